"""MuJoCo worlds give hands no more energy than the account: W0 = START_J plus what gravity and springs released.

A world is a MuJoCo scene that hands touch through devices; its shell limits forces that would give more. Tolerances
without a comment cover rounding.
"""

import json
from dataclasses import replace as replace_fields
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hands import Hands
from messages import says
from msgspec.structs import replace
from shared import checkered

from haptic_loop import design_coupling, simulate
from haptic_loop.controller.budget import Shell
from haptic_loop.controller.coupling import Compliance, NoCoupling, SpringDamper
from haptic_loop.controller.environment import Network, Spring
from haptic_loop.controller.lti import Lti
from haptic_loop.design.api import store
from haptic_loop.design.designs import design_by_kind
from haptic_loop.design.environments import THIS_ENVIRONMENT
from haptic_loop.models import world as world_of
from haptic_loop.sim.couplings import assessed, choose, read_coupling
from haptic_loop.sim.couplings import given as choose_given
from haptic_loop.sim.run import assemble
from haptic_loop.sim.scenario import SCENARIOS, InputError, Scenario, load, parse
from haptic_loop.sim.world import (
    START_J,
    Claim,
    HandsInWorld,
    InWorld,
    Late,
    Touched,
    _contacts_of,
    linearise,
    scene_of,
    thrown,
)

T = 1e-3
NAMES = ("cube", "ball", "peg", "door", "stack", "space")
LIMIT = (12.0, 12.0)
TIP = '<geom type="sphere" size="0.01"/>'


def scenario(folder: Path, text: str, contacts: str = '["left", "right"]', more: str = "", **changes) -> Scenario:
    (folder / "scene.xml").write_text(text)
    (folder / "loop.toml").write_text(
        f"""name = "test"
T = 1e-3
theta = [1, 2]
device = [{{ kind = "rigid", mass = 0.2, damping = 1.37, force_limit = 12.0 }},
          {{ kind = "rigid", mass = 0.2, damping = 0.9, force_limit = 12.0 }}]
[environment]
world = "scene.xml"
contacts = {contacts}
{more}
"""
    )
    loaded = load(folder / "loop.toml")
    return loaded.replace(**changes) if changes else loaded


def certified(loop: Scenario):
    """Return a moving-average design that is certified for any environment at the loop's delays."""
    return design_by_kind(loop.loop("I"), "moving-average")


class Touch:
    """Passive hands that touch a world through its shell; their energy comes from textbook formulas."""

    def __init__(self, loop: Scenario, hands: Hands, start: float = START_J, gravity: bool = True, credit: bool = True):
        coupling = certified(loop).coupling
        self.V, self.theta, self.hands, self.credit = coupling.compliance(T), loop.theta, hands, credit
        self.port = scene_of(loop, coupling, gravity).port([12.0] * loop.channels, loop.balls)
        self.shell = Shell(self.V, start=start)
        self.line = [np.zeros((loop.channels, 1))] * (max(loop.theta) + 1)
        self.start = float(hands.energy()[0])

    def tick(self) -> float:
        """Run one tick and return by how much the energy [J] of hands and devices exceeds that at the start."""
        free = self.shell.free(self.hands.x)
        wanted = self.port.step(free[:, 0])[:, None]
        if self.credit:
            self.shell.credit([self.port.released])
        force, _ = self.shell.limit(wanted)
        self.line = [force, *self.line[:-1]]
        self.hands.hold(np.array([self.line[n][i] for i, n in enumerate(self.theta)]))
        return float(self.hands.energy()[0]) - self.start


# ---- the packaged worlds


@pytest.mark.parametrize(("name", "lossless"), checkered(NAMES, [False, True]))
def test_no_hand_is_given_more_than_the_account(name, lossless):
    """Hands are thrown at each scene, where one device has a delay of 2 samples. The shell never acts."""
    rng = np.random.default_rng(3)
    for run in (0, 2):
        loop = load(f"world-{name}").replace(theta=(run, (run + 2) % 4))
        touch = Touch(loop, Hands(rng, 1, lossless, 0.3, T=T, delta=loop.delta))
        for _ in range(175):
            assert touch.tick() <= START_J + touch.port.released + 1e-12
        assert not touch.shell.limited[0]


@pytest.mark.parametrize("name", NAMES)
def test_without_gravity_energy_rises_within_the_account(name):
    """Hands' energy and the scene's kinetic energy rise by no more than W0 and what springs release."""
    loop = load(f"world-{name}").replace(theta=(0, 3))
    touch = Touch(loop, Hands(np.random.default_rng(5), 1, True, 0.3, T=T, delta=loop.delta), gravity=False)
    model, data = touch.port.world.model, touch.port.data
    mass = np.diag(model.dof_M0)
    for _ in range(200):
        risen = touch.tick()
        kinetic = data.qvel @ mass @ data.qvel / 2  # bodies here translate, or turn about one fixed hinge
        assert risen + kinetic <= START_J + touch.port.released + 1e-9


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=() if name in ("cube", "space") else pytest.mark.slow) for name in NAMES]
)
def test_a_packaged_world_runs_and_is_guaranteed(name):
    loop = load(f"world-{name}").replace(duration=0.2)
    design = certified(loop)
    trace = simulate(loop, design, engine="exact")
    world, again = trace.meta["world"], simulate(loop.replace(duration=0.05), design, engine="exact")
    assert trace.meta["guaranteed"]
    assert (
        "no passive hand is given more than W0 = 2 mJ beyond what gravity and springs released"
        in (trace.meta["guarantee"])
    )
    energies = {"given_J", "port_least_J", "released_J", "created_J"}
    assert set(world) == {"ticks", "ticks_acted", "unsettled_steps", "warnings"} | energies
    assert (world["ticks"], world["ticks_acted"], world["unsettled_steps"]) == (200, 0, 0)
    assert trace.meta["scene"]["active"] == []
    assert trace.meta["scene"]["settings"].startswith("integrator discrete, timestep 0.001 s")
    np.testing.assert_array_equal(trace.f[:50], again.f)


@pytest.mark.slow
def test_the_plate_lifts_the_cube():
    """The plate rises by 3 cm; its friction lifts the cube, which rests at 3 cm, by more than a centimetre."""
    loop = load("world-cube")
    coupling = certified(loop).coupling
    port, shell = scene_of(loop, coupling).port(LIMIT), Shell(coupling.compliance(T), start=START_J)
    for k in range(1500):
        squeeze, lift = 0.02 * min(1.0, k / 500), 0.03 * min(1.0, max(0, k - 500) / 500)
        force = port.step(shell.free(np.array([[squeeze], [lift]]))[:, 0])
        shell.limit(force[:, None])
    height = port.data.body("cube").xpos[2]
    assert 0.04 < height < 0.061


def test_contacts_have_the_axes_of_their_devices(tmp_path):
    """On a frictionless oblique plate the force has the direction of the plate's normal, projected onto the free axes.

    A device off the plate feels no force.
    """
    plate = '<geom type="box" pos="0 0 -.05" size=".2 .2 .05" condim="1" solimp=".9 .9"/>'
    (tmp_path / "scene.xml").write_text(
        f"""<mujoco><compiler angle="degree"/><option gravity="0 0 0"/><worldbody>
        <body name="one" pos="0 0 0" euler="10 40 70">{TIP}</body><body name="two" pos="0 0 5">{TIP}</body>
        <body name="plate" euler="0 30 0">{plate}</body></worldbody></mujoco>"""
    )
    normal = np.array([0.5, 0.0, np.sqrt(0.75)])
    for clamped, free in (("", [0, 1, 2]), ('clamped = ["y"]', [0, 2]), ('clamped = ["x", "y"]', [2])):
        (tmp_path / "loop.toml").write_text(
            f"""name = "space"\nT = 1e-3\ntheta = [0, 0]\n[environment]\nworld = "scene.xml"
            contacts = ["one", "two"]\n[[device]]\nkind = "rigid"\naxes = 3\n{clamped}\n
            [[device]]\nkind = "rigid"\naxes = 3\n{clamped}\n"""
        )
        loop, n = load(tmp_path / "loop.toml"), len(free)
        assert loop.channel_names == tuple(f"{body}.{'xyz'[axis]}" for body in ("one", "two") for axis in free)
        port = scene_of(loop, SpringDamper([900.0] * 2 * n, [5.0] * 2 * n)).port()
        goal = np.array([0.01, -0.02, -0.01])[free]  # the tip, of radius 10 mm, starts in the plate
        for _ in range(400):
            force = port.step(np.concatenate([goal, goal]))
        assert np.abs(force[:n]).max() > 1.0
        along = normal[free] / np.linalg.norm(normal[free])
        # MuJoCo's contact solver is iterative: it left 1e-7 N.
        np.testing.assert_allclose(force[:n] @ along * along, force[:n], rtol=0, atol=1e-5)
        np.testing.assert_allclose(force[n:], 0.0, rtol=0, atol=1e-9)


def test_matrix_levels_dissipate_as_computed_by_hand():
    """The energy given is -f'dx - dx' Delta dx/T = -(1 - 2 + 6) mJ - 7.6 mJ, worked out by hand."""
    damping = [[1.5, 0.4, 0.1], [0.4, 0.9, -0.2], [0.1, -0.2, 1.2]]
    loop = load("world-space").replace(device=[{"kind": "rigid", "axes": 3, "damping": damping}] * 2)
    simulation = assemble(loop, certified(loop).coupling)
    world, x = Touched().net(simulation, simulation.process, 1), np.zeros((6, 1))
    world.send(x, np.zeros((6, 1)))
    world.apply(0, np.arange(1.0, 7.0)[:, None])
    x[:3, 0] = 1e-3, -1e-3, 2e-3
    world.send(x, np.zeros((6, 1)))
    assert world._given[0] == pytest.approx(-5e-3 - 7.6e-3, rel=1e-12)


def test_along_is_for_devices_with_one_axis():
    text = (SCENARIOS / "world-space.toml").read_text()
    with pytest.raises(InputError, match=r"environment\.along is \[\[0, 0, 1\]\]: .* leave it out"):
        parse(text.replace('"finger 2"]', '"finger 2"]\nalong = [[0, 0, 1]]'), folder=SCENARIOS)


# ---- gravity and active scenes

TRAY = f"""<mujoco><worldbody><body name="left" pos="-0.05 0 0">{TIP}</body><body name="right" pos="0.05 0 0">{TIP}
</body><body name="tray" pos="0 0 0.02"><joint type="slide" axis="0 0 1"/>
<geom type="box" size="0.1 0.05 0.01" mass="0.3" solimp="0.9 0.9"/></body></worldbody></mujoco>"""
UP = "along = [[0, 0, 1], [0, 0, 1]]"


def test_a_run_sums_the_energy_given(tmp_path):
    """A tray of 0.3 kg on two hands gives them energy as it sinks; the trace has its positions and forces."""
    loop = scenario(tmp_path, TRAY, more=UP, duration=0.5)
    trace = simulate(loop, certified(loop), engine="exact")
    world, dx = trace.meta["world"], np.diff(trace.x, axis=0)
    most = np.cumsum((-trace.f[:-1] * dx - np.array(loop.delta) / T * dx**2).sum(axis=1)).max()
    assert most > START_J
    assert world["given_J"] == pytest.approx(most, abs=1e-12)
    assert most <= START_J + world["released_J"]


@pytest.mark.slow
def test_the_shell_credits_energy_that_gravity_releases(tmp_path):
    """Hands carry a tray of 0.3 kg. Without W0 and credit for released energy, the shell limits most forces."""
    loop = scenario(tmp_path, TRAY, more=UP)
    acted = {}
    for credit in (True, False):
        hands = Hands(np.random.default_rng(1), 1, False, 0.0, T=T, delta=loop.delta)
        touch = Touch(loop, hands, start=START_J if credit else 0.0, credit=credit)
        risen = max(touch.tick() for _ in range(600))
        acted[credit] = int(touch.shell.limited[0])
        if credit:
            assert START_J < risen <= START_J + touch.port.released
            assert touch.port.data.body("tray").xpos[2] < 0.02
        else:
            assert risen <= 1e-12
    assert acted[True] == 0
    assert acted[False] > 500


@pytest.mark.slow
def test_an_active_scene_is_held_back(tmp_path):
    """A motor with negative damping drives a body against the contacts; the shell limits the energy that it gives."""
    text = f"""<mujoco><option gravity="0 0 0"/><worldbody><body name="left" pos="-0.03 0 0">{TIP}</body>
    <body name="right" pos="0.08 0 0">{TIP}</body><body name="load"><joint name="j" type="slide" axis="1 0 0"/>
    <geom type="box" size="0.019 0.05 0.05" mass="0.3" solimp="0.9 0.9"/></body></worldbody>
    <actuator><velocity joint="j" kv="-60"/></actuator></mujoco>"""
    loop = scenario(tmp_path, text)
    worst = acted = 0
    for seed in range(2):
        hands = Hands(np.random.default_rng(seed), 1, True, 0.1, T=T, delta=loop.delta)
        touch = Touch(loop, hands)
        for _ in range(1000):
            worst = max(worst, touch.tick() - START_J - touch.port.released)
        acted += int(touch.shell.limited[0])
    assert worst <= 1e-12
    assert acted > 0


def thrown_at_walls(loop: Scenario, start: float) -> tuple[float, int]:
    """Return the least energy at the port [J] and the ticks on which the shell acts; hands of 1 kg fly at 1.5 m/s."""
    coupling = SpringDamper([1000.0, 1000.0], [0.5, 0.5])
    port, shell = scene_of(loop, coupling).port(), Shell(coupling.compliance(T), start=start)
    x, v, at_port, least, before = np.zeros(2), np.array([-1.5, 1.5]), 0.0, 0.0, port.u
    for _ in range(250):
        wanted = port.step(shell.free(x[:, None])[:, 0])
        shell.credit([port.released])
        force, u = shell.limit(wanted[:, None])
        at_port, before = at_port + float(force[:, 0] @ (u[:, 0] - before)), u[:, 0]
        least = min(least, at_port)
        v = v - T * (force[:, 0] + 50.0 * x)
        x = x + T * v
    return least, int(shell.limited[0])


@pytest.mark.parametrize(("impedance", "gives_J"), [("0.9 0.95", 0.04), ("0.99 0.99", 0.15), ("0.9 0.9", 0.0)])
def test_contacts_that_give_energy_are_held_back(tmp_path, impedance, gives_J):
    """With solimp 0.99 and by default, contacts of 0.1 kg that hit walls give energy; the shell passes at most W0."""
    tips = '<body name="{}" pos="{} 0 0"><geom size="0.01" mass="0.1"/></body>'
    walls = "".join(f'<geom type="box" size="0.01 0.1 0.1" pos="{x} 0 0"/>' for x in (-0.2, 0.2))
    text = f"""<mujoco><option gravity="0 0 0"/><default><geom solimp="{impedance} 0.001"/></default><worldbody>{walls}
    {tips.format("left", -0.05)}{tips.format("right", 0.05)}</worldbody></mujoco>"""
    loop = scenario(tmp_path, text)
    (least, idle), (held, acted) = (thrown_at_walls(loop, start) for start in (1e3, START_J))
    assert least <= -gives_J if gives_J else least == 0.0
    assert held >= -START_J - 1e-12
    assert not idle
    assert (acted > 0) == (gives_J > 0)


# ---- guarantees


def test_only_a_certified_coupling_is_guaranteed(tmp_path):
    loop = load("world-peg").replace(duration=0.05)
    stiff = simulate(loop, SpringDamper([50000.0, 50000.0], [0.0, 0.0]), engine="exact")
    assert not stiff.meta["guaranteed"]
    assert stiff.meta["guarantee"].startswith("No guarantee: the coupling is not certified for every environment")
    coarse = loop.replace(
        device=[{**d, "encoder_step": 1e-5} for d in [{"kind": "rigid", "mass": 0.25, "damping": 1.37}] * 2]
    )
    assert "encoder steps" in simulate(coarse, certified(coarse), engine="exact").meta["guarantee"]


def alone(folder: Path, stiffness: float, **changes) -> Scenario:
    """Return a scene in which 1 kg slides along z, apart from the contacts, on a spring of `stiffness` [N/m]."""
    mass = f'<joint type="slide" axis="0 0 1" stiffness="{stiffness}"/><geom size="0.05" mass="1"/>'
    bodies = f'<body name="left">{TIP}</body><body name="right" pos="1 0 0">{TIP}</body><body pos="0 2 0">{mass}</body>'
    return scenario(folder, f"<mujoco><worldbody>{bodies}</worldbody></mujoco>", **changes)


def test_a_guarantee_names_its_bound_in_joules(tmp_path):
    """In 0.2 s a free fall of 1 kg releases m (g t)^2 / 2 = 1.92 J, which a hand could be given."""
    loop = alone(tmp_path, 0.0, duration=0.2)
    words = simulate(loop, certified(loop)).meta["guarantee"]
    bound = float(words.partition(", here at most ")[2].partition(" J in all")[0])
    assert bound == pytest.approx(START_J + (9.81 * 0.2) ** 2 / 2, rel=0.02)  # discrete speeds differ by g T


def test_a_scene_that_diverges_has_no_guarantee(tmp_path, capsys):
    loop = alone(tmp_path, -1e9, duration=0.2)
    meta = simulate(loop, certified(loop)).meta
    assert not meta["guaranteed"]
    assert meta["guarantee"].startswith("No guarantee: the scene diverged")
    words = ["--scenario", str(tmp_path / "loop.toml"), "--out", str(tmp_path / "out")]
    for run in (
        ["run", "--duration", "0.2", "--no-plot"],
        ["validate", "--duration", "0.2", "--no-plot", "--humans", "2"],
    ):
        _, shown = command(capsys, *run, *words)
        assert shown.startswith("No guarantee: the scene diverged")


def test_steps_whose_limits_do_not_settle_are_counted(tmp_path, capsys, monkeypatch):
    """If no step may be repeated, the counted steps are the ticks on which a force is at its limit."""
    monkeypatch.setattr(world_of, "_MOST_REPETITIONS", 0)
    scenario(tmp_path, TRAY, more=UP)
    text = (tmp_path / "loop.toml").read_text().replace("12.0", "0.5").replace("[1, 2]", "[0, 0]")
    hand = "\n[[human]]\nlinks = [{ mass = 0.3, damping = 3.0, stiffness = 200.0 }]\n"
    (tmp_path / "loop.toml").write_text(text + hand + "voluntary = { amplitude = 0.03, frequency = 2.0 }" + hand)
    words = ("run", "--scenario", str(tmp_path / "loop.toml"), "--duration", "0.5", "--no-plot", "--out")
    with pytest.raises(InputError, match=r"scene\.xml is a file of the scene"):
        command(capsys, *words, str(tmp_path))
    out = tmp_path / "out"
    _, shown = command(capsys, *words, str(out))
    report = json.loads((out / "report.json").read_text())
    with np.load(out / "trace.npz") as trace:
        limited = int((np.abs(trace["f"]) >= 0.5).any(axis=1).sum())
    assert 20 < limited < 500
    assert report["world"]["unsettled_steps"] == limited
    assert f"did not settle in {limited} steps of the scene" in " ".join(shown.split())


def test_this_environment_certifies_no_world():
    loop = load("world-ball").loop("I")
    needs = THIS_ENVIRONMENT.judge(loop, certified(load("world-ball")).coupling)
    assert not needs.certified
    assert "no linear model" in needs.reason


@pytest.mark.parametrize(
    ("coupling", "message"),
    [
        (NoCoupling(), r"environment\.world needs a coupling"),
        (Compliance(Lti.constant([[1e-3, 1e-4], [1e-4, 1e-3]], T)), "couples devices"),
        (Compliance(Lti.constant([[1e-3, 0.0], [0.0, 0.0]], T)), "is not symmetric and positive definite"),
    ],
)
def test_couplings_unfit_for_worlds_are_refused(coupling, message):
    with pytest.raises(InputError, match=message) as caught:
        simulate(load("world-peg"), coupling)
    assert "\n" not in str(caught.value)


# ---- commands


def command(capsys, *words: str) -> tuple[int, str]:
    code = import_module(f"haptic_loop.cli.{words[0]}").main([*words[1:]])
    return code, capsys.readouterr().out


def test_a_run_reports_the_energy_account(tmp_path, capsys):
    (tmp_path / "figure.png").touch()  # the picture of an earlier run
    code, shown = command(
        capsys, "run", "--scenario", "world-ball", "--duration", "0.2", "--no-plot", "--out", str(tmp_path)
    )
    report = json.loads((tmp_path / "report.json").read_text())
    assert code == 0
    assert not (tmp_path / "figure.png").exists()
    assert "The shell acted on 0 of 200 ticks" in " ".join(shown.split())
    assert report["guaranteed"]
    assert report["world"]["ticks"] == 200
    assert report["assessment"]["requirements"]["any-environment"]["proof"] == "rational"
    assert report["scene"]["active"] == []


def test_a_validation_throws_both_kinds_of_hands(tmp_path, capsys):
    code, shown = command(
        capsys,
        *("validate", "--scenario", "world-peg", "--humans", "4", "--duration", "0.1", "--no-plot"),
        *("--out", str(tmp_path)),
    )
    report = json.loads((tmp_path / "report.json").read_text())
    assert code == 0
    assert "2 random hands" in shown
    assert "2 lossless hands" in shown
    assert report["worst_excess_J"] <= 0


def test_a_design_for_a_world_is_proved_exactly(tmp_path, capsys):
    code, shown = command(capsys, "design", "--scenario", "world-door", "--out", str(tmp_path / "door.json"))
    assert code == 0
    assert "proof: rational" in shown
    stored = read_coupling(tmp_path / "door.json")
    assert stored.loop.environment.world.file == "door.xml"
    with pytest.raises(InputError, match="a MuJoCo world is no linear block: export the coupling alone"):
        command(capsys, "export", str(tmp_path / "door.json"), "--process")
    _, shown = command(capsys, "check", str(tmp_path / "door.json"))
    assert "0.002 J" in " ".join(shown.split())


def test_refused_designs_for_worlds_name_another(tmp_path):
    words = ["--scenario", "world-door", "--coupling", "spring-damper", "--out", str(tmp_path / "no.json")]
    with pytest.raises(ValueError, match=r"no linear model E\(z\): take moving-average"):
        import_module("haptic_loop.cli.design").main([*words, "--condition", "any-environment"])


@pytest.mark.parametrize("words", ["zwidth", "compare", "accuracy"])
def test_other_commands_refuse_a_world_in_one_line(words):
    name, *options = words.split()
    with pytest.raises(InputError, match="accepts networks only") as caught:
        import_module(f"haptic_loop.cli.{name}").main([*options, "--scenario", "world-door"])
    assert "\n" not in str(caught.value)


# ---- scenarios


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (('"scene.xml"', '"other.xml"'), "other.xml: No such file"),
        (('["left", "right"]', '["left", "middle"]'), "contact 'middle': the world has no such body"),
        (('["left", "right"]', '["left", "world"]'), "contact 'world': the world has no such body"),
        (('["left", "right"]', '["left", "left"]'), "contact 'left' is named twice"),
        (("contacts", "springs = []\ncontacts"), None),
        (("contacts", "masses = { a = 1.0 }\ncontacts"), "world and masses"),
        (("contacts", "along = [[1, 0, 0]]\ncontacts"), "along has 1 directions for 2 contacts"),
        (("contacts", "along = [[1, 0, 0], [0, 0, 0]]\ncontacts"), "#2 is [0, 0, 0], expected finite numbers"),
        (("contacts", "every = 0\ncontacts"), "every is 0 .. 1 to 100 ticks"),
        (("theta =", "psi = [0, 1]\ntheta ="), "psi must be 0"),
        (("world =", "wrld ="), "unknown field `wrld`"),
    ],
)
def test_a_world_is_read_strictly(tmp_path, change, message):
    scenario(tmp_path, TRAY)
    text = (tmp_path / "loop.toml").read_text().replace(*change)
    if message is None:
        parse(text, folder=tmp_path)
        return
    with pytest.raises(InputError, match=r".*") as caught:
        parse(text, folder=tmp_path)
    assert says(caught.value, message)
    assert "\n" not in str(caught.value)


def test_digests_depend_on_contents_not_on_places(tmp_path):
    first = scenario(tmp_path, TRAY)
    moved = tmp_path / "elsewhere"
    moved.mkdir()
    assert scenario(moved, TRAY).digest == first.digest
    assert scenario(moved, TRAY.replace("0.3", "0.4")).digest != first.digest
    assert scenario(moved, TRAY, more=UP).digest != first.digest
    assert first.replace(name="test") == first


# ---- a linear model


@pytest.fixture
def linear_tray(tmp_path):
    """Return a scenario with a world, and a design that is certified for the linear network of its scene."""
    loop = scenario(tmp_path, TRAY)
    linear = loop.replace(environment=linearise(loop))
    return loop, design_coupling(linear.loop("I"), "spring-damper", "this-environment")


@pytest.mark.parametrize("change", [TRAY.replace("0.3", "0.4"), TRAY])
def test_scenes_that_changed_void_their_linear_network(tmp_path, linear_tray, change):
    """If and only if the scene has changed, the claim asks to call linearise again.

    Then linearise refuses the scenario that was loaded before the change.
    """
    before, design = linear_tray
    after = scenario(tmp_path, change)
    claim = Claim.of(assessed(after, "I", choose_given(design), energy_budget=START_J), design.certified_for)
    assert not claim.guaranteed
    assert "near its initial pose only" in claim.words
    assert ("call linearise again" in claim.words) == (change != TRAY)
    if change != TRAY:
        with pytest.raises(InputError, match="has changed since the scenario was loaded"):
            linearise(before)


@pytest.mark.slow
def test_a_world_becomes_a_network_for_a_design(tmp_path, capsys, monkeypatch):
    """Each contact is on a spring and a damper; the linear model has their E(z), with the contacts' masses."""
    text = f"""<mujoco><option gravity="0 0 0"/><worldbody>
    <body name="left"><site name="l"/>{TIP}</body><body name="right" pos="1 0 0"><site name="r"/>{TIP}</body>
    <site name="wall" pos="0.5 0 0"/></worldbody><tendon>
    <spatial stiffness="300" damping="2"><site site="l"/><site site="wall"/></spatial>
    <spatial stiffness="500" damping="1"><site site="r"/><site site="wall"/></spatial></tendon></mujoco>"""
    loop = scenario(tmp_path, text)
    network = linearise(loop)
    springs = (Spring(("left", "ground"), 300.0, 2.0), Spring(("right", "ground"), 500.0, 1.0))
    expected = Network(("left", "right"), springs, {"left": 0.03, "right": 0.03})
    z = np.exp(2j * np.pi * np.geomspace(0.1, 100, 30) * T)
    theirs = expected.E(T).at(z[None])[0]
    assert np.abs(network.E(T).at(z[None])[0] - theirs).max() < 1e-7 * np.abs(theirs).max()
    linear = loop.replace(environment=network)
    design = design_coupling(linear.loop("I"), "spring-damper", "this-environment")
    where = "The coupling is certified for the linear network of scene.xml near its initial pose only."
    store(linear.loop("I"), design, tmp_path / "design.json")
    for coupling in (design, tmp_path / "design.json"):
        claim = simulate(loop.replace(duration=0.05), coupling).meta["guarantee"]
        assert claim.startswith("No guarantee: the coupling is not certified for every environment: needs ")
        assert claim.endswith(where)
    monkeypatch.setattr("haptic_loop.cli.world.least_at_port", lambda *given: {})
    words = ("--scenario", str(tmp_path / "loop.toml"), "--coupling", str(tmp_path / "design.json"))
    _, shown = command(capsys, "audit", *words, "--out", str(tmp_path / "out"))
    assert where in " ".join(shown.split())
    assert "linear network" not in simulate(loop.replace(duration=0.05), certified(linear)).meta["guarantee"]
    assert linearise(loop, [0.0, 0.01]).linear_model_of == "scene.xml near the pose [0, 0.01]"
    with pytest.raises(InputError, match="filters the forces of its linear model and has no V"):
        simulate(loop, design_coupling(linear.loop("I"), "optimal", seconds=0.0))
    assert THIS_ENVIRONMENT.judge(linear.loop("I"), certified(linear).coupling).reason is None
    assert [contact.body for contact in _contacts_of(loop.environment)] == ["left", "right"]


@pytest.mark.parametrize("every", [2, pytest.param(4, marks=pytest.mark.slow)])
def test_default_couplings_of_slow_worlds_do_not_ring(every):
    """If a scene steps every few ticks, forces alternate from tick to tick by less than 0.1 N rms.

    The amplitude of alternation is the second difference of a force, divided by 4.
    """
    loop = load("world-cube").replace(duration=0.8)
    world = replace(loop.environment.world, every=every)
    slow = loop.replace(environment=replace(loop.environment, world=world))
    trace = simulate(slow, certified(slow), engine="exact")
    alternating = np.diff(trace.f, 2, axis=0) / 4
    assert trace.meta["guaranteed"]
    assert np.abs(trace.f).max() > 1
    assert np.sqrt((alternating**2).mean(axis=0)).max() < 0.1


def test_worlds_with_slow_steps_keep_the_account(tmp_path):
    loop = scenario(tmp_path, TRAY, more=f"{UP}\nevery = 4")
    touch = Touch(loop, Hands(np.random.default_rng(1), 1, True, 0.1, T=T, delta=loop.delta))
    assert touch.port.world.h == 4 * T
    for _ in range(500):
        assert touch.tick() <= START_J + touch.port.released + 1e-12
    assert not touch.shell.limited[0]


def test_thrown_hands_may_outlast_the_scenario(tmp_path):
    short = scenario(tmp_path, TRAY, more=UP, duration=0.1)
    (runs,) = thrown(short, choose(short, "I", "moving-average").coupling, 1, 0, 0.3)
    assert runs.figures.ticks == 300
    figures = replace_fields(runs.figures, given_J=5e-3, start_J=2e-3, released_J=4e-3)
    assert HandsInWorld("", 0, figures).excess_J == pytest.approx(-1e-3)  # W0 and 4 mJ were allowed


def test_a_scene_that_changed_is_refused(tmp_path):
    loaded = scenario(tmp_path, TRAY, more=UP)
    coupling = choose(loaded, "I", "moving-average").coupling
    (tmp_path / "scene.xml").write_text(TRAY.replace('mass="0.3"', 'mass="0.4"'))
    with pytest.raises(InputError, match=r"scene\.xml has changed since the scenario was loaded"):
        scene_of(loaded, coupling)


class _Random:
    """A port that asks for random forces."""

    created, unsettled, warnings = 0.0, 0, ()

    def __init__(self, rng, released):
        self.rng, self.released = rng, released

    def step(self, u0):
        return self.rng.normal(size=u0.shape)


def test_figures_at_a_port_are_sums_over_ticks():
    """The least energy at a port and the energy given equal sums by hand; the sent force is halved before it acts."""
    rng, V = np.random.default_rng(0), SpringDamper([500.0, 700.0], [0.5, 0.4]).compliance(T)
    ports, damping = [_Random(rng, 0.03), _Random(rng, 0.01)], np.array([[1.4, 0.2], [0.2, 1.1]]) / T
    world = InWorld(Shell(V, start=0.02, nsim=2), ports, damping)
    x, acting, u, state = np.zeros((2, 2)), np.zeros((2, 2)), np.zeros((2, 2)), np.zeros((V.order, 2))
    given, at_port = [np.zeros(2)], [np.zeros(2)]
    for k in range(200):
        dx = 1e-4 * rng.normal(size=(2, 2)) * (k > 0)
        given.append(given[-1] - (dx * acting).sum(axis=0) - [v @ damping @ v for v in dx.T])
        x, force = x + dx, np.zeros((2, 2))
        world.send(x, force)
        before, u = u, x - V.C @ state - V.D @ force
        state = V.A @ state + V.B @ force
        at_port.append(at_port[-1] + (force * (u - before)).sum(axis=0))
        acting = 0.5 * force
        world.apply(k, acting)
    figures = world.figures()
    assert figures.given_J == pytest.approx(np.max(given), rel=1e-9)
    assert figures.port_least_J == pytest.approx(np.min(at_port), rel=1e-9)
    assert figures.released_J == 0.03
    assert min(figures.given_J, -figures.port_least_J) > 1e-4


def test_worlds_dissipate_in_the_longest_period():
    scenario = load("world-ball").replace(T_max=2e-3)
    simulation = assemble(scenario, SpringDamper([800.0, 800.0], [0.4, 0.4]))
    world = Touched().net(simulation, simulation.process, 1)
    np.testing.assert_allclose(world._damping, simulation.loop.Delta() / 2e-3, rtol=1e-12)


def test_claims_name_a_sweep_without_proof():
    """A claim that only a sweep supports says so, as the verdicts of other loops do."""
    swept, proved = (
        Claim.of(SimpleNamespace(guarantee=SimpleNamespace(energy_J=2e-3, proof=proof))).words
        for proof in ("sampled", "rational")
    )
    assert "without an exact proof" in swept
    assert "without an exact proof" not in proved


def test_a_live_world_delays_every_simulation():
    """Channel 0 is late by two ticks and channel 1 by none, in each of two simulations."""

    class Ramp:
        def send(self, x, force):
            force[...] = x

    late, felt = Late(Ramp(), (2, 0)), []
    for k in range(5):
        force = np.zeros((2, 2))
        late.send(np.array([[1.0, 10.0], [2.0, 20.0]]) * (k + 1), force)
        felt.append(force)
    sent = np.arange(1, 6)
    assert np.array_equal(np.array(felt)[:, 0].T, np.outer([1, 10], [0, 0, 1, 2, 3]))
    assert np.array_equal(np.array(felt)[:, 1].T, np.outer([2, 20], sent))
