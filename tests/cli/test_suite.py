"""The suite runs commands as a user would, and its report says what each found and how to repeat it."""

import json
import os
import re
import shlex
import subprocess
import sys
from dataclasses import replace
from functools import partial
from importlib import import_module

import pytest
from haptic_loop.cli import suite
from haptic_loop.cli.options import Parser
from haptic_loop.cli.suite import CHECKS, Check, main
from haptic_loop.sim.scenario import InputError

from tests.checks import endurance, ours

HARD = next(check for check in ours.CHECKS if check.name == "hard")
QUICK = "sim.validate --case none --humans {humans} --links mixed --duration 0.3 --engine exact --seed {seed}"


def only(monkeypatch, *checks):
    """The suite has these checks alone."""
    monkeypatch.setattr(suite, "CHECKS", checks)
    monkeypatch.setattr(suite, "_measuring", lambda: ())


@pytest.fixture
def quick(monkeypatch):
    """Two checks of a second."""
    only(monkeypatch, Check("none", "No coupling?", QUICK, suite._verdicts), HARD)


@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.name)
def test_every_check_is_a_command_with_its_options(check, monkeypatch):
    module, *options = shlex.split(check.command(3, 1))
    parse = Parser.parse_args

    class Parsed(Exception):
        pass

    def understood(self, *args, **kwargs):
        raise Parsed(parse(self, *args, **kwargs).out)

    monkeypatch.setattr(Parser, "parse_args", understood)
    with pytest.raises(Parsed, match="x"):
        import_module(f"haptic_loop.cli.{module.removeprefix('sim.')}").main([*options, "--out", "x"])


def test_names_of_checks_are_folders_of_their_own():
    assert len(suite._checks()) == len(CHECKS) + len(ours.CHECKS)


def test_from_another_folder_with_tests_of_its_own_all_checks_are_there(tmp_path):
    (tmp_path / "tests").mkdir()
    (tmp_path / "tests" / "__init__.py").write_text("raise SystemExit('not these')")
    code = "from haptic_loop.cli import suite; print(*suite._checks())"
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout.split()) == (0, list(suite._checks())), done.stderr


def test_installed_without_the_repository_there_are_commands_alone(monkeypatch, tmp_path):
    package = tmp_path / "cli" / "suite.py"
    monkeypatch.setattr(suite, "__file__", str(package))
    suite._measuring.cache_clear()
    monkeypatch.setattr(suite, "_measuring", suite._measuring.__wrapped__)
    assert list(suite._checks()) == [check.name for check in CHECKS]
    with pytest.raises(InputError, match=r"has 'hard', allowed are none, .*\. The checks that .* come with its repos"):
        main(["--only", "hard"])


def test_the_report_begins_with_verdicts_and_every_number_has_its_command(tmp_path, quick):
    assert main(["--humans", "20", "--seed", "3", "--out", str(tmp_path), "--json", str(tmp_path / "r.json")]) == 0
    text, outcome = (tmp_path / "report.md").read_text(), json.loads((tmp_path / "r.json").read_text())
    assert outcome["holds"]
    assert [check["name"] for check in outcome["checks"]] == ["none", "hard"]
    headings = re.findall(r"^## (.*)$", text, flags=re.MULTILINE)
    assert headings == ["Verdicts", "No coupling?", "Numerically hard loops", "Where this was run"]
    command = f"python -m {QUICK.format(humans=20, seed=3)}"
    assert f"| `{command}` |" in text
    assert f"```sh\n{command}\n```" in text
    # the figures are those of the command itself
    found = json.loads((tmp_path / "none" / "report.json").read_text())
    assert outcome["checks"][0]["report"] == found
    assert re.search(rf"│ unstable +│ {found['unstable']['exact']} exact ", text)
    assert "| handle of 1 g, no human damping | -0.1670 | RK4 x 1: refused | RK4 x 48 |" in text
    pictures = re.findall(r"!\[.*?\]\((.*?)\)", text)
    assert pictures == ["none/population.png"]
    assert all((tmp_path / picture).stat().st_size > 10_000 for picture in pictures)
    anchors = re.findall(r"\]\(#(.*?)\)", text)
    assert anchors == ["no-coupling", "numerically-hard-loops"]


def test_a_check_that_fails_fails_the_suite_and_the_rest_is_done(tmp_path, quick, monkeypatch):
    monkeypatch.setattr("tests.checks.hard.CLOSE", 0.0)  # as if the rule were wrong
    assert main(["--humans", "5", "--out", str(tmp_path)]) == 1
    text = (tmp_path / "report.md").read_text()
    assert "**1 of 2 checks hold; not: hard.**" in text
    assert "| **does not hold** | [Numerically hard loops]" in text


def test_a_check_that_cannot_run_is_no_success(tmp_path, monkeypatch, capsys):
    broken = Check("broken", "Nothing there?", "sim.validate --scenario missing.toml", suite._verdicts)
    only(monkeypatch, broken)
    # what an earlier run left behind is not this one's
    (tmp_path / "broken").mkdir()
    (tmp_path / "broken" / "report.json").write_text('{"stale": true}')
    assert main(["--out", str(tmp_path)]) == 1
    assert "scenario missing.toml: No such file" in (tmp_path / "report.md").read_text()
    assert "scenario missing.toml: No such file" in capsys.readouterr().out
    assert json.loads((tmp_path / "report.json").read_text())["checks"][0]["report"] == {}


def test_a_session_of_seconds_and_some_hands_end_as_they_must_with_flat_memory():
    session = endurance._endure(lambda mark: endurance._long_session(mark, 10.0), 4.0)
    assert session.holds, session
    assert re.fullmatch(r"finished \(asked to\) after \d{4,5} ticks", session.result)
    hands = endurance._endure(lambda mark: endurance._many_hands(mark, 1250), 8.0)
    assert hands.holds, hands
    assert hands.result == "0 of 1250 unstable"


def test_memory_that_grows_and_work_that_goes_wrong_do_not_hold():
    kept = []

    def hoards(mark):
        mark(0.1)
        top = endurance._peak()
        while endurance._peak() < top + 16:  # what was freed before is used first
            kept.append(bytearray(2**20))
        return True, "done"

    row = endurance._endure(hoards, 8.0)
    assert row.end_mib - row.tenth_mib >= 8
    assert not row.holds
    assert not endurance._endure(lambda mark: (mark(0.5), (False, "lost"))[1], 8.0).holds


def test_long_work_is_done_by_a_process_of_its_own(monkeypatch):
    """One that dies is a row that does not hold."""
    monkeypatch.setattr(
        endurance, "_LONG", (("dies", os.abort, 8.0), ("runs", partial(endurance._many_hands, count=125), 8.0))
    )
    died, ran = endurance.endurance(1)
    assert (died.result, died.holds) == ("broke off", False)
    assert ran.result == "0 of 125 unstable"
    assert ran.holds
    parts = ours.memory_table({"rows": [vars(died), vars(ran)]})
    assert parts[0].rows[0][2:] == ("-", "-")
    assert parts[0].answer == "1 of 2 end as they must, with flat memory"


def test_ctrl_c_keeps_the_checks_that_are_done(tmp_path, monkeypatch):
    def interrupted(case):
        raise KeyboardInterrupt

    other = replace(HARD, name="other", asks="Never asked?")
    first = Check("none", "No coupling?", QUICK, suite._verdicts)
    only(monkeypatch, first, HARD, other)
    monkeypatch.setattr("tests.checks.hard.measure", interrupted)
    assert main(["--humans", "5", "--out", str(tmp_path)]) == 130
    outcome = json.loads((tmp_path / "report.json").read_text())
    assert outcome["interrupted"]
    assert not outcome["holds"]
    assert outcome["checks"][0]["holds"]
    assert outcome["left_out"] == ["other"]
    assert "Interrupted." in (tmp_path / "report.md").read_text()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--only", "all"], "--only has 'all', allowed are none, I, II"),
        (["--humans", "0"], "--humans is 0, allowed are 1 to 1000000"),
        (["--seed", "x"], "--seed is 'x', expected a whole number"),
    ],
)
def test_bad_calls(options, message, tmp_path):
    with pytest.raises(InputError, match=message):
        main([*options, "--out", str(tmp_path)])
