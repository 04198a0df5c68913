"""What matching takes of one frame or one pair, as stages spread it over the workers.

A frame is decoded once: its brightness lies on the disk as long as matching goes back to it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from geomosaic.arrays import Bools, Bytes, Floats, Ints64
from geomosaic.matching.affine_matching import TEMPLATE_PX, find, templates
from geomosaic.matching.contrast import raised
from geomosaic.matching.features import Features, reduction_for, shrunk, sift_features, stretched
from geomosaic.matching.match import Matching, MatchKeypoints, PairMatch, match_pair
from geomosaic.matching.planes import Guess
from geomosaic.pipeline.stage import Context, StageParams, param
from geomosaic.pipeline.stored_result import OptionalCache, StoredResult
from geomosaic.stages.spares import spare_of
from geomosaic.survey.model import Frame
from geomosaic.survey.pixels import read_pixels
from geomosaic.survey.small import FrameToDecode


class KeypointParams(StageParams):
    """See each parameter's help."""

    keypoints_px: int = param(
        1000, help="longest side of the images that keypoints are found in", unit="px", ge=200, le=20000
    )
    keypoints: int = param(6000, help="most keypoints of a frame, or of part of a map", ge=100, le=50000)
    ratio: float = param(0.8, help="Lowe's ratio of the best to the second distance", ge=0.1, le=1.0)
    tolerance_px: float = param(
        2.0,
        help="tolerance of the geometric check, in pixels of the images that keypoints are found in",
        unit="px",
        ge=0.1,
        le=50,
    )


@dataclass(frozen=True)
class FrameReduction:
    """How frames are looked at: halved until no side is longer than longest_px, in one band or in luma;
    keypoints are sought in images shrunk to keypoints_px."""

    longest_px: int
    keypoints_px: int
    band: int | None = None

    def reduction(self, frame: Frame) -> int:
        """Pixels of the frame in one of the image, along each side."""
        return reduction_for(frame.width_px, frame.height_px, self.longest_px)

    def pixel_px(self, frame: Frame) -> float:
        """Pixels of the frame in one of the image that its keypoints are of."""
        return max(float(self.reduction(frame)), max(frame.width_px, frame.height_px) / self.keypoints_px)


@dataclass(frozen=True)
class Brightness:
    """grey (rows, cols) of a frame as it is looked at, its faint parts raised; valid (rows, cols), None where
    all pixels are; faint: share of the frame that was raised."""

    grey: Bytes
    valid: Bytes | None
    faint: float = 0.0


def frame_brightness(sight: FrameReduction, unseen: FrameToDecode) -> Brightness:
    """Decodes a frame."""
    reduction, luma = sight.reduction(unseen.frame), sight.band is None
    pixels, valid = read_pixels(unseen.frame, reduction, luma=luma, spare=unseen.spare)
    image, levels = stretched(pixels, valid, sight.band)
    image, faint = raised(image, valid, sight.keypoints_px, levels)
    return Brightness(image, valid, faint)


@dataclass(frozen=True)
class Picture:
    """A frame and how it is looked at. Whoever wants its brightness first decodes it, and leaves it for the
    others."""

    sight: FrameReduction
    unseen: FrameToDecode
    decoded: OptionalCache[Brightness]

    @property
    def reduction(self) -> int:
        """Pixels of the frame in one of the image, along each side."""
        return self.sight.reduction(self.unseen.frame)

    def brightness(self) -> Brightness:
        """The frame as it is looked at."""
        found = self.decoded.found()
        if found is None:
            found = frame_brightness(self.sight, self.unseen)
            self.decoded.leave(found)
        return found


@contextmanager
def pictured(context: Context, sight: FrameReduction, frames: Sequence[Frame]) -> Iterator[list[Picture]]:
    """Frames, each decoded once at most for all that is done in the block, and not at all where all that is
    wanted of it is there from before. Then they go: a few MB each, and decoded again sooner than so much is
    kept; if the block fails, the next run finds them."""
    unseen = [FrameToDecode(frame, spare_of(context, frame.path)) for frame in frames]
    decoded = context.optional_caches("brightness", partial(frame_brightness, sight), unseen)
    yield [Picture(sight, one, cache) for one, cache in zip(unseen, decoded, strict=True)]
    for cache in decoded:
        cache.forget()


def frame_features(keypoints_px: int, most: int, picture: Picture) -> Features:
    """Keypoints of an image of the frame with no side longer than keypoints_px: at most `most`, and as many
    again for a frame that is faint all over."""
    seen = picture.brightness()
    small, valid = shrunk(seen.grey, seen.valid, keypoints_px)
    rows, cols = (
        picture.reduction * whole / part for whole, part in zip(seen.grey.shape, small.shape, strict=True)
    )
    found = sift_features(small, valid, (cols, rows), round(most * (1.0 + seen.faint)))
    return replace(found, faint=seen.faint)


@dataclass(frozen=True)
class PairItem:
    """A pair of frames, where it is expected to match, and by how much its keypoints' images were shrunk."""

    left: StoredResult[Features]
    right: StoredResult[Features]
    guess: Guess
    pixel_px: float


def pair_match(how: Matching, pair: PairItem) -> PairMatch:
    """Tie points of a pair."""
    left, right = (features.recall_as(MatchKeypoints.of) for features in (pair.left, pair.right))
    return match_pair(how, left, right, pair.guess, pair.pixel_px)


@dataclass(frozen=True)
class PlacesAsked:
    """A frame, and places (n, 2) that it is to show to others."""

    picture: Picture
    image_px: Floats


@dataclass(frozen=True)
class Windows:
    """values (n, TEMPLATE_PX, TEMPLATE_PX) of a frame, about its places."""

    values: Bytes


def frame_windows(shown: PlacesAsked) -> Windows:
    """What a frame shows at places."""
    return Windows(templates(shown.picture.brightness().grey, shown.image_px / shown.picture.reduction))


@dataclass(frozen=True)
class Sought:
    """Some windows of a frame, where (n, 2) another is expected to show them, and how it turns and stretches
    them (n, 2, 2), in pixels of both frames."""

    windows: StoredResult[Windows]
    reduction: int
    rows: Ints64
    near_px: Floats
    shapes: Floats


@dataclass(frozen=True)
class Search:
    """A frame and what is sought in it."""

    picture: Picture
    sought: tuple[Sought, ...]


@dataclass(frozen=True)
class PlacesFound:
    """image_px (n, 2) where a frame shows what was sought in it, in that order; sure (n,) whether it does."""

    image_px: Floats
    sure: Bools


def frame_places(search: Search) -> PlacesFound:
    """Where a frame shows windows of others."""
    reduction = search.picture.reduction
    values = [s.windows.recall().values[s.rows] for s in search.sought]
    found = find(
        np.concatenate([np.zeros((0, TEMPLATE_PX, TEMPLATE_PX), np.uint8), *values]),
        search.picture.brightness().grey,
        np.concatenate([s.near_px for s in search.sought]) / reduction,
        np.concatenate([s.shapes * (s.reduction / reduction) for s in search.sought]),
    )
    return PlacesFound(found.image_px * reduction, found.sure)
