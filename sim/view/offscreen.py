"""Pictures by MuJoCo's own renderer without a display: EGL, or OSMesa in software."""

from __future__ import annotations

import importlib
import os
import subprocess
import sys

import mujoco
import numpy as np
from numpy.typing import NDArray

from sim.graphics import asked
from sim.view.layout import PLOT, SIZE, WORDS
from sim.view.overlay import columns, overlay
from sim.view.session import Frame
from sim.view.stage import Stage

BACKENDS = ("egl", "osmesa")
PATIENCE = 60  # [s] for a driver to say whether it works

_PROBE = "from mujoco.{} import GLContext; c = GLContext(8, 8); c.make_current(); c.free()"


class NoOffscreen(Exception):
    """There is no OpenGL without a display here; the message says what was tried."""


def backend() -> str:
    """The name of a way to render without a display: what MUJOCO_GL asks for if it is one, else the first that works.

    Each is tried in a process of its own, because a failed one leaves OpenGL unusable for the next. Raises NoOffscreen.
    """
    tried = (asked(),) if asked() in BACKENDS else BACKENDS
    reasons = []
    for name in tried:
        reason = _failure(name)
        if reason is None:
            return name
        reasons.append(f"{name}: {reason}")
    raise NoOffscreen(f"no OpenGL without a display here ({'; '.join(reasons)})")


class Offscreen:
    """Renders frames of a stage."""

    def __init__(self, stage: Stage, name: str) -> None:
        """`name` is what backend() gave."""
        self.stage = stage
        width, height = SIZE
        self._gl = importlib.import_module(f"mujoco.{name}").GLContext(width, height)
        self._gl.make_current()
        self._context = mujoco.MjrContext(stage.model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._context)
        self._scene = mujoco.MjvScene(stage.model, 200)
        self._scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = 0
        self._scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = 0
        self._option, self._grip, self._camera = mujoco.MjvOption(), mujoco.MjvPerturb(), mujoco.MjvCamera()
        stage.aim(self._camera, (0.0, 0.0, 0.0), 1.3)

    def picture(self, frame: Frame) -> NDArray[np.uint8]:
        """(height, width, 3): what is said of the loop, the scene, the forces, from top to bottom."""
        stage, (width, height) = self.stage, SIZE
        stage.show(frame.q)
        mujoco.mjv_updateScene(
            stage.model,
            stage.data,
            self._option,
            self._grip,
            self._camera,
            mujoco.mjtCatBit.mjCAT_ALL.value,
            self._scene,
        )
        stage.draw(self._scene, frame)
        below = round(PLOT * height)
        top = round(WORDS * height)
        mujoco.mjr_render(mujoco.MjrRect(0, below, width, height - below - top), self._scene, self._context)
        above = mujoco.MjrRect(0, height - top, width, top)
        mujoco.mjr_rectangle(above, 0.93, 0.93, 0.93, 1.0)
        said = columns(overlay(frame, live=False))
        mujoco.mjr_overlay(
            mujoco.mjtFont.mjFONT_NORMAL,
            mujoco.mjtGridPos.mjGRID_TOPLEFT,
            above,
            *said,
            self._context,
        )
        for place, figure in stage.figures(frame, mujoco.MjrRect(0, 0, width, height)):
            mujoco.mjr_figure(place, figure, self._context)
        pixels = np.empty((height, width, 3), dtype=np.uint8)
        mujoco.mjr_readPixels(pixels, None, mujoco.MjrRect(0, 0, width, height), self._context)
        return np.flipud(pixels)

    def close(self) -> None:
        """Free what the driver holds."""
        self._context.free()
        self._gl.free()


def _failure(name: str) -> str | None:
    """Why a way to render does not work here, None if it does."""
    environment = {key: value for key, value in os.environ.items() if key not in ("PYOPENGL_PLATFORM", "MUJOCO_GL")}
    environment["MUJOCO_GL"] = name
    try:
        done = subprocess.run(
            [sys.executable, "-c", _PROBE.format(name)],
            capture_output=True,
            text=True,
            env=environment,
            timeout=PATIENCE,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return f"no answer in {PATIENCE} s"
    if done.returncode == 0:
        return None
    return (done.stderr.strip().splitlines() or [f"ended with {done.returncode}"])[-1]
