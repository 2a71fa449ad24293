"""Stable or not, for many sets of humans at once: from the exact closed loop, and from MuJoCo's own period map."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from controller.lti import Array, Lti
from controller.process import Process, Tape
from models.crowd import Variants
from sim.exact_engine import HeldPlant, hold
from sim.mujoco_engine import MujocoBatchEngine, profiler_off, quiet_warnings
from sim.stability import MARGINAL, ClosedLoop, close

DECIDED = 1e-3  # growth rates below this [1/s] are too close to zero for engines to disagree about


@dataclass(frozen=True, eq=False)
class Modes:
    """The dominant eigenvalue of each loop."""

    eigenvalue: NDArray[np.complex128]  # (nsim,)
    T: float  # [s]

    @property
    def spectral_radius(self) -> Array:
        return np.abs(self.eigenvalue)

    @property
    def growth(self) -> Array:
        """log|lambda| / T [1/s]"""
        with np.errstate(divide="ignore"):
            return np.log(self.spectral_radius) / self.T

    @property
    def frequency_hz(self) -> Array:
        return np.abs(np.angle(self.eigenvalue)) / (2 * np.pi * self.T)


def dominant_modes(loops: ClosedLoop) -> Modes:
    """The eigenvalue of the largest modulus of every loop; stability.dominant_mode for a stack."""
    values = np.linalg.eigvals(loops.A)
    largest = np.argmax(np.abs(values), axis=1)
    return Modes(values[np.arange(values.shape[0]), largest].astype(complex), loops.T)


def exact_loops(variants: Variants, F: Lti) -> ClosedLoop:
    """The exact closed loop with every set of humans, stacked."""
    return close(hold(variants.plants(), F.T), F)


def mujoco_loops(
    variants: Variants, process: Process, integrator: str = "RK4", substeps: int = 4, nthread: int = 0
) -> ClosedLoop:
    """The closed loops that MuJoCo itself simulates: its map over one period, joined with the process block.

    The plant is linear, so its map is known from one period from each basis state and with each force alone:
    2n + m simulations for every set of humans, stepped in one batch.
    """
    model = variants.scene.model
    n, m, nsim = 2 * model.nv, process.channels, len(variants)
    # within the actuators' limits, so that these do not clip
    unit = np.concatenate([np.ones(n), np.minimum(1.0, process.force_limit / 2)])
    tape = Tape(process, 1, n, variants.scene.outside, nsim * (n + m))
    basis = np.tile(np.diag(unit), (1, nsim))
    tape.s[0], tape.f[0] = basis[:n], basis[n:]
    with profiler_off(), quiet_warnings():
        fields = variants.repeated(n + m)
        engine = MujocoBatchEngine(variants.scene, process.F.T, integrator, substeps, nsim * (n + m), nthread, fields)
        engine.start(tape)
        engine.advance(0)
    columns = tape.s[1].reshape(n, nsim, n + m).transpose(1, 0, 2) / unit
    held = HeldPlant(columns[:, :, :n], columns[:, :, n:], np.eye(m, n), process.F.T)
    return close(held, process.F)


def unstable(growth: Array) -> NDArray[np.bool_]:
    """Whether each growth rate [1/s] counts as unstable: stability.verdict for an array."""
    return ~(growth <= MARGINAL)


def disagree(exact: Array, other: Array) -> NDArray[np.bool_]:
    """Where two growth rates [1/s] have opposite signs though the exact one is clearly not zero."""
    return (unstable(exact) != unstable(other)) & (np.abs(exact) > DECIDED) & np.isfinite(other)
