"""python -m design.export coupling.json: a stored coupling, or its whole discrete process, for use elsewhere.

Like design.check it works from the file alone, loop included: what is exported is what is certified.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from cli import options, render
from controller.coupling import SpringDamperForm
from controller.lti import Array
from design.certificate import Verdict, verify
from design.coupling_file import Stored
from design.export import (
    ExportedBlock,
    NothingToExport,
    Trial,
    c_source,
    control_source,
    coupling_block,
    data,
    process_block,
    trial,
)
from design.files import out_file, write
from design.guarantees import HERE, RANGES, switching_guarantee
from design.result import listed
from sim.couplings import read_coupling
from sim.scenario import InputError

_SUFFIX = {"c": ".c", "json": ".json", "npz": ".npz", "control": ".py"}


@dataclass(frozen=True)
class _Proof:
    """Whether the certificate on file holds."""

    proved: bool
    reason: str | None

    def __str__(self) -> str:
        return "[green]proved[/]" if self.proved else f"[red]none[/]: {self.reason}"


@dataclass(frozen=True)
class _Exported:
    """What was written."""

    format: str
    what: str
    states: int
    T_s: float
    file: Path = render.figure("file")
    channels: int = render.figure("block", "{} channels, {r.states} states, T = {r.T_s:g} s")
    certificate: _Proof = render.figure("certificate")
    multiplications: int = render.figure("one tick", "{} multiplications")
    force_limit: Array | None = render.unseen()
    forces: str | None = render.figure("forces")
    test: dict[str, Any] = render.figure("test vector", "{[ticks]} ticks, in the file")


def main(argv: list[str]) -> int:
    """Export a stored coupling. 0: written, 1: written, but the certificate in its file does not hold."""
    args = _parser().parse_args(argv)
    options.check_json(args)
    if args.without_theta and not args.process:
        raise InputError("--without-theta without --process: a coupling alone has no delay")
    if args.force_limit and (not args.process or args.format == "control"):
        other = "--format control: that is linear" if args.process else "a coupling alone sends no forces"
        raise InputError(f"--force-limit is for --process, {other}")
    stored = read_coupling(args.coupling)
    verdict = _verdict(stored)
    block = _block(args, stored, verdict)
    path = _destination(args, block)
    test = trial(block, args.seed)
    write(path, _content(args.format, block, test, path.name))

    exported = _Exported(
        args.format,
        block.name,
        block.system.order,
        block.system.T,
        path,
        block.system.inputs,
        _Proof(verdict.proved, verdict.reason),
        block.system.order**2 + 2 * block.system.order * block.system.inputs + block.system.inputs**2,
        block.limiter and block.limiter.limit,
        _forces(block) if args.process else None,
        {"ticks": len(test.inputs), "seed": args.seed, "largest_output": np.abs(test.outputs).max()},
    )
    title = f"{block.name} as {args.format}"
    render.publish(args, exported, [render.facts(title, render.rows_of(exported), left=True)])
    return options.DOES_NOT_HOLD if stored.certificate and not verdict.proved else options.DONE


def _parser() -> options.Parser:
    parser = options.Parser(
        "design.export",
        "Write a stored coupling, or its whole discrete process, as C99, plain data or a python-control block.",
        "python -m design.export coupling.json --process --format c",
    )
    parser.add_argument("coupling", metavar="FILE.json", help="the stored coupling, which names its loop")
    parser.add_argument("--format", choices=tuple(_SUFFIX), default="c", help="(default c)")
    parser.add_argument("--process", action="store_true", help="coupling, environment and delays as one block (6)")
    link = "leave out Theta, where the link to the devices is that delay"
    parser.add_argument("--without-theta", action="store_true", help=link)
    limit = "with the limiter that the certificate covers, for forces of up to so much [N]; one is for all channels"
    parser.add_argument("--force-limit", type=options.several(float, 1e-3, 1e6, "N"), metavar="N,N,..", help=limit)
    options.add_output_options(parser, "FILE", "the file (default out/export/<coupling>-<what>.<suffix>)")
    return parser


def _verdict(stored: Stored) -> Verdict:
    try:
        return verify(stored)
    except (ValueError, ArithmeticError) as error:
        return Verdict(False, str(error))


def _forces(block: ExportedBlock) -> str:
    if block.limiter:
        return f"limited to {listed(block.limiter.limit)} N by the limiter"
    return "not limited in this file: the proof holds below what the motors give (--force-limit for more)"


def _block(args: argparse.Namespace, stored: Stored, verdict: Verdict) -> ExportedBlock:
    """The block that was asked for, with lines on where it comes from. Raises InputError."""
    try:
        m = len(stored.loop.theta)
        limit = options.per_channel("--force-limit", args.force_limit, m) if args.force_limit else None
        block = process_block(stored, not args.without_theta, limit) if args.process else coupling_block(stored)
    except NothingToExport as error:
        raise InputError(f"{args.coupling}: {error} (--process)") from None
    except ValueError as error:  # coefficients beyond floating point
        raise InputError(f"{args.coupling}: {error}") from None
    origin = (
        f"Written by python -m design.export from {Path(args.coupling).name}: {_gains(stored)}",
        *block.about,
        _guarantee(stored, verdict, block.limiter is not None),
    )
    return replace(block, about=origin)


def _gains(stored: Stored) -> str:
    coupling = stored.coupling
    if isinstance(coupling, SpringDamperForm):
        return f"spring-damper, K = {listed(coupling.K)} N/m, B = {listed(coupling.B)} N s/m"
    return f"coupling of kind {coupling.__struct_config__.tag}"


def _guarantee(stored: Stored, verdict: Verdict, limited: bool) -> str:
    claim = stored.certificate
    if claim is None or not verdict.proved:
        return f"NOT CERTIFIED: {verdict.reason}"
    needs = f"needs {listed(claim.required)} of {listed(claim.available)} N s/m of device damping"
    delays = f"; {switching_guarantee(stored.loop.varying_delay)}, in {HERE}" if stored.loop.varying_delay else ""
    how = f"{claim.condition}, proof: {claim.proof}"
    if claim.guarantee == RANGES:
        how += "; at the vertices, between them nothing is proved: design.check searches there"
    return f"Certified for {claim.guarantee}{delays} ({how}): {needs}; " + (
        "also while forces are limited." if limited else "linear forces only."
    )


def _destination(args: argparse.Namespace, block: ExportedBlock) -> Path:
    return out_file(args.out, f"out/export/{Path(args.coupling).stem}-{block.name}{_SUFFIX[args.format]}")


def _content(kind: str, block: ExportedBlock, test: Trial, file: str) -> Any:
    """What `design.files.write` takes."""
    if kind == "c":
        return c_source(block, test, file)
    if kind == "control":
        return control_source(block, test)
    plain = data(block, test)
    if kind == "json":
        return json.dumps(plain, indent=1, allow_nan=False) + "\n"

    arrays: dict[str, Any] = {name: np.array(value) for name, value in plain.items()}

    def archive(destination: BinaryIO) -> None:
        np.savez(destination, **arrays)

    return archive
