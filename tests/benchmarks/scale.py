"""Measure CPU seconds of one core, and results, for growing numbers of devices, delays, hands and seconds.

PYTHONPATH=.:tests python tests/benchmarks/scale.py [devices|commands|delays|hands|duration ..]
"""

from __future__ import annotations

import resource
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from evaluate import prove_limiter
from threadpoolctl import threadpool_limits

from haptic_loop import certify, design_coupling
from haptic_loop.controller.coupling import PUBLISHED, SpringDamper
from haptic_loop.controller.loop import Loop
from haptic_loop.design.result import Design, NotProved
from haptic_loop.models.scene import MIXED
from haptic_loop.sim.crowds import Validation, validate
from haptic_loop.sim.run import assemble, run
from haptic_loop.sim.scenario import load, parse
from haptic_loop.sim.stability import exact_growth


def star(n: int) -> str:
    """Return a scenario of n unlike devices around one hub on a soft spring, with delays of 0 to 2 samples in turn."""
    springs = [f'{{ between = ["c{i}", "hub"], stiffness = {300 + 20 * (i % 9)}, damping = 0.2 }}' for i in range(n)]
    device = '[[device]]\nkind = "rigid"\nmass = {}\ndamping = {}\n'
    text = [
        f'name = "star"\nT = 1e-3\nduration = 2.0\ntheta = {[i % 3 for i in range(n)]}\npsi = {[0] * n}\n',
        *(device.format(0.1 + 0.01 * (i % 7), 0.8 + 0.05 * (i % 5)) for i in range(n)),
        "[[human]]\nlinks = [{ mass = 0.3, damping = 3.0, stiffness = 200.0 }]\n" * n,
        "[environment]\ncontacts = [" + ", ".join(f'"c{i}"' for i in range(n)) + "]\nmasses = { hub = 0.8 }\n",
        "springs = [" + ", ".join(springs) + ', { between = ["hub", "ground"], stiffness = 50.0, damping = 0.1 }]\n',
        "[tap]\nchannel = 1\nforce = 1.0\nstart = 0.1\nduration = 0.01\n",
    ]
    return "".join(text)


def limits(loop: Loop, design: Design) -> str:
    """Return required over available damping for limited forces, or why there is no proof."""
    try:
        return f"{1 / prove_limiter(loop, design.coupling, c=design.c).margin:.4f}, proved"
    except NotProved as refused:
        return str(refused)


def cpu(call: Callable[[], Any]) -> tuple[Any, float]:
    begin = time.process_time()
    done = call()
    return done, time.process_time() - begin


def devices() -> None:
    """Measure, in the order of the columns: a run of 2 s, an audit by both conditions with exact proofs, a design for
    clipped forces, a design with a limiter, the proof of this limiter, and a design for any-environment.
    """
    for n in (2, 4, 8, 16, 32):
        scenario = parse(star(n))
        loop = scenario.loop("I")
        _, clipped = cpu(lambda loop=loop: design_coupling(loop, "spring-damper", "this-environment", limiter=False))
        design, designed = cpu(lambda loop=loop: design_coupling(loop, "spring-damper", "this-environment"))
        _, soft = cpu(lambda loop=loop: design_coupling(loop, "spring-damper", "any-environment"))
        limited, proved = cpu(lambda loop=loop, design=design: limits(loop, design))
        needs, audited = cpu(lambda loop=loop, design=design: certify(loop, design.coupling))
        simulation = assemble(scenario, design.coupling)
        trace, ran = cpu(lambda simulation=simulation: run(simulation))
        ratio = needs["this-environment"].ratio
        seconds = " | ".join(f"{value:.2f}" for value in (ran, audited, clipped, designed, proved, soft))
        print(f"| {n} devices | {seconds} | needs {ratio:.4f}, limited {limited}, {trace.t.size} ticks |")


def commands() -> None:
    with TemporaryDirectory() as place:
        for n in (8, 16, 32):
            scenario = Path(place, f"star{n}.toml")
            scenario.write_text(star(n))
            asked = ["--scenario", str(scenario), "--out"]
            design = ["design", *asked, str(Path(place, "coupling.json"))]
            run = ["sim.run", *asked, str(Path(place, "run"))]
            seconds = []
            for command in (design, run):
                before = resource.getrusage(resource.RUSAGE_CHILDREN)
                subprocess.run([sys.executable, "-m", *command], check=True, capture_output=True)
                after = resource.getrusage(resource.RUSAGE_CHILDREN)
                seconds.append(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)
            print(f"| {n} devices | {' | '.join(f'{value:.1f}' for value in seconds)} |", flush=True)


def delays() -> None:
    """Measure a run of 2 s, and the growth rate by eigenvalues."""
    for theta in (2, 20, 100, 200, 400):
        scenario = load().replace(theta=(theta, theta), duration=2.0)
        coupling = SpringDamper([1000 / theta] * 2, [0.1, 0.1])
        simulation, built = cpu(lambda scenario=scenario, coupling=coupling: assemble(scenario, coupling))
        _, ran = cpu(lambda simulation=simulation: run(simulation))
        growth, solved = cpu(lambda simulation=simulation: exact_growth(simulation))
        print(f"| {theta} samples of delay | {built + ran:.2f} | eigenvalues {solved:.2f} | growth {growth:+.4f} 1/s |")


def hands() -> None:
    """Measure verdicts by both engines, without traces and with traces of 2 s."""
    for count in (1000, 10_000, 100_000):
        for duration in (0.0, 2.0) if count == 1000 else (0.0,):
            question = Validation(load(), PUBLISHED["I"], 0, count, MIXED, "both", duration)
            findings, used = cpu(lambda question=question: validate(question))
            print(f"| {count} hands, {duration:g} s | {used:.2f} | {int(findings.disagreements.sum())} disagreements |")


def duration() -> None:
    """Measure long runs; the memory is the peak of the process so far."""
    for seconds in (15, 150, 600):
        simulation = assemble(load().replace(duration=seconds), PUBLISHED["I"])
        _, used = cpu(lambda simulation=simulation: run(simulation))
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        print(f"| {seconds} s | {used:.2f} | {peak:.0f} MiB |")


if __name__ == "__main__":
    known = {f.__name__: f for f in (devices, commands, delays, hands, duration)}
    with threadpool_limits(1, user_api="blas"):
        for name in sys.argv[1:] or known:
            known[name]()
