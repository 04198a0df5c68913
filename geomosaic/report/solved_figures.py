"""What an adjustment solved and how sure it is, in words and numbers for the report."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from geomosaic.adjustment.model import Adjusted, ImageResiduals, SharedUnknowns
from geomosaic.arrays import Floats
from geomosaic.camera.interior import Camera
from geomosaic.report.numbers import by_deviation
from geomosaic.survey.model import Survey

STRONG = 0.7
"""Correlations beyond this are named."""
_UNITS = {"px": "px", "m": "m", "s": "s", "deg": "°", "rad": "rad"}
_WORDS = {
    "principal_col": "principal point, col",
    "principal_row": "principal point, row",
    "gps_lag": "GPS lag",
    "readout": "readout of all rows",
}
_HALF_PIXEL = 0.5
_MOST_CORRELATIONS = 20
_MOST_CELLS = 16
_LEAST_IN_CELL, _TYPICAL_IN_CELL = 5, 30


@dataclass(frozen=True)
class UnknownRow:
    """One number that frames share, as text; change in its unit, for a focal length also in per cent.

    change_sd: the change in standard deviations.
    """

    name: str
    given: str
    found: str
    change: str
    sd: str
    change_sd: str
    undetermined: bool


@dataclass(frozen=True)
class ResidualField:
    """Mean image residuals over one camera's image, as the sensor lay: what is not mean zero is no noise.

    at_px, mean_px (k, 2): cells' centres and weighted means. scatter_px: root mean square length that a
    mean would have by chance. observations: of all cells.
    """

    camera: Camera
    at_px: Floats
    mean_px: Floats
    scatter_px: float
    observations: int


def ground_reason(adjusted: Adjusted, asked: str = "auto") -> str:
    """Why the ground is what it is. asked: `Settings.ground`."""
    kind, relief_px = adjusted.ground.kind, adjusted.figures.get("ground_relief_px")
    if kind == "dem":
        return "a DEM was given"
    if asked != "auto":
        return "chosen by parameter"
    if relief_px is None:
        return "no DEM was given; images and attitudes agree with level ground"
    moves = f"relief moves points by {relief_px:.2g} px at the mosaic's resolution"
    if kind == "tie_surface" and relief_px > _HALF_PIXEL:
        return f"{moves}, more than half a pixel"
    if kind == "flat" and relief_px <= _HALF_PIXEL:
        return f"{moves}, not more than half a pixel"
    if kind == "tie_surface":
        return f"{moves}, but images or positions and attitudes contradict level ground"
    return f"chosen by parameter, though {moves}"


def unknown_tables(shared: SharedUnknowns) -> list[tuple[str, list[UnknownRow]]]:
    """One table for each camera and one for the platform: title and rows."""
    return [
        (of, [_row(shared, k) for k in range(len(shared.names)) if shared.of[k] == of])
        for of in dict.fromkeys(shared.of)
    ]


def _row(shared: SharedUnknowns, k: int) -> UnknownRow:
    given, found, sd = float(shared.given[k]), float(shared.found[k]), float(shared.sd[k])
    word, unit = unknown_name(shared.names[k])
    name = f"{word} [{unit}]" if unit else word
    if shared.fixed[k] or not (np.isfinite(sd) and sd > 0.0):
        return UnknownRow(name, f"{given:.6g}", "", "", "", "", True)
    decimals = by_deviation(sd)
    change = f"{found - given:+.{decimals}f}"
    if shared.names[k] == "focal_length_px":
        change += f" ({100.0 * (found - given) / given:+.2f} %)"
    before, after, spread = (f"{v:.{decimals}f}" for v in (given, found, sd))
    return UnknownRow(name, before, after, change, spread, f"{(found - given) / sd:+.1f}", False)


def unknown_name(name: str) -> tuple[str, str]:
    """`focal_length_px` as its words and its unit: `focal length`, `px`."""
    stem, _, last = name.rpartition("_")
    if last in _UNITS and stem:
        return _WORDS.get(stem, stem.replace("_", " ")), _UNITS[last]
    return name.replace("_", " "), ""


def solved_names(shared: SharedUnknowns) -> tuple[list[str], Floats]:
    """Names and correlations (k, k) of the numbers that were solved for; with the owner where it matters."""
    solved = np.flatnonzero(~shared.fixed)
    words = [unknown_name(shared.names[k])[0] for k in solved]
    several = len({shared.of[k] for k in solved if words.count(unknown_name(shared.names[k])[0]) > 1}) > 1
    names = [f"{shared.of[k]}: {word}" if several else word for k, word in zip(solved, words, strict=True)]
    return names, shared.correlation[np.ix_(solved, solved)]


def strong_correlations(names: Sequence[str], correlation: Floats) -> list[tuple[str, str, float]]:
    """Pairs with |r| above 0.7, the strongest first, 20 at most."""
    i, j = np.triu_indices(len(names), 1)
    r = np.nan_to_num(correlation[i, j])
    order = [k for k in np.argsort(-np.abs(r), kind="stable") if abs(r[k]) > STRONG]
    return [(names[i[k]], names[j[k]], float(r[k])) for k in order[:_MOST_CORRELATIONS]]


def residual_fields(
    survey: Survey, turned: Sequence[int], residuals: ImageResiduals, sigma_px: float
) -> list[ResidualField]:
    """For each camera the mean image residual in cells of its image.

    A lens belongs to the sensor: half-turned images (turned[i] of 2 quarters) are turned back.
    """
    camera_of = np.array([f.camera for f in survey.frames])[residuals.frame]
    half = np.array([q == 2 for q in turned] or [False] * len(survey.frames))[residuals.frame][:, None]
    out = []
    for camera in survey.cameras:
        size = np.array([camera.width_px, camera.height_px], dtype=np.float64)
        image_px = np.where(half, size - residuals.image_px, residuals.image_px)
        residual_px = np.where(half, -residuals.residual_px, residuals.residual_px)
        mine = (camera_of == camera.name) & np.isfinite(residual_px).all(axis=1)
        if mine.any():
            of = residuals.frame[mine], image_px[mine], residual_px[mine], residuals.weight[mine]
            out.append(_field(camera, ImageResiduals(*of), sigma_px))
    return out


def _field(camera: Camera, residuals: ImageResiduals, sigma_px: float) -> ResidualField:
    size = np.array([camera.width_px, camera.height_px], dtype=np.float64)
    image_px, residual_px, weight = residuals.image_px, residuals.residual_px, residuals.weight
    side = max(np.sqrt(np.prod(size) * _TYPICAL_IN_CELL / len(image_px)), size.max() / _MOST_CELLS)
    cells = np.maximum(np.round(size / side), 3).astype(np.int64)
    at = np.clip((image_px / size * cells).astype(np.int64), 0, cells - 1)
    cell = at[:, 1] * cells[0] + at[:, 0]
    total = np.bincount(cell, weight, minlength=int(np.prod(cells)))
    number = np.bincount(cell, minlength=len(total))
    full = np.flatnonzero((number >= _LEAST_IN_CELL) & (total > 0.0))
    sums = [np.bincount(cell, weight * residual_px[:, k], minlength=len(total)) for k in (0, 1)]
    return ResidualField(
        camera,
        (np.column_stack([full % cells[0], full // cells[0]]) + 0.5) / cells * size,
        np.column_stack(sums)[full] / total[full, None],
        sigma_px * float(np.sqrt(2.0 / np.median(number[full]))) if len(full) else float("nan"),
        len(image_px),
    )
