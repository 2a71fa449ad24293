"""A device latches forces on arrival: its motion, the measurement and the certificate take account of this."""

import json
from itertools import pairwise

import numpy as np
import pytest
from causes import cause_of, expect_stop
from scipy.linalg import expm

from haptic_loop import load
from haptic_loop.cli.bridge import _overlong_tick
from haptic_loop.cli.bridge import main as bridge
from haptic_loop.cli.replay import main as replay
from haptic_loop.design.certificate import required_damping
from haptic_loop.design.result import HERE
from haptic_loop.hw.control import CouplingRequest, certified_couplings, timed
from haptic_loop.hw.emulator import Emulator, FaultInjection
from haptic_loop.hw.monitor import Ages, LinkSettings
from haptic_loop.hw.recording import Recorder
from haptic_loop.hw.rehearsal import Rehearsal
from haptic_loop.hw.session import Stage, session_for
from haptic_loop.models.scene import plant
from haptic_loop.sim.run import outside_forces
from haptic_loop.sim.scenario import InputError

LAB = load("omega-pair").replace(theta=(0, 0))
TAU = 130  # [us] delay of an emulated link


@pytest.mark.slow
@pytest.mark.parametrize("share", [pytest.param(0.0, marks=pytest.mark.validate), 0.1])
def test_the_last_force_holds_until_the_answer(share):
    """Recompute the trace's positions from its forces, by matrix exponentials before and after each latch.

    Motor 2 adds a share of force 1 to its own. The share is too small for the test at arming to find.
    """
    session = session_for(LAB, LinkSettings(measure=60))
    session.record = recorder = Recorder(2)

    def plan(ages):
        met, link = timed(LAB, ages, 0.99, 100.0, at_once=True)
        assert met.latency == ((pytest.approx(30e-6), pytest.approx(230e-6)),) * 2
        return certified_couplings(CouplingRequest(met), link, spare=0)

    faults = (FaultInjection.parse(f"cross={share}"),)
    emulator = Emulator(LAB, faults)
    rehearsal = Rehearsal(session, emulator, plan, faults)
    rehearsal.run_until_armed(1.4)
    assert session.stage == Stage.ARMED
    assert session.config.theta == 0
    assert session.program.scenario.theta == (0, 0)
    assert session.counters.late == 0
    assert session.counters.unlike == 0
    P, T, link = plant(emulator.plant.scene.model), LAB.T, recorder.link()
    n, w = len(P.A), P.B.shape[1] - 2
    whole = np.zeros((n + w + 2, n + w + 2))
    whole[:n, :n], whole[:n, n:] = P.A, P.B
    early, later = expm(whole * 1e-6 * TAU)[:n], expm(whole * (T - 1e-6 * TAU))[:n]
    applied = link["applied"] * emulator.force_step @ np.array([[1.0, share], [0.0, 1.0]])
    assert abs(applied).max() > 0.2
    first = int(np.argmax(link["tick"] == emulator.begun_at))
    pushed = np.zeros((len(applied), w))
    pushed[first:] = outside_forces(LAB, emulator.plant.scene, 0, len(applied) - first)
    assert link["received"].all()
    s, places = np.zeros(n), []
    for w, (before, after) in zip(pushed, pairwise(applied), strict=False):
        places.append(s[:2])
        for stretch, f in ((early, before), (later, after)):
            s = stretch @ np.concatenate([s, w, -f])
    counts = LAB.device[0].encoder_step or 1e-12 * emulator.info.encoder_step[0]
    apart = abs(np.array(places) - link["x"][:-1])
    assert apart.max() < 0.51 * counts


@pytest.mark.slow
def test_coupled_motors_are_found_at_arming():
    def plan(ages):
        met, link = timed(LAB, ages, 0.99, 100.0, at_once=True)
        return certified_couplings(CouplingRequest(met), link, spare=0)

    session, faults = session_for(LAB, LinkSettings(measure=60)), (FaultInjection.parse("cross=-1"),)
    Rehearsal(session, Emulator(LAB, faults), plan, faults).run_until_armed(1.0)
    assert session.stage == Stage.STOPPED
    assert cause_of(session.cause) == "connected axes: 1 2"


def test_a_link_slower_than_a_period_is_refused():
    with expect_stop("answers beyond a tick: 1250 1200"):
        timed(LAB, Ages((1150,) * 100), 0.99, 100.0, at_once=True)


def test_certificates_cover_the_spread_of_ticks():
    ages = Ages((130,) * 100, 0, (1200,) * 50 + (1201,) * 49 + (3000,))
    even, link = timed(LAB, ages, 0.9, 100.0)
    assert (even.T_max, link) == (None, 1)  # the clock's resolution is a microsecond
    spread, _ = timed(LAB, Ages((130,) * 100, 0, (1150,) * 60 + (1320,) * 40), 0.99, 100.0)
    assert spread.T_max == pytest.approx(1.32e-3)
    needs = [
        certified_couplings(
            CouplingRequest(s.replace(delta=(2.0, 2.0)), name="published", condition="this-environment"), 1, spare=0
        )[0].assessment.requirements
        for s in (even, spread)
    ]
    even_need, spread_need = (max(need["this-environment"].required) for need in needs)
    assert spread_need == pytest.approx(1.1 * even_need, rel=1e-9)
    known = LAB.replace(T_max=1.4e-3)
    assert timed(known, ages, 0.9, 100.0)[0].T_max == 1.4e-3


def test_known_devices_get_the_shortest_measured_tick():
    """Theorem B holds for periods from T_min on, and the other conditions do not need T_min."""
    known, ticks = load("omega-pair-known"), (600,) * 40 + (1200,) * 60
    met, _ = timed(known, Ages((130,) * 100, 0, ticks), 0.99, 100.0)
    assert met.T_min <= 1e-6 * min(ticks)
    assert timed(known, Ages((130,) * 100, 0, (1199, 1200, 1201)), 0.99, 100.0)[0].T_min is None
    assert timed(LAB, Ages((130,) * 100, 0, ticks), 0.99, 100.0)[0].T_min is None


@pytest.mark.validate
def test_known_devices_cover_ticks_that_are_short():
    """A coupling for the constant T needs more damping with ticks of 0.6 ms."""
    known, ticks = load("omega-pair-known"), (600,) * 40 + (1200,) * 60
    met, link = timed(known, Ages((130,) * 100, 0, ticks), 0.99, 100.0)
    constant, covered = (
        certified_couplings(CouplingRequest(s, condition="known-device"), link, spare=0)[0] for s in (known, met)
    )
    needed = required_damping(met.loop("I"), constant.chosen.coupling, "known-device")
    assert needed.ratio > 1 > required_damping(known.loop("I"), constant.chosen.coupling, "known-device").ratio
    assert required_damping(met.loop("I"), covered.chosen.coupling, "known-device").certified


def test_the_power_of_overlong_ticks_is_bounded():
    """The power is the sum over devices of the greatest -f v - delta v^2 over all v, which is f^2/(4 delta)."""
    v = np.linspace(-3, 3, 100_001)
    most = sum((f * v - d * v**2).max() for f, d in ((2.0, 1.37), (1.5, 0.9)))
    assert _overlong_tick((2.0, 1.5), (1.37, 0.9)) == pytest.approx(most, rel=1e-6)


@pytest.mark.slow
def test_couplings_are_named_with_their_latency():
    (made,) = certified_couplings(CouplingRequest(LAB.replace(latency=((3e-5, 2.3e-4),) * 2)), 0, spare=0)
    assert made.assessment.loop.latency == ((3e-5, 2.3e-4),) * 2
    assert made.link == 0
    assert made.name == "spring-damper for theta = [0, 0] and 30 to 230 us"


@pytest.mark.slow
def test_sessions_with_arrival_latching_replay_bit_for_bit(tmp_path, capsys):
    file = tmp_path / "r.json"
    options = ["--rehearse", "--theta", "0", "--latch", "arrival", "--duration", "0.3", "--no-plot"]
    assert bridge([*options, "--out", str(tmp_path), "--json", str(file)]) == 0
    report = json.loads(file.read_text())
    assert report["assessment"]["loop"]["theta"] == [0, 0]
    assert report["assessment"]["loop"]["latency_s"][0] == pytest.approx([30e-6, 230e-6])
    assert report["assessment"]["guarantee"]["environments"] == HERE
    assert report["link"]["age_us"]["p50"] == pytest.approx(TAU)
    said = " ".join(capsys.readouterr().out.split())
    assert "forces that act 30 to 230 us after their tick" in said
    assert "one longer tick may give a hand at most 0.617 mJ for every ms" in said
    assert replay([str(tmp_path / "trace.npz")]) == 0


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (
            ["--condition", "any-environment", "--psi", "1"],
            "--condition any-environment with --latch arrival",
        ),
        (["--energy-budget", "0.01"], "--energy-budget with --latch arrival"),
        (["--latency", "1e-4"], "latency: hw.bridge does not simulate this key"),
    ],
)
def test_options_that_exclude_arrival_latching_are_refused(more, said):
    with pytest.raises(InputError, match=said):
        bridge(["--rehearse", "--latch", "arrival", *more])


def test_force_dimension_devices_never_latch_at_ticks():
    with pytest.raises(InputError, match="--latch tick with --port force-dimension: "):
        bridge(["--port", "force-dimension", "--latch", "tick", "--arm", "--no-dead-man"])


@pytest.mark.parametrize("more", [["--condition", "any-environment", "--psi", "1"], ["--energy-budget", "0.01"]])
def test_refusals_name_the_port_that_was_given(more):
    with pytest.raises(InputError, match=" with --port force-dimension:0x,1x, whose") as refused:
        bridge(["--port", "force-dimension:0x,1x", "--arm", "--no-dead-man", *more])
    assert str(refused.value).startswith(more[0])
    assert "--latch" not in str(refused.value)
