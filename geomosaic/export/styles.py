"""How QGIS shows layers, in its own XML (QML), as `layer_styles` of a GeoPackage and a project hold it.

Only what differs from QGIS' defaults is said. Names and values are those of its symbol layers' properties
(QgsSimpleFillSymbolLayer and its like); every file is read back by a real QGIS in `make check-qgis`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final
from xml.etree.ElementTree import Element, SubElement, tostring

VERSION: Final = "3.22.0"
PLACES: Final = {"around": "6", "on": "1", "along": "3"}
"""Of labels: next to a point, on a polygon, along a line, by QGIS' numbers."""
_WHITE: Final = "255,255,255,255"
_DARK: Final = "30,30,30,255"


@dataclass(frozen=True)
class Style:
    """A layer's renderer, its labels if it has any, and a word on it for people."""

    renderer: Element
    labels: Element | None = None
    text: str = ""


@dataclass(frozen=True)
class Symbol:
    """A marker, line or fill of one or more symbol layers: each a class and its properties; `inner` is the
    symbol that the first one draws with."""

    kind: str
    layers: tuple[tuple[str, Mapping[str, Any]], ...]
    inner: Symbol | None = None

    def element(self, name: str) -> Element:
        """As XML; `name` is the one by which a renderer calls it."""
        symbol = Element("symbol", type=self.kind, name=name, alpha="1", clip_to_extent="1", force_rhr="0")
        for k, (kind, properties) in enumerate(self.layers):
            layer = SubElement(symbol, "layer", {"class": kind, "enabled": "1", "pass": "0", "locked": "0"})
            options = SubElement(layer, "Option", type="Map")
            for key, value in properties.items():
                SubElement(options, "Option", type="QString", name=key, value=str(value))
            if self.inner is not None and k == 0:
                layer.append(self.inner.element(f"@{name}@{k}"))
        return symbol


def outline(color: str, width_mm: float = 0.3, dashes: str = "solid") -> Symbol:
    """Of polygons: nothing inside, so that what lies below is seen."""
    properties = {"style": "no", "outline_color": color, "outline_width": width_mm, "outline_style": dashes}
    return Symbol("fill", (("SimpleFill", {**properties, "outline_width_unit": "MM"}),))


def line(color: str, width_mm: float = 0.3) -> Symbol:
    """A plain line."""
    properties = {"line_color": color, "line_width": width_mm, "line_width_unit": "MM", "capstyle": "round"}
    return Symbol("line", (("SimpleLine", properties),))


def marker(shape: str, color: str, size_mm: float = 2.2) -> Symbol:
    """A filled marker with a white rim, or a cross."""
    rim = color if shape.startswith("cross") else _WHITE
    properties = {"name": shape, "color": color, "outline_color": rim, "outline_width": 0.3}
    return Symbol("marker", (("SimpleMarker", {**properties, "size": size_mm, "size_unit": "MM"}),))


def arrow(color: str, width_mm: float = 0.35) -> Symbol:
    """A line with a head at its end."""
    fill = Symbol("fill", (("SimpleFill", {"color": color, "outline_style": "no", "style": "solid"}),))
    properties = {
        "arrow_width": width_mm, "arrow_start_width": width_mm, "head_length": 3.5 * width_mm,
        "head_thickness": 2.2 * width_mm, "arrow_type": 0, "head_type": 0, "is_curved": 0, "is_repeated": 0,
    }  # fmt: skip
    return Symbol("line", (("ArrowLine", properties),), fill)


def larger_arrow(color: str, width_mm: float, scale: float, *, to_end: bool = False) -> Symbol:
    """An arrow so many times as long as the layer's line, from where that begins, or to where it ends."""
    if scale == 1.0:
        return arrow(color, width_mm)
    fixed, other = ("end", "start") if to_end else ("start", "end")
    away = ", ".join(
        f"{axis}({fixed}_point($geometry)) + {scale:g} * "
        f"({axis}({other}_point($geometry)) - {axis}({fixed}_point($geometry)))"
        for axis in "xy"
    )
    ends = [f"{fixed}_point($geometry)", f"make_point({away})"]
    drawn = f"make_line({', '.join(reversed(ends) if to_end else ends)})"
    properties = {"SymbolType": "Line", "geometryModifier": drawn, "units": "MapUnit"}
    return Symbol("line", (("GeometryGenerator", properties),), arrow(color, width_mm))


def single(symbol: Symbol) -> Element:
    """All features alike."""
    renderer = Element("renderer-v2", type="singleSymbol", forceraster="0", symbollevels="0")
    SubElement(renderer, "symbols").append(symbol.element("0"))
    return renderer


def categories(expression: str, symbols: Mapping[str, tuple[str, Symbol]]) -> Element:
    """By a text: each value's label and symbol."""
    renderer = Element(
        "renderer-v2", type="categorizedSymbol", attr=expression, forceraster="0", symbollevels="0"
    )
    listed, drawn = SubElement(renderer, "categories"), SubElement(renderer, "symbols")
    for k, (value, (label, symbol)) in enumerate(symbols.items()):
        SubElement(listed, "category", symbol=f"{k}", value=value, label=label, render="true", type="string")
        drawn.append(symbol.element(f"{k}"))
    return renderer


def ranges(expression: str, symbols: Sequence[tuple[float, float, str, Symbol]]) -> Element:
    """By a number: from, up to, label and symbol of each range; those without a number aren't drawn."""
    renderer = Element(
        "renderer-v2", type="graduatedSymbol", attr=expression, graduatedMethod="GraduatedColor",
        forceraster="0", symbollevels="0",
    )  # fmt: skip
    listed, drawn = SubElement(renderer, "ranges"), SubElement(renderer, "symbols")
    for k, (lower, upper, label, symbol) in enumerate(symbols):
        SubElement(
            listed, "range", symbol=f"{k}", lower=f"{lower:g}", upper=f"{upper:g}", label=label, render="true"
        )
        drawn.append(symbol.element(f"{k}"))
    return renderer


def labels(expression: str, place: str = "around") -> Element:
    """A text in one of `PLACES`, dark on a white rim, where there is room for it."""
    labeling = Element("labeling", type="simple")
    settings = SubElement(labeling, "settings", calloutType="simple")
    style = SubElement(
        settings, "text-style", fieldName=expression, isExpression="1", fontFamily="Open Sans",
        fontSize="8", fontSizeUnit="Point", fontWeight="50", textColor=_DARK, textOpacity="1",
    )  # fmt: skip
    SubElement(
        style, "text-buffer", bufferDraw="1", bufferSize="0.8", bufferSizeUnits="MM", bufferColor=_WHITE,
        bufferOpacity="0.85", bufferNoFill="1",
    )  # fmt: skip
    placed = SubElement(
        settings, "placement", placement=PLACES[place], predefinedPositionOrder="BR,TR,BL,TL",
        dist="2", distUnits="MM", offsetType="1",
    )  # fmt: skip
    if place == "along":
        placed.attrib |= {"dist": "0", "placementFlags": "1"}
    SubElement(settings, "rendering", drawLabels="1", obstacle="0", displayAll="0", scaleVisibility="0")
    return labeling


def qml(style: Style) -> str:
    """A style's own document."""
    labelled = "0" if style.labels is None else "1"
    document = Element("qgis", version=VERSION, styleCategories="Symbology|Labeling", labelsEnabled=labelled)
    document.extend(parts(style))
    return "<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>\n" + tostring(document, "unicode")


def parts(style: Style) -> list[Element]:
    """What stands in such a document, and as well in a project's layer."""
    return [style.renderer, *([] if style.labels is None else [style.labels])]
