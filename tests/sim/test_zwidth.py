"""Ratios of maps over gains K and B equal closed forms and single couplings; their verdicts equal single loops.

Tolerances without a comment cover rounding. Eigenvalues round by up to 1e-7 1/s, after division by T.
"""

import csv
import json
from dataclasses import replace
from itertools import count

import msgspec
import mujoco
import numpy as np
import pytest
from driven import drive
from messages import says
from shared import force_map, loop_of

from haptic_loop.cli import zwidth
from haptic_loop.cli.execute import execute
from haptic_loop.cli.options import BAD_INPUT, DOES_NOT_HOLD, INTERRUPTED
from haptic_loop.controller.coupling import SpringDamper
from haptic_loop.controller.environment import GROUND, RIGID_WALL, Network, Spring, Wall, environment
from haptic_loop.controller.law import Law
from haptic_loop.controller.loop import Loop
from haptic_loop.controller.tick import Process, StepBuffer
from haptic_loop.design.environments import THIS_ENVIRONMENT
from haptic_loop.design.frequency import on_circle, suprema
from haptic_loop.models.device import CompliantDevice, RigidDevice
from haptic_loop.models.human import Human, Link
from haptic_loop.models.scene import build, crowds, variants
from haptic_loop.sim import zwidth as zwidth_map
from haptic_loop.sim.engines import _discretised
from haptic_loop.sim.limit_cycles import UNDECIDED, HeldDevices, Plan, Points, _press_forces
from haptic_loop.sim.scenario import InputError, load
from haptic_loop.sim.stability import dominant_mode, exact_loops
from haptic_loop.sim.trace import oscillation, slowest_seen
from haptic_loop.sim.zwidth import CouplingSweep, Grid, Map, Mark, draw_map, make_grid
from haptic_loop.sim.zwidth_report import MapReport

DELTA, T = 1.37, 1e-3
PAIR, STAR = load("omega-pair"), load("three-rigid")
#: the pair with two walls in place of its springs
WALLED_PAIR = Network(
    PAIR.environment.contacts,
    PAIR.environment.springs[2:],
    PAIR.environment.masses,
    tuple(Wall(s.between, s.stiffness, s.damping) for s in PAIR.environment.springs[:2]),
)


def rigid(theta=0, **changes):
    loop = Loop(T, (theta,), (0,), (theta,), PAIR.delta[:1], RIGID_WALL)
    return CouplingSweep(PAIR.device[:1], PAIR.population, loop, **changes)


def of(scenario, theta, psi=None, network=None, **changes):
    """Return the sweep of a scenario's loop with other delays, or another network."""
    psi = psi or (0,) * scenario.channels
    network = network or scenario.environment
    loop = Loop(scenario.T, theta, psi, theta, scenario.delta, network)
    return CouplingSweep(scenario.device, scenario.population, loop, **changes)


def softer(network, share):
    springs = tuple(Spring(s.between, share * s.stiffness, share * s.damping) for s in network.springs)
    return Network(network.contacts, springs, network.masses)


def wall(theta, K, B):
    """Return the damping [N s/m] that this-environment and any-environment require against a rigid wall."""
    sweep = rigid(theta)
    assert sweep.loop.delta == (DELTA,)
    return [DELTA * sweep.ratios(name, np.array(K), np.array(B)) for name in ("this-environment", "any-environment")]


# --- the figures ---------------------------------------------------------------------------------------------------

SWEEPS = {
    "wall, no delay": rigid(0),
    "wall, one sample": rigid(1),
    "wall, seven samples": rigid(7),
    "pair": of(PAIR, (1, 2)),
    "pair, delay in a soft environment": of(PAIR, (1, 2), (1, 0), softer(PAIR.environment, 0.25)),
    "pair, delay inside": of(PAIR, (1, 2), (1, 0)),
    "star of three": of(STAR, (0, 3, 1)),
    "walls": of(PAIR, (1, 1), network=WALLED_PAIR),
}


@pytest.mark.parametrize("name", SWEEPS)
def test_maps_equal_requirements_of_single_couplings(name):
    """Maps begin at 1e-6 rad/sample; the relative error that this causes grows as the squared delay, here to 1e-11.

    The tolerance is that of the widest plane in the next test.
    """
    sweep = SWEEPS[name]
    rng = np.random.default_rng(1)
    K, B = np.exp(rng.uniform(np.log(30), np.log(8e3), 8)), np.append(0.0, rng.uniform(0, 3, 7))
    for condition in ("any-environment", "this-environment"):
        drawn = sweep.ratios(condition, K, B)
        true = np.array([sweep.requirement(condition, k, b).ratio for k, b in zip(K, B, strict=True)])
        assert (np.isfinite(drawn) == np.isfinite(true)).all()
        finite = np.isfinite(true)
        np.testing.assert_allclose(drawn[finite], true[finite], rtol=2e-9)
    if name == "pair, delay inside":
        assert sweep.refusals.keys() == {"any-environment"}


@pytest.mark.parametrize("scenario", [PAIR, STAR], ids=lambda s: s.name)
def test_maps_of_the_widest_plane_match_sweeps(scenario):
    """A free mass on K = 1e-3 N/m swings at 5e-5 rad/sample; the frequency that replaces 0 must be far below that.

    When measured, relative errors were up to 6e-10.
    """
    sweep = of(scenario, scenario.theta)
    K, B = (axis.ravel() for axis in np.meshgrid(np.geomspace(1e-3, 1e9, 5), np.geomspace(1e-5, 1e6, 4)))
    true = [sweep.requirement("this-environment", k, b).ratio for k, b in zip(K, B, strict=True)]
    np.testing.assert_allclose(sweep.ratios("this-environment", K, B), true, rtol=2e-9)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("theta", "least"), [(0, 1.6154), pytest.param(1, 1.8630, marks=pytest.mark.validate), (2, 2.3639)]
)
def test_maps_at_walls_match_single_sweeps(theta, least):
    """2000 N/m and 2 N s/m need `least` at a wall of 3000 N/m and 2 N s/m. With delay permanent contact needs less."""
    network = Network(("tip",), walls=(Wall(("tip", GROUND), 3000.0, 2.0),))
    sweep = CouplingSweep(PAIR.device[:1], PAIR.population, Loop(T, (theta,), (0,), (0,), (DELTA,), network))
    K, B = np.array([2000.0, 400.0]), np.array([2.0, 0.5])
    drawn = sweep.ratios("this-environment", K, B)
    assert drawn[0] * DELTA == pytest.approx(least, abs=1e-4)
    for cell in range(2):
        coupling = SpringDamper([K[cell]], [B[cell]])
        audited = THIS_ENVIRONMENT.judge(sweep.loop, coupling)
        assert sweep.requirement("this-environment", K[cell], B[cell]) == audited
        assert drawn[cell] == audited.ratio
    frozen = THIS_ENVIRONMENT.judge(sweep.loop.frozen()[-1], SpringDamper([2000.0], [2.0]))
    assert frozen.required[0] < least - 5e-3 or theta == 0


def test_undelayed_walls_match_colgates_condition():
    K, B = np.random.default_rng(0).uniform([[1], [0]], [[6000], [3]], (2, 50))
    for needed in wall(0, K, B):
        np.testing.assert_allclose(needed, K * T / 2 + B, rtol=1e-10)


def test_late_springs_require_the_closed_form_damping():
    K = np.geomspace(10, 5000, 9)
    # The supremum is at w -> 0; the map begins at 1e-6 rad/sample.
    for needed, share in zip(wall(1, K, 0 * K), (1.5, 2), strict=True):
        np.testing.assert_allclose(needed, share * K * T, rtol=1e-9)


@pytest.mark.slow
def test_the_stiffest_certified_spring_dampers_are_known():
    """The largest K is 2740 N/m without delay (2 delta/T), and 1135 with one sample of delay against a wall.

    Against every passive environment it is 878.86 N/m at T = 1.2 ms, and inversely proportional to T."""
    K, B = (
        axis.ravel()
        for axis in np.meshgrid([*np.arange(1050.0, 1060), *np.arange(1130.0, 1140)], np.linspace(0.32, 0.4, 41))
    )
    for needed, stiffest in zip(wall(1, K, B), (1135, np.floor(878.86 * 1.2)), strict=True):
        # The figures are rounded, and the grid's step is 1 N/m.
        assert K[needed < DELTA].max() == pytest.approx(stiffest, abs=1)
    assert wall(0, [2739.9, 2740.1], [0.0, 0.0])[1] == pytest.approx(DELTA, rel=1e-4)  # 0.1 of 2740 N/m is 4e-5


def test_the_force_maps_are_those_of_single_couplings():
    sweep, K, B = of(PAIR, (1, 2), (0, 1)), np.array([800.0, 50.0]), np.array([0.5, 0.0])
    (stack,), z = sweep.force_maps(K, B), on_circle(np.linspace(0.01, 3, 40))
    E = environment(PAIR.environment, PAIR.T)
    for i in range(2):
        F = force_map(E, SpringDamper([K[i]] * 2, [B[i]] * 2), (1, 2), (0, 1))
        # the free mass has two poles near z = 1, which cost seven digits
        np.testing.assert_allclose(stack[i].at(z), F.at(z), rtol=1e-8)


def test_suprema_equal_those_of_a_dense_sweep():
    centre, width = np.array([0.3, 1.7, 2.9]), np.array([0.05, 0.4, 1.0])

    def peaks(w):
        return 1 / (1 + ((w - centre[:, None]) / width[:, None]) ** 2) + 0.3 * np.cos(3 * w)

    dense = peaks(np.broadcast_to(np.linspace(0, np.pi, 400_001), (3, 400_001))).max(axis=1)
    # every point occurs twice, as in a grid around a pair of poles
    common, own = np.linspace(0, np.pi, 60), np.broadcast_to(np.linspace(0, np.pi, 60), (3, 60))
    refined = suprema(peaks, common, own)
    # Points are 8e-6 rad apart and second derivatives at most 800 per rad^2: maxima exceed the points by under 1e-8.
    np.testing.assert_allclose(refined, dense, rtol=0, atol=2e-8)
    assert suprema(lambda w: np.where(w > 3, np.nan, w), common, own).tolist() == [np.inf] * 3


def test_bad_grids_are_refused_and_defaults_fit():
    sweep = rigid(1)
    for arguments, message in (
        ((8, (10, 5), None), "--K-range is 10,5, expected the lower end first"),
        ((8, (1, 1e12), None), "0.001 to 1e+09 N/m"),
        ((8, (1, 10), None, ((20, 0.5),)), "--mark has K = 20, outside"),
    ):
        with pytest.raises(InputError, match=message.replace("+", r"\+")):
            make_grid(sweep, *arguments)
    wide = make_grid(sweep, 8, None, None, ((1e5, 9.0),))
    assert wide.K[-1] > 1e5
    assert wide.B[-1] > 9
    assert wide.scale == "linear"
    assert make_grid(of(PAIR, (1, 1)), 8, None, None).scale == "log"
    assert sweep.stiffness_scale == pytest.approx(DELTA / T)  # 2 delta/((theta + 1) T) with theta = 1
    with pytest.raises(InputError, match="--B-range begins at 0"):
        make_grid(of(PAIR, (1, 1)), 8, None, (0, 2))


def test_edges_interpolate_along_their_axis():
    K, ratio = np.array([1.0, 10.0, 1000.0]), np.array([0.1, 0.75, 1.75])  # 1 is a quarter of the way from 0.75 to 1.75
    assert zwidth_map._interpolated(K, ratio, 1, "linear") == pytest.approx(257.5)
    assert zwidth_map._interpolated(K, ratio, 1, "log") == pytest.approx(10 * 10**0.5)


# --- the population ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("links", [1, 0], ids=["simple", "mixed"])
def test_population_growth_equals_that_of_single_humans(links):
    """The growth equals that of sim.stability for the same humans; 1e-7 1/s is the eigenvalues' rounding over T."""
    sweep = rigid(1)
    crowd = HeldDevices.drawn(sweep.devices, sweep.population, sweep.loop.T, 3, 30, links)
    F = sweep.force_maps(np.array([1500.0]), np.array([0.4]))[0][0]
    growth, audible = crowd.growth(F)
    for index, some in crowds(sweep.population, 1, 3, range(30), links):
        modes = dominant_mode(exact_loops(variants(sweep.devices, some), F))
        np.testing.assert_allclose(growth[index], modes.growth, rtol=0, atol=1e-7)
        np.testing.assert_array_equal([crowd.links(human) for human in index], some.links)
    assert (audible <= growth + 1e-9).all()
    assert (growth > 0).any()
    half = np.arange(30) < 15
    np.testing.assert_array_equal(crowd.growth(F, half)[0][:15], growth[:15])
    assert np.isneginf(crowd.growth(F, half)[0][15:]).all()


def test_cells_without_unstable_leaders_test_everyone():
    """Unstable humans are found even if none of them is among the leaders, which are tested first."""
    sweep = rigid(1)
    crowd = HeldDevices.drawn(sweep.devices, sweep.population, sweep.loop.T, 0, 40, 1)
    F = sweep.force_maps(np.array([1300.0]), np.array([0.0]))[0][0]
    growth, _ = crowd.growth(F)
    unstable = growth > 0
    assert 0 < unstable.sum() < 40
    worst, count = zwidth_map._population(crowd, [F], ~unstable)
    assert count == unstable.sum()
    assert worst == pytest.approx(growth.max())
    calm = sweep.force_maps(np.array([10.0]), np.array([0.5]))[0][0]
    for leading in (~unstable, np.full(40, True)):  # one unstable contact state is enough
        assert zwidth_map._population(crowd, [calm, F], leading) == (worst, count)


def test_marks_take_the_worst_contact_state():
    loop = load("one-wall").replace(T=T, theta=(1,)).loop("I")
    sweep = CouplingSweep(PAIR.device[:1], PAIR.population, loop)
    crowd = HeldDevices.drawn(sweep.devices, sweep.population, T, 0, 8, 1)
    ((_, some),) = crowds(sweep.population, 1, 0, range(8), 1)
    coupling = SpringDamper([1500.0], [0.4])
    states = [exact_loops(variants(sweep.devices, some), state.F(coupling)) for state in loop.frozen()]
    growth = [dominant_mode(state).growth for state in states]
    assert (growth[0] < growth[1] - 1).any()
    worst = zwidth_map._growth(sweep, crowd, 1500.0, 0.4)
    np.testing.assert_allclose(worst, np.maximum(*growth), rtol=0, atol=1e-7)


def test_random_hands_meet_the_latest_forces():
    sweep = rigid(1)
    crowd = HeldDevices.drawn(sweep.devices, sweep.population, T, 3, 4, 1, ((1e-4, 5e-4),))
    F = sweep.force_maps(np.array([900.0]), np.array([0.4]))[0][0]
    ((_, some),) = crowds(sweep.population, 1, 3, range(4), 1)
    modes = dominant_mode(exact_loops(variants(sweep.devices, some), F, late=[5e-4]))
    np.testing.assert_allclose(crowd.growth(F)[0], modes.growth, rtol=0, atol=1e-7)


# --- the simulated points ------------------------------------------------------------------------------------------


def wave(amplitude, growth, hz, seconds=1.5):
    t = np.arange(round(seconds / T)) * T
    return (amplitude * np.exp(growth * t) * np.sin(2 * np.pi * hz * t + 0.3))[:, None, None]


def test_sustained_oscillations_are_told_from_decays():
    t = (np.arange(1500) * T)[:, None, None]
    cases = [
        (wave(1e-4, 0.0, 40), True),  # a limit cycle
        (wave(1e-4, 0.5, 40), True),
        (wave(1e-4, -0.5, 40), False),  # still large, but decaying
        (wave(5e-6, 0.0, 40), False),  # below the threshold
        (0.5 * (1 - np.exp(-t / 30)), False),  # a slow hand that gives way
        (wave(1e-2, -2.0, 7) + wave(2e-5, 0.3, 80), True),  # a slow decay does not hide a fast growth
        (wave(1e-3, 50.0, 80), True),  # far beyond 1 km
    ]
    judged = oscillation(np.concatenate([x for x, _ in cases], axis=2), T, 1e-5)
    assert judged.sustained.tolist() == [verdict for _, verdict in cases]
    # An octave's amplitude is that of the sinusoid in it; the relative error was 1e-7 in the middle of an octave.
    assert judged.amplitude[0] == pytest.approx(1e-4, rel=0.02)
    assert judged.frequency_hz[0] == pytest.approx(40, abs=1)  # The spectrum has a resolution of 1.3 Hz.
    assert np.isinf(judged.amplitude[-1])
    assert slowest_seen(4.0) == 4.0


def test_a_slow_swing_that_decays_is_no_oscillation():
    """A hand swings back with 4 mm at 0.6 to 1.2 Hz, at any phase, 400 times the threshold.

    A Hann window of 0.75 s leaves up to 9e-3 of the swing in the lowest octave, unless its trend is subtracted first.
    """
    t, phases = (np.arange(1500) * T)[:, None, None], np.linspace(0, np.pi, 24, endpoint=False)
    for hz in (0.6, 1.0, 1.12, 1.2):
        slow = 4e-3 * np.exp(-0.45 * t) * np.cos(2 * np.pi * hz * t + phases)
        assert not oscillation(slow, T, 1e-5).sustained.any()
        judged = oscillation(slow + 2e-5 * np.sin(2 * np.pi * 6 * t), T, 1e-5)
        assert judged.sustained.all()
        assert judged.amplitude == pytest.approx(2e-5, rel=0.2)  # 6 Hz is near an octave's edge: the error was 1 %


def walled(count):
    walls = tuple(Wall(("tip", GROUND), 900.0 * (i + 1), 0.7, 1e-4 * i) for i in range(count))
    network = Network(("tip",), (Spring(("tip", GROUND), 1.0),), walls=walls)
    return loop_of(network, (1,), (0,), T).law(SpringDamper([2000.0], [0.5]))


@pytest.mark.parametrize("walls", [0, 1, 2])
def test_batched_processes_equal_single_ones(walls):
    """Processes in one buffer equal single ones except for rounding, because sums are in another order."""
    rng, limit, step = np.random.default_rng(2), np.array([5.0]), np.array([1e-5])
    if walls:
        contacts = [walled(walls), walled(walls)]
        processes = [Process(c, limit, step) for c in contacts]
    else:
        (stack,) = rigid(1).force_maps(np.array([500.0, 900.0]), np.array([0.2, 1.0]))
        processes = [Process(Law(stack[i]), limit, step) for i in range(2)]
    x = rng.normal(scale=1e-3, size=(20, 2))
    law = processes[0].law.together([process.law for process in processes])
    together = StepBuffer(processes[0], 20, 2, 0, len(processes), law)
    alone = [StepBuffer(process, 20, 2) for process in processes]
    for k in range(20):
        together.s[k, 0] = x[k]
        together.tick(k)
        for i, buffer in enumerate(alone):
            buffer.s[k, 0] = x[k, i]
            buffer.tick(k)
            np.testing.assert_allclose(together.f[k, :, i], buffer.f[k, :, 0], rtol=1e-9, atol=1e-12)
    assert np.abs(together.f).max() > 0.1


def test_coulomb_friction_stops_devices_at_the_exact_place():
    """m v' = -b v - F stops after m/b log(1 + b v0/F). MuJoCo may err by 3e-6 m (1.4e-6 m when measured)."""
    device, force, v0 = RigidDevice(friction=0.3), 0.3, 0.2
    scene = build([device], [Human((Link(0, 0, 0),))])
    model = _discretised(scene, T, "RK4", 4)
    data = mujoco.MjData(model)
    data.qvel[0] = v0
    mujoco.mj_step(model, data, 4 * 500)
    b, m = device.damping, device.mass
    stop = m / b * np.log(1 + b * v0 / force)
    assert data.qpos[0] == pytest.approx(
        (v0 + force / b) * m / b * (1 - np.exp(-b * stop / m)) - force / b * stop, abs=3e-6
    )
    held = float(data.qpos[0])
    data.ctrl[:] = 0.5 * force, 0.0
    mujoco.mj_step(model, data, 4 * 500)
    assert data.qpos[0] == pytest.approx(held, abs=1e-6)  # a force of half the friction does not move the device


@pytest.mark.parametrize("between", [("tip", GROUND), (GROUND, "tip")])
def test_hands_press_towards_the_wall(between):
    """A tip that moves in the direction of the press meets the wall, and one that moves away does not."""
    loop = loop_of(Network(("tip",), walls=(Wall(between, 900.0, 0.7, 1e-3),)), (0,), (0,), T)
    ahead = 0.01 * zwidth_map._press_directions(loop)[0]
    process = Process(loop.law(SpringDamper([2000.0], [0.5])), np.full(1, np.inf), np.zeros(1))
    (force,) = drive(process, np.array([[[ahead, -ahead]]])).f[0]
    assert force[0] * ahead > 0 == force[1]


def test_hands_press_steadily_after_half_a_second():
    scene, press = build(PAIR.device, PAIR.human), np.array([3.0, -3.0])
    w = _press_forces(scene, T, press, 0, 800)
    for force, column in zip(press, scene.pushed, strict=True):
        np.testing.assert_allclose(w[[0, 250, 500, 799], column], [0, force / 2, force, force], rtol=0, atol=1e-12)
    np.testing.assert_array_equal(_press_forces(scene, T, press, 300, 500), w[300:])


def test_slow_rates_contradict_no_simulation():
    """Within 0.2 1/s of zero a trace cannot tell growth from a limit cycle."""
    growth, unknown = np.array([-0.3, -0.1, 0.1, 0.3]), np.zeros(4)
    on, off = (Points(np.arange(4), np.full(4, seen), unknown, unknown, growth) for seen in (True, False))
    assert on.differ.tolist() == [True, False, False, False]
    assert on.verdicts == ["oscillates", UNDECIDED, UNDECIDED, "oscillates"]
    assert off.differ.tolist() == [False, False, False, True]
    assert off.verdicts == ["rests"] * 4


def points(sweep, K, B, **changes):
    """Return the simulated points of a 2 x 2 map, its four corners."""
    settings = {"points": 2, "press": 3.0, "duration": 2.0, "threshold": 2e-5} | changes
    grid = Grid(np.array(K), np.array(B), "linear")
    crowd = HeldDevices.drawn(sweep.devices, sweep.population, sweep.loop.T, 0, 40, 1)
    return draw_map(sweep, grid, crowd, Plan(**settings), lambda *stage: None).points


def test_the_linear_points_agree_with_the_eigenvalues():
    corners = points(rigid(1), [400.0, 2500.0], [0.0, 1.0])
    assert corners.verdicts[0] == "rests"
    assert corners.verdicts[2:] == ["oscillates", "oscillates"]
    assert not corners.differ.any()


def with_devices(sweep, **changes):
    return replace(sweep, devices=tuple(msgspec.structs.replace(device, **changes) for device in sweep.devices))


@pytest.mark.slow
def test_friction_stops_growing_oscillations():
    free = points(rigid(1), [1500.0, 2500.0], [0.0, 0.2])
    assert free.oscillates.all()
    assert (free.growth > 1).all()
    held = points(with_devices(rigid(1), friction=5.0), [1500.0, 2500.0], [0.0, 0.2])
    assert not held.oscillates.any()
    assert held.differ.all()


@pytest.mark.slow
def test_coarse_encoders_make_stable_loops_oscillate():
    calm = points(rigid(1), [300.0, 800.0], [0.0, 0.05], threshold=1e-5)
    coarse = points(with_devices(rigid(1), encoder_step=2e-4), [300.0, 800.0], [0.0, 0.05], threshold=1e-5)
    assert not calm.oscillates.any()
    assert coarse.verdicts[2:] == ["oscillates", "oscillates"]
    assert (coarse.frequency_hz[2:] > 50).all()
    assert (coarse.amplitude[2:] < 2e-4).all()


def test_a_device_refuses_negative_friction():
    with pytest.raises(ValueError, match=r"friction is -1.*0 to 1000 N"):
        CompliantDevice(friction=-1.0)


# --- the command ---------------------------------------------------------------------------------------------------

OMEGA3 = [
    "--rigid",
    "--T",
    "1e-3",
    "--theta",
    "0",
    "--mark",
    "5000,0",
    "--humans",
    "60",
    "--grid",
    "12",
    "--points",
    "3",
]


@pytest.fixture(scope="module")
def audit(tmp_path_factory):
    """Return exit code and report of a map with CHAI3D's limits of an omega.3 as its mark."""
    out = tmp_path_factory.mktemp("zwidth")
    code = zwidth.main([*OMEGA3, "--duration", "1.5", "--no-plot", "--out", str(out)])
    return code, json.loads((out / "report.json").read_text())


@pytest.mark.slow
def test_chai3ds_limit_of_an_omega3_is_not_certified(audit):
    code, report = audit
    (mark,) = report["marks"]
    assert code == DOES_NOT_HOLD
    for condition in ("any-environment", "this-environment"):
        assert mark[condition]["required_damping"] == pytest.approx([2.5])
        assert not mark[condition]["certified"]
        assert mark["stiffest_K_at_this_B"][condition] == pytest.approx(2740, rel=1e-5)
    assert mark["unstable_humans"] > 30
    # Random humans allow a little more stiffness than all passive humans do.
    assert 2740 < mark["stiffest_K_at_this_B"]["population"] < 3200


@pytest.mark.slow
def test_the_parts_of_a_map_agree(audit):
    _, report = audit
    K, B = np.meshgrid(report["grid"]["K"], report["grid"]["B"], indexing="ij")
    ratio = np.array(report["this-environment"]["required_over_available"], float)
    # Without delay the requirement is K T/2 + B; the tolerance is that of the reported error, below.
    np.testing.assert_allclose(ratio * DELTA, K * T / 2 + B, rtol=3e-8)
    growth = np.array(report["population"]["growth_rate_per_s"], float)
    assert (growth[ratio < 1] <= 1e-9).all()
    assert report["this-environment"]["contradicted_cells"] == 0
    assert (growth[(B == 0) & (K > 3300)] > 0).all()
    assert len(report["simulation"]["points"]) == 9
    assert report["simulation"]["differ_from_linear"] == 0
    for error in report["error"].values():
        assert error["figure_relative"] < 3e-8
        # Interpolation is exact for this straight edge; the true edge is searched to 1e-7 in K and in the damping.
        assert error["edge_relative_in_K"] < 1e-6


def test_a_failing_mark_or_cell_is_reported():
    """A map holds if its marks are certified, no hand contradicts a certificate, and no linear simulation differs."""
    sweep, grid = rigid(0), Grid(np.array([1.0, 2.0]), np.array([0.0, 1.0]), "linear")
    good, bad = (
        Mark(K, 0.0, {name: sweep.requirement(name, K, 0.0) for name in sweep.judges}, -1.0, 0, {})
        for K in (100.0, 5000.0)
    )

    def report(growth, *marks, sweep=sweep, points=None):
        ratio = dict.fromkeys(sweep.judges, np.array([0.1, 0.2, 0.3, np.inf]))
        growths, points = np.array([-1.0, growth, -1.0, -1.0]), points or Points.joined([])
        drawn = Map(grid, ratio, growths, np.zeros(4), points, {}, False)
        return MapReport.of(PAIR, sweep, drawn, Plan(0, 3.0, 2.0, 1e-5), None, marks, 7, 0)

    assert report(-1.0, good).holds
    assert not report(-1.0, good, bad).holds
    failed = report(1e-3, good)
    assert not failed.holds
    assert [(r.certified_cells, r.contradicted_cells) for r in failed.ratios.values()] == [(3, 1)] * 2
    assert failed.population.stable_cells == 3
    moving = Points(np.array([0]), np.array([True]), *np.array([[1e-3], [40.0], [-1.0]]))
    assert not report(-1.0, good, points=moving).holds
    assert report(-1.0, good, points=moving, sweep=with_devices(sweep, friction=0.2)).holds


def test_maps_write_files_and_repeat_with_their_seed(tmp_path):
    out, few = tmp_path / "out", ["--rigid", "--humans", "5", "--grid", "4", "--points", "1", "--duration", "1.5"]
    out.mkdir()
    zwidth.main([*few, "--out", str(out), "--json", str(out / "again.json")])
    report = json.loads((out / "report.json").read_text())
    assert report["files"] == [str(out / name) for name in ("map.csv", "zwidth.png", "report.json")]
    assert json.loads((out / "again.json").read_text()) == report
    assert (out / "zwidth.png").read_bytes().startswith(b"\x89PNG")
    rows = list(csv.DictReader((out / "map.csv").read_text().splitlines()))
    assert len(rows) == 16
    assert sum(row["simulated"] != "" for row in rows) == 1
    assert float(rows[0]["this-environment required/available"]) == pytest.approx(
        report["this-environment"]["required_over_available"][0][0]
    )
    zwidth.main([*few, "--no-plot", "--out", str(tmp_path / "two")])
    again = json.loads((tmp_path / "two" / "report.json").read_text())
    for part in ("population", "simulation", "this-environment", "any-environment"):
        assert again[part] == report[part]


def test_maps_show_what_known_devices_allow(tmp_path):
    """At a rigid wall guaranteed bounds of the device certify spring-dampers that this-environment refuses."""
    file, known = tmp_path / "r.json", ["--rigid", "--scenario", "omega-pair-known", "--T", "1e-3", "--theta", "0"]
    part = ["--K-range", "500,1000", "--B-range", "1.4,2", "--grid", "4", "--points", "0", "--humans", "5"]
    zwidth.main([*known, *part, "--out", str(tmp_path), "--no-plot", "--json", str(file)])
    report = json.loads(file.read_text())
    for name in ("known-device", "known-device-any"):
        ratio = np.array(report[name]["required_over_available"])
        assert (ratio < 1).all()
    assert (np.array(report["this-environment"]["required_over_available"]) > 1).all()
    assert (np.array(report["population"]["growth_rate_per_s"]) < 0).all()


@pytest.mark.parametrize("stage", ["certificates", "population", "MuJoCo"])
def test_ctrl_c_keeps_finished_parts_of_a_map(stage, tmp_path, monkeypatch, capsys):
    def draw(*arguments):
        def stop(at, done, total):
            if at == stage and done:
                raise KeyboardInterrupt

        return draw_map(*arguments[:-1], stop)

    monkeypatch.setattr(zwidth.zwidth, "draw_map", draw)
    options = [
        "--rigid",
        "--theta",
        "1",
        "--humans",
        "5",
        "--grid",
        "8",
        "--points",
        "2",
        "--no-plot",
        "--out",
        str(tmp_path),
    ]
    assert zwidth.main(options) == INTERRUPTED
    report = json.loads((tmp_path / "report.json").read_text())
    assert report["interrupted"]
    known = [report["any-environment"]["required_over_available"], report["population"]["growth_rate_per_s"]]
    whole = [all(value is not None for row in rows for value in row) for rows in known]
    assert whole == {"certificates": [False, False], "population": [True, False], "MuJoCo": [True, True]}[stage]
    assert any(value is not None for row in known[0] for value in row)
    assert "Interrupted" in capsys.readouterr().out


def test_slices_cover_everything_once():
    seen = []
    done, stopped = zwidth_map._in_slices(
        lambda part: part.stop - part.start, 25, 4, lambda k, of: seen.append((k, of))
    )
    assert not stopped
    assert sorted(part.start for part, _ in done) == [0, 4, 8, 12, 16, 20, 24]
    assert sum(size for _, size in done) == 25
    assert seen[-1] == (25, 25)


def test_ctrl_c_while_tasks_are_submitted_ends_them(monkeypatch):
    """Otherwise the program would compute the submitted slices before it ends."""
    submit, numbers, computed = zwidth_map.ThreadPoolExecutor.submit, count(), []

    def interrupted(pool, *task):
        if next(numbers) == 3:
            raise KeyboardInterrupt
        return submit(pool, *task)

    monkeypatch.setattr(zwidth_map.ThreadPoolExecutor, "submit", interrupted)
    _, stopped = zwidth_map._in_slices(computed.append, 25, 1, lambda k, of: None)
    assert stopped
    assert len(computed) <= 3


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--grid", "1"], "--grid is 1 .. 4 to 400"),
        (["--humans", "0"], "--humans is 0 .. 1 to 100000"),
        (["--K-range", "5"], "--K-range is '5', expected two numbers separated by a comma"),
        (["--mark", "5000,x"], "--mark is '5000,x', expected two numbers"),
        (["--mark", "0,1"], "--mark is 0,1 .. K"),
        (["--case", "none"], "--case none is the loop without coupling"),
        (["--rigid", "--theta", "1,2"], "--rigid is one channel: --theta has 2 entries"),
        (["--rigid", "--theta", "1", "--psi", "1"], "no loop with a delayed environment is stable"),
        (["--duration", "0.1"], "--duration is 0.1 .. 1.5 to 10000 s"),
        (["--theta", "200"], "theta is 200, 200 .. 0 to 100 samples"),
        (["--seed", "-1"], "--seed is -1"),
        (["--coupling", "optimal", "--rigid"], "--rigid is allowed only for a map of spring-dampers"),
        (["--coupling", "optimal", "--condition", "any-environment"], "for optimal .. this-environment"),
        (["--condition", "any-environment"], "--condition is allowed only with --coupling"),
        (["--coupling", "optimal", "--scenario", "one-wall"], "an optimal coupling holds a linear model"),
        (["--coupling", "published", "--scenario", "one-wall"], "the paper prints gains for 2 channels"),
    ],
)
def test_bad_input_gives_one_line(options, message, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("sys.argv", ["zwidth", *options, "--out", str(tmp_path)])
    with pytest.raises(SystemExit) as leaving:
        execute(zwidth.main)
    error = capsys.readouterr().err
    assert leaving.value.code == BAD_INPUT
    assert says(error, message)
    assert error.count("\n") == 1


@pytest.mark.slow
def test_maps_cover_latency_and_longest_periods(tmp_path):
    """1000 N/m needs 0.7749 N s/m with forces 0.13 ms late, 1.8 with forces 1.2 ms late, and 0.9 with T_max 1.8 ms."""
    file = tmp_path / "r.json"
    wall = [
        "--rigid",
        "--T",
        "1.2e-3",
        "--delta",
        "2",
        "--mark",
        "1000,0",
        "--grid",
        "4",
        "--humans",
        "2",
        "--no-plot",
    ]
    needs = {}
    for name, options in {
        "late": ["--theta", "0", "--latency", "130e-6:130e-6", "--points", "1", "--duration", "1.5"],
        "whole": ["--theta", "1", "--points", "0"],
        "long": ["--theta", "0", "--T-max", "1.8e-3", "--points", "0"],
    }.items():
        assert zwidth.main([*wall, *options, "--out", str(tmp_path), "--json", str(file)]) == 0
        (mark,) = json.loads(file.read_text())["marks"]
        needs[name] = mark["this-environment"]["required_damping"][0]
    assert needs == pytest.approx({"late": 0.774878, "whole": 1.8, "long": 0.9}, abs=2e-6)
