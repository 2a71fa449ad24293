"""Design couplings for random extreme loops: is each design proved, and how close is it to the bound?

    PYTHONPATH=. python tests/benchmarks/hostile_loops.py --count 20 --seed 1

A loop has one to three devices with dampings of .02 to 5 N s/m, theta of 0 to 16 samples, and psi of 0 to 2 samples.
The object has masses of 1 g to 100 kg, stiffnesses of .01 to 1e6 N/m, and dampings from none to critical.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from itertools import pairwise

import numpy as np

from haptic_loop.controller.environment import GROUND, Network, Spring
from haptic_loop.controller.loop import Loop
from haptic_loop.design.bound import bound
from haptic_loop.design.optimal import design


def hostile(rng: np.random.Generator) -> Loop:
    """Return a random loop; masses, stiffnesses and the devices' dampings are uniform in their logarithms."""

    def drawn(low: float, high: float) -> float:
        return float(f"{np.exp(rng.uniform(np.log(low), np.log(high))):.3g}")

    m = int(rng.integers(1, 4))
    names = "abc"[:m]
    inner = [f"n{i}" for i in range(int(rng.integers(0, 4)))]
    masses = {name: drawn(1e-3, 100.0) for name in inner}
    places = [*names, *inner, GROUND]

    def spring(one: str, other: str) -> Spring:
        stiffness = drawn(1e-2, 1e6)
        weight = min((masses[name] for name in (one, other) if name in masses), default=0.1)
        damping = rng.choice([0.0, 0.001, 0.02, 1.0]) * 2 * np.sqrt(stiffness * weight)
        return Spring((one, other), stiffness, float(f"{damping:.3g}"))

    chain = [*names[:1], *inner, *names[1:]] if len(names) + len(inner) > 1 else [names, GROUND]
    springs = [spring(one, other) for one, other in pairwise(chain)]
    for _ in range(int(rng.integers(0, 3))):
        one, other = rng.choice(len(places), 2, replace=False)
        springs.append(spring(places[one], places[other]))
    theta, psi = (tuple(int(v) for v in rng.integers(0, most + 1, m)) for most in (16, 2))
    late = tuple(t + p for t, p in zip(theta, psi, strict=True))
    delta = tuple(drawn(0.02, 5.0) for _ in range(m))
    period = float(rng.choice([5e-4, 1e-3, 2e-3]))
    return Loop(period, theta, psi, late, delta, Network(contacts=tuple(names), springs=tuple(springs), masses=masses))


def loops(count: int, seed: int) -> Iterator[tuple[int, Loop]]:
    for number in range(seed, seed + count):
        yield number, hostile(np.random.default_rng(number))


def main() -> None:
    """Print a line per loop; the exit code is 1 if a design is not proved."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--bound", action="store_true", help="compute the bound for any linear coupling, too")
    args, missed = parser.parse_args(), 0
    for number, loop in loops(args.count, args.seed):
        started = time.process_time()
        optimum = design(loop)
        seconds = time.process_time() - started
        reached = 20 * np.log10(max(optimum.figures.rms_mismatch, 1e-9))
        least = bound(loop).rms_db if args.bound else np.nan
        missed += not optimum.proved
        delays = f"{','.join(map(str, loop.theta))}/{','.join(map(str, loop.psi))}"
        kind, told = type(optimum.coupling).__name__, optimum.reason or "proved"
        figures = f"{reached:8.2f} dB, bound {least:8.2f}, rendered stiffness {optimum.g:.3f}"
        print(
            f"{number:5d} {delays:16s} {figures} {kind:13s} {optimum.states:4d} states {seconds:5.1f} s  {told}",
            flush=True,
        )
    raise SystemExit(missed > 0)


if __name__ == "__main__":
    main()
