"""Whether a device does what it was told: its state, and the force that it says it applies.

Docs/protocol.md leaves a conforming device no choice: in ARMED it moved from its last force towards the one for this
tick, within slew and growing cap; in HOLDING it kept the last one; in DISARMED there is none.
"""

from __future__ import annotations

from hw.device import cap_after, limited
from hw.frame import Config, State
from hw.message import Phase
from hw.safety import DRIVING, Fault, Stage

REMEMBERED = 64  # forces on their way, of which at most theta matter
TOLERANCE = 1  # [steps] for a firmware that rounds otherwise
PATIENCE = 5  # ticks in a row
FORGETTING = 8  # right ticks that make up for a wrong one: seldom wrong is stopped too, just later


def check_state(state: State, config: Config, stage: Stage, gain: float) -> None:
    """Raise Fault where the device is where it may not be, or has a force that nobody can have asked for."""
    strongest = max(abs(a) - c for a, c in zip(state.applied, config.cap, strict=True))
    if strongest > 0:
        raise Fault(f"the device applies {state.applied} steps, the cap is {config.cap}")
    if state.phase in (Phase.STOPPED, Phase.RAMP, Phase.SILENT):
        raise Fault(f"the device is in {state.phase.name.lower()}, cause {state.cause.name.lower()}")
    armed = state.phase in (Phase.ARMED, Phase.HOLDING)
    if armed and stage not in DRIVING:
        raise Fault("the device is armed, and nobody asked it to")
    if not armed and (stage in (Stage.ARMED, Stage.DISARMING) or gain > 0):
        raise Fault("the device has disarmed itself")
    if not armed and any(state.applied):
        raise Fault(f"the device is disarmed and applies {state.applied} steps")


class Told:
    """The forces that a device was told, and whether it applies them."""

    def __init__(self, config: Config) -> None:
        self._config = config
        self._forces: dict[int, tuple[int, ...]] = {}  # by the tick that they are for
        self._last: State | None = None
        self._run = (0, 0)  # fewest and most forces latched since arming, where STATEs were lost
        self._unlike = self._holding = 0

    def tell(self, tick: int, steps: tuple[int, ...]) -> None:
        """`steps` answer `tick`."""
        self._forces[(tick + self._config.theta) & 0xFFFF] = steps
        if len(self._forces) > REMEMBERED:
            self._forces.pop(next(iter(self._forces)))

    def unlike(self, state: State, ticks: int) -> bool:
        """Whether the device applies what it cannot have been told; a STATE after a gap is not judged.

        Raises Fault where that goes on.
        """
        self._holding = self._holding + 1 if state.phase == Phase.HOLDING else 0
        if self._holding > self._config.hold:
            raise Fault(f"the device holds a force for {self._holding} ticks, {self._config.hold} are agreed")
        told, last = self._forces.pop(state.tick, None), self._last
        self._last = state
        if last is None or state.phase == Phase.DISARMED:
            return False
        if last.phase != Phase.DISARMED:
            fewest, most = self._run
            self._run = (fewest + (state.phase == Phase.ARMED), most + ticks)
        if ticks > 1:
            return False
        wrong = not self._could(state, last.applied, told)
        self._unlike = max(0, self._unlike + (FORGETTING if wrong else -1))
        if self._unlike > FORGETTING * (PATIENCE - 1):
            what = f"told {told}" if state.phase == Phase.ARMED else f"to hold {last.applied}"
            raise Fault(f"the device applies {state.applied} steps, it was {what}, and so for {PATIENCE} ticks")
        return wrong

    def _could(self, state: State, last: tuple[int, ...], told: tuple[int, ...] | None) -> bool:
        if state.phase == Phase.HOLDING:
            return state.applied == last
        if told is None:
            return False
        config = self._config
        for force, before, asked, cap, slew in zip(state.applied, last, told, config.cap, config.slew, strict=True):
            may = [limited(asked, before, cap_after(config, cap, run), slew) for run in self._run]
            if not min(may) - TOLERANCE <= force <= max(may) + TOLERANCE:
                return False
        return True
