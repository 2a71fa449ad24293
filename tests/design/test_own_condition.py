"""Tests of conditions, facts and couplings that a user writes: only what they state is assumed."""

import re
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
import pytest

from haptic_loop import load
from haptic_loop.controller.coupling import Compliance, Coupling, SpringDamper
from haptic_loop.controller.loop import DelayRange
from haptic_loop.controller.lti import Lti, as_like, constant_like, numbers, taps
from haptic_loop.design import compare
from haptic_loop.design.assessment import _covered_limits, assess
from haptic_loop.design.certificate import limiter_rho, prove, required_damping, requirements_of, verify
from haptic_loop.design.conditions import BEYOND, Condition, Demand
from haptic_loop.design.coupling_file import Stored, filed, sealed
from haptic_loop.design.coverage import robustness_nearby
from haptic_loop.design.environments import SWITCHING, SwitchingDelays
from haptic_loop.design.facts import Fact
from haptic_loop.design.files import InputError
from haptic_loop.design.result import ANY, HERE, RANGES, NotProved
from haptic_loop.sim.zwidth import CouplingSweep, EnvironmentSweep

PAIR = load("omega-pair").loop("I")
SOFT = SpringDamper([400.0, 300.0], [0.1, 0.1])
change = msgspec.structs.replace


class Plain(Condition):
    """this-environment for a constant period, written again."""

    name = "plain"

    def demand(self, loop, coupling, exact=False):
        F = loop.F(coupling, exact)
        F1, regular = F.over_z_minus_one()
        return Demand(regular, constant_like(F, np.diag(numbers(loop.delta, F.T) / F.T)), {"F(1)": F1}, ("F(1)",))


class Uneven(Plain):
    covers = ("T_max",)

    def demand(self, loop, coupling, exact=False):
        longest = loop.T if loop.T_max is None else loop.T_max
        demand = super().demand(loop, coupling, exact)
        return Demand(demand.free, demand.gain * (loop.period(exact) / numbers(longest, loop.period(exact))))


class Everywhere(Plain):
    covers = ("ranges",)


def _beyond() -> dict[str, tuple]:
    wall = load("one-wall").loop("I")
    one = SpringDamper([400.0] * wall.channels, [0.1] * wall.channels)
    return {
        "psi": (change(PAIR, psi=(1, 0)), SOFT),
        "T_max": (change(PAIR, T_max=2e-3), SOFT),
        "latency": (change(PAIR, latency=((0.0, 1.1e-3),) * 2), SOFT),
        "varying_delay": (PAIR.switching(DelayRange(PAIR.theta, tuple(n + 1 for n in PAIR.theta))), SOFT),
        "walls": (wall, one),
        "ranges": (load("omega-pair-ranges").loop("I"), SOFT),
    }


@pytest.mark.parametrize("name", BEYOND)
def test_a_condition_covers_only_what_it_names(name):
    loop, coupling = _beyond()[name]
    requirement = required_damping(loop, coupling, Plain())
    assert np.isinf(requirement.ratio)
    assert f"{name}, which the condition plain" in str(requirement.reason)
    with pytest.raises(NotProved, match=f"the loop has {name}, which the condition plain does not name"):
        prove(loop, coupling, Plain())


@pytest.mark.parametrize("names", ["not psi", ("wals",), ["psi"], None, ({},)])
def test_a_condition_covers_only_known_names(names):
    """As `covers`, a string would cover every name that is a part of it, and a wrong name would cover nothing."""
    with pytest.raises(InputError, match=r"^covers of the condition Wrong is .*, expected a tuple of 'psi', 'T_max', "):
        type("Wrong", (Plain,), {"covers": names})


def test_proofs_are_refused_by_conditions_that_cover_less():
    loop = change(PAIR, T_max=2e-3)
    assert required_damping(loop, SOFT, Uneven()).ratio == pytest.approx(
        required_damping(PAIR, SOFT, Plain()).ratio * 2e-3 / PAIR.T, rel=1e-9
    )
    stored = Stored.of(loop, SOFT, prove(loop, SOFT, Uneven()))
    assert verify(stored, Uneven()).proved
    assert "T_max" in str(verify(stored, Plain()).reason)

    class More(Uneven):
        pass

    assert "T_max" in str(required_damping(loop, SOFT, More()).reason)


@pytest.mark.slow
def test_named_ranges_are_proved_at_every_vertex():
    loop = load("omega-pair-ranges").loop("I")
    own, shipped = (required_damping(loop, SOFT, condition) for condition in (Everywhere(), "this-environment"))
    assert own.ratio == pytest.approx(shipped.ratio, rel=1e-9)
    certificate = prove(loop, SOFT, Everywhere())
    assert len(certificate.matrices) == len(loop.members()) > 1
    assert certificate.guarantee == RANGES
    assert verify(Stored.of(loop, SOFT, certificate), Everywhere()).proved


@pytest.mark.parametrize("taken", ["any-environment", "this-environment", "limiter", "", 7])
def test_shipped_or_invalid_condition_names_are_refused(taken):
    own = type("Steal", (Plain,), {"name": taken})()
    for call in (lambda: required_damping(PAIR, SOFT, own), lambda: prove(PAIR, SOFT, own)):
        with pytest.raises(ValueError, match="condition Steal: its name is"):
            call()
    ours = Stored.of(PAIR, SOFT, prove(PAIR, SOFT, "this-environment"))
    if taken == "this-environment":
        assert "condition Steal: its name is" in str(verify(ours, own).reason)


def test_maps_and_comparisons_take_own_conditions():
    """Maps and the demand over frequency of a user's condition equal those of this-environment."""
    scenario, K, B = load("omega-pair"), np.array([300.0, 4e3]), np.array([0.1, 1.0])
    plain, ours = Plain(), "this-environment"
    sweeps = (
        CouplingSweep(scenario.device, scenario.population, PAIR, own=plain),
        EnvironmentSweep(scenario.device, scenario.population, PAIR, SOFT, own=plain),
    )
    for sweep in sweeps:
        np.testing.assert_allclose(sweep.ratios("plain", K, B), sweep.ratios(ours, K, B), rtol=1e-7)
        assert sweep.decisive == "plain"
    judged, w = compare.judge(PAIR, SOFT, own=[plain]), np.geomspace(1e-3, 3, 50)
    np.testing.assert_allclose(judged.demands["plain"](w), judged.demands[ours](w), rtol=1e-12)
    wall = load("one-wall").loop("I")
    one = SpringDamper([400.0] * wall.channels, [0.1] * wall.channels)
    assert "the loop has walls" in compare.judge(wall, one, own=[plain]).requirements["plain"].reason


class Shifting(SwitchingDelays):
    """A user's condition with a multiplier, for delays that switch."""

    name, covers = "shifting", ("varying_delay",)


def test_own_multipliers_are_searched_stored_and_checked():
    loop, own = PAIR.switching(DelayRange(PAIR.theta, tuple(n + 1 for n in PAIR.theta))), Shifting()
    requirement, shipped = required_damping(loop, SOFT, own), required_damping(loop, SOFT, SWITCHING)
    assert requirement.required == shipped.required
    assert requirement.bound == pytest.approx(requirement.ratio, rel=1e-6)
    stored = Stored.of(loop, SOFT, prove(loop, SOFT, own))
    assert stored.certificate.multipliers == {"alpha": requirement.multiplier}
    assert verify(stored, own).proved
    for other in ({}, {"alpha": (1.0, 1.0)}, {"alpha": (-1.0, 1.0)}):
        forged = change(stored.certificate, multipliers=other)
        assert not verify(change(stored, certificate=sealed(forged)), own).proved


@pytest.fixture(scope="module")
def repeats():
    """Run the example of docs/extending.md, and return its fact and its condition by name."""
    page = (Path(__file__).parents[2] / "docs/extending.md").read_text()
    text = re.search(r"```python\n# repeats.py\n(.*?)```", page, re.DOTALL)[1]
    assert sum(bool(line.strip()) and "import" not in line for line in text.splitlines()) <= 15
    names: dict = {}
    exec(text, names)
    return names


def test_facts_and_conditions_need_one_method_each():
    assert (Fact.__abstractmethods__, Condition.__abstractmethods__) == ({"enter"}, {"demand"})


def test_an_own_fact_matches_a_dense_sweep(repeats):
    """The ratio is the least s with He[F/(z-1)] - F*F/(2 a) >= -(s delta/T - a/2) on a grid; 8 other a give no less."""
    own = repeats["RepeatedForces"]()
    requirement = required_damping(PAIR, SOFT, own)
    F, z = PAIR.F(SOFT), np.exp(1j * np.geomspace(1e-4, np.pi, 20_000))
    G, per_damping = F.at(z), np.sqrt(PAIR.T / np.array(PAIR.delta))

    def dense(a):
        step = G / (z - 1)[:, None, None]
        here = -(step + np.conj(np.swapaxes(step, 1, 2))) / 2 + np.diag(a) / 2
        here = here + np.conj(np.swapaxes(G, 1, 2)) @ np.diag(1 / (2 * a)) @ G
        return np.linalg.eigvalsh(per_damping[:, None] * here * per_damping).max()

    best = np.array(requirement.multiplier)
    assert requirement.ratio == pytest.approx(dense(best), rel=1e-6)
    assert requirement.ratio > required_damping(PAIR, SOFT, "this-environment").ratio
    others = np.random.default_rng(0).uniform(0.5, 2.0, (8, 2)) * best
    assert min(dense(a) for a in others) > requirement.ratio * (1 - 1e-6)


@pytest.mark.slow
def test_an_own_fact_is_proved_and_mapped(repeats):
    own, scenario = repeats["RepeatedForces"](), load("omega-pair")
    certificate = prove(PAIR, SOFT, own)
    assert verify(Stored.of(PAIR, SOFT, certificate), own).proved
    assert not own.extensible
    sweep = CouplingSweep(scenario.device, scenario.population, PAIR, own=own)
    gain = np.array([400.0]), np.array([0.1])
    needs = required_damping(PAIR, SpringDamper([400.0] * 2, [0.1] * 2), own)
    assert sweep.ratios(own.name, *gain)[0] == pytest.approx(needs.ratio, rel=1e-6)
    judged = compare.judge(PAIR, SOFT, own=[own])
    binding = judged.requirements[own.name]
    w = 2 * np.pi * PAIR.T * np.array([binding.frequency_hz])
    assert judged.demands[own.name](w)[0] == pytest.approx(binding.ratio, rel=1e-9)  # with the search's multiplier
    nearby, plain = robustness_nearby(PAIR, SOFT, own), robustness_nearby(PAIR, SOFT)
    assert nearby.required_over_available > plain.required_over_available


def test_own_conditions_cover_no_limited_forces():
    assert limiter_rho(PAIR, prove(PAIR, SOFT, Plain())) is None
    assert limiter_rho(PAIR, prove(PAIR, SOFT, "any-environment")) == (0.0, 0.0)


class Anywhere(Plain):
    name = "anywhere"

    def guarantee(self, loop):
        return ANY


@pytest.mark.slow
def test_own_conditions_state_environments_and_limits():
    stiff, own = SpringDamper([2000.0, 1500.0], [0.2, 0.2]), Anywhere()
    needs = requirements_of(PAIR, stiff, own=own)
    assert assess(PAIR, stiff, condition=own, limiter=False).guarantee.any_environment
    assert not needs["any-environment"].certified
    assert _covered_limits(PAIR, stiff, needs).less
    assert assess(PAIR, stiff, limiter=False).guarantee.environments == HERE
    assert not _covered_limits(PAIR, stiff, requirements_of(PAIR, stiff)).less


@dataclass(frozen=True)
class Mean(Coupling):
    """A spring after a weighted mean of two samples. `in_form` and `in_compliance` soften what these methods return."""

    K: float
    in_form: float = 1.0
    in_compliance: float = 1.0

    def _V(self, T, times=1.0):
        return Lti.diag(*[taps(numbers([0.8, 0.2], T) * numbers(times / self.K, T), T)] * 2)

    def compliance(self, T):
        return self._V(T, self.in_compliance)

    def around(self, environment, further=0):
        return environment.feedback(as_like(environment, self._V(environment.T)))

    def form(self):
        return Compliance(self._V(PAIR.T, self.in_form)).form()


def test_a_coupling_must_equal_its_stored_form():
    assert isinstance(filed(PAIR, Mean(400.0)), Compliance)
    assert filed(PAIR, SOFT) is SOFT
    certificate = prove(PAIR, Mean(400.0), "this-environment")
    assert verify(Stored.of(PAIR, Mean(400.0), certificate)).proved
    for other, what in ((Mean(400.0, in_form=1.00001), "around"), (Mean(400.0, in_compliance=2.0), "compliance")):
        for call in (Stored.of, filed, lambda loop, coupling: prove(loop, coupling, "this-environment")):
            with pytest.raises(InputError, match=f"coupling Mean: form.*another system than {what}"):
                call(PAIR, other)
