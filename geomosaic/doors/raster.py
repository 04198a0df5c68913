"""The one place where a raster is opened, by rasterio or by osgeo: a regular local file of a listed driver.

No raster that is opened here makes GDAL open a connection or a file that was not checked. Sidecars and the
sources of a VRT are left shut unless they were checked (`doors.references`).
"""

from __future__ import annotations

import logging
import stat
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, TypeAlias

import rasterio
from rasterio._err import CPLE_BaseError
from rasterio.env import set_gdal_config
from rasterio.errors import NotGeoreferencedWarning, RasterioError

from geomosaic.doors.at_hand import at_hand
from geomosaic.doors.bindings import gdal
from geomosaic.doors.files import check_regular
from geomosaic.doors.references import check_sidecars, check_sources
from geomosaic.doors.unwarned import unwarned
from geomosaic.errors import FileError

gdal.UseExceptions()

Raster: TypeAlias = rasterio.DatasetReader
MOST_BANDS: Final = 128  # OpenCV's own limit; satellites with more are no frames, DEMs or strips
READ_CACHE_BYTES: Final = 64 << 20  # GDAL's own is a twentieth of the memory; with less, it decodes twice
_MOST_BLOCK_BYTES: Final = 1 << 30  # GDAL decodes whole blocks: a strip of 4,096 columns and 130,000 lines
_BYTES: Final = {"uint8": 1, "int8": 1, "uint16": 2, "int16": 2, "uint32": 4, "int32": 4, "float32": 4}
_AGAIN: Final = "copy it again"
_CONNECTING = """
    AmigoCloud CSW Carto DAAS DAP EEDA EEDAI Elasticsearch GMLAS GTI HTTP MSSQLSpatial MySQL NGW OAPIF OGCAPI
    PLMOSAIC PLSCENES PostGISRaster PostgreSQL STACIT STACTA TileDB WCS WFS WMS WMTS Zarr netCDF
"""  # GDAL's drivers that open connections, some of them to wherever a file says


@dataclass(frozen=True)
class Purpose:
    """What a raster is wanted for: its drivers by GDAL's names, and what is said where it is none of them.

    sidecars: whether world files, .prj, .aux.xml and .ovr next to it count, as they do for maps.
    """

    drivers: tuple[str, ...]
    problem: str
    fix: str
    sidecars: bool = False
    missing: tuple[str, str] = "there is no such file", "check the path"


_PLAIN: Final = ("GTiff", "AAIGrid", "HFA", "ENVI", "EHdr", "GPKG", "VRT")
_FAILURES: Final = (RasterioError, CPLE_BaseError, OSError, MemoryError)
NO_SIDECARS: Final = {"GDAL_PAM_ENABLED": "NO", "GDAL_DISABLE_READDIR_ON_OPEN": "EMPTY_DIR"}
FRAME: Final = Purpose(
    ("GTiff", "PNG"), "is no readable TIFF or PNG file", "copy it again, or take it out of the folder"
)
MASK: Final = Purpose(("PNG", "GTiff", "JPEG"), "the mask can't be read", "write it as 8 bit PNG or TIFF")
STRIP: Final = Purpose(("GTiff",), "is no raster file that can be read", "give a strip such as a GeoTIFF")
OWN: Final = Purpose(("GTiff",), "can't be read as a raster", "run the recipe again")
DEM: Final = Purpose(
    (*_PLAIN, "SRTMHGT", "DTED", "USGSDEM"),
    "is no raster file that can be read",
    "give a DEM such as a GeoTIFF",
    sidecars=True,
    missing=("there is no such DEM", "check --dem"),
)
REFERENCE: Final = Purpose(
    (*_PLAIN, "JP2OpenJPEG", "PNG", "JPEG"),
    "is no raster file that can be read",
    "give a georeferenced raster such as a GeoTIFF",
    sidecars=True,
    missing=("no such file", "give a georeferenced raster such as a GeoTIFF"),
)


def unreferenced_is_fine() -> AbstractContextManager[None]:
    """Frames lie nowhere until they are placed."""
    return unwarned(NotGeoreferencedWarning)


def open_raster(path: Path, purpose: Purpose) -> Raster:
    """A raster as rasterio's dataset; that it has no place on the map is no cause for a warning.

    Raises: `FileError` for what is no regular local file, no raster of the purpose's drivers, or refers to
    what isn't one.
    """
    path = _regular(path, purpose)
    if "VRT" in purpose.drivers:
        single = replace(purpose, drivers=tuple(d for d in purpose.drivers if d != "VRT"))
        check_sources(path, lambda source: open_raster(source, single).close())
    options = {"GDAL_PAM_ENABLED": "YES"}
    if purpose.sidecars:
        check_sidecars(path)
    else:
        options = NO_SIDECARS
    try:
        with unreferenced_is_fine(), rasterio.Env(**options):
            raster = Raster(path, driver=[*purpose.drivers], sharing=False)
    except (*_FAILURES, ValueError) as error:
        raise FileError(purpose.problem, file=path, fix=purpose.fix) from error
    try:
        _check_blocks(raster, path)
    except FileError:
        raster.close()
        raise
    return raster


def open_with_osgeo(path: Path, purpose: Purpose) -> Any:
    """A raster as osgeo's dataset, its sidecars left shut. Raises `FileError` as `open_raster` does."""
    path = _regular(path, purpose)
    drivers = [driver for driver in purpose.drivers if driver != "VRT"]
    try:
        return gdal.OpenEx(str(path), gdal.OF_RASTER, allowed_drivers=drivers, sibling_files=[path.name])
    except RuntimeError as error:
        raise FileError(purpose.problem, file=path, fix=purpose.fix) from error


@contextmanager
def reading(path: Path, problem: str = "can't be read whole", fix: str = _AGAIN) -> Iterator[None]:
    """Puts `FileError` in the place of what GDAL says of a raster whose data can't be read."""
    try:
        yield
    except FileError:
        raise
    except _FAILURES as error:
        raise FileError(problem, file=path, fix=fix) from error


def _regular(path: Path, purpose: Purpose) -> Path:
    """The absolute path of a regular file; what looks like one but opens something else is refused."""
    named = path if len(str(path)) < 256 else f"{str(path)[:255]}..."
    if str(path).startswith("/vsi"):
        raise FileError("is no file on this machine", file=named, fix=purpose.fix)
    path = at_hand(path)
    try:
        folder = stat.S_ISDIR(path.stat().st_mode)
    except (OSError, ValueError) as error:
        raise FileError(purpose.missing[0], file=named, fix=purpose.missing[1]) from error
    if folder:
        raise FileError(purpose.problem, file=named, fix=purpose.fix)
    check_regular(path, purpose.fix)
    return path.absolute()


def _check_blocks(raster: Raster, path: Path) -> None:
    """GDAL decodes whole blocks, of all bands where they are interleaved: few bytes may ask for gigabytes."""
    if raster.count > MOST_BANDS:
        fix = f"take out the needed ones, at most {MOST_BANDS}"
        raise FileError(f"has {raster.count} bands", file=path, fix=fix)
    interleaved = raster.interleaving is not None and raster.interleaving.name == "pixel"
    bytes_each = [
        rows * cols * _BYTES.get(kind, 16)
        for (rows, cols), kind in zip(raster.block_shapes, raster.dtypes, strict=True)
    ]
    needed = sum(bytes_each) if interleaved else max(bytes_each, default=0)
    if needed > _MOST_BLOCK_BYTES:
        problem = f"is stored in blocks of {needed / 1e9:.1f} GB"
        raise FileError(problem, file=path, fix="write it in tiles (gdal_translate -co TILED=YES)")


def _go_offline() -> None:
    """Takes the drivers that open connections out of both GDALs, as far as these aren't at work yet."""
    logger = logging.getLogger("rasterio")
    level = logger.level
    logger.setLevel(logging.ERROR)  # it warns of each that it lacks
    try:
        set_gdal_config("GDAL_SKIP", " ".join(_CONNECTING.split()))
        with rasterio.Env():
            pass
    finally:
        logger.setLevel(level)
    here = [name for name in _CONNECTING.split() if gdal.GetDriverByName(name) is not None]
    gdal.SetConfigOption("GDAL_SKIP", " ".join(here))  # for osgeo.ogr, which registers all again
    for name in here:
        gdal.GetDriverByName(name).Deregister()


_go_offline()
