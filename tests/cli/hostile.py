"""Every way of bad input that we know of, through the commands as a user runs them: one process, forked for each case.

    python tests/cli/hostile.py [WORD]     the cases whose name holds WORD; 0: none is answered badly
    python tests/cli/hostile.py --signals  Ctrl-C and SIGTERM at random moments of a run in their place

A case is answered well where the command ends in time with the expected code and, unless it succeeded, one line on
standard error in which no character steers the terminal; where every file that was there is as it was; where no half
file is left. A traceback is never an answer.
"""

import io
import json
import os
import re
import resource
import shlex
import shutil
import signal
import sys
import tempfile
import time
import zipfile
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from importlib import import_module
from itertools import product
from pathlib import Path

import matplotlib.figure  # noqa: F401 - once, before the forks
import numpy as np
from combined import combined

from cli import options
from cli.main import COMMANDS
from controller.coupling import SpringDamper
from design.certificate import prove
from design.coupling_file import Stored, save
from sim.scenario import SCENARIOS, load

SECONDS = 20  # of processor time that a case may take
BUT = 2  # exit code of bad input


@dataclass(frozen=True)
class Case:
    """A command line, what is done before it, and how it should end."""

    name: str
    words: tuple[str, ...]
    codes: tuple[int, ...] = (BUT,)
    says: str = ""  # a regular expression that standard error holds
    before: Callable[[], object] | None = None  # in the child, within the case's folder


# ----------------------------------------------------------------------------------------------------
# The files that cases find, and how they are spoilt.


TEXT = (SCENARIOS / "omega-pair.toml").read_text()


def furnish(folder: Path) -> None:
    """A good file of each kind, and things that are no files."""
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
    """A trace of two channels, some of its arrays replaced or (None) left out."""
    n, t = 400, 1.2e-3 * np.arange(400)
    x = 1e-3 * np.sin(2 * np.pi * 60 * t)[:, None] * [1.0, 0.5]
    arrays = {"t": t, "x": x, "f": 100 * x, "x_handle": x, "v_handle": x, "w": np.zeros((n, 0))} | changed
    arrays.setdefault("meta", np.array("{}"))
    with Path(path).open("wb") as file:
        np.savez_compressed(file, **{name: value for name, value in arrays.items() if value is not None})


def toml(old: str, new: str) -> Callable[[], None]:
    """s.toml with some text replaced."""
    assert old in TEXT, old
    return lambda: put("s.toml", TEXT.replace(old, new, 1)) and None


def stored(path: str, value: object) -> Callable[[], None]:
    """c.json with one entry replaced; the path of names and numbers is joined by dots."""

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


# ----------------------------------------------------------------------------------------------------
# The cases.


def cases() -> Iterator[Case]:
    """All of them."""
    yield from numeric_options()
    yield from odd_paths()
    yield from overwritten()
    yield from scenarios()
    yield from humans_and_delays()
    yield from couplings()
    yield from traces()
    yield from streams()
    yield from silence()
    yield from names_in_pictures()
    for command, words, codes, people in combined():
        quick = QUICK[command] if command != "audit" else ()
        yield Case(f"{command} {words}", (command, *quick, *shlex.split(words)), codes, before=written("h.py", people))


QUICK = {  # what a command needs beside the option in question
    "run": ("--no-plot", "--no-alternatives", "--duration", "0.1"),
    "validate": ("--humans", "2", "--duration", "0", "--no-plot"),
    "zwidth": ("--grid", "4", "--points", "0", "--humans", "2", "--no-plot"),
    "view": ("--video", "v.gif"),
    "trace": ("t.npz",),
    "accuracy": (),
    "suite": ("--only", "I"),
    "design": (),
    "audit": ("--K", "400,300", "--B", ".1,.1"),
    "check": ("c.json",),
    "compare": (),
    "export": ("c.json",),
    "bridge": ("--rehearse", "--duration", "0.2"),
    "emulator": ("--duration", "0.01"),
    "identify": ("--rehearse",),
    "replay": ("t.npz",),
}

NO_NUMBERS = ("x", "", "nan", "1,,2", "\x1b[31m1", "9" * 5000, "-1e999")

NUMERIC = {
    "run": "theta psi lam delta T T-max latency loss varying-delay energy-budget substeps duration vertex seed",
    "validate": "humans shards generations duration seed theta",
    "zwidth": "grid K-range B-range mark humans points trials duration start press threshold quantisation friction",
    "view": "fps duration",
    "accuracy": "duration",
    "suite": "humans",
    "design": "ranges samples band high-gain seconds order varying-delay delta",
    "audit": "K B varying-delay",
    "compare": "points band seconds",
    "export": "seed",
    "bridge": "pace quantile guard measure force-cap max-speed continuous-force thermal-time duration seed baud",
    "emulator": "duration coulomb pace parent seed",
    "identify": "force band seconds coulomb sittings hand",
}


def numeric_options() -> Iterator[Case]:
    """Words that are no numbers, or no numbers within any limits."""
    for command, names in NUMERIC.items():
        for i, name in enumerate(names.split()):
            chosen = NO_NUMBERS if command in ("run", "bridge") else [NO_NUMBERS[(i + k) % 7] for k in (0, 2, 4)]
            for word in chosen:
                words = (command, *QUICK[command], f"--{name}={word}")
                yield Case(f"{command} --{name}={word[:8]!r}", words, says=name.split("-")[0])


INPUTS = (
    ("run", "--scenario"),
    ("run", "--human"),
    ("run", "--pattern"),
    ("audit", "--scenario"),
    ("check", ""),
    ("export", ""),
    ("trace", ""),
    ("replay", ""),
    ("view", "--coupling"),
)
NO_FILES = {
    "missing": "nix",
    "folder": "dir",
    "pipe": "fifo",
    "endless": "/dev/zero",
    "terminal": "/dev/tty",
    "circle": "loop",
    "long": "n" * 300,
    "very long": "n/" * 3000,
    "control": "n\x1b]0;x\x07\r\n",
    "right to left": "n\u202eabc",
    "no UTF-8": "n\udcff",
    "below a file": "s.toml/x",
    "empty": "",
}
SUFFIX = {"": ".json", "--coupling": ".json", "--human": ".toml"}


def odd_paths() -> Iterator[Case]:
    """What cannot be read, and what cannot be written."""
    for (command, option), (kind, path) in product(INPUTS, NO_FILES.items()):
        rest = tuple(word for word in QUICK[command] if option or not word.startswith(("c.json", "t.npz")))
        if option == "--coupling" and not path.startswith(("/", "dir", "fifo", "loop", "s.toml")):
            path += ".json"
        words = (command, *rest, *((f"{option}={path}",) if option else ("--", path)))
        if option:
            yield Case(f"{command} {option} {kind}", words, says=option.lstrip("-") if option != "--coupling" else "")
        else:
            yield Case(f"{command} {kind}", (command, *(w for w in words[1:] if w != "--"), "--json=r.json")
                       if path and not path.startswith("-") else words)  # fmt: skip
    outputs = [("run", "--out"), ("run", "--json"), ("design", "--out"), ("export", "--out"), ("trace", "--plot"),
               ("audit", "--json"), ("view", "--video"), ("bridge", "--out"), ("suite", "--out")]  # fmt: skip
    for command, option in outputs:
        for kind in ("below a file", "very long", "long", "circle", "folder", "no folder", "kernel", "zero"):
            path = {"no folder": "nix/r", "kernel": "/proc/self/r", "zero": "r\0"} | NO_FILES
            if kind == "no folder" and (command, option) in {("run", "--out"), ("bridge", "--out"), ("suite", "--out")}:
                continue  # a folder is made
            if kind == "folder" and option == "--out" and command in ("run", "bridge", "suite"):
                continue
            suffix = ".gif" if option == "--video" and kind not in ("folder", "circle") else ""
            words = (
                command,
                *(w for w in QUICK[command] if w not in ("--video", "v.gif")),
                option,
                path[kind] + suffix,
            )
            yield Case(f"{command} {option} {kind}", words, says=option)


def overwritten() -> Iterator[Case]:
    """Outputs that are inputs, or each other, by whatever name."""
    both = [
        ("design", "--scenario", "s.toml", "--out", "s.toml"),
        ("design", "--scenario", "to-s", "--out", "s.toml"),
        ("design", "--scenario", "s.toml", "--out", "to-s"),
        ("design", "--scenario", "s.toml", "--out", "./dir/../s.toml"),
        ("design", "--scenario", "s.toml", "--json", "s.toml"),
        ("design", "--out", "a.json", "--json", "a.json"),
        ("design", "--out", "a.json", "--json", "./a.json"),
        ("replay", "t.npz", "--json", "t.npz"),
        ("trace", "t.npz", "--json", "t.npz"),
        ("trace", "t.npz", "--plot", "t.npz"),
        ("trace", "t.npz", "--plot", "a.png", "--json", "a.png"),
        ("check", "c.json", "--json", "c.json"),
        ("export", "c.json", "--json", "c.json"),
        ("export", "c.json", "--out", "c.json"),
        ("export", "c.json", "--out", "a.c", "--json", "a.c"),
        ("audit", "--coupling", "c.json", "--json", "c.json"),
        ("audit", "--K", "400", "--B", "1", "--scenario", "s.toml", "--json", "s.toml"),
        ("run", *QUICK["run"], "--scenario", "s.toml", "--json", "s.toml"),
        ("run", *QUICK["run"], "--human", "h.toml", "--json", "h.toml"),
        ("run", *QUICK["run"], "--pattern", "p.txt", "--json", "p.txt"),
        ("run", *QUICK["run"], "--coupling", "c.json", "--json", "c.json"),
        ("validate", *QUICK["validate"], "--scenario", "s.toml", "--json", "s.toml"),
        ("validate", *QUICK["validate"], "--coupling", "c.json", "--json", "c.json"),
        ("zwidth", *QUICK["zwidth"], "--scenario", "s.toml", "--json", "s.toml"),
        ("zwidth", *QUICK["zwidth"], "--coupling", "c.json", "--json", "c.json"),
        ("compare", "--coupling", "none,c.json", "--json", "c.json"),
        ("compare", "--scenario", "s.toml", "--json", "s.toml"),
        ("view", "--video", "a.gif", "--json", "a.gif", "--duration", "0.2"),
        ("bridge", "--rehearse", "--scenario", "s.toml", "--json", "s.toml"),
        ("identify", "--rehearse", "--scenario", "s.toml", "--json", "s.toml"),
    ]
    for words in both:
        yield Case(" ".join(words), words, says="also|read")

    def report_is_a_scenario() -> None:
        put("dir/report.json", TEXT)

    words = ("run", *QUICK["run"], "--scenario", "dir/report.json", "--out", "dir")
    yield Case("a report over its scenario", words, says="read", before=report_is_a_scenario)
    words = ("run", *QUICK["run"], "--out", "new", "--json", "new/trace.npz")
    yield Case("json over the trace", words, says="twice", before=lambda: os.mkdir("new"))
    hard = ("design", "--scenario", "s.toml", "--json", "hard")
    yield Case("a second name of the scenario", hard, says="also", before=lambda: os.link("s.toml", "hard"))


def scenarios() -> Iterator[Case]:
    """Texts that are no scenario, or one that cannot be."""
    texts = {
        "nested": "a = " + 900 * "[" + 900 * "]",
        "deeply nested": "a = " + 100_000 * "[",
        "tables in tables": "a = " + 900 * "{a = " + "1" + 900 * "}",
        "a long integer": TEXT.replace("theta = [1, 2]", f"theta = [1, {5000 * '9'}]"),
        "dotted": "a" + 100_000 * ".a" + " = 1",
        "dotted and quoted": '"a"' + 50_000 * '."a"' + " = 1",
        "dotted table": "[a" + 30_000 * ".a" + "]",
        "binary": b"\xff\xfe\x00",
        "a zero byte": TEXT.replace("omega", "om\0ega", 1),
        "empty": "",
        "only a comment": "# x",
        "too long": "# " + 3_000_000 * "x",
        "a byte order mark": "\ufeff" + TEXT,
        "a date": TEXT.replace("T = 1.2e-3", "T = 2026-01-01"),
        "an infinite period": TEXT.replace("T = 1.2e-3", "T = inf"),
        "twice": TEXT + "\n[environment]\n",
        "cut": TEXT[: len(TEXT) // 2],
        "no devices": TEXT.replace("[[device]]", "[[devise]]"),
        "a key that steers": TEXT + '\n["\\u001b[31m"]\nx = 1\n',
        "a name that steers": TEXT.replace('"omega-pair"', '"\\u001b]0;x\\u0007"').replace("T = 1.2e-3", "T = 9"),
        "a name without end": TEXT.replace('"omega-pair"', f'"{1000 * "n"}"'),
        "a huge name": TEXT.replace('"omega-pair"', f'"{1_000_000 * "n"}"').replace("T = 1.2e-3", "T = 9"),
    }
    for name, text in texts.items():
        yield Case(f"scenario: {name}", ("run", *QUICK["run"], "--scenario", "s.toml"), before=written("s.toml", text))
    numbers = ("1e300", "1e999", "-1.0", "nan", "-inf", '"x"', "[]", "true")
    fields = [
        ("stiffness = 800.0", "stiffness = "),
        ("damping = 1.0 },", "damping = "),
        ("masses = { mass = 1.0 }", "masses = { mass = "),
        ("motor_mass = 0.06", "motor_mass = "),
        ("handle_mass = 0.19", "handle_mass = "),
        ("transmission_stiffness = 14500", "transmission_stiffness = "),
        ("force_limit = 12.0", "force_limit = "),
        ("duration = 15.0", "duration = "),
        ("mass = 0.3", "mass = "),
        ("stiffness = 200.0", "stiffness = "),
        ("amplitude = 0.015", "amplitude = "),
        ("frequency = 0.6", "frequency = "),
        ("ease = 1.0", "ease = "),
        ("force = 1.0", "force = "),
        ("start = 0.1", "start = "),
        ("theta = [1, 2]", "theta = [1, "),
        ("psi = [0, 0]", "psi = [0, "),
        ("channel = 1", "channel = "),
    ]
    closing = {"theta = [1, ": "]", "psi = [0, ": "]", "masses = { mass = ": " }", "damping = ": " },"}
    for (old, new), number in product(fields, numbers):
        if (old, number) == ("force = 1.0", "-1.0"):
            continue  # a pull
        field = old.split(" ")[0].removesuffix("es")
        text = f"{new}{number}{closing.get(new, '')}"
        words = ("audit", *QUICK["audit"], "--scenario", "s.toml")
        yield Case(f"scenario: {old} -> {number}", words, says=field, before=toml(old, text))
    springs = {
        "to itself": ('["contact 1", "mass"]', '["mass", "mass"]'),
        "one end": ('["contact 1", "mass"]', '["contact 1"]'),
        "three ends": ('["contact 1", "mass"]', '["contact 1", "mass", "ground"]'),
        "no name": ('["contact 1", "mass"]', '["", "mass"]'),
        "one contact twice": ('contacts = ["contact 1", "contact 2"]', 'contacts = ["contact 1", "contact 1"]'),
        "no contacts": ('contacts = ["contact 1", "contact 2"]', "contacts = []"),
        "a contact that is ground": ('contacts = ["contact 1", "contact 2"]', 'contacts = ["ground", "contact 2"]'),
        "mass of the ground": ("masses = { mass = 1.0 }", "masses = { ground = 1.0 }"),
        "mass of nothing": ("masses = { mass = 1.0 }", "masses = { mass = 1.0, moon = 7e22 }"),
        "no links": ("links = [{ mass = 0.3, damping = 3.0, stiffness = 200.0 }]", "links = []"),
        "many links": ("links = [{", "links = [" + 200 * "{ mass = 1.0, damping = 1.0, stiffness = 1.0 }, " + "{"),
        "a kind of device": ('kind = "compliant"', 'kind = "magic"'),
        "delays for three": ("theta = [1, 2]", "theta = [1, 2, 3]"),
        "a delay without end": ("theta = [1, 2]", "theta = [1, 1000000]"),
        "lam beyond": ("psi = [0, 0]", "psi = [0, 0]\nlam = [9, 9]"),
        "latency of two ticks": ("psi = [0, 0]", "psi = [0, 0]\nlatency = [[0.0, 0.1], [0.0, 0.1]]"),
        "latency backwards": ("psi = [0, 0]", "psi = [0, 0]\nlatency = [[1e-3, 1e-4], [0.0, 1e-4]]"),
        "T_max below T": ("psi = [0, 0]", "psi = [0, 0]\nT_max = 1e-4"),
    }
    for name, (old, new) in springs.items():
        codes = (0,) if name == "many links" else (BUT,)
        words = ("audit", *QUICK["audit"], "--scenario", "s.toml")
        yield Case(f"scenario: {name}", words, codes, before=toml(old, new))
    many = "springs = [\n" + 3000 * '{ between = ["mass", "ground"], stiffness = 1.0, damping = 1.0 },\n'
    yield Case("scenario: thousands of springs", ("audit", *QUICK["audit"], "--scenario", "s.toml"), (BUT, 1, 0),
               before=toml("springs = [\n", many))  # fmt: skip
    chain = "".join(f'{{ between = ["n{i}", "n{i + 1}"], stiffness = 1.0, damping = 1.0 }},\n' for i in range(1500))
    masses = ", ".join(f"n{i} = 1.0" for i in range(1501))

    def long_chain() -> None:
        text = TEXT.replace("springs = [\n", 'springs = [\n{ between = ["mass", "n0"], stiffness = 1.0 },\n' + chain)
        put("s.toml", text.replace("{ mass = 1.0 }", f"{{ mass = 1.0, {masses} }}"))

    for command in ("audit", "run"):
        words = (command, *QUICK[command], "--scenario", "s.toml")
        yield Case(f"scenario: a chain of 1500 masses, {command}", words, before=long_chain)
    ranges = '\n[ranges]\nsprings = [{ between = ["contact 1", "mass"], stiffness = %s }]\n'
    for number in ("[900.0, 700.0]", "[1.0, 2.0]", "[-1.0, 900.0]", "[nan, 900.0]", "[700.0, 1e300]", "[700.0]", "1.0"):
        words = ("audit", *QUICK["audit"], "--scenario", "s.toml")
        yield Case(f"scenario: ranges {number}", words, before=written("s.toml", TEXT + ranges % number))
    varying_delay = "\n[varying_delay]\nlo = %s\nhi = %s\n"
    for lo, hi in (("[0]", "[2]"), ("[2, 2]", "[1, 1]"), ("[0, 0]", "[1000000, 3]"), ("[-1, 0]", "[2, 3]"), ("1", "2")):
        words = ("run", *QUICK["run"], "--scenario", "s.toml")
        yield Case(
            f"scenario: varying_delay {lo} {hi}", words, before=written("s.toml", TEXT + varying_delay % (lo, hi))
        )


def humans_and_delays() -> Iterator[Case]:
    """Files of humans, in TOML and as scripts, and of recorded delays."""
    human = "[[human]]\nlinks = [{ mass = 0.3, damping = 3.0, stiffness = 200.0 }]\n"
    files = {
        "h.toml": {
            "one for two": human,
            "nothing": "",
            "nested": "a = " + 2000 * "[",
            "a mass of nan": 2 * human.replace("0.3", "nan"),
            "an overflow": 2 * human.replace("200.0", "1e300"),
            "a person of nobody": 2 * human + "[[person]]\nholds = [7, 8]\n",
            "an unknown field": 2 * human.replace("mass", "mess"),
        },
        "h.py": {
            "no humans": "x = 1",
            "a mistake": "humans = (",
            "an exception": "1 / 0",
            "an exit": "raise SystemExit(0)",
            "no hand": "humans = [1, 2]",
            "no list": "humans = 7",
            "no end to the text": "# " + 3_000_000 * "x",
            "a port that fails": "class H:\n def port(self): 1 / 0\n def voluntary_force(self, t): return 0\n"
            "humans = [H(), H()]",
            "a port that is none": "class H:\n def port(self): return 5\n def voluntary_force(self, t): return 0\n"
            "humans = [H(), H()]",
        },
        "p.txt": {
            "empty": "",
            "a word": "1,2\n1,x\n",
            "three columns": "1,2,3\n",
            "a fraction": "1.5,2\n",
            "huge": "1,99999999999999999999\n",
            "negative": "-7,2\n",
            "binary": b"\xff\xff",
            "too long": 3_000_000 * "1",
        },
    }
    for file, texts in files.items():
        option = "--pattern" if file == "p.txt" else "--human"
        for name, text in texts.items():
            words = ("run", *QUICK["run"], option, file)
            yield Case(f"{option} {file}: {name}", words, before=written(file, text))


def couplings() -> Iterator[Case]:
    """Stored couplings that are none, that overflow, or that claim what they do not have."""
    texts = {
        "empty": "",
        "blank": " \n",
        "binary": b"\xff\xfe",
        "nested": 100_000 * "[",
        "half": '{"loop": {',
        "a list": "[]",
        "null": "null",
        "twice": '{"loop": 1, "loop": 2}',
        "an empty object": "{}",
        "too large": '{"a": "' + 60_000_000 * "x" + '"}',
    }
    for command in ("check", "export", "audit"):
        way = ("--coupling", "c.json") if command == "audit" else ("c.json",)
        for name, text in texts.items():
            yield Case(f"{command}: {name}", (command, *way), says=r"c\.json", before=written("c.json", text))
    twice = lambda: put("c.json", Path("c.json").read_text().replace('"K"', '"K": [1.0, 1.0], "K"', 1))  # noqa: E731
    yield Case("check: K twice", ("check", "c.json"), says="twice", before=twice)
    entries = [
        ("coupling.K", [1e308, 1e308]),
        ("coupling.K", [1e300, 300.0]),
        ("coupling.K", [-400.0, 300.0]),
        ("coupling.K", [0.0, 0.0]),
        ("coupling.K", []),
        ("coupling.K", [1.0]),
        ("coupling.B", [1e308, 1e308]),
        ("coupling.B", [-1.0, 0.1]),
        ("coupling.B", "x"),
        ("coupling.kind", "magic"),
        ("loop.T", 0.0),
        ("loop.T", 1e300),
        ("loop.T", -1.0),
        ("loop.theta", [1, -2]),
        ("loop.theta", [1, 10**9]),
        ("loop.theta", [1]),
        ("loop.psi", [0, 10**6]),
        ("loop.delta", [0.0, 0.0]),
        ("loop.delta", [1e300, 1.0]),
        ("loop.delta", []),
        ("loop.environment.springs", []),
        ("loop.environment.springs.0.stiffness", 1e300),
        ("loop.environment.springs.0.stiffness", -1.0),
        ("loop.environment.springs.0.between", ["a", "a"]),
        ("loop.environment.masses.mass", 1e300),
        ("loop.environment.contacts", []),
        ("version", 99),
    ]
    for command in ("check", "export"):
        for path, value in entries:
            codes = (BUT, 1)  # 1: it can be read, and is not proved
            yield Case(f"{command}: {path} = {str(value)[:30]}", (command, "c.json"), codes, before=stored(path, value))
    claims = [
        ("certificate.required", [1e-9, 1e-9]),
        ("certificate.required", []),
        ("certificate.required", [-1.0, -1.0]),
        ("certificate.available", [1e9, 1e9]),
        ("certificate.margin", 1e9),
        ("certificate.proof", "magic"),
        ("certificate.condition", "this-environment"),
        ("certificate.promise", "these ranges"),
        ("certificate.seal", "x"),
        ("certificate.scenario", "x"),
        ("certificate.versions", {}),
        ("certificate.matrices", {}),
        ("certificate.matrices", {"P": []}),
        ("certificate.matrices", {"P": [["1/0"]]}),
        ("certificate.matrices", {"P": [["1"], ["1", "2"]]}),
        ("certificate.matrices", {"P": [["9" * 4000]]}),
        ("certificate.matrices", {"P": [["x"]]}),
        ("certificate.matrices", {"P": [[f"1/{10**900}"] * 40] * 40}),
        ("certificate.matrices", {"P": [["1"] * 700] * 700}),
    ]
    for path, value in claims:
        name = f"check: {path} = {str(value)[:30]}"
        yield Case(name, ("check", "c.json"), (BUT, 1), before=stored(path, value))


def packed(**entries: bytes) -> Callable[[], None]:
    """t.npz with entries as they are."""

    def change() -> None:
        with zipfile.ZipFile("t.npz", "w", zipfile.ZIP_DEFLATED) as archive:
            for name, content in entries.items():
                archive.writestr(f"{name}.npy", content)

    return change


def header(shape: str, kind: str = "<f8", rest: bytes = b"") -> bytes:
    text = f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}".encode().ljust(117) + b"\n"
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text + rest


def traces() -> Iterator[Case]:
    """Traces that are none, that declare more than they hold, and data that no session measured."""
    n, t = 400, 1.2e-3 * np.arange(400)
    x = 1e-3 * np.sin(400 * t)[:, None] * [1.0, 0.5]
    uneven = t + 1e-4 * (np.arange(n) % 7)
    holed = np.where(np.arange(n)[:, None] == 9, np.nan, x)
    changed = {
        "no t": {"t": None},
        "no meta": {"meta": None},
        "meta is no JSON": {"meta": np.array("{")},
        "meta is nested": {"meta": np.array(100_000 * "[")},
        "meta is a number": {"meta": np.array(7)},
        "steady ticks": {"meta": np.array('{"run": {"steady_ticks": [[0, 1000000]]}}')},
        "steady ticks without end": {"meta": np.array('{"run": {"steady_ticks": [[0, 1e999]]}}')},
        "steady words": {"meta": np.array('{"run": {"steady_ticks": "x"}}')},
        "encoder step": {"meta": np.array('{"run": {"encoder_step_m": [1, 2, 3]}}')},
        "encoder step nan": {"meta": np.array('{"run": {"encoder_step_m": [NaN, 1]}}')},
        "uneven": {"t": uneven},
        "backwards": {"t": t[::-1]},
        "standing": {"t": 0 * t},
        "t is not finite": {"t": np.where(t > 0.1, np.inf, t)},
        "complex": {"x": x + 0j},
        "words": {"x": x.astype("U8")},
        "dates": {"t": np.arange(n).astype("M8[s]")},
        "booleans": {"x": x > 0},
        "huge": {"x": 1e300 * x},
        "beyond": {"x": np.full((n, 2), 1.7e308) * np.sign(x)},
        "a hole": {"x": holed},
        "infinite": {"x": np.where(x > 0, np.inf, x)},
        "flat": {"x": x[:, 0]},
        "three axes": {"x": x[None]},
        "one shorter": {"x": x[:-1]},
        "no channels": {"x": x[:, :0], "f": x[:, :0]},
        "no ticks": {"t": t[:0], **dict.fromkeys(("x", "f", "x_handle", "v_handle"), x[:0]), "w": x[:0, :0]},
    }
    for name, arrays in changed.items():
        change = lambda arrays=arrays: npz("t.npz", **arrays)  # noqa: E731
        fine = (BUT, 0) if name in ("meta is a number", "one shorter") else (BUT,)
        yield Case(f"trace: {name}", ("trace", "t.npz"), fine, before=change)
        yield Case(f"replay: {name}", ("replay", "t.npz"), before=change)
        if name in ("a hole", "huge", "uneven", "complex"):
            yield Case(f"trace --plot: {name}", ("trace", "t.npz", "--plot", "a.png"), before=change)
    whole = np.zeros(3).tobytes()
    files = {
        "empty": written("t.npz", b""),
        "rubbish": written("t.npz", b"PK\x03\x04rubbish"),
        "text": written("t.npz", "t,x,f"),
        "one array": lambda: np.save(open("t.npz", "wb"), np.zeros(3)),  # noqa: SIM115
        "10^12 rows": packed(t=header("(1000000000000,)")),
        "10^12 rows, said twice": packed(t=header("(1000000000000,)"), x=header("(1000000000000, 2)")),
        "negative": packed(t=header("(-3,)", rest=whole)),
        "objects": packed(t=header("(3,)", "|O", whole)),
        "a header that is none": packed(t=b"\x93NUMPY\x01\x00\xff\xff" + b"(" * 70_000),
        "another version": packed(t=b"\x93NUMPY\x09\x00" + whole),
        "a nested shape": packed(t=header("(" * 40 + ")" * 40)),
        "cut": lambda: put("t.npz", Path("t.npz").read_bytes()[:-200]),
        "one bit": lambda: put("t.npz", flipped(Path("t.npz").read_bytes())),
        "too much to unpack": bomb,
    }
    for name, change in files.items():
        for command in ("trace", "replay"):
            yield Case(f"{command}: {name}", (command, "t.npz"), says=r"t\.npz", before=change)


def flipped(content: bytes) -> bytes:
    at = len(content) // 3
    return content[:at] + bytes([content[at] ^ 16]) + content[at + 1 :]


def bomb() -> None:
    """A small archive whose directory says that it unpacks to ten gigabytes."""
    with zipfile.ZipFile("t.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("t.npy", header("(3,)", rest=bytes(24)))
    content = bytearray(Path("t.npz").read_bytes())
    at = content.index(b"PK\x01\x02") + 24
    content[at : at + 4] = (4_294_967_294).to_bytes(4, "little")
    put("t.npz", bytes(content))


def streams() -> Iterator[Case]:
    """Standard streams that are closed, full or ASCII, and little memory."""

    def closed(*numbers: int) -> Callable[[], None]:
        def change() -> None:
            for number in numbers:
                os.close(number)
                setattr(sys, ("stdin", "stdout", "stderr")[number], None)

        return change

    def ascii_only() -> None:
        sys.stdout = io.TextIOWrapper(os.fdopen(1, "wb", closefd=False), encoding="ascii", write_through=True)

    def full() -> None:
        handle = os.open("/dev/full", os.O_WRONLY)
        os.dup2(handle, 1)

    def little() -> None:
        now = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
        resource.setrlimit(resource.RLIMIT_AS, (now + 300_000_000,) * 2)

    quick = [("audit", *QUICK["audit"]), ("check", "c.json"), ("trace", "t.npz"), ("export", "c.json")]
    for words in quick:
        for name, numbers in (("in", (0,)), ("out", (1,)), ("err", (2,)), ("all", (0, 1, 2))):
            yield Case(f"{words[0]}: std{name} closed", words, (0, 1), before=closed(*numbers))
        yield Case(f"{words[0]} --json -: stdout closed", (*words, "--json", "-"), (0, 1), before=closed(1))
        yield Case(f"{words[0]}: ASCII", words, (0, 1), before=ascii_only)
        yield Case(f"{words[0]}: full", words, says="No space left", before=full)
        yield Case(f"{words[0]} --json -: full", (*words, "--json", "-"), says="No space left", before=full)
    words = ("audit", "--K", "1", "--B", "1", "--scenario", "n\udcff")
    yield Case("bad input, stderr closed", words, before=closed(2))
    huge = lambda: (npz("t.npz", x=np.zeros((30_000_000, 1)), t=np.zeros(3)), little())  # noqa: E731
    yield Case("trace: little memory", ("trace", "t.npz"), (3,), "memory", before=huge)

    def backend() -> None:
        os.environ["MPLBACKEND"] = "nonsense"
        script = f"import sys; sys.path.insert(0, {str(Path(options.__file__).parents[1])!r}); "
        script += "from cli.main import door; door('trace')"
        os.execv(sys.executable, [sys.executable, "-c", script, "t.npz", "--plot", "a.png"])

    yield Case("MPLBACKEND=nonsense", ("trace",), (0,), before=backend)


def silence() -> Iterator[Case]:
    """Options that would have to be ignored, and lists with nothing between their commas."""
    none = ("--case", "none")
    for words, says in [
        (("run", *QUICK["run"], *none, "--coupling", "zzz"), "--coupling"),
        (("validate", *QUICK["validate"], *none, "--coupling", "zzz"), "--coupling"),
        (("audit", *none, "--coupling", "zzz"), "--coupling"),
        (("audit", *none, *QUICK["audit"]), "--K"),
        (("zwidth", *QUICK["zwidth"], *none, "--coupling", "zzz"), "--c"),
        (("view", "--video", "v.gif", *none, "--coupling", "zzz"), "--coupling"),
        (("bridge", "--rehearse", *none, "--coupling", "zzz"), "--c"),
        (("design", *none, "--coupling", "optimal"), "--case none"),
        (("compare", *none, "--coupling", "zzz"), "--coupling"),
        (("run", *QUICK["run"], "--coupling", ""), "--coupling"),
        (("run", *QUICK["run"], "--coupling", "x.json"), "x.json"),
        (("run", *QUICK["run"], "--scenario", ""), "scenario"),
        (("run", *QUICK["run"], "--human", ""), "--human"),
        (("run", *QUICK["run"], "--json", ""), "--json"),
        (("run", *QUICK["run"], "--out", ""), "--out"),
        (("design", "--out", ""), "--out"),
        (("design", "--json", ""), "--json"),
        (("export", "c.json", "--out", ""), "--out"),
        (("trace", "t.npz", "--plot", ""), "--plot"),
        (("compare", "--coupling", ""), "--coupling"),
        (("compare", "--coupling", "none,,published"), "--coupling"),
        (("compare", "--coupling", ",none"), "--coupling"),
        (("compare", "--coupling", "none,"), "--coupling"),
        (("compare", "--over", ""), "--over"),
        (("compare", "--over", "delay,"), "--over"),
        (("compare", "--over", "moon"), "--over"),
        (("compare", "--over", "damping=2"), "--over"),
        (("compare", "--over", "damping=2:1"), "--over"),
        (("compare", "--over", "damping=nan:1"), "--over"),
        (("suite", "--only", ""), "--only"),
        (("suite", "--only", "I,,hard"), "--only"),
        (("suite", "--only", "I,"), "--only"),
        (("run", *QUICK["run"], "--theta", "1,"), "--theta"),
        (("run", *QUICK["run"], "--delta", ",1"), "--delta"),
        (("run", *QUICK["run"], "--varying-delay", "1,"), "--varying-delay"),
        (("run", *QUICK["run"], "--loss", "0.1", "--pattern", "random"), "--varying-delay|--pattern"),
        (("run", *QUICK["run"], "--playout"), "--playout"),
        (("run", *QUICK["run"], "--energy-budget", "1,0.5"), "--energy-budget"),
        (("run", *QUICK["run"], "--engine", "exact", "--integrator", "RK4"), "--integrator"),
        (("run", *QUICK["run"], "--engine", "exact", "--substeps", "4"), "--substeps"),
        (("run", *QUICK["run"], "--vertex", "1"), "--vertex"),
        (("run", *QUICK["run"], "--no-plot", "--no-plot", "--side-by-side"), "--side-by-side"),
        (("design", "--best", "--coupling", "ccl"), "--coupling"),
        (("run", *QUICK["run"], "--error", "nan"), "--error is nan, allowed are 1e-18 to 1"),
        (("design", "--order", "2"), "--order"),
        (("design", "--method", "inner"), "--method"),
        (("design", "--compare"), "--compare"),
        (("design", "--objective", "rms"), "--objective"),
        (("design", "--band", "80,1"), "--band"),
        (("design", "--seconds", "9"), "--seconds"),
        (("design", "--high-gain", "2"), "--high-gain"),
        (("design", "--coupling", "ccl", "--limiter"), "limiter"),
        (("design", "--varying-delay", "1-2,0-3", "--condition", "any-environment"), "varying-delay"),
        (("design", "--coupling", "ccl", "--order", "99"), "--order"),
        (("design", "--samples", "5"), "--samples"),
        (("export", "c.json", "--without-theta"), "--without-theta"),
        (("audit", "--K", "1,2"), "--K"),
        (("audit",), "nothing to audit"),
        (("audit", "--rigid", "--K", "1,2", "--B", "1"), "--K"),
        (("zwidth", *QUICK["zwidth"], "--coupling", "c.json", "--rigid"), "--rigid"),
        (("zwidth", *QUICK["zwidth"], "--condition", "any-environment"), "--condition"),
        (("zwidth", "--grid", "4", "--points", "0", "--K-range", "5,1"), "--K-range"),
        (("zwidth", "--grid", "4", "--points", "0", "--B-range", "0,inf"), "--B-range"),
        (("bridge", "--rehearse", "--port", "x"), "--port"),
        (("bridge", "--port", "nix", "--arm"), "nix"),
        (("bridge", "--port", "dir", "--arm"), "dir"),
        (("bridge", "--port", "fifo", "--arm"), "fifo"),
        (("bridge", "--port", "s.toml", "--arm"), "s.toml"),
        (("bridge", "--port", "x", "--arm", "--fault", "unplug"), "--fault"),
        (("bridge", "--rehearse", "--fault", "magic"), "magic"),
        (("bridge", "--rehearse", "--fault", "up:drop=nan"), "drop"),
        (("bridge", "--rehearse", "--deadman", "key"), "--deadman"),
        (("bridge", "--rehearse", "--baud", "fast"), "--baud"),
        (("bridge", "--rehearse", "--condition", "magic"), "--condition"),
        (("emulator", "--fault", ""), "fault"),
        (("emulator", "--fault", "drop=2@x", "--duration", "0.01"), "drop"),
        (("emulator", "--parent", "1"), "--parent"),
        (("identify", "--rehearse", "--band", "80,3"), "--band"),
        (("validate", *QUICK["validate"], "--shards", "2", "--dask", "x:1"), "--dask"),
        (("validate", *QUICK["validate"], "--dask", ""), "--dask"),
        (("validate", *QUICK["validate"], "--dask", "nix"), "--dask"),
        (("validate", *QUICK["validate"], "--environments", "ranges"), "--environments"),
        (("validate", *QUICK["validate"], "--generations", "5"), "--generations"),
        (("view", "--video", "v.xyz"), "--video"),
        (("view", "--video", ""), "--video"),
        (("view", "--video", "v.gif", "--script", "x"), "--script"),
        (("view", "--video", "v.gif", "--script", "-1:quit"), "--script"),
    ]:
        yield Case(" ".join(words), words, says=says)
    yield Case("accuracy of a feather", ("accuracy", "--scenario", "s.toml"), (BUT,), before=feather)
    yield Case("run of a feather", ("run", *QUICK["run"], "--scenario", "s.toml"), (BUT, 0), before=feather)


def feather() -> None:
    put(
        "s.toml",
        TEXT.replace("handle_mass = 0.19", "handle_mass = 1e-6").replace(
            "links = [{ mass = 0.3", "links = [{ mass = 1e-6"
        ),
    )


def names_in_pictures() -> Iterator[Case]:
    """Names with everything that a typesetter reads as its own."""
    odd = [
        "$x^",
        "$\\frac$",
        "a_b^c$$",
        "\U0001f600",
        "中文",
        "\u202e",
        "%s{}",
        "[red]x[/]",
        "[/b]",
        ":smile:",
        "\x1b[31m",
    ]
    for name in odd:
        file = f"t{name}.npz".replace("/", "|")
        copied = lambda file=file: shutil.copy("t.npz", file)  # noqa: E731
        yield Case(f"picture of {name!r}", ("trace", file, "--plot", "a.png"), (0,), before=copied)
    for name in ("$a^$ \\U0001F600 \\u001b[31m", "[/b] [red]%s{}"):
        run = ("run", "--no-alternatives", "--duration", "0.3", "--scenario", "s.toml", "--out", "new")
        yield Case(f"scenario called {name}", run, (0,), before=toml('"omega-pair"', f'"{name}"'))


# ----------------------------------------------------------------------------------------------------
# Running them.


STEERS = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e\ud800-\udfff]")


def answer(case: Case, place: Path) -> list[str]:
    """What is wrong with how a case ends."""
    before = {path: content(path) for path in sorted(place.rglob("*"))}
    log = place.parent / f"{place.name}.log"
    begin = time.perf_counter()
    child = os.fork()
    if child == 0:
        run(case, place, log)
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    seconds = time.perf_counter() - begin
    err = Path(f"{log}.err").read_text(errors="surrogateescape")
    changed = json.loads(Path(f"{log}.changed").read_text()) if Path(f"{log}.changed").exists() else {}
    wrong = []
    if code not in case.codes:
        wrong.append(f"code {code} after {seconds:.1f} s, expected {case.codes}: {err[-300:]!r}")
    if "Traceback" in err or "Warning" in err or "Exception ignored" in err:
        wrong.append(f"no answer: {err[-400:]!r}")
    closed = "stderr closed" in case.name or "stdall" in case.name
    if (
        code in (2, 3)
        and not closed
        and "--json -: full" not in case.name
        and (err.count("\n") != 1 or STEERS.search(err[:-1]) or len(err) > 1200)
    ):
        wrong.append(f"not one line: {err[:300]!r}")
    if code == BUT and code in case.codes and case.says and not closed and not re.search(case.says, err):
        wrong.append(f"does not say {case.says!r}: {err[:300]!r}")
    for path, old in before.items():
        if str(path.relative_to(place)) not in changed and content(path) != old:
            wrong.append(f"{path.name} was changed")
    for name, digest in changed.items():
        if content(place / name) != digest:
            wrong.append(f"{name} was changed")
    wrong += [f"{path.name} is left" for path in place.rglob(".*.*")]
    return wrong


def content(path: Path) -> str:
    """A file's, short; anything else by its kind."""
    import hashlib

    if path.is_symlink():
        return os.readlink(path)
    return hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else str(path.is_dir())


def run(case: Case, place: Path, log: Path) -> None:
    """In the child: the case with its own streams; never returns."""
    code = 99
    try:
        os.chdir(place)
        before = {str(path.relative_to(place)): content(path) for path in place.rglob("*")}
        for number, name in ((1, "out"), (2, "err")):
            handle = os.open(f"{log}.{name}", os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
            os.dup2(handle, number)
            os.close(handle)
        os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
        os.environ["COLUMNS"] = "100"
        for number in (1, 2):
            stream = os.fdopen(number, "w", encoding="utf-8", buffering=1, closefd=False)
            setattr(sys, ("stdout", "stderr")[number - 1], stream)
        resource.setrlimit(resource.RLIMIT_CPU, (SECONDS, SECONDS))
        sys.setrecursionlimit(1000)
        changed = {}
        if case.before:
            if case.name == "MPLBACKEND=nonsense":
                put(f"{log}.changed", "{}")
            case.before()
            after = {str(path.relative_to(place)): content(path) for path in place.rglob("*")}
            changed = {name: digest for name, digest in after.items() if before.get(name) != digest}
        put(f"{log}.changed", json.dumps(changed))
        command, *words = case.words
        options.execute(lambda argv: put(f"{log}.begun", "") or import_module(f"cli.{command}").main(argv), words)
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else 0
    except BaseException:
        import traceback

        with suppress(Exception):
            traceback.print_exc()
    finally:
        for stream in (sys.stdout, sys.stderr):
            with suppress(Exception):
                stream.flush()
        os._exit(code)


MOMENTS = 30


def signalled(folder: Path, model: Path) -> Iterator[tuple[str, list[str]]]:
    """MOMENTS of a run in which Ctrl-C comes, half as many for SIGTERM: what came, and what is wrong with its end."""
    words = ("run", "--no-alternatives", "--duration", "2", "--out", "new")
    rng, whole, missed = np.random.default_rng(7), 0.0, 0
    signals = [0, *MOMENTS * [signal.SIGINT], *(MOMENTS // 2) * [signal.SIGTERM]]  # the first one measures how long
    for number, sent in enumerate(signals):
        place = folder / f"signal-{number}"
        shutil.copytree(model, place, symlinks=True, ignore=shutil.ignore_patterns("fifo"))
        log = folder / f"{place.name}.log"
        if (child := os.fork()) == 0:
            signal.signal(signal.SIGINT, signal.default_int_handler)
            run(Case("signals", words), place, log)
        while not Path(f"{log}.begun").exists():
            time.sleep(1e-3)
        begin, moment = time.perf_counter(), rng.uniform(0, 0.9) * whole
        if sent:
            time.sleep(moment)
            os.kill(child, sent)
        code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        whole = whole or time.perf_counter() - begin
        err = Path(f"{log}.err").read_text()
        expected = {
            0: (0, ("",)),
            signal.SIGINT: (130, ("", "interrupted\n")),
            signal.SIGTERM: (143, ("terminated\n",)),
        }
        right, lines = expected[sent]
        late = sent and code == 0 and (place / "new" / "report.json").exists()  # it came after the end
        missed += bool(late)
        wrong = [] if late or (code == right and err in lines) else [f"code {code}, {err[-400:]!r}"]
        wrong += ["it comes after the end for the tenth time"] if missed == 10 else []
        wrong += [f"{path.name} is left" for path in place.rglob(".*.*")]
        yield f"signal {sent} after {moment:.3f} of {whole:.2f} s", wrong


def main() -> int:
    """Run every case whose name holds the word of the command line."""
    word = sys.argv[1] if len(sys.argv) > 1 else ""
    for command in COMMANDS:
        import_module(f"cli.{command}")
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    os.environ["HAPTIC_LOOP_CACHE"] = "off"  # every case takes as long as the first
    if folder := os.environ.get("SHARED_DESIGNS"):
        sys.path.append(str(Path(__file__).parents[1]))
        import_module("forked").share_designs(Path(folder))
    bad, number, begin = 0, 0, time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        model = Path(folder) / "model"
        model.mkdir()
        furnish(model)
        if word == "--signals":
            ends = list(signalled(Path(folder), model))
            for name, wrong in ends:
                print(*(f"{name}: {line}" for line in wrong), sep="\n", end="\n" if wrong else "")
            bad = sum(bool(wrong) for _, wrong in ends)
            print(f"{len(ends)} cases, {bad} answered badly")
            return int(bad > 0)
        for case in cases():
            if word not in case.name:
                continue
            number += 1
            place = Path(folder) / str(number)
            shutil.copytree(model, place, symlinks=True, ignore=shutil.ignore_patterns("fifo"))
            os.mkfifo(place / "fifo")
            start = time.perf_counter()
            wrong = answer(case, place)
            took = time.perf_counter() - start
            if took > 2:
                print(f"slow: {took:.1f} s: {case.name}", file=sys.stderr, flush=True)
            for line in wrong:
                print(f"{case.name}: {line}", flush=True)
            bad += bool(wrong)
            shutil.rmtree(place)
    print(f"{number} cases, {bad} answered badly, {time.perf_counter() - begin:.0f} s")
    return int(bad > 0)


if __name__ == "__main__":
    sys.exit(main())
