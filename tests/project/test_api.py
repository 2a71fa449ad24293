"""`from haptic_loop import ..`: the functions for scripts do what the commands do."""

import json
import pydoc
import re
import subprocess
import sys
from dataclasses import fields, is_dataclass
from inspect import isfunction, signature
from types import SimpleNamespace

import numpy as np
import pytest
from evaluate import reported
from messages import says
from msgspec.structs import replace
from shared import SOFT

import haptic_loop
from haptic_loop import (
    DesignOptions,
    InputError,
    Scenario,
    Trace,
    assess,
    certify,
    design_coupling,
    load,
    parse,
    rehearse,
    simulate,
    transparency_of,
    validate,
)
from haptic_loop.cli.design import main as design_command
from haptic_loop.cli.run import main as run_command
from haptic_loop.cli.validate import main as validate_command
from haptic_loop.controller.coupling import Coupling, NoCoupling, SpringDamper
from haptic_loop.controller.environment import Spring
from haptic_loop.controller.ranges import Ranges
from haptic_loop.design.assessment import ForceLimits, RangesResult
from haptic_loop.design.designs import KINDS
from haptic_loop.design.result import HERE
from haptic_loop.models.device import RigidDevice
from haptic_loop.sim.run import assemble, run
from haptic_loop.sim.scenario import SCENARIOS
from haptic_loop.sim.switching import switching
from tests.evaluate import safe_with

SHORT = load().replace(duration=0.3)


def test_every_exported_name_exists():
    assert all(getattr(haptic_loop, name) is not None for name in haptic_loop.__all__)
    with pytest.raises(AttributeError, match="no_such_name"):
        haptic_loop.no_such_name  # noqa: B018


def test_importing_the_package_loads_no_library():
    code = "import sys, haptic_loop; print(len({'numpy', 'mujoco', 'cvxpy', 'msgspec'} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "0"


def test_help_and_completion_show_the_api():
    text = pydoc.render_doc(haptic_loop, renderer=pydoc.plaintext)
    public = {name for name in dir(haptic_loop) if not name.startswith("_")}
    assert public == set(haptic_loop.__all__)
    assert all(name in text for name in public)
    calls = {name for name in public if isfunction(getattr(haptic_loop, name))}
    assert all(f"{name}(" in haptic_loop.__doc__ for name in calls)  # the docstring lists every function


def test_the_options_are_those_that_the_designs_take():
    """The options in KINDS are those of DesignOptions, and the designs take them."""
    from haptic_loop.design import fixed_order as ccl
    from haptic_loop.design import optimal, spring_damper

    assert set(KINDS["ccl"].options) < set(signature(ccl.design).parameters)
    assert set(KINDS["spring-damper"].options) - {"switching"} <= set(signature(spring_damper.design).parameters)
    own = {field.name for field in fields(optimal.program.Options)} - {"bases"}
    assert set(KINDS["optimal"].options) == {*own, "switching"}
    assert set(DesignOptions.__annotations__) == {name for kind in KINDS.values() for name in kind.options}


@pytest.mark.slow
def test_guarantee_and_transparency_are_those_of_the_commands(tmp_path):

    loop = load().loop("I")
    design = design_coupling(loop)
    _, report = reported(design_command, tmp_path, "--out", str(tmp_path / "c.json"))
    assert assess(loop, design).guarantee.environments == safe_with(report) == HERE
    figures = transparency_of(loop, design)
    assert figures.mismatch_db == report["assessment"]["transparency"]["relative_mismatch_db"]
    assert figures == transparency_of(loop, design.coupling)
    assert transparency_of(loop, NoCoupling()).mismatch_db == -np.inf  # F = Theta Psi E = Lambda E in case I
    assert assess(loop, SpringDamper([2870, 2320], [5.47, 5.55])).guarantee is None
    ranges = replace(loop, ranges=Ranges(masses={"mass": (0.8, 1.2)}))
    assert assess(ranges, SpringDamper([300, 300], [0.1, 0.1]), ranges_samples=0).guarantee.any_environment


@pytest.mark.slow
def test_rehearsed_sessions_finish_with_their_guarantee():
    """The link takes 130 us from a sample to its force, so a delay of one tick of 1 ms covers it."""
    scenario = load().replace(T=1e-3, theta=(1, 1))
    session = rehearse(scenario, seconds=0.5)
    assert (session.stage, session.theta) == ("finished", (1, 1))
    assert session.assessment.guarantee.environments == HERE
    assert session.delay == pytest.approx(130e-6, abs=2e-6)  # the clock ticks in us, and each way is rounded
    designed = design_coupling(scenario.loop("I")).coupling
    np.testing.assert_array_equal(session.coupling.K, designed.K)
    assert 0.364 - 1e-9 <= session.zero_after <= 0.52  # a ramp of 100 to 250 ms, then a test of 132 ms for each motor
    assert session.result.x.shape == session.result.f.shape == (len(session.result.t), 2)
    force = np.abs(session.result.f).max(axis=1)
    assert force[-1] <= 2.5 + 1e-9  # [N] The last force is that of the motor test, which follows the coupling.
    soft = rehearse(scenario, SOFT, seconds=0.1)
    assert soft.coupling is SOFT
    assert soft.assessment.requirements["this-environment"].certified


@pytest.mark.slow
def test_springs_hold_the_axes_without_clamps():
    """Hands move y of the left and z of the right device by 3 mm; the held axes follow the closed form of a sine."""
    session = rehearse(load("omega-held"), seconds=4.0)
    assert session.stage == "finished"
    w, hand = 2 * np.pi * 0.6, 200.0 + 3.0j * 2 * np.pi * 0.6
    t, x = session.result.t, session.result.x
    cycle = x[(t >= 2.2) & (t < 2.2 + 1 / 0.6)]  # one period of the hands, at full gain
    for channel, hold in ((1, 400.0), (5, 300.0)):
        motion = 0.003 / np.hypot(1.0, 0.2) * abs(hand / (hand + hold + 1j * w * (1.0 + 1.37) - w**2 * (0.3 + 0.25)))
        assert np.ptp(cycle[:, channel]) / 2 == pytest.approx(motion, rel=0.02)
    assert np.abs(cycle[:, [2, 4]]).max() < 1e-6


def test_a_session_that_is_refused_says_why():
    session = rehearse(load().replace(T=1e-3, theta=(1, 1)), SpringDamper([2e4, 2e4], [1.0, 1.0]), seconds=0.5)
    assert session.stage == "refused"
    assert "theta = [1, 1]: " in session.cause
    assert session.result is session.zero_after is session.coupling is None


@pytest.mark.slow
def test_a_rehearsal_at_its_force_limit_is_stopped():
    """A session does not count as finished if more than half of its forces were cut in some second."""
    weak = tuple(replace(device, force_limit=0.03) for device in load().device)
    session = rehearse(load().replace(T=1e-3, theta=(1, 1), device=weak), seconds=2.2)
    assert session.stage == "stopped"
    assert re.search(r"requested, but \d+ % of the forces were cut in a second", session.cause)


def test_simulate_equals_the_commands_run(tmp_path):
    result = simulate(SHORT)
    assert isinstance(result, Trace)
    assert isinstance(SHORT, Scenario)
    options = ["--case", "none", "--duration", "0.3", "--no-plot", "--out", str(tmp_path)]
    assert run_command([*options, "--json", str(tmp_path / "r.json")]) == 0
    command = Trace.load_npz(tmp_path / "trace.npz")
    for name in ("t", "x", "f", "x_handle", "v_handle", "w"):
        np.testing.assert_array_equal(getattr(result, name), getattr(command, name))
    assert result.meta["stability"] == json.loads((tmp_path / "r.json").read_text())["stability"]
    assert (result.meta["integrator"], result.meta["substeps"]) == ("exponential", 1)


def test_engines_agree_on_a_run():
    mujoco, exact = simulate(SHORT, SOFT), simulate(SHORT, SOFT, engine="exact")
    assert exact.meta["substeps"] is None
    difference = np.abs(mujoco.x - exact.x).max()
    assert difference <= 1e-10 * np.abs(exact.x).max()


def test_validate_equals_the_commands_verdict(tmp_path):
    findings = validate(load(), humans=20, engine="exact", duration=0, seed=3)
    options = ["--case", "none", "--humans", "20", "--engine", "exact", "--duration", "0", "--seed", "3", "--no-plot"]
    _, report = reported(validate_command, tmp_path, *options, "--out", str(tmp_path))
    assert report["unstable"]["exact"] == int((findings.exact > 0).sum()) > 0
    assert report["worst"]["spectral_radius"] == findings.radius.max()


def test_validate_passes_its_arguments_on(monkeypatch):
    questions = []
    monkeypatch.setattr("haptic_loop.sim.crowds.validate", lambda question, *rest: questions.append(question))
    validate(SHORT, SOFT)
    validate(SHORT, SOFT, limiter=False, traces="all")
    rho = assess(SHORT.loop("I"), SOFT).force_limits.rho
    assert [(question.lag, question.all_traces) for question in questions] == [(rho, False), (None, True)]
    assert rho is not None


def test_own_environments_start_without_energy():
    """A passive spring is never limited, although W0 is 0; the trace has no linear stability verdict."""
    meta = simulate(SHORT, SOFT, "exact", environment=lambda u: 300.0 * u).meta
    assert meta["stability"] is None
    assert (meta["energy_budget"]["start_J"], meta["energy_budget"]["limited_ticks"]) == (0.0, 0)
    assert meta["assessment"]["guarantee"]["environments"] == "whatever computes the force"


def test_designs_are_certified_and_act_as_couplings():
    loop = load().loop("I")
    design = design_coupling(loop, condition="any-environment")
    requirements = certify(loop, design)
    assert requirements["any-environment"].certified
    assert requirements["any-environment"].proof == "rational"
    assert requirements["any-environment"].required == pytest.approx((1.3699, 1.3699), abs=1e-4)  # 0.9999 of 1.37
    assert certify(loop, design.coupling)["this-environment"].required == requirements["this-environment"].required
    assert (validate(load(), design, humans=10, engine="exact", duration=0).exact < 0).all()


@pytest.mark.slow
def test_simulate_draws_varying_delays_from_its_seed():
    text = (SCENARIOS / "omega-pair.toml").read_text()
    scenario = parse(text + "\n[varying_delay]\nlo = [0, 1]\nhi = [2, 3]\n").replace(duration=0.3)
    trace = simulate(scenario, SOFT, "exact", seed=1, limiter=False)
    moved, _ = switching(assemble(scenario, SOFT), 1, scenario.samples)
    np.testing.assert_array_equal(trace.f, run(moved, "exact").f)
    assert trace.meta["stability"] is None


def test_the_reported_seed_draws_the_periods():
    scenario = load().replace(period={"min": 0.8e-3, "max": 1.6e-3}, duration=0.1)
    trace = simulate(scenario, SOFT, seed=1)
    periods = scenario.timing(1, scenario.samples).period[: trace.t.size - 1]
    np.testing.assert_allclose(np.diff(trace.t), periods, rtol=1e-12)  # times of up to 0.1 s are rounded
    assert trace.meta["seed"] == 1


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: simulate(SHORT, engine="magic"), "engine is 'magic'.*mujoco, exact"),
        (lambda: simulate(SHORT, substeps=0), "substeps is 0.*1 to 10000"),
        (lambda: simulate(SHORT, integrator="Euler3"), "Euler3"),
        (lambda: validate(SHORT, humans=0), "humans is 0.*1 to 1000000"),
        (lambda: validate(SHORT, engine="magic"), "engine is 'magic'.*exact, mujoco, both"),
        (lambda: validate(SHORT, duration=1e-3), "duration is 0.001.*0 and 0.0048 s or more"),
        (lambda: validate(SHORT, shards=0), "shards is 0"),
        (lambda: validate(SHORT.replace(device=(RigidDevice(friction=0.2),) * 2)), r"device #1.friction is 0.2 N"),
        (lambda: design_coupling(SHORT.loop("I"), "rubber"), "kind is 'rubber'.*spring-damper"),
        (lambda: rehearse(SHORT.replace(delta=(0.0, 0.0))), r"delta is \[0.0, 0.0\]: a device without damping"),
        (lambda: rehearse(SHORT, case="none"), "case is 'none'.*I, II"),
        (lambda: rehearse(SHORT, seconds=0), "seconds is 0.*0.1 to 3600"),
        (lambda: simulate(SHORT, seed=-1), "seed is -1.*0 or more"),
        (lambda: validate(SHORT, seed=-1), "seed is -1.*0 or more"),
        (lambda: SpringDamper(800, 0.4), r"K is 800, expected a list of numbers, got shape \(\)"),
        (lambda: SpringDamper([800], 0.4), r"B is 0.4, expected a list of numbers, got shape \(\)"),
        (lambda: SpringDamper(["a"], [0.4]), r"K is \['a'\], expected a list of numbers"),
        (lambda: certify(SHORT.loop("I"), SpringDamper([1.0], [0.0])), "K has 1 entries, .* has 2 contacts"),
    ],
)
def test_bad_arguments_are_named(call, message):
    with pytest.raises(ValueError, match=message):
        call()


LOOP = SHORT.loop("I")


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: design_coupling(SHORT), 'loop is a Scenario, expected a Loop, as scenario.loop("I") gives it'),
        (lambda: design_coupling("omega-pair"), "loop is 'omega-pair' (str), expected a Loop"),
        (
            lambda: design_coupling(LOOP, "optimal", objectiv=3),
            "objectiv is no option of kind 'optimal' (did you mean",
        ),
        (lambda: design_coupling(LOOP, order=3), "order is no option of kind 'spring-damper' .. switching"),
        (
            lambda: design_coupling(LOOP, "moving-average", order=3),
            "order is no option of kind 'moving-average', which has none",
        ),
        (lambda: design_coupling(LOOP, "optimal", high_gain="x"), "high_gain is 'x' (str), expected a number"),
        (lambda: design_coupling(LOOP, "ccl", order=1.5), "order is 1.5 (float) .. whole numbers, 1 to 10"),
        (lambda: certify(SHORT, SOFT), "loop is a Scenario, expected a Loop"),
        (lambda: certify(LOOP, None), "coupling is None, expected a coupling (controller.coupling), or a Design"),
        (
            lambda: assess(LOOP, None),
            "coupling is None, expected a coupling (controller.coupling; NoCoupling() for none)",
        ),
        (lambda: certify(LOOP, SpringDamper), "expected a coupling (controller.coupling), or a Design"),
        (lambda: transparency_of(LOOP, "spring-damper"), "coupling is 'spring-damper' (str), expected a coupling"),
        (lambda: simulate(LOOP), 'scenario is a Loop, expected a Scenario, as load("omega-pair") gives it'),
        (lambda: simulate(SHORT, "spring-damper"), "coupling is 'spring-damper' (str), expected a coupling"),
        (lambda: simulate(SHORT, substeps=1.5), "substeps is 1.5 (float) .. whole numbers, 1 to 10000"),
        (lambda: simulate(SHORT, substeps=True), "substeps is True (bool) .. whole numbers"),
        (lambda: simulate(SHORT, environment=3), "environment is 3 (int), expected a function of one array"),
        (lambda: simulate(SHORT, seed="x"), "seed is 'x' (str) .. whole numbers, 0 or more"),
        (lambda: validate("omega-pair"), "scenario is 'omega-pair' (str), expected a Scenario"),
        (lambda: validate(SHORT, {"K": 1}), "coupling is {'K': 1} (dict), expected a coupling"),
        (lambda: validate(SHORT, humans=1.5), "humans is 1.5 (float) .. whole numbers, 1 to 1000000"),
        (lambda: validate(SHORT, duration="1"), "duration is '1' (str), expected a number of seconds"),
        (lambda: validate(SHORT, shards=2.0), "shards is 2.0 (float) .. whole numbers, 1 or more"),
        (lambda: rehearse(LOOP), "scenario is a Loop, expected a Scenario"),
        (lambda: rehearse(SHORT, "ccl"), "coupling is 'ccl' (str), expected a coupling"),
        (lambda: RigidDevice(damping="x"), "damping is 'x', expected a number"),
    ],
)
def test_an_argument_of_another_type_is_named(call, message):
    with pytest.raises(TypeError) as caught:
        call()
    assert says(caught.value, message)


def test_help_describes_every_result_field():
    results = [value for name in haptic_loop.__all__ if is_dataclass(value := getattr(haptic_loop, name))]
    results = [kind for kind in results if not issubclass(kind, Coupling)]
    assert {kind.__name__ for kind in results} == {
        *("Assessment", "Design", "Findings", "Guarantee", "Rehearsed", "Requirement", "Trace", "Transparency")
    }
    for kind in [*results, ForceLimits, RangesResult]:
        pages = [re.split("Attributes.*:", one.__doc__)[1] for one in kind.__mro__ if is_dataclass(one)]
        described = dict(re.findall(r"^\s+(\w+): (.+)$", "".join(pages), re.MULTILINE))
        assert set(described) == {field.name for field in fields(kind)}, kind
        for field in fields(kind):
            if "Array" in str(field.type):
                assert described[field.name].startswith(("(N", "(n", "(m")), (kind, field.name)


def test_results_are_shown_in_one_line():
    design = design_coupling(LOOP)
    trace = simulate(SHORT, design)
    shown = [SHORT, LOOP, design, assess(LOOP, design), assess(LOOP, design).guarantee, trace]
    shown += [transparency_of(LOOP, design), validate(SHORT, design, 5, engine="exact", duration=0), NoCoupling()]
    for one in shown:
        assert repr(one).startswith(f"{type(one).__name__}(")
        assert "\n" not in repr(one)
        assert len(repr(one)) < 250
    assert repr(SpringDamper([2870, 120.5], [5.47, 0])) == "SpringDamper(K=[2870, 120.5], B=[5.47, 0])"
    assert repr(trace).startswith("Trace(250 samples of 2 channels")


def test_a_stored_design_runs_as_the_design(tmp_path):
    path = tmp_path / "design.json"
    assert design_command(["--out", str(path)]) == 0
    stored, designed = simulate(SHORT, str(path)), simulate(SHORT, design_coupling(LOOP))
    np.testing.assert_array_equal(stored.f, designed.f)
    assert stored.meta["assessment"]["guarantee"] == designed.meta["assessment"]["guarantee"]
    assert (validate(SHORT, path, 5, engine="exact", duration=0).exact < 0).all()
    with pytest.raises(InputError, match=r"none\.json"):
        simulate(SHORT, "none.json")


def test_a_trace_converts_to_pandas(monkeypatch):
    """A stand-in that returns its arguments replaces pandas, which is no dependency."""
    stand_in = SimpleNamespace(DataFrame=lambda columns, index: (columns, index), Index=lambda t, name: (t, name))
    monkeypatch.setitem(sys.modules, "pandas", stand_in)
    trace = simulate(SHORT)
    columns, (index, name) = trace.to_frame()
    assert list(columns)[:4] == ["x1 [m]", "x2 [m]", "f1 [N]", "f2 [N]"]
    np.testing.assert_array_equal(columns["f2 [N]"], trace.f[:, 1])
    np.testing.assert_array_equal(index, trace.t)
    assert name == "t [s]"


def test_a_missing_pandas_gives_one_line(monkeypatch):
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(ImportError, match=r"^Trace.to_frame needs pandas, .*: pip install pandas$"):
        simulate(SHORT).to_frame()


def test_a_trace_draws_itself(tmp_path):
    trace = simulate(SHORT)
    screen, paper = trace.plot(), trace.plot(tmp_path / "run.pdf")
    assert (screen.get_size_inches()[0], paper.get_size_inches()[0]) == (11, 7.16)
    assert (tmp_path / "run.pdf").read_bytes().startswith(b"%PDF-")
    np.testing.assert_array_equal(screen.axes[1].lines[0].get_ydata(), trace.f[:, 0])
    with pytest.raises(InputError, match=r"the suffix is '.jpg'.*.png, .pdf, .svg"):
        trace.plot(tmp_path / "run.jpg")


@pytest.mark.parametrize(
    ("answer", "shown"),
    [
        (0.0, "returned 0.0,"),
        (None, "returned None,"),
        ("ab", "returned 'ab',"),
        (np.zeros(3), r"shape \(3,\),"),
        (np.zeros((2, 1)), r"shape \(2, 1\),"),
        (np.zeros(2, complex), r"shape \(2,\),"),
        (np.full(2, np.nan), r"array\(\[nan, nan\]\), shape \(2,\),"),
    ],
)
def test_wrong_answers_of_an_environment_are_refused(answer, shown):
    design = design_coupling(LOOP, condition="any-environment")
    with pytest.raises(InputError, match=rf"^environment .*{shown} expected an array of 2 finite forces \[N\], shape"):
        simulate(SHORT, design, environment=lambda u: answer)


def test_numbers_of_numpy_are_numbers():
    findings = validate(SHORT, SOFT, humans=np.int64(2), seed=np.int64(1), engine="exact", duration=np.float64(0))
    assert findings.index.size == 2


def test_help_and_refused_options_load_no_large_library():
    """Importing one of these libraries takes 0.05 to 1 s, and neither help nor a refusal needs it."""
    code = """
import contextlib, io, sys
from haptic_loop.cli.main import COMMANDS, _command
from haptic_loop.sim.scenario import InputError
for command in COMMANDS:
    for words, end in ((["--help"], SystemExit), (["--hlep"], InputError)):
        with contextlib.redirect_stdout(io.StringIO()), contextlib.suppress(end):
            _command(command).main(words)
            raise RuntimeError(f"{command} {words} did not end")
print(sorted({name.partition(".")[0] for name in sys.modules} & set(sys.argv[1:])))
"""
    large = ("mujoco", "scipy", "flint", "rich", "cvxpy", "clarabel", "matplotlib", "PIL")
    done = subprocess.run([sys.executable, "-c", code, *large], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"


def test_a_grounded_inerter_is_a_mass():
    """A mass of 1 kg with a grounded inerter of 0.25 kg requires the same damping as 1.25 kg, with a proof."""
    loop = load("omega-pair").loop("I")
    own = (*loop.network.springs, Spring(("mass", "ground"), 1.0, inertance=0.25))
    same = (*loop.network.springs, Spring(("mass", "ground"), 1.0))
    inert, massive = (
        loop.at(replace(loop.network, springs=springs, masses={"mass": mass}))
        for springs, mass in ((own, 1.0), (same, 1.25))
    )
    here, there = (certify(each, SOFT)["this-environment"] for each in (inert, massive))
    assert here.required == pytest.approx(there.required, rel=1e-9)
    assert here.proof == "rational"
