"""Options that cannot be, options that do not go together, and people of Python who do harm: cases for hostile.py."""

from collections.abc import Iterator

#: every one is refused, whatever its command would do else
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
        --no-limiter --energy-budget x | --human h.py --vertex 3""",
    "validate": """--resume | --environments ranges | --dask x
        --dask h:1 --shards 2 | --generations 5 | --links 3 | --humans 0 | --humans 1e3 | --shards 0
        --duration 1e-9 | --duration -1 | --latency 2e-3 | --T-max 1e-4 | --period 1e-3""",
    "design": """--ranges 0 | --ranges -5 | --ranges 101% | --ranges 1e9 | --ranges 10%% | --samples 5
        --ranges 10 --varying-delay 0,2 | --limiter --no-limiter | --best --coupling ccl | --best --order 2
        --method inner | --compare | --objective sup | --order 0 --coupling ccl
        --order 1e9 --coupling ccl | --high-gain 0 | --high-gain 2 | --seconds -1 --best | --band 1,0 --best
        --latency 1e-3 --varying-delay 0,2""",
    "audit": """--device nix | --devices --K 5 | --rigid | --rigid --K 5 --B 0 --theta 1,2 | --rigid --K 5 --B 0 --psi 1
        --rigid --K 0 --B 0 | --rigid --K 1e300 --B 0 | --K 1,2,3 --B 0 | --K 1,2 --B 0,0,0 | --K -1,2 --B 0
        --rigid --K 5 --B 0 --T-max 1e-9 | --K 1,2 --B 0 --coupling c.json""",
    "bridge": """--fault nonsense | --fault drop=2 | --fault drop=nan | --fault drop@-1 | --fault drop=0.1@1+-1
        --fault axis9:jump | --fault axis3:jump | --fault up:jump | --fault jump=1e9 | --fault stall=99
        --fault leap=0 | --fault period=0 | --fault = | --fault '' | --quantile 0 | --quantile 1.01 | --guard -1
        --guard 1e9 | --measure 0 | --measure 1e9 | --force-cap 0 | --force-cap 13 | --max-speed 0
        --energy-budget -1 | --pace 0 | --pace 1e-9 | --baud -1 | --continuous-force 0
        --continuous-force 13 | --continuous-force 1,2,3 | --thermal-time 0 | --T 0.05 | --T 1e-6
        --varying-delay 0,2 | --port nix | --emulate | --duration -1""",
    "identify": """--force 0 | --force 100 | --force -1 | --band 200,3 | --band 0,0 | --band 1,1e9 | --band 3
        --seconds 0 | --seconds 1e9 | --coulomb -1 | --coulomb 100 | --fault axis9:jump | --pace 0 | --T 0.05
        --port nix | --measure 0 | --quantile 2""",
    "zwidth": """--coupling nix | --K-range 5,1 | --B-range -1,5 | --grid 1 | --rigid --theta 1,2
        --mark 1 | --mark 1,2,3 | --points -1 | --velocity-filter 0""",
    "emulator": "--fault axis9:jump | --fault drop=-1 | --coulomb -1 | --pace 0 | --parent 1 | --duration -1",
}
HUMANS = """from models.human import Human, Link
humans = [Human((Link(0.3, 3.0, 200.0),))] * 2
"""
_PORT = """from models.human import *
class Hand:
    def port(self): {}
    def voluntary_force(self, t): {}
humans = [Hand()] * 2
"""
_GOOD = "return Human((Link(.3, 3., 200.),)).port()"
_DRAWS = HUMANS + "class P:\n    def draw(self, rng, n): {}\npopulation = P()\n"
#: how the file says it, and whether it may be taken for one of people
PEOPLE = {
    "ends": "raise SystemExit(0)",
    "interrupts": "raise KeyboardInterrupt",
    "no syntax": "humans = [",
    "a number": "humans = 5",
    "strings": "humans = ['a', 'b']",
    "one": HUMANS.replace("* 2", ""),
    "a port that is none": _PORT.format("return None", "return 0 * t"),
    "a port that raises": _PORT.format("raise RuntimeError('\\x1b[2J' * 500)", "return 0 * t"),
    "a force that raises": _PORT.format(_GOOD, "raise OSError(28, 'no')"),
    "a force of another shape": _PORT.format(_GOOD, "return [[1.0]]"),
    "a force that is no number": _PORT.format(_GOOD, "return t / 0"),
    "a force of words": _PORT.format(_GOOD, "return ['x'] * len(t)"),
    "nobody drawn": _DRAWS.format("return []"),
    "drawing that raises": _DRAWS.format("1 / 0"),
    "numbers drawn": _DRAWS.format("return [1] * n"),
    "a population that is none": HUMANS + "population = 7\n",
    "persons that are none": HUMANS + "persons = [1]\n",
    "endless recursion": "def f(): f()\nf()\n",
    "memory": "raise MemoryError",
    "control characters": "print('\\x1b[31mred')\n" + HUMANS,
    "output that is closed": "import sys\nsys.stdout.close()\n" + HUMANS,
}


def combined() -> Iterator[tuple[str, str, tuple[int, ...], str]]:
    """(command, words, codes it may end with, the people in h.py)."""
    for command, lines in REFUSED.items():
        for line in lines.splitlines():
            yield from ((command, words.strip(), (2,), HUMANS) for words in line.split("|"))
    for name, text in PEOPLE.items():
        for command in ("run", "validate"):
            yield command, f"--human h.py --seed {len(name)}", (0, 1, 2, 130), text
