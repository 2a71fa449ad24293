"""Tests of the limiter's condition: its block, closed forms, figures of the default loop, the best multiplier."""

from itertools import product

import msgspec
import numpy as np
import pytest
from evaluate import limiter, limiter_demand, prove_limiter, this_environment
from shared import DELTA, PAIR, STIFF, T

from haptic_loop.cli.design import main as design_main
from haptic_loop.controller.coupling import PUBLISHED, NoCoupling, SpringDamper
from haptic_loop.controller.loop import DelayRange
from haptic_loop.controller.lti import Lti, Sampled, taps
from haptic_loop.design import budgets, environments
from haptic_loop.design.certificate import limiter_rho, prove, required_damping, verify
from haptic_loop.design.conditions import _least_multiple
from haptic_loop.design.coupling_file import Certificate, Stored, load, save, sealed
from haptic_loop.design.environments import LIMITER, LimitedForces
from haptic_loop.design.frequency import hermitian, on_circle
from haptic_loop.design.gain_search import LimiterLoop
from haptic_loop.design.lmi import RESERVE
from haptic_loop.design.result import ANY, NotProved
from haptic_loop.design.spring_damper import design
from haptic_loop.design.transparency import transparency
from haptic_loop.sim.scenario import InputError

LAG = LIMITER.rho(PAIR)  # the limiter's rho [N/m], by device
BUILT = SpringDamper((5832.0, 2545.0), (0.187, 1.386))  # designed with the limiter's block


def required(coupling, c=None, lag=LAG) -> float:
    """Return the damping [N s/m] that the limited default loop requires for the multiplier c, or for the best one."""
    return limiter(PAIR.sent(coupling), PAIR.theta, DELTA, lag, c).required[0]


def test_one_channels_block_has_the_known_entries():
    """The block at w = 1 equals figures that were computed by hand; sampled responses give the same."""
    G, z = Lti.constant([[1000.0]], 1.0), on_circle(np.array([1.0]))
    upper = 984.010315 - 411.642518j
    expected = [[959.697694, upper], [np.conj(upper), 2032.919914]]
    demand = limiter_demand(G, (1,), (2000.0,), (20.0,), ((0.5,),))
    half = 5e-7  # half of the last digit
    np.testing.assert_allclose(hermitian((demand.free + demand.gain).at(z))[0], expected, rtol=0, atol=half)
    sampled = limiter_demand(Sampled.of(G, z[None]), (1,), (2000.0,), (20.0,), ((0.5,),))
    np.testing.assert_allclose(hermitian(sampled.free.G + sampled.gain.G)[0, 0], expected, rtol=0, atol=half)


def test_the_block_is_a_limited_loops_energy():
    """The sum of f'dx + dx' Delta dx/T - (M f_e)'de over time is the mean of the block's form over the circle.

    The motions begin and end at rest in the same place; M = z + sum_j c_j sum_{i<j} (z - z^-i).
    """
    rng = np.random.default_rng(3)
    theta, c, delta, rho = (1, 2), ((0.7, 0.2), (0.4, 0.1)), (1.3, 0.8), (30.0, 50.0)
    weights = rng.normal(size=(4, 2, 2)) * 300
    weights[-1] += (lambda total: (total.T - total) / 2)(weights.sum(axis=0))  # G(1) = G(1)'
    G = sum((Lti.constant(w, T) @ Lti.diag(*[taps([0] * k + [1], T)] * 2) for k, w in enumerate(weights[1:], 1)),
            Lti.constant(weights[0], T))  # fmt: skip
    ticks, moving = 256, 100
    dxi, de = np.zeros((2, ticks, 2))
    dxi[20:moving], de[20:moving] = rng.normal(size=(2, moving - 20, 2))
    dxi[moving], de[moving] = -dxi.sum(axis=0), -de.sum(axis=0)
    xi, e = (np.concatenate([np.zeros((1, 2)), np.cumsum(step, axis=0)[:-1]]) for step in (dxi, de))

    def late(signal, k):
        return np.roll(signal, k, axis=0)

    sent = sum(late(xi, k) @ w.T for k, w in enumerate(weights)) - (e - late(e, 1)) * rho
    felt = np.column_stack([late(sent, n)[:, i] for i, n in enumerate(theta)])
    multiplied = late(sent, -1)
    for j in (1, 2):
        own = sum(late(sent, -1) - late(sent, i) for i in range(j))
        multiplied = multiplied + own * [row[j - 1] for row in c]
    dx = dxi + de
    energy = (felt * dx + dx**2 * np.array(delta) / T - multiplied * de).sum()
    demand = limiter_demand(G, theta, delta, rho, c)
    z = on_circle(2 * np.pi * np.arange(ticks) / ticks)
    u = np.fft.fft(np.hstack([dxi, de]), axis=0)
    block = (demand.free + demand.gain).at(z)
    assert energy == pytest.approx((u.conj()[:, None] @ block @ u[:, :, None]).real.mean(), rel=1e-10)


@pytest.mark.parametrize("theta", [0, 1, 2, 4])
def test_limited_springs_meet_their_closed_forms(theta):
    """A spring needs (theta + 1)^2 K T/2 at c = 0 and (theta + 1/2) K T, as without limiter, at c_1 = theta."""
    K = 800.0
    G = Lti.constant([[K]], T)

    def needed(c):
        return limiter(G, (theta,), (1.0,), (1e-9,), c).required[0]

    assert needed(((0.0,),)) == pytest.approx((theta + 1) ** 2 * K * T / 2, rel=1e-6)
    assert needed(((float(theta),),)) == pytest.approx((theta + 0.5) * K * T, rel=1e-6)
    assert limiter(G, (theta,), (1.0,), (1e-9,)).required[0] == pytest.approx((theta + 0.5) * K * T, rel=1e-5)


@pytest.mark.parametrize(("c", "factor"), [(0.0, 2.0), (0.25, 1.6875), (0.5, 1.5625), (1.0, 1.5), (2.0, 1.6)])
def test_the_multiplier_sets_a_delayed_springs_need(c, factor):
    """With a delay of one sample and the multiplier c, a spring K requires the damping (2 + c)^2/(4 c + 2) K T."""
    G = Lti.constant([[1000.0]], T)
    assert limiter(G, (1,), (1.0,), (1e-9,), ((c,),)).ratio == pytest.approx(factor * 1000 * T, rel=1e-6)


def test_a_limited_coupling_needs_the_known_damping():
    """BUILT needs 1.30132 N s/m in the linear loop and more with the limiter, depending on the multiplier."""
    assert this_environment(PAIR.F(BUILT), DELTA).required[0] == pytest.approx(1.30132, abs=5e-6)
    for c, expected in (((0, 0), 1.42465), ((0.3, 0.3), 1.34059), ((0.278, 0.632), 1.32327)):
        assert required(BUILT, tuple((float(v),) for v in c)) == pytest.approx(expected, abs=5e-6)
    refused = limiter(PAIR.sent(BUILT), PAIR.theta, DELTA, LAG, ((1.0,), (1.0,)))
    assert not refused.certified
    assert "any multiplier c" in str(refused.reason)


@pytest.mark.parametrize(
    ("coupling", "expected"),
    [
        (NoCoupling(), 1.74600),
        (PUBLISHED["I"], 1.41600),
        (SpringDamper((879.0, 552.0), (0.39, 0.52)), 0.72345),
        (STIFF, 1.38533),
        (BUILT, 1.32327),
    ],
    ids=["none", "published", "any-environment", "this-environment", "built"],
)
def test_the_best_multiplier_needs_the_known_damping(coupling, expected):
    requirement = limiter(PAIR.sent(coupling), PAIR.theta, DELTA, LAG)
    assert requirement.required[0] == pytest.approx(expected, abs=1e-4)
    assert requirement.ratio <= requirement.bound * (1 + 2e-5)
    assert required(coupling, [[v] for v in requirement.multiplier]) == pytest.approx(requirement.required[0], rel=1e-9)
    linear = this_environment(PAIR.F(coupling), DELTA).required[0]
    assert requirement.required[0] >= linear * (1 - 1e-9)  # the linear loop's block is a principal part


def test_no_multiplier_on_a_grid_is_better():
    best = limiter(PAIR.sent(BUILT), PAIR.theta, DELTA, LAG).ratio
    grid = product(np.linspace(0.1, 0.6, 4), np.linspace(0.4, 0.9, 4))
    others = [limiter(PAIR.sent(BUILT), PAIR.theta, DELTA, LAG, ((a,), (b,))).ratio for a, b in grid]
    assert min(others) >= best * (1 - 1e-6)


def test_many_devices_use_the_zero_multiplier(monkeypatch):
    """With more than `MULTIPLIER_ROWS` rows one sweep at c = 0 replaces the search.

    The required damping at c = 0 may be larger than at the best c.
    """
    best = required_damping(PAIR, BUILT, LIMITER)
    monkeypatch.setattr(budgets, "MULTIPLIER_ROWS", 3)
    monkeypatch.setattr(environments._Search, "best", None)
    simple = required_damping(PAIR, BUILT, LIMITER)
    assert simple.multiplier == (0.0, 0.0)
    assert simple.required[0] == pytest.approx(required(BUILT, ((0.0,), (0.0,))))
    assert simple.required[0] >= best.required[0]
    assert required_damping(PAIR, BUILT, LIMITER, best.multiplier).required == pytest.approx(best.required)


def test_unequal_multipliers_need_enough_rho():
    """F(1) couples the channels: c = (0.2, 0.4) is infeasible at rho = 1e-4 Delta/T, but feasible at 0.01 Delta/T."""
    unequal = ((0.2,), (0.4,))
    assert np.isinf(required(BUILT, unequal, LimitedForces(1e-4).rho(PAIR)))
    assert required(BUILT, unequal) < 1.36


def test_bad_multipliers_betas_and_loops_are_refused():
    G = PAIR.sent(BUILT)
    with pytest.raises(ValueError, match="equally many per device"):
        limiter(G, (1, 2), DELTA, LAG, ((0.1,),))
    with pytest.raises(ValueError, match=r"beta is -0\.01, expected a number >= 0"):
        LimitedForces(-0.01)
    with pytest.raises(ValueError, match="expected numbers >= 0"):
        limiter(G, (1, 2), DELTA, LAG, ((-0.1,), (0.0,)))
    swinging = limiter(PAIR.sent(SpringDamper((1e6, 1e6), (50.0, 50.0))), (9, 9), DELTA, LAG)
    assert not swinging.certified


@pytest.mark.parametrize("rank", [1, 2, 3])
def test_the_least_multiple_makes_the_block_singular(rank):
    """At the least s the matrix `free + s gain` is singular.

    For a slightly larger s it is positive definite, and for a smaller s it is not. s is infinite unless `free` is
    positive where `gain` vanishes.
    """
    rng = np.random.default_rng(rank)
    for _ in range(20):
        half = rng.normal(size=(3, rank)) + 1j * rng.normal(size=(3, rank))
        gain = half @ half.conj().T
        free = hermitian(rng.normal(size=(3, 3)) + 1j * rng.normal(size=(3, 3))) + 0.5 * np.eye(3)
        null = np.linalg.svd(half)[0][:, rank:]
        feasible = rank == 3 or np.linalg.eigvalsh(null.conj().T @ free @ null)[0] > 0
        s = _least_multiple(free[None], gain[None])[0]
        assert np.isfinite(s) == feasible
        if feasible:
            assert np.linalg.eigvalsh(free + (s + 1e-6) * gain)[0] > 0
            assert np.linalg.eigvalsh(free + (s - 1e-6) * gain)[0] < 1e-9
            assert np.linalg.eigvalsh(free + s * gain)[0] == pytest.approx(0, abs=1e-8 * max(1, abs(s)))


# Exact proofs


@pytest.fixture(scope="module")
def stored() -> Stored:
    return Stored.of(PAIR, BUILT, prove_limiter(PAIR, BUILT))


def test_a_stored_limiter_proof_is_verified_after_loading(stored, tmp_path):
    save(stored, tmp_path / "limited.json")
    read = load(tmp_path / "limited.json")
    assert read == stored
    assert verify(read).proved
    assert read.certificate is not None
    proof = read.certificate
    assert (proof.condition, proof.facts) == ("this-environment", ("limiter",))
    assert proof.multipliers["rho"] == LAG
    assert limiter_rho(PAIR, read.certificate) == LAG
    assert proof.required == pytest.approx((1.32327, 1.32327), abs=5e-6)
    assert proof.margin == pytest.approx(1.37 / 1.32327, rel=1e-5)


def test_linear_proofs_survive_a_refused_limiter(tmp_path):
    """STIFF needs 1.385 N s/m with the limiter: its linear proof stays, the limiter's is refused with this figure."""
    stiff = STIFF
    plain = prove(PAIR, stiff, "this-environment")
    assert plain.facts == ()
    assert limiter_rho(PAIR, plain) is None
    with pytest.raises(NotProved, match=r"limiter: needs 1.38533, 1.38533 N s/m.* 1.37, 1.37"):
        prove_limiter(PAIR, stiff)


def test_any_environment_covers_the_limiter():
    soft = SpringDamper((879.0, 552.0), (0.39, 0.52))
    loop = msgspec.structs.replace(PAIR, delta=(1.4, 1.4))
    assert limiter_rho(loop, prove(loop, soft, "any-environment")) == (0.0, 0.0)


def tampered(stored, **fields):
    """Return the stored coupling with other fields in its certificate, whose seal is renewed."""
    known = stored.certificate.multipliers
    multipliers = known | {name: fields.pop(name) for name in ("c", "rho") if name in fields}
    proof = msgspec.structs.replace(stored.certificate, multipliers=multipliers, **fields)
    return msgspec.structs.replace(stored, certificate=sealed(proof))


@pytest.mark.parametrize(
    ("fields", "reason"),
    [
        ({"c": (0.5, 0.5)}, "limiter: required is"),
        ({"c": (1.0, 1.0)}, "limiter: no proof was found"),
        ({"c": (0.3, 0.1, 0.6)}, "expected 1 to 2 in rho and a multiple of that in c"),
        ({"c": (-0.1, 0.7)}, "limiter: c is [-0.1, 0.7], expected numbers >= 0"),
        ({"c": (0.3,)}, "rho has 2 numbers and c has 1"),
        ({"rho": (20.0, 20.0)}, "required is"),
        ({"rho": (-1.0, 10.0)}, "rho is"),
        ({"facts": ()}, "multipliers are"),
        ({"margin": 1.1}, "limiter: margin is 1.1"),
        ({"matrices": {"P": (("1",),)}}, "limiter: P has 1 rows"),
    ],
)
def test_changed_certificates_are_refused(stored, fields, reason):
    verdict = verify(tampered(stored, **fields))
    assert not verdict.proved
    assert reason in str(verdict.reason)


def test_a_changed_storage_matrix_proves_nothing(stored):
    P = [list(row) for row in stored.certificate.matrices["P"]]
    P[0][0] = "1/1000"
    assert "limiter: " in str(verify(tampered(stored, matrices={"P": tuple(map(tuple, P))})).reason)


def test_any_environment_with_psi_covers_no_limiter():
    loop = msgspec.structs.replace(PAIR, psi=(1, 1))
    some = Certificate("any-environment", (), (1.0, 1.0), PAIR.delta, 1.37, ANY, "rational", {}, {}, "", {})
    assert limiter_rho(PAIR, some) == (0.0, 0.0)
    assert limiter_rho(loop, some) is None


# Designs


@pytest.mark.slow
def test_limiter_designs_use_all_the_damping():
    """The limited loop needs over 99.9 % of the damping, and the design is over 1.3 dB better than BUILT."""

    def rms_db(coupling) -> float:
        return 20 * np.log10(transparency(PAIR.F(coupling), PAIR.E(), PAIR.lam).rms_mismatch)

    optimum = design(PAIR, "this-environment", limiter=True)
    assert 0.999 < 1 / prove_limiter(PAIR, optimum.coupling).margin < 1
    assert rms_db(BUILT) == pytest.approx(-9.16, abs=0.01)
    # A design without `limiter` reaches -11.19 dB, but has no proof for limited forces.
    assert rms_db(optimum.coupling) < -10.5
    with pytest.raises(ValueError, match="constant delays"):
        design(PAIR.switching(DelayRange((1, 1), (2, 2))), "this-environment", limiter=True)


@pytest.mark.slow
def test_the_command_stores_proofs_of_limited_forces(tmp_path):
    out = tmp_path / "limited.json"
    assert design_main(["--condition", "this-environment", "--limiter", "--out", str(out)]) == 0
    stored = load(out)
    assert verify(stored).proved
    assert limiter_rho(stored.loop, stored.certificate) == LAG
    with pytest.raises(InputError, match=r"--limiter is for --coupling .*, not ccl"):
        design_main(["--coupling", "ccl", "--limiter", "--out", str(out)])


def test_the_best_multiplier_attains_its_bound():
    """For delays of 0 and 3 samples the best multiplier attains its bound, and no random one is better by 0.1 %."""
    loop = msgspec.structs.replace(PAIR, theta=(0, 3), lam=(0, 0))
    G, rho = loop.sent(BUILT), LIMITER.rho(loop)
    requirement = limiter(G, loop.theta, loop.delta, rho)
    assert requirement.ratio <= requirement.bound * (1 + 1e-5)
    for c in np.random.default_rng(0).uniform(0, 1.5, (5, 2, 1)).tolist():
        assert limiter(G, loop.theta, loop.delta, rho, c).ratio > requirement.ratio * (1 - 1e-3)


def test_searched_parts_equal_the_block():
    sampled = LimiterLoop(PAIR)
    x = np.array([7.0, 6.5, 0.2, 0.9, 0.3, 0.6])
    G = Sampled.of(PAIR.sent(sampled.coupling(x)), on_circle(sampled.conditions)[None])
    demand = LIMITER.block(G, PAIR, [0.3, 0.6])
    block = hermitian((demand.free + (1 - 1.5 * RESERVE) * demand.gain).G[0])
    first, cross, corner = sampled.parts(x)
    for searched, part in (
        (first, block[:, :2, :2]),
        (cross, block[:, 2:, :2]),
        (corner[:, :, None] * np.eye(2), block[:, 2:, 2:]),
    ):
        # Rounding moved entries by up to 4e-12 of the largest one.
        np.testing.assert_allclose(searched, part, rtol=0, atol=1e-9 * np.abs(block).max())
