"""The optimal coupling of every loop in tests/loops: what it reaches, how long it takes, and what no coupling can do.

PYTHONPATH=. python tests/benchmarks/optimal_loops.py [--bound 2] [--only n0,o03]     (some minutes)

`before` is the rms mismatch of version 0.1's optimal couplings, for the nine loops that it was measured on. `to beat`
is the figure, and the rendered stiffness g, that this design was asked for. The bound is worked out for as many devices
as --bound says.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

from threadpoolctl import threadpool_limits

from design.bound import bound
from design.optimal import design, robustness
from sim.scenario import load

LOOPS = Path(__file__).parents[1] / "loops"

#: by loop: rms mismatch [dB] of version 0.1 (or why there was none), figure [dB] and stiffness to beat
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
    arguments.add_argument("--bound", type=int, default=2, help="most devices for which the bound is worked out")
    arguments.add_argument("--only", default="", help="beginnings of names, separated by commas")
    chosen = arguments.parse_args()
    print(f"{'loop':28} {'before':>8} {'to beat':>13} {'now':>7} {'g':>6} {'bound':>7} {'s':>5} {'states':>6}", end=" ")
    print(f"{'proved':>6} {'need':>7} {'gain':>5} {'at 10 %':>8} {'bound s':>7}")
    with threadpool_limits(1, user_api="blas"):
        for path in sorted(LOOPS.glob("*.toml")):
            if path.stem.startswith(tuple(chosen.only.split(","))):
                _row(path, chosen.bound)


def _row(path: Path, most: int) -> None:
    loop = load(path).loop("I")
    before, beat = BEFORE.get(path.stem[:2], ("", ""))
    found = design(loop)
    started = time.perf_counter()
    limit = f"{bound(loop).rms_db:7.2f}" if loop.channels <= most else ""
    took = time.perf_counter() - started
    figures = found.figures
    print(
        f"{path.stem:28} {before:>8} {beat:>13} {figures.rms_mismatch_db:7.2f} {found.g:6.3f} {limit:>7}"
        f" {found.wall_s:5.1f} {found.states:6} {'yes' if found.proved else 'no':>6} {found.requirement.ratio:7.4f}"
        f" {figures.high_frequency_gain:5.1f} {robustness(loop, found.coupling).worst:8.2f} {took:7.1f}",
        flush=True,
    )


if __name__ == "__main__":
    main()
