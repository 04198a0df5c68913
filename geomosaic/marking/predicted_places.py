"""Where surveyed points are expected in the frames, by poses that the marks made so far have corrected."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from geomosaic.arrays import Floats
from geomosaic.camera.exterior import Pose
from geomosaic.constants import FEW, sourced
from geomosaic.marking.marked_places import placed_point, places_of_others
from geomosaic.marking.oriented_frames import OrientedFrames
from geomosaic.marking.pose_correction import FrameMarks, common_correction, corrected_frame, moved
from geomosaic.survey.model import ControlPoint

SUSPECT = sourced(3.72, "deviations", "of a mark, two numbers: 0.1 % are beyond", "chi-squared, 2 degrees")


@dataclass(frozen=True)
class PredictedPlaces:
    """image_px (frames, points, 2): where each frame shows each point, NaN where it does not. off_px: of each
    mark, by point and frame, the distance from where the other marks predict it; suspect: marks that are
    farther off than expected."""

    image_px: Floats
    off_px: dict[tuple[int, int], float] = field(default_factory=dict)
    suspect: frozenset[tuple[int, int]] = frozenset()

    def expected(self, point: int, sizes_px: Floats) -> list[int]:
        """Frames that show a point inside them or close to them, by its distance from their middle. sizes_px
        (frames, 2)."""
        away = self.image_px[:, point] / sizes_px - 0.5
        inside = (np.abs(np.nan_to_num(away, nan=np.inf)) <= 0.5 + FEW).all(axis=1)
        away = np.linalg.norm(away, axis=1)
        return [int(i) for i in np.argsort(np.where(inside, away, np.inf), kind="stable")[: inside.sum()]]


def predicted_places(frames: OrientedFrames, points: tuple[ControlPoint, ...]) -> PredictedPlaces:
    """Places of all points in all frames, by poses that the points' marks correct. Where frames have no place
    on the Earth they are by the marks alone (`marked_places`), and NaN if no run has related the frames."""
    if not frames.on_earth:
        return _by_marks_alone(frames, points)
    places_m = frames.places_m(points)
    places = np.column_stack([places_m, [point.sd_horizontal_m for point in points]])
    number = {frame.name: i for i, frame in enumerate(frames.frames)}
    marks: dict[int, list[tuple[int, float, float]]] = {}
    for k, point in enumerate(points):
        for name, col, row in point.images:
            marks.setdefault(number[name], []).append((k, col, row))
    marked = {i: _marks(frames, i, of, places) for i, of in marks.items()}
    common = common_correction([*marked.values()])
    poses = [moved(pose, common) for pose in frames.poses]
    off_px, suspect = {}, set()
    for i, of in marks.items():
        found = corrected_frame(_marks(frames, i, of, places, common))
        poses[i] = found.pose
        for (k, _, _), off, deviations in zip(of, found.off_px, found.deviations, strict=True):
            off_px[k, i] = float(off)
            if deviations > SUSPECT:
                suspect.add((k, i))
    return PredictedPlaces(_seen(frames, poses, places_m), off_px, frozenset(suspect))


def _by_marks_alone(frames: OrientedFrames, points: tuple[ControlPoint, ...]) -> PredictedPlaces:
    places_m = np.full((len(points), 3), np.nan)
    number = {frame.name: i for i, frame in enumerate(frames.frames)}
    off_px, suspect = {}, set()
    for k, point in enumerate(points if frames.adjusted else ()):
        marked = [number[name] for name, _, _ in point.images]
        image_px = np.array([at for _, *at in point.images]).reshape(-1, 2)
        of = [frames.poses[i] for i in marked], [frames.cameras[i] for i in marked]
        found = placed_point(*of, image_px, frames.ground) if marked else None
        if found is None:
            continue
        places_m[k] = found.place_m
        for i, off, deviations in zip(marked, found.off_px, found.deviations, strict=True):
            if np.isfinite(off):
                off_px[k, i] = float(off)
            if deviations > SUSPECT:
                suspect.add((k, i))
    places_m = places_of_others(points, places_m, frames.ground)
    return PredictedPlaces(_seen(frames, frames.poses, places_m), off_px, frozenset(suspect))


def _seen(frames: OrientedFrames, poses: Sequence[Pose], places_m: Floats) -> Floats:
    """Where frames in these poses show places (k, 3) in the work frame: (frames, k, 2)."""
    return np.stack(
        [pose.image_from_ground(camera, places_m) for pose, camera in zip(poses, frames.cameras, strict=True)]
    )


def _marks(
    frames: OrientedFrames,
    i: int,
    marks: list[tuple[int, float, float]],
    places: Floats,
    common: Floats | None = None,
) -> FrameMarks:
    """The marks of frame i. marks: number of the point, col and row; places (k, 4): of the points in m, with
    their deviation in plan; common: a correction of its pose."""
    pose = frames.poses[i] if common is None else moved(frames.poses[i], common)
    of = np.array([k for k, _, _ in marks])
    image_px = np.array([(col, row) for _, col, row in marks])
    return FrameMarks(pose, frames.cameras[i], frames.pose_sd[i], places[of, :3], places[of, 3], image_px)
