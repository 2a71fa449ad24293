"""Run hw.identify on sixty simulated rigs, most of which are not ideal.

PYTHONPATH=. python tests/benchmarks/odd_rigs.py     (two minutes; --seed 1 draws other rigs)

This file integrates the plants by semi-implicit Euler in small steps, without the emulator. The true guarantee of a rig
is the viscous friction of its motor: all else is passive, or does not belong to the device.
"""

from __future__ import annotations

import argparse
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass

import numpy as np

from haptic_loop.controller.lti import Array
from haptic_loop.hw.identify import Estimate, Swing, chirp, identify
from haptic_loop.sim.scenario import load as scenario_of

#: rig -> error of the bound by an earlier fit, which assumed one mass with Coulomb friction and refused other rigs
EARLIER = {"coulomb 0.05, slip 0.02": "3.5 % above", "hand (0.01, 0.1, 20.0)": "7 to 17 % above"}
T, SUBSTEPS, FORCE_STEP = 1.2e-3, 24, 4e-4
BASE = ("viscous", "mass", "motor", "spring", "step")


@dataclass(frozen=True)
class Rig:
    """A rig with its imperfections. An imperfection of 0 is absent, and `thin` is absent at infinity."""

    name: str
    viscous: float = 1.0  # [N s/m] the true guarantee
    mass: float = 0.25  # [kg]
    motor: float = 0.3  # the motor's part of the mass
    spring: float = 14500.0  # [N/m] of the transmission
    loss: float = 0.5  # [N s/m] of the transmission
    step: float = 5e-6  # [m] encoder
    coulomb: float = 0.0  # [N]
    slip: float = 0.002  # [m/s] speed at which Coulomb friction reaches 3/4 of `coulomb`
    static: float = 0.0  # [N] static friction above Coulomb friction
    stribeck: float = 0.02  # [m/s] speed at which `static` is down to 1/e
    thin: float = np.inf  # [m/s] speed at which the viscous coefficient is down to a half
    memory: float = 0.0  # [N s/m] dashpot of a Maxwell element
    relax: float = 1.0  # [s] time constant of the Maxwell element
    drag: float = 0.0  # [N s2/m2] drag that grows with the square of the speed
    bristle: float = 0.0  # [N/m] presliding (Dahl's law) in place of tanh
    constant: float = 0.0  # [N] constant force
    drift: float = 0.0  # [N/s] rate of a growing force
    cable: float = 0.0  # [N/m] stiffness of a cable
    cogging: float = 0.0  # [N] amplitude of cogging
    period: float = 0.004  # [m] period of cogging
    eccentric: float = 0.0  # [m] amplitude of the encoder's error
    turn: float = 0.04  # [m] period of the eccentricity
    gap: float = 0.0  # [m] backlash
    lag: float = 0.0  # [T] time constant of the force, first order
    late: float = 0.0  # [T] pure delay of the force
    hand: tuple[float, float, float] = (0.0, 0.0, 0.0)  # [kg], [N s/m], [N/m]
    tremor: float = 0.0  # [N]


def rigs(seed: int = 7) -> list[Rig]:
    """Return sixty rigs: each imperfection on the default device and on a random one, mixtures, and hands."""
    one: list[dict[str, float]] = [
        {},
        {"constant": 1e-3},
        {"cable": 1.0},
        {"cogging": 2e-3},
        {"gap": 1e-5},
        {"lag": 0.3},
        {"eccentric": 2e-5},
        {"loss": 3.0},
        {"coulomb": 0.05, "slip": 0.02},
        {"coulomb": 0.05, "slip": 0.0005},
        {"coulomb": 0.04, "static": 0.03},
        {"coulomb": 0.03, "bristle": 2000.0},
        {"drag": 0.5},
        {"drift": 0.002},
        {"late": 0.3},
        {"constant": 0.02, "coulomb": 0.03},
    ]
    many = []
    draw = np.random.default_rng(seed)
    for variant in range(2):
        for extra in one:
            base = (
                {}
                if variant == 0
                else {
                    "viscous": float(np.exp(draw.uniform(np.log(0.4), np.log(2.0)))),
                    "mass": draw.uniform(0.12, 0.45),
                    "motor": draw.uniform(0.2, 0.5),
                    "spring": draw.uniform(8e3, 3e4),
                    "step": float(np.exp(draw.uniform(np.log(1e-6), np.log(2e-5)))),
                }
            )
            name = ", ".join(f"{k} {v:g}" for k, v in extra.items()) or "ideal"
            many.append(Rig(name, **(base | extra)))
    for _ in range(22):
        mixed: dict[str, float] = {
            "viscous": float(np.exp(draw.uniform(np.log(0.4), np.log(2.0)))),
            "mass": draw.uniform(0.12, 0.45),
            "motor": draw.uniform(0.2, 0.5),
            "spring": draw.uniform(8e3, 3e4),
            "step": float(np.exp(draw.uniform(np.log(1e-6), np.log(2e-5)))),
        }
        for k in draw.choice(np.arange(1, len(one)), 3, replace=False):
            mixed |= one[k]
        many.append(Rig("mixed: " + ", ".join(k for k in mixed if k not in BASE), **mixed))
    for hand in ((0.01, 0.1, 20.0), (0.02, 0.3, 60.0), (0.05, 0.2, 30.0), (0.1, 1.0, 200.0)):
        many.append(Rig(f"hand {hand}", hand=hand))
    for hand in ((0.01, 0.2, 8.0), (0.02, 0.5, 100.0)):
        many.append(Rig(f"hand {hand} with tremor", hand=hand, tremor=0.005))
    return many


def records(many: list[Rig], signal: Array, seed: int = 3, substeps: int = SUBSTEPS) -> Array:
    """Return encoder positions (ticks, rigs) [m] under the motors' forces `signal` (ticks,) [N]."""

    def of(name: str) -> Array:
        return np.array([getattr(r, name) for r in many], dtype=float)

    b, m, k, d, step, c, slip = map(of, ("viscous", "mass", "spring", "loss", "step", "coulomb", "slip"))
    m1, static, drag, bristle, gap = of("motor") * m, of("static"), of("drag"), of("bristle"), of("gap")
    hand = np.array([r.hand for r in many])
    m2, tremor = m - m1 + hand[:, 0], of("tremor")
    lag, late, period, turn = T * of("lag"), of("late"), of("period"), of("turn")
    cogging, eccentric = of("cogging"), of("eccentric")
    constant, drift, cable = of("constant"), of("drift"), of("cable")
    thin, memory, relax, stribeck = of("thin"), of("memory"), of("relax"), of("stribeck")
    draw = np.random.default_rng(seed)
    origin, phase = draw.uniform(size=len(many)), draw.uniform(0, 2 * np.pi, (2, len(many)))
    x, v, y, w, z, felt, wound = (np.zeros(len(many)) for _ in range(7))
    h, out, before = T / substeps, np.zeros((len(signal), len(many))), 0.0
    dahl, remembered, slack, free = bristle > 0, memory / relax, gap / 2, gap == 0
    followed = np.where(lag > 0, -np.expm1(-h / np.maximum(lag, 1e-9)), 1.0)
    reach, turns = c / np.maximum(bristle, 1e-9), 2 * np.pi / period
    old = [i < late * substeps for i in range(substeps)]  # whether the force of the last tick still acts
    pushes, pulls, damper, spring = h / m1, h / m2, hand[:, 1], hand[:, 2]
    for n, force in enumerate(signal):
        seen = x + eccentric * np.sin(2 * np.pi * x / turn + phase[0])
        out[n] = step * np.round(seen / step + origin)
        shake = tremor * np.sin(2 * np.pi * 9.3 * n * T) * (1 + np.sin(2 * np.pi * 0.7 * n * T))
        outside = constant + drift * n * T
        for i in range(substeps):
            now = np.where(old[i], before, force) if old[i].any() else force
            felt = felt + (now - felt) * followed
            stretch, speed = x - y, np.abs(v)
            contact = stretch - np.minimum(np.maximum(stretch, -slack), slack)
            link = k * contact + (free | (contact != 0)) * d * (v - w)
            z = np.minimum(np.maximum(z + h * v, -reach), reach)
            dry = np.where(dahl, bristle * z, np.tanh(v / slip) * (c + static * np.exp(-((v / stribeck) ** 2))))
            wound = wound + h * (v - wound / relax)  # [m] extension of the Maxwell element's spring
            total = felt + outside - link - v * (b / (1 + speed / thin) + drag * speed)
            total = total - remembered * wound - dry - cable * x + cogging * np.sin(turns * x + phase[1])
            v = v + pushes * total
            w = w + pulls * (link - damper * w - spring * y + shake)
            x, y = x + h * v, y + h * w
        before = force
    return out


def excitation(seconds: float = 2.5) -> Array:
    """Return the excitation of hw.identify (ticks,) [N], in whole force steps."""
    swing = Swing.of(scenario_of(), 0.5, 0.03)
    signal = chirp(1, T, 1, 1.0, (3.0, 200.0), seconds, Swing(swing.force[:1], swing.hz)).signal[:, 0]
    return FORCE_STEP * np.round(signal / FORCE_STEP)


def judged(rig: Rig, x: Array, signal: Array) -> tuple[Estimate | str, float]:
    """Return the estimate from a record or the error message, and the wall time [s]."""
    begin = time.perf_counter()
    estimate: Estimate | str
    try:
        estimate = identify(x, signal, T, rig.step, rigid=True)
    except ValueError as error:
        estimate = str(error)
    return estimate, time.perf_counter() - begin


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=7)
    parser.add_argument("--workers", type=int, default=2)
    args = parser.parse_args()
    many, signal = rigs(args.seed), excitation()
    x = records(many, signal, args.seed)
    with ProcessPoolExecutor(args.workers) as pool:
        results = list(pool.map(judged, many, x.T, [signal] * len(many)))
    off, longest = [], max(seconds for _, seconds in results)
    for i, (rig, (estimate, _)) in enumerate(zip(many, results, strict=True), start=1):
        before = "" if rig.name.startswith("mixed") else f" (earlier: {EARLIER.get(rig.name, 'no bound')})"
        if isinstance(estimate, str):
            print(f"{i:2d} {rig.name}: no bound: {estimate}{before}")
            continue
        off.append(100 * (estimate.delta / rig.viscous - 1))
        b = 100 * (estimate.viscous / rig.viscous - 1)
        print(f"{i:2d} {rig.name}: {rig.viscous:.3f} N s/m, viscous {b:+.2f} %, bound {off[-1]:+.2f} %{before}")
    above, none = sum(part > 0 for part in off), sum(part == -100 for part in off)
    print(f"{len(many)} rigs: {len(off)} bounds, {above} above the truth, and {none} bounds of 0")
    print(f"bound minus truth: median {np.median(off):.2f} %, least {min(off):.1f} %; {longest:.1f} s for the slowest")


if __name__ == "__main__":
    main()
