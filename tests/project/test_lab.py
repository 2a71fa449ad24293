"""Two unlike devices, from a scenario to C code, without a refusal on the way."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from cli.main import COMMANDS, _command
from cli.options import DOES_NOT_HOLD, DONE

LAB = str(Path(__file__).parents[2] / "examples/lab.toml")
DESIGNS = [
    ("spring-damper", []),
    ("anywhere", ["--condition", "any-environment"]),
    ("average", ["--coupling", "moving-average"]),
    ("best", ["--best", "--seconds", "1"]),
]


def go(command: str, *words: str, holds: bool = True) -> None:
    assert command in COMMANDS
    code = _command(command).main([*words])
    assert code == DONE if holds else code in (DONE, DOES_NOT_HOLD)


def test_from_scenario_to_c(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    lab = ("--scenario", LAB)
    go("run", *lab, "--duration", "1", "--no-plot", "--out", "run")
    report = json.loads(Path("run/report.json").read_text())
    assert report["certificate"]["certified"]
    assert report["stability"]["verdict"] == "stable"
    assert [other["coupling"] for other in report["alternatives"]] == [
        "none",
        "spring-damper",
        "spring-damper",
        "optimal",
    ]
    assert not any("reason" in other for other in report["alternatives"])
    for name, asked in DESIGNS:
        go("design", *lab, *asked, "--out", f"{name}.json")
        go("check", f"{name}.json")
        go("audit", *lab, "--coupling", f"{name}.json", "--out", "audit")
        go(
            "validate",
            *lab,
            "--coupling",
            f"{name}.json",
            "--humans",
            "10",
            "--duration",
            "0",
            "--no-plot",
            "--out",
            "v",
        )
        go("export", f"{name}.json", "--process", "--out", f"{name}.c")
    said = capsys.readouterr().err
    assert "error" not in said
    assert "not possible" not in said


@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")
def test_the_exported_tick_passes_its_own_test(tmp_path):
    make = [sys.executable, "-m", "design", "--scenario", LAB, "--best", "--seconds", "1", "--out", "best.json"]
    subprocess.run(make, cwd=tmp_path, check=True, capture_output=True)
    export = [sys.executable, "-m", "design.export", "best.json", "--process", "--out", "best.c"]
    subprocess.run(export, cwd=tmp_path, check=True, capture_output=True)
    flag = "-DHAPTIC_LOOP_TEST"
    subprocess.run(["cc", "-std=c99", flag, "best.c", "-lm", "-o", "best"], cwd=tmp_path, check=True)
    subprocess.run(["./best"], cwd=tmp_path, check=True)
