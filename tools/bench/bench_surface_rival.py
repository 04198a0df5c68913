"""OpenCV's StereoSGBM as a rival: pairs rectified by the adjusted poses, medians of heights on the cells."""

from __future__ import annotations

import time
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from geomosaic.adjustment.model import Adjusted
from geomosaic.constants import sourced, tuned
from geomosaic.pipeline.run_results import load_artefact, read_summary
from geomosaic.projection.footprint import footprint, ground_sampling_distance_m
from geomosaic.projection.ground import GroundSurface
from geomosaic.surface.cells import Cells
from geomosaic.surface.dtm import filled
from geomosaic.surface.model import DenseSurface
from geomosaic.survey.model import Survey
from geomosaic.survey.pixels import read_pixels

Bytes = NDArray[np.uint8]
Floats = NDArray[np.float64]
_REDUCED = tuned(2, "", "frames are reduced by it: each pair gives a cell of 4 ground pixels four heights")
_PAIRS = tuned(3, "neighbours", "of each frame that it is paired with")
_BELOW, _ABOVE = 0.1, 0.3
"""Of the flying height, how far below and above the ground through tie points is looked: as surface.dense."""
_WINDOW_PX = 5
_SMOOTH: tuple[int, int] = sourced(
    (8 * _WINDOW_PX**2, 32 * _WINDOW_PX**2),
    "",
    "what a step of one and of more costs, a pixel of the window",
    "OpenCV's advice: 8 and 32",
)


def stereo_sgbm(run: Path) -> tuple[DenseSurface, float]:
    """The surface on the run's cells, and the seconds that it took. Cells without a height are filled evenly
    and count as filled; deviations are not known."""
    summary = read_summary(run)
    survey: Survey = load_artefact(run, summary, "survey", Survey)
    adjusted: Adjusted = load_artefact(run, summary, "adjusted", Adjusted)
    cells = load_artefact(run, summary, "surface", DenseSurface).cells
    begun = time.perf_counter()
    images = [read_pixels(frame, _REDUCED, luma=True)[0] for frame in survey.frames]
    greys = [image[..., 0] if image.ndim == 3 else image for image in images]
    at = adjusted.poses.positions_m
    near = np.argsort(np.linalg.norm(at[:, None] - at, axis=2), axis=1, kind="stable")[:, 1 : _PAIRS + 1]
    pairs = sorted({(min(i, j), max(i, j)) for i, row in enumerate(near.tolist()) for j in row})
    found = np.concatenate([_points(adjusted, greys, i, j) for i, j in pairs])
    up_m, known = _medians(cells, found)
    up_m = filled(up_m, known)
    seconds = time.perf_counter() - begun
    nothing = np.full(up_m.shape, np.nan, dtype=np.float32)
    return DenseSurface(cells, up_m, nothing, known.astype(np.uint8) * 2), seconds


def _points(adjusted: Adjusted, greys: list[Bytes], i: int, j: int) -> Floats:
    """Points (n, 3) that a pair shows. Both frames are rectified: x along the base and z as near to straight
    down as it allows. So a point lies in both on one row."""
    ground: GroundSurface = adjusted.ground
    origins = adjusted.poses.positions_m[[i, j]]
    base_m = float(np.linalg.norm(origins[1] - origins[0]))
    x = (origins[1] - origins[0]) / base_m
    z = -np.array([0.0, 0.0, 1.0]) + x * x[2]
    z /= np.linalg.norm(z)
    axes = np.stack([x, np.cross(z, x), z])
    outlines = [footprint(adjusted.poses[k], adjusted.cameras[k], ground) for k in (i, j)]
    seen = [
        (outline[np.isfinite(outline).all(axis=1)] - o) @ axes.T
        for outline, o in zip(outlines, origins, strict=True)
    ]
    flying_m = float(np.median(seen[0][:, 2]))
    focal_px = (
        flying_m / _REDUCED / ground_sampling_distance_m(adjusted.poses[i], adjusted.cameras[i], ground)
    )
    near_m = min(s[:, 2].min() for s in seen) - _ABOVE * flying_m
    far_m = max(s[:, 2].max() for s in seen) + _BELOW * flying_m
    least = int(np.floor(focal_px * base_m / far_m))
    number = -(-(int(np.ceil(focal_px * base_m / near_m)) - least) // 16) * 16
    (left, top), (right, bottom) = (
        f(focal_px * seen[0][:, :2] / seen[0][:, 2:], axis=0) for f in (np.min, np.max)
    )
    col, row = np.arange(left - number, right), np.arange(top, bottom)
    images = []
    for k, origin, shift in ((i, origins[0], 0), (j, origins[1], least)):
        rays = np.stack(np.broadcast_arrays(col - shift, row[:, None], focal_px), axis=-1) @ axes
        px = adjusted.poses[k].image_from_ground(adjusted.cameras[k], origin + rays * (flying_m / focal_px))
        px = np.nan_to_num(px / _REDUCED - 0.5, nan=-1e4).astype(np.float32)
        images.append(cv2.remap(greys[k], px[..., 0], px[..., 1], cv2.INTER_LINEAR))
    matcher = cv2.StereoSGBM.create(
        0, number, _WINDOW_PX, *_SMOOTH, disp12MaxDiff=1, preFilterCap=31, uniquenessRatio=5,
        speckleWindowSize=100, speckleRange=2, mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
    )  # fmt: skip
    disparity = matcher.compute(*images).astype(np.float64) / 16.0
    v, u = np.nonzero((disparity >= 0.0) & (images[0] > 0))
    there = images[1][v, np.maximum(u - np.round(disparity[v, u]).astype(np.intp), 0)] > 0
    v, u = v[there], u[there]
    depth = focal_px * base_m / (disparity[v, u] + least)
    rays = np.stack([col[u], row[v], np.full(len(u), focal_px)], axis=-1) / focal_px
    return np.asarray(origins[0] + (rays * depth[:, None]) @ axes)


def _medians(cells: Cells, points: Floats) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """The median height in each cell (rows, cols), and where there is one."""
    east, north = cells.axes_m()
    col = np.round((points[:, 0] - east[0]) / cells.cell_m).astype(np.intp)
    row = np.round((points[:, 1] - north[0]) / cells.cell_m).astype(np.intp)
    inside = (col >= 0) & (row >= 0) & (col < len(east)) & (row < len(north))
    place, height = (row * len(east) + col)[inside], points[inside, 2]
    order = np.lexsort((height, place))
    place, height = place[order], height[order]
    at, first, number = np.unique(place, return_index=True, return_counts=True)
    up_m = np.zeros(len(north) * len(east), dtype=np.float32)
    up_m[at] = (height[first + (number - 1) // 2] + height[first + number // 2]) / 2.0
    known = np.zeros(up_m.shape, dtype=bool)
    known[at] = True
    return up_m.reshape(len(north), -1), known.reshape(len(north), -1)
