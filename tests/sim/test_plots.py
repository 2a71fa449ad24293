"""Lines, marks and legends of every picture show the reported numbers, up to rounding."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.text import Text

from haptic_loop.controller.units import in_unit
from haptic_loop.design.files import InputError
from haptic_loop.design.result import ANY, HERE
from haptic_loop.sim import map_plot, plots
from haptic_loop.sim.shown import Contacts, Onset
from haptic_loop.sim.trace import Trace


@pytest.fixture
def drawn(monkeypatch, tmp_path):
    """Return a function that draws and writes a picture, and returns its figure."""
    seen = []
    save = plots.save

    def look(figure, path, dpi=130):
        seen.append(figure)
        assert save(figure, path, 40).read_bytes()[:4] == b"\x89PNG"
        return path

    monkeypatch.setattr(plots, "save", look)

    def draw(function, *arguments, **keywords):
        assert function(*arguments, path=tmp_path / "a.png", **keywords) == tmp_path / "a.png"
        return seen[-1]

    return draw


def test_sessions_without_handles_show_their_encoders(drawn):
    x = np.sin(np.arange(3000) / 300)[:, None] * [1e-3, 2e-3]
    run = replace(trace(1e3 * x, x), x_handle=np.full_like(x, np.nan))
    (axis, _) = plots.draw_run(run, title="t", frequency_hz=80.0).axes
    assert axis.get_ylabel() == "displacement of the encoder [mm]"
    for i in range(2):
        np.testing.assert_array_equal(lines(axis)[f"device {i + 1}"][:, 1], 1e3 * x[:, i])


@pytest.fixture
def undrawn(monkeypatch):
    """Return a function that makes a picture without drawing its pixels, and returns its figure."""
    monkeypatch.setattr(plots, "save", lambda figure, path, dpi=130: figure)
    return lambda function, *arguments: function(*arguments, path=Path("a.png"))


def legend(figure):
    (box,) = figure.legends
    return [text.get_text() for text in box.get_texts()]


def lines(axis):
    return {line.get_label(): line.get_xydata() for line in axis.lines}


T = 1e-3


def trace(f, x=None):
    f = np.asarray(f, dtype=float)
    x = 1e-3 * f if x is None else x
    return Trace(T * np.arange(len(f)), x, f, x, x, np.zeros((len(f), 1)), {})


def test_the_zoom_shows_the_sharpest_six_periods():
    t = np.arange(4000)
    f = np.stack([np.sin(t / 300), np.sin(t / 300 + 1)], axis=1)
    f[2500:2600, 1] += 0.2 * np.sin(np.arange(100) * 2 * np.pi / 12)  # 83 Hz
    near = plots._sharpest(trace(f), 83.0)
    assert 2480 <= near.start < near.stop <= 2620
    assert near.stop - near.start == 72  # six periods
    # A short run is shown whole.
    assert plots._sharpest(trace(f[:20]), 83.0) == slice(0, 20)


def test_pictures_contain_every_sample(drawn):
    steps = np.random.default_rng(0).normal(size=(1200, 3))
    steps[60:] *= 1e-3
    f = steps.cumsum(axis=0)  # Sharp turns in the first ticks give the picture a zoom.
    f[:, 1] = 0.01 * np.arange(1200)  # the calm channel is drawn last, so that it stays visible
    figure = plots.draw_run(trace(f), title="t", frequency_hz=80.0, ideal=(2 * f, 12.34))
    curves = lines(figure.axes[2])
    for i in range(3):
        np.testing.assert_array_equal(curves[f"device {i + 1}"][:, 1], f[:, i])
        mm = lines(figure.axes[0])[f"device {i + 1}"][:, 1]
        np.testing.assert_allclose(mm, f[:, i], rtol=1e-12)  # x in mm equals f
    assert [line.get_label() for line in figure.axes[2].lines][2] == "device 2"
    assert figure.axes[0].get_ylabel() == "displacement of the handle [mm],\nwhere the encoder is"
    assert legend(figure) == [
        "device 1",
        "device 2",
        "device 3",
        "pale: the force of the object itself for this motion (force error 12 %)",
    ]


def test_the_label_says_how_near_encoders_are(drawn):
    x = np.sin(np.arange(3000) / 300)[:, None]
    run = replace(
        trace(1e3 * x, x), x_handle=1.004 * x
    )  # At an amplitude of 1 m, curves 4 mm apart look like one line.
    (axis, _) = plots.draw_run(run, title="t", frequency_hz=80.0).axes
    assert axis.get_ylabel() == "displacement of the handle [mm],\nwithin 4 mm of the encoder"
    np.testing.assert_allclose(lines(axis)["device 1"][:, 1], 1004 * x[:, 0], rtol=1e-12)


def test_legends_name_walls_and_curves_that_coincide(drawn):
    """A calm run has no zoom; walls are drawn at their positions; the legend names a curve that covers another."""
    t = np.arange(3000)
    wave = np.sin(t / 300)
    f = np.stack([wave, wave, 2 * wave], axis=1)
    touching = wave > 0.5
    around = Contacts(("left", "right", "top"), [(0, 0.0005, "wall 1")], touching)
    figure = plots.draw_run(trace(f), title="t", frequency_hz=80.0, around=around)
    displacement, force = figure.axes
    assert legend(figure) == [
        "left",
        "right, displacement (the same curve as left)",
        "right, force (the same curve as left)",
        "top",
        "in contact with a wall",
        "wall 1",
    ]
    assert set(lines(displacement)["wall 1"][:, 1]) == {0.5}
    edges = T * np.flatnonzero(np.diff(touching.astype(int)) != 0).reshape(-1, 2)
    for axis in (displacement, force):
        spans = [(part.get_x(), part.get_x() + part.get_width()) for part in axis.patches]
        np.testing.assert_allclose(spans, edges + T, rtol=1e-12)


def test_onsets_have_amplitudes_and_grey_times(drawn):
    t = T * np.arange(6000)
    swing = 1e-6 * np.exp(1.4 * t) * np.cos(2 * np.pi * 84 * t)
    handle = 0.015 * np.sin(2 * np.pi * 0.6 * t)
    x = np.stack([handle + swing, handle], axis=1)
    result = Trace(t, x, 800 * x, np.stack([handle, handle], axis=1), x, np.zeros((6000, 1)), {})
    middle, sizes = plots._amplitudes(result, 84.0, 5000)
    np.testing.assert_allclose(sizes[:, 0], 1e-6 * np.exp(1.4 * middle), rtol=0.02)  # errors were 8e-5 when measured
    assert middle[-1] < 5.0  # the amplitudes end before the first clipped tick
    onset = Onset(1.4, 5000, 4.0)  # growth [1/s], first clipped tick, end of the credible part [s]
    figure = plots.draw_run(result, title="t", frequency_hz=84.0, onset=onset)
    curve = lines(figure.axes[1])["slope predicted: +1.4 1/s"]
    assert np.diff(np.log(curve[:, 1]))[0] == pytest.approx(1.4 * np.diff(curve[:, 0])[0])
    names = [f"device 1, {what}" for what in ("handle (thick)", "encoder (thin)", "force")]
    assert legend(figure)[:3] == names
    handles, encoders = (lines(figure.axes[0])[f"device 1, {what}"] for what in ("handle (thick)", "encoder (thin)"))
    np.testing.assert_allclose(handles[:, 1], 1e3 * handle, rtol=1e-12)
    np.testing.assert_allclose(encoders[:, 1], 1e3 * x[:, 0], rtol=1e-12)
    (veil,) = figure.axes[0].patches
    assert veil.get_x() == 4.0
    assert figure.axes[3].lines[0].get_xdata().max() <= 4.0  # the zoom shows the credible part only


def test_wrong_verdicts_are_marked_by_crosses(undrawn):
    names = "integrator", "substeps", "wall_s_per_simulated_s", "position_relative_rms", "growth_rate_error"
    rows = [("RK4", 1, 0.1, 1e-6, -1e-3), ("RK4", 4, 0.3, 1e-8, 1e-5), ("Euler", 1, 0.05, 0.0, 2.0)]
    rows = [SimpleNamespace(**dict(zip(names, row, strict=True)), verdict_correct=row[0] == "RK4") for row in rows]
    rows.append(SimpleNamespace(integrator=None, position_relative_rms=0.0, growth_rate_error=0.0))
    position, growth = undrawn(plots.plot_accuracy, rows).axes
    np.testing.assert_array_equal(lines(growth)["RK4"], [(0.1, 1e-3), (0.3, 1e-5)])
    assert not lines(position)["Euler"].size  # an error of 0 has no place on a logarithmic axis
    assert [line.get_xydata().tolist() for line in growth.lines if line.get_marker() == "x"] == [[[0.05, 2.0]]]


def test_every_human_is_a_point(drawn):
    mass, damping, growth = np.array([0.1, 1.0, 2.0]), np.array([3.0, 2.0, 1.0]), np.array([-1.0, 0.0, 2.0])
    figure = plots.draw_population(mass, damping, growth, "t")
    assert legend(figure) == ["stable: 2", "unstable: 1"]
    stable, unstable = (part.get_offsets().tolist() for part in figure.axes[1].collections)
    assert stable == [[3.0, -1.0], [2.0, 0.0]]
    assert unstable == [[1.0, 2.0]]


HZ = np.array([1.0, 10.0, 100.0])


def coupling(name, ratio, at, delayed):
    demand = np.array([0.1, ratio / 2, ratio])
    part = SimpleNamespace(ratio=ratio, demand=demand, requirement=SimpleNamespace(frequency_hz=at, guarantee="here"))
    met = SimpleNamespace(guarantee="with a multiplier" if delayed else ANY)
    none = SimpleNamespace(ratio=np.inf, demand=None, requirement=met)
    felt = SimpleNamespace(
        stiffness=np.array([[1.0, 9.0], [-5.0, 9.0], [7.0, 9.0]]), damping=np.array([[0.1, 2.0]] * 3)
    )
    curves = SimpleNamespace(sigma_F=[[3.0, 1.0]] * 3, sigma_M=[[0.0, 0.0]] * 3, perceived=felt)
    conditions = {"this-environment": part, "any-environment": none}
    return SimpleNamespace(name=name, conditions=conditions, curves=curves)


def report(available=(1.37, 1.37), psi=(0, 0), names=()):
    felt = SimpleNamespace(stiffness=np.full((3, 2), 2.0), damping=np.zeros((3, 2)))
    couplings = [coupling("soft", 0.5, 100.0, any(psi)), coupling("stiff", 40.0, 0.0, any(psi))]
    data = {"frequency_hz": HZ, "available_damping": available, "psi": psi, "ideal": felt, "names": names}
    conditions = list(couplings[0].conditions)
    return SimpleNamespace(**data, sigma_E=[[4.0, 2.0]] * 3, couplings=couplings, conditions=conditions)


def test_binding_frequencies_are_marked(undrawn):
    here, anywhere = undrawn(plots.plot_required_damping, report()).axes
    np.testing.assert_allclose(lines(here)["soft"], np.transpose([HZ, 1.37 * np.array([0.1, 0.25, 0.5])]), rtol=1e-12)
    marks = {line.get_marker(): line.get_xydata()[0] for line in here.lines if line.get_marker() in "o^"}
    np.testing.assert_allclose(marks["o"], (100.0, 0.5 * 1.37), rtol=1e-12)
    # 0 Hz and a ratio of 40 are drawn at the edges
    np.testing.assert_allclose(marks["^"], (1.0, 20 * 1.37), rtol=1e-12)
    assert here.get_title() == HERE
    assert here.get_ylabel() == "required damping [N s/m]"
    assert "soft (no curve: see the printed remarks)" in lines(anywhere)
    here, anywhere = undrawn(plots.plot_required_damping, report((1.0, 2.0), (1, 0))).axes
    assert here.get_ylabel() == "required damping over available damping"
    assert anywhere.get_title() == f"{ANY} (with a multiplier for {HERE})"


def test_drawn_curves_are_the_reported_ones(undrawn):
    figure = undrawn(plots.plot_singular_values, report())
    assert [axis.get_title() for axis in figure.axes] == ["soft", "stiff"]
    assert legend(figure) == ["E, the environment", "F, felt at the devices", "M, the mismatch"]
    assert [text.get_text() for text in figure.axes[0].texts] == ["M = 0"]
    np.testing.assert_array_equal(lines(figure.axes[0])["E, the environment"], np.transpose([HZ, [4.0] * 3]))
    np.testing.assert_array_equal(lines(figure.axes[0])["F, felt at the devices"], np.transpose([HZ, [3.0] * 3]))
    figure = undrawn(plots.plot_perceived, report())
    np.testing.assert_array_equal(lines(figure.axes[0])["soft"], np.transpose([HZ, [1.0, -5.0, 7.0]]))
    np.testing.assert_array_equal(lines(figure.axes[3])["stiff"], np.transpose([HZ, [2.0] * 3]))
    assert legend(figure) == ["ideal: E itself", "soft", "stiff"]
    assert [axis.get_title() for axis in figure.axes[:2]] == ["device 1", "device 2"]
    figure = undrawn(plots.plot_perceived, report(names=("left.x", "left.y")))
    assert [axis.get_title() for axis in figure.axes[:2]] == ["left.x", "left.y"]


def k_b_map():
    B, K = np.array([0.0, 1.0, 2.0]), np.array([10.0, 20.0])
    growth = np.array([-1.0, -1.0, 1.0, 1.0, np.nan, -1.0])
    ratio = {
        "any-environment": np.array([0.5, 0.5, 2, 2, 2, 2.0]),
        "this-environment": np.array([0.5, 0.5, 2, 2, 2, 2.0]),
    }
    return SimpleNamespace(grid=SimpleNamespace(B=B, K=K, scale="linear", shape=(2, 3)), growth=growth, ratio=ratio)


def map_report(**changes):
    """Return the report of a map with three simulated points; `changes` replace its fields."""

    def point(B, K, verdict, differs=False):
        return SimpleNamespace(B=B, K=K, verdict=verdict, differs_from_linear=differs)

    effects = SimpleNamespace(encoder_step_m=[1e-5, 0.0], friction_n=[0.0, 0.0])
    points = [point(0, 10, "rests"), point(2, 20, "oscillates", True), point(1, 20, map_plot.UNDECIDED)]
    simulation = SimpleNamespace(points=points, effects=effects, nonlinear=True)
    head = {"fixed": None, "scenario": None, "coupling": None, "walls": False}
    loop = {"theta": [1, 1], "psi": [0, 1], "T": 1e-3, "delta": [1.37, 2.0]}
    rest = {
        "population": SimpleNamespace(humans=7),
        "simulation": simulation,
        "marks": [SimpleNamespace(K=15.0, B=0.5)],
    }
    return SimpleNamespace(**(head | loop | rest | changes))


def test_a_map_shows_verdicts_edges_and_points(drawn):
    figure = drawn(map_plot.plot_zwidth, k_b_map(), map_report())
    (axis,) = figure.axes
    cells = axis.collections[0].get_array()
    np.testing.assert_array_equal(cells.mask.ravel(), [False] * 4 + [True, False])
    assert cells.compressed().tolist() == [0, 0, 1, 1, 0]
    edges = axis.collections[1:3]  # Both edges coincide; the broken line is drawn last.
    assert [edge.get_linewidth()[0] for edge in edges] == [3.6, 1.8]
    assert legend(figure) == [
        "exact: stable with all of 7 humans",
        "exact: unstable with some",
        f"{HERE}: certified below this edge",
        "any-environment: certified below this edge",
        "MuJoCo: rests (1)",
        "MuJoCo: oscillates (1)",
        f"MuJoCo: {map_plot.UNDECIDED} (1)",
        "unlike the linear loop (1)",
    ]
    drawn_at = [(line.get_marker(), line.get_xydata().tolist()) for line in axis.lines]  # damping across, stiffness up
    circles = [("o", [[0, 10]]), ("X", [[2, 20]]), ("D", [[1, 20]]), ("o", [[2, 20]])]
    assert drawn_at == [*circles, ("*", [[0.5, 15]])]
    title = "rigid wall: theta 1, T 1 ms, delta 1.37, 2 N s/m\npsi 0, 1, encoder step 10 um"
    assert figure.get_suptitle() == title


def test_logarithmic_maps_show_marks_without_damping(drawn):
    chart = k_b_map()
    chart.grid.B, chart.grid.scale = np.array([0.1, 1.0, 2.0]), "log"
    empty = SimpleNamespace(points=[], effects=map_report().simulation.effects, nonlinear=False)
    report = map_report(marks=[SimpleNamespace(K=15.0, B=0.0)], simulation=empty)
    (axis,) = drawn(map_plot.plot_zwidth, chart, report).axes
    assert [line.get_xydata().tolist() for line in axis.lines if line.get_marker() == "*"] == [[[0.1, 15.0]]]
    assert [text.get_text() for text in axis.texts] == ["15, 0"]


def test_cells_meet_halfway():
    np.testing.assert_allclose(map_plot._cell_edges(np.array([1.0, 2.0, 4.0]), "linear"), [1, 1.5, 3, 4], rtol=1e-12)
    np.testing.assert_allclose(map_plot._cell_edges(np.array([1.0, 100.0, 1e4]), "log"), [1, 10, 1e3, 1e4], rtol=1e-12)


def test_panels_show_forces_beside_ideal_ones(undrawn):
    """The axes of both panels end at 1.5 times the largest ideal force of `calm`, the only run credible to its end."""
    f, t = np.array([[0.0], [1.0], [3.0]]), T * np.arange(3)
    panels = [plots.Panel("calm", trace(f), 2 * f), plots.Panel("wild", trace(5 * f), 9 * f, 1.5e-3)]
    figure = undrawn(plots.plot_side_by_side, panels)
    for axis, panel in zip(figure.axes, panels, strict=True):
        ideal, own = axis.lines[:2]
        np.testing.assert_array_equal(ideal.get_xydata(), np.column_stack([t, panel.ideal]))
        np.testing.assert_array_equal(own.get_xydata(), np.column_stack([t, panel.trace.f]))
        assert axis.get_ylim() == (-9.0, 9.0)
    (veil,) = figure.axes[1].patches
    assert (veil.get_x(), veil.get_x() + veil.get_width()) == (1.5e-3, t[-1])
    assert not figure.axes[0].patches


def test_environment_maps_mark_their_design_point(drawn):
    springs = [SimpleNamespace(B=1.0, K=15.0), SimpleNamespace(B=9.0, K=15.0)]
    fixed = SimpleNamespace(kind="spring-damper", contact_springs=springs)
    empty = SimpleNamespace(points=[], effects=map_report().simulation.effects, nonlinear=False)
    figure = drawn(map_plot.plot_zwidth, k_b_map(), map_report(fixed=fixed, simulation=empty))
    marks = [line.get_xydata().tolist() for line in figure.axes[0].lines if line.get_marker() == "P"]
    assert marks == [[[1.0, 15.0]]]  # the other spring is not on the map
    assert f"{HERE}: certified inside this edge" in legend(figure)


def test_legends_say_where_maps_are_certified(drawn):
    stiffer = k_b_map()
    stiffer.ratio = {"any-environment": np.array([2, 2, 2, 0.5, 2, 2.0])}
    figure = drawn(map_plot.plot_zwidth, stiffer, map_report(psi=[0, 0]))
    assert f"{ANY}: certified above this edge" in legend(figure)


def test_every_unit_in_a_picture_becomes_rotary():
    """Tick labels have no unit, so they are not rewritten."""
    f = np.sin(np.arange(2000) / 20)[:, None] * np.exp(np.arange(2000) / 500)[:, None]
    figure = plots.draw_run(trace(f), "2 mm", 8.0, ideal=(f, 15.0), onset=Onset(2.0, 1500))
    figure.axes[0].annotate("1 N", (0, 0))
    ticks = [len(part.majorTicks) for axis in figure.axes for part in (axis.xaxis, axis.yaxis)]
    plots.relabel(figure, "rad")
    assert [len(part.majorTicks) for axis in figure.axes for part in (axis.xaxis, axis.yaxis)] == ticks
    figure.set_layout_engine("none")
    figure.canvas.draw()
    texts = [text.get_text() for text in figure.findobj(Text)]
    assert {"2 mrad", "1 N m"} <= set(texts)
    assert [in_unit(text, "rad") for text in texts] == texts


def test_lines_are_told_apart_without_colours():
    styles = [str(style["linestyle"]) for style in plots.STYLES]
    assert len(set(styles)) == len(styles)


@pytest.mark.parametrize(
    ("suffix", "begin"), [("png", b"\x89PNG"), ("pdf", b"%PDF-"), ("svg", b"<?xml"), ("PDF", b"%PDF-")]
)
def test_a_picture_has_the_format_of_its_suffix(suffix, begin, tmp_path):
    assert plots.save(Figure(), tmp_path / f"a.{suffix}").read_bytes().startswith(begin)


@pytest.mark.parametrize("name", ["a", "a.jpg", "a.pn"])
def test_other_suffixes_of_pictures_are_refused(name, tmp_path):
    with pytest.raises(InputError, match=r"the suffix is .*\.png, \.pdf, \.svg"):
        plots.save(Figure(), tmp_path / name)
    with pytest.raises(InputError, match="no null byte"):
        plots.save(Figure(), tmp_path / f"{name}\0.png")
    assert not list(tmp_path.iterdir())
