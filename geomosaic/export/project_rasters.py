"""Rasters of a run in its QGIS project: the mosaic, which frame gave what, its accuracy, the surface lit
from the north-west."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final
from xml.etree.ElementTree import Element, SubElement, tostring

from geomosaic.composition.palette import frame_colour
from geomosaic.doors.raster import OWN, open_raster
from geomosaic.export.project import ProjectLayer
from geomosaic.export.styles import VERSION
from geomosaic.quality.rasters import RGB, colour_bands

HILLSHADE: Final = "surface_hillshade.tif"
_SPREAD: Final = 2.0
"""Deviations about the mean that are stretched from black to white, as QGIS does by default."""
_HEIGHTS: Final = ("#00224d", "#414d6b", "#7b7b78", "#bbae6e", "#fde737")
"""Low to high: CIVIDIS, which the report draws heights in too."""
_DOUBT: Final = ("#1a9641", "#a6d96a", "#ffffbf", "#fdae61", "#d7191c")
"""Sure to doubtful."""
_LEAVES: Final = _DOUBT[::-1]
"""Bare to green."""
_HEAT: Final = ("#000004", "#57106e", "#bc3754", "#f98e09", "#fcffa4")
"""Cold to hot: INFERNO."""
_SOURCES: Final = {
    1: ("tie surface", "#1a9641"),
    2: ("matched", "#2b83ba"),
    3: ("filled", "#fdae61"),
    4: ("extrapolated", "#d7191c"),
}
"""By band 3 of accuracy.tif: where a height comes from, and its colour."""
_MULTIPLY: Final = "6"
"""QGIS' number of the way of blending that shades what lies below."""


def image_layer(path: Path, title: str) -> ProjectLayer:
    """A raster on the map in its colours, stretched where it has more than 8 bits."""
    with open_raster(path, OWN) as tiff:
        bands = colour_bands(tiff)
        stretch = None if tiff.dtypes[0] == "uint8" else [_stretch(tiff.tags(band)) for band in bands]
        crs, mask = tiff.crs.to_wkt(), tiff.count + 1
    if len(bands) == 3:
        renderer = Element("rasterrenderer", type="multibandcolor", opacity="1", alphaBand=f"{mask}")
        for colour, band in zip(RGB, bands, strict=True):
            renderer.set(f"{colour}Band", f"{band}")
        parts: Sequence[str] = [f"{c}ContrastEnhancement" for c in RGB]
    else:
        renderer = Element(
            "rasterrenderer", type="singlebandgray", opacity="1", alphaBand=f"{mask}", grayBand="1",
            gradient="BlackToWhite",
        )  # fmt: skip
        parts = ["contrastEnhancement"]
    for part, limits in zip(parts, stretch or [], strict=False):
        if limits is not None:
            element = SubElement(renderer, part)
            for tag, value in zip(("minValue", "maxValue"), limits, strict=True):
                SubElement(element, tag).text = f"{value:g}"
            SubElement(element, "algorithm").text = "StretchToMinimumMaximum"
    return _raster(path, title, crs, renderer)


def _stretch(tags: dict[str, str]) -> tuple[float, float] | None:
    """What becomes black and white, by the band's statistics."""
    try:
        mean, sd = float(tags["STATISTICS_MEAN"]), float(tags["STATISTICS_STDDEV"])
        least, most = float(tags["STATISTICS_MINIMUM"]), float(tags["STATISTICS_MAXIMUM"])
    except (KeyError, ValueError):
        return None
    return max(least, mean - _SPREAD * sd), min(most, mean + _SPREAD * sd)


def source_layer(path: Path) -> ProjectLayer:
    """Which frame gave each pixel: a colour and the frame's name for each number."""
    with open_raster(path, OWN) as tiff:
        tags, crs = tiff.tags(), tiff.crs.to_wkt()
    frames = {
        int(key.removeprefix("FRAME_")): name
        for key, name in tags.items()
        if key.removeprefix("FRAME_").isdigit()
    }
    renderer = Element("rasterrenderer", type="paletted", band="1", alphaBand="-1", opacity="0.5")
    palette = SubElement(renderer, "colorPalette")
    for number in sorted(frames):
        red, green, blue = frame_colour(number)
        SubElement(
            palette, "paletteEntry", value=f"{number}", color=f"#{red:02x}{green:02x}{blue:02x}", alpha="255",
            label=frames[number],
        )  # fmt: skip
    return replace(_raster(path, "Which frame gives each pixel", crs, renderer), checked=False)


def accuracy_layers(folder: Path) -> list[ProjectLayer]:
    """Those of a run's accuracy.tif, if it has one: both deviations, and where heights come from."""
    path = folder / "accuracy.tif"
    if not path.is_file():
        return []
    with open_raster(path, OWN) as tiff:
        crs, known = tiff.crs.to_wkt(), [_stretch(tiff.tags(band)) is not None for band in (1, 2)]
    shown = [_coloured(path, "Accuracy in plan", 1, _DOUBT, id="accuracy_horizontal")] if known[0] else []
    if known[1]:
        shown.append(_coloured(path, "Accuracy of heights", 2, _DOUBT, id="accuracy_vertical"))
    renderer = Element("rasterrenderer", type="paletted", band="3", alphaBand="-1", opacity="0.6")
    palette = SubElement(renderer, "colorPalette")
    for number, (label, colour) in _SOURCES.items():
        SubElement(palette, "paletteEntry", value=f"{number}", color=colour, alpha="255", label=label)
    sources = _raster(path, "Where heights come from", crs, renderer)
    return [*shown, replace(sources, checked=False, name="accuracy_sources")]


def surface_layers(folder: Path) -> list[ProjectLayer]:
    """The layers of a run's surface, if it has one, with the shading on top. The shading is the file's where
    it was written, else QGIS makes it of the heights. No layer is seen at first, as they would hide the
    mosaic."""
    surface, terrain, confidence = (
        folder / f"{name}.tif" for name in ("surface", "terrain", "surface_confidence")
    )
    shown = []
    if surface.is_file():
        shown += [_shading(surface), _coloured(surface, "Surface", 1, _HEIGHTS)]
    if terrain.is_file():
        shown.append(_coloured(terrain, "Ground below what stands", 1, _HEIGHTS))
    if confidence.is_file():
        shown.append(_coloured(confidence, "Deviation of the surface", 1, _DOUBT))
        shown.append(_coloured(confidence, "Frames that agree", 2, _DOUBT[::-1], id="surface_views"))
    return shown


def _shading(surface: Path) -> ProjectLayer:
    """Light and shadow over whatever is seen below it."""
    written = surface.with_name(HILLSHADE)
    if written.is_file():
        surface, how = written, {"type": "singlebandgray", "grayBand": "1", "gradient": "BlackToWhite"}
    else:
        how = {"type": "hillshade", "azimuth": "315", "angle": "45", "zfactor": "1", "multidirection": "0"}
    renderer = Element("rasterrenderer", band="1", alphaBand="-1", opacity="1", attrib=how)
    with open_raster(surface, OWN) as tiff:
        crs = tiff.crs.to_wkt()
    blend = Element("blendMode")
    blend.text = _MULTIPLY
    shading = _raster(surface, "Shading", crs, renderer, (blend,))
    return replace(shading, checked=False, name="surface_shading")


def _coloured(path: Path, title: str, band: int, colours: Sequence[str], id: str = "") -> ProjectLayer:
    """A band's values in colours, from two deviations below the mean to two above."""
    with open_raster(path, OWN) as tiff:
        low, high = _stretch(tiff.tags(band)) or (0.0, 1.0)
        crs, unit = tiff.crs.to_wkt(), tiff.units[band - 1] or ""
        heights = tiff.tags().get("HEIGHTS", "")
    renderer = _pseudocolour(band, (low, high), colours, unit)
    abstract = f"Heights are {heights}." if heights and colours is _HEIGHTS else ""
    layer = _raster(path, title, crs, renderer)
    return replace(layer, checked=False, name=id or layer.name, abstract=abstract)


def _pseudocolour(band: int, ends: tuple[float, float], colours: Sequence[str], unit: str) -> Element:
    """A band's values in colours between two ends."""
    low, high = ends
    renderer = Element(
        "rasterrenderer", type="singlebandpseudocolor", band=f"{band}", alphaBand="-1", opacity="1",
        classificationMin=f"{low:.10g}", classificationMax=f"{high:.10g}",
    )  # fmt: skip
    shader = SubElement(
        SubElement(renderer, "rastershader"), "colorrampshader", colorRampType="INTERPOLATED",
        classificationMode="2", clip="0", minimumValue=f"{low:.10g}", maximumValue=f"{high:.10g}",
    )  # fmt: skip
    for k, colour in enumerate(colours):
        value = low + (high - low) * k / (len(colours) - 1)
        SubElement(
            shader,
            "item",
            value=f"{value:.10g}",
            label=f"{value:.4g} {unit}".strip(),
            color=colour,
            alpha="255",
        )
    return renderer


def index_layers(folder: Path) -> list[ProjectLayer]:
    """Those of the indices that were made of a run's mosaic."""
    paths = sorted(folder.glob("index_*.tif"))
    return [_coloured(path, path.stem.removeprefix("index_"), 1, index_colours(path)) for path in paths]


def index_colours(path: Path) -> Sequence[str]:
    """Those of an index, or of temperatures."""
    with open_raster(path, OWN) as raster:
        return _HEAT if raster.units[0] else _LEAVES


def index_style(path: Path, ends: tuple[float, float]) -> str:
    """An index's colours between two ends as a style file of QGIS (QML)."""
    with open_raster(path, OWN) as raster:
        unit = raster.units[0] or ""
    document = Element("qgis", version=VERSION, styleCategories="Symbology")
    SubElement(document, "pipe").append(_pseudocolour(1, ends, index_colours(path), unit))
    return tostring(document, "unicode")


def _raster(
    path: Path,
    title: str,
    crs: str,
    renderer: Element,
    siblings: tuple[Element, ...] = (),
) -> ProjectLayer:
    """A layer that is shown at first, called by the file's name."""
    pipe = Element("pipe")
    pipe.append(renderer)
    SubElement(pipe, "rasterresampler", maxOversampling="2", zoomedOutResampler="bilinear")
    return ProjectLayer(path.stem, title, f"./{path.name}", False, crs, (pipe, *siblings), True)
