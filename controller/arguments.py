"""Check function arguments. Each error message is one line that names the argument."""

from __future__ import annotations

import difflib
import math
import operator
from collections.abc import Collection, Iterable
from typing import Any


def of_kind(name: str, value: Any, kind: type, expected: str) -> None:
    """Raise TypeError unless `value` is an instance of `kind`; `expected` describes `kind` in the message."""
    if not isinstance(value, kind):
        raise TypeError(f"{name} is {shown(value)}, expected {expected}")


def whole(name: str, value: Any, low: int, high: float = math.inf) -> int:
    """Return `value` as an int from `low` to `high`; NumPy integers are allowed. Raises TypeError, ValueError."""
    span = f"{low} to {high}" if high < math.inf else f"{low} or more"
    allowed = f"whole numbers, {span}"
    try:
        number = operator.index(value)
    except TypeError:
        raise TypeError(f"{name} is {shown(value)}, allowed are {allowed}") from None
    if isinstance(value, bool):
        raise TypeError(f"{name} is {shown(value)}, allowed are {allowed}")
    if not low <= number <= high:
        raise ValueError(f"{name} is {number}, allowed are {span}")
    return number


def number(name: str, value: Any, expected: str = "a number") -> float:
    """Return `value` as a float; NumPy numbers are allowed. Raises TypeError."""
    if isinstance(value, bool | str | bytes) or not hasattr(value, "__float__") or getattr(value, "ndim", 0):
        raise TypeError(f"{name} is {shown(value)}, expected {expected}")
    return float(value)


def one_of(name: str, value: Any, allowed: Collection[str]) -> None:
    """Raise ValueError unless `value` is one of the allowed words."""
    if not isinstance(value, str) or value not in allowed:
        quoted = repr(value) if isinstance(value, str) else shown(value)
        raise ValueError(f"{name} is {quoted}, allowed are {', '.join(allowed)}")


def known(options: Iterable[str], allowed: Collection[str], what: str) -> None:
    """Raise TypeError for an option that is not allowed. `what` names the function or kind that has the options."""
    for option in options:
        if option not in allowed:
            close = difflib.get_close_matches(option, allowed, n=1)
            hint = f" (did you mean {close[0]}?)" if close else ""
            choices = f"allowed are {', '.join(allowed)}" if allowed else "which has none: leave it out"
            raise TypeError(f"{option} is no option of {what}{hint}, {choices}")


def shown(value: Any) -> str:
    """Return a description of `value` for a message: `2.5 (float)`, or `a Loop` for long text or our own classes."""
    text = repr(value)
    if len(text) > 60 or "\n" in text or type(value).__module__.startswith("haptic_loop"):
        return f"a {type(value).__name__}"
    return text if value is None else f"{text} ({type(value).__name__})"
