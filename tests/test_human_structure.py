"""Who holds which device: what the weights of Remark 1 buy, and where they buy nothing."""

import json

import numpy as np
import pytest

from cli import audit
from controller.coupling import Compliance, SpringDamper
from controller.environment import FIGURE_4, GROUND, Network, Spring, environment
from controller.lti import Lti
from controller.process import force_map
from design.certificate import Stored, data_of, save
from design.condition.human_structure import closed_loop_of_separate_humans, reciprocal, shared_weights, weighted
from design.conditions import closed_loop
from design.frequency import on_circle
from models.device import RigidDevice
from models.human import Cross, Human, Link, Person
from sim.run import assemble
from sim.scenario import Scenario, load
from sim.stability import exact_growth

T, DELTA = 1.2e-3, (1.37, 1.37)
WALLS = Network(("a", "b"), (Spring(("a", GROUND), 800.0, 1.0), Spring(("b", GROUND), 700.0, 1.0)))


def one_way(c: float) -> Compliance:
    """Springs of 1/6e-4 and 1/8e-4 N/m, and from channel 1 to 2 a high-pass that static forces do not pass."""
    high_pass = Lti([[0.9]], [[1.0, 0.0]], [[0.0], [c]], [[0.0, 0.0], [-10 * c, 0.0]], T)
    return Compliance(Lti.constant([[6e-4, 0.0], [0.0, 8e-4]], T) + high_pass)


def test_weights_certify_a_coupling_that_passes_force_one_way_only():
    F = force_map(environment(WALLS, T), one_way(1e-4), (1, 2), (0, 0))
    assert closed_loop(F, DELTA).ratio > 1.5
    requirement, d = closed_loop_of_separate_humans(F, DELTA, holders=(1, 2))
    assert requirement.ratio < 0.8
    # two separate loops, one driving the other, need what each needs alone
    alone = [closed_loop(force_map(environment(wall, T), SpringDamper([k], [0.0]), (n,), (0,)), (1.37,))
             for wall, k, n in zip(each_wall(), (1 / 6e-4, 1 / 8e-4), (1, 2), strict=True)]  # fmt: skip
    assert requirement.ratio == pytest.approx(max(r.ratio for r in alone), rel=1e-3)  # as the weights grow apart
    # the condition itself, from F on a dense grid
    z = on_circle(np.linspace(1e-3, np.pi, 5000))
    X = np.array(d)[:, None] * F.at(z) / (z - 1)[:, None, None]
    S = (X + np.conj(np.swapaxes(X, 1, 2))) / 2 + np.diag(np.array(d) * requirement.required) / T
    assert np.linalg.eigvalsh(S).min() > -1e-9 * np.abs(S).max()


def each_wall() -> list[Network]:
    return [Network(("a",), (Spring(("a", GROUND), k, 1.0),)) for k in (800.0, 700.0)]


def test_one_human_with_both_hands_is_given_no_weights():
    F = force_map(environment(WALLS, T), one_way(1e-4), (1, 2), (0, 0))
    requirement, d = closed_loop_of_separate_humans(F, DELTA, holders=(1, 1))
    assert d == (1.0, 1.0)
    assert requirement.ratio == closed_loop(F, DELTA).ratio


@pytest.mark.parametrize(
    "network", [FIGURE_4, WALLS, Network(("a", "b"), (*WALLS.springs, Spring(("a", "b"), 0.0, 9.0)))]
)
@pytest.mark.parametrize("theta", [(0, 0), (1, 2), (0, 5)])
def test_no_weights_help_a_reciprocal_loop(network, theta):
    """With a network behind a diagonal coupling equal weights are the best there are, whatever the delays."""
    F = force_map(environment(network, T), SpringDamper([900.0, 600.0], [0.4, 0.5]), theta, (0, 0))
    assert reciprocal(F)
    plain = closed_loop(F, DELTA).ratio
    for r in np.geomspace(0.03, 30, 12):
        d = np.array([1.0, r])
        other = closed_loop(weighted(F, d), tuple(d * DELTA)).ratio
        assert other >= plain - 1e-6  # a sweep is good to that


def test_static_stiffness_and_a_common_human_join_weights():
    coupled = np.array([[2.0, -1.0, 0.0], [-1.0, 2.0, 0.0], [0.0, 0.0, 1.0]])
    assert shared_weights(coupled, (1, 2, 3)) == [[0, 1], [2]]
    assert shared_weights(np.eye(3), (1, 2, 1)) == [[0, 2], [1]]
    assert shared_weights(coupled, (1, 2, 1)) == [[0, 1, 2]]


def two_walls(*persons: Person) -> Scenario:
    """The default devices and hands, each in front of a wall of its own: statically uncoupled."""
    return load().replace(name="two-walls", environment=WALLS, person=persons)


@pytest.mark.parametrize("together", [False, True])
def test_an_audit_asks_who_holds_what(tmp_path, together):
    both = Person(holds=(1, 2), mass=30.0, damping=80.0, stiffness=900.0, cross=Cross(0.0, 40.0))
    scenario = two_walls(both) if together else two_walls()
    assert len(set(scenario.holders)) == (1 if together else 2)
    file = tmp_path / "one-way.json"
    save(Stored(scenario.loop("I"), data_of(one_way(1e-4))), file)
    toml = tmp_path / "two-walls.toml"
    toml.write_text(TWO_WALLS + (PERSON if together else ""))
    result = tmp_path / "audit.json"
    options = ["--scenario", str(toml), "--coupling", str(file), "--json", str(result), "--out", str(tmp_path / "a")]
    assert audit.main(options) == 1  # the plain condition decides: whoever holds what
    part = json.loads(result.read_text())["separate-humans"]
    assert part["certified"] is not together
    assert part["proof"] == ("sampled" if together else "rational")
    assert (len(set(part["weights"])) > 1) is not together


TWO_WALLS = """
name = "two-walls"
T = 1.2e-3
theta = [1, 2]
psi = [0, 0]

[[device]]
kind = "rigid"
mass = 0.25
damping = 1.37
[[device]]
kind = "rigid"
mass = 0.25
damping = 1.37

[[human]]
links = [{ mass = 0.3, damping = 3.0, stiffness = 200.0 }]
[[human]]
links = [{ mass = 0.3, damping = 3.0, stiffness = 200.0 }]

[environment]
contacts = ["a", "b"]
springs = [
    { between = ["a", "ground"], stiffness = 800.0, damping = 1.0 },
    { between = ["b", "ground"], stiffness = 700.0, damping = 1.0 },
]
"""
PERSON = """
[[person]]
holds = [1, 2]
mass = 30.0
damping = 80.0
stiffness = 900.0
cross = { damping = 0.0, stiffness = 40.0 }
"""


def test_the_weights_do_matter():
    """A one-way coupling certified for separate humans only: one person in both devices makes it oscillate."""
    rng = np.random.default_rng(0)
    light = {"mass": 0.05, "damping": 1.37}
    scenario = two_walls().replace(device=(RigidDevice(**light), RigidDevice(**light)))
    V = one_way(3e-3)  # needs 32 times the damping if one person may hold both, 0.88 times for two
    alone, both = [], []
    for k in np.exp(rng.uniform(np.log(10.0), np.log(1e4), 60)):
        hands = (Human((Link(0.05, 0.01, 100.0),)),) * 2
        person = Person(holds=(1, 2), mass=1.0, damping=0.01, stiffness=100.0, cross=Cross(0.0, float(k)))
        alone.append(exact_growth(assemble(scenario.replace(human=hands), V)))
        both.append(exact_growth(assemble(scenario.replace(human=hands, person=(person,)), V)))
    assert max(alone) < 0
    assert max(both) > 0
