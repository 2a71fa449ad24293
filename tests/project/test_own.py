"""Classes of a user's own, in one file outside of the repository, through the commands."""

import pytest
from forked import run

MINE = """
from dataclasses import dataclass

import numpy as np

from haptic_loop.controller.coupling import Compliance, Coupling
from haptic_loop.controller.environment import Spring, Wall
from haptic_loop.controller.lti import Lti, numbers, taps


class Trapezoidal:
    def __init__(self, simulation):
        P, T = simulation.scene.plant, simulation.scenario.T
        left = np.linalg.inv(np.eye(len(P.A)) - T / 2 * P.A)
        self.step = np.hstack([left @ (np.eye(len(P.A)) + T / 2 * P.A), left @ P.B * T])

    def start(self, buffer):
        self.rows, self.states = buffer.plant_row, buffer.plant_state

    def advance(self, k):
        self.states[k + 1][...] = self.step @ self.rows[k]

    def troubled(self):
        return False


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


class Untroubled(Trapezoidal):
    troubled = None


class Short(Trapezoidal):
    def advance(self, k):
        self.states[k + 1][...] = np.zeros(7)


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
"""
SCENARIO = """
name = "own"
T = 1e-3
theta = [1, 1]
device = [{ kind = "rigid", damping = 1.37 }, { kind = "rigid", damping = 1.37 }]
[environment]
"""
HARD = 'elements = [{ type = "mine:Hardening", between = ["left", "right"], stiffness = 300.0, step = 0.002 }]'
RUN = "python -m sim.run --case I --duration 0.3 --no-plot"


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    folder = tmp_path_factory.mktemp("own")
    (folder / "mine.py").write_text(MINE)
    (folder / "hard.toml").write_text(f'{SCENARIO}contacts = ["left", "right"]\n{HARD}\n')
    (folder / "gel.toml").write_text(f'{SCENARIO}type = "mine:Gel"\nstiffness = 600.0\n')
    return folder


@pytest.mark.parametrize(("scenario", "covered"), [("hard", "any-environment"), ("gel", "this-environment")])
def test_an_element_and_an_environment_in_a_scenario(scenario, covered, place):
    """Designed, proved and stored, and proved again from the file alone, which asks for no class."""
    done = run(f"python -m design --scenario {scenario}.toml --condition {covered} --out {scenario}.json", place)
    assert done.returncode == 0, done.stderr
    (place / "elsewhere").mkdir(exist_ok=True)
    done = run(f"python -m design.check ../{scenario}.json", place / "elsewhere")
    assert "proved, in exact arithmetic" in done.stdout


@pytest.mark.parametrize(
    ("environment", "message"),
    [
        ('type = "mine:Active"\nstiffness = 6', "environment Active: block: not passive"),
        ('type = "mine:Gel"\nstifness = 6', "environment: TypeError: Gel.__init__() got an unexpected keyword arg"),
        ('type = "mine:Trapezoidal"', "environment: TypeError: Trapezoidal.__init__() missing 1 required"),
        (f'contacts = ["left", "right"]\n{HARD.replace("mine", "yours")}', "environment.elements #1.type is 'yours:H"),
        (
            f'contacts = ["left", "right"]\n{HARD.replace("300.0", "-5.0")}',
            "mine.py, line 68: stiffness between left",
        ),
        (f'contacts = ["left", "right"]\n{HARD.replace("type", "kind")}', "environment.elements #1 is {'kind': 'mine"),
        (f'contacts = ["left", "up"]\n{HARD}', "contact 'up' has neither spring"),
        ('type = "mine:Broken"\nstiffness = 6', "which is your own: ZeroDivisionError: division by zero"),
        (
            f'contacts = ["left", "right"]\n{HARD.replace("Hardening", "Negative")}',
            "mine.py, line 73: stiffness between",
        ),
    ],
)
def test_what_is_wrong_with_them_is_said_in_a_line(environment, message, place):
    (place / "wrong.toml").write_text(SCENARIO + environment)
    done = run(f"{RUN} --scenario wrong.toml", place)
    *before, last = done.stderr.splitlines()
    assert done.returncode == 2
    assert message in last
    assert bool(before) == ("your own" in last), "only an error within their code has a traceback"


@pytest.mark.parametrize(
    ("force", "message"),
    [
        (
            "np.where(t < 0.15, 0.0, np.nan)",
            "human #1.voluntary_force(t) is nan at 0.15 s, expected a finite force in N",
        ),
        (
            "0 * t if t[-1] < 0.2 else 1 // 0 + t",
            "friends.py, line 10, which is your own: ZeroDivisionError: ",
        ),
    ],
)
def test_a_hand_that_fails_after_a_while(force, message, place):
    """In a module that the file of hands imports."""
    hand = "import numpy as np\nfrom haptic_loop.models.human import Port\n\n\nclass Hand:\n    def port(self):\n"
    hand += "        return Port([0.3], [[-1, 1]], [4.0], [500.0])\n\n"
    hand += f"    def voluntary_force(self, t):\n        return {force}\n"
    (place / "friends.py").write_text(hand)
    (place / "held.py").write_text("from friends import Hand\n\nhumans = (Hand(), Hand())\n")
    done = run(f"{RUN} --human held.py", place)
    assert done.returncode == 2
    assert message in done.stderr.splitlines()[-1]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ("--coupling mine:duck", "coupling is a Duck, which is not derived from controller.coupling.Coupling"),
        ("--engine mine:Untroubled", "engine mine:Untroubled has no troubled: expected what has start(buffer), adv"),
        ("--engine mine:Nobody", "--engine is 'mine:Nobody': mine has no Nobody, but Trapezoidal, Weighted, Duck, "),
        ("--engine yours:X", "--engine is 'yours:X': there is no module 'yours' in"),
        ("--engine mine:1", "--engine is 'mine:1', expected package.module:Name"),
        ("--engine euler", "--engine is 'euler', allowed are mujoco, exact and package.module:Name"),
        ("--engine os:getcwd", "engine posix:getcwd: TypeError: "),
        ("--engine mine:Short", ", which is your own: ValueError: could not broadcast"),
    ],
)
def test_what_is_wrong_with_it_is_said_in_a_line(options, message, place):
    done = run(f"{RUN} {options}", place)
    *before, last = done.stderr.splitlines()
    assert done.returncode == 2
    assert message in last
    assert bool(before) == ("your own" in last), "only an error within their code has a traceback"


@pytest.mark.parametrize("command", [f"{RUN} --scenario hard.toml --coupling", "python -m design.audit --coupling"])
def test_a_coupling_that_is_its_compliance(command, place):
    """Behind it walls, and an audit, which takes the same words."""
    done = run(f"{command} mine:weighted", place)
    assert done.returncode == 0, done.stderr
    assert not done.stderr
