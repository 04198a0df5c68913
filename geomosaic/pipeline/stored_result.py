"""Results on disk that items, stages and workers refer to by their path.

What is large goes between processes by its place in the run folder and not by its bytes: whoever needs it
reads it there, and keeps what it needed lately.
"""

from __future__ import annotations

import mmap
import os
import pickle
import secrets
import socket
import struct
import threading
import typing
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Generic, TypeVar

from geomosaic.constants import TOGETHER, tuned
from geomosaic.doors.at_hand import at_hand, own_place, shares_disk
from geomosaic.errors import FileError
from geomosaic.pipeline import files
from geomosaic.pipeline.artefact_reader import decode
from geomosaic.pipeline.artefacts import Reference, encode, write
from geomosaic.recording.file.fingerprints import fingerprint_of_bytes

Result = TypeVar("Result")
Item = TypeVar("Item")


class _Sized(typing.Protocol):
    @property
    def nbytes(self) -> int: ...


Sized = TypeVar("Sized", bound=_Sized)

_MEMORY_BYTES = tuned(128 << 20, "bytes", "of cached results, 40 frames of keypoints: less reads files again")
_SHARED_BYTES = tuned(100_000, "bytes", "of arguments sent with each item: a file costs as much as 100 kB")
_LENGTH: Final = struct.Struct("<Q")
_ALIGNED_BYTES: Final = 64
"""From where to where arrays begin: any number's size goes into it."""


class _Memory:
    """What this process read lately, by mark; the oldest goes first. For threads."""

    def __init__(self, most_bytes: int) -> None:
        self._most = most_bytes
        self._size = 0
        self._values: OrderedDict[str, tuple[Any, int]] = OrderedDict()
        self._lock = threading.Lock()

    def get(self, mark: str, read: Callable[[], tuple[Any, int]]) -> Any:
        """The value, read (with its size in bytes) where it is not there."""
        with self._lock:
            if mark in self._values:
                self._values.move_to_end(mark)
                return self._values[mark][0]
        value, size = read()
        with self._lock:
            if mark not in self._values:
                self._values[mark] = value, size
                self._size += size
            while self._size > self._most and len(self._values) > 1:
                self._size -= self._values.popitem(last=False)[1][1]
        return value

    def clear(self) -> None:
        """Forgets all of it."""
        with self._lock:
            self._values.clear()
            self._size = 0


_memory = _Memory(_MEMORY_BYTES)


def forget_all() -> None:
    """Clears this process's cache of results."""
    _memory.clear()


@dataclass(frozen=True)
class StoredResult(Reference, Generic[Result]):
    """A result of `Context.stored` or `spooled`: in its file, or in memory where a stage is run by hand.

    It may stand in other items, however deep: it is the file's name that travels, not what the file holds,
    and its `mark` that counts for theirs. Whoever has to read it needs the run folder under the same path.
    """

    returns: Any
    mark: str
    path: Path | None
    data: bytes | None = field(default=None, repr=False)

    def load(self) -> Result:
        """The result. Raises `FileError` for a file that is gone or isn't what it was."""
        if self.data is not None:
            return typing.cast(Result, decode(self.data, self.returns))
        assert self.path is not None
        return typing.cast(Result, _read(self.path, lambda file: decode(file, self.returns)))

    def recall(self) -> Result:
        """As `load`, read once while this process wants it again soon. It is shared: don't change it."""
        if self.path is None:
            return self.load()
        path = self.path
        return typing.cast(
            Result, _memory.get(self.mark, lambda: (self.load(), at_hand(path).stat().st_size))
        )

    def recall_as(self, made_of: Callable[[Result], Sized]) -> Sized:
        """As `recall`, but what a function makes of the result, which isn't kept itself."""
        if self.path is None:
            return made_of(self.load())

        def make() -> tuple[Sized, int]:
            made = made_of(self.load())
            return made, made.nbytes

        return typing.cast(Sized, _memory.get(f"{self.mark} {made_of.__qualname__}", make))

    def look(self) -> Result:
        """As `recall`, but arrays stay in the file until they are looked at, part by part: for what is wanted
        in parts. Processes of a machine share what the system holds of it."""
        if self.path is None:
            return self.load()
        path = self.path

        def read() -> tuple[Result, int]:
            size = max(at_hand(path).stat().st_size, _MEMORY_BYTES // TOGETHER)  # mapped, it stays open
            return _read(path, lambda file: decode(file, self.returns, mapped=True)), size

        return typing.cast(Result, _memory.get(f"{self.mark} mapped", read))

    def forget(self) -> None:
        """Its file goes."""
        if self.path is not None:
            files.remove(self.path)


@dataclass(frozen=True)
class OptionalCache(Reference, Generic[Result]):
    """A cache entry that may be missing: on a miss the caller computes the result, which is the same.

    It takes no part in the names of other items.
    """

    returns: Any
    path: Path | None
    mark: str = field(default="", init=False)

    def leave(self, result: Result) -> None:
        """Stores the result."""
        if self.path is not None:
            path = own_place(self.path)
            with files.refusals_named(path), files.writing(path) as place, place.open("wb") as file:
                write(result, file)

    def found(self) -> Result | None:
        """The result, if it is there and whole."""
        if self.path is None:
            return None
        try:
            return typing.cast(Result, _read(own_place(self.path), lambda file: decode(file, self.returns)))
        except FileError:
            return None

    def forget(self) -> None:
        """Its file goes."""
        if self.path is not None:
            files.remove(self.path)


def without_bytes(kept: StoredResult[Result]) -> StoredResult[Result]:
    """The same without the copy in memory, if the result is on disk."""
    return StoredResult(kept.returns, kept.mark, kept.path, None if kept.path is not None else kept.data)


@dataclass(frozen=True)
class SharedFunction(Generic[Item, Result]):
    """A function with large arguments, written to disk once for all workers.

    Pickled, so that its numbers keep their types; it is taken only if its bytes have the mark that came
    with the task. Its arrays stay in the file, so that the workers of a machine share them.
    """

    path: Path
    mark: str
    head_bytes: int

    @classmethod
    def of(cls, function: Callable[[Item], Result], path: Path) -> Callable[[Item], Result]:
        """The function as it goes to the workers: itself, or what lies at `path` where it is large."""
        arrays: list[pickle.PickleBuffer] = []
        pickled = pickle.dumps(function, protocol=pickle.HIGHEST_PROTOCOL, buffer_callback=arrays.append)
        parts = [memoryview(pickled), *(a.raw() for a in arrays)]
        if sum(len(part) for part in parts) <= _SHARED_BYTES:
            return function
        pieces: list[bytes | memoryview] = [_LENGTH.pack(len(parts)), *(_LENGTH.pack(len(p)) for p in parts)]
        ends, size = [], sum(map(len, pieces))
        for part in parts:
            gap = bytes(-size % _ALIGNED_BYTES)
            pieces.extend((gap, part))
            size += len(gap) + len(part)
            ends.append(size)
        files.write_bytes(path, *pieces)
        return cls(path, fingerprint_of_bytes(*pieces), ends[0])

    def __call__(self, item: Item) -> Result:
        function: Callable[[Item], Result] = _memory.get(self.mark, self._read)
        return function(item)

    def _read(self) -> tuple[Any, int]:
        data = _read(self.path, _mapped)
        head = bytes(
            data[: self.head_bytes]
        )  # what is unpickled is what was checked, whoever writes meanwhile
        if fingerprint_of_bytes(head, data[self.head_bytes :]) != self.mark:
            raise FileError("isn't what the run wrote", file=self.path, fix="run again")
        (count,) = _LENGTH.unpack_from(head)
        ends, at = [], (1 + count) * _LENGTH.size
        for (length,) in _LENGTH.iter_unpack(head[_LENGTH.size : at]):
            at += -at % _ALIGNED_BYTES
            ends.append((at, at + length))
            at += length
        pickled, arrays = head[ends[0][0] :], [data[first:last] for first, last in ends[1:]]
        return pickle.loads(pickled, buffers=arrays), len(pickled)  # noqa: S301  written by this run, as its mark says


@dataclass(frozen=True)
class EncodedFunction(Generic[Item]):
    """A function whose result comes home as an artefact's bytes."""

    function: Callable[[Item], Any]

    def __call__(self, item: Item) -> bytes:
        return encode(self.function(item))


@dataclass(frozen=True)
class SpoolingFunction(Generic[Item]):
    """A function whose result the worker leaves on the disk, next to its final place. It returns the name of
    the file or, without a shared disk, its bytes. A task that is done twice leaves two files."""

    function: Callable[[Item], Any]

    def __call__(self, given: tuple[Item, Path]) -> Path | bytes:
        item, place = given
        result = self.function(item)
        if not shares_disk():
            return encode(result)
        path = place.with_name(f".{place.name}-{secrets.token_hex(4)}.{os.getpid()}.geomosaic.part")
        try:
            with files.refusals_named(place):
                path.parent.mkdir(parents=True, exist_ok=True)
                with path.open("wb") as file:
                    write(result, file)
        except BaseException:
            files.remove(path)
            raise
        return path


def _mapped(file: typing.BinaryIO) -> memoryview:
    size = os.fstat(file.fileno()).st_size
    return memoryview(mmap.mmap(file.fileno(), size, access=mmap.ACCESS_READ) if size else b"")


def _read(path: Path, read: Callable[[typing.BinaryIO], Result]) -> Result:
    try:
        with files.open_own(path) as file:
            return read(file)
    except FileNotFoundError as error:
        raise FileError(
            f"isn't there for the process at work on {socket.gethostname()}",
            file=path,
            fix="with --dask the run folder must have the same path on all machines; else run again",
        ) from error
    except OSError as error:
        raise FileError(f"can't be read ({error.strerror or error})", file=path, fix="run again") from error
