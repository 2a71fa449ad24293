"""Mass, friction and transmission of one axis from a record of forces and displacements, and a bound on its friction.

The excitation is a chirp of a small force, slow motion at half of it, then silence: a force that does not depend on the
motion closes no loop, so no certificate is needed. Mass and friction come from the balance of forces (hw/friction.py).
The transmission is output error: the parameters whose simulated displacement is nearest to the encoder's in the
least-squares sense, where a standstill counts as few samples.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import product
from math import tanh
from typing import Any

import numpy as np
import scipy  # its parts load when they are used
from numpy.typing import NDArray

from controller.lti import Array, frozen
from hw.control import Controller
from hw.friction import Friction, friction
from hw.recording import Recorder
from hw.session import Session
from sim.scenario import Scenario

_APART = 1  # [counts] that noise may move an encoder at rest: it reads two neighbours in turn
_WORTH = 5.0  # samples that one standstill counts as
_Flags = NDArray[np.bool_]
_COULOMB = 2  # where Coulomb friction is among the parameters
_SHIFT = 1e-5  # of log parameters, and of Coulomb friction in newtons, for derivatives
_UNEXPLAINED = 0.7, 1.5e-3  # encoder steps rms (rounding alone leaves 0.29), or this part of the motion's rms
_SLIP = 0.002  # [m/s] speed at which Coulomb friction is at 3/4
_COARSE, _FINE = 3, 8  # substeps of a tick for which it is held: in a search, and at its end
_SLOW_SPAN = 4.0  # of the slow sweeps' frequencies
_LEAD = 0.3  # [s] of zero force, in which the gain comes up
_MODES_HZ = np.geomspace(25.0, 300.0, 60)  # where a mode is looked for first
_FAST, _A_WHILE = 0.1, 0.02  # part of the largest mean square change of a force, and [s] of that mean
_PARTS = (0.15, 0.25, 0.35, 0.5, 0.65)  # of the mass, that the motor may have
_STARTS = 2  # of the search in time
_SPECTRUM = 250  # frequencies that are compared first
_FLOOR = 1e-12  # of a ratio whose logarithm is taken
_OUTLIER = 0.1  # of a logarithm, from which it counts less: friction spoils the low frequencies, a resonance is narrow
_EVALUATIONS = 30  # of a search, less those for derivatives
_POLISH = 15  # steps at the end, with friction integrated more finely
_ENOUGH = 1e-6  # part of the sum of squares, from which on a step is the last one
_VAGUE = 10.0  # times what rounding leaves: then it is not this transmission
_SPRUNG = 5.0  # [N/m] from which on it may be a hand: a cable has less
_LEAST_FRICTION = 1e-5  # that a search begins with, of the force's span
_SEARCH_REACH = 3.0  # of a search, in logarithms
_SUSPICIOUS = 0.1  # part by which an estimate may exceed the declared damping


# A force that does not depend on the motion: a chirp, then silence. What a device is identified with.


@dataclass(frozen=True, eq=False)
class Excitation:
    """Forces fed back over time, as a program for a session. Open loop: it can make no passive person unstable."""

    signal: Array  # (ticks, m) [N]
    T: float  # [s]
    link: int  # [ticks]
    margin_us: float = 0.0  # forces are late after their latch, not before

    def __post_init__(self) -> None:
        object.__setattr__(self, "signal", frozen(self.signal, 2))

    @property
    def certified(self) -> bool:
        """A force that the motion does not change closes no loop."""
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
    """Plays an excitation tick by tick, then zero."""

    def __init__(self, excitation: Excitation) -> None:
        self.T = excitation.T
        self._forces = iter(excitation.signal.tolist())

    def step(self, x: Sequence[float]) -> Sequence[float]:
        return next(self._forces, [0.0] * len(x))


def chirp(
    channels: int, T: float, link: int, amplitude: float, band: tuple[float, float], seconds: float
) -> Excitation:
    """The force [N] that is played to a device: three cosines of exponentially rising frequency, then silence.

    The first passes through `band` [Hz]; the second and the third are slow, the third at half the force. Each takes
    `seconds`, the silence half of that. Two slow motions at two levels of force show friction that is not viscous.
    Each cosine ends at a whole cycle, so that a free mass does not drift away; the last one ends a quarter of a cycle
    later, so that the device is released with a speed.
    """
    t = np.arange(round(seconds / T)) / round(seconds / T)

    def sweep(low: float, high: float, further: float = 0.0) -> Array:
        ratio = high / low
        cycles = max(1, round(seconds * (high - low) / np.log(ratio))) + further
        return amplitude * np.cos(2 * np.pi * cycles * (ratio**t - 1) / (ratio - 1))

    low, high = band
    slower, span = low / np.sqrt(2.0), min(_SLOW_SPAN, high / low)
    parts = sweep(low, high), sweep(low, span * low), sweep(slower, span * slower, 0.25) / 2
    lead, tail = np.zeros(round(_LEAD / T)), np.zeros(round(seconds / 2 / T))
    return Excitation(np.tile(np.concatenate([lead, *parts, tail])[:, None], channels), T, link)


# How much a sample of an encoder is worth to a fit: all samples of one standstill together as much as a few.
#
# An encoder that stands still tells its position to half a step, however often it is read: the error of every sample is
# the same one. Least squares that takes a thousand such samples for a thousand measurements moves the last place of a
# release to the middle of its count, at the price of friction: Coulomb and viscous are exchanged until it fits.


def worth(counts: Array) -> Array:
    """Weights (N,) in (0, 1] of samples (N,) [counts]: 1 while the encoder moves, WORTH/L in a standstill of L samples.

    A standstill is a stretch, as long as possible from left to right, in which the counts differ by _APART at most.
    """
    starts, low, high = [0], counts[0], counts[0]
    for k, n in enumerate(counts.tolist()):
        low, high = min(low, n), max(high, n)
        if high - low > _APART:
            starts.append(k)
            low = high = n
    lengths = np.diff([*starts, len(counts)])
    return np.repeat(np.minimum(1.0, _WORTH / lengths), lengths)


# One axis: the displacement that a record of forces gives, for any mass, friction, transmission.
#
# The model is the device's: motor (m1) with viscous friction b and Coulomb friction c, transmission spring k, handle
# (m2). Between ticks it is exact for a held force (expm); Coulomb friction is
# c tanh(v/v0), held for an eighth of a tick.


class _Model:
    """p = [log m1, log b, c, log m2, log k] -> simulated displacement."""

    def __init__(self, x: Array, force: Array, used: _Flags, T: float, step: float, substeps: int = _COARSE) -> None:
        self.x, self.force, self.used, self.T, self.step, self.substeps = x, force, used, T, step, substeps
        self.weight = worth(np.round(x[used] / step))

    def finer(self) -> _Model:
        """The same record, friction integrated more finely."""
        return _Model(self.x, self.force, self.used, self.T, self.step, _FINE)

    def matrices(self, p: Array, T: float) -> tuple[Array, Array]:
        """The plant held for T: s+ = A s + B u with s = [positions; velocities]."""
        m1, b, m2, k = np.exp(p[[0, 1, 3, 4]])
        a = np.zeros((5, 5))
        a[0, 2] = a[1, 3] = 1.0
        a[2] = [-k / m1, k / m1, -b / m1, 0.0, 1 / m1]
        a[3, :2] = [k / m2, -k / m2]
        step = np.asarray(scipy.linalg.expm(a * T), dtype=np.float64)
        return step[:-1, :-1], step[:-1, -1]

    def simulate(self, p: Array) -> Array:
        """Displacement (N,) [m] from rest."""
        substeps = self.substeps if p[_COULOMB] else 1
        A, B = self.matrices(p, self.T / substeps)
        return np.array(_play(A.tolist(), B.tolist(), float(p[_COULOMB]), self.force.tolist(), substeps))

    def allowed(self) -> float:
        """The largest error of an acceptable fit [m] rms."""
        return max(_UNEXPLAINED[0] * self.step, _UNEXPLAINED[1] * float(np.std(self.x[self.used])))

    def error(self, p: Array) -> Array:
        """Measured minus simulated (used,) [m], less its mean: the origin is unknown."""
        error = (self.x - self.simulate(p))[self.used]
        error -= np.average(error, weights=self.weight)
        return np.nan_to_num(error, nan=1e3, posinf=1e3, neginf=-1e3)

    def residual(self, p: Array) -> Array:
        """What a fit minimises: the error (used,) [m] times the root of each sample's weight."""
        return np.sqrt(self.weight) * self.error(p)

    def jacobian(self, p: Array) -> Array:
        """Derivatives of the displacement (used, p) by central differences."""
        shifts = _SHIFT * np.eye(p.size)
        columns = [(self.simulate(p + s) - self.simulate(p - s))[self.used] for s in shifts]
        return np.stack(columns, axis=1) / (2 * _SHIFT)

    def slopes(self, p: Array) -> Array:
        """Derivatives of what is subtracted in residual() (used, p)."""
        J = self.jacobian(p)
        return np.sqrt(self.weight)[:, None] * (J - np.average(J, axis=0, weights=self.weight))

    def rms(self, residual: Array) -> float:
        """The rms error [m] that belongs to a residual."""
        return float(np.sqrt(residual @ residual / self.weight.sum()))


def _play(A: list[list[float]], B: list[float], c: float, force: list[float], substeps: int) -> list[float]:
    """Displacements of the motor of two masses; plain floats, since so small a product is all overhead to NumPy."""
    (a00, a01, a02, a03), (a10, a11, a12, a13), (a20, a21, a22, a23), (a30, a31, a32, a33) = A
    b0, b1, b2, b3 = B
    x, y, v, w, out = 0.0, 0.0, 0.0, 0.0, []
    for f in force:
        out.append(x)
        for _ in range(substeps):
            u = f - c * tanh(v / _SLIP)
            x, y, v, w = (
                a00 * x + a01 * y + a02 * v + a03 * w + b0 * u,
                a10 * x + a11 * y + a12 * v + a13 * w + b1 * u,
                a20 * x + a21 * y + a22 * v + a23 * w + b2 * u,
                a30 * x + a31 * y + a32 * v + a33 * w + b3 * u,
            )
    return out


# Where the search for a transmission begins: the modes and splits of the mass that fit the spectrum.
#
# A search in time stops at any mode but the right one, and two per cent from it is already another one: a mode is but a
# few tenths of a hertz wide. The spectrum is that of the steps x[k+1] - x[k], which begin and end at rest, over that of
# the forces, where the force had something to say.


class _Spectrum:
    """The measured ratio of steps to forces, and how far a model is from it."""

    def __init__(self, model: _Model) -> None:
        force, moved = np.fft.rfft(model.force), np.fft.rfft(np.diff(model.x, append=model.x[-1]))
        loud = 1 + np.flatnonzero(np.abs(force[1:]) > 0.2 * np.abs(force).max())  # a free mass has no answer at 0 Hz
        self.model, self.z = model, np.exp(2j * np.pi * loud / len(model.force))
        self.measured = np.log(np.abs(moved[loud] / force[loud]) + _FLOOR)

    def apart(self, point: Array, every: int = 1) -> Array:
        """Logarithms of the model's ratio less the measured one's, at every so many frequencies."""
        A, B = self.model.matrices(point, self.model.T)
        z = self.z[::every]
        G = np.linalg.solve(z[:, None, None] * np.eye(len(A)) - A, np.broadcast_to(B[:, None], (z.size, len(A), 1)))
        return np.log(np.abs((z - 1) * G[:, 0, 0]) + _FLOOR) - self.measured[::every]

    def refined(self, point: Array) -> tuple[float, Array]:
        """The nearest point by all frequencies, and how far it is; Coulomb friction stays."""

        def apart(p: Array) -> Array:
            return self.apart(np.insert(p, _COULOMB, point[_COULOMB]))

        start, robust = np.delete(point, _COULOMB), {"loss": "soft_l1", "f_scale": _OUTLIER}
        fit = scipy.optimize.least_squares(apart, start, max_nfev=40, **robust)
        return float(fit.cost), np.insert(fit.x, _COULOMB, point[_COULOMB])


def _spectral_starts(model: _Model, stiff: Array) -> list[Array]:
    """Parameters to begin with, best first, from those of a stiff device: [log m, log b, c]."""
    spectrum = _Spectrum(model)
    every = max(1, spectrum.z.size // _SPECTRUM)
    points, mass = [], float(np.exp(stiff[0]))
    for hz, part in product(_MODES_HZ, _PARTS):
        m1, m2 = part * mass, (1 - part) * mass
        k = (2 * np.pi * hz) ** 2 * m1 * m2 / mass
        point = np.array([np.log(m1), max(stiff[1], -2.0), stiff[_COULOMB], np.log(m2), np.log(k)])
        # absolute: a few bins of a resonance may lie far apart
        points.append((float(np.abs(spectrum.apart(point, every)).mean()), point))
    best: dict[float, Array] = {}
    for _, point in sorted(points, key=lambda entry: entry[0]):
        best.setdefault(round(float(point[0]), 6), point)  # the best mode of every split
    refined = [spectrum.refined(point) for point in list(best.values())[:_STARTS]]
    return [point for _, point in sorted(refined, key=lambda entry: entry[0])]


# the fit


@dataclass(frozen=True)
class _Transmission:
    """Motor and handle, and the spring between them."""

    motor_mass: float  # [kg]
    handle_mass: float  # [kg]
    stiffness: float  # [N/m]
    mode_hz: float  # free at both ends


@dataclass(frozen=True)
class Estimate:
    """One axis."""

    friction: Friction
    transmission: _Transmission | None  # None for a rigid device, and where none explains the record

    @property
    def viscous(self) -> float:
        return self.friction.viscous

    @property
    def delta(self) -> float:
        return self.friction.delta


def identify(x: Array, force: Array, used: _Flags, T: float, step: float, rigid: bool) -> Estimate:
    """Fit one axis: displacements x (N,) [m], what the motor did (N,) [N], which samples count (N,), encoder step [m].

    Raises ValueError where the device did not move, a hand holds it or nothing is left of its damping.
    """
    if np.ptp(x[used]) < 20 * step:
        raise ValueError(f"the axis moved by {np.ptp(x[used]) / step:.0f} encoder steps, at least 20 are needed")
    found = friction(x, force, T, step)
    # one that is too uncertain to exclude a hand is refused as well
    if (most := found.stiffness + 2 * found.errors["stiffness"]) > _SPRUNG:
        raise ValueError(
            f"the handle is sprung by {found.stiffness:.3g} N/m (up to {most:.3g}, at most {_SPRUNG:g} may be): a hand "
            "or a finger rests on it? Its damping would be taken for the device's; let go, or loosen the spring"
        )
    if found.delta <= 0:
        raise ValueError(
            f"the record does not tell viscous from dry friction: {found.viscous:.3g} N s/m viscous, "
            f"{found.coulomb:.3g} N dry, {1e3 * found.rms:.2g} mN unexplained; take one with more force or a longer one"
        )
    if rigid:
        return Estimate(found, None)
    end = _end_of_chirp(force, T)
    return Estimate(found, _transmission(_Model(x[:end], force[:end], used[:end], T, step), found))


def _end_of_chirp(force: Array, T: float) -> int:
    """Where forces (N,) [N] that excite a transmission end: slow motion tells nothing of it."""
    changes = np.convolve(np.diff(force) ** 2, np.ones(max(2, round(_A_WHILE / T))))[: len(force)]
    return int(np.flatnonzero(changes > _FAST * changes.max())[-1])


def _transmission(model: _Model, found: Friction) -> _Transmission | None:
    """The transmission that explains a record, None where there is none."""
    stiff = np.array([np.log(found.mass), np.log(found.viscous), found.coulomb])
    fine, ends = model.finer(), []
    for start in _spectral_starts(model, stiff):
        p = _polished(fine, _search(model, start).x)
        ends.append((fine.rms(fine.residual(p)), p))
        if ends[-1][0] <= fine.allowed():
            break
    rms, p = min(ends, key=lambda end: end[0])
    if rms > _VAGUE * fine.allowed():
        return None
    m1, m2, k = np.exp(p[[0, 3, 4]])
    mode = np.sqrt(k * (m1 + m2) / (m1 * m2)) / (2 * np.pi)
    return _Transmission(float(m1), float(m2), float(k), float(mode))


def _search(model: _Model, start: Array) -> scipy.optimize.OptimizeResult:
    strongest = np.ptp(model.force)
    start = start.copy()
    start[_COULOMB] = np.clip(start[_COULOMB], _LEAST_FRICTION * strongest, strongest / 2)
    free = np.arange(start.size) != _COULOMB
    bounds = (np.where(free, start - _SEARCH_REACH, 0.0), np.where(free, start + _SEARCH_REACH, strongest))
    # the tolerance is of a sum of squares with a kink; what is left unexplained is looked at afterwards
    options: dict[str, Any] = {"x_scale": "jac", "max_nfev": _EVALUATIONS, "ftol": 1e-4}
    slopes: Any = lambda p: -model.slopes(p)  # noqa: E731 - SciPy's stub takes names only
    return scipy.optimize.least_squares(model.residual, start, slopes, bounds=bounds, **options)


def _polished(model: _Model, p: Array) -> Array:
    """The nearest parameters from close by: Gauss-Newton steps as long as they help, halved where they do not.

    A search that stops where its sum of squares hardly changes may be several standard errors away.
    """
    residual = model.residual(p)
    for _ in range(_POLISH):
        change = np.linalg.lstsq(model.slopes(p), residual, rcond=None)[0]
        for part in (1.0, 0.5, 0.1):
            other = p + part * change
            other[_COULOMB] = max(0.0, other[_COULOMB])
            left = model.residual(other)
            if left @ left < residual @ residual:
                break
        else:
            break
        gain = 1 - (left @ left) / (residual @ residual)
        p, residual = other, left
        if gain < _ENOUGH:
            break
    return p


# from a session's record


def held(estimates: list[Estimate], scenario: Scenario, session: Session) -> list[str]:
    """Warnings for axes with far more damping than INFO and the scenario declare.

    Of an honest device the estimate scatters about what is declared, and one bound in twenty lies above it: that alone
    is no reason to ask.
    """
    found = []
    for i, (e, said) in enumerate(zip(estimates, _declared(scenario, session), strict=False), start=1):
        if e.viscous > (1 + _SUSPICIOUS) * said:
            found.append(
                f"axis {i}: {e.viscous:.4g} N s/m estimated, {said:.4g} declared (scenario, INFO): is a hand "
                "on it? No bound is offered; where the device really has more, declare it and take another record"
            )
    return found


def settled(sittings: Sequence[Sequence[Estimate]]) -> tuple[list[Estimate], list[str]]:
    """One estimate per axis from two or more sittings, and warnings where a hand damped only some of them.

    The least damped sitting of an axis counts, with the least bound of all. A passive hand adds damping to a device,
    and takes none away (docs/hardware.md): it is enough that one sitting was free of it. Raises ValueError where the
    least damped sitting is alone: nobody knows then whether it was free.
    """
    if len(sittings) < 2:
        raise ValueError("one sitting tells no hand that only damps from more damping of the device: take two")
    found, words = [], []
    for i, axis in enumerate(zip(*sittings, strict=True), start=1):
        least, *others = sorted(axis, key=lambda e: e.viscous)
        figures = ", ".join(f"{e.viscous:.4g}" for e in axis)
        told = f"axis {i}: {figures} N s/m in sittings 1 to {len(axis)}, a hand damped it in"
        if _more_damped(others[0], least):
            raise ValueError(f"{told} one at least. The two least have to agree: let go, and take more (--sittings)")
        if hands := [f"{k}" for k, e in enumerate(axis, start=1) if _more_damped(e, least)]:
            words.append(f"{told} {', '.join(hands)}, which did not count")
        found.append(replace(least, friction=replace(least.friction, delta=min(e.delta for e in axis))))
    return found, words


def _more_damped(one: Estimate, least: Estimate) -> bool:
    """Whether a sitting has more damping than two records of one free device differ by."""
    scatter = 2 * np.hypot(one.friction.errors["viscous"], least.friction.errors["viscous"])
    return one.viscous - least.viscous > _SUSPICIOUS * least.viscous + scatter


def _declared(scenario: Scenario, session: Session) -> list[float]:
    """Damping of every axis [N s/m], the larger of the scenario's and INFO's."""
    guaranteed = [1e-6 * d for d in session.info.osp_damping] if session.info else [0.0] * scenario.channels
    return [max(device.damping, said) for device, said in zip(scenario.device, guaranteed, strict=True)]


def capped(estimates: list[Estimate], scenario: Scenario, session: Session) -> list[Estimate]:
    """The bounds, at most the declared damping: more may be a hand's."""
    said = _declared(scenario, session)
    return [
        replace(e, friction=replace(e.friction, delta=min(e.delta, limit)))
        for e, limit in zip(estimates, said, strict=False)
    ]


def estimate(
    recorder: Recorder,
    session: Session,
    scenario: Scenario,
    progress: Callable[[int, int, str], None] = lambda done, total, what: None,
) -> list[Estimate]:
    """One estimate per axis from a recorded session. Raises ValueError naming the axis that gives none."""
    link, units = recorder.link(), session.units
    missing = int((~link["received"]).sum())
    if missing:  # which force acted then is not known for certain, and a wrong one makes a wrong bound
        raise ValueError(f"{missing} of {len(recorder)} ticks came without a STATE: take another record")
    applied = link["applied"]
    estimates = []
    for i, device in enumerate(scenario.device):
        progress(i, scenario.channels, f"estimating axis {i + 1}")
        x, force, step = link["x"][:, i], applied[:, i] * units.force_step[i], units.encoder_step[i]
        try:
            estimates.append(identify(x, force, link["received"], scenario.T, step, device.transmission is None))
        except ValueError as error:
            raise ValueError(f"axis {i + 1}: {error}") from None
    return estimates


if __name__ == "__main__":
    from cli.main import door

    door("identify")
