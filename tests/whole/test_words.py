"""Words of the project's own that do not come back, room by room, and one meaning for each class name."""

from __future__ import annotations

import ast
import importlib
import re
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

import pytest

from geomosaic.pipeline.former_names import FORMER

PACKAGE = Path(__file__).parents[2] / "geomosaic"
MODULES = {
    "surface": "held fused verticals sharpening joined tile levels terrain doubts",
    "composition": "calmed shadows sight",
    "pipeline": "work given kept finished elsewhere forked freed announced named recorded single",
    "matching": "believed",
}
"""Former names of modules, by room."""
CLASSES = {
    "Voice",
    "Work",
    "Held",
    "Finished",
    "Given",
    "Kept",
    "Lent",
    "Spared",
    "Sighted",
    "Verticals",
    "Counted",
    "Believed",
    "Shadow",
    "Shown",
    "Seen",
    "Looks",
    "Look",
    "Told",
    "Judged",
    "LeftOut",
}
"""Former names of classes."""
PRIVATE = {
    "held",
    "told",
    "beside",
    "laid",
    "believed",
    "heard",
    "settled",
    "righted",
    "calm",
    "calmed",
    "unrest",
}
"""Words that no identifier of a clean room contains."""
CLEAN = (
    "camera",
    "ccd",
    "cli",
    "composition",
    "doors",
    "export",
    "geodesy",
    "matching",
    "pipeline",
    "placement",
    "projection",
    "stages",
    "quality",
    "recording",
    "report",
    "requests",
    "surface",
    "survey",
)
OTHERS = ("adjustment", "recording")
"""Rooms whose words are kept elsewhere."""


def trees(*rooms: str) -> Iterator[tuple[Path, ast.Module]]:
    """The modules of rooms; of all but `OTHERS` where none is named."""
    for path in sorted(PACKAGE.rglob("*.py")):
        room = path.relative_to(PACKAGE).parts[0]
        if room in rooms or (not rooms and room not in OTHERS):
            yield path.relative_to(PACKAGE), ast.parse(path.read_text(encoding="utf-8"))


def identifiers(tree: ast.Module) -> Iterator[str]:
    """Names that a module defines or uses."""
    for node in ast.walk(tree):
        match node:
            case ast.FunctionDef() | ast.AsyncFunctionDef() | ast.ClassDef():
                yield node.name
            case ast.Name():
                yield node.id
            case ast.arg() | ast.keyword():
                yield node.arg or ""
            case ast.Attribute():
                yield node.attr


def words(name: str) -> set[str]:
    """`held` and `cells` of `held_cells`, `HELD_CELLS` and `HeldCells`."""
    return {word.lower() for word in re.findall(r"[A-Z]?[a-z0-9]+|[A-Z]+(?![a-z])", name)}


@pytest.mark.parametrize("room", MODULES)
def test_modules_keep_their_present_names(room: str) -> None:
    there = {path.stem for path in (PACKAGE / room).glob("*.py")}
    assert not there & set(MODULES[room].split())


def test_classes_keep_their_present_names() -> None:
    found = [
        f"{path}: {node.name}"
        for path, tree in trees()
        for node in ast.walk(tree)
        if isinstance(node, ast.ClassDef) and node.name in CLASSES
    ]
    assert not found


@pytest.mark.parametrize("room", CLEAN)
def test_identifiers_of_a_room_hold_no_private_word(room: str) -> None:
    found = {
        f"{path}: {name}" for path, tree in trees(room) for name in identifiers(tree) if words(name) & PRIVATE
    }
    assert not found


def test_a_class_name_stands_for_one_thing() -> None:
    """Parameters of a stage belong to it: `Stage.Params`."""
    places = defaultdict(list)
    for path, tree in trees():
        for node in tree.body:
            if isinstance(node, ast.ClassDef):
                places[node.name].append(str(path))
    assert not {name: where for name, where in places.items() if len(where) > 1}


@pytest.mark.parametrize("name", FORMER.values())
def test_former_names_lead_to_classes(name: str) -> None:
    module, _, attribute = name.partition(":")
    assert isinstance(getattr(importlib.import_module(module), attribute), type)
