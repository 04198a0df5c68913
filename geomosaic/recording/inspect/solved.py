"""What a recorded run came to know of its frames and pairs: figures of each, as values that JSON knows."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from geomosaic.adjustment.model import Adjusted
from geomosaic.arrays import Floats
from geomosaic.camera.exterior import Poses
from geomosaic.camera.rotation import log_turn
from geomosaic.constants import SLIGHT, tuned
from geomosaic.export.orientation import Orientations, orientations
from geomosaic.matching.model import TiePoints
from geomosaic.matching.turned import corrected_poses
from geomosaic.placement.model import Placement
from geomosaic.placement.prior import heading_assumed, position_assumed
from geomosaic.quality.misalignment import pair_misalignments
from geomosaic.quality.solved_tables import DOWN_WEIGHTED, tie_weights
from geomosaic.survey.model import Survey

_FARTHEST_M = tuned(1e8, "m", "from a survey's centre: beyond lies more than the Earth's other side")
POSE = (
    *("lon_deg", "lat_deg", "height_ellipsoidal_m", "easting_m", "northing_m"),
    *("yaw_deg", "pitch_deg", "roll_deg", "sd_e_m", "sd_n_m", "sd_u_m"),
    *("sd_omega_deg", "sd_phi_deg", "sd_kappa_deg"),
)


@dataclass(frozen=True)
class Solved:
    """What is known of a survey, as far as its run got: None for what isn't recorded.

    prior: as the tags tell; placement: with headings and turned images set right by matching.
    warned: code, frame and text of every warning that names a frame.
    """

    survey: Survey
    prior: Placement | None = None
    placement: Placement | None = None
    ties: TiePoints | None = None
    adjusted: Adjusted | None = None
    warned: tuple[tuple[str, str, str], ...] = ()

    @cached_property
    def names(self) -> tuple[str, ...]:
        """The frames' names."""
        return tuple(frame.name for frame in self.survey.frames)

    def problem(self) -> str:
        """Why these can't be one run's (a stranger's file may say anything); empty if they can."""
        n = len(self.names)
        for placement in (self.prior, self.placement):
            if placement is not None:
                if not _whole(placement.poses, n) or len(placement.lines) != n:
                    return "its placement isn't of its frames"
                if placement.turned and len(placement.turned) != n:
                    return "its turned images aren't of its frames"
                if any(not 0 <= i < n for pair in placement.pairs for i in pair):
                    return "its placement has pairs of frames that aren't there"
        if {f.camera for f in self.survey.frames} - {c.name for c in self.survey.cameras}:
            return "its frames have cameras that aren't there"
        ties, adjusted = self.ties, self.adjusted
        if ties is not None:
            for t in ties.pairs:
                if t.left_px.shape != (len(t.left_px), 2) or t.left_px.shape != t.right_px.shape:
                    return "its tie points aren't places in two images"
            if any(not 0 <= i < n for pair in ties.frames for i in pair) or any(
                not 0 <= i < n for pair in ties.untied for i in pair
            ):
                return "its tie points are of frames that aren't there"
        if adjusted is None:
            return ""
        if not _whole(adjusted.poses, n) or not len(adjusted.status) == len(adjusted.cameras) == n:
            return "its adjusted frames aren't those of the survey"
        if adjusted.pose_covariance is not None and adjusted.pose_covariance.shape != (n, 6, 6):
            return "its covariances aren't of its frames"
        shapes = [(len(t), 2) for t in ties.pairs] if ties is not None else None
        if shapes is None or [r.shape for r in adjusted.residuals_m] != shapes:
            return "its residuals aren't those of its tie points"
        image = adjusted.image_residuals
        if image is not None:
            m = len(image.frame)
            if image.frame.shape != (m,) or image.weight.shape != (m,) or image.image_px.shape != (m, 2):
                return "its image residuals are of unequal lengths"
            if m and (
                image.frame.dtype.kind not in "iu" or not 0 <= image.frame.min() <= image.frame.max() < n
            ):
                return "its image residuals are of frames that aren't there"
        return ""

    @cached_property
    def given(self) -> Orientations | None:
        """Where the tags place the frames, in the terms of positions.csv."""
        return None if self.prior is None else orientations(self.survey, self.prior.poses, self._as_given)

    @cached_property
    def found(self) -> Orientations | None:
        """Where the adjustment places them."""
        if self.adjusted is None or self.prior is None:
            return None
        return orientations(self.survey, self.prior.poses, self.adjusted)

    @property
    def _as_given(self) -> Any:
        """The tags as if an adjustment had left all frames where they were."""
        assert self.prior is not None
        cameras = tuple(self.survey.camera_of(i) for i in range(len(self.names)))
        nothing: Any = None  # no ground is asked for
        return Adjusted(self.prior.poses, cameras, ("placed",) * len(self.names), (), (), nothing)

    @cached_property
    def turned(self) -> tuple[int, ...]:
        """Quarter turns of each frame's image after the flight."""
        return (self.placement and self.placement.turned) or (0,) * len(self.names)

    @cached_property
    def moved_m(self) -> Floats:
        """Found minus given, east, north and up (n, 3); NaN where one of both is unknown."""
        if self.adjusted is None or self.prior is None:
            return np.full((len(self.names), 3), np.nan)
        moved = self.adjusted.poses.positions_m - self.prior.poses.positions_m
        return np.where(position_assumed(self.prior.poses)[:, None], np.nan, moved)

    @cached_property
    def yawed_deg(self) -> Floats:
        """How far found headings are from given ones, turned images turned back, (n,); NaN where unknown."""
        if self.adjusted is None or self.prior is None:
            return np.full(len(self.names), np.nan)
        given = corrected_poses(self.prior.poses, {i: q for i, q in enumerate(self.turned) if q})
        turn = log_turn(self.adjusted.poses.rotations @ np.swapaxes(given.rotations, 1, 2))[:, 2]
        return np.where(heading_assumed(self.prior.poses), np.nan, np.degrees(turn))

    @cached_property
    def weights(self) -> tuple[Floats, ...]:
        """The solve's weight of each tie point of each pair, see `tie_weights`."""
        image = None if self.adjusted is None else self.adjusted.image_residuals
        return tie_weights(self.ties or TiePoints(()), image)

    @cached_property
    def pixel_m(self) -> float:
        """The paper's D, the ground pixel that residuals are given in; NaN if unknown."""
        placement = self.placement or self.prior
        return (
            placement.ground_pixel_m if placement is not None and placement.ground_pixel_m > 0 else math.nan
        )


def pair_figures(solved: Solved) -> list[dict[str, Any]]:
    """Of each tied pair, then of each tried in vain: points, misalignment, residuals, share down-weighted."""
    if solved.ties is None:
        return []
    ties, names = solved.ties, solved.names
    left_m = solved.adjusted.residuals_m if solved.adjusted else tuple(np.zeros((0, 2)) for _ in ties.pairs)
    of = pair_misalignments(ties, left_m)
    out: list[dict[str, Any]] = []
    for i, t in enumerate(ties.pairs):
        seen = solved.weights[i][np.isfinite(solved.weights[i])]
        out.append(
            {
                "left": names[t.left],
                "right": names[t.right],
                "tied": True,
                "tie_points": len(t),
                "mean_m": [known(v) for v in of.mean_m[i]],
                "rms_m": known(of.rms_m[i]),
                "rms_px": known(of.rms_m[i] / solved.pixel_m),
                "max_m": known(of.max_m[i]),
                "in_solve": len(seen),
                "share_down_weighted": float((seen < DOWN_WEIGHTED).mean()) if len(seen) else None,
            }
        )
    out += [{"left": names[a], "right": names[b], "tied": False, "tie_points": 0} for a, b in ties.untied]
    return out


def frame_figures(solved: Solved, pairs: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Of each frame: status, given and found pose with deviations, what ties it, what is left, what was
    said."""
    by_frame = pairs_by_frame(pairs)
    residual_px, down_weighted = _image_figures(solved)
    said: dict[str, list[str]] = {}
    for code, frame, text in solved.warned:
        said.setdefault(frame, []).append(f"{code}: {text}")
    placement = solved.placement or solved.prior
    out: list[dict[str, Any]] = []
    for i, name in enumerate(solved.names):
        mine = by_frame.get(name, [])
        tied = [p for p in mine if p["tied"]]
        squares = [(p["rms_m"], p["tie_points"]) for p in tied if p.get("rms_m") is not None]
        points = sum(k for _, k in squares)
        out.append(
            {
                "frame": name,
                "status": solved.adjusted.status[i] if solved.adjusted else "not adjusted",
                "line": placement.lines[i] if placement else None,
                "given": _pose(solved.given, i),
                "found": _pose(solved.found, i),
                "moved_m": [known(v) for v in solved.moved_m[i]],
                "yaw_off_deg": known(solved.yawed_deg[i]),
                "image_turned_deg": 90 * solved.turned[i],
                "pairs_tied": len(tied),
                "pairs_untied": len(mine) - len(tied),
                "tie_points": sum(p["tie_points"] for p in tied),
                "rms_m": math.sqrt(sum(r * r * k for r, k in squares) / points) if points else None,
                "rms_px": known(residual_px[i]),
                "share_down_weighted": known(down_weighted[i]),
                "said": said.get(name, []),
            }
        )
    for left in solved.survey.left_out:
        out.append(
            {"frame": left.name, "status": "left_out", "said": said.get(left.name, []) or [left.reason]}
        )
    return out


def pairs_by_frame(pairs: list[dict[str, Any]]) -> dict[str, list[dict[str, Any]]]:
    """The pairs of each frame that has any."""
    out: dict[str, list[dict[str, Any]]] = {}
    for pair in pairs:
        for name in dict.fromkeys((pair["left"], pair["right"])):
            out.setdefault(name, []).append(pair)
    return out


def status_counts(frames: list[dict[str, Any]]) -> dict[str, int]:
    """How many frames there are of each status."""
    return dict(Counter(f["status"] for f in frames))


def known(value: float) -> float | None:
    """A number as JSON knows it; None for what isn't finite."""
    return float(value) if math.isfinite(value) else None


def _image_figures(solved: Solved) -> tuple[Floats, Floats]:
    """Root mean square image residual (px) and share of its observations down-weighted, of each frame."""
    n = len(solved.names)
    image = None if solved.adjusted is None else solved.adjusted.image_residuals
    if image is None or image.residual_px.shape != (len(image.frame), 2):
        return np.full(n, np.nan), np.full(n, np.nan)
    frame = np.asarray(image.frame, dtype=np.intp)
    count = np.bincount(frame, minlength=n).astype(np.float64)
    with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
        squares = np.bincount(frame, (image.residual_px**2).sum(axis=1), minlength=n)
        down_weighted = np.bincount(frame, image.weight < DOWN_WEIGHTED, minlength=n)
        return np.sqrt(squares / count), down_weighted / count


def _pose(of: Orientations | None, i: int) -> dict[str, Any] | None:
    if of is None:
        return None
    values = (of.lon_lat_height, of.map_m, of.yaw_pitch_roll_deg, of.sd_m, of.sd_omega_phi_kappa_deg)
    return {n: known(v) for n, v in zip(POSE, np.concatenate([v[i] for v in values]), strict=True)}


def _whole(poses: Poses, n: int) -> bool:
    """Whether these can be poses of n frames: of the right shapes, on Earth, and turned by rotations."""
    shapes = (poses.positions_m, poses.positions_sd_m, poses.rotations_sd_rad)
    if any(v.shape != (n, 3) for v in shapes) or poses.rotations.shape != (n, 3, 3):
        return False
    there = np.isfinite(poses.positions_m).all() and np.isfinite(poses.rotations).all()
    if not there or np.abs(poses.positions_m).max(initial=0.0) > _FARTHEST_M:
        return False
    if np.abs(poses.rotations).max(initial=0.0) > 2.0:
        return False
    turned = np.swapaxes(poses.rotations, 1, 2) @ poses.rotations - np.eye(3)
    return bool(np.abs(turned).max(initial=0.0) < SLIGHT)
