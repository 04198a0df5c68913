"""The stages of composition and export, run as the runner does, on a small survey."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest
import rasterio
from mosaic_scenes import CAMERA, make_survey
from osgeo_utils.samples.validate_cloud_optimized_geotiff import validate
from pipeline_toy import recipe_of
from pystac.errors import STACValidationError
from stac_schema import check_schema

from geomosaic.adjustment.model import Adjusted
from geomosaic.errors import FileError
from geomosaic.export.stac import coverage_of_scene, stac_item, write_stac
from geomosaic.matching.model import TiePoints
from geomosaic.pipeline.run_folder import MARKER, RunFolder
from geomosaic.pipeline.single_stage import StageInputs, run_stage
from geomosaic.placement.model import Placement
from geomosaic.stages.export_cog import export_cog
from geomosaic.stages.exports_for_gis import export_layers
from geomosaic.stages.exports_for_web import export_stac, export_tiles, export_vrt
from geomosaic.stages.mosaic_compose import mosaic_compose
from geomosaic.stages.mosaic_seams import mosaic_seams


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    survey, poses, ground = make_survey(folder / "frames", lines=1, per_line=3)
    status = ("tied", "tied", "rejected")
    given = {
        "survey": survey,
        "ground": ground,
        "placement": Placement(poses, (0, 1, 2), (0, 0, 0), (), 0.25, "rigorous"),
        "ties": TiePoints(()),
        "adjusted": Adjusted(poses, (CAMERA,) * 3, status, (), (), ground),
    }
    notes = {}
    for stage in (
        mosaic_seams,
        mosaic_compose,
        export_cog,
        export_layers,
        export_vrt,
        export_tiles,
        export_stac,
    ):
        params = stage.Params(**({"gsd_m": 0.25} if stage is mosaic_seams else {}))
        taken = stage.inputs.keys() | stage.optional_inputs.keys()
        inputs = {name: given[name] for name in taken if name in given}
        outputs, notes[stage.id] = run_stage(
            recipe_of(stage, params),
            StageInputs(RunFolder(folder / "RUN"), inputs),
            work_folder=folder / "work",
            workers=1,
        )
        given.update(outputs)
    return folder / "RUN", given, notes


def test_the_run_folder_is_complete_and_clean(run):
    folder, _, _ = run
    files = "layers.gpkg mosaic.stac.json mosaic.tif mosaic.vrt positions.csv sources.tif tiles work"
    assert sorted(p.name for p in folder.iterdir()) == [MARKER, *files.split()]
    assert validate(str(folder / "mosaic.tif"), full_check=True)[:2] == ([], [])


def test_run_json_hears_of_the_mosaic(run):
    folder, given, notes = run
    mosaic = given["mosaic"]
    with rasterio.open(folder / "mosaic.tif") as tiff:
        reported = {"crs": "EPSG:32632", "gsd_m": 0.25, "width": tiff.width, "height": tiff.height}
    assert notes["mosaic.compose"].report["mosaic"] == reported
    assert mosaic.frames_used == (0, 1)
    assert (folder / mosaic.raster).is_file()


def test_sources_name_the_frames(run):
    folder, _, _ = run
    with rasterio.open(folder / "sources.tif") as tiff:
        assert set(np.unique(tiff.read(1))) == {0, 1, 2}
        assert tiff.tags()["FRAME_1"] == "frame 00.tif"


def test_assets_of_one_stem_stand_next_to_each_other(tmp_path):
    """`mosaic.pmtiles` took the place of `mosaic.tif`."""
    for name in ("mosaic.pmtiles", "mosaic_RPC.TXT", "mosaic.tif"):
        (tmp_path / name).write_bytes(b"")
    with rasterio.open(
        tmp_path / "mosaic.tif",
        "w",
        driver="GTiff",
        width=2,
        height=2,
        count=1,
        dtype="uint8",
        transform=rasterio.Affine(1, 0, 500000, 0, -1, 5000000),
    ) as raster:
        raster.write(np.ones((1, 2, 2), np.uint8))
    coverage = coverage_of_scene(np.array([[9.0, 45.0], [9.1, 45.0], [9.1, 45.1]]), 1.0, 2, 2)
    assets = stac_item("x", coverage, [], 0.0, tmp_path)["assets"]
    assert {key: asset["href"] for key, asset in assets.items()} == {
        "mosaic": "./mosaic.tif",
        "mosaic_RPC": "./mosaic_RPC.TXT",
        "mosaic_pmtiles": "./mosaic.pmtiles",
    }


def test_a_stac_item_is_json_where_nodata_is_nan(tmp_path):
    """accuracy.tif has NaN, for which JSON has no number."""
    with rasterio.open(
        tmp_path / "accuracy.tif", "w", driver="GTiff", width=2, height=2, count=1, dtype="float32",
        nodata=float("nan"), crs="EPSG:32632", transform=rasterio.Affine(1, 0, 500000, 0, -1, 5000000),
    ) as raster:  # fmt: skip
        raster.write(np.ones((1, 2, 2), np.float32))
    coverage = coverage_of_scene(np.array([[9.0, 45.0], [9.1, 45.0], [9.1, 45.1]]), 1.0, 2, 2)
    write_stac(tmp_path / "i.json", stac_item("x", coverage, [], 0.0, tmp_path))

    def no_number(name: str) -> None:
        raise AssertionError(f"{name} is no JSON")

    item = json.loads((tmp_path / "i.json").read_text(), parse_constant=no_number)
    assert item["assets"]["accuracy"]["bands"][0]["nodata"] == "nan"
    check_schema(item)


def test_the_stac_item_lists_what_is_there(run):
    folder, _, _ = run
    item = json.loads((folder / "mosaic.stac.json").read_text())
    assert set(item["assets"]) == {"mosaic", "layers", "positions", "sources"}
    check_schema(item)
    with pytest.raises(STACValidationError, match="data_type"):
        item["assets"]["mosaic"]["bands"][0]["data_type"] = "byte"
        check_schema(item)
    assert item["properties"]["datetime"] == "2023-11-14T22:13:20Z"


def test_without_work_the_mosaic_is_kept_otherwise(run, tmp_path):
    """RUN/work may be deleted: what was composed is in mosaic.tif."""
    folder, given, _ = run
    shutil.copytree(folder, tmp_path / "RUN", ignore=shutil.ignore_patterns("work"))
    for compression in ("zstd", "deflate"):
        params = export_cog.Params(compression=compression)
        inputs = {"raster_file": given["raster_file"]}
        run_stage(
            recipe_of(export_cog, params),
            StageInputs(RunFolder(tmp_path / "RUN"), inputs),
            work_folder=tmp_path / "w",
        )
        with (
            rasterio.open(folder / "mosaic.tif") as old,
            rasterio.open(tmp_path / "RUN" / "mosaic.tif") as new,
        ):
            assert new.compression.name == compression
            np.testing.assert_array_equal(old.read(), new.read())
            np.testing.assert_array_equal(old.dataset_mask(), new.dataset_mask())
    (tmp_path / "RUN" / "mosaic.tif").unlink()
    with pytest.raises(FileError, match="the file is gone"):
        run_stage(
            recipe_of(export_cog, export_cog.Params()),
            StageInputs(RunFolder(tmp_path / "RUN"), inputs),
            work_folder=tmp_path / "w",
        )
