"""Force-feedback devices with one to three axes, their guaranteed damping, and a catalogue of real devices."""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from dataclasses import dataclass
from numbers import Real
from typing import Any, ClassVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from haptic_loop.controller.loop import DeviceBounds


def require(field: str, value: float, low: float, high: float, unit: str) -> None:
    """Raise ValueError unless low <= value <= high (nan is refused, too), and TypeError if `value` is not a number."""
    if not isinstance(value, Real):
        raise TypeError(f"{field} is {value!r}, expected a number")
    if not low <= value <= high:
        raise ValueError(f"{field} is {value:g}, allowed are {low:g} to {high:g} {unit}")


MOST_DAMPING = 1e4  # [N s/m] largest damping of a device
_LEAST_EIGENVALUE = 1e-9  # [N s/m] of a damping matrix: far below the damping of any device, above rounding errors
AXES = ("x", "y", "z")

#: `_PerAxis` is one number for all axes, or one number per axis. `_Levels` may also be a symmetric matrix.
_PerAxis = float | tuple[float, ...]
_Levels = float | tuple[float | tuple[float, ...], ...]
_Matrix = NDArray[np.float64]


def symmetric(field: str, value: Any, axes: int) -> _Matrix:
    """Return the matrix (axes, axes) of a number, of a list with one number per axis, or of a symmetric matrix.

    Raises ValueError for any other value.
    """
    try:
        array = np.array(value, dtype=float)
    except (TypeError, ValueError):  # rows of different lengths
        array = np.empty(0)
    if array.shape not in ((), (axes,), (axes, axes)):
        expected = f"one number, {axes} numbers or {axes} rows of {axes} numbers"
    elif not np.isfinite(array).all():
        expected = "finite numbers" if array.ndim else "a finite number"
    elif (array != array.T).any():
        expected = "a symmetric matrix"
    else:
        return array if array.ndim == 2 else np.diag(np.broadcast_to(array, axes))
    raise ValueError(f"{field} is {_listed(value)}, expected {expected}")


def _listed(value: Any) -> Any:
    return [_listed(part) for part in value] if isinstance(value, list | tuple) else value


class _Device(msgspec.Struct, frozen=True, forbid_unknown_fields=True, repr_omit_defaults=True):
    """The fields and properties that both kinds of devices have."""

    damping: _Levels = 1.37  # [N s/m] the paper's section 6, from a first-order model identified on an Omega
    force_limit: _PerAxis = 12.0  # [N] CHAI3D's number for omega.3; one number for the vector, a list for single axes
    encoder_step: _PerAxis = 0.0  # [m] assumed 0: an ideal encoder
    friction: _PerAxis = 0.0  # [N] Coulomb friction at the motor, assumed 0; only MuJoCo models it, axis by axis
    friction_max: float | None = None  # [N] a published upper bound, neither simulated nor used by a proof
    delta: _Levels | None = None  # [N s/m] guaranteed damping, such as an identified bound; None means `damping`
    credible_speed: float = 2.0  # [m/s] largest speed for which the model is trusted, assumed: about 3 x 0.7 m/s
    # In a study, the masters of teleoperators moved faster than 0.7 m/s for a fifth of the fast phase of tapping.
    guaranteed: DeviceBounds | None = None  # bounds that the known-device conditions use; refused for a rigid device
    axes: int = 1  # 1 to 3: x, y, z
    clamped: tuple[str, ...] = ()  # axes that are held; the others are the device's channels

    @property
    def passivity_level(self: Any) -> float:
        """delta [N s/m]: the damping that the device guarantees to the design."""
        return self.damping if self.delta is None else self.delta

    def with_damping(self: Any, damping: float) -> Device:
        """Return the device with this motor damping on each of its axes, all of it guaranteed."""
        return msgspec.structs.replace(self, damping=damping, delta=None)

    @property
    def free(self) -> tuple[int, ...]:
        """The numbers of the axes that are not clamped, counted from 0. Each of these axes is one channel."""
        return tuple(i for i, axis in enumerate(AXES[: self.axes]) if axis not in self.clamped)

    @property
    def axis_names(self) -> tuple[str, ...]:
        """The endings of the names of joints and contacts: ".x" and so on, or "" if the device has one axis."""
        return tuple(f".{AXES[i]}" for i in self.free) if self.axes > 1 else ("",)

    def matrix(self, field: str) -> _Matrix:
        """Return `damping`, or with field "delta" the guaranteed damping, as a matrix over the free axes [N s/m]."""
        value = self.passivity_level if field == "delta" else self.damping
        return symmetric(field, value, self.axes)[np.ix_(self.free, self.free)]

    @property
    def ball(self) -> bool:
        """Whether `force_limit` bounds the length of the force vector instead of the force on each axis."""
        return isinstance(self.force_limit, Real) and len(self.free) > 1

    def channels(self: Any) -> tuple[Device, ...]:
        """Return the free axes as devices with one axis each. Their dampings are the diagonals of the matrices."""
        if self.axes == 1:
            return (self,)
        damping, level = np.diag(self.matrix("damping")), np.diag(self.matrix("delta"))
        alone: dict[str, Any] = {"axes": 1, "clamped": ()}
        devices = []
        for k, i in enumerate(self.free):
            per_axis = {
                name: value[i]
                for name in ("force_limit", "encoder_step", "friction")
                if isinstance(value := getattr(self, name), tuple)
            }
            delta = None if self.delta is None else float(level[k])
            devices.append(msgspec.structs.replace(self, **alone, **per_axis, damping=float(damping[k]), delta=delta))
        return tuple(devices)


class CompliantDevice(_Device, frozen=True, forbid_unknown_fields=True, tag="compliant", tag_field="kind"):
    """A motor with encoder, joined to the handle by a transmission spring.

    `damping` is the output-strict-passivity level at motor and encoder, for every passive load on the transmission.
    """

    motor_mass: float = 0.06  # [kg] assumed; motor and handle have 0.25 kg together
    handle_mass: float = 0.19  # [kg] assumed
    transmission_stiffness: float = 14500.0  # [N/m] assumed: the structural mode is then near 90 Hz
    transmission_damping: float = 0.0  # [N s/m] assumed
    credible_force: float | None = None  # [N] largest transmission force for which the linear model is trusted

    file: ClassVar[str] = "compliant"  # The MJCF file is models/{file}.xml.

    @property
    def bodies(self) -> dict[str, float]:
        """The masses [kg] by the names of the bodies; a hand holds the last body."""
        return {"motor": self.motor_mass, "handle": self.handle_mass}

    @property
    def transmission(self) -> tuple[float, float] | None:
        """Damping [N s/m] and stiffness [N/m] between motor and handle."""
        return self.transmission_damping, self.transmission_stiffness

    @property
    def most_credible_force(self) -> float:
        """The transmission force [N] up to which its linear model is trusted.

        By default it is three times the motor's force limit. This assumes a transmission that was made for its motor.
        """
        return 3.0 * float(np.max(self.force_limit)) if self.credible_force is None else self.credible_force

    def __post_init__(self) -> None:
        _check_common(self, ("motor_mass", "handle_mass"))
        require("transmission_stiffness", self.transmission_stiffness, 1e-4, 1e9, "N/m")
        require("transmission_damping", self.transmission_damping, 0.0, 1e5, "N s/m")
        if self.credible_force is not None:
            require("credible_force", self.credible_force, 1e-3, 1e6, "N")
        if known := self.guaranteed:
            require("motor_mass", self.motor_mass, known.motor_mass_min, 1e3, "kg (guaranteed)")
            stiffest = known.transmission_stiffness_max
            require("transmission_stiffness", self.transmission_stiffness, 1e-4, stiffest, "N/m (guaranteed)")
            least, most = known.transmission_damping_min, known.transmission_damping_max
            require("transmission_damping", self.transmission_damping, least, most, "N s/m (guaranteed)")


class RigidDevice(_Device, frozen=True, forbid_unknown_fields=True, tag="rigid", tag_field="kind"):
    """Motor, encoder and handle as one body."""

    mass: float = 0.25  # [kg] assumed

    file: ClassVar[str] = "rigid"
    transmission: ClassVar[None] = None
    most_credible_force: ClassVar[None] = None

    @property
    def bodies(self) -> dict[str, float]:
        """The mass [kg] of the only body, the motor, which the hand holds."""
        return {"motor": self.mass}

    def __post_init__(self) -> None:
        _check_common(self, ("mass",))
        if self.guaranteed is not None:
            raise ValueError("guaranteed: a rigid device has no transmission; known-device needs kind = 'compliant'")


Device = CompliantDevice | RigidDevice


class Mechanics(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The masses and the transmission of one device, drawn within its guaranteed bounds."""

    motor_mass: float  # [kg]
    handle_mass: float  # [kg]
    transmission_stiffness: float  # [N/m]
    transmission_damping: float  # [N s/m]

    @classmethod
    def within(cls, device: Device, u: NDArray[np.float64]) -> Mechanics:
        """Return the mechanics at u (4,) in [-1, 1] of a device with guaranteed bounds.

        A negative entry of u selects the bound itself, because the worst devices lie near the bounds. As an entry rises
        from 0 to 1, its parameter moves away from the bound on a logarithmic scale: the motor's mass to ten times the
        bound, the stiffness to a tenth, the damping to its upper bound. The handle's mass has no bound and moves to a
        hundredth of its value.
        """
        known = device.guaranteed
        assert known is not None  # the caller draws only if every device has bounds
        assert isinstance(device, CompliantDevice)  # a rigid device with bounds is refused
        least, most = known.transmission_damping_min, known.transmission_damping_max
        ends = np.array([10.0, 0.01, 0.1, most / least])
        starts = known.motor_mass_min, device.handle_mass, known.transmission_stiffness_max, least
        motor, handle, stiffness, damping = (np.array(starts) * ends ** np.maximum(u, 0.0)).tolist()
        return cls(motor, handle, stiffness, min(damping, most))

    def of(self, device: Device) -> Device:
        """Return the device with these mechanics. Raises ValueError for a rigid device, or mechanics out of bounds."""
        if isinstance(device, RigidDevice):
            raise ValueError("kind is 'rigid', expected 'compliant': these mechanics include a transmission")
        return msgspec.structs.replace(device, **msgspec.structs.asdict(self))


def _check_common(device: Device, masses: tuple[str, ...]) -> None:
    for name in masses:
        require(name, getattr(device, name), 1e-9, 1e3, "kg")
    _check_axes(device)
    limits = (("force_limit", 1e-3, 1e6, "N"), ("encoder_step", 0.0, 1e-2, "m"), ("friction", 0.0, 1e3, "N"))
    for name, low, high, unit in limits:
        for i, value in enumerate(_each(device, name), start=1):
            many = isinstance(getattr(device, name), tuple)
            require(f"{name} #{i}" if many else name, value, low, high, unit)
    if device.friction_max is not None:
        require("friction_max", device.friction_max, max(_each(device, "friction")), 1e3, "N")
    require("credible_speed", device.credible_speed, 1e-3, 1e3, "m/s")
    _check_damping(device)


def _each(self: Any, name: str) -> tuple[float, ...]:
    """Return the numbers of a field: one per axis, or only one. Raises ValueError for a list of the wrong length."""
    value = getattr(self, name)
    if not isinstance(value, tuple):
        return (value,)
    if len(value) != self.axes or self.axes == 1:
        expected = "one number" if self.axes == 1 else f"one number or {self.axes} numbers"
        raise ValueError(f"{name} is {list(value)}, expected {expected}: the device has axes = {self.axes}")
    return value


def _check_axes(self: Any) -> None:
    if not 1 <= self.axes <= len(AXES):
        raise ValueError(f"axes is {self.axes}, allowed are 1 to {len(AXES)}")
    names = AXES[: self.axes]
    for axis in self.clamped:
        if axis not in names:
            raise ValueError(
                f"clamped lists {axis!r}, allowed are {', '.join(names)}: the device has axes = {self.axes}"
            )
    if len(set(self.clamped)) < len(self.clamped):
        raise ValueError(f"clamped is {list(self.clamped)}, expected each axis of {', '.join(names)} at most once")
    if len(set(self.clamped)) == self.axes:
        raise ValueError(f"clamped is {list(self.clamped)}, which leaves no axis of {', '.join(names)}")


def _check_damping(self: Any) -> None:
    """Raise ValueError unless 0 < delta <= damping (matrices if axes > 1). A single damping may be 0 without delta."""
    if self.axes == 1:
        for name in ("damping", "delta"):
            if isinstance(getattr(self, name), tuple):
                raise ValueError(
                    f"{name} is {_listed(getattr(self, name))}, expected one number: the device has one axis"
                )
        require("damping", self.damping, 0.0, MOST_DAMPING, "N s/m")
        if self.delta is not None and not 0 < self.delta <= self.damping:
            raise ValueError(f"delta is {self.delta:g} N s/m, allowed are values in (0, damping = {self.damping:g}]")
        return
    damping = symmetric("damping", self.damping, self.axes)
    least, most = np.linalg.eigvalsh(damping)[[0, -1]]
    if not (least >= _LEAST_EIGENVALUE and most <= MOST_DAMPING):
        range_ = f"eigenvalues in [{_LEAST_EIGENVALUE:g}, {MOST_DAMPING:g}] N s/m"
        raise ValueError(
            f"damping is {_listed(self.damping)} with eigenvalues {least:g} to {most:g}, allowed are {range_}"
        )
    if self.delta is None:
        return
    delta = symmetric("delta", self.delta, self.axes)
    if not (lowest := np.linalg.eigvalsh(delta)[0]) >= _LEAST_EIGENVALUE:
        expected = f"eigenvalues of at least {_LEAST_EIGENVALUE:g} N s/m"
        raise ValueError(f"delta is {_listed(self.delta)} with the eigenvalue {lowest:g}, expected {expected}")
    # This tolerance is for the rounding of eigvalsh, a few units in the last place of the largest entry.
    if (left := np.linalg.eigvalsh(damping - delta)[0]) < -1e-12 * most:
        raise ValueError(
            f"delta is {_listed(self.delta)}, allowed is delta <= damping as matrices: "
            f"damping - delta has the eigenvalue {left:g}"
        )


# ----------------------------------------------------------------------------------------------------
# Published parameters of devices that can be bought or built, with their sources. A scenario that names a device must
# give its damping (which `python -m hw.identify` measures) and its force limit if nobody publishes them.


@dataclass(frozen=True)
class _Known:
    """A published number, or the published kind of a device's model, with its source."""

    value: float | str
    source: str


_CHAI3D = "CHAI3D's device table, src/devices/{}.cpp"
_DELTA, _FALCON, _PHANTOM = (
    _CHAI3D.format(f"C{name}Device{s}") for name, s in (("Delta", "s"), ("Falcon", ""), ("Phantom", "s"))
)
_SHEET = "the maker's data sheet of the {}, not checked again"
_OMNI, _PREMIUM = _SHEET.format("Phantom Omni"), _SHEET.format("Phantom Premium 1.5")


@dataclass(frozen=True)
class _Listed:
    """A real device along one axis. A field is None if no source publishes its number."""

    title: str
    kind: _Known | None = None  # kind of the model that the source identified; None means "rigid"
    damping: _Known | None = None  # [N s/m]
    mass: _Known | None = None  # [kg] felt at the handle
    force_limit: _Known | None = None  # [N]
    encoder_step: _Known | None = None  # [m] at the handle
    friction: _Known | None = None  # [N] upper bound on the Coulomb friction
    stiffness: _Known | None = None  # [N/m] largest stiffness that a programming framework admits
    framework_damping: _Known | None = None  # [N s/m] largest damping that a programming framework admits

    @property
    def known(self) -> dict[str, _Known]:
        """The published values by the names of RigidDevice's fields. A published friction becomes `friction_max`."""
        fields = ("kind", "damping", "mass", "force_limit", "encoder_step")
        facts = {name: fact for name in fields if (fact := getattr(self, name))}
        return facts | ({"friction_max": self.friction} if self.friction else {})


_IDENTIFIED = "section 6 of the paper: a first-order model identified on an Omega 3"


def _force_dimension(title: str, force: float, stiffness: float = 5000.0, **more: _Known) -> _Listed:
    limits = {"force_limit": force, "stiffness": stiffness, "framework_damping": 30.0}
    published = {name: _Known(value, _DELTA) for name, value in limits.items()}
    return _Listed(f"Force Dimension {title}", **published, **more)


CATALOGUE: Mapping[str, _Listed] = {
    "omega.3": _force_dimension("omega.3", 12.0, kind=_Known("rigid", _IDENTIFIED), damping=_Known(1.37, _IDENTIFIED)),
    "omega.6": _force_dimension("omega.6, translation", 12.0),
    "omega.7": _force_dimension("omega.7, translation", 12.0),
    "delta.3": _force_dimension("delta.3", 20.0),
    "delta.6": _force_dimension("delta.6, translation", 20.0),
    "sigma.7": _force_dimension("sigma.7, translation", 12.0, stiffness=4000.0),
    "falcon": _Listed(
        "Novint Falcon",
        force_limit=_Known(8.0, _FALCON),
        encoder_step=_Known(63.5e-6, "more than 400 dpi, H3D API's page of the Falcon"),
        stiffness=_Known(3000.0, _FALCON),
        framework_damping=_Known(20.0, _FALCON),
    ),
    "touch": _Listed(
        "3D Systems Touch (SensAble Phantom Omni)",
        mass=_Known(0.045, _OMNI),
        force_limit=_Known(3.3, _OMNI),
        encoder_step=_Known(55e-6, _OMNI),
        friction=_Known(0.26, _OMNI),
        stiffness=_Known(700.0, _PHANTOM),
        framework_damping=_Known(5.0, _PHANTOM),
    ),
    "phantom-premium": _Listed(
        "SensAble Phantom Premium 1.5",
        mass=_Known(0.075, _PREMIUM),
        force_limit=_Known(8.5, _PREMIUM),
        encoder_step=_Known(30e-6, _PREMIUM),
        friction=_Known(0.04, _PREMIUM),
        stiffness=_Known(800.0, _PHANTOM + " (1.5 6DOF)"),
        framework_damping=_Known(5.0, _PHANTOM + " (1.5 6DOF)"),
    ),
    "haply-2diy": _Listed("Haply 2DIY"),
    "inverse3": _Listed("Haply Inverse3"),
    "hapkit": _Listed("Hapkit"),
}
_OTHER_NAMES = {"omni": "touch", "omega": "omega.3", "delta": "delta.3", "2diy": "haply-2diy"}
_NEEDED = ("damping", "force_limit")  # the defaults of these fields do not apply to devices of the catalogue


def listed_device(name: str) -> tuple[str, _Listed]:
    """Return a device's name in the catalogue and its entry. Raises ValueError for an unknown name."""
    key = _OTHER_NAMES.get(name.lower(), name.lower())
    if key not in CATALOGUE:
        close = difflib.get_close_matches(key, CATALOGUE, n=1)
        hint = f" (did you mean {close[0]}?)" if close else ""
        raise ValueError(f"device is {name[:80]!r}{hint}, the catalogue has {', '.join(CATALOGUE)}")
    return key, CATALOGUE[key]


def fields_of(name: str, own: Mapping[str, Any]) -> dict[str, Any]:
    """Return the fields of a scenario's [[device]]: the catalogue's fields, overridden by the scenario's `own` fields.

    Raises ValueError for an unknown name, or if a required number is neither in the catalogue nor in `own`.
    """
    key, device = listed_device(name)
    fields: dict[str, Any] = {"kind": "rigid"} | {field: fact.value for field, fact in device.known.items()}
    if own.get("kind") == "compliant":  # a compliant device has motor_mass and handle_mass instead of mass
        fields.pop("mass", None)
    if "friction" in own:  # a measured friction replaces the published bound
        fields.pop("friction_max", None)
    fields |= own
    if missing := [field for field in _NEEDED if field not in fields]:
        unknown = " and ".join(f"{field} [{'N' if field == 'force_limit' else 'N s/m'}]" for field in missing)
        raise ValueError(f"nobody publishes {unknown} of {key}: give it beside `device` (hw.identify measures damping)")
    return fields
