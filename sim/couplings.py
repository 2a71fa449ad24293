"""Choose the coupling of a command by name or from a file, and assess it in the scenario's loop."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from haptic_loop.controller.coupling import PUBLISHED, Coupling, NoCoupling
from haptic_loop.controller.environment import Environment
from haptic_loop.controller.loop import Loop
from haptic_loop.design.api import COUPLING, bare, certified_for, fitting
from haptic_loop.design.assessment import Assessment, EncoderSteps, PluggedEnvironment, assess, shelled
from haptic_loop.design.certificate import verify
from haptic_loop.design.conditions import Condition
from haptic_loop.design.coupling_file import Stored, load
from haptic_loop.design.designs import KINDS, design_by_kind, name_and_own, own_coupling, usual_condition
from haptic_loop.design.environments import ANY_ENVIRONMENT, THIS_ENVIRONMENT
from haptic_loop.design.own import called, place_of
from haptic_loop.design.result import (
    CONDITIONS,
    KNOWN_CONDITIONS,
    Chosen,
    Design,
    DesignFailed,
    switching_guarantee,
)
from haptic_loop.design.transparency import BAND_HZ
from haptic_loop.design.worst_member import Progress
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
    """Return the coupling `name` for a case.

    Args:
        scenario: The scenario whose loop the coupling is for.
        case: The reference delays, "I" or "II"; "none" for the loop without a coupling.
        name: One of NAMES, FILE.json, or FILE.py:NAME of a user's own function. None means a design: a moving average
            in a MuJoCo scene, otherwise a spring-damper.
        condition: The condition of a design, by name or a user's own; None for the kind's usual condition.
        limiter: True requires a proof for limited forces, False ignores force limits, and None is the kind's default.
            Kinds without such proofs ignore it.
        progress: Called during long searches with (task, steps done, number of steps).

    Raises:
        InputError: Options contradict each other, or a file does not fit.
        DesignFailed: No coupling was found.
    """
    try:
        target, own = name_and_own(condition)
        chosen = _choose(scenario, case, name, target, own, limiter, progress)
    except (DesignFailed, InputError):
        raise
    except ValueError as error:
        if place_of(error):  # A class in the user's own file raised the error.
            raise
        raise InputError(str(error)) from None
    return replace(chosen, own=own)


def _choose(
    scenario: Scenario,
    case: str,
    name: str | None,
    condition: str | None,
    own: Condition | None,
    limiter: bool | None,
    progress: Callable[[str, int, int], None],
) -> Chosen:
    if case == "none":
        if name not in (None, "none"):
            raise InputError(f"--coupling {name} with --case none: that case is the loop without coupling")
        name = "none"
    name = name or ("moving-average" if scenario.environment.world else "spring-damper")
    if name == "none":
        return Chosen(NoCoupling(), condition or THIS_ENVIRONMENT.name, kind=name)
    if name == "published":
        if scenario.channels != 2:
            raise InputError(f"--coupling published: the paper prints gains for 2 channels, not {scenario.channels}")
        return Chosen(PUBLISHED[case], condition or ANY_ENVIRONMENT.name, kind=name)
    if name not in KINDS and ":" in name:
        coupled = own_of(name, scenario.loop(case))
        return replace(coupled, condition=condition or coupled.condition)
    if name in KINDS:
        loop = scenario.loop(case)
        condition = condition or usual_condition(loop, name)
        further: dict[str, Any] = {"limiter": limiter} if limiter is not None and KINDS[name].limited else {}
        return replace(design_by_kind(loop, name, own or condition, progress, **further), kind=name)
    stored, coupling = stored_coupling(scenario, name)
    chosen = from_file(stored, scenario.loop(case), Path(name).name, own, coupling)
    return replace(chosen, condition=condition or chosen.condition)


def stored_coupling(scenario: Scenario, name: str) -> tuple[Stored, Coupling]:
    """Return the content of FILE.json, and its coupling for the scenario. Raises InputError if they do not fit."""
    if Path(name).suffix != ".json":
        raise InputError(f"--coupling is {name!r}, allowed are {', '.join(NAMES)}, a FILE.json or FILE.py:NAME")
    stored = read_coupling(name)
    return stored, fitted(stored, name, scenario.channels, scenario.T)


def own_of(name: str, loop: Loop) -> Chosen:
    """Return the coupling of a user's own function for a loop. Raises InputError if the coupling does not fit."""
    coupling = own_coupling(name, loop)
    called(f"--coupling {name}", fitting, loop, coupling)
    return given(coupling, name)


def given(coupling: Any, kind: str = "given") -> Chosen:
    """Return the choice of a coupling or of a design with its proofs. None means the loop without a coupling."""
    if isinstance(coupling, Design):
        return replace(coupling, kind=kind)
    alone = NoCoupling() if coupling is None else bare(coupling, f"{COUPLING}, FILE.json, or None for no coupling")
    return Chosen(alone, THIS_ENVIRONMENT.name, kind=kind)


def read_coupling(path: str | Path) -> Stored:
    """Read a stored coupling. Raises InputError if the file or its coupling is invalid."""
    stored = load(path)
    try:
        stored.built()
    except ValueError as error:
        raise InputError(f"{path}: {error}") from None
    return stored


def fitted(stored: Stored, path: str, channels: int, T: float) -> Coupling:
    """Return the stored coupling for a loop of `channels` at T [s]. Raises InputError if the coupling does not fit."""
    if len(stored.loop.delta) != channels:
        raise InputError(f"{path} couples {len(stored.loop.delta)} channels, the loop has {channels}")
    coupling = stored.coupling.build(T)
    if coupling.one_period and stored.loop.T != T:
        raise InputError(f"{path}: its coefficients are for T = {stored.loop.T:g} s, the loop has {T:g} s")
    return coupling


def from_file(
    stored: Stored, loop: Loop, kind: str = "given", own: Condition | None = None, coupling: Coupling | None = None
) -> Chosen:
    """Return the stored coupling with the proofs of its file, and notes on how the file's loop differs from `loop`.

    Args:
        stored: The content of the file.
        loop: The loop in which the coupling is used.
        kind: The name of the coupling in reports.
        own: The user's own condition. The file stores only its name, but a check of the file's certificate needs it.
        coupling: The file's coupling if the caller has built it, for example for another T.

    Returns:
        The choice. Its `certificate` holds for the loop of the file, which may differ from `loop`.
    """
    claim, coupling = stored.certificate, coupling or stored.built()
    made_for = claim.condition if claim and claim.condition in CONDITIONS else THIS_ENVIRONMENT.name
    condition = own if claim and own and claim.condition == own.name else None
    try:
        reason = verify(stored, condition).reason if claim else None
    except (ValueError, ArithmeticError) as error:
        reason = str(error)
    notes = [f"the certificate in the coupling's file does not hold: {reason}"] if reason else []
    delays = ("theta", "varying_delay", "lam")  # theta and varying_delay are compared below; lam affects no proof.
    differ = [n for n in loop.__struct_fields__ if n not in delays and getattr(loop, n) != getattr(stored.loop, n)]
    proved = claim is not None and not reason
    switching = stored.loop.varying_delay if proved and not differ else None
    if switching and switching.contains(loop.delays):
        if loop.theta != stored.loop.theta or loop.varying_delay not in (None, switching):
            constant = f"the constant theta = {list(loop.theta)}"
            here = switching_guarantee(loop.varying_delay) if loop.varying_delay else constant
            notes.append(f"the file proves {switching_guarantee(switching)}, which covers {here}")
    else:
        differ += ["theta"] if loop.theta != stored.loop.theta else []
        if loop.varying_delay and proved and not differ:
            made_for_delays = switching_guarantee(switching) if switching else "constant delays"
            here = switching_guarantee(loop.varying_delay)
            notes.append(f"the file covers only {made_for_delays}, so {here} are judged anew here")
        if differ:
            notes.append(
                f"the coupling was stored for another loop (different {', '.join(differ)}), and is judged anew here"
            )
    return Chosen(
        coupling,
        made_for,
        kind=kind,
        certificate=claim if proved else None,
        limiter=(claim and claim.limiter) or None,
        switching=switching,
        notes=tuple(notes),
        certified_for=certified_for(stored.loop, proved),
    )


# ---- assessment before a run


def assessed(
    scenario: Scenario,
    case: str,
    chosen: Chosen,
    *,
    environment: Environment | PluggedEnvironment | None = None,
    energy_budget: float | None = None,
    limiter: bool | None = None,
    seed: int = 0,
    band_hz: tuple[float, float] = BAND_HZ,
    progress: Progress = lambda done, total: None,
) -> Assessment:
    """Return the assessment of the chosen coupling in the loop of a scenario, before the loop runs.

    Args:
        scenario: The scenario. A guarantee must cover all its ranges, delays, periods and force limits.
        case: The reference delays, "none", "I" or "II".
        chosen: The coupling with its proofs.
        environment: A network or function that runs in place of the scenario's environment.
        energy_budget: W0 [J] of the shell around a function or a MuJoCo scene, otherwise of the devices' energy budget.
        limiter: False to clip forces.
        seed: Seed of the environments that are drawn from inside ranges.
        band_hz: Frequency band [Hz] over which the transparency error counts.
        progress: Called with (points done, number of points) of the search over ranges.

    Returns:
        The assessment; encoder steps or lost packets may have removed its guarantee (`qualified`).
    """
    assessment = assess(
        scenario.loop(case),
        chosen,
        environment=environment,
        energy_budget=energy_budget,
        ranges_seed=seed,
        limiter=limiter,
        band_hz=band_hz,
        progress=progress,
    )
    return qualified(scenario, case, assessment)


def qualified(scenario: Scenario, case: str, assessment: Assessment) -> Assessment:
    """Return the assessment with the scenario's force limits and encoder steps.

    A guarantee that does not cover the scenario is removed. A shell gives no guarantee with encoder steps. With lost
    packets only an energy budget gives a guarantee, because forces may become older than any certificate covers.
    """
    plugged = shelled(assessment.environment)
    assessment = assessment.within([device.force_limit for device in scenario.axis_devices])
    assessment = assessment.with_encoder(None if plugged else encoder_steps(scenario, case, assessment))
    if plugged and assessment.guarantee and any(device.encoder_step for device in scenario.axis_devices):
        return assessment.without_guarantee("the devices have encoder steps, and the shell requires exact positions")
    budgeted = assessment.force_limits.energy_budget is not None and not plugged
    if scenario.loses_packets and assessment.guarantee and not budgeted:
        return assessment.without_guarantee("a lost packet makes a force older than the range of delays")
    return assessment


def encoder_steps(
    scenario: Scenario, case: str, assessment: Assessment, steps: Sequence[float] | None = None
) -> EncoderSteps | None:
    """Return the devices' friction beside the friction that encoder steps need in the environment that runs.

    `steps` (m,) [m] replace the scenario's encoder steps. Returns None without steps, or if the loop is singular.
    """
    stated = assessment.guarantee
    beyond = stated.condition if stated and (stated.own or stated.condition in KNOWN_CONDITIONS) else None
    fields = ("encoder_step", "friction", "friction_max")
    own, friction, most = ([getattr(device, field) for device in scenario.axis_devices] for field in fields)
    friction = [f / n for f, n in zip(friction, _shared(scenario), strict=True)]
    loop, running = scenario.loop(case), assessment.environment
    loop = loop.at(running) if isinstance(running, Environment) else loop
    try:
        return EncoderSteps.of(loop, assessment.coupling, steps or own, friction, most, beyond)
    except ValueError:  # The algebraic loop has no solution, which the conditions report.
        return None


def _shared(scenario: Scenario) -> list[float]:
    """Return a divisor for each channel's friction: sqrt(n) if one number bounds the friction of n axes together."""
    counts = [1 if isinstance(d.friction, tuple) else len(d.free) for d in scenario.device]
    return [count**0.5 for d, count in zip(scenario.device, counts, strict=True) for _ in d.free]
