"""The live loop of sim/view works without a window; these tests supply the clock, the keys and the mouse.

A frame is what the window shows at one time. Tolerances without a comment cover rounding, in pictures that of single
precision.
"""

import contextlib
import json
import math
import subprocess
import sys
import threading
from concurrent.futures import Executor, Future
from dataclasses import replace
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from messages import says
from msgspec import structs
from PIL import Image

from haptic_loop import simulate
from haptic_loop.cli import view as command
from haptic_loop.controller.coupling import SpringDamper
from haptic_loop.design.result import HERE, Chosen
from haptic_loop.models.hold import hold
from haptic_loop.models.human import Human, Link, Person, Voluntary
from haptic_loop.models.scene import APART, build, plant
from haptic_loop.sim.run import assemble
from haptic_loop.sim.run import run as close_loop
from haptic_loop.sim.scenario import SCENARIOS, InputError, load
from haptic_loop.sim.stability import close, dominant_mode
from haptic_loop.sim.view import stage as drawing
from haptic_loop.sim.view.drawn_object import object_of, scene_xml
from haptic_loop.sim.view.session import (
    _DAMPING,
    _STIFFNESS,
    GIVEN,
    KEYS,
    Couple,
    Grip,
    LiveLoop,
    Menu,
    _changed,
    _Delay,
    _gripped,
    _Pace,
    _Push,
    _Restart,
    first_loop,
    parse_script,
    words,
)
from haptic_loop.sim.view.stage import (
    _COLUMNS,
    _account,
    _apart,
    _dressed,
    _envelope,
    _FlatPictures,
    _limited,
    _loop,
    _overlay,
    _owners,
    _places,
    _scale,
    _ShownScene,
    _typed,
    keys_help,
    pictures_for,
    stage_for,
)
from haptic_loop.sim.world import START_J
from tests.sim.test_world import TRAY, UP
from tests.sim.test_world import scenario as world_scenario

SCENARIO = load()


class Inline(Executor):
    """An executor that runs each task when it is submitted."""

    def submit(self, fn, /, *args, **kwargs):
        future = Future()
        future.set_result(fn(*args, **kwargs))
        return future


class Later(Executor):
    """An executor that runs its tasks in order, one per call of `work`."""

    def __init__(self):
        self.tasks = []

    def submit(self, fn, /, *args, **kwargs):
        self.tasks.append((Future(), lambda: fn(*args, **kwargs)))
        return self.tasks[-1][0]

    def work(self):
        future, task = self.tasks.pop(0)
        future.set_result(task())


@pytest.fixture(scope="module")
def none():
    return first_loop(Menu("I"), SCENARIO, "none")


@pytest.fixture(scope="module")
def published():
    return first_loop(Menu("I"), SCENARIO, "published")


def session(prepared, script="", patience=np.inf):
    return LiveLoop(prepared, Inline(), parse_script(script, 2) if script else (), patience)


def press(running, *names):
    codes = {name: code for code, (name, _) in KEYS.items()}
    for name in names:
        _typed(running)(codes[name])


# the loop itself


def test_live_frames_equal_the_simulated_run(none):
    """Frames at any times show the run up to one rounding error per tick.

    A block of ticks sums in another order than single ticks, and the unstable mode amplifies rounding up to sevenfold.
    """
    running = session(none)
    for now in np.cumsum(np.random.default_rng(1).uniform(0.001, 0.2, 12)):
        frame = running.frame(now)
    ticks = round(frame.t / SCENARIO.T)
    record = close_loop(none.simulation, "exact", ticks=ticks + 1)
    for shown, run in ((running.state, record.s[ticks]), (frame.history, record.f[:ticks])):
        np.testing.assert_allclose(shown, run, rtol=0, atol=7 * ticks * np.finfo(float).eps * np.abs(run).max())
    assert np.array_equal(frame.q, running.state[: frame.q.size])


def test_frames_show_forces_since_the_previous_frame(none):
    running = session(none)
    running.frame(0.3)
    frame = running.frame(0.35)
    recent = frame.history[-(round(frame.t / SCENARIO.T) - 250) :]  # 0.3 s are 250 ticks
    assert np.array_equal(frame.low, recent.min(axis=0))
    assert np.array_equal(frame.high, recent.max(axis=0))
    assert np.array_equal(frame.mean, recent.mean(axis=0))
    again = running.frame(0.35)  # no tick was due: the last force still acts
    assert np.array_equal(again.mean, frame.history[-1])


def test_rest_is_the_state_of_held_positions(published):
    """At rest the state z obeys z = A z + B x, and the transfer function F gives the force F(1) x."""
    F, x = published.simulation.F, np.array([0.01, -0.004])
    z = published.simulation.process.law.at_rest(x)
    assert np.allclose(F.A @ z + F.B @ x, z, rtol=0, atol=1e-12)
    # The forces are 4 N; rounding in z and F(1) changed them by 5e-13 N when measured.
    assert np.allclose(F.C @ z + F.D @ x, F.at(1.0 + 0j).real @ x, rtol=0, atol=1e-10)


def test_switching_keeps_the_plant_state(none):
    running, alone = session(none), session(none)
    before = running.frame(0.5)
    press(running, "7")
    assert running.frame(0.5).prepared.label == "published"
    alone.frame(0.5)
    assert np.array_equal(running.state, alone.state)  # position and velocity do not jump
    F, x = running.prepared.simulation.F, before.q[:2]
    force = running.frame(0.5 + 1.01 * SCENARIO.T).history[-1]
    assert np.allclose(force, F.at(1.0 + 0j).real @ x, rtol=0, atol=1e-10)


def test_the_oscillation_starts_and_dies(none):
    """With more delay and no coupling, forces grow to their limits; published gains with less delay end this."""
    running = session(none, "0:theta+2 2.5:theta-3 2.5:published")
    grown = running.frame(2.5 - 1e-3)
    assert grown.prepared.mode.growth > 3
    assert grown.clipped > 100
    calm = running.frame(5.0)
    assert calm.prepared.mode.growth < 0
    assert np.abs(calm.history[-200:]).max() < 2  # the voluntary motion is still felt
    assert [what for _, what, _ in running.log] == ["start", "theta+2", "theta-3", "published"]


def test_vectors_at_their_limit_are_counted():
    """A frame counts a force vector whose length is at the limit, although no single axis reaches it."""
    space = load("omega-space")
    pushed = Human((Link(0.3, 3.0, 200.0),), Voluntary(0.05, 2.0, along=(1.0, 1.0, 1.0)))
    limit = 0.3
    devices = [structs.replace(one, force_limit=limit) for one in space.device]
    running = session(first_loop(Menu("I"), space.replace(device=devices, human=[pushed, pushed], tap=None), "none"))
    frame = running.frame(0.5)
    lengths = np.linalg.norm(frame.history.reshape(-1, 2, 3), axis=2)
    assert np.abs(frame.history).max() < limit
    assert frame.clipped == (lengths.max(axis=1) > limit * (1 - 1e-9)).sum() > 10
    assert frame.clipped == running.clipped
    recent = running.frame(0.52)
    count = round(recent.t / space.T) - round(frame.t / space.T)
    over = np.linalg.norm(recent.history[-count:].reshape(-1, 2, 3), axis=2).max(axis=0) > limit * (1 - 1e-9)
    np.testing.assert_array_equal(recent.at_limit, np.repeat(over, 3))


def replace_theta(prepared, theta):
    return first_loop(prepared.menu, SCENARIO.replace(theta=theta), prepared.label)


def test_a_diverged_loop_restarts_from_rest():
    """A soft coupling and a delayed environment make a process that is unstable by itself, of spectral radius 1.63."""
    soft = SpringDamper(np.array([879.0, 552.0]), np.array([0.39, 0.52]))  # the design for psi = 0
    before = first_loop(Menu("I"), SCENARIO, "published")
    prepared = _changed(replace(before, chosen=Chosen(soft, "any-environment", kind="spring-damper")), _Delay("psi", 1))
    assert np.abs(prepared.simulation.F.poles()).max() > 1.6
    running = session(prepared)
    noted = [running.frame(t).note for t in (1.0, 2.0, 3.0)]  # 1.63^k passes 1e308 at k = 1450, 1.7 s
    assert "the loop diverged until numbers overflowed, so it restarts from rest" in noted[1]
    assert np.isfinite(running.state).all()


# keys, scripts and pushes


def test_keys_of_mujocos_viewer_stay_free():
    """MuJoCo's viewer uses the digits 0 to 5, the letters and some other keys."""
    own = {ord(c) for c in "012345ABCDEFGHIJKLMNOPQRSTUVWXYZ [],-=`/;'\\"} | {256, 258, 262, 263, 266}
    assert not own & set(KEYS)
    assert {"none", "published", "designed", "optimal", "theta+1", "theta-1"} <= {words(e) for _, e in KEYS.values()}


def test_events_are_spelt_as_they_are_read():
    for _, event in KEYS.values():
        assert parse_script(f"2.5:{words(event)}", 2) == ((2.5, event),)
    assert parse_script("3:push2=-1.5 1:restart", 2) == ((1.0, _Restart()), (3.0, _Push(2, -1.5)))


def test_impossible_keys_leave_the_loop_running(none):
    running = session(none)
    press(running, "Down", "Down")  # theta is 1 and 2
    frame = running.frame(0.1)
    assert frame.prepared.scenario.theta == (0, 1)
    assert frame.note == "theta-1: theta would be [-1, 0], allowed are 0 to 1000 samples"
    press(running, "Insert")
    assert "no coupling from a file" in running.frame(0.2).note
    assert running.prepared.label == "none"


def test_the_loop_runs_during_a_design(none):
    later = Later()
    running = LiveLoop(none, later)
    press(running, "7", "Up")
    frame = running.frame(0.1)
    assert (frame.t > 0.09, frame.prepared.label, frame.note) == (True, "none", "theta+1: being prepared")
    later.work()
    designed = running.frame(0.2).prepared
    assert (designed.label, designed.scenario.theta) == ("published", (1, 2))
    later.work()
    delayed = running.frame(0.3).prepared
    assert delayed.scenario.theta == (2, 3)
    assert delayed.coupling is designed.coupling


def test_a_push_is_felt_until_the_next(none):
    quiet, pushed = session(none), session(none, "0.5:push1=3 1:push1=0")
    assert np.array_equal(pushed.frame(0.5 - 1e-3).q, quiet.frame(0.5 - 1e-3).q)
    frame = pushed.frame(0.9)
    assert np.array_equal(frame.push, [3, 0])
    assert frame.q[0] > quiet.frame(0.9).q[0] + 1e-3
    assert np.array_equal(pushed.frame(1.1).push, [0, 0])


def test_restart_begins_from_rest(none):
    running = session(none)
    running.frame(1.0)
    press(running, "Backspace")
    assert not running.frame(1.0).q.any()


# time


@given(st.lists(st.floats(0, 0.5), min_size=1, max_size=30))
def test_every_tick_is_made_or_counted_as_lost(steps):
    pace, now = _Pace(1e-3, patience=0.1), 0.0
    for step in steps:
        now += step
        assert 0 <= pace.due(now) <= 100
        # Each call leaves less than one tick (1 ms) to the next.
        assert -1e-6 <= now - pace.lost - pace.done * pace.T <= pace.T * (1 + 1e-6)
    # So more than 100 ticks are due only after a step of 0.1 s or more; 0.098 allows for rounding.
    assert pace.overruns <= sum(step > 0.098 for step in steps)


def test_late_ticks_are_lost_and_counted():
    pace = _Pace(1e-3, patience=0.1)
    assert pace.due(0.05) == 50
    assert pace.due(1.05) == 100
    assert (pace.overruns, pace.lost) == (1, pytest.approx(0.9))
    assert pace.factor(1.05) == pytest.approx(0.15 / 1.05)


# the mouse


def test_the_mouse_adds_a_spring_and_damper(none):
    """A grip equals a hand of one link with the mouse's spring and damper added to those of the link."""
    human = SCENARIO.human[0].links[0]
    firmer = Human((Link(human.mass, human.damping + _DAMPING, human.stiffness + _STIFFNESS),))
    scene = build(SCENARIO.device, (firmer, SCENARIO.human[1]))
    expected, held = hold(plant(scene.model), SCENARIO.T), _gripped(none.simulation.scene, Grip(0, (0.0,)), SCENARIO.T)
    # `held` and `expected` are exponentials of the same matrix, whose entries reach 1e5
    assert np.allclose(held.A, expected.A, rtol=0, atol=1e-10)
    assert np.allclose(held.B, expected.B, rtol=0, atol=1e-12)


def test_the_mouse_pulls_and_releases_handles():
    soft = replace_theta(first_loop(Menu("I"), SCENARIO, "published"), (0, 0))
    assert (
        dominant_mode(close(_gripped(soft.simulation.scene, Grip(1, (0.0,)), SCENARIO.T), soft.simulation.F)).growth < 0
    )
    running, quiet = session(soft), session(soft)
    handle = soft.simulation.scene.handles[1]
    for k in range(1, 30):
        drawn = running.frame(k / 20, Grip(1, (0.03,)))
        still = quiet.frame(k / 20)
    assert drawn.q[handle] > still.q[handle] + 0.005
    speed = running.state[drawn.q.size + handle]
    assert abs(speed) > 1e-4
    assert drawn.push[1] == pytest.approx(_STIFFNESS * (0.03 - drawn.q[handle]) - _DAMPING * speed, rel=1e-9)
    assert not running.frame(1.5).push.any()


def test_the_mouse_holds_knobs_at_their_radius(none):
    """At 20 mm, 200 N/m are 0.08 N m/rad and 3 N s/m are 1.2 mN m s/rad."""
    grip, scene = Grip(0, (0.5,), lever=0.02), none.simulation.scene
    assert grip.pull == pytest.approx([0.04])
    state = np.zeros(2 * scene.model.nq)
    state[scene.handles[0]], state[scene.model.nq + scene.handles[0]] = 0.1, 2.0
    assert grip.force(scene, state) == pytest.approx([0.04 - 0.008 - 0.0024])


def test_the_viewer_s_selection_is_a_grip(none):
    stage = _ShownScene(none.simulation.scene, none.simulation.process.force_limit)
    q = np.array([0.001, 0.002, 0.003, 0.004])
    stage.show(replace(session(none).frame(0.0), q=q))
    perturb = mujoco.MjvPerturb()
    assert stage.grip(perturb) is None
    motor, handle = stage.model.body("device_2/motor").id, none.simulation.scene.handles[1]
    perturb.select, perturb.active = motor, int(mujoco.mjtPertBit.mjPERT_TRANSLATE)
    perturb.refselpos[:] = stage.data.xpos[motor] + (0.02, 0.5, 0.1)  # dragged 20 mm along the device
    assert stage.grip(perturb) == Grip(1, (pytest.approx(q[handle] + 0.02),))
    perturb.active = int(mujoco.mjtPertBit.mjPERT_ROTATE)
    assert stage.grip(perturb) is None


# shapes and texts


@pytest.mark.parametrize("name", ["omega-pair", "three-rigid"])
def test_shapes_change_nothing_that_moves(name):
    scenario = load(name)
    arms = [Human((*human.links, Link(0.5, 2.0, 300.0))) for human in scenario.human]
    scene = build(scenario.device, arms)
    bare, shown = scene.model, _dressed(scene)
    assert bare.ngeom == 0
    assert shown.ngeom == bare.njnt + scene.channels  # a shape per body, a rail per device
    assert [shown.joint(j).name for j in range(shown.njnt)] == [bare.joint(j).name for j in range(bare.njnt)]
    assert not shown.geom_contype.any()
    assert not shown.geom_conaffinity.any()
    data = mujoco.MjData(shown)
    mujoco.mj_kinematics(shown, data)
    rows = data.xpos[shown.jnt_bodyid, 1]
    assert rows == pytest.approx(-APART * np.array(_owners(scene)))  # on the rails of their devices
    assert np.array_equal(shown.body_mass, bare.body_mass)
    assert np.array_equal(plant(shown).A, plant(bare).A)
    assert np.array_equal(plant(shown).B, plant(bare).B)


def test_every_body_has_its_place():
    scene = build(SCENARIO.device, [Human((Link(0.3, 3, 200), Link(1, 2, 300))), SCENARIO.human[1]])
    names = [scene.model.joint(j).name for j in range(scene.model.njnt)]
    places = dict(zip(names, zip(_owners(scene), _places(scene), strict=True), strict=True))
    assert places == {  # the device, and the place along its rail from the handle
        "device_1/motor": (0, -1),
        "device_2/motor": (1, -1),
        "device_1/handle": (0, 0),
        "device_2/handle": (1, 0),
        "human_1_2": (0, 1),
    }


def test_a_person_s_body_stands_behind_both_arms():
    arm = Human((Link(0.3, 3, 200), Link(1, 2, 300)))
    scene = build(SCENARIO.device, [arm, SCENARIO.human[1]], [Person((1, 2), 30.0, 80.0, 900.0)])
    body = scene.model.joint("body_1").id
    assert (_owners(scene)[body], _places(scene)[body]) == (0, 2)
    assert np.array_equal(plant(_dressed(scene)).A, plant(scene.model).A)


def test_the_overlay_says_growth_and_certificates(none, published):
    overlay = dict(_overlay(session(none).frame(0.1), live=True))
    assert overlay["growth"] == "+1.48 1/s at 84.0 Hz: unstable"
    assert overlay[HERE] == "needs 1.723 of 1.37 N s/m: NOT certified"
    assert overlay["any environment"] == "no certificate"
    assert "0 overruns" in overlay["clock"]
    overlay = dict(_overlay(session(published).frame(0.1), live=False))
    assert overlay[HERE] == "needs 1.399 of 1.37 N s/m: NOT certified"
    assert overlay["any environment"] == "needs 7.843 of 1.37 N s/m: NOT certified"
    assert overlay["time"] == "0.1 s"
    assert (GIVEN in dict(keys_help(True)).values(), GIVEN in dict(keys_help(False)).values()) == (True, False)


def test_the_overlay_says_what_limits_and_shells_do():
    def prepared(guarantee, rho):
        return SimpleNamespace(assessment=SimpleNamespace(guarantee=guarantee, force_limits=SimpleNamespace(rho=rho)))

    covered, clipped, none = prepared("here", (0.0,)), prepared("here", None), prepared(None, (0.0,))
    assert _limited(covered) == "limited: the guarantee still holds"
    assert (_limited(clipped), _limited(none)) == ("clipped: not covered", "no guarantee")
    shell = SimpleNamespace(start_J=2e-3, given_J=1.5e-3, released_J=0.1, limited_ticks=3, ticks=500)
    acted, most = "acted on 3 of 500 ticks, ", "devices got 1.50 of at most 2 (W0) + 100.0 (released) mJ"
    assert _account(shell, covered) == ("energy shell", acted + most)
    assert _account(shell, none)[1] == f"{acted}no guarantee"


def test_a_refusal_is_shown_completely_and_once(none):
    """A note of more than one line stands completely, and only once, in the bottom left corner of the window."""
    running = session(none)
    press(running, "Insert")
    frame = running.frame(0.1)
    assert frame.note == "given: there is no coupling from a file (start with --coupling FILE.json)"
    long = replace(frame, note=" ".join(["reason"] * 60))
    rest_of_it, refused = _apart(_overlay(long, live=True))
    assert " ".join(value for _, value in refused) == long.note
    assert "last" not in dict(rest_of_it)
    short = _overlay(replace(frame, note="theta+1"), live=True)
    assert _apart(short) == (short, [])


@pytest.mark.parametrize("ticks", [0, 1, 700, 3333])
def test_the_envelope_holds_every_force(ticks):
    history = np.random.default_rng(2).normal(size=(ticks, 2))
    low, high = _envelope(history, _COLUMNS, 3333)
    assert low.shape == high.shape == (_COLUMNS, 2)
    if ticks:
        assert np.array_equal(np.nanmin(low, axis=0), history.min(axis=0))
        assert np.array_equal(np.nanmax(high, axis=0), history.max(axis=0))
    assert np.isnan(low).any() == (ticks < 3333 - 3333 // _COLUMNS)
    assert _scale(history, np.full(1, 0.02)) >= np.abs(history).max(initial=0)


# the virtual object


def followed(name, coupling, **changes):
    """Return the scenario, a run, and the displacements of the object's nodes (ticks, nodes)."""
    scenario = load(name).replace(**changes)
    simulation = assemble(scenario, coupling)
    trace, drawn = close_loop(simulation, "exact", ticks=1500), object_of(simulation)
    motion = drawn.motion(coupling, scenario.psi, scenario.T)
    motion.rest(np.zeros(scenario.channels))
    return scenario, trace, np.array([motion.follow(x[None]) for x in trace.x])


@pytest.mark.parametrize(("psi", "K", "B"), [((0, 0), 700.0, 0.5), ((0, 1), 50000.0, 20.0)])
def test_the_drawn_springs_carry_the_forces(psi, K, B):
    """Forces are those of the drawn springs (800, 700 N/m; 1 N s/m) by backward differences, theta + psi ticks late."""
    scenario, trace, q = followed("omega-pair", SpringDamper([K, K / 2], [B, B]), psi=psi)
    for i, stiffness in enumerate((800.0, 700.0)):
        stretch = q[:, i] - q[:, 2]
        force = stiffness * stretch + 1.0 * np.diff(stretch, prepend=0.0) / scenario.T
        late = scenario.theta[i] + psi[i]
        assert np.abs(force).max() > 0.3
        np.testing.assert_allclose(trace.f[late:, i], force[: len(force) - late], rtol=0, atol=1e-9)


def test_the_drawn_tip_feels_the_walls_force():
    """A wall at 5 mm pushes by max(0, 3000 h + 2 dh/T) [N], one tick late; h is the penetration, dh its change."""
    scenario, trace, q = followed("one-wall", SpringDamper([1000.0], [0.5]))
    h = np.maximum(q[:, 0] - 0.005, 0.0)
    force = np.maximum(3000 * h + 2 * np.diff(h, prepend=0.0) / scenario.T, 0.0) * (h > 0)
    assert force.max() > 0.5
    np.testing.assert_allclose(trace.f[1:, 0], force[:-1], rtol=0, atol=1e-9)


def test_held_devices_hold_the_object(none):
    """The object rests like springs in series with the compliances 1/K1, 1/800, 1/700, 1/K2."""
    K, x = np.array([900.0, 400.0]), np.array([0.01, -0.004])
    motion = object_of(none.simulation).motion(SpringDamper(K, [0.5, 0.5]), (0, 0), SCENARIO.T)
    f = (x[0] - x[1]) / np.sum(1 / np.array([*K, 800.0, 700.0]))
    expected = [x[0] - f / K[0], x[1] + f / K[1], x[0] - f / K[0] - f / 800]
    np.testing.assert_allclose(motion.rest(x), expected, rtol=0, atol=1e-9)
    np.testing.assert_allclose(motion.follow(np.tile(x, (300, 1))), expected, rtol=0, atol=1e-9)


@pytest.mark.parametrize("name", ["omega-pair", "three-rigid", "one-wall", "omega-space", "world-cube"])
def test_scene_files_show_the_object_beside_devices(name):
    scenario = load(name)
    simulation = assemble(scenario, SpringDamper([900.0] * scenario.channels, [0.4] * scenario.channels))
    drawn, bare = (mujoco.MjModel.from_xml_string(xml) for xml in (scene_xml(simulation), simulation.scene.xml))
    network = scenario.environment
    parts = 4 if network.world else len(network.points or network.nodes()) + len(network.springs) + len(network.walls)
    assert drawn.ngeom == bare.ngeom + parts  # a world has four: the floor, the cube, the finger and the plate
    assert not drawn.geom_contype.any()
    assert drawn.geom_pos[drawn.geom_bodyid == 0][:, 0].max() < -0.09  # left of the motors
    assert np.array_equal(plant(drawn).A, plant(bare).A)
    assert np.array_equal(plant(drawn).B, plant(bare).B)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("mass = 0.3, damping", "mass = 0.3, damping", None),
        ("motor_mass = 0.06", "motor_mass = 0.06\nfriction = 0.5", "device #1.friction is 0.5 N"),
        ("psi = [0, 0]", "psi = [0, 0]\nvarying_delay = { lo = [1, 2], hi = [2, 3] }", "varying delays"),
        ("psi = [0, 0]", "psi = [0, 0]\nperiod = { min = 1e-3, max = 2e-3 }", "period"),
    ],
)
def test_the_window_refuses_what_it_cannot_simulate(tmp_path, old, new, message):
    text = (SCENARIOS / "omega-pair.toml").read_text()
    (tmp_path / "loop.toml").write_text(text.replace(old, new))
    film = str(tmp_path / "film.txt")  # The suffix is refused after the scenario, so no film is made.
    with pytest.raises(InputError, match=message or "film.txt"):
        command.main(["--scenario", str(tmp_path / "loop.toml"), "--video", film])


def test_a_film_shows_how_the_mass_moves(none):
    """The drawn mass moves by its displacement. At rest it is 70 mm left of the contacts, which gives the scale."""
    running = session(none)
    pictures = pictures_for(running)

    def middle(frame, kind):
        rgba = next(s.rgba for s in pictures.object.shapes(frame.nodes) if s.kind == kind)
        picture = pictures.picture(frame).astype(int)
        return np.nonzero(np.abs(picture - [round(255 * c) for c in rgba[:3]]).sum(axis=2) == 0)[1].mean()

    still, later = running.frame(0.0), running.frame(0.9)
    scale = (middle(still, "contact") - middle(still, "mass")) / 0.07
    assert abs(later.nodes[2]) > 0.005
    assert middle(later, "mass") - middle(still, "mass") == pytest.approx(scale * later.nodes[2], abs=1.5)  # pixels


class FakeWindow:
    """A stand-in for the viewer, with the attributes that the loop uses."""

    def __init__(self, frames, stage):
        self.left, self.said, self.figures, self.synced = frames, [], [], 0
        self.perturb, self.user_scn = mujoco.MjvPerturb(), mujoco.MjvScene(stage.model, 50)
        self.viewport = mujoco.MjrRect(0, 0, 800, 600)

    def is_running(self):
        self.left -= 1
        return self.left >= 0

    def lock(self):
        return contextlib.nullcontext()

    def sync(self):
        self.synced += 1

    def set_texts(self, texts):
        self.said.append(texts)

    def set_figures(self, figures):
        self.figures.append(figures)


def test_the_window_loop_follows_an_injected_clock(none):
    """Frames come at 60 Hz of an injected clock, the mouse reaches the session, and texts reach the window."""
    running = LiveLoop(none, Inline())
    stage = _ShownScene(none.simulation.scene, none.simulation.process.force_limit)
    window, time = FakeWindow(40, stage), [100.0]

    def sleep(seconds):
        assert 0 <= seconds <= 1 / 60
        time[0] += 1 / 60
        if time[0] > 100.3:
            window.perturb.select = stage.model.body("device_1/handle").id
            window.perturb.active = int(mujoco.mjtPertBit.mjPERT_TRANSLATE)
            window.perturb.refselpos[:] = stage.data.xpos[window.perturb.select] + (0.05, 0, 0)

    _loop(running, stage, window, lambda: time[0], sleep)
    assert window.synced == len(window.said) == 40
    assert running.t == pytest.approx(39 / 60, abs=SCENARIO.T)
    assert running.pace.overruns == 0
    assert "coupling\ndelays\ngrowth" in window.said[-1][0][2]
    assert "push" in window.said[-1][0][2]
    assert "push" not in window.said[5][0][2]
    assert len(window.figures[-1]) == 2
    assert window.user_scn.ngeom >= 3  # an arrow for each force, and one for the push
    figure = window.figures[-1][0][1]
    drawn = figure.linedata[0, 1 : 2 * figure.linepnt[0] : 2]
    assert drawn.max() == pytest.approx(running.frame(0).history[:, 0].max(), rel=1e-6)  # single precision


def arrows(stage, frame):
    """Return the directions (arrows, 3) of the drawn arrows, and the places of the bars."""
    picture = mujoco.MjvScene(stage.model, 50)
    stage.show(frame)
    stage.draw(picture, frame)
    drawn = [picture.geoms[i] for i in range(picture.ngeom)]
    ways = [np.array(geom.mat)[:, 2] for geom in drawn if geom.type == mujoco.mjtGeom.mjGEOM_ARROW]
    return ways, [np.array(geom.pos) for geom in drawn if geom.type == mujoco.mjtGeom.mjGEOM_CAPSULE]


def test_arrows_show_what_devices_feel(none):
    """A device feels -f. The bar covers the range of -f since the last frame, so its centre is the range's middle."""
    scene, limit = none.simulation.scene, none.simulation.process.force_limit
    stage, low, high = _ShownScene(scene, limit), np.array([1.0, -3.0]), np.array([3.0, -1.0])
    forces = {"mean": np.array([2.0, -2.0]), "low": low, "high": high, "push": np.array([0.0, 1.5])}
    ways, bars = arrows(stage, replace(session(none).frame(0.0), **forces))
    forward = [way[0] for way in ways]  # in single precision; the last one is the push
    np.testing.assert_allclose(forward, [-1, 1, 1], rtol=0, atol=1e-6)
    for bar, handle, f, most in zip(bars, scene.handles, (2.0, -2.0), limit, strict=True):
        at = stage.data.xpos[stage.model.jnt_bodyid[handle]]
        assert bar[0] - at[0] == pytest.approx(-f / most * drawing._LONGEST, abs=1e-6)


def test_the_window_loop_ends_at_its_time(none):
    stage = _ShownScene(none.simulation.scene, none.simulation.process.force_limit)
    window, time = FakeWindow(1000, stage), [0.0]

    def sleep(seconds):
        time[0] += 0.1

    _loop(LiveLoop(none, Inline()), stage, window, lambda: time[0], sleep, until=0.55)
    assert window.synced == 7  # frames at 0, 0.1, .., 0.6 s


def test_keys_may_come_from_another_thread(none):
    running = session(none)
    thread = threading.Thread(target=press, args=(running, "Up"))
    thread.start()
    thread.join()
    assert running.frame(0.1).prepared.scenario.theta == (2, 3)


# films


def run(*words, code=0):
    assert command.main(list(words)) == code


def test_a_film_is_the_same_every_time(tmp_path, capsys):
    words = ("--script", "0:none 0.2:theta+1 0.3:published", "--duration", "0.5")
    for name in ("a", "b"):
        run("--video", str(tmp_path / f"{name}.gif"), *words, "--json", str(tmp_path / f"{name}.json"))
    assert (tmp_path / "a.gif").read_bytes() == (tmp_path / "b.gif").read_bytes()
    with Image.open(tmp_path / "a.gif") as image:
        assert (image.size, image.n_frames, image.info["duration"]) == ((640, 640), 6, 100)
    report = json.loads((tmp_path / "a.json").read_text())
    assert [(e["event"], e["coupling"], e["theta"]) for e in report["events"]] == [
        ("start", "none", [1, 2]),
        ("theta+1", "none", [2, 3]),
        ("published", "published", [2, 3]),
    ]
    assert [round(e["exact_growth_rate_per_s"], 2) for e in report["events"]] == [1.48, 3.13, 0.69]
    assert [round(e["t_s"], 2) for e in report["events"]] == [0, 0.2, 0.3]
    assert report["simulated_s"] == pytest.approx(0.5, abs=SCENARIO.T)
    assert report["video"] == {"file": str(tmp_path / "a.gif"), "pictures": 6, "fps": 10}
    assert "NOT certified" in capsys.readouterr().out


def test_flat_pictures_show_a_handles_displacement(none):
    """The first device's handle, found by its colour, moves by its displacement in pixels.

    520 pixels show 0.42 m: on each side of the handle 0.09 m to the next body and 0.12 m for the longest arrow.
    """
    painter = _FlatPictures(none.simulation.scene, none.simulation.process.force_limit)
    frame = session(none).frame(0.05)

    def middle(q):
        picture = painter.picture(replace(frame, q=np.array([0, 0, q, 0.0])))[
            256:480
        ]  # between the words and the plots
        return np.flatnonzero((picture == (0, 115, 178)).all(axis=2).any(axis=0)).mean()

    # A motion by whole pixels rounds each edge of the handle alike at both ends.
    assert middle(60 * 0.42 / 520) - middle(0.0) == pytest.approx(60, abs=1e-9)


def test_flat_pictures_show_the_force_that_is_felt(none):
    """A device feels -f: a positive f draws a line to the left of its handle, and a curve above the plot's middle."""
    painter = _FlatPictures(none.simulation.scene, none.simulation.process.force_limit)
    frame = session(none).frame(0.05)

    def first_device(f):
        both = np.array([f, 0.0])
        forces = {"mean": both, "low": both, "high": both, "history": np.tile(both, (400, 1)), "push": 0 * both}
        picture = painter.picture(replace(frame, **forces))
        return np.nonzero((picture == (0, 115, 178)).all(axis=2))

    (rows, columns), (_, still) = first_device(6.0), first_device(0.0)
    body, plot = rows < 480, rows > 490
    assert columns[body].min() < still.min() - 20
    assert columns[body].max() == still[still < 500].max()
    assert rows[plot].max() < (498 + 622) / 2


def test_interrupted_films_keep_their_frames(tmp_path, monkeypatch):
    frames, picture = [], _FlatPictures.picture

    def interrupted(self, frame):
        if len(frames) == 4:
            raise KeyboardInterrupt
        frames.append(frame)
        return picture(self, frame)

    monkeypatch.setattr(_FlatPictures, "picture", interrupted)
    where = tmp_path / "a.gif"
    run("--coupling", "none", "--video", str(where), "--duration", "2", code=130)
    with Image.open(where) as image:
        assert image.n_frames == 4


@pytest.mark.parametrize("option", ["--scenario", "--coupling"])
def test_bad_files_are_refused_before_mujoco_loads(option, tmp_path):
    bad = tmp_path / "bad.json"
    bad.write_text("{")
    code = (
        "import sys; from haptic_loop.cli import view\n"
        "try: view.main(sys.argv[1:])\n"
        "except ValueError: print('mujoco' in sys.modules)"
    )
    words = [sys.executable, "-c", code, option, str(bad)]
    assert subprocess.run(words, capture_output=True, text=True, timeout=60).stdout == "False\n"


def test_mp4_is_what_ffmpeg_makes_of_the_pictures(tmp_path, monkeypatch):
    """A stand-in for ffmpeg copies its input, which must be every picture in order."""
    tool = tmp_path / "ffmpeg"
    tool.write_text(
        f"#!{sys.executable}\nimport shutil, sys\nshutil.copy(sys.argv[sys.argv.index('-i') + 1], sys.argv[-1])\n"
    )
    tool.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    pictures = np.random.default_rng(3).integers(0, 255, (3, 480, 640, 3), dtype=np.uint8)
    command._check_film(tmp_path / "a.mp4", 10)
    assert drawing.save_film(tmp_path / "a.mp4", iter(pictures), 10) == 3
    assert (tmp_path / "a.mp4").read_bytes() == pictures.tobytes()
    tool.write_text(f"#!{sys.executable}\nimport sys\nsys.exit('no codec')\n")
    with pytest.raises(InputError, match="ffmpeg: no codec"):
        drawing.save_film(tmp_path / "b.mp4", iter(pictures), 10)


def test_case_none_takes_a_coupling_later(tmp_path):
    """No coupling is designed for case none, so a coupling that is chosen later is designed for case I."""
    where, report = str(tmp_path / "a.gif"), tmp_path / "a.json"
    words = ("--case", "none", "--script", "0.1:designed", "--duration", "0.3", "--fps", "5")
    run(*words, "--video", where, "--json", str(report))
    assert [e["coupling"] for e in json.loads(report.read_text())["events"]] == ["none", "designed"]


# bad input

BAD = [
    (("--video", "a.png"), "--video a.png: the name must end in .gif or .mp4"),
    (("--video", "nowhere/a.gif"), "folder nowhere"),
    (("--video", "/proc/a.gif"), "--video /proc/a.gif: cannot write to /proc"),
    (("--video", "a.gif", "--fps", "12"), "--fps is 12, allowed for a .gif are the numbers that divide 100"),
    (("--video", "a.gif", "--duration", "0"), "--duration is 0 .. 0.001 to 3600 s"),
    (("--video", "a.gif", "--duration", "-1"), "--duration is -1 .. 0.001 to 3600 s"),
    (
        ("--coupling", "soft"),
        "'soft' .. none, published, spring-damper, moving-average, ccl, optimal, designed or a FILE.json",
    ),
    (("--coupling", "absent.json"), "absent.json: No such file"),
    (("--case", "none", "--coupling", "designed"), "that case is the loop without coupling"),
    (("--script", "none"), "--script: 'none', expected SECONDS:EVENT"),
    (("--script=-1:none",), "--script: '-1:none', expected SECONDS:EVENT with 0 to 3600 s"),
    (("--script", ""), "--script is empty"),
    (
        ("--script", "0:soft"),
        "'0:soft' is no event .. none, published, designed, moving-average, ccl, optimal, given, theta+1",
    ),
    (("--script", "0:push3=1"), "'0:push3=1' .. push1 to push2 with up to 100 N"),
    (("--script", "0:push1=1..2"), "push1 to push2"),
    (("--coupling", "none", "--script", "1:theta-2"), "theta would be [-1, 0]"),
    (("--coupling", "none", "--script", "1:given"), "there is no coupling from a file"),
]


@pytest.mark.parametrize(("words", "message"), BAD, ids=lambda part: " ".join(part) if isinstance(part, tuple) else "")
def test_bad_input_is_named(words, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError) as error:
        command.main(list(words))
    assert says(error.value, message)
    assert not list(tmp_path.iterdir())


def test_mp4_without_ffmpeg_is_refused(monkeypatch, tmp_path):
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(InputError, match="MP4 requires ffmpeg"):
        run("--video", str(tmp_path / "a.mp4"))


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="on other systems no variable names the display")
def test_a_missing_display_is_refused(monkeypatch):
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(InputError, match=r"no window can be opened: .*; --video FILE\.gif needs no window"):
        run("--coupling", "none")


# MuJoCo worlds


@pytest.fixture(scope="module")
def ball():
    return first_loop(Menu("I"), load("world-ball"), "moving-average")


@pytest.mark.slow
def test_live_worlds_have_the_forces_of_runs(tmp_path):
    """The live loop delays forces itself, and sim.run delays them as packets; forces and energies are equal."""
    tray = first_loop(Menu("I"), world_scenario(tmp_path, TRAY, more=UP, duration=0.5), "moving-average")
    running = LiveLoop(tray, Inline(), (), math.inf)
    trace = simulate(tray.scenario, tray.coupling, engine="exact")
    frame = running.frame(0.5)
    np.testing.assert_allclose(frame.history, trace.f, rtol=0, atol=1e-9)
    np.testing.assert_allclose(frame.q[:2], trace.x[-1], rtol=0, atol=1e-4)  # [m] the frame is a tick later
    assert frame.world.ticks == 500
    assert frame.world.given_J == pytest.approx(trace.meta["world"]["given_J"], abs=1e-12)
    assert frame.world.given_J > START_J  # The tray sinks, so that the scene gives energy.


def test_a_change_begins_the_scene_anew(ball):
    running = LiveLoop(ball, Inline(), parse_script("0.3:theta+1", 2), math.inf)
    assert np.abs(running.frame(0.3).pose).max() > 1e-4
    later = running.frame(0.301)
    assert later.prepared.scenario.theta == (2, 3)
    # One tick after the beginning, devices and bodies have hardly moved [m].
    assert np.abs(later.pose).max() < 1e-4
    assert np.abs(later.q).max() < 1e-4
    running.keys.put(Couple("none"))
    running.frame(0.31)
    assert "needs a coupling" in running.frame(0.32).note


def test_the_window_shows_scene_and_devices(ball):
    running = LiveLoop(ball, Inline())
    stage = stage_for(running)
    window, time = FakeWindow(40, stage), [0.0]

    def sleep(seconds):
        time[0] += 1 / 60
        if time[0] > 0.3:
            window.perturb.select = stage.model.body("finger 2").id
            window.perturb.active = int(mujoco.mjtPertBit.mjPERT_TRANSLATE)
            window.perturb.refselpos[:] = stage._rest[1] + (0.03, 0.0, 0.0)

    _loop(running, stage, window, lambda: time[0], sleep)
    words = window.said[-1][0][2]
    assert "energy shell" in words
    assert "growth" not in words
    assert "push" in words
    assert window.user_scn.ngeom >= 4  # two styluses of two shapes
    np.testing.assert_array_equal(stage.data.qpos, running.frame(0).pose)
    assert stage.grip(window.perturb) == Grip(1, (pytest.approx(0.03),))


def test_arrows_in_worlds_show_what_devices_feel(ball):
    running = LiveLoop(ball, Inline())
    forces = {"mean": np.array([1.0, -1.0]), "push": np.array([0.0, 2.0])}
    stage = stage_for(running)
    ways, _ = arrows(stage, replace(running.frame(0.0), **forces))
    along = [stage._along[i][0] for i in (0, 1, 1)]
    np.testing.assert_allclose([w @ a for w, a in zip(ways, along, strict=True)], [-1, 1, 1], rtol=0, atol=1e-6)


@pytest.mark.slow
def test_a_film_of_a_world_shows_the_scene(ball, tmp_path, capsys):
    running = LiveLoop(ball, Inline(), (), math.inf)
    try:
        artist = pictures_for(running)
    except InputError:
        pytest.skip("no OpenGL here")
    with contextlib.closing(artist):
        first, last = (artist.rendered(running.frame(t), 160, 120).astype(int) for t in (0.0, 1.0))
    assert (first == 255).all(axis=2).mean() > 0.3  # white background
    assert (first != last).any(axis=2).sum() > 100
    run("--scenario", "world-peg", "--duration", "0.1", "--video", str(tmp_path / "a.gif"))
    with Image.open(tmp_path / "a.gif") as image:
        assert (image.size, image.n_frames) == ((640, 640), 2)
    assert "a world, certified (any-environment)" in capsys.readouterr().out
