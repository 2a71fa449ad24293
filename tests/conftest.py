"""What holds for every test: one BLAS thread, and no verdict on how fast the machine is."""

import os
import signal

# `make test &` has SIGINT ignored, and whoever is started inherits that: tests that send it would wait for ever.
signal.signal(signal.SIGINT, signal.default_int_handler)

# The matrices here are small: a pool of BLAS threads costs more than it saves, most of all on a busy machine.
# To be set before NumPy is loaded; the commands that tests start inherit it.
for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(name, "1")

import pytest  # noqa: E402
from hypothesis import HealthCheck, settings  # noqa: E402

settings.register_profile("no-clock", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("no-clock")


@pytest.fixture(autouse=True, scope="session")
def couplings_beside_a_run_are_designed_once():
    """Every run shows other couplings for the same devices: the same designs again and again, seconds each."""
    from design.stored import digest
    from sim import alternatives

    made, choose = {}, alternatives.choose

    def remembered(scenario, case, kind, condition):
        key = (digest(scenario.loop(case)), case, kind, condition)
        if key not in made:
            made[key] = choose(scenario, case, kind, condition)
        return made[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(alternatives, "choose", remembered)
        yield
