"""Speed beside error, goal by goal, in one run.

PYTHONPATH=. python tests/benchmarks/goals.py [engines|hands|cold|peers ..]

CPU seconds. Ratios are medians of rounds in which both sides alternate; commands are the least of three, each in a
process of its own.
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from test_engine_cost import SCENES, cpu_seconds, looped, raw

from sim.accuracy import position_error
from sim.couplings import choose, limits_of
from sim.mujoco_engines import EXPONENTIAL
from sim.run import assemble
from sim.stability import exact_growth
from sim.step_choice import simulated_growth

ROUNDS = 9
COMMANDS = {
    "sim.run --help": 0.3,
    "design --help": 0.3,
    "design --out coupling.json": 1.2,
    "design.check coupling.json": 0.8,
    "design.audit --K 800 --B 0.5": 0.8,
}
RUN = 2.5


def engines() -> None:
    """The default design with its limiter; goals: 3 x as fast as RK4 x 4, loop over raw 1.10, growth 1e-9 1/s."""
    scenario = SCENES["default"]
    chosen = choose(scenario, "I", "spring-damper", "this-environment")
    simulation = assemble(scenario, chosen.coupling, limits_of(scenario, chosen).rho)
    exact = looped(simulation, "exact")
    rows = {"exact": ("exact", None, None), "exponential x 1": (EXPONENTIAL, 1), "RK4 x 4": ("RK4", 4)}
    settings = {name: ("exact", None, None) if name == "exact" else ("mujoco", *row) for name, row in rows.items()}
    used = {name: [] for name in settings}
    for _ in range(ROUNDS):
        for name, setting in settings.items():
            spent = cpu_seconds(lambda setting=setting: looped(simulation, *setting))
            bare = [raw(simulation, *setting[1:], exact, view) for view in (np.asarray, memoryview) if setting[1]]
            used[name].append((spent, *(spent / np.array(bare or [np.nan] * 2))))
    slow = np.array(used["RK4 x 4"])[:, 0]
    for name, (_, integrator, count) in settings.items():
        times, ratios, least = np.array(used[name]).T
        trace = looped(simulation, *settings[name])
        position = position_error(trace, exact, simulation).position_relative_rms
        beside = f"loop / raw {np.median(ratios):.2f}, {np.median(least):.2f} where raw calls copy by memoryview"
        growth = simulated_growth(simulation, integrator, count) - exact_growth(simulation) if integrator else 0.0
        print(
            f"| {name} | {1e3 * np.median(times):.0f} ms | {np.median(slow / times):.1f} x as fast as RK4 x 4 | "
            f"{beside if integrator else '-'} | position {position:.1e} | growth {growth:+.1e} 1/s |",
            flush=True,
        )


def command(words: str, folder: str, cache: str = "") -> float:
    """CPU seconds of a command and what it starts; designs are kept in a folder of that name."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    kept = {"HAPTIC_LOOP_CACHE": "" if cache else "off", "XDG_CACHE_HOME": str(Path(folder, cache))}
    subprocess.run(
        [sys.executable, "-m", *words.split()],
        cwd=folder,
        env=os.environ | kept | {"PYTHONPATH": str(Path(__file__).parents[2])},
        capture_output=True,
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def hands() -> None:
    """The goal is 15 s."""
    with tempfile.TemporaryDirectory() as folder:
        print(f"| sim.validate --humans 1000, with traces | {command('sim.validate --humans 1000', folder):.1f} s |")


def cold() -> None:
    """Beside each command its goal."""
    with tempfile.TemporaryDirectory() as folder:
        for words, goal in COMMANDS.items():
            best = min(command(words, folder) for _ in range(3))
            print(f"| {words} | {best:.2f} s | {goal:g} s |", flush=True)
        for words, what in (("sim.run", ""), ("sim.run --delta 1.36", ", of a loop of one's own")):
            best = min(command(words, folder, str(i)) for i in range(3))
            print(f"| sim.run{what}, the first time | {best:.2f} s | {RUN:g} s |", flush=True)
            best = min(command(words, folder, str(i)) for i in range(3))
            print(f"| sim.run{what}, its designs kept | {best:.2f} s | {RUN:g} s |", flush=True)


def peers() -> None:
    """Tools that are not installed are left out."""
    subprocess.run([sys.executable, str(Path(__file__).with_name("peers.py"))], check=True)


if __name__ == "__main__":
    known = {f.__name__: f for f in (engines, hands, cold, peers)}
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("goals", nargs="*", metavar="|".join(known), help="by default all")
    asked = parser.parse_args().goals
    if strange := set(asked) - set(known):
        parser.error(f"goals are {', '.join(known)}, not {', '.join(strange)}")
    for name in asked or known:
        known[name]()
