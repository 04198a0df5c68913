"""The finished mosaic for other programs: a VRT, web map tiles, KMZ."""

from __future__ import annotations

import errno
import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from osgeo import gdal

from geomosaic.doors.gdal_failures import GdalProgress, Progress, close, gdal_failures
from geomosaic.doors.raster import OWN, open_raster, open_with_osgeo
from geomosaic.doors.scratch import scratch_folder
from geomosaic.errors import InputError
from geomosaic.export.shown_bands import shown_bands
from geomosaic.export.tile_page import write_tile_page
from geomosaic.export.tile_pyramid import EQUATOR_M, TILE_PX, TilePyramid, write_pyramid
from geomosaic.geodesy.antimeridian import Bounds, geographic_bounds, within_the_map, wrapped
from geomosaic.geodesy.mapcrs import check_on_earth

SCENE_MAP: Final = "mosaic_map.tif"
_EARTH_RADIUS_M = EQUATOR_M / (2.0 * math.pi)
_FURTHEST_DEG = math.degrees(math.atan(math.sinh(math.pi)))
"""Latitude at which Web Mercator's square ends."""


def on_map(mosaic_file: Path) -> Path:
    """A mosaic, or for a scene of strips its version that was projected onto a map, if there is one."""
    scene_map = mosaic_file.with_name(SCENE_MAP)
    if not scene_map.is_file():
        return mosaic_file
    with open_raster(mosaic_file, OWN) as tiff:
        return scene_map if tiff.crs is None else mosaic_file


def write_vrt(mosaic_file: Path, out: Path) -> None:
    """A VRT next to the mosaic that names it by its relative path and shows its mask as an alpha band."""
    with gdal_failures(out):
        source = open_with_osgeo(mosaic_file, OWN)
        bands = [*range(1, source.RasterCount + 1), "mask"]
        done = gdal.Translate(str(out), source, format="VRT", bandList=bands, maskBand="none")
        done.GetRasterBand(len(bands)).SetColorInterpretation(gdal.GCI_AlphaBand)
        del done, source


@dataclass(frozen=True)
class TileOptions:
    """How tiles are written: one of FORMATS; the coarsest and the finest zoom, None: as `write_tiles` says;
    threads: at work."""

    tile_format: str = "png"
    min_zoom: int | None = None
    max_zoom: int | None = None
    threads: int = 2


def write_tiles(
    mosaic_file: Path,
    folder: Path,
    options: TileOptions = TileOptions(),
    layers_file: Path | None = None,
    progress: Progress | None = None,
) -> None:
    """Tiles `{z}/{x}/{y}` in Web Mercator with `tiles.json`, and `index.html`, a page that shows them and the
    run's layers.

    The finest zoom is the first whose pixels are no coarser than the mosaic's; the coarsest shows all of it
    in about one tile. More than 8 bits are stretched from the 1st to the 99th percentile; of more than three
    bands the first three are shown. Raises: what `progress` raises; `OSError` if a tile can't be written.
    """
    tile_format = options.tile_format
    zooms, bounds = _zooms(mosaic_file, options.min_zoom, options.max_zoom)
    west, south, east, north = bounds
    folder.mkdir(parents=True)
    finer = zooms[1] >= finest_zoom(mosaic_file)
    write_pyramid(
        TilePyramid(mosaic_file, shown_bands(mosaic_file), folder, zooms, tile_format, finer),
        options.threads,
        progress,
    )
    index = {
        "tilejson": "3.0.0",
        "scheme": "xyz",
        "tiles": [f"{{z}}/{{x}}/{{y}}.{tile_format}"],
        "minzoom": zooms[0],
        "maxzoom": zooms[1],
        "bounds": list(within_the_map(bounds)),
        "center": [wrapped((west + east) / 2.0), (south + north) / 2.0, zooms[0]],
    }
    (folder / "tiles.json").write_text(json.dumps(index, indent=2) + "\n")
    with open_raster(mosaic_file, OWN) as tiff:
        about_text = f"{tiff.width:,} x {tiff.height:,} px of {tiff.res[0]:g} m"
    there = _rows_of_columns(folder, tile_format)
    page = {**index, "view": bounds, "there": there}
    write_tile_page(folder / "index.html", mosaic_file.parent.name, about_text, page, layers_file)


def _rows_of_columns(folder: Path, tile_format: str) -> dict[str, dict[str, list[list[int]]]]:
    """Which tiles there are: by zoom and column, the first and the last row of each run without a gap."""
    found: dict[str, dict[str, list[list[int]]]] = {}
    for column in sorted(folder.glob("*/*/")):
        runs = found.setdefault(column.parent.name, {}).setdefault(column.name, [])
        for row in sorted(int(tile.stem) for tile in column.glob(f"*.{tile_format}")):
            if runs and runs[-1][1] == row - 1:
                runs[-1][1] = row
            else:
                runs.append([row, row])
    return found


def finest_zoom(mosaic_file: Path) -> int:
    """The first zoom whose pixels are no coarser than the mosaic's. Raises: `InputError` without a map."""
    return _zooms(mosaic_file, None, None)[0][1]


def write_kmz(
    mosaic_file: Path, out: Path, max_zoom: int | None = None, progress: Progress | None = None
) -> None:
    """A KMZ for Google Earth: images of 512 px in regions, finer ones as one comes nearer.

    Args: max_zoom: no pixel is finer than those of this zoom's tiles.
    Raises: `InputError` without a map, or across 180 degrees; `OSError` if it can't be written.
    """
    _, south, east, north = _bounds(mosaic_file)
    if east > 180.0:
        raise InputError(
            "crosses 180 degrees of longitude, which an overlay of a KMZ cannot",
            file=mosaic_file,
            fix="write tiles instead: geomosaic export tiles, mbtiles or pmtiles",
        )
    callback = GdalProgress(progress)
    with scratch_folder(out.parent) as scratch, callback.reraise(), gdal_failures(out):
        shown, warped = Path(scratch) / "shown.vrt", Path(scratch) / "warped.vrt"
        _write_shown(mosaic_file, shown)
        with open_raster(mosaic_file, OWN) as tiff:
            side_m = tiff.res[0]
        stretch = math.cos(math.radians((south + north) / 2.0))
        if max_zoom is not None:
            side_m = max(side_m, EQUATOR_M * stretch / TILE_PX / 2.0**max_zoom)
        side_deg = math.degrees(side_m / _EARTH_RADIUS_M)
        size = {"xRes": side_deg / stretch, "yRes": side_deg, "resampleAlg": "bilinear"}
        gdal.Warp(str(warped), str(shown), format="VRT", dstSRS="EPSG:4326", **size)
        done = gdal.Translate(
            str(out),
            str(warped),
            format="KMLSUPEROVERLAY",
            creationOptions=["FORMAT=AUTO", f"NAME={mosaic_file.parent.name}"],
            callback=callback,
        )
        if done is None:
            raise OSError(errno.EIO, "GDAL wrote no KMZ of it")
        close(done)


def _bounds(mosaic_file: Path) -> Bounds:
    """As `geographic_bounds`. Raises `InputError` without a map."""
    with open_raster(mosaic_file, OWN) as tiff:
        if tiff.crs is None:
            fix = "put it on a map first: geomosaic export map RUN"
            raise InputError("has no map projection", file=mosaic_file, fix=fix)
        check_on_earth(tiff.crs.to_wkt(), "web map")
        return geographic_bounds(tiff.crs, tiff.bounds)


def _zooms(mosaic_file: Path, min_zoom: int | None, max_zoom: int | None) -> tuple[tuple[int, int], Bounds]:
    """The coarsest and the finest zoom, as asked for or as `write_tiles` says, and the geographic bounds.

    Raises: `InputError` without a map, or beyond Web Mercator's end.
    """
    west, south, east, north = _bounds(mosaic_file)
    if south > _FURTHEST_DEG or north < -_FURTHEST_DEG:
        problem = f"lies beyond {_FURTHEST_DEG:.2f} degrees of latitude, where Web Mercator ends"
        raise InputError(problem, file=mosaic_file, fix="write a KMZ instead: geomosaic export kmz")
    with open_raster(mosaic_file, OWN) as tiff:
        gsd_m, side_m = tiff.res[0], max(tiff.width, tiff.height) * tiff.res[0]
    lat_deg = (south + north) / 2.0
    finest = math.ceil(_zoom(gsd_m, lat_deg) - 0.01) if max_zoom is None else max_zoom
    if min_zoom is None:
        min_zoom = min(finest, max(0, math.floor(_zoom(side_m / TILE_PX, lat_deg))))
    if min_zoom > finest:
        problem = f"tiles from zoom {min_zoom} to {finest} are none"
        raise InputError(
            problem, file=mosaic_file, fix=f"give a coarsest zoom (min_zoom) of at most {finest}"
        )
    return (min_zoom, finest), (west, south, east, north)


def _zoom(pixel_m: float, lat_deg: float) -> float:
    """The zoom, not whole, at which a Web Mercator pixel has this side on the ground."""
    return math.log2(EQUATOR_M * math.cos(math.radians(lat_deg)) / (TILE_PX * pixel_m))


def _write_shown(mosaic_file: Path, out: Path) -> None:
    """The mosaic as red, green and blue of 8 bits with alpha, as a VRT: a KMZ takes no grey with alpha."""
    shown = shown_bands(mosaic_file)
    each = 3 // len(shown.bands)
    bands, limits = shown.bands * each, shown.limits * each
    with gdal_failures(out):
        options: list[str] = []
        for k, (low, high) in enumerate(limits, 1):
            options += [f"-scale_{k}", f"{low:.17g}", f"{high:.17g}", "0", "255"]
        if options:
            options += [f"-scale_{len(bands) + 1}", "0", "255", "0", "255"]
        source = open_with_osgeo(mosaic_file, OWN)
        done = gdal.Translate(
            str(out),
            source,
            options=gdal.TranslateOptions(
                options=options,
                format="VRT",
                outputType=gdal.GDT_Byte,
                bandList=[*bands, "mask"],
                maskBand="none",
            ),
        )
        done.GetRasterBand(len(bands) + 1).SetColorInterpretation(gdal.GCI_AlphaBand)
        del done, source
