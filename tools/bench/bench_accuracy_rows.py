"""The rows of results that bench_accuracy writes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from tools.bench.result_rows import ResultRow, RowKind, counted
from tools.docs.results_page import BLOCK, FAULTS, LOOKS

Bounds = Mapping[str, tuple[float | None, float | None]]
"""By case: the largest error after a similarity, and the largest jump, px."""
ROWS = {
    "all": RowKind(
        BLOCK,
        "simulated surveys within their bounds (seed {seeds})",
        "all",
        "{good:d} of {surveys:d}",
    ),
    "flat": RowKind(
        BLOCK,
        "flat ground: shape after a similarity, jumps",
        "{after_most:g}, {jumps_most:g} px",
        "{after_px:.3f}, {jumps_px:.2f} px",
    ),
    "hills, DEM": RowKind(
        BLOCK,
        "hills with a DEM: shape; absolute",
        "{after_most:g} px",
        "{after_px:.3f} px; {absolute_m:.3f} m",
    ),
    "hills, no DEM": RowKind(
        BLOCK,
        "hills without a DEM: shape, jumps",
        "{after_most:g}, {jumps_most:g} px",
        "{after_px:.3f}, {jumps_px:.2f} px",
    ),
    "RTK positions": RowKind(
        BLOCK,
        "RTK positions, flat ground: absolute; shape",
        "{after_most:g} px",
        "{absolute_m:.3f} m; {after_px:.3f} px",
    ),
    "lies": RowKind(
        BLOCK,
        "wrong headings, positions and a turned line: shape; frames named",
        "{after_most:g} px",
        "{after_px:.3f} px; {named:d} of {wrong:d}",
    ),
    "heights off and drifting": RowKind(
        BLOCK,
        "heights that drift: shape",
        "{after_most:g} px",
        "{after_px:.3f} px",
    ),
    "GNSS": RowKind(
        BLOCK,
        "GNSS positions good to 1.5 m, flat ground: absolute",
        "",
        "{absolute_m:.3f} m",
    ),
    "line": RowKind(
        BLOCK,
        "line of 200 frames: growth of the error along it",
        "0 mm a frame",
        "{slope_mm:.1f} ± {slope_sd_mm:.1f} mm",
    ),
    "rough courses": RowKind(
        FAULTS,
        "a line of turned images and a line of kept headings (rough courses): frames named right",
        "all",
        "{turned} and {kept}",
    ),
    "image deviation": RowKind(
        LOOKS,
        "image deviation of tie points on simulated flights",
        "",
        "{sigma_px:.3f} px",
    ),
}
SHAPES = ("flat", "hills, DEM", "hills, no DEM", "RTK positions", "lies", "heights off and drifting")
"""Cases that have a row of their own, which is judged by the case's bounds."""


def result_rows(rows: Sequence[dict[str, Any]], bounds: Bounds) -> list[ResultRow]:
    """The rows of the cases that were run; of several seeds the worst figure, as the bounds are."""
    out = []
    by_case = {name: [r for r in rows if r["case"] == name] for name in bounds}
    if all(by_case.values()):
        good, seeds = sum(r["good"] for r in rows), sorted({r["seed"] for r in rows})
        out.append(ROWS["all"].row(good == len(rows), seeds=counted(seeds), good=good, surveys=len(rows)))
        sigma_px = float(np.median([r["sigma_px"] for r in rows]))
        out.append(ROWS["image deviation"].row(None, sigma_px=sigma_px))
    for case in SHAPES:
        if some := by_case[case]:
            after_most, jumps_most = bounds[case]
            figures = {key: max(r[key] for r in some) for key in ("after_px", "jumps_px", "absolute_m")}
            figures |= {key: sum(r[key] for r in some) for key in ("named", "wrong")}
            limits = {"after_most": after_most, "jumps_most": jumps_most}
            out.append(ROWS[case].row(all(r["good"] for r in some), **figures, **limits))
    if some := by_case["flat"]:
        out.append(ROWS["GNSS"].row(None, absolute_m=max(r["absolute_m"] for r in some)))
    if some := by_case["line of 200"]:
        worst = max(some, key=lambda r: abs(r["slope_mm"]) / r["slope_sd_mm"])
        figures = {key: worst[key] for key in ("slope_mm", "slope_sd_mm")}
        out.append(ROWS["line"].row(abs(worst["slope_mm"]) <= 2.0 * worst["slope_sd_mm"], **figures))
    if by_case["lies"] and by_case["stale yaw on a line"]:
        turned = _named(by_case["lies"], "frame-turned")
        kept = _named(by_case["stale yaw on a line"], "yaw-wrong")
        met = all(named == wrong for named, wrong in (turned, kept))
        texts = {"turned": "{} of {}".format(*turned), "kept": "{} of {}".format(*kept)}
        out.append(ROWS["rough courses"].row(met, **texts))
    return out


def _named(rows: Sequence[dict[str, Any]], code: str) -> tuple[int, int]:
    """Frames that are wrong in this way: how many are named, and how many there are."""
    named, wrong = zip(*(r["named_by_code"][code] for r in rows), strict=True)
    return sum(named), sum(wrong)
