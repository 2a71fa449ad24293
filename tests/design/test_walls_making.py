"""Tests of this-environment with walls that make and break contact: block, proof step by step, certificates, hands."""

import itertools
from functools import cache

import msgspec
import numpy as np
import pytest
from evaluate import any_environment, this_environment
from scipy.linalg import expm
from shared import walled

from haptic_loop.controller.coupling import Compliance, ForceFilter, NoCoupling, SpringDamper
from haptic_loop.controller.environment import GROUND, Network, Spring, Wall
from haptic_loop.controller.loop import Loop
from haptic_loop.controller.lti import Lti
from haptic_loop.design.assessment import assess
from haptic_loop.design.certificate import prove, required_damping, requirements_of, verify
from haptic_loop.design.coupling_file import Stored, sealed
from haptic_loop.design.designs import design_by_kind
from haptic_loop.design.environments import THIS_ENVIRONMENT
from haptic_loop.design.exact import find_storage
from haptic_loop.design.result import HERE, MAKING, NotProved

change = msgspec.structs.replace


def held(stiffness, delta=1.3, gap=0.0, theta=1):
    """Return a loop with a mass of 50 g on 20 N/m and 0.3 N s/m at the tip, and a wall."""
    wall = Wall(("tip", GROUND), stiffness, gap=gap)
    network = Network(("tip",), (Spring(("tip", GROUND), 20.0, 0.3),), {"tip": 0.05}, (wall,))
    return Loop(1e-3, (theta,), (0,), (theta,), (delta,), network)


COUPLING = SpringDamper([1000.0], [0.5])

#: Two devices, a mass between them, a wall on either side of the mass and one at the first contact.
NETWORK = Network(
    ("a", "b"),
    (Spring(("a", "mass"), 200.0, 0.3), Spring(("mass", "b"), 150.0, 0.2)),
    {"mass": 0.2},
    (
        Wall(("mass", GROUND), 2000.0, gap=0.002),
        Wall((GROUND, "mass"), 900.0, gap=0.001),
        Wall(("a", GROUND), 500.0, gap=-1e-4),
    ),
)
PAIR = Loop(1.2e-3, (1, 2), (0, 0), (1, 2), (1.37, 1.37), NETWORK)
#: PAIR with dampers in two of its walls: damping/T is 1667 and 417 N/m.
DAMPED = change(
    PAIR,
    environment=change(
        NETWORK, walls=tuple(change(w, damping=b) for w, b in zip(NETWORK.walls, (2.0, 0.0, 0.5), strict=True))
    ),
)
BOTH = SpringDamper([500.0, 400.0], [0.3, 0.3])


T = 1e-3


def bare(stiffness, damping, theta, delta=1.0):
    """Return a loop with a wall on the device itself."""
    network = Network(("tip",), walls=(Wall(("tip", GROUND), stiffness, damping),))
    return Loop(T, (theta,), (0,), (theta,), (delta,), network)


@pytest.mark.parametrize(
    ("stiffness", "damping", "needs"),
    [
        (3000.0, 2.0, (3.5, 4.22206, 5.79736)),
        (3000.0, 0.0, (1.5, 4.5, 7.5)),  # (theta + 1/2) k T
        pytest.param(3000.0, 0.5, (2.0, 4.0, 7.0), marks=pytest.mark.validate),
        pytest.param(1000.0, 5.0, (5.5, 5.5455, 5.6358), marks=pytest.mark.slow),
    ],
)
def test_bare_walls_need_the_known_damping(stiffness, damping, needs):
    """The requirement equals the figures of a separate computation, and the frozen contact needs no more."""
    for theta, need in enumerate(needs):
        loop = bare(stiffness, damping, theta)
        requirement = required_damping(loop, NoCoupling(), "this-environment")
        assert requirement.required[0] == pytest.approx(need, rel=5e-5)  # the search's gap to its bound
        assert requirement.bound == pytest.approx(requirement.ratio, rel=5e-5)
        touching = this_environment(loop.at(loop.environment.frozen()[-1]).F(NoCoupling()), loop.delta)
        assert touching.required[0] <= requirement.required[0] * (1 + 1e-9)


@pytest.mark.parametrize(
    ("damping", "needs"), [(0.0, (1.0, 1.6764, 2.4319)), (2.0, (1.6154, 1.8630, 2.3639))], ids=["spring", "damped"]
)
def test_walls_behind_a_coupling_need_the_known_damping(damping, needs):
    """A wall of 3000 N/m is behind a coupling of 2000 N/m and 2 N s/m. Forces are delayed by 0, 1 and 2 samples."""
    for theta, need in enumerate(needs):
        requirement = required_damping(bare(3000.0, damping, theta), SpringDamper([2000.0], [2.0]), "this-environment")
        assert requirement.required[0] == pytest.approx(need, abs=6e-5)


def test_without_m_the_requirement_has_closed_forms():
    """With m = 0 the least need is (k/2 + b) T at theta = 0, (k/2 + b + k^2/(4 b)) T at 1, and 7.5 N s/m at 2.

    The other multipliers are the best ones of each theta.
    """
    k, damping = 3000.0, 2.0
    b = damping / T
    for theta, need in ((0, (k / 2 + b) * T), (1, (k / 2 + b + k**2 / (4 * b)) * T), (2, 7.5)):
        loop = bare(k, damping, theta)
        values = {0: (b, 2 * b, b, 0.0), 1: (b, 2 * b, b, 0.0), 2: (2 * k - 1207.44, 2 * k, b, 0.0)}[theta]
        requirement = required_damping(loop, NoCoupling(), "this-environment", values)
        assert requirement.required[0] == pytest.approx(need, rel=1e-9)


def test_the_block_equals_its_definition():
    """The block equals (f) of docs/theory.md at four frequencies, for two channels and three walls."""
    G, s = walled(DAMPED, BOTH), 0.9
    k, b, _, _ = walls_by_hand(DAMPED)
    a, both, d, m = np.array([900.0, 500.0, 200.0]), np.array([700.0, 0, 900.0]), np.array([50.0, 0, 80]), [0.3, 0, 0.7]
    demand = THIS_ENVIRONMENT.block(DAMPED.walled_before_delay(BOTH), DAMPED, (*a, *both, *d, *m))
    c, damped = both - a, [0, 2]
    for w in (0.003, 0.2, 1.0, 3.0):
        z = np.exp(1j * w)
        response = G.at(z)
        F, J, H, Y = response[:2, :2], response[:2, 2:], response[2:, :2], response[2:, 2:]
        W, one = np.diag(k + b * (1 - 1 / z)), np.eye(3)
        D = np.hstack([H, Y @ W - one, Y @ (W - np.diag(k))])
        pull = np.diag(m * ((k + b) / z - b))
        rows = [
            np.hstack([F / (z - 1) + s * np.diag(DAMPED.delta) / DAMPED.T, J @ W / (z - 1), J @ np.diag(b) / z]),
            np.diag(k / (z - 1) - a) @ D - np.hstack([np.zeros((3, 5)), pull]),
            np.diag(c) @ D + np.hstack([np.zeros((3, 2)), np.diag(d), np.diag(d + m * b * (1 - 1 / z))]),
        ]
        order = [0, 1, 2, 5, 3, 4, 7]  # The block orders its inputs by wall: u, then s if it has a damper.
        expected = np.vstack(rows)[np.ix_(order, order)]
        ours = demand.free.at(z) + s * demand.gain.at(z)
        assert damped == [0, 2]
        assert (ours + ours.conj().T) == pytest.approx(expected + expected.conj().T, rel=1e-9, abs=1e-6)


def test_vanishing_walls_give_the_plain_condition():
    soft = held(1e-6)
    plain = this_environment(soft.at(change(soft.environment, walls=())).F(COUPLING), soft.delta)
    assert required_damping(soft, COUPLING, "this-environment").required == pytest.approx(plain.required, rel=1e-6)


def walls_by_hand(loop):
    """Return the walls' stiffness k, b = damping/T, gap and largest slope k + 2 b, shape (w,) each."""
    walls = loop.environment.walls
    stiff, gap = (np.array([getattr(w, name) for w in walls]) for name in ("stiffness", "gap"))
    b = np.array([w.damping for w in walls]) / loop.T
    return stiff, b, gap, stiff + 2 * b


def test_six_facts_hold_at_every_transition():
    """The facts hold on random paths into random walls: touched, left faster than they relax, and touched again."""
    rng = np.random.default_rng(0)
    n = 50_000
    k, b = 10 ** rng.uniform(1, 4, n), 10 ** rng.uniform(1, 4, n) * (rng.random(n) < 0.8)
    size = 10 ** rng.uniform(-5, -2, n)
    y = rng.normal(size=(4, n)) * size
    h, p = np.zeros((4, n)), np.zeros((4, n))
    for j in range(1, 4):  # This is the wall's law, from rest off the wall.
        h[j] = np.maximum(0, y[j])
        p[j] = np.where(h[j] > 0, np.maximum(0, k * h[j] + b * (h[j] - h[j - 1])), 0)
    e = np.where(h > 0, (p - k * h) / np.maximum(b, 1e-300), 0) * (b > 0)
    u, r = np.diff(h, axis=0), y - h
    s = np.where(b > 0, e[1:] - u, 0) * 1.0
    s = np.where((b > 0) & (h[1:] == 0), -u, s)  # e is zero where the wall is not touched
    dr, dp = np.diff(r, axis=0)[1:], np.diff(p, axis=0)[1:]
    before, now, u = s[:-1], s[1:], u[1:]
    scale = 1e-12 * size**2
    assert (now > 1e-9 * size).mean() > 0.05
    assert (np.abs(dp - ((k + b) * u + b * now - b * e[1:-1])) <= 1e-9 * (k + b) * size).all()
    assert (now >= -1e-12 * size).all()
    for fact in (
        np.where(True, -u * r[1:-1], 0) - h[2:] * dr,  # (1), with equality
        h[2:] * dr - (-u * r[1:-1]),
        h[2:] * dr,
        u * dr,
        -now * dr,
        (u + now) * dr,
        -now * (u + now),
    ):
        assert (fact >= -scale * 1e3).all()
    assert (before * dp >= -scale * 1e3 * (k + b)).all()


@cache
def steps_of(damped):
    """Return 1.01 of the required damping, the map G, the block, half its storage P, the residue S on (x, h), and m."""
    loop = DAMPED if damped else PAIR
    need = required_damping(loop, BOTH, "this-environment")
    delta = 1.01 * need.ratio * np.array(loop.delta)
    demand = THIS_ENVIRONMENT.block(
        loop.walled_before_delay(BOTH, exact=True), change(loop, delta=tuple(delta.tolist())), need.multiplier
    )
    block = demand.free + demand.gain
    P, reason = find_storage(block)
    assert P is not None, reason
    G, m = walled(loop, BOTH), loop.channels
    k = np.array([w.stiffness for w in loop.environment.walls])
    S1 = G.dc()
    S = np.block([[S1[:m, :m], S1[:m, m:] * k], [k[:, None] * S1[m:, :m], k[:, None] * S1[m:, m:] * k - np.diag(k)]])
    m_ = np.array(need.multiplier).reshape(4, -1)[3]
    return delta, G, block.floats(), P.floats() / 2, S, m_  # P stores twice the balance of Z.


class Walled:
    """A loop with walls that runs the controller's law tick by tick and holds the block's input v and state xi."""

    def __init__(self, loop, coupling, block):
        self.loop, self.block, self.m = loop, block, loop.channels
        self.G = walled(loop, coupling)
        self.k, self.b, self.gap, _ = walls_by_hand(loop)
        self.tick, self.state = loop.law(coupling).transition(), np.zeros(self.G.order + len(self.k))
        self.h, self.e, self.s, self.x = (np.zeros(n) for n in (*(len(self.k),) * 3, self.m))
        self.xi = np.zeros(block.order)

    def step(self, x):
        """Return (f, y, p) at this tick. Update the depth h, the damper's step e, s, and the block's input v."""
        before, after = np.concatenate([self.state, x])[:, None], np.zeros((self.m + len(self.state), 1))
        self.tick(before, after)
        xi, f, last = self.state[: self.G.order], after[: self.m, 0], self.h
        h = after[-len(self.k) :, 0]
        p = np.where(h > 0, np.maximum(0, self.k * h + self.b * (h - last)), 0)
        output = self.G.C @ xi + self.G.D @ np.concatenate([x, p])
        assert output[: self.m] == pytest.approx(f, rel=1e-7, abs=1e-9)
        e = np.where(h > 0, (p - self.k * h) / np.maximum(self.b, 1e-9), 0) * (self.b > 0)
        u = h - last
        s = np.where(self.b > 0, e - u, 0)
        parts = zip(u, s, self.b, strict=True)
        self.v = np.array([*(x - self.x), *(value for one, two, b in parts for value in ((one, two) if b else (one,)))])
        self.state, self.h, self.e, self.s, self.x = after[self.m :, 0], h, e, s, np.array(x)
        return f, output[self.m :], p


@pytest.mark.slow
@pytest.mark.parametrize("damped", [False, True], ids=["springs", "dampers"])
def test_the_balance_of_z_holds_at_ticks(damped):
    """On random motions of the running law the balance of the storage Z holds at every tick; Z >= min(0, first Z)."""
    rng, loop = np.random.default_rng(0), DAMPED if damped else PAIR
    delta, _, block, P, S, m_ = steps_of(damped)
    there, ticks = Walled(loop, BOTH, block), 800
    x = np.cumsum(rng.standard_normal((ticks + 1, 2)) * rng.choice([1e-5, 3e-4], (ticks + 1, 1)), axis=0)
    ticked, pressed, left = [], 0, 0
    for k in range(ticks + 1):
        f, _, p = there.step(x[k])
        there.xi = block.A @ there.xi + block.B @ there.v  # The first input is the step from rest.
        X = np.concatenate([x[k], there.h])
        Z = there.xi @ P @ there.xi + X @ S @ X / 2 - (there.k * there.gap * there.h).sum()
        Z -= (m_ * there.b * there.s * there.e).sum()
        ticked.append((x[k], f, Z))
        pressed, left = pressed + (p > 0).any(), left + ((p == 0) & (there.h > 0)).any()
    start = ticked[0][2]
    assert 50 < pressed < ticks
    assert (left > 0) == damped  # Only with dampers is p = 0 at h > 0.
    for (x0, f, Z), (x1, _, Z1) in itertools.pairwise(ticked):
        dx = x1 - x0
        size = 1e-9 * (abs(Z) + abs(Z1) + 1e-6)
        assert f @ dx + dx @ (delta / loop.T * dx) >= Z1 - Z - size
        assert min(start, 0) - 1e-12 <= Z1


@pytest.mark.parametrize(
    ("loop", "coupling"),
    [
        (held(3000.0), COUPLING),
        pytest.param(PAIR, BOTH, marks=pytest.mark.slow),
        pytest.param(DAMPED, BOTH, marks=pytest.mark.validate),
    ],
)
def test_walls_are_proved_stored_and_verified(loop, coupling):
    stored = Stored.of(loop, coupling, prove(loop, coupling, "this-environment"))
    assert set(stored.certificate.multipliers) == {"a", "a + c", "d", "m"}
    assert stored.certificate.facts == ("walls",)
    again = msgspec.json.decode(msgspec.json.encode(stored), type=Stored)
    assert verify(again).proved
    judged = requirements_of(loop, coupling)["this-environment"]
    assert judged.proof == "rational"
    required = np.array(judged.required)
    for factor, proved in ((1.001, True), (0.999, False)):
        one = change(loop, delta=tuple((factor * required).tolist()))
        if proved:
            prove(one, coupling, "this-environment")
        else:
            with pytest.raises(NotProved):
                prove(one, coupling, "this-environment")
    known = stored.certificate.multipliers
    for wrong in (known | {"a": (0.0,) * len(known["a"])}, {}, {name: v for name, v in known.items() if name != "m"}):
        forged = sealed(change(stored.certificate, multipliers=wrong))
        assert not verify(change(stored, certificate=forged)).proved


def test_longer_periods_scale_wall_requirements():
    loop, longer = held(3000.0), change(held(3000.0), T_max=1.5e-3)
    requirement = required_damping(loop, COUPLING, "this-environment")
    assert required_damping(longer, COUPLING, "this-environment", requirement.multiplier).required[0] == pytest.approx(
        1.5 * requirement.required[0], rel=1e-6
    )


def test_uncovered_wall_couplings_are_refused():
    loop = held(3000.0)
    with pytest.raises(NotProved, match=r"linear environment.*walls"):
        prove(loop, ForceFilter((), (), [[[1.0]]]), "this-environment")
    one_way = Compliance(Lti.constant([[1e-3, 5e-4], [0.0, 1e-3]], PAIR.T))
    assert "not symmetric" in required_damping(PAIR, one_way, "this-environment").reason
    judged = requirements_of(pressed_at_rest(), SpringDamper([1300.0], [0.45]))
    assert not judged["any-environment"].certified
    assert assess(pressed_at_rest(), SpringDamper([1300.0], [0.45])).guarantee.environments == MAKING


def test_couplings_may_be_stiffer_than_any_environment_allows():
    """At a wall of 3000 N/m a coupling of 1300 N/m is proved; any-environment needs over 1.2 times the damping."""
    loop = Loop(1e-3, (1,), (0,), (1,), (1.37,), Network(("tip",), walls=(Wall(("tip", GROUND), 3000.0, gap=0.005),)))
    coupling = SpringDamper([1300.0], [0.45])
    assert any_environment(coupling.compliance(loop.T), loop.theta, loop.delta).ratio > 1.2
    assert prove(loop, coupling, "this-environment").guarantee == HERE


# Hands that touch and leave a wall, simulated exactly.


HANDS = 60


def pressed_at_rest(damping=0.0):
    """Return a loop with one wall of 3000 N/m, into which the tip at rest reaches 2 mm."""
    network = Network(("tip",), walls=(Wall(("tip", GROUND), 3000.0, damping, gap=-0.002),))
    return Loop(1e-3, (1,), (0,), (1,), (1.37,), network)


def swinging(loop, coupling, damping, ticks, seed=11):
    """Return the largest speed [m/s] of lossless hands in the last 2 % of the ticks, and how often contact was made."""
    rng = np.random.default_rng(seed)
    mass, stiff = 10 ** rng.uniform(-3, 0, HANDS), 10 ** rng.uniform(0, 3, HANDS)
    A = np.zeros((HANDS, 3, 3))
    A[:, 0, 1] = 1
    A[:, 1, 0], A[:, 1, 1], A[:, 1, 2] = -stiff / mass, -damping / mass, -1 / mass
    step, tick = np.ascontiguousarray(np.moveaxis(expm(A * loop.T)[:, :2], 0, 2)), loop.law(coupling).transition()
    plant = rng.standard_normal((HANDS, 2)).T * [[1e-2], [0.1]]
    before, after = np.zeros((2, walled(loop, coupling).order + 2, HANDS))
    contacts, touching, fastest = 0, np.zeros(HANDS, dtype=bool), 0.0
    for k in range(ticks):
        before[-1] = plant[0]
        tick(before, after)
        before[:-1] = after[1:]
        plant = (step * [*plant, after[0]]).sum(axis=1)
        now = after[-1] > 0
        contacts, touching = contacts + int((now & ~touching).sum()), now
        if k > 0.98 * ticks:
            fastest = max(fastest, float(np.abs(plant[1]).max()))
    return fastest, contacts


@pytest.mark.slow
@pytest.mark.parametrize(("damping", "short"), [pytest.param(0.0, 0.8, marks=pytest.mark.validate), (2.0, 0.55)])
def test_hands_rest_at_the_requirement_not_below(damping, short):
    loop, coupling = pressed_at_rest(damping), SpringDamper([1300.0], [0.45])
    need = required_damping(loop, coupling, "this-environment").required[0]
    ticks = 12_000 if damping else 20_000
    fastest, contacts = swinging(loop, coupling, 1.02 * need, ticks)
    assert contacts > (300 if damping else 500)
    assert fastest < 0.05  # Heavy hands come to rest last.
    assert swinging(loop, coupling, short * need, ticks // 3)[0] > 0.5  # These hands never rest.


@pytest.mark.slow
def test_damped_wall_designs_are_tight_and_proved():
    """The design is stiffer than any-environment allows, and softer than all frozen states alone allow (1772 N/m)."""
    wall = Wall(("tip", GROUND), 3000.0, 2.0, 0.005)
    loop = Loop(1e-3, (1,), (0,), (1,), (1.37,), Network(("tip",), walls=(wall,)))
    design = design_by_kind(loop, condition="this-environment")
    assert 0.99 < design.requirement.ratio < 1
    assert 1500 < design.coupling.K[0] < 1772
    assert prove(loop, design.coupling, "this-environment").proof == "rational"
    assert not any_environment(design.coupling.compliance(loop.T), loop.theta, loop.delta).certified


@pytest.mark.slow
@pytest.mark.parametrize("damped", [pytest.param(False, marks=pytest.mark.validate), True], ids=["springs", "dampers"])
def test_storage_of_frozen_walls_falls_to_nonnegative_values(damped):
    """With x held and the touched walls kept, even if they pull, the storage Z of a state falls to a value >= 0."""
    rng = np.random.default_rng(5)
    _, G, block, P, S, _ = steps_of(damped)
    there, frozen = Walled(DAMPED if damped else PAIR, BOTH, block), 0
    k, b, gap, m = there.k, there.b, there.gap, 2
    x = np.cumsum(rng.standard_normal((240, m)) * rng.choice([1e-5, 3e-4], (240, 1)), axis=0)
    ends = [block.order, block.order + G.order]

    def after(values, one=0.0):
        """Return xi, the state of G and the depths h a tick later; with one = 0 without x and the gaps."""
        xi, state, h = np.split(values, ends)
        here, gaps = one * x[tick], one * gap
        free = G.C[m:] @ state + G.D[m:, :m] @ here  # This is y without the walls' forces at this tick.
        p = solve @ np.where(on, (k + b) * (free - gaps) - b * h, 0)
        then = np.where(on, free + G.D[m:, m:] @ p - gaps, 0)
        steps = zip(then - h, b, strict=True)
        v = np.array([0.0, 0.0, *(value for u, damper in steps for value in ((u, 0.0) if damper else (u,)))])
        return np.concatenate([block.A @ xi + block.B @ v, G.A @ state + G.B @ np.concatenate([here, p]), then])

    for tick in range(240):
        there.step(x[tick])
        there.xi = block.A @ there.xi + block.B @ there.v
        if tick % 80 != 79 or (there.s > 1e-12).any():
            continue
        on, frozen = there.h > 0, frozen + 1
        solve = np.linalg.inv(np.eye(3) - np.where(on, k + b, 0)[:, None] * G.D[m:, m:])
        path = [np.concatenate([there.xi, there.state[: G.order], there.h])]
        linear, constant = np.array([after(unit) for unit in np.eye(path[0].size)]).T, after(0 * path[0], 1.0)
        for _ in range(3000):
            path.append(linear @ path[-1] + constant)
        xi, _, h = np.split(np.array(path), ends, axis=1)
        X = np.hstack([np.broadcast_to(x[tick], (len(h), m)), h])
        Z = (xi @ P * xi).sum(axis=1) + (X @ S * X).sum(axis=1) / 2 - h @ (k * gap)
        assert (np.diff(Z) <= 1e-9 * (np.abs(Z[1:]) + 1e-9)).all()
        assert Z[-1] >= -1e-12
        assert np.abs(h[-1] - h[-2]).max() < 1e-6 * (np.abs(h[-1]).max() + 1e-9)  # the frozen motion has come to rest
    assert frozen > 1
