"""Only one process at a time writes to a folder."""

from __future__ import annotations

import errno
import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from geomosaic.errors import OutputError

_NO_LOCKS: Final = (errno.EBADF, errno.ENOLCK, errno.ENOTSUP, errno.EINVAL)


@contextmanager
def locked_folder(folder: Path, writer: str) -> Iterator[None]:
    """The folder while the block lasts, for one process alone; for all where a file system has no locks.

    Args: writer: what writes there, as a message names it.
    Raises: `OutputError` if another process has it.
    """
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            problem, fix = (
                f"another {writer} is writing here",
                "wait for it, end it, or choose another folder",
            )
            raise OutputError(problem, file=folder, fix=fix) from error
        except OSError as error:
            if error.errno not in _NO_LOCKS:
                raise
        yield
    finally:
        os.close(handle)
