"""Pictures of runs, as in Figures 5 and 6: readable in black and white and by the colour-blind."""

from __future__ import annotations

from pathlib import Path
from typing import Any, BinaryIO

import matplotlib as mpl
import numpy as np

from controller.lti import Array
from sim.files import write
from sim.result import Result

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
