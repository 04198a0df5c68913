"""Who gives the cells about raised roofs, in a long line of frames."""

from __future__ import annotations

import tracemalloc

import numpy as np
from mosaic_scenes import CAMERA, CRS, HOME

from geomosaic.camera.exterior import Poses
from geomosaic.camera.rotation import Rotation
from geomosaic.composition.grid import output_grid
from geomosaic.composition.mosaic_scene import MapPixels
from geomosaic.composition.ownership import nearest_nadir
from geomosaic.composition.roof_ownership import with_roofs
from geomosaic.composition.roofs import RaisedRoof
from geomosaic.composition.scene import Scene, ground_of
from geomosaic.composition.views import PosedFrames, frame_views
from geomosaic.composition.window import Window
from geomosaic.projection.ground import GroundSurface, RaisedObject
from geomosaic.spread import AtOnce
from geomosaic.survey.model import Survey

FRAMES, APART_M, HIGH_M, SIDE_M = 30, 20.0, 8.0, 6.0


def line_of_frames() -> tuple[Scene, np.ndarray]:
    """Over level land, 50 m up, from west to east; and where they are."""
    n = FRAMES
    at = np.array([[APART_M * (i - (n - 1) / 2.0), 0.0, 50.0] for i in range(n)])
    turned = np.repeat(Rotation.from_yaw_pitch_roll(0.0, 0.0, 0.0).matrix[None], n, axis=0)
    poses = Poses(at, turned, np.full((n, 3), 0.7), np.full((n, 3), 0.01))
    land = GroundSurface("tie_surface", -400.0, -60.0, 1.0, np.zeros((120, 800)))
    frames = PosedFrames(Survey((), (CAMERA,), HOME, CRS), poses, [CAMERA] * n, [True] * n, land)
    views = frame_views(frames, CRS)
    return Scene(HOME, land, output_grid(MapPixels(CRS, 0.05), views, ["f"] * n), views), at


def blocked(camera_m: np.ndarray, places_m: np.ndarray, middle_m: np.ndarray) -> np.ndarray:
    """Which lines of sight (n,) a house of SIDE_M, less its rim of 1 m, stops: by where they pass its walls."""
    ray = places_m - camera_m
    with np.errstate(divide="ignore"):
        low, high = np.sort(
            [(middle_m + side * (SIDE_M / 2.0 - 1.0) - camera_m[:2]) / ray[:, :2] for side in (-1, 1)], axis=0
        )
    down = np.stack([(camera_m[2] - HIGH_M) / -ray[:, 2], np.ones(len(ray))])
    return np.asarray(np.maximum(low.max(axis=1), down[0]) < np.minimum(high.min(axis=1), down[1]))


def test_what_a_roof_hides_goes_to_frames_that_see_it_in_little_memory() -> None:
    """Houses north and south of the line. Shares of all 217,000 cells for each frame are 26 MB."""
    scene, at = line_of_frames()
    before, _ = nearest_nadir(scene, [True] * FRAMES, 8)
    middles = np.array([[-243.0 + 60.0 * k, 12.0 if k % 2 else -13.0] for k in range(9)])
    up_m = np.full((int(SIDE_M / 0.25),) * 2, HIGH_M, np.float32)
    owners = [int(np.argmin(np.hypot(*(at[:, :2] - middle).T))) for middle in middles]
    first = [middle - SIDE_M / 2.0 + 0.125 for middle in middles]
    roofs = [RaisedRoof(RaisedObject(*f.tolist(), 0.25, up_m), i) for f, i in zip(first, owners, strict=True)]
    tracemalloc.start()
    after = with_roofs(before, scene, scene.ground, roofs, AtOnce())
    peak_mb = tracemalloc.get_traced_memory()[1] / 1e6
    tracemalloc.stop()
    assert before.owner.size > 200_000 and peak_mb < 12.0
    rows, cols = before.owner.shape
    places = ground_of(scene, Window(0, 0, cols * 8, rows * 8), 8).points_m()
    changed = after.owner != before.owner
    for middle, frame in zip(middles, owners, strict=True):
        off_m = np.abs(places[..., :2] - middle).max(axis=-1)
        assert (after.owner[off_m < 1.0] == frame + 1).all()
        about = changed & (off_m > SIDE_M / 2.0 + 1.0) & (off_m < 15.0)
        assert about.sum() > 10
        for i in np.unique(after.owner[about]):
            its = about & (after.owner == i)
            assert not blocked(at[i - 1], places[its], middle).any()
        changed &= off_m > 15.0
    assert not changed.any()
