"""Assess and simulate two Omegas that hold a block between springs in x, y and z, and draw the handles' paths."""

from pathlib import Path

from matplotlib.figure import Figure

from haptic_loop import SpringDamper, assess, load, simulate


def main(out: Path = Path("out/omega-in-space")) -> None:
    out.mkdir(parents=True, exist_ok=True)
    scenario = load("omega-space").replace(duration=4.0)
    loop = scenario.loop("I")  # channels 1 to 3 are x, y, z of the first device
    coupling = SpringDamper([600.0] * 6, [0.4] * 6)  # [N/m], [N s/m]: alike in every direction
    assessment = assess(loop, coupling)
    for name, needs in assessment.requirements.items():
        print(f"{name}: needs {needs.ratio:.4f} of the damping")
    print(assessment.guarantee or assessment.reason)
    trace = simulate(scenario, coupling)
    print(trace)
    figure = Figure((5, 4), layout="constrained")
    axis = figure.add_subplot(projection="3d")
    for first, name in ((0, "left"), (3, "right")):
        axis.plot(*(1e3 * trace.x_handle[:, first : first + 3].T), label=name)
    axis.set(xlabel="x [mm]", ylabel="y [mm]", zlabel="z [mm]")
    axis.legend()
    figure.savefig(out / "handles.png", dpi=130)


if __name__ == "__main__":
    main()
