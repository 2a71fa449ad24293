"""Energy budgets and the classics beside certified couplings, on the same runs: the tables of docs/energy-budget.md.

PYTHONPATH=. python tests/benchmarks/baselines.py [--seconds 8] [--eps 0.05] [--start 0] [--cap inf]     (half a minute)

The default scenario, case I, with the exact plant and its force limits. Columns:

    error     rms of the force applied less that of Lambda E for the true displacements, over the latter [%]
    > 40 Hz   rms of the applied force above 40 Hz [N]
    peak      the largest applied force [N]
    acted     share of the ticks in which the net acted [%]
              all four: with ideal encoders / with encoders of 10 um, while the users move
    hands     how many of 100 random pairs of lossless hands, started at 0.1 m/s and left alone, move faster than that
              in the last second of ten; and the largest speed of a device or hand among them then [m/s]
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator

import msgspec
import numpy as np

from haptic_loop import design_coupling
from haptic_loop.controller.budget import EnergyBounding, EnergyBudget, Packets, PassivityControl, Shell
from haptic_loop.controller.coupling import Coupling, NoCoupling, SpringDamper
from haptic_loop.controller.delay import delay
from haptic_loop.controller.environment import Networks, environment
from haptic_loop.controller.lti import Array, Lti
from haptic_loop.models.hold import HeldPlant, hold
from haptic_loop.models.scene import Crowd, variants
from haptic_loop.sim.run import assemble, outside_forces
from haptic_loop.sim.scenario import Scenario, load

STEP = 1e-5  # [m] of the encoders
SLOW = 0.1  # [m/s] with which hands are started
Limit = Callable[[Array, Array], Array]  # wanted (m, nsim), dx (m, nsim) -> force
Net = Callable[[int, float], Limit]  # a fresh one for so many simulations, with encoders of that step [m]


def pass_on(wanted: Array, dx: Array) -> Array:
    return wanted


def linear(F: Lti, nsim: int) -> Callable[[Array], Array]:
    """The forces of F, not yet delayed, tick by tick."""
    z = np.zeros((F.order, nsim))

    def force(x: Array) -> Array:
        nonlocal z
        out = F.C @ z + F.D @ x
        z = F.A @ z + F.B @ x
        return out

    return force


def shelled(E: Lti, V: Lti, nsim: int) -> Callable[[Array], Array]:
    """The same for E behind the coupling V with the shell between them."""
    shell, z, solve = Shell(V, nsim=nsim), np.zeros((E.order, nsim)), np.linalg.inv(np.eye(2) + E.D @ V.D)

    def force(x: Array) -> Array:
        nonlocal z
        out, u = shell.limit(solve @ (E.C @ z + E.D @ shell.free(x)))
        z = E.A @ z + E.B @ u
        return out

    return force


def close(
    plant: HeldPlant,
    force: Callable[[Array], Array],
    theta: tuple[int, ...],
    nets: tuple[Limit, Limit],
    w: Array,
    start: Array,
    limit: float,
    step: float = 0.0,
) -> tuple[Array, Array, Array]:
    """Displacements and applied forces (N, m, nsim), largest speeds (N, nsim); nets before and behind the delays."""
    m, (states, nsim) = len(theta), start.shape
    s, line, seen = start.copy(), np.zeros((max(theta) + 1, m, nsim)), None
    xs, fs, vs = [], [], []
    A, B = (np.broadcast_to(a, (nsim, *a.shape[-2:])) for a in (plant.A, plant.B))
    for outside in w:
        x = s[:m].copy()
        before, seen = seen, np.round(x / step) * step if step else x
        dx = np.zeros_like(x) if before is None else seen - before
        leaving = nets[0](np.clip(force(seen), -limit, limit), dx)
        line = np.concatenate([leaving[None], line[:-1]])
        f = np.clip(nets[1](np.stack([line[n, i] for i, n in enumerate(theta)]), dx), -limit, limit)
        xs.append(x), fs.append(f), vs.append(np.abs(s[states // 2 :]).max(axis=0))
        u = np.vstack([np.tile(outside[:, None], nsim), f])
        s = np.einsum("nij,jn->in", A, s) + np.einsum("nij,jn->in", B, u)
    return np.array(xs), np.array(fs), np.array(vs)


def lossless(scenario: Scenario, nsim: int) -> HeldPlant:
    """The devices in the hands of random lossless ladders: one mass and spring each, or two."""
    rng, m = np.random.default_rng(1), scenario.channels
    mass, stiffness = (np.exp(rng.uniform(*np.log(r), (nsim, m, 2))) for r in ((0.01, 3.0), (1.0, 1e4)))
    links = np.stack([mass, np.zeros_like(mass), stiffness], axis=-1)
    return hold(variants(scenario.device, Crowd(links)).plants(), scenario.T)


def keep_moving(scenario: Scenario, force: Callable[[int], Callable[[Array], Array]], nets: tuple[Net, Net]) -> str:
    """The column `hands`."""
    plants, nsim = lossless(scenario, 100), 100
    states = plants.A.shape[-1]
    start = np.zeros((states, nsim))
    start[states // 2 :] = SLOW * np.random.default_rng(2).choice([-1.0, 1.0], (1, nsim))
    ticks = round(10 / scenario.T)
    w = np.zeros((ticks, plants.B.shape[-1] - scenario.channels))
    made = (nets[0](nsim, 0.0), nets[1](nsim, 0.0))
    _, _, speed = close(plants, force(nsim), scenario.theta, made, w, start, scenario.device[0].force_limit)
    late = speed[-round(1 / scenario.T) :].max(axis=0)
    return f"{(late > SLOW).sum():4d} {late.max():8.3f}"


def rms(a: Array) -> float:
    return float(np.sqrt(np.mean(a**2)))


def fast(f: Array, T: float) -> float:
    """rms of what is above 40 Hz."""
    spectrum = np.fft.rfft(f, axis=0)
    spectrum[np.fft.rfftfreq(len(f), T) < 40] = 0
    return rms(np.fft.irfft(spectrum, len(f), axis=0))


def moved(scenario: Scenario, F: Lti, nets: tuple[Net, Net], seconds: float) -> Iterator[tuple[float, ...]]:
    """Error, high-frequency force, peak and acted, for either encoder."""
    simulation = assemble(scenario, NoCoupling())
    w = outside_forces(scenario, simulation.scene, 0, round(seconds / scenario.T))
    start = np.zeros((simulation.plant.A.shape[0], 1))
    for step in (0.0, STEP):
        made = (nets[0](1, step), nets[1](1, step))
        limit = scenario.device[0].force_limit
        x, f, _ = close(simulation.plant, linear(F, 1), scenario.theta, made, w, start, limit, step)
        felt = linear(delay(scenario.loop("I").lam, scenario.T) @ environment(scenario.environment, scenario.T), 1)
        ideal = np.array([felt(row) for row in x])
        acted = [net.__self__.limited[0] / len(w) for net in made if hasattr(net, "__self__")]
        yield 100 * rms(f - ideal) / rms(ideal), fast(f, scenario.T), np.abs(f).max(), 100 * max(acted, default=0.0)


def main() -> None:
    parser = argparse.ArgumentParser()
    for name, value in (("seconds", 8.0), ("start", 0.0), ("cap", np.inf)):
        parser.add_argument(f"--{name}", type=float, default=value)
    args = parser.parse_args()
    scenario = load()
    T, delta, theta, network = scenario.T, scenario.delta, scenario.theta, scenario.environment
    given = {"start": args.start, "cap": args.cap}

    def none(nsim: int, step: float) -> Limit:
        return pass_on

    def observer(**options: object) -> tuple[Net, Net]:
        return none, lambda n, step: PassivityControl(2, T, nsim=n, **options).limit

    def budget(nsim: int, step: float) -> Limit:
        return EnergyBudget(delta, T, Packets(theta), nsim=nsim, encoder_step=step, **given).limit

    nets = {
        "clipped": (none, none),
        "PO/PC at each device": observer(),
        "PO/PC at each device, with delta": observer(delta=delta),
        "energy bounding": (lambda n, step: EnergyBounding(delta, T, nsim=n).limit, none),
        "energy budget": (budget, none),
    }
    made: dict[str, Coupling] = {}
    for name, kind, condition in (
        ("spring-damper, any environment", "spring-damper", "any-environment"),
        ("spring-damper, this environment", "spring-damper", "this-environment"),
        ("optimal, this environment", "optimal", "this-environment"),
    ):
        made[name] = design_coupling(scenario.loop("I"), kind, condition).coupling
    E, late = environment(network, T), delay(scenario.psi, T)

    print(f"{'no coupling':36}{'error %':>14}{'> 40 Hz N':>14}{'peak N':>12}{'acted %':>12}{'hands':>16}")

    def row(name: str, F: Lti, nets: tuple[Net, Net]) -> None:
        layout = (2, 3, 1, 0), (14, 14, 12, 12)  # digits and widths
        cells = np.array(list(moved(scenario, F, nets, args.seconds))).T
        texts = (f"{a:.{d}f}/{b:.{d}f}".rjust(width) for (a, b), d, width in zip(cells, *layout, strict=True))
        print(f"{name:36}{''.join(texts)}{keep_moving(scenario, lambda n: linear(F, n), nets):>16}", flush=True)

    for name, pair in nets.items():
        row(name, NoCoupling().around(late @ E), pair)
    for name, coupling in made.items():
        row(name, coupling.around(late @ E), nets["clipped"])

    springs = tuple(msgspec.structs.replace(s, stiffness=2.5 * s.stiffness) for s in network.springs)
    hard = environment(msgspec.structs.replace(network, springs=springs), T)
    print("\nthe optimal coupling on springs 2.5 times stiffer: it needs 5.04 N s/m of 1.37")
    F = made["optimal, this environment"].around(late @ hard)
    for name, pair in nets.items():
        print(f"{name:88}{keep_moving(scenario, lambda n, F=F: linear(F, n), pair):>16}", flush=True)

    print("\na mass with -4 N s/m behind the spring-damper for any environment")
    M, D, K = network.matrices()
    D[2, 2] -= 4.0
    active, spring_damper = Networks(network.contacts, (M, D, K)).E(T), made["spring-damper, any environment"]
    assert isinstance(spring_damper, SpringDamper)
    V = spring_damper.compliance(T)
    for name, force in (
        ("clipped", lambda n: linear(active.feedback(V), n)),
        ("shell", lambda n: shelled(active, V, n)),
    ):
        print(f"{name:88}{keep_moving(scenario, force, nets['clipped']):>16}", flush=True)


if __name__ == "__main__":
    main()
