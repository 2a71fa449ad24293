"""MuJoCo scenes obey the step of models.world and the lemma of docs/theory.md, equal linear models, or are refused."""

from pathlib import Path

import mujoco
import numpy as np
import pytest
from shared import environment_by_hand

from haptic_loop.controller.coupling import MovingAverage, SpringDamper
from haptic_loop.controller.environment import Network, Spring
from haptic_loop.controller.lti import Lti
from haptic_loop.models.scene import quiet_warnings
from haptic_loop.models.world import Contact, Rows, World, digest_of, files_of, touchable_bodies

T = 1e-3
FREE = '<geom type="sphere" size="0.005" contype="0" conaffinity="0"/>'
#: contact - 800 N/m - 1 kg - 700 N/m - contact, all along x and without gravity
LINE = f"""<mujoco><option gravity="0 0 0"/><worldbody>
<body name="left" pos="-0.1 0 0">{FREE}<site name="l"/></body>
<body name="right" pos="0.1 0 0">{FREE}<site name="r"/></body>
<body name="block"><joint type="slide" axis="1 0 0"/>
<geom type="box" size="0.01 0.01 0.01" mass="1"/><site name="b"/></body>
</worldbody><tendon>
<spatial stiffness="800" damping="1"><site site="l"/><site site="b"/></spatial>
<spatial stiffness="700" damping="2"><site site="b"/><site site="r"/></spatial></tendon></mujoco>"""
#: the network of LINE, with the mass of 30 g that the program gives each contact
NETWORK = Network(
    ("left", "right"),
    (Spring(("left", "block"), 800.0, 1.0), Spring(("block", "right"), 700.0, 2.0)),
    {"block": 1.0, "left": 0.03, "right": 0.03},
)
COUPLINGS = (
    SpringDamper([1500.0, 900.0], [0.5, 0.8]),
    MovingAverage([1e-4, 2e-4], (2, 3), [1e-4, 1e-4]),
)


def world(folder: Path, text: str, contacts=("left", "right"), G=(1500.0, 900.0), **options) -> World:
    """Return the world of an MJCF text; each contact moves along the directions `along` and has a spring of G."""
    path = folder / "scene.xml"
    path.write_text(text)
    along = options.pop("along", ((1.0, 0.0, 0.0),))
    springs = [np.atleast_2d(g) for g in G]
    return World(path, [Contact(name, along) for name in contacts], springs, options.pop("T", T), **options)


# The step


@pytest.mark.parametrize("coupling", COUPLINGS)
def test_a_linear_scene_equals_its_network(tmp_path, coupling):
    """Behind a coupling the scene sends the network's forces for one second, and u = x - V f.

    Tendon springs are longer by 1e-12 of 0.1 m, which is at most 8e-11 N. Rounding of lengths adds 1e-14 N a tick.
    """
    V = coupling.compliance(T)
    port = world(tmp_path, LINE, G=1 / np.diag(V.D)).port()
    F = coupling.around(NETWORK.E(T))
    state, inner = np.zeros(F.order), np.zeros(V.order)
    for k in range(1000):
        x = 0.01 * np.sin(2 * np.pi * np.array([1.0, 1.7]) * k * T) + 0.001 * (k > 500)
        force = port.step(x - V.C @ inner)
        u = x - (V.C @ inner + V.D @ force)
        assert np.abs(port.u - u).max() < 1e-12
        assert np.abs(force - (F.C @ state + F.D @ x)).max() < 1e-9
        inner, state = V.A @ inner + V.B @ force, F.A @ state + F.B @ x


def test_limited_forces_are_felt_by_the_scene(tmp_path):
    """Free contacts obey v+ = v + h f/m, where f = G (u0 - u) is clipped at its limit."""
    text = f'<mujoco><worldbody><body name="left">{FREE}</body><body name="right">{FREE}</body></worldbody></mujoco>'
    port, limit = world(tmp_path, text).port([3.0, 5.0]), np.array([3.0, 5.0])
    v, u, hit = np.zeros(2), np.zeros(2), np.zeros(2, int)
    for k in range(500):
        goal = 0.02 * np.sin(2 * np.pi * np.array([20.0, 30.0]) * k * T)
        force = port.step(goal)
        stiff = np.array([1500.0, 900.0])
        free = stiff * (goal - u - T * v) / (1 + stiff * T**2 / 0.03)  # solved for the end of the step
        expected = np.clip(free, -limit, limit)
        assert np.abs(force - expected).max() < 1e-9
        hit += np.abs(expected) == limit
        v = v + T * expected / 0.03
        u = u + T * v
        assert np.abs(port.u - u).max() < 1e-11
    assert hit.min() > 50
    assert port.unsettled == 0


@pytest.mark.slow
@pytest.mark.parametrize("radial", [True, False])
def test_limited_forces_in_a_plane_are_felt(tmp_path, radial):
    """m (v+ - v)/h equals the force, which is G (u0 - u) limited to a ball or a box."""
    text = f'<mujoco><worldbody><body name="tip">{FREE}</body><body name="one">{FREE}</body></worldbody></mujoco>'
    path = tmp_path / "scene.xml"
    path.write_text(text)
    plane = ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0))
    G = np.array([[900.0, 300.0, 0.0], [300.0, 400.0, 0.0], [0.0, 0.0, 700.0]])
    scene = World(path, [Contact("tip", plane), Contact("one")], [G[:2, :2], G[2:, 2:]], T)
    port, limits = scene.port([3.0, 3.0, 2.0], [slice(0, 2)] * radial), np.array([3.0, 3.0, 2.0])

    def within(force):
        inside = np.clip(force, -limits, limits)
        if radial and np.linalg.norm(force[:2]) > 3.0:
            inside[:2] = force[:2] * 3.0 / np.linalg.norm(force[:2])
        return inside

    v, u, hit, inner = np.zeros(3), np.zeros(3), 0, 0
    for k in range(1500):
        goal = 0.02 * np.sin(2 * np.pi * np.array([20.0, 17.0, 30.0]) * k * T)
        force = port.step(goal)
        v = v + T * force / 0.03
        u = u + T * v
        assert np.abs(port.u - u).max() < 1e-11
        spring = G @ (goal - u)
        assert np.abs(force - within(spring)).max() < 1e-5  # a limited force is turned by less than 1e-6 of its limit
        hit += np.abs(force - spring)[:2].max() > 1e-3
        inner += np.abs(force - spring)[:2].max() < 1e-9
    assert min(hit, inner) > 20
    assert port.unsettled == 0


def test_a_slow_scene_stands_still_between_its_steps(tmp_path):
    port = world(tmp_path, LINE, every=4).port()
    assert port.world.h == 4 * T
    before = port.u
    for k in range(100):
        goal = 0.01 * np.sin(2 * np.pi * np.array([1.0, 1.7]) * k * T)
        force = port.step(goal)
        moved = np.abs(port.u - before).max() > 0
        assert not moved or k % 4 == 0
        np.testing.assert_allclose(force, [1500.0, 900.0] * (goal - port.u), rtol=0, atol=1e-12)
        before = port.u


def test_two_axes_take_a_full_spring_matrix(tmp_path):
    """With a full matrix G a free contact obeys m (v+ - v)/h = G (u0 - u) in both directions."""
    text = f'<mujoco><worldbody><body name="tip" euler="20 30 40">{FREE}</body></worldbody></mujoco>'
    G = np.array([[900.0, 300.0], [300.0, 400.0]])
    port = world(tmp_path, text, ["tip"], [G], along=((1.0, 0.0, 0.0), (0.0, 0.0, 1.0))).port()
    v, u = np.zeros(2), np.zeros(2)
    for k in range(500):
        goal = 0.01 * np.sin(2 * np.pi * np.array([1.0, 1.7]) * k * T)
        force = port.step(goal)
        v = np.linalg.solve(np.eye(2) + T**2 / 0.03 * G, v + T / 0.03 * G @ (goal - u))
        u = u + T * v
        np.testing.assert_allclose(port.u, u, rtol=0, atol=1e-13)
        np.testing.assert_allclose(force, G @ (goal - u), rtol=0, atol=1e-10)
        tip = port.data.body("tip").xpos
        np.testing.assert_allclose(tip, [u[0], 0.0, u[1]], rtol=0, atol=1e-13)


def test_released_energy_is_that_of_gravity_and_springs(tmp_path):
    """A body on a spring falls; the contact beside it has no weight, and its spring G does not count."""
    text = f"""<mujoco><worldbody><body name="left">{FREE}</body><body name="right">{FREE}</body>
    <body name="load" pos="0.5 0 0"><joint type="slide" axis="0 0 1" stiffness="20"/>
    <geom type="sphere" size="0.01" mass="0.5"/></body></worldbody></mujoco>"""
    port = world(tmp_path, text, along=((0.0, 0.0, 1.0),)).port()
    most = 0.0
    for _ in range(300):
        port.step(np.array([0.3, -0.2]))
        z = port.data.qpos[port.world.model.joint(2).qposadr[0]]
        most = max(most, -(0.5 * 9.81 * z + 20 * z**2 / 2))
        assert port.released == pytest.approx(most, abs=1e-12)
    assert most > 0.2


# The lemma

#: condim, impratio, d of solimp, solref, solreffriction of all contacts
SCENES = (
    (1, 1, 0.9, "0.01 1", None),
    (3, 1, 0.01, "0.01 1", None),
    (3, 10, 0.9, "0.02 1", None),
    (4, 1, 0.99, "0.005 1", None),
    (6, 10, 0.5, "0.01 0.5", None),
    (6, 1, 0.95, "-2000 -100", "-100 -3000"),
)
PAIRS = (("floor", "cube"), ("f1", "cube"), ("f2", "cube"), ("f1", "floor"), ("f2", "floor"), ("f1", "f2"))


def scene_of_the_lemma(condim, impratio, d, solref, friction) -> str:
    more = f'solreffriction="{friction}"' if friction else ""
    how = f'condim="{condim}" friction="0.6 0.5 0.02 0.001 0.001" solimp="{d} {d} 0.001" solref="{solref}" {more}'
    pairs = "".join(f'<pair geom1="{one}" geom2="{other}" {how}/>' for one, other in PAIRS)
    return f"""<mujoco><option impratio="{impratio}"/><worldbody><geom name="floor" type="plane" size="1 1 .1"/>
<body name="left" pos="-0.05 0 0.02"><geom name="f1" type="sphere" size="0.01"/></body>
<body name="right" pos="0.05 0 0.03"><geom name="f2" type="capsule" size="0.01 0.01"/></body>
<body name="cube" pos="0 0 0.03"><joint type="slide" axis="1 0 0"/>
<joint type="slide" axis="0 1 0" stiffness="50" damping="0.2" frictionloss="0.3" solimpfriction="0.9 0.9"/>
<joint type="slide" axis="0 0 1"/><geom name="cube" type="box" size="0.03 0.03 0.03" mass="0.3"/></body>
</worldbody><contact>{pairs}</contact></mujoco>"""


def count_of_the_lemma(folder: Path, scene, ticks: int) -> int:
    """Push two contacts at random, check every constraint of each tick, and return the number of constraints."""
    along = ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0))
    G = ([[800.0, 100.0], [100.0, 300.0]], [[700.0, 0.0], [0.0, 500.0]])
    port = world(folder, scene_of_the_lemma(*scene), G=G, along=along).port()
    rng, u0, v, count, created = np.random.default_rng(1), np.zeros(4), np.zeros(4), 0, 0.0
    for _ in range(ticks):
        v = 0.98 * v + 0.1 * rng.normal(size=4) - 0.1 * u0
        u0 = u0 + T * v
        force = port.step(u0 + np.array([0.015, 0.0, -0.015, 0.0]))
        data = port.data
        if not data.nefc:
            continue
        rows = Rows.of(port.world.model, data)
        inside = [np.where(rows.one_sided, np.minimum(r, 0), r) for r in (rows.depth, rows.depth + T * rows.after)]
        before, after = (rows.D * rows.K * r**2 / 2 for r in inside)  # energy [J] that the contacts store
        excess = rows.excess(T)
        by_hand = np.add.reduceat(T * rows.force * rows.after + after - before, rows.first)
        np.testing.assert_allclose(excess, by_hand, rtol=0, atol=1e-15)  # rounding of terms up to 1 J
        bound = np.add.reduceat(rows.D * data.efc_vel**2 / (4 * (1 + rows.b * T)), rows.first)
        assert (excess <= bound + 1e-15).all()  # rounding of terms up to 1 J
        created += np.maximum(excess, 0.0).sum()
        count += len(excess)
    assert port.created == pytest.approx(created, rel=1e-9)
    assert np.isfinite(force).all()
    return count


@pytest.mark.parametrize("scene", SCENES)
def test_a_contact_creates_no_more_than_the_lemma(tmp_path, scene):
    """tests/checks/test_worlds.py checks more than 120,000 constraints."""
    assert count_of_the_lemma(tmp_path, scene, 300) > 500


def test_friction_loss_takes_more_than_it_creates(tmp_path):
    """Two contacts push a body with 2 N of friction loss to and fro; the port never delivers energy."""
    loss = '<joint type="slide" axis="1 0 0" frictionloss="2"/>'
    tips = "".join(
        f'<body name="{n}" pos="{x} 0 0"><geom size="0.01"/></body>' for n, x in (("left", -4e-2), ("right", 4e-2))
    )
    box = f'<body>{loss}<geom type="box" size="0.03 0.03 0.03" mass="0.2" solimp="0.9 0.9"/></body>'
    port = world(tmp_path, f"<mujoco><worldbody>{tips}{box}</worldbody></mujoco>", G=(1500.0, 1500.0)).port()
    rng, u0, v, at_port, before = np.random.default_rng(0), np.zeros(2), np.zeros(2), 0.0, port.u
    for _ in range(1500):
        v = 0.98 * v + 0.1 * rng.normal(size=2) - 0.1 * u0
        u0 = u0 + T * v
        force = port.step(u0 + np.array([0.015, -0.015]))
        at_port, before = at_port + force @ (port.u - before), port.u
        assert at_port >= -1e-12
    assert 0.1 < port.created < at_port / 3


@pytest.mark.parametrize("scene", SCENES[:5])
def test_rows_follow_the_law_of_the_lemma(tmp_path, scene):
    """A one-sided row that presses has f = -D ((w+ - w)/h + b w+ + K (r + h w+)); for other rows this is <= 0.

    No row is in a friction cone.
    """
    port = world(tmp_path, scene_of_the_lemma(1, *scene[1:])).port()
    pressed = 0
    for k in range(300):
        port.step(np.array([0.03, -0.03]) * np.sin(0.02 * k))
        r = Rows.of(port.world.model, port.data) if port.data.nefc else None
        if r is None:
            continue
        law = -r.D * ((r.after - port.data.efc_vel) / T + r.b * r.after + r.K * (r.depth + T * r.after))
        inside = r.one_sided & (r.force > 0)
        np.testing.assert_allclose(r.force[inside], law[inside], rtol=1e-6, atol=1e-6)  # the solver's tolerance
        assert (law[r.one_sided & (r.force == 0)] <= 1e-6).all()
        pressed += inside.sum()
    assert pressed > 100


# A linear model


def test_linear_scenes_linearise_to_their_network(tmp_path):
    """E(z) agrees from 0.1 to 100 Hz to 1e-12 of its largest value, for two steps of the finite differences."""
    scene, z = world(tmp_path, LINE), np.exp(2j * np.pi * np.geomspace(0.1, 100, 60) * T)
    E = environment_by_hand(NETWORK, z, T)
    for step in (1e-4, 1e-2):
        ours = Lti(*scene.linear(step=step), T).inverse().at(z[None])[0]
        assert np.abs(ours - E).max() < 1e-12 * np.abs(E).max()


@pytest.mark.parametrize("ref", ["0", "0.1"])
def test_a_fixed_tendon_at_rest_pulls_back(tmp_path, ref):
    """A joint with 1 kg on a tendon spring of 1e5 N/m has the speed v / (1 + k h^2/m) after a discrete step."""
    joint = f'<joint name="j" type="slide" axis="1 0 0" ref="{ref}"/>'
    load = f'<body name="load" pos="0.2 0 0">{joint}<geom size=".01" mass="1" contype="0" conaffinity="0"/></body>'
    text = f'<mujoco><option gravity="0 0 0"/><worldbody><body name="tip">{FREE}</body>{load}</worldbody>'
    text += '<tendon><fixed stiffness="1e5"><joint joint="j" coef="1"/></fixed></tendon></mujoco>'
    A, _, _, _ = world(tmp_path, text, ["tip"], [1000.0]).linear()
    assert A[3, 3] == pytest.approx(1 / (1 + 1e5 * T**2), abs=1e-6)


def test_the_linear_model_is_mujocos_own_derivative(tmp_path):
    """`linear` equals mjd_transitionFD of the same step without the springs G, at a pose in contact."""
    scene = world(tmp_path, scene_of_the_lemma(1, 1, 0.9, "0.01 1", None))
    pose = scene.model.qpos0.copy()
    pose[-1] = -2e-4
    A, B, _, _ = scene.linear(pose, 1e-7)
    model, data = scene.model, mujoco.MjData(scene.model)
    model.jnt_stiffness[:2] = 0.0
    data.qpos[:] = pose
    n = 2 * model.nv
    theirs = np.zeros((n, n))
    mujoco.mjd_transitionFD(model, data, 1e-7, True, theirs, None, None, None)
    unit = np.repeat([1.0, T], model.nv)  # our states are (q, h v)
    assert np.abs(A - unit[:, None] * theirs / unit).max() < 2e-9  # 0.1 m rounded over steps of 1e-7 makes 1e-10
    assert B.shape == (n, 2)


@pytest.mark.filterwarnings("ignore:flex")  # MuJoCo warns of a flex whose elasticity it does integrate
def test_soft_bodies_lose_energy_and_are_listed(tmp_path):
    """MuJoCo's sensors leave elastic energy out, so that it never counts as released."""
    text = f"""<mujoco><option gravity="0 0 0"/><worldbody><body name="left" pos="-1 0 0">{FREE}</body>
    <body name="right" pos="1 0 0">{FREE}</body>
    <flexcomp name="soft" type="grid" count="3 3 3" spacing="0.03 0.03 0.03" radius="0.005" dim="3" mass="0.3"
    dof="trilinear"><elasticity young="1e4" poisson="0.2"/></flexcomp></worldbody></mujoco>"""
    port = world(tmp_path, text).port()
    model, data = port.world.model, port.data
    data.qvel[2:] = 0.3 * np.random.default_rng(0).normal(size=model.nv - 2)
    kinetic = []
    for _ in range(300):
        port.step(np.zeros(2))
        mujoco.mj_energyVel(model, data)
        kinetic.append(data.energy[1])
    assert max(kinetic) <= kinetic[0]
    assert min(kinetic) < 0.9 * kinetic[0]
    assert port.released == 0.0
    assert [part.what for part in port.world.parts() if "bodies" in part.what] == ["soft bodies"]


# Masses and refusals


@pytest.mark.parametrize("gravity", ['<option><flag gravity="disable"/></option>', '<option gravity="0 0 0"/>', ""])
def test_a_lifted_contact_releases_nothing(tmp_path, gravity):
    """A contact has no weight, whatever the scene's gravity: nothing falls here."""
    port = world(tmp_path, with_body(f'<body name="left">{FREE}</body>', gravity), along=((0.0, 0.0, 1.0),)).port()
    for k in range(100):
        port.step(np.array([0.002, 0.001]) * k)
    assert port.u.min() > 0.09
    assert port.released < 1e-15


@pytest.mark.parametrize("compiler", ['inertiafromgeom="true"', 'inertiafromgeom="auto"', 'fusestatic="true"'])
def test_masses_are_those_of_the_scene(tmp_path, compiler):
    """Masses equal MuJoCo's, even if MuJoCo takes them from geoms instead of the inertial; contacts weigh 30 g."""
    load = '<inertial pos="0 0 0" mass="5" diaginertia="1 1 1"/><geom name="load" size="0.01" mass="0.2"/>'
    text = with_body(f'<body name="left">{FREE}</body><body name="load"><joint type="slide"/>{load}</body>')
    text = text.replace("<worldbody>", f"<compiler {compiler}/><worldbody>")
    model = world(tmp_path, text).model
    assert model.body("load").mass == mujoco.MjModel.from_xml_string(text).body("load").mass
    assert model.body("left").mass == pytest.approx(0.03, abs=1e-15)


def test_scenes_mujoco_cannot_step_get_one_line(tmp_path):
    box = '<body name="load"><freejoint/><geom type="box" size="0.1 0.1 0.1"/></body><geom type="plane" size="1 1 1"/>'
    text = with_body(f'<body name="left">{FREE}</body>{box}', '<size memory="1K"/>')
    with pytest.raises(ValueError, match=r"increase <size memory") as caught:
        world(tmp_path, text)
    assert "\n" not in str(caught.value)


def test_a_diverging_scene_is_reported(tmp_path):
    driven = '<body name="load"><joint name="j" type="slide"/><geom size="0.1"/></body>'
    drive = '<actuator><velocity joint="j" kv="-1e5"/></actuator>'
    port = world(tmp_path, with_body(f'<body name="left" pos="0 0 1">{FREE}</body>{driven}', drive)).port()
    with quiet_warnings():
        for _ in range(400):
            port.step(np.zeros(2))
    assert any("Nan" in warning for warning in port.warnings)
    assert np.isfinite(port.created)


def with_body(body: str, more: str = "") -> str:
    return f'<mujoco><worldbody><body name="right">{FREE}</body>{body}</worldbody>{more}</mujoco>'


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (with_body(""), "contact 'left': the world has no such body; bodies without a joint: right"),
        (
            f'<mujoco><worldbody><body name="left">{FREE}</body></worldbody></mujoco>',
            "contact 'right': the world has no such body; bodies without a joint: left",
        ),
        (f'<mujoco><worldbody><body name="">{FREE}</body></worldbody></mujoco>', "contact 'left': the world has no"),
        ("<mujoco/>", "contact 'left': the world has no such body; bodies without a joint: none"),
        (
            with_body(f'<body name="left">{FREE}</body><body><joint name="left, slide 1"/><geom size="1"/></body>'),
            "joint 'left, slide 1' has the name of a slide that the program adds; rename it",
        ),
        (with_body(f'<body name="left"><joint name="j"/>{FREE}</body>'), "contact 'left' has a joint (j)"),
        (with_body(f'<body name="left" mocap="true">{FREE}</body>'), "contact 'left' is a mocap body"),
        (with_body(f'<body name="arm"><body name="left">{FREE}</body></body>'), "is a child of body 'arm'"),
        (
            with_body(
                f'<body name="left">{FREE}</body><body name="box"><freejoint/><geom size="0.1"/></body>',
                '<equality><weld name="w" body1="box" body2="left"/></equality>',
            ),
            "contact 'left' is welded (w)",
        ),
        (
            with_body(
                f'<body name="left"><body>{FREE}<site name="tip"/></body></body><site name="nail"/>',
                '<equality><weld name="w" site1="nail" site2="tip"/></equality>',
            ),
            "contact 'left' is welded (w)",
        ),
        (with_body(f'<body name="left">{FREE}</body>', '<option><flag spring="disable"/></option>'), "flag spring"),
        ("<mujoco><worldbody>", "not a valid XML file"),
        ("<mujoco><nonsense/></mujoco>", "nonsense"),
        ('<mujoco><include file="missing.xml"/></mujoco>', "missing.xml: No such file"),
    ],
)
def test_bodies_that_are_no_contacts_are_refused(tmp_path, text, message):
    with pytest.raises(ValueError, match=r".*") as caught:
        world(tmp_path, text)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_scene_defaults_do_not_reach_slides(tmp_path):
    plain = world(tmp_path, with_body(f'<body name="left">{FREE}</body>'))
    joint = """<default><joint damping="3" armature="1" frictionloss="2" range="-1 1" limited="true"
    actuatorgravcomp="true" actuatorfrclimited="true" actuatorfrcrange="-.001 .001"/></default>"""
    dressed = world(
        tmp_path, with_body(f'<body name="left">{FREE}</body>').replace("<worldbody>", joint + "<worldbody>")
    )
    for scene in (plain, dressed):
        model = scene.model
        for part in ("dof_damping", "dof_armature", "dof_frictionloss", "jnt_limited", "jnt_actfrclimited"):
            assert not getattr(model, part).any()
        assert not model.jnt_actgravcomp.any()
        assert model.body("left").mass == model.body("right").mass == 0.03


@pytest.mark.parametrize("name", ["/dev/zero", "/proc/kmsg", "empty.xml"])
def test_empty_or_irregular_files_are_refused(tmp_path, name):
    (tmp_path / "empty.xml").touch()
    with pytest.raises(ValueError, match="is empty or not a regular file, expected an MJCF file"):
        touchable_bodies(tmp_path / name)


def test_the_digest_covers_included_files(tmp_path):
    main, part = tmp_path / "main.xml", tmp_path / "part.xml"
    main.write_text('<mujoco><include file="part.xml"/></mujoco>')
    part.write_text("<mujocoinclude><worldbody/></mujocoinclude>")
    first = digest_of(main)
    assert [file.name for file in files_of(main)] == ["main.xml", "part.xml"]
    part.write_text('<mujocoinclude><worldbody><body name="b"/></worldbody></mujocoinclude>')
    assert digest_of(main) != first
    elsewhere = tmp_path / "copy"
    elsewhere.mkdir()
    for file in (main, part):
        (elsewhere / file.name).write_text(file.read_text())
    assert digest_of(elsewhere / "main.xml") == digest_of(main)


def test_the_digest_covers_every_mesh_that_mujoco_reads(tmp_path):
    """The digest covers a mesh with a namesake, a mesh whose path is stripped, and the files of an attached model."""
    for name in ("a.obj", "meshes/a.obj", "part/meshes/b.obj", "part/c.xml"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("<mujocoinclude/>")
    assets = '<compiler meshdir="meshes"/><asset><mesh file="{}"/>{}</asset>'
    model = '<model name="m" file="part/part.xml"/>'
    (tmp_path / "part" / "part.xml").write_text(
        f'<mujoco>{assets.format("elsewhere/b.obj", "")}<include file="c.xml"/></mujoco>'
    )
    main = tmp_path / "main.xml"
    main.write_text(f"<mujoco>{assets.format('a.obj', model)}</mujoco>")
    covered = {file.relative_to(tmp_path).as_posix() for file in files_of(main)}
    assert covered >= {"main.xml", "meshes/a.obj", "part/part.xml", "part/c.xml", "part/meshes/b.obj"}


@pytest.mark.parametrize(
    ("joint", "more", "part"),
    [
        ('damping="-5"', "", "springs and dampers with negative constants"),
        ('stiffness="10 -50"', "", "springs and dampers that are not linear"),
        ("", '<option wind="1 0 0" density="1.2"/>', "wind"),
        ("", "", None),
    ],
)
def test_parts_that_may_add_energy_are_listed(tmp_path, joint, more, part):
    bodies = f'<body name="left">{FREE}</body><body><joint type="slide" {joint}/>{FREE}</body>'
    known = {each.what: each.at_the_port for each in world(tmp_path, with_body(bodies, more)).parts()}
    assert [what for what, at_the_port in known.items() if at_the_port == "the shell only"] == [part] * bool(part)


@pytest.mark.parametrize("more", ["margin='0.01'", "solreffriction='-100 -3000'", ""])
def test_the_lemma_is_named_for_its_contacts_only(tmp_path, more):
    bodies = "".join(
        f'<body name="{name}"><geom name="{name}" size="0.01" solimp="0.9 0.9"/></body>' for name in ("left", "right")
    )
    pair = f'<contact><pair geom1="left" geom2="right" solimp="0.9 0.9" {more}/></contact>'
    scene = world(tmp_path, f"<mujoco><worldbody>{bodies}</worldbody>{pair}</mujoco>")
    bounds = {part.what: part.at_the_port for part in scene.parts()}
    assert any(at_the_port.startswith("lemma") for at_the_port in bounds.values()) == (not more)


def test_an_active_scene_is_listed(tmp_path):
    text = with_body(
        f'<body name="left">{FREE}</body><body name="box"><joint name="j"/><geom size="0.1"/></body>',
        '<actuator><motor name="drive" joint="j"/></actuator>',
    )
    scene = world(tmp_path, text)
    assert scene.outside_the_lemma() == ["actuator drive"]
    assert {part.what: part.at_the_port for part in scene.parts()}["actuators"] == "the shell only"
    mujoco.set_mjcb_passive(lambda model, data: None)
    try:
        assert scene.outside_the_lemma() == ["actuator drive", "callback mjcb_passive"]
    finally:
        mujoco.set_mjcb_passive(None)


def test_bodies_are_counted_by_how_they_move(tmp_path):
    """A body that slides on a turning body counts as turning; several slides count once, contacts never."""
    slides = "".join(f'<joint type="slide" axis="{axis}"/>' for axis in ("1 0 0", "0 0 1"))
    box, mass = '<geom size="0.01"/>', '<geom size="0.01" mass="1"/>'
    arm = f'<body><joint axis="0 1 0"/>{mass}<body>{slides}{mass}</body></body>'
    scene = world(tmp_path, with_body(f'<body name="left">{box}</body><body>{slides}{mass}</body>{arm}'))
    counts = {part.what: part.count for part in scene.parts()}
    assert (counts["bodies that translate"], counts["bodies that turn"]) == (1, 2)


def test_compensation_by_actuators_releases_nothing_itself(tmp_path):
    """Raising a body stores m g z even if a motor compensates its weight, since the motor may be limited."""
    text = f"""<mujoco><worldbody><body name="left">{FREE}</body><body name="right">{FREE}</body>
<body name="lift" gravcomp="100"><joint name="up" type="slide" axis="0 0 1" actuatorgravcomp="true"
actuatorfrcrange="-.01 .01"/><geom type="box" size="0.01 0.01 0.01" mass="0.3"/></body></worldbody></mujoco>"""
    port = world(tmp_path, text).port()
    low = port._potential()
    port.data.joint("up").qpos[0] = 0.2
    assert port._potential() - low == pytest.approx(0.3 * 9.81 * 0.2, rel=1e-12)


def test_includes_beside_the_including_file_are_read(tmp_path):
    (tmp_path / "sub").mkdir()
    (tmp_path / "sub" / "part.xml").write_text('<mujoco><worldbody><body name="left"/></worldbody></mujoco>')
    (tmp_path / "sub" / "more.xml").write_text('<mujoco><include file="part.xml"/></mujoco>')
    (tmp_path / "main.xml").write_text('<mujoco><include file="sub/more.xml"/></mujoco>')
    assert files_of(tmp_path / "main.xml")[-1] == tmp_path / "sub" / "part.xml"


def test_the_lemma_excludes_springs_that_yield(tmp_path):
    yields = LINE.replace('axis="1 0 0"/>', 'axis="1 0 0" stiffness="100" springyield="0.004"/>')
    parts = {part.what: part.at_the_port for part in world(tmp_path, yields).parts()}
    assert "shell" in parts["springs that yield"]
