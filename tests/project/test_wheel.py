"""The wheel works in a new environment, from a folder whose modules have the names of this package's folders."""

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    """Return the scripts folder of a new environment that holds the wheel and links to the present libraries."""
    place = tmp_path_factory.mktemp("wheel")
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "-q"]
    build = f"import setuptools.build_meta as backend; backend.build_wheel({str(place)!r})"  # as pip does, without pip
    subprocess.run([sys.executable, "-c", build], cwd=_copied_sources(place), stdout=subprocess.DEVNULL, check=True)
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(place / "env")], check=True)
    wheel = next(place.glob("haptic_loop-*.whl"))
    python = place / "env/bin/python"
    subprocess.run(
        [*pip, "--python", str(python), "install", "--no-deps", "--no-index", "--no-compile", str(wheel)], check=True
    )
    libraries = next(Path(path) for path in sys.path if path.endswith("site-packages"))
    site = next((place / "env/lib").glob("python*/site-packages"))
    for entry in libraries.iterdir():  # without our own editable installation
        if "haptic_loop" not in entry.name and not (site / entry.name).exists():
            (site / entry.name).symlink_to(entry)
    return place / "env/bin"


def _copied_sources(place: Path) -> Path:
    """Copy the files that git does not ignore, without docs and tests: the build must not write into the checkout."""
    listed = subprocess.run(["git", "ls-files", "-co", "--exclude-standard"], cwd=ROOT, capture_output=True, text=True)
    for name in listed.stdout.split("\n"):
        source, target = ROOT / name, place / "sources" / name
        if name and source.is_file() and name.split("/")[0] not in ("docs", "tests"):
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes(source.read_bytes())
    return place / "sources"


@pytest.fixture
def users_folder(tmp_path):
    """Return the folder of a user's project, whose modules are named like this package's folders."""
    for name in ("models/__init__.py", "controller/__init__.py", "sim.py", "cli.py", "design.py", "hw.py"):
        file = tmp_path / name
        file.parent.mkdir(exist_ok=True)
        file.write_text("raise ImportError('a module of the user was imported')\n")
    return tmp_path


@pytest.mark.slow
def test_console_script_ignores_the_users_modules(installed, users_folder):
    words = ["run", "--case", "none", "--duration", "0.3", "--no-plot"]
    done = subprocess.run([installed / "haptic-loop", *words], cwd=users_folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert (users_folder / "out").is_dir()


@pytest.mark.slow
def test_wheel_installs_one_package(installed, users_folder):
    code = "import haptic_loop, haptic_loop.sim, sys; print(haptic_loop.sim.__file__); haptic_loop.load('omega-pair')"
    done = subprocess.run([installed / "python", "-c", code], cwd=users_folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "site-packages/haptic_loop/sim" in done.stdout
    site = next((installed.parent / "lib").glob("python*/site-packages"))
    own = {file.name for file in site.iterdir() if not file.is_symlink()}
    assert own & {"models", "controller", "design", "sim", "hw", "cli", "tests", "docs", "examples"} == set()
