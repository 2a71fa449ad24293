"""Which integrator and how many substeps a plant asks for, and what an engine itself does in one period.

On a smooth scene the exponential integrator is exact with one step. Of MuJoCo's own ones two speeds decide, both from
the eigenvalues of the continuous plant: the fastest weakly damped mode, which must be resolved (mode h <= 0.2), and
the strongest damping, which must be followed (rate h < 1). What the rule picks is then checked: the loop that the
engine simulates must have the exact loop's verdict, else the number is doubled. Where an error is asked for, runs
decide: see sim.accuracy.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from controller.lti import Array
from controller.tick import StepBuffer
from models.hold import HeldPlant
from sim.engines import EXPONENTIAL, LEAST, default_integrator, quiet_warnings
from sim.run import AnyEngine, Simulation, engine_name, make_engine
from sim.scenario import InputError
from sim.stability import close, disagree, dominant_mode, exact_growth

_RESOLVED, _FOLLOWED = 0.2, 1.0  # what a step may advance the fastest mode [rad] and the strongest damping
MOST = 10_000  # substeps
_MODE_LOST = "it damps fast modes away"
NEUTRAL = 1e-6  # a passive plant's free motion has eigenvalues at 1, which rounding splits by about 1e-8
#: basis states and inputs are this long: the plant is linear, and no actuator limit is so small
_UNIT = 1e-6


@dataclass(frozen=True)
class _PlantSpeed:
    """How fast a plant moves."""

    mode: float  # [rad/s] its fastest weakly damped mode, 0 where there is none
    rate: float  # [1/s] its strongest damping

    def within(self, h: float) -> bool:
        """Whether a step of h seconds follows it."""
        return self.mode * h <= _RESOLVED and self.rate * h < _FOLLOWED

    def substeps(self, T: float) -> int:
        """The least number of steps in T seconds that follows it, LEAST at least."""
        return max(LEAST, math.ceil(self.mode * T / _RESOLVED), math.floor(self.rate * T / _FOLLOWED) + 1)

    def hardest(self, h: float) -> str:
        """What a step of h seconds has most trouble with, in words."""
        if self.mode / _RESOLVED >= self.rate / _FOLLOWED:
            return f"the mode at {self.mode / (2 * math.pi):.4g} Hz advances {self.mode * h:.3g} rad in a step"
        return f"the damping of {self.rate:.4g} 1/s times the step is {self.rate * h:.3g}"


def pace(A: Array) -> _PlantSpeed:
    """The pace of x' = A x, or the fastest of many. Weakly damped is what turns faster than it decays."""
    values = np.linalg.eigvals(A)
    weak = np.abs(values.imag) > np.abs(values.real)
    return _PlantSpeed(float(np.abs(values[weak]).max(initial=0.0)), float(-values.real.min(initial=0.0)))


def settle(
    simulation: Simulation, engine: AnyEngine, integrator: str | None = None, substeps: int | None = None
) -> tuple[str | None, int | None, list[str]]:
    """(integrator, substeps, remarks) of a run for which some were asked; without any but for MuJoCo.

    Raises InputError where they cannot be had.
    """
    if engine != "mujoco":
        for name, asked in (("integrator", integrator), ("substeps", substeps)):
            if asked is not None:
                raise InputError(f"--{name} with --engine {engine_name(engine)}: it is MuJoCo's; leave it out")
        if engine == "exact" and simulation.friction:
            raise InputError(
                "--engine exact is linear and has no Coulomb friction, the devices have; use --engine mujoco"
            )
        return None, None, []
    integrator = integrator or default_integrator(simulation.scene)
    if substeps is None and integrator != EXPONENTIAL:
        return integrator, default_substeps(simulation, integrator), []
    substeps = default_substeps(simulation, integrator) if substeps is None else substeps
    return integrator, substeps, check_substeps(simulation, integrator, substeps)


def default_substeps(simulation: Simulation, integrator: str = "RK4") -> int:
    """1 of the exponential integrator on a smooth scene, else 4 at least and more where the rule or the verdict asks.

    Raises InputError where no number up to 10000 does.
    """
    if integrator == EXPONENTIAL and default_integrator(simulation.scene) == EXPONENTIAL:
        return 1
    if integrator == "discrete":  # it remembers more than position and velocity, so no map of those can vouch for it
        raise InputError(f"--integrator discrete gives no verdict to rely on: {_MODE_LOST}; use RK4 or give --substeps")
    simulation = simulation.smooth.even
    speed, T = pace(simulation.scene.plant.A), simulation.scenario.T
    count = needed = speed.substeps(T)
    while count <= MOST and not _agrees(simulation, integrator, count):
        count *= 2
    if needed > MOST:
        raise InputError(f"{speed.hardest(T / MOST)} even with {MOST} substeps: use --engine exact")
    if count > MOST:
        raise InputError(f"--integrator {integrator} gives a wrong verdict up to {MOST} substeps: use --integrator RK4")
    return count


def check_substeps(simulation: Simulation, integrator: str, substeps: int) -> list[str]:
    """Remarks on a number of substeps that was asked for. Raises InputError outside the stable region."""
    if integrator == EXPONENTIAL:
        nearer = "of first order where devices rub, RK4 is nearer at equal cost (--cross-check: by how much)."
        rubs = default_integrator(simulation.scene) != EXPONENTIAL
        return [f"{integrator} x {substeps}: {nearer}"] if rubs else []
    simulation = simulation.smooth.even
    speed, h = pace(simulation.scene.plant.A), simulation.scenario.T / substeps
    radius = step_radius(simulation, integrator, substeps)
    what = f"{integrator} x {substeps}: {speed.hardest(h)}"
    if not radius <= 1 + NEUTRAL:
        instead = _instead(simulation, integrator)
        raise InputError(f"--substeps {substeps}: {what}, outside the stable region of {integrator}; {instead}")
    remarks = [] if speed.within(h) else [f"{what}: stable but coarse; {_instead(simulation, integrator)}."]
    if integrator == "discrete":
        remarks.append(f"discrete gives no verdict to rely on: {_MODE_LOST}.")
    elif not _agrees(simulation, integrator, substeps):
        simulated, exact = simulated_growth(simulation, integrator, substeps), exact_growth(simulation)
        growth = f"{simulated:+.3g} 1/s, the exact loop {exact:+.3g} 1/s"
        remarks.append(f"{integrator} x {substeps} gives a WRONG VERDICT: its loop grows by {growth}.")
    return remarks


def step_radius(simulation: Simulation, integrator: str, substeps: int) -> float:
    """Spectral radius of one substep on the plant alone, which is passive: above 1 the integrator is unstable."""
    step = measured_hold(simulation, "mujoco", integrator, 1, simulation.scenario.T / substeps)
    return float(np.abs(np.linalg.eigvals(step.A)).max()) if np.isfinite(step.A).all() else np.inf


def _agrees(simulation: Simulation, integrator: str, substeps: int) -> bool:
    if step_radius(simulation, integrator, substeps) > 1 + NEUTRAL:
        return False
    return not disagree(exact_growth(simulation), simulated_growth(simulation, integrator, substeps))


def _instead(simulation: Simulation, integrator: str) -> str:
    try:
        return f"use --substeps {default_substeps(simulation, integrator)} or leave it out"
    except InputError:
        return "use --engine exact"


def measured_hold(
    simulation: Simulation,
    engine: AnyEngine = "mujoco",
    integrator: str | None = None,
    substeps: int | None = None,
    T: float | None = None,
) -> HeldPlant:
    """The map s[k+1] = A s[k] + B [w; f][k] of an engine, from stepping every basis state and input once.

    Closed with the force map it gives the growth rate that this engine simulates, without a trace. `T` [s] is
    the scenario's period where it is not given.
    """
    period, simulation = simulation.scenario.T if T is None else T, simulation.even
    stepped = make_engine(simulation, engine, integrator, substeps, period)
    states, inputs = simulation.plant.B.shape
    buffer = StepBuffer(simulation.process, 1, states, inputs - simulation.process.channels)
    columns = []
    with quiet_warnings():
        for unit in _UNIT * np.eye(states + inputs):
            buffer.plant_row[0][:, 0] = unit
            stepped.start(buffer)
            stepped.advance(0)
            columns.append(buffer.plant_state[1][:, 0] / _UNIT)
    step = np.stack(columns, axis=1)
    return HeldPlant(step[:, :states], step[:, states:], simulation.plant.C, period)


def simulated_growth(
    simulation: Simulation, integrator: str | None, substeps: int | None, engine: AnyEngine = "mujoco"
) -> float:
    """The growth rate [1/s] of the loop that an engine simulates with these settings; of walls, in the worst state."""
    held = measured_hold(simulation, engine, integrator, substeps)
    return max(float(dominant_mode(close(held, F)).growth) for F in simulation.process.law.frozen().values())
