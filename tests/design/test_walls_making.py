"""this-environment with walls that make and break contact: the block, each step of its proof, certificates, hands."""

import itertools

import msgspec
import numpy as np
import pytest
from asked import any_environment, this_environment, walls_demand, walls_proof
from haptic_loop.controller.coupling import Compliance, InternalModel, SpringDamper
from haptic_loop.controller.environment import GROUND, Network, Spring, Wall
from haptic_loop.controller.loop import Loop
from haptic_loop.controller.lti import Lti
from haptic_loop.controller.ranges import Ranges
from haptic_loop.design.assessment import assess, check_ranges
from haptic_loop.design.certificate import prove, required_damping, requirements_of, verify
from haptic_loop.design.coupling_file import Stored, sealed
from haptic_loop.design.designs import design_by_kind
from haptic_loop.design.exact import find_storage
from haptic_loop.design.guarantees import MAKING
from haptic_loop.design.result import NotProved
from scipy.linalg import expm

change = msgspec.structs.replace


def held(stiffness, delta=1.3, gap=0.0, theta=1):
    """A mass of 50 g on 20 N/m and 0.3 N s/m at the tip, with a wall."""
    wall = Wall(("tip", GROUND), stiffness, gap=gap)
    network = Network(("tip",), (Spring(("tip", GROUND), 20.0, 0.3),), {"tip": 0.05}, (wall,))
    return Loop(1e-3, (theta,), (0,), (theta,), (delta,), network)


COUPLING = SpringDamper([1000.0], [0.5])

#: Two devices, a mass between them, a wall on either side of it and one at the first contact.
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
#: The same with dampers in two of the walls: b/T is 1667 and 417 N/m.
DAMPED = change(
    PAIR,
    environment=change(
        NETWORK, walls=tuple(change(w, damping=b) for w, b in zip(NETWORK.walls, (2.0, 0.0, 0.5), strict=True))
    ),
)
BOTH = SpringDamper([500.0, 400.0], [0.3, 0.3])


@pytest.mark.parametrize(("stiffness", "g", "needs"), [(3000.0, 0.6, 1.244369), (1e9, 0.3, 1.251404)])
def test_what_a_wall_asks(stiffness, g, needs):
    loop = held(stiffness)
    given = required_damping(loop, COUPLING, "this-environment", [g])
    assert given.required[0] == pytest.approx(needs, abs=1e-6)
    found = required_damping(loop, COUPLING, "this-environment")
    assert needs - 5e-4 < found.required[0] < needs
    each = [this_environment(loop.at(state).F(COUPLING), loop.delta) for state in loop.environment.frozen()]
    assert found.ratio > max(r.ratio for r in each)
    if stiffness == 3000.0:
        assert [r.required[0] for r in each] == pytest.approx([1.244099, 1.242139], abs=1e-6)


def test_the_block_written_out():
    """Against the definition at a few frequencies, for two channels and three walls."""
    G, g, s = PAIR.walled(BOTH), np.array([0.5, 1.5, 2.0]), 0.9
    stiffness = [w.stiffness for w in NETWORK.walls]
    demand = walls_demand(G, PAIR.delta, stiffness, g)
    for w in (0.003, 0.2, 1.0, 3.0):
        z = np.exp(1j * w)
        response = G.at(z)
        F, J, H, Y = response[:2, :2], response[:2, 2:], response[2:, :2], response[2:, 2:]
        M = np.diag(g * (z - 1) - 1)
        D = s * np.diag(PAIR.delta) / PAIR.T
        whole = np.block(
            [[F / (z - 1) + D, J / (z - 1)], [-M @ H / (z - 1), -M @ Y / (z - 1) + np.diag(g / stiffness)]]
        )
        ours = demand.free.at(z) + s * demand.gain.at(z)
        assert (ours + ours.conj().T) == pytest.approx(whole + whole.conj().T, rel=1e-9, abs=1e-9)


def test_without_walls_to_speak_of_it_is_the_plain_condition():
    soft = held(1e-6)
    plain = this_environment(soft.at(change(soft.environment, walls=())).F(COUPLING), soft.delta)
    assert required_damping(soft, COUPLING, "this-environment").required == pytest.approx(plain.required, rel=1e-6)


def steps_of(loop, coupling, damping):
    """The proof's parts: G, the storage P of its block at this damping, the static map, and the multipliers."""
    slopes = [w.slope(loop.T) for w in loop.environment.walls]
    proof = walls_proof(loop.walled(coupling), damping, slopes)
    G = loop.walled(coupling, exact=True)
    demand = walls_demand(G, damping, slopes, proof.multiplier)
    P, reason = find_storage(demand.free + demand.gain)
    assert P is not None, reason
    static = np.array(demand.static["the static map of devices and walls"], dtype=float)
    return G.floats(), P.floats() / 2, static, np.array(proof.multiplier)  # the matrix of (KYP) is twice the balance


def walls_by_hand(loop):
    """Stiffness, damping over T, gap and steepest slope of each wall, (w,) each."""
    walls = loop.environment.walls
    stiff, gap = (np.array([getattr(w, name) for w in walls]) for name in ("stiffness", "gap"))
    b = np.array([w.damping for w in walls]) / loop.T
    return stiff, b, gap, stiff + 2 * b


@pytest.mark.parametrize("loop", [PAIR, DAMPED], ids=["springs", "dampers"])
def test_every_step_of_the_proof(loop):
    """Random motions: the walls' two inequalities, the balance of the storage at every tick, and Z >= 0.

    A wall is (h, e): its depth, and the step that its damper feels, p = K h + (b/T) e, never more than lets p vanish.
    """
    rng = np.random.default_rng(0)
    need = required_damping(loop, BOTH, "this-environment").ratio
    delta = 1.01 * need * np.array(loop.delta)
    G, P, S, g = steps_of(loop, BOTH, delta.tolist())
    stiff, b, gap, slope = walls_by_hand(loop)
    tick, m, w = loop.law(BOTH).transition(), 2, len(stiff)

    def stored(xi, x, p):
        X = np.concatenate([x, p])
        change = G.A @ xi + G.B @ X - xi
        return change @ P @ change + X @ S @ X / 2

    ticks = 800
    x = np.cumsum(rng.standard_normal((ticks + 1, m)) * rng.choice([1e-5, 3e-4], (ticks + 1, 1)), axis=0)
    state, h = np.zeros(G.order + w), np.zeros(w)
    seen, pressed, left = [], 0, 0
    for k in range(ticks + 1):
        before = np.concatenate([state, x[k]])[:, None]
        after = np.zeros((m + G.order + w, 1))
        tick(before, after)
        xi, f, last = state[: G.order], after[:m, 0], h
        h = after[-w:, 0]
        p = np.where(h > 0, np.maximum(0, stiff * h + b * (h - last)), 0)
        output = G.C @ xi + G.D @ np.concatenate([x[k], p])
        assert output[:m] == pytest.approx(f, rel=1e-7, abs=1e-9)
        y = output[m:]
        assert h == pytest.approx(np.maximum(0, y - gap), rel=1e-6, abs=1e-9)
        e = np.where(h > 0, (p - stiff * h) / np.maximum(b, 1e-9), 0) * (b > 0)
        kept, potential = b * e**2 / 2, p * y - stiff * h**2 / 2
        Z = stored(xi, x[k], p) + (g * kept - potential).sum()
        assert Z >= -1e-12
        seen.append((x[k], f, y, p, kept, potential, Z))
        pressed, left = pressed + (p > 0).any(), left + ((p == 0) & (h > 0)).any()
        state = after[m:, 0]
    assert 50 < pressed < ticks
    assert (left > 0) == (loop is DAMPED)  # left faster than its damper lets it follow
    for (x0, f, y, p, kept, potential, Z), (x1, _, y1, p1, kept1, potential1, Z1) in itertools.pairwise(seen):
        dx, dy, dp = x1 - x0, y1 - y, p1 - p
        size = 1e-9 * (abs(Z) + abs(Z1) + 1e-6)
        assert (dp * (dy - dp / slope) - (kept1 - kept)).min() >= -size
        assert (potential1 - potential - y * dp).min() >= -size
        assert f @ dx + dx @ (delta / loop.T * dx) >= Z1 - Z - size


@pytest.mark.parametrize("loop", [PAIR, DAMPED], ids=["springs", "dampers"])
def test_frozen_motions_fall_to_a_nonnegative_value(loop):
    """The step that bounds Z from below: x held, pressed walls kept as spring-dampers; from any state whatever."""
    rng = np.random.default_rng(5)
    delta = (1.01 * required_damping(loop, BOTH, "this-environment").ratio * np.array(loop.delta)).tolist()
    G, P, S, g = steps_of(loop, BOTH, delta)
    stiff, damped, gap, _ = walls_by_hand(loop)
    for _trial in range(6):
        on = rng.random(3) < 0.6
        share = np.where(on, rng.uniform(0.05, 1, 3), 0.0)  # any slope up to the wall's
        k, b = share * stiff, share * damped
        solve = np.linalg.inv(np.eye(3) - (k + b)[:, None] * G.D[2:, 2:])
        x, xi, last_h = (
            1e-3 * rng.standard_normal(2),
            1e-3 * rng.standard_normal(G.order),
            1e-4 * rng.standard_normal(3),
        )
        last = np.inf
        for _ in range(6000):
            p = solve @ ((k + b) * (G.C[2:] @ xi + G.D[2:, :2] @ x - gap) - b * last_h)
            X = np.concatenate([x, p])
            y, after = G.C[2:] @ xi + G.D[2:] @ X, G.A @ xi + G.B @ X
            h = y - gap
            potential = (p * y - k * h**2 / 2 - g * b * (h - last_h) ** 2 / 2)[on].sum()
            Z = (after - xi) @ P @ (after - xi) + X @ S @ X / 2 - potential
            assert last - Z >= -1e-9 * (abs(Z) + 1e-9)
            last, xi, last_h = Z, after, h
        limit = x @ S[:2, :2] @ x / 2 - p @ S[2:, 2:] @ p / 2 + (p[on] ** 2 / (2 * k[on])).sum()
        assert (p[on] / k[on] + gap[on]) == pytest.approx((G.dc()[2:] @ X)[on], rel=1e-3, abs=1e-7)
        assert last == pytest.approx(limit, rel=1e-3, abs=1e-9)  # every frozen motion has come to rest
        assert limit >= 0


@pytest.mark.parametrize(("loop", "coupling"), [(held(3000.0), COUPLING), (PAIR, BOTH), (DAMPED, BOTH)])
def test_it_is_proved_stored_and_verified(loop, coupling):
    stored = Stored.of(loop, coupling, prove(loop, coupling, "this-environment"))
    assert set(stored.certificate.matrices) == {"P", "g"}
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
    matrices = stored.certificate.matrices
    forged = sealed(change(stored.certificate, matrices=matrices | {"g": (("0",) * len(matrices["g"][0]),)}))
    assert not verify(change(stored, certificate=forged)).proved
    lost = sealed(change(stored.certificate, matrices={"P": matrices["P"]}))
    assert not verify(change(stored, certificate=lost)).proved


def test_longer_periods_scale_it():
    loop = change(held(3000.0), T_max=1.5e-3)
    assert required_damping(loop, COUPLING, "this-environment", [0.6]).required[0] == pytest.approx(
        1.5 * 1.244369, rel=1e-6
    )


def test_what_is_not_covered_is_said():
    loop = held(3000.0)
    ranged = change(loop, ranges=Ranges(masses={"tip": (0.04, 0.06)}))
    assert check_ranges(ranged, COUPLING) is None
    assert not assess(ranged, COUPLING).holds
    with pytest.raises(NotProved, match="walls are proved in one environment"):
        prove(ranged, COUPLING, "this-environment")
    with pytest.raises(NotProved, match="linear model of the environment"):
        prove(loop, InternalModel(np.zeros(1), np.zeros((2, 1, 1))), "this-environment")
    one_way = Compliance(Lti.constant([[1e-3, 5e-4], [0.0, 1e-3]], PAIR.T))
    assert "not symmetric" in required_damping(PAIR, one_way, "this-environment").reason
    judged = requirements_of(pressed_at_rest(), SpringDamper([1300.0], [0.45]))
    assert not judged["any-environment"].certified
    assert assess(pressed_at_rest(), SpringDamper([1300.0], [0.45])).guarantee.environments == MAKING


def test_couplings_may_be_stiffer_than_any_environment_allows():
    """The one wall of 3000 N/m, without its damper: 1150 N/m and more, where any-environment ends at 1050."""
    loop = Loop(1e-3, (1,), (0,), (1,), (1.37,), Network(("tip",), walls=(Wall(("tip", GROUND), 3000.0, gap=0.005),)))
    coupling = SpringDamper([1300.0], [0.45])
    assert any_environment(coupling.compliance(loop.T), loop.theta, loop.delta).ratio > 1.2
    assert prove(loop, coupling, "this-environment").guarantee == "this environment"


# Hands on a wall that is made and left, simulated exactly.


HANDS, TICKS = 60, 20000


def pressed_at_rest(damping=0.0):
    """One wall of 3000 N/m alone, 2 mm into the way of the tip at rest."""
    network = Network(("tip",), walls=(Wall(("tip", GROUND), 3000.0, damping, gap=-0.002),))
    return Loop(1e-3, (1,), (0,), (1,), (1.37,), network)


def swinging(loop, coupling, damping, seed=11):
    """The largest speed [m/s] of the lossless hands in the end, and how often the wall was made by them all."""
    rng = np.random.default_rng(seed)
    mass, stiff = 10 ** rng.uniform(-3, 0, HANDS), 10 ** rng.uniform(0, 3, HANDS)
    A = np.zeros((HANDS, 3, 3))
    A[:, 0, 1] = 1
    A[:, 1, 0], A[:, 1, 1], A[:, 1, 2] = -stiff / mass, -damping / mass, -1 / mass
    step, tick = expm(A * loop.T), loop.law(coupling).transition()
    plant = rng.standard_normal((HANDS, 2)) * (1e-2, 0.1)
    before, after = np.zeros((2, loop.walled(coupling).order + 2, HANDS))
    made, touching, fastest = 0, np.zeros(HANDS, dtype=bool), 0.0
    for k in range(TICKS):
        before[-1] = plant[:, 0]
        tick(before, after)
        before[:-1] = after[1:]
        plant = (step @ np.column_stack([plant, after[0]])[..., None])[:, :2, 0]
        now = after[-1] > 0
        made, touching = made + int((now & ~touching).sum()), now
        if k > 0.98 * TICKS:
            fastest = max(fastest, float(np.abs(plant[:, 1]).max()))
    return fastest, made


@pytest.mark.parametrize(("damping", "short"), [(0.0, 0.8), (2.0, 0.55)])
def test_hands_come_to_rest_at_the_requirement_and_some_swing_below(damping, short):
    loop, coupling = pressed_at_rest(damping), SpringDamper([1300.0], [0.45])
    need = required_damping(loop, coupling, "this-environment").required[0]
    fastest, made = swinging(loop, coupling, 1.02 * need)
    assert made > (300 if damping else 500)
    assert fastest < 0.02  # and falling: 60 hands, the slowest of them heavy
    assert swinging(loop, coupling, short * need)[0] > 0.5  # for ever, the wall made and left


def test_a_design_before_a_wall_with_a_damper_spends_the_damping_and_is_proved():
    """Stiffer than any passive environment allows, and softer than what every frozen state alone allows (1772 N/m)."""
    wall = Wall(("tip", GROUND), 3000.0, 2.0, 0.005)
    loop = Loop(1e-3, (1,), (0,), (1,), (1.37,), Network(("tip",), walls=(wall,)))
    made = design_by_kind(loop, condition="this-environment")
    assert 0.99 < made.requirement.ratio < 1
    assert 1100 < made.coupling.K[0] < 1300
    assert prove(loop, made.coupling, "this-environment").proof == "rational"
    assert not any_environment(made.coupling.compliance(loop.T), loop.theta, loop.delta).certified
