"""What a K-B map says, in a few lines on the terminal."""

from __future__ import annotations

from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from sim.oscillation import SUSTAINED
from sim.zwidth.simulation import DECIDED, UNDECIDED
from sim.zwidth.surroundings import MODEL_KEPT


def print_map(outcome: dict[str, Any], console: Console) -> None:
    """What the map says in a few lines."""
    cells = len(outcome["grid"]["K"]) * len(outcome["grid"]["B"])
    K, B = outcome["grid"]["K"], outcome["grid"]["B"]
    title = f"K {K[0]:.4g} to {K[-1]:.4g} N/m, B {B[0]:.4g} to {B[-1]:.4g} N s/m, {cells} couplings"
    table = Table(title=title, title_justify="left", show_header=False)
    errors = outcome.get("error", {})
    if outcome["axes"] == "environment":
        for row in _designed_rows(outcome):
            table.add_row(*row)
    for name in outcome["conditions"]:
        error = errors.get(name)
        near = f"; edge within {100 * error['edge_relative_in_K']:.2g} % of design.margin" if error else ""
        table.add_row(f"certified, {name}", f"{_share(outcome[name]['certified_cells'], cells)}{near}")
    crowd = outcome["population"]
    who = f"stable with all of {crowd['humans']} random humans"
    table.add_row(who, f"{_share(crowd['stable_cells'], cells)} ({crowd['decided_cells']} decided)")
    simulation = outcome["simulation"]
    if simulation["points"]:
        beside = f"{simulation['undecided']} {UNDECIDED}, {simulation['differ_from_linear']} unlike the linear loop"
        ends = f"{simulation['oscillate']} of {len(simulation['points'])} oscillate, {beside}"
        table.add_row(f"simulated{_effects(simulation)}", ends)
    table.add_row("seconds", ", ".join(f"{stage} {wall:.1f}" for stage, wall in outcome["wall_s"].items()) or "-")
    console.print(table)
    for mark in outcome.get("marks", ()):
        console.print(_mark_line(mark, crowd["humans"]))
    for line in _remarks(outcome):
        console.print(f"[dim]·[/] {line}")


def _designed_rows(outcome: dict[str, Any]) -> list[tuple[str, str]]:
    """The fixed coupling in the environment that it was designed for."""
    designed = outcome["designed_for"]
    each = (f"{' - '.join(s['between'])} {s['K']:g} N/m, {s['B']:g} N s/m" for s in designed["contact_springs"])
    needs = "; ".join(
        f"{name} needs {100 / part['margin']:.4g} % of the damping ({part['proof']})"
        for name, part in designed["certificates"].items()
        if part["margin"]
    )
    return [
        ("coupling", f"{outcome['coupling']['kind']}, fixed"),
        ("designed for", ", ".join(each)),
        ("there", f"promise: {designed['promise'] or 'none'}; {needs or 'no damping is enough'}"),
    ]


def _about(outcome: dict[str, Any]) -> str:
    """What the axes are, and what a certified cell promises."""
    line = "K and B are those of every spring at a contact; each is certified for its environment alone, by a sweep"
    if MODEL_KEPT not in outcome["conditions"]:
        return f"{line}."
    return (
        f"{line}: closed-loop, the population and MuJoCo with the coupling's model set to the cell's environment, "
        f"{MODEL_KEPT} with the model left at what the coupling was designed for."
    )


def _mark_line(mark: dict[str, Any], humans: int) -> str:
    ends = ", ".join(f"{name} {_stiffest(K)}" for name, K in mark["stiffest_K_at_this_B"].items())
    needs = ", ".join(
        f"{name} needs {max(mark[name]['required_damping'], key=lambda d: d or np.inf) or np.inf:.6g} of "
        f"{min(mark[name]['available_damping']):.6g} N s/m "
        f"({'[green]certified[/]' if mark[name]['certified'] else '[red]not certified[/]'})"
        for name in mark["stiffest_K_at_this_B"]
        if name != "population"
    )
    met = f"{mark['unstable_humans']} of {humans} humans make it unstable"
    return f"K {mark['K']:g}, B {mark['B']:g}: {needs}; {met}; stiffest at this B: {ends}"


def _stiffest(K: float | str | None) -> str:
    return "none" if K is None else K if isinstance(K, str) else f"{K:.5g} N/m"


def _effects(simulation: dict[str, Any]) -> str:
    effects = simulation["effects"]
    on = {
        "quantisation": any(effects["encoder_step_m"]),
        "friction": any(effects["friction_n"]),
        "saturation": effects["force_limit_n"] is not None,
        "one-sided contact": effects["one_sided"],
    }
    names = [name for name, present in on.items() if present]
    return f" with {', '.join(names)}" if names else ", linear loop"


def _remarks(outcome: dict[str, Any]) -> list[str]:
    lines = []
    simulation = outcome["simulation"]
    if outcome["axes"] == "environment":
        lines += [*outcome["remarks"], _about(outcome)]
    for name in outcome["conditions"]:
        if outcome[name].get("reason"):
            lines.append(f"{name}: {outcome[name]['reason']}.")
        if outcome[name].get("contradicted_cells"):
            lines.append(f"[red]CONTRADICTION[/]: {outcome[name]['contradicted_cells']} certified cells are unstable.")
    if not simulation["nonlinear"] and simulation["differ_from_linear"]:
        lines.append(f"[red]DISAGREEMENT[/]: MuJoCo and the linear loop at {simulation['differ_from_linear']} points.")
    if outcome["velocity_filter_hz"]:
        lines.append("The velocity filter is in all maps: it is linear, and part of the coupling.")
    if outcome["one_sided"]:
        lines.append(
            "One-sided contact: closed-loop and the population are about each frozen contact state, theorem4 (psi = 0) "
            "and the simulated points about contact made and broken."
        )
    if simulation["points"]:
        lines.append(
            f"A simulated point oscillates if, at the end of {simulation['duration_s']:g} s, an octave above "
            f"{simulation['from_hz']:.3g} Hz keeps {100 * SUSTAINED:g} % of its amplitude, over "
            f"{simulation['threshold_m']:g} m; {UNDECIDED} where the linear loop is within {DECIDED:g} 1/s of the edge."
        )
    if outcome["interrupted"]:
        lines.append("Interrupted: the map has what was finished.")
    return [*lines, *outcome["files"]]


def _share(count: int, cells: int) -> str:
    return f"{100 * count / cells:.1f} % of the map"
