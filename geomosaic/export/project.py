"""A QGIS project of a run: its layers in groups, in their styles, all by relative paths.

Its XML is QGIS' own (QgsProject, QgsMapLayer); only what differs from its defaults is said. A `.qgz`
is a ZIP file that holds it.
"""

from __future__ import annotations

import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final
from xml.etree.ElementTree import Element, SubElement, tostring

from pyproj import CRS

from geomosaic.export.styles import VERSION

_EPOCH: Final = (1980, 1, 1, 0, 0, 0)
"""The first time that a ZIP file can hold: equal projects have equal bytes."""


@dataclass(frozen=True)
class ProjectLayer:
    """A layer of the project.

    name: of its own in the project. source: relative to the project. vector: by OGR, else a raster by GDAL.
    crs: WKT or a code. content: what its `maplayer` holds of the style. checked: seen at first.
    """

    name: str
    title: str
    source: str
    vector: bool
    crs: str
    content: tuple[Element, ...]
    checked: bool = True
    labelled: bool = False
    abstract: str = ""


@dataclass(frozen=True)
class LayerGroup:
    """Layers under one title, the first on top."""

    title: str
    layers: tuple[ProjectLayer, ...]
    expanded: bool = True


def write_project(
    path: Path, title: str, crs: str, extent: tuple[float, float, float, float], groups: Sequence[LayerGroup]
) -> None:
    """Writes `path` as .qgz.

    extent: west, south, east, north of what is shown at first, in the project's CRS.
    Raises: `OSError` if it can't be written.
    """
    project = Element("qgis", projectname=title, version=VERSION)
    SubElement(project, "title").text = title
    SubElement(project, "projectCrs").append(_reference(crs))
    tree = SubElement(project, "layer-tree-group")
    canvas = SubElement(project, "mapcanvas", name="theMapCanvas", annotationsVisible="1")
    SubElement(canvas, "units").text = "degrees" if CRS.from_user_input(crs).is_geographic else "meters"
    _extent(canvas, extent)
    SubElement(canvas, "destinationsrs").append(_reference(crs))
    layers = SubElement(project, "projectlayers")
    order = SubElement(project, "layerorder")
    for group in filter(lambda group: group.layers, groups):
        branch = SubElement(
            tree, "layer-tree-group", name=group.title, checked="Qt::Checked", expanded=_flag(group.expanded)
        )
        for layer in group.layers:
            SubElement(
                branch, "layer-tree-layer", id=_id(layer), name=layer.title, source=layer.source,
                providerKey=_provider(layer), expanded=_flag(layer.vector and layer.checked),
                checked="Qt::Checked" if layer.checked else "Qt::Unchecked",
            )  # fmt: skip
            layers.append(_map_layer(layer))
            SubElement(order, "layer", id=layer.name)
    properties = SubElement(project, "properties")
    for part, name, kind, text in (
        ("Paths", "Absolute", "bool", "false"),
        ("SpatialRefSys", "ProjectionsEnabled", "int", "1"),
    ):
        SubElement(SubElement(properties, part), name, type=kind).text = text
    text = "<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>\n" + tostring(project, "unicode")
    with zipfile.ZipFile(path, "w") as archive:
        entry = zipfile.ZipInfo("project.qgs", _EPOCH)
        entry.compress_type = zipfile.ZIP_DEFLATED
        archive.writestr(entry, text.encode())


def _map_layer(layer: ProjectLayer) -> Element:
    element = Element(
        "maplayer", type="vector" if layer.vector else "raster", labelsEnabled=_flag(layer.labelled),
        hasScaleBasedVisibilityFlag="0", autoRefreshEnabled="0", refreshOnNotifyEnabled="0",
    )  # fmt: skip
    for tag, text in (
        ("id", _id(layer)),
        ("datasource", layer.source),
        ("layername", layer.title),
        ("abstract", layer.abstract),
    ):
        SubElement(element, tag).text = text
    SubElement(element, "srs").append(_reference(layer.crs))
    SubElement(element, "provider", encoding="UTF-8").text = _provider(layer)
    element.extend(layer.content)
    return element


def _id(layer: ProjectLayer) -> str:
    """QGIS gives layers new ones where they have no more than ten letters, and its tree then finds none."""
    return f"geomosaic_{layer.name}"


def _provider(layer: ProjectLayer) -> str:
    return "ogr" if layer.vector else "gdal"


def _reference(crs: str) -> Element:
    """A CRS: by its code where it has one, else by its WKT."""
    known = CRS.from_user_input(crs)
    authority = known.to_authority()
    element = Element("spatialrefsys", nativeFormat="Wkt")
    for tag, text in (
        ("wkt", known.to_wkt()),
        ("authid", ":".join(authority) if authority else ""),
        ("description", known.name),
        ("geographicflag", "true" if known.is_geographic else "false"),
    ):
        SubElement(element, tag).text = text
    return element


def _extent(parent: Element, extent: tuple[float, float, float, float]) -> None:
    element = SubElement(parent, "extent")
    for tag, value in zip(("xmin", "ymin", "xmax", "ymax"), extent, strict=True):
        SubElement(element, tag).text = repr(float(value))


def _flag(on: bool) -> str:
    return "1" if on else "0"
