"""The limit curve and the ladder as a user meets them, and what varies along each axis."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from asked import this_environment
from haptic_loop.cli import compare as command
from haptic_loop.cli.compare import main
from haptic_loop.controller.coupling import PUBLISHED
from haptic_loop.controller.environment import environment
from haptic_loop.design import compare as limit_curve
from haptic_loop.design.compare import (
    AXES,
    LADDERS,
    SHORT,
    Point,
    Sweep,
    ladder_row,
    measured,
    optimum,
    points_along,
    remembered,
)
from haptic_loop.design.program import LADDER, Options
from haptic_loop.design.robustness import Nearby
from haptic_loop.sim.compare_report import Here, LimitCurves
from haptic_loop.sim.plots import plot_limits
from haptic_loop.sim.scenario import InputError, load
from worlds import force_map

LOOP = load().loop("I")
SMALL = Options(ladder=LADDER[:1])
IMPOSSIBLE = Point(0.0, load().replace(theta=(60, 60), delta=(1e-3, 1e-3)).loop("I"), SMALL)


def unasked(loop, coupling):
    """What a coupling needs nearby, where no test asks."""
    return Nearby()


@pytest.fixture(scope="module")
def impossible():
    """What is measured where no spring-damper is found, once: the search takes seconds."""
    return measured(IMPOSSIBLE, "spring-damper", "this-environment", {})


def run(tmp_path, *options):
    file = tmp_path / "r.json"
    code = main([*options, "--out", str(tmp_path / "out"), "--json", str(file)])
    return code, json.loads(file.read_text())


# what varies ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("axis", AXES)
@pytest.mark.parametrize("points", [1, 2, 5])
def test_what_there_is_lies_among_the_points(axis, points):
    """Values grow, nothing but the axis' own quantity changes, and one point is the loop as it is."""
    along = points_along(axis, LOOP, SMALL, points)
    values = [s.value for s in along]
    assert values == sorted(set(values))
    assert len(values) <= points
    assert any(s.loop == LOOP and s.options == SMALL for s in along)
    for s in along:
        changed = {name for name in LOOP.__struct_fields__ if getattr(s.loop, name) != getattr(LOOP, name)}
        assert changed <= {"damping": {"delta"}, "delay": {"theta", "lam"}, "period": {"T"}, "order": set()}[axis]


def test_unequal_devices_are_scaled_alike():
    loop = load("three-rigid").loop("I")
    for s in points_along("damping", loop, SMALL, 3, (0.4, 1.6)):
        assert min(s.loop.delta) == pytest.approx(s.value, rel=1e-12)
        np.testing.assert_allclose(np.array(s.loop.delta) / loop.delta, s.value / 0.8, rtol=1e-12)


def test_the_reference_keeps_what_it_lacks():
    """Case I stays delay-matched; case II stays ahead."""
    for case, expected in (("I", [(0, 1), (1, 2), (2, 3)]), ("II", [(0, 0)] * 3)):
        along = points_along("delay", load().loop(case), SMALL, 3)
        assert [s.loop.lam for s in along] == expected
        assert [s.loop.theta for s in along] == [(0, 1), (1, 2), (2, 3)]


def test_delays_in_seconds_are_never_shortened():
    along = points_along("period", LOOP, SMALL, 6, (0.3e-3, 2.4e-3), "seconds")
    for s in along:
        for samples, before in zip(s.loop.theta, LOOP.theta, strict=True):
            assert samples * s.loop.T >= before * LOOP.T * (1 - 1e-9)
            assert (samples - 1) * s.loop.T < before * LOOP.T
        assert s.loop.lam == s.loop.theta
    assert along[0].loop.theta == (4, 8)


# what is designed -------------------------------------------------------------------------------------------------


def test_more_damping_is_never_worse_and_the_figures_are_the_designs_own():
    """The feasible set grows with the damping."""
    limits_ = [optimum(s) for s in points_along("damping", LOOP, SMALL, 3, (1.3, 1.5))]
    rms = [limit.rms_mismatch_db for limit in limits_]
    assert rms[0] > rms[1] > rms[2]
    for limit in limits_:
        assert max(limit.required_damping) < limit.delta[0]
        np.testing.assert_allclose(limit.bare_damping, 1.7229, rtol=1e-4)


def test_more_rungs_are_never_worse():
    rms = [optimum(Point(n, LOOP, Options(ladder=LADDER[:n]))).rms_mismatch_db for n in (1, 2, 3)]
    assert rms == sorted(rms, reverse=True)


def test_a_point_without_a_solution_keeps_its_reason(impossible):
    assert impossible.rms_mismatch_db is None
    assert impossible.reason
    assert impossible.wall_s > 0


def test_nothing_is_designed_twice():
    calls = []

    def counted(point):
        calls.append(point)
        return measured(point, "spring-damper", "any-environment", {})

    recall = remembered(counted, False)
    along = points_along("order", LOOP, Options(), 2)
    first, again = (recall(s) for s in along)
    assert len(calls) == 1
    assert first.rms_mismatch_db == again.rms_mismatch_db
    assert (first.value, again.value) == tuple(s.value for s in along)


# the command --------------------------------------------------------------------------------------------------------


def test_the_command_draws_and_reports(tmp_path):
    code, report = run(tmp_path, "--over", "damping=1:2,order=1:2", "--points", "3", "--beside", "any-environment")
    assert code == 0
    assert set(report["sweeps"]) == {"damping", "order"}
    damping = report["sweeps"]["damping"]
    assert damping["values"] == [row["value"] for row in damping["optimal"]] == [1.0, 1.37, 2.0]
    first, here, free = damping["optimal"]
    assert first["rms_mismatch_db"] > here["rms_mismatch_db"]
    assert here["rms_mismatch_db"] == pytest.approx(-34.9, abs=0.1)
    assert free["relative_mismatch_db"] is None  # safe without any coupling: no mismatch at all
    assert free["reason"] is None
    assert len(damping["any-environment"]) == 3
    assert "this-environment" not in damping
    assert any("(here)" in line for line in report["gains"])
    assert any("without any coupling: needs 1.723, 1.723 N s/m, 1.26 times" in line for line in report["gains"])
    assert (tmp_path / "out" / "limits.png").read_bytes().startswith(b"\x89PNG")
    assert not report["interrupted"]


def test_nothing_found_is_exit_code_1(tmp_path, monkeypatch, impossible):
    monkeypatch.setattr(limit_curve, "optimum", lambda point: impossible)
    code, report = run(tmp_path, "--over", "order=1:2", "--points", "2", "--beside", "none")
    assert code == 1
    assert all(row["reason"] for row in report["sweeps"]["order"]["optimal"])
    assert (tmp_path / "out" / "limits.png").is_file()


def test_interrupting_keeps_the_points_that_are_done(tmp_path, monkeypatch):
    calls = []

    def interrupted(point):
        calls.append(point)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return measured(point, "spring-damper", "any-environment", {})  # what is designed does not matter here

    monkeypatch.setattr(limit_curve, "optimum", interrupted)
    code, report = run(tmp_path, "--over", "damping=1.3:1.5", "--points", "4", "--beside", "none")
    assert code == 130
    assert report["interrupted"]
    assert len(report["sweeps"]["damping"]["optimal"]) == 2
    assert len(report["sweeps"]["damping"]["values"]) == 4


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--over", "mass"], "--over has 'mass', allowed are damping, delay, period, order"),
        (["--over", "damping=2:1"], "--over damping=2:1: the range 2:1 is none between 0.001 and 1000 N s/m"),
        (["--over", "damping=2"], "--over damping=2: expected LOW:HIGH in N s/m"),
        (["--over", "damping=a:2"], "--over damping is 'a', expected a number"),
        (["--over", "delay=0:3"], "--over delay=0:3: delay starts at 0, but the channels differ by 1 samples"),
        (["--over", "delay=1.5:3"], "expected whole numbers of samples"),
        (["--over", "--points", "0"], "--points is 0, allowed are 1 to 100"),
        (["--over", "--high-gain", "0.5"], "--high-gain is 0.5, expected a factor of at least 1"),
        (["--over", "--band", "8"], "--band is '8', expected two numbers"),
        (["--over", "--case", "none"], "--case none has no coupling to design"),
        (["--ladder", "--over", "order"], "--over with --ladder: give one of them"),
        (["--ladder", "--seconds", "3"], "--seconds is only with --over"),
        (["--ladder", "--case", "II"], "--ladder shows both cases"),
        (["--ladder", "long"], "argument --ladder: invalid choice: 'long'"),
        (["--over", "order=1:500"], "--over order=1:500: the range 1:500 is none between 1 and 7 rungs"),
        (["--over", "period=1e-9:1"], "--over period=1e-9:1: the range"),
        (["--over", "--delta", "0"], "expected positive dampings"),
    ],
)
def test_bad_options(options, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError) as caught:
        main(options)
    assert message in str(caught.value)
    assert not list(tmp_path.rglob("*.json"))


def test_a_picture_of_every_number_of_panels(tmp_path):
    rows = [SimpleNamespace(value=1.0, rms_mismatch_db=db, relative_mismatch_db=-5.0, proof=None) for db in (-10, None)]
    sweep = Sweep("x", "s", [1.0], {"optimal": rows})
    here = Here((1.37,), (1,), (0,), 1e-3)
    for n in range(1, 5):
        chosen = dict.fromkeys(list(AXES)[:n], sweep)
        report = LimitCurves("s", 0, "I", "rms", "samples", SMALL, here, chosen, [], 0.0, False)
        assert plot_limits(report, tmp_path / f"{n}.png").stat().st_size > 5000


# the ladder ---------------------------------------------------------------------------------------------------------


def test_rungs_are_the_designs_that_they_name():
    """Against figures of their own: required damping and mismatch of the other commands."""
    by_name = {entry.name: entry for entry in SHORT}
    published = ladder_row("I", LOOP, by_name["published"], unasked)
    E = environment(LOOP.environment, LOOP.T)
    expected = this_environment(force_map(E, PUBLISHED["I"], LOOP.theta, LOOP.psi), LOOP.delta)
    assert published.design == "published (27)"
    assert published.required_damping == expected.required
    assert not published.certified
    assert published.proof is None
    assert published.relative_mismatch_db == pytest.approx(7.70, abs=0.005)
    any_environment = ladder_row("I", LOOP, by_name["spring-damper, any-environment"], unasked)
    assert any_environment.required_damping == pytest.approx([0.7145] * 2, abs=1e-4)
    assert any_environment.condition == "any-environment"
    assert any_environment.proof == "rational"
    optimal = ladder_row("I", LOOP, by_name["optimal"], unasked)
    assert optimal.rms_mismatch_db <= -34.8
    assert optimal.proof == "rational"
    assert optimal.certified
    limit = ladder_row("I", LOOP, by_name["bound for any linear coupling"], unasked)
    assert optimal.rms_mismatch_db - 1 < limit.rms_mismatch_db < optimal.rms_mismatch_db
    assert limit.required_damping is None


def test_a_rung_that_does_not_exist_says_so():
    loop = load("three-rigid").loop("I")
    missing = ladder_row("I", loop, next(entry for entry in SHORT if entry.kind == "published"), unasked)
    assert missing.required_damping is None
    assert missing.reason == "the paper prints gains for 2 channels, not 3"


def test_the_ladder_is_a_command(tmp_path, monkeypatch):
    monkeypatch.setitem(LADDERS, "short", SHORT[:3])
    code, report = run(tmp_path, "--ladder")
    assert code == 0
    assert [(row["case"], row["design"]) for row in report["rows"]] == [
        (case, name)
        for case, printed in (("I", "(27)"), ("II", "(28)"))
        for name in ("none", f"published {printed}", "spring-damper, any-environment")
    ]
    assert report["rows"][0]["rms_mismatch_db"] is None
    assert report["rows"][3]["relative_mismatch_db"] == pytest.approx(0.34, abs=0.005)


# what is proved ---------------------------------------------------------------------------------------------------


def test_a_point_says_what_is_proved_of_it(monkeypatch, impossible):
    """Each design's own condition; a proof that fails leaves the point sampled, with the reason."""
    point = points_along("order", LOOP, SMALL, 1)[0]
    assert (optimum(point).proof, optimum(point).proof_reason) == ("rational", None)
    assert impossible.proof is None

    def hopeless(*arguments):
        raise limit_curve.NotProved("too many states")

    monkeypatch.setattr(limit_curve, "prove", hopeless)
    limit = measured(point, "spring-damper", "any-environment", {})
    assert (limit.proof, limit.proof_reason) == ("sampled", "too many states")
    row = {"optimal": replace(limit, proof="rational"), "any-environment": limit, "this-environment": None}
    assert command._proofs(row) == "sampled: any-environment"
    assert command._proofs({"optimal": replace(limit, proof=None)}) == "-"


def test_a_scenario_that_fixes_the_reference_delays_has_one_ladder(monkeypatch, tmp_path, capsys):
    monkeypatch.setitem(LADDERS, "short", SHORT[:1])
    five = Path(__file__).parents[1] / "loops" / "o09-five.toml"
    main(["--ladder", "--scenario", str(five), "--out", str(tmp_path)])
    told = capsys.readouterr().out
    assert told.count("the ladder") == 1
    assert "lam 0, 0, 0, 0, 0" in told
    assert "case I" not in told
