"""Measure a tick of MuJoCo worlds of 1, 10 and 50 bodies, and how far contact forces are from their law.

make bench    (or: python -m pytest tests/benchmarks/test_world_cost.py --benchmark-only -s)
"""

import time

import mujoco
import numpy as np
import pytest

from haptic_loop.models.world import Contact, Rows, World

pytestmark = pytest.mark.benchmark(group="world")

T, G = 1e-3, 1500.0  # period [s], and stiffness of the spring at each finger [N/m]


def pile(bodies: int) -> str:
    """Return a scene of boxes that slide in x and z, in columns of five on a table, between two fingers."""
    parts = [
        f'<body pos="{0.062 * (i // 5)} 0 {0.02 + 0.04 * (i % 5)}"><joint type="slide" axis="1 0 0"/>'
        '<joint type="slide" axis="0 0 1"/><geom type="box" size="0.03 0.03 0.02" mass="0.1"/></body>'
        for i in range(bodies)
    ]
    end = 0.062 * ((bodies - 1) // 5) + 0.045
    return f"""<mujoco><default><geom solimp="0.9 0.9 0.001"/></default><worldbody>
    <geom type="plane" size="5 5 0.1"/><body name="left" pos="-0.045 0 0.02"><geom type="sphere" size="0.01"/></body>
    <body name="right" pos="{end} 0 0.02"><geom type="sphere" size="0.01"/></body>
    {"".join(parts)}</worldbody></mujoco>"""


@pytest.mark.parametrize("bodies", [1, 10, 50])
def test_a_tick_of_a_scene(benchmark, tmp_path, bodies):
    """Measure a tick and `mj_step` alone, best of many; forces of pressed contacts must satisfy their law."""
    path = tmp_path / "scene.xml"
    path.write_text(pile(bodies))
    port = World(path, [Contact("left"), Contact("right")], [np.eye(1) * G] * 2, T).port()
    goal = np.array([0.02, -0.02])
    for _ in range(500):
        port.step(goal)

    def cpu(call, times=200) -> float:
        spent = []
        for _ in range(times):
            began = time.thread_time()
            call()
            spent.append(time.thread_time() - began)
        return 1e6 * min(spent)

    tick = cpu(lambda: port.step(goal))
    rows = Rows.of(port.world.model, port.data)
    law = -rows.D * ((rows.after - rows.before) / T + rows.b * rows.after + rows.K * (rows.depth + T * rows.after))
    normal = rows.one_sided & (rows.force > 0)
    normal &= np.isin(np.arange(normal.size), rows.first)  # the first row of a contact is its normal
    error = np.abs(rows.force - law)[normal].max() / np.abs(rows.force).max()
    bare = cpu(lambda: mujoco.mj_step(port.world.model, port.data))
    counts = f"{bodies} bodies, {len(rows.first)} contacts, {rows.force.size} rows"
    print(f"\n{counts}: {tick:.0f} us a tick, mj_step {bare:.0f}, error of pressed contacts {error:.1e}")
    assert error < 1e-3  # relative to the largest force; when measured, the error was 2e-16
    benchmark.pedantic(lambda: port.step(goal), rounds=20, iterations=5)
