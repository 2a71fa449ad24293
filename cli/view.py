"""python -m sim.view: show the loop in real time in MuJoCo's viewer, or film it without a display."""

from __future__ import annotations

import argparse
import shutil
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass
from math import inf, isfinite, isnan, nan
from pathlib import Path
from typing import TYPE_CHECKING, Any

from haptic_loop.cli import options, render
from haptic_loop.design.files import check_file, off_table, write_json
from haptic_loop.sim.scenario import InputError, is_world, require_constant_delay, require_even_ticks, require_linear
from haptic_loop.sim.view.session import (
    COUPLINGS,
    GIVEN,
    LABELS,
    LONGEST_LAG,
    Couple,
    LiveLoop,
    Menu,
    PreparedLoop,
    Script,
    first_loop,
    keys_help,
    parse_script,
)

if TYPE_CHECKING:
    from haptic_loop.design.assessment import Assessment
    from haptic_loop.sim.view.stage import Picture

_EXAMPLES = (
    "python -m sim.view --coupling optimal",
    "python -m sim.view --video out.gif --script '0:none 1:theta+1 6:designed'",
)
_SCRIPT = "0:none 1:theta+1 6:designed"  # default script of a video: an oscillation starts and dies
_AFTER = 3.0  # [s] of video after the last event of its script
_LONGEST = 3600  # [s] longest video


def main(argv: list[str]) -> int:
    """Show the loop until the window is closed or --duration is over, or film it. Return 0, or 130 if interrupted."""
    args = _parser().parse_args(argv)
    scenario = options.scenario_from(args)
    require_even_ticks(scenario, "sim.view")
    require_constant_delay(scenario, "sim.view")
    require_linear(scenario, "sim.view", walls=True)
    if args.video:
        _check_film(Path(args.video), args.fps)
    if is_world(scenario):
        args.coupling, args.duration = args.coupling or "moving-average", args.duration or scenario.duration
        args.script = args.script or "0:restart"
    label, script = _beginning(args, scenario.channels)
    # --case none begins without a coupling; keys choose couplings for case I.
    file = args.coupling if label == GIVEN else None
    menu = Menu("I" if args.case == "none" else args.case, args.condition, file, args.limiter)
    prepared = first_loop(menu, scenario, label)
    executor = ThreadPoolExecutor(1)
    try:
        session = LiveLoop(prepared, executor, script, inf if args.video else LONGEST_LAG)
        ended = _film(args, session) if args.video else _window(session, args.duration)
    finally:
        executor.shutdown(cancel_futures=True)
    events = [_Event.of(*change) for change in session.log]
    report = _Report(args.case, session.prepared.scenario.name, session.t, session.clipped, events, **ended)
    for line in report.lines():
        render.console(args).print(line, soft_wrap=True)
    if args.json:
        write_json(args.json, report)
    return options.exit_code(True, report.interrupted)


@dataclass(frozen=True)
class _Event:
    """A change of the loop, with the verdicts on the changed loop."""

    t_s: float
    event: str
    coupling: str
    theta: tuple[int, ...]
    psi: tuple[int, ...]
    exact_growth_rate_per_s: float  # null in JSON if there is none
    exact_frequency_hz: float
    assessment: Assessment

    @classmethod
    def of(cls, t: float, what: str, prepared: PreparedLoop) -> _Event:
        scenario, mode = prepared.scenario, prepared.mode
        growth, frequency = (float(mode.growth), float(mode.frequency_hz)) if mode else (nan, nan)
        loop = prepared.label, scenario.theta, scenario.psi, growth, frequency
        return cls(t, what, *loop, prepared.assessment)

    def line(self) -> str:
        guarantee = self.assessment.guarantee
        held = [name for name, need in self.assessment.requirements.items() if need.certified] if guarantee else []
        growth = f"{self.exact_growth_rate_per_s:+.3g} 1/s at {self.exact_frequency_hz:.1f} Hz"
        unknown = "a world" if isnan(self.exact_growth_rate_per_s) else "no growth"
        grows = growth if isfinite(self.exact_growth_rate_per_s) else unknown
        encoder = self.assessment.encoder
        exact = " for exact positions" if encoder and not encoder.covered else ""
        proved = f"certified{exact} ({', '.join(held)})" if held else "NOT certified"
        loop = f"{self.coupling}, theta {list(self.theta)}, psi {list(self.psi)}: {grows}, {proved}"
        return f"{self.t_s:6.2f} s  {self.event:<10} {loop}"


@dataclass(frozen=True)
class _Report:
    case: str
    scenario: str
    simulated_s: float
    clipped_ticks: int
    events: list[_Event]
    interrupted: bool
    video: dict[str, Any] | None = off_table("if given", None)  # file, number of pictures, pictures per second
    clock: dict[str, Any] | None = off_table("if given", None)  # how often, and how long, the loop was behind the clock

    def lines(self) -> Iterator[str]:
        yield from (event.line() for event in self.events)
        yield f"{self.simulated_s:6.2f} s  end        {self.clipped_ticks} ticks at a force limit"
        if torques := self.events[0].assessment.held_torques:
            yield f"Held torques: {torques}."
        if clock := self.clock:
            yield f"The loop fell behind the clock {clock['overruns']} times: {clock['lost_s']:.2f} s lost."
        if film := self.video:
            yield f"{film['file']}: {film['pictures']} pictures"


def _parser() -> options.Parser:
    keys = ", ".join(f"{name} {word}" for name, word in keys_help(with_file=True))
    parser = options.Parser(
        "sim.view",
        f"Show the loop in a window, or film it.\n\nKeys: {keys}; `given` means --coupling FILE.json.",
        *_EXAMPLES,
        first="scenario coupling condition reference video script",
    )
    add = parser.add_argument
    parser.add_loop()
    what = f"the first coupling: {', '.join(_names())} or FILE.json; designed is spring-damper"
    add("--coupling", metavar="NAME|FILE", help=what)
    parser.add_condition("condition to design for (default: that of the coupling)")
    parser.add_limiter()
    add(
        "--script",
        metavar="EVENTS",
        help=f"events SECONDS:EVENT (default for a video, except with --coupling, --case none or a world: '{_SCRIPT}')",
    )
    until = "length (default: until the window is closed, or 3 s after a video's script; the scenario's in a world)"
    add("--duration", type=options.number(1e-3, _LONGEST, "s"), metavar="SECONDS", help=until)
    parser.add_json()
    add = parser.add_argument_group("without a display").add_argument
    add("--video", metavar="FILE", help="a film: .gif, or .mp4 where ffmpeg is installed")
    rate = "pictures per second (default 10); for a .gif a divisor of 100"
    add("--fps", type=options.whole(1, 100), default=10, metavar="N", help=rate)
    parser.only("with --video", lambda args: args.video, "fps")
    return parser


def _beginning(args: argparse.Namespace, channels: int) -> tuple[str, Script]:
    """Return the first coupling's name, and the script after it. Raises InputError."""
    label = _label(args)
    usual = args.video and args.coupling is None and args.case != "none"
    text = args.script if args.script is not None else _SCRIPT if usual else None
    script = () if text is None else parse_script(text, channels)
    if script and script[0][0] == 0 and isinstance(script[0][1], Couple):
        if args.coupling is not None:
            name = script[0][1].name
            raise InputError(f"--coupling {args.coupling} with --script 0:{name}: give the first coupling once")
        return script[0][1].name, script[1:]
    return label, script


def _label(args: argparse.Namespace) -> str:
    """Return the window's name of the coupling in --coupling. Raises InputError."""
    name = args.coupling
    if args.case == "none":
        if name not in (None, "none"):
            raise InputError(f"--coupling {name} with --case none: that case is the loop without coupling")
        return "none"
    if name is None:
        return "designed"
    if (label := LABELS.get(name, name)) in COUPLINGS:
        return label
    if Path(name).suffix != ".json":
        raise InputError(f"--coupling is {name!r}, allowed are {', '.join(_names())} or a FILE.json")
    return GIVEN


def _names() -> list[str]:
    """Return the allowed names of couplings: those of other commands, and those of the window."""
    return list(dict.fromkeys([*LABELS, *COUPLINGS]))


def _check_film(path: Path, fps: int) -> None:
    """Raise InputError if a film cannot be written, before any work is done."""
    if path.suffix not in (".gif", ".mp4"):
        raise InputError(f"--video {path}: the name must end in .gif or .mp4")
    check_file("--video", path)
    if path.suffix == ".mp4" and shutil.which("ffmpeg") is None:
        raise InputError(f"--video {path}: MP4 requires ffmpeg, which is not on the PATH; install it or write a .gif")
    if path.suffix == ".gif" and 100 % fps:  # A GIF states times in hundredths of a second.
        raise InputError(f"--fps is {fps}, allowed for a .gif are the numbers that divide 100")


def _film(args: argparse.Namespace, session: LiveLoop) -> dict[str, Any]:
    """Film the session in simulated time, so that the film is reproducible. Return fields of the report."""
    from haptic_loop.sim.view.stage import pictures_for, save_film

    seconds = args.duration or (session.script_ends + _AFTER)
    count, interrupted = round(seconds * args.fps) + 1, False
    artist = pictures_for(session)

    def pictures(move: render.Move) -> Iterator[Picture]:
        nonlocal interrupted
        for i in range(count):
            try:
                picture = artist.picture(session.frame(i / args.fps))
            except KeyboardInterrupt:
                interrupted = True
                return
            yield picture
            move(i + 1, count)

    with closing(artist), render.progress("filming") as move:
        pictures_made = save_film(Path(args.video), pictures(move), args.fps)
    return {"interrupted": interrupted, "video": {"file": args.video, "pictures": pictures_made, "fps": args.fps}}


def _window(session: LiveLoop, duration: float | None) -> dict[str, Any]:
    """Show the session in a window. Return fields of the report."""
    from haptic_loop.sim.view.stage import show, stage_for

    interrupted = False
    try:
        show(session, stage_for(session), duration)
    except KeyboardInterrupt:
        interrupted = True
    clock = {"overruns": session.pace.overruns, "lost_s": session.pace.lost}
    return {"interrupted": interrupted, "clock": clock}
