"""Artefacts as bytes: frozen dataclasses of plain values, paths and numpy arrays to one file and back.

An artefact is an uncompressed zip with a tree in JSON (`tree.json`) and one `.npy` member for each
array. Equal artefacts give equal bytes, so a hash of the bytes names the artefact. Nothing in the file
is ever executed or imported: a class is known by its name only if the type asked for contains it. A class
may map names that its fields had in earlier versions to those they have (`FORMERLY`).
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import io
import itertools
import json
import math
import mmap
import struct
import tokenize
import types
import typing
import zipfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from hashlib import blake2b
from pathlib import Path
from typing import IO, Any, BinaryIO, Final, TypeVar

import numpy as np

from geomosaic.errors import FileError
from geomosaic.pipeline.former_names import present_name
from geomosaic.recording.file.fingerprints import fingerprint_of_bytes, fingerprint_of_json

T = TypeVar("T")

_WORD_BITS: Final = 64
"""Of whole numbers: arrays have none that are longer."""
_NOT_WHOLE = (
    *(ValueError, KeyError, TypeError, IndexError, AttributeError, OverflowError),
    *(zipfile.BadZipFile, EOFError, RuntimeError, MemoryError),  # RuntimeError: encrypted, a later version
    *(SyntaxError, tokenize.TokenError),  # of an array's header, which numpy reads as a Python literal
)

_TREE = "tree.json"
_TIMELESS = (1980, 1, 1, 0, 0, 0)
_KINDS = "biufcSU"
_NAME_AT = 26
"""Where a member's own header in a zip has the lengths of its name and of what follows; then its bytes."""
_NPY_LENGTH_AT = 8
"""Where the two bytes of a `.npy` header's length are, in its first version."""


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
    """Writes what `encode` gives to a file, array by array: nothing is held twice."""
    content = _Content()
    tree = _tree(artefact, content, type(artefact).__name__)
    with zipfile.ZipFile(out, "w", zipfile.ZIP_STORED) as file:
        text = json.dumps(tree, separators=(",", ":"), allow_nan=False)
        file.writestr(zipfile.ZipInfo(_TREE, _TIMELESS), text)
        for i, member in enumerate(content.members):
            pieces, info = _pieces(member), zipfile.ZipInfo(str(i), _TIMELESS)
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
            if value.dtype.kind not in _KINDS:
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


_known: Callable[[Any], Mapping[str, type]] = functools.cache(dataclasses_in)
"""Of a type that is asked for again and again, with each result of `Context.map`; not to be changed."""


def decode(
    data: bytes | BinaryIO, as_type: type[T] | Any, also: Iterable[type] = (), *, mapped: bool = False
) -> T:
    """The artefact of a type (a dataclass, or an annotation such as `tuple[Camera, ...]`) from its bytes.

    `also` names more classes the file may hold. mapped: arrays stay in the file (which is one), are read as
    they are looked at, and can't be written to; nor is it asked whether their bytes are right. Raises
    `FileError` if the bytes are anything else.
    """
    known = dict(_known(as_type))
    for cls in also:
        dataclasses_in(cls, known)
    try:
        with _opened(data) as file:
            members = _Mapped(file) if mapped else _Members(file)
            value = _value(json.loads(file.read(_TREE)), members, known)
    except _NOT_WHOLE as error:
        raise FileError(f"this is no whole artefact of type {type_name(as_type)} ({error})") from error
    if isinstance(as_type, type) and as_type not in (object, Any) and not isinstance(value, as_type):
        raise FileError(f"this artefact is a {type(value).__name__}, not a {type_name(as_type)}")
    if not _fits(value, as_type):
        raise FileError(f"this artefact holds what a {type_name(as_type)} doesn't")
    return typing.cast(T, value)


def _fits(value: Any, annotation: Any) -> bool:
    """Whether a value may stand under an annotation, its fields too; what it can't check fits."""
    origin, inside = typing.get_origin(annotation), typing.get_args(annotation)
    if origin in (typing.Union, types.UnionType):
        return any(_fits(value, one) for one in inside)
    if origin is typing.Literal:
        return value in inside
    if origin is tuple:
        if not isinstance(value, tuple):
            return False
        each = itertools.repeat(inside[0]) if inside[-1:] == (...,) else inside
        return (inside[-1:] == (...,) or len(value) == len(inside)) and all(map(_fits, value, each))
    if origin is dict and isinstance(value, dict):
        return all(_fits(k, inside[0]) and _fits(v, inside[1]) for k, v in value.items())
    if isinstance(value, int) and annotation in (int, float):
        return not isinstance(value, bool) and value.bit_length() <= _WORD_BITS
    if annotation is float:
        return isinstance(value, float)
    kind = origin or annotation
    if not isinstance(kind, type) or kind is object:
        return True
    if not isinstance(value, kind):
        return False
    if dataclasses.is_dataclass(value):
        return all(_fits(getattr(value, name), hint) for name, hint in _fields(value.__class__))
    return True


@functools.cache
def _fields(cls: Any) -> tuple[tuple[str, Any], ...]:
    hints = typing.get_type_hints(cls)
    return tuple((f.name, hints[f.name]) for f in dataclasses.fields(cls) if f.init)


def _opened(data: bytes | BinaryIO) -> zipfile.ZipFile:
    """Raises `ValueError` for members that aren't stored as they are, or state more than the file holds."""
    stream = io.BytesIO(data) if isinstance(data, bytes) else data
    size = stream.seek(0, io.SEEK_END)
    file = zipfile.ZipFile(stream)
    if any(m.compress_type != zipfile.ZIP_STORED for m in file.infolist()):
        raise ValueError("it is compressed")
    if sum(m.file_size for m in file.infolist()) > size:
        raise ValueError("its members take more than the file")
    return file


def texts_in(data: bytes | BinaryIO) -> list[str]:
    """Every text and path that an artefact's bytes hold. Raises `FileError` if they are none."""
    try:
        with _opened(data) as file:
            return list(_texts(json.loads(file.read(_TREE))))
    except _NOT_WHOLE as error:
        raise FileError(f"this is no whole artefact ({error})") from error


def with_texts(data: bytes, change: Callable[[str], str]) -> bytes:
    """An artefact's bytes with every text and path in them changed."""

    def changed(tree: Any) -> Any:
        if isinstance(tree, dict):
            return {name: changed(value) for name, value in tree.items()}
        if isinstance(tree, list):
            return [changed(value) for value in tree]
        return change(tree) if isinstance(tree, str) else tree

    out = io.BytesIO()
    with _opened(data) as old, zipfile.ZipFile(out, "w", zipfile.ZIP_STORED) as new:
        for name in old.namelist():
            member = old.read(name)
            if name == _TREE:
                tree = changed(json.loads(member))
                member = json.dumps(tree, separators=(",", ":"), allow_nan=False).encode()
            new.writestr(zipfile.ZipInfo(name, _TIMELESS), member)
    return out.getvalue()


def _texts(tree: Any) -> Iterator[str]:
    waiting = [tree]
    while waiting:
        match waiting.pop():
            case str() as text:
                yield text
            case list() as items:
                waiting.extend(items)
            case dict() as items:
                waiting.extend(items.values())


class _Members:
    """The arrays and bytes of an artefact, each for one place in it, as they are written: so a value takes no
    more memory than the file."""

    def __init__(self, file: zipfile.ZipFile) -> None:
        self._file = file
        self._left = {name for name in file.namelist() if name != _TREE}

    def take(self, number: Any) -> bytes | memoryview:
        """Raises `KeyError` for one that isn't there, or has been taken."""
        self._left.remove(str(int(number)))
        return self._file.read(str(int(number)))


class _Mapped(_Members):
    """As `_Members`, of a file on the disk: its own bytes, not copies."""

    def __init__(self, file: zipfile.ZipFile) -> None:
        super().__init__(file)
        assert file.fp is not None
        self._map = memoryview(mmap.mmap(file.fp.fileno(), 0, access=mmap.ACCESS_READ))

    def take(self, number: Any) -> memoryview:
        """See `_Members`."""
        self._left.remove(str(int(number)))
        member = self._file.getinfo(str(int(number)))
        name, extra = struct.unpack_from("<HH", self._map, member.header_offset + _NAME_AT)
        start = member.header_offset + _NAME_AT + 4 + name + extra
        if start + member.file_size > len(self._map):
            raise ValueError("a member beyond the file's end")
        return self._map[start : start + member.file_size]


def _value(tree: Any, file: _Members, known: dict[str, type]) -> Any:
    if not isinstance(tree, dict):
        if isinstance(tree, list):
            raise ValueError("a bare list")
        return tree
    if "is" in tree:
        cls = known.get(present_name(tree["is"]))
        if cls is None:
            raise ValueError(f"it holds a {tree['is']!r}, which doesn't belong there")
        names: Mapping[str, str] = getattr(cls, "FORMERLY", {})
        return cls(**{names.get(n, str(n)): _value(v, file, known) for n, v in tree["fields"].items()})
    ((kind, content),) = tree.items()
    match kind:
        case "float":
            return {"nan": math.nan, "inf": math.inf, "-inf": -math.inf}[content]
        case "complex":
            return complex(float(content[0]), float(content[1]))
        case "path":
            return Path(str(content))
        case "bytes":
            return bytes(file.take(content))
        case "array":
            return _array(file.take(content))
        case "tuple":
            return tuple(_value(v, file, known) for v in content)
        case "list":
            return [_value(v, file, known) for v in content]
        case "dict":
            return {_value(k, file, known): _value(v, file, known) for k, v in content}
    raise ValueError(f"a {kind!r}")


def _array(data: bytes | memoryview) -> np.ndarray[Any, Any]:
    length = int.from_bytes(data[_NPY_LENGTH_AT : _NPY_LENGTH_AT + 2], "little")
    shape, dtype, start = _header(bytes(data[: _NPY_LENGTH_AT + 2 + length]))
    if math.prod(shape) * dtype.itemsize != len(data) - start:
        raise ValueError("an array whose size disagrees with its header")
    array = np.frombuffer(data, dtype, offset=start).reshape(shape)
    return array if isinstance(data, memoryview) else array.copy()


@functools.lru_cache(maxsize=128)
def _header(data: bytes) -> tuple[tuple[int, ...], np.dtype[Any], int]:
    """Shape, type and length of an array's header; arrays of an artefact are mostly alike."""
    stream = io.BytesIO(data)
    if np.lib.format.read_magic(stream) != (1, 0):
        raise ValueError("an array of another format version")
    shape, fortran, dtype = np.lib.format.read_array_header_1_0(stream)
    if dtype.kind not in _KINDS or fortran:
        raise ValueError("an array of another order or kind")
    return shape, dtype, stream.tell()
