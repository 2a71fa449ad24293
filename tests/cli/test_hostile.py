"""A thousand command lines and files that nobody should write; hostile.py says how each must end."""

import os
import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]


def test_every_hostile_case_is_answered_well():
    """In one process, forked for each case; a third of them would not find a mistake in a driver that finds nothing."""
    environment = os.environ | {"PYTHONPATH": str(ROOT), "OPENBLAS_NUM_THREADS": "1"}
    words = [sys.executable, str(Path(__file__).with_name("hostile.py"))]
    done = subprocess.run(words, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-4000:] + done.stderr[-1000:]
    number = re.match(r"(\d+) cases, 0 answered badly", done.stdout.splitlines()[-1])
    assert number
    assert int(number[1]) >= 500
