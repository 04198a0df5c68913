"""Files of a run folder: whole under their final name, and never reached through a link."""

from __future__ import annotations

import errno
import json
import os
import re
import shutil
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path, PurePosixPath
from typing import Any, BinaryIO, TypeGuard

from geomosaic.doors.at_hand import at_hand
from geomosaic.errors import GeomosaicError, LinkError, OutputError

_LEFTOVER = re.compile(r"\..+\.\d+\.geomosaic\.(part(\..+)?|old)")
_FIXES = {
    errno.ENOSPC: ("no space left on the disk", "free some or choose another output folder"),
    errno.EDQUOT: ("the disk quota is used up", "free some or choose another output folder"),
    errno.EACCES: ("no permission to write", "choose an output folder of your own"),
    errno.EPERM: ("no permission to write", "choose an output folder of your own"),
    errno.EROFS: ("the file system is read-only", "choose another output folder"),
    errno.ENOTDIR: ("a file stands where a folder is needed", "choose another output folder"),
    errno.EEXIST: ("a file stands where a folder is needed", "choose another output folder"),
    errno.EISDIR: ("a folder stands where the file is to go", "move it away"),
    errno.EFBIG: ("the file is too large for the disk", "choose another output folder"),
    errno.ENAMETOOLONG: ("the name is too long for the file system", "choose a shorter one"),
    errno.ENOENT: ("the folder can't be made", "choose another output folder"),
}


def is_output_error(error: BaseException) -> TypeGuard[OSError]:
    """Whether the system refused to write, and nobody has said so to the user yet."""
    full = (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EFBIG)
    return isinstance(error, OSError) and not isinstance(error, GeomosaicError) and error.errno in full


def output_error(error: OSError, path: Path) -> OutputError:
    """What the user can do about a failed write."""
    problem, fix = _FIXES.get(
        error.errno or 0, (f"can't be written ({error.strerror or error})", "see the disk")
    )
    return OutputError(problem, file=path, fix=fix)


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
def in_one_wording(run_folder: Path) -> Iterator[None]:
    """A disk that takes no more is reported alike, whether a stage, the cache or the recorder noticed it."""
    try:
        yield
    except OSError as error:
        cause = error.__cause__ if isinstance(error, OutputError) else error
        if cause is None or not is_output_error(cause):
            raise
        file = error.file if isinstance(error, OutputError) else error.filename
        raise output_error(cause, Path(file or run_folder)) from cause


@contextmanager
def refusals_named(path: Path) -> Iterator[None]:
    """What the system refuses in the block becomes an `OutputError` that names the path."""
    try:
        yield
    except OSError as error:
        raise output_error(error, path) from error


@contextmanager
def writing(path: Path) -> Iterator[Path]:
    """A temporary path next to `path` that takes its name if the block succeeds, and vanishes if not.

    The temporary name ends like the final one, so that drivers know the format. The block may make a
    file or a whole folder; a folder takes the place of an older one. A file never takes the place of a
    folder, nor a folder that of a file. That, a full disk or a missing permission becomes an `OutputError`
    that names the final path.
    """
    if path.name in ("", ".."):
        raise output_error(IsADirectoryError(errno.EISDIR, "a folder"), path)
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.geomosaic.part{path.suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        _remove_temporary(temporary)
        yield temporary
        old = path.with_name(f".{path.name}.{os.getpid()}.geomosaic.old")
        if path.exists() and temporary.exists() and path.is_dir() != temporary.is_dir():
            raise OSError(errno.EISDIR if path.is_dir() else errno.ENOTDIR, "another kind stands there")
        if temporary.is_dir() and path.exists():
            path.replace(old)
        temporary.replace(path)
        remove(old)
    except OSError as error:
        if isinstance(error, GeomosaicError):
            raise
        raise output_error(error, path) from error
    except (RuntimeError, MemoryError) as error:
        if not isinstance(error, GeomosaicError) and disk_is_full(path.parent):
            raise output_error(OSError(errno.ENOSPC, "disk full"), path) from error
        raise
    finally:
        _remove_temporary(temporary)


def sweep(*folders: Path) -> None:
    """Removes what killed runs left half-written in folders that no other run is writing to."""
    for path in (path for folder in folders for path in folder.iterdir()):
        if _LEFTOVER.fullmatch(path.name):
            _remove_temporary(path)


def disk_is_full(folder: Path) -> bool:
    """Whether less than 1 MiB is left, as after a driver's failed write."""
    try:
        return shutil.disk_usage(folder).free < 1 << 20
    except OSError:
        return False


def remove(path: Path) -> None:
    """Removes a file or a folder; of a link the link, never its target."""
    with suppress(OSError):
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        else:
            path.unlink(missing_ok=True)


def _remove_temporary(path: Path) -> None:
    """A half-written file, with what its driver left next to it (`-journal`, `-wal`)."""
    with suppress(OSError):
        for journal in path.parent.iterdir():
            if journal.name.startswith(f"{path.name}-"):
                remove(journal)
    remove(path)


def write_bytes(path: Path, *pieces: bytes | memoryview) -> None:
    """A file as a whole: pieces, one after the other."""
    with writing(path) as temporary, temporary.open("wb") as file:
        file.writelines(pieces)


def write_json(path: Path, value: Any) -> None:
    """Plain values as readable JSON."""
    write_bytes(path, (json.dumps(value, indent=2, ensure_ascii=False, allow_nan=False) + "\n").encode())


def path_within(folder: Path, name: str) -> Path:
    """`folder/name`, with no link on the way from `folder` down.

    Raises `ValueError` where the name leads out of the folder, `LinkError` where a link stands.
    """
    parts = PurePosixPath(name).parts
    if not parts or PurePosixPath(name).is_absolute() or ".." in parts or "\\" in name or "\0" in name:
        raise ValueError(f"'{name}' is no name inside {folder}")
    at = folder
    for part in parts:
        at = at / part
        if at.is_symlink():
            raise LinkError("is a link, and links are not followed there", file=at, fix="remove it")
    return at


@contextmanager
def open_own(path: Path) -> Iterator[BinaryIO]:
    """A file of a run folder, opened to be read, never through a link. Raises `OSError`."""
    handle = os.open(at_hand(path), os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    with os.fdopen(handle, "rb") as file:
        if not stat.S_ISREG(os.fstat(handle).st_mode):
            raise OSError(errno.EINVAL, "no regular file", str(path))
        yield file


def read_own(path: Path, most_bytes: int) -> bytes:
    """All of a small file of a run folder, as `open_own`. Raises `ValueError` beyond `most_bytes`."""
    with open_own(path) as file:
        if os.fstat(file.fileno()).st_size > most_bytes:
            raise ValueError(f"{path} is larger than {most_bytes} bytes")
        return file.read()
