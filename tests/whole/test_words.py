"""Words of the project's own do not come back, each class name has one meaning, and sentences are short."""

from __future__ import annotations

import ast
import importlib
import inspect
import io
import re
import tokenize
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

import pytest

from geomosaic.pipeline.former_names import FORMER

ROOT = Path(__file__).parents[2]
PACKAGES = ("geomosaic", "geomosaic_simulate")
PLACES = (*PACKAGES, "tools", "tests", "geomosaic/recipes", "Makefile")
MODULES = {
    "surface": "held fused verticals sharpening joined tile levels terrain doubts",
    "composition": "calmed shadows sight",
    "pipeline": "work given kept finished elsewhere forked freed announced named recorded single",
    "matching": "believed",
    "adjustment": "unrest doubts laying start beliefs trust chosen_model left_out swing flown levers",
}
"""Former names of modules, by room."""
CLASSES = {
    *("Voice", "Work", "Held", "Finished", "Given", "Kept", "Lent", "Spared", "Sighted", "Verticals"),
    *("Counted", "Believed", "Shadow", "Shown", "Seen", "Looks", "Look", "Told", "Judged", "LeftOut"),
}
"""Former names of classes."""
PRIVATE = {
    *(
        "held",
        "told",
        "untold",
        "beside",
        "laid",
        "believed",
        "heard",
        "settled",
        "righted",
        "calm",
        "calmed",
    ),
    *("unrest", "swing", "swings", "swinging", "mend", "mends", "mended"),
}
"""Words that no name, docstring, comment or text contains."""
FORMER_NAMES = {
    *("held", "mend", "beside", "laid_on", "swing_rad", "untold_turns", "swing 1", "^swing (?=\\d)"),
    *("height-not-believed", "Judgement.mend is Judgement.fix now"),
    *(f"{name}_told" for name in ("lens", "attitude", "height", "relative_height", "readout", "shutter")),
    *("gyroscope_told", "shutter_untold", "distortion_untold", "fisheye_untold", "--no-lens-told"),
}
"""Texts that files, plug-ins and commands of earlier versions have: they stay readable for one release."""
WORD_LISTS = {"tests/whole/test_words.py", "tests/whole/test_prose.py", "tests/whole/test_messages.py"}
"""Which contain the words to look for them."""
LONGEST = 30
"""Words of a docstring's sentence. The rule is 25."""


def modules(*places: str) -> Iterator[tuple[str, str]]:
    """Paths and texts of the Python files of some places."""
    for place in places:
        for path in sorted((ROOT / place).rglob("*.py")):
            yield path.relative_to(ROOT).as_posix(), path.read_text(encoding="utf-8")


def docstrings(tree: ast.Module) -> list[ast.Constant]:
    """Texts that stand alone: of modules, classes, functions and constants."""
    alone = (node.value for node in ast.walk(tree) if isinstance(node, ast.Expr))
    return [node for node in alone if isinstance(node, ast.Constant) and isinstance(node.value, str)]


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
            case ast.alias():
                yield from (node.name, node.asname or "")


def written(source: str) -> Iterator[str]:
    """All names, docstrings, texts but former names, and comments of a module."""
    tree = ast.parse(source)
    yield from identifiers(tree)
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and node.value not in FORMER_NAMES:
            yield node.value
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            yield token.string


def words(text: str) -> set[str]:
    """`held` and `cells` of `held_cells`, `HELD_CELLS`, `HeldCells` and `held cells`."""
    return {word.lower() for word in re.findall(r"[A-Z]?[a-z0-9]+|[A-Z]+(?![a-z])", text)}


def with_private_words(source: str) -> list[str]:
    return sorted({text for text in written(source) if words(text) & PRIVATE})


def sentences(docstring: str) -> Iterator[str]:
    """Sentences of a docstring without examples, formulas and commands, which are indented.

    Entries of lists of arguments count one by one.
    """
    prose = re.sub(r"^ *(>>>|\.\.\. ).*(\n(?! *\n).*)*", "", inspect.cleandoc(docstring), flags=re.M)
    for block in re.split(r"\n *\n|\n *(?:[-*]|\d+\.) ", prose):
        if all(line.startswith("    ") for line in block.splitlines()):
            continue
        text = " ".join(re.sub(r"``[^`]*``|`[^`]*`", "CODE", block).split())
        yield from re.split(r"(?<=[.!?])[)*\"]*\s+|;\s+(?=\w+(?: \([^)]*\))?:)", text)


def long_sentences(source: str) -> list[str]:
    found = (s for node in docstrings(ast.parse(source)) for s in sentences(str(node.value)))
    return [s for s in found if len(s.split()) > LONGEST]


def test_private_words_are_found_wherever_they_stand() -> None:
    for source in (
        "held = 1",
        "f(told=2)",
        '"""Laid."""',
        "x = 'beside it'",
        "a = 1  # believed",
        "class HeldBack: ...",
    ):
        assert with_private_words(source), source
    assert not with_private_words('names = {"swing_rad": "rotation_terms_rad"}')


def test_long_sentences_are_found() -> None:
    long = "word " * 31
    assert len(long_sentences(f'"""{long}. Short."""')) == 1
    assert not long_sentences(f'"""a: {"word " * 20}; b (n,): {"word " * 20}.\n\n>>> {long}"""')


@pytest.mark.parametrize("room", MODULES)
def test_modules_keep_their_present_names(room: str) -> None:
    there = {path.stem for path in (ROOT / "geomosaic" / room).rglob("*.py")}
    assert not there & set(MODULES[room].split())


@pytest.mark.parametrize("place", PLACES)
def test_no_private_word_is_written(place: str) -> None:
    """In names, docstrings, comments and texts; in recipes and the Makefile in any line."""
    found = [
        f"{path}: {text}"
        for path, source in modules(place)
        if path not in WORD_LISTS
        for text in with_private_words(source)
    ]
    lines = [ROOT / place] if (ROOT / place).is_file() else (ROOT / place).glob("*.[ym]*")
    found += [
        f"{path.name}: {line}"
        for path in lines
        for line in path.read_text(encoding="utf-8").splitlines()
        if words(line) & PRIVATE
    ]
    assert not found


def top_classes(*places: str) -> Iterator[tuple[str, str]]:
    """Path and name of every class that a module defines. Parameters of a stage belong to it: `Stage.Params`."""
    for path, source in modules(*places):
        for node in ast.parse(source).body:
            if isinstance(node, ast.ClassDef):
                yield path, node.name


def test_classes_keep_their_present_names() -> None:
    assert not [f"{path}: {name}" for path, name in top_classes(*PACKAGES) if name in CLASSES]


def test_a_class_name_stands_for_one_thing() -> None:
    """In both packages together, and in each folder of tools and tests."""
    found = defaultdict(list)
    for path, name in top_classes(*PACKAGES):
        found["packages", name].append(path)
    for path, name in top_classes("tools", "tests"):
        found[path.rpartition("/")[0], name].append(path)
    assert not {name: paths for name, paths in found.items() if len(paths) > 1}


@pytest.mark.parametrize("place", (*PACKAGES, "tools", "tests"))
def test_sentences_of_docstrings_are_short(place: str) -> None:
    assert not [f"{path}: {s}" for path, source in modules(place) for s in long_sentences(source)]


@pytest.mark.parametrize("name", FORMER.values())
def test_former_names_lead_to_classes(name: str) -> None:
    module, _, attribute = name.partition(":")
    assert isinstance(getattr(importlib.import_module(module), attribute), type)
