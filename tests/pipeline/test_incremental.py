"""`--incremental`: a run goes on from the finished one in its folder, or says why it can't."""

from __future__ import annotations

import hashlib
import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import rasterio
from numpy.typing import NDArray
from rasterio.warp import transform
from small_surveys import mosaic, small_survey, summary

from geomosaic.composition import compose
from geomosaic.composition.blended import BlendedBlock, Blending, WantedBlock
from geomosaic.errors import InputError
from geomosaic.pipeline.earlier_run import EARLIER
from geomosaic.pipeline.reporter import Silent
from geomosaic.requests.mosaic_request import MosaicRequest
from geomosaic.requests.perform import perform
from geomosaic_simulate.survey import SimulatedSurvey
from tools.bench.bench_incremental import TARGET_GREY, TARGET_PX, differences

LARGER = {"lines": 6, "frames_per_line": 4, "width_px": 240, "height_px": 180, "seed": 9}
SIZE = {"lines": 3, "frames_per_line": 3, "width_px": 240, "height_px": 180, "seed": 9}
RTK = {"position_sd_m": 0.01, "height_sd_m": 0.01}
FIRST, ALL = 6, 9
FEWER = "matching.sift.keypoints=500"


@pytest.fixture(scope="module")
def survey(tmp_path_factory: pytest.TempPathFactory) -> SimulatedSurvey:
    return small_survey(tmp_path_factory.mktemp("survey"), **SIZE, **RTK)


def given(survey: SimulatedSurvey) -> list[object]:
    return ["--pos", survey.pos, "--camera", survey.camera, "--fixed-time", "--set", FEWER]


def copied(survey: SimulatedSurvey, to: Path, first: int, last: int) -> Path:
    to.mkdir(exist_ok=True)
    for path in sorted(survey.frames.iterdir())[first:last]:
        shutil.copy2(path, to)
    return to


@pytest.fixture(scope="module")
def finished(survey: SimulatedSurvey, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Frames and the run of the first two lines."""
    folder = tmp_path_factory.mktemp("finished")
    frames = copied(survey, folder / "frames", 0, FIRST)
    assert mosaic(frames, folder / "run", *given(survey)) == 0
    return frames, folder / "run"


def positions(run: Path) -> NDArray[np.float64]:
    lines = (run / "positions.csv").read_text().splitlines()[1:]
    return np.array([[float(cell) for cell in line.split(",")[5:7]] for line in lines])


def test_nothing_to_do(finished: tuple[Path, Path], survey: SimulatedSurvey, tmp_path: Path) -> None:
    """The same frames: all is from the cache, with the same bytes."""
    frames, run = finished
    before = digest(run / "mosaic.tif")
    assert mosaic(frames, run, *given(survey), "--incremental") == 0
    assert "mosaic.compose" in summary(run)["cached_stages"]
    assert digest(run / "mosaic.tif") == before
    with rasterio.open(run / "mosaic.tif") as raster:
        assert raster.count == 3


def digest(path: Path) -> str:
    return hashlib.blake2b(path.read_bytes()).hexdigest()


def refused(frames: Path, run: Path, **options: object) -> str:
    request = MosaicRequest(frames=frames, output=run, workers=1, incremental=True, **options)
    with pytest.raises(InputError) as error:
        perform(request.job(), Silent())
    return str(error.value)


def test_why_it_can_not(finished: tuple[Path, Path], survey: SimulatedSurvey, tmp_path: Path) -> None:
    """One line each, which says what to do; the finished run stays."""
    frames, run = finished
    same = {"pos": survey.pos, "camera": survey.camera, "fixed_time": True, "set": [FEWER]}
    text = refused(frames, tmp_path / "none", **same)
    assert "no finished run to go on from; leave out --incremental" in text
    text = refused(frames, run, **same, gsd="0.2")
    assert "made with other options: its mosaic.seams.gsd_m is auto; give the same options" in text
    assert "its --seed is 0" in refused(frames, run, **same, seed=4)
    assert "its stages are others" in refused(frames, run, **same, ground_height=500.0)
    copy = shutil.copytree(run, tmp_path / "older")
    made = json.loads((copy / "run.json").read_text())
    made["stage_versions"]["adjustment.solve"] -= 1
    (copy / "run.json").write_text(json.dumps(made))
    assert "made by another version; leave out --incremental" in refused(frames, copy, **same)
    shutil.rmtree(copy / "work" / "adjustment.solve")
    made["stage_versions"]["adjustment.solve"] += 1
    (copy / "run.json").write_text(json.dumps(made))
    assert "work has lost results" in refused(frames, copy, **same)
    assert (run / "run.json").exists()


@pytest.mark.proof
def test_a_line_more_then_a_frame_less(
    survey: SimulatedSurvey,
    finished: tuple[Path, Path],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Poses and mosaic are those of a whole run, which the same folder gives without the option, byte for
    byte."""
    frames, run = finished
    copied(survey, frames, FIRST, ALL)
    assert mosaic(frames, run, *given(survey), "--incremental") == 0
    reused = summary(run)["metrics"]["reused"]
    assert (reused["frames"], reused["frames_of"], reused["adjustment"]) == (FIRST, ALL, False)
    assert reused["tiles_of"] >= reused["tiles"] >= 0
    assert "6 of 9 frames' keypoints" in capsys.readouterr().out
    assert not (run / EARLIER).exists()
    gone_on = positions(run)
    (tmp_path / "gone-on").mkdir()
    shutil.copy2(run / "mosaic.tif", tmp_path / "gone-on")
    sorted(frames.iterdir())[0].unlink()
    assert mosaic(frames, run, *given(survey), "--incremental") == 0
    reused = summary(run)["metrics"]["reused"]
    assert (reused["frames"], reused["frames_of"], reused["adjustment"]) == (ALL - 1, ALL - 1, False)
    copied(survey, frames, 0, 1)
    assert mosaic(frames, run, *given(survey)) == 0
    assert "reused" not in summary(run)["metrics"]
    assert np.abs(positions(run) - gone_on).max() < 1e-3
    assert mosaic(frames, tmp_path / "fresh", *given(survey)) == 0
    assert digest(run / "mosaic.tif") == digest(tmp_path / "fresh" / "mosaic.tif")
    off = differences(tmp_path / "gone-on", tmp_path / "fresh")
    assert off["shift_px"] < TARGET_PX
    assert off["grey"] < TARGET_GREY


def replaced(frame: Path) -> None:
    """The same picture in another file of the same name."""
    cv2.imwrite(str(frame), cv2.imread(str(frame)), [cv2.IMWRITE_JPEG_QUALITY, 98])


def near(run: Path, fresh: Path) -> bool:
    """Whether mosaics show the same, pixel by pixel, within the targets."""
    off = differences(run, fresh)
    return bool(off["shift_px"] < TARGET_PX and off["grey"] < TARGET_GREY)


@pytest.mark.proof
def test_earlier_frames_stay(tmp_path: Path) -> None:
    """Two frames are added, one is replaced, one removed: the adjustment solves those about them, and the
    mosaic is that of a fresh run."""
    made = small_survey(tmp_path / "survey", **LARGER, **RTK)
    count = len(list(made.frames.iterdir()))
    frames, run = copied(made, tmp_path / "frames", 0, count - 2), tmp_path / "run"
    assert mosaic(frames, run, *given(made)) == 0
    copied(made, frames, count - 2, count)
    assert mosaic(frames, tmp_path / "fresh", *given(made)) == 0

    def again(unchanged: int) -> int:
        """How many frames keep their poses."""
        assert mosaic(frames, run, *given(made), "--incremental") == 0
        reused = summary(run)["metrics"]["reused"]
        assert reused["frames"] == unchanged
        assert near(run, tmp_path / "fresh")
        return int(reused["poses"])

    assert count - 2 > again(count - 2) > count // 3
    replaced(sorted(frames.iterdir())[9])
    assert again(count - 1) > count // 3
    sorted(frames.iterdir())[0].unlink()
    assert again(count - 1) > count // 3


def test_another_lens_is_no_earlier_one(
    finished: tuple[Path, Path], survey: SimulatedSurvey, tmp_path: Path
) -> None:
    """The file that --camera names was edited meanwhile: the earlier solution is of the old one."""
    frames, run = finished
    copy, camera = shutil.copytree(run, tmp_path / "run"), tmp_path / "cameras.json"
    shutil.copy(survey.camera, camera)
    options = ["--pos", survey.pos, "--camera", camera, "--fixed-time", "--set", FEWER]
    assert mosaic(frames, copy, *options) == 0
    lenses = json.loads(camera.read_text())
    for lens in lenses.values():
        lens["focal_x"] = lens["focal_y"] = 1.02 * lens["focal_x"]
    camera.write_text(json.dumps(lenses))
    assert mosaic(frames, copy, *options, "--incremental") == 0
    assert summary(copy)["metrics"]["reused"]["adjustment"] is False


def box(path: Path, ring: list[tuple[float, float]]) -> None:
    """An area with corners in degrees."""
    geometry = {"type": "Polygon", "coordinates": [[*ring, ring[0]]]}
    feature = {"type": "Feature", "properties": {}, "geometry": geometry}
    path.write_text(json.dumps({"type": "FeatureCollection", "features": [feature]}))


def test_a_stopped_run_that_goes_on_has_no_holes(
    survey: SimulatedSurvey, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Frames on the map hold what a run asked for, and the run after a stopped one may ask for more. Here the
    area has lost a corner, so that tiles away from it are of the run before."""
    frames, run, aoi = (
        copied(survey, tmp_path / "frames", 0, FIRST),
        tmp_path / "run",
        tmp_path / "aoi.geojson",
    )
    options = [*given(survey), "--aoi", aoi, "--gsd", "0.02"]
    box(aoi, [(11.2, 48.0), (11.4, 48.0), (11.4, 48.2), (11.2, 48.2)])
    assert mosaic(frames, run, *options) == 0
    with rasterio.open(run / "mosaic.tif") as raster:
        west, south, east, north = raster.bounds
        cut = 0.3 * (east - west)
        corners = [(west, south), (east - cut, south), (east - cut, south + cut), (east, south + cut)]
        corners += [(east, north), (west, north)]
        box(aoi, list(zip(*transform(raster.crs, "EPSG:4326", *zip(*corners, strict=True)), strict=True)))

    def stopped(how: Blending, of: WantedBlock) -> BlendedBlock:
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(compose, "blended", stopped)
        assert mosaic(frames, run, *options, "--incremental") == 130
    assert mosaic(frames, run, *options, "--incremental") == 0
    assert mosaic(frames, tmp_path / "whole", *options) == 0
    with rasterio.open(run / "mosaic.tif") as found, rasterio.open(tmp_path / "whole" / "mosaic.tif") as true:
        missing = (true.dataset_mask() > 0) & (found.dataset_mask() == 0)
    assert missing.mean() < 0.001
    assert summary(run)["metrics"]["reused"]["tiles"] > 0
