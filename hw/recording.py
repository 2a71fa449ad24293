"""The record of a session: its trace, and the replay of the trace through the controller, bit by bit.

A trace is the npz of sim.run with arrays of the link added. Its metadata have a recipe for the replay of every arming:
limits, coupling and scenario. A MuJoCo world cannot be replayed. A digest detects changes of the file.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from struct import Struct
from typing import Annotated, Any, BinaryIO

import msgspec
import numpy as np
from numpy.typing import NDArray

from haptic_loop.controller.coupling import Form
from haptic_loop.controller.lti import Array
from haptic_loop.design.files import counted, read_arrays, write
from haptic_loop.hw.control import Arming, BudgetPlan, CertifiedCoupling, SentBudget, TraceRow, host_controller
from haptic_loop.hw.limits import SafetyLimits, Units
from haptic_loop.hw.protocol import NO_MARGIN, SafetyStop
from haptic_loop.sim.scenario import InputError, Scenario
from haptic_loop.sim.trace import Trace

#: names of the link's arrays in a trace, each with one row per tick
_LINK = ("tick", "arming", "received", "asked", "test", "gain", "sent", "margin_us", "status")
_ONCE = ("tick", "arming", "echo", "margin_us", "status")  # integers with one entry per tick, not one per axis


class Recorder:
    """Collect the rows of a trace as bytes: 32 m + 30 bytes per tick for m channels."""

    def __init__(self, channels: int) -> None:
        m = self.channels = channels
        floats = [("x", "<f8", m), ("asked", "<f8", m), ("test", "<f8", m), ("gain", "<f8")]
        integers = [("sent", "<i4", m), ("applied", "<i4", m), *((name, "<i4") for name in _ONCE)]
        self._row = np.dtype([*floats, *integers, ("received", "?"), ("limited", "?")])
        self._form = Struct(f"<{3 * m + 1}d{2 * m + len(_ONCE)}i??")
        self._rows, self._zero = bytearray(), (0,) * m

    def __call__(self, row: TraceRow) -> None:
        """Record one tick."""
        state, zero = row.state, self._zero
        if state is None:
            sent, applied, told = zero, zero, (0, NO_MARGIN, 0)
        else:
            sent, applied, told = row.sent, state.applied, (state.echo, state.margin_us, state.status)
        once = row.tick, row.arming, *told, state is not None, row.limited
        self._rows += self._form.pack(*row.x, *row.asked, *(row.test or zero), row.gain, *sent, *applied, *once)

    def __len__(self) -> int:
        return len(self._rows) // self._form.size

    def link(self) -> dict[str, NDArray[Any]]:
        """Return arrays by the names of _LINK, and `x` (N, m) [m], `applied` (N, m) [steps], `echo` and `limited`."""
        rows = np.frombuffer(bytes(self._rows), self._row)
        return {name: rows[name] for name in rows.dtype.names or ()}

    def steady_ticks(self, force_step: Sequence[float], limits: SafetyLimits) -> list[list[int]]:
        """Return rows [first, stop) of each arming, from full gain to the first cut by cap, slew rate or budget.

        In these rows the loop is linear. Missed ticks are included. `force_step` is (m,) [N].
        """
        link = self.link()
        wanted = -np.round(link["asked"] / np.array(force_step))
        cut = link["received"] & np.any((link["sent"] != wanted) | limits.capped(link["asked"]), axis=1)
        stretches = []
        for arming in np.unique(link["arming"]):
            full = np.flatnonzero((link["arming"] == arming) & (link["gain"] == 1.0))
            if full.size:
                count = int(np.argmax(cut[full])) if cut[full].any() else full.size
                stretches.append([int(full[0]), int(full[0]) + count])
        return stretches

    def trace(self, units: Units, T: float, meta: dict[str, Any], names: tuple[str, ...] = ()) -> Trace:
        """Return a trace in the form of sim.run. Handles and external forces are not measured (nan, or no column)."""
        link = self.link()
        n, m = len(self), self.channels
        # a missing force counts as held: each row without a STATE repeats the last known force
        last = np.maximum.accumulate(np.where(link["received"], np.arange(n), 0))
        f = -link["applied"][last] * np.array(units.force_step)
        unknown = np.full((n, m), np.nan)
        t = np.arange(n, dtype=float) * T
        return Trace(t, link["x"], f, unknown, unknown, np.zeros((n, 0)), meta, names=names)

    def save(self, path: Path, result: Trace) -> Path:
        """Write an npz that sim.trace reads, with the arrays of _LINK added."""
        recorded = self.link()
        link = {f"link_{name}": recorded[name] for name in _LINK}
        arrays: dict[str, Any] = {**result.arrays, **link}

        def content(file: BinaryIO) -> None:
            np.savez_compressed(file, allow_pickle=False, digest=np.array(_digest(arrays)), **arrays)

        return write(path, content)


def _digest(arrays: Mapping[str, Array]) -> str:
    """Return the SHA-256 of all arrays of a trace, which detects a changed, cut or merged record."""
    digest = hashlib.sha256()
    for name in sorted(arrays):
        digest.update(f"{name} {arrays[name].dtype.str} {arrays[name].shape} ".encode() + arrays[name].tobytes())
    return digest.hexdigest()


def load(path: Path) -> tuple[Trace, dict[str, Array]]:
    """Read a trace with its link arrays. Raises InputError if no session of the bridge wrote it, or it has changed."""
    arrays = read_arrays(path, "a trace of this program")
    result = Trace.of_arrays(path, arrays)
    if not all(f"link_{name}" in arrays for name in _LINK):
        raise InputError(f"{path}: holds a trace without data of a link: give a trace of hw.bridge")
    if str(arrays.pop("digest", "")) != _digest(arrays):
        raise InputError(f"{path}: was changed after hw.bridge wrote it: its digest differs")
    return result, {name: arrays[f"link_{name}"] for name in _LINK}


class Recipe(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The controller of one arming, as stored in the metadata of a trace."""

    scenario: Scenario
    coupling: Form
    link_delay: int  # [ticks]
    limits: SafetyLimits
    force_step: tuple[float, ...]  # (m,) [N]
    cap: tuple[int, ...]  # (m,) [steps]
    energy_budget: BudgetPlan | None = None
    behind: tuple[int, ...] = ()  # (m,) [ticks] that several boards add to the link
    lag: tuple[float, ...] | None = None  # (m,) [N/m] rho of the limiter, if there was one

    @classmethod
    def of(cls, arming: Arming, limits: SafetyLimits, units: Units) -> dict[str, Any]:
        """Return the recipe as plain data."""
        program, budget = arming.program, arming.budget
        assert isinstance(program, CertifiedCoupling)
        rho = program.assessment.force_limits.rho
        loop = program.scenario, program.chosen.coupling.form(), program.link
        device = units.force_step, arming.config.cap, budget and budget.plan
        return json.loads(
            msgspec.json.encode(cls(*loop, limits, *device, program.behind, None if rho is None else tuple(rho)))
        )


@dataclass(frozen=True, eq=False)
class _Comparison:
    """Differences between the replay and the record."""

    asked: NDArray[np.bool_]  # (N,) whether any bit of the controller's forces differs
    sent: NDArray[np.bool_]  # (N,) whether the steps sent differ
    largest: float  # [N] largest difference of the controller's forces

    @property
    def identical(self) -> bool:
        return not (self.asked.any() or self.sent.any())


def replay(result: Trace, link: dict[str, Array]) -> _Comparison:
    """Replay recorded displacements through controller, gain, limits and rounding, and compare the forces.

    The controller starts at rest in every arming. Raises InputError where the trace cannot be replayed, for example
    without a recipe.
    """
    wanted, sent, arming = np.zeros_like(link["asked"]), np.zeros_like(link["sent"]), link["arming"]
    try:
        recipes = _recipes_of(result)
        if len(recipes) != arming[-1] + 1:
            raise ValueError(f"it has {len(recipes)} recipes for {arming[-1] + 1} armings")
        for i, recipe in enumerate(recipes):
            _again(recipe, np.flatnonzero(arming == i), result, link, (wanted, sent))
    except (SafetyStop, msgspec.ValidationError, LookupError, ValueError, TypeError) as error:
        raise InputError(f"the trace cannot be replayed: {counted(str(error))}") from None
    different = wanted.view(np.int64) != link["asked"].view(np.int64)
    largest = float(np.abs(wanted - link["asked"]).max(initial=0.0))
    return _Comparison(different.any(axis=1), (sent != link["sent"]).any(axis=1), largest)


def _recipes_of(result: Trace) -> list[Recipe]:
    """Return the recipes in a trace, one for each arming."""
    return msgspec.convert(result.meta["replay"], Annotated[list[Recipe], msgspec.Meta(min_length=1)])


def _again(
    recipe: Recipe, ticks: NDArray[np.intp], result: Trace, link: dict[str, Array], into: tuple[Array, Array]
) -> None:
    """Replay the `ticks` of one arming, and write the controller's forces and the steps sent to `into`."""
    if recipe.scenario.environment.world:
        raise ValueError("its forces came from a MuJoCo world, which is not in the trace")
    m, coupling, (wanted, sent) = len(recipe.cap), recipe.coupling.build(recipe.scenario.T), into
    link_delay, cap = recipe.link_delay, recipe.limits.cap
    controller = host_controller(recipe.scenario, coupling, link_delay, cap, recipe.lag, recipe.behind)
    units, force = Units((1.0,) * m, recipe.force_step, (1,) * m), (0.0,) * m
    budget, missed = recipe.energy_budget and SentBudget(recipe.energy_budget), 0
    for k in ticks:
        wanted[k] = controller.step(result.x[k].tolist())
        if not link["received"][k]:
            missed += 1
            continue
        gain, test = float(link["gain"][k]), link["test"][k].tolist()
        force = recipe.limits.shape(wanted[k].tolist(), force, gain, recipe.scenario.T, test).force
        steps = units.steps(force, recipe.cap, recipe.limits.vectors)
        if budget:
            limited = budget.limit(steps, result.x[k].tolist(), result.f[k], missed)
            if limited != steps:
                force, steps = units.forces(limited), limited
            missed = 0
        sent[k] = steps
