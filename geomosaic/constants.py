"""Numbers in the maths, each with its unit, its reason and its source beside it.

A constant stands where it is used, annotated with its record:

    FARTHEST: Annotated[float, Because("robust deviations", "what is farther off is no noise", CHOSEN)] = 4.5

The value stays a plain number. `python -m geomosaic.constants [ROOM ...]` lists them all.
"""

from __future__ import annotations

import importlib
import math
import pkgutil
import reprlib
import signal
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Annotated, Any, Final, get_args, get_type_hints

CHOSEN: Final = "chosen, not measured"


@dataclass(frozen=True)
class Because:
    """Why a number is what it is.

    `unit`: of the value, or what it is a share of. `reason`: what goes wrong with a smaller or a larger one.
    `source`: a publication with its section, a standard, a measurement with its survey, or CHOSEN.
    """

    unit: str
    reason: str
    source: str


NORMAL_PER_MAD: Annotated[
    float,
    Because(
        "1",
        "standard deviations of a normal distribution in one median absolute deviation",
        "1 / Phi^-1(3/4)",
    ),
] = 1.4826

MEDIAN_LENGTH: Annotated[
    float,
    Because(
        "deviations",
        "median length of errors of two numbers with a deviation of 1 each",
        "Rayleigh's distribution: sqrt(2 ln 2)",
    ),
] = math.sqrt(math.log(4.0))


def records(*rooms: str) -> Iterator[tuple[str, Any, Because]]:
    """Name, value and record of each constant in these rooms, or in all of them."""
    for found in pkgutil.walk_packages([str(Path(__file__).parent)], "geomosaic."):
        if rooms and found.name.split(".")[1] not in rooms:
            continue
        module = importlib.import_module(found.name)
        noted = {n: a for n, a in getattr(module, "__annotations__", {}).items() if "Because(" in str(a)}
        hints = get_type_hints(SimpleNamespace(__annotations__=noted), vars(module), include_extras=True)
        for name, hint in hints.items():
            for note in get_args(hint)[1:]:
                yield f"{found.name.removeprefix('geomosaic.')}.{name}", vars(module)[name], note


def main() -> None:
    """Prints a table, as much of it as is read (`| head`)."""
    signal.signal(signal.SIGPIPE, signal.SIG_DFL)
    for name, value, why in records(*sys.argv[1:]):
        sys.stdout.write(f"{name} = {reprlib.repr(value)} [{why.unit}]\n    {why.reason}\n    {why.source}\n")


if __name__ == "__main__":
    main()
