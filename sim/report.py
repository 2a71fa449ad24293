"""Results of a run as plain data in SI units: null with a "reason" where a figure does not exist.

The rows on the screen are made of it in cli/run.py.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from controller.coupling import PUBLISHED, Coupling
from controller.delay import LOST, Ticks, VaryingDelay, ages
from controller.older import CONDITIONS, with_older
from controller.timing import Timing
from design.certificate import assess
from design.guarantees import encoder_part
from design.result import Chosen, Requirement, certificate_part, finite, listed
from design.transparency import Transparency, decibels
from sim.run import Simulation
from sim.scenario import Scenario, load
from sim.stability import Stability, close, dominant_mode, eigenvalues, linear_growth
from sim.switching import Period, certified_part
from sim.trace import Trace

# ----------------------------------------------------------------------------------------------------
# Certificates, couplings and transparency.


def certificates_part(requirements: Mapping[str, Requirement]) -> dict[str, Any]:
    """Both conditions, each under its name and under the name that it had before: the same objects."""
    parts = {name: certificate_part(requirement) for name, requirement in requirements.items()}
    return with_older(parts, CONDITIONS)


def coupling_part(kind: str, coupling: Coupling, T: float) -> dict[str, Any]:
    """Kind, gains (None where it has none) and order of V, Q or R."""
    return {"kind": kind, "K": None, "B": None} | coupling.figures(T)


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


def encoder_steps(scenario: Scenario, case: str, coupling: Coupling) -> dict[str, Any] | None:
    """Whether the devices' friction pays for their encoders' steps."""
    steps, friction = ([getattr(device, of) for device in scenario.device] for of in ("encoder_step", "friction"))
    try:
        return encoder_part(scenario.loop(case), coupling, steps, friction)
    except ValueError:  # no solution of the algebraic loop, which the conditions have said
        return None


# ----------------------------------------------------------------------------------------------------
# What the paper prints beside what comes out here, for its own scenario.


#: The transparency indices (25) printed beside the gains [dB]; no reading of Figure 4 that we tried gives them.
PRINTED_TAU_DB = {"I": -4.15, "II": -3.09}


@dataclass(frozen=True)
class PaperRow:
    """A figure of the paper, and what it is here."""

    what: str
    paper: str
    here: str
    why: str


def beside_the_paper(
    scenario: Scenario, case: str, stability: Stability, coupling: dict[str, Any]
) -> tuple[PaperRow, ...]:
    """Every figure that the paper prints of its loop; none where the loop is another."""
    if scenario.varying_delay or scenario.loop(case) != load().loop(case):
        return ()
    figure = _figure(case, stability)
    return (figure,) if case == "none" else (*_printed_gains(scenario, case, coupling), _tau(case), figure)


def _printed_gains(scenario: Scenario, case: str, got: dict[str, Any]) -> tuple[PaperRow, ...]:
    printed = PUBLISHED[case]
    need = assess(scenario.loop(case), printed)
    any_environment, this_environment = (need[name].required for name in ("any-environment", "this-environment"))
    gains = PaperRow(
        "gains [N/m], [N s/m]",
        f"K = {listed(printed.K, 5)}, B = {listed(printed.B, 5)}",
        "none" if got["K"] is None else f"K = {listed(got['K'], 5)}, B = {listed(got['B'], 5)}",
        "the printed gains are no solution of the paper's own problem (next row)",
    )
    damping = PaperRow(
        "damping that the printed gains need [N s/m]",
        f"at most {listed(scenario.delta, 5)}",
        f"{listed(any_environment, 5)} by Theorem 4; {listed(this_environment, 5)} in this environment",
        "Theorem 4 as printed is strictly infeasible (E-hat has a pole at z = 1); mended, it refuses them",
    )
    return gains, damping


def _tau(case: str) -> PaperRow:
    why = "inf sigma_min(E) = 0: moving both contacts together costs no static force"
    return PaperRow("transparency index tau (25)", f"{PRINTED_TAU_DB[case]} dB", "infinite", why)


def _figure(case: str, stability: Stability) -> PaperRow:
    growth = f"{stability.exact_growth_rate_per_s:+.2f} 1/s at {stability.exact_frequency_hz:.1f} Hz"
    here = f"{stability.exact_verdict}: {growth}"
    if case != "none":
        why = "agrees; masses and stiffness of the devices are assumed"
        return PaperRow("Figure 6: with a coupling", "no oscillation", here, why)
    why = "agrees; masses and transmission of the devices are assumed: the paper's own first-order device is "
    why += "stable with each of 200 pairs of hands"
    return PaperRow("Figure 5: no coupling", "self-sustained oscillation", here, why)


# ----------------------------------------------------------------------------------------------------
# What a run with varying delays says: the delays it met, whether it grew, and what certificates cover.


_JUDGED = 4.0  # [s] at most of the linear loop from which a growth is read: later numbers may overflow


def delays_part(
    simulation: Simulation, chosen: Chosen, period: Period | None, ticks: int, certified: bool
) -> dict[str, Any] | None:
    """All that a report says of delays that vary; None where the scenario has none."""
    scenario = simulation.scenario
    if scenario.varying_delay is None:
        return None
    met = _delays_met(simulation, period, ticks) if scenario.switches else {}
    return delay_range_part(scenario.varying_delay) | met | certified_part(scenario, chosen, certified)


def delay_range_part(varying: VaryingDelay) -> dict[str, Any]:
    """The range of delays and how they vary within it."""
    return {
        "lo": list(varying.lo),
        "hi": list(varying.hi),
        "pattern": varying.pattern,
        "loss": varying.loss,
        "playout": varying.playout,
        "constant": varying.steady,
    }


def _delays_met(switched: Simulation, period: Period | None, ticks: int) -> dict[str, Any]:
    """The delays that a run met, and the growth of its linear loop under them."""
    delays = switched.process.delays
    assert delays is not None
    met = ages(delays[:ticks])[..., 0]
    used = met[(met >= 0).all(axis=1)]
    growth, window = linear_growth(switched, max(4, min(ticks, round(_JUDGED / switched.scenario.T))))
    return {
        "age": _age(used),
        "lost_packets": (delays[:ticks] == LOST).sum(axis=(0, 2)).tolist(),
        "held_ticks": (np.diff(used, axis=0) == 1).sum(axis=0).tolist(),
        "growth_rate_per_s": finite(growth),
        "verdict": "unstable" if growth > 0 else "stable",
        "judged_s": window,
        "period": None
        if period is None
        else {
            "ticks": len(period.ages),
            "growth_rate_per_s": finite(period.growth),
            "spectral_radius": period.spectral_radius,
            "verdict": "unstable" if period.growth > 0 else "stable",
        },
    }


def _age(used: Ticks) -> dict[str, Any] | None:
    """Of the forces in use [samples], per channel, from the first arrival on; None where none arrives."""
    if not used.size:
        return None
    figures = {"least": used.min(axis=0), "largest": used.max(axis=0), "mean": used.mean(axis=0)}
    return {name: values.tolist() for name, values in figures.items()}


def timing_part(timing: Timing | None, scenario: Scenario) -> dict[str, Any] | None:
    """What periods a run had and how late its forces latched; None where ticks are even and forces latch at them."""
    if timing is None:
        return None
    period = timing.period
    return {
        "period_s": {"least": float(period.min()), "mean": float(period.mean()), "largest": float(period.max())},
        "recorded": bool(scenario.period and scenario.period.recorded),
        "T_max_s": scenario.longest_period,
        "latency_s": scenario.latency and [list(span) for span in scenario.latency],
    }


def switched_stability(simulation: Simulation, trace: Trace, delays: dict[str, Any]) -> Stability:
    """As stability_of, for a loop that switches: it has no eigenvalue of its own but over a period."""
    worst = delays["period"] or delays
    constant = eigenvalues(dominant_mode(close(simulation.plant, simulation.F)))
    grows = trace.diverged or "unstable" in (worst["verdict"], delays["verdict"])
    theta = listed(simulation.scenario.theta)
    return Stability(
        **vars(constant),
        verdict="unstable" if grows else "stable",
        clipped_ticks=int(trace.clipped(simulation.process.force_limit).sum()),
        growth_rate_per_s=worst["growth_rate_per_s"],
        frequency_hz=trace.dominant_frequency_hz(),
        reason=f"{_how(delays)}; the eigenvalues are those of the constant delay theta = {theta}",
    )


def _how(delays: dict[str, Any]) -> str:
    if delays["period"]:
        return f"growth by the eigenvalues of the product over the {delays['period']['ticks']} ticks of a period"
    return f"growth of the linear loop after an impulse, over {delays['judged_s']:.3g} s under the run's delays"
