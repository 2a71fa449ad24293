"""Design three couplings for one loop and compare what each promises, what it costs and how transparent it is."""

from controller.process import force_map
from design import certify, design_coupling
from design.assess import specification
from design.promises import promise_of
from design.transparency import decibels, transparency
from sim import load

LOOP = load("omega-pair").loop("I")
WISHES = [("spring-damper", "theorem4"), ("spring-damper", "closed-loop"), ("optimal", "closed-loop")]


def main() -> None:
    E = specification(LOOP).environment
    print(f"{'coupling':28} {'needs N s/m':>12} {'worst dB':>9} {'rms dB':>7}  certified for")
    for kind, condition in WISHES:
        design = design_coupling(LOOP, kind, condition)
        F = force_map(E, design.coupling, LOOP.theta, LOOP.psi)
        figures = transparency(F, E, LOOP.lam)
        needed = max(design.requirement.required)
        worst, rms = decibels(figures.relative_mismatch), decibels(figures.rms_mismatch)
        promise = promise_of(certify(LOOP, design), LOOP)
        print(f"{kind + ', ' + condition:28} {needed:12.4f} {worst:9.2f} {rms:7.2f}  {promise}")


if __name__ == "__main__":
    main()
