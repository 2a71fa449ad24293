"""The ideal environment's forces for a run's motion equal those of equations written out here, up to rounding."""

import json

import numpy as np
import pytest

from haptic_loop.cli.run import main
from haptic_loop.controller.coupling import PUBLISHED, NoCoupling, SpringDamper
from haptic_loop.design.files import plain
from haptic_loop.sim.accuracy import ForceError, force_error, response
from haptic_loop.sim.run import Simulation, assemble, run
from haptic_loop.sim.scenario import load
from haptic_loop.sim.trace import Trace

SCENARIO = load()


def by_hand(T: float, x: np.ndarray, late: tuple[int, ...]) -> np.ndarray:
    """Return the forces of Figure 4's network by backward Euler in positions, without a state space.

    The mass M (1 kg) is between spring-dampers (800 N/m, 1 N s/m) and (700, 1), whose sums are K and D:
    (M/T^2 + D/T + K) q = M (2 q- - q--)/T^2 + D q-/T + the pull of both contacts; q- and q-- are q one and two ticks
    before. The force of contact i is that of its spring-damper, `late[i]` samples later.
    """
    k, b, M = np.array([800.0, 700.0]), np.array([1.0, 1.0]), 1.0
    q, before, x_old, forces = 0.0, 0.0, np.zeros(2), []
    for now in x:
        pull = k @ now + b @ (now - x_old) / T + b.sum() * q / T
        new = (M * (2 * q - before) / T**2 + pull) / (M / T**2 + b.sum() / T + k.sum())
        forces.append(k * (now - new) + b * ((now - x_old) - (new - q)) / T)
        q, before, x_old = new, q, now
    shifted = np.zeros_like(x)
    for i, n in enumerate(late):
        shifted[n:, i] = np.array(forces)[: len(x) - n, i]
    return shifted


def record_of(simulation: Simulation, seconds: float) -> Trace:
    return run(simulation, "exact", ticks=round(seconds / SCENARIO.T))


@pytest.mark.parametrize(("case", "late"), [("I", (1, 2)), ("II", (0, 0))])
def test_the_ideal_force_follows_the_measured_motion(case, late):
    simulation = assemble(SCENARIO, PUBLISHED["I"])
    record = record_of(simulation, 2.0)
    part = force_error(simulation, record, SCENARIO.loop(case).lam)
    expected = by_hand(SCENARIO.T, record.x, late)
    # The rounding errors of 1700 ticks of a lightly damped mass add up.
    np.testing.assert_allclose(part.ideal, expected, rtol=0, atol=1e-9 * np.abs(expected).max())
    force = record.f
    np.testing.assert_allclose(part.asked, force, rtol=0, atol=1e-12)  # nothing is clipped here
    error = np.sqrt(((force - expected) ** 2).sum() / (expected**2).sum())
    assert part.error_percent == pytest.approx(100 * error, rel=1e-6)


def test_responses_equal_impulse_convolution():
    G = assemble(SCENARIO, SpringDamper([900.0, 500.0], [0.4, 0.5])).F
    x = np.random.default_rng(0).normal(size=(120, 2))
    impulse = [G.D, *(G.C @ np.linalg.matrix_power(G.A, n) @ G.B for n in range(119))]
    y = np.array([sum(impulse[n] @ x[k - n] for n in range(k + 1)) for k in range(120)])
    np.testing.assert_allclose(response(G, x), y, rtol=0, atol=1e-12 * np.abs(y).max())


def test_uncoupled_loops_are_ideal_despite_clipping():
    """F = Theta E = Lambda E, so the forces before clipping are exactly right, although the loop is unstable."""
    simulation = assemble(SCENARIO.replace(theta=(2, 3)), NoCoupling())
    record = record_of(simulation, 6.0)
    assert np.abs(record.f).max() == 12.0
    part = force_error(simulation, record, (2, 3))
    assert part.asked_rms_n > np.sqrt(np.mean(record.f**2))
    assert part.error_percent < 1e-8


def test_undefined_force_errors_are_none():
    still = np.zeros((5, 2))
    assert ForceError.of(still, still).reason == "the ideal environment would have rendered no force"
    assert ForceError.of(still[:0], still[:0]).error_percent is None
    lost = ForceError.of(still + 1, np.full((5, 2), 1e200))
    assert lost.error_percent is None
    assert lost.asked_rms_n is None
    json.dumps(plain(lost), allow_nan=False)


@pytest.mark.slow
def test_the_command_ranks_the_designs(tmp_path):
    """The optimal coupling's error is below 2 % and below a fifth of that of the spring-damper for this environment.

    The latter is below half of the error of the spring-damper for any environment.
    """
    errors = {}
    for name, condition in (
        ("optimal", None),
        ("spring-damper", "any-environment"),
        ("spring-damper", "this-environment"),
    ):
        file = tmp_path / "r.json"
        options = ["--coupling", name, *(["--condition", condition] if condition else []), "--engine", "exact"]
        assert (
            main(
                [
                    *options,
                    "--no-plot",
                    "--duration",
                    "4",
                    "--out",
                    str(tmp_path),
                    "--json",
                    str(file),
                ]
            )
            == 0
        )
        errors[name, condition] = json.loads(file.read_text())["ideal_force"]["error_percent"]
    assert errors["optimal", None] < 2
    assert errors["optimal", None] < errors["spring-damper", "this-environment"] / 5
    assert errors["spring-damper", "this-environment"] < errors["spring-damper", "any-environment"] / 2
    trace = Trace.load_npz(tmp_path / "trace.npz")
    expected = by_hand(SCENARIO.T, trace.x, (1, 2))
    error = np.sqrt(((trace.f - expected) ** 2).sum() / (expected**2).sum())
    assert errors["spring-damper", "this-environment"] == pytest.approx(100 * error, rel=1e-6)
