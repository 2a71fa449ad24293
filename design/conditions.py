"""Conditions under which no passive human can make a loop oscillate.

A condition is a block that must be strictly positive real: stable, with the Hermitian part He[block] > 0 on |z| = 1.
`Demand` (design.facts) holds the block as free + s gain, where s multiplies the damping Delta_D that the devices
guarantee. Poles at z = 1 are split off by `over_z_minus_one`. The same expression serves sweeps in floating point,
which give the required damping, and exact proofs over Fractions. Z-width maps and designs evaluate it for many
couplings at once, or for sampled responses. docs/theory.md derives the conditions. Numbers such as (12) are equations
of the paper.

design.facts describes the two parts of a condition, the hands' side and the facts of the environment's side, and has
base classes for new ones. design.environments and design.known_device search for multipliers. design.certificate proves
all conditions in the same way, and design.coupling_file stores the proofs.
"""

from __future__ import annotations

import sys
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from haptic_loop.controller.arguments import shown
from haptic_loop.controller.arithmetic import Number, SingularLoop, inverse, numbers, positive_definite
from haptic_loop.controller.complementarity import magnitudes
from haptic_loop.controller.coupling import Coupling
from haptic_loop.controller.delay import delay, moving_sum
from haptic_loop.controller.loop import Loop
from haptic_loop.controller.lti import Array, Block, Complex, Lti, Sampled, as_like, constant_like, hstack, vstack
from haptic_loop.controller.passivity import hermitian_floor
from haptic_loop.controller.ranges import Member
from haptic_loop.design import budgets
from haptic_loop.design.facts import Demand, compose, even_damping, even_level
from haptic_loop.design.files import InputError
from haptic_loop.design.frequency import (
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
from haptic_loop.design.result import ANY, HERE, RANGES, Environments, Requirement, from_ratio, refusal


def this_environment_demand(F: Block, loop: Loop) -> Demand[Block]:
    """Return the block of He[F/(z-1)] > -s Delta_D/T_max for the map F (6) from displacements to forces.

    With F(z) = F(1) + (z-1) R the block is R - F(1)/2 + s Delta_D/T_max. F may be floats, Fractions or responses. If
    forces latch after the tick, the block has up to twice as many rows (design.facts.Latency).
    """
    return compose(F, loop, late=False)


def theta_hat(theta: Sequence[int], damping: Any, T: Number) -> Lti:
    """Return Theta-hat (12), T/2 Delta^-1 (1 + 1/z + ... + z^-theta_i); `damping` is Delta (m, m) or its diagonal."""
    weight: Any = np.diag(T / (2 * damping)) if np.ndim(damping) == 1 else inverse(2 * damping / T)
    return weight @ moving_sum(theta, T)


def _v_hat(H: Block) -> tuple[Array, Block]:
    """Return H(1) and H(1)/2 - (H - H(1))/(z - 1), whose Hermitian part is that of T V-hat/|1 - 1/z|^2.

    V-hat = (1 - 1/z) H/T with H = V - Theta-hat (11) vanishes at z = 1. Therefore it is divided by |1 - 1/z|^2
    (docs/theory.md). H(1) must be symmetric. The result is linear in H, so that V and Theta-hat may be passed one by
    one.
    """
    H1, regular = H.over_z_minus_one()
    return H1, -regular


def any_environment_demand(V: Block, loop: Loop, phi: Sequence[Any] | Array | None = None) -> Demand[Block]:
    """Return s times the block of Theorem 4 for the damping s Delta_D; psi >= 1 needs the multiplier phi (m,) [N s/m].

    V-hat must be output strictly passive with the level Delta_V. Where phi is 0, Delta_V is 0, and elsewhere
    Delta_V^-1 = Phi^-1 - Delta_D^-1 (14). Let H be V - Theta-hat, and R the second result of `_v_hat`. A Schur
    complement gives He[[T R, 0], [2 H, Delta_V^-1]] >= 0, where the second row of blocks has rows only for phi > 0.
    Theta-hat and Delta_D^-1 are proportional to 1/s. Raises ValueError unless 0 <= phi < Delta_D T/T_max.
    """
    T, damping = V.T, even_damping(loop, V.T)
    shortage = numbers([0] * loop.channels if phi is None or not len(phi) else phi, T)
    level = even_level(loop, T) if loop.levels else damping
    below = len(shortage) == len(damping) and ((shortage >= 0) & (shortage < damping)).all()
    if not below or (loop.levels and not positive_definite(level - np.diag(shortage))):
        raise ValueError("the multiplier Phi must be at least 0 and below the device damping on every channel")
    short = np.flatnonzero(shortage)

    def excess(H: Any, corner: Any) -> tuple[Array, Any]:
        """Return H(1), and the block with this lower right corner. Both are linear in H and the corner."""
        H1, regular = _v_hat(H)
        if not short.size:
            return H1, regular
        corner = np.vstack([np.zeros((loop.channels, short.size), dtype=int), corner])
        return H1, hstack(vstack(T * regular, (2 * H).rows(short)), constant_like(H, corner))

    V1, gain = excess(V, np.diag(1 / shortage[short]))
    inverted = inverse(level)[np.ix_(short, short)] if loop.levels else np.diag(1 / damping[short])
    _, demand = excess(as_like(V, theta_hat(loop.theta, level, T)), inverted)
    return Demand(-demand, gain, {"V(1)": V1})


def delayed_environment_demand(delayed: Lti, phi: Sequence[Any] | Array) -> Demand[Lti]:
    """Return the block E-hat + Phi without its pole; the block must be positive real. `delayed` is Psi E.

    E-hat = T z/(z-1) Psi E = T E(1) z/(z-1) + T z R(z). The Hermitian part of z/(z-1) on the circle is 1/2, so the
    block is T (z R + E(1)/2) + Phi. With a delay the environment is not passive; Phi (14) covers the shortage.
    """
    T, E1 = delayed.T, delayed.dc()
    return Demand(T * _regular_part(delayed), Lti.constant(np.diag(numbers(phi, T)), T), {"E(1)": E1}, ("E(1)",))


def uncovered(environment: Lti, psi: Sequence[int], phi: Sequence[float] | Array) -> tuple[float, float]:
    """Return the largest shortage of passivity [N s/m] of E-hat + Phi by a sweep, and its frequency [rad/sample]."""
    demand = delayed_environment_demand(delay(psi, environment.T) @ environment, phi)
    block = demand.free + demand.gain

    def short(w: Array) -> Array:
        return largest_eigenvalue(-hermitian(block.at(on_circle(w))))

    return supremum(short, np.concatenate([[0.0], frequencies(block)]))


def covers(loop: Loop, phi: Sequence[float] | Array) -> bool:
    """Return whether E-hat + Phi for phi (m,) [N s/m] is passive, up to _ROUNDING times the largest damping."""
    demand = delayed_environment_demand(delay(loop.psi, loop.T) @ loop.E(), phi)
    slack = _ROUNDING * float(max(even_damping(loop)))
    return hermitian_floor(demand.free + demand.gain, -slack / 2, -slack)[0] >= -slack


#: A 2 x 2 gain counts as singular if its determinant is below _SINGULAR times the product of its diagonal entries. A
#: diagonal entry below _NOTHING times the largest one counts as a rounding error.
_SINGULAR, _NOTHING = 1e-12, 1e-15
_CELLS = 2**19  # entries of a response that are processed together, because they fit into the processor's cache


def least_scale(demand: Demand[Any], w: Array) -> Array:
    """Return the least s (k,) with He[free + s gain] >= 0 at each frequency w (k,) [rad/sample], or inf."""
    step = max(_CELLS // demand.gain.outputs**2, 64)
    if w.size > step:
        return np.concatenate([least_scale(demand, w[i : i + step]) for i in range(0, w.size, step)])
    z = on_circle(w)
    free, gain = hermitian(demand.free.at(z)), hermitian(demand.gain.at(z if demand.gain.order else z[:1]))
    return _least_multiple(free, gain)


def _least_multiple(free: Complex, gain: Complex) -> Array:
    """Return the least s (...,) with free + s gain >= 0 for Hermitian (..., p, p) with gain >= 0, or inf.

    If gain is singular, free must be positive on the null space of gain. A Schur complement covers other directions.
    """
    own = np.diagonal(gain, axis1=-2, axis2=-1).real
    if gain.shape[-1] == 2 and (own > 0).all():
        room = own[..., 0] * own[..., 1] - np.abs(gain[..., 0, 1]) ** 2
        if gain[..., 0, 1].any() and (np.abs(room) > _SINGULAR * own[..., 0] * own[..., 1]).all():
            return _of_pairs(free, gain, room)
    known = own > _NOTHING * own.max(axis=-1, keepdims=True)
    weight = 1 / np.sqrt(np.where(known, own, 1.0))
    free, gain = (weight[..., :, None] * part * weight[..., None, :] for part in (free, gain))
    diagonal = not (gain * (1 - np.eye(gain.shape[-1]))).any()
    if known.all() and diagonal:
        return largest_eigenvalue(-free)
    if gain.ndim > 2 and (gain == gain[..., :1, :, :]).all():
        gain = gain[..., :1, :, :]  # One decomposition serves all frequencies.
    eigenvalues, basis = np.linalg.eigh(gain)
    floor = np.maximum(1e-13 * np.abs(eigenvalues).max(axis=-1, keepdims=True), np.finfo(float).tiny)
    if diagonal and eigenvalues.size == gain.shape[-1]:
        order = np.argsort(np.diagonal(gain, axis1=-2, axis2=-1).real.ravel())
        H = free[..., order[:, None], order]
    else:
        scale = np.where(eigenvalues > floor, 1 / np.sqrt(np.maximum(eigenvalues, floor)), 1.0)
        whitened = np.conj(np.swapaxes(basis, -1, -2)) * scale[..., :, None]
        H = whitened @ (free @ np.conj(np.swapaxes(whitened, -1, -2)))
    flat, shape = H.reshape(-1, *H.shape[-2:]), H.shape[:-2]
    missing = np.broadcast_to((eigenvalues <= floor).sum(axis=-1), shape).ravel()
    needed = np.empty(missing.size)
    for r in set(missing.tolist()):  # Eigenvalues ascend, so the first r directions span the null space of the gain.
        here = flat[missing == r]
        needed[missing == r] = _beyond_the_null_space(here, r) if r else largest_eigenvalue(-here)
    needed[np.broadcast_to((eigenvalues < -floor).any(axis=-1), shape).ravel()] = np.inf
    return needed.reshape(shape)


def _of_pairs(free: Complex, gain: Complex, room: Array) -> Array:
    """Return `_least_multiple` of 2 x 2 matrices with det(gain) = room, 20 times as fast as with LAPACK."""
    (a, b, d), (p, q, r) = ((M[..., 0, 0].real, M[..., 0, 1], M[..., 1, 1].real) for M in (free, gain))
    twice, last = a * r + d * p - 2 * (b.real * q.real + b.imag * q.imag), a * d - b.real**2 - b.imag**2
    root = np.sqrt(np.maximum(twice**2 - 4 * room * last, 0.0))
    with np.errstate(divide="ignore", invalid="ignore"):
        least = np.where(twice < 0, (root - twice) / (2 * room), -2 * last / (twice + root))
    return np.where(room > 0, np.nan_to_num(least, nan=0.0), np.inf)


def _beyond_the_null_space(H: Complex, r: int) -> Array:
    """Return the least s (n,) with H + s diag(0, I) >= 0, where 0 has r rows; inf unless H is > 0 on these rows."""
    null, cross, rest = H[:, :r, :r], H[:, :r, r:], H[:, r:, r:]
    size = np.abs(np.diagonal(H, axis1=1, axis2=2)).max(axis=1, initial=0.0)
    positive = largest_eigenvalue(-null) < -1e-13 * size
    needed = np.full(len(H), np.inf)
    left = rest - np.conj(np.swapaxes(cross, 1, 2)) @ np.linalg.solve(
        np.where(positive[:, None, None], null, np.eye(r)), cross
    )
    needed[positive] = largest_eigenvalue(-left)[positive] if r < H.shape[-1] else 0.0
    return needed


#: Properties of a loop that a condition covers only if it names them in `covers`.
BEYOND = ("psi", "T_max", "latency", "varying_delay", "walls", "ranges")
#: Properties of a loop that a certificate may list as its facts, in the order of reports and files.
FACTS = ("latency", "walls", "limiter", "switching", "ranges")


class Condition(ABC):
    """A block that must be strictly positive real. A user's own condition needs a name and `demand`.

    `design.certificate` proves and verifies the block of every condition in the same way. That the block keeps a loop
    safe is the claim of its author. A loop with an item of `BEYOND` is refused unless `covers` names the item.
    """

    name: str  # name in requirements, certificates and reports
    covers: tuple[str, ...] = ()  # items of `BEYOND` that the block covers; a subclass does not inherit them
    source: str | None = None  # reference for a report

    def __init_subclass__(cls, **options: Any) -> None:
        """Raise InputError for names in `covers` that are not in BEYOND."""
        super().__init_subclass__(**options)
        named = vars(cls).get("covers", ())
        if not isinstance(named, tuple) or any(name not in BEYOND for name in named):
            allowed = ", ".join(map(repr, BEYOND))
            raise InputError(f"covers of the condition {cls.__name__} is {named!r}, expected a tuple of {allowed}")

    def separable(self, loop: Loop) -> bool:
        """Return whether each channel is judged alone if the coupling does not connect the channels."""
        return False

    @property
    def extensible(self) -> bool:
        """Whether `LimitedForces` and the fast sweeps of `in_each` (design.environments) apply to this condition."""
        return False

    @abstractmethod
    def demand(self, loop: Loop, coupling: Coupling, exact: bool = False, multiplier: Any = None) -> Demand[Lti]:
        """Return the block of this coupling in this loop, over Fractions if `exact`. Raises SingularLoop.

        `multiplier` is passed only to a condition that has `multiplier_sizes`.
        """

    def required(self, loop: Loop, coupling: Coupling, multiplier: Any = None) -> Requirement:
        """Return the damping that the devices need, by a refined sweep. Raises SingularLoop."""
        demands = [self.is_demand(self.demand(each, coupling)) for each in self._loops(loop)]
        shares = [_least_damping(self.name, demand.free, lambda d=demand: d, loop.delta) for demand in demands]
        return max(shares, key=lambda requirement: requirement.ratio)

    def judge(self, loop: Loop, coupling: Coupling, multiplier: Any = None) -> Requirement:
        """Return the requirement with its guarantee. It is infinite for a loop that is singular or not covered."""
        reason = self.beyond(loop)
        try:
            requirement = (
                refusal(self.name, loop.delta, reason, applies=False)
                if reason
                else self.required(loop, coupling, multiplier)
            )
        except SingularLoop as error:
            requirement = refusal(self.name, loop.delta, str(error))
        return replace(requirement, guarantee=self.words(loop), limiter_rho=self.limiter_rho(loop))

    def ratio(self, loop: Loop, coupling: Coupling) -> float:
        """Return required over available damping."""
        return self.judge(loop, coupling).ratio

    def over_frequency(self, loop: Loop, coupling: Coupling, multiplier: Any = None) -> Response | None:
        """Return the function w (k,) [rad/sample] -> required over available damping (k,), or None if there is none."""
        more = {} if multiplier is None else {"multiplier": multiplier}
        return partial(least_scale, self.demand(loop, coupling, **more))

    def ratios(self, loop: Loop, coupling: Coupling, multiplier: Any = None) -> Array | None:
        """Return required over available damping (n,) for a stack of n couplings, or None if stacks are not covered."""
        return None

    def exact_demands(self, loop: Loop, coupling: Coupling, multiplier: Any = None) -> dict[str, Demand[Lti]]:
        """Return the blocks to prove over the rationals, by the names of their matrices. Raises SingularLoop."""
        more = {} if multiplier is None else {"multiplier": multiplier}
        loops = enumerate(self._loops(loop))
        return {f"P{i or ''}": self.is_demand(self.demand(each, coupling, exact=True, **more)) for i, each in loops}

    def is_demand(self, demand: Demand[Block]) -> Demand[Block]:
        """Return `demand`, which a user's own code made. Raises InputError unless it is a Demand."""
        if not isinstance(demand, Demand):
            raise InputError(f"the demand of condition {self.name} is {shown(demand)}, expected a Demand")
        return demand

    def _loops(self, loop: Loop) -> list[Loop]:
        return [loop.at(member.network) for member in self.members(loop)] or [loop]

    def beyond(self, loop: Loop) -> str | None:
        """Return the reason why this loop is not covered, whatever the coupling, or None."""
        changes = loop.T_max not in (None, loop.T)
        walls = loop.environment.walls
        present = (any(loop.psi), changes, loop.latency, loop.varying_delay, walls, loop.ranges)
        covered = vars(type(self)).get("covers", ())
        missing = [name for name, is_there in zip(BEYOND, present, strict=True) if is_there and name not in covered]
        if missing:
            return f"the loop has {', '.join(missing)}, which the condition {self.name} does not name in covers"
        return loop.environment.active(loop.T) if self.guarantee(loop) == ANY else None

    @property
    def base(self) -> str:
        """The name of the condition in a certificate, which lists the facts separately."""
        return self.name

    def fact_names(self, loop: Loop) -> tuple[str, ...]:
        """Return the names of `FACTS` that a certificate of this loop lists."""
        walls, limited = loop.environment.walls, self.parameters(loop)
        ranges = loop.ranges and self.guarantee(loop) != HERE
        present = loop.latency, walls, limited, loop.varying_delay, ranges
        return tuple(name for name, is_there in zip(FACTS, present, strict=True) if is_there)

    def parameters(self, loop: Loop) -> dict[str, tuple[float, ...]]:
        """Return the numbers, such as rho, that a run must use. A certificate stores them with the multipliers."""
        return {}

    def limiter_rho(self, loop: Loop) -> tuple[float, ...] | None:
        """Return rho (m,) [N/m] of the limiter that the condition covers without another proof, or None."""
        return None

    def multiplier_sizes(self, loop: Loop) -> dict[str, int]:
        """Return {name in files: length} of the multipliers; {} for a condition without multipliers."""
        return {}

    def by_name(self, loop: Loop, multiplier: Sequence[Any]) -> dict[str, tuple[float, ...]]:
        """Return {name: values} of the multipliers, which `multiplier` holds one after the other."""
        named_values, start = dict[str, tuple[float, ...]](), 0
        for name, count in self.multiplier_sizes(loop).items():
            named_values[name] = tuple(float(v) for v in multiplier[start : start + count])
            start += count
        return named_values

    def least_multiplier(self, loop: Loop) -> tuple[Array | None, str | None]:
        """Return (the multiplier that serves every coupling or None, why the loop is not covered or None)."""
        return None, self.beyond(loop)

    def not_varied(self, loop: Loop) -> str | None:
        """Return the reason why sweeps over varied loops skip this condition, or None."""
        return None

    def members(self, loop: Loop) -> tuple[Member, ...]:
        """Return the environments that are proved one by one. Their proofs are the matrices P, P1, P2, .."""
        return loop.members()

    def guarantee(self, loop: Loop) -> Environments:
        """Return the environments for which the condition holds."""
        # Ranges are proved at every vertex; check_ranges and design.check search between the vertices.
        return RANGES if loop.ranges else HERE

    def place(self, loop: Loop, matrix: str = "P") -> str:
        """Return the beginning of a message on a proof matrix: the name of its environment in ranges, or ""."""
        members = self.members(loop)
        return f"{members[int(matrix[1:] or 0)].name}: " if len(members) > 1 else ""

    @property
    def origin(self) -> str:
        """The name and the file of a user's own condition, such as "joined-devices of joined.py"."""
        file = getattr(sys.modules.get(type(self).__module__), "__file__", None)
        return f"{self.name} of {Path(file).name}" if file else self.name

    @property
    def claim(self) -> str:
        """The sentence that reports print if a user's own condition holds."""
        return f"only the block of {self.name} is proved; you must show that it keeps this loop safe"

    def remark(self, needs: Requirement) -> str:
        return self.claim if needs.certified else f"fails the condition {self.name}: {needs.shortfall}"

    def words(self, loop: Loop) -> str:
        """Return the environments for which the condition holds, in the words of a report."""
        held = self.guarantee(loop)
        return loop.environment.here if held == HERE else held


def _least_damping(
    name: str, system: Lti, demand: Callable[[], Demand[Lti]], available: tuple[float, ...]
) -> Requirement:
    """Return the damping that a demand requires. `system` has its block's poles, and `available` is in N s/m."""
    if reason := unsound(system, available):
        return refusal(name, available, reason)
    try:
        needed = demand()
    except SingularLoop as error:  # The map has a pole at z = 1 that rounding has moved into the circle.
        return refusal(name, available, f"the force map is singular in floating point: {error}")
    if reason := unsound_static(system, needed, available):
        return refusal(name, available, reason)
    ratio, w = supremum(lambda w: least_scale(needed, w), np.concatenate([[0.0], frequencies(system)]))
    return from_ratio(name, max(ratio, 0.0), available, w / (2 * np.pi * system.T))


def unsound(system: Lti, delta: Sequence[float]) -> str | None:
    """Return the reason why no sweep of a block with the poles of this system can certify a loop, or None."""
    if min(delta) == 0:
        return "a device guarantees no damping, so no coupling is safe for every passive human"
    if reason := budgets.too_long(system):
        return reason
    radius = float(np.abs(system.poles()).max(initial=0.0))
    return f"the map F or V has a pole at radius {radius:.6f}, on or outside the unit circle" if radius >= 1 else None


def unsound_static(system: Lti, demand: Demand[Lti], delta: Sequence[float]) -> str | None:
    """Return the reason why a static matrix of the demand is asymmetric or negative beyond rounding, or None."""
    end = system.at(-1.0)
    for matrix, value in demand.static.items():
        skew, least = _static_errors(value, system.D, end)
        slack = _STATIC
        if max(skew, -least) > slack:  # The static matrix may consist of rounding errors only.
            size = max(float(np.abs(part).max()) for part in (value, system.D, end))
            allowed = min(rounding(system, on_circle(frequencies(system))), _STATIC * min(delta) / system.T)
            slack = max(slack, allowed / max(size, 1e-12))
        if skew > slack:
            return f"the static stiffness {matrix} is not symmetric: a slow closed path could extract energy"
        if least < -slack and matrix in demand.semidefinite:
            return f"the static stiffness {matrix} has a negative direction: it pushes outwards"
    return None


def this_environment(F: Lti, loop: Loop) -> Requirement:
    """Return the damping that this-environment requires for the force map F. The loop's environment is not used."""
    return _least_damping("this-environment", F, lambda: this_environment_demand(F, loop), loop.delta)


def ratio_in(loop: Loop, coupling: Coupling) -> float:
    """Return required over available damping of this-environment for a stable coupling; inf for a singular loop.

    The responses of a force filter and of the environment are multiplied at each frequency. As a state-space system,
    their series would have defective poles, which rounding moves far.
    """
    if (chain := coupling.in_series(loop.T)) is None:
        try:
            return this_environment(loop.F(coupling), loop).ratio
        except SingularLoop:
            return np.inf
    E = loop.E()
    delayed = delay(loop.psi, loop.T) @ E

    def needed(w: Array) -> Array:
        F = loop.late(coupling.around(Sampled.of(delayed, on_circle(w)[None])))
        demand = this_environment_demand(F, loop)
        return _least_multiple(hermitian(demand.free.G[0]), hermitian(demand.gain.G[0]))

    return supremum(needed, frequencies(E, chain, low=_LOWEST))[0]


_LOWEST = 1e-6  # [rad/sample] Responses are constant below this frequency.
_W_ZERO = 1e-10  # [rad/sample] replaces w = 0 for stacks, because the response of a network there may be 0/0
_STATIC = 1e-9  # allowed relative asymmetry and negativity of F(1)


def _static_errors(F1: Array, *elsewhere: Array | Complex) -> tuple[Array, Array]:
    """Return the asymmetry of F(1) and its least eigenvalue, (...,) each, relative to the largest of all entries.

    The matrices `elsewhere` count for the scale, because F(1) of a free mass is 0 only up to the rounding of large
    terms.
    """
    scale = np.max([np.abs(part).max(axis=(-2, -1)) for part in (F1, *elsewhere)], axis=0, initial=1e-12)
    turned = np.swapaxes(F1, -1, -2)
    least = np.linalg.eigvalsh((F1 + turned) / 2).min(axis=-1)
    return np.abs(F1 - turned).max(axis=(-2, -1)) / scale, least / scale


def any_environment(V: Lti, loop: Loop, phi: Array | None = None) -> Requirement:
    """Return the damping that any-environment requires for the coupling V with any passive environment.

    With phi (m,) [N s/m] (see `any_environment_demand`) the environment is that of the loop, with its delay psi.
    """
    available = loop.delta

    def refused(reason: str) -> Requirement:
        return refusal("any-environment", available, reason)

    if min(available) == 0:
        return refused("a device guarantees no damping, so no coupling is safe for every passive human")
    if reason := budgets.too_long(V) or (phi is not None and budgets.too_long(loop.E())):
        return refused(reason)
    if not V.is_stable():
        return refused("the coupling V has a pole on or outside the unit circle")
    demand = any_environment_demand(V, loop, phi)
    if reason := asymmetric(demand.static["V(1)"]):
        return refused(reason)
    if phi is not None and not covers(loop, phi):
        return refused("E-hat + Phi is not passive for this multiplier, or its passivity cannot be decided")
    least = partial(least_scale, demand) if phi is not None else partial(_scale_beside_zeros, V, demand)
    ratio, w = supremum(least, np.concatenate([[0.0], frequencies(V)]))
    if ratio > _NEVER:
        return refused(f"V is not passive enough at {w / (2 * np.pi * V.T):.4g} Hz: its damping vanishes there")
    return from_ratio("any-environment", ratio, available, w / (2 * np.pi * V.T))


_ROUNDING = 1e-9  # allowed shortage of E-hat + Phi, relative to the damping; rounding of a lossless E causes 2e-13
_VANISHES = 1e-5  # size of V, relative to V(1), up to which V counts as vanishing in a direction
_SOFTENED = 1e-12  # passivity, relative to V(1), that is added in directions in which V vanishes
_NEVER = 1e6  # A larger required over available damping means that V is not passive at its frequency.


def asymmetric(V1: Array) -> str | None:
    """Return the reason why a static compliance is refused, or None if it is symmetric to rounding."""
    skew, size = np.abs(V1 - V1.T).max(), max(float(np.abs(V1).max()), 1e-300)
    return "the static compliance V(1) is not symmetric" if skew > 1e-9 * size else None


def _scale_beside_zeros(V: Lti, demand: Demand[Any], w: Array) -> Array:
    """Return the least s (k,) of the demand at w (k,) [rad/sample].

    If V and Theta-hat vanish in one direction, so does V-hat, and the demand He V-hat >= Delta_V |V-hat|^2 is 0 >= 0.
    In such directions _SOFTENED V(1) is added to the gain.
    """
    z = on_circle(w)
    free, gain = hermitian(demand.free.at(z)), hermitian(demand.gain.at(z))
    response = V.at(z)
    _, sizes, right = np.linalg.svd(response) if V.inputs > 1 else (1, np.abs(response[..., 0]), np.ones((1, 1)))
    static = float(np.abs(demand.static["V(1)"]).max())
    idle = (sizes <= _VANISHES * static) * (_SOFTENED * static)
    return _least_multiple(free, gain + np.conj(np.swapaxes(right, -1, -2)) @ (idle[..., None] * right))


def any_environment_per_channel(V: Sequence[Lti], loop: Loop) -> Requirement:
    """Return the requirement of any-environment for a diagonal coupling, channel by channel."""
    each = [any_environment(v, loop.channel(i)) for i, v in enumerate(V)]
    worst = max(each, key=lambda r: r.ratio)
    required = tuple(r.required[0] for r in each)
    available = tuple(r.available[0] for r in each)
    return Requirement("any-environment", required, available, worst.frequency_hz, worst.reason)


_SMALL_TAIL = 1e-9  # bound of the remaining sum, relative to the sum, at which the summation ends
_CHUNK = 256  # ticks summed at once


def _l1_gain(F: Lti) -> Array:
    """Return an upper bound of the sum over all ticks of |impulse response|, (p, m); inf for an unstable F.

    Ticks are summed until a bound of the remaining sum is small. The bound is |c A^k b| <= r^k sqrt(c P^-1 c' b'P b),
    summed over k, for a P > 0 with A'PA <= r^2 P and r < 1.
    """
    import scipy

    A, X = F.A, F.B
    radius = float(np.abs(F.poles()).max(initial=0.0))
    if radius >= 1:
        return np.full(F.D.shape, np.inf)
    total = np.abs(F.D)
    if not F.order:
        return total
    r = (1 + radius) / 2
    P = scipy.linalg.solve_discrete_lyapunov(A.T / r, np.eye(F.order))
    P = (P + P.T) / 2
    reach = np.sqrt(np.einsum("in,ni->i", F.C, np.linalg.solve(P, F.C.T)))
    powers = [F.C]
    for _ in range(_CHUNK - 1):
        powers.append(powers[-1] @ A)
    rows, ahead = np.stack(powers), np.linalg.matrix_power(A, _CHUNK)
    tail = np.full_like(total, np.inf)
    for _ in range(budgets.GAIN_CHUNKS):
        total = total + np.abs(rows @ X).sum(axis=0)
        X = ahead @ X
        tail = np.outer(reach, np.sqrt(np.maximum(np.einsum("nj,nk,kj->j", X, P, X), 0.0))) / (1 - r)
        if (tail <= _SMALL_TAIL * total.max()).all():
            break
    return total + tail


def encoder_friction(F: Lti, steps: Sequence[float], axes: Sequence[int] = ()) -> Array:
    """Return the Coulomb friction W (p,) [N] that dissipates the work of encoder steps (m,) [m] (docs/theory.md).

    Errors of at most q_j/2 change force i by at most W_i = sum_j |F_ij|_1 q_j/2, with the `_l1_gain` |F_ij|_1. The
    friction acts at the encoder's own coordinate, in addition to the damping delta. W is not proved to suffice behind a
    limiter or walls, nor for design.known_device, where the error also multiplies beta (v+ - v). `axes` lists the
    number of axes of each device; () means one axis each. The friction of a device with several axes opposes its
    velocity in space and must be at least |W|_2 of these axes. Raises ValueError for a wrong number of steps or a
    negative step.
    """
    q = np.asarray(steps, dtype=float)
    if q.shape != (F.inputs,) or not (q >= 0).all():
        raise ValueError(f"steps is {q.tolist()}, expected {F.inputs} encoder steps >= 0 in m")
    W = _l1_gain(F) @ (q / 2)
    return magnitudes(W[:, None], axes)[:, 0] if axes else W


# Stacks of couplings or environments, for the maps over K and B (sim.zwidth).


def stacked_scales(demand: Callable[[Complex], Demand[Sampled]], poles: Complex, longest: int) -> Array:
    """Return the least s (n,) of n demands with these poles (n, p), whose loop has the `longest` delay [samples].

    `demand` returns the responses at z (n, k), or at z (1, k) for all of them, with one row for each demand.
    """

    def needed(w: Array) -> Array:
        sampled = demand(on_circle(w))
        return _least_multiple(hermitian(sampled.free.G), hermitian(sampled.gain.G))

    return suprema(needed, *frequencies_of_many(poles, longest))


def this_environment_ratios(at: Callable[[Complex], Sampled], poles: Complex, loop: Loop) -> Array:
    """Return required over available damping (n,), or inf, of n force maps with these responses and poles (n, p)."""
    here, opposite = (np.full((len(poles), 1), w) for w in (_W_ZERO, np.pi))
    skew, least = _static_errors(at(on_circle(here)).G[:, 0].real, at(on_circle(opposite)).G[:, 0])
    sound = (np.abs(poles).max(axis=1, initial=0.0) < 1) & (skew <= _STATIC) & (least >= -_STATIC)
    longest = max(n + p for n, p in zip(loop.theta, loop.psi, strict=True))
    scales = stacked_scales(lambda z: this_environment_demand(at(z), loop), poles, longest)
    return np.where(sound, np.maximum(scales, 0.0), np.inf)


def _regular_part(E: Lti) -> Lti:
    """Return E z/(z-1) without its pole at z = 1. Elsewhere on the circle the Hermitian part is the same."""
    _, regular = E.over_z_minus_one()
    return Lti(E.A, E.B, E.C + regular.C, E.D + regular.D, E.T)
