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
from geomosaic.recording.as_json import AS_JSON, fix_json

CHUNK_BYTES = 128 * 1024
_FIXED_STEP_NS = 1_000_000


class MessageFile:
    """Topics, schemas and times of a recording's messages.

    Log times rise strictly, and the sequence number counts all messages: the wall clock, or with
    `fixed_time` steps of 1 ms from the epoch. A message's own `timestamp`, if it has one, is its log time.
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
            if (
                self._path.is_file() or self._path.is_fifo()
            ):  # another name of the same file keeps its content
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
        """A protobuf message; the first on a topic settles the topic's schema. JSON where `as_json` says."""
        with self._lock:
            self._written(topic, message)

    def _written(self, topic: str, message: Any) -> None:
        now = self._now_ns()
        if "timestamp" in message.DESCRIPTOR.fields_by_name:
            message.timestamp.FromNanoseconds(now)
        schema = message.DESCRIPTOR.full_name
        data = fix_json(message) if schema in AS_JSON else message.SerializeToString(deterministic=True)
        with self._writing():
            self._writer.add_message(
                channel_id=self._channel_id(topic, type(message)),
                log_time=now,
                publish_time=now,
                sequence=self._sequence & 0xFFFFFFFF,
                data=data,
            )
        self._sequence += 1

    def flush(self, sync: bool = True) -> None:
        """End the chunk and give everything to the system, which keeps it if this process is killed; with
        `sync` also put it on the disk, which keeps it if the machine is."""
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
            encodings = (SchemaEncoding.JSONSchema, MessageEncoding.JSON)
            if schema not in AS_JSON:
                encodings = (SchemaEncoding.Protobuf, MessageEncoding.Protobuf)
            if schema not in self._schema_ids:
                described = AS_JSON.get(schema)
                if described is None:
                    described = build_file_descriptor_set(message_class).SerializeToString(deterministic=True)
                self._schema_ids[schema] = self._writer.register_schema(schema, encodings[0], described)
            self._channel_ids[topic] = self._writer.register_channel(
                topic, encodings[1], self._schema_ids[schema]
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
            mend = "free some space or choose another output folder"
            self._failure = OutputError(error.strerror or str(error), file=self._path, fix=mend)
            self._closed = True
            if hasattr(self, "_file"):
                with contextlib.suppress(OSError):
                    self._file.close()
            raise self._failure from error
