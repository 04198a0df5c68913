"""A page next to web map tiles that shows them, and a run's layers over them, without any network."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final
from uuid import uuid4

from jinja2 import Environment, StrictUndefined
from markupsafe import Markup
from osgeo import gdal

from geomosaic.doors.gdal_failures import close, gdal_failures
from geomosaic.doors.vector import open_vector

_HERE: Final = Path(__file__).parent
_LAYERS: Final[tuple[tuple[str, str, bool, str, dict[str, Any]], ...]] = (
    ("footprints", "Footprints", False, "", {"color": "#00c8e6", "weight": 1.2, "fillOpacity": 0.0}),
    ("seamlines", "Seamlines", False, "", {"color": "#ffe100", "weight": 2, "fillOpacity": 0.0}),
    ("ccd_strips", "CCD strips", True, "ccd", {"color": "#00c8e6", "weight": 1.2, "fillOpacity": 0.0}),
    ("moves", "Moves from given positions", False, "", {"color": "#d700a0", "weight": 3}),
    (
        "frames", "Frames", False, "frame",
        {"color": "#ffffff", "weight": 1.5, "fillColor": "#28a03c", "fillOpacity": 1.0, "radius": 5},
    ),
    (
        "control", "Control and check points", True, "name",
        {"color": "#ffffff", "weight": 1.5, "fillColor": "#d71e28", "fillOpacity": 1.0, "radius": 6},
    ),
)  # fmt: skip
"""Of a run's layers.gpkg: title, whether it is seen at first, the field that labels, and Leaflet's style."""
_MOST_FEATURES: Final = 5000
_FETCHED: Final = re.compile(r"[\w-]+:\s*url\([^)]*\)\s*;?")
_DECIMALS: Final = 7
"""Of degrees: a centimetre."""


def write_tile_page(
    out: Path, title: str, about_text: str, index: Mapping[str, Any], package: Path | None
) -> None:
    """Writes an HTML page that needs nothing but the tiles in its folder.

    about_text: a line about the mosaic. index: of the tiles, as tiles.json. package: the run's layers.gpkg.
    Raises: `OSError` if it can't be written.
    """
    environment = Environment(autoescape=True, undefined=StrictUndefined)
    page = environment.from_string((_HERE / "tiles.html").read_text(encoding="utf-8"))
    text = page.render(
        title=title,
        about=inline_json({"title": title, "text": about_text}),
        leaflet_css=leaflet("leaflet.css"),
        leaflet_js=leaflet("leaflet.js"),
        index=inline_json(index),
        layers=inline_json([] if package is None else _layers(package)),
    )
    out.write_text(text + "\n", encoding="utf-8")


def leaflet(name: str) -> Markup:
    """Leaflet's script or style sheet for a page that holds it; without images, which would be fetched."""
    text = (_HERE / "leaflet" / name).read_text(encoding="utf-8")
    return Markup(_FETCHED.sub("", text) if name.endswith(".css") else text)  # noqa: S704


def inline_json(value: Any) -> Markup:
    """JSON that no text in it can end the element of."""
    text = json.dumps(value, ensure_ascii=False, separators=(",", ":"))
    return Markup(text.replace("<", "\\u003c"))  # noqa: S704


def _layers(package: Path) -> list[dict[str, Any]]:
    """Those that hold anything, as GeoJSON; too large ones are left to a GIS."""
    shown = []
    with gdal_failures(package):
        source = open_vector(package)
        for name, title, checked, label, style in _LAYERS:
            layer = source.GetLayerByName(name)
            if layer is None or not 0 < layer.GetFeatureCount() <= _MOST_FEATURES:
                continue
            data = _geojson(source, name)
            shown.append({"title": title, "shown": checked, "label": label, "style": style, "data": data})
        close(source)
    return shown


def _geojson(source: Any, name: str) -> Any:
    path = f"/vsimem/{uuid4()}.geojson"
    options = ["RFC7946=YES", f"COORDINATE_PRECISION={_DECIMALS}"]
    close(
        gdal.VectorTranslate(
            path, source, format="GeoJSON", layers=[name], layerName=name, layerCreationOptions=options
        )
    )
    file = gdal.VSIFOpenL(path, "rb")
    text = bytes(gdal.VSIFReadL(1, gdal.VSIStatL(path).size, file))
    gdal.VSIFCloseL(file)
    gdal.Unlink(path)
    return json.loads(text)
