"""The table of guarantees agrees with the code, and documented commands leave no files behind."""

import re
import shutil
import subprocess
from pathlib import Path

import pytest

from haptic_loop.design.environments import ANY_ENVIRONMENT, LIMITER, THIS_ENVIRONMENT
from haptic_loop.design.known_device import KNOWN_DEVICE, KNOWN_DEVICE_ANY, LimitedKnownDevice

ROOT = Path(__file__).parents[2]


def test_documented_commands_leave_the_repository_clean():
    """Git ignores the files that documented commands write into the repository."""
    if shutil.which("git") is None or not (ROOT / ".git").exists():
        pytest.skip("no git, or no clone")
    texts = [page.read_text(encoding="utf-8") for page in (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")))]
    blocks = re.findall(r"^```(?:sh|console)\n(.*?)^```", "".join(texts), flags=re.DOTALL | re.MULTILINE)
    written = {name for block in blocks for name in re.findall(r"--(?:out|video|json) ([\w./-]+)", block)}
    files = sorted(name for name in written if not name.startswith(("/", "out/")))
    assert files
    done = subprocess.run(["git", "check-ignore", *files], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.stdout.split() == files


def test_the_table_of_guarantees_agrees_with_the_code():
    """A cell says "proved" exactly where the condition of its column names the row's extension in `covers`."""
    text = (ROOT / "docs" / "theory.md").read_text(encoding="utf-8").split("## What is guaranteed")[1]
    table = {cells[1].strip(): cells[2:] for line in text.splitlines() if len(cells := line.split("|")) > 5}
    rows = {
        "periods up to `T_max`": "T_max",
        "latency of part of a sample": "latency",
        "walls that make and break contact": "walls",
        "delays that switch": "varying_delay",
        "ranges of parameters": "ranges",
    }
    for row, name in rows.items():
        for condition, cell in ((ANY_ENVIRONMENT, table[row][0]), (THIS_ENVIRONMENT, table[row][2])):
            assert cell.strip().startswith("proved") == (name in condition.covers), (row, condition.name)
    assert "proved" in table["forces limited by the limiter"][2]
    assert ("ranges included" in table["forces limited by the limiter"][2]) == ("ranges" in LIMITER.covers)
    known = table["devices whose motor and transmission are known"]
    words = {"T_max": "periods in", "walls": "walls", "ranges": "ranges", "varying_delay": "switching"}
    for name, word in words.items():
        assert (word in known[2]) == (name in KNOWN_DEVICE.covers), name
    assert ("limiter" in known[2]) == ("walls" in LimitedKnownDevice.covers)
    assert ("latency breaks" in known[2]) == ("latency" not in KNOWN_DEVICE.covers)
    assert ("walls included" in known[0]) == ("walls" in KNOWN_DEVICE_ANY.covers)
    assert ("switching" in known[0]) == ("varying_delay" in KNOWN_DEVICE_ANY.covers)
