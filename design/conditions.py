"""What a loop must satisfy so that no passive human can make it oscillate. Each condition states its block once.

A condition is a block that must be strictly positive real: He[block] > 0 on |z| = 1. `Demand` holds it as
free + s gain, where s multiplies the damping Delta_D that the devices guarantee. Poles at z = 1 are split off,
G/(z - 1) into G(1)/(z - 1), whose Hermitian part on the circle is -G(1)/2, and the quotient (G - G(1))/(z - 1). The
same expression is evaluated in floating point (a sweep: the required damping), over Fractions (an exact proof), over
stacks and over sampled responses (maps and designs). docs/theory.md derives them.

this-environment   He[F/(z-1)] > -Delta_D/T,  F stable,  F(1) symmetric positive semidefinite
any-environment    Lemma 4 of the paper for Psi = I and any passive environment under backward Euler:
                   He[(z-1) V/(Tz)] >= diag((1 - cos n_i w) / (2 delta_i)),   n_i = theta_i + 1
switching          this-environment for delays of the forces that vary within lo..hi at every tick
latency            this-environment for forces that latch a fraction of a sample after the tick, anew at every tick
walls              this-environment for walls that make and break contact
limiter            this-environment for forces that leave through the limiter of controller.process

The period may vary from tick to tick, up to T_max, in all of them: `even_damping` is where it enters.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from typing import Any, Generic, Literal, TypeVar

import numpy as np
from scipy.linalg import solve_discrete_lyapunov
from scipy.optimize import linprog, minimize, minimize_scalar

from controller.delay import delay, moving_sum
from controller.lti import (
    Array,
    Block,
    Complex,
    Lti,
    Number,
    Sampled,
    SingularLoop,
    as_like,
    constant_like,
    hstack,
    numbers,
    taps,
    vstack,
)
from design.frequency import (
    Response,
    frequencies,
    frequencies_of_many,
    hermitian,
    largest_eigenvalue,
    on_circle,
    rounding,
    suprema,
    supremum,
)

Condition = Literal["this-environment", "any-environment"]

C = TypeVar("C", bound=str)  # a Condition, "jitter-proof" or "limiter"

#: c_ij >= 0 of the limiter's multiplier: for every channel i a weight per lag j = 1, 2, ..; none is zero
Lags = Sequence[Sequence[Any]]


@dataclass(frozen=True, eq=False)
class Demand(Generic[Block]):
    """free + s gain must be strictly positive real, with s = 1 for the damping that there is.

    `static` are matrices that must be symmetric, by name; those in `semidefinite` also positive semidefinite.
    """

    free: Block
    gain: Block
    static: Mapping[str, Array] = field(default_factory=dict)
    semidefinite: tuple[str, ...] = ()


def even_damping(delta: Sequence[Any], T: Number, T_max: float | None = None) -> Any:
    """Delta_D T/T_max [N s/m], (m,): the damping that does in even periods T what delta does in periods up to T_max.

    The integral of delta v^2 over a period T_k is at least delta dx^2/T_k, so the longest period counts. Nothing else
    in the energy balance depends on T: the force map is the same at every tick, however long the tick is.
    """
    damping = numbers(delta, T)
    return damping if T_max is None else damping * (T / numbers(T_max, T))


Latency = Sequence[tuple[float, float]]  # (m,) t1 and t2 [s], 0 <= t1 <= t2 < T: how late after a tick forces latch


def this_environment_demand(
    F: Block, delta: Sequence[Any], T_max: float | None = None, latency: Latency | None = None
) -> Demand[Block]:
    """He[F/(z-1)] > -s Delta_D/T_max. F displaces devices to forces (6), in any arithmetic; delta (m,) [N s/m].

    The energy that a device with a passive human can give back in a tick is at most the damping's, Delta_D dx^2/T, and
    what the force map gives is -F dx; with F(z) = F(1) + (z-1) R the block is R - F(1)/2 + s Delta_D/T. Forces that
    latch later than at the tick have a block of twice the size, see `latency_demand`.
    """
    if latency is not None:
        return latency_demand(F, delta, latency, T_max)
    F1, R = F.split_at_one()
    return Demand(R - F1 / 2, constant_like(F, np.diag(even_damping(delta, F.T, T_max) / F.T)), {"F(1)": F1}, ("F(1)",))


def latency_demand(F: Block, delta: Sequence[Any], latency: Latency, T_max: float | None = None) -> Demand[Block]:
    """this-environment for forces that latch at kT + tau_k, with any tau_k in [t1, t2] at every tick and channel.

    Between kT and kT + tau_k the force of the tick before still acts: a device moves by a under f[k-1] and then by b
    under f[k], and dissipates at least delta a^2/t2 + delta b^2/(T_max - t1). With Gam = F/(z-1) the block is, on
    (a, b),
        [[Gam/z + s Delta_D/t2, Gam/z], [Gam, Gam + s Delta_D/(T_max - t1)]],
    whose pole at z = 1 has F(1) in all four entries. A channel with t2 = 0 has no row of the first kind. The shortest
    period must be longer than t2.
    """
    T, m = F.T, F.D.shape[-1] if isinstance(F, Lti) else F.G.shape[-1]
    longest = T if T_max is None else numbers(T_max, T)
    first, last = (numbers([row[i] for row in latency], T) for i in (0, 1))
    late = [i for i in range(m) if last[i]]
    one = np.eye(m, dtype=int)
    before = one[late] @ delay((1,) * m, T)
    both = as_like(F, vstack(before, Lti.constant(one, T))) @ F @ np.hstack([one[:, late], one])
    E1, R = both.split_at_one()
    damping = numbers(delta, T)
    gain = np.concatenate([damping[late] / last[late], damping / (longest - first)])
    return Demand(R - E1 / 2, constant_like(F, np.diag(gain)), {"F(1)": E1[..., len(late) :, len(late) :]}, ("F(1)",))


def walls_demand(
    G: Block,
    delta: Sequence[Any],
    stiffness: Sequence[Any],
    g: Any,
    lam: Sequence[Any] | None = None,
    T_max: float | None = None,
) -> Demand[Block]:
    """this-environment for walls p = k max(0, y - gap) of any slope k up to `stiffness` (w,) [N/m] and any gap.

    G takes [x; p] to [f; y], displacements (m,) and wall forces to the forces of the devices and the ways into the
    walls, [[F, J], [H, Y]]. With a multiplier g >= 0 and a weight lam > 0 for each wall (1 if not given) and
    M = g (z-1) - 1 the block is, on (dx, dp),
        [[F, J], [-lam M H, -lam M Y]]/(z-1) + diag(s Delta_D/T, lam g/stiffness),
    whose static part must be symmetric, J(1) = H(1)' lam and lam Y(1) = Y(1)' lam, with F(1) >= 0 >= lam Y(1).
    """
    T, m, w = G.T, len(delta), len(stiffness)
    gains, one = numbers(g, T), numbers(np.eye(m + w), T)
    weights = numbers([1] * w if lam is None else lam, T)
    weigh = np.diag(np.concatenate([numbers([1] * m, T), weights]))
    S1, R = (weigh @ G).split_at_one()
    slopes = np.diag(np.concatenate([numbers([0] * m, T), weights * gains]))
    limits = np.concatenate([numbers([0] * m, T), weights * gains / numbers(stiffness, T)])
    free = np.hstack([one, -slopes]) @ vstack(R, G) - S1 / 2 + np.diag(limits)
    damping = np.concatenate([even_damping(delta, T, T_max) / T, numbers([0] * w, T)])
    F1, Y1 = S1[..., :m, :m], S1[..., m:, m:]
    static = {"F(1)": F1, "-Y(1)": -Y1, "the static map of devices and walls": S1}
    return Demand(free, constant_like(G, np.diag(damping)), static, ("F(1)", "-Y(1)"))


def any_environment_demand(
    V: Block, theta: Sequence[int], delta: Sequence[Any], T_max: float | None = None
) -> Demand[Block]:
    """He[(1 - 1/z) V/T] >= diag(|1 - z^-n_i|^2 / (4 s delta_i)), n = theta + 1, divided by |1 - 1/z|^2 and times s.

    With Theta-hat = diag(T/(2 delta_i) (1 + 1/z + ... + z^-theta_i)) (12) and H = V - Theta-hat/s, which (11) makes
    V-hat of, the block is H(1)/2 - (H - H(1))/(z - 1) for either part.
    """
    window = np.diag(V.T / (2 * even_damping(delta, V.T, T_max))) @ as_like(V, moving_sum(theta, V.T))
    (V1, R), (W1, S) = V.split_at_one(), window.split_at_one()
    return Demand(S - W1 / 2, V1 / 2 - R, {"V(1)": V1})


def switching_block(
    G: Block,
    lo: Sequence[int],
    hi: Sequence[int],
    delta: Any,
    alpha: Any,
    T_max: float | None = None,
) -> tuple[Block, Array]:
    """[[F/(z-1) + Delta_D/T - diag(alpha)/2, 0], [2 h G, 2 diag(alpha)]], which must be positive real; and F(1).

    F = Theta_nom G with Theta_nom = (z^-lo + z^-hi)/2 and 2 h = hi - lo; G are the forces as they leave,
    alpha (m,) [N/m] is a multiplier, positive where the delay varies. Channels whose delay does not vary have no row
    and column of the second kind.

    A force that is late by n in [lo, hi] differs from the nominal one by at most h times the sum of the steps in
    between; the multiplier weighs that error against the displacement (an S-procedure, channel by channel).
    """
    T, widths = G.T, [b - a for a, b in zip(lo, hi, strict=True)]
    varying = [i for i, width in enumerate(widths) if width]
    a = numbers(alpha, T)
    half = Lti.diag(*(taps(_halves(p, q), T) for p, q in zip(lo, hi, strict=True)))
    spread = Lti.constant(
        np.array([[widths[i] * (i == j) for j in range(len(lo))] for i in varying]).reshape(-1, len(lo)), T
    )
    both: Any = as_like(G, vstack(half, spread)) @ G
    m = len(lo)
    F1, R = both.rows(slice(None, m)).split_at_one()
    upper = R - F1 / 2 + np.diag(even_damping(delta, T, T_max) / T - a / 2)
    if not varying:
        return upper, F1
    lower = np.zeros((m + len(varying), len(varying)), dtype=object)
    lower[m:] = np.diag(2 * a[varying])
    return hstack(vstack(upper, both.rows(slice(m, None))), constant_like(G, numbers(lower, T))), F1


def _halves(lo: int, hi: int) -> list[Number]:
    return [Fraction((i == lo) + (i == hi), 2) for i in range(hi + 1)]


def limiter_demand(
    G: Block, theta: Sequence[int], delta: Any, rho: Sequence[Any], c: Lags, T_max: float | None = None
) -> Demand[Block]:
    """The limiter's block on (dx - de, de), the steps of what the environment follows and of the slip.

    G are the forces as they leave without the limiter, rho (m,) [N/m] its lag, fixed numbers that the damping does
    not scale, and c the multiplier. With df_e = G (dx - de) - rho (1 - 1/z) de, the steps of the limited forces, the
    block is [Theta/(z-1); N] df_e + s Delta_D/T [1, 0; 2, 1], where
    N_i = -(1 + .. + z^-theta_i) - sum_j c_ij (j + (j-1)/z + .. + z^-(j-1)).
    """
    m, T = len(theta), G.T
    damping = np.diag(even_damping(delta, T, T_max) / T)
    lines = Lti.diag(*(_delay_and_weights(n, row, T) for n, row in zip(theta, c, strict=True)))
    lines = lines.rows([*range(0, 2 * m, 2), *range(1, 2 * m, 2)])
    difference = Lti.diag(*(taps([1, -1], T) for _ in theta))
    steps: Any = hstack(G, as_like(G, difference @ np.diag(-numbers(rho, T))))
    both = as_like(G, lines) @ steps
    static, ramp = both.rows(slice(None, m)).split_at_one()  # [F(1), 0]: the slip's steps have no mean
    zero = np.zeros((m, m), dtype=int)
    free = vstack(ramp - static / 2, both.rows(slice(m, None)))
    gain = np.block([[damping, zero], [2 * damping, damping]])
    return Demand(free, constant_like(G, gain), {"F(1)": static[..., :m]}, ("F(1)",))


def _delay_and_weights(theta: int, c: Sequence[Any], T: Number) -> Lti:
    """[z^-theta; N] of one channel, over one line of delays."""
    lags = range(1, len(c) + 1)
    size = max(theta + 1, len(c))
    late = [int(k == theta) for k in range(size)]
    weights = [-sum([numbers(c[j - 1], T) * (j - k) for j in lags if j > k], int(k <= theta)) for k in range(size)]
    first, second = taps(late, T), taps(weights, T)
    return Lti(first.A, first.B, np.vstack([first.C, second.C]), np.vstack([first.D, second.D]), T)


def delayed_environment_block(delayed: Lti, phi: Sequence[Any]) -> tuple[Array, Lti]:
    """E(1), and E-hat + Phi without its pole, which must be positive real; `delayed` is Psi E.

    E-hat = T z/(z-1) Psi E = T E(1) z/(z-1) + T z R(z), and the Hermitian part of z/(z-1) on the circle is 1/2:
    T (z R + E(1)/2) + Phi. Delay makes the environment lose passivity; Phi (14) covers the loss.
    """
    E1, R = delayed.split_at_one()
    T, passive = delayed.T, Lti(R.A, R.B, R.C @ R.A, R.C @ R.B + E1 / 2, delayed.T)
    return E1, T * passive + np.diag(numbers(phi, T))


#: Delta_V^-1 stays this much, relatively, below the limit of (14), which is strict.
STRICT = Fraction(1, 10**9)
#: Delta_V^-1 in units of 1/delta where Phi is 0 and (14) asks only Delta_V > 0.
UNLIMITED = 10**6


def delayed_coupling_block(
    V: Lti, theta: Sequence[int], phi: Sequence[Any], delta: Any, T_max: float | None = None
) -> tuple[Array, Lti]:
    """H(1), which must be symmetric, and the block that carries the excess of V-hat, exactly, for the multiplier phi.

    V-hat must be Delta_V-OSP with Delta_V^-1 = S < Phi^-1 - Delta_D^-1 (14). With H = V - Theta-hat = H(1) + (z-1) R,
    divided by |1 - 1/z|^2: T He[H(1)/2 - R] > H* S^-1 H, by a Schur complement the Hermitian part of
    [[T (H(1)/2 - R), 0], [2 H, S]]. Raises ValueError for a multiplier that is none.
    """
    T = V.T
    damping = even_damping(delta, T, T_max)
    if len(phi) != len(delta) or not all(0 <= p < d for p, d in zip(phi, damping, strict=True)):
        raise ValueError("the multiplier Phi is not between 0 and the device damping on every channel")
    H = V - np.diag(T / (2 * damping)) @ moving_sum(theta, T)
    H1, R = H.split_at_one()
    excess = [(1 / p - 1 / d) * (1 - STRICT) if p else UNLIMITED / d for p, d in zip(phi, damping, strict=True)]
    m = len(delta)
    right = np.vstack([np.zeros((m, m), dtype=object), np.diag(numbers(excess, T))])
    return H1, hstack(vstack(T * (H1 / 2 - R), 2 * H), Lti.constant(right, T))


# How much damping a condition asks: sweeps, without a solver.


@dataclass(frozen=True)
class Requirement(Generic[C]):
    """The damping that a condition asks of the devices, against what they have."""

    condition: C
    required: tuple[float, ...]  # (m,) [N s/m]; inf when no damping helps
    available: tuple[float, ...]  # (m,) [N s/m]
    frequency_hz: float | None  # where it binds
    reason: str | None = None  # why the figure is infinite
    proof: str = "sampled"

    @property
    def ratio(self) -> float:
        """s: required / available on the worst channel."""
        pairs = zip(self.required, self.available, strict=True)
        return max(need / have if have > 0 else np.inf for need, have in pairs)

    @property
    def certified(self) -> bool:
        return self.ratio < 1


def least_scale(demand: Demand[Any], w: Array) -> Array:
    """The least s with He[free + s gain] >= 0 at each frequency w (k,) [rad/sample]; inf where there is none."""
    z = on_circle(w)
    free, gain = hermitian(demand.free.at(z)), hermitian(demand.gain.at(z))
    return least_multiple(free, gain)


def least_multiple(free: Complex, gain: Complex) -> Array:
    """The least s with free + s gain >= 0, (...,), of Hermitian (..., p, p) with gain >= 0; inf where there is none.

    Where gain is singular, free must be positive on its null space; the rest is a Schur complement.
    """
    own = np.diagonal(gain, axis1=-2, axis2=-1).real
    if (own > 0).all() and not (gain * (1 - np.eye(gain.shape[-1]))).any():
        weight = 1 / np.sqrt(own)
        return largest_eigenvalue(-weight[..., :, None] * free * weight[..., None, :])
    eigenvalues, basis = np.linalg.eigh(gain)
    floor = np.maximum(1e-13 * np.abs(eigenvalues).max(axis=-1, keepdims=True), np.finfo(float).tiny)
    scale = np.where(eigenvalues > floor, 1 / np.sqrt(np.maximum(eigenvalues, floor)), 1.0)
    whitened = np.conj(np.swapaxes(basis, -1, -2)) * scale[..., :, None]
    H = whitened @ (free @ np.conj(np.swapaxes(whitened, -1, -2)))
    flat, shape = H.reshape(-1, *H.shape[-2:]), H.shape[:-2]
    missing = np.broadcast_to((eigenvalues <= floor).sum(axis=-1), shape).ravel()
    needed = np.empty(missing.size)
    for r in np.unique(missing):  # eigenvalues ascend: the first r directions are those that the gain does not reach
        here = flat[missing == r]
        needed[missing == r] = _beyond_the_null_space(here, r) if r else np.linalg.eigvalsh(-here)[:, -1]
    needed[np.broadcast_to((eigenvalues < -floor).any(axis=-1), shape).ravel()] = np.inf
    return needed.reshape(shape)


def _beyond_the_null_space(H: Complex, r: int) -> Array:
    """The least s with H + s diag(0, I) >= 0, where 0 has r rows; (n,)."""
    null, cross, rest = H[:, :r, :r], H[:, :r, r:], H[:, r:, r:]
    size = np.abs(np.diagonal(H, axis1=1, axis2=2)).max(axis=1, initial=0.0)
    positive = np.linalg.eigvalsh(null)[:, 0] > 1e-13 * size
    needed = np.full(len(H), np.inf)
    left = rest - np.conj(np.swapaxes(cross, 1, 2)) @ np.linalg.solve(
        np.where(positive[:, None, None], null, np.eye(r)), cross
    )
    if r < H.shape[-1]:
        needed[positive] = np.linalg.eigvalsh(-left)[positive, -1]
    return needed


def this_environment(
    F: Lti, delta: Sequence[float], T_max: float | None = None, latency: Latency | None = None
) -> Requirement:
    """The damping that this-environment asks for the force map F, with device dampings `delta` [N s/m].

    For periods up to T_max [s] (T without it), and forces that latch late by `latency` (m,) [s] (at the tick without).
    """
    available = dampings(delta, F.inputs)

    def refused(reason: str) -> Requirement:
        return refusal("this-environment", available, reason)

    if min(available) == 0:
        return refused("a device guarantees no damping, so no coupling is safe for every passive human")
    radius = float(np.abs(F.poles()).max(initial=0.0))
    if radius >= 1:
        return refused(f"the force map has a pole at radius {radius:.6f}, on or outside the unit circle")
    try:
        demand = this_environment_demand(F, available, T_max, latency)
    except SingularLoop as error:  # a radius that rounding has kept below one
        return refused(f"the force map is singular in floating point: {error}")
    F1, end = F.dc(), F.at(-1.0)
    skew, least = _static_errors(F1, F.D, end)
    slack = STATIC
    if max(skew, -least) > slack:  # of a map that is nothing but rounding
        size = max(float(np.abs(part).max()) for part in (F1, F.D, end))
        allowed = min(rounding(F, on_circle(frequencies(F))), STATIC * min(available) / F.T)
        slack = max(slack, allowed / max(size, 1e-12))
    if skew > slack:
        return refused("the static stiffness F(1) is not symmetric: a slow closed path could extract energy")
    if least < -slack:
        return refused("the static stiffness F(1) has a negative direction: it pushes outwards")
    ratio, w = supremum(lambda w: least_scale(demand, w), np.concatenate([[0.0], frequencies(F)]))
    return from_ratio("this-environment", max(ratio, 0.0), available, w / (2 * np.pi * F.T))


W_ZERO = 1e-10  # [rad/sample] stands for F(1) of many, whose real part is even: sampled, a network may be 0/0 there
#: rounding that F(1) may miss of symmetry and of positive semidefiniteness
STATIC = 1e-9


def _static_errors(F1: Array, *elsewhere: Array | Complex) -> tuple[Array, Array]:
    """How far F(1) is from symmetric, and its least eigenvalue; relatively to what F is elsewhere, (...,) each.

    A free mass has F(1) = 0 out of large numbers.
    """
    scale = np.max([np.abs(part).max(axis=(-2, -1)) for part in (F1, *elsewhere)], axis=0, initial=1e-12)
    turned = np.swapaxes(F1, -1, -2)
    least = np.linalg.eigvalsh((F1 + turned) / 2).min(axis=-1)
    return np.abs(F1 - turned).max(axis=(-2, -1)) / scale, least / scale


def any_environment(V: Lti, theta: Sequence[int], delta: Sequence[float], T_max: float | None = None) -> Requirement:
    """The damping that any-environment asks for psi = 0 and V, whatever passive environment is behind it."""
    available = dampings(delta, V.inputs)
    if len(theta) != V.inputs:
        raise ValueError(f"theta has {len(theta)} entries for {V.inputs} channels")

    def refused(reason: str) -> Requirement:
        return refusal("any-environment", available, reason)

    if min(available) == 0:
        return refused("a device guarantees no damping, so no coupling is safe for every passive human")
    if not V.is_stable():
        return refused("the coupling V has a pole on or outside the unit circle")
    demand = any_environment_demand(V, theta, available, T_max)
    V1 = demand.static["V(1)"]
    if np.abs(V1 - V1.T).max() > 1e-9 * max(float(np.abs(V1).max()), 1e-300):
        return refused("the static compliance V(1) is not symmetric")
    least = lambda w: _scale_beside_zeros(V, demand, w)  # noqa: E731
    ratio, w = supremum(least, np.concatenate([[0.0], frequencies(V)]))
    if ratio > _NEVER:
        return refused(f"V is not passive enough at {w / (2 * np.pi * V.T):.4g} Hz: its damping vanishes there")
    return from_ratio("any-environment", ratio, available, w / (2 * np.pi * V.T))


#: V is taken to vanish in a direction in which it is smaller than this, beside V(1): nearer to a zero is rounding.
_VANISHES = 1e-5
#: What stands there in place of its passivity, beside V(1), and the ratio from which on nothing else does.
_SOFTENED, _NEVER = 1e-12, 1e6


def _scale_beside_zeros(V: Lti, demand: Demand[Any], w: Array) -> Array:
    """As `least_scale`, (k,), but a direction in which V vanishes needs no passivity of its own.

    Where V and the delays' window vanish together, so does V-hat, and He V-hat >= Delta_V |V-hat|^2 is 0 >= 0: the
    moving average does it at every zero of its window. Where only V does, the ratio is large.
    """
    z = on_circle(w)
    free, gain = hermitian(demand.free.at(z)), hermitian(demand.gain.at(z))
    _, sizes, right = np.linalg.svd(V.at(z))
    static = float(np.abs(demand.static["V(1)"]).max())
    idle = (sizes <= _VANISHES * static) * (_SOFTENED * static)
    return least_multiple(free, gain + np.conj(np.swapaxes(right, -1, -2)) @ (idle[..., None] * right))


def any_environment_per_channel(
    V: Sequence[Lti], theta: Sequence[int], delta: Sequence[float], T_max: float | None = None
) -> Requirement:
    """any-environment for a diagonal coupling, given its channels: each device's own figure."""
    each = [any_environment(v, [n], [d], T_max) for v, n, d in zip(V, theta, delta, strict=True)]
    worst = max(each, key=lambda r: r.ratio)
    required = tuple(r.required[0] for r in each)
    available = tuple(r.available[0] for r in each)
    return Requirement("any-environment", required, available, worst.frequency_hz, worst.reason)


def from_ratio(condition: C, ratio: float, available: tuple[float, ...], frequency_hz: float) -> Requirement[C]:
    """The requirement of `ratio` times what is available, on every channel."""
    return Requirement(condition, tuple(ratio * delta for delta in available), available, frequency_hz)


def refusal(condition: C, available: tuple[float, ...], reason: str) -> Requirement[C]:
    """The requirement that no damping satisfies."""
    return Requirement(condition, (np.inf,) * len(available), available, None, reason)


def dampings(delta: Sequence[float], channels: int) -> tuple[float, ...]:
    """`delta` as floats, one positive damping per channel [N s/m]."""
    values = tuple(float(d) for d in delta)
    if len(values) != channels:
        raise ValueError(f"delta has {len(values)} entries for {channels} channels")
    if not all(0 <= d < np.inf for d in values):
        raise ValueError(f"delta is {list(values)}, expected dampings >= 0 in N s/m")
    return values


# this-environment with walls: the best multiplier. The least s is convex in g, because the block is affine in both.


#: Where the multiplier of a wall is looked for [samples], and the digits that are kept of it.
LEAST_G, MOST_G, G_DIGITS = 1e-3, 1e3, 4


@dataclass(frozen=True)
class WallsProof:
    """What walls that make and break contact ask of the devices."""

    requirement: Requirement  # condition "this-environment"
    g: tuple[float, ...]  # (w,) the multiplier that shows it


def walls_proof(
    G: Lti,
    delta: Sequence[float],
    stiffness: Sequence[float],
    g: Sequence[float] | None = None,
    T_max: float | None = None,
) -> WallsProof:
    """The damping that `walls_demand` asks with the best multiplier found, or with g (w,) where it is given.

    G takes [x; p] to [f; y] while no wall touches.
    """
    m, w = len(delta), len(stiffness)
    available = dampings(delta, m)

    def refused(reason: str) -> WallsProof:
        return WallsProof(refusal("this-environment", available, reason), tuple(g or (1.0,) * w))

    if min(available) == 0:
        return refused("a device guarantees no damping, so no coupling is safe for every passive human")
    radius = float(np.abs(G.poles()).max(initial=0.0))
    if radius >= 1:
        return refused(f"the force map has a pole at radius {radius:.6f}, on or outside the unit circle")
    S1 = G.dc()
    # rounding, relative to what each channel and wall is elsewhere
    own = np.abs([np.diag(S1), np.diag(G.D), np.diag(G.at(-1.0))]).max(axis=0)
    if (np.abs(S1 - S1.T) > 1e-9 * np.sqrt(np.outer(own, own))).any():
        return refused("the static map of devices and walls is not symmetric: a slow closed path could extract energy")
    for name, part, size in (("F(1)", S1[:m, :m], own[:m]), ("-Y(1)", -S1[m:, m:], own[m:])):
        if np.linalg.eigvalsh((part + part.T) / 2).min() < -1e-9 * size.max():
            return refused(f"{name} has a negative direction: it pushes outwards")
    grid = np.concatenate([[0.0], frequencies(G)])
    z = on_circle(frequencies(G, points=100))
    sampled = Sampled(z[None], G.at(z)[None], G.T)

    def needed(values: Array) -> float:
        demand = walls_demand(sampled, available, stiffness, values, None, T_max)
        return float(least_multiple(hermitian(demand.free.G), hermitian(demand.gain.G)).max())

    found = _best_g(needed, w) if g is None else np.asarray(g, dtype=float)
    demand = walls_demand(G, available, stiffness, found, None, T_max)
    ratio, at = supremum(lambda w: least_scale(demand, w), grid)
    if np.isinf(ratio):
        return refused("no multiplier was found with which the walls are covered, whatever the damping")
    return WallsProof(
        from_ratio("this-environment", max(ratio, 0.0), available, at / (2 * np.pi * G.T)), tuple(found.tolist())
    )


def _best_g(needed: Callable[[Array], float], walls: int) -> Array:
    """g (walls,) with about the least `needed`: one for all of them, then one by one, each by a search in log g."""
    g = np.ones(walls)
    turns = [np.ones(walls, dtype=bool), *(np.eye(walls, dtype=bool) if walls > 1 else ())]

    def moved(which: Array, value: float) -> Array:
        return np.where(which, value, g)

    for which in turns:
        grid = np.geomspace(LEAST_G, MOST_G, 13)
        values = [needed(moved(which, value)) for value in grid]
        best = int(np.argmin(values))
        ends = np.log(grid[max(best - 1, 0)]), np.log(grid[min(best + 1, grid.size - 1)])
        finer = minimize_scalar(
            lambda x, which=which: min(needed(moved(which, np.exp(x))), 1e300),
            bounds=ends,
            method="bounded",
            options={"xatol": 1e-2},
        )
        g = moved(which, float(np.exp(finer.x)) if finer.fun < values[best] else float(grid[best]))
    return np.array([float(f"{value:.{G_DIGITS}g}") for value in g])


# Encoder steps under Coulomb friction
#
# f = F (x + n) with |n_j| <= q_j/2 is F x + w with |w_i| <= W_i = sum_j |F_ij|_1 q_j/2, where |F_ij|_1 is the sum of
# the absolute values of the impulse response. In a tick w does the work w'dx <= sum_i W_i (integral of |v_i|), and
# Coulomb friction of at least W_i at the encoder's coordinate dissipates that.


SMALL_TAIL, CHUNK, MOST_CHUNKS = (
    1e-9,
    256,
    20_000,
)  # of the bound; ticks summed at once; where the sum ends at the latest


def l1_gain(F: Lti) -> Array:
    """The sum over all ticks of |impulse response| of every entry, (p, m), from above; inf for an unstable F.

    Ticks are summed until what is left is small, and the rest is bounded: with A'PA <= r^2 P, r < 1,
    |c A^k b| <= r^k sqrt(c P^-1 c' b'P b).
    """
    A, X = F.A, F.B
    radius = float(np.abs(F.poles()).max(initial=0.0))
    if radius >= 1:
        return np.full(F.D.shape, np.inf)
    total = np.abs(F.D)
    if not F.order:
        return total
    r = (1 + radius) / 2
    P = solve_discrete_lyapunov(A.T / r, np.eye(F.order))
    P = (P + P.T) / 2
    reach = np.sqrt(np.einsum("in,ni->i", F.C, np.linalg.solve(P, F.C.T)))
    powers = [F.C]
    for _ in range(CHUNK - 1):
        powers.append(powers[-1] @ A)
    rows, ahead = np.stack(powers), np.linalg.matrix_power(A, CHUNK)
    tail = np.full_like(total, np.inf)
    for _ in range(MOST_CHUNKS):
        total = total + np.abs(rows @ X).sum(axis=0)
        X = ahead @ X
        tail = np.outer(reach, np.sqrt(np.maximum(np.einsum("nj,nk,kj->j", X, P, X), 0.0))) / (1 - r)
        if (tail <= SMALL_TAIL * total.max()).all():
            break
    return total + tail


def encoder_friction(F: Lti, steps: Sequence[float]) -> Array:
    """(p,) [N] Coulomb friction at each device that pays for encoder steps (m,) [m], whatever condition F satisfies.

    It is the friction at the encoder's own coordinate, beside the damping delta. Not behind a limiter or walls.
    """
    q = np.asarray(steps, dtype=float)
    if q.shape != (F.inputs,) or not (q >= 0).all():
        raise ValueError(f"steps is {q.tolist()}, expected {F.inputs} encoder steps >= 0 in m")
    return l1_gain(F) @ (q / 2)


# any-environment with delay inside the environment (psi >= 1), for a given multiplier Phi


#: What a sweep may find uncovered, relatively to the damping: rounding.
ROUNDING = 1e-6


def any_environment_delayed(
    V: Lti,
    environment: Lti,
    theta: Sequence[int],
    psi: Sequence[int],
    delta: Sequence[float],
    phi: Array,
    T_max: float | None = None,
) -> Requirement:
    """Theorem 4 for the coupling V with the diagonal multiplier phi (N,) [N s/m]; phi = 0 is `any_environment`.

    The ratio s is the least for which s Delta_D satisfies, at every frequency and divided by |1 - 1/z|^2,
    He[H/(1-z)] >= H* Delta_V H with H = V - Theta-hat/s and Delta_V = Phi + Phi (s Delta_D - Phi)^-1 Phi.
    """
    available = dampings(delta, V.inputs)

    def refused(reason: str) -> Requirement:
        return refusal("any-environment", available, reason)

    if not V.is_stable():
        return refused("the coupling V has a pole on or outside the unit circle")
    V1 = V.dc()
    if np.abs(V1 - V1.T).max() > 1e-9 * max(float(np.abs(V1).max()), 1e-300):
        return refused("the static compliance V(1) is not symmetric")
    damping = even_damping(available, V.T, T_max)
    if uncovered(environment, psi, np.diag(phi)) > ROUNDING * max(damping):
        return refused("E-hat + Phi is not passive for this multiplier")
    needed = delayed_demand(V, theta, damping, np.asarray(phi))
    ratio, w = supremum(needed, np.concatenate([[0.0], frequencies(V)]))
    if np.isinf(ratio):
        return refused(f"V is not passive enough at {w / (2 * np.pi * V.T):.4g} Hz for this multiplier")
    return from_ratio("any-environment", ratio, available, w / (2 * np.pi * V.T))


def uncovered(environment: Lti, psi: Sequence[int], Phi: Array) -> float:
    """sup over frequency of the largest eigenvalue of -He E-hat - Phi [N s/m]; > 0 where Phi is too small."""
    delayed = delay(psi, environment.T) @ environment
    regular = regular_part(delayed)

    def short(w: Array) -> Array:
        return -np.linalg.eigvalsh(environment.T * hermitian(regular.at(on_circle(w))) + Phi)[:, 0]

    return supremum(short, np.concatenate([[0.0], frequencies(delayed)]))[0]


def delayed_demand(V: Lti, theta: Sequence[int], delta: Array, phi: Array) -> Response:
    """w (k,) -> the least s of `any_environment_delayed` at each frequency."""
    response = _delayed_response(V, theta)
    return lambda w: _delayed_scale(response.at(on_circle(w)), delta, phi)


def _delayed_response(V: Block, theta: Sequence[int]) -> Block:
    """[(V(1)/2 - R)/T; V/T; 1 + 1/z + ... + z^-theta], what `_delayed_scale` needs of V = V(1) + (z-1) R."""
    V1, R = V.split_at_one()
    return vstack((V1 / 2 - R) * (1 / V.T), V * (1 / V.T), as_like(V, moving_sum(theta, V.T)))


def _delayed_scale(response: Complex, delta: Array, phi: Array) -> Array:
    """The least s of `any_environment_delayed`, (...,), from `_delayed_response` (..., 3m, m); inf where there is none.

    With S = He (V(1)/2 - R)/T - V* Phi V/T^2 and N = (1 + ... + z^-theta)/2 - Phi V/T the inequality is S > 0 and
    s Delta_D >= Phi + N S^-1 N*: two Schur complements of a matrix that is affine in s.
    """
    passivity, VT, window = np.split(response, 3, axis=-2)
    star = lambda M: np.conj(np.swapaxes(M, -1, -2))  # noqa: E731
    S = hermitian(passivity) - star(VT) @ (phi[:, None] * VT)
    N = window / 2 - phi[:, None] * VT
    sound = -largest_eigenvalue(-S) > 0
    S = np.where(sound[..., None, None], S, np.eye(phi.size))
    root = 1 / np.sqrt(delta)
    needed = np.diag(phi) + N @ np.linalg.solve(S, star(N))
    return np.where(sound, largest_eigenvalue(root[:, None] * hermitian(needed) * root), np.inf)


# Many couplings or environments at once: a row for each, as a map asks for them.

Responses = Callable[[Complex], Sampled]  # z (n, k) or (1, k) -> responses there, a row for each system


def this_environment_ratios(
    at: Responses,
    poles: Complex,
    delta: Sequence[float],
    delay: int,
    T_max: float | None = None,
    latency: Latency | None = None,
) -> Array:
    """Required over available damping, (n,), of n loops; inf where no damping is enough.

    `at` gives the responses of their force maps, `poles` (n, p) are these maps' own, and `delay` [samples] is the
    longest way through the loop, which makes so many lobes.
    """
    here, opposite = (np.full((len(poles), 1), w) for w in (W_ZERO, np.pi))
    skew, least = _static_errors(at(on_circle(here)).G[:, 0].real, at(on_circle(opposite)).G[:, 0])
    sound = (np.abs(poles).max(axis=1, initial=0.0) < 1) & (skew <= STATIC) & (least >= -STATIC)

    def needed(w: Array) -> Array:
        return _least_scales(this_environment_demand(at(on_circle(w)), delta, T_max, latency))

    return np.where(sound, np.maximum(suprema(needed, *frequencies_of_many(poles, delay)), 0.0), np.inf)


def any_environment_ratios(
    V: Responses, count: int, theta: Sequence[int], delta: Sequence[float], phi: Sequence[float] | None = None
) -> Array:
    """The same of any-environment for `count` couplings; phi (m,) [N s/m] is the multiplier that psi >= 1 needs."""

    def needed(w: Array) -> Array:
        response = V(on_circle(w))
        if phi is None:
            return _least_scales(any_environment_demand(response, theta, delta))
        return _delayed_scale(_delayed_response(response, theta).G, np.asarray(delta), np.asarray(phi))

    return suprema(needed, *frequencies_of_many(np.zeros((count, 0), dtype=np.complex128), max(theta)))


def _least_scales(demand: Demand[Sampled]) -> Array:
    return least_multiple(hermitian(demand.free.G), hermitian(demand.gain.G))


# delays that switch within [lo, hi]: the best multiplier
#
# With a = alpha T/delta the least factor s on delta is the supremum over frequency of an eigenvalue that is convex in
# a: at every frequency and direction u it is at least u*(..)u, a sum n + p.a + q.(1/a), and that bounds s from below
# for all a. The worst of these bounds are collected until their least a attains them. No convex solver is needed.

SETTLED = 1e-7  # relative gap between the sweep of a multiplier and the bound that no multiplier beats
MOST_ROUNDS = 60
FIRST = 0.1  # the a that a search begins with
SMALLEST, LARGEST = 1e-8, 1e6  # .. and what it may become
NEAR, MOST_PEAKS = 0.3, 8  # of the peaks within 30 % of the highest, so many give a bound


@dataclass(frozen=True)
class JitterProof:
    """What switching within a range asks of the devices."""

    requirement: Requirement  # condition "jitter-proof"
    alpha: tuple[float, ...]  # (m,) [N/m] the multiplier that shows it, at the available damping; 0 where lo = hi
    bound: float  # no multiplier shows less than this times the available damping (on the frequencies looked at)


def jitter_proof(
    G: Lti,
    lo: Sequence[int],
    hi: Sequence[int],
    delta: Sequence[float],
    alpha: Sequence[float] | None = None,
    T_max: float | None = None,
) -> JitterProof:
    """The least common factor on `delta` [N s/m] with which some multiplier satisfies the condition, and which does.

    G is the force map without Theta. The factor is that of the refined sweep (design.frequency.sweep) at the multiplier
    found, or at `alpha` (m,) [N/m] where it is given, positive where lo < hi; `bound` is then that factor.
    """
    available, h = dampings(delta, G.inputs), half_widths(lo, hi)
    if len(h) != G.inputs:
        raise ValueError(f"delays are given for {len(h)} channels, expected {G.inputs}")
    constant = this_environment(nominal(lo, hi, G.T) @ G, delta, T_max)
    if not np.isfinite(constant.ratio):
        return jitter_refusal(available, constant.reason or "no constant delay is safe")
    damping = even_damping(available, G.T, T_max)
    search, unit = _Search(G, lo, hi, damping), damping / G.T
    given = None if alpha is None else (np.asarray(alpha) / unit)[search.active]
    a, ratio, w, bound = search.least() if given is None else search.only(given)
    multiplier = np.zeros(h.size)
    multiplier[search.active] = a
    requirement = from_ratio("jitter-proof", max(ratio, 0.0), available, w / (2 * np.pi * G.T))
    return JitterProof(requirement, tuple((multiplier * unit).tolist()), bound)


def jitter_refusal(available: tuple[float, ...], reason: str) -> JitterProof:
    """That no damping is enough, and why."""
    return JitterProof(refusal("jitter-proof", available, reason), (np.inf,) * len(available), np.inf)


Found = tuple[Array, float, float, float]  # a, s(a), where it binds [rad/sample], a lower bound on s over all a


class _Search:
    """s(a) = sup over w of the largest eigenvalue of N + diag(a)/2 + Y* diag(1/2a) Y, over the channels that vary.

    A Schur complement of `switching_block`, scaled by W = diag(sqrt(T/delta)): N = -W He[F/(z-1)] W,
    F = Theta_nom G, Y = h W G W.
    """

    def __init__(self, G: Lti, lo: Sequence[int], hi: Sequence[int], delta: Array) -> None:
        F = nominal(lo, hi, G.T) @ G
        self._G, self._demand = G, this_environment_demand(F, delta.tolist())
        self._weight, self._h = np.sqrt(G.T / delta), half_widths(lo, hi)
        self.active = np.flatnonzero(self._h)
        self._grid = np.concatenate([[0.0], frequencies(G)])
        none = np.zeros((0, self.active.size))
        self._n, self._p, self._q = np.zeros(0), none, none  # the bounds collected

    def only(self, a: Array) -> Found:
        """s at this a."""
        ratio, w = self._swept(a)
        return a, ratio, w, ratio

    def least(self) -> Found:
        """The least s over all a."""
        a, bound = np.full(self.active.size, FIRST), -np.inf
        if not a.size:
            return self.only(a)
        N, Y = self._parts(self._grid)
        best: tuple[Array, float, float] = (a, np.inf, 0.0)
        for _ in range(MOST_ROUNDS):
            if self._cut(a, N, Y) <= bound + SETTLED * abs(bound):  # settled on the samples: look between them
                ratio, w = self._swept(a)
                best = min(best, (a, ratio, w), key=lambda found: found[1])
                if best[1] <= bound + 10 * SETTLED * abs(bound):
                    return *best, bound
                between = self._parts(np.array([w]))
                N, Y = np.concatenate([N, between[0]]), np.concatenate([Y, between[1]])
                self._cut(a, *between)
            a, bound = self._bound(a)
        return *min(best, (a, *self._swept(a)), key=lambda found: found[1]), bound

    def _swept(self, a: Array) -> tuple[float, float]:
        """(s(a), w) by a sweep that is refined between its samples."""
        return supremum(lambda w: self._largest(a, *self._parts(w)), self._grid)

    def _parts(self, w: Array) -> tuple[Complex, Complex]:
        """N (k, m, m) and the rows of Y with h > 0, at the frequencies w (k,) [rad/sample]."""
        z, W = on_circle(w), self._weight
        N = -W[:, None] * hermitian(self._demand.free.at(z)) * W
        Y = (self._h * W)[:, None] * self._G.at(z) * W
        return N, Y[:, self.active]

    def _matrices(self, a: Array, N: Complex, Y: Complex) -> Complex:
        """N + diag(a)/2 + Y* diag(1/2a) Y, (k, m, m)."""
        diagonal = np.zeros(self._h.size)
        diagonal[self.active] = a / 2
        return N + np.diag(diagonal) + np.conj(np.swapaxes(Y, 1, 2)) @ (Y / (2 * a[:, None]))

    def _largest(self, a: Array, N: Complex, Y: Complex) -> Array:
        return np.linalg.eigvalsh(self._matrices(a, N, Y))[:, -1].astype(float)

    def _cut(self, a: Array, N: Complex, Y: Complex) -> float:
        """Collect the bounds at the local peaks near the worst sampled frequency; the worst value."""
        values = self._largest(a, N, Y)
        top, padded = float(values.max()), np.concatenate([[-np.inf], values, [-np.inf]])
        peaks = np.flatnonzero((values >= padded[:-2]) & (values >= padded[2:]) & (values >= top - NEAR * abs(top)))
        peaks = peaks[np.argsort(values[peaks])[-MOST_PEAKS:]]
        u = np.linalg.eigh(self._matrices(a, N[peaks], Y[peaks]))[1][:, :, -1]
        self._n = np.append(self._n, np.einsum("ki,kij,kj->k", u.conj(), N[peaks], u).real)
        self._p = np.concatenate([self._p, np.abs(u[:, self.active]) ** 2 / 2])
        self._q = np.concatenate([self._q, np.abs(np.einsum("kij,kj->ki", Y[peaks], u)) ** 2 / 2])
        return top

    def _bound(self, a: Array) -> tuple[Array, float]:
        """(a, value): the least maximum over a of the bounds n + p.a + q.(1/a), convex in log a."""

        def below(x: Array) -> Array:
            return x[0] - self._n - self._p @ np.exp(x[1:]) - self._q @ np.exp(-x[1:])

        def slope(x: Array) -> Array:
            return np.column_stack([np.ones(self._n.size), -self._p * np.exp(x[1:]) + self._q * np.exp(-x[1:])])

        start = np.concatenate([[0.0], np.log(a)])
        start[0] = -below(start).min()
        limits = [(None, None)] + [(np.log(SMALLEST), np.log(LARGEST))] * a.size
        gradient = np.eye(1 + a.size)[0]
        found = minimize(
            lambda x: x[0],
            start,
            jac=lambda x: gradient,
            bounds=limits,
            method="SLSQP",
            constraints={"type": "ineq", "fun": below, "jac": slope},
            options={"maxiter": 200, "ftol": 1e-12},
        )
        return np.exp(found.x[1:]), float(found.x[0])


# the limiter: the best multiplier
#
# The block is affine in (s, c), so s(c) is convex, and each direction u at a frequency gives a linear bound:
# u*(free(c) + s gain)u >= 0. The worst of them are collected, a linear program finds the least s that they allow, and
# the search ends where the sweep attains it (Kelley's cutting planes).

BETA = 0.01  # of a limiter's lag under this-environment unless another is asked for
LARGEST_WEIGHT = 10.0  # that a search gives a c_ij
HOPELESS = 1e6  # times the available damping
SPARE = 0.02  # of rho: what the block keeps, however large the damping, so that c may be rounded and the proof exact
LIMITER_SETTLED = 1e-6  # relative gap between the sweep at the best c and the bound that no c beats


@dataclass(frozen=True)
class LimiterProof:
    """What the limiter asks of the devices."""

    requirement: Requirement  # condition "limiter"
    rho: tuple[float, ...]  # (m,) [N/m] the lag of the limiter that is asked about
    c: tuple[tuple[float, ...], ...]  # (m, lags) the multiplier that shows it
    bound: float  # what the search proved of all c that keep SPARE of rho; the ratio itself where c was given


def limiter_lag(delta: Sequence[float], T: float, beta: float) -> tuple[float, ...]:
    """rho = beta delta/T [N/m] of a limiter under this-environment, to six digits."""
    return tuple(float(f"{beta * d / T:.6g}") for d in delta)


def limiter(
    G: Lti,
    theta: Sequence[int],
    delta: Sequence[float],
    rho: Sequence[float],
    c: Lags | None = None,
    lags: int = 1,
    T_max: float | None = None,
) -> LimiterProof:
    """The least common factor on `delta` [N s/m] with which the limiter's block is positive real, at the best c.

    G is the force map without Theta, rho (m,) [N/m] the limiter's lag. With `c` given its figure is that of the
    refined sweep at this multiplier; otherwise the best with so many lags per channel is searched.
    """
    available, m = dampings(delta, G.inputs), G.inputs
    if len(theta) != m or len(rho) != m or (c is not None and len(c) != m):
        raise ValueError(f"theta, rho and c need one entry for each of {m} channels")
    if not all(0 <= r < np.inf for r in rho) or any(not 0 <= v < np.inf for row in c or () for v in row):
        raise ValueError(f"rho is {list(rho)} and c is {c}, expected numbers >= 0")
    none = tuple((0.0,) * lags for _ in theta) if c is None else tuple(tuple(float(v) for v in row) for row in c)
    # the slip at rest: its rows are among the block's
    linear = this_environment(delay(theta, G.T) @ G, available, T_max)
    if not np.isfinite(linear.ratio):
        reason = linear.reason or "the loop without limiter is not covered"
        return LimiterProof(refusal("limiter", available, reason), tuple(rho), none, np.inf)
    search = _LimiterSearch(G, theta, available, rho, lags, T_max)
    if c is not None:
        ratio, w = search.swept(none)
        return LimiterProof(search.requirement(ratio, w), tuple(rho), none, ratio)
    best, ratio, w, bound = search.least()
    return LimiterProof(search.requirement(ratio, w), tuple(rho), best, bound)


class _LimiterSearch:
    """s(c) by the refined sweep, and its least over c >= 0."""

    def __init__(
        self,
        G: Lti,
        theta: Sequence[int],
        delta: tuple[float, ...],
        rho: Sequence[float],
        lags: int,
        T_max: float | None = None,
    ) -> None:
        self._T_max = T_max
        self._loop, self._delta, self._shape = (G, theta, delta, rho), delta, (len(theta), lags)
        self._grid, self._lag = np.concatenate([[0.0], frequencies(G)]), np.diag([*rho, *rho])

    def requirement(self, ratio: float, w: float) -> Requirement:
        T = self._loop[0].T
        if np.isinf(ratio):
            reason = f"no damping is enough for the limiter at {w / (2 * np.pi * T):.4g} Hz with this multiplier"
            return refusal("limiter", self._delta, reason)
        return from_ratio("limiter", max(ratio, 0.0), self._delta, w / (2 * np.pi * T))

    def demand(self, c: Lags) -> Demand[Lti]:
        G, theta, delta, rho = self._loop
        return limiter_demand(G, theta, delta, rho, c, self._T_max)

    def swept(self, c: Lags, spare: float = 0.0) -> tuple[float, float]:
        """(s(c), w [rad/sample]) by a sweep that is refined between its samples, with so much of rho to spare."""
        demand = self.demand(c)
        demand = replace(demand, free=demand.free - spare * self._lag)
        return supremum(lambda w: least_scale(demand, w), self._grid)

    def least(self) -> tuple[tuple[tuple[float, ...], ...], float, float, float]:
        """(c, s(c), where it binds, a lower bound on s over all c that have something to spare)."""
        m, lags = self._shape
        c, bound = np.zeros(m * lags), -np.inf
        best: tuple[Array, float, float] = (c, np.inf, 0.0)
        parts, cuts = self._parts(self._grid), np.zeros((0, m * lags + 2))
        for _ in range(MOST_ROUNDS):
            found, top = self._cuts(c, *parts)
            if top <= bound + LIMITER_SETTLED * abs(bound):  # settled on the samples: look between them
                ratio, w = self.swept(self._rows(c), SPARE)
                best = min(best, (c, ratio, w), key=lambda found: found[1])
                if best[1] <= bound + 10 * LIMITER_SETTLED * abs(bound):
                    break
                between = self._parts(np.array([w]))
                parts = tuple(np.concatenate(pair, axis=-3) for pair in zip(parts, between, strict=True))
                found = np.concatenate([found, self._cuts(c, *between)[0]])
            cuts = np.concatenate([cuts, found])
            lowest = linprog(
                np.eye(c.size + 1)[-1],
                A_ub=-cuts[:, 1:],
                b_ub=cuts[:, 0],
                bounds=[*[(0.0, LARGEST_WEIGHT)] * c.size, (0.0, None)],
            )
            if lowest.x is None:  # no c within the bounds makes the block positive, however large the damping
                return self._rows(c), np.inf, self.swept(self._rows(c), SPARE)[1], np.inf
            c, bound = np.maximum(lowest.x[:-1], 0.0), float(lowest.x[-1])
        if np.isinf(best[1]):
            best = (c, *self.swept(self._rows(c), SPARE))
        c = np.round(best[0], 6)
        return self._rows(c), *self.swept(self._rows(c)), bound

    def _rows(self, c: Array) -> tuple[tuple[float, ...], ...]:
        """c (m lags,) as a row per channel."""
        return tuple(tuple(row) for row in c.reshape(self._shape).tolist())

    def _parts(self, w: Array) -> tuple[Complex, Complex, Complex]:
        """The Hermitian parts at w (k,) of the block without c, (1, k, p, p), of its slopes in c, and of the gain."""
        z, m = on_circle(w), len(self._delta)
        none = self.demand(np.zeros(self._shape).tolist())
        free, gain = hermitian(none.free.at(z)), hermitian(none.gain.at(z))
        units = np.eye(int(np.prod(self._shape)))
        slopes = [hermitian(self.demand(self._rows(unit)).free.at(z)) - free for unit in units]
        return (free - SPARE * self._lag)[None], np.array(slopes).reshape(-1, w.size, 2 * m, 2 * m), gain[None]

    def _cuts(self, c: Array, free: Complex, slopes: Complex, gain: Complex) -> tuple[Array, float]:
        """(rows, s): the bounds value + slope.c + s gain >= 0 at the worst peaks, and the worst s there."""
        block, gain = free[0] + np.tensordot(c, slopes, axes=1), gain[0]
        needed = least_multiple(block, gain)
        padded = np.concatenate([[-np.inf], needed, [-np.inf]])
        peaks = np.flatnonzero((needed >= padded[:-2]) & (needed >= padded[2:]))
        peaks = peaks[np.argsort(needed[peaks])[-MOST_PEAKS:]]
        # beyond any damping the worst direction is sought at one so large that only the null space of the gain counts
        s = np.where(np.isinf(needed[peaks]), HOPELESS, needed[peaks])
        u = np.linalg.eigh(block[peaks] + s[:, None, None] * gain[peaks])[1][:, :, 0]
        terms = np.concatenate([free, slopes, gain[None]])[:, peaks]
        rows = np.einsum("ka,tkab,kb->kt", u.conj(), terms, u).real
        return rows / np.abs(rows).max(axis=1, keepdims=True), float(needed.max())


def half_widths(lo: Sequence[int], hi: Sequence[int]) -> Array:
    """h = (hi - lo)/2, (m,). Raises ValueError unless 0 <= lo <= hi."""
    if len(lo) != len(hi) or any(not 0 <= a <= b for a, b in zip(lo, hi, strict=False)):
        raise ValueError(f"delays from {list(lo)} to {list(hi)}, expected 0 <= lo <= hi on every channel")
    return (np.asarray(hi) - np.asarray(lo)) / 2


def nominal(lo: Sequence[int], hi: Sequence[int], T: float) -> Lti:
    """Theta_nom = (z^-lo + z^-hi)/2, diagonal."""
    return Lti.diag(*(taps(_halves(p, q), T) for p, q in zip(lo, hi, strict=True)))


def regular_part(E: Lti) -> Lti:
    """R + E(1)/2, where E z/(z-1) = E(1) z/(z-1) + R: stable where E is.

    The Hermitian part of z/(z-1) on the circle is 1/2, so this has the Hermitian part of E z/(z-1) there.
    """
    E1, quotient = E.split_at_one()
    return Lti(E.A, E.B, quotient.C @ E.A, quotient.C @ E.B + E1 / 2, E.T)
