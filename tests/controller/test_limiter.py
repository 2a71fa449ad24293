"""The limiter solves a box problem in each tick, with delays and walls, and is passive for rho = 0."""

import numpy as np
import pytest
from driven import drive, random_walks
from shared import FIGURE_4, STIFF, T, checkered, loop_of

from haptic_loop.controller.arithmetic import SingularLoop
from haptic_loop.controller.complementarity import BoxProblem
from haptic_loop.controller.coupling import NoCoupling, SpringDamper
from haptic_loop.controller.environment import GROUND, Network, Spring, Wall
from haptic_loop.controller.law import Limiter
from haptic_loop.controller.lti import Lti
from haptic_loop.controller.tick import Process, StepBuffer

LIMITS = (12.0, 5.657)


def closed(limiter: Limiter) -> Process:
    """Return the process of a limiter whose actuators and encoders are ideal."""
    return Process(limiter, np.full(limiter.channels, np.inf), np.zeros(limiter.channels))


def unlimited(network: Network, theta) -> Process:
    return Process(loop_of(network, theta, (0, 0)).law(STIFF), np.full(2, np.inf), np.zeros(2))


def passive(n: int, rng: np.random.Generator) -> np.ndarray:
    """Return a positive definite, unsymmetric matrix: all its principal minors are positive."""
    root, turn = rng.normal(size=(2, n, n))
    return np.diag(rng.uniform(0.01, 1, n)) + root @ root.T + turn - turn.T


def check(problem: BoxProblem, q: np.ndarray) -> None:
    """Check the solution by its definition, with a residual of at most 1e-11 of its terms."""
    v, f = problem.solve(q)
    low, high = problem.lower[:, None], problem.upper[:, None]
    scale = 1e-11 * (np.abs(q) + np.abs(problem.M) @ np.abs(v))
    np.testing.assert_array_less(np.abs(q - problem.M @ v - f), scale + 1e-300)
    assert ((low <= f) & (f <= high)).all()
    assert (f[v > 0] == np.broadcast_to(high, f.shape)[v > 0]).all()
    assert (f[v < 0] == np.broadcast_to(low, f.shape)[v < 0]).all()
    assert 0 < (v != 0).mean() < 1


@pytest.mark.parametrize("n", [1, 2, 3, 4, 6, 8])
def test_the_forces_solve_the_box_problem(n):
    rng = np.random.default_rng(n)
    for _ in range(10):
        upper = rng.uniform(0.5, 3, n)
        check(BoxProblem(passive(n, rng), -upper, upper), rng.normal(size=(n, 60)) * 4)
    lower = np.where(np.arange(n) % 2, -np.inf, -1.0)  # some limits are one-sided, as for walls
    check(BoxProblem(passive(n, rng), lower, np.ones(n)), rng.normal(size=(n, 60)) * 4)


@pytest.mark.parametrize("n", [2, 3])
def test_pivoting_and_listing_find_equal_forces(n):
    rng = np.random.default_rng(n)
    for _ in range(20):
        problem = BoxProblem(passive(n, rng), -np.ones(n), np.ones(n))
        q = rng.normal(size=(n, 40)) * 4
        np.testing.assert_allclose(problem._pivoted(q), problem._listed(q)[0], rtol=0, atol=1e-12)  # up to 19 N


def test_one_sided_coupling_of_forces_is_solved():
    """The slip of the second force changes the first force, but not conversely."""
    v, f = BoxProblem(np.array([[1.0, 0.5], [0.0, 1.0]]), -np.ones(2), np.ones(2)).solve(np.array([[0.5], [2.0]]))
    np.testing.assert_allclose([v[:, 0], f[:, 0]], [[0.0, 1.0], [0.0, 1.0]], rtol=0, atol=1e-12)


def test_two_channels_equal_a_calculation_by_hand():
    upper = np.array(LIMITS)
    e, f = BoxProblem(np.array([[1000.0, -900.0], [-900.0, 1000.0]]), -upper, upper).solve(np.array([[20.0], [5.0]]))
    np.testing.assert_allclose(f[:, 0], LIMITS, rtol=1e-12)
    np.testing.assert_allclose(e[:, 0], [0.038993, 0.034437], rtol=0, atol=5e-7)  # half of the last digit
    ungrounded = BoxProblem(np.array([[1000.0, -1000.0], [-1000.0, 1000.0]]), -upper, upper)
    e, f = ungrounded.solve(np.array([[20.0], [-20.0]]))
    np.testing.assert_allclose(f[:, 0], [5.657, -5.657], rtol=1e-12)
    np.testing.assert_allclose(e[:, 0], [0, -0.014343], rtol=0, atol=1e-9)


def test_forces_at_contacts_without_ground_are_unique():
    """The stiffness matrix of a chain of springs without ground is singular, but the forces are unique."""
    K = 1000.0 * np.array([[1, -1, 0, 0], [-1, 2, -1, 0], [0, -1, 2, -1], [0, 0, -1, 1.0]])
    problem = BoxProblem(K, -np.ones(4), np.array([1.0, 2.0, 3.0, 1.0]))
    q = K @ np.random.default_rng(0).normal(size=(4, 200)) * 1e-2
    e, f = problem.solve(q)
    regularised = 1e-10 * 2000 * np.abs(e).max()  # [N] pivoting adds 1e-10 of M's largest entry to its diagonal
    assert np.abs(f.sum(axis=0)).max() < 4.1 * regularised  # the exact forces add up to 0
    np.testing.assert_allclose(q - K @ e, f, rtol=0, atol=1.1 * regularised)


def test_a_matrix_with_a_negative_minor_is_refused():
    with pytest.raises(SingularLoop, match=r"limited forces \[1, 2\] are not determined"):
        BoxProblem(np.array([[1.0, 2.0], [2.0, 1.0]]), -np.ones(2), np.ones(2))


def test_a_limited_spring_equals_calculations_by_hand():
    """The forces for G = 1000, L = 1, rho = 20 and theta = 0 were computed by hand."""
    limiter = Limiter(Lti.constant([[1000.0]], 1.0), (0,), limit=np.ones(1), rho=np.array([20.0]))
    x = np.array([0, 0.0005, 0.002, 0.003, 0.002, 0.0005, 0, -0.002])
    f = drive(closed(limiter), x[:, None, None]).f[: x.size, 0, 0]
    np.testing.assert_allclose(f, [0, 0.5, 1, 1, 1, 0.520384, 0, -1], rtol=0, atol=5e-7)  # half of the last digit
    assert (np.abs(f) <= 1).all()


@pytest.mark.parametrize("third", [False, True])
def test_a_device_between_walls_is_limited_to_the_right_side(third):
    """Without contact a slip changes no force, so its own entry in M is 0; with three walls the tick pivots."""
    walls = (Wall(("a", GROUND), 1000.0, 0.0, 1e-3), Wall((GROUND, "a"), 3000.0, 0.0, 2e-3))
    far = Wall(("a", "far"), 500.0, 0.0, 0.05)
    springs, masses = ((Spring(("far", GROUND), 100.0),), {"far": 0.1}) if third else ((), {})
    network = Network(("a",), springs, masses, walls=(*walls, *(far,) * third))
    x = 0.004 * np.random.default_rng(0).normal(size=(200, 1, 1))
    f = drive(closed(loop_of(network, (0,), (0,)).law(NoCoupling(), (2.0,), (0.0,))), x).f[:200]
    expected = np.clip(1000 * np.maximum(x - 1e-3, 0) - 3000 * np.maximum(-x - 2e-3, 0), -2, 2)
    np.testing.assert_allclose(f, expected, rtol=0, atol=1e-12)


def test_with_rho_a_limited_spring_can_give_energy():
    """With rho = 0.05 this cycle gives 0.0051 J per turn beyond the damping's dx^2/2; with rho = 0 it gives none."""
    x = np.tile([-1.048, -0.998, 1.028, 1.049, 1.069, 0.996], 20)
    taken = []
    for rho in (0.05, 0.0):
        limiter = Limiter(Lti.constant([[1.0]], 1.0), (0,), limit=np.ones(1), rho=np.array([rho]))
        f = drive(closed(limiter), x[:, None, None]).f[: x.size, 0, 0]
        dx = np.diff(np.append(x, x[0]))
        taken.append((f * dx + 0.5 * dx**2)[-6:].sum())
    np.testing.assert_allclose(taken, [-0.00513229, 0.00586900], rtol=0, atol=5e-9)  # half of the last digit


WALLED = Network(
    FIGURE_4.contacts,
    FIGURE_4.springs,
    FIGURE_4.masses,
    (Wall(("mass", GROUND), 5000.0, 3.0, 1e-3), Wall((GROUND, "mass"), 4000.0, 0.0, 2e-3)),
)


@pytest.mark.parametrize("network", [FIGURE_4, WALLED], ids=["linear", "walls"])
def test_limits_out_of_reach_change_nothing(network):
    x = random_walks(500, 2, 3)
    limiter = loop_of(network, (0, 2), (0, 0)).law(STIFF, (1e6, 1e6), (10.0, 20.0))
    limiting, without = drive(closed(limiter), x), drive(unlimited(network, (0, 2)), x)
    np.testing.assert_allclose(limiting.f[:500], without.f[:500], rtol=0, atol=1e-11)  # forces of up to 31 N
    w = len(network.walls)
    np.testing.assert_allclose(limiter.depths(limiting.z), without.z[1:, without.z.shape[1] - w :], rtol=0, atol=1e-12)
    assert not limiter.slips(limiting.z).any()
    assert len(limiter.frozen()) == 2**w


@pytest.mark.parametrize(("network", "theta"), checkered((FIGURE_4, WALLED), ((0, 0), (1, 2))))
def test_the_limited_loop_obeys_its_definition(network, theta):
    """The force f_e is within its limits. The slip e is 0 inside the limits, and at a limit it points outwards.

    The linear loop, driven by x - e, sends f_e + rho (e - e_-), where e_- is the slip of the tick before.
    """
    x, limit, rho = random_walks(600, 2, 4), np.array([3.0, 1.5]), np.array([11.0, 7.0])
    limiter = loop_of(network, theta, (0, 0)).law(STIFF, limit, rho)
    buffer = drive(closed(limiter), x)
    e = limiter.slips(buffer.z)
    n = max(theta)
    f_e = np.stack([buffer.f[theta[i] : 600 - n + theta[i], i] for i in range(2)], axis=1)
    e = e[: 600 - n]
    assert (np.abs(f_e) <= limit[:, None]).all()
    np.testing.assert_array_equal(f_e * e, limit[:, None] * np.abs(e))  # a slipping force equals its limit
    assert 0.1 < (e != 0).mean() < 0.9
    linear = unlimited(network, (0, 0))
    slips = np.diff(np.concatenate([np.zeros((1, 2, 4)), e]), axis=0)
    expected = drive(linear, x[: len(e)] - e).f[: len(e)] - rho[:, None] * slips
    np.testing.assert_allclose(f_e, expected, rtol=0, atol=1e-11)  # 600 ticks round forces of up to 3 N


@pytest.mark.slow
def test_many_simulations_equal_separate_runs():
    x = random_walks(300, 2, 5)
    process = closed(loop_of(WALLED, (1, 0), (0, 0)).law(STIFF, (3.0, 1.5), (0.0, 0.0)))
    together = drive(process, x).f[:300]
    alone = np.concatenate([drive(process, x[..., i : i + 1]).f[:300] for i in range(5)], axis=2)
    np.testing.assert_allclose(together, alone, rtol=0, atol=1e-11)  # 300 ticks round forces of up to 3 N


@pytest.mark.parametrize("weakest", [np.inf, 2.0], ids=["limiter", "actuators"])
@pytest.mark.parametrize("channels", [1, 2, 4])
def test_one_simulation_ticks_like_several(channels, weakest):
    """The second of two simulations is also run alone. In it each channel reaches both of its limits."""
    names, limit = tuple("abcd"[:channels]), np.linspace(2.6, 2.9, channels)
    network = Network(names, tuple(Spring((name, GROUND), 900.0, 0.3) for name in names))
    coupling = SpringDamper([2000.0] * channels, [0.5] * channels)
    theta = tuple(i % 2 for i in range(channels))
    limiter = loop_of(network, theta, (0,) * channels).law(coupling, limit, (5.0,) * channels)
    actuators = np.array([weakest] + [np.inf] * (channels - 1))  # the first actuator may be weaker than its limiter
    process = Process(limiter, actuators, np.zeros(channels))
    phases = np.arange(400)[:, None] / 15 + np.arange(channels)
    slow = 5e-3 * np.sin(phases)
    x = np.stack([1e-3 * slow, slow], axis=-1)  # only the second simulation is limited
    together, alone = StepBuffer(process, 400, channels, nsim=2), StepBuffer(process, 400, channels)
    for buffer, moved in ((together, x), (alone, x[:, :, 1:])):
        for k, row in enumerate(moved):
            buffer.x[k] = row
            buffer.tick(k)
    f = drive(process, x).f[:400]
    np.testing.assert_allclose(together.f[:400], f, rtol=0, atol=1e-12)
    np.testing.assert_allclose(alone.f[:400], f[:, :, 1:], rtol=0, atol=1e-12)
    np.testing.assert_allclose(f[:, :, 1].max(axis=0), np.minimum(limit, actuators), rtol=1e-12)
    np.testing.assert_allclose(f[:, :, 1].min(axis=0), -np.minimum(limit, actuators), rtol=1e-12)


@pytest.mark.parametrize(("walls", "limited"), checkered((0, 1, 2), (True, False)))
def test_a_stack_of_laws_ticks_like_each_alone(walls, limited):
    """Walls and springs differ between the laws, the states begin inside the walls, and forces exceed their limits."""
    laws = []
    for k in range(6):
        some = tuple(Wall(w.between, w.stiffness * (1 + k), 2.0 + k, w.gap / (1 + k)) for w in WALLED.walls[:walls])
        springs = tuple(Spring(s.between, s.stiffness * (1 + k / 9), s.damping) for s in FIGURE_4.springs)
        loop = loop_of(Network(FIGURE_4.contacts, springs, FIGURE_4.masses, some), (0, 1), (0, 0))
        laws.append(loop.law(STIFF, (3.0 + k, 1.5), (5.0, 2.0)) if limited else loop.law(STIFF))
    order, stack = laws[0].open.order, laws[0].together(laws)
    for before in 3e-3 * np.random.default_rng(0).normal(size=(40, order + 2, 6)):
        if walls:
            before[order - walls : order] = np.abs(before[order - walls : order])  # depths
        together, alone = np.empty((order + 2, 6)), np.empty((order + 2, 1))
        stack(before, together)
        for k, law in enumerate(laws):
            law.transition()(np.ascontiguousarray(before[:, k : k + 1]), alone)
            np.testing.assert_allclose(together[:, k], alone[:, 0], rtol=1e-9, atol=1e-9)


def test_a_slip_makes_its_tick_nonlinear():
    """The state after a tick is nonlinear only if a force slips; the limited force acts theta ticks later."""
    limiter = loop_of(FIGURE_4, (2, 3), (0, 0)).law(STIFF, (3.0, 1.5), (5.0, 2.0))
    buffer = drive(closed(limiter), random_walks(60, 2, 11))
    slipped = limiter.limited(buffer.z, buffer.f[:60], LIMITS)
    assert 0 < slipped.any(axis=1).mean() < 1
    seen = np.concatenate([buffer.z[:60], buffer.x[:60]], axis=1)
    bent = np.abs(buffer.z[1:61] - np.einsum("ij,kjn->kin", limiter.linear[2:], seen)).max(axis=1) > 1e-9
    np.testing.assert_array_equal(bent, slipped.any(axis=1))
    for i, theta in enumerate(limiter.theta):
        late = np.abs(buffer.f[theta:60, i])[slipped[: 60 - theta, i]]
        np.testing.assert_allclose(late, limiter.limit[i], rtol=1e-12)


@pytest.mark.parametrize("i", [0, 1])
def test_all_limits_hold_while_a_wall_pushes(i):
    """If all forces exceed their limits in one tick while a wall pushes, each is sent at its limit."""
    network = Network(WALLED.contacts, WALLED.springs, WALLED.masses, WALLED.walls[i : i + 1])
    limiter = loop_of(network, (0, 0), (0, 0)).law(STIFF, (3.0, 1.5), (0.0, 0.0))
    signs = np.array([[1, 1, -1, -1], [1, -1, 1, -1]])
    buffer = drive(closed(limiter), np.repeat(0.05 * signs[None], 60, axis=0))
    assert (limiter.depths(buffer.z)[:60] > 0).any(axis=(0, 1)).sum() == 2
    np.testing.assert_allclose(buffer.f[:60], np.broadcast_to(signs * [[3.0], [1.5]], (60, 2, 4)), rtol=1e-12)
    assert limiter.limited(buffer.z, buffer.f[:60], LIMITS).all()
    still = drive(closed(limiter), np.zeros((5, 2, 1)))
    assert not limiter.limited(still.z, still.f[:5], LIMITS).any()
    actuators = loop_of(network, (0, 0), (0, 0)).law(STIFF)
    force = np.array([[[3.0], [-1.4]]])
    np.testing.assert_array_equal(actuators.limited(still.z, force, np.array([[3.0], [1.5]])), [[[True], [False]]])


@pytest.mark.parametrize("sign", [-1, 1])
@pytest.mark.parametrize("channel", [0, 1])
def test_the_first_limited_tick_is_found(channel, sign):
    limiter = loop_of(FIGURE_4, (1, 2), (0, 0)).law(STIFF, LIMITS, (10.0, 10.0))
    buffer = StepBuffer(closed(limiter), 10, 2)
    sent, other = (buffer.after[:, limiter.sent_rows[i], 0] for i in (channel, 1 - channel))
    assert buffer.linear_until(10) == 10
    sent[4] = sign * LIMITS[channel]
    assert buffer.linear_until(10) == 10, "a tick with a force at its limit is still linear"
    assert buffer.linear_until(10, 0.5) == 4
    sent[6] = sign * LIMITS[channel] * (1 + 1e-9)
    assert (buffer.linear_until(10), buffer.linear_until(6)) == (6, 6)
    other[8] = 100.0
    assert buffer.linear_until(10) == 6
    other[2] = np.nan
    assert buffer.linear_until(10) == 2


def test_limiter_and_environment_are_passive_without_rho():
    """The sum of f_e (x_k - x_{k-1}) is never negative, with walls, limits and V = 0."""
    x = random_walks(600, 2, 10)
    f = drive(closed(loop_of(WALLED, (0, 0), (0, 0)).law(NoCoupling(), (3.0, 1.5), (0.0, 0.0))), x).f[:600]
    energy = np.cumsum((f * np.diff(x, axis=0, prepend=0.0)).sum(axis=1), axis=0)
    assert energy.min() >= -1e-9
    assert energy.max() > 0.5


@pytest.mark.slow
def test_clipped_cycles_give_energy_limited_ones_none():
    """On a circle of radius 4 cm, forces that are clipped one by one give two hands 0.616 J per turn at any speed."""
    coupling, rho = SpringDamper([5832.0, 2545.0], [0.187, 1.386]), (11.4167, 11.4167)
    limit = np.array(LIMITS)[:, None]
    linear = Process(loop_of(FIGURE_4, (1, 2), (0, 0)).law(coupling), np.full(2, np.inf), np.zeros(2))
    for turn_s, dissipated in ((5.0, 0.0173), (10.0, 0.00865)):
        ticks = round(turn_s / T)
        angle = 2 * np.pi * np.arange(2 * ticks) / ticks
        x = 0.04 * np.stack([np.cos(angle), -np.sin(angle)], axis=1)[..., None]
        dx = np.diff(x, axis=0)[-ticks:]
        assert (1.37 * dx**2 / T).sum() == pytest.approx(dissipated, rel=1e-2)
        clipped = np.clip(drive(linear, x).f[: 2 * ticks], -limit, limit)
        assert (clipped[-ticks - 1 : -1] * dx).sum() == pytest.approx(-0.616, abs=0.005)
        f = drive(closed(loop_of(FIGURE_4, (1, 2), (0, 0)).law(coupling, LIMITS, rho)), x).f[: 2 * ticks]
        # The delay and the network's damping leave a small energy per turn.
        assert abs((f[-ticks - 1 : -1] * dx).sum()) < 0.1 * dissipated
        assert (np.abs(f).max(axis=0) <= limit).all()


@pytest.mark.parametrize("x", [(0.001, -0.002), (0.03, -0.02), (0.05, 0.05)])
def test_at_rest_is_the_state_of_held_displacements(x):
    """The loop keeps the state `at_rest` at held displacements, within the limits and beyond them."""
    limiter = loop_of(FIGURE_4, (1, 2), (0, 0)).law(STIFF, LIMITS, (10.0, 10.0))
    z, held = limiter.at_rest(np.array(x)), StepBuffer(closed(limiter), 2000, 2)
    held.x[:, :, 0] = x
    held.z[0, :, 0] = z
    for k in range(2000):
        held.tick(k)
    np.testing.assert_allclose(held.z[1:, :, 0], np.broadcast_to(z, (2000, z.size)), rtol=0, atol=1e-10)
    stiffness = limiter.sent.dc()
    e = limiter.slips(held.z)[0, :, 0]
    np.testing.assert_allclose(held.f[0, :, 0], stiffness @ (np.array(x) - e), rtol=0, atol=1e-11)
    assert (e != 0).any() == (np.abs(stiffness @ x) > LIMITS).any()


def test_bad_limits_are_named():
    G = Lti.constant(np.eye(2), T)
    with pytest.raises(ValueError, match="rho has 1 entries for 2 channels"):
        Limiter(G, (0, 0), limit=np.ones(2), rho=np.ones(1))
    with pytest.raises(ValueError, match="expected positive forces"):
        Limiter(G, (0, 0), limit=np.array([1.0, 0.0]), rho=np.ones(2))
    for rho in (-1.0, np.inf):
        with pytest.raises(ValueError, match="expected stiffnesses >= 0"):
            Limiter(G, (0, 0), limit=np.ones(2), rho=np.array([1.0, rho]))
    with pytest.raises(ValueError, match="a block of 2 x 2 cannot serve 3 channels"):
        Limiter(G, (0, 0, 0), limit=np.ones(3), rho=np.ones(3))
