"""What residuals have in common at one place of all frames: a lens or a shutter does that, no tie point.

Averaging residuals by their place in the frame is how cameras are checked after a self-calibration (Luhmann
et al., Close-Range Photogrammetry, 3rd ed. 2020, section 7.2).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import NDArray

from geomosaic.adjustment.kernels.row_functions import TERMS, VIBRATION_TERMS
from geomosaic.adjustment.model import ImageResiduals
from geomosaic.adjustment.problem.tracks import frame_by_frame
from geomosaic.camera.interior import Camera
from geomosaic.constants import tuned
from geomosaic.estimation.linear import least_squares

Floats = NDArray[np.float64]

CELLS: tuple[int, int] = tuned(
    (8, 6),
    "columns, rows",
    "of the pattern: coarse enough that each cell sees many frames, fine enough for what a lens does "
    "from middle to corner",
)
LEAST_FRAMES = tuned(
    4,
    "frames",
    "seen by a cell, so that its mean's own deviation means something; by fewer, chance passes for a lens",
)
_HEARD = tuned(
    0.1,
    "share of the weight of a residual of 0",
    "residuals of less weight, beyond 5.9 deviations, are wrong matches and show no lens",
)


@dataclass(frozen=True)
class ResidualPattern:
    """One camera's mean residual by place in the frame.

    mean_px, sd_px (rows, cols, 2): measured minus computed in each cell and the mean's own deviation, NaN
    where too few frames have been there. systematic_px: root mean square of what is more than chance.
    """

    camera: str
    mean_px: Floats
    sd_px: Floats
    systematic_px: float


def residual_patterns(image: ImageResiduals, cameras: Sequence[Camera]) -> tuple[ResidualPattern, ...]:
    """A pattern for each camera; frames count alike in a cell, however many points they have there.

    Args: cameras: of each frame.
    """
    names = [c.name for c in cameras]
    heard = (image.weight > _HEARD) & np.isfinite(image.residual_px).all(axis=1)
    size = np.array([[c.width_px, c.height_px] for c in cameras], dtype=np.float64)
    cell = (image.image_px / size[image.frame] * CELLS).astype(np.intp)
    cell = np.clip(cell, 0, np.array(CELLS) - 1)
    return tuple(
        _pattern(name, cell, image, heard & np.array([n == name for n in names])[image.frame])
        for name in dict.fromkeys(names)
    )


def left_by_vibration(image: ImageResiduals, cameras: Sequence[Camera]) -> float:
    """Residuals of a smooth function of the row as fine as vibration's, as a share of those of one as coarse
    as turning's, fitted frame by frame; 1 where nothing vibrates.

    The ratio of two residual standard deviations, each by its own redundancy (nested regressions; Draper and
    Smith, Applied Regression Analysis, 3rd ed. 1998, section 6.1). Args: cameras: of each frame.
    """
    used = (image.weight > _HEARD) & np.isfinite(image.residual_px).all(axis=1)
    squares, redundancy = np.zeros(2), np.zeros(2)
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


def _pattern(
    name: str, cell: NDArray[np.intp], image: ImageResiduals, used: NDArray[np.bool_]
) -> ResidualPattern:
    cols, rows = CELLS
    frames = int(image.frame.max(initial=-1)) + 1
    place = (cell[used, 1] * cols + cell[used, 0]) * frames + image.frame[used]
    count = np.bincount(place, minlength=cols * rows * frames).astype(np.float64)
    total = [np.bincount(place, image.residual_px[used, k], cols * rows * frames) for k in (0, 1)]
    with np.errstate(invalid="ignore", divide="ignore"):
        of_frame = (np.stack(total, axis=-1) / count[:, None]).reshape(rows * cols, frames, 2)
        there = np.isfinite(of_frame[..., 0]).sum(axis=1)
        mean = np.nansum(of_frame, axis=1) / there[:, None]
        spread = np.nansum((of_frame - mean[:, None]) ** 2, axis=1) / (there - 1)[:, None]
        sd = np.sqrt(spread / there[:, None])
    few = there < LEAST_FRAMES
    mean[few], sd[few] = np.nan, np.nan
    excess = (mean**2 - sd**2).sum(axis=1)[~few]
    systematic = float(np.sqrt(max(excess.mean(), 0.0))) if excess.size else 0.0
    return ResidualPattern(name, mean.reshape(rows, cols, 2), sd.reshape(rows, cols, 2), systematic)
