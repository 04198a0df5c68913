"""Frames without a position: among others, with control points, and with nothing at all."""

from __future__ import annotations

import csv
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from osgeo import gdal
from small_surveys import geomosaic, mosaic, small_survey, summary, warned
from survey_files import image, write_jpeg

from geomosaic.errors import InputError
from geomosaic.geodesy.mapcrs import LOCAL_CRS
from geomosaic.matching.candidates import to_compare
from geomosaic.survey.inputs import SurveyInputs
from geomosaic.survey.read import read_survey

FEW = ("--set", "matching.sift.keypoints=700")
SIZE = {"lines": 2, "frames_per_line": 3, "width_px": 320, "height_px": 240, "seed": 5}


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One flight twice: `both` with tags and control points, `none` without any position or attitude."""
    out = tmp_path_factory.mktemp("flown")
    small_survey(out / "both", control_points=5, **SIZE)
    small_survey(out / "none", pos_in="csv", **SIZE)
    return out


PLACE, DEVIATION = ("easting_m", "northing_m", "height_ellipsoidal_m"), ("sd_e_m", "sd_n_m", "sd_u_m")


def _places(path: Path, columns: tuple[str, ...] = PLACE) -> dict[str, np.ndarray]:
    with path.open(encoding="utf-8", newline="") as file:
        return {
            row["frame"]: np.array([float(row[c] or "nan") for c in columns]) for row in csv.DictReader(file)
        }


def _off_m(run: Path, truth: Path) -> np.ndarray:
    found, true = _places(run / "positions.csv"), _places(truth / "truth" / "positions.csv")
    return np.array([found[name] - true[name] for name in sorted(true) if name in found])


def write_strange(path: Path, tags_of: Path) -> None:
    """A frame of other ground, with the tags of a frame without a position."""
    with_tags = tags_of.read_bytes()
    noise = np.random.default_rng(1).normal(0.0, 12.0, (240, 320, 1))
    other = np.clip(image(320, 240, seed=8) + noise, 0, 255).astype(np.uint8)
    strange = write_jpeg(path, other).read_bytes()
    end_of_tags = with_tags.index(b"\xff\xdb")
    path.write_bytes(with_tags[:end_of_tags] + strange[strange.index(b"\xff\xdb") :])


def test_frames_without_gps_are_placed_by_the_images(tmp_path: Path, flown: Path) -> None:
    """Two of six have none, one of them at a turn of the flight; a seventh shows something else."""
    frames = shutil.copytree(flown / "both" / "frames", tmp_path / "frames")
    for name in ("F0002.jpg", "F0004.jpg"):
        shutil.copy(flown / "none" / "frames" / name, frames / name)
    write_strange(frames / "F0007.jpg", flown / "none" / "frames" / "F0001.jpg")
    assert mosaic(frames, tmp_path / "run", *FEW) == 0
    run_summary = summary(tmp_path / "run")
    assert run_summary["frames"] == {"total": 7, "tied": 6, "placed": 0, "rejected": 1}
    assert warned(tmp_path / "run", "not-placed") == ["F0007.jpg"]
    (line,) = [w["text"] for w in run_summary["warnings"] if w["code"] == "position-missing"]
    assert line.startswith(
        "no position: placed by the images; give it with --pos if its ground is missing (3 "
    )
    assert line.endswith(" of 7 frames: F0007.jpg, F0002.jpg, F0004.jpg)")
    off_m = _off_m(tmp_path / "run", flown / "both")
    assert len(off_m) == 6 and np.abs(off_m).max() < 1.0
    assert np.isnan(_places(tmp_path / "run" / "positions.csv")["F0007.jpg"]).all(), "it lies nowhere"


@pytest.mark.proof
def test_control_points_stand_in_for_positions(tmp_path: Path, flown: Path) -> None:
    run = tmp_path / "run"
    assert mosaic(flown / "none" / "frames", run, "--gcp", flown / "both" / "gcp_list.txt", *FEW) == 0
    assert summary(run)["frames"]["tied"] == 6
    sd_m = _places(run / "positions.csv", DEVIATION)
    off_m = np.abs(_off_m(run, flown / "both"))
    assert off_m.max() < 1.0
    assert (off_m < 3.0 * np.array([sd_m[name] for name in sorted(sd_m)])).all()


def test_with_nothing_the_mosaic_lies_in_a_frame_of_its_own(tmp_path: Path, flown: Path) -> None:
    run = tmp_path / "run"
    assert mosaic(flown / "none" / "frames", run, *FEW) == 0
    its = summary(run)
    assert its["frames"]["tied"] == 6 and its["mosaic"]["crs"] == LOCAL_CRS
    truth = json.loads((flown / "none" / "truth" / "truth.json").read_text())
    assert its["mosaic"]["gsd_m"] == pytest.approx(120.0 / truth["camera"]["focal_length_px"], rel=0.1)
    assert len(warned(run, "local-frame")) == 1
    raster = gdal.Open(str(run / "mosaic.tif"))
    assert raster.GetSpatialRef().IsLocal()
    with (run / "positions.csv").open(encoding="utf-8", newline="") as file:
        assert {row["lon_deg"] for row in csv.DictReader(file)} == {""}
    for kind in ("stac", "tiles"):
        assert geomosaic("export", kind, run) == 2
    found, true = _places(run / "positions.csv"), _places(flown / "none" / "truth" / "positions.csv")
    z, w = (np.array([p[n][:2] @ [1, 1j] for n in sorted(true)]) for p in (found, true))
    z, w = z - z.mean(), w - w.mean()
    turn = (w * z.conj()).sum() / (np.abs(z) ** 2).sum()
    assert np.abs(w - turn * z).max() < 0.7


def test_a_frame_that_nothing_joins_to_a_map_without_positions_is_named(tmp_path: Path, flown: Path) -> None:
    """A stranger was asked for a tie to "a frame that has a position", which none had."""
    frames = shutil.copytree(flown / "none" / "frames", tmp_path / "frames")
    write_strange(frames / "F0007.jpg", frames / "F0001.jpg")
    assert mosaic(frames, tmp_path / "run", *FEW) == 0
    lines = [w for w in summary(tmp_path / "run")["warnings"] if w["code"] == "not-placed"]
    assert [(w["frame"], w["text"]) for w in lines] == [
        (
            "F0007.jpg",
            "no tie points with the 6 frames that are mapped: left out of the mosaic; mosaic such frames by "
            "themselves, or give positions with --pos",
        )
    ]


def test_what_control_can_tell(tmp_path: Path, flown: Path) -> None:
    frames, lines = flown / "none" / "frames", (flown / "both" / "gcp_list.txt").read_text().splitlines()
    table = [line.split() for line in lines[1:]]
    one = [line for line in table if line[6] == table[0][6]]
    few = tmp_path / "few.txt"
    few.write_text("\n".join([lines[0], *map(" ".join, one)]))
    with pytest.raises(
        InputError, match=r"few\.txt: no frame has a position, and 1 control point is measured"
    ):
        read_survey(SurveyInputs(frames, gcp=few))
    flat = tmp_path / "flat.txt"
    flat.write_text("\n".join([lines[0], *(" ".join([*t[:2], "0", *t[3:]]) for t in table)]))
    survey = read_survey(SurveyInputs(frames, gcp=flat))
    assert "control-plan-only" in {w.code for w in survey.warnings}
    assert all(c.plan_only for c in survey.control) and not any(survey.located)
    twice = tmp_path / "twice.txt"
    twice.write_text("\n".join([lines[0], " ".join([*table[0][:2], "520.4", *table[0][3:]]), *lines[2:]]))
    assert "control-spread" in {w.code for w in read_survey(SurveyInputs(frames, gcp=twice)).warnings}


def test_what_needs_the_earth_is_refused_without_positions(flown: Path) -> None:
    frames = flown / "none" / "frames"
    with pytest.raises(InputError, match="no frame has a position: there can be no map in EPSG:32632"):
        read_survey(SurveyInputs(frames, crs="EPSG:32632"))
    with pytest.raises(InputError, match="no frame has a position: a DEM cannot be used"):
        read_survey(SurveyInputs(frames, dem=flown / "none" / "truth" / "dem.tif"))


def test_comparing_all_with_all_is_bounded() -> None:
    assert to_compare(4, [1, 3]) == [(1, [0, 2, 3]), (3, [0, 2])]
    compared = to_compare(2000, range(2000))
    assert sum(len(others) for _, others in compared) <= 20_000
    assert compared[1000][1] == [*range(1001, 1011)]
    assert sum(len(others) for _, others in to_compare(200, range(200))) == 19_900
