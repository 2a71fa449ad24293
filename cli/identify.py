"""python -m hw.identify: measure the damping that a device guarantees, by chirps, a slow swing and a free release.

By default two sittings (sessions) are recorded; with --port, the user moves the handles between them. Nobody may hold a
handle: a hand that damps a handle in one sitting is revealed by the other sitting. With --transmission two sittings
with clamped handles follow, for the bounds of motor mass and transmission that the known-device conditions need.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from haptic_loop.cli import options, render
from haptic_loop.cli.session_cli import (
    add_link_options,
    add_output_options,
    add_person_options,
    boards_behind,
    check_link,
    hold_session,
    steady_scenario,
    with_person,
)
from haptic_loop.controller.units import in_unit
from haptic_loop.design.files import off_table, plain, write
from haptic_loop.hw.emulator import nobody
from haptic_loop.hw.encoders import ELSEWHERE
from haptic_loop.hw.identify import (
    Estimate,
    Excitation,
    Swing,
    capped,
    chirp,
    estimate,
    free_motion,
    held,
    records_of,
    settled,
    unbounded,
)
from haptic_loop.hw.limits import SafetyLimits, Stage, Units
from haptic_loop.hw.monitor import Ages, LinkSettings
from haptic_loop.hw.protocol import SafetyStop
from haptic_loop.hw.recording import Recorder
from haptic_loop.hw.session import STRONGEST, Session, session_for
from haptic_loop.hw.session_report import SessionReport, outcome
from haptic_loop.hw.transmission import TransmissionBounds, transmission_bounds
from haptic_loop.models.device import Device, RigidDevice
from haptic_loop.sim.scenario import InputError, Scenario

# Shares of --force in the two sittings with clamped handles; a difference between these sittings shows backlash.
_LEVELS = 1.0, 0.5
_SHARE = 0.9  # largest motion of a device as declared, as a share of a session's limits
_AVERAGED = 0.01  # [s] over which a session averages a speed before it compares it with its limit
_CLAMPED = 1000.0  # [kg] mass that clamps the handle of an emulated device
#: fields of a device that devices.toml takes from the scenario, the last one only where it is not identified
_DECLARED = "force_limit", "encoder_step", "friction_max", "credible_force", "transmission_damping"


@dataclass(frozen=True, eq=False)
class _Sitting:
    """One session, and the estimates from its record."""

    axes: list[Estimate]  # empty if nothing was estimated
    reason: str | None
    report: SessionReport = off_table("left out")
    session: Session = off_table("left out")
    recorder: Recorder = off_table("left out")
    trace: Path | None = off_table("left out")
    signals: Sequence[int] = off_table("left out")

    @property
    def finished(self) -> bool:
        """Whether the session ended as planned; otherwise the device is not driven again."""
        return self.session.stage == Stage.FINISHED and not self.signals


@dataclass(frozen=True, eq=False)
class _Report:
    """The report of all sittings; `session` is that of the last sitting with free handles."""

    session: SessionReport = off_table("inlined")
    axes: list[Estimate] = off_table()
    sittings: list[_Sitting] = off_table()
    bounded: bool = off_table()
    warnings: list[str] = off_table()
    reason: str | None = off_table("if given")
    transmissions: list[TransmissionBounds] | None = off_table("if given", None)  # one per axis, with --transmission
    no_transmissions: str | None = off_table("if given", None)  # why --transmission gave no bounds

    @property
    def verdict(self) -> str:
        """The bounds of all axes, or why there are none."""
        if not self.bounded:
            return f"No bound of the damping: {self.reason or 'see the warnings'}."
        speed = math.floor(1e2 * min(axis.viscosity.speed for axis in self.axes)) / 1e2
        bounds = ", ".join(f"{_floored(axis.delta, 4)} N s/m on axis {i}" for i, axis in enumerate(self.axes, start=1))
        return f"By these records the damping is at least {bounds}, up to {speed:.2f} m/s."

    def lines(self) -> list[str]:
        told = "" if self.bounded else self.reason or ""  # the verdict has this reason
        refused = [f"no bounds of motor and transmission: {self.no_transmissions}"] if self.no_transmissions else []
        return [*refused, *(f"[yellow]{warning}[/]" for warning in self.warnings if warning not in told)]


def main(argv: list[str]) -> int:
    """Identify every axis. Return 0 if all requested bounds were found, 1 if not, 130 if interrupted."""
    args = _parser().parse_args(argv)
    scenario, settings = steady_scenario(args, "hw.identify"), check_link(args)
    if boards_behind(args, scenario):
        raise InputError(f"--port is {args.port}: identify one board at a time, with a scenario of its device")
    low, high = args.band
    if not 0.5 <= low < high <= 0.4 / scenario.T:
        raise InputError(f"--band is {low:g},{high:g}, expected LOW,HIGH within 0.5 to {0.4 / scenario.T:.0f} Hz")
    settings = replace(with_person(args, settings), identifies=True, held=False)
    _check_motion(args, scenario, _session(args, scenario, settings).limits)
    out, sittings = options.out_folder(args, "identify"), list[_Sitting]()
    while len(sittings) < args.sittings and (not sittings or sittings[-1].finished):
        sittings.append(_sitting(args, scenario, settings, out, len(sittings) + 1))
        settings, last = replace(settings, check_axes=False), sittings[-1].session.link.last
        if args.port and last:
            settings = replace(settings, elsewhere=last.counts)
    report, clamped = _identified(scenario, sittings), list[_Sitting]()
    if args.transmission and report.bounded and sittings[-1].finished:
        settings = replace(settings, elsewhere=None, test_encoders=False)  # no test moves a clamped handle
        for level in _LEVELS:
            clamped.append(_sitting(args, scenario, settings, out, args.sittings + len(clamped) + 1, level))
        report = _with_transmissions(report, scenario, sittings, clamped)
    files = [sitting.trace for sitting in (*sittings, *clamped) if sitting.trace]
    if report.bounded:
        tables, end = list[str](), 0
        for device in scenario.device:
            own, end = slice(end, end + len(device.free)), end + len(device.free)
            tables.append(_table(device, report.axes[own], report.transmissions and report.transmissions[own]))
        files.append(write(out / "devices.toml", "\n".join(tables)))
    shown = [_figures(report)] if report.axes else []
    shown += [_bounds(report.transmissions)] if report.transmissions else []
    render.publish(args, report, shown, report.lines(), out, files, report.verdict)
    right = report.bounded and not report.no_transmissions
    return options.exit_code(right, bool([*sittings, *clamped][-1].signals))


def _parser() -> argparse.ArgumentParser:
    parser = options.Parser(
        "hw.identify",
        "Estimate mass, friction and transmission of a device that nobody holds, and a lower bound of its damping.",
        "python -m hw.identify --rehearse",
        "python -m hw.identify --port /dev/ttyACM0 --scenario omega-pair",
        first="port rehearse scenario arm force out",
    )
    parser.add_loop()
    add_link_options(parser)
    add_person_options(parser)
    parser.set_defaults(no_preflight=True)
    add, number = parser.add_argument, options.number
    add("--force", type=number(0.05, 6.0), default=1.0, metavar="NEWTON", help="amplitude of the chirp (default 1)")
    band = "frequencies of the chirp [Hz] (default 3,200)"
    add("--band", type=options.pair, default=(3.0, 200.0), metavar="LOW,HIGH", help=band)
    add("--seconds", type=number(0.5, 30.0), default=2.5, metavar="SECONDS", help="length of each chirp (default 2.5)")
    fast = "largest speed of a slow swing, up to which the bound holds (default 0.5)"
    add("--speed", type=number(0.05, 1.5), default=0.5, metavar="M/S", help=fast)
    far = "amplitude of the slow swing (default 30)"
    add("--travel", type=number(2.0, 200.0), default=30.0, metavar="MM", help=far)
    count = "number of sessions; each records every axis with the handles at another place; two must agree (default 2)"
    add("--sittings", type=options.whole(1, 20), default=2, metavar="N", help=count)
    known = "two more sittings with clamped handles bound motor mass and transmission, for known-device"
    add("--transmission", action="store_true", help=known)
    add_output_options(parser)
    parser.refuse("for commands with a coupling", "psi", "lam", "reference", "environment", "known_device")
    return parser


def _swing(args: argparse.Namespace, scenario: Scenario) -> Swing:
    r = scenario.lever  # [m] radius of the hand on a rotary device, 1 otherwise; options give figures at the hand
    return Swing.of(scenario, args.speed / r, 1e-3 * args.travel / r)


def _excitation(args: argparse.Namespace, scenario: Scenario, clamped: float | None, link: int) -> Excitation:
    """Return the excitation of a sitting; `clamped` is as for `_sitting`."""
    force, swing = (args.force, _swing(args, scenario)) if clamped is None else (clamped * args.force, None)
    force, slew = scenario.lever * force, scenario.lever * SafetyLimits.slew
    return chirp(scenario.channels, scenario.T, link, force, args.band, args.seconds, swing, slew)


def _session(args: argparse.Namespace, scenario: Scenario, settings: LinkSettings) -> Session:
    undamped = scenario.replace(delta=(1e-6,) * len(scenario.device))  # The damping is unknown: almost none is assumed.
    r, swing = scenario.lever, _swing(args, scenario)
    # A device that is lighter than declared moves faster than --speed; the session stops it at this speed [m/s].
    fastest = min(2.5, max(1.0, 2 * args.speed))
    axes = max(len(device.free) for device in scenario.device)  # The excitation acts on all of them at the same time.
    vector = axes**0.5 * max(args.force, *(f / r for f in swing.force))
    return session_for(undamped, settings, cap=min(STRONGEST, vector), speed=fastest / r)


def _check_motion(args: argparse.Namespace, scenario: Scenario, limits: SafetyLimits) -> None:
    """Raise InputError if the motion of a device as declared would look like a jump of its encoder, or be too fast."""
    x = free_motion(scenario, _excitation(args, scenario, None, 1))
    ticks = max(2, round(_AVERAGED / scenario.T))
    speed = float(np.abs(x[ticks:] - x[:-ticks]).max()) / (ticks * scenario.T)
    if (moved := 1e3 * float(np.abs(np.diff(x, axis=0)).max())) > (most := 1e3 * _SHARE * limits.jump):
        raise InputError(
            f"--speed is {args.speed:g}, --force is {args.force:g}: they move a device by {moved:.3g} mm in a tick, "
            f"allowed are {most:.3g} mm: lower them, or T"
        )
    if speed > (most := _SHARE * limits.speed):
        raise InputError(
            f"--force is {args.force:g}, --band is {args.band[0]:g},{args.band[1]:g}: "
            f"they move a device at {speed:.3g} m/s, allowed are {most:.3g} m/s: lower --force, or begin --band higher"
        )


def _check_reach(args: argparse.Namespace, scenario: Scenario, excitation: Excitation, units: Units) -> None:
    """Raise SafetyStop if a device as declared would leave its range even from the middle."""
    reach = 1e3 * np.abs(free_motion(scenario, excitation)).max(axis=0)
    allowed = 1e3 * _SHARE * np.multiply(units.range, units.encoder_step)
    for i in np.flatnonzero(reach > allowed).tolist():
        raise SafetyStop(
            f"--travel is {args.travel:g}, --force is {args.force:g}: they move axis {i + 1} by {reach[i]:.3g} mm, "
            f"allowed are {allowed[i]:.3g} mm: lower them, or begin --band higher"
        )


def _sitting(
    args: argparse.Namespace,
    scenario: Scenario,
    settings: LinkSettings,
    out: Path,
    number: int,
    clamped: float | None = None,
) -> _Sitting:
    """Run a session that excites every axis, and return its record with the estimated parameters.

    `clamped` is the share of --force for a sitting with clamped handles, in which only a chirp is recorded.
    """
    session = _session(args, scenario, settings)
    session.record = recorder = Recorder(scenario.channels)
    played = partial(_excitation, args, scenario, clamped)

    def plan(ages: Ages) -> Sequence[Excitation]:
        excitation = played(ages.link_delay(1e6 * scenario.T, args.quantile, 1e6 * args.guard))
        if clamped is None:
            _check_reach(args, scenario, excitation, session.units)
        return [excitation]

    if args.port and number > 1:
        far = f"{1e3 * ELSEWHERE / scenario.lever:.3g} mm"
        task = f"take every handle {far} or more away and let go"
        task += ": the sitting begins 5 s later" if args.arm else "; then press key a"
        if clamped is not None:
            task = "clamp every handle to a bench; then press key a" if not args.arm else "every handle must be clamped"
        count = args.sittings + len(_LEVELS) * args.transmission
        render.console(args).print(f"sitting {number} of {count}: {task}")
    emulated = nobody(scenario, 0.0 if clamped is None else _CLAMPED)
    # `hold_session` counts time at full gain. The gain rises in the first 0.3 s, in which the excitation is zero.
    seconds = played(1).seconds - 0.2
    live = hold_session(args, session, plan, seconds, out, emulated)
    if number == 1:
        render.remove_earlier(out, "devices.toml", *(each.name for each in out.glob("trace-[0-9]*.npz")))
    report, axes, reason = outcome("identify", session, recorder, live.dropped, args.pace), list[Estimate](), None
    if session.stage == Stage.FINISHED and len(recorder) and clamped is None:
        try:
            with render.progress("estimating") as move:
                axes = estimate(recorder, session, scenario, move)
        except ValueError as error:
            reason = str(error)
    elif session.stage != Stage.FINISHED or not len(recorder):
        reason = f"the session ended as {session.stage}: {session.cause}"
    trace = None
    if len(recorder):
        trace = recorder.trace(session.units, scenario.T, plain(report)).save_npz(out / f"trace-{number}.npz")
    return _Sitting(axes, reason, report, session, recorder, trace, live.signals)


def _identified(scenario: Scenario, sittings: list[_Sitting]) -> _Report:
    session, estimates = sittings[-1].session, [sitting.axes for sitting in sittings if sitting.axes]
    left_out = [f"sitting {k}: {sitting.reason}" for k, sitting in enumerate(sittings, start=1) if sitting.reason]
    axes, reason, warnings = (estimates[0] if estimates else []), "; ".join(left_out), left_out
    try:
        if estimates:
            axes, hands = settled(estimates)
            reason, warnings = "", left_out + hands
    except ValueError as error:
        reason, warnings = str(error), left_out
    suspicious = [] if reason else held(axes, scenario, session)
    axes = capped(axes, scenario, session)
    reason = reason or unbounded(axes)
    bounded = not reason and not suspicious
    return _Report(sittings[-1].report, axes, sittings, bounded, warnings + suspicious, reason or None)


def _with_transmissions(
    report: _Report, scenario: Scenario, sittings: list[_Sitting], clamped: list[_Sitting]
) -> _Report:
    """Return the report with bounds of every motor and transmission, or with the reason why there are none."""
    if reason := "; ".join(sitting.reason for sitting in clamped if sitting.reason):
        return replace(report, no_transmissions=reason)
    bounds = list[TransmissionBounds]()
    for i in range(scenario.channels):
        free = min((s for s in sittings if s.axes), key=lambda s: s.axes[i].viscous)  # Hands only add damping.
        try:
            first, *others = (records_of(s.recorder, s.session)[i] for s in (free, *clamped))
            step = free.session.units.encoder_step[i]
            bounds.append(transmission_bounds(first, others, scenario.T, step, free.axes[i].friction, scenario.lever))
        except ValueError as error:
            return replace(report, no_transmissions=f"axis {i + 1}: {error}")
    return replace(report, transmissions=bounds)


def _table(device: Device, axes: Sequence[Estimate], bounds: Sequence[TransmissionBounds] | None) -> str:
    """Return a [[device]] table. `axes` and `bounds` have one entry per free axis.

    Masses and the transmission are means over the axes; each bound is the worst of the axes. Without bounds, and
    without an estimate for every axis, the stiffness is the declared one. Fields that are not identified are as
    declared.
    """

    def listed(figures: Sequence[str]) -> str:
        by_axis = dict(zip(device.free, figures, strict=True))
        each = [by_axis.get(k, figures[0]) for k in range(device.axes)]  # The list includes clamped axes.
        return f"[{', '.join(each)}]" if device.axes > 1 else figures[0]

    def mean(figures: Iterable[float]) -> float:
        return sum(figures) / len(axes)

    mass, speed = mean(e.friction.mass for e in axes), min(e.viscosity.speed for e in axes)
    lines = ["[[device]]", f"damping = {listed([f'{e.viscous:.6g}' for e in axes])}"]
    lines.append(f"delta = {listed([_floored(e.delta, 6) for e in axes])}")
    comment = in_unit("# [m/s] largest speed of the record; delta is not known above it")
    lines.append(f"credible_speed = {_floored(speed, 3)}  {comment}")
    if device.axes > 1:
        lines += [f"axes = {device.axes}", f"clamped = {list(device.clamped)}"]
    declared = {name: getattr(device, name, None) for name in _DECLARED[: 5 - bool(bounds)]}
    lines += [f"{name} = {json.dumps(value)}" for name, value in declared.items() if value]
    if isinstance(device, RigidDevice):
        return "\n".join([*lines, 'kind = "rigid"', f"mass = {mass:.6g}", ""])
    if bounds:
        names = "motor_mass", "handle_mass", "transmission_stiffness", "transmission_damping"
        figures = {name: [getattr(known, name) for known in bounds] for name in TransmissionBounds.__annotations__}
        lines += ['kind = "compliant"', *(f"{name} = {mean(figures[name]):.6g}" for name in names)]
        lines += ["[device.guaranteed]  # with 95 % confidence, at the forces of the record"]
        least, most = ("motor_mass_min", "transmission_damping_min"), "transmission_damping_max"
        lines += [f"{name} = {_floored(min(figures[name]), 6)}" for name in least]
        lines += [f"{most} = {-float(_floored(-max(figures[most]), 6))}"]
        stiffest = -float(_floored(-max(figures["transmission_stiffness_max"]), 0))
        return "\n".join([*lines, f"transmission_stiffness_max = {stiffest}", ""])
    known = [e.transmission for e in axes if e.transmission]
    if len(known) == len(axes):
        motor, handle = mean(each.motor_mass for each in known), mean(each.handle_mass for each in known)
        stiffness = mean(each.stiffness for each in known)
    else:
        lines.insert(0, "# not every axis shows a transmission: the stiffness and the mass ratio are declared values")
        motor = mass * device.motor_mass / (device.motor_mass + device.handle_mass)
        handle, stiffness = mass - motor, device.transmission_stiffness
    masses = [f"motor_mass = {motor:.6g}", f"handle_mass = {handle:.6g}"]
    return "\n".join([*lines, 'kind = "compliant"', *masses, f"transmission_stiffness = {stiffness:.6g}", ""])


def _floored(value: float, decimals: int) -> str:
    """Return `value` rounded down to `decimals`, or to four digits if it is small."""
    decimals = max(decimals, 3 - math.floor(math.log10(abs(value)))) if value else decimals
    return f"{math.floor(value * 10**decimals) / 10**decimals:.{decimals}f}"


def _bounds(known: Sequence[TransmissionBounds]) -> render.Table:
    cells = []
    for i, each in enumerate(known, start=1):
        least, most = each.transmission_damping_min, each.transmission_damping_max
        mass, stiffness = f"{each.motor_mass_min:.5g}", f"{each.transmission_stiffness_max:.6g}"
        cells.append((str(i), mass, stiffness, f"{least:.4g} to {most:.4g}", f"{1e6 * each.late:.0f}"))
    heads = "axis", "motor at least [kg]", "k at most [N/m]", "b [N s/m]", "force late at most [us]"
    return render.grid("motor and transmission, with 95 % confidence", heads, cells, left=())


def _figures(report: _Report) -> render.Table:
    cells = []
    for i, axis in enumerate(report.axes, start=1):
        friction = axis.friction
        mode = "-" if axis.transmission is None else f"{axis.transmission.mode_hz:.2f}"
        names = ("mass", "viscous", "coulomb", "stiffness")
        figures = [f"{getattr(friction, name):.5g} ± {2 * friction.errors[name]:.2g}" for name in names]
        bound = _floored(axis.delta, 4) if report.bounded else "-"
        cells.append((str(i), *figures, mode, bound, f"{math.floor(1e2 * axis.viscosity.speed) / 1e2:.2f}"))
    heads = (
        *("axis", "mass [kg]", "viscous [N s/m]", "dry [N]", "to ground [N/m]", "mode [Hz]", "delta at least"),
        "at speeds up to [m/s]",
    )
    return render.grid(f"{report.session.scenario}, identified", heads, cells, left=())
