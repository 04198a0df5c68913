"""A simulated survey on disk, read back by other readers than those that wrote it."""

from __future__ import annotations

import csv
import dataclasses
import json
from pathlib import Path

import cv2
import exifread
import numpy as np
import pytest
import rasterio
from defusedxml.ElementTree import fromstring
from pyproj import Geod
from small_surveys import simulated

from geomosaic.camera.exterior import Pose
from geomosaic.camera.rotation import Rotation, about_z
from geomosaic.errors import OutputError
from geomosaic.geodesy.local import LocalFrame
from geomosaic.geodesy.mapcrs import MapProjection
from geomosaic.pipeline.stage import Context
from geomosaic.survey.header import read_header
from geomosaic.survey.inputs import SurveyInputs
from geomosaic.survey.read import read_survey
from geomosaic_simulate.exif import sexagesimal
from geomosaic_simulate.plan import SurveyPlan
from geomosaic_simulate.stage_frames import SimulateFrames
from geomosaic_simulate.survey import SimulatedSurvey, simulate_frames
from geomosaic_simulate.write import gimbal_deg

SMALL = {"lines": 1, "frames_per_line": 3, "width_px": 240, "height_px": 180, "height_above_ground_m": 30.0}
OFF_CENTRE = {"principal_col_offset_px": 6.0, "principal_row_offset_px": -4.0, "p1": 0.004}
PLAN = SurveyPlan(
    seed=11, turned="2", k1=0.0, k2=0.0, lat_deg=-33.5, lon_deg=-70.6,
    **OFF_CENTRE, **SMALL,
)  # fmt: skip
DJI = "{http://www.dji.com/drone-dji/1.0/}"


@pytest.fixture(scope="module")
def survey(tmp_path_factory: pytest.TempPathFactory) -> SimulatedSurvey:
    return simulate_frames(tmp_path_factory.mktemp("survey"), PLAN)


def rows_of(path: Path | None) -> list[dict[str, str]]:
    assert path is not None
    with path.open(newline="") as f:
        return list(csv.DictReader(f))


def contents(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def test_the_folder_is_structured_as_documented(survey: SimulatedSurvey) -> None:
    out = survey.camera.parent
    assert sorted(contents(out)) == [
        "cameras.json", "frames/F0001.jpg", "frames/F0002.jpg", "frames/F0003.jpg", "pos.csv",
        "truth/cameras.json", "truth/dem.tif", "truth/ortho.tif", "truth/positions.csv", "truth/truth.json",
    ]  # fmt: skip


def test_equal_plans_write_equal_bytes_and_may_be_repeated_in_place(
    survey: SimulatedSurvey, tmp_path: Path
) -> None:
    first = contents(survey.camera.parent)
    simulate_frames(tmp_path / "again", PLAN)
    assert contents(tmp_path / "again") == first
    simulate_frames(tmp_path / "again", PLAN)
    assert contents(tmp_path / "again") == first
    simulate_frames(tmp_path / "other", dataclasses.replace(PLAN, seed=12))
    other = contents(tmp_path / "other")
    assert other.keys() == first.keys()
    same = {name for name in first if first[name] == other[name]}
    assert same == {"cameras.json", "truth/cameras.json"} | (same & {"truth/dem.tif"})


def test_exif_says_what_the_pos_says_to_the_digit(survey: SimulatedSurvey) -> None:
    pos = rows_of(survey.pos)[2]
    path = survey.frames / "F0003.jpg"
    with path.open("rb") as f:
        tags = exifread.process_file(f, details=False)
    assert str(tags["Image Make"]) == "geomosaic"
    assert str(tags["Image Model"]) == "simulated"
    assert tags["Image Orientation"].values == [1]
    assert str(tags["EXIF DateTimeOriginal"]) == "2024:06:12 09:30:01"
    assert str(tags["EXIF SubSecTimeOriginal"]) == "350"
    assert float(tags["EXIF FocalLength"].values[0]) == pytest.approx(300.0 * 13.2 / 240.0, abs=5e-4)
    assert tags["EXIF FocalLengthIn35mmFilm"].values == [43]
    for axis in "XY":
        per_mm = float(tags[f"EXIF FocalPlane{axis}Resolution"].values[0])
        assert per_mm == pytest.approx(240.0 / 13.2, rel=1e-9)
    assert tags["EXIF FocalPlaneResolutionUnit"].values == [4]
    assert (tags["EXIF ExifImageWidth"].values, tags["EXIF ExifImageLength"].values) == ([240], [180])
    for axis, negative in (("Latitude", "S"), ("Longitude", "W")):
        d, m, s = (float(v) for v in tags[f"GPS GPS{axis}"].values)
        assert str(tags[f"GPS GPS{axis}Ref"]) == negative
        said = float(pos["lat_deg" if axis == "Latitude" else "lon_deg"])
        assert -(d + m / 60.0 + s / 3600.0) == pytest.approx(said, abs=8e-10)
        assert 0 <= m < 60 and 0 <= s < 60
    assert float(tags["GPS GPSAltitude"].values[0]) == pytest.approx(
        float(pos["height_ellipsoidal_m"]), abs=6e-4
    )
    assert tags["GPS GPSAltitudeRef"].values == [0]


def test_xmp_says_the_same_attitude(survey: SimulatedSurvey) -> None:
    for pos in rows_of(survey.pos):
        data = (survey.frames / pos["frame"]).read_bytes()
        packet = data[data.index(b"<x:xmpmeta") : data.index(b"</x:xmpmeta>") + 12]
        (description,) = fromstring(packet)[0]
        words = {key.removeprefix(DJI): v for key, v in description.attrib.items() if key.startswith(DJI)}
        assert words.pop("ShutterType") == "Mechanical"
        tags = {name: float(v) for name, v in words.items()}
        gimbal = (tags["GimbalYawDegree"], tags["GimbalPitchDegree"], tags["GimbalRollDegree"])
        said = Rotation.from_gimbal(*np.radians(gimbal)).matrix
        body = [float(pos[k]) for k in ("yaw_deg", "pitch_deg", "roll_deg")]
        np.testing.assert_allclose(said, Rotation.from_yaw_pitch_roll(*np.radians(body)).matrix, atol=4e-6)
        assert tags["GimbalPitchDegree"] == pytest.approx(-90.0, abs=6.0)
        assert tags["FlightYawDegree"] == pytest.approx((body[0] + 180.0) % 360.0 - 180.0, abs=0.006)
        height = float(pos["height_ellipsoidal_m"])
        assert tags["AbsoluteAltitude"] == pytest.approx(height, abs=6e-4)
        assert tags["RelativeAltitude"] == pytest.approx(height - 520.0, abs=6e-4)


def test_gimbal_angles_looking_forward() -> None:
    yaw, pitch, roll = gimbal_deg(np.array([40.0, 30.0, 0.0]))
    np.testing.assert_allclose([yaw, pitch, roll], [40.0, -60.0, 0.0], atol=1e-9)


def test_positions_are_of_the_images_as_they_are_stored(survey: SimulatedSurvey) -> None:
    truth = json.loads(survey.truth.read_text())
    for row, frame in zip(rows_of(survey.positions), truth["frames"], strict=True):
        yaw, pitch, roll = frame["true_yaw_pitch_roll_deg"]
        turned = frame["frame"] == "F0002.jpg"
        assert frame["turned"] is turned
        assert float(row["yaw_deg"]) == pytest.approx((yaw + 180.0 * turned) % 360.0, abs=0.1)
        sign = -1.0 if turned else 1.0
        assert float(row["pitch_deg"]) == pytest.approx(-90.0 + sign * pitch, abs=0.05)
        assert float(row["roll_deg"]) == pytest.approx(sign * roll, abs=0.05)
        opk = Rotation.from_omega_phi_kappa(
            *(np.radians(float(row[f"{k}_deg"])) for k in ("omega", "phi", "kappa"))
        )
        body = np.radians([float(row["yaw_deg"]), float(row["pitch_deg"]) + 90.0, float(row["roll_deg"])])
        to_grid = about_z(np.radians(0.883))  # (longitude - 69 W) * sin(latitude): true north lies west
        true_axes = Rotation.from_yaw_pitch_roll(*body).matrix
        np.testing.assert_allclose(opk.matrix, to_grid @ true_axes, atol=1e-5)
        assert float(row["moved_m"]) == pytest.approx(np.linalg.norm(frame["position_error_m"]), abs=1e-4)
        at = MapProjection("EPSG:32719").map_from_geodetic(float(row["lon_deg"]), float(row["lat_deg"]))
        np.testing.assert_allclose([float(row["easting_m"]), float(row["northing_m"])], at, atol=1e-4)
    assert truth["map_crs"] == "EPSG:32719"
    assert [w["frame"] for w in truth["warnings"] if w["code"] == "turned-frame"] == ["F0002.jpg"]


def test_a_stored_frame_lies_on_the_ortho_by_its_true_position(survey: SimulatedSurvey) -> None:
    """From the files alone: also of the turned frame, whose position row is of the turned image."""
    work = LocalFrame(-70.6, -33.5, 520.0)
    camera = PLAN.camera()
    with rasterio.open(survey.ortho) as ortho:
        image, inside, to_map = ortho.read(2).astype(float), ortho.dataset_mask() > 0, ortho.transform
        assert ortho.crs.to_epsg() == 32719
        assert (to_map.a, to_map.e) == (0.1, -0.1)
    cols, rows = np.meshgrid(np.arange(image.shape[1]) + 0.5, np.arange(image.shape[0]) + 0.5)
    e, n = to_map.c + cols * 0.1, to_map.f - rows * 0.1
    lonlat = MapProjection("EPSG:32719").geodetic_from_map(e, n)
    ground = work.enu_from_geodetic(lonlat[..., 0], lonlat[..., 1], 520.0)
    seen = np.zeros(inside.shape, bool)
    for row in rows_of(survey.positions):
        lon, lat, height, yaw, pitch, roll = (
            float(row[k])
            for k in ("lon_deg", "lat_deg", "height_ellipsoidal_m", "yaw_deg", "pitch_deg", "roll_deg")
        )
        pose = Pose(
            work.enu_from_geodetic(lon, lat, height),
            Rotation.from_yaw_pitch_roll(*np.radians([yaw, pitch + 90.0, roll])),
        )
        px = pose.image_from_ground(camera.turned(2) if row["frame"] == "F0002.jpg" else camera, ground)
        here = (px > 3.0).all(axis=-1) & (px[..., 0] < 237.0) & (px[..., 1] < 177.0)
        seen |= ((px > 0.0) & (px < [240.0, 180.0])).all(axis=-1)
        frame = cv2.imread(str(survey.frames / row["frame"]), cv2.IMREAD_COLOR)[..., 1].astype(np.float32)
        at = (np.nan_to_num(px[..., k]).astype(np.float32) - 0.5 for k in (0, 1))
        back = cv2.remap(frame, *at, cv2.INTER_CUBIC)
        score = [
            np.corrcoef(back[here], np.roll(image, shift, (0, 1))[here])[0, 1]
            for shift in ((0, 0), (0, 1), (0, -1), (1, 0), (-1, 0))
        ]
        assert score[0] > 0.93
        assert score[0] > max(score[1:]) + 0.03
    assert (seen != inside).mean() < 0.001, "the mask is the union of the footprints"


def test_turning_turns_pixels_and_nothing_else(tmp_path: Path) -> None:
    lossless = dataclasses.replace(PLAN, format="tiff8", pos_in="csv", turned="")
    straight = simulated(tmp_path / "a", lossless)
    turned = simulated(tmp_path / "b", dataclasses.replace(lossless, turned="1"))
    a, b = (cv2.imread(str(s.frames / "F0001.tif"), cv2.IMREAD_UNCHANGED) for s in (straight, turned))
    assert np.array_equal(a[::-1, ::-1], b)
    assert rows_of(straight.pos) == rows_of(turned.pos)


def test_sixteen_bits_hold_more_than_eight(tmp_path: Path) -> None:
    plan = dataclasses.replace(PLAN, format="tiff16", pos_in="csv", frames_per_line=1, turned="")
    frame = cv2.imread(str(simulated(tmp_path, plan).frames / "F0001.tif"), cv2.IMREAD_UNCHANGED)
    assert frame.dtype == np.uint16 and frame.shape == (180, 240, 3)
    assert np.unique(frame).size > 2000


def test_hills_and_standing_buildings_are_in_the_height_models(tmp_path: Path) -> None:
    plan = dataclasses.replace(
        PLAN, relief_m=8.0, relief_wavelength_m=60.0, buildings=3.0, buildings_stand=True
    )
    survey = simulated(tmp_path, plan)
    relief = json.loads(survey.truth.read_text())["relief"]
    assert relief["amplitude_m"] >= 8.0
    assert survey.dsm is not None
    with rasterio.open(survey.ortho) as ortho:
        rows, cols = np.nonzero(ortho.dataset_mask())
        e = ortho.bounds.left + (cols[::97] + 0.5) * 0.1
        n = ortho.bounds.top - (rows[::97] + 0.5) * 0.1
    with rasterio.open(survey.dem) as dem, rasterio.open(survey.dsm) as dsm:
        assert dem.res == dsm.res == pytest.approx((0.2, 0.2))
        assert dem.tags(1)["HEIGHTS"].startswith("ellipsoidal")
        inside = np.array([v[0] for v in dem.sample(np.column_stack([e, n]))])
        roofs = dsm.read(1) - dem.read(1)
    assert inside.max() - inside.min() == pytest.approx(8.0, abs=0.5)
    assert (inside.max() + inside.min()) / 2.0 == pytest.approx(520.0, abs=0.5)
    assert roofs.min() == pytest.approx(0.0, abs=0.01)
    assert 3.0 < np.percentile(roofs[roofs > 1.0], 50) < 12.0


def test_what_is_not_reported_is_not_written(tmp_path: Path) -> None:
    plan = dataclasses.replace(
        PLAN, frames_per_line=1, turned="", attitude_reported=False, height_reported=False, lens_reported=False, k1=-0.1,
        focal_error=0.05,
    )  # fmt: skip
    survey = simulated(tmp_path, plan)
    assert list(rows_of(survey.pos)[0]) == ["frame", "lon_deg", "lat_deg", "sd_horizontal_m"]
    data = (survey.frames / "F0001.jpg").read_bytes()
    assert b"Gimbal" not in data and b"Altitude" not in data
    with (survey.frames / "F0001.jpg").open("rb") as f:
        tags = exifread.process_file(f, details=False)
    assert "GPS GPSLatitude" in tags and "GPS GPSAltitude" not in tags
    (reported,) = json.loads(survey.camera.read_text()).values()
    (true,) = json.loads((survey.positions.parent / "cameras.json").read_text()).values()
    assert reported["k1"] == 0.0 and true["k1"] == -0.1
    assert reported["focal_x"] == pytest.approx(1.05 * 300.0 / 240.0)
    assert true["focal_x"] == pytest.approx(300.0 / 240.0)


def test_kappa_is_the_grid_heading_of_a_level_frame(tmp_path: Path) -> None:
    level = {"wander_m": 0.0, "wander_tilt_deg": 0.0, "wander_yaw_deg": 0.0}
    plan = dataclasses.replace(PLAN, lat_deg=52.0, lon_deg=13.1, heading_deg=70.0, turned="", **level)
    row = rows_of(simulated(tmp_path, plan).positions)[1]
    lon, lat = float(row["lon_deg"]), float(row["lat_deg"])
    ahead = Geod(ellps="WGS84").fwd(lon, lat, float(row["yaw_deg"]), 100.0)[:2]
    projection = MapProjection("EPSG:32633")
    step = projection.map_from_geodetic(*ahead) - projection.map_from_geodetic(lon, lat)
    grid_heading = np.degrees(np.arctan2(*step))
    assert float(row["yaw_deg"]) == pytest.approx(70.0, abs=1e-3)
    assert grid_heading == pytest.approx(71.497, abs=1e-3), "west of the meridian: grid north lies west"
    assert -float(row["kappa_deg"]) == pytest.approx(grid_heading, abs=1e-3)


def test_a_survey_without_a_camera_file_starts_from_the_right_focal_length(
    survey: SimulatedSurvey,
) -> None:
    read = read_survey(SurveyInputs(survey.frames))
    (camera,) = read.cameras
    assert camera.focal_length_px == pytest.approx(300.0, abs=0.02)
    assert [f.position.height_above_ground_m for f in read.frames] == pytest.approx([30.0] * 3, abs=8.0)


def test_absolute_heights_alone_with_a_common_bias(tmp_path: Path) -> None:
    one = dataclasses.replace(PLAN, turned="")
    biased = dataclasses.replace(one, height_bias_m=-45.0, position_bias_m=5.0)
    plain, off = simulated(tmp_path / "plain", one), simulated(tmp_path / "off", biased)
    positions = [[f.position for f in read_survey(SurveyInputs(s.frames)).frames] for s in (plain, off)]
    for true, said in zip(*positions, strict=True):
        assert said.height_ellipsoidal_m is not None and true.height_ellipsoidal_m is not None
        assert said.height_ellipsoidal_m - true.height_ellipsoidal_m == pytest.approx(-45.0, abs=2e-3)
        assert said.height_above_ground_m == pytest.approx(true.height_above_ground_m, abs=2e-3)
    errors = [
        np.array([f["position_error_m"] for f in json.loads(s.truth.read_text())["frames"]])
        for s in (plain, off)
    ]
    bias = json.loads(off.truth.read_text())["position_bias_m"]
    np.testing.assert_allclose(errors[1] - errors[0], [bias] * 3, atol=1e-9)
    assert np.hypot(*bias[:2]) == pytest.approx(5.0) and bias[2] == -45.0
    silent = simulated(tmp_path / "silent", dataclasses.replace(biased, relative_height_reported=False))
    for frame in read_survey(SurveyInputs(silent.frames)).frames:
        assert frame.position.height_above_ground_m is None
        assert frame.position.height_ellipsoidal_m is not None


def test_the_barometer_does_not_drift_with_the_gps(tmp_path: Path) -> None:
    one = dataclasses.replace(PLAN, turned="")
    plain = simulated(tmp_path / "plain", one)
    drifting = simulated(tmp_path / "drifting", dataclasses.replace(one, height_drift_m=30.0))
    positions = [[f.position for f in read_survey(SurveyInputs(s.frames)).frames] for s in (plain, drifting)]
    rises = [0.0, 15.0, 30.0]
    for rise, true, said in zip(rises, *positions, strict=True):
        assert said.height_ellipsoidal_m - true.height_ellipsoidal_m == pytest.approx(rise, abs=2e-3)
        assert said.height_above_ground_m == pytest.approx(true.height_above_ground_m, abs=2e-3)


def test_stated_deviations_may_be_wrong(tmp_path: Path) -> None:
    plan = dataclasses.replace(PLAN, frames_per_line=2, stated_sd_factor=0.2, stated_yaw_sd_deg=5.0)
    rows = rows_of(simulated(tmp_path / "wrong", plan).pos)
    for row in rows:
        stated = [float(row[f"sd_{k}"]) for k in ("horizontal_m", "vertical_m", "yaw_deg", "tilt_deg")]
        np.testing.assert_allclose(stated, [0.3, 0.4, 1.0, 0.06])
    honest = rows_of(simulated(tmp_path / "honest", dataclasses.replace(PLAN, frames_per_line=2)).pos)
    assert [r["lon_deg"] for r in rows] == [r["lon_deg"] for r in honest]


def test_lost_frames_are_nowhere_but_change_no_other(survey: SimulatedSurvey, tmp_path: Path) -> None:
    lacking = simulated(tmp_path, dataclasses.replace(PLAN, lost="1"))
    assert sorted(p.name for p in lacking.frames.iterdir()) == ["F0002.jpg", "F0003.jpg"]
    for name in ("F0002.jpg", "F0003.jpg"):
        assert (lacking.frames / name).read_bytes() == (survey.frames / name).read_bytes()
    assert rows_of(lacking.pos) == rows_of(survey.pos)[1:]
    assert rows_of(lacking.positions) == rows_of(survey.positions)[1:]
    truth = json.loads(lacking.truth.read_text())
    assert [f["frame"] for f in truth["frames"]] == ["F0002.jpg", "F0003.jpg"]


def test_the_pos_in_exif_alone_or_in_the_csv_alone(tmp_path: Path) -> None:
    one = dataclasses.replace(PLAN, frames_per_line=1, turned="")
    exif = simulated(tmp_path / "exif", dataclasses.replace(one, pos_in="exif"))
    assert exif.pos is None and not (tmp_path / "exif" / "pos.csv").exists()
    table = simulated(tmp_path / "csv", dataclasses.replace(one, pos_in="csv"))
    with (table.frames / "F0001.jpg").open("rb") as f:
        tags = exifread.process_file(f, details=False)
    assert "EXIF FocalLength" in tags and not any(key.startswith("GPS") for key in tags)


def test_sexagesimal_never_says_sixty_seconds() -> None:
    assert [float(v) for v in sexagesimal(11.99999999999)] == [12.0, 0.0, 0.0]
    assert [float(v) for v in sexagesimal(-7.508339)] == pytest.approx([7.0, 30.0, 30.0204])


def test_strange_frames_are_not_written_over(tmp_path: Path) -> None:
    (tmp_path / "frames").mkdir()
    (tmp_path / "frames" / "DJI_0001.JPG").write_bytes(b"precious")
    with pytest.raises(OutputError, match=r"frames: holds frames of something else \(DJI_0001.JPG\)"):
        simulated(tmp_path, PLAN)
    assert contents(tmp_path) == {"frames/DJI_0001.JPG": b"precious"}


def test_a_folder_that_can_not_be_made(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="file/out"):
        simulated(tmp_path / "file" / "out", PLAN)


def test_the_stage_declares_every_number_of_the_plan(tmp_path: Path) -> None:
    fields = {f.name: f.default for f in dataclasses.fields(SurveyPlan) if f.name != "seed"}
    assert SimulateFrames.Params().model_dump() == {"dirty": None, "without": "", **fields}


def test_the_stage_writes_the_survey_into_its_folder(tmp_path: Path) -> None:
    done: list[tuple[int, int, str]] = []
    context = Context(
        tmp_path / "out",
        work_folder=tmp_path / "work",
        seed=3,
        on_progress=lambda n, of, text: done.append((n, of, text)),
    )
    outputs = SimulateFrames().run({}, SimulateFrames.Params(**SMALL), context)
    assert outputs["truth_file"].name == "truth/truth.json"
    assert json.loads((tmp_path / "out" / "truth" / "truth.json").read_text())["seed"] == 3
    assert done[-1] == (3, 3, "frames")
    kept = {str(p.relative_to(tmp_path / "out")) for p in context.kept}
    assert kept == {*contents(tmp_path / "out")} - {"truth/cameras.json"}


def test_frames_report_the_exposure_that_the_automatic_chose(tmp_path: Path) -> None:
    """Half the brightness aimed at, in the shadow of clouds: twice the exposure time, read back from tags."""
    plan = dataclasses.replace(PLAN, turned="", pixel_noise=0.0, exposure_sd=0.0, clouds=0.5)
    automatic = dataclasses.replace(plan, auto_exposure=1.0, exposure_reported=True)
    ground = simulated(tmp_path / "plain", plan)
    even = simulated(tmp_path / "automatic", automatic)
    light, exposure = [], []
    for path in sorted(ground.frames.iterdir()):
        light.append(float(cv2.imread(str(path)).mean()))
        exposure.append(read_header(even.frames / path.name).exif.exposure or 0.0)
        assert read_header(path).exif.exposure == pytest.approx(1.0 / 800.0 / 2.8**2)
    assert max(light) < 60.0
    np.testing.assert_allclose(
        np.array(light) * exposure, 110.0 / 800.0 / 2.8**2, rtol=0.02, err_msg="110 is the mean aimed at"
    )
