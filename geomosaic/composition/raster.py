"""The mosaic's raster on disk: a COG, written once, of windows in any order and by any thread."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryFile
from types import MappingProxyType
from typing import Any, Final
from uuid import uuid4

import numpy as np
from osgeo import gdal, gdal_array, osr

from geomosaic import __version__
from geomosaic.arrays import Floats
from geomosaic.composition.blended import BlendedBlock
from geomosaic.composition.cog_layout import Tags, directories, write_cog_of
from geomosaic.composition.model import OutputGrid
from geomosaic.composition.palette import frame_colour
from geomosaic.composition.pyramid import RasterPyramid
from geomosaic.composition.tiles import TILE_PX, TileKind
from geomosaic.composition.window import Composed, Window
from geomosaic.doors.gdal_failures import close, gdal_failures, gdal_options
from geomosaic.radiometry.quantity import QUANTITY_TAG, SOURCE_TAG, Quantity
from geomosaic.survey.strip_pixels import GreyScale

BLOCK_ROWS: Final = TILE_PX
COMPRESSION: Final = "deflate"
OVERVIEWS: Final = "average"
SOFTWARE: Final = f"geomosaic {__version__}"
STATISTICS: Final = ("MINIMUM", "MAXIMUM", "MEAN", "STDDEV")
_PREDICTOR: Final = {"f": "3", "i": "2", "u": "2"}
"""TIFF's, by numpy's kinds of numbers."""
_INDICES: Final = ("uint8", "uint16", "uint32")
"""Types of the frames' numbers; those of 8 bits have colours."""
_COLOURS: Final = {
    1: (gdal.GCI_GrayIndex,),
    3: (gdal.GCI_RedBand, gdal.GCI_GreenBand, gdal.GCI_BlueBand),
}

COLOURS: Final = ("red", "green", "blue")
"""Names of a colour camera's bands in a mosaic with another camera's."""


class Raster:
    """A raster to write windows into, and next to it one of who gave each pixel, if that is wanted."""

    def __init__(self, image: RasterPyramid, sources: RasterPyramid | None = None) -> None:
        self._image, self._sources = image, sources

    def write(self, composed: Composed) -> None:
        """One window, by any thread; each pixel once. Whoever brings a tile's last pixel packs it."""
        self._image.add(composed.window, composed.pixels, composed.valid)
        if self._sources is not None:
            given = composed.source(self._sources.kind.dtype)
            self._sources.add(composed.window, given[..., None], composed.valid)

    def put(self, done: BlendedBlock) -> None:
        """Windows that are whole tiles, made elsewhere by the kinds of tiles; by any thread."""
        at = {(w.window.row // TILE_PX, w.window.col // TILE_PX): w for w in done.windows}
        self._image.put_under(done.place, {place: w.tile for place, w in at.items()}, done.over)
        if self._sources is not None:
            self._sources.put_under(done.place, {place: w.index for place, w in at.items()}, done.index_over)

    def leave_out(self, window: Window) -> None:
        """One in which nothing is shown: what it is part of need not wait for it."""
        for pyramid in filter(None, (self._image, self._sources)):
            pyramid.add_nothing(window)


def index_kind(frames: int) -> TileKind:
    """The tiles that say which of so many frames made each pixel."""
    dtype = next(of for of in _INDICES if frames <= np.iinfo(of).max)
    return TileKind(1, np.dtype(dtype), masked=False)


@dataclass(frozen=True)
class MosaicFiles:
    """Where a mosaic's raster goes, and that of its frame indices, if it is wanted. An index is 0 where there
    is no frame, else the frame's index + 1. The tags of that raster name the frames."""

    raster: Path
    sources: Path | None = None


@contextmanager
def writing_mosaic(
    files: MosaicFiles,
    grid: OutputGrid,
    kind: TileKind,
    frames: Sequence[str] = (),
    bands: Mapping[str, Quantity | None] = MappingProxyType({}),
) -> Iterator[Raster]:
    """Files on the map to write windows into; there when the block ends.

    frames: names of all of them, for the frame indices. bands: the name of each, as a rig's have, and what
    its values mean; then only COLOURS are colours.
    Raises: `OSError` (with `ENOSPC` where the disk is full) if they can't be written.
    """
    colours = _COLOURS.get(kind.bands, ())
    if bands:
        first = _COLOURS[3] if tuple(bands)[:3] == COLOURS else _COLOURS[1]
        colours = (*first, *[gdal.GCI_Undefined] * (kind.bands - len(first)))
    look = RasterMetadata(kind, grid, colours, tuple(bands), quantities=tuple(bands.values()))
    with ExitStack() as stack:
        image = stack.enter_context(_writing(files.raster, grid.width_px, grid.height_px, look))
        index = None
        if files.sources is not None:
            numbers = index_kind(len(frames))
            names = {f"FRAME_{i + 1}": name for i, name in enumerate(frames)}
            descriptions = ("index of the frame that made the pixel, from 1",)
            colours = (gdal.GCI_PaletteIndex,) if numbers.dtype == np.uint8 else _COLOURS[1]
            of = RasterMetadata(numbers, grid, colours, descriptions, names)
            index = stack.enter_context(_writing(files.sources, grid.width_px, grid.height_px, of))
        yield Raster(image, index)


@dataclass(frozen=True)
class SceneGreys:
    """Type of a scene's greys, the bits in use, and the values that they stand for, if these are others."""

    dtype: str
    bit_depth: int
    scale: GreyScale | None = None


@contextmanager
def writing_scene(
    path: Path, size_px: tuple[int, int], greys: SceneGreys, rpc: Mapping[str, str] | None
) -> Iterator[Raster]:
    """A raster of one band without a map, to write windows into; memory is least where they come by rows.

    Args: size_px: width and height.
    Raises: `OSError` (with `ENOSPC` where the disk is full) if it can't be written.
    """
    look = RasterMetadata(
        TileKind(1, np.dtype(greys.dtype)), None, _COLOURS[1], greys=greys, rpc=dict(rpc or {})
    )
    with _writing(path, *size_px, look) as image:
        yield Raster(image)


@dataclass(frozen=True)
class RasterMetadata:
    """What a raster says of itself besides its pixels."""

    kind: TileKind
    grid: OutputGrid | None
    colours: tuple[int, ...]
    band_names: tuple[str, ...] = ()
    tags: Mapping[str, str] = field(default_factory=dict)
    greys: SceneGreys | None = None
    rpc: Mapping[str, str] = field(default_factory=dict)
    quantities: tuple[Quantity | None, ...] = ()


@contextmanager
def _writing(path: Path, width: int, height: int, look: RasterMetadata) -> Iterator[RasterPyramid]:
    with TemporaryFile(dir=path.parent) as tiles:
        pyramid = RasterPyramid(width, height, look.kind, tiles, overviews=True)
        yield pyramid
        pyramid.finish()
        tiles.flush()
        with path.open("wb") as out:
            write_cog_of(pyramid, _directories(look, pyramid.statistics()), out)


def _directories(look: RasterMetadata, statistics: Floats | None) -> list[Tags]:
    """Those of a raster of one pixel and of its mask, as GDAL writes them."""
    name, kind = f"/vsimem/{uuid4()}.tif", look.kind
    with gdal_failures(Path(name)), gdal_options({"GDAL_TIFF_INTERNAL_MASK": "YES"}):
        options = [
            "TILED=YES", f"BLOCKXSIZE={TILE_PX}", f"BLOCKYSIZE={TILE_PX}", "INTERLEAVE=PIXEL",
            "COMPRESS=DEFLATE", f"PREDICTOR={_PREDICTOR[kind.dtype.kind]}", "SPARSE_OK=YES",
            "ENDIANNESS=LITTLE", "ALPHA=NO",
        ]  # fmt: skip
        of = gdal_array.NumericTypeCodeToGDALTypeCode(kind.dtype)
        dataset = gdal.GetDriverByName("GTiff").Create(name, 1, 1, kind.bands, of, options)
        tags = {"TIFFTAG_SOFTWARE": SOFTWARE, **look.tags}
        if look.grid is not None:
            crs = osr.SpatialReference()
            crs.SetFromUserInput(look.grid.crs)
            dataset.SetSpatialRef(crs)
            dataset.SetGeoTransform(look.grid.geotransform)
            tags["GSD_M"] = f"{look.grid.gsd_m:.10g}"
        dataset.SetMetadata(tags)
        if look.rpc:
            dataset.SetMetadata(dict(look.rpc), "RPC")
        for k in range(kind.bands):
            _describe(dataset.GetRasterBand(k + 1), look, k, statistics)
        if kind.masked:
            dataset.CreateMaskBand(gdal.GMF_PER_DATASET)
        close(dataset)
        file = gdal.VSIFOpenL(name, "rb")
        data = bytes(gdal.VSIFReadL(1, gdal.VSIStatL(name).size, file))
        gdal.VSIFCloseL(file)
        gdal.Unlink(name)
    return directories(data)


def _describe(band: Any, look: RasterMetadata, k: int, statistics: Floats | None) -> None:
    if look.colours == (gdal.GCI_PaletteIndex,):
        table = gdal.ColorTable()
        for number in range(1, 256):
            table.SetColorEntry(number, frame_colour(number))
        band.SetColorTable(table)
    elif k < len(look.colours):
        band.SetColorInterpretation(look.colours[k])
    if k < len(look.band_names):
        band.SetDescription(look.band_names[k])
    if k < len(look.quantities) and (quantity := look.quantities[k]) is not None:
        band.SetScale(quantity.scale)
        band.SetOffset(quantity.offset)
        band.SetUnitType(quantity.unit)
        band.SetMetadataItem(QUANTITY_TAG, quantity.name)
        if quantity.source:
            band.SetMetadataItem(SOURCE_TAG, quantity.source)
    if look.greys is not None:
        band.SetMetadataItem("NBITS", str(look.greys.bit_depth))
        if look.greys.scale is not None:
            band.SetOffset(look.greys.scale.offset)
            band.SetScale(look.greys.scale.scale)
    if not look.kind.masked:
        band.SetNoDataValue(0)
    for name, of_bands in zip(STATISTICS, () if statistics is None else statistics, strict=False):
        band.SetMetadataItem(f"STATISTICS_{name}", f"{of_bands[k]:.10g}")
