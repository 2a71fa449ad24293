"""Stored couplings as a command meets them: read, fitted to its loop, and doubted."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from controller.coupling import Compliance, Coupling, InternalModel
from design import store
from design.certificate import verify
from design.promises import switching_promise
from design.store import DelayRange, Loop, Stored
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


@dataclass(frozen=True)
class Standing:
    """What a coupling's file is worth in a loop."""

    notes: tuple[str, ...]  # what a reader should know of it
    switching: DelayRange | None = None  # the file proves that any switching of the delays within it is safe here


def standing(stored: Stored, loop: Loop) -> Standing:
    """Whether the certificate on file holds, and what it says of the coupling in this loop."""
    try:
        reason = verify(stored).reason if stored.certificate else None
    except (ValueError, ArithmeticError) as error:
        reason = str(error)
    notes = [f"the certificate in the coupling's file does not hold: {reason}"] if reason else []
    delays = ("theta", "jitter", "lam")  # lam matters to transparency only
    differ = [n for n in loop.__struct_fields__ if n not in delays and getattr(loop, n) != getattr(stored.loop, n)]
    proved = stored.certificate is not None and not reason and not differ
    switching = stored.loop.jitter if proved else None
    if switching and switching.contains(loop.jitter or DelayRange(loop.theta, loop.theta)):
        if loop.theta != stored.loop.theta or loop.jitter not in (None, switching):
            here = switching_promise(loop.jitter) if loop.jitter else f"the constant theta = {list(loop.theta)}"
            notes.append(f"the file proves {switching_promise(switching)}, which covers {here}")
        return Standing(tuple(notes), switching)
    differ += ["theta"] if loop.theta != stored.loop.theta else []
    if loop.jitter and proved:
        made_for = switching_promise(switching) if switching else "constant delays"
        notes.append(f"the file proves {made_for}: {switching_promise(loop.jitter)} are judged anew here")
    if differ:
        notes.append(
            f"the coupling was stored for another loop (different {', '.join(differ)}), and is judged anew here"
        )
    return Standing(tuple(notes), switching)
