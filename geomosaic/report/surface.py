"""What the report shows of a matched surface: shading, a profile to draw, figures, how it compares."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
from rasterio.enums import Resampling

from geomosaic.arrays import Bytes, Floats32
from geomosaic.doors.raster import OWN, open_raster, reading
from geomosaic.quality.heights import HeightFigures
from geomosaic.quality.surface import SurfaceComparison
from geomosaic.report.glance import data_uri
from geomosaic.report.numbers import percent, short, signed

_PICTURE_PX: Final = 900
_PROFILE_PX: Final = 380
_INDEX_PX: Final = 1600
_LEVELS: Final = 65534
"""Of the heights that a page holds in 16 bits; the next one stands for what is unknown."""
_LEAST_STEP_M: Final = 0.01
_SUN: Final = np.array([-1.0, 1.0, np.sqrt(2.0)]) / 2.0
"""Towards the sun of shadings: north-west, 45 degrees high."""
_DARK: Final = 0.35
_SCALE_PX: Final = 36
_LEAST_SCALE_PX: Final = 320

Row = tuple[str, str, str]
"""Name, value, what it says."""


@dataclass(frozen=True)
class Profile:
    """Heights as a page has them: a grid of cols x rows, pixel_m apart, north up.

    surface, terrain: a number for each height in 16 bits, little end first, in base64. The height is low_m +
    step_m times the number, unknown where that is the highest number.
    """

    cols: int
    rows: int
    pixel_m: float
    low_m: float
    step_m: float
    surface: str
    terrain: str


@dataclass(frozen=True)
class SurfaceSection:
    """All of it; uri: the shading, box_m: its west, south, east, north; low_m and high_m the ends of its
    colours; compared: rows of figures by class, off_uri the difference between -off_m and off_m, both empty
    without a reference."""

    uri: str
    box_m: tuple[float, float, float, float]
    low_m: float
    high_m: float
    rows: list[Row]
    profile: Profile
    reference: str
    datum: str
    compared: list[tuple[str, list[tuple[str, HeightFigures]]]]
    fit: str
    off_uri: str
    off_m: float


def surface_section(
    surface: Path,
    confidence: Path,
    terrain: Path,
    summary: Mapping[str, Any],
    comparison: SurfaceComparison | None,
) -> SurfaceSection:
    """Of the run's surface.tif, surface_confidence.tif and terrain.tif, read at reduced size."""
    heights, pixel_m = _reduced(surface, 1, _PICTURE_PX)
    known = heights[np.isfinite(heights)]
    low, high = np.percentile(known, [1.0, 99.0]).tolist() if known.size else (0.0, 1.0)
    off_m = 0.0 if comparison is None else reach_m(comparison.difference_m)
    return SurfaceSection(
        data_uri("webp", shaded(heights, pixel_m, low, high), [cv2.IMWRITE_WEBP_QUALITY, 85]),
        _box_m(surface),
        low,
        high,
        [*_figures(confidence, summary.get("metrics", {}), known), *_ortho(summary.get("metrics", {}))],
        _profile(surface, terrain),
        comparison.reference if comparison else "",
        comparison.datum if comparison else "",
        _compared(comparison) if comparison else [],
        _fit(comparison) if comparison else "",
        data_uri("png", coloured(comparison.difference_m, off_m)) if comparison else "",
        off_m,
    )


def _box_m(path: Path) -> tuple[float, float, float, float]:
    with open_raster(path, OWN) as raster:
        west, south, east, north = map(float, raster.bounds)
    return west, south, east, north


def _reduced(
    path: Path, band: int, most_px: int, resampling: Resampling = Resampling.average
) -> tuple[Floats32, float]:
    """A band (rows, cols) at a reduced size, NaN where it is unknown, and the side of its pixels in m."""
    with open_raster(path, OWN) as raster, reading(path, OWN.problem, OWN.fix):
        scale = max(1.0, max(raster.shape) / most_px)
        shape = max(1, round(raster.height / scale)), max(1, round(raster.width / scale))
        values = raster.read(band, out_shape=shape, resampling=resampling, masked=True)
        pixel_m = raster.transform.a * raster.width / shape[1]
    return np.asarray(values.astype(np.float32).filled(np.nan)), pixel_m


def shaded(heights: Floats32, pixel_m: float, low: float, high: float) -> Bytes:
    """Heights (rows, cols) lit from the north-west: blue, green, red and opacity, 0 where unknown."""
    known = np.isfinite(heights)
    whole = np.where(known, heights, np.float32(low))
    south, east = np.gradient(whole, pixel_m) if min(whole.shape) > 1 else (np.zeros_like(whole),) * 2
    light = (-east * _SUN[0] + south * _SUN[1] + _SUN[2]) / np.sqrt(1.0 + east**2 + south**2)
    level = np.clip((whole - low) / max(high - low, 1e-6), 0.0, 1.0) * 255.0
    colours = cv2.applyColorMap(level.astype(np.uint8), cv2.COLORMAP_CIVIDIS)
    shade = _DARK + (1.0 - _DARK) * np.clip(light / _SUN[2], 0.0, 1.3) / 1.3
    drawn = np.dstack([np.clip(colours * (1.3 * shade[..., None]), 0, 255), np.where(known, 255, 0)])
    return drawn.astype(np.uint8)


def _profile(surface: Path, terrain: Path) -> Profile:
    top, pixel_m = _reduced(surface, 1, _PROFILE_PX)
    ground, _ = _reduced(terrain, 1, _PROFILE_PX)
    known = np.concatenate([v[np.isfinite(v)] for v in (top, ground)])
    low, high = (float(known.min()), float(known.max())) if known.size else (0.0, 1.0)
    step = max(_LEAST_STEP_M, (high - low) / _LEVELS)

    def packed(values: Floats32) -> str:
        levels = np.where(np.isfinite(values), np.round((values - low) / step), _LEVELS + 1)
        return base64.b64encode(levels.astype("<u2").tobytes()).decode("ascii")

    return Profile(top.shape[1], top.shape[0], pixel_m, low, step, packed(top), packed(ground))


def _figures(confidence: Path, metrics: Mapping[str, Any], heights: Floats32) -> list[Row]:
    written = metrics.get("surface", {})
    views, _ = _reduced(confidence, 2, _PICTURE_PX, Resampling.nearest)
    sd, _ = _reduced(confidence, 1, _PICTURE_PX, Resampling.nearest)
    sd, seen = sd[np.isfinite(sd)], views[np.isfinite(views)]
    rows: list[Row] = []
    if heights.size:
        ends = f"{short(float(heights.min()), digits=4)} to {short(float(heights.max()), 'm', 4)}"
        rows.append(("heights", ends, str(written.get("heights", ""))))
    if "cell_m" in written:
        pixel = f"written in pixels of {short(written.get('pixel_m'), 'm')}"
        rows.append(("cells", short(written["cell_m"], "m"), pixel))
    if seen.size:
        matched = percent(float(np.mean(seen > 0.0)))
        rows.append(
            (
                "matched",
                matched,
                "of what surface.tif holds; the rest is filled from what lies around, or from tie points",
            )
        )
    if sd.size:
        middle, most = np.quantile(sd, [0.5, 0.9]).tolist()
        text = f"median {short(middle, 'm')}, 90 % below {short(most, 'm')}"
        rows.append(("deviation", text, "as matching states it; surface_confidence.tif has it by place"))
    if "ground_share" in written:
        ground = percent(written["ground_share"])
        rows.append(
            ("ground", ground, "of the matched cells show the ground; terrain.tif goes on beneath the rest")
        )
    return rows


def _ortho(metrics: Mapping[str, Any]) -> list[Row]:
    """What the mosaic stands on, and why, where the run says it."""
    chosen = metrics.get("ortho", {})
    ground = chosen.get("ground", chosen.get("laid_on"))  # the second key is of earlier versions
    if ground is None:
        return []
    found, why = chosen.get("disagreement"), "as was asked for"
    if found is not None:
        each = " and ".join(f"{short(off)} on the {name}" for name, off in found.items())
        why = f"1 - correlation of neighbouring frames is {each}, median over {chosen.get('places')} places"
    return [("the mosaic stands on", f"the {ground}", why)]


def _compared(comparison: SurfaceComparison) -> list[tuple[str, list[tuple[str, HeightFigures]]]]:
    whole = [("all", comparison.over_all), ("after the best shift and tilt", comparison.after_fit)]
    parts = (
        ("", whole),
        ("by support", list(comparison.by_support)),
        ("by slope of the surface", list(comparison.by_slope)),
        ("by the reference's class", list(comparison.by_kind)),
    )
    return [(title, rows) for title, rows in parts if len(rows) > 1 or not title]


def _fit(comparison: SurfaceComparison) -> str:
    f = comparison.fit
    if not np.isfinite(f.up_m):
        return ""
    tilt = 1000.0 * float(np.hypot(f.tilt_east, f.tilt_north))
    return (
        f"{signed(f.east_m, 'm')} east, {signed(f.north_m, 'm')} north, {signed(f.up_m, 'm')} up, and a "
        f"tilt of {short(tilt, 'm')} per km would lay the reference on the surface best"
    )


def reach_m(difference: Floats32) -> float:
    """The end of the difference's colours: 95 % are nearer to 0."""
    known = np.abs(difference[np.isfinite(difference)])
    return max(float(np.quantile(known, 0.95)), _LEAST_STEP_M) if known.size else 1.0


def coloured(difference: Floats32, reach_m: float) -> Bytes:
    """Differences (rows, cols) in blue, green, red, alpha: blue where the surface is lower, white alike, red
    higher, full colours from reach_m on."""
    known = np.isfinite(difference)
    share = np.clip(np.where(known, difference, 0.0) / reach_m, -1.0, 1.0)
    fade = 1.0 - np.abs(share)
    high, low = np.array([33.0, 38.0, 178.0]), np.array([172.0, 102.0, 33.0])
    end = np.where(share[..., None] > 0.0, high, low)
    colours = fade[..., None] * 247.0 + (1.0 - fade[..., None]) * end
    return np.dstack([colours, np.where(known, 255, 0)]).astype(np.uint8)


def difference_picture(difference: Floats32) -> Bytes:
    """The same as a picture of its own, with the colours' scale below. White is the median: what all of it is
    off by would cover the rest."""
    known = difference[np.isfinite(difference)]
    median_m = np.float32(np.median(known) if known.size else 0.0)
    ends_m = reach_m(difference - median_m)
    drawn = coloured(difference - median_m, ends_m)
    bar = coloured(np.linspace(-ends_m, ends_m, 256, dtype=np.float32)[None], ends_m)
    ends = (median_m - ends_m, median_m, median_m + ends_m)
    return with_legend(drawn, bar, [f"{value:+.3g} m" for value in ends])


def with_legend(drawn: Bytes, bar: Bytes, labels: Sequence[str]) -> Bytes:
    """A picture (rows, cols, 4) with its colours below, (1, n, 4), and three texts below these."""
    cols = max(drawn.shape[1], _LEAST_SCALE_PX)
    drawn = np.pad(drawn, ((0, 0), (0, cols - drawn.shape[1]), (0, 0)))
    scale = np.full((_SCALE_PX, cols, 4), 255, dtype=np.uint8)
    scale[: _SCALE_PX // 3] = cv2.resize(bar, (cols, 1), interpolation=cv2.INTER_LINEAR)
    font, size = cv2.FONT_HERSHEY_SIMPLEX, 0.4
    for text, share in zip(labels, (0.0, 0.5, 1.0), strict=True):
        (width, _), _ = cv2.getTextSize(text, font, size, 1)
        at = round(share * (cols - width - 8)) + 4, _SCALE_PX - 8
        cv2.putText(scale, text, at, font, size, (0, 0, 0, 255), 1, cv2.LINE_AA)
    return np.vstack([drawn, scale])


def in_colours(values: Floats32, ends: tuple[float, float], colours: Sequence[str]) -> Bytes:
    """Values (rows, cols) in blue, green, red, alpha, by colours such as #1a9641 evenly between two ends."""
    stops = np.array([[int(c[k : k + 2], 16) for k in (5, 3, 1)] for c in colours], dtype=np.float64)
    at = np.nan_to_num((values - ends[0]) / (ends[1] - ends[0])) * (len(stops) - 1)
    bgr = [np.interp(at, range(len(stops)), stops[:, k]) for k in range(3)]
    return np.dstack([*bgr, np.where(np.isfinite(values), 255.0, 0.0)]).astype(np.uint8)


def index_picture(index: Path, ends: tuple[float, float], colours: Sequence[str]) -> Bytes:
    """An index's raster in colours between two ends, as blue, green, red, alpha, with the legend below."""
    values, _ = _reduced(index, 1, _INDEX_PX)
    bar = in_colours(np.linspace(*ends, 256, dtype=np.float32)[None], ends, colours)
    with open_raster(index, OWN) as raster:
        unit = raster.units[0] or ""
        name = f"{raster.descriptions[0]} of {raster.tags()['VALUES']}"
    low, high = (f"{end:.3g} {unit}" for end in ends)
    return with_legend(in_colours(values, ends, colours), bar, [low, name, high])
