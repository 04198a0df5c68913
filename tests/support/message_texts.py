"""The texts that users may read, collected from the package's source: errors, their fixes, warnings."""

from __future__ import annotations

import ast
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import geomosaic

ROOT = Path(geomosaic.__file__).parent
ERRORS = {
    *("InputError", "FileError", "OutputError", "LinkError", "AmbiguousCrsError", "NotSolvableError"),
    *("PoorResultError", "GeomosaicError", "PluginError", "BindingsError", "UnknownNameError"),
}
WITH_FIX = {"InputError", "FileError", "OutputError"}
WARNINGS = {"Warn", "warn", "_warn"}
CALLED = ERRORS | WARNINGS
VALUE = "VALUE"
"""Stands for what a text takes in."""


@dataclass(frozen=True)
class Message:
    """One call: where, the error's class or 'warning', its texts and those of its fix."""

    where: str
    kind: str
    texts: tuple[str, ...]
    fixes: tuple[str, ...]
    has_fix: bool


def messages(without: tuple[str, ...] = ()) -> list[Message]:
    """Every message of the package but those of some rooms."""
    found = []
    for path in sorted(ROOT.rglob("*.py")):
        if path.relative_to(ROOT).parts[0] not in without:
            found += _in_file(path)
    return found


def _in_file(path: Path) -> Iterator[Message]:
    tree = ast.parse(path.read_text(encoding="utf-8"))
    constants = _assigned(tree.body)
    functions = [n for n in ast.walk(tree) if isinstance(n, ast.FunctionDef | ast.AsyncFunctionDef)]
    seen: set[int] = set()
    for function in sorted(functions, key=lambda n: -n.lineno):
        nodes = list(ast.walk(function))
        calls = [n for n in nodes if isinstance(n, ast.Call) and id(n) not in seen and _name(n) in CALLED]
        names = {**constants, **_assigned(nodes)} if calls else {}
        for call in calls:
            seen.add(id(call))
            name = _name(call)
            where = f"{path.relative_to(ROOT)}:{call.lineno}"
            if name in ERRORS and call.args:
                fix = next((k.value for k in call.keywords if k.arg == "fix"), None)
                yield Message(where, name, _texts(call.args[0], names), _texts(fix, names), fix is not None)
            elif name in WARNINGS and len(call.args) >= 3:
                yield Message(where, "warning", _texts(call.args[2], names), (), True)


def _name(call: ast.Call) -> str:
    """The function's, without its module or object."""
    return getattr(call.func, "id", getattr(call.func, "attr", ""))


def _assigned(nodes: list[ast.AST] | list[ast.stmt]) -> dict[str, list[ast.expr]]:
    found: dict[str, list[ast.expr]] = {}
    for node in nodes:
        pairs: list[tuple[ast.expr, ast.expr]] = []
        if isinstance(node, ast.Assign):
            pairs = [(target, node.value) for target in node.targets]
        elif isinstance(node, ast.AnnAssign) and node.value is not None:
            pairs = [(node.target, node.value)]
        for target, value in pairs:
            if isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple):
                pairs += list(zip(target.elts, value.elts, strict=False))
            if isinstance(target, ast.Name):
                found.setdefault(target.id, []).append(value)
    return found


def _texts(node: ast.expr | None, names: Mapping[str, list[ast.expr]], depth: int = 3) -> tuple[str, ...]:
    """The texts that an expression may be."""
    match node:
        case ast.Constant(value=str() as text):
            return (text,)
        case ast.JoinedStr():
            return (_joined(node, names, depth),)
        case ast.IfExp():
            return (*_texts(node.body, names, depth), *_texts(node.orelse, names, depth))
        case ast.BinOp(op=ast.Add()):
            left, right = _texts(node.left, names, depth), _texts(node.right, names, depth)
            return tuple(a + b for a in left or (VALUE,) for b in right or (VALUE,))
        case ast.Name(id=name) if depth and name in names:
            return tuple(text for value in names[name] for text in _texts(value, names, depth - 1))
    return ()


def _joined(node: ast.JoinedStr, names: Mapping[str, list[ast.expr]], depth: int) -> str:
    parts = []
    for value in node.values:
        if isinstance(value, ast.Constant):
            parts.append(str(value.value))
        else:
            assert isinstance(value, ast.FormattedValue)
            inner = value.value if isinstance(value.value, ast.Name | ast.IfExp) else None
            parts.append(max(_texts(inner, names, depth - 1), key=len, default=VALUE))
    return "".join(parts)
