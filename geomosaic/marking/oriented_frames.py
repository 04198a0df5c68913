"""Frames with their poses: those of their tags or of a POS file, or the adjusted ones of a finished run."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from geomosaic.adjustment.model import Adjusted
from geomosaic.arrays import Floats
from geomosaic.camera.exterior import Pose, Poses
from geomosaic.camera.interior import Camera
from geomosaic.constants import tuned
from geomosaic.errors import InputError
from geomosaic.geodesy.mapcrs import is_local
from geomosaic.pipeline.reporter import Reporter
from geomosaic.pipeline.run_options import RunOptions
from geomosaic.pipeline.run_results import load_artefact, read_summary
from geomosaic.pipeline.runner import run
from geomosaic.placement.model import Placement
from geomosaic.projection.footprint import footprint
from geomosaic.projection.ground import GroundSurface
from geomosaic.requests.mosaic_request import MosaicRequest
from geomosaic.requests.run_request import cores, recipe_of
from geomosaic.survey.folder import frame_files
from geomosaic.survey.model import ControlPoint, Frame, Survey
from geomosaic.survey.names import some

_POSITION_SD_M = tuned((0.1, 100.0), "m", "of prior positions; less: a biased run resists; more: no prior")
_ROTATION_SD_DEG = tuned((0.05, 20.0), "deg", "of prior attitudes; less: resists marks; more: steps diverge")
_NO_POSES = "none, no frame has a position; a finished run of the frames (--run) predicts places"
_STAGES = ("survey.read", "matching.flying_height", "projection.ground", "placement.pos")


@dataclass(frozen=True)
class OrientedFrames:
    """Frames of a survey with the pose and the camera of each.

    pose_sd (n, 6): deviations of positions in m and of turns about the cameras' axes in rad. ground: where
    outlines lie; source: of the poses, for people; adjusted: whether a run has related the frames to each
    other.
    """

    survey: Survey
    poses: tuple[Pose, ...]
    pose_sd: Floats
    cameras: tuple[Camera, ...]
    ground: GroundSurface
    source: str
    adjusted: bool = False

    @property
    def frames(self) -> tuple[Frame, ...]:
        """The frames, in the order of the poses."""
        return self.survey.frames

    @property
    def on_earth(self) -> bool:
        """Whether anything says where the frames lie; else points are predicted by their marks alone."""
        return not is_local(self.survey.map_crs)

    def places_m(self, points: tuple[ControlPoint, ...]) -> Floats:
        """Surveyed points (k, 3) in the work frame."""
        at = np.array([(p.lon_deg, p.lat_deg, p.height_ellipsoidal_m) for p in points]).reshape(-1, 3)
        places = self.survey.work_frame.enu_from_geodetic(*at.T)
        for k in (k for k, p in enumerate(points) if p.plan_only):
            places[k, 2] = self.ground.up_at(*places[k, :2])
        return places

    def outline_m(self, i: int) -> Floats:
        """East and north (k, 2) of frame i's outline on the ground, without what shows the sky."""
        outline = footprint(self.poses[i], self.cameras[i], self.ground, 2)
        return outline[np.isfinite(outline).all(axis=1), :2]


def frames_by_tags(request: MosaicRequest, reporter: Reporter) -> OrientedFrames:
    """Frames where their tags or the POS file put them, by the first stages of a mosaic.

    Raises: what the stages raise.
    """
    stages = [id for id in request.stages() if id in _STAGES]
    recipe = recipe_of(("control", f"frames of {request.frames.name}"), stages, request.parameters())
    with tempfile.TemporaryDirectory(prefix="geomosaic-control-") as folder:
        summary = run(recipe, Path(folder), RunOptions(workers=request.workers or cores()), reporter=reporter)
        survey = load_artefact(Path(folder), summary, "levelled_survey", Survey)
        ground = load_artefact(Path(folder), summary, "prior_ground", GroundSurface)
        placement = load_artefact(Path(folder), summary, "prior_placement", Placement)
    every = range(len(survey.frames))
    cameras = tuple(survey.camera_of(i) for i in every)
    source = "the frames' tags" if request.pos is None else request.pos.name
    if is_local(survey.map_crs):
        source = _NO_POSES
    poses = tuple(placement.poses[i] for i in every)
    return OrientedFrames(survey, poses, _pose_sd(placement.poses), cameras, ground, source)


def frames_of_run(folder: Path, run_folder: Path) -> OrientedFrames:
    """The frames in a folder with the adjusted poses and cameras of a run.

    Raises: `FileError` for what is no finished run, `InputError` where the run has none of the frames.
    """
    summary = read_summary(run_folder)
    survey = load_artefact(run_folder, summary, "survey", Survey)
    adjusted = load_artefact(run_folder, summary, "adjusted", Adjusted)
    there = {name: path for path, name in frame_files(folder).items()}
    kept = [i for i, frame in enumerate(survey.frames) if frame.name in there]
    if not kept:
        problem = f"none of the run's frames is in this folder ({some(f.name for f in survey.frames)})"
        raise InputError(problem, file=folder, fix="give the frames that the run was made of")
    frames = tuple(replace(survey.frames[i], path=str(there[survey.frames[i].name])) for i in kept)
    poses, sd = tuple(adjusted.poses[i] for i in kept), _pose_sd(adjusted.poses)[kept]
    cameras = tuple(adjusted.cameras[i] for i in kept)
    source = f"the adjusted poses of {run_folder.name}"
    return OrientedFrames(replace(survey, frames=frames), poses, sd, cameras, adjusted.ground, source, True)


def _pose_sd(poses: Poses) -> Floats:
    """Deviations (n, 6) within their limits; unknown ones are the largest."""
    place = np.clip(np.nan_to_num(poses.positions_sd_m, nan=np.inf), *_POSITION_SD_M)
    turn = np.clip(np.nan_to_num(poses.rotations_sd_rad, nan=np.inf), *np.radians(_ROTATION_SD_DEG))
    about_camera = np.sqrt(np.einsum("nij,ni->nj", poses.rotations**2, turn**2))
    return np.column_stack([place, about_camera])
