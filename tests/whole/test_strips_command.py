"""`geomosaic strips` from end to end: one scene of simulated strips, and what users get wrong."""

from __future__ import annotations

import csv
import json
import shutil
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
import yaml
from mcap.reader import make_reader
from osgeo import ogr
from osgeo_utils.samples import validate_cloud_optimized_geotiff
from rasterio.errors import NotGeoreferencedWarning
from rasterio.windows import Window
from small_surveys import geomosaic

from geomosaic.pipeline.run_folder import MARKER
from geomosaic_simulate.strip_plan import StripPlan
from geomosaic_simulate.strips import SimulatedStrips, simulate_strips

PLAN = StripPlan(seed=4, ccds=3, width_px=384, lines=3200, row_separation_lines=700, relief_m=150.0)
FINAL = {
    "mosaic.tif",
    "mosaic_RPC.TXT",
    "offsets.csv",
    "layers.gpkg",
    "project.qgz",
    "report.html",
    "run.mcap",
    "run.json",
}

RECIPES = Path(__file__).parents[2] / "recipes"


@pytest.fixture(scope="session")
def scene(tmp_path_factory: pytest.TempPathFactory) -> SimulatedStrips:
    """Three strips with model, RPC, DEM and truth."""
    return simulate_strips(tmp_path_factory.mktemp("strips") / "scene", PLAN)


@pytest.fixture(scope="session")
def run(scene: SimulatedStrips, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A whole run with the defaults, as if at no time."""
    out = tmp_path_factory.mktemp("strips") / "run"
    assert strips(scene.geometry, out, "--fixed-time") == 0
    return out


def strips(geometry: Path, run: Path, *more: object) -> int:
    return geomosaic("strips", geometry, "-o", run, *more)


def elsewhere(scene: SimulatedStrips, path: Path, **more: Any) -> Path:
    """The geometry file in another place, with other entries; None takes one out."""
    entry = yaml.safe_load(scene.geometry.read_text())
    folder = scene.geometry.parent
    for ccd in entry["ccds"]:
        ccd["path"] = str(folder / ccd["path"])
    entry |= {key: str(folder / entry[key]) for key in ("model", "dem", "rpc")} | more
    path.write_text(yaml.safe_dump({k: v for k, v in entry.items() if v is not None}))
    return path


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def figures(run: Path) -> dict[str, Any]:
    metrics = json.loads((run / "run.json").read_text(encoding="utf-8"))["metrics"]
    return metrics["errors"]["figures"]  # type: ignore[no-any-return]


def warnings_of(run: Path) -> dict[str, str]:
    """Texts by code."""
    warning_list = json.loads((run / "run.json").read_text(encoding="utf-8"))["warnings"]
    return {w["code"]: f"{w['frame']}: {w['text']}" for w in warning_list}


def test_a_run_is_whole_and_its_mosaic_a_cog_with_an_rpc(run: Path) -> None:
    assert {p.name for p in run.iterdir() if p.is_file()} == {*FINAL, MARKER}
    warnings, errors, _ = validate_cloud_optimized_geotiff.validate(str(run / "mosaic.tif"), full_check=True)
    assert not errors and not warnings
    with rasterio.open(run / "mosaic.tif") as mosaic:
        assert mosaic.tags(ns="RPC")["LINE_OFF"]
        assert (mosaic.width, mosaic.count, mosaic.dtypes[0]) == (3 * 384 - 2 * 96, 1, "uint16")
        # Both rows' teeth: from half the rows' separation before line 0 to as much beyond the last.
        assert abs(mosaic.height - (3200 + 700)) < 20
        mask = mosaic.dataset_mask()
    assert not mask[300, 100:280].any() and mask[300, 500].all()
    assert mask[800:-800, 8:-8].all()


def test_offsets_are_the_truth_within_a_tenth_of_a_pixel(run: Path, scene: SimulatedStrips) -> None:
    truth = {(r["pair"], r["line"]): r for r in rows(scene.true_offsets)}
    found = rows(run / "offsets.csv")
    assert len(found) == 2 * 3200
    measured = [r for r in found if r["label"] == "measured"]
    assert len(measured) > 2 * 2300
    errors = [
        [float(r[key]) - float(truth[r["pair"], r["line"]][key]) for key in ("dcol_px", "dline_px")]
        for r in measured
    ]
    assert np.sqrt(np.mean(np.square(errors).sum(axis=1))) < 0.1
    assert np.abs(errors).max() < 1.0


def test_run_json_tells_the_misplacement(run: Path) -> None:
    metrics = json.loads((run / "run.json").read_text(encoding="utf-8"))["metrics"]
    assert metrics["misplacement"]["misplaced"] is False
    assert metrics["misplacement"]["rms_px"] < 0.1
    assert metrics["misplacement"]["share_measured"] > 0.9


def test_an_independent_reader_finds_the_pairs(run: Path) -> None:
    with (run / "run.mcap").open("rb") as file:
        topics = {channel.topic for _, channel, _ in make_reader(file).iter_messages()}
    assert len([t for t in topics if t.startswith("/strip_offsets/")]) >= 2
    assert "/map/strips" in topics and "/images/mosaic" in topics


def test_layers_lie_where_the_scene_is(run: Path) -> None:
    layers = ogr.Open(str(run / "layers.gpkg"))
    names = {layers.GetLayer(i).GetName(): layers.GetLayer(i) for i in range(layers.GetLayerCount())}
    assert names["ccd_strips"].GetFeatureCount() == 3
    west, east, south, north = names["scene"].GetExtent()
    assert west < PLAN.lon_deg < east and south < PLAN.lat_deg < north
    assert names["seam_segments"].GetFeatureCount() == 2 * 7


@pytest.mark.proof
@pytest.mark.parametrize("method", ["piecewise_linear", "image_registration", "virtual_line"])
def test_other_methods_are_recipes(method: str, scene: SimulatedStrips, tmp_path: Path) -> None:
    geometry = elsewhere(scene, tmp_path / "geometry.yaml")
    recipe = RECIPES / f"strips_{method}.yaml"
    truth = f"quality.strips.truth={scene.true_offsets}"
    assert geomosaic("run", recipe, "-o", tmp_path / "run", "--strips", geometry, "--set", truth) == 0
    assert figures(tmp_path / "run")["rms_px"] < {"virtual_line": 0.02}.get(method, 0.6)


def test_the_misplacement_rate_counts_runs_by_method(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(run, tmp_path / "worse", ignore=shutil.ignore_patterns("work"))
    run_summary = json.loads((run / "run.json").read_text(encoding="utf-8"))
    run_summary["metrics"]["misplacement"] |= {"misplaced": True, "worst_segment_px": 1.25}
    (tmp_path / "worse" / "run.json").write_text(json.dumps(run_summary))
    capsys.readouterr()
    assert geomosaic("misplacement", run, tmp_path / "worse") == 0
    lines = capsys.readouterr().out.splitlines()
    assert "in place" in lines[0] and lines[1].endswith("worst segment 1.25 px (joint)")
    assert lines[2] == "joint: 1 of 2 misplaced, 50.0 % (95 % interval 9.5 to 90.5 %)"
    (tmp_path / "dark").mkdir()
    run_summary["metrics"]["misplacement"] |= dict.fromkeys(("misplaced", "rms_px", "worst_segment_px"))
    (tmp_path / "dark" / "run.json").write_text(json.dumps(run_summary))
    dark = tmp_path / "dark"
    assert geomosaic("misplacement", run, dark, tmp_path / "worse", dark, dark) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[1] == f"{dark}: unknown, unknown RMS, worst segment unknown (joint)"
    assert lines[5] == "joint: 1 of 2 misplaced, 50.0 % (95 % interval 9.5 to 90.5 %), 3 unknown"
    assert geomosaic("misplacement", dark, "--json") == 0
    rate = json.loads(capsys.readouterr().out)["rates"]["joint"]
    assert rate == {"scenes": 0, "misplaced": 0, "rate": None, "low": None, "high": None, "unknown": 1}
    assert geomosaic("misplacement", dark) == 0
    assert capsys.readouterr().out.splitlines()[1] == "joint: 1 unknown"
    (tmp_path / "worse" / "run.json").write_text('{"metrics": {}}')
    assert geomosaic("misplacement", tmp_path / "worse") == 2


@pytest.mark.proof
def test_equal_runs_give_equal_bytes(scene: SimulatedStrips, run: Path, tmp_path: Path) -> None:
    assert strips(scene.geometry, tmp_path / "again", "--fixed-time") == 0
    for path in run.iterdir():
        if path.is_file() and path.name != "run.json":
            assert path.read_bytes() == (tmp_path / "again" / path.name).read_bytes(), path.name


@pytest.mark.proof
def test_what_a_changed_strip_touches_is_redone_and_nothing_else(
    scene: SimulatedStrips, run: Path, tmp_path: Path
) -> None:
    again = tmp_path / "run"
    shutil.copytree(run, again)
    assert strips(scene.geometry, again, "--set", "mosaic.strips.blend=hard") == 0
    run_summary = json.loads((again / "run.json").read_text(encoding="utf-8"))
    assert (
        "ccd.offsets" in run_summary["cached_stages"] and "mosaic.strips" not in run_summary["cached_stages"]
    )
    whole = (scene.geometry.parent / "ccd2.tif").read_bytes()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            strip = rasterio.open(scene.geometry.parent / "ccd2.tif", "r+")
        with strip:
            strip.write(np.full((1, 20, 20), 7, dtype=strip.dtypes[0]), window=Window(50, 50, 20, 20))
        assert strips(scene.geometry, again, "--set", "mosaic.strips.blend=hard") == 0
    finally:
        (scene.geometry.parent / "ccd2.tif").write_bytes(whole)
    run_summary = json.loads((again / "run.json").read_text(encoding="utf-8"))
    assert "ccd.offsets" not in run_summary["cached_stages"]


def test_a_dead_ccd_and_a_short_strip_are_named_and_the_rest_is_stitched(tmp_path: Path) -> None:
    plan = replace(PLAN, ccds=4, lines=2200, dead="2", short="4:1700")
    made = simulate_strips(tmp_path / "scene", plan, scene=False)
    truth = f"quality.strips.truth={made.true_offsets}"
    assert strips(made.geometry, tmp_path / "run", "--set", truth) == 0
    warning_found = warnings_of(tmp_path / "run")
    assert warning_found["ccd-missing"].startswith("CCD 2:") and warning_found["strip-short"].startswith(
        "ccd4.tif: has 1700 lines"
    )
    assert "columns 384 to 575 of the scene stay empty" in warning_found["scene-gap"]
    errors = json.loads((tmp_path / "run" / "run.json").read_text())["metrics"]["errors"]
    assert errors["figures"]["p95_px"] < 0.2 and errors["measured_above"] == 0
    with rasterio.open(tmp_path / "run" / "mosaic.tif") as mosaic:
        mask = mosaic.dataset_mask()
    assert not mask[:, 384:576].any() and mask[800:1200, 8:384].all() and mask[800:1200, 576:-8].all()


BAD: dict[str, tuple[dict[str, Any], str]] = {
    "overlap of zero": ({"overlap_px": 0}, "overlap_px is 0; give a whole number of at least 8"),
    "another width": ({"width_px": 400}, "says strips of 400 columns, but they have 384"),
    "rows too far apart": ({"row_separation_lines": 4000}, "rows are 4000 lines apart"),
    "a key of its own": ({"gain": 2}, "gain"),
}


@pytest.mark.parametrize("case", BAD)
def test_a_bad_geometry_is_one_line_and_nothing_written(
    case: str, scene: SimulatedStrips, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    change, text = BAD[case]
    geometry = elsewhere(scene, tmp_path / "geometry.yaml", **change)
    assert strips(geometry, tmp_path / "run") == 2
    error = capsys.readouterr().err.strip()
    assert "\n" not in error and "geometry.yaml" in error and text in error
    assert not (tmp_path / "run").exists()


def test_a_strip_of_text_is_named(
    scene: SimulatedStrips, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    entry = yaml.safe_load(elsewhere(scene, tmp_path / "geometry.yaml").read_text())
    (tmp_path / "notes.tif").write_text("these are notes")
    entry["ccds"][1]["path"] = "notes.tif"
    (tmp_path / "geometry.yaml").write_text(yaml.safe_dump(entry))
    assert strips(tmp_path / "geometry.yaml", tmp_path / "run") == 2
    error = capsys.readouterr().err.strip()
    assert error.endswith("notes.tif: is no raster file that can be read; give a strip such as a GeoTIFF")
    assert not (tmp_path / "run").exists()


def test_an_rpc_of_another_scene_is_named(
    scene: SimulatedStrips, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = scene.rpc.read_text().splitlines()
    moved = ["LONG_OFF: 12.5 degrees" if line.startswith("LONG_OFF") else line for line in text]
    (tmp_path / "other_RPC.TXT").write_text("\n".join(moved))
    geometry = elsewhere(scene, tmp_path / "geometry.yaml", rpc="other_RPC.TXT")
    assert strips(geometry, tmp_path / "run") == 2
    error = capsys.readouterr().err.strip()
    assert "other_RPC.TXT: is of another scene" in error and "\n" not in error
    assert not (tmp_path / "run").exists()


def test_a_dry_run_says_what_scene_and_map_would_take(
    scene: SimulatedStrips, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    reports = []
    for more in ([], ["--map"]):
        assert strips(scene.geometry, tmp_path / "run", "--dry-run", *more) == 0
        said = dict(line.split(maxsplit=1) for line in capsys.readouterr().out.splitlines())
        assert said["strips"] == "3 of 384 px, up to 3,200 lines, 2 seams"
        reports.append(said["expected"])
    assert reports[0].startswith("the mosaic will have about 960 x 3,900 px") and reports[0] != reports[1]
    assert not (tmp_path / "run").exists()


def test_a_map_that_nothing_lays_is_refused_before_offsets_are_sought(
    scene: SimulatedStrips, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bare = elsewhere(scene, tmp_path / "bare.yaml", model=None, rpc=None, dem=None)
    assert strips(bare, tmp_path / "run", "--map") == 2
    said = capsys.readouterr().err
    assert "give 'model' or 'rpc'" in said and "Offsets between the strips" not in said


def test_virtual_line_without_a_model_says_what_to_give(
    scene: SimulatedStrips, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    geometry = elsewhere(scene, tmp_path / "geometry.yaml", model=None)
    assert strips(geometry, tmp_path / "run", "--method", "virtual_line") == 2
    assert "give 'model'" in capsys.readouterr().err


def test_a_strip_cut_short_on_disk_is_named(
    scene: SimulatedStrips, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "strips"
    shutil.copytree(scene.geometry.parent, folder, ignore=shutil.ignore_patterns("truth"))
    whole = (folder / "ccd3.tif").read_bytes()
    (folder / "ccd3.tif").write_bytes(whole[: len(whole) // 2])
    assert strips(folder / "geometry.yaml", tmp_path / "run") == 2
    error = capsys.readouterr().err.strip().splitlines()[-1]
    assert "ccd3.tif" in error
    assert not (tmp_path / "run" / "mosaic.tif").exists()


def test_no_input_is_overwritten(
    scene: SimulatedStrips, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "strips"
    shutil.copytree(scene.geometry.parent, folder, ignore=shutil.ignore_patterns("truth"))
    (folder / "ccd1.tif").rename(folder / "mosaic.tif")
    text = (folder / "geometry.yaml").read_text().replace("ccd1.tif", "mosaic.tif")
    (folder / "geometry.yaml").write_text(text)
    before = (folder / "mosaic.tif").read_bytes()
    assert strips(folder / "geometry.yaml", folder) == 2
    assert "would be overwritten by the run's own file of that name" in capsys.readouterr().err
    assert (folder / "mosaic.tif").read_bytes() == before and not (folder / "work").exists()


def test_tiles_want_a_map(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert geomosaic("export", "tiles", run) == 2
    assert "has no map projection; put it on a map first" in capsys.readouterr().err


def test_calibrated_strips_give_their_values_back(scene: SimulatedStrips, run: Path, tmp_path: Path) -> None:
    """I/F of 0.0003 a count, with NaN where a strip has none, and a hot pixel."""
    entry = yaml.safe_load(scene.geometry.read_text())
    warnings.simplefilter("ignore", NotGeoreferencedWarning)
    for k, ccd in enumerate(entry["ccds"]):
        with rasterio.open(scene.geometry.parent / ccd["path"]) as strip:
            profile, values = strip.profile, 3e-4 * strip.read(1).astype(np.float32)
        values[2000:2004, 200:205] = np.nan
        values[1000, 100] = 1e4
        ccd["path"] = str(tmp_path / f"{k}.tif")
        with rasterio.open(ccd["path"], "w", **{**profile, "dtype": "float32", "nodata": None}) as strip:
            strip.write(values, 1)
    folder = scene.geometry.parent
    entry |= {key: str(folder / entry[key]) for key in ("model", "dem", "rpc")}
    entry.pop("bit_depth", None)
    (tmp_path / "g.yaml").write_text(yaml.safe_dump(entry))
    assert strips(tmp_path / "g.yaml", tmp_path / "run", "-q") == 0
    with rasterio.open(tmp_path / "run" / "mosaic.tif") as got, rasterio.open(run / "mosaic.tif") as whole:
        assert got.dtypes == ("uint16",) and got.shape == whole.shape
        there, seen = whole.dataset_mask() > 0, got.dataset_mask() > 0
        values = got.offsets[0] + got.scales[0] * got.read(1)[seen].astype(np.float64)
        off = np.abs(values - 3e-4 * whole.read(1)[seen])[there[seen]]
    assert 0 < (there ^ seen).sum() < 200
    assert np.percentile(off, 99.0) < 3e-4  # the other run's greys are whole counts
