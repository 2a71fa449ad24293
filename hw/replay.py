"""python -m hw.replay: a recorded session through the controller again, and the forces compared bit by bit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np
from numpy.typing import NDArray
from rich.table import Table

from cli.options import DOES_NOT_HOLD, DONE, Parser, check_json, execute
from cli.render import console
from controller.coupling import Form
from controller.environment import environment
from controller.loop import force_map
from controller.lti import Array, Lti
from hw.handshake import Units
from hw.law import Law
from hw.safety import Fault, Limits, shape
from hw.trace import load
from models.device import require
from sim.files import write_json
from sim.scenario import InputError, Scenario
from sim.trace import Result


class Recipe(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What a trace says of the controller that made it."""

    scenario: Scenario
    coupling: Form
    link_delay: int
    limits: Limits
    force_step: tuple[float, ...]
    cap: tuple[int, ...]

    def __post_init__(self) -> None:
        """Raises ValueError naming what no session can have written."""
        m, least = self.scenario.channels, min(self.scenario.theta)
        for name, given in (("limits.cap", self.limits.cap), ("force_step", self.force_step), ("cap", self.cap)):
            if len(given) != m:
                raise ValueError(f"{name} has {len(given)} entries, the scenario {m} channels")
        for i in range(m):
            require(f"force_step[{i}]", self.force_step[i], 1e-9, 1.0, "N")
            require(f"cap[{i}]", self.cap[i], 1, 0x7FFF, "steps")
        if not 1 <= self.link_delay <= least:
            raise ValueError(f"link_delay is {self.link_delay}, allowed are 1 to {least}, the scenario's least theta")

    def law(self) -> Lti:
        """F as the host ran it."""
        scenario = self.scenario
        E = environment(scenario.environment, scenario.T)
        host = [n - self.link_delay for n in scenario.theta]
        return force_map(E, self.coupling.build(scenario.T), host, scenario.psi)


@dataclass(frozen=True, eq=False)
class Comparison:
    """Where the replay differs from the record."""

    asked: NDArray[np.bool_]  # (N,) the controller's forces, as 64-bit floats
    sent: NDArray[np.bool_]  # (N,) what was put on the wire, as integers
    largest: float  # [N] between the controller's forces

    @property
    def identical(self) -> bool:
        return not (self.asked.any() or self.sent.any())


def recipes_of(result: Result) -> list[Recipe]:
    """The recipes in a trace, one for each arming. Raises InputError where there is none."""
    try:
        _require_limits(result.meta.get("replay"))
        return msgspec.convert(result.meta.get("replay"), Annotated[list[Recipe], msgspec.Meta(min_length=1)])
    except (msgspec.ValidationError, ValueError) as error:
        raise InputError(f"the trace cannot be replayed: {error}") from None


def _require_limits(raw: object) -> None:
    """Raise ValueError where a recipe has other limits than Limits: msgspec passes over those of a dataclass."""
    names = {field.name for field in fields(Limits)}
    for recipe in raw if isinstance(raw, list) else []:
        limits = recipe.get("limits") if isinstance(recipe, dict) else None
        if isinstance(limits, dict) and set(limits) != names:
            wrong = ", ".join(sorted(set(limits) ^ names))
            raise ValueError(f"limits are {', '.join(sorted(names))}; missing or unknown: {wrong}")


def replay(result: Result, link: dict[str, Array]) -> Comparison:
    """Feed the recorded displacements through law, gain, limits and rounding, every arming from rest."""
    recipes, arming = recipes_of(result), link["arming"]
    channels = result.x.shape[1]
    if int(arming[-1]) + 1 != len(recipes) or any(recipe.scenario.channels != channels for recipe in recipes):
        told = f"{len(recipes)} recipes for {int(arming[-1]) + 1} armings of {channels} channels"
        raise InputError(f"the trace cannot be replayed: it has {told}")
    asked, sent = np.zeros_like(link["asked"]), np.zeros_like(link["sent"])
    for i, recipe in enumerate(recipes):
        _again(recipe, np.flatnonzero(arming == i), result, link, (asked, sent))
    different = asked.view(np.int64) != link["asked"].view(np.int64)
    largest = float(np.abs(asked - link["asked"]).max(initial=0.0))
    return Comparison(different.any(axis=1), (sent != link["sent"]).any(axis=1), largest)


def _again(
    recipe: Recipe, ticks: NDArray[np.intp], result: Result, link: dict[str, Array], into: tuple[Array, Array]
) -> None:
    """The `ticks` of one arming: forces asked for and steps sent, written to `into`."""
    law, units = _built(recipe), Units((1.0,) * len(recipe.cap), recipe.force_step, (1.0,) * len(recipe.cap))
    force: Sequence[float] = (0.0,) * len(recipe.cap)
    asked, sent = into
    for k in ticks:
        asked[k] = law.step(result.x[k].tolist())
        if not link["received"][k]:
            continue
        try:
            gain = float(link["gain"][k])
            force = shape(asked[k].tolist(), force, gain, recipe.limits, recipe.scenario.T).force
        except Fault as fault:
            raise InputError(f"the trace cannot be replayed: tick {k}: {fault}") from None
        sent[k] = units.steps(force, recipe.cap)


def _built(recipe: Recipe) -> Law:
    try:
        return Law(recipe.law())
    except ValueError as error:
        raise InputError(f"the trace cannot be replayed: {error}") from None


def main(argv: list[str]) -> int:
    """Replay a trace. 0: every force is the recorded one bit by bit, 1: not."""
    parser = Parser(
        "hw.replay",
        "Feed a recorded session through the controller again and compare the forces bit by bit.",
        "python -m hw.replay out/bridge-I/trace.npz",
    )
    parser.add_argument("trace", metavar="TRACE.npz", help="written by hw.bridge")
    parser.add_argument("--json", metavar="FILE|-", help="machine-readable result; - is standard output")
    args = parser.parse_args(argv)
    check_json(args)
    result, link = load(Path(args.trace))
    compared = replay(result, link)
    ticks, received = result.t.size, int(link["received"].sum())
    outcome = {
        "trace": args.trace,
        "ticks": ticks,
        "filled_in": ticks - received,
        "asked_differ": int(compared.asked.sum()),
        "sent_differ": int(compared.sent.sum()),
        "largest_difference_n": compared.largest,
        "first_difference_s": _first(compared, result),
        "identical": compared.identical,
    }
    table = Table(title=args.trace, show_header=False)
    for name, value in outcome.items():
        table.add_row(name.replace("_", " "), "-" if value is None else str(value))
    console(args).print(table)
    if args.json:
        write_json(args.json, outcome)
    return DONE if compared.identical else DOES_NOT_HOLD


def _first(compared: Comparison, result: Result) -> float | None:
    different = compared.asked | compared.sent
    return float(result.t[np.argmax(different)]) if different.any() else None


if __name__ == "__main__":
    execute(main)
