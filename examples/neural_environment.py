"""Touch a recurrent network of random neurons: it has no model, and yet the energy given to hands is bounded by proof.

The network is behind a coupling certified for any passive environment. A shell makes the network passive: it scales the
forces so that they never give more than the budget beyond the energy that they took. A physics engine can replace the
network.
"""

import sys

import numpy as np

from haptic_loop import InputError, design_coupling, load, simulate

BUDGET, SECONDS, NEURONS = 0.01, 6.0, 32  # [J], [s]


class Network:
    """Maps the positions (2,) [m] of its contacts to forces (2,) [N], by neurons that never come to rest."""

    def __init__(self, seed: int = 3) -> None:
        rng = np.random.default_rng(seed)
        self.inward, self.outward = rng.normal(size=(NEURONS, 2)), rng.normal(size=(2, NEURONS))
        self.weights = 1.5 * rng.normal(size=(NEURONS, NEURONS)) / np.sqrt(NEURONS)  # a factor above 1 prevents rest
        self.activity = np.zeros(NEURONS)

    def __call__(self, u: np.ndarray) -> np.ndarray:
        self.activity = 0.9 * self.activity + 0.1 * np.tanh(self.weights @ self.activity + 200 * self.inward @ u)
        return self.outward @ self.activity


def main() -> None:
    scenario = load("omega-pair").replace(duration=SECONDS)
    design = design_coupling(scenario.loop("I"), "spring-damper", "any-environment")
    for budget in (1e9, BUDGET):
        trace = simulate(scenario, design, environment=Network(), energy_budget=budget)
        net, speed = trace.meta["energy_budget"], np.abs(trace.v_handle[trace.t > SECONDS - 2]).max()
        print(
            f"budget {budget:g} J: limited {net['limited_ticks']} of {net['ticks']} ticks, hands up to {speed:.3f} m/s"
        )
    print(f"guarantee: {net['guarantee']}")


if __name__ == "__main__":
    try:
        main()
    except InputError as error:
        sys.exit(f"error: {error}")
