"""The page of the tiles in a real browser: it shows, zooms, switches and fades, and asks for nothing else."""

from __future__ import annotations

import numpy as np
import pytest
import shapely
from browser import Page, browser
from test_export_cog import raw_raster

from geomosaic.export.cog import write_cog
from geomosaic.export.geopackage import MapFeatures, write_geopackage
from geomosaic.export.web import TileOptions, write_tiles

TILES = "[...document.querySelectorAll('img.leaflet-tile-loaded')].filter(i => i.src.startsWith('file:'))"
SHOWN = f"{TILES}.length > 0"
ZOOM = f"Math.max(...{TILES}.map(i => +i.src.split('/').at(-3)))"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Tiles of 700 px, three frames and their footprints."""
    folder = tmp_path_factory.mktemp("page")
    raw_raster(folder / "raw.tif", side=700)
    write_cog(folder / "raw.tif", folder / "mosaic.tif")
    at = np.array([[576_627.0, 5_188_249.0], [576_630.0, 5_188_247.0], [576_633.0, 5_188_248.0]])
    names = {"frame": ["a <b>.jpg", "b.jpg", "c.jpg"]}
    frames = MapFeatures("frames", "", "Point", shapely.points(at), names)
    seen = MapFeatures("footprints", "", "Polygon", shapely.buffer(shapely.points(at), 2.0), names)
    write_geopackage(folder / "layers.gpkg", "EPSG:32615", None, [frames, seen])
    write_tiles(
        folder / "mosaic.tif", folder / "tiles", TileOptions(threads=1), layers_file=folder / "layers.gpkg"
    )
    return folder / "tiles"


@pytest.fixture(scope="module")
def chromium(tmp_path_factory):
    with browser(tmp_path_factory.mktemp("profile")) as page:
        yield page


@pytest.fixture
def page(folder, chromium):
    chromium.open((folder / "index.html").as_uri())
    chromium.until(SHOWN)
    yield chromium
    assert chromium.errors == []
    inside = (folder.as_uri(), "data:image/")
    assert [url for url in chromium.requests if not url.startswith(inside)] == []
    assert len(chromium.requests) > 1


def test_the_page_zooms_to_tiles_as_fine_as_there_are(page: Page) -> None:
    """And neither asks for finer ones nor for those that would be empty."""
    for way, finest in (("out", 21), ("in", 23)):
        button = f".leaflet-control-zoom-{way}"
        while not page.run(f"document.querySelector('{button}.leaflet-disabled') !== null"):
            before = page.run("map.getZoom()")
            page.click(button)
            page.until(f"map.getZoom() !== {before} && !map._animatingZoom")
        page.until(f"{ZOOM} === {finest}")


def test_layers_are_switched_and_the_mosaic_fades(page: Page) -> None:
    shapes = "document.querySelectorAll('path.leaflet-interactive').length"
    titles = "[...document.querySelectorAll('.leaflet-control-layers-overlays label')].map(l => l.innerText.trim())"
    before = page.run(shapes)
    assert page.run(titles) == ["Mosaic", "Footprints", "Frames"]
    page.click(".leaflet-control-layers-overlays label:nth-child(2) input")
    page.until(f"{shapes} === {before} + 3")
    page.click(".leaflet-control-layers-overlays label:nth-child(1) input")
    page.until("document.querySelectorAll('img.leaflet-tile').length === 0")
    page.click(".leaflet-control-layers-overlays label:nth-child(1) input")
    page.until(SHOWN)
    page.click("input[type=range]", 0.25)
    page.until("+getComputedStyle(document.querySelector('.leaflet-tile-pane .leaflet-layer')).opacity < 0.4")


def test_a_frame_tells_what_it_is(page: Page) -> None:
    page.click(".leaflet-control-layers-overlays label:nth-child(3) input")
    page.until("document.querySelectorAll('path.leaflet-interactive').length === 3")
    page.click("path.leaflet-interactive")
    page.until("document.querySelector('.leaflet-popup-content') !== null")
    assert page.run("document.querySelector('.leaflet-popup-content').innerText") == "frame a <b>.jpg"
