"""Test MuJoCo worlds over the device protocol, and the account of energy at their contacts."""

import json

import numpy as np
import pytest
from causes import cause_of

from haptic_loop.cli import bridge, replay
from haptic_loop.controller.budget import Shell
from haptic_loop.controller.coupling import SpringDamper
from haptic_loop.controller.lti import Lti
from haptic_loop.hw.control import CouplingRequest, WorldController, certified_couplings, timed
from haptic_loop.hw.emulator import Emulator, FaultInjection
from haptic_loop.hw.limits import Stage
from haptic_loop.hw.monitor import LinkSettings
from haptic_loop.hw.recording import load as read
from haptic_loop.hw.rehearsal import Rehearsal, rehearse
from haptic_loop.hw.session import session_for
from haptic_loop.models import world as world_of
from haptic_loop.sim.scenario import InputError, load

DRIVEN = """<mujoco><option gravity="0 0 0"/><worldbody>
<body name="left" pos="-0.03 0 0"><geom type="sphere" size="0.01"/></body>
<body name="right" pos="0.03 0 0"><geom type="sphere" size="0.01"/></body>
<body name="load"><joint name="j" type="slide" axis="1 0 0"/><geom type="box" size="0.019 0.05 0.05" mass="0.3"/></body>
</worldbody><actuator><velocity joint="j" kv="-60"/></actuator></mujoco>"""


def session(tmp_path, capsys, *words):
    """Rehearse a session by the command; return exit code, report and output."""
    code = bridge.main(["--rehearse", "--no-plot", "--out", str(tmp_path / "out"), *words])
    return code, json.loads((tmp_path / "out" / "report.json").read_text()), " ".join(capsys.readouterr().out.split())


def driven(tmp_path):
    """Write a scene whose motor always gives energy, and return its scenario file."""
    (tmp_path / "driven.xml").write_text(DRIVEN)
    (tmp_path / "loop.toml").write_text(
        """name = "driven"
T = 1e-3
theta = [1, 1]
device = [{ kind = "rigid", mass = 0.25, damping = 1.37, force_limit = 12.0 },
          { kind = "rigid", mass = 0.25, damping = 1.37, force_limit = 12.0 }]
[environment]
world = "driven.xml"
contacts = ["left", "right"]
[[human]]
links = [{ mass = 0.3, damping = 3.0, stiffness = 200.0 }]
voluntary = { amplitude = 0.03, frequency = 0.5, phase = 0.0, ease = 0.5 }
[[human]]
links = [{ mass = 0.3, damping = 3.0, stiffness = 200.0 }]
"""
    )
    return tmp_path / "loop.toml"


def account(trace, link, coupling, T):
    """Return the least sum of f'(u - u_-) [J], without the program's shell.

    f is the force as it was sent, u = x - V f, and u_- is u at the previous tick.

    Forces that test a motor are left out, since the scene does not send them.
    """
    V: Lti = coupling.compliance(T)
    f = -4e-4 * link["sent"] * ~link["test"].any(axis=1, keepdims=True)
    state, before, total, least = np.zeros(V.order), np.zeros(2), 0.0, 0.0
    for x, force in zip(trace.x, f, strict=True):
        u = x - (V.C @ state + V.D @ force)
        state = V.A @ state + V.B @ force
        total, before = total + force @ (u - before), u
        least = min(least, total)
    return least


@pytest.mark.slow
def test_a_world_is_rehearsed_behind_its_shell(tmp_path, capsys):
    """The energy given stays within the budget, and a session in a world has no replay."""
    code, report, shown = session(tmp_path, capsys, "--scenario", "world-ball", "--duration", "0.4")
    (world,) = report["world"]
    assert code == 0
    assert "W0 = 2 mJ" in shown
    assert "us of CPU time (median)" in shown
    assert world["ticks_acted"] == 0
    assert world["step_us"]["p50"] > 0
    assert world["given_J"] <= 2e-3 + world["released_J"]
    with pytest.raises(InputError, match="MuJoCo world, which is not in the trace"):
        replay.main([str(tmp_path / "out" / "trace.npz")])


@pytest.mark.slow
def test_steps_whose_limits_do_not_settle_are_reported(tmp_path, capsys, monkeypatch):
    """If no step may be repeated, the steps that do not settle are those with a force at the cap."""
    monkeypatch.setattr(world_of, "_MOST_REPETITIONS", 0)
    words = ("--scenario", str(driven(tmp_path)), "--duration", "0.5", "--force-cap", "1")
    _, report, shown = session(tmp_path, capsys, *words)
    _, link = read(tmp_path / "out" / "trace.npz")
    (world,) = report["world"]
    limited = int((np.abs(link["asked"]) >= 1.0).any(axis=1).sum())
    assert limited > 20
    assert world["unsettled_steps"] == limited
    assert f"limited forces did not settle in {limited} steps of the scene" in shown


@pytest.mark.slow
@pytest.mark.parametrize("budget", [pytest.param(0.002, marks=pytest.mark.validate), 0.02])
def test_rehearsals_hold_back_an_active_scene(tmp_path, capsys, budget):
    """The scene's motor has negative damping and forces are whole steps of 0.4 mN; the account still holds."""
    words = (
        "--scenario",
        str(driven(tmp_path)),
        "--duration",
        "1",
        "--force-cap",
        "2",
        "--energy-budget",
        str(budget),
    )
    _, report, shown = session(tmp_path, capsys, *words)
    (world,) = report["world"]
    assert report["link"]["counters"]["limited"] >= world["ticks_acted"]
    assert report["scene"]["active"] == ["actuator 0"]
    assert "active parts: actuator 0" in shown
    trace, link = read(tmp_path / "out" / "trace.npz")
    coupling = read_coupling_of(trace)
    assert world["ticks_acted"] > 10
    assert np.abs(link["sent"]).max() > 100
    least = account(trace, link, coupling, 1e-3)
    assert least == pytest.approx(world["port_least_J"], abs=1e-12)
    assert -budget - 1e-12 <= least < -0.9 * budget
    assert world["given_J"] <= budget + world["released_J"] + 1e-12


def read_coupling_of(trace):
    from haptic_loop.hw.recording import _recipes_of

    (recipe,) = _recipes_of(trace)
    return recipe.coupling.build(recipe.scenario.T)


def in_the_ball_world(name, until, *faults):
    """Run a session in the scenario `name`, a world, stopped `until` [s] after arming.

    Return the session and the total energy given at every tick [J].
    """
    scenario, rows = load(name), []
    faults = tuple(map(FaultInjection.parse, faults))
    session = session_for(scenario, LinkSettings(measure=60), 2.0)
    session.record = rows.append

    def plan(ages):
        met, link = timed(scenario, ages, 0.99, 100.0)
        return certified_couplings(CouplingRequest(met, name="moving-average"), link, spare=0)

    stop = [(until, lambda session, now: session.stop("asked to", now))]
    Rehearsal(session, Emulator(scenario, faults), plan, faults, actions=stop).run_until_armed(2.6)
    x = np.array([row.x for row in rows])
    f = -4e-4 * np.array([row.state.applied for row in rows])[:-1]
    dx = np.diff(x, axis=0)
    return session, -(f * dx + scenario.delta / np.array(scenario.T) * dx**2).sum(axis=1).cumsum()


@pytest.mark.slow
def test_sessions_in_worlds_finish_within_their_account():
    """The devices give at most W0 and what was released; their motion and the applied forces show this."""
    session, given = in_the_ball_world("world-space", 1.1)  # two devices of three axes
    assert session.stage == Stage.FINISHED, session.cause
    assert given.max() <= 2e-3 + session.worlds[0].port.released


@pytest.mark.slow
def test_a_dead_motor_in_a_world_never_finishes():
    session, _ = in_the_ball_world("world-ball", 1.1, "axis2:motor=0@0.8")
    assert session.stage == Stage.STOPPED
    assert cause_of(session.cause) == "no answer at the end: 2 2"


def test_the_host_delays_forces_beyond_the_link():
    world = WorldController(load("world-ball"), SpringDamper([800.0, 800.0], [0.4, 0.4]), 0.0, [2.0, 2.0], [0, 3])
    sent = [world.later((k, 10 * k), 1) for k in range(1, 6)]
    assert sent == [(1, 0), (2, 0), (3, 0), (4, 10), (5, 20)]
    assert world.later((9, 90), 3) == (9, 50)  # two ticks had no answer: the force before is held
    assert world.later((9, 100), 1) == (9, 50)


def test_ticks_without_answers_count_in_the_energy():
    """The device holds its force in every third tick, which the energy of the shell counts like the others."""
    coupling, unit, T = SpringDamper([800.0, 800.0], [0.4, 0.4]), np.array([4e-4, 4e-4]), 1e-3
    scenario = load("world-ball").replace(T=T)
    world = WorldController(scenario, coupling, 0.1, [2.0, 2.0], [0, 0])
    V, total, f, before = coupling.compliance(T), 0.0, np.zeros(2), np.zeros(2)
    state = np.zeros(V.order)
    for k in range(61):
        x = 0.02 * np.sin(k / 10) * np.array([1.0, -1.0])
        asked = world.step(x)
        if k % 3 < 2:
            f = -unit * world.limit([round(-force / 4e-4) for force in asked], unit)
        u = x - V.C @ state - V.D @ f
        state, total, before = V.A @ state + V.B @ f, total + f @ (u - before), u
        if k % 3 < 2:
            assert world.shell.energy[0] == pytest.approx(0.1 + total + world.port.released, abs=1e-12)
    assert abs(total) > 1e-3


def test_a_force_in_steps_never_overdraws_the_shell():
    V, rng, step = SpringDamper([500.0, 700.0], [0.5, 0.4]).compliance(1e-3), np.random.default_rng(0), 0.05
    shell, dearer = Shell(V, start=1e-4), 0
    for _ in range(2000):
        shell.free(1e-3 * rng.normal(size=(2, 1)))
        wanted = step * np.round(rng.normal(size=(2, 1)) / step)
        force, _ = shell.limit(wanted, lambda f, w=wanted: np.where(f == w, f, step * np.trunc(f / step)))
        assert np.abs(force / step - np.round(force / step)).max() < 1e-9
        assert shell.energy[0] >= -1e-18
        dearer += bool((force == 0).all())
    assert 0 < dearer < 2000


@pytest.mark.slow
def test_a_rehearsal_from_python_takes_a_world():
    rehearsed = rehearse(load("world-door"), seconds=0.3)
    assert rehearsed.stage == "finished"
    assert rehearsed.assessment.guarantee.energy_J == 2e-3
