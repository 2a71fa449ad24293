"""Estimate mass, friction and transmission of one axis from a record of forces and displacements; bound its damping.

The excitation is a chirp of a small force, slow motions, a swing that reaches the speed of a session, a chirp with the
force of the swing, and silence (`chirp`). This force does not depend on the motion, so it closes no loop and needs no
certificate. Mass and friction come from the balance of forces (hw/friction.py). Damping that falls with speed or
frequency is refused (hw/viscosity.py). The transmission is fitted to the spectra of the motion and of the force less
dry friction.
"""

from __future__ import annotations

if __name__ == "__main__":  # before the imports, which --help does not need
    from haptic_loop.cli.main import run_command

    run_command("identify")

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from haptic_loop.controller.lti import Array, frozen
from haptic_loop.hw.control import Controller
from haptic_loop.hw.emulator import nobody
from haptic_loop.hw.friction import Friction, at_radius, dry_friction, friction
from haptic_loop.hw.recording import Recorder
from haptic_loop.hw.session import STRONGEST, Session
from haptic_loop.hw.viscosity import Spectra, Viscosity, doubt, fitted, starts, viscosity
from haptic_loop.models.hold import hold
from haptic_loop.models.scene import build
from haptic_loop.sim.scenario import Scenario

_SLOW_SPAN = 4.0  # highest frequency of a slow sweep over its lowest
_LOUD_HZ, _LOUD_LENGTH = (10.0, 130.0), 4  # band of the sweep with the swing's force, and its length over `seconds`
_LEVELS = (0.4, 0.6, 0.8, 1.0)  # amplitudes of the swing, as shares of the largest
_CYCLES = 3  # cycles of the swing at each amplitude
_LEAD = 0.3  # [s] of zero force, while the gain rises
_BAND_HZ = (20.0, 300.0)  # band in which the motion shows a transmission
#: lower limits of the first seven parameters of Spectra.model; c = 0: friction without memory
_LEAST = np.array([-20.0] * 4 + [0.0, 0.0, -2e-3])
_STEPS = 40  # largest number of evaluations in a fit
_VAGUE = 0.3  # largest unexplained share of the motion with which a fitted transmission is accepted
_SPRUNG = 5.0  # [N/m] largest stiffness of a free axis with its cable; a hand is stiffer
_SUSPICIOUS = 0.1  # relative excess of damping up to which no hand is suspected


# the excitation, a force that does not depend on the motion


@dataclass(frozen=True, eq=False)
class Excitation:
    """A program that plays given forces in a session. Without feedback it can make no passive person unstable."""

    signal: Array  # (ticks, m) [N]
    T: float  # [s]
    link: int  # [ticks]
    margin_us: float = 0.0  # a force that comes before its latch is not late

    def __post_init__(self) -> None:
        object.__setattr__(self, "signal", frozen(self.signal, 2))

    @property
    def certified(self) -> bool:
        """True, because a force that the motion does not change closes no loop."""
        return True

    @property
    def name(self) -> str:
        return f"open-loop force of at most {np.abs(self.signal).max():g} N"

    @property
    def seconds(self) -> float:
        return len(self.signal) * self.T

    def controller(self, cap: Sequence[float]) -> Controller:
        return _Player(self)


class _Player:
    """Play an excitation tick by tick, then zero force."""

    def __init__(self, excitation: Excitation) -> None:
        self.T = excitation.T
        self._forces = iter(excitation.signal.tolist())

    def step(self, x: Sequence[float]) -> Sequence[float]:
        return next(self._forces, [0.0] * len(x))


@dataclass(frozen=True)
class Swing:
    """A slow swing of every axis at rising amplitudes, the last of which reaches the speed of a session."""

    force: tuple[float, ...]  # (m,) [N] amplitude of the fastest part
    hz: float

    @classmethod
    def of(cls, scenario: Scenario, speed: float, travel: float) -> Swing:
        """Return a swing that reaches `speed` [m/s] within +-`travel` [m] for the scenario's mass and damping.

        Its forces stay within the limits of device and session; an axis that would need a larger force stays slower.
        """
        w, counts = speed / travel, [len(device.free) for device in scenario.device]
        most = STRONGEST * scenario.lever / np.sqrt(np.repeat(counts, counts))
        need = [
            min(device.force_limit, limit, speed * abs(complex(device.damping, w * sum(device.bodies.values()))))
            for device, limit in zip(scenario.axis_devices, most.tolist(), strict=True)
        ]
        return cls(tuple(need), w / (2 * np.pi))

    def signal(self, T: float) -> Array:
        """Return forces (ticks, m) [N]: whole cycles of a cosine at each of _LEVELS."""
        t = np.arange(round(_CYCLES / self.hz / T)) / round(_CYCLES / self.hz / T)
        wave = np.concatenate([level * np.cos(2 * np.pi * _CYCLES * t) for level in _LEVELS])
        return wave[:, None] * np.array(self.force)


def chirp(
    channels: int,
    T: float,
    link: int,
    amplitude: float,
    band: tuple[float, float],
    seconds: float,
    swing: Swing | None = None,
    slew: float = np.inf,
) -> Excitation:
    """Return the force to play: zero for 0.3 s, cosines of exponentially rising frequency, a swing, then silence.

    The first cosine passes through `band` [Hz]; the second and the last are slow, the last at half the force. Each of
    these three cosines takes `seconds`, and the silence takes half of this time. Two slow motions at two levels of
    force show friction that is not viscous, and the swing between them shows it at the speed of a session. After the
    swing, a long cosine with the force of the swing shows how damping changes with frequency. Fast cosines become
    smaller where their force would change by more than `slew` [N/s], because a distorted cosine pushes a mass away.
    Each part ends at a whole cycle, so that a free mass does not drift away. Only the last part ends a quarter of a
    cycle later, so that the device is released while it moves.
    """

    def sweep(low: float, high: float, force: Sequence[float], further: float = 0.0, times: int = 1) -> Array:
        ratio, ticks = high / low, round(times * seconds / T)
        cycles = max(1, round(times * seconds * (high - low) / np.log(ratio))) + further
        phase = 2 * np.pi * cycles * (ratio ** (np.arange(ticks) / ticks) - 1) / (ratio - 1)
        most = slew / np.gradient(phase, T)
        return np.minimum(force, most[:, None]) * np.cos(phase)[:, None]

    low, high = band
    slower, span, force = low / np.sqrt(2.0), min(_SLOW_SPAN, high / low), (amplitude,) * channels
    parts = [sweep(low, high, force), sweep(low, span * low, force)]
    if swing:
        loud = sweep(_LOUD_HZ[0], min(_LOUD_HZ[1], 0.3 / T), swing.force, times=_LOUD_LENGTH)
        parts += [swing.signal(T), loud]
    parts.append(sweep(slower, span * slower, force, 0.25) / 2)
    lead, tail = (np.zeros((round(s / T), channels)) for s in (_LEAD, seconds / 2))
    return Excitation(np.concatenate([lead, *parts, tail]), T, link)


def free_motion(scenario: Scenario, excitation: Excitation) -> Array:
    """Return the motion (ticks, m) [m] that the excitation gives to the motors of the scenario, if nobody holds them.

    A transmission makes a motor move faster than its handle where a chirp passes the mode.
    """
    scene, m = build(scenario.device, nobody(scenario).human), scenario.channels
    plant = hold(scene.plant, scenario.T)
    state, forced = np.zeros(len(plant.A)), excitation.signal @ -plant.B[:, scene.outside :].T
    positions = np.zeros((len(forced), m))
    for k, step in enumerate(forced):
        positions[k], state = state[:m], plant.A @ state + step
    return positions


@dataclass(frozen=True)
class _Transmission:
    """Motor and handle, and the spring between them."""

    motor_mass: float  # [kg]
    handle_mass: float  # [kg]
    stiffness: float  # [N/m]
    mode_hz: float  # [Hz] natural frequency with both ends free


@dataclass(frozen=True)
class Estimate:
    """The estimated friction and transmission of one axis, and how its damping varies."""

    friction: Friction
    transmission: _Transmission | None  # None for a rigid device, or if no transmission explains the record
    viscosity: Viscosity

    @property
    def viscous(self) -> float:
        return self.friction.viscous

    @property
    def delta(self) -> float:
        """Lower bound of the damping [N s/m] at the recorded speeds and frequencies."""
        return min(self.friction.delta, self.viscosity.lasting)


def identify(x: Array, force: Array, T: float, step: float, rigid: bool, lever: float = 1.0) -> Estimate:
    """Fit one axis to displacements x (N,) [m] under motor forces (N,) [N] of period T [s], with encoder `step` [m].

    Radians and N m of a rotary axis are converted to metres and N at the hand, whose radius is `lever` [m], and fitted.

    Raises ValueError where the device did not move, a hand holds it, the bound of its damping is 0, or its damping
    falls with speed or frequency.
    """
    # The last third has a slow sweep, so that it shows an encoder or motor that has died.
    for when, part, least in (("", x, 20), (" in the last third of the record", x[2 * len(x) // 3 :], 5)):
        if (steps := np.ptp(part) / step) < least:
            raise ValueError(f"the axis moved by {steps:.0f} encoder steps{when}, at least {least} are needed")
    hand = lever * x, force / lever, T
    try:
        found = friction(*hand, lever * step)
    except ValueError:  # fewer usable samples than the fit has parameters
        raise ValueError(
            f"the motion is too small for encoder steps of {1e3 * step:.3g} mm: use a finer encoder, or more --force"
        ) from None
    law, allowed = at_radius(found, lever), _SPRUNG * lever**2
    # also refuse a stiffness that is too uncertain to exclude a hand
    if (most := law.stiffness + 2 * law.errors["stiffness"]) > allowed:
        raise ValueError(
            f"the handle is sprung by {law.stiffness:.3g} N/m (up to {most:.3g}, allowed {allowed:.3g}): does a "
            "hand or a finger rest on it? The fit would count its damping as the device's; let go, or loosen the spring"
        )
    if law.delta <= 0:
        raise ValueError(
            f"the record does not tell viscous from dry friction: {law.viscous:.3g} N s/m viscous, "
            f"{law.coulomb:.3g} N dry, {1e3 * law.rms:.2g} mN unexplained; record with more force, or for longer"
        )
    examined = at_radius(viscosity(*hand, lever * step, found), lever)
    if reason := doubt(examined, law):
        raise ValueError(reason)
    transmission = None if rigid else _transmission(*hand, found)
    return Estimate(law, transmission and at_radius(transmission, lever), examined)


def _transmission(x: Array, force: Array, T: float, found: Friction) -> _Transmission | None:
    """Return the transmission that explains the spectrum of a record, or None.

    The encoder is at the motor, where dry friction acts. So the force minus dry friction drives a linear plant.
    """
    spectrum = Spectra(x, force - dry_friction(x, T, found), T, band=_BAND_HZ, points=len(x))
    limits = _LEAST, np.full(7, np.inf)
    fits = [fitted(spectrum.error, spectrum.jacobian, p[:7], limits, _STEPS) for p in starts([spectrum], found)]
    fit = min(fits, key=lambda fit: fit.cost)
    if 2 * fit.cost > (_VAGUE * np.linalg.norm(spectrum.motion) / np.abs(spectrum.motion).max()) ** 2:
        return None
    m1, m2, k = np.exp(fit.x[:3])
    return _Transmission(float(m1), float(m2), float(k), float(np.sqrt(k * (m1 + m2) / (m1 * m2)) / (2 * np.pi)))


# from a session's record


def held(estimates: list[Estimate], scenario: Scenario, session: Session) -> list[str]:
    """Return warnings for axes with over 10 % more damping than INFO and the scenario declare.

    A smaller excess gives no warning: estimates of a correct device scatter about the declared damping, and one bound
    in twenty exceeds the damping.
    """
    causes = []
    for i, (e, said) in enumerate(zip(estimates, _declared(scenario, session), strict=False), start=1):
        if e.viscous > (1 + _SUSPICIOUS) * said:
            causes.append(
                f"axis {i}: {e.viscous:.4g} N s/m estimated, {said:.4g} declared (scenario, INFO): is a hand "
                "on it? No bound is offered; if the device really has more damping, declare it and take another record"
            )
    return causes


def settled(sittings: Sequence[Sequence[Estimate]]) -> tuple[list[Estimate], list[str]]:
    """Return one estimate per axis from two or more recordings (sittings), and warnings of recordings damped by a hand.

    Each axis gets the estimate of its least damped recording, and the least bound of all recordings. A passive hand
    only adds damping, so no hand damped the least damped recording, unless a hand damped all recordings.
    Raises ValueError for one recording, or where no other recording agrees with the least damped one.
    """
    if len(sittings) < 2:
        raise ValueError("one sitting cannot tell a hand's damping from the device's: take two (--sittings)")
    axes, words = [], []
    for i, axis in enumerate(zip(*sittings, strict=True), start=1):
        least, *others = sorted(axis, key=lambda e: e.viscous)
        figures = ", ".join(f"{e.viscous:.4g}" for e in axis)
        told = f"axis {i}: {figures} N s/m in sittings 1 to {len(axis)}, a hand damped it in"
        if _more_damped(others[0], least):
            raise ValueError(f"{told} one at least. The two lowest must agree: let go, and take more (--sittings)")
        if hands := [f"{k}" for k, e in enumerate(axis, start=1) if _more_damped(e, least)]:
            words.append(f"{told} {', '.join(hands)}, which did not count")
        slowest = min(axis, key=lambda e: e.viscosity.speed).viscosity  # no sitting's bound holds beyond its speed
        bound = replace(least.friction, delta=min(e.delta for e in axis))
        axes.append(replace(least, friction=bound, viscosity=slowest))
    return axes, words


def unbounded(estimates: Sequence[Estimate]) -> str:
    """Return why the first axis without a bound has no bound, or "" if all axes have bounds."""
    for i, e in enumerate(estimates, start=1):
        if e.delta <= 0:
            return (
                f"axis {i}: the record does not exclude that all damping is gone beyond "
                f"{1 / (2 * np.pi * e.viscosity.memory):.2g} Hz: record for longer (--seconds), or use a finer encoder"
            )
    return ""


def _more_damped(one: Estimate, least: Estimate) -> bool:
    """Return whether the damping of `one` exceeds that of `least` by more than recordings of a free device differ."""
    scatter = 2 * np.hypot(one.friction.errors["viscous"], least.friction.errors["viscous"])
    return one.viscous - least.viscous > _SUSPICIOUS * least.viscous + scatter


def _declared(scenario: Scenario, session: Session) -> list[float]:
    """Return the damping of every axis [N s/m], the larger of the scenario's and INFO's."""
    guaranteed = [1e-6 * d for d in session.info.osp_damping] if session.info else [0.0] * scenario.channels
    return [max(device.damping, said) for device, said in zip(scenario.axis_devices, guaranteed, strict=True)]


def capped(estimates: list[Estimate], scenario: Scenario, session: Session) -> list[Estimate]:
    """Limit the bounds to the declared damping, because any excess may come from a hand."""
    said = _declared(scenario, session)
    return [
        replace(e, friction=replace(e.friction, delta=min(e.delta, limit)))
        for e, limit in zip(estimates, said, strict=False)
    ]


def records_of(recorder: Recorder, session: Session) -> list[tuple[Array, Array]]:
    """Return displacements [m] and forces [N], (N,) each, of every axis. Raises ValueError where ticks are missing."""
    link, units = recorder.link(), session.units
    missing = int((~link["received"]).sum())
    if missing:  # the force in a missing tick is uncertain, and a wrong force gives a wrong bound
        raise ValueError(f"{missing} of {len(recorder)} ticks came without a STATE: take another record")
    return [(link["x"][:, i], link["applied"][:, i] * units.force_step[i]) for i in range(recorder.channels)]


def estimate(
    recorder: Recorder,
    session: Session,
    scenario: Scenario,
    progress: Callable[[int, int, str], None] = lambda done, total, what: None,
) -> list[Estimate]:
    """Return one estimate per axis of a recorded session. Raises ValueError naming an axis without an estimate."""
    estimates, records = [], records_of(recorder, session)
    for i, device in enumerate(scenario.axis_devices):
        progress(i, scenario.channels, f"estimating axis {i + 1}")
        try:
            step = session.units.encoder_step[i]
            rigid = device.transmission is None
            estimates.append(identify(*records[i], scenario.T, step, rigid, scenario.lever))
        except ValueError as error:
            raise ValueError(f"axis {i + 1}: {error}") from None
    return estimates
