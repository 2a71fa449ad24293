"""Other tools simulate the same loop, so that costs can be compared; tools that are not installed are skipped."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest

from haptic_loop.controller.coupling import PUBLISHED
from haptic_loop.sim.run import assemble, outside_forces
from haptic_loop.sim.scenario import load

_path = Path(__file__).parents[1] / "benchmarks/peers.py"
_spec = importlib.util.spec_from_file_location("peers", _path)
assert _spec
assert _spec.loader
peers = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(peers)

#: tool -> allowed relative rms error of positions and forces in a transient run, and the package that it needs; the
#: error is rounding, or that of the tool's integrator
ALLOWED = {
    "exponential x 1": (1e-11, None),
    "RK4 x 4": (1e-5, None),
    "Drake, RK3 x 4": (1e-3, "pydrake"),
    "Drake, discrete x 12": (1e-2, "pydrake"),
    "python-control, nonlinear": (1e-11, "control"),
    "scipy dlsim, no limits": (1e-11, None),
    "a plain NumPy loop": (1e-11, None),
}


@pytest.fixture(scope="module")
def loop():
    simulation = assemble(load().replace(duration=0.3), PUBLISHED["I"])
    w = outside_forces(simulation.scenario, simulation.scene, 0, simulation.scenario.samples)
    w[5:30, simulation.scene.tapped[0]] += 1.0
    return simulation, w, peers.PEERS["exact"](simulation, w)


def test_every_peer_has_an_allowed_error():
    assert set(ALLOWED) | {"exact"} == set(peers.PEERS)


@pytest.mark.filterwarnings("default")  # the tools emit warnings
@pytest.mark.parametrize("name", ALLOWED)
def test_peers_simulate_the_same_loop(loop, name):
    allowed, needed = ALLOWED[name]
    if needed:
        pytest.importorskip(needed, reason=f"{needed} is no dependency: this test runs if it is installed")
    simulation, w, (z, s, f) = loop
    others_z, others_s, others_f = peers.PEERS[name](simulation, w)
    assert (others_z.shape, others_s.shape, others_f.shape) == (z.shape, s.shape, f.shape)
    m = f.shape[1]
    for own, exact in ((others_s[:, :m], s[:, :m]), (others_f, f)):
        assert np.sqrt(np.mean((own - exact) ** 2) / np.mean(exact**2)) <= allowed
