"""python examples/touch_a_scene.py: three ways to touch two MuJoCo scenes, with the same lossless hands.

    contact force times a gain   usual in robot simulators: the contact is at the device's position, and the device
                                 feels a part of the contact force, clipped by its motors
    environment= function        the scene, a separate simulation, behind a certified coupling and an energy shell
    environment.world            scene and coupling solved in one step, with the same shell

A hand is a mass that is thrown at the scene, on a lossless spring to a fixed place. The energy of a pair of hands grows
if hands and devices receive more than W0 beyond what the devices' damping dissipates. W0 is the 2 mJ of the shell; with
environment.world the energy that gravity and springs released is added. A pair shakes if, in the last fifth of the run,
a force changes by more than a tenth of the limit in a tick.
"""

import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import mujoco
import numpy as np
from msgspec.structs import replace

from haptic_loop import design_coupling, load
from haptic_loop.controller.budget import Shell
from haptic_loop.models.world import digest_of
from haptic_loop.sim.world import START_J, scene_of

BLOCK = """<mujoco><default><geom solref="0.005 1" solimp="0.9 0.9 0.001"/></default><worldbody>
<geom type="box" pos="0 0 0.06" size="0.03 0.03 0.06"/>
<body name="pusher" pos="-0.05 0 0.06"><geom type="sphere" size="0.01" mass="2"/></body>
<body name="presser" pos="0 0 0.14"><geom type="sphere" size="0.01" mass="2"/></body></worldbody></mujoco>"""
GAINS = (1.0, 0.2)  # factors on the contact force


class ContactForce:
    """Moves the contacts of a scene to given positions and returns the contact forces."""

    def __init__(self, scene):
        self.port = scene.port()
        self.model, self.data = self.port.world.model, self.port.data
        joints = [f"{contact.body}, slide 1" for contact in scene.contacts]
        self.dofs = [self.model.joint(name).dofadr[0] for name in joints]
        self.T, self.before = scene.T, np.zeros(len(joints))

    def __call__(self, place):
        """Return the forces fed back (m,) [N] with the contacts at `place` (m,) [m]."""
        speed, self.before = (place - self.before) / self.T, place.copy()
        self.data.qpos[self.dofs], self.data.qvel[self.dofs] = place - self.T * speed, speed
        self.model.qpos_spring[self.dofs] = place  # the spring that the program adds stays at rest
        mujoco.mj_step(self.model, self.data)
        return -self.data.qfrc_constraint[self.dofs]


def touch(way, scenario, coupling, hands, seconds, seed=0):
    """Return peak force [N], share of limited ticks, and the numbers of pairs that gain energy and that shake."""
    rng, T, limit = np.random.default_rng(seed), scenario.T, scenario.device[0].force_limit
    peak, limited, grown, shaking, ticks = 0.0, 0, 0, 0, round(seconds / T)
    for _ in range(hands):
        scene = scene_of(scenario, coupling)  # compiled anew, since ContactForce changes its springs
        port, outside = scene.port([limit] * scene.channels), ContactForce(scene)
        shell = Shell(coupling.compliance(T), start=START_J)
        mass, stiffness = 0.25 + rng.uniform(0.05, 0.5, 2), rng.uniform(50.0, 500.0, 2)
        x, v, aim = np.zeros(2), 0.3 * rng.normal(size=2), 0.03 * rng.normal(size=2)
        received = most = 0.0
        line = [np.zeros(2)] * (max(scenario.theta) + 1)
        rotation = np.sqrt(stiffness / mass) * T  # [rad] phase of a hand's oscillation in a tick
        jump = 0.0  # [N] largest change of a force from tick to tick in the last fifth of the run
        for k in range(ticks):
            if isinstance(way, float):
                wanted = way * outside(x)
                force = np.clip(wanted, -limit, limit)
                limited += bool((np.abs(wanted) > limit).any())
            else:
                free = shell.free(x[:, None])[:, 0]
                wanted = port.step(free) if way == "world" else np.clip(outside(free), -limit, limit)
                shell.credit([port.released])
                force = shell.limit(wanted[:, None])[0][:, 0]
            if k > 0.8 * ticks:
                jump = max(jump, float(np.abs(force - line[0]).max()))
            line = [force, *line[:-1]]
            f = np.array([line[n][i] for i, n in enumerate(scenario.theta)])
            rest, before = aim - f / stiffness, x
            swing, speed = x - rest, v
            x = rest + swing * np.cos(rotation) + speed * np.sqrt(mass / stiffness) * np.sin(rotation)
            v = speed * np.cos(rotation) - swing * np.sqrt(stiffness / mass) * np.sin(rotation)
            dx = x - before
            v = v - np.array(scenario.delta) / mass * dx  # the damping dissipates at least delta dx^2/T
            received += -(f @ dx) - (np.array(scenario.delta) / T * dx**2).sum()
            most, peak = max(most, received), max(peak, float(np.abs(f).max()))
        limited += int(shell.limited[0])
        grown += most > START_J + port.released
        shaking += jump > 0.1 * limit
    return peak, limited / (hands * ticks), grown, shaking


def scenes(folder):
    """Return the packaged stack, and a fixed block with robot-like tips of 2 kg and contacts of time constant 5 ms."""
    stack = load("world-stack")
    (Path(folder) / "block.xml").write_text(BLOCK)
    block = Path(folder) / "block.xml"
    world = replace(stack.environment.world, file=str(block), digest=digest_of(block))
    return {"stack": stack, "block": stack.replace(environment=replace(stack.environment, world=world))}


def rows(hands=20, seconds=1.0):
    """Yield (way, scene, peak force [N], share of limited ticks, pairs whose energy grows, pairs that shake)."""
    with TemporaryDirectory() as folder:
        for scene, scenario in scenes(folder).items():
            coupling = design_coupling(scenario.loop("I"), "moving-average").coupling
            ways = [(f"contact force times {gain:g}", gain) for gain in GAINS]
            for label, way in (*ways, ("environment= function", "function"), ("environment.world", "world")):
                yield (label, scene, *touch(way, scenario, coupling, hands, seconds))


if __name__ == "__main__":
    hands, seconds = (int(sys.argv[1]), float(sys.argv[2])) if len(sys.argv) > 2 else (20, 1.0)
    print(f"{'way':24} {'scene':7} {'peak force':>10} {'ticks limited':>14} {'energy grows':>12} {'shake':>10}")
    for label, scene, peak, share, grown, shaking in rows(hands, seconds):
        counts = f"{grown:6d} of {hands:2d} {shaking:4d} of {hands:2d}"
        print(f"{label:24} {scene:7} {peak:8.1f} N {100 * share:12.1f} % {counts}")
