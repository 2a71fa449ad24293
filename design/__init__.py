"""Conditions, figures of merit and designs for virtual couplings. It sees a device only through its damping.

    from design import design_coupling, certify

Names are loaded when they are first used: a command must not wait for what it does not need.
"""

from __future__ import annotations

import sys
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from design.api import certify, design_coupling
    from design.failure import DesignFailed
    from design.margin import Requirement
    from design.result import Design
    from design.store import Loop

if sys.argv[:1] == ["-m"]:  # a command starts, and may be interrupted; scripts do not need sim for a design
    import sim  # noqa: F401

__all__ = ["Design", "DesignFailed", "Loop", "Requirement", "certify", "design_coupling"]

_HOMES = {
    "Design": "design.result",
    "DesignFailed": "design.failure",
    "Loop": "design.store",
    "Requirement": "design.margin",
}


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module 'design' has no attribute {name!r}")
    return getattr(import_module(_HOMES.get(name, "design.api")), name)
