"""One figure per channel, as text."""

from __future__ import annotations

from collections.abc import Iterable


def listed(values: Iterable[float | None], digits: int = 6) -> str:
    """1.37, 0.5 with so many significant digits; None stands for infinity in plain data."""
    return ", ".join("inf" if v is None else f"{v:.{digits}g}" for v in values)
