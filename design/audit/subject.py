"""What an audit is about: a coupling in its loop, judged by either condition and ready to be varied."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from controller.contact import held
from controller.coupling import Compliance, Coupling, NoCoupling, SpringDamper
from controller.environment import GROUND, Network, Spring, environment
from controller.lti import Lti, SingularLoop
from controller.process import force_map
from design.assess import closed_loop_of, theorem4_of
from design.jitter.multiplier import JitterProof, jitter_proof, jitter_refusal
from design.jitter.part import switching_requirement
from design.listed import listed
from design.margin import Requirement, closed_loop, refusal
from design.store import Condition, DelayRange, Loop

#: Beyond this many samples a sweep takes seconds, and no device's damping is enough.
LONGEST_DELAY = 100


@dataclass(frozen=True, eq=False)
class Subject:
    """A coupling between devices and an environment. Raises ValueError naming the field that is wrong."""

    coupling: Coupling
    network: Network | None  # None is a rigid wall behind the coupling, one channel
    T: float  # [s]
    theta: tuple[int, ...]  # (m,) transmission delays [samples]
    psi: tuple[int, ...]  # (m,) environment delays [samples]
    delta: tuple[float, ...]  # (m,) damping that the devices guarantee [N s/m]

    def __post_init__(self) -> None:
        for name in ("theta", "psi"):
            if not all(0 <= n <= LONGEST_DELAY for n in getattr(self, name)):
                raise ValueError(f"{name} is {listed(getattr(self, name))}, allowed are 0 to {LONGEST_DELAY} samples")
        if not all(0 < d < np.inf for d in self.delta):
            raise ValueError(f"delta is {listed(self.delta)}, expected positive dampings in N s/m")
        if self.network is None and not isinstance(self.coupling, SpringDamper):
            raise ValueError("a rigid wall needs a spring-damper in front of it")
        if self.network is None and any(self.psi):
            raise ValueError(
                f"psi is {listed(self.psi)}: behind a rigid wall no loop with a delayed environment is stable"
            )

    @property
    def channels(self) -> int:
        return len(self.delta)

    @property
    def walls(self) -> bool:
        """Whether contact is made and broken."""
        return self.network is not None and bool(self.network.walls)

    @property
    def F(self) -> Lti:
        """What the devices see (6), walls touching; against a rigid wall (E -> infinity) that is Theta V^-1.

        Raises SingularLoop.
        """
        if self.network is not None:
            return force_map(environment(held(self.network), self.T), self.coupling, self.theta, self.psi)
        assert isinstance(self.coupling, SpringDamper)
        (K,), (B,) = self.coupling.K.tolist(), self.coupling.B.tolist()
        clamped = Network(("contact",), (Spring(("contact", GROUND), K, B),))
        return force_map(environment(clamped, self.T), NoCoupling(), self.theta, self.psi)

    @property
    def G(self) -> Lti:
        """The forces as they leave for the devices: F without Theta. Raises SingularLoop."""
        return replace(self, theta=(0,) * self.channels).F

    def switching(self, span: DelayRange) -> JitterProof:
        """The damping that any switching of the forces' delays within this range asks of the devices."""
        if self.network is not None and not self.walls:
            loop = Loop(self.T, self.theta, self.psi, self.theta, self.delta, self.network, jitter=span)
            return switching_requirement(loop, self.coupling)
        try:
            return jitter_proof(self.G, span.lo, span.hi, self.delta)
        except SingularLoop as error:
            return jitter_refusal(self.delta, str(error))

    def requirement(self, condition: Condition) -> Requirement:
        """The damping that the condition asks of the devices."""
        return self._closed_loop() if condition == "closed-loop" else self._theorem4()

    def with_period(self, T: float) -> Self:
        """The same gains (of a state-space coupling: the same coefficients) and delays in samples at another T [s]."""
        coupling = self.coupling
        if isinstance(coupling, Compliance):
            coupling = Compliance(replace(coupling.V, T=T))
        return replace(self, coupling=coupling, T=T)

    def with_gains(self, K: ArrayLike, B: ArrayLike) -> Self:
        """The same loop with another spring-damper [N/m, N s/m]."""
        return replace(self, coupling=SpringDamper(K, B))

    def _closed_loop(self) -> Requirement:
        try:
            if self.network is None:
                return closed_loop(self.F, self.delta)
            return closed_loop_of(self.network, self.T, self.coupling, self.theta, self.psi, self.delta)
        except SingularLoop as error:
            return refusal("closed-loop", self.delta, str(error))

    def _theorem4(self) -> Requirement:
        # what is behind a wall's coupling does not matter to Theorem 4
        network = self.network or Network(("contact",), masses={"contact": 1.0})
        return theorem4_of(network, self.T, self.coupling, self.theta, self.psi, self.delta)
