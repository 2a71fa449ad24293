"""Measure speed and error, goal by goal, in one run.

PYTHONPATH=. python tests/benchmarks/goals.py [--write] [engines|cold|first|imports|long|peers ..]

`cold` measures commands until they end, `first` until they print a line, and `imports` the imports of the commands of
`cold` (`python -X importtime`). These three give wall seconds and need an idle machine; the others give CPU seconds.
`long` measures commands of many seconds. Ratios are medians of rounds in which the compared programs alternate.
Commands alternate with the floor, a process that only imports NumPy and MuJoCo. Goals are multiples of the floor's
time. `--write` puts the table of cold into docs/accuracy.md.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import resource
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from test_engine_cost import SCENES, cpu_seconds, looped, raw

from haptic_loop.sim.accuracy import position_error, simulated_growth
from haptic_loop.sim.couplings import assessed, choose
from haptic_loop.sim.engines import EXPONENTIAL
from haptic_loop.sim.run import assemble
from haptic_loop.sim.stability import exact_growth

ROOT = Path(__file__).parents[2]
PAGES = {"cold": "docs/accuracy.md"}
ROUNDS = 9
FLOOR = "-c import numpy, mujoco"

#: words of a command -> its goal, as a multiple of the floor's time; {} is a folder that all commands share
COMMANDS = {
    **{
        f"{name} --help": 1.0 for name in ("sim.run", "design", "design.audit", "sim.validate", "hw.bridge", "sim.view")
    },
    "design --out {}/coupling.json --json {}/r.json": 3.0,
    "design.check {}/coupling.json --json {}/r.json": 1.5,
    "design.audit --K 800 --B 0.5 --out {} --json {}/r.json": 2.0,
    "sim.run --case I --no-plot --out {} --json {}/r.json": 2.5,
    "sim.run --case I --out {} --json {}/r.json": 4.0,
}
MANY = "design --coupling optimal --out {}/many.json --json {}/r.json --scenario"  # four and eight devices
#: words of a command that takes many seconds and runs once -> its goal, as a multiple of the floor's time
LONG = {
    "sim.validate --humans 1000 --no-plot --out {} --json {}/r.json": 7.3,
    "sim.validate --humans 1000 --no-plot --traces all --out {} --json {}/r.json": None,
    "sim.validate --humans 10000 --duration 0 --no-plot --out {} --json {}/r.json": 7.3,
    "design --coupling optimal --out {}/optimal.json --json {}/r.json": None,
    **dict.fromkeys((f"{MANY} {ROOT}/benchmarks/loops/{name}.toml" for name in ("n6-star4-II", "n7-eight-I")), 29.0),
}
#: words of a command that prints a line before its end -> its goal, as a multiple of the floor's wall time
FIRST = {
    "sim.run --case I --out {} --json {}/r.json": 2.5,
    "design --coupling optimal --out {}/optimal.json --json {}/r.json": 6.4,
}


def engines() -> Iterator[Sequence[str]]:
    """Measure runs of the default design with its limiter.

    Goals of the exponential integrator: 3 times as fast as RK4 with 4 substeps, 1.10 times the cost of MuJoCo's calls
    alone ("raw"), and the exact growth rate within 1e-9 1/s.
    """
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
    yield "engine", "CPU", "as fast as RK4 x 4", "loop / raw", "loop / memoryview", "position error", "growth error"
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


def started(words: str, folder: str, *flags: str) -> subprocess.Popen[bytes]:
    """Start the command in a new process that finds bytecode and matplotlib's font cache, as a user's process does.

    `flags` are options of Python; if there are any, standard error is piped.
    """
    environment = os.environ | {"MPLCONFIGDIR": matplotlib.get_cachedir(), "PYTHONPATH": str(ROOT)}
    environment.pop("PYTHONDONTWRITEBYTECODE", None)
    arguments = ["-c", words[3:]] if words.startswith("-c ") else ["-m", *words.format(*[folder] * 2).split()]
    call, said = [sys.executable, *flags, *arguments], subprocess.PIPE if flags else subprocess.DEVNULL
    return subprocess.Popen(call, cwd=folder, env=environment, stdout=subprocess.PIPE, stderr=said)


def ended(process: subprocess.Popen[bytes]) -> None:
    process.communicate()
    if process.returncode:
        raise subprocess.CalledProcessError(process.returncode, process.args)


def cost(words: str, folder: str) -> float:
    """Return the CPU seconds of a command and its child processes."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    ended(started(words, folder))
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def waited(words: str, folder: str) -> float:
    """Return the seconds until a command has ended."""
    begin = time.perf_counter()
    ended(started(words, folder))
    return time.perf_counter() - begin


def first_line(words: str, folder: str) -> float:
    """Return the seconds until a command has printed a line, or until the floor has ended."""
    begin = time.perf_counter()
    process = started(words, folder)
    assert process.stdout is not None
    process.stdout.readline()
    spent = time.perf_counter() - begin
    ended(process)
    return spent


def error(report: dict[str, Any]) -> str:
    """Return the errors of a simulation, or how the requirements were proved."""
    if "traces" in report:
        traced = report["traces"] and f", {report['traces']['witnessed']} traces by both engines"
        apart = f"growth rates {report['largest_difference_per_s']:.1e} 1/s apart"
        return f"{apart}, {report['disagreements']} disagreements{traced or ''}"
    if "stability" in report:
        stability, position = report["stability"], report["error"]["position_relative_rms"]
        growth = stability["growth_rate_per_s"] - stability["exact_growth_rate_per_s"]
        return f"position {position:.1e}, growth {growth:+.1e} 1/s"
    assessment = report.get("assessment") or report
    needs = [need for need in assessment["requirements"].values() if need["certified"]]
    return ", ".join(f"{need['condition']}: {need['proof']}" for need in needs) or "not certified"


def interleaved(
    commands: Mapping[str, float | None], spent: Callable[[str, str], float], rounds: int
) -> Iterator[Sequence[str]]:
    """Yield a row for each command: medians over rounds of its seconds and of its ratio to the floor."""
    with tempfile.TemporaryDirectory() as folder:
        for words in [*commands] if rounds > 1 else []:
            spent(words, folder)
        seconds: dict[str, list[float]] = {words: [] for words in [FLOOR, *commands]}
        beside = {}
        for _ in range(rounds):
            for words in seconds:
                Path(folder, "r.json").unlink(missing_ok=True)
                seconds[words].append(spent(words, folder))
                if Path(folder, "r.json").exists():
                    beside[words] = error(json.loads(Path(folder, "r.json").read_text()))
        floor = np.array(seconds[FLOOR])
        for words, spent_on in seconds.items():
            goal = commands.get(words)
            figures = f"{np.median(spent_on):.2f}", f"{np.median(spent_on / floor):.2f}", f"{goal:g}" if goal else ""
            name = words.replace(" --json {}/r.json", "").replace(" --out {}/", " --out ").replace(" --out {}", "")
            name = name.replace(f"{ROOT}/", "")
            yield f"`{name.replace('{}/', '')}`", *figures, beside.get(words, "")


def cold() -> Iterator[Sequence[str]]:
    yield "command", "wall [s]", "floors", "goal", "error or proof"
    yield from interleaved(COMMANDS, waited, 5)


def long() -> Iterator[Sequence[str]]:
    yield "command", "CPU [s]", "floors", "goal", "error or proof"
    yield from interleaved(LONG, cost, 1)


def first() -> Iterator[Sequence[str]]:
    yield "first line of", "wall [s]", "floors", "goal", "error or proof"
    yield from interleaved(FIRST, first_line, 5)


def imports() -> Iterator[Sequence[str]]:
    """Yield the seconds of all imports of each command, and of the packages whose modules take longest."""
    yield "command", "imports [s]", "longest [s]"
    with tempfile.TemporaryDirectory() as folder:
        for words in [FLOOR, *COMMANDS]:
            _, said = started(words, folder, "-X", "importtime").communicate()
            packages = Counter[str]()  # [us]
            for own, module in re.findall(r"import time: +(\d+) \| +\d+ \| +(\w+)", said.decode()):
                packages[module] += int(own)
            longest = ", ".join(f"{name} {1e-6 * us:.3f}" for name, us in packages.most_common(5))
            name = words.split(" --out")[0].split(" --json")[0].replace("{}/", "")
            yield f"`{name}`", f"{1e-6 * packages.total():.2f}", longest


def peers() -> Iterator[Sequence[str]]:
    """Run peers.py, which leaves out tools that are not installed."""
    subprocess.run([sys.executable, str(Path(__file__).with_name("peers.py"))], check=True)
    return iter(())


def table(rows: Iterable[Sequence[str]]) -> str:
    """Return the rows as a Markdown table, and print it line by line."""
    lines = []
    for cells in rows:
        lines.append(f"| {' | '.join(cells)} |\n")
        print(lines[-1], end="", flush=True)
        if len(lines) == 1:
            lines.append("|---" * len(cells) + "|\n")
    return "".join(lines)


def write(name: str, made: str) -> None:
    """Put a table, without the rows of `--help`, behind its mark in the page."""
    made = re.sub(r".* --help` .*\n", "", made)
    page = ROOT / PAGES[name]
    mark = f"<!-- goals: {name} -->\n"
    before, after = page.read_text().split(mark)
    page.write_text(before + mark + made + re.sub(r"\A(\|.*\n)*", "", after))


if __name__ == "__main__":
    known = {f.__name__: f for f in (engines, cold, first, imports, long, peers)}
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("goals", nargs="*", metavar="|".join(known), help="goals to measure (default: all)")
    parser.add_argument("--write", action="store_true", help="write the table of cold into its page")
    args = parser.parse_args()
    if strange := set(args.goals) - set(known):
        parser.error(f"goals are {', '.join(known)}, not {', '.join(strange)}")
    for name in args.goals or known:
        made = table(known[name]())
        if args.write and name in PAGES:
            write(name, made)
