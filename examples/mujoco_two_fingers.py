"""Two force-feedback devices squeeze a cube in a MuJoCo world: the scene, the run and its guarantee."""

from pathlib import Path

from haptic_loop import design_coupling, load, simulate

OUT = Path("out/two-fingers")
SCENE = """
<mujoco>
  <option gravity="0 0 -9.81"/>
  <default><geom solimp="0.9 0.9 0.001" friction="1"/></default>
  <worldbody>
    <geom type="plane" size="0.3 0.3 0.02"/>
    <body name="left" pos="-0.05 0 0.03"><geom type="sphere" size="0.01"/></body>
    <body name="right" pos="0.05 0 0.03"><geom type="sphere" size="0.01"/></body>
    <body name="cube" pos="0 0 0.03">
      <joint type="slide" axis="1 0 0" damping="0.5"/>
      <geom type="box" size="0.03 0.03 0.03" mass="0.2"/>
    </body>
  </worldbody>
</mujoco>
"""
LAB = """
name = "two-fingers"
T = 1e-3
theta = [1, 2]
duration = 4.0
device = [{ kind = "rigid", damping = 1.37 }, { kind = "rigid", damping = 1.37 }]
environment = { world = "cube.xml", contacts = ["left", "right"] }

[[human]]
links = [{ mass = 0.3, damping = 3.0, stiffness = 200.0 }]
voluntary = { amplitude = 0.03, frequency = 0.5, phase = 0.0 }

[[human]]
links = [{ mass = 0.3, damping = 3.0, stiffness = 200.0 }]
voluntary = { amplitude = 0.03, frequency = 0.5, phase = 3.14 }
"""


def main() -> None:
    OUT.mkdir(parents=True, exist_ok=True)
    (OUT / "cube.xml").write_text(SCENE)
    (OUT / "lab.toml").write_text(LAB)
    scenario = load(OUT / "lab.toml")
    design = design_coupling(scenario.loop("I"), "moving-average")  # the stiffest coupling for any passive object
    trace = simulate(scenario, design)
    print(trace)
    print(f"largest force {abs(trace.f).max():.2f} N; {trace.meta['guarantee']}")
    trace.plot(OUT / "run.png", "two fingers squeeze a cube")


if __name__ == "__main__":
    main()
