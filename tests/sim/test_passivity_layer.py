"""The energy budget, and the shell around a user's environment, bound the energy that loops give to hands.

W0 [J] is the initial value of the account W: the most that a budget or shell gives in a run. Tolerances without a
comment cover rounding.
"""

from dataclasses import replace
from itertools import pairwise

import msgspec
import numpy as np
import pytest
from evaluate import reported
from shared import checkered

from haptic_loop import certify, design_coupling, load, simulate
from haptic_loop.cli.run import main as run_command
from haptic_loop.controller.budget import EnergyBudget, Packets
from haptic_loop.controller.coupling import NoCoupling, SpringDamper
from haptic_loop.controller.environment import Network, Spring
from haptic_loop.design.result import Requirement
from haptic_loop.sim.passivity_layer import EnergyNet, Plugged, idle, netted
from haptic_loop.sim.run import assemble, run
from haptic_loop.sim.scenario import InputError

SHORT = load().replace(duration=1.0)


def stiffer(scenario, factor):
    network = scenario.environment
    springs = tuple(msgspec.structs.replace(s, stiffness=factor * s.stiffness) for s in network.springs)
    return scenario.replace(environment=msgspec.structs.replace(network, springs=springs))


def energy_given(simulation, trace):
    """Return the largest energy [J] given to hands up to any tick: forces' work less the devices' least dissipation."""
    s, dx = trace.s[:, : simulation.process.channels], np.diff(trace.s[:, : simulation.process.channels], axis=0)
    assert len(s) == len(trace.f)
    lost = (dx**2 * np.array(simulation.scenario.delta)).sum(axis=1) / simulation.scenario.T
    return float(np.cumsum(-(trace.f[:-1] * dx).sum(axis=1) - lost).max(initial=0.0))


def test_budgets_are_idle_with_damping_to_spare():
    """The budget of this loop is idle if any-environment requires at most 95 % of the damping of each channel.

    No force may be clipped and no cap set. The loop has psi = 0, constant delays, ideal encoders and no walls.
    """
    clipped, budget = assemble(SHORT, NoCoupling()), EnergyBudget(SHORT.delta, SHORT.T, Packets((1, 2))).figures()
    unlimited = replace(clipped, process=clipped.process.unlimited)

    def reason(*shares, budget=budget, simulation=unlimited):
        required = tuple(share * d for share, d in zip(shares, SHORT.delta, strict=True))
        needs = Requirement("any-environment", required, SHORT.delta, None)
        return idle(simulation, {needs.condition: needs}, budget)

    assert reason(0.94, 0.94).startswith("it never acts")
    assert reason(0.94, 0.96) is None
    assert reason(0.94, 0.94, budget=replace(budget, cap_J=1.0)) is reason(0.94, 0.94, simulation=clipped) is None


def limited_and_idle(scenario, coupling, condition):
    """Return how many ticks a budget of 0.1 mJ limits, and what `idle` returns for the loop.

    `condition` must be met with 95 % of the damping.
    """
    free = tuple(msgspec.structs.replace(device, force_limit=1e6) for device in scenario.device)
    scenario = scenario.replace(device=free, duration=0.5)
    requirements = certify(scenario.loop("I"), coupling)
    assert requirements[condition].ratio < 0.95
    simulation = assemble(scenario, coupling, requirements[condition].limiter_rho)
    figures = run(netted(simulation, EnergyNet(1e-4)), "exact").net.figures()
    return figures.limited_ticks, idle(simulation, requirements, figures)


@pytest.mark.slow
def test_budgets_act_on_couplings_for_known_devices():
    """known-device-any also uses the motors' mass, and the budget does not.

    So the budget limits forces of a coupling that known-device-any certifies.
    """
    scenario = load("omega-pair-known")
    ends = scenario.environment.contacts
    network = Network(ends, tuple(Spring((end, "ground"), 1e6) for end in ends))
    ticks, why = limited_and_idle(
        scenario.replace(environment=network), SpringDamper([1327.5, 669.3], [2.12, 1.21]), "known-device-any"
    )
    assert ticks > 0
    assert why is None


def test_budgets_act_where_walls_store_energy():
    """A wall that is pressed at rest holds K gap^2/2 = 0.15 J, which the object may give."""
    scenario = load("one-wall")
    pressed = msgspec.structs.replace(scenario.environment.walls[0], gap=-0.01)
    network = msgspec.structs.replace(scenario.environment, walls=(pressed,))
    ticks, why = limited_and_idle(
        scenario.replace(environment=network), SpringDamper([854.0], [0.31]), "any-environment"
    )
    assert ticks > 0
    assert why is None


def test_a_budget_acts_on_clipped_forces():
    """Forces of a certified coupling, clipped at 0.3 and 0.1 N, do 1.3 mJ of work on this closed path.

    This is 0.4 mJ more than the devices dissipate, so the budget, which begins empty, must limit the forces.
    """
    loop, most = SHORT.loop("I"), np.array([[0.3], [0.1]])
    G, budget = loop.sent(SpringDamper([600.0, 400.0], [0.5, 0.5])), EnergyBudget(loop.delta, loop.T, Packets((1, 2)))
    corners = 1e-3 * np.array([[0, 0], [-10, -10], [-13, -10], [-3, 0], [0, 0]])
    path = np.vstack([np.linspace(a, b, 500) for a, b in pairwise(corners)])
    z, dx = np.zeros(G.order), np.diff(path, axis=0, prepend=path[:1])
    for x, step in zip(path, dx, strict=True):
        z, f = G.A @ z + G.B @ x, G.C @ z + G.D @ x
        budget.limit(np.clip(f[:, None], -most, most), step[:, None])
    assert budget.figures().limited_ticks > 100


@pytest.mark.parametrize("engine", ["exact", pytest.param("mujoco", marks=pytest.mark.slow)])
def test_a_budget_that_does_not_act_changes_nothing(engine):
    """With W0 = 0 and from rest the budget does not act on a coupling that is certified with 95 % of the damping."""
    weaker = SHORT.replace(delta=tuple(0.95 * d for d in SHORT.delta)).loop("I")
    coupling = design_coupling(weaker, "spring-damper", "any-environment").coupling
    with_budget = simulate(SHORT, coupling, engine, energy_budget=0.0)
    alone = simulate(SHORT, coupling, engine)
    part = with_budget.meta["energy_budget"]
    assert part["limited_ticks"] == part["surprises"] == 0
    assert part["ticks"] == len(alone.t)
    assert np.abs(with_budget.f - alone.f).max() < 1e-9
    assert np.abs(alone.f).max() > 0.1


@pytest.mark.parametrize(("start", "vary"), checkered([0.0, 0.01], [False, True]))
def test_hostile_loops_cannot_exceed_the_budget(start, vary):
    """Stiffer springs without a coupling give hands no more energy than the budget allows."""
    coupling, scenario = NoCoupling(), stiffer(load().replace(duration=2.0), 2.5)
    simulation = assemble(scenario, coupling)
    if vary:
        rng = np.random.default_rng(7)
        scenario = scenario.replace(varying_delay={"lo": (0, 1), "hi": (2, 3), "loss": 0.05})
        delays = rng.integers((0, 1), (3, 4), (scenario.samples, 2))
        delays = np.where(rng.random(delays.shape) < 0.05, -1, delays)
        delays[500:530] = -1  # a gap so long that the device must stop holding its force
        simulation = replace(assemble(scenario, coupling), scenario=scenario)
        simulation = replace(simulation, process=replace(simulation.process, delays=delays[:, :, None]))
    guarded = netted(simulation, EnergyNet(start))
    trace = run(guarded, "exact")
    part = trace.net.figures()
    assert part.limited_ticks > 100
    assert part.surprises == 0
    assert energy_given(guarded, trace) <= start + 1e-9
    assert (part.dropped_ticks > 0) == vary
    if not vary:
        alone = run(simulation, "exact")
        assert energy_given(simulation, alone) > 0.1
        assert np.abs(trace.f).max() < 0.5 * np.abs(alone.f).max()


@pytest.mark.slow
def test_budgets_bound_loops_with_walls():
    """A large budget changes nothing in a run with a wall; with W0 = 0 no energy is given."""
    scenario = load("one-wall").replace(duration=1.5)
    simulation = assemble(scenario, NoCoupling())
    alone, rich, poor = (
        run(one, "exact") for one in (simulation, *(netted(simulation, EnergyNet(W0)) for W0 in (1e3, 0.0)))
    )
    assert np.abs(alone.f).max() > 0.1
    assert np.abs(rich.f - alone.f).max() < 1e-9
    assert energy_given(simulation, poor) <= 1e-9


@pytest.mark.slow
def test_the_shell_bounds_a_users_environment():
    """A force along the motion gives at most W0 = 2 mJ through the shell, and far more with a huge W0."""
    coupling = design_coupling(SHORT.loop("I"), "spring-damper", "any-environment").coupling
    energies = {}

    def along_velocity():
        before = np.zeros(2)

        def force(u):
            nonlocal before
            way, before = u - before, u.copy()
            return -3.0 * np.sign(way)

        return force

    for start in (0.002, 1e9):
        simulation = assemble(SHORT, coupling)
        trace = run(netted(simulation, Plugged(along_velocity(), start)), "exact")
        energies[start] = energy_given(simulation, trace)
        assert trace.net.figures().limited_ticks > 100 or start > 1
    assert energies[0.002] <= 0.002
    assert energies[1e9] > 10 * 0.002
    with pytest.raises(ValueError, match="needs a coupling"):
        netted(assemble(SHORT, NoCoupling()), Plugged(lambda u: u))


@pytest.mark.slow
def test_reports_say_what_the_budget_did(tmp_path):
    options = ["--energy-budget", "0,0.0005", "--duration", "1.5", "--no-plot", "--out", str(tmp_path)]
    _, report = reported(run_command, tmp_path, *options)
    # The position error compares this run with a run of the exact engine. It is small only if both have the budget.
    assert report["error"]["position_relative_rms"] < 1e-6
    part = report["energy_budget"]
    assert (part["start_J"], part["cap_J"], part["idle"]) == (0, 0.0005, None)
    assert part["limited_ticks"] > 100
    assert "any energy" in part["guarantee"]


@pytest.mark.slow
def test_uneven_periods_cannot_exceed_the_budget():
    """With uneven periods the budget reserves energy for the longest tick, so an unstable loop gives at most W0."""
    scenario = stiffer(load().replace(duration=1.0, period={"min": 0.4e-3, "max": 1.6e-3}), 20)
    simulation = assemble(scenario, NoCoupling())
    for start in (0.0, 0.01):
        trace = run(netted(simulation, EnergyNet(start)), "exact")
        dx, ticks = np.diff(trace.s[:, :2], axis=0), simulation.timing.period[: len(trace.t) - 1]
        lost = (dx**2 * np.array(scenario.delta)).sum(axis=1) / ticks
        taken = np.cumsum(-(trace.f[:-1] * dx).sum(axis=1) - lost)
        assert taken.max() <= start + 1e-9
        assert trace.net.figures().limited_ticks > 10


def test_energy_accounts_refuse_a_latency_before_computing(capsys, monkeypatch, tmp_path):
    late = SHORT.replace(latency=((0.0, 1e-4),) * 2)
    with pytest.raises(InputError, match="an energy account assumes forces that latch at ticks"):
        netted(assemble(late, NoCoupling()), EnergyNet(0.0))
    for name in "cli.verdict.assess", "sim.api.assessed":
        monkeypatch.delattr(f"haptic_loop.{name}")
    with pytest.raises(InputError, match="latency"):
        simulate(late, energy_budget=0.0)
    for loop in ["--energy-budget", "0.01"], ["--scenario", "world-cube"]:
        with pytest.raises(InputError, match="latency"):
            run_command([*loop, "--latency", "1e-4", "--out", str(tmp_path)])
    assert not capsys.readouterr().out
