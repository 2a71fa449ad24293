"""Runs with limited forces have the right guarantee in the report, and are equal in both engines up to rounding.

docs/theory.md defines rho, beta and c of the limiter.
"""

import msgspec
import numpy as np
import pytest
from driven import tick_by_tick
from evaluate import prove_limiter, reported
from shared import SOFT, STIFF

from haptic_loop.cli.run import main
from haptic_loop.controller.coupling import SpringDamper
from haptic_loop.design.assessment import _covered_limits
from haptic_loop.design.certificate import requirements_of
from haptic_loop.design.coupling_file import Stored, save
from haptic_loop.sim.api import simulate
from haptic_loop.sim.couplings import assessed, choose
from haptic_loop.sim.run import assemble, make_engine, run
from haptic_loop.sim.scenario import load

BUILT = SpringDamper((5832.0, 2545.0), (0.187, 1.386))  # its limited forces are proved safe in omega-pair


def weak(*limits):
    """Return one second of the default scenario with these force limits [N]."""
    base = load()
    devices = tuple(msgspec.structs.replace(d, force_limit=f) for d, f in zip(base.device, limits, strict=True))
    return base.replace(device=devices, duration=1.0)


def test_the_limiter_follows_from_the_requirements():
    scenario = weak(12.0, 5.657)
    loop = scenario.loop("I")
    any_environment = _covered_limits(loop, SOFT, requirements_of(loop, SOFT))
    assert any_environment.rho == (0.0, 0.0)
    own = _covered_limits(loop, BUILT, requirements_of(loop, BUILT))
    # rho = beta delta/T = 0.01 s 1.37 N s/m / 1.2 ms
    assert own.rho == pytest.approx((11.4167, 11.4167))
    assert own.requirement is not None
    assert own.requirement.proof == "rational"
    refused = _covered_limits(loop, STIFF, requirements_of(loop, STIFF))
    assert refused.rho is None
    assert "needs 1.385" in refused.reason


def test_limiters_use_the_beta_of_the_file(tmp_path):
    """A run uses the beta of the file, 0.03 s instead of 0.01 s; rho = beta delta/T grows with the devices' damping."""
    scenario, path = weak(12.0, 5.657), tmp_path / "own.json"
    loop = scenario.loop("I")
    proof = prove_limiter(loop, BUILT, 0.03)
    save(Stored.of(loop, BUILT, proof), path)
    limits = assessed(scenario, "I", choose(scenario, "I", str(path))).force_limits
    assert limits.certificate == proof
    assert (limits.rho, limits.c, limits.proved) == (
        proof.multipliers["rho"],
        tuple((c,) for c in proof.multipliers["c"]),
        True,
    )
    assert limits.rho == pytest.approx((34.25, 34.25))
    devices = tuple(msgspec.structs.replace(device, damping=1.5) for device in scenario.device)
    stronger = scenario.replace(device=devices)
    assert assessed(stronger, "I", choose(stronger, "I", str(path))).force_limits.rho == pytest.approx((37.5, 37.5))


@pytest.mark.parametrize(("coupling", "rho"), [(SOFT, (0.0, 0.0)), (BUILT, (11.4167, 11.4167))])
def test_both_engines_agree_on_limited_forces(coupling, rho):
    """Motions of up to 2 cm agree to 1e-12 m, although forces are often at their limits and never above."""
    limits = np.array([0.3, 0.2])
    simulation = assemble(weak(*limits), coupling, rho)
    exact, own = (run(simulation, engine) for engine in ("exact", "mujoco"))
    np.testing.assert_allclose(own.x, exact.x, rtol=0, atol=1e-12)
    assert (np.abs(exact.f) <= limits).all()
    assert 0.2 < exact.clipped(limits).mean() < 0.95
    assert simulation.process.law.bounds
    assert np.abs(simulation.process.law.slips(exact.z)).max() > 1e-4


@pytest.mark.parametrize(("engine", "apart"), [("exact", 1e-12), ("exponential", 1e-12), ("RK4", 0.0)])
@pytest.mark.parametrize("limit", [0.69, 1e3])
def test_runs_in_blocks_equal_runs_by_ticks(engine, apart, limit):
    """Runs in blocks equal runs tick by tick up to rounding (RK4: exactly), even if a block must be undone.

    A block is undone from its first limited tick on; `apart` is relative to a signal's largest value.
    """
    simulation = assemble(weak(limit, limit).replace(duration=3.0), BUILT, (11.4167, 11.4167))
    which, integrator = ("exact", None) if engine == "exact" else ("mujoco", engine)
    fast, slow = (make_engine(simulation, which, integrator) for _ in range(2))
    blocks, expected = run(simulation, fast), run(simulation, tick_by_tick(slow))
    assert vars(fast)["run_block"] is not None
    assert (0 < expected.clipped(np.array([limit] * 2)).mean() < 0.2) == (limit < 10)
    for name in ("s", "z", "f", "w"):
        rows = getattr(expected, name)
        np.testing.assert_allclose(getattr(blocks, name), rows, rtol=0, atol=apart * np.abs(rows).max())


def test_a_single_block_applies_every_outside_force():
    simulation = assemble(weak(1e3, 1e3).replace(duration=0.1), BUILT, (11.4167, 11.4167))
    block, expected = run(simulation, "exact"), run(simulation, tick_by_tick(make_engine(simulation, "exact")))
    np.testing.assert_allclose(block.s, expected.s, rtol=0, atol=1e-12 * np.abs(expected.s).max())


def test_limited_and_clipped_runs_agree_below_limits():
    scenario = weak(1e3, 1e3)
    limited, clipped = (run(assemble(scenario, BUILT, lag), "exact") for lag in ((11.4167, 11.4167), None))
    np.testing.assert_allclose(limited.f, clipped.f, rtol=0, atol=1e-10)
    np.testing.assert_allclose(limited.x, clipped.x, rtol=0, atol=1e-13)


def test_simulate_limits_forces_unless_told_to_clip():
    scenario = weak(0.3, 0.2)
    for limiter, rho in ((True, (0.0, 0.0)), (False, None)):
        trace = simulate(scenario, SOFT, "exact", limiter=limiter)
        np.testing.assert_array_equal(trace.f, run(assemble(scenario, SOFT, rho), "exact").f)
        assert trace.meta["assessment"]["force_limits"]["rho"] == (None if rho is None else list(rho))


@pytest.mark.slow
def test_the_report_says_which_guarantee_holds(tmp_path):
    def report(*options) -> dict:
        code, report = reported(main, tmp_path, *options, "--no-plot", "--duration", "1", "--out", str(tmp_path))
        assert code == 0
        return report

    anywhere = ("--case", "I", "--condition", "any-environment")
    covered = report(*anywhere)["assessment"]["force_limits"]
    assert covered["rho"] == [0.0, 0.0]
    assert covered["force_limit"] == [12.0, 12.0]
    assert report(*anywhere, "--no-limiter")["assessment"]["force_limits"]["rho"] is None
    usual = report("--case", "I")["assessment"]["force_limits"]
    assert usual["rho"] == pytest.approx([11.4167, 11.4167])
    assert usual["words"].startswith("proved, also while forces are limited to 12 N")
    uncovered = report("--case", "I", "--coupling", "optimal")["assessment"]["force_limits"]
    assert uncovered["rho"] is None
    assert "any multiplier c" in uncovered["words"]
