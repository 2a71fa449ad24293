"""Every design side by side: what it requires, how close it comes to the environment, and what proves it."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from controller.coupling import Coupling, NoCoupling
from controller.process import force_map
from design.assess import specification
from design.certificate import NotProved, prove
from design.designs import design_coupling
from design.failure import DesignFailed
from design.margin import closed_loop
from design.promises import finite
from design.published import PUBLISHED
from design.result import Design
from design.specification import Specification
from design.store import Condition, Loop, data_of
from design.transparency import decibels, transparency

PRINTED = {"I": "(27)", "II": "(28)"}  # the paper's equations for its gains

Progress = Callable[[int, int], None]  # (designs done, designs in all)


@dataclass(frozen=True)
class Entry:
    """A design to be made: its name in the table, and the arguments of design.designs.design_coupling."""

    name: str
    kind: str
    condition: Condition = "closed-loop"
    options: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Rung:
    """One line of the table."""

    design: str
    case: str
    required_damping: tuple[float, ...] | None  # by the closed-loop condition [N s/m]; None where infinite or no design
    certified: bool  # by that condition
    condition: str  # what the proof is of
    relative_mismatch_db: float | None  # None: exact, or no design
    rms_mismatch_db: float | None
    proof: str | None
    wall_s: float  # of the design, with its check
    proof_s: float
    reason: str | None = None


def _optimal(functions: int, **options: Any) -> Entry:
    """The optimal coupling of so many functions per entry of Q; `HF` is what devices may feel above 100 Hz."""
    kind = "full" if options.get("diagonal") is False else "diagonal"
    words = [f"optimal, {kind} {functions}"]
    words += [options["objective"]] if "objective" in options else []
    words += ["no HF limit"] if "high_gain" in options else []
    return Entry(", ".join(words), "optimal", "closed-loop", {"functions": functions, **options})


SHORT = (
    Entry("none", "none"),
    Entry("published", "published"),
    Entry("spring-damper, theorem4", "spring-damper", "theorem4"),
    Entry("spring-damper, closed-loop", "spring-damper"),
    _optimal(4, high_gain=None),
    _optimal(8),
    _optimal(8, high_gain=None),
)
FULL = (
    *SHORT[:4],
    Entry("ccl, one state per channel, theorem4", "ccl", "theorem4"),
    *SHORT[4:],
    _optimal(16, high_gain=None),
    _optimal(16, diagonal=False, filter="mixed", high_gain=None),
    _optimal(37, diagonal=False, high_gain=None),
    _optimal(37, diagonal=False, high_gain=None, objective="sup"),
)
LADDERS = {"short": SHORT, "full": FULL}


def climb(loops: Mapping[str, Loop], entries: Sequence[Entry], progress: Progress) -> tuple[list[Rung], bool]:
    """The rungs of every case, and whether the keyboard ended it; what was done before is kept."""
    rungs: list[Rung] = []
    total = len(loops) * len(entries)
    try:
        for case, loop in loops.items():
            for entry in entries:
                progress(len(rungs), total)
                rungs.append(rung(case, loop, entry))
    except KeyboardInterrupt:
        return rungs, True
    return rungs, False


def rung(case: str, loop: Loop, entry: Entry) -> Rung:
    """One design with its proof; a request without a solution gives its reason."""
    spec, begin = specification(loop), time.perf_counter()
    try:
        coupling, design = _made(spec, case, entry)
    except DesignFailed as error:
        wall = time.perf_counter() - begin
        return Rung(_name(entry, case), case, None, False, entry.condition, None, None, None, wall, 0.0, str(error))
    wall = time.perf_counter() - begin
    F = force_map(spec.environment, coupling, loop.theta, loop.psi)
    requirement = closed_loop(F, loop.delta)
    figures = transparency(F, spec.environment, loop.lam)
    begin, proof, reason = time.perf_counter(), None, requirement.reason
    if design or requirement.certified:
        try:
            phi = None if design is None or design.phi is None else design.phi.tolist()
            proof = prove(loop, data_of(coupling), entry.condition, phi).proof
        except NotProved as error:
            reason = str(error)
    required = None if requirement.reason else requirement.required
    mismatch = finite(decibels(figures.relative_mismatch)), finite(decibels(figures.rms_mismatch))
    proof_s = time.perf_counter() - begin
    certified = requirement.certified
    return Rung(_name(entry, case), case, required, certified, entry.condition, *mismatch, proof, wall, proof_s, reason)


def _name(entry: Entry, case: str) -> str:
    return f"{entry.name} {PRINTED[case]}" if entry.kind == "published" else entry.name


def _made(spec: Specification, case: str, entry: Entry) -> tuple[Coupling, Design | None]:
    if entry.kind == "none":
        return NoCoupling(), None
    if entry.kind == "published":
        if spec.channels != 2:
            raise DesignFailed(None, (), f"the paper prints gains for 2 channels, not {spec.channels}")
        return PUBLISHED[case], None
    design = design_coupling(spec, entry.kind, entry.condition, **entry.options)
    return design.coupling, design
