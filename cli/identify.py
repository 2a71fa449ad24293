"""python -m hw.identify: how much damping does a device guarantee? From a chirp of a small force and a free release.

Nobody holds the device, in two sittings with the handles at other places: a hand that only damps is found out by the
sitting in which it was not there. The chirp passes through the same session as the bridge, with all its limits, capped
at its own amplitude.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from haptic_loop.cli import options, render
from haptic_loop.cli.session_cli import add_link_options, check_link, hold_session, steady_scenario
from haptic_loop.design.files import off_table, plain, write
from haptic_loop.hw.emulator import nobody
from haptic_loop.hw.identify import Estimate, Excitation, Swing, capped, chirp, estimate, held, settled
from haptic_loop.hw.limits import Stage
from haptic_loop.hw.monitor import Ages, LinkSettings
from haptic_loop.hw.recording import Recorder
from haptic_loop.hw.session import Session, session_for
from haptic_loop.hw.session_report import SessionReport, outcome
from haptic_loop.models.device import RigidDevice
from haptic_loop.sim.scenario import InputError, Scenario

_LIMITS = (
    "The bound is a statement about these records: the least viscous friction of all laws that fit, less its scatter "
    "between parts of a record (95 %), a part for what is left unexplained and 0.5 % for the encoder's scale; of all "
    "sittings the least. It does not see friction that changes with temperature or wear, nor that of a handle behind "
    "its transmission apart from the motor's. A dashpot behind a spring whose memory is short or faint (below 2 N s/m "
    "at 3 ms, below 0.5 N s/m at 10 ms) is taken for damping, though it damps nothing at high frequency. A hand that "
    "rests on the handle springs it: refused from 5 N/m on. One "
    "that only damps is not in the bound if nobody touched the handle in one of the sittings. Dry friction is left out "
    "of delta: it dissipates too, but ever less than a viscous damper as speed grows. Lag of the amplifier is not in "
    "delta: it belongs to the delay. The bound holds up to the speed of the records; hw.bridge stops a handle there."
)


@dataclass(frozen=True, eq=False)
class _Sitting:
    """One session, and what its record says."""

    axes: list[Estimate]  # none where there is a reason
    reason: str | None
    report: SessionReport = off_table("left out")
    session: Session = off_table("left out")
    trace: Path | None = off_table("left out")
    signals: Sequence[int] = off_table("left out")


@dataclass(frozen=True, eq=False)
class _Report:
    """The last session, one estimate per axis from all sittings, and whether each has a bound above zero."""

    session: SessionReport = off_table("inlined")
    axes: list[Estimate] = off_table()
    sittings: list[_Sitting] = off_table()
    bounded: bool = off_table()
    warnings: list[str] = off_table()
    reason: str | None = off_table("if given")
    limits: str = off_table(default=_LIMITS)

    def lines(self) -> list[str]:
        """What stands below the table."""
        reason = [f"no bound: {self.reason}"] if self.reason else []
        return [*reason, *(f"[yellow]{warning}[/]" for warning in self.warnings), self.limits]


def main(argv: list[str]) -> int:
    """Identify every axis. 0: each has a bound above zero, 1: not, or a session did not end as planned."""
    args = _parser().parse_args(argv)
    scenario, settings = steady_scenario(args, "hw.identify"), check_link(args)
    low, high = args.band
    if not 0.5 <= low < high <= 0.4 / scenario.T:
        raise InputError(f"--band is {low:g},{high:g}, expected LOW,HIGH within 0.5 to {0.4 / scenario.T:.0f} Hz")
    out, sittings = options.out_folder(args, "identify"), list[_Sitting]()
    settings = replace(settings, test_encoders=False)
    while len(sittings) < args.sittings and not (sittings and sittings[-1].signals):
        sittings.append(_sitting(args, scenario, settings, out, len(sittings) + 1))
        last = sittings[-1].session.link.last
        if args.port and not args.same_place and last:
            settings = replace(settings, elsewhere=last.counts)
    report = _identified(scenario, sittings)
    files = [sitting.trace for sitting in sittings if sitting.trace]
    if report.bounded:
        tables = [_table(e, scenario, i) for i, e in enumerate(report.axes)]
        files.append(write(out / "devices.toml", "\n".join(tables)))
    render.publish(args, report, [_figures(report)], report.lines(), out, files)
    return options.exit_code(report.bounded, bool(sittings[-1].signals))


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
    parser.set_defaults(deadman=None, no_preflight=True)
    add, number = parser.add_argument, options.number
    add("--force", type=number(0.05, 6.0), default=1.0, metavar="NEWTON", help="amplitude of the chirp (default 1)")
    band = "frequencies of the chirp [Hz] (default 3,200)"
    add("--band", type=options.pair, default=(3.0, 200.0), metavar="LOW,HIGH", help=band)
    add("--seconds", type=number(0.5, 30.0), default=2.5, metavar="SECONDS", help="length of the chirp (default 2.5)")
    rub = "dry friction of an emulated device (default 0)"
    add("--coulomb", type=number(0.0, 10.0), default=0.0, metavar="NEWTON", help=rub)
    fast = "speed that a slow swing reaches, and up to which the bound holds (default 0.5)"
    add("--speed", type=number(0.05, 1.5), default=0.5, metavar="M/S", help=fast)
    far = "amplitude of that swing (default 30)"
    add("--travel", type=number(2.0, 200.0), default=30.0, metavar="MM", help=far)
    count = "records of every axis, each with the handles at another place; two have to agree (default 2)"
    add("--sittings", type=options.whole(1, 20), default=2, metavar="N", help=count)
    stay = "leave the handles where they are between sittings (an emulator has nobody to move them)"
    add("--same-place", action="store_true", help=stay)
    rests = "with --rehearse, the damping of a hand at every handle in the first sitting (default 0)"
    add("--hand", type=number(0.0, 10.0), default=0.0, metavar="N_S/M", help=rests)
    parser.add_output()
    parser.only("with --rehearse", lambda args: args.rehearse, "hand")
    parser.only("with --rehearse", lambda args: not args.port, "coulomb")
    parser.only("with --port", lambda args: args.port, "same_place")
    return parser


def _sitting(args: argparse.Namespace, scenario: Scenario, settings: LinkSettings, out: Path, number: int) -> _Sitting:
    """Play the excitation to every axis, record and estimate."""
    asks_nothing = scenario.replace(delta=(1e-6,) * scenario.channels)  # what the damping is, is the question
    swing = Swing.of(scenario, args.speed, 1e-3 * args.travel)
    fastest = min(2.5, max(1.0, 2 * args.speed))  # a lighter device than declared is stopped there
    session = session_for(asks_nothing, settings, cap=max(args.force, *swing.force), speed=fastest)
    session.record = recorder = Recorder(scenario.channels)

    def played(link: int) -> Excitation:
        return chirp(scenario.channels, scenario.T, link, args.force, args.band, args.seconds, swing)

    def plan(ages: Ages) -> Sequence[Excitation]:
        return [played(ages.link_delay(1e6 * scenario.T, args.quantile, 1e6 * args.guard))]

    if args.port and number > 1:
        told = "let go of every handle" if args.same_place else "take every handle 5 mm or more away and let go"
        told += "; then press a" if not args.arm else "" if args.same_place else ": it begins 5 s later"
        render.console(args).print(f"sitting {number} of {args.sittings}: {told}")
    alone = nobody(scenario, args.hand if number == 1 else 0.0)
    seconds = played(1).seconds - 0.2  # the lead has the ramp
    live = hold_session(args, session, plan, seconds, out, alone, args.coulomb)
    report, axes, reason = outcome("identify", session, recorder, live.dropped, args.pace), list[Estimate](), None
    if session.stage == Stage.FINISHED and len(recorder):
        try:
            with render.progress("estimating") as move:
                axes = estimate(recorder, session, scenario, move)
        except ValueError as error:
            reason = str(error)
    else:
        reason = f"the session ended in {session.stage}: {session.cause}"
    trace = None
    if len(recorder):
        trace = recorder.trace(session.units, scenario.T, plain(report)).save_npz(out / f"trace-{number}.npz")
    return _Sitting(axes, reason, report, session, trace, live.signals)


def _identified(scenario: Scenario, sittings: list[_Sitting]) -> _Report:
    """The report of all sittings, with one estimate per axis."""
    session, told = sittings[-1].session, [sitting.axes for sitting in sittings if sitting.axes]
    left_out = [f"sitting {k}: {sitting.reason}" for k, sitting in enumerate(sittings, start=1) if sitting.reason]
    axes, reason, warnings = (told[0] if told else []), "; ".join(left_out), left_out
    try:
        if told:
            axes, hands = settled(told)
            reason, warnings = "", left_out + hands
    except ValueError as error:
        reason, warnings = str(error), left_out
    suspicious = [] if reason else held(axes, scenario, session)
    axes = capped(axes, scenario, session)
    bounded = not reason and not suspicious and all(e.delta > 0 for e in axes)
    return _Report(sittings[-1].report, axes, sittings, bounded, warnings + suspicious, reason or None)


def _table(e: Estimate, scenario: Scenario, i: int) -> str:
    """One [[device]] table for a scenario file; a transmission that was not found is the scenario's."""
    device, mass = scenario.axis_devices[i], e.friction.mass
    lines = ["[[device]]", f"damping = {e.viscous:.6g}", f"delta = {np.floor(1e6 * e.delta) / 1e6:.6f}"]
    speed = np.floor(1e3 * e.viscosity.speed) / 1e3
    lines.append(f"credible_speed = {speed:.3f}  # [m/s] of the record: delta is not known beyond it")
    if isinstance(device, RigidDevice):
        return "\n".join([*lines, 'kind = "rigid"', f"mass = {mass:.6g}", ""])
    if (found := e.transmission) is not None:
        motor, handle, stiffness = found.motor_mass, found.handle_mass, found.stiffness
    else:
        lines.insert(0, "# no transmission explained the record: its stiffness and how masses are shared are declared")
        motor = mass * device.motor_mass / (device.motor_mass + device.handle_mass)
        handle, stiffness = mass - motor, device.transmission_stiffness
    masses = [f"motor_mass = {motor:.6g}", f"handle_mass = {handle:.6g}"]
    return "\n".join([*lines, 'kind = "compliant"', *masses, f"transmission_stiffness = {stiffness:.6g}", ""])


def _figures(report: _Report) -> render.Table:
    cells = []
    for i, axis in enumerate(report.axes, start=1):
        found = axis.friction
        mode = "-" if axis.transmission is None else f"{axis.transmission.mode_hz:.2f}"
        names = ("mass", "viscous", "coulomb", "stiffness")
        figures = [f"{getattr(found, name):.5g} ± {2 * found.errors[name]:.2g}" for name in names]
        bound = f"{found.delta:.4f}" if report.bounded else "-"
        cells.append((str(i), *figures, mode, bound, f"{axis.viscosity.speed:.2f}"))
    heads = (
        *("axis", "mass [kg]", "viscous [N s/m]", "dry [N]", "to ground [N/m]", "mode [Hz]", "delta at least"),
        "up to [m/s]",
    )
    return render.grid(f"{report.session.scenario}, identified", heads, cells, left=())
