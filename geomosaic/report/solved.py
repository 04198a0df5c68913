"""The report's section on what was solved: the ground, what frames share, residuals."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geomosaic.adjustment.model import Adjusted
from geomosaic.placement.model import Placement
from geomosaic.report.numbers import plural, short
from geomosaic.report.plots import Axis, histogram
from geomosaic.report.solved_figures import (
    STRONG,
    UnknownRow,
    residual_fields,
    solved_names,
    strong_correlations,
    unknown_tables,
)
from geomosaic.report.solved_plots import correlation_map, image_vectors
from geomosaic.survey.model import Survey

_MOST_CAMERAS = 6


@dataclass(frozen=True)
class SolvedSection:
    """Texts, tables and images (SVG); empty where a method doesn't say.

    unknowns: title and rows of each camera and of the platform. correlations: pairs that can hardly be
    distinguished. fields: title and image of each camera's mean residuals.
    """

    ground: str
    unknowns: list[tuple[str, list[UnknownRow]]]
    strong: float
    correlations: list[tuple[str, str, float]]
    correlation_map: str
    fields: list[tuple[str, str]]
    lengths: str


def solved_section(
    survey: Survey,
    placement: Placement,
    adjusted: Adjusted,
    ground: str,
) -> SolvedSection:
    """Everything the section shows. ground: the sentence on the surface and why it was taken."""
    shared = adjusted.shared
    names, correlation = ([], np.zeros((0, 0))) if shared is None else solved_names(shared)
    sizes = {c.name: f"{c.name}, {c.width_px} × {c.height_px} px" for c in survey.cameras}
    tables = [] if shared is None else unknown_tables(shared)
    return SolvedSection(
        ground,
        [(sizes.get(of, of), rows) for of, rows in tables],
        STRONG,
        strong_correlations(names, correlation),
        correlation_map(names, correlation, label="correlations of what was solved")
        if len(names) > 1
        else "",
        _fields(survey, placement, adjusted),
        _lengths(adjusted),
    )


def _sigma_px(adjusted: Adjusted) -> float:
    return adjusted.figures.get("sigma_px", float("nan"))


def _fields(survey: Survey, placement: Placement, adjusted: Adjusted) -> list[tuple[str, str]]:
    if adjusted.image_residuals is None:
        return []
    fields = residual_fields(survey, placement.turned, adjusted.image_residuals, _sigma_px(adjusted))
    out = []
    for f in fields[:_MOST_CAMERAS]:
        drawn = image_vectors(
            (f.camera.width_px, f.camera.height_px),
            np.column_stack([f.at_px, f.mean_px]),
            label=f"mean image residuals of {f.camera.name}",
            principal_px=(f.camera.principal_col_px, f.camera.principal_row_px),
            scatter_px=f.scatter_px,
        )
        out.append((f"{f.camera.name}: means of {plural(f.observations, 'observation')}", drawn))
    return out


def _lengths(adjusted: Adjusted) -> str:
    """Histogram of the image residuals' lengths, with the deviation of one coordinate."""
    if adjusted.image_residuals is None or not len(adjusted.image_residuals.frame):
        return ""
    sigma_px = _sigma_px(adjusted)
    return histogram(
        np.linalg.norm(adjusted.image_residuals.residual_px, axis=1),
        Axis("length of the residual", "px"),
        label="lengths of the tie points' image residuals",
        mark=(f"σ = {short(sigma_px, 'px')}", sigma_px) if np.isfinite(sigma_px) else None,
    )
