"""Tests of design.compare: curves match formulas by hand, and their maxima are the conditions' requirements."""

import json
import re

import numpy as np
import pytest
from evaluate import reported
from shared import FIGURE_4, PAIR, SOFT, at_springs

from haptic_loop.cli.compare import main
from haptic_loop.controller.coupling import PUBLISHED, Compliance, NoCoupling, SpringDamper
from haptic_loop.controller.environment import Network, Spring
from haptic_loop.controller.loop import Loop
from haptic_loop.design.compare import curves, grid, ideal, judge
from haptic_loop.design.result import DesignFailed
from haptic_loop.sim import plots
from haptic_loop.sim.scenario import InputError, load

T, DELTA = 1.2e-3, 1.37

HZ = np.array([0.3, 6.17, 40.0, 133.0, 400.0])

#: Largest relative rounding error of a state-space response whose poles are 1e-3 from the unit circle.
ROUNDING = 1e-9


def by_hand(hz):
    """Yield E, F and Theta of the default scenario with the paper's gains, from Figure 4's formula and (6)."""
    for f in hz:
        z = np.exp(2j * np.pi * f * T)
        s = (z - 1) / (T * z)
        Z = np.diag([800 + s, 700 + s])
        one = np.ones((2, 1))
        E = Z - Z @ one @ one.T @ Z / (s**2 + (one.T @ Z @ one))
        V = np.diag(1 / (PUBLISHED["I"].K + PUBLISHED["I"].B * s))
        theta = np.diag([1 / z, 1 / z**2])
        yield E, theta @ np.linalg.inv(np.eye(2) + E @ V) @ E, theta


def test_singular_values_and_impedances_match_the_formulas():
    lines = curves(PAIR, judge(PAIR, PUBLISHED["I"]), HZ)
    sigma_E, undelayed = ideal(PAIR, HZ)
    for k, (E, F, theta) in enumerate(by_hand(HZ)):
        np.testing.assert_allclose(sigma_E[k], np.linalg.svd(E)[1], rtol=ROUNDING)
        np.testing.assert_allclose(lines.sigma_F[k], np.linalg.svd(F)[1], rtol=ROUNDING)
        sizes = np.linalg.svd(F - theta @ E)[1]  # the smaller one has the rounding of the larger one
        np.testing.assert_allclose(lines.sigma_M[k], sizes, rtol=ROUNDING, atol=1e-13 * sizes[0])
        for part, G in ((lines.perceived, F), (undelayed, E)):
            size = np.abs(G).max()
            np.testing.assert_allclose(part.stiffness[k], np.diag(G).real, rtol=0, atol=ROUNDING * size)
            omega = 2 * np.pi * HZ[k]
            np.testing.assert_allclose(part.damping[k], np.diag(G).imag / omega, rtol=0, atol=ROUNDING * size / omega)


def test_an_undelayed_wall_feels_like_its_spring():
    felt = curves(at_springs(1000.0), judge(at_springs(1000.0), NoCoupling()), HZ).perceived
    np.testing.assert_allclose(felt.stiffness[:, 0], 1000.0, rtol=1e-12)
    np.testing.assert_allclose(felt.damping[:, 0], 0.0, rtol=0, atol=1e-12)


def test_delayed_springs_and_dampers_have_closed_forms():
    """z^-1 K has the stiffness K cos wT and the damping -K sin(wT)/w.

    A damper B in backward Euler has the stiffness B (1 - cos wT)/T and the damping B sin(wT)/(wT).
    """
    omega = 2 * np.pi * HZ
    late = at_springs(1000.0, theta=1)
    felt = curves(late, judge(late, NoCoupling()), HZ).perceived
    np.testing.assert_allclose(felt.stiffness[:, 0], 1000 * np.cos(omega * T), rtol=1e-9)
    np.testing.assert_allclose(felt.damping[:, 0], -1000 * np.sin(omega * T) / omega, rtol=1e-9)
    damped = at_springs(1000.0, 2.0)
    felt = curves(damped, judge(damped, NoCoupling()), HZ).perceived
    np.testing.assert_allclose(felt.stiffness[:, 0], 1000 + 2 * (1 - np.cos(omega * T)) / T, rtol=1e-9)
    np.testing.assert_allclose(felt.damping[:, 0], 2 * np.sin(omega * T) / (omega * T), rtol=1e-9)


def test_demands_match_the_formulas():
    """The demand is -T He[F/(z-1)]/delta or, by any-environment, max (1 - cos n w)/(2 delta Re[(z-1) V/(Tz)])."""
    demands = curves(PAIR, judge(PAIR, PUBLISHED["I"]), HZ).demands
    for k, (_, F, _) in enumerate(by_hand(HZ)):
        z = np.exp(2j * np.pi * HZ[k] * T)
        H = F / (z - 1)
        worst = -np.linalg.eigvalsh(H + H.conj().T)[0] * T / (2 * DELTA)
        assert demands["this-environment"][k] == pytest.approx(worst, rel=1e-7)  # H loses digits near z = 1
        s = (z - 1) / (T * z)
        V = 1 / (PUBLISHED["I"].K + PUBLISHED["I"].B * s)
        window = 1 - np.cos(np.array([2, 3]) * np.angle(z))
        assert demands["any-environment"][k] == pytest.approx((window / (2 * DELTA * (s * V).real)).max(), rel=1e-7)


@pytest.mark.parametrize(
    "coupling", [NoCoupling(), PUBLISHED["I"], SOFT, Compliance(SOFT.compliance(T))], ids=lambda c: str(c)[:9]
)
def test_the_curves_maximum_is_the_required_damping(coupling):
    judged = judge(PAIR, coupling)
    hz = grid(PAIR, [judged])
    for condition, demand in curves(PAIR, judged, hz).demands.items():
        ratio = judged.requirements[condition].ratio
        if demand is None:
            assert ratio == np.inf
        else:
            assert demand.max() == pytest.approx(ratio, rel=1e-12)  # the binding frequency is in the grid


def test_curves_of_delayed_environments_reach_the_ratio():
    """With psi >= 1 any-environment has a multiplier, and the curve's maximum is still its ratio."""
    soft = Network(
        FIGURE_4.contacts,
        tuple(Spring(s.between, s.stiffness / 8, s.damping / 8) for s in FIGURE_4.springs),
        FIGURE_4.masses,
    )
    loop = Loop(T, (0, 0), (1, 1), (1, 1), (DELTA, DELTA), soft)
    judged = judge(loop, SpringDamper([200.0, 200.0], [0.2, 0.2]))
    demand = curves(loop, judged, grid(loop, [judged])).demands["any-environment"]
    assert 0 < demand.max() == pytest.approx(judged.requirements["any-environment"].ratio, rel=1e-9)


def test_perceived_damping_with_hold_gives_the_requirement():
    """For one channel, the minimum of T Im[F e^(-jw/2)]/(2 sin(w/2)) over frequency is -required."""
    loop = at_springs(900.0, 0.4, theta=2)
    judged = judge(loop, SpringDamper([2000.0], [0.3]))
    w = np.linspace(1e-4, np.pi, 200_001)
    late = (judged.F.at(np.exp(1j * w))[:, 0, 0] * np.exp(-0.5j * w)).imag * T / (2 * np.sin(w / 2))
    required = judged.requirements["this-environment"].required[0]
    assert -late.min() == pytest.approx(required, rel=1e-6)  # the error is of second order in the step, 1.6e-5 rad


@pytest.mark.slow
def test_the_command_writes_pictures_and_curves(tmp_path, capsys, monkeypatch):
    save = plots.save

    def small(figure, path, dpi=40):
        figure.set_layout_engine("none")  # tests/sim/test_plots.py draws with the layout
        return save(figure, path, dpi)

    monkeypatch.setattr(plots, "save", small)
    out = tmp_path / "o"
    assert main(["--coupling", "none,published", "--out", str(out), "--json", "-"]) == 0
    stdout, stderr = capsys.readouterr()
    outcome = json.loads(stdout)
    assert "published" in stderr
    assert [c["name"] for c in outcome["couplings"]] == ["none", "published"]
    published = outcome["couplings"][1]
    assert published["conditions"]["this-environment"]["required_damping"][0] == pytest.approx(1.398716, abs=2e-6)
    assert (
        published["conditions"]["this-environment"]["demand"][0] < published["conditions"]["this-environment"]["ratio"]
    )
    assert len(published["sigma_M"]) == len(outcome["frequency_hz"]) == len(published["perceived"]["damping"])
    assert outcome["couplings"][0]["conditions"]["any-environment"]["demand"] is None
    assert outcome["couplings"][0]["conditions"]["any-environment"]["reason"]
    assert json.loads((out / "report.json").read_text())["couplings"] == outcome["couplings"]
    for name in ("singular-values", "required-damping", "perceived"):
        assert (out / f"{name}.png").read_bytes()[:4] == b"\x89PNG"


@pytest.mark.slow
def test_delays_turn_the_phase_of_each_curve(tmp_path):
    """Without a coupling device i feels z^-n of the ideal E_ii for its delay of n samples; --no-plot draws nothing."""
    args = ["--scenario", "three-rigid", "--theta", "0,1,2", "--coupling", "none", "--no-plot", "--out", str(tmp_path)]
    _, outcome = reported(main, tmp_path, *args)
    assert not list(tmp_path.glob("*.png"))
    w = 2 * np.pi * np.array(outcome["frequency_hz"])[:, None]

    def felt(curves):
        return np.array(curves["stiffness"]) + 1j * w * np.array(curves["damping"])

    late = np.exp(-1j * w * load("three-rigid").T * [0, 1, 2])
    ideal = felt(outcome["ideal"])
    # Rounding in z^-n E of the largest response, and in the 12 digits of the frequencies.
    np.testing.assert_allclose(felt(outcome["couplings"][0]["perceived"]), late * ideal, atol=1e-9 * abs(ideal).max())


def test_an_impossible_design_leaves_the_other_couplings(tmp_path, capsys):
    base = ["--psi", "1,1", "--no-plot", "--out", str(tmp_path)]
    assert main(["--coupling", "none,spring-damper:any-environment", *base]) == 1
    assert re.search(r"spring-damper\S*( \S+)?: not possible", " ".join(capsys.readouterr().out.split()))
    with pytest.raises(DesignFailed):
        main(["--coupling", "spring-damper:any-environment", *base])


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        (["--coupling", "none,none"], "repeated"),
        (["--coupling", "none,,published"], "separated by commas"),
        (["--coupling", "a.json,b.json,c.json,d.json,e.json,f.json,g.json"], "1 to 6"),
        (["--coupling", "stiff"], "none, published"),
        (["--coupling", ""], "--coupling is empty"),
        (["--coupling", "spring-damper:foo"], "the condition is 'foo'"),
        (["--coupling", "published:"], "the condition is ''"),
        (["--case", "none", "--coupling", "published"], "without coupling"),
        (["--coupling", "missing.json"], "No such file"),
    ],
)
def test_bad_lists_of_couplings_are_refused(argv, message, tmp_path):
    with pytest.raises(InputError, match=message):
        main([*argv, "--out", str(tmp_path)])
