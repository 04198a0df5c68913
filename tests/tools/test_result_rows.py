"""Rows of the results are written by commands: each is declared by a benchmark that can write it."""

from __future__ import annotations

import argparse
import importlib
import json
import re
from pathlib import Path
from typing import Any

import pytest

from tools.bench.result_rows import RowKind, add_options, add_rows, write_rows

ROOT = Path(__file__).parents[2]
SUMMARY = ROOT / "docs" / "results" / "summary.json"
DECLARED = [
    f"tools.{path.relative_to(ROOT / 'tools').with_suffix('').as_posix().replace('/', '.')}"
    for path in sorted((ROOT / "tools").rglob("*.py"))
    if re.search(r"^ROWS = \{", path.read_text(encoding="utf-8"), re.MULTILINE)
]
BY_TESTS = {
    "pytest tests/survey/test_camera_kinds.py",
    "pytest tests/cli/test_watch.py",
    "pytest tests/stages/test_matching_reference.py",
}
"""Commands of rows that state what a test shows."""
KIND = RowKind("How?", "{frames:d} frames, {seen} seen", "{most:g} s", "{took:.1f} s", measured=("seen",))


def kinds() -> dict[str, RowKind]:
    """All declared rows by module and name."""
    return {
        f"{module} {name}": kind
        for module in DECLARED
        for name, kind in importlib.import_module(module).ROWS.items()
    }


def test_every_row_has_a_command_that_can_write_it() -> None:
    """A row is declared by one benchmark, or its command is a test."""
    declared = kinds()
    for row in json.loads(SUMMARY.read_text(encoding="utf-8"))["rows"]:
        if row["command"] in BY_TESTS:
            assert (ROOT / row["command"].partition(" ")[2]).is_file()
            continue
        found = {name for name, kind in declared.items() if kind.matches(row)}
        assert found, f"no benchmark declares the row {row['what']!r}, {row['target']!r}, {row['value']!r}"
        assert len({declared[name].what for name in found}) == 1, f"{row['what']!r} by {found}"


@pytest.mark.parametrize("module", DECLARED)
def test_a_declared_row_is_written(module: str) -> None:
    """Each kind is used in the module that declares it, and some program offers --summary for it."""
    path = ROOT.joinpath(*module.split(".")).with_suffix(".py")
    text = path.read_text(encoding="utf-8")
    for name in importlib.import_module(module).ROWS:
        direct = f'ROWS["{name}"]' in text
        assert direct or re.search(r"ROWS(\.get\(|\[)[a-z_.]+", text), f"{module}: {name} is never written"
    programs = [
        program
        for program in [path, *sorted(path.parent.glob("*.py"))]
        if "add_options(" in (code := program.read_text(encoding="utf-8"))
        and "write_rows(" in code
        and (program == path or path.stem in code)
    ]
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    names = [".".join(p.relative_to(ROOT).with_suffix("").parts).removesuffix(".__main__") for p in programs]
    assert any(f"-m {name} $(ROWS)" in makefile for name in names), f"{module}: no target of {names}"


def test_the_file_is_as_add_rows_writes_it() -> None:
    text = SUMMARY.read_text(encoding="utf-8")
    assert text == json.dumps(json.loads(text), indent=1, ensure_ascii=False) + "\n"


def rows_of(path: Path) -> list[tuple[Any, ...]]:
    return [(r["what"], r["value"], r["met"]) for r in json.loads(path.read_text(encoding="utf-8"))["rows"]]


def test_a_row_replaces_its_like_and_keeps_the_others(tmp_path: Path) -> None:
    """Same question and text, measured fields apart; other counts and questions are other rows."""
    path = tmp_path / "summary.json"
    first = [KIND.row(True, frames=frames, seen=7, most=2, took=1.0) for frames in (10, 100)]
    add_rows(path, "one", first)
    add_rows(path, "two", [KIND.row(False, frames=10, seen=8, most=2, took=3.0)], note="by night")
    assert rows_of(path) == [
        ("10 frames, 8 seen (by night)", "3.0 s", False),
        ("100 frames, 7 seen", "1.0 s", True),
    ]
    add_rows(path, "three", [KIND.row(True, frames=10, seen=9, most=2, took=1.5)])
    assert rows_of(path)[0] == ("10 frames, 9 seen", "1.5 s", True)
    row = json.loads(path.read_text(encoding="utf-8"))["rows"][0]
    assert row["command"] == "three" and row["target"] == "2 s" and row["commit"] and row["date"]
    assert [*row] == ["question", "what", "target", "value", "met", "command", "date", "commit"]


def test_notes_and_pictures_of_the_summary_stay(tmp_path: Path) -> None:
    path = tmp_path / "summary.json"
    path.write_text(json.dumps({"title": "t", "rows": [], "notes": {"How?": ["±"]}}), encoding="utf-8")
    add_rows(path, "one", [KIND.row(None, frames=1, seen=1, most=1, took=1.0)])
    whole = json.loads(path.read_text(encoding="utf-8"))
    assert whole["title"] == "t" and whole["notes"] == {"How?": ["±"]} and len(whole["rows"]) == 1
    assert "±" in path.read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("change", "same"),
    [
        ({}, True),
        ({"what": "10 frames, 8 seen (by night)"}, True),
        ({"what": "ten frames, 8 seen"}, False),
        ({"target": "2 GB"}, False),
        ({"value": "fast"}, False),
        ({"question": "Why?"}, False),
    ],
)
def test_a_kind_knows_its_rows(change: dict[str, str], same: bool) -> None:
    row = {"question": "How?", "what": "10 frames, 8 seen", "target": "2 s", "value": "1.5 s"}
    assert KIND.matches(row | change) is same


def test_the_command_leaves_out_where_it_writes(tmp_path: Path) -> None:
    parser = argparse.ArgumentParser()
    add_options(parser)
    path = tmp_path / "summary.json"
    args = parser.parse_args(["--summary", str(path)])
    row = KIND.row(True, frames=1, seen=1, most=1, took=1.0)
    write_rows(args, [row], ["--seeds", "3", "--out", "/tmp/x", "--summary", str(path), "--only", "a b"])
    command = json.loads(path.read_text(encoding="utf-8"))["rows"][0]["command"]
    assert command.endswith(" --seeds 3 --only 'a b'")
    write_rows(parser.parse_args([]), [row], [])
