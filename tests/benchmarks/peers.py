"""Run the same loop in other tools: position error, growth error, verdict and CPU time.

PYTHONPATH=. python tests/benchmarks/peers.py [--duration 15] [--rounds 3]     (pip install drake control)

Every tool simulates the default scenario with the published coupling of case I. Process, plant and external forces are
the same; so are the force limits, except in scipy.signal. The tools alternate, and the median of a tool's CPU times
counts. Growth is measured on the tool's trace, projected on the exact loop's dominant mode. `ratio` is the CPU time
over that of "exponential x 1".

Drake simulates a MultibodyPlant of prismatic joints; bushings replace the tendons between two bodies. The process runs
outside Drake and sets generalised forces at each tick, because Drake is slow with controllers in Python. python-control
simulates the sampled plant as a nonlinear discrete system, because linear systems cannot clip. scipy.signal simulates
the closed loop without clipping.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import numpy as np

from haptic_loop.controller.coupling import PUBLISHED
from haptic_loop.controller.lti import Array
from haptic_loop.models.scene import _actuation, _tendon_jacobian
from haptic_loop.sim.engines import EXPONENTIAL
from haptic_loop.sim.run import Simulation, assemble, make_engine, outside_forces, run
from haptic_loop.sim.scenario import load
from haptic_loop.sim.stability import MARGINAL, _measured_growth, close, dominant_mode
from haptic_loop.sim.trace import Trace

States = tuple[Array, Array, Array]  # process states (N, order), plant states (N, 2n), forces (N, m)
Peer = Callable[[Simulation, Array], States]  # runs from rest under external forces (N, outside)


def ours(engine: str, integrator: str | None = None, substeps: int | None = None) -> Peer:
    """Return one of this package's engines as a peer."""

    def peer(simulation: Simulation, w: Array) -> States:
        stepped = make_engine(simulation, engine, integrator, substeps)
        trace = run(simulation, stepped, lambda first, n: w[first : first + n], len(w))
        return trace.z, trace.s, trace.f

    return peer


def numpy_loop(simulation: Simulation, w: Array) -> States:
    """Run the loop with the sampled plant, in the simplest way."""
    F, plant, limit = simulation.F, simulation.plant, simulation.process.force_limit
    z, s = np.zeros(F.order), np.zeros(plant.A.shape[0])
    zs, ss, fs = [], [], []
    for pushed in w:
        x = plant.C @ s
        f = F.C @ z + F.D @ x
        f = np.clip(f, -limit, limit)
        zs.append(z)
        ss.append(s)
        fs.append(f)
        z = F.A @ z + F.B @ x
        s = plant.A @ s + plant.B @ np.concatenate([pushed, f])
    return np.array(zs), np.array(ss), np.array(fs)


def scipy_dlsim(simulation: Simulation, w: Array) -> States:
    """Run the closed loop, without force limits, in scipy.signal.dlsim."""
    from scipy.signal import dlsim, dlti

    F, plant = simulation.F, simulation.plant
    loop = close(plant, F)
    n, states = loop.A.shape[0], plant.A.shape[0]
    _, _, xi = dlsim(dlti(loop.A, loop.B, np.eye(n), np.zeros((n, w.shape[1])), dt=loop.T), w)
    s, z = xi[:, :states], xi[:, states:]
    return z, s, z @ F.C.T + s @ (F.D @ plant.C).T


def python_control(simulation: Simulation, w: Array) -> States:
    """Run the loop as a nonlinear discrete system in control.input_output_response."""
    import control

    F, plant, limit = simulation.F, simulation.plant, simulation.process.force_limit
    states = plant.A.shape[0]

    def force(xi):
        return np.clip(F.C @ xi[states:] + F.D @ (plant.C @ xi[:states]), -limit, limit)

    def update(t, xi, u, params):
        s, z = xi[:states], xi[states:]
        return np.concatenate([plant.A @ s + plant.B @ np.concatenate([u, force(xi)]), F.A @ z + F.B @ (plant.C @ s)])

    n = states + F.order
    loop = control.nlsys(update, lambda t, xi, u, params: xi, inputs=w.shape[1], outputs=n, states=n, dt=plant.T)
    xi = control.input_output_response(loop, plant.T * np.arange(len(w)), w.T, np.zeros(n)).outputs.T
    return xi[:, states:], xi[:, :states], np.array([force(row) for row in xi])


def drake(step: str, substeps: int) -> Peer:
    """Return pydrake's MultibodyPlant as a peer, with fixed Runge-Kutta steps ("RK3") or in "discrete" time."""

    def peer(simulation: Simulation, w: Array) -> States:
        from pydrake.systems.analysis import ResetIntegratorFromFlags, Simulator

        T, model, F = simulation.scenario.T, simulation.scene.model, simulation.F
        plant = _drake_plant(simulation, T / substeps if step == "discrete" else 0.0)
        simulator = Simulator(plant)
        context = simulator.get_mutable_context()
        if step == "RK3":
            integrator = ResetIntegratorFromFlags(simulator, "runge_kutta3", T / substeps)
            integrator.set_fixed_step_mode(True)
        held = plant.get_applied_generalized_force_input_port().FixValue(context, np.zeros(model.nv))
        simulator.Initialize()
        forces, limit, m = _actuation(model), simulation.process.force_limit, F.outputs
        z, s = np.zeros(F.order), np.zeros(2 * model.nv)
        zs, ss, fs = [], [], []
        for k, pushed in enumerate(w):
            x = s[:m]
            f = np.clip(F.C @ z + F.D @ x, -limit, limit)
            zs.append(z)
            ss.append(s)
            fs.append(f)
            z = F.A @ z + F.B @ x
            held.GetMutableData().get_mutable_value().SetFromVector(forces @ np.concatenate([pushed, f]))
            simulator.AdvanceTo((k + 1) * T)
            s = np.array(plant.GetPositionsAndVelocities(context))
        return np.array(zs), np.array(ss), np.array(fs)

    return peer


def _drake_plant(simulation: Simulation, time_step: float):
    """Return the compiled scene as bodies on prismatic joints along x, with a bushing for each tendon."""
    from pydrake.multibody.plant import MultibodyPlant
    from pydrake.multibody.tree import LinearBushingRollPitchYaw, PrismaticJoint, PrismaticSpring, SpatialInertia

    model = simulation.scene.model
    plant, bodies = MultibodyPlant(time_step), []
    plant.mutable_gravity_field().set_gravity_vector([0, 0, 0])
    world, stiffness = plant.world_frame(), np.ravel(model.jnt_stiffness)
    for j, damping in enumerate(np.ravel(model.dof_damping)):
        mass = float(model.body_mass[model.jnt_bodyid[j]])
        bodies.append(plant.AddRigidBody(f"mass_{j}", SpatialInertia.SolidSphereWithMass(mass, 0.02)))
        frame = bodies[-1].body_frame()
        joint = plant.AddJoint(PrismaticJoint(f"joint_{j}", world, frame, [1, 0, 0], damping=float(damping)))
        if stiffness[j]:
            plant.AddForceElement(PrismaticSpring(joint, 0.0, float(stiffness[j])))
    tendons = zip(_tendon_jacobian(model), model.tendon_stiffness, model.tendon_damping, strict=True)
    for across, spring, damper in tendons:
        a, b = (bodies[int(np.flatnonzero(across == sign)[0])].body_frame() for sign in (-1.0, 1.0))
        along = [np.array([float(np.ravel(value)[0]), 0.0, 0.0]) for value in (spring, damper)]
        plant.AddForceElement(LinearBushingRollPitchYaw(a, b, np.zeros(3), np.zeros(3), *along))
    plant.Finalize()
    return plant


PEERS: dict[str, Peer] = {
    "exact": ours("exact"),
    "exponential x 1": ours("mujoco", EXPONENTIAL, 1),
    "RK4 x 4": ours("mujoco", "RK4", 4),
    "Drake, RK3 x 4": drake("RK3", 4),
    "Drake, discrete x 12": drake("discrete", 12),
    "python-control, nonlinear": python_control,
    "scipy dlsim, no limits": scipy_dlsim,
    "a plain NumPy loop": numpy_loop,
}


def main() -> None:
    parser = argparse.ArgumentParser(description="Run the same loop in other tools.")
    parser.add_argument("--duration", type=float, default=15.0, metavar="SECONDS")
    parser.add_argument("--rounds", type=int, default=3, metavar="N")
    args = parser.parse_args()
    simulation = assemble(load().replace(duration=args.duration), PUBLISHED["I"])
    scenario, m = simulation.scenario, simulation.scene.channels
    w = outside_forces(scenario, simulation.scene, 0, scenario.samples)
    used, traces, missing = {name: [] for name in PEERS}, {}, {}
    for _ in range(args.rounds):
        for name, peer in PEERS.items():
            if name in missing:
                continue
            begin = time.process_time()
            try:
                traces[name] = peer(simulation, w)
            except ImportError as error:
                missing[name] = error
            used[name].append(time.process_time() - begin)

    loop = close(simulation.plant, simulation.F)
    mode, exact = dominant_mode(loop), traces["exact"][1]
    ratio = np.median(used["exponential x 1"])
    print(f"{scenario.name}, case I, {args.duration:g} s; exact growth {mode.growth:+.6f} 1/s")
    print(f"{'tool':<27}{'position error':>16}{'growth error':>14}{'verdict':>9}{'CPU ms':>9}{'ratio':>8}")
    for name in traces:
        z, s, f = traces[name]
        t, x, unknown = loop.T * np.arange(len(s)), s[:, :m], np.full_like(f, np.nan)
        trace = Trace(t, x, f, unknown, unknown, w, z=z, s=s)
        error = np.sqrt(np.mean((s[:, :m] - exact[:, :m]) ** 2) / np.mean(exact[:, :m] ** 2))
        growth, _ = _measured_growth(loop, trace, simulation.process.force_limit)
        right = (growth > MARGINAL) == (mode.growth > MARGINAL)
        cost = np.median(used[name])
        print(
            f"{name:<27}{error:>16.1e}{growth - mode.growth:>+14.1e}{'right' if right else 'WRONG':>9}"
            f"{1e3 * cost:>9.0f}{cost / ratio:>8.1f}"
        )
    for name, error in missing.items():
        print(f"{name:<27}not measured: {error}")


if __name__ == "__main__":
    main()
