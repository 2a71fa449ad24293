"""For mutate.py: the small mistakes that it makes in a module, and how a process gets one of them."""

from __future__ import annotations

import ast
import copy
import importlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import CodeType, FunctionType
from typing import Any

ROOT = Path(__file__).resolve().parents[2]

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
_DROPPED = {"abs", "conj", "sqrt", "frozen", "reduced"}  # A mistake replaces a call of these functions by its argument.


@dataclass(frozen=True)
class Mutant:
    """One small mistake. `place` is the number of its node in the module's tree."""

    module: str
    function: str  # qualified name
    place: int
    kind: int  # index of the mistake in the list of mistakes for this node
    line: int
    was: str
    now: str

    @property
    def key(self) -> str:
        """The name of the mutant in mutate.survivors.md, without a line number."""
        return f"{self.module} {self.function}: `{self.was}` -> `{self.now}`"


def _changed(node: ast.AST, returns: str | None) -> Iterator[ast.AST | None]:
    """Yield the nodes that replace a node, one for each mistake; None leaves the statement out."""
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
        case ast.Constant(value=float(value)) if 0 < value < float("inf"):  # Most numbers below 0.01 are tolerances.
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
        case ast.Return(value=ast.expr()) if returns == "str | None" and ast.unparse(node.value) != "None":
            yield ast.Return(ast.Constant(None))


def _functions(body: Sequence[ast.stmt], prefix: str = "") -> Iterator[tuple[str, ast.FunctionDef]]:
    """Yield the functions and methods of a module, with their qualified names."""
    for node in body:
        if isinstance(node, ast.ClassDef):
            yield from _functions(node.body, f"{prefix}{node.name}.")
        elif isinstance(node, ast.FunctionDef):
            yield prefix + node.name, node


def _parts(node: ast.AST) -> Iterator[ast.AST]:
    """Yield a node and the nodes below it that run: no annotations, defaults, messages and assertions."""
    if isinstance(node, ast.JoinedStr | ast.Assert):
        return
    yield node
    children: Any = ast.iter_child_nodes(node)
    if isinstance(node, ast.FunctionDef):
        children = node.body
    elif isinstance(node, ast.AnnAssign):
        children = [part for part in (node.target, node.value) if part]
    for child in children:
        yield from _parts(child)


def _shown(node: ast.AST | None) -> str:
    text = "nothing" if node is None else ast.unparse(node).partition("\n")[0]
    return " ".join(text.split())[:100]


def mistakes(module: str) -> Iterator[tuple[Mutant, ast.Module, ast.AST, ast.AST | None]]:
    """Yield every mutant of a module with the module's tree, the node and its replacement."""
    tree = ast.parse((ROOT / module).read_text())
    number = {id(node): i for i, node in enumerate(ast.walk(tree))}
    for name, function in _functions(tree.body):
        returns = ast.unparse(function.returns) if function.returns else None
        for node in (part for statement in function.body for part in _parts(statement)):
            for kind, new in enumerate(_changed(node, returns)):
                place = number[id(node)], kind, getattr(node, "lineno", 0)
                yield Mutant(module, name, *place, _shown(node), _shown(new)), tree, node, new


class _Replace(ast.NodeTransformer):
    def __init__(self, old: ast.AST, new: ast.AST | None) -> None:
        self.old, self.new = old, new

    def visit(self, node: ast.AST) -> Any:
        return ast.copy_location(self.new or ast.Pass(), node) if node is self.old else self.generic_visit(node)


def install(mutant: Mutant) -> None:
    """Put the code with the mistake into the function that this process has imported."""
    tree, node, new = next(rest for other, *rest in mistakes(mutant.module) if other == mutant)
    code = compile(ast.fix_missing_locations(_Replace(node, new).visit(tree)), str(ROOT / mutant.module), "exec")
    function: Any = importlib.import_module("haptic_loop." + mutant.module.removesuffix(".py").replace("/", "."))
    for part in mutant.function.split("."):
        function = vars(function)[part]
    if isinstance(function, property | cached_property):
        function = function.fget if isinstance(function, property) else function.func
    function = getattr(function, "__func__", function)
    while hasattr(function, "__wrapped__"):
        function = function.__wrapped__
    assert isinstance(function, FunctionType)
    function.__code__ = next(part for part in _codes(code) if part.co_qualname == mutant.function)


def _codes(code: CodeType) -> Iterator[CodeType]:
    for part in code.co_consts:
        if isinstance(part, CodeType):
            yield part
            yield from _codes(part)
