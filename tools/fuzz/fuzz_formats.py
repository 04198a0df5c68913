"""Spoiling by structure what is binary: TIFF and EXIF tags, JPEG segments, PNG chunks, MCAP messages."""

from __future__ import annotations

import io
import struct
import zipfile
from random import Random

from mcap.exceptions import McapError
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from tools.fuzz.fuzz_mutations import LENGTHS, Mutate, Nasty, repeated, some_bytes
from tools.fuzz.fuzz_trees import a_json, an_xml

_SIZES = {1: 1, 2: 1, 3: 2, 4: 4, 5: 8, 6: 1, 7: 1, 8: 2, 9: 4, 10: 8, 11: 4, 12: 8, 13: 4}
_POINTERS = {0x8769, 0x8825, 0x014A}  # Exif, GPS and sub directories


def mostly(structure: Mutate, share: float = 0.75) -> Mutate:
    """By structure in this share of the cases, by bytes in the others."""

    def mutate(data: bytes, rng: Random, nasty: Nasty) -> tuple[bytes, str]:
        if rng.random() < share:
            try:
                return structure(data, rng, nasty)
            except Exception:  # after an earlier spoiling there may be no structure to go by
                pass
        return some_bytes(data, rng, nasty)

    return mutate


def _entries(data: bytes, base: int) -> tuple[str, list[int]]:
    """Byte order, and where the 12 bytes of each directory entry begin, of a classic TIFF at `base`."""
    order = "<" if data[base : base + 2] == b"II" else ">"
    found: list[int] = []
    waiting, seen = [struct.unpack_from(order + "I", data, base + 4)[0]], set()
    while waiting and len(found) < 4000:
        at = base + waiting.pop()
        if at in seen or at + 2 > len(data):
            continue
        seen.add(at)
        (count,) = struct.unpack_from(order + "H", data, at)
        for i in range(min(count, 200)):
            entry = at + 2 + 12 * i
            if entry + 12 > len(data):
                break
            found.append(entry)
            tag, _, _, value = struct.unpack_from(order + "HHII", data, entry)
            if tag in _POINTERS:
                waiting.append(value)
        after = at + 2 + 12 * count
        if after + 4 <= len(data):
            (following,) = struct.unpack_from(order + "I", data, after)
            if following:
                waiting.append(following)
    return order, found


def tiff_tags(data: bytes, rng: Random, nasty: Nasty, base: int = 0) -> tuple[bytes, str]:
    """A tag's number, type, count, value, or the numbers it points to."""
    order, entries = _entries(data, base)
    if not entries:
        raise ValueError("no TIFF")
    out = bytearray(data)
    at = rng.choice(entries)
    tag, kind, count, value = struct.unpack_from(order + "HHII", data, at)
    what = f"tag {tag:#06x}"
    match rng.randrange(6):
        case 0:
            new = rng.choice((0, 1, 2, 3, 4, 5, 7, 10, 12, 13, 16, 99, 0xFFFF))
            struct.pack_into(order + "H", out, at + 2, new)
            return bytes(out), f"{what}: type {kind} -> {new}"
        case 1:
            new = rng.choice(LENGTHS)
            struct.pack_into(order + "I", out, at + 4, new)
            return bytes(out), f"{what}: count {count} -> {new}"
        case 2:
            new = rng.randrange(0x10000)
            struct.pack_into(order + "H", out, at, new)
            return bytes(out), f"{what} -> {new:#06x}"
        case 3:
            other = rng.choice(entries)
            out[at + 8 : at + 12] = data[other + 8 : other + 12]
            return bytes(out), f"{what}: the value of another"
    size = _SIZES.get(kind, 1) * count
    there = at + 8 if size <= 4 else base + value
    if not 0 <= there <= len(out) - max(size, 1):
        raise ValueError("points outside")
    step = {5: 4, 10: 4, 12: 8}.get(kind, max(1, _SIZES.get(kind, 1)))
    place = there + step * rng.randrange(max(1, size // step))
    if kind == 2 or step == 1:
        token = (nasty.word(rng) if rng.random() < 0.5 else rng.randbytes(size))[:size]
        out[there : there + len(token)] = token
        return bytes(out), f"{what}: text {token[:30]!r}"
    if kind == 12:
        number = rng.choice((0.0, -1.0, 1e308, float("nan"), float("inf"), 5e-324, 1e7))
        struct.pack_into(order + "d", out, place, number)
        return bytes(out), f"{what}: {number} at {place}"
    limit = 1 << 8 * min(step, 4)
    number = rng.choice((*LENGTHS, rng.randrange(limit))) % limit
    struct.pack_into(order + {2: "H", 4: "I"}[min(step, 4)], out, place, number)
    return bytes(out), f"{what}: {number} at {place}"


def _segments(data: bytes) -> list[tuple[int, int, int]]:
    """(marker, where it begins, where it ends) of a JPEG up to the entropy data."""
    found, at = [], 2
    while at + 4 <= len(data) and data[at] == 0xFF:
        marker = data[at + 1]
        end = at + 2 + int.from_bytes(data[at + 2 : at + 4], "big")
        found.append((marker, at, end))
        if marker == 0xDA:
            break
        at = end
    return found


def exif_tags(data: bytes, rng: Random, nasty: Nasty) -> tuple[bytes, str]:
    """A tag of a JPEG's EXIF."""
    at = data.index(b"Exif\0\0")
    return tiff_tags(data, rng, nasty, at + 6)


def xmp_packet(data: bytes, rng: Random, nasty: Nasty) -> tuple[bytes, str]:
    """A JPEG's XMP, its segment's length put right."""
    for marker, at, end in _segments(data):
        start = data.find(b"<", at, end)
        if marker == 0xE1 and start >= 0 and b"xap" in data[at:start]:
            packet, what = an_xml(data[start:end], rng, nasty)
            packet = packet[: 65_500 - (start - at)]
            head = (
                data[at : at + 2] + (start - at - 2 + len(packet)).to_bytes(2, "big") + data[at + 4 : start]
            )
            return data[:at] + head + packet + data[end:], what
    raise ValueError("no XMP")


def jpeg_segments(data: bytes, rng: Random, nasty: Nasty) -> tuple[bytes, str]:
    """Sizes in the header, lengths of segments, segments twice, gone, out of order, a hundred times."""
    found = _segments(data)
    marker, at, end = rng.choice(found)
    match rng.randrange(7):
        case 0:
            frame = next(s for s in found if s[0] in (0xC0, 0xC1, 0xC2))
            where, new = (
                rng.choice(((5, 2), (7, 2), (4, 1), (9, 1))),
                rng.choice((0, 1, 7, 33, 40_000, 65_535)),
            )
            out = bytearray(data)
            out[frame[1] + where[0] : frame[1] + sum(where)] = (new % (1 << 8 * where[1])).to_bytes(
                where[1], "big"
            )
            return bytes(out), f"frame header at {where[0]} = {new}"
        case 1:
            new = rng.choice((0, 1, 2, 3, 0xFFFF, rng.randrange(0x10000)))
            return data[: at + 2] + new.to_bytes(2, "big") + data[
                at + 4 :
            ], f"marker {marker:#x}: length {new}"
        case 2:
            return data[:at] + data[end:], f"marker {marker:#x} taken out"
        case 3:
            times = rng.choice((1, 2, 100, 1000))
            return data[:at] + repeated(data[at:end], times) + data[
                at:
            ], f"marker {marker:#x} {times} times more"
        case 4:
            other = rng.choice(found)
            return data[:at] + data[other[1] : other[2]] + data[end:], f"marker {other[0]:#x} for {marker:#x}"
        case 5:
            new = rng.choice((0xC2, 0xC3, 0xC9, 0xCA, 0xD9, 0xDA, 0xE1, 0xFE, 0x00))
            return data[: at + 1] + bytes([new]) + data[at + 2 :], f"marker {marker:#x} -> {new:#x}"
        case _:
            body = rng.randbytes(rng.choice((0, 10, 65_000)))
            new_segment = b"\xff\xe1" + (len(body) + 2).to_bytes(2, "big") + body
            return data[:at] + new_segment * rng.choice((1, 50)) + data[at:], "foreign APP1 put in"


def jpeg_entropy(data: bytes, rng: Random, nasty: Nasty) -> tuple[bytes, str]:
    """The image itself: zeroed, cut, flipped, spliced, markers in it; the end marker kept or not."""
    start = next(end for marker, _, end in _segments(data) if marker == 0xDA)
    stop = data.rfind(b"\xff\xd9")
    stop = stop if stop > start else len(data)
    body, tail = data[start:stop], data[stop:]
    at = rng.randrange(len(body))
    size = rng.randrange(1, max(2, len(body) - at))
    match rng.randrange(7):
        case 0:
            body, what = body[:at] + bytes(len(body) - at), f"zero from {at} of {len(body)}"
        case 1:
            body, what = body[:at], f"cut at {at} of {len(body)}, end marker kept"
        case 2:
            body, what, tail = body[:at], f"cut at {at} of {len(body)}", b""
        case 3:
            spoiled = bytearray(body)
            for _ in range(rng.choice((1, 1, 10, 100))):
                spoiled[rng.randrange(len(spoiled))] ^= 1 << rng.randrange(8)
            body, what = bytes(spoiled), "bits flipped"
        case 4:
            body, what = body[:at] + body[at + size :], f"{size} bytes out at {at} of {len(body)}"
        case 5:
            mark = bytes([0xFF, rng.choice((0xD0, 0xD7, 0xD9, 0xC4, 0xDA, 0x01))])
            body, what = body[:at] + mark + body[at:], f"marker {mark.hex()} at {at} of {len(body)}"
        case _:
            body, what = body[:at] + rng.randbytes(size) + body[at + size :], f"{size} random bytes at {at}"
    return data[:start] + body + tail, what


def png_chunks(data: bytes, rng: Random, nasty: Nasty) -> tuple[bytes, str]:
    """A field of the header with its checksum put right, or a chunk's length."""
    import zlib

    out = bytearray(data)
    if rng.random() < 0.6:
        at = rng.choice((16, 20, 24, 25, 28))
        size = 4 if at < 24 else 1
        new = rng.choice((0, 1, 3, 16, 40_000, 0x7FFFFFFF, 0xFFFFFFFF)) % (1 << 8 * size)
        out[at : at + size] = new.to_bytes(size, "big")
        out[29:33] = zlib.crc32(bytes(out[12:29])).to_bytes(4, "big")
        return bytes(out), f"PNG header at {at} = {new}"
    at = data.index(b"IDAT") - 4
    out[at : at + 4] = rng.choice(LENGTHS).to_bytes(4, "big")
    return bytes(out), "PNG chunk's length"


def mcap_messages(data: bytes, rng: Random, nasty: Nasty) -> tuple[bytes, str]:
    """One message, attachment or name spoiled and the file written again whole, checksums and all."""
    try:
        reader = make_reader(io.BytesIO(data))
        messages = list(reader.iter_messages(log_time_order=False))
        attachments, metadata = list(reader.iter_attachments()), list(reader.iter_metadata())
    except McapError as error:
        raise ValueError(str(error)) from error
    out = io.BytesIO()
    writer = Writer(out, compression=CompressionType.ZSTD)
    writer.start(profile="geomosaic")
    kind, which = rng.random(), rng.randrange(max(1, len(messages)))
    named = rng.choice([a.name for a in attachments]) if attachments and kind < 0.3 else None
    what = ""
    channels: dict[int, int] = {}
    for attachment in attachments:
        body = attachment.data
        if attachment.name == named:
            body, what = a_json(body, rng, nasty)
            what = f"{named}: {what}"
        times = attachment.create_time, attachment.log_time
        writer.add_attachment(*times, attachment.name, attachment.media_type, body)
    for entry in metadata:
        writer.add_metadata(entry.name, entry.metadata)
    for i, (schema, channel, message) in enumerate(messages):
        if channel.id not in channels:
            schema_id = writer.register_schema(schema.name, schema.encoding, schema.data) if schema else 0
            channels[channel.id] = writer.register_channel(
                channel.topic, channel.message_encoding, schema_id, channel.metadata
            )
        body, count = message.data, 1
        if named is None and i == which:
            if kind < 0.85:
                body, what = some_bytes(body, rng, nasty)
            else:
                count = rng.choice((0, 2, 1000))
                what = f"{count} times"
            what = f"message {i} of {channel.topic}: {what}"
        for _ in range(count):
            writer.add_message(
                channels[channel.id], message.log_time, body, message.publish_time, message.sequence
            )
    writer.finish()
    return out.getvalue(), what


def artefact_parts(data: bytes, rng: Random, nasty: Nasty) -> tuple[bytes, str]:
    """The tree or an array of an artefact, its zip written again whole."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as file:
            parts = {name: file.read(name) for name in file.namelist()}
    except zipfile.BadZipFile as error:
        raise ValueError(str(error)) from error
    name = "tree.json" if rng.random() < 0.6 else rng.choice(list(parts))
    parts[name], what = (a_json if name == "tree.json" else some_bytes)(parts[name], rng, nasty)
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", rng.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED))) as file:
        for part, body in parts.items():
            file.writestr(zipfile.ZipInfo(part, (1980, 1, 1, 0, 0, 0)), body)
    return out.getvalue(), f"{name}: {what}"
