"""The texts that users may read, collected from the package's source: errors, their fixes, warnings."""

from __future__ import annotations

import ast
import re
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
VALUE = "VALUE"
"""Stands for what a text takes in."""
TABLE = "_TEXTS"
"""What a module calls its texts by code."""
CODE = re.compile(r"[a-z]+(-[a-z]+)+")
"""What a warning's code looks like."""


@dataclass(frozen=True)
class Message:
    """One text: where, the error's class or 'warning', its texts and those of its fix; of a warning its code,
    where that stands next to it."""

    where: str
    kind: str
    texts: tuple[str, ...]
    fixes: tuple[str, ...]
    has_fix: bool
    code: str = ""


def messages() -> list[Message]:
    """Every message of the package."""
    return [message for path in sorted(ROOT.rglob("*.py")) for message in _in_file(path)]


def _in_file(path: Path) -> Iterator[Message]:
    source = path.read_text(encoding="utf-8")
    tree = ast.parse(source)
    constants = _assigned(tree.body)
    functions = [n for n in ast.walk(tree) if isinstance(n, ast.FunctionDef | ast.AsyncFunctionDef)]
    seen: set[int] = set()
    for function in sorted(functions, key=lambda n: -n.lineno):
        nodes = list(ast.walk(function))
        calls = [n for n in nodes if isinstance(n, ast.Call) and id(n) not in seen and _name(n) in ERRORS]
        names = {**constants, **_assigned(nodes)} if calls else {}
        for call in calls:
            seen.add(id(call))
            name = _name(call)
            where = f"{path.relative_to(ROOT)}:{call.lineno}"
            if call.args:
                fix = next((k.value for k in call.keywords if k.arg == "fix"), None)
                yield Message(where, name, _texts(call.args[0], names), _texts(fix, names), fix is not None)
    if "warn" in source.lower():
        yield from _warnings(path, tree, constants)


def _warnings(path: Path, tree: ast.Module, constants: Mapping[str, list[ast.expr]]) -> Iterator[Message]:
    """Codes with their texts: arguments of a call, items of a tuple that is passed on, or a table of texts."""
    for scope, nodes in _scopes(tree):
        for node in nodes:
            for code, text in _pairs(node):
                names = constants if scope is None else {**constants, **_in_force(scope, node.lineno)}
                where = f"{path.relative_to(ROOT)}:{node.lineno}"
                found = tuple(its for its in _texts(text, names) if " " in its)
                if found:
                    yield Message(where, "warning", found, (), True, code)


def _pairs(node: ast.AST) -> Iterator[tuple[str, ast.expr]]:
    """Codes and texts of one node; an empty code for one that a variable holds."""
    match node:
        case ast.Call(func=ast.Name(id=name) | ast.Attribute(attr=name), args=[code, _, _, *_]) if (
            name in WARNINGS and len(node.args) >= 3
        ):
            yield str(getattr(code, "value", "")), node.args[2]
        case ast.Tuple(elts=[*first, text]) if any(_code(of) for of in first):
            yield next(_code(of) for of in first if _code(of)), text
        case ast.Assign(targets=[ast.Name(id=name)]) | ast.AnnAssign(target=ast.Name(id=name)) if (
            name == TABLE and isinstance(node.value, ast.Dict)
        ):
            yield from ((_code(k), v) for k, v in zip(node.value.keys, node.value.values, strict=True))


def _code(node: ast.expr | None) -> str:
    """A warning's code, empty for another expression."""
    text = node.value if isinstance(node, ast.Constant) else ""
    return text if isinstance(text, str) and CODE.fullmatch(text) else ""


def _scopes(tree: ast.Module) -> Iterator[tuple[ast.FunctionDef | None, list[ast.AST]]]:
    """Each function with what stands in it, the innermost first, and the module with all else."""
    functions = [n for n in ast.walk(tree) if isinstance(n, ast.FunctionDef)]
    taken: set[int] = set()
    for scope in (*sorted(functions, key=lambda n: -n.lineno), None):
        nodes = [n for n in ast.walk(scope or tree) if id(n) not in taken]
        taken |= {id(n) for n in nodes}
        yield scope, nodes


def _in_force(function: ast.FunctionDef, line: int) -> dict[str, list[ast.expr]]:
    """What names stand for at a line: the last assignment above it, with what is added to it."""
    found: dict[str, list[ast.expr]] = {}
    stands = [n for n in ast.walk(function) if isinstance(n, ast.stmt) and n.lineno < line]
    for node in sorted(stands, key=lambda n: n.lineno):
        match node:
            case ast.AugAssign(target=ast.Name(id=name), value=value) if name in found:
                found[name] = [ast.BinOp(left, ast.Add(), value) for left in found[name]]
            case _:
                found |= _assigned([node])
    return found


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
        case ast.Name(id=name) if depth > 0 and name in names:
            return tuple(text for value in names[name] for text in _texts(value, names, depth - 1))
        case ast.Subscript(value=ast.Name(id=name)) if name in names:
            tables = [value for value in names[name] if isinstance(value, ast.Dict)]
            return tuple(text for table in tables for v in table.values for text in _texts(v, names, depth))
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
