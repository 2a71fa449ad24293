"""Where things stand in a picture, with which colours and scales, whoever draws it."""

from __future__ import annotations

import numpy as np

from controller.lti import Array
from models.scene import Scene

Colour = tuple[float, float, float]

#: Okabe and Ito's palette, one colour per device
PALETTE: tuple[Colour, ...] = (
    (0.0, 0.45, 0.70),
    (0.84, 0.37, 0.0),
    (0.0, 0.62, 0.45),
    (0.8, 0.47, 0.65),
    (0.34, 0.71, 0.91),
    (0.9, 0.6, 0.0),
)
GREY: Colour = (0.55, 0.55, 0.58)
ALARM: Colour = (1.0, 0.15, 0.15)  # a force at its limit

APART = 0.11  # [m] between devices, across their motion
STEP = 0.09  # [m] between the bodies of one device at rest, along their motion
LONGEST = 0.12  # [m] arrow of a force at its limit
SIZE = (640, 640)  # pixels of a video
WORDS = 0.40  # share of a video's height, at its top, that is left to words
PLOT = 0.25  # share of the picture's height, at its bottom, that the forces take
COLUMNS = 250  # spans of the plotted forces, each with its least and largest


def colour(channel: int) -> Colour:
    """The colour of a device, counted from 0."""
    return PALETTE[channel % len(PALETTE)]


def channels(scene: Scene) -> tuple[int, ...]:
    """The channel (from 0) that each joint belongs to."""
    owner = {motor: motor for motor in range(scene.channels)}
    for i, masses in enumerate(scene.masses):
        owner |= dict.fromkeys(masses, i)
    return tuple(owner[joint] for joint in range(scene.model.njnt))


def places(scene: Scene) -> tuple[int, ...]:
    """How many steps behind its handle each joint's body stands: 0 the handle, -1 a motor, 1.. a human's arm."""
    owners = channels(scene)
    return tuple(scene.masses[i].index(j) if j in scene.masses[i] else -1 for j, i in enumerate(owners))


def scale(history: Array) -> float:
    """A power of two [N] above every force."""
    return float(2.0 ** np.ceil(np.log2(max(1.0, 1.05 * np.abs(history).max(initial=0.0)))))


def envelope(history: Array, columns: int, ticks: int) -> tuple[Array, Array]:
    """Least and largest force in `columns` equal spans of the last `ticks` ticks, (columns, m) each.

    Where the history is shorter than that, the spans before it are not-a-number.
    """
    padded = np.full((ticks, history.shape[1]), np.nan)
    recent = history[-ticks:]
    padded[ticks - len(recent) :] = recent
    first = np.linspace(0, ticks, columns, endpoint=False).astype(int)
    return np.fmin.reduceat(padded, first, axis=0), np.fmax.reduceat(padded, first, axis=0)
