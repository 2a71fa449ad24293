"""Pictures of frames, and films of them: by MuJoCo's renderer without a display, or flat without any OpenGL.

The renderer is EGL, or OSMesa in software. A film is a GIF by Pillow, or an MP4 by ffmpeg where that is installed.
"""

from __future__ import annotations

import importlib
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import BinaryIO

import mujoco
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from controller.lti import Array
from design.files import check_file, write
from models.scene import Scene
from sim.mujoco_gl import asked
from sim.scenario import InputError
from sim.view import stage as drawn
from sim.view.session import HISTORY, Frame

Picture = NDArray[np.uint8]  # (height, width, 3)

_FORMATS = (".gif", ".mp4")
_COLOURS = 48  # of a GIF: few, so that it stays small
_BACKENDS = ("egl", "osmesa")
_PATIENCE = 60  # [s] for a driver to say whether it works
_BLACK, _LIGHT = (0, 0, 0), (205, 205, 205)

_PROBE = "from mujoco.{} import GLContext; c = GLContext(8, 8); c.make_current(); c.free()"


def painter(draw: str, scene: Scene, force_limit: Array) -> tuple[Flat | _Offscreen, str, list[str]]:
    """The painter ("auto", "gl" or "flat"), its name, and the reason where OpenGL is not used.

    Raises InputError where it is not there and "gl" asks for it.
    """
    if draw == "flat":
        return Flat(scene, force_limit), draw, []
    try:
        name = backend()
    except _NoOffscreen as error:
        if draw == "gl":
            raise InputError(f"--draw gl: {error}") from None
        return Flat(scene, force_limit), "flat", [f"{error}: the bodies are drawn flat"]
    return _Offscreen(drawn.ShownScene(scene, force_limit), name), name, []


class _NoOffscreen(Exception):
    """There is no OpenGL without a display here; the message says what was tried."""


def backend() -> str:
    """The name of a way to render without a display: what MUJOCO_GL asks for if it is one, else the first that works.

    Each is tried in a process of its own, because a failed one leaves OpenGL unusable for the next.
    Raises _NoOffscreen.
    """
    tried = (asked(),) if asked() in _BACKENDS else _BACKENDS
    reasons = []
    for name in tried:
        reason = _failure(name)
        if reason is None:
            return name
        reasons.append(f"{name}: {reason}")
    raise _NoOffscreen(f"no OpenGL without a display here ({'; '.join(reasons)})")


class _Offscreen:
    """Renders frames of a stage."""

    def __init__(self, stage: drawn.ShownScene, name: str) -> None:
        """`name` is what backend() gave."""
        self.stage = stage
        width, height = drawn.SIZE
        self._gl = importlib.import_module(f"mujoco.{name}").GLContext(width, height)
        self._gl.make_current()
        self._context = mujoco.MjrContext(stage.model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._context)
        self._scene = mujoco.MjvScene(stage.model, 200)
        self._scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = 0
        self._scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = 0
        self._option, self._grip, self._camera = mujoco.MjvOption(), mujoco.MjvPerturb(), mujoco.MjvCamera()
        stage.aim(self._camera, (0.0, 0.0, 0.0), 1.3)

    def picture(self, frame: Frame) -> Picture:
        """(height, width, 3): what is said of the loop, the scene, the forces, from top to bottom."""
        stage, (width, height) = self.stage, drawn.SIZE
        stage.show(frame.q)
        seen = self._option, self._grip, self._camera, mujoco.mjtCatBit.mjCAT_ALL.value
        mujoco.mjv_updateScene(stage.model, stage.data, *seen, self._scene)
        stage.draw(self._scene, frame)
        below = round(drawn.PLOT * height)
        top = round(drawn.WORDS * height)
        mujoco.mjr_render(mujoco.MjrRect(0, below, width, height - below - top), self._scene, self._context)
        above = mujoco.MjrRect(0, height - top, width, top)
        mujoco.mjr_rectangle(above, 0.93, 0.93, 0.93, 1.0)
        font, corner = mujoco.mjtFont.mjFONT_NORMAL, mujoco.mjtGridPos.mjGRID_TOPLEFT
        mujoco.mjr_overlay(font, corner, above, *drawn.columns(drawn.overlay(frame, live=False)), self._context)
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
            timeout=_PATIENCE,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return f"no answer in {_PATIENCE} s"
    if done.returncode == 0:
        return None
    return (done.stderr.strip().splitlines() or [f"ended with {done.returncode}"])[-1]


# ----------------------------------------------------------------------------------------------------
# Flat pictures: the bodies as shapes on their rails, seen from above, and the forces, by Pillow.


class Flat:
    """Draws frames of a scene."""

    def __init__(self, scene: Scene, force_limit: Array) -> None:
        self.scene, self.force_limit = scene, force_limit
        self._font = ImageFont.load_default(12)
        self._places, self._channels = drawn.places(scene), drawn.channels(scene)

    def picture(self, frame: Frame) -> Picture:
        """(height, width, 3): what is said of the loop, the bodies, the forces, from top to bottom."""
        image = Image.new("RGB", drawn.SIZE, "white")
        pen = ImageDraw.Draw(image)
        height = drawn.SIZE[1]
        below = round((1 - drawn.PLOT) * height)
        top = 8
        for label, value in drawn.overlay(frame, live=False):
            pen.text((8, top), label, _BLACK, self._font)
            pen.text((130, top), value, _BLACK, self._font)
            top += 15
        self._bodies(pen, frame, max(top, round(drawn.WORDS * height)), below)
        self._forces(pen, frame, below + 18, height - 18)
        return np.asarray(image)

    def close(self) -> None:
        """Nothing to free."""

    def _bodies(self, pen: ImageDraw.ImageDraw, frame: Frame, top: int, bottom: int) -> None:
        steps = max(self._places) + 2
        per_metre = (drawn.SIZE[0] - 120) / (steps * drawn.STEP + 2 * drawn.LONGEST)
        origin, row = 60 + (drawn.LONGEST + drawn.STEP) * per_metre, (bottom - top) / self.scene.channels
        size = min(14.0, 0.3 * row)
        for i in range(self.scene.channels):
            y = top + (i + 0.5) * row
            pen.line((30, y, drawn.SIZE[0] - 30, y), _LIGHT, 2)
        for place, i, q in zip(self._places, self._channels, frame.q, strict=True):
            x, y = origin + (place * drawn.STEP + q) * per_metre, top + (i + 0.5) * row
            corners = (x - size, y - size, x + size, y + size)
            if place == 0:
                pen.ellipse(corners, _rgb(drawn.colour(i)))
                self._force(pen, frame, i, x, y - 0.45 * row, per_metre)
            else:
                pen.rectangle(corners, _rgb(drawn.GREY))

    def _force(self, pen: ImageDraw.ImageDraw, frame: Frame, i: int, x: float, y: float, per_metre: float) -> None:
        """The range of the force since the last frame, and its mean; the device feels -f."""
        reach = per_metre * drawn.LONGEST / self.force_limit[i]
        clipped = max(-frame.low[i], frame.high[i]) >= self.force_limit[i]
        shade = drawn.ALARM if clipped else drawn.colour(i)
        pen.line((x - frame.high[i] * reach, y, x - frame.low[i] * reach, y), _rgb(shade), 3)
        pen.line((x, y + 4, x - frame.mean[i] * reach, y + 4), _rgb(drawn.colour(i)), 4)
        if frame.push[i]:
            pen.line((x, y + 9, x + frame.push[i] * reach, y + 9), _BLACK, 4)

    def _forces(self, pen: ImageDraw.ImageDraw, frame: Frame, top: int, bottom: int) -> None:
        """One plot per device, side by side."""
        m, most, middle = self.scene.channels, drawn.scale(frame.history), (top + bottom) / 2
        low, high = drawn.envelope(frame.history, drawn.COLUMNS, round(HISTORY / frame.prepared.scenario.T))
        width = (drawn.SIZE[0] - 20) / m
        for i in range(m):
            left, right = 50 + i * width, (i + 1) * width - 2
            for value in (-most, 0.0, most):
                y = middle - value / most * (bottom - top) / 2
                pen.line((left, y, right, y), _LIGHT)
                pen.text((left - 40, y - 7), f"{value:+g}" if value else "0", _BLACK, self._font)
            pen.text((left, bottom + 2), f"force on device {i + 1} [N], last {HISTORY:g} s", _BLACK, self._font)
            x = np.linspace(left, right, drawn.COLUMNS)
            for j in np.flatnonzero(np.isfinite(low[:, i])):
                ends = middle - np.array([low[j, i], high[j, i]]) / most * (bottom - top) / 2
                pen.line((x[j], ends[0], x[j], ends[1] - 1), _rgb(drawn.colour(i)), 2)


def _rgb(parts: drawn.Colour) -> tuple[int, int, int]:
    red, green, blue = (round(255 * part) for part in parts)
    return red, green, blue


# ----------------------------------------------------------------------------------------------------
# Films.


def check_film(path: Path) -> None:
    """Whether such a film can be written, before any work is done. Raises InputError."""
    if path.suffix not in _FORMATS:
        raise InputError(f"--video {path}: the name must end in {' or '.join(_FORMATS)}")
    check_file("--video", path)
    if path.suffix == ".mp4" and shutil.which("ffmpeg") is None:
        raise InputError(f"--video {path}: MP4 needs ffmpeg, which is not on the PATH; a .gif needs nothing")


def save_film(path: Path, pictures: Iterable[Picture], fps: float) -> int:
    """Write the film and return its number of pictures. Raises InputError where ffmpeg refuses."""
    return _gif(path, pictures, fps) if path.suffix == ".gif" else _mp4(path, pictures, fps)


def _gif(path: Path, pictures: Iterable[Picture], fps: float) -> int:
    images: list[Image.Image] = []
    palette: Image.Image | None = None
    for picture in pictures:
        # one palette for all: colours do not flicker, and what stands still costs nothing
        palette = palette or _palette(picture)
        images.append(Image.fromarray(picture).quantize(palette=palette, dither=Image.Dither.NONE))

    def content(file: BinaryIO) -> None:
        images[0].save(file, "GIF", save_all=True, append_images=images[1:], duration=round(1000 / fps), loop=0)

    write(path, content)
    return len(images)


def _palette(first: Picture) -> Image.Image:
    """The colours of the first picture, and of what may appear later: forces, in light and in shade."""
    shades = [np.multiply(shade, light) for shade in (*drawn.PALETTE, drawn.ALARM) for light in (1.0, 0.75, 0.5)]
    strip = np.repeat(np.array(shades) * 255, -(-first.shape[1] // len(shades)), axis=0)[: first.shape[1]]
    later = np.repeat(strip[None].astype(np.uint8), first.shape[0] // 4, axis=0)
    return Image.fromarray(np.concatenate([first, later])).quantize(_COLOURS, dither=Image.Dither.NONE)


def _mp4(path: Path, pictures: Iterable[Picture], fps: float) -> int:
    """ffmpeg writes elsewhere; the film is put in its place when it is complete."""
    with tempfile.TemporaryDirectory() as folder:
        raw, whole, count = Path(folder) / "film.rgb", Path(folder) / "film.mp4", 0
        with raw.open("wb") as file:
            for picture in pictures:
                file.write(picture.tobytes())
                count += 1
        size = "{}x{}".format(*drawn.SIZE)
        source = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", size, "-r", f"{fps:g}", "-i", str(raw)]
        command = ["ffmpeg", "-loglevel", "error", "-y", *source, "-pix_fmt", "yuv420p", str(whole)]
        done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False)
        if done.returncode:
            raise InputError(f"--video {path}: ffmpeg: {done.stderr.strip() or done.returncode}")
        write(path, whole.read_bytes())
    return count
