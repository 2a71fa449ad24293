"""Backward-Euler networks equal closed forms and obey the laws of every passive network."""

from fractions import Fraction

import numpy as np
import pytest
from shared import FIGURE_4

from haptic_loop.controller.environment import GROUND, Network, Networks, Spring, Wall, environment, walled_environment

T = 1.2e-3
W = np.geomspace(1e-3, np.pi, 80)
Z = np.exp(1j * W)
S = (Z - 1) / (T * Z)


def test_figure_4_equals_its_closed_form():
    """E = Z - Z 1 1' Z / (M s^2 + 1' Z 1), Z = diag(K_i + B_i s)."""
    spring = np.array([800 + S, 700 + S])
    shared = spring[:, None] * spring[None, :] / (S**2 + spring.sum(axis=0))
    expected = np.moveaxis(np.eye(2)[:, :, None] * spring - shared, -1, 0)
    E = environment(FIGURE_4, T)
    np.testing.assert_allclose(E.at(Z), expected, rtol=1e-9)
    assert E.order == 4


def test_static_stiffness_of_figure_4_has_rank_one():
    stiffness = 800 * 700 / (800 + 700)
    np.testing.assert_allclose(environment(FIGURE_4, T).dc(), stiffness * np.array([[1, -1], [-1, 1]]), rtol=1e-12)


@pytest.mark.parametrize(
    ("network", "force"),
    [
        (Network(("a",), (Spring(("a", GROUND), 500.0, 2.0),)), 500 + 2 * S),
        (Network(("a",), (Spring(("a", GROUND), 500.0),)), 500 + 0 * S),
        (Network(("a",), masses={"a": 0.3}), 0.3 * S**2),
        (Network(("a",), (Spring(("a", "b"), 300.0), Spring(("b", GROUND), 600.0))), 200 + 0 * S),
        (Network(("a",), (Spring(("a", "b"), 300.0, 1.0),), {"b": 0.5}), 1 / (1 / (300 + S) + 1 / (0.5 * S**2))),
    ],
    ids=["wall", "spring", "held mass", "massless node", "mass on a spring"],
)
def test_small_networks_equal_their_closed_forms(network, force):
    np.testing.assert_allclose(environment(network, T).at(Z)[:, 0, 0], force, rtol=1e-7)


def test_a_changed_mass_changes_the_response():
    """E(z) is computed once per network, but the masses are a dict, which a user can change in place."""
    network = Network(("a",), masses={"a": 0.3})
    s = (Z - 1) / (T * Z)
    for mass in (0.3, 0.5, 0.3):
        network.masses["a"] = mass
        np.testing.assert_allclose(network.E(T).at(Z)[:, 0, 0], mass * s**2, rtol=1e-7)


PLANE = {"hand": ("hand.x", "hand.y"), "body": ("body.x", "body.y")}
OBLIQUE = (0.6, 0.8)


@pytest.mark.parametrize("period", [T, Fraction(12, 10000)])
def test_one_diagonal_spring_leaves_its_perpendicular_free(period):
    """The damper is in series with m s^2 + k along the spring, and with m s^2 across it."""
    springs = (Spring(("hand", "body"), 0.0, 5.0), Spring(("body", GROUND), 2000.0, along=OBLIQUE))
    E = environment(Network(PLANE["hand"], springs, {"body": 0.1}, points=PLANE), period).floats()
    damper, along, across = 5 * S, 0.1 * S**2 + 2000, 0.1 * S**2
    u, n = np.array(OBLIQUE), np.array([-0.8, 0.6])
    expected = sum((damper * z / (damper + z))[:, None, None] * np.outer(d, d) for d, z in ((u, along), (n, across)))
    np.testing.assert_allclose(E.at(Z), expected, rtol=1e-7, atol=1e-9)
    assert np.abs(np.linalg.eigvals(E.A)).max() < 0.999


def test_an_oblique_wall_obeys_its_equation():
    """Along its normal n the wall obeys (m s^2 + B s) y = B s n'x - p, with the wall's force p."""
    wall = Wall(("body", GROUND), 1000.0, normal=OBLIQUE)
    network = Network(PLANE["hand"], (Spring(("hand", "body"), 0.0, 5.0),), {"body": 0.1}, (wall,), points=PLANE)
    y = walled_environment(network, T).at(Z)[:, 2, :]
    alone = 0.1 * S**2 + 5 * S
    expected = np.array([0.6 * 5 * S / alone, 0.8 * 5 * S / alone, -1 / alone]).T
    np.testing.assert_allclose(y, expected, rtol=1e-7)


def oblique_networks(seed):
    rng = np.random.default_rng(seed)
    points = {name: tuple(f"{name}.{axis}" for axis in "xyz") for name in ("hand", "body", "other")}
    directions = rng.normal(size=(3, 3)).round(3).tolist()
    springs = [Spring(("hand", "body"), 0.0, 3.0), Spring(("body", "other"), 0.0, 1.0)]
    for _ in range(rng.integers(1, 6)):
        ends = tuple(rng.choice([*points, GROUND], 2, replace=False).tolist())
        springs.append(Spring(ends, rng.uniform(10, 3000), rng.uniform(0, 3), along=directions[rng.integers(3)]))
    return Network(points["hand"], tuple(springs), {"body": 0.1, "other": 0.2}, points=points)


@pytest.mark.parametrize("seed", range(20))
def test_oblique_networks_equal_their_dynamic_stiffness(seed):
    network = oblique_networks(seed)
    E = environment(network, T)
    M, D, K = network.matrices()
    stiffness = M * S[:, None, None] ** 2 + D * S[:, None, None] + K
    expected = stiffness[:, :3, :3] - stiffness[:, :3, 3:] @ np.linalg.solve(stiffness[:, 3:, 3:], stiffness[:, 3:, :3])
    # Rounding in the elimination of the masses was at most 1e-13 of the largest entry.
    np.testing.assert_allclose(E.at(Z), expected, rtol=0, atol=1e-11 * np.abs(expected).max())
    assert np.abs(np.linalg.eigvals(E.A)).max() < 1 - 1e-6


def test_directions_equal_up_to_rounding_are_refused():
    """Three directions in one plane span space only by the rounding of their lengths."""
    points = {"hand": ("h.x", "h.y", "h.z"), "body": ("b.x", "b.y", "b.z")}
    springs = [Spring(("body", GROUND), 2000.0, along=d) for d in ((1.0, 2.0, 3.0), (2.0, 1.0, 1.0), (3.0, 3.0, 4.0))]
    springs.append(Spring(("hand", "body"), 0.0, 5.0))
    network = Network(points["hand"], tuple(springs), {"body": 0.1}, points=points)
    with pytest.raises(ValueError, match=r"b.x, b.y, b.z"):
        environment(network, T)


def random_network(rng) -> Network:
    contacts = [f"c{i}" for i in range(rng.integers(1, 4))]
    inner = [f"n{i}" for i in range(rng.integers(0, 4))]
    nodes = [*contacts, *inner, GROUND]
    springs = [Spring((c, rng.choice([*inner, GROUND])), *np.exp(rng.uniform(-1, 7, 2)).tolist()) for c in contacts]
    springs += [Spring((n, rng.choice([*contacts, GROUND])), float(np.exp(rng.uniform(0, 7)))) for n in inner]
    for _ in range(rng.integers(0, 4)):
        a, b = rng.choice(nodes, 2, replace=False)
        springs.append(Spring((str(a), str(b)), float(rng.uniform(0, 900)), float(rng.uniform(0, 3))))
    masses = {n: float(np.exp(rng.uniform(-4, 1))) for n in inner if rng.random() < 0.7}
    return Network(tuple(contacts), tuple(springs), masses)


def test_stacked_networks_equal_single_ones():
    """Stacked and sampled networks equal single ones, although one network alone has fewer states."""
    other = (Spring(("contact 1", "mass"), 90.0, 0.0), Spring(("mass", "contact 2"), 5e3, 7.0))
    networks = [FIGURE_4, Network(FIGURE_4.contacts, other, FIGURE_4.masses)]
    matrices = tuple(np.stack(parts) for parts in zip(*(network.matrices() for network in networks), strict=True))
    z = np.stack([Z, Z[::-1]])
    many = Networks(FIGURE_4.contacts, matrices)
    sampled, stack = many.sampled(z, T), many.E(T)
    assert stack.count == 2
    for i, network in enumerate(networks):
        alone = environment(network, T).at(z[i])
        # near z = 1 the force of the free mass is the small difference of two large ones
        np.testing.assert_allclose(stack[i].at(z[i]), alone, rtol=1e-7)
        np.testing.assert_allclose(sampled.G[i], alone, rtol=1e-7)


@pytest.mark.parametrize("seed", range(25))
def test_random_networks_dissipate(seed):
    """T z/(z-1) E(z) is positive real on the circle, E is symmetric, and its poles are stable or at z = 1."""
    network = random_network(np.random.default_rng(seed))
    E = environment(network, T)
    G = E.at(Z)
    np.testing.assert_allclose(G, np.swapaxes(G, 1, 2), rtol=1e-6, atol=1e-7 * np.abs(G).max())
    power = G * (T * Z / (Z - 1))[:, None, None]
    least = np.linalg.eigvalsh(power + np.conj(np.swapaxes(power, 1, 2)))[:, 0]
    assert (least >= -1e-9 * np.abs(power).max(axis=(1, 2))).all()
    assert np.abs(E.poles()).max(initial=0.0) <= 1 + 1e-9
    M, D, K = network.matrices()
    c = len(network.contacts)
    for k in (5, 40):
        dynamic = M * S[k] ** 2 + D * S[k] + K
        schur = dynamic[:c, :c] - dynamic[:c, c:] @ np.linalg.solve(dynamic[c:, c:], dynamic[c:, :c])
        np.testing.assert_allclose(G[k], schur, rtol=1e-6, atol=1e-6 * np.abs(G).max())


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: Network(("a", "a")), "contacts must be different names"),
        (lambda: Network(("a",), (Spring(("a", "b"), 1.0),), {"c": 1.0}), "masses lists 'c'"),
        (lambda: Network(("a", "b"), (Spring(("a", GROUND), 1.0),)), "contact 'b' has neither spring nor mass"),
        (lambda: Spring(("a", "a"), 1.0), "to itself"),
        (lambda: Spring(("a", "b"), -1.0), "stiffness between a and b is -1.0"),
        (lambda: environment(Network(("a",), (Spring(("a", GROUND), 1.0), Spring(("b", "c"), 1.0))), T), "nothing"),
    ],
)
def test_bad_networks_are_refused(build, message):
    with pytest.raises(ValueError, match=message):
        build()
