"""Tests of the Coulomb friction that covers encoder steps: the needed friction W, and the energy of quantised loops."""

import json
from dataclasses import replace
from itertools import product
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from evaluate import this_environment
from msgspec.structs import replace as change
from shared import FIGURE_4

from haptic_loop.cli.audit import main as audit_command
from haptic_loop.cli.bridge import _certified
from haptic_loop.cli.bridge import main as bridge_command
from haptic_loop.cli.compare import _panel_title
from haptic_loop.cli.compare import main as compare_command
from haptic_loop.cli.design import main as design_command
from haptic_loop.cli.run import main as run_command
from haptic_loop.cli.validate import main as validate_command
from haptic_loop.cli.verdict import verdict
from haptic_loop.cli.zwidth import main as zwidth_command
from haptic_loop.controller.coupling import SpringDamper
from haptic_loop.controller.delay import VaryingDelay, delay
from haptic_loop.controller.loop import Loop
from haptic_loop.controller.lti import Lti, taps
from haptic_loop.design import budgets
from haptic_loop.design.assessment import EncoderSteps, assess
from haptic_loop.design.conditions import _l1_gain, encoder_friction
from haptic_loop.hw.control import CertifiedCoupling
from haptic_loop.sim import scenario as scenario_module
from haptic_loop.sim.api import simulate
from haptic_loop.sim.comparison import Alternative
from haptic_loop.sim.couplings import assessed, encoder_steps, given
from haptic_loop.sim.scenario import load

T, STEP = 1.2e-3, 1e-5
LOOP = Loop(T, (0, 1), (0, 0), (0, 1), (1.37, 1.37), FIGURE_4)
SOFT = SpringDamper([300.0, 300.0], [1.0, 1.0])
F = LOOP.F(SpringDamper([879.0, 552.0], [0.39, 0.52]))


def summed(G: Lti) -> np.ndarray:
    """Return the sum of |D| and of |C A^k B| for k below 60,000, (outputs, inputs); 200 ticks are one product."""
    ticks = [G.B]
    for _ in range(199):
        ticks.append(G.A @ ticks[-1])
    total, X, later = np.abs(G.D), np.array(ticks), np.linalg.matrix_power(G.A, 200)
    for _ in range(300):
        total, X = total + np.abs(G.C @ X).sum(axis=0), later @ X
    return total


def test_ten_micrometre_steps_need_known_friction():
    """The friction is half a step times the l1 gain of F, which a sum over 60,000 ticks gave to four decimals."""
    assert _l1_gain(F).sum(axis=1) == pytest.approx([10019.6547, 7563.3655], abs=1e-4)
    assert encoder_friction(F, [STEP, STEP]) == pytest.approx([0.050098, 0.037817], abs=1e-6)
    assert encoder_friction(F, [0.0, 0.0]) == pytest.approx([0.0, 0.0])
    with pytest.raises(ValueError, match="expected 2 encoder steps"):
        encoder_friction(F, [STEP])


def test_an_upper_friction_bound_covers_no_steps():
    coupling, steps = SpringDamper([879.0, 552.0], [0.39, 0.52]), [STEP, STEP]
    needed = encoder_friction(F, steps)
    bounded = EncoderSteps.of(LOOP, coupling, steps, [0.0, 0.0], [0.26, 0.26])
    declared = EncoderSteps.of(LOOP, coupling, steps, [0.26, 0.26])
    assert (needed < 0.26).all()
    assert not bounded.covered
    assert "published: at most 0.26, 0.26 N" in bounded.words
    assert declared.covered
    assert not EncoderSteps.of(LOOP, coupling, steps, needed * [1.01, 0.99]).covered  # every axis needs its friction


def test_axes_share_the_friction_of_their_device():
    """Friction of 0.3 N against the velocity in space may act with only 0.3/sqrt(3) N on each axis."""
    space = load("omega-space")
    devices = [change(device, friction=0.3, encoder_step=STEP) for device in space.device]
    coupling = SpringDamper([400.0] * 6, [0.1] * 6)
    assessment = SimpleNamespace(guarantee=None, coupling=coupling, environment=space.environment)
    steps = encoder_steps(space.replace(device=devices), "I", assessment)
    assert steps.friction == pytest.approx([0.3 / 3**0.5] * 6)


def test_friction_covers_no_steps_of_known_devices():
    """The speed has a triangular spike of height v0 at each tick, with alternating signs: dx = 0 and |dv| = 2 v0.

    Force errors of size W supply W beta |dv| per period, more than friction W and the motor's c2 v'^2 and c0 v^2 take.
    """
    beta, mass, delta, W = 5e-5, 0.06, 1.37, 0.05
    v0, width = 0.1 * beta * W / mass, beta
    area, square, slope = v0 * width / 2, v0**2 * width / 3, 4 * v0**2 / width  # integrals of |v|, v^2 and v'^2
    assert W * area + delta * square + beta * mass * slope < W * beta * 2 * v0
    coupling, steps = SpringDamper([879.0, 552.0], [0.39, 0.52]), [STEP, STEP]
    assert EncoderSteps.of(LOOP, coupling, steps, [0.26, 0.26]).covered
    known = EncoderSteps.of(LOOP, coupling, steps, [0.26, 0.26], beyond="known-device")
    assert not known.covered
    assert known.friction_needed is None


def test_steps_are_covered_with_one_object_only():
    """A guarantee for any passive object covers encoder steps with one object only, whose F sets the friction."""
    coupling = SpringDamper([879.0, 552.0], [0.39, 0.52])
    covered = EncoderSteps.of(LOOP, coupling, [STEP, STEP], [0.26, 0.26])
    words = verdict(replace(assess(LOOP, coupling), encoder=covered))
    assert "any passive object" in words
    assert covered.covered
    assert covered.sentence in words


def test_friction_is_compared_in_the_running_environment():
    """With twice the mass, the error of a step rings longer: the friction needed grows by 37 % and 36 %."""
    coupling, steps = SpringDamper([879.0, 552.0], [0.39, 0.52]), [STEP, STEP]
    heavy = change(FIGURE_4, masses={name: 2 * mass for name, mass in FIGURE_4.masses.items()})
    at_heavy = LOOP.at(heavy).F(coupling)
    needed = summed(at_heavy).sum(axis=1) * STEP / 2
    scenario = load().replace(environment=FIGURE_4, theta=LOOP.theta)
    devices = [
        change(device, friction=float(f), encoder_step=STEP)
        for device, f in zip(scenario.device, 1.01 * encoder_friction(F, steps), strict=True)
    ]
    scenario = scenario.replace(device=devices)
    assessment = SimpleNamespace(guarantee=None, coupling=coupling, environment=FIGURE_4)
    assert encoder_steps(scenario, "I", assessment).covered
    assessment.environment = heavy
    running = encoder_steps(scenario, "I", assessment)
    assert not running.covered
    assert running.friction_needed == pytest.approx(needed, rel=1e-8)


_LOST = "varying_delay = { lo = [1, 2], hi = [2, 3], loss = 0.2 }"
_SHORT = ["--duration", "0.05", "--no-plot"]


def _first_line(command, scenario, options, tmp_path, capsys):
    """Return (exit code, first line, JSON) of a command with a changed omega-pair."""
    lines = {"lost": _LOST, "steps": "", "friction": ""}[scenario]
    device = {"lost": "", "steps": "encoder_step = 2e-4\n", "friction": "encoder_step = 2e-4\nfriction = 2.0\n"}
    source = (Path(scenario_module.__file__).parent / "scenarios" / "omega-pair.toml").read_text()
    source = source.replace("force_limit = 12.0", f"{device[scenario]}force_limit = 12.0")
    file, record = tmp_path / "s.toml", tmp_path / "report.json"
    file.write_text(source.replace("[[device]]", f"{lines}\n[[device]]", 1))
    code = command(["--scenario", str(file), "--json", str(record), *options])
    return code, capsys.readouterr().out.splitlines()[0], json.loads(record.read_text())


def stated(covered):
    """Return a record with the words that commands must print if friction covers the encoder steps, or if not."""
    return EncoderSteps((STEP,), (0.0,), (None,), None, covered, "")


_COMMANDS = {
    "run": (run_command, [*_SHORT, "--out", "out"]),
    "audit": (audit_command, ["--K", "300", "--B", "1"]),
    "design": (design_command, ["--out", "c.json"]),
    "validate": (validate_command, ["--humans", "2", "--duration", "0", "--no-plot", "--out", "out"]),
    "compare": (compare_command, ["--coupling", "spring-damper", "--no-plot", "--out", "out"]),
}


#: `make test` runs these pairs, `make suite` also the slow ones, `make validate` all others.
_QUICK = (("audit", "steps"), ("audit", "friction"))
_SLOW = (("run", "friction"), ("design", "steps"), ("validate", "lost"), ("compare", "steps"))


@pytest.mark.parametrize(
    ("name", "scenario"),
    # sim.validate refuses friction.
    [
        pytest.param(*pair, marks=[] if pair in _QUICK else pytest.mark.slow if pair in _SLOW else pytest.mark.validate)
        for pair in product(_COMMANDS, ("lost", "steps", "friction"))
        if pair != ("validate", "friction")
    ],
)
def test_commands_state_the_same_qualified_guarantee(name, scenario, tmp_path, monkeypatch, capsys):
    command, options = _COMMANDS[name]
    monkeypatch.chdir(tmp_path)
    code, line, record = _first_line(command, scenario, options, tmp_path, capsys)
    if command is compare_command:
        words = "spring-damper (none)" if scenario == "lost" else stated(scenario == "friction").suffix
        (coupling,) = record["couplings"]
        assessment = coupling["assessment"]
    else:
        words = "a lost packet" if scenario == "lost" else stated(scenario == "friction").sentence
        assessment = record["assessment"]
    assert words in line
    assert (assessment["guarantee"] is None) == (scenario == "lost")
    if scenario != "lost":
        assert assessment["encoder"]["covered"] == (scenario == "friction")
    if command in (audit_command, design_command):
        assert code == (scenario == "lost")
    if command is design_command and scenario == "lost":
        assert record["stored"]["switching"]["guarantee"] is None


@pytest.mark.slow
def test_traces_state_the_qualified_guarantee():
    scenario = load("omega-pair").replace(duration=0.05)
    lossy = scenario.replace(varying_delay=VaryingDelay(lo=(1, 2), hi=(2, 3), pattern="random", loss=0.2))
    assert simulate(lossy, SOFT).meta["assessment"]["guarantee"] is None
    devices = tuple(change(d, encoder_step=2e-4, friction=2.0) for d in scenario.device)
    meta = simulate(scenario.replace(device=devices), SOFT).meta
    assert meta["assessment"]["guarantee"]
    assert meta["assessment"]["encoder"]["covered"]
    assert meta["assessment"]["encoder"]["words"] in meta["remarks"]


def test_panels_and_bridge_tables_qualify_guarantees():
    """Titles and table cells name the encoder steps as the verdict does."""
    scenario, chosen = load("omega-pair"), given(SOFT)
    for friction, words in (0.0, "for exact positions only"), (2.0, "encoder steps with this object only"):
        devices = tuple(change(d, encoder_step=2e-4, friction=friction) for d in scenario.device)
        assessment = assessed(scenario.replace(device=devices), "I", chosen)
        panel = _panel_title(Alternative("spring-damper", "this-environment", assessment.guarantee_words))
        program = CertifiedCoupling(0, scenario, "I", chosen, assessment)
        assert panel.endswith(words)
        assert _certified(program)[-1].endswith(words)
        assert assessment.guarantee.part()["words"].endswith(words)
        assert assessment.with_encoder(None).guarantee.positions == ""


@pytest.mark.validate
def test_sessions_count_the_steps_of_the_device(tmp_path, capsys):
    """A session's device always counts encoder steps, also if the scenario declares none."""
    bridge_command(["--rehearse", "--duration", "0.2", "--no-plot", "--out", str(tmp_path)])
    assert stated(False).sentence in " ".join(capsys.readouterr().out.split())


@pytest.mark.slow
def test_maps_say_their_guarantees_are_for_exact_positions(tmp_path, capsys):
    source = (Path(scenario_module.__file__).parent / "scenarios" / "omega-pair.toml").read_text()
    (tmp_path / "s.toml").write_text(source.replace("force_limit = 12.0", "encoder_step = 1e-5\nforce_limit = 12.0"))
    options = ["--grid=4", "--points=0", "--humans=1", "--no-plot"]
    zwidth_command([*options, "--out", str(tmp_path), "--scenario", str(tmp_path / "s.toml")])
    assert "Guarantees are for exact positions" in " ".join(capsys.readouterr().out.split())


def test_the_l1_gain_is_a_close_upper_bound():
    total = summed(F)
    assert (_l1_gain(F) >= total * (1 - 1e-13)).all()  # rounding of 60,000 terms
    assert _l1_gain(F) == pytest.approx(total, rel=1e-8)


@pytest.mark.parametrize("pole", [0.0, 0.9, -0.99, 1 - 1e-4])
def test_first_order_gains_match_the_closed_form(pole):
    one = Lti([[pole]], [[1.0]], [[1 - pole]], [[0.5]], T)
    assert _l1_gain(one)[0, 0] == pytest.approx(0.5 + (1 - pole) / (1 - abs(pole)), rel=1e-7)


def test_slowly_decaying_responses_have_bounded_gains(monkeypatch):
    monkeypatch.setattr(budgets, "GAIN_CHUNKS", 100)
    slow = Lti([[1 - 1e-9]], [[1.0]], [[1.0]], [[0.0]], T)  # too slow to be summed; the gain is 1e9
    assert 1e9 <= _l1_gain(slow)[0, 0] < np.inf


def test_delays_keep_gains_and_integrators_are_unbounded():
    assert _l1_gain(delay((3,), T) @ taps([1.0, -2.0, 0.5], T))[0, 0] == pytest.approx(3.5)
    assert _l1_gain(Lti([[1.0]], [[1.0]], [[1.0]], [[0.0]], T))[0, 0] == np.inf


@pytest.mark.parametrize("amplitude", [0.05, 3.0, 100.0])
def test_quantised_loops_gain_no_energy(amplitude):
    """sum f'dx + dx' Delta dx/T + W |dx| >= 0 from rest near the edge of a step; without W small motions violate it."""
    requirement = this_environment(F, LOOP.delta)
    delta, W = np.array(requirement.required) * (1 + 1e-9), encoder_friction(F, [STEP, STEP])
    hz, phase = np.geomspace(2, 400, 25), np.random.default_rng(1).uniform(0, 2 * np.pi, (25, 2)).T
    k = np.arange(4000)[:, None, None]
    way = np.minimum(k / 200, 1)  # ramp from rest to the position where the encoder's value changes
    x = STEP * way * (0.5 + amplitude * np.sin(2 * np.pi * hz * T * k + phase))  # (ticks, channels, motions)
    rounded, state, plain, paid, least = np.round(x / STEP) * STEP, np.zeros((F.order, 25)), 0.0, 0.0, np.inf
    for measured, dx in zip(rounded, np.diff(x, axis=0), strict=False):
        work = ((F.C @ state + F.D @ measured) * dx).sum(axis=0) + delta / T @ dx**2
        state = F.A @ state + F.B @ measured
        plain, paid = plain + work, paid + work + W @ np.abs(dx)
        assert (paid >= -1e-15).all()
        least = min(least, plain.min())
    if amplitude < 1:
        assert least < 0
