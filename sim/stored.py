"""Stored couplings as a command meets them: read, fitted to its loop, and doubted."""

from __future__ import annotations

from pathlib import Path

from controller.coupling import Compliance, Coupling, InternalModel
from design import store
from design.certificate import verify
from design.store import Loop, Stored
from sim.scenario import InputError


def read_coupling(path: str | Path) -> Stored:
    """A stored coupling. Raises InputError where there is none that can be read."""
    try:
        return store.load(path)
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}") from None
    except store.BadFile as error:
        raise InputError(str(error)) from None


def fitted(stored: Stored, path: str, channels: int, T: float) -> Coupling:
    """The stored coupling in a loop of so many channels at T [s]. Raises InputError where it cannot stand there."""
    if len(stored.loop.delta) != channels:
        raise InputError(f"{path} couples {len(stored.loop.delta)} channels, the loop has {channels}")
    coupling = stored.coupling.build(T)
    if isinstance(coupling, Compliance | InternalModel) and stored.loop.T != T:
        raise InputError(f"{path}: its coefficients are for T = {stored.loop.T:g} s, the loop has {T:g} s")
    return coupling


def doubts(stored: Stored, loop: Loop) -> list[str]:
    """Why the certificate on file says nothing of the coupling in this loop: it fails, or is of another loop."""
    lines = []
    try:
        reason = verify(stored).reason if stored.certificate else None
    except (ValueError, ArithmeticError) as error:
        reason = str(error)
    if reason:
        lines.append(f"the certificate in the coupling's file does not hold: {reason}")
    differ = [n for n in loop.__struct_fields__ if n != "lam" and getattr(loop, n) != getattr(stored.loop, n)]
    if differ:
        lines.append(
            f"the coupling was stored for another loop (different {', '.join(differ)}), and is judged anew here"
        )
    return lines
