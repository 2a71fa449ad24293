"""Tests of an assessment's guarantee: which loops, couplings and forces it covers, and which changes end it."""

from functools import cache

import msgspec
import pytest
from evaluate import reported
from shared import ONE_MASS

from haptic_loop.cli.audit import main as audit
from haptic_loop.cli.compare import main as compare
from haptic_loop.cli.run import main as run
from haptic_loop.cli.validate import main as validate
from haptic_loop.cli.verdict import verdict
from haptic_loop.controller.coupling import NoCoupling, SpringDamper
from haptic_loop.controller.delay import VaryingDelay
from haptic_loop.controller.environment import GROUND, RIGID_WALL, Network, Spring
from haptic_loop.controller.loop import DelayRange, DeviceBounds, Loop
from haptic_loop.controller.ranges import Ranges
from haptic_loop.design import assessment as assessment_module
from haptic_loop.design import budgets
from haptic_loop.design import compare as comparison
from haptic_loop.design.assessment import assess
from haptic_loop.design.certificate import prove, required_damping
from haptic_loop.design.coupling_file import Stored, digest, save, sealed
from haptic_loop.design.coverage import ranges_around
from haptic_loop.design.environments import LIMITER, THIS_ENVIRONMENT, ThisEnvironment
from haptic_loop.design.result import HERE, RANGES, Chosen, Design, NotProved, listed
from haptic_loop.design.worst_member import search_ranges
from haptic_loop.sim.api import simulate
from haptic_loop.sim.couplings import assessed, given
from haptic_loop.sim.scenario import load, parse
from tests.evaluate import needs, safe_with

ONE = parse(ONE_MASS)
LOOP = ONE.loop("I")
SOFT = SpringDamper([800.0, 500.0], [0.3, 0.3])  # certified in the default loop for any environment
HERE_ONLY = SpringDamper([2100.0], [1.0])  # this-environment needs 97 % of LOOP's damping
change = msgspec.structs.replace


@cache
def on_its_own_loop():
    return assess(LOOP, HERE_ONLY)


@cache
def proved_here():
    return prove(LOOP, HERE_ONLY, "this-environment")


@pytest.mark.parametrize(
    "changes",
    [
        {"delta": (1.2,)},
        {"theta": (4,)},
        {"T_max": 1.5e-3},
        {"psi": (1,)},
        {"latency": ((0.0, 1e-3),)},
        {"varying_delay": DelayRange((1,), (3,))},
        {"environment": Network(("contact 1",), (Spring(("contact 1", GROUND), 9000.0),))},
    ],
    ids=str,
)
def test_another_loop_loses_the_guarantee(changes):
    assert on_its_own_loop().guarantee.environments == HERE
    elsewhere = assess(change(LOOP, **changes), HERE_ONLY, certificate=proved_here())
    assert elsewhere.guarantee is None
    assert elsewhere.reason


def test_an_energy_account_covers_no_latency():
    """A hand that moves only before forces latch takes energy from the previous force, which no account counts."""
    assert assess(LOOP, HERE_ONLY, energy_budget=0.1).guarantee.condition == "energy-budget"
    late = change(LOOP, latency=((0.0, 2e-4),))
    for accounted in ({"energy_budget": 0.1}, {"environment": lambda x: -100 * x}):
        assessment = assess(late, HERE_ONLY, **accounted)
        assert assessment.guarantee is None
        assert assessment.reason.startswith("latency")


@pytest.mark.slow
def test_the_limiter_is_judged_with_switching_delays():
    """The limiter needs 0.70 of the damping with constant delays, and 1.04 with delays that switch."""
    loop, coupling = load().loop("I").switching(DelayRange((1, 2), (2, 3))), SpringDamper((970.0, 970.0), (0.4, 0.4))
    limits = assess(loop, coupling, environment=loop.environment).force_limits
    assert limits.rho is None
    assert limits.requirement.ratio > 1


def test_another_coupling_does_not_inherit_a_certificate():
    stiffer = HERE_ONLY.scaled(stiffness=1.2)
    assert assess(LOOP, stiffer, certificate=proved_here()).guarantee is None


def test_a_forged_certificate_proves_nothing():
    stiffer = HERE_ONLY.scaled(stiffness=1.2)
    forged = sealed(change(proved_here(), scenario=digest(LOOP, stiffer.form())))
    assessment = assess(LOOP, stiffer, certificate=forged)
    assert (assessment.guarantee, assessment.certificate) == (None, None)


def test_a_guarantee_says_whether_limited_forces_are_covered():
    limited, clipped = on_its_own_loop(), assess(LOOP, HERE_ONLY, limiter=False)
    assert limited.force_limits.rho is not None
    assert "limiter" in limited.facts
    assert clipped.force_limits.rho is None
    assert limited.guarantee.forces != clipped.guarantee.forces
    assert "below" in clipped.guarantee.forces


def test_reports_say_whether_limited_forces_are_covered():
    scenario = load()
    loop, coupling = scenario.loop("I"), SpringDamper([600.0, 400.0], [0.5, 0.5])
    clipped = assess(loop, coupling, limiter=False).within((12.0, 12.0))
    limited = assess(loop, coupling).within((12.0, 12.0))
    ends = "Only while forces stay below their limits."
    assert ends in verdict(clipped)
    assert ends not in verdict(limited)
    assert "Not certified" not in verdict(limited)
    assert "proved, also while forces are limited" in limited.force_limits.words
    lost = limited.without_guarantee("a packet is lost")
    assert lost.force_limits.words == "limited to 12 N, without a guarantee"
    unstable = assess(loop, SpringDamper([1e5, 1e5], [0.0, 0.0])).within((12.0, 12.0))
    assert unstable.force_limits.words == "clipped to 12 N, without a guarantee"


def test_reports_name_no_force_if_none_is_declared():
    covered, clipped = on_its_own_loop().force_limits, assess(LOOP, HERE_ONLY, limiter=False).force_limits
    assert covered.words == covered.part()["words"] == "proved, also while forces are limited"
    assert clipped.words.startswith("clipped: a guarantee holds while forces stay below their limits")
    accounts = [assess(LOOP, HERE_ONLY, energy_budget=0.1, limiter=limiter).force_limits for limiter in (None, False)]
    assert [limits.words.split(",")[0] for limits in accounts] == ["limited", "clipped"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"energy_budget": -1}, "energy_budget is -1 J, expected a finite energy"),
        ({"energy_budget": float("nan")}, "energy_budget is nan J"),
        ({"energy_budget": "lots"}, "energy_budget is 'lots' (str)"),
        ({"ranges_seed": -1}, "ranges_seed is -1, allowed are 0 or more"),
        ({"ranges_samples": 0.5}, "ranges_samples is 0.5 (float)"),
        ({"environment": 3}, "environment is 3 (int), expected"),
        ({"certificate": 3}, "certificate is 3 (int), expected"),
        ({"condition": 3}, "condition is 3 (int), expected"),
        ({"band_hz": (3, 1)}, "band_hz is [3, 1], expected two rising frequencies in Hz"),
        ({"band_hz": (5000, 6000)}, "band_hz is [5000, 6000]"),
        ({"band_hz": 3}, "band_hz is 3 (int)"),
    ],
)
def test_impossible_arguments_are_named(arguments, message):
    with pytest.raises((TypeError, ValueError)) as refused:
        assess(LOOP, HERE_ONLY, **arguments)
    assert message in str(refused.value)


def test_a_users_condition_must_name_switching_delays():
    """A condition whose `covers` does not name switching delays is refused, and the rho that it gives is not used."""

    class Own(ThisEnvironment):
        name = "own"

        def limiter_rho(self, loop):
            return (0.0,) * loop.channels

    switching = change(LOOP, varying_delay=DelayRange((2,), (3,)), delta=(1.4 * 1.37,))
    assessment = assess(switching, HERE_ONLY, condition=Own())
    assert "varying_delay" in assessment.decisive.reason
    assert (assessment.holds, assessment.force_limits.rho) == (False, None)


@pytest.mark.slow
def test_a_guarantee_names_its_limiters_known_devices():
    """This-environment needs 0.991 of the available damping, and 1.005 of it if forces are limited.

    So its limiter is not certified, and the limiter of the condition known-device is used and proved.
    """
    bounds = DeviceBounds(0.1, 2000.0, 0.5, 2.0)
    loop = change(LOOP, delta=(0.98 * 1.37,), known_devices=(bounds,))
    limited = assess(loop, HERE_ONLY)
    assert (limited.guarantee.condition, limited.force_limits.bounded) == ("this-environment", True)
    assert "devices with at least 100 g" in limited.guarantee.hands


@pytest.mark.slow
def test_limited_forces_are_not_searched_between_vertices():
    """With the multiplier for a mass of 3 kg, the limiter needs 0.9848 times 1.37 N s/m, and 0.03 % more at 0.2 kg."""
    springs = (LOOP.environment.springs[0], change(LOOP.environment.springs[1], stiffness=700.0))
    network = change(LOOP.environment, masses={"mass": 3.0}, springs=springs)
    loop = change(LOOP, environment=network, ranges=Ranges(masses={"mass": (0.02, 3.0)}), delta=(0.985 * 1.37,))
    limits = assess(loop, HERE_ONLY, ranges_samples=0)
    between = loop.at(change(network, masses={"mass": 0.2}))
    assert limits.force_limits.requirement.certified
    assert not required_damping(between, HERE_ONLY, LIMITER, limits.force_limits.requirement.multiplier).certified
    assert limits.guarantee.environments == RANGES
    assert limits.guarantee.forces == "also while they are limited, in this environment"


def test_one_environment_covers_no_ranges():
    """In units of 1.37 N s/m the device has 0.973; the nominal mass of 1 kg needs 0.9713, and 0.1 kg needs 0.9735."""
    loop = change(LOOP, ranges=Ranges(masses={"mass": (0.02, 3.0)}), delta=(0.973 * 1.37,))
    nominal = assess(loop, HERE_ONLY, ranges_samples=0, limiter=False)
    assert (nominal.ranges.proved, nominal.holds) == (False, False)
    assert (nominal.guarantee.environments, nominal.guarantee.facts) == (HERE, ())


def test_a_sweep_of_limited_forces_is_no_proof():
    """A B of 130 decimals has too many digits for a proof: any-environment, which covers the limiter, is only swept."""
    loop = change(LOOP, theta=(0,), lam=(0,))
    for B, proof in ((0.01, "rational"), (1e-130, "sampled")):
        assessment = assess(loop, SpringDamper([100.0], [B])).within((12.0,))
        limits = assessment.force_limits
        assert assessment.requirements["any-environment"].proof == assessment.guarantee.proof == proof
        assert limits.rho == (0.0,)
        assert limits.proved == (proof == "rational")
        assert limits.words.startswith("proved") == (proof == "rational")
        assert ("without an exact proof" in verdict(assessment)) == (proof == "sampled")


def test_a_swept_limiter_makes_the_guarantee_sampled(monkeypatch):
    """The loop without limiter is proved, but the limiter is only swept, so the guarantee rests on a sweep."""

    def refuse(*args, **kwargs):
        raise NotProved("a proof takes long")

    monkeypatch.setattr(assessment_module, "prove", refuse)
    swept = assess(LOOP, HERE_ONLY).within((12.0,))
    assert swept.requirements["this-environment"].proof == "rational"
    assert (swept.guarantee.proof, swept.force_limits.proved) == ("sampled", False)
    assert "without an exact proof" in verdict(swept)
    assert assess(LOOP, HERE_ONLY, limiter=False).guarantee.proof == "rational"


@pytest.mark.parametrize("wrong", [((0.0,),), ((4.0,),), ((0.7,), (0.7,))])
def test_wrong_multipliers_of_a_limiter_are_replaced(wrong):
    """Multipliers 0 and 4 do not certify this coupling with limited forces; two multipliers fit two devices only."""
    right, none = ((0.75,),), None
    c = [assess(LOOP, Chosen(HERE_ONLY, "this-environment", c=c)).force_limits.c for c in (right, wrong, none)]
    assert c[0] == right
    assert c[1] == c[2]


@pytest.mark.slow
def test_a_stored_limiter_proof_covers_no_longer_delay():
    """The stored proof is for a delay of 1 sample. With 801 samples the loop has too many states for a proof."""
    loop = Loop(1e-3, (1,), (0,), (0,), (1.5,), Network(("a",), (Spring(("a", GROUND), 300.0),)))
    coupling = SpringDamper([1.0], [0.01])
    on_file = Chosen(coupling, "this-environment", limiter=prove(loop, coupling, LIMITER))
    longer = assess(change(loop, theta=(801,)), on_file).within((4.0,))
    assert longer.requirements["this-environment"].certified
    assert (longer.guarantee.proof, longer.force_limits.proved) == ("sampled", False)
    assert assess(loop, on_file).force_limits.proved


def test_lost_packets_end_the_guarantee():
    scenario = load("omega-pair")
    varying = {"lo": (1, 2), "hi": (1, 2), "pattern": "random", "loss": 0.1}
    lossy = scenario.replace(varying_delay=VaryingDelay(**varying))
    chosen = given(SOFT)
    assert assessed(scenario, "I", chosen).guarantee
    assert assessed(lossy, "I", chosen).guarantee is None


# The shell: the passivity layer around a user's own environment.


def spring(u):
    return 300.0 * u


@pytest.mark.parametrize(
    ("changes", "coupling", "holds"),
    [
        ({}, SOFT, True),
        ({}, SpringDamper([7000.0, 2900.0], [0.42, 1.69]), False),  # certified in this environment only
        ({"psi": (1, 1)}, SOFT, False),
        ({"theta": (3, 4)}, SOFT, False),
        ({"T_max": 3e-3}, SOFT, False),
    ],
    ids=str,
)
def test_the_shell_needs_a_coupling_for_any_environment(changes, coupling, holds):
    scenario = load("omega-pair").replace(duration=0.1, **changes)
    meta = simulate(scenario, coupling, "exact", environment=spring, energy_budget=0.1).meta
    guarantee, words = meta["assessment"]["guarantee"], meta["energy_budget"]["guarantee"]
    assert (guarantee is not None) == holds
    assert words.startswith("no guarantee: ") != holds
    if holds:
        assert (guarantee["energy_J"], guarantee["condition"]) == (0.1, "any-environment")
    else:
        assert meta["assessment"]["reason"] in words


def test_a_budgeted_run_guarantees_its_budget():
    """The certificate does not cover forces that the budget scales, so the guarantee is that of the budget."""
    meta = simulate(ONE.replace(duration=0.1), HERE_ONLY, "exact", energy_budget=0.02).meta
    guarantee = meta["assessment"]["guarantee"]
    assert (guarantee["condition"], guarantee["energy_J"]) == ("energy-budget", 0.02)
    assert meta["energy_budget"]["guarantee"] == guarantee["words"]


# The commands.


@pytest.fixture
def stored(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    save(Stored.of(LOOP, HERE_ONLY, proved_here()), "own.json")
    (tmp_path / "one.toml").write_text(ONE_MASS)


_COMMANDS = {  # a command, its options, and an option that changes the loop
    "audit": (audit, ["--coupling", "own.json"], ["--delta", "1.2"]),
    "run": (run, ["--coupling", "own.json", "--duration", "0.1", "--no-plot"], ["--psi", "1"]),
    "validate": (
        validate,
        ["--coupling", "own.json", "--humans", "2", "--duration", "0", "--no-plot"],
        ["--delta", "1.2"],
    ),
}


@pytest.mark.usefixtures("stored")
@pytest.mark.parametrize("name", ["audit", "run", pytest.param("validate", marks=pytest.mark.slow)])
def test_a_command_claims_nothing_in_another_loop(name, tmp_path):
    main, words, elsewhere = _COMMANDS[name]

    def report(*more):
        return reported(main, tmp_path, *words, *more, "--scenario", "one.toml", "--out", str(tmp_path / "out"))[1]

    assert safe_with(report()) == HERE
    there = report(*elsewhere)
    assert safe_with(there) is None
    assert not there["assessment"]["holds"]
    assert there["assessment"]["reason"]


# At one wall every command reports the damping for making and breaking contact, not that for permanent contact.


@pytest.mark.slow
@pytest.mark.parametrize("every", [False, pytest.param(True, marks=pytest.mark.validate)])
def test_commands_agree_on_the_requirement_of_a_wall(tmp_path, monkeypatch, every):
    monkeypatch.chdir(tmp_path)
    coupling = SpringDamper([1200.0], [0.5])
    scenario = load("one-wall")
    loop = scenario.loop("I")
    expected = assess(loop, coupling).requirements["this-environment"].required
    frozen = [required_damping(state, coupling, "this-environment").required[0] for state in loop.frozen()]
    assert expected[0] > 1.01 * max(frozen)
    save(Stored.of(loop, coupling), "wall.json")
    words = ["--scenario", "one-wall", "--coupling", "wall.json", "--out", "out"]
    quick = ["--duration", "0.1", "--no-plot"]
    for command, more in ((run, quick), (validate, [*quick, "--humans", "2"]), (audit, []))[: 3 if every else 2]:
        _, report = reported(command, tmp_path, *words, *more)
        assert needs(report, "this-environment")["required_damping"] == pytest.approx(expected, rel=1e-9)
    if every:
        (compared,) = reported(compare, tmp_path, *words, "--no-plot")[1]["couplings"]
        assert needs(compared, "this-environment")["required_damping"] == pytest.approx(expected, rel=1e-9)
    judged = comparison.judge(loop, coupling)
    assert judged.requirements["this-environment"].required == pytest.approx(expected, rel=1e-9)


@pytest.mark.slow
def test_switching_delays_need_more_damping_at_walls():
    """A coupling that is certified for a constant delay is not certified for delays of 0 to 2 samples."""
    loop, coupling = load("one-wall").loop("I"), SpringDamper([1200.0], [0.5])
    assert assess(loop, coupling).holds
    switching = assess(change(loop, varying_delay=DelayRange((0,), (2,))), coupling)
    assert not switching.holds


def test_guarantees_name_the_environment_that_runs():
    """Two samples late, a rigid wall behind 50,000 N/m needs 5/2 K T = 125 N s/m. The spring that runs is soft."""
    rigid = Loop(1e-3, (1,), (0,), (0,), (1.37,), RIGID_WALL, varying_delay=DelayRange((1,), (2,)))
    soft = Network(("tip",), (Spring(("tip", GROUND), 500.0),))
    coupling = SpringDamper([50_000.0], [0.0])
    assert assess(rigid, coupling).guarantee is None
    assert assess(rigid, coupling, environment=soft).guarantee.environments == HERE
    assert assess(rigid.at(soft), SpringDamper([400.0], [0.0]), environment=RIGID_WALL).guarantee.environments != HERE


SPRING = Network(("tip",), (Spring(("tip", GROUND), 500.0),))
ALONE = Loop(1.2e-3, (1,), (0,), (0,), (1.37,), SPRING)
FEW_TRIALS = (
    ("RANGE_ALONG", (2, 2)),
    ("RANGE_DRAWN", 0),
    ("RANGE_STARTS", 1),
)  # This makes the search between vertices short.


@pytest.mark.slow
def test_a_search_of_other_ranges_is_repeated(monkeypatch):
    """A bare spring k needs 3/2 k T: 0.66 of the damping for 505 N/m (1 % more), 0.92 for 700 N/m (40 % more)."""
    for name, few in FEW_TRIALS:
        monkeypatch.setattr(budgets, name, few)
    narrow, wide = (change(ALONE, ranges=ranges_around(SPRING, percent)) for percent in (1.0, 40.0))
    needs, searched = THIS_ENVIRONMENT.required(narrow, NoCoupling()), search_ranges(narrow, NoCoupling())
    proof = prove(narrow, NoCoupling(), THIS_ENVIRONMENT)
    design = Design(NoCoupling(), needs.condition, "stiffness", 1.0, needs, certificate=proof, searched=searched)
    assert assess(narrow, design).ranges.searched is searched
    most = assess(wide, design).ranges.searched.worst[0].ratio
    assert most == pytest.approx(1.5 * 700.0 * 1.2e-3 / 1.37, rel=1e-6)


@pytest.mark.slow
def test_a_search_of_another_condition_is_repeated(monkeypatch):
    """Known-device judges these ranges, but the search that is passed in was for this-environment."""
    for name, few in FEW_TRIALS:
        monkeypatch.setattr(budgets, name, few)
    bounds = (DeviceBounds(0.06, 14500.0, 0.5, 0.5),)
    loop = change(ALONE, ranges=ranges_around(SPRING, 10.0), known_devices=bounds)
    searched, proof = search_ranges(loop, NoCoupling()), prove(loop, NoCoupling(), THIS_ENVIRONMENT)
    chosen = Chosen(NoCoupling(), "known-device", certificate=proof, searched=searched)
    assessed = assess(loop, chosen, ranges_samples=0)
    assert assessed.ranges.worst[1].condition == "known-device"
    assert assessed.ranges.searched is not searched


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ((1.37, 1.37, 1.37), "1.37"),
        ((1.37, 1.37), "1.37, 1.37"),
        ((1.37, 1.37, 1.36), "1.37, 1.37, 1.36"),
        ((-0.0,), "0"),
    ],
)
def test_three_equal_dampings_print_once(values, text):
    assert listed(values, once=True) == text


def test_couplings_of_other_channels_are_refused():
    for count in (1, 3):
        gains = [500.0] * count
        with pytest.raises(ValueError, match=rf"K has {count} entries, the environment has 2 contacts"):
            assess(load("omega-pair").loop("I"), SpringDamper(gains, gains))
