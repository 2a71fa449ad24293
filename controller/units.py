"""The unit of positions: m, or rad for rotary devices, with N m, N m s/rad and kg m2 in place of N, N s/m and kg.

The equations are the same for both. The program's texts use metres. If the unit is rad, `in_unit` replaces the units in
a text before it is printed, drawn or written to a file, and `keys_in_unit` those in the keys and texts of a report.
Numbers stay the same.
"""

from __future__ import annotations

import re
from contextvars import ContextVar
from typing import Any, Literal

PositionUnit = Literal["m", "rad"]
_current: ContextVar[PositionUnit] = ContextVar("unit", default="m")
#: the rotary unit for each unit in a text; the single letters of _ALONE are units only directly after "[", or after a
#: digit or closing bracket and one space
_ROTARY = {"N s/m": "N m s/rad", "N/m": "N m/rad", "m/N": "rad/(N m)", "m/s": "rad/s", "kg": "kg m2"}
_ALONE = {"N": "N m", "m": "rad", "g": "g m2"}
_WORDS = re.compile(
    r"(?<![\w/])(?P<prefix>[mu]?)(?P<unit>N s/m|N/m|m/N|m/s|kg(?! m2))(?![\w/])"
    r"|(?<![\w/])(?P<small>[mu])m(?![\w/])"
    r"|(?:(?<=[\d\])}] )|(?<=\[))(?P<milli>[mu]?)(?P<alone>N(?! m\b)|m|g(?! m2))(?![\w/²]| s/)"
)
_KEY = re.compile(r"_(n_per_m|mm|um|m|n|N)$")
_KEYS = {"n_per_m": "nm_per_rad", "mm": "mrad", "um": "urad", "m": "rad", "n": "nm", "N": "Nm"}


def set_unit(unit: PositionUnit) -> None:
    """Set the unit of this command's output."""
    _current.set(unit)


def set_unit_of(meta: Any) -> None:
    """Set the unit of this command's output to that of a stored trace with these meta data."""
    set_unit("rad" if isinstance(meta, dict) and meta.get("unit") == "rad" else "m")


def current_unit() -> PositionUnit:
    """Return the unit of this command's output."""
    return _current.get()


def in_unit(text: str, unit: PositionUnit | None = None) -> str:
    """Return `text` with rotary units if `unit` (default: this command's) is rad. A second call changes nothing."""
    return _WORDS.sub(_rotary, text) if (unit or current_unit()) == "rad" else text


def with_unit(meta: dict[str, Any]) -> dict[str, Any]:
    """Return a trace's meta data, with "unit" if positions are in radians."""
    return meta | {"unit": "rad"} if current_unit() == "rad" else meta


def comments_in_unit(source: str) -> str:
    """Return a C source with comments in the unit of this command's output; its code is unchanged."""
    return re.sub(r"/\*.*?\*/", lambda comment: in_unit(comment[0]), source, flags=re.DOTALL)


def _rotary(match: re.Match[str]) -> str:
    if small := match["small"]:
        return f"{small}rad"
    if match["unit"]:
        return match["prefix"] + _ROTARY[match["unit"]]
    return match["milli"] + _ALONE[match["alone"]]


def keys_in_unit(report: Any) -> Any:
    """Return plain data with keys and texts in this command's unit: encoder_step_m becomes encoder_step_rad."""
    if current_unit() == "m":
        return report
    if isinstance(report, dict):
        return {_KEY.sub(lambda key: f"_{_KEYS[key[1]]}", k): keys_in_unit(value) for k, value in report.items()}
    if isinstance(report, list):
        return [keys_in_unit(value) for value in report]
    return in_unit(report) if isinstance(report, str) else report
