"""The stage that settles the mosaic's grid: the ground pixel, the area and the raster that are asked for."""

from __future__ import annotations

import csv
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
import shapely
from mosaic_scenes import CAMERA, CRS, make_survey, truth, with_mask
from osgeo import ogr, osr
from pipeline_toy import recipe_of
from pyproj import Transformer
from rasterio import Affine
from rasterio.errors import NotGeoreferencedWarning
from small_surveys import geomosaic, mosaic, small_survey, summary

from geomosaic.adjustment.model import Adjusted
from geomosaic.camera.exterior import Pose
from geomosaic.camera.rotation import Rotation
from geomosaic.composition import frame_part
from geomosaic.composition.area import Outline, area_seen
from geomosaic.composition.compose import compose
from geomosaic.composition.frames import Decoded
from geomosaic.composition.model import OutputGrid
from geomosaic.composition.ownership import Ownership
from geomosaic.composition.raster import MosaicFiles
from geomosaic.composition.spread import InProcessSpooler
from geomosaic.composition.views import FrameView, PosedFrames
from geomosaic.doors.vector import read_shapes
from geomosaic.errors import InputError
from geomosaic.geodesy.mapcrs import MapProjection
from geomosaic.pipeline.context import Notes
from geomosaic.pipeline.run_folder import RunFolder
from geomosaic.pipeline.single_stage import StageInputs, run_stage
from geomosaic.placement.model import Placement
from geomosaic.requests.mosaic_stages import OPTIONAL, STAGES
from geomosaic.stages.mosaic_compose import mosaic_compose
from geomosaic.stages.mosaic_seams import mosaic_seams
from geomosaic.survey.model import Frame
from geomosaic_simulate.survey import SimulatedSurvey

OWN_M = 0.2487


def given_for(folder: Path, **survey: Any) -> dict[str, Any]:
    """What the stages of composition take, of frames of 0.25 m."""
    made, poses, ground = make_survey(folder / "frames", **survey)
    n = len(poses)
    return {
        "survey": made,
        "ground": ground,
        "placement": Placement(poses, tuple(range(n)), (0,) * n, (), OWN_M, "rigorous"),
        "adjusted": Adjusted(poses, (CAMERA,) * n, ("tied",) * n, (), (), ground),
    }


def seams(folder: Path, given: dict[str, Any], **params: Any) -> tuple[Ownership, Notes]:
    inputs = {name: given[name] for name in mosaic_seams.inputs}
    outputs, notes = run_stage(recipe_of(mosaic_seams, mosaic_seams.Params(**params)), StageInputs(RunFolder(folder / "RUN"), inputs), work_folder=folder / "work")  # fmt: skip
    return outputs["ownership"], notes


@pytest.mark.parametrize(
    "gsd_m, wanted_text", [("auto", ""), (0.13, ""), (0.12, "room and time"), (1.2, "lost")]
)
def test_a_ground_pixel_far_from_the_frames_own_is_reported_once(
    tmp_path: Path, gsd_m: float | str, wanted_text: str
) -> None:
    owned, notes = seams(tmp_path, given_for(tmp_path, lines=1, per_line=2), gsd_m=gsd_m)
    assert owned.grid.gsd_m == (0.25 if gsd_m == "auto" else gsd_m)
    texts = [w["text"] for w in notes.warnings if w["code"] == "gsd-far"]
    assert len(texts) == bool(wanted_text)
    for text in texts:
        assert f"pixel is {gsd_m} m, the frames' own is 0.249 m: " in text and wanted_text in text


def polygons(path: Path, crs: str | None, *rings: list[list[tuple[float, float]]], driver: str = "") -> Path:
    """A file of polygons, each of rings of x and y, the outer one first."""
    driver = (
        driver
        or {".gpkg": "GPKG", ".geojson": "GeoJSON", ".shp": "ESRI Shapefile", ".kml": "KML"}[path.suffix]
    )
    reference = None
    if crs is not None:
        reference = osr.SpatialReference()
        reference.SetFromUserInput(crs)
        reference.SetAxisMappingStrategy(osr.OAMS_TRADITIONAL_GIS_ORDER)
    made = ogr.GetDriverByName(driver).CreateDataSource(str(path))
    layer = made.CreateLayer("area", reference, ogr.wkbUnknown)
    for polygon in rings:
        feature = ogr.Feature(layer.GetLayerDefn())
        text = ", ".join("(" + ", ".join(f"{x:.12f} {y:.12f}" for x, y in [*r, r[0]]) + ")" for r in polygon)
        feature.SetGeometry(ogr.CreateGeometryFromWkt(f"POLYGON ({text})"))
        layer.CreateFeature(feature)
        feature = None
    layer = made = None
    return path


def box(west: float, south: float, east: float, north: float) -> list[tuple[float, float]]:
    return [(west, south), (east, south), (east, north), (west, north)]


def written(
    folder: Path, given: dict[str, Any], blend: str = "auto", **params: Any
) -> tuple[np.ndarray, np.ndarray, OutputGrid, Any]:
    """Pixels, mask and grid of the mosaic, and its artefact."""
    own, _ = seams(folder, given, **params)
    outputs, _ = run_stage(recipe_of(mosaic_compose, mosaic_compose.Params(blend=blend)), StageInputs(RunFolder(folder / "RUN"), {**given, "ownership": own}), work_folder=folder / "work")  # fmt: skip
    with rasterio.open(folder / "RUN" / outputs["mosaic"].raster) as tiff:
        return np.moveaxis(tiff.read(), 0, -1), tiff.dataset_mask() > 0, own.grid, outputs["mosaic"]


@pytest.mark.parametrize(("blend", "feather_m", "warned"), [
    ("auto", 5.0, "multi_band"), ("hard", 5.0, "hard"), ("feather", 5.0, ""), ("auto", "auto", "")
])  # fmt: skip
def test_a_feather_that_the_blend_does_not_use_is_reported(
    tmp_path: Path, blend: str, feather_m: float | str, warned: str
) -> None:
    given = given_for(tmp_path, lines=1, per_line=2)
    own, _ = seams(tmp_path, given)
    params = mosaic_compose.Params(blend=blend, feather_m=feather_m)
    inputs = StageInputs(RunFolder(tmp_path / "RUN"), {**given, "ownership": own})
    _, notes = run_stage(recipe_of(mosaic_compose, params), inputs, work_folder=tmp_path / "work")
    texts = [w["text"] for w in notes.warnings if w["code"] == "feather-unused"]
    assert len(texts) == bool(warned)
    assert all(f"the blend {warned} has no width" in text for text in texts)


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, Any], Any]:
    """Six frames, and the mosaic of all they see."""
    folder = tmp_path_factory.mktemp("flown")
    given = given_for(folder)
    return given, written(folder, given)


def around(
    whole: OutputGrid, west: float, south: float, east: float, north: float
) -> list[tuple[float, float]]:
    """A box in metres from the middle of a grid."""
    e, n = whole.map_from_pixel(np.array([whole.width_px, whole.height_px]) // 2).tolist()
    return box(e + west, n + south, e + east, n + north)


def test_an_area_with_a_hole_cuts_the_mosaic_and_leaves_the_rest(tmp_path: Path, flown: Any) -> None:
    """A box with a hole and another one apart: pixels are inside by their middles, and are as they were."""
    given, (_, _, whole, _) = flown
    outer, hole, other = (
        around(whole, *b)
        for b in ((-16.1, -12.3, 9.9, 14.2), (-8.05, -3.1, 0.2, 4.0), (12.0, -20.0, 14.0, -17.9))
    )
    aoi = polygons(tmp_path / "area.gpkg", CRS, [outer, hole], [other])
    cut_pixels, cut_mask, grid, cut = written(tmp_path, given, aoi=aoi, seam="nearest_nadir")
    west, north = min(x for x, _ in outer), max(y for _, y in outer)
    assert (grid.west_m, grid.north_m) == (np.floor(west / 4.0) * 4.0, np.ceil(north / 4.0) * 4.0)
    far_east, far_south = max(x for x, _ in other), min(y for _, y in other)
    assert grid.width_px == np.ceil((far_east - grid.west_m) / 0.25)
    assert grid.height_px == np.ceil((grid.north_m - far_south) / 0.25)
    east = grid.west_m + (np.arange(grid.width_px) + 0.5) * 0.25
    rows = (grid.north_m - (np.arange(grid.height_px) + 0.5) * 0.25)[:, None]

    def inside(ring: list[tuple[float, float]]) -> np.ndarray:
        (w, s), _, (e, n), _ = ring
        return (east > w) & (east < e) & (rows > s) & (rows < n)

    wanted = (inside(outer) & ~inside(hole)) | inside(other)
    assert (cut_mask == wanted).all(), "frames show all of it"
    assert (cut_pixels[~wanted] == 0).all()
    off = round((grid.west_m - whole.west_m) / 0.25), round((whole.north_m - grid.north_m) / 0.25)
    before = written(tmp_path / "all", given, seam="nearest_nadir")[0]
    before = before[off[1] : off[1] + grid.height_px, off[0] : off[0] + grid.width_px]
    differs = np.abs(before.astype(int) - cut_pixels)[wanted]
    assert differs.max() <= 1
    assert cut.holes.number == 0
    with rasterio.open(tmp_path / "RUN" / "sources.tif") as tiff:
        assert ((tiff.read(1) > 0) == wanted).all()


def test_windows_at_an_areas_edge_are_cut_to_the_pixel(tmp_path: Path, flown: Any) -> None:
    """An L over many windows: inside not a bit differs from the mosaic of the same owners without an area."""
    given, (_, _, whole, _) = flown
    (w, s), _, (e, n), _ = around(whole, -21.03, -17.02, 20.01, 18.04)
    ring = [(w, s), (e, s), (e, s + 8.0), (w + 6.0, s + 8.0), (w + 6.0, n), (w, n)]
    aoi = polygons(tmp_path / "area.gpkg", CRS, [ring])
    owned, _ = seams(tmp_path, given, aoi=aoi, gsd_m=0.02)
    frames = PosedFrames(given["survey"], given["adjusted"].poses, [CAMERA] * 6, [True] * 6, given["ground"])
    asked: list[int] = []

    class Counting(InProcessSpooler):
        def progress(self, done: int, total: int, text: str = "") -> None:
            asked.append(total)

    for name, of in (("cut", owned), ("all", replace(owned, area=None))):
        compose(frames, of, MosaicFiles(tmp_path / f"{name}.tif"), spread=Counting())
    assert asked[0] == 12 and asked[-1] == 20, "windows of 512 px"
    with rasterio.open(tmp_path / "cut.tif") as cut, rasterio.open(tmp_path / "all.tif") as every:
        east = owned.grid.west_m + (np.arange(cut.width) + 0.5) * 0.02
        rows = (owned.grid.north_m - (np.arange(cut.height) + 0.5) * 0.02)[:, None]
        wanted = (east > w) & (east < e) & (rows > s) & (rows < n) & ((east < w + 6.0) | (rows < s + 8.0))
        valid = cut.dataset_mask() > 0
        assert ((every.dataset_mask() > 0) & wanted == valid).all() and valid.sum() > 0.95 * wanted.sum()
        assert (cut.read()[:, valid] == every.read()[:, valid]).all()


@pytest.mark.parametrize("name", ["area.geojson", "area.shp", "area.kml", "area.gpkg"])
def test_an_area_comes_in_any_format_and_crs(tmp_path: Path, flown: Any, name: str) -> None:
    """By longitude and latitude, or in the next zone: within 2 mm, i.e. of a few pixels at the edge."""
    given, (_, _, whole, _) = flown
    crs = "EPSG:32633" if name.endswith((".gpkg", ".shp")) else "EPSG:4326"
    ring = np.array(around(whole, -15.01, -12.02, 11.03, 14.04))
    there = Transformer.from_crs(CRS, crs, always_xy=True).transform(*ring.T)
    aoi = polygons(tmp_path / name, crs, [list(zip(*there, strict=True))])
    owned, _ = seams(tmp_path, given, aoi=aoi)
    assert owned.area is not None
    assert owned.area.geometry.bounds == pytest.approx([*ring[0], *ring[2]], abs=0.002)


def test_edges_that_bend_on_the_map_are_followed(flown: Any) -> None:
    """A parallel of 40 km lies 40 km^2 / 8 R tan(lat) = 33.8 m from its chord in the middle."""
    south = 47.2
    ring = [(9.4, south), (9.93, south), (9.93, 47.4), (9.4, 47.4)]
    outline = Outline(Path("a"), shapely.MultiPolygon([shapely.Polygon(ring)]), "EPSG:4326", False)
    pose, bounds = Pose(np.zeros(3), Rotation.from_yaw_pitch_roll(0.0, 0.0, 0.0)), (525_000.0, 5_225_000.0)
    view = FrameView(0, pose, CAMERA, np.zeros(2), np.array([*bounds, 580_000.0, 5_260_000.0]), 0.1)
    area, _ = area_seen(outline, CRS, [view])
    way = Transformer.from_crs("EPSG:4326", CRS, always_xy=True)
    for lon in (9.4, 9.61, 9.665, 9.92):
        at = shapely.Point(*way.transform(lon, south))
        assert shapely.distance(at, area.geometry.boundary) < 0.001
    ends = np.array([way.transform(lon, south) for lon in (9.4, 9.93)])
    middle = np.array(way.transform(9.665, south))
    assert np.linalg.norm(ends.mean(axis=0) - middle) == pytest.approx(33.8, rel=0.05)


@pytest.mark.parametrize("blend", ["hard", "multi_band"])
def test_an_area_decodes_no_frame_that_gives_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, blend: str
) -> None:
    """A box of 2 m about a nadir of eight in a line."""
    given = given_for(tmp_path, lines=1, per_line=8, suffix=".jpg")
    decoded: set[str] = set()

    def decode(frame: Frame, kernel_radius_px: int) -> Decoded:
        decoded.add(frame.name)
        return real(frame, kernel_radius_px)

    real = frame_part.decode
    monkeypatch.setattr(frame_part, "decode", decode)
    survey = given["survey"]
    lon, lat, _ = survey.work_frame.geodetic_from_enu(given["adjusted"].poses.positions_m[3])
    e, n = MapProjection(CRS).map_from_geodetic(lon, lat).tolist()
    aoi = polygons(tmp_path / "area.gpkg", CRS, [box(e - 1.0, n - 1.0, e + 1.0, n + 1.0)])
    *_, mosaic = written(tmp_path, given, blend, aoi=aoi)
    assert mosaic.frames_used == (3,)
    assert decoded == {"frame 03.jpg"}


def test_an_area_beyond_the_frames_is_reported(tmp_path: Path) -> None:
    """One frame: of an area within it, of one that goes on for 1000 km, and of one of 2 km about it."""
    given = given_for(tmp_path, lines=1, per_line=1)
    owned, notes = seams(tmp_path, given)
    east, north, gsd_m = owned.grid.west_m, owned.grid.north_m, owned.grid.gsd_m
    rows, cols = (np.flatnonzero((owned.owner > 0).any(axis=axis)) for axis in (1, 0))
    e, n = east + 8.0 * gsd_m * float(cols.mean()), north - 8.0 * gsd_m * float(rows.mean())
    for name, ring, share in (
        ("within", box(e - 5.0, n - 5.0, e + 5.0, n + 5.0), 1.0),
        ("half", box(e - 5.0, n - 5.0, e + 1_000_000.0, n + 5.0), None),
        ("far", box(e - 1000.0, n - 1000.0, e + 1000.0, n + 1000.0), None),
    ):
        area = polygons(tmp_path / f"{name}.gpkg", CRS, [ring])
        owned, notes = seams(tmp_path, given, aoi=area)
        side_m = owned.cell_px * owned.grid.gsd_m
        rows, cols = np.nonzero(owned.owner)
        middles = owned.grid.west_m + (cols + 0.5) * side_m, owned.grid.north_m - (rows + 0.5) * side_m
        seen_m2 = float(shapely.contains_xy(shapely.Polygon(ring), *middles).sum()) * side_m**2
        wanted = share if share is not None else seen_m2 / shapely.Polygon(ring).area
        assert notes.metrics["seams"]["area_seen"] == pytest.approx(wanted, rel=0.01)
        assert [w["code"] for w in notes.warnings] == ([] if share else ["aoi-beyond"])


def test_holes_are_those_in_the_area(tmp_path: Path) -> None:
    """One frame with an invalid patch: an area through it has one hole, an area next to it none."""
    given = given_for(tmp_path, lines=1, per_line=1)
    mask = np.full((180, 240), 255, np.uint8)
    mask[60:120, 90:150] = 0
    given["survey"] = with_mask(given["survey"], 0, mask)
    *_, mosaic = written(tmp_path, given)
    assert mosaic.holes.number == 1
    at = mosaic.holes.largest[0]
    for name, west, number in (("in.gpkg", at.easting_m - 1.0, 1), ("off.gpkg", at.easting_m + 10.0, 0)):
        ring = box(west, at.northing_m - 2.0, west + 6.0, at.northing_m + 2.0)
        *_, cut = written(tmp_path, given, aoi=polygons(tmp_path / name, CRS, [ring]))
        assert cut.holes.number == number
    ring = box(at.easting_m - 1.0, at.northing_m - 2.0, at.easting_m + 1.0, at.northing_m + 2.0)
    with pytest.raises(InputError):
        written(
            tmp_path, given, aoi=polygons(tmp_path / "none.gpkg", CRS, [[(x + 900.0, y) for x, y in ring]])
        )


def test_an_area_that_cannot_be_is_refused_in_one_line(tmp_path: Path, flown: Any) -> None:
    given, (_, _, whole, _) = flown
    good = around(whole, -5.0, -5.0, 5.0, 5.0)
    e, n = good[0]
    flat = polygons(tmp_path / "flat.gpkg", CRS, [[(e, n), (e + 9.0, n), (e + 4.0, n)]])
    far = polygons(tmp_path / "far.geojson", "EPSG:4326", [box(8.0, 46.5, 8.1, 46.6)])
    lost = polygons(tmp_path / "lost.shp", None, [good])
    text = tmp_path / "text.gpkg"
    text.write_text("no polygons")
    points = tmp_path / "points.geojson"
    points.write_text(
        '{"type": "Feature", "properties": {}, "geometry": {"type": "Point", "coordinates": [9, 47]}}'
    )
    two = tmp_path / "two.gpkg"
    made = ogr.GetDriverByName("GPKG").CreateDataSource(str(two))
    for layer in ("fields", "woods"):
        source = ogr.Open(str(polygons(tmp_path / f"{layer}.gpkg", CRS, [good])))
        made.CopyLayer(source.GetLayer(0), layer)
    made = source = None
    for file, problem in (
        (flat, "polygons are empty"),
        (
            far,
            "the frames show no part of the area: it lies at longitude 8.05000, latitude 46.55000, they lie at longitude 9.7",
        ),
        (lost, "no coordinate reference system; .*-a_srs"),
        (text, "no file of polygons"),
        (points, "has no polygon"),
        (two, r"polygons in 2 layers \(fields, woods\)"),
        (tmp_path / "missing.gpkg", "no such file"),
    ):
        with pytest.raises(InputError, match=problem) as caught:
            seams(tmp_path, given, aoi=file)
        assert (
            "\n" not in str(caught.value) and str(file) in str(caught.value) and caught.value.exit_code == 2
        )


def test_a_bomb_of_entities_and_a_log_of_sqlite_are_refused(tmp_path: Path) -> None:
    bomb = "".join(f'<!ENTITY a{i + 1} "{f"&a{i};" * 10}">' for i in range(9))
    text = f'<!DOCTYPE kml [<!ENTITY a0 "lol">{bomb}]><kml xmlns="http://www.opengis.net/kml/2.2"><name>&a9;</name></kml>'
    (tmp_path / "bomb.kml").write_text(text)
    aoi = polygons(tmp_path / "area.gpkg", CRS, [box(0.0, 0.0, 9.0, 9.0)])
    before = sorted(p.name for p in tmp_path.iterdir())
    assert len(read_shapes(aoi).geometries) == 1
    assert sorted(p.name for p in tmp_path.iterdir()) == before, "SQLite has put nothing next to it"
    (tmp_path / "area.gpkg-wal").write_bytes(b"log")
    for file, problem in (
        (tmp_path / "bomb.kml", "can't be read"),
        (aoi, "is being written by another program"),
        (Path("/vsicurl/http://127.0.0.1/a.gpkg"), "no file on this machine"),
        (tmp_path, "is no regular file but a folder"),
    ):
        with pytest.raises(InputError, match=problem):
            read_shapes(file)


def test_an_area_that_crosses_itself_is_corrected_and_reported(tmp_path: Path, flown: Any) -> None:
    given, (_, _, whole, _) = flown
    (w, s), _, (e, n), _ = around(whole, -8.0, -8.0, 8.0, 8.0)
    aoi = polygons(tmp_path / "bow.gpkg", CRS, [[(w, s), (e, n), (e, s), (w, n)]])
    owned, notes = seams(tmp_path, given, aoi=aoi)
    assert [x["code"] for x in notes.warnings] == ["aoi-corrected"]
    assert owned.area is not None and owned.area.geometry.area == pytest.approx(128.0, rel=1e-6)


QUICK = ("--adjust", "least_squares", "--ground-height", 520)


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> SimulatedSurvey:
    """Four frames in a line."""
    folder = tmp_path_factory.mktemp("simulated")
    return small_survey(folder, lines=1, frames_per_line=4, width_px=320, height_px=240)


@pytest.mark.proof
def test_the_command_cuts_follows_the_file_and_can_be_replayed(
    simulated: SimulatedSurvey, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    options = (
        simulated.frames,
        tmp_path / "run",
        "--pos",
        simulated.pos,
        "--camera",
        simulated.camera,
        *QUICK,
    )
    assert mosaic(*options) == 0
    with rasterio.open(tmp_path / "run" / "mosaic.tif") as tiff:
        crs, (west, south, east, north) = tiff.crs.to_string(), tiff.bounds
    x, y = round((west + east) / 2.0), round((south + north) / 2.0)
    aoi = tmp_path / "area.geojson"
    sizes, wanted = [], []
    for side in (4.0, 6.0):
        left_m, top_m = np.floor((x - side) / 1.6) * 1.6, np.ceil((y + 5.0) / 1.6) * 1.6
        wanted.append((round((x + side - left_m) / 0.1), round((top_m - y + side) / 0.1)))
        aoi.unlink(missing_ok=True)
        polygons(aoi, crs, [box(x - side, y - side, x + side, y + 5.0)])
        capfd.readouterr()
        assert mosaic(*options, "--aoi", aoi) == 0
        said = capfd.readouterr().err
        assert "Place the seamlines: unchanged" not in said and said.count("from the cache") >= 5
        sizes.append(
            (summary(tmp_path / "run")["mosaic"]["width"], summary(tmp_path / "run")["mosaic"]["height"])
        )
    assert sizes == wanted, "tenths of a metre, from whole cells of 16 on"
    assert geomosaic("replay", tmp_path / "run", "--from", "mosaic.seams", "-o", tmp_path / "again") == 0
    assert geomosaic("replay", tmp_path / "run", "--from", "mosaic.compose", "-o", tmp_path / "later") == 0
    for folder in ("again", "later"):
        assert (tmp_path / folder / "mosaic.tif").read_bytes() == (tmp_path / "run/mosaic.tif").read_bytes()
    far = polygons(tmp_path / "far.gpkg", crs, [box(x + 5000.0, y, x + 5010.0, y + 10.0)])
    capfd.readouterr()
    assert mosaic(*options, "--aoi", far) == 2
    assert "the frames show no part of the area" in capfd.readouterr().err.splitlines()[-1]


def raster(path: Path, crs: str | None, transform: Affine, width: int = 40, height: int = 30) -> Path:
    """An empty GeoTIFF."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        placed = {} if transform.is_identity else {"transform": transform}
        shape = {"width": width, "height": height, "count": 1, "dtype": "uint8"}
        with rasterio.open(path, "w", driver="GTiff", crs=crs, **shape, **placed):
            return path


def test_a_mosaic_aligned_to_a_raster_shares_its_pixels(tmp_path: Path, flown: Any) -> None:
    """Last year's, 3 km to the west, whose corner lies at no multiple of its pixel."""
    given, _ = flown
    west, north = 550_123.4567, 5_232_765.4321
    old = raster(tmp_path / "old.tif", CRS, Affine(0.3, 0.0, west, 0.0, -0.3, north))
    pixels, mask, grid, _ = written(tmp_path, given, align_to=old)
    off = (grid.west_m - west) / 0.3, (north - grid.north_m) / 0.3
    assert off == pytest.approx([round(o) for o in off], abs=1e-5) and off[0] > 9000
    assert (grid.gsd_m, grid.crs) == (0.3, CRS)
    east = grid.west_m + (np.arange(grid.width_px) + 0.5) * 0.3
    rows = grid.north_m - (np.arange(grid.height_px) + 0.5) * 0.3
    wanted = truth(*np.meshgrid(east, rows))
    assert np.quantile(np.abs(pixels[mask] - wanted[mask]), 0.95) < 3.0, "the ground is where it is"
    assert seams(tmp_path, given, align_to=old, gsd_m=0.3)[0].grid == grid


def test_rasters_that_no_mosaic_can_align_to_are_refused_with_the_fix(tmp_path: Path, flown: Any) -> None:
    given, _ = flown
    north_up = Affine(0.3, 0.0, 550_000.0, 0.0, -0.3, 5_232_000.0)
    turned = Affine(0.3, 0.01, 550_000.0, 0.01, -0.3, 5_232_000.0)
    upside_down = Affine(0.3, 0.0, 550_000.0, 0.0, 0.3, 5_232_000.0)
    wide = Affine(0.3, 0.0, 550_000.0, 0.0, -0.2, 5_232_000.0)
    degrees = Affine(1e-6, 0.0, 9.7, 0.0, -1e-6, 47.2)
    for crs, transform, params, problem in (
        (CRS, turned, {}, r"turned or upside down.*gdalwarp -t_srs EPSG:32632"),
        (CRS, upside_down, {}, "turned or upside down"),
        (CRS, wide, {}, r"pixels of 0.3 x 0.2 m, no squares; .*gdalwarp -tr 0.3 0.3"),
        ("EPSG:4326", degrees, {}, r"is in EPSG:4326, no map projection in metres; .*-t_srs EPSG:32632"),
        ("EPSG:2263", north_up, {}, r"is in EPSG:2263, no map projection in metres; .*-t_srs EPSG:326\d\d"),
        (None, north_up, {}, r"has no place on the map; .*gdal_edit.py -a_srs"),
        (CRS, Affine.identity(), {}, r"has no place on the map"),
        ("EPSG:32633", north_up, {}, r"is in EPSG:32633, but the mosaic in EPSG:32632; leave out --crs"),
        (CRS, north_up, {"gsd_m": 0.25}, r"pixels of 0.3 m, but --gsd asks for 0.25 m; leave out --gsd"),
    ):
        file = raster(tmp_path / "raster.tif", crs, transform)
        with pytest.raises(InputError, match=problem) as caught:
            seams(tmp_path, given, align_to=file, **params)
        assert str(file) in str(caught.value) and caught.value.exit_code == 2


@pytest.mark.proof
def test_the_command_aligns_to_a_raster_of_another_crs(
    simulated: SimulatedSurvey, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """In the next UTM zone, where the survey's east is not the grid's; layers and positions are there too."""
    old = raster(tmp_path / "old.tif", "EPSG:32633", Affine(0.2, 0.0, 12_345.67, 0.0, -0.2, 5_100_000.07))
    options_here = (
        simulated.frames,
        tmp_path / "run",
        "--pos",
        simulated.pos,
        "--camera",
        simulated.camera,
        *QUICK,
    )
    for wrong, both in (
        (("--crs", "EPSG:32632"), ("EPSG:32633", "EPSG:32632")),
        (("--gsd", 0.1), ("0.2 m", "0.1 m")),
    ):
        assert mosaic(*options_here, "--align-to", old, *wrong) == 2
        (line,) = [x for x in capfd.readouterr().err.splitlines() if "old.tif" in x]
        assert all(word in line for word in both)
    assert mosaic(*options_here, "--align-to", old, "--crs", "EPSG:32633") == 0
    with rasterio.open(tmp_path / "run" / "mosaic.tif") as tiff:
        assert tiff.crs.to_string() == "EPSG:32633" and tiff.transform.a == 0.2
        off = (tiff.transform.c - 12_345.67) / 0.2, (tiff.transform.f - 5_100_000.07) / 0.2
        bounds = tiff.bounds
    assert off == pytest.approx([round(o) for o in off], abs=1e-5)
    with (tmp_path / "run" / "positions.csv").open() as file:
        for row in csv.DictReader(file):
            assert bounds.left < float(row["easting_m"]) < bounds.right
    capfd.readouterr()
    assert mosaic(*options_here, "--align-to", old) == 0
    assert "Place the seamlines: unchanged, from the cache" in capfd.readouterr().err
    recipe = tmp_path / "run.yaml"
    stages = "\n".join(f"  - {stage}" for stage in STAGES if stage not in OPTIONAL)
    recipe.write_text(f"stages:\n{stages}\n")
    sets = [f"survey.read.pos={simulated.pos}", f"survey.read.camera={simulated.camera}",
            "adjustment.solve.method=least_squares", "projection.ground.height_m=520"]  # fmt: skip
    options = [x for s in sets for x in ("--set", s)]
    run = (
        "run",
        recipe,
        "-o",
        tmp_path / "recipe",
        "--frames",
        simulated.frames,
        "--align-to",
        old,
        *options,
    )
    assert geomosaic(*run, "--workers", 1) == 0
    assert (tmp_path / "recipe/mosaic.tif").read_bytes() == (tmp_path / "run/mosaic.tif").read_bytes()
