"""`from sim import ..` and `from design import ..`: the functions for scripts do what the commands do."""

import json
import subprocess
import sys

import numpy as np
import pytest

import design
import sim
from controller.coupling import SpringDamper
from design import certify, design_coupling
from models.device import RigidDevice
from sim import InputError, Result, Scenario, load, parse, simulate, validate
from sim.run import main as run_command
from sim.scenario import SCENARIOS
from sim.validate import main as validate_command

SHORT = load().replace(duration=0.3)
GAINS = SpringDamper([878.7, 551.8], [0.3864, 0.5219])


def test_every_name_that_is_exported_is_there():
    for package in (sim, design):
        assert all(getattr(package, name) is not None for name in package.__all__)
        with pytest.raises(AttributeError, match="no_such_name"):
            package.no_such_name  # noqa: B018


def test_a_file_of_the_same_name_does_not_take_the_functions_place():
    """In whatever order: this file has imported sim.validate already, a fresh process does so first."""
    assert callable(validate)
    assert callable(simulate)
    code = "import sim.validate, sim.simulate; from sim import simulate, validate; print(simulate.__module__)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "sim.api"


def test_importing_the_packages_loads_nothing():
    code = "import sys, sim, design; print(len({'numpy', 'mujoco', 'cvxpy', 'msgspec'} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "0"


def test_simulate_is_the_commands_run(tmp_path):
    result = simulate(SHORT)
    assert isinstance(result, Result)
    assert isinstance(SHORT, Scenario)
    options = ["--case", "none", "--duration", "0.3", "--no-plot", "--out", str(tmp_path)]
    assert run_command([*options, "--json", str(tmp_path / "r.json")]) == 0
    command = Result.load_npz(tmp_path / "trace.npz")
    for name in ("t", "x", "f", "x_handle", "v_handle", "w"):
        np.testing.assert_array_equal(getattr(result, name), getattr(command, name))
    assert result.meta["stability"] == json.loads((tmp_path / "r.json").read_text())["stability"]
    assert result.meta["substeps"] == 4


def test_engines_agree_on_a_run():
    mujoco, exact = simulate(SHORT, GAINS), simulate(SHORT, GAINS, engine="exact")
    assert exact.meta["substeps"] is None
    difference = np.abs(mujoco.x - exact.x).max()
    assert difference <= 1e-6 * np.abs(exact.x).max()  # RK4 x 4: docs/accuracy.md has 1.2e-8 rms


def test_validate_is_the_commands_verdict(tmp_path):
    findings = validate(load(), humans=20, engine="exact", duration=0, seed=3)
    options = ["--case", "none", "--humans", "20", "--engine", "exact", "--duration", "0", "--seed", "3", "--no-plot"]
    assert validate_command([*options, "--out", str(tmp_path), "--json", str(tmp_path / "r.json")]) == 0
    report = json.loads((tmp_path / "r.json").read_text())
    assert report["unstable"]["exact"] == int((findings.exact > 0).sum()) > 0
    assert report["worst"]["spectral_radius"] == findings.radius.max()


def test_a_design_is_certified_and_goes_where_a_coupling_goes():
    loop = load().loop("I")
    found = design_coupling(loop)
    requirements = certify(loop, found)
    assert requirements["theorem4"].certified
    assert requirements["theorem4"].proof == "rational"
    assert requirements["theorem4"].required == pytest.approx((1.3699, 1.3699), abs=1e-4)  # (1 - 1e-4) of 1.37
    assert certify(loop, found.coupling)["closed-loop"].required == requirements["closed-loop"].required
    assert (validate(load(), found, humans=10, engine="exact", duration=0).exact < 0).all()


def test_delays_that_vary_are_simulated():
    text = (SCENARIOS / "omega-pair.toml").read_text()
    scenario = parse(text + "\n[jitter]\nlo = [0, 1]\nhi = [2, 3]\n").replace(duration=0.3)
    first, again, other = (simulate(scenario, GAINS, seed=seed) for seed in (0, 0, 1))
    np.testing.assert_array_equal(first.f, again.f)
    assert np.any(first.f != other.f)
    assert first.meta["stability"] is None


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: simulate(SHORT, engine="magic"), "engine is 'magic', allowed are mujoco, exact"),
        (lambda: simulate(SHORT, substeps=0), "substeps is 0, allowed are 1 to 10000"),
        (lambda: simulate(SHORT, integrator="Euler3"), "Euler3"),
        (lambda: validate(SHORT, humans=0), "humans is 0, allowed are 1 to 1000000"),
        (lambda: validate(SHORT, engine="magic"), "engine is 'magic', allowed are exact, mujoco, both"),
        (lambda: validate(SHORT, duration=1e-3), "duration is 0.001, allowed are 0 and 0.0048 s or more"),
        (lambda: validate(SHORT, shards=0), "shards is 0"),
        (lambda: validate(SHORT.replace(device=(RigidDevice(friction=0.2),) * 2)), r"device\[0\].friction is 0.2 N"),
        (lambda: design_coupling(SHORT.loop("I"), "rubber"), "kind is 'rubber', allowed are spring-damper"),
        (lambda: certify(SHORT.loop("I"), SpringDamper([1.0], [0.0])), "K has 1 entries, .* has 2 contacts"),
    ],
)
def test_what_makes_no_sense_is_refused(call, message):
    with pytest.raises(ValueError, match=message) as caught:
        call()
    assert isinstance(caught.value, InputError | ValueError)
