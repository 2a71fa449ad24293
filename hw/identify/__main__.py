"""python -m hw.identify: how much damping does a device guarantee? From a chirp of a small force and a free release.

Nobody holds the device. A force that does not depend on the motion closes no loop, so no certificate is needed; it
passes through the same session as the bridge, with all its limits, capped at the chirp's own amplitude.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from cli.options import (
    DOES_NOT_HOLD,
    DONE,
    INTERRUPTED,
    Parser,
    add_loop_options,
    add_output_options,
    execute,
    numbers,
    out_folder,
    scenario_from,
    seed_from,
)
from cli.render import console, progress
from hw import session_report
from hw.desk import add_link_options, check_link, hold_session, measured_link, number, session_for
from hw.identify.excitation import Excitation, chirp
from hw.identify.fit import Estimate, identify
from hw.plan import Ages
from hw.safety import Stage
from hw.session import Session
from hw.trace import Recorder, result_of
from models.device import RigidDevice
from sim.files import write, write_json
from sim.scenario import InputError, Scenario, require_constant_delay, require_linear

SUSPICIOUS = 0.1  # part by which an estimate may exceed the declared damping
LIMITS = (
    "The bound is a statement about this record: 95 % confidence that the viscous friction of the model (motor, "
    "transmission, handle) is at least this, where residuals are correlated over at most 60 ticks. It does not see "
    "friction that changes with position, temperature or wear, gravity, or motions faster than the chirp. Nor can it "
    "tell a hand from the device: whoever holds or touches the handle adds damping, and the bound is then too high. "
    "Dry friction is taken to reverse within a few mm/s; where it takes 10 mm/s, bounds 2 % too high were seen. "
    "Coulomb friction is left out of delta: it dissipates too, but ever less than a viscous damper as speed grows."
)


def main(argv: list[str]) -> int:
    """Identify every axis. 0: each has a bound above zero, 1: not, or the session did not end as planned."""
    args = _parser().parse_args(argv)
    scenario, seed, settings = scenario_from(args), seed_from(args), check_link(args)
    require_linear(scenario, "hw.identify")
    require_constant_delay(scenario, "hw.identify")
    force, seconds = number(args, "force", 0.05, 6.0), number(args, "seconds", 0.5, 30.0)
    low, high = numbers("--band", args.band, float, 2)
    if not 0.5 <= low < high <= 0.4 / scenario.T:
        raise InputError(f"--band is {args.band}, expected LOW,HIGH within 0.5 to {0.4 / scenario.T:.0f} Hz")
    coulomb = number(args, "coulomb", 0.0, 10.0)
    out = out_folder(args, "identify")
    asks_nothing = scenario.replace(delta=(1e-6,) * scenario.channels)  # what the damping is, is the question
    session = session_for(asks_nothing, settings, cap=force)
    session.record = recorder = Recorder(scenario.channels)

    def plan(ages: Ages) -> Sequence[Excitation]:
        link = measured_link(args, ages, scenario.T)
        return [chirp(scenario.channels, scenario.T, link, force, (low, high), seconds)]

    played = 1.5 * seconds + 0.1  # from full gain on: the lead has the ramp
    live = hold_session(args, session, plan, played, seed, ["--nobody", f"--coulomb={coulomb}"])
    outcome, estimates = _outcome(session, recorder, scenario, live.dropped, float(args.pace))
    outcome["files"] = [str(p) for p in _save(out, session, recorder, scenario, estimates, outcome)]
    _print(outcome, console(args))
    if args.json:
        write_json(args.json, outcome)
    if live.signals:
        return INTERRUPTED
    return DONE if session.stage == Stage.FINISHED and outcome["bounded"] else DOES_NOT_HOLD


def _parser() -> argparse.ArgumentParser:
    parser = Parser(
        "hw.identify",
        "Estimate mass, friction and transmission of a device that nobody holds, and a lower bound of its damping.",
        "python -m hw.identify --emulate",
    )
    add_loop_options(parser)
    add_link_options(parser)
    parser.add_argument("--force", default="1", metavar="NEWTON", help="amplitude of the chirp (default 1)")
    parser.add_argument("--band", default="3,200", metavar="LOW,HIGH", help="of the chirp [Hz] (default 3,200)")
    parser.add_argument("--seconds", default="2.5", metavar="SECONDS", help="of the chirp (default 2.5)")
    parser.add_argument("--coulomb", default="0", metavar="NEWTON", help="dry friction of the device of --emulate")
    add_output_options(parser)
    return parser


def _outcome(
    session: Session, recorder: Recorder, scenario: Scenario, dropped: int, pace: float
) -> tuple[dict[str, Any], list[Estimate]]:
    outcome = session_report.outcome("identify", session, recorder, dropped, pace)
    estimates: list[Estimate] = []
    if session.stage == Stage.FINISHED and len(recorder):
        try:
            estimates = estimate(recorder, session, scenario)
        except ValueError as error:
            outcome["reason"] = str(error)
    else:
        outcome["reason"] = f"the session ended in {session.stage}: {session.cause}"
    outcome["warnings"] = warnings = held(estimates, scenario, session)
    estimates = capped(estimates, scenario, session)
    outcome["axes"] = [asdict(e) for e in estimates]
    outcome["bounded"] = bool(estimates) and all(e.delta > 0 for e in estimates) and not warnings
    outcome["limits"] = LIMITS
    return outcome, estimates


def held(estimates: list[Estimate], scenario: Scenario, session: Session) -> list[str]:
    """Axes with far more damping than they are said to have, by INFO's guarantee and the scenario's own damping.

    A hand cannot be told from a device by its motion. Of an honest device the estimate scatters about what is
    declared, and one bound in twenty lies above it: that alone is no reason to ask.
    """
    found = []
    for i, (e, said) in enumerate(zip(estimates, declared(scenario, session), strict=False), start=1):
        if e.viscous > (1 + SUSPICIOUS) * said:
            found.append(
                f"axis {i}: {e.viscous:.4g} N s/m estimated, {said:.4g} declared (scenario, INFO): is somebody "
                "holding it? No bound is offered; where the device really has more, declare it and take another record"
            )
    return found


def declared(scenario: Scenario, session: Session) -> list[float]:
    """Damping of every axis [N s/m], the larger of the scenario's and INFO's."""
    guaranteed = [1e-6 * d for d in session.info.osp_damping] if session.info else [0.0] * scenario.channels
    return [max(device.damping, said) for device, said in zip(scenario.device, guaranteed, strict=True)]


def capped(estimates: list[Estimate], scenario: Scenario, session: Session) -> list[Estimate]:
    """No bound above the declared damping: what is more may be a hand."""
    said = declared(scenario, session)
    return [replace(e, delta=min(e.delta, limit)) for e, limit in zip(estimates, said, strict=False)]


def estimate(recorder: Recorder, session: Session, scenario: Scenario) -> list[Estimate]:
    """One estimate per axis from a recorded session. Raises ValueError naming the axis that gives none."""
    link, units = recorder.link(), session.units
    missing = int((~link["received"]).sum())
    if missing:  # which force acted then is not known for certain, and a wrong one makes a wrong bound
        raise ValueError(f"{missing} of {len(recorder)} ticks came without a STATE: take another record")
    applied = link["applied"]
    estimates = []
    with progress("estimating") as move:
        for i, device in enumerate(scenario.device):
            move(i, scenario.channels, f"estimating axis {i + 1}")
            rigid = isinstance(device, RigidDevice)
            x, force = link["x"][:, i], applied[:, i] * units.force_step[i]
            try:
                estimates.append(identify(x, force, link["received"], scenario.T, units.encoder_step[i], rigid))
            except ValueError as error:
                raise ValueError(f"axis {i + 1}: {error}") from None
    return estimates


def _save(
    out: Path,
    session: Session,
    recorder: Recorder,
    scenario: Scenario,
    estimates: list[Estimate],
    outcome: dict[str, Any],
) -> list[Path]:
    files = []
    if len(recorder):
        result = result_of(recorder, session.units, scenario.T, outcome)
        files.append(result.save_npz(out / "trace.npz"))
    if outcome["bounded"]:
        files.append(write(out / "devices.toml", "\n".join(map(_table, estimates))))
    files.append(out / "report.json")
    write_json(files[-1], outcome | {"files": [str(p) for p in files]})
    return files


def _table(e: Estimate) -> str:
    """One [[device]] table for a scenario file."""
    lines = ["[[device]]", f"damping = {e.viscous:.6g}", f"delta = {np.floor(1e6 * e.delta) / 1e6:.6f}"]
    if e.stiffness is None:
        return "\n".join([*lines, 'kind = "rigid"', f"mass = {e.mass:.6g}", ""])
    masses = [f"motor_mass = {e.motor_mass:.6g}", f"handle_mass = {e.mass - e.motor_mass:.6g}"]
    return "\n".join([*lines, 'kind = "compliant"', *masses, f"transmission_stiffness = {e.stiffness:.6g}", ""])


def _print(outcome: dict[str, Any], console: Console) -> None:
    table = Table(title=f"{outcome['scenario']}, identified")
    for column in ("axis", "mass [kg]", "viscous [N s/m]", "Coulomb [N]", "mode [Hz]", "delta at least", "residual"):
        table.add_column(column, justify="right")
    for i, axis in enumerate(outcome["axes"], start=1):
        mode = "-" if axis["mode_hz"] is None else f"{axis['mode_hz']:.2f}"
        figures = [f"{axis[name]:.5g} ± {2 * axis['errors'][name]:.2g}" for name in ("mass", "viscous", "coulomb")]
        table.add_row(str(i), *figures, mode, f"{axis['delta']:.4f}", f"{axis['steps']:.2g} encoder steps")
    console.print(table)
    if "reason" in outcome:
        console.print(f"nothing was identified: {outcome['reason']}")
    for warning in outcome["warnings"]:
        console.print(f"[yellow]{warning}[/]")
    console.print(f"[dim]·[/] {LIMITS}")
    console.print("files: " + ", ".join(outcome["files"]), soft_wrap=True)


if __name__ == "__main__":
    execute(main)
