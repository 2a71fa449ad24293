"""The closed loop: scenarios, engines, runs, and what a run is worth.

    from sim import Scenario, load, parse, simulate, validate, plot_run

load("omega-pair"), parse(text)     a Scenario, from a TOML file, by name, or from text; Scenario.replace changes it
Scenario.loop("I")                  all that a design may know of it, for the package `design`
simulate(scenario, coupling)        a Trace: what happens with the people of the scenario, tick by tick
validate(scenario, coupling)        Findings: what happens with so many random ones
plot_run(trace, path, ...)          a picture of a Trace
InputError                          a ValueError: something to put right, in one line

help(sim.simulate) and the like say more. Names are loaded when they are first used: a command must not wait for what
it does not need.
"""

from __future__ import annotations

import os
import sys
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sim.api import simulate, validate
    from sim.crowds import Findings
    from sim.plots import plot_run
    from sim.scenario import InputError, Scenario, load, parse
    from sim.trace import Trace

__all__ = ["Findings", "InputError", "Scenario", "Trace", "load", "parse", "plot_run", "simulate", "validate"]

_HOMES = {
    "simulate": "sim.api",
    "validate": "sim.api",
    "Findings": "sim.crowds",
    "plot_run": "sim.plots",
    "Trace": "sim.trace",
}


def _command_starts() -> bool:
    """Whether this process is one of our commands that Python is still looking for."""
    words = sys.orig_argv
    module = words[words.index("-m") + 1] if "-m" in words[:-1] else ""
    if sys.argv[:1] == ["-m"]:
        return module.split(".")[0] in ("design", "sim", "hw", "cli")
    started = sys.argv[0] if sys.argv else ""
    return os.path.basename(started) == "haptic-loop" or started.endswith(os.path.join("cli", "__main__.py"))


# MuJoCo cannot be imported where what MUJOCO_GL names is not there, and no command of ours draws by it; a script's own
# MuJoCo keeps what it was given
if _command_starts():
    os.environ.pop("MUJOCO_GL", None)


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module 'sim' has no attribute {name!r}")
    return getattr(import_module(_HOMES.get(name, "sim.scenario")), name)


def __dir__() -> list[str]:
    """For help() and completion: what is for scripts, and what every package has."""
    return [*__all__, *(name for name in globals() if name.startswith("__"))]
