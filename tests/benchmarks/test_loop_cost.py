"""What the loop costs beside the raw mj_step calls it makes, and how accurate those are.

make bench    (or: python -m pytest tests/benchmarks --benchmark-only -s)
"""

import time

import mujoco
import numpy as np
import pytest

from design.result import CASE_I
from sim.engines import discretised, profiler_off
from sim.run import assemble, make_engine, run
from sim.scenario import load

pytestmark = pytest.mark.benchmark(group="loop")


def seconds(call) -> float:
    begin = time.perf_counter()
    call()
    return time.perf_counter() - begin


def raw_steps(assembly, integrator: str, substeps: int, ticks: int) -> None:
    model = discretised(assembly.scene, assembly.scenario.T, integrator, substeps)
    data, step = mujoco.MjData(model), mujoco.mj_step
    with profiler_off():
        for _ in range(ticks):
            step(model, data, substeps)


@pytest.mark.parametrize(("integrator", "substeps"), [("RK4", 4), ("RK4", 2), ("Euler", 12)])
def test_loop_over_raw_stepping(benchmark, integrator, substeps):
    """Alternates both in one run and prints the median ratio; asserts only what does not depend on the clock."""
    assembly = assemble(load(), CASE_I)
    exact = run(assembly, "exact")
    ratios, loops = [], []

    def once():
        raw = seconds(lambda: raw_steps(assembly, integrator, substeps, assembly.scenario.samples))
        loops.append(seconds(lambda: run(assembly, make_engine(assembly, "mujoco", integrator, substeps))))
        ratios.append(loops[-1] / raw)

    benchmark.pedantic(once, rounds=9, iterations=1, warmup_rounds=1)
    record = run(assembly, make_engine(assembly, "mujoco", integrator, substeps))
    error = np.sqrt(np.mean((record.s[:, :2] - exact.s[:, :2]) ** 2) / np.mean(exact.s[:, :2] ** 2))
    duration = assembly.scenario.duration
    print(
        f"\n{integrator} x {substeps}: loop / raw steps {np.median(ratios):.2f} (median of {len(ratios)}), "
        f"{duration / np.median(loops):.0f} x real time, position error {error:.1e} relative rms"
    )
    assert error < 1e-2


def test_exact_engine(benchmark):
    assembly = assemble(load(), CASE_I)
    benchmark.pedantic(lambda: run(assembly, "exact"), rounds=9, iterations=1, warmup_rounds=1)
    median = benchmark.stats.stats.median if benchmark.stats else float("nan")
    print(f"\nexact: {assembly.scenario.duration / median:.0f} x real time, the reference for errors")
    assert assembly.scenario.samples == 12500
