"""Figures in the pages occur in the files of docs/results that commands write."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "docs" / "results"
PLACES = [
    ("README.md", "How accurate, how fast", "summary.json"),
    ("docs/comparison.md", "What was measured", "peers.json"),
    ("docs/recording.md", "Cost", "summary.json"),
]
"""A page, a heading, and the file that has the figures below it."""
NAMES = r"\d+ x \d+ px|\b\d+\.\d+\.\d+\b|\d(?=D\b)|of \d[\d.]* (?:m|MP)\b"
"""Sizes of frames, versions and dimensions: they name what was measured."""


def section(page: str, heading: str) -> str:
    text = (ROOT / page).read_text(encoding="utf-8")
    return text.split(f"## {heading}\n", 1)[1].split("\n## ", 1)[0]


def figures(text: str) -> list[str]:
    """Numbers of tables and sentences that are measured: with decimals, or of two digits and more."""
    text = re.sub(r"`[^`]*`|\]\([^)]*\)", " ", text)
    text = re.sub(NAMES, " ", text)
    return re.findall(r"(?<![\w.])(?:\d+\.\d+|\d[\d,]+)(?![\w.]*\d)", text)


def numbers(of: Any) -> Iterator[float]:
    """All numbers of a file of results, those within texts as well."""
    if isinstance(of, dict):
        for value in of.values():
            yield from numbers(value)
    elif isinstance(of, list):
        for value in of:
            yield from numbers(value)
    elif isinstance(of, str):
        yield from (float(n.replace(",", "")) for n in re.findall(r"\d[\d,]*(?:\.\d+)?", of))
    elif isinstance(of, int | float) and not isinstance(of, bool):
        yield float(of)


@pytest.mark.parametrize(("page", "heading", "file"), PLACES)
def test_each_figure_stands_in_the_results(page: str, heading: str, file: str) -> None:
    """To its digits."""
    whole = json.loads((RESULTS / file).read_text(encoding="utf-8"))
    measured = [[r["what"], r["value"]] for r in whole["rows"]] if file == "summary.json" else whole
    known = list(numbers(measured))
    found = figures(section(page, heading))
    assert found
    for figure in found:
        digits = len(figure.partition(".")[2])
        plain = figure.replace(",", "")
        assert any(f"{n:.{digits}f}" == plain for n in known), f"{page}: {figure} is not in {file}"


def test_figures_are_read() -> None:
    """Names, versions and code have none."""
    text = "| pycolmap 4.2.1, 2D | 16.5 | 283 | 0.006 |, 24 frames of 480 x 360 px of 9 MP: 1,146 MB `--n 30`"
    assert figures(text) == ["16.5", "283", "0.006", "24", "1,146"]
