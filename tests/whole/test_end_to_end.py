"""From frames to a run folder with the command line, against simulated truth; every file opened by others."""

from __future__ import annotations

import base64
import csv
import re
import shutil
import warnings
from pathlib import Path

import cv2
import numpy as np
import pytest
import rasterio
from osgeo import ogr
from osgeo_utils.samples.validate_cloud_optimized_geotiff import validate
from rasterio.errors import NotGeoreferencedWarning
from small_surveys import NOISE_M, mosaic, small_survey, summary, warned

from geomosaic.adjustment.methods import METHODS
from geomosaic.doors.raster import OWN, open_raster
from geomosaic.export.positions import COLUMNS
from geomosaic.pipeline.run_folder import MARKER
from geomosaic.pipeline.run_results import load_artefact
from geomosaic.recording import read_recording
from geomosaic.report.given import GivenMosaic
from geomosaic.report.glance import Glance
from geomosaic_simulate.survey import SimulatedSurvey

PATCHES = [f"--set=quality.compare.{k}_px={v}" for k, v in (("patch", 48), ("step", 24), ("search", 32))]
LAYERS = {"frames", "footprints", "nadir_points", "tie_points", "residuals", "seamlines",
          "error_ellipses", "image_residuals", "control", "control_residuals", "moves", "trimmed"}  # fmt: skip


def companions(survey: SimulatedSurvey) -> list[str]:
    """Options of the files next to the frames."""
    return ["--pos", str(survey.pos), "--camera", str(survey.camera)]


def compared(survey: SimulatedSurvey) -> list[str]:
    """Against the true ortho."""
    return ["--reference", str(survey.ortho), *PATCHES]


def rows(path: Path) -> list[dict[str, str]]:
    """A CSV file."""
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def off_m(run: Path, survey: SimulatedSurvey) -> np.ndarray:
    """Each frame's position minus the true one: east, north, up; (n, 3)."""
    columns = ("lon_deg", "lat_deg", "height_ellipsoidal_m")
    found, true = (
        {r["frame"]: [float(r[c]) for c in columns] for r in rows(path)}
        for path in (run / "positions.csv", survey.positions)
    )
    assert found.keys() == true.keys()
    lon, lat, up = (np.array([found[n] for n in sorted(true)]) - [true[n] for n in sorted(true)]).T
    radians = np.radians([(lon + 180.0) % 360.0 - 180.0, lat])
    middle = np.radians(next(iter(true.values()))[1])
    return np.column_stack([6_388_000.0 * np.cos(middle) * radians[0], 6_368_000.0 * radians[1], up])


def rms(values: np.ndarray) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def likeness(image: Glance, mosaic_file: Path, east_m: float) -> float:
    """How well an image and a mosaic correlate where both show the ground, one of them moved."""
    given = cv2.imdecode(np.frombuffer(base64.b64decode(image.uri.split(",")[1]), np.uint8), -1)
    with rasterio.open(mosaic_file) as raster:
        grey, valid = cv2.blur(raster.read(2).astype(float), (9, 9)), raster.dataset_mask() > 0
        rows, cols = (at.ravel() for at in np.mgrid[8 : raster.height : 16, 8 : raster.width : 16])
        t = raster.transform
        east, north = t.c + (cols + 0.5) * t.a, t.f + (rows + 0.5) * t.e
    at = np.floor(image.at(np.stack([east + east_m, north], axis=1))).astype(int)
    inside = ((at >= 0) & (at < [image.width_px, image.height_px])).all(axis=1) & valid[rows, cols]
    col, row = at[inside].T
    shown = given[row, col, 3] > 0
    other = cv2.blur(given[..., 1].astype(float), (9, 9))[row, col]
    assert shown.sum() > 100
    return float(np.corrcoef(grey[rows, cols][inside][shown], other[shown])[0, 1])


@pytest.fixture(scope="session")
def block(tmp_path_factory: pytest.TempPathFactory) -> SimulatedSurvey:
    """Two lines of four frames over flat ground, JPEG with tags."""
    return small_survey(tmp_path_factory.mktemp("block"))


@pytest.fixture(scope="session")
def run(block: SimulatedSurvey, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The block's run folder."""
    folder = tmp_path_factory.mktemp("runs") / "run"
    fewer = "--set=matching.sift.keypoints=1500"
    assert mosaic(block.frames, folder, *companions(block), *compared(block), fewer) == 0
    return folder


def test_the_run_folder_holds_just_what_is_promised(run: Path) -> None:
    names = {p.name for p in run.iterdir()}
    promised = {"mosaic.tif", "layers.gpkg", "positions.csv", "run.mcap", "run.json", "report.html", "work"}
    promised |= {"accuracy.tif", "accuracy_report.json", "sources.tif", "project.qgz", MARKER}
    assert names == promised
    assert not [p for p in run.rglob("*") if ".part" in p.name or p.name.endswith("-journal")]


def test_the_mosaic_is_a_cog_on_the_map(run: Path, block: SimulatedSurvey) -> None:
    doubts, errors, _ = validate(str(run / "mosaic.tif"), full_check=True)
    assert (doubts, errors) == ([], [])
    of_mosaic = summary(run)["mosaic"]
    with rasterio.open(run / "mosaic.tif") as tiff, rasterio.open(block.ortho) as true:
        assert tiff.crs.to_epsg() == 32632 and of_mosaic["crs"] == "EPSG:32632"
        assert (tiff.width, tiff.height) == (of_mosaic["width"], of_mosaic["height"])
        assert tiff.transform.a == -tiff.transform.e == of_mosaic["gsd_m"]
        assert 0.095 < of_mosaic["gsd_m"] < 0.105
        assert tiff.dtypes[:3] == ("uint8",) * 3
        filled = (tiff.dataset_mask() > 0).sum() * tiff.transform.a**2
        wanted = (true.dataset_mask() > 0).sum() * true.transform.a**2
        # the true ortho has a margin around the frames; a shrunk block would lack a tenth and more
        assert 0.8 * wanted < filled < 1.02 * wanted


def test_the_mosaic_is_true(run: Path, block: SimulatedSurvey) -> None:
    quality = summary(run)["metrics"]["quality"]
    assert quality["share_measured"] > 0.9 and quality["measured"] > 100
    assert 0.02 < quality["absolute_rmse_m"] < 2.0 * NOISE_M
    assert 0.02 < quality["after_similarity_px"] < 0.5
    assert 0.05 < quality["jump_99_px"] < 1.5
    assert quality["ssim"]["ssim"] < 0.9999


def test_every_layer_has_a_crs_an_index_and_features(run: Path) -> None:
    package = ogr.Open(str(run / "layers.gpkg"))
    layers = {package.GetLayer(i).GetName(): package.GetLayer(i) for i in range(package.GetLayerCount())}
    assert layers.keys() == LAYERS | {"layer_styles"}
    assert layers.pop("layer_styles").GetFeatureCount() == len(LAYERS)
    for name, layer in layers.items():
        assert layer.GetSpatialRef().GetAuthorityCode(None) == "32632"
        query = f"SELECT HasSpatialIndex('{name}', '{layer.GetGeometryColumn()}')"
        result = package.ExecuteSQL(query, dialect="SQLITE")
        assert result.GetNextFeature().GetField(0) == 1
        package.ReleaseResultSet(result)
        count = layer.GetFeatureCount()
        if not name.startswith(("control", "trimmed")):
            assert count == 8 if name in ("frames", "footprints", "nadir_points") else count > 7, name
    feature = layers["frames"].GetNextFeature()
    assert feature.GetField("frame") == "F0001.jpg" and feature.GetField("status") == "tied"


def test_positions_have_the_promised_columns_and_lie_near_the_truth(
    run: Path, block: SimulatedSurvey
) -> None:
    table = rows(run / "positions.csv")
    assert tuple(table[0]) == COLUMNS
    assert [r["frame"] for r in table] == [f"F{i:04d}.jpg" for i in range(1, 9)]
    assert {r["status"] for r in table} == {"tied"}
    off = off_m(run, block)
    assert 0.01 < rms(off[:, :2]) < NOISE_M
    assert 0.01 < rms(off[:, 2]) < 2.0 * NOISE_M
    true = {r["frame"]: r for r in rows(block.positions)}
    for r in table:
        t = true[r["frame"]]
        turn = (float(r["yaw_deg"]) - float(t["yaw_deg"]) + 180.0) % 360.0 - 180.0
        assert abs(turn) < 2.0
        assert abs(float(r["pitch_deg"]) - float(t["pitch_deg"])) < 1.0
        assert -93.5 < float(r["pitch_deg"]) < -86.5
        assert abs(float(r["kappa_deg"]) - float(t["kappa_deg"])) < 2.0
        assert 0.02 < float(r["sd_e_m"]) < 2.0 * NOISE_M


def test_run_json_keeps_its_promise(run: Path) -> None:
    run_summary = summary(run)
    assert run_summary["frames"] == {"total": 8, "tied": 8, "placed": 0, "rejected": 0}
    assert {
        "warnings",
        "camera",
        "timings_s",
        "peak_memory_mb",
        "metrics",
        "recipe",
        "versions",
        "inputs",
    } <= (run_summary.keys())
    assert all({"code", "frame", "text"} == w.keys() for w in run_summary["warnings"])
    assert len(run_summary["timings_s"]) == 19 and run_summary["timings_s"]["matching.sift"] > 0.0
    (camera,) = run_summary["camera"]
    assert camera["focal_length_px"] == pytest.approx(500.0, abs=10.0) and camera["focal_length_px"] != 500.0
    assert len(run_summary["inputs"]["survey.read.frames"]["files"]) == 8


def test_the_report_needs_no_other_file(run: Path) -> None:
    """What its scripts might ask for is looked at in a browser (test_report_chromium)."""
    whole = (run / "report.html").read_text(encoding="utf-8")
    assert whole.lower().startswith("<!doctype html>")
    page = re.sub(r"(?s)(<script\b[^>]*>).*?</script>", r"\1</script>", whole)
    addresses = re.findall(r"""(?:\bsrc|\bhref)\s*=\s*["']?([^"'\s>]+)|\burl\(\s*["']?([^"'\s)]+)""", page)
    assert addresses and all("".join(a).startswith(("data:", "#", "URL.")) for a in addresses), addresses
    assert "<script src" not in page and "@import" not in page
    for frame in ("F0001.jpg", "F0008.jpg"):
        assert frame in page


def test_the_recording_is_read_by_others(run: Path) -> None:
    recording = read_recording(run / "run.mcap")
    assert [s.stage_id for s in recording.stages][:3] == [
        "survey.read", "matching.flying_height", "projection.ground",
    ]  # fmt: skip
    assert all(s.finished for s in recording.stages) and len(recording.stages) == 19
    chunk = pytest.importorskip("rerun.chunk", reason="Rerun isn't installed")
    paths = {c.entity_path for c in chunk.McapReader(run / "run.mcap").stream()}
    assert {"/images/mosaic", "/log"} <= paths


@pytest.mark.proof
@pytest.mark.parametrize("method", sorted(METHODS.keys() - {"bundle"}))
def test_every_method_goes_to_the_end(
    method: str, few_survey: SimulatedSurvey, few_run: Path, tmp_path: Path
) -> None:
    """Stages before the adjustment come from the cache of the first run."""
    again = tmp_path / "run"
    shutil.copytree(few_run, again)
    assert mosaic(few_survey.frames, again, *companions(few_survey), "--adjust", method) == 0
    run_summary = summary(again)
    assert "matching.sift" in run_summary["cached_stages"]
    assert run_summary["metrics"]["adjustment"]["method"] == method
    off = rms(off_m(again, few_survey)[:, :2])
    most = {"none": 1.5, "least_squares": 2.0}.get(method, 12.0)
    assert 0.05 < off < most * NOISE_M, method
    given = load_artefact(again, run_summary, "given", GivenMosaic).image
    alike = [likeness(given, again / "mosaic.tif", east_m) for east_m in (0.0, 4.0)]
    assert alike[0] > alike[1] + 0.1
    if method == "none":
        assert alike[0] > 0.9, "what positions alone give is what this method gives"


@pytest.mark.proof
def test_hills_with_a_dem_and_frames_that_were_turned(tmp_path: Path) -> None:
    survey = small_survey(
        tmp_path,
        frames_per_line=3,
        width_px=360,
        height_px=270,
        relief_m=8.0,
        relief_wavelength_m=120.0,
        turned="2-3",
        seed=5,
    )
    run = tmp_path / "run"
    dem = ["--dem", str(survey.dem), "--dem-offset", "0"]
    assert mosaic(survey.frames, run, *companions(survey), *dem, *compared(survey)) == 0
    quality = summary(run)["metrics"]["quality"]
    assert summary(run)["metrics"]["ground"]["kind"] == "dem"
    assert warned(run, "frame-turned") == ["F0002.jpg", "F0003.jpg"]
    assert quality["share_measured"] > 0.9
    assert 0.02 < quality["absolute_rmse_m"] < 2.0 * NOISE_M
    assert 0.004 < quality["after_similarity_px"] < 0.6
    assert 0.01 < rms(off_m(run, survey)[:, :2]) < NOISE_M


@pytest.mark.proof
def test_frames_alone_across_the_border_of_two_zones_in_the_south(tmp_path: Path) -> None:
    """No POS, no camera file: EXIF and XMP say it all. Zones 20 and 21 meet at 60 degrees west."""
    survey = small_survey(
        tmp_path, lines=1, width_px=320, height_px=240, lon_deg=-60.0, lat_deg=-33.5, pos_in="exif", seed=6
    )
    run = tmp_path / "run"
    assert mosaic(survey.frames, run, "--adjust", "least_squares", *compared(survey)) == 0
    lon = [float(r["lon_deg"]) for r in rows(run / "positions.csv")]
    assert min(lon) < -60.0 < max(lon)
    epsg = "EPSG:32720" if np.median(lon) < -60.0 else "EPSG:32721"
    run_summary = summary(run)
    assert run_summary["mosaic"]["crs"] == epsg
    assert {"height-above-take-off", "camera-assumed"} <= {w["code"] for w in run_summary["warnings"]}
    quality = run_summary["metrics"]["quality"]
    assert quality["share_measured"] > 0.9
    assert 0.05 < quality["absolute_rmse_m"] < 3.0 * NOISE_M


def test_16_bits_and_four_bands_with_a_mask_at_the_180th_meridian(tmp_path: Path) -> None:
    survey = small_survey(
        tmp_path,
        lines=1,
        width_px=320,
        height_px=240,
        lon_deg=180.0,
        lat_deg=-16.5,
        heading_deg=80.0,
        format="tiff16",
        pos_in="csv",
        seed=7,
    )
    for path in sorted(survey.frames.glob("*.tif")):
        _add_infrared(path)
    mask = np.full((240, 320), 255, np.uint8)
    mask[:, :40] = 0
    assert cv2.imwrite(str(survey.frames / "F0001_mask.png"), mask)
    lon = [float(r["lon_deg"]) for r in rows(survey.positions)]
    assert min(lon) < -179.9 and max(lon) > 179.9
    run = tmp_path / "run"
    dem = ["--dem", str(survey.dem), "--dem-offset", "0"]
    assert mosaic(survey.frames, run, *companions(survey), *dem, "--adjust", "least_squares") == 0
    assert summary(run)["mosaic"]["crs"] in ("EPSG:32701", "EPSG:32760")
    assert summary(run)["frames"]["tied"] == 4
    assert 0.02 < rms(off_m(run, survey)[:, :2]) < 2.0 * NOISE_M
    with rasterio.open(run / "mosaic.tif") as tiff:
        assert tiff.dtypes[:4] == ("uint16",) * 4
        valid = tiff.dataset_mask() > 0
        red, _, _, infrared = (tiff.read(b)[valid].astype(float) for b in (1, 2, 3, 4))
        gsd_m = tiff.transform.a
    assert red.max() > 20_000.0
    # four frames in a line, 70 % overlap: 320 x (240 + 3 x 72) px; 40 columns of the outer 72 are masked
    whole = 320 * (240 + 3 * 72) * 0.1**2
    assert 0.9 * (whole - 40 * 72 * 0.1**2) < valid.sum() * gsd_m**2 < whole * 1.05
    assert np.abs(infrared - (65535.0 - red)).mean() < 500.0


def _add_infrared(path: Path) -> None:
    """A fourth band, the red one's opposite."""
    with open_raster(path, OWN) as tiff:
        pixels = tiff.read()
        profile = {k: tiff.profile[k] for k in ("driver", "width", "height", "dtype")}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        with rasterio.open(path, "w", count=4, **profile) as tiff:
            tiff.write(np.concatenate([pixels, 65535 - pixels[:1]]))
