"""The K-B map as one picture: what is certified, what random humans allow, and what was simulated."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, BinaryIO

import matplotlib as mpl
import numpy as np
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from controller.lti import Array
from sim.files import write
from sim.limit_cycles import UNDECIDED
from sim.stability import MARGINAL
from sim.trace import Result
from sim.zwidth import MODEL_KEPT, Map

# ----------------------------------------------------------------------------------------------------
# Pictures of runs, as in Figures 5 and 6: readable in black and white and by the colour-blind.


mpl.use("Agg")

SAME = 1e-6  # [%] what rounding leaves between two forces that are one

#: Okabe and Ito's palette, with a line style each
STYLES: tuple[dict[str, Any], ...] = (
    {"color": "#0072B2", "linestyle": "-"},
    {"color": "#D55E00", "linestyle": "--"},
    {"color": "#009E73", "linestyle": ":"},
    {"color": "#CC79A7", "linestyle": "-."},
    {"color": "#56B4E9", "linestyle": (0, (5, 1, 1, 1, 1, 1))},
    {"color": "#E69F00", "linestyle": (0, (1, 2))},
)


def plot_run(
    result: Result, path: Path, title: str, frequency_hz: float, ideal: tuple[Array, float | None] | None = None
) -> Path:
    """Displacements and forces over the whole run, and about six periods of `frequency_hz` where forces turn sharply.

    `ideal`: forces (N, m) [N] of the ideal environment, drawn behind the others, and how far they are from it [%].
    """
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(2, 2, figsize=(11, 6), layout="constrained", width_ratios=(2, 1), sharex="col")
    near = _zoom(result, frequency_hz)
    for row, (values, label) in enumerate(((1e3 * result.x, "displacement [mm]"), (result.f, "force fed back [N]"))):
        for column, part in enumerate((slice(None), near)):
            for i in _calmest_last(values):
                style = STYLES[i % len(STYLES)]
                width = 0.9 if column == 0 else 1.4
                axes[row, column].plot(
                    result.t[part], values[part, i], label=f"device {i + 1}", linewidth=width, **style
                )
            axes[row, column].grid(alpha=0.3)
        axes[row, 0].set_ylabel(label)
    if ideal:
        _draw_ideal(axes[1], result, ideal, (slice(None), near))
    handles, labels = axes[1, 0].get_legend_handles_labels()
    order = np.argsort(labels)
    figure.legend([handles[i] for i in order], [labels[i] for i in order], loc="outside lower center", ncols=6)
    axes[0, 1].set_title("zoom: where the forces turn most sharply", fontsize=10)
    for column in range(2):
        axes[1, column].set_xlabel("time [s]")
        axes[1, column].margins(x=0.01)
    figure.suptitle(title)

    def content(file: BinaryIO) -> None:
        figure.savefig(file, format="png", dpi=130)

    try:
        return write(path, content)
    finally:
        plt.close(figure)


def _draw_ideal(axes: Array, result: Result, ideal: tuple[Array, float | None], parts: tuple[slice, ...]) -> None:
    """The ideal forces, broad and pale in each device's colour; cut where they are more than three times as large."""
    forces, percent = ideal
    label = "pale: ideal environment"
    if percent is not None:  # of the force before the motors' limit, as in the report
        label += " (the motors were asked for the same)" if percent < SAME else f" (asked force {percent:.2g} % off)"
    for axis, part in zip(axes, parts, strict=True):
        most = 3 * max(map(abs, axis.get_ylim()))
        for i, force in enumerate(forces[part].T):
            axis.plot(result.t[part], force, color=STYLES[i % len(STYLES)]["color"], alpha=0.3, linewidth=3, zorder=1)
        axis.plot([], [], color="#BBBBBB", linewidth=3, label=label)
        low, high = axis.get_ylim()
        axis.set_ylim(max(low, -most), min(high, most))


def plot_accuracy(rows: list[dict[str, Any]], path: Path) -> Path:
    """Cost against both errors, one line per integrator; wrong verdicts are crossed."""
    import matplotlib.pyplot as plt

    errors = {"position_relative_rms": "position error, relative rms", "growth_rate_error": "|growth-rate error| [1/s]"}
    figure, axes = plt.subplots(1, 2, figsize=(11, 4.5), layout="constrained", sharex=True)
    for axis, (key, label) in zip(axes, errors.items(), strict=True):
        names = list(dict.fromkeys(row["integrator"] for row in rows if row["integrator"]))
        for name, style in zip(names, STYLES, strict=False):
            mine = [row for row in rows if row["integrator"] == name and row[key]]
            cost = [row["wall_s_per_simulated_s"] for row in mine]
            axis.loglog(cost, [abs(row[key]) for row in mine], marker="o", label=name, **style)
            for row, c in zip(mine, cost, strict=True):
                axis.annotate(
                    f"x{row['substeps']}", (c, abs(row[key])), fontsize=7, textcoords="offset points", xytext=(4, 4)
                )
                if not row["verdict_correct"]:
                    axis.plot(c, abs(row[key]), "kx", markersize=11)
        axis.set_xlabel("seconds per simulated second")
        axis.set_ylabel(label)
        axis.grid(alpha=0.3)
    axes[0].legend()
    figure.suptitle("speed against error (crossed: wrong verdict)")
    try:
        return write(path, lambda file: figure.savefig(file, format="png", dpi=130))
    finally:
        plt.close(figure)


def _calmest_last(values: Array) -> list[int]:
    """Channels by their sample-to-sample change, so that a calm curve stays visible on an agitated one."""
    return list(np.argsort(-np.square(np.diff(values, axis=0)).sum(axis=0)))


def _zoom(result: Result, frequency_hz: float) -> slice:
    """Six periods where the forces turn most sharply; more where they turn less than six times in them."""
    n = result.t.size
    T = result.t[1] - result.t[0] if n > 1 else 1.0
    width = min(n, max(60, round(6 / (max(frequency_hz, 1.0) * T))))
    bend = np.concatenate([[0.0], (np.diff(result.f, n=2, axis=0) ** 2).sum(axis=1), [0.0]])[:n]
    total = np.concatenate([[0.0], np.cumsum(bend)])
    while True:
        first = int(np.argmax(total[width:] - total[:-width])) if n > width else 0
        part = slice(first, first + width)
        if 4 * width > n or _turns(result.f[part]) >= 6:
            return part
        width *= 2


def _turns(f: Array) -> int:
    """How often the force that does so most turns round; (k, m)."""
    signs = (np.sign(column[column != 0]) for column in np.diff(f, axis=0).T)
    return max((int(np.count_nonzero(np.diff(sign))) for sign in signs), default=0)


def plot_population(mass: Array, damping: Array, growth: Array, path: Path, title: str) -> Path:
    """Growth rate [1/s] of every loop over its humans' mass [kg] and least damping [N s/m]; all shapes (n,).

    Where a loop has several humans, mass and damping are geometric means over them.
    """
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(10, 4.2), layout="constrained", sharey=True)
    kinds = (("stable", growth <= 0, "o", STYLES[0]), ("unstable", growth > 0, "^", STYLES[1]))
    for axis, values, label in zip(
        axes, (mass, damping), ("mass of the human [kg]", "least damping of the human [N s/m]"), strict=True
    ):
        for name, chosen, marker, style in kinds:
            count = f"{name}: {int(chosen.sum())}"
            axis.scatter(values[chosen], growth[chosen], s=10, marker=marker, color=style["color"], label=count)
        axis.axhline(0.0, color="black", linewidth=0.8)
        axis.set(xscale="log", xlabel=label)
        axis.set_yscale("symlog", linthresh=1e-1)
        axis.grid(alpha=0.3)
    axes[0].set_ylabel("growth rate [1/s]")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=2)
    figure.suptitle(title)

    def content(file: BinaryIO) -> None:
        figure.savefig(file, format="png", dpi=130)

    try:
        return write(path, content)
    finally:
        plt.close(figure)


def plot_tightness(rows: list[dict[str, Any]], path: Path) -> Path:
    """Growth rate with the first destabilising human found, over the share of the required damping that was missing."""
    import matplotlib.pyplot as plt

    figure, axis = plt.subplots(figsize=(7, 4.2), layout="constrained")
    for name, style in zip(dict.fromkeys(row["loop"] for row in rows), STYLES, strict=False):
        mine = [row for row in rows if row["loop"] == name]
        short = [100 * row["short"] for row in mine]
        growth = [row["growth_rate_per_s"] if row["found"] else 0.0 for row in mine]
        axis.plot(short, growth, label=name, **style)
        for found, marker in ((True, "^"), (False, "o")):
            chosen = [i for i, row in enumerate(mine) if row["found"] == found]
            axis.plot([short[i] for i in chosen], [growth[i] for i in chosen], marker, color=style["color"])
    axis.plot([], [], "k^", label="somebody destabilises it")
    axis.plot([], [], "ko", label="nobody was found")
    axis.set(
        xlabel="damping missing of what the closed-loop condition requires [%]",
        ylabel="growth with the first human found [1/s]",
    )
    axis.grid(alpha=0.3)
    axis.legend()

    def content(file: BinaryIO) -> None:
        figure.savefig(file, format="png", dpi=130)

    try:
        return write(path, content)
    finally:
        plt.close(figure)


# ----------------------------------------------------------------------------------------------------
# Pictures of couplings over frequency, drawn from the data that `python -m design.plot` writes as JSON.


IDEAL: dict[str, Any] = {"color": "0.45", "linestyle": "-", "linewidth": 3.0, "alpha": 0.55}
#: E, F and M in every panel of singular values
PARTS: tuple[tuple[str, str, dict[str, Any]], ...] = (
    ("sigma_E", "E, the environment", IDEAL),
    ("sigma_F", "F, what the devices see", STYLES[0]),
    ("sigma_M", "M, the mismatch", STYLES[1]),
)
CONDITIONS = {"closed-loop": "closed-loop (this environment)", "theorem4": "theorem4 (any passive environment)"}
DELAYED = "theorem4 (with a multiplier of this environment)"  # psi >= 1
HIGHEST = 20.0  # of the available damping: what a picture of the required one still shows
FLOOR = 1e-4  # of the largest value: what a logarithmic axis still shows


def plot_singular_values(data: dict[str, Any], path: Path) -> Path:
    """E, F and the mismatch M, one panel per coupling; all singular values, the smaller ones thinner."""
    couplings = data["couplings"]
    figure, axes = _panels(1, len(couplings), (4.2, 4.2), "singular values")
    hz = _array(data["frequency_hz"])
    top = max(_array(part).max() for c in couplings for part in (data["sigma_E"], c["sigma_F"], c["sigma_M"]))
    for axis, coupling in zip(axes[0], couplings, strict=True):
        for key, label, style in PARTS:
            values = _array(data[key] if key in data else coupling[key])
            for i, row in enumerate(np.maximum(values, FLOOR * top / 10).T):
                width = (3.0 if style is IDEAL else 1.6) / (1 + i)
                axis.plot(hz, row, label=label if i == 0 else None, **(style | {"linewidth": width}))
        if not _array(coupling["sigma_M"]).any():
            axis.annotate("M = 0", (0.05, 0.05), xycoords="axes fraction", color=STYLES[1]["color"])
        axis.set(xscale="log", yscale="log", title=coupling["name"], xlabel="frequency [Hz]")
        axis.set_ylim(FLOOR * top, 2 * top)
    axes[0, 0].set_ylabel("singular values [N/m]")
    return _save(figure, axes, path)


def plot_required_damping(data: dict[str, Any], path: Path) -> Path:
    """What each condition asks of the devices at each frequency, what they have, and where it binds."""
    figure, axes = _panels(1, 2, (5.5, 4.2), "required damping over frequency; o: where it binds, ^: above the picture")
    hz = _array(data["frequency_hz"])
    scale, unit = _damping_scale(data["available_damping"])
    for axis, (condition, title) in zip(axes[0], CONDITIONS.items(), strict=True):
        axis.axhline(scale, color="black", linewidth=1.2)
        _note(axis, "available", (hz[0], scale))
        parts = [coupling[condition] for coupling in data["couplings"]]
        top = scale * min(max([1.0, *(part["ratio"] or 0.0 for part in parts)]), HIGHEST)
        for coupling, part, style in zip(data["couplings"], parts, STYLES, strict=False):
            if part["demand"] is None:
                axis.plot([], [], label=f"{coupling['name']} (no curve: see the notes)", **style)
                continue
            axis.plot(hz, scale * _array(part["demand"]), label=coupling["name"], **style)
            binds, marker = scale * part["ratio"], "o" if scale * part["ratio"] <= top else "^"
            axis.plot(max(part["binding_frequency_hz"], hz[0]), min(binds, top), marker, color=style["color"])
        axis.axhspan(scale, 1.12 * top, color="black", alpha=0.06, linewidth=0)
        title = DELAYED if condition == "theorem4" and any(data["psi"]) else title
        axis.set(xscale="log", title=title, xlabel="frequency [Hz]", ylim=(-0.5 * scale, 1.12 * top))
        axis.legend(fontsize=8)
    axes[0, 0].set_ylabel(f"required damping{unit}")
    return _save(figure, axes, path, legend=False)


def plot_perceived(data: dict[str, Any], path: Path) -> Path:
    """The effective impedance of each channel as a stiffness and a damping, against the ideal."""
    channels = len(data["available_damping"])
    figure, axes = _panels(
        2, channels, (4.8, 3.2), "perceived by each user, the other devices held still; linear near zero"
    )
    hz = _array(data["frequency_hz"])
    curves = [("ideal: E itself", data["ideal"], IDEAL)]
    curves += [(c["name"], c["perceived"], s) for c, s in zip(data["couplings"], STYLES, strict=False)]
    for row, (key, label) in enumerate((("stiffness", "stiffness [N/m]"), ("damping", "damping [N s/m]"))):
        for i in range(channels):
            for name, values, style in curves:
                axes[row, i].plot(hz, _array(values[key])[:, i], label=name, **style)
            axes[row, i].axhline(0.0, color="black", linewidth=0.7)
            axes[row, i].set(xscale="log")
            _focus(axes[row, i], [_array(values[key])[:, i] for _, values, _ in curves])
        axes[row, 0].set_ylabel(label)
    for i in range(channels):
        axes[0, i].set_title(f"device {i + 1}")
        axes[1, i].set_xlabel("frequency [Hz]")
    return _save(figure, axes, path)


def _focus(axis: Axes, curves: Sequence[Array]) -> None:
    """A symmetric logarithmic axis, linear around zero up to the power of ten below the median size."""
    sizes = np.abs(np.concatenate(curves))
    typical = float(np.median(sizes[sizes > 0])) if (sizes > 0).any() else 1.0
    axis.set_yscale("symlog", linthresh=10.0 ** np.floor(np.log10(typical)))


def _note(axis: Axes, text: str, at: tuple[float, float]) -> None:
    axis.annotate(text, at, textcoords="offset points", xytext=(2, 3), fontsize=8)


def _damping_scale(available: Sequence[float]) -> tuple[float, str]:
    """What one unit of the ratio is worth [N s/m], where all devices are alike; else the ratio itself."""
    alike = len(set(available)) == 1
    return (available[0], " [N s/m]") if alike else (1.0, " over available damping")


def _panels(rows: int, columns: int, size: tuple[float, float], title: str) -> tuple[Figure, Any]:
    import matplotlib.pyplot as plt

    shape = (max(columns * size[0], 5.5), rows * size[1] + 0.6)
    figure, axes = plt.subplots(rows, columns, figsize=shape, layout="constrained", sharex=True, squeeze=False)
    for axis in axes.flat:
        axis.grid(alpha=0.3)
    figure.suptitle(title)
    return figure, axes


def _save(figure: Figure, axes: Any, path: Path, legend: bool = True) -> Path:
    import matplotlib.pyplot as plt
    from matplotlib.ticker import NullFormatter

    for axis in (part for panel in axes.flat for part in (panel.xaxis, panel.yaxis)):
        axis.set_major_formatter("{x:g}")  # 0.1, 1, 10 are read faster than powers of ten, and drawn faster
        axis.set_minor_formatter(NullFormatter())
    if legend:
        figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=4)
    try:
        return write(path, lambda file: figure.savefig(file, format="png", dpi=90))
    finally:
        plt.close(figure)


def _array(values: Any) -> Array:
    """Numbers as they stand in JSON, null as not-a-number (which is not drawn)."""
    return np.array(values, dtype=float)


# ----------------------------------------------------------------------------------------------------
# The picture of design.limits: how good a coupling could be, against what a laboratory could change.


mpl.use("Agg")

#: design -> what it is called, and how it is drawn (Okabe and Ito's palette, told apart in grey by marker and dashes)
CURVES = {
    "optimal": ("the optimal coupling", {"color": "#0072B2", "linestyle": "-", "marker": "o"}),
    "closed-loop": ("spring-damper, closed-loop", {"color": "#D55E00", "linestyle": "--", "marker": "s"}),
    "theorem4": ("spring-damper, theorem4", {"color": "#009E73", "linestyle": ":", "marker": "^"}),
}
#: the floor of the picture [dB]: in case I a loop that needs no coupling has minus infinity
FLOOR_PLOT_LIMITS = -60.0
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
            points = [(x, max(y, FLOOR_PLOT_LIMITS)) for x, y in known]
            (handles[words],) = axis.plot(*zip(*points, strict=True), markersize=5, **style)
        exact = [x for x, y in known if y <= FLOOR_PLOT_LIMITS]
        if exact and kind == "optimal":
            low = [FLOOR_PLOT_LIMITS] * len(exact)
            (handles[f"{FLOOR_PLOT_LIMITS:g} dB or less"],) = axis.plot(
                exact, low, "v", color="black", markersize=9, zorder=3
            )
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


STABLE, UNSTABLE = "#DDEBF4", "#F6D9C6"
#: the broken line lies on the other, so that both are seen where they are the same
LINES: dict[str, dict[str, Any]] = {
    "closed-loop": {"color": STYLES[2]["color"], "linestyle": "-", "linewidth": 3.6},
    "theorem4": {"color": STYLES[0]["color"], "linestyle": "--", "linewidth": 1.8},
    MODEL_KEPT: {"color": STYLES[3]["color"], "linestyle": "-.", "linewidth": 1.8},
}


def plot_zwidth(drawn: Map, outcome: dict[str, Any], path: Path) -> Path:
    """Stiffness over damping; cells are the population's verdict, lines the certificates' edges, symbols MuJoCo's."""
    figure, axes = plt.subplots(figsize=(8, 5.6), layout="constrained")
    about_environment = outcome["axes"] == "environment"
    of = " of the environment's contacts" if about_environment else ""
    axes.set(xscale=drawn.grid.scale, yscale=drawn.grid.scale, xlabel=f"B{of} [N s/m]", ylabel=f"K{of} [N/m]")
    entries = [*_cells(axes, drawn, outcome), *_edges(axes, drawn, about_environment), *_points(axes, drawn, outcome)]
    for mark in outcome.get("marks", ()):
        axes.plot(mark["B"], mark["K"], "*", color="black", markersize=14, clip_on=False, zorder=5)
        axes.annotate(
            f"{mark['K']:g}, {mark['B']:g}", (mark["B"], mark["K"]), (9, 5), textcoords="offset points", zorder=5
        )
    if about_environment:
        entries += _designed_for(axes, drawn, outcome)
    figure.legend(handles=entries, loc="outside lower center", ncols=2, fontsize=8.5)
    figure.suptitle(_title(outcome), fontsize=11)
    try:
        return write(path, lambda file: figure.savefig(file, format="png", dpi=110))
    finally:
        plt.close(figure)


def _cells(axes: Axes, drawn: Map, outcome: dict[str, Any]) -> list[Patch]:
    growth = drawn.growth.reshape(drawn.grid.shape)
    verdict = np.ma.masked_invalid(np.where(np.isnan(growth), np.nan, growth > MARGINAL))
    colours = ListedColormap([STABLE, UNSTABLE])
    edges = [_cell_edges(axis, drawn.grid.scale) for axis in (drawn.grid.B, drawn.grid.K)]
    axes.pcolormesh(*edges, verdict, cmap=colours, vmin=0, vmax=1, rasterized=True)
    humans = outcome["population"]["humans"]
    return [
        Patch(color=STABLE, label=f"exact: stable with all of {humans} humans"),
        Patch(color=UNSTABLE, label="exact: unstable with some"),
    ]


def _cell_edges(axis: Array, scale: str) -> Array:
    """Borders halfway between grid values, with the first and the last value on the border of the picture."""
    values = np.log(axis) if scale == "log" else axis
    borders = np.concatenate([values[:1], (values[1:] + values[:-1]) / 2, values[-1:]])
    return np.exp(borders) if scale == "log" else borders


def _edges(axes: Axes, drawn: Map, about_environment: bool) -> list[Line2D]:
    entries = []
    for name, ratio in drawn.ratio.items():
        style = LINES[name]
        # the edge is where required damping is what is available; far from it the figure is only kept finite
        height = np.ma.masked_invalid(np.clip(ratio, 0, 4).reshape(drawn.grid.shape))
        safe, unsafe = bool((ratio < 1).any()), bool((ratio >= 1).any())
        if safe and unsafe:
            drawing = {"colors": style["color"], "linestyles": style["linestyle"], "linewidths": style["linewidth"]}
            axes.contour(drawn.grid.B, drawn.grid.K, height, [1], **drawing)
        side = "inside this edge" if about_environment else "below this edge"
        what = side if safe and unsafe else "everything here" if safe else "nothing here"
        entries.append(Line2D([], [], label=f"{name} certifies {what}", **style))
    return entries


def _designed_for(axes: Axes, drawn: Map, outcome: dict[str, Any]) -> list[Line2D]:
    """The contact springs of the environment that the coupling was designed for, where they lie on the map."""
    style: dict[str, Any] = {"marker": "P", "markersize": 9, "color": "black", "linestyle": "none"}
    shown = [(s["B"], s["K"]) for s in outcome["designed_for"]["contact_springs"]]
    for b, k in shown:
        if drawn.grid.B[0] <= b <= drawn.grid.B[-1] and drawn.grid.K[0] <= k <= drawn.grid.K[-1]:
            axes.plot(b, k, zorder=5, markeredgecolor="white", **style)
    return [Line2D([], [], label="the springs that the coupling was designed for", **style)]


def _points(axes: Axes, drawn: Map, outcome: dict[str, Any]) -> list[Line2D]:
    points = outcome["simulation"]["points"]
    if not points:
        return []
    entries, effects = [], "" if outcome["simulation"]["nonlinear"] else ", linear loop"
    kinds = (("rests", "o", "white"), ("oscillates", "X", STYLES[1]["color"]), (UNDECIDED, "D", "grey"))
    for word, marker, face in kinds:
        some = [p for p in points if p["verdict"] == word]
        if not some:
            continue
        style = {"marker": marker, "markersize": 5.5, "markerfacecolor": face, "markeredgecolor": "black"}
        style |= {"linestyle": "none", "markeredgewidth": 0.7}
        axes.plot([p["B"] for p in some], [p["K"] for p in some], clip_on=False, zorder=4, **style)
        entries.append(Line2D([], [], label=f"MuJoCo{effects}: {word} ({len(some)})", **style))
    other = [p for p in points if p["differs_from_linear"]]
    if other:
        style = {"marker": "o", "markersize": 11, "markerfacecolor": "none", "markeredgecolor": STYLES[3]["color"]}
        style |= {"linestyle": "none", "markeredgewidth": 1.6}
        axes.plot([p["B"] for p in other], [p["K"] for p in other], clip_on=False, zorder=4, **style)
        entries.append(Line2D([], [], label=f"unlike the linear loop ({len(other)})", **style))
    return entries


def _title(outcome: dict[str, Any]) -> str:
    what = "rigid wall" if outcome["rigid"] else outcome["scenario"]
    if outcome["coupling"]:
        what += f", {outcome['coupling']['kind']} coupling"
    if outcome["one_sided"]:
        what += ", one-sided"
    parts = [
        f"theta {_list(outcome['theta'])}",
        f"T {1e3 * outcome['T']:g} ms",
        f"delta {_list(outcome['delta'])} N s/m",
    ]
    if any(outcome["psi"]):
        parts.append(f"psi {_list(outcome['psi'])}")
    if outcome["velocity_filter_hz"]:
        parts.append(f"velocity filter {outcome['velocity_filter_hz']:g} Hz")
    effects = outcome["simulation"]["effects"]
    if any(effects["encoder_step_m"]):
        parts.append(f"encoder step {1e6 * max(effects['encoder_step_m']):g} um")
    if any(effects["friction_n"]):
        parts.append(f"friction {max(effects['friction_n']):g} N")
    if effects["force_limit_n"]:
        parts.append(f"limit {_list(effects['force_limit_n'])} N")
    head = f"{what}: {', '.join(parts[:3])}"
    return head if len(parts) == 3 else f"{head}\n{', '.join(parts[3:])}"


def _list(values: list[float]) -> str:
    return (
        ", ".join(f"{v:g}" for v in dict.fromkeys(values))
        if len(set(values)) == 1
        else ", ".join(f"{v:g}" for v in values)
    )
