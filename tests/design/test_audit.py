"""Tests of `python -m design.audit`: closed forms, the paper's gains, edges of certification, JSON and bad calls."""

import json
import re
import subprocess
import sys
from functools import cache

import msgspec
import numpy as np
import pytest
from messages import says
from shared import FIGURE_4, PAIR, SOFT

from haptic_loop.cli.audit import main
from haptic_loop.cli.execute import execute
from haptic_loop.controller.coupling import PUBLISHED, Compliance, Coupling, NoCoupling, SpringDamper
from haptic_loop.controller.environment import GROUND, RIGID_WALL, Network, Spring
from haptic_loop.controller.loop import DelayRange, Loop
from haptic_loop.controller.lti import Lti
from haptic_loop.controller.ranges import Ranges
from haptic_loop.design import budgets, certificate, coupling_file
from haptic_loop.design.api import certify
from haptic_loop.design.assessment import assess
from haptic_loop.design.audit import _MOST_EXTRA_SAMPLES, _helps, _sensitivity, _stiffest, audit, edge
from haptic_loop.design.certificate import named, required_damping
from haptic_loop.design.files import plain
from haptic_loop.design.result import ANY, CAVEATS, GUARD, HERE, suffices
from tests.evaluate import needs, safe_with

CONDITIONS = ("this-environment", "any-environment")
T = 1.2e-3
SAFE = SpringDamper([870.0, 545.0], [0.38, 0.52])


def pair(coupling, **changes) -> tuple[Loop, Coupling]:
    """Return the default scenario's loop with `changes`, and the coupling."""
    loop = {"T": T, "theta": (1, 2), "psi": (0, 0), "delta": (1.37, 1.37), "environment": FIGURE_4} | changes
    return Loop(lam=loop["theta"], **loop), coupling


def stiffest(*subject):
    """Return the largest certified K of a loop and a coupling by the condition of this name."""
    loop, coupling, condition = subject
    return _stiffest(loop, coupling, named(condition))


def sensitivity(*subject):
    """Return the tolerated errors of a loop with a coupling by the condition of this name."""
    loop, coupling, condition = subject
    return _sensitivity(loop, coupling, named(condition), required_damping(*subject))


def helps(*subject):
    """Return the changes that help a coupling in a loop to satisfy the condition of this name."""
    loop, coupling, condition = subject
    return _helps(loop, coupling, named(condition), required_damping(*subject))


def report(*subject):
    """Return the audit as its JSON file stores it: dictionaries, lists, numbers and texts."""
    return plain(audit(*subject))


def wall(K: float, B: float, theta: int = 0, delta: float = 1.37, T: float = 1e-3) -> tuple[Loop, Coupling]:
    return Loop(T, (theta,), (0,), (theta,), (delta,), RIGID_WALL), SpringDamper([K], [B])


@pytest.fixture
def run(tmp_path, monkeypatch, capsys):
    """Return a function that runs the command as a shell would and returns (exit code, stdout, stderr)."""
    monkeypatch.chdir(tmp_path)

    def command(*argv: str) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["design.audit", *argv])
        with pytest.raises(SystemExit) as leaving:
            execute(main)
        return leaving.value.code, *capsys.readouterr()

    return command


def strict(text: str) -> dict:
    """Parse JSON, and refuse the NaN and Infinity that Python would accept."""

    def refuse(constant: str):
        raise AssertionError(f"{constant} is not JSON")

    return json.loads(text, parse_constant=refuse)


@pytest.mark.parametrize(
    ("K", "B", "theta", "this_environment", "any_environment"),
    [(5000, 0, 0, 2.5, 2.5), (5000, 30, 0, 32.5, 32.5), (800, 0.7, 0, 1.1, 1.1), (5000, 0, 1, 7.5, 10.0)],
)
def test_closed_forms_of_a_rigid_wall(K, B, theta, this_environment, any_environment):
    """Without delay a wall needs K T/2 + B. One sample late a spring needs 3 K T/2, and 2 K T for any environment."""
    subject = wall(K, B, theta)
    assert required_damping(*subject, "this-environment").required[0] == pytest.approx(this_environment, rel=1e-9)
    assert required_damping(*subject, "any-environment").required[0] == pytest.approx(any_environment, rel=1e-9)


@pytest.mark.parametrize(("theta", "proved"), [(0, True), (1, True), (1, False)])
def test_sufficiently_damped_rigid_walls_are_proved_and_stored(theta, proved, tmp_path):
    """A rigid wall behind a spring K needs (theta + 1/2) K T. With delay the guarantee covers a rigid wall only."""
    loop, coupling = wall(1000, 0, theta, delta=1.51 if proved else 1.49)
    needs = certify(loop, coupling)
    assert needs["this-environment"].required[0] == pytest.approx((theta + 0.5) * 1000 * 1e-3)
    assert needs["this-environment"].proof == ("rational" if proved else "sampled")
    held = assess(loop, coupling).guarantee
    assert (held and held.environments) == ((ANY if theta == 0 else "a rigid wall only") if proved else None)
    if proved:
        proof = certificate.prove(loop, coupling, "this-environment")
        coupling_file.save(coupling_file.Stored.of(loop, coupling, proof), tmp_path / "wall.json")
        again = coupling_file.load(tmp_path / "wall.json")
        assert again.loop == loop
        assert certificate.verify(again).proved


def test_impossible_rigid_walls_are_refused():
    loop, _ = wall(1000, 0)
    with pytest.raises(ValueError, match="no loop with a delayed environment is stable"):
        msgspec.structs.replace(loop, psi=(1,))
    with pytest.raises(ValueError, match="needs a spring-damper or another V"):
        loop.F(NoCoupling())
    with pytest.raises(ValueError, match="is no network of springs"):
        msgspec.structs.replace(loop, ranges=Ranges(masses={"tip": (1.0, 2.0)}))


def test_a_rigid_wall_equals_a_very_stiff_spring():
    ground = Network(("a",), (Spring(("a", GROUND), 1e9),))  # softens K = 2000 N/m by 2e-6 of K
    loop, coupling = wall(2000, 0.4, 1)
    ratio = required_damping(loop.at(ground), coupling, "this-environment").ratio
    assert ratio == pytest.approx(required_damping(loop, coupling, "this-environment").ratio, rel=1e-5)


@pytest.mark.parametrize(("condition", "theta", "K"), [("this-environment", 0, 2340), ("any-environment", 0, 2340)])
def test_the_stiffest_spring_is_at_colgates_bound(condition, theta, K):
    """The stiffest spring without delay has K = 2 (delta - B)/T."""
    assert stiffest(*wall(100, 0.2, theta), condition).K[0] == pytest.approx(K, rel=1e-6)


def test_the_stiffest_gains_respect_full_levels():
    """With theta = 0 equal K of both axes are certified up to 2/T times the least eigenvalue of Delta - B."""
    level = np.array([[1.0, 0.9], [0.9, 1.0]])
    plane = Network(("a.x", "a.y"), (Spring(("a.x", GROUND), 300.0), Spring(("a.y", GROUND), 200.0)))
    loop = Loop(1e-3, (0, 0), (0, 0), (0, 0), (1.0, 1.0), plane, axes=(2,), levels=(tuple(map(tuple, level.tolist())),))
    expected = 2 * (np.linalg.eigvalsh(level)[0] - 0.05) / 1e-3
    K = stiffest(loop, SpringDamper([100.0] * 2, [0.05] * 2), "any-environment").K
    assert np.array(K) == pytest.approx(expected, rel=1e-6)
    assert required_damping(loop, SpringDamper(K, [0.05] * 2), "any-environment").certified
    beyond = stiffest(loop, SpringDamper([100.0] * 2, [0.3] * 2), "any-environment")
    assert beyond.K == (None, None)
    assert "no multiple of K" in beyond.reason


@pytest.mark.validate
def test_stiffest_axes_of_late_devices_hold_together():
    """The stiffest K of the two axes are certified together, not only axis by axis."""
    plane = Network(("a.x", "a.y"), (Spring(("a.x", GROUND), 300.0), Spring(("a.y", GROUND), 200.0)))
    late = {"axes": (2,), "latency": ((0.0, 5e-4),) * 2}
    loop = Loop(1e-3, (0, 0), (0, 0), (0, 0), (1.5, 0.9), plane, **late)
    K = stiffest(loop, SpringDamper([1500.0, 900.0], [0.3] * 2), "any-environment").K
    assert required_damping(loop, SpringDamper(K, [0.3] * 2), "any-environment").certified


@pytest.mark.validate
@pytest.mark.parametrize("B", [0.62, 0.85, 0.899])
def test_the_stiffest_gains_of_late_forces_are_certified(B):
    """For large B no K is certified although B < delta, and a K near 0 may need more damping than a larger K."""
    loop, coupling = wall(100, B, theta=1, delta=0.9)
    loop = msgspec.structs.replace(loop, latency=((0.0, 9e-4),))
    margin = stiffest(loop, coupling, "any-environment")
    certified = [K for K in (1.0, 100.0) if required_damping(loop, SpringDamper([K], [B]), "any-environment").certified]
    assert (margin.K[0] is None) == (not certified)
    if certified:
        assert margin.K[0] >= certified[-1]
        assert required_damping(loop, SpringDamper(margin.K, [B]), "any-environment").certified
    else:
        assert f"with B = {B:g} N s/m, no K" in margin.reason


def test_the_largest_period_is_at_colgates_bound():
    subject = wall(1000, 0.37)
    for condition in CONDITIONS:
        edges = sensitivity(*subject, condition)
        assert edges.largest_T_s == pytest.approx(2 * (1.37 - 0.37) / 1000, rel=1e-6)


def test_the_papers_gains_are_not_certified():
    outcome = report(*pair(PUBLISHED["I"]))
    assert needs(outcome, "this-environment")["required_damping"] == pytest.approx([1.39871] * 2, rel=1e-5)
    assert needs(outcome, "any-environment")["required_damping"] == pytest.approx([7.63, 7.84], abs=0.005)
    assert not outcome["assessment"]["holds"]
    assert outcome["assessment"]["guarantee"] is None
    assert outcome["margins"]["any-environment"]["stiffest"]["K"] == [None, None]
    assert "B = 5.47 N s/m alone uses up delta = 1.37" in outcome["margins"]["any-environment"]["stiffest"]["reason"]


@pytest.mark.parametrize("condition", CONDITIONS)
@pytest.mark.parametrize(
    "subject", [pair(SAFE), wall(900, 0.3, 1), wall(300, 0.1, 2)], ids=["pair", "wall", "late wall"]
)
def test_certification_ends_at_the_reported_edges(subject, condition):
    """An edge errs by at most 1e-7: nothing is certified 1e-5 (1e-6 for delta) or one sample beyond an edge."""
    loop, coupling = subject
    needs = required_damping(loop, coupling, condition)
    assert needs.certified
    edges = sensitivity(loop, coupling, condition)
    K = np.array(stiffest(loop, coupling, condition).K)
    least, T = np.array(edges.least_delta), edges.largest_T_s
    change, later = msgspec.structs.replace, [n + edges.extra_samples for n in loop.theta]
    inside = [
        (loop, SpringDamper(K, coupling.B)),
        (change(loop, T=T), coupling),
        (change(loop, theta=later), coupling),
        (change(loop, delta=tuple(least * (1 + 1e-6))), coupling),
    ]
    outside = [
        (loop, SpringDamper(K * (1 + 1e-5), coupling.B)),
        (change(loop, T=T * (1 + 1e-5)), coupling),
        (change(loop, theta=[n + 1 for n in later]), coupling),
        (change(loop, delta=tuple(least * (1 - 1e-6))), coupling),
    ]
    assert [required_damping(*s, condition).certified for s in inside] == [True] * 4
    assert [required_damping(*s, condition).certified for s in outside] == [False] * 4


def test_figures_that_do_not_exist_have_a_reason():
    spring = wall(0.01, 0.0, delta=1.0)
    edges = sensitivity(*spring, "this-environment")
    assert (edges.largest_T_s, edges.extra_samples) == (None, None)
    assert f"{_MOST_EXTRA_SAMPLES} samples more" in edges.reason
    assert "largest T tried" in edges.reason
    assert "multiple of K" in stiffest(*wall(5000, 30), "this-environment").reason
    assert "stiffest K tried" in stiffest(*pair(SAFE, delta=(3.0, 3.0)), "this-environment").reason
    assert "not certified" in sensitivity(*pair(PUBLISHED["I"]), "this-environment").reason


def test_remedies_are_evaluated_and_no_larger_than_needed():
    subject = wall(5000, 0.5, 1)
    changes = {r.change.split(" ")[0]: r for r in helps(*subject, "this-environment")}
    assert changes["delay"].requirement.required[0] == pytest.approx(3.0)
    assert not changes["delay"].requirement.certified
    assert changes["period"].requirement.certified
    assert changes["period"].requirement.required[0] > 0.98 * 1.37
    assert helps(*wall(500, 0), "this-environment") == []
    assert {helping["condition"] for helping in report(*wall(5000, 0))["helps"]} == {"this-environment"}


def test_delayed_environments_need_a_multiplier():
    needs = required_damping(*pair(SAFE, psi=(1, 1)), "any-environment")
    assert not needs.certified
    assert "the environment alone uses up" in needs.reason
    softer = Network(("a",), (Spring(("a", GROUND), 100.0, 0.2),))
    subject = Loop(T, (0,), (1,), (0,), (1.37,), softer), SpringDamper([200.0], [0.2])
    assert required_damping(*subject, "any-environment").certified
    assert "multiplier" in stiffest(*subject, "any-environment").reason


@pytest.mark.slow
def test_any_coupling_can_be_audited():
    V = SAFE.compliance(T)
    general, structured = report(*pair(Compliance(V))), report(*pair(SAFE))
    assert needs(general, "this-environment")["required_damping"] == pytest.approx(
        needs(structured, "this-environment")["required_damping"]
    )
    assert needs(general, "any-environment")["required_share"] == pytest.approx(
        needs(structured, "any-environment")["required_share"], rel=1e-6
    )
    assert general["assessment"]["coupling"]["kind"] == "compliance"
    assert "only a spring-damper" in general["margins"]["any-environment"]["stiffest"]["reason"]
    nothing = report(*pair(NoCoupling()))
    assert needs(nothing, "this-environment")["required_damping"] == pytest.approx([1.7229] * 2, rel=3e-5)
    assert needs(nothing, "any-environment")["required_damping"] == [None, None]
    assert "needs a coupling" in needs(nothing, "any-environment")["reason"]


@pytest.mark.slow
def test_guarantees_name_their_environments():
    assert assess(*pair(SAFE)).guarantee.environments == ANY
    assert assess(*pair(SpringDamper([2000.0, 2000.0], [0.2, 0.2]))).guarantee.environments == HERE
    assert assess(*wall(5000, 0)).guarantee is None
    assert assess(*wall(900, 0.2, 1)).guarantee.environments == ANY
    assert assess(*wall(900, 0, 1)).guarantee.environments == "a rigid wall only"


def test_edge_takes_the_certified_side():
    assert edge(lambda x: x, 0.5, 2.0) < 1
    assert edge(lambda x: x, 0.5, 2.0) == pytest.approx(1, rel=1e-6)
    assert edge(lambda x: 0.9, 0.5, 2.0) == 2.0
    assert edge(lambda x: 0.5 if x < 1.3 else np.inf, 1.0, 2.0) == pytest.approx(1.3, rel=1e-6)


@pytest.mark.parametrize(
    ("ratio", "inverse", "inside", "outside"),
    [
        (lambda x: 0.4 + x, lambda r: r - 0.4, 1e-9, 1.0),
        (lambda x: x**0.5, lambda r: r**2, 0.5, 2.0),
        (lambda x: x + x**3 / 2, lambda r: np.roots([0.5, 0, 1, -r])[-1].real, 0.1, 2.0),
        (lambda x: 1 / x, lambda r: 1 / r, 3.0, 0.5),
    ],
)
def test_edges_of_smooth_ratios_take_few_sweeps(ratio, inverse, inside, outside):
    """The edge is within 1e-7 of its exact value after at most 8 sweeps. Bisection would take 24."""
    values = []

    def swept(x):
        values.append(x)
        return ratio(x)

    at, last = edge(cache(swept), inside, outside), inverse(1 - GUARD)
    assert suffices(ratio(at))
    assert abs(at - last) <= 1e-7 * last
    assert len(values) <= 8


@pytest.mark.parametrize(
    ("argv", "code", "required"),
    [
        (["--rigid", "--K", "2000", "--B", "0", "--T", "1e-3", "--theta", "1", "--delta", "3.1"], 0, 3.0),
        (["--device", "omega.3"], 1, 32.5),
        (["--device", "omega.3", "--B", "0", "--K", "2000", "--rigid", "--T", "1e-3", "--theta", "0"], 0, 1.0),
        (["--device", "falcon", "--delta", "0.5"], 1, 21.5),
        (["--device", "omega", "--case", "I", "--K", "2870,2320", "--B", "5.47,5.55"], 1, 1.39871),
        pytest.param(
            ["--device", "touch", "--delta", "1.37", "--K", "879,552", "--B", ".39,.52"],
            *(0, 0.714344),
            marks=pytest.mark.validate,
        ),
        (["--case", "none"], 1, 1.7229),
        pytest.param(["--scenario", "three-rigid", "--K", "300", "--B", "0.2"], 0, None, marks=pytest.mark.validate),
    ],
)
def test_the_command_reports_verdict_and_requirement(run, argv, code, required):
    exit_code, out, err = run(*argv, "--details", "--json", "-")
    outcome = strict(out)
    assert exit_code == code
    assert outcome["assessment"]["holds"] == (code == 0)
    if required:
        assert needs(outcome, "this-environment")["required_damping"][0] == pytest.approx(required, rel=3e-5)
    assert set(outcome) >= {"assessment", "margins", "helps", "not_covered", "wall_s"}
    assert outcome["not_covered"] == CAVEATS
    assert outcome["switching"] is None
    assert ("Stable" if code == 0 else "Not certified") in err
    assert "do not cover periods longer than T_max" in " ".join(err.split())


def test_out_stores_the_report(run, tmp_path):
    assert run("--rigid", "--K", "100", "--B", "0", "--theta", "0", "--out", "here")[0] == 0
    assert safe_with(strict((tmp_path / "here" / "report.json").read_text())) == ANY


def test_gains_of_a_device_name_their_source(run):
    outcome = strict(run("--device", "omega.3", "--json", "-")[1])
    assert outcome["device"]["name"] == "omega.3"
    assert "CDeltaDevices.cpp" in outcome["gains"]
    assert (outcome["assessment"]["loop"]["T_s"], outcome["assessment"]["loop"]["theta"]) == (1e-3, [0])


@pytest.fixture
def files(tmp_path):
    """Write a spring-damper, the same coupling as a state space, an unstable coupling and a malformed file."""
    loop = Loop(T, (1, 2), (0, 0), (1, 2), (1.37, 1.37), FIGURE_4)
    coupling_file.save(coupling_file.Stored.of(loop, SAFE), tmp_path / "gains.json")
    coupling_file.save(coupling_file.Stored(loop, Compliance(SAFE.compliance(T)).form()), tmp_path / "space.json")
    unstable = Compliance(Lti(1.1 * np.eye(2), np.eye(2), np.eye(2), np.eye(2), T))
    coupling_file.save(coupling_file.Stored.of(loop, unstable), tmp_path / "unstable.json")
    (tmp_path / "broken.json").write_text("{")


@pytest.mark.slow
@pytest.mark.usefixtures("files")
def test_stored_couplings_are_audited(run):
    for name in ("gains.json", "space.json"):
        code, out, _ = run("--coupling", name, "--json", "-")
        assert code == 0
        assert safe_with(strict(out)) == ANY
    code, out, _ = run("--coupling", "unstable.json", "--json", "-")
    assert code == 1
    assert "unit circle" in needs(strict(out), "any-environment")["reason"]
    assert run("--coupling", "gains.json", "--T", "1e-3")[0] == 0


BAD = [
    ("", "nothing to audit"),
    ("--K 100", "--K without --B"),
    ("--B 1", "--B without --K"),
    ("--rigid --B 1", "--B without --K: give any K; the first line then names the stiffest wall with this B"),
    ("--K nan --B 1", "--K is nan .. 0.001 to 1e+09 N/m"),
    ("--K=-1,5 --B 1", "--K is -1, allowed"),
    ("--K 0 --B 1", "--K is 0, allowed"),
    ("--K 1 --B inf", "--B is inf .. 0 to 1e+06 N s/m"),
    ("--K 1 --B=-0.1", "--B is -0.1, allowed"),
    ("--K 1,2,3 --B 1", "--K has 3 entries, expected 2 (one per channel) or 1"),
    ("--K x --B 1", "--K is 'x'"),
    ("--rigid --K 1,2 --B 1", "--K has 2 entries, expected one"),
    ("--rigid --K 1 --B 1 --theta 0,1", "--rigid is one channel: --theta has 2 entries"),
    ("--rigid --K 1 --B 1 --psi 1", "no loop with a delayed environment is stable"),
    ("--rigid --coupling gains.json", "gains.json couples 2 channels, the loop has 1"),
    ("--rigid --case none", "--rigid with --case none"),
    ("--case none --K 1 --B 1", "--K with --case none"),
    ("--device falkon --delta 1", "--device is 'falkon' .. falcon .. omega.3, omega.6"),
    ("--device falcon", "--device falcon: nobody publishes its damping: give --delta"),
    ("--device hapkit --delta 1", "nothing to audit"),
    ("--coupling gains.json --K 1", "--K with --coupling"),
    ("--coupling gains.json --scenario three-rigid", "gains.json couples 2 channels, the loop has 3"),
    ("--coupling space.json --T 1e-3", "its coefficients are for T = 0.0012 s, the loop has 0.001 s"),
    ("--coupling nowhere.json", "nowhere.json: No such file"),
    ("--coupling broken.json", "broken.json: "),
    ("--K 1 --B 1 --delta 0", "delta, the damping of devices, is 0, 0, expected positive numbers [N s/m]"),
    ("--K 1 --B 1 --delta=-1", "--delta is -1 .. 0 to 10000"),
    ("--K 1 --B 1 --delta nan", "--delta is nan, allowed"),
    ("--K 1 --B 1 --T 0", "T is 0, allowed"),
    ("--K 1 --B 1 --theta=-1", "theta #1 is -1, allowed"),
    ("--K 1 --B 1 --theta 101", "theta is 101, 101 .. 0 to 100 samples"),
    ("--K 1 --B 1 --theta 0.5", "--theta is '0.5', expected whole numbers"),
    ("--K 1 --B 1 --seed x", "--seed is 'x'"),
    ("--K 1 --B 1 --json nowhere/x.json", "folder nowhere"),
    ("--K 1 --B 1 --sceanrio x", "unknown option --sceanrio .. --scenario"),
]


@pytest.mark.usefixtures("files")
@pytest.mark.parametrize(("options", "message"), BAD, ids=[options or "nothing" for options, _ in BAD])
def test_bad_calls_end_with_one_error_line(run, options, message):
    code, out, err = run(*options.split())
    assert (code, out) == (2, "")
    assert err.startswith("error: ")
    assert says(err, message)
    assert err.count("\n") == 1


def test_the_catalogue_has_a_source_for_every_number(run):
    code, out, err = run("--devices", "--json", "-")
    devices = strict(out)["devices"]
    assert code == 0
    assert set(devices) >= {
        "omega.3",
        "omega.6",
        "omega.7",
        "delta.3",
        "delta.6",
        "sigma.7",
        "falcon",
        "touch",
        "phantom-premium",
        "haply-2diy",
        "inverse3",
        "hapkit",
    }
    for name, device in devices.items():
        assert name in err
        for field, fact in device.items():
            assert field == "title" or fact is None or fact["source"]
    assert devices["falcon"]["damping"] is None
    assert devices["omega.3"]["kind"]["value"] == "rigid"
    assert [devices[name]["force_limit"]["value"] for name in ("omega.7", "delta.6", "sigma.7")] == [12.0, 20.0, 12.0]
    assert "unknown" in err


@pytest.mark.parametrize("B", [pytest.param(0.0, marks=pytest.mark.validate), 0.37])
def test_a_rigid_audit_names_the_stiffest_wall(run, B):
    """Without delay a wall behind K and B needs K T/2 + B (Colgate and Schenkel)."""
    _, out, _ = run(*f"--rigid --K 5000 --B {B} --T 1e-3 --theta 0 --delta 1.37".split())
    named = float(re.search(rf"The stiffest wall with B = {B:g} N s/m: ([\d.]+) N/m", out.replace("\n", " "))[1])
    assert named == pytest.approx(2 * (1.37 - B) / 1e-3, rel=1e-4)


def test_a_rigid_audit_names_too_large_a_damper(run):
    _, out, _ = run("--rigid", "--K", "5000", "--B", "2", "--T", "1e-3", "--theta", "0", "--delta", "1.37")
    assert "No stiffest wall with B = 2 N s/m is given: with this B, no multiple of K" in out.replace("\n", " ")


def test_a_certified_wall_is_not_called_uncertified(run):
    code, out, _ = run(*["--rigid", "--K", "1000", "--B", "0", "--T", "1e-3", "--theta", "0", "--delta", "1e4"])
    assert code == 0
    words = out.replace("\n", " ")
    assert "No stiffest wall with B = 0 N s/m is given: certified at the stiffest K tried, 1e+06 N/m" in words


@pytest.mark.validate
def test_an_audit_without_environment_delay_imports_no_solver(tmp_path):
    argv = ["--K", "879,552", "--B", ".39,.52", "--out", str(tmp_path)]
    needless = {"cvxpy", "scipy.linalg", "scipy.sparse"}  # SciPy's imports take a tenth of an audit
    code = f"import sys, cli.audit as a; r = a.main({argv!r}); sys.exit(r or bool({needless} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True).returncode == 0


# Budgets of time


def test_long_computations_are_refused_or_ended(monkeypatch):
    """A sweep of the pair is estimated at 0.16 ms, and a search at sixty sweeps."""
    monkeypatch.setattr(budgets, "SWEEPS", 5e-3)
    outcome = report(PAIR, SOFT)
    part, need = outcome["margins"]["this-environment"], needs(outcome, "this-environment")
    assert need["certified"]
    assert part["stiffest"]["reason"].startswith("not searched: some 60 sweeps over 8 states and 2 channels would take")
    assert part["sensitivity"]["least_delta"] == need["required_damping"]
    with monkeypatch.context() as patch:
        patch.setattr(budgets, "too_long", lambda *_: None)
        patch.setattr(budgets, "SWEEPS", 1e-3)
        part = report(PAIR, SOFT)["margins"]["this-environment"]
    assert part["stiffest"]["K"] == [None, None]
    assert "0.001 s" in part["stiffest"]["reason"]
    monkeypatch.setattr(budgets, "SWEEPS", 1e-5)
    assert "a sweep over 8 states and 2 channels would take" in required_damping(PAIR, SOFT, "this-environment").reason


def test_tables_of_switching_loops_use_constant_delays(run):
    """A wall K needs K T/2 without delay; switching within [0, 1] needs 3/2 K T, more than is available."""
    loop, coupling = wall(1000.0, 0.0)
    audited = audit(loop.switching(DelayRange((0,), (1,))), coupling)
    for condition in CONDITIONS:
        assert audited.constant[condition].ratio == pytest.approx(1000.0 * 1e-3 / 2 / 1.37, rel=1e-6)
        assert audited.margins[condition].stiffest.K[0] == pytest.approx(2 * 1.37 / 1e-3, rel=1e-6)
    assert not audited.assessment.holds
    assert audited.helps == []
    options = ("--rigid", "--K", "1000", "--B", "0", "--T", "1e-3", "--theta", "0", "--varying-delay", "0,1")
    code, out, _ = run(*options)
    assert code == 1
    assert "for constant delays" in out
    assert "What helps" not in out
