"""Tests of exact arithmetic: it agrees with numpy and floating-point blocks, and F(1) is exactly symmetric."""

import random
import re
from fractions import Fraction

import numpy as np
import pytest
from shared import FIGURE_4, force_map

from haptic_loop.controller.arithmetic import SingularLoop, TooLong, inverse, numbers, rational
from haptic_loop.controller.coupling import Compliance, NoCoupling, SpringDamper
from haptic_loop.controller.delay import delay, moving_sum
from haptic_loop.controller.environment import Network, Spring, environment
from haptic_loop.controller.lti import Lti
from haptic_loop.design import budgets, exact
from haptic_loop.design.exact import (
    _Matrix,
    _prove_positive_real,
    _reached,
    find_storage,
    negative_minor,
    refuted_rows,
    rows_of,
)

T = 1.2e-3
STAR = Network(
    contacts=("a", "b", "c"),
    springs=(
        Spring(("a", "hub"), 613.7, 0.31),
        Spring(("b", "hub"), 402.1, 1.7),
        Spring(("c", "hub"), 877.3),
        Spring(("hub", "ground"), 55.0, 0.2),
        Spring(("a", "ground"), 12.5),
    ),
    masses={"hub": 0.7, "b": 0.05},
)
COUPLINGS = [
    NoCoupling(),
    SpringDamper([7806.0, 3137.0], [0.105, 0.0]),
    Compliance(
        Lti([[0.3, 0.1], [0.0, -0.2]], [[1.0, 0.2], [0.3, 1.0]], [[1e-4, 0.0], [0.0, 2e-4]], 1e-4 * np.eye(2), T)
    ),
]


def at(G: Lti, z: complex) -> np.ndarray:
    return G.floats().at(z)


def symmetric_integers(rng: np.random.Generator, n: int) -> np.ndarray:
    S = rng.integers(-3, 4, (n, n))
    return S + S.T + rng.integers(0, 4 * n) * np.eye(n, dtype=int)


def test_a_float_counts_as_its_shortest_decimal():
    assert rational(0.0012) == Fraction(12, 10000)
    assert rational(np.float64(0.1)) == Fraction(1, 10)


def rounded_proof(S: np.ndarray, bits: int = 192) -> bool:
    """Return whether S (n, n), rounded to multiples of 2^-bits of its diagonal, is proved to be positive definite."""
    P, n = _Matrix.of(S), len(S)
    if any(v <= 0 for v in np.diag(P.num)):
        return False
    return exact._definite(exact._less(exact._rounded(P, exact._halves(P), bits), n), bits)


def test_negative_minors_agree_with_eigenvalues():
    rng = np.random.default_rng(1)
    outcomes = set()
    for _ in range(300):
        S = symmetric_integers(rng, int(rng.integers(1, 7)))
        idle = rng.integers(0, 5, len(S)) == 0
        S[idle], S[:, idle] = 0, 0
        least = np.linalg.eigvalsh(S)[0]
        minor = negative_minor(S)
        assert (minor is None) == (least > -1e-9)  # rounding may give a zero eigenvalue either sign
        if abs(least) > 1e-9:
            assert rounded_proof(S) == (least > 0)
        outcomes.add(least > 1e-9)
    assert outcomes == {True, False}


@pytest.mark.parametrize(
    ("S", "rows", "words"),
    [
        (np.diag([0, -1]), [2], "the principal minor of rows 2 is negative"),
        (np.diag([1, 0, -1]), [1, 3], "the principal minor of rows 1, 3 is negative"),
        (np.diag([2, -1]), [1, 2], "the leading minor of order 2 is negative"),
        ([[0, 1], [1, 5]], [1, 2], "the leading minor of order 2 is negative"),
        ([[0, 0, 1], [0, 3, 0], [1, 0, 5]], [1, 3], "the principal minor of rows 1, 3 is negative"),
    ],
)
def test_indefinite_matrices_name_a_negative_minor(S, rows, words):
    assert negative_minor(S) == words
    assert np.linalg.det(np.array(S)[np.ix_(*[np.array(rows) - 1] * 2)]) < -0.5


def test_gram_matrices_are_semidefinite_but_not_definite():
    rng = np.random.default_rng(2)
    for rank in range(1, 5):
        half = rng.integers(-5, 6, (6, rank))
        gram = half @ half.T
        assert negative_minor(gram) is None
        assert not rounded_proof(gram)


def test_definiteness_below_rounding_is_not_proved():
    tiny = Fraction(1, 2**400)
    S = [[Fraction(1), 1 - tiny], [1 - tiny, Fraction(1)]]
    assert negative_minor(S) is None
    assert not rounded_proof(S)


@pytest.mark.parametrize("bits", [16, 24, 40])
def test_matrices_that_rounding_makes_definite_are_not_proved(bits):
    """J + u M (J has ones, |M| <= 1/2, u = 2^-bits) is indefinite; rounded to multiples of u it is J + u I > 0."""
    u, less = Fraction(1, 2**bits), Fraction(499, 1000)
    M = [[Fraction(1, 2), -less, less], [-less, Fraction(1, 2), less], [less, less, Fraction(1, 2)]]
    S = [[1 + u * entry for entry in row] for row in M]
    assert negative_minor(S)
    assert not rounded_proof(S, bits)
    assert rounded_proof([[1 + 8 * u * (i == j) for j in range(3)] for i in range(3)], bits)


def test_coarse_rounding_never_proves_what_elimination_refuses():
    rng, proved = np.random.default_rng(5), 0
    for _ in range(400):
        n = int(rng.integers(2, 6))
        half = rng.integers(-9, 10, (n, n))
        S = half @ half.T * 1000 + np.diag(rng.integers(0, 60, n)) - int(rng.integers(0, 400)) * np.eye(n, dtype=int)
        if rounded_proof(S, bits=10):
            assert negative_minor(S) is None
            assert np.linalg.eigvalsh(S)[0] > 1e-6
            proved += 1
    assert proved > 50


def test_huge_entries_prove_nothing_false(recwarn):
    for size in (10**200, 10**400, 10**4000):
        assert not rounded_proof([[1, size], [size, 1]])
        assert not rounded_proof([[Fraction(1, size), 1], [1, 1]])
        assert rounded_proof([[size, 1], [1, Fraction(2, size)]])
    assert not recwarn.list


def hilbert(n: int, shift: Fraction = Fraction(0)) -> list[list[Fraction]]:
    return [[Fraction(1, i + j + 1) - (shift if i == j else 0) for j in range(n)] for i in range(n)]


def test_definiteness_is_proved_beyond_double_precision():
    """Hilbert's matrices of condition 5e5 to 2e28 are shifted to both sides of a bisected least eigenvalue."""
    for n in (5, 12, 20):
        below, above = -120, 0  # powers of two; the least eigenvalue is at least 1e-30
        while above - below > 1:
            middle = (below + above) // 2
            definite = negative_minor(hilbert(n, Fraction(1, 2**-middle))) is None
            below, above = (middle, above) if definite else (below, middle)
        low, high = Fraction(1, 2**-below), Fraction(1, 2**-above)
        while high - low > high / 30:
            middle = (low + high) / 2
            low, high = (middle, high) if negative_minor(hilbert(n, middle)) is None else (low, middle)
        assert rounded_proof(hilbert(n))
        assert rounded_proof(hilbert(n, low))
        assert not rounded_proof(hilbert(n, high))


def test_the_exact_inverse_is_an_inverse():
    rng = np.random.default_rng(3)
    for n in range(1, 8):
        S = numbers(rng.integers(-9, 10, (n, n)), Fraction(1)) / 7
        assert (S @ inverse(S) == np.eye(n, dtype=int)).all()
    with pytest.raises(SingularLoop):
        inverse(numbers([[1, 2], [2, 4]], Fraction(1)))


@pytest.mark.parametrize("coupling", COUPLINGS, ids=lambda c: type(c).__name__)
@pytest.mark.parametrize(("theta", "psi"), [((1, 2), (0, 0)), ((0, 3), (1, 0))])
def test_the_exact_force_map_equals_the_running_one(coupling, theta, psi):
    F = force_map(environment(FIGURE_4, rational(T)), coupling, theta, psi)
    running = force_map(environment(FIGURE_4, T), coupling, theta, psi)
    rng = np.random.default_rng(4)
    for z in rng.uniform(0.7, 1.5, 5) * np.exp(1j * rng.uniform(0, np.pi, 5)):
        # Near a resonance a response in floating point loses digits: here an entry errs by up to 2e-10 of its size.
        np.testing.assert_allclose(at(F, z), running.at(z), rtol=1e-8, atol=1e-8)


def test_the_static_stiffness_is_exactly_symmetric_and_semidefinite():
    T = rational(0.001)
    for coupling in (SpringDamper([901.3, 512.9, 3000.1], [0.3, 0.0, 1.1]), NoCoupling()):
        F1, _ = force_map(environment(STAR, T), coupling, (0, 3, 1), (0, 0, 0)).split_at_one()
        assert (F1 == F1.T).all()
        assert negative_minor(F1) is None
    F1, _ = environment(FIGURE_4, rational(T)).split_at_one()
    assert F1[0, 0] == Fraction(800 * 700, 1500)
    assert negative_minor(F1) is None
    assert negative_minor(F1 - Fraction(1, 10**40) * np.eye(2, dtype=int)) is not None


def test_exact_delays_and_sums_equal_the_running_ones():
    z = 1.1 * np.exp(0.4j)
    window = [sum(z**-k for k in range(n + 1)) for n in (0, 3)]
    np.testing.assert_allclose(at(moving_sum((0, 3), rational(T)), z), np.diag(window), rtol=1e-12)
    np.testing.assert_allclose(at(delay((0, 3), rational(T)), z), delay((0, 3), T).at(z), rtol=1e-12)


def test_a_wrong_storage_matrix_proves_nothing():
    # G = 1 + 0.5/(z - 0.5): He G >= 2/3 on the circle
    G = Lti(*([[v]] for v in (0.5, 1.0, 0.5, 1.0)), Fraction(1))
    assert _prove_positive_real(G, _Matrix.of([["1/2"]])) is None
    assert re.search("KYP|negative", _prove_positive_real(G, _Matrix.of([[5]])))
    # with P = 1 the matrix is diag(3/4, 2 D - 1): floating point cannot tell its entry of 2e-30 from zero
    for D, reason in ((Fraction(1, 2) + Fraction(1, 10**30), None), (Fraction(1, 2), "the KYP matrix is not positive")):
        refusal = _prove_positive_real(Lti(*([[v]] for v in (0.5, 1, 0.5, D)), Fraction(1)), _Matrix.of([[1]]))
        assert refusal is reason or refusal.startswith(reason)
    zero = Lti(*([[v]] for v in (1, 1, 1, Fraction(1, 2))), Fraction(1))  # with P = 1 the KYP matrix is exactly zero
    assert _prove_positive_real(zero, _Matrix.of([[1]])).startswith("the KYP matrix is not positive")
    # An unstable block may have a positive KYP matrix with P < 0; only the inequality P > 0 refuses it.
    unstable = Lti(*([[v]] for v in (2, 1, 0, 5)), Fraction(1))
    assert _prove_positive_real(unstable, _Matrix.of([[-1]])) == (
        "P is not positive definite, or too close to singular for a proof"
    )
    # D + D' = 0, and the input moves no state: no P can prove it
    still = Lti(*([[Fraction(v)]] for v in ("1/2", "0", "0", "0")), Fraction(1))
    assert _prove_positive_real(still, _Matrix.of([[1]])).startswith("D + D' is not positive definite")
    assert find_storage(unstable) == (None, "the block has a pole on or outside the unit circle")
    assert _prove_positive_real(G, _Matrix.of(np.eye(2))) == "P has shape (2, 2), the block has 1 states"


def random_exact(rng: np.random.Generator, n: int, m: int) -> Lti:
    A, B, C, D = (rng.integers(-9, 10, shape) for shape in ((n, n), (n, m), (m, n), (m, m)))
    return Lti(*(numbers(part, Fraction(1)) / 10 for part in (A, B, C, D)), Fraction(1))


def kyp(G: Lti, P: np.ndarray) -> np.ndarray:
    """Return the Kalman-Yakubovich-Popov matrix in Fractions."""
    cross = G.C - G.B.T @ P @ G.A
    return np.block([[P - G.A.T @ P @ G.A, cross.T], [cross, G.D + G.D.T - G.B.T @ P @ G.B]])


def test_a_static_block_is_refused_exactly(monkeypatch):
    """D has the determinant -1/2^60, which a sweep in floating point may take for positive."""
    monkeypatch.setattr(exact, "_least_eigenvalue", lambda G: (1e-17, 0.0))
    D = [[Fraction(1), Fraction(1)], [Fraction(1), 1 - Fraction(1, 2**60)]]
    P, reason = find_storage(Lti.constant(D, Fraction(1, 1000)))
    assert P is None
    assert reason


def test_the_kyp_form_is_supply_less_storage_increase():
    """The KYP form x'Px - (Ax + Bu)'P(Ax + Bu) + 2u'(Cx + Du) is the supply less the increase of storage."""
    rng = np.random.default_rng(6)
    G, half = random_exact(rng, 3, 2), rng.integers(-5, 6, (3, 3))
    P = numbers(half + half.T, Fraction(1)) / 7
    for _ in range(20):
        x, u = (numbers(rng.integers(-9, 10, k), Fraction(1)) for k in (3, 2))
        after, both = G.A @ x + G.B @ u, np.concatenate([x, u])
        assert both @ kyp(G, P) @ both == x @ P @ x - after @ P @ after + 2 * u @ (G.C @ x + G.D @ u)


@pytest.mark.parametrize(("bits", "finer"), [(16, 16), (32, 16), (48, 112), (192, 192)])
def test_rounding_of_the_kyp_matrix_is_bounded(bits, finer):
    """The integer matrix differs from the exact one by at most its bound, in any units of states and channels."""
    rng, fullest = np.random.default_rng(16), 0.0
    for _ in range(12):
        n, m = 5, 2
        units = [Fraction(10) ** int(k) for k in rng.integers(-3, 4, n + m)]
        states, channels, back = np.diag(units[:n]), np.diag(units[n:]), np.diag([1 / v for v in units[:n]])
        G, half = random_exact(rng, n, m), rng.integers(-9, 10, (n, n)) + 9 * np.eye(n, dtype=int)
        D = G.D + 3 * np.eye(m, dtype=int)
        G = Lti(states @ G.A @ back, states @ G.B @ channels, channels @ G.C @ back, channels @ D @ channels, G.T)
        P = _Matrix.of(back @ (half @ half.T) @ back / 7)
        row, column = exact._halves(P), exact._halves(_Matrix.of(G.D + G.D.T))
        size = np.diag([Fraction(2) ** h for h in row])
        rounded = size @ exact._rounded(P, row, bits) @ size * Fraction(1, 2**bits)
        integers, most = exact._kyp_matrix(G, P, bits, finer)
        size = np.diag([Fraction(2) ** -h for h in [*row, *column]])
        error = 2**finer * (size @ kyp(G, rounded) @ size) - integers
        worst = np.abs(np.linalg.eigvalsh(error.astype(float))).max() / most
        assert worst <= 1
        fullest = max(fullest, worst)
    assert fullest > 0.01


def test_exact_arithmetic_alone_refuses_wrong_storage_matrices(monkeypatch):
    """Without the quick refusal in floating point, a P just outside either end of the valid interval is refused."""
    monkeypatch.setattr(exact, "_refuted_in_floating_point", lambda G, P: False)
    # A P is valid if (3/4 P)(2 - P) > (1/2 - P/2)^2.
    G = Lti(*([[v]] for v in (0.5, 1, 0.5, 1)), Fraction(1))
    low, high = (4 - np.sqrt(12)) / 4, (4 + np.sqrt(12)) / 4
    for p, expected in ((low, (False, True)), (high, (True, False))):
        for factor, proved in zip((1 - 1e-9, 1 + 1e-9), expected, strict=True):
            refusal = _prove_positive_real(G, _Matrix.of([[Fraction(p * factor)]]))
            assert (refusal is None) == proved


def test_floating_point_refuses_no_definite_matrix():
    """The exact P - A'PA = (1 - r^2) P is definite. Computed in floats it often is not, because 1 - r^2 is tiny."""
    rng, indefinite = np.random.default_rng(7), 0
    for _ in range(60):
        n = int(rng.integers(2, 6))
        half = rng.normal(size=(n, n)) @ np.diag(10.0 ** rng.uniform(-3, 0, n)) * 10.0 ** rng.uniform(-3, 3, n)[:, None]
        P = _Matrix.of(np.vectorize(Fraction, otypes=[object])(half @ half.T))
        r = Fraction(1) - Fraction(1, 2 ** int(rng.integers(44, 53)))
        eye, zero = numbers(np.eye(n), Fraction(1)), numbers(np.zeros((n, 1)), Fraction(1))
        G = Lti(r * eye, zero, zero.T, numbers([[1]], Fraction(1)), Fraction(1))
        M = P.floats() - G.floats().A.T @ P.floats() @ G.floats().A
        indefinite += np.linalg.eigvalsh(M)[0] < 0
        if negative_minor(kyp(G, P.fractions())) is None:
            assert not exact._refuted_in_floating_point(G, P)
    assert indefinite > 10


def test_unreachable_states_are_left_out():
    A = [[0.5, 0, 0, 0], [0, 0.5, 0, 0], [1, -1, 0.2, 0], [0, 0, 0.3, 0.1]]
    B, C = [[1], [1], [0], [0]], [[0.1, 0, 0.1, 0.1]]
    G = Lti(*(numbers(part, Fraction(1)) for part in (A, B, C, [[1]])), Fraction(1))
    assert _reached(G) is G
    P, reason = find_storage(G)  # the first two states are equal, and cancel in the third
    assert reason is None
    assert P.shape == (4, 4)
    late = Lti(G.A.T, numbers([[0], [0], [1], [0]], Fraction(1)), G.C, G.D, Fraction(1))
    assert _reached(late).order == 3
    np.testing.assert_allclose(at(_reached(late), 1.3j), at(late, 1.3j), rtol=1e-12)
    P, reason = find_storage(late)
    assert reason is None
    assert refuted_rows("P", late, rows_of(P)) is None
    unreached = [*([*row, "0"] for row in rows_of(P)), ["0", "0", "0", "1"]]
    assert refuted_rows("P", late, unreached) == "P has 4 rows, the block has 3 states"


def test_a_wrong_riccati_solution_proves_nothing(monkeypatch):
    G = Lti(*([[v]] for v in (0.5, 1, 0.5, 1)), Fraction(1))
    for wrong in (-1.0, 100.0):
        monkeypatch.setattr(exact, "_riccati", lambda *words, p=wrong: np.array([[p]]))
        P, reason = find_storage(G)
        assert P is None
        assert re.search("KYP|negative", reason)


def test_exact_arithmetic_takes_numbers_beyond_floats(recwarn):
    G = Lti(*([[v]] for v in (0.5, 1, 0.5, 10**308)), Fraction(1))  # D + D' overflows
    assert _prove_positive_real(G, _Matrix.of([[1]])) is None
    assert _prove_positive_real(G, _Matrix.of([[-1]])) is not None
    assert not recwarn.list


def test_proofs_are_limited_to_800_states():
    budgets.require_size(budgets.PROOF_STATES)
    with pytest.raises(TooLong, match=r"^a proof over 801 states takes long: up to 800 are tried$"):
        budgets.require_size(budgets.PROOF_STATES + 1)


@pytest.mark.parametrize(("bits", "others"), [(3, 3), (16, 15), (192, 57), (31, 500)])
def test_integer_products_are_exact(bits, others):
    """Products equal those of Python's integers, also for the largest entries of either sign and empty matrices."""
    draw = random.Random(bits)
    X, M = (
        np.array([[draw.randint(-(2**b), 2**b) for _ in range(columns)] for _ in range(30)], dtype=object)
        for b, columns in ((bits, 25), (others, 30))
    )
    X[:, 0], X[:, 1], X[:, 2], M[:, 0], M[:, 1] = 2**bits, -(2**bits), 0, 2**others, 1 - 2**others
    for columns in (25, 1, 0):
        product = exact._congruence(X[:, :columns], M)
        assert product.shape == (columns, columns)
        assert (product == X[:, :columns].T @ M @ X[:, :columns]).all()
        assert all(type(v) is int for v in product.flat)
    assert exact._congruence(X[:0], M[:0, :0]).tolist() == [[0] * 25] * 25
