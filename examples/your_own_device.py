"""Rehearse a session of the bridge with an emulator of your device, over the real protocol.

The session runs in virtual time: handshake, measurement of the delay, design for it, arming, run, ramp to zero.
"""

import sys

import numpy as np

from haptic_loop import RIGID_WALL, InputError, Loop, RigidDevice, SpringDamper, certify, load, rehearse

# put your numbers here: [kg], [N s/m], [N], [m]
MINE = {"mass": 0.18, "damping": 0.9, "force_limit": 6.0, "encoder_step": 2e-6}
SECONDS = 2.0


def _wall(delay: float | None) -> float:
    """Return the damping [N s/m] that a wall of 1000 N/m needs with this delay [s]; None is a delay of one sample."""
    theta, latency = ((1,), None) if delay is None else ((0,), ((delay, delay),))
    wall = Loop(1.2e-3, theta, (0,), theta, (MINE["damping"],), RIGID_WALL, latency=latency)
    return certify(wall, SpringDamper([1000.0], [0.0]))["this-environment"].required[0]


def main() -> None:
    device = RigidDevice(**MINE)
    scenario = load("omega-pair").replace(T=1e-3, theta=(0, 0), device=(device, device))
    session = rehearse(scenario, seconds=SECONDS, latch_on_arrival=True)  # False: forces wait for the next tick
    if session.result is None or session.zero_after is None:
        raise InputError(f"no force was ever felt: the session was {session.stage}, {session.cause}")
    needs = session.assessment.requirements["this-environment"]
    delay, late = 1e6 * (session.delay or 0.0), [1e6 * tau for tau in session.latency or ()]
    print(f"measured: {delay:.0f} us from sample to force; spring-damper for {late[0]:.0f} to {late[1]:.0f} us")
    print(f"needs {max(needs.required):.4f} of {min(needs.available):.2f} N s/m: certified = {needs.certified}")
    print(
        f"a wall of 1000 N/m at 1.2 ms needs {_wall(session.delay):.4f} N s/m, "
        f"and {_wall(None):.4f} N s/m with a delay of one sample"
    )
    moved = np.abs(session.result.x).max()
    print(f"{len(session.result.t)} ticks, ended {session.stage}; handles moved up to {1e3 * moved:.1f} mm")
    print(f"zero force {1e3 * session.zero_after:.1f} ms after the stop request")


if __name__ == "__main__":
    try:
        main()
    except (TypeError, ValueError) as error:  # MINE has a number that no device or no certificate allows
        sys.exit(f"error: {error}")
