"""Couplings and transparency as plain data: what the commands print and write as JSON."""

from __future__ import annotations

import math
from typing import Any

from controller.coupling import Compliance, Coupling, InternalModel, SpringDamper
from design.promises import finite
from design.transparency import Transparency, decibels


def coupling_part(kind: str, coupling: Coupling, T: float) -> dict[str, Any]:
    """Kind, gains (None where it has none) and order of V, or of Q."""
    part: dict[str, Any] = {"kind": kind, "K": None, "B": None, "order": 0}
    match coupling:
        case SpringDamper(K=K, B=B):
            part |= {"K": K.tolist(), "B": B.tolist(), "order": coupling.compliance(T).order}
        case Compliance(V=V):
            part["order"] = V.order
        case InternalModel():
            part["order"] = coupling.parameter(T).order
    return part


def transparency_part(figures: Transparency) -> dict[str, Any]:
    """The figures of the mismatch, in decibels, with a reason where one is infinite."""
    part: dict[str, Any] = {
        "tau_db": finite(decibels(figures.tau)),
        "relative_mismatch_db": finite(decibels(figures.relative_mismatch)),
        "rms_mismatch_db": finite(decibels(figures.rms_mismatch)),
        "dc_ratio": finite(figures.dc_ratio),
        "high_frequency_gain": finite(figures.high_frequency_gain),
        "band_hz": list(figures.band_hz),
    }
    if figures.relative_mismatch == 0:
        part["reason"] = "the devices see the reference exactly: the mismatch is zero, minus infinity in dB"
    elif math.isinf(figures.tau):
        part["reason"] = "tau (25) divides by inf sigma_min(E), which is 0: some motion costs no static force"
    return part
