"""Changes between two maps: what was planted is found, and nothing else, whatever lies between both flights."""

from __future__ import annotations

import json
import tracemalloc
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest
import rasterio
import shapely
from pyogrio.raw import read
from rasterio.transform import Affine
from small_surveys import geomosaic

from geomosaic.errors import InputError
from geomosaic.export.changes import write_picture
from geomosaic.quality import changes as module
from geomosaic.quality.changes import (
    Change,
    Registration,
    SurfaceRasters,
    height_changes,
    image_changes,
    registration,
)
from geomosaic.quality.compare import compare
from geomosaic.quality.compared_block import ComparisonOptions
from geomosaic.quality.figures import best_similarity

SIDE, PIXEL_M, EAST, NORTH = 500, 0.1, 671_000.0, 5_330_000.0
PLACES = ((120, 150), (260, 330), (390, 110), (330, 410))
"""Row and col of the first pixel of each square of 10 px."""


def ground(seed: int) -> np.ndarray:
    """Texture of all sizes, with edges, (rows, cols) of 0 to 255."""
    rng = np.random.default_rng(seed)
    image = np.full((SIDE, SIDE), 110.0, np.float32)
    for size, contrast in ((4, 8.0), (10, 14.0), (40, 20.0)):
        few = rng.standard_normal((SIDE // size + 2, SIDE // size + 2)).astype(np.float32)
        image += contrast * cv2.resize(few, (SIDE, SIDE), interpolation=cv2.INTER_CUBIC)
    for _ in range(60):
        row, col, high, wide = (int(v) for v in rng.integers((0, 0, 8, 8), (SIDE, SIDE, 60, 60)))
        image[row : row + high, col : col + wide] += float(rng.uniform(-50.0, 50.0))
    return np.clip(image, 5.0, 250.0)


def run(folder: Path, grey: np.ndarray, shift_m: tuple[float, float] = (0.0, 0.0)) -> Path:
    """A run's folder with its mosaic. shift_m: by which its georeference is off."""
    folder.mkdir(parents=True)
    place = Affine(PIXEL_M, 0.0, EAST + shift_m[0], 0.0, -PIXEL_M, NORTH + shift_m[1])
    kind = {"width": SIDE, "height": SIDE, "count": 3, "dtype": "uint8", "crs": "EPSG:32632"}
    with rasterio.open(folder / "mosaic.tif", "w", driver="GTiff", transform=place, **kind) as tiff:
        tiff.write(np.repeat(np.clip(np.rint(grey), 0, 255).astype(np.uint8)[None], 3, axis=0))
    accuracy = {"absolute": {"rmse_h_m": 0.8, "rmse_v_m": 1.0}}
    (folder / "run.json").write_text(json.dumps({"artefacts": {}, "accuracy": accuracy}), encoding="utf-8")
    return folder


def later(grey: np.ndarray, seed: int, squares: bool = True) -> np.ndarray:
    """The same ground half a pixel aside, with noise, a brighter sun, light that falls off, and squares."""
    rng = np.random.default_rng(seed + 100)
    changed = grey.copy()
    for row, col in PLACES if squares else ():
        here = changed[row : row + 10, col : col + 10]
        here[:] = 230.0 if here.mean() < 128.0 else 25.0
    by = np.array([[1.0, 0.0, 0.45], [0.0, 1.0, -0.3]], np.float32)
    aside = cv2.warpAffine(changed, by, (SIDE, SIDE), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    light = np.linspace(0.97, 1.05, SIDE)[None, :]
    return np.asarray(aside * light + 4.0 + rng.normal(0.0, 1.5, aside.shape))


def found(old: Path, new: Path) -> list[shapely.Geometry]:
    before, after = old / "mosaic.tif", new / "mosaic.tif"
    on_old = registration(compare(after, before, ComparisonOptions(search_px=64)))
    assert on_old.sd_px < 0.2
    return [change.outline for change in image_changes(before, after, on_old)]


@pytest.mark.parametrize("seed", range(3))
def test_planted_squares_of_10_px_are_found_and_nothing_else(seed: int, tmp_path: Path) -> None:
    old = run(tmp_path / "old", ground(seed))
    new = run(tmp_path / "new", later(ground(seed), seed), (0.7, -1.1))
    outlines = found(old, new)
    assert len(outlines) == len(PLACES)
    for row, col in PLACES:
        east, north = EAST + 0.7 + (col + 5.45) * PIXEL_M, NORTH - 1.1 - (row + 4.7) * PIXEL_M
        (there,) = [o for o in outlines if o.contains(shapely.Point(east, north))]
        assert 0.5 < there.area < 2.6


@pytest.mark.parametrize("seed", range(3))
def test_two_flights_over_the_same_ground_differ_nowhere(seed: int, tmp_path: Path) -> None:
    old = run(tmp_path / "old", ground(seed))
    assert not found(old, run(tmp_path / "new", later(ground(seed), seed, squares=False)))


def test_planted_squares_are_found_between_mosaics_of_kelvin(tmp_path: Path) -> None:
    """In 32-bit floats, which GDAL's warping gives no mask for. The old map lacks its last 100 columns."""
    old, new = run(tmp_path / "old", ground(0)), run(tmp_path / "new", later(ground(0), 0), (0.7, -1.1))
    for folder, cols in ((old, SIDE - 100), (new, SIDE)):
        with rasterio.open(folder / "mosaic.tif") as tiff:
            kelvin, place = 270.0 + tiff.read(1)[:, :cols] / 10.0, tiff.transform
        kind = {"width": cols, "height": SIDE, "count": 1, "dtype": "float32", "crs": "EPSG:32632"}
        with rasterio.open(folder / "mosaic.tif", "w", driver="GTiff", transform=place, **kind) as tiff:
            tiff.write(kelvin.astype(np.float32)[None])
    outlines = found(old, new)
    assert len(outlines) == 3, "the fourth square lies beyond the old map"


def test_maps_of_other_places_are_refused(tmp_path: Path) -> None:
    maps = [run(tmp_path / f"{seed}", ground(seed)) / "mosaic.tif" for seed in (1, 2)]
    with pytest.raises(InputError, match=r"places look alike in both maps; compare runs of the same place"):
        registration(compare(maps[0], maps[1], ComparisonOptions(search_px=16)))


def surface(folder: Path, height_m: np.ndarray, sd_m: float) -> SurfaceRasters:
    place = Affine(0.4, 0.0, EAST, 0.0, -0.4, NORTH)
    kind = {
        "width": height_m.shape[1],
        "height": height_m.shape[0],
        "count": 1,
        "dtype": "float32",
        "crs": "EPSG:32632",
        "nodata": -9999.0,
    }
    for name, values in (("surface", height_m), ("surface_confidence", np.full((125, 125), sd_m))):
        path = folder / f"{name}.tif"
        with rasterio.open(path, "w", driver="GTiff", transform=place, **kind) as tiff:
            tiff.write(values.astype(np.float32)[None])
    return SurfaceRasters(folder / "surface.tif", folder / "surface_confidence.tif")


@pytest.mark.parametrize("seed", range(3))
def test_a_heap_is_found_and_neither_offset_nor_tilt_nor_noise(seed: int, tmp_path: Path) -> None:
    rng = np.random.default_rng(seed)
    row, col = np.indices((125, 125))
    hills = 500.0 + 3.0 * np.sin(col / 20.0) + 2.0 * np.cos(row / 15.0)
    heap = np.where((np.abs(row - 40) <= 4) & (np.abs(col - 70) <= 4), 0.6, 0.0)
    old, new = run(tmp_path / "old", ground(seed)), run(tmp_path / "new", later(ground(seed), seed, False))
    before = surface(old, hills + rng.normal(0.0, 0.05, hills.shape), 0.05)
    after = hills + heap + 1.7 + 0.001 * col + rng.normal(0.0, 0.05, hills.shape)
    after[100:110, 10:30] = -9999.0
    on_old = registration(compare(new / "mosaic.tif", old / "mosaic.tif", ComparisonOptions(search_px=64)))
    (change,), offset_m = height_changes(before, surface(new, after, 0.05), on_old, PIXEL_M)
    assert change.rise_m == pytest.approx(0.6, abs=0.06)
    assert change.volume_m3 == pytest.approx(0.6 * 81 * 0.4**2, rel=0.1)
    assert change.outline.contains(shapely.Point(EAST + 70.5 * 0.4, NORTH - 40.5 * 0.4))
    assert offset_m == pytest.approx(1.76, abs=0.03)


def test_the_command_writes_polygons_and_a_picture(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    old = run(tmp_path / "old", ground(1))
    new = run(tmp_path / "new", later(ground(1), 1), (0.7, -1.1))
    assert geomosaic("compare", old, new, "-q") == 0
    lines = capsys.readouterr().out
    assert "image      4 changes" in lines and "apart; then equal to 0.0" in lines
    folder = tmp_path / "new-changes"
    meta, _, geometry, fields = read(folder / "changes.gpkg")
    assert len(geometry) == 4 and meta["crs"] == "EPSG:32632"
    assert set(fields[list(meta["fields"]).index("kind")]) == {"image"}
    assert cv2.imread(str(folder / "changes.png")).shape == (SIDE, SIDE, 3)
    assert geomosaic("compare", old, new, "-o", tmp_path / "c", "--json") == 0
    output = json.loads(capsys.readouterr().out)
    assert output["apart_is_explained"] and output["apart_m"] == pytest.approx(1.30, abs=0.06)
    assert geomosaic("compare", old, new, "-o", tmp_path / "c", "-q") == 0
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "changes.gpkg").write_bytes(b"polygons of a surveyor")
    assert geomosaic("compare", old, new, "-o", tmp_path / "mine", "-q") == 2
    assert "is in the way" in capsys.readouterr().err
    assert (tmp_path / "mine" / "changes.gpkg").read_bytes() == b"polygons of a surveyor"
    assert geomosaic("compare", old, tmp_path, "-q") == 2


@pytest.mark.parametrize(
    ("west", "east", "grey"), [(-5.0, -5.0, (0, 0)), (-20.0, -5.0, (0, 255)), (290.0, 300.0, (0, 255))]
)
def test_a_picture_of_degrees_is_stretched_over_its_values(
    west: float, east: float, grey: tuple[int, int], tmp_path: Path
) -> None:
    """Its upper half has nodata, and is black."""
    values = np.where(np.arange(60) < 30, west, east)[None].repeat(40, axis=0).astype(np.float32)
    values[:20] = np.nan
    kind = {"width": 60, "height": 40, "count": 1, "dtype": "float32", "crs": "EPSG:32632", "nodata": np.nan}
    place = Affine(1.0, 0.0, EAST, 0.0, -1.0, NORTH)
    with rasterio.open(tmp_path / "mosaic.tif", "w", driver="GTiff", transform=place, **kind) as tiff:
        tiff.write(values[None])
    write_picture(tmp_path / "changes.png", tmp_path / "mosaic.tif", [])
    picture = cv2.imread(str(tmp_path / "changes.png"))
    assert not picture[:20].any()
    assert [np.unique(picture[20:, at]).tolist() for at in (slice(0, 30), slice(30, 60))] == [
        [v] for v in grey
    ]


def shapes_of(changes: Sequence[Change]) -> list[tuple[float, ...]]:
    """Area, strongest deviation, mean rise and volume of each, and the middle of its outline."""
    return sorted(
        (c.area_m2, c.sigma, c.rise_m, c.volume_m3, c.outline.centroid.x - EAST, c.outline.centroid.y - NORTH)
        for c in changes
    )


def test_blocks_do_not_show_in_the_changes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With blocks of 48 cells the heap lies in four of them. Its outline has no corner at their edges."""
    rng = np.random.default_rng(5)
    row, col = np.indices((125, 125))
    hills = 500.0 + 3.0 * np.sin(col / 20.0) + 2.0 * np.cos(row / 15.0)
    heap = np.where((np.abs(row - 48) <= 6) & (np.abs(col - 46) <= 6), 0.8, 0.0)
    old, new = run(tmp_path / "old", ground(5)), run(tmp_path / "new", later(ground(5), 5))
    before = surface(old, hills + rng.normal(0.0, 0.05, hills.shape), 0.05)
    after = surface(new, hills + heap + 1.7 + rng.normal(0.0, 0.05, hills.shape), 0.05)
    on_old = registration(compare(new / "mosaic.tif", old / "mosaic.tif", ComparisonOptions(search_px=64)))
    whole, offset_m = height_changes(before, after, on_old, PIXEL_M)
    monkeypatch.setattr(module, "GLANCE_PX", 48)
    parts, same_offset_m = height_changes(before, after, on_old, PIXEL_M)
    assert len(whole) == 1 and whole[0].volume_m3 == pytest.approx(0.8 * 169 * 0.4**2, rel=0.1)
    np.testing.assert_allclose(shapes_of(parts), shapes_of(whole), rtol=1e-6)
    assert same_offset_m == pytest.approx(offset_m, abs=1e-9)
    assert shapely.get_num_coordinates(parts[0].outline) == shapely.get_num_coordinates(whole[0].outline)
    monkeypatch.setattr(module, "GLANCE_PX", 125)  # an edge through the first and the third square
    images = image_changes(old / "mosaic.tif", new / "mosaic.tif", on_old)
    assert len(images) == len(PLACES) and all(0.5 < c.area_m2 < 2.6 for c in images)


def test_memory_does_not_grow_with_the_surface(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """1,440,000 cells in less than 40 bytes each, of which the thinned sample takes most."""
    rng = np.random.default_rng(6)
    hills = 500.0 + 3.0 * np.sin(np.arange(1200) / 200.0) + np.zeros((1200, 1))
    heap = np.zeros(hills.shape)
    heap[600:640, 250:290] = 1.0
    old, new = tmp_path / "old", tmp_path / "new"
    for folder in (old, new):
        folder.mkdir()
    before = surface(old, hills + rng.normal(0.0, 0.05, hills.shape), 0.05)
    after = surface(new, hills + heap + 0.3 + rng.normal(0.0, 0.05, hills.shape), 0.05)
    on_old = Registration(
        best_similarity(np.array([[0.0, 0.0], [9.0, 0.0], [0.0, 9.0]]), np.zeros((3, 2)))[0], 0.1
    )
    monkeypatch.setattr(module, "GLANCE_PX", 256)
    tracemalloc.start()
    try:
        (change,), offset_m = height_changes(before, after, on_old, PIXEL_M)
        _, peak_bytes = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak_bytes < 40 * hills.size
    assert offset_m == pytest.approx(0.3, abs=1e-3)
    assert change.volume_m3 == pytest.approx(1600 * 0.4**2, rel=0.01)
