"""The finished mosaic for other programs: a VRT beside it, and web map tiles."""

from __future__ import annotations

import errno
import json
import math
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

import numpy as np
from osgeo import gdal
from rasterio.warp import transform_bounds

from geomosaic.doors.gdal_failures import gdal_failures
from geomosaic.doors.raster import NO_SIDECARS, OWN, open_raster, open_with_osgeo
from geomosaic.errors import InputError
from geomosaic.geodesy.mapcrs import check_on_earth

TILE_FORMATS: Final = {"png": "PNG", "webp": "WEBP"}
_TILE_PX = 256
_EQUATOR_M = 40_075_016.685578488
_SHOWN_PERCENTILES = (1.0, 99.0)


def write_vrt(mosaic_file: Path, out: Path) -> None:
    """A VRT beside the mosaic that names it by its relative path and shows its mask as an alpha band."""
    with gdal_failures(out):
        source = open_with_osgeo(mosaic_file, OWN)
        bands = [*range(1, source.RasterCount + 1), "mask"]
        done = gdal.Translate(str(out), source, format="VRT", bandList=bands, maskBand="none")
        done.GetRasterBand(len(bands)).SetColorInterpretation(gdal.GCI_AlphaBand)
        del done, source


def write_tiles(
    mosaic_file: Path,
    folder: Path,
    *,
    tile_format: str = "png",
    min_zoom: int | None = None,
    max_zoom: int | None = None,
    processes: int = 2,
    check_cancelled: Callable[[], None] | None = None,
) -> None:
    """Tiles `{z}/{x}/{y}` in Web Mercator with `tiles.json`, cut by GDAL's gdal2tiles.

    The finest zoom is the first whose pixels are no coarser than the mosaic's; the coarsest shows all of it
    in about one tile. More than 8 bits are stretched from the 1st to the 99th percentile; of more than three
    bands the first three are shown. Raises `OSError` if a tile can't be written.
    """
    folder.mkdir(parents=True)
    with open_raster(mosaic_file, OWN) as tiff:
        if tiff.crs is None:
            mend = "put it on a map first, such as with gdalwarp -rpc"
            raise InputError("has no map projection", file=mosaic_file, mend=mend)
        check_on_earth(tiff.crs.to_wkt(), "web map")
        west, south, east, north = transform_bounds(tiff.crs, "OGC:CRS84", *tiff.bounds)
        gsd_m, side_m = tiff.res[0], max(tiff.width, tiff.height) * tiff.res[0]
    lat_deg = (south + north) / 2.0
    max_zoom = math.ceil(_zoom(gsd_m, lat_deg) - 0.01) if max_zoom is None else max_zoom
    if min_zoom is None:
        min_zoom = min(max_zoom, max(0, math.floor(_zoom(side_m / _TILE_PX, lat_deg))))
    shown = folder / "shown.vrt"
    _write_shown(mosaic_file, shown)
    command = [
        sys.executable, "-m", "osgeo_utils.gdal2tiles", "--xyz", "--webviewer=none", "--quiet", "--exclude",
        "--resampling=average", f"--zoom={min_zoom}-{max_zoom}", f"--processes={processes}",
        f"--tiledriver={TILE_FORMATS[tile_format]}", str(shown), str(folder),
    ]  # fmt: skip
    _run(command, check_cancelled)
    shown.unlink()
    (folder / "tilemapresource.xml").unlink(missing_ok=True)
    index = {
        "tilejson": "3.0.0",
        "scheme": "xyz",
        "tiles": [f"{{z}}/{{x}}/{{y}}.{tile_format}"],
        "minzoom": min_zoom,
        "maxzoom": max_zoom,
        "bounds": [west, south, east, north],
    }
    (folder / "tiles.json").write_text(json.dumps(index, indent=2) + "\n")


def _zoom(pixel_m: float, lat_deg: float) -> float:
    """The zoom, not whole, at which a Web Mercator pixel has this side on the ground."""
    return math.log2(_EQUATOR_M * math.cos(math.radians(lat_deg)) / (_TILE_PX * pixel_m))


def _write_shown(mosaic_file: Path, out: Path) -> None:
    """The mosaic as 8 bit grey or colour with alpha, as a VRT."""
    with open_raster(mosaic_file, OWN) as tiff:
        bands = [1, 2, 3] if tiff.count >= 3 else [1]
        reduction = max(1, max(tiff.shape) // 1000)
        shape = (len(bands), -(-tiff.height // reduction), -(-tiff.width // reduction))
        seen = tiff.read(bands, out_shape=shape, masked=True)
        eight_bits = tiff.dtypes[0] == "uint8"
    with gdal_failures(out):
        options: list[str] = []
        if not eight_bits:
            for k, band in enumerate(seen):
                valid = band.compressed()
                low, high = np.percentile(valid, _SHOWN_PERCENTILES) if valid.size else (0.0, 1.0)
                options += [f"-scale_{k + 1}", f"{low:.10g}", f"{max(high, low + 1e-9):.10g}", "0", "255"]
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


def _run(command: Sequence[str], check_cancelled: Callable[[], None] | None) -> None:
    """Runs a program to its end, looking every half second whether to stop it. Raises `OSError`."""
    with (
        tempfile.TemporaryDirectory(prefix="geomosaic-tiles-") as scratch,
        subprocess.Popen(  # noqa: S603
            command,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
            env={**os.environ, **NO_SIDECARS, "TMPDIR": scratch},
        ) as running,
    ):
        try:
            while True:
                try:
                    _, said = running.communicate(timeout=0.5)
                    break
                except subprocess.TimeoutExpired:
                    if check_cancelled is not None:
                        check_cancelled()
        except BaseException:
            running.kill()
            raise
    if running.returncode:
        last = said.strip().splitlines() or ["gdal2tiles failed"]
        raise OSError(errno.ENOSPC if "No space left" in said else errno.EIO, last[-1])
