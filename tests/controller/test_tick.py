"""A tick obeys the timing convention of controller.tick."""

import numpy as np
import pytest
from shared import FIGURE_4, force_map, loop_of

from haptic_loop.controller.coupling import Compliance, NoCoupling, SpringDamper
from haptic_loop.controller.environment import GROUND, Network, Spring, Wall, environment
from haptic_loop.controller.law import Law
from haptic_loop.controller.lti import Lti
from haptic_loop.controller.tick import Process, StepBuffer

T = 1e-3
NONE = np.zeros(1)


def drive(process: Process, x: np.ndarray) -> np.ndarray:
    """Return the forces (ticks, m) for displacements x (ticks, m)."""
    buffer = StepBuffer(process, len(x), x.shape[1])
    for k, row in enumerate(x):
        buffer.x[k] = row[:, None]
        buffer.tick(k)
    return buffer.f[: len(x), :, 0]


def wall(K: float, B: float = 0.0) -> Lti:
    return environment(Network(("a",), (Spring(("a", GROUND), K, B),)), T)


def process(F: Lti, limit=np.inf, step=0.0) -> Process:
    return Process(Law(F), np.full(F.inputs, limit), np.full(F.inputs, step))


def test_three_ticks_equal_a_calculation_by_hand():
    """A spring-damper of 1000 N/m and 2 N s/m is behind a coupling spring of 1000 N/m; theta = 1, the limit is 5 N.

    The coupling's force f_e moves the end of the coupling from u-, one tick before, to u:
    f_e = 1000 u + 2 (u - u-)/T = 3000 u - 2000 u-,  u = x - f_e/1000  =>  f_e = (3000 x - 2000 u-) / 4
        k   x[mm]   u-[mm]   f_e[N]     u[mm]     f[N] = f_e one tick later, within 5 N
        0   4       0        3          1         0
        1   8       1        5.5        2.5       3
        2   0       2.5     -1.25       1.25      5 (5.5 clipped)
    """
    F = force_map(wall(1000.0, 2.0), SpringDamper([1000.0], [0.0]), [1], [0])
    f = drive(process(F, limit=5.0), np.array([[4e-3], [8e-3], [0.0], [0.0]]))
    np.testing.assert_allclose(f[:, 0], [0.0, 3.0, 5.0, -1.25], rtol=0, atol=1e-12)


def test_forces_end_at_their_limit_in_both_directions():
    """A spring of 1000 N/m is moved by 12, 5 and 4 mm to either side; the limit is 5 N."""
    f = drive(process(wall(1000.0), limit=5.0), 1e-3 * np.array([[12.0], [5.0], [4.0], [-4.0], [-5.0], [-12.0]]))
    np.testing.assert_allclose(f[:, 0], [5.0, 5.0, 4.0, -4.0, -5.0, -5.0], rtol=0, atol=1e-12)


@pytest.mark.parametrize(("theta", "psi"), [(0, 0), (2, 0), (0, 1), (3, 2)])
def test_without_coupling_both_delays_only_shift(theta, psi):
    x = np.random.default_rng(0).normal(size=(30, 1))
    shifted = drive(process(force_map(wall(500.0, 1.0), NoCoupling(), [theta], [psi])), x)
    direct = drive(process(wall(500.0, 1.0)), x)
    n = theta + psi
    np.testing.assert_allclose(shifted[n:], direct[: 30 - n], rtol=1e-12)
    assert not shifted[:n].any()


def test_only_psi_is_inside_the_loop():
    coupling = SpringDamper([900.0], [0.5])
    E, z = wall(500.0, 1.0), np.exp(1j * np.array([0.1, 1.0, 2.0]))
    V, e = coupling.compliance(T).at(z)[:, 0, 0], E.at(z)[:, 0, 0]
    F = force_map(E, coupling, [2], [1]).at(z)[:, 0, 0]
    np.testing.assert_allclose(F, z**-2 * (e / z) / (1 + e / z * V), rtol=1e-12)


def test_the_coupling_is_spring_and_damper_in_parallel():
    z = np.exp(1j * np.array([0.1, 1.0, 2.0]))
    V = SpringDamper([900.0, 400.0], [0.5, 0.0]).compliance(T)
    s = (z - 1) / (T * z)
    np.testing.assert_allclose(V.at(z)[:, 0, 0], 1 / (900 + 0.5 * s), rtol=1e-12)
    np.testing.assert_allclose(V.at(z)[:, 1, 1], 1 / 400, rtol=1e-12)
    assert V.order == 1


def test_many_simulations_equal_separate_runs():
    F = force_map(environment(FIGURE_4, T), SpringDamper([900.0, 500.0], [0.4, 0.5]), [1, 2], [0, 1])
    x = np.random.default_rng(1).normal(size=(20, 2, 5))
    buffer = StepBuffer(process(F), 20, 2, nsim=5)
    for k in range(20):
        buffer.x[k] = x[k]
        buffer.tick(k)
    for i in range(5):
        # The number of columns may change the order in which a matrix product adds its terms.
        np.testing.assert_allclose(buffer.f[:20, :, i], drive(process(F), x[:, :, i]), rtol=1e-9, atol=1e-9)


def test_rewinding_continues_the_run():
    F = force_map(environment(FIGURE_4, T), SpringDamper([900.0, 500.0], [0.4, 0.5]), [1, 2], [0, 0])
    x = np.random.default_rng(2).normal(size=(20, 2))
    buffer = StepBuffer(process(F), 10, 2)
    parts = []
    for stretch in (x[:7], x[7:17], x[17:]):
        for k, row in enumerate(stretch):
            buffer.x[k] = row[:, None]
            buffer.tick(k)
        parts.append(buffer.f[: len(stretch), :, 0].copy())
        buffer.rewind(len(stretch))
    np.testing.assert_allclose(np.concatenate(parts), drive(process(F), x), rtol=1e-12)


def test_encoders_round_to_whole_steps():
    f = drive(process(wall(1000.0), step=1e-3), np.array([[0.4e-3], [0.6e-3], [-1.6e-3]]))
    np.testing.assert_allclose(f[:, 0], [0.0, 1.0, -2.0], rtol=0, atol=1e-12)


def test_an_encoder_of_one_channel_rounds_that_one():
    each = Process(Law(Lti.constant(1000 * np.eye(2), T)), np.full(2, np.inf), np.array([1e-3, 0.0]))
    np.testing.assert_allclose(drive(each, np.full((1, 2), 0.6e-3)), [[1.0, 0.6]], rtol=0, atol=1e-12)


def test_encoders_do_not_move_the_device():
    """Only the measured position is rounded; rounding the device's own position would make it creep."""
    buffer = StepBuffer(process(wall(1000.0), step=1e-3), 2, 2)
    buffer.x[0] = 0.6e-3
    buffer.tick(0)
    assert buffer.f[0, 0, 0] == pytest.approx(1.0)
    assert buffer.x[0, 0, 0] == 0.6e-3


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: SpringDamper([1.0, 2.0], [1.0]), r"K has the shape \(2,\) and B has \(1,\)"),
        (lambda: SpringDamper([0.0], [1.0]), "expected positive stiffnesses"),
        (lambda: SpringDamper([1.0], [-1.0]), "expected dampings >= 0"),
        (lambda: Compliance(Lti.constant([[1.0]], T)).around(environment(FIGURE_4, T)), "has 2 contacts"),
    ],
)
def test_impossible_couplings_are_refused(build, message):
    with pytest.raises(ValueError, match=message):
        build()


def test_passivity_layers_count_ticks_of_the_run():
    """In a later block, which begins at tick `first`, delays and layers still count from the start of the run."""
    heard = []

    class Net:
        def send(self, x, force):
            heard.append("send")

        def apply(self, k, force):
            heard.append(k)

    delays = np.zeros((100, 1, 1), dtype=int)
    delays[:50] = 1  # These delays would act if the block counted its ticks from 0.
    F = wall(1000.0)
    buffer = StepBuffer(Process(Law(F), np.array([np.inf]), NONE, delays=delays, net=lambda nsim: Net()), 3, 1)
    buffer.first = 50
    buffer.x[:3, 0, 0] = 1e-3 * np.arange(1, 4)
    for k in range(3):
        buffer.tick(k)
    assert heard == ["send", 50, "send", 51, "send", 52]
    np.testing.assert_allclose(buffer.f[:3, 0, 0], [1.0, 2.0, 3.0], rtol=1e-12)


def test_a_process_knows_its_walls():
    network = Network(("a",), walls=(Wall(("a", GROUND), 1000.0),))
    joined = loop_of(network, (0,), (0,), T).law(NoCoupling())
    assert Process(joined, np.array([np.inf]), NONE).walls == network.walls != ()
    assert process(wall(1000.0)).walls == ()
