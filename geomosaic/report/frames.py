"""The report: one self-contained HTML page for people, without a network or (but for the form) a script."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from markupsafe import Markup
from pyproj import CRS

from geomosaic.adjustment.model import Adjusted
from geomosaic.export.on_map import map_from_work
from geomosaic.export.orientation import orientations
from geomosaic.matching.model import TiePoints
from geomosaic.mosaic.model import Mosaic
from geomosaic.placement.model import Placement
from geomosaic.quality.compare import Comparison
from geomosaic.quality.misalignment import pair_misalignments
from geomosaic.quality.scores import CCIR_500_1, CRITERIA
from geomosaic.quality.verdict import Verdict
from geomosaic.report import parts
from geomosaic.report.comparison import comparison_map, comparison_rows, ssim_image
from geomosaic.report.glance import glance
from geomosaic.report.overview import overview
from geomosaic.report.page import Fact, length, markup, part, plural, render
from geomosaic.report.solved import solved_section
from geomosaic.report.solved_figures import ground_reason
from geomosaic.report.surface import SurfaceSection
from geomosaic.report.svg import short
from geomosaic.report.verdict import verdict_section
from geomosaic.survey.model import Survey

_MOST_ROWS = 3000

_GROUND = {"flat": "flat ground", "dem": "the DEM", "tie_surface": "the tie points' surface"}
_STATUS = {
    "tied": "joined to its neighbours by tie points",
    "placed": "placed by its position and attitude alone",
    "rejected": "left out of the mosaic",
}


def render_report(
    *,
    survey: Survey,
    placement: Placement,
    ties: TiePoints,
    adjusted: Adjusted,
    mosaic: Mosaic,
    mosaic_file: Path,
    summary: Mapping[str, Any],
    comparison: Comparison | None = None,
    verdict: Verdict | None = None,
    surface: SurfaceSection | None = None,
) -> str:
    """The page's HTML.

    Names of files and texts of warnings are strangers' data: the template escapes all that is not
    markup, and the page forbids itself any network by its content security policy.

    Args:
        mosaic_file: mosaic.tif, read at reduced size.
        summary: what run.json holds (`frames`, `warnings`, `timings_s`, `peak_memory_mb`, `metrics`,
            `recipe`, `versions`); missing keys are left out of the page.
    """
    names = tuple(f.name for f in survey.frames)
    image = glance(mosaic_file)
    footprints_m = parts.map_footprints_m(survey, adjusted)
    nadir_m = map_from_work(survey, adjusted.poses.positions_m)
    drawn = overview(
        image, footprints_m, nadir_m, placement.lines, placement.sequence, adjusted.status, names
    )
    pairs = pair_misalignments(ties, adjusted.residuals_m)
    orientation = orientations(survey, placement.poses, adjusted)
    rows = parts.frame_rows(placement, ties, orientation)
    ground = _ground(adjusted, summary)
    svg = markup
    judged = verdict_section(survey, verdict)
    return render(
        "frames.html",
        summary,
        _facts(survey, placement, ties, adjusted, mosaic, summary, image.covered_m2),
        form_script=part("score_form.js"),
        title="Mosaic of " + plural(len(names), "frame"),
        verdict=judged.lead,
        surface=surface,
        surface_css=part("surface.css"),
        surface_script=part("surface_profile.js"),
        judged=judged,
        overview=svg(drawn),
        crowded=len(names) > 60,
        composition_rows=parts.composition_rows(summary.get("metrics", {})),
        comparison=comparison,
        comparison_rows=comparison_rows(comparison) if comparison else [],
        comparison_maps=_comparison_maps(comparison) if comparison else [],
        ssim_uri=ssim_image(comparison) if comparison else "",
        ssim_width_px=_heat_width_px(comparison) if comparison else 0,
        before=parts.misaligned_px(adjusted, 0, placement.ground_pixel_m) if adjusted.rounds else None,
        rounds=svg(parts.rounds_plot(adjusted, placement.ground_pixel_m)),
        moves=svg(parts.moves_map(survey, placement, adjusted, footprints_m)),
        graph=svg(parts.ties_map(survey, ties, adjusted)),
        residuals=svg(parts.residuals_plot(adjusted, placement.ground_pixel_m)),
        worst_pairs=parts.worst_pairs(survey, pairs),
        frames=rows[:_MOST_ROWS],
        frames_left_out=max(0, len(rows) - _MOST_ROWS),
        status_words=_STATUS,
        control=parts.control_tables(adjusted),
        solved=solved_section(survey, placement, adjusted, orientation, footprints_m, ground),
        cameras=parts.camera_rows(survey, adjusted),
        levels=CCIR_500_1,
        criteria=CRITERIA,
    )


def _comparison_maps(comparison: Comparison) -> list[tuple[str, Markup]]:
    if not len(comparison.vectors_m):
        return []
    titles = (("As measured", False), ("After the best shift, turn and scale", True))
    return [(title, markup(comparison_map(comparison, after))) for title, after in titles]


def _heat_width_px(comparison: Comparison) -> int:
    rows, cols = comparison.ssim_cells.shape
    return int(min(720.0, 420.0 * cols / rows))


def _facts(
    survey: Survey,
    placement: Placement,
    ties: TiePoints,
    adjusted: Adjusted,
    mosaic: Mosaic,
    summary: Mapping[str, Any],
    covered_m2: float,
) -> list[Fact]:
    """What the head of the page says."""
    crs = CRS.from_user_input(mosaic.grid.crs)
    code = crs.to_authority()
    count = {s: adjusted.status.count(s) for s in ("tied", "placed", "rejected")}
    area = (covered_m2 / 1e4, "ha") if covered_m2 < 1e7 else (covered_m2 / 1e6, "km²")
    method = str(summary.get("metrics", {}).get("adjustment", {}).get("method", ""))
    rejected = f"{count['placed']} placed by POS alone, {count['rejected']} rejected"
    return [
        ("frames tied", f"{count['tied']} of {len(survey.frames)}", rejected),
        ("taken", *_taken(survey)),
        ("ground pixel", length(mosaic.grid.gsd_m), f"{mosaic.grid.width_px} × {mosaic.grid.height_px} px"),
        ("area covered", short(*area), plural(len(set(placement.lines)), "flight line")),
        ("map", ":".join(code) if code else crs.name, crs.name if code else ""),
        ("tie points", f"{sum(len(p) for p in ties.pairs):,}", "in " + plural(len(ties.pairs), "pair")),
        ("adjustment", method.replace("_", " ") or "–", _adjustment_note(adjusted)),
    ]


def _adjustment_note(adjusted: Adjusted) -> str:
    rounds = plural(len(adjusted.rounds), "round") + ", " if adjusted.rounds else ""
    return f"{rounds}on {_GROUND.get(adjusted.ground.kind, adjusted.ground.kind)}"


def _ground(adjusted: Adjusted, summary: Mapping[str, Any]) -> str:
    """Which surface, and why, as the run reports it."""
    reason = summary.get("metrics", {}).get("ground", {}).get("reason") or ground_reason(adjusted)
    return f"{_GROUND.get(adjusted.ground.kind, adjusted.ground.kind)} ({reason})"


def _taken(survey: Survey) -> tuple[str, str]:
    times = [f.time_s for f in survey.frames if f.time_s is not None]
    if not times:
        return "–", "the frames have no time"
    first, last = (datetime.fromtimestamp(t, tz=UTC) for t in (min(times), max(times)))
    return f"{first:%Y-%m-%d}", f"{first:%H:%M:%S} to {last:%H:%M:%S} UTC"
