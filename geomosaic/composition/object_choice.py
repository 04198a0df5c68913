"""Which objects lie on the surface: those that frames show alike there, and more so than on the ground."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from geomosaic.composition.objects import Objects
from geomosaic.composition.views import FrameView
from geomosaic.constants import sourced, tuned
from geomosaic.projection.ground import GroundSurface
from geomosaic.projection.resample import seen_on
from geomosaic.projection.warp import GroundWindow
from geomosaic.spread import Spread
from geomosaic.surface.refinement import NOISE_GREY
from geomosaic.survey.model import Frame, Survey
from geomosaic.survey.pixels import read_pixels
from geomosaic.survey.small import REDUCTIONS

Bools = NDArray[np.bool_]
Bytes = NDArray[np.uint8]
Floats = NDArray[np.float64]
Floats32 = NDArray[np.float32]
Views = Sequence[FrameView]
_FRAMES = tuned(4, "frames", "that show an object most steeply: fewer let one decide; more take time")
_WINDOW = tuned(7, "half nodes", "of correlation: larger mixes a roof with its yard; smaller is chance")
_MARGIN = _WINDOW // 2
LEAST_VIEWS = sourced(3, "frames", "that see an object whole", "two frames cannot contradict each other")
_CERTAIN = sourced(1.645, "deviations", "by which the surface is better", "Phi^-1(0.95)")
_ALIKE = sourced(0.5, "correlation", "of half an object at least", "as much signal in both frames as noise")


@dataclass(frozen=True)
class ObjectAgreement:
    """Of objects (n,): views, the frames that see it whole; on_surface and on_terrain, the median correlation
    of the frames over it; gain_sd, the deviation of their difference; NaN where nothing was compared."""

    views: NDArray[np.intp]
    on_surface: Floats
    on_terrain: Floats
    gain_sd: Floats

    @property
    def chosen(self) -> Bools:
        """Which objects the surface shows: at least `LEAST_VIEWS` frames see them whole, agree on them there,
        by `_ALIKE`, and do not on the terrain; and the difference is sure."""
        with np.errstate(invalid="ignore"):
            better = self.on_surface - self.on_terrain > _CERTAIN * self.gain_sd
            better &= (self.on_surface >= _ALIKE) & (self.on_terrain < _ALIKE)
        return np.asarray((self.views >= LEAST_VIEWS) & better)


@dataclass(frozen=True)
class _Land:
    """What frames are looked at on: objects, and the surface and the terrain on the same nodes."""

    surface: GroundSurface
    terrain: GroundSurface

    def windows(self, box: NDArray[np.intp]) -> list[GroundWindow]:
        """A box of nodes with its margin, in half nodes, on the surface and on the terrain."""
        grounds = self.surface, self.terrain
        row, col, last_row, last_col = box.tolist()
        rows, cols = last_row - row, last_col - col
        half_m = self.surface.spacing_m / 2.0
        polynomial = np.zeros((6, 3))
        polynomial[0, 0] = self.surface.east_0_m + half_m * (col + last_col - 1)
        polynomial[0, 1] = self.surface.north_0_m + half_m * (row + last_row - 1)
        polynomial[1, 0], polynomial[2, 1] = half_m * cols, half_m * rows
        found = []
        for ground in grounds:
            up_m = ground.up_m[row:last_row, col:last_col].astype(np.float32)
            denser = cv2.resize(up_m, (2 * cols, 2 * rows), interpolation=cv2.INTER_LINEAR)
            relief_m = np.asarray(denser, dtype=np.float32)
            found.append(GroundWindow(2 * cols, 2 * rows, polynomial, np.array([0.0, 0.0, 1.0]), relief_m))
        return found


@dataclass(frozen=True)
class _FrameObjects:
    """A frame, and the boxes (k, 4) of the nodes that are to be seen in it."""

    frame: Frame
    view: FrameView
    boxes: NDArray[np.intp]


def agreement(
    survey: Survey,
    views: Views,
    objects: Objects,
    grounds: tuple[GroundSurface, GroundSurface],
    spread: Spread,
) -> ObjectAgreement:
    """Of all objects, by the frames that see them most steeply; each frame is decoded once.

    grounds: the surface and the terrain, on the same nodes as the objects.
    """
    land = _Land(*grounds)
    boxes = objects.boxes + np.array([-1, -1, 1, 1]) * _MARGIN
    boxes = np.clip(boxes, 0, np.tile(objects.labels.shape, 2))
    seeing = _seeing(land, views, boxes)
    asked: dict[int, list[int]] = {}
    for k, frames in enumerate(seeing):
        if len(frames) >= LEAST_VIEWS:
            for i in frames[:_FRAMES]:
                asked.setdefault(i, []).append(k)
    looks = [_FrameObjects(survey.frames[views[i].frame], views[i], boxes[ks]) for i, ks in asked.items()]
    seen = spread.map("objects", partial(_looked, land), looks, [views[i].frame for i in asked])
    order = {i: dict(zip(ks, of, strict=True)) for (i, ks), of in zip(asked.items(), seen, strict=True)}
    views_of = np.array([len(frames) for frames in seeing], dtype=np.intp)
    figures = np.full((len(boxes), 3), np.nan)
    for k, frames in enumerate(seeing):
        if len(frames) < LEAST_VIEWS:
            continue
        row, col, last_row, last_col = boxes[k].tolist()
        labels = objects.labels[row:last_row, col:last_col].repeat(2, axis=0).repeat(2, axis=1)
        figures[k] = _figures([order[i][k] for i in frames[:_FRAMES]], labels == k + 1)
    return ObjectAgreement(views_of, *figures.T)


def _seeing(land: _Land, views: Views, boxes: NDArray[np.intp]) -> list[list[int]]:
    """The frames that see all of each box, on both grounds, the steepest first."""
    surface = land.surface
    spacing_m, corner = surface.spacing_m, np.array([surface.east_0_m, surface.north_0_m])
    places = corner + spacing_m * boxes[:, [[1, 0], [1, 2], [3, 0], [3, 2]]]
    up = np.empty((len(boxes), 2))
    for k, (row, col, last_row, last_col) in enumerate(boxes.tolist()):
        at = slice(row, last_row), slice(col, last_col)
        up[k] = float(land.terrain.up_m[at].min()), float(surface.up_m[at].max())
    points = np.concatenate(
        [
            np.concatenate([places, np.broadcast_to(up[:, None, j, None], (*places.shape[:2], 1))], axis=2)
            for j in (0, 1)
        ],
        axis=1,
    )
    nadirs = np.array([view.pose.position_m[:2] for view in views]).reshape(-1, 2)
    most = min(len(views), 4 * _FRAMES)
    if not len(boxes) or not most:
        return [[] for _ in boxes]
    _, near = KDTree(nadirs).query(places.mean(axis=1), k=np.arange(1, most + 1))
    found: list[dict[int, None]] = [{} for _ in boxes]
    whole = np.zeros(near.shape, dtype=bool)
    for i, view in enumerate(views):
        which = near == i
        of = np.flatnonzero(which.any(axis=1))
        if not of.size:
            continue
        px = view.pose.image_from_ground(view.camera, points[of])
        size = np.array([view.camera.width_px, view.camera.height_px])
        with np.errstate(invalid="ignore"):
            inside = ((px > 0.0) & (px < size)).all(axis=(1, 2))
        whole[of, which[of].argmax(axis=1)] = inside
    for k, (frames, sees) in enumerate(zip(near.tolist(), whole, strict=True)):
        found[k] = dict.fromkeys(i for i, s in zip(frames, sees.tolist(), strict=True) if s)
    return [list(of) for of in found]


def _looked(land: _Land, look: _FrameObjects) -> list[Bytes]:
    """Of each box how the frame shows it on the surface and on the terrain, (2, rows, cols) in half nodes; 0
    where it doesn't."""
    finer = land.surface.spacing_m / 2.0 / look.view.gsd_m
    reduction = max(r for r in REDUCTIONS if r == 1 or r <= finer)
    pixels, mask = read_pixels(look.frame, luma=True)
    grey = pixels.mean(axis=2, dtype=np.float32)
    scale = np.float32(255.0 / max(float(grey.max(initial=0.0)), 1.0)) if grey.max() > 255 else np.float32(1)
    if reduction > 1:
        grey = np.asarray(cv2.blur(grey, (reduction, reduction)), dtype=np.float32)
    found = []
    for box in look.boxes:
        shown = []
        for window in land.windows(box):
            image, valid = seen_on(window, look.view.pose, look.view.camera, grey, mask)
            shown.append(np.where(valid, np.clip(image * scale, 1.0, 255.0), 0.0).astype(np.uint8))
        found.append(np.stack(shown))
    return found


def _figures(shown: Sequence[Bytes], own: Bools) -> tuple[float, float, float]:
    """Median correlation on the surface and on the terrain over an object, and the deviation of their
    difference, by as many windows as it holds."""
    first, *others = shown
    with np.errstate(invalid="ignore"):
        on = np.stack([[_correlation(first[g], other[g]) for other in others] for g in (0, 1)])
        both = np.isfinite(on).all(axis=(0, 1))
        on_surface, on_terrain = np.median(on, axis=1)
    own = own & both
    windows = float(np.count_nonzero(own)) / _WINDOW**2
    if windows <= 1.0:
        return np.nan, np.nan, np.nan
    sd = float((on_surface - on_terrain)[own].std() / np.sqrt(windows))
    return float(np.median(on_surface[own])), float(np.median(on_terrain[own])), sd


def _correlation(one: Bytes, other: Bytes) -> Floats32:
    """In windows, NaN where one of both shows nothing."""
    a, b = one.astype(np.float32), other.astype(np.float32)
    side = (_WINDOW, _WINDOW)
    mean_a, mean_b = cv2.blur(a, side), cv2.blur(b, side)
    noise = np.float32(NOISE_GREY**2)
    spread_a = np.maximum(cv2.blur(a * a, side) - mean_a**2, 0.0) + noise
    spread_b = np.maximum(cv2.blur(b * b, side) - mean_b**2, 0.0) + noise
    found = (cv2.blur(a * b, side) - mean_a * mean_b) / np.sqrt(spread_a * spread_b)
    lacking = cv2.dilate(((one == 0) | (other == 0)).view(np.uint8), np.ones(side, np.uint8)) > 0
    return np.where(lacking, np.float32(np.nan), found).astype(np.float32)
