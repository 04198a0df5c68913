"""Systematic image residuals by place in the frame, as a lens or a shutter causes: the check of a camera
after self-calibration (Luhmann et al., Close-Range Photogrammetry, 3rd ed. 2020, section 7.2)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import legendre

from geomosaic.adjustment.kernels.row_functions import TERMS, VIBRATION_TERMS
from geomosaic.adjustment.model import ImageResiduals
from geomosaic.arrays import Bools, Floats, Ints
from geomosaic.camera.interior import Camera
from geomosaic.constants import tuned
from geomosaic.estimation.linear import least_squares
from geomosaic.estimation.robust import LEAST_OBSERVATIONS
from geomosaic.matching.tracks import frame_by_frame

CELLS: tuple[int, int] = tuned((8, 6), "columns, rows", "finer: few frames a cell; coarser: no lens shows")


@dataclass(frozen=True)
class ResidualPattern:
    """One camera's mean residuals by place in the frame. mean_px, sd_px (rows, cols, 2): mean of measured
    minus computed in each cell and its deviation, NaN with too few frames. systematic_px: root mean square
    without the part of chance."""

    camera: str
    mean_px: Floats
    sd_px: Floats
    systematic_px: float


def _valid(image: ImageResiduals) -> Bools:
    return np.asarray((image.weight > 0.5) & np.isfinite(image.residual_px).all(axis=1))


def residual_patterns(image: ImageResiduals, cameras: Sequence[Camera]) -> tuple[ResidualPattern, ...]:
    """A pattern for each camera; each frame counts once in a cell. Args: cameras: of each frame."""
    names = np.array([c.name for c in cameras])
    size = np.array([[c.width_px, c.height_px] for c in cameras], dtype=np.float64)
    cell = (image.image_px / size[image.frame] * CELLS).astype(np.intp)
    col, row = np.clip(cell, 0, np.array(CELLS) - 1).T
    frames = int(image.frame.max(initial=-1)) + 1
    place, valid = (row * CELLS[0] + col) * frames + image.frame, _valid(image)
    return tuple(
        _pattern(name, place[mine], image.residual_px[mine], frames)
        for name in dict.fromkeys(names.tolist())
        for mine in (valid & (names == name)[image.frame],)
    )


def left_by_vibration(image: ImageResiduals, cameras: Sequence[Camera]) -> float:
    """Residual deviation of functions of the row as fine as vibration's, as a share of that of functions as
    coarse as a rotation's, fitted frame by frame; 1 without vibration. Nested regressions, each with its own
    redundancy (Draper and Smith, Applied Regression Analysis, 3rd ed. 1998, section 6.1). Args: cameras: of
    each frame."""
    used, squares, redundancy = _valid(image), np.zeros(2), np.zeros(2)
    row_px, residual_px = image.image_px[used, 1], image.residual_px[used]
    for frame, own in frame_by_frame(image.frame[used]):
        count = len(row_px[own])
        if count <= 2 * VIBRATION_TERMS:
            continue
        rows = 2.0 * row_px[own] / cameras[frame].height_px - 1.0
        for k, terms in enumerate((TERMS, VIBRATION_TERMS)):
            design = legendre.legvander(rows, terms)
            left = residual_px[own] - design @ least_squares(design, residual_px[own])
            squares[k] += float((left**2).sum())
            redundancy[k] += count - terms - 1
    if not squares.all():
        return 1.0
    coarse, fine = squares / redundancy
    return float(np.sqrt(fine / coarse))


def _pattern(name: str, place: Ints, residual_px: Floats, frames: int) -> ResidualPattern:
    """The pattern of residuals (m, 2) by cell and frame (m,)."""
    cols, rows = CELLS
    bins = cols * rows * frames
    count = np.bincount(place, minlength=bins).astype(np.float64)
    total = [np.bincount(place, residual_px[:, k], bins) for k in (0, 1)]
    with np.errstate(invalid="ignore", divide="ignore"):
        of_frame = (np.stack(total, axis=-1) / count[:, None]).reshape(rows * cols, frames, 2)
        there = np.isfinite(of_frame[..., 0]).sum(axis=1)
        mean = np.nansum(of_frame, axis=1) / there[:, None]
        spread = np.nansum((of_frame - mean[:, None]) ** 2, axis=1) / (there - 1)[:, None]
        sd = np.sqrt(spread / there[:, None])
    few = there < LEAST_OBSERVATIONS
    mean[few], sd[few] = np.nan, np.nan
    excess = (mean**2 - sd**2).sum(axis=1)[~few]
    systematic = float(np.sqrt(max(excess.mean(), 0.0))) if excess.size else 0.0
    return ResidualPattern(name, mean.reshape(rows, cols, 2), sd.reshape(rows, cols, 2), systematic)
