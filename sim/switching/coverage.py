"""What is certified of a coupling where delays vary: by its file, or judged anew, and what that covers."""

from __future__ import annotations

from typing import Any

import msgspec

from controller.delay import LOST
from controller.jitter import Jitter
from design.jitter.part import switching_part, switching_requirement
from design.jitter.proof import sent
from design.margin import Requirement
from design.promises import switching_promise
from design.store import DelayRange
from sim.couplings import Chosen
from sim.scenario import Scenario


def certified_part(scenario: Scenario, chosen: Chosen, certified: bool) -> dict[str, Any]:
    """The jitter-proof requirement, and what the certificates cover; `certified` is about the constant theta."""
    assert scenario.jitter is not None
    if not scenario.switches:
        return {"jitter_proof": None, "on_file": None} | coverage(scenario.jitter, certified, None)
    span = scenario.delay_range
    loop = scenario.loop("I").switching(span)  # the case does not matter to stability
    found = switching_requirement(loop, chosen.coupling)
    on_file = chosen.switching if chosen.switching and chosen.switching.contains(span) else None
    figures = switching_part(found, sent(loop, chosen.coupling), span)
    proof = _how_proved(found.requirement, on_file)
    parts = {"jitter_proof": figures, "on_file": on_file and msgspec.to_builtins(on_file)}
    return parts | coverage(scenario.jitter, certified, proof, figures["playout"]["certified"])


def _how_proved(requirement: Requirement, on_file: DelayRange | None) -> str:
    """What shows that any switching within the range is safe, "" where nothing does."""
    if on_file:
        return f"proved in the coupling's file for {switching_promise(on_file)}"
    if not requirement.certified:
        return ""
    return "proved exactly" if requirement.proof == "rational" else "by a refined sweep, without an exact proof"


def coverage(jitter: Jitter, certified: bool, proof: str | None, buffered: bool = False) -> dict[str, Any]:
    """Whether what is certified covers these delays: {"covered", "covers"}.

    `certified` is about the constant theta, `proof` says what shows that every switching within the range is safe
    ("" if nothing does, None where the delay is constant), `buffered` is about the constant delay hi.
    """
    constants = (
        "certificates are about constant delays" if certified else "nothing is certified, even for constant delays"
    )
    if proof is None:
        text = "the delay is constant after all (theta): the certificates cover it" if certified else constants
        return {"covered": certified, "covers": text}
    lossy = jitter.loss > 0 or any(LOST in row for row in jitter.recorded)
    if proof:
        what = "any switching of the delays within their range is covered"
        within = f"jitter-proof in this environment ({proof}): {what}"
        losses = ", but a lost packet makes a force older than hi, which is not"
        return {"covered": not lossy, "covers": within + (losses if lossy else "")}
    verdict = "for which it is certified" if buffered else "for which it is not certified either"
    constant = f"the constant {list(jitter.hi)}" + (" but for lost packets" if lossy else "")
    advice = f"a playout buffer (--playout) makes the delay {constant}, {verdict}"
    return {
        "covered": False,
        "covers": f"{constants}; this coupling is not jitter-proof, so switching is not covered; {advice}",
    }
