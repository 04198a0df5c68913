"""The surface in the report: what the page holds of it, and what it says."""

from __future__ import annotations

import base64
from pathlib import Path

import cv2
import numpy as np
import pytest
import rasterio
from report_survey import made_up_run
from test_report_page import Page

from geomosaic.pipeline.stage import Context
from geomosaic.quality.surface import compare_surface
from geomosaic.report.frames import FramesReport, render_report
from geomosaic.report.surface import SurfaceSection, surface_section
from geomosaic.stages.export_report import export_report

HOSTILE = "dem <img src=x onerror=alert(1)>.tif"
ROWS, COLS = 200, 1000


def write(path: Path, *bands: np.ndarray) -> Path:
    shape = {"height": ROWS, "width": COLS, "count": len(bands)}
    transform = rasterio.Affine(0.5, 0.0, 660_000.0, 0.0, -0.5, 5_210_000.0)
    with rasterio.open(
        path,
        "w",
        driver="GTiff",
        dtype="float32",
        crs="EPSG:32632",
        nodata=-9999.0,
        transform=transform,
        **shape,
    ) as tiff:
        tiff.write(np.stack(bands).astype(np.float32))
    return path


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    """A slope to the east of 40 m with a house on it; unknown in the north."""
    folder = tmp_path_factory.mktemp("surface")
    ground = np.tile(np.linspace(500.0, 540.0, COLS), (ROWS, 1))
    top = ground.copy()
    top[100:140, 300:380] = 530.0
    sd, views = np.full(top.shape, 0.25), np.full(top.shape, 4.0)
    views[:, 500:] = 0.0
    for band in (ground, top, sd, views):
        band[:50] = -9999.0
    write(folder / "terrain.tif", ground)
    write(folder / "surface.tif", top)
    write(folder / "surface_confidence.tif", sd, views)
    write(folder / HOSTILE, np.where(top > 0.0, top - 0.5, top))
    return folder


METRICS = {
    "surface": {
        "cell_m": 0.52,
        "pixel_m": 0.5,
        "heights": "ellipsoidal, WGS 84, metres",
        "ground_share": 0.81,
    },
    "ortho": {"ground": "terrain", "disagreement": {"surface": 0.412, "terrain": 0.2}, "places": 17},
}


def section(run: Path, metrics: dict | None = None, compared: bool = False) -> SurfaceSection:
    files = [run / f"{name}.tif" for name in ("surface", "surface_confidence", "terrain")]
    comparison = compare_surface(files[0], files[1], run / HOSTILE, None, print)[0] if compared else None
    return surface_section(*files, {"metrics": METRICS if metrics is None else metrics}, comparison)


def decoded(text: str, rows: int, cols: int) -> np.ndarray:
    return np.frombuffer(base64.b64decode(text), "<u2").reshape(rows, cols).astype(float)


def image(uri: str) -> np.ndarray:
    data = np.frombuffer(base64.b64decode(uri.partition(",")[2]), np.uint8)
    return cv2.imdecode(data, cv2.IMREAD_UNCHANGED)


def test_the_page_holds_heights_to_a_centimetre(run):
    profile = section(run).profile
    assert (profile.cols, profile.rows) == (380, 76)
    assert profile.pixel_m == pytest.approx(COLS * 0.5 / 380)
    surface, terrain = (decoded(t, 76, 380) for t in (profile.surface, profile.terrain))
    assert (surface[:18] == 65535).all() and (surface[20:] < 65535).all()
    at = profile.low_m + profile.step_m * terrain[60]
    east = (np.arange(380) + 0.5) * profile.pixel_m
    np.testing.assert_allclose(at, 500.0 + (east - 0.25) / (499.5) * 40.0, atol=0.02)
    row, col = int(120 / ROWS * 76), int(340 / COLS * 380)
    assert profile.low_m + profile.step_m * surface[row, col] == pytest.approx(530.0, abs=0.011)


def test_the_shading_is_lit_from_the_north_west(run):
    shaded = image(section(run).uri)
    assert shaded.shape == (180, 900, 4)
    assert (shaded[:40, :, 3] == 0).all() and (shaded[60:, :, 3] == 255).all()
    grey = shaded[..., :3].sum(axis=-1)
    west, east = 300 * 0.9, 380 * 0.9
    assert (
        grey[95:120, int(west) - 2 : int(west) + 2].max()
        > 1.3 * grey[95:120, int(east) - 2 : int(east) + 2].min()
    )


def test_figures_and_what_the_mosaic_stands_on(run):
    rows = {name: (value, note) for name, value, note in section(run).rows}
    assert rows["matched"][0] == "50\u00a0%"
    assert rows["heights"] == ("500.0 to 540.0\u00a0m", "ellipsoidal, WGS 84, metres")
    assert rows["deviation"][0] == "median 0.250\u00a0m, 90 % below 0.250\u00a0m"
    assert rows["ground"][0] == "81\u00a0%"
    value, why = rows["the mosaic stands on"]
    assert value == "the terrain" and "0.412 on the surface and 0.200 on the terrain" in why
    asked = section(run, {"ortho": {"laid_on": "surface"}}).rows
    assert ("the mosaic stands on", "the surface", "as was asked for") in asked
    assert "the mosaic stands on" not in {name for name, *_ in section(run, {}).rows}


def test_the_difference_is_red_where_the_surface_is_higher(run):
    shown = section(run, compared=True)
    drawn = image(shown.off_uri)
    assert shown.off_m == pytest.approx(0.5, abs=1e-3)
    blue, _, red, opaque = drawn[-5, 100]
    assert red > blue + 100 and opaque == 255 and drawn[5, 100, 3] == 0


@pytest.fixture(scope="module")
def made_up(tmp_path_factory):
    return made_up_run(tmp_path_factory.mktemp("run"))


def test_the_page_is_whole_with_a_surface_and_asks_nothing_of_a_network(run, made_up):
    html = render_report(FramesReport(**made_up, surface=section(run, compared=True)))
    page = Page(html)
    assert page.open == []
    words = " ".join(page.words.split())
    for wanted in (
        "The surface",
        "Surface minus reference",
        "NMAD",
        "by support",
        "assumed to share",
        "+0.500 m",
    ):
        assert wanted in words, wanted
    assert HOSTILE in page.words and HOSTILE not in html
    assert all((a.get("src") or "data:").startswith("data:image/") or "src" not in a for _, a in page.tags)
    assert not any(k.startswith("on") for _, a in page.tags for k in a)
    figure = next(a for t, a in page.tags if a.get("id") == "profile")
    assert len(decoded(figure["data-surface"], int(figure["data-rows"]), int(figure["data-cols"]))) == 76
    assert len(html.encode()) < 2e6


def test_the_stage_shows_the_runs_own_files(run, made_up, tmp_path):
    folder = made_up["mosaic_file"].parent
    for name in ("surface", "surface_confidence", "terrain"):
        (folder / f"{name}.tif").write_bytes((run / f"{name}.tif").read_bytes())
    context = Context(folder, stage_id="export.report", work_folder=tmp_path, summary=made_up["summary"])
    inputs = {k: made_up[k] for k in ("survey", "placement", "ties", "adjusted", "mosaic")}
    inputs["mosaic_file"] = context.run_file("mosaic.tif")
    files = {
        "surface_file": "surface.tif",
        "confidence_file": "surface_confidence.tif",
        "terrain_file": "terrain.tif",
    }
    for given in (inputs, inputs | {name: context.run_file(file) for name, file in files.items()}):
        export_report().run(given, export_report.Params(), context)
        shown = (folder / "report.html").read_text(encoding="utf-8")
        assert ("click two places" in shown) == ("surface_file" in given)
