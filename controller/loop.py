"""The loop that design, simulation and hardware use: devices, delays and environment.

                 x  sampled                                     Delta_D  damping that the devices guarantee
    devices ---------------> (+) ---> Psi E ---+---> Theta ---> f  held for T
                              ^-               |
                              +----- V <-------+                F = Theta (I + Psi E V)^-1 Psi E     (6)

A `Loop` contains the damping of every device and, if guaranteed, bounds of its motor and transmission. It contains
nothing about the humans. controller.tick computes its ticks. Numbers such as (6) are equations of the paper.
"""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from typing import Annotated, Any

import msgspec
import numpy as np
from numpy.typing import ArrayLike

from haptic_loop.controller.arithmetic import Number, numbers, positive_definite, rational
from haptic_loop.controller.coupling import Coupling, Strict
from haptic_loop.controller.delay import MOST_SAMPLES, delay
from haptic_loop.controller.environment import RIGID_WALL, Environment, Network, RigidWall, walled_environment
from haptic_loop.controller.law import Law, Limiter
from haptic_loop.controller.lti import Array, Block, Complex, Lti, Sampled, as_like
from haptic_loop.controller.ranges import Member, Ranges, members
from haptic_loop.controller.units import PositionUnit, in_unit

_Steps = tuple[Annotated[int, msgspec.Meta(ge=0, le=MOST_SAMPLES)], ...]
_Positive = Annotated[float, msgspec.Meta(gt=0)]
_LEAST_DAMPING = 1e-12  # [N s/m] far below that of any device; the square of its inverse does not overflow
Rows = tuple[tuple[float, ...], ...]  # rows of a matrix


class DelayRange(Strict, frozen=True):
    """Delays between lo and hi, which may change at every tick and differ between channels."""

    lo: _Steps  # (m,) [samples]
    hi: _Steps  # (m,) [samples]

    def __post_init__(self) -> None:
        shown = f"delays from {list(self.lo)} to {list(self.hi)} samples"
        if len(self.lo) != len(self.hi):
            raise ValueError(f"{shown}, expected equal numbers of least and largest delays")
        if any(not 0 <= a <= b <= MOST_SAMPLES for a, b in zip(self.lo, self.hi, strict=True)):
            raise ValueError(f"{shown}, expected 0 <= lo <= hi <= {MOST_SAMPLES} on every channel")

    def __str__(self) -> str:
        """Return '[1, 2] samples', or '[1, 2], [0, 3] samples' if the channels differ."""
        spans = [f"[{a}, {b}]" for a, b in zip(self.lo, self.hi, strict=True)]
        return f"{', '.join(spans if len(set(spans)) > 1 else spans[:1])} samples"

    def contains(self, other: DelayRange) -> bool:
        """Return whether the range contains `other`; a constant theta is DelayRange(theta, theta)."""
        below, above = zip(self.lo, other.lo, strict=True), zip(self.hi, other.hi, strict=True)
        return all(a <= b for a, b in below) and all(a >= b for a, b in above)


class DeviceBounds(Strict, frozen=True):
    """Guaranteed bounds of a device's motor and transmission, `[device.guaranteed]` of a scenario.

    A known-device proof holds for every device within them. The transmission, a spring and a damper in parallel, joins
    the motor to everything else. Simulated devices must lie within the bounds.
    """

    motor_mass_min: _Positive  # [kg] mass that moves rigidly with the motor's shaft, at the encoder's coordinate
    transmission_stiffness_max: _Positive  # [N/m]
    transmission_damping_min: _Positive  # [N s/m]
    transmission_damping_max: _Positive  # [N s/m]

    def __post_init__(self) -> None:
        for name, low, high, unit in (
            ("motor_mass_min", 1e-9, 1e3, "kg"),
            ("transmission_stiffness_max", 1e-4, 1e9, "N/m"),
            ("transmission_damping_min", 1e-9, 1e5, "N s/m (a lossless transmission guarantees nothing)"),
            ("transmission_damping_max", self.transmission_damping_min, 1e5, "N s/m"),
        ):
            if not low <= getattr(self, name) <= high:
                raise ValueError(f"{name} is {getattr(self, name):g}, allowed are {low:g} to {high:g} {unit}")


def check_shortest(T_min: float | None, T: float) -> None:
    """Raise ValueError unless a declared shortest period T_min [s] is positive and at most T."""
    if T_min is not None and not 0 < T_min <= T:
        raise ValueError(f"T_min is {T_min:g} s, expected above 0 and at most T = {T:g} s")


class Loop(Strict, frozen=True, omit_defaults=True):  # defaults are left out of the digest
    """All data from which a condition certifies a coupling."""

    T: _Positive  # [s]
    theta: _Steps  # (m,) transmission delays [samples]
    psi: _Steps  # (m,) environment delays [samples]
    lam: _Steps  # (m,) delays of the reference [samples], for transparency only
    delta: tuple[_Positive, ...]  # (m,) damping that the devices guarantee [N s/m]
    environment: Network | RigidWall  # or an `Environment` of a user's own class, which cannot be stored
    ranges: Ranges | None = None  # ranges of the environment's parameters
    varying_delay: DelayRange | None = None  # the forces' delays, if they may change at every tick
    T_max: _Positive | None = None  # [s] longest period if periods vary; None: T
    latency: tuple[tuple[float, float], ...] | None = None  # (m,) [s] least and largest latency of forces after kT
    T_min: _Positive | None = None  # [s] shortest period, for the known-device condition and the latency
    known_devices: tuple[DeviceBounds, ...] | None = None  # (m,) guaranteed bounds of the devices
    axes: tuple[int, ...] | None = None  # number of channels of each device; None: one for each device
    levels: tuple[Rows, ...] | None = None  # Delta_i per device [N s/m], with diagonals as in delta; None: diag(delta)
    unit: PositionUnit = "m"  # unit of positions; if it is "rad", N m, N m s/rad and kg m2 replace N, N s/m and kg

    def __post_init__(self) -> None:
        if not 0 < self.T < float("inf"):
            raise ValueError(f"T is {self.T:g} s, expected a positive, finite period")
        m = len(self.environment.contacts)
        for name in ("theta", "psi", "lam", "delta"):
            if len(getattr(self, name)) != m:
                raise ValueError(f"{name} has {len(getattr(self, name))} entries, the environment has {m} contacts")
        for name in ("theta", "psi", "lam"):
            steps = getattr(self, name)
            if any(n != int(n) or not 0 <= n <= MOST_SAMPLES for n in steps):
                raise ValueError(f"{name} is {list(steps)}, allowed are whole numbers of samples, 0 to {MOST_SAMPLES}")
        if not all(d == 0 or _LEAST_DAMPING <= d < float("inf") for d in self.delta):
            raise ValueError(
                f"delta is {list(self.delta)}, expected 0 or a finite damping from {_LEAST_DAMPING:g} N s/m"
            )
        if any(n > t + p for n, t, p in zip(self.lam, self.theta, self.psi, strict=True)):
            raise ValueError(f"lam is {list(self.lam)}, expected at most theta + psi on every channel")
        for member in self.members():
            try:
                member.network.check(self.psi, self.T)  # refuses, for example, an internal node that nothing holds
            except ValueError as error:
                raise ValueError(f"{member.name}: {error}" if self.ranges else str(error)) from None
        if self.varying_delay:
            self._check_varying_delay(self.varying_delay)
        if self.T_max is not None and not self.T <= self.T_max < float("inf"):
            raise ValueError(f"T_max is {self.T_max:g} s, expected at least T = {self.T:g} s")
        check_shortest(self.T_min, self.T)
        if self.known_devices is not None and len(self.known_devices) != m:
            raise ValueError(f"known_devices has {len(self.known_devices)} entries for {m} channels")
        if self.latency is not None:
            self._check_latency(self.latency)
        self._check_axes()

    def _check_axes(self) -> None:
        """Raise ValueError unless axes, levels and values per device fit the channels; set default values to None."""
        m, axes = self.channels, (1,) * self.channels if self.axes is None else self.axes
        if sum(axes) != m or min(axes) < 1:
            raise ValueError(f"axes is {list(axes)}, expected numbers >= 1 that add up to the {m} contacts")
        for name in ("theta", "psi", "latency", "known_devices"):
            each = getattr(self, name) or ()
            if any(len(set(each[own])) > 1 for own in self.devices):
                raise ValueError(f"{name} is {list(each)}, expected one value for all axes of a device")
        spans = [*zip(self.delays.lo, self.delays.hi, strict=True)]
        if any(len(set(spans[own])) > 1 for own in self.devices):
            raise ValueError(f"varying_delay is {self.varying_delay}, expected one range for all axes of a device")
        if self.levels is not None:
            self._check_levels(self.levels)
        if set(axes) == {1}:
            msgspec.structs.force_setattr(self, "axes", None)

    def _check_levels(self, levels: tuple[Rows, ...]) -> None:
        if len(levels) != len(self.devices):
            raise ValueError(f"levels has {len(levels)} matrices for {len(self.devices)} devices")
        for i, (level, own) in enumerate(zip(levels, self.devices, strict=True), start=1):
            n, shown = own.stop - own.start, f"level #{i} is {[list(row) for row in level]}"
            if len(level) != n or any(len(row) != n for row in level):
                raise ValueError(f"{shown}, expected a {n} x {n} matrix [N s/m]")
            if any(level[j][k] != level[k][j] for j in range(n) for k in range(j)):
                raise ValueError(f"{shown}, expected a symmetric matrix")
            if any(level[j][j] != d for j, d in enumerate(self.delta[own])):
                raise ValueError(f"{shown}, expected delta = {list(self.delta[own])} on its diagonal")
            if not positive_definite(numbers(level, Fraction(1))):
                raise ValueError(f"{shown}, expected a positive definite matrix")
        if not any(value for level in levels for j, row in enumerate(level) for value in (*row[:j], *row[j + 1 :])):
            msgspec.structs.force_setattr(self, "levels", None)

    def _check_latency(self, latency: tuple[tuple[float, float], ...]) -> None:
        if len(latency) != len(self.theta):
            raise ValueError(f"latency has {len(latency)} ranges for {len(self.theta)} channels")
        name, shortest = ("T_min", self.T_min) if self.T_min else ("T", self.T)
        for i, (least, most) in enumerate(latency, start=1):
            if not 0 <= least <= most < shortest:
                raise ValueError(
                    f"latency #{i} is {least:g} to {most:g} s, expected 0 <= least <= most < {name} = {shortest:g} s"
                )

    def _check_varying_delay(self, span: DelayRange) -> None:
        if len(span.lo) != len(self.theta):
            raise ValueError(f"varying_delay has {len(span.lo)} ranges for {len(self.theta)} channels")
        if not span.contains(DelayRange(self.theta, self.theta)):
            raise ValueError(f"theta is {list(self.theta)}, outside of its varying_delay, {span}")

    def __repr__(self) -> str:
        shown = f"T = {1e3 * self.T:g} ms, theta = {list(self.theta)}, psi = {list(self.psi)}"
        shown += f", damping {list(self.delta)} {in_unit('N s/m', self.unit)}"
        return f"Loop({shown}, contacts {', '.join(self.environment.contacts)})"

    @property
    def channels(self) -> int:
        return len(self.theta)

    @property
    def devices(self) -> tuple[slice, ...]:
        """The channels of every device, as a slice."""
        ends = np.cumsum(self.axes or (1,) * self.channels).tolist()
        return tuple(slice(first, last) for first, last in zip([0, *ends[:-1]], ends, strict=True))

    def per_device(self, values: ArrayLike) -> Array:
        """Return (devices,): the least value of each device, from one value per channel (m,)."""
        return np.minimum.reduceat(np.asarray(values, dtype=float), [own.start for own in self.devices])

    def per_channel(self, values: Sequence[Any]) -> tuple[Any, ...]:
        """Repeat the value of each device for each of its channels."""
        return tuple(v for v, n in zip(values, self.axes or (1,) * self.channels, strict=True) for _ in range(n))

    @property
    def least_damping(self) -> tuple[float, ...]:
        """The least eigenvalue of each Delta_i [N s/m], the least damping of a device over all directions."""
        if self.levels is None:
            return tuple(self.per_device(self.delta).tolist())
        return tuple(float(np.linalg.eigvalsh(np.array(level))[0]) for level in self.levels)

    def Delta(self, exact: bool = False) -> Any:
        """Return the guaranteed damping Delta_D = blockdiag(Delta_1, ..) (10) [N s/m], (m, m)."""
        T = self.period(exact)
        out = numbers(np.diag(self.delta), T)
        for own, level in zip(self.devices, self.levels or (), strict=self.levels is not None):
            out[own, own] = numbers(level, T)
        return out

    def period(self, exact: bool = False) -> Number:
        """Return T, a Fraction if `exact`; its type determines the arithmetic of all blocks."""
        return rational(self.T) if exact else self.T

    def E(self, exact: bool = False) -> Lti:
        """Return the environment E(z), with every wall touching."""
        return self.environment.E(self.period(exact))

    def sent(self, coupling: Coupling, exact: bool = False) -> Lti:
        """Return G from displacements to the forces before Theta, (I + Psi E V)^-1 Psi E. Raises SingularLoop."""
        if not exact:
            return self.environment.sent(coupling, self.psi, self.T)
        key = (self.environment, coupling, self.psi, self.T)
        known, block = _exactly
        if block is None or not all(one is other for one, other in zip(key, known, strict=True)):
            block = self.environment.sent(coupling, self.psi, self.period(exact))
            _exactly[:] = key, block
        return block

    def sent_at(self, coupling: Coupling, z: Complex) -> Sampled:
        """Return the G of `sent` at points z of the circle, (n, k) or (1, k)."""
        return self.environment.sent_at(coupling, self.psi, z, self.T)

    def late(self, G: Block) -> Block:
        """Return Theta G (6), from displacements to the forces that act on the devices."""
        return as_like(G, delay(self.theta, G.T)) @ G

    def F(self, coupling: Coupling, exact: bool = False) -> Lti:
        """Return F = Theta G (6) from displacements to forces at the devices. Raises SingularLoop."""
        return self.late(self.sent(coupling, exact))

    def walled_before_delay(self, coupling: Coupling, exact: bool = False) -> Lti:
        """Return the block of `sent` with ports for the walls, from [x; p] to [f_e; y] with the sent forces f_e.

        p are the forces [N] of the walls, and y the displacements [m] across them. Psi delays the effect of p on f_e.
        Raises SingularLoop, and ValueError for a coupling that excludes walls.
        """
        if not (walls := len(self.environment.walls)):
            return self.sent(coupling, exact)
        T = self.period(exact)
        late = Lti.diag(delay(self.psi, T), Lti.constant(np.eye(walls), T))
        return coupling.around(late @ walled_environment(self.network, T), further=walls)

    def law(
        self,
        coupling: Coupling,
        limit: ArrayLike | None = None,
        rho: ArrayLike | None = None,
        balls: Sequence[slice] = (),
    ) -> Law:
        """Return the law of a tick.

        With both `rho` (m,) [N/m] and `limit` (m,) [N] a limiter bounds the sent forces. `balls` are groups of
        neighbouring channels whose force is limited as a vector. Raises SingularLoop, and ValueError for a coupling
        that excludes walls.
        """
        walls = self.environment.walls
        sent = self.walled_before_delay(coupling)
        if limit is None or rho is None:
            return Law(sent, self.theta, walls)
        return Limiter(sent, self.theta, walls, limit=np.array(limit), rho=np.array(rho), balls=tuple(balls))

    def members(self) -> tuple[Member, ...]:
        """Return the nominal environment, and at most 128 vertices of its ranges if it has any."""
        if self.ranges:
            return members(self.network, self.ranges)
        return (Member("the nominal environment", self.environment),)

    @property
    def network(self) -> Network:
        """The environment, if it is a network. Raises ValueError otherwise."""
        return self.environment.as_network()

    def frozen(self) -> tuple[Loop, ...]:
        """Return the loop for every set of walls that are frozen in contact."""
        return tuple(self.at(state) for state in self.environment.frozen())

    def at(self, network: Environment) -> Loop:
        """Return the loop with this environment, without ranges."""
        return msgspec.structs.replace(self, environment=network, ranges=None)

    def channel(self, i: int) -> Loop:
        """Return channel i with delta_i and a rigid wall, for conditions that do not depend on the environment."""
        own, known, late, span = slice(i, i + 1), self.known_devices, self.latency, self.varying_delay
        return Loop(
            self.T,
            self.theta[own],
            (0,),
            (0,),
            self.delta[own],
            RIGID_WALL,
            varying_delay=span and DelayRange(span.lo[own], span.hi[own]),
            T_max=self.T_max,
            latency=late and late[own],
            T_min=self.T_min,
            known_devices=known and known[own],
        )

    def delayed(self, theta: _Steps) -> Loop:
        """Return the loop with these constant delays of its forces, and with lam at most theta + psi."""
        lam = tuple(min(n, t + p) for n, t, p in zip(self.lam, theta, self.psi, strict=True))
        return msgspec.structs.replace(self, theta=theta, lam=lam, varying_delay=None)

    def switching(self, span: DelayRange | None) -> Loop:
        """Return the loop with delays that may change within `span`, or with the constant theta if `span` is None."""
        return msgspec.structs.replace(self, varying_delay=span)

    @property
    def delays(self) -> DelayRange:
        """The range of the forces' delays, with lo = hi = theta if the delays are constant."""
        return self.varying_delay or DelayRange(self.theta, self.theta)


#: The key and the value of the last G over Fractions. A proof may use G twice, and most of the work is to compute G.
_exactly: list[Any] = [(None,) * 4, None]


def forget_exact() -> None:
    """Clear the stored G, so that the counted work of a proof does not depend on earlier proofs."""
    _exactly[:] = (None,) * 4, None
