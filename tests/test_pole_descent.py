"""The poles of a basis: the gradient against differences of solved problems, and what the descent is worth."""

import numpy as np
import pytest

from design.assess import specification
from design.cutting_planes import Problem, cut_problem
from design.failure import Infeasible
from design.free_parameter import FreeParameter
from design.optimal import design, world
from design.pole_descent import FARTHEST, Places, descend, gradient, log_mismatch
from design.wish import Wish
from sim.scenario import load

SPEC = {case: specification(load().loop(case)) for case in ("I", "II")}


def problem(case: str, wish: Wish, poles: list[float]) -> Problem:
    Q = FreeParameter(np.array(poles), 2, wish.diagonal)
    return Problem.of(Q, wish, [world(SPEC[case])], np.asarray(SPEC[case].delta))


def test_places_keep_poles_together():
    places = Places.of(np.array([0.5, 0.0, 0.5, 0.9]))
    assert places.number == (1, 2, 1)
    np.testing.assert_array_equal(places.poles(), [0.0, 0.5, 0.5, 0.9])
    assert Places.of(np.zeros(0)).poles().size == 0


@pytest.mark.parametrize(
    ("case", "wish"),
    [
        ("I", Wish(high_gain=None)),
        ("I", Wish(high_gain=1.5)),
        ("II", Wish(objective="sup", diagonal=False, high_gain=None)),
    ],
    ids=["rms", "rms, limited", "sup"],
)
def test_the_gradient_is_that_of_the_optimum(case, wish):
    """Against central differences of solved problems, the frequencies held.

    A step of 1e-3 and a solver good to 1e-8 leave 1e-5, and the curvature about 1e-3 of the largest slope.
    """
    poles = [0.1, 0.1, 0.1, 0.6, 0.95]
    here = problem(case, wish, poles)
    optimum, _ = cut_problem(here)
    places = Places.of(here.Q.poles)
    found = gradient(here, optimum, places)
    expected = []
    for unit in np.eye(places.at.size):
        values = []
        for side in (1, -1):
            there = problem(case, wish, Places(places.at + side * 1e-3 * unit, places.number).poles().tolist())
            values.append(log_mismatch(there, there.optimum(optimum.imposed)))
        expected.append((values[0] - values[1]) / 2e-3)
    np.testing.assert_allclose(found, expected, atol=0.01 * np.abs(expected).max())
    assert np.abs(expected).max() > 0.01


def test_an_adapted_basis_is_better_than_its_start():
    """Six functions, rms: what poles are worth is not rounding, and what comes out is certified like all else."""
    wish = Wish(functions=6, high_gain=None)
    usual, adapted = (design(SPEC["I"], Wish(functions=6, high_gain=None, filter=f)) for f in ("auto", "adapted"))
    assert usual.requirement.certified
    assert adapted.requirement.certified
    assert adapted.requirement.ratio < 1 - wish.margin + 1e-3
    assert 20 * np.log10(adapted.objective / usual.objective) < -0.4
    poles = adapted.coupling.poles
    assert poles.shape == (5,)
    assert np.abs(poles).max() <= FARTHEST
    np.testing.assert_array_equal(poles, np.round(poles, 4))


def test_a_basis_without_poles_stays():
    Q, solved = descend(FreeParameter(np.zeros(0), 2, True), Wish(functions=1), [world(SPEC["I"])], np.full(2, 1.37))
    assert Q.poles.size == 0
    assert solved >= 1


def test_a_start_without_solution_is_infeasible():
    """The descent needs a solution to start from."""
    with pytest.raises(Infeasible):
        descend(FreeParameter(np.zeros(0), 2, True), Wish(functions=1), [world(SPEC["I"])], np.full(2, 0.01))


def test_a_long_basis_for_the_sup_of_case_II():
    """The usual basis of 17 functions, and the FIR filter of as many, full, without limit: -6.9 against -5.9 dB."""
    made = design(SPEC["II"], Wish(functions=17, objective="sup", diagonal=False, high_gain=None))
    assert 20 * np.log10(made.objective) < -6.7
    assert made.requirement.certified
