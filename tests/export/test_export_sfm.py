"""The adjusted block for other programs, read back by their own readers or by formulas of their manuals."""

from __future__ import annotations

import csv
import json
from dataclasses import replace

import cv2
import numpy as np
import pycolmap
import pytest
from pipeline_toy import recipe_of
from pyproj import CRS, Transformer
from scipy.spatial.transform import Rotation as Turn
from solved_block import ALONE, solved_block

from geomosaic.camera.rotation import Rotation
from geomosaic.export.references import write_odm_control
from geomosaic.pipeline.run_folder import RunFolder
from geomosaic.pipeline.single_stage import StageInputs, run_stage
from geomosaic.stages.exports_of_block import (
    export_colmap,
    export_metashape,
    export_odm,
    export_opensfm,
    export_pix4d,
)
from geomosaic.survey.pos import read_pos


@pytest.fixture(scope="module")
def solved():
    return solved_block()


@pytest.fixture(scope="module")
def run(solved, tmp_path_factory):
    folder = tmp_path_factory.mktemp("sfm")
    for stage in (export_colmap, export_opensfm, export_metashape, export_pix4d, export_odm):
        inputs = {name: getattr(solved, name) for name in stage.inputs}
        run_stage(
            recipe_of(stage, stage.Params()),
            StageInputs(RunFolder(folder / "RUN"), inputs),
            work_folder=folder / "work",
        )
    return folder / "RUN"


def test_colmap_reads_cameras_poses_and_points(solved, run):
    model = pycolmap.Reconstruction(run / "colmap")
    assert model.num_images() == 8
    (camera,) = model.cameras.values()
    images = {image.name: image for image in model.images.values()}
    adjusted = solved.adjusted
    for i, frame in enumerate(solved.survey.frames):
        image = images[frame.name]
        assert image.projection_center() == pytest.approx(adjusted.poses.positions_m[i], abs=1e-6)
        ground = adjusted.poses.positions_m[i] + [7.0, -4.0, -90.0]
        expected = adjusted.poses[i].image_from_ground(adjusted.cameras[i], ground)
        in_camera = image.cam_from_world() * ground
        assert camera.img_from_cam(in_camera) == pytest.approx(expected, abs=1e-4)
    assert images[solved.survey.frames[ALONE].name].num_points3D == 0
    assert model.num_points3D() > 100
    reported = np.array([point.error for point in model.points3D.values()])
    model.update_point_3d_errors()
    found = np.array([point.error for point in model.points3D.values()])
    assert np.median(found) < 0.6, "the observations have 0.3 px of noise"
    assert np.corrcoef(reported, found)[0, 1] > 0.9


def test_opensfm_projects_as_we_do(solved, run):
    """By OpenCV, with OpenSfM's geometric models: shares of the longer side from the middle."""
    (whole,) = json.loads((run / "opensfm" / "reconstruction.json").read_text())
    assert set(whole) == {"cameras", "shots", "points", "reference_lla"}
    lon, lat, height = (whole["reference_lla"][k] for k in ("longitude", "latitude", "altitude"))
    assert (lon, lat, height) == (11.5, 48.1, 520.0)
    rows = list(csv.DictReader((run / "opensfm" / "tracks.csv").read_text().splitlines()[1:], delimiter="\t",
                               fieldnames=["image", "track", "feature", "x", "y", "scale", "r", "g", "b", "segm", "inst"]))  # fmt: skip
    for name, shot in whole["shots"].items():
        of = whole["cameras"][shot["camera"]]
        matrix = np.array([[of["focal_x"], 0, of["c_x"]], [0, of["focal_y"], of["c_y"]], [0, 0, 1.0]])
        lens = np.array([of[k] for k in ("k1", "k2", "p1", "p2", "k3")])
        mine = [row for row in rows if row["image"] == name]
        if not mine:
            assert name == solved.survey.frames[ALONE].name
            continue
        points = np.array([whole["points"][row["track"]]["coordinates"] for row in mine])
        projected, _ = cv2.projectPoints(
            points, np.array(shot["rotation"]), np.array(shot["translation"]), matrix, lens
        )
        seen = np.array([(float(row["x"]), float(row["y"])) for row in mine])
        off = np.linalg.norm(projected[:, 0] - seen, axis=1) * max(of["width"], of["height"])
        assert np.median(off) < 0.6, "in pixels; the observations have 0.3 px of noise"


def test_metashapes_angles_turn_the_camera_as_ours(solved, run):
    rows = list(csv.reader((run / "metashape.csv").read_text().splitlines()))
    assert rows[0][:4] == ["#Label", "X/Longitude", "Y/Latitude", "Z/Altitude"]
    adjusted, frame = solved.adjusted, solved.survey.work_frame
    for i, row in enumerate(rows[1:]):
        lon, lat, height = map(float, row[1:4])
        assert frame.enu_from_geodetic(lon, lat, height) == pytest.approx(
            adjusted.poses.positions_m[i], abs=1e-3
        )
        # Body (forward, right, down) to north, east, down; the camera's right is the body's, its top forward.
        body = Turn.from_euler("ZYX", [float(v) for v in row[6:9]], degrees=True).as_matrix()
        right, top = (body @ axis for axis in ([0.0, 1.0, 0.0], [1.0, 0.0, 0.0]))
        enu = np.array([[right[1], right[0], -right[2]], [top[1], top[0], -top[2]]])
        assert enu == pytest.approx(adjusted.poses.rotations[i].T[:2], abs=1e-5)
        assert float(row[4]) > 0.0
        assert float(row[5]) > 0.0


def test_pix4ds_angles_are_relative_to_the_grid(solved, run):
    rows = list(csv.reader((run / "pix4d.csv").read_text().splitlines()))
    assert len(rows) == 8
    for i, row in enumerate(rows):
        lat, lon = float(row[1]), float(row[2])
        place = solved.survey.work_frame.geodetic_from_enu(solved.adjusted.poses.positions_m[i])
        assert (lon, lat, float(row[3])) == pytest.approx(tuple(place), abs=1e-3)
        camera = Turn.from_euler("XYZ", [float(v) for v in row[4:7]], degrees=True).as_matrix()
        # Grid north of UTM 32 lies (11.5 - 9) deg * sin 48.1 deg = 1.861 deg east of true north here.
        grid = Turn.from_euler("z", 1.861, degrees=True).as_matrix()
        assert grid.T @ camera == pytest.approx(solved.adjusted.poses.rotations[i], abs=2e-4)
        read = read_pos(run / "pix4d.csv").rows[i]
        body = Rotation.from_yaw_pitch_roll(*np.radians([read.yaw_deg, read.pitch_deg, read.roll_deg]))
        assert body.matrix == pytest.approx(solved.adjusted.poses.rotations[i], abs=2e-4)
        assert (read.name, read.lon_deg, read.sd_vertical_m) == (row[0], lon, float(row[8]))


def test_odm_has_positions_and_control(solved, run):
    lines = (run / "odm" / "geo.txt").read_text().splitlines()
    assert lines[0] == "EPSG:4326"
    for i, line in enumerate(lines[1:]):
        name, lon, lat, height, _yaw, pitch, roll, flat, vertical = line.split(" ")
        assert name == solved.survey.frames[i].name
        at = solved.survey.work_frame.enu_from_geodetic(float(lon), float(lat), float(height))
        assert at == pytest.approx(solved.adjusted.poses.positions_m[i], abs=1e-3)
        assert abs(float(pitch)) < 30.0, "0 looks down"
        assert abs(float(roll)) < 30.0
        assert float(flat) > 0.0
        assert float(vertical) > 0.0
    control = (run / "odm" / "gcp_list.txt").read_text().splitlines()
    assert control[0] == "EPSG:32632"
    (point,) = (p for p in solved.survey.control if not p.check)
    assert len(control) == 1 + len(point.images)
    x, y, z, col, row, image, name = control[1].split(" ")
    to_map = Transformer.from_crs("EPSG:4326", "EPSG:32632", always_xy=True)
    assert (float(x), float(y)) == pytest.approx(to_map.transform(point.lon_deg, point.lat_deg), abs=1e-3)
    assert (image, float(col), float(row), name) == (
        point.images[0][0], pytest.approx(point.images[0][1], abs=1e-3),
        pytest.approx(point.images[0][2], abs=1e-3), "A",
    )  # fmt: skip
    assert float(z) == pytest.approx(point.height_ellipsoidal_m, abs=1e-3)
    assert (run / "odm" / "check_list.txt").read_text().splitlines()[1].endswith(" B")


@pytest.mark.parametrize(
    "crs", ["ESRI:102003", "IGNF:LAMB93", CRS("EPSG:27572").to_wkt().replace("27572", "0")]
)
def test_odm_gets_degrees_where_it_knows_no_name_of_the_map(solved, tmp_path, crs):
    """Its header is an EPSG code, a PROJ string or a UTM zone."""
    (point,) = (p for p in solved.survey.control if not p.check)
    write_odm_control(tmp_path / "gcp_list.txt", [point], crs)
    header, first, *_ = (tmp_path / "gcp_list.txt").read_text().splitlines()
    assert header == "EPSG:4326"
    lon, lat, height, *_ = first.split(" ")
    assert (float(lon), float(lat)) == pytest.approx((point.lon_deg, point.lat_deg), abs=2e-9)
    assert float(height) == pytest.approx(point.height_ellipsoidal_m, abs=1e-4)


def test_odm_gets_the_map_s_own_coordinates_with_a_proj_string(solved, tmp_path):
    (point,) = (p for p in solved.survey.control if not p.check)
    write_odm_control(tmp_path / "gcp_list.txt", [point], "+proj=utm +zone=32 +datum=WGS84 +type=crs")
    header, first, *_ = (tmp_path / "gcp_list.txt").read_text().splitlines()
    assert header.startswith("+proj=utm") and 600_000.0 < float(first.split(" ")[0]) < 700_000.0


@pytest.mark.parametrize(("stage", "program"), [(export_colmap, "COLMAP"), (export_odm, "OpenDroneMap")])
@pytest.mark.parametrize("name", ["000.jpg", "left side.jpg"])
def test_names_with_spaces_are_warned_of(solved, tmp_path, stage, program, name):
    first, *others = solved.survey.frames
    survey = replace(solved.survey, frames=(replace(first, name=name), *others))
    inputs = {of: getattr(solved, of) for of in stage.inputs} | {"survey": survey}
    given = StageInputs(RunFolder(tmp_path / "RUN"), inputs)
    _, notes = run_stage(recipe_of(stage, stage.Params()), given, work_folder=tmp_path / "work")
    warned = [warning["text"] for warning in notes.warnings if warning["code"] == "spaces-in-names"]
    assert len(warned) == (" " in name)
    assert all(f"which {program} reads as separators" in text for text in warned)
