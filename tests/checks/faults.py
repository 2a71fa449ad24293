"""Rehearse faults of a link, a device, a controller or a person in virtual time; `make validate` rehearses all.

Each case runs a whole session of bridge and emulated device. It states a fault, the stage at the end, and the time
allowed. In every tick the device sends positions in a STATE frame, and the host answers with forces in a FORCE frame.
The time to zero force counts from _WHEN, when most faults begin, to the first tick after which no motor has a force.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from haptic_loop.hw.control import CertifiedCoupling, CouplingRequest, certified_couplings
from haptic_loop.hw.emulator import Emulator, FaultInjection, info_of, nobody
from haptic_loop.hw.limits import ENDED, Stage
from haptic_loop.hw.monitor import Ages, LinkSettings
from haptic_loop.hw.protocol import Info
from haptic_loop.hw.rehearsal import Plan, Rehearsal
from haptic_loop.hw.session import FREE_SPEED, STRONGEST, USUAL_CAP, Said, Session, session_for
from haptic_loop.models.human import Voluntary
from haptic_loop.sim.scenario import Scenario, load
from tests.causes import cause_of
from tests.sessions import MovesAxes, inject_faults

_WHEN = 0.6336  # [s] from arming to the fault: the gain is 1 after 0.52 s, the person moves after 0.49 s
LATE = 0.595  # [s] from arming to a time before most faults
_LASTS = 0.9336  # [s] from arming to the end of a case
_T_MS = 1.2
_ROOT = Path(__file__).parents[2]
_AMPLITUDE = 3e-3  # [m] motion of people at devices with little damping; their forces rarely reach the default cap

#: bounds on the time to zero force [ms]; those in ticks include one for the sampling of the fault
_AT_ONCE = 2 * _T_MS  # an e-stop acts at the next tick; a session that ended before _WHEN has zero force at _WHEN
_STOP = 8 * _T_MS  # the frame that shows the fault, the STOP, 5 ticks of ramp
_WATCHDOG = 12 * _T_MS  # theta, 4 ticks with a held force, 5 of ramp, one to notice
_TESTED = 2 * (12.0 + 120.0)  # the final test: per motor 12 ms at rest and a block of 120 ms
_DEAD = 300.0  # the fault is found only after a force has changed by more than 1 N
_SILENCE = 6.0 + 1.0 + 8 * _T_MS  # the host's time-out, checked every millisecond, then a STOP

_Call = Callable[[Session, int], Said]


@dataclass(frozen=True)
class Fault:
    """A fault, and how its session must end."""

    name: str
    stage: Stage
    cause: str = ""  # a regular expression to find in `cause_of(session.cause)`
    faults: tuple[str, ...] = ()
    within: float | None = None  # [ms] from _WHEN to zero force; None: not measured
    action: _Call | None = None  # the action of a person or of a faulty controller
    acts: float = _WHEN  # [s] from arming to the action
    host_stall: float = 0.0  # [s] time for which the host freezes from _WHEN
    info: Callable[[Info], Info] | None = None  # changes the INFO of the device
    baud: int | None = None
    continuous: tuple[float, ...] = ()  # [N] forces that the motors can hold for ever
    coupling: str | None = None
    designed: bool = False  # the coupling is designed for the measured delay, not beforehand
    counted: tuple[str, ...] = ()  # counters that must not be zero
    first_tick: int = 0
    free: bool = False  # nobody holds the handles, and the session knows it
    shown: bool = False  # a person moves each axis in its + direction before arming
    deadman: bool = False  # forces act only while the dead-man switch at the device is held
    period: float = 1.0  # [T] duration of a tick by the device's clock
    lasts: float = _LASTS  # [s] from arming to the end of the case


def _spoiled(force: float | None) -> _Call:
    """Return an action after which the controller returns `force` [N], or raises if `force` is None."""

    def call(session: Session, now: int) -> Said:
        def step(x: Sequence[float]) -> Sequence[float]:
            if force is None:
                raise ZeroDivisionError("division by zero")
            return [force] * len(x)

        assert session.drive is not None
        session.drive.controller.step = step
        return ()

    return call


def person(what: str) -> _Call:
    """Return the action of a person: stop or estop."""
    return lambda session, now: getattr(session, what)("asked to", now)


def at(text: str) -> tuple[str, ...]:
    """Return the faults in `text`, which begin at _WHEN."""
    return tuple(f"{part}@{_WHEN}" for part in text.split())


def _signed(
    name: str, kind: str, value: float, cause: str, within: float | None, when: str = f"@{_WHEN}", **more: Any
) -> list[Fault]:
    """Return one case for each axis and each sign of `value`."""
    cases = []
    for axis in (1, 2):
        for sign in ("", "-"):
            fault = f"axis{axis}:{kind}={sign}{value}{when}"
            words = cause.format(axis=axis, sign=sign)
            cases.append(Fault(name.format(f"{sign}{value}", axis), Stage.STOPPED, words, (fault,), within, **more))
    return cases


G, A = Stage, Stage.ARMED
#: 120 ms for one more block of the final test, as one block alone does not show that a motion is too small
_ENDED: dict[str, Any] = {"action": person("stop"), "within": 2 * (100.0 + _TESTED) + 120.0, "lasts": 1.8}
_UNFOUND: dict[str, Any] = {"action": person("stop"), "acts": 0.9, "lasts": 1.9}
_LATE = at("down:jitter=0.0007")
CASES = (
    Fault("nothing", A),
    Fault("ticks wrap around", A, first_tick=65000),
    # mild faults of the line
    Fault("5 % of STATEs lost", A, faults=at("up:drop=0.05"), counted=("gaps", "misses")),
    Fault("5 % of FORCEs lost", A, faults=at("down:drop=0.05"), counted=("misses",)),
    Fault("bits of STATEs flipped", A, faults=at("up:flip=0.05"), counted=("gaps", "host_errors")),
    Fault("bits of FORCEs flipped", A, faults=at("down:flip=0.05"), counted=("misses", "device_errors")),
    Fault("STATEs cut short", A, faults=at("up:truncate=0.03"), counted=("gaps", "host_errors")),
    Fault("FORCEs cut short", A, faults=at("down:truncate=0.03"), counted=("misses", "device_errors")),
    Fault("a little garbage", A, faults=at("garbage=0.03"), counted=("gaps", "host_errors", "device_errors")),
    Fault("STATEs twice", A, faults=at("up:duplicate=0.3"), counted=("duplicates",)),
    Fault("FORCEs twice", A, faults=at("down:duplicate=0.3")),
    Fault("STATEs out of order", A, faults=at("up:reorder=0.03"), counted=("stale", "gaps")),
    Fault("FORCEs out of order", A, faults=at("down:reorder=0.03"), counted=("late", "misses")),
    Fault("0.5 ms later both ways", A, faults=at("delay=0.0005")),
    Fault("device freezes for 4 ms", A, faults=at("stall=0.004")),
    Fault("host freezes for 4 ms", A, host_stall=0.004, counted=("misses",)),
    Fault("handshake over a bad line", A, faults=("drop=0.04", "flip=0.01"), counted=("gaps",)),
    # severe faults of the line
    Fault("no STATE arrives", G.LOST, "silence:", at("up:drop=1"), _SILENCE),
    Fault("no FORCE arrives", G.STOPPED, "watchdog:", at("down:drop=1"), _WATCHDOG),
    Fault("nothing arrives", G.LOST, "silence:", at("drop=1"), _WATCHDOG),
    Fault("every STATE damaged", G.LOST, "silence:", at("up:flip=1"), _SILENCE),
    Fault("every FORCE damaged", G.STOPPED, "watchdog:", at("down:flip=1"), _WATCHDOG),
    Fault("every frame cut short", G.LOST, "silence:", at("truncate=1"), _WATCHDOG),
    Fault("noise all the time", G.LOST, "silence:", at("up:garbage=60"), _SILENCE),
    Fault("noise at the device", G.STOPPED, "watchdog:", at("down:garbage=60"), _WATCHDOG),
    Fault("40 % of FORCEs lost", G.STOPPED, "missed answers:|watchdog:", at("down:drop=0.4"), 300.0),
    Fault("2 ms later both ways", G.STOPPED, "watchdog:", at("delay=0.002"), _WATCHDOG + 4.0),
    Fault("host freezes for 20 ms", G.STOPPED, "watchdog:", within=_WATCHDOG, host_stall=0.02),
    Fault("cable pulled", G.LOST, "port is gone", at("unplug"), _WATCHDOG),
    # the delay
    Fault("answers get late", G.DISARMED, "theta = 2", _LATE, 500.0, designed=True, counted=("late",), lasts=1.4),
    Fault("late, no softer coupling left", G.STOPPED, "late answers:", _LATE, 500.0, counted=("late",), lasts=1.4),
    Fault("a slow link from the start", A, faults=("delay=0.004",), designed=True),
    Fault("answers in bursts, every 3 ms", A, faults=("down:burst=0.003",), designed=True),
    Fault("STATEs in bursts, every 3 ms", A, faults=("up:burst=0.003",), designed=True),
    Fault("a link too slow", G.REFUSED, "at most theta = 15", ("delay=0.012",), designed=True),
    Fault("a coupling not certified", G.REFUSED, "published is not certified", coupling="published", designed=True),
    Fault("no coupling", G.REFUSED, "without coupling is not certified", coupling="none", designed=True),
    # while the gain rises
    Fault(
        "answers late in ramp-in",
        G.DISARMED,
        "theta = 2",
        ("down:jitter=0.0007@0.28",),
        _AT_ONCE,
        designed=True,
    ),
    Fault("no FORCE in ramp-in", G.STOPPED, "watchdog:", ("down:drop=1@0.3",), _AT_ONCE),
    Fault("many FORCEs lost in ramp-in", G.STOPPED, "missed answers:|watchdog:", ("down:drop=0.4@0.28",), _AT_ONCE),
    Fault("tick number leaps in ramp-in", G.STOPPED, "tick leap: 301 5", ("leap=300@0.29",), _AT_ONCE),
    # the measurement
    Fault("a third of FORCEs lost from the start", G.REFUSED, "answers that never reached:", ("down:drop=0.33",)),
    Fault(
        "3 % lost from the start", G.REFUSED, "answers that never arrived: .* 99$", ("down:drop=0.03",), designed=True
    ),
    # the device
    Fault("tick number leaps by 300", G.STOPPED, "tick leap: 301", at("leap=300"), _STOP),
    Fault("tick number leaps by 3", G.STOPPED, "device clock:", at("leap=3"), _STOP),
    *_signed(
        "an uncommanded force of {} N on axis {}",
        "own",
        2,
        "force unlike the command: .* 5$",
        _STOP + 6 * _T_MS,
    ),
    Fault("an uncommanded force in ramp-in", G.STOPPED, "force unlike the command:", ("own=2@0.3",), _AT_ONCE),
    Fault("every tick lasts twice as long", G.STOPPED, "device clock:", at("period=2"), 2 * _STOP + 6 * _T_MS),
    Fault("clock drifts by 2 %", G.STOPPED, "device clock: 12.. ", at("period=1.02"), 250.0),
    Fault("clock drifts by 0.5 %", A, faults=at("period=1.005")),
    Fault("device freezes for 20 ms", G.LOST, "silence:", at("stall=0.02"), 20.0 + _WATCHDOG),
    Fault("device resets", G.LOST, "silence:", at("reset"), _AT_ONCE),
    Fault("encoder jumps by 0.05 mm", A, faults=at("jump=0.05")),
    *_signed("jump of {} mm, encoder {}", "jump", 5, "(jump|jolt): {axis} ", _STOP),
    *_signed("jump of {} mm, encoder {}", "jump", 0.2, "(jump|jolt): {axis} ", _STOP + _T_MS),
    *_signed("shaking by {} mm, encoder {}", "shake", 0.5, "(jump|jolt): {axis} ", _STOP + 2 * _T_MS),
    *(
        Fault(f"encoder {axis} {what}", G.STOPPED, f"(jump|jolt): {axis} ", (f"axis{axis}:{fault}@0.48",), lasts=2.2)
        for axis in (1, 2)
        for what, fault in (("wraps every 2 mm", "wrap=2"), ("has a stuck bit of 0.26 mm", "bit=8"))
    ),
    *_signed(
        "drift by {} m/s, below the speed limit, encoder {}", "drift", 0.69, "speed: {axis} 0.7|range: {axis} ", None
    ),
    *_signed("drift by {} m/s, encoder {}", "drift", 1.5, "speed: {axis} ", _STOP + 12 * _T_MS),
    *_signed("offset of {} mm, out of the range of encoder {}", "jump", 200, r"range: {axis} {sign}\d", None, ""),
    Fault("encoder dead before arming", G.STOPPED, "dead encoder: 1 0 ", ("freeze",), _AT_ONCE),
    Fault("encoder 2 dead before arming", G.STOPPED, "dead encoder: 2 0 ", ("axis2:freeze",), _STOP),
    Fault("one channel of encoder 1 dead before arming", G.STOPPED, "(dead|still) encoder: 1 ", ("toggle",), _AT_ONCE),
    Fault("a channel of encoder 2 dead before arming", G.STOPPED, "(dead|still) encoder: 2 ", ("axis2:toggle",), _STOP),
    Fault("encoder dies", G.STOPPED, "(dead|still) encoder: 1 ", at("freeze"), _DEAD),
    Fault("encoder 2 dies", G.STOPPED, "(dead|still) encoder: 2 ", at("axis2:freeze"), _DEAD),
    Fault("both encoders die", G.STOPPED, "still encoder:", at("freeze axis2:freeze"), _DEAD, lasts=1.7),
    Fault("a channel of encoder 1 dies", G.STOPPED, "(dead|still) encoder: 1 ", at("toggle"), _DEAD),
    Fault("a channel of encoder 2 dies", G.STOPPED, "(dead|still) encoder: 2 ", at("axis2:toggle"), _DEAD),
    *_signed(
        "saturated at {} mm, encoder {}",
        "saturate",
        4,
        "still encoder: {axis} ",
        None,
        "@0.48",
        lasts=2.2,
    ),
    # faults that the test at arming must find
    *(
        Fault(f"{what} of axis {axis} before arming", G.STOPPED, cause.format(axis), (f"axis{axis}:{fault}",), _AT_ONCE)
        for axis in (1, 2)
        for what, fault, cause in (
            ("reversed encoder", "reverse", "wrong sign: {}"),
            ("reversed motor", "motor=-1", "wrong sign: {}"),
            ("encoder scale 2.5", "scale=2.5", "wrong scale: {} 2.5 "),
            ("encoder scale 0.4", "scale=0.4", r"wrong scale: {} 0\.(4|39) "),
            ("dead motor", "motor=0", "(dead encoder|held at arming): {} "),
        )
    ),
    *(
        Fault(
            f"{what} of axis {axis}, a hand moves before arming",
            G.STOPPED,
            cause,
            (f"axis{axis}:{fault}", drift),
            _AT_ONCE,
        )
        for axis in (1, 2)
        for drift in (f"axis{axis}:drift=0.05@0",)
        for what, fault, cause in (
            ("reversed encoder", "reverse", "wrong sign:"),
            ("dead motor", "motor=0", "dead encoder:|held at arming:"),
        )
    ),
    # faults that the test at the end must find
    *(
        Fault(f"{what} of axis {axis}, then the end", G.STOPPED, cause, (f"axis{axis}:{fault}@0.6",), **_ENDED)
        for axis in (1, 2)
        for what, fault, cause in (
            ("dead motor", "motor=0", "no answer at the end:"),
            ("reversed motor", "motor=-1", "wrong sign:|speed:|(dead|still) encoder:|no answer at the end:|clipped"),
        )
    ),
    *(
        Fault(f"{what} of axis {axis}, free, then the end", G.STOPPED, cause, (fault,), free=True, **_ENDED)
        for axis in (1, 2)
        for what, kind in (("encoder scale 0.4", "scale"), ("motor 0.4 times as strong", "motor"))
        for fault, cause in ((f"axis{axis}:{kind}=0.4@0.6", f"(wrong scale|weaker motor): {axis} 0.4"),)
    ),
    *(
        Fault(f"motor {axis} {what}, then the end", G.STOPPED, cause, (f"axis{axis}:{fault}",), free=True, **_ENDED)
        for axis in (1, 2)
        for what, fault, cause in (
            ("saturates at 0.6 N before arming", "limit=0.6", f"(wrong scale|weaker motor): {axis} 0."),
            ("saturates at 0.6 N", "limit=0.6@0.6", f"(wrong scale|weaker motor): {axis} 0."),
            ("is 0.6 times as strong", "motor=0.6@0.6", f"weaker motor: {axis} 0.6"),
            ("makes 0.15 of negative forces", "oneway=0.15@0.6", f"one-sided (motor|encoder): {axis}"),
            ("makes half of negative forces", "oneway=0.5@0.6", f"one-sided motor: {axis}"),
        )
    ),
    *(
        Fault(
            f"motor {axis} makes {share} times negative forces before arming{', free' * free}",
            G.STOPPED,
            f"one-sided (motor|encoder): {axis}",
            (f"axis{axis}:oneway={share}",),
            _AT_ONCE,
            free=free,
        )
        for axis, free in ((1, False), (1, True), (2, True))
        for share in (0, 0.15)
    ),
    *(
        Fault(
            f"{what} of axis {axis} before arming, free",
            G.STOPPED,
            cause,
            (f"axis{axis}:{fault}",),
            _AT_ONCE,
            free=True,
        )
        for axis in (1, 2)
        for what, fault, cause in (
            ("half of negative forces", "oneway=0.5", f"one-sided motor: {axis}"),
            ("dead zone of 0.1 N", "zone=0.1", f"dead zone: {axis} 0."),
            ("dead zone of 0.3 N", "zone=0.3", f"dead zone: {axis} 0."),
            ("half of negative counts", "lose=0.5", f"one-sided encoder: {axis}"),
            ("negative counts doubled", "lose=2", f"one-sided encoder: {axis}"),
        )
    ),
    *(
        Fault(f"half of negative counts of axis {axis}, then the end", G.STOPPED, cause, (fault,), free=True, **_ENDED)
        for axis in (1, 2)
        for fault, cause in ((f"axis{axis}:lose=0.5@0.6", f"one-sided encoder: {axis}"),)
    ),
    # faults that nothing finds (docs/hardware.md)
    *(
        Fault(f"{what} of axis {axis}", G.FINISHED, "asked to", faults, **_UNFOUND)
        for axis in (1, 2)
        for what, faults in (
            ("dead motor for 0.2 s", (f"axis{axis}:motor=0@0.6", f"axis{axis}:motor=1@0.8")),
            ("reversed motor for 0.2 s", (f"axis{axis}:motor=-1@0.6", f"axis{axis}:motor=1@0.8")),
            ("three quarters of negative forces", (f"axis{axis}:oneway=0.75",)),
            ("0.8 of negative counts", (f"axis{axis}:lose=0.8",)),
            ("dead zone of 0.05 N", (f"axis{axis}:zone=0.05",)),
        )
    ),
    *(
        Fault(f"motor 2 adds {part} of motor 1's force", G.FINISHED, "", (f"cross={part}",), **_UNFOUND)
        for part in (0.2, -0.2)
    ),
    # more faults that are found, most of them at arming; encoder noise is no fault
    *(
        Fault(
            f"encoder {axis} is read {n} ticks late before arming",
            G.STOPPED,
            cause,
            (f"axis{axis}:late={n}",),
            _AT_ONCE,
            free=True,
        )
        for axis in (1, 2)
        for n, cause in ((1, f"late axis: {axis} 1.0$"), (2, f"late axis: {axis}"))
    ),
    *(
        Fault(f"motor 2 adds {part} of motor 1's force", G.STOPPED, "connected axes: 1 2", (f"cross={part}",), _AT_ONCE)
        for part in (1.0, 0.5, -1.0)
    ),
    Fault("axes moved by hand", A, free=True, shown=True),
    Fault("axes 1 and 2 exchanged", G.REFUSED, "moved another axis: 2 .* 1$", ("exchange",), free=True, shown=True),
    *(
        Fault(
            f"motor and encoder of axis {i} reversed",
            G.REFUSED,
            f"moved backwards: {i} -",
            (f"axis{i}:motor=-1", f"axis{i}:reverse"),
            free=True,
            shown=True,
        )
        for i in (1, 2)
    ),
    Fault("axes swapped before arming", G.STOPPED, "swapped axes: 1 2", ("swap",), _AT_ONCE),
    Fault(
        "axes swapped and reversed before arming",
        G.STOPPED,
        "swapped axes: 1 2",
        ("swap", "reverse", "axis2:reverse"),
        _AT_ONCE,
    ),
    *(
        Fault(
            f"{what} of axis {axis} before arming, free",
            G.STOPPED,
            cause.format(axis),
            (f"axis{axis}:{fault}",),
            _AT_ONCE,
            free=True,
        )
        for axis in (1, 2)
        for what, fault, cause in (
            ("reversed encoder", "reverse", "wrong sign: {}"),
            ("encoder scale 2.5", "scale=2.5", "wrong scale: {} 2"),
            ("encoder scale 0.4", "scale=0.4", "wrong scale: {} 0"),
            ("motor 2.5 times as strong", "motor=2.5", "wrong scale: {} 2"),
            ("motor 0.4 times as strong", "motor=0.4", "wrong scale: {} 0"),
        )
    ),
    *(
        Fault(f"encoder noise of {counts} counts, axis {axis}", A, faults=(f"axis{axis}:noise={counts}",))
        for axis in (1, 2)
        for counts in (0.3, 0.5, 1.0)
    ),
    Fault(
        "dead encoder with noise before arming",
        G.STOPPED,
        "(dead|still) encoder: 1 ",
        ("freeze", "noise=0.5"),
        _AT_ONCE,
    ),
    Fault(
        "encoder with noise dies",
        G.STOPPED,
        "(dead|still) encoder: 1 |still handle: 1 ",
        ("noise=0.5", *at("freeze noise=0.5")),
        _DEAD,
    ),
    Fault("e-stop at the device", G.ESTOP, "estop_device", at("estop"), _AT_ONCE),
    Fault("e-stop at the device before arming", G.REFUSED, "refuses the configuration: estop", ("estop",)),
    Fault("motor 1 gets hot", G.STOPPED, "heat: 1 ", within=1500.0, continuous=(0.2, 12.0), lasts=2.7),
    Fault("motor 2 gets hot", G.STOPPED, "heat: 2 ", within=1500.0, continuous=(12.0, 0.2), lasts=2.7),
    Fault("firmware finds a fault", G.STOPPED, "device fault:", at("trip"), _STOP),
    Fault("device clock runs 5 % fast", G.REFUSED, "device clock:", period=1.05),
    # the controller
    Fault("controller asks for nan", G.STOPPED, "no force: nan nan", within=_STOP, action=_spoiled(np.nan)),
    Fault("controller asks for inf", G.STOPPED, "no force: inf inf", within=_STOP, action=_spoiled(np.inf)),
    Fault("controller raises", G.STOPPED, "ZeroDivisionError", within=_STOP, action=_spoiled(None)),
    Fault("controller asks for -inf", G.STOPPED, "no force: -inf -inf", within=_STOP, action=_spoiled(-np.inf)),
    Fault("controller asks for 100 N", A, action=_spoiled(100.0), counted=("clipped", "slowed"), lasts=0.6636),
    Fault("controller asks for -100 N", A, action=_spoiled(-100.0), counted=("clipped", "slowed"), lasts=0.6636),
    # people
    Fault("planned stop", G.FINISHED, "asked to", within=100.0 + _TESTED + _STOP, action=person("stop"), lasts=1.2),
    Fault("deadman let go", G.STOPPED, "device deadman:", at("letgo"), 100.0 + _STOP, deadman=True),
    Fault("e-stop at the host", G.ESTOP, "asked to", within=_AT_ONCE, action=person("estop")),
    # the handshake
    Fault("an older protocol", G.REFUSED, "version 1 .*give it the firmware", info=lambda i: i._replace(version=1)),
    Fault("a newer protocol", G.REFUSED, "version 3 of the protocol", info=lambda i: i._replace(version=3)),
    Fault(
        "one axis",
        G.REFUSED,
        "1 axis, the scenario 2",
        info=lambda i: i._replace(**{n: getattr(i, n)[:1] for n in i._fields[4:]}),
    ),
    Fault("another period", G.REFUSED, "every 1000000 ns", info=lambda i: i._replace(period_ns=1_000_000)),
    Fault("a weak motor", G.REFUSED, "can apply 6 N", info=lambda i: i._replace(hard_limit=(30000, 15000))),
    Fault("little damping", G.REFUSED, "guarantees 1 N s/m", info=lambda i: i._replace(osp_damping=(10**6, 10**6))),
    Fault(
        "coarse motors",
        G.REFUSED,
        "force step of axis 1 is 3 N, at most 0.75 N",
        info=lambda i: i._replace(force_step=(3_000_000,) * 2, hard_limit=(4, 4)),
    ),
    Fault(
        "coarse encoders",
        G.REFUSED,
        "count of axis 1 is 0.5 mm, at most 0.3 mm",
        info=lambda i: i._replace(encoder_step=(500_000_000,) * 2, range=(200, 200)),
    ),
    Fault("115200 baud", G.REFUSED, "4167 us, more than T = 1200 us", baud=115200),
    Fault("921600 baud", A, baud=921600),
    Fault("nobody there", G.LOST, "no answer:", ("up:drop=1",)),
)


#: scenario -> faulty axis; its default force cap is below 1.3 N, because its devices have little damping
_WEAK = {"examples/hapkit.toml": 1, "three-rigid": 2}


def _weak_cases(scenario: str, axis: int) -> list[Fault]:
    """Return faults of a device with little damping, for a session with the default force cap."""
    end: dict[str, Any] = {"action": person("stop"), "acts": 1.4, "lasts": 8.0}
    short: dict[str, Any] = {"lasts": 1.4}
    dies, a = {"lasts": 2.4}, f"axis{axis}"
    rows: list[tuple[str, Stage, str, str, dict[str, Any]]] = [
        ("nothing", G.FINISHED, "asked to", "", end),
        ("no STATE arrives", G.LOST, "silence:", "up:drop=1@1", {}),
        ("no FORCE arrives", G.STOPPED, "watchdog:", "down:drop=1@1", {}),
        ("cable pulled", G.LOST, "port is gone", "unplug@1", {}),
        ("e-stop at the device", G.ESTOP, "estop_device", "estop@1", {}),
        ("deadman let go", G.STOPPED, "device deadman:", "letgo@1", {"deadman": True}),
        ("an uncommanded force of 0.5 N", G.STOPPED, "force unlike the command:", f"{a}:own=0.5@1", {}),
        ("an uncommanded force of -0.5 N", G.STOPPED, "force unlike the command:", f"{a}:own=-0.5@1", {}),
        ("encoder drifts by 0.69 m/s", G.STOPPED, "speed:|range:", f"{a}:drift=0.69@1", {}),
        ("encoder drifts by -1.5 m/s", G.STOPPED, "speed:", f"{a}:drift=-1.5@1", {}),
        ("encoder jumps by 5 mm", G.STOPPED, "jump:|jolt:", f"{a}:jump=5@1", {}),
        ("reversed encoder before arming", G.STOPPED, "wrong sign:", f"{a}:reverse", {}),
        ("reversed motor before arming", G.STOPPED, "wrong sign:", f"{a}:motor=-1", {}),
        ("dead motor before arming", G.STOPPED, "dead encoder:|held at arming:", f"{a}:motor=0", {}),
        ("dead encoder before arming", G.STOPPED, "dead encoder:", f"{a}:freeze", {}),
        ("encoder scale 2.5 before arming", G.STOPPED, "wrong scale:", f"{a}:scale=2.5", {}),
        ("encoder scale 0.4 before arming", G.STOPPED, "wrong scale:", f"{a}:scale=0.4", {}),
        ("motor 2.5 times as strong before arming", G.STOPPED, "wrong scale:", f"{a}:motor=2.5", {"free": True}),
        ("motor 0.4 times as strong before arming", G.STOPPED, "wrong scale:", f"{a}:motor=0.4", {"free": True}),
        ("half of negative forces before arming", G.STOPPED, "one-sided motor:", f"{a}:oneway=0.5", {"free": True}),
        ("half of negative counts before arming", G.STOPPED, "one-sided encoder:", f"{a}:lose=0.5", {"free": True}),
        ("dead zone of 0.1 N before arming", G.STOPPED, "dead zone:|wrong scale:", f"{a}:zone=0.1", {"free": True}),
        ("encoder is read 2 ticks late before arming", G.STOPPED, "late axis:", f"{a}:late=2", {"free": True}),
        ("encoder dies", G.STOPPED, "(dead|still) (encoder|handle):", f"{a}:freeze@1", dies),
        ("motor dies, then the end", G.STOPPED, "no answer at the end:", f"{a}:motor=0@1", end),
        ("reversed motor, then the end", G.STOPPED, "", f"{a}:motor=-1@1", end),
        ("encoder scale 0.4, then the end", G.STOPPED, "", f"{a}:scale=0.4@1", end | {"free": True}),
        ("motor 0.4 times as strong, then the end", G.STOPPED, "", f"{a}:motor=0.4@1", end | {"free": True}),
        ("motor saturates at 0.3 N, then the end", G.STOPPED, "", f"{a}:limit=0.3@1", end | {"free": True}),
    ]
    return [
        Fault(f"{Path(scenario).stem}: {name}", stage, cause, (fault,) * bool(fault), **short | more)
        for name, stage, cause, fault, more in rows
    ]


_MEASURED = 100  # number of answers whose age is measured; the delay does not vary


@dataclass(frozen=True)
class _FaultOutcome:
    """The outcome of a case."""

    fault: str
    stage: str
    cause: str
    peak_force_n: float  # of any motor
    peak_speed: float  # [m/s] of any motor or handle
    free_speed: float  # [m/s] of any motor or handle if nobody holds the faulty device, under the default force cap
    zero_force_ms: float | None  # from _WHEN on; None: not measured, or never
    allowed_ms: float | None
    wrong: tuple[str, ...]  # empty if all went as required

    @property
    def holds(self) -> bool:
        return not self.wrong


def rehearse_faults() -> list[_FaultOutcome]:
    """Run every case with lively people, and once more without a hand at the faulty device.

    The default scenario has its own force limits in the first run, and the default force cap as limits of its motors in
    the second run. The scenarios of _WEAK have the default force cap of a session in both runs.
    """
    scenario = _lively(load())
    limits = [msgspec.structs.replace(d, force_limit=USUAL_CAP) for d in scenario.device]
    runs: list[tuple[Scenario, Scenario, float | None, Sequence[Fault]]] = [
        (scenario, scenario.replace(device=tuple(limits)), STRONGEST, CASES)
    ]
    for name, axis in _WEAK.items():
        weak = load(str(_ROOT / name) if name.endswith(".toml") else name)
        weak = _lively(weak.replace(human=load().human[:1] * len(weak.device)), _AMPLITUDE)
        runs.append((weak, weak, None, _weak_cases(name, axis)))
    outcomes = []
    for held, free, cap, cases in runs:
        couplings = [certified_couplings(CouplingRequest(each), 1, spare=1) for each in (held, free)]
        for case in cases:
            outcome = _rehearse_case(case, held, couplings[0], cap=cap)[1]
            fastest = _rehearse_case(case, free, couplings[1], free=True, cap=cap)[1].peak_speed
            wrong = (*outcome.wrong, *[f"a free handle at {fastest:.2f} m/s"] * (fastest > FREE_SPEED))
            outcomes.append(replace(outcome, free_speed=fastest, wrong=wrong))
    return outcomes


def _lively(scenario: Scenario, most: float = 1.0) -> Scenario:
    """Let people move by at most `most` [m] soon after arming, so that forces act when a fault begins."""

    def soon(motion: Voluntary) -> Voluntary:
        return msgspec.structs.replace(motion, ease=0.1, phase=0.8, amplitude=min(motion.amplitude, most))

    people = [msgspec.structs.replace(h, voluntary=h.voluntary and soon(h.voluntary)) for h in scenario.human]
    return scenario.replace(human=tuple(people))


def _without_hand(scenario: Scenario, case: Fault) -> Scenario:
    """Return the scenario without a hand at the faulty device."""
    faulty = 1 if any("axis2:" in fault for fault in case.faults) else 0
    hands = list(scenario.human)
    hands[faulty] = nobody(scenario).human[faulty]
    return scenario.replace(human=tuple(hands))


def _rehearse_case(
    case: Fault,
    scenario: Scenario,
    couplings: tuple[CertifiedCoupling, ...],
    free: bool = False,
    cap: float | None = STRONGEST,
) -> tuple[Rehearsal, _FaultOutcome]:
    """Run one case; with `free` nobody holds the faulty device. `couplings` are for a delay of one tick.

    `cap` is the force cap [N] of the session; None for the default.
    """
    rehearsal = _prepared(case, scenario, couplings, free, cap)
    return rehearsal, _rehearsed(case, rehearsal)


def begins_late(case: Fault) -> bool:
    """Return whether a case equals `CASES[0]` until LATE; its handles may be free."""
    late = replace(case, name=CASES[0].name, stage=A, cause="", faults=(), within=None, action=None, counted=())
    same = replace(late, acts=_WHEN, host_stall=0.0, lasts=_LASTS, free=False) == CASES[0]
    return same and all((FaultInjection.parse(text).start or 0.0) > LATE for text in case.faults)


def rehearse_late_case(case: Fault, rehearsal: Rehearsal) -> _FaultOutcome:
    """Continue a rehearsal of `CASES[0]`, which has reached LATE, with the fault of a case that `begins_late`."""
    inject_faults(rehearsal, *case.faults)
    rehearsal.actions = _actions(case, rehearsal)
    return _rehearsed(case, rehearsal)


def _prepared(
    case: Fault,
    scenario: Scenario,
    couplings: tuple[CertifiedCoupling, ...],
    free: bool = False,
    cap: float | None = STRONGEST,
) -> Rehearsal:
    """Return the rehearsal of a case before its first tick."""
    info = info_of(scenario)
    scenario = _without_hand(scenario, case) if free and not case.free else scenario
    most = [d.force_limit for d in scenario.device]
    session = session_for(
        scenario,
        LinkSettings(case.baud, _MEASURED, deadman=case.deadman, held=not case.free, check_axes=case.shown),
        cap,
        continuous=tuple(map(min, case.continuous, most)),
        thermal=1.0,
    )
    faults = tuple(FaultInjection.parse(text) for text in case.faults)
    emulator = Emulator(nobody(scenario) if case.free else scenario, faults, case.info(info) if case.info else info)
    emulator.device.k = case.first_tick

    rehearsal = Rehearsal(
        session,
        emulator,
        _plan(case, scenario, couplings),
        faults,
        clock=case.period,
        watch=MovesAxes(emulator) if case.shown else lambda session: None,
    )
    rehearsal.actions = _actions(case, rehearsal)
    return rehearsal


def _actions(case: Fault, rehearsal: Rehearsal) -> list[tuple[float, _Call]]:
    """Return the action of a case with its time [s]; without an action the host freezes for `host_stall`."""

    def frozen(session: Session, now: int) -> Said:
        rehearsal.freeze(case.host_stall)
        return ()

    return [(case.acts, case.action)] if case.action else [(_WHEN, frozen)]


def _rehearsed(case: Fault, rehearsal: Rehearsal) -> _FaultOutcome:
    """Run a case to its end."""
    rehearsal.run_until_armed(case.lasts)
    timed = case.within is not None and rehearsal.armed_us is not None
    to_zero = rehearsal.zero_after(_WHEN) if timed else None
    zero_ms = None if to_zero is None else 1e3 * to_zero
    force = float(np.abs([m.applied for m in rehearsal.moments]).max(initial=0.0))
    wrong, session = tuple(_wrong(case, rehearsal, zero_ms, force)), rehearsal.session
    told = case.name, str(session.stage), session.cause, force, rehearsal.emulator.plant.fastest
    return _FaultOutcome(*told, 0.0, zero_ms, case.within, wrong)


def _plan(case: Fault, scenario: Scenario, couplings: tuple[CertifiedCoupling, ...]) -> Plan:
    def plan(ages: Ages) -> tuple[CertifiedCoupling, ...]:
        if not case.designed:
            return couplings[:1]
        link = ages.link_delay(1e6 * scenario.T, 0.99, 100.0)
        if (link, case.coupling) == (1, None):
            return couplings
        return certified_couplings(CouplingRequest(scenario, name=case.coupling), link, spare=0)

    return plan


def _wrong(case: Fault, rehearsal: Rehearsal, zero_ms: float | None, force: float) -> list[str]:
    """List the requirements that a case violates; `force` [N] is its peak force."""
    session, wrong = rehearsal.session, []
    if session.stage != case.stage:
        wrong.append(f"ended in {session.stage} ({session.cause}), expected {case.stage}")
    if not re.search(case.cause, cause_of(session.cause)):
        wrong.append(f"the cause is {session.cause!r}, expected {case.cause!r}")
    if case.within is not None and (zero_ms is None or zero_ms > case.within):
        wrong.append(f"zero force after {zero_ms} ms, allowed are {case.within:g} ms")
    for name in case.counted:
        if not getattr(session.counters, name):
            wrong.append(f"nothing counted as {name}")
    if session.stage != Stage.ARMED and np.any(rehearsal.moments[-1].applied):
        wrong.append("a motor still has a force")
    cap = max(session.limits.cap)
    if force > cap:
        wrong.append(f"a motor had more than {cap:g} N")
    if session.stage in ENDED:
        session.arm(session.now + 1)
        if session.stage not in ENDED:
            wrong.append("it could be armed again")
    return wrong


def table() -> int:
    """Print each fault's peak force, peak speeds of held and free handles, time to zero and verdict.

    In names, "free" means that nobody holds the handles, and "then the end" that a person stops the session, which then
    tests all axes. Returns the number of faults that violate a requirement; a free handle above 1 m/s is one, too.
    """
    outcomes = rehearse_faults()
    print(f"{'fault':58s} {'peak N':>7s} {'held m/s':>8s} {'free m/s':>8s} {'ms to 0':>8s}  verdict")
    for one in outcomes:
        zero = "-" if one.zero_force_ms is None else f"{one.zero_force_ms:.1f}"
        print(
            f"{one.fault[:58]:58s} {one.peak_force_n:7.2f} {one.peak_speed:8.2f} {one.free_speed:8.2f} {zero:>8s}  "
            f"{one.stage}{': ' + '; '.join(one.wrong) if one.wrong else ''}"
        )
    wrong, fastest = sum(not one.holds for one in outcomes), max(one.free_speed for one in outcomes)
    finished = ", ".join(one.fault for one in outcomes if one.stage == Stage.FINISHED)
    print(f"{len(outcomes)} faults, {wrong} wrong; free handles at most {fastest:.2f} m/s; finished: {finished}")
    return wrong


if __name__ == "__main__":
    raise SystemExit(table() > 0)
