"""From a scenario to a figure, cell by cell: open this file in an editor with cells (VS Code, Spyder), or run it."""

# %% Load a laboratory: devices, hands, delays and the object
from pathlib import Path

from haptic_loop import assess, design_coupling, load, simulate, transparency_of, validate

scenario = load("omega-pair").replace(duration=8.0)
print(scenario)

# %% Without a coupling the loop oscillates
loop = scenario.loop("I")
before = simulate(scenario)
stability = before.meta["stability"]
growth, hertz = stability["exact_growth_rate_per_s"], stability["exact_frequency_hz"]
print(f"no coupling: growth {growth:+.3f} 1/s at {hertz:.1f} Hz")

# %% Design a coupling, and see for whom it is safe
design = design_coupling(loop)
print(design)
print(assess(loop, design).guarantee)
print(transparency_of(loop, design))

# %% Run the same hands with the coupling, then other hands
after = simulate(scenario, design)
print(f"designed coupling: growth {after.meta['stability']['exact_growth_rate_per_s']:+.3f} 1/s")
print(validate(scenario, design, humans=50, engine="exact", duration=0))

# %% Look at the forces: a picture for the screen, and one for a paper
out = Path("out/first-steps")
out.mkdir(parents=True, exist_ok=True)
before.plot(out / "no-coupling.png")
figure = after.plot(out / "designed-coupling.pdf")  # evaluate `figure` to see the picture in an editor
