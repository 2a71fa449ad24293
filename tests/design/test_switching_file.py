"""Tests for coupling files that prove any switching of the delays: stored, verified, tampered with, used elsewhere."""

import json
import re
from itertools import product

import msgspec
import numpy as np
import pytest
from evaluate import switching_demand, switching_sweep, this_environment
from shared import DELTA, FIGURE_4, PAIR, SOFT, STIFF, T, environment_by_hand, force_map, undelayed_map

from haptic_loop import certify
from haptic_loop.cli.audit import main as audit_main
from haptic_loop.cli.check import main as check_main
from haptic_loop.cli.design import main as design_main
from haptic_loop.cli.run import main as run_main
from haptic_loop.cli.validate import main as validate_main
from haptic_loop.controller import coupling as built
from haptic_loop.controller.coupling import SpringDamper
from haptic_loop.controller.delay import LOST, VaryingDelay, ages
from haptic_loop.controller.environment import environment
from haptic_loop.controller.loop import DelayRange, Loop
from haptic_loop.controller.lti import Lti, Sampled
from haptic_loop.controller.ranges import Ranges, UncertainSpring, inside
from haptic_loop.design import budgets
from haptic_loop.design.assessment import assess
from haptic_loop.design.certificate import prove, required_damping, verify
from haptic_loop.design.coupling_file import Certificate, Stored, digest, load, save, sealed
from haptic_loop.design.environments import SWITCHING
from haptic_loop.design.exact import _Matrix
from haptic_loop.design.files import InputError
from haptic_loop.design.frequency import hermitian
from haptic_loop.design.result import RANGES, NotProved, switching_guarantee
from haptic_loop.hw.control import CouplingRequest, certified_couplings
from haptic_loop.models.scene import Crowd, variants
from haptic_loop.sim.couplings import from_file
from haptic_loop.sim.run import assemble
from haptic_loop.sim.scenario import load as scenario_of
from haptic_loop.sim.switching import switched_crowd

RANGE = DelayRange((1, 1), (2, 2))
WITHIN = switching_guarantee(RANGE)
LOOP = PAIR.switching(RANGE)
change = msgspec.structs.replace


@pytest.fixture(scope="module")
def stored() -> Stored:
    return Stored.of(LOOP, SOFT, prove(LOOP, SOFT, "this-environment"))


@pytest.fixture
def file(stored, tmp_path) -> str:
    save(stored, tmp_path / "proof.json")
    return str(tmp_path / "proof.json")


@pytest.fixture
def constant_file(tmp_path) -> str:
    save(Stored.of(PAIR, STIFF, prove(PAIR, STIFF, "this-environment")), tmp_path / "constant.json")
    return str(tmp_path / "constant.json")


# the proof


def test_a_stored_proof_is_verified_after_loading(stored, file):
    read = load(file)
    assert read == stored
    assert verify(read).proved
    proof = read.certificate
    assert (proof.condition, proof.facts) == ("this-environment", ("switching",))
    assert proof.required == pytest.approx(switching_sweep(undelayed_map(SOFT), *[(1, 1), (2, 2)], DELTA).required)
    assert 1.07 < proof.required[0] < 1.08
    assert proof.margin == pytest.approx(1.37 / proof.required[0])


def test_stored_multipliers_pass_a_dense_sweep(stored):
    """The stored alpha and P satisfy the condition at 20000 frequencies and the KYP inequality in floating point."""
    proof = stored.certificate
    z = np.exp(1j * np.geomspace(1e-4, np.pi, 20_000))
    demand = switching_demand(
        Sampled.of(undelayed_map(SOFT), z[None]), (1, 1), (2, 2), DELTA, proof.multipliers["alpha"]
    )
    assert np.linalg.eigvalsh(hermitian(demand.free.G + demand.gain.G)).min() > 0
    G = exact_block(LOOP, SOFT, proof.multipliers["alpha"])
    F, S = G.floats(), _Matrix.of(proof.matrices["P"]).floats()
    A, B, C, D = F.A, F.B, F.C, F.D
    kyp = np.block([[S - A.T @ S @ A, (C - B.T @ S @ A).T], [C - B.T @ S @ A, D + D.T - B.T @ S @ B]])
    scale = 1 / np.sqrt(np.diag(kyp))
    assert np.linalg.eigvalsh(scale[:, None] * kyp * scale).min() > 0


@pytest.mark.parametrize(("lo", "hi"), [((1, 2), (1, 2)), ((0, 1), (2, 4)), ((1, 2), (3, 2))])
def test_other_ranges_are_proved_too(lo, hi):
    soft = SpringDamper((300.0, 250.0), (0.3, 0.3))
    loop = PAIR.switching(DelayRange(lo, hi))
    stored = Stored.of(loop, soft, prove(loop, soft, "this-environment"))
    assert verify(stored).proved
    assert [a > 0 for a in stored.certificate.multipliers["alpha"]] == [a < b for a, b in zip(lo, hi, strict=True)]


@pytest.mark.parametrize("coupling", [SOFT, STIFF])
def test_constant_delays_in_range_need_no_more(coupling):
    """Constant delays need no more damping than switching, so a file that is proved for switching covers them."""
    switching = switching_sweep(undelayed_map(coupling), (1, 0), (2, 3), DELTA).ratio
    for theta in product((1, 2), (0, 1, 2, 3)):
        F = force_map(environment(FIGURE_4, T), coupling, theta, (0, 0))
        assert this_environment(F, DELTA).ratio <= switching * (1 + 1e-9)


def test_unsafe_switching_is_not_certified():
    assert prove(PAIR, STIFF, "this-environment").facts == ()
    with pytest.raises(NotProved, match=rf"^{re.escape(WITHIN)}: needs 2\.04"):
        prove(LOOP, STIFF, "this-environment")


def test_files_without_a_range_keep_their_digests():
    """The recorded digest does not depend on the fields of varying delays, which the loop lacks."""
    expected = "b8cae9c8ced7f5c0abcd4246af3ea609fa292b47b365d074618a2702234f644a"
    assert digest(PAIR, STIFF.form()) == expected
    assert digest(LOOP, STIFF.form()) != expected


# tampering


def test_a_changed_file_is_refused(stored):
    wider = change(LOOP, varying_delay=DelayRange((1, 1), (2, 3)))
    assert "digest differs" in verify(change(stored, loop=wider)).reason
    forged = change(stored, certificate=change(stored.certificate, multipliers={"alpha": (100.0, 100.0)}))
    assert "seal differs" in verify(forged).reason


def exact_block(loop, coupling, alpha) -> Lti:
    demand = SWITCHING.exact_demands(loop, coupling, alpha)["P"]
    return demand.free + demand.gain


def forged(stored: Stored, loop: Loop = LOOP, **fields) -> str:
    """Return why a changed file with repaired digest and seal is refused."""
    certificate = change(stored.certificate, scenario=digest(loop, SOFT.form()), **fields)
    verdict = verify(Stored.of(loop, SOFT, sealed(certificate)))
    assert not verdict.proved
    return verdict.reason


def test_repaired_digests_do_not_forge_a_proof(stored):
    P, alpha = stored.certificate.matrices["P"], stored.certificate.multipliers["alpha"]
    begins = f"{WITHIN}: "
    assert forged(stored, required=(1.0, 1.0)).startswith(f"{begins}required is [1.0, 1.0], the sweep finds [1.07")
    assert forged(stored, margin=2.0).startswith(f"{begins}margin is 2, the sweep finds 1.27")
    assert forged(stored, multipliers={"alpha": (0.0, alpha[1])}).startswith(f"{begins}alpha is [0.0")
    assert "the sweep finds" in forged(stored, multipliers={"alpha": (alpha[0] * 3, alpha[1])})
    assert forged(stored, matrices={"P": P[:-1]}).startswith(f"{begins}P has ")
    assert "not a rational number" in forged(stored, matrices={"P": (("1/0", *P[0][1:]), *P[1:])})
    negated = tuple(tuple(f"-{v}".replace("--", "") for v in row) for row in P)
    assert forged(stored, matrices={"P": negated}).startswith(begins)
    other = DelayRange((1, 1), (2, 3))
    assert forged(stored, LOOP.switching(other)).startswith(f"{switching_guarantee(other)}: required is")
    narrow = forged(stored, LOOP.switching(DelayRange((1, 2), (2, 2))))
    assert "positive number where the delay varies and 0 elsewhere" in narrow


def test_facts_must_match_the_range_of_delays(stored):
    bare = sealed(change(stored.certificate, facts=()))
    assert verify(change(stored, certificate=bare)).reason == "facts are [], expected ['switching']"
    smuggled = sealed(change(stored.certificate, scenario=digest(PAIR, SOFT.form())))
    assert "facts are ['switching'], expected []" in verify(Stored.of(PAIR, SOFT, smuggled)).reason


def test_negative_multipliers_are_refused():
    """A channel of constant delay has no second row with alpha, so a negative alpha would add damping for free."""
    loop = PAIR.switching(DelayRange((1, 2), (2, 2)))
    requirement = switching_sweep(undelayed_map(STIFF), (1, 2), (2, 2), DELTA)
    with pytest.raises(ValueError, match="expected a positive number where the delay varies and 0 elsewhere"):
        exact_block(loop, STIFF, (requirement.multiplier[0], -1e6))


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"lo": [2, 2], "hi": [1, 1]}, "expected 0 <= lo <= hi <= 1000 on every channel - at `$.loop.varying_delay`"),
        ({"lo": [1, 1, 1], "hi": [2, 2, 2]}, "varying_delay has 3 ranges for 2 channels"),
        ({"lo": [2, 2], "hi": [3, 3]}, "theta is [1, 2], outside of its varying_delay, [2, 3] samples"),
        ({"lo": [1, 1], "high": [2, 2]}, "unknown field `high`"),
    ],
)
def test_files_with_impossible_ranges_are_refused(file, tmp_path, fields, message):
    text = json.loads((tmp_path / "proof.json").read_text())
    text["loop"]["varying_delay"] = fields
    (tmp_path / "bad.json").write_text(json.dumps(text))
    with pytest.raises(InputError) as error:
        load(tmp_path / "bad.json")
    assert message in str(error.value)


# ranges of environments, whose members share one alpha

UNCERTAIN = Ranges((UncertainSpring(("mass", "contact 1"), (640.0, 840.0), absent=True),))
RANGED = change(LOOP, ranges=UNCERTAIN)


@pytest.fixture(scope="module")
def ranged() -> Certificate:
    return prove(RANGED, SOFT, "this-environment")


def test_one_alpha_serves_switching_at_every_vertex(ranged, tmp_path):
    """At the stored requirement the least eigenvalue by hand over 4000 frequencies is zero at the worst member only."""
    assert (ranged.facts, ranged.guarantee, len(ranged.matrices)) == (("switching", "ranges"), RANGES, 4)
    save(Stored.of(RANGED, SOFT, ranged), tmp_path / "ranges.json")
    assert verify(load(tmp_path / "ranges.json")).proved
    forged = sealed(change(ranged, facts=("switching",)))
    assert "facts are" in verify(Stored.of(RANGED, SOFT, forged)).reason
    z = np.exp(1j * np.geomspace(1e-3, np.pi, 4000))
    alpha, s, one = np.diag(ranged.multipliers["alpha"]), (1 - 1 / z) / T, np.eye(2)
    V = np.array([1 / (K + B * s) for K, B in zip(SOFT.K, SOFT.B, strict=True)]).T[:, :, None] * one
    least = []
    for member in RANGED.members():
        E = environment_by_hand(member.network, z)
        G = np.linalg.solve(one + E @ V, E)
        nominal = ((1 / z + 1 / z**2) / 2 / (z - 1))[:, None, None] * G
        error = np.conj(G).swapaxes(1, 2) @ np.linalg.inv(8 * alpha) @ G  # h^2/(2 alpha), h = 1/2
        free = (nominal + np.conj(nominal).swapaxes(1, 2)) / 2 - alpha / 2 - error
        least.append(np.linalg.eigvalsh(free + np.diag(ranged.required) / T)[:, 0].min())
    assert min(least) == pytest.approx(0, abs=1e-4 * 1.37 / T)
    assert sorted(least)[1] > 0


@pytest.mark.validate
def test_switching_over_ranges_is_guaranteed_for_ranges(ranged):
    assessment = assess(RANGED, SOFT, certificate=ranged, ranges_samples=0)
    assert assessment.holds
    assert (assessment.guarantee.environments, assessment.guarantee.facts) == (
        RANGES,
        ("switching", "ranges", "limiter"),
    )
    assert (
        assessment.requirements["switching"].ratio < ranged.required[0] / 1.37
    )  # This is for the nominal environment.
    less = change(RANGED, delta=(1.09, 1.09))
    assert required_damping(less, SOFT, "this-environment").ratio > 1


@pytest.mark.validate
def test_random_members_are_stable_under_worst_switching(ranged):
    """In a random member no motion of lossless hands grows under adversarial switching; with less damping it can."""
    rng = np.random.default_rng(1)
    links = np.exp(rng.uniform(np.log([0.01, 1.0, 10.0]), np.log([1.0, 1.001, 3000.0]), size=(12, 2, 1, 3)))
    links[..., 1] = 0.0
    growing = {1.0: 0, 0.5: 0}
    for member in inside(FIGURE_4, UNCERTAIN, 1, seed=4):
        for share in growing:
            scenario = scenario_of().replace(
                theta=(1, 1),
                environment=member.network,
                varying_delay=VaryingDelay((1, 1), (2, 2), "adversarial"),
                delta=tuple(share * d for d in ranged.required),
            )
            loop = assemble(scenario, SOFT)
            held_by = variants(scenario.device, Crowd(links))
            growing[share] += int((switched_crowd(loop, held_by, np.arange(12), 0, 2.0, None).exact > 0).sum())
    assert growing[1.0] == 0
    assert growing[0.5] > 0


# the commands


def reported(capsys, main, *options) -> tuple[int, dict]:
    capsys.readouterr()
    code = main([*options, "--json", "-"])
    return code, json.loads(capsys.readouterr().out)


@pytest.mark.slow
def test_check_names_the_guarantee_and_the_proof(stored, file, tmp_path, capsys):
    code, report = reported(capsys, check_main, file)
    assert (code, report["proved"]) == (0, True)
    assert report["switching"]["guarantee"] == f"{WITHIN}, in this environment"
    assert report["switching"]["proof"] == "rational"
    broken = sealed(change(stored.certificate, required=(1.0, 1.0)))
    save(change(stored, certificate=broken), tmp_path / "broken.json")
    code, report = reported(capsys, check_main, str(tmp_path / "broken.json"))
    assert (code, report["proved"]) == (1, False)
    assert report["switching"]["guarantee"] is report["switching"]["proof"] is report["proof"] is None
    assert report["reason"].startswith(f"{WITHIN}: required is")


@pytest.fixture
def run(tmp_path, capsys):
    quick = ["--engine", "exact", "--duration", "0.1", "--no-plot", "--out", str(tmp_path / "out")]

    def report(coupling: str, *options: str) -> dict:
        code, outcome = reported(capsys, run_main, "--coupling", coupling, *options, *quick)
        assert code == 0
        return outcome

    return report


def test_notes_compare_the_files_delays(stored):
    def notes(loop: Loop) -> tuple[str, ...]:
        return from_file(stored, loop).notes

    narrow, wide = DelayRange((1, 2), (2, 2)), DelayRange((0, 0), (3, 3))
    covers, only = f"the file proves {WITHIN}, which covers ", f"the file covers only {WITHIN}, so "
    assert notes(LOOP) == ()
    assert notes(change(PAIR, theta=(2, 1), lam=(1, 1))) == (covers + "the constant theta = [2, 1]",)
    assert notes(change(PAIR, theta=(2, 2))) == (covers + "the constant theta = [2, 2]",)
    assert notes(PAIR.switching(narrow)) == (covers + switching_guarantee(narrow),)
    assert notes(PAIR.switching(wide)) == (only + switching_guarantee(wide) + " are judged anew here",)
    (other,) = notes(change(LOOP, delta=(1.5, 1.5)))
    assert "another loop (different delta)" in other


@pytest.mark.slow
def test_a_run_says_what_the_file_covers(run, file):
    remark = f"the file proves {WITHIN}, which covers "
    narrow = run(file, "--varying-delay", "1-2,2-2")
    assert remark + switching_guarantee(DelayRange((1, 2), (2, 2))) in narrow["remarks"]
    assert narrow["varying_delay"]["on_file"] == {"lo": [1, 1], "hi": [2, 2]}


@pytest.mark.slow
def test_uncovered_loops_are_judged_anew(run, constant_file):
    plain = run(constant_file, "--varying-delay", "1,2")
    line = f"the file covers only constant delays, so {WITHIN} are judged anew here"
    assert line in plain["remarks"]
    assert not plain["varying_delay"]["covered"]
    # A playout buffer makes the delay (2, 2), for which these gains need 1.70 N s/m, more than the available 1.37.
    assert "the constant [2, 2], which no certificate covers either" in plain["varying_delay"]["covers"]


@pytest.mark.validate
def test_a_tampered_file_covers_nothing(run, stored, tmp_path):
    broken = sealed(change(stored.certificate, margin=9.0))
    save(change(stored, certificate=broken), tmp_path / "broken.json")
    outcome = run(str(tmp_path / "broken.json"), "--varying-delay", "1,2")
    assert any(f": {WITHIN}: margin is 9" in remark for remark in outcome["remarks"])
    assert outcome["varying_delay"]["on_file"] is None
    assert outcome["varying_delay"]["covered"]  # The run finds its own proof.
    assert "proved exactly" in outcome["varying_delay"]["covers"]


@pytest.mark.slow
def test_validate_and_audit_say_what_files_cover(file, constant_file, tmp_path, capsys):
    quick = ["--humans", "3", "--engine", "exact", "--duration", "0", "--no-plot", "--out", str(tmp_path / "v")]
    _, outcome = reported(capsys, validate_main, "--coupling", file, "--varying-delay", "1,2", *quick)
    assert f"proved in the coupling's file for {WITHIN}" in outcome["switching"]["covers"]
    code, outcome = reported(
        capsys, audit_main, "--coupling", constant_file, "--varying-delay", "1,2", "--out", str(tmp_path)
    )
    assert code == 1
    assert any("judged anew" in note for note in outcome["notes"])


@pytest.mark.slow
def test_without_proof_files_keep_constant_delays(tmp_path, capsys, monkeypatch):
    """The limit on states is below the switching model's order. The report says so; the file claims no switching."""
    monkeypatch.setattr(budgets, "PROOF_STATES", exact_block(LOOP, SOFT, (1.0, 1.0)).order - 1)
    out = str(tmp_path / "c.json")
    options = ["--condition", "this-environment", "--varying-delay", "1,2", "--out", out]
    code, outcome = reported(capsys, design_main, *options)
    assert code == 0
    assert outcome["switching"]["proof"] == "sampled"
    assert outcome["stored"]["proof"] == "rational"
    assert outcome["stored"]["switching"]["proof"] is None
    assert "states" in outcome["stored"]["switching"]["reason"]
    assert load(out).loop == PAIR
    assert verify(load(out)).proved


def test_ranges_without_theta_are_refused(tmp_path):
    options = ["--condition", "this-environment", "--varying-delay", "2,3", "--out", str(tmp_path / "c.json")]
    with pytest.raises(
        ValueError, match=r"--varying-delay: theta is \[1, 2\], outside of its varying_delay, \[2, 3\] samples"
    ):
        design_main(options)


# scripts and the bridge


def test_the_loop_has_the_scenarios_range():
    scenario = scenario_of().replace(varying_delay=VaryingDelay((1, 1), (2, 2)))
    assert scenario.loop("I") == LOOP
    for steady in (
        VaryingDelay((1, 1), (2, 2), "constant"),
        VaryingDelay((1, 2), (1, 2)),
        VaryingDelay((1, 2), (1, 2), loss=0.1),
    ):
        assert scenario.replace(varying_delay=steady).loop("I") == PAIR


def test_certify_judges_any_switching():
    coupling = built.SpringDamper(SOFT.K, SOFT.B)
    requirements = certify(LOOP, coupling)
    assert requirements["switching"].certified
    assert requirements["switching"].proof == "rational"
    assert requirements["this-environment"] == certify(PAIR, coupling)["this-environment"]
    assert "switching" not in certify(PAIR, coupling)


@pytest.mark.parametrize(
    ("K", "certified"),
    [pytest.param((2000.0, 1500.0), True, marks=pytest.mark.validate), ((7806.0, 3137.0), False)],
)
def test_certify_judges_every_vertex_of_the_ranges(K, certified):
    """The nominal environment alone would certify both couplings."""
    loop = change(PAIR, ranges=Ranges((UncertainSpring(("mass", "contact 1"), (640.0, 960.0), absent=True),)))
    coupling = built.SpringDamper(K, (0.105, 1.68))
    worst, nominal = certify(loop, coupling)["this-environment"], certify(PAIR, coupling)["this-environment"]
    at = [
        this_environment(force_map(environment(m.network, T), coupling, (1, 2), (0, 0)), DELTA) for m in loop.members()
    ]
    assert len(at) == 4
    assert worst.ratio == max(requirement.ratio for requirement in at)
    assert nominal.certified
    assert worst.ratio > nominal.ratio
    assert worst.certified == certified
    assert worst.proof == ("rational" if certified else "sampled")


@pytest.mark.slow
def test_the_bridge_reports_the_longest_hold(tmp_path):
    """The ages that the delay line computes for isolated missed answers lie within the range on file."""
    loop = change(LOOP, theta=(1, 1), lam=(1, 1))
    save(Stored.of(loop, SOFT, prove(loop, SOFT, "this-environment")), tmp_path / "one.json")
    scenario = scenario_of().replace(theta=(1, 1))
    # No reserve exists.
    (first,) = certified_couplings(CouplingRequest(scenario, name=str(tmp_path / "one.json")), 1, spare=1)
    (remark,) = first.remarks()
    assert "1 missed answer " in remark
    late = change(LOOP, theta=(2, 2), lam=(2, 2), varying_delay=DelayRange((2, 2), (2, 2)))
    save(Stored.of(late, SOFT, prove(late, SOFT, "this-environment")), tmp_path / "two.json")
    (early,) = certified_couplings(CouplingRequest(scenario, name=str(tmp_path / "two.json")), 1, spare=0)
    assert early.held == 0  # The delay of 1 sample lies below the range on file.
    missed = np.ones((40, 2, 1), dtype=np.int64)
    missed[5::3] = LOST
    met = ages(missed)[1:]
    assert RANGE.contains(DelayRange(tuple(met.min(axis=(0, 2))), tuple(met.max(axis=(0, 2)))))
    later = scenario.replace(theta=(2, 2))
    (second,) = certified_couplings(CouplingRequest(later, name=str(tmp_path / "one.json")), 2, spare=0)
    assert second.scenario.theta == (2, 2)
    assert second.remarks() == [f"the file proves {WITHIN}, which covers the constant theta = [2, 2]"]
    longer = change(LOOP, theta=(2, 2), varying_delay=DelayRange((2, 2), (3, 3)))
    held = required_damping(longer, SOFT, "this-environment")
    assert not held.certified
