"""Boards without a host arm only correct axes and drop forces at faults: hw/firmware/haptic_alone.h, compiled here.

The handle is a mass with damping, Coulomb friction and a constant force such as gravity. With Coulomb friction it is
stepped ten times a tick, otherwise once.
"""

import ctypes
import math
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from haptic_loop.controller.coupling import SpringDamper
from haptic_loop.controller.environment import GROUND, Network, Spring
from haptic_loop.controller.loop import Loop
from haptic_loop.design.certificate import prove
from haptic_loop.design.coupling_file import Stored
from haptic_loop.design.export import c_source, in_single_precision, process_block, trial

GCC, GXX = shutil.which("gcc"), shutil.which("g++")
pytestmark = pytest.mark.skipif(GCC is None, reason="gcc is not installed: haptic_alone.h is not compiled here")
FIRMWARE, STUBS = Path(__file__).parents[2] / "hw/firmware", Path(__file__).parents[1] / "firmware"
T, MASS, COUNT = 1e-3, 0.08, 2e-5  # [s], [kg], [m]
READY, RUNNING, STOPPING = 1, 3, 4  # phases of haptic_alone.h; the next line has causes
ASKED, RANGE, SIGN, DEAD, SCALE, LIMITS = 1, 4, 6, 7, 8, 9
#: A spring of 300 N/m with a little damping and an outside force replace the exported file. The board's force is -f.
SOURCE = """
#define PROCESS_CHANNELS 2
#define PROCESS_PERIOD 1e-3
#define PROCESS_PERIOD_NS 1000000
#define PROCESS_CERTIFIED 1
#define PROCESS_THETA_LEAST 1
#define PROCESS_THETA_MOST 1
#define PROCESS_FORCE_LIMIT_MN 4000
typedef struct { REAL last[2]; } process_state;
static double pushed;
static inline void process_reset(process_state *s) { s->last[0] = s->last[1] = 0; }
static inline void process_step(process_state *s, const REAL *x, REAL *f) {
    for (int i = 0; i < 2; i++) {
        f[i] = 300 * x[i] + (x[i] - s->last[i]) / (REAL)1e-3 - (REAL)pushed;
        s->last[i] = x[i];
    }
}
#define HA_REAL REAL
#include "haptic_alone.h"
static ha_runner runner;
static const ha_limits right = {0.1, 1.0, 4.0, 2e-5, 0.08};
static ha_limits limits;
void home(void) { limits = right; pushed = 0; ha_home(&runner); }
void limit(int at, double to) { (at == 0 ? &limits.range : at == 1 ? &limits.speed : &limits.cap)[0] = (REAL)to; }
void push(double force) { pushed = force; }
void arm(void) { ha_arm(&runner); }
void stop(int cause) { ha_stop(&runner, (uint8_t)cause); }
int tick(const double *x, double *force) {
    REAL own[2] = {(REAL)x[0], (REAL)x[1]};
    ha_tick(&runner, &limits, own);
    for (int i = 0; i < 2; i++) force[i] = runner.force[i];
    return runner.phase + 16 * runner.cause;
}
"""


@pytest.fixture(scope="module", params=["double", "float"])
def board(request, tmp_path_factory):
    folder = tmp_path_factory.mktemp("alone")
    (folder / "board.c").write_text(SOURCE)
    command = ["gcc", "-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Werror", "-O1", "-shared", "-fPIC"]
    command += [f"-DREAL={request.param}", f"-I{FIRMWARE}", "-o", "board.so", "board.c"]
    subprocess.run(command, cwd=folder, check=True)
    library = ctypes.CDLL(str(folder / "board.so"))
    library.seeds = range(3) if request.param == "double" else range(3, 6)
    return library


class Bench:
    """A board with two handles. The motor or the sensor of axis 2 may be wrong."""

    def __init__(self, board, seed=0, noise=0.0, friction=0.0, gravity=0.0, speed=0.0, motor=1.0, sensor=1.0):
        self.board, self.rng, self.noise = board, np.random.default_rng(seed), noise
        self.friction, self.gravity, self.motor, self.sensor = friction, gravity, motor, sensor
        self.x, self.v = [0.0, 0.0], [speed, speed]
        self.force, self.seen = (ctypes.c_double * 2)(), (ctypes.c_double * 2)()
        self.fastest, self.stuck, self.hand = 0.0, None, 0.0
        board.home()

    def tick(self):
        """Run a tick, and return the board's phase and cause."""
        acting = self.force[0], self.motor * self.force[1]  # the board computed these from the last sample
        noise = (self.noise * self.rng.standard_normal(2)).tolist() if self.noise else [0.0, 0.0]
        shown = [round(x / COUNT + n) * COUNT for x, n in zip(self.x, noise, strict=True)]
        self.seen[0], self.seen[1] = shown[0], self.sensor * shown[1]
        if self.stuck is not None:
            self.seen[1] = self.stuck + round(noise[1]) * COUNT
        told, steps = self.board.tick(self.seen, self.force), 10 if self.friction else 1
        for i, force in enumerate(acting):
            x, v, outside = self.x[i], self.v[i], force + self.gravity + self.hand
            for _ in range(steps):
                friction = self.friction * math.tanh(v / 1e-3) if self.friction else 0.0
                v += T / steps * (outside - 0.5 * v - friction) / MASS
                x += T / steps * v
            self.x[i], self.v[i] = x, v
        self.fastest = max(self.fastest, *map(abs, self.v))
        return told % 16, told // 16

    def armed(self):
        """Arm the board, and return its phase and cause after its motor tests."""
        for _ in range(150):
            self.tick()
        self.board.arm()
        for _ in range(1300):
            if (state := self.tick())[0] in (READY, RUNNING):
                return state
        raise AssertionError("the motor tests do not end")


NOISE = [0.0, pytest.param(0.5, marks=pytest.mark.slow), 1.0, 2.0]  # [counts]


def seeds(board, noise):
    """Return seeds of the noise: without noise all runs are equal."""
    return board.seeds if noise else board.seeds[:1]


@pytest.mark.parametrize("noise", NOISE)
@pytest.mark.parametrize("load", [{}, {"friction": 0.2}, {"gravity": 0.05}, {"speed": 0.03}], ids=str)
def test_correct_axes_are_armed(board, noise, load):
    for seed in seeds(board, noise):
        assert Bench(board, seed, noise, **load).armed() == (RUNNING, 0)


@pytest.mark.parametrize("noise", NOISE)
@pytest.mark.parametrize(
    ("wrong", "causes"),
    [
        ({"motor": -1.0}, {SIGN}),
        ({"sensor": -1.0}, {SIGN}),
        ({"motor": 0.0}, {DEAD}),
        ({"sensor": 0.0}, {DEAD}),
        ({"motor": 0.35}, {SCALE, DEAD}),  # a weak motor may stay below the noise
        ({"sensor": 2.5}, {SCALE}),
        ({"motor": -1.0, "friction": 0.2}, {SIGN, DEAD}),
        ({"motor": -1.0, "speed": 0.05}, {SIGN}),
        ({"motor": 0.0, "speed": 0.05}, {DEAD}),
        ({"motor": 0.0, "gravity": 0.05}, {DEAD}),
    ],
    ids=str,
)
def test_wrong_axes_are_never_armed(board, noise, wrong, causes):
    for seed in seeds(board, noise):
        bench = Bench(board, seed, noise, **wrong)
        phase, cause = bench.armed()
        assert phase == READY
        assert cause in causes
        assert list(bench.force) == [0.0, 0.0]
        assert bench.fastest < 0.35  # [m/s] at a free handle


@pytest.mark.parametrize("noise", [0.0, 1.0])
def test_forces_ramp_out_if_a_sensor_dies(board, noise):
    bench = Bench(board, 1, noise)
    assert bench.armed() == (RUNNING, 0)
    for k in range(1500):
        bench.hand = 1.5 * min(1, k / 500) * (1 + 0.02 * np.sin(2 * np.pi * 9 * T * k))  # the hand has tremor
        assert bench.tick() == (RUNNING, 0)
    assert abs(bench.force[1]) > 1.0
    bench.stuck = bench.sensor * round(bench.x[1] / COUNT) * COUNT
    pushed = []
    for _ in range(620):
        told = bench.tick()
        pushed.append(abs(bench.force[1]))
    assert told == (READY, DEAD)
    assert pushed[-1] == 0.0
    assert max(np.abs(np.diff(pushed))) < 0.05 + 0.3 * noise  # [N] in a tick: a ramp lasts 100 ms


def test_a_fast_handle_cuts_the_ramp_short(board):
    bench = Bench(board)
    assert bench.armed() == (RUNNING, 0)
    for k in range(600):
        bench.hand = 1.5 * min(1, k / 500)
        bench.tick()
    board.stop(ASKED)
    bench.tick()
    assert any(bench.force)
    bench.v[0] = 1.5
    bench.tick()
    assert bench.tick() == (READY, ASKED)  # the first cause stays
    assert list(bench.force) == [0.0, 0.0]


@pytest.mark.parametrize("stopping", [False, True])
@pytest.mark.parametrize("wrong", [np.nan, np.inf, -np.inf])
def test_one_invalid_position_drops_the_force(board, wrong, stopping):
    bench = Bench(board)
    assert bench.armed() == (RUNNING, 0)
    bench.hand = 1.0
    for _ in range(300):
        bench.tick()
    if stopping:
        board.stop(ASKED)
        bench.tick()
    assert any(bench.force)
    bench.seen[1] = wrong
    told = board.tick(bench.seen, bench.force)
    assert (told % 16, told // 16) == (READY, ASKED if stopping else RANGE)
    assert list(bench.force) == [0.0, 0.0]
    bench.hand, bench.v = 0.0, [0.0, 0.0]
    assert bench.armed() == (RUNNING, 0)  # nothing invalid is left in the state


def test_an_invalid_position_at_rest_is_forgotten(board):
    """Afterwards the sensors' noise is measured anew, so a moving handle under force is not taken for dead."""
    bench = Bench(board)
    bench.seen[:] = 0.0, np.nan
    board.tick(bench.seen, bench.force)
    assert bench.armed() == (RUNNING, 0)
    for k in range(1200):
        bench.hand = 1.5 * min(1, k / 500) * (1 + 0.02 * np.sin(2 * np.pi * 9 * T * k))
        assert bench.tick() == (RUNNING, 0)


@pytest.mark.parametrize("value", [np.nan, 0.0, -1.0])
@pytest.mark.parametrize("limit", range(3), ids=["range", "speed", "cap"])
def test_impossible_limits_prevent_arming(board, limit, value):
    bench = Bench(board)
    for _ in range(150):
        bench.tick()
    board.limit(limit, ctypes.c_double(value))
    board.arm()
    assert bench.tick() == (READY, LIMITS)
    assert list(bench.force) == [0.0, 0.0]


def test_separate_presses_of_a_still_handle_never_add(board):
    """The force ramps out after 0.5 s of force without a motion; after a pause without force this time begins anew."""
    bench = Bench(board)
    assert bench.armed() == (RUNNING, 0)
    for force, ticks in [(2.0, 400), (0.0, 10)] * 4:
        board.push(ctypes.c_double(force))
        for _ in range(ticks):
            assert board.tick(bench.seen, bench.force) == RUNNING
    board.push(ctypes.c_double(2.0))
    states = {board.tick(bench.seen, bench.force) for _ in range(700)}
    assert states == {RUNNING, STOPPING + 16 * DEAD, READY + 16 * DEAD}


def write_export(path, theta=(1, 1), with_theta=False, limit=8.0, period=1.2e-3, single=False, **more):
    """Write the process of soft springs with a limiter of their proof. `more` are fields of the block."""
    names, m = tuple("abc"[: len(theta)]), len(theta)
    springs = tuple(Spring((name, GROUND), 300.0, 0.1) for name in names)
    loop = Loop(period, theta, (0,) * m, theta, (20.0,) * m, Network(names, springs))
    coupling = SpringDamper((300.0,) * m, (0.1,) * m)
    stored = Stored.of(loop, coupling, prove(loop, coupling, "any-environment"))
    block = process_block(stored, with_theta, limit and (limit,) * m)
    block = replace(in_single_precision(block) if single else block, **{"certified": True} | more)
    path.write_text(c_source(block, trial(block), path.name))


@pytest.mark.skipif(GXX is None, reason="g++ is not installed: teensy.ino is not compiled here")
@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({}, None),
        ({"limit": 3.0}, None),
        ({"with_theta": True}, "Export with --without-theta"),
        ({"theta": (2,)}, "theta = 1 for each axis"),
        ({"theta": (1, 2)}, "theta = 1 for each axis"),
        ({"theta": (0, 1)}, "theta = 1 for each axis"),
        ({"limit": None}, "Export with --force-limit"),
        ({"limit": 8.1}, "clips forces above CAP_MN"),
        ({"theta": (1, 1, 1)}, "pins for two axes"),
        ({"period": 1.2345678e-3}, "whole microseconds"),
        ({"period": 4.001e-3}, "a T of at most 4 ms"),
        ({"certified": False}, "is not certified"),
        ({"rotary": True}, "metres and newtons"),
    ],
    ids=str,
)
def test_a_sketch_refuses_exports_that_do_not_fit(options, words, tmp_path):
    write_export(tmp_path / "coupling-process.c", **options)
    command = [GXX, "-std=gnu++11", "-fsyntax-only", "-I.", f"-I{FIRMWARE}", f"-I{STUBS}", "-x", "c++"]
    command += [FIRMWARE / "teensy.ino"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert (done.returncode == 0) == (words is None), done.stderr
    assert words is None or words in done.stderr
