"""Tests of certificates: they agree with the sweep, survive saving and loading, and are refused after tampering."""

import os
import re
from fractions import Fraction
from functools import cache

import msgspec
import numpy as np
import pytest
from evaluate import prove_limiter, this_environment
from shared import FIGURE_4, PAIR, SOFT, SOFT_NETWORK, STIFF, at_springs, walled

from haptic_loop.controller import coupling as controller_coupling
from haptic_loop.controller.arithmetic import SingularLoop, numbers, rational, solve
from haptic_loop.controller.coupling import (
    PUBLISHED,
    Compliance,
    ForceFilter,
    NoCoupling,
    SpringDamper,
    _ComplianceForm,
)
from haptic_loop.controller.environment import Environment, Network, Spring, Wall
from haptic_loop.controller.loop import DelayRange, Loop
from haptic_loop.controller.lti import Lti
from haptic_loop.design import budgets, environments, spring_damper
from haptic_loop.design import certificate as design_certificate
from haptic_loop.design.certificate import Verdict, prove, proves, required_damping, verify
from haptic_loop.design.coupling_file import Stored, digest, load, save, sealed
from haptic_loop.design.coverage import ranges_around
from haptic_loop.design.environments import ANY_ENVIRONMENT, LIMITER, THIS_ENVIRONMENT
from haptic_loop.design.files import InputError
from haptic_loop.design.frequency import frequencies, on_circle, rounding
from haptic_loop.design.result import ANY, HERE, NotProved, from_ratio
from haptic_loop.sim.scenario import load as scenario
from tests.checks.random_loops import proofs

DEFAULT = Loop(1.2e-3, (1, 2), (0, 0), (1, 2), (1.37, 1.37), FIGURE_4)
change = msgspec.structs.replace


def test_channels_without_cross_terms_need_their_own_damping():
    """With B = 0 any-environment needs K T (theta + 1)^2/2 per channel: 0.96 and 0.54 N s/m."""
    coupling = SpringDamper([400.0, 100.0], [0.0, 0.0])
    assert prove(DEFAULT, coupling, "any-environment").required == pytest.approx((0.96, 0.54), rel=1e-9)
    assert required_damping(DEFAULT, coupling, "any-environment").required == pytest.approx((0.96, 0.54), rel=1e-9)


@pytest.mark.parametrize("psi", [pytest.param((1, 1), marks=pytest.mark.validate), (1, 0)])
def test_loops_with_psi_are_proved_with_phi(psi):
    """With psi = 1 in a channel, Theorem 4 needs a large enough Phi and guarantees this environment only."""
    loop = change(DEFAULT, psi=psi, environment=SOFT_NETWORK)
    design = spring_damper.design(loop)
    stored = Stored.of(loop, design.coupling, prove(loop, design.coupling, "any-environment", design.phi))
    assert stored.certificate.guarantee == HERE
    assert set(stored.certificate.matrices) == {"P", "P_E"}
    assert verify(stored) == Verdict(True)
    least = prove(loop, design.coupling, "any-environment")  # `prove` finds the least Phi
    assert verify(Stored.of(loop, design.coupling, least)) == Verdict(True)
    with pytest.raises(NotProved, match="needs a multiplier Phi, one entry per channel"):
        prove(loop, design.coupling, "any-environment", [0.1])
    with pytest.raises(NotProved, match="E-hat \\+ Phi is not passive"):
        prove(loop, design.coupling, "any-environment", 0.9 * design.phi)
    forged = sealed(change(stored.certificate, multipliers={"Phi": (0.01, 0.01)}))
    assert not verify(change(stored, certificate=forged)).proved


def test_loops_too_large_to_prove_are_refused():
    loop = change(DEFAULT, theta=(400, 400), delta=(600.0, 600.0))
    with pytest.raises(NotProved, match=r"806 states.* 800 "):
        prove(loop, SpringDamper((4.0, 4.0), (0.5, 0.5)), "this-environment")


def certified(loop: Loop, coupling, condition: str) -> Stored:
    return Stored.of(loop, coupling, prove(loop, coupling, condition))


@cache
def of_stiff_gains() -> Stored:
    """Return STIFF with its proof in the default loop."""
    return certified(DEFAULT, STIFF, "this-environment")


@pytest.mark.parametrize(
    ("coupling", "condition", "ratio"),
    [
        (STIFF, "this-environment", 1.363 / 1.37),
        (SpringDamper((879, 552), (0.39, 0.52)), "this-environment", 0.714344 / 1.37),
        (SOFT, "this-environment", 0.714 / 1.37),
        (SOFT, "any-environment", 0.9999),
        (SpringDamper((400.0, 300.0), (0.0, 0.5)), "any-environment", None),
    ],
)
def test_safe_gains_are_proved_again_from_files(tmp_path, coupling, condition, ratio):
    stored = certified(DEFAULT, coupling, condition)
    assert stored.certificate.proof == "rational"
    if ratio:  # A ratio of None is not compared. The ratios are given to three digits.
        assert stored.certificate.required[0] / 1.37 == pytest.approx(ratio, abs=1e-3)
    save(stored, tmp_path / "coupling.json")
    assert load(tmp_path / "coupling.json") == stored
    assert verify(load(tmp_path / "coupling.json")) == Verdict(True)
    assert [p.name for p in tmp_path.iterdir()] == ["coupling.json"]


@pytest.mark.parametrize(
    ("coupling", "condition"),
    [
        (PUBLISHED["I"], "this-environment"),
        (PUBLISHED["I"], "any-environment"),
        (NoCoupling(), "this-environment"),
        (NoCoupling(), "any-environment"),
        (SpringDamper((879, 552), (0.39, 0.52)), "any-environment"),  # the optimal gains, rounded up
    ],
)
def test_unsafe_gains_are_refused(coupling, condition):
    with pytest.raises(NotProved) as refusal:
        prove(DEFAULT, coupling, condition)
    assert refusal.value.requirement.ratio > 1


def test_loops_without_coupling_are_proved_with_enough_damping():
    """Without a coupling the loop needs 1.7229 N s/m."""
    assert verify(certified(change(DEFAULT, delta=(1.7232, 1.7232)), NoCoupling(), "this-environment")).proved


@pytest.mark.parametrize(("K", "B"), [(1000.0, 0.0), (500.0, 0.3), (30.0, 2.0)])
def test_proofs_reach_colgates_condition_within_a_millionth(K, B):
    needed = K * 1e-3 / 2 + B
    assert verify(certified(at_springs(K, B, 0, needed * (1 + 1e-6), 1e-3), NoCoupling(), "this-environment")).proved
    with pytest.raises(NotProved, match="needs"):
        prove(at_springs(K, B, 0, needed * (1 - 1e-6), 1e-3), NoCoupling(), "this-environment")


def test_three_unequal_channels_are_proved():
    springs = tuple(Spring((tip, "hub"), k, 0.5) for tip, k in (("a", 400.0), ("b", 300.0), ("c", 350.0)))
    network = Network(contacts=("a", "b", "c"), springs=springs, masses={"hub": 0.4})
    loop = Loop(1e-3, (0, 3, 1), (0, 0, 0), (0, 3, 1), (2.0, 0.8, 1.37), network)
    coupling = SpringDamper((1500.0, 250.0, 500.0), (0.5, 0.2, 0.3))
    for condition in ("this-environment", "any-environment"):
        assert verify(certified(loop, coupling, condition)).proved


def test_a_general_compliance_is_proved_under_both_conditions():
    V = controller_coupling.SpringDamper([800.0, 500.0], [0.39, 0.52]).compliance(1.2e-3)
    crossed = Lti(V.A, V.B, V.C, V.D + 1e-5, V.T)  # V has entries off the diagonal, and V(1) is symmetric
    rounded = Compliance(Lti(*(np.round(getattr(crossed, n), 12) for n in "ABCD"), V.T))
    for condition in ("this-environment", "any-environment"):
        assert verify(certified(DEFAULT, rounded, condition)).proved


def test_a_static_asymmetry_is_refused():
    anchored = change(FIGURE_4, springs=(*FIGURE_4.springs, Spring(("mass", "ground"), 50.0)))
    V = Compliance(Lti.constant([[2e-3, 1e-4], [2e-4, 2e-3]], 1.2e-3))
    for condition in ("this-environment", "any-environment"):
        with pytest.raises(NotProved, match="symmetric"):
            prove(change(DEFAULT, environment=anchored), V, condition)


def test_environment_delay_needs_more_damping_for_any_environment():
    loop = change(DEFAULT, psi=(1, 1), delta=(2.5, 2.5))
    damped = SpringDamper((2000.0, 2000.0), (3.0, 3.0))
    assert verify(certified(loop, damped, "this-environment")).proved
    with pytest.raises(NotProved, match=r"^needs 5\.76"):
        prove(loop, damped, "any-environment")


@pytest.mark.validate
def test_proof_and_sweep_agree_on_both_sides():
    """A random loop is proved if its ratio is below 1 - 1e-4, and refused if its ratio is above 1."""
    rng = np.random.default_rng(7)
    outcomes = []
    for _ in range(60):
        loop, coupling = random_case(rng)
        ratio = required_damping(loop, coupling, "this-environment").ratio
        try:
            proved = verify(certified(loop, coupling, "this-environment")).proved
        except NotProved:
            proved = False
        outcomes.append(proved)
        assert proved == (ratio < 1) or 1 - 1e-4 <= ratio <= 1
    assert 15 < sum(outcomes) < 45


def random_case(rng: np.random.Generator) -> tuple[Loop, SpringDamper]:
    """Return a star of 1 to 3 contacts and a coupling. Delta is 0.5 to 1.5 times min(requirement, 100 N s/m)."""
    m = int(rng.integers(1, 4))
    tips = tuple(f"tip {i}" for i in range(m))
    spokes = [Spring((tip, "hub"), *np.round([rng.uniform(50, 2000), rng.uniform(0, 2)], 3).tolist()) for tip in tips]
    anchor = Spring(("hub", "ground"), round(float(rng.uniform(0, 500)), 3), 0.1)
    network = Network(contacts=tips, springs=(*spokes, anchor), masses={"hub": round(float(rng.uniform(0.1, 2)), 3)})
    theta = tuple(rng.integers(0, 4, m).tolist())
    psi = tuple(rng.integers(0, 2, m).tolist())
    loop = Loop(1e-3, theta, psi, theta, (1.0,) * m, network)
    coupling = SpringDamper(tuple(rng.uniform(300, 9000, m).tolist()), tuple(rng.uniform(0, 3, m).tolist()))
    ratio = required_damping(loop, coupling, "this-environment").ratio
    delta = float(min(ratio, 100.0) * rng.uniform(0.5, 1.5))
    return change(loop, delta=(max(delta, 1e-3),) * m), coupling


def test_tampering_is_rejected_with_the_reason():
    good = of_stiff_gains()
    stiffer = SpringDamper((7806.0 * 1.01, 3137.0), STIFF.B)
    P = [list(row) for row in good.certificate.matrices["P"]]
    P[0][0] = "7" + P[0][0]
    wrong = change(good.certificate, matrices={"P": tuple(map(tuple, P))})
    cases = {
        "scenario digest differs": change(good, coupling=stiffer.form()),
        "seal differs": change(good, certificate=wrong),
        "P is not symmetric|KYP|negative|not positive definite": change(good, certificate=sealed(wrong)),
        "no certificate": change(good, certificate=None),
    }
    for reason, stored in cases.items():
        verdict = verify(stored)
        assert not verdict.proved
        assert any(part in verdict.reason for part in reason.split("|")), verdict.reason


def test_repaired_digests_do_not_forge_a_proof():
    good = of_stiff_gains()
    starved = change(DEFAULT, delta=(1.36, 1.36))
    forged = change(prove(change(DEFAULT, delta=(1.38, 1.38)), STIFF, "this-environment"), available=(1.36, 1.36))
    honest_digest = digest(starved, STIFF.form())
    requirement = required_damping(starved, STIFF, "this-environment")
    forged = change(forged, scenario=honest_digest, required=requirement.required, margin=1 / requirement.ratio)
    verdict = verify(Stored.of(starved, STIFF, sealed(forged)))
    assert not verdict.proved
    assert "1.00239 times the available damping" in (verdict.reason or "")
    claims = {
        "margin is": change(good.certificate, margin=2.0),
        "required is": change(good.certificate, required=(0.1, 0.1)),
        "available is": change(good.certificate, available=(2.0, 2.0)),
        "does not guarantee": change(good.certificate, guarantee=ANY),
        "carries no exact proof": change(good.certificate, proof="sampled"),
        "expected P": change(good.certificate, matrices={}),
        "the block has 9 states": change(good.certificate, matrices={"P": (("1",),)}),
    }
    for reason, certificate in claims.items():
        assert reason in verify(change(good, certificate=sealed(certificate))).reason


@pytest.mark.parametrize(
    ("old", "new", "names"),
    [
        (b'"T": 0.0012', b'"T": -1', "$.loop.T"),
        (b'"T": 0.0012', b'"T": "0.0012"', "$.loop.T"),
        (b'"kind": "spring-damper"', b'"kind": "magic"', "$.coupling.kind"),
        (b'"version": 3', b'"version": 4', "$.version"),
        (b'"version": 3', b'"version": 3, "extra": 0', "extra"),
        (b"7806.0", b"-7806.0", "K is [-7806.0, 3137.0]"),
        (b'"theta": [', b'"theta": [0, ', "theta has 3 entries"),
        (b'"proof": "rational"', b'"proof": "faith"', "$.certificate.proof"),
        (b"7806.0", b"1e400", "$.coupling.K #1"),
        (b"7806.0", b"NaN", ", 'NaN,': JSON is malformed"),
    ],
)
def test_a_bad_file_gets_one_error_line(tmp_path, old, new, names):
    path = tmp_path / "coupling.json"
    save(of_stiff_gains(), path)
    text = path.read_bytes()
    assert old in text
    path.write_bytes(text.replace(old, new, 1))
    with pytest.raises(InputError) as error:
        load(path)
    assert names in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("content", "message"), [(b" \n", "is empty"), (b"[]", "is no stored coupling"), (b"{", "truncated")]
)
def test_files_without_a_coupling_are_refused(tmp_path, content, message):
    path = tmp_path / "coupling.json"
    path.write_bytes(content)
    with pytest.raises(InputError, match=f"coupling.json: .*{message}"):
        load(path)


def test_coefficients_above_1e12_are_refused():
    with pytest.raises(ValueError, match=r"D has an entry -1e\+13.*sizes up to 1e\+12"):
        _ComplianceForm((), (), ((),), ((-1e13,),))


def test_proof_entries_beyond_floating_point_are_rejected():
    good = of_stiff_gains()
    rows = [list(row) for row in good.certificate.matrices["P"]]
    rows[0][0] = "1" + "0" * 400
    forged = sealed(change(good.certificate, matrices={"P": tuple(map(tuple, rows))}))
    assert "beyond the range of floating point" in verify(change(good, certificate=forged)).reason


# Rounding that changes the system, and proofs that would take minutes


def cancelling(size: float) -> Compliance:
    """Return 2 mm/N plus three equal modes whose coefficients size + 0.1, -size and -0.1 cancel as decimals."""
    return Compliance(Lti(0.5 * np.eye(3), np.ones((3, 1)), [[size + 0.1, -size, -0.1]], [[2e-3]], 1e-3))


@pytest.mark.parametrize("condition", ["this-environment", "any-environment"])
def test_realisations_changed_by_rounding_are_refused(condition):
    """The modes cancel in exact arithmetic, but rounding in floating point leaves a part of them."""
    loop = at_springs(1000.0, 0.0, 1, 5.0, 1e-3)
    assert verify(certified(loop, cancelling(1.0), condition)).proved
    with pytest.raises(NotProved, match=r"rounding may change the forces by 1\.\de-04 \(relative\)"):
        prove(loop, cancelling(1000.0), condition)
    requirement, good = required_damping(loop, cancelling(1000.0), condition), prove(loop, cancelling(1.0), condition)
    scenario = digest(loop, cancelling(1000.0).form())
    claims = change(good, scenario=scenario, required=requirement.required, margin=1 / requirement.ratio)
    reason = verify(Stored.of(loop, cancelling(1000.0), sealed(claims))).reason
    assert reason.startswith("rounding may change the forces by ")


@pytest.mark.parametrize("least", [0, 10**6])
def test_second_processes_refuse_rounding(least, monkeypatch):
    """A large proof and the check of its rounding, computed at the same time, give the verdicts of one process."""
    monkeypatch.setattr("haptic_loop.design.forked.allowed", True)
    monkeypatch.setattr("haptic_loop.design.certificate._FORKED", least)
    loop = at_springs(1000.0, 0.0, 1, 5.0, 1e-3)
    assert verify(certified(loop, cancelling(1.0), "this-environment")).proved
    with pytest.raises(NotProved, match="rounding may change the forces by"):
        prove(loop, cancelling(1000.0), "this-environment")


def test_the_bound_on_rounding_holds_over_ticks():
    """By Parseval's theorem, each error of 200 forces is at most `rounding` times the norm of x.

    The entries of x have a standard deviation of 1, so the norm of its 200 entries is below 3 sqrt(200).
    """
    loop, rng = at_springs(1000.0, 2.0, 1, 5.0, 1e-3), np.random.default_rng(8)
    for size in (1.0, 1e3):
        running, exact = loop.F(cancelling(size)), loop.F(cancelling(size), exact=True)
        x = np.round(rng.normal(size=200), 3)
        z, xi = np.zeros(running.order), np.zeros(exact.order, dtype=object) * Fraction(0)
        off = []
        for value in x:
            u, v = np.array([value]), np.array([rational(value)])
            off.append(float((running.C @ z + running.D @ u)[0]) - float((exact.C @ xi + exact.D @ v)[0]))
            z, xi = running.A @ z + running.B @ u, exact.A @ xi + exact.B @ v
        assert np.abs(off).max() <= 3 * rounding(running, on_circle(frequencies(running))) * np.sqrt(x.size)
        assert np.abs(off).max() > 0


def test_proof_and_run_agree_near_sharp_resonances():
    """The responses of the float and the rational loop are computed exactly at a point of the circle near a sharp peak.

    The rational loop's response in floating point has an error above the difference of the two loops. `rounding` still
    bounds this difference, and the filter is proved.
    """
    springs = (("a", "m", 1000.0, 0.01), ("m", "n", 100.0, 0.0), ("n", "k", 1000.0, 0.0), ("k", "b", 3000.0, 0.01))
    parts = tuple(Spring((one, other), stiffness, damping) for one, other, stiffness, damping in springs)
    network = Network(contacts=("a", "b"), springs=parts, masses={"m": 0.001, "n": 50.0, "k": 0.1})
    loop = Loop(1e-3, (0, 16), (2, 2), (2, 18), (0.1, 5.0), network)
    coupling = ForceFilter([0.0, 0.9, 0.995], [], np.broadcast_to(np.eye(2) / 800, (4, 2, 2)))
    running, meant = loop.sent(coupling), loop.sent(coupling, exact=True)
    t = Fraction(20503569, 10**10)  # z = (1 + it)^2/(1 + t^2)

    def response(G: Lti) -> np.ndarray:
        A, B, C, D = (np.vectorize(Fraction, otypes=[object])(part) for part in (G.A, G.B, G.C, G.D))
        n, turned = len(A), 2 * t / (1 + t * t) * numbers(np.eye(len(A)), Fraction(1))
        left = (1 - t * t) / (1 + t * t) * numbers(np.eye(n), Fraction(1)) - A
        X = solve(np.block([[left, -turned], [turned, left]]), np.vstack([B, 0 * B]))
        return (C @ X[:n] + D).astype(float) + 1j * (C @ X[n:]).astype(float)

    z, here = on_circle(frequencies(running)), complex((1 + 1j * float(t)) ** 2 / (1 + float(t) ** 2))
    exactly, apart = response(meant), np.abs(response(running) - response(meant)).max()
    assert 0 < apart < rounding(running, z, meant.floats()) < 1e-6 * np.abs(exactly).max()
    assert np.abs(meant.floats().at(here) - exactly).max() > apart
    assert certified(loop, coupling, "this-environment").certificate.proof == "rational"


def test_a_sweep_above_the_damping_refuses_proofs(monkeypatch):
    good = of_stiff_gains()
    worse = this_environment(DEFAULT.F(STIFF), (1.0, 1.0))
    ratio = worse.required[0] / 1.37 * 1.01
    needs = from_ratio("this-environment", ratio, DEFAULT.delta, 1.0)
    monkeypatch.setattr(design_certificate, "required_damping", lambda *_: needs)
    claims = change(good.certificate, required=needs.required, margin=1 / ratio)
    reason = verify(change(good, certificate=sealed(claims))).reason
    assert f"{ratio:.6g} times the available damping" in (reason or "")


@pytest.mark.parametrize(
    ("loop", "coupling", "message"),
    [
        (change(DEFAULT, theta=(400, 400), psi=(1, 0)), STIFF, "801 states.* 800 "),
        (DEFAULT, SpringDamper((7806.0, 3137.0), (1e-300, 1.0)), "1e-300 has too many digits for exact arithmetic"),
    ],
)
def test_limits_are_checked_before_anything_is_built(monkeypatch, loop, coupling, message):
    monkeypatch.setattr(Loop, "sent", lambda *_: pytest.fail("built"))
    for condition in ("this-environment", "any-environment"):
        with pytest.raises(NotProved, match=message):
            prove(loop, coupling, condition)


def test_proofs_with_too_many_digits_are_refused(tmp_path):
    good = of_stiff_gains()
    rows = [[f"1/{10**600 + 2 * (9 * i + j) + 1}" for j in range(9)] for i in range(9)]
    reason = verify(change(good, certificate=sealed(change(good.certificate, matrices={"P": tuple(map(tuple, rows))}))))
    assert reason.reason == "P has a common denominator of more than 4000 bits: testing it would take minutes"
    path = tmp_path / "coupling.json"
    save(good, path)
    path.write_text(path.read_text().replace(good.certificate.matrices["P"][0][0], "7" * 4000, 1))
    with pytest.raises(InputError, match="of length <= 1000"):
        load(path)


@pytest.mark.parametrize("name", ["T", "K", "version", "proof"])
def test_repeated_names_in_files_are_refused(tmp_path, name):
    path = tmp_path / "coupling.json"
    save(of_stiff_gains(), path)
    lines = path.read_text().splitlines(keepends=True)
    at = next(i for i, line in enumerate(lines) if f'"{name}":' in line)
    value = {"T": "0.002", "K": "[1.0, 1.0]", "version": "3", "proof": '"kyp"'}[name]
    path.write_text("".join([*lines[:at], f'"{name}": {value},\n', *lines[at:]]))
    with pytest.raises(InputError, match=f"coupling.json: names '{name}' twice in one object"):
        load(path)


def test_irregular_or_huge_files_are_refused(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(InputError, match="pipe: is not a regular file, expected a file"):
        load(tmp_path / "pipe")
    with pytest.raises(InputError, match="is a folder"):
        load(tmp_path)
    (tmp_path / "large.json").touch()
    os.truncate(tmp_path / "large.json", 50_000_001)
    with pytest.raises(InputError, match=r"large\.json: is larger than 50 MB"):
        load(tmp_path / "large.json")


# The any-environment condition


def test_any_environment_ignores_the_realisation_and_walls():
    structured = ANY_ENVIRONMENT.required(PAIR, SOFT)
    general = ANY_ENVIRONMENT.required(PAIR, Compliance(SOFT.compliance(PAIR.T)))
    assert max(structured.required) == pytest.approx(max(general.required), rel=1e-6)
    assert structured.certified
    walled = change(FIGURE_4, walls=(Wall(("contact 1", "ground"), 3000.0),))
    behind = required_damping(PAIR.at(walled), SOFT, "any-environment")
    assert behind.condition == "any-environment"
    assert behind.required == pytest.approx(required_damping(PAIR, SOFT, "any-environment").required, rel=1e-9)


# Budgets of time


def test_exact_arithmetic_ends_at_its_budget(monkeypatch):
    stored = certified(PAIR, STIFF, "this-environment")
    monkeypatch.setattr(budgets, "EXACT", 0.0)
    words = "exact arithmetic .* 0 s: too many"
    with pytest.raises(NotProved, match=words):
        prove(PAIR, STIFF, "this-environment")
    assert not verify(stored).proved
    assert re.match(words, verify(stored).reason)
    assert {requirement.proof for requirement in design_certificate.requirements_of(PAIR, SOFT).values()} == {"sampled"}
    with pytest.raises(NotProved, match=words):
        prove_limiter(PAIR, SpringDamper((3000.0, 2000.0), (0.1, 0.1)))
    with pytest.raises(NotProved, match=words):
        prove(PAIR.switching(DelayRange((1, 2), (1, 3))), SOFT, "this-environment")


# Bodies that can drift


DRAGGED = Network(("a",), (Spring(("a", "m1"), 0.0, 3.0), Spring(("m1", "m2"), 200.0, 0.1)), {"m1": 0.5, "m2": 0.3})
BETWEEN = Network(("a", "b"), (*DRAGGED.springs, Spring(("b", "m2"), 0.0, 2.0)), DRAGGED.masses)


@pytest.mark.parametrize("network", [DRAGGED, BETWEEN])
def test_a_body_that_only_dampers_drag_is_proved(network):
    m = len(network.contacts)
    loop = Loop(1e-3, (1,) * m, (0,) * m, (1,) * m, (5.0,) * m, network)
    for coupling in (NoCoupling(), SpringDamper((900.0,) * m, (0.2,) * m)):
        needed = required_damping(loop, coupling, "this-environment").required
        # A proof may need 1e-4 more damping than the sweep.
        for factor, expected in ((1 + 1e-4, True), (1 - 1e-6, False)):
            damped = change(loop, delta=tuple(d * factor for d in needed))
            try:
                assert verify(certified(damped, coupling, "this-environment")).proved == expected
            except NotProved:
                assert not expected


def test_proof_and_sweep_agree_on_random_networks():
    """Of 12 random networks 4 to 8 are proved, and the sweep agrees on each of the 12."""
    rows = list(proofs(11, 12))
    assert [row for row in rows if not row.holds] == []
    assert 3 < sum(row.proved for row in rows) < 9


def test_every_block_has_a_limit_of_states(monkeypatch):
    """A block with one state more than the limit is refused, and the message names the limit."""
    loop, coupling = scenario("omega-pair").loop("I"), SpringDamper((400.0, 300.0), (0.1, 0.1))
    wall, one = scenario("one-wall").loop("I"), SpringDamper((400.0,), (0.1,))
    limited = loop.sent(coupling).order + loop.channels + sum(loop.theta)
    blocks = {
        coupling.compliance(loop.T).order + sum(loop.theta): lambda: design_certificate._blocks(
            loop, coupling, ANY_ENVIRONMENT, None
        ),
        limited: lambda: design_certificate._blocks(loop, coupling, LIMITER, (1.0, 1.0)),
        walled(wall, one).order + 2: lambda: design_certificate._blocks(wall, one, THIS_ENVIRONMENT, [1.0] * 4),
    }
    for states, make in blocks.items():
        monkeypatch.setattr(budgets, "PROOF_STATES", states - 1)
        with pytest.raises(NotProved, match=f"up to {states - 1} are tried"):
            make()


def test_walls_without_a_solution_are_refused(monkeypatch):
    def singular(*_):
        raise SingularLoop("no solution")

    monkeypatch.setattr(environments.ThisEnvironment, "block", singular)
    loop, coupling = scenario("one-wall").loop("I"), SpringDamper((400.0,), (0.1,))
    with pytest.raises(NotProved, match="algebraic loop without solution"):
        design_certificate._blocks(loop, coupling, THIS_ENVIRONMENT, [1.0] * 4)


@pytest.mark.slow
def test_a_loop_with_a_long_delay_is_stored(tmp_path):
    """A delay of 101 samples, one more than an audit allows, is proved with 110 states, saved, loaded and verified."""
    loop, soft = scenario().replace(theta=(1, 101)).loop("I"), SpringDamper((400.0, 5.0), (0.0, 0.0))
    stored = Stored.of(loop, soft, prove(loop, soft, "this-environment"))
    save(stored, tmp_path / "late.json")
    again = load(tmp_path / "late.json")
    assert again.loop.theta == (1, 101)
    assert len(again.certificate.matrices["P"]) > 100
    assert verify(again) == Verdict(True)


@pytest.mark.parametrize("psi", [1001, 10**9, 2**70])
def test_delays_beyond_1000_samples_are_refused(psi):
    with pytest.raises(ValueError, match=rf"psi is \[{psi}, {psi}\].* 0 to 1000"):
        msgspec.structs.replace(PAIR, psi=(psi, psi))
    with pytest.raises(ValueError, match=rf"to \[{psi}, {psi}\] samples, expected 0 <= lo <= hi <= 1000"):
        DelayRange((1, 1), (psi, psi))


def test_saving_a_loop_without_damping_is_refused(tmp_path):
    stored = Stored(msgspec.structs.replace(PAIR, delta=(1.0, 0.0)), SOFT.form())
    with pytest.raises(InputError, match=r"bad.json: .* > 0.0 - at `\$.loop.delta"):
        save(stored, tmp_path / "bad.json")
    assert not (tmp_path / "bad.json").exists()


# Damping equal to the requirement


@pytest.mark.parametrize("condition", ["this-environment", "any-environment"])
@pytest.mark.parametrize("theta", [(0, 0), (1, 2)])
@pytest.mark.parametrize(("room", "certified"), [(0.0, False), (1e-15, False), (-1e-15, False), (1e-6, True)])
def test_no_condition_certifies_at_equality(condition, theta, room, certified):
    """No condition certifies at equality, where rounding alone would decide."""
    loop = msgspec.structs.replace(PAIR, theta=theta, lam=theta)
    need = required_damping(loop, SOFT, condition).required
    edge = msgspec.structs.replace(loop, delta=tuple(each * (1 + room) for each in need))
    assert required_damping(edge, SOFT, condition).certified is certified


def test_certificates_of_one_environment_list_no_ranges():
    """With psi = 1 a proof of Theorem 4 covers only the environment for which Phi was found, here the nominal one."""
    pair, coupling = scenario().loop("I"), SpringDamper([2800.0, 1700.0], [1.6, 2.2])
    ranges = ranges_around(pair.environment, 10.0)
    loop = msgspec.structs.replace(pair, psi=(1, 1), delta=(5.0, 5.0), ranges=ranges)
    certificate = prove(loop, coupling, "any-environment")
    assert (certificate.guarantee, certificate.facts) == (HERE, ())
    assert verify(Stored.of(loop, coupling, certificate)).proved


def of_own_spring(stiffness: float) -> Loop:
    """Return a loop around a spring whose class has no fields. Each call defines another class of the same name."""

    class Own(Environment):
        contacts = ("tip",)

        def E(self, T):
            return Lti.constant(numbers([[stiffness]], T), T)

    return Loop(1e-3, (1,), (0,), (0,), (1.37,), Own())


def test_environments_of_equal_class_names_need_separate_proofs():
    """A spring k alone needs (theta + 1/2) k T: 0.75 N s/m for 500 N/m, 7.5 for 5000, so one proof covers one of them.

    `proves` does not verify a certificate that this process has made, so only the digest tells the two loops apart.
    """
    soft, stiff, same = (of_own_spring(k) for k in (500.0, 5000.0, 500.0))
    certificate = prove(soft, NoCoupling(), THIS_ENVIRONMENT)
    assert certificate.required == pytest.approx((0.75,))
    assert proves(soft, NoCoupling(), certificate)
    assert proves(same, NoCoupling(), certificate)
    assert required_damping(stiff, NoCoupling(), THIS_ENVIRONMENT).ratio == pytest.approx(7.5 / 1.37)
    assert not proves(stiff, NoCoupling(), certificate)
