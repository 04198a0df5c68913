"""What the trials spoil: a tiny survey, tiny strips and their files in every form, made once from a seed."""

from __future__ import annotations

import csv
import shutil
from pathlib import Path

import numpy as np
import rasterio
import yaml
from osgeo import gdal

from geomosaic_simulate.plan import SurveyPlan
from geomosaic_simulate.strip_plan import StripPlan
from geomosaic_simulate.strips import simulate_strips
from geomosaic_simulate.survey import simulate_frames

SURVEY_STAGES = ("survey.read", "projection.ground", "placement.pos")
MAP_CRS = "EPSG:32632"
RECIPES = {
    "short.yaml": [*SURVEY_STAGES],
    "pixels.yaml": [
        *SURVEY_STAGES,
        {"stage": "matching.sift", "params": {"longest_px": 300, "keypoints": 600}},
        {"stage": "adjustment.solve", "params": {"method": "none"}},
        "mosaic.seams",
        "mosaic.compose",
        "export.cog",
    ],
    "whole.yaml": [
        *SURVEY_STAGES,
        *(
            "matching.sift",
            "adjustment.solve",
            "mosaic.seams",
            "mosaic.compose",
            "export.cog",
            "export.layers",
        ),
        "export.report",
    ],
    "strips.yaml": ["survey.strips"],
    "strips_whole.yaml": [
        *("survey.strips", "ccd.offsets", "ccd.radiometry", "mosaic.strips", "quality.strips"),
        *("export.cog", "export.offsets", "export.strip_layers", "export.strip_report"),
    ],
}


def make_base(folder: Path, seed: int) -> None:
    """FOLDER/survey, FOLDER/tiffs and FOLDER/strips, each with all files that describe it."""
    plan = SurveyPlan(
        seed=seed,
        lines=2,
        frames_per_line=2,
        width_px=320,
        height_px=240,
        height_above_ground_m=50.0,
        control_points=4,
        position_sd_m=0.4,
        height_sd_m=0.4,
    )
    survey = folder / "survey"
    simulate_frames(survey, plan)
    (survey / "truth" / "dem.tif").rename(survey / "dem.tif")
    (survey / "truth" / "positions.csv").rename(survey / "positions.csv")
    (survey / "truth" / "ortho.tif").rename(survey / "ortho.tif")
    shutil.rmtree(survey / "truth")
    _pos_files(survey)
    _camera_files(survey)
    _elevations(survey)
    _masks(survey)
    _recipes(survey)
    _tiffs(survey, folder / "tiffs")
    strip_plan = StripPlan(
        seed=seed,
        ccds=3,
        width_px=160,
        lines=900,
        row_separation_lines=200.0,
        overlap_px=64,
        read_px=72,
        relief_m=50.0,
    )
    simulate_strips(folder / "strips", strip_plan, scene=False)
    shutil.rmtree(folder / "strips" / "truth")
    _recipes(folder / "strips")


def people(folder: Path) -> None:
    """Files of other people: nothing may change them, and no stranger's file may show them."""
    secret = np.full((3, 40, 40), 137, np.uint8)
    secret[:, ::2, 1::2] = 61
    options = {"driver": "GTiff", "width": 40, "height": 40, "count": 3, "dtype": "uint8"}
    with rasterio.open(
        folder / "secret.tif", "w", **options, crs=MAP_CRS, transform=rasterio.Affine(1, 0, 0, 0, -1, 0)
    ) as file:
        file.write(secret)
    (folder / "secret.txt").write_text("the people's own words, 8314\n")
    (folder / "notes.csv").write_text("frame,lon_deg\nmine,1\n")


def _recipes(folder: Path) -> None:
    for name, stages in RECIPES.items():
        (folder / name).write_text(
            yaml.safe_dump({"name": Path(name).stem, "stages": stages}, sort_keys=False)
        )


def _rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def _pos_files(survey: Path) -> None:
    geo, pix4d = (
        ["EPSG:4326"],
        ["imagename,latitude,longitude,altitude,accuracy_horizontal,accuracy_vertical"],
    )
    for r in _rows(survey / "pos.csv"):
        place = r["lon_deg"], r["lat_deg"], r["height_ellipsoidal_m"]
        geo.append(" ".join((r["frame"], *place, r["yaw_deg"], r["pitch_deg"], r["roll_deg"], "1.5", "2")))
        pix4d.append(",".join((r["frame"], place[1], place[0], place[2], "1.5", "2")))
    opk = ["frame;easting;northing;height_ellipsoidal;omega_deg;phi_deg;kappa_deg"]
    for r in _rows(survey / "positions.csv"):
        names = (
            "frame",
            "easting_m",
            "northing_m",
            "height_ellipsoidal_m",
            "omega_deg",
            "phi_deg",
            "kappa_deg",
        )
        opk.append(";".join(r[name] for name in names))
    for name, lines in {"geo.txt": geo, "pix4d.csv": pix4d, "opk.csv": opk}.items():
        (survey / name).write_text("\n".join(lines) + "\n")


def _camera_files(survey: Path) -> None:
    own = {"name": "geomosaic simulated", "width_px": 320, "height_px": 240, "focal_length_px": 500.0}
    own |= {
        "focal_length_sd_px": 2.0,
        "principal_col_px": 160.0,
        "principal_row_px": 120.0,
        "k1": -0.02,
        "p1": 0.0,
    }
    (survey / "camera.yaml").write_text(yaml.safe_dump(own, sort_keys=False))
    other = {
        "type": "brown",
        "im_size": [320, 240],
        "focal_len": 20.625,
        "sensor_size": [13.2, 9.9],
        "k1": -0.02,
    }
    (survey / "orthority.yaml").write_text(yaml.safe_dump({"simulated": other}, sort_keys=False))


def _elevations(survey: Path) -> None:
    gdal.UseExceptions()
    gdal.Translate(str(survey / "dem.asc"), str(survey / "dem.tif"), format="AAIGrid")
    gdal.BuildVRT(str(survey / "dem.vrt"), [str(survey / "dem.tif")]).FlushCache()


def _masks(survey: Path) -> None:
    (survey / "masks").mkdir()
    mask = np.full((1, 240, 320), 255, np.uint8)
    mask[:, :40, :60] = 0
    for name, driver in {"F0001_mask.png": "PNG", "F0002_mask.tif": "GTiff"}.items():
        options = {"driver": driver, "width": 320, "height": 240, "count": 1, "dtype": "uint8"}
        with rasterio.open(survey / "masks" / name, "w", **options) as file:
            file.write(mask)


def _tiffs(survey: Path, tiffs: Path) -> None:
    """The same survey with TIFF frames of one strip and of tiles, and a POS file that names them."""
    shutil.copytree(survey, tiffs, ignore=lambda _, names: [n for n in names if n in ("frames", "ortho.tif")])
    (tiffs / "frames").mkdir()
    for i, jpeg in enumerate(sorted((survey / "frames").iterdir())):
        options = {"tiled": True, "blockxsize": 64, "blockysize": 64, "compress": "lzw"} if i % 2 else {}
        with rasterio.open(jpeg) as file:
            profile = {"driver": "GTiff", "width": 320, "height": 240, "count": 3, "dtype": "uint8"}
            with rasterio.open(tiffs / "frames" / f"{jpeg.stem}.tif", "w", **profile, **options) as out:
                out.write(file.read())
    text = (tiffs / "pos.csv").read_text()
    (tiffs / "pos.csv").write_text(text.replace(".jpg", ".tif"))
