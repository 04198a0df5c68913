"""Spoiled recordings: artefacts whose values are spoiled and whose fingerprints are right none the less."""

from __future__ import annotations

import io
import zipfile
from random import Random

import numpy as np
from mcap.exceptions import McapError
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from geomosaic.recording.file.fingerprints import artefact_fingerprint, fingerprint_of_bytes
from geomosaic.recording.file.run_kinds import Artefact, StageEvent
from tools.fuzz.fuzz_formats import artefact_parts, mcap_messages
from tools.fuzz.fuzz_mutations import Nasty

NUMBERS = (0.0, -1.0, 1e-300, 1e9, 1e300, np.nan, np.inf, -np.inf, 2**31, -(2**31))


def a_recording(data: bytes, rng: Random, nasty: Nasty) -> tuple[bytes, str]:
    """Half of the time a message, an attachment or a name; else an artefact's parts or values."""
    return mcap_messages(data, rng, nasty) if rng.random() < 0.5 else an_artefact(data, rng, nasty)


def an_artefact(data: bytes, rng: Random, nasty: Nasty) -> tuple[bytes, str]:
    """One artefact of one part spoiled, under a fingerprint that fits it; the file written again whole."""
    try:
        reader = make_reader(io.BytesIO(data))
        messages = list(reader.iter_messages(log_time_order=False))
        attachments, metadata = list(reader.iter_attachments()), list(reader.iter_metadata())
    except McapError as error:
        raise ValueError(str(error)) from error
    kinds = [schema.name if schema else "" for schema, _, _ in messages]
    artefacts = {
        i: Artefact.FromString(messages[i][2].data) for i, k in enumerate(kinds) if k.endswith("Artefact")
    }
    which = rng.choice([i for i, a in artefacts.items() if a.parts == 1] or [-1])
    if which < 0:
        raise ValueError("no artefact of one part")
    spoiled = artefacts[which]
    change = some_values if rng.random() < 0.6 else artefact_parts
    spoiled.data, what = change(spoiled.data, rng, nasty)
    spoiled.total_bytes = len(spoiled.data)
    events = [
        StageEvent.FromString(m.data)
        for k, (_, _, m) in zip(kinds, messages, strict=True)
        if k.endswith("Event")
    ]
    old = spoiled.fingerprint
    for event in events:
        if event.finished and event.stage_index == spoiled.stage_index and rng.random() < 0.9:
            written = {f.name: f.fingerprint for f in event.written}
            content = fingerprint_of_bytes(spoiled.data)
            spoiled.fingerprint = artefact_fingerprint(content, written, event.lineage)
    out = io.BytesIO()
    writer = Writer(out, compression=CompressionType.ZSTD)
    writer.start(profile="geomosaic")
    for a in attachments:
        writer.add_attachment(a.create_time, a.log_time, a.name, a.media_type, a.data)
    for entry in metadata:
        writer.add_metadata(entry.name, entry.metadata)
    channels: dict[int, int] = {}
    for i, (schema, channel, message) in enumerate(messages):
        if channel.id not in channels:
            schema_id = writer.register_schema(schema.name, schema.encoding, schema.data) if schema else 0
            channels[channel.id] = writer.register_channel(
                channel.topic, channel.message_encoding, schema_id, channel.metadata
            )
        body = spoiled.SerializeToString() if i == which else message.data
        if kinds[i].endswith("Event"):  # what names the artefact goes with it
            body = body.replace(old.encode(), spoiled.fingerprint.encode())
        times = message.log_time, body, message.publish_time, message.sequence
        writer.add_message(channels[channel.id], *times)
    writer.finish()
    return out.getvalue(), f"{spoiled.name}: {what}"


def some_values(data: bytes, rng: Random, nasty: Nasty) -> tuple[bytes, str]:
    """Some numbers of one array become odd ones; all else is as it was."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as file:
            parts = {name: file.read(name) for name in file.namelist()}
        arrays = {n: np.load(io.BytesIO(body)) for n, body in parts.items() if n != "tree.json"}
    except (zipfile.BadZipFile, ValueError) as error:
        raise ValueError(str(error)) from error
    kept = {n: a for n, a in arrays.items() if a.size and a.dtype.kind in "iuf"}
    if not kept:
        return artefact_parts(data, rng, nasty)
    name = rng.choice(sorted(kept))
    array = kept[name].copy()
    value = rng.choice(NUMBERS)
    share = rng.choice((0.0, 0.01, 1.0))
    at = [rng.randrange(array.size) for _ in range(max(1, min(int(share * array.size), 10_000)))]
    with np.errstate(all="ignore"):
        array.reshape(-1)[at] = (
            np.array([value]).astype(array.dtype)[0] if share < 1.0 else np.roll(array, 1).reshape(-1)[at]
        )
    body = io.BytesIO()
    np.lib.format.write_array(body, array, version=(1, 0))
    parts[name] = body.getvalue()
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_STORED) as file:
        for part, content in parts.items():
            file.writestr(zipfile.ZipInfo(part, (1980, 1, 1, 0, 0, 0)), content)
    return out.getvalue(), f"array {name} {array.shape}: {len(at)} values {value}"
