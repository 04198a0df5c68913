"""SIFT tie points between frames that may overlap, moved to where the pixels agree; frames turned after the
flight are turned back."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Final, Literal

import numpy as np

from geomosaic.arrays import Floats
from geomosaic.camera.exterior import Poses
from geomosaic.camera.interior import Camera
from geomosaic.camera.rotation import Rotation
from geomosaic.matching.candidates import FrameComparison, alike, coarse, likely_pairs, to_compare
from geomosaic.matching.expected_overlap import LEAST_RADIUS_PX, ExpectedOverlap
from geomosaic.matching.features import Features
from geomosaic.matching.match import Matching
from geomosaic.matching.model import TiePairs, TiePoints
from geomosaic.matching.planes import Guess
from geomosaic.matching.search import CHECKS
from geomosaic.matching.turned import corrected_poses, found_turned, reheaded, seen_pairs
from geomosaic.matching.untied import mostly
from geomosaic.pipeline.function_stage import stage
from geomosaic.pipeline.stage import Context, param
from geomosaic.pipeline.stored_result import StoredResult
from geomosaic.placement.model import Placement
from geomosaic.placement.reach import misplacement_m
from geomosaic.projection.footprint import ground_sampling_distance_m
from geomosaic.projection.ground import GroundSurface
from geomosaic.stages.keypoints import FrameReduction, KeypointParams, frame_features, pictured
from geomosaic.stages.tie_points import Pairing, record_tried, refined
from geomosaic.survey.model import Survey

_REVERSED: Final = (
    "all headings of the POS file point to the images' bottoms: its rows are in reverse order, which turns "
    "the map by 180 degrees, or the camera is mounted the other way round; turned here: check the "
    "order of the rows in --pos"
)


class SiftParams(KeypointParams):
    """See each parameter's help."""

    longest_px: int = param(
        3000,
        help="frames are halved until no side is longer; tie points are placed in those pixels",
        unit="px",
        ge=300,
        le=20000,
    )
    band: int | None = param(None, help="band to match, counted from 1; luma if none is given", ge=1, le=1000)
    radius_m: float | Literal["auto"] = param(
        "auto",
        help="how far apart two frames may place a point; auto: at least 300 ground px",
        unit="m",
        ge=0.0,
    )
    check: str = param("auto", help="geometric check", choices=CHECKS)
    least: int = param(16, help="fewest tie points that tie a pair", ge=4, le=1000)
    refine: bool = param(True, help="tie points are moved to where windows about them agree")


@stage(
    "matching.sift", "Match frames with SIFT", group="Matching", version=28, outputs=("ties", "placement"),
    wants_frames=True,
)  # fmt: skip
def matching_sift(
    survey: Survey,
    prior_ground: GroundSurface,
    prior_placement: Placement,
    params: SiftParams,
    context: Context,
) -> tuple[TiePoints, Placement]:
    """Finds the same ground in two images."""
    placement, ground = prior_placement, prior_ground
    cameras = [survey.camera_of(i) for i in range(len(survey.frames))]
    reach_m = misplacement_m(placement.poses, cameras, ground)
    reach_m = np.where(survey.located, reach_m, np.inf)
    sizes = [(f.width_px, f.height_px) for f in survey.frames]
    expected = _expected(params, placement, cameras, ground, reach_m)
    pairs, pairing = _tied(survey, placement, expected, params, context)
    untied = pairing.untied
    record_tried(context, [f.name for f in survey.frames], pairing, pairs, params.least)
    cap_m = LEAST_RADIUS_PX * placement.ground_pixel_m
    if any(survey.located):
        cap_m = max(cap_m, float(np.median(reach_m[np.array(survey.located)])))
    seen = seen_pairs(pairs, placement.poses, cameras, ground, survey.located)
    turns, headings = found_turned(seen, placement.poses, sizes, cap_m)
    reversed_file = _of_reversed_file(survey, np.unique(pairs.frames).tolist(), turns)
    if reversed_file:
        context.warn("headings-reversed", "", _REVERSED)
    each = {i: quarters for i, quarters in turns.items() if i not in reversed_file}
    _report(context, [f.name for f in survey.frames], placement.poses, each, headings)
    faint = [features.look().faint for features in pairing.features]
    faint_frames = sum(map(mostly, faint))
    context.metric("matching.faint_frames", faint_frames)
    if faint_frames:
        context.inform(
            f"{faint_frames} of {len(faint)} frames are faint; their contrast is raised for matching alone"
        )
    context.metric("matching.pairs_tried", len(pairs) + len(untied))
    context.metric("matching.pairs_tied", len(pairs))
    context.metric("matching.tie_points", int(pairs.counts.sum()))
    placement = replace(
        placement,
        poses=reheaded(corrected_poses(placement.poses, turns), headings),
        turned=tuple(turns.get(i, 0) for i in range(len(survey.frames))),
    )
    return pairing.ties(pairs, faint), placement


def _tied(
    survey: Survey,
    placement: Placement,
    expected: Callable[[int, int], Guess],
    params: SiftParams,
    context: Context,
) -> tuple[TiePairs, Pairing]:
    """The pairs that hold together, and how all were tried."""
    sight = FrameReduction(params.longest_px, params.keypoints_px, params.band)
    sizes = [(f.width_px, f.height_px) for f in survey.frames]
    with pictured(context, sight, survey.frames) as pictures:
        features = context.stored(
            "keypoints", partial(frame_features, params.keypoints_px, params.keypoints), pictures
        )
        pairing = Pairing(
            context,
            Matching(params.ratio, params.check, params.tolerance_px, params.least),
            features,
            sizes,
            [sight.pixel_px(f) for f in survey.frames],
            expected,
            placement.sequence,
        )
        lost = np.flatnonzero(~np.array(survey.located)).tolist()
        pairs = pairing.match([*placement.pairs, *_without_positions(context, features, lost)])
        if params.refine:
            pairs = refined(context, pictures, sizes, pairs, params.least)
    return pairs, pairing


def _expected(
    params: SiftParams,
    placement: Placement,
    cameras: Sequence[Camera],
    ground: GroundSurface,
    reach_m: Floats,
) -> Callable[[int, int], Guess]:
    """Where pairs are expected to match: by poses, to within how far these may be off."""
    overlap = ExpectedOverlap.of(placement.poses, cameras, ground)
    own_m = [ground_sampling_distance_m(placement.poses[i], c, ground) for i, c in enumerate(cameras)]
    pixel_m = np.where(np.isfinite(own_m) & (np.array(own_m) > 0.0), own_m, placement.ground_pixel_m)

    def of(a: int, b: int) -> Guess:
        if params.radius_m != "auto":
            return overlap.guess(a, b, params.radius_m / pixel_m[b])
        off_m = float(np.hypot(reach_m[a], reach_m[b]))
        return overlap.guess(a, b, max(LEAST_RADIUS_PX, off_m / pixel_m[b]))

    return of


def _without_positions(
    context: Context, features: Sequence[StoredResult[Features]], frames: Sequence[int]
) -> list[tuple[int, int]]:
    """Candidate pairs of frames that have no position, by what their images have in common."""
    if not frames:
        return []
    few = [coarse(f.load()) for f in features]
    compared = to_compare(len(features), frames)
    jobs = [FrameComparison(few[i], tuple(few[j] for j in others)) for i, others in compared]
    found = context.map("frames without position", alike, jobs, keys=[i for i, _ in compared])
    context.metric("matching.pairs_compared", sum(len(others) for _, others in compared))
    return likely_pairs(compared, found)


def _of_reversed_file(survey: Survey, tied: Collection[int], turns: Mapping[int, int]) -> list[int]:
    """Tied frames with headings of a POS file, if all are off by 180 degrees. Then their images were not
    turned one by one: the file is wrong, or the camera was mounted so."""
    frames = survey.frames
    given = [i for i in tied if frames[i].attitude.source.startswith("pos-")]
    given = [i for i in given if frames[i].attitude.yaw_deg is not None]
    return given if len(given) > 1 and all(turns.get(i) == 2 for i in given) else []


def _report(
    context: Context,
    names: Sequence[str],
    poses: Poses,
    turns: Mapping[int, int],
    headings: Mapping[int, float],
) -> None:
    """Names wrong headings and turned images."""
    yaw = Rotation(poses.rotations).yaw_pitch_roll()[0]
    for frame, heading in headings.items():
        context.warn(
            "yaw-wrong",
            names[frame],
            f"its heading was given as {np.degrees(yaw[frame]) % 360.0:.0f} degrees and is about "
            f"{np.degrees(heading):.0f} by its neighbours' images, which set it: nothing to do",
        )
    for frame, quarters in turns.items():
        context.warn(
            "frame-turned",
            names[frame],
            f"its pixels were turned by {quarters * 90} degrees after the flight; turned back here: nothing "
            "to do",
        )
