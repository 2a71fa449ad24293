"""Devices with several axes match closed forms and devices with one axis; impossible fields are refused.

Tolerances without a comment cover rounding.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
import pytest
import scipy.linalg

from haptic_loop.cli import verdict
from haptic_loop.controller import complementarity
from haptic_loop.controller.coupling import SpringDamper
from haptic_loop.controller.environment import Network, Wall
from haptic_loop.controller.loop import Loop
from haptic_loop.controller.lti import Array
from haptic_loop.controller.tick import at_limit
from haptic_loop.design.assessment import assess
from haptic_loop.design.files import InputError
from haptic_loop.design.gain_search import LimiterLoop
from haptic_loop.models.device import RigidDevice
from haptic_loop.models.hold import hold
from haptic_loop.models.human import Cross, Human, Link, Person, Population, Voluntary, directions
from haptic_loop.models.scene import Scene, build, draw, variants
from haptic_loop.sim.api import run_scenario
from haptic_loop.sim.crowds import Validation
from haptic_loop.sim.run import assemble, outside_forces, run
from haptic_loop.sim.scenario import Scenario, held_by, parse, save_humans
from haptic_loop.sim.stability import close, dominant_mode, exact_loops, mujoco_plants

TEXT = """
name = "space"
T = 1e-3
duration = 0.3
theta = [1, 2]

[[device]]
kind = "rigid"
axes = 3
FIRST

[[device]]
kind = "rigid"
axes = 3
SECOND

[environment]
contacts = ["left", "right"]
masses = { block = 0.3 }
springs = [{ between = ["left", "block"], stiffness = 800.0, damping = 1.0 },
           { between = ["block", "right"], stiffness = 700.0, damping = 1.0 }MORE]
"""
COUPLING = SpringDamper([3000.0] * 6, [0.3] * 6)


def scenario(first: str = "", second: str = "", more: str = "") -> Scenario:
    return parse(TEXT.replace("FIRST", first).replace("SECOND", second).replace("MORE", more))


def line() -> Scenario:
    """Return `scenario()` with devices of one axis."""
    return parse(TEXT.replace("axes = 3", "").replace("FIRST", "").replace("SECOND", "").replace("MORE", ""))


def rotation(seed: int) -> Array:
    """Return the orthogonal factor of a random matrix; with seed 1 it is a rotation."""
    Q, R = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    return Q * np.sign(np.diag(R))


def rows(matrix: Array) -> str:
    """Return the symmetric part of a matrix as TOML text."""
    return str(((matrix + matrix.T) / 2).tolist())


# ---- contents of files


@pytest.mark.parametrize(
    ("first", "more", "words"),
    [
        ('clamped = ["x", "y", "z"]', "", ("device #1: clamped", "leaves no axis")),
        ('clamped = ["w"]', "", ("clamped lists 'w'", "allowed are x, y, z")),
        ('clamped = ["y", "y"]', "", ("clamped is ['y', 'y']", "at most once")),
        ("damping = [[1, nan, 0], [nan, 1, 0], [0, 0, 1]]", "", ("damping is [[1", "finite numbers")),
        ("damping = [[1, 1, 0], [1, 1.00000000000001, 0], [0, 0, 1]]", "", ("damping is [[1", "eigenvalues in [1e-09")),
        (
            "",
            ', {between = ["left", "ground"], stiffness = 1.0, along = [1e200, 0, 0]}',
            ("springs #3: along", "[1e+200, 0.0, 0.0]", "below 1e9"),
        ),
        ("damping = [[1, 0, 0], [0.5, 1, 0], [0, 0, 1]]", "", ("damping is", "symmetric")),
        ("damping = [[1, 2, 0], [2, 1, 0], [0, 0, 1]]", "", ("damping is", "eigenvalues -1 to 3")),
        ("damping = [1, 2]", "", ("damping is [1", "expected one number, 3 numbers or 3 rows")),
        ("damping = [1, inf, 1]", "", ("damping is [1", "expected finite numbers")),
        ("damping = inf", "", ("damping is inf", "expected a finite number")),
        ("damping = 1.0\ndelta = nan", "", ("delta is nan", "expected a finite number")),
        ("damping = 1.0\ndelta = [1.0, 1.0, 1.1]", "", ("delta is", "delta <= damping as matrices")),
        ("force_limit = [3, 3]", "", ("force_limit is", "expected one number or 3")),
        ("friction = [0, 0, -1]", "", ("friction #3 is -1", "0 to 1000 N")),
        (
            "",
            ', {between = ["left", "ground"], stiffness = 1.0, along = [0, 0, 0]}',
            ("springs #3: along", "1e-9"),
        ),
        ("", ', {between = ["left", "ground"], stiffness = 1.0, along = []}', ("springs #3: along", "[]", "1e-9")),
        ("", ', {between = ["left", "ground"], stiffness = 1.0, along = [1, 0]}', ("along", "expected 3 numbers")),
        ("", ', {between = ["left", "ground"], stiffness = [1, 2]}', ("springs #3.stiffness is [1, 2]", "3 numbers")),
        ("", ', {between = ["left", "ground"], stiffness = [1, 1, -2]}', ("springs #3.stiffness", "eigenvalue -2")),
        (
            "",
            ', {between = ["left", "b"], stiffness = 1.0, along = [1, 1, 0]}',
            ("b.x, b.y, b.z", "nothing that holds it"),
        ),
    ],
)
def test_impossible_axes_are_refused_in_one_line(first: str, more: str, words: tuple[str, ...]) -> None:
    with pytest.raises(InputError) as refused:
        scenario(first, more=more)
    assert "\n" not in str(refused.value)
    for word in words:
        assert word in str(refused.value)


ALIKE = "damping = 1.0, stiffness = 9.0"


@pytest.mark.parametrize(
    ("link", "more", "words"),
    [
        ("damping = 1.0, stiffness = [9.0, 8.0]", "", r"human #1.links #1.stiffness is \[9.0, 8.0\], expected 3"),
        (
            ALIKE,
            ", voluntary = { amplitude = 0.01, frequency = 1.0, along = [1, 0] }",
            r"along is \[1.0, 0.0\], expected 3",
        ),
        (ALIKE, ", voluntary = { amplitude = 0.01, frequency = 1.0, along = [] }", r"along is \[\], expected"),
    ],
)
def test_hands_have_the_axes_of_their_devices(link: str, more: str, words: str) -> None:
    hands = f"{{ links = [{{ mass = 0.1, {link} }}]{more} }}, {{ links = [{{ mass = 0.1, {ALIKE} }}] }}"
    text = f"human = [{hands}]\n" + TEXT.replace("FIRST", "").replace("SECOND", "").replace("MORE", "")
    with pytest.raises(InputError, match=words):
        parse(text)


def test_persons_hold_devices_with_the_same_axes() -> None:
    person = "person = [{ holds = [1, 2], mass = 30.0, damping = 80.0, stiffness = 900.0 }]\n"
    text = TEXT.replace("FIRST", "").replace("SECOND", 'clamped = ["z"]').replace("MORE", "")
    with pytest.raises(InputError, match=r"person #1.holds is \[1, 2\].* free axes are x, y, z; x, y"):
        parse(person + text)


def test_each_device_has_one_delay_and_one_level() -> None:
    space = scenario()
    assert (space.theta, space.psi, space.delta) == ((1, 1, 1, 2, 2, 2), (0,) * 6, (1.37,) * 6)
    changed = space.replace(theta=(0, 3), delta=(1.0, 2.0), latency=((0.0, 1e-4), (1e-4, 2e-4)))
    assert changed.theta == (0, 0, 0, 3, 3, 3)
    assert changed.delta == (1.0, 1.0, 1.0, 2.0, 2.0, 2.0)
    timing = changed.timing(0, 50)
    assert timing is not None
    assert timing.late is not None
    assert (timing.late == timing.late[:, [0, 0, 0, 3, 3, 3]]).all()
    with pytest.raises(InputError, match="theta has 3 entries, expected 2, one for each device"):
        space.replace(theta=(1, 2, 3))


def test_springs_in_space_match_closed_form_matrices() -> None:
    stiffness = np.array([[900.0, 120.0, -40.0], [120.0, 500.0, 10.0], [-40.0, 10.0, 300.0]])
    more = f', {{ between = ["left", "ground"], stiffness = {rows(stiffness)}, damping = [0.5, 0.2, 0.1] }}'
    more += ', { between = ["right", "ground"], stiffness = 50.0, along = [1, 2, 2] }'
    T, z = 1e-3, np.exp(1j * np.array([0.05, 0.7, 3.0]))
    s = (z - 1) / (T * z)
    eye, along = np.eye(3), np.array([1.0, 2.0, 2.0]) / 3
    for k, E in enumerate(scenario(more=more).loop("I").environment.E(T).at(z)):
        one, two = 800 + s[k], 700 + s[k]
        inner = one + two + 0.3 * s[k] ** 2
        left = stiffness + s[k] * np.diag([0.5, 0.2, 0.1]) + (one - one**2 / inner) * eye
        right = 50 * np.outer(along, along) + (two - two**2 / inner) * eye
        expected = np.block([[left, -one * two / inner * eye], [-one * two / inner * eye, right]])
        assert np.abs(E - expected).max() < 1e-9 * np.abs(expected).max()


def wall_forces(network: Network, x: Array) -> Array:
    """Return the forces (ticks, m) of the network behind a coupling for displacements x (ticks, m)."""
    m = x.shape[1]
    loop = Loop(1e-3, (1,) * m, (0,) * m, (0,) * m, (1.0,) * m, network, axes=(m,))
    law = loop.law(SpringDamper([5000.0] * m, [0.5] * m))
    tick, state, forces = law.transition(), np.zeros((law.open.order, 1)), []
    for position in x:
        after = np.empty((m + len(state), 1))
        tick(np.concatenate([state, position[:, None]]), after)
        forces.append(after[:m, 0])
        state = after[m:]
    return np.array(forces)


def test_walls_push_along_their_normals() -> None:
    normal, coordinates = np.array([2.0, -1.0, 2.0]) / 3, ("tip.x", "tip.y", "tip.z")
    wall = {"stiffness": 2000.0, "damping": 1.0, "gap": 1e-3}
    walls = (Wall(("tip", "ground"), **wall, normal=tuple(6 * normal)),)
    space = Network(coordinates, walls=walls, points={"tip": coordinates})
    path = 8e-4 * np.random.default_rng(0).normal(size=(200, 3)).cumsum(axis=0)
    alone = wall_forces(Network(("tip",), walls=(Wall(("tip", "ground"), **wall),)), path @ normal[:, None])
    assert 0.1 < (alone != 0).mean() < 0.9
    assert np.allclose(wall_forces(space, path), alone * normal, rtol=0, atol=1e-9)


# ---- the plant, by both engines


def push_along(scene: Scene, direction: Array, first: int, ticks: int) -> Array:
    """Return outside forces from tick `first` on: until tick 50 `direction` [N] on handle 1, -1/2 of it on handle 2."""
    w = np.zeros((ticks, scene.outside))
    for k, column in enumerate(scene.tapped):
        w[: max(0, 50 - first), column] = (1.0, -0.5)[k // len(direction)] * direction[k % len(direction)]
    return w


@pytest.mark.parametrize("engine", ["exact", "mujoco"])
def test_three_decoupled_axes_equal_one_axis(engine: str) -> None:
    arm = Human((Link(0.3, 3.0, 200.0), Link(0.5, 1.0, 90.0)))
    traces = []
    for each, direction in ((scenario(), np.array([0.0, 1.0, 0.0])), (line(), np.ones(1))):
        held = each.replace(human=(arm, arm), person=(Person((1, 2), 5.0, 20.0, 300.0, Cross(1.0, 50.0)),))
        simulation = assemble(held, SpringDamper([3000.0] * each.channels, [0.3] * each.channels))
        traces.append(run(simulation, engine, partial(push_along, simulation.scene, direction)))
    assert np.abs(traces[1].x).max() > 1e-4
    assert np.abs(traces[0].x[:, [1, 4]] - traces[1].x).max() < 1e-12
    assert not traces[0].x[:, [0, 2, 3, 5]].any()


def test_two_clamped_axes_leave_a_single_axis() -> None:
    clamped = scenario('clamped = ["y", "z"]', 'clamped = ["y", "z"]')
    assert clamped.loop("I").axes is None
    scene = build(clamped.device, clamped.human)
    assert [scene.model.joint(i).name for i in range(scene.model.njnt)] == ["device_1/motor.x", "device_2/motor.x"]
    pair = SpringDamper([3000.0] * 2, [0.3] * 2)
    forces = [run(assemble(each, pair), "exact").f for each in (clamped, line())]
    assert np.array_equal(forces[0], forces[1])


DAMPING = np.array([[1.5, 0.4, 0.1], [0.4, 0.9, -0.2], [0.1, -0.2, 1.2]])
STIFFNESS = np.array([[700.0, 100.0, 0.0], [100.0, 400.0, 50.0], [0.0, 50.0, 300.0]])


@pytest.mark.parametrize(("kind", "engine"), [("rigid", "exact"), ("compliant", "exact"), ("compliant", "mujoco")])
def test_rotated_loops_have_rotated_trajectories(kind: str, engine: str) -> None:
    Q, hand = rotation(1), Human((Link(0.3, 3.0, 200.0),))
    traces = []
    for turn in (np.eye(3), Q):
        ground = f', {{ between = ["block", "ground"], stiffness = {rows(turn @ STIFFNESS @ turn.T)} }}'
        text = TEXT.replace('"rigid"', f'"{kind}"').replace("FIRST", f"damping = {rows(turn @ DAMPING @ turn.T)}")
        turned = parse(text.replace("SECOND", "").replace("MORE", ground)).replace(human=(hand, hand))
        simulation = assemble(turned, COUPLING)
        push = partial(push_along, simulation.scene, turn @ np.array([1.0, 0.3, -0.5]))
        traces.append(run(simulation, engine, push))
    for name in ("x", "f"):
        before, after = (getattr(trace, name).reshape(-1, 2, 3) for trace in traces)
        assert np.abs(before @ Q.T - after).max() < 1e-9 * np.abs(before).max()


def test_plant_with_matrices_equals_a_matrix_exponential() -> None:
    """A device of 0.25 kg in a hand of 0.3 kg follows 0.55 x'' = -K x - B x' - f; B is the sum of their dampings."""
    hand = np.array([[3.0, 0.5, 0.0], [0.5, 2.0, -0.4], [0.0, -0.4, 1.0]])
    K = np.array([[200.0, -50.0, 20.0], [-50.0, 150.0, 0.0], [20.0, 0.0, 90.0]])
    device = RigidDevice(axes=3, damping=tuple(map(tuple, DAMPING.tolist())))
    held = Human((Link(0.3, tuple(map(tuple, hand.tolist())), tuple(map(tuple, K.tolist()))),))
    plant, eye, zero = build((device,), (held,)).plant, np.eye(3), np.zeros((3, 3))
    A = np.block([[zero, eye], [-K / 0.55, -(hand + DAMPING) / 0.55]])
    exact = scipy.linalg.expm(1e-3 * np.block([[A, np.vstack([zero, -eye / 0.55])], [np.zeros((3, 9))]]))
    step = hold(plant, 1e-3)
    assert np.abs(step.A - exact[:6, :6]).max() < 1e-12
    assert np.abs(step.B[:, -3:] - exact[:6, 6:]).max() < 1e-12


# ---- hands in space


def test_drawn_hands_stay_within_the_population() -> None:
    population = Population()
    for index in range(100):
        for row in draw(population, 2, 0, index, 1, (3, 3))[:, 0]:
            for amounts, (low, high) in (
                (row[1:10], population.damping),
                (row[10:], population.stiffness),
            ):
                values = np.linalg.eigvalsh(directions(3).T * amounts @ directions(3))
                assert low * (1 - 1e-9) <= values[0] <= values[-1] <= high * (1 + 1e-9)


def test_engines_agree_on_hands_in_space() -> None:
    space = scenario(
        f"damping = {rows(DAMPING)}", more=f', {{ between = ["block", "ground"], stiffness = {rows(STIFFNESS)} }}'
    )
    simulation = assemble(space, COUPLING)
    for _, crowd in Validation(space, COUPLING, 3, 6, 0, "both", 0.0).crowds(range(6)):
        each = variants(space.device, crowd)
        growths = [dominant_mode(loops).growth for loops in (
            exact_loops(each, simulation.F), close(mujoco_plants(each, simulation.process, substeps=8), simulation.F)
        )]  # fmt: skip
        assert np.abs(growths[0] - growths[1]).max() < 1e-6  # [1/s] RK4 x 8 erred by 4e-10 when measured
        assert (growths[0] != 0).all()


def test_saved_hands_have_the_plant_of_drawn_ones(tmp_path: Path) -> None:
    space = scenario()
    crowd = Validation(space, COUPLING, 3, 6, 2, "exact", 0.0).crowd(4)
    path = save_humans(tmp_path / "hands.toml", crowd.humans(0), "drawn")
    again = held_by(space, str(path))
    plants = [build(space.device, humans).plant.A for humans in (crowd.humans(0), again.human)]
    assert np.abs(plants[0] - plants[1]).max() < 1e-9 * np.abs(plants[0]).max()


def test_voluntary_motion_follows_its_direction() -> None:
    moved = Voluntary(0.015, 0.6, along=(3.0, 0.0, 4.0))
    space = scenario().replace(human=(Human((Link(0.3, 3.0, 200.0),), moved), Human((Link(0.3, 3.0, 200.0),))))
    w = outside_forces(space, build(space.device, space.human), 0, 300)
    alone = Human((Link(0.3, 3.0, 200.0),), Voluntary(0.015, 0.6)).voluntary_force(np.arange(300) * 1e-3)
    assert np.allclose(w[:, :3], alone[:, None] * [0.6, 0.0, 0.8], rtol=1e-12, atol=1e-15)
    assert not w[:, 3:6].any()


# ---- forces at their limits


def test_actuators_limit_forces_to_a_ball_or_box() -> None:
    process = assemble(scenario("force_limit = 3.0", "force_limit = [1.0, 2.0, 3.0]"), COUPLING).process
    wanted = 5 * np.random.default_rng(0).normal(size=(6, 400))
    applied = process.applied(wanted)
    ball, box = applied[:3], applied[3:]
    length = np.linalg.norm(wanted[:3], axis=0)
    assert np.allclose(ball, wanted[:3] * np.minimum(1, 3 / length), rtol=1e-14, atol=0)
    assert np.array_equal(box, np.clip(wanted[3:], [[-1.0], [-2.0], [-3.0]], [[1.0], [2.0], [3.0]]))
    limited = at_limit(applied[None], process.force_limit, process.balls)[0]
    assert np.array_equal(limited[0], length >= 3)


def test_clipped_runs_stay_within_the_ball() -> None:
    space = scenario("force_limit = 0.05", "force_limit = 0.05")
    simulation = assemble(space, COUPLING)
    push = partial(push_along, simulation.scene, np.array([1.0, 0.5, -0.7]))
    traces = [run(simulation, engine, push) for engine in ("exact", "mujoco")]
    lengths = np.linalg.norm(traces[0].f.reshape(-1, 2, 3), axis=2)
    assert lengths.max() <= 0.05 * (1 + 1e-14)
    assert traces[0].clipped(simulation.process.force_limit, simulation.process.balls).mean() > 0.1
    assert np.abs(traces[0].x - traces[1].x).max() < 1e-9


def test_reports_count_forces_without_a_solution(monkeypatch: pytest.MonkeyPatch) -> None:
    space = scenario("force_limit = 0.01", "force_limit = 0.01").replace(duration=0.1)
    lag = (5.0,) * 6
    assert run_scenario(space, COUPLING, lag).unsolved == 0
    for name in ("_NEWTON", "_HALVINGS", "_SPLIT"):
        monkeypatch.setattr(complementarity, name, 0)
    blocked = run_scenario(space, COUPLING, lag)
    # A force vector is 0 where no solution was found, and before the first delayed force arrives.
    zero = (blocked.trace.f.reshape(-1, 2, 3) == 0).all(axis=2).sum()
    assert 10 < blocked.unsolved <= zero
    assert run_scenario(space, COUPLING, lag).unsolved == blocked.unsolved


@pytest.mark.slow
def test_reports_say_held_torques_are_not_covered() -> None:
    rows = [dict(verdict.rows(assess(each.loop("I"), SpringDamper([3000.0] * m, [0.3] * m)))).get("held torques")
        for each, m in ((scenario(), 6), (line(), 2))]  # fmt: skip
    assert "not covered" in str(rows[0])
    assert rows[1] is None


def test_search_shares_a_multiplier_within_a_device() -> None:
    """Derivatives of `LimiterLoop.room` by gains and by one multiplier per device equal central differences."""
    loop = LimiterLoop(scenario('clamped = ["x"]', 'clamped = ["x"]').loop("I"))
    x = loop.point(SpringDamper([3000.0, 4000.0, 2000.0, 2500.0], [0.3, 0.4, 0.5, 0.2]))
    x[8:] += [0.1, -0.2, 0.3, 0.05]
    assert len(loop.multiplier(x)) == 2
    steps = 1e-6 * np.eye(x.size)
    differences = np.stack([(loop.room(x + step) - loop.room(x - step)) / 2e-6 for step in steps], axis=1)
    # Differences by steps of 1e-6 erred by 3e-8 of the largest when measured.
    assert np.abs(loop.room_slope(x) - differences).max() < 1e-5 * np.abs(differences).max()
