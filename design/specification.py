"""What a design is asked for: the environment, the delays, the devices, and how mismatch is weighed."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from controller.box import Region
from controller.delay import delay
from controller.lti import Array, Lti
from design.frequency.sweep import frequencies, hermitian, on_circle, supremum
from design.margin import dampings

#: Designs ask for (1 - RESERVE) of the damping that there is, so that they are certified as stored.
RESERVE = 1e-4


@dataclass(frozen=True, eq=False)
class Specification:
    """N channels in, N channels out. Raises ValueError naming the field that is wrong."""

    environment: Lti  # E(z), N x N, passive
    theta: tuple[int, ...]  # (N,) transmission delays [samples]
    psi: tuple[int, ...]  # (N,) environment delays [samples]
    lam: tuple[int, ...]  # (N,) delays of the reference Lambda (7) [samples], 0 <= lam <= theta + psi
    delta: tuple[float, ...]  # (N,) device dampings [N s/m]
    W1: Lti | None = None  # weight on the left of (22); the identity if None
    W2: Lti | None = None  # diagonal weight on its right; low_pass if None
    others: Mapping[str, Lti] = field(default_factory=dict)  # by name: what else the environment may be, for `optimal`
    regions: tuple[Region, ...] = ()  # the box of the others, in which the design is searched for violations
    shrunk: Callable[[float], Mapping[str, Lti]] | None = None  # the others of a box with ranges so many times as wide

    def __post_init__(self) -> None:
        E = self.environment
        if E.inputs != E.outputs:
            raise ValueError(f"environment is {E.outputs} x {E.inputs}, expected one force per contact")
        for name in ("theta", "psi", "lam"):
            object.__setattr__(self, name, _delays(name, getattr(self, name), E.inputs))
        object.__setattr__(self, "delta", dampings(self.delta, E.inputs))
        if min(self.delta) == 0:
            raise ValueError(f"delta is {list(self.delta)}, expected positive dampings in N s/m")
        ahead = [i for i, spare in enumerate(self.advance) if spare < 0]
        if ahead:
            i = ahead[0]
            limit = self.theta[i] + self.psi[i]
            raise ValueError(f"lam[{i}] is {self.lam[i]}, expected at most theta + psi = {limit} samples (7)")
        W1 = self.W1 or Lti.constant(np.eye(E.inputs), E.T)
        W2 = self.W2 or low_pass(E.inputs, E.T)
        object.__setattr__(self, "W1", W1)
        object.__setattr__(self, "W2", W2)
        _check_weights(W1, W2, E)
        check_passive(E)

    @property
    def channels(self) -> int:
        return self.environment.inputs

    @property
    def T(self) -> float:
        return self.environment.T

    @property
    def advance(self) -> tuple[int, ...]:
        """(N,) samples by which the round trip is later than the reference: the exponent of Psi Lambda^-1 Theta."""
        return tuple(t + p - n for t, p, n in zip(self.theta, self.psi, self.lam, strict=True))

    @property
    def delayed_environment(self) -> Lti:
        """Psi E."""
        return delay(self.psi, self.T) @ self.environment

    @property
    def usable(self) -> Array:
        """(N,) the damping that a design may spend [N s/m]."""
        return (1 - RESERVE) * np.asarray(self.delta)


def low_pass(channels: int, T: float, f0: float = 80.0) -> Lti:
    """w(z) I, the backward Euler discretisation of 1/(1 + s/(2 pi f0)), f0 in Hz (section 6 of the paper)."""
    a = 2 * np.pi * f0 * T
    gain, pole = a / (1 + a), 1 / (1 + a)
    one = np.eye(channels)
    return Lti(pole * one, one, gain * pole * one, gain * one, T)


def check_passive(E: Lti, tolerance: float = 1e-9) -> None:
    """Raise ValueError unless E z/(z-1), from displacement, is positive real and E(1) symmetric and >= 0."""
    if not E.is_stable():
        raise ValueError("environment is not passive: it has a pole on or outside the unit circle")
    static = E.dc()
    scale = np.abs(static).max() + np.abs(E.D).max()
    if np.abs(static - static.T).max() > tolerance * scale:
        raise ValueError("environment is not passive: its static stiffness E(1) is not symmetric")
    if np.linalg.eigvalsh((static + static.T) / 2)[0] < -tolerance * scale:
        raise ValueError("environment is not passive: its static stiffness E(1) has a negative direction")
    regular = regular_part(E)

    def active(w: Array) -> Array:
        return -np.linalg.eigvalsh(hermitian(regular.at(on_circle(w))))[:, 0]

    worst, w = supremum(active, np.concatenate([[0.0], frequencies(E)]))
    if worst > tolerance * scale:
        raise ValueError(f"environment is not passive: it produces energy at {w / (2 * np.pi * E.T):.4g} Hz")


def regular_part(E: Lti) -> Lti:
    """R + E(1)/2, where E z/(z-1) = E(1) z/(z-1) + R: stable where E is.

    The Hermitian part of z/(z-1) on the circle is 1/2, so this has the Hermitian part of E z/(z-1) there.
    """
    quotient = E.quotient_at_one()
    return Lti(E.A, E.B, quotient.C @ E.A, quotient.C @ E.B + E.dc() / 2, E.T)


def _delays(name: str, steps: Sequence[int], channels: int) -> tuple[int, ...]:
    if len(steps) != channels:
        raise ValueError(f"{name} has {len(steps)} entries for {channels} channels")
    if any(n != int(n) or n < 0 for n in steps):
        raise ValueError(f"{name} is {list(steps)}, expected whole numbers of samples, zero or more")
    return tuple(int(n) for n in steps)


def _check_weights(W1: Lti, W2: Lti, E: Lti) -> None:
    if W1.inputs != E.outputs or (W2.inputs, W2.outputs) != (E.inputs, E.inputs):
        raise ValueError(f"W1 and W2 must fit the {E.inputs} channels on the inside, W2 also on the outside")
    for name, W in (("W1", W1), ("W2", W2)):
        if not W.is_stable():
            raise ValueError(f"{name} has a pole on or outside the unit circle, so no norm is finite")
    z = on_circle(np.array([0.1, 1.0, 3.0]))
    response = W2.at(z)
    if np.abs(response - response * np.eye(E.inputs)).max() > 1e-9 * np.abs(response).max():
        raise ValueError("W2 must be diagonal: the convex-concave step divides by it channel by channel")
