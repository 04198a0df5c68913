"""What the QGIS project of a run shows: layers of its GeoPackage in their styles there, and its rasters."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final

from defusedxml.ElementTree import fromstring

from geomosaic.doors.raster import OWN, open_raster
from geomosaic.export.looks import contours
from geomosaic.export.project import LayerGroup, ProjectLayer
from geomosaic.export.project_rasters import (
    accuracy_layers,
    image_layer,
    index_layers,
    source_layer,
    surface_layers,
)
from geomosaic.export.styles import parts
from geomosaic.export.web import on_map

_TITLES: Final[dict[str, tuple[str, bool]]] = {
    "frames": ("Frames", True),
    "moves": ("Moves from given positions", True),
    "control": ("Control and check points", True),
    "control_residuals": ("Residuals of control points", True),
    "error_ellipses": ("Error ellipses", False),
    "nadir_points": ("Given positions", False),
    "footprints": ("Footprints", True),
    "residuals": ("Residuals of tie points", False),
    "tie_points": ("Tie points", False),
    "image_residuals": ("Residuals in images", False),
    "seamlines": ("Seamlines", True),
    "trimmed": ("Trimmed", False),
    "seam_segments": ("Seams by misplacement", True),
    "ccd_strips": ("CCD strips", True),
    "scene": ("Scene", True),
}
"""Each layer's title, and whether it is seen at first."""
_GROUPS: Final = {
    "Frames": ("frames", "moves", "nadir_points", "error_ellipses", "footprints"),
    "Control": ("control", "control_residuals"),
    "Residuals": ("residuals", "tie_points", "image_residuals"),
    "Strips": ("seam_segments", "ccd_strips", "scene"),
}
_ON_MOSAIC: Final = ("seamlines", "trimmed")
CONTOURS: Final = "terrain_contours.gpkg"
_SOURCES: Final = "sources.tif"


def project_of(
    package: Path, mosaic: Path
) -> tuple[str, tuple[float, float, float, float], list[LayerGroup]]:
    """A run's project: its CRS, what of it is seen at first, and its groups.

    package: the run's layers.gpkg; rasters are those in its folder. A scene of strips is shown by its
    mosaic_map.tif, if that was made.
    """
    crs, shown = vector_layers(package)
    rasters = []
    mosaic = on_map(mosaic)
    with open_raster(mosaic, OWN) as tiff:
        bounds = None if tiff.crs is None else tuple(tiff.bounds)
        crs = crs if tiff.crs is None else tiff.crs.to_wkt()
    if bounds is not None:
        rasters = [image_layer(mosaic, "Mosaic")]
        if (sources := mosaic.with_name(_SOURCES)).is_file():
            rasters.insert(0, source_layer(sources))
    groups = [
        LayerGroup(
            title, tuple(shown[name] for name in names if name in shown), expanded=title != "Residuals"
        )
        for title, names in _GROUPS.items()
    ]
    folder, over = package.parent, [shown[name] for name in _ON_MOSAIC if name in shown]
    groups += [
        LayerGroup("Indices", tuple(index_layers(folder))),
        LayerGroup("Accuracy", tuple(accuracy_layers(folder))),
        LayerGroup("Surface", (*contour_layers(folder), *surface_layers(folder))),
        LayerGroup("Mosaic", (*over, *rasters)),
    ]
    return crs, bounds or bounds_of_layers(package, list(shown)), groups


def vector_layers(package: Path) -> tuple[str, dict[str, ProjectLayer]]:
    """A GeoPackage of ours: its CRS, and its layers that hold anything, by name."""
    from pyogrio import read_info
    from pyogrio.raw import read

    from geomosaic.doors.vector import open_vector

    meta, _, _, columns = read(str(package), layer="layer_styles", read_geometry=False)
    table = dict(zip(meta["fields"].tolist(), columns, strict=True))
    rows = zip(table["f_table_name"], table["styleQML"], table["description"], strict=True)
    styles = {name: (fromstring(document), text) for name, document, text in rows}
    crs, shown = "", {}
    opened = open_vector(package)
    for layer in (opened.GetLayer(k) for k in range(opened.GetLayerCount())):
        name = layer.GetName()
        if name not in styles:
            continue
        crs = crs or read_info(str(package), layer=name)["crs"]  # one for all
        if layer.GetFeatureCount():
            document, text = styles[name]
            title, checked = _TITLES.get(name, (name, True))
            shown[name] = ProjectLayer(
                name, title, f"./{package.name}|layername={name}", True, crs, tuple(document), checked,
                document.get("labelsEnabled") == "1", text,
            )  # fmt: skip
    return crs, shown


def contour_layers(folder: Path) -> list[ProjectLayer]:
    """A run's contours, if they were written, with their heights."""
    from pyogrio import read_info

    file = folder / CONTOURS
    if not file.is_file():
        return []
    crs = read_info(str(file), layer="contours")["crs"]
    content = tuple(parts(contours()))
    return [
        ProjectLayer(
            "terrain_contours", "Contours of the ground", f"./{CONTOURS}|layername=contours", True, crs,
            content, checked=False, labelled=True,
        )
    ]  # fmt: skip


def bounds_of_layers(package: Path, names: Sequence[str]) -> tuple[float, float, float, float]:
    """Of all features of some layers of a GeoPackage; the whole Earth if there is none."""
    from pyogrio import read_info

    found = [read_info(str(package), layer=name, force_total_bounds=True)["total_bounds"] for name in names]
    if not found:
        return -180.0, -90.0, 180.0, 90.0
    west, south, east, north = zip(*found, strict=True)
    return min(west), min(south), max(east), max(north)
