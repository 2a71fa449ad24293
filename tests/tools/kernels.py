"""Run the numerical tests under every linear-algebra kernel of this processor, and print a table of the results.

A kernel is a build of OpenBLAS for one kind of processor. Kernels round differently, because they add in different
orders. So do two more settings: NumPy without the instruction sets that it chooses at run time, and eight threads.

    python tests/tools/kernels.py                 every setting (half an hour to an hour on two cores)
    python tests/tools/kernels.py --one           one other kernel than the native one, without slow tests (for CI); the
                                                  commit chooses the kernel, and tests/design or the other folders
    python tests/tools/kernels.py --only HASWELL  only this setting
    python tests/tools/kernels.py --list          the settings of this processor

The output of pytest is written to build/kernels/SETTING.txt. The exit code is 1 if a test fails under any setting.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import subprocess
import sys
import time
from pathlib import Path

ROOT = Path(__file__).parents[2]
OUT = ROOT / "build" / "kernels"
TESTS = ("tests/controller", "tests/design", "tests/models", "tests/sim")

#: kernels of OpenBLAS, and the feature of the processor, in NumPy's words, that each needs
NEEDS = {
    "PRESCOTT": "SSE3",
    "NEHALEM": "SSE42",
    "SANDYBRIDGE": "AVX",
    "HASWELL": "AVX2",
    "ZEN": "AVX2",
    "SKYLAKEX": "AVX512_SKX",
}
#: asks NumPy for its features, and threadpoolctl for the kernels that NumPy's and SciPy's OpenBLAS use
_ASK = """
import json, numpy, scipy.linalg
from threadpoolctl import threadpool_info
from numpy._core._multiarray_umath import __cpu_dispatch__, __cpu_features__
blas = [pool.get("architecture") for pool in threadpool_info() if pool["user_api"] == "blas"]
have = [name for name, there in __cpu_features__.items() if there]
print(json.dumps([blas, have, [name for name in __cpu_dispatch__ if name in have]]))
"""


def asked(**variables: str) -> tuple[list[str], list[str], list[str]]:
    """Return (kernels in use, features of the processor, those features that NumPy chooses at run time)."""
    out = subprocess.run([sys.executable, "-c", _ASK], env={**os.environ, **variables}, capture_output=True, check=True)
    return tuple(json.loads(out.stdout))


def settings() -> dict[str, dict[str, str]]:
    """Return name -> environment variables of every setting that this processor can run, the native kernel first.

    OpenBLAS may silently use one build for several names; only the first of these names is listed.
    """
    blas, have, dispatched = asked()
    every: dict[str, dict[str, str]] = {"native": {}}
    there = {str(blas): "native"}
    for kernel, feature in NEEDS.items():
        if feature in have:
            name = str(asked(OPENBLAS_CORETYPE=kernel)[0])
            if name in there:
                print(f"{kernel} is the same kernel as {there[name]}")
            else:
                there[name], every[kernel] = kernel, {"OPENBLAS_CORETYPE": kernel}
    if dispatched:
        every["NumPy baseline"] = {"NPY_DISABLE_CPU_FEATURES": " ".join(dispatched)}
    # Idle threads sleep after 2^4 cycles; with the usual 2^26 they would slow down working threads.
    every["8 threads"] = {"OPENBLAS_NUM_THREADS": "8", "OPENBLAS_THREAD_TIMEOUT": "4"}
    print(f"the native kernel is {' and '.join(sorted(set(blas)))}", flush=True)
    return every


def foreign(every: dict[str, dict[str, str]]) -> str:
    """Return a kernel other than the native one and the slow PRESCOTT, chosen by the commit's hash, or "native"."""
    others = [name for name in every if name in NEEDS and name != "PRESCOTT"]
    return others[_commit() % len(others)] if others else "native"


def _commit() -> int:
    commit = subprocess.run(["git", "rev-parse", "HEAD"], cwd=ROOT, capture_output=True, text=True).stdout.strip()
    return int(commit or "0", 16)


def tested(name: str, variables: dict[str, str], workers: int, quick: bool) -> tuple[int, int, int, float]:
    """Run the numerical tests under a setting, print failures, and return (passed, failed, skipped, seconds).

    `quick` leaves out the slow tests, and those of tests/design or of the other folders.
    """
    OUT.mkdir(parents=True, exist_ok=True)
    began = time.monotonic()
    parallel = ["-n", str(workers), "--dist", "loadfile", "--no-loadscope-reorder"]
    chosen = ["-m", "not slow and not validate and not firmware"] if quick else []
    half = [folder for folder in TESTS if (folder == "tests/design") == (_commit() >> 8) % 2]
    words = [sys.executable, "-m", "pytest", *parallel, "-rfEs", *chosen, *(half if quick else TESTS)]
    environment = {"OPENBLAS_NUM_THREADS": "1", **os.environ, **variables}
    path = OUT / f"{name.replace(' ', '-')}.txt"
    with path.open("w") as file:
        code = subprocess.run(words, cwd=ROOT, env=environment, stdout=file, stderr=subprocess.STDOUT).returncode
    lines = path.read_text().splitlines()
    print(
        f"\n{name}:",
        *(line for line in lines if line.startswith(("FAILED", "ERROR"))),
        *lines[-1:],
        sep="\n",
        flush=True,
    )
    passed, failed, skipped = counted(lines[-1])
    return passed, failed or int(code != 0), skipped, time.monotonic() - began


def counted(summary: str) -> list[int]:
    """Return the numbers of passed, failed and skipped tests in pytest's last line; an error counts as failed."""
    return [
        sum(int(n) for n in re.findall(rf"(\d+) (?:{words})", summary))
        for words in ("passed", "failed|error", "skipped")
    ]


def main() -> int:
    for name in ("OPENBLAS_CORETYPE", "NPY_DISABLE_CPU_FEATURES"):
        os.environ.pop(name, None)
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", action="append", metavar="SETTING")
    parser.add_argument("--one", action="store_true", help="one foreign kernel, without slow tests")
    parser.add_argument("--list", action="store_true", help="name the settings, run nothing")
    parser.add_argument("-n", type=int, default=os.cpu_count() or 1, help="tests at a time (default: one per core)")
    args = parser.parse_args()
    every = settings()
    names = [foreign(every)] if args.one else args.only or list(every)
    if unknown := [name for name in names if name not in every]:
        parser.error(f"--only {unknown[0]}: this processor runs {', '.join(every)}")
    if args.list:
        print(*names, sep="\n")
        return 0
    rows = [(name, *tested(name, every[name], args.n, args.one)) for name in names]
    print(f"\n{'setting':16}{'passed':>8}{'failed':>8}{'skipped':>9}{'seconds':>9}")
    for name, passed, failed, skipped, seconds in rows:
        print(f"{name:16}{passed:8}{failed:8}{skipped:9}{seconds:9.0f}")
    return int(any(failed for _, _, failed, *_ in rows))


if __name__ == "__main__":
    sys.exit(main())
