"""Count how often the bound of hw.identify exceeds the true damping of random simulated devices.

PYTHONPATH=. python tests/benchmarks/bound_coverage.py --cases 120     (some minutes; continue with --first 120)

Every case draws a device from its own seed; every fourth is compliant, the others are rigid. Mass is 0.1 to 0.5 kg,
viscous friction 0.3 to 2 N s/m, Coulomb friction 0 to 0.05 N (0 in a fifth of the cases). Encoder steps are 1 to 20 um
with a random origin; half of the cases have white noise of 0.2 or 0.4 steps. The excitation is that of hw.identify
without its swing, and without the long cosine that follows the swing.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass

import msgspec
import numpy as np

from haptic_loop.hw.emulator import nobody
from haptic_loop.hw.identify import Estimate, chirp, identify
from haptic_loop.models.device import RigidDevice
from haptic_loop.sim.scenario import load
from tests.sessions import RubbingPlant

FORCE_STEP = 4e-4  # [N] force step of the simulated device
NOISE = (0.0, 0.0, 0.2, 0.4)  # [encoder steps]


@dataclass(frozen=True)
class Case:
    """A device, its encoder, and the duration of a sweep."""

    seed: int
    rigid: bool
    mass: float  # [kg]
    motor: float  # the motor's share of the mass of a compliant device
    stiffness: float  # [N/m] of the transmission
    viscous: float  # [N s/m]
    coulomb: float  # [N]
    step: float  # [m]
    noise: float  # [steps]
    seconds: float = 2.5  # duration of each of the three sweeps


def case(seed: int) -> Case:
    """Return the random case of a seed."""
    draw = np.random.default_rng(seed)
    return Case(
        seed,
        rigid=seed % 4 != 3,
        mass=draw.uniform(0.1, 0.5),
        motor=draw.uniform(0.2, 0.5),
        stiffness=draw.uniform(8e3, 25e3),
        viscous=float(np.exp(draw.uniform(np.log(0.3), np.log(2.0)))),
        coulomb=draw.choice([0.0, *draw.uniform(0.0, 0.05, 4)]),
        step=float(np.exp(draw.uniform(np.log(1e-6), np.log(2e-5)))),
        noise=draw.choice(NOISE),
    )


def estimated(c: Case) -> Estimate:
    """Return the estimate from a simulated record. Raises ValueError if there is none."""
    base, draw = load("omega-pair"), np.random.default_rng((c.seed, 1))
    if c.rigid:
        device = RigidDevice(mass=c.mass, damping=c.viscous)
    else:
        masses = {"motor_mass": c.motor * c.mass, "handle_mass": (1 - c.motor) * c.mass}
        device = msgspec.structs.replace(
            base.device[0], damping=c.viscous, delta=None, transmission_stiffness=c.stiffness, **masses
        )
    scenario = nobody(base.replace(device=(device,) * base.channels))
    plant = RubbingPlant(scenario, np.full(base.channels, c.step), c.coulomb)
    signal = chirp(base.channels, base.T, 1, 1.0, (3.0, 200.0), c.seconds).signal
    late = np.vstack([np.zeros(base.channels), signal[:-1]])
    applied = -FORCE_STEP * np.round(late / FORCE_STEP)  # The device feels -f.
    x, origin = [], draw.uniform()
    for force in applied:
        x.append(c.step * np.round(plant.s[0] / c.step + origin + c.noise * draw.standard_normal()))
        plant.advance(-force)
    return identify(np.array(x), applied[:, 0], base.T, c.step, c.rigid)


def judged(seed: int) -> tuple[Case, Estimate | str, float]:
    """Return the case, its estimate or the error message, and the wall time [s]."""
    c, begin = case(seed), time.perf_counter()
    try:
        estimate: Estimate | str = estimated(c)
    except ValueError as error:
        estimate = str(error)
    return c, estimate, time.perf_counter() - begin


def report(results: Iterable[tuple[Case, Estimate | str, float]]) -> None:
    excess, scaled, none, longest = [], [], 0, 0.0
    for c, estimate, seconds in results:
        longest = max(longest, seconds)
        kind = "rigid" if c.rigid else "compliant"
        what = f"{c.seed:4d} {kind:9s} {c.mass:.3f} kg, {c.viscous:.3f} N s/m, {c.coulomb:.4f} N, {1e6 * c.step:.1f} um"
        if isinstance(estimate, str):
            none += 1
            print(f"{what}, noise {c.noise}: no bound: {estimate}", flush=True)
            continue
        excess.append(100 * (estimate.delta / c.viscous - 1))
        scaled.append((estimate.viscous - c.viscous) / estimate.friction.errors["viscous"])
        off = 100 * (estimate.viscous / c.viscous - 1)
        print(f"{what}, noise {c.noise}: viscous {off:+.3f} %, bound {excess[-1]:+.3f} %, {seconds:.1f} s", flush=True)
    over = sum(e > 0 for e in excess)
    print(f"{len(excess)} bounds, {over} above the truth; no bound in {none} cases; bound minus truth:")
    print(f"largest {max(excess):+.3f} %, median {np.median(excess):+.2f} %, least {min(excess):+.2f} %")
    print(f"errors over standard errors: mean {np.mean(scaled):+.2f}, deviation {np.std(scaled):.2f}")
    print(f"longest case {longest:.1f} s")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=120)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--workers", type=int, default=2)
    args = parser.parse_args()
    with ProcessPoolExecutor(args.workers) as pool:
        report(pool.map(judged, range(args.first, args.first + args.cases)))


if __name__ == "__main__":
    main()
