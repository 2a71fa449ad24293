"""Tests of varying periods: the required damping of each condition, and exact simulations with random periods."""

import json
from fractions import Fraction

import msgspec
import numpy as np
import pytest
from driven import growing
from evaluate import any_environment, any_environment_demand, prove_limiter, this_environment_demand
from evaluate import loop as loop_of
from scipy.linalg import expm
from shared import FIGURE_4, ONE_MASS

from haptic_loop.cli.design import main as cli_design
from haptic_loop.controller.coupling import SpringDamper
from haptic_loop.controller.environment import Network, Spring
from haptic_loop.controller.loop import DelayRange, Loop
from haptic_loop.design.certificate import prove, required_damping, requirements_of, verify
from haptic_loop.design.conditions import even_damping
from haptic_loop.design.coupling_file import Stored, digest
from haptic_loop.design.environments import LIMITER, SWITCHING
from haptic_loop.design.spring_damper import design

T, LONG = 1e-3, 1.6e-3
LOOP = Loop(T, (1, 2), (0, 0), (1, 2), (1.37, 1.37), FIGURE_4)
STIFF, SOFT = SpringDamper([7806, 3137], [0.105, 1.68]), SpringDamper([500, 350], [0.2, 0.3])
change = msgspec.structs.replace


@pytest.mark.slow
def test_switching_reports_use_the_longest_period(tmp_path):
    """The damping reported for a playout buffer, which makes every delay the largest one, is that of T_max."""
    (tmp_path / "one.toml").write_text(ONE_MASS)
    file, more = tmp_path / "r.json", ["--condition", "this-environment", "--T-max", "1.8e-3"]
    more += ["--scenario", str(tmp_path / "one.toml")]
    cli_design(["--varying-delay", "1,2", *more, "--json", str(file), "--out", str(tmp_path / "c.json")])
    stored = msgspec.json.decode((tmp_path / "c.json").read_bytes(), type=Stored)
    loop = stored.loop.switching(None)
    buffered = required_damping(change(loop, theta=(2,)), stored.coupling.build(loop.T), "this-environment")
    shown = json.loads(file.read_text())["switching"]["playout"]["required_damping"]
    assert shown == pytest.approx(list(buffered.required), rel=1e-6)


@pytest.mark.parametrize("condition", ["this-environment", "any-environment"])
def test_the_longest_period_scales_the_required_damping(condition):
    even = required_damping(LOOP, SOFT, condition)
    uneven = required_damping(change(LOOP, T_max=LONG), SOFT, condition)
    assert uneven.required == pytest.approx([1.6 * b for b in even.required], rel=1e-9)
    assert uneven.available == LOOP.delta


def test_the_longest_period_scales_switching_and_multipliers():
    switching = change(LOOP, varying_delay=DelayRange((0, 1), (1, 2)))
    even, uneven = (required_damping(change(switching, T_max=longest), SOFT, SWITCHING) for longest in (None, LONG))
    # Two searches for the multiplier alpha end at different points, each within 1e-6 of its bound.
    assert uneven.required == pytest.approx([1.6 * b for b in even.required], rel=1e-6)
    soft = msgspec.structs.replace(
        FIGURE_4, springs=tuple(change(s, stiffness=s.stiffness / 8, damping=0.2) for s in FIGURE_4.springs)
    )
    delayed = change(LOOP, psi=(1, 0), environment=soft)
    longer = change(delayed, T_max=LONG, delta=tuple(1.6 * d for d in LOOP.delta))
    optimum = design(delayed)
    needs = [required_damping(one, optimum.coupling, "any-environment", optimum.phi) for one in (delayed, longer)]
    assert needs[1].ratio == pytest.approx(needs[0].ratio, rel=1e-7)
    assert verify(
        Stored.of(longer, optimum.coupling, prove(longer, optimum.coupling, "any-environment", optimum.phi))
    ).proved


def test_the_longest_period_scales_limited_forces():
    """The controller sets the limiter's rho, so no period changes it. The certificate states the swept requirement."""
    loop, c = change(LOOP, delta=(3.0, 3.0)), ((0.3,), (0.3,))
    longer = change(loop, T_max=LONG)
    even, uneven = (required_damping(one, SOFT, LIMITER, (0.3, 0.3)) for one in (loop, longer))
    assert uneven.required == pytest.approx([1.6 * b for b in even.required], rel=1e-9)
    assert prove_limiter(longer, SOFT, c=c).required == uneven.required


def test_any_environment_follows_its_formula():
    """He[(1 - 1/z) V] >= T_max |1 - z^-n|^2 / (4 delta) holds for one spring at theta = 1, so n = 2."""
    V, n = SpringDamper([500.0], [0.0]).compliance(T), 2
    w = np.linspace(0.01, np.pi, 4000)
    have = ((1 - np.exp(-1j * w)) / 500).real
    need = LONG * (np.abs(1 - np.exp(-1j * n * w)) ** 2 / (4 * have)).max()
    assert any_environment(V, [1], [1.0], LONG).required[0] == pytest.approx(need, rel=1e-4)  # from w = 0.01, not 0


def test_damping_per_tick_is_exact():
    longer = loop_of(1e-3, [1.37], T_max=1.6e-3)
    assert even_damping(longer, Fraction(1, 1000))[0] == Fraction(137, 100) / Fraction(16, 10)
    F = LOOP.F(SOFT, exact=True)
    gain = this_environment_demand(F, LOOP.delta, LONG).gain.D
    assert gain[0, 0] == Fraction(137, 100) / Fraction(16, 10000)
    V = SOFT.compliance(Fraction(1, 1000))
    window = any_environment_demand(V, LOOP.theta, LOOP.delta, LONG).free.D[0, 0]
    even = any_environment_demand(V, LOOP.theta, LOOP.delta).free.D[0, 0]
    assert window / even == Fraction(8, 5)


@pytest.mark.parametrize("condition", ["this-environment", "any-environment"])
def test_uneven_period_certificates_are_proved_from_files(condition):
    loop = change(LOOP, T_max=LONG)
    stored = Stored.of(loop, SOFT, prove(loop, SOFT, condition))
    again = msgspec.json.decode(msgspec.json.encode(stored), type=Stored)
    assert verify(again).proved
    assert not verify(change(again, loop=change(loop, T_max=1.7e-3))).proved
    assert digest(change(LOOP, T_max=None)) == digest(LOOP) != digest(loop)


def test_uneven_period_designs_are_certified():
    loop = change(LOOP, T_max=LONG)
    optimum = design(loop, "this-environment", limiter=False)
    requirement = requirements_of(loop, optimum.coupling)["this-environment"]
    assert requirement.certified
    assert requirement.proof == "rational"
    assert requirement.ratio == pytest.approx(1, rel=1e-3)  # the design uses all available damping


def test_a_longest_period_below_the_period_is_refused():
    with pytest.raises(ValueError, match=r"T_max is 0\.0009 s, expected at least T = 0\.001 s"):
        change(LOOP, T_max=0.9e-3)


# Loops with random periods, simulated exactly: devices have the given damping, hands have none.


PERIODS = (0.2e-3, 0.7e-3, 1.1e-3, 1.6e-3)
HANDS = 60
HELD = Network(("tip",), (Spring(("tip", "ground"), 20.0, 0.3),), {"tip": 0.05})
ONE, COUPLING = Loop(T, (1,), (0,), (1,), (1.0,), HELD), SpringDamper([1000.0], [0.5])


def plants(damping, rng):
    """Return A (hands, 2, 2) and B (hands, 2, 1) of devices in lossless hands: 1 g to 1 kg on 1 to 1000 N/m."""
    mass, spring = (10 ** rng.uniform(*limits, HANDS) for limits in ((-3, 0), (0, 3)))
    A, B = np.zeros((HANDS, 2, 2)), np.zeros((HANDS, 2, 1))
    A[:, 0, 1] = 1
    A[:, 1, 0], A[:, 1, 1], B[:, 1, 0] = -spring / mass, -damping / mass, -1 / mass
    return A, B


def tick(F, A, B, period):
    """Return the exact transition of plants and computer over one period, (hands, 2 + states, 2 + states)."""
    n, m = B.shape[1:]
    whole = np.zeros((HANDS, n + m, n + m))
    whole[:, :n, :n], whole[:, :n, n:] = A, B
    step = expm(whole * period)
    Ad, Bd, C = step[:, :n, :n], step[:, :n, n:], np.eye(m, n)
    upper = np.concatenate([Ad + Bd @ F.D @ C, Bd @ F.C], axis=2)
    lower = np.concatenate([F.B @ C, F.A], axis=1)
    return np.concatenate([upper, np.broadcast_to(lower, (HANDS, *lower.shape))], axis=1)


def grown(damping, mean, seed=7):
    """Return for how many hands the motion grows a hundredfold between a tenth of the ticks and the end.

    Periods are drawn anew after `mean` ticks on average. If `mean` is None, each tick has the period that gives the
    hand most energy.
    """
    rng = np.random.default_rng(seed)
    A, B = plants(damping, rng)
    F = ONE.F(COUPLING)
    steps = np.stack([tick(F, A, B, period) for period in PERIODS])
    energy = np.stack([-A[:, 1, 0] / -B[:, 1, 0], -1 / B[:, 1, 0]], axis=1)  # twice the energy: stiffness and mass
    return growing(steps, energy, mean, rng, 20_000 if mean else 6000)


@pytest.mark.parametrize(
    "mean",
    [pytest.param(50, marks=pytest.mark.slow), *(pytest.param(n, marks=pytest.mark.validate) for n in (1000, None))],
)
def test_motions_grow_only_below_the_longest_periods_requirement(mean):
    need = required_damping(ONE, COUPLING, "this-environment").required[0]
    assert need == pytest.approx(1.244099, rel=1e-6)
    assert grown(1.01 * 1.6 * need, mean) == 0
    assert grown(0.6 * 1.6 * need, mean) > 0
