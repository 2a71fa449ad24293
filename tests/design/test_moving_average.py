"""Tests of the moving average, almost the stiffest linear coupling for any environment: zeros, design and file."""

import numpy as np
import pytest
from evaluate import any_environment

from haptic_loop import certify, design_coupling, simulate, transparency_of
from haptic_loop import load as scenario_of
from haptic_loop.controller.coupling import MovingAverage, SpringDamper
from haptic_loop.controller.lti import Lti, taps
from haptic_loop.design.certificate import prove, verify
from haptic_loop.design.coupling_file import Stored, load, save
from haptic_loop.design.transparency import decibels

T = 1e-3


def window(theta, delta, factor=1.0):
    """Return factor T/(2 delta) (1 + ... + z^-theta), a moving average without the constant that the design adds."""
    return taps([factor * T / (2 * delta)] * (theta + 1), T)


@pytest.mark.parametrize("theta", range(5))
@pytest.mark.parametrize("factor", [0.9, 0.98, 1.02, 1.5])
def test_scaled_moving_averages_need_inversely_scaled_damping(theta, factor):
    """V and Theta-hat vanish at the same frequencies, where no damping is required. Elsewhere the ratio is 1/factor."""
    needs = any_environment(window(theta, 1.3, factor), [theta], [1.3])
    assert needs.reason is None
    assert needs.ratio == pytest.approx(1 / factor, rel=1e-5)
    assert needs.certified == (factor > 1)


def test_channels_with_different_zeros_need_one_ratio():
    """The ratio is 1/1.02. Three channels also catch a matrix of singular vectors swapped with its transpose."""
    theta, delta = [1, 2, 4], [1.3, 0.7, 1.0]
    for m in (2, 3):
        V = Lti.diag(*[window(n, d, 1.02) for n, d in zip(theta[:m], delta[:m], strict=True)])
        assert any_environment(V, theta[:m], delta[:m]).ratio == pytest.approx(1 / 1.02, rel=1e-5)


@pytest.mark.parametrize(("weights", "theta"), [([1.0, 1.0], 2), ([1.0, 1.0], 0), ([1.0, 0.0, 1.0], 3)])
def test_a_zero_of_the_coupling_alone_is_refused(weights, theta):
    """At this zero the delay requires damping, but the coupling has no excess of passivity."""
    assert "damping vanishes" in (any_environment(taps([1e-3 * w for w in weights], T), [theta], [1.0]).reason or "")


@pytest.mark.parametrize(("name", "case"), [("omega-pair", "I"), ("omega-pair", "II"), ("three-rigid", "I")])
def test_moving_averages_beat_spring_dampers(name, case):
    loop = scenario_of(name).loop(case)
    stiff, soft = (design_coupling(loop, kind, "any-environment") for kind in ("moving-average", "spring-damper"))
    limit = 2 * np.array(loop.delta) / ((np.array(loop.theta) + 1) * loop.T)  # bound for every linear coupling
    assert isinstance(stiff.coupling, MovingAverage)
    assert isinstance(soft.coupling, SpringDamper)
    assert (stiff.coupling.stiffness < limit).all()
    np.testing.assert_allclose(stiff.coupling.stiffness, limit, rtol=1e-3)  # the constant costs 1e-4 (theta + 1)
    assert (stiff.coupling.stiffness > soft.coupling.K).all()
    better, worse = (decibels(transparency_of(loop, each).rms_mismatch) for each in (stiff, soft))
    assert better < worse - 0.5
    if (name, case) == ("omega-pair", "I"):
        assert better == pytest.approx(-1.129, abs=2e-3)
    assert certify(loop, stiff)["any-environment"].proof == "rational"


@pytest.mark.slow
def test_moving_averages_are_proved_with_psi():
    """With psi = (1, 0) the design is proved under any-environment, and its exact simulation is stable."""
    scenario = scenario_of("omega-pair").replace(psi=(1, 0), delta=(3.0, 3.0))
    loop = scenario.loop("I")
    design = design_coupling(loop, "moving-average")
    requirements = certify(loop, design)
    assert requirements["any-environment"].proof == "rational"
    assert requirements["this-environment"].certified
    assert simulate(scenario.replace(duration=1.0), design, "exact").meta["stability"]["exact_verdict"] == "stable"


def test_a_moving_average_is_stored_and_proved(tmp_path):
    loop = scenario_of("omega-pair").loop("I")
    coupling = design_coupling(loop, "moving-average").coupling
    file = tmp_path / "coupling.json"
    save(Stored.of(loop, coupling, prove(loop, coupling, "any-environment")), file)
    stored = load(file)
    assert verify(stored).proved
    np.testing.assert_array_equal(stored.coupling.build(loop.T).compliance(loop.T).D, coupling.compliance(loop.T).D)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        (([-1e-3], [2], [0.0]), "weight is"),
        (([1e-3], [0], [0.0]), "terms are"),
        (([1e-3, 1e-3], [2], [0.0]), "2, 1 and 1 entries"),
    ],
)
def test_invalid_moving_averages_are_refused(fields, message):
    with pytest.raises(ValueError, match=message):
        MovingAverage(*fields)
