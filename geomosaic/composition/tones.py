"""How brightly each frame shows the ground: gains, slopes and vignettes, found where frames overlap.

A camera that writes what its sensor counted shows twice the light as twice the value. A camera that renders
pictures bends values towards white, so that none exceeds it. Which of the two a flight's camera does is found
from its frames: the one by which they can be made alike.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from geomosaic.arrays import Floats, Floats32, Ints
from geomosaic.camera.interior import Camera
from geomosaic.composition.hot_spot import directions, hot_spot
from geomosaic.composition.views import FrameView
from geomosaic.composition.window import scaled
from geomosaic.constants import tuned
from geomosaic.geodesy.local import LocalFrame
from geomosaic.projection.ground import GroundSurface
from geomosaic.projection.map_grid import MapGrid
from geomosaic.projection.resample import resample
from geomosaic.projection.warp import frame_from_map, ground_window
from geomosaic.survey.model import Frame
from geomosaic.survey.pixels import read_pixels
from geomosaic.survey.small import Spare

GREYS = float(np.iinfo(np.uint8).max)
_FARTHEST = tuned(8, "frames' sides", "that one sees all nodes along; more: its nodes fill the memory")
ACROSS = tuned(24, "places", "along a frame: some hundred in an overlap; fewer make gains noisy")
_LEAST_SIDE_PX = tuned(64, "px", "of the sampled image: smaller mixes a tree with the field next to it")
BUMPS = tuned((0.1, 0.2, 0.4), "half diagonals", "deviations of bumps; one alone has another shape")
_TELLING = tuned((6.0, 249.0), "grey levels", "usable: below is noise; above may be saturated")


@dataclass(frozen=True)
class Tones:
    """Natural logarithms of how much brighter frames show the ground than all do in the mean. They are of
    values v or, where these bend towards white, of their odds v / (white - v).

    The logistic curve over the logarithm of light is the middle of a film's characteristic curve (Hurter and
    Driffield 1890), which cameras draw by. More light multiplies odds by a factor.

    gain (n, b): of each frame and band. slope (n, b, 2): times what a place lies to the right of the frame's
    middle and below it, in half diagonals. vignette (n, b, k): times the first k functions of its distance
    from there, see `radial`. level (n, b, 6): of what all frames show together there, by the `powers` of
    these offsets; the map keeps it. None where it shows one exposure throughout. level_box (n, 2, 2): the
    least and the greatest offsets to the right and below of each frame's sightings; beyond, its level is that
    of the box's edge. spot (b,): times a `hot_spot` of this width about the direction away from the sun in
    each camera's axes, away (n, 3); None where none shows. reported (n, b): the part of the gains that
    frames' exposures account for. curve: of the whole map, see `tone_curve.curve_to_mid_grey`.
    """

    gain: Floats
    slope: Floats
    vignette: Floats
    white: float = float("inf")
    level: Floats | None = None
    spot: Floats | None = None
    away: Floats | None = None
    spot_width_rad: float = 0.0
    reported: Floats | None = None
    curve: float = 1.0
    level_box: Floats | None = None

    def flat(self, frame: int) -> bool:
        """Whether a frame shows the ground as bright as all do."""
        its = (self.gain, self.slope, self.vignette, self.level)
        return self.spot is None and not any(of is not None and of[frame].any() for of in its)

    def brighter(self, frame: int, camera: Camera, cols: Floats32, rows: Floats32) -> Floats32:
        """How much brighter than all in the mean a frame shows the ground at cols and rows (...), as natural
        logarithms (..., b)."""
        right, below = (
            np.nan_to_num(a)[..., None] for a in _from_middle(camera, cols, rows)
        )  # NaN: not seen
        seen = None
        if self.away is not None:
            image = np.nan_to_num(np.stack([cols, rows], axis=-1)).astype(np.float64)
            seen = hot_spot(directions(camera, image), self.away[frame], self.spot_width_rad)
        return self.at_offsets(frame, right, below, seen)

    def at_offsets(
        self, frame: int, right: Floats32, below: Floats32, seen: Floats | None = None
    ) -> Floats32:
        """As `brighter`, at places (..., 1) to the right of the frame's middle and below it, in half
        diagonals. seen (...): of the hot spot."""
        across, along = self.slope[frame].astype(np.float32).T
        vignette = self.vignette[frame].astype(np.float32).T
        gain = self.gain[frame].astype(np.float32)
        out = np.broadcast_to(gain, (*right.shape[:-1], *gain.shape)).copy()
        for its, by in zip(vignette, radial(right * right + below * below), strict=False):
            if its.any():
                out += its * by
        if across.any() or along.any():
            out += right * across + below * along
        if self.spot is not None and seen is not None:
            out += seen[..., None].astype(np.float32) * self.spot.astype(np.float32)
        if self.level is not None:
            if self.level_box is not None:
                (first, top), (last, bottom) = self.level_box[frame].astype(np.float32)
                right, below = np.clip(right, first, last), np.clip(below, top, bottom)
            out -= powers(right, below) @ self.level[frame].astype(np.float32).T
        return np.asarray(out)


def radial(radius2: NDArray[Any]) -> Iterator[NDArray[Any]]:
    """Functions (...) of squared distances (...) from a frame's middle, in half diagonals: the square, its
    square, and bumps in the middle. Lenses darken as the former do; cameras that correct this too much, or by
    a table, leave the latter."""
    yield radius2
    yield radius2 * radius2
    for width in BUMPS:
        yield np.exp(radius2 * np.float32(-0.5 / width**2))


def powers(right: NDArray[Any], below: NDArray[Any]) -> NDArray[Any]:
    """Terms of the second degree (..., 6) of offsets (..., 1)."""
    one = np.ones_like(right)
    return np.concatenate([one, right, below, right * right, right * below, below * below], axis=-1)


def evened(pixels: NDArray[Any], darker: Floats32, white: float, dtype: str) -> NDArray[Any]:
    """Pixels (h, w, b) as all frames would show them, rounded and cut as by `window.as_type`.

    Args: darker (h, w, b): what values are multiplied by, or their odds where there is a white.
    """
    if np.isfinite(white):
        odds_less = darker - np.float32(1.0)
        odds_less *= pixels
        odds_less += np.float32(white)
        np.divide(np.float32(white), odds_less, out=odds_less)
        odds_less *= darker
        darker = odds_less
    return scaled(pixels, darker, dtype)


@dataclass(frozen=True)
class Sampling:
    """A frame, where it is to be sampled: image_px (n, 2) col and row; and where it may lie small."""

    frame: Frame
    image_px: Floats
    spare: Spare | None = None


@dataclass(frozen=True)
class Samples:
    """Values (n, b) of a frame at the places asked for, NaN where it is invalid, too dark or too bright."""

    values: Floats32


@dataclass(frozen=True)
class ToneSightings:
    """m sightings: number of the place and the frame, (m,) each; offset (m, 2) to the right of the frame's
    middle and below it, in half diagonals; image_px (m, 2). nodes (p, 2): row and col of each place in a
    lattice on the map."""

    place: Ints
    frame: Ints
    offset: Floats
    image_px: Floats
    nodes: Ints


def lattice(
    views: Sequence[FrameView], crs: str, work_frame: LocalFrame, ground: GroundSurface
) -> ToneSightings:
    """Where each frame sees the nodes of a lattice on the map. One that sees far more land than most sees
    every third, fifth and so on: odd steps have nodes in common."""
    spacing_m = float(np.median([v.gsd_m * max(v.camera.width_px, v.camera.height_px) for v in views]))
    spacing_m /= ACROSS
    place, frame, offset, image = [], [], [], []
    for view in views:
        extent_m = float(np.max(view.bounds_m[2:] - view.bounds_m[:2]))
        every = int(np.ceil(extent_m / spacing_m / (_FARTHEST * ACROSS))) | 1
        own_m = every * spacing_m
        west, south, east, north = view.bounds_m / own_m
        first, last = (int(np.floor(west)), int(np.floor(-north))), (int(np.ceil(east)), int(np.ceil(-south)))
        across, down = last[0] - first[0], last[1] - first[1]
        grid = MapGrid(crs, first[0] * own_m, -first[1] * own_m, own_m, across, down)
        window = ground_window(grid, work_frame, ground)
        cols, rows = frame_from_map(window, view.pose, view.camera)
        margin = _reduction(view.camera.width_px, view.camera.height_px)
        seen = (cols > margin) & (cols < view.camera.width_px - margin)
        seen &= (rows > margin) & (rows < view.camera.height_px - margin)
        if (well := view.sees_well(cols, rows)) is not None:
            seen &= well
        j, i = np.nonzero(seen)
        place.append(np.column_stack([j + first[1], i + first[0]]) * every + every // 2)
        frame.append(np.full(len(i), view.frame))
        offset.append(np.column_stack(_from_middle(view.camera, cols[seen], rows[seen])))
        image.append(np.column_stack([cols[seen], rows[seen]]))
    nodes, number = np.unique(np.concatenate(place), axis=0, return_inverse=True)
    return ToneSightings(
        number.ravel(),
        np.concatenate(frame),
        np.concatenate(offset).astype(np.float64),
        np.concatenate(image).astype(np.float64),
        nodes,
    )


def sampled(job: Sampling) -> Samples:
    """Decodes a frame once, reduced, and takes its means about the places."""
    frame = job.frame
    reduction = _reduction(frame.width_px, frame.height_px)
    pixels, valid = read_pixels(frame, reduction, spare=job.spare)
    cols, rows = (np.ascontiguousarray(job.image_px[:, [k]] / reduction, dtype=np.float32) for k in (0, 1))
    smooth = cv2.blur(pixels, (3, 3), borderType=cv2.BORDER_REPLICATE).reshape(pixels.shape)
    values = resample(smooth, cols, rows, "bilinear")[:, 0].astype(np.float32)
    dark, bright = _TELLING if pixels.dtype == np.uint8 else (0.0, _most(pixels.dtype))
    values[~((values > dark) & (values < bright)).all(axis=1)] = np.nan
    if valid is not None:
        whole = cv2.erode(valid, np.ones((3, 3), np.uint8))
        values[resample(whole[..., None], cols, rows, "bilinear")[:, 0, 0] < 255] = np.nan
    return Samples(values)


def _most(dtype: np.dtype[Any]) -> float:
    return float(np.iinfo(dtype).max) if np.issubdtype(dtype, np.integer) else np.inf


def _from_middle(camera: Camera, cols: NDArray[Any], rows: NDArray[Any]) -> tuple[Floats32, Floats32]:
    """How far places lie to the right of a frame's middle and below it, in half diagonals."""
    half = np.array([camera.width_px, camera.height_px]) / 2.0
    unit = float(np.hypot(*half))
    right, below = (
        np.asarray((a - h) / unit, dtype=np.float32) for a, h in zip((cols, rows), half, strict=True)
    )
    return right, below


def _reduction(width_px: int, height_px: int) -> int:
    return next((r for r in (8, 4, 2) if min(width_px, height_px) >= r * _LEAST_SIDE_PX), 1)
