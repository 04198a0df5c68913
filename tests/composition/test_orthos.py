"""Each frame's own raster on the mosaic's grid, and the VRT over all of them."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from mosaic_scenes import CRS, paint
from osgeo_utils.samples.validate_cloud_optimized_geotiff import validate
from pipeline_toy import recipe_of
from rasterio.windows import Window, from_bounds
from small_surveys import geomosaic, mosaic, small_survey
from test_mosaic_grid import around, given_for, polygons, seams

from geomosaic.composition.tones import Tones
from geomosaic.errors import CancelledError
from geomosaic.export.orthos import ortho_names
from geomosaic.pipeline.context import Context
from geomosaic.pipeline.run_folder import RunFolder
from geomosaic.pipeline.single_stage import StageInputs, run_stage
from geomosaic.stages.export_orthos import export_orthos
from geomosaic.stages.mosaic_compose import mosaic_compose


def exported(folder: Path, given: dict[str, Any], own: Any) -> Path:
    """The mosaic, hard at its seams, and the orthos."""
    for stage, params in ((mosaic_compose, {"blend": "hard"}), (export_orthos, {})):
        run_stage(recipe_of(stage, stage.Params(**params)), StageInputs(RunFolder(folder / "RUN"), {**given, "ownership": own}), work_folder=folder / "work")  # fmt: skip
    return folder / "RUN"


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Any]:
    """Six frames of one brightness each; the last one was rejected."""
    folder = tmp_path_factory.mktemp("orthos")
    given = given_for(folder)
    for i, frame in enumerate(given["survey"].frames):
        paint(frame, np.full((180, 240, 3), 40.0 + 30.0 * i))
    tones = np.zeros((6, 3))
    tones[2] = np.log(2.0)
    given["tones"] = Tones(tones, np.zeros((6, 3, 2)), np.zeros((6, 3, 2)))
    given["adjusted"] = rejecting(given["adjusted"], 5)
    own, _ = seams(folder, given, seam="nearest_nadir")
    return exported(folder, given, own), own


def rejecting(adjusted: Any, frame: int) -> Any:
    status = tuple("rejected" if i == frame else s for i, s in enumerate(adjusted.status))
    return replace(adjusted, status=status)


def test_orthos_are_the_mosaics_pixels_on_its_grid(run: tuple[Path, Any]) -> None:
    """Tones are evened too: the frame that is twice as bright shows half of it."""
    folder, _ = run
    files = [f"frame_{i:02d}.tif" for i in range(5)]
    assert sorted(p.name for p in (folder / "orthos").iterdir()) == [*files, "orthos.vrt"]
    mosaic_file = folder / "work" / "mosaic.compose" / "mosaic.tif"
    with rasterio.open(mosaic_file) as whole, rasterio.open(folder / "sources.tif") as sources:
        for i, name in enumerate(files):
            assert validate(str(folder / "orthos" / name), full_check=True)[:2] == ([], [])
            with rasterio.open(folder / "orthos" / name) as ortho:
                at = from_bounds(*ortho.bounds, transform=whole.transform)
                offsets = at.col_off, at.row_off, at.width, at.height
                assert offsets == pytest.approx([round(o) for o in offsets], abs=1e-6)
                at = Window(*(round(o) for o in offsets))
                shown, valid = ortho.read(), ortho.dataset_mask() > 0
                given = sources.read(1, window=at) == i + 1
                assert valid.sum() > given.sum() > 1000 and (valid | ~given).all()
                assert (shown[:, given] == whole.read(window=at)[:, given]).all()
                assert (shown[:, valid] == (50 if i == 2 else 40 + 30 * i)).all()
                assert ortho.crs.to_string() == CRS


def test_the_vrt_shows_the_frames_that_give_most_on_top(run: tuple[Path, Any]) -> None:
    folder, own = run
    cells = np.bincount(own.owner.ravel(), minlength=7)[1:]
    order = sorted(range(5), key=lambda i: (cells[i], -i))
    with rasterio.open(folder / "orthos" / "orthos.vrt") as vrt:
        image, valid = vrt.read(1), vrt.dataset_mask() > 0
        top = np.full(image.shape, -1)
        for i in order:
            with rasterio.open(folder / "orthos" / f"frame_{i:02d}.tif") as ortho:
                at = from_bounds(*ortho.bounds, transform=vrt.transform).round_offsets().round_lengths()
                part = top[at.toslices()]
                part[ortho.dataset_mask() > 0] = i
        assert (valid == (top >= 0)).all()
        values = np.array([40, 70, 50, 130, 160])
        assert (image[valid] == values[top[valid]]).all()
    text = (folder / "orthos" / "orthos.vrt").read_text()
    assert 'relativeToVRT="1">frame_00.tif' in text and str(folder) not in text


def test_orthos_end_at_the_area(tmp_path: Path) -> None:
    given = given_for(tmp_path, lines=1, per_line=4)
    whole, _ = seams(tmp_path, given)
    ring = around(whole.grid, -5.0, -20.0, 5.0, -14.0)
    own, _ = seams(tmp_path, given, aoi=polygons(tmp_path / "area.gpkg", CRS, [ring]))
    folder = exported(tmp_path, given, own) / "orthos"
    (west, south), _, (east, north), _ = ring
    names = sorted(p.name for p in folder.glob("*.tif"))
    assert 0 < len(names) < 4, "frames that see nothing of it have none"
    for name in names:
        with rasterio.open(folder / name) as ortho:
            rows, cols = np.nonzero(ortho.dataset_mask())
            x, y = ortho.xy(rows, cols)
            with rasterio.open(folder.parent / "work/mosaic.compose/mosaic.tif") as tiff:
                at = from_bounds(*ortho.bounds, transform=tiff.transform).round_offsets().round_lengths()
                whole_pixels = tiff.read(window=at)
            with rasterio.open(folder.parent / "sources.tif") as tiff:
                given_by = tiff.read(1, window=at) == 1 + int(name[6:8])
            assert (ortho.read()[:, given_by] == whole_pixels[:, given_by]).all()
            assert min(x) > west and max(x) < east and min(y) > south and max(y) < north


def test_names_are_safe_and_differ() -> None:
    frames = [
        "a/IMG 1.jpg",
        "b/img 1.JPG",
        "../../etc/passwd",
        "..",
        "C:\\x\\ö&1.tif",
        "IMG_1_2.jpg",
        "\x1b[0m",
        "x" * 300,
    ]
    names = ortho_names(frames)
    assert names == [
        "IMG_1.tif", "img_1_2.tif", "passwd.tif", "frame.tif", "ö_1.tif", "IMG_1_2_2.tif", "0m.tif", "x" * 60 + ".tif",
    ]  # fmt: skip
    assert len({n.casefold() for n in names}) == len(names)


def test_orthos_can_be_stopped(tmp_path: Path) -> None:
    given = given_for(tmp_path, lines=1, per_line=2)
    own, _ = seams(tmp_path, given)
    asked: list[int] = []

    def stop() -> bool:
        asked.append(1)
        return len(asked) > 2

    context = Context(tmp_path / "run", stage_id="export.orthos", cancelled=stop)
    with pytest.raises(CancelledError):
        export_orthos().run({**given, "ownership": own}, export_orthos.Params(), context)
    assert not (tmp_path / "run" / "orthos").exists()


@pytest.mark.proof
def test_the_command_writes_orthos_of_a_finished_run(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """Resampled as the mosaic was."""
    made = small_survey(tmp_path, lines=1, frames_per_line=3, width_px=240, height_px=180)
    options = (
        "--pos",
        made.pos,
        "--camera",
        made.camera,
        "--adjust",
        "least_squares",
        "--ground-height",
        520,
    )
    how = ("mosaic.compose.resampling=lanczos", "mosaic.compose.blend=hard")
    assert mosaic(made.frames, tmp_path / "run", *options, *(a for h in how for a in ("--set", h))) == 0
    capfd.readouterr()
    assert geomosaic("export", "orthos", tmp_path / "run") == 0
    assert capfd.readouterr().out.strip() == str(tmp_path / "run" / "orthos")
    names = sorted(p.name for p in (tmp_path / "run" / "orthos").iterdir())
    assert names == ["F0001.tif", "F0002.tif", "F0003.tif", "orthos.vrt"]
    gsd_m = json.loads((tmp_path / "run" / "run.json").read_text())["mosaic"]["gsd_m"]
    with rasterio.open(tmp_path / "run" / "orthos" / "F0002.tif") as ortho:
        assert ortho.transform.a == gsd_m and ortho.overviews(1) == [] and ortho.count == 3
        mine, bounds = ortho.read(), ortho.bounds
    with rasterio.open(tmp_path / "run" / "mosaic.tif") as whole:
        there = whole.read(window=from_bounds(*bounds, whole.transform).round())
    with rasterio.open(tmp_path / "run" / "sources.tif") as sources:
        given_by = sources.read(1, window=from_bounds(*bounds, sources.transform).round())
    assert (given_by == 2).sum() > 1000
    assert (mine == there)[:, given_by == 2].all()
