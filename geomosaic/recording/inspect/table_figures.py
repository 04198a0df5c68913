"""Figures of frames and pairs out of a recording's tables, where it holds no artefacts (level summary)."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from geomosaic.recording.file.model import FigureTable, Recording
from geomosaic.recording.inspect.solved import POSE, known, pairs_by_frame


def warned(recording: Recording) -> tuple[tuple[str, str, str], ...]:
    """Code, frame and text of each warning: of stages that finished by their notes, of others by the log."""
    return tuple(_warned(recording))


def _warned(recording: Recording) -> Iterator[tuple[str, str, str]]:
    done = {stage.stage_id for stage in recording.stages if stage.finished}
    for stage in recording.stages:
        warnings: Any = stage.notes.get("warnings")
        for warning in warnings if isinstance(warnings, list) else ():
            if isinstance(warning, dict):
                code, frame, text = (str(warning.get(key, "")) for key in ("code", "frame", "text"))
                yield code, frame, text
    for line in recording.warnings:
        if line.level == "warning" and line.stage not in done:
            code, _, text = line.text.partition(": ")
            yield code, line.frame, text


def table_pairs(recording: Recording) -> list[dict[str, Any]]:
    """As `solved.pair_figures`, as far as tables tell."""
    out: list[dict[str, Any]] = []
    adjusted, tried = recording.table("pairs.adjusted"), recording.table("pairs.tried")
    for i, (left, right) in enumerate(_ends(adjusted)):
        value = _row(adjusted, i)
        out.append(
            {
                "left": left,
                "right": right,
                "tied": True,
                "tie_points": int(value.get("tie_points") or 0),
                "mean_m": [value.get("mean_e_m"), value.get("mean_n_m")],
                "rms_m": value.get("rms_m"),
                "rms_px": None,
                "max_m": value.get("largest_m"),
                "in_solve": None,
                "share_down_weighted": value.get("share_down_weighted"),
            }
        )
    tied = {(p["left"], p["right"]) for p in out}
    rest = [ends for ends in dict.fromkeys(_ends(tried)) if ends not in tied]
    return out + [{"left": a, "right": b, "tied": False, "tie_points": 0} for a, b in rest]


def table_frames(recording: Recording, pairs: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """As `solved.frame_figures`, as far as tables tell: places in the work frame are left out."""
    placed, adjusted = recording.table("frames.placed"), recording.table("frames.adjusted")
    given = {n: _row(placed, i) for i, n in enumerate(placed.row)}
    said: dict[str, list[str]] = {}
    for code, frame, text in warned(recording):
        said.setdefault(frame, []).append(f"{code}: {text}")
    by_frame = pairs_by_frame(pairs)
    out = []
    for i, name in enumerate(adjusted.row or placed.row):
        found = _row(adjusted, i) if adjusted.row else {}
        before = given.get(name, {})
        ends = by_frame.get(name, [])
        yaws = found.get("yaw_deg"), before.get("yaw_deg")
        off = None if None in yaws else (yaws[0] - yaws[1] + 180.0) % 360.0 - 180.0  # type: ignore[operator]
        out.append(
            {
                "frame": name,
                "status": adjusted.note[i] if adjusted.note else "not adjusted",
                "line": None,
                "given": _pose(before),
                "found": _pose(found) if found else None,
                "moved_m": [found.get(f"moved_{axis}_m") for axis in "enu"],
                "yaw_off_deg": off,
                "image_turned_deg": 0,
                "pairs_tied": sum(p["tied"] for p in ends),
                "pairs_untied": sum(not p["tied"] for p in ends),
                "tie_points": int(found.get("tie_points") or 0),
                "rms_m": None,
                "rms_px": None,
                "share_down_weighted": found.get("share_down_weighted"),
                "said": said.get(name, []),
            }
        )
    return out


def _ends(table: FigureTable) -> list[tuple[str, str]]:
    return list(zip(table.row, table.other, strict=False))


def _row(table: FigureTable, i: int) -> dict[str, float | None]:
    return {name: known(column[i]) for name, column in table.columns.items()}


def _pose(row: dict[str, float | None]) -> dict[str, float | None]:
    """A table's row under the names of positions.csv."""
    own = {"sd_kappa_deg": "sd_yaw_deg", "sd_omega_deg": "sd_tilt_deg", "sd_phi_deg": "sd_tilt_deg"}
    return {name: row.get(own.get(name, name)) for name in POSE}
