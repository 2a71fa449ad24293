"""Energy budgets bound the energy of hands, and limit no force in loops that any-environment certifies."""

from itertools import product

import msgspec
import numpy as np
import pytest
from hands import Hands
from shared import FIGURE_4

from haptic_loop import design_coupling
from haptic_loop.controller.budget import EnergyBudget, Packets, Shell
from haptic_loop.controller.coupling import SpringDamper
from haptic_loop.controller.environment import Network, Networks, Spring, environment
from haptic_loop.controller.lti import Lti
from haptic_loop.models.hold import hold as hold_input
from haptic_loop.models.scene import Crowd, variants
from haptic_loop.sim.scenario import load

T = 1.2e-3
DELTA = np.array([1.37, 0.9])


def springs(x, rng):
    """Return a controller that delivers energy: an unsymmetric stiffness with negative damping."""
    K, old = np.array([[6000.0, 2500.0], [-2500.0, 3000.0]]), x

    def force(x, v):
        nonlocal old
        out = K @ x - 20 * (x - old) / T
        old = x
        return out

    return force


def network(x, rng):
    """Return a controller that is a random recurrent network of saturating units."""
    A, B, C = rng.normal(size=(30, 30)) / 4, rng.normal(size=(30, 4)) * [300, 300, 5, 5], rng.normal(size=(2, 30)) * 4
    h = rng.normal(size=(30, 1)) * np.ones(x.shape[1])

    def force(x, v):
        nonlocal h
        h = np.tanh(A @ h + B @ np.vstack([x, v]))
        return C @ h

    return force


def along_velocity(x, rng):
    """Return a controller whose forces of 12 N always push along the velocity."""
    return lambda x, v: -12.0 * np.sign(v + 1e-12)


def each_in_turn(hands, rng):
    """Return a function that gives forces (m, nsim) [N]; each of three controllers acts in every third simulation."""
    parts = [
        (slice(k, None, 3), make(hands.x[:, k::3], rng)) for k, make in enumerate((springs, network, along_velocity))
    ]

    def force():
        x, v = hands.x, hands.v
        out = np.empty_like(x)
        for part, one in parts:
            out[:, part] = one(x[:, part], v[:, part])
        return out

    return force


class Line:
    """A link with varying delays and losses. It applies the newest packet, or 0 if that is over hi + hold ticks old."""

    def __init__(self, rng, lo, hi, hold, loss, nsim):
        self.rng, self.lo, self.hi, self.hold, self.loss = rng, np.array(lo), np.array(hi), hold, loss
        self.ticks = 0
        self.newest, self.force = np.full((2, nsim), -1), np.zeros((2, nsim))  # newest arrived packet
        self.packets = []  # (tick, force, arrival) of recent packets

    def carry(self, f):
        k, self.ticks = self.ticks, self.ticks + 1
        took = self.rng.integers(self.lo[:, None], self.hi[:, None], size=f.shape, endpoint=True)
        due = np.where(self.rng.random(f.shape) < self.loss, 10**9, k + took)
        self.packets = [*self.packets, (k, f, due)][-int(self.hi.max()) - 1 :]
        for j, sent, arrives in self.packets:
            fresh = (arrives <= k) & (self.newest < j)
            self.newest, self.force = np.where(fresh, j, self.newest), np.where(fresh, sent, self.force)
        old = k - self.newest > self.hi[:, None] + self.hold
        return np.where(old | (self.newest < 0), 0.0, self.force)


def test_no_hand_is_given_more_than_the_budget():
    """Each controller meets twenty hands of each kind: lossless or damped, with initial speeds of 1 mm/s or 0.3 m/s."""
    rng, n = np.random.default_rng(7), np.arange(240)
    lossless, start = n // 3 % 2 == 0, np.where(n // 6 % 2 == 0, 1e-3, 0.3)
    hands = Hands(rng, n.size, lossless, start)
    W0, initial, theta = 0.05, hands.energy(), (1, 2)
    force, budget = each_in_turn(hands, rng), EnergyBudget(DELTA, T, Packets(theta), start=W0, nsim=n.size)
    line, x, most = np.zeros((3, 2, n.size)), hands.x, np.zeros(n.size)
    for _ in range(700):
        line = np.concatenate([budget.limit(force(), hands.x - x)[None], line[:-1]])
        x = hands.x
        assert (budget.energy - budget.reserved > -1e-9).all()
        hands.hold(np.stack([line[n, i] for i, n in enumerate(theta)]))
        received = hands.energy() - initial
        assert (received <= W0 + 1e-9 * (1 + initial)).all()
        most = np.maximum(most, received)
    assert budget.limited.min() > 0
    # Some hand receives more than half of the bound.
    assert most[(n % 3 == 2) & lossless & (start < 0.1)].max() > 0.5 * W0


@pytest.mark.validate
def test_the_budget_holds_on_stiffer_springs():
    """The default scenario's optimal coupling meets springs 2.5 times stiffer, compliant devices and lossless hands.

    With the budget, forces give at most what devices dissipate, and hands stay below 0.5 m/s. Without it, most hands
    exceed 2 m/s.
    """
    scenario, nsim = load(), 30
    coupling = design_coupling(scenario.loop("I"), "optimal", "this-environment").coupling
    springs = tuple(msgspec.structs.replace(s, stiffness=2.5 * s.stiffness) for s in FIGURE_4.springs)
    F = coupling.around(environment(msgspec.structs.replace(FIGURE_4, springs=springs), T))
    rng = np.random.default_rng(20)
    links = np.exp(rng.uniform(np.log([0.01, 1e-300, 1.0]), np.log([3.0, 1e-299, 1e4]), (nsim, 2, 2, 3)))
    plants = hold_input(variants(scenario.device, Crowd(links)).plants(), T)
    late, delta, dissipated = {}, np.array(scenario.delta)[:, None], 0.0
    for limited in (True, False):
        budget = EnergyBudget(scenario.delta, T, Packets((1, 2)), nsim=nsim)
        s, z, line = np.zeros((nsim, plants.A.shape[-1])), np.zeros((F.order, nsim)), np.zeros((3, 2, nsim))
        s[:, s.shape[1] // 2 :] = 0.1
        x = acted = supplied = np.zeros((2, nsim))
        for k in range(4000):
            dx, x = s[:, :2].T - x, s[:, :2].T.copy()
            wanted = np.clip(F.C @ z + F.D @ x, -12, 12)
            z = F.A @ z + F.B @ x
            if k and limited:
                supplied = supplied - acted * dx - delta * dx**2 / T
                assert supplied.sum(axis=0).max() < 1e-9
                dissipated = dissipated + (delta * dx**2).sum(axis=0)
            line = np.concatenate([(budget.limit(wanted, dx) if limited else wanted)[None], line[:-1]])
            acted = np.stack([line[1, 0], line[2, 1]])
            push = np.concatenate([np.zeros((nsim, plants.B.shape[-1] - 2)), acted.T], axis=1)
            s = np.einsum("nij,nj->ni", plants.A, s) + np.einsum("nij,nj->ni", plants.B, push)
        late[limited] = np.abs(s[:, s.shape[1] // 2 :]).max(axis=1)
    assert np.median(late[False]) > 2
    assert late[True].max() < 0.5
    mass = links[..., 0].sum(axis=(1, 2)) + 0.5  # [kg] of hands and devices, which start at 0.1 m/s
    assert (dissipated <= mass * 0.1**2 / 2 * T / 0.05).all()


@pytest.mark.parametrize(
    ("hold", "loss", "report"),
    [
        (3, 0.3, "late"),
        pytest.param(0, 0.0, "never", marks=pytest.mark.slow),
        *(
            pytest.param(*case, marks=pytest.mark.validate)
            for case in [(0, 0.0, "late"), (0, 0.0, "at once"), (3, 0.3, "never"), (3, 0.3, "at once")]
        ),
    ],
)
def test_varying_delays_and_losses_keep_the_guarantee(hold, loss, report):
    """The budget learns which forces acted: at once, four ticks late, or never."""
    rng, nsim = np.random.default_rng(8), 90
    hands = Hands(rng, nsim, True, 0.01)
    W0, initial, lo, hi, late = 0.05, hands.energy(), (0, 1), (3, 2), 4
    budget = EnergyBudget(DELTA, T, Packets(lo, hi, hold), start=W0, nsim=nsim)
    line, force, x, acted = (
        Line(rng, lo, hi, hold, loss, nsim),
        each_in_turn(hands, rng),
        hands.x,
        [np.zeros((2, nsim))],
    )
    for k in range(500):
        sent = budget.limit(force(), hands.x - x, acted[-1] if report == "at once" else None)
        x = hands.x
        if report == "late" and k > late:
            budget.tell(k - late, acted[k - late + 1])
        acted.append(line.carry(sent))
        hands.hold(acted[-1])
        assert (hands.energy() - initial).max() <= W0 + 1e-9
        assert (budget.energy - budget.reserved > -1e-9).all()
    assert budget.surprises == 0
    # Without reports the budget stays empty for some hands, but most hands get forces.
    assert (np.abs(acted).sum(axis=(0, 1)) > 0.1).mean() > 0.6


@pytest.mark.parametrize("case", [pytest.param("constant", marks=pytest.mark.slow), "late"])
def test_coarse_encoders_keep_the_guarantee(case):
    """No hand receives more than the budget W0. If encoder steps of 0.5 mm are ignored, one hand gets over 1.5 W0."""
    W0, q, most = 0.05, 5e-4, {}
    for known in (q, 0.0) if case == "constant" else (q,):
        rng = np.random.default_rng(17)
        hands = Hands(rng, 40, True, 0.02)
        initial, steal = hands.energy(), along_velocity(hands.x, rng)
        lo, hi = ((0, 1), (0, 1)) if case == "constant" else ((0, 0), (2, 2))
        budget = EnergyBudget(DELTA, T, Packets(lo, hi), encoder_step=known, start=W0, nsim=40)
        line, seen, acted = Line(rng, lo, hi, 0, 0.0, 40), 0.0, []
        for k in range(500):
            now = np.round(hands.x / q) * q
            wanted = steal(hands.x, hands.v) * (1 + (k % 2))  # behind coarse encoders, changes cost energy
            sent = budget.limit(wanted, now - seen)
            if case == "late" and k >= 3:
                budget.tell(k - 3, acted[k - 3])
            seen = now
            acted.append(line.carry(sent))
            hands.hold(acted[-1])
            most[known] = max(most.get(known, 0.0), (hands.energy() - initial).max())
        assert np.abs(acted).sum() > 0
    assert most[q] <= W0 + 1e-9
    if case == "constant":
        assert most[0.0] > 1.5 * W0


@pytest.mark.parametrize("every", [1, 2])
def test_encoder_errors_cost_their_worst_combination(every):
    """The device reports every tick or every second one. All combinations of errors of +-q/2 are tried, q is the step.

    The previous force bounds the errors of a tick only if it was reported. Other ticks count with their largest loss.
    """
    rng, q, ticks = np.random.default_rng(31), 1e-4, 8
    f, dx = rng.normal(size=(ticks + 1, 2)), 2e-4 * rng.normal(size=(ticks, 2))
    budget = EnergyBudget(DELTA, T, Packets((0, 0), (1, 1)), encoder_step=q, start=1.0)
    budget.limit(f[0, :, None], 0 * f[0, :, None])
    for k in range(ticks):
        sent = budget.limit(f[k + 1, :, None], dx[k, :, None])
        np.testing.assert_array_equal(sent[:, 0], f[k + 1])  # 1 J is enough for all forces
        if k % every == 0:
            budget.tell(k, f[k, :, None])
    damping = 0.95 * DELTA
    losses = T * f**2 / (4 * damping) + 2 * q * np.abs(f)
    losses[1:] = np.maximum(losses[1:], losses[:-1])  # the larger loss of the packets of both ages
    energy = 1 - sum(losses[k].sum() for k in range(ticks) if k % every)
    for run in [range(ticks)] if every == 1 else [[k] for k in range(0, ticks, every)]:
        errors = q / 2 * np.array(list(product((-1, 1), repeat=len(run) + 1)))
        energy -= (np.diff(errors) @ f[run]).max(axis=0).sum()
        energy += (f[run] * dx[run] + damping * np.maximum(np.abs(dx[run]) - q, 0) ** 2 / T).sum()
    assert budget.energy[0] == pytest.approx(energy, abs=1e-14)  # two units in the last place per tick


@pytest.mark.slow
def test_reserve_and_scale_match_brute_force():
    """By definition the reserve sums over the next ticks the largest loss of a packet of an allowed age.

    If a scaled force were larger by 1e-4 of the wanted force, the reserve would exceed the energy.
    """
    rng = np.random.default_rng(9)
    cases = (((0, 0), (0, 0), 0, 0), ((1, 2), (1, 2), 0, 0), ((0, 1), (4, 2), 0, 0), ((1, 0), (2, 3), 2, 1e-5))
    for lo, hi, hold, step in cases:
        budget = EnergyBudget(DELTA, T, Packets(lo, hi, hold), encoder_step=step, start=0.02, cap=0.03)
        packets = []

        def loss(i, f, step=step):
            return T * f**2 / (4 * 0.95 * DELTA[i]) + 2 * step * abs(f)

        def reserve(packets, lo=lo, hi=hi, hold=hold, loss=loss):
            k, total = len(packets) - 1, 0.0
            for i in range(2):
                for t in range(k, k + hi[i] + hold + 1):
                    ages = range(max(0, t - hi[i] - hold), min(k, t - lo[i]) + 1)
                    total += max((loss(i, packets[j][i]) for j in ages), default=0.0)
            return total

        acts = 0
        for k in range(300):
            wanted = rng.normal(size=2) * 4 * (k % 9 > 2)
            sent = budget.limit(wanted[:, None], rng.normal(size=(2, 1)) * 3e-5)[:, 0]
            packets.append(sent)
            assert budget.reserved[0] == pytest.approx(reserve(packets), rel=1e-9, abs=1e-15)
            assert budget.reserved[0] <= budget.energy[0] + 1e-12 <= 0.03 + 2e-12
            scale = sent @ wanted / (wanted @ wanted) if wanted.any() else 1.0
            np.testing.assert_allclose(sent, scale * wanted, rtol=0, atol=1e-12)
            if scale < 0.999:
                acts += 1
                assert reserve([*packets[:-1], sent + 1e-4 * wanted]) > budget.energy[0]
        assert acts > 10


def motions(rng, ticks, nsim):
    """Return motions (ticks, 2, nsim) [m] from rest: random walks, waves of many frequencies, and jumps."""
    t = np.arange(ticks)[:, None, None]
    walk = rng.normal(size=(ticks, 2, nsim)).cumsum(axis=0) * 1e-3
    walk = np.where(rng.random((1, 1, nsim)) < 0.5, walk, rng.normal(size=walk.shape) * 0.01)
    wave = np.sin(np.exp(rng.uniform(np.log(1e-3), np.log(np.pi), (1, 2, nsim))) * t) * rng.normal(size=(1, 2, nsim))
    x = np.where(rng.random((1, 1, nsim)) < 0.5, walk, 0.01 * wave)
    x[0] = 0
    return x


def limited_ticks(F, x, theta, delta, **options):
    """Return the numbers (nsim,) of ticks in which the budget limits the undelayed forces of F for motions x."""
    budget, z = EnergyBudget(delta, F.T, Packets(theta), nsim=x.shape[2], **options), np.zeros((F.order, x.shape[2]))
    for k, now in enumerate(x):
        budget.limit(F.C @ z + F.D @ now, now - x[k - 1])
        z = F.A @ z + F.B @ now
    return budget.limited


def test_any_environment_loops_are_never_limited():
    rng, eps = np.random.default_rng(10), 0.05
    scenario = load()
    coupling = certified((1 - eps) * np.array(scenario.delta))
    x = motions(rng, 400, 60)
    stiff = Network(
        ("a", "b"), (Spring(("a", "ground"), 1e5, 3.0), Spring(("a", "b"), 4e4), Spring(("b", "ground"), 9e4))
    )
    for net in (FIGURE_4, stiff):
        E = environment(net, T)
        options = {"start": 1e-12}  # [J] covers rounding
        assert limited_ticks(coupling.around(E), x, (1, 2), scenario.delta, **options).max() == 0
    beyond = SpringDamper(1.5 * coupling.K, 1.5 * coupling.B)
    assert limited_ticks(beyond.around(environment(stiff, T)), x, (1, 2), scenario.delta, **options).max() > 0


@pytest.mark.parametrize("theta", [0, 2])
def test_delayed_springs_within_bounds_are_never_limited(theta):
    rng, eps = np.random.default_rng(11), 0.05
    most = (1 - eps) * DELTA / ((theta + 0.5) * T)
    ramps = np.abs((np.arange(400)[:, None, None] + rng.integers(0, 60, (1, 2, 40))) % 80 - 40.0) * 1e-3
    x = np.concatenate([motions(rng, 400, 60), ramps - ramps[:1]], axis=2)
    inside, beyond = (Lti.constant(np.diag(most * scale), T) for scale in (1 - 1e-9, 1.1))
    options = {"start": 1e-12}
    assert limited_ticks(inside, x, (theta, theta), DELTA, **options).max() == 0
    assert limited_ticks(beyond, x, (theta, theta), DELTA, **options).max() > 0


def test_a_cap_below_stored_energy_limits_most_ticks():
    """A spring of 1000 N/m stores 0.2 J at 2 cm: a cap of 0.25 J limits no tick, a cap of 0.05 J most ticks."""
    x = 0.02 * np.sin(2 * np.pi * 3.0 * T * np.arange(834))[:, None, None]
    spring = Lti.constant([[1000.0]], T)
    share = {cap: limited_ticks(spring, x, (0,), [1.37], cap=cap)[0] / len(x) for cap in (0.05, 0.25)}
    assert share[0.25] == 0
    assert 0.5 < share[0.05] < 0.8


def test_late_reports_count_and_impossible_ones_are_noticed():
    rng = np.random.default_rng(12)
    now, later = (EnergyBudget([1.0], T, Packets([0], [2]), start=5.0) for _ in range(2))
    dx = rng.normal(size=(50, 1, 1)) * 1e-4
    sent = [now.limit([[3.0]], dx[0])]
    later.limit([[3.0]], dx[0])
    for k in range(1, 50):
        sent.append(now.limit([[3.0]], dx[k], sent[-1]))
        later.limit([[3.0]], dx[k])
        assert later.energy < now.energy
    for k in range(49):
        later.tell(k, sent[k])
    assert later.energy == pytest.approx(now.energy, rel=1e-12)
    assert now.surprises == later.surprises == 0
    now.limit([[3.0]], dx[0], [[4.0]])
    assert now.surprises == 1
    with pytest.raises(ValueError, match="tick 3 does not wait"):
        later.tell(3, sent[3])


def test_forces_that_are_not_finite_become_zero():
    budget = EnergyBudget(DELTA, T, Packets((0, 0)), start=1.0, nsim=3)
    sent = budget.limit([[np.nan, 1.0, 1e300], [1.0, 2.0, np.inf]], np.zeros((2, 3)))
    np.testing.assert_array_equal(sent[:, 0], [0.0, 1.0])
    np.testing.assert_array_equal(sent[:, 2], [0.0, 0.0])
    assert (budget.reserved <= budget.energy).all()
    np.testing.assert_array_equal(sent[:, 1], [1.0, 2.0])
    assert budget.limited.tolist() == [1, 0, 1]
    force, _ = Shell(Lti.constant(np.eye(2), T), start=1.0, nsim=3).limit([[np.nan, 0.1, 1e200], [1.0, 0.2, 1e200]])
    np.testing.assert_array_equal(force, [[0.0, 0.1, 0.0], [1.0, 0.2, 0.0]])


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"start": -1.0}, "W0 is -1 J"),
        ({"start": 2.0, "cap": 1.0}, "cap is 1 J, expected at least its start, 2 J"),
        ({"delta": [0.0]}, r"delta is \[0.0\]"),
    ],
)
def test_impossible_budgets_are_refused(changed, message):
    with pytest.raises(ValueError, match=message):
        EnergyBudget(**({"delta": [1.0], "T": T, "packets": Packets([1])} | changed))


# The shell at the environment's port


def active_environment():
    """Return E(z) of the default network with -4 N s/m between its mass and ground."""
    M, D, K = FIGURE_4.matrices()
    return Networks(FIGURE_4.contacts, (M, D - 4.0 * np.diag([0, 0, 1.0]), K)).E(T)


@pytest.mark.slow
def test_the_shell_makes_an_active_mass_passive():
    """The energy from the environment's port never exceeds W0, and no larger scale of the force is possible."""
    rng, W0, nsim = np.random.default_rng(13), 0.01, 40
    E = active_environment()
    V = SpringDamper([879.0, 552.0], [0.39, 0.52]).compliance(T)
    shell, x = Shell(V, start=W0, nsim=nsim), motions(rng, 3000, nsim)
    solve = np.linalg.inv(np.eye(2) + E.D @ V.D)
    z, before, energy = np.zeros((E.order, nsim)), np.zeros((2, nsim)), np.full(nsim, W0)
    with np.errstate(over="ignore", invalid="ignore"):
        for k in range(3000):
            free = shell.free(x[k])
            wanted = solve @ (E.C @ z + E.D @ free)
            start = energy.copy()
            force, u = shell.limit(wanted)
            energy += (force * (u - before)).sum(axis=0)
            assert energy.min() > -1e-12
            more = force + 1e-6 * wanted
            cut = np.abs(force - wanted).max(axis=0) > 1e-5 * np.abs(wanted).max(axis=0)
            would = start + (more * (free - V.D @ more - before)).sum(axis=0)
            assert (would[cut] < 1e-12).all()
            z, before = E.A @ z + E.B @ u, u
    assert (shell.limited > 0).sum() > nsim / 4


def certified(delta, theta=(1, 2)):
    """Return the spring-damper that is designed for any environment."""
    loop = load().replace(delta=tuple(delta), theta=theta).loop("I")
    return design_coupling(loop, "spring-damper", "any-environment").coupling


@pytest.mark.slow
def test_hands_behind_the_shell_get_its_budget():
    """Behind a coupling for any environment, hands receive at most W0 from an active mass or from random forces.

    With W0 = 1e9 J, which limits nothing, some hand receives over 0.1 J.
    """
    E = active_environment()
    V = certified(DELTA).compliance(T)
    solve, most, nsim = np.linalg.inv(np.eye(2) + E.D @ V.D), {}, 80
    nonsense = np.arange(nsim) % 2 == 1
    for W0, ticks in ((0.02, 2000), (1e9, 3000)):
        rng = np.random.default_rng(18)
        hands, shell = Hands(rng, nsim, True, 0.05), Shell(V, start=W0, nsim=nsim)
        initial, line, z, most[W0] = hands.energy(), np.zeros((3, 2, nsim)), np.zeros((E.order, nsim)), np.zeros(nsim)
        for _ in range(ticks):
            wanted = solve @ (E.C @ z + E.D @ shell.free(hands.x))
            force, u = shell.limit(np.where(nonsense, 20 * rng.normal(size=(2, nsim)), wanted))
            z = E.A @ z + E.B @ u
            line = np.concatenate([force[None], line[:-1]])
            hands.hold(np.stack([line[1, 0], line[2, 1]]))
            most[W0] = np.maximum(most[W0], hands.energy() - initial)
        assert most[W0].max() <= W0 + 1e-9
    assert most[1e9][~nonsense].max() > 5 * 0.02
    assert most[0.02][~nonsense].max() > 0.1 * 0.02


def test_the_shell_never_limits_a_passive_environment():
    rng = np.random.default_rng(14)
    E, V = environment(FIGURE_4, T), SpringDamper([879.0, 552.0], [0.39, 0.52]).compliance(T)
    shell, x, F = Shell(V, start=1e-12, nsim=20), motions(rng, 400, 20), E.feedback(V)
    solve = np.linalg.inv(np.eye(2) + E.D @ V.D)
    z, y = np.zeros((E.order, 20)), np.zeros((F.order, 20))
    for now in x:
        force, u = shell.limit(solve @ (E.C @ z + E.D @ shell.free(now)))
        np.testing.assert_allclose(force, F.C @ y + F.D @ now, rtol=1e-9, atol=1e-9)
        z, y = E.A @ z + E.B @ u, F.A @ y + F.B @ now
    assert shell.limited.max() == 0
    with pytest.raises(ValueError, match="not passive"):
        Shell(Lti.constant([[-1.0]], T))
