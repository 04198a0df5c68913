"""The tables of bench_flights: one row a flight, and seconds and memory by stage."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

Row = Mapping[str, Any]
_COLUMNS = (
    "flight", "exit", "frames tied", "parts", "sigma, px", "reprojection, px", "seams, px: median, 90, 95 %",
    "verdict", "control, m: plan, height", "check points, m: plan, height", "mosaic, px", "trimmed",
    "processors, s", "memory, MB", "folder over raw mosaic", "commit", "missed",
)  # fmt: skip


def tables(flights: Mapping[str, Row]) -> str:
    """Markdown of all flights, by name."""
    lines = ["| " + " | ".join(_COLUMNS) + " |", "|" + "---|" * len(_COLUMNS)]
    lines += ["| " + " | ".join(_cells(name, row)) + " |" for name, row in sorted(flights.items())]
    stages = list(dict.fromkeys(s for row in flights.values() for s in row.get("stages_s", {})))
    if stages:
        lines += ["", "Seconds by stage, and the peak memory up to its end in MB (run.json):", ""]
        lines += ["| flight | " + " | ".join(stages) + " |", "|" + "---|" * (len(stages) + 1)]
        for name, row in sorted(flights.items()):
            cells = [_stage(row, stage) for stage in stages]
            lines.append("| " + " | ".join([name, *cells]) + " |")
    return "\n".join(lines) + "\n"


def _cells(name: str, row: Row) -> list[str]:
    frames, mosaic = row.get("frames"), row.get("mosaic")
    seams = [_number(row.get(key), 2) for key in ("seams_px", "seams_90_px", "seams_95_px")]
    trimmed = row.get("trimmed_share")
    cause = f": {row['verdict_cause']}" if row.get("verdict_cause") else ""
    cells = [
        name,
        "-" if row["exit_code"] is None else str(row["exit_code"]),
        f"{frames['tied']} of {frames['total']}" if frames else "-",
        _number(row.get("parts"), 0),
        _number(row.get("sigma_px"), 2),
        _number(row.get("reprojection_mean_px"), 2),
        ", ".join(seams) if frames else "-",
        f"{row['verdict']}{cause}" if row.get("verdict") else "-",
        _points(row.get("control")),
        _points(row.get("check")),
        f"{mosaic['width']} x {mosaic['height']}" if mosaic else "-",
        "-" if trimmed is None else f"{100 * trimmed:.1f} %",
        f"{row['processor_s']:.0f}",
        f"{row['peak_mb']:.0f}",
        _number(row.get("folder_over_raw"), 2),
        row["commit"],
        "; ".join(row["missed"]),
    ]
    return [cell.replace("|", "\\|") for cell in cells]


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def _points(figures: Row | None) -> str:
    """Errors at surveyed points, and how many there are."""
    if figures is None:
        return "-"
    if "failed" in figures:
        return str(figures["failed"])
    plan, up = figures["rmse_horizontal_m"], figures.get("rmse_up_m")
    after = " after a similarity" if figures.get("after_similarity") else ""
    return f"{_number(plan, 3)}, {_number(up, 3)}{after} ({figures['n']})"


def _stage(row: Row, stage: str) -> str:
    seconds, stage_mb = row.get("stages_s", {}).get(stage), row.get("stages_mb", {}).get(stage)
    if seconds is None:
        return "-"
    return f"{seconds:.1f}" + ("" if stage_mb is None else f", {stage_mb:.0f}")
