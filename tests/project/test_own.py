"""Classes of a user's own, in one file outside of the repository, through the commands."""

import pytest
from forked import run

MINE = """
import numpy as np


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


class Untroubled(Trapezoidal):
    troubled = None


class Short(Trapezoidal):
    def advance(self, k):
        self.states[k + 1][...] = np.zeros(7)
"""
RUN = "python -m sim.run --case I --duration 0.3 --no-alternatives --no-plot"


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    folder = tmp_path_factory.mktemp("own")
    (folder / "mine.py").write_text(MINE)
    return folder


def test_an_engine_by_its_name(place):
    """The trapezoidal rule is near the exact solution, and beside another engine its loop has the same verdict."""
    done = run(f"{RUN} --engine mine:Trapezoidal --cross-check", place)
    assert done.returncode == 0, done.stderr
    assert "(mine:Trapezoidal)" in done.stdout
    assert "same verdict" in done.stdout


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ("--engine mine:Untroubled", "engine mine:Untroubled has no troubled: expected what has start(buffer), adv"),
        ("--engine mine:Nobody", "--engine is 'mine:Nobody': mine has no Nobody, but Trapezoidal, Untroubled, Short"),
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
    assert bool(before) == ("your own" in message), "only an error within their code has a traceback"
