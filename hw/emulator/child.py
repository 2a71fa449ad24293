"""The emulator as a child of the bridge."""

from __future__ import annotations

import argparse
import os
import select
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from cli.options import numbers
from sim.scenario import InputError

PATIENCE = 60.0  # [s] for the emulator to load MuJoCo and print its path
SPARE = 600.0  # [s] beside the run, after which an orphan would end by itself
PASSED_ON = ("case", "scenario", "theta", "psi", "lam", "delta", "T")


def pace_from(args: argparse.Namespace) -> float:
    """Seconds of the device's clock per second. Raises InputError."""
    pace = numbers("--pace", args.pace, float, 1)[0]
    if not 0.01 <= pace <= 1:
        raise InputError(f"--pace is {pace:g}, allowed are 0.01 to 1")
    return pace


@contextmanager
def spawned(args: argparse.Namespace, seed: int, seconds: float, extra: Sequence[str] = ()) -> Iterator[str]:
    """The path of an emulator with the same loop and the faults of --fault, for as long as it is needed."""
    options = [f"--{name}={getattr(args, name)}" for name in PASSED_ON if getattr(args, name) is not None]
    options += [f"--fault={fault}" for fault in args.fault]
    options += [
        f"--parent={os.getpid()}",
        f"--seed={seed}",
        f"--pace={args.pace}",
        f"--duration={seconds + SPARE:g}",
        *extra,
    ]
    child = subprocess.Popen(
        [sys.executable, "-m", "hw.emulator", *options],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        start_new_session=True,  # Ctrl-C is for the bridge, which ramps out first
        text=True,
    )
    assert child.stdout is not None
    assert child.stderr is not None
    try:
        ready = select.select([child.stdout], [], [], PATIENCE)[0]
        path = child.stdout.readline().strip() if ready else ""
        if not path:
            child.terminate()
            said = child.stderr.read().strip().splitlines() or ["it said nothing"]
            raise InputError(f"the emulator did not start: {said[-1].removeprefix('error: ')}")
        yield path
    finally:
        child.terminate()
        child.communicate()
