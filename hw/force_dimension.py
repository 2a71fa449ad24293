"""Drive Force Dimension devices, which have no clock, through the maker's library and its Python package.

The host is the clock: it reads the position, computes a force and writes it. The force acts at once, a fraction of a
period after the sample (theta = 0). The certificate covers the periods and latencies that the host measures at zero
force.
"""

from __future__ import annotations

import math
import re
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, redirect_stderr
from importlib import import_module
from io import StringIO
from itertools import combinations
from typing import Any, Self

from haptic_loop.hw import protocol as wire
from haptic_loop.hw.device_state import RUNNING, Device
from haptic_loop.hw.emulator import info_of
from haptic_loop.hw.haptic_device import PortLost
from haptic_loop.sim.scenario import InputError, Scenario

FORCE_DIMENSION = "force-dimension"  # value of --port for these devices
_PACKAGE = "forcedimension_core"
_SATURATED = 2  # code that setForce returns when the motors cannot make the force
_WATCHDOG = 160  # [125 us] 20 ms: a device with a watchdog drops a force if no new force comes in this time
_SPIN = 2e-4  # [s] last part of a wait, in which the host does not sleep, because a sleep ends late
_COUNTS = 2**31  # a position in counts fits into 32 bits
_SHORTEST = 0.75  # after a late tick, the next tick comes no earlier than this share of T


class _Library:
    """Look up the package's calls, some of which are in a module for experts. The calls return -1 for an error."""

    def __init__(self) -> None:
        self._modules = import_module(f"{_PACKAGE}.dhd"), import_module(f"{_PACKAGE}.dhd.expert")
        self.Status = import_module(f"{_PACKAGE}.containers").Status
        self.ForceOffCause = import_module(f"{_PACKAGE}.constants").ForceOffCause

    def __getattr__(self, name: str) -> Any:
        return getattr(next((m for m in self._modules if hasattr(m, name)), self._modules[0]), name)


def library() -> Any:
    """Load the package, which needs the maker's library. Raises InputError if either is missing."""
    said = StringIO()
    try:
        with redirect_stderr(said):  # The package writes why it cannot load the maker's library.
            return _Library()
    except ImportError as error:
        what = f"the Python package {_PACKAGE} and Force Dimension's SDK (https://www.forcedimension.com)"
        raise InputError(f"--port {FORCE_DIMENSION} needs {what}: {said.getvalue() or error}") from None


class ForceDimension:
    """Drive axes of one or several Force Dimension devices. This host is their clock.

    The state machine is the firmware's (hw/device_state.py): it arms on ARM, limits forces and their slew rate, and
    ramps them to zero.
    """

    errors = 0  # number of unreadable frames: there are no frames

    def __init__(
        self,
        scenario: Scenario,
        axes: str | None = None,
        sdk: Any = None,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
        deadman: bool = False,
    ) -> None:
        """Open the devices that `axes` names, such as "0x,1x" (default: the scenario's axes, on the first devices).

        With `deadman`, button 0 of every device is read at every tick. Raises InputError where `axes` is wrong or names
        a device twice, the library is missing, or a device cannot be opened or has no button to be read.
        """
        self._where = _axes(axes, scenario)
        #: channels whose force limit is that of another channel: all but the first of each limited force vector
        self._shared = {i for ball in scenario.limiter_limits[1] for i in range(ball.start + 1, ball.stop)}
        self._sdk = sdk or library()
        self._clock, self._sleep, self._begun = clock, sleep, clock()
        self._ids: dict[str, int] = {}
        with ExitStack() as opened:
            opened.push(self)  # an exception closes the devices that are open
            for name in dict.fromkeys(name for name, _ in self._where):
                sdk = self._sdk
                ID = sdk.openSerial(int(name[2:])) if name.startswith("sn") else sdk.openID(int(name))
                if ID < 0:
                    raise InputError(f"--port {FORCE_DIMENSION}: device {name}: {sdk.errorGetLastStr()}")
                self._ids[name] = ID
                if deadman and sdk.getButton(0, ID=ID) < 0:
                    others = "give --deadman key, --deadman FILE or --no-dead-man"
                    raise InputError(f"--deadman device: the button of device {name} cannot be read; {others}")
            self._buttons = [*self._ids.values()] if deadman else []
            self._require_different()
            self._status = {index: self._sdk.Status() for index in self._ids}
            first = next(iter(self._ids.values()))
            name = (self._sdk.getSystemName(ID=first) or "Force Dimension").encode("ascii", "replace").decode()[:16]
            self._info = info_of(scenario)._replace(firmware=name, serial=max(0, self._sdk.getSerialNumber(ID=first)))
            self._sdk.enableExpertMode()  # the watchdog needs expert mode
            #: whether every device has set its watchdog
            self.guarded = {self._sdk.setWatchdog(_WATCHDOG, ID=ID) for ID in self._ids.values()} == {0}
            opened.pop_all()
        self._device, self._decoder = Device(self._info), wire.Decoder()
        self._T = 1e-9 * self._info.period_ns
        self._due = clock()

    @property
    def unused_axes(self) -> list[str]:
        """The translations that no channel drives, one entry per device, such as "y and z of device 0".

        The library's own regulation cannot hold them: drdRegulatePos locks x, y and z of the base together.
        """
        return [
            f"{' and '.join(axis for i, axis in enumerate('xyz') if (name, i) not in self._where)} of device {name}"
            for name in self._ids
            if sum(name == used for used, _ in self._where) < 3
        ]

    def info(self) -> wire.Info:
        """Return INFO. Only name and serial number are the library's, which reports no damping and no encoder step."""
        return self._info

    def configure(self, config: wire.Config) -> int | None:
        with self._off_after_an_error():
            self._device.configure(config)
            (ack,) = self._decoder.feed(self._device.ack)
            self._device.ack = b""
            assert isinstance(ack, wire.Ack)
            if ack.refused == wire.Refused.RUNNING:
                self.exchange(None)  # the next tick of the ramp
                return None
            if not ack.refused:
                for index, ID in self._ids.items():
                    self._heeded(self._sdk.setMaxForce(self._strongest(config, index), ID=ID))
                    self._heeded(self._sdk.enableForce(True, ID=ID))
                self._write(self._device.zero)
            return ack.refused

    def exchange(self, force: wire.Force | None) -> wire.State | None:
        with self._off_after_an_error():
            if force is not None:
                self._device.receive(wire.encode(force), came := self._now())
                self._write(self._device.applied)
                if self._device.margin != wire.NO_MARGIN:  # a force acts only after it was written
                    self._device.margin = max(-0x7FFF, self._device.margin - (self._now() - came))
            while (left := self._due - self._clock()) > 0:
                self._sleep(left - _SPIN if left > 2 * _SPIN else 0.0)
            self._due = max(self._due, self._clock() - (1 - _SHORTEST) * self._T) + self._T
            self._check_status()
            if self._buttons:
                self._device.deadman = all(self._heeded(self._sdk.getButton(0, ID=ID)) for ID in self._buttons)
            before = self._device.applied
            _, out = self._device.tick(self._now(), self._counts())
            if self._device.applied != before or force is None:
                self._write(self._device.applied)
            return next((m for m in self._decoder.feed(out) if isinstance(m, wire.State)), None)

    def stop(self, reason: wire.Reason) -> None:
        self._device.receive(wire.encode(wire.Stop(reason)), self._now())
        if self._device.phase == wire.Phase.ESTOP:
            self._zero()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """Set zero force, switch the motors off and close the devices."""
        self._zero()
        for ID in self._ids.values():
            self._sdk.enableForce(False, ID=ID)
            self._sdk.close(ID=ID)

    def _require_different(self) -> None:
        """Raise InputError if two names open the same device. Devices without a serial number are not compared."""
        numbers = {name: self._sdk.getSerialNumber(ID=ID) for name, ID in self._ids.items()}
        for one, other in combinations(numbers, 2):
            if 0 < numbers[one] == numbers[other]:
                same = f"{one} and {other} are the same device, serial number {numbers[one]}"
                raise InputError(f"--port {FORCE_DIMENSION}: {same}; give it one of these names")

    def _zero(self) -> None:
        """Set zero force at every device, even if one of them reports an error."""
        for ID in self._ids.values():
            self._sdk.setForce([0.0, 0.0, 0.0], ID=ID)

    @contextmanager
    def _off_after_an_error(self) -> Iterator[None]:
        """Set zero force at every device and enter ESTOP if an exception is raised, then raise it again."""
        try:
            yield
        except Exception:
            self._device.estop(wire.Cause.DEVICE)
            self._zero()
            raise

    def _now(self) -> int:
        return round(1e6 * (self._clock() - self._begun))

    def _counts(self) -> tuple[int, ...]:
        places = {index: [0.0, 0.0, 0.0] for index in self._ids}
        for index, ID in self._ids.items():
            self._heeded(self._sdk.getPosition(places[index], ID=ID))
        counts = []
        for (index, axis), step in zip(self._where, self._info.encoder_step, strict=True):
            count = places[index][axis] / (1e-12 * step)
            if not abs(count) < _COUNTS:  # also true for nan
                place = f"{'xyz'[axis]} = {places[index][axis]:g} m"
                raise wire.SafetyStop(f"device {index} reports the position {place}")
            counts.append(round(count))
        return tuple(counts)

    def _strongest(self, config: wire.Config, index: str) -> float:
        """Return the length [N] of the largest force that a device may have to make, plus 1 % for rounding."""
        each = enumerate(zip(self._where, config.cap, self._info.force_step, strict=True))
        caps = {i: 1e-6 * cap * step for i, ((own, _), cap, step) in each if own == index and i not in self._shared}
        return 1.01 * math.hypot(*caps.values())

    def _check_status(self) -> None:
        """Raise SafetyStop if a device has no power, no link or an error, or is in reset mode.

        The forces of an armed device must also be on. Raises PortLost if a status cannot be read.
        """
        armed = self._device.phase in RUNNING
        for index, ID in self._ids.items():
            status = self._status[index]
            self._heeded(self._sdk.getStatus(status, ID=ID))
            troubles = {
                "has no power": not status.power,
                "is not connected": not status.connected,
                f"reports error {status.error}": status.error,
                "is in reset mode: calibrate it": status.reset,
            }
            if armed and not status.force:
                names = {cause.value: cause.name.lower() for cause in self._sdk.ForceOffCause}
                cause = names.get(status.forceoffcause, status.forceoffcause)
                troubles[f"has switched its forces off, cause {cause}"] = 1
            if wrong := next((words for words, there in troubles.items() if there), None):
                raise wire.SafetyStop(f"device {index} {wrong}")

    def _write(self, steps: tuple[int, ...]) -> None:
        forces = {index: [0.0, 0.0, 0.0] for index in self._ids}
        for (index, axis), n, step in zip(self._where, steps, self._info.force_step, strict=True):
            forces[index][axis] = 1e-6 * n * step
        for index, ID in self._ids.items():
            if self._heeded(self._sdk.setForce(forces[index], ID=ID)) == _SATURATED:
                self._device.fault()

    def _heeded(self, code: int) -> int:
        """Return the code of one of the library's calls. Raises PortLost if the code reports an error."""
        if code < 0:
            raise PortLost(f"a call to the device failed: {self._sdk.errorGetLastStr()}")
        return code


def _axes(text: str | None, scenario: Scenario) -> list[tuple[str, int]]:
    """Parse the device (its index, or "sn" and its serial number) and the axis of every channel. Raises InputError."""
    channels = scenario.channels
    usual = [f"{i}{'xyz'[axis]}" for i, device in enumerate(scenario.device) for axis in device.free]
    parts = text.split(",") if text else usual
    if len(parts) != channels or not all(re.fullmatch(r"(sn)?\d+[xyz]", part) for part in parts):
        example = ",".join(usual)
        raise InputError(
            f"--port {FORCE_DIMENSION}:{text}: expected a device (its index, or sn and its serial number) and an axis "
            f"for each of {channels} channels, as in {FORCE_DIMENSION}:{example}"
        )
    chosen = [(part[:-1], "xyz".index(part[-1])) for part in parts]
    if len(set(chosen)) != channels:
        raise InputError(f"--port {FORCE_DIMENSION}:{text}: two channels have the same axis")
    return chosen
