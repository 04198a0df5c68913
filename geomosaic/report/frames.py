"""The report of frames: one self-contained HTML page for people, without a network."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from pyproj import CRS

from geomosaic.adjustment.model import Adjusted
from geomosaic.arrays import Floats
from geomosaic.composition.model import Mosaic
from geomosaic.export.orientation import orientations
from geomosaic.geodesy.mapcrs import is_local
from geomosaic.matching.model import TiePoints
from geomosaic.placement.model import Placement
from geomosaic.quality.compare import Comparison
from geomosaic.quality.misalignment import pair_misalignments
from geomosaic.quality.scores import CCIR_500_1, CRITERIA
from geomosaic.quality.verdict import Verdict
from geomosaic.report import parts
from geomosaic.report.accuracy_image import accuracy_image
from geomosaic.report.comparison import comparison_rows, ssim_image
from geomosaic.report.control import mapped_points, point_figures
from geomosaic.report.control_layers import arrow_scale, control_layers
from geomosaic.report.frame_layers import FrameLayers, map_footprints_m
from geomosaic.report.glance import Glance, glance
from geomosaic.report.layers import MapImage, MapView, box_of
from geomosaic.report.map_images import overlap_image
from geomosaic.report.numbers import UNKNOWN, length, plural, short, whole
from geomosaic.report.page import Fact, PageHead, markup, part, render
from geomosaic.report.plate import plate
from geomosaic.report.solved import solved_section
from geomosaic.report.solved_figures import ground_reason
from geomosaic.report.surface import SurfaceSection
from geomosaic.report.verdict import verdict_section
from geomosaic.report.warnings import warnings_of
from geomosaic.survey.model import Survey

_GROUND = {"flat": "flat ground", "dem": "the DEM", "tie_surface": "the tie points' surface"}


@dataclass(frozen=True)
class OtherImages:
    """Other images of the mosaic's ground, to be swiped over it: by POS alone, and the reference.

    accuracy: accuracy.tif, a layer of the map.
    """

    given: Glance | None = None
    reference: Glance | None = None
    accuracy: Path | None = None


@dataclass(frozen=True)
class FramesReport:
    """What a report of frames is made of.

    mosaic_file: mosaic.tif, read at reduced size, unless it is given so: image. name: of the run, for the
    page's head and the files of scores; may be empty. summary: what run.json holds (`frames`, `warnings`,
    `timings_s`, `peak_memory_mb`, `metrics`, `recipe`, `versions`); missing keys are left out of the page.
    """

    survey: Survey
    placement: Placement
    ties: TiePoints
    adjusted: Adjusted
    mosaic: Mosaic
    mosaic_file: Path
    summary: Mapping[str, Any]
    name: str = ""
    comparison: Comparison | None = None
    verdict: Verdict | None = None
    surface: SurfaceSection | None = None
    others: OtherImages = OtherImages()
    image: Glance | None = None


def render_report(report: FramesReport) -> str:
    """The page's HTML.

    Names of files and texts of warnings are strangers' data: the template escapes all that is not
    markup, and the page forbids itself any network by its content security policy.
    """
    survey, placement, ties, adjusted = report.survey, report.placement, report.ties, report.adjusted
    mosaic, comparison, verdict = report.mosaic, report.comparison, report.verdict
    image = report.image or glance(report.mosaic_file)
    orientation = orientations(survey, placement.poses, adjusted)
    footprints_m = map_footprints_m(survey, adjusted, orientation.placed)
    points = point_figures(adjusted)
    mapped = mapped_points(survey, points)
    judged = verdict_section(survey, verdict, mosaic.grid.gsd_m, points)
    ground = _ground(adjusted, report.summary)
    origin = np.array([mosaic.grid.west_m, mosaic.grid.south_m])
    pixel_m = mosaic.grid.gsd_m * mosaic.grid.width_px / image.width_px
    scale = arrow_scale(mapped, mosaic.grid.gsd_m * max(mosaic.grid.width_px, mosaic.grid.height_px))
    drawn = FrameLayers(survey, placement, ties, adjusted, orientation, footprints_m, origin, pixel_m)
    on_earth = not is_local(mosaic.grid.crs)
    unscaled_px_m = None if on_earth else placement.ground_pixel_m
    begin = PageHead(
        title="Mosaic of " + plural(len(survey.frames), "frame"),
        run=report.name,
        judged=judged.judged,
        image=image,
        caption="North is up. " * on_earth + "The full image is mosaic.tif.",
        facts=_facts(report, image.covered_m2),
        map_view=MapView(
            (float(origin[0]), float(origin[1])),
            ("E", "N"),
            False,
            "m" if on_earth else "",
            on_earth,
            box_of(image, origin),
            _images(report, image, origin, footprints_m),
            [
                *drawn.all(mosaic, None if verdict is None else verdict.seams, comparison),
                *control_layers(mapped, scale, origin),
            ],
        ),
        table=parts.frame_table(placement, ties, adjusted, orientation, warnings_of(report.summary).frames),
        plate=plate(image, mapped, scale, on_earth),
    )
    return render(
        "frames.html",
        report.summary,
        begin,
        form_script=part("score_form.js"),
        surface=report.surface,
        surface_css=part("surface.css"),
        surface_script=part("surface_profile.js"),
        judged=judged,
        trimmed_rows=parts.trimmed_rows(mosaic.trimmed, mosaic.grid.crs),
        composition_rows=parts.composition_rows(report.summary.get("metrics", {}), unscaled_px_m),
        comparison=comparison,
        comparison_rows=comparison_rows(comparison) if comparison else [],
        before=parts.misaligned_px(adjusted, 0, placement.ground_pixel_m)
        if adjusted.rounds and on_earth
        else None,
        rounds=markup(parts.rounds_plot(adjusted, placement.ground_pixel_m)),
        residuals=markup(parts.residuals_plot(adjusted, placement.ground_pixel_m)),
        worst_pairs=parts.worst_pairs(survey, pair_misalignments(ties, adjusted.residuals_m), unscaled_px_m),
        control=points,
        solved=solved_section(survey, placement, adjusted, ground),
        cameras=parts.camera_rows(survey, adjusted),
        levels=CCIR_500_1,
        criteria=CRITERIA,
    )


def _images(
    report: FramesReport, image: Glance, origin: np.ndarray[Any, Any], footprints_m: list[Floats]
) -> list[MapImage]:
    comparison, surface, others = report.comparison, report.surface, report.others
    box = box_of(image, origin)
    counts = "red 1, orange 2, yellow 3, light green 4, green 5 and more footprints"
    out = [
        MapImage(
            "overlap", "Overlap count", overlap_image(image, footprints_m), box, note=counts, opacity=0.6
        )
    ]
    deviations = None if is_local(report.mosaic.grid.crs) else others.accuracy
    accuracy = None if deviations is None else accuracy_image(deviations, origin)
    if accuracy is not None:
        out.append(accuracy)
    if surface is not None:
        west, south, east, north = surface.box_m
        lies = (west - origin[0], south - origin[1], east - origin[0], north - origin[1])
        ends = f"{short(surface.low_m, 'm', 4)} dark to {short(surface.high_m, 'm', 4)} light"
        out.append(MapImage("surface", "Surface", "#surface-image", lies, note=ends))
    if comparison is not None:
        rows, cols = comparison.ssim_cells.shape
        west, north = comparison.west_m - float(origin[0]), comparison.north_m - float(origin[1])
        east, south = west + cols * comparison.ssim_cell_m, north - rows * comparison.ssim_cell_m
        note = f"dark 0 to light 1, in cells of {short(comparison.ssim_cell_m, 'm')}"
        out.append(
            MapImage(
                "ssim", "SSIM", ssim_image(comparison), (west, south, east, north), note=note, opacity=0.8
            )
        )
    for name, title, other in (
        ("given", "by POS only", others.given),
        ("reference", "the reference", others.reference),
    ):
        if other is not None:
            out.append(MapImage(name, title, other.uri, box_of(other, origin), "compare"))
    return out


def _facts(report: FramesReport, covered_m2: float) -> list[Fact]:
    """What the head of the page says."""
    survey, ties, adjusted, mosaic = report.survey, report.ties, report.adjusted, report.mosaic
    crs = CRS.from_user_input(mosaic.grid.crs)
    code = crs.to_authority()
    local = is_local(mosaic.grid.crs)  # without a scale
    counted = {s: adjusted.status.count(s) for s in ("tied", "placed", "rejected")}
    area = (covered_m2 / 1e4, "ha") if covered_m2 < 1e7 else (covered_m2 / 1e6, "km²")
    method = str(report.summary.get("metrics", {}).get("adjustment", {}).get("method", ""))
    odd = [
        f"{n} {words}"
        for n, words in ((counted["placed"], "placed by POS alone"), (counted["rejected"], "rejected"))
        if n
    ]
    lines = plural(len(set(report.placement.lines)), "flight line")
    size = f"{whole(mosaic.grid.width_px)} × {whole(mosaic.grid.height_px)} px"
    means = survey.quantity
    return [
        ("frames tied", f"{counted['tied']} of {len(survey.frames)}", ", ".join(odd)),
        ("ground pixel", UNKNOWN if local else length(mosaic.grid.gsd_m), size),
        ("area covered", UNKNOWN if local else short(*area), lines),
        ("tie points", whole(sum(len(p) for p in ties.pairs)), "in " + plural(len(ties.pairs), "pair")),
        ("adjustment", method.replace("_", " ") or "–", _adjustment_note(adjusted)),
        ("map", ":".join(code) if code else crs.name, crs.name if code else ""),
        ("taken", *_taken(survey)),
        *([] if means is None else [("values", means.name, f"by {means.source}" if means.source else "")]),
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
    return f"{first:%Y-%m-%d}", f"{first:%H:%M:%S} to {last:%H:%M:%S} (UTC, or the clock of the camera)"
