"""`geomosaic measure`: lengths, areas and volumes on a run's map, with their standard deviations."""

from __future__ import annotations

import json
from collections.abc import Sequence
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from geomosaic.cli.options import AsJson
from geomosaic.errors import InputError

if TYPE_CHECKING:
    from geomosaic.quality.measured import Figure
    from geomosaic.quality.run_measures import MeasuredPolygon


def measure(
    run: Annotated[Path, typer.Argument(help="folder of a finished run", metavar="RUN")],
    line: Annotated[
        Path | None, typer.Option(help="lines to measure (GeoJSON, GeoPackage, ...)", metavar="FILE")
    ] = None,
    polygon: Annotated[
        Path | None, typer.Option(help="polygons to measure (GeoJSON, GeoPackage, ...)", metavar="FILE")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Measure lengths, areas and volumes on a run's map.

    Each figure has its standard deviation.

    Volumes are those above and below the plane through a polygon's rim; the run needs a surface for them.
    """
    from geomosaic.doors.vector import LINE, POLYGON, read_shapes
    from geomosaic.quality.run_measures import ASSUMED, measure_lines, measure_polygons
    from geomosaic.viewer.run_view import run_rasters

    if line is None and polygon is None:
        raise InputError("there is nothing to measure", fix="give --line FILE or --polygon FILE")
    rasters = run_rasters(run)
    found: dict[str, Any] = {"run": str(run)}
    if line is not None:
        found["crs"], lines = measure_lines(rasters, read_shapes(line, LINE), line)
        found["lines"] = [{"line": k, **_figure("length", "m", of)} for k, of in enumerate(lines, start=1)]
    if polygon is not None:
        found["crs"], polygons = measure_polygons(rasters, read_shapes(polygon, POLYGON), polygon)
        found["polygons"] = [_polygon(number, of) for number, of in enumerate(polygons, start=1)]
    found["assumed"] = ASSUMED
    if as_json:
        print(json.dumps(found, indent=2))
        return
    for name in ("lines", "polygons"):
        if name in found:
            _show(found[name])
    print(f"On the map ({found['crs']}), 1 sigma; {ASSUMED}.")


def _polygon(number: int, of: MeasuredPolygon) -> dict[str, Any]:
    volume = of.volume
    figures = {
        "volume_above_m3": None if volume is None else _known(volume.above),
        "volume_below_m3": None if volume is None else _known(volume.below),
        "volume_sd_m3": None if volume is None else _known(volume.sd),
    }
    return {"polygon": number, **_figure("area", "m2", of.area), **figures}


def _figure(name: str, unit: str, of: Figure) -> dict[str, Any]:
    """ellipsoidal: only where it differs from the map."""
    other = {} if of.ellipsoidal is None else {f"{name}_ellipsoidal_{unit}": _known(of.ellipsoidal)}
    return {f"{name}_{unit}": _known(of.value), f"{name}_sd_{unit}": _known(of.sd), **other}


def _known(value: float) -> float | None:
    return value if isfinite(value) else None


def _show(rows: Sequence[dict[str, Any]]) -> None:
    """A table; columns without any value are left out."""
    every = dict.fromkeys(name for row in rows for name in row)
    names = [name for name in every if any(row.get(name) is not None for row in rows)]
    cells = [names, *([_text(row.get(name)) for name in names] for row in rows)]
    widths = [max(len(line[k]) for line in cells) for k in range(len(names))]
    for cell in cells:
        print("  ".join(text.rjust(width) for text, width in zip(cell, widths, strict=True)))


def _text(value: float | None) -> str:
    return "unknown" if value is None else f"{value:d}" if isinstance(value, int) else f"{value:,.3f}"
