"""Tests of a user's own fact: no shortcut of a condition leaves it out, and the verdict names whose claim it is."""

import re
from pathlib import Path

import msgspec
import numpy as np
import pytest
from shared import PAIR, SOFT, STIFF, checkered

from haptic_loop import certify, load
from haptic_loop.cli import check
from haptic_loop.cli.verdict import verdict
from haptic_loop.controller.coupling import SpringDamper
from haptic_loop.controller.loop import DelayRange
from haptic_loop.controller.lti import constant_like, numbers
from haptic_loop.design.assessment import BELOW_LIMITS, assess
from haptic_loop.design.certificate import covered, prove, required_damping, verify
from haptic_loop.design.conditions import Condition, Demand
from haptic_loop.design.coupling_file import Stored, save, sealed
from haptic_loop.design.coverage import robustness_nearby
from haptic_loop.design.environments import ANY_ENVIRONMENT, LIMITER, LimitedForces, SwitchingDelays, ThisEnvironment
from haptic_loop.design.facts import Fact, Switching, Unknowns
from haptic_loop.design.known_device import KNOWN_DEVICE, KNOWN_DEVICE_ANY, KnownDevice, LimitedKnownDevice
from haptic_loop.design.result import ANY, HERE, RANGES
from haptic_loop.sim.couplings import encoder_steps
from haptic_loop.sim.zwidth import CouplingSweep, EnvironmentSweep

change = msgspec.structs.replace
KNOWN = load("omega-pair-known").loop("I")


class Less(Fact):
    """Forces return up to `less` dx^2 [J] more energy per tick, which requires `less` T more damping; `less` in N/m."""

    def __init__(self, less):
        self.less = less

    def enter(self, block, loop, values):
        for i in range(loop.channels):
            dx = block.places["dx", i]
            block.term(dx, dx, numbers(-self.less, block.T))


class Searched(Less):
    """The fact `Less` with a multiplier that it does not use."""

    def unknowns(self, loop):
        return (Unknowns("c", (1.0,), "a positive number", 1e-6, 1e3),)


def condition(base, fact):
    """Return a condition of a user: `base` with one more fact."""

    def facts(self, loop):
        return (*base.facts(self, loop), fact)

    return type("Own", (base,), {"name": "own", "covers": ("psi", "T_max"), "facts": facts})()


class Twenty(ThisEnvironment):
    name, covers = "twenty", ("psi", "T_max", "ranges")

    def facts(self, loop):
        return (*super().facts(loop), Less(20.0))


FACTS = [Less(20.0), Searched(20.0), Less(1e6)]


@pytest.mark.parametrize("fact", FACTS)
@pytest.mark.parametrize(
    ("base", "shipped"),
    [
        (ThisEnvironment, "this-environment"),
        (SwitchingDelays, "this-environment"),
        (type(ANY_ENVIRONMENT), "any-environment"),
    ],
)
def test_an_own_fact_adds_its_damping(base, shipped, fact):
    own, plain = required_damping(PAIR, SOFT, condition(base, fact)), required_damping(PAIR, SOFT, shipped)
    assert own.condition == "own"
    assert own.required == pytest.approx([max(plain.required) + fact.less * PAIR.T] * 2, rel=1e-8)


@pytest.mark.validate
def test_files_name_the_bounds_of_own_known_devices():
    """Theorem B bounds the period from below, too, so that a certificate names T_min and the devices' bounds."""
    loop = change(KNOWN, T_max=1.2e-3, T_min=0.8e-3)
    own = [*covered(loop, prove(loop, SOFT, condition(KnownDevice, Less(0.0))))]
    assert own == [*covered(loop, prove(loop, SOFT, KNOWN_DEVICE))]
    assert "from 0.8 to 1.2 ms" in own[0]


@pytest.mark.slow
@pytest.mark.parametrize(("shipped", "fact"), checkered((KNOWN_DEVICE, KNOWN_DEVICE_ANY), FACTS))
def test_known_devices_keep_an_own_fact(shipped, fact):
    """At constant speed Theorem B's L <= s delta dx^2/T bounds s from below; beta -> 0 bounds it from above."""
    own = condition(type(shipped), fact)
    needs, plain = required_damping(KNOWN, SOFT, own), required_damping(KNOWN, SOFT, shipped.plain)
    assert fact.less * KNOWN.T <= needs.required[0] * (1 + 1e-9)
    assert needs.required[0] <= (plain.required[0] + fact.less * KNOWN.T) * (1 + 1e-9)
    values, z = (1e-5, 1e-5, 0.0, 0.0, 0.0, 0.0), np.exp(1j * np.linspace(0.1, 3.0, 7))
    extra = tuple(u for each in fact.unknowns(KNOWN) for u in each.units)
    blocks = (own.demand(KNOWN, SOFT, multiplier=values + extra), shipped.demand(KNOWN, SOFT, multiplier=values))
    there, without = (block.free.at(z) for block in blocks)
    added = np.diag([-fact.less] * 2 + [0.0] * (without.shape[-1] - 2))
    np.testing.assert_allclose(there, without + added, rtol=0, atol=1e-9 * max(fact.less, np.abs(without).max()))


@pytest.mark.slow
def test_known_devices_take_their_plain_conditions_facts():
    own = type(
        "Own", (KnownDevice,), {"name": "own", "covers": ("psi",), "plain": condition(ThisEnvironment, FACTS[2])}
    )
    needs = required_damping(KNOWN, SOFT, own())
    assert needs.required[0] >= 1e6 * KNOWN.T


def test_maps_and_variations_keep_an_own_fact():
    scenario, K, B = load("omega-pair"), np.array([300.0, 4e3]), np.array([0.1, 1.0])
    extra = 20.0 * PAIR.T / PAIR.delta[0]
    for sweep in (
        CouplingSweep(scenario.device, scenario.population, PAIR, own=Twenty()),
        EnvironmentSweep(scenario.device, scenario.population, PAIR, SOFT, own=Twenty()),
    ):
        plain = sweep.ratios("this-environment", K, B)
        np.testing.assert_allclose(sweep.ratios("twenty", K, B), plain + extra, rtol=1e-6)
    nearby, plain = (
        robustness_nearby(PAIR, SOFT, each).required_over_available for each in (Twenty(), ThisEnvironment())
    )
    assert nearby == pytest.approx(plain + extra, rel=1e-6)
    ranges = load("omega-pair-ranges").loop("I")
    needs, plain = (required_damping(ranges, SOFT, each).ratio for each in (Twenty(), "this-environment"))
    assert needs == pytest.approx(plain + 20.0 * ranges.T / ranges.delta[0], rel=1e-8)


def test_a_file_proves_its_own_fact(tmp_path, capsys):
    """A proof without the fact is refused: the +20 T of damping is in the figures and in the block."""
    delta = required_damping(PAIR, SOFT, "this-environment").required[0] + 10.0 * PAIR.T
    loop = change(PAIR, delta=(delta, delta))  # enough without the fact, too little with it
    right = Stored.of(PAIR, SOFT, prove(PAIR, SOFT, Twenty()))
    assert right.certificate
    shipped = prove(loop, SOFT, "this-environment")
    required = required_damping(loop, SOFT, Twenty())
    assert not required.certified
    claims = {"condition": "twenty", "required": required.required, "margin": 1 / required.ratio}
    forged = Stored.of(loop, SOFT, sealed(change(shipped, **claims)))
    assert verify(right, Twenty()).proved
    assert not verify(forged, Twenty()).proved
    own = prove(PAIR, SOFT, condition(ThisEnvironment, Less(0.0)))
    assert "the sweep finds" in str(verify(Stored.of(PAIR, SOFT, own), condition(ThisEnvironment, Less(20.0))).reason)
    words = ["--condition", f"{__file__}:Twenty"]
    for file, code in ((right, 0), (forged, 1)):
        save(file, path := tmp_path / "coupling.json")
        assert check.main([str(path), *words]) == code
    capsys.readouterr()


def test_any_environment_refuses_facts_behind_delay():
    reason = required_damping(change(PAIR, psi=(1, 0)), SOFT, condition(type(ANY_ENVIRONMENT), Less(0.0))).reason
    assert "facts of your own" in str(reason)


def test_equal_multiplier_names_are_refused():
    loop = PAIR.switching(PAIR.delays)
    twice = type("Twice", (SwitchingDelays,), {"name": "twice", "covers": ("varying_delay",), "facts": _twice})()
    assert "two multipliers have one name" in str(required_damping(loop, SOFT, twice).reason)


def _twice(self, loop):
    return Switching(), Switching()


# What a verdict states if the user's own condition judges the loop.


class Nothing(Condition):
    name = "nothing"

    def demand(self, loop, coupling, exact=False):
        one = constant_like(loop.F(coupling, exact), np.eye(loop.channels, dtype=int))
        return Demand(one, one)


class Anything(Nothing):
    name = "anything"

    def guarantee(self, loop):
        return ANY


def test_the_first_line_names_an_own_condition():
    """any-environment certifies SOFT, but it leaves out the fact, so that it gives neither guarantee nor limiter."""
    for own, coupling in ((Twenty(), SOFT), (Nothing(), STIFF)):
        assessment = assess(PAIR, coupling, condition=own).within((12.0, 12.0))
        stated = assessment.guarantee
        assert stated
        assert (stated.condition, stated.environments, stated.forces) == (own.name, HERE, BELOW_LIMITS)
        assert assessment.force_limits.rho is None
        first = re.sub(r"\[.*?\]", "", verdict(assessment))
        assert first.startswith(f"Stable by the condition {own.name} of {Path(__file__).name}, which is your own, for")
        assert "your own" in stated.words
    assert assess(PAIR, SOFT).guarantee.any_environment


def test_only_an_own_condition_gives_its_guarantee():
    fails = assess(PAIR, SOFT, condition=condition(ThisEnvironment, Less(1e6)))
    assert fails.requirements["any-environment"].certified
    assert (fails.guarantee, fails.holds) == (None, False)
    assert str(fails.reason).endswith("(own)")


def test_no_friction_covers_steps_with_own_facts():
    scenario = load("omega-pair")
    steps = [encoder_steps(scenario, "I", assess(PAIR, SOFT, condition=own), [1e-9] * 2) for own in (None, Twenty())]
    assert [each is not None and each.friction_needed is None for each in steps] == [False, True]


def test_accounts_refuse_own_conditions_of_one_environment():
    assert assess(PAIR, SOFT, energy_budget=1e-3).guarantee
    assert assess(PAIR, SOFT, condition=Twenty(), energy_budget=1e-3).guarantee is None
    assert assess(PAIR, SOFT, environment=lambda u: u).guarantee.own is None
    here, anywhere = (assess(PAIR, SOFT, condition=own, environment=lambda u: u) for own in (Nothing(), Anything()))
    assert f"nothing holds in {HERE}" in here.reason
    assert anywhere.guarantee.condition == "anything"


@pytest.mark.validate
def test_ranges_are_judged_by_an_own_condition():
    loop = load("omega-pair-ranges").loop("I")
    soft = SpringDamper([200.0] * 2, [0.5] * 2)
    own = assess(loop, soft, condition=Twenty(), ranges_samples=2)
    assert (own.guarantee.environments, own.guarantee.condition) == (RANGES, "twenty")
    extra = 20.0 * loop.T / loop.delta[0]
    assert own.ranges.worst[1].ratio == pytest.approx(
        assess(loop, soft, ranges_samples=2).ranges.worst[1].ratio + extra
    )
    assert certify(loop, soft, Twenty())["twenty"].ratio == pytest.approx(own.ranges.worst_found[1].ratio, rel=1e-6)
    other = assess(loop, soft, condition=Nothing(), ranges_samples=2)
    assert not other.holds
    assert "ranges" in verdict(other)
    assert not certify(loop, soft, Nothing())["nothing"].certified


def test_certify_refuses_switching_for_an_own_condition():
    loop = PAIR.switching(DelayRange(PAIR.theta, tuple(n + 1 for n in PAIR.theta)))
    assert "varying_delay" in str(certify(loop, SOFT, Twenty())["twenty"].reason)


@pytest.mark.parametrize(
    ("loop", "base", "shipped"),
    [
        pytest.param(PAIR, LimitedForces, LIMITER, id="plain"),
        pytest.param(KNOWN, LimitedKnownDevice, LimitedKnownDevice(), id="known-device", marks=pytest.mark.validate),
    ],
)
def test_an_own_limiter_counts_once_it_is_proved(loop, base, shipped):
    own = condition(base, Less(0.0))
    assessment = assess(loop, SOFT, condition=own).within((12.0, 12.0))
    assert assessment.force_limits.rho == LIMITER.rho(loop)
    assert assessment.force_limits.proved
    assert assessment.decisive.ratio == pytest.approx(required_damping(loop, SOFT, shipped).ratio, rel=1e-6)
    certificate = prove(loop, SOFT, own)
    assert (certificate.condition, certificate.facts) == ("own", ("limiter",))
    assert verify(Stored.of(loop, SOFT, certificate), own).proved
    rho = certificate.multipliers | {"rho": tuple(2 * r for r in certificate.multipliers["rho"])}
    assert not verify(Stored.of(loop, SOFT, sealed(change(certificate, multipliers=rho))), own).proved


def test_certify_takes_own_conditions_only():
    """A name would be ignored, because the result has all conditions that have a name."""
    loop = load().loop("I")
    with pytest.raises(TypeError, match=r"^condition is 'foo' \(str\), expected your own Condition"):
        certify(loop, SOFT, "foo")
