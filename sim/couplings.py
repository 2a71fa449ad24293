"""The coupling that a command was asked for, by name or in a file, and what a stored one is worth in a loop."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from haptic_loop.controller.coupling import PUBLISHED, Coupling, NoCoupling
from haptic_loop.controller.loop import DelayRange, Loop
from haptic_loop.design.api import COUPLING, bare, fitting
from haptic_loop.design.certificate import RangesCheck, assess, check_ranges, verify
from haptic_loop.design.conditions import Condition
from haptic_loop.design.coupling_file import Stored, load
from haptic_loop.design.coverage import Limits, RangesFigures, covered_limits
from haptic_loop.design.designs import KINDS, design_by_kind, name_and_own, own_coupling, usual_condition
from haptic_loop.design.environments import THIS_ENVIRONMENT
from haptic_loop.design.files import off_table
from haptic_loop.design.guarantees import guarantee_of
from haptic_loop.design.lmi import ANY_ENVIRONMENT
from haptic_loop.design.own import called, place_of
from haptic_loop.design.result import (
    CONDITIONS,
    KNOWN_CONDITIONS,
    Chosen,
    Design,
    DesignFailed,
    Requirement,
    switching_guarantee,
)
from haptic_loop.sim.scenario import InputError, Scenario

NAMES = ("none", "published", *KINDS)


def choose(
    scenario: Scenario,
    case: str,
    name: str | None = None,
    condition: str | Condition | None = None,
    limiter: bool | None = None,
    progress: Callable[[str, int, int], None] = lambda what, done, total: None,
) -> Chosen:
    """The coupling of a case; by default the designed spring-damper.

    See design.designs.design_by_kind for `condition`, `limiter` and `progress`.

    Raises InputError where the request contradicts itself, DesignFailed where there is no such coupling.
    """
    try:
        asked, own = name_and_own(condition)
        found = _choose(scenario, case, name, asked, own, limiter, progress)
    except (DesignFailed, InputError):
        raise
    except ValueError as error:
        if place_of(error):  # in a class of the user's own
            raise
        raise InputError(str(error)) from None
    return replace(found, own=own)


def _choose(
    scenario: Scenario,
    case: str,
    name: str | None,
    condition: str | None,
    own: Condition | None,
    limiter: bool | None,
    progress: Callable[[str, int, int], None],
) -> Chosen:
    """The same, by the name of the condition, and the user's own of that name."""
    if case == "none":
        if name not in (None, "none"):
            raise InputError(f"--coupling {name} with --case none: that case is the loop without coupling")
        name = "none"
    name = name or "spring-damper"
    if name == "none":
        return Chosen(NoCoupling(), condition or THIS_ENVIRONMENT.name, kind=name)
    if name == "published":
        if scenario.channels != 2:
            raise InputError(f"--coupling published: the paper prints gains for 2 channels, not {scenario.channels}")
        return Chosen(PUBLISHED[case], condition or ANY_ENVIRONMENT.name, kind=name)
    if name not in KINDS and ":" in name:
        made = own_of(name, scenario.loop(case))
        return replace(made, condition=condition or made.condition)
    if name in KINDS:
        loop = scenario.loop(case)
        condition = condition or usual_condition(loop, name)
        asked: dict[str, Any] = {"limiter": limiter} if limiter is not None and KINDS[name].limited else {}
        return replace(design_by_kind(loop, name, own or condition, progress, **asked), kind=name)
    if Path(name).suffix != ".json":
        raise InputError(f"--coupling is {name!r}, allowed are {', '.join(NAMES)}, a FILE.json or FILE.py:NAME")
    stored = read_coupling(name)
    coupling = fitted(stored, name, scenario.channels, scenario.T)
    made_for = stored.certificate.condition if stored.certificate else THIS_ENVIRONMENT.name
    checked = check_stored(stored, scenario.loop(case), own)
    if made_for not in (*CONDITIONS, *KNOWN_CONDITIONS):  # one of the user's own, which has to be named again
        made_for = THIS_ENVIRONMENT.name
    proof = (stored.certificate and stored.certificate.limiter) or None
    how = {"notes": checked.notes, "switching": checked.switching, "limiter": proof}
    return Chosen(coupling, condition or made_for, kind=Path(name).name, **how)


def own_of(name: str, loop: Loop) -> Chosen:
    """What a user's own function makes of a loop, which it must fit. Raises InputError."""
    found = own_coupling(name, loop)
    called(f"--coupling {name}", fitting, loop, found)
    return given(found, name)


def given(coupling: Coupling | Design | None, kind: str = "given") -> Chosen:
    """A coupling, or that of a design with its proofs; None is the loop without one."""
    if isinstance(coupling, Design):
        proof = (coupling.certificate and coupling.certificate.limiter) or None
        return replace(coupling, kind=kind, certificate=None, limiter=proof)
    alone = NoCoupling() if coupling is None else bare(coupling, f"{COUPLING}, or None for the loop without one")
    return Chosen(alone, THIS_ENVIRONMENT.name, kind=kind)


def limits_of(
    scenario: Scenario,
    chosen: Chosen,
    requirements: Mapping[str, Requirement] | None = None,
    limiter: bool | None = None,
) -> Limits:
    """How forces are limited in a loop: by the limiter that a guarantee covers, unless `limiter` is False."""
    within = tuple(device.force_limit for device in scenario.device)
    if limiter is False:
        return Limits(None, "forces are clipped, as asked", force_limit=within)
    if scenario.varying_delay:
        return Limits(None, "limited forces are proved for constant delays", force_limit=within)
    loop = scenario.loop("I")  # the reference does not matter
    coupling, proof = chosen.coupling, chosen.limiter
    asked = requirements or assess(loop, coupling, chosen.certificate, own=chosen.own)
    return covered_limits(loop, coupling, asked, proof, chosen.certificate).within(within)


def read_coupling(path: str | Path) -> Stored:
    """A stored coupling. Raises InputError where it cannot be read."""
    stored = load(path)
    try:
        stored.built()
    except ValueError as error:
        raise InputError(f"{path}: {error}") from None
    return stored


def fitted(stored: Stored, path: str, channels: int, T: float) -> Coupling:
    """The stored coupling in a loop of so many channels at T [s]. Raises InputError where it cannot stand there."""
    if len(stored.loop.delta) != channels:
        raise InputError(f"{path} couples {len(stored.loop.delta)} channels, the loop has {channels}")
    coupling = stored.coupling.build(T)
    if coupling.one_period and stored.loop.T != T:
        raise InputError(f"{path}: its coefficients are for T = {stored.loop.T:g} s, the loop has {T:g} s")
    return coupling


@dataclass(frozen=True)
class _FileCheck:
    """Whether a coupling's file proves anything in this loop."""

    notes: tuple[str, ...]  # what a reader should know of it
    switching: DelayRange | None = None  # the file proves that any switching of the delays within it is safe here


def check_stored(stored: Stored, loop: Loop, own: Condition | None = None) -> _FileCheck:
    """Whether the certificate on file holds, and what it says of the coupling in this loop.

    `own` is a condition of the user's, for a certificate of that name.
    """
    claim = stored.certificate
    asked = own if claim and own and claim.condition == own.name else None
    try:
        reason = verify(stored, asked).reason if claim else None
    except (ValueError, ArithmeticError) as error:
        reason = str(error)
    notes = [f"the certificate in the coupling's file does not hold: {reason}"] if reason else []
    delays = ("theta", "varying_delay", "lam")  # lam matters to transparency only
    differ = [n for n in loop.__struct_fields__ if n not in delays and getattr(loop, n) != getattr(stored.loop, n)]
    proved = stored.certificate is not None and not reason and not differ
    switching = stored.loop.varying_delay if proved else None
    if switching and switching.contains(loop.varying_delay or DelayRange(loop.theta, loop.theta)):
        if loop.theta != stored.loop.theta or loop.varying_delay not in (None, switching):
            constant = f"the constant theta = {list(loop.theta)}"
            here = switching_guarantee(loop.varying_delay) if loop.varying_delay else constant
            notes.append(f"the file proves {switching_guarantee(switching)}, which covers {here}")
        return _FileCheck(tuple(notes), switching)
    differ += ["theta"] if loop.theta != stored.loop.theta else []
    if loop.varying_delay and proved:
        made_for = switching_guarantee(switching) if switching else "constant delays"
        notes.append(f"the file proves {made_for}: {switching_guarantee(loop.varying_delay)} are judged anew here")
    if differ:
        notes.append(
            f"the coupling was stored for another loop (different {', '.join(differ)}), and is judged anew here"
        )
    return _FileCheck(tuple(notes), switching)


@dataclass(frozen=True)
class CouplingFigures:
    """Kind, gains (None where it has none) and order of V, Q or R."""

    kind: str
    order: int
    K: list[float] | None = None  # (m,) [N/m]
    B: list[float] | None = None  # (m,) [N s/m]
    stiffness: list[float] | None = off_table("if given", None)  # (m,) [N/m], static, of a moving average

    @classmethod
    def of(cls, kind: str, coupling: Coupling, T: float) -> CouplingFigures:
        return cls(kind, **coupling.figures(T))


# ----------------------------------------------------------------------------------------------------
# A coupling in its loop before anything runs: what each condition asks, ranges, limits, and whom it is safe for.


@dataclass(frozen=True, eq=False)
class Judged:
    """The parts that every report of a coupling begins with."""

    chosen: Chosen = off_table("left out")
    whole: RangesCheck | None = off_table("left out")
    coupling: CouplingFigures = off_table()
    certificates: dict[str, Requirement] = off_table()  # by condition
    guarantee: str | None = off_table()
    ranges: RangesFigures | None = off_table()
    limiter: Limits = off_table()

    @classmethod
    def of(
        cls,
        chosen: Chosen,
        loop: Loop,
        requirements: dict[str, Requirement],
        whole: RangesCheck | None,
        limits: Limits,
    ) -> Judged:
        """The verdicts on a coupling in a loop."""
        return cls(
            chosen,
            whole,
            CouplingFigures.of(chosen.kind, chosen.coupling, loop.T),
            requirements,
            guarantee_of(requirements, loop, bool(whole and whole.proved)),
            whole and RangesFigures.of(whole),
            limits,
        )

    @property
    def proved(self) -> bool:
        """Whether the guarantee is proved for the ranges."""
        return bool(self.whole and self.whole.proved)


def judge(
    scenario: Scenario,
    case: str,
    chosen: Chosen,
    seed: int,
    limiter: bool | None,
    met: Scenario,
    progress: Callable[[int, int], None],
) -> Judged:
    """The coupling in the scenario's loop; conditions are asked of `met`, one environment of its ranges."""
    whole = check_ranges(scenario.loop(case), chosen.coupling, seed, progress=progress)
    requirements = assess(met.loop(case), chosen.coupling, chosen.certificate, own=chosen.own)
    limits = limits_of(met, chosen, requirements, limiter)
    return Judged.of(chosen, met.loop(case), requirements, whole, limits)
