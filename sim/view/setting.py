"""A loop ready to be entered while another one runs: what a key asks for, with its growth rate and certificates."""

from __future__ import annotations

from dataclasses import dataclass

from controller.coupling import Coupling
from controller.lti import SingularLoop
from design.certificate import assess, promise_of
from design.conditions import Requirement
from design.designs import KINDS
from design.result import DesignFailed
from sim.couplings import Chosen, choose
from sim.run import Assembly, assemble
from sim.scenario import LONGEST_DELAY, InputError, Scenario
from sim.stability import Mode, worst_mode
from sim.view.events import COUPLINGS, GIVEN, Couple, Delay


@dataclass(frozen=True)
class Menu:
    """What the keys choose from."""

    case: str
    condition: str | None = None  # what a coupling is designed for, by default its own
    given: str | None = None  # the file of --coupling


@dataclass(frozen=True, eq=False)
class Setting:
    """A loop, and what can be said of it before it runs."""

    menu: Menu
    label: str  # as the user calls the coupling
    chosen: Chosen
    assembly: Assembly
    mode: Mode  # of the exact linear loop; before walls, of the worst contact state
    requirements: dict[str, Requirement]
    promise: str | None

    @property
    def scenario(self) -> Scenario:
        return self.assembly.scenario

    @property
    def coupling(self) -> Coupling:
        return self.chosen.coupling


def first_setting(menu: Menu, scenario: Scenario, label: str) -> Setting:
    """The loop to begin with. Raises InputError, DesignFailed or SingularLoop."""
    return _setting(menu, scenario, label, _choose(menu, scenario, label))


def changed(setting: Setting, event: Couple | Delay) -> Setting:
    """The loop after an event. Raises InputError, DesignFailed or SingularLoop; the old loop can go on."""
    if isinstance(event, Couple):
        chosen = _choose(setting.menu, setting.scenario, event.name)
        return _setting(setting.menu, setting.scenario, event.name, chosen)
    delays = tuple(n + event.samples for n in getattr(setting.scenario, event.which))
    if not 0 <= min(delays) <= max(delays) <= LONGEST_DELAY:
        raise InputError(f"{event.which} would be {list(delays)}, allowed are 0 to {LONGEST_DELAY} samples")
    scenario = setting.scenario.replace(None, **{event.which: delays})
    return _setting(setting.menu, scenario, setting.label, setting.chosen)


def attempt(setting: Setting, event: Couple | Delay) -> Setting | str:
    """The loop after an event, or why there is none."""
    try:
        return changed(setting, event)
    except (InputError, DesignFailed, SingularLoop) as error:
        return " ".join(str(error).split())


def _choose(menu: Menu, scenario: Scenario, label: str) -> Chosen:
    if label == GIVEN:
        if menu.given is None:
            raise InputError("there is no coupling from a file (start with --coupling FILE.json)")
        return choose(scenario, menu.case, menu.given)
    name = COUPLINGS[label]
    return choose(scenario, menu.case, name, menu.condition if name in KINDS else None)


def _setting(menu: Menu, scenario: Scenario, label: str, chosen: Chosen) -> Setting:
    assembly, loop = assemble(scenario, chosen.coupling), scenario.loop(menu.case)
    requirements = assess(loop, chosen.coupling, chosen.phi)
    return Setting(menu, label, chosen, assembly, worst_mode(assembly), requirements, promise_of(requirements, loop))
