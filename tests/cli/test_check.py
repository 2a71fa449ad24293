"""design.check has the right exit codes and output, and imports no solver."""

import json
import subprocess
import sys

import pytest
from shared import PAIR, SOFT

from haptic_loop.cli.check import main
from haptic_loop.cli.execute import execute
from haptic_loop.design.certificate import prove
from haptic_loop.design.coupling_file import Stored, save
from haptic_loop.design.result import ANY


def leave(monkeypatch, *argv: str) -> int:
    """Run the command and return its exit code."""
    monkeypatch.setattr(sys, "argv", ["design.check", *argv])
    with pytest.raises(SystemExit) as leaving:
        execute(main)
    return leaving.value.code


@pytest.fixture
def path(tmp_path):
    file = tmp_path / "coupling.json"
    save(Stored.of(PAIR, SOFT, prove(PAIR, SOFT, "any-environment")), file)
    return file


def test_check_of_a_proof_exits_with_0(path, capsys):
    assert main([str(path), "--json", "-"]) == 0
    out, err = capsys.readouterr()
    result = json.loads(out)
    assert result["proved"]
    assert result["guarantee"] == ANY
    assert result["required_damping"][0] < 1.37
    assert "proved, in exact arithmetic" in err


def test_a_changed_gain_exits_with_1(path, tmp_path, capsys):
    path.write_text(path.read_text().replace("878.7", "887.5"))
    assert main([str(path), "--json", str(tmp_path / "result.json")]) == 1
    assert "not proved" in capsys.readouterr().out
    result = json.loads((tmp_path / "result.json").read_text())
    assert "digest differs" in result["reason"]
    assert result["guarantee"] is None


@pytest.mark.parametrize("content", [None, b"", b"{", b"[]", b"\xff", b'{"loop": {}}', b"[" * 100000])
def test_bad_input_exits_with_2_and_one_line(tmp_path, capsys, monkeypatch, content):
    file = tmp_path / "bad.json"
    if content is not None:
        file.write_bytes(content)
    assert leave(monkeypatch, str(file)) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("error: ")
    assert err.count("\n") == 1


def test_checking_imports_no_solver(path):
    """Neither clarabel, which designs use, nor cvxpy, which matrix expressions use, is loaded."""
    code = f"import sys, cli.check as c; print(c.main([{str(path)!r}]), {{'clarabel', 'cvxpy'}} & {{*sys.modules}})"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout.splitlines()[-1] == "0 set()"


def test_an_interruption_exits_with_130(path, monkeypatch):
    def interrupted(*arguments):
        raise KeyboardInterrupt

    monkeypatch.setattr("haptic_loop.cli.check.verify", interrupted)
    assert leave(monkeypatch, str(path)) == 130
