"""PYTHONPATH=. python tests/benchmarks/still_holds.py [N]: is a hand that holds still ever taken for a dead encoder?

N (default 10,000) holds of 1.2 s are simulated by plain integration of a mass, a damper and a spring, without the
emulator. All values are random. The hand has 0.05 to 2 kg, 2 to 60 N s/m, 100 to 3000 N/m, and a tremor of up to 0.2 N
at 8 to 12 Hz. The device has 0.2 to 0.5 kg, up to 0.3 N of dry friction, and an encoder of 1 to 100 um with a random
origin. The hand resists the force of a partner: up to 6 N at 0.3 to 8 Hz, as a sine or in steps.
"""

import sys

import numpy as np

from haptic_loop.hw.encoders import CheckedAxes, EncoderMonitor
from haptic_loop.hw.limits import SafetyLimits, Units
from haptic_loop.hw.protocol import SafetyStop

T, TICKS, SUBSTEPS = 1.2e-3, 1000, 8
FORCE_STEP = 4e-4  # [N]
SLIP = 1e-4  # [m/s] speed at which dry friction is at 3/4


def still_holds(holds: int, seed: int = 0) -> tuple[int, int]:
    """Return how many of the holds are stopped, and in how many the force changes by more than 1 N."""
    rng = np.random.default_rng(seed)

    def draw(low: float, high: float) -> np.ndarray:
        return np.exp(rng.uniform(np.log(low), np.log(high), holds))

    mass, damping, stiffness = rng.uniform(0.2, 0.5, holds) + draw(0.05, 2.0), draw(2, 60), draw(100, 3000)
    tremor, tremor_hz = rng.uniform(0, 0.2, holds), rng.uniform(8, 12, holds)
    friction, step, origin = rng.uniform(0, 0.3, holds), draw(1e-6, 1e-4), rng.uniform(size=holds)
    force, hz, phase = rng.uniform(0.6, 6.0, holds), draw(0.3, 8.0), rng.uniform(0, 2 * np.pi, holds)
    steps = rng.random(holds) < 0.3
    x, v = np.zeros(holds), np.zeros(holds)
    counts, applied = np.empty((TICKS, holds), int), np.empty((TICKS, holds), int)
    h = T / SUBSTEPS
    for k in range(TICKS):
        wave = np.sin(2 * np.pi * hz * k * T + phase)
        applied[k] = np.round(force * np.where(steps, np.sign(wave), wave) / FORCE_STEP)
        counts[k] = np.round(x / step + origin)
        for i in range(SUBSTEPS):
            shake = tremor * np.sin(2 * np.pi * tremor_hz * (k * T + i * h))
            dry = friction * np.tanh(v / SLIP)
            push = applied[k] * FORCE_STEP + shake - dry - damping * v - stiffness * x
            v += h * push / (mass + h * friction / SLIP)
            x += h * v
    changing = int((np.ptp(applied * FORCE_STEP, axis=0) > 1.0).sum())
    stopped = (_stopped(counts[:, i].tolist(), applied[:, i].tolist(), step[i]) for i in range(holds))
    return sum(stopped), changing


def _stopped(counts: list[int], applied: list[int], step: float) -> bool:
    units = Units((step,), (FORCE_STEP,), (10**6,))
    monitor = EncoderMonitor(CheckedAxes(SafetyLimits((12.0,)), units, T, (1,)))
    try:
        for n, force in zip(counts, applied, strict=True):
            monitor.check((n,), (force,), 1)
    except SafetyStop:
        return True
    return False


if __name__ == "__main__":
    stopped, changing = still_holds(int(sys.argv[1]) if sys.argv[1:] else 10_000)
    print(f"{stopped} holds were stopped; in {changing} holds the force changed by more than 1 N")
