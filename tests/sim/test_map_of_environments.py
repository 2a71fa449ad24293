"""Maps over stiffness and damping of contact springs, with a fixed coupling, equal closed forms and dense sweeps."""

import json

import numpy as np
import pytest

from haptic_loop.cli import zwidth
from haptic_loop.cli.options import DONE
from haptic_loop.controller.coupling import NoCoupling, SpringDamper
from haptic_loop.controller.environment import GROUND, Network, Spring
from haptic_loop.design.frequency import on_circle
from haptic_loop.design.optimal import design
from haptic_loop.design.program import Options
from haptic_loop.design.result import HERE
from haptic_loop.models.scene import crowds, variants
from haptic_loop.sim.couplings import choose
from haptic_loop.sim.limit_cycles import HeldDevices
from haptic_loop.sim.scenario import load
from haptic_loop.sim.stability import dominant_mode, exact_loops
from haptic_loop.sim.zwidth import EnvironmentSweep

PAIR, STAR = load("omega-pair"), load("three-rigid")
WALL = Network(("tip",), (Spring(("tip", GROUND), 2000.0, 0.2),))


def around(scenario, coupling):
    return EnvironmentSweep(scenario.device, scenario.population, scenario.loop("I"), coupling)


@pytest.fixture(scope="module")
def optimal():
    """Return the optimal coupling of each scenario; that of three channels has a small basis, so that it is quick."""
    small = design(STAR.loop("I"), Options(bases=((6, 4),)))
    return {PAIR.name: choose(PAIR, "I", "optimal").coupling, STAR.name: small.coupling}


def densely(sweep, coupling_force, K, B):
    """Return required over available damping from up to 60010 frequencies and the network's equations alone.

    The first pass sweeps every tenth of 60000 frequencies, which are 5e-5 rad/sample apart. The second pass sweeps the
    neighbours of those whose ratio is within 1 % of the largest. A peak of width 0.01 rad/sample exceeds its nearest
    ratio of the first pass by at most the share (2.5e-4/0.01)^2 = 6e-4, so that the second pass finds it.
    """
    T, (M, D, S) = sweep.loop.T, sweep.loop.network.matrices()
    network = sweep.loop.network
    for spring, row in zip(network.springs, network.across(network.springs), strict=True):
        if set(spring.between) & set(network.contacts):
            pattern = np.outer(row, row)
            D, S = D + (B - spring.damping) * pattern, S + (K - spring.stiffness) * pattern
    root = np.sqrt(T / np.array(sweep.loop.delta))

    def swept(w):
        z = on_circle(w)
        m, s = sweep.loop.channels, ((z - 1) / (T * z))[:, None, None]
        E = np.linalg.inv(np.linalg.inv(M * s**2 + D * s + S)[:, :m, :m])
        G = coupling_force(z, z[:, None, None] ** -np.array(sweep.loop.psi)[:, None] * E)
        F = z[:, None, None] ** -np.array(sweep.loop.theta)[:, None] * G / (z - 1)[:, None, None]
        return np.linalg.eigvalsh(-(root[:, None] * root) * (F + np.conj(np.swapaxes(F, 1, 2))) / 2)[:, -1]

    fine = np.linspace(1e-5, np.pi, 60_000)
    coarse = swept(fine[5::10])
    near = np.repeat(coarse > coarse.max() - 0.01 * abs(coarse.max()), 10)
    return max(swept(np.geomspace(1e-6, 1e-5, 10)).max(), swept(fine[near]).max())


@pytest.mark.slow
@pytest.mark.parametrize(("scenario", "K", "B"), [(PAIR, 1213.2, 2.54), (STAR, 90.0, 0.3)], ids=["pair", "star"])
def test_the_figures_are_those_of_a_dense_sweep(scenario, K, B, optimal):
    """Ratios agree to 1e-5: a peak of width 0.01 exceeds points 5e-5 apart by at most (2.5e-5/0.01)^2 = 6e-6 of it.

    With the slowest pole 0.0015 from 1, a supremum at 0 exceeds the value at 1e-6 rad/sample by a share of 4e-7.
    """
    coupling = optimal[scenario.name]
    sweep = around(scenario, coupling)

    def filtered(z, E):
        return coupling.filter(scenario.T).at(z) @ E

    ratio = sweep.ratios("this-environment", np.array([K]), np.array([B]))[0]
    assert ratio == pytest.approx(densely(sweep, filtered, K, B), rel=1e-5)
    assert sweep.requirement("this-environment", K, B).ratio == pytest.approx(ratio, rel=1e-6)


def test_bare_walls_match_colgates_condition():
    scenario = load("one-wall").replace(environment=WALL, theta=(0,))
    sweep = around(scenario, NoCoupling())
    K, B = np.array([100.0, 900.0, 3000.0]), np.array([0.1, 0.9, 0.0])
    needed = sweep.ratios("this-environment", K, B) * sweep.loop.delta[0]
    # Maps split the pole of F/(z-1) at z = 1 off, so that rounding does not grow at low frequencies. Relative errors
    # were 2e-16.
    np.testing.assert_allclose(needed, K * scenario.T / 2 + B, rtol=1e-13)


def test_any_environment_requires_the_same_in_all_cells():
    sweep = around(PAIR, SpringDamper([800.0, 500.0], [0.4, 0.5]))
    assert tuple(sweep.judges) == ("any-environment", "this-environment")
    ratios = sweep.ratios("any-environment", np.array([50.0, 5e3]), np.array([0.1, 3.0]))
    assert ratios[0] == ratios[1] == sweep.requirement("any-environment", 1.0, 1.0).ratio < 1


@pytest.mark.slow
def test_hands_growth_rates_equal_those_of_exact_loops(optimal):
    """HeldDevices gives each set of hands the growth rate of the exact loop with the force map of the cell."""
    sweep = around(PAIR, optimal["omega-pair"])
    crowd = HeldDevices.drawn(sweep.devices, sweep.population, sweep.loop.T, 1, 12, 1)
    F = sweep.force_maps(np.array([300.0, 3000.0]), np.array([0.5, 0.5]))[0]
    for i, stable in ((0, True), (1, False)):
        growth = crowd.growth(F[i])[0]
        for index, some in crowds(sweep.population, 2, 1, range(12), 1):
            modes = dominant_mode(exact_loops(variants(sweep.devices, some), F[i]))
            np.testing.assert_allclose(growth[index], modes.growth, rtol=0, atol=1e-7)  # rounding over T
        assert (growth < 0).all() == stable


OPTIONS = ["--coupling", "optimal", "--grid", "4", "--humans", "5", "--points", "1", "--duration", "1.5"]


@pytest.mark.slow
def test_maps_of_optimal_couplings_report_their_guarantee(tmp_path, capsys):
    assert zwidth.main([*OPTIONS, "--out", str(tmp_path)]) == DONE
    report, text = json.loads((tmp_path / "report.json").read_text()), capsys.readouterr().out
    assert report["axes"] == "environment"
    assert report["kind"] == "optimal"
    assert report["assessment"]["guarantee"]["environments"] == HERE
    assert report["assessment"]["requirements"]["this-environment"]["proof"] == "rational"
    assert report["conditions"] == ["any-environment", "this-environment"]
    assert report["this-environment"]["contradicted_cells"] == 0
    assert 0 < report["this-environment"]["certified_cells"] < 16
    assert report["simulation"]["differ_from_linear"] == 0
    for name in report["conditions"]:
        missing = any(value is None for row in report[name]["required_over_available"] for value in row)
        assert missing == ("reason" in report[name])
    for words in ("guarantee: this environment", "for its environment alone"):
        assert words in " ".join(text.split())
    assert (tmp_path / "zwidth.png").read_bytes().startswith(b"\x89PNG")
