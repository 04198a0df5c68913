"""Artefacts as bytes: frozen dataclasses of plain values, paths and numpy arrays to one file and back.

An artefact is an uncompressed zip with a tree in JSON (`tree.json`) and one `.npy` member for each
array. Equal artefacts give equal bytes, so a hash of the bytes names the artefact. Nothing in the file
is ever executed or imported: a class is known by its name only if the type asked for contains it. A class
may map names that its fields had in earlier versions to those they have, or to '' (`FORMERLY`).
"""

from __future__ import annotations

import dataclasses
import hashlib
import io
import json
import math
import types
import typing
import zipfile
from hashlib import blake2b
from pathlib import Path
from typing import IO, Any, BinaryIO

import numpy as np

from geomosaic.recording.file.fingerprints import fingerprint_of_bytes, fingerprint_of_json

TREE = "tree.json"
TIMELESS = (1980, 1, 1, 0, 0, 0)
KINDS = "biufcSU"


def fingerprint_of_file(file: BinaryIO) -> str:
    """As `fingerprint_of_bytes`, of an open file, piece by piece."""
    return hashlib.file_digest(file, lambda: blake2b(digest_size=20)).hexdigest()  # type: ignore[arg-type]


class Reference:
    """What stands for something that lies elsewhere, and counts by its mark: it has no bytes of its own."""

    mark: str


def content_of(value: Any) -> tuple[str, set[str]]:
    """What names a value by its content, a `Reference` in it by its mark; and every text and path in it.

    Raises: `TypeError` as `encode`.
    """
    content = _Content(may_refer=True)
    tree = _tree(value, content, type(value).__name__)
    members = [fingerprint_of_bytes(*_pieces(member)) for member in content.members]
    return fingerprint_of_json([tree, members]), content.texts


def encode(artefact: Any) -> bytes:
    """The artefact as bytes. Raises `TypeError` where it holds what has no plain form."""
    out = io.BytesIO()
    write(artefact, out)
    return out.getvalue()


def write(artefact: Any, out: IO[bytes]) -> None:
    """Writes what `encode` gives to a file, array by array: nothing is in memory twice."""
    content = _Content()
    tree = _tree(artefact, content, type(artefact).__name__)
    with zipfile.ZipFile(out, "w", zipfile.ZIP_STORED) as file:
        text = json.dumps(tree, separators=(",", ":"), allow_nan=False)
        file.writestr(zipfile.ZipInfo(TREE, TIMELESS), text)
        for i, member in enumerate(content.members):
            pieces, info = _pieces(member), zipfile.ZipInfo(str(i), TIMELESS)
            info.file_size = sum(map(len, pieces))
            with file.open(info, "w") as into:
                for piece in pieces:
                    into.write(piece)


def _pieces(member: bytes | np.ndarray[Any, Any]) -> tuple[bytes | memoryview, ...]:
    """A member's bytes: those of an array as `.npy`, its header and what it holds, which isn't copied."""
    if isinstance(member, bytes):
        return (member,)
    npy, plain = io.BytesIO(), np.ascontiguousarray(member)
    np.lib.format.write_array_header_1_0(
        npy, np.lib.format.header_data_from_array_1_0(plain.reshape(member.shape))
    )
    return npy.getvalue(), plain.reshape(-1).view(np.uint8).data


@dataclasses.dataclass
class _Content:
    """What a value holds besides its tree: its arrays and bytes, one after the other; its texts."""

    members: list[bytes | np.ndarray[Any, Any]] = dataclasses.field(default_factory=list)
    texts: set[str] = dataclasses.field(default_factory=set)
    may_refer: bool = False

    def take(self, member: bytes | np.ndarray[Any, Any]) -> int:
        self.members.append(member)
        return len(self.members) - 1


def _tree(value: Any, content: _Content, where: str) -> Any:
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, str | Path):
        content.texts.add(str(value))
    match value:
        case None | bool() | int() | str():
            return value if type(value) in (types.NoneType, bool, int, str) else _plain(value, where)
        case float():
            return float(value) if math.isfinite(value) else {"float": repr(float(value))}
        case complex():
            return {"complex": [repr(value.real), repr(value.imag)]}
        case Path():
            return {"path": str(value)}
        case bytes():
            return {"bytes": content.take(value)}
        case np.ndarray():
            if value.dtype.kind not in KINDS:
                raise TypeError(f"{where}: an array of {value.dtype} can't be kept as an artefact")
            return {"array": content.take(value)}
        case Reference() if content.may_refer:
            return {"reference": value.mark}
        case tuple() | list():
            items = [_tree(v, content, f"{where}[{i}]") for i, v in enumerate(value)]
            return {"tuple" if isinstance(value, tuple) else "list": items}
        case dict():
            return {
                "dict": [
                    [_tree(k, content, where), _tree(v, content, f"{where}[{k!r}]")] for k, v in value.items()
                ]
            }
    if dataclasses.is_dataclass(value) and not isinstance(value, type | Reference):
        fields = {
            f.name: _tree(getattr(value, f.name), content, f"{where}.{f.name}")
            for f in dataclasses.fields(value)
            if f.init
        }
        return {"is": type_name(type(value)), "fields": fields}
    return _plain(value, where)


def _plain(value: Any, where: str) -> typing.NoReturn:
    raise TypeError(
        f"{where}: {type(value).__name__} can't be kept as an artefact; use plain values and arrays"
    )


def type_name(cls: Any) -> str:
    """How a class is named in a file."""
    return f"{cls.__module__}:{cls.__qualname__}" if isinstance(cls, type) else str(cls)


def dataclasses_in(annotation: Any, found: dict[str, type] | None = None) -> dict[str, type]:
    """Every dataclass that a value of this type can hold, by name, through the fields' types."""
    found = {} if found is None else found
    name = type_name(annotation)
    if isinstance(annotation, type) and dataclasses.is_dataclass(annotation) and name not in found:
        found[name] = annotation
        for hint in typing.get_type_hints(annotation).values():
            dataclasses_in(hint, found)
    for argument in typing.get_args(annotation):
        dataclasses_in(argument, found)
    return found
