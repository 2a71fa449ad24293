"""Cases of hostile.py with files that are malformed, overflow, or claim false proofs: scenarios, hands, traces, .."""

from __future__ import annotations

import re
import zipfile
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np
from hostile_cases import BUT, TEXT, Case, entries, npz, pairs, put, quick, stored, toml, written

with_T, LATE = partial(TEXT.replace, "T = 1.2e-3"), TEXT.replace("T = 1.2e-3", "T = 9")
#: name -> text of a file that is no scenario
NO_SCENARIOS = {
    "nested": "a = " + 900 * "[" + 900 * "]", "deeply nested": "a = " + 100_000 * "[",
    "tables in tables": "a = " + 900 * "{a = " + "1" + 900 * "}",
    "a long integer": TEXT.replace("theta = [1, 2]", f"theta = [1, {5000 * '9'}]"),
    "dotted": "a" + 100_000 * ".a" + " = 1", "dotted and quoted": '"a"' + 50_000 * '."a"' + " = 1",
    "dotted table": "[a" + 30_000 * ".a" + "]", "binary": b"\xff\xfe\x00", "empty": "", "only a comment": "# x",
    "a zero byte": TEXT.replace("omega", "om\0ega", 1), "too long": "# " + 3_000_000 * "x",
    "a byte order mark": "\ufeff" + TEXT, "a date": with_T("T = 2026-01-01"), "an infinite period": with_T("T = inf"),
    "a table twice": TEXT + "\n[environment]\n", "cut in half": TEXT[: len(TEXT) // 2],
    "no devices": TEXT.replace("[[device]]", "[[devise]]"),
    "a key with control characters": TEXT + '\n["\\u001b[31m"]\nx = 1\n',
    "a name with control characters": LATE.replace('"omega-pair"', '"\\u001b]0;x\\u0007"'),
    "a long name": TEXT.replace('"omega-pair"', f'"{1000 * "n"}"'),
    "a huge name": LATE.replace('"omega-pair"', f'"{1_000_000 * "n"}"'),
}  # fmt: skip
#: parts of the scenario; one of NUMBERS replaces the last number in the part
FIELDS = """stiffness = 800.0 | damping = 1.0 }, | masses = { mass = 1.0 } | motor_mass = 0.06 | handle_mass = 0.19
    transmission_stiffness = 14500 | force_limit = 12.0 | duration = 15.0 | mass = 0.3 | stiffness = 200.0
    amplitude = 0.015 | frequency = 0.6 | ease = 1.0 | force = 1.0 | start = 0.1 | theta = [1, 2] | psi = [0, 0]
    channel = 1"""
NUMBERS = ("1e300", "1e999", "-1.0", "nan", "-inf", '"x"', "[]", "true")
CONTACTS, PSI = 'contacts = ["contact 1", "contact 2"]', "psi = [0, 0]"
#: part of the scenario -> name -> what replaces it
NO_NETWORKS = {
    '["contact 1", "mass"]': {
        "to itself": '["mass", "mass"]', "one end": '["contact 1"]', "three ends": '["contact 1", "mass", "ground"]',
        "no name": '["", "mass"]',
    },
    CONTACTS: {
        "one contact twice": 'contacts = ["contact 1", "contact 1"]', "no contacts": "contacts = []",
        "a contact that is ground": 'contacts = ["ground", "contact 2"]',
    },
    "masses = { mass = 1.0 }": {
        "mass of the ground": "masses = { ground = 1.0 }",
        "mass of an unknown node": "masses = { mass = 1.0, moon = 7e22 }",
    },
    "links = [{ mass = 0.3, damping = 3.0, stiffness = 200.0 }]": {"no links": "links = []"},
    "links = [{": {"many links": "links = [" + 200 * "{ mass = 1.0, damping = 1.0, stiffness = 1.0 }, " + "{"},
    'kind = "compliant"': {"a kind of device": 'kind = "magic"'},
    "theta = [1, 2]": {"three delays": "theta = [1, 2, 3]", "a huge delay": "theta = [1, 1000000]"},
    PSI: {
        "lam above theta + psi": f"{PSI}\nlam = [9, 9]",
        "latency of two ticks": f"{PSI}\nlatency = [[0.0, 0.1], [0.0, 0.1]]",
        "latency backwards": f"{PSI}\nlatency = [[1e-3, 1e-4], [0.0, 1e-4]]", "T_max below T": f"{PSI}\nT_max = 1e-4",
    },
}  # fmt: skip
RANGES = ("[900.0, 700.0]", "[1.0, 2.0]", "[-1.0, 900.0]", "[nan, 900.0]", "[700.0, 1e300]", "[700.0]", "1.0")
DELAYS = (("[0]", "[2]"), ("[2, 2]", "[1, 1]"), ("[0, 0]", "[1000000, 3]"), ("[-1, 0]", "[2, 3]"), ("1", "2"))


def scenarios() -> Iterator[Case]:
    """Yield texts that are no scenario, or an impossible one."""

    def case(name: str, before: Callable, command: str = "audit", codes: tuple = (BUT,), says: str = "") -> Case:
        return Case(f"scenario: {name}", quick(command, "--scenario", "s.toml"), codes, says, before)

    for name, text in NO_SCENARIOS.items():
        yield case(name, written("s.toml", text), "run")
    for old, number in pairs(entries(FIELDS), NUMBERS, 3):
        if (old, number) != ("force = 1.0", "-1.0"):  # A negative force is allowed.
            before = toml(old, re.sub(r"[\d.]+(?=\D*$)", number, old))
            yield case(f"{old} -> {number}", before, says=old.split(" ")[0].removesuffix("es"))
    for old, news in NO_NETWORKS.items():
        for name, new in news.items():
            yield case(name, toml(old, new), codes=(0,) if name == "many links" else (BUT,))
    many = "springs = [\n" + 3000 * '{ between = ["mass", "ground"], stiffness = 1.0, damping = 1.0 },\n'
    yield case("thousands of springs", toml("springs = [\n", many), codes=(BUT, 1, 0))
    chain = "".join(f'{{ between = ["n{i}", "n{i + 1}"], stiffness = 1.0, damping = 1.0 }},\n' for i in range(1500))
    text = TEXT.replace("springs = [\n", 'springs = [\n{ between = ["mass", "n0"], stiffness = 1.0 },\n' + chain)
    text = text.replace("{ mass = 1.0 }", f"{{ mass = 1.0, {', '.join(f'n{i} = 1.0' for i in range(1501))} }}")
    for command in ("audit", "run"):
        yield case(f"a chain of 1500 masses, {command}", written("s.toml", text), command)
    for span in RANGES:
        ranges = f'\n[ranges]\nsprings = [{{ between = ["contact 1", "mass"], stiffness = {span} }}]\n'
        yield case(f"ranges {span}", written("s.toml", TEXT + ranges))
    for lo, hi in DELAYS:
        varying = f"\n[varying_delay]\nlo = {lo}\nhi = {hi}\n"
        yield case(f"varying_delay {lo} {hi}", written("s.toml", TEXT + varying), "run")


HUMAN = "[[human]]\nlinks = [{ mass = 0.3, damping = 3.0, stiffness = 200.0 }]\n"
HANDS = "class H:\n def port(self): {}\n def voluntary_force(self, t): return 0\nhumans = [H(), H()]"
#: file -> name -> its text: humans in TOML and in Python, and recorded delays
NO_PEOPLE = {
    "h.toml": {
        "one hand for two devices": HUMAN, "empty": "", "nested": "a = " + 2000 * "[",
        "a mass of nan": 2 * HUMAN.replace("0.3", "nan"), "an overflow": 2 * HUMAN.replace("200.0", "1e300"),
        "a person at unknown devices": 2 * HUMAN + "[[person]]\nholds = [7, 8]\n",
        "an unknown field": 2 * HUMAN.replace("mass", "mess"),
    },
    "h.py": {
        "no humans": "x = 1", "a mistake": "humans = (", "an exception": "1 / 0", "an exit": "raise SystemExit(0)",
        "no hand": "humans = [1, 2]", "no list": "humans = 7", "too long": "# " + 3_000_000 * "x",
        "a port that fails": HANDS.format("1 / 0"), "a port that is none": HANDS.format("return 5"),
    },
    "p.txt": {
        "empty": "", "a word": "1,2\n1,x\n", "three columns": "1,2,3\n", "a fraction": "1.5,2\n",
        "huge": "1,99999999999999999999\n", "negative": "-7,2\n", "binary": b"\xff\xff", "too long": 3_000_000 * "1",
    },
}  # fmt: skip


def humans_and_delays() -> Iterator[Case]:
    for file, texts in NO_PEOPLE.items():
        option = "--pattern" if file == "p.txt" else "--human"
        for name, text in texts.items():
            yield Case(f"{option} {file}: {name}", quick("run", option, file), before=written(file, text))


NO_COUPLINGS = {
    "empty": "", "blank": " \n", "binary": b"\xff\xfe", "nested": 100_000 * "[", "cut": '{"loop": {', "a list": "[]",
    "null": "null", "twice": '{"loop": 1, "loop": 2}', "an empty object": "{}",
    "too large": '{"a": "' + 50_000_000 * "x" + '"}',
}  # fmt: skip
#: entry of a stored coupling -> impossible values
ENTRIES = {
    "coupling.K": ([1e308, 1e308], [1e300, 300.0], [-400.0, 300.0], [0.0, 0.0], [], [1.0]),
    "coupling.B": ([1e308, 1e308], [-1.0, 0.1], "x"), "coupling.kind": ("magic",),
    "loop.T": (0.0, 1e300, -1.0), "loop.theta": ([1, -2], [1, 10**9], [1]), "loop.psi": ([0, 10**6],),
    "loop.delta": ([0.0, 0.0], [1e300, 1.0], []), "loop.environment.springs": ([],),
    "loop.environment.springs.0.stiffness": (1e300, -1.0), "loop.environment.springs.0.between": (["a", "a"],),
    "loop.environment.masses.mass": (1e300,), "loop.environment.contacts": ([],), "version": (99,),
}  # fmt: skip
LARGE = 40 * [40 * [f"1/{10**900}"]], 700 * [700 * ["1"]]
MATRICES = [], [["1/0"]], [["1"], ["1", "2"]], [["9" * 4000]], [["x"]], *LARGE
#: entry of a certificate -> false claims
CLAIMS = {
    "required": ([1e-9, 1e-9], [], [-1.0, -1.0]), "available": ([1e9, 1e9],), "margin": (1e9,), "proof": ("magic",),
    "condition": ("this-environment",), "guarantee": ("these ranges",), "seal": ("x",), "scenario": ("x",),
    "versions": ({},), "matrices": ({}, *({"P": matrix} for matrix in MATRICES)),
}  # fmt: skip


def couplings() -> Iterator[Case]:
    """Yield stored couplings that are malformed, overflow, or claim proofs that they do not have."""
    for command, (name, text) in pairs(("check", "export", "audit"), NO_COUPLINGS.items()):
        way = ("--coupling", "c.json") if command == "audit" else ("c.json",)
        yield Case(f"{command}: {name}", (command, *way), says=r"c\.json", before=written("c.json", text))
    twice = lambda: put("c.json", Path("c.json").read_text().replace('"K"', '"K": [1.0, 1.0], "K"', 1))  # noqa: E731
    yield Case("check: K twice", ("check", "c.json"), says="twice", before=twice)
    changes = [(path, value) for path, values in ENTRIES.items() for value in values]
    claims = [(f"certificate.{path}", value) for path, values in CLAIMS.items() for value in values]
    for command, (path, value) in (*pairs(("check", "export"), changes), *(("check", claim) for claim in claims)):
        codes = (BUT, 1)  # 1: the file can be read, but is not proved
        yield Case(f"{command}: {path} = {str(value)[:30]}", (command, "c.json"), codes, before=stored(path, value))


def packed(**arrays: bytes) -> Callable[[], None]:
    """Return a function that writes t.npz with these raw entries."""

    def change() -> None:
        with zipfile.ZipFile("t.npz", "w", zipfile.ZIP_DEFLATED) as archive:
            for name, content in arrays.items():
                archive.writestr(f"{name}.npy", content)

    return change


def header(shape: str, kind: str = "<f8", rest: bytes = b"") -> bytes:
    text = f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}".encode().ljust(117) + b"\n"
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text + rest


def changed(change: Callable[[bytes], bytes]) -> Callable[[], int]:
    """Return a function that changes the content of t.npz."""
    return lambda: put("t.npz", change(Path("t.npz").read_bytes()))


def bomb() -> None:
    """Write a small archive whose directory says that it unpacks to four gigabytes."""
    packed(t=header("(3,)", rest=bytes(24)))()
    content = Path("t.npz").read_bytes()
    at = content.index(b"PK\x01\x02") + 24
    put("t.npz", content[:at] + (4_294_967_294).to_bytes(4, "little") + content[at + 4 :])


n, t = 400, 1.2e-3 * np.arange(400)
x = 1e-3 * np.sin(400 * t)[:, None] * [1.0, 0.5]
META = {
    "meta is no JSON": "{", "meta is nested": 100_000 * "[", "meta is a number": 7,
    "steady ticks": '{"run": {"steady_ticks": [[0, 1000000]]}}',
    "steady ticks without end": '{"run": {"steady_ticks": [[0, 1e999]]}}',
    "steady words": '{"run": {"steady_ticks": "x"}}', "encoder step": '{"run": {"encoder_step_m": [1, 2, 3]}}',
    "encoder step nan": '{"run": {"encoder_step_m": [NaN, 1]}}',
}  # fmt: skip
#: name -> arrays of a trace that are replaced, or left out if None
CHANGED = {
    "no t": {"t": None}, "no meta": {"meta": None}, **{name: {"meta": np.array(text)} for name, text in META.items()},
    "uneven times": {"t": t + 1e-4 * (np.arange(n) % 7)}, "times backwards": {"t": t[::-1]}, "no time": {"t": 0 * t},
    "t is not finite": {"t": np.where(t > 0.1, np.inf, t)}, "complex": {"x": x + 0j}, "words": {"x": x.astype("U8")},
    "dates": {"t": np.arange(n).astype("M8[s]")}, "booleans": {"x": x > 0}, "huge": {"x": 1e300 * x},
    "near the largest float": {"x": np.full((n, 2), 1.7e308) * np.sign(x)},
    "a row of nan": {"x": np.where(np.arange(n)[:, None] == 9, np.nan, x)}, "inf": {"x": np.where(x > 0, np.inf, x)},
    "flat": {"x": x[:, 0]}, "three axes": {"x": x[None]}, "one shorter": {"x": x[:-1]},
    "no channels": {"x": x[:, :0], "f": x[:, :0]},
    "no ticks": {"t": t[:0], **dict.fromkeys(("x", "f", "x_handle", "v_handle"), x[:0]), "w": x[:0, :0]},
}  # fmt: skip
whole = np.zeros(3).tobytes()
#: name -> function that writes a t.npz that is no archive of arrays
NO_ARCHIVES = {
    "empty": written("t.npz", b""), "rubbish": written("t.npz", b"PK\x03\x04rubbish"),
    "text": written("t.npz", "t,x,f"), "one array": lambda: np.save(open("t.npz", "wb"), np.zeros(3)),  # noqa: SIM115
    "10^12 rows": packed(t=header("(1000000000000,)")),
    "10^12 rows in two arrays": packed(t=header("(1000000000000,)"), x=header("(1000000000000, 2)")),
    "negative": packed(t=header("(-3,)", rest=whole)), "objects": packed(t=header("(3,)", "|O", whole)),
    "a header that is none": packed(t=b"\x93NUMPY\x01\x00\xff\xff" + b"(" * 70_000),
    "another version": packed(t=b"\x93NUMPY\x09\x00" + whole), "a nested shape": packed(t=header("(" * 40 + ")" * 40)),
    "cut": changed(lambda old: old[:-200]),
    "one bit": changed(lambda old: old[: (at := len(old) // 3)] + bytes([old[at] ^ 16]) + old[at + 1 :]),
    "too much to unpack": bomb,
}  # fmt: skip


def traces() -> Iterator[Case]:
    """Yield malformed traces, traces that declare more than they hold, and data that no session could measure."""
    for (name, arrays), command in pairs(CHANGED.items(), ("trace", "replay")):
        change = lambda arrays=arrays: npz("t.npz", **arrays)  # noqa: E731
        fine = (BUT, 0) if command == "trace" and name in ("meta is a number", "one shorter") else (BUT,)
        yield Case(f"{command}: {name}", (command, "t.npz"), fine, before=change)
        if command == "trace" and name in ("a row of nan", "huge", "uneven times", "complex"):
            yield Case(f"trace --plot: {name}", ("trace", "t.npz", "--plot", "a.png"), before=change)
    for (name, change), command in pairs(NO_ARCHIVES.items(), ("trace", "replay")):
        yield Case(f"{command}: {name}", (command, "t.npz"), says=r"t\.npz", before=change)


def cases() -> Iterator[Case]:
    for part in (scenarios, humans_and_delays, couplings, traces):
        yield from part()
