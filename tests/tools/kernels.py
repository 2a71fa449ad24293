"""Run the numerical tests under every linear-algebra kernel of this processor, and print a table of the results.

A kernel is a build of OpenBLAS for one kind of processor. Kernels round differently, because they add in different
orders. So do two more settings: NumPy without the instruction sets that it chooses at run time, and eight threads.

    python tests/tools/kernels.py                 every setting (half an hour to an hour on two cores)
    python tests/tools/kernels.py --one           the quick tests of ROUNDING under one other kernel than the native
                                                  one, which the commit chooses (for CI)
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

#: The tests of --one: those whose results depend most on rounding (factorizations, eigenvalues, exact proofs, designs).
#: To choose them, the calls of numpy.linalg, scipy.linalg and LAPACK were recorded. Whole files are listed if they
#: compare such results with independent ones. The single tests reach calls that no listed file reaches. When recorded,
#: these tests reached 202 of the 234 calls that all quick tests reach, in an eighth of the time.
ROUNDING = (
    "tests/controller/test_limiter.py",
    "tests/controller/test_lti.py",
    "tests/controller/test_own_environment.py",
    "tests/controller/test_walls.py",
    "tests/design/test_ccl.py",
    "tests/design/test_certificate.py",
    "tests/design/test_cone.py",
    "tests/design/test_exact.py",
    "tests/design/test_exact_blocks.py",
    "tests/design/test_limiter.py",
    "tests/design/test_lmi.py",
    "tests/design/test_margin.py",
    "tests/design/test_moving_average.py",
    "tests/design/test_robustness.py",
    "tests/models/test_human.py",
    "tests/sim/test_axes.py",
    "tests/sim/test_growth.py",
    "tests/sim/test_map_of_environments.py",
    "tests/sim/test_own_hand.py",
    "tests/sim/test_passivity_layer.py",
    "tests/sim/test_stability.py",
    "tests/sim/test_substeps.py",
    "tests/design/test_axes.py::test_longest_period_scales_matrix_levels",
    "tests/design/test_axes.py::test_this_environment_takes_matrix_levels",
    "tests/design/test_bound.py::test_negative_values_between_samples_are_found",
    "tests/design/test_bound.py::test_timing_scales_the_level_of_a_bound",
    "tests/design/test_claims.py::test_one_sample_of_psi_exceeds_the_damping",
    "tests/design/test_combinations.py::test_the_stiffest_coupling_attains_the_latency_limit",
    "tests/design/test_encoder_steps.py::test_ten_micrometre_steps_need_known_friction",
    "tests/design/test_export.py::test_unsolved_vectors_are_zero_with_their_slips",
    "tests/design/test_known_device.py::test_bare_springs_gain_nothing_from_known_devices",
    "tests/design/test_known_device.py::test_the_proof_is_tight_for_the_papers_loop",
    "tests/design/test_optimal.py::test_late_walls_match_their_closed_form",
    "tests/design/test_optimal.py::test_matrix_routines_equal_those_of_scipy",
    "tests/design/test_optimal.py::test_the_barrier_reaches_a_cone_solvers_optimum",
    "tests/design/test_spring_damper.py::test_slopes_match_finite_differences",
    "tests/design/test_spring_damper.py::test_the_least_eigenpair_solves_its_equation",
    "tests/sim/test_validate.py::test_batched_eigenvalues_are_those_of_each_loop",
    "tests/sim/test_view.py::test_live_frames_equal_the_simulated_run",
    "tests/sim/test_world.py::test_matrix_levels_dissipate_as_computed_by_hand",
    "tests/sim/test_zwidth.py::test_maps_of_the_widest_plane_match_sweeps",
    "tests/sim/test_zwidth.py::test_the_linear_points_agree_with_the_eigenvalues",
)

#: kernels of OpenBLAS, and the feature of the processor, in NumPy's words, that each needs
NEEDS = {
    "PRESCOTT": "SSE3",
    "NEHALEM": "SSE42",
    "SANDYBRIDGE": "AVX",
    "HASWELL": "AVX2",
    "ZEN": "AVX2",
    "SKYLAKEX": "AVX512_SKX",
}
#: program that asks NumPy for its features, and threadpoolctl for the kernels that NumPy's and SciPy's OpenBLAS use
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

    `quick` runs the quick tests of ROUNDING only.
    """
    OUT.mkdir(parents=True, exist_ok=True)
    began = time.monotonic()
    parallel = ["-n", str(workers), "--dist", "loadfile", "--no-loadscope-reorder"]
    chosen = ["-m", "not slow and not validate and not firmware", *ROUNDING] if quick else TESTS
    words = [sys.executable, "-m", "pytest", *parallel, "-rfEs", *chosen]
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
    parser.add_argument("--one", action="store_true", help="the quick tests of ROUNDING under one foreign kernel")
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
