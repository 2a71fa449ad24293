"""Animate the same hands on the same devices, without a coupling and with the certified one.

python examples/unstable_and_certified.py [FILE.gif]
"""

import sys

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from PIL import Image

from haptic_loop import assess, design_coupling, load, simulate

SECONDS, FRAMES_PER_SECOND, CHANNEL = 12.0, 4, 1


def main(path: str) -> None:
    scenario = load("omega-pair").replace(duration=SECONDS)
    loop = scenario.loop("I")
    design = design_coupling(loop)
    guarantee = assess(loop, design.coupling).guarantee
    safe = f"guaranteed for {guarantee.hands} and {guarantee.environments}" if guarantee else "no guarantee"
    runs = {"without coupling": simulate(scenario), f"designed coupling, {safe}": simulate(scenario, design)}
    panels = {f"{name}: {trace.meta['stability']['verdict']}": trace for name, trace in runs.items()}
    figure, axes = plt.subplots(2, 1, figsize=(7, 3.6), sharex=True, layout="constrained")
    lines = []
    for axis, (title, trace), color in zip(axes, panels.items(), ("tab:red", "tab:blue"), strict=True):
        axis.set_title(title, loc="left", fontsize=9)
        axis.set(xlim=(0, SECONDS), ylim=(-13, 13), ylabel="force [N]")
        lines.append((axis.plot([], [], color=color, linewidth=0.8)[0], trace))
    axes[-1].set_xlabel("time [s]")
    frames = []
    for frame in range(1, int(SECONDS * FRAMES_PER_SECOND) + 1):
        for line, trace in lines:
            shown = trace.t <= frame / FRAMES_PER_SECOND
            line.set_data(trace.t[shown], trace.f[shown, CHANNEL])
        figure.canvas.draw()
        figure.set_layout_engine("none")  # every frame has the layout of the first frame
        size = figure.canvas.get_width_height()
        frames.append(Image.frombuffer("RGBA", size, figure.canvas.buffer_rgba()).convert("P", palette=1, colors=32))
    frames[0].save(path, save_all=True, append_images=frames[1:], duration=1000 // FRAMES_PER_SECOND, loop=0)
    print(*panels, path, sep="\n")


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else "unstable-and-certified.gif")
