"""The block algebra agrees with dense frequency responses and with python-control."""

from fractions import Fraction

import numpy as np
import pytest

from haptic_loop.controller import lti
from haptic_loop.controller.arithmetic import SingularLoop, times
from haptic_loop.controller.coupling import ForceFilter
from haptic_loop.controller.delay import delay
from haptic_loop.controller.lti import Lti, Sampled, hstack, taps

Z = np.exp(1j * np.linspace(0.01, 3.1, 60))


def random_lti(rng, order, inputs, outputs, T=1e-3):
    A = rng.normal(size=(order, order))
    A *= 0.9 / max(np.abs(np.linalg.eigvals(A)).max(), 1e-9) if order else 1.0
    parts = rng.normal(size=(order, inputs)), rng.normal(size=(outputs, order)), rng.normal(size=(outputs, inputs))
    return Lti(A, *parts, T)


@pytest.fixture(params=range(5))
def blocks(request):
    rng = np.random.default_rng(request.param)
    return tuple(random_lti(rng, order, 2, 2) for order in rng.integers(0, 6, size=2))


def assert_close(a, b):
    np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9 * max(1.0, np.abs(b).max()))


def test_responses_equal_their_definition(blocks):
    G = blocks[0]
    expected = [G.C @ np.linalg.solve(z * np.eye(G.order) - G.A, G.B) + G.D for z in Z]
    assert_close(G.at(Z), expected)


def test_blocks_with_equal_matrices_have_their_own_responses(blocks):
    """Eigenvectors and Schur forms are cached by A, and must not bring B, C or D of another block along."""
    G, other = blocks
    for H in (G, other, Lti(G.A, 2 * G.B, G.C[::-1], G.D, G.T), Lti(G.A.T, G.C.T, G.B.T, G.D.T, G.T)):
        for z in (Z, 1.5 * Z):  # responses on the circle are sums over poles, others come from substitution
            assert_close(H.at(z), [H.C @ np.linalg.solve(one * np.eye(H.order) - H.A, H.B) + H.D for one in z])
        np.testing.assert_allclose(np.sort_complex(H.poles()), np.sort_complex(np.linalg.eigvals(H.A)), atol=1e-12)


@pytest.mark.validate
def test_response_agrees_with_python_control(blocks):
    import control  # the import takes a second, and every worker collects this file

    G = blocks[0]
    other = control.ss(G.A, G.B, G.C, G.D, G.T)
    assert_close(G.at(Z), np.moveaxis(other(Z), -1, 0))


def test_algebra_is_pointwise(blocks):
    G, H = blocks
    g, h = G.at(Z), H.at(Z)
    assert_close((G @ H).at(Z), g @ h)
    assert_close((G + H).at(Z), g + h)
    assert_close((G - H).at(Z), g - h)
    assert_close(G.feedback(H).at(Z), np.linalg.solve(np.eye(2) + g @ h, g))
    both = Lti.diag(G, H).at(Z)
    assert_close(both[:, :2, :2], g)
    assert_close(both[:, 2:, 2:], h)
    assert not both[:, :2, 2:].any()


@pytest.mark.parametrize("m", [1, 2, 3])
def test_sampled_responses_obey_the_same_algebra(m):
    """A system is sampled at one row of points, and at two rows as in a stack of two systems."""
    rng = np.random.default_rng(m)
    G, H = (random_lti(rng, 4, m, m) for _ in range(2))
    for z in (Z[None], np.stack([Z, Z[::-1] * np.exp(0.001j)])):
        g, h, M = Sampled.of(G, z), Sampled.of(H, z), rng.normal(size=(m, m))
        for sampled, system in (
            (g @ h, G @ H),
            (M @ g + g @ M - h, M @ G + G @ M - H),
            (g.feedback(h), G.feedback(H)),
            (g.inverse(), G.inverse()),
        ):
            assert_close(sampled.G, system.at(z))
        (_, sampled), (at_one, quotient) = g.over_z_minus_one(), G.split_at_one()
        assert_close(sampled.G - at_one / (z - 1)[..., None, None], quotient.at(z))


def test_a_sampled_split_keeps_digits_near_one():
    """He[K/(z-1)] = -K/2 on the whole circle, but 1 - cos w computed from z has the relative error 1e-16/w^2."""
    z = np.exp(1j * np.geomspace(1e-8, 3, 50))[None]
    split = Sampled.of(Lti.constant([[800.0]], 1e-3), z).over_z_minus_one()[1]
    np.testing.assert_allclose(split.G.real, -400.0, rtol=1e-15)


def test_the_quotient_at_one_equals_its_definition(blocks):
    G = blocks[0]
    assert_close(G.split_at_one()[1].at(Z), (G.at(Z) - G.dc()) / (Z - 1)[:, None, None])


def test_splitting_the_pole_keeps_the_hermitian_part(blocks):
    """G/(z-1) without its pole at z = 1 has the same Hermitian part. G = 3 + 1/z gives G(1) = 4 and leaves -2 - 1/z."""
    G = blocks[0] + (blocks[0].dc().T - blocks[0].dc()) / 2
    at_one, regular = G.over_z_minus_one()
    whole, rest = G.at(Z) / (Z - 1)[:, None, None], regular.at(Z)
    assert_close(at_one, G.dc())
    assert_close(rest + np.conj(np.swapaxes(rest, -1, -2)), whole + np.conj(np.swapaxes(whole, -1, -2)))
    at_one, regular = taps([3, 1], Fraction(1, 1000)).over_z_minus_one()
    assert (at_one.item(), regular.D.item(), regular.dc().item()) == (4, -2, -3)


@pytest.mark.parametrize("steps", [(0,), (3,), (1, 2), (0, 4, 50)])
def test_a_delay_line_equals_a_power_of_z(steps):
    D = delay(steps, 1e-3)
    assert D.order == sum(steps)
    assert_close(D.at(Z), np.array([np.diag([z ** -float(n) for n in steps]) for z in Z]))


def test_output_delays_equal_powers_of_z(blocks):
    """The delays are behind a block, before it, in a loop, in branches, and in a ring that no input reaches."""
    G = blocks[0]
    T, loop = G.T, delay((3, 0), G.T) @ G @ delay((1, 4), G.T)
    ring = np.zeros((8, 8))
    for i, j in ((1, 0), (2, 1), (3, 1), (4, 3), (5, 6), (6, 5), (7, 6)):
        ring[i, j] = 1
    ring[0, 0] = 0.5
    branches = Lti(ring, np.eye(8, 1), np.arange(16.0).reshape(2, 8), np.zeros((2, 1)), T)
    for block in (loop, loop.split_at_one()[1], delay((2, 3), T) @ G.feedback(0.01 * loop), branches):
        z = 1.1 * Z[:, None, None]
        assert_close(
            block.at(1.1 * Z), block.C @ np.linalg.solve(z * np.eye(block.order) - block.A, block.B + 0j) + block.D
        )
        assert block.poles().size == block.order
    assert loop._lines[0].size == G.order + 5 + 1  # 5 input delays; of the output's 3 delays, 2 only copy the first


def _stiff():
    """Return lightly damped modes of 0.1 to 400 Hz whose states have units from 1e-6 to 1e6."""
    radii, angles = 1 - np.geomspace(1e-6, 1e-2, 4), 2 * np.pi * 1e-3 * np.geomspace(0.1, 400, 4)
    A = np.zeros((8, 8))
    for i, (r, a) in enumerate(zip(radii, angles, strict=True)):
        A[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] = r * np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]])
    unit = np.geomspace(1e-6, 1e6, 8)
    rng = np.random.default_rng(3)
    return Lti(
        unit[:, None] * A / unit,
        unit[:, None] * rng.normal(size=(8, 2)),
        rng.normal(size=(2, 8)) / unit,
        np.zeros((2, 2)),
        1e-3,
    )


def _inner_delays():
    """Return a block with delays in a loop and before it, whose poles at 0 are defective."""
    rng = np.random.default_rng(4)
    G, H = random_lti(rng, 4, 2, 2), random_lti(rng, 3, 2, 2)
    return G.feedback(0.05 * H @ delay((3, 1), G.T)) @ delay((4, 10), G.T)


def _double_pole():
    """Return two equal blocks in series, whose double poles have one eigenvector each."""
    G = random_lti(np.random.default_rng(5), 5, 2, 2)
    return G @ G


@pytest.mark.parametrize(("make", "summed"), [(_stiff, True), (_inner_delays, True), (_double_pole, False)])
def test_stiff_and_defective_responses_match_plain_solves(make, summed):
    """Poles and taps are summed if the error of the sum is bounded; otherwise the Schur form is used."""
    G = make()
    assert (G._terms is not None) == summed
    w = np.concatenate([Z, np.exp(1j * np.abs(np.angle(G.poles())))])  # including each pole's angle
    expected = np.array([G.C @ np.linalg.solve(z * np.eye(G.order) - G.A, G.B) + G.D for z in w])
    np.testing.assert_allclose(G.at(w), expected, atol=1e-9 * np.abs(expected).max(), rtol=0)


def test_singular_algebraic_loop_is_refused():
    G, H = Lti.constant([[2.0]], 1e-3), Lti.constant([[-0.5]], 1e-3)
    with pytest.raises(SingularLoop, match="algebraic loop"):
        G.feedback(H)


def test_blocks_check_shapes_numbers_and_periods():
    with pytest.raises(ValueError, match=r"C has shape \(1, 3\), expected \(1, 2\)"):
        Lti(np.eye(2), np.ones((2, 1)), np.ones((1, 3)), [[0.0]], 1e-3)
    with pytest.raises(ValueError, match="not finite"):
        Lti.constant([[np.nan]], 1e-3)
    with pytest.raises(ValueError, match="different sampling periods"):
        Lti.constant([[1.0]], 1e-3) @ Lti.constant([[1.0]], 2e-3)
    with pytest.raises(ValueError, match="read-only"):
        Lti.constant([[1.0]], 1e-3).D[0, 0] = 2.0


def test_building_a_block_formats_no_matrices():
    """A search builds thousands of blocks, and formatting one costs more than its arithmetic."""

    class Unwritable(np.ndarray):
        def __repr__(self):
            raise AssertionError("a matrix was written as text")

    matrix = np.eye(2).view(Unwritable)
    block = Lti(matrix, matrix, matrix, matrix, 1e-3)
    assert (np.eye(2) == block.A).all()


def exact(G):
    """Return a block of Fractions near G, with a different denominator in each row."""
    T, rounded = Fraction(1, 1000), []
    for name in "ABCD":
        rows = [[Fraction(round(v * (97 + i)), 97 + i) for v in row] for i, row in enumerate(getattr(G, name).tolist())]
        rounded.append(np.array(rows, dtype=object).reshape(getattr(G, name).shape))
    return Lti(*rounded, T)


def at_rest(G):
    """Return G(1) of a block of Fractions by elimination of I - A, from its matrices alone."""
    n = G.order
    rows = [
        [*(Fraction(i == j) - a for j, a in enumerate(row)), *b]
        for i, (row, b) in enumerate(zip(G.A, G.B, strict=True))
    ]
    for k in range(n):
        pivot = next(i for i in range(k, n) if rows[i][k])
        rows[k], rows[pivot] = rows[pivot], rows[k]
        for i in range(n):
            if i != k and rows[i][k]:
                factor = rows[i][k] / rows[k][k]
                rows[i] = [a - factor * b for a, b in zip(rows[i], rows[k], strict=True)]
    X = [[v / rows[k][k] for v in rows[k][n:]] for k in range(n)]
    return [[G.D[i, j] + sum(G.C[i, k] * X[k][j] for k in range(n)) for j in range(G.inputs)] for i in range(G.outputs)]


def test_exact_blocks_at_rest_combine_their_parts(blocks):
    G, H = map(exact, blocks)
    late = hstack(G, delay((1, 2), G.T)) @ Lti.diag(H, 2 * H).rows([0, 3, 1, 2])
    for block in (G, G @ H, delay((2, 0), G.T) @ G.feedback(H), G @ np.array(H.D), late):
        static, R = block.split_at_one()
        assert (static == np.array(at_rest(block), dtype=object)).all()
        assert (block.dc() == static).all()
        # (z - 1) R = G - G(1) holds if R.C (A - I) = C, which needs no division
        assert (times(R.C, R.A) - R.C == block.C).all()
        assert (R.B == block.B).all()
        assert not R.D.any()


def test_products_of_fractions_are_sums_of_products():
    rng = np.random.default_rng(3)
    over, below = rng.integers(-60, 60, (2, 5, 5)), rng.integers(1, 60, (2, 5, 5))
    left, right = np.frompyfunc(lambda n, d: Fraction(int(n), int(d)), 2, 1)(over, below)
    left[1] = left[:, 2] = Fraction(0)
    assert (times(left, right) == left @ right).all()


def test_an_exact_block_without_states_stays_exact():
    """1/3 as a float would be 0.3333333333333333."""
    third = Lti.constant([[Fraction(1, 3)]], Fraction(1, 1000))
    closed = delay((1,), Fraction(1, 1000)).feedback(Lti(third.A, third.B, third.C, third.D, third.T))
    assert closed.A[0, 0] == Fraction(-1, 3)
    floats = Lti.constant([[0.25]], 1e-3)
    assert all(getattr(Lti(floats.A, floats.B, floats.C, floats.D, third.T), name).dtype == object for name in "ABCD")


def test_chains_of_slow_poles_keep_their_digits():
    """The product of both responses is accurate to 5e-13; a Schur form of all states together loses three digits."""
    b, w = 0.998, 0.06
    rotation = b * np.array([[np.cos(w), -np.sin(w)], [np.sin(w), np.cos(w)]])
    oscillator = Lti(rotation, [[1.0], [0.0]], [[1.0, 1.0]], [[0.5]], 1e-3)
    weights = np.resize([0.3, -0.7, 0.5, -0.1], 29)
    weights[0] += np.round(1 - weights.sum(), 1)
    chain = ForceFilter(1 - 0.5 * 1.35 ** -np.arange(20), [[-1.99, 0.992]] * 4, weights[:, None, None])
    z = np.exp(1j * np.geomspace(1e-5, np.pi, 100))
    product = chain.around(Sampled.of(oscillator, z[None])).G[0]
    series = chain.around(oscillator)
    states = Lti(series.A, series.B, series.C, series.D, series.T)
    for block in (series, states, Lti.constant([[1.0]], 1e-3) @ series):
        np.testing.assert_allclose(block.at(z), product, rtol=0, atol=2e-12 * np.abs(product).max())


@pytest.mark.parametrize("n", [1, 2, 7, 30])
def test_schur_forms_are_unitary_and_triangular(n):
    """Rounding errors are small multiples of n eps (Golub and Van Loan, 7.5.6). Matrices with NaN are refused."""
    A = np.random.default_rng(n).standard_normal((n, n))
    S, U = lti._schur_form(A)
    assert not np.tril(S, -1).any()
    assert np.abs(U @ U.conj().T - np.eye(n)).max() < 20 * n * np.finfo(float).eps
    assert np.abs(U @ S @ U.conj().T - A).max() < 20 * n * np.finfo(float).eps * np.linalg.norm(A)
    with pytest.raises(ValueError, match="infs or NaNs"):
        lti._schur_form(A * np.nan)
