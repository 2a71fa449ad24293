"""The block of a condition, composed from one hands' side and the facts of the environment's side.

Every proof in docs/theory.md has two sides, which share only the displacements and the forces as the devices receive
them. The **hands' side** is a lower bound of the energy that every passive hand and the devices dissipate, whatever
forces act. Its inputs are the displacements of a period: dx, or xa and xb before and after a force latches. A **fact**
of the environment's side describes the forces; it adds inputs, a row for each, and multipliers. The quadratic form is

    sum over ticks of f'(displacement that f multiplies) + energy of the damping + terms of the multipliers,

and its block must be strictly positive real, with its pole at z = 1 split off. `Collected` collects the entries of both
sides and builds the block in any arithmetic.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any, Generic

import numpy as np

from haptic_loop.controller.arithmetic import Number, numbers, times
from haptic_loop.controller.loop import Loop
from haptic_loop.controller.lti import Array, Lti, Sampled, as_like, vstack
from haptic_loop.controller.lti import Block as AnyBlock
from haptic_loop.design.arguments import shown
from haptic_loop.design.exact import require_size


@dataclass(frozen=True, eq=False)
class Demand(Generic[AnyBlock]):
    """free + s gain must be strictly positive real, with s = 1 for the available damping.

    `static` holds named matrices that must be symmetric. Those named in `semidefinite` must also be positive
    semidefinite.
    """

    free: AnyBlock
    gain: AnyBlock
    static: Mapping[str, Array] = field(default_factory=dict)
    semidefinite: tuple[str, ...] = ()
    spare: Array | None = None  # (n,) margin of the diagonal in a search for multipliers

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
    """Return Delta_D T/T_max (m,) [N s/m], the damping for even periods T that stands for delta in periods up to T_max.

    The integral of delta v^2 over a period T_k is at least delta dx^2/T_k, so the longest period counts. The rest of
    the energy balance does not depend on T: the force map is the same at every tick.
    """
    T = loop.T if T is None else T
    damping = numbers(loop.delta, T)
    return damping if loop.T_max is None else damping * (T / numbers(loop.T_max, T))


def even_level(loop: Loop, T: Number | None = None) -> Any:
    """Return Delta_D T/T_max [N s/m] as a matrix (m, m)."""
    T = loop.T if T is None else T
    level = loop.Delta(exact=isinstance(T, Fraction))
    return level if loop.T_max is None else level * (T / numbers(loop.T_max, T))


Weights = Sequence[Any]  # w_0 + w_1/z + .. of a row, or w_0 + w_1 z + .. of a displacement


def product(p: Weights, q: Weights) -> list[Any]:
    """Return the weights of the product of two polynomials."""
    out: list[Any] = [0] * (len(p) + len(q) - 1)
    for i, a in enumerate(p):
        for j, b in enumerate(q):
            out[i + j] = out[i + j] + a * b
    return out


def less_advance(p: Weights, follows: Any) -> list[Any]:
    """Return the weights of (p(1/z) - follows z)/(z - 1), which is causal because p(1) = follows.

    For p = z^-theta this is -(1 + 1/z + .. + z^-theta), the negative window of a delay.
    """
    out, left = [], follows
    for weight in p:
        out.append(-left)
        left = left - weight
    return out


@dataclass(frozen=True)
class Input:
    """One scalar input of the hands' side: a displacement or a speed of a device at every tick."""

    name: str
    channel: int
    moved: Weights = (1,)  # weights w_0 + w_1 z + .. of the input in the displacement that the force f[k] multiplies
    follows: int = 1  # 1 if the input is a displacement of the environment, 0 for a speed
    slips: bool = True  # whether the limiter's slip is subtracted from the input


class Collected(Generic[AnyBlock]):
    """The entries of the hands' side and the facts: inputs, weights of forces, rows, and constant terms."""

    def __init__(
        self, T: Number, path: Sequence[Weights], walls: int, hands: Sequence[Input], any_object: bool = False
    ) -> None:
        """Add the rows of the hands' inputs.

        With `any_object` the energy of a passive object behind the sent forces is subtracted: the factor of f_e[k] is
        the displacement without x[k] - x[k-1] (docs/theory.md, "any environment").
        """
        self.T, self.channels, self.walls = T, len(path), walls
        self.path, self.hands = path, hands  # path: the weights of each channel's nominal delay
        self.places: dict[tuple[str, int], int] = {}  # (name, channel or wall) -> input
        self._into: list[tuple[int, int, Weights]] = []  # (output of the inputs' filter, input, weights)
        self._force: list[tuple[int, int, Weights]] = []  # (channel, input, weights) of steps added to the response
        self._sums: list[tuple[int, int, Weights, Any]] = []  # (row, channel, weights of f_e, scale)
        self._steps: list[tuple[int, int, Weights, Any]] = []  # (row, channel, weights of df_e, scale)
        self._walls: list[tuple[int, int, Any, bool]] = []  # (row, wall, weight of dy, whether it is summed)
        self._terms: list[tuple[int, int, Any]] = []
        self._before: list[tuple[int, int, Any]] = []  # (row, input one tick before, weight)
        self._gain: list[tuple[int, int, Any]] = []
        self._keep: list[tuple[int, float]] = []
        for i in hands:
            row, weights = self.input(i.name, i.channel), product(path[i.channel], i.moved)
            if any_object or not i.follows:  # The weights of a speed add up to 0, so there is no pole.
                self.steps(row, i.channel, less_advance(weights, i.follows))
            else:
                self.sums(row, i.channel, weights)
                self._into.append((i.channel, row, (1,)))

    def limit(self) -> None:
        """Subtract the limiter's slip, one more input per channel, from the displacements of inputs with `slips`."""
        for i in self.hands:
            if i.slips:
                self.input("de", i.channel)

    def take(self, damping: Any, rest: Sequence[Any] = ()) -> None:
        """Add the quadratic form of the hands' side, in the displacements from which no slip is subtracted."""
        parts = [self._with_slip(i) for i in self.hands]
        for enter, form in zip((self.damping, self.term, self.before), (damping, *rest), strict=False):
            for g, h in zip(*np.nonzero(form), strict=True):
                for row in parts[g]:
                    for column in parts[h]:
                        enter(row, column, form[g, h])

    def _with_slip(self, i: Input) -> list[int]:
        """Return the numbers of the inputs that add up to a hands' input."""
        slip = self.places.get(("de", i.channel)) if i.slips else None
        return [self.places[i.name, i.channel], *([] if slip is None else [slip])]

    def input(self, name: str, place: int) -> int:
        """Add an input of a device or a wall and return its number."""
        self.places[name, place] = len(self.places)
        return len(self.places) - 1

    def of(self, name: str) -> dict[int, int]:
        """Return {channel or wall: number} of the inputs with this name."""
        return {place: i for (known, place), i in self.places.items() if known == name}

    def slip(self, channel: int) -> int:
        """Return the number of the limiter's slip of a channel."""
        return self.places["de", channel]

    def moving(self, channel: int) -> list[tuple[int, Weights]]:
        """Return the inputs that add up to the displacement that a channel's force multiplies, with weights in z."""
        parts: list[tuple[int, Weights]] = [
            (self.places[i.name, i.channel], i.moved) for i in self.hands if i.channel == channel
        ]
        return parts + ([(self.slip(channel), (1,))] if ("de", channel) in self.places else [])

    def slipping(self, channel: int) -> tuple[int, int]:
        """Return the numbers of the displacement from which the limiter's slip is subtracted, and of the slip."""
        (own,) = (self.places[i.name, channel] for i in self.hands if i.channel == channel and i.slips)
        return own, self.slip(channel)

    @property
    def size(self) -> int:
        return len(self.places)

    # -- effects of inputs

    def press(self, i: int, wall: int, weights: Weights) -> None:
        """Let input i add to the steps of a wall's force."""
        self._into.append((self.channels + wall, i, weights))

    def force(self, i: int, channel: int, weights: Weights) -> None:
        """Let input i add to the steps of a device's force, besides the environment's response."""
        self._force.append((channel, i, weights))

    # -- terms of rows

    def sums(self, row: int, channel: int, weights: Weights, scale: Any = 1) -> None:
        """Add the weighted sent force to a row. The force is the sum of its steps, which is a pole at z = 1."""
        self._sums.append((row, channel, weights, scale))

    def steps(self, row: int, channel: int, weights: Weights, scale: Any = 1) -> None:
        """Add the weighted steps of the sent force to a row."""
        self._steps.append((row, channel, weights, scale))

    def way(self, row: int, wall: int, weight: Any, summed: bool = False) -> None:
        """Add the weighted steps of the displacement y across a wall to a row, or y itself if `summed`."""
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
        """Add a margin to the diagonal in a search, so that multipliers may be rounded."""
        self._keep.append((row, amount))

    @property
    def spare(self) -> Array | None:
        """The margins (n,) of `keep`, or None."""
        spare = np.zeros(self.size)
        for row, amount in self._keep:
            spare[row] += amount
        return spare if self._keep else None

    # -- the block

    @property
    def states(self) -> int:
        """The number of states of the block besides those of the environment's response."""
        return self._bank(self._reads()[1]).order + self._filter()[0].order

    def _matrix(self, entries: Sequence[tuple[int, int, Any]]) -> Any:
        out: Any = numbers(np.zeros((self.size, self.size), dtype=int), self.T) + 0
        for i, j, weight in entries:
            out[i, j] = out[i, j] + weight
        return out

    def gain(self) -> Any:
        return self._matrix(self._gain)

    def _reads(self) -> tuple[list[tuple[int, Any, bool]], list[tuple[int, Weights]]]:
        """Return (row, scale, summed) of each term with forces, and its (channel, weights)."""
        kinds = [*((r, True) for r in self._sums), *((r, False) for r in self._steps)]
        return [(row, scale, summed) for (row, _, _, scale), summed in kinds], [(c, w) for (_, c, w, _), _ in kinds]

    def _bank(self, reads: Sequence[tuple[int, Weights]]) -> Lti:
        """Return the block from sent forces (m,) to the weighted forces, with one delay line per channel."""
        order = sorted(range(len(reads)), key=lambda r: reads[r][0])
        parts = [_taps([w for c, w in reads if c == channel], self.T) for channel in range(self.channels)]
        return Lti.diag(*parts).rows(np.argsort(order)) if reads else Lti.constant(np.zeros((0, self.channels)), self.T)

    def _filter(self) -> tuple[Lti, list[int]]:
        """Return the block from inputs to [x; p; added force steps; previous inputs], and the previous inputs used."""
        late = sorted({j for _, j, _ in self._before})
        first, second = self.channels + self.walls, 2 * self.channels + self.walls
        entries = [*self._into, *((first + c, i, w) for c, i, w in self._force)]
        entries += [(second + r, i, (0, 1)) for r, i in enumerate(late)]
        return _of_weights(entries, second + len(late), self.size, self.T), late

    def build(self, G: AnyBlock | None) -> tuple[Array, AnyBlock, Any]:
        """Return (residue at z = 1 (n, n), block without its pole, matrix that the damping multiplies).

        G maps [x; p], displacements and wall forces, to [f_e; y], sent forces and displacements across walls. With None
        the steps of the forces are inputs instead (`force`).
        """
        m, w, n, T = self.channels, self.walls, self.size, self.T
        into, late = self._filter()
        rows, reads = self._reads()
        bank = self._bank(reads)
        follows = len(reads)
        # The signals are weighted forces, displacements across walls, and inputs of the previous tick.
        inner = m + w  # outputs of G
        rest = m + len(late)  # outputs of the filter that bypass G
        mix: Any = numbers(np.zeros((m + w + len(late), inner + rest), dtype=int), T) + 0
        for i in range(m):
            mix[i, i] = mix[i, inner + i] = 1
        for j in range(w):
            mix[m + j, m + j] = 1
        for j in range(len(late)):
            mix[m + w + j, inner + m + j] = 1
        lines = Lti.diag(bank, Lti.constant(np.eye(w + len(late), dtype=int), T)) @ mix
        if isinstance(G, Sampled):
            filtered = Sampled(G.z, into.at(G.z), G.T)
            through = vstack(G @ filtered.rows(slice(0, inner)), filtered.rows(slice(inner, None)))
        else:
            silent = Lti.constant(np.zeros((inner, inner), dtype=int), T) if G is None else G
            through = Lti.diag(silent, Lti.constant(np.eye(rest, dtype=int), T)) @ into
        signals = as_like(through, lines) @ through
        if isinstance(signals, Lti) and signals.is_exact:
            require_size(signals.order)
        static, regular = signals.over_z_minus_one()
        count = signals.G.shape[-2] if isinstance(signals, Sampled) else signals.outputs
        sums: Any = numbers(np.zeros((n, count), dtype=int), T) + 0
        steps: Any = sums + 0
        for r, (row, scale, summed) in enumerate(rows):
            target = sums if summed else steps
            target[row, r] = target[row, r] + scale
        for row, wall, weight, summed in self._walls:
            target = sums if summed else steps
            target[row, follows + wall] = target[row, follows + wall] + weight
        for row, column, weight in self._before:
            place = follows + w + late.index(column)
            steps[row, place] = steps[row, place] + weight
        free = np.hstack([sums, steps]) @ vstack(regular, signals) + self._matrix(self._terms)
        return times(sums, static), free, self.gain()


def _taps(rows: Sequence[Weights], T: Number) -> Lti:
    """Return the block from one channel to w_0 + w_1/z + .. for each row, with one delay line."""
    n = max((len(row) for row in rows), default=1) - 1
    table: Any = numbers(np.zeros((len(rows), n + 1), dtype=int), T) + 0
    for r, row in enumerate(rows):
        for k, weight in enumerate(row):
            table[r, k] = numbers(weight, T)
    first = np.zeros((n, 1), dtype=int)
    first[:1] = 1
    return Lti(np.eye(n, k=-1, dtype=int), first, table[:, 1:], table[:, :1], T)


def _of_weights(entries: Sequence[tuple[int, int, Weights]], outputs: int, inputs: int, T: Number) -> Lti:
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
