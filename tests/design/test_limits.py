"""Tests that optimal couplings improve with damping and basis size, and of known figures without optimisation."""

from functools import cache

import pytest
from evaluate import this_environment
from shared import force_map

from haptic_loop import certify, load, transparency_of
from haptic_loop.controller.coupling import PUBLISHED, NoCoupling
from haptic_loop.controller.environment import environment
from haptic_loop.design.designs import design_by_kind
from haptic_loop.design.program import _BASES

LOOP = load().loop("I")


@cache
def optimum(damping, bases):
    loop = load().replace(delta=(damping,) * 2).loop("I")
    return loop, design_by_kind(loop, "optimal", bases=_BASES[:bases])


@pytest.mark.slow
def test_more_damping_never_worsens_the_optimum():
    """The feasible set grows with the damping."""
    optima = [optimum(damping, 1) for damping in (1.3, 1.37)]
    rms = [transparency_of(*each).rms_mismatch_db for each in optima]
    assert rms[0] > rms[1]
    for loop, design in optima:
        assert max(certify(loop, design)["this-environment"].required) < loop.delta[0]


@pytest.mark.slow
@pytest.mark.parametrize("most", [2, pytest.param(3, marks=pytest.mark.validate)])
def test_more_bases_approach_the_bound(most):
    """Two bases reach -33.8 dB, three -34.8 dB. Separate code gave the bound; tests/design/test_bound.py checks it."""
    first, last = (transparency_of(*optimum(1.37, bases)).rms_mismatch_db for bases in (1, most))
    assert -35.137 < last < min(first, -33.8 if most == 2 else -34.8)


def test_published_gains_have_their_known_mismatch():
    E = environment(LOOP.environment, LOOP.T)
    expected = this_environment(force_map(E, PUBLISHED["I"], LOOP.theta, LOOP.psi), LOOP.delta)
    assert certify(LOOP, PUBLISHED["I"])["this-environment"].required == expected.required
    assert transparency_of(LOOP, PUBLISHED["I"]).mismatch_db == pytest.approx(7.70, abs=0.005)
    bare = transparency_of(load().loop("II"), NoCoupling())
    assert bare.mismatch_db == pytest.approx(0.34, abs=0.005)
