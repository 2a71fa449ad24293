"""Estimate the damping of an axis from a balance of forces, and a lower bound of this damping.

Both sides of the balance are filtered by a Gaussian window h (modulating functions, Shinbrot 1957):

    m x'' + b x' + p x''' + r x'''' + k x + f0 + f1 t + (1 + a D^2)(g + q x'|x'|) + periodic(x) = (1 + l D + a D^2) f

with the displacement x, the motor's force f and D = d/dt. The fit estimates the mass m and the viscous damping b. The
term k x stands for a cable, a spring or gravity that changes with position, f0 + f1 t for a constant force and its
drift. A motor (m1) that drives the handle (m2) by a transmission (k12, d12) gives a = m2/k12, l = d12/k12,
p = a b + l m, r = a m1. The motor's balance was multiplied by 1 + l D + a D^2, so there are no fractions; small terms
such as l D g and derivatives of k x are left out. An amplifier's lag tau changes l to l - tau and a to about
a + tau^2 - l tau, so the fit does not mistake it for negative damping. The fit differentiates h, never the counts, and
integrates a force held for a tick exactly. The balance is linear in all parameters except the a before g, so a fit
takes milliseconds. A fit needs no initial state.

Dry friction g is c tanh(x'/v0) with a slip v0, or the friction of a bristle that bends over some distance (Dahl). Both
laws have a part that vanishes at high speed (Stribeck). The law is not known, so all slips v0 of _SLIPS are tried, and
all bristles of _BRISTLES that bend farther than an encoder step. Each fit includes a drag q >= 0; of b and q, only b is
guaranteed. The periodic term holds forces and encoder errors that repeat with position (a motor's poles, an encoder's
eccentricity). Their periods are searched in the residual.

For one law, the bound is b minus the error of b (95 %, by a jackknife over tenths of the record), and minus a share of
the damping that noise as strong as the residual could imitate. The final bound is the least bound of all laws that fit
almost as well as the best law, reduced by the share SCALE.

The power that dry and viscous friction dissipate, divided by the speed squared, is least at high speed, where only b is
left. So b is a lower bound of the damping at every speed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from haptic_loop.controller.lti import Array

_WINDOW = 0.012  # [s] least standard deviation of h; this h halves amplitudes at 16 Hz
_ACCELERATION_NOISE = 1.5e-3  # [m/s2] rounding noise allowed in accelerations; a coarse encoder gets a longer window
_SPEED_NOISE = 3e-4  # [m/s] rounding noise allowed in the speed that friction depends on; sets the shortest window
_SPACING = 0.4  # distance of two rows of the fit, in standard deviations of h: filtered signals have no finer detail
_NEARBY = 3.5  # least distance of a row from a tick at which the balance does not hold, in standard deviations of h
_REACH = 6  # standard deviations at which a window is cut off
_STILL = 0.02  # [s] an axis is at rest if its encoder stays within one count for this long
#: [m/s] speed at which dry friction reaches 3/4 of its maximum
_SLIPS = (5e-4, 1e-3, 2e-3, 3.5e-3, 6e-3, 1e-2, 1.4e-2, 2e-2, 3e-2, 5e-2, 8e-2, 0.12)
#: [m] distances over which a bristle's friction grows from 0 to its limit (Dahl 1968)
_BRISTLES = (1e-5, 1.7e-5, 3e-5, 5.5e-5, 1e-4, 1.7e-4)
_STRIBECK = 0.02  # [m/s] speed at which the Stribeck part has fallen to 37 %
_SLOW, _WEAK = 0.2, 0.05  # share of a force that h must pass; share of the strongest force from which this is checked
_SLIP = 0.002  # [m/s] slip assumed in `dry_friction` if the best law is a bristle
_BLOCKS = 10  # parts of the record that are left out in turn
_HIDDEN = 0.03  # share of the damping that the residual could hide, which is subtracted from the bound
#: relative error of the encoder's scale, which no record shows; eccentricity of 20 um in a turn of 40 mm gives 3e-3
SCALE = 5e-3
_QUANTILE = 1.833  # one-sided 95 % quantile of Student's t with 9 degrees of freedom
_FEW = 200  # least number of ticks of a record at which the balance holds
_ALMOST = 4.0  # twice the largest log likelihood ratio of the best law to a law that counts in the bound
_ROUNDS = 3  # iterations for the weight a of friction's second derivative
_PERIODS = np.geomspace(5e-4, 0.08, 60)  # [m] periods of the disturbances that are searched
_NEAR = np.geomspace(0.92, 1.09, 24)  # multiples of the best of these periods, searched next
_PERIODIC = 4  # largest number of periodic disturbances in a fit
_CHANCE = 2.0  # least gain of log likelihood by a periodic pair, in excess of the best pair's gain in pure noise
_MASS, _VISCOUS, _CONSTANT, _SLOPE, _SPRING, _TAU, _MODE, _LOSS, _STIFF, _DRAG, _DRY, _STATIC = range(12)
_NOT_NEGATIVE = (_VISCOUS, _MODE, _DRAG, _DRY, _STATIC)


@dataclass(frozen=True)
class Friction:
    """The parameters of one axis that fit its balance of forces best, with standard errors."""

    mass: float  # [kg]
    viscous: float  # b [N s/m]
    coulomb: float  # c [N]
    stiffness: float  # [N/m] of a spring from the handle to ground
    constant: float  # [N] constant force
    drift: float  # [N/s] rate at which the constant force changes
    static: float  # [N] Stribeck part of dry friction, which vanishes at high speed
    drag: float  # q [N s2/m2]
    slip: float  # [m/s] v0 of the best law of dry friction; 0 where the best law is a bristle
    reach: float  # [m] distance over which a bristle's friction grows to its maximum; 0 where friction depends on speed
    periods: tuple[float, ...]  # [m] periods of the disturbances found
    errors: dict[str, float]  # standard errors of mass, viscous, coulomb, stiffness
    delta: float  # [N s/m] lower bound of b
    rms: float  # [N] residual of the balance


def _window(order: int, sigma: float, T: float) -> Array:
    """Return samples, times T, of the `order`-th derivative of a Gaussian of standard deviation sigma [s]."""
    t = np.arange(-round(_REACH * sigma / T), round(_REACH * sigma / T) + 1) * T / sigma
    hermite = np.polynomial.hermite_e.hermeval(t, [0.0] * order + [1.0])
    return T * (-1) ** order * hermite * np.exp(-(t**2) / 2) / (np.sqrt(2 * np.pi) * sigma ** (order + 1))


def _filtered(signal: Array, order: int, sigma: float, T: float) -> Array:
    import scipy

    return scipy.signal.fftconvolve(signal, _window(order, sigma, T), mode="same")


def _held(force: Array, sigma: float, T: float) -> tuple[Array, Array, Array]:
    """Return the filtered force, held for each tick, and its first two derivatives."""
    import scipy

    n = round(_REACH * sigma / T)
    t = np.arange(-n, n + 1) * T
    step = (scipy.special.erf(t / (np.sqrt(2) * sigma)) - scipy.special.erf((t - T) / (np.sqrt(2) * sigma))) / 2
    bells = [np.exp(-((s / sigma) ** 2) / 2) / (np.sqrt(2 * np.pi) * sigma) for s in (t, t - T)]
    slope = (bells[1] * (t - T) - bells[0] * t) / sigma**2
    kernels = (step, bells[0] - bells[1], slope)
    first, second, third = (scipy.signal.fftconvolve(force, kernel, mode="same") for kernel in kernels)
    return first, second, third


def _moving(x: Array, step: float, T: float) -> NDArray[np.bool_]:
    """Return the ticks at which the encoder moves."""
    counts, n = np.round(x / step), max(2, round(_STILL / T))
    moves = np.ones(len(x), dtype=bool)
    view = np.lib.stride_tricks.sliding_window_view(counts, n)
    for k in np.flatnonzero(np.ptp(view, axis=1) <= 1):
        moves[k : k + n] = False
    return moves


def _bristle(x: Array, reach: float) -> Array:
    """Return the friction (N,) of a bristle, within +-1, for displacements x (N,) [m]; it slips if bent by `reach`."""
    z, out = 0.0, []
    for moved in np.diff(x, prepend=x[0]).tolist():
        z += moved
        if not -reach <= z <= reach:
            z = reach if z > 0 else -reach
        out.append(z)
    return np.array(out) / reach


def _slow(force: Array, sigma: float, T: float) -> NDArray[np.bool_]:
    """Return the ticks at which the force is weak, or h passes enough of it.

    At the other ticks, most of the force is too fast for h. It causes a fast motion, which changes the mean friction
    but is missing in the filtered balance.
    """
    strong, left = (_filtered(f**2, 0, sigma, T) for f in (force, _filtered(force, 0, sigma, T)))
    return (left > _SLOW**2 * strong) | (strong < _WEAK**2 * strong.max())


class _Balance:
    """The balance of forces as rows of a linear fit, at the ticks at which the axis moves."""

    def __init__(self, x: Array, force: Array, T: float, step: float) -> None:
        import scipy

        noise = 3 * step**2 * T / (96 * np.sqrt(np.pi) * _ACCELERATION_NOISE**2)  # sigma^5 for white rounding noise
        self.T, self.sigma, self.force = T, max(_WINDOW, 3 * T, noise**0.2), force
        self.x = x - x[0]
        self._reach = round(_REACH * self.sigma / T)
        # leave out rest and dither, where g does not describe friction
        clear = _moving(x, step, T) & _slow(force, self.sigma, T)
        spoilt = scipy.ndimage.binary_dilation(~clear, iterations=round(_NEARBY * self.sigma / T)).astype(bool)
        rows = np.flatnonzero(~spoilt[self._reach : -self._reach]) + self._reach
        if len(rows) < _FEW:
            raise ValueError(f"the axis moves in {len(rows)} usable samples, at least {_FEW} are needed")
        self.independent = len(rows) * T / (2 * np.sqrt(np.pi) * self.sigma)  # independent filtered samples
        self.rows = rows[:: max(1, int(_SPACING * self.sigma / T))]
        self._length = scipy.fft.next_fast_len(len(x) + 2 * self._reach)
        windows = [_window(n, self.sigma, T) for n in range(5)]
        self._filters = [np.fft.fft(window, self._length) for window in windows]
        self.speed = _filtered(self.x, 1, min(_speed_window(step, T), self.sigma / 2), T)
        applied, rate, bend = _held(force, self.sigma, T)
        self.applied = applied[self.rows]
        t = np.arange(len(x)) * T
        zero = np.zeros(len(self.rows))
        place, velocity, acceleration, jerk, snap = self._of(self.x, 0, 1, 2, 3, 4)
        drift = t[self.rows] - t[self.rows].mean()
        lag = [rate[self.rows], -bend[self.rows]]
        self.common = [acceleration, velocity, zero + 1.0, drift, place, *lag, jerk, snap]
        self._drag = self._of(self.speed * np.abs(self.speed), 0, 2)

    def _complex(self, signal: NDArray[np.complex128], *orders: int) -> list[NDArray[np.complex128]]:
        """Return derivatives (rows,) of the filtered signal (N,)."""
        spectrum = np.fft.fft(signal, self._length)
        return [np.fft.ifft(spectrum * self._filters[order])[self.rows + self._reach] for order in orders]

    def _of(self, signal: Array, *orders: int) -> list[Array]:
        """Return derivatives (rows,) of the filtered real signal (N,), by transforms of half the length."""
        spectrum, half = np.fft.rfft(signal, self._length), self._length // 2 + 1
        each = (np.fft.irfft(spectrum * self._filters[order][:half], self._length) for order in orders)
        return [one[self.rows + self._reach] for one in each]

    def laws(self, step: float) -> list[tuple[float, float, Array]]:
        """Return slip [m/s], reach [m] and dry friction (N,) within +-1 of every law tried; slip or reach is 0."""
        bristles = [(0.0, reach, _bristle(self.x, reach)) for reach in _BRISTLES if reach > step]
        return [(slip, 0.0, np.tanh(self.speed / slip)) for slip in _SLIPS] + bristles

    def matrix(self, dry: Array) -> Callable[[float], Array]:
        """Return the function from the weight a of friction's second derivative to the columns (rows, p)."""
        laws = [dry, dry * np.exp(-((self.speed / _STRIBECK) ** 2))]
        plain, bent = zip(self._drag, *(self._of(law, 0, 2) for law in laws), strict=True)

        def columns(mode: float) -> Array:
            return np.stack([*self.common, *(one + mode * two for one, two in zip(plain, bent, strict=True))], axis=1)

        return columns

    def waves(self, periods: Array) -> list[_Pair]:
        """Return two pairs for each period [m]: a force and an encoder error that repeat with position."""
        waves = [(p, wave) for p in periods.tolist() for wave in self._complex(np.exp(2j * np.pi * self.x / p), 0, 2)]
        return [_Pair(period, np.stack([wave.real, wave.imag], axis=1)) for period, wave in waves]


@dataclass(frozen=True, eq=False)
class _Pair:
    """A periodic disturbance: the columns (rows, 2) of its cosine and sine over position."""

    period: float  # [m]
    columns: Array


@dataclass(frozen=True, eq=False)
class _Fit:
    """Parameters (p,), columns (rows, p) and residual (rows,) [N] of a fit."""

    p: Array
    columns: Array
    residual: Array

    @property
    def squares(self) -> float:
        return float(self.residual @ self.residual)

    @property
    def price(self) -> float:
        """Akaike's penalty for friction that is not viscous. It selects the simplest of equally good laws."""
        return 2.0 * int(np.count_nonzero(self.p[[_DRAG, _DRY, _STATIC]]))


def _triangle(rows: Array) -> Array:
    """Return R of the QR factorization of rows [columns, force]. Least squares needs no more of these rows."""
    triangle: Any = np.linalg.qr(rows, mode="r")
    return triangle


def _solve(triangle: Array) -> Array:
    """Solve least squares with some parameters that must not be negative."""
    import scipy

    r, right = triangle[:-1, :-1], triangle[:-1, -1]
    scale = np.linalg.norm(r, axis=0) + 1e-300
    free = scipy.linalg.solve_triangular(r / scale, right, check_finite=False)
    if (free[list(_NOT_NEGATIVE)] >= 0).all():
        return free / scale
    low = np.full(len(r), -np.inf)
    low[list(_NOT_NEGATIVE)] = 0.0
    return scipy.optimize.lsq_linear(r / scale, right, (low, np.inf), method="bvls").x / scale


def _fitted(balance: _Balance, matrix: Callable[[float], Array], periodic: list[_Pair]) -> _Fit:
    """Fit one law of dry friction, whose columns are those of `matrix`, and the periodic disturbances."""
    p = at = np.zeros(_MODE + 1)
    for _ in range(_ROUNDS):
        at = np.hstack([matrix(p[_MODE]), *(pair.columns for pair in periodic)])
        p = _solve(_triangle(np.column_stack([at, balance.applied])))
    return _Fit(p, at, balance.applied - at @ p)


def _strongest(pairs: list[_Pair], columns: Array, residual: Array) -> tuple[float, _Pair]:
    """Return the share of `residual` (rows,) that the best pair explains beside `columns` (rows, p), and this pair."""
    q = np.linalg.qr(columns)[0]
    left, most, strongest = residual - q @ (q.T @ residual), 0.0, pairs[0]
    for pair in pairs:
        own = np.linalg.qr(pair.columns - q @ (q.T @ pair.columns))[0]
        gain = float(np.sum((own.T @ left) ** 2) / (left @ left))
        if gain > most:
            most, strongest = gain, pair
    return most, strongest


def _disturbances(balance: _Balance, fit: _Fit) -> list[_Pair]:
    """Return the periodic disturbances that explain the residual of the fit, strongest first.

    In pure noise, the best of n pairs explains a share of 2 log(n) / `independent`. A pair counts if its gain of log
    likelihood exceeds that of this best pair by _CHANCE.
    """
    pairs: list[_Pair] = []
    grid = balance.waves(_PERIODS[np.ptp(balance.x) > _PERIODS])
    needed = -np.expm1(-2 * (np.log(len(grid) * len(_NEAR) + 1) + _CHANCE) / balance.independent)
    while grid and len(pairs) < _PERIODIC:
        columns = np.hstack([fit.columns, *(pair.columns for pair in pairs)])
        _, near = _strongest(grid, columns, fit.residual)
        # the grid is too coarse for a long record: search near its best period
        gain, pair = _strongest(balance.waves(near.period * _NEAR), columns, fit.residual)
        if gain < needed:
            break
        pairs.append(pair)
    return pairs


def _scatter(fit: _Fit, force: Array) -> Array:
    """Return the jackknife covariance (p, p) of the parameters: each fit leaves out one of _BLOCKS parts."""
    rows, group = np.column_stack([fit.columns, force]), np.arange(len(force)) * _BLOCKS // len(force)
    triangles = [_triangle(rows[group == g]) for g in range(_BLOCKS)]
    others = [_solve(_triangle(np.vstack(triangles[:g] + triangles[g + 1 :]))) for g in range(_BLOCKS)]
    apart = np.array(others) - np.mean(others, axis=0)
    return (_BLOCKS - 1) / _BLOCKS * apart.T @ apart


def _apart(columns: Array, i: int) -> Array:
    """Return the part of a column that the other columns do not explain."""
    others = np.linalg.qr(np.delete(columns, i, axis=1))[0]
    return columns[:, i] - others @ (others.T @ columns[:, i])


def dry_friction(x: Array, T: float, found: Friction) -> Array:
    """Return dry friction [N] for displacements x (N,) [m], without its Stribeck part; v0 is _SLIP for a bristle."""
    return found.coulomb * np.tanh(np.diff(x, append=x[-1]) / T / (found.slip or _SLIP))


def nonviscous(x: Array, T: float, step: float, found: Friction) -> Array:
    """Return the sum (N,) [N] of dry friction, drag, spring and drift in each tick from x (N,) [m], by the best law."""
    x, edge = x - x[0], round(_REACH * _speed_window(step, T) / T)
    speed = _filtered(np.pad(x, edge, mode="edge"), 1, _speed_window(step, T), T)[edge : edge + len(x)]
    speed = (speed + np.append(speed[1:], speed[-1])) / 2
    steps = np.diff(x, append=x[-1]) / T
    dry = np.tanh(steps / found.slip) if found.slip else _bristle(x, found.reach)
    dry = dry * (found.coulomb + found.static * np.exp(-((speed / _STRIBECK) ** 2)))
    return dry + found.drag * speed * np.abs(speed) + found.stiffness * x + found.drift * T * np.arange(len(x))


def _speed_window(step: float, T: float) -> float:
    """Return the standard deviation [s] of the shortest window in which rounding leaves _SPEED_NOISE."""
    return max(T, (step**2 / 12 * T / (4 * np.sqrt(np.pi) * _SPEED_NOISE**2)) ** (1 / 3))


#: power of the radius that converts a figure in metres at the hand to one in radians of the axis
_SQUARED = "mass viscous stiffness delta thinning thinning_error lasting motor_mass handle_mass motor_mass_min"
_SQUARED += " transmission_stiffness transmission_stiffness_max"
_SQUARED += " transmission_damping transmission_damping_min transmission_damping_max"
_POWERS = dict.fromkeys(_SQUARED.split(), 2) | dict.fromkeys(["coulomb", "constant", "drift", "static", "rms"], 1)
_POWERS |= dict.fromkeys(["slip", "reach", "periods", "speed"], -1) | {"drag": 3}
_Figures = TypeVar("_Figures")  # a dataclass of figures


def at_radius(figures: _Figures, r: float) -> _Figures:
    """Convert figures in metres at the hand to radians of the axis, for a hand at the radius r [m]."""

    def turned(values: dict[str, Any]) -> dict[str, Any]:
        return {
            name: np.multiply(value, r ** _POWERS[name]).tolist() for name, value in values.items() if name in _POWERS
        }

    each: Any = figures
    errors = {"errors": turned(each.errors)} if isinstance(figures, Friction) else {}
    return each if r == 1.0 else replace(each, **turned(vars(each)), **errors)


def friction(x: Array, force: Array, T: float, step: float) -> Friction:
    """Fit the balance to displacements x (N,) [m] under forces (N,) [N] held for T [s], with encoder `step` [m].

    Raises ValueError where the axis moves in too few samples.
    """
    balance = _Balance(x, force, T, step)
    laws = [(slip, reach, balance.matrix(dry)) for slip, reach, dry in balance.laws(step)]
    fits = [(slip, reach, _fitted(balance, matrix, [])) for slip, reach, matrix in laws]
    if periodic := _disturbances(balance, min((fit for *_, fit in fits), key=lambda fit: fit.squares)):
        fits = [(slip, reach, _fitted(balance, matrix, periodic)) for slip, reach, matrix in laws]
    least = min(fit.squares for *_, fit in fits)
    slip, reach, best = min(
        fits, key=lambda entry: balance.independent * np.log(entry[2].squares / least) + entry[2].price
    )
    delta, covariance = np.inf, np.zeros(0)
    for *_, fit in fits:
        if balance.independent * np.log(fit.squares / least) > _ALMOST:
            continue
        spread = _scatter(fit, fit.residual + fit.columns @ fit.p)
        hid = np.sqrt(fit.squares) / np.linalg.norm(_apart(fit.columns, _VISCOUS))
        delta = min(delta, fit.p[_VISCOUS] - _QUANTILE * np.sqrt(spread[_VISCOUS, _VISCOUS]) - _HIDDEN * hid)
        if fit is best:
            covariance = spread
    names = {"mass": _MASS, "viscous": _VISCOUS, "coulomb": _DRY, "stiffness": _SPRING}
    places = names | {"constant": _CONSTANT, "drift": _SLOPE, "static": _STATIC, "drag": _DRAG}
    return Friction(
        **{name: float(best.p[i]) for name, i in places.items()},
        slip=slip,
        reach=reach,
        periods=tuple(pair.period for pair in periodic),
        errors={name: float(np.sqrt(covariance[i, i])) for name, i in names.items()},
        delta=max(0.0, (1 - SCALE) * float(delta)),
        rms=float(np.sqrt(best.squares / len(best.residual))),
    )
