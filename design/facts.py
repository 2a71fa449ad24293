"""The block of a condition, composed of one hands' side and the facts of the environment's side.

Every proof in docs/theory.md has two sides, which share only the displacements and the forces as the devices receive
them. The **hands' side** is a lower bound of the energy that every passive hand and the devices dissipate, whatever
forces act. Its inputs are the displacements of a period: dx, or xa before and xb after a force latches. For a known
motor (Theorem B) the motor's speed v is an input, too. A **fact** of the environment's side describes the forces. It
adds inputs with one row of the block each, and multipliers. The quadratic form is

    sum over ticks of f'(displacement that f multiplies) + energy of the damping + terms of the multipliers,

and its block must be strictly positive real, with its pole at z = 1 split off. `Collected` collects the entries of both
sides and builds the block for floats, Fractions or responses.
"""

from __future__ import annotations

import itertools
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any, Generic, NamedTuple

import numpy as np

from haptic_loop.controller.arguments import shown
from haptic_loop.controller.arithmetic import Number, numbers, rational, times
from haptic_loop.controller.loop import Loop
from haptic_loop.controller.lti import Array, Block, Lti, Sampled, as_like, constant_like, vstack


@dataclass(frozen=True, eq=False)
class Demand(Generic[Block]):
    """The demand that free + s gain is strictly positive real; s is 1 for the available damping.

    The matrices in `static` must be symmetric; those named in `semidefinite` must also be positive semidefinite.
    """

    free: Block
    gain: Block
    static: Mapping[str, Array] = field(default_factory=dict)
    semidefinite: tuple[str, ...] = ()
    spare: Array | None = None  # (n,) margin that a search for multipliers subtracts from the diagonal of `free`

    def __post_init__(self) -> None:
        for name, part in (("free", self.free), ("gain", self.gain)):
            if not isinstance(part, Lti | Sampled):
                raise ValueError(f"{name} of a demand is {shown(part)}, expected an Lti")
        if isinstance(self.free, Lti) and isinstance(self.gain, Lti):
            (rows, columns), other = (self.free.outputs, self.free.inputs), (self.gain.outputs, self.gain.inputs)
            if not rows == columns == other[0] == other[1]:
                sizes = f"free is {rows} x {columns}, gain is {other[0]} x {other[1]}"
                raise ValueError(f"{sizes} in a demand, expected square blocks of one size")


def even_damping(loop: Loop, T: Number | None = None) -> Any:
    """Return delta T/T_max (m,) [N s/m]: proofs for a constant T with this damping hold for periods up to T_max.

    The integral of delta v^2 over a period T_k is at least delta dx^2/T_k, so the longest period counts.
    """
    T = loop.T if T is None else T
    damping = numbers(loop.delta, T)
    return damping if loop.T_max is None else damping * (T / numbers(loop.T_max, T))


def even_level(loop: Loop, T: Number | None = None) -> Any:
    """Return Delta_D T/T_max [N s/m] as a matrix (m, m)."""
    T = loop.T if T is None else T
    level = loop.Delta(exact=isinstance(T, Fraction))
    return level if loop.T_max is None else level * (T / numbers(loop.T_max, T))


_Weights = Sequence[Any]  # coefficients of w_0 + w_1/z + .. (in a row) or of w_0 + w_1 z + .. (in a displacement)


def _product(p: _Weights, q: _Weights) -> list[Any]:
    out: list[Any] = [0] * (len(p) + len(q) - 1)
    for i, a in enumerate(p):
        for j, b in enumerate(q):
            out[i + j] = out[i + j] + a * b
    return out


def _less_advance(p: _Weights, follows: Any) -> list[Any]:
    """Return the weights of (p(1/z) - follows z)/(z - 1), which has no pole at z = 1 because p(1) = follows.

    For p = z^-theta and follows = 1 the result is -(1 + 1/z + .. + z^-theta).
    """
    out, left = [], follows
    for weight in p:
        out.append(-left)
        left = left - weight
    return out


@dataclass(frozen=True)
class Input:
    """One scalar input of the hands' side: a displacement or a speed of one axis of a device at every tick."""

    name: str
    channel: int
    moved: _Weights = (1,)  # f[k] multiplies the sum of (w_0 + w_1 z + ..) times the input over a channel's inputs
    follows: int = 1  # 1 for a displacement, to which the environment responds; 0 for a speed
    slips: bool = True  # whether the limiter's slip, if there is one, is subtracted from the input


class Collected(Generic[Block]):
    """The entries of the hands' side and the facts: inputs, weights of forces, rows, and constant terms."""

    def __init__(
        self, T: Number, path: Sequence[_Weights], walls: int, hands: Sequence[Input], any_object: bool = False
    ) -> None:
        """Add the hands' inputs and their rows; `path` has the weights of each channel's nominal delay.

        With `any_object` the energy that a passive object receives is subtracted. Then f_e[k] multiplies the
        displacement minus x[k] - x[k-1] (docs/theory.md, "Facts that hold together").
        """
        self.T, self.channels, self.walls = T, len(path), walls
        self.path, self.hands = path, hands
        self.places: dict[tuple[str, int], int] = {}  # (name, channel or wall) -> number of the input
        self._into: list[tuple[int, int, _Weights]] = []  # (output of `_filter`, input, weights)
        self._force: list[tuple[int, int, _Weights]] = []  # (channel, input, weights) of steps added to f_e
        self._sums: list[tuple[int, int, _Weights]] = []  # (row, channel, weights of f_e)
        self._steps: list[tuple[int, int, _Weights]] = []  # (row, channel, weights of the steps of f_e)
        self._walls: list[tuple[int, int, Any, bool]] = []  # (row, wall, weight, True for y and False for its steps)
        self._terms: list[tuple[int, int, Any]] = []  # (row, input, weight)
        self._before: list[tuple[int, int, Any]] = []  # (row, input one tick before, weight)
        self._gain: list[tuple[int, int, Any]] = []  # (row, input, weight) of terms that scale with the damping
        self._keep: list[tuple[int, float]] = []  # (row, margin of its diagonal entry)
        for i in hands:
            row, weights = self.input(i.name, i.channel), _product(path[i.channel], i.moved)
            if any_object or not i.follows:  # The weights of a speed add up to 0, so there is no pole.
                self.steps(row, i.channel, _less_advance(weights, i.follows))
            else:
                self.sums(row, i.channel, weights)
                self._into.append((i.channel, row, (1,)))

    def limit(self) -> None:
        """Add the limiter's slip as an input of each channel. It is subtracted from the inputs with `slips`."""
        for i in self.hands:
            if i.slips:
                self.input("de", i.channel)

    def take(self, damping: Any, rest: Sequence[Any] = ()) -> None:
        """Add the quadratic form of the hands' side, where each displacement is the sum of its input and its slip."""
        parts = [self._with_slip(i) for i in self.hands]
        for enter, form in zip((self.damping, self.term, self.before), (damping, *rest), strict=False):
            for g, h in zip(*np.nonzero(form), strict=True):
                for row in parts[g]:
                    for column in parts[h]:
                        enter(row, column, form[g, h])

    def _with_slip(self, i: Input) -> list[int]:
        """Return the numbers of the inputs whose sum is this input of the hands' side."""
        slip = self.places.get(("de", i.channel)) if i.slips else None
        return [self.places[i.name, i.channel], *([] if slip is None else [slip])]

    def input(self, name: str, place: int) -> int:
        """Add an input of a device or a wall and return its number."""
        self.places[name, place] = len(self.places)
        return len(self.places) - 1

    def moving(self, channel: int) -> list[tuple[int, _Weights]]:
        """Return (input, weights w_0 + w_1 z + ..) of the displacement that a channel's force multiplies."""
        parts = [(self.places[i.name, i.channel], i.moved) for i in self.hands if i.channel == channel]
        return parts + ([(self.places["de", channel], (1,))] if ("de", channel) in self.places else [])

    def slipping(self, channel: int) -> list[int]:
        """Return the number of the displacement from which a channel's slip is subtracted, and that of the slip."""
        (own,) = (i for i in self.hands if i.channel == channel and i.slips)
        return self._with_slip(own)

    @property
    def size(self) -> int:
        return len(self.places)

    def press(self, i: int, wall: int, weights: _Weights) -> None:
        """Add the weighted input i to the steps of a wall's force."""
        self._into.append((self.channels + wall, i, weights))

    def force(self, i: int, channel: int, weights: _Weights) -> None:
        """Add the weighted input i to the steps of a channel's sent force f_e."""
        self._force.append((channel, i, weights))

    def sums(self, row: int, channel: int, weights: _Weights) -> None:
        """Add the weighted sent force to a row. The force is the sum of its steps, so the row has a pole at z = 1."""
        self._sums.append((row, channel, weights))

    def steps(self, row: int, channel: int, weights: _Weights) -> None:
        """Add the weighted steps of the sent force to a row."""
        self._steps.append((row, channel, weights))

    def way(self, row: int, wall: int, weight: Any, summed: bool = False) -> None:
        """Add to a row the weighted steps of the displacement y across a wall, or y itself if `summed`."""
        self._walls.append((row, wall, weight, summed))

    def term(self, row: int, column: int, weight: Any) -> None:
        """Add the weighted input `column` to a row."""
        self._terms.append((row, column, weight))

    def before(self, row: int, column: int, weight: Any) -> None:
        """Add the weighted input `column` of the previous tick to a row."""
        self._before.append((row, column, weight))

    def damping(self, row: int, column: int, weight: Any) -> None:
        """Add a term that is proportional to the damping of the devices."""
        self._gain.append((row, column, weight))

    def keep(self, row: int, amount: float) -> None:
        """Reserve a margin on the row's diagonal entry. A search subtracts it, so that multipliers may be rounded."""
        self._keep.append((row, amount))

    @property
    def spare(self) -> Array | None:
        """The reserved margins (n,) of the diagonal, or None."""
        spare = np.zeros(self.size)
        for row, amount in self._keep:
            spare[row] += amount
        return spare if self._keep else None

    def _matrix(self, entries: Sequence[tuple[int, int, Any]]) -> Any:
        out: Any = numbers(np.zeros((self.size, self.size), dtype=int), self.T) + 0
        for i, j, weight in entries:
            out[i, j] = out[i, j] + weight
        return out

    def _bank(self) -> Lti:
        """Return the block from sent forces (m,) to all weighted forces, with one delay line per channel."""
        reads = [*self._sums, *self._steps]
        order, parts = [], []
        for channel in range(self.channels):
            own = [r for r, (_, c, _) in enumerate(reads) if c == channel]
            parts.append(_of_weights([(i, 0, reads[r][2]) for i, r in enumerate(own)], len(own), 1, self.T))
            order += own
        return Lti.diag(*parts).rows(np.argsort(order))

    def _filter(self) -> tuple[Lti, list[int]]:
        """Return the block from inputs to [dx; steps of walls' forces; steps added to f_e; late inputs].

        The second result lists the late inputs, which rows read one tick later (`before`).
        """
        late = sorted({j for _, j, _ in self._before})
        first, second = self.channels + self.walls, 2 * self.channels + self.walls
        entries = [*self._into, *((first + c, i, w) for c, i, w in self._force)]
        entries += [(second + r, i, (0, 1)) for r, i in enumerate(late)]
        return _of_weights(entries, second + len(late), self.size, self.T), late

    def build(self, G: Block | None) -> tuple[Array, Block, Any]:
        """Return (residue at z = 1 (n, n), block without this pole and without the damping, damping matrix).

        G maps displacements x and wall forces p to sent forces f_e and displacements y across walls. If G is None, the
        steps of the forces are inputs (`force`). For a Sampled G the residue is 0, and the block keeps its pole, which
        does not change its Hermitian part on the circle.
        """
        m, w, n, T = self.channels, self.walls, self.size, self.T
        into, late = self._filter()
        bank = self._bank()
        follows = bank.outputs
        # The signals are weighted forces, displacements across walls, and inputs of the previous tick.
        inner = m + w  # outputs of G
        rest = m + len(late)  # outputs of the filter that bypass G
        one = np.eye(inner + len(late), dtype=int)
        mix = numbers(np.hstack([one[:, :inner], one[:, :m], one[:, inner:]]), T)
        lines = Lti.diag(bank, Lti.constant(np.eye(w + len(late), dtype=int), T)) @ mix
        if isinstance(G, Sampled):
            filtered = Sampled(G.z, into.at(G.z), G.T)
            through = vstack(G @ filtered.rows(slice(0, inner)), filtered.rows(slice(inner, None)))
        else:
            silent = Lti.constant(np.zeros((inner, inner), dtype=int), T) if G is None else G
            through = Lti.diag(silent, Lti.constant(np.eye(rest, dtype=int), T)) @ into
        signals = as_like(through, lines) @ through
        static, regular = signals.over_z_minus_one()
        count = signals.G.shape[-2] if isinstance(signals, Sampled) else signals.outputs
        sums: Any = numbers(np.zeros((n, count), dtype=int), T) + 0
        steps: Any = sums + 0
        for r, (row, _, _) in enumerate([*self._sums, *self._steps]):
            target = sums if r < len(self._sums) else steps
            target[row, r] = 1
        for row, wall, weight, summed in self._walls:
            target = sums if summed else steps
            target[row, follows + wall] = target[row, follows + wall] + weight
        for row, column, weight in self._before:
            place = follows + w + late.index(column)
            steps[row, place] = steps[row, place] + weight
        free = np.hstack([sums, steps]) @ vstack(regular, signals) + self._matrix(self._terms)
        return times(sums, static), free, self._matrix(self._gain)


def _of_weights(entries: Sequence[tuple[int, int, _Weights]], outputs: int, inputs: int, T: Number) -> Lti:
    """Return a block of weighted and delayed inputs, with one delay line per input."""
    length = [max((len(w) for _, j, w in entries if j == i), default=1) for i in range(inputs)]
    starts = np.cumsum([0, *(n - 1 for n in length)])
    order = int(starts[-1])
    A, B = np.zeros((order, order), dtype=int), np.zeros((order, inputs), dtype=int)
    C: Any = numbers(np.zeros((outputs, order), dtype=int), T) + 0
    D: Any = numbers(np.zeros((outputs, inputs), dtype=int), T) + 0
    for i, n in enumerate(length):
        if n > 1:
            B[starts[i], i] = 1
            for k in range(n - 2):
                A[starts[i] + k + 1, starts[i] + k] = 1
    for row, i, weights in entries:
        for k, weight in enumerate(weights):
            value = numbers(weight, T)
            if k:
                C[row, starts[i] + k - 1] = C[row, starts[i] + k - 1] + value
            else:
                D[row, i] = D[row, i] + value
    return Lti(A, B, C, D, T)


Values = Mapping[str, Sequence[Any]]  # values of the multipliers, by name


@dataclass(frozen=True)
class Unknowns:
    """The numbers of one multiplier.

    A search keeps each number between `least` and `most` times its unit. For a multiplier of the hands' side, it keeps
    s times the number in this range.
    """

    name: str  # name of the multiplier in files
    units: tuple[float, ...]  # (n,); 0 for a number that is always 0
    expected: str  # the allowed values in words, for messages
    least: float  # in units; if it is positive, 0 or negative, the numbers must be positive, >= 0, or of any sign
    most: float
    start: tuple[float, ...] | None = None  # (n,) first values of a search; the units if None

    def check(self, values: Sequence[Any]) -> None:
        """Raise ValueError unless the values may be a multiplier: 0 where the unit is 0, otherwise as `least` says."""

        def allowed(v: Any) -> bool:
            return abs(v) < np.inf and (self.least < 0 or (v >= 0 if self.least == 0 else v > 0))

        right = len(values) == len(self.units) and all(
            allowed(v) if unit else v == 0 for v, unit in zip(values, self.units, strict=True)
        )
        if not right:
            raise ValueError(f"{self.name} is {[float(v) for v in values]}, expected {self.expected}")


def longest(loop: Loop, T: Number) -> Any:
    """Return the longest period [s] in the arithmetic of T."""
    return T if loop.T_max is None else numbers(loop.T_max, T)


class HandsSide(ABC):
    """A lower bound of the energy that devices and hands dissipate per tick, as a quadratic form of some inputs."""

    @abstractmethod
    def inputs(self, loop: Loop, T: Number) -> list[Input]:
        """Return the inputs of this side, in the order of the rows of `damping` and `rest`."""

    @abstractmethod
    def damping(self, loop: Loop, T: Number, values: Values) -> Any:
        """Return the matrix (n, n) over the inputs that is proportional to the devices' damping [N/m]."""

    def rest(self, loop: Loop, T: Number, values: Values) -> Sequence[Any]:
        """Return the matrices M_0, M_1 of the part M_0 + M_1/z of the form, which does not scale with the damping."""
        return ()

    def unknowns(self, loop: Loop) -> tuple[Unknowns, ...]:
        """Return the multipliers. A search solves for the factor s of the damping and for s times each multiplier."""
        return ()

    def room(self, loop: Loop, values: Values, s: Any) -> list[Array]:
        """Return matrices (k, n, n) that must be positive semidefinite; `values` holds s times the multipliers."""
        return []

    def allowed(self, loop: Loop, values: Values) -> Values:
        """Return the multipliers, scaled so that they are allowed and as large as possible."""
        return values

    def excess(self, loop: Loop, values: Values) -> str | None:
        """Return the reason why the multipliers are not allowed, by exact arithmetic, or None."""
        return None


class _EvenPeriods(HandsSide):
    """The form dx' Delta dx/T_max, for periods that are constant or vary up to T_max."""

    def inputs(self, loop: Loop, T: Number) -> list[Input]:
        return [Input("dx", i) for i in range(loop.channels)]

    def damping(self, loop: Loop, T: Number, values: Values) -> Any:
        return np.diag(even_damping(loop, T) / T)


class Latency(HandsSide):
    """Forces that latch at kT + tau, with any tau in [t1, t2] at every tick and on every device.

    The device moves by xa under f[k-1] and then by xb under f[k]. A channel with t2 = 0 has no xa. The shortest period
    must be longer than t2. If t1 < t2, the multiplier Q (2, 2) [1/s] is the weight of (xa, xb) in the energy of the
    damping. It may be any symmetric Q that is at most diag(1/tau, 1/(T_max - tau)) for all tau in [t1, t2].
    """

    def inputs(self, loop: Loop, T: Number) -> list[Input]:
        late = [i for i, (_, last) in enumerate(loop.latency or ()) if last]
        before = [Input("xa", i, moved=(0, 1), slips=False) for i in late]
        return before + [Input("xb", i) for i in range(loop.channels)]

    def unknowns(self, loop: Loop) -> tuple[Unknowns, ...]:
        if not _varies(loop):
            return ()
        q11, q22 = (tuple(each) for each in zip(*(_separate(loop, d) for d in range(len(loop.devices))), strict=True))
        q12 = tuple(float(np.sqrt(a * b)) for a, b in zip(q11, q22, strict=True))
        expected = "an entry of Q [1/s] of each device, 0 where the latency does not vary"
        return (
            Unknowns("q11", q11, expected, 0.0, 1e6),
            Unknowns("q12", q12, expected, -1e6, 1e6, start=(0.0,) * len(q12)),
            Unknowns("q22", q22, expected, 0.0, 1e6),
        )

    def damping(self, loop: Loop, T: Number, values: Values) -> Any:
        first, last = (numbers([row[i] for row in loop.latency or ()], T) for i in (0, 1))
        late, damping = [i for i, t in enumerate(last) if t], numbers(loop.delta, T)
        form = np.diag(np.concatenate([damping[late] / last[late], damping / (longest(loop, T) - first)]))
        device = loop.per_channel(range(len(loop.devices)))
        for a, i in enumerate(late):
            if first[i] < last[i] and "q11" in values:
                q11, q12, q22 = (numbers(values[name][device[i]], T) for name in _Q)
                b = len(late) + i
                form[a, a], form[a, b], form[b, a], form[b, b] = (damping[i] * q for q in (q11, q12, q12, q22))
        return form

    def room(self, loop: Loop, values: Values, s: Any) -> list[Array]:
        """Return s I - D Q D for each device whose latency varies, with the D Q D of `_weighted`."""
        return [s * np.eye(2) - _weighted(loop, values, d, _LATENCIES) for d in _varies(loop)]

    def allowed(self, loop: Loop, values: Values) -> Values:
        shrunk = {name: list(part) for name, part in values.items()}
        for d in _varies(loop):
            most = np.linalg.eigvalsh(_weighted(loop, values, d, _CLOSER)).max()
            for less in _LESS:  # The reduction covers rounded entries, and latencies between the samples.
                entries = [float(f"{(1 - less) / most * values[name][d]:.{_DIGITS}g}") for name in _Q]
                if _admits(loop, d, entries):
                    break
            else:
                q11, q22 = _separate(loop, d)
                entries = [q11, 0.0, q22]
            for name, entry in zip(_Q, entries, strict=True):
                shrunk[name][d] = entry
        return shrunk

    def excess(self, loop: Loop, values: Values) -> str | None:
        for d in _varies(loop):
            entries = [float(values[name][d]) for name in _Q]
            if not _admits(loop, d, entries):
                first, last = _ranges(loop)[d]
                between = f"the latency of device {d + 1}, {first:g} to {last:g} s"
                return f"q11, q12, q22 are {entries} 1/s, more than {between}, allows"
        return None


_Q = "q11", "q12", "q22"  # names of the entries of Q
_LATENCIES, _CLOSER = 9, 400  # numbers of latencies sampled per range: in a search, and for scaling its result
_DIGITS = 10  # significant digits of an entry of Q
_LESS = 1e-9, 1e-8, 1e-7, 1e-6, 1e-5, 1e-4  # relative reductions of Q that are tried


def _varies(loop: Loop) -> list[int]:
    """Return the devices whose latency varies."""
    return [d for d, (first, last) in enumerate(_ranges(loop)) if first < last]


def _ranges(loop: Loop) -> list[tuple[float, float]]:
    """Return the (least, largest) latency [s] of every device; the axes of a device share it."""
    return [loop.latency[own.start] for own in loop.devices] if loop.latency else []


def _separate(loop: Loop, d: int) -> tuple[float, float]:
    """Return q11 = 1/t2 and q22 = 1/(T_max - t1) [1/s] of a diagonal Q, rounded down; 0, 0 for a constant latency."""
    if d not in _varies(loop):
        return 0.0, 0.0
    (first, last), T = _ranges(loop)[d], rational(loop.T_max or loop.T)
    shares = []
    for longest_part in (rational(last), T - rational(first)):
        q = float(1 / longest_part)
        shares.append(q if rational(q) * longest_part <= 1 else float(np.nextafter(q, 0)))
    return shares[0], shares[1]


def _weighted(loop: Loop, values: Values, d: int, count: int) -> Array:
    """Return D Q D (count, 2, 2) of device d, D = diag(tau, T_max - tau)^(1/2), for evenly spaced tau in its range."""
    tau = np.linspace(*_ranges(loop)[d], count)
    D, (q11, q12, q22) = np.sqrt([tau, (loop.T_max or loop.T) - tau]).T, (values[name][d] for name in _Q)
    return D[:, :, None] * np.array([[q11, q12], [q12, q22]]) * D[:, None, :]


def _admits(loop: Loop, d: int, entries: Sequence[float]) -> bool:
    """Return whether Q <= diag(1/tau, 1/(T_max - tau)) for all tau of device d, in exact arithmetic.

    This means q11 tau <= 1, q22 (T_max - tau) <= 1, and (1 - q11 tau)(1 - q22 (T_max - tau)) >= q12^2 tau (T_max -
    tau). The last difference is quadratic in tau.
    """
    (t1, t2), T = map(rational, _ranges(loop)[d]), rational(loop.T_max or loop.T)
    q11, q12, q22 = map(rational, entries)
    ends = (t1, t2)
    if any(q11 * tau > 1 or q22 * (T - tau) > 1 for tau in ends):
        return False
    constant, slope, curve = 1 - q22 * T, q22 - q11 * (1 - q22 * T) - q12**2 * T, q12**2 - q11 * q22
    least = [constant + slope * tau + curve * tau**2 for tau in ends]
    if curve > 0 and t1 < -slope / (2 * curve) < t2:
        least.append(constant - slope**2 / (4 * curve))
    return min(least) >= 0


class PeriodCost(NamedTuple):
    """The coefficients of the lower bound L of Theorem B for a period, (m,) each, for known devices.

    L(dx, v, v+) = dx^2 move - 2 dx vb cross + vb^2 mean + (v+ - v)^2 step with the speeds v, v+ at the two ends of the
    period and vb = (v + v+)/2. The fields are floats or Fractions, in N/m, N s/m, N s^2/m and N s^2/m. The formulas
    beside the fields hold for a constant period T, with c0, c2 and q of design.known_device.
    """

    move: Any  # c0/(T - q)
    cross: Any  # c0 q/(T - q)
    mean: Any  # c0 q T/(T - q)
    step: Any  # c2/q


class KnownMotor(HandsSide):
    """The form f'(dx + beta dv) + L of Theorem B, with the speed v at a period's beginning and the `PeriodCost` L."""

    def __init__(self, cost: PeriodCost, beta: Any) -> None:
        self.cost, self.beta = cost, beta

    def inputs(self, loop: Loop, T: Number) -> list[Input]:
        speeds = [Input("v", i, moved=(-b, b), follows=0, slips=False) for i, b in enumerate(numbers(self.beta, T))]
        return [*(Input("dx", i) for i in range(len(speeds))), *speeds]

    def damping(self, loop: Loop, T: Number, values: Values) -> Any:
        return np.zeros((2 * len(self.beta),) * 2, dtype=int)

    def rest(self, loop: Loop, T: Number, values: Values) -> Sequence[Any]:
        move, cross, mean, step = (np.diag(part) for part in self.cost)
        zero = 0 * move
        return (
            np.block([[move, zero], [-cross, mean / 2 + 2 * step]]),
            np.block([[zero, zero], [-cross, mean / 2 - 2 * step]]),
        )


def hands_side(loop: Loop) -> HandsSide:
    """Return the hands' side that uses only the damping of the loop's devices."""
    return Latency() if loop.latency else _EvenPeriods()


# ----------------------------------------------------------------------------------------------------
# Facts of the environment's side.


class Fact(ABC):
    """A property of the environment's side that a linear network with constant delays does not have.

    A user's own fact must define only `enter`; docs/extending.md shows an example.
    """

    @abstractmethod
    def enter(self, block: Collected[Any], loop: Loop, values: Values) -> None:
        """Add the inputs and rows of this fact to the block; `values` are its multipliers, by name."""

    def unknowns(self, loop: Loop) -> tuple[Unknowns, ...]:
        """Return the multipliers that a search finds; none by default."""
        return ()


class Walls(Fact):
    """Walls that make and break contact, with the multipliers a, a + c, d and m of each wall.

    Every wall has the input u, the step of its depth h. A wall with a damper has one more input s >= 0, which is
    positive only when the damper would pull. The step of the wall's force is W u + (W - k) s with W = k + b (1 - 1/z).
    `laws` returns k and b.
    """

    def laws(self, loop: Loop, T: Number) -> list[tuple[Any, Any]]:
        """Return (k, b) of every wall [N/m]; b is the damping divided by T."""
        return [(numbers(wall.stiffness, T), numbers(wall.damping, T) / T) for wall in loop.environment.walls]

    def unknowns(self, loop: Loop) -> tuple[Unknowns, ...]:
        laws = self.laws(loop, loop.T)
        stiff, damped = tuple(float(k) for k, _ in laws), tuple(float(k) if b else 0.0 for k, b in laws)
        ones = tuple(1.0 if b else 0.0 for _, b in laws)
        none = (0.0,) * len(laws)
        expected = f"a number >= 0 for each of {len(laws)} walls, 0 (except in a) for those without damper"
        return (
            Unknowns("a", stiff, expected, 0.0, 1e3),
            Unknowns("a + c", damped, expected, 0.0, 1e3),
            Unknowns("d", damped, expected, 0.0, 1e3),
            Unknowns("m", ones, expected, 0.0, 1e3, start=none),
        )

    def enter(self, block: Collected[Any], loop: Loop, values: Values) -> None:
        laws = self.laws(loop, block.T)
        for j, (k, b) in enumerate(laws):
            u = block.input("u", j)
            a, both, d, m = (numbers(values[name][j], block.T) for name in ("a", "a + c", "d", "m"))
            block.press(u, j, (k + b, -b) if b else (k,))
            block.way(u, j, k, summed=True)
            block.way(u, j, -a)
            block.term(u, u, k / 2 + a)
            if b:
                s, c = block.input("s", j), both - a
                block.press(s, j, (b, -b))
                block.way(s, j, c)
                block.term(s, u, d - c)
                block.term(s, s, d + m * b)
                block.term(u, s, m * b)
                block.before(u, s, -m * (k + b))
                block.before(s, s, -m * b)


class Switching(Fact):
    """Delays that switch within [lo, hi] at every tick and on every device; the multiplier is alpha_i > 0 [N/m].

    A force with the delay of its tick differs from the force with the mean delay. Let h be (hi - lo)/2, dq the
    displacement that the force multiplies, and df_e the steps of the sent force. The work of the difference is at least
    the sum of -alpha dq^2/2 - h^2 df_e^2/(2 alpha) (docs/theory.md). The last term is the least value of
    2 alpha w^2 + 2 h w df_e over the input w, so the block is affine in alpha. The axes of a device share its delay, so
    the weight is the matrix alpha_i Delta_i / mean(diag(Delta_i)).
    """

    def unknowns(self, loop: Loop) -> tuple[Unknowns, ...]:
        moves = np.array(loop.delays.hi) > np.array(loop.delays.lo)
        units = tuple(loop.per_device(even_damping(loop) / loop.T * moves).tolist())
        expected = "a positive number where the delay varies and 0 elsewhere"
        return (Unknowns("alpha", units, expected, 1e-8, 1e6),)

    def enter(self, block: Collected[Any], loop: Loop, values: Values) -> None:
        level = loop.Delta(isinstance(block.T, Fraction))
        for own, alpha in zip(loop.devices, values["alpha"], strict=True):
            axes, wide = range(own.start, own.stop), loop.delays.hi[own.start] - loop.delays.lo[own.start]
            if not wide:
                continue
            weights = numbers(alpha, block.T) * (level[own, own] / (np.trace(level[own, own]) / len(axes)))
            for i in axes:
                block.steps(block.input("w", i), i, (wide,))
            for (a, i), (b, j) in itertools.product(enumerate(axes), repeat=2):
                if not (weight := weights[a, b]):
                    continue
                for (g, p), (h, q) in itertools.product(block.moving(i), block.moving(j)):
                    for power, share in _correlation(p, q):
                        if power == 0:
                            block.term(g, h, -weight * share / 2)
                        else:
                            block.before(g, h, -weight * share)
                block.term(block.places["w", i], block.places["w", j], 2 * weight)


def _correlation(p: _Weights, q: _Weights) -> list[tuple[int, Any]]:
    """Return (power of 1/z, weight) of the terms of p(1/z) q(z) with powers >= 0."""
    return [(i - j, a * b) for i, a in enumerate(p) for j, b in enumerate(q) if i >= j and a * b]


_SPARE = 0.02  # margin of the block's diagonal, relative to rho; a search subtracts it, so that c may be rounded


class Limited(Fact):
    """Forces that are sent through the limiter of controller.law, with the stiffness rho > 0 [N/m] of each device.

    The multiplier has weights c_1, c_2, .. for the past ticks. All axes of a device share rho and these weights. So the
    force of a device may be limited to a ball or to a box.
    """

    def __init__(self, rho: Sequence[float], lags: int = 1) -> None:
        self.rho, self.lags = tuple(rho), lags

    def unknowns(self, loop: Loop) -> tuple[Unknowns, ...]:
        units = (1.0,) * len(loop.devices) * self.lags
        return (Unknowns("c", units, "numbers >= 0, equally many per device", 0.0, 10.0, start=(0.0,) * len(units)),)

    def enter(self, block: Collected[Any], loop: Loop, values: Values) -> None:
        for i, d in enumerate(loop.per_channel(range(len(loop.devices)))):
            for part in block.slipping(i):
                block.keep(part, _SPARE * self.rho[d])
            c = [numbers(v, block.T) for v in values["c"][d * self.lags : (d + 1) * self.lags]]
            e, rho = block.places["de", i], numbers(self.rho[d], block.T)
            block.force(e, i, (-rho, rho))
            block.steps(e, i, _less_advance(block.path[i], 1))
            for j, weight in enumerate(c, start=1):
                block.steps(e, i, tuple(-weight * k for k in range(j, 0, -1)))


def _levelled(form: Any, inputs: Sequence[Input], loop: Loop, T: Number) -> Any:
    """Return the quadratic form of the damping, extended to matrices Delta.

    If the entry of `form` for the inputs a and b of axis i is q delta_i, then the entry for the input a of axis i and
    the input b of axis j is q Delta_ij.
    """
    if loop.levels is None:
        return form
    level, at = loop.Delta(isinstance(T, Fraction)), {(each.name, each.channel): g for g, each in enumerate(inputs)}
    out = form.copy()
    for g, one in enumerate(inputs):
        for h, other in enumerate(inputs):
            i, j = one.channel, other.channel
            if i != j and level[i, j]:
                out[g, h] = form[g, at[other.name, i]] * level[i, j] / level[i, i]
    return out


def compose(
    G: Block,
    loop: Loop,
    facts: Sequence[Fact] = (),
    values: Values | None = None,
    late: bool = True,
    scaled: bool = False,
    hands: HandsSide | None = None,
) -> Demand[Block]:
    """Return the block of a hands' side with these facts at these multipliers, which are not checked.

    Args:
        G: The map from displacements x (m,) and wall forces p to sent forces f_e (m,) and displacements y across walls.
        values: The multipliers by name.
        late: Whether the delays Theta have to be added; False if G contains them.
        scaled: Whether `values` holds s times the multipliers of the hands' side, so that the block is affine in s and
            all values.
        hands: The hands' side; None for `hands_side(loop)`.
    """
    values = values or {}
    path: list[_Weights] = [(1,)] * loop.channels
    if late:
        path = _paths(loop, any(isinstance(fact, Switching) for fact in facts))
    hands, T = hands or hands_side(loop), G.T
    walls = len(loop.environment.walls) if any(isinstance(fact, Walls) for fact in facts) else 0
    block: Collected[Block] = Collected(T, path, walls, hands.inputs(loop, T))
    if any(isinstance(fact, Limited) for fact in facts):
        block.limit()
    _take(block, hands, loop, values, scaled)
    for fact in facts:
        fact.enter(block, loop, values)
    S, free, gain = block.build(G)
    m = [block.places[i.name, i.channel] for i in block.hands if i.slips]
    ways = [number for (name, _), number in block.places.items() if name == "u"]
    F1, Y1 = S[..., m, :][..., :, m], S[..., ways, :][..., :, ways]
    static, least = {"F(1)": F1}, ("F(1)",)
    if walls:
        every = [*m, *ways]
        static |= {"-Y(1)": -Y1, "the static map of devices and walls": S[..., every, :][..., :, every]}
        least = ("F(1)", "-Y(1)")
    return Demand(free, constant_like(G, gain), static, least, block.spare)


def _take(block: Collected[Any], hands: HandsSide, loop: Loop, values: Values, scaled: bool) -> None:
    """Add the form of the hands' side. If `scaled`, its terms with multipliers already contain the factor s."""

    def form(values: Values) -> Any:
        return _levelled(hands.damping(loop, block.T, values), block.hands, loop, block.T)

    damping, rest = form(values), list(hands.rest(loop, block.T, values))
    if scaled and (unknowns := hands.unknowns(loop)):
        idle = form({**values, **{each.name: (0,) * len(each.units) for each in unknowns}})
        rest[:1] = [damping - idle + (rest[0] if rest else 0)]
        damping = idle
    block.take(damping, rest)


def _paths(loop: Loop, switch: bool) -> list[_Weights]:
    """Return the weights of Theta for each channel. For switching delays Theta is the mean of z^-lo and z^-hi."""
    spans = zip(loop.delays.lo, loop.delays.hi, strict=True) if switch else zip(loop.theta, loop.theta, strict=True)
    return [[Fraction((i == lo) + (i == hi), 2) for i in range(hi + 1)] for lo, hi in spans]


def compose_any(
    V: Block,
    loop: Loop,
    facts: Sequence[Fact] = (),
    values: Values | None = None,
    scaled: bool = False,
    hands: HandsSide | None = None,
) -> Demand[Block]:
    """Return the block of a hands' side for any passive object behind the coupling V, without delay psi.

    The inputs are those of the hands' side and of the facts, and then df_e, the steps of the sent forces. The block of
    df_e is V(1)/2 - (V - V(1))/(z-1). The multipliers `values` are not checked.
    """
    values, hands, T = values or {}, hands or hands_side(loop), V.T
    path = _paths(loop, any(isinstance(fact, Switching) for fact in facts))
    block: Collected[Lti] = Collected(T, path, 0, hands.inputs(loop, T), any_object=True)
    _take(block, hands, loop, values, scaled)
    for fact in facts:
        fact.enter(block, loop, values)
    steps = [block.input("df_e", i) for i in range(loop.channels)]
    for i, row in enumerate(steps):
        block.force(row, i, (1,))
    _, free, gain = block.build(None)
    V1, regular = V.over_z_minus_one()
    place = np.eye(block.size, dtype=int)[:, steps]
    return Demand(as_like(V, free) - place @ regular @ place.T, constant_like(V, gain), {"V(1)": V1})
