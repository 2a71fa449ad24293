"""Pictures of the window and of films: positions, colours, text, arrows and plots.

The window is MuJoCo's passive viewer, which shows the frames of a session and passes keys and mouse to the session. The
window shows a copy of a world's scene, or a copy of the devices' scene with other shapes. These shapes have no mass and
collide with nothing, so that the copy has the matrices of the simulated scene. Pillow draws the pictures of a film, in
which MuJoCo renders the scene of a world. Pillow writes a GIF, and ffmpeg an MP4.
"""

from __future__ import annotations

import copy
import subprocess
import sys
import tempfile
import textwrap
import threading
import time
from collections.abc import Callable, Iterable
from importlib import import_module
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import mujoco
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from haptic_loop.controller.lti import Array
from haptic_loop.controller.units import PositionUnit, in_unit
from haptic_loop.design.files import InputError, write
from haptic_loop.design.result import Requirement
from haptic_loop.models.scene import APART, DRAWN, STEP, Scene
from haptic_loop.sim.view.drawn_object import SPRING, DrawnObject, object_of
from haptic_loop.sim.view.session import HISTORY, KEYS, Frame, Grip, LiveLoop, PreparedLoop, keys_help
from haptic_loop.sim.world import WorldFigures

if TYPE_CHECKING:
    from mujoco import viewer

    from haptic_loop.models.world import World

Picture = NDArray[np.uint8]  # (height, width, 3)
_Colour = tuple[float, float, float]
_Lines = list[tuple[str, str]]

#: Okabe and Ito's palette, one colour per device
_PALETTE: tuple[_Colour, ...] = (
    (0.0, 0.45, 0.70),
    (0.84, 0.37, 0.0),
    (0.0, 0.62, 0.45),
    (0.8, 0.47, 0.65),
    (0.34, 0.71, 0.91),
    (0.9, 0.6, 0.0),
)
_GREY: _Colour = (0.55, 0.55, 0.58)
_ALARM: _Colour = (1.0, 0.15, 0.15)  # a force at its limit

_LONGEST = 0.12  # [m] length of the arrow of a force at its limit, except in a world
_SIZE = (640, 640)  # pixels of a video
_WORDS = 0.40  # least share of a video's height for the text at the top, except in a world
_PLOT = 0.25  # share of the picture's height for the forces at the bottom
_WIDTH = 60  # characters in a line of the note on the last event
_COLUMNS = 250  # number of time spans in a plot of forces; each has a line from its least to its largest force

_BOX, _SPHERE, _ARROW, _BAR = (
    getattr(mujoco.mjtGeom, f"mjGEOM_{name}") for name in ("BOX", "SPHERE", "ARROW", "CAPSULE")
)
_MASSLESS = {"mass": 0, "contype": 0, "conaffinity": 0}


def _colour(channel: int) -> _Colour:
    """Return the colour of a device, counted from 0."""
    return _PALETTE[channel % len(_PALETTE)]


def _channels(scene: Scene) -> list[list[int]]:
    """Return the channels of each device."""
    return [[k for k, of in enumerate(scene.devices) if of == device] for device in range(1 + max(scene.devices))]


def _owners(scene: Scene) -> tuple[int, ...]:
    """Return the device (from 0) of each joint; for a person's body, the first device that the person holds."""
    owner, devices = dict(enumerate(scene.devices)), len(_channels(scene))
    for i, points in enumerate(scene.points[:devices]):
        owner |= dict.fromkeys(points, i)
    for points in scene.points[devices:]:
        owner |= {joint: owner[points[0]] for joint in points if joint not in owner}
    return tuple(owner[joint] for joint in range(scene.model.njnt))


def _places(scene: Scene) -> tuple[int, ...]:
    """Return the place of each joint's body in units of STEP: -1 for a motor, 0 for a handle, then arm and body."""
    place = dict.fromkeys(range(scene.channels), -1)
    for own, points in zip(_channels(scene), scene.points, strict=False):
        place |= {joint: k // len(own) for k, joint in enumerate(points)}
    behind = 1 + max(place.values())
    return tuple(place.get(joint, behind) for joint in range(scene.model.njnt))


def _scale(history: Array, limit: Array) -> float:
    """Return a power of two [N] above every force and above the lesser of 1 N and 1/16 of the largest limit."""
    least = min(1.0, float(np.max(limit)) / 16)
    return float(2.0 ** np.ceil(np.log2(max(least, 1.05 * np.abs(history).max(initial=0.0)))))


def _envelope(history: Array, columns: int, ticks: int) -> tuple[Array, Array]:
    """Return least and largest forces (columns, m) in `columns` equal spans of the last `ticks` ticks.

    Spans before the beginning of a shorter history are nan.
    """
    padded = np.full((ticks, history.shape[1]), np.nan)
    recent = history[-ticks:]
    padded[ticks - len(recent) :] = recent
    first = np.linspace(0, ticks, columns, endpoint=False).astype(int)
    return np.fmin.reduceat(padded, first, axis=0), np.fmax.reduceat(padded, first, axis=0)


def _overlay(frame: Frame, live: bool) -> _Lines:
    """Return labels and values of the overlay; `live` adds the clock, which a film does not have."""
    prepared, scenario = frame.prepared, frame.prepared.scenario
    delays = f"theta {_list(scenario.theta)}, psi {_list(scenario.psi)} samples of {1e3 * scenario.T:g} ms"
    mode, needs = prepared.mode, prepared.assessment.requirements
    lines = [
        ("coupling", prepared.label),
        ("delays", delays),
        *([("growth", f"{mode.growth:+.3g} 1/s at {mode.frequency_hz:.1f} Hz: {mode.verdict}")] if mode else []),
        *((name.replace("-", " "), _needs(need)) for name, need in needs.items() if mode or not need.reason),
        *([_account(frame.world, prepared)] if frame.world else [("force limits", _limited(prepared))]),
        ("largest force", f"{np.abs(frame.history).max():.2f} N in {HISTORY:g} s, {frame.clipped} ticks at the limit"),
    ]
    if np.any(frame.push):
        lines.append(("push", f"{', '.join(f'{p:+.2f}' for p in frame.push)} N"))
    clock = f"{frame.t:.1f} s"
    lines.append(("time", clock if not live else f"{clock}, real time x {frame.factor:.2f}"))
    if live:
        lines.append(("clock", f"{frame.overruns} overruns, {frame.lost:.2f} s lost"))
    if frame.note:
        first, *rest = textwrap.wrap(frame.note, _WIDTH)
        lines += [("last", first), *(("", line) for line in rest)]
    return [(label, in_unit(value, scenario.unit)) for label, value in lines]


def _limited(prepared: PreparedLoop) -> str:
    """Return in words whether a guarantee also holds while forces are at their limits."""
    assessment = prepared.assessment
    if assessment.guarantee is None:
        return "no guarantee"
    return "clipped: not covered" if assessment.force_limits.rho is None else "limited: the guarantee still holds"


def _account(figures: WorldFigures, prepared: PreparedLoop) -> tuple[str, str]:
    """Return the row of the energy shell of a world: its label, and its figures in words."""
    W0, given_mJ, released = (1e3 * joules for joules in (figures.start_J, figures.given_J, figures.released_J))
    most = (
        f"devices got {given_mJ:.2f} of at most {W0:g} (W0) + {released:.1f} (released) mJ"
        if prepared.assessment.guarantee
        else "no guarantee"
    )
    return "energy shell", f"acted on {figures.limited_ticks} of {figures.ticks} ticks, {most}"


def _needs(requirement: Requirement) -> str:
    """Return in words the required and the available damping of the worst channel, and whether that is certified."""
    if not np.isfinite(requirement.ratio):
        return "no certificate"
    worst = int(np.argmax(np.divide(requirement.required, requirement.available)))
    need, have = requirement.required[worst], requirement.available[worst]
    return f"needs {need:.3f} of {have:g} N s/m: {'certified' if requirement.certified else 'NOT certified'}"


def _apart(lines: _Lines) -> tuple[_Lines, _Lines]:
    """Return the lines in two parts; the second part is the note on the last event if it takes several lines."""
    at = next((i for i, (label, _) in enumerate(lines) if label == "last"), len(lines))
    return (lines[:at], lines[at:]) if len(lines) - at > 1 else (lines, [])


def _columns(lines: _Lines) -> tuple[str, str]:
    """Return labels and values as two texts, as MuJoCo's overlays expect them."""
    return "\n".join(label for label, _ in lines), "\n".join(value for _, value in lines)


def _list(values: tuple[int, ...]) -> str:
    return ", ".join(map(str, values))


class _ShownScene:
    """The picture of devices and object, with handles that the mouse can hold."""

    def __init__(self, scene: Scene, force_limit: Array, drawn: DrawnObject | None = None) -> None:
        self.scene, self.force_limit, self.object = scene, force_limit, drawn
        self.model = _dressed(scene)
        self.data = mujoco.MjData(self.model)
        self.device = _owners(scene)  # joint -> device
        self._channels = _channels(scene)

    def show(self, frame: Frame) -> None:
        """Set the joints to the positions of a frame."""
        self.data.qpos[:] = frame.q
        self.data.qvel[:] = 0.0
        mujoco.mj_forward(self.model, self.data)

    def grip(self, perturb: mujoco.MjvPerturb) -> Grip | None:
        """Return the grip of the mouse on the handle of the clicked device, or None."""
        joint = int(self.model.body_jntadr[perturb.select]) if perturb.select > 0 else -1
        if joint < 0 or not (perturb.active | perturb.active2) & int(mujoco.mjtPertBit.mjPERT_TRANSLATE):
            return None
        channels = self._channels[self.device[joint]]
        handles = np.array(self.scene.handles)[channels]
        turn = self.data.xmat[perturb.select].reshape(3, 3)
        held_at = self.data.xpos[perturb.select] + turn @ perturb.localpos
        drawn = self.model.jnt_axis[handles] @ (perturb.refselpos - held_at)
        return Grip(channels[0], tuple((self.data.qpos[handles] + drawn).tolist()))

    def draw(self, drawn: mujoco.MjvScene, frame: Frame) -> None:
        """Draw the object, and for each device the mean and the range of its force since the last frame, and pushes."""
        for shape in self.object.shapes(frame.nodes) if self.object else ():
            if shape.kind == "spring":
                _connect(drawn, _BAR, SPRING, shape.at, shape.to, shape.rgba)
            else:
                kind = _BOX if shape.kind in ("mass", "wall") else _SPHERE
                _solid(drawn, kind, shape.size, shape.at, shape.quat, shape.rgba)
        for device, channels in enumerate(self._channels):
            own = _colour(device)
            handles = np.array(self.scene.handles)[channels]
            axes, reach = self.model.jnt_axis[handles], _LONGEST / self.force_limit[channels]
            at = self.data.xpos[self.model.jnt_bodyid[handles[0]]] + np.array([0, 0, 0.045])
            for axis, low, high, each, over in zip(
                axes, frame.low[channels], frame.high[channels], reach, frame.at_limit[channels], strict=True
            ):
                band = (*_ALARM, 0.6) if over else (*own, 0.35)
                _connect(drawn, _BAR, 0.010, at - high * each * axis, at - low * each * axis, band)
            _arrow(drawn, at, -(frame.mean[channels] * reach) @ axes, (*own, 1.0))
            pushed = np.clip(frame.push[channels] * reach, -_LONGEST, _LONGEST) @ axes
            _arrow(drawn, at + np.array([0, 0, 0.03]), pushed, (0.1, 0.1, 0.1, 1.0))

    def figures(self, frame: Frame, picture: mujoco.MjrRect) -> list[tuple[mujoco.MjrRect, mujoco.MjvFigure]]:
        """Return plots of each device's forces in the last seconds, side by side at the bottom of a picture."""
        width, height = picture.width // len(self._channels), round(_PLOT * picture.height)
        low, high = _envelope(frame.history, _COLUMNS, round(HISTORY / frame.prepared.scenario.T))
        top, drawn = _scale(frame.history, self.force_limit), []
        for i, own in enumerate(self._channels):
            place = mujoco.MjrRect(picture.left + i * width, picture.bottom, width, height)
            drawn.append((place, _figure(i, low[:, own], high[:, own], top, frame.prepared.scenario.unit)))
        return drawn

    def aim(self, camera: mujoco.MjvCamera) -> None:
        """Aim the camera from above at the devices, between the text and the plots."""
        behind = (self.object.reach - STEP) / 2 if self.object else 0.0  # [m] shift of the aim towards the object
        camera.lookat[:] = self.model.stat.center + self.model.stat.extent * np.array((0.0, 0.0, 0.2))
        camera.lookat[0] -= behind
        camera.distance = 3.0 * (self.model.stat.extent + behind / 2)
        camera.azimuth, camera.elevation = 90.0, -35.0


class _ShownWorld(_ShownScene):
    """The MuJoCo scene of a world in a picture, with each device as a stylus whose tip is the device's position."""

    def __init__(self, world: World, force_limit: Array) -> None:
        self.force_limit = force_limit
        self.model = copy.deepcopy(world.model)  # The loop changes its own model while a window draws.
        self.model.vis.global_.offwidth, self.model.vis.global_.offheight = _SIZE
        self.data = mujoco.MjData(self.model)
        mujoco.mj_forward(self.model, self.data)
        self._bodies = [self.model.body(contact.body).id for contact in world.contacts]
        self._rest = [self.data.xpos[body].copy() for body in self._bodies]
        self._along = [np.array(contact.along) for contact in world.contacts]  # (axes, 3) each
        self._x = [np.zeros(len(along)) for along in self._along]
        ends = np.cumsum([0, *map(len, self._along)]).tolist()
        self._channels = [list(range(first, last)) for first, last in pairwise(ends)]
        self.model.vis.headlight.ambient[:], self.model.vis.headlight.diffuse[:] = 0.45, 0.5
        away = [rest - self.model.stat.center + (0.0, 0.0, 0.2 * self.model.stat.extent) for rest in self._rest]
        length = 0.45 * self.model.stat.extent
        self._stylus = [length * one / max(float(np.linalg.norm(one)), 1e-9) for one in away]  # [m], tip to handle

    def show(self, frame: Frame) -> None:
        """Set the bodies to the pose of a frame."""
        assert frame.pose is not None
        self.data.qpos[:] = frame.pose
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)
        mujoco.mj_camlight(self.model, self.data)
        self._x = self._by_device(frame.q)

    def _by_device(self, values: Array) -> list[Array]:
        return [values[own] for own in self._channels]

    def grip(self, perturb: mujoco.MjvPerturb) -> Grip | None:
        """Return the grip of the mouse on a contact, in the directions in which the contact slides."""
        held = int(perturb.active | perturb.active2) & int(mujoco.mjtPertBit.mjPERT_TRANSLATE)
        if perturb.select not in self._bodies or not held:
            return None
        i = self._bodies.index(perturb.select)
        drawn = np.array(perturb.refselpos) - self._rest[i]
        return Grip(self._channels[i][0], tuple((self._along[i] @ drawn).tolist()))

    def draw(self, drawn: mujoco.MjvScene, frame: Frame) -> None:
        """Draw a stylus for each device, and arrows at its handle for its force and for pushes."""
        size = 0.045 * self.model.stat.extent
        forces, pushes = self._by_device(frame.mean), self._by_device(frame.push)
        for i, (along, x) in enumerate(zip(self._along, self._x, strict=True)):
            own, tip = _colour(i), self._rest[i] + x @ along
            at, reach = tip + self._stylus[i], 25 * size / float(np.min(self.force_limit))
            _connect(drawn, _BAR, size / 5, tip, at, (*_GREY, 1.0))
            _solid(drawn, _SPHERE, np.full(3, size), at, np.array([1.0, 0.0, 0.0, 0.0]), (*own, 1.0))
            _connect(drawn, _ARROW, size / 3, at, at - reach * forces[i] @ along, (*own, 1.0))
            _connect(drawn, _ARROW, size / 4, at, at + reach * pushes[i] @ along, (0.1, 0.1, 0.1, 1.0))

    def aim(self, camera: mujoco.MjvCamera) -> None:
        """Aim as the scene's own camera does, or from the front and somewhat above if it has none."""
        mujoco.mjv_defaultFreeCamera(self.model, camera)
        if self.model.ncam:
            camera.type, camera.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, 0
        else:
            camera.azimuth, camera.elevation, camera.distance = 110.0, -20.0, 2.8 * self.model.stat.extent


def stage_for(session: LiveLoop) -> _ShownScene:
    """Return the drawn scene of a session: its MuJoCo world, or its devices with the simulated object."""
    simulation = session.prepared.simulation
    if session.world:
        return _ShownWorld(session.world.ports[0].world, simulation.process.force_limit)
    return _ShownScene(simulation.scene, simulation.process.force_limit, drawn=object_of(simulation))


def _dressed(scene: Scene) -> mujoco.MjModel:
    """Return the scene's model with the shapes, positions and colours for drawing; its dynamics are unchanged."""
    spec = mujoco.MjSpec.from_string(scene.xml)
    _undress(spec)
    spec.visual.global_.offwidth, spec.visual.global_.offheight = _SIZE
    spec.visual.headlight.ambient = [0.5, 0.5, 0.5]
    where = _places(scene)
    seen = set[int]()
    for joint, (place, device) in enumerate(zip(where, _owners(scene), strict=True)):
        number = int(scene.model.jnt_bodyid[joint])
        if number in seen:  # An earlier joint has the same body.
            continue
        seen.add(number)
        body = spec.body(scene.model.body(number).name)
        body.pos = [place * STEP, device * -APART, 0.03]
        if body.frame:  # The frame of an attached device would shift the body.
            body.frame.pos = [0.0, 0.0, 0.0]
        if place == 0:
            body.add_geom(type=_SPHERE, size=[0.024] * 3, rgba=(*_colour(device), 1.0), **_MASSLESS)
        else:
            body.add_geom(type=_BOX, size=[0.022, 0.026, 0.022], rgba=(*_GREY, 1.0), **_MASSLESS)
    deepest, channels = max(1, *where), _channels(scene)
    middle = [(deepest - 1) * STEP / 2, -APART * (len(channels) - 1) / 2, 0.03]
    for device, own in enumerate(channels):
        if len(own) > 1:  # A device with several axes needs no rail.
            continue
        at, rail = [middle[0], -APART * device, 0.0], [0.5 * STEP * (deepest + 1) + 0.06, 0.012, 0.004]
        spec.worldbody.add_geom(type=_BOX, pos=at, size=rail, rgba=[0.8, 0.8, 0.8, 1], **_MASSLESS)
    spec.stat.center = middle
    spec.stat.extent = 0.24 + 0.5 * STEP * deepest + 0.5 * APART * (len(channels) - 1)
    return spec.compile()


def _undress(spec: mujoco.MjSpec) -> None:
    """Delete the shapes of the scene's file, because the window draws other shapes and colours."""
    drawn = [tendon for tendon in spec.tendons if tendon.name.endswith(DRAWN)]
    for part in [*drawn, *spec.geoms, *spec.sites]:
        spec.delete(part)


def _figure(device: int, low: Array, high: Array, top: float, unit: PositionUnit) -> mujoco.MjvFigure:
    """Return a figure of one device's least and largest forces (spans, axes) [N] in every time span."""
    figure = mujoco.MjvFigure()
    mujoco.mjv_defaultFigure(figure)
    figure.title, figure.xlabel = in_unit(f"force on device {device + 1} [N]", unit), "time [s]"
    figure.flg_extend, figure.flg_legend = 0, 0
    figure.gridsize = [5, 5]
    figure.figurergba[:] = (1, 1, 1, 1)
    figure.panergba[:] = (1, 1, 1, 1)
    figure.textrgb[:] = (0, 0, 0)
    figure.gridrgb[:] = (0.75, 0.75, 0.75)
    figure.range[:] = ((-HISTORY, 0.0), (-top, top))
    t = np.linspace(-HISTORY, 0.0, len(low))
    for k, (least, most) in enumerate(zip(low.T, high.T, strict=True)):
        points = np.stack([t, least, t, most], axis=1)[np.isfinite(least)].reshape(-1)
        figure.linedata[k, : points.size] = points
        figure.linepnt[k] = points.size // 2
        figure.linergb[k] = _shade(device, k)
    return figure


def _shade(device: int, axis: int) -> _Colour:
    """Return the colour of an axis of a device; each further axis is darker."""
    red, green, blue = _colour(device)
    return red * 0.6**axis, green * 0.6**axis, blue * 0.6**axis


def _arrow(drawn: mujoco.MjvScene, at: Array, way: Array, rgba: tuple[float, ...]) -> None:
    if np.abs(way).max() > 1e-4:
        _connect(drawn, _ARROW, 0.005, at, at + way, rgba)


def _solid(
    drawn: mujoco.MjvScene, kind: mujoco.mjtGeom, size: Any, at: Any, quat: Any, rgba: tuple[float, ...]
) -> None:
    if drawn.ngeom < drawn.maxgeom:
        turn, geom = np.zeros(9), drawn.geoms[drawn.ngeom]
        mujoco.mju_quat2Mat(turn, quat)
        mujoco.mjv_initGeom(geom, kind, np.array(size), np.array(at, float), turn, np.array(rgba, dtype=np.float32))
        drawn.ngeom += 1


def _connect(
    drawn: mujoco.MjvScene, shape: mujoco.mjtGeom, width: float, a: Array, b: Array, rgba: tuple[float, ...]
) -> None:
    if drawn.ngeom >= drawn.maxgeom or not np.any(a != b):
        return
    geom = drawn.geoms[drawn.ngeom]
    mujoco.mjv_initGeom(geom, shape, np.zeros(3), np.zeros(3), np.zeros(9), np.array(rgba, dtype=np.float32))
    mujoco.mjv_connector(geom, shape, width, np.asarray(a, dtype=float), np.asarray(b, dtype=float))
    drawn.ngeom += 1


# ----------------------------------------------------------------------------------------------------
# The window.

_RATE = 60.0  # frames per second
_PATIENCE = 30  # [s] time for the display to answer

# Without a display the viewer's thread ends and its caller waits forever. So another process first tries to open a
# window.
_PROBE = (
    "import glfw, sys; glfw.init() or sys.exit(1); glfw.window_hint(glfw.VISIBLE, 0); "
    "sys.exit(0 if glfw.create_window(64, 64, '', None, None) else 1)"
)


def _display() -> bool:
    """Return whether a window can be opened here."""
    try:
        probe = subprocess.run([sys.executable, "-c", _PROBE], capture_output=True, timeout=_PATIENCE, check=False)
    except subprocess.TimeoutExpired:
        return False
    return probe.returncode == 0


def show(session: LiveLoop, stage: _ShownScene, until: float | None = None) -> None:
    """Run the session in a window until the window is closed, or for `until` [s].

    Raises InputError without a display, and on macOS without MuJoCo's own launcher.
    """
    instead = "--video FILE.gif needs no window"
    if not _display():
        raise InputError(f"no window can be opened: there is no display, or none with OpenGL; {instead}")
    threads = set(threading.enumerate())
    try:
        from mujoco import viewer  # imports GLFW, which only a window needs

        window = viewer.launch_passive(
            stage.model, stage.data, key_callback=_typed(session), show_left_ui=False, show_right_ui=False
        )
    except RuntimeError as error:
        raise InputError(f"{error}; {instead}") from None
    try:
        with window:
            with window.lock():
                stage.aim(window.cam)
            _loop(session, stage, window, time.perf_counter, time.sleep, until)
    finally:  # The viewer's threads must release OpenGL before Python ends.
        for thread in set(threading.enumerate()) - threads:
            thread.join(_PATIENCE)


def _loop(
    session: LiveLoop,
    stage: _ShownScene,
    window: viewer.Handle,
    clock: Callable[[], float],
    sleep: Callable[[float], None],
    until: float | None = None,
) -> None:
    """Show frame after frame, and pass the grip of the mouse to the session."""
    start = clock()
    grip = None
    while window.is_running():
        begun = clock()
        grip = _shown(stage, window, session.frame(begun - start, grip))
        if until is not None and begun - start >= until:
            return
        sleep(max(0.0, 1 / _RATE - (clock() - begun)))


def _shown(stage: _ShownScene, window: viewer.Handle, frame: Frame) -> Grip | None:
    """Show a frame, and return the grip of the mouse afterwards."""
    with window.lock():
        stage.show(frame)
        grip = stage.grip(window.perturb)
        if window.user_scn is not None:
            window.user_scn.ngeom = 0
            stage.draw(window.user_scn, frame)
    window.sync()
    (said, refused), keys = _apart(_overlay(frame, live=True)), keys_help(frame.prepared.menu.given is not None)
    font, grid = mujoco.mjtFontScale.mjFONTSCALE_150, mujoco.mjtGridPos
    places = {grid.mjGRID_TOPLEFT: said, grid.mjGRID_TOPRIGHT: keys, grid.mjGRID_BOTTOMLEFT: refused}
    window.set_texts([(font, place, *_columns(lines)) for place, lines in places.items() if lines])
    if window.viewport is not None:
        window.set_figures(stage.figures(frame, window.viewport))
    return grip


def _typed(session: LiveLoop) -> Callable[[int], None]:
    """Return the viewer's callback for a key, which runs in the viewer's own thread."""

    def key(code: int) -> None:
        if code in KEYS:
            session.keys.put(KEYS[code][1])

    return key


# ----------------------------------------------------------------------------------------------------
# Films: their pictures, and the file.

_COLOURS = 48  # number of colours in a GIF, which keeps the file small
_BLACK, _LIGHT = (0, 0, 0), (205, 205, 205)


class _FlatPictures:
    """Pictures of a film by Pillow: the scene from above (a body grows with its height z), and the forces."""

    def __init__(self, scene: Scene, force_limit: Array, drawn: DrawnObject | None = None) -> None:
        self.scene, self.force_limit, self.object = scene, force_limit, drawn
        self._channels, self._font = _channels(scene), ImageFont.load_default(12)
        places, owners, first = _places(scene), _owners(scene), dict[int, int]()
        for joint, body in enumerate(scene.model.jnt_bodyid.tolist()):
            first.setdefault(body, joint)
        #: (number, place in units of STEP, device) of each body, in the order of the bodies' first joints
        self._shapes = [(body, places[joint], owners[joint]) for body, joint in first.items()]

    def picture(self, frame: Frame) -> Picture:
        """Return the picture (height, width, 3) of a frame: text, bodies and forces from top to bottom."""
        image = Image.new("RGB", _SIZE, "white")
        pen = ImageDraw.Draw(image)
        height = _SIZE[1]
        below = round((1 - _PLOT) * height)
        top = 8
        for label, value in _overlay(frame, live=False):
            pen.text((8, top), label, _BLACK, self._font)
            pen.text((130, top), value, _BLACK, self._font)
            top += 15
        self._scene(image, frame, top, below)
        self._forces(pen, frame, below + 18, height - 18)
        return np.asarray(image)

    def close(self) -> None:
        """Free the renderer, if there is one."""

    def _scene(self, image: Image.Image, frame: Frame, top: int, bottom: int) -> None:
        """Draw bodies, object and forces between two rows of pixels, but not in the share _WORDS at the top."""
        pen, top = ImageDraw.Draw(image), max(top, round(_WORDS * image.height))
        steps, behind = max(place for _, place, _ in self._shapes) + 1, self.object.reach if self.object else 0.0
        left = max(_LONGEST + STEP, behind)  # [m] width of the picture to the left of the handles
        per_metre = (_SIZE[0] - 120) / (left + steps * STEP + _LONGEST)
        origin, row = 60 + left * per_metre, (bottom - top) / len(self._channels)
        usual = min(14.0, 0.3 * row)
        self._object(pen, frame, origin, per_metre, top, row)
        for i, own in enumerate(self._channels):
            y = top + (i + 0.5) * row
            if len(own) == 1:
                pen.line((origin - (STEP + _LONGEST / 2) * per_metre, y, _SIZE[0] - 30, y), _LIGHT, 2)
        model = self.scene.model
        for body, place, i in self._shapes:
            moved = frame.q[model.jnt_bodyid == body] @ model.jnt_axis[model.jnt_bodyid == body]
            x, y = origin + (place * STEP + moved[0]) * per_metre, top + (i + 0.5) * row - moved[1] * per_metre
            size = usual * min(2.0, max(0.5, 1 + moved[2] / STEP))
            corners = (x - size, y - size, x + size, y + size)
            if place == 0:
                pen.ellipse(corners, _rgb(_colour(i)))
                self._force(pen, frame, i, x, y - 0.45 * row, per_metre)
            else:
                pen.rectangle(corners, _rgb(_GREY))

    def _object(
        self, pen: ImageDraw.ImageDraw, frame: Frame, origin: float, per_metre: float, top: float, row: float
    ) -> None:
        """Draw the virtual object from above; motion along z is not shown."""

        def place(at: Array) -> tuple[float, float]:
            return origin + at[0] * per_metre, top + (0.5 - at[1] / APART) * row

        for shape in self.object.shapes(frame.nodes) if self.object else ():
            (x, y), colour = place(shape.at), _rgb(shape.rgba[:3])
            if shape.kind == "spring":
                pen.line((x, y, *place(shape.to)), colour, 2)
            elif shape.kind == "wall":
                along = 0.25 * row * np.array([-shape.to[1], -shape.to[0]])
                pen.line((x - along[0], y - along[1], x + along[0], y + along[1]), colour, 4)
            else:
                size = 0.7 * shape.size[0] * per_metre
                corners = (x - size, y - size, x + size, y + size)
                (pen.rectangle if shape.kind == "mass" else pen.ellipse)(corners, colour)

    def _force(self, pen: ImageDraw.ImageDraw, frame: Frame, device: int, x: float, y: float, per_metre: float) -> None:
        """Draw range and mean of the force -f since the last frame, and the push; with several axes only the mean."""
        channels = self._channels[device]
        if len(channels) > 1:
            joints = np.array(self.scene.handles)[channels]
            reach = per_metre * _LONGEST / self.force_limit[channels]
            dx, dy, _ = -(frame.mean[channels] * reach) @ self.scene.model.jnt_axis[joints]
            pen.line((x, y, x + dx, y - dy), _rgb(_colour(device)), 4)
            return
        (i,) = channels
        reach = per_metre * _LONGEST / self.force_limit[i]
        shade = _ALARM if frame.at_limit[i] else _colour(device)
        pen.line((x - frame.high[i] * reach, y, x - frame.low[i] * reach, y), _rgb(shade), 3)
        pen.line((x, y + 4, x - frame.mean[i] * reach, y + 4), _rgb(_colour(device)), 4)
        if frame.push[i]:
            pen.line((x, y + 9, x + frame.push[i] * reach, y + 9), _BLACK, 4)

    def _forces(self, pen: ImageDraw.ImageDraw, frame: Frame, top: int, bottom: int) -> None:
        """Draw one plot for each device, side by side."""
        most, middle = _scale(frame.history, self.force_limit), (top + bottom) / 2
        low, high = _envelope(frame.history, _COLUMNS, round(HISTORY / frame.prepared.scenario.T))
        width = (_SIZE[0] - 20) / len(self._channels)
        for i, channels in enumerate(self._channels):
            left, right = 50 + i * width, (i + 1) * width - 2
            for value in (-most, 0.0, most):
                y = middle - value / most * (bottom - top) / 2
                pen.line((left, y, right, y), _LIGHT)
                pen.text((left - 40, y - 7), f"{value:+g}" if value else "0", _BLACK, self._font)
            label = in_unit(f"force on device {i + 1} [N], last {HISTORY:g} s", frame.prepared.scenario.unit)
            pen.text((left, bottom + 2), label, _BLACK, self._font)
            x = np.linspace(left, right, _COLUMNS)
            for axis, channel in enumerate(channels):
                for j in np.flatnonzero(np.isfinite(low[:, channel])):
                    ends = middle - np.array([low[j, channel], high[j, channel]]) / most * (bottom - top) / 2
                    pen.line((x[j], ends[0], x[j], ends[1] - 1), _rgb(_shade(i, axis)), 2)


class _WorldPictures(_FlatPictures):
    """Pictures of a film of a world: scene and devices, rendered without a display, and plots of the forces."""

    def __init__(self, stage: _ShownWorld, scene: Scene, force_limit: Array) -> None:
        """Open the renderer. Raises InputError if there is no OpenGL."""
        super().__init__(scene, force_limit)
        self.stage, self._gl = stage, _offscreen(*_SIZE)
        self._gl.make_current()
        self._drawn = mujoco.MjvScene(stage.model, maxgeom=10_000)
        self._camera, self._option = mujoco.MjvCamera(), mujoco.MjvOption()
        stage.aim(self._camera)
        self._context = mujoco.MjrContext(stage.model, mujoco.mjtFontScale.mjFONTSCALE_100)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)

    def rendered(self, frame: Frame, width: int, height: int) -> Picture:
        """Return the pixels (height, width, 3) of scene and devices, without text and plots."""
        stage, size = self.stage, mujoco.MjrRect(0, 0, width, height)
        stage.show(frame)
        everything = int(mujoco.mjtCatBit.mjCAT_ALL)
        pixels, depth = np.empty((height, width, 3), dtype=np.uint8), np.empty((height, width), dtype=np.float32)
        mujoco.mjv_updateScene(stage.model, stage.data, self._option, None, self._camera, everything, self._drawn)
        stage.draw(self._drawn, frame)
        self._gl.make_current()
        mujoco.mjr_render(size, self._drawn, self._context)
        mujoco.mjr_readPixels(pixels, depth, size, self._context)
        pixels[(depth == depth.max()) & (depth.max() > 0.999)] = 255  # the background
        return pixels[::-1]

    def close(self) -> None:
        """Free the renderer. Otherwise the next renderer would share its texture numbers."""
        self._gl.make_current()
        self._context.free()
        self._gl.free()

    def _scene(self, image: Image.Image, frame: Frame, top: int, bottom: int) -> None:
        image.paste(Image.fromarray(self.rendered(frame, image.width, bottom - top - 8)), (0, top + 4))


def pictures_for(session: LiveLoop) -> _FlatPictures:
    """Return the object that draws a film's pictures. Raises InputError if a world needs OpenGL and there is none."""
    simulation, stage = session.prepared.simulation, stage_for(session)
    if isinstance(stage, _ShownWorld):
        return _WorldPictures(stage, simulation.scene, simulation.process.force_limit)
    return _FlatPictures(simulation.scene, simulation.process.force_limit, stage.object)


def _offscreen(width: int, height: int) -> Any:
    """Return an OpenGL context without a window, by EGL, OSMesa or CGL. Raises InputError if there is none."""
    for kind in ("egl", "osmesa", "cgl"):
        try:
            return import_module(f"mujoco.{kind}").GLContext(width, height)
        except Exception:
            continue
    raise InputError("--video: a MuJoCo scene requires OpenGL; install EGL (libegl1) or OSMesa")


def _rgb(parts: _Colour) -> tuple[int, int, int]:
    red, green, blue = (round(255 * part) for part in parts)
    return red, green, blue


def save_film(path: Path, pictures: Iterable[Picture], fps: float) -> int:
    """Write the film and return its number of pictures. Raises InputError if ffmpeg fails."""
    return _gif(path, pictures, fps) if path.suffix == ".gif" else _mp4(path, pictures, fps)


def _gif(path: Path, pictures: Iterable[Picture], fps: float) -> int:
    images: list[Image.Image] = []
    palette: Image.Image | None = None
    for picture in pictures:
        # One palette for all pictures avoids flicker, and lets the file omit unchanged pixels.
        palette = palette or _palette(picture)
        images.append(Image.fromarray(picture).quantize(palette=palette, dither=Image.Dither.NONE))

    def content(file: BinaryIO) -> None:
        images[0].save(file, "GIF", save_all=True, append_images=images[1:], duration=round(1000 / fps), loop=0)

    write(path, content)
    return len(images)


def _palette(first: Picture) -> Image.Image:
    """Return a palette with the colours of the first picture, and with bright and dark colours of later forces."""
    shades = [np.multiply(shade, light) for shade in (*_PALETTE, _ALARM) for light in (1.0, 0.75, 0.5)]
    strip = np.repeat(np.array(shades) * 255, -(-first.shape[1] // len(shades)), axis=0)[: first.shape[1]]
    later = np.repeat(strip[None].astype(np.uint8), first.shape[0] // 4, axis=0)
    return Image.fromarray(np.concatenate([first, later])).quantize(_COLOURS, dither=Image.Dither.NONE)


def _mp4(path: Path, pictures: Iterable[Picture], fps: float) -> int:
    """Write an MP4 film with ffmpeg to a temporary folder, and copy it to `path` when it is complete."""
    with tempfile.TemporaryDirectory() as folder:
        raw, film, count = Path(folder) / "film.rgb", Path(folder) / "film.mp4", 0
        with raw.open("wb") as file:
            for picture in pictures:
                file.write(picture.tobytes())
                count += 1
        size = "{}x{}".format(*_SIZE)
        source = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", size, "-r", f"{fps:g}", "-i", str(raw)]
        command = ["ffmpeg", "-loglevel", "error", "-y", *source, "-pix_fmt", "yuv420p", str(film)]
        ffmpeg = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False)
        if ffmpeg.returncode:
            raise InputError(f"--video {path}: ffmpeg: {ffmpeg.stderr.strip() or ffmpeg.returncode}")
        write(path, film.read_bytes())
    return count
