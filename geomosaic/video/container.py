"""Which files are videos, by their first bytes."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from geomosaic.errors import FileError

_HEAD_BYTES: Final = 4096
_STARTS: Final = (
    b"\x1a\x45\xdf\xa3",  # Matroska, WebM: EBML, RFC 8794
    b"\x00\x00\x01\xba",  # MPEG program stream: ISO/IEC 13818-1
    b"\x30\x26\xb2\x75\x8e\x66\xcf\x11",  # Windows Media: ASF, section 3.1
    b"FLV\x01",
)
_BOXES: Final = (b"ftyp", b"moov", b"mdat", b"wide", b"free", b"skip", b"pnot")
"""That MP4 and QuickTime files begin with: ISO/IEC 14496-12."""
_PACKETS: Final = ((188, 0), (192, 4))
"""Length of packets of MPEG transport streams and of those of AVCHD, and where the first 0x47 stands."""


def require_video(path: Path) -> None:
    """Refuses what is no video. Texts that name other files, such as playlists, would have these opened too.

    Raises: `FileError` for those, and for a file that cannot be read.
    """
    try:
        with path.open("rb") as file:
            head = file.read(_HEAD_BYTES)
    except OSError as error:
        reason = f"can't be read ({error.strerror or error})"
        raise FileError(reason, file=path, fix="give an MP4 or MOV file") from error
    riff = head[:4] == b"RIFF" and head[8:12] == b"AVI "
    stream = any(len(head) > 4 * n and head[at : 4 * n : n] == b"\x47" * 4 for n, at in _PACKETS)
    if not (riff or stream or head[4:8] in _BOXES or head.startswith(_STARTS)):
        raise FileError("is no video that can be read", file=path, fix="give an MP4 or MOV file")
