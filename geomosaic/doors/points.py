"""The one place where a point cloud of strangers is opened: LAS or LAZ, looked at before laspy reads it."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from pyproj import CRS

from geomosaic.arrays import Bytes, Floats
from geomosaic.doors.files import check_regular
from geomosaic.errors import FileError, GeomosaicError

SUFFIXES: Final = (".las", ".laz")
_FIX: Final = "give a point cloud as LAS or LAZ"
_AGAIN: Final = "copy it again"
_HEAD: Final = struct.Struct("<4s90xHIIBHI")
"""Up to the number of points: signature, header's size, offset to points, records before them, format, bytes
a point."""
_RECORD_BYTES: Final = 54
_MOST_RECORDS: Final = 10_000
_MOST_POINT_BYTES: Final = 1024
_AT_ONCE: Final = 500_000


@dataclass(frozen=True)
class Points:
    """Some points: easting, northing and height (n, 3) in the cloud's CRS, ASPRS class (n,), withheld ones
    and those that are nowhere left out."""

    xyz: Floats
    kind: Bytes


@dataclass(frozen=True)
class PointCloud:
    """An open cloud; crs: None where it says none that can be understood."""

    path: Path
    number: int
    crs: CRS | None
    _reader: Any

    def some(self, most: int) -> Iterator[Points]:
        """At most so many points, evenly chosen by their place in the file, in parts.

        Raises: `FileError` where they can't be read.
        """
        step, before = -(-self.number // most), 0
        chunks = self._reader.chunk_iterator(_AT_ONCE)
        while True:
            with _strange(self.path, "can't be read whole"):
                chunk = next(chunks, None)
                if chunk is None:
                    return
                part = chunk[-before % step :: step]
                points = _taken(part)
            before += len(chunk)
            yield points


def is_point_cloud(path: Path) -> bool:
    """By its name."""
    return path.suffix.lower() in SUFFIXES


@contextmanager
def open_points(path: Path) -> Iterator[PointCloud]:
    """A point cloud while the block lasts.

    Raises: `FileError` for what is missing, no regular file, no LAS or LAZ, or asks for more than its size.
    """
    import laspy  # which brings a client of the web; hardly a run opens a cloud

    check_regular(path, _FIX)
    _check_head(path)
    with path.open("rb") as file:
        with _strange(path, "is no LAS or LAZ file that can be read"):
            reader = laspy.open(file, closefd=False, read_evlrs=False)
            number = int(reader.header.point_count)
        yield PointCloud(path, number, _crs(reader.header), reader)


def _check_head(path: Path) -> None:
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(_HEAD.size)
    if len(head) < _HEAD.size or head[:4] != b"LASF":
        raise FileError("is no LAS or LAZ file", file=path, fix=_FIX)
    _, header, offset, records, _, point, _ = _HEAD.unpack(head)
    if not header <= offset <= size or records > min(_MOST_RECORDS, (offset - header) // _RECORD_BYTES):
        raise FileError("has a header that asks for more than its size", file=path, fix=_AGAIN)
    if point > _MOST_POINT_BYTES:
        raise FileError(f"has points of {point} bytes", file=path, fix="write them without extra bytes")


def _crs(header: Any) -> CRS | None:
    try:
        found = header.parse_crs()
    except Exception:
        return None
    return found if isinstance(found, CRS) else None


def _taken(part: Any) -> Points:
    xyz = np.stack([np.asarray(part[axis], dtype=np.float64) for axis in "xyz"], axis=-1)
    known = np.isfinite(xyz).all(axis=1)
    if "withheld" in part.point_format.dimension_names:
        known &= ~np.asarray(part.withheld).astype(bool)
    return Points(xyz[known], np.asarray(part.classification, dtype=np.uint8)[known])


@contextmanager
def _strange(path: Path, problem: str) -> Iterator[None]:
    """Whatever laspy or what unpacks for it raises becomes `FileError`; the latter's panics are no
    `Exception`."""
    try:
        yield
    except GeomosaicError:
        raise
    except BaseException as error:
        if not isinstance(error, Exception) and type(error).__name__ != "PanicException":
            raise
        raise FileError(problem, file=path, fix=_AGAIN) from error
