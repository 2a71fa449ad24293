"""What an engine itself does in one period, as matrices: its own discretisation of the plant."""

from __future__ import annotations

import numpy as np

from controller.contact import State
from controller.process import Tape
from sim.exact_engine import HeldPlant
from sim.mujoco_engine import quiet_warnings
from sim.simulate import Assembly, make_engine
from sim.stability import Mode, close, dominant_mode

#: basis states and inputs are this long: the plant is linear, and no actuator limit is so small
UNIT = 1e-6


def measured_hold(
    assembly: Assembly, engine: str = "mujoco", integrator: str = "RK4", substeps: int = 4, T: float | None = None
) -> HeldPlant:
    """The map s[k+1] = A s[k] + B [w; f][k] of an engine, from stepping every basis state and input once.

    Closed with the force map it gives the growth rate that this engine simulates, without a trace. `T` [s] is
    the scenario's period where it is not given.
    """
    period = assembly.scenario.T if T is None else T
    stepped = make_engine(assembly, engine, integrator, substeps, period)
    states, inputs = assembly.plant.B.shape
    tape = Tape(assembly.process, 1, states, inputs - assembly.process.channels)
    columns = []
    with quiet_warnings():
        for unit in UNIT * np.eye(states + inputs):
            tape.plant_row[0][:, 0] = unit
            stepped.start(tape)
            stepped.advance(0)
            columns.append(tape.plant_state[1][:, 0] / UNIT)
    step = np.stack(columns, axis=1)
    return HeldPlant(step[:, :states], step[:, states:], assembly.plant.C, period)


def simulated_growth(assembly: Assembly, integrator: str, substeps: int) -> float:
    """The growth rate [1/s] of the loop that MuJoCo simulates with these settings; of walls, in the worst state."""
    held = measured_hold(assembly, "mujoco", integrator, substeps)
    return max(dominant_mode(close(held, F)).growth for F in assembly.process.frozen().values())


def exact_growth(assembly: Assembly) -> float:
    """The growth rate [1/s] of the exact loop; where there are walls, in the worst frozen contact state."""
    return worst_mode(assembly).growth


def worst_mode(assembly: Assembly) -> Mode:
    """The dominant mode of the exact loop; where there are walls, of the worst frozen contact state."""
    return max(frozen_modes(assembly).values(), key=lambda mode: mode.spectral_radius)


def frozen_modes(assembly: Assembly) -> dict[State, Mode]:
    """The dominant mode of the exact loop for every set of walls that touch."""
    return {walls: dominant_mode(close(assembly.plant, F)) for walls, F in assembly.process.frozen().items()}
