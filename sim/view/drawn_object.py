"""The virtual object in pictures: its masses, springs and walls, and the positions of its nodes at each tick.

The displacements of the nodes are computed apart from the loop and do not affect it. They are further outputs of the
equations of a tick, beside the forces before the delays Theta.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np

from haptic_loop.controller.coupling import Coupling
from haptic_loop.controller.delay import delay
from haptic_loop.controller.environment import GROUND, Network, walled_environment
from haptic_loop.controller.law import Law
from haptic_loop.controller.lti import Array, Lti
from haptic_loop.models.device import AXES
from haptic_loop.models.scene import APART, STEP, quiet_warnings, written
from haptic_loop.sim.run import Simulation

if TYPE_CHECKING:  # --help does not load MuJoCo
    import mujoco

# Three distances [m]: from handles to contacts, between columns of nodes, and from the floor to the object.
_FIRST, _COLUMN, _HEIGHT = STEP + 0.07, 0.07, 0.03
_RADIUS = {"contact": 0.012, "node": 0.008, "mass": 0.02}  # [m]; a mass is a cube
SPRING = 0.002  # [m] radius of a drawn spring
_WALL = (0.03, 0.03, 0.002)  # [m] half the sides of a wall; the last is along its normal
_COLOUR: dict[str, tuple[float, float, float, float]] = {
    "contact": (0.95, 0.9, 0.3, 1.0),
    "node": (0.3, 0.3, 0.3, 1.0),
    "mass": (0.45, 0.35, 0.6, 1.0),
    "spring": (0.3, 0.3, 0.3, 1.0),
    "wall": (0.6, 0.45, 0.3, 1.0),
}


class _Shape(NamedTuple):
    """One shape of the object."""

    kind: Literal["contact", "node", "mass", "spring", "wall"]
    at: Array  # (3,) [m] centre, or the first end of a spring
    to: Array  # (3,) second end [m] of a spring, or normal of a wall; unused for other shapes

    @property
    def rgba(self) -> tuple[float, float, float, float]:
        return _COLOUR[self.kind]

    @property
    def size(self) -> tuple[float, ...]:
        """For a box half of each side [m]; for a sphere its radius [m], repeated; unused for springs."""
        return _WALL if self.kind == "wall" else (_RADIUS[self.kind],) * 3

    @property
    def quat(self) -> Array:
        """The quaternion that turns the z axis to the normal of a wall; the identity for other shapes."""
        import mujoco

        quat = np.array([1.0, 0.0, 0.0, 0.0])
        if self.kind == "wall":
            mujoco.mju_quatZ2Vec(quat, self.to)
        return quat


@dataclass(frozen=True, eq=False)
class DrawnObject:
    """A network with a position for each of its points, left of the devices."""

    network: Network
    rest: dict[str, Array]  # position (3,) [m] of each point at rest
    contacts: tuple[str, ...]  # the points that devices touch, one per device

    @classmethod
    def of(cls, network: Network) -> DrawnObject:
        """Return the network with contacts beside their devices, and other points in columns behind them.

        A point's column is the least number of springs and walls between the point and a contact.
        """
        points = tuple(network.points) or tuple(network.nodes())
        nodes = set(network.contacts)
        contacts = tuple(name for name in points if nodes & set(network.coordinates(name)))
        row, depth = {name: -APART * i for i, name in enumerate(contacts)}, dict.fromkeys(contacts, 0)
        ends = [part.between for part in (*network.springs, *network.walls)]
        pairs = [pair for one, other in ends for pair in ((one, other), (other, one)) if GROUND not in pair]
        for column in range(1, len(points)):
            near = {other for one, other in pairs if depth.get(one) == column - 1 and other not in depth}
            for name in [name for name in points if name in near]:
                y = float(np.mean([row[one] for one, other in pairs if other == name and depth.get(one) == column - 1]))
                while any(depth[other] == column and abs(row[other] - y) < 2.2 * _RADIUS["mass"] for other in depth):
                    y -= 2.5 * _RADIUS["mass"]
                row[name], depth[name] = y, column
        rest = {name: _place(depth.get(name, 1), row.get(name, 0.0)) for name in points}
        return cls(network, rest, contacts)

    @property
    def reach(self) -> float:
        """The distance [m] from the handles to the ground behind the object."""
        return _FIRST + _COLUMN - min(0.0, *(float(at[0]) + _FIRST for at in self.rest.values()))

    def motion(self, coupling: Coupling, psi: Sequence[int], T: float) -> _Motion:
        """Return an object that computes the nodes' displacements tick by tick, behind `coupling`."""
        return _Motion(self.network, coupling, psi, T)

    def shapes(self, displacements: Array | None = None) -> Iterator[_Shape]:
        """Yield the shapes of the object for displacements (nodes,) [m] of its nodes; None means that it rests."""
        moved = {name: np.zeros(3) for name in self.rest}
        if displacements is not None:
            q = dict(zip(self.network.nodes(), displacements, strict=True))
            for name in moved:
                for i, node in enumerate(self.network.coordinates(name)):
                    axis = AXES.index(node.rpartition(".")[2]) if self.network.points and node != GROUND else i
                    moved[name][axis] += q.get(node, 0.0)
        for spring in self.network.springs:
            a, b = (GROUND if end == GROUND else self.rest[end] + moved[end] for end in spring.between)
            if isinstance(a, str):
                a, b = b, a
            yield _Shape("spring", np.asarray(a), np.array([-self.reach, a[1], a[2]]) if isinstance(b, str) else b)
        for wall in self.network.walls:
            first, second = wall.between
            sign = -1.0 if first == GROUND else 1.0
            near, other = (second, first) if first == GROUND else (first, second)
            normal = sign * np.pad(np.array(wall.normal or (1.0,)), (0, 3 - len(wall.normal or (1.0,))))
            away = (wall.gap + _RADIUS[self._kind(near)]) * normal
            yield _Shape("wall", self.rest[near] + away + moved.get(other, np.zeros(3)), normal)
        for name, at in self.rest.items():
            yield _Shape(self._kind(name), at + moved[name], at)

    def _kind(self, name: str) -> Literal["contact", "node", "mass"]:
        return "contact" if name in self.contacts else "mass" if self.network.masses.get(name) else "node"


def _place(column: int, y: float) -> Array:
    return np.array([-_FIRST - column * _COLUMN, y, _HEIGHT])


class _Motion:
    """Displacements of a network's nodes behind a coupling, for given motions of the devices and no force limits."""

    def __init__(self, network: Network, coupling: Coupling, psi: Sequence[int], T: float) -> None:
        self._m, nodes = len(network.contacts), len(network.nodes())
        further = nodes + len(network.walls)
        G = walled_environment(network, T, places=True)
        if coupling.compliance(T) is not None:  # Without V the contacts move with the devices.
            late = Lti.diag(delay(psi, T), Lti.constant(np.eye(further), T))
            G = Coupling.around(coupling, late @ G, further)
        self._law = Law(G, (0,) * (self._m + nodes), network.walls)  # maps [x; forces on nodes] to [f; nodes' places]
        self._tick = self._law.transition()
        ports, order = self._law.channels, self._law.open.order
        self._before, self._after = np.zeros((order + ports, 1)), np.zeros((ports + order, 1))
        self._z, self._x = self._before[:order], self._before[order : order + self._m, 0]
        self._nodes, self._next = self._after[self._m : ports, 0], self._after[ports:]

    def rest(self, x: Array) -> Array:
        """Start in equilibrium, no wall touched, with devices at x (m,) [m]; return displacements (nodes,) [m]."""
        self._z[:, 0] = self._law.at_rest(np.concatenate([x, np.zeros(self._nodes.size)]))
        self._x[:] = x
        self._tick(self._before, self._after)
        return self._nodes.copy()

    def follow(self, x: Array) -> Array:
        """Return the displacements (nodes,) [m] after ticks with the devices at x (ticks, m) [m]."""
        for row in x:
            self._x[:] = row
            self._tick(self._before, self._after)
            self._z[:] = self._next
        return self._nodes.copy()


def object_of(simulation: Simulation) -> DrawnObject | None:
    """Return the virtual object of a loop; None for a MuJoCo world and for environments that are no network."""
    environment = simulation.scenario.environment
    return DrawnObject.of(environment) if isinstance(environment, Network) and not environment.world else None


# ----------------------------------------------------------------------------------------------------
# The scene's file.


def scene_xml(simulation: Simulation) -> str:
    """Return the MJCF of the devices, with the object or the world at rest beside them, which collides with nothing."""
    import mujoco

    spec = mujoco.MjSpec.from_string(simulation.scene.xml)
    kind, dead = mujoco.mjtGeom, {"contype": 0, "conaffinity": 0, "mass": 0}
    if world := simulation.scenario.environment.world:
        _add_world(spec, Path(world.file), dead)
    for shape in drawn.shapes() if (drawn := object_of(simulation)) else ():
        if shape.kind == "spring":
            ends = [*shape.at, *shape.to]
            spec.worldbody.add_geom(type=kind.mjGEOM_CAPSULE, fromto=ends, size=[SPRING, 0, 0], rgba=shape.rgba, **dead)
        else:
            form = kind.mjGEOM_BOX if shape.kind in ("mass", "wall") else kind.mjGEOM_SPHERE
            geom = spec.worldbody.add_geom(type=form, pos=shape.at, size=shape.size, rgba=shape.rgba, **dead)
            geom.quat = shape.quat
    spec.compile()
    return written(spec)


def _add_world(spec: mujoco.MjSpec, file: Path, dead: dict[str, Any]) -> None:
    """Add the geoms of a MuJoCo scene in its initial pose, left of the devices, without meshes and height fields."""
    import mujoco

    with quiet_warnings():
        model, kind = mujoco.MjModel.from_xml_path(str(file)), mujoco.mjtGeom
    data, extent = mujoco.MjData(model), float(model.stat.extent)
    mujoco.mj_kinematics(model, data)
    away = np.array([-_FIRST - extent, 0.0, _HEIGHT]) - model.stat.center
    for i in range(model.ngeom):
        shape, material = int(model.geom_type[i]), int(model.geom_matid[i])
        rgba = model.mat_rgba[material] if material >= 0 else model.geom_rgba[i]
        if shape in (kind.mjGEOM_MESH, kind.mjGEOM_HFIELD, kind.mjGEOM_SDF) or not rgba[3]:
            continue
        quat, size = np.zeros(4), model.geom_size[i].copy()
        mujoco.mju_mat2Quat(quat, data.geom_xmat[i])
        if shape == kind.mjGEOM_PLANE:
            size[:2] = np.where(size[:2] > 0, np.minimum(size[:2], extent), extent)
        at = data.geom_xpos[i] + away
        spec.worldbody.add_geom(type=shape, pos=at, size=size, quat=quat, rgba=rgba, **dead)
