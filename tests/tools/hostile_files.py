"""Cases of hostile.py with files that are malformed, overflow, or claim false proofs: scenarios, hands, traces, .."""

from __future__ import annotations

import shutil
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from hostile_cases import BUT, QUICK, SHORT, TEXT, Case, npz, pairs, put, stored, toml, written

NO_SCENARIOS = {
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
FIELDS = [
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
NO_NETWORKS = {
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


def scenarios() -> Iterator[Case]:
    """Yield texts that are no scenario, or an impossible one."""
    for name, text in NO_SCENARIOS.items():
        yield Case(f"scenario: {name}", ("run", *QUICK["run"], "--scenario", "s.toml"), before=written("s.toml", text))
    numbers = ("1e300", "1e999", "-1.0", "nan", "-inf", '"x"', "[]", "true")
    closing = {"theta = [1, ": "]", "psi = [0, ": "]", "masses = { mass = ": " }", "damping = ": " },"}
    for (old, new), number in pairs(FIELDS, numbers, 3):
        if (old, number) == ("force = 1.0", "-1.0"):
            continue  # a negative force is allowed
        field = old.split(" ")[0].removesuffix("es")
        text = f"{new}{number}{closing.get(new, '')}"
        words = ("audit", *QUICK["audit"], "--scenario", "s.toml")
        yield Case(f"scenario: {old} -> {number}", words, says=field, before=toml(old, text))
    for name, (old, new) in NO_NETWORKS.items():
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


HUMAN = "[[human]]\nlinks = [{ mass = 0.3, damping = 3.0, stiffness = 200.0 }]\n"
NO_PEOPLE = {
    "h.toml": {
        "one for two": HUMAN,
        "nothing": "",
        "nested": "a = " + 2000 * "[",
        "a mass of nan": 2 * HUMAN.replace("0.3", "nan"),
        "an overflow": 2 * HUMAN.replace("200.0", "1e300"),
        "a person of nobody": 2 * HUMAN + "[[person]]\nholds = [7, 8]\n",
        "an unknown field": 2 * HUMAN.replace("mass", "mess"),
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


def humans_and_delays() -> Iterator[Case]:
    """Yield bad files of humans, in TOML and as scripts, and of recorded delays."""
    for file, texts in NO_PEOPLE.items():
        option = "--pattern" if file == "p.txt" else "--human"
        for name, text in texts.items():
            words = ("run", *QUICK["run"], option, file)
            yield Case(f"{option} {file}: {name}", words, before=written(file, text))


NO_COUPLINGS = {
    "empty": "",
    "blank": " \n",
    "binary": b"\xff\xfe",
    "nested": 100_000 * "[",
    "half": '{"loop": {',
    "a list": "[]",
    "null": "null",
    "twice": '{"loop": 1, "loop": 2}',
    "an empty object": "{}",
    "too large": '{"a": "' + 50_000_000 * "x" + '"}',
}
ENTRIES = [
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
CLAIMS = [
    ("certificate.required", [1e-9, 1e-9]),
    ("certificate.required", []),
    ("certificate.required", [-1.0, -1.0]),
    ("certificate.available", [1e9, 1e9]),
    ("certificate.margin", 1e9),
    ("certificate.proof", "magic"),
    ("certificate.condition", "this-environment"),
    ("certificate.guarantee", "these ranges"),
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


def couplings() -> Iterator[Case]:
    """Yield stored couplings that are malformed, overflow, or claim proofs that they do not have."""
    for command, (name, text) in pairs(("check", "export", "audit"), NO_COUPLINGS.items()):
        way = ("--coupling", "c.json") if command == "audit" else ("c.json",)
        yield Case(f"{command}: {name}", (command, *way), says=r"c\.json", before=written("c.json", text))
    twice = lambda: put("c.json", Path("c.json").read_text().replace('"K"', '"K": [1.0, 1.0], "K"', 1))  # noqa: E731
    yield Case("check: K twice", ("check", "c.json"), says="twice", before=twice)
    for command, (path, value) in pairs(("check", "export"), ENTRIES):
        codes = (BUT, 1)  # 1: the file can be read, but is not proved
        yield Case(f"{command}: {path} = {str(value)[:30]}", (command, "c.json"), codes, before=stored(path, value))
    for path, value in CLAIMS:
        name = f"check: {path} = {str(value)[:30]}"
        yield Case(name, ("check", "c.json"), (BUT, 1), before=stored(path, value))


def packed(**entries: bytes) -> Callable[[], None]:
    """Return a function that writes t.npz with these raw entries."""

    def change() -> None:
        with zipfile.ZipFile("t.npz", "w", zipfile.ZIP_DEFLATED) as archive:
            for name, content in entries.items():
                archive.writestr(f"{name}.npy", content)

    return change


def header(shape: str, kind: str = "<f8", rest: bytes = b"") -> bytes:
    text = f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}".encode().ljust(117) + b"\n"
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text + rest


def flipped(content: bytes) -> bytes:
    at = len(content) // 3
    return content[:at] + bytes([content[at] ^ 16]) + content[at + 1 :]


def bomb() -> None:
    """Write a small archive whose directory says that it unpacks to four gigabytes."""
    with zipfile.ZipFile("t.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("t.npy", header("(3,)", rest=bytes(24)))
    content = bytearray(Path("t.npz").read_bytes())
    at = content.index(b"PK\x01\x02") + 24
    content[at : at + 4] = (4_294_967_294).to_bytes(4, "little")
    put("t.npz", bytes(content))


n, t = 400, 1.2e-3 * np.arange(400)
x = 1e-3 * np.sin(400 * t)[:, None] * [1.0, 0.5]
uneven = t + 1e-4 * (np.arange(n) % 7)
holed = np.where(np.arange(n)[:, None] == 9, np.nan, x)
CHANGED = {
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
whole = np.zeros(3).tobytes()
NO_ARCHIVES = {
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


def traces() -> Iterator[Case]:
    """Yield malformed traces, traces that declare more than they hold, and data that no session could measure."""
    for (name, arrays), command in pairs(CHANGED.items(), ("trace", "replay")):
        change = lambda arrays=arrays: npz("t.npz", **arrays)  # noqa: E731
        fine = (BUT, 0) if command == "trace" and name in ("meta is a number", "one shorter") else (BUT,)
        yield Case(f"{command}: {name}", (command, "t.npz"), fine, before=change)
        if command == "trace" and name in ("a hole", "huge", "uneven", "complex"):
            yield Case(f"trace --plot: {name}", ("trace", "t.npz", "--plot", "a.png"), before=change)
    for (name, change), command in pairs(NO_ARCHIVES.items(), ("trace", "replay")):
        yield Case(f"{command}: {name}", (command, "t.npz"), says=r"t\.npz", before=change)


#: names that a typesetter, a terminal or a format string would interpret
STEERING = (
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
)


def names_in_pictures() -> Iterator[Case]:
    """Yield files and a scenario with names that a typesetter would interpret; a short run has every second one."""
    for name in STEERING[:: 1 + SHORT]:
        file = f"t{name}.npz".replace("/", "|")
        copied = lambda file=file: shutil.copy("t.npz", file)  # noqa: E731
        yield Case(f"picture of {name!r}", ("trace", file, "--plot", "a.png"), (0,), before=copied)
    name = "$a^$ \\U0001F600 \\u001b[31m [/b] [red]%s{}"
    run = ("run", "--case", "none", "--duration", "0.1", "--scenario", "s.toml", "--out", "new")
    yield Case(f"scenario called {name}", run, (0,), before=toml('"omega-pair"', f'"{name}"'))


def cases() -> Iterator[Case]:
    """Yield all cases of this file."""
    yield from scenarios()
    yield from humans_and_delays()
    yield from couplings()
    yield from traces()
    yield from names_in_pictures()
