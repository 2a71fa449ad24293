"""Scenarios: devices, humans, environment, delays and timing of one loop, read strictly from TOML.

Unknown keys and impossible numbers are refused. A separate file can hold the humans. sim.validate writes such files, so
that sim.run can simulate the worst humans again.
"""

from __future__ import annotations

import difflib
import hashlib
import re
from collections.abc import Sequence
from inspect import isfunction
from pathlib import Path
from typing import Any, Self, get_args

import msgspec
import numpy as np

from haptic_loop.controller.delay import LOST, MOST_SAMPLES, Periods, Timing, VaryingDelay, draw_timing
from haptic_loop.controller.environment import (
    GROUND,
    RIGID_WALL,
    Block,
    Environment,
    Network,
    Spring,
    Wall,
)
from haptic_loop.controller.loop import DelayRange, DeviceBounds, Loop, check_shortest
from haptic_loop.controller.lti import Lti
from haptic_loop.controller.ranges import Ranges, UncertainSpring
from haptic_loop.controller.units import PositionUnit, in_unit
from haptic_loop.design.files import InputError, counted, read_text, toml, write
from haptic_loop.design.own import called, named, place_of
from haptic_loop.models.device import AXES, MOST_DAMPING, Device, Mechanics, fields_of, require, symmetric
from haptic_loop.models.human import Cross, Human, Link, MeasuredHand, Person, Population, Port, Voluntary, check_holds

CASES = ("none", "I", "II")  # "none": no coupling; "I", "II": the paper's two cases of reference delays
SCENARIOS = Path(__file__).parent / "scenarios"
DEFAULT = "omega-pair"

_MOST_DELAYS = 1000  # total of all channels [samples]; the eigenvalues of 1000 states take about a second
_MOST_CHANNELS = 32  # sim.run with 32 channels takes seconds, and a design tens of seconds
_LONGEST_NAME = 200  # characters
_TIMING_STREAM = 6  # random stream of the timing, independent of the humans' stream with the same seed
_Delays = tuple[int, ...]
_UNSAID: Any = None  # placeholder of a default that depends on the number of channels or devices


class _Tap(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A short constant force on one handle."""

    channel: int  # counted from 1, over the free axes of all devices
    force: float  # [N]
    start: float  # [s]
    duration: float  # [s]

    def __post_init__(self) -> None:
        require("force", self.force, -1e4, 1e4, "N")
        require("start", self.start, 0.0, 1e6, "s")
        require("duration", self.duration, 0.0, 1e6, "s")


def _usual_hand(i: int, r: float) -> Human:
    """Return the default hand of device i (from 0): 0.3 kg on a spring whose far end moves by +-15 mm at 0.6 Hz.

    For a rotary device, the hand holds it at the radius r [m]; otherwise r is 1.
    """
    return Human((Link(0.3 * r**2, 3.0 * r**2, 200.0 * r**2),), Voluntary(0.015 / r, 0.6, phase=0.5 * np.pi * i))


class Scenario(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Devices, humans, environment, delays and timing of one loop, with one human per device.

    A channel is a free axis of a device. A file has delays and latencies per device or per channel; they are stored per
    channel.
    """

    name: str
    unit: PositionUnit = "m"  # of positions; "rad" for rotary devices, with forces in N m and dampings in N m s/rad
    radius: float | None = None  # [m] from a rotary device's axis to the hand; scales default hands and limits
    T: float  # sampling period [s]
    theta: _Delays  # transmission delays [samples], the paper's equation 4
    psi: _Delays = _UNSAID  # environment delays [samples], equation 5; default: 0
    device: tuple[Device, ...]
    human: tuple[Human, ...] = _UNSAID  # the hands that hold the devices in a run; default: `_usual_hand`
    environment: Network
    ranges: Ranges | None = None  # environments that guarantees must cover besides the nominal one
    lam: _Delays | None = None  # reference delays [samples], equation 7; None: those of the case (`reference_delays`)
    person: tuple[Person, ...] = ()  # people who hold several devices
    tap: _Tap | None = None
    duration: float = 15.0  # simulated time [s]
    population: Population = Population()  # distribution of random humans
    varying_delay: VaryingDelay | None = None  # delays of the forces in a range around theta; None: constant delays
    T_max: float | None = None  # [s] the longest period if periods vary; certificates hold for all periods up to T_max
    T_min: float | None = None  # [s] the shortest period if periods vary, for known-device; latencies must be less
    period: Periods | None = None  # the simulated periods; the coupling is computed for T
    latency: tuple[tuple[float, float], ...] | None = None  # [s] (least, most) time from a tick to the latch of a force

    def __post_init__(self) -> None:
        if len(self.name) > _LONGEST_NAME:
            raise ValueError(f"name has {len(self.name)} characters, allowed are up to {_LONGEST_NAME}")
        self._per_channel()
        if self.channels > _MOST_CHANNELS:
            raise ValueError(f"environment.contacts has {self.channels} entries, allowed are 1 to {_MOST_CHANNELS}")
        require("T", self.T, 1e-6, 0.1, "s")
        if self.radius is not None:
            require("radius", self.radius, 1e-3, 1.0, "metres")
            if self.unit == "m":
                raise ValueError(f'radius is {self.radius:g}, which is for unit = "rad" only')
        if self.unit == "rad" and is_world(self):
            raise ValueError('unit is "rad", but a MuJoCo world is in metres')
        require("duration", self.duration, self.T, 1e6, "s")
        if self.psi is _UNSAID:
            msgspec.structs.force_setattr(self, "psi", (0,) * self.channels)
        if self.human is _UNSAID:
            if self.unit == "rad" and self.radius is None:
                where = "the distance in metres from axis to hand, which scales the default hands"
                raise ValueError(f"radius is missing: give {where}; or give [[human]]")
            usual = tuple(_usual_hand(i, self.lever) for i in range(len(self.device)))
            msgspec.structs.force_setattr(self, "human", usual)
        self._check_counts()
        for name in ("theta", "psi", "lam"):
            value = getattr(self, name)
            for i, n in enumerate(value or (), start=1):
                require(f"{name} #{i}", n, 0, MOST_SAMPLES, "samples")
        if (total := sum((*self.theta, *self.psi))) > _MOST_DELAYS:
            each = f"theta {list(self.theta)} and psi {list(self.psi)} of the channels"
            many = f"{each} are {total} samples in all, allowed are {_MOST_DELAYS}"
            seconds = f"each sample is a state, and the eigenvalues would take about {1e-9 * total**3:.0f} s"
            raise ValueError(f"{many}: {seconds}; a longer T has fewer samples for the same delay")
        for i, lam in enumerate(self.lam or ()):
            if lam > self.theta[i] + self.psi[i]:
                total = self.theta[i] + self.psi[i]
                raise ValueError(f"lam #{i + 1} is {lam}, allowed are 0 to theta + psi = {total} samples")
        check_holds([person.holds for person in self.person], len(self.device))
        for i, (human, device) in enumerate(zip(self.human, self.device, strict=True), start=1):
            has = len(device.free)
            if isinstance(human, Human) and human.voluntary and self.unit == "m":
                require(f"human #{i}.voluntary.amplitude", human.voluntary.amplitude, 0.0, 1.0, "m")
            for field, value in human.vectors() if isinstance(human, Human) else ():
                if len(value) != has:
                    expected = f"expected {has} entries, one for each free axis of the device"
                    raise ValueError(f"human #{i}.{field} is {list(value)}, {expected}")
        for i, person in enumerate(self.person, start=1):
            free = [self.device[k - 1].axis_names for k in person.holds]
            if len(set(free)) > 1:
                shown = "; ".join(", ".join(name[1:] for name in names) for names in free)
                expected = f"expected devices with the same free axes; the free axes are {shown}"
                raise ValueError(f"person #{i}.holds is {list(person.holds)}, {expected}")
        if self.varying_delay:
            self._check_varying_delay(self.varying_delay)
        self._check_timing()
        self.loop("I")  # raises ValueError where the ranges do not fit the environment
        there = self.environment
        parts = (amount for spring in there.springs for amount in spring.amounts(float))
        if not (there.world or there.block or there.walls or any(there.masses.values()) or any(parts)):
            raise ValueError("environment has no force: all springs, dampers and masses are 0, and there are no walls")
        if self.tap and not 1 <= self.tap.channel <= self.channels:
            raise ValueError(f"tap.channel is {self.tap.channel}, allowed are 1 to {self.channels}")

    def _check_counts(self) -> None:
        contacts = f"the environment has {self.channels} contacts ({', '.join(self.environment.contacts)})"
        if (axes := sum(len(device.free) for device in self.device)) != self.channels:
            several = any(device.axes > 1 for device in self.device)
            has = f"{len(self.device)} entries" + (f" with {axes} free axes in all" if several else "")
            raise ValueError(f"device has {has}, but {contacts}")
        for name in ("theta", "psi", "lam"):
            if (value := getattr(self, name)) is not None and len(value) != self.channels:
                raise ValueError(f"{name} has {len(value)} entries, but {contacts}")
        if len(self.human) != (devices := len(self.device)):
            raise ValueError(f"human has {len(self.human)} entries, expected {devices}, one for each device")

    def _per_channel(self) -> None:
        """Convert values per device to values per channel, if devices have several axes.

        Raises ValueError for a list of wrong length, or if a list gives the axes of one device different values.
        """
        counts = [len(device.free) for device in self.device]
        if max(counts, default=1) == 1:
            return

        def each(name: str, values: Any) -> Any:
            if values is None:
                return None
            if len(values) == len(counts):
                return tuple(value for value, count in zip(values, counts, strict=True) for _ in range(count))
            if len(values) != sum(counts):
                raise ValueError(f"{name} has {len(values)} entries, expected {len(counts)}, one for each device")
            if any(value != values[first] for value, first in zip(values, self.lead, strict=True)):
                raise ValueError(f"{name} is {list(values)}, expected one value for all axes of a device")
            return tuple(values)

        for name in ("theta", "psi", "lam", "latency"):
            msgspec.structs.force_setattr(self, name, each(name, getattr(self, name)))
        if varying := self.varying_delay:
            rows = {name: each(f"varying_delay.{name}", getattr(varying, name)) for name in ("lo", "hi")}
            recorded = tuple(each("varying_delay.recorded", row) for row in varying.recorded)
            varying = msgspec.structs.replace(varying, **rows, recorded=recorded)
            msgspec.structs.force_setattr(self, "varying_delay", varying)

    @property
    def axis_devices(self) -> tuple[Any, ...]:
        """For each channel a device with one axis, whose fields are numbers; `device` itself if all have one axis."""
        if all(device.axes == 1 for device in self.device):
            return self.device
        return tuple(axis for device in self.device for axis in device.channels())

    @property
    def channel_names(self) -> tuple[str, ...]:
        """Names (m,) such as "left.x" if devices have several axes; otherwise ()."""
        return () if self.axis_devices is self.device else self.environment.contacts

    @property
    def balls(self) -> tuple[slice, ...]:
        """The channels of each device whose `force_limit` bounds the length of the force vector, not each axis."""
        ends = np.cumsum([0, *(len(device.free) for device in self.device)]).tolist()
        return tuple(slice(a, b) for device, a, b in zip(self.device, ends, ends[1:], strict=False) if device.ball)

    @property
    def limiter_limits(self) -> tuple[tuple[float, ...], tuple[slice, ...]]:
        """Limits (m,) [N] of a limiter, and the channels of each force vector whose length the limiter bounds.

        No limiter bounds the length of vectors in a loop with walls. There each of a vector's n axes gets 1/sqrt(n) of
        the vector's limit.
        """
        limits = [device.force_limit for device in self.axis_devices]
        if not self.environment.walls:
            return tuple(limits), self.balls
        for ball in self.balls:
            limits[ball] = [limit / (ball.stop - ball.start) ** 0.5 for limit in limits[ball]]
        return tuple(limits), ()

    @property
    def lead(self) -> list[int]:
        """For each channel, the first channel of its device. A device's axes share its drawn delay and latency."""
        counts = [len(device.free) for device in self.device]
        return np.repeat(np.cumsum([0, *counts[:-1]]), counts).tolist()

    def _check_timing(self) -> None:
        check_shortest(self.T_min, self.T)
        if self.period and self.T_max is not None and self.period.longest > self.T_max:
            raise ValueError(f"period is up to {self.period.longest:g} s, above T_max = {self.T_max:g} s")
        if self.period and self.T_min is not None and self.period.shortest < self.T_min:
            raise ValueError(f"period is from {self.period.shortest:g} s, below T_min = {self.T_min:g} s")
        shortest = self.shortest_period or self.T
        for i, (_, most) in enumerate(self.latency or (), start=1):
            if most >= shortest:
                raise ValueError(f"latency #{i} is up to {most:g} s, expected less than every period, {shortest:g} s")

    def _check_varying_delay(self, varying: VaryingDelay) -> None:
        if varying.channels != self.channels:
            raise ValueError(f"varying_delay has {varying.channels} ranges for {self.channels} channels")
        if self.environment.walls:
            instead = "design and design.audit prove both with --varying-delay"
            raise ValueError(f"varying_delay and environment.walls: the simulation cannot combine them; {instead}")
        for i, (n, lo, hi) in enumerate(zip(self.theta, varying.lo, varying.hi, strict=True), start=1):
            if varying.playout and n != hi:
                raise ValueError(f"theta #{i} is {n}, but varying_delay.playout makes it the largest delay, {hi}")
            if not lo <= n <= hi:
                raise ValueError(f"theta #{i} is {n}, outside of its varying_delay, {lo} to {hi} samples")

    def __repr__(self) -> str:
        timing = f"T = {1e3 * self.T:g} ms, theta = {list(self.theta)}, {self.duration:g} s"
        return f"Scenario({self.name!r}: {timing}, contacts {', '.join(self.environment.contacts)})"

    @property
    def channels(self) -> int:
        return len(self.environment.contacts)

    @property
    def switches(self) -> bool:
        """Whether the delay of the forces may differ from theta."""
        return self.varying_delay is not None and not self.varying_delay.steady

    @property
    def loses_packets(self) -> bool:
        """Whether packets may be lost, so that forces may become older than `delay_range`."""
        varying = self.varying_delay
        return varying is not None and (varying.loss > 0 or any(LOST in row for row in varying.recorded))

    @property
    def delay_range(self) -> DelayRange:
        """The range of the delay [samples] of a force that is not lost."""
        varying = self.varying_delay
        return DelayRange(varying.lo, varying.hi) if varying else DelayRange(self.theta, self.theta)

    @property
    def delta(self) -> tuple[float, ...]:
        """The guaranteed damping on each channel [N s/m]. For a device with a damping matrix this is its diagonal."""
        return tuple(device.passivity_level for device in self.axis_devices)

    @property
    def _levels(self) -> tuple[Any, ...] | None:
        """The matrix of guaranteed damping of each device [N s/m] as rows of numbers; None if all are diagonal."""
        matrices = [device.matrix("delta") for device in self.device]
        if all((matrix == np.diag(np.diag(matrix))).all() for matrix in matrices):
            return None
        return tuple(tuple(map(tuple, matrix.tolist())) for matrix in matrices)

    @property
    def samples(self) -> int:
        """Number of ticks of a run."""
        return max(1, round(self.duration / (self.period.mean if self.period else self.T)))

    @property
    def longest_period(self) -> float | None:
        """The longest period for certificates: T_max, or the longest simulated period; None if every period is T."""
        if self.T_max is not None or self.period is None:
            return self.T_max
        return max(self.period.longest, self.T)

    @property
    def shortest_period(self) -> float | None:
        """The shortest period for certificates: T_min, or the shortest simulated period; None without both."""
        if self.T_min is not None or self.period is None:
            return self.T_min
        return min(self.period.shortest, self.T)

    @property
    def known_devices(self) -> tuple[DeviceBounds, ...] | None:
        """The guaranteed bounds of every channel's device; None unless all devices have such bounds."""
        known = tuple(device.guaranteed for device in self.axis_devices if device.guaranteed)
        return known if len(known) == self.channels else None

    @property
    def usual_latency(self) -> list[float] | None:
        """The middle of each channel's range of latency [s]; None if forces latch at ticks."""
        return None if self.latency is None else [sum(span) / 2 for span in self.latency]

    @property
    def uneven(self) -> bool:
        """Whether ticks differ in length or in the time at which forces latch."""
        return self.period is not None or any(least < most for least, most in self.latency or ())

    def timing(self, seed: int, ticks: int) -> Timing | None:
        """Draw and return the times at which ticks begin and forces latch; None without `period` and `latency`."""
        rng = np.random.default_rng(np.random.SeedSequence((seed, _TIMING_STREAM)))
        timing = draw_timing(self.T, self.period, self.latency, ticks, rng)
        if timing is None or timing.late is None or self.axis_devices is self.device:
            return timing
        return Timing(timing.period, timing.late[:, self.lead])

    @property
    def digest(self) -> str:
        """SHA-256 over the scenario's contents."""
        newer = {"T_max", "T_min", "latency", "period"}  # left out if None, so that old digests stay valid
        contents = {name: value for name, value in msgspec.structs.asdict(self).items() if name not in newer or value}
        if self.unit == "m":
            del contents["unit"], contents["radius"]
        contents["device"] = [_given_fields(device) for device in self.device]
        if self.environment.world:  # The digest depends on the contents of a world's files, not on their folder.
            contents["environment"] = _without_folder(self.environment)
        content = msgspec.json.encode(contents, order="sorted", enc_hook=_contents)
        return hashlib.sha256(content).hexdigest()

    def reference_delays(self, case: str) -> tuple[int, ...]:
        """Return the reference delays [samples]: `lam` if given, otherwise 0 in case II and theta + psi in case I.

        Raises InputError for an unknown case.
        """
        if case not in CASES:
            raise InputError(f"case is {case!r}, allowed are {', '.join(CASES)}")
        if self.lam is not None:
            return self.lam
        if case == "II":
            return (0,) * self.channels
        return tuple(t + p for t, p in zip(self.theta, self.psi, strict=True))

    def title(self, case: str) -> str:
        """Return the title of reports and pictures. Only the paper's loop has a case in its title."""
        if (case == "none" or self.varying_delay is None) and self.loop(case) == load().loop(case):
            return f"{self.name}, case {case}"
        if case == "none":
            return f"{self.name}, no coupling"
        lam, loop = self.reference_delays(case), tuple(map(sum, zip(self.theta, self.psi, strict=True)))
        if not any(lam) and (case == "II" or any(loop)):
            return f"{self.name}, reference without delay"
        return self.name if lam == loop else f"{self.name}, reference {list(lam)} samples late"

    @property
    def lever(self) -> float:
        """The radius [m] at which a hand holds a rotary device, which converts N to N m; 1 without `radius`."""
        return self.radius or 1.0

    def loop(self, case: str) -> Loop:
        """Return the loop for designs and proofs. It has the devices' damping and guaranteed bounds, but no humans.

        `case` is "none", "I" or "II". Raises InputError for another case.
        """
        span, known, counts = self.delay_range, self.known_devices, tuple(len(device.free) for device in self.device)
        return Loop(
            T=self.T,
            theta=self.theta,
            psi=self.psi,
            lam=self.reference_delays(case),
            delta=self.delta,
            environment=_without_folder(self.environment),
            ranges=self.ranges,
            varying_delay=span if self.switches and span.lo != span.hi else None,
            T_max=self.longest_period,
            latency=self.latency,
            T_min=self.shortest_period if known else None,
            known_devices=known,
            axes=counts if max(counts) > 1 else None,
            levels=self._levels,
            unit=self.unit,
        )

    def before_a_rigid_wall(self, psi: tuple[int, ...] = (0,)) -> Loop:
        """Return the loop of the first device alone before a rigid wall. Raises ValueError if psi is not 0.

        The wall of a device with several axes may face any direction, so the loop has the least damping of all
        directions.
        """
        theta, late, delta = self.theta[:1], self.latency and self.latency[:1], self.delta[:1]
        if self.device[0].axes > 1:
            least = np.linalg.eigvalsh(self.device[0].matrix("delta"))[0]
            # The factor 1 - 1e-12 covers the rounding of eigvalsh.
            delta = (min(float(least) * (1 - 1e-12), *self.delta[: len(self.device[0].free)]),)
        known, longest = self.known_devices, self.longest_period
        more: dict[str, Any] = {"known_devices": known[:1], "T_min": self.shortest_period} if known else {}
        return Loop(self.T, theta, psi, theta, delta, RIGID_WALL, latency=late, T_max=longest, unit=self.unit, **more)

    def replace(self, delta: Sequence[float] | None = None, **changes: Any) -> Self:
        """Return the scenario with some fields changed; `delta` gives each device another guaranteed damping [N s/m].

        The scenario checks and normalises values as in a file. Three fields may also be objects of a user's own class:
        humans (models.human.Hand), a population with a method `draw(rng, n)` that returns n humans, and an environment
        with `contacts` and `E(T)` or `parts()`. Raises InputError for a wrong value.
        """
        fields = {name: getattr(self, name) for name in self.__struct_fields__} | changes
        own = {name: fields.pop(name) for name in ("human", "population") if _is_own(name, fields[name])}
        try:
            if not isinstance(fields["environment"], Network | dict):
                fields["environment"] = _network(fields["environment"], fields["T"])
            if delta is not None:
                parts = {name: fields[name] for name in ("device", "environment")}
                fields["device"] = _strictly({**parts, "delta": delta}, _Damped).devices()
            if "human" in own:
                fields["human"] = [_NOBODY] * len(own["human"])
            scenario = _strictly(fields, type(self))
            return msgspec.structs.replace(scenario, **{name: _checked_own(value) for name, value in own.items()})
        except InputError:
            raise
        except ValueError as error:
            raise InputError(str(error)) from None


def own_environment(text: str) -> Any:
    """Return the object NAME of FILE.py, or its result if it can be called. Raises InputError if this fails."""
    own = named("--environment", text)
    return called(f"--environment {text}", own) if callable(own) else own


def load(source: str | Path = DEFAULT) -> Scenario:
    """Return the scenario of a TOML file, or a packaged one by name. Raises InputError if it is missing or invalid."""
    if not isinstance(source, str | Path):
        kind = type(source).__name__
        raise InputError(f"scenario is {source!r} ({kind}), expected a TOML file or one of: {', '.join(built_in())}")
    path = SCENARIOS / f"{source}.toml" if str(source) in built_in() else Path(source)
    close = difflib.get_close_matches(str(source), built_in(), n=1)
    hint = f" (did you mean {close[0]}?)" if close else ""
    text = read_text(path, f"scenario {source}", f"{hint}; give a TOML file or one of: {', '.join(built_in())}")
    return parse(text, str(source), path.parent)


def parse(text: str, source: str = "scenario", folder: Path = Path()) -> Scenario:
    """Return the scenario of a TOML text. The path of a world's file is relative to `folder`.

    Raises InputError with the path and the value of a wrong field, and TypeError unless `text` is a str.
    """
    if not isinstance(text, str):
        raise TypeError(f"text is of type {type(text).__name__}, expected a str: the scenario itself, in TOML")
    try:
        scenario: Scenario = _converted(text, Scenario, source, folder)
    except InputError as error:
        if _is_rotary(text):
            raise InputError(in_unit(str(error), "rad")) from None
        raise
    try:
        scenario.environment.check(scenario.psi, scenario.T)
    except ValueError as error:
        raise InputError(f"{source}: environment: {error}") from None
    return scenario


def built_in() -> list[str]:
    return sorted(path.stem for path in SCENARIOS.glob("*.toml"))


def is_world(scenario: Scenario) -> bool:
    return scenario.environment.world is not None


def require_no_world(scenario: Scenario, what: str) -> None:
    """Raise InputError if the environment is a MuJoCo scene; `what` names the command in the message."""
    if is_world(scenario):
        able = "sim.run, sim.view, sim.validate, design, design.audit and hw.bridge accept worlds"
        raise InputError(
            f"environment.world: {what} accepts networks only; {able}; linearise(world, pose) gives a network"
        )


def require_scaled_hands(scenario: Scenario) -> None:
    """Raise InputError for a rotary scenario with neither `radius` nor [population], which scale random hands."""
    if scenario.unit == "rad" and scenario.radius is None and scenario.population == Population():
        where = "the distance in metres from axis to hand, which scales random hands"
        raise InputError(f"radius is missing: give {where}; or give [population]")


def require_linear(scenario: Scenario, what: str, walls: bool = False) -> None:
    """Raise InputError if a loop has Coulomb friction, or has walls although `walls` is False."""
    for i, device in enumerate(scenario.device, start=1):
        if np.any(device.friction):
            friction = list(device.friction) if isinstance(device.friction, tuple) else f"{device.friction:g}"
            instead = "sim.run and sim.zwidth simulate it"
            raise InputError(f"device #{i}.friction is {friction} N: {what} accepts linear loops only; {instead}")
    if scenario.environment.walls and not walls:
        raise InputError(f"environment.walls: {what} accepts linear loops only; sim.run simulates walls")


def require_constant_delay(scenario: Scenario, what: str) -> None:
    """Raise InputError if there is a table varying_delay."""
    if scenario.varying_delay is not None:
        instead = "or use sim.run"
        raise InputError(f"varying_delay: {what} does not simulate varying delays; remove the table, {instead}")


def require_even_ticks(scenario: Scenario, what: str) -> None:
    """Raise InputError if the scenario has `period` or `latency`."""
    for name in ("period", "latency"):
        if getattr(scenario, name) is not None:
            raise InputError(f"{name}: {what} does not simulate this key; remove it, or use sim.run")


def require_latch_at_ticks(scenario: Scenario) -> None:
    """Raise InputError if forces have a latency."""
    if scenario.latency:
        raise InputError("latency: an energy account assumes forces that latch at ticks; add a sample to theta instead")


# ---- humans in a separate file


class _HumanFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The contents of a file of humans."""

    human: tuple[Any, ...]  # Human, MeasuredHand, or a user's own class
    person: tuple[Person, ...] = ()
    population: Any = None  # a user's own population with draw(rng, n)
    device: tuple[Mechanics, ...] = ()  # mechanics that sim.validate drew within the guaranteed bounds, or ()


def held_by(scenario: Scenario, text: str) -> Scenario:
    """Return the scenario with the people of a TOML file or FILE.py:NAME. Raises InputError if they do not fit."""
    people = _load_humans(text, len(scenario.device))
    who: dict[str, Any] = {"human": people.human, "person": people.person} if people.human else {}
    if people.population is not None:
        who["population"] = people.population
    if people.device:
        if len(people.device) != len(scenario.device):
            has, expected = len(people.device), len(scenario.device)
            raise InputError(f"--human {text} has {has} [[device]] tables, expected {expected} or none")
        try:
            who["device"] = tuple(map(Mechanics.of, people.device, scenario.device))
        except ValueError as error:
            raise InputError(f"--human {text}: device: {error}") from None
    return scenario.replace(**who)


def _load_humans(text: str, devices: int) -> _HumanFile:
    """Return the people of a TOML file or of FILE.py:NAME. Raises InputError for an invalid file."""
    own = ".py" in text
    try:
        people = _own_humans(text) if own else _humans_of(read_text(text, f"--human {text}"), f"--human {text}")
        if len(people.human) != devices and not people.population:
            what = "hands" if own else "[[human]] tables"
            raise InputError(f"--human {text} has {len(people.human)} {what}, expected {devices} (one per device)")
        check_holds([person.holds for person in people.person], devices)
    except InputError:
        raise
    except ValueError as error:
        raise InputError(f"--human {text}: {error}") from None
    except Exception as error:
        if not own:
            raise
        raise InputError(f"--human {text}: {type(error).__name__}: {error}") from None  # raised in the user's file
    return people


def _humans_of(text: str, source: str) -> _HumanFile:
    people: _HumanFile = _converted(text, _HumanFile, source)
    if people.population is not None:
        raise InputError(f"{source}: [population] belongs in a scenario; a file of humans has [[human]] and [[person]]")
    humans = []
    for i, human in enumerate(people.human, start=1):
        kind = MeasuredHand if isinstance(human, dict) and "A" in human else Human
        try:
            humans.append(msgspec.convert(human, kind))
        except msgspec.ValidationError as error:
            joint = "." if re.search(r" - at `\$\.", str(error)) else ": "
            place = _located(str(error), human if isinstance(human, dict) else {})
            raise InputError(f"{source}: human #{i}{joint}{place}") from None
        except ValueError as error:
            raise InputError(f"{source}: human #{i}: {error}") from None
    return _HumanFile(tuple(humans), people.person, None, people.device)


def _own_humans(text: str) -> _HumanFile:
    """Return the people of FILE.py:NAME. NAME is a list, a population, or a function or class that makes either."""
    people: Any = named("--human", text)
    if isinstance(people, type) or isfunction(people):
        people = called(f"--human {text}", people)
    if callable(getattr(people, "draw", None)):
        if len(_checked_own(tuple(people.draw(np.random.default_rng(0), 2)))) != 2:
            raise ValueError("draw(rng, 2) does not return two humans")
        return _HumanFile((), (), people)
    if not isinstance(people, list | tuple):
        raise ValueError(f"the value is {people!r}, neither a list of hands nor a population with draw(rng, n)")
    persons = tuple(person for person in people if isinstance(person, Person))
    return _HumanFile(_checked_own(tuple(hand for hand in people if not isinstance(hand, Person))), persons)


def _toml(value: Any) -> str:
    return f"[{', '.join(map(_toml, value))}]" if isinstance(value, tuple) else repr(value)


def save_humans(
    path: Path,
    humans: tuple[Any, ...],
    remark: str,
    persons: tuple[Person, ...] = (),
    mechanics: Sequence[Mechanics] = (),
) -> Path:
    """Write a file for --human, and return its path. Voluntary motions are left out; `remark` becomes a comment."""
    lines = [f"# {line}" for line in remark.splitlines()]
    for human in humans:
        rows = (
            f"    {{ mass = {x.mass!r}, damping = {_toml(x.damping)}, stiffness = {_toml(x.stiffness)} }},"
            for x in human.links
        )
        lines += ["", "[[human]]", "links = [", *rows, "]"]
    for person in persons:
        body = [f"{name} = {getattr(person, name)!r}" for name in ("mass", "damping", "stiffness")]
        cross = f"cross = {{ damping = {person.cross.damping!r}, stiffness = {person.cross.stiffness!r} }}"
        lines += ["", "[[person]]", f"holds = {list(person.holds)}", *body, cross]
    for own in mechanics:
        lines += ["", "[[device]]", *(f"{name} = {value!r}" for name, value in msgspec.structs.asdict(own).items())]
    return write(path, "\n".join(lines) + "\n")


# ---- conversion of files, and error messages


def _is_rotary(text: str) -> bool:
    try:
        return toml(text, "").get("unit") == "rad"
    except InputError:
        return False


_NEEDED = ("name", "T", "theta", "device", "environment")


def _converted(text: str, kind: Any, source: str, folder: Path = Path()) -> Any:
    raw = toml(text, source)
    try:
        if kind is Scenario:
            _require_keys(raw)
            raw = _at_the_hand(raw)
        return msgspec.convert(_with_world(_in_space(_with_catalogue(raw)), folder), kind)
    except msgspec.ValidationError as error:
        raise InputError(f"{source}: {_located(str(error), raw)}") from None
    except ValueError as error:
        if place_of(error):  # The user's own class raised the error.
            raise
        raise InputError(f"{source}: {error}") from None


def _require_keys(raw: dict[str, Any]) -> None:
    """Raise ValueError if a key is missing that every scenario or every rotary device needs."""
    missing = [name for name in _NEEDED if name not in raw]
    # If there are unknown keys, msgspec.convert reports them instead: a key may be missing because it is misspelt.
    if missing and set(raw) <= set(Scenario.__struct_fields__):
        raise ValueError(f"missing {', '.join(missing)}; every scenario has {', '.join(_NEEDED)}")
    devices = raw.get("device") if raw.get("unit") == "rad" else None
    for i, table in enumerate(devices if isinstance(devices, list) else [devices] if devices else (), start=1):
        given = table if isinstance(table, dict) and "device" not in table else {}
        needed = (
            ("motor_mass", "handle_mass", "transmission_stiffness") if given.get("kind") == "compliant" else ("mass",)
        )
        if missing := [name for name in (*needed, "damping", "force_limit", "credible_speed") if name not in given]:
            raise ValueError(
                f"device #{i}: missing {', '.join(missing)}: rotary devices have neither defaults nor a catalogue"
            )


def _at_the_hand(raw: dict[str, Any]) -> dict[str, Any]:
    """Return the table of a rotary scenario with the default ranges of its population at the radius."""
    r, people = raw.get("radius"), raw.get("population", {})
    if raw.get("unit") != "rad" or not isinstance(r, int | float) or not 0 < r <= 1 or not isinstance(people, dict):
        return raw  # A linear scenario, or one without a valid radius.
    units = {name: np.array(getattr(Population(), name)) * r**2 for name in ("mass", "damping", "stiffness")}
    return raw | {"population": {name: each.tolist() for name, each in units.items()} | people}


def _with_catalogue(raw: dict[str, Any]) -> dict[str, Any]:
    """Return the table with fields in place of catalogue names of devices. Raises InputError for an unknown name."""
    devices = raw.get("device")
    if isinstance(devices, str):
        contacts = raw.get("environment", {}).get("contacts", [])
        devices = [devices] * (len(contacts) if isinstance(contacts, list) else 1)
    if not isinstance(devices, list):
        return raw
    tables = []
    for i, one in enumerate(devices, start=1):
        fields = {"device": one} if isinstance(one, str) else one
        if isinstance(fields, dict) and isinstance(name := fields.get("device"), str):
            try:
                fields = fields_of(name, {key: value for key, value in fields.items() if key != "device"})
            except ValueError as error:
                raise InputError(f"device #{i}: {error}") from None
        tables.append(fields)
    return raw | {"device": tables}


def _in_space(raw: dict[str, Any]) -> dict[str, Any]:
    """Return the table with one node per axis for each point of the environment, if the devices have several axes.

    The node of a clamped axis is the ground. Raises ValueError if contacts or springs do not fit the devices.
    """
    devices, table = raw.get("device"), raw.get("environment")
    tables = [one for one in devices if isinstance(one, dict)] if isinstance(devices, list) else []
    counts = [one.get("axes", 1) for one in tables]
    if all(n == 1 for n in counts) or not all(type(n) is int and 1 <= n <= len(AXES) for n in counts):
        return raw  # All devices have one axis, or msgspec.convert will refuse the number of axes.
    if not isinstance(table, dict) or table.get("points"):
        return raw
    for i, n in enumerate(counts, start=1):
        if n != counts[0]:
            raise ValueError(f"device #{i}.axes is {n}, expected {counts[0]} as for device #1: clamp axes instead")
    names = AXES[: counts[0]]
    held = [one.get("clamped", []) for one in tables]
    contacts, walls = table.get("contacts", []), table.get("walls", [])
    springs = [part for i, one in enumerate(table.get("springs", []), 1) for part in _along_axes(i, one, len(names))]
    parts = [*springs, *(walls if isinstance(walls, list) else [])]
    if not isinstance(contacts, list) or not all(isinstance(name, str) for name in contacts):
        return raw
    if len(contacts) != len(tables):
        raise ValueError(
            f"environment.contacts has {len(contacts)} points, expected {len(tables)}, one for each device"
        )
    ends = [end for part in parts if isinstance(part, dict) for end in _listed(part.get("between")) if end != GROUND]
    masses = table.get("masses", {})
    points = {name: [f"{name}.{axis}" for axis in names] for name in (*contacts, *ends, *masses)}
    for name, clamped in zip(contacts, held, strict=True):
        free = [axis for axis in names if axis not in _listed(clamped)]
        points[name] = [f"{name}.{axis}" if axis in free else GROUND for axis in names]
    flat = [node for name in contacts for node in points[name] if node != GROUND]
    return raw | {"environment": {**table, "contacts": flat, "springs": springs, "points": points}}


def _listed(value: Any) -> list[str]:
    return [part for part in value if isinstance(part, str)] if isinstance(value, list | tuple) else []


def _along_axes(number: int, spring: Any, axes: int) -> list[Any]:
    """Return springs along principal directions for a spring whose stiffness or damping is a list or a matrix.

    Raises ValueError if this spring also has `along`, or if the matrix is not symmetric and positive semidefinite.
    """
    fields = ("stiffness", "damping")
    several = [f for f in fields if isinstance(spring, dict) and isinstance(spring.get(f), list)]
    if not several:
        return [spring]
    if "along" in spring:
        raise ValueError(f"environment.springs #{number}: expected along or a list of {several[0]}, not both")
    rest = {key: value for key, value in spring.items() if key not in several}
    by_direction: dict[tuple[float, ...], dict[str, float]] = {}
    for name in several:
        field = f"environment.springs #{number}.{name}"
        value = spring[name]
        if not all(type(c) in (int, float) for row in value for c in (row if isinstance(row, list) else [row])):
            raise ValueError(f"{field} is {value!r}, expected numbers")
        matrix = symmetric(field, value, axes)
        diagonal = (matrix == np.diag(np.diag(matrix))).all()
        amounts, directions = (np.diag(matrix), np.eye(axes)) if diagonal else np.linalg.eigh(matrix)
        most = float(np.abs(amounts).max())
        if amounts.min() < -1e-12 * most:  # beyond the rounding of eigh
            raise ValueError(f"{field} is {value!r} with the eigenvalue {amounts.min():g}, expected none below 0")
        for amount, direction in zip(amounts.tolist(), directions.T.tolist(), strict=True):
            if amount > 1e-12 * most:
                by_direction.setdefault(tuple(direction), {})[name] = amount
    plain = [rest | {"stiffness": rest.get("stiffness", 0.0)}] if set(rest) - {"between"} else []
    directed = [{"stiffness": 0.0} | rest_of | {"along": list(n)} for n, rest_of in by_direction.items()]
    return [*plain, *({"between": spring.get("between")} | one for one in directed)]


_DEFAULT_DIRECTION = [1.0, 0.0, 0.0]  # direction in which a contact of a world slides without `along`


def _with_world(raw: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Return the table with path, digest and contact directions of its world. Raises ValueError for a wrong world."""
    table = raw.get("environment")
    if not isinstance(table, dict) or "world" not in table:
        if extra := [key for key in ("along", "every") if isinstance(table, dict) and key in table]:
            raise ValueError(f"environment.{extra[0]} is allowed only with environment.world")
        return raw
    from haptic_loop.models.world import check_contacts, digest_of  # loads MuJoCo, which other scenarios do not need

    name, contacts = table["world"], table.get("contacts", [])
    if not isinstance(name, str) or not isinstance(contacts, list) or not all(isinstance(c, str) for c in contacts):
        raise ValueError("environment.world: expected world = 'FILE.xml' and contacts, names of bodies in that file")
    points = table.get("points", {})
    if points and "along" in table:
        allowed = "contacts of devices with several axes slide along x, y and z; leave it out and clamp axes"
        raise ValueError(f"environment.along is {table['along']!r}: {allowed}")
    rows = table.get("along", [_DEFAULT_DIRECTION] * len(contacts))
    along = [_free_axes(nodes) for nodes in points.values()] or [[_direction(*row)] for row in enumerate(rows, 1)]
    path = (folder / name).resolve()
    try:
        world = {"file": str(path), "digest": digest_of(path), "along": along, "every": table.get("every", 1)}
        check_contacts(path, list(points) or contacts)
    except ValueError as error:
        raise ValueError(f"environment: {error}") from None
    rest = {key: value for key, value in table.items() if key not in ("along", "every")}
    return raw | {"environment": rest | {"world": world}}


def _free_axes(nodes: Sequence[str]) -> list[list[float]]:
    """Return the unit vectors along which a contact slides; `nodes` has its node for each axis."""
    return [row for row, node in zip(np.eye(len(AXES)).tolist(), nodes, strict=False) if node != GROUND]


def world_environment(table: dict[str, Any]) -> Network:
    """Return the environment of an [environment] table with the key `world`. Raises InputError for an invalid table."""
    try:
        return msgspec.convert(_with_world({"environment": table}, Path())["environment"], Network)
    except ValueError as error:
        raise InputError(str(error)) from None


def _direction(number: int, row: Any) -> list[float]:
    """Return the direction `row` scaled to unit length. Raises ValueError unless it is a direction."""
    length = 0.0
    if isinstance(row, list) and len(row) == 3 and all(type(c) in (int, float) and abs(c) < 1e6 for c in row):
        length = float(np.linalg.norm(row))
    if not 1e-6 < length < 1e6:
        raise ValueError(f"environment.along #{number} is {row!r}, expected finite numbers [x, y, z], not all zero")
    return [c / length for c in row]


def _without_folder(environment: Network) -> Network:
    """Return the environment with only the name of a world's file, without its folder."""
    if not environment.world:
        return environment
    world = msgspec.structs.replace(environment.world, file=Path(environment.world.file).name)
    return msgspec.structs.replace(environment, world=world)


def _network(own: Any, T: Any) -> Network:
    """Return the network of a user's own object. Raises InputError if the object lacks methods."""
    label = f"environment {type(own).__name__}"
    contacts, block = getattr(own, "contacts", None), None
    has_E = getattr(type(own), "E", Environment.E) is not Environment.E
    if not isinstance(contacts, list | tuple) or not (has_E or hasattr(own, "parts")):
        raise InputError(f"{label}: expected a class with contacts, and E(T) or parts()")
    if has_E:
        E = called(f"{label}.E(T)", own.E, T)
        if not isinstance(E, Lti):
            m, text = len(contacts), " ".join(repr(E).split())
            expected = f"a haptic_loop.controller.lti.Lti with {m} inputs and {m} outputs"
            raise InputError(f"{label}.E(T) is {text[:60]}, expected {expected}")
        block = called(label, Block.of, E)
    elements = (own,) if hasattr(own, "parts") else ()
    return called(label, Network, tuple(contacts), block=block, elements=elements)


class _Damped(msgspec.Struct, frozen=True):
    """Devices, and a new guaranteed damping for each of them."""

    delta: tuple[float, ...]  # [N s/m]
    device: tuple[Device, ...]

    def __post_init__(self) -> None:
        for i, damping in enumerate(self.delta, start=1):
            require(f"delta #{i}", damping, 0.0, MOST_DAMPING, "N s/m")
        if len(self.delta) != len(self.device):
            raise ValueError(f"delta has {len(self.delta)} entries for {len(self.device)} devices")

    def devices(self) -> tuple[Device, ...]:
        return tuple(one.with_damping(damping) for one, damping in zip(self.device, self.delta, strict=True))


def _strictly(fields: dict[str, Any], kind: Any) -> Any:
    """Return the fields as a struct `kind`, by the rules of a file. Raises InputError for a wrong field."""
    raw = {name: _plain(name, value) for name, value in fields.items()}
    try:
        return msgspec.convert(_in_space(_with_catalogue(raw)), kind)
    except msgspec.ValidationError as error:
        raise InputError(_located(str(error), raw)) from None


def _plain(name: str, value: Any) -> Any:
    """Return structs, tuples and NumPy's types as types of a file. Raises InputError for any other type."""

    def of_numpy(part: Any) -> Any:
        if isinstance(part, np.ndarray | np.generic):
            return part.tolist()
        raise InputError(f"{name} holds {part!r} ({type(part).__name__}), which no scenario can have")

    if isinstance(value, set | frozenset | bytes | bytearray):  # msgspec would take them for lists and text
        return of_numpy(value)
    return _lists(msgspec.to_builtins(value, enc_hook=of_numpy))


def _lists(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _lists(part) for name, part in value.items()}
    return [_lists(part) for part in value] if isinstance(value, list | tuple) else value


_NOBODY = Human((Link(0.0, 0.0, 0.0),))  # stands for a human of a user's own class while other fields are checked
_TIMES = np.array([0.0, 0.1])  # [s] times at which a user's own voluntary force is tested


def _is_own(name: str, value: Any) -> bool:
    """Return whether a value is a user's own population, or includes a MeasuredHand or a user's own human."""
    if name == "population":
        return callable(getattr(value, "draw", None)) and not isinstance(value, Population)
    parts = value if isinstance(value, list | tuple) else ()
    return any(hasattr(part, "port") and not isinstance(part, Human) for part in parts)


def _checked_own(value: Any) -> Any:
    """Return the value. Raises ValueError for an invalid human in a list; a population is not checked here."""
    if not isinstance(value, list | tuple):
        return value
    for i, human in enumerate(value, start=1):
        if not (callable(getattr(human, "port", None)) and callable(getattr(human, "voluntary_force", None))):
            raise ValueError(f"human #{i} is {human!r}, expected a Human, or a class with port(), voluntary_force(t)")
        if not isinstance(port := human.port(), Port):  # A Port that is not passive raises ValueError.
            raise ValueError(f"human #{i}.port() is {port!r}, expected a models.human.Port")
        try:
            with np.errstate(all="ignore"):
                force = np.asarray(human.voluntary_force(_TIMES))
        except (TypeError, ValueError) as error:
            raise ValueError(f"human #{i}.voluntary_force(t) fails for an array t of two times: {error}") from None
        if force.shape != _TIMES.shape or force.dtype.kind not in "fiu" or not np.isfinite(force).all():
            raise ValueError(f"human #{i}.voluntary_force(t) is {force!r} for two times, expected two forces in N")
    return tuple(value)


def _given_fields(device: Device) -> dict[str, Any]:
    """Return the fields of a device. Newer fields with their default value are left out: old digests stay valid."""
    fields = msgspec.to_builtins(device)
    for name, default in (("guaranteed", None), ("friction_max", None), ("axes", 1), ("clamped", ())):
        if fields.get(name) == default:
            fields.pop(name, None)
    return fields


def _contents(part: Any) -> Any:
    """Return what the digest hashes of an array, or of a user's own human or population."""
    return part.tolist() if isinstance(part, np.ndarray | np.generic) else [type(part).__qualname__, vars(part)]


def _located(message: str, raw: dict[str, Any]) -> str:
    """Return 'theta #1 = 1.5: expected `int`, got `float`' for 'Expected `int`, got `float` - at `$.theta[0]`'."""
    match = re.fullmatch(r"(.*?)(?: - at `(?:key in )?\$\.?(.*)`)?", message, flags=re.DOTALL)
    assert match
    problem, path = match[1], match[2] or ""
    problem += _hint(problem)
    value: Any = raw
    for key, index in re.findall(r"([^.\[\]]+)|\[(\d+)\]", path):
        try:
            value = value[int(index)] if index else value[key]
        except (KeyError, IndexError, TypeError):
            value = None
            break
    shown = f" = {value!r}" if isinstance(value, int | float | str) else ""
    if problem[1:2].islower():  # The message does not start with a symbol.
        problem = problem[0].lower() + problem[1:]
    return f"{counted(path)}{shown}: {problem}" if path else problem


def _hint(problem: str) -> str:
    """Return the allowed values, or a similar name, for messages of msgspec that lack them."""
    unknown = re.search(r"unknown field `(.*)`", problem)
    if unknown:
        known = {name for struct in _STRUCTS for name in struct.__struct_fields__}
        close = difflib.get_close_matches(unknown[1], sorted(known - {unknown[1]}), n=1)
        return f" (did you mean `{close[0]}`?)" if close else ""
    if problem.startswith("Invalid value"):
        return f", allowed are {' and '.join(repr(d.__struct_config__.tag) for d in get_args(Device))}"
    return ""


_STRUCTS = (
    Scenario, _Tap, VaryingDelay, Human, Link, Voluntary, Person, Cross, Population, Network, Spring, Wall, Ranges,
    UncertainSpring, *get_args(Device)
)  # fmt: skip
