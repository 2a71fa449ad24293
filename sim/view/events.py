"""What may happen to a running loop, by a key or by a script, and the loop that comes of it, with its certificates."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

from controller.coupling import Coupling
from design.certificate import assess
from design.conditions import Condition
from design.coverage import Limits
from design.designs import KINDS, name_and_own
from design.guarantees import guarantee_of
from design.result import Chosen, Requirement
from sim.couplings import NAMES, choose, limits_of
from sim.run import Simulation, assemble
from sim.scenario import LONGEST_DELAY, InputError, Scenario
from sim.stability import Mode, worst_mode

#: what a user calls a coupling -> what sim.couplings calls it
COUPLINGS = {"designed" if name == "spring-damper" else name: name for name in NAMES}
#: the other way round: a user may say it as the other commands do
LABELS = {kind: label for label, kind in COUPLINGS.items()}
GIVEN = "given"  # the coupling of --coupling FILE.json
_STRONGEST = 100.0  # [N] a push


@dataclass(frozen=True)
class Couple:
    """Another coupling, made for the delays as they are now."""

    name: str  # one of COUPLINGS, or GIVEN


@dataclass(frozen=True)
class Delay:
    """More or fewer samples of delay on every channel; the coupling stays as it is."""

    which: str  # theta or psi
    samples: int


@dataclass(frozen=True)
class Push:
    """A force on a handle, until the next one."""

    channel: int  # counted from 1
    force: float  # [N]


@dataclass(frozen=True)
class Restart:
    """The plant and the process from rest."""


Event = Couple | Delay | Push | Restart

#: GLFW's key codes, left free by the viewer itself: 0 to 5 and the letters show and hide parts of the scene
KEYS: dict[int, tuple[str, Event]] = {
    ord("6"): ("6", Couple("none")),
    ord("7"): ("7", Couple("published")),
    ord("8"): ("8", Couple("designed")),
    ord("9"): ("9", Couple("optimal")),
    260: ("Insert", Couple(GIVEN)),
    265: ("Up", Delay("theta", 1)),
    264: ("Down", Delay("theta", -1)),
    268: ("Home", Delay("psi", 1)),
    269: ("End", Delay("psi", -1)),
    259: ("Backspace", Restart()),
}

Script = tuple[tuple[float, Event], ...]  # (time [s], event), in order of time


def parse_script(text: str, channels: int) -> Script:
    """'0:none 5:designed 7:theta+1 8:push1=3' as events in order of time. Raises InputError."""
    script = []
    for entry in text.split():
        when, colon, what = entry.partition(":")
        time = _number(when)
        if not colon or not 0 <= time <= 3600:
            raise InputError(f"--script: {entry!r}, expected SECONDS:EVENT with 0 to 3600 s")
        script.append((time, _event(entry, what, channels)))
    if not script:
        raise InputError("--script is empty, expected entries like 0:none 5:designed")
    return tuple(sorted(script, key=lambda item: item[0]))


def words(event: Event) -> str:
    """The event as a script spells it."""
    match event:
        case Couple(name):
            return name
        case Delay(which, samples):
            return f"{which}{samples:+d}"
        case Push(channel, force):
            return f"push{channel}={force:g}"
        case Restart():
            return "restart"


def _event(entry: str, what: str, channels: int) -> Event:
    if (label := LABELS.get(what, what)) in (*COUPLINGS, GIVEN):
        return Couple(label)
    if what == "restart":
        return Restart()
    if delay := re.fullmatch(r"(theta|psi)([+-]\d{1,4})", what):
        return Delay(delay[1], int(delay[2]))
    if push := re.fullmatch(r"push(\d{1,3})=([+-]?[\d.]+)", what):
        channel, force = int(push[1]), _number(push[2])
        if 1 <= channel <= channels and abs(force) <= _STRONGEST:
            return Push(channel, force)
        raise InputError(f"--script: {entry!r}, allowed are push1 to push{channels} with up to {_STRONGEST:g} N")
    allowed = ", ".join((*COUPLINGS, GIVEN, "theta+1", "theta-1", "psi+1", "psi-1", "push1=3", "restart"))
    raise InputError(f"--script: {entry!r} is no event, allowed are {allowed}")


def _number(text: str) -> float:
    """What the text says, infinite where it is no number: that is never allowed."""
    try:
        return float(text)
    except ValueError:
        return math.inf


# ----------------------------------------------------------------------------------------------------
# A loop ready to be entered while another one runs: what a key asks for, with its growth rate and certificates.


@dataclass(frozen=True)
class Menu:
    """What the keys choose from."""

    case: str
    condition: str | Condition | None = None  # what a coupling is designed for, by default its own
    given: str | None = None  # the file of --coupling
    limiter: bool | None = None  # False: forces are clipped


@dataclass(frozen=True, eq=False)
class PreparedLoop:
    """A loop, and what can be said of it before it runs."""

    menu: Menu
    label: str  # as the user calls the coupling
    chosen: Chosen
    simulation: Simulation
    mode: Mode  # of the exact linear loop; before walls, of the worst contact state
    requirements: dict[str, Requirement]
    guarantee: str | None
    limits: Limits

    @property
    def scenario(self) -> Scenario:
        return self.simulation.scenario

    @property
    def coupling(self) -> Coupling:
        return self.chosen.coupling


def first_loop(menu: Menu, scenario: Scenario, label: str) -> PreparedLoop:
    """The loop to begin with. Raises InputError, DesignFailed or SingularLoop."""
    return _prepare(menu, scenario, label, _choose(menu, scenario, label))


def changed(prepared: PreparedLoop, event: Couple | Delay) -> PreparedLoop:
    """The loop after an event. Raises InputError, DesignFailed or SingularLoop; the old loop can go on."""
    if isinstance(event, Couple):
        chosen = _choose(prepared.menu, prepared.scenario, event.name)
        return _prepare(prepared.menu, prepared.scenario, event.name, chosen)
    delays = tuple(n + event.samples for n in getattr(prepared.scenario, event.which))
    if not 0 <= min(delays) <= max(delays) <= LONGEST_DELAY:
        raise InputError(f"{event.which} would be {list(delays)}, allowed are 0 to {LONGEST_DELAY} samples")
    scenario = prepared.scenario.replace(None, **{event.which: delays})
    return _prepare(prepared.menu, scenario, prepared.label, prepared.chosen)


def _choose(menu: Menu, scenario: Scenario, label: str) -> Chosen:
    if label == GIVEN:
        if menu.given is None:
            raise InputError("there is no coupling from a file (start with --coupling FILE.json)")
        return choose(scenario, menu.case, menu.given, name_and_own(menu.condition)[1])
    name, (_, own) = COUPLINGS[label], name_and_own(menu.condition)
    return choose(scenario, menu.case, name, menu.condition if name in KINDS else own, menu.limiter)


def _prepare(menu: Menu, scenario: Scenario, label: str, chosen: Chosen) -> PreparedLoop:
    loop = scenario.loop(menu.case)
    requirements = assess(loop, chosen.coupling, chosen.phi, own=chosen.own)
    limits = limits_of(scenario, chosen, requirements, menu.limiter)
    simulation, guarantee = assemble(scenario, chosen.coupling, limits.rho), guarantee_of(requirements, loop)
    return PreparedLoop(menu, label, chosen, simulation, worst_mode(simulation), requirements, guarantee, limits)
