"""Bounds of motor and transmission contain the true values of simulated rigs; unsuitable rigs are refused."""

import json
from contextlib import suppress
from pathlib import Path
from runpy import run_path
from types import SimpleNamespace

import msgspec
import numpy as np
import pytest
from scipy.linalg import expm

from haptic_loop.cli.identify import _table
from haptic_loop.cli.identify import main as identify_command
from haptic_loop.controller.loop import DeviceBounds
from haptic_loop.hw.friction import friction
from haptic_loop.hw.identify import chirp
from haptic_loop.hw.transmission import transmission_bounds
from haptic_loop.hw.viscosity import Spectra
from haptic_loop.sim.scenario import load

T, STEP, FAR = 1.2e-3, 5e-6, 1e9  # [s], [m], [N/m]; FAR stands for a clamp of 1000 t


def signals(seconds=1.5):
    """Return the forces [N] of a free record and of two clamped ones, in steps of 0.4 mN."""
    whole = chirp(1, T, 1, 1.0, (3.0, 200.0), seconds).signal[:, 0]
    return [4e-4 * np.round(level * whole / 4e-4) for level in (1.0, 1.0, 0.5)]


def record(force, m1, m2, k, b, delta, ground=0.0, lag=0.0):
    """Return encoder positions (N,) [m] of two masses, exact for held forces; `ground` [N/m] is a spring at the handle.

    A current loop of first order with time constant `lag` [s] stands before the motor.
    """
    A = np.zeros((6, 6))  # x, y, v, w, force, requested force
    A[0, 2] = A[1, 3] = 1
    A[2] = [-k / m1, k / m1, -(delta + b) / m1, b / m1, 1 / m1, 0]
    A[3] = [k / m2, -(k + ground) / m2, b / m2, -b / m2, 0, 0]
    A[4] = [0, 0, 0, 0, -1 / (lag or 1), 1 / (lag or 1)]
    step, s, out = expm(A * T), np.zeros(6), np.zeros(len(force))
    for n, f in enumerate(force):
        out[n], s[5] = s[0], f
        if not lag:
            s[4] = f
            A[4] = 0
        s = step @ s
    return STEP * np.round(out / STEP + 0.37)


def bounds(m1, m2, k, b, delta, lag=0.0, clamp=FAR):
    """Return the bounds of a rig whose handle is clamped by a mass of 1000 t, or by a spring `clamp` [N/m]."""
    free, *clamped = signals()
    x = record(free, m1, m2, k, b, delta, 0.0, lag)
    heavy, ground = (1e6, 0.0) if clamp == FAR else (m2, clamp)
    held = [(record(f, m1, heavy, k, b, delta, ground, lag), f) for f in clamped]
    return transmission_bounds((x, free), held, T, STEP, friction(x, free, T, STEP))


RIGS = [(0.06, 0.19, 14500.0, 0.5, 1.37), (0.09, 0.12, 9000.0, 2.5, 0.6), (0.05, 0.2, 20000.0, 0.2, 1.0)]


@pytest.mark.slow
@pytest.mark.parametrize(("m1", "m2", "k", "b", "delta"), RIGS)
def test_bounds_contain_the_truth(m1, m2, k, b, delta):
    bound = bounds(m1, m2, k, b, delta)
    assert 0.97 * m1 < bound.motor_mass_min <= m1
    assert k <= bound.transmission_stiffness_max < 1.03 * k
    assert bound.transmission_damping_min <= b <= bound.transmission_damping_max
    assert bound.transmission_damping_max - bound.transmission_damping_min < 0.3 * b
    assert bound.late < 0.02 * T


@pytest.mark.parametrize("held", [False, True])
def test_derivatives_of_responses_are_exact(held):
    """Derivatives equal central differences.

    The tolerance is 1e-5 times the largest difference. It covers the error of differences, which is of second order in
    the step, and rounding.
    """
    free = signals(0.2)[0]
    spectra = Spectra(record(free, *RIGS[0]), free, T, held)
    p = np.array([*np.log(RIGS[0][:4]), 1.37, 3e-5, 2e-5, 0.3, 0.1])
    exact = spectra.derivatives(p, 4e-3)
    for i, step in enumerate([1e-5] * 5 + [1e-9] * 2 + [1e-5] * 2):
        high, low = (spectra.model(q, 4e-3) for q in (p + step * np.eye(9)[i], p - step * np.eye(9)[i]))
        difference = (high - low) / (2 * step)
        np.testing.assert_allclose(exact[:, i], difference, rtol=0, atol=1e-5 * np.abs(difference).max())


@pytest.mark.slow
def test_a_lossless_transmission_has_no_bounds():
    with pytest.raises(ValueError, match=r"transmission damping .* lower bound .*, which is not above 0|leave"):
        bounds(0.06, 0.19, 14500.0, 1e-4, 1.37)


@pytest.mark.slow
def test_a_late_current_loop_is_refused():
    with pytest.raises(ValueError, match="us late, at most 60 us"):
        bounds(*RIGS[0], lag=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("clamp", [2e4, pytest.param(1e5, marks=pytest.mark.validate), 1e6])
def test_a_soft_clamp_hides_no_stiffness(clamp):
    """A clamp that gives way makes the transmission look softer: the record is refused, or the bound still holds."""
    with suppress(ValueError):
        bound = bounds(*RIGS[0], clamp=clamp)
        assert bound.transmission_stiffness_max >= 14500.0
        assert bound.motor_mass_min <= 0.06


@pytest.mark.slow
def test_play_and_presliding_friction_are_refused():
    """The plant of the benchmark simulates play and presliding friction."""
    bench = run_path(str(Path(__file__).parents[1] / "benchmarks/odd_rigs.py"))
    odd = ({"gap": 1e-5}, {"coulomb": 0.03, "bristle": 2000.0})
    free, *clamped = signals(0.5)
    forces = np.concatenate([free, *clamped])
    rigs = [bench["Rig"]("free", **more) for more in odd]
    held = [bench["Rig"]("clamped", hand=(1e6, 0.0, 0.0), **more) for more in odd]
    x = bench["records"](rigs + held, forces, substeps=6)
    n = len(free)
    for i in range(len(odd)):
        records = [(x[:n, i], free), *((x[(1 + j) * n : (2 + j) * n, len(odd) + i], f) for j, f in enumerate(clamped))]
        with pytest.raises(ValueError, match=r"leave [3-9]"):
            transmission_bounds(records[0], records[1:], T, STEP, friction(*records[0], T, STEP))


@pytest.mark.slow
def test_written_bounds_are_rounded_outwards():
    """A written table is read as a device with bounds that are no tighter than those found."""
    bound, known = bounds(*RIGS[0]), load("omega-pair-known")
    axis = SimpleNamespace(
        viscous=1.37, delta=1.36, viscosity=SimpleNamespace(speed=0.5), friction=SimpleNamespace(mass=1)
    )
    (written,) = msgspec.toml.decode(_table(known.device[0], [axis], [bound]))["device"]
    device = known.replace(device=[written] * 2).device[0]
    assert device.guaranteed.motor_mass_min <= bound.motor_mass_min
    assert device.guaranteed.transmission_stiffness_max >= bound.transmission_stiffness_max
    assert device.guaranteed.transmission_damping_min <= bound.transmission_damping_min
    assert device.guaranteed.transmission_damping_max >= bound.transmission_damping_max


@pytest.mark.validate
def test_the_command_writes_bounds_for_known_device(tmp_path):
    options = ["--rehearse", "--scenario", "omega-pair-known", "--measure", "60", "--seconds", "0.5", "--travel", "8"]
    assert identify_command([*options, "--transmission", "--out", str(tmp_path)]) == 0
    report = json.loads((tmp_path / "report.json").read_text())
    assert len(report["transmissions"]) == 2
    text = (tmp_path / "devices.toml").read_text()
    known = load("omega-pair-known")
    written = msgspec.toml.decode(text)["device"]
    again = known.replace(device=written)  # refused unless the simulated devices lie within the bounds
    for device in again.device:
        assert isinstance(device.guaranteed, DeviceBounds)
        assert 0.057 < device.guaranteed.motor_mass_min <= 0.06
        assert 14500 <= device.guaranteed.transmission_stiffness_max < 15000
        least, most = device.guaranteed.transmission_damping_min, device.guaranteed.transmission_damping_max
        assert 0.4 < least <= 0.5 <= most < 0.6
