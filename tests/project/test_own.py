"""The commands accept a user's own classes from a file outside of the repository."""

import json

import pytest
from forked import run

from haptic_loop.design.files import InputError
from haptic_loop.design.own import is_refusal, named, place_of

MINE = """
from dataclasses import dataclass

import numpy as np

from haptic_loop.controller.coupling import Compliance, Coupling
from haptic_loop.controller.environment import Network, Spring, Wall
from haptic_loop.controller.lti import Lti, numbers, taps


@dataclass
class Weighted(Coupling):
    K: float
    T: float

    def compliance(self, T):
        return Lti.diag(*[taps(numbers([0.8, 0.2], T) / numbers(self.K, T), T)] * 2)

    def form(self):
        return Compliance(self.compliance(self.T)).form()


class Duck:
    around, compliance, form = Weighted.around, Weighted.compliance, Weighted.form


def duck(loop):
    return Duck()


def weighted(loop):
    return Weighted(900.0, loop.T)


@dataclass
class Hardening:
    between: list
    stiffness: float
    step: float

    def parts(self):
        (a, b), k = self.between, self.stiffness
        return [Spring((a, b), k), Wall((a, b), 3 * k, gap=self.step), Wall((b, a), 3 * k, gap=self.step)]


class Negative(Hardening):
    def parts(self):
        return [Spring(tuple(self.between), -5.0)]


@dataclass
class Gel:
    stiffness: float
    contacts = ("left", "right")

    def E(self, T):
        return Lti.constant(self.stiffness * np.array([[1, -1], [-1, 1]]), T)


class Active(Gel):
    def E(self, T):
        return Lti.constant(-np.eye(2), T)


class Broken(Gel):
    def E(self, T):
        return 1 / 0


def gel():
    return Gel(600.0)


def hard(kind=Hardening, **changes):
    return Network(("left", "right"), elements=(kind(**{**USUAL, **changes}),))


USUAL = {"between": ["left", "right"], "stiffness": 300.0, "step": 0.002}
active, broken = Active(6.0), Broken(6.0)


def soft():
    return hard(stiffness=-5.0)


def negative():
    return hard(Negative)


def leaves():
    raise SystemExit(0)
"""
RUN = "python -m sim.run --case I --duration 0.3 --no-plot"


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    folder = tmp_path_factory.mktemp("own")
    (folder / "mine.py").write_text(MINE)
    (folder / "loud.py").write_text("print('something')\nfrom mine import gel\n")
    (folder / "ends.py").write_text("raise SystemExit(7)\n")
    traced = "from pathlib import Path\nfrom mine import Gel, Hardening, gel\nPath('executed').touch()\n"
    (folder / "traced.py").write_text(traced)
    return folder


@pytest.mark.parametrize(
    ("name", "covered"), [pytest.param("hard", "any-environment", marks=pytest.mark.slow), ("gel", "this-environment")]
)
def test_an_own_environment_is_proved_and_stored(name, covered, place):
    """`design.check` repeats the proof from the JSON file alone, without the user's class."""
    words = f"--environment mine.py:{name} --condition {covered} --out {name}.json"
    done = run(f"python -m design {words}", place)
    assert done.returncode == 0, done.stderr
    (place / "elsewhere").mkdir(exist_ok=True)
    done = run(f"python -m design.check ../{name}.json", place / "elsewhere")
    assert "proved, in exact arithmetic" in done.stdout


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("mine.py:active", "environment Active: block: not passive"),
        ("mine.py:Gel", "--environment mine.py:Gel: TypeError: Gel.__init__() missing 1 required"),
        ("mine.py:np", "environment module: expected a class with contacts"),
        ("mine.py:soft", "stiffness between left"),
        ("mine.py:negative", "stiffness between left"),
        ("mine.py:broken", "which is your own code: ZeroDivisionError: division by zero"),
        ("mine.py:nobody", "mine.py has no nobody; it defines Weighted, Duck, "),
        ("yours.py:X", "there is no file yours.py"),
        ("mine:Gel", "expected FILE.py:NAME"),
        ("ends.py:X", "SystemExit: 7"),
        ("mine.py:leaves", "--environment mine.py:leaves: it ends the program by sys.exit(0)"),
    ],
)
def test_wrong_environments_are_refused(words, message, place):
    done = run(f"{RUN} --environment {words}", place)
    *before, last = done.stderr.splitlines()
    assert done.returncode == 2
    assert message in last
    assert bool(before) == ("your own" in last), "only an error in the user's code has a traceback"


def test_an_own_file_prints_to_standard_error(place):
    done = run(f"{RUN} --environment loud.py:gel --json -", place)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["case"] == "I"
    assert "something" in done.stderr


@pytest.mark.parametrize(
    "line", ['type = "traced:Gel"', 'elements = [{ type = "traced:Hardening", between = ["left", "right"] }]']
)
def test_scenario_files_cannot_name_classes(line, place):
    """The named module would leave a file if its code were executed."""
    scenario = 'name = "own"\nT = 1e-3\ntheta = [1, 1]\ndevice = ["omega.3", "omega.3"]\n[environment]\n'
    (place / "code.toml").write_text(f'{scenario}contacts = ["left", "right"]\n{line}\n')
    done = run(f"{RUN} --scenario code.toml", place)
    assert done.returncode == 2
    assert "environment" in done.stderr
    assert len(done.stderr.splitlines()) == 1
    assert not (place / "executed").exists()
    run(f"{RUN} --environment traced.py:nobody", place)
    (place / "executed").unlink()  # The option --environment executes the file, so the check above could have failed.


@pytest.mark.parametrize(
    ("force", "message"),
    [
        (
            "np.where(t < 0.15, 0.0, np.nan)",
            "human #1.voluntary_force(t) is nan at 0.15 s, expected a finite force in N",
        ),
        (
            "0 * t if t[-1] < 0.2 else 1 // 0 + t",
            "friends.py, line 10, which is your own code: ZeroDivisionError: ",
        ),
    ],
)
def test_a_hand_that_fails_later_is_named(force, message, place):
    """The hand is in a module that the file of hands imports."""
    hand = "import numpy as np\nfrom haptic_loop.models.human import Port\n\n\nclass Hand:\n    def port(self):\n"
    hand += "        return Port([0.3], [[-1, 1]], [4.0], [500.0])\n\n"
    hand += f"    def voluntary_force(self, t):\n        return {force}\n"
    (place / "friends.py").write_text(hand)
    (place / "held.py").write_text("from friends import Hand\n\nhumans = (Hand(), Hand())\n")
    done = run(f"{RUN} --human held.py:humans", place)
    assert done.returncode == 2
    assert message in done.stderr.splitlines()[-1]


def test_own_couplings_must_be_subclasses_of_coupling(place):
    done = run(f"{RUN} --coupling mine.py:duck", place)
    assert done.returncode == 2
    message = "coupling is a Duck, which is not derived from controller.coupling.Coupling"
    assert message in done.stderr.splitlines()[-1]


@pytest.mark.parametrize(
    "command", [f"{RUN} --environment mine.py:hard --coupling", "python -m design.audit --coupling"]
)
def test_a_coupling_may_be_given_by_its_compliance(command, place):
    """`weighted` defines only its compliance. It runs with an environment that has walls, and an audit takes it."""
    done = run(f"{command} mine.py:weighted", place)
    assert done.returncode == 0, done.stderr
    assert "error" not in done.stderr.lower()
    assert "Warning" not in done.stderr


def test_errors_name_the_innermost_line(tmp_path):
    """`is_refusal` tells errors that this package raises on purpose from errors of the user's code."""
    file = tmp_path / "nested_error.py"
    file.write_text("def inner():\n    raise ValueError('no')\n\ndef outer():\n    inner()\n")
    with pytest.raises(ValueError, match="no") as caught:
        named("--x", f"{file}:outer")()
    assert place_of(caught.value) == f"{file}, line 2"
    assert not is_refusal(caught.value)
    with pytest.raises(InputError) as refused:
        named("--x", "nothing")
    assert is_refusal(refused.value)
