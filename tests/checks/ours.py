"""The checks of `sim.suite` that measure this project itself, and how their rows read."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

from haptic_loop.cli import render
from haptic_loop.cli.suite import Check, Part, Row, table
from haptic_loop.sim.stability import unstable

from tests.checks.challenges import challenges
from tests.checks.endurance import endurance
from tests.checks.faults import rehearse_faults
from tests.checks.hard import hard_loops
from tests.checks.random_loops import proofs, traces
from tests.checks.tightness import delayed, plot_tightness, usual
from tests.checks.uneven import uneven_ticks


def _optional(name: str, form: str) -> Callable[[Row], str]:
    return lambda row: render.optional(row[name], form)


def _failing(row: Row) -> str:
    """The coarsest setting that fails, what is wrong with it, and by how much."""
    if not row["fails"]:
        return "none tried"
    off = "" if row["off"] is None else f" {row['off']:+.1e}"
    return f"{' x '.join(map(str, row['fails']))}: {row['fault'] or '-'}{off}"


hard = table(
    "{good} of {count} verdicts right under the substep rule",
    {
        "loop": "{name}",
        "exact growth [1/s]": "{exact:+.4f}",
        "fails": _failing,
        "holds": "RK4 x {substeps}",
        "growth error [1/s]": "{error:+.1e}",
    },
)
faults = table(
    "{good} of {count} faults end as they must",
    {
        "fault": "{fault}",
        "ends in": "{stage}",
        "cause": lambda row: "; ".join(row["wrong"]) or row["cause"],
        "zero force after": _optional("zero_force_ms", "{:.1f} ms"),
        "allowed": _optional("allowed_ms", "{:.1f} ms"),
    },
)
memory_table = table(
    "{good} of {count} end as they must, with flat memory",
    {
        "work": "{what}",
        "result": "{result}",
        "peak after a tenth": _optional("tenth_mib", "{:.0f} MiB"),
        "peak at the end": _optional("end_mib", "{:.0f} MiB"),
    },
)
_uneven_rows = table(
    "no hand gains energy in {good} of {count} runs at 1.02 times the requirement",
    {
        "loop": "{loop}",
        "ticks": lambda row: f"{row['ticks']}, {'drawn' if row['drawn'] else 'the worst'}",
        "needs": "{required:.4g} N s/m",
        "most energy, of the start's": "{energy:.6g}",
        "balance below 0": lambda row: "never" if row["balance"] >= 0 else f"to {row['balance']:.1e} of what it sums",
        "grow with half": "{grow} of {hands}",
    },
)


def uneven(report: dict[str, Any]) -> list[Part]:
    """Of uneven ticks."""
    (part,) = _uneven_rows(report)
    found = sum(row["grow"] > 0 for row in report["rows"])
    below = f"hands grow in {found} of them" if found else "no hand was found that grows"
    return [replace(part, answer=f"{part.answer}; at half of it {below}")]


def tightness(report: dict[str, Any]) -> list[Part]:
    """How often the adversary succeeds, by the share of the damping that is missing."""
    found = {short: [row["found"] for row in rows] for short, rows in sorted(_by(report["rows"], "short").items())}
    rows = tuple((f"{short:.1%}", str(len(f)), f"{sum(f) / len(f):.0%}") for short, f in found.items())
    first = next((short for short, f in found.items() if all(f)), None)
    gist = "at no shortage that was tried does a human destabilise every loop"
    if first is not None:
        gist = f"a human destabilises every loop whose devices lack {first:.1%} of the damping required"
    whole = Part(gist, ("damping missing", "loops", "destabilised"), rows, "Success rate of the adversary")
    return [whole, *(replace(part, title="Each loop") for part in _each_loop(report))]


def _by(rows: Sequence[Row], *names: str) -> dict[Any, list[Row]]:
    """The rows, grouped by these figures."""
    groups: dict[Any, list[Row]] = {}
    for row in rows:
        groups.setdefault(tuple(row[name] for name in names) if names[1:] else row[names[0]], []).append(row)
    return groups


def _by_whom(row: Row) -> str:
    if not row["found"]:
        return "no human"
    return "one person" if row["held_together"] else "one hand each"


_each_loop = table(
    "",
    {
        "loop": "{loop}",
        "damping missing": "{short:.1%}",
        "destabilised by": _by_whom,
        "growth [1/s], first found": lambda row: f"{row['growth_rate_per_s']:+.3g}" if row["found"] else "-",
    },
)


def edges(report: dict[str, Any]) -> list[Part]:
    """Guarantees at their limit: one row for each guarantee and each multiple of the damping that it asks."""
    rows, taken = [], []
    for (name, factor), some in _by(report["rows"], "guarantee", "factor").items():
        motions, took, grew = (sum(row[of] for row in some) for of in ("motions", "took", "grew"))
        limited, least = max(row["limited"] for row in some), min(row["least_J"] for row in some)
        met = f"{took} of {motions}", f"{grew}"
        rows.append((name, f"{factor:g}", *met, f"{limited:.0%}", f"{least:.2g}"))
        if factor >= 1:
            taken.append(took + grew)
    columns = ("guarantee", "times what it asks", "motions that took energy", "hands that grew", "limited", "least J")
    return [Part(f"{sum(taken)} violations at 1.02 times what {len(taken)} guarantees ask", columns, tuple(rows))]


def proved(report: dict[str, Any]) -> list[Part]:
    """How many random networks are proved, by what the sweep says of them."""
    rows, good = [], sum(row["holds"] for row in report["rows"])
    for says, enough in (("there is enough damping", True), ("there is too little", False)):
        some = [row for row in report["rows"] if (row["required"] is not None and row["required"] < 1) == enough]
        rows.append((says, str(len(some)), str(sum(row["proved"] for row in some))))
    gist = f"proof and sweep agree about {good} of {len(report['rows'])} networks"
    return [Part(gist, ("the sweep says that", "networks", "proved"), tuple(rows))]


def traced(report: dict[str, Any]) -> list[Part]:
    """What the traces of random scenarios show, by what their eigenvalues say."""
    rows, good = [], sum(row["holds"] for row in report["rows"])
    for says, grows in (("stable", False), ("unstable", True)):
        some = [row for row in report["rows"] if bool(unstable(row["exact_per_s"])) == grows]
        read = [row for row in some if row["trace_per_s"] is not None]
        same = sum(bool(unstable(row["trace_per_s"])) == grows for row in read)
        quiet = sum(row["not_excited"] for row in some)
        rows.append((says, *map(str, (len(some), same, len(read) - same, quiet, len(some) - len(read) - quiet))))
    answers = ("the trace agrees", "says the opposite", "not excited", "no rate, for another reason")
    gist = f"{good} of {len(report['rows'])} traces agree with the eigenvalues"
    return [Part(gist, ("by the eigenvalues", "runs", *answers), tuple(rows))]


CHECKS = (
    Check("tightness", "How tight is the condition?", usual, tightness, plot_tightness),
    Check("delayed", "How tight is it with long delays?", delayed, tightness, plot_tightness),
    Check("hard", "Numerically hard loops", hard_loops, hard),
    Check("proofs", "Are random networks proved where the sweep says so?", proofs, proved),
    Check("traces", "Does a trace ever say the opposite of the eigenvalues?", traces, traced),
    Check("uneven", "Do uneven periods and late forces keep the guarantee?", uneven_ticks, uneven),
    Check("guarantees", "Do limits, budgets, walls and friction hold at what they ask?", challenges, edges),
    Check("faults", "Does every fault of a link end as it must?", lambda seed: rehearse_faults(), faults),
    Check("endurance", "Does memory stay flat over an hour and 100,000 hands?", endurance, memory_table),
)
