"""Users define environments by elements of springs and walls, by the numbers of E(z), or by a class with E(T)."""

from dataclasses import dataclass

import msgspec
import numpy as np
import pytest

from haptic_loop import load
from haptic_loop.controller.arithmetic import rational
from haptic_loop.controller.environment import Block, Network, Spring, Wall, _parts_of, environment
from haptic_loop.controller.lti import Lti
from haptic_loop.controller.passivity import hermitian_floor, sizes_around
from haptic_loop.design.exact import negative_minor
from haptic_loop.sim.scenario import InputError

T = 1e-3
SQUARE = np.exp(1j * np.array([1e-3, 0.01, 0.1, 1.0, 3.0]))
#: a network with inerters between a contact and an inner node, two inner nodes, and a contact and ground
INERT = Network(
    ("a", "b"),
    (
        Spring(("a", "m"), 300.0, 1.0, 0.05),
        Spring(("m", "n"), 250.0, 0.0, 0.03),
        Spring(("n", "b"), 200.0, 0.5),
        Spring(("b", "ground"), 0.0, 0.1, 0.02),
    ),
    {"m": 0.3, "n": 0.1},
)


@dataclass
class Hardening:
    between: tuple[str, str]
    stiffness: float
    step: float

    def parts(self):
        (a, b), k = self.between, self.stiffness
        return [Spring((a, b), k), Wall((a, b), 3 * k, gap=self.step), Wall((b, a), 3 * k, gap=self.step)]


def test_an_inerter_equals_its_dynamic_stiffness():
    """In floats E(z) = Z_cc - Z_ci Z_ii^-1 Z_ic at s = (z-1)/(Tz); over Fractions D is the same."""
    E = environment(INERT, T)
    (M, D, K), c = INERT.matrices(), slice(None, 2)
    inner = slice(2, None)
    for z in SQUARE:
        s = (z - 1) / (T * z)
        Z = M * s**2 + D * s + K
        expected = Z[c, c] - Z[c, inner] @ np.linalg.solve(Z[inner, inner], Z[inner, c])
        np.testing.assert_allclose(E.at(np.array([z]))[0], expected, rtol=1e-11, atol=1e-11 * np.abs(expected).max())
    exact = environment(INERT, rational(T))
    np.testing.assert_allclose(exact.D.astype(float), E.D, rtol=1e-12)


def test_inertance_is_stored_only_if_given():
    assert b"inertance" not in msgspec.json.encode(Spring(("a", "b"), 1.0))
    assert msgspec.json.decode(msgspec.json.encode(INERT), type=Network) == INERT


def test_elements_become_springs_and_walls():
    network = Network(("a",), (Spring(("a", "ground"), 5.0),), elements=(Hardening(("a", "ground"), 100.0, 2e-3),))
    assert [spring.stiffness for spring in network.springs] == [5.0, 100.0]
    assert [wall.between for wall in network.walls] == [("a", "ground"), ("ground", "a")]
    assert network.elements == ()
    assert network == msgspec.json.decode(msgspec.json.encode(network), type=Network)
    with pytest.raises(ValueError, match="element int: it is 3, expected a class whose parts"):
        _parts_of(3)
    with pytest.raises(ValueError, match=r"the network has 8 walls.*6"):
        Network(("a",), elements=(Hardening(("a", "ground"), 100.0, 2e-3),) * 4)


def test_a_block_equals_the_network_of_its_numbers():
    """The block, alone and beside a spring, may add 2e-6 of its gain as a spring. Over Fractions its A is exact."""
    E = environment(INERT, T)
    alone = Network(INERT.contacts, block=Block.of(E))
    np.testing.assert_allclose(environment(alone, T).at(SQUARE), E.at(SQUARE), rtol=2e-6)
    spring = (Spring(("a", "b"), 70.0, 0.2),)
    beside, full = (msgspec.structs.replace(n, springs=(*n.springs, *spring)) for n in (alone, INERT))
    np.testing.assert_allclose(beside.E(T).at(SQUARE), full.E(T).at(SQUARE), rtol=2e-6)
    exact = alone.E(rational(T))
    assert all(rational(a) == b for a, b in zip(E.A.ravel(), exact.A.ravel(), strict=True))
    with pytest.raises(ValueError, match=r"block: its numbers are for T = 0.001 s, the loop has 0.002 s"):
        alone.E(2e-3)


@pytest.mark.parametrize(
    ("E", "message"),
    [
        (Lti.constant([[-1.0]], T), "not passive"),
        (Lti([[0.0]], [[1.0]], [[300.0]], [[0.0]], T), "not passive, it generates energy at"),  # a delayed spring
        (Lti.constant([[0.0, 1.0], [-1.0, 0.0]], T), "not passive"),
        (Lti([[1.0]], [[1.0]], [[1.0]], [[1.0]], T), "an eigenvalue on or outside the unit circle"),
        (Lti.constant([[1.0, 0.0]], T), r"D is \[\[1.0, 0.0\]\], expected 1 rows of 1 numbers"),
    ],
)
def test_active_or_malformed_blocks_are_refused(E, message):
    with pytest.raises(ValueError, match=message):
        Block.of(E)


def resonance(width: float, angle: float, size: float = 1.5, floor: float = 500.0) -> Lti:
    """Return E = H (1 - 1/z), with r = size e^(j angle), p = (1 - width) e^1.2j and r*, p* their conjugates.

    H = floor + r/(1 - p/z) + r*/(1 - p*/z) has a real part of about floor + size cos(angle)/width at the resonance.
    """
    p, r = (1 - width) * np.exp(1.2j), size * np.exp(1j * angle)
    turn = np.array([[p.real, -p.imag], [p.imag, p.real]])
    H = Lti(turn, [[1.0], [0.0]], [[2 * (r * p).real, -2 * (r * p).imag]], [[floor + 2 * r.real]], T)
    return H @ Lti([[0.0]], [[1.0]], [[-1.0]], [[1.0]], T)


@pytest.mark.parametrize("width", [1e-3, 1e-5, 1e-6, 1e-7, 1e-9])
def test_no_narrow_resonance_hides_from_passivity(width):
    """A block is accepted if and only if He [E/(1 - 1/z)] = He H is positive on a fine sweep around the resonance."""
    w = 1.2 + np.concatenate([width * np.linspace(-50, 50, 4001), np.linspace(-1.2, 1.9, 2001)])
    verdicts = set()
    for size, angle in ((1.5, 1.536), (1.5, 1.6), (1.0, 0.0), (30 * width, 1.6), (200 * width, 3.0), (400 * width, 2)):
        p, r = (1 - width) * np.exp(1.2j), size * np.exp(1j * angle)
        z = np.exp(1j * w)
        power = (500 + r / (1 - p / z) + r.conjugate() / (1 - p.conjugate() / z)).real.min()
        assert abs(power) > 1
        verdicts.add(passive := power > 0)
        if passive:
            Block.of(resonance(width, angle, size))
        else:
            with pytest.raises(ValueError, match=r"not passive, it generates energy at 19[01]"):
                Block.of(resonance(width, angle, size))
    assert verdicts == {True, False}


@pytest.mark.parametrize("count", [12, pytest.param(30, marks=pytest.mark.validate)])
def test_the_bound_is_below_every_sample(count):
    """`hermitian_floor` of random stable blocks is below a dense sweep around all poles, by at most 0.2 %."""
    rng = np.random.default_rng(11)
    for _ in range(count):
        n, m = int(rng.integers(1, 7)), int(rng.integers(1, 4))
        A = rng.normal(size=(n, n))
        A *= (1 - 10 ** rng.uniform(-6, -0.5)) / np.abs(np.linalg.eigvals(A)).max()
        G = Lti(A, rng.normal(size=(n, m)), rng.normal(size=(m, n)), rng.normal(size=(m, m)) + 3 * np.eye(m), T)
        poles = np.linalg.eigvals(A)
        near = np.abs(np.angle(poles))[:, None] + (1 - np.abs(poles))[:, None] * np.linspace(-30, 30, 2001)
        w = np.concatenate([np.linspace(0, np.pi, 5001), near.ravel()])
        response = G.at(np.exp(1j * w))
        sampled = np.linalg.eigvalsh((response + response.conj().swapaxes(1, 2)) / 2)[:, 0].min()
        floor, least, _ = hermitian_floor(G, sampled - 1e-3 * abs(sampled), -np.inf)
        assert floor <= sampled + 1e-9 * abs(sampled)
        assert floor <= least
        assert floor >= sampled - 2e-3 * abs(sampled)


def test_a_block_is_bounded_away_from_its_poles():
    """`sizes_around` bounds sharply resonant random blocks on circles of complex frequencies, or is inf near poles."""
    rng = np.random.default_rng(12)
    for _ in range(20):
        n, m = int(rng.integers(1, 7)), int(rng.integers(1, 4))
        A = rng.normal(size=(n, n))
        A *= (1 - 10 ** rng.uniform(-6, -0.5)) / np.abs(np.linalg.eigvals(A)).max()
        G = Lti(A, rng.normal(size=(n, m)), rng.normal(size=(m, n)), rng.normal(size=(m, m)), T)
        poles = np.linalg.eigvals(A)
        w, radius = rng.uniform(0, np.pi, 40), 10 ** rng.uniform(-6, -0.5, 40)
        w[: n // 2] = np.abs(np.angle(poles))[: n // 2]
        bounds, errors = sizes_around(G, w, radius)
        for middle, r, bound, error in zip(w, radius, bounds, errors, strict=True):
            z = np.exp(1j * (middle + r * np.exp(2j * np.pi * np.arange(24) / 24)))
            sizes = np.linalg.norm(G.C @ np.linalg.solve(z[:, None, None] * np.eye(n) - A, G.B) + G.D, axis=(1, 2))
            assert (sizes <= bound).all()
            assert np.isinf(bound) or np.abs(poles - np.exp(1j * middle)).min() > np.expm1(r)
            assert 0 < error < 1e-6 * bound or np.isinf(bound)
        assert np.isfinite(bounds).any()


def test_blocks_of_barely_passive_networks_are_accepted():
    """The block of a barely passive network gets a spring of at most 2e-6 of its mean gain."""
    between = (Spring(("a", "m"), 1000.0), Spring(("m", "b"), 700.0))
    for network in (
        Network(("a",), masses={"a": 0.3}),
        Network(("a", "b"), (Spring(("a", "b"), 1000.0, 2.0),)),
        Network(("a", "b"), between, {"m": 0.3}),
        Network(("a", "b"), between, {"m": 0.3, "a": 0.1}),
    ):
        E = environment(network, T)
        z = np.exp(1j * np.geomspace(1e-2, np.pi, 300))
        gain = np.linalg.norm(E.at(z), axis=(1, 2)).mean()
        added = Block.of(E).at(T).at(z) - E.at(z)
        assert np.abs(added).max() <= 2e-6 * gain
        flow = (1 - z)[:, None, None] * Block.of(E).at(T).at(z)
        assert np.linalg.eigvalsh(flow + flow.conj().swapaxes(1, 2)).min() >= -1e-15 * gain


class Gel:
    contacts = ("left", "right")

    def E(self, T):
        return Network(self.contacts, (Spring(self.contacts, 600.0, 2.0),)).E(T)


def test_maxwell_elements_are_passive_despite_rounding():
    """A spring and a damper in series have E(1) = 0; in floats it is a difference of two numbers near k b/(k T + b)."""
    rng, below = np.random.default_rng(0), 0

    def maxwell(k: float, b: float, period: float, less: float = 0.0) -> Lti:
        a, D = b / (b + k * period), k * b / period / (k + b / period)
        return Lti([[a]], [[1, -1]], [[D * (a - 1)], [D * (1 - a)]], (D - less) * np.array([[1, -1], [-1, 1]]), period)

    for i in range(60):
        E = maxwell(np.exp(rng.uniform(3, 9)), np.exp(rng.uniform(-2, 4)), rng.choice([1e-3, 5e-4, 1.2e-3]))
        block = Block.of(E)
        below += E.dc()[0, 0] < 0
        if i % 10 == 0:  # over Fractions, as in a proof
            static = block.at(rational(E.T)).dc()
            assert (static == static.T).all()
            assert negative_minor(static) is None
            largest = 2e-6 * np.abs(E.D).max()  # the largest correction that Block accepts
            np.testing.assert_allclose(static.astype(float), 0, rtol=0, atol=largest)
    assert below > 6
    with pytest.raises(ValueError, match=r"static stiffness E\(1\) is \[\[-1e-05, 1e-05\], \[1e-05, -1e-05\]\]"):
        Block.of(maxwell(500.0, 6.0, T, less=1e-5))


def test_a_scenario_takes_an_own_environment():
    own = load().replace(environment=Gel())
    same = load().replace(environment=Network(Gel.contacts, (Spring(Gel.contacts, 600.0, 2.0),)))
    # A block adds a spring of at most 2e-6 of its gain.
    np.testing.assert_allclose(own.loop("I").E().at(SQUARE), same.loop("I").E().at(SQUARE), rtol=2e-6)
    with pytest.raises(InputError, match=r"environment int: expected a class with contacts, and E\(T\) or parts\(\)"):
        load().replace(environment=3)
    with pytest.raises(InputError, match=r"^environment Scalar.E\(T\) is 3.0, expected .*Lti with 2 inputs and 2 out"):
        load().replace(environment=type("Scalar", (), {"contacts": ("a", "b"), "E": lambda self, T: 3.0})())
    with pytest.raises(InputError, match=r"ranges with environment.block"):
        own.replace(ranges={"masses": {"left": [0.1, 0.2]}})
