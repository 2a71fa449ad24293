"""How good a coupling could be if the laboratory were another: the optimum along one axis of the loop or of the design.

Every point is a convex problem of its own (design.optimal), so what a curve shows is a limit, not what a search found.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import msgspec
import numpy as np

from controller.coupling import NoCoupling
from controller.lti import Array
from controller.process import force_map
from design.assess import specification
from design.certificate import NotProved, prove
from design.designs import design_coupling
from design.margin import Requirement, closed_loop
from design.parameter.wish import Wish
from design.promises import finite
from design.result import Design
from design.store import Condition, Loop, data_of, digest
from design.transparency import decibels, transparency

Kept = Literal["samples", "seconds"]  # what stays of a delay when the period changes


@dataclass(frozen=True)
class Axis:
    """What is varied: its label, its unit, and the range around what there is, unless another is asked for."""

    label: str
    unit: str
    low: float  # times what there is; nan where it is not a factor
    high: float
    least: float  # what may be asked for
    most: float


AXES = {
    "damping": Axis("damping of the devices (the least)", "N s/m", 0.5, 1.4, 1e-3, 1e3),
    "delay": Axis("transmission delay (the largest)", "samples", math.nan, math.nan, 0, 100),
    "period": Axis("sampling period", "s", 0.5, 2.5, 1e-5, 0.1),
    "order": Axis("basis functions of each entry of Q", "functions", 0.2, 1.6, 1, 200),
}


@dataclass(frozen=True)
class Setting:
    """One point of a curve: where it is drawn, and what is designed there."""

    value: float
    loop: Loop
    wish: Wish


def settings(
    axis: str, loop: Loop, wish: Wish, points: int, span: tuple[float, float] | None = None, kept: Kept = "samples"
) -> list[Setting]:
    """The points of one axis, with what there is among them. Raises ValueError for a range that is none.

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
            Setting(v, msgspec.structs.replace(loop, delta=tuple(v / least * d for d in loop.delta)), wish)
            for v in values.tolist()
        ]
    if axis == "delay":
        longest, shortest = max(loop.theta), min(loop.theta)
        low, high = span or (longest - min(shortest, points - 1), None)
        steps = range(int(low), int(low) + points) if high is None else _whole(low, high, points)
        if min(steps) < longest - shortest:
            raise ValueError(f"delay starts at {min(steps)}, but the channels differ by {longest - shortest} samples")
        return [Setting(float(n), _delayed(loop, n - longest), wish) for n in steps]
    if axis == "period":
        return [Setting(T, _sampled(loop, T, kept), wish) for T in _spread(loop.T, AXES[axis], points, span).tolist()]
    counts = {max(1, round(n)) for n in _spread(wish.functions, AXES[axis], points, span).tolist()}
    return [Setting(float(n), loop, replace(wish, functions=n)) for n in sorted(counts)]


@dataclass(frozen=True)
class Limit:
    """The best that was found at a point, or why there is nothing."""

    value: float
    delta: tuple[float, ...]  # [N s/m]
    theta: tuple[int, ...]  # [samples]
    T_s: float
    functions: int | None  # None for a spring-damper
    rms_mismatch_db: float | None
    relative_mismatch_db: float | None
    required_damping: tuple[float | None, ...] | None  # closed-loop, [N s/m]
    dc_ratio: float | None  # share of the static stiffness that is felt
    bare_damping: tuple[float | None, ...]  # what the loop without any coupling requires, closed-loop [N s/m]
    wall_s: float
    reason: str | None = None  # why there is no design
    proof: str | None = None  # of the condition it was designed for: "rational" (exact) or "sampled"; None: no design
    proof_reason: str | None = None  # why there is no exact proof


Designer = Callable[[Setting], Limit]


def optimum(setting: Setting) -> Limit:
    """The optimal coupling of a setting."""
    wish = setting.wish
    names = ("functions", "filter", "diagonal", "objective", "high_gain", "margin")
    return measured(setting, "optimal", None, {name: getattr(wish, name) for name in names})


def spring_damper(condition: Condition) -> Designer:
    """The designed spring-damper of a setting."""
    return lambda setting: measured(setting, "spring-damper", condition, {})


def measured(setting: Setting, kind: str, condition: Condition | None, options: dict[str, Any]) -> Limit:
    """One design and its figures, from the coupling alone; a request without a solution gives its reason."""
    loop, begin = setting.loop, time.perf_counter()
    figures: dict[str, Any] = dict.fromkeys(("rms_mismatch_db", "relative_mismatch_db", "required_damping", "dc_ratio"))
    bare: tuple[float | None, ...] = (None,) * len(loop.delta)
    try:
        spec = specification(loop)
        bare = _damping(closed_loop(force_map(spec.environment, NoCoupling(), loop.theta, loop.psi), loop.delta))
        design = design_coupling(spec, kind, condition, **options)
    except ValueError as error:  # no such design, or a loop that cannot be
        figures["reason"] = str(error)
    else:
        F = force_map(spec.environment, design.coupling, loop.theta, loop.psi)
        transparent = transparency(F, spec.environment, loop.lam)
        figures = {
            "rms_mismatch_db": finite(decibels(transparent.rms_mismatch)),
            "relative_mismatch_db": finite(decibels(transparent.relative_mismatch)),
            "required_damping": _damping(closed_loop(F, loop.delta)),
            "dc_ratio": finite(transparent.dc_ratio),
        } | _proof(loop, design)
    functions = setting.wish.functions if kind == "optimal" else None
    wall = time.perf_counter() - begin
    place = (setting.value, loop.delta, loop.theta, loop.T, functions)
    return Limit(*place, **figures, bare_damping=bare, wall_s=wall)


def _proof(loop: Loop, design: Design) -> dict[str, str | None]:
    """Whether the design's own condition was proved in exact arithmetic, and why not."""
    phi = None if design.phi is None else design.phi.tolist()
    # what is asked is the environment alone, as the figures are
    alone = loop.at(loop.environment)
    try:
        certificate = prove(alone, data_of(design.coupling), design.condition, phi)
    except NotProved as error:
        return {"proof": "sampled", "proof_reason": str(error)}
    return {"proof": certificate.proof, "proof_reason": None}


def _damping(requirement: Requirement) -> tuple[float | None, ...]:
    return tuple(finite(b) for b in requirement.required)


def remembered(designer: Designer, whole: bool) -> Designer:
    """The same, but what was designed once is not designed again; `whole` if the wish matters to it."""
    known: dict[tuple[str, Wish | None], Limit] = {}

    def recalled(setting: Setting) -> Limit:
        key = (digest(setting.loop), setting.wish if whole else None)
        if key not in known:
            known[key] = designer(setting)
        return replace(known[key], value=setting.value)

    return recalled


def _spread(base: float, axis: Axis, points: int, span: tuple[float, float] | None) -> Array:
    """`points` values, even in their logarithm; the nearest to what there is becomes that, if it lies between."""
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


def _sampled(loop: Loop, T: float, kept: Kept) -> Loop:
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
