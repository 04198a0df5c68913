"""Names of the frames' orthos, and the VRT that lays them over each other."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from typing import Final

from osgeo import gdal

from geomosaic.doors.gdal_failures import close, gdal_failures
from geomosaic.doors.raster import OWN, open_raster

_UNSAFE: Final = re.compile(r"[^\w.-]")
_LONGEST: Final = 60
"""In characters: at most four bytes each, where names may have 255."""


def ortho_names(frames: Sequence[str]) -> list[str]:
    """A file name for each frame: its own without folders and what shells and web servers stumble over.

    Those that would be alike, in capitals or not, are numbered: `a.tif`, `A_2.tif`.
    """
    names: list[str] = []
    taken: set[str] = set()
    for frame in frames:
        stem = (
            _UNSAFE.sub("_", PurePosixPath(frame.replace("\\", "/")).stem).lstrip("._-")[:_LONGEST] or "frame"
        )
        name, number = stem, 1
        while name.casefold() in taken:
            number += 1
            name = f"{stem}_{number}"
        taken.add(name.casefold())
        names.append(f"{name}.tif")
    return names


def write_orthos_vrt(rasters: Sequence[Path], out: Path) -> None:
    """A VRT beside rasters of one grid, the last on top, bands named as theirs; masked pixels let those below
    be seen.

    Raises: `OSError` if it can't be written.
    """
    with open_raster(rasters[-1], OWN) as top:
        names = [name or "" for name in top.descriptions]
    with gdal_failures(out):
        made = gdal.BuildVRT(str(out), [str(path) for path in rasters])
        for band, name in enumerate(names, start=1):
            made.GetRasterBand(band).SetDescription(name)
        close(made)
