"""Imports between folders go one way, without cycles, and each large package is imported in one or two folders."""

import ast
import tomllib
from functools import cache
from pathlib import Path

import msgspec
import pytest
from oldest import floors
from packaging.requirements import Requirement
from threadpoolctl import threadpool_info, threadpool_limits

from haptic_loop.models.device import CompliantDevice

ROOT = Path(__file__).parents[2]
FOLDERS = ("models", "controller", "design", "sim", "hw", "cli")

#: A folder may import itself and these folders.
MAY_IMPORT = {
    "models": {"controller"},  # Lti, the lower bound of its Hermitian part, and DeviceBounds
    "controller": set(),
    "design": {"controller"},
    "sim": {"models", "controller", "design"},
    "hw": {"models", "controller", "design", "sim"},
    "cli": {"models", "controller", "design", "sim", "hw"},
}

#: the only folders that may import a package
ONLY_IN = {
    "mujoco": {"models", "sim"},
    "cvxpy": set(),
    "clarabel": {"design"},
    "serial": {"hw"},
    "matplotlib": {"sim", "cli"},
    "PIL": {"sim"},
}

FILES = [path for folder in FOLDERS for path in sorted((ROOT / folder).rglob("*.py"))]


def is_main_block(node: ast.stmt) -> bool:
    """Return whether a statement is the `if __name__ == "__main__":` tail of a file, whose imports do not count."""
    return isinstance(node, ast.If) and "__main__" in ast.unparse(node.test)


@cache
def _tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text())


def _called(node: ast.Call) -> str:
    """Return the last name of the called expression, or "" if it does not end in a name."""
    return getattr(node.func, "attr", getattr(node.func, "id", ""))


@cache
def _nodes(path: Path) -> list[ast.AST]:
    return list(ast.walk(_tree(path)))


#: names of conditions, with which only the files of EXEMPT may compare
CONDITIONS = {"any-environment", "this-environment", "ANY_ENVIRONMENT", "THIS_ENVIRONMENT"}
EXEMPT = ("design/conditions", "design/environments", "design/result")


@pytest.mark.slow
def test_only_exempt_files_compare_names_of_conditions():
    """A user's own condition works in every command, since only EXEMPT files decide by a condition's name."""
    comparisons = []
    for path in FILES:
        place = path.relative_to(ROOT).as_posix().removesuffix(".py")
        named = any(name in path.read_text() for name in CONDITIONS)
        for node in _nodes(path) if named and place not in EXEMPT else ():
            if isinstance(node, ast.Compare | ast.match_case):
                parts = [getattr(part, of, None) for part in ast.walk(node) for of in ("value", "id", "attr")]
                if any(w in CONDITIONS for w in parts if isinstance(w, str)):
                    comparisons.append(f"{place}: {ast.unparse(node)}")
    assert not comparisons


@cache
def imported(path: Path) -> set[str]:
    """Return the modules that a file imports anywhere, or by import_module(".."), without the prefix haptic_loop."""
    names = set()
    for top in _tree(path).body:
        for node in () if is_main_block(top) else ast.walk(top):
            if isinstance(node, ast.Import):
                names |= {alias.name.removeprefix("haptic_loop.") for alias in node.names}
            elif isinstance(node, ast.ImportFrom):
                assert node.level == 0, f"{path}: relative import"
                inside = {f"{node.module}.{alias.name}".removeprefix("haptic_loop.") for alias in node.names}
                modules = {name for name in inside if file_of(name)}
                names |= modules or {(node.module or "").removeprefix("haptic_loop.")}
            elif isinstance(node, ast.Call) and _called(node).endswith("import_module"):
                names |= {
                    arg.value.removeprefix("haptic_loop.")
                    for arg in node.args
                    if isinstance(arg, ast.Constant) and isinstance(arg.value, str)
                }
    return names


def file_of(name: str) -> Path | None:
    base = ROOT / name.replace(".", "/")
    return next((path for path in (base.with_suffix(".py"), base / "__init__.py") if path.is_file()), None)


def all_imports() -> list[tuple[str, str]]:
    """Return (file, module that it imports, without the prefix haptic_loop), for all files."""
    return [(path.relative_to(ROOT).as_posix(), name) for path in FILES for name in sorted(imported(path))]


def test_folders_import_only_allowed_folders():
    wrong = []
    for place, name in all_imports():
        folder, package = place.split("/")[0], name.split(".")[0]
        if package in FOLDERS and package != folder and package not in MAY_IMPORT[folder]:
            wrong.append(f"{place} imports {name}")
    assert not wrong


def test_large_packages_stay_in_their_folders():
    imports = [(place.split("/")[0], name.split(".")[0]) for place, name in all_imports()]
    assert [(folder, package) for folder, package in imports if folder not in ONLY_IN.get(package, FOLDERS)] == []


def circle(arrows: dict[str, set[str]]) -> list[str] | None:
    """Return the nodes of a closed path of arrows, or None if there is no closed path."""
    done, way = set(), []

    def visit(node: str) -> list[str] | None:
        if node in way:
            return [*way[way.index(node) :], node]
        if node in done:
            return None
        way.append(node)
        for after in sorted(arrows.get(node, ())):
            if found := visit(after):
                return found
        way.pop()
        done.add(node)
        return None

    return next((found for node in sorted(arrows) if (found := visit(node))), None)


def between_files() -> dict[str, set[str]]:
    arrows = {}
    for path in FILES:
        targets = {file_of(name) for name in imported(path) if name.split(".")[0] in FOLDERS} - {None, path}
        # The __init__.py of a folder has only a docstring.
        arrows[str(path.relative_to(ROOT))] = {str(t.relative_to(ROOT)) for t in targets if t.name != "__init__.py"}
    return {name: after for name, after in arrows.items() if not name.endswith("__init__.py")}


def test_files_have_no_import_cycle():
    assert circle(between_files()) is None


def test_folders_have_no_import_cycle():
    folders: dict[str, set[str]] = {}
    for name, after in between_files().items():
        place = Path(name).parent.as_posix()
        folders.setdefault(place, set()).update({Path(a).parent.as_posix() for a in after} - {place})
    assert circle(folders) is None


def test_the_check_sees_forbidden_imports_and_cycles(tmp_path):
    wrong = tmp_path / "wrong.py"
    main_block = "if __name__ == '__main__':\n    import cli.run\n"
    wrong.write_text(
        f"import numpy\nfrom haptic_loop.sim.run import run\nimport_module('haptic_loop.hw.session')\n{main_block}"
    )
    assert imported(wrong) == {"numpy", "sim.run", "hw.session"}
    assert circle({"a": {"b"}, "b": {"c"}, "c": {"a"}}) == ["a", "b", "c", "a"]
    assert circle({"a": {"b"}, "b": {"c"}}) is None


def test_replaced_fields_exist():
    """replace() of dataclasses and structs takes any name, so that pyright cannot see a wrong one."""
    nodes = [(path, node) for path in FILES for node in _nodes(path)]
    fields = {n.target.id for _, n in nodes if isinstance(n, ast.AnnAssign) and isinstance(n.target, ast.Name)}
    wrong = [
        f"{path.name}:{node.lineno}: {keyword.arg}"
        for path, node in nodes
        if isinstance(node, ast.Call) and _called(node) in ("replace", "change")
        for keyword in node.keywords
        if keyword.arg and keyword.arg not in fields
    ]
    assert not wrong


def test_pinned_versions_satisfy_the_lower_bounds():
    """`floors` gives a least version for each dependency; each requirement admits the version in constraints.txt."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    named = [Requirement(one) for one in [*project["dependencies"], *project["optional-dependencies"]["dev"]]]
    lines = [line for line in (ROOT / "constraints.txt").read_text().splitlines() if "==" in line]
    pinned = dict(line.split("==") for line in lines)
    assert [one.name for one in named if one.name not in pinned or not one.specifier.contains(pinned[one.name])] == []
    oldest = dict(one.split("==") for one in floors())
    assert set(oldest) >= {Requirement(one).name for one in project["dependencies"]}


def test_least_msgspec_checks_replaced_fields_again():
    """msgspec 0.20 replaces a struct's fields without __post_init__, so that a negative mass could be made."""
    assert "msgspec==0.21.*" in floors()
    with pytest.raises(ValueError, match="motor_mass is -1"):
        msgspec.structs.replace(CompliantDevice(), motor_mass=-1.0)


def test_least_threadpoolctl_finds_the_blas_of_numpy():
    """threadpoolctl 3.4 does not know scipy-openblas, so that designs would compute with every core."""
    assert "threadpoolctl==3.5.*" in floors()
    with threadpool_limits(1, user_api="blas"):
        assert [lib["num_threads"] for lib in threadpool_info() if "numpy" in lib["filepath"]] == [1]
