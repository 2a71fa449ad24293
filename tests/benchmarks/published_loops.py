"""Write benchmarks/figures.csv: PYTHONPATH=. python tests/benchmarks/published_loops.py     (a quarter of an hour)

For loops n* and o*, the columns of EXPENSIVE other than `designed_rms_db` are copied from the present file;
tests/benchmarks/optimal_loops.py computes them.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping
from pathlib import Path

from threadpoolctl import threadpool_limits

from haptic_loop.controller.coupling import Coupling, NoCoupling, SpringDamper
from haptic_loop.controller.loop import Loop
from haptic_loop.design.api import design_coupling, transparency_of
from haptic_loop.design.assessment import assess
from haptic_loop.design.bound import bound
from haptic_loop.design.certificate import judged, required_damping
from haptic_loop.design.designs import KINDS, design_by_kind
from haptic_loop.design.environments import SWITCHING
from haptic_loop.design.result import DesignFailed
from haptic_loop.sim.run import assemble
from haptic_loop.sim.scenario import load
from haptic_loop.sim.stability import worst_mode

ROOT = Path(__file__).parents[2] / "benchmarks"
EXPENSIVE = ("designed_rms_db", "best_rms_db", "best_stiffness_share", "bound_rms_db")


def cheap(path: Path) -> dict[str, float | None]:
    """Return the figures of a loop that take less than a second; None where a condition does not apply."""
    scenario = load(path)
    loop = scenario.loop("I")
    reference = SpringDamper([d / (2 * loop.T) for d in loop.delta], [d / 4 for d in loop.delta])
    mode = worst_mode(assemble(scenario, NoCoupling()))
    figures: dict[str, float | None] = {"devices": loop.channels}
    figures |= {"growth_without_coupling_per_s": float(mode.growth), "growth_frequency_hz": float(mode.frequency_hz)}
    figures["without_coupling"] = _here(loop, NoCoupling())
    figures["reference_this_environment"] = _here(loop, reference)
    figures["reference_any_environment"] = required_damping(loop, reference, "any-environment").ratio
    known = required_damping(loop, reference, "known-device").ratio if loop.known_devices else None
    return figures | {"reference_known_device": known}


def _here(loop: Loop, coupling: Coupling) -> float:
    """Return required over available damping for this-environment, under any switching if delays switch."""
    if loop.varying_delay:
        return judged(loop, coupling, SWITCHING).ratio
    return required_damping(loop, coupling, "this-environment").ratio


def designed(path: Path) -> float | None:
    """Return the mismatch [dB] of the designed spring-damper; None if no spring-damper is certified."""
    loop = load(path).loop("I")
    try:
        return transparency_of(loop, design_coupling(loop)).rms_mismatch_db
    except DesignFailed:
        return None


def best(path: Path) -> dict[str, float | None]:
    """Return figures of the best certified optimal or spring-damper coupling; known devices have no bound (None)."""
    loop, reached = load(path).loop("I"), []
    switching = {"switching": (loop.varying_delay.lo, loop.varying_delay.hi)} if loop.varying_delay else {}
    kinds = [("optimal", name) for name in KINDS["optimal"].conditions]
    for kind, condition in [*kinds, *(("spring-damper", name) for name in KINDS["spring-damper"].conditions)]:
        try:
            made = design_by_kind(loop, kind, condition, **switching)
        except ValueError:
            continue  # The design finds no coupling, or refuses this loop, for example because of its walls.
        if assess(loop, made, condition=SWITCHING if switching else made.required_condition).holds:
            seen = transparency_of(loop, made)
            reached.append((seen.rms_mismatch_db, seen.dc_ratio))
    rms, share = min(reached)
    # The bound covers couplings that this-environment certifies; known-device may certify better ones.
    least = None if loop.known_devices else bound(loop).rms_db
    return {"best_rms_db": rms, "best_stiffness_share": share, "bound_rms_db": least}


def written(value: float | None) -> str:
    return "" if value is None else f"{value:.6g}"


def table() -> list[dict[str, str]]:
    """Return the rows of the present file."""
    with (ROOT / "figures.csv").open() as file:
        return list(csv.DictReader(file))


def main() -> None:
    before: Mapping[str, dict[str, str]] = {row["loop"]: row for row in table()}
    rows = []
    with threadpool_limits(1, user_api="blas"):
        for path in sorted((ROOT / "loops").glob("*.toml")):
            row = {"loop": path.stem} | {name: written(value) for name, value in cheap(path).items()}
            row |= {name: before.get(path.stem, {}).get(name, "") for name in EXPENSIVE}
            rows.append(row | {"designed_rms_db": written(designed(path))})
            if path.stem.startswith("p"):
                rows[-1] |= {name: written(value) for name, value in best(path).items()}
            print(*rows[-1].values(), sep=", ", flush=True)
    with (ROOT / "figures.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, rows[0], lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


if __name__ == "__main__":
    main()
