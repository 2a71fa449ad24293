"""A force-feedback wheel whose game sends torques at 60 or 360 Hz: which delay theta describes a held torque?

With `unit = "rad"` wheel.toml has rad, N m, N m s/rad and kg m2 in place of m, N, N s/m and kg. A torque is computed
within a period of the game, which is n ticks of the wheel's 1 kHz loop, and held for the next period. Its mean age is
3 n/2 ticks. The hold of the 1 kHz loop adds half a tick itself, so theta = 3 n/2 - 1/2. The script judges the exact
loop, whose period is the game's (theta = 1); the 1 kHz loop with theta = 3 n/2 - 1/2 needs nearly the same damping.
"""

import math
import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from haptic_loop import Scenario, SpringDamper, certify, design_coupling, load

BASE = load(Path(__file__).with_name("wheel.toml"))
RIGID = SpringDamper([1e6], [0.0])  # so stiff that the loop is nearly that without a coupling


def theta_of(hertz: float) -> int:
    """Return the delay in ticks of 1 ms, rounded up, that describes torques held for a period of the game."""
    return math.ceil(1.5 / (hertz * BASE.T) - 0.5)


def needed(scenario: Scenario) -> float:
    """Return the damping [N m s/rad] that the stiffness of 20 N m/rad needs without a coupling."""
    return certify(scenario.loop("I"), RIGID)["this-environment"].required[0]


def main() -> None:
    figure, axis = plt.subplots(figsize=(6, 4), layout="constrained")
    hertz = np.geomspace(0.1, 20, 200)
    for rate, style in ((1000, "-"), (360, "--"), (60, "-")):
        game, theta = BASE.replace(T=1 / rate), theta_of(rate)
        at_1_khz = needed(BASE.replace(theta=(theta,)))
        bare = f"bare, it needs {needed(game):.4f} of 0.1 N m s/rad ({at_1_khz:.4f} at 1 kHz with theta)"
        loop = game.loop("I")
        felt = np.abs(loop.F(design_coupling(loop).coupling).at(np.exp(2j * np.pi * hertz / rate)))[:, 0, 0]
        print(f"{rate:4d} Hz: theta = {theta:2d}; {bare}; coupled, {felt[0]:.2f} of 20 N m/rad are felt")
        axis.semilogx(hertz, felt, style, label=f"{rate} Hz, theta = {theta}")
    axis.set(xlabel="frequency [Hz]", ylabel="felt stiffness [N m/rad]", title="Felt part of a spring of 20 N m/rad")
    axis.set_ylim(bottom=0)
    axis.legend()
    figure.savefig(sys.argv[1] if len(sys.argv) > 1 else "wheel.png", dpi=120)


if __name__ == "__main__":
    main()
