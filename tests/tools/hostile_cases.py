"""For hostile.py: the class of a case, the good files in its folder, functions that spoil them, and bad streams."""

from __future__ import annotations

import io
import json
import os
import re
import resource
import shlex
import sys
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np

from haptic_loop.cli import options
from haptic_loop.controller.coupling import SpringDamper
from haptic_loop.design.certificate import prove
from haptic_loop.design.coupling_file import Stored, save
from haptic_loop.sim.scenario import SCENARIOS, load

BUT = 2  # exit code of bad input
SHORT = "--short" in sys.argv


def pairs(left: Iterable, right: Iterable, every: int = 2) -> Iterator[tuple]:
    """Yield all pairs. A short run yields one in `every`, evenly, so that each entry of both sides still occurs."""
    for (i, one), (j, other) in product(enumerate(left), enumerate(right)):
        if not SHORT or (i + j) % every == 0:
            yield one, other


@dataclass(frozen=True)
class Case:
    """A command line, what is done before the command, and how the command should end."""

    name: str
    words: tuple[str, ...]
    codes: tuple[int, ...] = (BUT,)
    says: str = ""  # a regular expression that matches standard error
    before: Callable[[], object] | None = None  # runs in the child, in the case's folder


QUICK = {  # a command's required arguments, and options that keep it short
    "run": ("--no-plot", "--duration", "0.1"),
    "validate": ("--humans", "2", "--duration", "0", "--no-plot"),
    "zwidth": ("--grid", "4", "--points", "0", "--humans", "2", "--no-plot"),
    "view": ("--video", "v.gif"),
    "trace": ("t.npz",),
    "accuracy": (),
    "design": (),
    "audit": ("--K", "400,300", "--B", ".1,.1"),
    "check": ("c.json",),
    "compare": (),
    "export": ("c.json",),
    "bridge": ("--rehearse", "--duration", "0.2"),
    "identify": ("--rehearse",),
    "replay": ("t.npz",),
}

TEXT = (SCENARIOS / "omega-pair.toml").read_text()


def quick(command: str, *more: str) -> tuple[str, ...]:
    """Return a command line with the command's QUICK words."""
    return (command, *QUICK[command], *more)


def entries(table: str) -> list[str]:
    """Return the entries of a text, which are separated by ` | ` or by line ends."""
    return re.split(r" \| |\n *", table)


def furnish(folder: Path) -> None:
    """Write a good file of each kind, a pipe, a folder, and links."""
    scenario = load()
    loop, data = scenario.loop("I"), SpringDamper((400.0, 300.0), (0.1, 0.1))
    (folder / "s.toml").write_text(TEXT)
    save(Stored.of(loop, data, prove(loop, data, "any-environment")), folder / "c.json")
    link = "[[human]]\nlinks = [{ mass = 0.3, damping = 3.0, stiffness = 200.0 }]\n"
    (folder / "h.toml").write_text(2 * link)
    (folder / "p.txt").write_text("1,2\n1,2\n")
    npz(folder / "t.npz")
    os.mkfifo(folder / "fifo")
    (folder / "dir").mkdir()
    (folder / "dir" / "report.json").write_text("{}")
    (folder / "loop").symlink_to("loop")
    (folder / "to-s").symlink_to("s.toml")


def npz(path, **changed):
    """Write a trace of two channels with some arrays replaced, or left out if None."""
    n, t = 400, 1.2e-3 * np.arange(400)
    x = 1e-3 * np.sin(2 * np.pi * 60 * t)[:, None] * [1.0, 0.5]
    arrays = {"t": t, "x": x, "f": 100 * x, "x_handle": x, "v_handle": x, "w": np.zeros((n, 0))} | changed
    arrays.setdefault("meta", np.array("{}"))
    with Path(path).open("wb") as file:
        np.savez_compressed(file, **{name: value for name, value in arrays.items() if value is not None})


def toml(old: str, new: str) -> Callable[[], None]:
    """Return a function that replaces a text in s.toml."""
    assert old in TEXT, old
    return lambda: put("s.toml", TEXT.replace(old, new, 1)) and None


def stored(path: str, value: object) -> Callable[[], None]:
    """Return a function that replaces one entry of c.json; dots join the names and numbers of its path."""

    def change() -> None:
        whole = json.loads(Path("c.json").read_text())
        *way, last = [int(word) if word.isdecimal() else word for word in path.split(".")]
        part = whole
        for step in way:
            part = part[step]
        part[last] = value
        Path("c.json").write_text(json.dumps(whole))

    return change


def put(name: str, content: str | bytes) -> int:
    return Path(name).write_bytes(content.encode() if isinstance(content, str) else content)


def written(name: str, content: str | bytes) -> Callable[[], int]:
    return lambda: put(name, content)


RIGID = tuple(shlex.split("audit --rigid --K 1000 --B 0 --T 1e-3 --theta 0 --delta 1.37"))
STREAMS = {"stdin": (0,), "stdout": (1,), "stderr": (2,), "all streams": (0, 1, 2)}
LEAST = [RIGID, ("check", "c.json"), ("trace", "t.npz"), ("export", "c.json")]  # the quickest commands


def streams() -> Iterator[Case]:
    """Yield cases with closed, full or ASCII standard streams, with little memory, and with a wrong backend."""

    def closed(*numbers: int) -> Callable[[], None]:
        def change() -> None:
            for number in numbers:
                os.close(number)
                setattr(sys, ("stdin", "stdout", "stderr")[number], None)

        return change

    def ascii_only() -> None:
        sys.stdout = io.TextIOWrapper(os.fdopen(1, "wb", closefd=False), encoding="ascii", write_through=True)

    def full() -> None:
        os.dup2(os.open("/dev/full", os.O_WRONLY), 1)

    def little() -> None:
        now = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
        resource.setrlimit(resource.RLIMIT_AS, (now + 100_000_000,) * 2)

    kinds = [
        *((f": {name} closed", (), (0, 1), "", closed(*numbers)) for name, numbers in STREAMS.items()),
        (" --json -: stdout closed", ("--json", "-"), (0, 1), "", closed(1)),
        (": ASCII stdout", (), (0, 1), "", ascii_only),
        (": stdout full", (), (BUT,), "No space left", full),
        (" --json -: stdout full", ("--json", "-"), (BUT,), "No space left", full),
    ]
    for words, (name, more, codes, says, before) in pairs(LEAST, kinds):
        yield Case(words[0] + name, (*words, *more), codes, says, before)
    yield Case("bad input, stderr closed", ("audit", "--scenario", "n\udcff"), before=closed(2))
    huge = lambda: (npz("t.npz", x=np.zeros((10_000_000, 1)), t=np.zeros(3)), little())  # noqa: E731
    yield Case("trace: little memory", ("trace", "t.npz"), (3,), "memory", before=huge)

    def backend() -> None:
        os.environ["MPLBACKEND"] = "nonsense"
        script = f"import sys; sys.path.insert(0, {str(Path(options.__file__).parents[1])!r}); "
        script += "from haptic_loop.cli.main import run_command; run_command('trace')"
        os.execv(sys.executable, [sys.executable, "-c", script, "t.npz", "--plot", "a.png"])

    yield Case("MPLBACKEND=nonsense", ("trace",), (0,), before=backend)
