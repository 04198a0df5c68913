"""Frames over flat ground with points that bear targets, without a flight: poses that are known, and reported ones."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from target_survey import with_target

from geomosaic.camera.exterior import Pose
from geomosaic.camera.interior import Camera
from geomosaic.camera.rotation import Rotation
from geomosaic.geodesy.local import LocalFrame
from geomosaic.marking.oriented_frames import OrientedFrames
from geomosaic.marking.pose_correction import moved
from geomosaic.projection.ground import flat_ground
from geomosaic.survey.model import Attitude, ControlPoint, Frame, Position, Survey

CAMERA = Camera("wide", 900, 600, 800.0, 452.0, 298.0, k1=-0.05)
HEIGHT_M = 40.0
POINTS_M = ((-9.0, -14.0), (11.0, -9.0), (-12.0, 6.0), (9.0, 12.0), (1.0, 0.0), (-2.0, 19.0), (14.0, 25.0))
SHIFT = np.array([2.0, -1.5, 1.0, 0.01, -0.008, 0.03])
"""What reported poses are off by in common: m, and rad about the camera's axes."""
OWN_SD = np.array([0.2, 0.2, 0.3, 0.002, 0.002, 0.004])
POSE_SD = np.array([3.0, 3.0, 3.0, 0.02, 0.02, 0.05])


@dataclass(frozen=True)
class MarkingScene:
    """frames as they are reported; true_poses: without their errors; true_px: where each frame (by name) shows each point (by name)."""

    frames: OrientedFrames
    true_poses: tuple[Pose, ...]
    points: tuple[ControlPoint, ...]
    true_px: dict[str, dict[str, tuple[float, float]]]

    def marked(self, most: int, of: int = len(POINTS_M)) -> tuple[ControlPoint, ...]:
        """The points; the first `of` of them have true marks in their first `most` frames."""
        marks = [[(f, *at) for f, at in self.true_px[p.name].items()][:most] for p in self.points[:of]]
        return (
            *(replace(p, images=tuple(m)) for p, m in zip(self.points, marks, strict=False)),
            *self.points[of:],
        )


def marking_scene(folder: Path, frames: int = 8, seed: int = 1) -> MarkingScene:
    """Two lines of frames. Their files are not written: `write_frames` does."""
    rng = np.random.default_rng(seed)
    at = LocalFrame(7.0, 51.0, 100.0)
    poses, reported, listed = [], [], []
    for i in range(frames):
        east, north = (-6.0, 7.0)[i % 2], -12.0 + 8.0 * (i // 2)
        yaw, pitch, roll = np.radians([180.0 * (i % 2), *rng.normal(0.0, 2.0, 2)])
        pose = Pose(np.array([east, north, HEIGHT_M]), Rotation.from_yaw_pitch_roll(yaw, pitch, roll))
        poses.append(pose)
        reported.append(moved(pose, SHIFT + OWN_SD * rng.standard_normal(6)))
        lon, lat, height = at.geodetic_from_enu(pose.position_m).tolist()
        position = Position(lon, lat, height, HEIGHT_M, 3.0, 3.0, 3.0, "exif")
        attitude = Attitude(None, None, None, 5.0, 1.0, "none")
        path = folder / f"F{i:02d}.jpg"
        listed.append(Frame(path.name, str(path), 900, 600, 3, "uint8", "wide", position, attitude))
    ground = flat_ground(at, 100.0, 200.0)
    places = np.array([(e, n, float(ground.up_at(e, n))) for e, n in POINTS_M])
    points, true_px = [], {}
    for k, (lon, lat, height) in enumerate(at.geodetic_from_enu(places).tolist()):
        name = f"T{k + 1}"
        points.append(ControlPoint(name, lon, lat, height, 0.02, 0.03, False, ()))
        seen = [pose.image_from_ground(CAMERA, places[k]) for pose in poses]
        inside = [(i, px) for i, px in enumerate(seen) if ((px > 15) & (px < [885, 585])).all()]
        true_px[name] = {listed[i].name: (float(px[0]), float(px[1])) for i, px in inside}
    survey = Survey(tuple(listed), (CAMERA,), at, "EPSG:32632")
    of = (tuple(reported), np.tile(POSE_SD, (frames, 1)), (CAMERA,) * frames, ground, "the frames' tags")
    return MarkingScene(OrientedFrames(survey, *of), tuple(poses), tuple(points), true_px)


def write_frames(scene: MarkingScene, seed: int = 2) -> None:
    """Their JPEG files: a meadow with targets."""
    rng = np.random.default_rng(seed)
    for frame in scene.frames.frames:
        coarse, fine = (rng.normal(0.0, 1.0, (n, int(1.5 * n), 1)).astype(np.float32) for n in (30, 600))
        light = 8.0 * cv2.resize(coarse, (900, 600), interpolation=cv2.INTER_CUBIC)[..., None] + 5.0 * fine
        pixels = np.clip(light + [70.0, 110.0, 95.0], 0, 255).astype(np.uint8)
        for at in scene.true_px.values():
            if frame.name in at:
                with_target(pixels, *at[frame.name])
        cv2.imwrite(frame.path, pixels, [cv2.IMWRITE_JPEG_QUALITY, 95])
