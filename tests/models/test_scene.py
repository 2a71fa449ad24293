"""Matrices that are read from MuJoCo equal those of the equations of motion, and are passive."""

import mujoco
import numpy as np
import pytest
from scipy.linalg import expm

from haptic_loop.models.device import CompliantDevice, RigidDevice
from haptic_loop.models.human import Cross, Human, Link, Person, Population, Voluntary
from haptic_loop.models.scene import _FILES, build, plant

HAND = Human((Link(0.3, 3.0, 200.0),))
ARM = Human((Link(0.1, 5.0, 800.0), Link(1.0, 8.0, 150.0)))


def test_compliant_device_is_a_two_mass_oscillator():
    d, h = CompliantDevice(transmission_damping=0.2), HAND.links[0]
    linear = plant(build([d], [HAND]).model)
    M = np.diag([d.motor_mass, d.handle_mass + h.mass])
    k, c = d.transmission_stiffness, d.transmission_damping
    K = np.array([[k, -k], [-k, k + h.stiffness]])
    D = np.array([[d.damping + c, -c], [-c, c + h.damping]])
    np.testing.assert_allclose(linear.A[2:, :2], -np.linalg.solve(M, K), rtol=1e-12)
    np.testing.assert_allclose(linear.A[2:, 2:], -np.linalg.solve(M, D), rtol=1e-12)
    # The device feels -f; the external force acts on the handle.
    np.testing.assert_allclose(linear.B[2:], [[0, -1 / d.motor_mass], [1 / (d.handle_mass + h.mass), 0]], rtol=1e-12)
    np.testing.assert_array_equal(linear.C, [[1, 0, 0, 0]])


def test_a_rigid_device_and_arm_match_their_equations():
    d, (hand, arm) = RigidDevice(), ARM.links
    linear = plant(build([d], [ARM]).model)
    M = np.diag([d.mass + hand.mass, arm.mass])
    K = np.array([[hand.stiffness, -hand.stiffness], [-hand.stiffness, hand.stiffness + arm.stiffness]])
    D = np.array([[d.damping + hand.damping, -hand.damping], [-hand.damping, hand.damping + arm.damping]])
    np.testing.assert_allclose(linear.A[2:], -np.linalg.solve(M, np.hstack([K, D])), rtol=1e-12)
    np.testing.assert_allclose(linear.B[2:], [[1 / M[0, 0], 0, -1 / M[0, 0]], [0, 1 / arm.mass, 0]], rtol=1e-12)


def test_several_channels_do_not_touch_each_other():
    devices, humans = [CompliantDevice(), RigidDevice(), CompliantDevice(motor_mass=0.1)], [HAND, ARM, HAND]
    scene = build(devices, humans)
    together = plant(scene.model)
    names = [scene.model.joint(j).name for j in range(scene.model.njnt)]
    assert names == [
        "device_1/motor",
        "device_2/motor",
        "device_3/motor",
        "device_1/handle",
        "device_3/handle",
        "human_2_2",
    ]
    n = len(names)
    for i, (device, human) in enumerate(zip(devices, humans, strict=True), start=1):
        mine = [j for j, name in enumerate(names) if f"_{i}" in name[:8]]
        alone = plant(build([device], [human]).model)
        rows = [*mine, *(n + j for j in mine)]
        np.testing.assert_allclose(together.A[np.ix_(rows, rows)], alone.A, rtol=1e-12)
        others = [r for r in range(2 * n) if r not in rows]
        assert not together.A[np.ix_(rows, others)].any()


TWO_HANDS = Person((1, 2), 20.0, 15.0, 900.0, Cross(2.0, 60.0))


def test_a_person_is_two_arms_on_one_body():
    """The plant equals matrices written by hand, for rigid devices and arms of one and two links."""
    d, (one,), (near, far), p = RigidDevice(), HAND.links, ARM.links, TWO_HANDS
    scene = build([d, d], [HAND, ARM], [p])
    linear = plant(scene.model)
    assert [scene.model.joint(j).name for j in range(4)] == ["device_1/motor", "device_2/motor", "human_2_2", "body_1"]
    M = np.diag([d.mass + one.mass, d.mass + near.mass, far.mass, p.mass])

    def springs(a, b, c, body, cross):
        """Return the stiffness matrix; a joins hand 1 and body, b joins hand 2 and arm 2, c joins arm 2 and body."""
        return np.array(
            [
                [a + cross, -cross, 0, -a],
                [-cross, b + cross, -b, 0],
                [0, -b, b + c, -c],
                [-a, 0, -c, a + c + body],
            ]
        )

    K = springs(one.stiffness, near.stiffness, far.stiffness, p.stiffness, p.cross.stiffness)
    D = springs(one.damping, near.damping, far.damping, p.damping, p.cross.damping) + np.diag([d.damping] * 2 + [0, 0])
    np.testing.assert_allclose(linear.A[4:], -np.linalg.solve(M, np.hstack([K, D])), rtol=1e-12)
    # A muscle acts between an arm's last link and the body; taps act on the hands.
    pushed = M @ linear.B[4:][:, list(scene.pushed)]
    np.testing.assert_allclose(pushed, [[1, 0], [0, 0], [0, 1], [-1, -1]], rtol=0, atol=1e-12)
    tapped = M @ linear.B[4:][:, list(scene.tapped)]
    np.testing.assert_allclose(tapped, [[1, 0], [0, 1], [0, 0], [0, 0]], rtol=0, atol=1e-12)


def test_a_heavy_body_acts_as_ground():
    separate = plant(build([CompliantDevice()] * 2, [HAND, ARM]).model).A
    held = plant(build([CompliantDevice()] * 2, [HAND, ARM], [Person((1, 2), 1e3, 1e6, 1e9)]).model).A
    n = separate.shape[0] // 2
    rows = [*range(n), *range(n + 1, 2 * n + 1)]  # all joints but the last, the body's
    np.testing.assert_array_equal(held[np.ix_(rows, rows)], separate)
    body = [n, 2 * n + 1]
    # Of the other joints, only the arms' springs and dampers act on the body.
    assert np.abs(held[2 * n + 1, rows]).max() == HAND.links[0].stiffness / 1e3
    assert held[2 * n + 1, body[0]] == pytest.approx(-1e9 / 1e3, rel=1e-6)


@pytest.mark.parametrize("seed", range(4))
def test_a_person_in_both_hands_is_passive(seed):
    """The Hermitian part of the impedance at the handles is positive, or zero without damping."""
    rng = np.random.default_rng(seed)
    humans = Population(links=int(rng.integers(1, 3))).draw(rng, 2)
    mass, damping, stiffness, cd, ck = np.exp(rng.uniform(-2, 4, 5))
    light = RigidDevice(mass=1e-6, damping=0.0)
    lossless = [Human(tuple(Link(x.mass, 0.0, x.stiffness) for x in h.links)) for h in humans]
    for people, person, lost in (
        (humans, Person((1, 2), mass, damping, stiffness, Cross(cd, ck)), True),
        (lossless, Person((1, 2), mass, 0.0, stiffness, Cross(0.0, ck)), False),
    ):
        linear = plant(build([light, light], people, [person]).model)
        n = linear.A.shape[0] // 2
        for w in np.geomspace(0.3, 3e3, 20):
            velocity = np.linalg.solve(1j * w * np.eye(2 * n) - linear.A, -linear.B[:, -2:])[n : n + 2]
            impedance = np.linalg.inv(velocity)
            hermitian = np.linalg.eigvalsh(impedance + impedance.conj().T) / 2
            # rounding of the inverses, relative to the impedance
            noise = 1e-9 * np.abs(impedance).max()
            assert (hermitian > noise).all() if lost else np.abs(hermitian).max() < noise


@pytest.mark.parametrize("persons", [(), (TWO_HANDS,)], ids=["apart", "held together"])
def test_mujoco_accelerates_as_the_matrices_say(persons):
    scene = build([CompliantDevice(), RigidDevice()], [ARM, HAND], persons)
    linear, model = plant(scene.model), scene.model
    data = mujoco.MjData(model)
    rng = np.random.default_rng(0)
    data.qpos[:], data.qvel[:], data.ctrl[:] = rng.normal(size=model.nq), rng.normal(size=model.nv), 1.0
    mujoco.mj_forward(model, data)
    expected = linear.A @ np.concatenate([data.qpos, data.qvel]) + linear.B @ data.ctrl
    np.testing.assert_allclose(data.qacc, expected[model.nv :], rtol=1e-12)


@pytest.mark.parametrize("seed", range(8))
def test_without_input_the_energy_never_increases(seed):
    rng = np.random.default_rng(seed)
    humans = Population(links=int(rng.integers(1, 4))).draw(rng, 2)
    model = build([CompliantDevice(), RigidDevice()], humans).model
    linear, n = plant(model), model.nv
    mass = np.zeros((n, n))
    mujoco.mj_fullM(model, _forward(model), mass)
    stiffness = -mass @ linear.A[n:, :n]
    step = expm(linear.A * 1e-3)
    s = rng.normal(size=2 * n)
    energies = []
    for _ in range(200):
        energies.append(s[n:] @ mass @ s[n:] / 2 + s[:n] @ stiffness @ s[:n] / 2)
        s = step @ s
    assert (np.diff(energies) <= 1e-12 * energies[0]).all()
    assert np.linalg.eigvalsh(stiffness).min() >= -1e-9


@pytest.mark.parametrize("seed", range(5))
def test_the_motor_port_dissipates_its_damping(seed):
    """Re Z is at least the damping at every frequency, whoever holds the handle of the compliant device."""
    human = Population(links=2).draw(np.random.default_rng(seed), 1)
    linear = plant(build([CompliantDevice()], human).model)
    n = linear.A.shape[0] // 2
    for w in np.geomspace(0.1, 1e4, 60):
        response = np.linalg.solve(1j * w * np.eye(2 * n) - linear.A, -linear.B[:, -1:])
        impedance = 1 / response[n, 0]
        assert impedance.real >= 1.37 * (1 - 1e-9)


def _forward(model):
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return data


def test_guaranteed_damping_is_the_damping_unless_bounded():
    assert CompliantDevice().passivity_level == 1.37
    assert RigidDevice(damping=2.0, delta=1.5).passivity_level == 1.5
    assert RigidDevice(damping=2.0, delta=1.5).with_damping(0.7).passivity_level == 0.7


def test_population_is_log_uniform_and_reproducible():
    draw = Population().draw(np.random.default_rng(3), 4000)
    assert draw == Population().draw(np.random.default_rng(3), 4000)
    masses = np.log([h.links[0].mass for h in draw])
    low, high = np.log([0.01, 3.0])
    assert low <= masses.min()
    assert masses.max() <= high
    # mean and spread of a uniform distribution, to five and four standard errors
    assert abs(masses.mean() - (low + high) / 2) < 5 * (high - low) / np.sqrt(12 * 4000)
    assert abs(masses.std() - (high - low) / np.sqrt(12)) < 0.05


def test_voluntary_velocity_is_the_motions_derivative():
    t = np.linspace(0, 3, 30001)
    hand = Voluntary(0.015, 0.6, 0.6, 1.0)
    x, v = hand.force(t, 1.0, 0.0), hand.force(t, 0.0, 1.0)
    # At the fade's end the acceleration jumps by at most amplitude (pi/ease)^2/2. There a central difference over steps
    # of 0.1 ms errs by a quarter of the jump times the step, 1.85e-6 m/s; elsewhere it errs by 3e-9 m/s.
    np.testing.assert_allclose(np.gradient(x, t)[1:-1], v[1:-1], rtol=0, atol=2e-6)
    assert (x[0], v[0]) == (0.0, 0.0)
    np.testing.assert_allclose(np.abs(x).max(), 0.015, rtol=1e-6)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: CompliantDevice(motor_mass=-1.0), "motor_mass is -1.*1e-09 to 1000 kg"),
        (lambda: RigidDevice(mass=float("nan")), "mass is nan"),
        (lambda: RigidDevice(delta=2.0), r"delta is 2 N s/m.*values in \(0, damping = 1.37\]"),
        (lambda: Link(0.1, -1.0, 1.0), "damping is -1"),
        (lambda: Human((Link(0.1, 1.0, 1.0), Link(0.0, 1.0, 1.0))), r"links #2.mass is 0"),
        (lambda: Population(mass=(1.0, 0.1)), r"mass #2 is 0.1.*1 to"),
        (lambda: Person((1,), 1.0, 0.0, 0.0), r"holds is \[1\], expected two or more different devices"),
        (lambda: Person((1, 1), 1.0, 0.0, 0.0), r"holds is \[1, 1\]"),
        (lambda: Person((1, 2), 0.0, 0.0, 0.0), "mass is 0.*1e-06 to 1000 kg"),
        (lambda: Person((1, 2), 1.0, -1.0, 0.0), "damping is -1"),
        (lambda: Cross(stiffness=-1.0), "stiffness is -1"),
        (lambda: build([RigidDevice()], [HAND], [TWO_HANDS]), r"person #1.holds has device 2.*1 to 1"),
        (
            lambda: build([RigidDevice()] * 2, [HAND] * 2, [TWO_HANDS] * 2),
            "device 1, which another person holds already",
        ),
        (lambda: build([RigidDevice()], []), "1 devices and 0 humans"),
    ],
)
def test_impossible_bodies_cannot_be_built(call, message):
    with pytest.raises(ValueError, match=message):
        call()


@pytest.mark.parametrize(("name", "device"), [("compliant", CompliantDevice()), ("rigid", RigidDevice())])
def test_device_files_equal_their_assembled_scene(name, device):
    """A device's MJCF file has the matrices, the limit and the names of the device with a usual hand."""
    drawn = mujoco.MjModel.from_xml_path(str(_FILES / f"{name}.xml"))
    assembled = build([device], [Human((Link(0.3, 3.0, 200.0),))])
    ours, theirs = plant(assembled.model), plant(drawn)
    np.testing.assert_array_equal(theirs.A, ours.A)
    np.testing.assert_array_equal(theirs.B, ours.B)
    assert drawn.actuator("force").ctrlrange.tolist() == [-device.force_limit, device.force_limit]
    parts = {drawn.geom(g).name for g in range(drawn.ngeom)}
    assert parts >= {"motor", "handle", "hand"}
    assert {drawn.tendon(t).name for t in range(drawn.ntendon)} == (
        {"transmission", "drawn transmission"} if name == "compliant" else set()
    )
    assert not drawn.opt.gravity.any()
    assert drawn.opt.disableflags == assembled.model.opt.disableflags


def test_saved_scenes_reopen_with_equal_matrices():
    scene = build([CompliantDevice(damping=2.0), RigidDevice(mass=0.4)], [ARM, HAND], [TWO_HANDS])
    opened = mujoco.MjModel.from_xml_string(scene.xml)
    np.testing.assert_allclose(plant(opened).A, plant(scene.model).A, rtol=1e-14)
    np.testing.assert_allclose(plant(opened).B, plant(scene.model).B, rtol=1e-14)
    assert scene.model.ngeom == 0
    shown = {opened.body(int(b)).name for b in opened.geom_bodyid}
    assert shown == {scene.model.body(b).name for b in range(1, scene.model.nbody)}
    assert not opened.geom_contype.any()
    assert "<default" not in scene.xml
