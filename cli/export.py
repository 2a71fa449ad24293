"""python -m design.export coupling.json: export a stored coupling as C, alone or with environment and delays.

The loop is read from the file, so that the exported process is the certified one.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from haptic_loop.cli import options, render
from haptic_loop.controller.loop import Loop
from haptic_loop.controller.lti import Array
from haptic_loop.controller.units import comments_in_unit, set_unit
from haptic_loop.design.certificate import Verdict, limiter_rho, named, verify
from haptic_loop.design.coupling_file import Stored
from haptic_loop.design.designs import name_and_own
from haptic_loop.design.export import (
    ExportedBlock,
    c_source,
    coupling_block,
    in_single_precision,
    process_block,
    trial,
    with_origin,
)
from haptic_loop.design.files import off_table, out_file, write
from haptic_loop.design.result import held_torques, listed
from haptic_loop.sim.couplings import read_coupling
from haptic_loop.sim.scenario import InputError


@dataclass(frozen=True)
class _Exported:
    what: str
    states: int
    T_s: float
    file: Path = render.figure("file")
    channels: int = render.figure("block", "{} channels, {r.states} states, T = {r.T_s:g} s")
    certificate: Verdict = render.figure(
        "certificate", lambda found: "[green]proved[/]" if found.proved else f"[red]none[/]: {found.reason}"
    )
    multiplications: int = render.figure("one tick", "{} multiplications, not counting limiter and walls")
    force_limit: Array | None = off_table()
    forces: str | None = render.figure("forces")
    single: str | None = render.figure("single precision", json="if given")
    test: dict[str, Any] = render.figure("test vector", "{[ticks]} ticks, in the file")
    claim: str | None = render.figure("claim", json="if given")  # claim of the user's own condition


def main(argv: list[str]) -> int:
    """Export a stored coupling. Return 1 if its file has a certificate that does not hold, else 0."""
    args = _parser().parse_args(argv)
    stored = read_coupling(args.coupling)
    set_unit(stored.loop.unit)
    own = name_and_own(args.condition)[1]
    try:
        with render.progress("proving the coupling again"):
            verdict = verify(stored, args.condition and named(args.condition))
    except (ValueError, ArithmeticError) as error:
        verdict = Verdict(False, str(error))
    claim = own.claim if own and verdict.proved else None
    block = _block(args, stored, verdict, claim)
    path = out_file(args.out, f"out/export/{options.name_of(args.coupling)}-{block.name}.c")
    test = trial(block)
    write(path, comments_in_unit(c_source(block, test, path.name)))

    forces = "not limited by the C code: a proof covers only forces below the motors' limits"
    forces += " (--force-limit adds the limiter)" if limiter_rho(stored.loop, stored.certificate) is not None else ""
    if block.limiter:
        limits = [float(block.limiter.limit[own.start]) for own in stored.loop.devices]
        limited = "each axis" if stored.loop.axes else "forces"
        if block.limiter.balls:
            limited = "the length of each device's force vector"
        largest = listed(limits if block.limiter.balls else block.limiter.limit.tolist())
        forces = f"the limiter keeps {limited} within {largest} N"
    exported = _Exported(
        block.name,
        block.system.order,
        block.system.T,
        path,
        block.system.inputs,
        verdict,
        block.system.order**2 + 2 * block.system.order * block.system.inputs + block.system.inputs**2,
        block.limiter and block.limiter.limit,
        forces if args.process else None,
        _error(block),
        {"ticks": len(test.inputs), "largest_output": np.abs(test.outputs).max()},
        claim,
    )
    title = f"{block.name} as C99"
    proof = "the stored proof was repeated" if verdict.proved else f"not proved: {verdict.reason}"
    written = f"Wrote {path}: {block.name} as C99; {proof}."
    torques = held_torques(stored.loop)
    lines = [f"Held torques: {torques}."] if torques else []
    render.publish(args, exported, [render.facts(title, render.rows_of(exported), left=True)], lines, verdict=written)
    return options.exit_code(verdict.proved or not stored.certificate)


def _parser() -> options.Parser:
    parser = options.Parser(
        "design.export",
        "Write a stored coupling, or its whole discrete process, as C99.",
        "python -m design.export coupling.json --process",
        "python -m design.export coupling.json --process --force-limit 12",
    )
    parser.add_argument("coupling", metavar="FILE.json", help="the stored coupling and its loop")
    parser.add_argument("--process", action="store_true", help="coupling, environment and delays as one block")
    link = "leave out the transmission delay theta, if the link to the devices causes it"
    parser.add_argument("--without-theta", action="store_true", help=link)
    limit = "add the limiter that the certificate covers, with these largest forces [N]: one for all, one for each "
    limit += "device (length of its force vector) or one for each axis"
    parser.add_argument("--force-limit", type=options.several(float, 1e-3, 1e6, "N"), metavar="N,N,..", help=limit)
    single = "compute in single precision, for processors without double precision; its error is printed"
    parser.add_argument("--float", action="store_true", help=single)
    parser.add_condition("the condition of the file's certificate, needed only if it is your own")
    parser.add_output("FILE", "the file (default out/export/<coupling>-<what>.c)", seed=False)
    parser.only("with --process: a coupling alone has no delay", lambda args: args.process, "without_theta")
    parser.only("with --process: a coupling alone sends no forces", lambda args: args.process, "force_limit")
    return parser


def _block(args: argparse.Namespace, stored: Stored, verdict: Verdict, claim: str | None) -> ExportedBlock:
    """Return the block, with comment lines on its file and proof. Raises InputError if file or options do not fit."""
    limit, balls = _force_limits(args.force_limit, stored.loop) if args.force_limit else (None, ())
    try:
        block = process_block(stored, not args.without_theta, limit, balls) if args.process else coupling_block(stored)
    except ValueError as error:
        raise InputError(f"{args.coupling}: {error}") from None
    block = with_origin(block, Path(args.coupling).name, stored, verdict, claim)
    return in_single_precision(block) if args.float else block


def _force_limits(given: tuple[float, ...], loop: Loop) -> tuple[tuple[float, ...], tuple[slice, ...]]:
    """Return limits (m,) [N], and the channels of each force vector whose length they limit. Raises InputError."""
    vectors = tuple(own for own in loop.devices if own.stop > own.start + 1)
    if not vectors or len(given) == loop.channels:
        return options.per_channel("--force-limit", given, loop.channels), ()
    if len(given) not in (1, len(loop.devices)):
        expected = f"1, {len(loop.devices)} (of each device's vector) or {loop.channels} (of each axis)"
        raise InputError(f"--force-limit has {len(given)} values, expected {expected}")
    return loop.per_channel(given * len(loop.devices) if len(given) == 1 else given), vectors


def _error(block: ExportedBlock) -> str | None:
    if block.single is None:
        return None
    error, largest = block.single
    unit = "N" if block.output.letter == "f" else "m"
    return (
        f"differs from double precision by at most {error:.2g} {unit} in 4096 random ticks; "
        f"the largest value is {largest:.3g} {unit}"
    )
