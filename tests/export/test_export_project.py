"""project.qgz as QGIS reads it: a ZIP file of one XML document. A real QGIS opens it in `make check-qgis`."""

from __future__ import annotations

import zipfile
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import rasterio
import shapely
from osgeo import ogr

from geomosaic.composition.palette import frame_colour
from geomosaic.export import looks
from geomosaic.export.geopackage import MapFeatures, write_geopackage
from geomosaic.export.project import write_project
from geomosaic.export.project_layers import project_of

CRS = "EPSG:32615"


def raster(path: Path, bands: int, dtype: str, crs: str | None = CRS, **tags: str) -> Path:
    where = {"crs": crs, "transform": rasterio.Affine(0.5, 0, 5e5, 0, -0.5, 5e6)}
    with rasterio.open(path, "w", "GTiff", 8, 6, bands, dtype=dtype, **where) as tiff:
        tiff.write(np.ones((bands, 6, 8), dtype))
        tiff.update_tags(**tags)
    return path


def package(path: Path) -> Path:
    points = shapely.points([[5e5, 5e6], [5e5 + 2, 5e6 - 1]])
    fields = {"frame": ["a.jpg", "b.jpg"], "status": ["tied", "placed"]}
    frames = MapFeatures("frames", "", "Point", points, fields, looks.frames())
    control = MapFeatures("control", "", "Point", [], {"name": np.array([], dtype=str)}, looks.control())
    write_geopackage(path, CRS, None, [frames, control])
    return path


@pytest.fixture
def project(tmp_path):
    """Of two frames over a mosaic of 16 bits and three bands."""
    mosaic = raster(
        tmp_path / "mosaic.tif", 3, "uint16",
    )  # fmt: skip
    with rasterio.open(mosaic, "r+") as tiff:
        for band in (1, 2, 3):
            tiff.update_tags(
                band, STATISTICS_MEAN=1000, STATISTICS_STDDEV=200, STATISTICS_MINIMUM=700,
                STATISTICS_MAXIMUM=9000,
            )  # fmt: skip
    raster(tmp_path / "sources.tif", 1, "uint16", FRAME_1="a.jpg", FRAME_2="b.jpg")
    crs, extent, groups = project_of(package(tmp_path / "layers.gpkg"), mosaic)
    write_project(tmp_path / "project.qgz", "flight <1>", crs, extent, groups)
    return tmp_path / "project.qgz"


def document(path: Path) -> ElementTree.Element:
    with zipfile.ZipFile(path) as archive:
        assert archive.namelist() == ["project.qgs"]
        return ElementTree.fromstring(archive.read("project.qgs"))


def test_every_layer_of_the_tree_is_there_by_its_relative_path(project):
    root = document(project)
    layers = {layer.findtext("id"): layer for layer in root.findall("projectlayers/maplayer")}
    tree = {node.get("id"): node for node in root.iter("layer-tree-layer")}
    assert tree.keys() == layers.keys()
    assert min(map(len, tree)) > 10, "QGIS gives shorter ids up, and the tree then finds no layer"
    sources = {name: layer.findtext("datasource") for name, layer in layers.items()}
    assert sources == {
        "geomosaic_frames": "./layers.gpkg|layername=frames",
        "geomosaic_sources": "./sources.tif",
        "geomosaic_mosaic": "./mosaic.tif",
    }, "a layer that holds nothing is left out"
    assert [group.get("name") for group in root.iter("layer-tree-group") if group.get("name")] == [
        "Frames", "Mosaic",
    ]  # fmt: skip
    assert root.findtext("title") == "flight <1>"
    assert root.findtext("projectCrs/spatialrefsys/authid") == CRS
    assert [float(e.text) for e in root.find("mapcanvas/extent")] == [5e5, 5e6 - 3, 5e5 + 4, 5e6]


def test_layers_look_as_the_geopackage_says(project):
    root = document(project)
    dataset = ogr.Open(str(project.with_name("layers.gpkg")))
    (text,) = (r["styleQML"] for r in dataset.GetLayer("layer_styles") if r["f_table_name"] == "frames")
    own = ElementTree.fromstring(text)
    for part in ("renderer-v2", "labeling"):
        given = root.find(f"projectlayers/maplayer[id='geomosaic_frames']/{part}")
        assert ElementTree.tostring(given).strip() == ElementTree.tostring(own.find(part)).strip()


def test_rasters_are_stretched_and_the_sources_named(project):
    root = document(project)
    mosaic = root.find("projectlayers/maplayer[id='geomosaic_mosaic']/pipe/rasterrenderer")
    assert mosaic.get("alphaBand") == "4", "the mask is the band after the last"
    limits = [(e.findtext("minValue"), e.findtext("maxValue")) for e in mosaic]
    assert limits == [("700", "1400")] * 3, "two deviations about the mean, no further than there is anything"
    palette = root.findall(".//paletteEntry")
    assert [(e.get("value"), e.get("label")) for e in palette] == [("1", "a.jpg"), ("2", "b.jpg")]
    colours = np.array([frame_colour(n) for n in range(1, 300)])
    steps = np.linalg.norm(np.diff(colours, axis=0), axis=1)
    assert steps.min() > 60, "frames that follow each other differ"


def test_the_surface_has_a_group_of_its_own(tmp_path):
    """Its shading is made of its heights; none of it hides the mosaic at first."""
    for name, bands in (("mosaic", 3), ("surface", 1), ("terrain", 1), ("surface_confidence", 2)):
        path = raster(tmp_path / f"{name}.tif", bands, "float32", HEIGHTS="ellipsoidal, in metres")
        with rasterio.open(path, "r+") as tiff:
            statistics = {"MEAN": 100, "STDDEV": 5, "MINIMUM": 97, "MAXIMUM": 140}
            for band in tiff.indexes:
                tiff.update_tags(band, **{f"STATISTICS_{k}": v for k, v in statistics.items()})
    crs, extent, groups = project_of(package(tmp_path / "layers.gpkg"), tmp_path / "mosaic.tif")
    write_project(tmp_path / "project.qgz", "t", crs, extent, groups)
    root = document(tmp_path / "project.qgz")
    names = [group.get("name") for group in root.iter("layer-tree-group") if group.get("name")]
    assert names == ["Frames", "Surface", "Mosaic"], "over the mosaic, so that the shading falls on it"
    group = root.find(".//layer-tree-group[@name='Surface']")
    assert [(node.get("source"), node.get("checked")) for node in group] == [
        ("./surface.tif", "Qt::Unchecked"), ("./surface.tif", "Qt::Unchecked"),
        ("./terrain.tif", "Qt::Unchecked"), ("./surface_confidence.tif", "Qt::Unchecked"),
        ("./surface_confidence.tif", "Qt::Unchecked"),
    ]  # fmt: skip
    assert len({node.get("id") for node in group}) == 5
    shading, surface = (
        root.find(f"projectlayers/maplayer[id='geomosaic_{name}']") for name in ("surface_shading", "surface")
    )
    assert shading.findtext("blendMode") == "6"
    assert shading.find("pipe/rasterrenderer").get("type") == "hillshade"
    assert surface.findtext("abstract") == "Heights are ellipsoidal, in metres."
    items = [float(item.get("value")) for item in surface.iter("item")]
    assert items == [97.0, 100.25, 103.5, 106.75, 110.0], "two deviations, no further than heights reach"


def test_shading_and_contours_that_were_written_are_shown(tmp_path):
    for name, kind in (("mosaic", "uint8"), ("surface", "float32"), ("surface_hillshade", "uint8")):
        raster(tmp_path / f"{name}.tif", 1, kind)
    line = shapely.LineString([(0, 0), (1, 1)])
    contours = MapFeatures("contours", "", "LineString", [line], {"height_m": [2.0]})
    write_geopackage(tmp_path / "terrain_contours.gpkg", CRS, None, [contours])
    crs, extent, groups = project_of(package(tmp_path / "layers.gpkg"), tmp_path / "mosaic.tif")
    write_project(tmp_path / "project.qgz", "t", crs, extent, groups)
    root = document(tmp_path / "project.qgz")
    group = root.find(".//layer-tree-group[@name='Surface']")
    assert [(node.get("source"), node.get("providerKey"), node.get("checked")) for node in group] == [
        ("./terrain_contours.gpkg|layername=contours", "ogr", "Qt::Unchecked"),
        ("./surface_hillshade.tif", "gdal", "Qt::Unchecked"), ("./surface.tif", "gdal", "Qt::Unchecked"),
    ]  # fmt: skip
    shading, lines = (
        root.find(f"projectlayers/maplayer[id='geomosaic_{name}']")
        for name in ("surface_shading", "terrain_contours")
    )
    assert shading.findtext("blendMode") == "6"
    assert shading.find("pipe/rasterrenderer").get("type") == "singlebandgray"
    assert lines.find("labeling/settings/text-style").get("fieldName") == "round(\"height_m\", 2) || ' m'"


def test_a_scene_without_a_map_is_left_out(tmp_path):
    mosaic = raster(tmp_path / "mosaic.tif", 1, "uint16", crs=None)
    crs, extent, groups = project_of(package(tmp_path / "layers.gpkg"), mosaic)
    assert extent == (5e5, 5e6 - 1, 5e5 + 2, 5e6)
    write_project(tmp_path / "a.qgz", "t", crs, extent, groups)
    write_project(tmp_path / "b.qgz", "t", crs, extent, groups)
    assert [e.text for e in document(tmp_path / "a.qgz").iter("datasource")] == [
        "./layers.gpkg|layername=frames"
    ]
    assert (tmp_path / "a.qgz").read_bytes() == (tmp_path / "b.qgz").read_bytes()
