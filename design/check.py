"""python -m design.check coupling.json: prove a stored coupling again, from the file alone and without a solver."""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import msgspec
from rich.console import Console
from rich.table import Table

from design.certificate import Verdict, verify
from design.store import Stored, load

EXAMPLE = "example: python -m design.check coupling.json --json -"


def main(argv: list[str] | None = None) -> int:
    """0 proved, 1 not proved, 2 bad input, 130 interrupted."""
    options = _parser().parse_args(argv)
    try:
        start = time.perf_counter()
        stored = load(options.coupling)
        verdict = verify(stored)
        result = _result(stored, verdict, time.perf_counter() - start)
        if options.json:
            _write(result, options.json)
    except (ValueError, ArithmeticError, OSError) as error:
        print(f"design.check: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130
    Console(stderr=options.json == "-").print(_table(result))
    return 0 if verdict.proved else 1


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m design.check", description="Prove a stored coupling again, in exact arithmetic.", epilog=EXAMPLE
    )
    parser.add_argument("coupling", type=Path, help="the stored coupling (JSON)")
    parser.add_argument("--json", metavar="FILE", help="write the result as JSON; - for standard output only")
    return parser


def _result(stored: Stored, verdict: Verdict, seconds: float) -> dict:
    """The machine-readable result; figures are null where the file carries no certificate."""
    claim = stored.certificate
    return {
        "proved": verdict.proved,
        "reason": verdict.reason,
        "condition": claim and claim.condition,
        "promise": claim.promise if claim and verdict.proved else None,
        "proof": claim.proof if claim and verdict.proved else None,
        "required_damping": claim and claim.required,
        "available_damping": stored.loop.delta,
        "margin": claim and claim.margin,
        "wall_s": seconds,
    }


def _write(result: dict, target: str) -> None:
    text = msgspec.json.format(msgspec.json.encode(result), indent=2) + b"\n"
    if target == "-":
        sys.stdout.buffer.write(text)
    else:
        Path(target).write_bytes(text)


def _table(result: dict) -> Table:
    title = "proved, in exact arithmetic" if result["proved"] else "not proved"
    table = Table(title=title, show_header=False, title_justify="left")
    for key, value in result.items():
        if value is not None and key != "proved":
            shown = ", ".join(f"{v:.6g}" for v in value) if isinstance(value, tuple) else value
            table.add_row(key.replace("_", " "), f"{shown:.6g}" if isinstance(shown, float) else str(shown))
    return table


if __name__ == "__main__":
    sys.exit(main())
