"""Web map tiles in one file: MBTiles for phones and map servers, PMTiles for pages that read parts of it.

MBTiles 1.3, https://github.com/mapbox/mbtiles-spec; PMTiles 3, https://github.com/protomaps/PMTiles, by the
package of its authors.
"""

from __future__ import annotations

import errno
import json
import sqlite3
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

from geomosaic.doors.gdal_failures import Progress
from geomosaic.doors.scratch import scratch_folder
from geomosaic.export.web import TileOptions, finest_zoom, write_tiles

_MBTILES: Final = """
BEGIN;
PRAGMA application_id = 0x4d504258;
CREATE TABLE metadata (name TEXT, value TEXT);
CREATE TABLE tiles (zoom_level INTEGER, tile_column INTEGER, tile_row INTEGER, tile_data BLOB);
CREATE UNIQUE INDEX tile_index ON tiles (zoom_level, tile_column, tile_row);
"""
_FINEST_MBTILES: Final = 22
"""GDAL opens no finer ones (mbtilesdataset.cpp)."""
_E7: Final = 1e7
"""PMTiles' degrees: whole numbers of 1e-7."""


def write_packed(
    mosaic_file: Path,
    out: Path,
    form: str,
    options: TileOptions = TileOptions(),
    progress: Progress | None = None,
) -> None:
    """The tiles of `write_tiles` in one file of one of `FORMS`.

    The finest zoom of MBTiles is at most 22 where none is asked for.
    Raises: `InputError` without a map; `OSError` if it can't be written.
    """
    if form == "mbtiles" and options.max_zoom is None:
        options = replace(options, max_zoom=min(finest_zoom(mosaic_file), _FINEST_MBTILES))
    with scratch_folder(out.parent) as scratch:
        folder = Path(scratch) / "tiles"
        write_tiles(mosaic_file, folder, options, progress=progress)
        index = {**json.loads((folder / "tiles.json").read_text()), "name": mosaic_file.parent.name}
        FORMS[form](out, folder, index, options.tile_format)


def _write_mbtiles(out: Path, folder: Path, index: dict[str, Any], tile_format: str) -> None:
    metadata = {
        "name": index["name"],
        "format": tile_format,
        "type": "overlay",
        "minzoom": str(index["minzoom"]),
        "maxzoom": str(index["maxzoom"]),
        "bounds": ",".join(f"{v:.8f}" for v in index["bounds"]),
        "center": ",".join(f"{v:.8g}" for v in index["center"]),
    }
    rows = (
        (zoom, col, 2**zoom - 1 - row, tile.read_bytes())
        for zoom, col, row, tile in _tiles(folder, tile_format)
    )
    try:
        with closing(sqlite3.connect(out, isolation_level=None)) as database:
            database.executescript(_MBTILES)
            database.executemany("INSERT INTO metadata VALUES (?, ?)", metadata.items())
            database.executemany("INSERT INTO tiles VALUES (?, ?, ?, ?)", rows)
            database.execute("COMMIT")
    except sqlite3.Error as error:
        full = getattr(error, "sqlite_errorcode", 0) == sqlite3.SQLITE_FULL
        raise OSError(errno.ENOSPC if full else errno.EIO, str(error)) from error


def _write_pmtiles(out: Path, folder: Path, index: dict[str, Any], tile_format: str) -> None:
    """Tiles along Hilbert's curve, equal ones once."""
    from pmtiles.tile import Compression, TileType, zxy_to_tileid
    from pmtiles.writer import Writer

    west, south, east, north = (round(v * _E7) for v in index["bounds"])
    lon, lat = (round(v * _E7) for v in index["center"][:2])
    header = {
        "tile_type": TileType[tile_format.upper()],
        "tile_compression": Compression.NONE,
        "min_lon_e7": west,
        "min_lat_e7": south,
        "max_lon_e7": east,
        "max_lat_e7": north,
        "center_zoom": index["minzoom"],
        "center_lon_e7": lon,
        "center_lat_e7": lat,
    }
    numbered = {zxy_to_tileid(z, col, row): tile for z, col, row, tile in _tiles(folder, tile_format)}
    with out.open("wb") as file:
        writer = Writer(file)
        for number in sorted(numbered):
            writer.write_tile(number, numbered[number].read_bytes())
        writer.finalize(header, {"name": index["name"], "type": "overlay"})


def _tiles(folder: Path, tile_format: str) -> Iterator[tuple[int, int, int, Path]]:
    """Zoom, column, row from the north and file, in order of these."""
    tiles = (
        (int(tile.parent.parent.name), int(tile.parent.name), int(tile.stem), tile)
        for tile in folder.glob(f"*/*/*.{tile_format}")
    )
    yield from sorted(tiles)


FORMS: Final[dict[str, Callable[[Path, Path, dict[str, Any], str], None]]] = {
    "mbtiles": _write_mbtiles,
    "pmtiles": _write_pmtiles,
}
