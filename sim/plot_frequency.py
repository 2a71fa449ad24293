"""Pictures of couplings over frequency, drawn from the data that `python -m design.plot` writes as JSON."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from controller.lti import Array
from sim.files import write
from sim.plot import STYLES

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
