"""Summaries and differences of recordings as tables for people."""

from __future__ import annotations

import json
from typing import Any

from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from geomosaic.recording.reader import printable

_MOST_ROWS = 100


def show_summary(short: dict[str, Any], console: Console) -> None:
    """Prints a `summary`."""
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
        columns = (
            "stage",
            "round",
            "pairs",
            "largest misalignment, m",
            "rms, m",
            "largest move, m",
            "worst pair",
        )
        table = new_table("rounds", *columns)
        for r in _first(short["rounds"], "rounds", console):
            worst = " - ".join(r["worst_pair"] or ())
            row(
                table,
                r["stage"],
                r["round"],
                r["pairs"],
                *(
                    number(r[key])
                    for key in ("largest_misalignment_m", "rms_misalignment_m", "largest_move_m")
                ),
                worst,
            )
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


def show_difference(difference: dict[str, Any], console: Console) -> None:
    """Prints what `compare` found."""
    if difference["equal"]:
        console.print("the runs are equal")
    else:
        first = difference["first_stage"]
        line(console, f"the runs differ; first stage that differs: {first}" if first else "the runs differ")
    for a in difference["altered"]:
        path = difference["paths"][a["in"] == "b"]
        line(console, f"altered: {path}: artefact '{a['artefact']}' of stage {a['stage']}")
    if difference["whole"]:
        whole, cut = (0, 1) if difference["whole"][0] else (1, 0)
        line(console, f"only {difference['paths'][whole]} is whole, not {difference['paths'][cut]}")
    for words in difference["recipe"]:
        line(console, words)
    table = new_table("differences", "stage", "what", "a", "b")
    for name, (a, b) in difference["manifest"].items():
        row(table, "input files", name, shortened(a), shortened(b))
    for stage in difference["stages"]:
        if "only_in" in stage:
            there = ("there", "") if stage["only_in"] == "a" else ("", "there")
            row(table, stage["stage"], "stage", *there)
        for what in ("version", "params", "inputs", "outputs", "finished"):
            for name, (a, b) in stage.get(what, {}).items():
                mark = what in ("inputs", "outputs")
                values = (_mark(a), _mark(b)) if mark else (shortened(a), shortened(b))
                row(table, stage["stage"], f"{what} {name}".strip(), *values)
    for offsets in difference["offsets"]:
        rounds_a, rounds_b = offsets["rounds"]
        row(table, offsets["stage"], "rounds", rounds_a, rounds_b)
        farthest = sorted(
            offsets["frames"], key=lambda f: -abs(complex(f.get("d_east_m", 0), f.get("d_north_m", 0)))
        )
        for frame in farthest[:10]:
            if "only_in" in frame:
                there = ("moved", "") if frame["only_in"] == "a" else ("", "moved")
                row(table, offsets["stage"], frame["frame"], *there)
            else:
                row(
                    table,
                    offsets["stage"],
                    frame["frame"],
                    "",
                    f"{frame['d_east_m']:+.3f} m east, {frame['d_north_m']:+.3f} m north",
                )
        if len(farthest) > 10:
            row(table, offsets["stage"], f"and {len(farthest) - 10} more frames", "", "")
    for curve in difference["strips"]:
        what = f"offsets of pair {curve['pair']}"
        if "only_in" in curve:
            there = ("there", "") if curve["only_in"] == "a" else ("", "there")
            row(table, curve["stage"], what, *there)
        else:
            apart = f"up to {number(curve['largest_px'])} px from a's, {number(curve['rms_px'])} px RMS"
            labels = f", {share(curve['share_relabelled'])} of the lines labelled otherwise"
            row(table, curve["stage"], what, "", apart + labels)
    for left in difference["strip_residuals"]:
        what = f"left in pair {left['pair']}"
        if "only_in" in left:
            there = ("there", "") if left["only_in"] == "a" else ("", "there")
            row(table, left["stage"], what, *there)
        else:
            both = zip(left["rms_px"], left["blocks_measured"], strict=True)
            of_a, of_b = (f"{number(rms)} px RMS of {blocks} blocks" for rms, blocks in both)
            change = f", up to {number(left['largest_px'])} px from a's"
            row(table, left["stage"], what, of_a, of_b + change)
    for warning in difference["warnings"]:
        text = f"{warning['frame']}: {warning['text']}" if warning["frame"] else warning["text"]
        row(
            table,
            warning["stage"],
            warning["level"],
            *((text, "") if warning["only_in"] == "a" else ("", text)),
        )
    for name, (a, b) in difference["environment"].items():
        row(table, "(environment)", name, shortened(a), shortened(b))
    if table.row_count:
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


def _mark(fingerprint: str | None) -> str:
    return "missing" if fingerprint is None else fingerprint[:12]


def shortened(value: Any) -> str:
    """A value as JSON, cut in the middle."""
    text = value if isinstance(value, str) else json.dumps(value)
    return text if len(text) <= 60 else f"{text[:40]}...{text[-17:]}"


def number(value: float | None) -> str:
    """To three decimals."""
    return "unknown" if value is None else f"{value:.3f}"


def share(value: float | None) -> str:
    """In percent."""
    return "unknown" if value is None else f"{100.0 * value:.1f} %"


def _range(ends: list[float] | None) -> str:
    return "unknown" if ends is None else f"{ends[0]:+.2f} to {ends[1]:+.2f}"


def bytes_of(count: int | None) -> str:
    """A size."""
    if count is None:
        return "not recorded"
    return (
        f"{count} bytes"
        if count < 10_000
        else f"{count / 1e3:.0f} kB"
        if count < 10_000_000
        else f"{count / 1e6:.0f} MB"
    )
