"""The serial link: protocol, device state machine, bridge and emulator.

    from hw import rehearse

rehearse(scenario)                  Rehearsed: a whole session with an emulated device, in virtual time
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from hw.rehearsal import Rehearsed, rehearse

__all__ = ["Rehearsed", "rehearse"]


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module 'hw' has no attribute {name!r}")
    return getattr(import_module("hw.rehearsal"), name)


def __dir__() -> list[str]:
    """For help() and completion: what is for scripts, and what every package has."""
    return [*__all__, *(name for name in globals() if name.startswith("__"))]
