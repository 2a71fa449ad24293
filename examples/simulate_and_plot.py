"""Figures 5 and 6: the same two devices and hands without a coupling and with the designed one, in MuJoCo."""

from pathlib import Path

import numpy as np

from haptic_loop import Trace, design_coupling, load, simulate

SECONDS = 8.0


def show(name: str, result: Trace, out: Path) -> None:
    """One line of figures, and a picture."""
    stability = result.meta["stability"]
    growth, hertz = stability["exact_growth_rate_per_s"], stability["exact_frequency_hz"]
    last = result.f[result.t > SECONDS - 1]
    loudest = np.sqrt(np.mean(last**2, axis=0)).max()
    print(f"{name}: growth {growth:+.3f} 1/s at {hertz:.1f} Hz; {loudest:.2f} N rms in the last second")
    result.plot(out / f"{name.replace(' ', '-')}.png", f"{name}: growth {growth:+.3f} 1/s")


def main(out: Path = Path("out/simulate-and-plot")) -> None:
    out.mkdir(parents=True, exist_ok=True)
    scenario = load("omega-pair").replace(duration=SECONDS)
    show("no coupling", simulate(scenario), out)
    show("designed coupling", simulate(scenario, design_coupling(scenario.loop("I"))), out)
    print(f"pictures: {', '.join(sorted(str(path) for path in out.glob('*.png')))}")


if __name__ == "__main__":
    main()
