"""Hundreds of bad command lines and files; tests/tools/hostile.py says how each must end."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


def driven(*options: str) -> int:
    """Run the driver, assert that all cases are answered well, and return their number."""
    environment = os.environ | {"PYTHONPATH": str(ROOT), "OPENBLAS_NUM_THREADS": "1"}
    words = [sys.executable, str(ROOT / "tests/tools/hostile.py"), *options]
    done = subprocess.run(words, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-4000:] + done.stderr[-1000:]
    number = re.match(r"(\d+) cases, 0 answered badly", done.stdout.splitlines()[-1])
    assert number
    return int(number[1])


@pytest.mark.slow
def test_hostile_cases_are_answered_well():
    """A short run has every second or third pair of field and value, so that every field and every value occurs."""
    assert driven("--short") >= 500
