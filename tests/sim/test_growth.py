"""Growth rates from displacements equal known ones; voluntary motion and encoder steps count as no oscillation.

When measured, the rate of a single mode erred by up to 4e-5 1/s in the tests without a comment.
"""

import json

import numpy as np
import pytest

from haptic_loop.cli import run as command
from haptic_loop.cli import trace
from haptic_loop.controller.coupling import NoCoupling
from haptic_loop.sim.accuracy import settle
from haptic_loop.sim.run import assemble, make_engine, run
from haptic_loop.sim.scenario import InputError, load
from haptic_loop.sim.stability import close, dominant_mode, stability_of
from haptic_loop.sim.trace import Trace, growth, growths
from tests.checks.random_loops import traces

T, STEP = 1.2e-3, np.full(2, 1e-6)


def motion(seconds, *modes):
    """Return 15 mm at 0.6 Hz plus modes (last size [m], Hz, growth [1/s]), halved in channel 2, in encoder steps."""
    t = T * np.arange(round(seconds / T))
    x = 15e-3 * np.sin(2 * np.pi * 0.6 * t + 0.3)
    for size, frequency, rate in modes:
        x = x + size * np.exp(rate * (t - t[-1])) * np.sin(2 * np.pi * frequency * t)
    return np.round(np.column_stack([x, 0.5 * x]) / STEP) * STEP


@pytest.mark.parametrize(
    ("frequency", "rate"), [(f, g) for f in (6.2, 84.0) for g in (-3.0, -0.5, 0.4, 1.5)] + [(84.0, 6.0)]
)
def test_measured_rates_equal_known_ones(frequency, rate):
    """The error is at most four standard errors, plus 0.02 1/s because voluntary motion disturbs the slowest octave."""
    measured = growth(motion(6.0, (4e-4, frequency, rate)), T, STEP)
    assert measured.growth_rate_per_s == pytest.approx(rate, abs=4 * measured.error_per_s + 0.02)
    assert measured.error_per_s < 0.2
    assert measured.frequency_hz == pytest.approx(frequency, abs=1.5)  # the spectrum's lines are 1 Hz apart
    assert measured.trend == ("grows" if rate > 0 else "decays")


def test_the_error_of_a_rate_is_its_scatter():
    """The rms of reported errors equals the scatter of rates over traces with different noise, within a third."""
    rng, truth = np.random.default_rng(3), 0.3
    clean = motion(6.0, (4e-4, 60.0, truth))
    measured = [growth(clean + 1e-4 * rng.normal(size=clean.shape), T, STEP) for _ in range(60)]
    rates = np.array([one.growth_rate_per_s for one in measured])
    errors = np.array([one.error_per_s for one in measured])
    assert np.sqrt(np.mean(errors**2)) == pytest.approx(np.std(rates), rel=1 / 3)


def test_voluntary_motion_and_encoder_steps_are_no_oscillation():
    measured = growth(motion(6.0), T, STEP)
    assert measured.growth_rate_per_s is None
    assert measured.reason == "nothing oscillates above 1.1 um"


def test_flicker_below_the_named_size_is_no_oscillation():
    """In the first window 1.08 um at 5 Hz exceed the rounding in this octave, 0.2 um, but not the named 1.1 um."""
    measured = growth(motion(6.0, (0.6e-6 * np.exp(-4 * 2.5), 5.0, -4.0)), T, STEP)
    assert measured.reason == "nothing oscillates above 1.1 um"


@pytest.mark.parametrize(("size", "rate", "end"), [(2e-5, 60.0, "still there"), (4e-10, -4.0, "gone")])
def test_reasons_say_how_brief_oscillations_ended(size, rate, end):
    measured = growth(motion(6.0, (size, 84.0, rate)), T, STEP)
    assert measured.growth_rate_per_s is None
    assert measured.reason.endswith(f"was seen too briefly for a rate, and was {end} at the end")


def test_decaying_modes_do_not_hide_growing_ones():
    measured = growth(motion(6.0, (3e-4, 20.0, -0.8), (2e-5, 90.0, 1.0)), T, STEP)
    assert measured.trend == "grows"
    assert measured.frequency_hz == pytest.approx(90.0, abs=1.5)  # the spectrum's lines are 1 Hz apart


def test_a_limit_cycle_neither_grows_nor_decays():
    measured = growth(motion(6.0, (2e-3, 60.0, 0.0)), T, STEP)
    assert abs(measured.growth_rate_per_s) < 1e-3
    assert measured.amplitude_m == pytest.approx(2e-3 * np.hypot(1, 0.5), rel=0.01)  # both channels together


def test_displacements_give_the_exact_engines_growth():
    """The rate measured without coupling, while people move, equals the eigenvalue's within 1e-3 1/s."""
    simulation = assemble(load().replace(duration=6.0), NoCoupling())
    exact = dominant_mode(close(simulation.plant, simulation.F)).growth
    record = run(simulation, "exact")
    ticks = record.ticks_before_clipping(simulation.process.force_limit)
    measured = growth(record.x[:ticks], T, STEP)
    assert measured.growth_rate_per_s == pytest.approx(exact, abs=1e-3)


def test_too_few_ticks_give_a_reason():
    assert growth(motion(0.2), T, STEP).reason == "only 167 ticks; a growth rate needs 200"


@pytest.mark.slow
def test_the_command_reads_what_sim_run_writes(tmp_path, capsys):
    options = [
        "--case",
        "none",
        "--engine",
        "exact",
        "--duration",
        "9",
        "--no-plot",
        "--out",
        str(tmp_path),
    ]
    assert command.main(options) == 0
    capsys.readouterr()
    path = tmp_path / "trace.npz"
    assert trace.main([str(path), "--plot", str(tmp_path / "again.png"), "--json", "-"]) == 0
    (part,) = json.loads(capsys.readouterr().out)["growth"]
    report = json.loads((tmp_path / "report.json").read_text())
    assert part["growth_rate_per_s"] == pytest.approx(report["stability"]["exact_growth_rate_per_s"], abs=1e-3)
    assert part["stop"] == report["run"]["steady_ticks"][0][1] < report["run"]["samples"]  # the run clips at its end
    assert (tmp_path / "again.png").stat().st_size > 10_000
    assert trace.main([str(path)]) == 0
    assert "1/s at 84" in capsys.readouterr().out


def trace_of(x, meta):
    """Return a trace of displacements x with this metadata and without forces."""
    n = len(x)
    unknown = np.full((n, 2), np.nan)
    return Trace(T * np.arange(n), x, np.zeros((n, 2)), unknown, unknown, np.zeros((n, 0)), meta)


@pytest.mark.parametrize(
    ("run_part", "words"),
    [
        ({"steady_ticks": [[0, 5000]]}, "the trace has 500 ticks"),
        ({"steady_ticks": [[30, 20]]}, r"run.steady_ticks are \[\[30, 20\]\]"),
        ({"steady_ticks": "all"}, "are no pairs of ticks"),
        ({"steady_ticks": 3}, "are no pairs of ticks"),
        ({"encoder_step_m": [1e-6]}, "are no pairs of ticks"),
        ({"encoder_step_m": [1e-6, float("nan")]}, "not finite"),
    ],
)
def test_a_trace_with_wrong_metadata_is_refused(run_part, words):
    with pytest.raises(InputError, match=words):
        growths(trace_of(motion(0.6), {"run": run_part}))


def test_a_trace_without_steady_ticks_is_one_part():
    (part,) = growths(trace_of(motion(4.0, (2e-3, 84.0, 1.0)), {"run": None}))
    assert part.growth_rate_per_s == pytest.approx(1.0, abs=1e-2)


def test_parts_keep_the_ticks_of_their_trace():
    (part,) = growths(trace_of(motion(4.0, (2e-3, 84.0, 1.0)), {"run": {"steady_ticks": [[300, 3300]]}}))
    assert (part.first, part.stop) == (1800, 3300)  # the second half of the part


def test_unusable_traces_and_plot_paths_are_refused(tmp_path):
    trace_of(motion(0.0), {}).save_npz(tmp_path / "empty.npz")
    with pytest.raises(InputError, match="has no ticks"):
        trace.main([str(tmp_path / "empty.npz")])
    trace_of(motion(1.0), {}).save_npz(tmp_path / "whole.npz")
    with pytest.raises(InputError, match=r"--plot .*: is a folder, expected a file"):
        trace.main([str(tmp_path / "whole.npz"), "--plot", str(tmp_path)])
    (tmp_path / "text.npz").write_text("no trace")
    with pytest.raises(InputError, match="not a trace of this program"):
        trace.main([str(tmp_path / "text.npz")])


# a mode that nothing excites


def alike():
    """Return a scenario of two equal devices and hands with equal motions, joined so stiffly that a mode grows.

    A BLAS kernel may add the two halves of a row in different orders. A tick then excites the mode by one rounding,
    2e-16 of the state. The mode grows by 33/s: all roundings of 0.35 s add up to 6e-10; 1e-8 counts as excited.
    """
    one = load("omega-pair")
    link = {"between": ["contact 1", "contact 2"], "stiffness": 2000.0}
    ground = [{"between": [f"contact {i}", "ground"], "stiffness": 100.0} for i in (1, 2)]
    network = {"contacts": ["contact 1", "contact 2"], "springs": [link, *ground]}
    changes = {"theta": (1, 1), "human": (one.human[0],) * 2, "tap": None, "environment": network}
    return one.replace(duration=0.35, **changes)


@pytest.mark.parametrize("engine", ["exact", "mujoco"])
def test_unexcited_modes_take_the_exact_verdict(engine):
    """By symmetry the hands, which move alike, do no work on the mode in which the devices move against each other."""
    scenario = alike()
    quiet = stability_of(*simulated(scenario, engine))
    assert quiet.exact_verdict == quiet.verdict == "unstable"
    assert quiet.growth_rate_per_s is None
    assert "not excited" in quiet.reason
    loud = stability_of(*simulated(scenario.replace(tap=load("omega-pair").tap), engine))
    assert loud.verdict == "unstable"
    assert loud.growth_rate_per_s == pytest.approx(quiet.exact_growth_rate_per_s, rel=1e-2)


def simulated(scenario, engine):
    simulation = assemble(scenario, NoCoupling())
    return simulation, run(simulation, make_engine(simulation, engine, *settle(simulation, engine)[:2]))


@pytest.mark.slow
def test_no_trace_contradicts_its_eigenvalues():
    """Trace 11 has two devices that nothing joins: one is unstable, but only the other moves.

    `make validate` checks 460 traces.
    """
    rows = list(traces(1, 24))
    assert [row for row in rows if not row.holds] == []
    assert rows[11].not_excited
    assert rows[11].exact_per_s > 100
    # 8 is a third of the traces.
    assert sum(row.not_excited for row in rows) < 8 < sum(row.exact_per_s > 0 for row in rows)


@pytest.mark.parametrize("T", [0.11, 0.25, 0.6, 1.0, 1e3, 1e300])
def test_too_long_ticks_give_a_reason(T):
    x = np.sin(np.arange(400) / 7)[:, None]
    measured = growth(x, T, np.array([1e-9]))
    assert measured.growth_rate_per_s is None
    assert "a growth rate needs 0.1 s or less" in measured.words(T)
