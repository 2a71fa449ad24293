"""Pictures without any OpenGL: the bodies as shapes on their rails, seen from above, and the forces, by Pillow."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from controller.lti import Array
from models.scene import Scene
from sim.view.layout import (
    ALARM,
    COLUMNS,
    GREY,
    LONGEST,
    PLOT,
    SIZE,
    STEP,
    WORDS,
    Colour,
    channels,
    colour,
    envelope,
    places,
    scale,
)
from sim.view.overlay import overlay
from sim.view.session import HISTORY, Frame

BLACK, LIGHT = (0, 0, 0), (205, 205, 205)


class Flat:
    """Draws frames of a scene."""

    def __init__(self, scene: Scene, force_limit: Array) -> None:
        self.scene, self.force_limit = scene, force_limit
        self._font = ImageFont.load_default(12)
        self._places, self._channels = places(scene), channels(scene)

    def picture(self, frame: Frame) -> NDArray[np.uint8]:
        """(height, width, 3): what is said of the loop, the bodies, the forces, from top to bottom."""
        image = Image.new("RGB", SIZE, "white")
        pen = ImageDraw.Draw(image)
        height = SIZE[1]
        below = round((1 - PLOT) * height)
        top = 8
        for label, value in overlay(frame, live=False):
            pen.text((8, top), label, BLACK, self._font)
            pen.text((130, top), value, BLACK, self._font)
            top += 15
        self._bodies(pen, frame, max(top, round(WORDS * height)), below)
        self._forces(pen, frame, below + 18, height - 18)
        return np.asarray(image)

    def close(self) -> None:
        """Nothing is held."""

    def _bodies(self, pen: ImageDraw.ImageDraw, frame: Frame, top: int, bottom: int) -> None:
        steps = max(self._places) + 2
        per_metre = (SIZE[0] - 120) / (steps * STEP + 2 * LONGEST)
        origin, row = 60 + (LONGEST + STEP) * per_metre, (bottom - top) / self.scene.channels
        size = min(14.0, 0.3 * row)
        for i in range(self.scene.channels):
            y = top + (i + 0.5) * row
            pen.line((30, y, SIZE[0] - 30, y), LIGHT, 2)
        for place, i, q in zip(self._places, self._channels, frame.q, strict=True):
            x, y = origin + (place * STEP + q) * per_metre, top + (i + 0.5) * row
            corners = (x - size, y - size, x + size, y + size)
            if place == 0:
                pen.ellipse(corners, _rgb(colour(i)))
                self._force(pen, frame, i, x, y - 0.45 * row, per_metre)
            else:
                pen.rectangle(corners, _rgb(GREY))

    def _force(self, pen: ImageDraw.ImageDraw, frame: Frame, i: int, x: float, y: float, per_metre: float) -> None:
        """The range of the force since the last frame, and its mean; the device feels -f."""
        reach = per_metre * LONGEST / self.force_limit[i]
        clipped = max(-frame.low[i], frame.high[i]) >= self.force_limit[i]
        pen.line((x - frame.high[i] * reach, y, x - frame.low[i] * reach, y), _rgb(ALARM if clipped else colour(i)), 3)
        pen.line((x, y + 4, x - frame.mean[i] * reach, y + 4), _rgb(colour(i)), 4)
        if frame.push[i]:
            pen.line((x, y + 9, x + frame.push[i] * reach, y + 9), BLACK, 4)

    def _forces(self, pen: ImageDraw.ImageDraw, frame: Frame, top: int, bottom: int) -> None:
        """One plot per device, side by side."""
        m, most, middle = self.scene.channels, scale(frame.history), (top + bottom) / 2
        low, high = envelope(frame.history, COLUMNS, round(HISTORY / frame.setting.scenario.T))
        width = (SIZE[0] - 20) / m
        for i in range(m):
            left, right = 50 + i * width, (i + 1) * width - 2
            for value in (-most, 0.0, most):
                y = middle - value / most * (bottom - top) / 2
                pen.line((left, y, right, y), LIGHT)
                pen.text((left - 40, y - 7), f"{value:+g}" if value else "0", BLACK, self._font)
            pen.text((left, bottom + 2), f"force on device {i + 1} [N], last {HISTORY:g} s", BLACK, self._font)
            x = np.linspace(left, right, COLUMNS)
            for j in np.flatnonzero(np.isfinite(low[:, i])):
                ends = middle - np.array([low[j, i], high[j, i]]) / most * (bottom - top) / 2
                pen.line((x[j], ends[0], x[j], ends[1] - 1), _rgb(colour(i)), 2)


def _rgb(colour: Colour) -> tuple[int, int, int]:
    red, green, blue = (round(255 * part) for part in colour)
    return red, green, blue
