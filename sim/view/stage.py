"""The scene as it is shown: the loop's own bodies with shapes on them, arrows for the forces, and what the mouse holds.

A dressed copy only. What is simulated stays as small as models.scene builds it; the shapes have no mass and touch
nothing, so both models have the same matrices.
"""

from __future__ import annotations

import mujoco
import numpy as np

from controller.lti import Array
from models.scene import Scene
from sim.view.grip import Grip
from sim.view.layout import (
    ALARM,
    APART,
    COLUMNS,
    GREY,
    LONGEST,
    PLOT,
    SIZE,
    STEP,
    channels,
    colour,
    envelope,
    places,
    scale,
)
from sim.view.session import HISTORY, Frame

_BOX, _SPHERE, _ARROW, _BAR = (
    getattr(mujoco.mjtGeom, f"mjGEOM_{name}") for name in ("BOX", "SPHERE", "ARROW", "CAPSULE")
)
_MASSLESS = {"mass": 0, "contype": 0, "conaffinity": 0}


class Stage:
    """A scene that can be looked at, and pushed with the mouse."""

    def __init__(self, scene: Scene, force_limit: Array, size: tuple[int, int] = SIZE) -> None:
        self.scene, self.force_limit = scene, force_limit
        self.model = dressed(scene, size)
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
        low, high = envelope(frame.history, COLUMNS, round(HISTORY / frame.setting.scenario.T))
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


def dressed(scene: Scene, size: tuple[int, int] = SIZE) -> mujoco.MjModel:
    """The scene's model with shapes, places, a camera's distance and colours, but the same dynamics."""
    spec = mujoco.MjSpec.from_string(scene.xml)
    spec.visual.global_.offwidth, spec.visual.global_.offheight = size
    sky = {"type": mujoco.mjtTexture.mjTEXTURE_SKYBOX, "builtin": mujoco.mjtBuiltin.mjBUILTIN_FLAT}
    spec.add_texture(name="sky", width=32, height=192, rgb1=[0.93, 0.93, 0.93], rgb2=[0.93, 0.93, 0.93], **sky)
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
