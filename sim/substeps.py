"""How many substeps a plant asks of an integrator, and which numbers of them are refused.

Two speeds decide, both from the eigenvalues of the continuous plant: the fastest weakly damped mode, which must be
resolved (mode h <= 0.2), and the strongest damping, which must be followed (rate h < 1). What the rule picks is
then checked: the loop that the engine simulates must have the exact loop's verdict, else the number is doubled.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from controller.lti import Array
from models.scene import plant
from sim.one_period import exact_growth, measured_hold, simulated_growth
from sim.scenario import InputError
from sim.simulate import Assembly

RESOLVED, FOLLOWED = 0.2, 1.0  # what a step may advance the fastest mode [rad] and the strongest damping
LEAST, MOST = 4, 10_000  # substeps
DECIDED = 1e-3  # [1/s] exact growth rates nearer to zero than this are no verdict to get wrong
NEUTRAL = 1e-6  # a passive plant's free motion has eigenvalues at 1, which rounding splits by about 1e-8

_MODE_LOST = "it damps fast modes away"


@dataclass(frozen=True)
class Pace:
    """How fast a plant moves."""

    mode: float  # [rad/s] its fastest weakly damped mode, 0 where there is none
    rate: float  # [1/s] its strongest damping

    def within(self, h: float) -> bool:
        """Whether a step of h seconds follows it."""
        return self.mode * h <= RESOLVED and self.rate * h < FOLLOWED

    def substeps(self, T: float) -> int:
        """The least number of steps in T seconds that follows it, LEAST at least."""
        return max(LEAST, math.ceil(self.mode * T / RESOLVED), math.floor(self.rate * T / FOLLOWED) + 1)

    def hardest(self, h: float) -> str:
        """What a step of h seconds has most trouble with, in words."""
        if self.mode / RESOLVED >= self.rate / FOLLOWED:
            return f"the mode at {self.mode / (2 * math.pi):.4g} Hz advances {self.mode * h:.3g} rad in a step"
        return f"the damping of {self.rate:.4g} 1/s times the step is {self.rate * h:.3g}"


def pace(A: Array) -> Pace:
    """The pace of x' = A x, or the fastest of many. Weakly damped is what turns faster than it decays."""
    values = np.linalg.eigvals(A)
    weak = np.abs(values.imag) > np.abs(values.real)
    return Pace(float(np.abs(values[weak]).max(initial=0.0)), float(-values.real.min(initial=0.0)))


def default_substeps(assembly: Assembly, integrator: str = "RK4") -> int:
    """At least 4, more where the rule or the verdict asks. Raises InputError where no number up to 10000 does."""
    if integrator == "discrete":  # it remembers more than position and velocity, so no map of those can vouch for it
        raise InputError(f"--integrator discrete gives no verdict to rely on: {_MODE_LOST}; use RK4 or give --substeps")
    assembly = assembly.smooth
    speed, T = pace(plant(assembly.scene.model).A), assembly.scenario.T
    count = needed = speed.substeps(T)
    while count <= MOST and not _agrees(assembly, integrator, count):
        count *= 2
    if needed > MOST:
        raise InputError(f"{speed.hardest(T / MOST)} even with {MOST} substeps: use --engine exact")
    if count > MOST:
        raise InputError(f"--integrator {integrator} gives a wrong verdict up to {MOST} substeps: use --integrator RK4")
    return count


def check_substeps(assembly: Assembly, integrator: str, substeps: int) -> list[str]:
    """Remarks on a number of substeps that was asked for. Raises InputError outside the stable region."""
    assembly = assembly.smooth
    speed, h = pace(plant(assembly.scene.model).A), assembly.scenario.T / substeps
    radius = step_radius(assembly, integrator, substeps)
    what = f"{integrator} x {substeps}: {speed.hardest(h)}"
    if not radius <= 1 + NEUTRAL:
        instead = _instead(assembly, integrator)
        raise InputError(f"--substeps {substeps}: {what}, outside the stable region of {integrator}; {instead}")
    remarks = [] if speed.within(h) else [f"{what}: stable but coarse; {_instead(assembly, integrator)}."]
    if integrator == "discrete":
        remarks.append(f"discrete gives no verdict to rely on: {_MODE_LOST}.")
    elif not _agrees(assembly, integrator, substeps):
        simulated, exact = simulated_growth(assembly, integrator, substeps), exact_growth(assembly)
        growth = f"{simulated:+.3g} 1/s, the exact loop {exact:+.3g} 1/s"
        remarks.append(f"{integrator} x {substeps} gives a WRONG VERDICT: its loop grows by {growth}.")
    return remarks


def step_radius(assembly: Assembly, integrator: str, substeps: int) -> float:
    """Spectral radius of one substep on the plant alone, which is passive: above 1 the integrator is unstable."""
    step = measured_hold(assembly, "mujoco", integrator, 1, assembly.scenario.T / substeps)
    return float(np.abs(np.linalg.eigvals(step.A)).max()) if np.isfinite(step.A).all() else np.inf


def _agrees(assembly: Assembly, integrator: str, substeps: int) -> bool:
    if step_radius(assembly, integrator, substeps) > 1 + NEUTRAL:
        return False
    exact = exact_growth(assembly)
    return abs(exact) <= DECIDED or (simulated_growth(assembly, integrator, substeps) > 0) == (exact > 0)


def _instead(assembly: Assembly, integrator: str) -> str:
    try:
        return f"use --substeps {default_substeps(assembly, integrator)} or leave it out"
    except InputError:
        return "use --engine exact"
