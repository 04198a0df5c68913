"""The frames' orthos as files: their names, each as a COG, and the VRT that lays them over each other."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Final

from osgeo import gdal

from geomosaic.composition.area import Area
from geomosaic.composition.frame_part import Warping
from geomosaic.composition.orthos import write_ortho
from geomosaic.composition.visibility import FrameOnMap
from geomosaic.doors.gdal_failures import close, gdal_failures
from geomosaic.doors.raster import OWN, open_raster
from geomosaic.doors.scratch import scratch_folder
from geomosaic.export.cog import CogOptions, write_cog

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


@dataclass(frozen=True)
class OrthoStyle:
    """What all frames' orthos have in common; scratch: a folder for files that come and go."""

    warping: Warping
    area: Area | None
    names: tuple[str, ...]
    cog: CogOptions
    scratch: Path


@dataclass(frozen=True)
class OrthoFile:
    """A frame's ortho, a COG's bytes; none where it shows nothing."""

    cog: bytes


def ortho_file(style: OrthoStyle, frame: tuple[FrameOnMap, ...]) -> OrthoFile:
    """One frame's ortho. Raises: as `write_ortho` and `write_cog`."""
    with scratch_folder(style.scratch) as folder:
        raster, out = Path(folder) / "raster.tif", Path(folder) / "ortho.tif"
        if not write_ortho(style.warping, style.area, style.names, frame, raster):
            return OrthoFile(b"")
        write_cog(raster, out, style.cog)
        return OrthoFile(out.read_bytes())


def write_orthos_vrt(rasters: Sequence[Path], out: Path) -> None:
    """A VRT in the folder of rasters of one grid, the last on top, bands named as theirs; masked pixels let
    those below be seen.

    Raises: `OSError` if it can't be written.
    """
    with open_raster(rasters[-1], OWN) as top:
        names = [name or "" for name in top.descriptions]
    with gdal_failures(out):
        made = gdal.BuildVRT(str(out), [str(path) for path in rasters])
        for band, name in enumerate(names, start=1):
            made.GetRasterBand(band).SetDescription(name)
        close(made)
