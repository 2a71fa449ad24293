"""The picture of design.limits: how good a coupling could be, against what a laboratory could change."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib as mpl

from sim.files import write

mpl.use("Agg")

#: design -> what it is called, and how it is drawn (Okabe and Ito's palette, told apart in grey by marker and dashes)
CURVES = {
    "optimal": ("the optimal coupling", {"color": "#0072B2", "linestyle": "-", "marker": "o"}),
    "closed-loop": ("spring-damper, closed-loop", {"color": "#D55E00", "linestyle": "--", "marker": "s"}),
    "theorem4": ("spring-damper, theorem4", {"color": "#009E73", "linestyle": ":", "marker": "^"}),
}
#: the floor of the picture [dB]: in case I a loop that needs no coupling has minus infinity
FLOOR = -60.0
FIGURES = {"rms": "rms_mismatch_db", "sup": "relative_mismatch_db"}


def plot_limits(outcome: dict[str, Any], path: Path) -> Path:
    """One panel per sweep; a point without a solution is a cross at the top of its panel."""
    import matplotlib.pyplot as plt

    sweeps = {name: sweep for name, sweep in outcome["sweeps"].items() if sweep["optimal"]}
    rows = (len(sweeps) + 1) // 2
    columns = min(len(sweeps), 2)
    size = (5.5 * columns + 0.5, 3.6 * rows + 0.9)
    figure, axes = plt.subplots(rows, columns, figsize=size, layout="constrained", squeeze=False, sharey=True)
    handles: dict[str, Any] = {}
    for axis, (name, sweep) in zip(axes.flat, sweeps.items(), strict=False):
        handles |= _panel(axis, name, sweep, FIGURES[outcome["objective"]], _here(name, outcome))
    for axis in axes.flat[len(sweeps) :]:
        axis.set_visible(False)
    for axis in axes[:, 0]:
        axis.set_ylabel(f"{outcome['objective']} mismatch [dB]")
    figure.legend(list(handles.values()), list(handles), loc="outside lower center", ncols=3, fontsize=9)
    figure.suptitle(f"The best reachable mismatch: {outcome['scenario']}, case {outcome['case']}")
    try:
        return write(path, lambda file: figure.savefig(file, format="png", dpi=130))
    finally:
        plt.close(figure)


def _here(name: str, outcome: dict[str, Any]) -> float:
    """Where the scenario stands on this axis, in the unit drawn."""
    here = outcome["here"]
    each = {"damping": min(here["delta"]), "delay": max(here["theta"]), "period": 1e3 * here["T_s"]}
    return (each | {"order": outcome["wish"]["functions"]})[name]


def _panel(axis: Any, name: str, sweep: dict[str, Any], figure: str, here: float) -> dict[str, Any]:
    """Draw one sweep; what belongs into the legend by its words."""
    scale, unit = (1e3, "ms") if sweep["unit"] == "s" else (1.0, sweep["unit"])
    handles: dict[str, Any] = {}
    for kind, (words, style) in CURVES.items():
        known = [(scale * row["value"], row[figure]) for row in sweep.get(kind, []) if row[figure] is not None]
        if known:
            points = [(x, max(y, FLOOR)) for x, y in known]
            (handles[words],) = axis.plot(*zip(*points, strict=True), markersize=5, **style)
        exact = [x for x, y in known if y <= FLOOR]
        if exact and kind == "optimal":
            low = [FLOOR] * len(exact)
            (handles[f"{FLOOR:g} dB or less"],) = axis.plot(exact, low, "v", color="black", markersize=9, zorder=3)
    top = axis.get_xaxis_transform()
    nothing = [scale * row["value"] for row in sweep["optimal"] if row[figure] is None]
    if nothing:
        (handles["no such optimal coupling"],) = axis.plot(
            nothing, [0.96] * len(nothing), "kx", markersize=8, transform=top, clip_on=False
        )
    handles["this scenario"] = axis.axvline(here, color="grey", linewidth=0.8, linestyle=(0, (4, 3)), zorder=0)
    if name in ("damping", "period"):
        axis.set_xscale("log")
        ticks = [scale * row["value"] for row in sweep["optimal"]]
        axis.set_xticks(ticks, [f"{tick:.3g}" for tick in ticks])
        axis.set_xticks([], minor=True)
    else:
        axis.set_xticks([row["value"] for row in sweep["optimal"]])
    axis.set_xlabel(f"{sweep['label']}" + ("" if name == "order" else f" [{unit}]"))
    axis.grid(alpha=0.3)
    return handles
