"""Check in virtual time who arms a live session, and when."""

import re

import pytest

from haptic_loop.hw.driver import Operator
from haptic_loop.hw.emulator import Emulator, FaultInjection, nobody
from haptic_loop.hw.encoders import AxisCheck
from haptic_loop.hw.limits import SafetyLimits, Stage, Units
from haptic_loop.hw.monitor import LinkSettings
from haptic_loop.hw.rehearsal import Rehearsal
from haptic_loop.hw.session import Session


def rehearsal_of(scenario, rungs, operator, *faults):
    session = Session(scenario, SafetyLimits((12.0, 12.0)), LinkSettings(measure=100))
    faults = tuple(map(FaultInjection.parse, faults))
    return Rehearsal(session, Emulator(scenario, faults), lambda ages: rungs, faults, operator=operator)


def stages(session):
    """Return the stages that were entered, without the log's remark on positions."""
    return [event.stage for event in session.log if not event.cause.startswith("positions count from")]


@pytest.mark.parametrize("start", [0, 0.05, 0.2, 0.2496, 0.26, 0.5])
def test_a_session_arms_by_itself_once(scenario, rungs, start):
    """Late answers, in ramp-in or after it, end a session if nobody arms the softer coupling."""
    rehearsal = rehearsal_of(scenario, rungs, Operator(True, 5.0), f"down:jitter=0.0008@{start}")
    session = rehearsal.run_until_armed(2.0)
    assert session.stage == Stage.REFUSED
    assert "nobody is there to arm the softer coupling" in session.cause
    assert stages(session).count(Stage.ARMING) == 1


def test_a_key_during_a_hindrance_arms_nothing(scenario, rungs, monkeypatch):
    """A key that could not arm the session does not count as an arming: the session arms by itself later."""
    held = [False]
    monkeypatch.setattr(Session, "held", property(lambda session: held[0]))
    operator = Operator(True, 5.0)
    rehearsal = rehearsal_of(scenario, rungs, operator)
    session = rehearsal.run(0.5)
    operator.press("a", session, session.now)
    assert session.stage == Stage.DISARMED
    held[0] = True
    assert rehearsal.run_until_armed(1.5).stage == Stage.ARMED


def test_sessions_with_late_answers_never_reach_full_gain(scenario, rungs):
    """A tenth of 200 ticks is late long before the 209 ticks of the ramp are over."""
    session = rehearsal_of(scenario, rungs, Operator(True, 5.0), "down:jitter=0.0008@0").run_until_armed(2.0)
    assert Stage.DISARMING in stages(session)
    assert Stage.ARMED not in stages(session)


def test_sessions_end_after_their_time_at_full_gain(scenario, rungs):
    operator = Operator(True, 0.3)
    rehearsal = rehearsal_of(scenario, rungs, operator)
    session = rehearsal.run_until_armed(0.6)
    assert session.stage == Stage.ARMED
    assert operator.press("a", session, session.now) == ()
    rehearsal.run_until_armed(1.5)
    assert (session.stage, session.cause) == (Stage.FINISHED, "the time is over")
    at = {event.stage: event.t_us for event in session.log}
    assert at[Stage.DISARMING] - at[Stage.ARMED] == pytest.approx(300_000, abs=2400)  # the time is checked once a tick


def test_a_key_arms_a_disarmed_session_only(scenario, rungs):
    """A key pressed in a ramp-out must not arm the next coupling."""
    operator = Operator(False, 5.0)
    rehearsal = rehearsal_of(scenario, rungs, operator, "down:jitter=0.0008@0.5")
    session = rehearsal.run(0.5)
    assert session.stage == Stage.DISARMED
    assert operator.press("a", session, session.now) == ()
    rehearsal.run_until_armed(0.6)
    assert session.stage == Stage.ARMED
    begun = session.now
    while session.stage != Stage.DISARMING:
        rehearsal.run(1e-6 * session.now + 0.01)
    operator.press("a", session, session.now)
    rehearsal.run(1e-6 * begun + 1.5)
    assert session.stage == Stage.DISARMED
    assert stages(session).count(Stage.ARMING) == 1
    operator.press("a", session, session.now)
    rehearsal.run(1e-6 * session.now + 0.4)
    assert stages(session).count(Stage.ARMING) == 2


@pytest.mark.parametrize("key", ["x", "\n", "A"])
def test_other_keys_do_nothing(scenario, rungs, key):
    rehearsal = rehearsal_of(scenario, rungs, Operator(False, 1.0))
    session = rehearsal.run(0.5)
    assert Operator(False, 1.0).press(key, session, session.now) == ()
    assert session.stage == Stage.DISARMED


@pytest.mark.parametrize("encoders", [True, False])
def test_sessions_that_never_armed_have_not_finished(scenario, rungs, encoders):
    settings = LinkSettings(measure=100, test_encoders=encoders)
    session = Session(scenario, SafetyLimits((12.0, 12.0)), settings)
    rehearsal = Rehearsal(session, Emulator(scenario), lambda ages: rungs, arm=False)
    assert rehearsal.run(1.0).stage == Stage.DISARMED
    Operator(False, 5.0).press("q", session, session.now)
    assert (session.stage, session.cause) == (Stage.STOPPED, "key q, before any force acted")


# axes that a person moves before the first arming


def shown(scenario, rungs, monkeypatch, *faults, mm=6.0, seconds=8.0):
    """Run a session whose person moves each axis by `mm` when asked, and then lets go of it."""
    monkeypatch.setattr("haptic_loop.hw.driver._LET_GO_US", 300_000)
    free, faults, requests = nobody(scenario), tuple(map(FaultInjection.parse, faults)), []
    session = Session(free, SafetyLimits((12.0, 12.0)), LinkSettings(measure=100, held=False, check_axes=True))
    emulator = Emulator(free, faults)

    def move(session):
        asked = re.match(r"move axis (\d) by 5 mm or more in its \+ direction", session.request or "")
        if asked and session.request not in requests:
            emulator.plant.s[int(asked[1]) - 1 : 4 : 2] += 1e-3 * mm  # motor and handle
            requests.append(session.request)

    rehearsal = Rehearsal(session, emulator, lambda ages: rungs, faults, operator=Operator(True, 5.0), watch=move)
    rehearsal.run_until_armed(0.6) if seconds is None else rehearsal.run(seconds)
    return session, rehearsal, [int(request[10]) for request in requests]


def test_axes_moved_as_asked_arm(scenario, rungs, monkeypatch):
    session, rehearsal, axes = shown(scenario, rungs, monkeypatch, seconds=None)
    assert session.stage == Stage.ARMED, session.cause
    assert axes == [1, 2]
    assert rehearsal.armed_us > 1e6 * (0.1 + 2 * 0.5 + 0.3)  # the measurement, two rests, the time to let go


@pytest.mark.parametrize(
    ("faults", "mm", "words"),
    [
        (["exchange"], 6, r"axis 2 moved by \+6 mm instead of axis 1: the axes are exchanged"),
        (["exchange"], -6, "axis 2 moved by -6 mm instead of axis 1"),
        (["motor=-1", "reverse"], 6, r"axis 1 moved by -6 mm, not in \+ direction: reverse both its motor"),
        (["axis2:motor=-1", "axis2:reverse"], 6, r"axis 2 moved by -6 mm, not in \+ direction"),
        ([], -6, "axis 1 moved by -6 mm, not in"),
    ],
)
def test_axes_moved_otherwise_are_refused(scenario, rungs, monkeypatch, faults, mm, words):
    session, rehearsal, _ = shown(scenario, rungs, monkeypatch, *faults, mm=mm)
    assert session.stage == Stage.REFUSED
    assert re.match(words, session.cause), session.cause
    assert rehearsal.armed_us is None


@pytest.mark.parametrize("faults", [["exchange"], ["motor=-1", "reverse"]])
def test_no_force_shows_exchanged_axes(scenario, rungs, faults):
    """Without the person the motor test passes, because motors and encoders are exchanged or reversed together."""
    assert rehearsal_of(scenario, rungs, None, *faults).run_until_armed(0.6).stage == Stage.ARMED


def test_small_motions_show_no_axis(scenario, rungs, monkeypatch):
    session, _, axes = shown(scenario, rungs, monkeypatch, mm=4.9, seconds=3.0)
    assert (session.stage, axes) == (Stage.DISARMED, [1])
    session.arm(session.now)
    assert session.stage == Stage.DISARMED
    assert session.log[-1].cause == "move axis 1 by 5 mm or more in its + direction"


@pytest.mark.parametrize("direction", [1, -1])
@pytest.mark.parametrize("lever", [1.0, 0.02])
def test_one_axis_shows_its_direction(direction, lever):
    """A knob held at 20 mm must turn by 5 mm / 20 mm = 0.25 rad."""
    T, q, far = 1e-3, 1e-5, 5e-3 / lever
    check = AxisCheck(Units((q,), (1e-3,), (10**9,)), T, lever)
    counts = [round(direction * min(1.0, max(0, k - 600) / 300) * 1.01 * far / q) for k in range(1000)]
    answers = [check.note((n,)) for n in counts]
    first = next((k for k, n in enumerate(counts) if abs(n) * q >= far), None)
    if direction > 0:
        assert not any(answers)
        assert check.request is None
    else:
        assert re.match("axis 1 moved by -.*, not in", answers[first])
        assert not any(answers[:first])
