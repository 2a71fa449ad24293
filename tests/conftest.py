"""Settings of all tests: one BLAS thread, and no failure because the machine is slow."""

import gc
import os
import signal
import sys
import time

# A shell runs `make test &` with SIGINT ignored, which child processes inherit: tests that send SIGINT would hang.
signal.signal(signal.SIGINT, signal.default_int_handler)

# For small matrices, BLAS threads cost more than they save. NumPy reads these variables when it is loaded.
for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(name, "1")

# Hundreds of tests start commands: without bytecode each of them would compile a hundred files.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

import pytest  # noqa: E402
from hypothesis import HealthCheck, settings  # noqa: E402

# With Python's default threshold the garbage collector would scan all modules and fixtures thousands of times.
gc.set_threshold(100_000)

settings.register_profile("no-clock", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("no-clock")


#: the slowest test files; they start first, so that no worker ends long after the others
LONGEST = (
    *("test_docs.py", "test_known_device.py", "test_identify.py", "test_hostile.py", "test_optimal.py"),
    *("test_session.py", "test_live_bridge.py", "test_combinations.py", "test_run.py", "test_spring_damper.py"),
    *("test_budget.py", "test_world.py", "test_ranges.py", "test_ccl.py", "test_audit.py", "test_same_designs.py"),
    *("test_uneven.py", "test_assessment.py", "test_api.py", "test_optimal_humans.py", "test_validate.py"),
)


#: `make check` sets the time at which its minute ends; tests that have not started then are skipped. Lint comes first,
#: so the tests get at least 15 s.
CHECK_UNTIL = max(float(os.environ.get("CHECK_UNTIL", "inf")), time.time() + 15)


def pytest_runtest_setup():
    if time.time() > CHECK_UNTIL:
        pytest.skip("the minute of `make check` is over: `make test` runs this")


def pytest_collection_modifyitems(items):
    if "CHECK_UNTIL" in os.environ:
        return
    items.sort(key=lambda item: LONGEST.index(item.path.name) if item.path.name in LONGEST else len(LONGEST))


@pytest.fixture(autouse=True, scope="session")
def a_run_designs_once(tmp_path_factory):
    """Share designs, which take seconds each, between all tests and processes."""
    from forked import share_designs, wait_silently

    folder = tmp_path_factory.getbasetemp()
    folder = (folder.parent if os.environ.get("PYTEST_XDIST_WORKER") else folder) / "designs"
    folder.mkdir(exist_ok=True)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SHARED_DESIGNS", str(folder))
        share_designs(folder, patch.setattr)
        wait_silently(patch.setattr)
        yield
