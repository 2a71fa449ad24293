"""Loops, couplings, transfer functions written out by hand, and a serial line, for many tests."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest

from haptic_loop.controller.coupling import ForceFilter, SpringDamper
from haptic_loop.controller.delay import delay
from haptic_loop.controller.environment import Network, Spring, environment
from haptic_loop.controller.loop import Loop
from haptic_loop.controller.lti import Lti

#: Figure 4 of the paper as we read it: contact 1 -(K1, B1)- M -(K2, B2)- contact 2, with a free mass M
FIGURE_4 = Network(
    contacts=("contact 1", "contact 2"),
    springs=(
        Spring(("contact 1", "mass"), stiffness=800.0, damping=1.0),
        Spring(("mass", "contact 2"), stiffness=700.0, damping=1.0),
    ),
    masses={"mass": 1.0},
)


def checkered(*sides):
    """Return all combinations of a value from each of `sides` as parameters. Every second runs in `make validate` only.

    `make test` runs every second one, like the fields of one colour on a chess board: each value occurs.
    """
    marks = ((), pytest.mark.validate)
    places = product(*(enumerate(side) for side in sides))
    return [pytest.param(*(v for _, v in place), marks=marks[sum(i for i, _ in place) % 2]) for place in places]


T = 1.2e-3  # [s]
DELTA = (1.37, 1.37)  # [N s/m]
#: the default scenario, case I
PAIR = Loop(T, (1, 2), (0, 0), (1, 2), DELTA, FIGURE_4)


def pair(lam=(1, 2), network=FIGURE_4, theta=(1, 2), psi=(0, 0), delta=DELTA, period=T) -> Loop:
    """Return a loop of two devices, by default `PAIR`."""
    return Loop(period, theta, psi, lam, delta, network)


def at_springs(K, B=0.0, theta=0, delta=1.37, period=T, channels=1) -> Loop:
    """Return a loop of equal channels, each at a spring and a damper to ground."""
    contacts, late = tuple("abcd"[:channels]), (theta,) * channels
    springs = tuple(Spring((contact, "ground"), K, B) for contact in contacts)
    return Loop(period, late, (0,) * channels, late, (delta,) * channels, Network(contacts, springs))


#: a scenario of one device at a mass of 1 kg on a spring, two samples late
ONE_MASS = """
name = "one-mass"
T = 1.2e-3
theta = [2]
psi = [0]
device = [{ kind = "compliant", damping = 1.37, force_limit = 12.0 }]

[[human]]
links = [{ mass = 0.3, damping = 3.0, stiffness = 200.0 }]
voluntary = { amplitude = 0.015, frequency = 0.6 }

[environment]
contacts = ["contact 1"]
masses = { mass = 1.0 }
springs = [
    { between = ["contact 1", "mass"], stiffness = 800.0, damping = 1.0 },
    { between = ["mass", "ground"], stiffness = 700.0, damping = 1.0 },
]
"""
#: certified for the default environment and the constant delays (1, 2) only
STIFF = SpringDamper((7806.0, 3137.0), (0.105, 1.68))
#: certified for every passive environment; needs 1.078 N s/m in Figure 4 with delays that switch within [1, 2]
SOFT = SpringDamper((878.767, 551.883), (0.386476, 0.521984))
#: Figure 4 with springs that are four times softer
SOFT_NETWORK = Network(
    ("contact 1", "contact 2"),
    (Spring(("contact 1", "mass"), 200.0, 0.25), Spring(("mass", "contact 2"), 175.0, 0.25)),
    {"mass": 1.0},
)
#: a filter with a resonance at 41 rad/s: certified at the vertices of omega-pair-ranges, but not between them
VERTICES_ONLY = ForceFilter(
    (),
    [(-1.986289, 0.988713)],
    [np.diag(row) for row in ((0.152927, 0.138856), (0.48123, -0.085068), (-0.495127, 0.085242))],
)


def force_map(E, coupling, theta, psi):
    """Return F = Theta (I + Psi E V)^-1 Psi E (6) of an environment E(z)."""
    return delay(theta, E.T) @ coupling.around(delay(psi, E.T) @ E)


def undelayed_map(coupling) -> Lti:
    """Return the force map of Figure 4 with this coupling, without delays."""
    return force_map(environment(FIGURE_4, T), coupling, (0, 0), (0, 0))


def walled(loop, coupling, exact=False):
    """Return F with ports for the walls, from [x; p] to [f; y], with their forces p and the displacements y there."""
    T, walls = loop.period(exact), len(loop.environment.walls)
    late = Lti.diag(delay(loop.theta, T), Lti.constant(np.eye(walls), T))
    return late @ loop.walled_before_delay(coupling, exact)


def loop_of(network, theta, psi, period: float = T) -> Loop:
    """Return a loop whose damping and reference are arbitrary, because a tick does not depend on them."""
    return Loop(period, tuple(theta), tuple(psi), (0,) * len(theta), (1.0,) * len(theta), network)


def environment_by_hand(network: Network, z: np.ndarray, period: float = T) -> np.ndarray:
    """Return E(z) (k, m, m) at k points z: M s^2 + D s + K with the single inner node eliminated."""
    (M, D, K), m = network.matrices(), len(network.contacts)
    s = ((z - 1) / (period * z))[:, None, None]
    Z = M * s**2 + D * s + K
    return Z[:, :m, :m] - Z[:, :m, m:] @ Z[:, m:, :m] / Z[:, m:, m:]


def filter_by_hand(coupling: ForceFilter, z: np.ndarray) -> np.ndarray:
    """Return R(z) (k, m, m) at k points z, from the definition of its basis."""
    R, through = coupling.R[0].astype(complex), np.ones_like(z)
    for a, coefficient in zip(coupling.poles, coupling.R[1:], strict=False):
        R = R + coefficient * (through * (1 - a) / (z - a))[:, None, None]
        through = through * (1 - a * z) / (z - a)
    rest = coupling.R[1 + coupling.poles.size :]
    for (b1, b2), first, second in zip(coupling.pairs, rest[::2], rest[1::2], strict=True):
        section = (through * (1 + b1 + b2) / (z * z + b1 * z + b2))[:, None, None]
        R = R + (first * z[:, None, None] + second) * section
        through = through * (b2 * z * z + b1 * z + 1) / (z * z + b1 * z + b2)
    return R


def contact_by_hand(z, T, mass=0.0, stiffness=0.0, damping=0.0, coupling=None):
    """Return F, J, H and Y (k,) at k points z: the responses of a tip that a spring-damper coupling holds.

    F and J map a device's displacement and a wall's force at the tip to the sent force; H and Y map them to the tip's
    displacement. The tip has a mass [kg], and a spring [N/m] and a damper [N s/m] to ground.
    """
    s = (1 - 1 / z) / T
    E = mass * s**2 + damping * s + stiffness
    V = 0 * z if coupling is None else 1 / (coupling.K[0] + coupling.B[0] * s)
    through = 1 / (1 + E * V)
    return E * through, through, through, -V * through


def block_by_hand(z, T, theta, contact, cost, beta=0.0, wall=None, limiter=None):
    """Return the Hermitian block (k, n, n) of one device, as docs/theory.md states its quadratic form.

    Args:
        z: Points of the unit circle, (k,).
        T: Period [s].
        theta: Delay [samples].
        contact: The responses of `contact_by_hand`.
        cost: The least dissipated energy, as a matrix on dx (k, 1, 1), or on dx and the speed v (k, 2, 2).
        beta: Theorem B's beta [s]; 0 without v.
        wall: Stiffness k and damping of a damped wall, and its multipliers a, a + c, d and m.
        limiter: The limiter's rho and its multiplier c.
    """
    names = ["dx", *(["v"] if cost.shape[1] == 2 else []), *(["de"] if limiter else []), *(["u", "s"] if wall else [])]
    rows = np.eye(len(names))[:, None] + 0j * z[:, None]  # (n, k, n)
    of = {"de": 0j * rows[0]} | dict(zip(names, rows, strict=True))
    z = z[:, None]
    F, J, H, Y = (part[:, None] for part in contact)
    dx = of["dx"] + of["de"]  # The first input is the displacement less the limiter's slip.
    sent, terms = F * of["dx"] / (z - 1), []
    if wall:
        k, b = wall[0], wall[1] / T
        a, both, d, m = wall[2:]
        W = k + b * (1 - 1 / z)
        sent = sent + J * (W * of["u"] / (z - 1) + b / z * of["s"])
        apart = H * of["dx"] + Y * (W * of["u"] + (W - k) * of["s"]) - of["u"]  # steps of y less those of the depth
        terms.append((of["u"], (k / (z - 1) - a) * apart - m * ((k + b) / z - b) * of["s"]))
        terms.append((of["s"], (both - a) * apart + d * of["u"] + (d + m * b * (1 - 1 / z)) * of["s"]))
    if limiter:
        rho, c = limiter
        sent = sent - rho / z * of["de"]
        terms.append((-of["de"], (z + c * (z - 1)) * sent))
    moved = dx + (beta * (z - 1) * of["v"] if "v" in of else 0)
    terms.append((moved, z**-theta * sent))
    inputs = np.stack([dx, of["v"]] if "v" in of else [dx], axis=1)
    block = sum(np.conj(one)[:, :, None] * other[:, None] for one, other in terms)
    block = (block + np.conj(np.swapaxes(block, 1, 2))) / 2
    return block + np.conj(np.swapaxes(inputs, 1, 2)) @ cost @ inputs


def least_scaled(block: np.ndarray) -> float:
    """Return the least eigenvalue of matrices (k, n, n), each scaled to a diagonal of ones."""
    size = np.sqrt(np.abs(np.diagonal(block, axis1=1, axis2=2)))
    return float(np.linalg.eigvalsh(block / size[:, :, None] / size[:, None])[:, 0].min())


class FakePort:
    """The host's end of a serial line: `coming` will be read, `sent` was written, `now` is the host's clock [us]."""

    def __init__(self):
        self.coming, self.sent, self.now = b"", b"", 0

    def wait(self, seconds):
        self.now += 0 if self.coming else round(1e6 * seconds)
        return bool(self.coming)

    def read(self):
        data, self.coming = self.coming, b""
        return data

    def write(self, data):
        self.sent += data
        return len(data)

    def discard(self):
        self.coming = b""
