"""Tests of forces that latch a fraction of a sample late: closed forms, whole samples, proofs and simulations."""

import msgspec
import numpy as np
import pytest
from analysis import solve
from driven import growing
from evaluate import latency_demand, this_environment, this_environment_demand
from scipy.linalg import expm
from shared import FIGURE_4, ONE_MASS

from haptic_loop.controller.arithmetic import numbers
from haptic_loop.controller.coupling import NoCoupling, SpringDamper
from haptic_loop.controller.delay import delay
from haptic_loop.controller.environment import GROUND, Network, Spring
from haptic_loop.controller.loop import Loop
from haptic_loop.controller.lti import Lti, Sampled, hstack, vstack
from haptic_loop.design.api import design_coupling, transparency_of
from haptic_loop.design.certificate import prove, required_damping, requirements_of, verify
from haptic_loop.design.conditions import Condition, Demand, least_scale
from haptic_loop.design.coupling_file import Stored, load, save, sealed
from haptic_loop.design.environments import THIS_ENVIRONMENT, ThisEnvironment
from haptic_loop.design.facts import Latency
from haptic_loop.design.frequency import frequencies, hermitian, on_circle
from haptic_loop.design.result import NotProved
from haptic_loop.sim.scenario import parse

T, TAU, K = 1.2e-3, 0.13e-3, 1000.0
SOFT = SpringDamper([879.0, 552.0], [0.39, 0.52])
STIFF = SpringDamper([5832.0, 2545.0], [0.187, 1.386])
PAIR = Loop(T, (0, 1), (0, 0), (0, 1), (1.37, 1.37), FIGURE_4)
WALL = Loop(T, (0,), (0,), (0,), (1.0,), Network(("tip",), (Spring(("tip", GROUND), K),)))
change = msgspec.structs.replace


def spring(theta=0) -> Lti:
    """Return K z^-theta."""
    return delay((theta,), T) @ Lti.constant([[K]], T)


@pytest.mark.parametrize(
    ("theta", "range", "needs"), [(0, (TAU, TAU), 0.774878), (0, (0.0, TAU), 0.841354), (1, (TAU, TAU), 1.947854)]
)
def test_late_walls_need_the_known_damping(theta, range, needs):
    requirement = this_environment(spring(theta), [1.0], latency=[range])
    assert requirement.required[0] == pytest.approx(needs, abs=2e-6)
    if theta == 0:  # the condition binds as w -> 0: (delta/t2 - 3K/2)(delta/(T - t1) - K/2) = K^2
        t1, t2 = range
        closed = np.roots([1 / (t2 * (T - t1)), -K / (2 * t2) - 3 * K / (2 * (T - t1)), 3 * K**2 / 4 - K**2]).max()
        assert requirement.required[0] == pytest.approx(closed, rel=1e-9)
        assert requirement.frequency_hz == 0


def test_the_block_has_the_known_entries():
    demand = latency_demand(spring(), [1.0], [(TAU, TAU)])
    z = on_circle(np.array([0.5]))
    block = hermitian(demand.free.at(z) + demand.gain.at(z))[0]
    expected = [[6314.725130, -938.791281 + 239.712769j], [-938.791281 - 239.712769j, 434.579439]]
    assert block == pytest.approx(np.array(expected), abs=1e-6)
    sampled = latency_demand(Sampled(z[None], spring().at(z)[None], T), [1.0], [(TAU, TAU)])
    assert hermitian(sampled.free.G + sampled.gain.G)[0, 0] == pytest.approx(block, abs=1e-6)


@pytest.mark.parametrize(
    ("range", "needs"),
    [((1e-10, 1e-10), 0.584731), ((TAU, TAU), 0.574622), ((0.0, TAU), 0.611902), ((T - 1e-12, T - 1e-12), 0.714344)],
)
def test_pairs_with_latency_need_the_known_damping(range, needs):
    """A latency of almost 0 needs the damping of theta = (0, 1), a latency of almost T that of theta = (1, 2)."""
    requirement = required_damping(change(PAIR, latency=(range, range)), SOFT, "this-environment")
    assert max(requirement.required) == pytest.approx(needs, abs=2e-6)
    assert this_environment(PAIR.F(SOFT), PAIR.delta).required[0] == pytest.approx(0.584731, abs=1e-6)
    assert this_environment(change(PAIR, theta=(1, 2)).F(SOFT), PAIR.delta).required[0] == pytest.approx(
        0.714344, abs=1e-6
    )


# Ranges of latency: a matrix Q weights both parts of a period together


@pytest.mark.parametrize("theta", [0, 1])
@pytest.mark.parametrize("range", [(0.0, 0.4 * T), (0.1 * T, 0.6 * T)])
def test_the_latest_latency_sets_a_walls_requirement(theta, range):
    """The needed delta is the larger root of a quadratic equation for the latest latency t2.

    The equation is (delta/t2 - (theta + 3/2) K)(delta/(T - t2) - (theta + 1/2) K) = (theta + 1)^2 K^2.
    """
    late, soon = range[1], T - range[1]
    slope = (theta + 1.5) / soon + (theta + 0.5) / late
    closed = np.roots([1 / (late * soon), -slope * K, ((theta + 1.5) * (theta + 0.5) - (theta + 1) ** 2) * K**2]).max()
    known = {(0, 0.0): 1.1548, (0, 0.1 * T): 1.3825, (1, 0.0): 2.3173, (1, 0.1 * T): 2.5538}[theta, range[0]]
    loop = change(WALL, theta=(theta,), latency=(range,), delta=(3.0,))
    requirement = required_damping(loop, NoCoupling(), "this-environment")
    assert requirement.required[0] == pytest.approx(closed, rel=1e-6)
    assert closed == pytest.approx(known, abs=5e-5)


def by_a_dense_program(loop, coupling, latencies, binding_hz):
    """Return the least delta of equal devices over all Q: a semidefinite program at many frequencies and latencies."""
    import cvxpy as cp

    near = 2 * np.pi * T * binding_hz * np.linspace(0.98, 1.02, 5)
    w = np.concatenate([near, np.linspace(1e-4, np.pi, 40), np.geomspace(1e-3, 0.5, 30)])
    z, m, s = np.exp(1j * w), loop.channels, cp.Variable()
    R = [cp.Variable((2, 2), symmetric=True) for _ in loop.theta]  # s Q
    least, most = loop.latency[0]
    limits = [
        s * np.diag([1 / max(tau, 1e-9), 1 / (T - tau)]) - part >> 0
        for part in R
        for tau in np.linspace(least, most, latencies)
    ]
    taken = cp.bmat([[cp.diag(cp.hstack([part[a, b] for part in R])) for b in (0, 1)] for a in (0, 1)])
    for zk, F in zip(z, loop.F(coupling).at(z), strict=True):
        G = F / (zk - 1)
        H = np.block([[G / zk, G / zk], [G, G]])
        H = (H + H.conj().T) / 2
        real = np.block([[H.real, -H.imag], [H.imag, H.real]])
        limits.append(T * (cp.kron(np.eye(2), taken) + real) / loop.delta[0] >> 0)
    assert m == 2
    return solve(cp.Problem(cp.Minimize(s / loop.delta[0]), limits)) * loop.delta[0]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("coupling", "range", "needs"),
    [(SOFT, (0.0, 0.4 * T), 0.691186), pytest.param(STIFF, (0.1 * T, 0.6 * T), 1.324571, marks=pytest.mark.validate)],
)
def test_pair_requirements_match_a_dense_program(coupling, range, needs):
    loop = change(PAIR, latency=(range, range))
    requirement = required_damping(loop, coupling, "this-environment")
    assert requirement.required[0] == pytest.approx(needs, rel=2e-6)
    assert by_a_dense_program(loop, coupling, 9, requirement.frequency_hz) == pytest.approx(needs, rel=5e-4)
    apart = least_scale_of(this_environment_demand(loop.F(coupling), PAIR.delta, latency=loop.latency))
    assert 0.8 < requirement.ratio / apart < 0.87  # separate weights of both parts of a period need more
    assert (
        requirement.ratio
        > required_damping(change(PAIR, latency=((range[1],) * 2,) * 2), coupling, THIS_ENVIRONMENT).ratio
    )


def least_scale_of(demand):
    """Return the ratio for a demand that weights both parts of a period separately."""
    return least_scale(demand, frequencies(PAIR.F(SOFT), points=4000)).max()


def test_weights_are_admitted_if_every_latency_admits_them():
    """`Latency` accepts a Q, even an indefinite one, if and only if eigenvalues at many latencies admit it."""
    rng, agreed = np.random.default_rng(0), np.zeros(2, dtype=int)
    for _ in [None] * 60:
        first, last = np.sort(np.round(rng.uniform(0, T, 2), 6))
        loop = change(WALL, latency=((first, last),), T_max=float(rng.choice([T, 1.5e-3])))
        tau = np.linspace(first, last, 2000)[:, None, None]
        D = np.where(np.eye(2) > 0, np.sqrt(np.concatenate([tau, loop.T_max - tau], axis=1)), 0)
        Q = rng.standard_normal((2, 2)) * rng.uniform(0, 3e3)
        Q = (Q + Q.T) * np.sign(np.trace(Q))  # so that Q is positive in some direction
        most = np.linalg.eigvalsh(D @ Q @ D).max()
        for share in (0.999, 1.001):
            entries = {
                "q11": (share / most * Q[0, 0],),
                "q12": (share / most * Q[0, 1],),
                "q22": (share / most * Q[1, 1],),
            }
            admitted = Latency().excess(loop, entries) is None
            assert admitted == (share < 1)
            agreed[int(admitted)] += 1
    assert agreed.min() == 60


def test_forged_weights_are_refused():
    loop = change(PAIR, latency=((0.0, 0.4 * T), (TAU, TAU)))
    stored = Stored.of(loop, SOFT, prove(loop, SOFT, "this-environment"))
    assert stored.certificate.multipliers["q11"][1] == 0  # the second device's latency is constant
    assert verify(msgspec.json.decode(msgspec.json.encode(stored), type=Stored)).proved
    more = {name: (1.01 * first, rest) for name, (first, rest) in stored.certificate.multipliers.items()}
    forged = sealed(change(stored.certificate, multipliers=more))
    assert "more than the latency of device 1" in verify(change(stored, certificate=forged)).reason


def test_channels_without_latency_have_no_row():
    F = PAIR.F(SOFT)
    none, plain = latency_demand(F, PAIR.delta, [(0.0, 0.0)] * 2), this_environment_demand(F, PAIR.delta)
    w = frequencies(F, points=100)
    assert least_scale(none, w) == pytest.approx(least_scale(plain, w), abs=1e-12)
    mixed = latency_demand(F, PAIR.delta, [(0.0, TAU), (0.0, 0.0)])
    assert mixed.free.inputs == 3
    both = latency_demand(F, PAIR.delta, [(0.0, TAU), (0.0, 1e-12)])
    assert least_scale(mixed, w) == pytest.approx(least_scale(both, w), abs=1e-6)


@pytest.mark.parametrize(
    ("latency", "longest"),
    [
        (((TAU, TAU), (0.0, TAU)), 1.5e-3),
        pytest.param(((0.0, TAU), (0.0, 0.0)), None, marks=pytest.mark.validate),
    ],
)
def test_latency_is_proved_stored_and_verified(latency, longest):
    loop = change(PAIR, latency=latency, T_max=longest)
    stored = Stored.of(loop, SOFT, prove(loop, SOFT, "this-environment"))
    again = msgspec.json.decode(msgspec.json.encode(stored), type=Stored)
    assert verify(again).proved
    assert not verify(change(again, loop=change(loop, latency=((0.0, TAU), (0.0, 2 * TAU))))).proved
    least = required_damping(loop, SOFT, "this-environment").required
    enough, short = (change(loop, delta=tuple(f * d for d in least)) for f in (1.001, 0.999))
    assert prove(enough, SOFT, "this-environment").proof == "rational"
    with pytest.raises(NotProved):
        prove(short, SOFT, "this-environment")


def test_loops_without_a_derived_condition_are_refused():
    loop = change(PAIR, latency=((0.0, TAU),) * 2)
    assert requirements_of(loop, SOFT)["this-environment"].proof == "rational"
    with pytest.raises(NotProved, match="delay in the environment"):
        prove(change(loop, psi=(1, 1)), SOFT, "any-environment")
    with pytest.raises(ValueError, match=r"latency #2 is 0 to 0\.0012 s"):
        change(loop, latency=((0.0, TAU), (0.0, T)))
    with pytest.raises(ValueError, match=r"latency #1 .* < T_min"):
        change(loop, T_max=2 * T, T_min=TAU)


# Loops whose latency switches, simulated exactly: the previous force acts until kT + tau_k, then the new one.


HANDS, TICKS = 60, 6000


def grown(damping, latencies, mean, seed=3):
    """Return for how many lossless hands the motion grows a hundredfold between a tenth of the ticks and the end.

    tau is one of `latencies` [s]. It is drawn anew after `mean` ticks on average. If `mean` is None, each tick has the
    tau that gives the hand most energy.
    """
    rng = np.random.default_rng(seed)
    mass, stiff = 10 ** rng.uniform(-4, 0, HANDS), 10 ** rng.uniform(0, 3, HANDS)
    A = np.zeros((HANDS, 3, 3))
    A[:, 0, 1] = 1
    A[:, 1, 0], A[:, 1, 1], A[:, 1, 2] = -stiff / mass, -damping / mass, -1 / mass  # under a constant force
    steps = []
    latch, force = np.diag([1.0, 1.0, 0.0]), np.zeros((3, 3))
    force[2, 0] = K  # the new force follows from the position at the tick
    for tau in latencies:
        steps.append(expm(A * (T - tau)) @ (latch @ expm(A * tau) + force))
    steps, energy = np.stack(steps), np.stack([stiff, mass], axis=1)
    return growing(steps, energy, mean, rng, TICKS)


@pytest.mark.parametrize("mean", [1, 100, pytest.param(None, marks=pytest.mark.slow)])
def test_motions_grow_only_below_the_requirement(mean):
    latencies = np.linspace(0, TAU, 3)
    need = required_damping(
        change(WALL, latency=((0.0, TAU),)), SpringDamper([1e9], [0.0]), "this-environment"
    ).required[0]
    assert need == pytest.approx(0.774878, rel=1e-4)  # as for the constant latency TAU
    assert grown(1.02 * need, latencies, mean) == 0
    assert grown(0.6 * need, latencies, mean) > 0


@pytest.mark.slow
def test_latency_designs_beat_a_whole_sample():
    one = change(parse(ONE_MASS).loop("I"), theta=(0,), lam=(0,))
    loop = change(one, latency=((0.0, TAU),))
    design = design_coupling(loop, "spring-damper", "this-environment")
    assert 0.99 < design.requirement.ratio < 1
    assert requirements_of(loop, design.coupling)["this-environment"].proof == "rational"
    whole = design_coupling(change(one, theta=(1,)), "spring-damper", "this-environment")
    assert transparency_of(loop, design).rms_mismatch_db < transparency_of(loop, whole).rms_mismatch_db - 1
    anywhere = design_coupling(loop, "spring-damper", "any-environment")
    assert 0.99 < anywhere.requirement.ratio < 1


# Conditions that a user writes


class LatchesLate(Condition):
    """The block of a latency, written again: forces of the previous tick act for TAU on every channel."""

    name = "latches-late"

    def demand(self, loop, coupling, exact=False):
        F, m = loop.F(coupling, exact), loop.channels
        before = delay((1,) * m, F.T) @ F
        split = [G.split_at_one() for G in (hstack(before, before), hstack(F, F))]
        static, rest = np.vstack([G1 for G1, _ in split]), vstack(*(R for _, R in split))
        gain = numbers(loop.delta * 2, F.T) / numbers([TAU] * m + [T - TAU] * m, F.T)
        F1 = static[m:, m:]
        return Demand(rest - static / 2, Lti.constant(np.diag(gain), F.T), {"F(1)": F1}, ("F(1)",))


class OneSampleMore(ThisEnvironment):
    """The condition this-environment for forces that arrive a sample later."""

    name = "one-sample-more"

    def demand(self, loop, coupling, exact=False):
        return super().demand(change(loop, theta=tuple(n + 1 for n in loop.theta)), coupling, exact)

    required = Condition.required


@pytest.mark.parametrize(
    ("own", "shipped"),
    [
        (LatchesLate(), change(PAIR, latency=((TAU, TAU),) * 2)),
        (OneSampleMore(), change(PAIR, theta=(1, 2))),
    ],
)
def test_users_conditions_are_proved_like_shipped_conditions(own, shipped, tmp_path):
    requirement, expected = (
        required_damping(*case) for case in ((PAIR, SOFT, own), (shipped, SOFT, "this-environment"))
    )
    assert requirement.required == pytest.approx(expected.required, rel=1e-8)
    assert requirement.condition == own.name
    stored = Stored.of(PAIR, SOFT, prove(PAIR, SOFT, own))
    save(stored, tmp_path / "own.json")
    stored = load(tmp_path / "own.json")
    assert verify(stored, own).proved
    assert f"condition is '{own.name}'" in verify(stored).reason
    assert "not of 'this-environment'" in verify(stored, THIS_ENVIRONMENT).reason
    forged = change(stored.certificate, matrices={"P": prove(PAIR, SOFT, "this-environment").matrices["P"]})
    assert not verify(change(stored, certificate=sealed(forged)), own).proved
    short = change(PAIR, delta=tuple(0.99 * d for d in requirement.required))
    with pytest.raises(NotProved, match="N s/m"):
        prove(short, SOFT, own)
