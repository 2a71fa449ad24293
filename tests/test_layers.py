"""Who may import whom, and which package lives where."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
WORLDS = ("models", "controller", "design", "sim", "hw")

#: arrows of the architecture: a package may import itself and these
MAY_IMPORT = {
    "models": set(),
    "controller": set(),
    "design": {"controller"},
    "sim": {"models", "controller", "design"},
    "hw": {"models", "controller", "design", "sim"},
}
#: commands of design, a file or a folder each, may also read scenarios, share the command line, and draw
DESIGN_COMMANDS = {f"design/{name}__main__.py" for name in ("", "audit/", "export/", "limits/", "plot/")} | {
    "design/check.py"
}
COMMANDS_MAY_IMPORT = {
    "sim.scenario",
    "sim.command",
    "sim.couplings",
    "sim.files",
    "sim.stored",
    "sim.plot",
    "sim.plot_frequency",
}

#: under `python -m design..`, so that Ctrl-C ends a command that is still being imported
STARTS_COMMANDS = ("design/__init__.py", "sim")

#: the only files that may import a package
HOMES = {
    # the last three only show what runs without them: shapes and arrows, the window, pictures without a window
    "mujoco": {
        "models/scene.py",
        "sim/mujoco_engine.py",
        "sim/view/stage.py",
        "sim/view/live.py",
        "sim/view/offscreen.py",
    },
    "cvxpy": {"design/"},
    "distributed": {"sim/validate/cluster.py"},
    "serial": {"hw/transport.py"},
    "matplotlib": {"sim/plot"},
    "PIL": {"sim/view/flat.py", "sim/view/film.py"},
}

FILES = [path for world in WORLDS for path in sorted((ROOT / world).rglob("*.py"))]


def imported(path: Path) -> set[str]:
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            names.add(node.module or "")
    return names


@pytest.mark.parametrize("path", FILES, ids=lambda p: p.relative_to(ROOT).as_posix())
def test_arrows_point_one_way(path):
    world = path.relative_to(ROOT).parts[0]
    for name in imported(path):
        package = name.split(".")[0]
        if package not in WORLDS or package == world or package in MAY_IMPORT[world]:
            continue
        shared = name in COMMANDS_MAY_IMPORT or name.startswith("sim.plot_")
        place = path.relative_to(ROOT).as_posix()
        allowed = place in DESIGN_COMMANDS and shared
        starts = (place, name) == STARTS_COMMANDS
        assert allowed or starts, f"{place} imports {name}"


@pytest.mark.parametrize("path", FILES, ids=lambda p: p.relative_to(ROOT).as_posix())
def test_packages_live_where_they_belong(path):
    place = path.relative_to(ROOT).as_posix()
    for name in imported(path):
        homes = HOMES.get(name.split(".")[0])
        if homes:
            assert any(place.startswith(home) for home in homes), f"{place} imports {name}"


def test_matplotlib_is_imported_lazily():
    """sim/run.py imports sim.plot inside the function that needs it."""
    tree = ast.parse((ROOT / "sim/run.py").read_text())
    top = [node for node in tree.body if isinstance(node, ast.Import | ast.ImportFrom)]
    assert all("plot" not in (getattr(node, "module", "") or "") for node in top)


def test_the_check_sees_a_forbidden_arrow(tmp_path):
    wrong = tmp_path / "wrong.py"
    wrong.write_text("import numpy\nfrom sim.loop import run\n")
    assert imported(wrong) == {"numpy", "sim.loop"}
