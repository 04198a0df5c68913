"""Tiles of an earlier mosaic stay where nothing moved by more than the bound, compared with what made them."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from mosaic_scenes import CRS, make_survey
from numpy.typing import NDArray

from geomosaic.composition.compose import CompositionOptions, TileKeeping, compose
from geomosaic.composition.composed_tiles import MOST_MOVED_PX, ComposedTiles, EarlierMosaic
from geomosaic.composition.grid import output_grid
from geomosaic.composition.model import MapPixels
from geomosaic.composition.ownership import Ownership, by_nearest_nadir
from geomosaic.composition.raster import MosaicFiles
from geomosaic.composition.spread import InProcessSpooler, SpooledResult, Spooler
from geomosaic.composition.tiles import TILE_PX
from geomosaic.composition.tones import Tones
from geomosaic.composition.views import PosedFrames, frame_views
from geomosaic.doors.at_hand import Copies, reading_copies
from geomosaic.pipeline.artefact_reader import decode
from geomosaic.pipeline.artefacts import encode

GSD_M = 0.06
Made = tuple[EarlierMosaic, int]


class Scene:
    """Frames, and mosaics of them."""

    def __init__(self, folder: Path) -> None:
        survey, poses, ground = make_survey(folder / "frames", lines=2, per_line=3)
        self.folder = folder
        self.frames = PosedFrames(survey, poses, survey.cameras * 6, [True] * 6, ground)
        self.names = [frame.name for frame in survey.frames]
        views = frame_views(self.frames, CRS)
        self.ownership = by_nearest_nadir(self.frames, output_grid(MapPixels(CRS, GSD_M), views, self.names))

    def moved(self, frame: int, east_m: float) -> PosedFrames:
        """One frame further east."""
        positions_m = self.frames.poses.positions_m.copy()
        positions_m[frame, 0] += east_m
        return replace(self.frames, poses=replace(self.frames.poses, positions_m=positions_m))

    def made(
        self,
        name: str,
        frames: PosedFrames,
        earlier: EarlierMosaic | None = None,
        *,
        ownership: Ownership | None = None,
        tones: Tones | None = None,
        names: Sequence[str] = (),
        spread: Spooler | None = None,
    ) -> Made:
        """A mosaic, and how many of its tiles were kept."""
        files = MosaicFiles(self.folder / f"{name}.tif", self.folder / f"{name}-sources.tif")
        noted: list[tuple[ComposedTiles, int]] = []
        keeping = TileKeeping(
            tuple(names or self.names), earlier, lambda tiles, kept: noted.append((tiles, kept))
        )
        how = CompositionOptions("multi_band", tones=tones, keeping=keeping)
        compose(frames, ownership or self.ownership, files, how, spread)
        assert files.sources is not None
        ((tiles, kept),) = noted
        tiles = decode(encode(tiles), ComposedTiles)
        return EarlierMosaic(files.raster, files.sources, tiles), kept


class WithoutDisk(InProcessSpooler):
    """Whose workers see no file of the run, and have been sent none."""

    def __init__(self, folder: Path) -> None:
        super().__init__()
        self._copies = Copies(folder, folder / "copies")

    @contextmanager
    def spooled(
        self, name: str, function: Callable[[Any], Any], items: Iterable[Any], keys: Sequence[Any]
    ) -> Iterator[Sequence[SpooledResult[Any]]]:
        def there(item: Any) -> Any:
            with reading_copies(self._copies):
                return function(item)

        with super().spooled(name, there, items, keys) as made:
            yield made


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return Scene(tmp_path_factory.mktemp("tiles"))


@pytest.fixture(scope="module")
def first(scene: Scene) -> EarlierMosaic:
    made, kept = scene.made("first", scene.frames)
    assert kept == 0
    return made


def pixels(made: EarlierMosaic) -> NDArray[np.uint8]:
    with rasterio.open(made.raster) as raster:
        return np.concatenate([raster.read(), raster.dataset_mask()[None]])


def digest(path: Path) -> str:
    return hashlib.blake2b(path.read_bytes()).hexdigest()


def sources(made: EarlierMosaic) -> NDArray[np.uint8]:
    with rasterio.open(made.sources) as raster:
        read: NDArray[np.uint8] = raster.read(1)
        return read


def test_nothing_changed(scene: Scene, first: EarlierMosaic) -> None:
    """All tiles are kept, and the files have the same bytes."""
    again, kept = scene.made("again", scene.frames, first)
    assert kept == len(first.tiles.places) > 6
    assert (pixels(again) == pixels(first)).all()
    assert (sources(again) == sources(first)).all()
    assert digest(again.raster) == digest(first.raster)
    assert digest(again.sources) == digest(first.sources)


def test_workers_without_a_shared_disk_get_the_tiles_alone(scene: Scene, first: EarlierMosaic) -> None:
    """Not the files of the earlier mosaic, which may be too large to be sent."""
    far, kept = scene.made("far", scene.frames, first, spread=WithoutDisk(scene.folder))
    assert kept == len(first.tiles.places)
    assert digest(far.raster) == digest(first.raster) and digest(far.sources) == digest(first.sources)


def test_frames_that_only_touch_a_tile(scene: Scene) -> None:
    """Of sixteen places of the tile none lies within such a frame's lens, which ends at its corners; it is
    kept all the same, unless the frame moved."""
    cameras = [replace(camera, k1=-0.3) for camera in scene.frames.cameras]
    frames = replace(scene.frames, cameras=cameras)
    made, _ = scene.made("bent", frames)
    assert np.isfinite(made.tiles.image_px).all()
    _, kept = scene.made("bent-again", frames, made)
    assert kept == len(made.tiles.places)
    moved = replace(scene.moved(0, 10.0 * GSD_M), cameras=cameras)
    part, kept = scene.made("bent-part", moved, made)
    whole, _ = scene.made("bent-whole", moved)
    assert 0 < kept < len(made.tiles.places)
    assert (pixels(part) == pixels(whole)).all()


def test_one_frame_moved(scene: Scene, first: EarlierMosaic) -> None:
    """Tiles that it is part of are composed anew, others kept: as the whole mosaic is."""
    moved = scene.moved(0, 10.0 * GSD_M)
    part, kept = scene.made("part", moved, first)
    whole, _ = scene.made("whole", moved)
    assert 0 < kept < len(first.tiles.places)
    assert (pixels(part) == pixels(whole)).all()
    assert (sources(part) == sources(whole)).all()


def test_errors_do_not_add_up(scene: Scene, first: EarlierMosaic) -> None:
    """Steps below the bound: tiles are compared with what made them, not with the last run."""
    step_m = 0.6 * MOST_MOVED_PX * GSD_M
    once, kept = scene.made("once", scene.moved(0, step_m), first)
    assert kept == len(first.tiles.places)
    assert np.array_equal(once.tiles.image_px, first.tiles.image_px, equal_nan=True)
    _, kept = scene.made("twice", scene.moved(0, 2.0 * step_m), once)
    assert 0 < kept < len(first.tiles.places)


def test_brightness(scene: Scene, first: EarlierMosaic) -> None:
    """Half a grey level of 256 at the brightest."""
    for gain, less in ((0.0019, False), (0.0021, True)):
        tones = Tones(np.zeros((6, 3)), np.zeros((6, 3, 2)), np.zeros((6, 3, 2)))
        tones.gain[0] = gain
        _, kept = scene.made("bright", scene.frames, first, tones=tones)
        assert (kept < len(first.tiles.places)) == less


def test_another_owner_or_content(scene: Scene, first: EarlierMosaic) -> None:
    """Seams that moved, and a frame that was replaced."""
    owner = scene.ownership.owner.copy()
    owner[:3, :3] = np.where(owner[:3, :3] == 1, 2, owner[:3, :3])
    owner[owner.shape[0] // 2, owner.shape[1] // 2] = 1
    _, kept = scene.made("owner", scene.frames, first, ownership=replace(scene.ownership, owner=owner))
    assert 0 < kept < len(first.tiles.places)
    _, kept = scene.made("content", scene.frames, first, names=["replaced", *scene.names[1:]])
    assert 0 < kept < len(first.tiles.places)


def test_frames_in_another_order_and_a_larger_grid(scene: Scene, first: EarlierMosaic) -> None:
    """A grid with a row of tiles more, and frames that are counted otherwise."""
    order = [3, 4, 5, 0, 1, 2]
    survey = replace(scene.frames.survey, frames=tuple(scene.frames.survey.frames[i] for i in order))
    frames = replace(scene.frames, survey=survey, poses=scene.frames.poses.of(np.array(order)))
    grid = scene.ownership.grid
    larger = replace(grid, north_m=grid.north_m + TILE_PX * GSD_M, height_px=grid.height_px + TILE_PX)
    rows = TILE_PX // scene.ownership.cell_px
    number = np.argsort([0, *(1 + i for i in order)])
    owner = np.pad(number[scene.ownership.owner], ((rows, 0), (0, 0))).astype(np.int32)
    ownership = replace(scene.ownership, grid=larger, owner=owner)
    made, kept = scene.made(
        "larger", frames, first, ownership=ownership, names=[scene.names[i] for i in order]
    )
    whole, _ = scene.made("larger-whole", frames, ownership=ownership, names=[scene.names[i] for i in order])
    assert kept > len(first.tiles.places) // 2
    off = np.abs(pixels(made).astype(int) - pixels(whole))
    assert off.max() <= 1, "sums of the same numbers in another order"
    assert (sources(made) == sources(whole)).all()


def test_the_grid_keeps_the_tiles_of_an_earlier_one(scene: Scene) -> None:
    """The smallest that holds all, whole tiles from the earlier corner, in both directions."""
    views = frame_views(scene.frames, CRS)
    plain = output_grid(MapPixels(CRS, GSD_M), views, scene.names)
    for east_px, north_px in ((700, -300), (-3, 5)):
        earlier = replace(
            plain, west_m=plain.west_m + east_px * GSD_M, north_m=plain.north_m + north_px * GSD_M
        )
        grid = output_grid(MapPixels(CRS, GSD_M, earlier=earlier), views, scene.names)
        for off in (grid.west_m - earlier.west_m, grid.north_m - earlier.north_m):
            assert (off / GSD_M) % TILE_PX == pytest.approx(0.0, abs=1e-3) or (
                off / GSD_M
            ) % TILE_PX == pytest.approx(TILE_PX, abs=1e-3)
        assert 0.0 <= round((plain.west_m - grid.west_m) / GSD_M) < TILE_PX
        assert 0.0 <= round((grid.north_m - plain.north_m) / GSD_M) < TILE_PX
        east, south = (
            round((grid.west_m - plain.west_m) / GSD_M) + grid.width_px,
            round((plain.north_m - grid.north_m) / GSD_M) + grid.height_px,
        )
        assert (east, south) == (plain.width_px, plain.height_px)
