"""The coupling that a command was asked for: a name, or a file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from controller.coupling import Coupling, NoCoupling
from controller.lti import Array
from design.assess import specification
from design.designs import KINDS, design_coupling
from design.failure import DesignFailed
from design.published import PUBLISHED
from design.store import DelayRange
from sim.scenario import InputError, Scenario
from sim.stored import fitted, read_coupling, standing

NAMES = ("none", "published", *KINDS)


@dataclass(frozen=True, eq=False)
class Chosen:
    """A coupling, how it came about, and the condition that it was made for or is judged by."""

    kind: str
    coupling: Coupling
    condition: str
    phi: Array | None = None  # (m,) multiplier of Theorem 4 that the design found, if it needed one
    notes: tuple[str, ...] = ()  # what a reader should know of its origin
    switching: DelayRange | None = None  # its file proves that any switching of the delays within it is safe here


def choose(scenario: Scenario, case: str, name: str | None = None, condition: str | None = None) -> Chosen:
    """The coupling of a case; by default the designed spring-damper.

    Raises InputError where the request contradicts itself, DesignFailed where there is no such coupling.
    """
    if case == "none":
        if name not in (None, "none"):
            raise InputError(f"--coupling {name} with --case none: that case is the loop without coupling")
        name = "none"
    name = name or "spring-damper"
    if name == "none":
        return Chosen(name, NoCoupling(), condition or "closed-loop")
    if name == "published":
        return _published(scenario, case, condition)
    if name in KINDS:
        try:
            design = design_coupling(specification(scenario.loop(case)), name, condition)
        except DesignFailed:
            raise
        except ValueError as error:
            raise InputError(str(error)) from None
        return Chosen(name, design.coupling, design.condition, design.phi)
    return _from_file(scenario, case, name, condition)


def _published(scenario: Scenario, case: str, condition: str | None) -> Chosen:
    if scenario.channels != 2:
        raise InputError(f"--coupling published: the paper prints gains for 2 channels, not {scenario.channels}")
    return Chosen("published", PUBLISHED[case], condition or "theorem4")


def _from_file(scenario: Scenario, case: str, name: str, condition: str | None) -> Chosen:
    if Path(name).suffix != ".json":
        raise InputError(f"--coupling is {name!r}, allowed are {', '.join(NAMES)} or a FILE.json")
    stored = read_coupling(name)
    coupling = fitted(stored, name, scenario.channels, scenario.T)
    made_for = stored.certificate.condition if stored.certificate else "closed-loop"
    there = standing(stored, scenario.loop(case))
    return Chosen(Path(name).name, coupling, condition or made_for, notes=there.notes, switching=there.switching)
