"""Couplings for force-feedback devices with delays: design, proof, simulation in MuJoCo, and a bridge to a device.

    from haptic_loop import load, simulate, validate, design_coupling, certify

load("omega-pair"), parse(text)     Return a Scenario, from a TOML file, a packaged name, or a text.
Scenario.loop("I")                  Return the Loop of a scenario: all data that a design may use.
design_coupling(loop, kind)         Return a Design: the best coupling found of the kind `kind`. See DesignOptions.
certify(loop, coupling)             Return a Requirement per condition: the damping that the coupling needs.
assess(loop, coupling)              Return an Assessment: requirements, force limits, and the guarantee or a reason.
transparency_of(loop, coupling)     Return a Transparency: how close the felt force is to the environment's.
simulate(scenario, coupling)        Return a Trace: a run with the humans of the scenario, tick by tick.
validate(scenario, coupling)        Return Findings: the loop's growth rates with many random humans.
linearise(world, pose)              Return a Network, the linear model of a MuJoCo scene near a pose.
rehearse(scenario)                  Return a Rehearsed: a session with an emulated device, in virtual time.
trace.plot(path), trace.to_frame()  Draw a Trace; return it as a pandas data frame.

Couplings: SpringDamper, NoCoupling. Devices: RigidDevice, CompliantDevice. Environments: Network, with Spring
and Wall, and RIGID_WALL. InputError and DesignFailed are ValueErrors. Names are imported on first use, so that commands
start quickly.
"""

from __future__ import annotations

import os
from importlib import import_module

TYPE_CHECKING = False  # Importing it from typing takes time.
if TYPE_CHECKING:
    from typing import Any

    from haptic_loop.controller.coupling import NoCoupling, SpringDamper
    from haptic_loop.controller.environment import RIGID_WALL, Network, Spring, Wall
    from haptic_loop.controller.loop import Loop
    from haptic_loop.design.api import DesignOptions, certify, design_coupling, transparency_of
    from haptic_loop.design.assessment import Assessment, Guarantee, assess
    from haptic_loop.design.result import Design, DesignFailed, Requirement
    from haptic_loop.design.transparency import Transparency
    from haptic_loop.hw.rehearsal import Rehearsed, rehearse
    from haptic_loop.models.device import CompliantDevice, RigidDevice
    from haptic_loop.sim.api import simulate, validate
    from haptic_loop.sim.crowds import Findings
    from haptic_loop.sim.scenario import InputError, Scenario, load, parse
    from haptic_loop.sim.trace import Trace
    from haptic_loop.sim.world import linearise

_NAMES = {
    "controller.coupling": "NoCoupling SpringDamper",
    "controller.environment": "RIGID_WALL Network Spring Wall",
    "controller.loop": "Loop",
    "design.api": "DesignOptions certify design_coupling transparency_of",
    "design.assessment": "Assessment Guarantee assess",
    "design.result": "Design DesignFailed Requirement",
    "design.transparency": "Transparency",
    "hw.rehearsal": "Rehearsed rehearse",
    "models.device": "CompliantDevice RigidDevice",
    "sim.api": "simulate validate",
    "sim.crowds": "Findings",
    "sim.scenario": "InputError Scenario load parse",
    "sim.trace": "Trace",
    "sim.world": "linearise",
}
_HOMES = {name: module for module, names in _NAMES.items() for name in names.split()}

__all__ = [*_HOMES]  # pyright: ignore[reportUnsupportedDunderAll]

_ROOT = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))
if os.path.isfile(os.path.join(_ROOT, "pyproject.toml")) and os.path.isdir(os.path.join(_ROOT, "controller")):
    __path__.append(_ROOT)  # in a checkout, haptic_loop.sim is the top-level folder sim


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'haptic_loop' has no attribute {name!r}")
    return getattr(import_module(f"haptic_loop.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    """Return the public names, and the names with two underscores that every package has."""
    return [*__all__, *(name for name in globals() if name.startswith("__"))]
