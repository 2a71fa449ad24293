"""The examples run as a newcomer would run them, and print the expected lines."""

import re
from pathlib import Path

import pytest
from forked import run

ROOT = Path(__file__).parents[2]
#: examples that take more than two seconds
SLOW = ("limits_of_any_coupling", "unstable_and_certified", "your_own_device", "mujoco_two_fingers", "wheel")
SLOW += ("first_steps", "neural_environment", "compare_couplings")
EXAMPLES = sorted(p for p in (ROOT / "examples").glob("*.py") if p.stem != "classics")  # test_classics.py runs its rows

#: patterns that each example must print; docs and other tests have the same figures
PRINTED = {
    "audit": ["this-environment: needs 1.3987, 1.3987 of 1.37 N s/m: not certified", "the gains times 0.8995"],
    "compare_couplings": [
        "any passive environment",
        "this-environment +1.36.. ",
        r"-17.6. .*-34.8. .*this environment",
    ],
    "unstable_and_certified": ["without coupling: unstable", "guaranteed for .* and this environment: stable"],
    "neural_environment": [
        r"budget 1e\+09 J: limited 0 of [25]\d{3}",
        r"budget 0.01 J: limited [1-4]\d{3} of [25]\d{3}",
        "behind a coupling certified for any environment",
        "no passive hand is given more than 0.01 J",
    ],
    "first_steps": [
        r"no coupling: growth \+1.48. 1/s at 84.0 Hz",
        "designed coupling: growth -0.848 1/s",
        r"Findings\(50 sets of hands: 0 unstable",
    ],
    "mujoco_two_fingers": ["[14]000 samples of 2 channels", "no passive hand is given more than W0 = 2 mJ"],
    "omega_in_space": ["this-environment: needs 0.46.. of the damping", "every passive hand", "of 6 channels"],
    "teleoperation": [rf"{d} samples: {0.5 * (d + 1):.4f} N s/m for each robot" for d in range(9)],
    "hapkit_wall": ["wall of 264 N/m: .* certified, rational", "wall of 1600 N/m: .* not certified"],
    "limits_of_any_coupling": [r"1.37 +-34.8. ", r"1.918 +-60.00 "],
    "monte_carlo": [
        r"no coupling: 4\d\d of 500 hands unstable",
        "designed coupling: 0 of 500 hands unstable; .* 0.6 %",
    ],
    "touch_a_scene": [
        r"environment.world +stack +\d+\.\d N +0.0 % +0 of  2 +0 of  2",
        r"environment.world +block +\d+\.\d N +0.0 % +0 of  2 +0 of  2",
    ],
    "wheel": [
        r"1000 Hz: theta =  1; bare, it needs 0.0325 .* \(0.0325 at 1 kHz with theta\); coupled, 20.00",
        r" 360 Hz: theta =  4; bare, it needs 0.0671 .* \(0.0700 at 1 kHz with theta\); coupled, ",
        r"  60 Hz: theta = 25; bare, it needs 0.4800 .* \(0.4900 at 1 kHz with theta\); coupled, ",
    ],
    "your_own_device": [
        "certified = True",
        "wall of 1000 N/m .* needs 0.7749 N s/m, and 1.8000 N s/m",
        "ended finished",
        r"zero force 3[67]\d.. ms after the stop",
    ],
}


#: examples that save a picture
DRAWING = ("first_steps", "mujoco_two_fingers", "omega_in_space", "teleoperation", "hapkit_wall", "wheel")

#: a part of each long example and its quicker replacement; `make validate` runs these examples unchanged
SHORTER = {
    "limits_of_any_coupling": ("(0.7, 1.0, 1.4)", "(1.0, 1.4)"),
    "mujoco_two_fingers": ("duration = 4.0", "duration = 1.0"),
    "neural_environment": ("0.01, 6.0, 32", "0.01, 3.0, 32"),
    "unstable_and_certified": ("12.0, 4, 1", "12.0, 1, 1"),
    "your_own_device": ("SECONDS = 2.0", "SECONDS = 0.5"),
}

#: command-line arguments of two examples
ARGUMENTS = {"limits_of_any_coupling": ("damping",), "touch_a_scene": ("2", "0.3")}


@pytest.mark.slow
def test_missing_damping_ends_the_example_clearly(tmp_path):
    text = (ROOT / "examples/your_own_device.py").read_text()
    assert '"damping": 0.9' in text
    (tmp_path / "mine.py").write_text(text.replace('"damping": 0.9', '"damping": 0.0'))
    done = run(["python", tmp_path / "mine.py"], tmp_path)
    assert done.returncode == 1
    assert done.stderr == "error: delta is [0.0, 0.0]: a device without damping can guarantee nothing to any human\n"


def _marked(path):
    return pytest.param(path, SHORTER.get(path.stem), id=path.stem, marks=pytest.mark.slow if path.stem in SLOW else ())


def _unchanged(path):
    return pytest.param(path, None, id=f"{path.stem} unchanged", marks=pytest.mark.validate)


@pytest.mark.parametrize(
    ("path", "change"),
    [*(_marked(path) for path in EXAMPLES), *(_unchanged(path) for path in EXAMPLES if path.stem in SHORTER)],
)
def test_an_example_runs(path, change, tmp_path):
    file, text = path, path.read_text()
    if change:
        assert text.count(change[0]) == 1
        file = tmp_path / path.name
        file.write_text(text.replace(*change))
    done = run(["python", file, *ARGUMENTS.get(path.stem, ())], tmp_path)
    assert done.returncode == 0, done.stderr
    missing = [words for words in PRINTED[path.stem] if not re.search(words, done.stdout)]
    assert not missing, done.stdout
    if path.stem in DRAWING:
        assert [file for file in tmp_path.rglob("*") if file.suffix in (".png", ".pdf") and file.stat().st_size > 5000]
