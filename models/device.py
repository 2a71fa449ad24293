"""Force-feedback devices clamped to one axis, the damping that certificates rest on, and a catalogue of real ones."""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from dataclasses import dataclass
from numbers import Real
from typing import Any, ClassVar

import msgspec

# ----------------------------------------------------------------------------------------------------
# Physical quantities with their units and the range in which a value makes sense.


def require(field: str, value: float, low: float, high: float, unit: str) -> None:
    """Raise ValueError unless low <= value <= high (nan is refused), TypeError for anything but a number."""
    if not isinstance(value, Real):
        raise TypeError(f"{field} is {value!r}, expected a number")
    if not low <= value <= high:
        raise ValueError(f"{field} is {value:g}, allowed are {low:g} to {high:g} {unit}")


MOST_DAMPING = 1e4  # [N s/m]


class Guaranteed(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What is guaranteed of a device's motor and transmission, `[device.guaranteed]` of a scenario.

    The bounds hold for the real device; what is simulated must lie within them. The known-device conditions rest on
    them: everything but the motor is reached through a spring and a damper in parallel.
    """

    motor_mass_min: float  # [kg] of all that moves rigidly with the motor's shaft
    transmission_stiffness_max: float  # [N/m]
    transmission_damping_min: float  # [N s/m]
    transmission_damping_max: float  # [N s/m]

    def __post_init__(self) -> None:
        require("guaranteed.motor_mass_min", self.motor_mass_min, 1e-6, 1e3, "kg")
        require("guaranteed.transmission_stiffness_max", self.transmission_stiffness_max, 1.0, 1e9, "N/m")
        if self.transmission_damping_min == 0:
            raise ValueError(
                "guaranteed.transmission_damping_min is 0 N s/m: a lossless transmission guarantees nothing"
            )
        require("guaranteed.transmission_damping_min", self.transmission_damping_min, 1e-6, 1e5, "N s/m")
        least = self.transmission_damping_min
        require("guaranteed.transmission_damping_max", self.transmission_damping_max, least, 1e5, "N s/m")


class _Device(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What both kinds of a device, which declare the fields, have."""

    @property
    def passivity_level(self: Any) -> float:
        """delta [N s/m]: the damping that the device guarantees to the design."""
        return self.damping if self.delta is None else self.delta

    def with_damping(self: Any, damping: float) -> Device:
        """The same device with another motor damping, all of it guaranteed."""
        return msgspec.structs.replace(self, damping=damping, delta=None)


class CompliantDevice(_Device, frozen=True, forbid_unknown_fields=True, tag="compliant", tag_field="kind"):
    """A motor with encoder, joined to the handle by a transmission spring.

    Whatever hangs on the transmission, the port at motor and encoder dissipates at least `damping`: it is the
    output-strict-passivity level of the device.
    """

    motor_mass: float = 0.06  # [kg] assumed, with handle_mass: 0.25 kg in total
    damping: float = 1.37  # [N s/m] the paper's section 6, from a first-order model identified on an Omega
    handle_mass: float = 0.19  # [kg] assumed
    transmission_stiffness: float = 14500.0  # [N/m] assumed: puts the structural mode near 90 Hz
    transmission_damping: float = 0.0  # [N s/m] assumed
    force_limit: float = 12.0  # [N] omega.3 in CHAI3D's device table
    encoder_step: float = 0.0  # [m] assumed 0: an ideal encoder
    friction: float = 0.0  # [N] Coulomb friction at the motor, assumed 0; only MuJoCo models it
    friction_max: float | None = None  # [N] an upper bound that is published: never simulated, and no proof uses it
    delta: float | None = None  # [N s/m] guaranteed damping; `damping` unless an identification bounds it lower
    credible_force: float | None = None  # [N] in the transmission: more is the model's alone, see `most_credible_force`
    credible_speed: float = 2.0  # [m/s] likewise; assumed: three times the 0.7 m/s that teleoperation masters exceed
    # in a fifth of the fast part of a tapping task (the abstract of such a study says so; not a figure of this device)
    guaranteed: Guaranteed | None = None  # bounds of motor and transmission that the known-device conditions rest on

    file: ClassVar[str] = "compliant"  # .xml, its MJCF

    @property
    def bodies(self) -> dict[str, float]:
        """Its masses by name [kg]; the last one is what a hand holds."""
        return {"motor": self.motor_mass, "handle": self.handle_mass}

    @property
    def transmission(self) -> tuple[float, float] | None:
        """Damping [N s/m] and stiffness [N/m] between motor and handle."""
        return self.transmission_damping, self.transmission_stiffness

    @property
    def most_credible_force(self) -> float:
        """What the transmission may carry [N] before the linear model of it is doubted.

        The force at which a cable slips on its capstan is not published. Where a device declares none, it is three
        times what its motor can push, because a transmission that is made for a motor need not hold more.
        """
        return 3.0 * self.force_limit if self.credible_force is None else self.credible_force

    def __post_init__(self) -> None:
        _check_common(self, ("motor_mass", "handle_mass"))
        require("transmission_stiffness", self.transmission_stiffness, 1.0, 1e9, "N/m")
        require("transmission_damping", self.transmission_damping, 0.0, 1e5, "N s/m")
        if self.credible_force is not None:
            require("credible_force", self.credible_force, 1e-3, 1e6, "N")
        if known := self.guaranteed:
            require("motor_mass", self.motor_mass, known.motor_mass_min, 1e3, "kg (guaranteed)")
            stiffest = known.transmission_stiffness_max
            require("transmission_stiffness", self.transmission_stiffness, 1.0, stiffest, "N/m (guaranteed)")
            least, most = known.transmission_damping_min, known.transmission_damping_max
            require("transmission_damping", self.transmission_damping, least, most, "N s/m (guaranteed)")


class RigidDevice(_Device, frozen=True, forbid_unknown_fields=True, tag="rigid", tag_field="kind"):
    """Motor, encoder and handle as one body."""

    mass: float = 0.25  # [kg] assumed
    damping: float = 1.37  # [N s/m] the paper's section 6
    force_limit: float = 12.0  # [N] omega.3 in CHAI3D's device table
    encoder_step: float = 0.0  # [m] assumed 0: an ideal encoder
    friction: float = 0.0  # [N] Coulomb friction, assumed 0; only MuJoCo models it
    friction_max: float | None = None  # [N] an upper bound that is published: never simulated, and no proof uses it
    delta: float | None = None  # [N s/m] guaranteed damping
    credible_speed: float = 2.0  # [m/s] as of a compliant device
    guaranteed: Guaranteed | None = None  # refused: there is no transmission to guarantee

    file: ClassVar[str] = "rigid"
    transmission: ClassVar[None] = None
    most_credible_force: ClassVar[None] = None

    @property
    def bodies(self) -> dict[str, float]:
        """Its mass by name [kg]; the hand holds the motor itself."""
        return {"motor": self.mass}

    def __post_init__(self) -> None:
        _check_common(self, ("mass",))
        if self.guaranteed is not None:
            raise ValueError("guaranteed: a rigid device has no transmission; known-device needs kind = 'compliant'")


Device = CompliantDevice | RigidDevice


def _check_common(device: Device, masses: tuple[str, ...]) -> None:
    for name in masses:
        require(name, getattr(device, name), 1e-6, 1e3, "kg")
    require("damping", device.damping, 0.0, MOST_DAMPING, "N s/m")
    require("force_limit", device.force_limit, 1e-3, 1e6, "N")
    require("encoder_step", device.encoder_step, 0.0, 1e-2, "m")
    require("friction", device.friction, 0.0, 1e3, "N")
    if device.friction_max is not None:
        require("friction_max", device.friction_max, device.friction, 1e3, "N")
    require("credible_speed", device.credible_speed, 1e-3, 1e3, "m/s")
    if device.delta is not None and not 0 < device.delta <= device.damping:
        raise ValueError(f"delta is {device.delta:g} N s/m, allowed are values in (0, damping = {device.damping:g}]")


# ----------------------------------------------------------------------------------------------------
# Devices that can be bought or built: what is published of each, and by whom. No certificate rests on a number that is
# not known: a scenario that names a device gives those itself, measured by `python -m hw.identify` for example.


@dataclass(frozen=True)
class _Known:
    """A published number with its source."""

    value: float
    source: str


_CHAI3D = "CHAI3D's device table, src/devices/{}.cpp"
_DELTA, _FALCON, _PHANTOM = (
    _CHAI3D.format(f"C{name}Device{s}") for name, s in (("Delta", "s"), ("Falcon", ""), ("Phantom", "s"))
)
_SHEET = "the maker's data sheet of the {}, quoted and not re-read here"
_OMNI, _PREMIUM = _SHEET.format("Phantom Omni"), _SHEET.format("Phantom Premium 1.5")


@dataclass(frozen=True)
class Listed:
    """A real device along one axis; None stands for a number without a published source."""

    title: str
    damping: _Known | None = None  # [N s/m]
    mass: _Known | None = None  # [kg] felt at the handle
    force_limit: _Known | None = None  # [N]
    encoder_step: _Known | None = None  # [m] at the handle
    friction: _Known | None = None  # [N] Coulomb, at most
    stiffness: _Known | None = None  # [N/m] the most that a framework lets a programmer ask for
    framework_damping: _Known | None = None  # [N s/m] likewise

    @property
    def known(self) -> dict[str, _Known]:
        """The published fields of a RigidDevice. Of friction an upper bound is published, which is no `friction`."""
        fields = ("damping", "mass", "force_limit", "encoder_step")
        facts = {name: fact for name in fields if (fact := getattr(self, name))}
        return facts | ({"friction_max": self.friction} if self.friction else {})


_IDENTIFIED = _Known(1.37, "section 6 of the paper: a first-order model identified on an Omega")

CATALOGUE: Mapping[str, Listed] = {
    "omega.3": Listed(
        "Force Dimension omega.3",
        damping=_IDENTIFIED,
        force_limit=_Known(12.0, _DELTA),
        stiffness=_Known(5000.0, _DELTA),
        framework_damping=_Known(30.0, _DELTA),
    ),
    "delta.3": Listed(
        "Force Dimension delta.3",
        force_limit=_Known(20.0, _DELTA),
        stiffness=_Known(5000.0, _DELTA),
        framework_damping=_Known(30.0, _DELTA),
    ),
    "falcon": Listed(
        "Novint Falcon",
        force_limit=_Known(8.0, _FALCON),
        encoder_step=_Known(63.5e-6, "more than 400 dpi, H3D API's page of the Falcon"),
        stiffness=_Known(3000.0, _FALCON),
        framework_damping=_Known(20.0, _FALCON),
    ),
    "touch": Listed(
        "3D Systems Touch (SensAble Phantom Omni)",
        mass=_Known(0.045, _OMNI),
        force_limit=_Known(3.3, _OMNI),
        encoder_step=_Known(55e-6, _OMNI),
        friction=_Known(0.26, _OMNI),
        stiffness=_Known(700.0, _PHANTOM),
        framework_damping=_Known(5.0, _PHANTOM),
    ),
    "phantom-premium": Listed(
        "SensAble Phantom Premium 1.5",
        mass=_Known(0.075, _PREMIUM),
        force_limit=_Known(8.5, _PREMIUM),
        encoder_step=_Known(30e-6, _PREMIUM),
        friction=_Known(0.04, _PREMIUM),
        stiffness=_Known(800.0, _PHANTOM + " (1.5 6DOF)"),
        framework_damping=_Known(5.0, _PHANTOM + " (1.5 6DOF)"),
    ),
    "haply-2diy": Listed("Haply 2DIY"),
    "inverse3": Listed("Haply Inverse3"),
    "hapkit": Listed("Hapkit"),
}
_OTHER_NAMES = {"omni": "touch", "omega": "omega.3", "delta": "delta.3", "2diy": "haply-2diy"}
_NEEDED = ("damping", "force_limit")  # of a simulated device; for mass and encoder a RigidDevice has an assumption


def listed_device(name: str) -> tuple[str, Listed]:
    """The catalogue's device of this name, and its spelling there. Raises ValueError that lists the names."""
    key = _OTHER_NAMES.get(name.lower(), name.lower())
    if key not in CATALOGUE:
        close = difflib.get_close_matches(key, CATALOGUE, n=1)
        hint = f" (did you mean {close[0]}?)" if close else ""
        raise ValueError(f"device is {name[:80]!r}{hint}, the catalogue has {', '.join(CATALOGUE)}")
    return key, CATALOGUE[key]


def fields_of(name: str, given: Mapping[str, Any]) -> dict[str, Any]:
    """A catalogue device as the fields of a scenario's [[device]]; numbers that are given replace the catalogue's.

    Raises ValueError for an unknown name, and where a number is neither published nor given.
    """
    key, device = listed_device(name)
    fields: dict[str, Any] = {"kind": "rigid"} | {field: fact.value for field, fact in device.known.items()}
    if given.get("kind") == "compliant":  # its mass is divided between motor and handle
        fields.pop("mass", None)
    if "friction" in given:  # measured, so that the published bound says nothing more
        fields.pop("friction_max", None)
    fields |= given
    if missing := [field for field in _NEEDED if field not in fields]:
        unknown = " and ".join(f"{field} [{'N' if field == 'force_limit' else 'N s/m'}]" for field in missing)
        raise ValueError(f"nobody publishes {unknown} of {key}: give it beside `device`, as measured by hw.identify")
    return fields
