"""What windows ask of frames: enough for every blend, and little more."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pytest
import rasterio
from mosaic_scenes import CAMERA, hills, make_survey

from geomosaic.camera.exterior import Poses
from geomosaic.camera.interior import Camera
from geomosaic.camera.rotation import Rotation
from geomosaic.composition.blends import BLENDS
from geomosaic.composition.cells import MosaicCells
from geomosaic.composition.compose import compose
from geomosaic.composition.frame_part import TILE_PX, Asked, FramePart, Patch, Warping, frame_part
from geomosaic.composition.frame_source import FrameSource
from geomosaic.composition.grid import output_grid
from geomosaic.composition.model import MapPixels, OutputGrid
from geomosaic.composition.ownership import Ownership, by_nearest_nadir, nearest_nadir, owned_cells
from geomosaic.composition.plan import Planned, Planning, windows
from geomosaic.composition.raster import MosaicFiles
from geomosaic.composition.scene import CELL_PX, Scene, ground_of, margin_px
from geomosaic.composition.views import FrameView, PosedFrames, frame_views
from geomosaic.composition.visibility import FrameOnMap, VisibleCells, cells_in_view
from geomosaic.composition.window import CompositionStep, Manner, SourcePart, Window, compose_window
from geomosaic.geodesy.local import LocalFrame
from geomosaic.projection.ground import GroundSurface, RaisedObject
from geomosaic.projection.warp import frame_from_map
from geomosaic.survey.model import Survey

GSD_M, REACH_PX, OWNER_CELL_PX = 0.06, 60.0, 8


def exactly(whole: FramePart, planned: Planned, asked: np.ndarray) -> FramePart:
    """Nothing but the cells that are asked for."""
    patches = []
    for row, col in np.argwhere(asked).tolist():
        around = planned.step.around
        at = Window(around.col + col * CELL_PX, around.row + row * CELL_PX, CELL_PX, CELL_PX)
        shown = whole.shown(at)
        patches.append(Patch(at.row, at.col, shown.pixels, shown.margin_px))
    return FramePart(tuple(patches))


@pytest.mark.parametrize("blend", ["multi_band", pytest.param("feather", marks=pytest.mark.proof), "hard"])
def test_a_window_of_the_asked_cells_alone_is_that_of_all_frames_whole(tmp_path: Path, blend: str) -> None:
    """Frames of several brightnesses, so that a pixel whose neighbours are missing shows it."""
    survey, poses, ground = make_survey(tmp_path, gains=(0.5, 0.9, 0.7, 0.95, 0.6, 0.8))
    used = [True] * len(poses)
    views = frame_views(PosedFrames(survey, poses, [CAMERA] * len(poses), used, ground), survey.map_crs)
    grid = output_grid(MapPixels(survey.map_crs, GSD_M), views, [f.name for f in survey.frames])
    scene = Scene(survey.work_frame, ground, grid, views)
    ownership = nearest_nadir(scene, used, OWNER_CELL_PX)[0]
    halo_px = BLENDS[blend].halo_px(REACH_PX)
    sources = {v.frame: FrameSource(grid, ownership, v) for v in views}
    seen = {v.frame: cells_in_view(scene, v, halo_px) for v in views}
    warping = Warping(scene, "cubic", None, "uint8", REACH_PX / 2.0)
    whole = {
        v.frame: frame_part(warping, Asked(FrameOnMap(survey.frames[v.frame], v), seen[v.frame].cells))
        for v in views
    }
    planning = Planning(ownership, sources, seen, halo_px, REACH_PX)
    manner = Manner(BLENDS[blend], 3, "uint8")
    mixed = 0
    for planned in planning.steps(windows(grid, 256)):
        step = planned.step
        window = step.window
        mixed += len(step.parts) > 1
        numbers = [part.source.number for part in step.parts]
        gives = {n: exactly(whole[n], planned, of) for n, of in zip(numbers, planned.asked, strict=True)}
        found = compose_window(manner, step, gives)
        around = window.grown(halo_px)
        every = slice(0, around.height), slice(0, around.width)
        parts = tuple(SourcePart(source, *every) for source in sources.values())
        of_all = compose_window(manner, CompositionStep(window, around, REACH_PX, parts), whole)
        np.testing.assert_array_equal(found.source(), of_all.source())
        off = np.abs(found.pixels.astype(int) - of_all.pixels)
        assert off.max() <= 1 and np.count_nonzero(off) < 1e-5 * off.size, "halves, in another order of sums"
        alone = next(planning.steps([window]))
        assert alone.step == step and np.array_equal(alone.asked, planned.asked), "whatever else is planned"
    assert mixed > 5


def test_boxes_hold_all_cells_once_and_leave_out_most_others() -> None:
    """A ring about nothing, its corners beyond the grid, and a cell by itself."""
    down, across = np.mgrid[-40:60, -20:90]
    away = np.hypot(down - 8, across - 30)
    flags = (away < 44) & (away > 36)
    flags[95, 105] = True
    cells = MosaicCells(-40, -20, flags)
    found = np.zeros(flags.shape, dtype=int)
    boxes = list(cells.boxes(TILE_PX))
    for box in boxes:
        assert box.row // TILE_PX == (box.row + box.height - 1) // TILE_PX
        assert box.col // TILE_PX == (box.col + box.width - 1) // TILE_PX
        row, col = box.row // CELL_PX + 40, box.col // CELL_PX + 20
        found[row : row + box.height // CELL_PX, col : col + box.width // CELL_PX] += 1
    assert found.max() == 1 and found[flags].all()
    tiles = itertools.product(range(0, 100, 32), range(0, 110, 32))
    one_a_tile = 0
    for top, left in tiles:
        some = np.argwhere(flags[max(top - 24, 0) : top + 8, max(left - 12, 0) : left + 20])
        one_a_tile += int(np.prod(np.ptp(some, axis=0) + 1)) if len(some) else 0
    assert flags.sum() < found.sum() < 0.75 * one_a_tile
    assert len(boxes) < 30 and not list(MosaicCells(0, 0, np.zeros((3, 3), dtype=bool)).boxes(TILE_PX))


@pytest.mark.parametrize("cell_px", [8, 16, 64])
def test_the_owners_of_a_window_are_those_of_its_cells_and_of_adjacent_ones(cell_px: int) -> None:
    """Owners at random, in cells finer and coarser than those by which is planned, at an edge and inside."""
    rng = np.random.default_rng(5)
    grid = OutputGrid("EPSG:32632", 0.0, 0.0, 1.0, 40 * cell_px, 40 * cell_px)
    owner = (rng.integers(0, 4, (40, 40)) * (rng.random((40, 40)) < 0.2)).astype(np.int32)
    ownership = Ownership(grid, np.ones(3, dtype=bool), cell_px, owner)
    for window in (Window(-64, -32, 256, 192), Window(5 * cell_px // 16 * 16, 128, 128, 128)):
        numbers, owned = owned_cells(ownership, window)
        found = dict(zip(numbers, owned, strict=True))
        for frame in range(3):
            for i, j in np.ndindex(window.height // CELL_PX, window.width // CELL_PX):
                top, left = window.row + i * CELL_PX, window.col + j * CELL_PX
                rows = np.arange(top // cell_px - 1, (top + CELL_PX - 1) // cell_px + 2).clip(0, 39)
                cols = np.arange(left // cell_px - 1, (left + CELL_PX - 1) // cell_px + 2).clip(0, 39)
                adjacent = bool((owner[np.ix_(rows, cols)] == frame + 1).any())
                assert adjacent == (frame in found and bool(found[frame][i, j])), (window, frame, i, j)


def test_where_no_owner_sees_the_ground_the_nearer_nadir_point_gives_it() -> None:
    """Less than any share of an owner's: of two frames below which pixels 10 and 50 lie, up to 30 the first."""
    grid = OutputGrid("EPSG:32632", 5e5, 5e6, 1.0, 64, 8)
    nobody = Ownership(grid, np.ones(2, dtype=bool), OWNER_CELL_PX, np.zeros((1, 8), np.int32))
    window, every = Window(0, 0, 64, 8), (slice(0, 8), slice(0, 64))
    share = [
        FrameSource(
            grid, nobody, FrameView(i, None, CAMERA, np.array([5e5 + at, 5e6 - 4.0]), None, 1.0)
        ).share(window, *every)
        for i, at in enumerate((10.0, 50.0))
    ]
    assert np.array_equal(share[0] > share[1], np.broadcast_to(np.arange(64) < 30, (8, 64)))
    assert max(np.abs(s).max() for s in share) < 1e-4


@pytest.mark.parametrize("gsd_m", [4.0, 10.0, 20.0])
@pytest.mark.parametrize("relief", [False, True], ids=["flat", "hills"])
def test_frames_smaller_than_a_cell_give_all_pixels_that_they_see(
    tmp_path: Path, gsd_m: float, relief: bool
) -> None:
    """Frames of 60 m x 45 m on pixels like those of satellites: 15, 6 and 3 across."""
    survey, poses, ground = make_survey(tmp_path, ground=hills() if relief else None)
    frames = PosedFrames(survey, poses, [CAMERA] * len(poses), [True] * len(poses), ground)
    views = frame_views(frames, survey.map_crs)
    grid = output_grid(MapPixels(survey.map_crs, gsd_m), views, [f.name for f in survey.frames])
    compose(frames, by_nearest_nadir(frames, grid), MosaicFiles(tmp_path / "mosaic.tif"))
    with rasterio.open(tmp_path / "mosaic.tif") as file:
        valid = file.dataset_mask() > 0
    whole = Window(0, 0, grid.width_px, grid.height_px)
    places = ground_of(Scene(survey.work_frame, ground, grid, views), whole, 1)
    margins = [margin_px(*frame_from_map(places, poses[i], CAMERA), CAMERA, None) for i in range(len(poses))]
    margin = np.max(margins, axis=0)
    assert np.count_nonzero(margin > 0.1) >= 8
    assert valid[margin > 0.1].all() and not valid[margin < -0.1].any()


def seen_cells(ground: GroundSurface) -> tuple[VisibleCells, np.ndarray, np.ndarray]:
    """The cells of a tilted frame, and the least and the most margin of the pixels of each."""
    turned = Rotation.from_yaw_pitch_roll(0.6, 0.3, -0.2).matrix
    poses = Poses(np.array([[0.0, 0.0, 160.0]]), turned[None], np.zeros((1, 3)), np.zeros((1, 3)))
    camera = Camera("c", 1600, 1200, 1600.0, 790.0, 610.0)
    survey = Survey((), (camera,), LocalFrame(9.0, 48.0, 500.0), "EPSG:32632")
    views = frame_views(PosedFrames(survey, poses, [camera], [True], ground), "EPSG:32632")
    grid = output_grid(MapPixels("EPSG:32632", 0.1), views, ["c"])
    scene = Scene(survey.work_frame, ground, grid, views)
    seen = cells_in_view(scene, views[0])
    down, across = seen.somewhere.shape
    window = Window(seen.col * CELL_PX, seen.row * CELL_PX, across * CELL_PX, down * CELL_PX)
    margin = margin_px(*frame_from_map(ground_of(scene, window, 1), poses[0], camera), camera, None)
    cells = margin.reshape(down, CELL_PX, across, CELL_PX)
    return seen, cells.min(axis=(1, 3)), cells.max(axis=(1, 3))


@pytest.mark.parametrize("spacing_m", [12.0, 3.0])
def test_cells_are_known_whatever_the_ground_and_the_tilt(spacing_m: float) -> None:
    """On nodes farther apart than blocks of cells, which are looked at as one, and on nearer ones."""
    rng, n = np.random.default_rng(3), int(600.0 / spacing_m)
    ground = GroundSurface("tie_surface", -300.0, -300.0, spacing_m, rng.normal(0.0, 0.1 * spacing_m, (n, n)))
    seen, least, most = seen_cells(ground)
    assert most[~seen.somewhere].max() <= 0.0 and least[seen.everywhere].min() > 0.0
    assert most[seen.somewhere].min() > -3.0 * CELL_PX and least[~seen.everywhere].max() < 3.0 * CELL_PX
    assert seen.everywhere.sum() > 0.8 * (least > 0.0).sum()


@pytest.mark.parametrize("kind", ["flat", "tie_surface"])
def test_cells_of_raised_roofs_are_known(kind: str) -> None:
    """Roofs of 12 m x 12 m, 25 m high, every 30 m: near the frame's edge they lean out of it."""
    up_m = np.full((24, 24), 25.0, np.float32)
    at = [-90.0 + 30.0 * k for k in range(7)]
    roofs = tuple(RaisedObject(east, north, 0.5, up_m) for east in at for north in at)
    ground = GroundSurface(kind, -300.0, -300.0, 100.0, np.zeros((7, 7)), raised=roofs)
    seen, least, most = seen_cells(ground)
    assert most[~seen.somewhere].max() <= 0.0 and least[seen.everywhere].min() > 0.0
    assert seen.everywhere.sum() > 0.5 * (least > 0.0).sum()
