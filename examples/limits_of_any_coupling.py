"""How small can the error of a coupling be? Design optimal couplings for several dampings, delays and periods.

python examples/limits_of_any_coupling.py [damping|delay|period ..]      (a minute for all three)
"""

import sys

from matplotlib.figure import Figure

from haptic_loop import DesignFailed, Scenario, design_coupling, load, transparency_of

BASE = load("omega-pair")  # T = 1.2 ms, theta = (1, 2) samples, 1.37 N s/m
FLOOR = -60.0  # [dB] shown in place of lower errors, such as those of loops that need no coupling


def scaled(factor: float) -> Scenario:
    """Return the base scenario with `factor` times the damping."""
    return BASE.replace(delta=[factor * d for d in BASE.delta])


AXES = {
    "damping": ("damping [N s/m]", {round(1.37 * k, 3): scaled(k) for k in (0.7, 1.0, 1.4)}),
    "delay": ("largest delay [samples]", {n + 1: BASE.replace(theta=(n, n + 1)) for n in range(3)}),
    "period": ("sampling period [ms]", {T: BASE.replace(T=1e-3 * T) for T in (0.8, 1.2, 1.8)}),
}


def error_db(scenario: Scenario, kind: str) -> float | None:
    """Return the rms transparency error [dB], or None if the design fails."""
    try:
        return transparency_of(loop := scenario.loop("I"), design_coupling(loop, kind)).rms_mismatch_db
    except DesignFailed:
        return None


def main(names: list[str]) -> None:
    figure = Figure((4.2 * len(names), 3.4), layout="constrained")
    for name, axis in zip(names, figure.subplots(1, len(names), squeeze=False)[0], strict=True):
        label, scenarios = AXES[name]
        print(f"{label:26} {'optimal dB':>11} {'spring-damper dB':>17}")
        axis.set(xlabel=label, ylabel="rms transparency error [dB]")
        curves = [[error_db(each, kind) for each in scenarios.values()] for kind in ("optimal", "spring-damper")]
        for x, *errors in zip(scenarios, *curves, strict=True):
            print(f"{x:<26} " + " ".join(f"{'-' if e is None else f'{max(e, FLOOR):.2f}':>13}" for e in errors))
        for words, marker, curve in zip(("optimal", "spring-damper"), "os", curves, strict=True):
            known = [(x, max(e, FLOOR)) for x, e in zip(scenarios, curve, strict=True) if e is not None]
            axis.plot(*zip(*known, strict=True), marker, linestyle="-", label=words)
        axis.legend()
    figure.savefig("limits.png", dpi=120)


if __name__ == "__main__":
    main(sys.argv[1:] or list(AXES))
