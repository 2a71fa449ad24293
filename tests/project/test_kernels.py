"""tests/tools/kernels.py counts what pytest's last line says, and names tests that exist."""

import importlib.util
from pathlib import Path

import pytest

_spec = importlib.util.spec_from_file_location("kernels", Path(__file__).parents[1] / "tools/kernels.py")
kernels = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(kernels)


@pytest.mark.parametrize(
    ("summary", "counts"),
    [
        ("3 failed, 40 passed, 2 skipped in 9.1s", [40, 3, 2]),
        ("40 passed, 2 errors in 9.1s", [40, 2, 0]),
        ("1 failed, 40 passed, 1 error in 9.1s", [40, 2, 0]),
        ("no tests ran in 0.1s", [0, 0, 0]),
    ],
)
def test_errors_count_as_failures(summary, counts):
    assert kernels.counted(summary) == counts


def test_tests_of_rounding_exist():
    for name in kernels.ROUNDING:
        file, _, test = name.partition("::")
        assert f"\ndef {test or 'test_'}" in (kernels.ROOT / file).read_text(), name
