"""python -m hw.identify: how much damping does a device guarantee? From a chirp of a small force and a free release.

Nobody holds the device. The chirp passes through the same session as the bridge, with all its limits, capped at its own
amplitude.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

from cli import options, render
from cli.session_cli import add_link_options, check_link, hold_session, measured_link
from design.files import write
from hw.identify import Estimate, Excitation, capped, chirp, estimate, held
from hw.limits import Stage
from hw.monitor import Ages
from hw.recording import Recorder, outcome, result_of
from hw.session import Session, session_for
from models.device import RigidDevice
from sim.scenario import InputError, Scenario, require_constant_delay, require_even_ticks, require_linear

_LIMITS = (
    "The bound is a statement about this record: the least viscous friction of all laws that fit it, less its scatter "
    "between parts of the record (95 %), a part for what is left unexplained and 0.5 % for the encoder's scale. It "
    "does not see friction that changes with temperature or wear, nor that of a handle behind its transmission apart "
    "from the motor's. A hand that rests on the handle springs it, and from 5 N/m on is refused; one that only damps "
    "cannot be told from the device. Dry friction is left out of delta: it dissipates too, but ever less than a "
    "viscous damper as speed grows. Lag of the amplifier is not in delta: it belongs to the delay."
)


def main(argv: list[str]) -> int:
    """Identify every axis. 0: each has a bound above zero, 1: not, or the session did not end as planned."""
    args = _parser().parse_args(argv)
    scenario, settings = options.scenario_from(args), check_link(args)
    require_linear(scenario, "hw.identify")
    require_constant_delay(scenario, "hw.identify")
    require_even_ticks(scenario, "hw.identify")
    force, seconds, (low, high) = args.force, args.seconds, args.band
    if not 0.5 <= low < high <= 0.4 / scenario.T:
        raise InputError(f"--band is {low:g},{high:g}, expected LOW,HIGH within 0.5 to {0.4 / scenario.T:.0f} Hz")
    out = options.out_folder(args, "identify")
    asks_nothing = scenario.replace(delta=(1e-6,) * scenario.channels)  # what the damping is, is the question
    session = session_for(asks_nothing, replace(settings, test_encoders=False), cap=force)
    session.record = recorder = Recorder(scenario.channels)

    def plan(ages: Ages) -> Sequence[Excitation]:
        link = measured_link(args, ages, scenario.T)
        return [chirp(scenario.channels, scenario.T, link, force, (low, high), seconds)]

    played = chirp(1, scenario.T, 1, force, (low, high), seconds).seconds - 0.2  # the lead has the ramp
    live = hold_session(args, session, plan, played, out, nobody=True, coulomb=args.coulomb)
    report, estimates = _identified(session, recorder, scenario, live.dropped, args.pace)
    files = _save(out, session, recorder, scenario, estimates, report)
    render.publish(args, report, [_figures(report)], _lines(report), out, files)
    if live.signals:
        return options.INTERRUPTED
    return options.DONE if session.stage == Stage.FINISHED and report["bounded"] else options.DOES_NOT_HOLD


def _parser() -> argparse.ArgumentParser:
    parser = options.Parser(
        "hw.identify",
        "Estimate mass, friction and transmission of a device that nobody holds, and a lower bound of its damping.",
        "python -m hw.identify --rehearse",
    )
    options.add_loop_options(parser)
    add_link_options(parser)
    push, seconds = options.number(0.05, 6.0), options.number(0.5, 30.0)
    parser.add_argument("--force", type=push, default=1.0, metavar="NEWTON", help="amplitude of the chirp (default 1)")
    band = "of the chirp [Hz] (default 3,200)"
    parser.add_argument("--band", type=options.pair, default=(3.0, 200.0), metavar="LOW,HIGH", help=band)
    parser.add_argument("--seconds", type=seconds, default=2.5, metavar="SECONDS", help="of the chirp (default 2.5)")
    rub = "dry friction of an emulated device"
    parser.add_argument("--coulomb", type=options.number(0.0, 10.0), default=0.0, metavar="NEWTON", help=rub)
    options.add_output_options(parser)
    return parser


def _identified(
    session: Session, recorder: Recorder, scenario: Scenario, dropped: int, pace: float
) -> tuple[dict[str, Any], list[Estimate]]:
    report = outcome("identify", session, recorder, dropped, pace)
    estimates: list[Estimate] = []
    if session.stage == Stage.FINISHED and len(recorder):
        try:
            with render.progress("estimating") as move:
                estimates = estimate(recorder, session, scenario, move)
        except ValueError as error:
            report["reason"] = str(error)
    else:
        report["reason"] = f"the session ended in {session.stage}: {session.cause}"
    report["warnings"] = warnings = held(estimates, scenario, session)
    estimates = capped(estimates, scenario, session)
    report["axes"] = [asdict(e) for e in estimates]
    report["bounded"] = bool(estimates) and all(e.delta > 0 for e in estimates) and not warnings
    report["limits"] = _LIMITS
    return report, estimates


def _save(
    out: Path,
    session: Session,
    recorder: Recorder,
    scenario: Scenario,
    estimates: list[Estimate],
    report: dict[str, Any],
) -> list[Path]:
    files = []
    if len(recorder):
        result = result_of(recorder, session.units, scenario.T, report)
        files.append(result.save_npz(out / "trace.npz"))
    if report["bounded"]:
        tables = [_table(e, scenario, i) for i, e in enumerate(estimates)]
        files.append(write(out / "devices.toml", "\n".join(tables)))
    return files


def _table(e: Estimate, scenario: Scenario, i: int) -> str:
    """One [[device]] table for a scenario file; a transmission that was not found is the scenario's."""
    device, mass = scenario.device[i], e.friction.mass
    lines = ["[[device]]", f"damping = {e.viscous:.6g}", f"delta = {np.floor(1e6 * e.delta) / 1e6:.6f}"]
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


def _figures(report: dict[str, Any]) -> Table:
    cells = []
    for i, axis in enumerate(report["axes"], start=1):
        found = axis["friction"]
        mode = "-" if axis["transmission"] is None else f"{axis['transmission']['mode_hz']:.2f}"
        names = ("mass", "viscous", "coulomb", "stiffness")
        figures = [f"{found[name]:.5g} ± {2 * found['errors'][name]:.2g}" for name in names]
        cells.append((str(i), *figures, mode, f"{found['delta']:.4f}"))
    heads = ("axis", "mass [kg]", "viscous [N s/m]", "dry [N]", "to ground [N/m]", "mode [Hz]", "delta at least")
    return render.grid(f"{report['scenario']}, identified", heads, cells, left=())


def _lines(report: dict[str, Any]) -> list[str]:
    reason = [f"nothing was identified: {report['reason']}"] if "reason" in report else []
    return [*reason, *(f"[yellow]{warning}[/]" for warning in report["warnings"]), _LIMITS]
