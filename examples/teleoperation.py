"""Two robots joined by a position-position controller with delay: how much damping does each need, in any hands?

Robot 1 feels k (x1[n] - x2[n-d]), robot 2 feels k (x2[n] - x1[n-d]). The answer is k (d + 1) T for each robot.
"""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from haptic_loop import Loop, NoCoupling, SpringDamper, certify
from haptic_loop.controller.delay import delay
from haptic_loop.controller.environment import Environment
from haptic_loop.controller.lti import Lti

T, K, DELAYS = 1e-3, 500.0, range(9)  # [s], [N/m], [samples]


class PositionPosition(Environment):
    """E(z) = k [[1, -1/z^d], [-1/z^d, 1]]: the delay is in E, since each robot knows its own position at once."""

    contacts = ("robot 1", "robot 2")

    def __init__(self, k: float, d: int) -> None:
        self.k, self.d = k, d

    def E(self, T: float) -> Lti:
        swap = Lti.constant(np.eye(2)[::-1], T)
        return self.k * (Lti.constant(np.eye(2), T) - delay((self.d, self.d), T) @ swap)


def loop(d: int, damping: float) -> Loop:
    return Loop(T, (0, 0), (0, 0), (0, 0), (damping, damping), PositionPosition(K, d))


def main(out: Path = Path("out/teleoperation")) -> None:
    needs = [certify(loop(d, 1.0), NoCoupling())["this-environment"].required[0] for d in DELAYS]
    for d, need in zip(DELAYS, needs, strict=True):
        print(f"{d} samples: {need:.4f} N s/m for each robot; k (d + 1) T = {K * (d + 1) * T:.4f}")
    soft = certify(loop(4, 1.37), SpringDamper([300.0] * 2, [0.5] * 2))["this-environment"]
    print(f"4 samples, 1.37 N s/m, behind springs of 300 N/m with dampers: {soft}")
    figure = Figure((5, 3.2), layout="constrained")
    axis = figure.subplots()
    axis.plot(DELAYS, [K * (d + 1) * T for d in DELAYS], label="k (d + 1) T")
    axis.plot(DELAYS, needs, "o", label="certify")
    axis.set(xlabel="delay d [samples]", ylabel="damping of each robot [N s/m]")
    axis.legend()
    out.mkdir(parents=True, exist_ok=True)
    figure.savefig(out / "damping.png", dpi=130)


if __name__ == "__main__":
    main()
