"""Walks an MCAP file that may be cut off, damaged or hostile: every size is checked before it is used."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO, Any, NamedTuple

import zstandard
from google.protobuf.message import DecodeError
from mcap.exceptions import EndOfFile, McapError
from mcap.records import Channel, Chunk, McapRecord, Message, Schema
from mcap.stream_reader import StreamReader, breakup_chunk

from geomosaic.doors.files import check_regular
from geomosaic.errors import FileError

MAX_RECORD_BYTES = 128 * 2**20
FIX = "give the run.mcap of a run folder"
BROKEN = (
    McapError,
    DecodeError,
    zstandard.ZstdError,
    struct.error,
    ValueError,
    OverflowError,
    RecursionError,
)
"""What the libraries raise on bytes that aren't what they should be."""
DAMAGED = (*BROKEN, TypeError, KeyError, AttributeError)
"""What decoding a message raises, JSON within it too."""


class Item(NamedTuple):
    """A record and the file offset where it, or the chunk that holds it, starts; of a message also
    its topic and its schema's name. A `record` of None stands for damage, which `problem` describes."""

    offset: int
    record: McapRecord | None
    topic: str = ""
    schema: str = ""
    problem: str = ""


def opened(path: Path) -> IO[bytes]:
    """The file, open for reading. Raises FileError."""
    check_regular(path, FIX)
    try:
        if path.stat().st_size == 0:  # as the system's own files say of themselves (/proc)
            raise FileError("this file is empty", file=path, fix=FIX)
        return path.open("rb")
    except FileError:
        raise
    except OSError as error:
        raise FileError(f"can't be read ({error.strerror})", file=path, fix=FIX) from error


def items(path: Path, file: IO[bytes], more: Callable[[], bool] = lambda: False) -> Iterator[Item]:
    """Every record in the file's order, chunks unpacked.

    A damaged chunk is left out, and reading goes on behind it; where the file ends too early, reading
    ends, unless `more` may come. Raises FileError if it is no MCAP file from its first bytes on.
    """
    schemas: dict[int, str] = {}
    channels: dict[int, Channel] = {}
    records = stream(file)
    offset = 0
    while True:
        try:
            record = next(records, None)
        except BROKEN as error:
            if isinstance(error, EndOfFile) and more():
                records = stream(file, offset)
                continue
            if offset == 0:
                problem = "this is no MCAP file, or it was cut off in its header"
                empty = file.seek(0, 2) == 0
                raise FileError("this file is empty" if empty else problem, file=path, fix=FIX) from error
            cut = isinstance(error, EndOfFile)
            text = "it was cut off" if cut else f"damaged behind byte {offset} ({error})"
            yield Item(offset, None, problem=text)
            return
        if record is None:
            return
        inner = [record]
        if isinstance(record, Chunk):
            try:
                inner = unpacked(record)
            except BROKEN as error:
                yield Item(offset, None, problem=f"the chunk at byte {offset} is damaged ({error})")
                inner = []
        for r in inner:
            if isinstance(r, Schema):
                schemas[r.id] = r.name
            elif isinstance(r, Channel):
                channels[r.id] = r
                yield Item(offset, r, r.topic, schemas.get(r.schema_id, ""))
                continue
            elif isinstance(r, Message) and r.channel_id in channels:
                channel = channels[r.channel_id]
                yield Item(offset, r, channel.topic, schemas.get(channel.schema_id, ""))
                continue
            yield Item(offset, r)
        offset = file.tell()


def stream(file: IO[bytes], offset: int = 0) -> Iterator[McapRecord]:
    """Records with chunks left packed, from the start or from the offset of a record."""
    whole_reads: Any = _WholeReads(file, offset)
    reader = StreamReader(
        whole_reads,
        skip_magic=offset > 0,
        emit_chunks=True,
        validate_crcs=True,
        record_size_limit=MAX_RECORD_BYTES,
    )
    return iter(reader.records)


def unpacked(chunk: Chunk) -> list[McapRecord]:
    """The records of a chunk, its size checked before anything is decompressed. Raises of `BROKEN`."""
    if chunk.compression not in ("", "zstd"):
        raise ValueError(f"compression {chunk.compression[:20]!r} isn't used by geomosaic")
    size = zstandard.frame_content_size(chunk.data) if chunk.compression else len(chunk.data)
    if size != chunk.uncompressed_size or size > MAX_RECORD_BYTES:
        raise ValueError("its size disagrees with its header")
    return breakup_chunk(chunk, validate_crc=True)


class _WholeReads:
    """A file whose read gives all that was asked for, or raises EndOfFile before allocating it."""

    def __init__(self, file: IO[bytes], offset: int) -> None:
        self._file = file
        self._size = file.seek(0, 2)
        file.seek(offset)

    def read(self, length: int) -> bytes:
        """Exactly `length` bytes."""
        if length > self._size - self._file.tell():
            raise EndOfFile
        return self._file.read(length)
