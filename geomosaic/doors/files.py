"""The one way in for files of text: regular ones only, read once, within a budget, names and texts clean."""

from __future__ import annotations

import os
import re
import stat
from pathlib import Path
from typing import Final

from geomosaic.constants import tuned
from geomosaic.errors import FileError

RUN_MARKER: Final = ".geomosaic.json"
"""What every folder holds that geomosaic writes to: nothing in it is an input unless it is named."""
_LONGEST_PATH: Final = 255  # shown whole
_KINDS: Final = (
    (stat.S_ISDIR, "a folder"),
    (stat.S_ISFIFO, "a pipe"),
    (stat.S_ISSOCK, "a socket"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
)
_UNSAFE: Final = re.compile("[\x00-\x1f\x7f-\x9f\u2028-\u202e\u2066-\u2069\ud800-\udfff\ufffe\uffff]")
"""What XML, a terminal or a line can't hold: controls, turns of the writing's direction, surrogates."""


def printable(text: str, keep: str = "") -> str:
    """A text without what spoils a page, a terminal or a line; that becomes `%1B`, as in web addresses."""
    return _UNSAFE.sub(lambda m: m[0] if m[0] in keep else f"%{ord(m[0]):02X}", text)


def check_name(path: Path) -> None:
    """`FileError` for a path that isn't UTF-8: no result could name it."""
    try:
        str(path).encode()
    except UnicodeEncodeError as error:
        whole = os.fsencode(path).decode("utf-8", "backslashreplace")
        raise FileError("its name is not in UTF-8", file=whole, fix="rename it") from error


def mode_of(path: Path) -> int:
    """The mode of what lies under a name that may be anybody's. It is 0 where nothing does, where access is
    denied, and where no file can have such a name."""
    try:
        return path.stat().st_mode
    except (OSError, ValueError):
        return 0


def check_regular(path: Path, fix: str, named: str = "") -> None:
    """`FileError` for what is missing, or no regular file: a folder, a device or a pipe, which may never end.

    Args: named says in the message where the path stands.
    """
    check_name(path)
    text = str(path)
    file = text if len(text) <= _LONGEST_PATH else f"{text[:_LONGEST_PATH]}..."
    try:
        mode = path.stat().st_mode
    except (FileNotFoundError, NotADirectoryError) as error:
        raise FileError(f"there is no such file{named}", file=file, fix=fix) from error
    except OSError as error:
        raise FileError(f"can't be read ({error.strerror}){named}", file=file, fix=fix) from error
    except ValueError as error:
        raise FileError(f"no file can have such a name{named}", file=printable(file), fix=fix) from error
    if not stat.S_ISREG(mode):
        kind = next((kind for is_kind, kind in _KINDS if is_kind(mode)), "something else")
        fix = "write what it gives to a file first" if stat.S_ISFIFO(mode) else fix
        raise FileError(f"is no regular file but {kind}{named}", file=file, fix=fix)


MOST_PARTS = tuned(20_000, "parts", "tags, points, characters of a line; more takes time and memory")
PIECE_BYTES = tuned(8 << 20, "bytes", "read at once: less takes more requests; more delays a stop")
SHORT_BYTES = tuned(1 << 20, "bytes", "of XMP, an RPC or a projection, which have some kB; more takes time")
TEXT_BYTES = tuned(128 << 20, "bytes", "of a file read whole: a large block's table; more fills the memory")


def read_bytes(path: Path, most_bytes: int, kind: str, fix: str) -> bytes:
    """A regular file's content, read once and without waiting.

    Args: kind: what it is to be, as in `is too large for a camera file`.
    Raises: `FileError` where it is missing, empty, larger than most_bytes, or can't be read. The same for
    files that the system makes up (/proc), whose size is not that of their content.
    """
    path = Path(path)
    check_regular(path, fix)
    try:
        handle = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC)
        with os.fdopen(handle, "rb") as file:
            status = os.fstat(handle)
            readable = stat.S_ISREG(status.st_mode) and status.st_size <= most_bytes
            content = file.read(most_bytes + 1) or b"" if readable else b""
    except OSError as error:
        raise FileError(f"can't be read ({error.strerror})", file=path, fix=fix) from error
    if max(len(content), status.st_size) > most_bytes:
        size = f"{most_bytes >> 20} MB" if most_bytes >= 1 << 20 else f"{most_bytes >> 10} kB"
        raise FileError(f"is too large for {kind}: more than {size}", file=path, fix="is it the right file?")
    if len(content) != status.st_size or not stat.S_ISREG(status.st_mode):
        raise FileError("changes while it is read", file=path, fix="copy what it gives to a file first")
    if not content:
        raise FileError("is empty", file=path, fix=fix)
    return content


def read_text(path: Path, most_bytes: int, kind: str, fix: str) -> str:
    """A text file's content: UTF-8 or UTF-16 with or without a mark, else Latin-1, `printable` line by line.

    Raises: as `read_bytes`, and `FileError` for what holds zero bytes.
    """
    return decoded(read_bytes(path, most_bytes, kind, fix), path, fix)


def decoded(content: bytes, path: Path, fix: str) -> str:
    """Bytes as `read_text` gives them; path is for the message."""
    try:
        text = content.decode("utf-16" if content[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig")
    except UnicodeDecodeError:
        text = content.decode("latin-1")
    if "\x00" in text:
        raise FileError("is no text file", file=path, fix=fix)
    return printable(text, keep="\t\n\r")
