"""Is a hand-picked coupling safe for every passive human? If not, by which factor must its gains shrink?

The loop is that of the paper which README.md names: two devices of 1.37 N s/m, T = 1.2 ms, delays of 1 and 2 samples.
"""

from haptic_loop import SpringDamper, certify, load

LOOP = load("omega-pair").loop("I")
K, B = (2870.0, 2320.0), (5.47, 5.55)  # the paper's gains (27) [N/m], [N s/m]


def safe(share: float) -> bool:
    """Return whether the gains times `share` are certified in this environment."""
    gains = SpringDamper([share * k for k in K], [share * b for b in B])
    return certify(LOOP, gains)["this-environment"].certified


def largest_safe_share(steps: int = 20) -> float:
    """Return the largest share of the gains that is certified, by bisection to a millionth."""
    low, high = 0.0, 1.0
    for _ in range(steps):
        middle = (low + high) / 2
        low, high = (middle, high) if safe(middle) else (low, middle)
    return low


def main() -> None:
    for name, requirement in certify(LOOP, SpringDamper(K, B)).items():
        needed = ", ".join(f"{b:.4f}" for b in requirement.required)
        verdict = f"certified ({requirement.proof})" if requirement.certified else "not certified"
        print(f"{name:>11}: needs {needed} of 1.37 N s/m: {verdict}, binds at {requirement.frequency_hz:.1f} Hz")
    share = largest_safe_share()
    print(f"this-environment certifies the gains times {share:.4f}: K = {share * K[0]:.0f}, {share * K[1]:.0f} N/m")


if __name__ == "__main__":
    main()
