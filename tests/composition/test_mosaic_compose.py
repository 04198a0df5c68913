"""Composition against a known image of the ground: real files in, a real raster out."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
import threading
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import rasterio
from hypothesis import given
from hypothesis import strategies as st
from mosaic_scenes import CAMERA, CRS, GSD_M, hills, make_survey, paint, truth, truth_of, with_mask

from geomosaic.composition import blended, pyramid, raster, tiles
from geomosaic.composition import compose as compose_module
from geomosaic.composition.compose import CompositionOptions, compose
from geomosaic.composition.grid import auto_gsd_m, far_from_own, output_grid
from geomosaic.composition.model import MapPixels, OutputGrid
from geomosaic.composition.ownership import by_nearest_nadir
from geomosaic.composition.raster import MosaicFiles
from geomosaic.composition.spread import InProcessSpooler
from geomosaic.composition.views import PosedFrames, frame_views
from geomosaic.errors import CancelledError, FileError, InputError, UnknownNameError
from geomosaic.pipeline.context import Context
from geomosaic.pipeline.executor import Workers


def composed(folder: Path, survey, poses, ground, used=None, **options):
    used = used or [True] * len(poses)
    cameras = [survey.camera_of(i) for i in range(len(poses))]
    frames = PosedFrames(survey, poses, cameras, used, ground)
    views = frame_views(frames, CRS)
    grid = options.pop("grid", None) or output_grid(
        MapPixels(CRS, GSD_M), views, [f.name for f in survey.frames]
    )
    files = MosaicFiles(folder / "mosaic.tif", options.pop("sources_path", None))
    spread = options.pop("spread", None)
    how = CompositionOptions(**{"feather_m": 3.0, **options})
    mosaic = compose(frames, by_nearest_nadir(frames, grid), files, how, spread)
    with rasterio.open(files.raster) as tiff:
        return mosaic, np.moveaxis(tiff.read(), 0, -1), tiff.dataset_mask() > 0


def small_tiles(monkeypatch: pytest.MonkeyPatch, side_px: int) -> None:
    """Many windows of a small mosaic: each is a tile."""
    for module in (compose_module, blended, pyramid, raster, tiles):
        monkeypatch.setattr(module, "TILE_PX", side_px)


def truth_on(grid: OutputGrid, bands: int = 3, top: float = 255.0) -> np.ndarray:
    east = grid.west_m + (np.arange(grid.width_px) + 0.5) * grid.gsd_m
    north = grid.north_m - (np.arange(grid.height_px) + 0.5) * grid.gsd_m
    return truth(*np.meshgrid(east, north), bands, top)


@pytest.mark.parametrize("relief", [False, True], ids=["flat", "dem"])
def test_the_mosaic_is_the_ground(tmp_path, relief):
    survey, poses, ground = make_survey(tmp_path / "frames", ground=hills() if relief else None)
    mosaic, pixels, valid = composed(tmp_path, survey, poses, ground)
    error = (pixels - truth_on(mosaic.grid))[valid]
    assert 0.8 < valid.mean() < 0.95
    assert abs(error.mean()) < 0.02, "no bias from rounding or a half pixel"
    assert error.std() < 0.5, "little above the 0.41 of two roundings"
    assert np.abs(error).max() < 6.0
    assert mosaic.frames_used == (0, 1, 2, 3, 4, 5)
    assert (pixels[~valid] == 0).all()


def test_half_a_pixel_would_be_seen(tmp_path):
    survey, poses, ground = make_survey(tmp_path / "frames")
    mosaic, pixels, valid = composed(tmp_path, survey, poses, ground)
    shifted = replace(mosaic.grid, west_m=mosaic.grid.west_m + 0.5 * GSD_M)
    assert (pixels - truth_on(shifted))[valid].std() > 1.0


def test_sixteen_bits_and_five_bands(tmp_path):
    survey, poses, ground = make_survey(tmp_path / "frames", bands=5, dtype="uint16", per_line=2)
    mosaic, pixels, valid = composed(tmp_path, survey, poses, ground)
    assert (mosaic.bands, mosaic.dtype, pixels.dtype) == (5, "uint16", np.uint16)
    error = (pixels - truth_on(mosaic.grid, 5, 65535.0))[valid]
    assert error.std() < 60.0
    assert pixels.max() > 60000


def test_jpeg_frames_in_colour_keep_their_order_of_bands(tmp_path):
    survey, poses, ground = make_survey(tmp_path / "frames", suffix=".jpg", lines=1, per_line=2)
    mosaic, pixels, valid = composed(tmp_path, survey, poses, ground)
    assert (pixels - truth_on(mosaic.grid))[valid].std() < 1.5


def test_threads_and_memory_change_no_byte(tmp_path, monkeypatch):
    small_tiles(monkeypatch, 128)
    gains = [1.0, 0.8, 0.9, 0.7, 1.0, 0.85]
    survey, poses, ground = make_survey(tmp_path / "frames", suffix=".jpg", gains=gains)
    runs = {}
    for name, options in {
        "one": {"threads": 1},
        "two": {"threads": 2},
    }.items():
        (tmp_path / name).mkdir()
        sources = tmp_path / name / "sources.tif"
        composed(tmp_path / name, survey, poses, ground, sources_path=sources, **options)
        runs[name] = ((tmp_path / name / "mosaic.tif").read_bytes(), sources.read_bytes())
    assert runs["one"] == runs["two"]


@pytest.mark.proof
def test_a_composition_that_was_stopped_brings_no_frame_onto_the_grid_twice(tmp_path, monkeypatch):
    """By two processes, by one, and by threads alone the mosaic is the same to the byte."""
    survey, poses, ground = make_survey(tmp_path / "frames", suffix=".jpg")
    (tmp_path / "plain").mkdir()
    composed(tmp_path / "plain", survey, poses, ground)

    class Stopped(Context):
        def progress(self, done: int, total: int, text: str = "") -> None:
            if text == "writing":
                raise CancelledError

    with Workers(2) as team:
        context = Stopped(tmp_path / "run", stage_id="mosaic.compose", key="one", workers=team)
        with pytest.raises(CancelledError):
            composed(tmp_path, survey, poses, ground, spread=context)
    for frame in survey.frames:
        Path(frame.path).write_bytes(b"gone")
    context = Context(tmp_path / "run", stage_id="mosaic.compose", key="one")
    composed(tmp_path, survey, poses, ground, spread=context)
    assert (tmp_path / "mosaic.tif").read_bytes() == (tmp_path / "plain" / "mosaic.tif").read_bytes()


def test_windows_leave_no_trace(tmp_path, monkeypatch):
    survey, poses, ground = make_survey(tmp_path / "frames", gains=[1.0, 0.8, 0.9, 0.7, 1.0, 0.85])
    _, whole, valid = composed(tmp_path, survey, poses, ground)
    small_tiles(monkeypatch, 64)
    _, tiled, tiled_valid = composed(tmp_path, survey, poses, ground)
    assert (valid == tiled_valid).mean() > 0.9999
    differ = np.abs(whole.astype(int) - tiled)
    assert differ.max() <= 1 or (differ > 1).sum() <= 3
    assert (differ > 0).mean() < 0.01


def test_weights_make_no_step_where_a_bright_frame_ends(tmp_path):
    """Two frames of different brightness: the blend goes over in the feather and never jumps."""
    survey, poses, ground = make_survey(tmp_path / "frames", lines=1, per_line=2)
    for frame, level in zip(survey.frames, (80, 160), strict=True):
        paint(frame, np.full((180, 240, 3), level))
    _, pixels, valid = composed(tmp_path, survey, poses, ground, blend="feather", feather_m=10.0)
    values = pixels[..., 0].astype(int)
    assert set(np.unique(values[valid])) >= {80, 160, 120}
    inner = cv2.erode(valid.astype(np.uint8), np.ones((81, 81))) > 0  # where both frames end is no blend
    steps = np.abs(np.diff(values, axis=0))[inner[1:]]
    assert 2 <= steps.max() <= 8, "80 levels over 40 px, a little steeper where the edges' ramps join in"


def test_a_hard_seam_has_no_mixed_pixel(tmp_path):
    survey, poses, ground = make_survey(tmp_path / "frames", lines=1, per_line=2)
    for frame, level in zip(survey.frames, (80, 160), strict=True):
        paint(frame, np.full((180, 240, 3), level))
    sources = tmp_path / "sources.tif"
    _, pixels, valid = composed(tmp_path, survey, poses, ground, blend="hard", sources_path=sources)
    assert set(np.unique(pixels[valid])) == {80, 160}
    with rasterio.open(sources) as tiff:
        index = tiff.read(1)
        assert tiff.tags()["FRAME_2"] == "frame 01.tif"
        assert tiff.dtypes == ("uint8",)
    np.testing.assert_array_equal(index, np.where(valid, pixels[..., 0] // 80, 0))


def test_invalid_pixels_are_left_to_the_neighbours(tmp_path):
    """A black hole painted into one frame and masked: the mosaic shows the ground there, from others."""
    survey, poses, ground = make_survey(tmp_path / "frames")
    mask = np.full((180, 240), 255, dtype=np.uint8)
    mask[60:130, 80:170] = 0
    image = truth_of(survey, ground, poses, 1, 3, 255.0)
    image[mask == 0] = 0.0
    paint(survey.frames[1], np.rint(image))
    survey = with_mask(survey, 1, mask)
    mosaic, pixels, valid = composed(tmp_path, survey, poses, ground)
    error = (pixels - truth_on(mosaic.grid))[valid]
    assert error.std() < 0.5
    assert np.abs(error).max() < 6.0


def test_where_all_is_masked_there_is_no_mosaic(tmp_path):
    survey, poses, ground = make_survey(tmp_path / "frames", lines=1, per_line=1)
    mask = np.full((180, 240), 255, dtype=np.uint8)
    mask[:, :120] = 0
    mosaic, pixels, valid = composed(tmp_path, with_mask(survey, 0, mask), poses, ground)
    assert valid.mean() < 0.5
    assert np.abs((pixels - truth_on(mosaic.grid))[valid]).max() < 6.0


def test_holes_are_counted_and_listed(tmp_path):
    """A frame alone, with a hole of 70 x 50 px masked and one that is open to the outside."""
    survey, poses, ground = make_survey(tmp_path / "frames", lines=1, per_line=1)
    mask = np.full((180, 240), 255, dtype=np.uint8)
    mask[60:110, 80:150] = 0
    mask[150:, 200:] = 0
    mosaic, _, valid = composed(tmp_path, with_mask(survey, 0, mask), poses, ground)
    assert (mosaic.holes.number, len(mosaic.holes.largest)) == (1, 1)
    hole = mosaic.holes.largest[0]
    views = frame_views(PosedFrames(survey, poses, [CAMERA], [True], ground), CRS)
    assert hole.area_m2 == mosaic.holes.area_m2 == pytest.approx(75 * 55 * views[0].gsd_m ** 2, rel=0.1)
    grid = mosaic.grid
    col, row = (hole.easting_m - grid.west_m) / GSD_M, (grid.north_m - hole.northing_m) / GSD_M
    assert not valid[int(row) - 8 : int(row) + 8, int(col) - 8 : int(col) + 8].any()


def test_rejected_frames_are_left_out(tmp_path):
    survey, poses, ground = make_survey(tmp_path / "frames")
    used = [True, True, False, True, True, True]
    mosaic, _, _ = composed(tmp_path, survey, poses, ground, used)
    assert mosaic.frames_used == (0, 1, 3, 4, 5)
    assert {s.frame for s in mosaic.seamlines} == {0, 1, 3, 4, 5}


def test_seamlines_tile_the_mosaic(tmp_path):
    import shapely

    survey, poses, ground = make_survey(tmp_path / "frames")
    mosaic, _, valid = composed(tmp_path, survey, poses, ground)
    polygons = [shapely.Polygon(p[0], p[1:]) for s in mosaic.seamlines for p in s.polygons]
    covered = valid.sum() * GSD_M**2
    assert shapely.unary_union(polygons).area == pytest.approx(covered, rel=0.01)
    assert sum(p.area for p in polygons) == pytest.approx(shapely.unary_union(polygons).area, rel=1e-9)
    for seamline in mosaic.seamlines:
        east, north = mosaic_nadir(survey, poses, seamline.frame)
        own = shapely.unary_union([shapely.Polygon(p[0], p[1:]) for p in seamline.polygons])
        assert own.contains(shapely.Point(east, north)), "each frame has the ground below itself"


def mosaic_nadir(survey, poses, i):
    from geomosaic.geodesy.mapcrs import MapProjection

    lon, lat, _ = survey.work_frame.geodetic_from_enu(poses.positions_m[i])
    return MapProjection(CRS).map_from_geodetic(lon, lat)


@pytest.mark.parametrize("resampling, worst", [("bilinear", 1.2), ("cubic", 0.5), ("lanczos", 0.5)])
def test_resampling_choices(tmp_path, resampling, worst):
    survey, poses, ground = make_survey(tmp_path / "frames", lines=1, per_line=2)
    mosaic, pixels, valid = composed(tmp_path, survey, poses, ground, resampling=resampling)
    assert 0.3 < (pixels - truth_on(mosaic.grid))[valid].std() < worst


def test_progress_runs_to_its_end_and_cancel_stops(tmp_path, monkeypatch):
    small_tiles(monkeypatch, 64)
    survey, poses, ground = make_survey(tmp_path / "frames", lines=1, per_line=2)
    seen: list[tuple[int, int]] = []

    class Counting(InProcessSpooler):
        def progress(self, done: int, total: int, text: str = "") -> None:
            seen.append((done, total))

    composed(tmp_path, survey, poses, ground, spread=Counting())
    assert [d for d, _ in seen] == list(range(1, seen[-1][1] + 1))

    before = set(threading.enumerate())

    class Stopped(InProcessSpooler):
        def check_cancelled(self) -> None:
            if set(threading.enumerate()) - before:
                raise CancelledError

    with pytest.raises(CancelledError):
        composed(tmp_path, survey, poses, ground, spread=Stopped())
    assert not set(threading.enumerate()) - before


def test_wrong_input_is_named(tmp_path):
    survey, poses, ground = make_survey(tmp_path / "frames", lines=1, per_line=2)
    with pytest.raises(UnknownNameError, match="did you mean 'multi_band'"):
        composed(tmp_path, survey, poses, ground, blend="multiband")
    with pytest.raises(UnknownNameError, match="resampling"):
        composed(tmp_path, survey, poses, ground, resampling="quintic")
    mixed = replace(survey, frames=(survey.frames[0], replace(survey.frames[1], bands=1)))
    with pytest.raises(InputError, match=r"frame 01.tif: has 1 bands of uint8, frame 00.tif 3"):
        composed(tmp_path, mixed, poses, ground)
    Path(survey.frames[1].path).write_bytes(b"gone")
    with pytest.raises(FileError, match="frame 01"):
        composed(tmp_path, survey, poses, ground)
    grid = OutputGrid(CRS, 0.0, 0.0, 1.0, 10, 10)
    with pytest.raises(InputError, match="no frame can be used"):
        composed(tmp_path, survey, poses, ground, used=[False, False], grid=grid)


def test_a_feather_wider_than_tiles_is_refused(tmp_path):
    survey, poses, ground = make_survey(tmp_path / "frames", lines=1, per_line=2)
    with pytest.raises(InputError, match=r"of 1000.0 m is 4,000 pixels of 0.25 m wide, 2,048 at most"):
        composed(tmp_path, survey, poses, ground, blend="feather", feather_m=1000.0)


def test_a_wild_position_is_named_before_anything_is_written(tmp_path):
    survey, poses, ground = make_survey(tmp_path / "frames")
    wild = replace(poses, positions_m=poses.positions_m + np.eye(6, 3, k=-4) * [40_000.0, 0.0, 0.0])
    assert wild.positions_m[4, 0] > 30_000
    views = frame_views(PosedFrames(survey, wild, [CAMERA] * 6, [True] * 6, ground), CRS)
    with pytest.raises(
        InputError, match=r"40\.\d x \d\.\d km, .* without frame frame 04.tif: it reaches 40\.0 km"
    ):
        output_grid(MapPixels(CRS, GSD_M), views, [f.name for f in survey.frames])
    sane = frame_views(PosedFrames(survey, poses, [CAMERA] * 6, [True] * 6, ground), CRS)
    with pytest.raises(InputError, match="too fine"):
        output_grid(MapPixels(CRS, 0.001), sane, [f.name for f in survey.frames])


@pytest.mark.parametrize(
    "own_m, gsd_m",
    [(0.0995, 0.1), (0.1004, 0.1), (0.0169423, 0.017), (12.3456, 12.0), (0.9996, 1.0), (0.105, 0.1),
     (0.106, 0.11), (0.019, 0.019), (0.0191, 0.02), (0.0483, 0.05), (0.147, 0.15), (0.0347, 0.035)],
)  # fmt: skip
def test_the_automatic_ground_pixel_is_round(own_m: float, gsd_m: float) -> None:
    assert auto_gsd_m(own_m) == gsd_m


@given(st.floats(1e-4, 1e4))
def test_rounding_the_ground_pixel_costs_no_more_than_five_percent(own_m: float) -> None:
    assert auto_gsd_m(own_m) == pytest.approx(own_m, rel=0.05)


def test_a_ground_pixel_far_from_the_frames_own_is_reported() -> None:
    assert "can't show more" in far_from_own(0.049, 0.1) and "is lost" in far_from_own(0.41, 0.1)
    assert far_from_own(0.051, 0.1) == far_from_own(0.39, 0.1) == ""


def test_grids_begin_at_whole_cells(tmp_path):
    """16 ground pixels, the step of blends, or a cell of seams where that is larger: 32 for frames of 9600
    pixels. So grids of more or fewer frames have their cells at the same places."""
    survey, poses, ground = make_survey(tmp_path / "frames", lines=1, per_line=1)
    views = frame_views(PosedFrames(survey, poses, [CAMERA], [True], ground), CRS)
    west, south, east, north = views[0].bounds_m
    large = [replace(views[0], camera=replace(CAMERA, width_px=9600))]
    gsd_m = 0.2
    for seen, step_m in ((views, 3.2), (large, 6.4)):
        grid = output_grid(MapPixels(CRS, gsd_m), seen, ["a"])
        assert grid.west_m / step_m == pytest.approx(round(grid.west_m / step_m), abs=1e-6)
        assert grid.north_m / step_m == pytest.approx(round(grid.north_m / step_m), abs=1e-6)
        assert 0.0 <= west - grid.west_m < step_m
        assert 0.0 <= grid.north_m - north < step_m
        assert 0.0 <= grid.east_m - east < gsd_m
        assert 0.0 <= south - grid.south_m < gsd_m


@pytest.mark.proof
def test_memory_does_not_grow_with_the_mosaic(tmp_path):
    """Three times the frames and pixels: only the seam labels grow, and they stop at 16 MB."""
    import tracemalloc

    peaks = []
    for per_line in (5, 15):
        survey, poses, ground = make_survey(tmp_path / f"frames{per_line}", lines=1, per_line=per_line)
        tracemalloc.start()
        composed_only(tmp_path, survey, poses, ground)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.5 * peaks[0]


def composed_only(folder: Path, survey, poses, ground) -> None:
    cameras, used = [CAMERA] * len(poses), [True] * len(poses)
    frames = PosedFrames(survey, poses, cameras, used, ground)
    views = frame_views(frames, CRS)
    grid = output_grid(MapPixels(CRS, GSD_M / 4), views, [f.name for f in survey.frames])
    spread = Context(folder / "run", stage_id="mosaic.compose", key=str(len(poses)))
    compose(frames, by_nearest_nadir(frames, grid), MosaicFiles(folder / "m.tif"), spread=spread)


FULL_DISK = """
import resource, signal, sys
from pathlib import Path
from mosaic_scenes import make_survey
from test_mosaic_compose import composed
survey, poses, ground = make_survey(Path(sys.argv[1]) / "frames", lines=1, per_line=2)
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))
try:
    composed(Path(sys.argv[1]), survey, poses, ground)
except OSError as error:
    print("OSError", error.errno)
"""


def test_a_raster_that_can_not_grow_is_an_error(tmp_path):
    """As on a full disk: the system refuses further bytes."""
    run = subprocess.run(
        [sys.executable, "-c", FULL_DISK, str(tmp_path)],
        capture_output=True,
        text=True,
        timeout=60,
        cwd=Path(__file__).parent,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
    )
    assert run.stdout == f"OSError {errno.EFBIG}\n", run.stderr


def test_what_a_damaged_jpeg_lost_comes_from_its_neighbours(tmp_path: Path) -> None:
    """A third of its rows are whole, so that planning may not count on the rest."""
    survey, poses, ground = make_survey(tmp_path / "frames", suffix=".jpg", lines=1, per_line=6)
    cameras = [survey.camera_of(i) for i in range(6)]
    shown = []
    for whole_rows in (None, 60):
        frames = tuple(
            replace(f, whole_rows=whole_rows if i == 2 else None) for i, f in enumerate(survey.frames)
        )
        posed = PosedFrames(replace(survey, frames=frames), poses, cameras, [True] * 6, ground)
        views = frame_views(posed, CRS)
        grid = output_grid(MapPixels(CRS, 0.05), views, [f.name for f in frames])
        path = tmp_path / f"{whole_rows}.tif"
        mosaic = compose(posed, by_nearest_nadir(posed, grid), MosaicFiles(path))
        assert mosaic.holes.number == 0
        with rasterio.open(path) as raster:
            shown.append(int((raster.dataset_mask() > 0).sum()))
    assert shown[1] > 0.97 * shown[0]
