"""python -m sim.zwidth: the K-B map that haptics people draw - certified, exact for random humans, simulated.

options -> Ground (the loop, without its coupling) -> grid of gains -> Map -> picture, CSV, JSON
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

from sim import zwidth_report
from sim.command import (
    DOES_NOT_HOLD,
    DONE,
    INTERRUPTED,
    Parser,
    add_loop_options,
    add_output_options,
    console,
    execute,
    numbers,
    out_folder,
    progress_bar,
    rigid_loop,
    scenario_from,
    seed_from,
)
from sim.files import write_json
from sim.gain_grid import Grid, axes
from sim.gain_map import Effects, Map, Plan, draw_map, locate
from sim.gain_ground import Ground
from sim.scenario import InputError, Scenario

EXAMPLE = """python -m sim.zwidth --theta 1 --grid 30
  python -m sim.zwidth --rigid --T 1e-3 --theta 0 --mark 5000,0
  python -m sim.zwidth --rigid --theta 1 --quantisation 1e-5 --saturation --friction 0.2"""
