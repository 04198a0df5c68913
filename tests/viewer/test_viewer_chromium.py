"""A finished run in a real browser: measures by clicks agree with the simulated truth, two runs with each other."""

from __future__ import annotations

import base64
import csv
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest
import rasterio
from browser import Page, browser
from osgeo import gdal, osr
from pyproj import Transformer
from small_surveys import mosaic
from target_survey import target_survey

from geomosaic.marking.target_refinement import refined
from geomosaic.pages.loopback_server import LoopbackServer
from geomosaic.viewer.grid_raster import ViewGrid
from geomosaic.viewer.run_view import run_views
from geomosaic.viewer.viewer_pages import ViewerPages

CELL_M = 0.5
HEAP_M, HEAP_UP_M, GROUND_M = 6.0, 2.0, 520.0
FEWER = "--set=matching.sift.keypoints=1000"


@dataclass(frozen=True)
class Flight:
    """A run with a surface, and where its targets are: on the map in m, and in the mosaic in pixels."""

    run: Path
    true_m: dict[str, np.ndarray]
    px: dict[str, np.ndarray]
    grid: ViewGrid

    @property
    def heap_m(self) -> np.ndarray:
        """The middle of the heap that its surface has: on the raster's middle cell."""
        with rasterio.open(self.run / "surface.tif") as raster:
            return np.array(raster.transform @ (raster.width // 2, raster.height // 2))


@pytest.fixture(scope="module")
def window(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    with browser(tmp_path_factory.mktemp("profile")) as page:
        yield page


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Flight:
    """Eight frames over targets whose true places are known; the surface is the true ground with a heap."""
    survey = target_survey(tmp_path_factory.mktemp("flight"), position_sd_m=0.03, height_sd_m=0.03)
    run = tmp_path_factory.mktemp("runs") / "run"
    control = survey.rover.with_name("gcp.csv")
    assert mosaic(survey.frames, run, "--camera", survey.camera, "--gcp", control, "-q", FEWER) == 0
    grid = ViewGrid.of(run / "mosaic.tif")
    write_surface(run, grid)
    way = Transformer.from_crs("EPSG:4326", grid.crs, always_xy=True)
    with survey.rover.open(newline="") as file:
        true = {
            r["name"]: np.array(way.transform(float(r["lon_deg"]), float(r["lat_deg"])))
            for r in csv.DictReader(file)
        }
    with rasterio.open(run / "mosaic.tif") as tiff:
        grey = cv2.cvtColor(np.ascontiguousarray(np.moveaxis(tiff.read(), 0, 2)), cv2.COLOR_RGB2GRAY)
    found = {name: refined(grey, *grid.px_from_map(at[None])[0]) for name, at in true.items()}
    px = {name: np.array(at) for name, at in found.items() if at is not None}
    assert len(px) >= 4
    return Flight(run, true, px, grid)


def write_surface(run: Path, grid: ViewGrid) -> None:
    """Level ground, and in the middle of the raster a heap with upright sides, all known to 5 cm."""
    by = round(CELL_M / grid.pixel_m)
    cols, rows = -(-grid.width // by), -(-grid.height // by)
    up = np.full((rows, cols), GROUND_M, np.float32)
    half = round(HEAP_M / CELL_M / 2)
    up[rows // 2 - half : rows // 2 + half, cols // 2 - half : cols // 2 + half] += HEAP_UP_M
    for name, bands in {"surface": [up], "surface_confidence": [0.0 * up + 0.05, 0.0 * up + 5]}.items():
        made = gdal.GetDriverByName("GTiff").Create(
            str(run / f"{name}.tif"), cols, rows, len(bands), gdal.GDT_Float32
        )
        reference = osr.SpatialReference()
        reference.ImportFromWkt(grid.crs)
        made.SetSpatialRef(reference)
        made.SetGeoTransform((grid.transform.c, CELL_M, 0.0, grid.transform.f, 0.0, -CELL_M))
        for k, values in enumerate(bands, start=1):
            made.GetRasterBand(k).SetNoDataValue(-9999.0)
            made.GetRasterBand(k).WriteArray(values)
        made.FlushCache()


@contextmanager
def served(*runs: Path) -> Iterator[LoopbackServer]:
    with LoopbackServer(ViewerPages(run_views(*runs))) as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.02,), daemon=True)
        thread.start()
        yield server
        server.shutdown()
        thread.join()


def opened(window: Page, server: LoopbackServer, width: int = 1280, height: int = 800) -> None:
    window.open(server.url, width, height)
    window.until("document.querySelectorAll('#tools button').length === 5")


def press(window: Page, key: str) -> None:
    text = {"text": key} if len(key) == 1 else {"text": "\r"} if key == "Enter" else {}
    window.send("Input.dispatchKeyEvent", type="keyDown", key=key, **text)
    window.send("Input.dispatchKeyEvent", type="keyUp", key=key)


class Map:
    """The canvas and where the map's pixels are on it, as the page has it after a press of 0: the whole map."""

    def __init__(self, window: Page, grid: ViewGrid) -> None:
        box = "document.querySelector('#map').getBoundingClientRect()"
        self.box = np.array(window.run(f"(b => [b.left, b.top, b.width, b.height])({box})"))
        self.scale = 0.94 * float(min(self.box[2] / grid.width, self.box[3] / grid.height))
        self.middle = np.array([grid.width, grid.height]) / 2.0

    def screen(self, px: np.ndarray) -> np.ndarray:
        return self.box[:2] + self.box[2:] / 2.0 + (px - self.middle) * self.scale


def click(window: Page, at: np.ndarray) -> None:
    for kind in ("mousePressed", "mouseReleased"):
        where = {"x": float(at[0]), "y": float(at[1])}
        window.send("Input.dispatchMouseEvent", type=kind, **where, button="left", clickCount=1)


def measured(window: Page, kind: str, *places: np.ndarray) -> dict[str, tuple[float, float]]:
    """Values and deviations by their labels, of a measure made by clicks and a last Enter."""
    before = window.run("document.querySelectorAll('.measure').length")
    window.click(f"[data-kind={kind}]")
    for at in places:
        click(window, at)
    if kind != "place":
        press(window, "Enter")
    window.until(f"document.querySelectorAll('.measure').length === {before + 1}")
    window.click(f"[data-kind={kind}]")
    rows = window.run("[...document.querySelector('.measure dl').children].map(e => e.textContent)")
    return {label: numbers(value) for label, value in zip(rows[::2], rows[1::2], strict=True)}


def numbers(value: str) -> tuple[float, float]:
    found = [float(n) for n in re.findall(r"-?[\d.]+", value.replace(",", ""))]
    return (found + [float("nan")] * 2)[:2]  # type: ignore[return-value]


def picture(window: Page) -> np.ndarray:
    data = window.send("Page.captureScreenshot", format="png")["data"]
    return cv2.imdecode(np.frombuffer(base64.b64decode(data), np.uint8), cv2.IMREAD_COLOR)


def test_clicks_measure_what_is_true(window: Page, flight: Flight) -> None:
    with served(flight.run) as server:
        opened(window, server)
        view = Map(window, flight.grid)
        one, other, third, fourth = list(flight.px)[:4]
        px, true = flight.px, flight.true_m
        off_m = flight.grid.pixel_m / view.scale  # a mouse clicks whole pixels of the screen

        length, sd = measured(window, "distance", view.screen(px[one]), view.screen(px[other]))["Length"]
        assert length == pytest.approx(np.linalg.norm(true[one] - true[other]), abs=2 * sd + 2 * off_m)
        assert 0.0 < sd < 0.01 * length

        east, _ = measured(window, "place", view.screen(px[third]))["East"]
        assert east == pytest.approx(true[third][0], abs=0.2 + off_m)

        corners = [true[name] for name in (one, other, third, fourth)]
        order = np.argsort([np.arctan2(*(c - np.mean(corners, axis=0))) for c in corners])
        names = [(one, other, third, fourth)[k] for k in order]
        ring = np.array([true[name] for name in names])
        area = 0.5 * abs(np.sum(ring[:, 0] * np.roll(ring[:, 1], 1) - ring[:, 1] * np.roll(ring[:, 0], 1)))
        found = measured(window, "area", *(view.screen(px[name]) for name in names))["Area"]
        assert found[0] == pytest.approx(area, abs=3 * found[1] + 0.02 * area)

        around = np.array([[-6, -6], [6, -6], [6, 6], [-6, 6]]) + flight.heap_m
        places = [view.screen(at) for at in flight.grid.px_from_map(around)]
        volume = measured(window, "volume", *places)
        assert volume["Above the rim"][0] == pytest.approx(HEAP_M**2 * HEAP_UP_M, abs=0.5)
        assert volume["Below the rim"][0] == pytest.approx(0.0, abs=0.01)
        assert volume["Above the rim"][1] == pytest.approx(144.0 * 0.05 * np.sqrt(2.0), rel=0.1)

        ends = flight.grid.px_from_map(flight.heap_m + np.array([[-10.0, 0.0], [1.0, 0.0]]))
        profile = measured(window, "profile", *(view.screen(at) for at in ends))
        assert profile["Height difference"] == pytest.approx((HEAP_UP_M, 0.05 * np.sqrt(2.0)), abs=0.01)
        assert profile["Lowest, highest"] == pytest.approx((GROUND_M, GROUND_M + HEAP_UP_M))
        assert window.run("document.querySelectorAll('.measure svg polyline').length") == 1

        found = (
            "{area: {value: 9, sd: 1, ellipsoidal: 9.1}, volume: {above: 7, below: 2, sd: 1}, surface: true}"
        )
        window.run(
            f"import('./measures.js').then(m => {{ window.said = m.headline('volume', {found}); }}), 0"
        )
        window.until("window.said")
        assert window.run("window.said").startswith("5.0 "), "above less below, whatever rows stand before it"
        assert not window.errors
        assert all(url.startswith(server.url) for url in window.requests if not url.startswith("data:"))


def test_layers_are_shown_and_points_taken_back(window: Page, flight: Flight) -> None:
    with served(flight.run) as server:
        opened(window, server)
        seen = [still(window)]
        for layer in ("surface", "accuracy"):
            window.click(f"[value={layer}]")
            window.until("!document.querySelector('#legend').hidden")
            seen.append(shown(window, seen[-1]))
        for title in ("Seamlines", "Control and check points"):
            window.click(f"[value='{title}']")
            seen.append(shown(window, seen[-1]))
        assert window.run("document.querySelector('#low').textContent").endswith(" m")

        view = Map(window, flight.grid)
        window.click("[data-kind=area]")
        for k in range(3):
            click(window, view.screen(view.middle + [60.0 * k, 40.0 * (k % 2)]))
        window.until("!document.querySelector('#done').disabled")
        press(window, "Backspace")
        assert window.run("document.querySelector('#done').disabled")
        assert "1 more point" in window.run("document.querySelector('#hint').textContent")
        press(window, "Escape")
        assert window.run("document.querySelectorAll('.measure').length") == 0
        assert not window.errors


def still(window: Page) -> np.ndarray:
    """The window once it looks alike for half a second."""
    last = picture(window)
    for _ in range(60):
        time.sleep(0.5)
        now = picture(window)
        if (now == last).all():
            return now
        last = now
    pytest.fail("the map does not come to rest")


def shown(window: Page, before: np.ndarray) -> np.ndarray:
    """The window once it looks otherwise and is still."""
    for _ in range(200):
        if np.abs(picture(window).astype(int) - before)[:, :900].mean() > 0.01:
            return still(window)
    pytest.fail("the map looks as it did")


def test_a_swipe_compares_two_runs_on_different_grids(window: Page, flight: Flight, tmp_path: Path) -> None:
    """The other run is the same map in the next zone, with other pixels."""
    other = tmp_path / "other"
    shutil.copytree(flight.run, other, ignore=shutil.ignore_patterns("work", "surface*"))
    gdal.Warp(
        str(other / "mosaic.tif"), str(flight.run / "mosaic.tif"), dstSRS="EPSG:32633", xRes=0.13, yRes=0.13,
        resampleAlg="cubic", creationOptions=["TILED=YES"], dstAlpha=True,
    )  # fmt: skip
    with served(flight.run, other) as server:
        opened(window, server)
        view = Map(window, flight.grid)
        seen = []
        for edge in (0.995, 0.005):
            box = window.run(
                "(b => [b.left + b.width / 2, b.top + 100])(document.querySelector('#swipe').getBoundingClientRect())"
            )
            window.drag(tuple(box), (view.box[0] + edge * view.box[2], box[1]))
            window.until(f"Math.abs(document.querySelector('#swipe').ariaValueNow - {100 * edge}) < 2")
            seen.append(cv2.GaussianBlur(still(window), (0, 0), 1.0))
        at = view.screen(view.middle).astype(int)
        one, two = (s[at[1] - 150 : at[1] + 150, at[0] - 200 : at[0] + 200].ravel() for s in seen)
        assert np.corrcoef(one, two)[0, 1] > 0.98
        assert (one != two).any()

        names = list(flight.px)[:2]
        window.click("[data-kind=distance]")
        for name in names:
            click(window, view.screen(flight.px[name]))
        press(window, "Enter")
        window.until("document.querySelectorAll('.measure dl').length === 2")
        lengths = window.run("[...document.querySelectorAll('.measure dd')].map(e => e.textContent)")
        assert numbers(lengths[0])[0] == pytest.approx(numbers(lengths[-1])[0], rel=2e-3)
        assert not window.errors


def test_a_phone_measures_by_touch(window: Page, flight: Flight) -> None:
    with served(flight.run) as server:
        opened(window, server, 390, 800)
        window.send("Emulation.setTouchEmulationEnabled", enabled=True, maxTouchPoints=2)
        assert window.run("document.documentElement.scrollWidth") <= 390
        view = Map(window, flight.grid)
        tap(
            window,
            window.run(
                "(b => [b.left + 20, b.top + 20])(document.querySelector('[data-kind=distance]').getBoundingClientRect())"
            ),
        )
        for name in list(flight.px)[:2]:
            tap(window, view.screen(flight.px[name]))
        window.until("document.querySelector('#hint').textContent.includes('±')")
        tap(
            window,
            window.run(
                "(b => [b.left + 20, b.top + 20])(document.querySelector('#done').getBoundingClientRect())"
            ),
        )
        window.until("document.querySelectorAll('.measure').length === 1")
        length, sd = numbers(window.run("document.querySelector('.measure dd').textContent"))
        one, other = (flight.true_m[name] for name in list(flight.px)[:2])
        assert length == pytest.approx(
            np.linalg.norm(one - other), abs=2 * sd + 2 * flight.grid.pixel_m / view.scale
        )
        window.send("Emulation.setTouchEmulationEnabled", enabled=False)
        assert not window.errors


def tap(window: Page, at: np.ndarray) -> None:
    point = [{"x": float(at[0]), "y": float(at[1]), "id": 0}]
    window.send("Input.dispatchTouchEvent", type="touchStart", touchPoints=point)
    window.send("Input.dispatchTouchEvent", type="touchEnd", touchPoints=[])


def test_the_command_serves_and_ends(flight: Flight) -> None:
    command = [sys.executable, "-m", "geomosaic.cli.main", "open", flight.run]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        word, url = process.stdout.readline().split()
        with urllib.request.urlopen(f"{url}tile/0/mosaic/1/0/0", timeout=60) as answer:
            assert word == "open" and answer.headers["Content-Type"] == "image/webp"
        process.send_signal(signal.SIGINT)
        process.stdout.read()
    assert process.returncode == 130
