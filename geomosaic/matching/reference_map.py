"""Frames against a map: where they show keypoints of an orthophoto, and which of these place a block."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from geomosaic.arrays import Bools, Bytes, Floats, Ints
from geomosaic.constants import tuned
from geomosaic.matching.features import Features, sift_features
from geomosaic.matching.match import Matching, MatchKeypoints, match_pair
from geomosaic.matching.planes import Guess, through

_MARGIN_PX = tuned(48, "px", "about a tile, so that keypoints at its edges are found: less loses coarse ones")


@dataclass(frozen=True)
class MapTile:
    """Part of a map's image. grey, valid (rows, cols), with a margin about it; first_px: col and row of its
    first pixel on the whole map; core_px: first and last col and row (2, 2) of the part without the margin;
    pixel_px: frames' pixels in one of the map's."""

    grey: Bytes
    valid: Bytes
    first_px: tuple[int, int]
    core_px: tuple[tuple[int, int], tuple[int, int]]
    pixel_px: float


@dataclass(frozen=True)
class ReferenceGrid:
    """The part of the reference under the survey, in the map's CRS. pixel_m: of its image; pixel_px: frames'
    pixels in one of these."""

    path: Path
    crs: str
    west: float
    north: float
    size_px: tuple[int, int]
    pixel_m: float
    pixel_px: float

    def map_m(self, image_px: Floats) -> Floats:
        """Easting and northing of places in frames' pixels from the corner."""
        return np.array([self.west, self.north]) + image_px / self.pixel_px * self.pixel_m * [1.0, -1.0]

    def image_px(self, map_m: Floats) -> Floats:
        """And back."""
        return (map_m - [self.west, self.north]) * [1.0, -1.0] / self.pixel_m * self.pixel_px


def tile_bounds(size_px: tuple[int, int], side_px: int) -> list[tuple[tuple[int, int], tuple[int, int]]]:
    """First and last col and row (exclusive) of tiles that fill a map of a width and height."""
    width, height = size_px
    return [
        ((col, row), (min(col + side_px, width), min(row + side_px, height)))
        for row in range(0, height, side_px)
        for col in range(0, width, side_px)
    ]


def with_margin(
    core: tuple[tuple[int, int], tuple[int, int]], size_px: tuple[int, int]
) -> tuple[tuple[int, int], tuple[int, int]]:
    """A tile's bounds with the margin, as far as the map goes."""
    (left, top), (right, bottom) = core
    return (
        (max(0, left - _MARGIN_PX), max(0, top - _MARGIN_PX)),
        (min(size_px[0], right + _MARGIN_PX), min(size_px[1], bottom + _MARGIN_PX)),
    )


def tile_features(most: int, tile: MapTile) -> Features:
    """Keypoints of a tile without its margin, at most `most`; on the whole map, in frames' pixels."""
    found = sift_features(tile.grey, tile.valid, (1.0, 1.0), most)
    at = found.image_px + tile.first_px
    first, last = np.array(tile.core_px)
    inside = ((at >= first) & (at < last)).all(axis=1)
    return _some(Features(at * tile.pixel_px, found.size_px, found.descriptors), inside)


def joined_features(parts: Sequence[Features]) -> Features:
    """Those of all tiles."""
    return Features(
        np.concatenate([p.image_px for p in parts]),
        np.concatenate([p.size_px for p in parts]),
        np.concatenate([p.descriptors for p in parts]),
    )


def _some(features: Features, which: Bools | Ints) -> Features:
    return Features(features.image_px[which], features.size_px[which], features.descriptors[which])


@dataclass(frozen=True)
class ExpectedOnMap:
    """Keypoints of the map where a frame is expected. number (n,): theirs among all of the map."""

    number: Ints
    features: Features
    guess: Guess


def expected_on_map(of_map: Features, guess: Guess) -> ExpectedOnMap:
    """The map's keypoints about where it is expected to show a frame; all where nothing is expected."""
    if np.isinf(guess.radius_px):
        return ExpectedOnMap(np.arange(len(of_map)), of_map, guess)
    corners = np.array(guess.corners_px)
    low, high = corners.min(axis=0) - guess.radius_px, corners.max(axis=0) + guess.radius_px
    near = np.flatnonzero(((of_map.image_px >= low) & (of_map.image_px <= high)).all(axis=1))
    return ExpectedOnMap(near, _some(of_map, near), guess)


@dataclass(frozen=True)
class FoundOnMap:
    """Places (k, 2) of a frame that the map shows too, and the numbers (k,) of the map's keypoints. off_px:
    how far the frame lies from where it was expected, in the frame's pixels; NaN where nothing was
    expected."""

    image_px: Floats
    number: Ints
    off_px: float


def found_on_map(how: Matching, frame: Features, on_map: ExpectedOnMap, pixel_px: float) -> FoundOnMap:
    """Where a frame shows keypoints of the map. pixel_px: of the coarser of both images that keypoints are
    of, in the frame's pixels."""
    left, right = MatchKeypoints.of(frame), MatchKeypoints.of(on_map.features)
    match = match_pair(how, left, right, on_map.guess, pixel_px)
    here, there = left.image_px[match.left], right.image_px[match.right]
    off_px = np.nan
    if np.isfinite(on_map.guess.radius_px) and len(here):
        off = np.median(there - through(on_map.guess.plane, here), axis=0)
        off_px = float(np.linalg.norm(off))
    return FoundOnMap(here, on_map.number[match.right], off_px)


def spread_places(found: Sequence[FoundOnMap], at_m: Floats, cell_m: float) -> list[int]:
    """Numbers of map keypoints that place a block: of each cell of cell_m the one that most frames show, if
    these are two or more: one leaves its height open. Args: at_m (n, 2): places of the map's keypoints."""
    numbers = np.concatenate([np.zeros(0, np.intp), *(np.unique(f.number) for f in found)])
    count = np.bincount(numbers, minlength=len(at_m))
    cell = np.floor(at_m / cell_m).astype(np.int64)
    order = np.lexsort((np.arange(len(at_m)), -count, cell[:, 1], cell[:, 0]))
    first = np.diff(cell[order], axis=0, prepend=cell[order[:1]] - 1).any(axis=1)
    best = order[first]
    return sorted(best[count[best] > 1].tolist())
