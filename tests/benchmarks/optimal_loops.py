"""Design optimal couplings for the loops n* and o* of benchmarks/loops, and bound the mismatch of any linear coupling.

PYTHONPATH=. python tests/benchmarks/optimal_loops.py [--bound 4] [--only n0,o03]     (some minutes)

`before` is the rms mismatch [dB] of an older version's optimal coupling, or the reason why there was none; `now` is
that of this version. `to beat` is the goal for the rms mismatch and the rendered stiffness g. `s` and `bound s` are
CPU seconds. `need` is the required over the available damping; `at 10 %` is the largest such ratio when one spring, all
springs or one mass of the environment change by 10 %. `gain` is the high-frequency gain (design/transparency.py), and
`limited` the rms mismatch [dB] of the design with a limiter, if that design is proved.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

from threadpoolctl import threadpool_limits

from haptic_loop.design.bound import MOST, bound
from haptic_loop.design.coverage import robustness_nearby
from haptic_loop.design.optimal import design
from haptic_loop.design.program import Options
from haptic_loop.sim.scenario import load

T = TypeVar("T")
PATIENT = Options(seconds=600)  # no larger basis is tried after this time, so that one loop cannot block the run
LOOPS = Path(__file__).parents[2] / "benchmarks" / "loops"

#: loop -> `before`, `to beat`
BEFORE = {
    "n0": ("-29.50", "-33.69, .996"),
    "n1": ("-11.19", "-13.13, .88"),
    "n2": ("refused", "-9.83, .73"),
    "n3": ("refused", "-5.13, .52"),
    "n4": ("-20.04", ""),
    "n5": ("-22.98", "-27.17, .97"),
    "n6": ("-12.05", ""),
    "n7": ("not run", "-2.53, .16"),
    "n8": ("no end", "-6.08, .29"),
}


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument(
        "--bound", type=int, default=MOST, help="largest number of devices for which the bound is computed"
    )
    arguments.add_argument(
        "--limiter", type=int, default=2, help="largest number of devices for which a design with limiter is made"
    )
    arguments.add_argument("--only", default="", help="beginnings of names, separated by commas")
    chosen = arguments.parse_args()
    print(f"{'loop':28} {'before':>8} {'to beat':>13} {'now':>7} {'g':>6} {'bound':>7} {'s':>5} {'states':>6}", end=" ")
    print(f"{'proved':>6} {'need':>7} {'gain':>5} {'at 10 %':>8} {'limited':>8} {'bound s':>7}")
    with threadpool_limits(1, user_api="blas"):
        for path in sorted(LOOPS.glob("[no]*.toml")):
            if path.stem.startswith(tuple(chosen.only.split(","))):
                _row(path, chosen.bound, chosen.limiter)


def _row(path: Path, most: int, limited: int) -> None:
    loop = load(path).loop("I")
    before, beat = BEFORE.get(path.stem[:2], ("", ""))
    optimum, seconds = _timed(lambda: design(loop, PATIENT))
    limit, took = _timed(lambda: f"{bound(loop).rms_db:7.2f}" if loop.channels <= most else "")
    held = design(loop, replace(PATIENT, limiter=True)) if loop.channels <= limited else None
    shown = f"{held.figures.rms_mismatch_db:8.2f}" if held and held.proved else ""
    figures = optimum.figures
    nearby = robustness_nearby(loop, optimum.coupling).required_over_available
    print(
        f"{path.stem:28} {before:>8} {beat:>13} {figures.rms_mismatch_db:7.2f} {optimum.g:6.3f} {limit:>7}"
        f" {seconds:5.1f} {optimum.states:6} {'yes' if optimum.proved else 'no':>6} {optimum.requirement.ratio:7.4f}"
        f" {figures.high_frequency_gain:5.1f} {nearby:8.2f} {shown:>8} {took:7.1f}",
        flush=True,
    )


def _timed(work: Callable[[], T]) -> tuple[T, float]:
    started = time.process_time()
    return work(), time.process_time() - started


if __name__ == "__main__":
    main()
