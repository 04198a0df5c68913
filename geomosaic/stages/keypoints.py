"""What matching takes of one frame or one pair, as stages spread it over the workers.

A frame is decoded once: its brightness lies on the disk as long as matching goes back to it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from geomosaic.arrays import Bools, Bytes, Floats, Floats32, Ints64
from geomosaic.matching.affine_matching import TEMPLATE_PX, find, templates
from geomosaic.matching.contrast import raised
from geomosaic.matching.features import Features, reduction_for, shrunk, sift_features, stretched
from geomosaic.matching.fixed_pattern import MOST_PX, RUN, SAMPLE, fixed_pattern, without_pattern
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


@dataclass(frozen=True)
class FixedPattern:
    """values (rows, cols) of `fixed_pattern`, (0, 0) without one."""

    values: Floats32


@dataclass(frozen=True)
class UnseenFrame:
    """A frame to be decoded, and the pattern of its sensor."""

    to_decode: FrameToDecode
    pattern: StoredResult[FixedPattern] | None = None


def frame_brightness(sight: FrameReduction, unseen: UnseenFrame) -> Brightness:
    """Decodes a frame."""
    image, valid, levels = _grey(sight, unseen.to_decode)
    if unseen.pattern is not None:
        image = without_pattern(image, unseen.pattern.recall().values)
    image, faint = raised(image, valid, sight.keypoints_px, levels)
    return Brightness(image, valid, faint)


def frames_pattern(sight: FrameReduction, some: tuple[FrameToDecode, ...]) -> FixedPattern:
    """What some frames of a sensor have in common."""
    found = fixed_pattern([_grey(sight, one)[0] for one in some])
    return FixedPattern(np.zeros((0, 0), np.float32) if found is None else found)


def _grey(sight: FrameReduction, one: FrameToDecode) -> tuple[Bytes, Bytes | None, float | None]:
    """A frame as `stretched`, where it is valid, and its levels."""
    luma = sight.band is None
    pixels, valid = read_pixels(one.frame, sight.reduction(one.frame), luma=luma, spare=one.spare)
    image, levels = stretched(pixels, valid, sight.band)
    return image, valid, levels


@dataclass(frozen=True)
class Picture:
    """A frame and how it is looked at. Whoever wants its brightness first decodes it, and leaves it for the
    others."""

    sight: FrameReduction
    unseen: UnseenFrame
    decoded: OptionalCache[Brightness]

    @property
    def reduction(self) -> int:
        """Pixels of the frame in one of the image, along each side."""
        return self.sight.reduction(self.unseen.to_decode.frame)

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
    unseen = _unseen(context, sight, frames)
    decoded = context.optional_caches("brightness", partial(frame_brightness, sight), unseen)
    yield [Picture(sight, one, cache) for one, cache in zip(unseen, decoded, strict=True)]
    for cache in decoded:
        cache.forget()


def _unseen(context: Context, sight: FrameReduction, frames: Sequence[Frame]) -> list[UnseenFrame]:
    """Frames to be decoded; those as small as a thermal sensor's with its pattern, if it shows one."""
    to_decode = [FrameToDecode(frame, spare_of(context, frame.path)) for frame in frames]
    small: dict[tuple[str, int, int], list[int]] = {}
    for i, frame in enumerate(frames):
        if frame.width_px * frame.height_px <= MOST_PX:
            small.setdefault((frame.camera, frame.width_px, frame.height_px), []).append(i)
    runs = [its[k : k + RUN] for its in small.values() for k in range(0, len(its), RUN)]
    runs = [run for run in runs if len(run) >= SAMPLE]
    chosen = [np.linspace(0, len(run) - 1, SAMPLE).round().astype(int) for run in runs]
    samples = [tuple(to_decode[run[k]] for k in some) for run, some in zip(runs, chosen, strict=True)]
    found = context.stored("fixed patterns", partial(frames_pattern, sight), samples)
    pattern_of = {
        i: pattern
        for run, pattern in zip(runs, found, strict=True)
        if pattern.load().values.size
        for i in run
    }
    return [UnseenFrame(one, pattern_of.get(i)) for i, one in enumerate(to_decode)]


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
