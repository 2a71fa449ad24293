"""Measure the cost of the limiter below and at its limits, and the speed of the exact engine.

make bench    (or: python -m pytest tests/benchmarks --benchmark-only -s)
"""

import time
from functools import partial

import numpy as np
import pytest
from msgspec.structs import replace

from haptic_loop.controller.complementarity import BallProblem, BoxProblem, magnitudes
from haptic_loop.controller.coupling import PUBLISHED, SpringDamper
from haptic_loop.sim.run import assemble, run
from haptic_loop.sim.scenario import load

pytestmark = pytest.mark.benchmark(group="loop")


def seconds(call) -> float:
    begin = time.thread_time()
    call()
    return time.thread_time() - begin


def test_exact_engine(benchmark):
    simulation = assemble(load(), PUBLISHED["I"])
    benchmark.pedantic(lambda: run(simulation, "exact"), rounds=9, iterations=1, warmup_rounds=1)
    median = benchmark.stats.stats.median if benchmark.stats else float("nan")
    print(f"\nexact: {simulation.scenario.duration / median:.0f} x as fast as real time")
    assert simulation.scenario.samples == 12500


@pytest.mark.parametrize("engine", ["exact", "mujoco"])
def test_the_limiter_costs_little_below_its_limits(benchmark, engine, monkeypatch):
    """The limiter solves a box problem only in ticks whose forces it limits; compare its time with that of clipping."""
    coupling, solved, solve = SpringDamper((5832.0, 2545.0), (0.187, 1.386)), [], BoxProblem.solve
    monkeypatch.setattr(BoxProblem, "solve", lambda problem, q: [solved.append(1), solve(problem, q)][1])
    limited, clipped = (assemble(load(), coupling, lag) for lag in ((11.4167, 11.4167), None))
    times = []

    def once():
        times.append([seconds(partial(run, loop, engine)) for loop in (limited, clipped)])

    benchmark.pedantic(once, rounds=15, iterations=1, warmup_rounds=1)
    ratio = np.divide(*np.min(times, axis=0))
    print(f"\n{engine}: limited / clipped {ratio:.2f} (least of {len(times)} each), {len(solved)} box problems")
    assert not solved
    scenario = load()
    weak = scenario.replace(device=tuple(replace(device, force_limit=0.5) for device in scenario.device))
    tight = assemble(weak, coupling, (11.4167, 11.4167))
    slips = tight.process.law.slips(run(tight, engine).z).any(axis=1).sum()
    assert slips > 0
    assert len(solved) - slips in (0, 1)  # the record lacks the slip of the last tick


@pytest.mark.parametrize("devices", [1, 2, 8])
def test_limiting_vectors(benchmark, devices):
    """The solution f + M v = q, with forces f within the limits, is exact to rounding; a column of q is one tick."""
    rng, n, balls = np.random.default_rng(devices), 3 * devices, (3,) * devices
    root, skew = rng.normal(size=(n, n)), rng.normal(size=(n, n))
    M = 30 * (root @ root.T + np.eye(n) + skew - skew.T)
    problem, q = BallProblem(M, np.full(n, 12.0), balls), 60 * rng.normal(size=(n, 300))
    columns = [q[:, k : k + 1] for k in range(q.shape[1])]
    solved = benchmark.pedantic(lambda: [problem.solve(column) for column in columns], rounds=3, warmup_rounds=1)
    v, f = (np.hstack(parts) for parts in zip(*solved, strict=True))
    wrong = np.abs(f + M @ v - q).max() / 12.0
    median = benchmark.stats.stats.median if benchmark.stats else float("nan")
    print(
        f"\n{devices} x 3 axes at their limits: {1e6 * median / 300:.0f} us a tick, residual {wrong:.1e} of the limit"
    )
    assert problem.unsolved == [0]
    assert (magnitudes(f, balls) <= 12 * (1 + 1e-14)).all()
    assert wrong < 1e-11  # rounding of the terms of M v, which are up to 1e3 times the limit
