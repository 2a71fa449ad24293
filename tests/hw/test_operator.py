"""Check in virtual time who arms a live session, and when."""

import re

import numpy as np
import pytest

from haptic_loop.cli import session_cli
from haptic_loop.hw.driver import Operator
from haptic_loop.hw.emulator import Emulator, FaultInjection, nobody
from haptic_loop.hw.encoders import AxisCheck
from haptic_loop.hw.limits import SafetyLimits, Stage, Units
from haptic_loop.hw.monitor import LinkSettings
from haptic_loop.hw.rehearsal import Rehearsal
from haptic_loop.hw.session import Session
from tests.causes import cause_of
from tests.sessions import MovesAxes, rehearsal_of


def stages(session):
    """Return the stages that were entered, without the log's remark on positions."""
    return [event.stage for event in session.log if not event.cause.startswith("positions count from")]


@pytest.mark.parametrize("start", [0.2496, 0.5])
def test_a_session_arms_by_itself_once(scenario, link_couplings, start):
    """Late answers, in ramp-in or after it, end a session if nobody arms the softer coupling."""
    rehearsal = rehearsal_of(scenario, link_couplings, f"down:jitter=0.0008@{start}", operator=Operator(True, 5.0))
    session = rehearsal.run_until_armed(2.0)
    assert session.stage == Stage.REFUSED
    assert cause_of(session.cause).startswith("nobody to arm:")
    assert stages(session).count(Stage.ARMING) == 1


def test_a_key_that_cannot_arm_does_not_count(scenario, link_couplings, monkeypatch):
    """A key that could not arm the session does not count as an arming: the session arms by itself later."""
    held = [False]
    monkeypatch.setattr(Session, "held", property(lambda session: held[0]))
    operator = Operator(True, 5.0)
    rehearsal = rehearsal_of(scenario, link_couplings, operator=operator)
    session = rehearsal.run(0.3)
    operator.press("a", session, session.now)
    assert session.stage == Stage.DISARMED
    held[0] = True
    assert rehearsal.run_until_armed(0.6).stage == Stage.ARMED


def test_sessions_with_late_answers_never_reach_full_gain(scenario, link_couplings):
    """A tenth of 200 ticks is late long before the 209 ticks of the ramp are over."""
    rehearsal = rehearsal_of(scenario, link_couplings, "down:jitter=0.0008@0", operator=Operator(True, 5.0))
    session = rehearsal.run_until_armed(2.0)
    assert Stage.DISARMING in stages(session)
    assert Stage.ARMED not in stages(session)
    assert session.stage == Stage.REFUSED
    assert stages(session).count(Stage.ARMING) == 1


def test_sessions_end_after_their_time_at_full_gain(scenario, link_couplings):
    operator = Operator(True, 0.3)
    rehearsal = rehearsal_of(scenario, link_couplings, operator=operator)
    session = rehearsal.run_until_armed(0.6)
    assert session.stage == Stage.ARMED
    assert operator.press("a", session, session.now) == ()
    rehearsal.run_until_armed(1.5)
    assert (session.stage, cause_of(session.cause)) == (Stage.FINISHED, "time:")
    at = {event.stage: event.t_us for event in session.log}
    assert at[Stage.DISARMING] - at[Stage.ARMED] == pytest.approx(300_000, abs=2400)  # the time is checked once a tick


def test_a_key_arms_a_disarmed_session_only(scenario, link_couplings):
    """A key pressed in a ramp-out must not arm the next coupling."""
    operator = Operator(False, 5.0)
    rehearsal = rehearsal_of(scenario, link_couplings, "down:jitter=0.0008@0.5", operator=operator)
    session = rehearsal.run(0.3)
    assert session.stage == Stage.DISARMED
    assert operator.press("a", session, session.now) == ()
    rehearsal.run_until_armed(0.6)
    assert session.stage == Stage.ARMED
    while session.stage != Stage.DISARMING:
        rehearsal.run(1e-6 * session.now + 0.01)
    operator.press("a", session, session.now)
    rehearsal.run(1e-6 * session.now + 0.4)
    assert session.stage == Stage.DISARMED
    assert stages(session).count(Stage.ARMING) == 1
    operator.press("a", session, session.now)
    rehearsal.run(1e-6 * session.now + 0.4)
    assert stages(session).count(Stage.ARMING) == 2


def test_other_keys_do_nothing(scenario, link_couplings):
    rehearsal = rehearsal_of(scenario, link_couplings, operator=Operator(False, 1.0))
    session = rehearsal.run(0.3)
    assert session.stage == Stage.DISARMED
    for key in ("x", "\n", "A"):
        assert Operator(False, 1.0).press(key, session, session.now) == ()
        assert session.stage == Stage.DISARMED


@pytest.mark.parametrize("encoders", [True, False])
def test_sessions_that_never_armed_have_not_finished(scenario, link_couplings, encoders):
    settings = LinkSettings(measure=100, test_encoders=encoders)
    session = Session(scenario, SafetyLimits((12.0, 12.0)), settings)
    rehearsal = Rehearsal(session, Emulator(scenario), lambda ages: link_couplings, operator=Operator(False, 1.0))
    assert rehearsal.run(0.3).stage == Stage.DISARMED
    Operator(False, 5.0).press("q", session, session.now)
    assert (session.stage, session.cause) == (Stage.STOPPED, "key q, before any force acted")


def test_the_status_line_shows_positions_and_request(scenario, link_couplings, monkeypatch, capfd):
    """Both fit into 80 columns."""
    monkeypatch.setenv("COLUMNS", "80")
    settings = LinkSettings(measure=100, check_axes=True)
    session_cli._show(rehearsal_of(scenario, link_couplings, settings=settings).run(1.5))
    assert re.search(
        r"disarmed( · [+-]\d+\.\d{3} mm){2} · move axis 1 by \+5 mm or more and hold it", capfd.readouterr().err
    )


# axes that a person moves before the first arming


def shown(scenario, link_couplings, monkeypatch, *faults, mm=6.0, seconds=8.0):
    """Run a session whose person moves each axis by `mm` when asked, and repeats a wrong motion from the same place."""
    monkeypatch.setattr("haptic_loop.hw.driver._LET_GO_US", 300_000)
    free, faults = nobody(scenario), tuple(map(FaultInjection.parse, faults))
    session = Session(free, SafetyLimits((12.0, 12.0)), LinkSettings(measure=100, held=False, check_axes=True))
    emulator = Emulator(free, faults)
    person = MovesAxes(emulator, mm)
    rehearsal = Rehearsal(
        session, emulator, lambda ages: link_couplings, faults, operator=Operator(True, 5.0), watch=person
    )
    rehearsal.run_until_armed(0.6) if seconds is None else rehearsal.run_to_the_end(seconds)
    return session, rehearsal, person.axes


def test_axes_moved_as_asked_arm(scenario, link_couplings, monkeypatch):
    session, rehearsal, axes = shown(scenario, link_couplings, monkeypatch, seconds=None)
    assert session.stage == Stage.ARMED, session.cause
    assert axes == [1, 2]
    assert rehearsal.armed_us > 1e6 * (0.1 + 2 * 0.5 + 0.3)  # the measurement, two rests, the time to let go


def test_motor_tests_do_not_reveal_exchanged_axes(scenario, link_couplings):
    """Without the person the motor test passes, because motors and encoders are exchanged and reversed together."""
    rehearsal = rehearsal_of(scenario, link_couplings, "exchange", "motor=-1", "reverse", operator=None)
    assert rehearsal.run_until_armed(0.6).stage == Stage.ARMED


def test_small_motions_show_no_axis(scenario, link_couplings, monkeypatch):
    session, _, axes = shown(scenario, link_couplings, monkeypatch, mm=4.9, seconds=1.7)
    assert (session.stage, axes) == (Stage.DISARMED, [1])
    session.arm(session.now)
    assert session.stage == Stage.DISARMED
    assert cause_of(session.log[-1].cause) == "asked to move: 1 +5"


def checked(places, lever=1.0, q=1e-5):
    """Move axes to `places` [mm at a lever of 1 m] in 0.3 s each, with rests of 0.6 s; return (answers, check)."""
    T, m = 1e-3, len(places[0])
    check, answers, here = AxisCheck(Units((q,) * m, (1e-3,) * m, (10**9,) * m), T, lever), [], np.zeros(m)
    for place in [here, *(1e-3 / lever * np.array(place, dtype=float) for place in places)]:
        path = np.concatenate([np.linspace(here, place, 300), np.repeat([place], 600, axis=0)])
        answers += [check.note(tuple(np.round(x / q).astype(int).tolist())) for x in path]
        here = place
    return [answer for answer in answers if answer], check


@pytest.mark.parametrize("lever", [1.0, 0.02])
def test_one_axis_shows_its_direction(lever):
    """A knob held at 20 mm must turn by 5 mm / 20 mm = 0.25 rad."""
    assert checked([(5.05,)], lever)[1].request is None
    assert checked([(4.9,)], lever)[1].request is not None
    (answer,), _ = checked([(-5.05,), (0.0,), (-5.05,)], lever)
    assert cause_of(answer).startswith("moved backwards: 1 -")


@pytest.mark.parametrize(
    "places",
    [
        [(8, 0), (0, 0), (0, 6)],  # Axis 1 returns before axis 2 is moved.
        [(0, 7), (0, 0), (6, 0), (6, 6)],  # The person moves axis 2 first, goes back, and then moves axes 1 and 2.
        [(6, 6), (0, 0), (6, 1), (6, 7)],  # The person moves both axes at first.
        [(8, 2), (8, 10)],  # The person moves axis 1 obliquely.
    ],
)
def test_honest_motions_pass_the_check(places):
    answers, check = checked(places)
    assert not answers
    assert check.request is None


@pytest.mark.parametrize("x", [6, -6])
def test_a_motion_of_another_axis_is_named_twice(x):
    (answer,), check = checked([(0, x), (0, 0), (0, x)])
    assert cause_of(answer) == f"moved another axis: 2 {x:+} 1"
    assert check.request is not None


def test_the_way_back_counts_as_no_motion():
    """A reversed axis moves back in its measured + direction."""
    answers, check = checked([(-8,), (0,)])
    assert not answers
    assert cause_of(check.request) == "asked again: 1 -8 1 +5"


def test_a_sagging_handle_passes_no_axis():
    """At 0.8 mm/s every window of 0.5 s counts as rest; at 1.5 mm/s there is no rest."""
    for speed in (0.8, 1.5, -0.8):
        check = AxisCheck(Units((1e-5,), (1e-3,), (10**9,)), 1e-3, 1.0)
        assert not any(check.note((round(speed * k / 10),)) for k in range(15_000))
        assert check.request is not None
