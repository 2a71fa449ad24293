"""The loop-shaping objective of section 5 of the paper: ||W1 L W2||_inf with L = I + Psi E V - Psi Lambda^-1 Theta."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from controller.delay import delay
from controller.lti import Array, Lti
from design.frequency.sweep import frequencies, on_circle, supremum
from design.specification import Specification

Complex = NDArray[np.complex128]


class Shaping:
    """L (22) for one specification, evaluated fast for many couplings."""

    def __init__(self, spec: Specification) -> None:
        assert spec.W1 is not None  # the identity and a low-pass filter, where none were given
        assert spec.W2 is not None
        self.spec, self.W1, self.W2 = spec, spec.W1, spec.W2
        one = Lti.constant(np.eye(spec.channels), spec.T)
        self.late = one - delay(spec.advance, spec.T)  # I - Psi Lambda^-1 Theta
        self.environment = spec.delayed_environment

    def parts(self, w: Array) -> tuple[Complex, Complex, Complex]:
        """W1 Psi E, W2 and W1 (I - Psi Lambda^-1 Theta) at exp(jw), each (k, ., .)."""
        z = on_circle(w)
        W1 = self.W1.at(z)
        return W1 @ self.environment.at(z), self.W2.at(z), W1 @ self.late.at(z)

    def grid(self, *systems: Lti) -> Array:
        """Frequencies [rad/sample] from 0 to pi that resolve every pole of E, the weights and `systems`."""
        known = (self.environment, self.W1, self.W2, *systems)
        return np.concatenate([[0.0], frequencies(*known)])

    def gain(self, V: Lti, w: Array) -> Array:
        """sigma_max of W1 L W2 at exp(jw), shape (k,)."""
        left, right, late = self.parts(w)
        return np.linalg.norm((left @ V.at(on_circle(w)) + late) @ right, 2, axis=(1, 2))

    def norm(self, V: Lti) -> tuple[float, float]:
        """(||W1 L W2||_inf, the frequency where it is attained [rad/sample])."""
        return supremum(lambda w: self.gain(V, w), self.grid(V))
