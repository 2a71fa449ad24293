"""Run commands as a user does, but without a second of imports: a process with all imports forks for each command."""

from __future__ import annotations

import atexit
import fcntl
import functools
import gc
import hashlib
import inspect
import json
import os
import pickle
import pkgutil
import runpy
import shlex
import subprocess
import sys
import tempfile
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]


def wait_silently(patch=setattr) -> None:
    """Keep commands from printing what they wait for, which would depend on the speed of the machine."""
    from haptic_loop.cli import render

    patch(render, "_SILENCE", 1e6)


def load() -> None:
    """Import all modules, so that no fork has to."""
    import matplotlib as mpl

    mpl.use("Agg")
    for name in ("matplotlib.pyplot", "clarabel", "numpy.fft", "numpy.random", "scipy.linalg", "scipy.optimize"):
        import_module(name)
    for folder in ("cli", "controller", "design", "hw", "models", "sim"):
        package = import_module(f"haptic_loop.{folder}")
        for module in pkgutil.iter_modules(package.__path__):
            import_module(f"haptic_loop.{folder}.{module.name}")
    wait_silently()


def share_designs(folder: Path, patch=setattr) -> None:
    """Cache slow results for all tests and processes. Only the listed modules get the functions with a cache."""
    import haptic_loop.cli.check
    import haptic_loop.cli.design
    from haptic_loop.design import api, assessment, bound, designs
    from haptic_loop.hw import control
    from haptic_loop.sim import couplings

    for function, modules in (
        (designs.design_by_kind, (haptic_loop.cli.design, api, couplings)),
        (bound.bound, (bound,)),
        (assessment.required_damping, (assessment, control)),
        (assessment.prove, (assessment,)),
        (assessment.requirements_of, (assessment,)),
        (assessment.search_ranges, (assessment, haptic_loop.cli.check)),
        (assessment.in_each, (assessment,)),
        (api.instead, (api,)),
    ):
        for module in modules:
            patch(module, function.__name__, _cached(folder, function))


def draw_once(folder: Path) -> None:
    """Draw only the first picture of each command and file name, then empty ones, because drawing is slow."""
    from matplotlib.figure import Figure

    from haptic_loop.sim import plots

    save = plots.save

    def drawn(figure: Figure, path: Path, dpi: int = 130) -> Path:
        try:
            (folder / f"{Path(sys.argv[0]).name}-{Path(path).name}").touch(exist_ok=False)
            figure.set_layout_engine("none")  # tests/sim/test_plots.py draws with the layout.
        except FileExistsError:
            figure = Figure()
        return save(figure, path, dpi)

    plots.save = drawn


def _cached(folder: Path, make):
    """Return `make` with a cache of its results in the folder."""
    from haptic_loop.design import budgets
    from haptic_loop.design.coupling_file import digest

    @functools.wraps(make)
    def cached(loop, *arguments, **options):
        try:
            key = digest(loop), make.__name__, budgets.GROWTH, _arguments(make, loop, *arguments, **options)
        except TypeError:  # Objects that a test defines have no digest.
            return make(loop, *arguments, **options)
        file = folder / hashlib.sha256(repr(key).encode()).hexdigest()
        with file.with_suffix(".lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)  # Other processes wait for the result.
            if not file.exists():
                result = make(loop, *arguments, **options)
                part = file.with_suffix(".part")
                part.write_bytes(pickle.dumps(result))
                part.rename(file)
        return pickle.loads(file.read_bytes())

    return cached


def _arguments(make, loop, *arguments, **options) -> list[tuple[str, str]]:
    """Return (name, text) of each argument except loop and functions; equal calls give equal texts."""
    from haptic_loop.design.conditions import Condition
    from haptic_loop.design.designs import usual_condition
    from haptic_loop.design.program import DEFAULT

    call = inspect.signature(make).bind(loop, *arguments, **options)
    call.apply_defaults()
    words = {name: x for name, x in call.arguments.items() if name != "loop" and not callable(x)}
    if any(isinstance(x, Condition) and not type(x).__module__.startswith("haptic_loop.") for x in words.values()):
        raise TypeError("a condition that a user defines")
    if make.__name__ == "design_by_kind":
        if ":" in words["kind"]:
            raise TypeError("a design that a user defines")
        words["condition"] = words["condition"] or usual_condition(loop, words["kind"])
        words |= (vars(DEFAULT) if words["kind"] == "optimal" else {}) | words.pop("options")
    return sorted((name, _text(x)) for name, x in words.items())


def _text(x: Any) -> str:
    """Return equal texts for equal arguments. Raises TypeError for an object without a value."""
    from haptic_loop.design.conditions import Condition
    from haptic_loop.design.coupling_file import digest

    if hasattr(x, "form"):
        return digest(x.form())
    if isinstance(x, Condition):
        return f"{type(x).__qualname__}({sorted((name, _text(part)) for name, part in vars(x).items())})"
    if " at 0x" in repr(x):
        raise TypeError(f"{type(x).__name__} has no value")
    return repr(x)


@functools.cache
def _warm() -> subprocess.Popen[str]:
    """Return the process that forks."""
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    words = [sys.executable, str(Path(__file__)), os.environ.get("SHARED_DESIGNS", "")]
    warm = subprocess.Popen(words, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    atexit.register(lambda: (warm.stdin.close(), warm.wait()))
    return warm


def run(command: str | list[str], folder: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run `python -m MODULE ...` or `python FILE ...`, for a width of 100 columns."""
    words = shlex.split(command, comments=True) if isinstance(command, str) else [str(word) for word in command]
    with tempfile.TemporaryDirectory() as place:
        files = [Path(place, name) for name in ("out", "err")]
        code = _request_fork(words[1:], folder, files, {"COLUMNS": "100"} | environment)
        return subprocess.CompletedProcess(words, code, *(file.read_text(encoding="utf-8") for file in files))


def begin(module: str, *options: str, out: Path, err: Path) -> int:
    """Begin `python -m MODULE ...` in a new session, with its output in `out` and `err`; return the process id."""
    return _request_fork(["-m", module, f"--parent={_warm().pid}", *options], ROOT, [out, err], {}, beside=True)


def _request_fork(words: list[str], folder: Path, files: list[Path], environment: dict[str, str], beside=False) -> int:
    """Return the exit code of the command or, with `beside`, the process id of a command that runs on."""
    request = {"words": words, "folder": str(folder), "files": [str(file) for file in files]}
    request |= {"environment": environment, "beside": beside}
    print(json.dumps(request), file=_warm().stdin, flush=True)
    return int(_warm().stdout.readline())


def _command(words: list[str]) -> None:
    """Run the command or the file in the child. A command raises SystemExit."""
    from haptic_loop.cli.main import COMMANDS, run_command

    if words[0] != "-m":
        sys.argv = words
        runpy.run_path(str(ROOT / words[0]), run_name="__main__")
        return
    sys.argv = words[1:]
    if command := {module: command for command, (module, _) in COMMANDS.items()}.get(words[1]):
        run_command(command)
    runpy.run_module(words[1], run_name="__main__")


def _child(request: dict) -> None:
    code = 99
    try:
        if request["beside"]:
            os.setsid()  # Ctrl-C does not reach a new session.
        os.chdir(request["folder"])
        os.environ.update(request["environment"])
        os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
        for number, name in enumerate(request["files"], start=1):
            os.dup2(os.open(name, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), number)
            stream = os.fdopen(number, "w", encoding="utf-8", closefd=False)
            setattr(sys, ("stdout", "stderr")[number - 1], stream)
        _command(request["words"])
        code = 0
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else int(end.code is not None)
        if isinstance(end.code, str):
            print(end.code, file=sys.stderr)
    except BaseException:
        import traceback

        traceback.print_exc()
        code = 1
    finally:
        for stream in (sys.stdout, sys.stderr):
            with suppress(Exception):
                stream.flush()
        os._exit(code)


def _serve() -> None:
    load()
    if sys.argv[1]:
        share_designs(Path(sys.argv[1]))
        draw_once(Path(sys.argv[1]))
    gc.freeze()  # Otherwise a garbage collection in a fork would copy the memory of all modules.
    for line in sys.stdin:
        request = json.loads(line)
        if (child := os.fork()) == 0:
            _child(request)
        print(child if request["beside"] else os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)


if __name__ == "__main__":
    _serve()
