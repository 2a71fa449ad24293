"""Devices with the humans who hold them: one MuJoCo scene, the plant's matrices, and a model for each set of humans."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache, cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from haptic_loop.models.device import AXES, Device, Mechanics
from haptic_loop.models.human import (
    Cross,
    Hand,
    Human,
    Impedance,
    Link,
    Person,
    Population,
    Port,
    check_holds,
    directions,
)

if TYPE_CHECKING:  # MuJoCo takes a third of a second to import; functions import it when they need it
    import mujoco

# ----------------------------------------------------------------------------------------------------
# Devices and humans as one MuJoCo model, and the same plant as matrices, read from that model.
#
# Only this file uses the names of joints. A body slides along x, or along the free axes of its device; then its joints
# are called motor.x, motor.y and so on. The order of the joints is motors, handles of compliant devices, further masses
# of the humans, bodies of persons. The encoders measure the first m positions. One device and its human:
#
#     actuator (-f) -> motor ==transmission== handle (with the human's first mass) ==link== human_i_2 == ...
#
# Motor, handle and transmission come from compliant.xml or rigid.xml and get the prefix device_i/. The scene's XML
# contains shapes that are only drawn; the simulated model does not.
#
# The last link of a human ends on ground, or on the body of a person who holds several devices.
# Gravity, contacts and constraints are off, except for the Coulomb friction of devices. The inputs are MuJoCo
# actuators: first the external forces (voluntary motion and taps), then one motor per channel with gear -1, because
# the device feels -f.
#
# A spring-damper that stretches with one joint alone becomes a property of this joint; every other one becomes
# a fixed tendon. An impedance (A, B, C, D) has no body: it is stored in the model's custom numbers, where `plant` reads
# it, and the engines integrate its state.


_Array = NDArray[np.floating[Any]]

#: solref and solimp of the motors' friction. In MuJoCo a device creeps although friction holds it: 0.25 kg with 0.3 N
#: of friction and a push of 0.15 N creep at 1e-7 m/s with these numbers, and at 6e-4 m/s with the defaults of MuJoCo.
_STICK, _HARD = [3e-3, 1.0], [0.9999, 0.9999, 0.001, 0.5, 2.0]
_FILES = Path(__file__).parent  # folder of the devices' MJCF
APART, STEP, _HEIGHT = 0.11, 0.09, 0.03  # [m] distances of devices and of bodies of one device; height of bodies
DRAWN = "drawn transmission"  # end of the names of tendons that are only drawn
_SKY: dict[str, Any] = {"name": "sky", "width": 32, "height": 192, "rgb1": [0.93] * 3, "rgb2": [0.93] * 3}
_EMPTY_CLASSES = re.compile(r" *<default>\s*(<default class=\"[^\"]*\"/>\s*)*</default>\s*\n")  # left by attached files
_FORCE = "/force"  # part of the names of the motors' actuators
#: Custom numbers with this prefix describe an impedance: the joint of the handle, the joint of the base (-1: none),
#: then the rows of [[A, B], [C, D]].
_IMPEDANCE = "impedance_"


@dataclass(frozen=True, eq=False)
class Scene:
    """A compiled model and the places of the loop's signals in it."""

    model: mujoco.MjModel
    xml: str
    handles: tuple[int, ...]  # (m,) joint of each handle, on each of its axes
    pushed: tuple[int, ...]  # (m,) external input that acts on the end of each human (voluntary force)
    tapped: tuple[int, ...]  # (m,) external input that acts on each handle
    points: tuple[tuple[int, ...], ...]  # (devices + persons,) joints of each port's points, the handles first
    devices: tuple[int, ...]  # (m,) the device of each channel, counted from 0

    @property
    def channels(self) -> int:
        return len(self.handles)

    @property
    def outside(self) -> int:
        """The number of external inputs: the actuators before the motors."""
        return int(self.model.nu) - self.channels

    @cached_property
    def plant(self) -> Plant:
        """The linear plant of the model (see `plant`)."""
        return plant(self.model)


@dataclass(frozen=True, eq=False)
class Plant:
    """The plant s' = A s + B [external forces; f], x = C s; s = [positions; velocities; states of the impedances]."""

    A: _Array  # (2n + states, 2n + states)
    B: _Array  # (2n + states, outside + m)
    C: _Array  # (m, 2n + states)
    felt: _Array | None = None  # the impedances' part of A, which MuJoCo does not simulate; None without impedances


@contextmanager
def quiet_warnings() -> Iterator[None]:
    """Suppress MuJoCo's warnings on the screen and in a file, because reports state them."""
    import mujoco

    previous = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda message: None)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(previous)


def build(devices: Sequence[Device], humans: Sequence[Hand], persons: Sequence[Person] = ()) -> Scene:
    """Build one scene of devices, each held by its human. `persons` hold several devices.

    Raises:
        ValueError: There are more or fewer humans than devices, a human has other axes than the device or several
            handles, or a person holds a device that does not exist, is held by another person, or has other axes.
    """
    held = tuple((person.holds, person.port()) for person in persons)
    return _compiled(devices, _placed(devices, tuple(human.port() for human in humans), held))


def plant(model: mujoco.MjModel) -> Plant:
    """Return the linear plant of `model`: without friction, but with the impedances that MuJoCo does not simulate."""
    import mujoco

    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    mass = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, mass)
    across = _tendon_jacobian(model)
    stiffness = np.diag(model.jnt_stiffness.astype(float)) + across.T * model.tendon_stiffness @ across
    damping = np.diag(model.dof_damping) + across.T * model.tendon_damping @ across
    inverse = np.linalg.inv(mass)
    return _plant(
        lambda matrix: inverse @ matrix, stiffness, damping, _actuation(model), _motors(model), _impedances(model)
    )


class _Felt(NamedTuple):
    """An impedance between joints: its input is `row` times the joint velocities, and its force acts along -`row`."""

    row: _Array  # (n,)
    Z: Impedance


def _plant(
    solved: Callable[[_Array], _Array], K: _Array, D: _Array, forces: _Array, motors: int, felt: Sequence[_Felt]
) -> Plant:
    """Return the plant M q'' = -K q - D q' + forces u with the impedances; `solved` multiplies by M^-1."""
    *many, n, _ = K.shape
    size = 2 * n + sum(z.order for _, z in felt)
    A, B = np.zeros((*many, size, size)), np.zeros((*many, size, forces.shape[-1]))
    A[..., :n, n : 2 * n] = np.eye(n)
    A[..., n : 2 * n, :n], A[..., n : 2 * n, n : 2 * n] = -solved(K), -solved(D)
    B[..., n : 2 * n, :] = solved(forces)
    if not felt:
        return Plant(A, B, np.eye(motors, size))
    added, first = np.zeros_like(A), 2 * n
    for row, z in felt:
        mine = slice(first, first + z.order)
        added[..., n : 2 * n, n : 2 * n] -= solved(np.outer(row, row) * z.D)
        added[..., mine, n : 2 * n] = z.B * row
        added[..., mine, mine] = z.A
        added[..., n : 2 * n, mine] = -solved(row[:, None] * z.C)
        first += z.order
    return Plant(A + added, B, np.eye(motors, size), added)


def _impedances(model: mujoco.MjModel) -> list[_Felt]:
    felt = []
    for i in range(model.nnumeric):
        first, size = int(model.numeric_adr[i]), int(model.numeric_size[i])
        if model.numeric(i).name.startswith(_IMPEDANCE):
            (handle, base), numbers = model.numeric_data[first : first + 2].astype(int), model.numeric_data[first + 2 :]
            n = math.isqrt(size - 2) - 1  # (n + 1)^2 numbers
            matrix = numbers[: (n + 1) ** 2].reshape(n + 1, n + 1)
            row = np.zeros(model.nv)
            row[handle] = 1.0
            if base >= 0:
                row[base] = -1.0
            felt.append(_Felt(row, Impedance(matrix[:n, :n], matrix[:n, n:], matrix[n:, :n], matrix[n:, n:])))
    return felt


def from_mjcf(xml: str, handle: str = "handle", pull: str | None = None) -> Port:
    """Return the port of a hand written in MJCF: bodies that slide along x, with springs and dampers between them.

    The body `handle` is the part of the hand that moves with the handle, and the world is the base. The voluntary force
    contracts the joint or tendon named `pull`, by default the last spring-damper. Gravity and collisions are ignored.

    Raises:
        ValueError: The model is not a network of masses, springs and dampers along x, or `handle` or `pull` is missing.
    """
    import mujoco

    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    _check_linear(model, data)
    names = [model.body(b).name for b in model.jnt_bodyid]
    if handle not in names:
        raise ValueError(f"MJCF of a hand: no body {handle!r} that slides; there are {', '.join(map(repr, names))}")
    order = sorted(range(model.njnt), key=lambda j: names[j] != handle)
    point = {int(model.jnt_bodyid[j]): k for k, j in enumerate(order)} | {0: model.njnt}
    mass = np.zeros(model.njnt + 1)
    np.add.at(mass, [point[int(b)] for b in model.body_weldid], model.body_mass)
    slides = np.zeros((model.njnt, model.njnt + 1))  # joint positions = slides @ positions of the points and the base
    for j, b in enumerate(model.jnt_bodyid):
        slides[j, point[int(b)]] = 1.0
        slides[j, point[int(model.body_weldid[model.body_parentid[b]])]] = -1.0
    across = np.vstack([slides, _tendon_jacobian(model) @ slides])
    damping = np.concatenate([model.dof_damping, model.tendon_damping])
    stiffness = np.concatenate([model.jnt_stiffness, model.tendon_stiffness])
    labels = [*(model.joint(j).name for j in range(model.njnt)), *(model.tendon(t).name for t in range(model.ntendon))]
    if pull is not None and pull not in labels:
        raise ValueError(f"MJCF of a hand: no joint or tendon {pull!r}; there are {', '.join(map(repr, labels))}")
    there = [i for i, label in enumerate(labels) if damping[i] or stiffness[i] or label == pull]
    if not there:
        raise ValueError("MJCF of a hand: it has no spring and no damper")
    end = -1 if pull is None else there.index(labels.index(pull))
    return Port(mass[:-1], across[there], damping[there], stiffness[there], pull=end)


def _check_linear(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    """Raise ValueError unless the model is a network of masses, springs and dampers along x, at rest."""
    import mujoco

    slide, fixed = mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtWrap.mjWRAP_JOINT
    rubbing = ("dof_frictionloss", "tendon_frictionloss", "dof_armature", "tendon_armature")
    curved = ("jnt_stiffnesspoly", "tendon_stiffnesspoly", "dof_dampingpoly", "tendon_dampingpoly")
    unsupported = {
        "a joint that does not slide along x": (model.jnt_type != slide).any()
        or not np.allclose(data.xaxis, [1.0, 0.0, 0.0]),
        "several joints in one body": len(set(model.jnt_bodyid)) < model.njnt,
        "a limit": model.jnt_limited.any() or model.tendon_limited.any(),
        "friction or armature": any(getattr(model, name).any() for name in rubbing),
        "a nonlinear spring or damper": any(getattr(model, name).any() for name in curved),
        "an actuator or a constraint": bool(model.nu or model.neq),
        "a tendon that is not fixed": (model.wrap_type != fixed).any(),
        "a spring that is not at rest": model.qpos_spring.any() or model.qpos0.any() or model.tendon_lengthspring.any(),
    }
    for part, present in unsupported.items():
        if present:
            raise ValueError(f"MJCF of a hand: it has {part}, expected masses, springs and dampers along x, at rest")


def _tendon_jacobian(model: mujoco.MjModel) -> _Array:
    """Return the derivatives of the tendons' lengths with respect to the joint positions, shape (tendons, n)."""
    import mujoco

    rows = np.zeros((model.ntendon, model.nv))
    for t in range(model.ntendon):
        first, count = int(model.tendon_adr[t]), int(model.tendon_num[t])
        for wrap in range(first, first + count):
            if model.wrap_type[wrap] == mujoco.mjtWrap.mjWRAP_JOINT:  # skip tendons that are only drawn
                rows[t, model.wrap_objid[wrap]] += model.wrap_prm[wrap]
    return rows


def _actuation(model: mujoco.MjModel) -> _Array:
    """Return the force on each joint per unit of each input, shape (n, external + m)."""
    import mujoco

    columns, across = np.zeros((model.nv, model.nu)), _tendon_jacobian(model)
    for a in range(model.nu):
        target, gain = model.actuator_trnid[a, 0], model.actuator_gear[a, 0] * model.actuator_gainprm[a, 0]
        if model.actuator_trntype[a] == mujoco.mjtTrn.mjTRN_TENDON:
            columns[:, a] = gain * across[target]
        else:
            columns[target, a] = gain
    return columns


def _disable_unused_physics(spec: mujoco.MjSpec, friction: bool) -> None:
    import mujoco

    off = mujoco.mjtDisableBit
    disabled = [off.mjDSBL_CONTACT, off.mjDSBL_AUTORESET, off.mjDSBL_SENSOR]
    if not friction:  # MuJoCo's Coulomb friction is a constraint
        disabled.append(off.mjDSBL_CONSTRAINT)
    spec.option.gravity = [0, 0, 0]
    spec.option.disableflags = sum(int(flag) for flag in disabled)


def _joints(body: str, device: Device) -> tuple[str, ...]:
    """Return the names of a body's joints, one per free axis; with one axis the joint has the name of the body."""
    return tuple(body + axis for axis in device.axis_names)


def _body(joint: str) -> str:
    return joint.partition(".")[0]


def _handle(i: int, device: Device) -> tuple[str, ...]:
    return _joints(f"device_{i}/{list(device.bodies)[-1]}", device)


class _Placed(NamedTuple):
    """A port and the joints and tendons that represent it in the scene."""

    port: Port
    joints: tuple[str, ...]  # joint of each coordinate of the points
    base: tuple[str, ...]  # joints of the body on which the port ends; none for ground
    springs: tuple[str, ...]  # the tendon or joint that carries each spring-damper

    @property
    def handles(self) -> int:
        """The number of joints that belong to handles; they come first."""
        return self.port.handles * self.port.axes


def _placed(
    devices: Sequence[Device], ports: Sequence[Port], held: Sequence[tuple[tuple[int, ...], Port]]
) -> tuple[_Placed, ...]:
    """Return the placed ports of all devices, then those of `held`.

    Raises ValueError if the numbers or axes of humans and devices differ, if a human has several handles, or if a
    person holds a device that does not exist, is held by another person, or has other axes.
    """
    if len(devices) != len(ports) or not devices:
        raise ValueError(f"{len(devices)} devices and {len(ports)} humans: each device needs one human")
    check_holds([holds for holds, _ in held], len(devices))
    handles = [_handle(i, device) for i, device in enumerate(devices, start=1)]
    body = {device: f"body_{p}" for p, (holds, _) in enumerate(held, start=1) for device in holds}
    placed = []
    for i, (port, device) in enumerate(zip(ports, devices, strict=True), start=1):
        try:
            port = port.in_space(len(device.free))
        except ValueError as error:
            raise ValueError(f"human #{i}: {error}") from None
        if port.handles > 1:
            raise ValueError(f"human #{i} has {port.handles} handles, expected one: a person holds several")
        own = (joint for j in range(2, port.mass.shape[-1] + 1) for joint in _joints(f"human_{i}_{j}", device))
        base = _joints(body[i], device) if i in body else ()
        placed.append(_place(port, (*handles[i - 1], *own), base, f"link_{i}"))
    for p, (holds, port) in enumerate(held, start=1):
        first = devices[holds[0] - 1]
        if any(devices[i - 1].axis_names != first.axis_names for i in holds):
            raise ValueError(f"person #{p}.holds is {list(holds)}: expected devices with the same free axes")
        port = port.in_space(len(first.free))
        hands = (joint for i in holds for joint in handles[i - 1])
        placed.append(_place(port, (*hands, *_joints(f"body_{p}", first)), (), f"cross_{p}"))
    return tuple(placed)


def _place(port: Port, joints: tuple[str, ...], base: tuple[str, ...], name: str) -> _Placed:
    ends = (*joints, *base)  # ground has no joint
    springs = []
    for j, row in enumerate(port.across, start=1):
        between = [joint for joint, c in zip(ends, row, strict=False) if c]
        springs.append(between[0] if len(between) == 1 and between[0] in joints else f"{name}_{j}")
    return _Placed(port, joints, base, tuple(springs))


class _Amounts(NamedTuple):
    """Masses, dampings and stiffnesses by the name of a joint or tendon: numbers, or arrays over the sets of humans."""

    mass: dict[str, Any]  # in the order motors, handles, other masses
    damping: dict[str, Any]
    stiffness: dict[str, Any]


#: The mechanics of every device in every set of humans; () if the devices keep the scenario's mechanics.
_Drawn = tuple[tuple[Mechanics, ...], ...]


def _mechanics(device: Device, drawn: Sequence[Mechanics]) -> tuple[dict[str, Any], tuple[Any, Any] | None]:
    """Return bodies and transmission of a device, as arrays over the sets if the mechanics are random."""
    if not drawn:
        return dict(device.bodies), device.transmission
    rows = [(d.motor_mass, d.handle_mass, d.transmission_damping, d.transmission_stiffness) for d in drawn]
    motor, handle, damping, stiffness = np.array(rows).T
    return {"motor": motor, "handle": handle}, (damping, stiffness)


def _amounts(devices: Sequence[Device], placed: Sequence[_Placed], drawn: _Drawn = ()) -> _Amounts:
    """Sum masses, dampings and stiffnesses per joint and tendon, without the dampers between a device's axes."""
    mass: dict[str, Any] = {}
    damping: dict[str, Any] = {}
    stiffness: dict[str, Any] = {}
    for i, device in enumerate(devices, start=1):
        own, _ = _dampers(device)
        for motor, amount in zip(_joints(f"device_{i}/motor", device), own, strict=True):
            mass[motor], damping[motor], stiffness[motor] = 0.0, amount, 0.0
    for i, device in enumerate(devices, start=1):
        bodies, transmission = _mechanics(device, [row[i - 1] for row in drawn])
        for name, amount in bodies.items():
            mass |= dict.fromkeys(_joints(f"device_{i}/{name}", device), amount)
        if transmission:
            for between in _joints(f"device_{i}/transmission", device):
                damping[between], stiffness[between] = transmission
    for port, joints, _, springs in placed:
        for k, joint in enumerate(joints):
            mass[joint] = mass.get(joint, 0.0) + port.mass[..., k // port.axes]
        for r, name in enumerate(springs):
            lever = float(port.across[r, joints.index(name)]) ** 2 if name in joints else 1.0
            damping[name] = damping.get(name, 0.0) + lever * port.damping[..., r]
            stiffness[name] = stiffness.get(name, 0.0) + lever * port.stiffness[..., r]
    return _Amounts(mass, damping, stiffness)


def _dampers(device: Device) -> tuple[list[float], list[tuple[float, list[float]]]]:
    """Return a device's damping on each joint, and the dampers between its axes: amounts [N s/m] with directions."""
    if device.axes == 1:
        return [device.damping], []  # type: ignore[list-item]
    matrix = device.matrix("damping")
    if (matrix == np.diag(np.diag(matrix))).all():
        return np.diag(matrix).tolist(), []
    amounts, directions = np.linalg.eigh(matrix)
    return [0.0] * len(matrix), list(zip(amounts.tolist(), directions.T.tolist(), strict=True))


def _per_channel(device: Device, name: str) -> list[float]:
    return [getattr(channel, name) for channel in device.channels()]


def _compiled(devices: Sequence[Device], placed: Sequence[_Placed], with_xml: bool = True) -> Scene:
    """Compile the scene. Without `with_xml` its `xml` is empty, which saves half of the time."""
    import mujoco

    spec = mujoco.MjSpec()
    spec.modelname = "haptic loop"
    spec.add_texture(type=mujoco.mjtTexture.mjTEXTURE_SKYBOX, builtin=mujoco.mjtBuiltin.mjBUILTIN_FLAT, **_SKY)
    spec.visual.headlight.ambient = [0.5, 0.5, 0.5]
    _disable_unused_physics(spec, friction=any(np.any(device.friction) for device in devices))
    mass, damping, stiffness = _amounts(devices, placed)
    own = [joint for part in placed for joint in part.joints[part.handles :]]
    order = [name for name in mass if name not in own] + own
    _attach_devices(spec, devices)
    row = {joint: -APART * min(i, len(devices) - 1) for i, part in enumerate(placed) for joint in part.joints}
    _add_bodies(spec, own, row)
    for name in order:
        spec.body(_body(name)).mass, joint = float(mass[name]), spec.joint(name)
        joint.damping[0], joint.stiffness[0] = float(damping.get(name, 0.0)), float(stiffness.get(name, 0.0))
    for i, (device, part) in enumerate(zip(devices, placed, strict=False), start=1):
        _fill_device(spec, i, device)
        _add_springs(spec, part, damping, stiffness)
    for part in placed[len(devices) :]:
        _add_springs(spec, part, damping, stiffness)

    channels = placed[: len(devices)]
    handles = [joint for part in channels for joint in part.joints[: part.handles]]
    ends = [end for part in channels for end in _pulled(part)]
    reached = list(dict.fromkeys([*((name, 1.0) for name in handles), *ends]))
    for name, gear in reached:
        _add_motor(spec, f"push_{name}", name, gear, joint=name in mass)
    for i, device in enumerate(devices, start=1):
        for axis, limit in zip(device.axis_names, _per_channel(device, "force_limit"), strict=True):
            _add_motor(spec, f"device_{i}{_FORCE}{axis}", f"device_{i}/motor{axis}", gear=-1.0, limit=limit)
    number = {name: j for j, name in enumerate(order)}
    for i, (port, joints, base, _) in enumerate(channels, start=1):
        if z := port.impedance:
            numbers = np.block([[z.A, z.B], [z.C, z.D]]).ravel()
            for k, axis in enumerate(devices[i - 1].axis_names):
                places = [number[joints[k]], number[base[k]] if base else -1]
                spec.add_numeric(name=f"{_IMPEDANCE}{i}{axis}", data=[*places, *numbers], size=len(numbers) + 2)
    xml = ""
    if with_xml:
        spec.compile()
        xml = written(spec)
    for part in [*(tendon for tendon in spec.tendons if tendon.name.endswith(DRAWN)), *spec.sites]:
        spec.delete(part)
    spec.compiler.discardvisual = True
    model = spec.compile()
    return Scene(
        model=model,
        xml=xml,
        handles=tuple(model.joint(name).id for name in handles),
        pushed=tuple(reached.index(end) for end in ends),
        tapped=tuple(reached.index((name, 1.0)) for name in handles),
        points=tuple(tuple(model.joint(name).id for name in part.joints) for part in placed),
        devices=tuple(i for i, part in enumerate(channels) for _ in range(part.handles)),
    )


def written(spec: mujoco.MjSpec) -> str:
    """Return the MJCF of a compiled specification without the empty classes of attached files."""
    return _EMPTY_CLASSES.sub("", spec.to_xml())


def _axis(joint: str) -> list[float]:
    """Return the direction in which a joint slides: the axis after the dot in its name, or x."""
    _, _, axis = joint.partition(".")
    return [float(name == (axis or "x")) for name in AXES]


def _attach_devices(spec: mujoco.MjSpec, devices: Sequence[Device]) -> None:
    """Add the motors and handles of the devices' files, side by side: first all motors, then all handles."""
    parts = [_file(device.file).copy() for device in devices]
    for name in ("motor", "handle"):
        for i, part in enumerate(parts, start=1):
            if part.body(name):
                frame = spec.worldbody.add_frame(pos=[0.0, -APART * (i - 1), 0.0])
                frame.attach_body(part.body(name), prefix=f"device_{i}/")
    for i, device in enumerate(devices, start=1):
        if device.axes > 1:
            _free_axes(spec, i, device)


def _add_bodies(spec: mujoco.MjSpec, joints: Sequence[str], row: Mapping[str, float]) -> None:
    """Add the bodies of hands with these joints; `row` has the y coordinate [m] of each joint's device."""
    import mujoco

    for step, name in enumerate(dict.fromkeys(map(_body, joints)), start=1):
        own = [joint for joint in joints if _body(joint) == name]
        body = spec.worldbody.add_body(name=name, pos=[STEP * (1 + step), row[own[0]], _HEIGHT])
        body.ipos, body.inertia, body.explicitinertial = [0, 0, 0], [1e-3] * 3, True
        for joint in own:
            body.add_joint(name=joint, type=mujoco.mjtJoint.mjJNT_SLIDE, axis=_axis(joint))
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.02] * 3, mass=0, contype=0, conaffinity=0)


def _fill_device(spec: mujoco.MjSpec, i: int, device: Device) -> None:
    """Set friction, transmission and dampers of device i, whose file has been attached."""
    motors = _joints(f"device_{i}/motor", device)
    for name, friction in zip(motors, _per_channel(device, "friction"), strict=True):
        if friction:
            joint = spec.joint(name)
            joint.frictionloss = friction
            joint.solref_friction, joint.solimp_friction = _STICK, _HARD
    if device.transmission:
        for name in _joints(f"device_{i}/transmission", device):
            tendon = spec.tendon(name)
            tendon.damping[0], tendon.stiffness[0] = device.transmission
    for k, (amount, direction) in enumerate(_dampers(device)[1], start=1):
        ends = {joint: c for joint, c in zip(motors, direction, strict=True) if c}
        _add_spring(spec, f"device_{i}/damper_{k}", ends, 0.0, amount)


def _free_axes(spec: mujoco.MjSpec, i: int, device: Device) -> None:
    """Replace each slide along x of device i, and its transmission, by one slide or transmission per free axis."""
    import mujoco

    for name in device.bodies:
        body = spec.body(f"device_{i}/{name}")
        spec.delete(spec.joint(body.name))
        for joint in _joints(body.name, device):
            body.add_joint(name=joint, type=mujoco.mjtJoint.mjJNT_SLIDE, axis=_axis(joint))
    if device.transmission:
        spec.delete(spec.tendon(f"device_{i}/transmission"))
        damping, stiffness = device.transmission
        for axis in device.axis_names:
            ends = {f"device_{i}/handle{axis}": 1.0, f"device_{i}/motor{axis}": -1.0}
            _add_spring(spec, f"device_{i}/transmission{axis}", ends, stiffness, damping)


@cache
def _file(name: str) -> mujoco.MjSpec:
    """Read a device's file without its actuators: the scene adds them in its own order."""
    import mujoco

    spec = mujoco.MjSpec.from_file(str(_FILES / f"{name}.xml"))
    for actuator in list(spec.actuators):
        spec.delete(actuator)
    return spec


def _pulled(part: _Placed) -> list[tuple[str, float]]:
    """Return one (joint or tendon, gear) per axis, on which the voluntary force of a human acts."""
    pulled, port = [], part.port
    first = port.pull % (len(port.across) // port.axes) * port.axes
    for row in range(first, first + port.axes):
        name = part.springs[row]
        gear = -float(port.across[row, part.joints.index(name)]) if name in part.joints else -1.0
        pulled.append((name, gear))
    return pulled


def _add_springs(spec: mujoco.MjSpec, part: _Placed, damping: Mapping[str, Any], stiffness: Mapping[str, Any]) -> None:
    """Add the spring-dampers of a port that lie between joints, as fixed tendons."""
    for name, row in zip(part.springs, part.port.across, strict=True):
        if name not in part.joints:
            joints = (*part.joints, *part.base)
            ends = {joint: float(c) for joint, c in zip(joints, row, strict=False) if c}
            _add_spring(spec, name, ends, float(stiffness[name]), float(damping[name]))


def _add_spring(spec: mujoco.MjSpec, name: str, ends: Mapping[str, float], stiffness: float, damping: float) -> None:
    """Add a fixed tendon with a spring and a damper. `ends` maps joints to derivatives of the tendon's length."""
    tendon = spec.add_tendon(name=name)
    # Entry 0 is the linear coefficient; MuJoCo has two nonlinear ones as well.
    tendon.stiffness[0], tendon.damping[0] = stiffness, damping
    tendon.springlength = [0, 0]
    for joint, factor in sorted(ends.items(), key=lambda end: -end[1]):
        tendon.wrap_joint(joint, factor)


def _add_motor(
    spec: mujoco.MjSpec, name: str, target: str, gear: float, limit: float | None = None, joint: bool = True
) -> None:
    import mujoco

    kind = mujoco.mjtTrn.mjTRN_JOINT if joint else mujoco.mjtTrn.mjTRN_TENDON
    motor = spec.add_actuator(name=name, target=target, trntype=kind)
    motor.set_to_motor()
    motor.gear = [gear, 0, 0, 0, 0, 0]
    if limit is not None:
        motor.ctrllimited, motor.ctrlrange = True, [-limit, limit]


def _motors(model: mujoco.MjModel) -> int:
    return sum(_FORCE in model.actuator(a).name for a in range(model.nu))


@dataclass(frozen=True, eq=False)
class Crowd:
    """Sets of humans without voluntary motion, all with the same number of links; a set has one human per device.

    `holds` lists the devices of each person with several devices, and `bodies` the bodies and cross springs of these
    persons. A link with three numbers is the same in every direction. On a device with several axes a link may have a
    damping and a stiffness along each of `models.human.directions`.
    """

    links: _Array  # (nsim, devices, links, 3 or more): mass [kg], dampings [N s/m], stiffnesses [N/m]
    holds: tuple[tuple[int, ...], ...] = ()  # (persons,) devices, counted from 1
    bodies: _Array = field(default_factory=lambda: np.zeros((0, 0, 5)))
    # bodies: (nsim, persons, 5): mass, damping and stiffness of the body, damping and stiffness between the hands
    axes: tuple[int, ...] = ()  # (devices,) numbers of free axes, if a link has 1 + 2 max(axes)^2 numbers; else ()
    mechanics: _Drawn = ()  # (nsim, devices), or empty if all hands hold the scenario's devices

    def __post_init__(self) -> None:
        links = np.array(self.links, dtype=float)
        bodies = np.array(self.bodies, dtype=float) if self.holds else np.zeros((len(links), 0, 5))
        for name, values in (("links", links), ("bodies", bodies)):
            values.setflags(write=False)
            object.__setattr__(self, name, values)

    def __len__(self) -> int:
        return self.links.shape[0]

    @property
    def ports(self) -> tuple[Port, ...]:
        """One port per device, each with a leading axis over the sets."""
        axes = self.axes or (1,) * self.links.shape[1]
        return tuple(Port.chain(self.links[:, i, :, : 1 + 2 * k**2], k) for i, k in enumerate(axes))

    @property
    def held(self) -> tuple[tuple[tuple[int, ...], Port], ...]:
        """For each person with several devices: the devices, and the port with a leading axis over the sets."""
        return tuple((holds, Port.body(len(holds), self.bodies[:, p])) for p, holds in enumerate(self.holds))

    def humans(self, i: int) -> tuple[Human, ...]:
        """Return the humans of set i, one per device."""
        axes = self.axes or (1,) * self.links.shape[1]
        return tuple(Human(tuple(_link(row, k) for row in human)) for human, k in zip(self.links[i], axes, strict=True))

    def persons(self, i: int) -> tuple[Person, ...]:
        """Return the persons of set i who hold several devices."""
        pairs = zip(self.holds, self.bodies[i].tolist(), strict=True)
        return tuple(Person(holds, m, b, k, Cross(*cross)) for holds, (m, b, k, *cross) in pairs)


def _link(row: _Array, axes: int) -> Link:
    if axes == 1:
        return Link(*row[:3].tolist())
    along, count = directions(axes), axes**2
    amounts = row[1 : 1 + count], row[1 + count : 1 + 2 * count]
    damping, stiffness = ((along.T * amount @ along).tolist() for amount in amounts)
    return Link(float(row[0]), tuple(map(tuple, damping)), tuple(map(tuple, stiffness)))


MIXED = 0  # value of `links`: with equal probability every human of a set has one link, or every human has two


def draw(population: Population, devices: int, seed: int, index: int, links: int, axes: tuple[int, ...] = ()) -> _Array:
    """Draw the links (devices, links, 3 or more) of the humans with this index, one per device, as in Crowd.

    The links depend on this index only, not on the other indices that are drawn. With `links` = MIXED all humans have
    one link, or all have two. With `axes` a link has random amounts of damping and stiffness along `directions`. Each
    direction d has a weight w such that the sum of w d d' is the identity. So the damping and the stiffness in any
    direction lie within the population's ranges.
    """
    rng = np.random.default_rng(np.random.SeedSequence((seed, index)))
    count = int(rng.integers(1, 3)) if links == MIXED else links
    low, high = np.log([population.mass, population.damping, population.stiffness]).T
    if not axes:
        # Generator.uniform gives the same bits, but is three times slower, because it checks its bounds.
        return np.exp(low + (high - low) * rng.random((devices, count, 3)))
    drawn = np.zeros((devices, count, 1 + 2 * max(axes) ** 2))
    for i, k in enumerate(axes):
        # The sum of w d d' is I because e_i + e_j and e_i - e_j together give 2 (e_i e_i' + e_j e_j').
        weights = np.concatenate([[1.0], *[np.repeat([0.5 / k, 1.0 / k], [k * k - k, k])] * 2])
        which = np.repeat([0, 1, 2], [1, k * k, k * k])
        amounts = np.exp(rng.uniform(low[which], high[which], size=(count, which.size)))
        drawn[i, :, : which.size] = weights * amounts
    return drawn


def crowds(
    population: Population,
    devices: int,
    seed: int,
    indices: Iterable[int],
    links: int,
    holds: tuple[tuple[int, ...], ...] = (),
    axes: tuple[int, ...] = (),
    known: Sequence[Device] = (),
) -> Iterator[tuple[NDArray[np.intp], Crowd]]:
    """Yield the humans of these indices, grouped by their number of links, as (indices of the group, crowd).

    `holds` lists the devices of each person who holds several, and `axes` the free axes of each device, as in Crowd.
    `known` are devices whose masses and transmissions are drawn within their guaranteed bounds, if all have bounds.
    """
    drawn = {i: draw(population, devices, seed, i, links, axes) for i in indices}
    for count in sorted({values.shape[1] for values in drawn.values()}):
        group = [i for i, values in drawn.items() if values.shape[1] == count]
        bodies = np.stack([_draw_bodies(population, len(holds), seed, i) for i in group])
        mechanics = draw_mechanics(known, seed, group)
        yield np.array(group), Crowd(np.stack([drawn[i] for i in group]), holds, bodies, axes, mechanics)


def draw_mechanics(devices: Sequence[Device], seed: int, indices: Iterable[int]) -> _Drawn:
    """Draw devices within their guaranteed bounds for the humans of these indices; () unless all devices have bounds.

    The devices have a separate random stream, so that the humans do not depend on them.
    """
    if not (devices and all(device.guaranteed for device in devices)):
        return ()
    streams = (np.random.default_rng(np.random.SeedSequence((seed, i, 2))) for i in indices)
    return tuple(tuple(Mechanics.within(device, rng.uniform(-1, 1, 4)) for device in devices) for rng in streams)


def _draw_bodies(population: Population, persons: int, seed: int, index: int) -> _Array:
    """Draw the bodies (persons, 5) of the persons with this index who hold several devices, as in Crowd."""
    if not persons:
        return np.zeros((0, 5))
    rng = np.random.default_rng(np.random.SeedSequence((seed, index, 1)))
    ranges = (population.mass, population.damping, population.stiffness, population.damping, population.stiffness)
    low, high = np.log(ranges).T
    return np.exp(rng.uniform(low, high, size=(persons, 5)))


@dataclass(frozen=True, eq=False)
class HumanSets:
    """Sets of any humans, with the methods of Crowd. All sets have one structure and the same persons."""

    sets: tuple[tuple[Hand, ...], ...]  # (nsim, devices)
    people: tuple[Person, ...] = ()
    mechanics: _Drawn = ()  # (nsim, devices) as in Crowd

    def __len__(self) -> int:
        return len(self.sets)

    @property
    def ports(self) -> tuple[Port, ...]:
        """One port per device, with a leading axis over the sets. Raises ValueError if their structures differ."""
        return tuple(Port.stack([human.port() for human in column]) for column in zip(*self.sets, strict=True))

    @property
    def held(self) -> tuple[tuple[tuple[int, ...], Port], ...]:
        return tuple((person.holds, Port.stack([person.port()] * len(self))) for person in self.people)

    def humans(self, i: int) -> tuple[Hand, ...]:
        return self.sets[i]

    def persons(self, i: int) -> tuple[Person, ...]:
        return self.people


@dataclass(frozen=True, eq=False)
class Variants:
    """The fields of MuJoCo's model in which the models of a crowd differ, one row per set of humans."""

    scene: Scene
    fields: dict[str, _Array]  # (nsim, bodies | joints | tendons)
    impedances: tuple[_Felt, ...] = ()  # with a leading axis over the sets

    def __len__(self) -> int:
        return self.fields["body_mass"].shape[0]

    @property
    def states(self) -> int:
        return 2 * self.scene.model.nv + sum(z.order for _, z in self.impedances)

    def taken(self, sets: NDArray[np.intp]) -> Variants:
        """Return the variants of the sets with these numbers, in this order."""
        felt = tuple(_Felt(row, z.changed(lambda part: part[sets])) for row, z in self.impedances)
        return Variants(self.scene, {name: rows[sets] for name, rows in self.fields.items()}, felt)

    def plants(self) -> Plant:
        """Return the plants of all models, with A (nsim, states, states) and B (nsim, states, inputs)."""
        model = self.scene.model
        across, mass = _tendon_jacobian(model), self.fields["body_mass"][:, model.jnt_bodyid]

        def matrix(joint: str, tendon: str) -> _Array:
            between = across.T * self.fields[tendon][:, None, :] @ across
            return between + self.fields[joint][:, :, None] * np.eye(model.nv)

        K, D = matrix("jnt_stiffness", "tendon_stiffness"), matrix("dof_damping", "tendon_damping")
        return _plant(
            lambda matrix: matrix / mass[:, :, None], K, D, _actuation(model), self.scene.channels, self.impedances
        )


def variants(devices: Sequence[Device], crowd: Crowd | HumanSets) -> Variants:
    """Return the models of the devices with every set of humans.

    Raises ValueError if the numbers or axes of humans and devices differ, if a person holds a device that does not
    exist, is held by another person or has other axes, or if the humans of one device differ in their structure.
    """
    placed = _placed(devices, crowd.ports, crowd.held)
    first = tuple(part._replace(port=part.port.of(0)) for part in placed)
    scene = _compiled(devices, first, with_xml=False)
    model = scene.model
    names = ("body_mass", "jnt_stiffness", "dof_damping", "tendon_stiffness", "tendon_damping")
    fields = {name: np.tile(getattr(model, name).astype(float), (len(crowd), 1)) for name in names}
    mass, damping, stiffness = _amounts(devices, placed, crowd.mechanics)
    for name, amount in mass.items():
        fields["body_mass"][:, model.body(_body(name)).id] = amount
    for name, amount in damping.items():
        joint = name in mass
        at = model.joint(name).id if joint else model.tendon(name).id
        fields["dof_damping" if joint else "tendon_damping"][:, at] = amount
        fields["jnt_stiffness" if joint else "tendon_stiffness"][:, at] = stiffness[name]
    rows = (row for row, _ in _impedances(model))
    stacked = (part.port.impedance for part in placed if part.port.impedance for _ in range(part.port.axes))
    return Variants(scene, fields, tuple(_Felt(row, z) for row, z in zip(rows, stacked, strict=True)))
