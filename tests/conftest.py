"""What holds for every test: one BLAS thread, and no verdict on how fast the machine is."""

import hashlib
import os
import pickle
import signal

# `make test &` has SIGINT ignored, and whoever is started inherits that: tests that send it would wait for ever.
signal.signal(signal.SIGINT, signal.default_int_handler)

# The matrices here are small: a pool of BLAS threads costs more than it saves, most of all on a busy machine.
# To be set before NumPy is loaded; the commands that tests start inherit it.
for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(name, "1")

# What a test finds does not depend on what ran before it.
os.environ["HAPTIC_LOOP_CACHE"] = "off"

import pytest  # noqa: E402
from hypothesis import HealthCheck, settings  # noqa: E402

settings.register_profile("no-clock", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("no-clock")


@pytest.fixture(autouse=True, scope="session")
def a_run_designs_once(tmp_path_factory):
    """Runs, maps and crowds ask for the same couplings again and again, seconds each: one design for all processes.

    The designs' own tests (tests/design) call what makes them, and are not served from here.
    """
    from design import designs
    from design.stored import digest
    from sim import couplings

    folder = tmp_path_factory.getbasetemp()
    folder = (folder.parent if os.environ.get("PYTEST_XDIST_WORKER") else folder) / "designs"
    folder.mkdir(exist_ok=True)

    def remembered(loop, kind, condition=None, progress=None, **asked):
        asked_for = digest(loop), kind, condition, *sorted(asked.items())
        file = folder / hashlib.sha256(repr(asked_for).encode()).hexdigest()
        if not file.exists():
            made = designs.design_by_kind(loop, kind, condition, *([progress] if progress else []), **asked)
            part = file.with_suffix(f".{os.getpid()}")
            part.write_bytes(pickle.dumps(made))
            part.rename(file)
        return pickle.loads(file.read_bytes())

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(couplings, "design_by_kind", remembered)
        yield
