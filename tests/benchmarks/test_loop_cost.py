"""What the limiter costs while no force is limited, and how fast the exact engine is; test_engine_cost.py has the rest.

make bench    (or: python -m pytest tests/benchmarks --benchmark-only -s)
"""

import time
from functools import partial

import numpy as np
import pytest
from msgspec.structs import replace

from haptic_loop.controller.complementarity import BoxProblem
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
    print(f"\nexact: {simulation.scenario.duration / median:.0f} x real time, the reference for errors")
    assert simulation.scenario.samples == 12500


@pytest.mark.parametrize("engine", ["exact", "mujoco"])
def test_the_limiter_costs_little_below_its_limits(benchmark, engine, monkeypatch):
    """The loop with the limiter beside the one that clips, in turns: the ratio of their least times. No tick asks for
    the box problem, and only those do whose forces are limited.
    """
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
    assert len(solved) - slips in (0, 1)  # the slip of the last tick is in no record
