"""The surface's judge: known differences in, known figures out, and references of strangers."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import laspy
import numpy as np
import pytest
import rasterio
from geoids import egm96_of, undulation_m
from laspy.vlrs.known import WktCoordinateSystemVlr
from osgeo_utils.samples.validate_cloud_optimized_geotiff import validate
from pyproj import CRS, Transformer

from geomosaic.cli.main import main
from geomosaic.errors import FileError, InputError
from geomosaic.pipeline.artefacts import encode, type_name
from geomosaic.pipeline.stage import Context, RunFile
from geomosaic.quality.heights import height_figures
from geomosaic.quality.surface import compare_surface
from geomosaic.stages.quality_surface import quality_surface

UTM = "EPSG:32632"
EAST, NORTH, PIXEL_M = 660_000.0, 5_210_000.0, 1.0
SIDE = 160


def land(east: np.ndarray, north: np.ndarray) -> np.ndarray:
    """Hills of 12 m."""
    return 700.0 + 6.0 * np.sin((east - EAST) / 17.0) + 6.0 * np.cos((north - NORTH) / 23.0)


def middles() -> tuple[np.ndarray, np.ndarray]:
    at = (np.arange(SIDE) + 0.5) * PIXEL_M
    east, north = np.meshgrid(EAST + at, NORTH - at)
    return east, north


def write(
    path: Path, *bands: np.ndarray, crs: str = UTM, place: tuple[float, float, float] = (EAST, NORTH, PIXEL_M)
) -> Path:
    west, north, pixel = place
    shape = {"height": bands[0].shape[0], "width": bands[0].shape[1], "count": len(bands)}
    transform = rasterio.Affine(pixel, 0.0, west, 0.0, -pixel, north)
    with rasterio.open(
        path, "w", driver="GTiff", dtype="float32", crs=crs, nodata=-9999.0, transform=transform, **shape
    ) as tiff:
        tiff.write(np.stack(bands).astype(np.float32))
    return path


@pytest.fixture
def run(tmp_path) -> Path:
    """surface.tif on the land, unknown in a corner, filled from what lies around in the west."""
    heights = land(*middles())
    heights[:20, :20] = -9999.0
    views = np.full(heights.shape, 5.0)
    views[:, :40] = 0.0
    write(tmp_path / "surface.tif", heights)
    write(tmp_path / "surface_confidence.tif", np.full(heights.shape, 0.1), views)
    return tmp_path


def compare(run: Path, reference: Path, offset_m: float | None = None):
    warned_codes: list[str] = []
    paths = run / "surface.tif", run / "surface_confidence.tif", reference
    return (*compare_surface(*paths, offset_m, warned_codes.append), warned_codes)


def cloud(path: Path, xyz: np.ndarray, kind: np.ndarray, crs: str | None = UTM) -> Path:
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales, header.offsets = np.full(3, 0.001), np.array([EAST, NORTH, 0.0])
    if crs:
        header.vlrs.append(WktCoordinateSystemVlr(CRS(crs).to_wkt()))
        header.global_encoding.wkt = True
    points = laspy.LasData(header)
    points.x, points.y, points.z = xyz.T
    points.classification = kind
    points.write(path)
    return path


def scattered(n: int = 20_000, seed: int = 1) -> np.ndarray:
    rng = np.random.default_rng(seed)
    east = EAST + rng.uniform(1.0, SIDE - 1.0, n)
    north = NORTH - rng.uniform(1.0, SIDE - 1.0, n)
    return np.column_stack([east, north, land(east, north)])


def test_figures_by_hand():
    """Deviations from the median 0.2: 0.3, 0.1, 0, 0.1, 4.8, whose median is 0.1."""
    f = height_figures(np.array([-0.1, 0.1, 0.2, 0.3, 5.0]))
    assert (f.n, f.median_m) == (5, 0.2)
    assert f.nmad_m == pytest.approx(0.14826)
    assert f.mean_m == pytest.approx(1.1)
    assert f.rmse_m == pytest.approx(np.sqrt((0.01 + 0.01 + 0.04 + 0.09 + 25.0) / 5.0))
    # sorted 0.1 0.1 0.2 0.3 5.0; 68.3 % lies at place 2.732, 95 % at 3.8
    assert f.abs_68_m == pytest.approx(0.2 + 0.732 * 0.1)
    assert f.abs_95_m == pytest.approx(0.3 + 0.8 * 4.7)
    assert np.isnan(height_figures(np.zeros(0)).nmad_m)


def test_differences_are_surface_minus_reference(run, tmp_path):
    found, difference, warned_codes = compare(run, write(tmp_path / "dem.tif", land(*middles()) - 0.75))
    assert found.over_all.median_m == pytest.approx(0.75, abs=1e-4)
    assert found.over_all.nmad_m < 1e-3 and found.over_all.rmse_m == pytest.approx(0.75, abs=1e-3)
    assert np.isnan(difference[:20, :20]).all()
    np.testing.assert_allclose(difference[40:, 40:], 0.75, atol=1e-3)
    assert [name for name, _ in found.by_support] == ["matched", "filled from what lies around"]
    assert found.by_support[1][1].n == 40 * SIDE - 400
    assert len(warned_codes) == 1 and "no vertical datum" in warned_codes[0]
    assert found.after_fit.rmse_m < 0.01 and found.fit.up_m == pytest.approx(0.75, abs=0.01)


def test_a_reference_in_another_zone_and_pixel_lies_where_it_should(run, tmp_path):
    to_33 = Transformer.from_crs(UTM, "EPSG:32633", always_xy=True)
    west, north = np.min(to_33.transform(*middles()), axis=(1, 2)) + [-20.0, 0.0]
    at = np.arange(500) * 0.5 + 0.25
    e, n = np.meshgrid(west + at, north + 230.0 - at)
    back = Transformer.from_crs("EPSG:32633", UTM, always_xy=True).transform(e, n)
    reference = write(
        tmp_path / "dem.tif", land(*map(np.array, back)), crs="EPSG:32633", place=(west, north + 230.0, 0.5)
    )
    found, _, _ = compare(run, reference)
    assert found.over_all.n == SIDE * SIDE - 400
    assert found.over_all.abs_95_m < 0.02


def test_points_by_their_class(run, tmp_path):
    xyz = scattered()
    kind = np.arange(len(xyz)) % 4
    kind = np.choose(kind, [2, 5, 7, 64]).astype(np.uint8)
    xyz[:, 2] += np.select([kind == 2, kind == 5, kind == 7], [-0.1, 2.0, 90.0], 0.0)
    found, _, _ = compare(run, cloud(tmp_path / "points.laz", xyz, kind))
    figures = dict(found.by_kind)
    assert list(figures) == ["ground", "high vegetation", "class 64"]
    assert figures["ground"].median_m == pytest.approx(0.1, abs=0.01)
    assert figures["high vegetation"].median_m == pytest.approx(-2.0, abs=0.01)
    assert figures["class 64"].abs_95_m < 0.05
    assert found.over_all.n == sum(f.n for f in figures.values())


def test_points_of_a_cloud_in_feet(run, tmp_path):
    xyz = scattered()
    xyz[:, 2] *= 3937.0 / 1200.0  # NAVD88 in US survey feet
    feet = cloud(tmp_path / "feet.laz", xyz, np.full(len(xyz), 2, np.uint8), crs="EPSG:32632+6360")
    found, _, _ = compare(run, feet, offset_m=0.4)
    assert found.over_all.median_m == pytest.approx(-0.4, abs=0.01)
    assert found.over_all.abs_95_m < 0.5


def test_slopes_part_level_from_steep(run, tmp_path):
    heights = land(*middles())
    heights[:, 80:] += 9.0
    with rasterio.open(run / "surface.tif", "r+") as tiff:
        tiff.write(heights.astype(np.float32), 1)
    reference = land(*middles())
    reference[:, 81:] += 9.0
    found, _, _ = compare(run, write(tmp_path / "dem.tif", reference))
    figures = dict(found.by_slope)
    assert list(figures) == [
        "0 to 5\N{DEGREE SIGN}",
        "5 to 15\N{DEGREE SIGN}",
        "15 to 35\N{DEGREE SIGN}",
        "60 to 90\N{DEGREE SIGN}",
    ]
    assert figures["60 to 90\N{DEGREE SIGN}"].rmse_m > 4.0
    assert figures["5 to 15\N{DEGREE SIGN}"].rmse_m < 0.01


def test_a_shift_and_a_tilt_are_found_in_the_hills(run, tmp_path):
    """Points that lie 1.5 m too far west, 0.8 m too far north, 2 m too low, and lean."""
    xyz = scattered(seed=2)
    moved = xyz + [-1.5, 0.8, -2.0]
    moved[:, 2] -= 0.004 * (xyz[:, 0] - EAST - 80.0)
    rng = np.random.default_rng(3)
    moved[:, 2] += rng.normal(0.0, 0.05, len(moved))
    moved[::20, 2] += rng.uniform(1.0, 8.0, len(moved[::20]))
    found, _, _ = compare(run, cloud(tmp_path / "points.las", moved, np.zeros(len(moved), dtype=np.uint8)))
    assert (found.fit.east_m, found.fit.north_m) == pytest.approx((1.5, -0.8), abs=0.05)
    assert found.fit.up_m == pytest.approx(2.0, abs=0.05)
    assert found.fit.tilt_east == pytest.approx(0.004, abs=2e-4)
    assert found.over_all.nmad_m > 0.3 and found.after_fit.nmad_m < 0.08


def test_a_vertical_datum_counts(run, tmp_path):
    """Heights above the geoid are 40 m less."""
    e, n = middles()
    lon, lat = Transformer.from_crs(UTM, "EPSG:4326", always_xy=True).transform(e, n)
    heights = land(e, n) - undulation_m(np.array(lon), np.array(lat))
    reference = write(tmp_path / "dem.tif", heights, crs="EPSG:32632+5773")
    missing = write(tmp_path / "missing.tif", heights, crs="EPSG:32632+3855")
    with pytest.raises(
        InputError, match=r"geoid model .* is not installed.*--set quality\.surface\.offset_m=METRES"
    ):
        compare(run, missing)
    with egm96_of(tmp_path):
        found, _, warned_codes = compare(run, reference)
    assert abs(found.over_all.median_m) < 0.002 and not warned_codes
    assert found.datum.startswith("EGM96 height, offset +4")
    found, _, warned_codes = compare(run, reference, 41.0)
    assert found.over_all.median_m == pytest.approx(-1.0, abs=0.3) and not warned_codes


def test_what_does_not_overlap_is_refused(run, tmp_path):
    elsewhere = write(tmp_path / "dem.tif", np.full((50, 50), 700.0), place=(EAST + 5000.0, NORTH, 1.0))
    with pytest.raises(InputError, match=r"dem\.tif: does not overlap the surface"):
        compare(run, elsewhere)
    points = cloud(tmp_path / "far.laz", scattered(100) + [9000.0, 0.0, 0.0], np.zeros(100, dtype=np.uint8))
    with pytest.raises(InputError, match=r"far\.laz: does not overlap the surface"):
        compare(run, points)


def test_strange_references_are_one_clear_line_before_the_run(tmp_path):
    whole = cloud(tmp_path / "whole.laz", scattered(3000), np.zeros(3000, dtype=np.uint8)).read_bytes()
    many_records = bytearray(whole)
    many_records[100:104] = (2**31).to_bytes(4, "little")
    large_points = bytearray(whole)
    large_points[105:107] = (60_000).to_bytes(2, "little")
    for name, content, words in (
        ("text.laz", b"not a cloud at all", "is no LAS or LAZ file"),
        ("empty.las", b"", "is no LAS or LAZ file"),
        ("short.laz", whole[:300], "asks for more than its size"),
        ("many.laz", bytes(many_records), "asks for more than its size"),
        ("large.laz", bytes(large_points), "points of 60000 bytes"),
        ("text.tif", b"not a raster", "no raster"),
    ):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(FileError, match=words):
            quality_surface.check(quality_surface.Params(reference=tmp_path / name))
    nowhere = cloud(tmp_path / "nowhere.laz", scattered(50), np.zeros(50, dtype=np.uint8), crs=None)
    with pytest.raises(FileError, match="no coordinate reference system"):
        quality_surface.check(quality_surface.Params(reference=nowhere))
    degrees = cloud(tmp_path / "degrees.las", scattered(50), np.zeros(50, dtype=np.uint8), crs="EPSG:4326")
    with pytest.raises(FileError, match="no map in metres"):
        quality_surface.check(quality_surface.Params(reference=degrees))


def test_a_cloud_that_ends_early_is_no_fault_of_ours(run, tmp_path):
    whole = cloud(tmp_path / "whole.laz", scattered(30_000), np.zeros(30_000, dtype=np.uint8)).read_bytes()
    cut = tmp_path / "cut.laz"
    cut.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(FileError, match=r"cut\.laz: (can't be read whole|is no LAS)"):
        compare(run, cut)


def test_the_stage_writes_the_difference_and_tells_the_figures(run, tmp_path):
    reference = write(tmp_path / "dem.tif", land(*middles()) - 0.5)
    context = Context(run, stage_id="quality.surface", work_folder=tmp_path / "work")
    files = {"surface_file": "surface.tif", "confidence_file": "surface_confidence.tif"}
    inputs = {name: context.run_file(file) for name, file in files.items()}
    out = quality_surface().run(inputs, quality_surface.Params(reference=reference), context)
    assert validate(str(run / "surface_difference.tif"), full_check=True)[:2] == ([], [])
    with rasterio.open(run / "surface_difference.tif") as tiff:
        values = tiff.read(1, masked=True)
        assert tiff.crs.to_epsg() == 32632 and tiff.units == ("m",)
    assert values.mask.sum() == 400 and values.mean() == pytest.approx(0.5, abs=1e-3)
    metrics = context.notes.metrics["quality"]["surface"]
    assert metrics["over_all"]["median_m"] == pytest.approx(0.5, abs=1e-3)
    assert metrics["by_support"]["matched"]["n"] == 120 * SIDE
    json.dumps(metrics, allow_nan=False)
    assert [w["code"] for w in context.notes.warnings] == ["reference-datum-assumed"]
    text = dict(quality_surface.conclusions({"metrics": context.notes.metrics}))["heights"]
    assert "median +0.5 m" in text and "25,200 points" in text
    assert out["surface_comparison"].difference_m.shape == (SIDE, SIDE)


def finished(run: Path) -> Path:
    """The folder as a run that made both rasters."""
    names = {"surface_file": "surface.tif", "confidence_file": "surface_confidence.tif"}
    context = Context(run, stage_id="export.surface", work_folder=run / "scratch")
    artefacts = {}
    for name, file in names.items():
        (run / f"{name}.artefact").write_bytes(encode(context.run_file(file)))
        artefacts[name] = {"file": f"{name}.artefact", "type": type_name(RunFile), "fingerprint": name}
    (run / "run.json").write_text(json.dumps({"artefacts": artefacts}), encoding="utf-8")
    return run


def test_a_finished_run_is_compared_without_running_again(run, tmp_path, capsys):
    reference = write(tmp_path / "dem.tif", land(*middles()) - 0.5)
    asked = ["evaluate", str(finished(run)), "--surface-reference", str(reference)]
    assert main(asked) == 0
    lines = capsys.readouterr().out.splitlines()
    for name, n, median in (
        ("all", "25,200", "0.500"),
        ("after the best shift and tilt", "25,200", "0.000"),
        ("matched", "19,200", "0.500"),
        ("filled from what lies around", "6,000", "0.500"),
    ):
        (line,) = (line for line in lines if line.startswith(f"{name} "))
        assert line.removeprefix(name).split()[:2] == [n, median], line
    assert any(line.startswith("slope 5 to 15°") for line in lines)
    assert lines[-2:] == [str(run / "surface_difference.tif"), str(run / "surface_difference.png")]
    picture = cv2.imread(str(run / "surface_difference.png"), cv2.IMREAD_UNCHANGED)
    assert picture.shape[1] == 320 and picture[5, 5, 3] == 0
    assert picture[80, 80].tolist() == pytest.approx([247, 247, 247, 255], abs=25)
    assert main([*asked, "--json"]) == 0
    output = json.loads(capsys.readouterr().out)
    assert output["quality"]["surface"]["by_support"]["matched"]["n"] == 120 * SIDE
    assert output["warnings"][0]["code"] == "reference-datum-assumed"


def test_a_run_without_a_surface_says_what_to_do(run, tmp_path, capsys):
    reference = write(tmp_path / "dem.tif", land(*middles()))
    (run / "run.json").write_text(json.dumps({"artefacts": {}}), encoding="utf-8")
    assert main(["evaluate", str(run), "--surface-reference", str(reference)]) == 2
    assert "has no surface to compare; run it with --surface dense" in capsys.readouterr().err
