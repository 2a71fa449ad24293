"""What a picture shows, in the window and in a film: places, colours, text, arrows and plots.

The scene as it is shown is a dressed copy. What is simulated stays as small as models.scene builds it; the shapes have
no mass and touch nothing, so both models have the same matrices.
"""

from __future__ import annotations

import textwrap

import mujoco
import numpy as np

from controller.lti import Array
from design.result import Requirement
from models.scene import APART, DRAWN, STEP, Scene
from sim.view.events import GIVEN, KEYS, Couple, PreparedLoop, words
from sim.view.session import HISTORY, Frame, Grip

Colour = tuple[float, float, float]
_Lines = list[tuple[str, str]]

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

LONGEST = 0.12  # [m] arrow of a force at its limit
SIZE = (640, 640)  # pixels of a video
WORDS = 0.40  # share of a video's height, at its top, that is left to words
PLOT = 0.25  # share of the picture's height, at its bottom, that the forces take
_WIDTH = 60  # characters of a line of words
COLUMNS = 250  # spans of the plotted forces, each with its least and largest

_BOX, _SPHERE, _ARROW, _BAR = (
    getattr(mujoco.mjtGeom, f"mjGEOM_{name}") for name in ("BOX", "SPHERE", "ARROW", "CAPSULE")
)
_MASSLESS = {"mass": 0, "contype": 0, "conaffinity": 0}


def colour(channel: int) -> Colour:
    """The colour of a device, counted from 0."""
    return PALETTE[channel % len(PALETTE)]


def channels(scene: Scene) -> tuple[int, ...]:
    """The channel (from 0) that each joint belongs to; of a person's body, the first that the person holds."""
    owner = {motor: motor for motor in range(scene.channels)}
    for i, (_, *own) in enumerate(scene.points[: scene.channels]):
        owner |= dict.fromkeys((scene.handles[i], *own), i)
    for points in scene.points[scene.channels :]:
        owner |= {joint: owner[points[0]] for joint in points if joint not in owner}
    return tuple(owner[joint] for joint in range(scene.model.njnt))


def places(scene: Scene) -> tuple[int, ...]:
    """How many steps behind its handle each joint's body stands: 0 the handle, -1 a motor, 1.. a human's arm."""
    place = dict.fromkeys(range(scene.channels), -1)
    for points in scene.points[: scene.channels]:
        place |= {joint: step for step, joint in enumerate(points)}
    behind = 1 + max(place.values())
    return tuple(place.get(joint, behind) for joint in range(scene.model.njnt))


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


def overlay(frame: Frame, live: bool) -> _Lines:
    """Labels and values; `live` adds the clock, which a video has none of."""
    prepared, scenario = frame.prepared, frame.prepared.scenario
    delays = f"theta {_list(scenario.theta)}, psi {_list(scenario.psi)} samples of {1e3 * scenario.T:g} ms"
    mode = prepared.mode
    lines = [
        ("coupling", prepared.label),
        ("delays", delays),
        ("growth", f"{mode.growth:+.3g} 1/s at {mode.frequency_hz:.1f} Hz: {mode.verdict}"),
        *((name.replace("-", " "), _needs(need)) for name, need in prepared.requirements.items()),
        ("force limits", _limited(prepared)),
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
    return lines


def _limited(prepared: PreparedLoop) -> str:
    """Whether a guarantee holds at the force limits."""
    return "clipped: not covered" if prepared.limits.rho is None else "limited: the guarantee holds there too"


def _needs(requirement: Requirement) -> str:
    """Required against available damping of the worst channel, and the verdict."""
    if not np.isfinite(requirement.ratio):
        return "no certificate"
    worst = int(np.argmax(np.divide(requirement.required, requirement.available)))
    need, have = requirement.required[worst], requirement.available[worst]
    return f"needs {need:.3f} of {have:g} N s/m: {'certified' if requirement.certified else 'NOT certified'}"


def keys_help(given: bool) -> _Lines:
    """The keys and what they ask for; `given` where there is a coupling from a file. The mouse comes last."""
    keys = [(name, words(event)) for name, event in KEYS.values() if given or event != Couple(GIVEN)]
    return [*keys, ("double click", "take a body"), ("Ctrl+right", "draw it")]


def apart(lines: _Lines) -> tuple[_Lines, _Lines]:
    """The lines, and the last refusal, which may take several lines."""
    at = next((i for i, (label, _) in enumerate(lines) if label == "last"), len(lines))
    return (lines[:at], lines[at:]) if len(lines) - at > 1 else (lines, [])


def columns(lines: _Lines) -> tuple[str, str]:
    """Labels and values as MuJoCo's overlays take them."""
    return "\n".join(label for label, _ in lines), "\n".join(value for _, value in lines)


def _list(values: tuple[int, ...]) -> str:
    return ", ".join(map(str, values))


class ShownScene:
    """A scene that can be looked at, and pushed with the mouse."""

    def __init__(self, scene: Scene, force_limit: Array, size: tuple[int, int] = SIZE) -> None:
        self.scene, self.force_limit = scene, force_limit
        self.model = _dressed(scene, size)
        self.data = mujoco.MjData(self.model)
        self.channel = channels(scene)  # joint -> channel; bodies and joints have the same order

    def show(self, q: Array) -> None:
        """Put the joints at q [m]."""
        self.data.qpos[:] = q
        self.data.qvel[:] = 0.0
        mujoco.mj_forward(self.model, self.data)

    def grip(self, perturb: mujoco.MjvPerturb) -> Grip | None:
        """What the mouse holds. A hand holds the handle, whichever body of its device was taken."""
        joint = int(self.model.body_jntadr[perturb.select]) if perturb.select > 0 else -1
        if joint < 0 or not (perturb.active | perturb.active2) & int(mujoco.mjtPertBit.mjPERT_TRANSLATE):
            return None
        channel = self.channel[joint]
        turn = self.data.xmat[perturb.select].reshape(3, 3)
        taken = self.data.xpos[perturb.select] + turn @ perturb.localpos
        drawn = float(perturb.refselpos[0] - taken[0])
        return Grip(channel, float(self.data.qpos[self.scene.handles[channel]]) + drawn)

    def draw(self, drawn: mujoco.MjvScene, frame: Frame) -> None:
        """Arrows: the mean force on each device, the range it has had since the last frame, and what pushes."""
        for i, handle in enumerate(self.scene.handles):
            own, reach = colour(i), LONGEST / self.force_limit[i]
            at = self.data.xpos[self.model.jnt_bodyid[handle]] + np.array([0, 0, 0.045])
            clipped = max(-frame.low[i], frame.high[i]) >= self.force_limit[i]
            band = (*ALARM, 0.6) if clipped else (*own, 0.35)
            # the device feels -f
            left, right = (np.array([-f * reach, 0, 0]) for f in (frame.high[i], frame.low[i]))
            _connect(drawn, _BAR, 0.010, at + left, at + right, band)
            _arrow(drawn, at, -frame.mean[i] * reach, (*own, 1.0))
            pushed = float(np.clip(frame.push[i] * reach, -LONGEST, LONGEST))
            _arrow(drawn, at + np.array([0, 0, 0.03]), pushed, (0.1, 0.1, 0.1, 1.0))

    def figures(self, frame: Frame, picture: mujoco.MjrRect) -> list[tuple[mujoco.MjrRect, mujoco.MjvFigure]]:
        """The forces of the last seconds, side by side at the bottom of a picture."""
        m = self.scene.channels
        width, height = picture.width // m, round(PLOT * picture.height)
        low, high = envelope(frame.history, COLUMNS, round(HISTORY / frame.prepared.scenario.T))
        top, drawn = scale(frame.history), []
        for i in range(m):
            place = mujoco.MjrRect(picture.left + i * width, picture.bottom, width, height)
            drawn.append((place, _figure(i, low[:, i], high[:, i], top)))
        return drawn

    def aim(self, camera: mujoco.MjvCamera, aside: tuple[float, float, float], back: float) -> None:
        """Look from above at a point `aside` of the devices' middle and from `back` of it, in extents of the scene."""
        camera.lookat[:] = self.model.stat.center + self.model.stat.extent * np.array(aside)
        camera.distance = back * self.model.stat.extent
        camera.azimuth, camera.elevation = 90.0, -35.0


def _dressed(scene: Scene, size: tuple[int, int] = SIZE) -> mujoco.MjModel:
    """The scene's model with shapes, places, a camera's distance and colours, but the same dynamics."""
    spec = mujoco.MjSpec.from_string(scene.xml)
    _undress(spec)
    spec.visual.global_.offwidth, spec.visual.global_.offheight = size
    spec.visual.headlight.ambient = [0.5, 0.5, 0.5]
    where = places(scene)
    for joint, (place, channel) in enumerate(zip(where, channels(scene), strict=True)):
        body = spec.body(scene.model.joint(joint).name)
        body.pos = [place * STEP, channel * -APART, 0.03]
        if place == 0:
            body.add_geom(type=_SPHERE, size=[0.024] * 3, rgba=(*colour(channel), 1.0), **_MASSLESS)
        else:
            body.add_geom(type=_BOX, size=[0.022, 0.026, 0.022], rgba=(*GREY, 1.0), **_MASSLESS)
    deepest = max(1, *where)
    middle = [(deepest - 1) * STEP / 2, -APART * (scene.channels - 1) / 2, 0.03]
    for channel in range(scene.channels):
        at, rail = [middle[0], -APART * channel, 0.0], [0.5 * STEP * (deepest + 1) + 0.06, 0.012, 0.004]
        spec.worldbody.add_geom(type=_BOX, pos=at, size=rail, rgba=[0.8, 0.8, 0.8, 1], **_MASSLESS)
    spec.stat.center = middle
    spec.stat.extent = 0.24 + 0.5 * STEP * deepest + 0.5 * APART * (scene.channels - 1)
    return spec.compile()


def _undress(spec: mujoco.MjSpec) -> None:
    """Take out what a viewer shows of the scene's own file: this stage has its own shapes and colours."""
    drawn = [tendon for tendon in spec.tendons if tendon.name.endswith(DRAWN)]
    for part in [*drawn, *spec.geoms, *spec.sites]:
        spec.delete(part)


def _figure(channel: int, low: Array, high: Array, top: float) -> mujoco.MjvFigure:
    """One device's forces [N], drawn from least to largest in every span."""
    figure = mujoco.MjvFigure()
    mujoco.mjv_defaultFigure(figure)
    figure.title, figure.xlabel = f"force on device {channel + 1} [N]", "time [s]"
    figure.flg_extend, figure.flg_legend = 0, 0
    figure.gridsize = [5, 5]
    figure.figurergba[:] = (1, 1, 1, 1)
    figure.panergba[:] = (1, 1, 1, 1)
    figure.textrgb[:] = (0, 0, 0)
    figure.gridrgb[:] = (0.75, 0.75, 0.75)
    figure.range[:] = ((-HISTORY, 0.0), (-top, top))
    t, seen = np.linspace(-HISTORY, 0.0, low.size), np.isfinite(low)
    points = np.stack([t, low, t, high], axis=1)[seen].reshape(-1)
    figure.linedata[0, : points.size] = points
    figure.linepnt[0] = points.size // 2
    figure.linergb[0] = colour(channel)
    return figure


def _arrow(drawn: mujoco.MjvScene, at: Array, length: float, rgba: tuple[float, ...]) -> None:
    if abs(length) > 1e-4:
        _connect(drawn, _ARROW, 0.005, at, at + np.array([length, 0, 0]), rgba)


def _connect(
    drawn: mujoco.MjvScene, shape: mujoco.mjtGeom, width: float, a: Array, b: Array, rgba: tuple[float, ...]
) -> None:
    if drawn.ngeom >= drawn.maxgeom or not np.any(a != b):
        return
    geom = drawn.geoms[drawn.ngeom]
    mujoco.mjv_initGeom(geom, shape, np.zeros(3), np.zeros(3), np.zeros(9), np.array(rgba, dtype=np.float32))
    mujoco.mjv_connector(geom, shape, width, np.asarray(a, dtype=float), np.asarray(b, dtype=float))
    drawn.ngeom += 1
