"""The report's first words: can the mosaic be trusted, why, and what would mend it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from markupsafe import Markup

from geomosaic.adjustment.residual_pattern import CELLS, ResidualPattern
from geomosaic.export.report_page import markup
from geomosaic.export.svg import COLOURS, document, number, short, tag, text
from geomosaic.quality.verdict import Verdict
from geomosaic.survey.model import Survey

_WORST_SEAMS = 12
_ARROW_PX = 40.0
_CELL_PX = 70.0
_LEADS = {
    "good": "Good: nothing that was measured speaks against this mosaic.",
    "doubtful": "Doubtful:",
    "bad": "Bad:",
}
_NOT_JUDGED = "Not judged: the recipe has no stage quality.verdict."


@dataclass(frozen=True)
class VerdictSection:
    """What the template shows. evidence: (name, figure, grade, cause, mend); seams: (left, right, how far the
    ground jumps, easting, northing), worst first; patterns: pictures with their captions."""

    grade: str
    lead: str
    mend: str
    evidence: list[tuple[str, str, str, str, str]]
    seams: list[tuple[str, str, str, str, str]]
    measured: str
    patterns: list[tuple[str, Markup]]


def verdict_section(survey: Survey, verdict: Verdict | None) -> VerdictSection:
    """Of a run without a verdict it says that there is none."""
    if verdict is None:
        return VerdictSection("", _NOT_JUDGED, "", [], [], "", [])
    seams, length = verdict.seams, verdict.seams.length_px
    worst = [i for i in np.argsort(-np.nan_to_num(length)) if np.isfinite(length[i])][:_WORST_SEAMS]
    names = [f.name for f in survey.frames]
    cause = f" {verdict.cause}." if verdict.cause else ""
    return VerdictSection(
        grade=verdict.grade,
        lead=f"{_LEADS[verdict.grade]}{cause} {verdict.text[:1].upper()}{verdict.text[1:]}.",
        mend=verdict.mend,
        evidence=[(e.name, e.figure, e.grade, e.cause, e.mend) for e in verdict.evidence],
        seams=[
            (
                names[seams.left[i]],
                names[seams.right[i]],
                short(float(length[i]), "px"),
                f"{seams.at_m[i, 0]:.1f}",
                f"{seams.at_m[i, 1]:.1f}",
            )
            for i in worst
        ],
        measured=f"{int(np.isfinite(length).sum())} of {len(length)}",
        patterns=[(p.camera, markup(_pattern(p))) for p in verdict.patterns],
    )


def _pattern(pattern: ResidualPattern) -> str:
    """Mean residuals as arrows over the frame; the longest is `_ARROW_PX` long in the picture."""
    cols, rows = CELLS
    width, height = cols * _CELL_PX, rows * _CELL_PX
    length = np.linalg.norm(pattern.mean_px, axis=-1)
    longest = float(np.nanmax(length)) if np.isfinite(length).any() else 0.0
    drawn = [tag("rect", x=0.5, y=0.5, width=width - 1.0, height=height - 1.0, class_="axis")]
    for row, col in np.argwhere(np.isfinite(length) & (length > 0.0)):
        x, y = (col + 0.5) * _CELL_PX, (row + 0.5) * _CELL_PX
        dx, dy = pattern.mean_px[row, col] * _ARROW_PX / longest
        path = f"M{number(x)},{number(y)}l{number(dx)},{number(dy)}"
        drawn.append(tag("path", d=path, stroke=COLOURS[0], stroke_width=2.0, fill="none"))
        drawn.append(tag("circle", cx=float(x), cy=float(y), r=2.5, fill=COLOURS[0]))
    words = f"longest {short(longest, 'px')}; beyond chance {short(pattern.systematic_px, 'px')}"
    drawn.append(text(0.0, height + 20.0, words))
    return document(width, height + 28.0, drawn, f"mean residuals by place in the frame, {pattern.camera}")
