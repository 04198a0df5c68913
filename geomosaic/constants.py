"""Numbers in the maths, each with its unit and its reason in one line.

A constant stands where it is used:

    NODE_POINTS = tuned(3.0, "tie points a node", "fewer: stiffness decides; more: relief is lost")
    MAD = sourced(1.4826, "1", "normal deviations in a median absolute deviation", "1 / Phi^-1(3/4)")

The value stays a plain number. `python -m geomosaic.constants [ROOM ...]` lists them all, and tests and
benchmarks try other values by name: `with varied(NODE_POINTS=2.0): ...`.
"""

from __future__ import annotations

import ast
import importlib
import math
import pkgutil
import reprlib
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any, Final, TypeVar

T = TypeVar("T")
CHOSEN: Final = "chosen, not measured"


def tuned(value: T, unit: str, reason: str) -> T:
    """The value: a number that was chosen. unit: of the value, or what it is a share of. reason: what goes
    wrong with a smaller or a larger one."""
    return value


def sourced(value: T, unit: str, reason: str, source: str) -> T:
    """The value: a number with a source. source: a publication with its section, a standard, a definition or
    a measurement with its survey."""
    return value


NORMAL_PER_MAD = sourced(1.4826, "1", "normal deviations in a median absolute deviation", "1 / Phi^-1(3/4)")
FOUR_SIGMA = sourced(4.0, "deviations", "beyond: not chance among thousands", "normal errors: 1 in 16,000")
SIX_SIGMA = sourced(6.0, "deviations", "beyond: not chance among millions", "normal errors: 2 in 1e9")
DAY_S = sourced(86400.0, "s", "length of a day", "SI brochure, table 8")
MEDIAN_ONE = sourced(0.6745, "deviations", "median size of a normal error of one number", "Phi^-1(3/4)")
ROUNDS = tuned(12, "rounds", "of an iteration each of which halves what is left at least; fewer show it")
MOST_ROUNDS = tuned(50, "rounds", "of a search that ends by itself: what takes more has no solution")
HEIGHT_ROUNDS = tuned(3, "rounds", "of a ray and the ground's height: one leaves metres, three 0.1 mm")
ASSUMED_SD_SHARE = tuned(0.1, "share", "of an assumed value: less binds what is wrong; more leaves all free")
ENOUGH = tuned(100, "items", "that show what is usual: of fewer a few decide; more take time")
FEW = tuned(0.1, "share", "are of another kind, or wrong: less reports chance; more ignores a part")
TOGETHER = tuned(256, "items", "computed at once: more do not fit the cache; fewer cost calls")
SLIGHT = tuned(1e-6, "share", "changes nothing that is determined, and determines the rest; 0 is singular")
MEDIAN_LENGTH = sourced(math.sqrt(math.log(4.0)), "1", "median of planar errors", "Rayleigh: sqrt(2 ln 2)")


@dataclass(frozen=True)
class Record:
    """Why a number is what it is; see `tuned` and `sourced`."""

    unit: str
    reason: str
    source: str


def records(*rooms: str) -> Iterator[tuple[str, Any, Record]]:
    """Name, value and record of each constant in these rooms, or in all of them."""
    for found in pkgutil.walk_packages([str(Path(__file__).parent)], "geomosaic."):
        if rooms and found.name.split(".")[1] not in rooms:
            continue
        module = importlib.import_module(found.name)
        for name, call in recorded(ast.parse(Path(str(module.__file__)).read_text(encoding="utf-8"))):
            texts = [_text(argument, module) for argument in call.args[1:]]
            yield (
                f"{found.name.removeprefix('geomosaic.')}.{name}",
                vars(module)[name],
                Record(*texts, *[CHOSEN] * (3 - len(texts))),
            )


@contextmanager
def varied(module: str = "", /, **values: Any) -> Iterator[None]:
    """Other values of constants while it lasts, in this process. What a module computed from a constant when
    it was loaded stays.

    Args: module: the end of the name of the module that defines them, where several define one of that name.
    Raises: LookupError where no loaded module, or more than one, defines a constant.
    """
    loaded = {name: its for name, its in sys.modules.items() if its and name.startswith("geomosaic.")}
    before: list[tuple[ModuleType, str, Any]] = []
    try:
        for name, value in values.items():
            homes = [its for of, its in loaded.items() if of.endswith(module) and _defines(its, name)]
            if len(homes) != 1:
                raise LookupError(f"{name}: {len(homes)} loaded modules define it, not one")
            old = vars(homes[0])[name]
            for its in loaded.values():
                own = its is not homes[0] and _defines(its, name)  # small numbers are one object everywhere
                if name in vars(its) and vars(its)[name] is old and not own:
                    before.append((its, name, old))
                    setattr(its, name, value)
        yield
    finally:
        for its, name, old in before:
            setattr(its, name, old)


def _defines(module: ModuleType, constant: str) -> bool:
    """Whether it has a constant of this name that it did not import."""
    source = getattr(module, "__file__", None)
    if constant not in vars(module) or not source:
        return False
    tree = ast.parse(Path(source).read_text(encoding="utf-8"))
    return constant in {name for name, _ in recorded(tree)}


def recorded(tree: ast.Module) -> Iterator[tuple[str, ast.Call]]:
    """Names and calls of the constants that a module defines with `tuned` or `sourced`."""
    for line in tree.body:
        if isinstance(line, (ast.Assign, ast.AnnAssign)) and isinstance(line.value, ast.Call):
            target = line.targets[0] if isinstance(line, ast.Assign) else line.target
            made_by = line.value.func
            if isinstance(made_by, ast.Name) and made_by.id in ("tuned", "sourced"):
                yield ast.unparse(target), line.value


def _text(argument: ast.expr, module: object) -> str:
    """What an argument says; it may name other texts of its module and add them up."""
    if isinstance(argument, ast.Name):
        return str(vars(module)[argument.id])
    if isinstance(argument, ast.BinOp):
        return _text(argument.left, module) + _text(argument.right, module)
    return str(ast.literal_eval(argument))


def main() -> None:
    """Prints a table, as much of it as is read (`| head`)."""
    signal.signal(signal.SIGPIPE, signal.SIG_DFL)
    for name, value, why in records(*sys.argv[1:]):
        sys.stdout.write(f"{name} = {reprlib.repr(value)} [{why.unit}]\n    {why.reason}\n    {why.source}\n")


if __name__ == "__main__":
    main()
