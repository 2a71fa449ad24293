"""Test the blocks that must be positive real for each condition, and the search for proofs.

Each family of blocks is built over Fractions at a damping just above and just below a limit. A closed form or a dense
sweep of formulas in this file gives the limit. Above the limit a proof is found. Below it the same proof is refused
and no other is found. Later tests replace the sweep of `prove` and `verify`, and forge certificates.
"""

import re
from collections.abc import Callable
from dataclasses import replace
from fractions import Fraction

import msgspec
import numpy as np
import pytest
from evaluate import (
    any_environment_demand,
    limiter_demand,
    summed,
    switching_demand,
    this_environment_demand,
    walls_demand,
)
from scipy.optimize import minimize_scalar
from shared import FIGURE_4, SOFT, STIFF, T, checkered, walled

from haptic_loop.controller.arithmetic import rational
from haptic_loop.controller.coupling import Compliance, NoCoupling, SpringDamper
from haptic_loop.controller.environment import Network, Spring, Wall
from haptic_loop.controller.loop import DelayRange, Loop
from haptic_loop.controller.lti import Lti
from haptic_loop.controller.ranges import Ranges, UncertainSpring
from haptic_loop.design import certificate
from haptic_loop.design.certificate import prove, verify
from haptic_loop.design.conditions import delayed_environment_demand
from haptic_loop.design.coupling_file import Stored, digest, sealed
from haptic_loop.design.environments import SWITCHING, LimitedForces
from haptic_loop.design.exact import _prove_positive_real, find_storage
from haptic_loop.design.result import ANY, NotProved, from_ratio

CLOSE = 1e-6  # relative distance from a limit, on either side
change = msgspec.structs.replace


def assert_limit(block: Callable[[float], Lti], limit: float) -> None:
    """Assert that the block is proved strictly positive real just above the limit, but not just below it."""
    above, below = block(limit * (1 + CLOSE)), block(limit * (1 - CLOSE))
    P, reason = find_storage(above)
    assert P is not None, reason
    assert _prove_positive_real(above, P) is None
    assert _prove_positive_real(below, P) is not None
    assert find_storage(below)[0] is None


def highest(value: Callable[[np.ndarray], np.ndarray]) -> float:
    """Return the supremum of value(w) over w in [0, pi], by searches around the best points of a grid."""
    grid = np.unique(np.concatenate([np.geomspace(1e-4, np.pi, 20_000), np.linspace(1e-4, np.pi, 20_000)]))
    values = value(grid)
    best = float(values.max())
    for i in np.argsort(values)[-3:]:
        low, high = grid[max(i - 1, 0)], grid[min(i + 1, grid.size - 1)]
        peak = minimize_scalar(lambda w: -value(np.array([w]))[0], bounds=(low, high), options={"xatol": 1e-11})
        best = max(best, -peak.fun)
    return best


def he(G):
    return (G + np.conj(np.swapaxes(G, -1, -2))) / 2


def figure_4(z):
    """Return E(z) of Figure 4: springs of 800 and 700 N/m with 1 N s/m each join two contacts to 1 kg."""
    s = (1 - 1 / z) / T
    p, q = 800 + s, 700 + s
    return np.moveaxis(
        np.array([[p, 0 * p], [0 * p, q]]) - np.array([[p * p, p * q], [p * q, q * q]]) / (s**2 + p + q), -1, 0
    )


def late(z, steps):
    """Return diag(z^-n) for the delays n in `steps`, (k, m, m)."""
    return z[:, None, None] ** -np.array(steps, dtype=float)[:, None] * np.eye(len(steps))


def sent(z, coupling, psi=(0, 0)):
    """Return (I + Psi E V)^-1 Psi E from its formula."""
    s = (1 - 1 / z) / T
    V = np.array([1 / (k + b * s) for k, b in zip(coupling.K, coupling.B, strict=True)]).T[:, :, None] * np.eye(2)
    X = late(z, psi) @ figure_4(z)
    return np.linalg.solve(np.eye(2) + X @ V, X)


def loop_of(network: Network, theta, psi=None, delta=None, period=T) -> Loop:
    m = len(theta)
    return Loop(period, theta, psi or (0,) * m, theta, delta or (1.0,) * m, network)


def to_ground(*stiffness: float, damping: float = 0.0) -> Network:
    """Return a network of separate tips, each on a spring and a damper to ground."""
    springs = tuple(Spring((f"tip {i}", "ground"), k, damping) for i, k in enumerate(stiffness))
    return Network(tuple(f"tip {i}" for i in range(len(stiffness))), springs)


# this-environment


def test_the_exact_block_holds_the_damping_exactly():
    F, delta = Lti.constant([[1000]], rational(T)), Fraction(1, 3)
    assert summed(this_environment_demand(F, [delta])).D[0, 0] == delta / rational(T) - 500


@pytest.mark.parametrize("theta", [0, 1, 4])
def test_springs_need_the_closed_form(theta):
    """The limit is (theta + 1/2) K T."""
    F = loop_of(to_ground(1000.0), (theta,)).F(Compliance(Lti.constant([[0.0]], T)), exact=True)
    assert_limit(lambda d: summed(this_environment_demand(F, [d])), (theta + 0.5) * 1000 * T)


def test_undelayed_spring_dampers_need_the_closed_form():
    """The limit is K T/2 + B."""
    F = loop_of(to_ground(700.0, damping=0.9), (0,)).F(Compliance(Lti.constant([[0.0]], T)), exact=True)
    assert_limit(lambda d: summed(this_environment_demand(F, [d])), 700 * T / 2 + 0.9)


def test_joined_channels_need_the_largest_eigenvalue():
    """The limit is (theta + 1/2) T times the largest eigenvalue of K relative to the dampings."""
    K, ratio = np.array([[900.0, -300.0], [-300.0, 400.0]]), np.array([1.0, 0.37])
    springs = (Spring(("a", "b"), 300.0), Spring(("a", "ground"), 600.0), Spring(("b", "ground"), 100.0))
    F = loop_of(Network(("a", "b"), springs), (2, 2)).F(Compliance(Lti.constant(np.zeros((2, 2)), T)), exact=True)
    top = np.linalg.eigvalsh(K / np.sqrt(ratio[:, None] * ratio)).max()
    assert_limit(lambda d: summed(this_environment_demand(F, [d, 0.37 * d])), 2.5 * T * top)


@pytest.mark.parametrize(("theta", "psi"), [((1, 2), (0, 0)), ((0, 1), (1, 0))])
def test_figure_4_needs_the_damping_of_a_sweep(theta, psi):
    def needed(w):
        z = np.exp(1j * w)
        F = late(z, theta) @ sent(z, STIFF, psi)
        return np.linalg.eigvalsh(-T * he(F / (z - 1)[:, None, None])).max(axis=1)

    F = loop_of(FIGURE_4, theta, psi).F(STIFF, exact=True)
    assert_limit(lambda d: summed(this_environment_demand(F, [d, d])), highest(needed))


# any-environment, psi = 0


def any_environment_limit(K: float, B: float, theta: int) -> float:
    """Return sup |K T (1 + .. + z^-theta) + B (1 - z^-n)|^2 / (4 (K T/2 + B)) with n = theta + 1.

    The formula follows from He[1/c] = Re c/|c|^2 with c = K T/(1 - 1/z) + B.
    """

    def needed(w):
        z = np.exp(1j * w)
        window = sum(z**-k for k in range(theta + 1))
        return np.abs(K * T * window + B * (1 - z ** -(theta + 1.0))) ** 2 / (4 * (K * T / 2 + B))

    return highest(needed)


@pytest.mark.parametrize(("theta", "gains"), checkered((0, 1, 3), ((900.0, 0.0), (900.0, 0.4), (50.0, 2.0))))
def test_one_spring_damper_meets_its_any_environment_limit(theta, gains):
    K, B = gains
    V = SpringDamper([K], [B]).compliance(rational(T))
    limit = any_environment_limit(K, B, theta)
    if not B:
        assert limit == pytest.approx(K * T * (theta + 1) ** 2 / 2, rel=1e-7)
    if not theta:
        assert limit == pytest.approx(K * T / 2 + B)
    assert_limit(lambda d: summed(any_environment_demand(V, (theta,), [d])), limit)


def test_rotated_spring_dampers_need_the_larger_limit():
    """With spring-dampers along rotated axes, the one that needs more damping sets the limit."""
    turn = np.array([[Fraction(3, 5), Fraction(-4, 5)], [Fraction(4, 5), Fraction(3, 5)]])
    V = turn @ SpringDamper([900.0, 700.0], [0.4, 0.3]).compliance(rational(T)) @ turn.T
    limit = max(any_environment_limit(900.0, 0.4, 1), any_environment_limit(700.0, 0.3, 1))
    assert_limit(lambda d: summed(any_environment_demand(V, (1, 1), [d, d])), limit)


# any-environment, psi >= 1


@pytest.mark.parametrize("psi", [1, 2, 5])
def test_phi_of_a_delayed_spring_is_known(psi):
    """Phi must exceed (psi - 1/2) K T, as He[z^-psi z/(z-1)] = 1/2 - (1 + cos w + .. + cos (psi-1) w)."""
    E = loop_of(to_ground(1000.0), (0,), (psi,))
    delayed = E.sent(Compliance(Lti.constant([[0.0]], T)), exact=True)
    assert_limit(lambda phi: certificate._block(delayed_environment_demand(delayed, [phi])), (psi - 0.5) * 1000 * T)


def test_phi_of_a_delayed_spring_damper_is_known():
    """The limit is K T/2 + B, from w = pi; w = 0 alone would need less."""
    E = loop_of(to_ground(700.0, damping=0.9), (0,), (1,))
    delayed = E.sent(Compliance(Lti.constant([[0.0]], T)), exact=True)
    assert_limit(lambda phi: certificate._block(delayed_environment_demand(delayed, [phi])), 700 * T / 2 + 0.9)


def test_figure_4s_multiplier_matches_a_dense_sweep():
    def short(w):
        z = np.exp(1j * w)
        return np.linalg.eigvalsh(-T * he((z / (z - 1))[:, None, None] * (late(z, (1, 2)) @ figure_4(z)))).max(axis=1)

    delayed = loop_of(FIGURE_4, (0, 0), (1, 2)).sent(Compliance(Lti.constant(np.zeros((2, 2)), T)), exact=True)
    assert_limit(lambda phi: certificate._block(delayed_environment_demand(delayed, [phi, phi])), highest(short))


@pytest.mark.parametrize("share", [0.05, 0.3, 0.45])
def test_a_coupling_spring_with_phi_meets_its_limit(share):
    """T/(2 delta) must be below (T/phi - 2/K)/(K (4 T/phi - 6/K)) at w = 0 and (T/phi - 2/K)/2 at w = pi."""
    K, a = 900.0, 1 / 900.0
    phi = share * K * T / 2
    least = min(a * (T / phi - 2 * a) / (4 * T / phi - 6 * a), (T / phi - 2 * a) / 2)
    V, multiplier = SpringDamper([K], [0.0]).compliance(rational(T)), [rational(phi)]
    assert_limit(lambda d: certificate._block(any_environment_demand(V, (1,), [d], phi=multiplier)), T / (2 * least))


def test_a_spring_damper_with_phi_meets_its_limit():
    K, B, phi, theta = 900.0, 0.4, 0.2, 2
    w = np.concatenate([np.geomspace(1e-3, np.pi, 20_000), np.linspace(1e-3, np.pi, 20_000)])
    z = np.exp(1j * w)

    def holds(delta):
        window = sum(z**-k for k in range(theta + 1))
        hat = (1 - 1 / z) / T * (1 / (K + B * (1 - 1 / z) / T) - T / (2 * delta) * window)
        return (hat.real / (1 - np.cos(w)) > np.abs(hat) ** 2 / (1 / phi - 1 / delta) / (1 - np.cos(w))).all()

    low, high = phi, 100.0
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (low, middle) if holds(middle) else (middle, high)
    V, multiplier = SpringDamper([K], [B]).compliance(rational(T)), [rational(phi)]
    assert_limit(lambda d: certificate._block(any_environment_demand(V, (theta,), [d], phi=multiplier)), high)


# switching


@pytest.mark.parametrize(("weight", "ages"), checkered((0.5, 1.0, 3.0), ((0, 1), (1, 3))))
def test_switching_before_a_spring_needs_the_closed_form(weight, ages):
    """The limit is T (alpha/2 + h^2 K^2/(2 alpha) + K ((lo + hi)/2 + 1/2)), or (hi + 1/2) K T if alpha = h K."""
    lo, hi = ages
    K, h = 1000.0, (hi - lo) / 2
    alpha = weight * h * K
    G = loop_of(to_ground(K), (0,)).sent(Compliance(Lti.constant([[0.0]], T)), exact=True)
    limit = T * (alpha / 2 + (h * K) ** 2 / (2 * alpha) + K * ((lo + hi) / 2 + 0.5))
    if weight == 1:
        assert limit == pytest.approx((hi + 0.5) * K * T)
    assert_limit(lambda d: summed(switching_demand(G, [lo], [hi], [d], [alpha])), limit)


@pytest.mark.parametrize(("lo", "hi"), [((1, 1), (2, 2)), ((0, 2), (3, 2))])
def test_switching_needs_the_damping_of_a_sweep(lo, hi):
    alpha = np.array([500.0, 300.0]) * (np.array(lo) < np.array(hi))
    h = (np.array(hi) - np.array(lo)) / 2

    def needed(w):
        z = np.exp(1j * w)
        G = sent(z, STIFF)
        nominal = (late(z, lo) + late(z, hi)) / 2 @ G / (z - 1)[:, None, None]
        error = (h[:, None] * G)[:, h > 0]
        cost = np.conj(np.swapaxes(error, 1, 2)) @ (error / (2 * alpha[h > 0])[:, None])
        return np.linalg.eigvalsh(T * (np.diag(alpha / 2) + cost - he(nominal))).max(axis=1)

    G = loop_of(FIGURE_4, (0, 0)).sent(STIFF, exact=True)
    assert_limit(lambda d: summed(switching_demand(G, lo, hi, [d, d], alpha.tolist())), highest(needed))


# periods, latency, limits and walls


@pytest.mark.parametrize("longest", [T, 1.7 * T])
def test_the_longest_period_scales_each_block(longest):
    """A longest period T_max needs T_max/T times the damping for the constant period T."""
    rigid = Compliance(Lti.constant([[0.0]], T))
    F, V = loop_of(to_ground(1000.0), (2,)).F(rigid, exact=True), SpringDamper([900.0], [0.4]).compliance(rational(T))
    assert_limit(lambda d: summed(this_environment_demand(F, [d], longest)), 2.5 * 1000 * longest)
    needs = any_environment_limit(900.0, 0.4, 1) * longest / T
    assert_limit(lambda d: summed(any_environment_demand(V, (1,), [d], longest)), needs)
    G = loop_of(to_ground(1000.0), (0,)).sent(rigid, exact=True)
    assert_limit(lambda d: summed(switching_demand(G, [1], [3], [d], [1000.0], longest)), 3.5 * 1000 * longest)


@pytest.mark.parametrize(("first", "last", "longest"), [(1.3e-4, 1.3e-4, T), (0.0, 5e-4, T), (2e-4, 6e-4, 1.5e-3)])
def test_a_spring_with_latency_needs_the_closed_form(first, last, longest):
    """For latencies t1 to t2 the limit is the larger root d of (d/t2 - 3 K/2)(d/(T_max - t1) - K/2) = K^2."""
    K, a, b = 1000.0, 1 / last, 1 / (longest - first)
    limit = max(np.roots([a * b, -K * (a + 3 * b) / 2, -(K**2) / 4]))
    F = loop_of(to_ground(K), (0,)).F(Compliance(Lti.constant([[0.0]], T)), exact=True)
    assert_limit(lambda d: summed(this_environment_demand(F, [d], longest, [(first, last)])), limit)


@pytest.mark.parametrize(("theta", "c"), [(0, 0.0), (1, 0.5), (2, 1.3)])
def test_a_limited_spring_needs_the_computed_damping(theta, c):
    """The damping d adds [1, 1; 1, 1] d/T, which is 0 for the input (1, -1), so a Schur complement gives the limit."""
    K, rho = 1000.0, 20.0

    def needed(w):
        z = np.exp(1j * w)
        n = -sum(z**-i for i in range(theta + 1)) - c
        corner = -rho * z ** -(theta + 1) + rho * (z**-theta - (z - 1) * n) / z
        a, b = np.real(K * z**-theta / (z - 1)), (-rho * z ** -(theta + 1) + np.conj(n * K)) / 2
        both_ways = np.real(corner) - 2 * np.real(b) + a  # the block's form at the input (1, -1)
        return T * (np.abs(a - b) ** 2 / both_ways - a)

    G = loop_of(to_ground(K), (0,)).sent(Compliance(Lti.constant([[0.0]], T)), exact=True)
    assert_limit(lambda d: summed(limiter_demand(G, [theta], [d], [rho], [[c]])), highest(needed))


@pytest.mark.parametrize(("theta", "g"), [(0, 1.0), (1, 2.0), (2, 0.7)])
def test_walls_at_the_device_need_the_closed_form(theta, g):
    """The limit is (theta + 1 + g)^2 K T/(4 g + 2) with the multiplier g K; only the wall exerts a force."""
    wall = Wall(("tip", "ground"), 3000.0)
    network = Network(("tip",), (), walls=(wall,))
    G = walled(loop_of(network, (theta,)), Compliance(Lti.constant([[0.0]], T)), exact=True)
    limit = (theta + 1 + g) ** 2 * 3000.0 * T / (4 * g + 2)
    assert_limit(lambda d: summed(walls_demand(G, [d], [3000.0], [g * 3000.0])), limit)


# `prove` and `verify` with a sweep that certifies every loop


@pytest.fixture
def lenient_sweep(monkeypatch):
    """Replace the sweep by one that requires half of the available damping in every loop."""

    def half_required(loop: Loop, coupling, condition, multiplier=None):
        usual = ALPHA if loop.varying_delay else None
        return replace(from_ratio("any", 0.5, loop.delta, 1.0), multiplier=multiplier or usual)

    monkeypatch.setattr(certificate, "required_damping", half_required)


ALPHA = (500.0, 250.0)
EITHER: list = ["this-environment", "any-environment"]


def proves(loop: Loop, coupling, condition, phi=None) -> bool:
    try:
        proof = prove(loop, coupling, condition, phi)
    except NotProved:
        return False
    assert verify(Stored.of(loop, coupling, proof)).proved
    return True


def assert_loop_limit(loop: Loop, coupling, condition, limit: float, phi=None) -> None:
    """Assert that the loop is proved just above the damping `limit`, but not just below it."""
    for factor, expected in ((1 + CLOSE, True), (1 - CLOSE, False)):
        assert proves(change(loop, delta=(limit * factor,) * loop.channels), coupling, condition, phi) == expected


@pytest.mark.usefixtures("lenient_sweep")
def test_each_condition_is_proved_by_its_own_block():
    loop, coupling = loop_of(to_ground(1000.0), (1,)), SpringDamper((800.0,), (0.0,))
    assert_loop_limit(loop, coupling, "any-environment", 800 * T * 2)
    joined = 1 / (1 / 800 + 1 / 1000)
    assert_loop_limit(loop, coupling, "this-environment", 1.5 * joined * T)


@pytest.mark.usefixtures("lenient_sweep")
def test_every_vertex_of_a_range_is_proved():
    """The vertex with the stiffest spring sets the limit, and the refusal names it."""
    loop = change(
        loop_of(to_ground(1000.0), (1,)), ranges=Ranges((UncertainSpring(("tip 0", "ground"), (500.0, 1600.0)),))
    )
    assert_loop_limit(loop, NoCoupling(), "this-environment", 1.5 * 1600 * T)
    with pytest.raises(NotProved, match=r"^vertex 2 \(tip 0-ground 1600 N/m, 0 N s/m\): the condition is violated"):
        prove(change(loop, delta=(1.5 * 1600 * T * (1 - CLOSE),)), NoCoupling(), "this-environment")


@pytest.mark.usefixtures("lenient_sweep")
def test_environment_delay_needs_its_multiplier():
    K, environment_needs = 900.0, 0.5 * 100 * T
    loop, coupling, a = loop_of(to_ground(100.0), (1,), (1,)), SpringDamper((K,), (0.0,)), 1 / 900.0
    phi = environment_needs * (1 + CLOSE)
    limit = T / (2 * min(a * (T / phi - 2 * a) / (4 * T / phi - 6 * a), (T / phi - 2 * a) / 2))
    assert_loop_limit(loop, coupling, "any-environment", limit, [phi])
    enough = change(loop, delta=(2 * limit,))
    assert proves(enough, coupling, "any-environment", [phi])
    assert not proves(enough, coupling, "any-environment", [environment_needs * (1 - CLOSE)])


@pytest.mark.usefixtures("lenient_sweep")
def test_delay_ranges_are_proved_by_their_block():
    K = 1000.0
    loop = loop_of(to_ground(K, K), (1, 1)).switching(DelayRange((0, 0), (1, 1)))
    limits = [T * (a / 2 + (K / 2) ** 2 / (2 * a) + K) for a in ALPHA]
    assert limits[1] > 1.01 * limits[0]
    assert limits[0] == pytest.approx(1.5 * K * T)  # alpha = K/2: the damping for a constant delay of 1
    assert_loop_limit(loop, NoCoupling(), "this-environment", limits[1])


# Forged certificates with renewed digests and seals


def forged(loop: Loop, coupling, proof, **changes) -> str | None:
    """Return why `verify` refuses the certificate with these fields and renewed digests, or None."""
    fields = {"scenario": digest(loop, coupling.form())} | changes
    return verify(Stored.of(loop, coupling, sealed(change(proof, **fields)))).reason


NEGATIVE = re.compile("KYP|negative")


def test_proofs_serve_only_their_own_condition():
    loop, coupling = loop_of(to_ground(1000.0), (1,), delta=(2.0,)), SpringDamper((800.0,), (0.0,))
    here, anywhere = (prove(loop, coupling, condition) for condition in ("this-environment", "any-environment"))
    assert len(here.matrices["P"]) == len(anywhere.matrices["P"])  # The size must not reveal an exchanged P.
    assert forged(loop, coupling, anywhere) is None
    assert NEGATIVE.search(forged(loop, coupling, anywhere, matrices=here.matrices))
    assert "does not guarantee" in forged(loop, coupling, here, guarantee=ANY)
    soft = change(loop, environment=to_ground(100.0))  # The block for this-environment depends on the spring.
    assert forged(soft, coupling, prove(soft, coupling, "this-environment"), matrices=anywhere.matrices) is not None


def test_the_nominal_proof_does_not_serve_vertices():
    loop = loop_of(to_ground(1000.0), (1,), delta=(1.5 * 1600 * T * 1.001,))
    loop = change(loop, ranges=Ranges((UncertainSpring(("tip 0", "ground"), (500.0, 1600.0)),)))
    proof = prove(loop, NoCoupling(), "this-environment")
    assert proof.required == pytest.approx((1.5 * 1600 * T,), rel=1e-9)  # the vertex that needs most
    nominal = proof.matrices["P"]
    assert forged(loop, NoCoupling(), proof) is None
    reason = forged(loop, NoCoupling(), proof, matrices={"P": nominal, "P1": nominal, "P2": nominal})
    assert reason.startswith("vertex 2 (tip 0-ground 1600 N/m, 0 N s/m): ")
    assert NEGATIVE.search(reason)
    assert forged(loop, NoCoupling(), proof, matrices={"P": nominal}) == "matrices are P, expected P, P1, P2"


@pytest.mark.parametrize(("condition", "name"), [("this-environment", "F(1)"), ("any-environment", "V(1)")])
def test_a_slightly_asymmetric_static_part_is_refused(condition, name):
    loop = loop_of(to_ground(900.0, 700.0), (1, 0), delta=(3.0, 3.0))

    def crossed(other):
        return Compliance(Lti.constant([[2e-3, 1e-4], [other, 2e-3]], T))

    proof = prove(loop, crossed(1e-4), condition)
    skew = crossed(1e-4 * (1 + 1e-12))
    assert forged(loop, crossed(1e-4), proof) is None
    assert forged(loop, skew, proof) == f"{name} is not exactly symmetric"


def test_slight_asymmetry_is_refused_with_delay_switching_limiter():
    loop = loop_of(to_ground(100.0, 80.0), (0, 0), (1, 1), delta=(5.0, 5.0))
    phi = [0.1, 0.1]

    def crossed(other):
        return Compliance(Lti.constant([[2e-3, 1e-4], [other, 2e-3]], T))

    proof = prove(loop, crossed(1e-4), "any-environment", phi)
    skew = crossed(1e-4 * (1 + 1e-12))
    assert forged(loop, skew, proof) == "V(1) is not exactly symmetric"
    switching = change(loop, psi=(0, 0)).switching(DelayRange((0, 0), (1, 1)))
    limited = change(loop, psi=(0, 0))
    for there, condition, multiplier in ((switching, SWITCHING, ALPHA), (limited, LimitedForces(0.01, 0), ())):
        assert certificate._blocks(there, crossed(1e-4), condition, multiplier)["P"].order
        with pytest.raises(NotProved, match=r": F\(1\) is not exactly symmetric"):
            certificate._blocks(there, skew, condition, multiplier)


def test_a_slightly_indefinite_static_stiffness_is_refused():
    """The second diagonal entry of F(1) is 1/(0.001 - 1e8) = -1e-8 N/m."""
    loop = loop_of(to_ground(1000.0, 1000.0), (0, 0), delta=(2.0, 2.0))

    soft, negative = (Compliance(Lti.constant([[0.0, 0.0], [0.0, v]], T)) for v in (1e8, -1e8))
    proof = prove(loop, soft, "this-environment")
    assert forged(loop, soft, proof) is None
    assert forged(loop, negative, proof).startswith("F(1) is not positive semidefinite")
    switching = loop.switching(DelayRange((0, 0), (1, 1)))
    assert certificate._blocks(switching, soft, SWITCHING, ALPHA)["P"].order
    with pytest.raises(NotProved, match=r": F\(1\) is not positive semidefinite"):
        certificate._blocks(switching, negative, SWITCHING, ALPHA)


def test_multipliers_lie_between_environment_and_damping(monkeypatch):
    K, a = 900.0, 1 / 900.0
    loop, coupling, phi = loop_of(to_ground(100.0), (1,), (1,), (4.0,)), SpringDamper((K,), (0.0,)), 0.1
    proof = prove(loop, coupling, "any-environment", [phi])
    assert forged(loop, coupling, proof) is None
    claimed = from_ratio("any-environment", proof.required[0] / 4.0, (4.0,), 1.0)
    monkeypatch.setattr(certificate, "required_damping", lambda *_: claimed)  # the sweep certifies with any Phi

    def with_phi(value: float) -> str | None:
        return forged(loop, coupling, proof, multipliers={"Phi": (value,)})

    assert T / (2 * (a * (T / phi - 2 * a) / (4 * T / phi - 6 * a))) < 4
    assert with_phi(4.0) == "the multiplier Phi must be at least 0 and below the device damping on every channel"
    assert NEGATIVE.search(with_phi(2.0))
    assert NEGATIVE.search(with_phi(0.01))
    assert with_phi(-0.1) == "the multiplier Phi must be at least 0 and below the device damping on every channel"


def test_stored_figures_are_checked_to_a_millionth():
    loop = loop_of(FIGURE_4, (1, 2), delta=(1.37, 1.37))
    proof = prove(loop, STIFF, "this-environment")
    for factor, sound in ((1 + 2e-6, False), (1 - 2e-6, False), (1 + 5e-7, True)):
        required = tuple(d * factor for d in proof.required)
        one = (proof.required[0], proof.required[1] * factor)
        for reason in (forged(loop, STIFF, proof, required=r) for r in (required, one)):
            assert (reason is None) == sound
            assert sound or reason.startswith("required is [1.3632")
        reason = forged(loop, STIFF, proof, margin=proof.margin * factor)
        assert (reason is None) == sound
    assert forged(loop, STIFF, proof, margin=2 * proof.margin).startswith(
        f"margin is {2 * proof.margin:.9g}, the sweep"
    )


def test_stored_switching_figures_are_checked_to_a_millionth():
    soft = SOFT
    loop = loop_of(FIGURE_4, (1, 2), delta=(1.37, 1.37)).switching(DelayRange((1, 1), (2, 2)))
    proof = prove(loop, soft, "this-environment")
    for factor, sound in ((1 + 2e-6, False), (1 - 2e-6, False), (1 + 5e-7, True)):
        for name in ("required", "margin"):
            value = np.multiply(getattr(proof, name), factor).tolist()
            value = tuple(value) if name == "required" else value
            reason = forged(loop, soft, proof, **{name: value})
            assert (reason is None) == sound
            assert sound or f": {name} is " in reason


def test_a_ragged_proof_is_refused():
    loop = loop_of(FIGURE_4, (1, 2), delta=(1.37, 1.37))
    proof = prove(loop, STIFF, "this-environment")
    P = proof.matrices["P"]
    ragged = (P[0][:-1], *P[1:])
    assert forged(loop, STIFF, proof, matrices={"P": ragged}) == "P has a row of 8 entries, the block has 9 states"
    assert forged(loop, STIFF, proof, matrices={"P": P[:-1]}) == "P has 8 rows, the block has 9 states"
