"""Cases of hostile.py with bad command lines: wrong values and paths, outputs that would replace inputs, names, .."""

from __future__ import annotations

import os
import shlex
import shutil
from collections.abc import Iterator

from hostile_cases import BUT, QUICK, SHORT, TEXT, Case, entries, pairs, quick, toml, written

NO_NUMBERS = ("x", "", "nan", "1,,2", "\x1b[31m1", "9" * 5000, "-1e999")
NUMERIC = {
    "run": "theta psi lam delta T T-max latency loss varying-delay energy-budget substeps duration vertex seed",
    "validate": "humans shards generations duration seed theta",
    "zwidth": "grid K-range B-range mark humans points duration",
    "view": "fps duration",
    "accuracy": "duration",
    "design": "ranges samples band high-gain seconds order varying-delay delta",
    "audit": "K B varying-delay",
    "compare": "points band seconds",
    "export": "seed",
    "bridge": "pace quantile guard measure force-cap max-speed continuous-force thermal-time duration seed baud",
    "identify": "force band seconds sittings",
}


def numeric_options() -> Iterator[Case]:
    """Yield numeric options with words that are not numbers, or are outside of all limits."""
    for command, names in NUMERIC.items():
        for i, name in enumerate(names.split()):
            every = command in ("run", "bridge") and not SHORT
            for word in NO_NUMBERS if every else [NO_NUMBERS[(i + k) % 7] for k in (0, 3)]:
                words = quick(command, f"--{name}={word}")
                yield Case(f"{command} --{name}={word[:8]!r}", words, says=name.split("-")[0])


INPUTS = """run --scenario | run --human | run --pattern | audit --scenario | check | export | trace | replay
    view --coupling"""
NO_FILES = {
    "missing": "nix", "folder": "dir", "pipe": "fifo", "endless": "/dev/zero", "terminal": "/dev/tty",
    "link to itself": "loop", "long": "n" * 300, "very long": "n/" * 3000,
    "control characters": "n\x1b]0;x\x07\r\n", "right to left": "n\u202eabc",
    "no UTF-8": "n\udcff", "below a file": "s.toml/x", "empty": "",
}  # fmt: skip
OUTPUTS = """run --out | run --json | design --out | export --out | trace --plot | audit --json | view --video
    bridge --out"""
NO_OUTPUTS = ("below a file", "very long", "long", "link to itself", "folder", "no folder", "in /proc", "zero byte")


def odd_paths() -> Iterator[Case]:
    """Yield inputs that cannot be read, and outputs that cannot be written."""
    for place, (kind, path) in pairs(entries(INPUTS), NO_FILES.items()):
        command, _, option = place.partition(" ")
        if not option:
            yield Case(f"{command} {kind}", (command, path, "--json=r.json") if path else (command, "--", path))
            continue
        says = option.lstrip("-")
        if option == "--coupling":
            path, says = path if path.startswith(("/", "dir", "fifo", "loop", "s.toml")) else f"{path}.json", ""
        yield Case(f"{place} {kind}", quick(command, f"{option}={path}"), says=says)
    files = {"no folder": "nix/r", "in /proc": "/proc/self/r", "zero byte": "r\0"} | NO_FILES
    for place, kind in pairs(entries(OUTPUTS), NO_OUTPUTS):
        command, option = place.split()
        if place in ("run --out", "bridge --out") and kind in ("folder", "no folder"):
            continue  # The command uses or makes the folder.
        suffix = ".gif" if option == "--video" and kind not in ("folder", "link to itself") else ""
        words = (command, *(() if command == "view" else QUICK[command]), option, files[kind] + suffix)
        yield Case(f"{place} {kind}", words, says=option)


def split(line: str) -> tuple[str, ...]:
    """Return the words of a command line; run, validate and zwidth get their QUICK words."""
    command, *more = shlex.split(line)
    return quick(command, *more) if command in ("run", "validate", "zwidth") else (command, *more)


BOTH = """design --scenario s.toml --out s.toml | design --scenario to-s --out s.toml
    design --scenario s.toml --out to-s | design --scenario s.toml --out ./dir/../s.toml
    design --scenario s.toml --json s.toml | design --out a.json --json a.json | design --out a.json --json ./a.json
    replay t.npz --json t.npz | trace t.npz --json t.npz | trace t.npz --plot t.npz
    trace t.npz --plot a.png --json a.png | check c.json --json c.json | export c.json --json c.json
    export c.json --out c.json | export c.json --out a.c --json a.c | audit --coupling c.json --json c.json
    audit --K 400 --B 1 --scenario s.toml --json s.toml | run --scenario s.toml --json s.toml
    run --human h.toml --json h.toml | run --pattern p.txt --json p.txt | run --coupling c.json --json c.json
    validate --scenario s.toml --json s.toml | validate --coupling c.json --json c.json
    zwidth --scenario s.toml --json s.toml | zwidth --coupling c.json --json c.json
    compare --coupling none,c.json --json c.json | compare --scenario s.toml --json s.toml
    view --video a.gif --json a.gif --duration 0.2 | bridge --rehearse --scenario s.toml --json s.toml
    identify --rehearse --scenario s.toml --json s.toml"""


def overwritten() -> Iterator[Case]:
    """Yield outputs that are also inputs or other outputs, under any name."""
    for words in map(split, entries(BOTH)):
        yield Case(" ".join(words), words, says="also|read")
    words = split("run --case none --scenario dir/report.json --out dir")
    yield Case("a report that would replace its scenario", words, says="read", before=written("dir/report.json", TEXT))
    words = split("run --case none --out new --json new/trace.npz")
    yield Case("a report that would replace the trace", words, says="twice", before=lambda: os.mkdir("new"))
    hard = ("design", "--scenario", "s.toml", "--json", "hard")
    yield Case("a hard link of the scenario", hard, says="also", before=lambda: os.link("s.toml", "hard"))


#: command lines, each with the words of its error line if these are not its last option
SILENT = """run --case none --coupling zzz | validate --case none --coupling zzz | audit --case none --coupling zzz
    audit --case none --K 400,300 --B .1,.1 => --K | zwidth --case none --coupling zzz => --c
    view --video v.gif --case none --coupling zzz | bridge --rehearse --case none --coupling zzz => --c
    design --case none --coupling optimal => --case none | compare --case none --coupling zzz
    run --coupling '' | run --coupling x.json => x.json | run --scenario '' => scenario | run --human ''
    run --json '' | run --out '' | design --out '' | design --json '' | export c.json --out '' | trace t.npz --plot ''
    compare --coupling '' | compare --coupling none,,published | compare --coupling ,none | compare --coupling none,
    run --theta 1, | run --delta ,1 | run --varying-delay 1,
    run --loss 0.1 --pattern random => --varying-delay|--pattern | run --playout | run --energy-budget 1,0.5
    run --engine exact --integrator RK4 | run --engine exact --substeps 4 | run --vertex 1
    run --error nan => --error is nan, allowed are 1e-18 to 1 | design --order 2 | design --compare
    design --objective rms | design --band 80,1 | design --seconds 9 | design --high-gain 2
    design --coupling ccl --limiter => limiter
    design --varying-delay 1-2,0-3 --coupling moving-average => varying-delay
    design --coupling ccl --order 99 | export c.json --without-theta | audit --K 1,2 | audit => nothing to audit
    audit --rigid --K 1,2 --B 1 => --K | zwidth --coupling c.json --rigid | zwidth --condition any-environment
    zwidth --K-range 5,1 | zwidth --B-range 0,inf | bridge --rehearse --port x
    bridge --port nix --arm --no-dead-man => nix | bridge --port dir --arm --no-dead-man => dir
    bridge --port fifo --arm --no-dead-man => fifo | bridge --port s.toml --arm --no-dead-man => s.toml
    bridge --port x --arm --fault unplug | bridge --rehearse --fault magic => magic
    bridge --rehearse --fault up:drop=nan => drop | bridge --rehearse --deadman key | bridge --rehearse --baud fast
    bridge --rehearse --condition magic | identify --rehearse --band 80,3 | validate --environments ranges
    validate --generations 5 | view --video v.xyz | view --video '' | view --video v.gif --script x
    view --video v.gif --script -1:quit"""
#: a scenario whose handles and hands weigh 1 mg
LIGHT = TEXT.replace("handle_mass = 0.19", "handle_mass = 1e-6").replace("[{ mass = 0.3", "[{ mass = 1e-6")


def silence() -> Iterator[Case]:
    """Yield options that would be ignored, and lists with empty entries."""
    for line, _, says in (entry.partition(" => ") for entry in entries(SILENT)):
        words = split(line)
        yield Case(" ".join(words), words, says=says or [word for word in words if word.startswith("--")][-1])
    if not SHORT:
        accuracy = ("accuracy", "--scenario", "s.toml")
        yield Case("accuracy with masses of 1 mg", accuracy, before=written("s.toml", LIGHT))
        yield Case("run with masses of 1 mg", split("run --scenario s.toml"), (BUT, 0), before=written("s.toml", LIGHT))


#: command -> options that are refused
REFUSED = {
    "run": """--error 0 | --error -1 | --error 1e-400 | --error inf | --error 1e-6 --engine exact
        --error 1e-6 --integrator RK4 | --error 1e-6 --substeps 4 | --energy-budget -1 | --energy-budget 1,0.5
        --energy-budget 1, | --energy-budget ,1 | --energy-budget 1,2,3 | --energy-budget 0.1,nan | --T-max 0
        --T-max 1e-3 | --T-max inf | --period 1e-3 | --period 2e-3,1e-3 | --period 0,1 | --period nix
        --period 1e-3,5e-3 --T-max 2e-3 | --period -1e-3,2e-3 | --period 1e-3,inf | --latency -1e-4
        --latency 1.2e-3 | --latency 1 | --latency 1e-4,2e-4,3e-4 | --latency 1e-4:2e-4:3e-4
        --latency 1e-4 --period 1e-5,2e-3 | --loss 1.5 | --varying-delay 2,1 | --varying-delay 0,1e9
        --varying-delay 1.5,2 | --playout | --pattern random | --vertex 1 | --vertex -1 | --band 5,1 | --band 0,0
        --band nan,5 | --theta 1,2,3 | --theta 1.5 | --psi -1,0 | --delta -1 | --T 1e-7 | --T 1 | --theta 1001,0
        --theta 1000,1000 | --case none --lam 0,0,0 | --condition any-environment --case III
        --no-limiter --energy-budget x | --human h.py:humans --vertex 3""",
    "validate": """--links 3 | --humans 0 | --humans 1e3 | --shards 0
        --duration 1e-9 | --duration -1 | --latency 2e-3 | --T-max 1e-4 | --period 1e-3""",
    "design": """--ranges 0 | --ranges -5 | --ranges 101% | --ranges 1e9 | --ranges 10%%
        --coupling moving-average --varying-delay 0,2 | --limiter --no-limiter | --coupling optimal --order 2
        --compare | --objective sup | --order 0 --coupling ccl
        --order 1e9 --coupling ccl | --high-gain 0 | --high-gain 2 | --seconds -1 --coupling optimal
        --band 1,0 --coupling optimal | --best""",
    "audit": """--device nix | --devices --K 5 | --rigid | --rigid --K 5 --B 0 --theta 1,2 | --rigid --K 5 --B 0 --psi 1
        --rigid --K 0 --B 0 | --rigid --K 1e300 --B 0 | --K 1,2,3 --B 0 | --K 1,2 --B 0,0,0 | --K -1,2 --B 0
        --rigid --K 5 --B 0 --T-max 1e-9 | --K 1,2 --B 0 --coupling c.json""",
    "bridge": """--fault nonsense | --fault drop=2 | --fault drop=nan | --fault drop@-1 | --fault drop=0.1@1+-1
        --fault axis9:jump | --fault axis3:jump | --fault up:jump | --fault jump=1e9 | --fault stall=99
        --fault leap=0 | --fault period=0 | --fault = | --fault '' | --quantile 0 | --quantile 1.01 | --guard -1
        --guard 1e9 | --measure 0 | --measure 1e9 | --force-cap 0 | --force-cap 13 | --max-speed 0
        --energy-budget -1 | --pace 0 | --pace 1e-9 | --baud -1 | --continuous-force 0
        --continuous-force 13 | --continuous-force 1,2,3 | --thermal-time 0 | --T 0.05 | --T 1e-6
        --varying-delay 0,2 | --port nix | --duration -1""",
    "identify": """--force 0 | --force 100 | --force -1 | --band 200,3 | --band 0,0 | --band 1,1e9 | --band 3
        --seconds 0 | --seconds 1e9 | --coulomb -1 | --coulomb 100 | --fault axis9:jump | --pace 0 | --T 0.05
        --port nix | --measure 0 | --quantile 2""",
    "zwidth": """--coupling nix | --K-range 5,1 | --B-range -1,5 | --grid 1 | --rigid --theta 1,2
        --mark 1 | --mark 1,2,3 | --points -1""",
}
HUMANS = """from haptic_loop.models.human import Human, Link
humans = [Human((Link(0.3, 3.0, 200.0),))] * 2
"""
_PORT = """from haptic_loop.models.human import *
class Hand:
    def port(self): {}
    def voluntary_force(self, t): {}
humans = [Hand()] * 2
"""
_GOOD = "return Human((Link(.3, 3., 200.),)).port()"
_DRAWS = HUMANS + "class P:\n    def draw(self, rng, n): {}\npopulation = P()\n"
#: name -> text of a Python file of hands, most of which fail or do harm
PEOPLE = {
    "ends": "raise SystemExit(0)", "interrupts": "raise KeyboardInterrupt", "no syntax": "humans = [",
    "a number": "humans = 5", "strings": "humans = ['a', 'b']", "one hand": HUMANS.replace("* 2", ""),
    "a port that is none": _PORT.format("return None", "return 0 * t"),
    "a port that raises": _PORT.format("raise RuntimeError('\\x1b[2J' * 500)", "return 0 * t"),
    "a force that raises": _PORT.format(_GOOD, "raise OSError(28, 'no')"),
    "a force of another shape": _PORT.format(_GOOD, "return [[1.0]]"),
    "a force that is no number": _PORT.format(_GOOD, "return t / 0"),
    "a force of words": _PORT.format(_GOOD, "return ['x'] * len(t)"),
    "nobody drawn": _DRAWS.format("return []"), "drawing that raises": _DRAWS.format("1 / 0"),
    "numbers drawn": _DRAWS.format("return [1] * n"), "a population that is none": HUMANS + "population = 7\n",
    "persons that are none": HUMANS + "persons = [1]\n", "endless recursion": "def f(): f()\nf()\n",
    "memory": "raise MemoryError", "control characters": "print('\\x1b[31mred')\n" + HUMANS,
    "output that is closed": "import sys\nsys.stdout.close()\n" + HUMANS,
}  # fmt: skip


def combined() -> Iterator[Case]:
    """Yield impossible options, options that exclude each other, and harmful Python files of hands."""
    for command, lines in REFUSED.items():
        for line in entries(lines):
            words = (command, *(QUICK[command] if command != "audit" else ()), *shlex.split(line))
            yield Case(f"{command} {line}", words, before=written("h.py", HUMANS))
    for (name, text), command in pairs(PEOPLE.items(), ("run", "validate")):
        words = quick(command, "--case", "none", "--human", "h.py:humans")
        yield Case(f"{command} with hands in Python: {name}", words, (0, 1, BUT, 130), before=written("h.py", text))


#: names that a typesetter, a terminal or a format string would interpret
STEERING = ("$x^", "$\\frac$", "a_b^c$$", "\U0001f600", "中文", "\u202e", "%s{}", "[red]x[/]", "[/b]", ":smile:")
STEERING += ("\x1b[31m",)


def names_in_pictures() -> Iterator[Case]:
    """Yield files and a scenario with names of STEERING; a short run has every second file."""
    for name in STEERING[:: 1 + SHORT]:
        file = f"t{name}.npz".replace("/", "|")
        copied = lambda file=file: shutil.copy("t.npz", file)  # noqa: E731
        yield Case(f"picture of {name!r}", ("trace", file, "--plot", "a.png"), (0,), before=copied)
    name = "$a^$ \\U0001F600 \\u001b[31m [/b] [red]%s{}"
    run = ("run", "--case", "none", "--duration", "0.1", "--scenario", "s.toml", "--out", "new")
    yield Case(f"scenario called {name}", run, (0,), before=toml('"omega-pair"', f'"{name}"'))


def cases() -> Iterator[Case]:
    for part in (numeric_options, odd_paths, overwritten, silence, combined, names_in_pictures):
        yield from part()
