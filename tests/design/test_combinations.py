"""Tests of facts that hold together (docs/theory.md): separate figures, proofs, and hands that try to gain energy."""

import functools
import itertools

import msgspec
import numpy as np
import pytest
from scipy.linalg import expm
from shared import block_by_hand, contact_by_hand, least_scaled

from haptic_loop.controller.coupling import NoCoupling, SpringDamper
from haptic_loop.controller.environment import GROUND, Network, Spring, Wall
from haptic_loop.controller.loop import DelayRange, DeviceBounds, Loop
from haptic_loop.controller.ranges import Ranges
from haptic_loop.design.api import design_coupling
from haptic_loop.design.assessment import assess
from haptic_loop.design.certificate import prove, required_damping, verify
from haptic_loop.design.conditions import FACTS
from haptic_loop.design.coupling_file import Stored, sealed
from haptic_loop.design.environments import ANY_ENVIRONMENT, THIS_ENVIRONMENT, LimitedForces
from haptic_loop.design.facts import KnownMotor, Limited, Switching, Walls, compose
from haptic_loop.design.known_device import period_cost
from haptic_loop.design.result import RANGES

change = msgspec.structs.replace
BARE, COUPLING = NoCoupling(), SpringDamper([1000.0], [0.5])


def wall(stiffness, damping):
    return Wall(("tip", GROUND), stiffness, damping)


def held(*walls):
    """Return a mass of 50 g at the tip, held to ground by 20 N/m and 0.3 N s/m, with walls."""
    return Network(("tip",), (Spring(("tip", GROUND), 20.0, 0.3),), {"tip": 0.05}, walls)


def loop_of(network, T=1.2e-3, theta=0, delta=1.0, **further):
    return Loop(T, (theta,), (0,), (0,), (delta,), network, **further)


def need(loop, coupling, rho=None):
    """Return the damping [N s/m] that this-environment requires, with limited forces if rho is given."""
    condition = LimitedForces(held=(rho,)) if rho else THIS_ENVIRONMENT
    return required_damping(loop, coupling, condition).required[0]


@pytest.mark.parametrize(
    ("k", "damping", "theta", "latency", "most"),
    [
        (1000.0, 3.6, 1, (0.0, 0.48e-3), 5.6832),
        (3000.0, 2.4, 0, (0.12e-3, 0.6e-3), 5.3171),
        *(
            pytest.param(1000.0, damping, 0, (0.0, 0.48e-3), most, marks=pytest.mark.validate)
            for damping, most in ((0.0, 1.4213), (3.6, 4.5544))
        ),
    ],
)
def test_latency_and_walls_need_damping_within_bounds(k, damping, theta, latency, most):
    """The requirement is at least 4 % below `most`, which bounds each part of a period alone and has m = 0 for walls.

    A wall that never loses contact needs no more.
    """
    loop = loop_of(Network(("tip",), walls=(wall(k, damping),)), theta=theta, latency=(latency,))
    touched = loop_of(Network(("tip",), (Spring(("tip", GROUND), k, damping),)), theta=theta)
    least = need(change(touched, latency=(latency[1:] * 2,)), BARE)  # with the constant latest latency
    assert least * (1 - 1e-6) < need(loop, BARE) < 0.96 * most


@pytest.mark.parametrize(("theta", "known", "alone"), [(1, 1.2623, 1.2452), (0, 0.99051, 0.99051)])
def test_limiter_and_walls_need_damping_within_bounds(theta, known, alone):
    """The requirement lies between `alone`, without limiter, and `known`, for the walls' multiplier m = 0.

    rho is 0.01/T times the requirement without limiter.
    """
    loop = loop_of(held(wall(3000.0, 2.0)), 1e-3, theta)
    linear = need(loop, COUPLING)
    assert alone * 0.999 < linear <= alone * (1 + 5e-5)
    assert linear * (1 - 1e-6) < need(loop, COUPLING, 0.01 * linear / 1e-3) <= known * (1 + 5e-5)


@pytest.mark.parametrize(
    ("theta", "walls", "known"),
    [
        *((0, (), 0.8172), (1, (1,), 1.3910)),
        *(pytest.param(*each, marks=pytest.mark.validate) for each in ((1, (), 1.3905), (0, (1,), 0.8177))),
    ],
)
def test_limiter_and_latency_need_the_known_damping(theta, walls, known):
    """rho is 13 N/m and the latency 0.3 ms; `known` was computed for the walls' m = 0, which costs at most 2.4e-4."""
    loop = loop_of(held(*(wall(3000.0, 2.0) for _ in walls)), 1e-3, theta, latency=((0.3e-3, 0.3e-3),))
    required = need(loop, COUPLING, 13.0)
    assert known * (1 - 5e-4) < required < known * (1 + 5e-5)


EVERY = {  # fact -> fields that add it to a loop; `combined` reads `walls` and `rho`
    "latency": {"latency": ((0.1e-3, 0.3e-3),)},
    "walls": {"walls": (wall(3000.0, 2.0),)},
    "limiter": {"rho": 13.0},
    "switching": {"varying_delay": DelayRange((0,), (1,))},
}
SETS = [names for count in (2, 3) for names in itertools.combinations(EVERY, count)]
#: `make test` tests two sets, which have each fact once; `make suite` also the set of all facts.
QUICK_SETS = ("latency", "switching"), ("walls", "limiter")
MOST_SETS = pytest.mark.parametrize(
    "names",
    [
        *QUICK_SETS,
        pytest.param(tuple(EVERY), marks=pytest.mark.slow),
        *(pytest.param(names, marks=pytest.mark.validate) for names in SETS if names not in QUICK_SETS),
    ],
    ids="-".join,
)


def combined(names, delta=10.0):
    """Return a loop with these facts of EVERY, and the limiter's rho [N/m], or None without a limiter."""
    fields = {key: value for name in names for key, value in EVERY[name].items()}
    rho, network = fields.pop("rho", None), held(*fields.pop("walls", ()))
    return loop_of(network, 1e-3, 1, delta, **fields), rho


@functools.cache
def least_of(names):
    """Return the damping [N s/m] that a combination of facts requires."""
    loop, rho = combined(names)
    return need(loop, COUPLING, rho)


@MOST_SETS
def test_every_combination_is_proved_stored_and_verified(names):
    """A proof exists at 1.001 of the requirement; at 0.999 the sweep refuses. No multiplier may be missing."""
    loop, rho = combined(names)
    least = least_of(names)
    condition = LimitedForces(held=(rho,)) if rho else THIS_ENVIRONMENT
    enough = change(loop, delta=(1.001 * least,))
    certificate = prove(enough, COUPLING, condition)
    assert (certificate.condition, certificate.facts) == ("this-environment", tuple(f for f in FACTS if f in names))
    stored = Stored.of(enough, COUPLING, certificate)
    assert verify(msgspec.json.decode(msgspec.json.encode(stored), type=Stored)).proved
    for name in certificate.multipliers:
        fewer = {known: values for known, values in certificate.multipliers.items() if known != name}
        assert not verify(change(stored, certificate=sealed(change(certificate, multipliers=fewer)))).proved
    assert not required_damping(change(loop, delta=(0.999 * least,)), COUPLING, condition).certified


def test_limited_walls_agree_with_a_block_by_hand():
    """With the multipliers of the search, the block by hand is positive at 1.001 of the requirement, not at 0.999."""
    loop, rho = combined(("walls", "limiter"))
    needs = required_damping(loop, COUPLING, LimitedForces(held=(rho,)))
    binding = max(2 * np.pi * loop.T * needs.frequency_hz, 1e-3)
    z = np.exp(1j * np.sort(np.append(np.geomspace(1e-3, np.pi, 2000), binding)))
    *of_wall, c = needs.multiplier
    contact = contact_by_hand(z, loop.T, 0.05, 20.0, 0.3, COUPLING)

    def least(share):
        cost = np.full((z.size, 1, 1), share * needs.required[0] / loop.T)
        return least_scaled(block_by_hand(z, loop.T, 1, contact, cost, wall=(3000.0, 2.0, *of_wall), limiter=(rho, c)))

    assert least(1.001) > 0 > least(0.999)


HANDS, TICKS = 60, 12000


def growing(loop, coupling, damping, rho, limit=3.0, seed=5, ticks=TICKS):
    """Return how many lossless hands gain 2 % of energy from the middle to the end.

    Each tick tries the forces of all ages at both ends of the latency and of the periods T to T_max. Each hand gets the
    force that gives it most energy. If a hand reaches 1e6 J, the run ends, and hands above 1 J count.
    """
    rng = np.random.default_rng(seed)
    mass, stiff = 10 ** rng.uniform(-3, 0, HANDS), 10 ** rng.uniform(0, 3.5, HANDS)
    A = np.zeros((HANDS, 3, 3))
    A[:, 0, 1] = 1
    A[:, 1, 0], A[:, 1, 1], A[:, 1, 2] = -stiff / mass, -damping / mass, -1 / mass
    late = sorted(set(loop.latency[0])) if loop.latency else [0.0]
    ends = [*itertools.product(sorted({loop.T, loop.T_max or loop.T}), late)]
    parts = [(expm(A * (period - tau))[:, :2], expm(A * tau)[:, :2]) for period, tau in ends]
    # (ends, 2, 4, hands): map from the plant, the last force and the new force to the plant after a period
    step = np.stack([np.concatenate([second[..., :2] @ first, second[..., 2:]], axis=2) for second, first in parts])
    step = np.ascontiguousarray(np.moveaxis(step, 1, -1))
    bound = {} if rho is None else {"limit": [limit], "rho": [rho]}
    lo, hi = loop.delays.lo[0], loop.delays.hi[0]
    law = loop.switching(None).delayed((0,)).law(coupling, **bound)
    tick = law.transition()
    plant = rng.standard_normal((HANDS, 2)).T * [[1e-2], [0.1]]
    before, after = np.zeros((2, law.open.order + 1, HANDS))
    forces, applied, energy = [np.zeros(HANDS)] * (hi + 1), np.zeros(HANDS), np.zeros((2, HANDS))
    every = np.arange(HANDS)
    for k in range(ticks):
        before[-1] = plant[0]
        tick(before, after)
        before[:-1] = after[1:]
        forces = [after[0].copy(), *forces[:-1]]
        held = (step[:, :, :3] * [*plant, applied]).sum(axis=2)
        acting = np.repeat(forces[lo:], len(ends), axis=0)  # one row per age, period and latency
        now = np.tile(held, (hi + 1 - lo, 1, 1)) + np.tile(step[:, :, 3], (hi + 1 - lo, 1, 1)) * acting[:, None]
        gained = (mass * now[:, 1] ** 2 + stiff * now[:, 0] ** 2) / 2
        best = np.argmax(gained, axis=0), every
        most = gained[best]
        if most.max() > 1e6:  # [J]; hands begin with less than 0.5 J
            return int((most > 1.0).sum())
        plant, applied = np.stack([now[:, 0][best], now[:, 1][best]]), acting[best]
        at = 0 if 0.4 * ticks < k < 0.5 * ticks else 1 if k > 0.9 * ticks else None
        if at is not None:
            energy[at] = np.maximum(energy[at], most)
    return int((energy[1] > 1.02 * energy[0]).sum())


@pytest.mark.parametrize("ticks", [TICKS // 8, pytest.param(TICKS // 2, marks=pytest.mark.validate)])
@MOST_SETS
def test_no_hand_gains_energy_at_the_requirement(names, ticks):
    loop, rho = combined(names)
    assert growing(loop, COUPLING, 1.01 * least_of(names), rho, ticks=ticks) == 0


@pytest.mark.parametrize(("share", "some"), [(1.01, False), (0.3, True)])
def test_no_hand_gains_energy_under_worst_timing(share, some):
    """With the worst period, latency and age at every tick no hand gains energy at 1.01 of the requirement.

    At 0.3 of it some hands do.
    """
    loop = change(combined(("latency", "switching"))[0], T_max=1.5e-3)
    assert (growing(loop, COUPLING, share * need(loop, COUPLING), None, ticks=TICKS // 8) > 0) == some


@pytest.mark.parametrize(
    "names", [pytest.param(("walls", "limiter"), marks=pytest.mark.slow), ("latency", "switching")], ids="-".join
)
def test_some_hands_gain_energy_far_below_the_requirement(names):
    loop, rho = combined(names)
    assert growing(loop, COUPLING, 0.5 * least_of(names), rho, ticks=TICKS // 8) > 0


@pytest.mark.validate
@pytest.mark.parametrize("names", [("walls", "limiter"), ("latency", "walls")], ids="-".join)
def test_facts_are_proved_at_every_vertex(names):
    """All vertices share one set of multipliers; no vertex needs more when it is judged alone."""
    loop, rho = combined(names)
    loop = change(loop, ranges=Ranges(masses={"tip": (0.04, 0.06)}))
    least, condition = need(loop, COUPLING, rho), LimitedForces(held=(rho,)) if rho else THIS_ENVIRONMENT
    alone = [need(loop.at(member.network), COUPLING, rho) for member in loop.members()]
    assert max(alone) * (1 - 1e-6) < least < max(alone) * 1.01
    assert all(member.network.walls == loop.environment.walls for member in loop.members())
    enough = change(loop, delta=(1.001 * least,))
    certificate = prove(enough, COUPLING, condition)
    assert certificate.guarantee == RANGES
    assert {name for name in certificate.matrices if name[0] == "P"} == {"P", "P1", "P2"}
    assert verify(Stored.of(enough, COUPLING, certificate)).proved
    stiffer = change(enough, ranges=Ranges(masses={"tip": (0.04, 5.0)}))
    assert not verify(Stored(stiffer, COUPLING.form(), certificate)).proved


@pytest.mark.validate
def test_walls_with_ranges_are_guaranteed_for_ranges():
    """Every vertex is proved, and the search between the vertices uses the multipliers of the proof."""
    network = held(wall(3000.0, 2.0))
    loop = loop_of(network, 1e-3, 1, 1.3, ranges=Ranges(masses={"tip": (0.04, 0.06)}))
    assessment = assess(loop, COUPLING, ranges_samples=2)
    assert assessment.ranges.proved
    assert assessment.holds
    assert assessment.guarantee.environments == RANGES
    assert not assess(change(loop, delta=(1.2,)), COUPLING, ranges_samples=0).holds


# The any-environment condition.

ANYWHERE = SpringDamper([1000.0], [0.1])
LATE, SWITCHED = {"latency": ((0.13e-3, 0.4e-3),)}, {"varying_delay": DelayRange((0,), (1,))}


def anywhere(further, delta=10.0, coupling=ANYWHERE, **network):
    """Return a loop with these fields, and the damping [N s/m] that any-environment requires."""
    loop = loop_of(Network(("tip",), (Spring(("tip", GROUND), 1000.0),), **network), delta=delta, **further)
    return loop, required_damping(loop, coupling, ANY_ENVIRONMENT).required[0]


@pytest.mark.parametrize(
    ("further", "theta", "needs"),
    [
        ({"latency": ((0.13e-3, 0.13e-3),)}, 0, 0.795),  # K (T + 3 tau)/2
        ({"latency": ((0.0, 0.13e-3),)}, 0, 0.795),
        ({"varying_delay": DelayRange((0,), (1,))}, 0, 2.4),  # (hi + 1)^2 K T/2
        ({"varying_delay": DelayRange((0,), (2,))}, 0, 5.4),
        ({"varying_delay": DelayRange((1,), (3,))}, 1, 9.6),
    ],
)
def test_springs_before_any_environment_need_the_closed_form(further, theta, needs):
    loop = loop_of(Network(("tip",), (Spring(("tip", GROUND), 1000.0),)), theta=theta, **further)
    requirement = required_damping(loop, SpringDamper([1000.0], [0.0]), ANY_ENVIRONMENT)
    assert requirement.required[0] == pytest.approx(needs, rel=1e-7)


def test_any_environment_with_latency_meets_its_formula():
    """The least delta has 4 delta He[V/(1-z)] >= tau |1 + .. + z^-(theta+1)|^2 + (T - tau) |1 + .. + z^-theta|^2."""
    tau, theta, T = 0.3e-3, 2, 1.2e-3
    coupling = SpringDamper([900.0], [0.3])
    loop = loop_of(Network(("tip",), (Spring(("tip", GROUND), 1.0),)), T, theta, latency=((tau, tau),))
    w = np.append(1e-5, np.linspace(1e-3, np.pi, 20001))
    z = np.exp(1j * w)
    V = 1 / (900.0 + 0.3 * (1 - 1 / z) / T)
    windows = [abs(sum(z**-k for k in range(n + 1))) ** 2 for n in (theta + 1, theta)]
    needs = ((tau * windows[0] + (T - tau) * windows[1]) / (4 * (V / (1 - z)).real)).max()
    assert required_damping(loop, coupling, ANY_ENVIRONMENT).required[0] == pytest.approx(needs, rel=1e-7)


def test_periods_latency_and_switching_meet_their_formula():
    """He[V/(1-z)] > c* Q^-1 c/4 + h^2/(2 alpha) is tight at the requirement, with h = (hi - lo)/2.

    Q is delta diag(1/tau, 1/(T_max - tau)) - alpha d* d/2 with d = (z, 1). The entries of c are means over n = lo and
    n = hi: of 1 + .. + z^-(n+1), and of 1 + .. + z^-n.
    """
    T, longest, tau, lo, hi = 1e-3, 1.4e-3, 0.3e-3, 0, 2
    further = {"varying_delay": DelayRange((lo,), (hi,)), "latency": ((tau, tau),), "T_max": longest}
    loop = loop_of(Network(("tip",), (Spring(("tip", GROUND), 1.0),)), T, 1, **further)
    requirement = required_damping(loop, SpringDamper([900.0], [0.3]), ANY_ENVIRONMENT)
    (delta,), (alpha,) = requirement.required, requirement.multiplier
    z = np.exp(1j * np.append(np.linspace(1e-4, np.pi, 20001), 2 * np.pi * T * requirement.frequency_hz))
    V = 1 / (900.0 + 0.3 * (1 - 1 / z) / T)
    d = np.stack([z, np.ones_like(z)], axis=1)
    c = np.stack([sum(sum(z**-k for k in range(n + j)) for n in (lo, hi)) / 2 for j in (2, 1)], axis=1)

    def left(scale):
        Q = np.diag([1 / tau, 1 / (longest - tau)]) * scale * delta
        Q = Q - alpha / 2 * np.conj(d)[:, :, None] * d[:, None, :]
        charge = np.einsum("ki,kij,kj->k", np.conj(c), np.linalg.inv(Q), c).real / 4
        assert (np.linalg.eigvalsh(Q) > 0).all()
        return ((V / (1 - z)).real - charge - ((hi - lo) / 2) ** 2 / (2 * alpha)).min()

    assert left(1 + 1e-6) > 0 > left(1 - 1e-6)


@pytest.mark.parametrize("further", [LATE, SWITCHED, LATE | SWITCHED], ids=["latency", "switching", "both"])
def test_any_environment_is_proved_stored_and_verified(further):
    loop, least = anywhere(further)
    enough = change(loop, delta=(1.001 * least,))
    certificate = prove(enough, ANYWHERE, ANY_ENVIRONMENT)
    there = {"latency": "latency", "switching": "varying_delay"}
    assert certificate.facts == tuple(name for name in FACTS if there.get(name) in further)
    stored = Stored.of(enough, ANYWHERE, certificate)
    assert verify(msgspec.json.decode(msgspec.json.encode(stored), type=Stored)).proved
    for name in certificate.multipliers:
        fewer = {known: values for known, values in certificate.multipliers.items() if known != name}
        assert not verify(change(stored, certificate=sealed(change(certificate, multipliers=fewer)))).proved
    assert not required_damping(change(loop, delta=(0.999 * least,)), ANYWHERE, ANY_ENVIRONMENT).certified
    assert "delay in the environment" in ANY_ENVIRONMENT.beyond(change(loop, psi=(1,)))


def lossless(rng):
    """Return a random chain of springs and masses from the tip to the ground."""
    count = int(rng.integers(1, 4))
    nodes = ["tip", *(f"node {i}" for i in range(1, count)), GROUND]
    springs = tuple(Spring(pair, 10 ** rng.uniform(2, 6)) for pair in itertools.pairwise(nodes))
    return Network(("tip",), springs, {node: 10 ** rng.uniform(-4, 0) for node in nodes[:-1] if rng.random() < 0.7})


@pytest.mark.parametrize("count", [1, pytest.param(2, marks=pytest.mark.validate)])
@pytest.mark.parametrize(
    ("limited", "further"),
    [
        pytest.param(limited, further, marks=[] if limited == (further is LATE) else pytest.mark.validate)
        for limited in (True, False)
        for further in (LATE, SWITCHED)
    ],
)
def test_no_hand_gains_energy_before_lossless_environments(further, limited, count):
    """Ages and latencies are the worst ones; the limited loops have a wall and a limiter with rho = 0."""
    rng = np.random.default_rng(11)
    _, least = anywhere(further)
    ticks = 1500 if count == 1 else 4000  # Within 1500 ticks a slow beat of the second network looks like growth.
    for seed in range(count):
        network = change(lossless(rng), walls=(wall(3000.0, 2.0),) if limited else ())
        loop = change(anywhere(further)[0], environment=network)
        assert growing(loop, ANYWHERE, 1.01 * least, 0.0 if limited else None, 0.5, seed, ticks) == 0


@pytest.mark.parametrize("further", [LATE, SWITCHED], ids=["latency", "switching"])
def test_below_the_requirement_some_hands_gain_energy(further):
    loop, least = anywhere(further)
    stiff = change(loop, environment=Network(("tip",), (Spring(("tip", GROUND), 1e6),)))
    assert growing(stiff, ANYWHERE, 0.5 * least, None, ticks=1500) > 0


@pytest.mark.parametrize(("theta", "tau"), [(0, 0.13e-3), (2, 0.5e-3)])
def test_the_stiffest_coupling_attains_the_latency_limit(theta, tau):
    """V(1) = ((theta + 1) T + tau)/(2 delta) is the least compliance of a linear coupling."""
    loop = loop_of(Network(("tip",), (Spring(("tip", GROUND), 1e3),)), theta=theta, latency=((tau, tau),))
    design = design_coupling(loop, "moving-average", "any-environment")
    limit = 2 / ((theta + 1) * 1.2e-3 + tau)
    assert 0.999 * limit < 1 / design.coupling.compliance(1.2e-3).dc()[0, 0] < limit
    assert prove(loop, design.coupling, "any-environment").proof == "rational"


# The block of each hands' side with any facts is the quadratic form of docs/theory.md, in phasors at one frequency.

GRIP, KNOWN = DeviceBounds(0.06, 14500.0, 0.5, 0.5), 6e-5  # bounds of the device, and beta [s]
MULTIPLIERS = {"a": (2000.0,), "a + c": (900.0,), "d": (700.0,), "m": (0.3,), "alpha": (350.0,), "c": (0.4, 0.7)}


def work(first, second):
    """Return the real part of the inner product of two complex vectors."""
    return np.vdot(first, second).real


def of_hands(hands, f, z, x, delta, T):
    """Return the terms of a hands' side, and the displacement dq that f[k] multiplies; x holds the inputs by name.

    T_max is 1.4 ms, and the latency 0.3 ms.
    """
    if hands == "periods":
        return work(f, x["dx"]) + delta / 1.4e-3 * abs(x["dx"]) ** 2, x["dx"]
    if hands == "latency":
        heat = delta * (abs(x["xa"]) ** 2 / 3e-4 + abs(x["xb"]) ** 2 / (1.4e-3 - 3e-4))
        return work(f / z, x["xa"]) + work(f, x["xb"]) + heat, x["xb"] + z * x["xa"]
    dx, v, last = x["dx"], x["v"], z * x["v"]
    c0, c2 = delta - KNOWN**2 * 14500.0**2 / 0.5 / 4, KNOWN * 0.06 - KNOWN**2 * 0.5 / 4
    q = 2 * np.sqrt(c2 / c0) * np.tanh(np.sqrt(c0 / c2) * T / 2)
    mean, dq = (v + last) / 2, dx + KNOWN * (last - v)
    L = c0 * q * abs(mean) ** 2 + c0 * abs(dx - q * mean) ** 2 / (T - q) + c2 * abs(last - v) ** 2 / q
    return work(f, dq) + L, dq


@pytest.mark.parametrize("names", [(), ("walls",), ("switching",), ("limiter",), ("walls", "switching", "limiter")])
@pytest.mark.parametrize("hands", ["periods", "latency", "known"])
def test_every_block_is_the_form_of_the_theory(hands, names):
    rng, T, rho, alpha = np.random.default_rng(1), 1e-3, 13.0, MULTIPLIERS["alpha"][0]
    lo, hi = (0, 2) if "switching" in names else (1, 1)
    more = {"known_devices": (GRIP,)} if hands == "known" else {"T_max": 1.4e-3}
    more |= {"latency": ((3e-4, 3e-4),)} if hands == "latency" else {}
    network = held(wall(3000.0, 2.0)) if "walls" in names else held()
    loop = loop_of(network, T, 1, 1.3, varying_delay=DelayRange((lo,), (hi,)), **more)
    G = loop.walled_before_delay(COUPLING) if "walls" in names else loop.sent(COUPLING)
    facts = {"walls": Walls(), "switching": Switching(), "limiter": Limited((rho,), 2)}
    motor = KnownMotor(period_cost(loop, 1.0, np.array([KNOWN])), np.array([KNOWN])) if hands == "known" else None
    demand = compose(G, loop, [facts[name] for name in names], MULTIPLIERS, hands=motor)
    inputs = {"periods": ["dx"], "latency": ["xa", "xb"], "known": ["dx", "v"]}[hands]
    inputs += ["de"] * ("limiter" in names) + ["u", "s"] * ("walls" in names) + ["w"] * ("switching" in names)
    z = np.exp(1j * rng.uniform(0.05, 3.1))
    y = rng.normal(size=(len(inputs), 2)) @ [1, 1j]
    x = {"de": 0, "u": 0, "s": 0, "w": 0} | dict(zip(inputs, y, strict=True))
    responds = x["dx"] if "dx" in x else x["xa"] + x["xb"]
    x["xb" if hands == "latency" else "dx"] += x["de"]  # The slip is taken off these inputs of the block.
    k, b, u, s = 3000.0, 2.0 / T, x["u"], x["s"]
    W = k + b * (1 - 1 / z)
    dp = W * u + (W - k) * s
    df_e, *dy = G.at(np.array([z]))[0] @ ([responds, dp] if "walls" in names else [responds])
    df_e = df_e - rho * (1 - 1 / z) * x["de"]
    f_e = df_e / (z - 1)
    form, dq = of_hands(hands, (z**-lo + z**-hi) / 2 * f_e, z, x, 1.3, T)
    if "walls" in names:
        (a,), (both,), (d,), (m,) = (MULTIPLIERS[name] for name in ("a", "a + c", "d", "m"))
        dr = dy[0] - u
        form += k * work(u, dr / (z - 1)) - a * work(u, dr) + (both - a) * work(s, dr)
        form += d * work(s, u + s) - m * work(s / z, dp)
    if "limiter" in names:
        M = z + sum(c * sum(z - z**-n for n in range(j)) for j, c in enumerate(MULTIPLIERS["c"], start=1))
        form -= work(M * f_e, x["de"])
    if "switching" in names:
        form += work(x["w"], (hi - lo) * df_e + 2 * alpha * x["w"]) - alpha / 2 * abs(dq) ** 2
    block = (demand.free + demand.gain).at(np.array([z]))[0]
    assert work(y, block @ y) == pytest.approx(form, rel=1e-10)
