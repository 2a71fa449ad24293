"""Conditions, figures of merit and designs for virtual couplings. It sees a device only through its damping.

    from design import design_coupling, certify, guarantee, transparency_of

design_coupling(loop, kind)         a Design: the best coupling of a kind for a loop; see DesignOptions
certify(loop, coupling)             a Requirement by each condition: how much damping the coupling needs, and where
guarantee(loop, requirements)       for which environments that makes it safe for every passive human, in words
transparency_of(loop, coupling)     figures of Transparency: how close what one feels comes to the environment
DesignFailed                        a ValueError: there is no such coupling

help(design.certify) and the like say more. Names are loaded when they are first used: a command must not wait for
what it does not need.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from controller.loop import Loop
    from design.api import DesignOptions, certify, design_coupling, guarantee, transparency_of
    from design.result import Design, DesignFailed, Requirement
    from design.transparency import Transparency

__all__ = [
    "Design",
    "DesignFailed",
    "DesignOptions",
    "Loop",
    "Requirement",
    "Transparency",
    "certify",
    "design_coupling",
    "guarantee",
    "transparency_of",
]

_HOMES = {
    "Design": "design.result",
    "DesignFailed": "design.result",
    "Loop": "controller.loop",
    "Requirement": "design.result",
    "Transparency": "design.transparency",
}


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module 'design' has no attribute {name!r}")
    return getattr(import_module(_HOMES.get(name, "design.api")), name)


def __dir__() -> list[str]:
    """For help() and completion: what is for scripts, and what every package has."""
    return [*__all__, *(name for name in globals() if name.startswith("__"))]
