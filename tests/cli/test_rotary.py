"""Scenarios in radians give the same numbers as scenarios in metres, with the units of rotary devices."""

import json
import re
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
from messages import says

from haptic_loop import certify, design_coupling, simulate, validate
from haptic_loop.controller.units import in_unit, keys_in_unit, set_unit
from haptic_loop.hw.emulator import Emulator, FaultInjection
from haptic_loop.hw.monitor import LinkSettings
from haptic_loop.hw.session import session_for
from haptic_loop.sim.couplings import read_coupling
from haptic_loop.sim.scenario import InputError, load, parse
from haptic_loop.sim.view.stage import _figure

WHEEL = Path(__file__).parents[2] / "examples/wheel.toml"
LINEAR = re.compile(r"N s/m|N/m\b|m/N|(?<!\w)[mu]m\b|(?<!\w)m/s|kg(?! m2)|\d N(?! m)|\[N\]|\[m\]|_(m|n|N|mm)\b")


@pytest.fixture(autouse=True)
def _metres():
    yield
    set_unit("m")


@pytest.mark.parametrize(
    ("linear", "rotary"),
    [
        ("needs 1.2 of 3 N s/m", "needs 1.2 of 3 N m s/rad"),
        ("K [N/m], B [N s/m]", "K [N m/rad], B [N m s/rad]"),
        ("mass is 7 kg, 3 mm off", "mass is 7 kg m2, 3 mrad off"),
        ("at 2 m/s, 12 N, 0.5 m", "at 2 rad/s, 12 N m, 0.5 rad"),
        ("limited to [8, 9] N and [1] m", "limited to [8, 9] N m and [1] rad"),
        ("force [N], x [m], x [mm], x [um]", "force [N m], x [rad], x [mrad], x [urad]"),
        ("3 mN of 2 mJ in 4 ms; m channels, N draws", "3 mN m of 2 mJ in 4 ms; m channels, N draws"),
        ("5e-4 m/N, 9 mm/s, 1 um", "5e-4 rad/(N m), 9 mrad/s, 1 urad"),
    ],
)
def test_texts_take_the_rotary_units(linear, rotary):
    assert in_unit(linear) == linear
    assert in_unit(linear, "rad") == in_unit(rotary, "rad") == rotary


def test_keys_take_the_rotary_units():
    set_unit("rad")
    report = {
        "encoder_step_m": [1.0],
        "peak_force_N": 2.0,
        "largest_difference_n": 0.0,
        "T_s": 1.0,
        "of": {"x_m": "1 N"},
    }
    assert keys_in_unit(report) == {
        **{"encoder_step_rad": [1.0], "peak_force_Nm": 2.0, "largest_difference_nm": 0.0, "T_s": 1.0},
        "of": {"x_rad": "1 N m"},
    }


def test_radians_change_no_number():
    """The wheel and the same numbers in metres have equal gains, requirements and traces, but different digests."""
    wheel = load(WHEEL)
    handle = parse(WHEEL.read_text().replace('unit = "rad"', "").replace("radius = 0.15", ""))
    gains, needs, forces = [], [], []
    for scenario in (wheel, handle):
        design = design_coupling(scenario.loop("I"))
        gains.append((design.coupling.K.tolist(), design.coupling.B.tolist()))
        needs.append(certify(scenario.loop("I"), design.coupling)["this-environment"].required)
        forces.append(simulate(scenario.replace(duration=0.2), design).f.tolist())
    assert gains[0] == gains[1]
    assert needs[0] == needs[1]
    assert forces[0] == forces[1]
    assert wheel.digest != handle.digest
    assert repr(wheel.loop("I")).count("N m s/rad") == 1


@pytest.mark.slow
def test_every_output_of_a_wheel_is_rotary(tmp_path, capsys):
    """Tables, reports, headers, C comments and logs of seven commands have no linear unit."""
    stored, out = tmp_path / "wheel.json", tmp_path / "out"
    for command, *words in (
        ("run", "--duration", "0.2", "--out", str(out)),
        ("audit", "--K", "10", "--B", "0.01", "--out", str(out)),
        ("design", "--case", "I", "--out", str(stored)),
        ("check", str(stored)),
        ("export", str(stored), "--out", str(tmp_path / "wheel.c")),
        ("bridge", "--rehearse", "--duration", "0.3", "--measure", "60", "--out", str(out), "--no-plot"),
        ("trace", str(out / "trace.npz"), "--plot", str(tmp_path / "trace.svg")),
    ):
        set_unit("m")
        of = [] if command in ("check", "export", "trace") else ["--scenario", str(WHEEL)]
        assert import_module(f"haptic_loop.cli.{command}").main([*words, *of]) == 0
        report = out / "report.json"
        printed = " ".join(capsys.readouterr().out.split()) + (report.read_text() if report.exists() else "")
        assert not (match := LINEAR.search(printed)), (command, printed[match.start() - 80 : match.end() + 80])
    assert (out / "trace.csv").read_text().splitlines()[0] == "t [s],x1 [rad],f1 [N m]"
    assert json.loads(report.read_text())["session"]["stage"] == "finished"
    assert not LINEAR.search((out / "incidents.jsonl").read_text())
    comments = re.findall(r"/\*.*?\*/", (tmp_path / "wheel.c").read_text(), flags=re.DOTALL)
    assert not LINEAR.search(" ".join(comments))
    assert read_coupling(stored).loop.unit == "rad"


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("radius = 0.15", "radius = 3"), "radius is 3"),
        (('unit = "rad"', ""), 'radius is 0.15, which is for unit = "rad" only'),
        (('"rad"', '"deg"'), "unit"),
        (("credible_speed = 10.0", ""), "device #1: missing credible_speed: rotary devices have neither defaults"),
        (
            ('kind = "rigid"', 'kind = "compliant"'),
            "device #1: missing motor_mass, handle_mass, transmission_stiffness",
        ),
        (('kind = "rigid"', 'device = "omega.3"'), "neither defaults nor a catalogue"),
        (("mass = 0.02\ndamping = 0.1", "mass = 1e9\ndamping = 0.1"), "mass is 1e+09 .. 1e-09 to 1000 kg m2"),
    ],
)
def test_wrong_rotary_fields_are_named(change, words):
    with pytest.raises(InputError) as error:
        parse(WHEEL.read_text().replace(*change))
    assert says(error.value, words)


@pytest.mark.parametrize(
    ("command", "words", "unit"),
    [
        ("audit", ["--K", "-1"], "1e+09 N m/rad"),
        ("audit", ["--K", "1", "--B", "-1"], "1e+06 N m s/rad"),
        ("zwidth", ["--mark", "1e-9,1"], "N m/rad, B 0 to 1e6 N m s/rad"),
    ],
)
def test_refusals_of_options_use_rotary_units(command, words, unit):
    with pytest.raises(InputError) as error:
        import_module(f"haptic_loop.cli.{command}").main(["--scenario", str(WHEEL), *words])
    assert unit in in_unit(str(error.value))


def test_the_live_window_has_rotary_units():
    """The window's thread takes the unit from the scenario, since no command has set it there."""
    figure = _figure(0, np.zeros((2, 1)), np.zeros((2, 1)), 1.0, load(WHEEL).unit)
    assert figure.title == "force on device 1 [N m]"


def test_sessions_ask_for_the_radius():
    """Limits are those of a hand at 0.15 m: 2 N are 0.3 N m, 0.7 m/s are 4.7 rad/s, and 3 mm are 0.02 rad."""
    limits = session_for(load(WHEEL), LinkSettings(), cap=2.0).limits
    assert limits.cap == (0.3,)
    assert limits.speed == pytest.approx(0.7 / 0.15)
    assert limits.jump == pytest.approx(0.02)
    with pytest.raises(InputError, match="radius is missing"):
        session_for(parse(WHEEL.read_text().replace("radius = 0.15", "")), LinkSettings())


KNOB = """
name = "knob"
unit = "rad"
radius = 0.02
T = 1e-3
theta = [1]
device = [{ kind = "rigid", mass = 2e-5, damping = 2e-4, force_limit = 0.1, credible_speed = 30.0 }]
[environment]
contacts = ["rim"]
springs = [{ between = ["rim", "ground"], stiffness = 0.05, damping = 1e-4 }]
"""


def test_default_hands_hold_the_radius():
    """At the hand, a knob has the default hands of a handle: 0.3 kg, 3 N s/m, 200 N/m, 15 mm; 0.01 to 3 kg."""
    knob = parse(KNOB)
    link, motion, people = knob.human[0].links[0], knob.human[0].voluntary, knob.population
    assert (link.mass, link.damping, link.stiffness) == pytest.approx((1.2e-4, 1.2e-3, 0.08))
    assert (motion.amplitude, motion.frequency) == pytest.approx((0.75, 0.6))
    ranges = np.array([people.mass, people.damping, people.stiffness])
    assert ranges == pytest.approx(4e-4 * np.array([(0.01, 3.0), (0.1, 30.0), (1.0, 2000.0)]))
    some = parse(KNOB + "[population]\nlinks = 2\nmass = [1e-5, 1e-4]").population
    assert (some.links, some.mass) == (2, (1e-5, 1e-4))
    assert some.damping == people.damping


def test_hands_without_size_ask_for_the_radius():
    alone = KNOB.replace("radius = 0.02", "")
    with pytest.raises(InputError, match=r"radius is missing.*\[\[human\]\]"):
        parse(alone)
    held = parse(alone + "[[human]]\nlinks = [{ mass = 1e-4, damping = 1e-3, stiffness = 0.1 }]")
    with pytest.raises(InputError, match=r"radius is missing.*\[population\]"):
        validate(held, None, humans=2)


def test_faults_of_a_knob_are_at_the_hand():
    """At 20 mm, 5 mm are 0.25 rad, and 0.6 N are 12 mN m."""
    jumps, limit = Emulator(parse(KNOB), (FaultInjection.parse("jump=5"),)), FaultInjection.parse("limit=0.6")
    assert jumps._in_counts(FaultInjection.parse("jump=5")) * 1e-12 * jumps.info.encoder_step[0] == pytest.approx(0.25)
    assert jumps._broken(limit, 0)(1.0) == pytest.approx(0.012)


def test_coarse_wheels_are_refused_in_radians(tmp_path):
    """900 counts per turn are 6.98 mrad; 2 mrad, or 0.3 mm at 0.15 m, are a tenth of the largest motion in a tick."""
    path = tmp_path / "wheel.toml"
    path.write_text(WHEEL.read_text().replace("force_limit = 8.0", f"force_limit = 8.0\nencoder_step = {np.pi / 450}"))
    with pytest.raises(InputError) as error:
        import_module("haptic_loop.cli.bridge").main(["--scenario", str(path), "--rehearse"])
    assert says(in_unit(str(error.value)), "encoder_step of channel 1 is 0.00698132 .. 0.002 rad")


@pytest.mark.parametrize("cap", [None, 5.0])
def test_a_healthy_knob_finishes_its_rehearsal(cap, tmp_path):
    """The default cap of 0.5 N holds 0.01 N m, 5 N are the knob's own limit of 0.1 N m."""
    path = tmp_path / "knob.toml"
    path.write_text(KNOB)
    words = ["--scenario", str(path), "--rehearse", "--duration", "0.5", "--measure", "60", "--no-plot"]
    words += ["--out", str(tmp_path / "out"), *(["--force-cap", str(cap)] if cap else [])]
    assert import_module("haptic_loop.cli.bridge").main(words) == 0


def test_soft_springs_are_stiff_for_knobs(tmp_path, capsys):
    """Two knobs of 2e-4 N m s/rad need K below 1 N m/rad, and half a spring of 0.05 N m/rad is not useless."""
    path = tmp_path / "knobs.toml"
    device = re.search(r"device = \[(.*)\]", KNOB)[1]
    text = KNOB.replace(device, f"{device}, {device}").replace("[1]", "[1, 1]").replace('"rim"]', '"rim", "rim2"]', 1)
    path.write_text(text.replace('["rim", "ground"]', '["rim", "rim2"]'))
    design = design_coupling(load(path).loop("I"))
    assert 0.1 < max(design.coupling.K) < 1.0
    path.write_text(KNOB)
    assert import_module("haptic_loop.cli.audit").main(["--scenario", str(path), "--K", "0.05", "--B", "1e-4"]) == 0
    assert "Useless" not in capsys.readouterr().out
