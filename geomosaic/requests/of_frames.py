"""What runs of frames can be asked for besides all others."""

from __future__ import annotations

from abc import ABC
from dataclasses import dataclass
from pathlib import Path

from geomosaic.requests.option import OUTPUT, RARE, RUNNING, Option, asked
from geomosaic.requests.run_request import DASK, NewRunRequest


@dataclass(frozen=True, kw_only=True)
class FramesRequest(NewRunRequest, ABC):
    """A run that may make a mosaic of frames."""

    aoi: Path | None = asked(
        Option(
            "cut the mosaic to the polygons in this file (GeoPackage, GeoJSON, ...)",
            "FILE",
            OUTPUT,
            sets="mosaic.seams.aoi",
        )
    )
    align_to: Path | None = asked(
        Option(
            "use CRS, pixel size and grid of this raster, so that pixels coincide",
            "TIF",
            RARE,
            sets="mosaic.seams.align_to",
        )
    )
    incremental: bool = asked(
        Option(
            "go on from the finished run in RUN: do anew only what added, removed and replaced frames change",
            None,
            RUNNING,
        ),
        False,
    )
    dask: str | None = asked(DASK)
    strict: bool = asked(
        Option(
            "end with an error if a frame cannot be used, a position has no frame or the verdict is bad",
            None,
            RUNNING,
            sets="survey.read.strict",
        ),
        False,
    )

    @property
    def is_strict(self) -> bool:
        """Whether a poor result is an error."""
        return self.strict

    @property
    def goes_on(self) -> bool:
        """Whether it goes on from the finished run in its folder."""
        return self.incremental

    @property
    def cluster(self) -> str | None:
        """The address of a Dask cluster that computes."""
        return self.dask


def crs_of(align_to: Path, wanted: str) -> str:
    """The CRS of a raster, or the one that was asked for if it is the same; else `InputError`."""
    from geomosaic.composition.alignment import read_alignment

    alignment = read_alignment(align_to)
    if wanted == "auto":
        return alignment.crs
    alignment.check_crs(wanted)
    return wanted
