"""Where constants are named in the package: by which modules, in which functions, or while a module loads."""

from __future__ import annotations

import ast
import functools
import sys
from pathlib import Path
from types import ModuleType


@functools.cache
def _tree(path: str) -> ast.Module:
    return ast.parse(Path(path).read_text(encoding="utf-8"))


@functools.cache
def used_while_loading(path: str) -> frozenset[str]:
    """Names that a module reads outside of functions, or as defaults of their arguments."""
    found: set[str] = set()

    def visit(node: ast.AST) -> None:
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda)):
            defaults = [d for d in (*node.args.defaults, *node.args.kw_defaults) if d is not None]
            for part in (*defaults, *getattr(node, "decorator_list", ())):
                visit(part)
            return
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Load):
            found.add(node.id)
        for child in ast.iter_child_nodes(node):
            visit(child)

    visit(_tree(path))
    return frozenset(found)


@functools.cache
def _taken(path: str) -> frozenset[tuple[str, str]]:
    """Module and name of all that a module imports by name."""
    return frozenset(
        (str(node.module), alias.name)
        for node in ast.walk(_tree(path))
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    )


def loaded() -> dict[str, ModuleType]:
    return {
        name: module
        for name, module in sys.modules.items()
        if name.startswith("geomosaic.") and getattr(module, "__file__", None)
    }


def homes(name: str) -> list[str]:
    """Files of the loaded modules that define a constant or take it by name. name: with its module's."""
    module, _, constant = name.rpartition(".")
    return [
        str(its.__file__)
        for of, its in loaded().items()
        if of == f"geomosaic.{module}" or (f"geomosaic.{module}", constant) in _taken(str(its.__file__))
    ]


@functools.cache
def names_in(file: str) -> dict[tuple[str, int], frozenset[str]]:
    """Names that each function of a file uses, by its own name and first line."""
    found: dict[tuple[str, int], frozenset[str]] = {}
    if not file.endswith(".py") or not Path(file).exists():
        return found
    pending = [compile(_tree(file), file, "exec")]
    while pending:
        code = pending.pop()
        if code.co_name != "<module>":
            found[code.co_name, code.co_firstlineno] = frozenset(code.co_names)
        pending += [c for c in code.co_consts if hasattr(c, "co_names")]
    return found
