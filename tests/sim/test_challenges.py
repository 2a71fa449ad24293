"""Adversaries attack guarantees for limits, budgets, walls and encoder steps, as `make validate` does at length."""

import pytest

from tests.checks.challenges import ENOUGH, GUARANTEES, challenges


@pytest.mark.slow
@pytest.mark.parametrize("name", GUARANTEES)
def test_requirements_suffice_and_much_less_fails(name):
    """With 1.02 times what a guarantee requires, no adversary takes too much energy; with far less, one does.

    Forces are limited, or walls touched, in over a third of the ticks, so that the guarantee matters.
    """
    rows = list(challenges(0, loops=1, hands=8, seconds=0.3, ticks=250, names=[name]))
    assert [row.factor for row in rows] == [ENOUGH, GUARANTEES[name][1]]
    enough, less = rows
    assert (enough.took, enough.grew) == (0, 0)
    assert enough.least_J >= 0
    assert less.took > 0
    if name == "encoder steps":
        assert less.grew > 0
    else:
        assert enough.limited > 1 / 3
