"""A virtual wall on a Hapkit: which stiffness may students program, and what happens beyond it?

out/hapkit/wall.json is the safe wall for hw/firmware/hapkit.ino, whose forces act one tick late: docs/hardware.md.
The friction and damping of a Hapkit are not published and differ from kit to kit: the numbers below are examples.
`python -m hw.identify` measures yours.
"""

from pathlib import Path

from haptic_loop import NoCoupling, Scenario, assess, parse, simulate
from haptic_loop.design.coupling_file import Stored, save

T, DAMPING = 1.25e-3, 0.5  # [s], [N s/m]: put yours here
LAB = """
name = "hapkit wall"
T = {T}
theta = [1]
duration = 3.0
device = [{{ device = "hapkit", mass = 0.07, damping = {DAMPING}, force_limit = 4.8 }}]

[[human]]
links = [{{ mass = 0.05, damping = 0.2, stiffness = 30.0 }}]
voluntary = {{ amplitude = 0.02, frequency = 0.5 }}

[environment]
contacts = ["handle"]
walls = [{{ between = ["handle", "ground"], stiffness = {K}, gap = 0.005 }}]

[tap]
channel = 1
force = 1.0
start = 0.1
duration = 0.01
"""


def lab(stiffness: float) -> Scenario:
    return parse(LAB.format(T=T, DAMPING=DAMPING, K=stiffness))


def main(out: Path = Path("out/hapkit")) -> None:
    out.mkdir(parents=True, exist_ok=True)
    safe = DAMPING / (1.5 * T)  # Colgate and Schenkel: b > K T/2, and K T more for forces one tick late
    for stiffness, name in ((0.99 * safe, "safe"), (6 * safe, "too-stiff")):
        loop = lab(stiffness).loop("I")
        found = assess(loop, NoCoupling())
        needs, proof = found.requirements["this-environment"], found.force_limits.certificate
        if proof:  # also while forces are limited
            save(Stored.of(loop, NoCoupling(), proof), out / "wall.json")
        trace = simulate(lab(stiffness), NoCoupling())
        print(f"wall of {stiffness:.0f} N/m: {needs}; last second: {abs(trace.f[-1000:]).max():.2f} N at most")
        trace.plot(out / f"{name}.png", f"a wall of {stiffness:.0f} N/m on a Hapkit of {DAMPING} N s/m")


if __name__ == "__main__":
    main()
