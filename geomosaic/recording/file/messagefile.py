"""An MCAP file of messages on one clock, written so that a killed process loses little."""

from __future__ import annotations

import contextlib
import os
import threading
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from mcap.well_known import MessageEncoding, SchemaEncoding
from mcap.writer import CompressionType, Writer
from mcap_protobuf.schema import build_file_descriptor_set

from geomosaic import __version__
from geomosaic.errors import OutputError

CHUNK_BYTES = 128 * 1024
_FIXED_STEP_NS = 1_000_000


class MessageFile:
    """Topics, schemas and times of a recording's messages.

    The sequence number counts all messages. Log times rise strictly: the wall clock, or with `fixed_time`
    steps of 1 ms from the epoch. A message that brings a `timestamp`, that of an exposure, has it as publish
    time; Foxglove plots no file whose log times span more than 104 days.
    Threads may write at once. A path of None is no file.
    Every method raises OutputError where the file can't be written, and from then on always.
    """

    def __init__(self, path: Path | None, profile: str, fixed_time: bool) -> None:
        self._path = path or Path(os.devnull)
        self._lock = threading.RLock()
        self._fixed_time = fixed_time
        self._time_ns = 0
        self._sequence = 0
        self._schema_ids: dict[str, int] = {}
        self._channel_ids: dict[str, int] = {}
        self._failure: OutputError | None = None
        self._closed = False
        with self._writing():
            if self._path.is_file() or self._path.is_fifo():  # another name of it keeps its content
                self._path.unlink()
            self._file = self._path.open("wb")
            self._writer: Any = Writer(  # partly untyped
                self._file,
                chunk_size=CHUNK_BYTES,
                compression=CompressionType.ZSTD,
                enable_data_crcs=True,
            )
            self._writer.start(profile=profile, library=f"geomosaic {__version__}")

    @property
    def failed(self) -> bool:
        """Whether something couldn't be written."""
        return self._failure is not None

    def describe(self, name: str, values: Mapping[str, str]) -> None:
        """A metadata record."""
        with self._lock, self._writing():
            self._writer.add_metadata(name, dict(values))

    def attach(self, name: str, media_type: str, data: bytes) -> None:
        """An attachment."""
        with self._lock, self._writing():
            now = self._now_ns()
            self._writer.add_attachment(
                create_time=now, log_time=now, name=name, media_type=media_type, data=data
            )

    def write(self, topic: str, message: Any) -> None:
        """A protobuf message; the first on a topic settles the topic's schema."""
        fields = message.DESCRIPTOR.fields_by_name
        with self._lock, self._writing():
            at_ns = published_ns = self._now_ns()
            if "recorded_ns" in fields:
                message.recorded_ns = at_ns
            if "timestamp" in fields:
                published_ns = _nanoseconds(message.timestamp) or at_ns
                message.timestamp.FromNanoseconds(published_ns)
            self._writer.add_message(
                channel_id=self._channel_id(topic, type(message)),
                log_time=at_ns,
                publish_time=published_ns,
                sequence=self._sequence & 0xFFFFFFFF,
                data=message.SerializeToString(deterministic=True),
            )
            self._sequence += 1

    def flush(self, sync: bool = True) -> None:
        """End the chunk and give everything to the system, which keeps it if this process is killed. With
        `sync` also put it on the disk, which keeps it if the machine fails."""
        with self._lock, self._writing():
            self._writer.flush()
            self._file.flush()
            if sync and self._path.is_file():
                os.fsync(self._file.fileno())

    def close(self) -> None:
        """Write summary and footer. Closing twice is harmless."""
        if self._closed:
            return
        self._closed = True
        with self._lock, self._writing():
            self._writer.finish()
            self._file.flush()
            if self._path.is_file():
                os.fsync(self._file.fileno())
            self._file.close()

    def _now_ns(self) -> int:
        wall_ns = 0 if self._fixed_time else time.time_ns()
        self._time_ns = max(wall_ns, self._time_ns + (_FIXED_STEP_NS if self._fixed_time else 1))
        return self._time_ns

    def _channel_id(self, topic: str, message_class: Any) -> int:
        if topic not in self._channel_ids:
            schema = message_class.DESCRIPTOR.full_name
            if schema not in self._schema_ids:
                described = build_file_descriptor_set(message_class).SerializeToString(deterministic=True)
                self._schema_ids[schema] = self._writer.register_schema(
                    schema, SchemaEncoding.Protobuf, described
                )
            self._channel_ids[topic] = self._writer.register_channel(
                topic, MessageEncoding.Protobuf, self._schema_ids[schema]
            )
        return self._channel_ids[topic]

    @contextlib.contextmanager
    def _writing(self) -> Iterator[None]:
        """Turns an OSError into an OutputError, and keeps it: a file with a hole takes no more."""
        if self._failure is not None:
            raise self._failure
        try:
            yield
        except OSError as error:
            fix = "free some space or choose another output folder"
            self._failure = OutputError(error.strerror or str(error), file=self._path, fix=fix)
            self._closed = True
            if hasattr(self, "_file"):
                with contextlib.suppress(OSError):
                    self._file.close()
            raise self._failure from error


def _nanoseconds(timestamp: Any) -> int:
    """Since 1970; 0 where it is none that a file of this century can have."""
    try:
        return max(int(timestamp.ToNanoseconds()), 0)
    except ValueError:
        return 0
