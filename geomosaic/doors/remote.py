"""The one door to files on other machines: their size and version, and their bytes as they are.

Everything goes through GDAL's file systems, with its own credentials and proxies from the environment, and
nothing is decoded. GDAL's bolt (`doors.offline`) stays shut for every other name: it is opened for one file
at a time, in the thread that reads it.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Generator, Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, Final
from urllib.parse import urljoin, urlsplit

from geomosaic.constants import tuned
from geomosaic.doors.addresses import Address, file_name
from geomosaic.doors.bindings import gdal
from geomosaic.doors.files import PIECE_BYTES, printable
from geomosaic.doors.gdal_failures import gdal_options
from geomosaic.errors import CancelledError, GeomosaicError, InputError

MOST_FILES = tuned(100_000, "files", "of a survey, which has thousands: more is a whole store by mistake")
_TRIES = tuned(4, "connections", "for a file: fewer give up at an interruption; more hide a broken server")
_HTTP: Final = {
    "GDAL_HTTP_CONNECTTIMEOUT": "10",
    "GDAL_HTTP_LOW_SPEED_LIMIT": "1000",
    "GDAL_HTTP_LOW_SPEED_TIME": "30",
    "GDAL_HTTP_TIMEOUT": "900",
    "GDAL_HTTP_MAX_RETRY": "3",
    "GDAL_HTTP_RETRY_DELAY": "1",
}
"""Limits unless the environment says otherwise, in seconds and bytes a second. A request ends after 10 s
without a connection, 30 s below 1 kB/s, or 900 s for 8 MB. Errors that pass (HTTP 429, 502 to 504) are tried
3 times again, first after about 1 s, then later and later."""
_PAGE: Final = re.compile(rb"(\xef\xbb\xbf)?\s*(<|\{)")
_WEB_PAGE: Final = re.compile(rb"(\xef\xbb\xbf)?\s*<(!doctype\s+html|html)\b", re.IGNORECASE)
_IMAGES: Final = {".jpg": "JPEG", ".jpeg": "JPEG", ".tif": "TIFF", ".tiff": "TIFF", ".png": "PNG"}


@dataclass(frozen=True)
class Remote:
    """A file as its server tells of it; changed_s (since 1970) is 0 and tag '' where it doesn't say."""

    address: Address
    size_bytes: int
    changed_s: int
    tag: str

    def is_same(self, size_bytes: object, changed_s: object, tag: object) -> bool:
        """Whether the server reports the same version again; the tag is surer than the time."""
        known = tag == self.tag if self.tag and tag else changed_s == self.changed_s
        return size_bytes == self.size_bytes and known


def listed(folder: Address) -> tuple[list[Remote], list[str]]:
    """The files in a folder of an object store, and the names of the folders in it, which aren't entered.

    Raises: `InputError` if it can't be listed or holds more than `MOST_FILES`.
    """
    files: list[Remote] = []
    folders: list[str] = []
    base = folder.vsi.rstrip("/")
    gdal.VSICurlPartialClearCache(base)
    with _opened(base, folder.text):
        handle = gdal.OpenDir(base, 0)
        if handle is None:
            problem = f"can't be listed ({_said() or 'no such folder, no right to it, or no answer'})"
            raise InputError(problem, file=folder.text, fix="check the address and the store's credentials")
        try:
            while (entry := gdal.GetNextDirEntry(handle)) is not None:
                if entry.IsDirectory():
                    folders.append(printable(entry.name))
                    continue
                if len(files) == MOST_FILES:
                    fix = "give a folder of the store that holds one survey"
                    raise InputError(f"holds more than {MOST_FILES:,} files", file=folder.text, fix=fix)
                text = f"{folder.text.rstrip('/')}/{entry.name}"
                address = Address(printable(text), f"{base}/{entry.name}", file_name(entry.name, text))
                tag = _plain_tag(entry.extra.get("ETag", ""))
                files.append(Remote(address, entry.size, max(0, entry.mtime), tag))
        finally:
            gdal.CloseDir(handle)
    return files, folders


def look(address: Address) -> Remote:
    """What a file's server tells of it now.

    Raises: `InputError` if it isn't there or isn't given, has no size, or is led to on another machine.
    """
    gdal.VSICurlPartialClearCache(address.vsi)
    with _opened(address.vsi, address.text):
        headers = {k.lower(): v for k, v in (gdal.GetFileMetadata(address.vsi, "HEADERS") or {}).items()}
        flags = gdal.VSI_STAT_EXISTS_FLAG | gdal.VSI_STAT_SIZE_FLAG | gdal.VSI_STAT_SET_ERROR_FLAG
        status = gdal.VSIStatL(address.vsi, flags)
        if "location" in headers:
            _check_redirect(address, headers["location"])
        if status is None:
            raise _not_given(address)
    if status.size <= 0:
        problem = "is empty, or its server does not state its size"
        raise InputError(problem, file=address.text, fix="check the address")
    return Remote(address, status.size, max(0, status.mtime), _plain_tag(headers.get("etag", "")))


def copy(remote: Remote, to: BinaryIO, stopped: Callable[[], bool]) -> None:
    """Writes a file's bytes as they are; where they break off, they are asked for again from there.

    Raises: `InputError` if they can't be had, are fewer than announced, changed meanwhile, or are a page
    where an image should be; `CancelledError` once stopped says so.
    """
    address, done, tries = remote.address, 0, 0
    while done < remote.size_bytes:
        if tries == _TRIES:
            problem = f"breaks off after {done:,} of {remote.size_bytes:,} bytes"
            raise InputError(problem, file=address.text, fix="fetch again: what is there already stays")
        if tries:
            gdal.VSICurlPartialClearCache(address.vsi)
        with closing(_pieces(remote, done)) as pieces:
            for piece in pieces:
                if not done:
                    _check_kind(address, piece[:1024])
                if stopped():
                    raise CancelledError
                to.write(piece)
                done += len(piece)
        tries += 1
    if tries > 1 or remote.size_bytes > PIECE_BYTES:
        now = look(address)
        if not remote.is_same(now.size_bytes, now.changed_s, now.tag):
            fix = "fetch again once it is whole"
            raise InputError("changes while it is fetched", file=address.text, fix=fix)


def store(path: Path, to: Address) -> int:
    """Writes a file's bytes under an address of an object store; returns their number.

    Raises: `InputError` where the store refuses, or has another size of it afterwards.
    """
    size_bytes = path.stat().st_size
    with _opened(to.vsi, to.text), path.open("rb") as file:
        try:
            _write(file, to.vsi)
        except RuntimeError as error:
            fix = "check the address, the right to write there, and the store's credentials"
            problem = f"can't be written ({_shown(str(error)) or 'no answer'})"
            raise InputError(problem, file=to.text, fix=fix) from error
    if size_bytes and look(to).size_bytes != size_bytes:
        raise InputError("arrived with another size", file=to.text, fix="push again")
    return size_bytes


def withdraw(from_: Address) -> None:
    """Deletes a file under an address of an object store, if there is one and the store lets us."""
    gdal.VSICurlPartialClearCache(from_.vsi)
    with _opened(from_.vsi, from_.text), suppress(RuntimeError):
        gdal.Unlink(from_.vsi)


def _write(file: BinaryIO, name: str) -> None:
    """All that is left of a file under GDAL's name. Raises: `RuntimeError`."""
    handle = gdal.VSIFOpenExL(name, "wb", True)
    if handle is None:
        raise RuntimeError(gdal.VSIGetLastErrorMsg())
    whole = True
    try:
        while piece := file.read(PIECE_BYTES):
            whole &= gdal.VSIFWriteL(piece, 1, len(piece), handle) == len(piece)
    finally:
        whole &= gdal.VSIFCloseL(handle) == 0
    if not whole:
        raise RuntimeError(gdal.VSIGetLastErrorMsg())


def _pieces(remote: Remote, start: int) -> Generator[bytes, None, None]:
    """A file's bytes from a place on, as far as they come."""
    address, at = remote.address, start
    with _opened(address.vsi, address.text):
        handle = gdal.VSIFOpenExL(address.vsi, "rb", True)
        if handle is None:
            raise _not_given(address)
        try:
            gdal.VSIFSeekL(handle, start, os.SEEK_SET)
            while piece := gdal.VSIFReadL(1, min(PIECE_BYTES, remote.size_bytes - at), handle):
                yield bytes(piece)
                at += len(piece)
                if at == remote.size_bytes:
                    return
        finally:
            gdal.VSIFCloseL(handle)


@contextmanager
def _opened(name: str, shown: str) -> Iterator[None]:
    """GDAL may open this one name, in this thread, as long as the block lasts; what it raises is reported."""
    options = {key: str(gdal.GetConfigOption(key, usual)) for key, usual in _HTTP.items()}
    options |= {"CPL_VSIL_CURL_ALLOWED_FILENAME": name, "GDAL_DISABLE_READDIR_ON_OPEN": "EMPTY_DIR"}
    gdal.PushErrorHandler("CPLQuietErrorHandler")
    gdal.ErrorReset()
    gdal.VSIErrorReset()
    try:
        with gdal_options(options | {"CPL_VSIL_CURL_USE_S3_REDIRECT": "NO"}):
            yield
    except RuntimeError as error:
        if isinstance(error, GeomosaicError):
            raise
        problem = f"can't be fetched ({_shown(str(error))})"
        raise InputError(problem, file=shown, fix="fetch it by other means") from error
    finally:
        gdal.PopErrorHandler()


def _check_redirect(address: Address, location: str) -> None:
    """Another way on the same machine passes, to an encrypted one too; another machine is said."""
    if not address.vsi.startswith("/vsicurl/"):
        return
    asked = address.vsi.removeprefix("/vsicurl/")
    here, there = urlsplit(asked), urlsplit(urljoin(asked, location))
    if here.hostname == there.hostname and (there.scheme == "https" or here.netloc == there.netloc):
        return
    target = printable(f"{there.scheme}://{there.netloc.rpartition('@')[2]}{there.path}")[:200]
    raise InputError(f"leads to {target}", file=address.text, fix="if that is right, write it into the list")


def _check_kind(address: Address, head: bytes) -> None:
    """A server's message is not taken for the file that was asked for."""
    kind = _IMAGES.get(Path(address.name).suffix.lower(), "")
    if _WEB_PAGE.match(head):
        what = "a page of the web (HTML)"
    elif kind and _PAGE.match(head):
        what = "a message of its server"
    else:
        return
    fix = "open it in a browser: it may need credentials"
    raise InputError(f"is {what}, no {kind or 'file of a survey'}", file=address.text, fix=fix)


def _plain_tag(tag: str) -> str:
    return tag.removeprefix("W/").strip('"')


def _said() -> str:
    return _shown(gdal.VSIGetLastErrorMsg() or gdal.GetLastErrorMsg())


def _shown(text: str) -> str:
    """What GDAL says, on one line and without queries, which may hold a signature."""
    return re.sub(r"\?\S*", "", " ".join(printable(text).split()))[:300]


def _not_given(address: Address) -> InputError:
    said = _said()
    code = re.search(r"HTTP response code: (\d+)", said)
    number = int(code[1]) if code else 0
    if number in (404, 410):
        problem, fix = "there is no such file", "correct the address, or take it out of the list"
    elif number in (401, 403):
        problem, fix = f"its server refuses it (HTTP {number})", "check the address and the credentials"
    elif number:
        problem, fix = f"its server answers with HTTP {number}", "try again later"
    else:
        problem, fix = f"can't be reached ({said or 'no answer'})", "check the address and the network"
    return InputError(problem, file=address.text, fix=fix)
