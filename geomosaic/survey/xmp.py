"""XMP: the packet a drone writes into an image, as flat names and texts."""

from __future__ import annotations

import math
import re
from typing import Final
from xml.etree.ElementTree import Element, ParseError

from defusedxml.common import DefusedXmlException
from defusedxml.ElementTree import fromstring

from geomosaic.constants import tuned
from geomosaic.doors.files import MOST_PARTS, SHORT_BYTES, printable
from geomosaic.survey.exif_tags import LONGEST_BYTES

Xmp = dict[str, str]
"""Texts by `room:Name`, whatever prefix the file uses: rooms are `drone-dji`, `drone-parrot`,
`sensefly`, `FLIR`, `Camera` (Pix4D's, also used by Parrot, MicaSense and senseFly), `DLS`, else the
namespace's last word."""

_OPENINGS: Final = tuple(re.compile(rb"<((?:\w{1,40}:)?%s)[\s/>]" % name) for name in (b"xmpmeta", b"RDF"))
_LONG_NAMESPACE: Final = re.compile(rb"xmlns(?::[\w.-]{1,40})?\s{0,9}=\s{0,9}[\"'][^\"']{300}")
_NUMBER: Final = re.compile(r"([-+]?(?:\d+(?:\.\d+)?|\.\d+)(?:[eE][-+]?\d+)?)(?:/(\d+))?", re.ASCII)
_UNCLOSED: Final = re.compile(rb"(=\"[^\"<>]{0,300}\")(\s{0,9}<[A-Za-z])")
"""An attribute, then the next tag: the mark between them is missing in packets of FLIR's Vue Pro R."""
_MOST_PREFIXES = tuned(100, "prefixes", "of a packet: far more than programs write; each is declared")
_RDF: Final = "http://www.w3.org/1999/02/22-rdf-syntax-ns#"


def parse_xmp(data: bytes) -> Xmp | None:
    """The properties of the XMP packets in some bytes, of a repeated one the first: {} without a packet, None
    if one is unreadable. Programs that edit an image may add a packet to the camera's.

    Simple properties count, written as attributes or as elements; an ordered list as its items between
    commas, of other lists the first item. Prefixes
    that the packet uses but never declares (seen in drones' firmware) are declared for it, and a start tag
    that is never closed (FLIR's Vue Pro R) is closed.
    """
    found: Xmp = {}
    rest = data[:SHORT_BYTES]
    while (at := _packet(rest)) is not None:
        packet, rest = rest[at], rest[at.stop :]
        if packet.count(b"<") > MOST_PARTS or _LONG_NAMESPACE.search(packet):
            return None
        root = _root(packet)
        if root is None:
            root = _root(_UNCLOSED.sub(rb"\1>\2", packet))
        if root is None:
            return None
        for description in root.iter(f"{{{_RDF}}}Description"):
            for name, value in description.attrib.items():
                found.setdefault(_flat(name), printable(value.strip()))
            for child in description:
                found.setdefault(_flat(child.tag), _text(child))
    return found


def _root(packet: bytes) -> Element | None:
    """The packet's tree; None where it can't be read."""
    try:
        return fromstring(_declared(packet), forbid_dtd=True)
    except (ParseError, DefusedXmlException, ValueError, LookupError):
        return None


def _packet(data: bytes) -> slice | None:
    """From the first opening mark to its end mark; each is looked for once, whatever else stands there."""
    for opening in _OPENINGS:
        if start := opening.search(data):
            end = data.find(b"</" + start[1], start.end())
            close = data.find(b">", end)
            if min(end, close) > 0:
                return slice(start.start(), close + 1)
    return None


def number(xmp: Xmp, *names: str) -> float | None:
    """The first of some properties that is a finite number (`+12.5`, or a fraction `25/2`)."""
    for name in names:
        text = xmp.get(name, "")
        match = _NUMBER.fullmatch(text) if len(text) <= LONGEST_BYTES else None
        if match and float(match[2] or 1):
            value = float(match[1]) / float(match[2] or 1)
            if math.isfinite(value):
                return value
    return None


def numbers(xmp: Xmp, name: str, count: int) -> tuple[float, ...] | None:
    """A property of so many finite numbers between commas."""
    found = [number({name: field.strip()}, name) for field in xmp.get(name, "").split(",", count)]
    values = tuple(value for value in found if value is not None)
    return values if len(values) == len(found) == count else None


def _declared(packet: bytes) -> bytes:
    used = set(re.findall(rb"[<\s]([A-Za-z][\w.-]*):[A-Za-z][\w.-]*(?=[\s=>/])", packet))
    if len(used) > _MOST_PREFIXES:
        raise ValueError("too many prefixes")
    missing = used - {b"xml", b"xmlns", *re.findall(rb"xmlns:([\w.-]+)=", packet)}
    known = {b"rdf": _RDF.encode(), b"x": b"adobe:ns:meta/"}
    extra = b"".join(b' xmlns:%s="%s"' % (p, known.get(p, b"urn:" + p)) for p in sorted(missing))
    return re.sub(rb"^<[\w:.-]+", lambda m: m[0] + extra, packet, count=1)


def _flat(name: str) -> str:
    uri, _, local = name.removeprefix("{").rpartition("}")
    for pattern, room in (
        (r"drone-dji", "drone-dji"),
        (r"drone-parrot", "drone-parrot"),
        (r"[/:]camera\b(?!-)", "Camera"),
        (r"sensefly", "sensefly"),
        (r"\bflir\b", "FLIR"),
        (r"[/:]dls\b", "DLS"),
        (r"[/:]drone\b(?!-)", "drone-dji"),  # Autel's newer firmware
    ):
        if re.search(pattern, uri, re.IGNORECASE):
            return f"{room}:{local}"
    words = [w for w in re.split(r"[/:#]", uri) if w and not re.fullmatch(r"[\d.]+", w)]
    return f"{words[-1] if words else ''}:{local}"


def _text(element: Element) -> str:
    ordered = [(i.text or "").strip() for i in element.iterfind(f"{{{_RDF}}}Seq/{{{_RDF}}}li")]
    if ordered:
        return printable(",".join(ordered))
    item = next(element.iter(f"{{{_RDF}}}li"), element)
    return printable((item.text or "").strip())
