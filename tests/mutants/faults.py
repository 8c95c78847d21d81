"""Faults of one node: every one that a module may be given, a repeatable draw, the faulty text.

A fault replaces one expression within a function: another comparison, `and` for `or`, `+` for `-`,
another number or truth value, a condition or a sign the other way round, `max` for `min`, a
function that returns None, a call that is left out.  Texts, annotations, default values, logging,
assertions, the `strict` of `zip` and what a module or a class holds stay as they are.
"""

import ast
import copy
import hashlib
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

COMPARED: dict[type[ast.cmpop], tuple[type[ast.cmpop], ...]] = {
    ast.Lt: (ast.LtE, ast.GtE),
    ast.LtE: (ast.Lt, ast.Gt),
    ast.Gt: (ast.GtE, ast.LtE),
    ast.GtE: (ast.Gt, ast.Lt),
    ast.Eq: (ast.NotEq,),
    ast.NotEq: (ast.Eq,),
    ast.Is: (ast.IsNot,),
    ast.IsNot: (ast.Is,),
    ast.In: (ast.NotIn,),
    ast.NotIn: (ast.In,),
}
CALCULATED: dict[type[ast.operator], type[ast.operator]] = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.FloorDiv: ast.Mult,
    ast.Mod: ast.FloorDiv,
    ast.Pow: ast.Mult,
}
CALLED = {"min": "max", "max": "min", "any": "all", "all": "any"}
LOGGERS = {"log", "logging"}


@dataclass(frozen=True)
class Fault:
    """One node's text in a file, and the text that replaces it."""

    file: str
    function: str
    old: str
    new: str
    line: int
    begin: int
    end: int
    """From which byte of the file to which one the old text lies."""

    def __str__(self) -> str:
        return f"{self.file}:{self.line} {self.function}: {_short(self.old)} -> {_short(self.new)}"

    @property
    def identity(self) -> tuple[str, str, str, str]:
        """What it is called in the list of faults that change nothing; lines move."""
        return self.file, self.function, " ".join(self.old.split()), " ".join(self.new.split())

    def to_json(self) -> dict[str, object]:
        return asdict(self)


def draw(
    root: Path,
    areas: Mapping[str, Sequence[str]],
    seed: int,
    count: int,
    left_out: Collection[tuple[str, str, str, str]] = (),
) -> list[Fault]:
    """Faults of the areas in turn (each is folders or files), none within another.

    Their order depends on the seed and on each fault's own text: an edit elsewhere moves none.
    """
    ranked = [_ranked(root, paths, seed) for paths in areas.values()]
    drawn: list[Fault] = []
    while len(drawn) < count and any(ranked):
        for faults in ranked:
            while faults and len(drawn) < count:
                fault = faults.pop()
                if fault.identity not in left_out and not any(_overlap(fault, d) for d in drawn):
                    drawn.append(fault)
                    break
    return drawn


def _ranked(root: Path, paths: Sequence[str], seed: int) -> list[Fault]:
    places = [root / path for path in paths]
    files = {f for place in places for f in (place.rglob("*.py") if place.is_dir() else [place])}
    faults = [fault for file in sorted(files) for fault in faults_of(root, file)]
    times: dict[tuple[str, ...], int] = {}
    rank = {}
    for fault in faults:
        # The same fault may stand in one function twice.
        times[fault.identity] = times.get(fault.identity, 0) + 1
        key = repr((seed, fault.identity, times[fault.identity]))
        rank[fault] = hashlib.sha256(key.encode()).digest()
    return sorted(faults, key=rank.__getitem__)


def _overlap(one: Fault, other: Fault) -> bool:
    return one.file == other.file and one.begin < other.end and other.begin < one.end


def faults_of(root: Path, file: Path) -> list[Fault]:
    """Every fault that a module may be given."""
    text = file.read_bytes()
    finder = _Finder(file.relative_to(root).as_posix(), text)
    finder.visit(ast.parse(text))
    return finder.faults


def replaced(text: bytes, faults: Mapping[int, Fault], wrapped: str) -> bytes:
    """The text of a module with some of its faults, by number; none lies within another.

    `wrapped` has `{number}`, `{new}` and `{old}`.
    """
    for number, fault in sorted(faults.items(), key=lambda pair: -pair[1].begin):
        new = wrapped.format(number=number, new=fault.new, old=fault.old).encode()
        text = text[: fault.begin] + new + text[fault.end :]
    return text


class _Finder(ast.NodeVisitor):
    def __init__(self, file: str, text: bytes) -> None:
        self._file, self._text = file, text
        self._lines = [0]
        for line in text.splitlines(keepends=True):
            self._lines.append(self._lines[-1] + len(line))
        self._names: list[str] = []
        self._functions = 0
        self.faults: list[Fault] = []

    def _add(self, node: ast.expr, new: ast.expr) -> None:
        assert node.end_lineno is not None
        assert node.end_col_offset is not None
        begin = self._lines[node.lineno - 1] + node.col_offset
        end = self._lines[node.end_lineno - 1] + node.end_col_offset
        names, old = ".".join(self._names), self._text[begin:end].decode()
        self.faults.append(Fault(self._file, names, old, ast.unparse(new), node.lineno, begin, end))

    def visit(self, node: ast.AST) -> None:
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            self._names.append(node.name)
            self._functions += not isinstance(node, ast.ClassDef)
            for statement in node.body:
                self.visit(statement)
            self._functions -= not isinstance(node, ast.ClassDef)
            self._names.pop()
        elif isinstance(node, ast.AnnAssign):
            self.generic_visit(ast.Expr(node.value) if node.value else ast.Pass())
        elif isinstance(node, ast.match_case):
            for each in [*([node.guard] if node.guard else []), *node.body]:
                self.visit(each)
        elif not _stays(node):
            if self._functions:
                for expression, new in faulty(node):
                    self._add(expression, new)
            self.generic_visit(node)


def faulty(node: ast.AST) -> Iterator[tuple[ast.expr, ast.expr]]:
    """The faults of a node alone: an expression, which it is or has, and another instead."""
    match node:
        case ast.Compare():
            for at, operator in enumerate(node.ops):
                for other in COMPARED[type(operator)]:
                    yield node, _with(node, ops=[*node.ops[:at], other(), *node.ops[at + 1 :]])
        case ast.BoolOp():
            yield node, _with(node, op=ast.Or() if isinstance(node.op, ast.And) else ast.And())
        case ast.BinOp() if type(node.op) in CALCULATED and not _has_text(node):
            yield node, _with(node, op=CALCULATED[type(node.op)]())
        case ast.UnaryOp(op=ast.Not()) | ast.UnaryOp(op=ast.USub()):
            yield node, node.operand
        case ast.Constant(value=bool(value)):
            yield node, ast.Constant(not value)
        case ast.Constant(value=int(value) | float(value)):
            yield node, ast.Constant(value + 1)
        case ast.Call(func=ast.Name(id=name)) if name in CALLED:
            yield node, _with(node, func=ast.Name(CALLED[name], ast.Load()))
        case ast.Return(value=ast.expr() as value) if not _is_none(value):
            yield value, ast.Constant(None)
        case ast.Expr(value=ast.Call() | ast.Await() as value):
            yield value, ast.Constant(None)
        case ast.If(test=test) | ast.IfExp(test=test) | ast.While(test=test) if _has_no_own(test):
            yield test, ast.UnaryOp(ast.Not(), test)
        case ast.comprehension(ifs=tests):
            for test in filter(_has_no_own, tests):
                yield test, ast.UnaryOp(ast.Not(), test)


def _with(node: ast.expr, **changed: object) -> ast.expr:
    new = copy.copy(node)
    for name, value in changed.items():
        setattr(new, name, value)
    return new


def _has_no_own(test: ast.expr) -> bool:
    """True if no other fault turns the condition round."""
    return not isinstance(test, ast.Compare | ast.Constant) and not (
        isinstance(test, ast.UnaryOp) and isinstance(test.op, ast.Not)
    )


def _has_text(node: ast.BinOp) -> bool:
    def is_text(side: ast.expr) -> bool:
        return isinstance(side, ast.JoinedStr | ast.List | ast.Tuple | ast.ListComp) or (
            isinstance(side, ast.Constant) and isinstance(side.value, str | bytes)
        )

    return is_text(node.left) or is_text(node.right)


def _is_none(node: ast.expr) -> bool:
    return isinstance(node, ast.Constant) and node.value is None


def _stays(node: ast.AST) -> bool:
    """Whether it is a text, an assertion (as `strict` of `zip` is one), or a line of the log."""
    match node:
        case ast.JoinedStr() | ast.Assert() | ast.keyword(arg="strict"):
            return True
        case ast.Expr(value=ast.Call(func=ast.Attribute(value=ast.Name(id=name)))):
            return name in LOGGERS
    return False


def _short(text: str) -> str:
    text = " ".join(text.split())
    return text if len(text) <= 60 else text[:57] + "..."
