"""How small the mismatch of any linear coupling can be, of whatever order: a bound by weak duality.

Of a certified F only this is used: P(z) = Delta + T F(z)/(z-1) is analytic outside the unit circle with He P >= 0
there, so S = He P = sum_k s_k z^-k is a positive matrix measure on the circle, s_0 = Delta, and the delays forbid
some combinations of the first s_k (row i is zero for 1 <= k <= theta_i: no force has arrived). With <X, Y> the mean of
Re tr X*Y over the circle and w the weight of the mean square relative mismatch J = <M, w M>, M = F - Lambda E, for
every H with support in the band |M|^2 w >= 2 Re tr H*M - |H|^2/w, so
    J  >=  2 <H, F> - 2 <H, Lambda E> - <H, H/w>.
F's coefficients are differences of the s_k. Hence 2 <H, F> + tr C_0 Delta = <D, S> >= 0 if, for some C_k that only
weigh what the delays forbid,
    D = He[ (4/T) ((1/z - 1) H_+ + H_0) + sum_{k>=1} C_k z^-k ] + C_0  >=  0,     H_+ = sum_{k>=0} H_k z^-k,
and then J >= -tr C_0 Delta - 2 <H, Lambda E> - <H, H/w>. With H = w |E| h this is
    1 - tr C_0 Delta - mean |h + Lambda E/|E||^2,
the mean over log frequency in the band. What D lacks to be positive on the points of the transform is charged.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
import scipy  # its parts load when they are used
from numpy.typing import NDArray

from controller.coupling import Coupling
from controller.delay import delay
from controller.loop import Loop
from controller.lti import Array, Complex, Lti
from design.barrier import Block, Program, centre, towards
from design.designs import design_by_kind
from design.frequency import frequencies, hermitian, on_circle
from design.program import LADDER
from design.result import Design
from design.transparency import BAND_HZ, decibels

_Indices = NDArray[np.intp]  # of points of the transform

_POINTS = 65536  # of the transform
_KNOTS = {1: 60, 2: 60}  # of h, by channels; fewer for more
_FEWEST = 24
_EVERY = 3  # channels up to which h is any matrix
MOST = 4  # channels for which there is a bound
NO_BOUND = f"no bound for more than {MOST} devices: it takes minutes, and what it gives then is decibels too low"
_NEAR_END = (0.22, 0.5)  # of a step between knots: h falls to zero at the upper end of the band
_DEGREE = 3  # of the splines that h is made of
_GAP = 0.002  # of the bound, relatively, that the barrier leaves
_SWEEPS = 6
_QUADRATURE = 3e-6  # of the mean square: what the sums over transform and band may differ from their integrals
_RUNGS = LADDER[:2]  # of the design that it begins from
_LEFT_OUT = 0.0005  # of the mean square mismatch of a coupling: what the shapes of h lack
_LARGEST_CHARGE = 0.003  # of the bound, for what D lacks between the frequencies where it is imposed
_STEEPER = 4.0


@dataclass(frozen=True)
class _Bound:
    """No linear coupling for this environment has less rms mismatch."""

    rms: float  # relative to the environment
    seconds: float

    @property
    def rms_db(self) -> float:
        return decibels(self.rms)


def bound(
    loop: Loop, band_hz: tuple[float, float] = BAND_HZ, knots: int | None = None, near: Coupling | None = None
) -> _Bound:
    """The least rms mismatch over the band that any coupling certified this-environment can have.

    `near` is a good one, or one is designed: with more than EVERY channels h is made of what makes up its mismatch.
    """
    started = time.perf_counter()
    if loop.channels <= _EVERY:
        shapes = np.eye(loop.channels**2)
    else:
        shapes = _shapes(loop, loop.F(near or design_by_kind(loop, "optimal", ladder=_RUNGS).coupling), band_hz)
    dual = _Dual.of(loop, band_hz, knots or _KNOTS.get(loop.channels, _FEWEST), shapes)
    square = dual.best()
    return _Bound(float(np.sqrt(max(square - _QUADRATURE, 0.0))), time.perf_counter() - started)


@dataclass(frozen=True, eq=False)
class _Dual:
    """Unknowns: h at its knots (real and imaginary parts, entry by entry), C_0, then the C_k; D in units of 1/delta."""

    m: int
    A: Array  # (rows, n) h over the band, weighted
    b: Array  # (rows,) -Lambda E/|E|, weighted
    c: Array  # (n,) tr C_0
    shapes: Array  # (shapes, m, m) orthonormal: h is a sum of them, each times a scalar function
    parts: Complex  # (scalars, POINTS/2 + 1): what each real scalar function of h contributes to one entry of D
    forbidden: tuple[
        tuple[int, Array], ...
    ]  # (row, (steps + 1, m)): sums over s_k[row] that are zero for every coupling
    root: Array  # (m,) sqrt(delta)

    @classmethod
    def of(cls, loop: Loop, band_hz: tuple[float, float], count: int, shapes: Array) -> _Dual:
        E, m = loop.E(), loop.channels
        low, high = 2 * np.pi * band_hz[0] * loop.T, min(2 * np.pi * band_hz[1] * loop.T, 0.999 * np.pi)
        span = np.log(high / low)
        modes = np.abs(np.angle(E.poles()))
        knots = np.geomspace(low, high, count)
        width = knots[1] / knots[0]
        extra = [w * f for w in modes for f in (width**-0.5, 1.0, width**0.5) if low < w * f < high]
        extra += [high * width**-f for f in _NEAR_END]
        knots = np.union1d(knots, extra)
        knots = knots[np.concatenate([[True], np.diff(np.log(knots)) > 0.2 * np.log(width)])]
        x = np.log(knots)
        spline = np.concatenate([[x[0]] * _DEGREE, x, [x[-1]] * _DEGREE])
        inner = x.size + _DEGREE - 3  # h is zero at both ends of the band, else H_+ would be unbounded there

        def hats(w: Array) -> Array:
            """(inner, k): B-splines in log w."""
            x = np.clip(np.log(w), spline[0], spline[-1])
            return scipy.interpolate.BSpline.design_matrix(x, spline, _DEGREE).toarray()[:, 1:-1].T

        # objective, by Gauss's rule between the points of a grid that has the knots
        grid = np.union1d(knots, frequencies(E, low=low, high=high, points=200))
        node, weight = np.polynomial.legendre.leggauss(3)
        left, right = np.log(grid[:-1]), np.log(grid[1:])
        logarithm = ((left + right) / 2 + (right - left) / 2 * node[:, None]).ravel()
        weight = ((right - left) / 2 * weight[:, None]).ravel() / span
        w = np.exp(logarithm)
        z = on_circle(w)
        response = E.at(z)
        size = np.linalg.norm(response, axis=(1, 2))
        target = (z[:, None] ** -np.asarray(loop.lam))[:, :, None] * response / size[:, None, None]
        shape = np.sqrt(weight) * hats(w)  # (inner, k)
        target = np.sqrt(weight)[:, None, None] * target
        sizes = (2 * inner * len(shapes), m * (m + 1) // 2)
        forbidden = _forbidden(loop, E)
        n = sum(sizes) + len(forbidden)
        along = target.reshape(w.size, -1) @ shapes.T  # (k, shapes)
        rows, ends = [np.zeros((1, n))], [[np.sqrt(max((np.abs(target) ** 2).sum() - (np.abs(along) ** 2).sum(), 0))]]
        for at, part in product(range(len(shapes)), (np.real, np.imag)):
            row = np.zeros((w.size, n))
            row[:, inner * (len(rows) - 1) :][:, :inner] = shape.T
            rows.append(row)
            ends.append(-part(along[:, at]))
        A, b = np.vstack(rows), np.concatenate(ends)
        c = np.zeros(n)
        c[sizes[0] : sizes[0] + sizes[1]] = [1.0 if i == j else 0.0 for i, j in _triangle(m)]

        # the causal parts, by transforms
        w = 2 * np.pi * np.arange(_POINTS // 2 + 1) / _POINTS
        inside = (w > low) & (w < high)
        real = np.zeros((inner, w.size))
        e = np.linalg.norm(E.at(on_circle(w[inside])), axis=(1, 2))
        real[:, inside] = (
            hats(w[inside]) * np.pi / (span * w[inside] * e)
        )  # H = weight |E| h, weight = pi/(span w |E|^2)
        parts = np.concatenate([_causal(real.astype(complex)), _causal((1j * real).astype(np.complex128))]) * (
            2 / loop.T
        )
        root = np.sqrt(np.asarray(loop.delta))
        return cls(m, A, b, c, shapes.reshape(-1, m, m), parts, forbidden, root)

    @property
    def inner(self) -> int:
        return len(self.parts) // 2

    def block(self, points: _Indices) -> Block:
        """D at some of the transform's points, scaled by root(delta) from both sides."""
        m, inner = self.m, self.inner
        z = np.exp(2j * np.pi * points / _POINTS)
        slope = np.zeros((points.size, self.c.size, m, m), dtype=complex)
        at, parts = 2 * inner * len(self.shapes), 2 * self.parts[:, points].T
        scaled = self.shapes * np.outer(self.root, self.root)
        slope[:, :at] = np.einsum("kh,sij->kshij", parts, scaled).reshape(points.size, at, m, m)
        for i, j in _triangle(m):
            slope[:, at, i, j] = 1.0 if i == j else 2.0
            at += 1
        for i, weights in self.forbidden:
            slope[:, at, i] = z[:, None] ** -np.arange(len(weights)) @ weights
            at += 1
        return Block.of(np.zeros((points.size, m, m), dtype=np.complex128), hermitian(slope))

    def start(self) -> Array:
        """h = 0 and C_0 = I/delta: D = I."""
        x = np.zeros(self.c.size)
        x[2 * self.inner * len(self.shapes) :][: self.m * (self.m + 1) // 2] = [
            float(i == j) for i, j in _triangle(self.m)
        ]
        return x

    def lacking(self, x: Array) -> Array:
        """The least eigenvalue of D at every point, (POINTS/2 + 1,)."""
        points = np.arange(_POINTS // 2 + 1)
        return np.concatenate([np.linalg.eigvalsh(self._at(x, some))[:, 0] for some in np.array_split(points, 16)])

    def _at(self, x: Array, points: _Indices) -> Complex:
        """D itself, without its slopes."""
        m, inner = self.m, self.inner
        z = np.exp(2j * np.pi * points / _POINTS)
        D: Complex = np.zeros((points.size, m, m), dtype=np.complex128)
        h = x[: 2 * inner * len(self.shapes)].reshape(-1, 2 * inner)
        D += 2 * np.tensordot(self.parts[:, points].T @ h.T, self.shapes, axes=1) * np.outer(self.root, self.root)
        at = h.size
        for i, j in _triangle(m):
            D[:, i, j] += x[at] * (1.0 if i == j else 2.0)
            at += 1
        for i, weights in self.forbidden:
            D[:, i] += x[at] * (z[:, None] ** -np.arange(len(weights)) @ weights)
            at += 1
        return (D + np.conj(np.swapaxes(D, 1, 2))) / 2

    def best(self) -> float:
        """The bound on the mean square."""
        last = _POINTS // 2
        # the lowest points first, then even in the logarithm and even
        points = np.unique(np.concatenate([[0], np.geomspace(1, last, 220).round(), np.linspace(1, last, 160).round()]))
        points = points.astype(int)
        Q, R = np.linalg.qr(self.A)
        A, b = R, Q.T @ self.b
        rest = float(self.b @ self.b - b @ b)  # what no h reaches
        start = x = self.start()
        t, found = None, 0.0
        for sweep in range(_SWEEPS):
            program = Program(A, b, self.c, (self.block(points),))
            x = towards(start, x, program)
            program, U = program.conditioned(x)
            y = U @ x
            t = program.degree / max(program.value(y), 1e-12) if t is None else t / _STEEPER
            while True:
                y = centre(program, y, t)
                left = max(1 - rest - program.value(y), 1e-9)
                if program.degree / t <= (_GAP if sweep else 5 * _GAP) * left:
                    break
                t *= _STEEPER
            x = scipy.linalg.solve_triangular(U, y)
            lacking = self.lacking(x)
            charge = self.m * max(0.0, -float(lacking.min()))
            value = 1 - rest - program.value(y) - charge
            found = max(found, value)
            if sweep and charge <= _LARGEST_CHARGE * max(value, 1e-9):
                break
            points = np.union1d(points, _worst(lacking))
        return found


def _shapes(loop: Loop, near: Lti, band_hz: tuple[float, float]) -> Array:
    """(shapes, m m): the real matrices that make up all but _LEFT_OUT of the mean square mismatch of this force map."""
    E, per_hz = loop.E(), 2 * np.pi * loop.T
    w = frequencies(E, low=per_hz * band_hz[0], high=min(per_hz * band_hz[1], 0.999 * np.pi), points=200)
    z = on_circle(w)
    ideal = E.at(z)
    M = near.at(z) - z[:, None, None] ** -np.asarray(loop.lam)[:, None] * ideal
    M *= (np.sqrt(np.gradient(np.log(w))) / np.linalg.norm(ideal, axis=(1, 2)))[:, None, None]
    M = M.reshape(w.size, -1)
    _, size, shapes = np.linalg.svd(np.vstack([M.real, M.imag]), full_matrices=False)
    left = 1 - np.cumsum(size**2) / (size**2).sum()
    return shapes[: int(np.argmax(left < _LEFT_OUT)) + 1]


def _triangle(m: int) -> list[tuple[int, int]]:
    return [(i, j) for i in range(m) for j in range(i, m)]


def _forbidden(loop: Loop, E: Lti) -> tuple[tuple[int, Array], ...]:
    """What the delays forbid: (row i, weights v (k, m)) with sum_k v_k' s_k[i] = 0 for every F = Theta R Psi E.

    Row i of s_k is zero for 1 <= k <= theta_i. The next coefficients of F are those of R times those of Psi E: where
    the channels' psi differ they lie in a subspace, and v is from its complement.
    """
    m, span = E.inputs, max(loop.psi)
    found = []
    for i, theta in enumerate(loop.theta):
        for k in range(1, theta + 1):
            for unit in np.eye(m):
                weights = np.zeros((theta + span + 1, m))
                weights[k] = unit
                found.append((i, weights))
    if not span:
        return tuple(found)
    G = delay(loop.psi, loop.T) @ E
    impulse = [G.D, *(G.C @ np.linalg.matrix_power(G.A, k) @ G.B for k in range(span - 1))]
    reach = np.zeros((span * m, span * m))  # coefficient l of R's row by step k of F's row
    for step in range(span):
        for k in range(step, span):
            reach[step * m : (step + 1) * m, k * m : (k + 1) * m] = impulse[k - step]
    for v in scipy.linalg.null_space(reach, rcond=1e-9).T:
        for i, theta in enumerate(loop.theta):
            weights = np.zeros((theta + span + 1, m))
            for k, row in enumerate(v.reshape(span, m)):  # F_k = 2 (s_{k+1} - s_k)/T, and s_k is zero up to theta
                weights[theta + k + 1] += row
                if k:
                    weights[theta + k] -= row
            found.append((i, weights))
    return tuple(found)


def _causal(half: Complex) -> Complex:
    """(1/z - 1) H_+ + H_0 on the half circle, of functions H given there, (n, POINTS/2 + 1); H(conj z) = conj H(z)."""
    coefficients = np.fft.irfft(half, n=_POINTS)  # H_k of z^-k: H(w) = sum_k H_k e^{-jwk}
    coefficients[:, _POINTS // 2 :] = 0.0  # k < 0
    shifted = np.roll(coefficients, 1, axis=1) - coefficients
    shifted[:, 0] = 0.0  # -H_0 + H_0
    return np.fft.rfft(shifted, n=_POINTS)


def _worst(lacking: Array) -> _Indices:
    """The points of the deepest local minima below zero."""
    padded = np.concatenate([[np.inf], lacking, [np.inf]])
    local = np.flatnonzero((lacking <= padded[:-2]) & (lacking <= padded[2:]) & (lacking < 0))
    return local[np.argsort(lacking[local])[:96]]


def bound_part(loop: Loop, best: Design, band_hz: tuple[float, float]) -> dict[str, Any]:
    """What no linear coupling can be better than, or why that is not worked out."""
    if loop.channels > MOST:
        return {"rms_mismatch_db": None, "reason": NO_BOUND}
    if best.objective == 0:
        return {"rms_mismatch_db": None, "reason": "the mismatch is zero: there is nothing to bound"}
    return {"rms_mismatch_db": bound(loop, band_hz, near=best.coupling).rms_db}
