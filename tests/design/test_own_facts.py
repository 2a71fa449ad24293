"""Tests of a user's own fact: no shortcut of a condition leaves it out, and the verdict names whose claim it is."""

import msgspec
import numpy as np
import pytest
from worlds import PAIR, SOFT

from haptic_loop import load
from haptic_loop.cli import check
from haptic_loop.controller.lti import numbers
from haptic_loop.design.certificate import prove, required_damping, verify
from haptic_loop.design.coupling_file import Stored, save, sealed
from haptic_loop.design.environments import ANY_ENVIRONMENT, SwitchingDelays, ThisEnvironment
from haptic_loop.design.facts import Fact, Switching, Unknowns
from haptic_loop.design.known_device import KNOWN_DEVICE, KNOWN_DEVICE_ANY, KnownDevice
from haptic_loop.design.robustness import robustness
from haptic_loop.sim.zwidth import CouplingSweep, EnvironmentSweep

change = msgspec.structs.replace
KNOWN = load("omega-pair-known").loop("I")


class Less(Fact):
    """Forces that return up to `less` dx^2/2 [N/m] more energy per tick, so that `less` T more damping is required."""

    def __init__(self, less):
        self.less = less

    def enter(self, block, loop, values):
        for i in range(loop.channels):
            dx = block.places["dx", i]
            block.term(dx, dx, numbers(-self.less, block.T))


class Searched(Less):
    """The same fact with a multiplier that it does not use."""

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
    assert own.required == pytest.approx([d + fact.less * PAIR.T for d in plain.required], rel=1e-8)


@pytest.mark.parametrize("fact", FACTS)
@pytest.mark.parametrize("shipped", [KNOWN_DEVICE, KNOWN_DEVICE_ANY])
def test_known_devices_keep_an_own_fact(shipped, fact):
    """With a constant speed L is at most s delta dx^2/T, which bounds the damping from below; beta -> 0 from above."""
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


def test_a_known_device_takes_facts_from_plain():
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
    nearby, plain = (robustness(PAIR, SOFT, each).required_over_available for each in (Twenty(), ThisEnvironment()))
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
