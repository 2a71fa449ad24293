"""Test whole sessions in virtual time: faults, the exact engine's run, delays in the design, limits and budget."""

import re
from itertools import pairwise

import numpy as np
import pytest
from causes import cause_of
from rich.console import Console
from scipy.optimize import brentq
from sessions import AT_REST, FAST, in_fork, inject_faults, rehearsal_of, session_with
from shared import FakePort

from haptic_loop.cli import bridge
from haptic_loop.cli import replay as replay_command
from haptic_loop.controller.coupling import SpringDamper
from haptic_loop.controller.law import Law
from haptic_loop.design.coupling_file import Stored
from haptic_loop.design.coupling_file import save as save_coupling
from haptic_loop.design.environments import THIS_ENVIRONMENT
from haptic_loop.hw.control import (
    BudgetPlan,
    CouplingRequest,
    SentBudget,
    _HostController,
    certified_coupling,
    certified_couplings,
)
from haptic_loop.hw.driver import Driver, Operator
from haptic_loop.hw.emulator import Emulator, FaultInjection
from haptic_loop.hw.haptic_device import SerialDevice
from haptic_loop.hw.limits import SafetyLimits, Stage
from haptic_loop.hw.monitor import Ages, LinkSettings
from haptic_loop.hw.protocol import Command, Decoder, Force, Hello, Phase, SafetyStop, State, Stop, encode
from haptic_loop.hw.recording import Recorder, _recipes_of, load, replay
from haptic_loop.hw.rehearsal import Rehearsal, rehearse
from haptic_loop.hw.session import Session, session_for
from haptic_loop.hw.session_report import outcome, save
from haptic_loop.models.hold import hold
from haptic_loop.models.scene import plant
from haptic_loop.sim.run import assemble, outside_forces, run
from haptic_loop.sim.scenario import InputError, parse
from haptic_loop.sim.scenario import load as load_scenario
from tests.checks.faults import (
    CASES,
    A,
    Fault,
    _rehearse_case,
    at,
    begins_late,
    person,
    rehearse_late_case,
)

# faults


@pytest.mark.slow
def test_deaf_devices_do_not_finish_sessions(harmless):
    """The host cannot remove the force of a device that ignores it, but says so, and the session has not finished.

    The session checks 30 ms after STOP whether the device is at rest, and the rehearsal lasts until then.
    """

    def logged(case):
        assert rehearse_late_case(case, harmless).stage == Stage.STOPPED
        return harmless.session.log

    log = in_fork(logged, Fault("planned", Stage.FINISHED, faults=at("stuck"), action=person("stop"), lasts=1.3))
    assert cause_of(log[-1].cause).startswith("deaf device:")
    assert [event.stage for event in log[-2:]] == [Stage.FINISHED, Stage.STOPPED]
    log = in_fork(logged, Fault("fault", Stage.STOPPED, faults=at("stuck jump=5")))
    assert [cause_of(event.cause).split(":")[0] for event in log[-2:]] == ["jump", "deaf device"]


@pytest.mark.parametrize("kind", ["swap", "cross=1"])
def test_faults_of_two_axes_need_two(kind):
    with pytest.raises(ValueError, match=rf"--fault {kind[:4]}.* two axes"):
        Emulator(load_scenario("one-wall"), (FaultInjection.parse(kind),))


def one_of_each_kind():
    """Return one case of each group whose cases differ only by numbers; its place in the group varies."""
    kinds = {}
    for case in CASES:
        kinds.setdefault((re.sub(r"-|\b([\d.]+|inf|nan)\b", "", case.name), case.stage), []).append(case)
    return [alike[i % len(alike)] for i, alike in enumerate(kinds.values())]


@pytest.mark.parametrize(
    "case",
    [
        pytest.param(case, marks=[pytest.mark.slow] * (i % 3 != 0 or (case.designed and case.stage == A)), id=case.name)
        for i, case in enumerate(one_of_each_kind())
    ],
)
def test_every_fault_ends_where_it_must(case, scenario, link_couplings, harmless, free_handles):
    """Stage, cause, time to zero force and counters are right; no force exceeds the cap; nothing arms again.

    Late faults begin in forks of one session. Two of three cases are marked slow, as are those that need a design.
    `make validate` runs all cases, each from its beginning (`python -m tests.checks.faults`).
    """
    if begins_late(case):
        outcome = in_fork(rehearse_late_case, case, free_handles if case.free else harmless)
    else:
        outcome = _rehearse_case(case, scenario, link_couplings)[1]
    assert outcome.wrong == ()


def test_a_cable_pulled_after_the_end_changes_nothing(scenario, link_couplings):
    rehearsal = rehearsal_of(scenario, link_couplings, "motor=-1", "unplug@0.5")
    rehearsal.run_until_armed(0.6)
    assert rehearsal.run(1e-6 * rehearsal.armed_us + 0.6).stage == Stage.STOPPED


def test_peak_speeds_count_handles(scenario):
    plant = Emulator(scenario).plant
    plant.s[plant.scene.model.nq + plant.scene.handles[1]] = 1.0  # [m/s], while the motor rests
    plant.advance(np.zeros(2))
    assert plant.fastest > 0.9


def test_devices_with_free_handles_are_armed(scenario, link_couplings):
    """A device that nobody holds is armed, so tests/checks/faults.py prints true speeds of free handles."""
    session = _rehearse_case(CASES[0], scenario, link_couplings, free=True)[0].session
    assert session.stage == Stage.ARMED, session.cause


def test_duplicated_frames_change_no_force(harmless):
    """A frame that comes twice, on either side, changes no force."""

    def run(*faults):
        inject_faults(harmless, *faults)
        duplicates = harmless.run_until_armed(0.8).counters.duplicates
        return duplicates, np.array([moment.applied for moment in harmless.moments])

    (none, plain), (many, twice) = in_fork(run), in_fork(run, "duplicate=0.5@0.6")
    assert none == 0
    assert many > 50
    assert np.abs(np.diff(plain[-160:], axis=0)).max() > 0
    np.testing.assert_array_equal(plain, twice)


def test_repeating_devices_count_as_lost(harmless):
    """Repeating one STATE for ever is no sign of life: the time-out still acts."""

    def repeat():
        session = harmless.session
        assert session.stage == Stage.ARMED
        assert session.link.last
        again, now = session.link.last, session.now
        for _ in range(100):
            now += 100
            session.take(again, now)
            session.poll(now)
        assert session.stage == Stage.LOST
        assert session.log[-1].t_us - session.heard <= session.limits.watchdog_us + 100

    in_fork(repeat)


@pytest.mark.parametrize(
    ("fault", "cause"),
    [
        ("down:jitter=0.0007", "late answers:"),
        pytest.param("down:drop=0.35", "missed answers:", marks=pytest.mark.slow),
    ],
)
def test_links_failing_in_the_last_test_stop_sessions(harmless, fault, cause):
    def fail():
        session = harmless.session
        inject_faults(harmless, f"{fault}@0.75")
        session.stop("asked to", session.now)
        harmless.run_until_armed(0.74)
        assert (session.stage, session.gain) == (Stage.DISARMING, 0.0)
        harmless.run_until_armed(2.0)
        return session.stage, session.cause, harmless.zero_after(1.0)

    stage, words, zero = in_fork(fail)
    assert (stage, zero) == (Stage.STOPPED, 0.0)
    assert cause_of(words).startswith(cause)


@pytest.mark.parametrize(
    ("change", "cause"),
    [
        ({"applied": (30001, 0)}, "force above the cap:"),
        ({"status": Phase.DISARMED}, "disarmed itself:"),
        ({"status": Phase.SILENT}, "silent device:"),
    ],
)
def test_devices_that_contradict_the_session_are_stopped(harmless, change, cause):
    def contradict():
        session = harmless.session
        last = session.link.last
        assert last
        (said,) = session.take(last._replace(tick=(last.tick + 1) & 0xFFFF, **change), session.now)
        assert isinstance(said, Stop)
        assert session.stage == Stage.STOPPED
        assert cause_of(session.cause).startswith(cause)

    in_fork(contradict)


def test_a_device_that_arms_by_itself_is_stopped(scenario, link_couplings):
    rehearsal = rehearsal_of(scenario, link_couplings, operator=Operator(False, 1.0))
    session = rehearsal.run(0.3)
    assert session.stage == Stage.DISARMED
    last = session.link.last
    assert last
    session.take(last._replace(tick=(last.tick + 1) & 0xFFFF, status=Phase.ARMED), session.now)
    assert (session.stage, cause_of(session.cause)) == (Stage.STOPPED, "armed itself:")


def test_without_arming_no_force_is_ever_asked_for(scenario, link_couplings):
    rehearsal = rehearsal_of(scenario, link_couplings, operator=Operator(False, 1.0))
    rehearsal.emulator.plant.begin()  # the person still moves
    sent = []
    receive = rehearsal.emulator.receive
    rehearsal.emulator.receive = lambda data, now: (sent.append(data), receive(data, now))
    session = rehearsal.run(0.8)
    forces = [m for m in Decoder().feed(b"".join(sent)) if isinstance(m, Force)]
    assert session.stage == Stage.DISARMED
    assert len(forces) > 500
    assert all(m.command == Command.IDLE and not any(m.force) for m in forces)


def test_a_lost_stop_is_repeated(harmless):
    def lose():
        session = harmless.session
        last = session.link.last
        assert last
        session.end(Stage.STOPPED, "a test", session.now)
        for ahead in (1, 2):
            answer = session.take(last._replace(tick=(last.tick + ahead) & 0xFFFF), session.now)
            assert [type(m) for m in answer] == [Stop]

    in_fork(lose)


def test_random_bytes_move_nothing(scenario):
    """A megabyte of noise and frames with one wrong byte cause no crash, no change of stage and no FORCE."""
    rng = np.random.default_rng(5)
    session, port = session_with(scenario), FakePort()
    driver = Driver(session, SerialDevice(port, lambda: 1e-6 * port.now), lambda ages: (), lambda: port.now)
    session.start(0)
    state = encode(State(Phase.DISARMED, 1, 0, 0, 0, 0, 0, (5, 5), (0, 0)))
    for _ in range(250):
        broken = bytearray(state)
        broken[int(rng.integers(len(state)))] ^= int(rng.integers(1, 256))
        port.coming = rng.bytes(4000) + bytes(broken)
        driver.turn()
    assert session.stage == Stage.CONNECTING
    assert {type(m) for m in Decoder().feed(port.sent)} == {Hello}
    assert session.counters.host_errors > 1000


# the exact engine


def test_bridge_and_emulator_reproduce_the_exact_run(scenario, link_couplings):
    """Both devices over the whole link move as in sim's exact engine with ideal encoders and forces.

    Positions agree to one encoder step: rounding is half a step, and rounded forces add less than the other half.
    Forces agree to the sum of K times an encoder step, B times an encoder step per tick, and one force step.
    """
    recorder = Recorder(2)
    rehearsal = rehearsal_of(scenario, link_couplings, recorder=recorder, settings=AT_REST)
    rehearsal.run_until_armed(1.7)
    emulator = rehearsal.emulator
    link, begun = recorder.link(), emulator.begun_at
    first = int(np.argmax(link["tick"] == begun))
    assert link["received"].all()
    assert (link["gain"][first:] == 1.0).all()
    n = len(recorder) - first
    exact = run(assemble(scenario, link_couplings[0].chosen.coupling), "exact", ticks=n)
    step, coupling = 1e-6, link_couplings[0].chosen.coupling
    assert n > 900
    assert np.abs(exact.s[:, :2]).max() > 5e-3  # the people do move
    assert np.abs(link["x"][first:] - exact.s[:, :2]).max() < step
    forces = -link["applied"][first:] * 4e-4
    bound = max(coupling.K) * step + max(coupling.B) * step / scenario.T + 4e-4
    assert np.abs(forces - exact.f).max() < bound


def test_sessions_equal_a_simulation_that_rounds(scenario, link_couplings):
    """The session equals a separate loop: plant with held forces, rounded encoders, F with delays, rounded forces."""
    recorder = Recorder(2)
    rehearsal = rehearsal_of(scenario, link_couplings, recorder=recorder, settings=AT_REST)
    rehearsal.run_until_armed(1.1)
    link = recorder.link()
    first = int(np.argmax(link["tick"] == rehearsal.emulator.begun_at))
    simulation = assemble(scenario, link_couplings[0].chosen.coupling)
    held = hold(plant(simulation.scene.model), scenario.T)
    n = len(recorder) - first
    w, law = outside_forces(scenario, simulation.scene, 0, n), _HostController(Law(simulation.F))
    s, counts, applied = np.zeros(held.A.shape[0]), [], []
    for k in range(n):
        x = np.round(s[:2] / 1e-6)
        f = np.round(np.array(law.step(x * 1e-6)) / 4e-4)
        s = held.A @ s + held.B @ np.concatenate([w[k], f * 4e-4])
        counts.append(x)
        applied.append(-f)
    # another order of the sums could round a force the other way; in this run it never does
    np.testing.assert_array_equal(applied, link["applied"][first:])
    np.testing.assert_allclose(np.array(counts) * 1e-6, link["x"][first:], rtol=0, atol=1e-15)


# caps


@pytest.mark.parametrize(
    ("device", "caps"),
    [
        ("axes = 3", [1.3] * 3),  # The length of the vector is limited.
        ("axes = 3, force_limit = [12.0, 12.0, 12.0]", [1.3 / 3**0.5] * 3),
        ("axes = 3, force_limit = [12.0, 12.0, 0.5]", [1.3 / 3**0.5] * 2 + [0.5]),
        ('axes = 3, clamped = ["z"], force_limit = [12.0, 12.0, 12.0]', [1.3 / 2**0.5] * 2),
        ('axes = 3, clamped = ["x", "z"], force_limit = [12.0, 12.0, 12.0]', [1.3]),
    ],
)
@pytest.mark.parametrize("wall", [False, True])
def test_no_force_vector_exceeds_the_cap(device, caps, wall):
    parts = 'walls = [{ between = ["left", "ground"], normal = [0, 1, 0], gap = 0.01, stiffness = 500.0 }]' * wall
    scenario = parse(f"""
name = "box"
T = 1e-3
theta = [1, 1]
device = [{{ kind = "rigid", {device} }}, {{ kind = "rigid", axes = 3 }}]
[environment]
contacts = ["left", "right"]
springs = [{{ between = ["left", "right"], stiffness = 800.0, damping = 1.0 }}]
{parts}
""")
    limits = session_for(scenario, FAST, 1.3).limits
    box = [1.3 / 3**0.5] * 3
    left, right = (box if "force_limit" not in device else caps, box) if wall else (caps, [1.3] * 3)
    assert limits.cap == pytest.approx([*left, *right])
    asked = np.full(scenario.channels, 50.0)
    force = np.array(limits.shape(asked, limits.cap, 1.0, scenario.T).force)
    for own in (force[:-3], force[-3:]):
        assert np.linalg.norm(own) <= 1.3 * (1 + 1e-12)


# delays in the design


@pytest.mark.parametrize(
    ("ages", "expected"),
    [([130] * 100, 1), ([1150] * 100, 2), ([130] * 995 + [9000] * 5, 1), ([130] * 900 + [2000] * 100, 2)],
)
def test_the_link_delay_is_a_guarded_quantile(ages, expected):
    assert Ages(tuple(ages)).link_delay(1200.0, 0.99, 100.0) == expected


def test_reserves_are_softer_and_certified(scenario, link_couplings):
    fast, soft = link_couplings
    assert (fast.scenario.theta, soft.scenario.theta) == ((1, 2), (2, 2))
    assert (fast.link, soft.link) == (1, 2)
    assert fast.certified
    assert soft.certified
    assert max(soft.chosen.coupling.K) < max(fast.chosen.coupling.K)


def test_the_host_and_the_link_share_the_delay(scenario, link_couplings):
    """The host's controller, delayed by the link, is the F that was certified."""
    z = np.exp(1j * np.linspace(0.01, 3, 50))
    F = assemble(link_couplings[0].scenario, link_couplings[0].chosen.coupling).F
    on_host = link_couplings[0].controller((12.0, 12.0)).F.at(z) * z[:, None, None] ** -link_couplings[0].link
    np.testing.assert_allclose(on_host, F.at(z), rtol=1e-9, atol=1e-9)  # the sums have different orders


@pytest.mark.slow
def test_long_delays_wait_in_the_host(scenario):
    """Of delays of 16 and 17 ticks, 15 are the line's, so the host delays its forces by one and two ticks."""
    (made,) = certified_couplings(CouplingRequest(scenario.replace(theta=(16, 17))), 1, spare=0)
    controller = made.controller((12.0, 12.0))
    answers = np.array([controller.step((1e-3 * (k == 0), 1e-3 * (k == 0))) for k in range(4)])
    assert (answers != 0).tolist() == [[False, False], [True, False], [True, True], [True, True]]
    session = rehearsal_of(scenario, [made]).run_until_armed(0.7)
    assert session.stage == Stage.ARMED
    assert session.config
    assert session.config.theta == made.link == 15


def test_nothing_uncertified_is_loaded(scenario, link_couplings):
    with pytest.raises(SafetyStop, match=r"published .* theta = \[1, 2\]: any-environment needs 7.629"):
        certified_coupling(CouplingRequest(scenario, name="published"), 1)
    with pytest.raises(SafetyStop, match="at most theta = 15"):
        certified_coupling(CouplingRequest(scenario), 16)
    session = session_with(scenario)
    rehearsal = Rehearsal(session, Emulator(scenario), lambda ages: ())
    rehearsal.run_until_armed(0.1)
    assert session.stage == Stage.REFUSED


@pytest.mark.slow
def test_reserves_take_over_after_arming(scenario, link_couplings):
    """After 10 % late answers the session ramps out and loads the next coupling; only arm() brings forces back."""
    faults = (FaultInjection.parse("down:jitter=0.0007@0.45"),)
    rehearsal = Rehearsal(session_with(scenario), Emulator(scenario), lambda ages: link_couplings, faults)
    session = rehearsal.run_until_armed(1.2)
    assert session.stage == Stage.DISARMED
    assert session.program is link_couplings[1]
    rehearsal.run(3.0)
    assert session.stage == Stage.DISARMED
    assert not any(np.any(m.applied) for m in rehearsal.moments[-800:])
    session.arm(session.now)
    rehearsal.run(4.0)
    assert session.stage == Stage.ARMED
    assert session.config
    assert session.config.theta == 2
    assert any(np.any(m.applied) for m in rehearsal.moments[-100:])


@pytest.fixture(scope="module")
def optimal_couplings(scenario):
    """Return optimal couplings of the first bases, without the search over larger ones."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("haptic_loop.design.budgets.GROWTH", 0.0)
        return certified_couplings(CouplingRequest(scenario, name="optimal"), 1, spare=1)


def assert_in_reserve(link_couplings):
    """Check each reserve: it is softer where its delay is longer, and stiffer nowhere.

    In the loop with the longer delay, it needs less damping than the coupling before it, and no more than available.
    """
    for before, reserve in pairwise(link_couplings):
        loop, slower = (made.scenario.loop("I") for made in (before, reserve))
        later = np.greater(slower.theta, loop.theta)
        assert later.any()
        felt = [np.diag(made.scenario.loop("I").F(made.chosen.coupling).dc()) for made in (before, reserve)]
        assert (felt[1][later] < felt[0][later]).all()
        assert (felt[1] <= felt[0] * (1 + 1e-9)).all()
        needs = [THIS_ENVIRONMENT.judge(slower, made.chosen.coupling).ratio for made in (before, reserve)]
        assert needs[1] < min(needs[0], 1)


@pytest.mark.slow
def test_optimal_couplings_have_a_reserve(optimal_couplings, capsys):
    fast, soft = optimal_couplings
    assert (fast.chosen.kind, soft.chosen.kind) == ("optimal", "optimal")
    assert (fast.link, soft.link) == (1, 2)
    assert fast.assessment.requirements["this-environment"].certified
    assert soft.assessment.requirements["this-environment"].certified
    assert_in_reserve(optimal_couplings)
    assert soft.scenario.theta == (2, 2)
    bridge._print_certificate(Ages((130,) * 100), 1, optimal_couplings, (2.0, 2.0), Console(width=160))
    table = capsys.readouterr().out
    assert re.search(r"│ optimal, theta = 1, 2 .*rational.*this environment", table)
    assert re.search(r"│ optimal, theta = 2, 2 .*rational.*this environment", table)
    assert "no reserve" not in table


@pytest.mark.slow
def test_a_coupling_from_a_file_has_reserves_too(scenario, optimal_couplings, tmp_path):
    path = tmp_path / "stiff.json"
    save_coupling(Stored(scenario.loop("I"), optimal_couplings[0].chosen.coupling.form()), path)
    link_couplings = certified_couplings(CouplingRequest(scenario, name=str(path)), 1)
    assert [r.chosen.kind for r in link_couplings] == ["stiff.json", "spring-damper", "spring-damper"]
    assert [r.link for r in link_couplings] == [1, 2, 3]
    assert all(r.certified for r in link_couplings)
    assert_in_reserve(link_couplings)
    with pytest.raises(SafetyStop, match=r"stiff\.json .* theta = \[2, 2\]"):
        certified_couplings(CouplingRequest(scenario, name=str(path)), 2)  # no reserve replaces the file's coupling


@pytest.mark.slow
def test_a_reserve_armed_later_replays_bit_by_bit(scenario, optimal_couplings, tmp_path):
    """After late answers and a ramp, a person arms the reserve. The trace of both couplings replays bit by bit."""
    recorder = Recorder(2)
    rehearsal = rehearsal_of(scenario, optimal_couplings, "down:jitter=0.0007@0.45", recorder=recorder)
    session = rehearsal.run_until_armed(1.2)
    assert (session.stage, session.program) == (Stage.DISARMED, optimal_couplings[1])
    session.arm(session.now)
    rehearsal.run(1e-6 * session.now + 1.3)
    assert session.stage == Stage.ARMED
    session.stop("enough", session.now)
    rehearsal.run(1e-6 * session.now + 0.2)
    files = save(tmp_path, session, recorder, outcome("I", session, recorder, 0), False)
    result, link = load(files[0])
    assert [recipe.link_delay for recipe in _recipes_of(result)] == [1, 2]
    assert replay(result, link).identical
    assert np.abs(link["sent"][link["arming"] == 1]).max() > 100


# faults that are injected


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("drop=0.1", FaultInjection("drop", 0.1)),
        ("up:flip=0.02@1+2", FaultInjection("flip", 0.02, "up", 1.0, 2.0)),
        ("unplug@1", FaultInjection("unplug", 0.0, "both", 1.0)),
    ],
)
def test_faults_are_read(text, expected):
    assert FaultInjection.parse(text) == expected


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("dorp=0.1", "KIND one of flip, drop"),
        ("drop=2", "0 to 1"),
        ("drop=x", "could not convert"),
        ("up:unplug", "happens to the device"),
        ("drop=nan", "0 to 1"),
        ("drop@-1", "START"),
    ],
)
def test_wrong_faults_are_refused_in_one_line(text, words):
    with pytest.raises(InputError, match=words) as error:
        FaultInjection.parse(text)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(("second", "shown"), [("freeze", [300, 300]), ("toggle", [300, 301]), ("late=1", [300, 300])])
def test_second_faults_change_counts_of_the_first(scenario, second, shown):
    """The encoder shows thrice the true counts when it breaks again, at 100 true counts."""
    emulator = Emulator(scenario, tuple(map(FaultInjection.parse, ("scale=3", second))))
    counts, tick = [], emulator.device.tick
    emulator.device.tick = lambda now, seen: (counts.append(seen[0]), tick(now, seen))[1]
    for k, true in enumerate((100, 101)):
        emulator.plant.s[0] = true * emulator.plant.encoder_step[0]
        emulator.tick(1200 * k)
    assert counts == shown


@pytest.mark.slow
def test_limited_forces_replay_under_their_guarantee(scenario, link_couplings, tmp_path):
    """With caps of 0.3 and 0.2 N, the limiter keeps forces within the caps and acts in over a third of the ticks."""
    recorder = Recorder(2)
    session = Session(scenario, SafetyLimits((0.3, 0.2)), FAST)
    session.record = recorder
    Rehearsal(session, Emulator(scenario), lambda ages: link_couplings).run_until_armed(2.0)
    report = outcome("I", session, recorder, 0)
    limits = report.assessment.force_limits
    assert limits.proved
    assert tuple(limits.force_limit) == (0.3, 0.2)
    asked = np.abs(recorder.link()["asked"])
    assert (asked <= (0.3, 0.2)).all()
    assert (asked == (0.3, 0.2)).any(axis=1).mean() > 1 / 3
    assert session.counters.clipped > len(recorder) / 3
    path = save(tmp_path, session, recorder, report, False)[0]
    assert replay(*load(path)).identical


class _ActiveController:
    """A controller that pushes along the motion, so that it gives energy all the time."""

    def __init__(self, T):
        self.T, self._before = T, np.zeros(2)

    def step(self, x):
        way, self._before = np.array(x) - self._before, np.array(x)
        return -2.0 * np.sign(way)


@pytest.mark.slow
def test_the_bridges_budget_is_idle_with_certified_couplings(scenario, link_couplings, tmp_path):
    recorder = Recorder(2)
    settings = LinkSettings(measure=100, energy_budget=(0.05, np.inf))
    run = rehearsal_of(scenario, link_couplings, recorder=recorder, settings=settings)
    run.run_to_the_end(1.2)
    (part,) = outcome("I", run.session, recorder, 0).energy_budget
    assert part.limited_ticks == part.surprises == 0
    assert part.ticks == len(recorder)
    assert part.guarantee.startswith("no guarantee")  # These couplings were assessed without the budget.
    assert part.reserved_J <= part.energy_J


def test_sessions_with_forces_cut_by_the_budget_stop(scenario, link_couplings, monkeypatch):
    """The budget limits most forces of an active controller, and the record has every tick in which it does."""
    monkeypatch.setattr(
        "haptic_loop.hw.control.host_controller", lambda scenario, *given: _ActiveController(scenario.T)
    )
    recorder, stop = Recorder(2), (0.8, lambda session, now: session.stop("asked to", now))
    settings = LinkSettings(measure=100, energy_budget=(0.01, np.inf))
    run = rehearsal_of(scenario, link_couplings, recorder=recorder, settings=settings, actions=[stop])
    assert run.run_to_the_end(3.0).stage == Stage.FINISHED
    report = outcome("I", run.session, recorder, 0)
    assert recorder.link()["limited"].sum() == report.energy_budget[0].limited_ticks > 200
    assert report.session.stage == "stopped"
    assert cause_of(report.session.cause).startswith("cut by the budget:")


@pytest.mark.slow
def test_the_bridges_budget_limits_an_active_controller(scenario, link_couplings, monkeypatch, tmp_path):
    """The budget limits an active controller over a lossy line, and the replay repeats this bit by bit."""
    for module in ("control", "recording"):
        monkeypatch.setattr(
            f"haptic_loop.hw.{module}.host_controller", lambda scenario, *given: _ActiveController(scenario.T)
        )
    taken = {}
    for budget in (0.01, 10.0):
        recorder = Recorder(2)
        settings = LinkSettings(measure=100, test_encoders=False, energy_budget=(budget, np.inf))
        run = rehearsal_of(scenario, link_couplings, "down:drop=0.02@0.5", recorder=recorder, settings=settings)
        run.run_to_the_end(1.3)
        report = outcome("I", run.session, recorder, 0)
        (part,) = report.energy_budget
        path = save(tmp_path, run.session, recorder, report, False)[0]
        assert replay(*load(path)).identical
        trace = recorder.trace(run.session.units, scenario.T, {})
        dx = np.diff(trace.x, axis=0)
        lost = (dx**2 * np.array(scenario.delta)).sum(axis=1) / scenario.T
        taken[budget] = np.cumsum(-(trace.f[:-1] * dx).sum(axis=1) - lost).max()
        assert part.surprises == 0
        assert part.limited_ticks > 50 or budget > 1
        assert taken[budget] <= budget + 1e-5
    assert taken[10.0] > 2 * 0.01


# walls


@pytest.mark.slow
def test_rehearsed_forces_solve_coupling_and_wall_in_series():
    """Forces solve coupling and wall in series: Kc d + Bc dd/T = max(0, K h + B dh/T), h = max(0, x - d - gap).

    Here d is the deflection of the coupling, h the penetration of the wall, and dd and dh are their changes in a tick.
    """
    scenario = load_scenario("one-wall")
    session = rehearse(scenario, seconds=3.0)
    assert (session.stage, session.assessment.guarantee.condition) == ("finished", "any-environment")
    (Kc,), (Bc,), wall, T = session.coupling.K, session.coupling.B, scenario.environment.walls[0], scenario.T
    pushes, d, h = [], 0.0, 0.0
    for x in session.result.x[:, 0]:

        def give(way, x=x, d=d):
            return Kc * way + Bc * (way - d) / T

        def push(way, x=x, h=h):
            deep = max(0.0, x - way - wall.gap)
            return max(0.0, wall.stiffness * deep + wall.damping * (deep - h) / T)

        way = brentq(lambda way, give=give, push=push: push(way) - give(way), -0.1, 0.1, xtol=1e-16)
        pushes.append(give(way))
        d, h = way, max(0.0, x - way - wall.gap)
    felt = session.result.f[400:-120, 0]  # these are ticks at full gain
    assert felt.max() > 1.0
    assert (felt == 0).mean() > 0.3
    np.testing.assert_allclose(felt, pushes[399:-121], rtol=0, atol=2.1e-4)  # the force is rounded to steps of 0.4 mN


@pytest.mark.slow
def test_walls_on_the_bridge_replay_bit_by_bit(tmp_path, capsys):
    words = ["--scenario", "one-wall", "--duration", "1", "--out", str(tmp_path), "--no-plot"]
    assert bridge.main(["--rehearse", *words]) == 0
    shown = " ".join(capsys.readouterr().out.split())
    assert re.search(r"link while forces acted: \d+ answers a second, 0\.00 % of ticks missed", shown)
    assert re.search(r"counters of the whole session, including the delay measurement: states \d+, misses 14", shown)
    assert replay_command.main([str(tmp_path / "trace.npz")]) == 0
    with pytest.raises(ValueError, match="cannot face walls"):
        bridge.main(["--rehearse", "--coupling", "optimal", *words])


def test_budgets_need_a_coupling_certified_without_them(scenario):
    """The account guarantees an energy for any controller, but a session also needs a coupling that comes to rest."""
    soft = certified_coupling(CouplingRequest(scenario, energy_budget=0.01), 1)
    assert soft.certified
    assert (soft.assessment.guarantee.condition, soft.assessment.guarantee.energy_J) == ("energy-budget", 0.01)
    with pytest.raises(SafetyStop, match="is not certified"):
        certified_coupling(
            CouplingRequest(scenario, own=SpringDamper((5000.0, 5000.0), (0.1, 0.1)), energy_budget=0.01), 1
        )
    mine = type("Mine", (type(THIS_ENVIRONMENT),), {"name": "mine"})()
    assert certified_coupling(CouplingRequest(scenario, condition=mine), 1).certified
    with pytest.raises(SafetyStop, match="your own condition mine does not cover forces that an energy account scales"):
        certified_coupling(CouplingRequest(scenario, condition=mine, energy_budget=0.01), 1)


@pytest.mark.parametrize(("length", "exceeded"), [(1e-3, False), (2e-3, True)])
def test_a_budget_holds_up_to_its_longest_tick(length, exceeded):
    """The force f moves the hand at the speed f/(2 delta), which costs the energy f^2/(4 delta) times the tick."""
    force_step, delta, start = 1e-6, 1.0, 1e-3
    budget = SentBudget(BudgetPlan(start, None, (delta,), (1e-9,), (force_step,), 1, 0, 1e-3))
    x, force, given = 0.0, 0.0, 0.0
    for _ in range(200):
        (steps,) = budget.limit((round(-1.0 / force_step),), (x,), np.array([force]), 0)
        v = -force / (2 * delta)
        given -= (force * v + delta * v**2) * length
        x, force = x + v * length, -steps * force_step
    assert (given > start) == exceeded
