"""Files by content, and files that are whole under their final name."""

from __future__ import annotations

import errno
import json
import os
import re
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from hashlib import blake2b
from pathlib import Path, PurePosixPath
from typing import Any, TypeGuard

from geomosaic.errors import FileError, GeomosaicError, OutputError
from geomosaic.pipeline.artefacts import fingerprint_of_json

_CHUNK_BYTES = 1 << 20
_LEFTOVER = re.compile(r"\..+\.\d+\.(part(\..+)?|old)")
_SIDECARS = (".prj", ".tfw", ".jgw", ".wld")
_MENDS = {
    errno.ENOSPC: ("no space left on the disk", "free some or choose another output folder"),
    errno.EDQUOT: ("the disk quota is used up", "free some or choose another output folder"),
    errno.EACCES: ("no permission to write", "choose an output folder of your own"),
    errno.EPERM: ("no permission to write", "choose an output folder of your own"),
    errno.EROFS: ("the file system is read-only", "choose another output folder"),
    errno.ENOTDIR: ("a file stands where a folder is needed", "choose another output folder"),
    errno.EEXIST: ("a file stands where a folder is needed", "choose another output folder"),
    errno.EISDIR: ("a folder stands where the file is to go", "move it away"),
    errno.EFBIG: ("the file is too large for the disk", "choose another output folder"),
    errno.ENOENT: ("the folder can't be made", "choose another output folder"),
}


def is_output_error(error: BaseException) -> TypeGuard[OSError]:
    """Whether the system refused to write, and nobody has said so to the user yet."""
    full = (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EFBIG)
    return isinstance(error, OSError) and not isinstance(error, GeomosaicError) and error.errno in full


def output_error(error: OSError, path: Path) -> OutputError:
    """What the user can do about a failed write."""
    problem, mend = _MENDS.get(
        error.errno or 0, (f"can't be written ({error.strerror or error})", "see the disk")
    )
    return OutputError(problem, file=path, mend=mend)


def make_folder(folder: Path) -> Path:
    """The folder, made with its parents where missing, and proven to be writable."""
    probe = folder / f".writable-{os.getpid()}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe.write_bytes(b"ok")
        probe.unlink()
    except OSError as error:
        raise output_error(error, folder) from error
    return folder


@contextmanager
def writing(path: Path) -> Iterator[Path]:
    """A temporary path beside `path` that takes its name if the block succeeds, and vanishes if not.

    The temporary name ends like the final one, so that drivers know the format. The block may make a
    file or a whole folder; a folder takes the place of an older one. A full disk or a missing
    permission becomes an `OutputError` that names the final path.
    """
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.part{path.suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        _remove(temporary)
        yield temporary
        old = path.with_name(f".{path.name}.{os.getpid()}.old")
        if temporary.is_dir() and path.exists():
            path.replace(old)
        temporary.replace(path)
        _remove(old)
    except OSError as error:
        if isinstance(error, GeomosaicError):
            raise
        raise output_error(error, path) from error
    except (RuntimeError, MemoryError) as error:
        if not isinstance(error, GeomosaicError) and disk_is_full(path.parent):
            raise output_error(OSError(errno.ENOSPC, "disk full"), path) from error
        raise
    finally:
        _remove(temporary)


def sweep(folder: Path) -> None:
    """Removes what killed runs left half-written in a folder that no other run is writing to."""
    for path in folder.iterdir():
        if _LEFTOVER.fullmatch(path.name):
            _remove(path)


def disk_is_full(folder: Path) -> bool:
    """Whether less than 1 MiB is left, as after a driver's failed write."""
    try:
        return shutil.disk_usage(folder).free < 1 << 20
    except OSError:
        return False


def _remove(path: Path) -> None:
    with suppress(OSError):
        if path.is_dir():
            shutil.rmtree(path)
        else:
            for leftover in [path, *(p for p in path.parent.iterdir() if p.name.startswith(f"{path.name}-"))]:
                leftover.unlink(missing_ok=True)


def write_bytes(path: Path, data: bytes) -> None:
    """A small file in one piece."""
    with writing(path) as temporary:
        temporary.write_bytes(data)


def write_json(path: Path, value: Any) -> None:
    """Plain values as readable JSON."""
    write_bytes(path, (json.dumps(value, indent=2, ensure_ascii=False, allow_nan=False) + "\n").encode())


def path_within(folder: Path, name: str) -> Path:
    """`folder/name`, refused with `ValueError` where the name leads out of the folder."""
    parts = PurePosixPath(name).parts
    if not parts or PurePosixPath(name).is_absolute() or ".." in parts or "\\" in name or "\0" in name:
        raise ValueError(f"'{name}' is no name inside {folder}")
    return folder.joinpath(*parts)


class FileHashes:
    """BLAKE2b of files' contents, remembered by path, size and time of change."""

    def __init__(self, memory: Path | None = None) -> None:
        self._memory = memory
        self._known: dict[str, list[Any]] = {}
        self._asked: set[str] = set()
        self._new = False
        if memory is not None:
            with suppress(OSError, ValueError):
                known = json.loads(memory.read_text())
                self._known = known if isinstance(known, dict) else {}

    def of_file(self, path: Path) -> str:
        """Hash of one file's bytes."""
        try:
            stat = path.stat()
            mark = [stat.st_size, stat.st_mtime_ns]
            known = self._known.get(str(path))
            self._asked.add(str(path))
            if isinstance(known, list) and known[:2] == mark and isinstance(known[-1], str):
                return known[-1]
            digest = blake2b(digest_size=20)
            with path.open("rb") as file:
                while chunk := file.read(_CHUNK_BYTES):
                    digest.update(chunk)
        except OSError as error:
            raise FileError(f"can't be read ({error.strerror or error})", file=path) from error
        self._known[str(path)] = [*mark, digest.hexdigest()]
        self._new = True
        return digest.hexdigest()

    def manifest(self, path: Path, progress: Callable[[int, int], None] | None = None) -> dict[str, str]:
        """Names and hashes of what a file parameter stands for.

        A file stands for itself and its sidecars (`.prj`, world files, `.aux.xml`, `.msk`), a folder for
        the files directly inside that aren't hidden.
        """
        if path.is_dir():
            files = sorted(p for p in path.iterdir() if p.is_file() and not p.name.startswith("."))
        else:
            beside = [path.with_suffix(s) for s in _SIDECARS]
            beside += [path.with_name(path.name + s) for s in (".aux.xml", ".msk")]
            files = [path, *(p for p in beside if p != path and p.is_file())]
        hashes = {}
        for i, file in enumerate(files):
            hashes[file.name] = self.of_file(file)
            if progress:
                progress(i + 1, len(files))
        return hashes

    def of_written(self, path: Path) -> str:
        """Hash of a file, or of all that lies below a folder, that a stage wrote."""
        if path.is_dir():
            files = sorted(p for p in path.rglob("*") if p.is_file())
            return fingerprint_of_json([[p.relative_to(path).as_posix(), self.of_file(p)] for p in files])
        return self.of_file(path)

    def forget_unasked(self) -> None:
        """Forgets the files that nobody asked for since the start."""
        self._new = self._new or self._known.keys() != self._asked
        self._known = {path: mark for path, mark in self._known.items() if path in self._asked}

    def save(self) -> None:
        """Keeps what is known for the next run."""
        if self._memory is not None and self._new:
            write_bytes(self._memory, json.dumps(self._known, separators=(",", ":")).encode())
            self._new = False
