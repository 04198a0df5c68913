"""SIFT tie points between frames that may overlap; frames turned after the flight are righted."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from geomosaic.camera.exterior import Poses
from geomosaic.camera.interior import Camera
from geomosaic.camera.rotation import Rotation
from geomosaic.matching.candidates import Comparison, alike, coarse, likely_pairs, to_compare
from geomosaic.matching.features import Features, reduction_for
from geomosaic.matching.match import PairJob, match_pair
from geomosaic.matching.model import TiePair, TiePoints
from geomosaic.matching.search import CHECKS
from geomosaic.matching.turned import Seen, found_turned, reheaded, righted
from geomosaic.pipeline.stage import Context, Stage, StageParams, param
from geomosaic.placement.graph import flown_beside
from geomosaic.placement.model import Placement
from geomosaic.placement.reach import misplacement_m
from geomosaic.projection.footprint import ground_from_image
from geomosaic.projection.ground import GroundSurface
from geomosaic.stages.keypoints import frame_features
from geomosaic.survey.model import Survey

Floats = NDArray[np.float64]


class MatchingSift(Stage):
    """Finds the same ground in two images."""

    id = "matching.sift"
    display_name = "Match frames with SIFT"
    group = "Matching"
    version = 7
    inputs: ClassVar[dict[str, type]] = {
        "survey": Survey, "prior_ground": GroundSurface, "prior_placement": Placement,
    }  # fmt: skip
    outputs: ClassVar[dict[str, type]] = {"ties": TiePoints, "placement": Placement}

    class Params(StageParams):
        """See each parameter's help."""

        longest_px: int = param(
            3000, help="frames are halved until no side is longer", unit="px", ge=300, le=20000
        )
        keypoints: int = param(6000, help="most keypoints of a frame", ge=100, le=50000)
        band: int | None = param(
            None, help="band to match, counted from 1; luma if none is given", ge=1, le=1000
        )
        radius_m: float | Literal["auto"] = param(
            "auto",
            help="how far apart two frames may place a point; auto: at least 300 ground px",
            unit="m",
            ge=0.0,
        )
        ratio: float = param(0.8, help="Lowe's ratio of the best to the second distance", ge=0.1, le=1.0)
        tolerance_px: float = param(
            2.0, help="tolerance of the geometric check, in reduced pixels", unit="px", ge=0.1, le=50
        )
        check: str = param("auto", help="geometric check", choices=CHECKS)
        least: int = param(16, help="fewest tie points that tie a pair", ge=4, le=1000)

    def run(self, inputs: Mapping[str, Any], params: Params, context: Context) -> dict[str, Any]:
        """Keypoints per frame, tie points per pair, then turned frames."""
        survey: Survey = inputs["survey"]
        placement: Placement = inputs["prior_placement"]
        ground: GroundSurface = inputs["prior_ground"]
        frames = survey.frames
        take = partial(frame_features, longest_px=params.longest_px, most=params.keypoints, band=params.band)
        features = context.map(
            "keypoints", take, frames, reads=lambda f: [p for p in (f.path, f.valid_mask) if p is not None]
        )
        cameras = [survey.camera_of(i) for i in range(len(frames))]
        ground_m = [
            ground_from_image(placement.poses[i], cameras[i], ground, features[i].image_px)[:, :2]
            for i in range(len(frames))
        ]
        reach_m = misplacement_m(placement.poses, cameras, ground)
        tried, found = list(placement.pairs), []
        located = np.array(survey.located)
        reach_m = np.where(located, reach_m, np.inf)
        tried += self._without_positions(context, features, np.flatnonzero(~located).tolist())
        job = partial(self._job, params, placement.ground_pixel_m, cameras, features, ground_m, reach_m)
        found += context.map("pairs", match_pair, [job(pair) for pair in tried], keys=tried)
        tied = {i for pair, match in zip(tried, found, strict=True) if len(match.left) for i in pair}
        more = flown_beside(set(range(len(frames))) - tied, placement.sequence, tried)
        if more:
            found += context.map(
                "pairs of lonely frames", match_pair, [job(pair) for pair in more], keys=more
            )
            tried += more
        pairs, untied, seen = [], [], []
        for (a, b), match in zip(tried, found, strict=True):
            if not len(match.left):
                untied.append((a, b))
                continue
            i, j = match.left, match.right
            pairs.append(TiePair(a, b, features[a].image_px[i], features[b].image_px[j], i, j))
            here, there = ground_m[a][i], ground_m[b][j]
            hit = np.isfinite(here).all(axis=1) & np.isfinite(there).all(axis=1)
            if hit.any() and located[a] and located[b]:
                seen.append(Seen(a, b, here[hit], there[hit]))
        cap_m = max(
            300.0 * placement.ground_pixel_m, float(np.median(reach_m[located])) if located.any() else 0.0
        )
        sizes = [(f.width_px, f.height_px) for f in frames]
        turns, headings = found_turned(seen, placement.poses, placement.lines, sizes, cap_m)
        self._report(context, [f.name for f in frames], placement.poses, turns, headings)
        context.metric("matching.pairs_tried", len(tried))
        context.metric("matching.pairs_tied", len(pairs))
        context.metric("matching.tie_points", sum(len(p) for p in pairs))
        return {
            "ties": TiePoints(tuple(pairs), tuple(untied)),
            "placement": replace(
                placement,
                poses=reheaded(righted(placement.poses, turns), headings),
                turned=tuple(turns.get(i, 0) for i in range(len(frames))),
            ),
        }

    @staticmethod
    def _without_positions(
        context: Context, features: Sequence[Features], frames: Sequence[int]
    ) -> list[tuple[int, int]]:
        """Candidate pairs of frames that have no position, by what their images have in common."""
        if not frames:
            return []
        few = [coarse(f) for f in features]
        compared = to_compare(len(features), frames)
        jobs = [Comparison(few[i], tuple(few[j] for j in others)) for i, others in compared]
        found = context.map("frames without position", alike, jobs, keys=[i for i, _ in compared])
        context.metric("matching.pairs_compared", sum(len(others) for _, others in compared))
        return likely_pairs(compared, found)

    @staticmethod
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
                f"its heading was given as {np.degrees(yaw[frame]) % 360.0:.0f} degrees and by its course is "
                f"about {np.degrees(heading):.0f}; set by its neighbours",
            )
        for frame, quarters in turns.items():
            context.warn(
                "frame-turned",
                names[frame],
                f"its pixels were turned by {quarters * 90} degrees after the flight; righted here",
            )

    @staticmethod
    def _job(
        params: Params,
        ground_pixel_m: float,
        cameras: Sequence[Camera],
        features: Sequence[Features],
        ground_m: Sequence[Floats],
        reach_m: Floats,
        pair: tuple[int, int],
    ) -> PairJob:
        a, b = pair
        radius = params.radius_m
        if radius == "auto":
            radius = max(300.0 * ground_pixel_m, float(np.hypot(reach_m[a], reach_m[b])))
        reduction = max(
            reduction_for(cameras[i].width_px, cameras[i].height_px, params.longest_px) for i in (a, b)
        )
        return PairJob(
            features[a], features[b], ground_m[a], ground_m[b], float(radius),
            params.tolerance_px * reduction, params.ratio, params.check, params.least,
        )  # fmt: skip
