"""MuJoCo scenes as environments: devices touch bodies of a scene, and scene and coupling are solved in one step.

A device touches a contact: a body of the scene that is a child of the world body and has no joint. A coupling with
the direct part D_V responds within the tick, u = u0 - D_V f, where u0 is the contact's position without force. Device,
delays and coupling therefore act on the scene like one spring G = D_V^-1 from the contact to the point u0. The program
adds this spring, and slide joints along the contact's directions. While no force is limited, MuJoCo's `discrete`
integrator then solves in each step of length h

    f = G (u0 - u),   M (v+ - v)/h = f + all other forces at the end of the step,   u = displacement after the step.

controller.budget.Shell measures and limits the energy that a scene generates. The lemma in docs/theory.md, "MuJoCo
worlds", bounds this energy for ordinary scenes.
"""

from __future__ import annotations

import hashlib
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from haptic_loop.controller.lti import Array, block_diagonal
from haptic_loop.models.scene import quiet_warnings

_CONTACT_MASS = 0.03  # [kg] mass of a contact for which the scene states no mass; densities are ignored
ITERATIONS, TOLERANCE = 100, 1e-10  # limits of the Newton solver
_MOST_REPETITIONS = 8  # largest number of repetitions of a step whose forces are limited
_LIMIT_SLACK = 1e-9  # hysteresis of the decision whether a force is limited, relative to the limit
_DIRECTION_SLACK = 1e-6  # repetitions end when they change limited forces by less than this part of the limit
_TOO_LARGE = 50_000_000  # [bytes] largest size of an XML file of a scene


@dataclass(frozen=True)
class Contact:
    """A body that a device touches, and the directions in which it slides: (axes, 3), orthonormal."""

    body: str
    along: tuple[tuple[float, float, float], ...] = ((1.0, 0.0, 0.0),)


@dataclass(frozen=True)
class _Part:
    """One kind of part of a scene, and the bound on the energy that such parts generate at the contacts."""

    what: str
    count: int
    at_the_port: str  # the bound, in words


def files_of(path: Path) -> list[Path]:
    """Return the MJCF file, all files that it includes or attaches, and their meshes, height fields and textures.

    A mesh that exists in several folders is listed once per folder. Raises ValueError if a file cannot be read, is
    empty, too large or not XML, or is included twice.
    """
    files: dict[Path, None] = {}
    folders: list[Path] = []
    assets: list[str] = []

    def visit(file: Path, base: Path) -> None:
        if file in files:
            raise ValueError(f"world {path}: {file.name} is included twice")
        files[file] = None
        folders.append(base)
        for node in _xml(file, path).iter():
            name = node.get("file")
            if node.tag == "include" and name:
                beside = file.parent / name  # MuJoCo reads this file if the main file's folder has no file of this name
                visit(base / name if (base / name).exists() or not beside.exists() else beside, base)
            elif node.tag == "model" and name and (part := base / name).suffix == ".xml":
                if part not in files:
                    visit(part, part.parent)
            elif node.tag == "compiler":
                named = (node.get(key) for key in ("assetdir", "meshdir", "texturedir"))
                folders.extend(base / folder for folder in named if folder)
            else:
                assets.extend(value for key, value in node.attrib.items() if key.startswith("file"))

    visit(path, path.parent)
    for name in assets:
        # The compiler's option strippath keeps only the last part of a name.
        places = [folder / part for folder in folders for part in (name, Path(name).name)]
        files.update(dict.fromkeys(place for place in places if place.is_file()))
    return list(files)


def _xml(file: Path, world: Path) -> ElementTree.Element:
    try:
        if file.exists() and not (file.is_file() and file.stat().st_size):  # reading a pipe or device could block
            raise ValueError(f"world {file}: is empty or not a regular file, expected an MJCF file")
        if file.stat().st_size > _TOO_LARGE:
            raise ValueError(f"world {world}: {file.name} is larger than {_TOO_LARGE // 1_000_000} MB")
        return ElementTree.fromstring(file.read_bytes())
    except OSError as error:
        raise ValueError(f"world {file}: {error.strerror or error}") from None
    except ElementTree.ParseError as error:
        raise ValueError(f"world {file}: not a valid XML file: {error}") from None


def digest_of(path: Path) -> str:
    """Return the SHA-256 digest of the names and contents of a scene's files.

    Raises ValueError for a file that cannot be read, is empty, too large or not XML, or is included twice.
    """
    total = hashlib.sha256()
    for file in files_of(path):
        content = file.read_bytes()
        total.update(f"{file.name}\0{len(content)}\0".encode() + content)
    return total.hexdigest()


def check_contacts(path: Path, bodies: Sequence[str]) -> None:
    """Raise ValueError for a file that MuJoCo refuses, or for a body that cannot be a contact."""
    World(path, [Contact(body) for body in bodies], [np.eye(1)] * len(bodies), 1e-3)


def touchable_bodies(path: Path) -> list[str]:
    """Return the names of the world's children that have no joint and are not mocap bodies, in file order.

    Each of them may be a contact, unless it is welded. Raises ValueError for a file that MuJoCo refuses or cannot read.
    """
    return _without_joints(_spec(path))


# ----------------------------------------------------------------------------------------------------
# The scene with its contacts


class World:
    """A scene with slides and springs at its contacts, compiled with the settings that `WorldPort` needs.

    One world serves any number of ports (simulations) on one thread; their steps may alternate.
    """

    def __init__(
        self,
        path: Path | str,
        contacts: Sequence[Contact],
        stiffness: Sequence[Array],
        T: float,
        every: int = 1,
        gravity: bool = True,
    ) -> None:
        """Compile the scene.

        Args:
            path: The MJCF file.
            contacts: One contact per device.
            stiffness: G of each device, (axes, axes), symmetric and positive definite [N/m].
            T: The period of the loop [s].
            every: The number of ticks per step of the scene, so that a step lasts `every` * T seconds.
            gravity: False switches the scene's gravity off.

        Raises:
            ValueError: MuJoCo refuses the file, or a body cannot be a contact.
        """
        self.path, self.contacts, self.T, self.every = Path(path), tuple(contacts), T, every
        with quiet_warnings():
            self._compile(stiffness, gravity)

    def _compile(self, stiffness: Sequence[Array], gravity: bool) -> None:
        spec = _spec(self.path)
        base = _compiled(spec, self.path)
        self._keys = {base.key(i).name: base.key(i).qpos.copy() for i in range(base.nkey)}
        rotations, springs, names = [], [], [contact.body for contact in self.contacts]
        bodies = [_touchable(spec, name, names) for name in names]  # checks all bodies before the first gets a joint
        for contact, body, G in zip(self.contacts, bodies, stiffness, strict=True):
            values, Q = np.linalg.eigh((G + G.T) / 2)
            _slide(spec, body, contact, Q, values, base.body(contact.body).quat)
            rotations.append(Q)
            springs.append(values)
        for key in list(spec.keys):
            spec.delete(key)
        _force_settings(spec, self.T * self.every, gravity)
        self.model = _compiled(spec, self.path)
        _off_rest(self.model)
        self.xml = spec.to_xml()
        self._Q, self._g = block_diagonal(rotations), np.concatenate(springs)  # u = Q q
        joints = [self.model.joint(_name(c, a)) for c in self.contacts for a in range(len(c.along))]
        self._qpos = np.array([joint.qposadr[0] for joint in joints])
        self._dof = np.array([joint.dofadr[0] for joint in joints])
        self._joint = np.array([joint.id for joint in joints])
        weightless = self.model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_GRAVITY
        carried = 0.0 if weightless else self.model.body_gravcomp * ~_lifted_by_actuators(self.model)
        self._afloat = self.model.body_mass * carried  # (nbody,) [kg] mass whose weight gravity compensation carries

    @property
    def channels(self) -> int:
        return self._g.size

    @property
    def h(self) -> float:
        """The length of one step of the scene [s]."""
        return self.model.opt.timestep

    def port(self, force_limit: Sequence[float] | Array | None = None, balls: Sequence[slice] = ()) -> WorldPort:
        """Return a simulation of the scene from its initial pose, with force limits (m,) [N] at the contacts.

        A limit bounds each component of a contact's force. If `balls` contains the slice of the contact's channels, the
        limit bounds the length of the force.
        """
        limits = np.full(self.channels, np.inf) if force_limit is None else np.array(force_limit, float)
        return WorldPort(self, limits, balls)

    def linear(self, pose: Array | str | None = None, step: float = 1e-6) -> tuple[Array, Array, Array, Array]:
        """Linearise the scene near a pose, without the springs G, by centred differences of one step.

        The model neglects every nonlinearity, above all contacts that open or close, and large turns of joints.

        Args:
            pose: Positions (nq,) of this model, the name of a keyframe of the MJCF file, or None for the initial pose.
            step: The displacement of each position [m, rad]. The changes of speeds and forces move the scene by about
                this displacement in one step.

        Returns:
            A, B, C, D from forces on the contacts [N] to u [m], with the state (q, h v).

        Raises:
            ValueError: The keyframe is unknown, or the pose has another length.
        """
        model, data = self.model, mujoco.MjData(self.model)
        q0, nv = self._pose(pose), model.nv
        stiffness = model.jnt_stiffness[self._joint].copy()

        def after(move: Array) -> Array:
            mujoco.mj_resetData(model, data)
            data.qpos[:] = q0
            mujoco.mj_integratePos(model, data.qpos, move[:nv], 1.0)
            data.qvel[:] = move[nv : 2 * nv]
            data.qfrc_applied[self._dof] = self._Q.T @ move[2 * nv :]
            mujoco.mj_step(model, data)
            moved = np.empty(nv)
            mujoco.mj_differentiatePos(model, moved, 1.0, q0, data.qpos)
            return np.concatenate([moved, data.qvel])

        model.jnt_stiffness[self._joint] = 0.0
        try:
            push = np.full(self.channels, step / self.h**2 * model.body_mass[model.jnt_bodyid[self._joint]].min())
            moves = np.concatenate([np.full(nv, step), np.full(nv, step / self.h), push])
            columns = [(after(row) - after(-row)) / (2 * move) for row, move in zip(np.diag(moves), moves, strict=True)]
        finally:
            model.jnt_stiffness[self._joint] = stiffness
        scale = np.repeat([1.0, self.h], nv)  # makes every state a length, so that inverses lose fewer digits
        A, B = np.hsplit(scale[:, None] * np.array(columns).T, [2 * nv])
        A = A / scale
        rows = self._Q @ np.eye(2 * nv)[self._dof]
        return A, B, rows @ A, rows @ B

    def _pose(self, pose: Array | str | None) -> Array:
        if isinstance(pose, str):
            if pose not in self._keys:
                named = ", ".join(name for name in self._keys if name) or "none"
                raise ValueError(f"pose is {pose!r}, keyframes of {self.path.name}: {named}")
            qpos = self.model.qpos0.copy()
            qpos[np.setdiff1d(np.arange(self.model.nq), self._qpos)] = self._keys[pose]
            return qpos
        qpos = self.model.qpos0.copy() if pose is None else np.array(pose, dtype=float)
        if qpos.shape != (self.model.nq,):
            raise ValueError(f"pose has the shape {qpos.shape}, expected ({self.model.nq},) positions")
        return qpos

    def settings(self) -> str:
        """Return one line with the settings that the program imposes on the scene."""
        slow = f" = {self.every} ticks" if self.every > 1 else ""
        solver = f"Newton, {ITERATIONS} iterations, tolerance {TOLERANCE:g}, no noslip"
        return f"integrator discrete, timestep {self.h:g} s{slow}, elliptic cones, {solver}"

    def outside_the_lemma(self) -> list[str]:
        """Return the names of actuators, plugins and callbacks, whose energy the lemma does not bound."""
        m = self.model
        listed = [f"actuator {m.actuator(i).name or i}" for i in range(m.nu)]
        listed += [f"plugin {m.plugin(i).name or i}" for i in range(m.nplugin)]
        callbacks = ("passive", "control", "act_dyn", "act_gain", "act_bias", "contactfilter")
        for name in callbacks:
            get = getattr(mujoco, f"get_mjcb_{name}", None)
            if get is not None and get() is not None:
                listed.append(f"callback mjcb_{name}")
        return listed

    def parts(self) -> list[_Part]:
        """Return the kinds of parts in the scene, with the bound on the energy of each (docs/worlds.md)."""
        return _parts(self.model, set(self._joint.tolist()))


def _lifted_by_actuators(m: mujoco.MjModel) -> NDArray[np.bool_]:
    """Return a mask (nbody,) of the bodies whose gravity compensation acts through actuators, which may limit it."""
    lifted = np.zeros(m.nbody, dtype=bool)
    lifted[m.jnt_bodyid[m.jnt_actgravcomp != 0]] = True
    for body in range(1, m.nbody):  # parents come before their children
        lifted[body] |= lifted[m.body_parentid[body]]
    return lifted


def _spec(path: Path) -> Any:
    files_of(path)  # raises ValueError with the name of a missing file
    with _refused(path):
        spec = mujoco.MjSpec.from_file(str(path))
    spec.compiler.fusestatic = False  # fusing would remove the contacts
    return spec


def _compiled(spec: Any, path: Path) -> mujoco.MjModel:
    with _refused(path):
        model = spec.compile()
        mujoco.mj_forward(model, mujoco.MjData(model))  # raises if the scene's memory is too small
    return model


@contextmanager
def _refused(path: Path) -> Iterator[None]:
    """Turn MuJoCo's errors into a ValueError of one line."""
    try:
        yield
    except (ValueError, mujoco.FatalError) as error:
        raise ValueError(f"world {path}: {' '.join(str(error).split())}") from None


def _without_joints(spec: Any) -> list[str]:
    return [body.name for body in spec.worldbody.bodies if body.name and not body.joints and not body.mocap]


def _touchable(spec: Any, name: str, contacts: Sequence[str]) -> Any:
    """Return the body of a contact. Raises ValueError for a body that cannot be one."""
    body = spec.body(name) if name else None
    free = _without_joints(spec)
    if body is None or body.parent is None:  # only the world body has no parent
        named = ", ".join(free) or "none"
        raise ValueError(f"contact {name!r}: the world has no such body; bodies without a joint: {named}")
    if body.parent.name != "world":
        raise ValueError(f"contact {name!r} is a child of body {body.parent.name!r}, expected a child of the world")
    if body.joints:
        raise ValueError(f"contact {name!r} has a joint ({body.joints[0].name or 'unnamed'}), expected none")
    if body.mocap:
        raise ValueError(f"contact {name!r} is a mocap body, expected an ordinary body without joints")
    if list(contacts).count(name) > 1:
        raise ValueError(f"contact {name!r} is named twice; each device must touch a different body")
    fixed = list(_fixed_to(body))
    own = {mujoco.mjtObj.mjOBJ_BODY: {part.name for part in fixed}}
    own[mujoco.mjtObj.mjOBJ_SITE] = {site.name for part in fixed for site in part.sites}
    for equality in spec.equalities:
        ends = {equality.name1, equality.name2} & own.get(equality.objtype, set())
        if equality.type == mujoco.mjtEq.mjEQ_WELD and ends:
            raise ValueError(f"contact {name!r} is welded ({equality.name or 'unnamed weld'}); remove the weld")
    return body


def _name(contact: Contact, axis: int) -> str:
    return f"{contact.body}, slide {axis + 1}"


def _slide(spec: Any, body: Any, contact: Contact, Q: Array, stiffness: Array, turn: Array) -> None:
    """Add slides and springs to a contact, give it a mass if the scene states none, and compensate its weight.

    `turn` is the body's quaternion. All settings are explicit, so that the scene's defaults do not apply. Raises
    ValueError if the scene has a joint with the name of a slide.
    """
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, np.asarray(turn, dtype=float))
    directions = Q.T @ np.array(contact.along) @ rotation.reshape(3, 3)  # in the frame of the body
    for axis, (direction, k) in enumerate(zip(directions, stiffness, strict=True)):
        name = _name(contact, axis)
        if spec.joint(name) is not None:
            raise ValueError(f"joint {name!r} has the name of a slide that the program adds; rename it")
        joint = body.add_joint(name=name, type=mujoco.mjtJoint.mjJNT_SLIDE, axis=direction)
        joint.stiffness = [k, 0.0, 0.0]
        joint.damping = [0.0, 0.0, 0.0]
        joint.armature = joint.frictionloss = joint.ref = joint.springref = joint.springyield = 0.0
        joint.limited = joint.actfrclimited = mujoco.mjtLimited.mjLIMITED_FALSE
        joint.actgravcomp = 0
    if not body.explicitinertial and all(np.isnan(geom.mass) for geom in body.geoms):
        body.explicitinertial, body.mass, body.inertia = True, _CONTACT_MASS, [1e-5] * 3
        body.ipos = [0.0, 0.0, 0.0]
        for geom in body.geoms:  # the compiler reads these masses if inertiafromgeom is "true"
            geom.mass = _CONTACT_MASS / len(body.geoms)
    for part in _fixed_to(body):
        part.gravcomp = 1.0


def _fixed_to(body: Any) -> Iterator[Any]:
    """Return the body and all its descendants that are fixed to it without joints."""
    yield body
    for child in body.bodies:
        if not child.joints:
            yield from _fixed_to(child)


def _force_settings(spec: Any, h: float, gravity: bool) -> None:
    option, enable, disable = spec.option, mujoco.mjtEnableBit, mujoco.mjtDisableBit
    if option.disableflags & disable.mjDSBL_SPRING:
        raise ValueError("option flag spring is disabled: the scene's contacts need springs, remove the flag")
    option.integrator = mujoco.mjtIntegrator.mjINT_DISCRETE
    option.timestep = h
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    option.solver = mujoco.mjtSolver.mjSOL_NEWTON
    option.iterations, option.tolerance, option.noslip_iterations = ITERATIONS, TOLERANCE, 0
    option.enableflags = (option.enableflags | enable.mjENBL_ENERGY) & ~(
        enable.mjENBL_SLEEP | enable.mjENBL_IPC | enable.mjENBL_FWDINV | enable.mjENBL_SPECULATIVE
    )
    option.disableflags |= disable.mjDSBL_AUTORESET
    if not gravity:
        option.gravity = [0.0, 0.0, 0.0]


def _off_rest(model: mujoco.MjModel) -> None:
    """Lengthen tendon springs by 1e-12 of their rest length, or from 0 to 1e-12 m.

    MuJoCo ignores a tendon spring exactly at rest. Springs with a range of rest lengths are not changed.
    """
    if not model.ntendon:
        return
    exact = (model.tendon_stiffness.reshape(model.ntendon, -1) != 0).any(axis=1)
    exact &= model.tendon_lengthspring[:, 0] == model.tendon_lengthspring[:, 1]
    length = model.tendon_lengthspring[exact]
    model.tendon_lengthspring[exact] = np.where(length == 0, 1e-12, length * (1 + 1e-12))


# ----------------------------------------------------------------------------------------------------
# The simulation of a scene


_STATE = mujoco.mjtState.mjSTATE_INTEGRATION
_TWO_SIDED = int(mujoco.mjtConstraint.mjCNSTR_FRICTION_TENDON)  # MuJoCo lists the two-sided types first


class WorldPort:
    """One simulation of a world, tick by tick, with the energy that the scene has generated."""

    def __init__(self, world: World, force_limit: Array, balls: Sequence[slice] = ()) -> None:
        """Start a simulation with `force_limit` (m,) [N], inf for none, and `balls` as in World.port."""
        self.world, self.data = world, mujoco.MjData(world.model)
        self._axes = np.array([len(contact.along) for contact in world.contacts])
        self._first = np.cumsum(self._axes) - self._axes  # the first channel of each contact
        channels = [slice(first, first + axes) for first, axes in zip(self._first, self._axes, strict=True)]
        self._limits = force_limit
        self._radial = np.array([own in balls and own.stop - own.start > 1 for own in channels])
        any_limit = bool((force_limit < np.inf).any())
        self._saved = np.zeros(mujoco.mj_stateSize(world.model, _STATE)) if any_limit else None
        self.ticks = 0
        self.created = 0.0  # [J] upper bound on the energy that contacts and other constraints have created so far
        self.unsettled = 0  # steps of the scene in which limited forces still changed after _MOST_REPETITIONS
        self._at_first = self._potential()
        self.released = 0.0  # [J] largest energy that gravity and the scene's springs have released so far

    def step(self, u0: Array) -> Array:
        """Advance by one tick; return the forces (m,) [N] of contacts whose positions without force are u0 (m,) [m].

        Raises ValueError if MuJoCo cannot step. The forces are not finite if MuJoCo's state is not finite.
        """
        world = self.world
        goal = world._Q.T @ u0
        # Between its steps the scene does not move, so the forces do no work.
        force = self._within(self._spring(goal)) if self.ticks % world.every else self._stepped(goal)
        self.ticks += 1
        return force

    def _spring(self, goal: Array) -> Array:
        """Return G (u0 - u) (m,) [N] at the scene's present position."""
        world = self.world
        return world._Q @ (world._g * (goal - self.data.qpos[world._qpos]))

    def _used(self, force: Array) -> Array:
        """Return the force of each contact (contacts,) relative to its limit."""
        share = np.abs(force) / self._limits
        most = np.maximum.reduceat(share, self._first)
        if not self._radial.any():
            return most
        return np.where(self._radial, np.sqrt(np.add.reduceat(share**2, self._first)), most)

    def _within(self, force: Array) -> Array:
        """Return `force` (m,) [N] scaled or clipped to its limits."""
        if self._radial.any():
            force = force / np.repeat(np.where(self._radial, np.maximum(self._used(force), 1.0), 1.0), self._axes)
        return np.clip(force, -self._limits, self._limits)

    @property
    def u(self) -> Array:
        """Displacements of the contacts along their directions, (m,) [m]."""
        return self.world._Q @ self.data.qpos[self.world._qpos]

    @property
    def warnings(self) -> list[str]:
        """MuJoCo's warnings of this simulation, such as numbers that are not finite, or omitted contacts."""
        kinds = enumerate(self.data.warning)
        return [mujoco.mju_warningText(kind, each.lastinfo) for kind, each in kinds if each.number]

    def _stepped(self, goal: Array) -> Array:
        model, data, world = self.world.model, self.data, self.world
        model.qpos_spring[world._qpos] = goal
        try:
            if self._saved is None:
                mujoco.mj_step(model, data)
                force = self._spring(goal)
            else:
                force = self._limited(goal, self._saved)
        except mujoco.FatalError as error:
            raise ValueError(f"world {world.path}: {' '.join(str(error).split())}") from None
        if data.nefc and np.isfinite(created := self._creates()):
            self.created += created
        self.released = max(self.released, self._at_first - self._potential())
        return force

    def _limited(self, goal: Array, saved: Array) -> Array:
        """Repeat the step until two steps in a row limit the same contacts, with equal forces up to _DIRECTION_SLACK.

        At most _MOST_REPETITIONS repetitions are made. On a limited contact the limited force replaces the spring's.
        """
        model, data, world = self.world.model, self.data, self.world
        mujoco.mj_getState(model, data, saved, _STATE)
        pushed, push = np.zeros(len(self._axes), dtype=bool), np.zeros(world.channels)
        repetition = 0
        while True:
            held = np.repeat(pushed, self._axes)
            model.jnt_stiffness[world._joint] = np.where(held, 0.0, world._g)
            data.qfrc_applied[world._dof] = world._Q.T @ push
            mujoco.mj_step(model, data)
            free = self._spring(goal)
            limited = self._used(free) > np.where(pushed, 1 - _LIMIT_SLACK, 1 + _LIMIT_SLACK)
            force = np.where(np.repeat(limited, self._axes), self._within(free), 0.0)
            off = np.abs(force - push) > _DIRECTION_SLACK * np.where(held, self._limits, np.inf)
            if settled := bool((limited == pushed).all() and not off.any()):
                break
            if repetition == _MOST_REPETITIONS:
                break
            repetition, pushed, push = repetition + 1, limited, force
            mujoco.mj_setState(model, data, saved, _STATE)
        self.unsettled += not settled
        model.jnt_stiffness[world._joint], data.qfrc_applied[world._dof] = world._g, 0.0
        return self._within(np.where(held, push, free))

    def _potential(self) -> float:
        """Return the energy [J] of gravity and of the scene's own springs, but not of G, at the present positions."""
        model, data, world = self.world.model, self.data, self.world
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        if model.nflex:
            mujoco.mj_flex(model, data)
        if model.ntendon:
            mujoco.mj_tendon(model, data)
        at = data.qpos[world._qpos]
        model.qpos_spring[world._qpos] = at  # so that the springs G store no energy
        mujoco.mj_energyPos(model, data)
        return float(data.energy[0] + (world._afloat @ data.xipos) @ model.opt.gravity)

    def _creates(self) -> float:
        """Return the sum [J] of the positive `Rows.excess`, an upper bound of the energy created in the last step."""
        rows = Rows.of(self.world.model, self.data)
        return float(np.maximum(rows.excess(self.world.h), 0.0).sum())


@dataclass(frozen=True, eq=False)
class Rows:
    """The constraint rows of the last step, grouped by contact or other constraint."""

    force: Array  # (rows,) [N]
    after: Array  # (rows,) w+, the speed after the step [m/s]; w is the speed before it
    depth: Array  # (rows,) r, the distance to the contact or limit [m]; it is negative beyond it
    D: Array  # (rows,) inverse regularisation of the row's law f = -D ((w+ - w)/h + b w+ + K (r + h w+)) [kg]
    K: Array  # (rows,) reference stiffness [1/s^2]
    b: Array  # (rows,) reference damping [1/s]
    first: NDArray[np.intp]  # the first row of each contact or other constraint
    one_sided: NDArray[np.bool_]  # (rows,) False for equalities and friction (which stores no energy, K = 0)

    @classmethod
    def of(cls, model: mujoco.MjModel, data: mujoco.MjData) -> Rows:
        """Read the rows from a step of the discrete integrator, whose efc_D is D (1 + b h + K h^2)."""
        n, h = data.nefc, model.opt.timestep
        after = np.empty(n)
        mujoco.mj_mulJacVec(model, data, after, data.qvel)
        KBIP = data.efc_KBIP.reshape(n, 4)
        K, b = KBIP[:, 0] * KBIP[:, 2], KBIP[:, 1]
        D = data.efc_D / (1 + b * h + K * h**2)
        kind, number = data.efc_type, data.efc_id
        new = np.ones(n, dtype=bool)
        new[1:] = (kind[1:] != kind[:-1]) | (number[1:] != number[:-1])
        one_sided = kind > _TWO_SIDED
        depth = data.efc_pos - data.efc_margin
        return cls(data.efc_force, after, depth, D, K, b, np.flatnonzero(new), one_sided)

    def _stored(self, depth: Array) -> Array:
        inside = np.where(self.one_sided, np.minimum(depth, 0.0), depth)
        return self.D * self.K * inside**2 / 2

    def excess(self, h: float) -> Array:
        """Return the energy [J] that each contact or other constraint creates: h f'w+ + phi(r + h w+) - phi(r).

        phi(r) = D K min(0, r)^2/2 is the energy stored in a one-sided row; in a two-sided row r replaces min(0, r).
        """
        rows = h * self.force * self.after + self._stored(self.depth + h * self.after) - self._stored(self.depth)
        return np.add.reduceat(rows, self.first)


# ----------------------------------------------------------------------------------------------------
# The parts of a scene and the bounds on their energy


_NONE = "no energy (lemma)"
_BOUNDED = "lemma: at most what contacts create, which a run prints; the shell bounds it"
_ROW = "may create energy, at most the lemma's term; the shell bounds it"
_SMALL = "small in measurements; the shell bounds it"
_VARYING = "small in measurements unless contact is made fast; the shell bounds it"
_TURNING = "small in measurements of slow motion; the shell bounds it"
_SHELL = "the shell only"


def _parts(m: mujoco.MjModel, slides: set[int]) -> list[_Part]:
    joints = [i for i in range(m.njnt) if i not in slides]
    soft = {*m.flex_vertbodyid.tolist(), *m.flex_nodebodyid.tolist()}  # points of soft bodies
    movable, turns = set(m.jnt_bodyid[joints].tolist()) - soft, np.zeros(m.nbody, dtype=bool)
    turns[m.jnt_bodyid[m.jnt_type != mujoco.mjtJoint.mjJNT_SLIDE]] = True
    for body in range(1, m.nbody):  # parents come before their children
        turns[body] |= turns[m.body_parentid[body]]
    turning = int(turns[list(movable)].sum())
    constants = (m.jnt_stiffness, m.tendon_stiffness, m.dof_damping, m.tendon_damping)
    higher = (m.jnt_stiffnesspoly, m.tendon_stiffnesspoly, m.dof_dampingpoly, m.tendon_dampingpoly)
    yielding = int((m.jnt_springyield != 0).sum() + (m.tendon_springyield != 0).sum())
    rubbing = int((m.dof_frictionloss > 0).sum() + (m.tendon_frictionloss > 0).sum())
    limited = [i for i in joints if m.jnt_limited[i]]
    constant_limits = bool((m.jnt_solimp[limited, 0] == m.jnt_solimp[limited, 1]).all())
    solid = (m.geom_contype != 0) | (m.geom_conaffinity != 0)
    constant = bool((m.geom_solimp[solid, 0] == m.geom_solimp[solid, 1]).all() and not m.geom_margin[solid].any())
    constant &= bool((m.pair_solimp[:, 0] == m.pair_solimp[:, 1]).all()) and not m.pair_margin.any()
    constant &= not m.pair_solreffriction.any() and not m.opt.enableflags & mujoco.mjtEnableBit.mjENBL_OVERRIDE
    contacts = "constant impedance" if constant else "other impedance, margin or friction"
    wind = int(m.opt.wind.any() and (m.opt.density > 0 or m.opt.viscosity > 0))
    parts = (
        _Part("bodies that translate", len(movable) - turning, _NONE),
        _Part("bodies that turn", turning, _TURNING),
        _Part("joint springs", int((m.jnt_stiffness[joints] != 0).sum()), _NONE),
        _Part("springs and dampers with negative constants", sum(int((c < 0).sum()) for c in constants), _SHELL),
        _Part("springs and dampers that are not linear", sum(int((c != 0).any(axis=1).sum()) for c in higher), _SHELL),
        _Part("springs that yield", yielding, _SHELL),
        _Part("tendons", m.ntendon, _SMALL),
        _Part("friction losses", rubbing, _ROW),
        _Part("joint limits", len(limited), _BOUNDED if constant_limits else _VARYING),
        _Part(f"geoms in contact, {contacts}", int(solid.sum()), _BOUNDED if constant else _VARYING),
        _Part("equality constraints", m.neq, _SMALL),
        _Part("soft bodies", m.nflex, _SMALL),
        _Part("actuators", m.nu, _SHELL),
        _Part("motion capture", m.nmocap, _SHELL),
        _Part("plugins", m.nplugin, _SHELL),
        _Part("wind", wind, _SHELL),
    )
    return [part for part in parts if part.count]
