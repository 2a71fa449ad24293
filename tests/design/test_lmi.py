"""Tests of the matrix inequalities: realisations, agreement with frequency responses, the paper's infeasible forms."""

import cvxpy as cp
import numpy as np
import pytest
from analysis import analysis, balanced, dissipated, e_hat_regular, solve, theta_hat, unit_coupling, v_hat_ports
from evaluate import any_environment
from shared import DELTA, FIGURE_4, T

from haptic_loop.controller.coupling import SpringDamper
from haptic_loop.controller.delay import delay
from haptic_loop.controller.environment import Network, Spring, environment
from haptic_loop.controller.lti import Lti
from haptic_loop.design.conditions import _v_hat
from haptic_loop.design.frequency import frequencies, hermitian, on_circle
from haptic_loop.design.lmi import Ports, lemma1, lemma2, lemma3, unit_environment

Z = np.exp(1j * np.array([0.01, 0.3, 1.0, 2.0, 3.1]))


def e_hat_printed(E, psi):
    """Return E-hat = z/(z-1) Psi E as printed in (11). Its pole at z = 1 makes (15) infeasible."""
    m = E.inputs
    one = np.eye(m)
    return Lti(one, one, one, one, E.T) @ (delay(psi, E.T) @ E)


def v_hat_printed(V, theta):
    """Return V-hat = (1 - 1/z)(V - Theta-hat) in the realisation (16)."""
    m = V.inputs
    one, zero = np.eye(m), np.zeros((m, m))
    return Lti(zero, one, -one, one, V.T) @ (V - theta_hat(theta))


def random_stable(rng, order, m=2):
    A = rng.normal(size=(order, order))
    A *= rng.uniform(0.2, 0.95) / np.abs(np.linalg.eigvals(A)).max()
    return Lti(A, rng.normal(size=(order, m)), rng.normal(size=(m, order)), rng.normal(size=(m, m)), 1.0)


def near_the_boundary(rng, V, theta, delta):
    """Return V, scaled in up to 60 trials until it needs half to twice `delta`, but not within 1 % of `delta`."""
    for _ in range(60):
        ratio = any_environment(V, theta, delta).ratio
        if not np.isfinite(ratio):
            break
        if 0.5 < ratio < 2 and abs(ratio - 1) > 0.01:
            return V
        factor = ratio * rng.uniform(0.6, 1.6)
        V = Lti(V.A, V.B, V.C * factor, V.D * factor, V.T)
    return V


def strength(matrix, *storages):
    """Return the largest s <= 1 for which `matrix` >= s I with the storages >= 0 and of bounded trace."""
    s = cp.Variable()
    bounds = [P >> 0 for P in storages] + [cp.trace(P) <= 1e3 for P in storages]
    solve(cp.Problem(cp.Maximize(s), [matrix >> s * np.eye(matrix.shape[0]), s <= 1, *bounds]))
    return float(s.value)


@pytest.mark.parametrize("seed", range(5))
def test_balancing_leaves_the_response_alone(seed):
    G = random_stable(np.random.default_rng(seed), 5)
    padded = Lti.diag(G, Lti([[0.5]], [[0.0]], [[1.0]], [[2.0]], 1.0))
    minimal = balanced(padded)
    assert minimal.order == 5
    np.testing.assert_allclose(minimal.at(Z), padded.at(Z), rtol=0, atol=1e-11 * np.abs(padded.at(Z)).max())


def test_units_preserve_the_eigenvalues_of_e_v():
    E, V = environment(FIGURE_4, T), SpringDamper([500, 900], [1, 2]).compliance(T)
    scaled = unit_environment(E, (2.0, 0.8)).at(Z) @ unit_coupling(V, (2.0, 0.8)).at(Z)
    np.testing.assert_allclose(np.linalg.eigvals(scaled), np.linalg.eigvals(E.at(Z) @ V.at(Z)), rtol=1e-9)


def test_realisation_16_and_its_quotient_are_v_hat():
    V = unit_coupling(SpringDamper([500, 900], [1, 2]).compliance(T), DELTA)
    theta = (1, 3)
    hat = (1 - 1 / Z)[:, None, None] * (V.at(Z) - theta_hat(theta).at(Z))
    np.testing.assert_allclose(v_hat_printed(V, theta).at(Z), hat, rtol=0, atol=1e-12)
    ports = v_hat_ports(V, theta)
    y2 = Lti(ports.A, ports.B, ports.C2, ports.D2, 1.0).at(Z)
    # Where z is near 1, a division by |1 - 1/z|^2 = 1e-4 makes rounding errors of 1e-12.
    quotient = hermitian(hat) / np.abs(1 - 1 / Z)[:, None, None] ** 2
    np.testing.assert_allclose(hermitian(y2), quotient, rtol=0, atol=1e-10)
    np.testing.assert_allclose(y2, _v_hat(V - theta_hat(theta))[1].at(Z), rtol=0, atol=1e-10)  # the design's formula


def test_e_hats_regular_part_keeps_the_hermitian_part():
    E = unit_environment(environment(FIGURE_4, T), DELTA)
    regular, printed = e_hat_regular(E, (0, 2)), e_hat_printed(E, (0, 2))
    np.testing.assert_allclose(hermitian(regular.at(Z)), hermitian(printed.at(Z)), rtol=0, atol=1e-9)
    assert regular.is_stable()


@pytest.mark.parametrize("seed", range(6))
def test_lemma_1_agrees_with_the_frequency_response(seed):
    rng = np.random.default_rng(seed)
    G = random_stable(rng, 3)
    z = on_circle(frequencies(G))
    response = G.at(z)
    Delta = np.eye(2) * rng.uniform(0, 0.3)
    margin = hermitian(response) - np.conj(np.swapaxes(response, 1, 2)) @ Delta @ response
    shift = -np.linalg.eigvalsh(margin).min()
    for room in (-0.05, 0.05):
        P = cp.Variable((3, 3), symmetric=True)
        slack = strength(dissipated(Ports.same(G), P, Delta, -(shift + room) * np.eye(2)), P)
        assert (slack > 0) == (room > 0)


def test_lemma_2_is_equivalent_to_lemma_1():
    rng = np.random.default_rng(1)
    G = Ports.same(random_stable(rng, 3))
    for _ in range(200):
        root = rng.normal(size=(3, 3))
        P, Delta, Phi = (
            root @ root.T + 0.1 * np.eye(3),
            np.diag(rng.uniform(0.01, 1, 2)),
            -rng.uniform(0, 60) * np.eye(2),
        )
        first = np.linalg.eigvalsh(lemma1(G, P, Delta, Phi)).min()
        np.testing.assert_allclose(lemma1(G, P, Delta, Phi), dissipated(G, P, Delta, Phi).value, rtol=0, atol=1e-12)
        second = np.linalg.eigvalsh(lemma2(G, np.linalg.inv(P), P, np.linalg.inv(Delta), Phi)).min()
        assert (first > 0) == (second > 0)


@pytest.mark.parametrize("seed", range(4))
def test_lemma_3_holds_above_the_norm_only(seed):
    G = random_stable(np.random.default_rng(seed), 3)
    norm = np.linalg.norm(G.at(on_circle(frequencies(G, points=3000))), 2, axis=(1, 2)).max()
    for factor in (0.99, 1.01):
        # With X = U^-1 the Schur complement over U and I is the bounded-real inequality, linear in X.
        X = cp.Variable((3, 3), symmetric=True)
        A, B, C, D = G.A, G.B, G.C, G.D
        bounded = cp.bmat(
            [
                [X - A.T @ X @ A - C.T @ C, -A.T @ X @ B - C.T @ D],
                [-B.T @ X @ A - D.T @ C, (factor * norm) ** 2 * np.eye(2) - B.T @ X @ B - D.T @ D],
            ]
        )
        holds = strength((bounded + bounded.T) / 2, X) > 1e-9
        assert holds == (factor > 1)
        if holds:
            full = lemma3(A, B, C, D, X.value, np.linalg.inv(X.value), (factor * norm) ** 2)
            assert np.linalg.eigvalsh(full).min() > 0


def test_15_as_printed_is_not_strictly_feasible():
    E = unit_environment(environment(FIGURE_4, T), DELTA)
    printed = e_hat_printed(E, (0, 0))
    n = printed.order
    P = cp.Variable((n, n), symmetric=True)
    Phi = cp.Variable((2, 2), symmetric=True)
    assert strength(dissipated(Ports.same(printed), P, np.zeros((2, 2)), -Phi), P) < 1e-6
    # (15) is infeasible because v'(A'PA - P)v = 0 for every P where A v = v.
    regular = balanced(e_hat_regular(E, (0, 0)))
    P = cp.Variable((regular.order,) * 2, symmetric=True)
    assert strength(dissipated(Ports.same(regular), P, np.zeros((2, 2)), -np.eye(2)), P) > 1e-3


def test_2_as_printed_is_infeasible_for_v_hat():
    V = unit_coupling(SpringDamper([300, 300], [0.3, 0.3]).compliance(T), DELTA)
    printed = balanced(v_hat_printed(V, (1, 2)))
    P = cp.Variable((printed.order,) * 2, symmetric=True)
    assert strength(dissipated(Ports.same(printed), P, np.zeros((2, 2)), np.zeros((2, 2))), P) < 1e-6
    assert analysis(
        SpringDamper([300, 300], [0.3, 0.3]).compliance(T), environment(FIGURE_4, T), (1, 2), (0, 0), DELTA
    ).feasible


@pytest.mark.parametrize("count", [6, pytest.param(48, marks=pytest.mark.validate)])
def test_analysis_agrees_with_the_frequency_condition(count):
    """The couplings are on either side of the boundary, with one to three channels, diagonal and coupled."""
    rng = np.random.default_rng(7)
    verdicts = []
    for trial in range(count):
        m = int(rng.integers(1, 4))
        walls = Network(
            contacts=tuple(f"c{i}" for i in range(m)),
            springs=tuple(Spring((f"c{i}", "ground"), rng.uniform(10, 3000), rng.uniform(0, 5)) for i in range(m)),
        )
        E = environment(walls if trial % 2 or m != 2 else FIGURE_4, T)
        theta, delta = rng.integers(0, 4, m), rng.uniform(0.5, 3, m)
        V = SpringDamper(np.exp(rng.uniform(4, 8, m)), np.exp(rng.uniform(-4, 1.0, m))).compliance(T)
        if trial % 3 == 0:
            mix = np.linalg.qr(rng.normal(size=(m, m)))[0]
            V = Lti(V.A, V.B @ mix.T, mix @ V.C, mix @ V.D @ mix.T, T)
        V = near_the_boundary(rng, V, theta, delta)
        ratio = any_environment(V, theta, delta).ratio
        if abs(ratio - 1) < 1e-3:
            continue
        verdicts.append(ratio < 1)
        assert analysis(V, E, theta, [0] * m, delta).feasible == verdicts[-1], (trial, ratio)
    assert count / 5 < sum(verdicts) < len(verdicts) - count / 5


def scalar_any_environment(V, E, theta, psi, delta):
    """Return phi = sup -Re E-hat (0 at least) and inf Re V-hat/|V-hat|^2 - phi/(1 - phi/delta) of Lemma 4."""
    systems = (V, E)
    z = on_circle(frequencies(*systems, points=4000))
    e_hat = T * z / (z - 1) * z**-psi * E.at(z)[:, 0, 0]
    window = sum(z**-j for j in range(theta + 1)) * T / (2 * delta)
    _v_hat = (z - 1) / (T * z) * (V.at(z)[:, 0, 0] - window)
    phi = max(0.0, float(np.max(-e_hat.real)))
    excess = float(np.min(_v_hat.real / np.abs(_v_hat) ** 2))
    return phi, (excess - phi / (1 - phi / delta) if phi < delta else -np.inf)


@pytest.mark.parametrize("count", [9, pytest.param(30, marks=pytest.mark.validate)])
def test_analysis_with_psi_agrees_with_scalar_lemma_4(count):
    rng = np.random.default_rng(3)
    verdicts = []
    for _ in range(count):
        network = Network(contacts=("c",), springs=(Spring(("c", "ground"), rng.uniform(5, 300), rng.uniform(0, 0.2)),))
        E = environment(network, T)
        theta, psi, delta = int(rng.integers(0, 3)), int(rng.integers(1, 3)), rng.uniform(0.5, 3)
        V = SpringDamper([np.exp(rng.uniform(4, 7))], [np.exp(rng.uniform(-3, 0.5))]).compliance(T)
        phi, room = scalar_any_environment(V, E, theta, psi, delta)
        if abs(room) < 2e-3 * delta or abs(phi - delta) < 1e-3:
            continue
        verdicts.append(room > 0)
        assert analysis(V, E, [theta], [psi], [delta]).feasible == (room > 0), (theta, psi, delta, room)
    assert count / 6 < sum(verdicts) < len(verdicts) - count / 6


def test_separate_channels_have_the_smaller_margin():
    network = Network(("a", "b"), (Spring(("a", "ground"), 80.0, 0.1), Spring(("b", "ground"), 120.0, 0.1)))
    E = environment(network, T)
    V = SpringDamper([200, 300], [0.3, 0.4])
    alone = []
    for i, stiffness in enumerate((80.0, 120.0)):
        single = environment(Network(("a",), (Spring(("a", "ground"), stiffness, 0.1),)), T)
        alone.append(analysis(SpringDamper(V.K[[i]], V.B[[i]]).compliance(T), single, [1], [1], [1.37]).margin)
    both = analysis(V.compliance(T), E, (1, 1), (1, 1), DELTA).margin
    assert both == pytest.approx(min(alone), abs=1e-5)


@pytest.mark.parametrize(
    ("V", "word"),
    [
        (Lti([[1.01]], [[1.0]], [[1.0]], [[1.0]], T), "pole"),
        (Lti.constant([[1.0, 0.5], [0.0, 1.0]], T), "symmetric"),
    ],
)
def test_unstable_or_asymmetric_couplings_are_refused_without_inequalities(V, word):
    E = environment(FIGURE_4, T) if V.inputs == 2 else environment(Network(("c",), (Spring(("c", "ground"), 9.0),)), T)
    outcome = analysis(V, E, [0] * V.inputs, [0] * V.inputs, [1.0] * V.inputs)
    assert outcome.margin == -np.inf
    assert word in outcome.reason


def test_analysis_refuses_an_active_environment():
    active = Lti.constant([[-5.0]], T)
    with pytest.raises(ValueError, match="not passive"):
        analysis(Lti.constant([[1e-3]], T), active, [0], [0], [1.0])
