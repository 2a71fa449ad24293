"""Compare classic passivity layers (PO/PC, energy bounding) with our couplings, in half a minute.

error %     rms error of the applied force, relative to the ideal force
> 40 Hz N   rms of the force above 40 Hz
peak N      largest force
acted %     share of ticks in which the layer changed a force
hands       of 100 pairs of lossless hands that start at 0.1 m/s, those that are faster in the tenth second
m/s         largest speed of these pairs in the tenth second
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from haptic_loop import design_coupling, load
from haptic_loop.controller.budget import NetFigures
from haptic_loop.controller.coupling import NoCoupling
from haptic_loop.models.hold import hold
from haptic_loop.models.scene import Crowd, variants
from haptic_loop.sim.accuracy import ForceError, force_error
from haptic_loop.sim.couplings import assessed, given
from haptic_loop.sim.engines import ExactEngine
from haptic_loop.sim.passivity_layer import EnergyNet, netted
from haptic_loop.sim.run import assemble, run, run_blocks

PAIRS, SECONDS, SLOW = 100, 10.0, 0.1  # pairs of lossless hands, duration of a run [s], speed at the start [m/s]


class PassivityControl:
    """Passivity observer and series controller (Hannaford and Ryu, IEEE Trans. Robotics and Automation 18, 2002).

    The observer adds up f dx; when the sum is negative, a damper dissipates the deficit in one tick. We added `delta`
    (m,) [N s/m], the devices' damping, which the sum then counts. The damper acts at the devices, behind the delays.
    """

    at_device = True

    def __init__(self, m: int, T: float, delta: Any = 0.0, nsim: int = 1) -> None:
        self.credit, self.energy = np.broadcast_to(np.asarray(delta, float), (m,))[:, None] / T, np.zeros((m, nsim))

    def limit(self, wanted: np.ndarray, dx: np.ndarray) -> np.ndarray:
        """Return the force to apply (m, nsim) [N], for the force `wanted` and the last tick's displacement dx [m]."""
        self.energy += wanted * dx + self.credit * dx**2
        missing = np.maximum(-self.energy, 0.0)
        damper = np.divide(missing, dx**2, out=np.zeros_like(dx), where=dx != 0)
        self.energy += damper * dx**2
        return wanted + damper * dx


class EnergyBounding:
    """Energy bounding on each channel, made for loops without delay (Kim and Ryu, Int. J. Robotics Research 29, 2010).

    f = f_- + b dx with the last force f_- and b between -c1 - 2 f_-/dx and c1, that is, |f| <= |f_- + c1 dx|. Here
    c1 = 2 delta/T.
    """

    at_device = False

    def __init__(self, m: int, T: float, delta: Any, nsim: int = 1) -> None:
        self.c1, self.force = 2 * np.broadcast_to(np.asarray(delta, float), (m,))[:, None] / T, np.zeros((m, nsim))

    def limit(self, wanted: np.ndarray, dx: np.ndarray) -> np.ndarray:
        """Return the force to send (m, nsim) [N] for the `wanted` force [N] and the last tick's displacement dx [m]."""
        most = np.abs(self.force + self.c1 * dx)
        self.force = np.where(dx == 0, self.force, np.clip(wanted, -most, most))
        return self.force.copy()


class _Layer:
    """A passivity layer in the simulated loop; its law receives forces within the motors' limits."""

    def __init__(self, law: Any, within: Any) -> None:
        self.law, self.within, self.x, self.acted, self.ticks = law, within, None, 0, 0

    def _limited(self, force: np.ndarray) -> None:
        before, self.ticks = force.copy(), self.ticks + 1
        force[...] = self.law.limit(before, self.dx)
        self.acted += bool((force != before)[:, 0].any())

    def send(self, x: np.ndarray, force: np.ndarray, /) -> None:
        self.dx, self.x = x - (x if self.x is None else self.x), x.copy()
        force[...] = self.within(force)
        if not self.law.at_device:
            self._limited(force)

    def apply(self, k: int, force: np.ndarray, /) -> None:
        if self.law.at_device:
            self._limited(force)

    def figures(self) -> NetFigures:
        return NetFigures(guarantee=None, ticks=self.ticks, limited_ticks=self.acted)


@dataclass(frozen=True)
class Classic:
    """The settings from which `netted` makes a passivity layer; with `credited` its law counts the devices' damping."""

    kind: type
    credited: bool = True

    def net(self, simulation: Any, process: Any, nsim: int) -> _Layer:
        """Return a new layer."""
        loop = simulation.loop
        law = self.kind(len(loop.delta), loop.T, loop.delta if self.credited else 0.0, nsim=nsim)
        return _Layer(law, process.applied)


ROWS: dict[str, Any] = {
    "none, clipped": None,
    "PO/PC": Classic(PassivityControl, credited=False),
    "PO/PC with delta": Classic(PassivityControl),
    "energy bounding": Classic(EnergyBounding),
    "energy budget": EnergyNet(0.0),
    "spring-damper, any-environment": ("spring-damper", "any-environment"),
    "spring-damper, this-environment": ("spring-damper", "this-environment"),
    "optimal, this-environment": ("optimal", "this-environment"),
}


def row(layer: Any) -> tuple[float | None, float, float, float, int, float]:
    """Return the figures of one row of ROWS, in the order of the columns."""
    scenario = load("omega-pair")
    design = design_coupling(scenario.loop("I"), *layer) if isinstance(layer, tuple) else None
    coupling = design.coupling if design else NoCoupling()
    loop = assemble(scenario, coupling, assessed(scenario, "I", given(design)).force_limits.rho if design else None)
    if layer and not design:
        loop = netted(loop, layer, max(scenario.samples, round(SECONDS / scenario.T)))
    trace = run(loop, "exact")
    error = ForceError.of(trace.f, force_error(loop, trace, scenario.loop("I").lam).ideal, None).error_percent
    spectrum = np.fft.rfft(trace.f, axis=0)
    spectrum[np.fft.rfftfreq(len(trace.f), scenario.T) < 40.0] = 0
    fast = float(np.sqrt(np.mean(np.fft.irfft(spectrum, len(trace.f), axis=0) ** 2)))
    acted = 100 * trace.net.figures().limited_ticks / len(trace.t) if trace.net else 0.0
    return error, fast, float(np.abs(trace.f).max()), acted, *left_alone(loop)


def left_alone(loop: Any) -> tuple[int, float]:
    """Return how many pairs of lossless hands exceed SLOW in the last second, and their top speed [m/s] in it."""
    scenario, rng, shape = loop.scenario, np.random.default_rng(1), (PAIRS, loop.scenario.channels, 2)
    mass, stiffness = (np.exp(rng.uniform(*np.log(span), shape)) for span in ((0.01, 3.0), (1.0, 1e4)))
    crowd = variants(scenario.device, Crowd(np.stack([mass, np.zeros_like(mass), stiffness], axis=-1)))
    plants, ticks = hold(crowd.plants(), scenario.T), round(SECONDS / scenario.T)
    half, start = plants.A.shape[-1] // 2, np.zeros((plants.A.shape[-1], PAIRS))
    start[half:] = SLOW * rng.choice([-1.0, 1.0], (1, PAIRS))
    fastest = np.zeros(PAIRS)

    def watch(buffer: Any, first: int, count: int) -> bool:
        if first >= ticks - round(1 / scenario.T):
            speed = np.abs(buffer.s[:count, half:]).max(axis=(0, 1))
            np.maximum(fastest, np.where(np.isfinite(speed), speed, np.inf), out=fastest)
        return False

    outside = plants.B.shape[-1] - scenario.channels
    run_blocks(loop.process, ExactEngine(plants), lambda at, n: np.zeros((n, outside)), ticks, start, watch)
    return int((fastest > SLOW).sum()), float(fastest.max())


def main() -> None:
    print(f"{'':32}{'error %':>9}{'> 40 Hz N':>11}{'peak N':>8}{'acted %':>9}{'hands':>7}{'m/s':>8}")
    for name, layer in ROWS.items():
        error, fast, peak, acted, moving, fastest = row(layer)
        print(f"{name:32}{error:9.2f}{fast:11.3f}{peak:8.1f}{acted:9.0f}{moving:7}{fastest:8.3f}")


if __name__ == "__main__":
    main()
