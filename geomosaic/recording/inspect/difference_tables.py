"""What `compare` found, as text for people: what came of it first, fingerprints last and in one line."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from rich.console import Console

from geomosaic.recording.inspect.tables import line, new_table, number, row, share, shortened

_MOST_ROWS = 10


def show_difference(difference: dict[str, Any], console: Console) -> None:
    if difference["equal"]:
        line(console, "the runs are equal")
    else:
        first = difference["first_stage"]
        line(console, f"the runs differ; first stage that differs: {first}" if first else "the runs differ")
    for name, (a, b) in difference["elsewhere"].items():
        line(console, f"the same files in another place: {name}: {a} and {b}")
    for a in difference["altered"]:
        path = difference["paths"][a["in"] == "b"]
        line(console, f"altered: {path}: artefact '{a['artefact']}' of stage {a['stage']}")
    if difference["whole"]:
        whole, cut = (0, 1) if difference["whole"][0] else (1, 0)
        line(console, f"only {difference['paths'][whole]} is whole, not {difference['paths'][cut]}")
    _frames(difference["frames"], console)
    _pairs(difference["pairs"], console)
    table = new_table("came of it", "stage", "what", "a", "b")
    for cells in (*_consequences(difference), *_offsets(difference["offsets"]), *_strips(difference)):
        row(table, *cells)
    if table.row_count:
        console.print(table)
    for words in difference["recipe"]:
        line(console, words)
    table = new_table("was done", "stage", "what", "a", "b")
    for cells in _done(difference):
        row(table, *cells)
    if table.row_count:
        console.print(table)
    if seconds := difference["seconds"]:
        words = [f"{s['stage']} {s['seconds'][0]:.1f} -> {s['seconds'][1]:.1f} s" for s in seconds[:4]]
        line(console, f"time: {', '.join(words)}")
    if difference["fingerprints"]:
        stages = ", ".join(entry["stage"] for entry in difference["fingerprints"])
        line(console, f"fingerprints differ of {stages}; --json has them")


def _frames(frames: list[dict[str, Any]], console: Console) -> None:
    if not frames:
        return
    table = new_table(
        f"frames placed otherwise by b ({len(frames)}, the worst first)",
        *("frame", "moved, m", "east, north, up, m", "yaw, pitch, roll, deg", "status"),
    )
    for f in frames[:_MOST_ROWS]:
        if "only_in" in f:
            row(table, f["frame"], "", "", "", f"only in {f['only_in']}")
            continue
        moved = ", ".join(_signed(f[n]) for n in ("d_east_m", "d_north_m", "d_up_m"))
        turned = ", ".join(_signed(f[n]) for n in ("d_yaw_deg", "d_pitch_deg", "d_roll_deg"))
        row(table, f["frame"], number(f["moved_m"]), moved, turned, " -> ".join(f.get("status", ())))
    console.print(table)


def _pairs(pairs: list[dict[str, Any]], console: Console) -> None:
    if not pairs:
        return
    title = f"pairs with other residuals ({len(pairs)}, the worst first)"
    table = new_table(title, "left", "right", "left over, m", "tie points", "down-weighted")
    for p in pairs[:_MOST_ROWS]:
        if "tied_only_in" in p:
            row(table, p["left"], p["right"], f"tied only in {p['tied_only_in']}", "", "")
            continue
        shown = (("rms_m", number), ("tie_points", str), ("share_down_weighted", share))
        row(table, p["left"], p["right"], *(" -> ".join(map(text, p.get(name, ()))) for name, text in shown))
    console.print(table)


def _consequences(difference: dict[str, Any]) -> Iterator[tuple[Any, ...]]:
    for name, (a, b) in difference["verdict"].items():
        yield "(verdict)", name, _figure(a), _figure(b)
    for k, (name, (a, b)) in enumerate(difference["figures"].items()):
        if k == _MOST_ROWS:
            yield "(figures)", f"and {len(difference['figures']) - k} more; --json has them", "", ""
            break
        yield "(figures)", name, _figure(a), _figure(b)
    for warning in difference["warnings"]:
        text = f"{warning['frame']}: {warning['text']}" if warning["frame"] else warning["text"]
        yield warning["stage"], warning["level"], *_in_column(text, warning)


def _offsets(offsets: list[dict[str, Any]]) -> Iterator[tuple[Any, ...]]:
    for moved in offsets:
        yield moved["stage"], "rounds", *moved["rounds"]
        for frame in moved["frames"][:_MOST_ROWS]:
            if "only_in" in frame:
                yield moved["stage"], frame["frame"], *_in_column("moved", frame)
            else:
                words = f"{frame['d_east_m']:+.3f} m east, {frame['d_north_m']:+.3f} m north"
                yield moved["stage"], frame["frame"], "", words
        if len(moved["frames"]) > _MOST_ROWS:
            yield moved["stage"], f"and {len(moved['frames']) - _MOST_ROWS} more frames", "", ""


def _strips(difference: dict[str, Any]) -> Iterator[tuple[Any, ...]]:
    for curve in difference["strips"]:
        what = f"offsets of pair {curve['pair']}"
        if "only_in" in curve:
            yield curve["stage"], what, *_in_column("there", curve)
            continue
        apart = f"up to {number(curve['largest_px'])} px from a's, {number(curve['rms_px'])} px RMS"
        labels = f", {share(curve['share_relabelled'])} of the lines labelled otherwise"
        yield curve["stage"], what, "", apart + labels
    for left in difference["strip_residuals"]:
        what = f"left in pair {left['pair']}"
        if "only_in" in left:
            yield left["stage"], what, *_in_column("there", left)
            continue
        both = zip(left["rms_px"], left["blocks_measured"], strict=True)
        of_a, of_b = (f"{number(rms)} px RMS of {blocks} blocks" for rms, blocks in both)
        yield left["stage"], what, of_a, f"{of_b}, up to {number(left['largest_px'])} px from a's"


def _done(difference: dict[str, Any]) -> Iterator[tuple[Any, ...]]:
    for name, (a, b) in difference["manifest"].items():
        yield "input files", name, _mark(a), _mark(b)
    for stage in difference["stages"]:
        if "only_in" in stage:
            yield stage["stage"], "stage", *_in_column("there", stage)
        for what in ("version", "params", "finished"):
            for name, (a, b) in stage.get(what, {}).items():
                yield stage["stage"], f"{what} {name}".strip(), shortened(a), shortened(b)
    for name, (a, b) in difference["environment"].items():
        yield "(environment)", name, shortened(a), shortened(b)


def _in_column(text: str, only: dict[str, Any]) -> tuple[str, str]:
    """A text in the column of the run that alone has it."""
    return (text, "") if only["only_in"] == "a" else ("", text)


def _figure(value: Any) -> str:
    """Of numbers four digits; --json has them whole."""
    return f"{value:.4g}" if isinstance(value, float) else shortened(value)


def _signed(value: float | None) -> str:
    return "unknown" if value is None else f"{value:+.3f}"


def _mark(value: Any) -> str:
    return "missing" if value is None else shortened(value)[:12]
