"""The pages are written in short sentences, in the field's words."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
PAGES = sorted([*DOCS.glob("*.md"), *(DOCS / "methods").glob("*.md"), *ROOT.glob("*.md")])
OTHERS = {"CHANGELOG.md", "plan.md"}
READ = [page for page in PAGES if page.name not in OTHERS]
LONGEST = 30
FIRST_SCREEN = 25
"""Lines of the README that show what it is and where to begin."""
OLD_WORDS = re.compile(r"\b(held|told|laid|believed|beside|unrest|doubts|swings?|calmed)\b", re.I)


def prose(text: str) -> Iterator[str]:
    """Paragraphs and entries of lists, without code, tables, headings, pictures and addresses of links."""
    text = re.sub(r"^(```|~~~).*?^\1", "", text, flags=re.M | re.S)
    text = re.sub(r"<!--.*?-->|!\[[^]]*\]\([^)]*\)", "", text, flags=re.S)
    text = re.sub(r"^(?:\||#| {4,}(?![-*\d])).*$", "", text, flags=re.M)
    for block in re.split(r"\n\s*\n|^\s*(?:[-*]|\d+\.) ", text, flags=re.M):
        block = re.sub(r"\[([^]]*)\]\([^)]*\)", r"\1", block)
        yield re.sub(r"``[^`]*``|`[^`]*`", "CODE", block).strip()


def sentences(text: str) -> Iterator[str]:
    for block in prose(text):
        yield from filter(None, (" ".join(one.split()) for one in re.split(r"(?<=[.!?])[)*\"]*\s+", block)))


def long_ones(page: Path) -> list[str]:
    found = sentences(page.read_text(encoding="utf-8"))
    return [one for one in found if len(re.findall(r"\w[\w'.,/-]*", one)) > LONGEST]


def old_words(page: Path) -> list[str]:
    text = re.sub(r"^(```|~~~).*?^\1|`[^`\n]*`", "", page.read_text(encoding="utf-8"), flags=re.M | re.S)
    return [line for line in re.sub(r"\]\([^)]*\)", "]", text).splitlines() if OLD_WORDS.search(line)]


def test_a_long_sentence_is_found() -> None:
    text = "Short one.\n\n| a | table |\n\n" + "word " * 31 + "end. Another `code with many words` one.\n"
    assert [len(one.split()) for one in sentences(text)] == [2, 32, 3]


@pytest.mark.parametrize("page", READ, ids=lambda page: page.name)
def test_sentences_are_short(page: Path) -> None:
    assert not long_ones(page)


@pytest.mark.parametrize("page", READ, ids=lambda page: page.name)
def test_words_of_the_project_s_own_do_not_come_back(page: Path) -> None:
    """In prose, tables and headings; names in code may have them."""
    assert not old_words(page)


def test_the_first_screen_says_what_it_is() -> None:
    lines = (ROOT / "README.md").read_text(encoding="utf-8").splitlines()
    first = "\n".join(lines[:FIRST_SCREEN])
    for word in ("drone", "orthomosaic", "DSM", "QGIS toolbox", "Python", "Makefile"):
        assert word in first
    assert "](docs/img/" in first
