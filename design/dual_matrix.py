"""The matrix D of the dual problem in design.bound, with a lower bound of its eigenvalues on the whole circle |z| = 1.

D(w) = He[(4/T) ((1/z - 1) H_+ + H_0) + sum_k C_k z^-k] + C_0 at z = exp(jw), with the H and C_k of design.bound, is
scaled by root(delta) from both sides. H is piecewise linear; at each bend x_i its slope changes by 2 pi c_i. H_0 is the
mean of H over the circle (`mean`), and H_+ is the causal part of H. With a = 1/z - 1 and the dilogarithm Li2 this gives

    (1/z - 1) H_+ + H_0 = mean - a g,     g(w) = sum_i c_i Li2(e^j(x_i - w)) + conj(c_i Li2(e^j(x_i + w))) - mean.

In an interval of length l without a bend inside, the error of linear interpolation is at most
- l^2/8 max |f^(2)| for any f, with the second derivative f^(2);
- l^2/16 + min(l/e, l^2/(8 d)) for Li2(e^jx), where d is the distance of the interval from 0 modulo 2 pi. Proof:
  Li2^(2) = 1/(1 - e^-jx) = (1 - j cot(x/2))/2 with |cot(x/2)|/2 <= 1/|x|. The bound 1/|x| is the second derivative of
  x log x. The interpolation error of x log x is largest on [0, l], where it is l/e;
- l^2/8 (|f^(2)| + l/2 |f^(3)| + l^2/8 max |f^(4)|) with the derivatives |f^(2)| and |f^(3)| in the middle. This bound
  serves the sum over far bends, whose terms cancel. Li2^(3) = j/4 (1 + cot(x/2)^2), and |Li2^(4)| <= 1/(4 sin(d/2)^3);
- |a| (error of g) + l^2/8 max |g| + l/4 |g(right) - g(left)| for the product a g. The last two terms are the error of
  a times the interpolant of g. The second derivative of this product is a^(2) times the interpolant plus 2 a^(1) times
  its slope, with |a^(1)| = |a^(2)| = 1.
A matrix on the line between two Hermitian matrices has no eigenvalue below the smaller of their least eigenvalues. So
take the smaller of the least eigenvalues of D at the ends of the interval, and subtract the Frobenius norm of the
errors above and of rounding. The result is a lower bound of the eigenvalues of D in the interval.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from fractions import Fraction
from functools import cache

import numpy as np

from haptic_loop.controller.arithmetic import spend
from haptic_loop.controller.lti import Array, Complex
from haptic_loop.design.frequency import hermitian

_UNIT = 2.0**-53  # unit roundoff of double precision
_EVALUATION = 6e-8  # counted work of one bend at one frequency, in units of design.budgets
_MOST = 40_000_000  # largest number of bends times frequencies for one matrix, which takes about two seconds
_CHUNK = 2**18  # bends times frequencies that are processed together and fit into the cache
_FAR = 2.0  # distance beyond which a bend counts as far, in lengths of the interval
_COTANGENT = 1e-12  # relative rounding of a cotangent and of the sums over it, rounded up
# An interval is halved only while its bound is below minus the tolerance and its error exceeds 1/_SHARE of the larger
# of two numbers: the tolerance, and the size of a negative eigenvalue at its ends.
_SHARE = 8


@dataclass(frozen=True, eq=False)
class DualMatrix:
    """The matrix D at one point of the dual problem, for m channels, n bends of H, and C_k up to the step K."""

    points: Array  # (n,) x_i [rad/sample], in (0, pi)
    bends: Complex  # (n, m, m) c_i times 4/T, scaled
    slopes: Array  # (n, m, m) sum of the absolute values of the two slopes beside each bend, in units of `bends`
    mean: Array  # (m, m) H_0 times 4/T, scaled
    sums: Array  # (K + 1, m, m): C_0, .., C_K, scaled

    @classmethod
    def of(cls, points: Array, heights: Complex, scale: Array, sums: Array) -> DualMatrix:
        """Return D for the piecewise linear H with these heights (n, m, m) at the points.

        The first and the last height must be 0. `scale` (m, m) is 4/T root(delta_i delta_j).
        """
        width, ends = np.diff(points)[:, None, None], ((1, 1), (0, 0), (0, 0))
        slope = np.pad(scale / (2 * np.pi) * np.diff(heights, axis=0) / width, ends)
        mean = scale / (2 * np.pi) * (width * (heights[1:] + heights[:-1]).real).sum(axis=0)
        return cls(points, np.diff(slope, axis=0), np.abs(slope[1:]) + np.abs(slope[:-1]), mean, sums)

    def lower(self, swept: Array, wanted: float) -> tuple[float, Array, Array]:
        """Return a lower bound of D's eigenvalues, evaluated frequencies (k,), and the least eigenvalues there (k,).

        The frequencies `swept` and the bends are the ends of intervals. An interval is halved until its bound is above
        -`wanted`, or its error is small compared with the eigenvalues at its ends. The search also ends after _MOST
        evaluations of bends.
        """
        w = np.unique(np.concatenate([[0.0, np.pi], swept, self.points]))
        budget = _MOST // self.points.size - w.size
        g, D = self._parts(w)
        least = np.linalg.eigvalsh(D)[:, 0]
        where, values = [w], [least]
        left, right, g_left, g_right, end = w[:-1], w[1:], g[:-1], g[1:], np.stack([least[:-1], least[1:]])
        bound = np.inf
        while True:
            error, lower, middle = self._error(left, right, g_left, g_right), end.min(axis=0), (left + right) / 2
            rough = (lower - error < -wanted) & (error > np.maximum(wanted, -lower) / _SHARE)
            rough &= (middle > left) & (middle < right)
            if rough.sum() > budget:
                rough[:] = False
            bound = min(bound, (lower - error)[~rough].min(initial=np.inf))
            if not rough.any():
                break
            left, right, middle = left[rough], right[rough], middle[rough]
            budget -= middle.size
            g, D = self._parts(middle)
            least = np.linalg.eigvalsh(D)[:, 0]
            where, values = [*where, middle], [*values, least]
            left, right = np.append(left, middle), np.append(middle, right)
            g_left, g_right = np.concatenate([g_left[rough], g]), np.concatenate([g, g_right[rough]])
            before, after = end[:, rough]
            end = np.stack([np.append(before, least), np.append(least, after)])
        order = np.argsort(np.concatenate(where))
        return float(bound) - self.rounding(), np.concatenate(where)[order], np.concatenate(values)[order]

    def rounding(self) -> float:
        """Return a bound of the rounding error of D's eigenvalues at any frequency.

        In units of 2^-53, the error of a complex sum of n products is 3 (n + 6) times the sum of absolute values, with
        |Li2| <= 2. A value of Li2 has an error of 300, of which 160 come from the rounding of its argument near 2 pi.
        The error of a bend is 8 times the adjacent slopes, that of a is 2, with |a| <= 2, and that of a power z^-k is
        7 (k + 2). The error of an eigenvalue is 20 m times the norm.
        """
        m, bends, slopes = len(self.mean), np.abs(self.bends).sum(axis=0), self.slopes.sum(axis=0)
        steps = np.arange(len(self.sums))[:, None, None]
        entries = 4 * bends * (3 * (self.points.size + 6) + 300) + 64 * slopes + 100 * np.abs(self.mean)
        entries = entries + (np.abs(self.sums) * (7 * (steps + 2) + len(self.sums))).sum(axis=0)
        size = np.linalg.norm(8 * bends + np.abs(self.sums).sum(axis=0) + 3 * np.abs(self.mean))
        return float(_UNIT * (np.linalg.norm(entries) + 20 * m * size))

    def _parts(self, w: Array) -> tuple[Complex, Complex]:
        """Return g and D at these frequencies, (k, m, m) each."""
        spend(_EVALUATION * w.size * self.points.size)
        m = len(self.mean)
        g, c = np.empty((w.size, m * m), dtype=np.complex128), self.bends.reshape(-1, m * m)
        for part in self._chunks(w.size):
            below, above = dilogarithm(self.points - w[part, None]), dilogarithm(self.points + w[part, None])
            g[part] = below @ c + np.conj(above @ c)
        g = g.reshape(-1, m, m) - self.mean
        powers = np.exp(-1j * np.outer(w, np.arange(len(self.sums))))
        polynomial = (powers @ self.sums.reshape(len(self.sums), -1)).reshape(-1, m, m)
        return g, hermitian(self.mean - (np.exp(-1j * w) - 1)[:, None, None] * g + polynomial)

    def _error(self, left: Array, right: Array, g_left: Complex, g_right: Complex) -> Array:
        """Return a bound of the norm of the difference between D and its linear interpolant in each interval, (k,)."""
        spend(_EVALUATION * left.size * self.points.size)
        m, length = len(self.mean), (right - left)[:, None, None]
        g = np.empty((left.size, m * m))
        for part in self._chunks(left.size):
            g[part] = self._interpolation(left[part, None], right[part, None])
        jump, size = np.abs(g_right - g_left), np.maximum(np.abs(g_left), np.abs(g_right))
        modulus = np.minimum(right, 2.0)[:, None, None]  # |a| = 2 sin(w/2)
        error = modulus * g.reshape(-1, m, m) + length**2 / 8 * size + length / 4 * jump
        squares = np.arange(len(self.sums))[:, None, None] ** 2
        error = error + length**2 / 8 * (squares * np.abs(self.sums)).sum(axis=0)
        norm = np.linalg.norm((error + np.swapaxes(error, 1, 2)) / 2, axis=(1, 2))
        return (1 + 1e-9) * norm  # The sums have no negative terms, so their relative rounding error is below 1e-9.

    def _interpolation(self, left: Array, right: Array) -> Array:
        """Return bounds (k, m^2) on the interpolation errors of the entries of g; left and right are (k, 1)."""
        c, x, middle, length = self.bends.reshape(len(self.bends), -1), self.points, (left + right) / 2, right - left
        below = np.maximum(np.maximum(x - right, left - x), 0.0)
        above = np.maximum(np.minimum(x + left, 2 * np.pi - x - right), 0.0)
        bend = turn = np.zeros((len(left), c.shape[1]), dtype=np.complex128)
        rest = np.zeros((len(left), x.size))
        for distance, angle, sign in ((below, x - middle, -1), (above, x + middle, 1)):
            far = distance > _FAR * length
            cot = np.where(far, 1 / np.tan(np.where(far, angle, 1.0) / 2), 0.0)
            second, third = far @ c / 2 - 0.5j * (cot @ c), 0.25j * ((far + cot**2) @ c)
            bend = bend + (second if sign < 0 else np.conj(second))
            turn = turn + (-third if sign < 0 else np.conj(third))
            fourth = length**2 / 32 / np.sin(np.where(far, distance, 1.0) / 2) ** 3
            beyond = length**2 / 8 * (fourth + _COTANGENT * (1 + np.abs(cot)) ** 2)
            near = length**2 / 16 + np.minimum(length / np.e, length**2 / (8 * np.maximum(distance, length / 100)))
            rest += np.where(far, beyond, near)
        return rest @ np.abs(c) + length**2 / 8 * (np.abs(bend) + length / 2 * np.abs(turn))

    def _chunks(self, count: int) -> list[slice]:
        step = max(_CHUNK // self.points.size, 1)
        return [slice(start, start + step) for start in range(0, count, step)]


@cache
def _clausen() -> list[float]:
    """Return 2 zeta(n)/((2 pi)^n n (n + 1)) = |B_n|/(n! n (n + 1)) for n = 46, 44, .., 2 and Bernoulli's B."""
    B = [Fraction(1)]
    for n in range(1, 47):
        B.append(-sum((math.comb(n + 1, k) * B[k] for k in range(n)), Fraction(0)) / (n + 1))
    return [float(abs(B[n]) / (math.factorial(n) * n * (n + 1))) for n in range(46, 0, -2)]


def dilogarithm(x: Array) -> Complex:
    """Return Li2(e^jx) for |x| <= 2 pi."""
    short = np.where(np.abs(x) > np.pi, x - 2 * np.pi * np.sign(x), x)
    square, series = short**2, np.zeros_like(short)
    for coefficient in _clausen():
        series += coefficient
        series *= square
    clausen = short * (1 + series - np.log(np.where(short == 0, 1.0, np.abs(short))))
    return np.pi**2 / 6 - np.abs(short) * (2 * np.pi - np.abs(short)) / 4 + 1j * clausen
