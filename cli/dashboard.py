"""The live view of a session, in a process of its own: drawing a table takes longer than a tick.

The bridge writes one line of JSON a few times a second; this process draws the last one.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from contextlib import suppress
from typing import Any

from rich.live import Live
from rich.table import Table

from cli.render import Screen
from hw.limits import Stage
from hw.session import Session

_WIDTH = 72  # columns
_BAR = 30  # characters of a bar
_COUNTED = ("gaps", "misses", "late", "clipped", "device_errors", "duplicates", "stale", "host_errors")


def _snapshot(session: Session) -> dict[str, Any]:
    """What the view shows, as plain data."""
    drive = session.drive
    return {
        "stage": str(session.stage),
        "cause": session.cause,
        "doing": _doing(session),
        "x_mm": [1e3 * x for x in (drive.x or ())] if drive else [],
        "f": list(drive.force) if drive else [],
        "cap": list(session.limits.cap),
        "gain": session.gain,
        "theta": session.config.theta if session.config else None,
        "margin_us": session.link.least_margin,
        "counters": {name: getattr(session.counters, name) for name in _COUNTED},
    }


def _doing(session: Session) -> str:
    """The present work, if it takes longer than a moment."""
    if session.stage == Stage.MEASURING:
        return f"measuring the delay: {len(session.measurement.ages)} of {session.settings.measure} answers"
    return "designing the coupling" if session.stage == Stage.MEASURED else ""


def view(data: dict[str, Any], width: int = _WIDTH) -> Table:
    """One snapshot as a table, in a terminal of `width` columns."""
    table = Table(title=f"{data['stage']}: {data['cause']}", width=min(width, _WIDTH), show_header=False)
    table.add_column("what", width=16 if width >= _WIDTH else 7)
    table.add_column("now")
    if data["doing"]:
        table.add_row("now", data["doing"])
    for i, (x, f, cap) in enumerate(zip(data["x_mm"], data["f"], data["cap"], strict=False), start=1):
        table.add_row(f"axis {i}", f"{x:+8.3f} mm  {f:+7.3f} N  {_bar(f / cap) if width >= _WIDTH else ''}")
    margin = "-" if data["margin_us"] is None else f"at least {data['margin_us']} us in the last ticks"
    table.add_row("margin", f"{margin}; theta = {data['theta']}, gain {data['gain']:.2f}")
    table.add_row("counted", ", ".join(f"{name} {n}" for name, n in data["counters"].items()))
    table.add_row("keys", "a arm · s stop · space e-stop · q quit")
    return table


def _bar(part: float) -> str:
    """A bar for a force between its two limits, growing from the middle."""
    half = _BAR // 2
    n = round(min(1.0, abs(part)) * half)
    return ("█" * n).rjust(half) + "│" + " " * half if part < 0 else " " * half + "│" + ("█" * n).ljust(half)


class Dashboard:
    """The view's process, fed without waiting for it."""

    def __init__(self) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-m", "cli.dashboard"], stdin=subprocess.PIPE, start_new_session=True
        )
        assert self._process.stdin is not None
        self._pipe = self._process.stdin.fileno()
        os.set_blocking(self._pipe, False)

    def __call__(self, session: Session) -> None:
        """Show the session as it is now; a view that does not keep up misses a picture."""
        with suppress(OSError):
            os.write(self._pipe, (json.dumps(_snapshot(session)) + "\n").encode())

    def close(self) -> None:
        """Leave the last picture on the screen."""
        assert self._process.stdin is not None
        with suppress(OSError):
            self._process.stdin.close()
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(timeout=2.0)


def main() -> None:
    """Draw every snapshot until the pipe ends."""
    with Live(console=Screen(stderr=True), auto_refresh=False) as live:
        for line in sys.stdin:
            with suppress(ValueError):
                live.update(view(json.loads(line), live.console.width), refresh=True)


if __name__ == "__main__":
    main()
