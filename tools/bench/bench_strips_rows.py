"""The rows of results that bench_strips writes."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from tools.bench.result_rows import ResultRow, RowKind, listed
from tools.docs.results_page import STRIPS

AIMS_PX = {
    "clean": ("clear ground", 0.05),
    "low contrast 40 %": ("low contrast on 40 %", 0.3),
    "clouds 20 %": ("clouds on 20 %", 0.3),
    "clouds 50 %": ("clouds on 50 %", 0.5),
    "all together": ("all together", 0.8),
}
"""What a row calls a case, and its largest RMSE."""
RESAMPLED_AIMS_PX = {
    "resampled, clean": ("clean ground of another sampling", 0.05),
    "resampled, low contrast 40 %": ("low contrast on 40 %, another sampling", 0.3),
    "resampled, clouds 50 %": ("clouds on 50 %, another sampling", 0.5),
}
INSIDE = (0.85, 0.95)
"""Share of errors within the stated 90 %."""
_ONE_PX = "lines called measured that are off by more than 1 px"
ROWS = {
    "rmse": RowKind(
        STRIPS,
        "RMSE of `joint`, {case}; errors within the stated 90 %",
        "{aim:g} px",
        "{rmse:.3f} px; {inside:.0f} %",
    ),
    "measured lines": RowKind(
        STRIPS,
        _ONE_PX + ", {scenes:d} scenes",
        "none",
        "{lines}",
    ),
    "rivals": RowKind(
        STRIPS,
        "clouds on 20 %: RMSE of `whole_scene`, `piecewise_linear`, `image_registration`",
        "",
        "{rmse} px",
    ),
    "mixed": RowKind(
        STRIPS,
        "{scenes:d} mixed scenes with a segment off by more than 1 px: "
        "`whole_scene`, `piecewise_linear`, `joint`",
        "",
        "{shares} %",
    ),
    "short": RowKind(
        STRIPS,
        "two cameras, short scenes: those of {asked:d} that were run; measured lines off by more than 1 px",
        "{asked:d}; none",
        "{scenes:d}; {lines}",
    ),
    "bright": RowKind(
        STRIPS,
        _ONE_PX + ", ground as bright as clouds on 30 %, {scenes:d} short scenes",
        "none",
        "{lines}",
    ),
    "resampled": RowKind(
        STRIPS,
        "RMSE of `joint`, {case}; errors within the stated 90 %",
        f"{{aim:g}} px; {100 * INSIDE[0]:.0f} to {100 * INSIDE[1]:.0f} %",
        "{rmse:.{digits}f} px; {inside:.0f} %",
    ),
    "resampled mean": RowKind(
        STRIPS,
        "RMSE of `mean_offset`, another sampling: clean, low contrast, clouds",
        "",
        "{rmse} px",
    ),
}


def result_rows(rows: Sequence[dict[str, Any]], asked: int) -> list[ResultRow]:
    """The rows of what was measured; asked: so many scenes were to be run."""
    out = []
    for names, kind in ((AIMS_PX, "rmse"), (RESAMPLED_AIMS_PX, "resampled")):
        for case, (name, aim) in names.items():
            some = _of(rows, case, "joint")
            if some:
                rmse, inside = _rmse(some), _inside(some)
                met = rmse <= aim and (kind == "rmse" or INSIDE[0] <= round(inside, 2) <= INSIDE[1])
                figures = {"rmse": rmse, "inside": 100 * inside, "digits": 3 if rmse < 0.1 else 2}
                out.append(ROWS[kind].row(met, case=name, aim=aim, **figures))
    joint = [r for r in rows if r["method"] == "joint"]
    usual = [r for r in joint if r["case"] in AIMS_PX]
    if {r["case"] for r in usual} == set(AIMS_PX):
        lines = _above(usual)
        out.append(ROWS["measured lines"].row(not lines, scenes=len(usual), lines=_count(lines)))
    rivals = [_of(rows, "clouds 20 %", m) for m in ("whole_scene", "piecewise_linear", "image_registration")]
    if all(rivals):
        out.append(ROWS["rivals"].row(None, rmse=listed(map(_rmse, rivals), ".2f")))
    mixed = [_of(rows, "mixed", m) for m in ("whole_scene", "piecewise_linear", "joint")]
    if all(mixed):
        shares = [100.0 * np.mean([r["figures"]["misplaced"] is True for r in of]) for of in mixed]
        out.append(ROWS["mixed"].row(None, scenes=len(mixed[0]), shares=listed(shares, ".0f")))
    short = [r for r in joint if r["case"].startswith(("TH-1, ", "5 m, "))]
    if short:
        lines, met = _above(short), len(short) == asked and not _above(short)
        out.append(ROWS["short"].row(met, asked=asked, scenes=len(short), lines=_count(lines)))
        bright = [r for r in short if r["case"].endswith("ground as bright")]
        lines = _above(bright)
        out.append(ROWS["bright"].row(not lines, scenes=len(bright), lines=_count(lines)))
    means = [_of(rows, case, "mean_offset") for case in RESAMPLED_AIMS_PX]
    if all(means):
        out.append(ROWS["resampled mean"].row(None, rmse=listed(map(_rmse, means), ".2f")))
    return out


def _of(rows: Iterable[dict[str, Any]], case: str, method: str) -> list[dict[str, Any]]:
    return [r for r in rows if (r["case"], r["method"]) == (case, method)]


def _rmse(rows: Sequence[dict[str, Any]]) -> float:
    """Over all lines of all scenes, px."""
    lines = [r["figures"]["lines"] for r in rows]
    return math.sqrt(np.average([r["figures"]["rms_px"] ** 2 for r in rows], weights=lines))


def _inside(rows: Sequence[dict[str, Any]]) -> float:
    lines = [r["figures"]["lines"] for r in rows]
    return float(np.average([np.mean(r["coverage"]) for r in rows], weights=lines))


def _above(rows: Iterable[dict[str, Any]]) -> int:
    return sum(r["measured_above"] for r in rows)


def _count(lines: int) -> str:
    return f"{lines:,} lines" if lines else "none"
