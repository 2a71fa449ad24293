"""design.compare reports required damping and errors of several couplings for the same devices and hands."""

import json
import math
from dataclasses import replace

import pytest
from evaluate import reported

from haptic_loop.cli.compare import _beside, _nearest, main
from haptic_loop.cli.run import main as run_once
from haptic_loop.design.result import ANY, HERE, Requirement
from haptic_loop.sim.comparison import Alternative
from haptic_loop.sim.scenario import InputError


def compare(tmp_path, *options):
    return reported(main, tmp_path, *options, "--out", str(tmp_path / "out"))[1]["alternatives"]


@pytest.fixture(scope="module")
def compared(tmp_path_factory):
    """Return the rows of a comparison by coupling and condition, and the folder of its files."""
    place = tmp_path_factory.mktemp("compared")
    return {(row["coupling"], row["condition"]): row for row in compare(place, "--case", "I")}, place


@pytest.mark.slow
def test_each_coupling_has_its_guarantee_and_error(compared):
    rows, place = compared
    assert list(rows)[:2] == [("none", None), ("published", None)]
    none, free = rows["none", None], rows["spring-damper", "any-environment"]
    here, best = rows["spring-damper", "this-environment"], rows["optimal", "this-environment"]
    assert none["growth_rate_per_s"] == pytest.approx(1.481, abs=1e-3)
    assert (none["guarantee"], none["force_error_percent"]) == (None, None)
    assert none["required_damping"]["this-environment"] == pytest.approx([1.7229] * 2, rel=1e-4)
    assert free["guarantee"] == ANY
    assert [row["dc_ratio"] for row in (free, here, best)] == pytest.approx([0.476, 0.850, 1.0], abs=1e-3)
    # the rms mismatch over the band is 1.8 %; the slow motion of this run has a smaller error
    assert best["force_error_percent"] == pytest.approx(0.58, abs=0.1)
    assert here["force_error_percent"] < free["force_error_percent"]
    assert best["rms_mismatch_db"] == pytest.approx(-34.87, abs=0.3)
    assert (place / "out" / "couplings.png").stat().st_size > 50_000


@pytest.mark.slow
def test_each_row_equals_a_run_with_its_coupling(compared, tmp_path):
    """The comparison uses the exact engine and the run uses MuJoCo; both report the same force error."""
    rows, _ = compared
    assert run_once(["--no-plot", "--out", str(tmp_path), "--json", str(tmp_path / "run.json")]) == 0
    error = json.loads((tmp_path / "run.json").read_text())["ideal_force"]["error_percent"]
    assert rows["spring-damper", "this-environment"]["force_error_percent"] == pytest.approx(error, rel=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "kinds"),
    [("one-wall", ["none", "spring-damper", "spring-damper"]), ("omega-pair-ranges", ["none", "spring-damper"])],
)
def test_only_couplings_that_permit_the_environment_are_compared(tmp_path, name, kinds):
    rows = compare(tmp_path, "--scenario", name, "--no-plot")
    assert [row["coupling"] for row in rows] == kinds


def test_conditions_need_named_couplings(tmp_path):
    with pytest.raises(InputError, match="--condition"):
        main(["--condition", "any-environment", "--out", str(tmp_path)])


def test_stiffness_ranks_couplings_whose_force_errors_are_unknown():
    rows = [Alternative("soft", None, "g", dc_ratio=0.3), Alternative("stiff", None, "g", dc_ratio=0.9)]
    assert "stiff (g) is nearest to the object: 90 % of the stiffness" in _nearest(rows)
    assert _nearest([Alternative("soft", None, "g")]).startswith("No force error was measured")


def test_each_row_shows_the_worst_channels_ratio():
    needs = Requirement("own", (1.0, 3.0), (2.0, 2.0), None)
    row = Alternative("soft", None, requirements={"own": needs, "never": replace(needs, required=(math.inf, 1.0))})
    assert [row.needs(name) for name in ("own", "never", "absent")] == [1.5, None, None]


def test_tables_show_growing_loops_without_error():
    needs = {"this-environment": Requirement("this-environment", (0.5,), (1.0,), None)}
    rows = [
        Alternative("none", None, growth_rate_per_s=1.0, force_error_percent=7.0),
        Alternative("optimal", "this-environment", HERE, 0.9, -30.0, -1.0, 3.21, requirements=needs),
        Alternative("published", None, reason="it is of another loop"),
    ]
    columns = {column.header: list(column.cells) for column in _beside(rows, None).columns}
    assert columns["coupling"] == ["none", "optimal", "published"]
    assert columns["error"] == ["grows", "3.21 %", ""]
    assert columns["guarantee"] == ["none", HERE, "not possible: it is of another loop"]
    assert columns["stiffness"] == ["-", "90 %", ""]
