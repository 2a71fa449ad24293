"""Options that several commands share, the types of their values, exit codes, and one-line errors for bad input.

A type parses the text of one option; its error names the value and the allowed values, and `Parser` adds the option's
name.
"""

from __future__ import annotations

import argparse
import difflib
import math
import re
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn, TypeVar

import msgspec

from haptic_loop.controller.delay import LOST, Periods, VaryingDelay
from haptic_loop.controller.loop import DelayRange, DeviceBounds, Loop
from haptic_loop.controller.units import set_unit
from haptic_loop.design.files import check_file, folder, read_text
from haptic_loop.design.own import called, named, place_of
from haptic_loop.design.result import CONDITIONS, DesignFailed
from haptic_loop.models.device import MOST_DAMPING
from haptic_loop.sim.scenario import (
    CASES,
    DEFAULT,
    InputError,
    Scenario,
    built_in,
    held_by,
    is_world,
    load,
    own_environment,
    world_environment,
)

if TYPE_CHECKING:
    from haptic_loop.design.conditions import Condition

DONE, DOES_NOT_HOLD, BAD_INPUT, UNFINISHED, INTERRUPTED = 0, 1, 2, 3, 130  # exit codes

_Number = TypeVar("_Number", int, float)
_Given = TypeVar("_Given")
_Group = argparse._ActionsContainer
_CHOICE = re.compile(r"argument ([\w-]+): invalid choice: (.*) \(choose from (.*)\)")  # argparse's message
_OWN_WORDS = re.compile(r"argument ([\w-]+): ((?:is|has) .*)", re.DOTALL)  # messages of the option types below


class Parser(argparse.ArgumentParser):
    """An argparse parser with one-line errors; --help begins with the options in `first` and ends with examples."""

    def __init__(self, prog: str, description: str, *examples: str, first: str = "") -> None:
        super().__init__(
            prog=f"python -m {prog}",
            description=description,
            epilog="examples:\n" + "\n".join(f"  {example}" for example in examples),
            formatter_class=argparse.RawDescriptionHelpFormatter,
            allow_abbrev=False,
        )
        self._first = first.split()
        self._only: list[tuple[str, Callable[[argparse.Namespace], Any], tuple[str, ...]]] = []

    def only(self, where: str, acts: Callable[[argparse.Namespace], Any], *names: str) -> None:
        """Refuse the options `names`, with an error that ends in `where`, unless `acts` is true for the arguments."""
        self._only.append((where, acts, names))

    def refuse(self, where: str, *names: str) -> None:
        """Always refuse the options `names`, and leave them out of --help."""
        self.only(where, lambda args: False, *names)
        for action in self._actions:
            if action.dest in names:
                action.help = argparse.SUPPRESS

    def format_help(self) -> str:
        arguments = [action for action in self._actions if not action.option_strings]
        by_name = {name.removeprefix("--"): action for action in self._actions for name in action.option_strings}
        first = [by_name[name] for name in self._first]
        text = self._get_formatter()
        text.add_usage(" ".join([self.prog, *(str(a.metavar) for a in arguments), "[options]"]), [], [])
        text.add_text(self.description)
        for title, actions in (
            ("arguments", arguments),
            ("first options", first),
            *((group.title, group._group_actions) for group in self._action_groups),
        ):
            shown = [a for a in actions if actions is first or actions is arguments or a not in (*first, *arguments)]
            text.start_section("more options" if title == "options" and first else title)
            text.add_arguments(shown)
            text.end_section()
        text.add_text(self.epilog)
        return text.format_help()

    def parse_known_args(self, *args: Any, **how: Any) -> Any:  # argparse's parse_args calls this
        """Parse options. Raises InputError for unknown or excluded ones, empty values, or an impossible --json file."""
        self._words = args[0] if args else None
        parsed, rest = super().parse_known_args(*args, **how)
        if rest:
            is_option, help_ = rest[0].startswith("-"), "--help lists the options"
            near = self._near(rest[0]) if is_option or f"--{rest[0]}" in self._option_string_actions else ""
            if re.fullmatch(r"[\d.][\d.,e+-]*", rest[0]):
                help_ = "several numbers are written with commas, as 1,2,3"
            raise InputError(f"{'unknown option' if is_option else 'unexpected word'} {rest[0]}{near} ({help_})")
        if "reference" in parsed:
            _translate(parsed)
        if ":" in (getattr(parsed, "condition", None) or ""):
            parsed.condition = own_condition(parsed.condition)
        for action in self._actions:
            if getattr(parsed, action.dest, None) == "":
                raise InputError(f"{action.option_strings[-1] if action.option_strings else action.dest} is empty")
        for where, acts, names in self._only:
            for name in names if not acts(parsed) else ():
                if getattr(parsed, name) != self.get_default(name):
                    option = next(a.option_strings[-1] for a in self._actions if a.dest == name and a.option_strings)
                    raise InputError(f"{option} is allowed only {where}")
        if getattr(parsed, "json", None) not in (None, "-"):
            check_file("--json", Path(parsed.json), "a file or -")
        return parsed, rest

    def _near(self, word: str) -> str:
        known = [name for action in self._actions if action.help != argparse.SUPPRESS for name in action.option_strings]
        return did_you_mean(word.partition("=")[0], known)

    def error(self, message: str) -> NoReturn:
        """Raise InputError with a message in the unit of --scenario, metres or radians."""
        scenarios = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
        scenarios.add_argument("--scenario", default=DEFAULT)
        with suppress(argparse.ArgumentError, InputError):
            set_unit(load(scenarios.parse_known_args(self._words)[0].scenario).unit)
        if choice := _CHOICE.fullmatch(message):
            allowed = choice[3].replace("'", "")
            raise InputError(f"{choice[1]} is {choice[2]}, allowed are {allowed}")
        own = _OWN_WORDS.fullmatch(message)
        raise InputError(f"{own[1]} {own[2]}" if own else f"{message} (--help lists the options)")

    # options of several commands

    def add_loop(self) -> None:
        loop = self.add_argument_group("the loop")
        reference = "the ideal that a coupling is compared with: I with the loop's delays (default), II without delay"
        loop.add_argument("--reference", choices=("I", "II"), help=reference)
        paper = "short names: I and II mean --reference I and II, none means --coupling none"
        loop.add_argument("--case", choices=CASES, help=paper)
        names = ", ".join(built_in())
        loop.add_argument("--scenario", default=DEFAULT, metavar="FILE.toml", help=f"a file, or one of: {names}")
        own = "your own environment in place of the scenario's: a Network, or a class with contacts and E(T) or parts()"
        loop.add_argument("--environment", metavar="FILE.py:NAME", help=own)
        for name, what in (("theta", "transmission"), ("psi", "environment"), ("lam", "reference")):
            what = f"{what} delay of each device [samples], or one for all"
            loop.add_argument(f"--{name}", type=several(int), metavar="N,N,..", help=what)
        damping, what = (
            several(float, 0, MOST_DAMPING, "N s/m"),
            "guaranteed damping of each device [N s/m], or one for all",
        )
        loop.add_argument("--delta", type=damping, metavar="D,D,..", help=what)
        loop.add_argument("--T", type=number(), metavar="SECONDS", help="sampling period [s]")
        longest = (
            "longest period [s], if periods vary: certificates cover all up to it (known-device: from the scenario's "
        )
        longest += "T_min up to it)"
        loop.add_argument("--T-max", type=number(), metavar="SECONDS", help=longest)
        known = (
            "guaranteed bounds: least motor mass [kg], and largest stiffness [N/m], least damping and largest damping "
            "[N s/m] of the transmission"
        )
        loop.add_argument(
            "--known-device",
            type=_known_device,
            action="append",
            metavar="MASS,K_MAX,B_MIN,B_MAX",
            help=f"{known}; once for all devices, or once per device",
        )
        late = "time [s] from a tick until the device applies its force, below T: LO:HI, or S for 0:S; one for all or "
        late += "one per device"
        loop.add_argument("--latency", type=_latency_ranges, metavar="S", help=late)

    def add_coupling(self, names: str) -> None:
        what = f"{names}, FILE.json or FILE.py:NAME of a function (default spring-damper; moving-average in a world)"
        self.add_argument("--coupling", metavar="NAME|FILE", help=what)
        self.add_condition()

    def add_condition(
        self, what: str = "condition to certify (default: that of the coupling)", to: _Group | None = None
    ) -> None:
        help_ = f"{what}; one of {', '.join(CONDITIONS)} or FILE.py:NAME of your own"
        (to or self).add_argument("--condition", type=condition, metavar="NAME|FILE.py:NAME", help=help_)

    def add_limiter(self, what: str = "clip forces at the devices' limits", to: _Group | None = None) -> None:
        """Add --no-limiter, which sets `limiter` to False instead of None."""
        help_ = f"{what}, without the limiter and its guarantee"
        (to or self).add_argument("--no-limiter", dest="limiter", action="store_const", const=False, help=help_)

    def add_rigid(self) -> None:
        wall = "a rigid wall in place of the environment; one channel, the scenario's first"
        self.add_argument("--rigid", action="store_true", help=wall)
        replaced = "without --rigid, whose wall replaces the environment and the reference"
        self.only(replaced, lambda args: not args.rigid, "environment", "lam")

    def add_human(self, more: str = "") -> None:
        """Add --human; `more` says what a .py file may contain besides a list of hands."""
        who = f"other humans: one [[human]] per device in a .toml, or a list of hands{more or ' in a .py'}"
        self.add_argument("--human", metavar="FILE.toml|FILE.py:NAME", help=who)

    def add_energy_budget(self) -> None:
        what = "scale forces: passive hands get at most W0 [J] beyond what devices dissipate; CAP [J] limits the budget"
        self.add_argument("--energy-budget", type=_energy_budget, metavar="W0[,CAP]", help=what)

    def add_band(self, to: _Group | None = None) -> None:
        band = "frequencies over which the transparency error counts [Hz] (default 0.5,80)"
        (to or self).add_argument("--band", dest="band_hz", type=_band_of, metavar="LOW,HIGH", help=band)

    def add_varying_delay(self, what: str, to: _Group | None = None) -> None:
        (to or self).add_argument("--varying-delay", type=_delay_ranges, metavar="LO,HI", help=what)

    def add_varying_delays(self) -> None:
        group = self.add_argument_group("delays and periods that vary")
        periods = "periods [s]: random between MIN and MAX at every tick, or a file of recorded periods"
        group.add_argument("--period", metavar="MIN,MAX|FILE", help=periods)
        span = "range of the forces' delays [samples]; or LO-HI,LO-HI,.. per channel"
        self.add_varying_delay(span, group)
        pattern = f"how delays vary: {', '.join(_DRAWN)} (default random), or a file of recorded delays, a row per tick"
        group.add_argument("--pattern", metavar="NAME|FILE", help=pattern)
        loss = "probability that a force is lost; the device then holds the last force"
        group.add_argument("--loss", type=number(), metavar="P", help=loss)
        group.add_argument("--playout", action="store_true", help="a buffer that gives every force the largest delay")
        alike = "as a FILE with --playout: the buffer gives every force the largest delay"
        self.only(alike, lambda args: not args.playout or args.pattern not in _DRAWN, "pattern")

    def add_output(
        self,
        out: str = "DIR",
        what: str = "folder for files, created if missing "
        "(default out/<command>-<case or scenario>[-<coupling>][-<condition>])",
        picture: bool = False,
        seed: bool = True,
    ) -> None:
        output = self.add_argument_group("output")
        if picture:
            output.add_argument("--no-plot", action="store_true", help="write no picture")
        self.add_json(output)
        output.add_argument("--out", metavar=out, help=what)
        if seed:
            drawn = "seed of random draws, stored in the report (default 0)"
            output.add_argument("--seed", type=whole(0), metavar="N", default=0, help=drawn)

    def add_details(self) -> None:
        what = "also print what no certificate covers, and for a run its speed and position error"
        self.add_argument("--details", action="store_true", help=what)

    def add_json(self, to: _Group | None = None) -> None:
        (to or self).add_argument("--json", metavar="FILE|-", help="machine-readable result; - is standard output")


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """Return ", did you mean ..?" with the closest of the known words, or ""."""
    bare = {name.lstrip("-"): name for name in known}
    close = difflib.get_close_matches(word.lstrip("-"), list(bare), n=1)
    return f", did you mean {bare[close[0]]}?" if close else ""


def _translate(args: argparse.Namespace) -> None:
    """Set `case` from --reference or --case. Raises InputError for a contradiction."""
    if args.reference and args.case and args.reference != args.case:
        remedy = "replace --case none by --coupling none" if args.case == "none" else "give one of them"
        raise InputError(f"--reference {args.reference} with --case {args.case}: {remedy}")
    args.case = args.case or args.reference or "I"


# ---- types of options


def _one(
    kind: Callable[[str], _Number], least: float = -math.inf, most: float = math.inf, unit: str = ""
) -> Callable[[str], _Number]:
    """Return a parser of one number within these limits."""

    def read(text: str) -> _Number:
        try:
            value = kind(text)
        except ValueError:
            what = "a whole number" if kind is int else "a number"
            raise argparse.ArgumentTypeError(f"is {text!r}, expected {what}") from None
        return _within(value, least, most, unit)

    return read


number, whole = partial(_one, float), partial(_one, int)  # (least, most, unit)


def several(
    kind: Callable[[str], _Number], least: float = -math.inf, most: float = math.inf, unit: str = ""
) -> Callable[[str], tuple[_Number, ...]]:
    """Return a parser of numbers within these limits, separated by commas."""
    expected = f"{'whole numbers' if kind is int else 'numbers'} separated by commas"

    def read(text: str) -> tuple[_Number, ...]:
        return tuple(_within(value, least, most, unit) for (value,) in _parts(text, kind, expected))

    return read


def _parts(text: str, kind: Callable[[str], _Number], expected: str, within: str = "") -> list[list[_Number]]:
    """Split at commas, and each part at `within`; return the numbers of each part."""
    try:
        return [[kind(word) for word in (part.split(within) if within else [part])] for part in text.split(",")]
    except ValueError:
        raise argparse.ArgumentTypeError(f"is {text!r}, expected {expected}") from None


def pair(text: str) -> tuple[float, float]:
    """Parse two numbers separated by a comma. Raises ArgumentTypeError."""
    numbers = _parts(text, float, expected := "two numbers separated by a comma")
    if len(numbers) != 2:
        raise argparse.ArgumentTypeError(f"is {text!r}, expected {expected}")
    return numbers[0][0], numbers[1][0]


def _band_of(text: str) -> tuple[float, float]:
    low, high = pair(text)
    if not 0 < low < high < math.inf:
        raise argparse.ArgumentTypeError(f"is {text!r}, expected two rising frequencies in Hz, the first above 0")
    return low, high


def _energy_budget(text: str) -> tuple[float, float]:
    """Parse 'W0' or 'W0,CAP' [J], the initial energy of a budget and its largest value (inf without a cap)."""
    values = several(float, 0, unit="J")(text)
    start, cap = (*values, math.inf)[:2]
    if len(values) > 2 or not start <= cap or start == math.inf:
        raise argparse.ArgumentTypeError(f"is {text!r}, expected W0 or W0,CAP in J, W0 finite and at most CAP")
    return start, cap


def _delay_ranges(text: str) -> tuple[tuple[int, int], ...]:
    """Parse '1,2' as one range [samples] for all channels, '1-2,0-3' as one range for each channel or device."""
    parts = _parts(text, int, expected := "LO,HI or LO-HI,LO-HI,.. in whole samples", "-")
    if [len(part) for part in parts] == [1, 1]:
        parts = [(parts[0][0], parts[1][0])]
    if any(len(part) != 2 for part in parts):
        raise argparse.ArgumentTypeError(f"is {text!r}, expected {expected}")
    for i, (lo, hi) in enumerate(parts, start=1):
        if not 0 <= lo <= hi:
            channel = f" in range {i}" if len(parts) > 1 else ""
            raise argparse.ArgumentTypeError(f"is {text!r}, expected 0 <= LO <= HI{channel}")
    return tuple((lo, hi) for lo, hi in parts)


def _latency_ranges(text: str) -> tuple[tuple[float, float], ...]:
    """Parse '130e-6' as 0 to 0.13 ms, '100e-6:130e-6' as a range [s]; one range for all devices or one for each."""
    parts = _parts(text, float, expected := "S or LO:HI in seconds, one for all or one per device", ":")
    if any(len(part) > 2 for part in parts):
        raise argparse.ArgumentTypeError(f"is {text!r}, expected {expected}")
    return tuple((0.0, part[0]) if len(part) == 1 else (part[0], part[1]) for part in parts)


def condition(text: str) -> str:
    """Return the text if it is the name of a condition, or has the form FILE.py:NAME."""
    if text not in CONDITIONS and ":" not in text:
        raise argparse.ArgumentTypeError(f"is {text!r}, allowed are {', '.join(CONDITIONS)} and FILE.py:NAME")
    return text


def own_condition(text: str) -> Condition:
    """Load a user's own condition from FILE.py:NAME. Raises InputError."""
    from haptic_loop.design.certificate import named as checked
    from haptic_loop.design.conditions import Condition

    loaded = named("--condition", text)
    condition = called(f"--condition {text}", loaded) if isinstance(loaded, type) else loaded
    if not isinstance(condition, Condition):
        raise InputError(f"--condition {text} is {condition!r}, expected a design.conditions.Condition")
    with refused(f"--condition {text}: "):
        return checked(condition)


def _within(value: _Number, least: float, most: float, unit: str) -> _Number:
    if least <= value <= most:  # False for nan
        return value
    shown, low, high = (str(n) if isinstance(n, int) else f"{n:g}" for n in (value, least, most))
    span = f"{low} to {high}" if most < math.inf else f"numbers from {low}" if least > -math.inf else "finite numbers"
    unit = f" {unit}" if unit and not unit.startswith(",") else unit
    raise argparse.ArgumentTypeError(f"is {shown}, allowed are {span}{unit}")


def given(value: Any) -> bool:
    """Return whether an option has a value other than None and False."""
    return value is not None and value is not False


@contextmanager
def refused(name: str = "", args: argparse.Namespace | None = None) -> Iterator[None]:
    """Turn a ValueError or ArithmeticError into InputError, with `name` in front of its message.

    InputError, DesignFailed and errors raised in a user's own code are raised again unchanged. If the message begins
    with the name of an argument in `args`, the option's name replaces it.
    """
    try:
        yield
    except (InputError, DesignFailed):
        raise
    except (ValueError, ArithmeticError) as error:
        if place_of(error):
            raise
        text = str(error)
        argument = text.partition(" ")[0]
        if given(getattr(args, argument, None)):
            text = f"--{argument.replace('_', '-')}{text[len(argument) :]}"
        raise InputError(f"{name}{text}") from None


def per_channel(
    option: str, values: tuple[_Given, ...], channels: int, what: str = "entries", each: str = "channel"
) -> tuple[_Given, ...]:
    """Return one value for each channel (or device); a single value is repeated. Raises InputError."""
    values = values * channels if len(values) == 1 else values
    if len(values) != channels:
        expected = "one" if channels == 1 else f"{channels} (one per {each}) or 1"
        raise InputError(f"{option} has {len(values)} {what}, expected {expected}")
    return values


def delay_range(pairs: tuple[tuple[int, int], ...], loop: Loop, most: int) -> DelayRange:
    """Convert the ranges of --varying-delay: one for all, one per device, or one per channel. Raises InputError."""
    if loop.axes and len(pairs) == len(loop.axes):
        pairs = loop.per_channel(pairs)
    lo, hi = zip(*per_channel("--varying-delay", pairs, loop.channels, "ranges"), strict=True)
    for i, (a, b) in enumerate(zip(lo, hi, strict=True), start=1):
        if not 0 <= a <= b <= most:
            spans = ",".join(f"{a}-{b}" for a, b in pairs)
            raise InputError(f"--varying-delay is {spans}, expected 0 <= LO <= HI <= {most} samples for channel {i}")
    return DelayRange(lo, hi)


def numbers(option: str, text: str, kind: Callable[[str], _Number], count: int) -> tuple[_Number, ...]:
    """Parse `count` numbers; a single number is repeated. Raises InputError, whose message names `option`."""
    try:
        if count == 1 and "," not in text:
            return (_one(kind)(text),)
        return per_channel(option, several(kind)(text), count)
    except argparse.ArgumentTypeError as error:
        raise InputError(f"{option} {error}") from None


# ---- scenarios, loops and files from options


def scenario_from(args: argparse.Namespace) -> Scenario:
    """Return the scenario that the loop options describe. Raises InputError."""
    scenario = load(args.scenario)
    set_unit(scenario.unit)
    if (args.reference or args.case == "II") and (args.lam or scenario.lam is not None):
        option = f"--reference {args.reference}" if args.reference else "--case II"
        raise InputError(f"{option} with {'--lam' if args.lam else 'lam of the scenario'}: both set the reference")
    if is_world(scenario) or getattr(args, "world", None):
        require_no_reference(args, "in a MuJoCo scene no transparency error is computed")
    elif getattr(args, "rigid", False):
        require_no_reference(args, "the rigid wall replaces the reference")
    names = ("theta", "psi", "lam", "latency", "delta", "T", "T_max")
    each = "channel" if scenario.channels == len(scenario.device) else "device"
    values = {name: getattr(args, name) for name in names if getattr(args, name) is not None}
    changes: dict[str, Any] = {
        name: value if name in ("T", "T_max") else per_channel(f"--{name}", value, len(scenario.device), each=each)
        for name, value in values.items()
    }
    if args.environment is not None:
        changes["environment"] = own_environment(args.environment)
    if args.known_device:
        bounds = per_channel("--known-device", args.known_device, len(scenario.device), each=each)
        with refused("--known-device: "):
            pairs = zip(scenario.device, bounds, strict=True)
            changes["device"] = tuple(msgspec.structs.replace(one, guaranteed=bound) for one, bound in pairs)
    return scenario.replace(**changes) if changes else scenario


def require_no_reference(args: argparse.Namespace, why: str) -> None:
    """Raise InputError for --reference II, --case II or --lam; `why` says why the option has no effect."""
    for option, chosen in (
        ("--lam", args.lam),
        ("--reference II", args.reference == "II"),
        ("--case II", args.case == "II"),
    ):
        if chosen:
            raise InputError(f"{option}: {why}; leave it out")


def _known_device(text: str) -> DeviceBounds:
    values = several(float)(text)
    if len(values) != 4:
        raise argparse.ArgumentTypeError(f"is {text!r}, expected MASS,K_MAX,B_MIN,B_MAX")
    try:
        return DeviceBounds(*values)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def in_world(scenario: Scenario, file: str) -> Scenario:
    """Return the scenario with a MuJoCo scene as its environment, touched along x. Raises InputError."""
    from haptic_loop.models.world import touchable_bodies

    with refused("--world: "):
        bodies = touchable_bodies(Path(file))
    if len(bodies) != scenario.channels:
        listed = f"{len(bodies)} named bodies without a joint ({', '.join(bodies) or 'none'})"
        need = f"{scenario.name} has {scenario.channels} contact{'s' if scenario.channels > 1 else ''}"
        raise InputError(f"--world {file} has {listed}, but {need}: name contacts in a scenario, as in world-cube")
    return scenario.replace(environment=world_environment({"world": str(Path(file).resolve()), "contacts": bodies}))


def with_humans(args: argparse.Namespace, scenario: Scenario) -> Scenario:
    """Return the scenario with the humans of --human. Raises InputError."""
    return scenario if args.human is None else held_by(scenario, args.human)


def out_folder(args: argparse.Namespace, command: str) -> Path:
    """Create and return the folder for the files of a command. Raises InputError."""
    return folder(Path(args.out or f"out/{command}{f'-{place(args)}' if 'case' in args else ''}"))


def place(args: argparse.Namespace) -> str:
    """Return case or scenario, coupling and condition as a part of a file name: I-stiff for --coupling stiff.json."""
    if args.scenario == DEFAULT:
        loop = args.case
    else:
        loop = name_of(args.scenario) + ("" if args.case == "I" else f"-{args.case}")
    values = (getattr(args, option, None) for option in ("coupling", "condition"))
    return "-".join([loop, *(_in_file_names(value) for value in values if value)])


def name_of(file: str) -> str:
    """Return the name of a file without suffix, with a digest of its folder unless that is the working directory.

    The digest keeps the results of files with equal names apart.
    """
    path = Path(file)
    if path.parent.resolve() == Path.cwd():
        return path.stem
    return f"{path.stem}-{sha256(str(path.parent.resolve()).encode()).hexdigest()[:6]}"


_LONGEST = 80  # most characters of couplings or a condition in a file name; file systems allow 255 in all


def _in_file_names(value: str | tuple[str, ...] | Condition) -> str:
    """Return couplings or a condition as a part of a file name, with a digest in place of a long end."""
    names = value if isinstance(value, tuple) else (value if isinstance(value, str) else value.name,)
    words = [part for name in names for part in name.split(":")]
    parts = (name_of(word) if word.endswith((".json", ".py")) else word for word in words)
    text = re.sub(r"[^\w.-]+", "-", "-".join(parts)).strip("-.")
    return text if len(text) <= _LONGEST else f"{text[:_LONGEST]}-{sha256(text.encode()).hexdigest()[:8]}"


def rigid_loop(args: argparse.Namespace, scenario: Scenario) -> Loop:
    """Return the loop of one channel before a rigid wall. Raises InputError for values of several channels."""
    for name in ("theta", "psi", "delta", "latency", "known_device"):
        option = name.replace("_", "-")
        per_channel(f"--rigid is one channel: --{option}", tuple(getattr(args, name) or (0,)), 1)
    with refused():
        return scenario.before_a_rigid_wall(scenario.psi[:1] if args.psi else (0,))


# ---- delays that vary


_DRAWN = ("constant", "random", "bursty", "adversarial")


def with_varying_delays(args: argparse.Namespace, scenario: Scenario) -> Scenario:
    """Return the scenario with the periods and delays of the options. Raises InputError."""
    if args.period is not None:
        scenario = scenario.replace(period=_periods(args.period))
    changes: dict[str, Any] = {}
    if args.pattern is not None:
        changes |= _pattern(args.pattern, scenario.channels)
    if args.varying_delay is not None:
        per_device = len(args.varying_delay) == len(scenario.device)
        count = len(scenario.device) if per_device else scenario.channels
        pairs = per_channel("--varying-delay", args.varying_delay, count, "ranges")
        changes["lo"], changes["hi"] = zip(*pairs, strict=True)
    changes |= {name: value for name in ("loss", "playout") if given(value := getattr(args, name))}
    if not changes:
        return scenario
    if scenario.varying_delay is None and "lo" not in changes:
        if "loss" not in changes or len(changes) > 1:
            option = "--playout" if args.playout else "--pattern"
            raise InputError(f"{option} without a range of delays: give --varying-delay LO,HI")
        changes |= {"lo": scenario.theta, "hi": scenario.theta}
    with refused():
        old = scenario.varying_delay
        varying = msgspec.structs.replace(old, **changes) if old else VaryingDelay(**changes)
    theta = varying.hi if varying.playout and args.theta is None else scenario.theta
    return scenario.replace(theta=theta, varying_delay=varying)


def _periods(text: str) -> Periods:
    """Parse --period. Raises InputError."""
    with refused("--period: "):
        if "," in text and not Path(text).is_file():
            least, most = numbers("--period", text, float, 2)
            return Periods(least, most)
        rows = _rows("--period", text, float, 1, "; give MIN,MAX in seconds or a file")
        return Periods(recorded=tuple(row[0] for row in rows))


def _pattern(name: str, channels: int) -> dict[str, Any]:
    if name in _DRAWN:
        return {"pattern": name, "recorded": ()}
    rows = _rows("--pattern", name, int, channels, f"; give a file or one of: {', '.join(_DRAWN)}")
    arrived = [[n for n in column if n != LOST] or [0] for column in zip(*rows, strict=True)]
    lo, hi = (tuple(side(column) for column in arrived) for side in (min, max))
    return {"pattern": "recorded", "recorded": rows, "lo": lo, "hi": hi}


def _rows(
    option: str, path: str, kind: Callable[[str], _Number], columns: int, hint: str
) -> tuple[tuple[_Number, ...], ...]:
    """Read rows of numbers, separated by commas or blanks, from a file; # begins a comment. Raises InputError.

    A row with a single number stands for equal numbers in all columns.
    """
    rows = []
    for n, line in enumerate(read_text(path, f"{option} {path}", hint).splitlines(), start=1):
        if words := line.split("#")[0].replace(",", " ").split():
            rows.append(numbers(f"{option} {path}, line {n}:", ",".join(words), kind, columns))
    if not rows:
        raise InputError(f"{option} {path}: holds no numbers")
    return tuple(rows)


def exit_code(holds: bool, interrupted: bool = False) -> int:
    """Return the exit code of a command that has printed its report."""
    return INTERRUPTED if interrupted else DONE if holds else DOES_NOT_HOLD
