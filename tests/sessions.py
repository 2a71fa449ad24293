"""Sessions in virtual time, for the tests of hw/."""

import os
import pickle
import re
import warnings

import numpy as np

from haptic_loop.hw.emulator import Emulator, FaultInjection, Line, _EmulatedPlant
from haptic_loop.hw.limits import SafetyLimits
from haptic_loop.hw.monitor import LinkSettings
from haptic_loop.hw.rehearsal import Rehearsal
from haptic_loop.hw.session import Session

FAST = LinkSettings(measure=100)
AT_REST = LinkSettings(measure=100, test_encoders=False)  # nothing moves the handles before the person does


def session_with(scenario, settings=FAST):
    return Session(scenario, SafetyLimits(tuple(d.force_limit for d in scenario.device)), settings)


def rehearsal_of(scenario, couplings, *faults, recorder=None, settings=FAST, **options):
    """Return a rehearsal with these certified couplings, and faults written as for --fault."""
    faults = tuple(map(FaultInjection.parse, faults))
    session = session_with(scenario, settings)
    if recorder is not None:
        session.record = recorder
    return Rehearsal(session, Emulator(scenario, faults), lambda ages: couplings, faults, **options)


def inject_faults(rehearsal, *faults, board=0):
    """Add faults, written as for --fault, to a device and its line, which have had none."""
    faults, cable = tuple(map(FaultInjection.parse, faults)), rehearsal._cables[board]
    cable.emulator._waiting = list(faults)
    cable.up, cable.down = (Line(way, faults, rehearsal.seed, rehearsal.latency_us) for way in ("up", "down"))


def in_fork(call, *arguments):
    """Call in a fork of this process, which changes no object here. Return the result, or raise the exception."""
    read, write = os.pipe()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # warns of forks beside threads; this fork uses none
        child = os.fork()
    if not child:
        try:
            result = call(*arguments), None
        except BaseException as error:
            result = None, error
        try:
            with open(write, "wb") as pipe:
                pickle.dump(result, pipe)
        finally:
            os._exit(0)
    os.close(write)
    with open(read, "rb") as pipe:
        data = pipe.read()
    os.waitpid(child, 0)
    result, error = pickle.loads(data)
    if error is not None:
        raise error
    return result


class RubbingPlant(_EmulatedPlant):
    """An emulated plant whose motors have dry friction of `coulomb` [N], which is updated eight times a tick."""

    def __init__(self, scenario, encoder_step, coulomb):
        super().__init__(scenario, encoder_step)
        self.coulomb = coulomb

    def advance(self, f, share=1.0, begins=True):
        for k in range(8):
            friction = self.coulomb * np.tanh(self.s[self.motors] / 0.002)
            super().advance(f + friction, share / 8, begins and not k)


class RubbingEmulator(Emulator):
    """An emulated device with a RubbingPlant."""

    def __init__(self, scenario, *more, coulomb):
        super().__init__(scenario, *more)
        self.plant = RubbingPlant(scenario, self.plant.encoder_step, coulomb)


class MovesAxes:
    """A person who moves each axis by `mm` when a session asks for it, and lists these axes, from 1, in `axes`.

    After a wrong motion the person goes back, and moves the axis again 0.8 s later.
    """

    def __init__(self, emulator, mm=6.0):
        self.axes, self._emulator, self._mm, self._plan, self._requests = [], emulator, mm, [], set()

    def __call__(self, session):
        request = re.search(r"move axis (\d) by \+5 mm or more", session.request or "")
        if request and session.request not in self._requests:
            self._requests.add(session.request)
            self.axes.append(int(request[1]))
            again = session.request.startswith("axis")  # The request begins with the wrong motion.
            moves = [(0.0, -self._mm), (0.8, self._mm)] if again else [(0.0, self._mm)]
            self._plan += [(session.now + 1e6 * after, mm) for after, mm in moves]
        while self._plan and self._plan[0][0] <= session.now:
            self._emulator.plant.s[self.axes[-1] - 1 : 4 : 2] += 1e-3 * self._plan.pop(0)[1]  # motor and handle
