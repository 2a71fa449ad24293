"""Pictures that commands write, in one style that is readable in black and white and by the colour-blind.

A function plot_.. writes one picture and returns its path; a function draw_.. returns its figure.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties, findfont, get_font
from matplotlib.lines import Line2D
from matplotlib.text import Text
from matplotlib.ticker import NullFormatter
from PIL import Image

from haptic_loop.controller.units import PositionUnit, in_unit
from haptic_loop.design.files import InputError, printable, write
from haptic_loop.sim.shown import Contacts, Onset, Signals

# The second process that draws a run (cli.painter) does not need controller.lti, and starts faster without it.
if TYPE_CHECKING:
    from haptic_loop.controller.lti import Array

Row = Comparison = Any  # sim.accuracy.Row and sim.comparison.Comparison; importing them would be circular


# ---- the style

#: Okabe and Ito's palette, with a line style for each colour
STYLES: tuple[dict[str, Any], ...] = (
    {"color": "#0072B2", "linestyle": "-"},
    {"color": "#D55E00", "linestyle": "--"},
    {"color": "#009E73", "linestyle": ":"},
    {"color": "#CC79A7", "linestyle": "-."},
    {"color": "#56B4E9", "linestyle": (0, (5, 1, 1, 1, 1, 1))},
    {"color": "#E69F00", "linestyle": (0, (1, 2))},
)
#: style of ideal curves: broad and grey
_IDEAL: dict[str, Any] = {"color": "0.45", "linestyle": "-", "linewidth": 3.0, "alpha": 0.55}


def _panels(
    title: str, rows: int, columns: int, size: tuple[float, float], layout: Any = "constrained", **shared: Any
) -> tuple[Figure, Any]:
    """Return a figure of `size` [inch] with a title, and its axes (rows, columns), each with grid lines."""
    figure = Figure(size, layout=layout)
    axes = figure.subplots(rows, columns, squeeze=False, **shared)
    for axis in axes.flat:
        axis.grid(alpha=0.3)
    figure.suptitle(title)
    return figure, axes


def _arrange(figure: Figure, axes: Any) -> None:
    """Make room for labels of the axes (rows, columns) and the legend, twice as fast as the constrained layout."""
    renderer, (width, height) = FigureCanvasAgg(figure).get_renderer(), figure.get_size_inches()

    def room(axis: Any, side: int) -> float:
        """Return the room [inch] that labels need on the left (side 0) or below (side 1) of their axes."""
        box = axis.get_tightbbox(renderer)
        return 0.0 if box is None else (axis.axes.bbox.min[side] - box.min[side]) / figure.dpi + _MARGIN

    (columns, rows), dpi = axes.T.shape, figure.dpi
    left = [max(room(panel.yaxis, 0) for panel in column) for column in axes.T]
    below = [max(room(panel.xaxis, 1) for panel in row) for row in axes]
    titled = [_MARGIN + _TITLE * any(panel.get_title() for panel in row) for row in axes]
    below[-1] += sum(legend.get_window_extent(renderer).height for legend in figure.legends) / dpi + _MARGIN
    titled[0] += _TITLE * (1 + figure.get_suptitle().count("\n"))
    across, down = sum(left[1:]), sum(below[:-1]) + sum(titled[1:])
    figure.subplots_adjust(
        left=left[0] / width,
        right=1 - _MARGIN / width,
        bottom=below[-1] / height,
        top=1 - titled[0] / height,
        wspace=columns * across / max(columns - 1, 1) / (width - left[0] - _MARGIN - across),
        hspace=rows * down / max(rows - 1, 1) / (height - below[-1] - titled[0] - down),
    )


_MARGIN, _TITLE = 0.12, 0.22  # [inch] margin around panels, labels and legends; height of a line of a title


def _legend(figure: Figure, entries: dict[str, Any], columns: int, **style: Any) -> None:
    """Draw a legend below all panels. `entries` maps labels to drawn objects."""
    figure.legend(list(entries.values()), list(entries), loc="outside lower center", ncols=columns, **style)


def _entries(axis: Axes) -> dict[str, Any]:
    handles, labels = axis.get_legend_handles_labels()
    return dict(zip(labels, handles, strict=True))


_FORMATS = (".png", ".pdf", ".svg")


def relabel(figure: Figure, unit: PositionUnit | None = None) -> None:
    """Rewrite the texts of a figure in `unit`; the default is the unit of the running command."""
    for text in _texts(figure):
        text.set_text(in_unit(text.get_text(), unit))


def _texts(figure: Figure) -> list[Text]:
    """Return all texts but tick labels. Unlike `findobj`, this does not create all ticks, which is slow."""
    texts = list(figure.texts)
    for axis in figure.axes:
        texts += [axis.title, axis.xaxis.label, axis.yaxis.label, *axis.texts]
    for legend in (*figure.legends, *filter(None, (axis.get_legend() for axis in figure.axes))):
        texts += [legend.get_title(), *legend.get_texts()]
    return texts


def save(figure: Figure, path: Path, dpi: int = 130) -> Path:
    """Write the figure in the format of the suffix, and return its path. Only tick labels may contain formulas.

    A .png is for the screen. A .pdf or .svg is for a paper: it is at most as wide as a page with two columns, and has
    letters that are readable at this width.

    Raises:
        InputError: The suffix is none of .png, .pdf and .svg, or the file cannot be written.
    """
    kind = Path(path).suffix.lower()
    if kind not in _FORMATS:
        raise InputError(f"picture {path}: the suffix is {kind!r}, allowed are {', '.join(_FORMATS)}")
    if kind == ".png":
        return write(path, png(figure, dpi))
    _literal(figure)
    relabel(figure)
    figure.set_layout_engine("constrained")
    _fit_paper(figure)
    return write(path, lambda file: figure.savefig(file, format=kind[1:], dpi=dpi))


def png(figure: Figure, dpi: int = 130) -> bytes:
    """Return the content of a PNG file of the figure. Only tick labels may contain formulas."""
    _literal(figure)
    relabel(figure)
    figure.set_dpi(dpi)
    content, canvas = BytesIO(), FigureCanvasAgg(figure)
    canvas.draw()  # `savefig` would draw a figure twice if it has a layout.
    # Every pixel is opaque. Without opacity and with compression 1, a file takes half the time and is 6 % smaller.
    opaque = Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3])
    opaque.save(content, "png", compress_level=1, dpi=(dpi, dpi))
    return content.getvalue()


_PAGE = 7.16  # [inch] width of both columns of an IEEE page; other papers with two columns are nearly as wide
_LEGEND = 0.8  # number of legend columns per entry in a figure that is not shrunk
_LETTERS = (6.5, 9.0)  # [pt] smallest and largest letters in a paper


def _fit_paper(figure: Figure) -> None:
    width, height = figure.get_size_inches()
    share = min(1.0, _PAGE / width)
    figure.set_size_inches(share * width, share * height)
    for text in figure.findobj(Text):
        text.set_fontsize(min(max(share * float(text.get_fontsize()), _LETTERS[0]), _LETTERS[1]))
    for line in figure.findobj(Line2D):
        line.set_linewidth(max(share * line.get_linewidth(), 0.4))
    for old in tuple(figure.legends):  # Letters shrink less than the figure, so fewer columns fit.
        entries = dict(zip([text.get_text() for text in old.get_texts()], old.legend_handles, strict=True))
        columns = max(1, int(_LEGEND * share * len(entries)))
        old.remove()
        _legend(figure, entries, min(columns, 4), fontsize=_LETTERS[0])


def _literal(figure: Figure) -> None:
    """Show all texts but tick labels without formulas, and replace characters that the font lacks."""
    glyphs = get_font(findfont(FontProperties())).get_charmap()
    for text in _texts(figure):
        text.set_parse_math(False)
        shown = printable(text.get_text())
        text.set_text("".join(c if ord(c) in glyphs or c == "\n" else "\N{REPLACEMENT CHARACTER}" for c in shown))


def _plain_numbers(axes: Any) -> None:
    """Label axes with plain numbers such as 0.1, which are drawn faster than powers such as 10^-1."""
    for axis in (part for panel in axes.flat for part in (panel.xaxis, panel.yaxis)):
        axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter(NullFormatter())


# ---- runs, as in the paper's Figures 5 and 6

_SAME = 1e-6  # [%] A smaller force error is rounding, so the commanded force equals that of the object itself.


def draw_run(
    result: Signals,
    title: str,
    frequency_hz: float,
    ideal: tuple[Array, float | None] | None = None,
    onset: Onset | None = None,
    around: Contacts | None = None,
) -> Figure:
    """Return a figure of displacements and forces of a run, with a zoom where the forces turn most sharply.

    Args:
        result: The signals of the run.
        title: The title of the figure.
        frequency_hz: The frequency of the oscillation, for the widths of the zoom and of the windows of amplitudes.
        ideal: Forces (N, m) [N] of the ideal environment, drawn behind the forces of the run, and the force error [%].
        onset: The part of the run that is not credible, which is drawn in grey. If the loop grows, the amplitude of the
            oscillation and its prediction replace the zoom of the displacements.
        around: Names of the curves, and walls.
    """
    growth, around = onset.growth if onset else None, around or Contacts(result.names)
    parts = _shown_parts(result, frequency_hz, onset)
    zoomed = len(parts) > 1
    shape: dict[str, Any] = {"width_ratios": (2, 1)} if zoomed else {}
    shared = False if growth is not None else "col"
    figure, axes = _panels(title, 2, len(parts), (11, 6.4), layout=None, sharex=shared, **shape)
    if growth is not None:
        axes[0, 0].sharex(axes[1, 0])
    _draw_displacements(axes[0] if growth is None else axes[0, :1], result, parts, around)
    _draw_walls(axes[:, 0], result, around)
    _draw_forces(axes[1], result, parts, around)
    if ideal:
        _draw_ideal(axes[1], result, ideal, parts)
    if onset and onset.until is not None:
        _grey_out(axes[:, 0], result, onset.until)
    if onset and growth is not None:
        _draw_onset(axes[0, 1], result, frequency_hz, onset, around)
    entries = _entries(axes[0, 0]) | _entries(axes[1, 0])
    _legend(figure, _ordered(entries, around), 3 if len(entries) > 6 else 6, fontsize=9)
    if zoomed:
        zoom = axes[0, 1] if growth is None else axes[1, 1]
        zoom.set_title("zoom: where the forces turn most sharply", fontsize=10)
    for axis in axes[1]:
        axis.set_xlabel("time [s]")
        axis.margins(x=0.01)
    _arrange(figure, axes)
    return figure


def _shown_parts(result: Signals, frequency_hz: float, onset: Onset | None) -> tuple[slice, ...]:
    """Return slices of ticks: that of the whole run and, if there is a zoom, that of the zoom.

    There is a zoom if the loop grows, or if the forces turn far more sharply there than elsewhere. The zoom ends before
    the run leaves the credible limits and, if the loop grows, before the first clipped force.
    """
    last, grows = result.t.size, onset is not None and onset.growth is not None
    if onset and onset.until is not None:
        last = int(np.searchsorted(result.t, onset.until))
    if onset and grows:
        last = min(last, onset.steady)
    near = _sharpest(result, frequency_hz, last if last > 1 else result.t.size)
    return (slice(None), near) if grows or _stands_out(result, near, last) else (slice(None),)


def _ordered(entries: dict[str, Any], around: Contacts) -> dict[str, Any]:
    """Return the curves of the legend channel by channel; those of handles come first."""
    names = around.names or [f"device {i}" for i in range(1, 100)]

    def place(label: str) -> tuple[int, bool, str]:
        mine = [i for i, name in enumerate(names) if label == name or label.startswith((f"{name},", f"{name} ("))]
        return (mine[0] if mine else len(names), "handle" not in label, label)

    return dict(sorted(entries.items(), key=lambda entry: place(entry[0])))


def _two_points(result: Signals) -> bool:
    """Return whether handles and encoders differ visibly in a picture."""
    return bool(np.abs(result.x_handle - result.x).max(initial=0.0) > 0.02 * np.abs(result.x).max(initial=0.0))


def _handles_known(result: Signals) -> bool:
    """Return whether the displacements of the handles are known; a session measures those of the encoders only."""
    return not np.isnan(result.x_handle).any()


def _calmest_last(values: Array) -> list[int]:
    """Return the channels in the order of drawing: those that change fastest first."""
    return np.argsort(-np.square(np.diff(values, axis=0)).sum(axis=0)).tolist()


_ALIKE = 0.005  # Two curves look the same if their difference is smaller, relative to the largest value.


def _coinciding(values: Array, around: Contacts) -> list[str]:
    """Return a label suffix for each column of `values` (N, m), which names an earlier curve that looks the same."""
    scale = np.abs(values).max(initial=0.0)
    ends = [""] * values.shape[1]
    for i in range(1, values.shape[1]):
        on = [j for j in range(i) if np.abs(values[:, i] - values[:, j]).max(initial=0.0) <= _ALIKE * scale]
        ends[i] = f" (the same curve as {around.name(on[0])})" if on and scale else ""
    return ends


_SHARPER = 4.0  # least ratio, zoom over whole run, of the mean square of the forces' second differences


def _stands_out(result: Signals, near: slice, ticks: int) -> bool:
    """Return whether the part `near` is short, and forces turn far more sharply in it than in the first `ticks`."""
    if 10 * (near.stop - near.start) > result.t.size:
        return False
    bend = np.square(np.diff(result.f[:ticks], n=2, axis=0)).sum(axis=1)
    return bool(bend[near.start : near.stop].mean() > _SHARPER * bend.mean())


def _one_point(result: Signals) -> str:
    """Return the label of the displacement axis, if each curve shows handle and encoder at once, or an encoder."""
    if not _handles_known(result):
        return "displacement of the encoder [mm]"
    apart = 1e3 * float(np.abs(result.x_handle - result.x).max(initial=0.0))
    beside = f"within {apart:.1g} mm of the encoder" if apart > 1e-9 else "where the encoder is"
    return f"displacement of the handle [mm],\n{beside}"


def _draw_walls(axes: Array, result: Signals, around: Contacts) -> None:
    for i, place, name in around.walls:
        colour = STYLES[i % len(STYLES)]["color"]
        axes[0].axhline(1e3 * place, color=colour, linestyle=(0, (2, 2)), linewidth=1.0, label=name)
    if around.touching is None or not around.touching.any():
        return
    edges = np.flatnonzero(np.diff(np.concatenate([[0], around.touching.astype(int), [0]])))
    for axis in axes:
        for k, (first, stop) in enumerate(edges.reshape(-1, 2)):
            label = "in contact with a wall" if k == 0 and axis is axes[0] else None
            span = result.t[first], result.t[min(stop, result.t.size - 1)]
            axis.axvspan(*span, color="#F0E442", alpha=0.35, zorder=0, linewidth=0, label=label)


def _draw_displacements(axes: Array, result: Signals, parts: tuple[slice, ...], around: Contacts) -> None:
    """Draw encoders and, over them, handles [mm].

    If both look the same in the picture, draw only handles; if handles were not measured (nan), draw only encoders.
    """
    two, alike = _two_points(result), _coinciding(result.x, around)
    one = result.x_handle if _handles_known(result) else result.x
    for axis, part, width in zip(axes, parts, (0.9, 1.4), strict=False):
        for i in _calmest_last(result.x):
            style = STYLES[i % len(STYLES)]
            label = f"{around.name(i)}, encoder (thin)" if two else around.name(i)
            if alike[i] and not two:
                label += f", displacement{alike[i]}"
            thin, x = (0.5 * width, result.x) if two else (width, one)
            axis.plot(result.t[part], 1e3 * x[part, i], label=label, linewidth=thin, **style)
        if two:
            for i in _calmest_last(result.x_handle):
                style = STYLES[i % len(STYLES)]
                label, handle = f"{around.name(i)}, handle (thick)", 1e3 * result.x_handle[part, i]
                axis.plot(result.t[part], handle, label=label, linewidth=2.2 * width, **style)
    axes[0].set_ylabel("displacement [mm]" if two else _one_point(result))


def _draw_forces(axes: Array, result: Signals, parts: tuple[slice, ...], around: Contacts) -> None:
    """Draw the forces. Calm curves are drawn last, so that no agitated curve hides them."""
    two, alike = _two_points(result), _coinciding(result.f, around)
    for axis, part, width in zip(axes, parts, (0.9, 1.4), strict=False):
        for i in _calmest_last(result.f):
            style = STYLES[i % len(STYLES)]
            label = f"{around.name(i)}, force" if two or alike[i] else around.name(i)
            axis.plot(result.t[part], result.f[part, i], label=label + alike[i], linewidth=width, **style)
    axes[0].set_ylabel("force fed back [N]")


def _grey_out(axes: Array | list[Axes], result: Signals, until: float) -> None:
    """Grey out the run after `until` [s], where the linear model of the devices is no longer credible."""
    for axis in axes:
        axis.axvspan(until, result.t[-1], color="0.85", alpha=0.75, zorder=5, linewidth=0)
    text = "grey: beyond the devices'\ncredible force or speed"
    where: dict[str, Any] = {"xycoords": "axes fraction", "textcoords": "offset points", "ha": "right", "va": "top"}
    axes[0].annotate(text, (1.0, 1.0), (-6, -5), fontsize=8, zorder=6, **where)


def _draw_onset(axis: Axes, result: Signals, hertz: float, onset: Onset, around: Contacts) -> None:
    """Draw the amplitude of the oscillation at the encoders up to the first clipped tick, and its prediction."""
    assert onset.growth is not None
    t, sizes = _amplitudes(result, hertz, onset.steady)
    axis.set_title(f"{hertz:.0f} Hz oscillation until a force clips", fontsize=10)
    axis.set(yscale="log", xlabel="time [s]", ylabel="amplitude at the encoder [mm]")
    if not t.size:
        return
    for i, column in enumerate(1e3 * sizes.T):
        axis.plot(t, column, label=around.name(i), linewidth=1.6, **STYLES[i % len(STYLES)])
    loudest = int(np.argmax(sizes[-1]))
    # The level is fitted to the last third of the amplitudes, where only the dominant mode is left.
    # The curve is drawn 25 % higher, so that it does not hide the amplitudes.
    late = slice(2 * t.size // 3, None)
    level = np.exp(np.mean(np.log(sizes[late, loudest]) - onset.growth * t[late]))
    predicted = 1e3 * level * np.exp(onset.growth * t)
    label = f"slope predicted: {onset.growth:+.3g} 1/s"
    axis.plot(t, 1.25 * predicted, color="black", linestyle=(0, (6, 3)), linewidth=1.2, label=label)
    if onset.until is not None and onset.until < t[-1]:
        axis.axvspan(onset.until, t[-1], color="0.85", alpha=0.75, linewidth=0)
    axis.set_ylim(bottom=max(1e3 * sizes[sizes > 0].min(), 1e-5 * predicted[-1]))
    axis.legend(fontsize=8, loc="lower right")


def _amplitudes(result: Signals, hertz: float, ticks: int) -> tuple[Array, Array]:
    """Return times (k,) [s] and amplitudes (k, m) [m] of the encoders' oscillation at `hertz`.

    A window has 12 periods. Both arrays are empty if `ticks` is less than two windows.
    """
    T = float(result.t[1] - result.t[0]) if result.t.size > 1 else 1.0
    width = max(8, round(12 / (max(hertz, 1.0) * T)))
    if ticks < 2 * width:
        return np.empty(0), np.empty((0, result.x.shape[1]))
    window, starts = np.hanning(width), np.arange(0, ticks - width, max(1, width // 4))
    # The second difference removes a hand's slow motion. It multiplies the oscillation by `factor`.
    fast = np.diff(result.x[:ticks], n=2, axis=0, prepend=result.x[:1], append=result.x[ticks - 1 : ticks])
    turning = window * np.exp(-2j * np.pi * hertz * T * np.arange(width))
    sums = np.array([turning @ fast[k : k + width] for k in starts])
    factor = 4 * np.sin(np.pi * hertz * T) ** 2
    return result.t[starts] + 0.5 * width * T, 2 * np.abs(sums) / (window.sum() * factor)


def _draw_ideal(axes: Array, result: Signals, ideal: tuple[Array, float | None], parts: tuple[slice, ...]) -> None:
    """Draw the ideal forces broad and pale, and cut them off at three times the largest force of the run."""
    forces, percent = ideal
    label = "pale: the force of the object itself for this motion"
    if percent is not None:
        label += " (equal to the commanded force)" if percent < _SAME else f" (force error {percent:.2g} %)"
    for axis, part in zip(axes, parts, strict=True):
        most = 3 * max(map(abs, axis.get_ylim()))
        for i, force in enumerate(forces[part].T):
            axis.plot(result.t[part], force, color=STYLES[i % len(STYLES)]["color"], alpha=0.3, linewidth=3, zorder=1)
        axis.plot([], [], color="#BBBBBB", linewidth=3, label=label)
        low, high = axis.get_ylim()
        axis.set_ylim(max(low, -most), min(high, most))


def _sharpest(result: Signals, frequency_hz: float, ticks: int | None = None) -> slice:
    """Return the part of the first `ticks` in which the forces turn most sharply.

    The part has six periods (of at most 1 s), or 60 ticks if these are longer. Its length is doubled, up to half of the
    ticks, until some force has six turning points in the part.
    """
    n = result.t.size if ticks is None else ticks
    T = result.t[1] - result.t[0] if n > 1 else 1.0
    width = min(n, max(60, round(6 / (max(frequency_hz, 1.0) * T))))
    bend = np.concatenate([[0.0], (np.diff(result.f[:n], n=2, axis=0) ** 2).sum(axis=1), [0.0]])[:n]
    total = np.concatenate([[0.0], np.cumsum(bend)])
    while True:
        first = int(np.argmax(total[width:] - total[:-width])) if n > width else 0
        part = slice(first, first + width)
        if 4 * width > n or _turns(result.f[part]) >= 6:
            return part
        width *= 2


def _turns(f: Array) -> int:
    """Return the largest number of turning points of any of the forces f (k, m)."""
    signs = (np.sign(column[column != 0]) for column in np.diff(f, axis=0).T)
    return max((int(np.count_nonzero(np.diff(sign))) for sign in signs), default=0)


@dataclass(frozen=True, eq=False)
class Panel:
    """The data of one panel."""

    title: str
    trace: Signals
    ideal: Array  # (N, m) forces of the ideal environment [N]
    until: float | None = None  # [s] time at which the run stops being credible; None if it never does


def plot_side_by_side(panels: Sequence[Panel], path: Path, names: Sequence[str] = ()) -> Path:
    """Plot the forces of several couplings on equal axes, with a panel for each coupling.

    Pale curves are the object's own forces. The axes reach to 1.5 times the largest ideal force of the credible runs
    (of all runs if none is credible), and cut off larger forces.
    """
    columns, around = 2 if len(panels) > 1 else 1, Contacts(names)
    rows = -(-len(panels) // columns)
    title, size = "the same devices, hands and object, another coupling in each panel", (11, 3.1 * rows + 0.6)
    figure, axes = _panels(title, rows, columns, size, sharex=True, sharey=True)
    calm = [panel.ideal for panel in panels if panel.until is None] or [panel.ideal for panel in panels]
    most = 1.5 * max(float(np.abs(force).max(initial=1e-9)) for force in calm)
    for axis, panel in zip(axes.flat, panels, strict=False):
        axis.set_ylim(-most, most)
        for i in _calmest_last(panel.trace.f):
            style = STYLES[i % len(STYLES)]
            ideal = panel.ideal[:, i]
            axis.plot(panel.trace.t, ideal, color=style["color"], alpha=0.3, linewidth=5, zorder=1)
            axis.plot(panel.trace.t, panel.trace.f[:, i], label=around.name(i), linewidth=1.1, **style)
        if panel.until is not None:
            _grey_out([axis], panel.trace, panel.until)
        axis.set_title(panel.title, fontsize=10)
        axis.margins(x=0.01)
    for axis in axes.flat[len(panels) :]:
        axis.set_visible(False)
    for axis in axes[:, 0]:
        axis.set_ylabel("force [N]")
    for axis in axes[-1]:
        axis.set_xlabel("time [s]")
    pale = "pale: the force of the object itself for this motion, with the reference delay"
    axes[0, 0].plot([], [], color="#BBBBBB", linewidth=5, label=pale)
    _legend(figure, _ordered(_entries(axes[0, 0]), around), 6)
    return save(figure, path)


# ---- checks: engines against each other, and random humans


def plot_accuracy(rows: Sequence[Row], path: Path) -> Path:
    """Plot position and growth-rate errors over computing time, by integrator; crosses mark wrong verdicts."""
    errors = {"position_relative_rms": "position error, relative rms", "growth_rate_error": "|growth-rate error| [1/s]"}
    figure, axes = _panels("error over computing time (crossed: wrong verdict)", 1, 2, (11, 4.5), sharex=True)
    names = list(dict.fromkeys(row.integrator for row in rows if row.integrator))
    for axis, (key, label) in zip(axes[0], errors.items(), strict=True):
        for name, style in zip(names, STYLES, strict=False):
            mine = [row for row in rows if row.integrator == name and getattr(row, key)]
            points = [(row.wall_s_per_simulated_s, abs(getattr(row, key))) for row in mine]
            axis.loglog(*zip(*points, strict=True) if points else ((), ()), marker="o", label=name, **style)
            for row, point in zip(mine, points, strict=True):
                axis.annotate(f"x{row.substeps}", point, (4, 4), textcoords="offset points", fontsize=7)
                if not row.verdict_correct:
                    axis.plot(*point, "kx", markersize=11)
        axis.set(xlabel="seconds per simulated second", ylabel=label)
    axes[0, 0].legend()
    return save(figure, path)


def draw_population(mass: Array, damping: Array, growth: Array, title: str) -> Figure:
    """Return a figure of growth rates (n,) [1/s] over masses (n,) [kg] and least dampings (n,) [N s/m] of hands."""
    figure, axes = _panels(title, 1, 2, (10, 4.2), sharey=True)
    kinds = (("stable", growth <= 0, "o", STYLES[0]), ("unstable", growth > 0, "^", STYLES[1]))
    labels = "mass of the human [kg]", "least damping of the human [N s/m]"
    for axis, values, label in zip(axes[0], (mass, damping), labels, strict=True):
        for name, chosen, marker, style in kinds:
            count = f"{name}: {int(chosen.sum())}"
            axis.scatter(values[chosen], growth[chosen], s=10, marker=marker, color=style["color"], label=count)
        axis.axhline(0.0, color="black", linewidth=0.8)
        axis.set(xscale="log" if (values > 0).any() else "linear", xlabel=label)
        axis.set_yscale("symlog", linthresh=1e-1)
    axes[0, 0].set_ylabel("growth rate [1/s]")
    _plain_numbers(axes)
    _legend(figure, _entries(axes[0, 0]), 2)
    return figure


# ---- couplings over frequency, from the report of `python -m design.compare`

#: (field, label, style) of E, F and M in every panel of singular values
_PARTS: tuple[tuple[str, str, dict[str, Any]], ...] = (
    ("sigma_E", "E, the environment", _IDEAL),
    ("sigma_F", "F, felt at the devices", STYLES[0]),
    ("sigma_M", "M, the mismatch", STYLES[1]),
)
_HIGHEST = 20.0  # largest required damping in a picture, relative to the available one
_FLOOR = 1e-4  # smallest value on a logarithmic axis, relative to the largest


def plot_singular_values(report: Comparison, path: Path) -> Path:
    """Plot all singular values of E, F and the mismatch M, one panel per coupling; thinner lines are smaller values."""
    couplings = report.couplings
    figure, axes = _over_frequency("singular values", 1, len(couplings), (4.2, 4.2))
    hz = report.frequency_hz
    top = max(np.max(part) for c in couplings for part in (report.sigma_E, c.curves.sigma_F, c.curves.sigma_M))
    for axis, coupling in zip(axes[0], couplings, strict=True):
        for key, label, style in _PARTS:
            values = getattr(report if key == "sigma_E" else coupling.curves, key)
            for i, row in enumerate(np.maximum(values, _FLOOR * top / 10).T):
                width = (3.0 if style is _IDEAL else 1.6) / (1 + i)
                axis.plot(hz, row, label=label if i == 0 else None, **(style | {"linewidth": width}))
        if not np.any(coupling.curves.sigma_M):
            axis.annotate("M = 0", (0.05, 0.05), xycoords="axes fraction", color=STYLES[1]["color"])
        axis.set(xscale="log", yscale="log", title=coupling.name, xlabel="frequency [Hz]")
        axis.set_ylim(_FLOOR * top, 2 * top)
    axes[0, 0].set_ylabel("singular values [N/m]")
    _plain_numbers(axes)
    _legend(figure, _entries(axes[0, 0]), 4)
    return save(figure, path, 90)


def plot_required_damping(report: Comparison, path: Path) -> Path:
    """Plot each condition's required damping over frequency, the available damping, and where conditions bind."""
    from haptic_loop.design.result import ANY, TITLES

    title = "required damping over frequency; o: where a condition binds, ^: above the picture"
    names = report.conditions
    figure, axes = _over_frequency(title, 1, len(names), (5.5, 4.2))
    hz, available = report.frequency_hz, report.available_damping
    alike = len(set(available)) == 1  # If devices have different dampings, the curves are ratios.
    scale, unit = (available[0], " [N s/m]") if alike else (1.0, " over available damping")
    for axis, condition in zip(axes[0], names, strict=True):
        axis.axhline(scale, color="black", linewidth=1.2)
        axis.annotate("available", (hz[0], scale), (2, 3), textcoords="offset points", fontsize=8)
        parts = [coupling.conditions[condition] for coupling in report.couplings]
        top = scale * min(max([1.0, *(part.ratio for part in parts if np.isfinite(part.ratio))]), _HIGHEST)
        for coupling, part, style in zip(report.couplings, parts, STYLES, strict=False):
            if part.demand is None:
                axis.plot([], [], label=f"{coupling.name} (no curve: see the printed remarks)", **style)
                continue
            axis.plot(hz, scale * part.demand, label=coupling.name, **style)
            binds = scale * part.ratio
            at = max(part.requirement.frequency_hz or 0.0, hz[0]), min(binds, top)
            axis.plot(*at, "o" if binds <= top else "^", color=style["color"])
        axis.axhspan(scale, 1.12 * top, color="black", alpha=0.06, linewidth=0)
        words, holds = TITLES.get(str(condition), str(condition)), parts[0].requirement.guarantee
        words += " (with a multiplier for this environment)" if words == ANY != holds else ""
        axis.set(xscale="log", title=words, xlabel="frequency [Hz]", ylim=(-0.5 * scale, 1.12 * top))
        axis.legend(fontsize=8)
    axes[0, 0].set_ylabel(f"required damping{unit}")
    _plain_numbers(axes)
    return save(figure, path, 90)


def plot_perceived(report: Comparison, path: Path) -> Path:
    """Plot the stiffness and the damping that users feel on each channel, beside those of E itself."""
    title = "felt on each channel, the other channels held still; vertical axes are linear near zero"
    figure, axes = _over_frequency(title, 2, len(report.available_damping), (4.8, 3.2))
    hz = report.frequency_hz
    curves = [("ideal: E itself", report.ideal, _IDEAL)]
    curves += [(c.name, c.curves.perceived, s) for c, s in zip(report.couplings, STYLES, strict=False)]
    for row, (key, label) in zip(axes, (("stiffness", "stiffness [N/m]"), ("damping", "damping [N s/m]")), strict=True):
        for i, axis in enumerate(row):
            for name, values, style in curves:
                axis.plot(hz, getattr(values, key)[:, i], label=name, **style)
            axis.axhline(0.0, color="black", linewidth=0.7)
            axis.set_xscale("log")
            # The scale is linear up to the power of ten below the median size.
            sizes = np.abs([getattr(values, key)[:, i] for _, values, _ in curves])
            typical = float(np.median(sizes[sizes > 0])) if (sizes > 0).any() else 1.0
            axis.set_yscale("symlog", linthresh=10.0 ** np.floor(np.log10(typical)))
        row[0].set_ylabel(label)
    for i, (upper, lower) in enumerate(axes.T):
        upper.set_title(report.names[i] if report.names else f"device {i + 1}")
        lower.set_xlabel("frequency [Hz]")
    _plain_numbers(axes)
    _legend(figure, _entries(axes[0, 0]), 4)
    return save(figure, path, 90)


def _over_frequency(title: str, rows: int, columns: int, size: tuple[float, float]) -> tuple[Figure, Any]:
    """Return a figure that is wide enough for its title, and its axes: panels of `size` [inch] each."""
    return _panels(title, rows, columns, (max(columns * size[0], 5.5), rows * size[1] + 0.6), sharex=True)
