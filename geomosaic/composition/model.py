"""What composition takes and gives: the output grid, the mosaic, its seamlines."""

from __future__ import annotations

from dataclasses import dataclass

from geomosaic.arrays import Floats
from geomosaic.projection.map_grid import MapGrid


@dataclass(frozen=True)
class MapPixels:
    """Where pixels lie on the map: its CRS, their side, and easting and northing of a corner of theirs.
    earlier: the grid of a mosaic of whose tiles this one has whole ones more or fewer."""

    crs: str
    gsd_m: float
    origin_m: tuple[float, float] = (0.0, 0.0)
    earlier: MapGrid | None = None


@dataclass(frozen=True)
class OutputGrid(MapGrid):
    """The raster that a mosaic or another product of the run is written to.

    The corner lies at whole multiples of 16 ground pixels or more, so that mosaics of one CRS and
    ground pixel share their pixels and the cells of their seams. Aligned to a raster, it lies
    so many of its pixels from that raster's.
    """


@dataclass(frozen=True)
class Seamline:
    """Where one frame (an index into `Survey.frames`) gives the mosaic.

    polygons: each a tuple of closed rings (n, 2) of easting and northing, the outer one first.
    """

    frame: int
    polygons: tuple[tuple[Floats, ...], ...]


@dataclass(frozen=True)
class Hole:
    """Ground inside the mosaic that no frame shows: its area, and easting and northing of a place in it."""

    area_m2: float
    easting_m: float
    northing_m: float


@dataclass(frozen=True)
class Holes:
    """How many there are, their area together, and the largest of them, by area."""

    number: int = 0
    area_m2: float = 0.0
    largest: tuple[Hole, ...] = ()


@dataclass(frozen=True)
class TrimmedPart:
    """Land that was trimmed for one reason: its area, and its polygons, each a tuple of closed rings (n, 2)
    of easting and northing, the outer one first."""

    reason: str
    area_m2: float
    polygons: tuple[tuple[Floats, ...], ...]


@dataclass(frozen=True)
class Trimmed:
    """What the mosaic leaves out of the land that frames see, seen_m2, by reason."""

    seen_m2: float
    parts: tuple[TrimmedPart, ...] = ()

    @property
    def area_m2(self) -> float:
        """Of all reasons together."""
        return sum(part.area_m2 for part in self.parts)

    @property
    def share(self) -> float:
        """Of the land that frames see."""
        return self.area_m2 / self.seen_m2 if self.seen_m2 else 0.0


@dataclass(frozen=True)
class Mosaic:
    """The composed mosaic, as a COG with an internal mask.

    raster: the raster's name inside the run folder. frames_used: indices of frames that gave pixels.
    band_names: of a rig's bands, in the raster's order. holes: none smaller than a cell of the seamlines is
    seen. resampling: how frames were.
    """

    grid: OutputGrid
    raster: str
    bands: int
    dtype: str
    nodata: float | None
    seamlines: tuple[Seamline, ...]
    frames_used: tuple[int, ...]
    band_names: tuple[str, ...] = ()
    holes: Holes = Holes()
    resampling: str = "cubic"
    trimmed: Trimmed | None = None
