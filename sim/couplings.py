"""The couplings that a command can be asked for, by name."""

from __future__ import annotations

from dataclasses import dataclass

from controller.coupling import Coupling, NoCoupling, SpringDamper
from design.margin import Requirement, closed_loop, theorem4_per_channel
from design.published import PUBLISHED
from sim.scenario import InputError, Scenario
from sim.simulate import Assembly

KINDS = ("none", "published")
CONDITIONS = ("theorem4", "closed-loop")


@dataclass(frozen=True, eq=False)
class Chosen:
    """A coupling, how it came about, and the condition that it was made or is judged by."""

    kind: str
    coupling: Coupling
    condition: str


def choose(scenario: Scenario, case: str, kind: str | None, condition: str | None) -> Chosen:
    """The coupling of a case. Raises InputError where the request contradicts itself."""
    if case == "none":
        if kind not in (None, "none"):
            raise InputError(f"--coupling {kind} with --case none: that case is the loop without coupling")
        kind = "none"
    kind = kind or "published"
    if kind == "none":
        return Chosen(kind, NoCoupling(), condition or "closed-loop")
    if scenario.channels != 2:
        raise InputError(f"--coupling published: the paper prints gains for 2 channels, not {scenario.channels}")
    return Chosen(kind, PUBLISHED[case], condition or "theorem4")


def requirements(assembly: Assembly, coupling: Coupling) -> dict[str, Requirement]:
    """What each condition asks of the devices."""
    scenario = assembly.scenario
    return {
        "theorem4": _theorem4(scenario, coupling),
        "closed-loop": closed_loop(assembly.F, scenario.delta),
    }


def _theorem4(scenario: Scenario, coupling: Coupling) -> Requirement:
    unknown = (float("inf"),) * scenario.channels
    if isinstance(coupling, NoCoupling):
        return Requirement("theorem4", unknown, scenario.delta, None, "without a coupling Theorem 4 has nothing to use")
    if any(scenario.psi):
        return Requirement("theorem4", unknown, scenario.delta, None, "an environment delay (psi >= 1) needs the LMI")
    assert isinstance(coupling, SpringDamper)
    return theorem4_per_channel(coupling.channels(scenario.T), scenario.theta, scenario.delta)
