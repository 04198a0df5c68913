"""What the adjustment knows of its own errors, in positions.csv and layers.gpkg."""

from __future__ import annotations

import csv
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from osgeo import ogr
from osgeo_utils.samples import validate_gpkg
from pyogrio import read_info
from pyproj import Transformer
from solved_block import ALONE, WORK, solved_block

from geomosaic.camera.rotation import Rotation, exp_turn
from geomosaic.export import residual_layers
from geomosaic.export.ellipses import error_ellipses, exaggeration
from geomosaic.export.layers import SolvedSurvey, write_layers
from geomosaic.export.orientation import orientations
from geomosaic.export.positions import write_positions


@pytest.fixture(scope="module")
def solved():
    return solved_block()


@pytest.fixture(scope="module")
def package(solved, tmp_path_factory):
    path = tmp_path_factory.mktemp("solved") / "layers.gpkg"
    write_layers(
        path, SolvedSurvey(solved.survey, solved.placement, solved.ties, solved.adjusted, solved.mosaic)
    )
    validate_gpkg.check(str(path), abort_at_first_error=True)
    return ogr.Open(str(path))


def test_an_ellipse_by_hand():
    """Semi-axes 3 and 1 m, the long one 30 degrees east of north."""
    along = np.array([np.sin(np.radians(30.0)), np.cos(np.radians(30.0))])
    across = np.array([along[1], -along[0]])
    e = error_ellipses((9.0 * np.outer(along, along) + np.outer(across, across))[None])
    assert (e.semi_major_m[0], e.semi_minor_m[0]) == pytest.approx((3.0, 1.0))
    assert np.degrees(e.azimuth_rad[0]) == pytest.approx(30.0)
    outline = e.outlines_m(np.array([[500.0, 700.0]]), 10.0)[0] - [500.0, 700.0]
    assert np.linalg.norm(outline, axis=1).max() == pytest.approx(30.0)
    np.testing.assert_allclose(outline[0], 30.0 * along)
    assert np.abs(outline @ across).max() == pytest.approx(10.0)


@given(st.floats(0.01, 10.0), st.floats(0.0, 1.0), st.floats(0.0, 3.1))
def test_ellipses_are_the_covariances_principal_axes(major, share, azimuth):
    minor = share * major
    along, across = np.array([[np.sin(azimuth), np.cos(azimuth)], [np.cos(azimuth), -np.sin(azimuth)]])
    covariance = major**2 * np.outer(along, along) + minor**2 * np.outer(across, across)
    e = error_ellipses(covariance[None])
    assert e.semi_major_m[0] == pytest.approx(major, rel=1e-6)
    assert e.semi_minor_m[0] == pytest.approx(minor, abs=1e-6 * major)
    if share < 0.9:
        assert np.sin(e.azimuth_rad[0] - azimuth) == pytest.approx(0.0, abs=1e-6)


def test_ellipses_are_drawn_as_large_as_their_neighbours_leave_room():
    at = np.array([[0.0, 0.0], [100.0, 0.0], [100.0, 100.0], [np.nan, 0.0]])
    size = np.array([0.3, 0.3, 0.2, np.nan])
    assert exaggeration(size, at) == 100.0, "0.4 * 100 m / 0.3 m = 133"
    assert exaggeration(size, at / 200.0) == 1.0, "never smaller than life"
    assert exaggeration(size, np.zeros((4, 2))) == 1.0


def test_deviations_are_those_of_finite_differences(solved):
    """Frames turned by 130 degrees and tilted by up to 25, with a covariance full of correlations."""
    rng = np.random.default_rng(8)
    root = rng.normal(0.0, 1.0, (8, 6, 6))
    covariance = root @ np.swapaxes(root, 1, 2) * np.outer([0.1] * 3 + [1e-4] * 3, [0.1] * 3 + [1e-4] * 3)
    angles = np.radians([[130.0, 25.0, -11.0]] * 4 + [[-37.0, -8.0, 19.0]] * 4)
    poses = replace(
        solved.adjusted.poses,
        rotations=Rotation.from_yaw_pitch_roll(*angles.T).matrix,
        positions_m=solved.adjusted.poses.positions_m + [3000.0, -2000.0, 0.0],
    )
    adjusted = replace(solved.adjusted, poses=poses, pose_covariance=covariance)

    def outcome(move: np.ndarray, turn: np.ndarray) -> np.ndarray:
        """Easting, northing, height, omega, phi, kappa of all frames, by PROJ and the rotations' formula."""
        there = replace(
            adjusted,
            poses=replace(
                poses,
                positions_m=poses.positions_m + move,
                rotations=exp_turn(np.tile(turn, (8, 1))) @ poses.rotations,
            ),
        )
        o = orientations(solved.survey, solved.placement.poses, there)
        lon, lat, height = o.lon_lat_height.T
        east, north = Transformer.from_crs(4326, 32632, always_xy=True).transform(lon, lat)
        return np.column_stack([east, north, height, np.radians(o.omega_phi_kappa_deg)])

    step, columns = 1e-4, []
    for k in range(6):
        by = np.zeros(6)
        by[k] = step
        columns.append((outcome(by[:3], by[3:]) - outcome(-by[:3], -by[3:])) / (2.0 * step))
    jacobian = np.stack(columns, axis=-1)
    jacobian[:, 3:, :3] = 0.0  # the meridians converge: 2e-7 rad a metre
    expected = np.sqrt(np.einsum("nij,njk,nik->ni", jacobian, covariance, jacobian))
    o = orientations(solved.survey, solved.placement.poses, adjusted)
    np.testing.assert_allclose(o.sd_m, expected[:, :3], rtol=6e-4)  # UTM's scale
    np.testing.assert_allclose(np.radians(o.sd_omega_phi_kappa_deg), expected[:, 3:], rtol=1e-6)
    independent = replace(adjusted, pose_covariance=covariance * np.eye(6))
    other = orientations(solved.survey, solved.placement.poses, independent)
    assert np.abs(other.sd_omega_phi_kappa_deg / o.sd_omega_phi_kappa_deg - 1.0).max() > 0.2


def test_a_position_that_nobody_reported_has_no_ellipse(solved, tmp_path):
    """Its prior of 100 km made an ellipse of the size of a continent."""
    sd_m = solved.placement.poses.positions_sd_m.copy()
    sd_m[ALONE] = (1e5, 1e5, 5.0)
    prior = replace(solved.placement.poses, positions_sd_m=sd_m)
    positions_m = solved.adjusted.poses.positions_m.copy()
    positions_m[ALONE] = prior.positions_m[ALONE]
    rotations = solved.adjusted.poses.rotations.copy()
    rotations[ALONE] = prior.rotations[ALONE]
    poses = replace(solved.adjusted.poses, positions_m=positions_m, rotations=rotations)
    adjusted = replace(solved.adjusted, poses=poses)
    o = orientations(solved.survey, prior, adjusted)
    assert np.isnan(o.sd_m[ALONE, :2]).all() and o.sd_m[ALONE, 2] == pytest.approx(5.0)
    assert np.isfinite(np.delete(o.sd_m, ALONE, axis=0)).all()
    placement = replace(solved.placement, poses=prior)
    path = tmp_path / "l.gpkg"
    write_layers(path, SolvedSurvey(solved.survey, placement, solved.ties, adjusted, solved.mosaic))
    read = read_info(str(path), layer="error_ellipses", force_total_bounds=True)
    west, south, east, north = read["total_bounds"]
    assert max(east - west, north - south) < 1000.0


def test_an_untied_frame_has_the_deviations_of_its_prediction(solved, tmp_path):
    """About those of its POS, 1.5 m and 2 m, with the doubt of what its neighbours say of it."""
    assert solved.adjusted.status[ALONE] == "placed"
    write_positions(tmp_path / "p.csv", orientations(solved.survey, solved.placement.poses, solved.adjusted))
    with (tmp_path / "p.csv").open(newline="") as file:
        rows = [{k: v for k, v in row.items() if k.startswith("sd_")} for row in csv.DictReader(file)]
    alone, tied = ({k: float(v) for k, v in rows[i].items()} for i in (ALONE, 2))
    of_poses = solved.adjusted.poses.positions_sd_m[ALONE]
    assert (alone["sd_e_m"], alone["sd_n_m"], alone["sd_u_m"]) == pytest.approx(tuple(of_poses), abs=1e-4)
    assert (alone["sd_e_m"], alone["sd_u_m"]) == pytest.approx((1.5, 2.0), rel=0.5)
    assert (alone["sd_omega_deg"], alone["sd_kappa_deg"]) == pytest.approx((0.3, 1.0), rel=0.5)
    own = np.sqrt(np.diagonal(solved.adjusted.pose_covariance[2]))
    assert (tied["sd_e_m"], tied["sd_u_m"]) == pytest.approx((own[0], own[2]), rel=0.03)
    assert np.radians(tied["sd_kappa_deg"]) == pytest.approx(own[5], rel=0.01)
    assert tied["sd_e_m"] < 1.0


def test_error_ellipses_lie_in_the_maps_grid(solved, tmp_path):
    """Positions are twice as sure across the work frame's north. At 2.5 degrees east of the zone's middle and
    48.1 north, the grid's north lies 2.5 * sin(48.1) = 1.861 degrees east of true north."""
    covariance = np.tile(np.diag([0.04, 0.16, 0.09, 1e-8, 1e-8, 1e-8]), (8, 1, 1))
    adjusted = replace(solved.adjusted, pose_covariance=covariance)
    write_layers(
        tmp_path / "l.gpkg",
        SolvedSurvey(solved.survey, solved.placement, solved.ties, adjusted, solved.mosaic),
    )
    dataset = ogr.Open(str(tmp_path / "l.gpkg"))
    frame = dataset.GetLayer("frames").GetFeature(1)
    assert (frame["ellipse_major_m"], frame["ellipse_minor_m"]) == pytest.approx((0.4, 0.2), rel=1e-4)
    assert frame["ellipse_azimuth_deg"] == pytest.approx(180.0 - 1.861, abs=0.005)
    layer = dataset.GetLayer("error_ellipses")
    assert layer.GetMetadataItem("DESCRIPTION").endswith("drawn 10 times larger"), "0.4 * 18 m / 0.4 m = 18"
    ellipse = layer.GetFeature(1)
    assert (ellipse["frame"], ellipse["status"], ellipse["scale"]) == ("000.jpg", "tied", 10.0)
    assert ellipse["ellipse_azimuth_deg"] == frame["ellipse_azimuth_deg"]
    outline = ellipse.GetGeometryRef()
    corners = 48 / (2.0 * np.pi) * np.sin(2.0 * np.pi / 48)
    assert outline.GetArea() == pytest.approx(np.pi * 4.0 * 2.0 * corners, rel=1e-3)
    centre, at = outline.Centroid(), frame.GetGeometryRef()
    assert (centre.GetX(), centre.GetY()) == pytest.approx((at.GetX(), at.GetY()), abs=1e-6)
    ring = np.array(outline.GetGeometryRef(0).GetPoints())[:, :2] - [at.GetX(), at.GetY()]
    east, north = ring[np.argmax(np.hypot(*ring.T))]
    assert np.degrees(np.arctan2(east, north)) % 180.0 == pytest.approx(180.0 - 1.861, abs=0.005)


def test_image_residuals_lie_where_their_frame_puts_them(solved, package):
    layer, r = package.GetLayer("image_residuals"), solved.adjusted.image_residuals
    assert layer.GetFeatureCount() == len(r.frame) > 1000
    feature = layer.GetFeature(1 + 345)
    assert feature["frame"] == solved.survey.frames[r.frame[345]].name
    reported = [feature[k] for k in ["col_px", "row_px", "residual_col_px", "residual_row_px", "weight"]]
    assert reported == pytest.approx([*r.image_px[345], *r.residual_px[345], r.weight[345]])
    assert feature["residual_px"] == pytest.approx(np.hypot(*r.residual_px[345]))
    pose, camera = solved.adjusted.poses[r.frame[345]], solved.adjusted.cameras[r.frame[345]]
    at = feature.GetGeometryRef()
    lon, lat = Transformer.from_crs(32632, 4326, always_xy=True).transform(at.GetX(), at.GetY())
    up = float(np.median(solved.adjusted.ground.up_m))
    ground = WORK.enu_from_geodetic(lon, lat, 520.0 + up)
    seen = pose.image_from_ground(camera, ground)
    assert seen == pytest.approx(r.image_px[345], abs=0.02)


def test_of_too_many_observations_an_even_share_is_shown(solved, tmp_path, monkeypatch):
    monkeypatch.setattr(residual_layers, "MOST_POINTS", 100)
    path = tmp_path / "l.gpkg"
    write_layers(
        path, SolvedSurvey(solved.survey, solved.placement, solved.ties, solved.adjusted, solved.mosaic)
    )
    dataset = ogr.Open(str(path))
    layer = dataset.GetLayer("image_residuals")
    m = len(solved.adjusted.image_residuals.frame)
    assert layer.GetFeatureCount() == 100
    assert layer.GetMetadataItem("DESCRIPTION").endswith(f": 100 of {m:,}, evenly thinned")
    assert len({f["frame"] for f in layer}) == 7


def test_control_stands_where_it_was_surveyed(solved, package):
    layer = package.GetLayer("control")
    points = {f["name"]: f for f in layer}
    assert [(n, points[n]["kind"]) for n in points] == [
        ("A", "control"), ("B", "check"), ("C", "check"), ("unseen", "check"),
    ]  # fmt: skip
    (b,) = [c for c in solved.adjusted.control if c.name == "B"]
    # Work frame to grid: turned by the convergence of 1.861 degrees.
    turn = np.radians(1.861)
    east = np.cos(turn) * b.residual_m[0] - np.sin(turn) * b.residual_m[1]
    north = np.sin(turn) * b.residual_m[0] + np.cos(turn) * b.residual_m[1]
    reported = [points["B"][f"residual_{axis}_m"] for axis in "enu"]
    assert reported == pytest.approx([east, north, b.residual_m[2]], rel=2e-3, abs=1e-5)
    assert points["B"]["sd_u_m"] == pytest.approx(b.sd_m[2], rel=1e-4)
    assert points["B"]["pictures"] == b.images >= 3
    at = points["B"].GetGeometryRef()
    lon, lat, height = WORK.geodetic_from_enu(np.array([20.05, 8.0, 0.0]))
    expected = Transformer.from_crs(4326, 32632, always_xy=True).transform(lon, lat)
    assert (at.GetX(), at.GetY(), at.GetZ()) == pytest.approx((*expected, height), abs=1e-4)
    assert points["unseen"]["residual_e_m"] is None and points["unseen"]["pictures"] == 0
    lines = {f["name"]: f for f in package.GetLayer("control_residuals")}
    assert list(lines) == ["A", "B", "C"]
    start, end = (np.array(lines["B"].GetGeometryRef().GetPoint_2D(k)) for k in (0, 1))
    assert end == pytest.approx(expected, abs=1e-4)
    assert end - start == pytest.approx(reported[:2], abs=1e-6)


def test_methods_that_used_no_control_have_check_points_only(solved, tmp_path):
    asked = tuple(replace(c, check=True) for c in solved.adjusted.control)
    adjusted = replace(solved.adjusted, control=asked, image_residuals=None, pose_covariance=None)
    path = tmp_path / "l.gpkg"
    write_layers(path, SolvedSurvey(solved.survey, solved.placement, solved.ties, adjusted, solved.mosaic))
    dataset = ogr.Open(str(path))
    assert {f["kind"] for f in dataset.GetLayer("control")} == {"check"}
    assert [f["residual_m"] is None for f in dataset.GetLayer("control")] == [False, False, False, True]
    assert dataset.GetLayer("image_residuals").GetFeatureCount() == 0
