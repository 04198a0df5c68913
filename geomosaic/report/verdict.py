"""The report's first words: can the mosaic be trusted, why, and what would fix it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from markupsafe import Markup

from geomosaic.adjustment.procedure.residual_pattern import CELLS, ResidualPattern
from geomosaic.quality.statement import asprs_statement
from geomosaic.quality.verdict import Evidence, Verdict
from geomosaic.report.accuracy_table import accuracy_table
from geomosaic.report.control import PointFigures
from geomosaic.report.numbers import map_metres, short
from geomosaic.report.page import PageVerdict, markup
from geomosaic.report.solved_plots import image_vectors
from geomosaic.survey.model import Survey

_WORST_SEAMS = 12
_GOOD = "Nothing that was measured speaks against this mosaic."
_NOT_JUDGED = "The recipe has no stage quality.verdict."


@dataclass(frozen=True)
class VerdictSection:
    """What the template shows. evidence: (name, figure, grade, cause, fix); seams: (left, right, how far the
    ground jumps, easting, northing), worst first; patterns: images with their captions."""

    judged: PageVerdict
    evidence: list[tuple[str, str, str, str, str]]
    seams: list[tuple[str, str, str, str, str]]
    measured: str
    patterns: list[tuple[str, Markup]]


def verdict_section(
    survey: Survey, verdict: Verdict | None, pixel_m: float, points: Sequence[PointFigures] = ()
) -> VerdictSection:
    """Of a run without a verdict it says that there is none. points: those of control and check points."""
    rows = [f.row for f in points]
    if verdict is None:
        return VerdictSection(PageVerdict("", _NOT_JUDGED, points=rows), [], [], "", [])
    seams, length = verdict.seams, verdict.seams.length_px
    worst = [i for i in np.argsort(-np.nan_to_num(length)) if np.isfinite(length[i])][:_WORST_SEAMS]
    names = [f.name for f in survey.frames]
    cause = f"{_sentence(verdict.cause)} " if verdict.cause else _GOOD * (verdict.grade == "good") + " "
    return VerdictSection(
        judged=PageVerdict(
            verdict.grade,
            f"{cause}{_sentence(verdict.text)}",
            _sentence(verdict.fix),
            accuracy_table(verdict.accuracy, verdict.required, verdict.seams, pixel_m),
            rows,
            asprs_statement(verdict.accuracy.absolute),
        ),
        evidence=[_row(e) for e in verdict.evidence],
        seams=[
            (
                names[seams.left[i]],
                names[seams.right[i]],
                short(float(length[i]), "px"),
                map_metres(float(seams.at_m[i, 0])),
                map_metres(float(seams.at_m[i, 1])),
            )
            for i in worst
        ],
        measured=f"{int(np.isfinite(length).sum())} of {len(length)}",
        patterns=[_pattern(survey, p) for p in verdict.patterns],
    )


def _row(e: Evidence) -> tuple[str, str, str, str, str]:
    """A warning that counts as evidence is named by its code, and is there or not: it has no figure.
    The cause is followed by what it does to the map, and where."""
    cause = "; ".join(filter(None, [e.cause, e.effect]))
    return e.name.replace("-", " "), e.figure if e.unit else "", e.grade, cause, e.fix


def _sentence(words: str) -> str:
    return f"{_capital(words)}." if words else ""


def _capital(words: str) -> str:
    return words[:1].upper() + words[1:]


def _pattern(survey: Survey, pattern: ResidualPattern) -> tuple[str, Markup]:
    """Mean residuals over the camera's image, and a caption."""
    (camera,) = (c for c in survey.cameras if c.name == pattern.camera)
    size = camera.width_px, camera.height_px
    known = np.isfinite(pattern.mean_px).all(axis=-1)
    row, col = np.nonzero(known)
    at_px = (np.column_stack([col, row]) + 0.5) / CELLS * size
    label = f"mean residuals by place in the image, {pattern.camera}"
    drawn = image_vectors(size, np.column_stack([at_px, pattern.mean_px[known]]), label=label)
    return f"{pattern.camera}: beyond chance {short(pattern.systematic_px, 'px')}", markup(drawn)
