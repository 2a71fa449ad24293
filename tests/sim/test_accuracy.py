"""sim.accuracy: the table's figures, its front, its exit code."""

import json

import numpy as np
import pytest

from cli.accuracy import main
from sim import accuracy as yardstick
from sim.accuracy import mark_front
from sim.scenario import InputError


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    """Each row is run once: repeating it is for its seconds, which no test looks at."""
    place = tmp_path_factory.mktemp("accuracy")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(yardstick, "_REPEATS", 1)
        code = main(["--duration", "6", "--out", str(place / "o"), "--json", str(place / "r.json")])
    assert (place / "o" / "accuracy.png").stat().st_size > 10_000
    return code, json.loads((place / "r.json").read_text())


def test_figures(report):
    code, outcome = report
    assert code == 0
    rows = {(row["integrator"], row["substeps"]): row for row in outcome["rows"]}
    assert rows[None, None]["position_relative_rms"] == 0
    assert rows["exponential", 1]["position_relative_rms"] < 1e-10
    assert abs(rows["exponential", 1]["growth_rate_error"]) < 1e-9
    assert rows["exponential", 1]["verdict_correct"]
    assert rows["RK4", 4]["position_relative_rms"] < 1e-7
    assert abs(rows["RK4", 4]["growth_rate_error"]) < 1e-3
    assert rows["RK4", 4]["verdict_correct"]
    # first order errs towards stable: the sampled position leads
    assert rows["Euler", 1]["growth_rate_error"] == pytest.approx(-1.70, abs=0.01)
    assert not rows["Euler", 1]["verdict_correct"]
    assert not rows["discrete", 12]["verdict_correct"]
    assert all(row["wall_s_per_simulated_s"] > 0 for row in outcome["rows"])


def test_the_front_is_what_nothing_beats():
    names = ("engine", "wall_s_per_simulated_s", "position_relative_rms", "growth_rate_error", "verdict_correct")
    values = [("a", 1, 1, 1, True), ("a", 2, 0.5, -0.5, True), ("a", 3, 0.5, -0.6, True), ("b", 9, 9, 9, True)]
    rows = [dict(zip(names, value, strict=True)) for value in (*values, ("a", 0.5, 2, 2, False))]
    mark_front(rows)
    np.testing.assert_array_equal([row["pareto"] for row in rows], [True, True, False, True, False])


def test_bad_duration():
    with pytest.raises(InputError, match="--duration is 'x'"):
        main(["--duration", "x"])
