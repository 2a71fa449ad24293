"""Passivity layers of a simulated controller: the energy budget, and the shell around a user's own environment.

    figures = run(netted(simulation, EnergyNet(0.01)), "exact").net.figures()

The code calls a passivity layer a net. With a net, the linear block of a tick does not contain the delays Theta. The
budget scales the forces of G = (I + Psi E V)^-1 Psi E, after these are limited as in the actuators. The shell replaces
these forces by those of the user's environment. Budget and shell send their forces through a delay line, even if the
delays are constant.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Protocol

import numpy as np

from haptic_loop.controller.budget import (
    EPS,
    BudgetFigures,
    EnergyBudget,
    Packets,
    Shell,
    ShellFigures,
)
from haptic_loop.controller.delay import LOST, Ticks, ages
from haptic_loop.controller.law import Limiter
from haptic_loop.controller.lti import Array
from haptic_loop.controller.tick import Net, Process
from haptic_loop.design.assessment import Assessment
from haptic_loop.design.environments import ANY_ENVIRONMENT
from haptic_loop.design.result import Requirement
from haptic_loop.sim.run import Simulation
from haptic_loop.sim.scenario import InputError, require_latch_at_ticks

_HELD = 4  # number of ticks beyond the largest delay for which a device holds a force if packets are lost


@dataclass(frozen=True)
class EnergyNet:
    """The settings of an energy budget for a run."""

    start: float  # W0 [J]
    cap: float = np.inf  # largest stored energy [J]
    guarantee: str | None = None  # the guarantee of this run in words, or the reason why there is none

    def net(self, simulation: Simulation, process: Process, nsim: int) -> Net:
        """Return a new budget for `nsim` runs. Raises InputError for impossible numbers."""
        assert process.delays is not None
        loop, lost = simulation.loop, bool((process.delays == LOST).any())
        hold, span = _HELD if lost else 0, loop.delays
        # A device dissipates at least delta |dx|^2 / T in a tick. This bound is smallest for the longest T.
        packets, longest = Packets(span.lo, span.hi, hold), loop.T_max or loop.T
        settings: dict[str, Any] = {"start": self.start, "cap": self.cap, "nsim": nsim}
        settings["encoder_step"] = process.encoder_step
        try:
            budget = EnergyBudget(loop.Delta() if loop.levels else loop.delta, longest, packets, **settings)
        except ValueError as error:
            raise InputError(f"energy budget: {error}") from None
        late = ages(process.delays) if lost else None
        return _Budgeted(budget, self.guarantee, process, late, np.array(span.hi) + hold)


@dataclass(frozen=True, eq=False)
class Plugged:
    """A user's function in place of the environment, behind the coupling and a shell that makes it passive."""

    force: Callable[[Array], Array]  # positions (m,) [m] that the port has without force -> forces (m,) [N]
    start: float = 0.0  # W0 [J]
    guarantee: str | None = None  # the guarantee of this run in words, or the reason why there is none

    def net(self, simulation: Simulation, process: Process, nsim: int) -> Net:
        """Return a new shell for `nsim` runs. Raises ValueError if no shell fits the loop, or if `start` is wrong."""
        V = simulation.coupling.compliance(simulation.loop.T)
        if V is None:
            raise ValueError("your own environment needs a coupling with a compliance V")
        if (process.encoder_step > 0).any():
            raise ValueError("your own environment needs ideal encoders: no shell is known for encoder steps")
        return _Shelled(Shell(V, start=self.start, nsim=nsim), self, process)


def claim(assessment: Assessment) -> str:
    """Return the guarantee of a run with a net in words, or the reason why there is none."""
    if assessment.guarantee is None:
        return f"no guarantee: {assessment.reason}"
    behind = "behind a coupling certified for any environment, " if callable(assessment.environment) else ""
    return f"{behind}{assessment.guarantee.words}"


class Wanted(Protocol):
    """The settings of a net: EnergyNet, Plugged, sim.world.Touched, or a user's own class."""

    def net(self, simulation: Simulation, process: Process, nsim: int) -> Net:
        """Return a new net for `nsim` runs that are simulated together."""
        ...


def netted(simulation: Simulation, wanted: Wanted, ticks: int | None = None) -> Simulation:
    """Return the loop with a net between controller and devices, for runs of up to `ticks` (default: the scenario's).

    For linear analyses, such as certificates and modes, use the simulation without a net. Raises InputError if forces
    have a latency, and the errors of `wanted.net` if its settings are impossible.
    """
    scenario, process = simulation.scenario, simulation.process
    require_latch_at_ticks(scenario)
    if process.delays is None:
        samples = scenario.samples if ticks is None else ticks
        constant = np.broadcast_to(np.array(scenario.theta)[None, :, None], (samples, process.channels, 1))
        process = replace(process, delays=constant)
    make = partial(wanted.net, simulation, process)
    make(1)  # Impossible settings raise their error here, before the simulation begins.
    return replace(simulation, process=replace(process, net=make))


def idle(simulation: Simulation, requirements: Mapping[str, Requirement], budget: BudgetFigures) -> str | None:
    """Return the reason why the budget never acts in this run from rest, or None if it may act."""
    scenario, law = simulation.scenario, simulation.process.law
    free = isinstance(law, Limiter) and not law.rho.any()  # A limiter with rho = 0 keeps the environment passive.
    if (
        budget.cap_J is not None
        or ((simulation.process.force_limit < np.inf).any() and not free)
        or any(scenario.psi)
        or scenario.switches
        or (simulation.process.encoder_step > 0).any()
        or any(wall.gap < 0 for wall in scenario.environment.walls)  # A wall that is pressed at rest stores energy.
    ):
        return None
    # The budget counts only the devices' damping, as any-environment does. Other conditions count more.
    needs = requirements[ANY_ENVIRONMENT.name]
    if not needs.ratio <= 1 - EPS:
        return None
    return f"it never acts from rest: any-environment requires at most {100 * (1 - EPS):g} % of the devices' damping"


class _Budgeted:
    """An energy budget for forces within the actuators' limits, and devices that drop a force that is too old."""

    def __init__(
        self, budget: EnergyBudget, guarantee: str | None, process: Process, late: Ticks | None, oldest: Array
    ) -> None:
        self._budget, self._guarantee, self._late, self._oldest = budget, guarantee, late, oldest[:, None]
        self._within, self._dropped = process.applied, 0
        self._x: Array | None = None  # positions [m] at the tick before
        self._acted: Array | None = None  # forces [N] that acted since that tick

    def send(self, x: Array, force: Array, /) -> None:
        moved = np.zeros_like(x) if self._x is None else x - self._x
        self._x = x.copy()
        force[...] = self._budget.limit(self._within(force), moved, self._acted)

    def apply(self, k: int, force: Array, /) -> None:
        if self._late is not None:
            gone = np.broadcast_to(self._late[k] > self._oldest, force.shape)
            self._dropped += int(gone.any())
            force[gone] = 0.0
        self._acted = force.copy()

    def figures(self) -> BudgetFigures:
        return replace(self._budget.figures(self._guarantee), dropped_ticks=self._dropped)


def _answer(forces: Any, channels: int) -> Array:
    """Return the forces [N] of a user's function. Raises InputError unless each channel has one finite force."""
    try:
        answer = np.empty(0) if np.iscomplexobj(forces) else np.asarray(forces, dtype=float)
    except (TypeError, ValueError):
        answer = np.empty(0)
    if answer.shape != (channels,) or not np.isfinite(answer).all():
        text = " ".join(repr(forces).split())
        expected = f"an array of {channels} finite forces [N], shape ({channels},)"
        shape = f", shape {forces.shape}" if isinstance(forces, np.ndarray) else ""
        raise InputError(f"environment returned {text[:60]}{shape}, expected {expected}")
    return answer


class _Shelled:
    """A user's own environment behind a shell, with forces within the actuators' limits."""

    def __init__(self, shell: Shell, plugged: Plugged, process: Process) -> None:
        self._shell, self._plugged, self._within = shell, plugged, process.applied

    def send(self, x: Array, force: Array, /) -> None:
        free = self._shell.free(x)
        wanted = np.stack([_answer(self._plugged.force(u), len(free)) for u in free.T], axis=1)
        force[...], _ = self._shell.limit(self._within(wanted))

    def apply(self, k: int, force: Array, /) -> None:
        pass

    def figures(self) -> ShellFigures:
        return self._shell.figures(self._plugged.guarantee)
