"""XMP: the packet a drone writes into a picture, as flat names and texts."""

from __future__ import annotations

import math
import re
from typing import Final
from xml.etree.ElementTree import Element, ParseError

from defusedxml.common import DefusedXmlException
from defusedxml.ElementTree import fromstring

Xmp = dict[str, str]
"""Texts by `room:Name`, whatever prefix the file uses: rooms are `drone-dji`, `drone-parrot`,
`sensefly`, `Camera` (Pix4D's, also used by Parrot, MicaSense and senseFly), `DLS`, else the namespace's
last word."""

_MAX_BYTES: Final = 1 << 20
_PACKET: Final = re.compile(
    rb"<(\w+:)?xmpmeta\b.*?</(\w+:)?xmpmeta\s*>|<rdf:RDF\b.*?</rdf:RDF\s*>", re.DOTALL
)
_RDF: Final = "http://www.w3.org/1999/02/22-rdf-syntax-ns#"


def parse_xmp(data: bytes) -> Xmp | None:
    """The properties of the first XMP packet in some bytes: {} without a packet, None if unreadable.

    Simple properties count, written as attributes or as elements; of a list the first item. Prefixes
    that the packet uses but never declares (seen in drones' firmware) are declared for it.
    """
    match = _PACKET.search(data[:_MAX_BYTES])
    if match is None:
        return {}
    try:
        root = fromstring(_declared(match[0]), forbid_dtd=True)
    except (ParseError, DefusedXmlException, ValueError, LookupError):
        return None
    found: Xmp = {}
    for description in root.iter(f"{{{_RDF}}}Description"):
        for name, value in description.attrib.items():
            found.setdefault(_flat(name), value.strip())
        for child in description:
            found.setdefault(_flat(child.tag), _text(child))
    return found


def number(xmp: Xmp, *names: str) -> float | None:
    """The first of some properties that is a finite number (`+12.5`, or a fraction `25/2`)."""
    for name in names:
        match = re.fullmatch(r"([-+]?\d*\.?\d+(?:[eE][-+]?\d+)?)(?:/(\d+))?", xmp.get(name, ""))
        if match and (match[2] is None or int(match[2])):
            value = float(match[1]) / float(match[2] or 1)
            if math.isfinite(value):
                return value
    return None


def _declared(packet: bytes) -> bytes:
    used = set(re.findall(rb"[<\s]([A-Za-z][\w.-]*):[A-Za-z][\w.-]*(?=[\s=>/])", packet))
    missing = {p for p in used if p not in (b"xml", b"xmlns") and b"xmlns:" + p + b"=" not in packet}
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
        (r"[/:]dls\b", "DLS"),
    ):
        if re.search(pattern, uri, re.IGNORECASE):
            return f"{room}:{local}"
    words = [w for w in re.split(r"[/:#]", uri) if w and not re.fullmatch(r"[\d.]+", w)]
    return f"{words[-1] if words else ''}:{local}"


def _text(element: Element) -> str:
    item = next(element.iter(f"{{{_RDF}}}li"), element)
    return (item.text or "").strip()
