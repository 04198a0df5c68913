"""What each layer of layers.gpkg looks like in a GIS: thin lines over the mosaic, arrows for what moved."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Final

from geomosaic.export.styles import (
    Style,
    Symbol,
    categories,
    labels,
    larger_arrow,
    line,
    marker,
    outline,
    ranges,
    single,
)

_GREEN: Final = "40,160,60,255"
_AMBER: Final = "245,160,20,255"
_RED: Final = "215,30,40,255"
_BLUE: Final = "40,90,220,255"
_GREY: Final = "130,130,130,255"
_SAND: Final = "250,205,150,255"
_CYAN: Final = "0,200,230,170"
_YELLOW: Final = "255,225,0,230"
_MAGENTA: Final = "215,0,160,255"
_ORANGE: Final = "255,120,0,220"
_RESIDUALS: Final = (
    (0.0, 0.5, "up to 0.5 px", "70,180,90,255"),
    (0.5, 1.0, "0.5 to 1 px", "190,205,40,255"),
    (1.0, 2.0, "1 to 2 px", "250,160,20,255"),
    (2.0, 1e9, "more than 2 px", "215,30,40,255"),
)
_NAME: Final = "regexp_replace(\"frame\", '\\\\.[^.]*$', '')"
"""A frame's name without its file's ending, as QGIS computes it."""


def _by_residual(symbol: Callable[[str], Symbol]) -> list[tuple[float, float, str, Symbol]]:
    return [(low, high, label, symbol(color)) for low, high, label, color in _RESIDUALS]


def _times(scale: float) -> str:
    return "true to scale" if scale == 1.0 else f"{scale:,.0f} times larger"


def frames() -> Style:
    states = {"tied": _GREEN, "placed": _AMBER, "rejected": _RED}
    symbols = {state: (state, marker("circle", color)) for state, color in states.items()}
    return Style(categories('"status"', symbols), labels(_NAME), "By status, with the frames' names")


def contours() -> Style:
    return Style(single(line(_SAND, 0.35)), labels("round(\"height_m\", 2) || ' m'", "along"))


def footprints() -> Style:
    return Style(single(outline(_CYAN, 0.2)), text="Outlines, the mosaic is seen through them")


def nadir_points() -> Style:
    return Style(single(marker("cross2", _MAGENTA, 1.8)), text="Ground below the given positions")


def moves(scale: float) -> Style:
    text = f"Arrows from given to adjusted positions, {_times(scale)}"
    return Style(single(larger_arrow(_MAGENTA, 0.45, scale)), text=text)


def error_ellipses(scale: float) -> Style:
    return Style(single(outline(_ORANGE, 0.3)), text=f"1 sigma, {_times(scale)}")


def tie_points() -> Style:
    symbols = _by_residual(partial(marker, "circle", size_mm=1.2))
    return Style(ranges('"residual_px"', symbols), text="By residual")


def residuals(scale: float) -> Style:
    text = f"From left to right frame's place, {_times(scale)}"
    symbols = _by_residual(partial(larger_arrow, width_mm=0.2, scale=scale))
    return Style(ranges('"residual_px"', symbols), text=text)


def control() -> Style:
    kinds = {"control": ("triangle", _RED), "check": ("square", _BLUE)}
    symbols = {kind: (f"{kind} point", marker(shape, color, 2.8)) for kind, (shape, color) in kinds.items()}
    return Style(categories('"kind"', symbols), labels('"name"'), "Surveyed points, with names")


def control_residuals(scale: float) -> Style:
    kinds = {"control": _RED, "check": _BLUE}
    symbols = {
        kind: (f"{kind} point", larger_arrow(color, 0.45, scale, to_end=True))
        for kind, color in kinds.items()
    }
    text = f"From where the images put points to where they were surveyed, {_times(scale)}"
    return Style(categories('"kind"', symbols), text=text)


def seamlines() -> Style:
    return Style(single(outline(_YELLOW, 0.4)), text="Each frame's part of the mosaic")


def trimmed() -> Style:
    return Style(single(outline(_GREY, 0.4)), text="Trimmed")


def scene() -> Style:
    return Style(single(outline(_YELLOW, 0.5)), text="The scene's outline")


def ccd_strips() -> Style:
    text = "What each CCD saw, numbered from the left"
    return Style(single(outline(_CYAN, 0.35)), labels('"ccd"', "on"), text)


def seam_segments() -> Style:
    expression = (
        "case when \"misplacement_px\" is null then 'unknown' when \"misplacement_px\" <= 0.5 then 'good' "
        "when \"misplacement_px\" <= 1 then 'fair' else 'bad' end"
    )
    found = {
        "good": ("up to 0.5 px", line(_GREEN, 0.8)),
        "fair": ("0.5 to 1 px", line(_AMBER, 0.8)),
        "bad": ("more than 1 px", line(_RED, 1.0)),
        "unknown": ("not checked", line(_GREY, 0.5)),
    }
    return Style(categories(expression, found), text="Misplacement of each segment")
