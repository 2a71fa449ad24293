"""make mutate: do the tests notice when a line that verdicts rest on is wrong?

Small mistakes are made, one at a time, in the exact layer, the conditions, certificates, the process, the limits and
the device's state machine: a comparison turned, a sign, a constant, a refusal left out, `max` for `min`. Tests that
call the changed function run, the quick ones first, until one fails: the mutant is killed. A process that has collected
the tests is forked for each, and the changed function gets its new code there. Which mistakes are drawn follows from
the seed alone. Those that no test notices are judged in mutate.survivors.md: a survivor that is not there, or a score
below the goal, fails the run.

    python tests/mutate.py [--only design/exact.py] [--count 40] [--seed 0] [--jobs 2]
"""

from __future__ import annotations

import argparse
import ast
import builtins
import contextlib
import copy
import hashlib
import importlib
import io
import itertools
import os
import pickle
import resource
import signal
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from types import CodeType, FunctionType, ModuleType
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[1]
JUDGED = ROOT / "tests/mutate.survivors.md"
GOAL = 0.95
#: module -> the files of tests that are about it
TABLE = {
    "design/exact.py": "design/test_exact design/test_exact_blocks",
    "design/certificate.py": "design/test_certificate design/test_exact_blocks design/test_switching_file "
    "design/test_limiter design/test_walls_making",
    "design/conditions.py": "design/test_exact_blocks design/test_margin design/test_latency design/test_encoder_steps "
    "design/test_moving_average",
    "controller/tick.py": "controller/test_tick controller/test_walls controller/test_varying_delay "
    "controller/test_limiter controller/test_budget sim/test_switched sim/test_passivity_layer sim/test_engines "
    "sim/test_limited",
    "controller/complementarity.py": "controller/test_tick controller/test_walls controller/test_limiter",
    "controller/law.py": "controller/test_limiter controller/test_tick controller/test_walls",
    "hw/limits.py": "hw/test_limits",
    "hw/device_state.py": "hw/test_device hw/test_latch_on_arrival",
}
_ENOUGH = 6.0  # [s] of CPU that the tests of one mutant may take when nothing is wrong; the quickest are taken
_TIMEOUT = 3.0  # times as long, and some seconds, end a mutant

_COMPARISONS = {
    ast.Lt: (ast.LtE, ast.GtE), ast.LtE: (ast.Lt, ast.Gt), ast.Gt: (ast.GtE, ast.LtE), ast.GtE: (ast.Gt, ast.Lt),
    ast.Eq: (ast.NotEq,), ast.NotEq: (ast.Eq,), ast.Is: (ast.IsNot,), ast.IsNot: (ast.Is,),
    ast.In: (ast.NotIn,), ast.NotIn: (ast.In,),
}  # fmt: skip
_OPERATORS = {
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.FloorDiv: ast.Mult, ast.Mod: ast.Mult,
    ast.Pow: ast.Mult, ast.LShift: ast.RShift, ast.RShift: ast.LShift, ast.BitAnd: ast.BitOr, ast.BitOr: ast.BitAnd,
}  # fmt: skip
_NAMES = {"min": "max", "any": "all", "argmin": "argmax", "minimum": "maximum", "floor": "ceil", "zeros": "ones"}
_NAMES |= {other: one for one, other in _NAMES.items()}
_DROPPED = {"abs", "conj", "sqrt", "frozen", "reduced"}  # calls that may be left out around their argument


# ----------------------------------------------------------------------------------------------------
# Mutants.


@dataclass(frozen=True)
class Mutant:
    """One small mistake. `place` is the number of its node in the module's tree."""

    module: str
    function: str  # the qualified name of the outermost function, or of a constant of the module
    place: int
    kind: int  # of several that one node allows
    line: int
    was: str
    now: str

    @property
    def key(self) -> str:
        """What survivors are judged by, whatever line it is."""
        return f"{self.module} {self.function}: `{self.was}` -> `{self.now}`"


def _changed(node: ast.AST, returns: str | None) -> Iterator[ast.AST | None]:
    """Every mistake that is made at a node: what stands in its place, None where nothing does."""
    new = copy.copy(node)
    match node:
        case ast.Compare(ops=[op]):
            for other in _COMPARISONS[type(op)]:
                yield ast.Compare(node.left, [other()], node.comparators)
        case ast.BinOp(op=op) if type(op) in _OPERATORS:
            yield ast.BinOp(node.left, _OPERATORS[type(op)](), node.right)
        case ast.AugAssign(op=op) if type(op) in _OPERATORS:
            yield ast.AugAssign(node.target, _OPERATORS[type(op)](), node.value)
            yield None
        case ast.BoolOp(op=op):
            yield ast.BoolOp(ast.Or() if isinstance(op, ast.And) else ast.And(), node.values)
        case ast.UnaryOp(op=ast.Not() | ast.USub()):
            yield node.operand
        case ast.Constant(value=bool(value)):
            yield ast.Constant(not value)
        case ast.Constant(value=int(value)):
            yield ast.Constant(value + 1)
        case ast.Constant(value=float(value)) if 0 < value < float("inf"):  # most small ones are tolerances
            yield ast.Constant(1000 * value if value < 1e-2 else 2 * value)
        case ast.Name(id=name) | ast.Attribute(attr=name) if name in _NAMES:
            setattr(new, "id" if isinstance(node, ast.Name) else "attr", _NAMES[name])
            yield new
        case ast.Attribute(attr="T"):
            yield node.value
        case ast.Call(func=ast.Name(id=name) | ast.Attribute(attr=name), args=[one]) if name in _DROPPED:
            yield one
        case ast.If() | ast.While():
            for value in (True, False):
                new = copy.copy(node)
                new.test = ast.Constant(value)
                yield new
        case ast.IfExp():
            yield node.body
            yield node.orelse
        case ast.Raise() | ast.Continue() | ast.Break() | ast.Expr(value=ast.Call()):
            yield None
        case ast.Return(value=ast.expr()) if returns == "bool":
            yield ast.Return(ast.Constant(True))
            yield ast.Return(ast.Constant(False))
        case ast.Return(value=ast.expr()) if returns == "str | None" and not _is_none(node.value):
            yield ast.Return(ast.Constant(None))


def _is_none(node: ast.AST | None) -> bool:
    return isinstance(node, ast.Constant) and node.value is None


def mutants(module: str) -> list[Mutant]:
    """Every mistake that can be made in a module, in the order of its tree."""
    tree = ast.parse((ROOT / module).read_text())
    number = {id(node): i for i, node in enumerate(ast.walk(tree))}
    found: list[Mutant] = []

    def look(node: ast.AST, function: str, returns: str | None) -> None:
        if isinstance(node, ast.JoinedStr | ast.Assert):  # words, and what types are told
            return
        if function:
            for kind, other in enumerate(_changed(node, returns)):
                was, now = (_shown(one) for one in (node, other))
                found.append(Mutant(module, function, number[id(node)], kind, node.lineno, was, now))  # type: ignore[attr-defined]
        for child in _inside(node):
            look(child, function, returns)

    def inside(body: Sequence[ast.stmt], name: str) -> None:
        for node in body:
            match node:
                case ast.ClassDef():
                    inside(node.body, f"{name}{node.name}.")
                case ast.FunctionDef():
                    returns = ast.unparse(node.returns) if node.returns else None
                    for statement in node.body:
                        look(statement, name + node.name, returns)
                case ast.Assign(targets=[ast.Name(id=constant)]) | ast.AnnAssign(target=ast.Name(id=constant)) if (
                    not name
                ):
                    if node.value:
                        look(node.value, constant, None)

    inside(tree.body, "")
    return found


def _inside(node: ast.AST) -> Iterator[ast.AST]:
    """The parts of a node that run, without annotations and defaults."""
    if isinstance(node, ast.FunctionDef):
        yield from node.body
    elif isinstance(node, ast.AnnAssign):
        yield from (part for part in (node.target, node.value) if part)
    elif isinstance(node, ast.Call) and ast.unparse(node.func).split(".")[-1] in ("TypeVar", "cast"):
        return
    else:
        yield from ast.iter_child_nodes(node)


def _shown(node: ast.AST | None) -> str:
    text = "nothing" if node is None else ast.unparse(node).partition("\n")[0]
    return " ".join(text.split())[:100]


class _Replace(ast.NodeTransformer):
    def __init__(self, old: ast.AST, new: ast.AST | None) -> None:
        self.old, self.new = old, new

    def visit(self, node: ast.AST) -> Any:
        if node is not self.old:
            return self.generic_visit(node)
        new = self.new if self.new is not None else ast.Pass()
        return ast.copy_location(new, node)


def mutated(mutant: Mutant) -> CodeType:
    """The code of the module with the mistake in it."""
    path = ROOT / mutant.module
    tree = ast.parse(path.read_text())
    node = next(n for i, n in enumerate(ast.walk(tree)) if i == mutant.place)
    returns = _returns(tree, node)
    new = next(other for kind, other in enumerate(_changed(node, returns)) if kind == mutant.kind)
    return compile(ast.fix_missing_locations(_Replace(node, new).visit(tree)), str(path), "exec")


def _returns(tree: ast.Module, node: ast.AST) -> str | None:
    """How the innermost of the outermost functions around a node is annotated."""
    for function in ast.walk(tree):
        if isinstance(function, ast.FunctionDef) and any(node is part for part in ast.walk(function)):
            return ast.unparse(function.returns) if function.returns else None
    return None


def install(mutant: Mutant) -> None:
    """Give the function its wrong code wherever it is known, or the constant its wrong value."""
    module = _module(mutant)
    code = mutated(mutant)
    target = _function(module, mutant.function)
    if target is not None:
        target.__code__ = next(c for c in _codes(code) if c.co_qualname == mutant.function)
        return
    namespace: dict[str, Any] = {"__name__": module.__name__}
    exec(code, namespace)
    old = getattr(module, mutant.function)
    for other in list(sys.modules.values()):
        if isinstance(other, ModuleType) and other.__dict__.get(mutant.function) is old:
            setattr(other, mutant.function, namespace[mutant.function])


def telling(module: str) -> None:
    """Make every function of a module say that it is called."""
    tree, loaded = ast.parse((ROOT / module).read_text()), importlib.import_module(_name(module))
    names = []

    def inside(body: Sequence[ast.stmt], name: str) -> None:
        for node in body:
            if isinstance(node, ast.ClassDef):
                inside(node.body, f"{name}{node.name}.")
            elif isinstance(node, ast.FunctionDef):
                names.append(name + node.name)
                node.body.insert(0, ast.parse(f"__seen__({names[-1]!r})").body[0])

    inside(tree.body, "")
    codes = {c.co_qualname: c for c in _codes(compile(ast.fix_missing_locations(tree), module, "exec"))}
    for name in names:
        if function := _function(loaded, name):
            function.__code__ = codes[name]


def _name(module: str) -> str:
    return module.removesuffix(".py").replace("/", ".")


def _module(mutant: Mutant) -> ModuleType:
    return importlib.import_module(_name(mutant.module))


def _function(module: ModuleType, name: str) -> FunctionType | None:
    """The function behind whatever decorates it; None for what is none."""
    *classes, last = name.split(".")
    owner: Any = module
    for part in classes:
        owner = getattr(owner, part)
    found = vars(owner)[last]
    if isinstance(found, property):
        found = found.fget
    elif isinstance(found, cached_property):
        found = found.func
    found = getattr(found, "__func__", found)
    while hasattr(found, "__wrapped__"):
        found = found.__wrapped__
    return found if isinstance(found, FunctionType) else None


def _codes(code: CodeType) -> Iterator[CodeType]:
    for part in code.co_consts:
        if isinstance(part, CodeType):
            yield part
            yield from _codes(part)


# ----------------------------------------------------------------------------------------------------
# Running the tests in forks of a process that has collected them.


@dataclass(frozen=True)
class Outcome:
    mutant: Mutant
    end: str  # killed | timeout | survived
    by: str  # the test that failed, or how many passed


class _Runner:
    """A pytest plugin that takes the place of its loop."""

    def __init__(self, module: str, drawn: Sequence[Mutant], jobs: int) -> None:
        self.module, self.drawn, self.jobs = module, drawn, jobs
        self.outcomes: list[Outcome] = []
        self.trouble, self.calling = "", False

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        seconds, calls, failed = _forked(lambda: self._learn(session))()
        if failed:
            self.trouble = f"fails without any mutant: {failed}"
            return True
        waiting: list[tuple[Mutant, Callable[[], Any]]] = []
        for mutant in self.drawn:
            chosen, total, users = [], 0.0, _users(mutant)
            for item in sorted(session.items, key=lambda item: seconds[item.nodeid]):
                if calls[item.nodeid] & users and total + seconds[item.nodeid] < _ENOUGH:
                    chosen.append(item)
                    total += seconds[item.nodeid]
            if len(waiting) >= self.jobs:
                self._take(waiting)
            waiting.append((mutant, _forked(partial(self._try, mutant, chosen, total))))
        while waiting:
            self._take(waiting)
        return True

    def _take(self, waiting: list[tuple[Mutant, Callable[[], Any]]]) -> None:
        mutant, result = waiting.pop(0)
        end, by = result() or ("timeout", "")
        self.outcomes.append(Outcome(mutant, end, by))
        print(f"{end:9} {mutant.key}  [{mutant.line}] {by}", flush=True)

    def _learn(self, session: pytest.Session) -> tuple[dict[str, float], dict[str, set[str]], str]:
        """CPU seconds of every test, the functions of the module that it calls, and the first that fails."""
        calls: dict[str, set[str]] = defaultdict(set)
        seconds: dict[str, float] = {}
        item: Any = None

        def seen(function: str) -> None:
            calls[item.nodeid if self.calling else item.nodeid.partition("::")[0]].add(function)

        builtins.__seen__ = seen  # type: ignore[attr-defined]
        telling(self.module)
        for item, after in itertools.pairwise([*session.items, None]):
            begin = time.process_time()
            if failed := _fails(item, after):
                return {}, {}, failed
            seconds[item.nodeid] = time.process_time() - begin
        # fixtures are made by the first test that asks for them, for all of its file
        return seconds, {n: calls[n] | calls[n.partition("::")[0]] for n in seconds}, ""

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_call(self, item: pytest.Item) -> Iterator[None]:
        self.calling = True
        try:
            return (yield)
        finally:
            self.calling = False

    def _try(self, mutant: Mutant, chosen: list[Any], seconds: float) -> tuple[str, str]:
        resource.setrlimit(resource.RLIMIT_CPU, (int(_TIMEOUT * seconds + 15), resource.RLIM_INFINITY))
        resource.setrlimit(resource.RLIMIT_AS, (4 << 30, resource.RLIM_INFINITY))
        try:
            install(mutant)
        except Exception as error:
            return "broken", repr(error)
        for item, after in itertools.pairwise([*chosen, None]):
            if name := _fails(item, after):
                return "killed", name
        return "survived", f"{len(chosen)} tests"


def _users(mutant: Mutant) -> set[str]:
    """The function itself, or those that name the constant."""
    module = _module(mutant)
    if _function(module, mutant.function):
        return {mutant.function}
    code = compile((ROOT / mutant.module).read_text(), "", "exec")
    return {c.co_qualname.partition(".<locals>")[0] for c in _codes(code) if mutant.function in c.co_names}


def _fails(item: pytest.Item, after: pytest.Item | None) -> str:
    """The name of a test that fails, '' of one that passes or is skipped."""
    from _pytest.runner import runtestprotocol

    reports = runtestprotocol(item, nextitem=after, log=False)
    return item.nodeid.removeprefix("tests/") if any(report.failed for report in reports) else ""


def _forked(work: Callable[[], Any]) -> Callable[[], Any]:
    """Begin the work in a fork; what comes back waits for it, and gives None where it was killed."""
    read, write = os.pipe()
    if not (pid := os.fork()):
        os.close(read)
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, 1)
        os.dup2(nowhere, 2)
        try:
            with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
                result = work()
        except BaseException as error:  # a mutant may do anything
            result = ("killed", f"{type(error).__name__}: {error}")
        with os.fdopen(write, "wb") as out:
            pickle.dump(result, out)
        os._exit(0)
    os.close(write)

    def wait() -> Any:
        with os.fdopen(read, "rb") as source:
            data = source.read()
        os.waitpid(pid, 0)
        return pickle.loads(data) if data else None

    return wait


def outcomes_of(module: str, count: int, seed: int, jobs: int) -> list[Outcome]:
    """The fate of `count` mutants of a module."""
    all_of_them = mutants(module)
    # by what they are, so that a change of one line leaves the others drawn
    drawn = sorted(all_of_them, key=lambda m: hashlib.sha256(f"{seed} {m.key}".encode()).digest())[:count]
    runner = _Runner(module, sorted(drawn, key=lambda m: (m.place, m.kind)), jobs)
    files = [str(ROOT / "tests" / f"{name}.py") for name in TABLE[module].split()]
    pytest.main([*files, "-q", "-p", "no:cacheprovider", "-p", "no:xdist", "--no-header", "--no-summary"], [runner])
    if runner.trouble or len(runner.outcomes) < len(drawn):
        sys.exit(f"{module}: {runner.trouble or 'its tests did not run'}")
    return runner.outcomes


# ----------------------------------------------------------------------------------------------------
# The command.


def judged() -> set[str]:
    """The survivors that somebody has looked at: list items that begin with their keys."""
    items = (line[2:] for line in JUDGED.read_text().splitlines() if line.startswith("- "))
    return {item.partition("  ")[0].strip() for item in items}


def main() -> int:
    parser = argparse.ArgumentParser(description="Do the tests notice small mistakes in what verdicts rest on?")
    parser.add_argument("--only", default=",".join(TABLE), help="modules, by commas")
    parser.add_argument("--count", type=int, default=40, help="mutants of each module (default 40)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    args = parser.parse_args()
    begin, rows, open_ones, known = time.monotonic(), [], [], judged()
    for module in args.only.split(","):
        found = outcomes_of(module, args.count, args.seed, args.jobs)
        survived = [o.mutant for o in found if o.end == "survived"]
        accepted = [m for m in survived if m.key in known]
        open_ones += [m for m in survived if m.key not in known]
        ends = [sum(o.end == end for o in found) for end in ("killed", "timeout", "survived")]
        rows.append((module, len(found), *ends, len(accepted)))
    print(f"\n{'module':24}{'mutants':>8}{'killed':>8}{'timeout':>8}{'survived':>9}{'judged':>8}  score")
    totals = ("together", *(sum(row[i] for row in rows) for i in range(1, 6)))
    for name, n, killed, late, survived, fine in (*rows, totals):
        print(f"{name:24}{n:8}{killed:8}{late:8}{survived:9}{fine:8}  {(killed + late) / max(n - fine, 1):.1%}")
    print(f"seed {args.seed}, {time.monotonic() - begin:.0f} s; a timeout counts as killed, the judged are not counted")
    for mutant in open_ones:
        print(f"survived, not judged: {mutant.key}  [line {mutant.line}]")
    score = (totals[2] + totals[3]) / max(totals[1] - totals[5], 1)
    return 0 if not open_ones and score >= GOAL else 1


if __name__ == "__main__":
    sys.exit(main())
