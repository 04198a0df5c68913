"""Rows of docs/results/summary.json, written by the benchmarks that measure them.

A benchmark declares its rows in a table `ROWS` of `RowKind`, calls `add_options(parser)`, and ends with
`write_rows(args, rows)`. Without `--summary` nothing is written.
"""

from __future__ import annotations

import argparse
import datetime
import json
import re
import shlex
import string
import subprocess
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import geomosaic

_LEFT_OUT = ("--summary", "--out", "--note")
"""Options with one argument each that a row's command does not show."""
_WORDS = ("no", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten")
_NOTE = r"(?: \([^()]+\))?"


@dataclass(frozen=True)
class ResultRow:
    """A measured row. same: matches `what` of the rows that this one replaces."""

    question: str
    what: str
    target: str
    value: str
    met: bool | None
    same: re.Pattern[str]


@dataclass(frozen=True)
class RowKind:
    """A row that a command can write: texts with fields in braces, which the measurement fills.

    measured: fields of `what` that differ between two measurements of the same row; they may be empty.
    """

    question: str
    what: str
    target: str
    value: str
    measured: tuple[str, ...] = ()

    def row(self, met: bool | None, **fields: Any) -> ResultRow:
        """The row with its fields filled; met: None where there is no target."""
        kept = {name: text for name, text in fields.items() if name not in self.measured}
        texts = (text.format(**fields) for text in (self.what, self.target, self.value))
        judged = None if met is None else bool(met)
        return ResultRow(
            self.question, *texts, judged, re.compile(_pattern(self.what, self.measured, kept) + _NOTE)
        )

    def matches(self, row: dict[str, Any]) -> bool:
        """Whether this kind can give the row; a note in parentheses may follow `what`."""
        return row["question"] == self.question and all(
            re.fullmatch(_pattern(text, self.measured) + note, row[key]) is not None
            for key, text, note in (
                ("what", self.what, _NOTE),
                ("target", self.target, ""),
                ("value", self.value, ""),
            )
        )


def _pattern(text: str, empty: Sequence[str], known: dict[str, Any] | None = None) -> str:
    """A regular expression for a text with fields, of which some may be empty and some are known."""
    out = ""
    for literal, name, spec, conversion in string.Formatter().parse(text):
        out += re.escape(literal)
        if name is not None:
            ending = (f"!{conversion}" if conversion else "") + (f":{spec}" if spec else "")
            found = (known or {}).get(name)
            unknown = r"[-+\d.,]+" if spec else ".*" if name in empty else ".+"
            out += unknown if found is None else re.escape(("{0" + ending + "}").format(found))
    return out


def add_rows(path: Path, command: str, rows: Iterable[ResultRow], note: str = "") -> None:
    """Writes rows into a summary: they replace the same rows there, all others stay.

    Args:
        path: a file like docs/results/summary.json; made if missing
        command: that measures the rows again
        note: circumstances, which each row's first cell then ends with
    """
    whole = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {"rows": []}
    date, of = datetime.date.today().isoformat(), commit()
    for row in rows:
        new = {
            "question": row.question, "what": row.what + (f" ({note})" if note else ""),
            "target": row.target, "value": row.value, "met": row.met,
            "command": command, "date": date, "commit": of,
        }  # fmt: skip
        same = [
            k
            for k, old in enumerate(whole["rows"])
            if old["question"] == row.question and row.same.fullmatch(old["what"])
        ]
        at = same[0] if same else len(whole["rows"])
        whole["rows"] = [old for k, old in enumerate(whole["rows"]) if k not in same]
        whole["rows"].insert(at, new)
    path.write_text(json.dumps(whole, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


def add_options(parser: argparse.ArgumentParser) -> None:
    """The options --summary and --note."""
    parser.add_argument("--summary", type=Path, help="write the rows of docs/results.md into this file")
    parser.add_argument("--note", default="", help="circumstances that these rows state in parentheses")


def write_rows(
    args: argparse.Namespace, rows: Iterable[ResultRow], words: Sequence[str] | None = None
) -> None:
    """Writes the rows where --summary is given; words: the command's arguments, else those of the process."""
    if args.summary is not None:
        add_rows(args.summary, command_line(sys.argv[1:] if words is None else words), rows, args.note)


def command_line(words: Sequence[str]) -> str:
    """This program with its arguments, but for where it writes."""
    spec = sys.modules["__main__"].__spec__
    if spec is not None:
        program = f"python -m {spec.name.removesuffix('.__main__')}"
    else:
        program = f"python {sys.argv[0]}"
    shown, left_out = [], False
    for word in words:
        if left_out:
            left_out = False
        elif word in _LEFT_OUT:
            left_out = True
        elif word.partition("=")[0] not in _LEFT_OUT:
            shown.append(word)
    return " ".join([program, *map(shlex.quote, shown)])


def commit() -> str:
    """The commit of the tree that geomosaic is imported from, with `-dirty` where files differ from it."""
    tree = Path(geomosaic.__file__).parents[1]
    words = ["git", "-C", tree, "describe", "--always", "--dirty", "--exclude=*"]
    return subprocess.run(words, capture_output=True, text=True, check=False).stdout.strip() or "unknown"


def in_words(count: int) -> str:
    """A small count in words."""
    return _WORDS[count] if 0 <= count < len(_WORDS) else f"{count:,}"


def counted(seeds: Sequence[int]) -> str:
    """Seeds as "7" or "1 to 7"."""
    return f"{seeds[0]}" if len(seeds) == 1 else f"{seeds[0]} to {seeds[-1]}"


def listed(values: Iterable[float], spec: str) -> str:
    """Numbers with commas."""
    return ", ".join(f"{value:{spec}}" for value in values)
