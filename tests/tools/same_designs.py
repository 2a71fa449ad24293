"""Design the same couplings under different conditions of the machine, and compare the stored files byte for byte.

    python tests/tools/same_designs.py

Each coupling is designed on an idle machine, under load, and in three simultaneous processes, one of which is pinned to
one core. The exit code is 1 if a file differs.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from hashlib import sha256
from pathlib import Path

ROOT = Path(__file__).parents[2]
LOOPS = ROOT / "benchmarks" / "loops"
DESIGNS = {
    "case I": ("--case", "I", "--coupling", "optimal"),
    "case II": ("--case", "II", "--coupling", "optimal"),
    "n2 with ranges": ("--scenario", str(LOOPS / "n2-lab31.toml"), "--coupling", "optimal", "--ranges", "10"),
    "n5": ("--scenario", str(LOOPS / "n5-three-psi1.toml"), "--coupling", "optimal"),
    "o04, gains": ("--scenario", str(LOOPS / "o04-unlike-pair.toml"), "--condition", "this-environment"),
    "o12, limiter": ("--scenario", str(LOOPS / "o12-free-mass-late.toml"), "--coupling", "optimal", "--limiter"),
}


def begun(words: tuple[str, ...], out: Path, core: int | None = None) -> subprocess.Popen[bytes]:
    """Start a design that stores its coupling in `out`; `core` pins it to a core."""
    command = [sys.executable, "-m", "design", *words, "--out", str(out)]
    pinned = None if core is None else (lambda: os.sched_setaffinity(0, {core}))
    return subprocess.Popen(command, cwd=ROOT, preexec_fn=pinned, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)


def stored(process: subprocess.Popen[bytes], out: Path) -> bytes:
    """Wait for a design, and return its file. Raises RuntimeError if it stored none."""
    _, error = process.communicate()
    if not out.exists():
        raise RuntimeError(f"{' '.join(map(str, process.args))}\n{error.decode()}")
    return out.read_bytes()


@contextmanager
def busy(count: int) -> Iterator[None]:
    """Keep `count` processes busy until the block ends."""
    with ExitStack() as stack:
        for _ in range(count):
            process = stack.enter_context(subprocess.Popen([sys.executable, "-c", "while True: pass"]))
            stack.callback(process.kill)
        yield


def files(words: tuple[str, ...], folder: Path) -> dict[str, bytes]:
    """Return the file that the design stores under each condition of the machine."""

    def made(*names: str, core: int | None = None) -> dict[str, bytes]:
        """Return the files of simultaneous processes, one per name; `core` pins the last one to a core."""
        outs = [folder / f"{name}.json" for name in names]
        cores = [*[None] * (len(names) - 1), core]
        begins = [begun(words, out, core) for out, core in zip(outs, cores, strict=True)]
        return {name: stored(one, out) for name, one, out in zip(names, begins, outs, strict=True)}

    stored_files = made("idle")
    with busy(8):
        stored_files |= made("under load")
    core = min(os.sched_getaffinity(0)) if hasattr(os, "sched_setaffinity") else None
    return stored_files | made("first of three", "second of three", "third, on one core", core=core)


def main() -> int:
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    differ = False
    for name, words in DESIGNS.items():
        with tempfile.TemporaryDirectory() as folder:
            stored_files = files(words, Path(folder))
        same = len(set(stored_files.values())) == 1
        differ |= not same
        digests = ", ".join(f"{how}: {sha256(data).hexdigest()[:12]}" for how, data in stored_files.items())
        print(f"{name}: {'the same bytes' if same else 'DIFFERENT BYTES'} ({digests})", flush=True)
    return int(differ)


if __name__ == "__main__":
    sys.exit(main())
