"""Numerically hard loops. Each has an integrator setting that holds and, except in one loop, a setting that fails.

The rule is `default_substeps`, which picks the substeps of an integrator.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache

import numpy as np

from haptic_loop.controller.coupling import PUBLISHED, Coupling, SpringDamper
from haptic_loop.models.device import CompliantDevice
from haptic_loop.models.human import Human, Link
from haptic_loop.sim.accuracy import _check_substeps, default_substeps, position_error, simulated_growth
from haptic_loop.sim.run import Simulation, assemble, make_engine, run
from haptic_loop.sim.scenario import InputError, Scenario, load
from haptic_loop.sim.stability import exact_growth

CLOSE = 1e-2  # [1/s] largest error of the growth rate with the substeps that the rule picks
#: a setting holds if the integrator is stable with it, its verdict is the exact one, and both errors are at most these
GROWTH, POSITION = 1e-3, 1e-3  # [1/s]; relative rms of the device positions over the run
RK4, _EULER = ("RK4", 1), ("Euler", 1)
_TRIED = tuple((name, 1) for name in ("RK4", "Euler", "implicitfast"))

_Setting = tuple[str, int]  # integrator, substeps


@dataclass(frozen=True)
class _Hard:
    """A loop that is hard to integrate."""

    name: str
    scenario: Scenario
    fails: _Setting | None  # a setting that does not hold; None if all of _TRIED hold
    how: str  # the fault of `fails`: "refused", "verdict", "growth" or "position"
    coupling: Coupling = PUBLISHED["I"]
    substeps: int | None = None  # RK4 substeps that hold; None: those that the rule picks


@dataclass(frozen=True)
class _Row:
    """The measurements of a hard loop."""

    name: str
    exact: float  # [1/s] growth of the exact loop
    fails: _Setting | None
    fault: str | None  # the fault of `fails`, or None
    off: float | None  # error of `fails`; None if it has no fault or was refused
    rule: int  # RK4 substeps that the rule picks
    substeps: int  # RK4 substeps that hold
    error: float  # [1/s] growth rate with `substeps` minus the exact one
    #: whether `fails` has the expected fault, `substeps` hold (and exceed `rule` only if stated), and the growth rate
    #: with `rule` has the right sign and an error of at most CLOSE
    holds: bool


@cache
def nominal() -> Scenario:
    """Return the default scenario for one second; the hard loops are variants of it."""
    return load().replace(duration=1.0)


def devices(**changes: float) -> Scenario:
    return nominal().replace(device=(CompliantDevice(**changes),) * 2)


def hands(mass: float, damping: float, stiffness: float) -> Scenario:
    return nominal().replace(human=(Human((Link(mass, damping, stiffness),)),) * 2)


def light(damping: float) -> Scenario:
    """Return the nominal loop with handles of 1 g and hands without mass."""
    return devices(handle_mass=1e-3).replace(human=(Human((Link(0.0, damping, 200.0),)),) * 2)


def cases() -> tuple[_Hard, ...]:
    return (
        _Hard("human stiffness 1e5 N/m", hands(0.3, 3.0, 1e5), RK4, "position"),
        _Hard("handle of 1 g, human damping 3 N s/m", light(3.0), RK4, "refused"),
        _Hard("handle of 1 g, no human damping", light(0.0), RK4, "refused", substeps=48),
        _Hard("motor 1 g", devices(motor_mass=1e-3), RK4, "refused"),
        _Hard("motor 100 kg", devices(motor_mass=100.0), _EULER, "growth"),
        _Hard("human damping 1000 N s/m", hands(0.3, 1000.0, 200.0), _EULER, "position"),
        _Hard("transmission 1e6 N/m", devices(transmission_stiffness=1e6), RK4, "refused"),
        _Hard("T = 4 ms", nominal().replace(T=4e-3), _EULER, "refused"),
        _Hard("T = 10 us", nominal().replace(T=1e-5, duration=0.05), None, "none tried fails"),
        _Hard("50-sample delays", nominal().replace(theta=(50, 50)), _EULER, "growth"),
        _Hard("zero damping", nominal().replace(delta=(0.0, 0.0)), _EULER, "growth"),
        _Hard("coupling 1e5 N/m", nominal(), _EULER, "verdict", SpringDamper(np.full(2, 1e5), np.zeros(2))),
    )


def faults(loop: Simulation, integrator: str, substeps: int) -> dict[str, float]:
    """Return fault -> error of a setting; empty if the setting holds."""
    try:
        _check_substeps(loop, integrator, substeps)
    except InputError:
        return {"refused": np.inf}
    exact, own = exact_growth(loop), simulated_growth(loop, integrator, substeps)
    error = position_error(run(loop, make_engine(loop, "mujoco", integrator, substeps)), run(loop, "exact"), loop)
    errors = {"verdict": own - exact} if (own > 0) != (exact > 0) else {}
    if abs(own - exact) > GROWTH:
        errors["growth"] = own - exact
    if (apart := error.position_relative_rms) is not None and apart > POSITION:
        errors["position"] = apart
    return errors


def hard_loops(seed: int) -> Iterator[_Row]:
    """Yield the measurements of all hard loops; the seed has no effect."""
    return map(measure, cases())


def measure(hard: _Hard) -> _Row:
    """Compare failing and holding settings with the exact loop. Raises InputError if the rule finds no substeps."""
    loop = assemble(hard.scenario, hard.coupling)
    rule, exact = default_substeps(loop, "RK4"), exact_growth(loop)
    substeps = hard.substeps or rule
    bad = faults(loop, *hard.fails) if hard.fails else {}
    off = bad.get(hard.how)
    chosen = simulated_growth(loop, "RK4", rule)
    right = (
        (off is not None if hard.fails else not any(faults(loop, *setting) for setting in _TRIED)),
        not faults(loop, "RK4", substeps),
        (chosen > 0) == (exact > 0) and abs(chosen - exact) <= CLOSE,
        (rule < substeps) == (hard.substeps is not None),
    )
    return _Row(
        hard.name,
        exact,
        hard.fails,
        hard.how if off is not None else None,
        off if off is not None and np.isfinite(off) else None,
        rule,
        substeps,
        simulated_growth(loop, "RK4", substeps) - exact,
        all(right),
    )
