"""Run the commands with every kind of bad input that we know of, in forks of one process.

    python tests/tools/hostile.py [WORD]     run the cases whose name contains WORD; exit code 0 if all end well
    python tests/tools/hostile.py --short    run one in two or three pairs of a command (or field) and a value
    python tests/tools/hostile.py --signals  send Ctrl-C or SIGTERM at random moments of a run instead

A case is answered well if the command ends in time with the expected code, leaves every earlier file unchanged, and
leaves no half-written file. With code 2 or 3 it must print one line on standard error, without control characters. A
traceback is never an answer.
"""

import gc
import hashlib
import io
import json
import os
import re
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Iterator
from contextlib import redirect_stderr, redirect_stdout, suppress
from importlib import import_module
from pathlib import Path

import hostile_files
import hostile_words
import numpy as np
from hostile_cases import BUT, LEAST, SHORT, Case, furnish, put, streams
from matplotlib.figure import Figure

from haptic_loop.cli.execute import execute
from haptic_loop.sim import plots

SECONDS = 20  # CPU seconds that a case may take
STEERS = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e\ud800-\udfff]")  # characters that control a terminal
TOGETHER = 100  # cases per process: starting a process costs more than most cases
MOMENTS = 30  # number of moments at which Ctrl-C is sent


def answered(cases: list[Case], folder: Path, model: Path) -> Iterator[tuple[str, list[str]]]:
    """Yield each case's name and what is wrong with its end. If a case ends its process, a new one runs the rest."""
    good = contents(model)
    while cases:
        places = [Path(tempfile.mkdtemp(dir=folder)) for _ in cases]
        if (child := os.fork()) == 0:
            try:
                for case, place in zip(cases, places, strict=True):
                    furnished(model, place / "files")
                    run(case, place)
            finally:
                os._exit(0)
        last = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        ended = [place for place in places if (place / "code").exists()]
        for case, place in zip(cases, places[: len(ended) + 1], strict=False):
            yield case.name, judged(case, place, int((place / "code").read_text()) if place in ended else last, good)
        for place in places:
            shutil.rmtree(place)
        cases = cases[len(ended) + 1 :]


def furnished(model: Path, place: Path) -> Path:
    """Copy the model's files and its pipe to a new folder, and return this folder."""
    shutil.copytree(model, place, symlinks=True, ignore=shutil.ignore_patterns("fifo"), copy_function=shutil.copyfile)
    os.mkfifo(place / "fifo")
    return place


def judged(case: Case, place: Path, code: int, good: dict[str, str]) -> list[str]:
    """Return what is wrong with a case that has ended: its exit code, its message, or changed files."""
    err, files = (place / "err").read_text(errors="surrogateescape"), place / "files"
    present = contents(files)
    expected = good | (json.loads((place / "changed").read_text()) if (place / "changed").exists() else {})
    closed, wrong = "stderr closed" in case.name or "all streams closed" in case.name, []
    if code not in case.codes:
        wrong.append(f"code {code}, expected {case.codes}: {err[-300:]!r}")
    if any(word in err for word in ("Traceback", "Warning", "Exception ignored")):
        wrong.append(f"traceback or warning: {err[-400:]!r}")
    one_line = err.count("\n") == 1 and not STEERS.search(err[:-1]) and len(err) <= 1200
    if code in (2, 3) and not (closed or one_line or "--json -: stdout full" in case.name):
        wrong.append(f"not one plain line on standard error: {err[:300]!r}")
    if code == BUT and code in case.codes and not (closed or re.search(case.says, err)):
        wrong.append(f"standard error lacks {case.says!r}: {err[:300]!r}")
    wrong += [f"{name} was changed" for name, digest in expected.items() if present.get(name) != digest]
    return wrong + left(files)


def contents(folder: Path) -> dict[str, str]:
    """Return path -> a link's target, a file's hash, or whether the path is a folder."""

    def content(path: Path) -> str:
        if path.is_symlink():
            return os.readlink(path)
        return hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else str(path.is_dir())

    return {str(path.relative_to(folder)): content(path) for path in folder.rglob("*")}


def left(folder: Path) -> list[str]:
    """Return a line for each half-written file."""
    return [f"half-written file {path.name} is left" for path in folder.rglob(".*.*")]


def run(case: Case, place: Path) -> int:
    """Run a case in the child with its own streams and files, and return its exit code."""
    code, files, surroundings = 99, place / "files", dict(os.environ)
    try:
        os.chdir(files)
        for number, name in ((1, "out"), (2, "err")):
            os.dup2(handle := os.open(place / name, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), number)
            os.close(handle)
            stream = os.fdopen(number, "w", encoding="utf-8", buffering=1, closefd=False)
            setattr(sys, ("stdout", "stderr")[number - 1], stream)
        os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
        os.environ["COLUMNS"] = "100"
        used = resource.getrusage(resource.RUSAGE_SELF)
        resource.setrlimit(resource.RLIMIT_CPU, (int(used.ru_utime + used.ru_stime) + SECONDS, resource.RLIM_INFINITY))
        sys.setrecursionlimit(1000)
        warnings.simplefilter("default", append=True)  # show a warning again in each case
        if case.before:
            old = contents(files)
            case.before()
            put(place / "changed", json.dumps(dict(contents(files).items() - old.items())))
        command, *words = case.words
        execute(lambda argv: put(place / "begun", "") or import_module(f"haptic_loop.cli.{command}").main(argv), words)
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else 0
    except BaseException:
        with suppress(Exception):
            traceback.print_exc()
    finally:
        for stream in (sys.stdout, sys.stderr):
            with suppress(Exception):
                stream.flush()
        os.environ.clear()
        os.environ.update(surroundings)
        put(place / "code", str(code))
    return code


def signalled(folder: Path, model: Path) -> Iterator[tuple[str, list[str]]]:
    """Yield what is wrong with the end of a run after Ctrl-C at MOMENTS moments, and after SIGTERM at half as many."""
    words = ("run", "--duration", "2", "--out", "new")
    rng, whole, missed, code = np.random.default_rng(7), 0.0, 0, 99
    ends = {0: (0, ("",)), signal.SIGINT: (130, ("", "interrupted\n")), signal.SIGTERM: (143, ("terminated\n",))}
    signals = [0, *MOMENTS * [signal.SIGINT], *(MOMENTS // 2) * [signal.SIGTERM]]  # 0: measure the duration
    for number, sent in enumerate(signals):
        place = furnished(model, folder / f"signal-{number}" / "files").parent
        if (child := os.fork()) == 0:
            signal.signal(signal.SIGINT, signal.default_int_handler)
            try:
                code = run(Case("signals", words), place)
            finally:
                os._exit(code)
        while not (place / "begun").exists():
            time.sleep(1e-3)
        begin, moment = time.perf_counter(), rng.uniform(0, 0.9) * whole
        if sent:
            time.sleep(moment)
            os.kill(child, sent)
        code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        whole = whole or time.perf_counter() - begin
        err, (right, lines) = (place / "err").read_text(), ends[sent]
        late = sent and code == 0 and (place / "files" / "new" / "report.json").exists()
        missed += bool(late)
        wrong = [] if late or (code == right and err in lines) else [f"code {code}, {err[-400:]!r}"]
        wrong += ["the signal came after the end for the tenth time"] if missed == 10 else []
        yield f"signal {sent} after {moment:.3f} of {whole:.2f} s", wrong + left(place)


def chosen(word: str, folder: Path, model: Path) -> Iterator[tuple[str, list[str]]]:
    """Yield the names of the cases that contain the word, and what is wrong with the end of each case."""
    cases = [case for part in (hostile_words, hostile_files) for case in part.cases() if word in case.name]
    groups = [cases[first : first + TOGETHER] for first in range(0, len(cases), TOGETHER)]
    # The cases of `streams` change the streams or the memory of their process, so each has its own process.
    for group in [*groups, *([case] for case in streams() if word in case.name)]:
        yield from answered(group, folder, model)


def warm(model: Path) -> None:
    """Run good commands once, so that no case loads, compiles or caches what they need; draw pictures coarsely."""
    save = plots.save

    def coarse(figure: Figure, path: Path, dpi: int = 20) -> Path:
        figure.set_layout_engine("none")
        return save(figure, path, dpi)

    plots.save = coarse
    before = Path.cwd()
    with tempfile.TemporaryDirectory() as folder, redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
        os.chdir(furnished(model, Path(folder, "files")))
        for command, *words in [*LEAST, ("trace", "t.npz", "--plot", "a.png")]:
            import_module(f"haptic_loop.cli.{command}").main(words)
        os.chdir(before)


def main() -> int:
    word = sys.argv[1] if len(sys.argv) > 1 and not SHORT else ""
    sys.path.append(str(Path(__file__).parents[1]))
    forked = import_module("forked")
    forked.load()
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    if shared := os.environ.get("SHARED_DESIGNS"):
        forked.share_designs(Path(shared))
    begin = time.perf_counter()
    memory = "/dev/shm" if os.access("/dev/shm", os.W_OK) else None
    with tempfile.TemporaryDirectory(dir=memory) as folder:
        model = Path(folder) / "model"
        model.mkdir()
        furnish(model)
        warm(model)
        gc.freeze()  # Otherwise a garbage collection in a fork would copy the memory of all modules.
        ends = signalled(Path(folder), model) if word == "--signals" else chosen(word, Path(folder), model)
        count = bad = 0
        for count, (name, wrong) in enumerate(ends, start=1):  # noqa: B007
            bad += bool(wrong)
            print(*(f"{name}: {line}\n" for line in wrong), sep="", end="", flush=True)
    print(f"{count} cases, {bad} answered badly, {time.perf_counter() - begin:.0f} s")
    return int(bad > 0)


if __name__ == "__main__":
    sys.exit(main())
