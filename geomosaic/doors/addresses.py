"""Addresses of files on other machines, read out of lists and checked; nothing is opened here."""

from __future__ import annotations

import csv
import ipaddress
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Final
from urllib.parse import quote, unquote, urlsplit

from geomosaic.constants import tuned
from geomosaic.doors.files import TEXT_BYTES, printable, read_text
from geomosaic.errors import FileError, InputError

_STORES: Final = {"s3": "/vsis3/", "gs": "/vsigs/", "az": "/vsiaz/"}
_KNOWN: Final = "https://, s3://, gs:// or az://"
_SPOILED: Final = re.compile(r"(?:^|/)(https?|ftp|s3|gs|az):/+(.*)", re.DOTALL)
NAME_BYTES = tuned(200, "bytes", "of a file's name: systems allow 255, and the temporary name takes 40 more")


@dataclass(frozen=True)
class Address:
    """Where a file lies, or with an empty name a folder of an object store.

    text: as messages and notes show it, without a query, which may hold a signature. vsi: GDAL's name.
    """

    text: str
    vsi: str
    name: str


def is_address(text: str) -> bool:
    """Whether a text means something on another machine and no local path."""
    return "://" in text


def address_in(path: Path) -> str | None:
    """The address that was given where a path is wanted: pathlib leaves one slash of its two."""
    found = _SPOILED.search(str(path))
    return f"{found[1]}://{found[2]}" if found else None


def read_addresses(path: Path) -> list[str]:
    """The addresses of a list: one a line, or one a row of a .csv file, whose first row may be its header.

    Blank lines and those that begin with # are passed over. Raises: `FileError` as `read_text`, and for a
    line without an address or a row with several.
    """
    fix = "write one address a line"
    lines = read_text(path, TEXT_BYTES, "a list of addresses", fix).splitlines()
    found = []
    for number, line in enumerate(lines, start=1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        try:
            cells = next(csv.reader([line])) if path.suffix.lower() == ".csv" else [line]
        except csv.Error as error:
            raise FileError(f"line {number} is no row of a table", file=path, fix=fix) from error
        here = [cell.strip() for cell in cells if is_address(cell)]
        if len(here) == 1:
            found += here
        elif here or found or path.suffix.lower() != ".csv":
            count = "several addresses" if here else f"no address ({_KNOWN})"
            raise FileError(f"line {number} holds {count}", file=path, fix=fix)
    if not found:
        raise FileError("holds no address", file=path, fix=fix)
    return found


def parsed(text: str, insecure: bool = False) -> Address:
    """An address out of a text; insecure: http:// to other machines than this one is allowed.

    Keys of object stores stand as they are; paths of https:// are percent-encoded.

    Raises: `InputError` for what is none, holds a password, or gives its file a name that no file of a survey
    can have.
    """
    scheme, _, rest = text.partition("://")
    scheme = scheme.lower()
    if printable(text) != text:
        raise InputError("holds what no address can", file=printable(text), fix="correct it")
    if scheme in _STORES:
        bucket, _, key = rest.partition("/")
        if not bucket:
            raise InputError("names no bucket", file=text, fix=f"write {scheme}://BUCKET/FOLDER/")
        shown = f"{scheme}://{rest}"
        return Address(shown, _STORES[scheme] + rest, file_name(key.rpartition("/")[2], shown))
    if scheme not in ("https", "http"):
        raise InputError("is no address that is read", file=text, fix=f"give {_KNOWN}")
    try:
        url = urlsplit(quote(text, safe="%/:?[]@!$&'()*+,;=~"))
        local = _is_this_machine(url.hostname or "")
    except ValueError as error:
        raise InputError("is no address", file=text, fix="correct it") from error
    shown = f"{scheme}://{url.netloc.rpartition('@')[2]}{url.path}"
    if not url.hostname:
        raise InputError("names no host", file=shown, fix="write https://HOST/PATH")
    if "@" in url.netloc:
        fix = "give them as GDAL takes them (GDAL_HTTP_USERPWD, or ~/.netrc)"
        raise InputError("holds credentials", file=shown, fix=fix)
    if scheme == "http" and not (insecure or local):
        fix = "write https://, or allow it with --insecure"
        raise InputError("goes over the network unencrypted", file=shown, fix=fix)
    last = url.path.rpartition("/")[2]
    if not last:
        fix = "write a list of its files, one a line"
        raise InputError("is a folder, and folders of web servers aren't listed", file=shown, fix=fix)
    whole = f"{scheme}://{url.netloc}{url.path}" + (f"?{url.query}" if url.query else "")
    return Address(shown, f"/vsicurl/{whole}", file_name(unquote(last, errors="surrogateescape"), shown))


def file_name(name: str, shown: str) -> str:
    """The last part of an address as a file's name; '' and hidden ones pass, which nobody wants.

    Raises: `InputError` for one that leads elsewhere or can't be shown.
    """
    if printable(name) != name or {"/", "\\"} & set(name) or len(name.encode()) > NAME_BYTES:
        problem = "names a file that no file of a survey can be called"
        raise InputError(problem, file=printable(shown), fix="rename it there, or take it out of the list")
    return name


def _is_this_machine(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
