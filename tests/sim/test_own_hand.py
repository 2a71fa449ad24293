"""A user's own class of hands, written here, works in both engines, in verdicts and in random draws.

Tolerances without a comment cover rounding.
"""

import json
from dataclasses import dataclass, replace

import msgspec
import numpy as np
import pytest

from haptic_loop import design_coupling, load, simulate, validate
from haptic_loop.cli.run import main
from haptic_loop.cli.validate import main as validate_command
from haptic_loop.controller.coupling import PUBLISHED, NoCoupling
from haptic_loop.controller.delay import Periods
from haptic_loop.models.hold import hold
from haptic_loop.models.human import Human, Link, Person, Port, state_space
from haptic_loop.models.scene import variants
from haptic_loop.sim.adversary import search_population
from haptic_loop.sim.crowds import Validation
from haptic_loop.sim.run import assemble, make_engine, run
from haptic_loop.sim.scenario import InputError, _load_humans
from haptic_loop.sim.stability import close, dominant_mode
from haptic_loop.sim.verdicts import disagreement_words

AGREE = 1e-6  # largest relative rms difference between the engines' positions
SCENARIO = load().replace(duration=1.5)


@dataclass(frozen=True)
class Muscle:
    """A hand with Hill's muscle: a damper behind a series spring, the tissue's mass between them, a parallel spring.

    The muscle's force lags behind the motion by damping / elastic."""

    mass: float = 0.25  # [kg]
    elastic: float = 400.0  # [N/m]
    damping: float = 9.0  # [N s/m]
    parallel: float = 150.0  # [N/m]
    tissue: float = 0.02  # [kg]
    skin: float = 0.0  # [N s/m] beside the parallel spring
    pull: float = 1.5  # [N]

    def port(self):
        across = [[-1, 1, 0], [0, -1, 1], [-1, 0, 1]]  # points: hand, tissue, base
        damping, stiffness = [0, self.damping, self.skin], [self.elastic, 0, self.parallel]
        return Port([self.mass, self.tissue], across, damping, stiffness, pull=2)

    def voluntary_force(self, t):
        return self.pull * np.sin(2 * np.pi * 0.7 * t)


class MuscleBySpace(Muscle):
    """`Muscle` as a state space; states: length of the series spring, speed of the tissue, position of the hand."""

    def port(self):
        k, b, m = self.elastic, self.damping, self.tissue
        A = [[0, -1, 0], [k / m, -b / m, 0], [0, 0, 0]]
        return state_space(A, [[1], [0], [1]], [[k, 0, self.parallel]], self.skin, mass=self.mass)


class Light(Muscle):
    """`Muscle` without the tissue's mass, as a state space, because a body of MuJoCo cannot be massless."""

    def port(self):
        tau = self.damping / self.elastic
        A, C = [[-1 / tau, 0], [0, 0]], [[self.damping, self.parallel]]
        return state_space(A, [[1 / tau], [1]], C, self.skin, mass=self.mass)


def held_by(*hands):
    return SCENARIO.replace(human=hands)


def rms(a, b):
    """Return the rms of a - b over that of b."""
    return np.sqrt(np.mean(np.square(a - b)) / np.mean(np.square(b)))


def test_engines_agree_on_own_hands():
    scenario = held_by(Muscle(), Muscle(elastic=900.0, tissue=0.03))
    exact, mujoco = (simulate(scenario, PUBLISHED["I"], engine=engine) for engine in ("exact", "mujoco"))
    assert np.abs(exact.x).max() > 2e-3  # the muscles move the devices
    assert rms(mujoco.x, exact.x) < AGREE
    for record in (exact, mujoco):
        assert record.meta["stability"]["verdict"] == "stable"


def test_matrices_and_bodies_give_equal_runs():
    """The state space of a hand gives the trace of its bodies, up to rounding."""
    bodies, space = (
        simulate(held_by(hand, hand), PUBLISHED["I"], engine="exact") for hand in (Muscle(), MuscleBySpace())
    )
    # The rounding of 1250 ticks adds up, to less than 1e-9 of each signal's rms.
    assert rms(space.x, bodies.x) < 1e-9
    assert rms(space.v_handle, bodies.v_handle) < 1e-9
    assert rms(space.f, bodies.f) < 1e-9


def test_a_vanishing_tissue_mass_changes_nothing():
    """Half the tissue's mass halves the difference to the hand without tissue."""
    light = simulate(held_by(Light(), Light()), PUBLISHED["I"], engine="exact").x
    off = [
        rms(simulate(held_by(h, h), PUBLISHED["I"], engine="exact").x, light)
        for h in (Muscle(tissue=1e-3), Muscle(tissue=5e-4))
    ]
    assert off[0] < 1e-2  # 2e-4 when measured
    # The difference has a small part of second order in the tissue's mass.
    assert off[0] / off[1] == pytest.approx(2.0, abs=0.1)


def test_with_impedances_only_the_exponential_integrator_is_exact():
    """With hands as state spaces the exponential integrator is exact up to rounding, and RK4 is of second order."""
    simulation = assemble(held_by(Light(), MuscleBySpace()), PUBLISHED["I"])
    exact = run(simulation, "exact")
    assert rms(run(simulation).s, exact.s) < 1e-10  # rounding
    coarse, fine = (rms(run(simulation, make_engine(simulation, "mujoco", "RK4", n)).x, exact.x) for n in (4, 8))
    assert coarse < 1e-5  # 6e-7 when measured
    assert np.log2(coarse / fine) == pytest.approx(2.0, abs=0.1)  # terms of higher order


def test_impedances_run_in_uneven_late_ticks():
    uneven = {"period": Periods(1e-3, 1.2e-3), "latency": ((1e-4, 5e-4), (0.0, 3e-4)), "duration": 0.3}
    simulation = assemble(held_by(Light(), MuscleBySpace()).replace(**uneven), PUBLISHED["I"])
    exact = run(simulation, "exact")
    # RK4 erred by 7e-7 when measured.
    for integrator, least in (("exponential", 1e-10), ("RK4", 1e-5)):
        assert rms(run(simulation, make_engine(simulation, "mujoco", integrator)).x, exact.x) < least


@pytest.mark.slow
def test_friction_with_an_impedance_needs_runge_kutta():
    rubbing = held_by(Light(), Light())
    devices = tuple(msgspec.structs.replace(device, friction=0.2) for device in rubbing.device)
    simulation = assemble(rubbing.replace(device=devices), PUBLISHED["I"])
    with pytest.raises(InputError, match=r"a human has an impedance .* and a device has friction: use integrator RK4"):
        make_engine(simulation, "mujoco", "exponential")
    coarse, fine = (run(simulation, make_engine(simulation, "mujoco", "RK4", n)).x for n in (4, 16))
    assert rms(coarse, fine) < 1e-4  # RK4 is of first order where a device sticks


@pytest.mark.slow
def test_impedance_populations_agree_in_both_engines():
    findings = validate(held_by(Light(), Light()).replace(population=Muscles(Light)), None, humans=10, duration=0.3)
    assert 0 < (findings.exact > 0).sum() < 10
    assert not findings.disagreements.any()
    # RK4 gives the rates `mujoco`: when measured, they were within 3e-4 1/s.
    np.testing.assert_allclose(findings.mujoco, findings.exact, atol=2e-2, rtol=1e-3)
    np.testing.assert_allclose(findings.trace, findings.exact, atol=2e-2, rtol=1e-3)


@dataclass(frozen=True)
class Muscles:
    """A user's own population: fields of `kind`, in their order, are uniform in their logarithms."""

    kind: type[Muscle] = Muscle

    def draw(self, rng, n):
        low, high = np.log([[0.02, 50, 0.5, 5, 5e-3, 0.1], [2.0, 2000, 30, 800, 0.1, 30]])
        return [self.kind(*np.exp(rng.uniform(low, high))) for _ in range(n)]


def test_own_hand_populations_agree_in_both_engines():
    """Without coupling some hands make the loop unstable; both engines agree which, and a repetition gives the same."""
    scenario = SCENARIO.replace(population=Muscles())
    findings = validate(scenario, None, humans=40, duration=0.5)
    assert 0 < (findings.exact > 0).sum() < 40
    assert not findings.disagreements.any()
    # RK4 gives the rates `mujoco`: when measured, they were within 4e-4 1/s.
    np.testing.assert_allclose(findings.mujoco, findings.exact, atol=2e-2, rtol=1e-3)
    contradicted, question = (
        replace(findings, mujoco=-findings.exact),
        Validation(scenario, NoCoupling(), 0, 40, 1, "both", 0.5),
    )
    assert "repeat" not in disagreement_words(question, contradicted)  # No file can store these hands.
    again = validate(scenario, None, humans=10, duration=0.0, engine="exact")
    np.testing.assert_array_equal(again.exact, findings.exact[:10])
    assert findings.mass.shape == (40,)
    assert (findings.damping == 0).all()  # the series spring has no damper


@pytest.mark.slow
def test_the_adversary_searches_the_populations_hands():
    """The search finds more growth than random draws, a quarter as many, and reports the true growth of its hands."""
    population = Muscles()
    scenario = SCENARIO.replace(population=population)
    F = assemble(scenario, NoCoupling()).F
    worst = search_population(scenario, F, seed=1, generations=4)
    random = validate(scenario, None, humans=worst.evaluated // 4, seed=1, duration=0.0, engine="exact").exact.max()
    assert worst.growth > random
    assert all(isinstance(hand, Muscle) and 0.02 <= hand.mass <= 2.0 for hand in worst.humans)
    alone = assemble(scenario.replace(human=worst.humans), NoCoupling())
    assert dominant_mode(close(alone.plant, F)).growth == pytest.approx(worst.growth, rel=1e-9)
    assert search_population(scenario, F, seed=1, generations=4) == worst


class Mixed:
    """A population of two kinds of hands: one has a body for the tissue, the other has none."""

    def draw(self, rng, n):
        return [hand for _ in range(n) for hand in Muscles((Muscle, Light)[rng.integers(2)]).draw(rng, 1)]


@pytest.mark.slow
def test_the_adversary_fails_against_enough_damping():
    """The published gains need 1.3987 N s/m; with 1.42 N s/m no hand that is searched destabilises the loop."""
    scenario = SCENARIO.replace(delta=(1.42, 1.42), population=Mixed())
    worst = search_population(scenario, assemble(scenario, PUBLISHED["I"]).F, generations=1)
    assert not worst.destabilises


def test_a_force_for_single_times_is_refused():
    """The force of a hand is computed for an array of times."""

    class Late(Muscle):
        def voluntary_force(self, t):
            return 1.0 if t > 0.1 else 0.0

    with pytest.raises(InputError, match=r"human #1.voluntary_force\(t\) fails for an array t of two times: "):
        held_by(Late(), Muscle())


@pytest.mark.slow
def test_the_adversary_takes_a_population_file(tmp_path):
    file, report = tmp_path / "who.py", tmp_path / "r.json"
    file.write_text(
        "import numpy as np\nfrom haptic_loop.models.human import Port\n"
        "class Grip:\n"
        "    def __init__(self, m, k): self.m, self.k = m, k\n"
        "    def port(self): return Port([self.m], [[-1, 1]], [0.2], [self.k])\n"
        "    def voluntary_force(self, t): return 0 * t\n"
        "class Grips:\n"
        "    def draw(self, rng, n): return [Grip(*np.exp(rng.uniform([-4, 2], [1, 8]))) for _ in range(n)]\n"
        "population = Grips()\n"
    )
    words = [
        "--case",
        "none",
        "--human",
        f"{file}:population",
        "--humans",
        "5",
        "--duration",
        "0",
        "--engine",
        "exact",
        "--no-plot",
    ]
    words += ["--adversary", "--generations", "3", "--out", str(tmp_path / "out"), "--json", str(report)]
    assert validate_command(words) == 0
    worst = json.loads(report.read_text())["adversary_population"]
    assert worst["found"]
    assert worst["evaluated"] == 360  # three generations of 120 sets
    assert [human["class"] for human in worst["human"]] == ["Grip", "Grip"]


def test_population_verdicts_equal_those_of_single_hands():
    scenario = SCENARIO.replace(population=Muscles(Light))
    findings = validate(scenario, PUBLISHED["I"], humans=6, duration=0.0, engine="exact")
    for i in (0, 5):
        hands = Validation(scenario, PUBLISHED["I"], 0, 20, 1, "exact", 0.0).crowd(i).humans(0)
        simulation = assemble(scenario.replace(human=hands), PUBLISHED["I"])
        assert findings.exact[i] == pytest.approx(dominant_mode(close(simulation.plant, simulation.F)).growth, abs=1e-9)
        assert findings.mass[i] == pytest.approx(np.sqrt(hands[0].mass * hands[1].mass))


def test_a_person_may_hold_with_own_hands():
    person = Person((1, 2), 20.0, 15.0, 900.0)
    scenario = held_by(Muscle(), Human((Link(0.3, 3.0, 200.0),))).replace(person=(person,))
    exact, mujoco = (simulate(scenario, PUBLISHED["I"], engine=engine) for engine in ("exact", "mujoco"))
    assert rms(mujoco.x, exact.x) < AGREE
    alone = simulate(scenario.replace(person=()), PUBLISHED["I"], engine="exact")
    assert rms(exact.x, alone.x) > 1e-3


def test_scenarios_keep_own_hands():
    scenario = held_by(Muscle(), Human((Link(0.3, 3.0, 200.0),)))
    assert scenario.replace(theta=(2, 2)).human == scenario.human
    assert len({held_by(Muscle(mass=m), Muscle()).digest for m in (0.2, 0.3, 0.3)}) == 2
    with pytest.raises(InputError, match="human has 1 "):
        held_by(Muscle())
    with pytest.raises(InputError, match="human #2 is None, expected a Human"):
        held_by(Muscle(), None)
    with pytest.raises(InputError, match="damping has a negative"):
        held_by(Muscle(), Muscle(damping=-1.0))


def test_the_command_takes_hands_from_a_python_file(tmp_path, capsys):
    hands = tmp_path / "my_hands.py"
    hands.write_text(
        "from haptic_loop.models.human import Port\n"
        "class Soft:\n"
        "    def port(self): return Port([0.2], [[-1, 1]], [2.0], [90.0])\n"
        "    def voluntary_force(self, t): return 0 * t\n"
        "humans = (Soft(), Soft())\none = (Soft(),)\n"
    )
    words = ("--case", "none", "--duration", "0.2", "--no-plot", "--out", str(tmp_path / "out"))
    assert main([*words, "--human", f"{hands}:humans"]) == 0
    assert "unstable" in capsys.readouterr().out
    with pytest.raises(InputError, match="has 1 hands, expected 2"):
        main([*words, "--human", f"{hands}:one"])


def test_files_define_measured_hands_and_populations(tmp_path):
    """A state space in TOML is checked and simulated; a Python file may define a population."""
    file = tmp_path / "hands.toml"
    space = "[[human]]\nmass = 0.2\nA = [[-30.0]]\nB = [[1.0]]\nC = [[{C}]]\nD = [[2.0]]\n"
    chain = "[[human]]\nlinks = [{ mass = 0.3, damping = 3.0, stiffness = 200.0 }]\n"
    file.write_text(space.format(C=200.0) + chain)
    people = _load_humans(str(file), 2).human
    assert people[0].port().impedance.order == 1
    run = simulate(SCENARIO.replace(human=people, duration=0.5), PUBLISHED["I"], engine="exact")
    assert run.meta["stability"]["exact_verdict"] == "stable"
    for text, message in [
        (space.format(C=-200.0) + chain, "human #1: impedance: not passive"),
        (space.format(C='"x"') + chain, "human #1.C #1 #1 = 'x': expected `float`"),
        (chain.replace("mass", "mas") + chain, "human #1.links #1: object contains unknown field `mas`"),
    ]:
        file.write_text(text)
        with pytest.raises(InputError) as caught:
            _load_humans(str(file), 2)
        assert message in str(caught.value)
    python = tmp_path / "drawn.py"
    python.write_text(
        "from haptic_loop.models.human import Human, Link\n"
        "class Draw:\n    def __init__(self, drawn): self.drawn = drawn\n"
        "    def draw(self, rng, n): return self.drawn[:n]\n"
        "good, none, wrong = Draw([Human((Link(0.3, 3.0, 200.0),))] * 3), Draw([]), Draw([1, 1])\n"
        "number = 1\n"
    )
    assert len(_load_humans(f"{python}:good", 2).population.draw(None, 3)) == 3
    for name, message in [
        ("none", "draw(rng, 2) does not return two humans"),
        ("wrong", "human #1 is 1, expected a Human"),
        ("number", "the value is 1, neither a list of hands"),
    ]:
        with pytest.raises(InputError) as caught:
            _load_humans(f"{python}:{name}", 2)
        assert message in str(caught.value)


def test_a_state_space_is_refused_as_a_coupling():
    with pytest.raises(TypeError, match=r"wrap it in Compliance\(\.\.\.\)"):
        simulate(SCENARIO, PUBLISHED["I"].compliance(SCENARIO.T))


@pytest.mark.slow
def test_engines_agree_on_a_population_at_walls():
    """The engines agree, traces touch the wall and give no energy, and a hand's growth is that of its worst contact."""
    scenario = load("one-wall")
    coupling = design_coupling(scenario.loop("I"), "spring-damper", "any-environment")
    findings = validate(scenario, coupling, humans=20, duration=2.0)
    assert (findings.exact < 0).all()
    assert not findings.disagreements.any()
    assert findings.contacts.sum() > 10
    assert (findings.energy >= -1e-9 * findings.audited).all()
    # The growth is the larger growth of the open and the touching loop with this human.
    simulation = assemble(scenario, coupling.coupling)
    crowd = Validation(scenario, coupling.coupling, 0, 20, 1, "exact", 0.0).crowd(7)
    plant = hold(variants(scenario.device, crowd).plants(), scenario.T)
    states = simulation.process.law.frozen().values()
    growth = max(float(dominant_mode(close(plant, F)).growth[0]) for F in states)
    assert findings.exact[7] == pytest.approx(growth, rel=1e-9)
    assert (validate(scenario, None, humans=20, duration=0.0).exact > 0).any()
