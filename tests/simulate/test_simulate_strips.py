"""Simulated CCD strips: every sign by its physics, points found where the truth has them, files read back."""

from __future__ import annotations

import csv
import dataclasses
import json
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import rasterio
import yaml
from affine import Affine
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from osgeo import gdal
from scipy import ndimage, optimize

from geomosaic.camera.rpc import parse_rpc
from geomosaic.doors.raster import OWN, open_raster
from geomosaic.errors import FileError, InputError, OutputError
from geomosaic.pipeline.stage import Context
from geomosaic.survey.strip_model import read_model
from geomosaic.survey.strips import read_geometry
from geomosaic_simulate.stage_strips import SimulateStrips
from geomosaic_simulate.strip_overlaps import simulate_overlaps
from geomosaic_simulate.strip_plan import StripPlan
from geomosaic_simulate.strip_scene import PairTruth, StripWorld
from geomosaic_simulate.strip_seen import CcdView
from geomosaic_simulate.strips import SimulatedStrips, simulate_strips

STILL: dict[str, Any] = {
    "jitter_1hz_px": 0.0, "jitter_5hz_px": 0.0, "jitter_22hz_px": 0.0, "drift_px_per_s": 0.0,
    "drift_angle_deg": 0.0, "mounting_px": 0.0, "thermal_px": 0.0, "relief_m": 0.0, "course_deg": 180.0,
}  # fmt: skip
CLEAR: dict[str, Any] = {"snr": 0.0, "gain_sd": 0.0, "offset_sd": 0.0, "column_sd": 0.0}
SMALL: dict[str, Any] = {
    "ccds": 3, "width_px": 128, "lines": 600, "overlap_px": 48, "read_px": 60, "row_separation_lines": 150.0,
    "dem_pixel_m": 60.0,
}  # fmt: skip
BETWEEN_S = 2114.0 / 3272.4


def truth(pair: int = 0, **changes: Any) -> PairTruth:
    return StripWorld(StripPlan(**{"ccds": 3, "width_px": 256, "lines": 3000, **STILL, **changes})).truth(
        pair
    )


def rows_of(path: Path | None) -> list[dict[str, str]]:
    assert path is not None
    with path.open(newline="") as f:
        return list(csv.DictReader(f))


def pixels(path: Path) -> NDArray[Any]:
    with open_raster(path, OWN) as strip:
        return np.asarray(strip.read(1))


# The signs of the offsets, with TH-1's numbers


def test_a_perfect_camera_over_level_ground_has_no_offsets() -> None:
    for pair in (0, 1):
        t = truth(pair)
        assert len(t.dcol_px) == 3000
        np.testing.assert_allclose(t.dcol_px, 0.0, atol=0.002)
        np.testing.assert_allclose(t.dline_px, 0.0, atol=0.002)


def test_high_ground_comes_later_to_the_leading_row_and_earlier_to_the_trailing_one() -> None:
    plan = StripPlan(**{"ccds": 3, "width_px": 256, "lines": 3000, **STILL, "relief_m": 900.0, "seed": 4})
    scene = StripWorld(plan)
    for pair, sign in ((0, -1.0), (1, 1.0)):
        dline = scene.truth(pair).dline_px
        middle_m = ((pair + 1) * 160 + 48 - scene.scene_width_px / 2) * 2.0
        ahead_lines = 1057.0 if sign < 0 else -1057.0
        north_m = (1500.0 - np.arange(3000) - 0.5 - ahead_lines) * 2.0
        height = scene.relief.height_at(middle_m, north_m) - 900.0
        assert np.ptp(height) > 300.0
        np.testing.assert_allclose(dline, sign * height / 233.0, atol=0.02)


def test_a_first_ccd_in_the_trailing_row_turns_the_signs() -> None:
    one, other = (truth(0, first_row=row, relief_m=900.0, seed=4).dline_px for row in (1, 2))
    assert np.abs(one).max() > 0.8
    highest, seen_by_other = int(np.argmin(one)), int(np.argmax(other))
    assert seen_by_other - highest == pytest.approx(2114, abs=3) or min(highest, 2999 - seen_by_other) < 2


def motion(path: Path, time_s: Any, along_px: Any, across_px: Any) -> Path:
    with path.open("w") as f:
        f.write("time_s,along_px,across_px\n")
        f.writelines(
            f"{t:.6f},{a:.6f},{b:.6f}\n" for t, a, b in zip(time_s, along_px, across_px, strict=True)
        )
    return path


def test_a_camera_that_turns_steadily(tmp_path: Path) -> None:
    t = np.array([-5.0, 10.0])
    path = motion(tmp_path / "m.csv", t, 5.0 * t, -3.0 * t)
    leading, trailing = (truth(pair, motion=path) for pair in (0, 1))
    at = 5.0 * BETWEEN_S * (1.0 - 5.0 / 3272.4)  # looking ahead faster and faster shortens the way
    np.testing.assert_allclose(leading.dline_px, -at, atol=0.01)
    np.testing.assert_allclose(trailing.dline_px, at, atol=0.01)
    np.testing.assert_allclose(leading.dcol_px, 3.0 * BETWEEN_S, atol=0.01)
    np.testing.assert_allclose(trailing.dcol_px, -3.0 * BETWEEN_S, atol=0.01)


def test_one_nod_is_seen_twice_a_row_separation_apart(tmp_path: Path) -> None:
    """A nod ahead at camera line 2500: at once in the left strip, 2114 lines earlier by way of the right."""
    t = np.arange(-0.5, 2.0, 0.0025)
    nod = 2.0 * np.exp(-(((t - 2500.5 / 3272.4) / 0.02) ** 2))
    dline = truth(0, motion=motion(tmp_path / "m.csv", t, nod, 0.0 * t)).dline_px
    assert int(np.argmax(dline)) == pytest.approx(2500, abs=2)
    assert int(np.argmin(dline)) == pytest.approx(2500 - 2114, abs=4)
    assert dline.max() == pytest.approx(2.0, abs=0.01)
    assert dline.min() == pytest.approx(-2.0, abs=0.01)
    assert abs(dline[1500]) < 0.002


def test_the_drift_angle_moves_columns_the_other_way_in_every_second_pair() -> None:
    """Yaw to the flight's right takes the leading row to lower columns: the ground is at higher ones there."""
    leading, trailing = (truth(pair, drift_angle_deg=0.05).dcol_px for pair in (0, 1))
    shift = np.radians(0.05) * 2114.0
    assert (leading < -0.78 * shift).all()
    assert (leading > -1.22 * shift).all()
    assert (trailing > 0.78 * shift).all()


def test_a_lost_and_a_repeated_line_shift_what_follows() -> None:
    plain, lost = truth(0), truth(0, lost="2:2500:5")
    np.testing.assert_allclose(lost.dline_px[:380], plain.dline_px[:380], atol=1e-9)
    np.testing.assert_allclose(lost.dline_px[395:], plain.dline_px[395:] - 5.0, atol=1e-9)
    again = truth(0, repeated="1:1000:3")
    assert len(again.dline_px) == 3003
    np.testing.assert_allclose(again.dline_px[:1000], plain.dline_px[:1000], atol=1e-9)
    np.testing.assert_allclose(again.dline_px[1003:], plain.dline_px[1000:] - 3.0, atol=1e-9)


@pytest.mark.parametrize(
    ("height_m", "wind_deg", "wanted"),
    [(2330.0, 0.0, -10.0 + 3.23), (2330.0, 180.0, -10.0 - 3.23), (0.0, 0.0, 3.23)],
)
def test_clouds_move_by_their_height_and_the_wind(height_m: float, wind_deg: float, wanted: float) -> None:
    """10 m/s is 3.23 lines between the rows; height has one sign, the wind either (paper, section 2)."""
    plan = StripPlan(
        **{"ccds": 2, "width_px": 256, "lines": 3000, **STILL, **CLEAR, "contrast": 0.0, "bit_depth": 16},
        cloud_cover=0.6, cloud_size_m=600.0, cloud_height_m=height_m, wind_m_per_s=10.0, wind_deg=wind_deg,
    )  # fmt: skip
    _, (pair,) = simulate_overlaps(plan)
    left = pair.left[100:800, 20:100].astype(np.float64)
    scores = []
    shifts = np.arange(-18, 12)
    for shift in shifts:
        right = pair.right[100 + 2114 + shift : 800 + 2114 + shift, 6:86].astype(np.float64)
        scores.append(np.corrcoef(left.ravel(), right.ravel())[0, 1])
    k = int(np.argmax(scores))
    a, b, c = scores[k - 1 : k + 2]
    assert b > 0.99
    assert shifts[k] + 0.5 * (a - c) / (a - 2.0 * b + c) == pytest.approx(wanted, abs=0.1)


# Images against truth


@pytest.fixture(scope="module")
def spots(tmp_path_factory: pytest.TempPathFactory) -> SimulatedStrips:
    """Point targets on plain ground, all motions and relief on."""
    plan = StripPlan(
        **{
            **SMALL,
            **CLEAR,
            "contrast": 0.0,
            "bit_depth": 16,
            "targets": 12,
            "seed": 5,
            "jitter_22hz_px": 0.3,
        },
        parallax_m_per_line=1000.0,
    )
    return simulate_strips(tmp_path_factory.mktemp("spots"), plan)


def centres(spots: SimulatedStrips) -> dict[tuple[int, int], tuple[float, float, float, float]]:
    """(target, ccd from 0): col and line found in the strip by centroid, col and line as targets.csv has it."""
    strips = [pixels(path).astype(np.float64) for path in spots.strips]
    found = {}
    for row in rows_of(spots.targets):
        ccd, col, line = int(row["ccd"]) - 1, float(row["col_px"]), float(row["line_px"])
        c, r = int(col) - 7, int(line) - 7
        if c >= 0 and r >= 0 and c + 15 <= 128 and r + 15 <= 600:
            part = strips[ccd][r : r + 15, c : c + 15] - 0.35 * 65535
            rows, cols = np.mgrid[r : r + 15, c : c + 15] + 0.5
            mass = part.sum()
            at = float((part * cols).sum() / mass), float((part * rows).sum() / mass)
            found[int(row["target"]), ccd] = (*at, col, line)
    return found


def test_points_are_found_where_the_rigorous_model_has_them(spots: SimulatedStrips) -> None:
    found = np.array(list(centres(spots).values()))
    assert len(found) >= 16
    np.testing.assert_allclose(found[:, :2], found[:, 2:], atol=0.003)


def test_points_are_found_in_both_strips_where_the_offsets_have_them(spots: SimulatedStrips) -> None:
    found = centres(spots)
    offsets = np.array([[float(v) for v in row.values()] for row in rows_of(spots.true_offsets)])
    sides = {0: 1, 1: -1}
    checked = 0
    for (target, ccd), (col, line, *_) in found.items():
        if (target, ccd + 1) not in found:
            continue
        right_col, right_line, *_ = found[target, ccd + 1]
        of_pair = offsets[offsets[:, 0] == ccd]
        dcol, dline = (float(np.interp(line, of_pair[:, 1] + 0.5, of_pair[:, k])) for k in (2, 3))
        assert right_col == pytest.approx(col - (128 - 48) + dcol, abs=0.01)
        assert right_line == pytest.approx(line + sides[ccd] * 150.0 + dline, abs=0.01)
        checked += 1
    assert checked >= 6
    assert np.abs(offsets[:, 3]).max() > 0.3


def test_the_image_itself_moves_by_the_offset() -> None:
    """The shift that makes both edges most alike, smoothed so that nothing is aliased, is the mean offset."""
    plan = StripPlan(**{**SMALL, **STILL, **CLEAR, "bit_depth": 16, "mounting_px": 0.4, "seed": 8})
    _, pairs = simulate_overlaps(plan)
    for pair, side in zip(pairs, (1, -1), strict=True):
        first = 20 if side == 1 else 170
        at = slice(first, first + 400)
        dcol, dline = (float(v[at].mean()) for v in (pair.truth.dcol_px, pair.truth.dline_px))
        smooth = [ndimage.gaussian_filter(edge.astype(float), 2.0) for edge in (pair.left, pair.right)]
        left, right = smooth[0][at, 22:50], smooth[1][first + side * 150 - 10 : first + side * 150 + 410]

        def unlike(by: NDArray[np.float64], left: Any = left, right: Any = right) -> float:
            moved = ndimage.shift(right, [-by[1], -by[0]], order=5)[10:-10, 10:38]
            return float(((moved - left) ** 2).mean())

        found = optimize.minimize(unlike, [0.1, 0.1], method="Nelder-Mead", options={"xatol": 1e-4}).x
        np.testing.assert_allclose(found, [dcol, dline], atol=0.002)
        assert np.hypot(dcol, dline) > 0.1


def test_overlaps_alone_are_the_strips_edges(tmp_path: Path) -> None:
    plan = StripPlan(**{**SMALL, **CLEAR, "cloud_cover": 0.3, "cloud_size_m": 300.0, "lost": "2:300:4"})
    written = simulate_strips(tmp_path, plan, scene=False)
    geometry, pairs = simulate_overlaps(plan)
    strips = [pixels(path).astype(int) for path in written.strips]
    assert geometry.lines == (600, 596, 600)
    for k, pair in enumerate(pairs):
        assert pair.left.shape == (geometry.lines[k], 60)
        for edge, strip in ((pair.left, strips[k][:, -60:]), (pair.right, strips[k + 1][:, :60])):
            assert np.abs(edge - strip).max() <= 1


def test_fast_rays_are_the_rigorous_model_s() -> None:
    plan = StripPlan(ccds=8, width_px=4096, lines=12000, jitter_22hz_px=0.4, course_deg=11.0, lat_deg=-61.0)
    scene = StripWorld(plan)
    ccd, model = 6, scene.cameras.true
    seen = CcdView(
        model, ccd, scene.projection, scene.cameras.slow_rad, plan.ground_height_m, plan.altitude_m, 4096,
        (-100.0, 12100.0),
    )  # fmt: skip
    rng = np.random.default_rng(3)
    lines, cols = np.sort(rng.uniform(0.0, 12000.0, 60)), rng.uniform(0.0, 4096.0, (60, 3))
    for height in (700.0, 900.0, 1800.0):
        ground = model.ground_from_image(ccd, cols, lines[:, None], height)
        wanted = scene.projection.map_from_geodetic(ground[..., 0], ground[..., 1])
        got = np.moveaxis(seen.rays(cols, lines).at_height(height), 0, -1)
        np.testing.assert_allclose(got, wanted, atol=1e-3)


# The cameras


def test_flying_south_columns_grow_to_the_east_and_lines_to_the_south() -> None:
    plan = StripPlan(**{**SMALL, **STILL, "course_deg": 180.0, "lon_deg": 30.0, "lat_deg": 47.0})
    ideal = StripWorld(plan).cameras.ideal
    width = plan.geometry().scene_width_px
    middle = ideal.ground_from_image(0, width / 2.0, 300.0, 900.0)
    np.testing.assert_allclose(middle, [30.0, 47.0, 900.0], atol=1e-7)
    east = ideal.ground_from_image(0, width / 2.0 + 50.0, 300.0, 900.0)
    south = ideal.ground_from_image(0, width / 2.0, 350.0, 900.0)
    assert east[0] - 30.0 == pytest.approx(100.0 / (np.cos(np.radians(47.0)) * 6.3899e6) * 57.29578, rel=1e-3)
    assert south[1] - 47.0 == pytest.approx(-100.0 / 6.3698e6 * 57.29578, rel=1e-3)


def test_attitude_turns_the_view_as_the_docstring_says() -> None:
    """Flying south at 35.1 km: pitch looks further south, roll to the left (east), yaw turns right (west)."""
    plan = StripPlan(**{**SMALL, **STILL, "course_deg": 180.0, "row_separation_lines": 150.0})
    model = StripWorld(plan).cameras.true
    height = plan.altitude_m
    assert height == pytest.approx(1.0 / (1.0 / (233.0 * 150.0) - 1.0 / 6371000.0))
    at = 40.0, 300.0, 900.0
    level = model.ground_from_image(0, *at)
    north_m, east_m = 111200.0, 111200.0 * np.cos(np.radians(38.2))
    moves = {}
    for k, axis in enumerate(("roll", "pitch", "yaw")):
        angles = np.zeros(3)
        angles[k] = 1e-3
        moves[axis] = model.ground_from_image(0, *at, angles) - level
    assert moves["pitch"][1] * north_m == pytest.approx(-35.14, abs=0.2)
    assert moves["roll"][0] * east_m == pytest.approx(35.14, abs=0.2)
    assert moves["yaw"][0] * east_m == pytest.approx(-0.15, abs=0.02)  # 150 m ahead: to the west


@settings(max_examples=20, deadline=None)
@given(st.floats(0, 128), st.floats(0, 600), st.floats(-200, 3000), st.integers(0, 2))
def test_ground_and_back(col: float, line: float, height: float, ccd: int) -> None:
    model = MOVING.cameras.true
    ground = model.ground_from_image(ccd, col, line, height)
    np.testing.assert_allclose(
        model.image_from_ground(ccd, ground, line + 40.0, col - 30.0), [col, line], atol=1e-6
    )
    assert ground[2] == height


MOVING = StripWorld(StripPlan(**SMALL))


def test_the_model_on_disk_is_the_camera(spots: SimulatedStrips) -> None:
    model = read_model(spots.true_model)
    plan = StripPlan(**{**SMALL, "seed": 5, "jitter_22hz_px": 0.3, "parallax_m_per_line": 1000.0})
    camera = StripWorld(plan).cameras.true
    at = 2, np.array([3.0, 100.0]), np.array([80.5, 555.0]), 1000.0
    np.testing.assert_allclose(
        model.ground_from_image(*at), camera.ground_from_image(*at), rtol=0, atol=2e-10
    )


def test_what_is_reported_is_off_by_what_was_asked() -> None:
    plan = StripPlan(**SMALL, attitude_bias_urad=30.0)
    cameras = StripWorld(plan).cameras
    away = cameras.reported.roll_pitch_yaw_rad - cameras.true.roll_pitch_yaw_rad
    np.testing.assert_allclose(np.abs(away), 30e-6, rtol=1e-6)
    noisy = StripWorld(dataclasses.replace(plan, attitude_bias_urad=0.0, attitude_noise_urad=7.0)).cameras
    away = noisy.reported.roll_pitch_yaw_rad - noisy.true.roll_pitch_yaw_rad
    assert away.std() == pytest.approx(7e-6, rel=0.1)


def test_gdal_reads_the_rpc_as_we_do(spots: SimulatedStrips, tmp_path: Path) -> None:
    assert spots.true_scene is not None
    shutil.copy(spots.true_scene, tmp_path / "scene.tif")
    shutil.copy(spots.rpc, tmp_path / "scene_RPC.TXT")
    ours = parse_rpc(spots.rpc.read_text())
    model = StripWorld(StripPlan(**{**SMALL, "seed": 5, "parallax_m_per_line": 1000.0})).cameras.ideal
    col, line, height = 31.0, 410.5, 1010.0
    ground = model.ground_from_image(0, col, line, height)
    np.testing.assert_allclose(ours.image_from_ground(ground), [col, line], atol=0.002)
    dataset = gdal.Open(str(tmp_path / "scene.tif"))
    transformer = gdal.Transformer(dataset, None, ["METHOD=RPC", "RPC_PIXEL_ERROR_THRESHOLD=0.0001"])
    _, (x, y, _) = transformer.TransformPoint(1, *(float(v) for v in ground))
    np.testing.assert_allclose([x, y], [col, line], atol=0.003)


# Ground, sensor, faults


def test_contrast_and_brightness_are_as_asked() -> None:
    for contrast in (0.02, 0.12):
        plan = StripPlan(**{**SMALL, **STILL, **CLEAR, "contrast": contrast, "bit_depth": 16, "lines": 900})
        _, pairs = simulate_overlaps(plan)
        light = np.concatenate([p.left.ravel() for p in pairs]) / 65535.0
        assert light.mean() == pytest.approx(0.35, rel=0.25)
        assert light.std() / 0.35 == pytest.approx(contrast, rel=0.35)


def test_low_contrast_and_clouds_cover_the_share_asked_for() -> None:
    plan = StripPlan(
        ccds=4, width_px=2000, lines=5000, cloud_cover=0.3, cloud_size_m=1500.0, low_contrast_share=0.4,
        low_contrast=0.005, **CLEAR,
    )  # fmt: skip
    scene = StripWorld(plan)
    cover = np.concatenate([scene.truth(k).cloud_left for k in range(3)])
    assert cover.mean() == pytest.approx(0.3, abs=0.08)
    assert 0.0 in cover
    assert 1.0 in cover
    _, pairs = simulate_overlaps(dataclasses.replace(plan, cloud_cover=0.0))
    spread = np.concatenate([p.left.std(axis=1) / p.left.mean(axis=1) for p in pairs])
    assert (spread < 0.012).mean() == pytest.approx(0.4, abs=0.12)


@pytest.mark.parametrize(("bits", "kind"), [(8, "uint8"), (11, "uint16"), (16, "uint16")])
def test_counts_fill_the_bits_and_glare_saturates(bits: int, kind: str) -> None:
    plan = StripPlan(**{**SMALL, "ccds": 2}, bit_depth=bits, saturated_share=0.5)
    _, (pair,) = simulate_overlaps(plan)
    assert pair.left.dtype == kind
    assert pair.left.max() == 2**bits - 1
    assert 0.05 < (pair.left == 2**bits - 1).mean() < 0.95


def test_noise_and_gain_are_as_asked() -> None:
    plan = StripPlan(**{**SMALL, **STILL, "ccds": 2, "lines": 900, "contrast": 0.0, "bit_depth": 16})
    plan = dataclasses.replace(plan, snr=100.0, gain_sd=0.05, offset_sd=0.01, column_sd=0.004, seed=9)
    _, (pair,) = simulate_overlaps(plan)
    by_column = pair.left.mean(axis=0)
    assert pair.left.std(axis=0).mean() / by_column.mean() == pytest.approx(0.01, rel=0.1)
    assert by_column.std() / by_column.mean() == pytest.approx(0.004, rel=0.4)
    assert abs(pair.left.mean() - pair.right.mean()) > 0.01 * 0.35 * 65535


def test_an_image_given_is_the_ground(tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    image = np.kron(rng.integers(0, 2, (40, 30)), np.ones((8, 8))).astype(np.uint8) * 200 + 20
    path = tmp_path / "ground.png"
    assert cv2.imwrite(str(path), image)
    plan = StripPlan(**{**SMALL, **STILL, **CLEAR, "contrast": 0.3, "bit_depth": 16}, texture=path)
    strip = simulate_overlaps(plan)[1][0].left / 65535.0 / 0.35
    low, high = np.quantile(strip, [0.1, 0.9])
    assert high - low == pytest.approx(0.6, abs=0.1)  # two tones, two standard deviations apart


def test_heights_given_are_the_ground(tmp_path: Path) -> None:
    path = tmp_path / "dem.tif"
    profile = {
        "driver": "GTiff",
        "width": 60,
        "height": 60,
        "count": 1,
        "dtype": "float32",
        "crs": "EPSG:4326",
    }
    ramp = np.broadcast_to(np.linspace(3000.0, 1000.0, 60, dtype=np.float32)[:, None], (60, 60))
    transform = Affine(1.0 / 60, 0.0, 99.9, 0.0, -1.0 / 60, 38.7)
    with rasterio.open(path, "w", **profile, transform=transform) as out:
        out.write(ramp[None])
    plan = StripPlan(**{**SMALL, **STILL, "course_deg": 180.0, "lines": 900}, dem=path)
    scene = StripWorld(plan)
    assert scene.plan.ground_height_m == pytest.approx(2000.0, abs=1.0)
    dline = scene.truth(0).dline_px
    per_line = 2000.0 / (59.0 / 60.0 * 111000.0) * 2.0 / 233.0  # lower to the south, where the flight goes
    assert np.polyfit(np.arange(900), dline, 1)[0] == pytest.approx(per_line, rel=0.03)


def test_dead_short_lost_and_repeated(tmp_path: Path) -> None:
    plain = simulate_strips(tmp_path / "plain", StripPlan(**SMALL, snr=0.0), scene=False)
    plan = StripPlan(**{**SMALL, "snr": 0.0, "ccds": 3, "dead": "1", "short": "3:500", "lost": "2:100:7"})
    faulty = simulate_strips(tmp_path / "faulty", plan, scene=False)
    geometry = read_geometry(faulty.geometry)
    assert geometry.lines == (0, 593, 500)
    assert geometry.ccds[0].path is None
    assert {row["pair"] for row in rows_of(faulty.true_offsets)} == {"1"}
    whole = [pixels(path) for path in plain.strips]
    np.testing.assert_array_equal(pixels(faulty.strips[0]), np.delete(whole[1], slice(100, 107), axis=0))
    np.testing.assert_array_equal(pixels(faulty.strips[1]), whole[2][:500])
    again = dataclasses.replace(plan, dead="", short="", lost="", repeated="2:100:2")
    np.testing.assert_array_equal(again.acquired(1)[98:104], [98, 99, 100, 100, 100, 101])


# Files


def test_the_folder_is_structured_as_documented(spots: SimulatedStrips) -> None:
    out = spots.geometry.parent
    assert sorted(str(p.relative_to(out)) for p in out.rglob("*") if p.is_file()) == [
        "ccd1.tif", "ccd2.tif", "ccd3.tif", "dem.tif", "geometry.yaml", "model.yaml", "model_attitude.csv",
        "model_orbit.csv", "scene_RPC.TXT", "truth/clouds.csv", "truth/dem.tif", "truth/model.yaml",
        "truth/model_attitude.csv", "truth/model_orbit.csv", "truth/offsets.csv", "truth/scene.tif",
        "truth/targets.csv", "truth/truth.json",
    ]  # fmt: skip
    assert spots.files() == sorted(p for p in out.rglob("*") if p.is_file())
    geometry = read_geometry(spots.geometry)
    assert (geometry.lines, geometry.width_px, geometry.bit_depth) == ((600, 600, 600), 128, 16)
    assert geometry.row_separation_lines == 150.0
    assert geometry.model == spots.model
    assert pixels(out / "truth/scene.tif").shape == (600, geometry.scene_width_px)
    assert list(rows_of(spots.true_offsets)[0]) == ["pair", "line", "dcol_px", "dline_px"]
    assert len(rows_of(spots.true_offsets)) == 1200
    assert json.loads(spots.truth.read_text())["plan"]["seed"] == 5


def test_the_true_scene_has_the_points_at_the_ideal_camera_s_places(spots: SimulatedStrips) -> None:
    assert spots.true_scene is not None
    scene = pixels(spots.true_scene).astype(np.float64) - 0.35 * 65535
    rpc = parse_rpc(spots.rpc.read_text())
    for row in rows_of(spots.targets)[:4]:
        ground = [float(row[k]) for k in ("lon_deg", "lat_deg", "height_ellipsoidal_m")]
        col, line = rpc.image_from_ground(ground)
        c, r = int(col) - 7, int(line) - 7
        part = scene[r : r + 15, c : c + 15]
        rows, cols = np.mgrid[r : r + 15, c : c + 15] + 0.5
        assert (part * cols).sum() / part.sum() == pytest.approx(col, abs=0.01)
        assert (part * rows).sum() / part.sum() == pytest.approx(line, abs=0.01)


def test_the_reported_dem_is_off_by_the_bias(tmp_path: Path) -> None:
    written = simulate_strips(tmp_path, StripPlan(**SMALL, dem_bias_m=20.0, dem_error_m=4.0), scene=False)
    away = pixels(written.dem) - pixels(written.true_dem)
    assert away.mean() == pytest.approx(20.0, abs=1.5)
    assert away.std() == pytest.approx(4.0, rel=0.3)


def test_equal_seeds_give_equal_bytes(tmp_path: Path) -> None:
    plan = StripPlan(**SMALL, cloud_cover=0.2, low_contrast_share=0.3)
    one, two = (simulate_strips(tmp_path / name, plan) for name in ("one", "two"))
    for a, b in zip(one.files(), two.files(), strict=True):
        assert a.read_bytes() == b.read_bytes(), a.name
    other = simulate_strips(tmp_path / "other", dataclasses.replace(plan, seed=2), scene=False)
    assert other.strips[0].read_bytes() != one.strips[0].read_bytes()
    with pytest.raises(OutputError, match="holds strips already"):
        simulate_strips(tmp_path / "one", plan)


def test_the_stage_writes_the_scene_and_keeps_its_files(tmp_path: Path) -> None:
    params = SimulateStrips.Params(**SMALL, short="3:400", true_scene=False)
    context = Context(tmp_path / "run", stage_id="simulate.strips", work_folder=tmp_path / "work", seed=3)
    (tmp_path / "run").mkdir()
    outputs = SimulateStrips().run({}, params, context)
    assert outputs["truth_file"].name == "truth/truth.json"
    assert read_geometry(tmp_path / "run" / "geometry.yaml").lines == (600, 600, 400)
    assert {p.name for p in context.kept} >= {"ccd1.tif", "geometry.yaml", "offsets.csv", "model_orbit.csv"}
    defaults = {k: v for k, v in SimulateStrips.Params().model_dump().items() if k != "true_scene"}
    assert defaults == {k: v for k, v in dataclasses.asdict(StripPlan()).items() if k != "seed"}


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"overlap_px": 70}, "an overlap of 70 px, read 60 px, doesn't fit strips of 128 px"),
        ({"lines": 150}, "150 lines are no more than the rows' separation"),
        ({"parallax_m_per_line": 20000.0}, "wants an orbit above 2000 km"),
        ({"dead": "4"}, "dead: there is no CCD 4"),
        ({"short": "2"}, "short is '2'; give ccd:lines"),
        ({"lost": "2:3"}, "lost is '2:3'; give ccd:line:count"),
        ({"repeated": "a:3:1"}, "repeated is 'a:3:1'"),
    ],
)
def test_a_plan_that_can_t_be_is_one_clear_line(changes: dict[str, Any], text: str) -> None:
    with pytest.raises(InputError) as caught:
        StripPlan(**{**SMALL, **changes})
    assert text in str(caught.value)


@pytest.mark.parametrize(
    ("content", "text"),
    [("time,a,b\n0,1,2\n", "its first line isn't"), ("time_s,along_px,across_px\n0,x,2\n", "no number"),
     ("time_s,along_px,across_px\n1,0,0\n0,0,0\n", "times don't rise")],
)  # fmt: skip
def test_a_motion_that_can_t_be_read_is_named(tmp_path: Path, content: str, text: str) -> None:
    path = tmp_path / "m.csv"
    path.write_text(content)
    with pytest.raises(InputError, match=text) as caught:
        StripWorld(StripPlan(**SMALL, motion=path))
    assert "m.csv" in str(caught.value)


@pytest.mark.parametrize(
    ("key", "value", "text"),
    [("looks", [], "isn't a list of look angles"), ("line_rate_hz", "fast", "line_rate_hz isn't 1 number"),
     ("orbit", "none.csv", "there is no such file"), ("orbit", "model_attitude.csv", "its first line isn't"),
     ("speed", 3, "unknown model key 'speed'"), ("attitude", None, "names None as a table"),
     ("looks", [{"forward_tan": [0, 0, 0], "right_tan": [0, 0, 0]}], "doesn't change with the column")],
)  # fmt: skip
def test_a_model_that_can_t_be_read_is_named(
    spots: SimulatedStrips, tmp_path: Path, key: str, value: Any, text: str
) -> None:
    for name in ("model.yaml", "model_orbit.csv", "model_attitude.csv"):
        shutil.copy(spots.model.with_name(name), tmp_path / name)
    path = tmp_path / "model.yaml"
    path.write_text(yaml.safe_dump({**yaml.safe_load(path.read_text()), key: value}))
    with pytest.raises(InputError, match=text) as caught:
        read_model(path)
    assert str(tmp_path) in str(caught.value)


@pytest.fixture(scope="module")
def elsewhere(tmp_path_factory: pytest.TempPathFactory) -> SimulatedStrips:
    """A scene of the same camera, 300 km to the east."""
    plan = StripPlan(**{**SMALL, "lon_deg": 104.0, "parallax_m_per_line": 1000.0})
    return simulate_strips(tmp_path_factory.mktemp("elsewhere"), plan, scene=False)


@pytest.mark.parametrize(
    ("keep", "text"),
    [(("model", "dem"), r"is of another scene: its middle is 31\d km from where the model looks"),
     (("dem",), r"is of another scene: its middle \(104.000, 38.200 deg\) is not on dem.tif")],
)  # fmt: skip
def test_an_rpc_of_another_scene_is_named(
    spots: SimulatedStrips, elsewhere: SimulatedStrips, keep: tuple[str, ...], text: str
) -> None:
    entry = yaml.safe_load(spots.geometry.read_text())
    entry = {k: v for k, v in entry.items() if k in keep or k not in ("dem", "model")}
    path = spots.geometry.with_name("other.yaml")
    try:
        path.write_text(yaml.safe_dump({**entry, "rpc": str(elsewhere.rpc)}))
        with pytest.raises(InputError, match=text) as caught:
            read_geometry(path)
        assert "scene_RPC.TXT" in str(caught.value)
    finally:
        path.unlink()


def test_companions_that_don_t_fit_are_named(spots: SimulatedStrips, tmp_path: Path) -> None:
    for file in spots.geometry.parent.glob("*.*"):
        shutil.copy(file, tmp_path / file.name)
    entry = yaml.safe_load(spots.geometry.read_text())
    path = tmp_path / "geometry.yaml"
    ccds = entry["ccds"]
    small = (
        spots.rpc.read_text()
        .replace("LINE_OFF: 299.5", "LINE_OFF: 49.5")
        .replace("LINE_SCALE: 300", "LINE_SCALE: 50")
    )
    (tmp_path / "small_RPC.TXT").write_text(small)
    for changes, text in (
        ({"line_rate_hz": 3000.0}, "model.yaml: has 3272.4 lines a second, the geometry 3000"),
        ({"ccds": ccds[:2]}, "model.yaml: has looks for 3 CCDs, the geometry has 2"),
        ({"rpc": "model.yaml"}, "model.yaml: is no RPC and no raster that holds one"),
        ({"rpc": "ccd1.tif"}, "ccd1.tif: the RPC has no LINE_OFF"),
        ({"rpc": "small_RPC.TXT"}, "some 288 x 100 px, where the strips make 288 x 600"),
        ({"dem": "model.yaml"}, "model.yaml: is no raster file that can be read"),
    ):
        path.write_text(yaml.safe_dump({**entry, **changes}))
        with pytest.raises(InputError) as caught:
            read_geometry(path)
        assert text in str(caught.value)


def test_a_model_of_text_and_a_table_of_text(spots: SimulatedStrips, tmp_path: Path) -> None:
    (tmp_path / "model.yaml").write_text("{")
    with pytest.raises(FileError, match="is no valid YAML"):
        read_model(tmp_path / "model.yaml")
    shutil.copy(spots.model, tmp_path / "model.yaml")
    (tmp_path / "model_orbit.csv").write_text("time_s,x_m,y_m,z_m\n0,1,2\n")
    with pytest.raises(InputError, match="isn't a table of at least four lines"):
        read_model(tmp_path / "model.yaml")
