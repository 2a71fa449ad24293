"""Many humans for the same devices: one compiled scene, and a row of its parameters for each of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from models.device import CompliantDevice, Device
from models.human import Cross, Human, Link, Person, check_holds

# ----------------------------------------------------------------------------------------------------
# Devices and humans as one MuJoCo model, and the same plant as matrices, read from that model.
#
# The only place that knows joint names. Every body slides along x. Joints come in the order motors, handles (of
# compliant devices), further masses of the humans, bodies, so that the first m positions are the encoders':
#
#     actuator (-f) -> motor_i ==transmission== handle_i (with the human's first mass) ==link== human_i_2 == ...
#
# The last link of a human ends on ground, or on the body of a person who holds several devices (the last joints).
# Gravity, contacts and constraints are off, but for the Coulomb friction of devices that have some. Inputs are MuJoCo
# actuators: first the outside forces (voluntary motion and taps), then one motor per device with gear -1, because the
# device feels -f.


Array = NDArray[np.floating[Any]]

#: MuJoCo's friction constraint creeps while it sticks; this hard it stops a 0.25 kg device within 1.5e-6 m of where
#: Coulomb's law does, and creeps at 1e-7 m/s under half its force (MuJoCo's defaults: 7e-5 m and 6e-4 m/s)
STICK, HARD = [3e-3, 1.0], [0.9999, 0.9999, 0.001, 0.5, 2.0]


@dataclass(frozen=True, eq=False)
class Scene:
    """A compiled model and where the loop's signals are in it."""

    model: mujoco.MjModel
    xml: str
    handles: tuple[int, ...]  # (m,) joint of each handle
    pushed: tuple[int, ...]  # (m,) outside input that reaches the end of each human (voluntary force)
    tapped: tuple[int, ...]  # (m,) outside input that reaches each handle
    masses: tuple[tuple[int, ...], ...]  # (m, links) joint that each mass of a human moves on
    springs: tuple[tuple[int, ...], ...]  # (m, links - 1) tendon behind each mass but the last, whose is the joint's;
    # (m, links) where a body is behind the last
    bodies: tuple[int, ...]  # (persons,) joint of each body
    crossings: tuple[tuple[int, ...], ...]  # (persons, hands - 1) tendons from hand to hand

    @property
    def channels(self) -> int:
        return len(self.handles)

    @property
    def outside(self) -> int:
        """Number of outside inputs: the actuators before the motors."""
        return int(self.model.nu) - self.channels


@dataclass(frozen=True, eq=False)
class Plant:
    """x' = A x + B u, y = C x with x = [positions; velocities], u = [outside forces; f], y = encoder positions."""

    A: Array  # (2n, 2n)
    B: Array  # (2n, outside + m)
    C: Array  # (m, 2n)


def build(devices: Sequence[Device], humans: Sequence[Human], persons: Sequence[Person] = ()) -> Scene:
    """One scene of devices, each held by its human; `persons` are those who hold several.

    Raises ValueError where the numbers of devices and humans differ, or a device is held twice.
    """
    if len(devices) != len(humans) or not devices:
        raise ValueError(f"{len(devices)} devices and {len(humans)} humans: each device needs one human")
    check_holds(persons, len(devices))
    spec = mujoco.MjSpec()
    spec.modelname = "haptic loop"
    _only_what_the_loop_needs(spec, friction=any(device.friction for device in devices))
    body = {channel: f"body_{p}" for p, person in enumerate(persons, start=1) for channel in person.holds}
    parts = list(enumerate(zip(devices, humans, strict=True), start=1))
    chains = [_chain(i, device, human, body.get(i)) for i, (device, human) in parts]
    _add_masses(spec, devices, humans, persons)
    for (_, (device, human)), (i, chain) in zip(parts, enumerate(chains, start=1), strict=True):
        _add_springs(spec, i, device, human, chain)

    handles = [_handle(i, device) for i, device in enumerate(devices, start=1)]
    crossings = [_add_crossings(spec, p, person, handles) for p, person in enumerate(persons, start=1)]
    # a voluntary force acts on the last mass, and back on the body that the arm ends on
    ends = [c.tendons[-1] if i in body else c.joints[-1] for i, c in enumerate(chains, start=1)]
    reached = list(dict.fromkeys((*handles, *ends)))
    for name in reached:
        _add_motor(spec, f"push_{name}", name, gear=-1.0 if name.startswith("link") else 1.0)
    for i, device in enumerate(devices, start=1):
        _add_motor(spec, f"force_{i}", f"motor_{i}", gear=-1.0, limit=device.force_limit)
    model = spec.compile()
    return Scene(
        model=model,
        xml=spec.to_xml(),
        handles=tuple(model.joint(name).id for name in handles),
        pushed=tuple(reached.index(name) for name in ends),
        tapped=tuple(reached.index(name) for name in handles),
        masses=tuple(
            tuple(model.joint(name).id for name in c.joints if name != body.get(i))
            for i, c in enumerate(chains, start=1)
        ),
        springs=tuple(tuple(model.tendon(name).id for name in c.tendons) for c in chains),
        bodies=tuple(model.joint(f"body_{p}").id for p in range(1, len(persons) + 1)),
        crossings=tuple(tuple(model.tendon(name).id for name in names) for names in crossings),
    )


def plant(model: mujoco.MjModel) -> Plant:
    """The linear plant that `model` simulates: its mass, damping, stiffness and actuation matrices, no friction."""
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    n, m = model.nv, _motors(model)
    mass = np.zeros((n, n))
    mujoco.mj_fullM(model, data, mass)
    inverse = np.linalg.inv(mass)
    across = tendon_jacobian(model)
    stiffness = np.diag(model.jnt_stiffness.astype(float)) + across.T * model.tendon_stiffness @ across
    damping = np.diag(model.dof_damping) + across.T * model.tendon_damping @ across
    forces = actuation(model)
    A = np.block([[np.zeros((n, n)), np.eye(n)], [-inverse @ stiffness, -inverse @ damping]])
    B = np.vstack([np.zeros_like(forces), inverse @ forces])
    return Plant(A, B, np.eye(m, 2 * n))


def tendon_jacobian(model: mujoco.MjModel) -> Array:
    """How each tendon lengthens when a joint moves, shape (tendons, n)."""
    rows = np.zeros((model.ntendon, model.nv))
    for t in range(model.ntendon):
        first, count = int(model.tendon_adr[t]), int(model.tendon_num[t])
        for wrap in range(first, first + count):
            rows[t, model.wrap_objid[wrap]] += model.wrap_prm[wrap]
    return rows


def actuation(model: mujoco.MjModel) -> Array:
    """Force on each joint per unit of each input, shape (n, outside + m)."""
    columns, across = np.zeros((model.nv, model.nu)), tendon_jacobian(model)
    for a in range(model.nu):
        target, gain = model.actuator_trnid[a, 0], model.actuator_gear[a, 0] * model.actuator_gainprm[a, 0]
        if model.actuator_trntype[a] == mujoco.mjtTrn.mjTRN_TENDON:
            columns[:, a] = gain * across[target]
        else:
            columns[target, a] = gain
    return columns


def _only_what_the_loop_needs(spec: mujoco.MjSpec, friction: bool) -> None:
    off = mujoco.mjtDisableBit
    disabled = [off.mjDSBL_CONTACT, off.mjDSBL_AUTORESET, off.mjDSBL_SENSOR]
    if not friction:  # MuJoCo's Coulomb friction is a constraint
        disabled.append(off.mjDSBL_CONSTRAINT)
    spec.option.gravity = [0, 0, 0]
    spec.option.disableflags = sum(int(flag) for flag in disabled)


def _handle(i: int, device: Device) -> str:
    return f"handle_{i}" if isinstance(device, CompliantDevice) else f"motor_{i}"


def _add_masses(
    spec: mujoco.MjSpec, devices: Sequence[Device], humans: Sequence[Human], persons: Sequence[Person]
) -> None:
    """Masses in the order motors, handles, human masses, bodies, with what joins them to ground."""
    motors, handles, arms = [], [], []
    grounded: dict[str, tuple[float, float]] = {}  # damping and stiffness
    held = {channel for person in persons for channel in person.holds}
    rubbing: dict[str, float] = {}
    for i, (device, human) in enumerate(zip(devices, humans, strict=True), start=1):
        first = human.links[0].mass
        if isinstance(device, CompliantDevice):
            motors.append((f"motor_{i}", device.motor_mass, device.damping))
            handles.append((f"handle_{i}", device.handle_mass + first, 0.0))
        else:
            motors.append((f"motor_{i}", device.mass + first, device.damping))
        rubbing[f"motor_{i}"] = device.friction
        arms += [(f"human_{i}_{j}", link.mass, 0.0) for j, link in enumerate(human.links[1:], start=2)]
        if i not in held:
            grounded[_chain(i, device, human).joints[-1]] = human.links[-1].damping, human.links[-1].stiffness
    bodies = [(f"body_{p}", person.mass, 0.0) for p, person in enumerate(persons, start=1)]
    grounded |= {name: (p.damping, p.stiffness) for (name, *_), p in zip(bodies, persons, strict=True)}
    for name, mass, damping in (*motors, *handles, *arms, *bodies):
        body = spec.worldbody.add_body(name=name, mass=mass, ipos=[0, 0, 0], inertia=[1e-3] * 3, explicitinertial=True)
        joint = body.add_joint(name=name, type=mujoco.mjtJoint.mjJNT_SLIDE, axis=[1, 0, 0])
        joint.damping[0] = damping
        if rubbing.get(name):
            joint.frictionloss = rubbing[name]
            joint.solref_friction, joint.solimp_friction = STICK, HARD
        if name in grounded:
            joint.damping[0] += grounded[name][0]
            joint.stiffness[0] = grounded[name][1]


def _add_springs(spec: mujoco.MjSpec, i: int, device: Device, human: Human, chain: _Chain) -> None:
    """The transmission and the links between the masses of one human, as fixed tendons."""
    if isinstance(device, CompliantDevice):
        stiffness, damping = device.transmission_stiffness, device.transmission_damping
        _add_spring(spec, f"transmission_{i}", f"motor_{i}", f"handle_{i}", stiffness, damping)
    for j, (name, link) in enumerate(zip(chain.tendons, human.links, strict=False)):
        _add_spring(spec, name, chain.joints[j], chain.joints[j + 1], link.stiffness, link.damping)


def _add_crossings(spec: mujoco.MjSpec, p: int, person: Person, handles: Sequence[str]) -> list[str]:
    """The springs from hand to hand; returns their names."""
    names = []
    for a, b in pairwise(person.holds):
        names.append(f"cross_{p}_{a}_{b}")
        _add_spring(spec, names[-1], handles[a - 1], handles[b - 1], person.cross.stiffness, person.cross.damping)
    return names


class _Chain(NamedTuple):
    """The joints of a human's masses, with the body that they end on, and the tendons between them."""

    joints: list[str]
    tendons: list[str]


def _chain(i: int, device: Device, human: Human, body: str | None = None) -> _Chain:
    links = len(human.links)
    joints = [_handle(i, device), *(f"human_{i}_{j}" for j in range(2, links + 1))]
    if body:
        joints.append(body)
    return _Chain(joints, [f"link_{i}_{j}" for j in range(1, len(joints))])


def _add_spring(spec: mujoco.MjSpec, name: str, a: str, b: str, stiffness: float, damping: float) -> None:
    tendon = spec.add_tendon(name=name)
    # entry 0 is the linear term; MuJoCo also knows two nonlinear ones
    tendon.stiffness[0], tendon.damping[0] = stiffness, damping
    tendon.springlength = [0, 0]
    tendon.wrap_joint(b, 1.0)
    tendon.wrap_joint(a, -1.0)


def _add_motor(spec: mujoco.MjSpec, name: str, target: str, gear: float, limit: float | None = None) -> None:
    kind = mujoco.mjtTrn.mjTRN_TENDON if target.startswith("link") else mujoco.mjtTrn.mjTRN_JOINT
    motor = spec.add_actuator(name=name, target=target, trntype=kind)
    motor.set_to_motor()
    motor.gear = [gear, 0, 0, 0, 0, 0]
    if limit is not None:
        motor.ctrllimited, motor.ctrlrange = True, [-limit, limit]


def _motors(model: mujoco.MjModel) -> int:
    return sum(model.actuator(a).name.startswith("force_") for a in range(model.nu))


@dataclass(frozen=True, eq=False)
class Crowd:
    """Sets of humans, one per device, all with the same number of links. They have no voluntary motion.

    `holds` says which channels' humans are arms of one person, whose body and cross spring are in `bodies`.
    """

    links: Array  # (nsim, m, links, 3): mass [kg], damping [N s/m], stiffness [N/m]
    holds: tuple[tuple[int, ...], ...] = ()  # (persons,) channels, counted from 1
    bodies: Array = field(default_factory=lambda: np.zeros((0, 0, 5)))
    # (nsim, persons, 5): mass, damping, stiffness as above, damping and stiffness from hand to hand

    def __post_init__(self) -> None:
        links = np.array(self.links, dtype=float)
        if links.ndim != 4 or links.shape[-1] != 3 or 0 in links.shape[1:]:
            raise ValueError(f"links has the shape {links.shape}, expected (sets, devices, links, 3)")
        if not ((links >= 0) & (links < np.inf)).all():
            raise ValueError("links has a negative or infinite entry: such a human is not passive")
        bodies = np.array(self.bodies, dtype=float) if self.holds else np.zeros((len(links), 0, 5))
        if bodies.shape != (len(links), len(self.holds), 5):
            raise ValueError(f"bodies has the shape {bodies.shape}, expected {(len(links), len(self.holds), 5)}")
        if not ((bodies >= 0) & (bodies < np.inf)).all() or not (bodies[..., 0] > 0).all():
            raise ValueError("bodies has a negative, infinite or massless entry: such a person is not passive")
        for name, values in (("links", links), ("bodies", bodies)):
            values.setflags(write=False)
            object.__setattr__(self, name, values)

    def __len__(self) -> int:
        return self.links.shape[0]

    def humans(self, i: int) -> tuple[Human, ...]:
        """Set i, one human per device."""
        return tuple(Human(tuple(Link(*link) for link in human)) for human in self.links[i].tolist())

    def persons(self, i: int) -> tuple[Person, ...]:
        """Set i, those who hold several devices."""
        pairs = zip(self.holds, self.bodies[i].tolist(), strict=True)
        return tuple(Person(holds, m, b, k, Cross(*cross)) for holds, (m, b, k, *cross) in pairs)


@dataclass(frozen=True, eq=False)
class Variants:
    """The fields in which the models of a crowd differ, by MuJoCo's names, with one row per set of humans."""

    scene: Scene
    fields: dict[str, Array]  # (nsim, bodies | joints | tendons)

    def __len__(self) -> int:
        return self.fields["body_mass"].shape[0]

    def repeated(self, times: int) -> dict[str, Array]:
        """The fields with every row `times` times in succession."""
        return {name: np.repeat(rows, times, axis=0) for name, rows in self.fields.items()}

    def plants(self) -> Plant:
        """All plants at once, A (nsim, 2n, 2n) and B (nsim, 2n, inputs): the same matrices as of each one's model."""
        model = self.scene.model
        n, across, forces = model.nv, tendon_jacobian(model), actuation(model)
        mass = self.fields["body_mass"][:, model.jnt_bodyid, None]
        A = np.zeros((len(self), 2 * n, 2 * n))
        A[:, :n, n:] = np.eye(n)
        for column, joint, tendon in ((0, "jnt_stiffness", "tendon_stiffness"), (n, "dof_damping", "tendon_damping")):
            between = across.T * self.fields[tendon][:, None, :] @ across
            A[:, n:, column : column + n] = -(between + self.fields[joint][:, :, None] * np.eye(n)) / mass
        B = np.zeros((len(self), 2 * n, forces.shape[1]))
        B[:, n:] = forces / mass
        return Plant(A, B, plant(model).C)


def variants(devices: Sequence[Device], crowd: Crowd) -> Variants:
    """The devices in the hands of every set of humans. Raises ValueError where their numbers differ."""
    nsim, m, links, _ = crowd.links.shape
    # a hand without mass, damping or stiffness leaves the devices' own parameters; further masses cannot be zero
    nobody = Human((Link(0, 0, 0), *(Link(1, 0, 0) for _ in range(links - 1))))
    scene = build(devices, [nobody] * m, [Person(holds, 1, 0, 0) for holds in crowd.holds])
    model = scene.model
    names = ("body_mass", "jnt_stiffness", "dof_damping", "tendon_stiffness", "tendon_damping")
    fields = {name: np.tile(getattr(model, name).astype(float), (nsim, 1)) for name in names}
    for i, (joints, tendons) in enumerate(zip(scene.masses, scene.springs, strict=True)):
        mass, damping, stiffness = np.moveaxis(crowd.links[:, i], -1, 0)  # (nsim, links) each
        bodies = model.jnt_bodyid[list(joints)]
        fields["body_mass"][:, bodies[0]] += mass[:, 0]
        fields["body_mass"][:, bodies[1:]] = mass[:, 1:]
        if len(tendons) < links:  # the last link ends on ground
            fields["dof_damping"][:, joints[-1]] += damping[:, -1]
            fields["jnt_stiffness"][:, joints[-1]] = stiffness[:, -1]
        fields["tendon_damping"][:, list(tendons)] = damping[:, : len(tendons)]
        fields["tendon_stiffness"][:, list(tendons)] = stiffness[:, : len(tendons)]
    for p, (joint, crossings) in enumerate(zip(scene.bodies, scene.crossings, strict=True)):
        mass, damping, stiffness, cross_damping, cross_stiffness = crowd.bodies[:, p].T
        fields["body_mass"][:, model.jnt_bodyid[joint]] = mass
        fields["dof_damping"][:, joint], fields["jnt_stiffness"][:, joint] = damping, stiffness
        fields["tendon_damping"][:, list(crossings)] = cross_damping[:, None]
        fields["tendon_stiffness"][:, list(crossings)] = cross_stiffness[:, None]
    return Variants(scene, fields)
