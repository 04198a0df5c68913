"""Frames that can't see a place don't give it: masks, what none sees, and a mosaic about a house."""

from __future__ import annotations

import zlib
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import rasterio
from mosaic_scenes import CAMERA, make_survey, truth

from geomosaic.composition.compose import compose
from geomosaic.composition.grid import output_grid
from geomosaic.composition.hidden import Clear, Hidden
from geomosaic.composition.model import MapPixels, OutputGrid
from geomosaic.composition.occlusion import (
    OcclusionDepth,
    occluded,
    occluded_parts,
    occlusion_depth,
    side_px_of,
    with_occlusion,
)
from geomosaic.composition.ownership import nearest_nadir
from geomosaic.composition.raster import MosaicFiles
from geomosaic.composition.scene import Scene
from geomosaic.composition.views import PosedFrames, frame_views
from geomosaic.composition.window import Window
from geomosaic.projection.ground import GroundSurface

GSD_M, SPACING_M, TOP_M = 0.25, 0.5, 10.0


def house() -> GroundSurface:
    """Flat land with a house of 12 m x 9 m, 10 m high, between the flight lines."""
    axis = -80.0 + SPACING_M * np.arange(321)
    east, north = np.meshgrid(axis, axis)
    return GroundSurface(
        "dense", -80.0, -80.0, SPACING_M, np.where((abs(east) < 6.0) & (abs(north) < 4.5), TOP_M, 0.0)
    )


def test_low_steps_and_islands_hide_nothing_and_edges_count_in_full() -> None:
    """In cells of 0.5 m: a shadow of 4 m, its depth falling to nothing; a kerb's of 0.8 m; one deep cell."""
    below = np.full((40, 60), -1.0, np.float32)
    below[5:15, 10:18] = np.linspace(4.0, 0.0, 8)
    below[25:35, 10:18] = 0.8
    below[8:11, 40:42] = 3.0
    below[30, 50] = 9.0
    found = occluded(below, 0.5)
    assert found[4:16, 9:18].all() and not found[:, 19:38].any()
    assert not found[24:36, 8:20].any() and not found[29:32, 49:52].any() and found[7:12, 39:43].all()
    below[9:11, 12] = -1.0
    assert occluded(below, 0.5)[9:11, 12].all(), "two cells seen amid it"


def test_what_no_frame_sees_is_given_by_the_one_that_comes_nearest_to_it() -> None:
    grid = OutputGrid("EPSG:32632", 0.0, 0.0, 0.25, 64, 64)

    def depth_of(frame: int, depth: np.ndarray) -> OcclusionDepth:
        shape = (depth.shape[0], depth.shape[1])
        return OcclusionDepth(frame, 0, 0, shape, zlib.compress(depth.astype(np.uint8).tobytes()))

    one, other = np.zeros((16, 16)), np.zeros((16, 16))
    one[2:6], other[4:9] = 30, 20
    one[4, :8], one[:, 15], other[:, 15] = 10, 255, 255
    hidden, unseen = occluded_parts(grid, 4, [depth_of(3, one), depth_of(7, other)])
    flags = {h.frame: h.flags for h in hidden}
    assert flags[3][2:6, 8:15].all() and not flags[3][4, :8].any() and flags[3][5, :15].all()
    assert flags[7][4, :8].all() and not flags[7][4:6, 8:15].any() and flags[7][6:9, :15].all()
    assert not (flags[3] & flags[7]).any() and not flags[3][:, 15].any()
    assert unseen.area_m2 == pytest.approx(30.0) and unseen.share == pytest.approx(30 / 240)


def test_flags_at_pixels_and_in_planning_cells() -> None:
    flags = np.zeros((8, 12), dtype=bool)
    flags[4:, 4:8] = True
    hidden = Hidden.of(0, 4, 8, 4, flags)
    assert np.array_equal(hidden.flags, flags)
    window = Window(16, 32, 64, 48)
    np.testing.assert_array_equal(hidden.within(window)[:8], np.pad(flags, ((0, 0), (0, 4))))
    share = hidden.share(window, 16)
    assert share.shape == (3, 4) and share[1, 1] == 1.0 and share.sum() == 1.0
    margin = Clear(hidden).margin_px(Window(16, 32, 48, 32))
    inside = np.kron(flags, np.ones((4, 4))) > 0
    wrong = (margin > 0.0) == inside
    assert not (wrong & (cv2.erode(inside.astype(np.uint8), np.ones((3, 3))) > 0)).any()
    assert not (wrong & (cv2.dilate(inside.astype(np.uint8), np.ones((3, 3))) == 0)).any()
    assert margin[8, 2] == pytest.approx(np.hypot(7.5, 13.5), rel=0.1)


@pytest.mark.parametrize("side_px", [8, 4, 2, 1])
def test_pixels_are_given_where_cells_of_three_frames_meet(side_px: int) -> None:
    giver = np.array([[0, 0, 1, 1], [0, 0, 1, 1], [2, 2, 2, 0], [1, 2, 0, 0]])
    side = side_px * len(giver)
    margins = [
        Clear(Hidden.of(k, side_px, 3, 5, giver != k)).margin_px(Window(5 * side_px, 3 * side_px, side, side))
        for k in range(3)
    ]
    of_pixels = np.kron(giver, np.ones((side_px, side_px), dtype=int))
    for k, margin in enumerate(margins):
        assert (margin[of_pixels == k] > 0.0).all()


def composed(folder: Path, shade: bool) -> tuple[np.ndarray, np.ndarray, float]:
    """The mosaic about the house, what it should be, and the share that no frame sees."""
    ground = house()
    camera = replace(CAMERA, width_px=300, height_px=220, focal_length_px=170.0, principal_col_px=151.0)
    camera = replace(camera, principal_row_px=109.0)
    survey, poses, _ = make_survey(folder, ground=ground, lines=2, per_line=3, camera=camera)
    n = len(poses)
    frames = PosedFrames(survey, poses, [camera] * n, [True] * n, ground)
    views = frame_views(frames, survey.map_crs)
    grid = output_grid(MapPixels(survey.map_crs, GSD_M), views, [f.name for f in survey.frames])
    scene, hidden, share = Scene(survey.work_frame, ground, grid, views), (), 0.0
    if shade:
        hidden, unseen = occluded_parts(
            grid, 2, [occlusion_depth(scene, side_px_of(scene), v) for v in views]
        )
        share = unseen.share
        scene = replace(scene, views=with_occlusion(views, hidden))
    ownership = replace(nearest_nadir(scene, [True] * n, 8)[0], hidden=hidden)
    target = folder / "mosaic.tif"
    compose(frames, ownership, MosaicFiles(target))
    with rasterio.open(target) as tiff:
        found, valid = np.moveaxis(tiff.read(), 0, -1).astype(float), tiff.dataset_mask() > 0
    col, row = np.meshgrid(np.arange(grid.width_px) + 0.5, np.arange(grid.height_px) + 0.5)
    true = truth(grid.west_m + col * GSD_M, grid.north_m - row * GSD_M)
    return np.abs(found - true).mean(axis=-1), valid, share


@pytest.mark.proof
def test_frames_give_no_ground_that_a_house_hides_from_them(tmp_path: Path) -> None:
    """Every frame is what the ground's image is where its rays first meet the ground. A place that a frame
    sees is true, one that it doesn't shows the roof's or the wall's image."""
    without, valid, _ = composed(tmp_path / "without", shade=False)
    with_it, also, unseen = composed(tmp_path / "with", shade=True)
    assert np.array_equal(valid, also), "no holes where frames are cut"
    inner = cv2.erode(valid.astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
    wrong = [np.count_nonzero((off > 6.0) & inner) * GSD_M**2 for off in (without, with_it)]
    assert unseen < 0.002
    assert wrong[0] > 10.0 and wrong[1] < 0.5, wrong
