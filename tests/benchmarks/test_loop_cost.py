"""What the limiter costs while no force is limited, and how fast the exact engine is; test_engine_cost.py has the rest.

make bench    (or: python -m pytest tests/benchmarks --benchmark-only -s)
"""

import time

import numpy as np
import pytest

from controller.coupling import SpringDamper
from design.result import CASE_I
from sim.run import assemble, run
from sim.scenario import load

pytestmark = pytest.mark.benchmark(group="loop")


def seconds(call) -> float:
    begin = time.perf_counter()
    call()
    return time.perf_counter() - begin


def test_exact_engine(benchmark):
    assembly = assemble(load(), CASE_I)
    benchmark.pedantic(lambda: run(assembly, "exact"), rounds=9, iterations=1, warmup_rounds=1)
    median = benchmark.stats.stats.median if benchmark.stats else float("nan")
    print(f"\nexact: {assembly.scenario.duration / median:.0f} x real time, the reference for errors")
    assert assembly.scenario.samples == 12500


@pytest.mark.parametrize("engine", ["exact", "mujoco"])
def test_what_the_limiter_costs_while_no_force_is_limited(benchmark, engine):
    """The loop with the limiter beside the one that clips, in turns: median ratio of their times."""
    coupling, ratios = SpringDamper((5832.0, 2545.0), (0.187, 1.386)), []
    limited, clipped = (assemble(load(), coupling, lag) for lag in ((11.4167, 11.4167), None))

    def once():
        ratios.append(seconds(lambda: run(limited, engine)) / seconds(lambda: run(clipped, engine)))

    benchmark.pedantic(once, rounds=9, iterations=1, warmup_rounds=1)
    print(f"\n{engine}: limited / clipped {np.median(ratios):.2f} (median of {len(ratios)})")
    assert not run(limited, "exact").clipped(limited.process.force_limit).any()
