"""Virtual couplings: what stands between the devices and the environment.

V maps force to displacement (a compliance) and sits in negative feedback around Psi E, so that the
environment sees u = x - V f. A coupling is anything that turns Psi E into G = (I + Psi E V)^-1 Psi E.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from controller.lti import Array, Lti, frozen


class Coupling(Protocol):
    """Anything that can be closed around the (delayed) environment."""

    def around(self, environment: Lti, further: int = 0) -> Lti:
        """(I + Psi E V)^-1 Psi E, given Psi E, whose last `further` ports lie behind no coupling."""
        ...


@dataclass(frozen=True)
class NoCoupling:
    """V = 0: the devices touch the environment directly."""

    def around(self, environment: Lti, further: int = 0) -> Lti:
        return environment


@dataclass(frozen=True, eq=False)
class SpringDamper:
    """V = [K + B (z-1)/(Tz)]^-1, one spring and damper per channel (26)."""

    K: Array  # (m,) [N/m]
    B: Array  # (m,) [N s/m]

    def __post_init__(self) -> None:
        for name in "KB":
            object.__setattr__(self, name, frozen(getattr(self, name), 1))
        if self.K.shape != self.B.shape:
            raise ValueError(f"K has {self.K.size} channels and B has {self.B.size}; give one of each per device")
        if not (np.isfinite(self.K).all() and (self.K > 0).all()):
            raise ValueError(f"K is {self.K.tolist()}, expected positive stiffnesses in N/m")
        if not (np.isfinite(self.B).all() and (self.B >= 0).all()):
            raise ValueError(f"B is {self.B.tolist()}, expected dampings >= 0 in N s/m")

    def channels(self, T: float) -> list[Lti]:
        """V_i(z): y = (f + (B/T) y-) / (K + B/T), with a state only where there is a damper."""
        return [_spring_damper(k, b, T) for k, b in zip(self.K, self.B, strict=True)]

    def compliance(self, T: float) -> Lti:
        """V(z), diagonal."""
        return Lti.diag(*self.channels(T))

    def around(self, environment: Lti, further: int = 0) -> Lti:
        return Compliance(self.compliance(environment.T)).around(environment, further)


@dataclass(frozen=True, eq=False)
class Compliance:
    """A general V(z), given as a state-space block."""

    V: Lti

    def around(self, environment: Lti, further: int = 0) -> Lti:
        contacts = environment.inputs - further
        if self.V.inputs != environment.outputs - further or self.V.outputs != contacts:
            channels = f"{self.V.outputs} x {self.V.inputs}"
            raise ValueError(f"the coupling is {channels}, the environment has {contacts} contacts")
        V = Lti.diag(self.V, Lti.constant(np.zeros((further, further)), self.V.T)) if further else self.V
        return environment.feedback(V)


def _spring_damper(k: float, b: float, T: float) -> Lti:
    gain = 1.0 / (k + b / T)
    if b == 0:
        return Lti.constant([[gain]], T)
    memory = gain * b / T
    return Lti([[memory]], [[gain]], [[memory]], [[gain]], T)
