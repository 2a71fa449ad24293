"""Tests of design.export: the C file matches the loop's formulas, compiles, runs, and is called from other code."""

import json
import re
import shutil
import subprocess
import sys
from dataclasses import replace

import msgspec
import numpy as np
import pytest
from evaluate import prove_limiter
from shared import FIGURE_4, PAIR, SOFT, T, checkered

from haptic_loop.cli.check import main as check
from haptic_loop.cli.export import main
from haptic_loop.controller.coupling import PUBLISHED, Compliance, NoCoupling, SpringDamper
from haptic_loop.controller.coupling import SpringDamper as Gains
from haptic_loop.controller.environment import GROUND, Network, Spring, Wall, environment
from haptic_loop.controller.law import Law, Limiter
from haptic_loop.controller.loop import DeviceBounds, Loop
from haptic_loop.controller.lti import Lti
from haptic_loop.controller.tick import Process, StepBuffer
from haptic_loop.design import export as export_module
from haptic_loop.design.assessment import assess
from haptic_loop.design.certificate import prove, required_damping
from haptic_loop.design.coupling_file import Stored, load, save
from haptic_loop.design.export import (
    _balled,
    _Balls,
    _sequential,
    c_source,
    in_single_precision,
    process_block,
    trial,
)
from haptic_loop.design.files import InputError, one_command
from haptic_loop.design.result import ANY

SPRINGS = SpringDamper((300.0, 200.0), (0.0, 0.0))  # no state at all
FULL = Compliance(
    Lti([[0.5, 0.1], [-0.2, 0.3]], [[1e-3, 0], [2e-4, 1e-3]], [[0.4, 0], [0.1, 0.5]], [[1e-3, 1e-4], [1e-4, 2e-3]], T)
)
COUPLINGS = {"gains": SOFT, "springs": SPRINGS, "full": FULL}

CC = shutil.which("gcc") or shutil.which("cc")
needs_cc = pytest.mark.skipif(CC is None, reason="neither gcc nor cc is here: exported C files are not compiled")
PASSED = "process: 64 ticks repeat to the last bit\n"
STRICT = ["-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Werror", "-ffp-contract=off"]


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """Return a folder with the stored couplings, of which only `gains` is certified."""
    folder = tmp_path_factory.mktemp("export")
    for name, data in COUPLINGS.items():
        certificate = prove(PAIR, SOFT, "any-environment") if name == "gains" else None
        save(Stored.of(PAIR, data, certificate), folder / f"{name}.json")
    return folder


def export(place, name, *options):
    path = place / f"{name}{'-process' if '--process' in options else ''}.c"
    assert main([str(place / f"{name}.json"), "--out", str(path), *options]) == 0
    return path


def compiled(sources, *flags):
    program = sources[0].with_suffix(".out")
    subprocess.run([CC, *STRICT, *flags, *map(str, sources), "-o", str(program), "-lm"], check=True)
    return program


def run(program):
    return subprocess.run([program], capture_output=True, text=True, check=False)


def test_plain_python_repeats_the_exported_bits():
    """Python's floats, with one rounding per operation, give the outputs of the test vector to the last bit."""
    block = process_block(Stored.of(PAIR, SOFT))
    test, G = trial(block), block.system
    z = [0.0] * G.order
    for u, y in zip(test.inputs.tolist(), test.outputs.tolist(), strict=True):
        sums = []
        for row in np.block([[G.C, G.D], [G.A, G.B]]).tolist():
            total = 0.0
            for entry, value in zip(row, z + u, strict=True):
                total += entry * value
            sums.append(total)
        assert sums[: G.outputs] == y
        z = sums[G.outputs :]


#: a wall, and two devices that meet between two walls
ONE_WALL = Wall(("a", GROUND), 2000.0, 0.4, 0.005)
MEETING = (Wall(("a", GROUND), 900.0, 0.3, 1e-3), Wall((GROUND, "b"), 700.0, 0.0, 2e-3), Wall(("a", "b"), 500.0, 0.2))


@pytest.fixture(scope="module")
def limited_files(tmp_path_factory):
    """Return a folder and its stored couplings: the default pair, a star of five, a free chain of four, and walls."""
    folder, stored = tmp_path_factory.mktemp("limited"), {}
    names = ("a", "b", "c", "d", "e")
    star = tuple(Spring((name, "hub"), 300.0, 0.5) for name in names)
    free = tuple(Spring(pair, 500.0, 0.2) for pair in (("a", "b"), ("b", "c"), ("c", "d")))
    networks = {
        "star": Network(names, (*star, Spring(("hub", GROUND), 200.0, 0.1)), {"hub": 0.1}),
        "free": Network(names[:4], free),
        "wall": Network(("a",), walls=(ONE_WALL,)),
        "meeting": Network(("a", "b"), walls=MEETING),
        "box": Network(
            *(("a", "b"), (Spring(("a", "lid"), 300.0, 0.5),), {"lid": 0.1}),
            walls=(Wall(("lid", "b"), 800.0, 0.3, 5e-4), Wall((GROUND, "lid"), 900.0, 0.0, -1e-4)),
        ),
    }
    for name, network in networks.items():
        m = len(network.contacts)
        loop = Loop(T, tuple(range(m)), (0,) * m, tuple(range(m)), (5.0,) * m, network)
        soft = SpringDamper((600.0,) * m, (0.5,) * m)
        stored[name] = Stored.of(loop, soft, prove(loop, soft, "any-environment"))
    built = SpringDamper((5832.0, 2545.0), (0.187, 1.386))
    stored["pair"] = Stored.of(PAIR, built, prove_limiter(PAIR, built))
    for name, one in stored.items():
        save(one, folder / f"{name}.json")
    return folder, stored


@pytest.mark.parametrize(
    ("name", "limit"),
    [
        *(("pair", (12.0, 5.0)), ("star", (2.0,) * 5), ("free", (3.0, 2.0, 1.0, 2.0))),
        *(("wall", (2.0,)), ("meeting", (2.0, 1.5)), ("box", (1.5, 1.0))),
    ],
)
def test_limited_forces_are_those_of_the_simulator(limited_files, name, limit):
    """The simulator's forces differ by rounding, and where a slip alone changes no force by 1e-10 of M's entries."""
    stored = limited_files[1][name]
    block = process_block(stored, force_limit=limit)
    test, m = trial(block), len(limit)
    process = Process(block.limiter, np.full(m, np.inf), np.zeros(m))
    buffer = StepBuffer(process, len(test.inputs), m)
    for k, x in enumerate(test.inputs):
        buffer.x[k, :, 0] = x
        buffer.tick(k)
    np.testing.assert_allclose(buffer.f[:-1, :, 0], test.outputs, rtol=0, atol=1e-9 * max(limit))
    limited = (np.abs(test.outputs) >= limit).any(axis=1)
    assert (0.05 if block.law.walls else 0.2) < limited.mean() < 0.9
    assert (np.abs(test.outputs) <= limit).all()


@pytest.mark.parametrize("limit", [np.inf, 2.0])
def test_an_exported_wall_has_its_closed_form(limited_files, limit):
    """A spring-damper and a wall in series push with their common force p, or slip at the limit."""
    stored, T_ = limited_files[1]["wall"], T
    block = process_block(stored, force_limit=None if limit == np.inf else (limit,))
    test, K, B = trial(block), 600.0, 0.5
    a, alpha, h, d, expected = 2000.0 + 0.4 / T_, K + B / T_, 0.0, 0.0, []
    for x in test.inputs[:, 0]:
        c, free = 0.4 * h / (T_ * a), x - B / T_ * d / alpha - 0.005
        force = min(max(0.0, (free - c) / (1 / a + 1 / alpha)), limit)
        d = (force + B / T_ * d) / alpha
        h = c + force / a if force > 0 else max(0.0, free)
        expected.append(force)
    # rounding of forces up to 30 N; a slip without contact changes no force, so that M has 1e-10 added to it
    np.testing.assert_allclose(test.outputs[:, 0], expected, rtol=0, atol=1e-12 if limit == np.inf else 1e-8)
    begun = np.diff(np.array(expected) > 0)
    assert begun.sum() > 10  # contacts begin and end
    assert limit == np.inf or 3 < np.sum(np.array(expected) == limit) < 30


@pytest.mark.parametrize("condition", ["any-environment", "this-environment"])
def test_the_header_has_the_guarantee_of_the_assessment(condition, tmp_path):
    loop = Loop(1.25e-3, (1,), (0,), (1,), (0.5,), Network(("a",), walls=(ONE_WALL,)))
    coupling = SpringDamper((250.0 if condition == "any-environment" else 360.0,), (0.15,))
    stored = Stored.of(loop, coupling, prove(loop, coupling, condition))
    save(stored, tmp_path / "one.json")
    covered = assess(loop, coupling, certificate=stored.certificate, condition=condition)
    limit = ["--force-limit", "4.8"] if condition == "any-environment" else []
    header = " ".join(export(tmp_path, "one", "--process", *limit).read_text().replace(" * ", " ").split())
    assert covered.guarantee.environments in header
    assert "walls" in header
    assert "theta = 1" in header
    assert ("also while forces are limited to 4.8 N" in header) == bool(limit)


def test_exported_walls_solve_their_complementarity_problem(limited_files):
    """Gauss-Seidel sweeps over the walls between two springs give the forces of devices that meet between walls."""
    stored = limited_files[1]["meeting"]
    test = trial(process_block(stored, with_theta=False))
    S = np.array([[1.0, 0.0], [0.0, -1.0], [1.0, -1.0]])  # depths in the walls from positions
    K, B, gap = (np.array([getattr(wall, name) for wall in MEETING]) for name in ("stiffness", "damping", "gap"))
    a, alpha = K + B / T, 600.0 + 0.5 / T
    M, h, d, states = np.diag(1 / a) + S @ S.T / alpha, np.zeros(3), np.zeros(2), set()
    for x, outputs in zip(test.inputs, test.outputs, strict=True):
        free, c, p = S @ (x - 0.5 / T * d / alpha) - gap, B * h / (T * a), np.zeros(3)
        for _ in range(400):
            for i in range(3):
                p[i] = max(0.0, p[i] + (free[i] - c[i] - M[i] @ p) / M[i, i])
        f = S.T @ p
        np.testing.assert_allclose(outputs, f, rtol=0, atol=1e-11)  # rounding of forces up to a few newtons
        d = (f + 0.5 / T * d) / alpha
        h = np.maximum(0.0, S @ (x - d) - gap)
        states.add(tuple(p > 0))
    assert len(states) >= 6


@needs_cc
@pytest.mark.parametrize(
    ("name", "limit"),
    [
        *(("pair", "12,5"), pytest.param("star", "2", marks=pytest.mark.validate), ("free", "3,2,1,2")),
        *(("wall", "2"), ("wall", None), ("meeting", "2,1.5"), ("meeting", None), ("box", "1.5,1")),
    ],
)
def test_limited_c_code_repeats_its_test_vector(limited_files, name, limit):
    folder = limited_files[0]
    out = folder / f"{name}.c"
    words = ["--force-limit", limit] if limit else []
    assert main([str(folder / f"{name}.json"), "--process", *words, "--out", str(out)]) == 0
    comment = " ".join(out.read_text().replace("\n *", " ").split())  # where lines break depends on the digits of gains
    assert ("also while forces are limited" in comment) == bool(limit)
    process = run(compiled([out], "-O2", "-DHAPTIC_LOOP_TEST"))
    assert (process.returncode, process.stdout) == (0, PASSED)


@pytest.fixture(scope="module")
def space(tmp_path_factory):
    """Return the coupling of two planar devices that hold a body, and its file; one damping matrix is full."""
    tips = tuple(f"{tip}.{axis}" for tip in "ab" for axis in "xy")
    held = tuple(Spring((tip, f"body.{tip[2]}"), 700.0 if tip[0] == "a" else 400.0, 0.5) for tip in tips)
    ground = (Spring(("body.x", GROUND), 200.0, 0.1), Spring(("body.y", GROUND), 90.0, 0.1))
    network = Network(tips, (*held, *ground), {"body.x": 0.1, "body.y": 0.1})
    levels = ((9.0, 2.0), (2.0, 8.0)), ((9.0, 0.0), (0.0, 9.0))
    loop = Loop(T, (1, 1, 2, 2), (0,) * 4, (0,) * 4, (9.0, 8.0, 9.0, 9.0), network, axes=(2, 2), levels=levels)
    coupling = SpringDamper((6000.0,) * 4, (0.5,) * 4)
    stored = Stored.of(loop, coupling, prove_limiter(loop, coupling))
    save(stored, path := tmp_path_factory.mktemp("space") / "space.json")
    return stored, path


def vectors(stored, psi):
    """Return the limited process for delays `psi` in the environment, with ten times the rho of the proof.

    Unequal delays make the tick's matrix M = D_G + rho block triangular.
    """
    block, loop = process_block(stored, force_limit=(2.0, 2.0, 1.0, 1.0), balls=stored.loop.devices), stored.loop
    G = msgspec.structs.replace(loop, psi=psi).sent(stored.built())
    limiter = Limiter(G, loop.theta, limit=block.limiter.limit, rho=10 * block.limiter.rho, balls=loop.devices)
    return replace(block, system=limiter.open, law=limiter)


@pytest.mark.parametrize("psi", [(0, 0, 0, 0), (1, 1, 0, 0)])
def test_limited_force_vectors_are_those_of_the_simulator(space, psi):
    """The export's test vector has the simulator's forces, though the simulator begins with full Newton steps."""
    block = vectors(space[0], psi)
    test = trial(block)
    buffer = StepBuffer(Process(block.limiter, np.full(4, np.inf), np.zeros(4)), len(test.inputs), 4)
    for k, x in enumerate(test.inputs):
        buffer.x[k, :, 0] = x
        buffer.tick(k)
    np.testing.assert_allclose(buffer.f[:-1, :, 0], test.outputs, rtol=0, atol=1e-12)  # rounding of forces up to 2 N
    lengths = np.linalg.norm(test.outputs.reshape(-1, 2, 2), axis=2) / [2.0, 1.0]
    assert lengths.max() <= 1 + 1e-15
    assert 0.2 < (lengths >= 1 - 1e-12).any(axis=1).mean() < 0.9


@needs_cc
@pytest.mark.parametrize(("psi", "single"), checkered(((0, 0, 0, 0), (1, 1, 0, 0)), (False, True)))
def test_limited_vectors_in_c_repeat_their_test_vector(space, tmp_path, psi, single):
    block = replace(vectors(space[0], psi), single=(0.0, 0.0) if single else None)
    out = tmp_path / "process.c"
    out.write_text(c_source(block, trial(block), out.name))
    process = run(compiled([out], "-O2", "-DHAPTIC_LOOP_TEST"))
    assert (process.returncode, process.stdout) == (0, PASSED)


@pytest.mark.slow
def test_force_limits_apply_to_vectors_or_axes(space, tmp_path, capsys):
    for values, words in (("2", "2, 2 N"), ("2,1", "2, 1 N"), ("2,2,1,1", "2, 2, 1, 1 N")):
        options = [str(space[1]), "--process", "--force-limit", values, "--out", str(tmp_path / "x.c"), "--json", "-"]
        assert main(options) == 0
        forces = json.loads(capsys.readouterr().out)["forces"]
        assert words in forces
        assert ("vector" in forces) == (values.count(",") < 3)
    with pytest.raises(InputError, match=r"expected 1, 2 \(of each device's vector\) or 4 \(of each axis\)"):
        main([str(space[1]), "--process", "--force-limit", "2,1,1"])


@pytest.mark.parametrize("psi", [(0, 0, 0, 0), (1, 1, 0, 0)])
def test_unsolved_vectors_are_zero_with_their_slips(space, monkeypatch, psi):
    """After one step a device's force obeys its limit, with a slip along the force, or is 0 with 0 = q - M e."""
    table, limits = _Balls.of(vectors(space[0], psi).limiter, float), np.array([2.0, 1.0])
    M, rng = np.array(table.M)[np.ix_(*[np.argsort(table.at)] * 2)], np.random.default_rng(0)
    monkeypatch.setattr(export_module, "_MOST_STEPS", 1)
    unsolved = 0
    for q in rng.normal(size=(100, 4)):
        e, f = (np.array(part).reshape(2, 2) for part in _balled(table, q))
        np.testing.assert_allclose(f.ravel(), q - M @ e.ravel(), rtol=0, atol=1e-12)  # rounding of a few newtons
        lengths, slips = np.linalg.norm(f, axis=1), np.linalg.norm(e, axis=1)
        zero, within = (f == 0).all(axis=1), (slips == 0) & (lengths <= limits)
        limited = (abs(lengths - limits) < 1e-12) & (abs((e * f).sum(axis=1) - slips * lengths) <= 1e-12 * slips)
        assert (zero | within | limited).all()
        unsolved += zero.any()
    assert 10 < unsolved < 90


def test_force_limits_that_no_certificate_covers_are_refused(place, limited_files):
    folder = limited_files[0]
    with pytest.raises(InputError, match="the certificate covers no limited forces"):
        main([str(place / "full.json"), "--process", "--force-limit", "3", "--out", str(place / "x.c")])
    with pytest.raises(InputError, match="--force-limit is allowed only with --process"):
        main([str(folder / "pair.json"), "--force-limit", "3", "--out", str(place / "x.c")])


@pytest.mark.parametrize("data", COUPLINGS.values(), ids=COUPLINGS)
def test_export_and_simulator_differ_by_rounding(data):
    """BLAS sums in any order: export and simulator err by at most gamma_N |row| |v| per tick; A carries errors on."""
    block = process_block(Stored.of(PAIR, data))
    test, G = trial(block), block.system
    limits = np.full(2, np.inf)
    buffer = StepBuffer(Process(Law(G), limits, np.zeros(2)), len(test.inputs), plant_states=2)
    for k, x in enumerate(test.inputs):
        buffer.x[k, :, 0] = x
        buffer.tick(k)
    z = _sequential(Lti(G.A, G.B, np.eye(G.order), np.zeros_like(G.B), T), test.inputs)  # states before each tick
    terms = G.order + G.inputs
    gamma = terms * 2.0**-53 / (1 - terms * 2.0**-53)
    local = 2 * gamma * (np.abs(z) @ np.abs(G.A).T + np.abs(test.inputs) @ np.abs(G.B).T)
    carried = np.array([np.abs(G.C @ np.linalg.matrix_power(G.A, n)) for n in range(len(z))])
    for k in range(len(z)):
        own = 2 * gamma * (np.abs(G.C) @ np.abs(z[k]) + np.abs(G.D) @ np.abs(test.inputs[k]))
        bound = own + np.einsum("nij,nj->i", carried[:k][::-1], local[:k])
        assert (np.abs(buffer.f[k, :, 0] - test.outputs[k]) <= 1.01 * bound).all()  # 1.01 covers products of roundings
    largest = np.abs(test.outputs).max()
    difference = np.abs(buffer.f[: len(z), :, 0] - test.outputs).max()
    print(f"largest difference {difference:.1e} of {largest:.2g} N: {difference / np.spacing(largest):.1f} ulp")


@needs_cc
@pytest.mark.parametrize("what", [[], ["--process"]], ids=["coupling", "process"])
@pytest.mark.parametrize("name", COUPLINGS)
def test_the_c_file_repeats_its_test_vector(place, name, what):
    source = export(place, name, *what)
    # Sums may not be reordered, so vector units change nothing.
    for flags in (["-O2"], ["-O3", "-march=native"])[: 2 if name == "full" else 1]:
        process = run(compiled([source], *flags, "-DHAPTIC_LOOP_TEST"))
        assert (process.returncode, process.stderr) == (0, "")
        assert "64 ticks" in process.stdout


@pytest.mark.slow
@needs_cc
@pytest.mark.parametrize(
    ("name", "limit"),
    [
        *(("free", "3,2,1,2"), ("pair", None), ("wall", "2"), ("box", "1.5,1")),
        *(pytest.param(*each, marks=pytest.mark.validate) for each in (("pair", "12,5"), ("star", "2"))),
    ],
)
def test_single_precision_repeats_its_own_test_vector(limited_files, name, limit, capsys):
    folder = limited_files[0]
    out, words = folder / f"{name}-float.c", ["--force-limit", limit] if limit else []
    words += ["--process", "--float", "--out", str(out), "--json", "-"]
    assert main([str(folder / f"{name}.json"), *words]) == 0
    assert "differs from double precision by at most" in json.loads(capsys.readouterr().out)["single"]
    assert "double" not in re.sub(r"/\*.*?\*/", "", out.read_text(), flags=re.DOTALL)
    process = run(compiled([out], "-O2", "-DHAPTIC_LOOP_TEST"))
    assert (process.returncode, process.stdout) == (0, PASSED)


@pytest.mark.parametrize("data", COUPLINGS.values(), ids=COUPLINGS)
def test_single_precision_stays_within_its_error_bound(data):
    """Coefficients, inputs and sums are rounded to 2^-24: a row errs by gamma_(N+2) |row| |v|; A carries errors on."""
    block = process_block(Stored.of(PAIR, data))
    G, inputs = block.system, trial(block).inputs
    single, double = _sequential(G, inputs, dtype=np.float32), _sequential(G, inputs)
    z = _sequential(Lti(G.A, G.B, np.eye(G.order), np.zeros_like(G.B), T), inputs, dtype=np.float32).astype(float)
    terms = G.order + G.inputs + 2
    gamma = terms * 2.0**-24 / (1 - terms * 2.0**-24)
    local = gamma * (np.abs(z) @ np.abs(G.A).T + np.abs(inputs) @ np.abs(G.B).T)
    carried = np.array([np.abs(G.C @ np.linalg.matrix_power(G.A, n)) for n in range(len(z))])
    for k in range(len(z)):
        own = gamma * (np.abs(G.C) @ np.abs(z[k]) + np.abs(G.D) @ np.abs(inputs[k]))
        bound = own + np.einsum("nij,nj->i", carried[:k][::-1], local[:k])
        assert (np.abs(single[k] - double[k]) <= 1.01 * bound).all()


def test_single_precision_errs_little_over_many_ticks():
    error, largest = in_single_precision(process_block(Stored.of(PAIR, SOFT))).single
    assert 0 < error < 1e-4 * largest


@needs_cc
def test_the_c_files_own_test_can_fail(place):
    source = export(place, "gains", "--process")
    text = source.read_text()
    begin = text.index("process_C[2]")
    old = re.search(r"-?0x1\.\w+p[+-]\d+", text[begin:])[0]  # the first entry that is not zero
    new = float(np.nextafter(float.fromhex(old), np.inf)).hex()
    source.write_text(text[:begin] + text[begin:].replace(old, new, 1))
    process = run(compiled([source], "-DHAPTIC_LOOP_TEST"))
    assert process.returncode == 1
    assert "expected" in process.stderr


DRIVER = """
#define HAPTIC_LOOP_DECLARATIONS_ONLY
#include "SOURCE"
#include <stdio.h>
int main(void)
{
    coupling_state state;
    double x[COUPLING_CHANNELS], f[COUPLING_CHANNELS], d[COUPLING_CHANNELS];
    int k, i;
    coupling_reset(&state);
    for (k = 0; k < 40; k++) {
        coupling_free(&state, d);
        for (i = 0; i < COUPLING_CHANNELS; i++) {
            x[i] = 0.001 * (k % (5 + i));
            f[i] = 900.0 * (x[i] - d[i]) / (1.0 + 900.0 * coupling_D[i][i]);
            printf("%a\\n", f[i]);
        }
        coupling_step(&state, f, d);
    }
    return 0;
}
"""


@needs_cc
def test_other_code_can_close_the_loop(place):
    """Code with f = 900 (x - d) and V from the C file gives the forces of F = (I + E V)^-1 E with E = 900 I."""
    source = export(place, "gains")
    driver = place / "driver.c"
    driver.write_text(DRIVER.replace("SOURCE", source.name))
    out = subprocess.run([compiled([driver, source])], capture_output=True, text=True, check=True).stdout
    f = np.array([float.fromhex(line) for line in out.split()]).reshape(40, 2)
    x = 1e-3 * np.stack([np.arange(40) % 5, np.arange(40) % 6], axis=1)
    F = Gains(SOFT.K, SOFT.B).around(Lti.constant(900 * np.eye(2), T))
    np.testing.assert_allclose(f, _sequential(F, x), rtol=0, atol=1e-13)  # a few roundings of forces up to 2 N


def test_the_process_is_the_papers_force_map():
    """C (zI - A)^-1 B + D at three frequencies is Theta (I + E V)^-1 E, by the formulas of (6) and (26)."""
    system = process_block(Stored.of(PAIR, SOFT)).system
    E = environment(FIGURE_4, T)
    for hz in (1.0, 30.0, 300.0):
        z = np.exp(2j * np.pi * hz * T)
        V = np.diag(1 / (np.array(SOFT.K) + np.array(SOFT.B) * (z - 1) / (T * z)))
        expected = np.diag([1 / z, 1 / z**2]) @ np.linalg.inv(np.eye(2) + E.at(z) @ V) @ E.at(z)
        np.testing.assert_allclose(system.at(z), expected, rtol=1e-9)


def test_without_theta_the_process_omits_the_delay():
    stored = Stored.of(PAIR, SOFT)
    with_it, without = (process_block(stored, flag) for flag in (True, False))
    z = np.exp(0.3j)
    theta = np.diag([1 / z, 1 / z**2])
    np.testing.assert_allclose(with_it.system.at(z), theta @ without.system.at(z), rtol=1e-12)
    assert "NOT included" in " ".join(without.about)


def test_an_export_is_repeatable_byte_for_byte(place):
    first = export(place, "gains", "--process").read_text()
    assert f"Certified for theta = 1, 2 and {ANY}" in first
    assert export(place, "gains", "--process").read_text() == first
    assert "NOT CERTIFIED: the file carries no certificate" in export(place, "full").read_text()


BOUNDS = (DeviceBounds(0.06, 14500.0, 0.5, 0.5),) * 2
LATE = msgspec.structs.replace(PAIR, theta=(0, 0), lam=(0, 0), T_max=1.3e-3, latency=((3e-4, 6e-4),) * 2)


@pytest.mark.parametrize(
    ("loop", "coupling", "condition", "words"),
    [
        pytest.param(
            msgspec.structs.replace(PAIR, known_devices=BOUNDS),
            *(PUBLISHED["I"], "known-device", "at least 60 g"),
            marks=pytest.mark.validate,
            id="known",
        ),
        pytest.param(
            LATE,
            *(SOFT, "this-environment", "periods up to 1.3 ms; forces that latch 0.3 to 0.6 ms after"),
            marks=pytest.mark.slow,
            id="late",
        ),
    ],
)
def test_a_file_names_the_loop_that_is_certified(tmp_path, capsys, loop, coupling, condition, words):
    """Export and `check` name known devices, periods and latencies, because other loops are not certified here."""
    save(Stored.of(loop, coupling, prove(loop, coupling, condition)), tmp_path / "one.json")
    header = " ".join(export(tmp_path, "one", "--process").read_text().replace(" * ", " ").split())
    assert words in header
    assert "encoder steps are not covered" in header
    capsys.readouterr()
    assert check([str(tmp_path / "one.json"), "--json", "-"]) == 0
    assert words in json.loads(capsys.readouterr().out)["loop"]
    other = msgspec.structs.replace(loop, known_devices=None, T_max=1.2e-2 if loop is LATE else None, latency=None)
    assert not required_damping(other, coupling, "this-environment").certified


def test_an_uncertified_export_exits_with_1(place, tmp_path, capsys):
    changed = tmp_path / "changed.json"
    changed.write_text((place / "gains.json").read_text().replace("878.7", "1878.7"))
    out = tmp_path / "changed.c"
    assert main([str(changed), "--process", "--out", str(out)]) == 1
    assert "#define PROCESS_CERTIFIED 0\n" in out.read_text()
    assert main([str(place / "gains.json"), "--process", "--out", str(out)]) == 0
    assert "#define PROCESS_CERTIFIED 1\n" in out.read_text()
    capsys.readouterr()
    assert main([str(changed), "--out", str(out), "--json", "-"]) == 1
    outcome = json.loads(capsys.readouterr().out)
    assert not outcome["certificate"]["proved"]
    assert outcome["file"] == str(out)
    assert "NOT CERTIFIED" in out.read_text()


@pytest.mark.parametrize(("name", "offered"), [("gains", True), ("springs", False)])
def test_the_limiter_is_offered_only_if_certified(place, capsys, name, offered):
    export(place, name, "--process")
    assert ("--force-limit" in capsys.readouterr().out) == offered


def test_a_hostile_name_stays_inside_the_comment(tmp_path):
    path = tmp_path / "a*\nint hostile;#.json"
    save(Stored.of(PAIR, SOFT), path)
    assert main([str(path), "--out", str(tmp_path / "out.c")]) == 0
    code = re.sub(r"/\*.*?\*/", "", (tmp_path / "out.c").read_text(), flags=re.DOTALL)
    assert "hostile" not in code


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["{gains}", "--without-theta"], "--without-theta is allowed only with --process"),
        (["{gains}", "--out", "{gains}"], "name another file"),
        (["{gains}", "--out", "{place}"], "is a folder"),
        (["{gains}", "--seed", "1"], "unknown option --seed"),
        (["{place}/missing.json"], "No such file"),
        (["{place}/none.json"], "export its process with --process"),
    ],
)
def test_bad_export_options_are_refused(place, options, message):
    save(Stored.of(PAIR, NoCoupling()), place / "none.json")
    with pytest.raises(InputError, match=message), one_command():
        main([option.format(gains=place / "gains.json", place=place) for option in options])


def test_one_device_has_two_springs_in_series(tmp_path):
    """The process of one device has the static stiffness of the coupling and the spring to ground in series."""
    wall = Network(("tip",), (Spring(("tip", GROUND), 2000.0),))
    save(Stored.of(Loop(T, (1,), (0,), (1,), (1.37,), wall), SpringDamper((500.0,), (0.1,))), tmp_path / "one.json")
    static = process_block(load(tmp_path / "one.json")).system.at(1.0)
    assert static == pytest.approx(2000 * 500 / 2500)


@pytest.mark.slow
def test_the_export_needs_no_solver():
    code = "import sys, design.export; sys.exit('cvxpy' in sys.modules or 'control' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
