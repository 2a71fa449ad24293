"""Check three laws on random loops: `make validate`.

An exact proof succeeds if and only if the sweep requires less damping than is available. The verdict of a simulated
trace never contradicts the eigenvalues; if nothing excites the deciding mode, the verdict says so. In a slow loop with
fifty hands, a trace counts only if its growth rate exceeds the rate's error; then it agrees with the eigenvalues.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import msgspec
import numpy as np

from haptic_loop.controller.coupling import Coupling, NoCoupling, SpringDamper
from haptic_loop.controller.environment import Network, Spring
from haptic_loop.controller.loop import Loop
from haptic_loop.design.certificate import prove, required_damping
from haptic_loop.design.result import NotProved
from haptic_loop.models.device import CompliantDevice, RigidDevice
from haptic_loop.models.human import Human, Population, Voluntary
from haptic_loop.sim.accuracy import settle
from haptic_loop.sim.crowds import Validation, validate
from haptic_loop.sim.run import assemble, make_engine, run
from haptic_loop.sim.scenario import InputError, Scenario, load
from haptic_loop.sim.stability import _NOT_EXCITED, disagree, stability_of

_TOO_CLOSE = 1e-4  # margin below which a proof may fail, as a share of the damping
_HANDS = Population()


def _random_network(rng: np.random.Generator) -> Network:
    """Return a network of one to three contacts and up to three inner nodes, joined at random."""
    tips = [f"tip {i}" for i in range(rng.integers(1, 4))]
    names = tips + [f"node {i}" for i in range(rng.integers(0, 4))]
    everywhere, springs = names + (["ground"] if rng.random() < 0.6 else []), {}
    for _ in range(int(rng.integers(len(names), 3 * len(names) + 1)) if len(everywhere) > 1 else 0):
        ends, kind = rng.choice(everywhere, 2, replace=False).tolist(), rng.integers(3)
        stiffness, damping = np.exp(rng.uniform(3, 8)) * (kind != 0), np.exp(rng.uniform(-4, 1.5)) * (kind != 1)
        springs[frozenset(ends)] = Spring(tuple(ends), round(float(stiffness), 3), round(float(damping), 4))
    reached = [n for n in names if any(n in s.between for s in springs.values())]
    masses = {n: round(float(np.exp(rng.uniform(-4, 2))), 4) for n in reached if rng.random() < 0.6}
    return Network(tuple(tips), tuple(springs.values()), masses)


def _delayed(rng: np.random.Generator) -> Loop:
    """Return a loop of a random network and random delays, with 1 N s/m of damping on each channel."""
    while True:
        try:
            network = _random_network(rng)
            m = len(network.contacts)
            theta, psi = (tuple(rng.integers(0, 1 + n, m).tolist()) for n in (3, rng.random() < 0.3))
            return Loop(1e-3, theta, psi, theta, (1.0,) * m, network)
        except ValueError:  # A random network may have a contact without springs and masses.
            continue


def _coupling(rng: np.random.Generator, m: int) -> Coupling:
    gains = np.exp(rng.uniform(5, 9, m)).round(3), (rng.uniform(0, 3, m) * (rng.random() < 0.8)).round(4)
    return NoCoupling() if rng.random() < 0.15 else SpringDamper(*gains)


@dataclass(frozen=True)
class _Proof:
    """The proof for one network; its devices have 0.5 to 1.5 times the required damping."""

    number: int
    required: float  # required over available damping
    proved: bool
    reason: str | None

    @property
    def holds(self) -> bool:
        return self.proved == (self.required < 1) or 1 - _TOO_CLOSE <= self.required <= 1


def proofs(seed: int, count: int = 500) -> Iterator[_Proof]:
    """Yield for `count` random networks whether this-environment is proved, and the required damping by the sweep."""
    rng = np.random.default_rng(seed)
    for number in range(count):
        loop = _delayed(rng)
        m = loop.channels
        coupling = _coupling(rng, m)
        least = min(required_damping(loop, coupling, "this-environment").ratio, 100.0)
        loop = msgspec.structs.replace(loop, delta=(float(max(least * rng.uniform(0.5, 1.5), 1e-3)),) * m)
        ratio, reason = required_damping(loop, coupling, "this-environment").ratio, None
        try:
            proved = prove(loop, coupling, "this-environment").proof == "rational"
        except NotProved as error:
            proved, reason = False, str(error)
        yield _Proof(number, ratio, proved, reason)


@dataclass(frozen=True)
class _TraceVerdict:
    """The verdict of one run and that of its eigenvalues."""

    number: int
    engine: str
    exact_per_s: float  # growth by the eigenvalues
    trace_per_s: float | None  # growth in the trace; None if the trace gives no rate
    verdict: str | None
    reason: str | None
    not_excited: bool
    holds: bool


def _scenario(rng: np.random.Generator) -> Scenario:
    """Return a random scenario; with probability 1/3 all its delays, devices, hands and motions are alike."""
    loop = _delayed(rng)
    m, alike = loop.channels, rng.random() < 1 / 3
    device, human = [], []
    for _ in range(1 if alike else m):
        damping, mass = np.exp(rng.uniform(-2, 2)), np.exp(rng.uniform(-3, 0))
        stiffness = np.exp(rng.uniform(9, 12))
        device.append(
            RigidDevice(mass=mass, damping=damping)
            if rng.random() < 0.5
            else CompliantDevice(damping=damping, motor_mass=mass, transmission_stiffness=stiffness)
        )
        (hand,) = _HANDS.draw(rng, 1)
        moves = rng.random() < 0.8
        human.append(Human(hand.links, Voluntary(0.02, float(rng.uniform(0.2, 3))) if moves else None))
    shared = m if alike else 1
    tap = {"channel": 1, "force": 2.0, "start": 0.1, "duration": 0.02} if rng.random() < 0.5 else None
    return Scenario(
        name="random",
        T=float(rng.choice([5e-4, 1e-3, 2e-3])),
        theta=(loop.theta[0],) * m if alike else loop.theta,
        psi=(loop.psi[0],) * m if alike else loop.psi,
        device=tuple(device) * shared,
        human=tuple(human) * shared,
        environment=loop.network,
        duration=1.5,
    ).replace(tap=tap)


def traces(seed: int, count: int = 460) -> Iterator[_TraceVerdict]:
    """Yield for `count` runs, about half of them in MuJoCo, whether their verdicts agree with the eigenvalues."""
    rng, number = np.random.default_rng(seed), 0
    while number < count:
        scenario, engine = _scenario(rng), str(rng.choice(["exact", "mujoco"]))
        coupling = _coupling(rng, scenario.channels)
        try:
            simulation = assemble(scenario, coupling)
            trace = run(simulation, make_engine(simulation, engine, *settle(simulation, engine)[:2]))
        except InputError:  # No number of substeps is enough.
            continue
        part = stability_of(simulation, trace)
        growth, exact = part.growth_rate_per_s, part.exact_growth_rate_per_s
        silent, other = part.reason == _NOT_EXCITED, growth is not None and bool(disagree(exact, growth))
        opposite = other or (growth is None and part.verdict not in (None, part.exact_verdict))
        yield _TraceVerdict(number, engine, exact, growth, part.verdict, part.reason, silent, not opposite)
        number += 1


@dataclass(frozen=True)
class _Slow:
    """Traces of 2 s of fifty hands on one network that decays in seconds, beside the eigenvalues."""

    network: int
    decided: int  # number of traces whose rate is larger than its error
    contradicted: int  # number of these traces that contradict the eigenvalues
    worst: float  # |rate - exact growth| over the error that the trace states
    holds: bool


def slow(seed: int, count: int = 2000) -> Iterator[_Slow]:
    """Yield whether traces contradict the eigenvalues, for `count` loops of three devices around a mass."""
    for number in range(count // 50):
        rng = np.random.default_rng((seed, number))
        stiffness, damping = np.exp(rng.uniform(2.5, 7.0, 3)), rng.choice([0.0, 0.3], 3) * rng.random(3)
        springs = tuple(
            Spring((end, "m"), float(k), float(b)) for end, k, b in zip("abc", stiffness, damping, strict=True)
        )
        network = Network(("a", "b", "c"), springs, {"m": float(np.exp(rng.uniform(-3.0, 0.5)))})
        theta = tuple(rng.integers(0, 5, 3).tolist())
        scenario = load("three-rigid").replace(environment=network, theta=theta)
        findings = validate(Validation(scenario, NoCoupling(), number, 50, 1, "exact", 2.0))
        decided = findings.trace_decides
        contradicted = int((decided & ((findings.trace > 0) != (findings.exact > 0))).sum())
        worst = float(
            np.max(np.abs(findings.trace - findings.exact)[decided] / findings.trace_error[decided], initial=0.0)
        )
        yield _Slow(number, int(decided.sum()), contradicted, worst, not contradicted and worst < 1)
