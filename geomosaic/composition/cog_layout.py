"""A COG put together of tiles that are packed already: all directories first, then the tiles, the smallest
overview's in front, each with its mask behind it.

The directories (TIFF 6.0, section 2; BigTIFF's have longer numbers) are those of a raster that GDAL made,
with other sizes and places. The words before the first one say how tiles lie, so that GDAL reads a tile, its
size and its mask in one go (GDAL, COG driver, "Header ghost area").
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from enum import IntEnum, IntFlag
from typing import IO, Any, Final

import numpy as np

from geomosaic.arrays import Ints64
from geomosaic.composition.pyramid import RasterLevel, RasterPyramid


class Tag(IntEnum):
    """What of a directory matters here."""

    SUBFILE = 254
    WIDTH = 256
    HEIGHT = 257
    BITS = 258
    COMPRESSION = 259
    PHOTOMETRIC = 262
    BANDS = 277
    PLANAR = 284
    PREDICTOR = 317
    TILE_WIDTH = 322
    TILE_HEIGHT = 323
    TILES = 324
    TILE_BYTES = 325
    EXTRA_BANDS = 338
    NUMBERS = 339
    NODATA = 42113


class Subfile(IntFlag):
    """What a directory is of."""

    RASTER = 0
    OVERVIEW = 1
    MASK = 4


class NumberKind(IntEnum):
    """Types of whole numbers."""

    LONG = 4
    LONG8 = 16


Tags = dict[int, tuple[int, int, bytes]]
"""A directory's: of each tag type, number of values and these, little endian."""
_OWN: Final = (Tag.SUBFILE, Tag.WIDTH, Tag.HEIGHT, Tag.TILES, Tag.TILE_BYTES)
"""What an overview doesn't have from its raster, as it has how pixels are kept."""
_STRUCT: Final = {
    1: "B", 2: "c", 3: "H", 4: "I", 5: "Q", 6: "b", 7: "c", 8: "h", 9: "i", 10: "q", 11: "f", 12: "d",
}  # fmt: skip
"""One value of each type."""
_SIZE_BYTES: Final = struct.calcsize("<I")
"""A tile's size before it, and its last bytes once more behind it."""
_CLASSIC_BYTES: Final = np.iinfo(np.uint32).max
_WORDS: Final = (
    "LAYOUT=IFDS_BEFORE_DATA\nBLOCK_ORDER=ROW_MAJOR\nBLOCK_LEADER=SIZE_AS_UINT4\n"
    "BLOCK_TRAILER=LAST_4_BYTES_REPEATED\nKNOWN_INCOMPATIBLE_EDITION=NO\n "
)
_MASK_WORDS: Final = "MASK_INTERLEAVED_WITH_IMAGERY=YES\n"


def directories(tiff: bytes) -> list[Tags]:
    """Those of a classic TIFF, little endian."""
    found = []
    (at,) = struct.unpack_from("<I", tiff, 4)
    while at:
        (entries,) = struct.unpack_from("<H", tiff, at)
        tags: Tags = {}
        for entry in range(at + 2, at + 2 + 12 * entries, 12):
            tag, kind, count = struct.unpack_from("<HHI", tiff, entry)
            size, first = struct.calcsize(f"<{_STRUCT[kind]}") * count, entry + 8
            if size > 4:
                (first,) = struct.unpack_from("<I", tiff, first)
            tags[tag] = kind, count, tiff[first : first + size]
        found.append(tags)
        (at,) = struct.unpack_from("<I", tiff, at + 2 + 12 * entries)
    return found


def write_cog_of(pyramid: RasterPyramid, like: Sequence[Tags], out: IO[bytes]) -> None:
    """Writes a finished pyramid. like: the directories of a raster of such tiles and, if they have masks, of
    its mask.
    """
    empty = pyramid.kind.empty()
    sizes = [_sizes(level, empty) for level in pyramid.levels]
    total = sum(int((of + 2 * _SIZE_BYTES).sum()) for of in sizes)
    header = _header(pyramid.levels, sizes, like, big=False)
    if len(header) + total > _CLASSIC_BYTES:
        header = _header(pyramid.levels, sizes, like, big=True)
    out.write(header)
    for level in reversed(pyramid.levels):
        for places in level.places:
            out.writelines(_blocks(pyramid.tiles, places, empty))


def _sizes(level: RasterLevel, empty: tuple[bytes, bytes]) -> Ints64:
    """Bytes of each tile, and of its mask if there are any, (down, across, 1 or 2)."""
    of = level.places[..., 1:].copy()
    of[of[..., 0] == 0] = [len(part) for part in empty]
    return of[..., : 2 if empty[1] else 1]


def _blocks(tiles: IO[bytes], places: Ints64, empty: tuple[bytes, bytes]) -> Iterator[bytes]:
    """The bytes of a row of tiles."""
    for first, size, mask_size in places.tolist():
        parts = empty
        if size:
            tiles.seek(first)
            both = tiles.read(size + mask_size)
            parts = both[:size], both[size:]
        for part in filter(None, parts):
            yield from (struct.pack("<I", len(part)), part, part[-_SIZE_BYTES:])


def _header(
    levels: Sequence[RasterLevel], sizes: Sequence[Ints64], like: Sequence[Tags], *, big: bool
) -> bytes:
    """Everything before the tiles, of which it says where each one lies."""
    places = [np.zeros_like(of) for of in sizes]
    at = len(_written(_directories(levels, sizes, places, like, big), len(like) > 1, big))
    for into, of in zip(reversed(places), reversed(sizes), strict=True):
        ends = at + np.cumsum(of + 2 * _SIZE_BYTES).reshape(of.shape)
        into[:] = ends - of - _SIZE_BYTES
        at = int(ends.flat[-1])
    return _written(_directories(levels, sizes, places, like, big), len(like) > 1, big)


def _directories(
    levels: Sequence[RasterLevel],
    sizes: Sequence[Ints64],
    places: Sequence[Ints64],
    like: Sequence[Tags],
    big: bool,
) -> list[Tags]:
    """In GDAL's order: the raster, its mask, the overviews, their masks."""
    whole, mask = Subfile.RASTER, Subfile.MASK
    smaller = range(1, len(levels))
    order = [(0, whole), (0, mask), *((k, whole) for k in smaller), *((k, mask) for k in smaller)]
    found = []
    for k, of in order:
        if of and len(like) == 1:
            continue
        tags = dict(like[1 if of else 0])
        if k:
            tags = {tag: tags[tag] for tag in Tag if tag in tags and tag not in _OWN}
            of |= Subfile.OVERVIEW
        if of:
            tags[Tag.SUBFILE] = _numbers(of)
        tags[Tag.WIDTH], tags[Tag.HEIGHT] = _numbers(levels[k].width), _numbers(levels[k].height)
        part = 1 if of & mask else 0
        tags[Tag.TILES] = _numbers(places[k][..., part], NumberKind.LONG8 if big else NumberKind.LONG)
        tags[Tag.TILE_BYTES] = _numbers(sizes[k][..., part])
        found.append(tags)
    return found


def _numbers(values: Any, kind: NumberKind = NumberKind.LONG) -> tuple[int, int, bytes]:
    numbers = np.asarray(values, "<u8" if kind == NumberKind.LONG8 else "<u4")
    return kind, numbers.size, numbers.tobytes()


def _written(found: Sequence[Tags], masked: bool, big: bool) -> bytes:
    """A file's first bytes: directories, each with its longer values behind it, then the lists of tiles."""
    count, entry, word = ("<Q", "<HHQ", "<Q") if big else ("<H", "<HHI", "<I")
    words = _WORDS + (_MASK_WORDS if masked else "")
    ghost = _even(f"GDAL_STRUCTURAL_METADATA_SIZE={len(words):06d} bytes\n{words}".encode("ascii"))
    start = struct.calcsize(word) * 2 + len(ghost)
    out = struct.pack("<2sHHHQ", b"II", 43, 8, 0, start) if big else struct.pack("<2sHI", b"II", 42, start)
    out += ghost
    room = struct.calcsize(word)
    long = [[t for t in sorted(tags) if len(tags[t][2]) > room] for tags in found]
    other_tags = [[t for t in of if t not in (Tag.TILES, Tag.TILE_BYTES)] for of in long]
    spans = [
        struct.calcsize(count) + (struct.calcsize(entry) + room) * len(tags) + room
        + sum(len(_even(tags[t][2])) for t in of)
        for tags, of in zip(found, other_tags, strict=True)
    ]  # fmt: skip
    lists_at = start + sum(spans)
    lists = b""
    for k, (tags, of) in enumerate(zip(found, other_tags, strict=True)):
        end = len(out) + spans[k]
        values = b"".join(_even(tags[t][2]) for t in of)
        value_at = end - len(values)
        out += struct.pack(count, len(tags))
        for tag in sorted(tags):
            kind, number, data = tags[tag]
            out += struct.pack(entry, tag, kind, number)
            if len(data) <= room:
                out += data.ljust(room, b"\0")
            elif tag in of:
                out += struct.pack(word, value_at)
                value_at += len(_even(data))
            else:
                out += struct.pack(word, lists_at + len(lists))
                lists += data
        out += struct.pack(word, end if k + 1 < len(found) else 0) + values
    return out + lists


def _even(data: bytes) -> bytes:
    return data + b"\0" * (len(data) % 2)
