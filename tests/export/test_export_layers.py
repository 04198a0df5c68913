"""positions.csv and layers.gpkg, read back by others' readers."""

from __future__ import annotations

import csv
import re
import shutil
import sqlite3
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pyogrio
import pytest
import shapely
from mosaic_scenes import CAMERA, CRS, GSD_M, HOME, make_survey
from osgeo import gdal, ogr
from osgeo_utils.samples import validate_gpkg

from geomosaic.adjustment.model import Adjusted
from geomosaic.camera.exterior import Poses
from geomosaic.camera.rotation import Rotation
from geomosaic.composition.compose import compose
from geomosaic.composition.grid import output_grid
from geomosaic.composition.model import MapPixels
from geomosaic.composition.ownership import by_nearest_nadir
from geomosaic.composition.raster import MosaicFiles
from geomosaic.composition.views import PosedFrames, frame_views
from geomosaic.export import residual_layers
from geomosaic.export.geopackage import MapFeatures, write_geopackage
from geomosaic.export.layers import SolvedSurvey, write_layers
from geomosaic.export.orientation import orientations
from geomosaic.export.positions import COLUMNS, write_positions
from geomosaic.geodesy.local import LocalFrame
from geomosaic.geodesy.mapcrs import MapProjection
from geomosaic.matching.model import TiePair, TiePoints
from geomosaic.placement.model import Placement
from geomosaic.projection.footprint import ground_from_image
from geomosaic.projection.ground import flat_ground
from geomosaic.quality.positions import read_poses
from geomosaic.survey.model import Attitude, Frame, Position, Survey
from geomosaic.survey.pos import read_pos

CONTRACT = (
    "frame status lon_deg lat_deg height_ellipsoidal_m easting_m northing_m yaw_deg pitch_deg roll_deg "
    "omega_deg phi_deg kappa_deg sd_e_m sd_n_m sd_u_m sd_omega_deg sd_phi_deg sd_kappa_deg moved_m turned_deg"
)


def one_frame(lon: float, lat: float, yaw_deg: float, pitch_deg: float, roll_deg: float):
    """A frame 6 km east of the work frame's origin with known angles in its own axes."""
    home = LocalFrame(9.7, 47.2, 0.0)
    local = Rotation.from_yaw_pitch_roll(*np.radians([yaw_deg, pitch_deg, roll_deg])).matrix
    position = home.enu_from_geodetic(lon, lat, 812.5)[None]
    work = (home.enu_from_local_rotation(lon, lat) @ local)[None]
    poses = Poses(position, work, np.array([[0.3, 0.4, 0.9]]), np.radians([[0.02, 0.03, 0.05]]))
    frame = Frame(
        'a,"b.jpg', "/x", 240, 180, 3, "uint8", "cam",
        Position(lon, lat, 800.0, None, 1.0, 1.0, 1.0, "t"), Attitude(None, None, None, 1.0, 1.0, "t"),
    )  # fmt: skip
    survey = Survey((frame,), (CAMERA,), home, "EPSG:32632")
    turned = Rotation.from_yaw_pitch_roll(*np.radians([yaw_deg - 2.5, 0.0, 0.0])).matrix
    prior = Poses(
        position - [[3.0, 4.0, 12.0]],
        (home.enu_from_local_rotation(lon, lat) @ turned)[None],
        np.ones((1, 3)),
        np.full((1, 3), 0.1),
    )
    adjusted = Adjusted(poses, (CAMERA,), ("tied",), (), (), flat_ground(home, 400.0, 9000.0))
    return survey, prior, adjusted


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_positions_csv_holds_the_contract(tmp_path):
    survey, prior, adjusted = one_frame(9.78, 47.23, 37.0, 0.0, 0.0)
    write_positions(tmp_path / "p.csv", orientations(survey, prior, adjusted))
    assert (tmp_path / "p.csv").read_text().splitlines()[0] == CONTRACT.replace(" ", ",")
    assert tuple(CONTRACT.split()) == COLUMNS
    row = rows(tmp_path / "p.csv")[0]
    number = {k: float(v) for k, v in row.items() if k not in ("frame", "status")}
    assert (row["frame"], row["status"]) == ('a,"b.jpg', "tied")
    assert (number["lon_deg"], number["lat_deg"]) == pytest.approx((9.78, 47.23), abs=1e-9)
    assert number["height_ellipsoidal_m"] == pytest.approx(812.5, abs=1e-4)
    easting, northing = MapProjection("EPSG:32632").map_from_geodetic(9.78, 47.23)
    assert (number["easting_m"], number["northing_m"]) == pytest.approx((easting, northing), abs=1e-4)
    assert (number["yaw_deg"], number["pitch_deg"]) == pytest.approx((37.0, -90.0), abs=1e-5)
    assert number["roll_deg"] == pytest.approx(0.0, abs=1e-5)
    # Convergence 0.78 deg * sin(47.23 deg) = 0.5726 deg, to its first order; grid azimuth = 37 - 0.5726.
    assert number["kappa_deg"] == pytest.approx(-(37.0 - 0.5727), abs=2e-4)
    assert (number["omega_deg"], number["phi_deg"]) == pytest.approx((0.0, 0.0), abs=1e-5)
    assert number["moved_m"] == pytest.approx(13.0, abs=1e-4)
    assert number["turned_deg"] == pytest.approx(2.5, abs=1e-4)
    assert number["sd_u_m"] == pytest.approx(0.9, abs=1e-4)
    assert number["sd_e_m"] == pytest.approx(0.3, abs=1e-3)
    assert number["sd_kappa_deg"] == pytest.approx(0.05, abs=1e-4)


def test_nobody_turned_a_frame_whose_heading_nobody_reported(tmp_path):
    survey, prior, adjusted = one_frame(9.78, 47.23, 37.0, 0.0, 0.0)
    prior = replace(prior, rotations_sd_rad=np.ones((1, 3)))
    write_positions(tmp_path / "p.csv", orientations(survey, prior, adjusted))
    row = rows(tmp_path / "p.csv")[0]
    assert row["turned_deg"] == "" and float(row["moved_m"]) == pytest.approx(13.0)


def test_pitch_and_roll_are_those_of_the_frames_own_vertical(tmp_path):
    survey, prior, adjusted = one_frame(9.95, 47.1, 200.0, 4.0, -3.0)
    o = orientations(survey, prior, adjusted)
    assert o.yaw_pitch_roll_deg[0] == pytest.approx([200.0, -86.0, -3.0], abs=1e-9)
    raw = Rotation(adjusted.poses.rotations).yaw_pitch_roll()[1]
    assert abs(np.degrees(raw[0]) - 4.0) > 0.03, "19 km away the work frame's vertical is another"


def test_omega_phi_kappa_sd_follow_the_angles():
    """At kappa = 90 deg and no tilt omega is still about east, phi about north."""
    survey, prior, adjusted = one_frame(9.7, 47.2, -90.0, 0.0, 0.0)
    o = orientations(survey, prior, adjusted)
    assert o.sd_omega_phi_kappa_deg[0] == pytest.approx([0.02, 0.03, 0.05], rel=1e-3)
    assert o.omega_phi_kappa_deg[0, 2] == pytest.approx(90.0 + 0.5136, abs=1e-3)


def test_unknown_deviations_are_empty_cells(tmp_path):
    survey, prior, adjusted = one_frame(9.7, 47.2, 10.0, 1.0, 2.0)
    poses = adjusted.poses
    unsure = Poses(
        poses.positions_m, poses.rotations, np.array([[0.3, 0.4, np.inf]]), np.full((1, 3), np.nan)
    )
    unsure = Adjusted(unsure, (CAMERA,), ("placed",), (), (), adjusted.ground)
    write_positions(tmp_path / "p.csv", orientations(survey, prior, unsure))
    row = rows(tmp_path / "p.csv")[0]
    assert (row["sd_u_m"], row["sd_omega_deg"], row["sd_phi_deg"], row["sd_kappa_deg"]) == ("", "", "", "")
    assert float(row["sd_e_m"]) == pytest.approx(0.3, abs=1e-3)
    assert "nan" not in (tmp_path / "p.csv").read_text()


@pytest.fixture(scope="module")
def package(tmp_path_factory):
    """A GeoPackage of six frames, two tied pairs whose residual is 0.3 m east, 0.4 m south."""
    folder = tmp_path_factory.mktemp("layers")
    survey, poses, ground = make_survey(folder / "frames")
    frames = PosedFrames(survey, poses, [CAMERA] * 6, [True] * 6, ground)
    views = frame_views(frames, CRS)
    grid = output_grid(MapPixels(CRS, GSD_M), views, [f.name for f in survey.frames])
    mosaic = compose(frames, by_nearest_nadir(frames, grid), MosaicFiles(folder / "raw.tif"))
    pixels = np.array([[50.5, 60.5], [120.25, 90.75], [200.0, 20.0]])
    number = np.arange(3, dtype=np.int32)
    pairs = tuple(TiePair(a, b, pixels, pixels + 7.0, number, number) for a, b in ((0, 1), (2, 5)))
    residuals = (np.tile([0.3, -0.4], (3, 1)),) * 2
    adjusted = Adjusted(
        poses, (CAMERA,) * 6, ("tied", "tied", "tied", "placed", "placed", "tied"), (), residuals, ground
    )
    placement = Placement(poses, (5, 4, 3, 2, 1, 0), (0, 0, 0, 1, 1, 1), ((0, 1), (2, 5)), 0.25, "rigorous")
    arguments = (survey, placement, TiePoints(pairs), adjusted, mosaic)
    write_layers(folder / "layers.gpkg", SolvedSurvey(*arguments))
    return folder / "layers.gpkg", arguments


def test_every_layer_has_its_crs_and_spatial_index(package):
    path, _ = package
    validate_gpkg.check(str(path), abort_at_first_error=True)
    dataset = ogr.Open(str(path))
    names = {dataset.GetLayer(i).GetName(): dataset.GetLayer(i) for i in range(dataset.GetLayerCount())}
    counts = {name: layer.GetFeatureCount() for name, layer in names.items()}
    assert counts == {
        "frames": 6, "footprints": 6, "nadir_points": 6, "error_ellipses": 6, "tie_points": 6,
        "residuals": 6, "image_residuals": 0, "control": 0, "control_residuals": 0, "seamlines": 6,
        "moves": 6, "trimmed": 0, "layer_styles": 12,
    }  # fmt: skip
    del names["layer_styles"]
    for name, layer in names.items():
        assert layer.GetSpatialRef().GetAuthorityCode(None) == "32632", name
    with sqlite3.connect(path) as db:
        indexed = {
            t
            for (t,) in db.execute(
                "SELECT table_name FROM gpkg_extensions WHERE extension_name='gpkg_rtree_index'"
            )
        }
    assert indexed == set(names)


def test_frames_say_where_and_how(package):
    path, (_survey, _, _, adjusted, _) = package
    dataset = ogr.Open(str(path))
    feature = dataset.GetLayer("frames").GetFeature(4)
    assert feature["frame"] == "frame 03.tif"
    assert (feature["status"], feature["flight_line"], feature["sequence"]) == ("placed", 1, 2)
    assert feature["source_index"] == 4
    assert feature.GetFieldDefnRef("time_utc").GetType() == ogr.OFTDateTime
    assert feature["time_utc"] == "2023/11/14 22:13:26+00"
    lon, lat, height = HOME.geodetic_from_enu(adjusted.poses.positions_m[3])
    assert (feature["lon_deg"], feature["lat_deg"]) == pytest.approx((lon, lat), abs=1e-10)
    geometry = feature.GetGeometryRef()
    assert (geometry.GetX(), geometry.GetY()) == pytest.approx(
        tuple(MapProjection(CRS).map_from_geodetic(lon, lat)), abs=1e-6
    )
    assert geometry.GetZ() == pytest.approx(height, abs=1e-6)
    assert feature["sd_e_m"] == pytest.approx(0.7, abs=0.01)


def test_arrows_run_from_the_given_to_the_adjusted_position(package, tmp_path):
    _, (survey, placement, ties, adjusted, mosaic) = package
    prior = replace(placement.poses, positions_m=placement.poses.positions_m - [3.0, -4.0, 1.5])
    write_layers(
        tmp_path / "l.gpkg", SolvedSurvey(survey, replace(placement, poses=prior), ties, adjusted, mosaic)
    )
    dataset = ogr.Open(str(tmp_path / "l.gpkg"))
    feature = dataset.GetLayer("moves").GetFeature(1)
    # The work frame's north is turned by the convergence (0.52 deg) against the grid's.
    expected = [3.0 + 4.0 * 0.0091, -4.0 + 3.0 * 0.0091, 1.5]
    assert [feature[f"moved_{axis}_m"] for axis in "enu"] == pytest.approx(expected, abs=3e-3)
    (start, end) = feature.GetGeometryRef().GetPoints()
    assert np.subtract(end, start) == pytest.approx(expected[:2], abs=3e-3)


def test_rejected_frames_without_a_position_are_nowhere(package, tmp_path):
    """The last two, which are tied to each other alone, lie in no layer; without a position but tied to
    others, the second frame has a place."""
    _, (survey, placement, ties, adjusted, mosaic) = package
    sd_m = placement.poses.positions_sd_m.copy()
    sd_m[[1, 4, 5]] = 1e5
    placement = replace(placement, poses=replace(placement.poses, positions_sd_m=sd_m))
    status = ("tied", "tied", "rejected", "tied", "rejected", "rejected")
    adjusted = replace(adjusted, status=status)
    ties = replace(ties, pairs=(ties.pairs[0], replace(ties.pairs[1], left=4, right=5)))
    o = orientations(survey, placement.poses, adjusted)
    assert o.placed.tolist() == [True, True, True, True, False, False]
    write_positions(tmp_path / "p.csv", o)
    place = (*COLUMNS[2:7], *COLUMNS[13:16], "moved_m")
    assert place[4:7] == ("northing_m", "sd_e_m", "sd_n_m")
    unknown = [[row[name] == "" for name in place] for row in rows(tmp_path / "p.csv")]
    assert unknown[2] == [False] * 9 and unknown[4] == unknown[5] == [True] * 9
    assert unknown[1] == [False] * 5 + [True, True, False, True]
    names = [f.name for f in survey.frames]
    assert [row.name for row in read_pos(tmp_path / "p.csv").rows] == names[:4]
    read_back = read_poses(tmp_path / "p.csv", names[:4], HOME).positions_m
    assert np.abs(read_back - adjusted.poses.positions_m[:4]).max() < 1e-3
    write_layers(tmp_path / "l.gpkg", SolvedSurvey(survey, placement, ties, adjusted, mosaic))
    dataset = ogr.Open(str(tmp_path / "l.gpkg"))
    for name in ("frames", "footprints", "nadir_points"):
        shown = [feature.GetGeometryRef() is not None for feature in dataset.GetLayer(name)]
        assert shown == [True, True, True, True, False, False], name
    assert dataset.GetLayer("frames").GetFeature(5)["gsd_m"] is None
    assert dataset.GetLayer("nadir_points").GetFeature(5)["height_above_ground_m"] is None
    for name in ("tie_points", "residuals"):
        assert [feature["left_frame"] for feature in dataset.GetLayer(name)] == ["frame 00.tif"] * 3
    assert [feature["frame"] for feature in dataset.GetLayer("error_ellipses")] == [
        f"frame 0{k}.tif" for k in (0, 2, 3)
    ]


def test_layers_bring_their_styles(package, tmp_path):
    _, (survey, placement, ties, adjusted, mosaic) = package
    prior = replace(placement.poses, positions_m=placement.poses.positions_m - [0.3, -0.4, 0.0])
    write_layers(
        tmp_path / "l.gpkg", SolvedSurvey(survey, replace(placement, poses=prior), ties, adjusted, mosaic)
    )
    dataset = ogr.Open(str(tmp_path / "l.gpkg"))
    rows = {row["f_table_name"]: row for row in dataset.GetLayer("layer_styles")}
    assert rows.keys() == {dataset.GetLayer(i).GetName() for i in range(12)} - {"layer_styles"}
    assert {row["useAsDefault"] for row in rows.values()} == {1}
    fill = ElementTree.fromstring(rows["footprints"]["styleQML"]).find(".//layer[@class='SimpleFill']/Option")
    assert {o.get("name"): o.get("value") for o in fill}["style"] == "no", "the mosaic is seen through it"
    moved = rows["moves"]
    (larger,) = re.findall(r"positions, (\d+) times larger", moved["description"])
    (drawn,) = (o.get("value") for o in ElementTree.fromstring(moved["styleQML"]).iter("Option")
                if o.get("name") == "geometryModifier")  # fmt: skip
    assert f"+ {larger} *" in drawn


def test_residuals_run_from_left_to_right_true_to_scale(package):
    path, (_survey, _, ties, adjusted, _) = package
    dataset = ogr.Open(str(path))
    feature = dataset.GetLayer("residuals").GetFeature(5)
    assert (feature["left_frame"], feature["right_frame"]) == ("frame 02.tif", "frame 05.tif")
    assert feature["residual_m"] == pytest.approx(0.5, abs=1e-3)
    line = feature.GetGeometryRef()
    ground = ground_from_image(adjusted.poses[2], CAMERA, adjusted.ground, ties.pairs[1].left_px[1])
    geodetic = HOME.geodetic_from_enu(ground)
    start = MapProjection(CRS).map_from_geodetic(geodetic[0], geodetic[1])
    assert line.GetPoint_2D(0) == pytest.approx(tuple(start), abs=1e-3)
    # The work frame's north is turned by the convergence (0.52 deg) against the grid's.
    d_east, d_north = np.subtract(line.GetPoint_2D(1), line.GetPoint_2D(0))
    assert (d_east, d_north) == pytest.approx((0.3 + 0.4 * 0.0091, -0.4 + 0.3 * 0.0091), abs=2e-4)


def test_equal_data_give_equal_bytes(package, tmp_path):
    path, arguments = package
    write_layers(tmp_path / "again.gpkg", SolvedSurvey(*arguments))
    assert (tmp_path / "again.gpkg").read_bytes() == path.read_bytes()


def test_of_too_many_tie_points_every_pair_keeps_its_share_and_the_layer_says_so(
    package, tmp_path, monkeypatch
):
    _, arguments = package
    monkeypatch.setattr(residual_layers, "MOST_POINTS", 4)
    write_layers(tmp_path / "thin.gpkg", SolvedSurvey(*arguments))
    dataset = ogr.Open(str(tmp_path / "thin.gpkg"))
    for name in ("tie_points", "residuals"):
        layer = dataset.GetLayer(name)
        assert [f["left_frame"] for f in layer] == ["frame 00.tif"] * 2 + ["frame 02.tif"] * 2
        assert layer.GetMetadataItem("DESCRIPTION").endswith(": 4 of 6, evenly thinned")
    whole = ogr.Open(str(package[0]))
    assert whole.GetLayer("tie_points").GetMetadataItem("DESCRIPTION") == "Tie points on the ground"
    monkeypatch.setattr(residual_layers, "MOST_A_FRAME", 0)
    write_layers(tmp_path / "none.gpkg", SolvedSurvey(*arguments))
    none = ogr.Open(str(tmp_path / "none.gpkg"))
    assert none.GetLayer("tie_points").GetMetadataItem("DESCRIPTION").endswith(": 0 of 6, evenly thinned")


@pytest.fixture(scope="module")
def many(tmp_path_factory):
    """20,000 points, every hundredth unknown: a spatial index of three levels."""
    path = tmp_path_factory.mktemp("many") / "many.gpkg"
    at = np.random.default_rng(3).uniform(0.0, 300.0, (20_000, 2)) + [553_000.0, 5_231_000.0]
    at[:40] = at[0]
    points = [None if i % 100 == 7 else p for i, p in enumerate(shapely.points(at))]
    layer = MapFeatures("points", "Some", "Point", points, {"number": np.arange(20_000)})
    write_geopackage(path, CRS, None, [layer])
    at[7::100] = np.nan
    return path, at


def test_the_spatial_index_is_whole_and_finds_what_lies_there(many):
    path, at = many
    with sqlite3.connect(path) as db:
        assert db.execute("SELECT rtreecheck('main', 'rtree_points_geom')").fetchone() == ("ok",)
        (root,) = db.execute("SELECT data FROM rtree_points_geom_node WHERE nodeno = 1").fetchone()
        assert root[:2] == b"\x00\x02"
        for west, east, south, north in ((553_100, 553_101.5, 5_231_050, 5_231_290), (0, 1, 2, 3)):
            found = db.execute(
                "SELECT id - 1 FROM rtree_points_geom WHERE maxx >= ? AND minx <= ? AND maxy >= ? AND miny <= ?",
                (west, east, south, north),
            ).fetchall()
            inside = (at > [west, south]).all(axis=1) & (at < [east, north]).all(axis=1)
            near = (at > [west - 0.1, south - 1]).all(axis=1) & (at < [east + 0.1, north + 1]).all(axis=1)
            assert set(np.flatnonzero(inside)) <= {i for (i,) in found} <= set(np.flatnonzero(near))
    dataset = ogr.Open(str(path))
    layer = dataset.GetLayer("points")
    assert (layer.GetFeatureCount(), layer.GetFeature(8).GetGeometryRef()) == (20_000, None)
    assert layer.GetExtent() == pytest.approx(
        (*np.nanmin(at, 0)[:1], *np.nanmax(at, 0)[:1], *np.nanmin(at, 0)[1:], *np.nanmax(at, 0)[1:]), abs=1e-6
    )


def test_a_gis_may_edit_the_layer(many, tmp_path):
    """The triggers that keep index and count are there."""
    path = shutil.copy(many[0], tmp_path / "edited.gpkg")
    dataset = ogr.Open(str(path), 1)
    layer = dataset.GetLayer("points")
    feature = ogr.Feature(layer.GetLayerDefn())
    feature.SetGeometry(ogr.CreateGeometryFromWkt("POINT (553900.5 5231900.25)"))
    layer.CreateFeature(feature)
    layer.DeleteFeature(1)
    del feature, layer, dataset
    dataset = ogr.Open(str(path))
    layer = dataset.GetLayer("points")
    layer_count = layer.GetFeatureCount()
    layer.SetSpatialFilterRect(553_800, 5_231_800, 554_000, 5_232_000)
    assert (layer_count, [f.GetFID() for f in layer]) == (20_000, [20_001])
    validate_gpkg.check(str(path), abort_at_first_error=True)


def test_names_are_data(package, tmp_path):
    _, (survey, placement, ties, adjusted, mosaic) = package
    evil = "x'); DROP TABLE frames;--\u00e9\".jpg"
    frames = (replace(survey.frames[0], name=evil), *survey.frames[1:])
    write_layers(
        tmp_path / "l.gpkg", SolvedSurvey(replace(survey, frames=frames), placement, ties, adjusted, mosaic)
    )
    dataset = ogr.Open(str(tmp_path / "l.gpkg"))
    assert dataset.GetLayer("frames").GetFeature(1)["frame"] == evil


def test_no_ties_at_all_still_gives_every_layer(package, tmp_path):
    _, (survey, placement, _, adjusted, mosaic) = package
    alone = replace(adjusted, residuals_m=())
    write_layers(
        tmp_path / "l.gpkg",
        SolvedSurvey(survey, placement, TiePoints(()), alone, replace(mosaic, seamlines=())),
    )
    dataset = ogr.Open(str(tmp_path / "l.gpkg"))
    assert dataset.GetLayerCount() == 13
    assert dataset.GetLayer("tie_points").GetFeatureCount() == 0


def test_accuracy_stands_in_the_metadata_with_equal_bytes(tmp_path: Path) -> None:
    """As GIS show it of the file; written at another time it is the same file."""
    said = {"verdict": "good: 5 of 5 frames tied", "absolute accuracy": "horizontal RMSE 3.6 m"}
    files = [tmp_path / name for name in ("a.gpkg", "b.gpkg")]
    layer = MapFeatures("place", "One.", "Point", [shapely.Point(1.0, 2.0)], {"x": [1]}, metadata=said)
    for path in files:
        write_geopackage(path, "EPSG:32632", 1e9, [layer])
    opened = gdal.OpenEx(str(files[0]), gdal.OF_VECTOR)
    kept = opened.GetLayerByName("place").GetMetadata()
    assert {name: kept[name] for name in said} == said
    assert pyogrio.list_layers(files[1]).shape == (1, 2)
    assert files[0].read_bytes() == files[1].read_bytes()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.gpkg", "b.gpkg"]
