"""Counts of the house: lines by room, constants, imports between rooms, longest functions and modules.

    python -m tools.check.house [--results docs/results/house]

Writes a table to standard output and, where asked, RESULTS.json with date and commit. A room is a folder
below geomosaic/; an arrow is a room that imports another.
"""

from __future__ import annotations

import argparse
import ast
import json
import subprocess
import time
from collections import Counter
from pathlib import Path
from typing import Any

PACKAGE, SIMULATOR = Path("geomosaic"), Path("geomosaic_simulate")
MOST_LINES, MOST_ARGUMENTS = 300, 5


def room_of(path: Path) -> str:
    """The folder below the package that holds a module, or the module itself."""
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def counts() -> dict[str, Any]:
    """Every count of the package."""
    lines: Counter[str] = Counter()
    long_modules: dict[str, int] = {}
    functions: list[tuple[int, str]] = []
    wide: list[str] = []
    arrows: set[tuple[str, str]] = set()
    constants = lines_of_constants = 0
    for path in sorted(PACKAGE.rglob("*.py")):
        text = path.read_text(encoding="utf-8")
        length, room = text.count("\n"), room_of(path)
        lines[room] += length
        if length > MOST_LINES:
            long_modules[str(path)] = length
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.FunctionDef):
                functions.append(((node.end_lineno or 0) - node.lineno + 1, f"{path}:{node.name}"))
                if arguments(node) > MOST_ARGUMENTS:
                    wide.append(f"{path}:{node.name}")
            elif isinstance(node, ast.Call) and getattr(node.func, "id", "") in ("tuned", "sourced"):
                constants += 1
                lines_of_constants += (node.end_lineno or 0) - node.lineno + 1
            elif isinstance(node, ast.ImportFrom) and (node.module or "").startswith("geomosaic."):
                to = str(node.module).split(".")[1]
                if to != room:
                    arrows.add((room, to))
    longest = max(functions)
    return {
        "lines": sum(lines.values()),
        "lines_by_room": dict(lines.most_common()),
        "lines_of_adjustment_and_estimation": lines["adjustment"] + lines["estimation"],
        "lines_of_simulator": sum(
            p.read_text().count("\n") for p in Path("geomosaic_simulate").rglob("*.py")
        ),
        "constants": constants,
        "lines_of_constants": lines_of_constants,
        "rooms": sum(path.is_dir() for path in PACKAGE.iterdir() if path.name != "__pycache__"),
        "arrows": len(arrows),
        "longest_function": {"lines": longest[0], "where": longest[1]},
        f"modules_over_{MOST_LINES}_lines": long_modules,
        f"signatures_over_{MOST_ARGUMENTS}_arguments": len(wide),
        "of_them_in_adjustment": sum("/adjustment/" in name or "/estimation/" in name for name in wide),
    }


def arguments(function: ast.FunctionDef) -> int:
    """How many it takes, without self."""
    its = function.args
    named = [a.arg for a in (*its.posonlyargs, *its.args, *its.kwonlyargs)]
    return len([name for name in named if name not in ("self", "cls")])


def main() -> None:
    """Counts and writes."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--results", type=Path, help="without suffix")
    asked = parser.parse_args()
    found = counts()
    print(json.dumps(found, indent=1))
    if asked.results is not None:
        commit = subprocess.run(
            ["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=False
        )
        about = {"date": time.strftime("%Y-%m-%d"), "commit": commit.stdout.strip()}
        asked.results.with_suffix(".json").write_text(
            json.dumps({"command": "python -m tools.check.house", **about, **found}, indent=1) + "\n"
        )


if __name__ == "__main__":
    main()
