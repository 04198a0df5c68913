"""Reads a recording, also one whose run was killed."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from mcap.records import Attachment, Channel, Chunk, Header, Message, Metadata

from geomosaic.errors import FileError
from geomosaic.recording.file.frame_kinds import THUMBNAILS
from geomosaic.recording.file.kinds import KINDS
from geomosaic.recording.file.mcapfile import BROKEN, DAMAGED, FIX, Item, items, opened, stream, unpacked
from geomosaic.recording.file.messages import At
from geomosaic.recording.file.model import ArtefactEntry, Recording, Topic
from geomosaic.recording.file.plain import json_object
from geomosaic.recording.file.run_kinds import Artefact, StageEvent
from geomosaic.recording.file.writer import ENVIRONMENT, FORMAT, MANIFEST, PROFILE, RECIPE

MAX_KEPT_BYTES = 512 * 2**20
MOST_UNPACKED = 100
"""Times a recording's own size that its artefacts may take, plus 64 MiB; those of runs take 2 to 10."""
MOST_SHOWN = 80
"""The same of what a view takes: images hardly pack, tables do."""
_ALWAYS_BYTES = 64 * 2**20


def read_recording(path: Path, with_images: bool = False) -> Recording:
    """Reads a recording in one pass; of an unfinished or damaged file everything that is whole.

    Tie points, thumbnails, the artefacts' bytes and, unless asked for, all images stay in the file
    (`messages`, `artefact_data`).
    Raises FileError if the file can't be opened, is no MCAP, no recording of geomosaic, or larger than
    any run could make it.
    """
    recording, kept_bytes = Recording(path, with_images), 0
    most_kept = MOST_SHOWN * path.stat().st_size + _ALWAYS_BYTES if with_images else MAX_KEPT_BYTES
    with opened(path) as file:
        for item in items(path, file):
            _check_ours(path, item)
            kept_bytes += _kept_bytes(item, with_images)
            if kept_bytes > most_kept:
                problem = f"its figures and images take more than {most_kept} bytes"
                raise FileError(problem, file=path, fix=FIX)
            try:
                take(recording, item)
            except DAMAGED as error:
                item = Item(
                    item.offset, None, problem=f"a message behind byte {item.offset} is damaged ({error})"
                )
            if item.record is None and not recording.problem:
                recording.problem = printable(item.problem)
    most_bytes = MOST_UNPACKED * path.stat().st_size + _ALWAYS_BYTES
    if sum(a.total_bytes for a in recording.artefacts) > most_bytes:
        raise FileError(f"its artefacts would take more than {most_bytes} bytes", file=path, fix=FIX)
    recording.stages.sort(key=lambda stage: stage.index)
    return recording


def messages(path: Path, schema: str) -> Iterator[tuple[str, int, bytes]]:
    """Topic, log time in ns and bytes of every message of a schema, e.g. `foxglove.CompressedImage`."""
    with opened(path) as file:
        for item in items(path, file):
            if isinstance(item.record, Message) and item.schema == schema:
                yield item.topic, item.record.log_time, item.record.data


def recorded_images(path: Path, topic: str) -> Iterator[tuple[str, bytes]]:
    """Label and JPEG of every image of a topic, without the damaged ones."""
    for at, _, data in messages(path, CompressedImage.DESCRIPTOR.full_name):
        if at == topic:
            with suppress(*BROKEN):
                message = CompressedImage.FromString(data)
                yield message.frame_id, message.data


def stage_messages(recording: Recording, stage_index: int) -> Iterator[tuple[str, str, bytes, bool]]:
    """All that a stage recorded, for `Recorder.copy`: topic, schema, bytes, and whether the time is that of
    an exposure. No events, no artefacts.

    Raises FileError where its beginning and end can't be found.
    """
    now = -1
    with opened(recording.path) as file:
        for item in items(recording.path, file):
            if not isinstance(item.record, Message) or item.schema == "geomosaic.Artefact":
                continue
            if item.schema == "geomosaic.StageEvent":
                try:
                    event = StageEvent.FromString(item.record.data)
                except BROKEN as error:
                    text = "what its stages recorded is damaged"
                    raise FileError(text, file=recording.path, fix="run the recipe again") from error
                now = -1 if event.finished else event.stage_index
            elif now == stage_index:
                captured = item.record.publish_time != item.record.log_time
                yield item.topic, item.schema, item.record.data, captured


def artefact_data(recording: Recording, entry: ArtefactEntry) -> bytes:
    """The bytes of an artefact. Raises FileError if a part is missing or the size is not as said."""
    data = bytearray()
    with opened(recording.path) as file:
        for part, (offset, number) in enumerate(entry.found):
            try:
                chunk = next(stream(file, offset))
                for record in unpacked(chunk) if isinstance(chunk, Chunk) else ():
                    if isinstance(record, Message) and record.sequence == number:
                        message = Artefact.FromString(record.data)
                        if (message.name, message.part) == (entry.name, part):
                            data += message.data
                            if len(data) > entry.total_bytes:
                                raise ValueError("it is longer than it says")
            except BROKEN as error:
                text = f"artefact '{printable(entry.name)}' is damaged ({printable(str(error))})"
                raise FileError(text, file=recording.path, fix="run again") from error
    if not entry.complete or len(data) != entry.total_bytes:
        raise FileError(
            f"artefact '{printable(entry.name)}' of stage {printable(entry.stage_id)} is incomplete",
            file=recording.path,
            fix="replay from an earlier stage, or run again",
        )
    return bytes(data)


def printable(text: str) -> str:
    """A stranger's text on one line, without the control characters a terminal would obey."""
    return "".join(c if c.isprintable() else " " for c in text)


def _check_ours(path: Path, item: Item) -> None:
    if isinstance(item.record, Header) and item.record.profile != PROFILE:
        raise FileError("this MCAP is no recording of geomosaic", file=path, fix=FIX)
    if isinstance(item.record, Metadata) and item.record.name == PROFILE:
        written = item.record.metadata.get("format", "unknown")
        if written != FORMAT:
            raise FileError(
                f"a recording of format {printable(written)}, while this version reads {FORMAT}",
                file=path,
                fix="read it with the geomosaic that wrote it",
            )


def _kept_bytes(item: Item, with_images: bool) -> int:
    """About how much memory an item will take for good."""
    if isinstance(item.record, Message):
        kind = KINDS.get(item.schema)
        once = kind is None or kind.take is None or item.schema == "geomosaic.Progress"
        if item.schema == CompressedImage.DESCRIPTOR.full_name:
            return len(item.record.data) if with_images and item.topic != THUMBNAILS else 0
        whole = 0 if item.schema == "geomosaic.Artefact" else len(item.record.data)
        return 0 if once else 256 + 4 * whole
    return 1024 if isinstance(item.record, Channel) else 0


def take(recording: Recording, item: Item) -> None:
    """Adds a record of its file to what is known of a recording. Raises of `DAMAGED`."""
    record = item.record
    if isinstance(record, Channel):
        recording.topics.setdefault(item.topic, Topic(item.topic, item.schema))
    if isinstance(record, Attachment):
        _take_attachment(recording, record)
    if not isinstance(record, Message):
        return
    if not item.topic:
        raise ValueError("its channel is unknown")
    recording.topics[item.topic].messages += 1
    kind = KINDS.get(item.schema)
    if kind is not None and kind.take is not None:
        recording.last_ns = max(recording.last_ns, record.log_time)
        at = At(item.topic, record.log_time, record.sequence, item.offset)
        kind.take(recording, kind.of(record.data), at)


def _take_attachment(recording: Recording, attachment: Attachment) -> None:
    if attachment.name == RECIPE:
        recording.recipe_yaml = attachment.data.decode()
    elif attachment.name == ENVIRONMENT:
        recording.environment = json_object(attachment.data)
    elif attachment.name == MANIFEST:
        recording.manifest = json_object(attachment.data)
