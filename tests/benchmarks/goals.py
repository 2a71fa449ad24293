"""Speed beside error, goal by goal, in one run.

PYTHONPATH=. python tests/benchmarks/goals.py [--write] [engines|hands|cold|peers ..]

CPU seconds. Ratios are medians of rounds in which both sides alternate; commands are the least of three, each in a
process of its own, with matplotlib's list of fonts made before. `--write` puts the tables of engines and cold into the
pages: on an idle machine.
"""

from __future__ import annotations

import argparse
import os
import re
import resource
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import matplotlib
import numpy as np
from test_engine_cost import SCENES, cpu_seconds, looped, raw

from haptic_loop.sim.accuracy import position_error, simulated_growth
from haptic_loop.sim.couplings import assessed, choose
from haptic_loop.sim.engines import EXPONENTIAL
from haptic_loop.sim.run import assemble
from haptic_loop.sim.stability import exact_growth

ROOT = Path(__file__).parents[2]
PAGES = {"engines": "docs/accuracy.md", "cold": "docs/accuracy.md"}
ROUNDS = 9
COMMANDS = {
    "sim.run --help": 0.3,
    "design --help": 0.3,
    "design --out coupling.json": 1.2,
    "design.check coupling.json": 0.8,
    "design.audit --K 800 --B 0.5": 0.8,
}
RUN = 2.5


def engines() -> Iterator[Sequence[str]]:
    """The default design with its limiter; goals: 3 x as fast as RK4 x 4, loop over raw 1.10, growth 1e-9 1/s."""
    scenario = SCENES["default"]
    chosen = choose(scenario, "I", "spring-damper", "this-environment")
    simulation = assemble(scenario, chosen.coupling, assessed(scenario, "I", chosen).force_limits.rho)
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
    yield "engine", "CPU", "as fast as RK4 x 4", "loop / raw", "raw by memoryview", "position error", "growth error"
    for name, (_, integrator, count) in settings.items():
        times, ratios, least = np.array(used[name]).T
        trace = looped(simulation, *settings[name])
        row = [name, f"{1e3 * np.median(times):.0f} ms", f"{np.median(slow / times):.1f} x"]
        if integrator is None:
            yield *row, "", "", "reference", "reference"
            continue
        position = position_error(trace, exact, simulation).position_relative_rms
        growth = simulated_growth(simulation, integrator, count) - exact_growth(simulation)
        yield *row, f"{np.median(ratios):.2f}", f"{np.median(least):.2f}", f"{position:.1e}", f"{growth:+.1e} 1/s"


def command(words: str, folder: str) -> float:
    """CPU seconds of a command and what it starts."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    kept = {"MPLCONFIGDIR": matplotlib.get_cachedir()}
    subprocess.run(
        [sys.executable, "-m", *words.split()],
        cwd=folder,
        env=os.environ | kept | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def hands() -> Iterator[Sequence[str]]:
    yield "command", "CPU [s]", "goal"
    with tempfile.TemporaryDirectory() as folder:
        yield "sim.validate --humans 1000, with traces", f"{command('sim.validate --humans 1000', folder):.1f}", "15"


def cold() -> Iterator[Sequence[str]]:
    yield "command", "CPU [s]", "goal"
    with tempfile.TemporaryDirectory() as folder:
        for words, goal in COMMANDS.items():
            yield f"`{words}`", f"{min(command(words, folder) for _ in range(3)):.2f}", f"{goal:g}"
        best = min(command("sim.run", folder) for _ in range(3))
        yield "`sim.run` with its picture", f"{best:.2f}", f"{RUN:g}"


def peers() -> Iterator[Sequence[str]]:
    """Tools that are not installed are left out."""
    subprocess.run([sys.executable, str(Path(__file__).with_name("peers.py"))], check=True)
    return iter(())


def table(rows: Iterable[Sequence[str]]) -> str:
    """As Markdown, printed line by line."""
    lines = []
    for cells in rows:
        lines.append(f"| {' | '.join(cells)} |\n")
        print(lines[-1], end="", flush=True)
        if len(lines) == 1:
            lines.append("|---" * len(cells) + "|\n")
    return "".join(lines)


def write(name: str, made: str) -> None:
    """Put a table behind its mark in the page."""
    page = ROOT / PAGES[name]
    mark = f"<!-- goals: {name} -->\n"
    before, after = page.read_text().split(mark)
    page.write_text(before + mark + made + re.sub(r"\A(\|.*\n)*", "", after))


if __name__ == "__main__":
    known = {f.__name__: f for f in (engines, hands, cold, peers)}
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("goals", nargs="*", metavar="|".join(known), help="by default all")
    parser.add_argument("--write", action="store_true", help="into the pages")
    args = parser.parse_args()
    if strange := set(args.goals) - set(known):
        parser.error(f"goals are {', '.join(known)}, not {', '.join(strange)}")
    for name in args.goals or known:
        made = table(known[name]())
        if args.write and name in PAGES:
            write(name, made)
