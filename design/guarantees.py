"""Words for guarantees, and the Coulomb friction that encoder steps need."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from haptic_loop.controller.coupling import Coupling
from haptic_loop.controller.loop import Loop
from haptic_loop.design.conditions import encoder_friction

ANY, RANGES, HERE = "any passive environment", "these ranges", "this environment"
AT_VERTICES = "these ranges: proved at the vertices, searched between them"  # RANGES in words


#: limits of every certificate
CAVEATS = (
    "The proofs are for the linear loop: they hold while forces stay below their limits (clipped ticks are counted) "
    "or leave through the limiter that a report names, "
    "not for periods longer than the loop's T_max (T where it has none), encoder steps beyond what Coulomb "
    "friction pays for, velocity filters or friction compensation."
)


@dataclass(frozen=True)
class EncoderSteps:
    """Comparison of declared Coulomb friction with the friction that dissipates the work of encoder steps."""

    encoder_step: tuple[float, ...]  # (m,) [m]
    friction: tuple[float, ...]  # (m,) [N] declared by the devices as a lower bound
    friction_max: tuple[float | None, ...]  # (m,) [N] published upper bounds, which are reported only
    friction_needed: tuple[float, ...] | None  # (m,) [N]; None with walls, where nothing is proved
    covered: bool
    words: str

    @classmethod
    def of(
        cls,
        loop: Loop,
        coupling: Coupling,
        steps: Sequence[float],
        friction: Sequence[float],
        friction_max: Sequence[float | None] | None = None,
    ) -> EncoderSteps | None:
        """Compare the declared friction (m,) [N] with that needed for encoder steps (m,) [m]; None without steps.

        `friction_max` (m,) [N] are published upper bounds, which are reported only.
        """
        if not any(steps):
            return None
        widths = ", ".join(f"{1e6 * q:.4g}" for q in steps)
        published = tuple(friction_max or [None] * len(steps))
        values = tuple(steps), tuple(friction), published
        if loop.environment.walls:
            return cls(*values, None, False, f"encoder steps of {widths} um: with walls nothing is proved of them")
        needed = encoder_friction(loop.F(coupling), steps, loop.axes or ())
        covered = bool((needed <= np.asarray(friction)).all())
        amounts, has = (", ".join(f"{f:.4g}" for f in some) for some in (needed, friction))
        verdict = "are covered while forces stay below the limits" if covered else "are not covered"
        if any(most is not None for most in published):
            bounds = ", ".join("-" if most is None else f"{most:.4g}" for most in published)
            has = f"at least {has} N (published: at most {bounds} N)"
        else:
            has += " N"
        enough = f"friction of {amounts} N is enough for {widths} um, the devices declare {has}"
        return cls(*values, tuple(needed.tolist()), covered, f"encoder steps {verdict}: {enough}")


def held_torques(loop: Loop) -> str | None:
    """Return the remark that conditions ignore the change of pose while torques are held; None without `loop.axes`."""
    return "not charged: forces count as held in space while the pose moves on" if loop.axes else None
