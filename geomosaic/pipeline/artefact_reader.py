"""Artefacts from their bytes: the type that is asked for, or an error; nothing in the file is executed."""

from __future__ import annotations

import dataclasses
import functools
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
from pathlib import Path
from typing import Any, BinaryIO, Final, TypeVar

import numpy as np

from geomosaic.errors import FileError
from geomosaic.pipeline.artefacts import KINDS, TIMELESS, TREE, dataclasses_in, type_name
from geomosaic.pipeline.former_names import present_name

T = TypeVar("T")

_WORD_BITS: Final = 64
"""Of whole numbers: arrays have none that are longer."""
_NOT_WHOLE = (
    *(ValueError, KeyError, TypeError, IndexError, AttributeError, OverflowError),
    *(zipfile.BadZipFile, EOFError, RuntimeError, MemoryError),  # RuntimeError: encrypted, a later version
    *(SyntaxError, tokenize.TokenError),  # of an array's header, which numpy reads as a Python literal
)
_NAME_AT = 26
"""Where a member's own header in a zip has the lengths of its name and of what follows; then its bytes."""
_NPY_LENGTH_AT = 8
"""Where the two bytes of a `.npy` header's length are, in its first version."""


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
            value = _value(json.loads(file.read(TREE)), members, known)
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
            return list(_texts(json.loads(file.read(TREE))))
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
            if name == TREE:
                tree = changed(json.loads(member))
                member = json.dumps(tree, separators=(",", ":"), allow_nan=False).encode()
            new.writestr(zipfile.ZipInfo(name, TIMELESS), member)
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
        self._left = {name for name in file.namelist() if name != TREE}

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
        fields = {names.get(name, str(name)): value for name, value in tree["fields"].items()}
        return cls(**{name: _value(value, file, known) for name, value in fields.items() if name})
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
    if dtype.kind not in KINDS or fortran:
        raise ValueError("an array of another order or kind")
    return shape, dtype, stream.tell()
