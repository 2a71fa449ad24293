"""A hand that is not passive cannot be built, and each way of describing a hand gives the same plant."""

import numpy as np
import pytest
import scipy
from hypothesis import given, settings
from hypothesis import strategies as st

from haptic_loop.models.device import CompliantDevice, RigidDevice
from haptic_loop.models.human import Cross, Human, Impedance, Link, Person, Port, state_space
from haptic_loop.models.scene import Crowd, HumanSets, build, from_mjcf, plant, variants

DEVICE = RigidDevice(mass=0.2, damping=0.9)


class Own:
    """A hand of a user's own class, with the given port."""

    def __init__(self, port):
        self._port = port

    def port(self):
        return self._port

    def voluntary_force(self, t):
        return np.zeros_like(t)


def felt(port, w, device=DEVICE):
    """Return the impedance at the device's motor, force over velocity [N s/m], from the plant's matrices."""
    scene = build([device], [Own(port)])
    linear = plant(scene.model)
    x = np.linalg.solve(1j * w * np.eye(len(linear.A)) - linear.A, -linear.B[:, -1])
    return 1 / x[scene.model.nv]


# passivity of an impedance


@settings(deadline=None, max_examples=20)
@given(st.integers(0, 10**6), st.integers(1, 5))
def test_every_frequency_is_decided_without_a_grid(seed, n):
    """A random impedance is accepted if a dense sweep finds Re Z > 0 everywhere, and refused if Re Z < 0 somewhere."""
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(n, n))
    A -= (np.linalg.eigvals(A).real.max() + 0.3) * np.eye(n)
    B, C = rng.normal(size=(n, 1)), rng.normal(size=(1, n))
    sweep = np.concatenate([[0.0], np.geomspace(1e-3, 1e3, 4000)])
    real = (C @ np.linalg.solve(1j * sweep[:, None, None] * np.eye(n) - A, B)).real
    least = min(real.min(), 0.0)  # Re Z is 0 at infinity
    size = np.abs(real).max()
    assert Impedance(A, B, C, [[-least + 1e-3 * size]]).order == n
    with pytest.raises(ValueError, match="not passive, Re Z is -"):
        Impedance(A, B, C, [[-least - 1e-2 * size]])


@pytest.mark.parametrize("width", [1e-3, 1e-5, 1e-7])
@pytest.mark.parametrize("depth", [1e-2, 1.0])
def test_a_narrow_active_resonance_is_refused(width, depth):
    """The resonance -2 c h w0 s/(s^2 + 2 h w0 s + w0^2), of gain c, makes Re Z < 0 near w0; with c < 0 Z is passive."""
    rng = np.random.default_rng(7)
    w = 90.0 * 10 ** np.array([0.0, -1.0, 0.5, 1.2])
    h = np.array([width, 0.3, 0.05, 0.7])
    gain = np.array([-2.0 * (1 + depth), 3.0, 0.4, 1.0])  # the last three resonances are passive
    blocks = [w * np.array([[0.0, 1.0], [-1.0, -2 * h]]) for w, h in zip(w, h, strict=True)]
    A, B = scipy.linalg.block_diag(*blocks), np.tile([[0.0], [1.0]], (4, 1))
    C = np.ravel([[0.0, g * 2 * h * w] for g, h, w in zip(gain, h, w, strict=True)])[None]
    turn = np.linalg.qr(rng.normal(size=A.shape))[0]
    beside = (C @ np.linalg.solve(1j * w[0] * np.eye(8) - A, B)).item().real - gain[0]
    for sign, passive in ((1.0, False), (-1.0, True)):
        D = [[0.5 if passive else 2.0 - beside]]
        parts = turn.T @ A @ turn, turn.T @ B, C * np.where(np.arange(8) < 2, sign, 1.0) @ turn, D
        if passive:
            assert Impedance(*parts).order == 8
        else:
            with pytest.raises(ValueError, match=r"not passive|cannot be decided"):
                Impedance(*parts)


def test_one_lag_is_passive_two_are_not():
    """g/(1 + tau s) has the real part g/(1 + (tau w)^2); that of g/(1 + tau s)^2 is negative above w = 1/tau."""
    assert Impedance([[-20.0]], [[20.0]], [[3.0]], [[0.0]]).order == 1
    twice = [[-20.0, 0.0], [20.0, -20.0]], [[20.0], [0.0]], [[0.0, 3.0]], [[0.0]]
    with pytest.raises(ValueError, match=r"not passive, Re Z is -.* N s/m at .* Hz"):
        Impedance(*twice)
    # The least real part is -g/8, at w = sqrt(3)/tau, so a damping of g/8 is just enough.
    assert Impedance(*twice[:3], [[3.0 / 8]]).order == 2
    with pytest.raises(ValueError, match=r"at 5\.\d* Hz"):
        Impedance(*twice[:3], [[0.999 * 3.0 / 8]])


def test_nearly_lossless_impedances_are_accepted():
    """Re Z of a lightly damped resonance at 30 rad/s is nearly zero at most frequencies."""
    assert Impedance([[-1e-3, -30.0], [30.0, -1e-3]], [[1.0], [0.0]], [[1.0, 0.0]], [[0.0]]).order == 2


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        (([[1.0]], [[1.0]], [[1.0]], [[0.0]]), "expected a stable A"),
        (([[0.0]], [[1.0]], [[1.0]], [[0.0]]), "expected a stable A"),
        (([[-1.0]], [[1.0]], [[1.0]], [[-0.1]]), "not passive"),
        (([[-1.0]], [[1.0]], [[-1.0]], [[0.0]]), "not passive"),
        (([[-1.0]], [[1.0, 2.0]], [[1.0]], [[0.0]]), r"B has the shape \(1, 2\), expected \(1, 1\)"),
    ],
)
def test_active_or_malformed_impedances_are_refused(parts, message):
    with pytest.raises(ValueError, match=message):
        Impedance(*parts)


# hands by their state space


def test_a_spring_inside_the_matrices_is_split_off():
    """The hand k/s + b + g/(1 + tau s) is given in coordinates that hide the spring k."""
    k, b, g, tau, mass = 250.0, 4.0, 12.0, 0.05, 0.3
    T = np.array([[1.0, 2.0], [-1.5, 0.5]])
    A, B, C = np.diag([0.0, -1 / tau]), np.array([[1.0], [g / tau]]), np.array([[k, 1.0]])
    port = state_space(T @ A @ np.linalg.inv(T), T @ B, C @ np.linalg.inv(T), b, mass)
    assert port.stiffness[0] == pytest.approx(k, rel=1e-12)
    assert port.impedance.order == 1
    for w in (0.3, 7.0, 200.0):
        s = 1j * w
        hand = mass * s + k / s + b + g / (1 + tau * s)
        assert felt(port, w) == pytest.approx(DEVICE.mass * s + DEVICE.damping + hand, rel=1e-9)


def test_a_pure_spring_and_damper_is_a_link():
    """A = 0 is one spring at any scale of B and C; with an empty A there is no spring, only the damper."""
    for A, link in (([[0.0]], Link(0.3, 4.0, 250.0)), (np.zeros((0, 0)), Link(0.3, 4.0, 0.0))):
        n = len(A)
        port = state_space(A, np.full((n, 1), 50.0), np.full((1, n), 5.0), 4.0, 0.3)
        for w in (1.0, 30.0):
            assert felt(port, w) == pytest.approx(felt(Human((link,)).port(), w), rel=1e-12)


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        (([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]], [[1.0, 0.0]], 1.0), "double eigenvalue at zero"),
        (([[0.0]], [[1.0]], [[-1.0]], 1.0), "stiffness has a negative"),
    ],
)
def test_no_negative_spring_is_split_off(parts, message):
    with pytest.raises(ValueError, match=message):
        state_space(*parts)


# hands by masses, springs and dampers


def hill(elastic=400.0, damping=9.0, tissue=0.004, parallel=150.0, mass=0.25):
    """Return Hill's muscle: a series elastic part, the contractile part's damping, a parallel spring, and masses."""
    across = [[-1, 1, 0], [0, -1, 1], [-1, 0, 1]]
    return Port([mass, tissue], across, [0.0, damping, 0.5], [elastic, 0.0, parallel], pull=1)


def test_the_plant_has_the_ports_matrices():
    port, d = hill(), DEVICE
    linear = plant(build([d], [Own(port)]).model)
    K = np.array([[400 + 150, -400], [-400, 400.0]])
    D = np.array([[0.9 + 0.5, 0], [0, 9.0]])
    M = np.diag([0.2 + 0.25, 0.004])
    np.testing.assert_allclose(linear.A[2:], -np.linalg.solve(M, np.hstack([K, D])), rtol=1e-12)
    # The voluntary force shortens the contractile part: it pulls the tissue towards the base.
    scene = build([d], [Own(port)])
    np.testing.assert_allclose(M @ linear.B[2:, scene.pushed[0]], [0, 1], rtol=0, atol=1e-12)


def test_levers_enter_the_plants_matrices():
    """A spring on a lever lengthens by 2 x_2 - x_1 / 2; another one by 3 x_2 alone."""
    port = Port([0.1, 0.5], [[-0.5, 2, 0], [0, 3, 0]], [1.0, 2.0], [100.0, 50.0])
    linear, M = plant(build([DEVICE], [Own(port)]).model), np.diag([0.3, 0.5])
    row, other = np.array([-0.5, 2.0]), np.array([0.0, 3.0])
    K = 100 * np.outer(row, row) + 50 * np.outer(other, other)
    D = 1 * np.outer(row, row) + 2 * np.outer(other, other) + np.diag([0.9, 0])
    np.testing.assert_allclose(linear.A[2:], -np.linalg.solve(M, np.hstack([K, D])), rtol=1e-12)


def test_bodies_and_state_space_agree():
    """The states are the elastic part's length e and the tissue's speed u, with e' = v - u."""
    tissue, elastic, damping = 0.004, 400.0, 9.0
    A = [[0.0, -1.0], [elastic / tissue, -damping / tissue]]
    port = state_space(A, [[1.0], [0.0]], [[elastic, 0.0]], 0.0)
    assert port.stiffness[0] == 0
    bodies = Port([0.0, tissue], [[-1, 1, 0], [0, -1, 1]], [0.0, damping], [elastic, 0.0])
    for device in (DEVICE, CompliantDevice()):
        for w in np.geomspace(0.1, 3000, 6):
            assert felt(port, w, device) == pytest.approx(felt(bodies, w, device), rel=1e-9)


MJCF = """<mujoco><worldbody>
  <body name="arm"><inertial pos="0 0 0" mass="1.2" diaginertia="1 1 1"/>
    <joint name="shoulder" type="slide" axis="1 0 0" stiffness="150" damping="8"/>
    <body name="handle"><inertial pos="0 0 0" mass="0.1" diaginertia="1 1 1"/>
      <joint name="wrist" type="slide" axis="1 0 0" stiffness="800" damping="5"/>
      <body name="ring"><inertial pos="0 0 0" mass="0.05" diaginertia="1 1 1"/></body>
    </body>
  </body>
</worldbody></mujoco>"""


def test_mjcf_hands_equal_their_chain():
    """The wrist joint connects the handle to the arm; the ring is welded to the handle."""
    port = from_mjcf(MJCF, pull="shoulder")
    chain = Human((Link(0.15, 5.0, 800.0), Link(1.2, 8.0, 150.0)))
    for w in np.geomspace(0.1, 300, 8):
        assert felt(port, w) == pytest.approx(felt(chain.port(), w), rel=1e-9)
    mine, theirs = (plant(build([DEVICE], [hand]).model) for hand in (Own(port), chain))
    pushed = build([DEVICE], [chain]).pushed[0]
    np.testing.assert_allclose(
        np.abs(mine.B[:, build([DEVICE], [Own(port)]).pushed[0]]), theirs.B[:, pushed], rtol=1e-12
    )


@pytest.mark.parametrize(
    ("was", "now", "message"),
    [
        ('axis="1 0 0" stiffness="150"', 'axis="0 1 0" stiffness="150"', "does not slide along x"),
        ('type="slide" axis="1 0 0" stiffness="800"', 'type="hinge" axis="1 0 0"', "does not slide along x"),
        ('damping="8"', 'damping="8" armature="0.1"', "friction or armature"),
        ('damping="8"', 'damping="8" frictionloss="0.1"', "friction or armature"),
        ('damping="8"', 'damping="8" springref="0.1"', "not at rest"),
        ('damping="8"', 'damping="8" range="-1 1" limited="true"', "a limit"),
        ('name="handle"', 'name="grip"', "no body 'handle' that slides; there are 'arm', 'grip'"),
        ("</mujoco>", '<actuator><motor joint="wrist"/></actuator></mujoco>', "an actuator"),
    ],
)
def test_mjcf_that_is_no_passive_network_is_refused(was, now, message):
    assert was in MJCF
    with pytest.raises(ValueError, match=message):
        from_mjcf(MJCF.replace(was, now))


# persons


def test_a_persons_arms_may_differ():
    """The plant obeys the nodal equations of hands and body, with one lagging arm and a cross spring."""
    g, tau, person = 12.0, 0.05, Person((1, 2), 3.0, 20.0, 700.0, Cross(1.0, 40.0))
    lags, link = state_space([[-1 / tau]], [[g / tau]], [[1.0]], 0.5, mass=0.25), Link(0.3, 3.0, 200.0)
    scene = build([DEVICE] * 2, [Own(lags), Human((link,))], [person])
    linear, n = plant(scene.model), scene.model.nv
    for w in (0.5, 5.0, 30.0):
        s = 1j * w
        ends = {(0, 2): g / (1 + tau * s) + 0.5, (1, 2): 3.0 + 200 / s, (0, 1): 1.0 + 40 / s}
        Z = np.diag([0.45 * s + 0.9, 0.5 * s + 0.9, 3 * s + 20 + 700 / s])
        for (a, b), between in ends.items():
            row = np.eye(3)[a] - np.eye(3)[b]
            Z += between * np.outer(row, row)
        x = np.linalg.solve(s * np.eye(len(linear.A)) - linear.A, -linear.B[:, -2:])[n : n + 2]
        np.testing.assert_allclose(x, np.linalg.inv(Z)[:2, :2], rtol=1e-9)


# stacks of hands


def test_crowds_stack_each_hands_matrices():
    rng = np.random.default_rng(5)
    devices = [CompliantDevice(), DEVICE]

    def lagging():
        tau, g = rng.uniform(0.01, 0.1), rng.uniform(1, 9)
        return Own(state_space([[-1 / tau]], [[1 / tau]], [[g]], rng.uniform(0, 2), rng.uniform(0.1, 1)))

    sets = [(Own(hill(elastic=k)), lagging()) for k in rng.uniform(100, 900, 6)]
    together = variants(devices, HumanSets(tuple(sets))).plants()
    for i, hands in enumerate(sets):
        alone = plant(build(devices, hands).model)
        # One plant divides by the masses, the other multiplies by their inverses.
        np.testing.assert_allclose(together.A[i], alone.A, rtol=1e-14)
        np.testing.assert_allclose(together.B[i], alone.B, rtol=1e-14)


def test_crowds_equal_their_humans_one_by_one():
    links = np.exp(np.random.default_rng(1).uniform(-1, 4, (5, 2, 2, 3)))
    bodies = np.exp(np.random.default_rng(2).uniform(-1, 4, (5, 1, 5)))
    crowd = Crowd(links, ((1, 2),), bodies)
    fast = variants([DEVICE] * 2, crowd)
    for i in range(5):
        one = variants([DEVICE] * 2, HumanSets((crowd.humans(i),), crowd.persons(i)))
        for name, rows in fast.fields.items():
            np.testing.assert_array_equal(rows[i], one.fields[name][0])


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: Port([0.1], [[-1, 1]], [-1.0], [0.0]), "damping has a negative or infinite entry"),
        (lambda: Port([0.1, 0.0], [[-1, 1, 0]], [1.0], [0.0]), "a positive mass at every other point"),
        (lambda: Port([0.1], [[0, 1]], [1.0], [0.0]), "at least one point"),
        (lambda: Port([0.1], np.zeros((0, 2)), [], []), "at least one point"),
        (lambda: Port([0.1], [[-1, 1]], [1.0, 2.0], [0.0]), r"damping has the shape \(2,\), expected \(1,\)"),
        (lambda: Port.stack([hill(), Human((Link(1, 1, 1),)).port()]), "the same points"),
        (lambda: build([DEVICE], [Own(Person((1, 2), 1, 1, 1).port())]), "has 2 handles, expected one"),
    ],
)
def test_impossible_ports_are_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call()


@pytest.mark.parametrize(("d", "b"), [(2.0, 1.5), (2.0, 2.0), (1.0, 1.5)])
def test_dead_times_take_their_pade_form(d, b):
    """d + b (1 - s tau/2)/(1 + s tau/2) equals d + b exp(-s tau) within b (w tau)^3/12; it is passive if d >= b."""
    tau = 0.05
    parts = [[-2 / tau]], [[1.0]], [[4 * b / tau]], d - b
    if d < b:
        with pytest.raises(ValueError, match="not passive"):
            state_space(*parts)
        return
    port = state_space(*parts)
    for w in (0.5, 2.0, 8.0):
        assert felt(port, w) - DEVICE.mass * 1j * w - DEVICE.damping == pytest.approx(
            d + b * np.exp(-1j * w * tau), abs=1.01 * b * (w * tau) ** 3 / 12
        )
