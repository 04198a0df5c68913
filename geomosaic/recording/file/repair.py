"""A whole MCAP file of what is whole in another: of a killed run, or a damaged one."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from mcap.records import Attachment, Channel, Header, Message, Metadata, Schema
from mcap.writer import CompressionType, Writer

from geomosaic.recording.file.mcapfile import items, opened
from geomosaic.recording.file.messagefile import CHUNK_BYTES
from geomosaic.recording.file.model import Recording


def repaired(recording: Recording, out: Path) -> int:
    """Writes everything of a recording that is whole, with summary and footer; returns how many messages.

    Times, numbers and bytes of messages stay as they are. The recording itself isn't touched. Raises OSError
    where `out` can't be written.
    """
    messages = 0
    with opened(recording.path) as file, out.open("wb") as target:
        writer: Any = Writer(  # partly untyped
            target, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD, enable_data_crcs=True
        )
        schemas: dict[int, int] = {0: 0}
        channels: dict[int, int] = {}
        for item in items(recording.path, file):
            match item.record:
                case Header() as header:
                    writer.start(profile=header.profile, library=header.library)
                case Schema() as s if s.id not in schemas:
                    schemas[s.id] = writer.register_schema(s.name, s.encoding, s.data)
                case Channel() as c if c.id not in channels and c.schema_id in schemas:
                    channels[c.id] = writer.register_channel(
                        c.topic, c.message_encoding, schemas[c.schema_id], c.metadata
                    )
                case Message() as m if m.channel_id in channels:
                    writer.add_message(channels[m.channel_id], m.log_time, m.data, m.publish_time, m.sequence)
                    messages += 1
                case Metadata() as m:
                    writer.add_metadata(m.name, m.metadata)
                case Attachment() as a:
                    writer.add_attachment(a.create_time, a.log_time, a.name, a.media_type, a.data)
        writer.finish()
    return messages
