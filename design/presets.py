"""Limits that public frameworks ship, as data: what an application may ask of a device when it trusts them."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Preset:
    """A spring-damper against a rigid wall, one channel without delay."""

    K: float  # [N/m]
    B: float  # [N s/m]
    T: float  # [s]
    source: str  # of each number


PRESETS = {
    "chai3d-omega3": Preset(
        K=5000.0,
        B=30.0,
        T=1e-3,
        source="K and B: m_maxLinearStiffness and m_maxLinearDamping of the omega.3 in CHAI3D's "
        "src/devices/CDeltaDevices.cpp; T: the 1 kHz that haptic loops customarily run at",
    ),
}
