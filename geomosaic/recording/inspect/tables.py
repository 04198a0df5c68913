"""Summaries and differences of recordings as tables for people."""

from __future__ import annotations

import json
from typing import Any

from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from geomosaic.recording.file.reader import printable

_MOST_ROWS = 100


def show_summary(short: dict[str, Any], console: Console) -> None:
    environment = short["environment"]
    known = [name for name in ("geomosaic", "python", "platform") if name in environment]
    line(console, ", ".join(f"{name} {environment[name]}" for name in known))
    table = new_table("stages", "stage", "v", "", "s", "parameters", "outputs")
    table.columns[0].no_wrap = True
    sizes = {(a["stage"], a["name"]): a["bytes"] for a in short["artefacts"]}
    for stage in short["stages"]:
        done = "reused" if stage["cached"] else "done" if stage["finished"] else "unfinished"
        seconds = "" if stage["seconds"] is None else f"{stage['seconds']:.2f}"
        params = [
            f"{name}={shortened(value)}" for name, value in stage["params"].items() if value is not None
        ]
        outputs = [
            f"{name} {mark[:8]}, {bytes_of(sizes.get((stage['id'], name)))}"
            for name, mark in stage["outputs"].items()
        ]
        row(table, stage["id"], stage["version"], done, seconds, params, outputs)
    console.print(table)
    if short["rounds"]:
        names = ("largest_misalignment_m", "rms_misalignment_m", "largest_move_m")
        titles = ("largest misalignment, m", "rms, m", "largest move, m")
        table = new_table("rounds", "stage", "round", "pairs", *titles, "worst pair")
        for r in _first(short["rounds"], "rounds", console):
            worst = " - ".join(r["worst_pair"] or ())
            row(table, r["stage"], r["round"], r["pairs"], *(number(r[name]) for name in names), worst)
        console.print(table)
    if short["strips"]:
        ends = ("dcol, px", "dline, px", "largest sd, px")
        table = new_table("strips", "pair", "left", "right", *ends, "measured", "bridged", "unreliable")
        for c in _first(short["strips"], "pairs of strips", console):
            shares = (share(c[f"share_{label}"]) for label in ("measured", "bridged", "unreliable"))
            ranges = (_range(c["dcol_px"]), _range(c["dline_px"]))
            row(table, c["pair"], c["left"], c["right"], *ranges, number(c["largest_sd_px"]), *shares)
        console.print(table)
    if short["strip_residuals"]:
        columns = ("pair", "left", "right", "blocks", "measured", "RMS, px", "largest, px")
        table = new_table("what is left between the strips", *columns)
        for r in _first(short["strip_residuals"], "pairs of strips", console):
            lengths = (number(r["rms_px"]), number(r["largest_px"]))
            row(table, r["pair"], r["left"], r["right"], r["blocks"], r["blocks_measured"], *lengths)
        console.print(table)
    if short["jitter"]:
        table = new_table("jitter, strongest peaks", "spectrum", "Hz", "across, px", "along, px")
        for j in short["jitter"]:
            for peak in j["peaks"]:
                row(table, j["what"], *(number(peak[k]) for k in ("frequency_hz", "across_px", "along_px")))
        console.print(table)
    for a in short["altered"]:
        text = f"artefact '{a['artefact']}' of stage {a['stage']} isn't what its fingerprint says"
        line(console, f"altered: {text}")
    for warning in _first(short["warnings"], "warnings", console):
        about = f"{warning['frame']}: " if warning["frame"] else ""
        line(console, f"{warning['level']}: {about}{warning['text']}")
    table = new_table("topics", "topic", "messages", "schema")
    for topic in _first(short["topics"], "topics", console):
        row(table, topic["topic"], topic["messages"], topic["schema"])
    console.print(table)


def _first(rows: list[Any], what: str, console: Console) -> list[Any]:
    """As many as people read; says how many more there are."""
    if len(rows) > _MOST_ROWS:
        line(console, f"{_MOST_ROWS} of {len(rows)} {what}; --json has them all")
    return rows[:_MOST_ROWS]


def new_table(title: str, *columns: str) -> Table:
    """Nothing is cut: a word longer than its column goes on in the next line."""
    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, pad_edge=False)
    for column in columns:
        table.add_column(column, overflow="fold")
    return table


def line(console: Console, text: str) -> None:
    """One line, however long: it can be searched and copied."""
    console.print(_text(text), soft_wrap=True)


def row(table: Table, *cells: object) -> None:
    """A row of texts; a list stands for the lines of one cell."""
    table.add_row(
        *("\n".join(_text(str(line)) for line in (c if isinstance(c, list) else [c])) for c in cells)
    )


def _text(text: str) -> str:
    """A stranger's text as rich prints it unchanged, on one line."""
    return escape(printable(text))


def shortened(value: Any) -> str:
    """A value as JSON, cut in the middle."""
    text = value if isinstance(value, str) else json.dumps(value)
    return text if len(text) <= 60 else f"{text[:40]}...{text[-17:]}"


def number(value: float | None, digits: int = 3) -> str:
    """To so many decimals."""
    return "unknown" if value is None else f"{value:.{digits}f}"


def share(value: float | None) -> str:
    return "unknown" if value is None else f"{100.0 * value:.1f} %"


def _range(ends: list[float] | None) -> str:
    return "unknown" if ends is None else f"{ends[0]:+.2f} to {ends[1]:+.2f}"


def bytes_of(count: int | None) -> str:
    if count is None:
        return "not recorded"
    if count < 10_000:
        return f"{count} bytes"
    return f"{count / 1e3:.0f} kB" if count < 10_000_000 else f"{count / 1e6:.0f} MB"
