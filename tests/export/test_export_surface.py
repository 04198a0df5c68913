"""The surface's files: heights where they belong, by other programs' numbers, and what is unknown."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import laspy
import numpy as np
import pytest
import rasterio
from geoids import egm96_of, undulation_m
from osgeo import gdal, ogr, osr
from osgeo_utils.samples.validate_cloud_optimized_geotiff import validate
from pyproj import CRS, Transformer
from stac_schema import check_schema

from geomosaic.composition.model import Mosaic, OutputGrid
from geomosaic.doors.raster import READ_CACHE_BYTES
from geomosaic.errors import InputError
from geomosaic.export.stac import coverage_of_mosaic, stac_item
from geomosaic.export.surface import SurfaceOnMap
from geomosaic.export.surface_heights import HeightSystem, height_system, write_sidecar
from geomosaic.geodesy.local import LocalFrame
from geomosaic.geodesy.mapcrs import LOCAL_CRS
from geomosaic.pipeline.stage import Context
from geomosaic.requests.mosaic_stages import STAGES
from geomosaic.requests.run_request import recipe_of
from geomosaic.stages.export_surface import export_surface
from geomosaic.surface.cells import Cells
from geomosaic.surface.dtm import TerrainModel
from geomosaic.surface.model import DenseSurface
from geomosaic.survey.model import Survey

LON, LAT, HEIGHT_M = 11.0, 47.0, 600.0
PLACE = f"+lon_0={LON} +lat_0={LAT} +h_0={HEIGHT_M} +ellps=WGS84"
GEODETIC_FROM_ENU = Transformer.from_pipeline(
    f"+proj=pipeline +step +inv +proj=topocentric {PLACE} +step +inv +proj=cart +ellps=WGS84 "
    "+step +proj=unitconvert +xy_in=rad +xy_out=deg"
)
CELL_M, SIDE = 4.0, 170
FAR_M = 9000.0
"""East and north of the work frame's origin, where the Earth falls away by 12 m."""


def land_m(lon: np.ndarray, lat: np.ndarray) -> np.ndarray:
    """Ellipsoidal heights: a slope of a few percent."""
    return 640.0 + 3000.0 * (lon - 11.1) + 1500.0 * (lat - 47.08)


def up_of(cells: Cells, height) -> np.ndarray:
    """Up in the work frame of what has these ellipsoidal heights, by PROJ's own topocentric frame."""
    east, north = np.meshgrid(*cells.axes_m())
    up = np.zeros(east.shape)
    for _ in range(6):
        lon, lat, h = GEODETIC_FROM_ENU.transform(east, north, up)
        up += height(lon, lat) - h
    return up


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> dict:
    cells = Cells(FAR_M, FAR_M, CELL_M, SIDE, SIDE)
    up = up_of(cells, lambda lon, lat: land_m(lon, lat) + 8.0).astype(np.float32)
    sd = np.full(up.shape, 0.25, dtype=np.float32)
    sd[100:] = np.nan
    views = np.full(up.shape, 4, dtype=np.uint8)
    views[:40] = 0
    surface = DenseSurface(cells, up, sd, views)
    terrain = TerrainModel(cells, up_of(cells, land_m).astype(np.float32), sd, views > 0)
    corner = GEODETIC_FROM_ENU.transform(FAR_M, FAR_M + SIDE * CELL_M, 0.0)
    west, north = Transformer.from_crs("EPSG:4326", "EPSG:32632", always_xy=True).transform(*corner[:2])
    grid = OutputGrid("EPSG:32632", np.floor(west) + 20.0, np.floor(north) - 20.0, 1.0, 600, 610)
    folder = tmp_path_factory.mktemp("run")
    return {
        "folder": folder,
        "survey": Survey((), (), LocalFrame(LON, LAT, HEIGHT_M), "EPSG:32632"),
        "surface": surface,
        "terrain": terrain,
        "mosaic": Mosaic(grid, "mosaic.tif", 3, "uint8", None, (), ()),
        "file": mosaic_file(folder / "mosaic.tif", grid),
    }


def mosaic_file(path: Path, grid: OutputGrid) -> Path:
    """Colours that rise by pixels; nothing in its south."""
    rows, cols = np.indices((grid.height_px, grid.width_px))
    colours = np.stack([rows % 256, cols % 256, np.full(rows.shape, 77)]).astype(np.uint8)
    shape = {"width": grid.width_px, "height": grid.height_px, "count": 3, "dtype": "uint8", "crs": grid.crs}
    transform = rasterio.Affine.from_gdal(*grid.geotransform)
    with (
        rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True),
        rasterio.open(path, "w", driver="GTiff", transform=transform, **shape) as tiff,
    ):
        tiff.write(colours)
        tiff.write_mask(np.where(rows < 560, 255, 0).astype(np.uint8))
    return path


def export(scene: dict, work: Path, **params) -> Path:
    folder = work.parent / "run"
    folder.mkdir(exist_ok=True)
    shutil.copy(scene["file"], folder)
    context = Context(folder, stage_id="export.surface", work_folder=work)
    inputs = {name: scene[name] for name in ("survey", "surface", "terrain", "mosaic")}
    inputs["mosaic_file"] = context.run_file(scene["file"].name)
    export_surface().run(inputs, export_surface.Params(**params), context)
    return folder


@pytest.fixture(scope="module")
def written(scene, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("written")
    return export(scene, folder / "work", hillshade=True, contours_m=5.0, point_cloud=True)


def test_heights_are_ellipsoidal_nine_kilometres_from_the_frames_origin(written):
    """Where the work frame's up is 12 m off, and its vertical 0.1 degrees."""
    to_lonlat = Transformer.from_crs("EPSG:32632", "EPSG:4326", always_xy=True)
    for name, above_m in (("surface", 8.0), ("terrain", 0.0)):
        with rasterio.open(written / f"{name}.tif") as tiff:
            row, col = np.indices(tiff.shape)
            lon, lat = to_lonlat.transform(*tiff.xy(row.ravel(), col.ravel()))
            off = tiff.read(1).ravel() - land_m(np.array(lon), np.array(lat)) - above_m
            known = tiff.read_masks(1).ravel() > 0
        assert np.abs(off[known]).max() < 0.002, name


def test_gdal_reads_a_known_place(written):
    lon, lat, _ = GEODETIC_FROM_ENU.transform(FAR_M + 300.0, FAR_M + 400.0, 0.0)
    e, n = Transformer.from_crs("EPSG:4326", "EPSG:32632", always_xy=True).transform(lon, lat)
    data = gdal.Open(str(written / "surface.tif"))
    col, row = gdal.ApplyGeoTransform(gdal.InvGeoTransform(data.GetGeoTransform()), e, n)
    reported = data.ReadAsArray(int(col), int(row), 1, 1)[0, 0]
    assert reported == pytest.approx(land_m(lon, lat) + 8.0, abs=0.15)  # half a pixel of slope


def test_the_grid_is_the_mosaics_in_whole_pixels(written, scene):
    with rasterio.open(written / "surface.tif") as tiff:
        grid = scene["mosaic"].grid
        assert tiff.transform[:6] == (4.0, 0.0, grid.west_m, 0.0, -4.0, grid.north_m)
        assert (tiff.width, tiff.height) == (150, 153)
        assert tiff.dtypes == ("float32",) and tiff.nodata == -9999.0 and tiff.units == ("m",)
        assert tiff.tags()["HEIGHTS"] == "ellipsoidal, WGS 84, metres"


@pytest.mark.parametrize("name", ["surface", "surface_confidence", "terrain"])
def test_each_is_a_cog_on_the_map(written, name):
    path = written / f"{name}.tif"
    assert validate(str(path), full_check=True)[:2] == ([], [])
    with rasterio.Env(GDAL_PAM_ENABLED="NO"), rasterio.open(path) as tiff:
        assert tiff.crs.to_epsg() == 32632


@pytest.mark.parametrize("name", ["surface", "terrain"])
def test_gdal_finds_ellipsoidal_heights_in_the_crs(written, name):
    reference = gdal.Open(str(written / f"{name}.tif")).GetSpatialRef()
    with rasterio.open(written / f"{name}.tif") as tiff:
        theirs = tiff.crs.to_wkt(version="WKT2_2019")
    for wkt in (reference.ExportToWkt(["FORMAT=WKT2_2019"]), theirs):
        crs = CRS.from_wkt(wkt)
        assert [axis.direction for axis in crs.axis_info] == ["east", "north", "up"]
        assert crs.to_2d().to_epsg() == 32632 and "llips" in crs.axis_info[2].name
    assert reference.GetDataAxisToSRSAxisMapping() == [1, 2, 3]


def test_confidence_tells_deviation_and_frames(written):
    with rasterio.open(written / "surface_confidence.tif") as tiff:
        sd, views = tiff.read(masked=True)
    assert set(np.unique(sd.compressed())) == {0.25}
    assert sd.mask[:20].all() and not sd.mask[80:120].any(), "unknown in the north"
    assert set(np.unique(views.compressed())) == {0.0, 4.0}


def test_what_neither_frames_nor_the_mosaic_show_is_unknown(written):
    """The mosaic ends in the south, where nothing was matched, and begins north of where heights are filled."""
    with rasterio.open(written / "surface.tif") as tiff:
        known = tiff.read_masks(1) > 0
    with rasterio.open(written / "surface_confidence.tif") as tiff:
        views = tiff.read(2)
    assert known[:140].all() and not known[140:].any()
    assert (views[known] == 0).any()


def test_equal_surfaces_give_equal_bytes(written, scene, tmp_path):
    again = export(scene, tmp_path / "work", threads=1, hillshade=True, contours_m=5.0, point_cloud=True)
    files = [p.name for p in sorted(written.iterdir()) if p.is_file()]
    assert len(files) == 10
    for name in files:
        assert (again / name).read_bytes() == (written / name).read_bytes(), name


def test_orthometric_heights_by_the_geoids_grid(scene, tmp_path):
    with egm96_of(tmp_path):
        folder = export(scene, tmp_path / "work", heights="EGM96")
    with rasterio.open(folder / "surface.tif") as tiff:
        crs = CRS.from_wkt(tiff.crs.to_wkt(version="WKT2_2019"))
        assert tiff.tags()["HEIGHTS"] == "EGM96 height, metres"
        row, col = np.indices(tiff.shape)
        lon, lat = Transformer.from_crs("EPSG:32632", "EPSG:4326", always_xy=True).transform(
            *tiff.xy(row.ravel(), col.ravel())
        )
        lon, lat = np.array(lon), np.array(lat)
        off = tiff.read(1).ravel() - land_m(lon, lat) - 8.0 + undulation_m(lon, lat)
        assert np.abs(off[tiff.read_masks(1).ravel() > 0]).max() < 0.003
    assert crs.is_compound and crs.sub_crs_list[1].to_epsg() == 5773 and crs.to_2d().to_epsg() == 32632
    with rasterio.Env(GDAL_PAM_ENABLED="NO"), rasterio.open(folder / "surface.tif") as tiff:
        tags = CRS.from_wkt(tiff.crs.to_wkt(version="WKT2_2019"))
    assert tags.is_compound, "in the file itself as well"


def test_a_sidecar_of_other_heights_does_not_stay(scene, tmp_path):
    """GDAL would believe it before the file's own tags."""
    folder = export(scene, tmp_path / "work")
    with egm96_of(tmp_path):
        export(scene, tmp_path / "work", heights="EPSG:5773")
    reference = gdal.Open(str(folder / "surface.tif")).GetSpatialRef()
    assert reference.IsCompound() and reference.GetAxesCount() == 3


def test_maps_that_count_north_first_are_written_east_first(tmp_path):
    """EPSG:31467's axes are northing, easting."""
    grid = OutputGrid("EPSG:31467", 3_500_000.0, 5_400_000.0, 1.0, 600, 610)
    path = tmp_path / "surface.tif.aux.xml"
    write_sidecar(
        path, HeightSystem("EPSG:31467", CRS("EPSG:31467").to_3d().to_wkt(), "", np.zeros((33, 33)))
    )
    assert b'dataAxisToSRSAxisMapping="2,1,3"' in path.read_bytes()
    assert height_system(grid, "ellipsoidal").crs == "EPSG:31467"


def test_a_geoid_without_its_grid_is_one_clear_error(scene, tmp_path):
    with pytest.raises(
        InputError, match=r"geoid model for 'EGM2008 height' is not installed.*; write ellips"
    ):
        export(scene, tmp_path / "work", heights="EGM2008")


@pytest.mark.parametrize("wrong", ["EPSG:32632", "EPSG:9999999", "geoid", "EPSG:32632+5773"])
def test_what_is_no_vertical_crs_is_refused_before_the_run(wrong):
    with pytest.raises(InputError, match=r"vertical|no vertical reference system"):
        export_surface.check(export_surface.Params(heights=wrong))


def test_over_another_ellipsoid_no_crs_says_what_heights_count_from():
    """British heights over Airy's ellipsoid would be 50 m lower than those that are written."""
    grid = OutputGrid("EPSG:27700", 400_000.0, 300_000.0, 1.0, 600, 610)
    british = height_system(grid, "ellipsoidal")
    assert british.crs == british.whole_crs == "EPSG:27700"
    local = OutputGrid(LOCAL_CRS, 0.0, 0.0, 1.0, 600, 610)
    assert height_system(local, "ellipsoidal").crs_in_space == ""
    with pytest.raises(InputError, match="local frame"):
        height_system(local, "EPSG:5773")


def test_the_cloud_lies_on_the_surface_in_the_mosaics_colours(written, scene):
    with laspy.open(written / "point_cloud.laz") as file:
        header, points = file.header, file.read()
    with rasterio.open(written / "surface.tif") as tiff:
        grid = tiff.transform
        col = (np.array(points.x) - grid.c) / grid.a
        row = (np.array(points.y) - grid.f) / grid.e
        np.testing.assert_allclose(row % 1.0, 0.5, atol=0.001)
        row, col = row.astype(int), col.astype(int)
        heights = tiff.read(1)[row, col]
    with rasterio.open(written / "surface_confidence.tif") as tiff:
        views = tiff.read(2)
    np.testing.assert_allclose(points.z, heights, atol=0.0006)
    assert len(points) == (views == 4).sum() > 15000
    assert set(points.classification) == {2}
    assert header.scales.tolist() == [0.001] * 3 and header.point_format.id == 7
    assert abs(header.offsets[0] - header.mins[0]) < 1000.0
    assert points.blue.min() == points.blue.max() == 77 * 257
    inner = np.flatnonzero((row == 50) & (col == 60))[0]
    assert points.red[inner] == pytest.approx(201.5 * 257, abs=0.6)
    assert points.green[inner] == pytest.approx(241.5 * 257, abs=0.6)


def test_the_clouds_crs_is_read_by_pyproj_and_gdal(written):
    with laspy.open(written / "point_cloud.laz") as file:
        crs = file.header.parse_crs()
        (wkt,) = (v.string for v in file.header.vlrs if v.record_id == 2112)
    assert crs.to_2d().to_epsg() == 32632 or crs.sub_crs_list[0].to_epsg() == 32632
    assert wkt.startswith("COMPD_CS[") and "llips" in wkt
    reference = osr.SpatialReference()
    assert reference.ImportFromWkt(wkt) == 0 and reference.GetAxesCount() == 3


def test_what_stands_on_the_ground_is_no_ground_in_the_cloud(scene, tmp_path):
    seen = scene["terrain"].seen.copy()
    seen[:, :80] = False
    terrain = replace(scene["terrain"], seen=seen)
    folder = export({**scene, "terrain": terrain}, tmp_path / "work", point_cloud=True)
    with laspy.open(folder / "point_cloud.laz") as file:
        points = file.read()
    east, kind = np.array(points.x), np.array(points.classification)
    assert set(kind[east < east.mean() - 100.0]) == {1}
    assert set(kind[east > east.mean() + 100.0]) == {2}


def test_the_catalogue_says_what_stands_in_the_surface(written, scene):
    item = stac_item("town", coverage_of_mosaic(scene["mosaic"]), [], 1.6e9, written)
    check_schema(item)
    for name in ("surface", "terrain", "surface_confidence"):
        asset = item["assets"][name]
        with rasterio.open(written / f"{name}.tif") as tiff:
            assert asset["proj:shape"] == list(tiff.shape)
            assert asset["proj:transform"] == list(tiff.transform[:6])
            assert [band["name"] for band in asset["bands"]] == list(tiff.descriptions)
            assert asset["bands"][0]["statistics"]["maximum"] == pytest.approx(tiff.read(1).max(), rel=1e-6)
        assert asset["bands"][0]["nodata"] == -9999.0 and asset["bands"][0]["unit"] == "m"
        assert "ellipsoidal" in asset["description"]
    assert item["assets"]["surface"]["roles"] == ["data"]
    assert item["assets"]["point_cloud"]["type"] == "application/vnd.laszip"


def test_contours_lie_at_their_heights(written):
    dataset = ogr.Open(str(written / "terrain_contours.gpkg"))
    layer = dataset.GetLayer(0)
    assert layer.GetName() == "contours"
    heights = set()
    with rasterio.open(written / "terrain.tif") as tiff:
        for feature in layer:
            heights.add(feature["height_m"])
            x, y, *_ = feature.geometry().GetPoint(feature.geometry().GetPointCount() // 2)
            assert next(tiff.sample([(x, y)]))[0] == pytest.approx(feature["height_m"], abs=0.2)
        low, high = (tiff.read(1, masked=True).min(), tiff.read(1).max())
    assert heights == set(np.arange(np.ceil(low / 5) * 5, high, 5.0))
    assert CRS.from_wkt(layer.GetSpatialRef().ExportToWkt()).to_2d().to_epsg() == 32632


def test_the_hillshade_is_a_cog_lit_from_the_north_west(written):
    assert validate(str(written / "surface_hillshade.tif"), full_check=True)[:2] == ([], [])
    with rasterio.open(written / "surface_hillshade.tif") as tiff:
        shade = tiff.read(1)
        assert tiff.dtypes == ("uint8",) and tiff.nodata == 0
    # lon and lat rise by 1 degree in 75.6 and 111 km: a slope of 0.0397 to the east and 0.0135 to the north
    to_sun = np.array([-1.0, 1.0, np.sqrt(2.0)]) / 2.0
    normal = np.array([-3000.0 / 75_850.0, -1500.0 / 111_170.0, 1.0])
    expected = 1.0 + 254.0 * (normal @ to_sun) / np.linalg.norm(normal)
    assert np.median(shade[40:100, 40:100]) == pytest.approx(expected, abs=1.5)


def test_the_command_wires_the_surfaces_stages(tmp_path):
    """Nothing runs: that every stage gets what it takes is seen when the recipe is made."""
    given = {"survey.read": {"frames": tmp_path}, "quality.surface": {"reference": tmp_path / "dem.tif"}}
    stages = [id for id in STAGES if id not in ("quality.compare", "matching.reference")]
    recipe = recipe_of(("mosaic", ""), stages, given, sets=["export.surface.heights=EPSG:5773"])
    made = {step.stage.id: step for step in recipe.steps}
    assert made["export.surface"].params.heights == "EPSG:5773"
    with pytest.raises(InputError, match=r"quality\.surface needs 'surface_file'"):
        without = [id for id in stages if id != "export.surface"]
        recipe_of(("mosaic", ""), without, given)


def test_memory_goes_by_the_block(scene):
    """Even where 64 of the mosaic's pixels are one of the surface's along a side."""
    grid = OutputGrid("EPSG:32632", 660_000.0, 5_217_000.0, 64.0, 500, 500)
    on_map = SurfaceOnMap(
        grid,
        64,
        scene["survey"].work_frame,
        scene["surface"],
        scene["terrain"],
        height_system(grid, "ellipsoidal"),
    )
    with rasterio.open(scene["file"]) as mosaic:
        assert next(on_map.blocks(mosaic)).valid.shape == (64, 64)


def test_gdal_keeps_few_blocks_while_rasters_are_written(scene, tmp_path, monkeypatch):
    """By itself each of both GDALs keeps a twentieth of the machine's memory."""
    seen, blocks = [], SurfaceOnMap.blocks

    def watched(on_map, mosaic):
        for block in blocks(on_map, mosaic):
            seen.append((gdal.GetCacheMax(), rasterio.env.get_gdal_config("GDAL_CACHEMAX")))
            yield block

    monkeypatch.setattr(SurfaceOnMap, "blocks", watched)
    before = gdal.GetCacheMax()
    gdal.SetCacheMax(4 * READ_CACHE_BYTES)
    try:
        export(scene, tmp_path / "work")
        assert gdal.GetCacheMax() == 4 * READ_CACHE_BYTES
    finally:
        gdal.SetCacheMax(before)
    assert set(seen) == {(READ_CACHE_BYTES, READ_CACHE_BYTES)}
