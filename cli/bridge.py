"""python -m hw.bridge: drive a device with a coupling that is certified for the measured delay.

Steps of a session: port -> handshake -> delay -> coupling and certificate -> arm -> run -> ramp out -> trace and report
"""

from __future__ import annotations

import argparse
import math
import signal
from collections.abc import Sequence
from dataclasses import replace

import msgspec
import numpy as np

from haptic_loop.cli import options, render, session_cli
from haptic_loop.cli.verdict import verdict
from haptic_loop.cli.world import world_start
from haptic_loop.design.certificate import named
from haptic_loop.design.files import lost_output, plain, write_json
from haptic_loop.design.result import CAVEATS, listed
from haptic_loop.hw.control import CertifiedCoupling, CouplingRequest, certified_couplings, timed
from haptic_loop.hw.limits import Stage
from haptic_loop.hw.monitor import Ages
from haptic_loop.hw.recording import Recorder
from haptic_loop.hw.session import FREE_SPEED, USUAL_CAP, session_for
from haptic_loop.hw.session_report import SessionReport, outcome, save
from haptic_loop.sim.couplings import NAMES, encoder_steps, stored_coupling
from haptic_loop.sim.scenario import InputError, Scenario, is_world
from haptic_loop.sim.world import START_J, Claim

_LONGEST = 3600.0  # [s] largest --duration (time at full gain after arming), because the trace is kept in memory


def main(argv: list[str]) -> int:
    """Run a session. Return 0 if it ended as planned, 130 after a signal other than SIGUSR1, 1 for any other end."""
    args = _parser().parse_args(argv)
    scenario, settings = session_cli.steady_scenario(args, "hw.bridge"), session_cli.check_link(args)
    seconds = scenario.duration if args.duration is None else args.duration
    if seconds > _LONGEST:
        allowed = f"a session lasts 0.1 to {_LONGEST:g} s: use --duration"
        raise InputError(f"duration = {seconds:g} s in scenario {scenario.name}; {allowed}")
    # A device without a clock applies each force on arrival.
    at_once = args.latch == "arrival" or session_cli.host_clocked(args)
    start = world_start(args) if is_world(scenario) else START_J
    if is_world(scenario):
        args.energy_budget = None  # In a world the energy account, which begins with `start` [J], replaces the budget.
    behind = session_cli.boards_behind(args, scenario)
    _check(args, scenario, at_once, bool(behind))
    settings = replace(settings, behind=behind, rereference=not args.no_rereference, energy_budget=args.energy_budget)
    limits = session_cli.limits_from(args, scenario)
    # In a rehearsal the scenario's hands hold the handles.
    settings = replace(session_cli.with_person(args, settings), held=args.rehearse)
    session = session_for(scenario, settings, **limits)
    below = session.scenario.delta if session.scenario.delta != scenario.delta else ()
    scenario = session.scenario
    session.record = recorder = Recorder(scenario.channels)
    out, console = options.out_folder(args, "bridge"), render.console(args)

    def plan(ages: Ages) -> Sequence[CertifiedCoupling]:
        met, link = timed(scenario, ages, args.quantile, 1e6 * args.guard, at_once)
        request = CouplingRequest(
            met,
            args.case,
            args.coupling,
            args.condition,
            limiter=args.limiter,
            behind=behind,
            start=start,
            energy_budget=args.energy_budget and args.energy_budget[0],
        )
        programs = certified_couplings(request, link)
        steps = session.units.encoder_step
        programs = [_with_encoder_steps(program, steps) for program in programs]
        console.print(verdict(programs[0].assessment), soft_wrap=True)
        console.print(_cap_words(scenario, session.limits.cap, args.force_cap), soft_wrap=True, highlight=False)
        _print_certificate(ages, link, programs, session.limits.cap, console)
        if below:
            note = "· delta is a full matrix, but the device's INFO has one number per axis: the certificate uses"
            matrix = f"the smaller diagonal matrix {', '.join(f'{d:.4g}' for d in below)} N s/m"
            console.print(f"{note} {matrix}", highlight=False)
        return programs

    live = session_cli.hold_session(args, session, plan, seconds, out)
    report = outcome(args.case, session, recorder, live.dropped, args.pace)
    _print_session(report, console, args.details)  # before files, whose disk may be full
    files = [str(p) for p in save(out, session, recorder, report, not args.no_plot)]
    console.print("files: " + ", ".join(files), soft_wrap=True)
    if args.json:
        write_json(args.json, plain(report) | {"files": files})
    if signal.SIGHUP in live.signals:  # The terminal is closed, so lost output is no error.
        lost_output.clear()
    return options.exit_code(report.session.stage == Stage.FINISHED, bool(set(live.signals) - {signal.SIGUSR1}))


def _with_encoder_steps(program: CertifiedCoupling, steps: Sequence[float]) -> CertifiedCoupling:
    """Return the program, assessed for the encoder steps (m,) [m] that the device reports."""
    encoder = encoder_steps(program.scenario, program.case, program.assessment, steps)
    return replace(program, assessment=program.assessment.with_encoder(encoder))


def _check(args: argparse.Namespace, scenario: Scenario, at_once: bool, several_boards: bool) -> None:
    """Raise InputError for options that exclude each other, or that no certificate covers."""
    if args.case == "none":
        raise InputError("--case none has no coupling, so there is nothing that could be certified")
    if args.coupling and args.coupling not in NAMES and ":" not in args.coupling:
        stored_coupling(scenario, args.coupling)  # Refuse a bad file before the link is measured.
    arrival = "--latch arrival"
    if session_cli.host_clocked(args):
        if args.latch == "tick":
            acts = "a force acts when the host writes it, not at a tick"
            raise InputError(f"--latch tick with --port {args.port}: {acts}; leave --latch out")
        arrival = f"--port {args.port}, whose forces latch on arrival"
    if at_once and args.condition:
        choice, late = named(args.condition), ((0.0, scenario.T / 2),) * scenario.channels
        if reason := choice.beyond(msgspec.structs.replace(scenario.loop(args.case), latency=late)):
            raise InputError(f"--condition {choice.name} with {arrival}: {reason}")
    if args.energy_budget and at_once:
        raise InputError(f"--energy-budget with {arrival}: the budget counts forces that latch at ticks; drop one")
    if args.energy_budget and not args.energy_budget[0]:
        raise InputError(
            "--energy-budget is 0 J: arming tests the encoders with a small force, give for example 0.01 J"
        )
    counted = ("--latch arrival", args.latch == "arrival"), ("a world", is_world(scenario))
    for feature, present in (*counted, ("--energy-budget", args.energy_budget)):
        if several_boards and present:
            several = f"{feature} needs one clock for all devices, but each board has its own clock"
            raise InputError(f"--port is {args.port}: {several}")


def _parser() -> argparse.ArgumentParser:
    parser = options.Parser(
        "hw.bridge",
        "Drive a device with a coupling that is certified for the measured delay.",
        "python -m hw.bridge --rehearse --duration 2",
        "python -m hw.bridge --port /dev/ttyACM0 --coupling coupling.json",
        first="port rehearse scenario coupling arm duration",
    )
    parser.add_loop()
    session_cli.add_link_options(parser)
    session_cli.add_safety_options(parser)
    session_cli.add_person_options(parser)
    names = ", ".join(NAMES)
    parser.add_argument(
        "--coupling",
        metavar="NAME|FILE",
        help=f"{names} or FILE.json (default spring-damper; moving-average in a world)",
    )
    parser.add_condition()
    latch = (
        "when forces act: at whole ticks (default), or on arrival with a certified latency (always for force-dimension)"
    )
    parser.add_argument("--latch", choices=("tick", "arrival"), help=latch)
    parser.add_energy_budget()
    parser.add_limiter()
    seconds, most = "time at full gain (default: the scenario's)", options.number(0.1, _LONGEST)
    parser.add_argument("--duration", type=most, metavar="SECONDS", help=seconds)
    parser.add_details()
    session_cli.add_output_options(parser, picture=True)
    return parser


def _print_certificate(
    ages: Ages, link: int, programs: Sequence[CertifiedCoupling], caps: Sequence[float], console: render.Screen
) -> None:
    at = {p: int(np.percentile(ages.values, p)) for p in (50, 99)}
    console.print(
        f"answers are {at[50]} us old (median), {at[99]} us at the 99th percentile, {ages.missing} of "
        f"{len(ages.values) + ages.missing} never arrived; "
        f"the certificate is for {_link(link, programs[0].scenario)}"
    )
    console.print(_ticks(ages, programs[0].scenario, caps), highlight=False)
    heads = ("coupling", "K [N/m]", "B [N s/m]", "needs", "of [N s/m]", "guarantee")
    title = "certified for the measured delay, and reserves for longer delays"
    console.print(render.grid(title, heads, [_certified(program) for program in programs], left=range(6)))
    remarks = [(program.assessment.within(caps).force_limits.words, *program.remarks()) for program in programs]
    shared = set(remarks[0]).intersection(*remarks) if len(programs) > 1 else set()
    for program, own in zip(programs, remarks, strict=True):
        for remark in (each for each in own if each not in shared):
            console.print(f"[dim]·[/] {program.name}: {remark}", highlight=False)
    for remark in (each for each in remarks[0] if each in shared):
        console.print(f"[dim]·[/] {remark}", highlight=False)
    if len(programs) == 1:
        console.print(
            "no reserve: no softer coupling is certified for a longer delay. Too many late answers end the session."
        )


def _certified(program: CertifiedCoupling) -> tuple[str, ...]:
    """Return the table row of a coupling, with the required damping of the first condition that certifies it."""
    assessment = program.assessment
    gains, requirements = assessment.gains, (assessment.decisive, *assessment.requirements.values())
    certified = next(need for need in requirements if need.certified)
    latency = program.scenario.latency
    late = f" and {1e6 * latency[0][0]:.0f} to {1e6 * latency[0][1]:.0f} us" if latency else ""
    return (
        f"{program.chosen.kind}, theta = {', '.join(map(str, program.scenario.theta))}{late}",
        *(listed(gains[name], 5) if name in gains else "-" for name in "KB"),
        f"{listed(certified.required, 5, once=True)} ({certified.condition}, {certified.proof})",
        listed(certified.available, 5, once=True),
        assessment.guarantee_words or "none",
    )


def _link(link: int, scenario: Scenario) -> str:
    if link or not scenario.latency:
        return f"a link delay of {link} tick{'s' if link > 1 else ''}"
    least, most = scenario.latency[0]
    return f"forces that act {1e6 * least:.0f} to {1e6 * most:.0f} us after their tick"


def _ticks(ages: Ages, scenario: Scenario, caps: Sequence[float]) -> str:
    """Describe the lengths of ticks, and the energy that a tick longer than certified may give a hand."""
    least, most = (f"{1e-3 * side(ages.ticks, default=1e6 * scenario.T):.4g}" for side in (min, max))
    span = least if least == most else f"{least} to {most}"
    longest, shortest = 1e3 * (scenario.T_max or scenario.T), 1e3 * (scenario.T_min or scenario.T)
    known = f" (known-device: from {shortest:.4g} ms)" if scenario.known_devices else ""
    cost = _overlong_tick(caps, scenario.delta)
    return (
        f"ticks of the device last {span} ms, certified up to {longest:.4g} ms{known}; one longer tick "
        f"may give a hand at most {cost:.3g} mJ for every ms that it lasts (at the force cap)"
    )


def _cap_words(scenario: Scenario, caps: Sequence[float], chosen: float | None) -> str:
    """Describe the force caps (m,) [N] at the hand; if the user has `chosen` one, how fast a free handle may become."""
    newtons = f"forces at the hand are at most {listed([cap / scenario.lever for cap in caps], 3, once=True)} newtons"
    most = f"{FREE_SPEED:g} metre per second"
    if chosen is None:
        why = f"at most {USUAL_CAP:g}, and no constant force may move a free handle faster than {most}"
        return f"{newtons} (default: {why}; --force-cap changes it)"
    speeds = [scenario.lever * cap / delta for cap, delta in zip(caps, scenario.delta, strict=True)]
    fastest = max(speeds)
    if fastest <= FREE_SPEED:
        return f"{newtons} (--force-cap)"
    axis, enough = speeds.index(fastest), scenario.delta[speeds.index(fastest)] * FREE_SPEED / scenario.lever**2
    constant = f"a constant force moves a free handle of axis {axis + 1} at up to {fastest:.3g} metres per second"
    return f"{newtons}; {constant}, and with --force-cap {math.floor(100 * enough) / 100:g} at up to {most}"


def _overlong_tick(caps: Sequence[float], delta: Sequence[float]) -> float:
    """Bound the power [W] that a hand receives in an overlong tick: sum f^2/(4 delta), at the force caps f [N]."""
    return sum(f * f / (4 * d) for f, d in zip(caps, delta, strict=True))


def _print_session(report: SessionReport, console: render.Screen, details: bool) -> None:
    """Print the session's log, and the figures of the link, of energy accounts and of the scene."""
    if report.assessment is None:  # No verdict was printed.
        last = report.session.log[-1]
        console.print(f"[red]Not certified[/]: the session is {_colour(last.stage)}, {last.cause}.", soft_wrap=True)
    cells = {"after": "{r.t_s:.3f} s", "stage": lambda r: _colour(r.stage), "cause": "{r.cause}"}
    console.print(render.columns(f"case {report.case} · {report.scenario}", cells, report.session.log, left=(1, 2)))
    link = report.link
    if link.age_us:
        ages = ", ".join(f"{name} {us / 1000:.2f} ms" for name, us in link.age_us.items())
        rate = f"{link.rate_hz:.0f} answers a second, {link.missed_percent:.2f} % of ticks missed"
        console.print(f"link while forces acted: {rate}; age {ages}")
    for i, growth in enumerate(report.growth, start=1):
        console.print(f"growth at full gain, arming {i}, {growth.words(report.run.T_s)}")
    for i, part in enumerate(report.energy_budget or [], start=1):
        console.print(f"energy budget, arming {i}: limited {part.limited_ticks} of {part.ticks} ticks")
        console.print(f"  {part.guarantee}")
    for i, part in enumerate(report.world or [], start=1):
        claim = Claim.of(report.assessment, ran=part).words if report.assessment else "No guarantee."
        acted = f"The shell acted on {part.ticks_acted} of {part.ticks} ticks."
        console.print(f"world, arming {i}: {claim} The encoder steps of the devices are not covered. {acted}")
        if part.unsettled_steps:
            console.print(f"  limited forces did not settle in {part.unsettled_steps} steps of the scene")
        if part.warnings:
            console.print(f"  MuJoCo warns: {' '.join(part.warnings)}")
        if part.step_us:
            took = f"{part.step_us['p50']:.0f} us of CPU time (median), {part.step_us['p99']:.0f} us (99 %)"
            console.print(f"  a step of the scene took {took}; T is {1e6 * report.run.T_s:.0f} us")
    if report.scene and report.scene.active:
        console.print(f"active parts: {', '.join(report.scene.active)}")
    counted = ", ".join(f"{name.replace('_', ' ')} {n}" for name, n in link.counters.items() if n)
    console.print(f"counters of the whole session, including the delay measurement: {counted or 'nothing'}")
    if details:
        console.print(f"[dim]·[/] {CAVEATS}")


def _colour(stage: str) -> str:
    colours = {Stage.FINISHED: "green", Stage.REFUSED: "yellow", Stage.STOPPED: "red", Stage.LOST: "red"}
    colour = (colours | {Stage.ESTOP: "red"}).get(Stage(stage))
    return f"[{colour}]{stage}[/]" if colour else stage
