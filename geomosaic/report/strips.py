"""The report of a scene of CCD strips: one self-contained HTML page for people, without a network."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

from geomosaic.ccd.model import PairOffsets, StripOffsets
from geomosaic.ccd.radiometry import Radiometry
from geomosaic.composition.strip_compose import StripMosaic
from geomosaic.quality.jitter import jitter_spectrum, residual_spectrum
from geomosaic.quality.strip_figures import LIMIT_PX, SEGMENT_LINES
from geomosaic.quality.strips import PairQuality, StripQuality
from geomosaic.report.layers import MapView
from geomosaic.report.numbers import length, percent, plural, short, signed, whole
from geomosaic.report.page import Fact, PageHead, PageVerdict, markup, render
from geomosaic.report.strip_images import Place, scene_glance, scene_layers, seam_crops, seam_places
from geomosaic.report.strip_plots import misplacement_plot, offsets_plot, spectrum_plot
from geomosaic.report.table import Cell, ReportTable, TableRow, number
from geomosaic.survey.strips import StripGeometry

_FIXES = {
    "bad": "Look at that seam below; another method of offsets may do better there (What next).",
    "doubtful": "Look at the seams that could not be checked below.",
    "": "Look at the seams below: nothing in the strips says how well they lie.",
}


@dataclass(frozen=True)
class StripsReport:
    """What a report of strips is made of.

    mosaic_file: mosaic.tif, read at reduced size, and at full size about the seams. name: of the run, for the
    page's head; may be empty. summary: what run.json holds (`warnings`, `timings_s`, `peak_memory_mb`,
    `recipe`, `versions`); missing keys are left out of the page.
    """

    geometry: StripGeometry
    offsets: StripOffsets
    quality: StripQuality
    radiometry: Radiometry | None
    mosaic: StripMosaic
    mosaic_file: Path
    summary: Mapping[str, Any]
    name: str = ""


def render_strips_report(report: StripsReport) -> str:
    """The page's HTML; what comes from strangers is escaped, and the page forbids itself any network."""
    geometry, offsets, quality = report.geometry, report.offsets, report.quality
    mosaic, mosaic_file = report.mosaic, report.mosaic_file
    image = scene_glance(mosaic_file)
    names = [_pair_name(p.pair) for p in quality.pairs]
    by_pair = {p.pair: p for p in offsets.pairs}
    found = jitter_spectrum(offsets, geometry.line_rate_hz)
    left = residual_spectrum(quality, geometry.line_rate_hz)
    seams = []
    for seam, checked in zip(names, quality.pairs, strict=True):
        places = seam_places(geometry, checked, by_pair[checked.pair])
        crops = seam_crops(mosaic_file, geometry, checked.pair, places, mosaic.first_line)
        seams.append((seam, [(_crop_words(place), markup(crop)) for place, crop in crops]))
    return render(
        "strips.html",
        report.summary,
        PageHead(
            title="Scene of " + plural(sum(map(bool, geometry.lines)), "CCD strip"),
            run=report.name,
            judged=PageVerdict(grade := _grade(quality), strips_verdict(quality), _FIXES.get(grade, "")),
            image=image,
            caption="Lines run downwards in the order they were taken. The full image is mosaic.tif.",
            facts=_facts(geometry, offsets, quality, mosaic),
            map_view=MapView(
                (0.0, 0.0),
                ("column", "line"),
                True,
                "px",
                False,
                (0.0, -float(mosaic.height_px), float(mosaic.width_px), 0.0),
                [],
                scene_layers(geometry, quality, mosaic.height_px, mosaic.first_line),
            ),
            table=_pair_table(geometry, quality, by_pair),
        ),
        gaps=_gaps(geometry, mosaic),
        limit=LIMIT_PX,
        segment_lines=SEGMENT_LINES,
        misplacement=markup(misplacement_plot(quality, names, label="misplacement of each segment")),
        seams=seams,
        curves=[(_pair_name(p.pair), _curve(p)) for p in offsets.pairs],
        spectrum=markup(spectrum_plot(found, left, label="spectrum of the offsets found and left")),
        separation_s=geometry.row_separation_lines / geometry.line_rate_hz,
        ccds=_ccd_rows(geometry, report.radiometry),
    )


def _pair_name(pair: int) -> str:
    return f"{pair + 1}–{pair + 2}"


def _curve(pair: PairOffsets) -> Markup:
    return markup(offsets_plot(pair, label=f"offsets of CCD {pair.pair + 2} against CCD {pair.pair + 1}"))


def _crop_words(place: Place) -> str:
    left = "" if np.isnan(place.left_px) else f", {short(place.left_px, 'px', 2)} left"
    return f"{place.why}: line {place.line}{left}"


def strips_verdict(quality: StripQuality) -> str:
    """What is known of how well the strips lie on one another; its first sentence says what isn't."""
    f = quality.figures
    if quality.misplaced is None:
        little = "Too little" if f.lines else "Nothing"
        return f"{little} could be checked: the strips lie where the offsets and the geometry put them."
    hidden = [_pair_name(p.pair) for p in quality.pairs if not np.isfinite(p.segments_px).any()]
    seams = "CCDs " + " and ".join([", ".join(hidden[:-1])] * (len(hidden) > 1) + hidden[-1:])
    rest = 1.0 - f.lines / max(quality.lines, 1)
    unknown = (
        f" {percent(rest)} of the lines could not be checked: bridged, unreliable or without texture."
        if rest > 0.005
        else ""
    )
    if quality.others.lines and quality.others.share_above > 0.05:
        share = percent(quality.others.share_above)
        unknown += (
            f" Where lines were bridged, {share} seem off by more than {LIMIT_PX:g} px: clouds, or misplaced."
        )
    if quality.misplaced:
        pair, segment = _worst(quality)
        odd = sum(int((p.segments_px > LIMIT_PX).sum()) for p in quality.pairs)
        many = sum(int(np.isfinite(p.segments_px).sum()) for p in quality.pairs)
        return (
            f"Misplaced: {odd} of {plural(many, 'segment')} {'is' if odd == 1 else 'are'} off by more than "
            f"{LIMIT_PX:g} px; the worst, between CCDs {pair.pair + 1} and {pair.pair + 2} at lines "
            f"{_segment_words(pair, segment)}, by {short(f.worst_segment_px, 'px', 2)}"
            f"{f'; between {seams} nothing could be checked' if hidden else ''}.{unknown}"
        )
    lead = f"Nothing could be checked between {seams}; elsewhere" if hidden else "In place:"
    return (
        f"{lead} neighbouring strips agree to {short(f.rms_px, 'px', 2)} RMS where they were checked; "
        f"the worst segment is off by {short(f.worst_segment_px, 'px', 2)}, the limit is {LIMIT_PX:g} px."
        f"{unknown}"
    )


def _grade(quality: StripQuality) -> str:
    """`bad` with a misplaced segment, `doubtful` with an unchecked seam, empty where nothing was checked."""
    if quality.misplaced is None:
        return ""
    hidden = any(not np.isfinite(p.segments_px).any() for p in quality.pairs)
    return "bad" if quality.misplaced else "doubtful" if hidden else "good"


def _worst(quality: StripQuality) -> tuple[PairQuality, int]:
    best = [np.nanmax(p.segments_px, initial=-1.0) for p in quality.pairs]
    pair = quality.pairs[int(np.argmax(best))]
    return pair, int(np.nanargmax(pair.segments_px))


def _segment_words(pair: PairQuality, segment: int) -> str:
    last = min((segment + 1) * SEGMENT_LINES, pair.lines) - 1
    return f"{segment * SEGMENT_LINES} to {last}"


def _facts(
    geometry: StripGeometry,
    offsets: StripOffsets,
    quality: StripQuality,
    mosaic: StripMosaic,
) -> list[Fact]:
    """What the head of the page says."""
    f, living = quality.figures, sum(map(bool, geometry.lines))
    n = max(quality.lines, 1)
    size = f"{whole(mosaic.width_px)} × {whole(mosaic.height_px)}"
    return [
        (
            "strips",
            f"{living} of {len(geometry.ccds)}",
            f"{whole(geometry.width_px)} px by {whole(max(geometry.lines))} lines",
        ),
        ("scene", size, f"{mosaic.dtype}, {mosaic.bit_depth} bits"),
        ("ground pixel", length(geometry.ground_pixel_m), f"{short(geometry.line_rate_hz)} lines a second"),
        ("method", offsets.method.replace("_", " "), "of the offsets"),
        ("misplacement", short(f.rms_px, "px", 2), f"RMS; 95 %: {short(f.p95_px, 'px', 2)}"),
        (
            "worst segment",
            short(f.worst_segment_px, "px", 2),
            f"lines above {LIMIT_PX:g} px: {percent(f.share_above)}",
        ),
        ("checked", percent(f.lines / n), f"of {whole(quality.lines)} lines of the overlaps"),
        ("not measured", percent(quality.other_lines / n), "bridged or unreliable"),
    ]


def _gaps(geometry: StripGeometry, mosaic: StripMosaic) -> list[str]:
    """What is missing from the scene."""
    longest = max(geometry.lines)
    out = [f"CCD {k + 1} has no strip." for k, lines in enumerate(geometry.lines) if not lines]
    out += [
        f"Columns {first} to {last - 1} of the scene are empty: no CCD saw them."
        for first, last in mosaic.gaps_px
    ]
    out += [
        f"The strip of CCD {k + 1} ends {plural(longest - lines, 'line')} before the longest."
        for k, lines in enumerate(geometry.lines)
        if 0 < lines < longest
    ]
    return out


def _pair_table(
    geometry: StripGeometry, quality: StripQuality, offsets: Mapping[int, PairOffsets]
) -> ReportTable:
    """Neighbouring CCDs: how their offsets were found, and what is left."""
    return ReportTable(
        "seam",
        (
            ("CCDs", False), ("state", False), ("left, RMS", True), ("worst segment", True),
            ("at lines", False),
            ("measured", True), ("bridged", True), ("unreliable", True), ("dcol, px", True),
            ("dline, px", True), ("strips", False),
        ),
        [_pair_row(geometry, k, p, offsets[p.pair]) for k, p in enumerate(quality.pairs)],
        (
            ("in place", f"no segment is off by more than {LIMIT_PX:g} px"),
            ("misplaced", "some segment is"),
            ("not checked", "nothing could be measured"),
        ),
        elsewhere="offsets.csv",
    )  # fmt: skip


def _pair_row(geometry: StripGeometry, place: int, checked: PairQuality, offsets: PairOffsets) -> TableRow:
    length_px = np.hypot(*checked.residual_px.T)
    known = np.isfinite(length_px) & (checked.counts > 0)
    counts = np.where(known, checked.counts, 0.0)
    squares = np.where(known, length_px, 0.0) ** 2 @ counts
    rms = float(np.sqrt(squares / counts.sum())) if known.any() else float("nan")
    segments = checked.segments_px
    some = bool(np.isfinite(segments).any())
    worst = float(np.nanmax(segments)) if some else float("nan")
    kind = "not checked" if not some else "misplaced" if worst > LIMIT_PX else "in place"
    files = [ccd.path.name if ccd.path else "" for ccd in geometry.ccds[checked.pair : checked.pair + 2]]
    spans = [
        Cell(f"{signed(float(v.min()))} to {signed(float(v.max()))}", f"{float(v.min()):.6g}")
        for v in (offsets.dcol_px, offsets.dline_px)
    ]
    return TableRow(
        place,
        kind,
        (
            Cell(_pair_name(checked.pair)),
            Cell(kind),
            number(rms, "px", 2),
            number(worst, "px", 2),
            Cell(_segment_words(checked, int(np.nanargmax(segments))) if some else "–"),
            *(
                Cell(percent(share), f"{share:.6g}" if share == share else "-1")
                for share in checked.share_of_labels
            ),
            *spans,
            Cell(" – ".join(files)),
        ),
    )


def _ccd_rows(
    geometry: StripGeometry, radiometry: Radiometry | None
) -> list[tuple[int, str, str, int, str, str]]:
    """Number, strip, row, lines, gain, offset of every CCD."""
    out = []
    for k, (ccd, lines) in enumerate(zip(geometry.ccds, geometry.lines, strict=True)):
        gain = offset = "–"
        if radiometry is not None and lines:
            gain, offset = short(float(radiometry.gain[k]), digits=4), signed(float(radiometry.offset[k]))
        row = "leading" if ccd.row == 1 else "trailing"
        out.append((k + 1, ccd.path.name if ccd.path else "none", row, lines, gain, offset))
    return out
