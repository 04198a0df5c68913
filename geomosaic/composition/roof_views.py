"""A roof as frames show it: on its own heights, and on the ground."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy import ndimage

from geomosaic.arrays import Bools, Bytes, Floats, Floats32, Ints32
from geomosaic.composition.roof_planes import roof_planes
from geomosaic.composition.seam_parts import HIGH_M
from geomosaic.composition.views import FrameView
from geomosaic.constants import sourced, tuned
from geomosaic.matching.features import grey
from geomosaic.projection.ground import GroundSurface
from geomosaic.projection.resample import seen_on
from geomosaic.projection.warp import GroundWindow
from geomosaic.survey.model import Frame
from geomosaic.survey.pixels import read_pixels

Box = tuple[slice, slice]
"""Rows and cols of nodes."""
FINER = tuned(2, "px a node", "of a roof's window: less loses the frames' detail; more resamples for nothing")
LEAST_VIEWS = sourced(3, "frames", "that see an object whole", "two frames cannot contradict each other")
_VIEWS = tuned(5, "frames", "nearest to an object, that are compared: fewer let one decide; more take time")
_LEAST_M2 = tuned(
    20.0, "m2", "of a roof: less raises crowns of few nodes, which a plane fits; more loses sheds"
)
_PLANE_SHARE = tuned(0.8, "share", "of a roof that planes fit: less raises crowns; more loses houses")
_EDGE_PX = tuned(4.0, "frame px", "rim left out of a roof's views: less meets what no frame shows")
OFF_EDGES = tuned(np.ones((5, 5), np.uint8), "px", "about planes or a roof, still of it; more: its yard")
_FARTHEST_M = tuned(
    12.0, "m", "beyond an object that is looked at: less cuts shadows of towers; more is slow"
)
_LEAST_LEAN_NODES = tuned(2.0, "nodes", "of a roof worth raising: less gains nothing, and edges may fray")
_HIGHEST = tuned(1.5, "of the highest node", "of a roof's planes, which are carried out to its edges")
_LOWEST_M = tuned(0.5, "m", "of a roof over the ground: lower is a plane that was carried too far")


@dataclass(frozen=True)
class Roof:
    """An object on a window of pixels, (rows, cols), from the south up: roof_m and ground_m, its planes'
    height and the ground's, everywhere; mask: where the object is. frames: indices of the views that see it
    whole, the steepest first. west_m, south_m: the first pixel's middle; pixel_m: its side."""

    west_m: float
    south_m: float
    pixel_m: float
    roof_m: Floats32
    ground_m: Floats32
    mask: Bools
    frames: tuple[int, ...]

    def window(self, up_m: Floats32) -> GroundWindow:
        """Of its pixels at some height."""
        rows, cols = up_m.shape
        polynomial = np.zeros((6, 3))
        polynomial[0, 0] = self.west_m + self.pixel_m * (cols - 1) / 2.0
        polynomial[0, 1] = self.south_m + self.pixel_m * (rows - 1) / 2.0
        polynomial[1, 0], polynomial[2, 1] = self.pixel_m * cols / 2.0, self.pixel_m * rows / 2.0
        return GroundWindow(cols, rows, polynomial, np.array([0.0, 0.0, 1.0]), up_m)

    def hides(self, mask: Bools, views: Sequence[FrameView]) -> list[Bools]:
        """The ground (rows, cols) that the roof, where mask is, hides from each view. Lines of sight are
        followed pixel by pixel up to the roof's height, each time in the box that they may meet the mask
        from."""
        return [self._hides(mask, view.pose.position_m) for view in views]

    def _hides(self, mask: Bools, camera_m: Floats) -> Bools:
        rows, cols = mask.shape
        hidden, inside = np.zeros(mask.shape, dtype=bool), ndimage.find_objects(mask.view(np.uint8))
        if not inside:
            return hidden
        east = (camera_m[0] - self.west_m - self.pixel_m * np.arange(cols)).astype(np.float32)
        north = (camera_m[1] - self.south_m - self.pixel_m * np.arange(rows)).astype(np.float32)[:, None]
        away = np.maximum(np.hypot(east, north), np.float32(self.pixel_m))
        rise = (np.float32(camera_m[2]) - self.ground_m) / away * np.float32(self.pixel_m)
        top = np.where(mask, self.roof_m, np.float32(-1e4))
        highest = float((self.roof_m - self.ground_m)[mask].max(initial=0.0))
        steps = min(int(highest / float(rise.min())) + 1, max(rows, cols))
        col, row = np.arange(cols, dtype=np.float32), np.arange(rows, dtype=np.float32)[:, None]
        ahead = [(of / away)[inside[0]] for of in (north, east)]
        ahead = [(float(of.min()), float(of.max())) for of in ahead]
        for step in range(1, steps + 1):
            box = tuple(
                slice(max(int(of.start - step * most) - 2, 0), max(int(of.stop - step * least) + 3, 0))
                for of, (least, most) in zip(inside[0], ahead, strict=True)
            )
            far, east_of, north_of = away[box], east[box[1]], north[box[0]]
            at = col[box[1]] + step * east_of / far, row[box[0]] + step * north_of / far
            if far.size:
                over = cv2.remap(
                    top, *at, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=(-1e4,) * 4
                )
                hidden[box] |= over > self.ground_m[box] + step * rise[box]
        return hidden & ~mask


@dataclass(frozen=True)
class RoofSeen:
    """A roof as one frame shows it, (rows, cols): on_roof at its planes' height, on_ground at the ground's; 0
    where the frame ends."""

    on_roof: Bytes
    on_ground: Bytes


def roof_candidate(
    surface: GroundSurface,
    ground_m: Floats32,
    labels: Ints32,
    found: tuple[int, Box],
    views: Sequence[FrameView],
) -> Roof | None:
    """An object, if it stands high, is of planes, and `LEAST_VIEWS` frames see it whole.

    ground_m (rows, cols): the ground at the surface's nodes. found: the object's number and its box of nodes.
    """
    number, at = found
    own = labels[at] == number
    over_m = surface.up_m[at] - ground_m[at]
    if np.count_nonzero(own) * surface.spacing_m**2 < _LEAST_M2 or np.median(over_m[own]) < HIGH_M:
        return None
    heights_m = float(ground_m[at].min()), float(surface.up_m[at][own].max())
    frames, tangents = _seeing(surface, at, heights_m, views)
    if len(frames) < LEAST_VIEWS:
        return None
    leans = [(heights_m[1] - heights_m[0]) * tangent / surface.spacing_m for tangent in tangents]
    if leans[0] < _LEAST_LEAN_NODES:
        return None
    beyond = int(min(leans[-1], _FARTHEST_M / surface.spacing_m)) + 4
    rows, cols = (
        slice(max(of.start - beyond, 0), min(of.stop + beyond, n))
        for of, n in zip(at, labels.shape, strict=True)
    )
    own = labels[rows, cols] == number
    over_m = (surface.up_m[rows, cols] - ground_m[rows, cols]).astype(np.float32)
    planes = roof_planes(over_m, own, surface.spacing_m)
    if planes.share < _PLANE_SHARE:
        return None
    size = own.shape[1] * FINER, own.shape[0] * FINER
    low_m = np.asarray(cv2.resize(ground_m[rows, cols], size, interpolation=cv2.INTER_LINEAR), np.float32)
    high_m = np.clip(planes.heights_m(FINER), np.float32(_LOWEST_M), np.float32(_HIGHEST) * over_m[own].max())
    own &= cv2.dilate((planes.labels > 0).view(np.uint8), OFF_EDGES) > 0
    mask = cv2.resize(own.astype(np.float32), size, interpolation=cv2.INTER_LINEAR) > 0.5
    pixel_m = surface.spacing_m / FINER
    west_m = surface.east_0_m + surface.spacing_m * (cols.start - 0.5) + pixel_m / 2.0
    south_m = surface.north_0_m + surface.spacing_m * (rows.start - 0.5) + pixel_m / 2.0
    return Roof(west_m, south_m, pixel_m, low_m + high_m, low_m, np.asarray(mask), frames)


def _seeing(
    surface: GroundSurface,
    box: Box,
    heights_m: tuple[float, float],
    views: Sequence[FrameView],
) -> tuple[tuple[int, ...], list[float]]:
    """The steepest views that have a box of nodes with two more about it in their image, and how aslant the
    first and the last of them look."""
    rows, cols = (np.array([of.start - 2, of.stop + 1]) for of in box)
    corners = np.stack(np.meshgrid(
        surface.east_0_m + surface.spacing_m * cols, surface.north_0_m + surface.spacing_m * rows, heights_m
    ), axis=-1).reshape(-1, 3)  # fmt: skip
    positions_m = np.array([v.pose.position_m for v in views]).reshape(-1, 3)
    away = np.hypot(*(positions_m[:, :2] - corners[:, :2].mean(axis=0)).T)
    found, tangents = [], []
    for i in np.argsort(away, kind="stable").tolist():
        px = views[i].pose.image_from_ground(views[i].camera, corners)
        size = np.array([views[i].camera.width_px, views[i].camera.height_px])
        with np.errstate(invalid="ignore"):
            if ((px > _EDGE_PX) & (px < size - _EDGE_PX)).all():
                found.append(i)
                tangents.append(float(away[i] / (positions_m[i, 2] - heights_m[0])))
        if len(found) == _VIEWS:
            break
    return tuple(found), tangents


@dataclass(frozen=True)
class RoofsOfFrame:
    """A frame and the roofs that are looked at in it."""

    frame: Frame
    view: FrameView
    roofs: tuple[Roof, ...]


def roofs_seen(look: RoofsOfFrame) -> list[RoofSeen]:
    """Each roof as the frame shows it, averaged over the roof's pixels; the frame is decoded once."""
    pixels, mask = read_pixels(look.frame, luma=True)
    box = _centred_box(look.roofs[0].pixel_m / look.view.gsd_m)
    image = np.maximum(grey(pixels, mask), 1)
    shown = np.asarray(cv2.sepFilter2D(image, cv2.CV_32F, box, box), dtype=np.float32)
    found = []
    for roof in look.roofs:
        both = []
        for up_m in (roof.roof_m, roof.ground_m):
            there, valid = seen_on(roof.window(up_m), look.view.pose, look.view.camera, shown, mask)
            both.append(np.where(valid, np.clip(there, 1.0, 255.0), 0.0).astype(np.uint8))
        found.append(RoofSeen(*both))
    return found


def _centred_box(width_px: float) -> Floats32:
    """Weights of a box of that width, one pixel at least, about the middle of a pixel: it shifts nothing."""
    half = max(width_px, 1.0) / 2.0
    reach = int(np.ceil(half - 0.5))
    weights = np.clip(half + 0.5 - np.abs(np.arange(-reach, reach + 1)), 0.0, 1.0)
    return np.asarray(weights / weights.sum(), dtype=np.float32)
