"""What has happened to a running loop, for machines and for people."""

from __future__ import annotations

from typing import Any

from rich.console import Console

from design.certificate import certificate_part, finite
from sim.view.session import Session
from sim.view.setting import Setting


def happened(session: Session) -> dict[str, Any]:
    """How long it ran, what was changed when, and what could be said of each loop."""
    return {
        "scenario": session.setting.scenario.name,
        "simulated_s": session.t,
        "clipped_ticks": session.clipped,
        "events": [{"t_s": t, "event": what, **_facts(setting)} for t, what, setting in session.log],
    }


def print_story(outcome: dict[str, Any], out: Console) -> None:
    """One line per event, and where the film is."""
    for event in outcome["events"]:
        held = [name for name, part in event["certificates"].items() if part["certified"]]
        growth = event["exact_growth_rate_per_s"]
        grows = "no growth" if growth is None else f"{growth:+.3g} 1/s at {event['exact_frequency_hz']:.1f} Hz"
        delays = f"theta {event['theta']}, psi {event['psi']}"
        proved = f"certified ({', '.join(held)})" if held else "NOT certified"
        loop = f"{event['coupling']}, {delays}: {grows}, {proved}"
        out.print(f"{event['t_s']:6.2f} s  {event['event']:<10} {loop}", soft_wrap=True)
    out.print(f"{outcome['simulated_s']:6.2f} s  end        {outcome['clipped_ticks']} ticks at a force limit")
    if "clock" in outcome:
        out.print(
            f"The clock was missed {outcome['clock']['overruns']} times: {outcome['clock']['lost_s']:.2f} s lost."
        )
    if "video" in outcome:
        video = outcome["video"]
        out.print(f"{video['file']}: {video['pictures']} pictures, drawn by {video['drawn']}", soft_wrap=True)
    for remark in outcome["remarks"]:
        out.print(f"Note: {remark}.", soft_wrap=True)


def _facts(setting: Setting) -> dict[str, Any]:
    return {
        "coupling": setting.label,
        "theta": list(setting.scenario.theta),
        "psi": list(setting.scenario.psi),
        "exact_growth_rate_per_s": finite(setting.mode.growth),
        "exact_frequency_hz": setting.mode.frequency_hz,
        "certificates": {name: certificate_part(need) for name, need in setting.requirements.items()},
        "promise": setting.promise,
    }
