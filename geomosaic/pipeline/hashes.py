"""Files by content: BLAKE2b hashes, remembered for as long as nothing speaks against them."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from hashlib import blake2b
from pathlib import Path
from typing import Any

from geomosaic.doors.references import companions_of, sources_of
from geomosaic.errors import FileError
from geomosaic.pipeline import files
from geomosaic.recording.file.fingerprints import fingerprint_of_json

_CHUNK_BYTES = 1 << 20
_MOST_MEMORY_BYTES = 64 << 20
UNTOUCHED_NS = 2_000_000_000
"""A file changed so shortly before it was hashed could change again without another time of change: 2 s is
the coarsest clock of a file system in use (FAT). Git's index has the same rule ("racily clean")."""

Mark = list[int]


def _mark(status: os.stat_result) -> Mark:
    """What changes with a file's content: size, time of change, and the times and numbers of its inode.

    Tools that keep the time of change (touch -r, rsync -t, cp -p) can't keep the inode's own (ctime).
    """
    return [status.st_size, status.st_mtime_ns, status.st_ctime_ns, status.st_ino, status.st_dev]


class FileHashes:
    """BLAKE2b of files' contents.

    A hash is taken from memory only if size, both times, inode and device are unchanged. The file must also
    have been unchanged for 2 s when it was hashed. What this can't see: an edit on a file system without a
    time of inode change (FAT, some network mounts) that keeps size and time. After RUN/work is deleted, all
    files are hashed anew.
    """

    def __init__(self, memory: Path | None = None) -> None:
        self._memory = memory
        self._known: dict[str, list[Any]] = {}
        self._now: dict[str, tuple[Mark, str]] = {}
        self._read: dict[Path, str] = {}
        self._inputs: set[Path] = set()
        self._companions: dict[Path, list[Path]] = {}
        self._new = False
        if memory is not None:
            with suppress(OSError, ValueError, RecursionError):
                known = json.loads(files.read_own(memory, _MOST_MEMORY_BYTES))
                self._known = known if isinstance(known, dict) else {}

    def of_file(self, path: Path) -> str:
        """Hash of one file's bytes. Raises `FileError` if it can't be read, or changes meanwhile."""
        try:
            mark = _mark(path.stat())
            name = str(path)
            known = self._now.get(name)
            if known is not None and known[0] == mark:
                return known[1]
            kept = self._known.get(name)
            if isinstance(kept, list) and kept[:-1] == mark and isinstance(kept[-1], str):
                self._now[name] = (mark, kept[-1])
                return kept[-1]
            digest = blake2b(digest_size=20)
            with path.open("rb") as file:
                while chunk := file.read(_CHUNK_BYTES):
                    digest.update(chunk)
            if _mark(path.stat()) != mark:
                raise _changed(path)
        except FileError:
            raise
        except OSError as error:
            raise FileError(
                f"can't be read ({error.strerror or error})", file=path, fix="make it readable"
            ) from error
        self._now[name] = (mark, digest.hexdigest())
        self._known.pop(name, None)
        if time.time_ns() - max(mark[1], mark[2]) > UNTOUCHED_NS:
            self._known[name] = [*mark, digest.hexdigest()]
        self._new = True
        return digest.hexdigest()

    def of_input(self, path: Path) -> str:
        """Hash of a file that the run reads; `check_unchanged` then watches over it."""
        digest = self.of_file(path)
        if path not in self._read:
            self._companions.setdefault(path.with_suffix(""), []).append(path)
            self._inputs.add(Path(os.path.normpath(path.absolute())))
        self._read[path] = digest
        return digest

    def named(self, texts: Iterable[str]) -> dict[Path, str]:
        """The files that texts name, and the inputs of the same stem in their folders, with their hashes."""
        found: dict[Path, str] = {}
        for text in texts:
            path = Path(text)
            if path in self._read:
                found |= {p: self.of_input(p) for p in self._companions[path.with_suffix("")]}
            elif os.sep in text and is_file(path):
                found[path] = self.of_file(path)
        return found

    def check_unchanged(self, hashes: Mapping[Path, str] | None = None) -> None:
        """Raises `FileError` for the first of some files, or of all inputs, that isn't what was hashed.

        One that is gone is left to whoever wants to read it.
        """
        for path, digest in (self._read if hashes is None else hashes).items():
            if path.exists() and self.of_file(path) != digest:
                raise _changed(path)

    def inputs(self) -> frozenset[Path]:
        """The files that the run reads, as normalised absolute paths."""
        return frozenset(self._inputs)

    def reads(self, path: Path) -> bool:
        """Whether the run reads a file, given by its normalised absolute path."""
        return path in self._inputs

    def reads_within(self, place: Path) -> bool:
        """Whether the run reads a file, or one in a folder, by whatever path."""
        place = place.resolve()
        return any(place in (path, *path.parents) for path in (given.resolve() for given in self._inputs))

    def manifest(self, path: Path, progress: Callable[[int, int], None] | None = None) -> dict[str, str]:
        """Names and hashes of what a file parameter stands for.

        A file stands for itself, the files that are read with it (`companions_of`), and the sources of a VRT
        by their full paths. A folder stands for the files directly inside that aren't hidden.
        """
        if path.is_dir():
            found = sorted(p for p in path.iterdir() if p.is_file() and not p.name.startswith("."))
        else:
            found = [*sorted({path, *companions_of(path)}), *sources_of(path.absolute())]
        near = path if path.is_dir() else path.parent
        hashes = {}
        for i, file in enumerate(found):
            hashes[file.name if file.parent == near else str(file)] = self.of_input(file)
            if progress:
                progress(i + 1, len(found))
        return hashes

    def of_written(self, path: Path) -> str:
        """Hash of a file, or of all that lies below a folder, that a stage wrote; links are refused."""
        if path.is_dir():
            found = sorted(p for p in path.rglob("*") if p.is_symlink() or p.is_file())
            return fingerprint_of_json([[p.relative_to(path).as_posix(), self.of_written(p)] for p in found])
        if path.is_symlink():
            raise FileError("is a link", file=path, fix="give the file itself")
        if not path.is_file():
            raise FileError("is no regular file", file=path, fix="give a file on the disk")
        return self.of_file(path)

    def of_copy(self, path: Path, original: Path) -> str:
        """Hash of a file that a stage wrote as a copy of another one, which isn't read again."""
        digest, status = self.of_written(original), path.stat()
        if path.is_symlink() or status.st_size != original.stat().st_size:
            raise _changed(path)
        self._now[str(path)] = (_mark(status), digest)
        return digest

    def forget_unasked(self) -> None:
        """Forgets the files that nobody asked for since the start."""
        self._new = self._new or not self._known.keys() <= self._now.keys()
        self._known = {path: kept for path, kept in self._known.items() if path in self._now}

    def save(self) -> None:
        """Keeps what is known for the next run."""
        if self._memory is not None and self._new:
            known = dict(self._known)  # a stage in another thread may hash on
            files.write_bytes(self._memory, json.dumps(known, separators=(",", ":")).encode())
            self._new = False


def is_file(path: Path) -> bool:
    """Whether a path leads to a file; one that no file can have leads to none."""
    try:
        return path.is_file()
    except (OSError, ValueError):  # no name that a file can have
        return False


def _changed(path: Path) -> FileError:
    return FileError("was changed while the run read it", file=path, fix="run again once nobody writes to it")
