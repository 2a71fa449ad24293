"""The picture of a Z-width map: edges of certified regions, verdicts with random humans, and simulated cells."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from haptic_loop.controller.lti import Array
from haptic_loop.design.result import ANY, GUARD, TITLES, suffices
from haptic_loop.sim import plots
from haptic_loop.sim.limit_cycles import UNDECIDED
from haptic_loop.sim.stability import MARGINAL
from haptic_loop.sim.zwidth import Map
from haptic_loop.sim.zwidth_report import MapReport

_STABLE, _UNSTABLE = "#DDEBF4", "#F6D9C6"  # colours of areas

#: lines in the order of drawing; if a dashed line lies on the solid line before it, both are visible
_LINES: dict[str, dict[str, Any]] = {
    "this-environment": plots.STYLES[2] | {"linestyle": "-", "linewidth": 3.6},
    "any-environment": plots.STYLES[0] | {"linestyle": "--", "linewidth": 1.8},
    "known-device": plots.STYLES[1] | {"linestyle": "-", "linewidth": 3.6},
    "known-device-any": plots.STYLES[4] | {"linestyle": "--", "linewidth": 1.8},
}
_OWN_LINE: dict[str, Any] = plots.STYLES[4] | {"linestyle": ":", "linewidth": 2.2}  # line of a user's own condition


def plot_zwidth(drawn: Map, report: MapReport, path: Path) -> Path:
    """Plot K over B, and return the path. Cells show the population, lines the certificates, and symbols MuJoCo."""
    figure = Figure((8, 5.6), layout="constrained")
    axes = figure.subplots()
    about_environment = report.fixed is not None
    of = " of the environment's contacts" if about_environment else ""
    axes.set(xscale=drawn.grid.scale, yscale=drawn.grid.scale, xlabel=f"B{of} [N s/m]", ylabel=f"K{of} [N/m]")
    entries = [*_cells(axes, drawn, report), *_edges(axes, drawn, report), *_points(axes, report)]
    for mark in report.marks or ():
        place = max(mark.B, drawn.grid.B[0]), mark.K  # A logarithmic map shows marks with B = 0 on its border.
        axes.plot(*place, "*", color="black", markersize=14, clip_on=False, zorder=5)
        axes.annotate(f"{mark.K:g}, {mark.B:g}", place, (9, 5), textcoords="offset points", zorder=5)
    if about_environment:
        entries += _designed_for(axes, drawn, report)
    figure.legend(handles=entries, loc="outside lower center", ncols=2, fontsize=8.5)
    figure.suptitle(_title(report), fontsize=11)
    return plots.save(figure, path, 110)


def _cells(axes: Axes, drawn: Map, report: MapReport) -> list[Patch]:
    growth = drawn.growth.reshape(drawn.grid.shape)
    verdict = np.ma.masked_invalid(np.where(np.isnan(growth), np.nan, growth > MARGINAL))
    colours = ListedColormap([_STABLE, _UNSTABLE])
    edges = [_cell_edges(axis, drawn.grid.scale) for axis in (drawn.grid.B, drawn.grid.K)]
    axes.pcolormesh(*edges, verdict, cmap=colours, vmin=0, vmax=1, rasterized=True)
    humans = report.population.humans
    return [
        Patch(color=_STABLE, label=f"exact: stable with all of {humans} humans"),
        Patch(color=_UNSTABLE, label="exact: unstable with some"),
    ]


def _cell_edges(axis: Array, scale: str) -> Array:
    """Return borders halfway between grid values, with the first and the last value on the picture's border."""
    values = np.log(axis) if scale == "log" else axis
    borders = np.concatenate([values[:1], (values[1:] + values[:-1]) / 2, values[-1:]])
    return np.exp(borders) if scale == "log" else borders


def _edges(axes: Axes, drawn: Map, report: MapReport) -> list[Line2D]:
    entries = []
    # With psi > 0 any-environment (Theorem 4) covers only the environment of the cell.
    titles = {name: title for name, title in TITLES.items() if title != ANY or not any(report.psi)}
    order = [*_LINES, *drawn.ratio]
    for name, ratio in sorted(drawn.ratio.items(), key=lambda item: order.index(item[0])):
        style = _LINES.get(name, _OWN_LINE)
        # The edge is the contour 1 - GUARD of required over available damping. Clipping makes infinite ratios finite.
        height = np.ma.masked_invalid(np.clip(ratio, 0, 4).reshape(drawn.grid.shape))
        safe, unsafe = bool(suffices(ratio).any()), bool((ratio >= 1 - GUARD).any())
        if safe and unsafe:
            drawing = {"colors": style["color"], "linestyles": style["linestyle"], "linewidths": style["linewidth"]}
            axes.contour(drawn.grid.B, drawn.grid.K, height, [1 - GUARD], **drawing)
        where = "everywhere here" if safe else "nowhere here"
        if safe and unsafe:
            where = f"{_side(ratio, drawn, report)} this edge"
        label = f"{titles.get(name, name)}: certified {where}"
        entries.append(Line2D([], [], label=label, **style))
    return entries


def _side(ratio: Array, drawn: Map, report: MapReport) -> str:
    """Return on which side of its edge the certified part of the map lies: "below", "above" or "inside"."""
    certified = suffices(ratio).reshape(drawn.grid.shape)  # The rows are stiffnesses, the softest first.
    if report.fixed is None and not (certified[1:] > certified[:-1]).any():
        return "below"
    return "above" if report.fixed is None and not (certified[1:] < certified[:-1]).any() else "inside"


def _designed_for(axes: Axes, drawn: Map, report: MapReport) -> list[Line2D]:
    """Draw the contact springs of the scenario's environment that lie on the map; return the entry of the legend."""
    style: dict[str, Any] = {"marker": "P", "markersize": 9, "color": "black", "linestyle": "none"}
    shown = [(s.B, s.K) for s in report.fixed.contact_springs] if report.fixed else []
    for b, k in shown:
        if drawn.grid.B[0] <= b <= drawn.grid.B[-1] and drawn.grid.K[0] <= k <= drawn.grid.K[-1]:
            axes.plot(b, k, zorder=5, markeredgecolor="white", **style)
    return [Line2D([], [], label="the contact springs of the scenario", **style)]


def _points(axes: Axes, report: MapReport) -> list[Line2D]:
    points = report.simulation.points
    if not points:
        return []
    entries, effects = [], "" if report.simulation.nonlinear else ", linear loop"

    def draw(some: Sequence[Any], label: str, **style: Any) -> None:
        style["linestyle"] = "none"
        axes.plot([p.B for p in some], [p.K for p in some], clip_on=False, zorder=4, **style)
        entries.append(Line2D([], [], label=f"{label} ({len(some)})", **style))

    kinds = (("rests", "o", "white"), ("oscillates", "X", plots.STYLES[1]["color"]), (UNDECIDED, "D", "grey"))
    for word, marker, face in kinds:
        if some := [p for p in points if p.verdict == word]:
            edge = {"markeredgecolor": "black", "markeredgewidth": 0.7}
            draw(some, f"MuJoCo{effects}: {word}", marker=marker, markersize=5.5, markerfacecolor=face, **edge)
    if other := [p for p in points if p.differs_from_linear]:
        edge = {"markeredgecolor": plots.STYLES[3]["color"], "markeredgewidth": 1.6}
        draw(other, "unlike the linear loop", marker="o", markersize=11, markerfacecolor="none", **edge)
    return entries


def _title(report: MapReport) -> str:
    subject = report.scenario or "rigid wall"
    if report.fixed:
        subject += f", {report.fixed.kind} coupling"
    if report.walls:
        subject += ", with walls"
    parts = [
        f"theta {_list(report.theta)}",
        f"T {1e3 * report.T:g} ms",
        f"delta {_list(report.delta)} N s/m",
    ]
    if any(report.psi):
        parts.append(f"psi {_list(report.psi)}")
    effects = report.simulation.effects
    if any(effects.encoder_step_m):
        parts.append(f"encoder step {1e6 * max(effects.encoder_step_m):g} um")
    if any(effects.friction_n):
        parts.append(f"friction {max(effects.friction_n):g} N")
    head = f"{subject}: {', '.join(parts[:3])}"
    return head if len(parts) == 3 else f"{head}\n{', '.join(parts[3:])}"


def _list(values: Sequence[float]) -> str:
    return ", ".join(f"{v:g}" for v in (values if len(set(values)) > 1 else values[:1]))
