"""Check in virtual time who arms a live session, and when."""

import pytest

from haptic_loop.hw.driver import Operator
from haptic_loop.hw.emulator import Emulator, FaultInjection
from haptic_loop.hw.limits import SafetyLimits, Stage
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
