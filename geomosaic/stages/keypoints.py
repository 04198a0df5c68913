"""What matching takes of one frame or one pair, as stages spread it over the workers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geomosaic.matching.affine_matching import TEMPLATE_PX, find, templates
from geomosaic.matching.features import Bytes, Features, grey, reduction_for, shrunk, sift_features
from geomosaic.matching.match import Matching, PairMatch, match_pair
from geomosaic.matching.planes import Guess
from geomosaic.pipeline.kept import Kept
from geomosaic.survey.model import Frame
from geomosaic.survey.pixels import read_pixels

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Sight:
    """How frames are looked at: halved until no side is longer than longest_px, in one band or in luma."""

    longest_px: int
    band: int | None = None

    def grey(self, frame: Frame) -> tuple[Bytes, Bytes | None]:
        """The frame's brightness, and which pixels are valid."""
        pixels, valid = read_pixels(frame, self.reduction(frame), luma=self.band is None)
        return grey(pixels, valid, self.band), valid

    def reduction(self, frame: Frame) -> int:
        """Pixels of the frame in one of the image, along each side."""
        return reduction_for(frame.width_px, frame.height_px, self.longest_px)

    def pixel_px(self, frame: Frame, keypoints_px: int) -> float:
        """Pixels of the frame in one of the image that its keypoints are of: no larger than keypoints_px."""
        return max(float(self.reduction(frame)), max(frame.width_px, frame.height_px) / keypoints_px)


def frame_features(sight: Sight, keypoints_px: int, most: int, frame: Frame) -> Features:
    """Decodes a frame once and takes its keypoints, of an image with no side longer than keypoints_px."""
    image, valid = sight.grey(frame)
    small, seen = shrunk(image, valid, keypoints_px)
    rows, cols = (
        sight.reduction(frame) * whole / part for whole, part in zip(image.shape, small.shape, strict=True)
    )
    return sift_features(small, seen, (cols, rows), most)


@dataclass(frozen=True)
class PairItem:
    """A pair of frames, where it is believed to match, and by how much its keypoints' images were shrunk."""

    left: Kept[Features]
    right: Kept[Features]
    guess: Guess
    pixel_px: float


def pair_match(how: Matching, pair: PairItem) -> PairMatch:
    """Tie points of a pair."""
    return match_pair(how, pair.left.recall(), pair.right.recall(), pair.guess, pair.pixel_px)


@dataclass(frozen=True)
class Shown:
    """A frame, and places (n, 2) that it is to show to others."""

    frame: Frame
    image_px: Floats


@dataclass(frozen=True)
class Windows:
    """values (n, TEMPLATE_PX, TEMPLATE_PX) of a frame, about its places."""

    values: Bytes


def frame_windows(sight: Sight, shown: Shown) -> Windows:
    """What a frame shows at places, decoded once."""
    image, _ = sight.grey(shown.frame)
    return Windows(templates(image, shown.image_px / sight.reduction(shown.frame)))


@dataclass(frozen=True)
class Sought:
    """Some windows of a frame, where (n, 2) another is believed to show them, and how it turns and stretches
    them (n, 2, 2), in pixels of both frames."""

    windows: Kept[Windows]
    reduction: int
    rows: NDArray[np.int64]
    near_px: Floats
    shapes: Floats


@dataclass(frozen=True)
class Search:
    """A frame and what is sought in it."""

    frame: Frame
    sought: tuple[Sought, ...]


@dataclass(frozen=True)
class Places:
    """image_px (n, 2) where a frame shows what was sought in it, in that order; sure (n,) whether it does."""

    image_px: Floats
    sure: NDArray[np.bool_]


def frame_places(sight: Sight, search: Search) -> Places:
    """Where a frame shows windows of others, decoded once."""
    image, _ = sight.grey(search.frame)
    reduction = sight.reduction(search.frame)
    values = [s.windows.recall().values[s.rows] for s in search.sought]
    found = find(
        np.concatenate([np.zeros((0, TEMPLATE_PX, TEMPLATE_PX), np.uint8), *values]),
        image,
        np.concatenate([s.near_px for s in search.sought]) / reduction,
        np.concatenate([s.shapes * (s.reduction / reduction) for s in search.sought]),
    )
    return Places(found.image_px * reduction, found.sure)
