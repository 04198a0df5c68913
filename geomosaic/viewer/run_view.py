"""A finished run as it is shown: its layers on the pixels of a map, and what it can be measured by."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from geomosaic.errors import FileError, InputError
from geomosaic.export.web import on_map
from geomosaic.geodesy.mapcrs import check_on_earth
from geomosaic.pipeline.files import path_within
from geomosaic.pipeline.run_results import read_summary
from geomosaic.quality.run_measures import RunRasters
from geomosaic.viewer.grid_raster import ViewGrid
from geomosaic.viewer.map_features import map_features
from geomosaic.viewer.tile_layers import (
    AccuracyLayer,
    Colours,
    IndexLayer,
    MosaicLayer,
    SurfaceLayer,
    TileLayer,
    accuracy_colours,
    surface_colours,
)

MOSAIC: Final = "mosaic"
SURFACE: Final = "surface"
ACCURACY: Final = "accuracy"


@dataclass(frozen=True)
class RunView:
    """A run on a grid. features: its vector layers; rasters: to measure by, None where `unmeasured` says why
    not."""

    folder: Path
    grid: ViewGrid
    layers: dict[str, TileLayer]
    features: list[dict[str, Any]]
    rasters: RunRasters | None
    unmeasured: str


def run_rasters(run: Path) -> RunRasters:
    """The rasters that a run is measured by. Raises: `FileError` for no finished run, or one without them."""
    summary = read_summary(run)
    accuracy, surface, confidence = (
        path_within(run, name) for name in ("accuracy.tif", "surface.tif", "surface_confidence.tif")
    )
    if not accuracy.is_file():
        fix = "make the mosaic again: geomosaic mosaic writes accuracy.tif"
        raise FileError("the run has no accuracy.tif", file=run, fix=fix)
    matched = surface.is_file() and confidence.is_file()
    return RunRasters(accuracy, summary, *((surface, confidence) if matched else (None, None)))


def run_views(run: Path, other: Path | None = None) -> list[RunView]:
    """A run, and another one on the first one's pixels.

    Raises: `FileError` for what is no finished run or has no mosaic; `InputError` where two are not on the
    Earth, or do not overlap.
    """
    grid = ViewGrid.of(_mosaic(run))
    ends = _common_ends([run] if other is None else [run, other])
    views = [_view(run, grid, ends)]
    if other is not None:
        for folder, at in ((run, grid), (other, ViewGrid.of(_mosaic(other)))):
            if not at.crs:
                fix = "put it on a map first: geomosaic export map RUN"
                raise InputError("has no map projection, and cannot be compared", file=folder, fix=fix)
            check_on_earth(at.crs, "comparison")
        views.append(_view(other, grid, ends))
    return views


def _mosaic(run: Path) -> Path:
    read_summary(run)
    mosaic = path_within(run, "mosaic.tif")
    if not mosaic.is_file():
        raise FileError("the run has no mosaic.tif", file=run, fix="run the recipe again")
    return on_map(mosaic)


def _common_ends(runs: Sequence[Path]) -> dict[str, Colours]:
    """Of the surface and of the accuracy: one colour means one value in all runs."""
    found: dict[str, Colours] = {}
    for name, ends_of in ((SURFACE, surface_colours), (ACCURACY, accuracy_colours)):
        files = (path_within(run, f"{name}.tif") for run in runs)
        each = [ends for file in files if file.is_file() and (ends := ends_of(file)) is not None]
        if each:
            found[name] = Colours(min(e.low for e in each), max(e.high for e in each))
    return found


def _view(run: Path, grid: ViewGrid, ends: Mapping[str, Colours]) -> RunView:
    layers: dict[str, TileLayer] = {MOSAIC: MosaicLayer(_mosaic(run), grid)}
    surface, accuracy, package = (
        path_within(run, name) for name in ("surface.tif", "accuracy.tif", "layers.gpkg")
    )
    if surface.is_file() and SURFACE in ends:
        layers[SURFACE] = SurfaceLayer(surface, grid, ends[SURFACE])
    if accuracy.is_file() and ACCURACY in ends:
        layers[ACCURACY] = AccuracyLayer(accuracy, grid, ends[ACCURACY])
    for path in sorted(run.glob("index_*.tif")):
        layers[path.stem] = IndexLayer(path_within(run, path.name), grid)
    features = map_features(package, grid) if package.is_file() else []
    try:
        rasters, unmeasured = run_rasters(run), ""
    except FileError as error:
        rasters, unmeasured = None, str(error)
    return RunView(run, grid, layers, features, rasters, unmeasured)
