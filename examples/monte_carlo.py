"""Random passive hands on the devices: how many make the loop unstable, without a coupling and with a designed one?"""

import numpy as np
from scipy.special import betaincinv

from haptic_loop import Design, Scenario, design_coupling, load, validate

HANDS = 500


def meet(name: str, scenario: Scenario, coupling: Design | None) -> int:
    """Print how many hands make the loop unstable and which hand is worst; return the number of unstable hands."""
    findings = validate(scenario, coupling, humans=HANDS, seed=1, engine="exact", duration=0)
    unstable = int((findings.exact > 0).sum())
    worst = int(np.argmax(findings.exact))
    most = betaincinv(unstable + 1, HANDS - unstable, 0.95) if unstable < HANDS else 1.0  # limit by Clopper and Pearson
    limit = f"at most {100 * most:.1f} % of all such hands (95 % confidence)"
    print(f"{name}: {unstable} of {HANDS} hands unstable; {limit}")
    print(f"  the worst one: {findings.exact[worst]:+.3f} 1/s at {findings.frequency[worst]:.1f} Hz (index {worst})")
    return unstable


def main() -> None:
    scenario = load("omega-pair")
    meet("no coupling", scenario, None)
    design = design_coupling(scenario.loop("I"))
    if meet("designed coupling", scenario, design):
        raise SystemExit("a certified coupling was destabilised: please report this")


if __name__ == "__main__":
    main()
