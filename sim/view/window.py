"""MuJoCo's own viewer, passive: it shows what the session has made, and hands over keys and the mouse."""

from __future__ import annotations

import subprocess
import sys
import threading
import time
from collections.abc import Callable

import mujoco
from mujoco import viewer

from sim.view.events import KEYS
from sim.view.session import Frame, Grip, LiveLoop
from sim.view.stage import ShownScene, apart, columns, keys_help, overlay

_RATE = 60.0  # frames per second
_PATIENCE = 30  # [s] for the display to answer

# without a display the viewer's thread dies and its caller waits for ever: a process of its own asks first
_PROBE = (
    "import glfw, sys; glfw.init() or sys.exit(1); glfw.window_hint(glfw.VISIBLE, 0); "
    "sys.exit(0 if glfw.create_window(64, 64, '', None, None) else 1)"
)


class NoWindow(Exception):
    """The viewer cannot open a window here."""


def _display() -> bool:
    """Whether a window can be opened here."""
    try:
        done = subprocess.run([sys.executable, "-c", _PROBE], capture_output=True, timeout=_PATIENCE, check=False)
    except subprocess.TimeoutExpired:
        return False
    return done.returncode == 0


def show(session: LiveLoop, stage: ShownScene, until: float | None = None) -> None:
    """Run the session in a window until that is closed, or until it is `until` [s] old.

    Raises NoWindow where there is no display, or on macOS without MuJoCo's own launcher.
    """
    if not _display():
        raise NoWindow("no window can be opened: there is no display, or none with OpenGL")
    threads = set(threading.enumerate())
    try:
        window = viewer.launch_passive(
            stage.model, stage.data, key_callback=_typed(session), show_left_ui=False, show_right_ui=False
        )
    except RuntimeError as error:
        raise NoWindow(str(error)) from None
    try:
        with window:
            with window.lock():
                stage.aim(window.cam, (0.0, 0.0, 0.2), 3.0)  # between the words and the plots
            loop(session, stage, window, time.perf_counter, time.sleep, until)
    finally:  # the viewer must have left OpenGL before Python ends
        for thread in set(threading.enumerate()) - threads:
            thread.join(_PATIENCE)


def loop(
    session: LiveLoop,
    stage: ShownScene,
    window: viewer.Handle,
    clock: Callable[[], float],
    sleep: Callable[[float], None],
    until: float | None = None,
) -> None:
    """Frame after frame: the mouse to the session, the session to the window."""
    start = clock()
    grip = None
    while window.is_running():
        begun = clock()
        grip = _shown(stage, window, session.frame(begun - start, grip))
        if until is not None and begun - start >= until:
            return
        sleep(max(0.0, 1 / _RATE - (clock() - begun)))


def _shown(stage: ShownScene, window: viewer.Handle, frame: Frame) -> Grip | None:
    """Show a frame, and return what the mouse holds afterwards."""
    with window.lock():
        stage.show(frame.q)
        grip = stage.grip(window.perturb)
        if window.user_scn is not None:
            window.user_scn.ngeom = 0
            stage.draw(window.user_scn, frame)
    window.sync()
    (said, refused), keys = apart(overlay(frame, live=True)), keys_help(frame.prepared.menu.given is not None)
    font, grid = mujoco.mjtFontScale.mjFONTSCALE_150, mujoco.mjtGridPos
    places = {grid.mjGRID_TOPLEFT: said, grid.mjGRID_TOPRIGHT: keys, grid.mjGRID_BOTTOMLEFT: refused}
    window.set_texts([(font, place, *columns(lines)) for place, lines in places.items() if lines])
    if window.viewport is not None:
        window.set_figures(stage.figures(frame, window.viewport))
    return grip


def _typed(session: LiveLoop) -> Callable[[int], None]:
    """The viewer's callback for a key, in the viewer's own thread."""

    def key(code: int) -> None:
        if code in KEYS:
            session.keys.put(KEYS[code][1])

    return key
