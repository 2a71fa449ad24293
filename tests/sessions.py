"""Sessions in virtual time, for the tests of hw/."""

from haptic_loop.hw.emulator import Emulator, FaultInjection
from haptic_loop.hw.limits import SafetyLimits
from haptic_loop.hw.monitor import LinkSettings
from haptic_loop.hw.rehearsal import Rehearsal
from haptic_loop.hw.session import Session

FAST = LinkSettings(measure=100)
AT_REST = LinkSettings(measure=100, test_encoders=False)  # nothing moves the handles before the person does


def session_with(scenario, settings=FAST):
    return Session(scenario, SafetyLimits(tuple(d.force_limit for d in scenario.device)), settings)


def rehearsal_of(scenario, rungs, *faults, recorder=None, settings=FAST, **options):
    """Return a rehearsal with the certified couplings `rungs`, and faults written as for --fault."""
    faults = tuple(map(FaultInjection.parse, faults))
    session = session_with(scenario, settings)
    if recorder is not None:
        session.record = recorder
    return Rehearsal(session, Emulator(scenario, faults), lambda ages: rungs, faults, **options)
