"""Why no single Q serves a whole set of environments, and what to change."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

from design.parameter.wish import Wish
from design.specification import Specification

Question = Callable[[Specification, Wish], bool]
Progress = Callable[[str, int, int], None]  # what is being done, steps done, of how many

SMALLER = (0.75, 0.5, 0.25, 0.1)  # times the width of a box's ranges that are tried


def set_advice(
    spec: Specification,
    wish: Wish,
    changes: Mapping[str, Wish],
    feasible: Question,
    solvable: Question,
    binding: Callable[[Specification, Wish], str],
    progress: Progress,
) -> str:
    """Which vertices leave no solution though the environment alone has one, and what would.

    `changes` are tried one at a time. feasible: by a quick look, which may err on the hopeful side; solvable: by the
    whole search at the vertices.
    """
    others = spec.others.items()
    total, done = len(others) + len(changes) + 1 + len(SMALLER), 0

    def step() -> bool:
        nonlocal done
        progress("no coupling: looking for the reason", done, total)
        done += 1
        return True

    hopeless = [
        name for name, E in others if step() and not feasible(replace(spec, others={name: E}, shrunk=None), wish)
    ]
    kind = "diagonal" if wish.diagonal else "full"
    request = f"no {kind} Q of {wish.functions} functions is certified for the whole box"
    if hopeless:
        more = f", nor with {len(hopeless) - 1} more of the {len(others)} vertices" if len(hopeless) > 1 else ""
        why = f"beside the nominal environment there is none with {hopeless[0]}{more}"
    else:
        why = "each vertex has one beside the nominal environment, but not all of them together with the points between"
    helpful = [w for w, other in changes.items() if step() and feasible(spec, other) and solvable(spec, other)]
    assert spec.shrunk  # a box came with it
    smaller = ((f, replace(spec, others=spec.shrunk(f), regions=())) for f in SMALLER)
    share = next((f for f, less in smaller if step() and solvable(less, wish)), None)
    step()
    limit = binding(spec, wish)
    remedies = [
        f"there is one for ranges of {share:.0%} of their width around the nominal values" if share else "",
        f"there is one for the whole box with {', or with '.join(helpful)}" if helpful else "",
    ]
    remedy = "; ".join(filter(None, remedies)) or f"nothing helped of narrower ranges, {', '.join(changes)}"
    return f"{request}: {why}; {limit}; {remedy}"
