"""Every command accepts the condition that docs/extending.md shows."""

import json
import re
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

from haptic_loop import certify, design_coupling, load
from haptic_loop.design.files import InputError
from haptic_loop.hw.control import CouplingRequest, SafetyStop, certified_coupling
from tests.evaluate import decisive

PAGE = (Path(__file__).parents[2] / "docs/extending.md").read_text()
NAME, OWN = "joined-devices", "joined_devices.py:JoinedDevices"
JSON = ["--json", "report.json"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return a folder with the page's condition in a file, and a spring-damper that `design` wrote for it."""
    place = tmp_path_factory.mktemp("own")
    code = re.search(r"```python\n# joined.py\n(.*?)```", PAGE, re.DOTALL)[1]
    (place / "joined_devices.py").write_text(code)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(place)
        assert run("design", "--out", "joined.json", *JSON) == 0
        (place / "design.json").write_text((place / "report.json").read_text())
    return place


CLAIMED = "you must show"  # words of Condition.claim


def run(command: str, *words: str) -> int:
    return import_module(f"haptic_loop.cli.{command}").main([*words, "--condition", OWN])


@pytest.mark.slow
def test_own_condition_designs_are_proved_and_tight(folder):
    report = json.loads((folder / "design.json").read_text())
    needs = report["assessment"]["requirements"][NAME]
    assert decisive(report) == needs
    assert (needs["proof"], report["stored"]["proof"]) == ("rational", "rational")
    assert 1.36 < max(needs["required_damping"]) < 1.37
    # the devices' joint damping is a full matrix with the eigenvalues 1.37 - .2 and 1.37 + .2
    here = max(report["assessment"]["requirements"]["this-environment"]["required_damping"])
    assert 1.37 * here / 1.57 < max(needs["required_damping"]) < 1.37 * here / 1.17
    assert CLAIMED in report["claim"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("command", "words"),
    [
        ("check", ["joined.json"]),
        ("audit", ["--coupling", "joined.json"]),
        ("export", ["joined.json"]),
        ("compare", ["--coupling", f"joined.json,moving-average:{OWN}", "--no-plot"]),
        ("run", ["--coupling", "joined.json", "--duration", ".1", "--no-plot"]),
        ("validate", ["--coupling", "joined.json", "--humans", "3", "--duration", "0", "--no-plot"]),
        pytest.param(
            "zwidth",
            ["--grid", "4", "--points", "0", "--humans", "2", "--no-plot"],
            marks=pytest.mark.slow,
        ),
        ("zwidth", ["--coupling", "joined.json", "--grid", "4", "--points", "0", "--humans", "2", "--no-plot"]),
        ("bridge", ["--rehearse", "--coupling", "joined.json", "--duration", ".1", "--no-plot"]),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_every_command_judges_by_the_own_condition(command, words, folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    assert run(command, *words, *JSON) == 0
    shown, text = capsys.readouterr().out, Path("report.json").read_text()
    if command == "export":
        assert "certificate │ proved" in shown
        return
    assert f'"{NAME}"' in text
    assert NAME in shown
    assert CLAIMED in text
    if "joined.json" in words and command != "check":
        assert "does not hold" not in text


@pytest.mark.slow
def test_the_given_condition_decides_an_audit(folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    assert (
        import_module("haptic_loop.cli.audit").main(["--coupling", "joined.json", "--condition", "any-environment"])
        == 1
    )
    assert " by any-environment" in " ".join(capsys.readouterr().out.split())


def test_a_file_without_its_condition_is_explained(folder, monkeypatch):
    monkeypatch.chdir(folder)
    assert import_module("haptic_loop.cli.check").main(["joined.json", *JSON]) == 1
    assert "condition is 'joined-devices', allowed are" in Path("report.json").read_text()
    words = ["--coupling", "joined.json", "--duration", ".1", "--no-plot", *JSON]
    assert import_module("haptic_loop.cli.run").main(words) == 0
    report = json.loads(Path("report.json").read_text())
    assert report["assessment"]["condition"] == "this-environment"
    assert any("condition is 'joined-devices'" in remark for remark in report["remarks"])


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            ["--coupling", "optimal"],
            "spring-damper, moving-average and FILE.py:NAME",
        ),
        (["--scenario", "one-wall"], "the loop has walls, which the condition joined-devices does not name in covers"),
    ],
)
def test_designs_without_own_conditions_are_refused(words, message, folder, monkeypatch):
    monkeypatch.chdir(folder)
    monkeypatch.setattr("haptic_loop.design.api.instead", lambda *failed: "")  # `instead` would design other couplings.
    with pytest.raises(ValueError, match=message) as caught:
        run("design", *words)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("named", "message"),
    [
        ("joined_devices.py:Nothing", "has no Nothing; it defines JoinedDevices"),
        ("joined_devices.py:np", "has no np"),
        ("nowhere/mine.py:Mine", "there is no file nowhere/mine.py"),
        ("pathlib:Path", "expected FILE.py:NAME"),
        ("joined_devices.py:Demand", "joined_devices.py:Demand"),
        ("this-env", "this-environment, .*FILE.py:NAME"),
    ],
)
def test_objects_other_than_conditions_are_refused(named, message, folder, monkeypatch):
    monkeypatch.chdir(folder)
    with pytest.raises(InputError, match=message):
        import_module("haptic_loop.cli.design").main(["--condition", named])


def test_python_functions_accept_an_own_condition(folder, monkeypatch):
    monkeypatch.chdir(folder)
    own = import_module("joined_devices").JoinedDevices()
    loop = load("omega-pair").loop("I")
    design = design_coupling(loop, "moving-average", own)
    assert (design.condition, design.own) == (NAME, own)
    needs = certify(loop, design)
    assert needs[NAME].proof == "rational"
    assert certify(loop, design.coupling, own)[NAME].required == needs[NAME].required
    assert NAME not in certify(loop, design.coupling)
    # with Delta = 1.37 I the block would be that of this-environment; the full matrix's eigenvalues bound the ratio
    assert 1 / 1.57 < needs[NAME].ratio / needs["this-environment"].ratio / 1.37 < 1 / 1.17
    assert np.isfinite(needs["any-environment"].ratio)


NEVER = """
from dataclasses import replace
from haptic_loop.design.conditions import Condition, this_environment_demand

class Never(Condition):
    name = "never"
    def demand(self, loop, coupling, exact=False):
        linear = this_environment_demand(loop.F(coupling, exact), loop)
        return replace(linear, free=linear.free * 2)
"""


@pytest.mark.parametrize(
    ("command", "words", "code"),
    [
        ("audit", [], 1),
        ("run", ["--duration", ".1", "--no-plot"], 0),
        ("validate", ["--humans", "2", "--duration", "0", "--no-plot"], 1),
        pytest.param("compare", ["--no-plot"], 0, marks=pytest.mark.slow),
        pytest.param(
            "zwidth",
            ["--grid", "4", "--points", "0", "--humans", "2", "--no-plot", "--K-range", "9e3,1e4"],
            0,
            marks=pytest.mark.slow,
        ),
    ],
)
def test_a_condition_that_fails_is_nowhere_claimed(command, words, code, folder, monkeypatch):
    monkeypatch.chdir(folder)
    (folder / "never.py").write_text(NEVER)
    options = ["--coupling", "joined.json", "--condition", "never.py:Never"]
    assert import_module(f"haptic_loop.cli.{command}").main([*options, *words, *JSON]) == code
    text = Path("report.json").read_text()
    assert "fails the condition never: needs 2." in text
    assert CLAIMED not in text


def test_only_the_given_condition_arms_a_device(folder, monkeypatch):
    monkeypatch.chdir(folder)
    (folder / "never.py").write_text(NEVER)
    own = import_module("never").Never()
    with pytest.raises(SafetyStop, match=r"theta = \[1, 2\]: .*never needs 2\."):
        certified_coupling(CouplingRequest(load("omega-pair"), name="joined.json", condition=own), 1)


def test_exported_blocks_state_the_claim_of_own_conditions(folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    assert run("export", "joined.json", "--out", "joined.c", *JSON) == 0
    assert CLAIMED in capsys.readouterr().out
    assert CLAIMED in Path("joined.c").read_text().replace("\n *     ", " ")
    assert CLAIMED in json.loads(Path("report.json").read_text())["claim"]
