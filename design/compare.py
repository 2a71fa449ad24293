"""Couplings side by side: over frequency, as a ladder of designs, and as limits along an axis of the loop."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import msgspec
import numpy as np
from haptic_loop.controller.coupling import PUBLISHED, Coupling, NoCoupling
from haptic_loop.controller.delay import delay
from haptic_loop.controller.loop import Loop
from haptic_loop.controller.lti import Array, Lti
from haptic_loop.design import conditions
from haptic_loop.design.bound import MOST, NO_BOUND, bound
from haptic_loop.design.certificate import named, prove
from haptic_loop.design.conditions import Condition
from haptic_loop.design.coupling_file import digest
from haptic_loop.design.designs import design_by_kind
from haptic_loop.design.files import off_table
from haptic_loop.design.frequency import Response, frequencies, on_circle
from haptic_loop.design.program import LADDER, Options
from haptic_loop.design.result import CONDITIONS, ConditionName, Design, DesignFailed, NotProved, Requirement, finite
from haptic_loop.design.robustness import Nearby
from haptic_loop.design.transparency import decibels, transparency
from numpy.typing import NDArray

# ----------------------------------------------------------------------------------------------------
# A coupling over frequency: singular values, the demand for damping, and what a hand perceives.


_Progress = Callable[[int, int], None]  # (designs done, designs in all)
_NearbyOf = Callable[[Loop, Coupling], Nearby]

_LOWEST_HZ = 0.1
FEEL_HZ = (1.0, 10.0)  # where perceived stiffness and damping are quoted


@dataclass(frozen=True, eq=False)
class Perceived:
    """The effective impedance of one channel with the others held still: x -> f read as a spring and a damper."""

    stiffness: Array  # (k, m) Re G_ii [N/m]
    damping: Array  # (k, m) Im G_ii / omega [N s/m]; below zero where motion is fed


@dataclass(frozen=True, eq=False)
class Demands:
    """A coupling in its loop, with what both conditions ask of the devices."""

    F: Lti
    requirements: dict[str, Requirement]
    demands: dict[str, Response | None]  # w -> required over available damping; None where no damping helps


@dataclass(frozen=True, eq=False)
class Curves:
    """One coupling at the frequencies `hz` of its picture."""

    sigma_F: Array  # (k, m) singular values of F [N/m], largest first
    sigma_M: Array  # (k, m) of the mismatch F - Lambda E [N/m]
    perceived: Perceived
    demands: dict[str, Array | None] = field(metadata={"json": "left out"})  # (k,) required over available damping


def judge(loop: Loop, coupling: Coupling, own: Sequence[Condition] = ()) -> Demands:
    """Every condition of a coupling, as figures and over frequency, before walls while all touch. Raises SingularLoop.

    `own` are conditions of the user's.
    """
    F, touching = loop.F(coupling), loop.at(loop.environment.frozen()[-1])
    requirements: dict[str, Requirement] = {}
    demands: dict[str, Response | None] = {}
    for each in (*map(named, CONDITIONS), *own):
        here = loop.at(loop.environment) if each.beyond(loop.at(loop.environment)) else touching  # refused, or judged
        needs = requirements[each.name] = each.judge(here, coupling)
        curve = each.over_frequency(here, coupling, needs.multiplier) if np.isfinite(needs.ratio) else None
        demands[each.name] = curve
    return Demands(F, requirements, demands)


def grid(loop: Loop, couplings: Sequence[Demands], low_hz: float = _LOWEST_HZ) -> Array:
    """Frequencies [Hz] up to Nyquist's, dense around every pole, with FEEL_HZ and where conditions bind."""
    per_hz = 2 * np.pi * loop.T
    systems = (loop.E(), *(judged.F for judged in couplings))
    even = frequencies(*systems, low=low_hz * per_hz, high=np.pi, points=200) / per_hz
    binding = [r.frequency_hz for judged in couplings for r in judged.requirements.values()]
    wanted = (*FEEL_HZ, *(hz for hz in binding if hz is not None))
    return np.unique([*even, *(hz for hz in wanted if low_hz <= hz <= even[-1])])


def curves(loop: Loop, judged: Demands, hz: Array) -> Curves:
    """The curves of one coupling at `hz` (k,)."""
    w = 2 * np.pi * hz * loop.T
    z = on_circle(w)
    E = loop.E()
    target = (delay(loop.lam, loop.T) @ E).at(z)
    F = judged.F.at(z)
    demands = {name: None if demand is None else demand(w) for name, demand in judged.demands.items()}
    return Curves(_singular_values(F), _singular_values(F - target), perceived(F, hz), demands)


def ideal(loop: Loop, hz: Array) -> tuple[Array, Perceived]:
    """Singular values of E (k, m) [N/m] and its effective impedance: what an undelayed loop without coupling gives."""
    E = loop.E().at(on_circle(2 * np.pi * hz * loop.T))
    return _singular_values(E), perceived(E, hz)


def _singular_values(G: NDArray[np.complex128]) -> Array:
    """(k, m, m) -> (k, m), largest first."""
    return np.linalg.svd(G, compute_uv=False)


def perceived(G: NDArray[np.complex128], hz: Array) -> Perceived:
    """The diagonal of displacement-to-force responses (k, m, m) at `hz` (k,) > 0 as stiffness and damping."""
    own = np.diagonal(G, axis1=1, axis2=2)
    return Perceived(own.real, own.imag / (2 * np.pi * hz)[:, None])


# ----------------------------------------------------------------------------------------------------
# How good a coupling could be if the laboratory were another: the optimum along one axis of the loop or of the
# design.
#
# Every point is a convex problem of its own (design.optimal), so what a curve shows is a limit, not what a search
# found.


_Kept = Literal["samples", "seconds"]  # what stays of a delay when the period changes


@dataclass(frozen=True)
class _Axis:
    """A quantity that is varied: its label, its unit, and the default range around its value in the loop."""

    label: str
    unit: str
    low: float  # times its value in the loop; nan where it is not a factor
    high: float
    least: float  # what may be asked for
    most: float


AXES = {
    "damping": _Axis("damping of the devices (the least)", "N s/m", 0.5, 1.4, 1e-3, 1e3),
    "delay": _Axis("transmission delay (the largest)", "samples", math.nan, math.nan, 0, 100),
    "period": _Axis("sampling period", "s", 0.5, 2.5, 1e-5, 0.1),
    "order": _Axis("rungs of the optimal coupling's basis", "rungs", 0.2, 1.0, 1, len(LADDER)),
}


@dataclass(frozen=True)
class Point:
    """One point of a curve: where it is drawn, and what is designed there."""

    value: float
    loop: Loop
    options: Options


def points_along(
    axis: str,
    loop: Loop,
    options: Options,
    points: int,
    span: tuple[float, float] | None = None,
    kept: _Kept = "samples",
) -> list[Point]:
    """The points of one axis, the loop's own among them. Raises ValueError for an empty or impossible range.

    damping: all devices scaled alike. delay: the same number of samples more or less on every channel. period: `kept`
    says what stays of the delays. Lambda keeps what it lacks of Theta Psi. `span` is in the axis' unit.
    """
    if axis not in AXES:
        raise ValueError(f"axis is {axis!r}, allowed are {', '.join(AXES)}")
    least, most, unit = AXES[axis].least, AXES[axis].most, AXES[axis].unit
    if span and not least <= span[0] < span[1] <= most:
        raise ValueError(f"the range {span[0]:g}:{span[1]:g} is none between {least:g} and {most:g} {unit}")
    if axis == "damping":
        least = min(loop.delta)
        values = _spread(least, AXES[axis], points, span)
        return [
            Point(v, msgspec.structs.replace(loop, delta=tuple(v / least * d for d in loop.delta)), options)
            for v in values.tolist()
        ]
    if axis == "delay":
        longest, shortest = max(loop.theta), min(loop.theta)
        low, high = span or (longest - min(shortest, points - 1), None)
        steps = range(int(low), int(low) + points) if high is None else _whole(low, high, points)
        if min(steps) < longest - shortest:
            raise ValueError(f"delay starts at {min(steps)}, but the channels differ by {longest - shortest} samples")
        return [Point(float(n), _delayed(loop, n - longest), options) for n in steps]
    if axis == "period":
        return [Point(T, _sampled(loop, T, kept), options) for T in _spread(loop.T, AXES[axis], points, span).tolist()]
    rungs = {max(1, round(n)) for n in _spread(len(options.ladder), AXES[axis], points, span).tolist()}
    return [Point(float(n), loop, replace(options, ladder=LADDER[:n])) for n in sorted(rungs)]


@dataclass(frozen=True)
class Limit:
    """The best design found at a point, or the reason why there is none."""

    value: float
    delta: tuple[float, ...]  # [N s/m]
    theta: tuple[int, ...]  # [samples]
    T_s: float
    states: int | None  # of the loop; None: no design
    rms_mismatch_db: float | None
    relative_mismatch_db: float | None
    required_damping: tuple[float | None, ...] | None  # this-environment, [N s/m]
    dc_ratio: float | None  # share of the static stiffness that is felt
    bare_damping: tuple[float | None, ...]  # what the loop without any coupling requires, this-environment [N s/m]
    wall_s: float
    reason: str | None = None  # why there is no design
    proof: str | None = None  # of the condition it was designed for: "rational" (exact) or "sampled"; None: no design
    proof_reason: str | None = None  # why there is no exact proof


_Designer = Callable[[Point], Limit]


def optimum(point: Point) -> Limit:
    """The optimal coupling of a point."""
    return measured(point, "optimal", None, vars(point.options))


def spring_damper(condition: ConditionName) -> _Designer:
    """The designed spring-damper of a point."""
    return lambda point: measured(point, "spring-damper", condition, {})


def measured(point: Point, kind: str, condition: ConditionName | None, options: dict[str, Any]) -> Limit:
    """One design and its figures, from the coupling alone; a request without a solution gives its reason."""
    loop, begin = point.loop, time.perf_counter()
    names = ("states", "rms_mismatch_db", "relative_mismatch_db", "required_damping", "dc_ratio")
    figures: dict[str, Any] = dict.fromkeys(names)
    bare: tuple[float | None, ...] = (None,) * len(loop.delta)
    try:
        bare = _damping(conditions.this_environment(loop.F(NoCoupling()), loop))
        design = design_by_kind(loop, kind, condition, **options)
    except ValueError as error:  # no such design, or a loop that cannot be
        figures["reason"] = str(error)
    else:
        F = loop.F(design.coupling)
        transparent = transparency(F, loop.E(), loop.lam)
        figures = {
            "states": F.order,
            "rms_mismatch_db": finite(decibels(transparent.rms_mismatch)),
            "relative_mismatch_db": finite(decibels(transparent.relative_mismatch)),
            "required_damping": _damping(conditions.this_environment(F, loop)),
            "dc_ratio": finite(transparent.dc_ratio),
        } | _proof(loop, design)
    wall = time.perf_counter() - begin
    place = (point.value, loop.delta, loop.theta, loop.T)
    return Limit(*place, **figures, bare_damping=bare, wall_s=wall)


def _proof(loop: Loop, design: Design) -> dict[str, str | None]:
    """Whether the design's own condition was proved in exact arithmetic, and why not."""
    phi = None if design.phi is None else design.phi.tolist()
    # what is asked is the environment alone, as the figures are
    alone = loop.at(loop.environment)
    try:
        certificate = prove(alone, design.coupling, design.condition, phi)
    except NotProved as error:
        return {"proof": "sampled", "proof_reason": str(error)}
    return {"proof": certificate.proof, "proof_reason": None}


def _damping(requirement: Requirement) -> tuple[float | None, ...]:
    return tuple(finite(b) for b in requirement.required)


def remembered(designer: _Designer, whole: bool) -> _Designer:
    """A designer that does not repeat a design; `whole` where the options matter to the design."""
    known: dict[tuple[str, Options | None], Limit] = {}

    def recalled(point: Point) -> Limit:
        key = (digest(point.loop), point.options if whole else None)
        if key not in known:
            known[key] = designer(point)
        return replace(known[key], value=point.value)

    return recalled


@dataclass(frozen=True)
class Sweep:
    """The designs along one axis of the loop."""

    label: str
    unit: str
    values: list[float]
    curves: dict[str, list[Limit]] = field(metadata={"json": "inlined"})  # by design


def limits(
    plan: Mapping[str, Sequence[Point]], beside: Sequence[ConditionName], progress: _Progress
) -> tuple[dict[str, Sweep], bool]:
    """The optimum at every point of a plan, beside it the spring-dampers by these conditions; what an interruption
    leaves, and whether there was one.
    """
    designers = {"optimal": remembered(optimum, True)}
    designers |= {name: remembered(spring_damper(name), False) for name in beside}
    sweeps = {
        name: Sweep(AXES[name].label, AXES[name].unit, [at.value for at in along], {kind: [] for kind in designers})
        for name, along in plan.items()
    }
    jobs = [(name, point, kind) for name, along in plan.items() for point in along for kind in designers]
    try:
        for done, (name, point, kind) in enumerate(jobs):
            progress(done, len(jobs))
            sweeps[name].curves[kind].append(designers[kind](point))
    except KeyboardInterrupt:
        return {name: sweep for name, sweep in sweeps.items() if any(sweep.curves.values())}, True
    return sweeps, False


def _spread(base: float, axis: _Axis, points: int, span: tuple[float, float] | None) -> Array:
    """`points` values, even in their logarithm; the nearest to `base` becomes `base`, if that lies between the ends."""
    low, high = span or (axis.low * base, axis.high * base)
    values = np.geomspace(low, high, points)
    if low <= base <= high:
        values[np.argmin(np.abs(np.log(values / base)))] = base
    return np.array([float(f"{v:.6g}") if v != base else base for v in values])


def _whole(low: float, high: float, points: int) -> Sequence[int]:
    if low != int(low) or high != int(high):
        raise ValueError(f"the range {low:g}:{high:g} is none, expected whole numbers of samples")
    return sorted({round(n) for n in np.linspace(low, high, points)})


def _delayed(loop: Loop, more: int) -> Loop:
    """`more` samples on every channel; Lambda keeps what it lacks of Theta Psi, as far as it can."""
    theta = tuple(t + more for t in loop.theta)
    return msgspec.structs.replace(loop, theta=theta, lam=_reference(loop, theta, loop.psi))


def _sampled(loop: Loop, T: float, kept: _Kept) -> Loop:
    """Another period. In seconds a delay is never shortened: it becomes the next whole number of samples."""
    if kept == "samples":
        return msgspec.structs.replace(loop, T=T)
    theta, psi = (tuple(math.ceil(n * loop.T / T - 1e-9) for n in delays) for delays in (loop.theta, loop.psi))
    return msgspec.structs.replace(loop, T=T, theta=theta, psi=psi, lam=_reference(loop, theta, psi))


def _reference(loop: Loop, theta: tuple[int, ...], psi: tuple[int, ...]) -> tuple[int, ...]:
    """Theta Psi where the reference is that, else what it was, but at most Theta Psi (7)."""
    full = [t + p for t, p in zip(loop.theta, loop.psi, strict=True)]
    new = [t + p for t, p in zip(theta, psi, strict=True)]
    return tuple(b if n == a else min(n, b) for n, a, b in zip(loop.lam, full, new, strict=True))


# ----------------------------------------------------------------------------------------------------
# Every design side by side: what it requires, how close it comes to the environment, and what proves it.


_PRINTED = {"I": "(27)", "II": "(28)"}  # the paper's equations for its gains


@dataclass(frozen=True)
class _Entry:
    """A design to be made: its name in the table, and the arguments of design.designs.design_by_kind."""

    name: str
    kind: str
    condition: ConditionName = "this-environment"
    options: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class LadderRow:
    """One line of the table."""

    design: str
    case: str
    required_damping: (
        tuple[float, ...] | None
    )  # by the this-environment condition [N s/m]; None where infinite or no design
    certified: bool  # by that condition
    condition: str  # what the proof is of
    relative_mismatch_db: float | None  # None: exact, or no design
    rms_mismatch_db: float | None
    proof: str | None
    wall_s: float  # of the design, with its check
    proof_s: float
    reason: str | None = None
    nearby: Nearby = off_table("inlined", Nearby())  # within ten percent of every spring and mass


SHORT = (
    _Entry("none", "none"),
    _Entry("published", "published"),
    _Entry("spring-damper, any-environment", "spring-damper", "any-environment"),
    _Entry("spring-damper, this-environment", "spring-damper"),
    _Entry("optimal", "optimal"),
    _Entry("bound for any linear coupling", "bound"),
)
_FULL = (
    *SHORT[:4],
    _Entry("ccl, one state per channel, any-environment", "ccl", "any-environment"),
    _Entry("optimal, one rung", "optimal", options={"ladder": LADDER[:1]}),
    _Entry("optimal, |F| <= 1.5 |E| above 100 Hz", "optimal", options={"high_gain": 1.5}),
    _Entry("optimal, sup", "optimal", options={"objective": "sup"}),
    *SHORT[4:],
)
LADDERS = {"short": SHORT, "full": _FULL}


def compare_designs(
    loops: Mapping[str, Loop], entries: Sequence[_Entry], progress: _Progress, judge_nearby: _NearbyOf
) -> Iterator[LadderRow]:
    """The rows of every case. What was designed for a case whose loop is the same is not designed again."""
    jobs = [(case, loop, entry) for case, loop in loops.items() for entry in entries]
    known: dict[tuple[str, str], LadderRow] = {}
    for done, (case, loop, entry) in enumerate(jobs):
        progress(done, len(jobs))
        same = digest(loop), _name(entry, case)
        if same not in known:
            known[same] = ladder_row(case, loop, entry, judge_nearby)
        yield replace(known[same], case=case)


def ladder_row(case: str, loop: Loop, entry: _Entry, judge_nearby: _NearbyOf) -> LadderRow:
    """One design with its proof; a request without a solution gives its reason."""
    begin = time.perf_counter()
    if entry.kind == "bound":
        return _bound_row(case, loop, entry)
    try:
        coupling, design = _made(loop, case, entry)
    except DesignFailed as error:
        wall = time.perf_counter() - begin
        return LadderRow(
            _name(entry, case), case, None, False, entry.condition, None, None, None, wall, 0.0, str(error)
        )
    wall = time.perf_counter() - begin
    F = loop.F(coupling)
    requirement = conditions.this_environment(F, loop)
    figures = transparency(F, loop.E(), loop.lam)
    begin, proof, reason = time.perf_counter(), None, requirement.reason
    held = design.certificate if design else None
    if held and held.condition == entry.condition and held.scenario == digest(loop, coupling.form()):
        proof = held.proof
    elif design or requirement.certified:
        try:
            phi = None if design is None or design.phi is None else design.phi.tolist()
            proof = prove(loop, coupling, entry.condition, phi).proof
        except NotProved as error:
            reason = str(error)
    required = None if requirement.reason else requirement.required
    mismatch = finite(decibels(figures.relative_mismatch)), finite(decibels(figures.rms_mismatch))
    proof_s, certified = time.perf_counter() - begin, requirement.certified
    place = _name(entry, case), case, required, certified, entry.condition
    return LadderRow(*place, *mismatch, proof, wall, proof_s, reason, judge_nearby(loop, coupling))


def _bound_row(case: str, loop: Loop, entry: _Entry) -> LadderRow:
    """What no linear coupling can be better than: no design, and of the rms mismatch only."""
    row = LadderRow(entry.name, case, None, False, entry.condition, None, None, None, 0.0, 0.0)
    if loop.channels > MOST:
        return replace(row, reason=NO_BOUND)
    found = bound(loop)
    return replace(row, rms_mismatch_db=finite(found.rms_db), wall_s=found.seconds)


def _name(entry: _Entry, case: str) -> str:
    return f"{entry.name} {_PRINTED[case]}" if entry.kind == "published" else entry.name


def _made(loop: Loop, case: str, entry: _Entry) -> tuple[Coupling, Design | None]:
    if entry.kind == "none":
        return NoCoupling(), None
    if entry.kind == "published":
        if loop.channels != 2:
            raise DesignFailed(None, (), f"the paper prints gains for 2 channels, not {loop.channels}")
        return PUBLISHED[case], None
    design = design_by_kind(loop, entry.kind, entry.condition, **entry.options)
    return design.coupling, design


_EXACT_DB = -60.0  # below it the difference to the environment is the solver's


def gains(plan: dict[str, list[Point]], sweeps: Mapping[str, Sweep], loop: Loop, options: Options) -> list[str]:
    """What there is to gain, in a line per sweep."""
    lines = []
    for name, sweep in sweeps.items():
        found = [(limit, _figure(limit, options.objective)) for limit in sweep.curves["optimal"]]
        known = [(limit, figure) for limit, figure in found if figure is not None]
        if len(known) < 2:
            continue
        here = next((s.value for s in plan[name] if s.loop == loop and s.options == options), None)
        words = [
            f"{printed_decibels(figure)} at {limit.value:.4g}" + (" (here)" if limit.value == here else "")
            for limit, figure in known
            if limit in (known[0][0], known[-1][0]) or limit.value == here
        ]
        lines.append(f"{name} in {AXES[name].unit}: {', '.join(words)}")
    bare = next((limit for sweep in sweeps.values() for limit in sweep.curves["optimal"] if _is(limit, loop)), None)
    needs = [b for b in bare.bare_damping if b is not None] if bare else []
    if len(needs) == len(loop.delta):
        need = ", ".join(f"{b:.4g}" for b in needs)
        share = max(b / d for b, d in zip(needs, loop.delta, strict=True))
        lines.append(f"without any coupling: needs {need} N s/m, {share:.3g} times what the devices have")
    return lines


def _is(limit: Limit, loop: Loop) -> bool:
    return (limit.delta, limit.theta, limit.T_s) == (loop.delta, loop.theta, loop.T)


def _figure(limit: Limit, objective: str) -> float | None:
    return limit.rms_mismatch_db if objective == "rms" else limit.relative_mismatch_db


def printed_decibels(value: float) -> str:
    """A mismatch in dB; one below the accuracy of a solver, where minus infinity is exact, is printed as such."""
    return f"below {_EXACT_DB:g} dB" if value < _EXACT_DB else f"{value:.2f} dB"


if __name__ == "__main__":
    from haptic_loop.cli.main import door

    door("compare")
