"""Walls solve a complementarity problem in each tick, return at most the stored energy, and are certified in loops."""

import msgspec
import numpy as np
import pytest
from driven import drive, random_walks
from evaluate import reported, this_environment
from messages import says
from scipy.optimize import brentq
from shared import FIGURE_4, SOFT, force_map, loop_of

from haptic_loop.cli.accuracy import main as accuracy
from haptic_loop.cli.run import main
from haptic_loop.controller.arithmetic import SingularLoop
from haptic_loop.controller.complementarity import Complementarity
from haptic_loop.controller.coupling import Coupling, NoCoupling, SpringDamper
from haptic_loop.controller.environment import GROUND, Network, Wall, environment, with_frozen_walls
from haptic_loop.controller.law import Law
from haptic_loop.controller.lti import Lti, taps
from haptic_loop.controller.tick import Process
from haptic_loop.design.assessment import assess
from haptic_loop.design.certificate import prove, required_damping, requirements_of
from haptic_loop.design.result import ANY, MAKING
from haptic_loop.models.device import CompliantDevice
from haptic_loop.models.hold import hold
from haptic_loop.models.human import Population
from haptic_loop.models.scene import crowds, variants
from haptic_loop.sim.engines import ExactEngine, MujocoBatchEngine
from haptic_loop.sim.run import assemble, run, run_blocks
from haptic_loop.sim.scenario import SCENARIOS, InputError, load, parse
from tests.evaluate import needs, safe_with

T = 1e-3
WALL = ("tip", GROUND)


def one(stiffness=1000.0, damping=0.0, gap=0.0) -> Network:
    return Network(("tip",), walls=(Wall(WALL, stiffness, damping, gap),))


def walled(network: Network, coupling, theta, psi) -> Process:
    """Return the process of a loop with walls whose actuators and encoders are ideal."""
    walls = loop_of(network, theta, psi, T).law(coupling)
    return Process(walls, np.full(walls.channels, np.inf), np.zeros(walls.channels))


@pytest.mark.parametrize("damping", [0.0, 0.3, 50.0])
def test_walls_return_at_most_their_stored_energy(damping):
    """f[k] (x[k] - x[k-1]) is at least the rise of the potential energy in every tick, up to rounding."""
    x = random_walks(2000, 1, 20)
    f = drive(walled(one(700.0, damping, 0.004), NoCoupling(), [0], [0]), x).f[:2000]
    depth = np.maximum(x - 0.004, 0)
    potential = 700.0 * depth**2 / 2
    assert (f[1:] * np.diff(x, axis=0) >= np.diff(potential, axis=0) - 1e-12 * 700).all()
    assert (f >= 0).all()  # a wall never pulls
    touching = depth > 0
    assert (touching[1:] & ~touching[:-1]).sum() > 100
    assert ((f == 0) & touching).any() == (damping > 0)  # with damping the force ends before contact does


@pytest.mark.parametrize("walls", [1, 2, 3, 4])
def test_the_wall_forces_solve_the_complementarity_problem(walls):
    """For positive definite, unsymmetric M: p >= 0, s = M p - q >= 0 and p' s = 0, to 1e-12 of the terms."""
    rng = np.random.default_rng(walls)
    for _ in range(20):
        root, turn = rng.normal(size=(2, walls, walls))
        M = np.diag(rng.uniform(1e-5, 1e-3, walls)) + 1e-3 * (root @ root.T + turn - turn.T)
        q = 1e-3 * rng.normal(size=(walls, 50))
        p = Complementarity(M).solve(q)
        s = M @ p - q
        scale = np.abs(M) @ p + np.abs(q)
        assert (p >= 0).all()
        assert (s >= -1e-12 * scale).all()
        assert (np.minimum(p * np.diag(M)[:, None], s) <= 1e-12 * scale).all()
        assert 0 < (p > 0).mean() < 1


def test_wall_forces_that_are_not_determined_are_refused():
    with pytest.raises(SingularLoop, match=r"forces of walls \[2\] are not determined"):
        Complementarity(np.array([[1.0, 0.0], [0.0, -1.0]]))
    with pytest.raises(SingularLoop, match=r"forces of walls \[1, 2\] are not determined"):
        Complementarity(np.ones((2, 2)))
    with pytest.raises(ValueError, match="a block of 1 x 2 cannot serve 0 channels and 2 walls"):
        Law(Lti.constant(np.ones((1, 2)), T), (), (Wall(("a", GROUND), 1.0),) * 2)


def test_a_wall_behind_a_coupling_matches_root_finding():
    """Brent's method solves K y + B (y - y-)/T = wall(u) with u = x - y, one equation in each tick."""
    K, B, stiffness, damping, gap = 900.0, 0.4, 3000.0, 2.0, 2e-3
    x = random_walks(400, 1, 1)[:, 0, 0]
    expected, y_old, h_old = [0.0], 0.0, 0.0  # theta = 1

    def push(u):
        h = max(0.0, u - gap)
        return max(0.0, stiffness * h + damping * (h - h_old) / T)

    for target in x:
        u = brentq(lambda u, t=target, y=y_old: K * (t - u) + B * (t - u - y) / T - push(u), -1.0, 1.0, xtol=1e-16)
        expected.append(push(u))
        y_old, h_old = target - u, max(0.0, u - gap)
    f = drive(walled(one(stiffness, damping, gap), SpringDamper([K], [B]), [1], [0]), x[:, None, None]).f[:400, 0, 0]
    np.testing.assert_allclose(f, expected[:400], rtol=0, atol=1e-9)  # brentq finds u to 1e-16 m, times 5000 N/m
    assert 0 < (f > 0).mean() < 1


class Weighted(Coupling):
    """A user's own coupling: V = (0.8 + 0.2/z)/900 on each of two channels."""

    def compliance(self, T):
        return Lti.diag(*[taps([0.8 / 900, 0.2 / 900], T)] * 2)


def test_a_wall_behind_an_own_coupling():
    """A wall between two contacts sends f = max(0, k w) with w = a - b - 2 (0.8 f + 0.2 f-)/900."""
    network = Network(("a", "b"), walls=(Wall(("a", "b"), 3000.0),))
    x = random_walks(60, 2, 1)
    f, expected = 0.0, []
    for a, b in x[..., 0]:
        expected.append(f := max(0.0, 3000 * (a - b - 2 * 0.2 / 900 * f) / (1 + 3000 * 2 * 0.8 / 900)))
    forces = drive(walled(network, Weighted(), [0, 0], [0, 0]), x).f[:60, :, 0]
    np.testing.assert_allclose(forces, np.outer(expected, [1, -1]), rtol=0, atol=1e-12)
    assert 0 < (forces > 0).mean() < 0.5
    with pytest.raises(ValueError, match="the coupling is 2 x 2, the environment has 1 contacts"):
        load("one-wall").loop("I").law(Weighted())


BOXED = Network(
    FIGURE_4.contacts,
    FIGURE_4.springs,
    FIGURE_4.masses,
    (
        Wall(("mass", GROUND), 5000.0, 3.0, 1e-3),
        Wall((GROUND, "mass"), 4000.0, 0.0, 2e-3),
        Wall(("contact 1", "contact 2"), 2000.0, 1.0, -1.0),
    ),
)


@pytest.mark.parametrize("coupling", [NoCoupling(), SpringDamper([2e4, 1e4], [1.0, 0.0])], ids=["none", "stiff"])
@pytest.mark.parametrize("psi", [(0, 0), (0, 2)])
def test_a_touching_wall_is_a_spring_damper(coupling, psi):
    """If walls always touch, two runs differ by as much as with spring-dampers in place of the walls."""
    walls = (Wall(("contact 1", GROUND), 5000.0, 3.0, -1.0), Wall(FIGURE_4.contacts, 2000.0, 1.0, -1.0))
    network = Network(BOXED.contacts, BOXED.springs, BOXED.masses, walls)
    x = random_walks(300, 2, 2)
    f = drive(walled(network, coupling, (1, 2), psi), x).f[:300]
    F = force_map(environment(with_frozen_walls(network), T), coupling, (1, 2), psi)
    linear = drive(Process(Law(F), np.full(2, np.inf), np.zeros(2)), x).f[:300]
    assert np.abs(f - linear).max() > 100  # the gaps add constant forces
    change, expected = f[..., 0] - f[..., 1], linear[..., 0] - linear[..., 1]
    np.testing.assert_allclose(change, expected, rtol=0, atol=1e-9)  # the gaps make forces of up to 11 kN


def test_frozen_walls_equal_springs_where_they_touch():
    walls = loop_of(BOXED, (1, 2), (0, 0), T).law(SOFT)
    z = np.exp(1j * np.array([0.02, 0.5, 3.0]))
    states = walls.frozen()
    assert len(states) == 8
    for touching, F in states.items():
        E = environment(with_frozen_walls(BOXED, touching), T)
        np.testing.assert_allclose(F.at(z), force_map(E, SOFT, (1, 2), (0, 0)).at(z), rtol=1e-8)
    np.testing.assert_allclose(walls.open.at(z), states[(False,) * 3].at(z), rtol=1e-9)


def test_walls_between_nodes_keep_the_whole_environment_passive():
    """The sum of f'dx is never negative if the run starts at rest with open walls."""
    network = Network(
        BOXED.contacts, BOXED.springs, BOXED.masses, (*BOXED.walls[:2], Wall(FIGURE_4.contacts, 2e3, 1, 1e-3))
    )
    process = walled(network, NoCoupling(), (0, 0), (0, 0))
    x = random_walks(3000, 2, 10)
    x -= x[0]
    buffer = drive(process, x)
    energy = np.cumsum((buffer.f[1:3000] * np.diff(x, axis=0)).sum(axis=1), axis=0)
    assert energy.min() > -1e-12 * energy.max()
    depths = process.law.depths(buffer.z) > 0
    assert ((depths[1:] & ~depths[:-1]).sum(axis=(0, 2)) > 50).all()  # every wall is hit


def boxed(scenario):
    walls = (Wall(("contact 1", GROUND), 20000.0, 0.0, 1e-3), Wall((GROUND, "contact 2"), 2000.0, 5.0))
    network = Network(FIGURE_4.contacts, FIGURE_4.springs, FIGURE_4.masses, walls)
    devices = tuple(CompliantDevice(force_limit=1e6) for _ in range(2))
    return scenario.replace(environment=network, device=devices, tap=None)


@pytest.mark.parametrize(
    ("name", "humans", "seconds"),
    [
        pytest.param("exact", 40, 3.0, marks=pytest.mark.slow),
        pytest.param("mujoco", 6, 3.0, marks=pytest.mark.validate),
    ],
)
def test_hands_on_walls_behind_certified_couplings_slow_down(name, humans, seconds):
    """Behind a certified coupling all hands slow down from the first to the last quarter, despite many contacts."""
    scenario = boxed(load())
    assert requirements_of(scenario.loop("I"), SOFT)["any-environment"].certified
    loop = assemble(scenario, SOFT)
    ((_, crowd),) = crowds(Population(damping=(0.3, 30.0)), 2, 0, range(humans), 1)
    sets = variants(scenario.device, crowd)
    exact = name == "exact"
    engine = ExactEngine(hold(sets.plants(), scenario.T)) if exact else MujocoBatchEngine(sets, scenario.T)
    n = sets.scene.model.nv
    start = np.zeros((2 * n, humans))
    start[n:] = np.random.default_rng(1).uniform(-0.3, 0.3, (n, humans))
    contacts, speed, strongest = np.zeros((2, humans)), np.zeros((4, humans)), 0.0
    ticks, outside = round(seconds / scenario.T), sets.scene.outside

    def look(buffer, first, count):
        nonlocal strongest
        touching = loop.process.law.depths(buffer.z) > 0
        i = min(4 * first // ticks, 3)
        contacts[min(i, 1)] += (touching[1:] & ~touching[:-1]).sum(axis=(0, 1))
        speed[i] += (buffer.s[:count, n:] ** 2).sum(axis=(0, 1))
        strongest = max(strongest, np.abs(buffer.f[:count]).max())

    run_blocks(loop.process, engine, lambda first, count: np.zeros((count, outside)), ticks, start, look)
    assert contacts.sum() > 10 * humans
    assert (contacts[0] > 0).mean() > 0.9
    assert strongest < loop.process.force_limit.min()
    assert (speed[-1] < 0.25 * speed[0]).all()


def test_both_engines_see_the_same_contacts():
    """The engines agree on the ticks of contact of a bouncing trace, and on its motion to 1e-6."""
    loop = assemble(load("one-wall").replace(duration=2.0), SpringDamper([900.0], [0.4]))
    exact, own = run(loop, "exact"), run(loop, "mujoco")
    depths = [loop.process.law.depths(record.z) > 0 for record in (exact, own)]
    np.testing.assert_array_equal(*depths)
    assert depths[0].shape == (len(exact.z) - 1, 1)
    assert (depths[0][1:] & ~depths[0][:-1]).sum() >= 1
    assert np.abs(exact.s[:, 0] - own.s[:, 0]).max() < 1e-6 * np.abs(exact.s[:, 0]).max()


@pytest.mark.slow
def test_a_run_reports_contact_and_its_certificate(tmp_path):
    def run(*options):
        quick = ["--scenario", "one-wall", "--duration", "3", "--engine", "exact", "--no-plot"]
        return reported(main, tmp_path, *quick, *options, "--out", str(tmp_path))[1]

    soft, bare = run(), run("--case", "none")
    assert safe_with(soft) == ANY
    assert any("any-environment covers it" in line for line in soft["remarks"])
    assert soft["stability"]["contact"]["made"] == 2
    assert [state["touching"] for state in soft["stability"]["contact"]["frozen"]] == [[], [1]]
    assert soft["stability"]["growth_rate_per_s"] is None
    assert "contact was made 2 times" in soft["stability"]["reason"]
    needed = needs(bare, "this-environment")["required_damping"]
    assert needed == pytest.approx([4.2221], rel=5e-5)  # computed separately: a bare wall, one sample late
    assert bare["assessment"]["guarantee"] is None
    assert any("no certificate covers it" in line for line in bare["remarks"])


def test_walls_need_more_damping_than_frozen_states():
    """Two walls make four linear loops; switching between them requires more damping than each by itself."""
    loop = boxed(load()).loop("I")
    requirement = requirements_of(loop, SOFT)["this-environment"]
    singles = [
        this_environment(
            force_map(environment(with_frozen_walls(loop.environment, state), loop.T), SOFT, (1, 2), (0, 0)), loop.delta
        )
        for state in [(False, False), (False, True), (True, False), (True, True)]
    ]
    assert requirement.ratio > max(single.ratio for single in singles)
    assert len({single.ratio for single in singles}) == 4
    assert requirement.proof == "rational"
    assert prove(loop, SOFT, "any-environment").guarantee == ANY
    late = boxed(load()).replace(psi=(1, 0)).loop("I")
    assert "no walls" in (requirements_of(late, SOFT)["any-environment"].reason or "")


def test_stiffer_couplings_are_certified_for_known_walls():
    """With B = 0.5 any-environment certifies up to 1032 N/m; this-environment certifies 1200 N/m with the wall.

    1772 N/m with B = 0.453 is certified only while the wall stays open or stays closed.
    """
    loop, coupling = load("one-wall").loop("I"), SpringDamper([1200.0], [0.5])
    assert required_damping(loop, coupling, "this-environment").certified
    assert not required_damping(loop, coupling, "any-environment").certified
    assert assess(loop, coupling, limiter=False).guarantee.environments == MAKING
    stiff = SpringDamper([1772.0], [0.453])
    assert not required_damping(loop, stiff, "this-environment").certified
    assert all(this_environment(state.F(stiff), loop.delta).certified for state in loop.frozen())
    assert required_damping(loop.at(with_frozen_walls(loop.network, [False])), coupling, "this-environment").ratio == 0


def test_couplings_with_a_model_refuse_walls():
    class Model(Coupling):
        holds_model = True

        def around(self, environment, further=0):
            return environment

    with pytest.raises(InputError, match="Model holds a linear model"):
        assemble(load("one-wall"), Model())


TEXT = (SCENARIOS / "one-wall.toml").read_text()
BAD = [
    ("stiffness = 3000.0", "stiffness = -1.0", "stiffness of the wall between tip and ground is -1.0"),
    ("stiffness = 3000.0", "stiffness = 0.0", "stiffness of the wall between tip and ground is 0"),
    ("gap = 0.005", "gap = inf", "gap of the wall between tip and ground is inf, expected a finite length"),
    ("gap = 0.005", "gab = 0.005", "`gab` .. `gap`"),
    ('"ground"]', '"tip"]', "between joins 'tip' to itself"),
    ('["tip", "ground"]', '["tap", "ground"]', "contact 'tip' has neither spring nor mass nor wall"),
]


@pytest.mark.parametrize(("old", "new", "message"), BAD, ids=[new for _, new, _ in BAD])
def test_a_bad_wall_gets_one_line(old, new, message):
    assert old in TEXT
    with pytest.raises(InputError) as caught:
        parse(TEXT.replace(old, new, 1))
    assert says(caught.value, message)


def test_more_than_six_walls_are_refused():
    with pytest.raises(InputError, match=r"environment.walls: expected `array` of length <= 6"):
        parse(TEXT.replace("walls = [", "walls = [" + 6 * '{ between = ["tip", "ground"], stiffness = 1.0 }, '))


def test_sim_accuracy_refuses_walls():
    with pytest.raises(InputError, match="accepts linear loops only"):
        accuracy(["--scenario", "one-wall"])


def test_files_without_walls_say_nothing_of_them():
    assert b"walls" not in msgspec.json.encode(FIGURE_4)
