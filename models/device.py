"""Force-feedback devices clamped to one axis, and the guaranteed damping that all certificates rest on."""

from __future__ import annotations

from numbers import Real

import msgspec

# ----------------------------------------------------------------------------------------------------
# Physical quantities with their units and the range in which a value makes sense.


def require(field: str, value: float, low: float, high: float, unit: str) -> None:
    """Raise ValueError unless low <= value <= high; not-a-number never passes. TypeError for what is no number."""
    if not isinstance(value, Real):
        raise TypeError(f"{field} is {value!r}, expected a number")
    if not low <= value <= high:
        raise ValueError(f"{field} is {value:g}, allowed are {low:g} to {high:g} {unit}")


MOST_DAMPING = 1e4  # [N s/m]


class CompliantDevice(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag="compliant", tag_field="kind"):
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
    delta: float | None = None  # [N s/m] guaranteed damping; `damping` unless an identification bounds it lower
    credible_force: float | None = None  # [N] in the transmission: more is the model's alone, see `credible_force`
    credible_speed: float = 2.0  # [m/s] likewise; assumed: three times the 0.7 m/s that teleoperation masters exceed
    # in a fifth of the fast part of a tapping task (the abstract of such a study says so; not a figure of this device)

    def __post_init__(self) -> None:
        _check_common(self, ("motor_mass", "handle_mass"))
        require("transmission_stiffness", self.transmission_stiffness, 1.0, 1e9, "N/m")
        require("transmission_damping", self.transmission_damping, 0.0, 1e5, "N s/m")
        if self.credible_force is not None:
            require("credible_force", self.credible_force, 1e-3, 1e6, "N")


class RigidDevice(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag="rigid", tag_field="kind"):
    """Motor, encoder and handle as one body."""

    mass: float = 0.25  # [kg] assumed
    damping: float = 1.37  # [N s/m] the paper's section 6
    force_limit: float = 12.0  # [N] omega.3 in CHAI3D's device table
    encoder_step: float = 0.0  # [m] assumed 0: an ideal encoder
    friction: float = 0.0  # [N] Coulomb friction, assumed 0; only MuJoCo models it
    delta: float | None = None  # [N s/m] guaranteed damping
    credible_speed: float = 2.0  # [m/s] as of a compliant device

    def __post_init__(self) -> None:
        _check_common(self, ("mass",))


Device = CompliantDevice | RigidDevice


def passivity_level(device: Device) -> float:
    """delta [N s/m]: the damping that the device guarantees to the design."""
    return device.damping if device.delta is None else device.delta


def credible_force(device: CompliantDevice) -> float:
    """What the transmission may carry [N] before the linear model of it is doubted.

    Nobody publishes at which force a cable slips on its capstan. Assumed where a device says nothing: three times what
    its motor can push, because a transmission that is made for a motor need not hold more.
    """
    return 3.0 * device.force_limit if device.credible_force is None else device.credible_force


def with_damping(device: Device, damping: float) -> Device:
    """The same device with another motor damping, all of it guaranteed."""
    return msgspec.structs.replace(device, damping=damping, delta=None)


def _check_common(device: Device, masses: tuple[str, ...]) -> None:
    for name in masses:
        require(name, getattr(device, name), 1e-6, 1e3, "kg")
    require("damping", device.damping, 0.0, MOST_DAMPING, "N s/m")
    require("force_limit", device.force_limit, 1e-3, 1e6, "N")
    require("encoder_step", device.encoder_step, 0.0, 1e-2, "m")
    require("friction", device.friction, 0.0, 1e3, "N")
    require("credible_speed", device.credible_speed, 1e-3, 1e3, "m/s")
    if device.delta is not None and not 0 < device.delta <= device.damping:
        raise ValueError(f"delta is {device.delta:g} N s/m, allowed are values in (0, damping = {device.damping:g}]")
