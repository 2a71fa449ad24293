"""Design three couplings for one loop and compare guarantees, required damping and transparency."""

from haptic_loop import assess, design_coupling, load, transparency_of

LOOP = load("omega-pair").loop("I")
DESIGNS = [("spring-damper", "any-environment"), ("spring-damper", "this-environment"), ("optimal", "this-environment")]


def main() -> None:
    print(f"{'coupling':31} {'needs N s/m':>12} {'worst dB':>9} {'rms dB':>7}  certified for")
    for kind, condition in DESIGNS:
        design = design_coupling(LOOP, kind, condition)
        figures = transparency_of(LOOP, design)
        needed = max(design.requirement.required)
        worst, rms = figures.mismatch_db, figures.rms_mismatch_db
        guarantee = assess(LOOP, design).guarantee
        covered = guarantee.environments if guarantee else None
        print(f"{kind + ', ' + condition:31} {needed:12.4f} {worst:9.2f} {rms:7.2f}  {covered}")


if __name__ == "__main__":
    main()
