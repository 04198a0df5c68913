"""Files of a run, for a process that may be on a machine without the run's disk.

Whoever opens a file that a worker may need asks `at_hand` where it lies. On the run's disk that is its own
path. Elsewhere it is a copy's, and `NotAtHand` where none has come yet: who began the work then brings one
(`pipeline.carrier`), and the work starts again.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


class NotAtHand(BaseException):
    """A file of which this machine has no copy."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self.path = path


class Copies:
    """Copies of a run's files in a folder of this machine: those of one folder lie in one folder."""

    def __init__(self, run: Path, folder: Path) -> None:
        self.run = run
        self.folder = folder
        self._whole: dict[Path, bool] = {}
        self._writing = threading.Lock()

    def place(self, path: Path) -> Path:
        """Where the copy of a file lies, or would."""
        parent = hashlib.blake2b(os.fsencode(path.parent), digest_size=10).hexdigest()
        return self.folder / parent / path.name

    def known(self, path: Path) -> bool:
        """Whether a file was brought, or is known to be nowhere."""
        return path in self._whole

    def find(self, path: Path) -> Path:
        """The copy's path, the file's own one where there is no such file. Raises: `NotAtHand`."""
        if path.is_relative_to(self.folder):
            return path
        try:
            return self.place(path) if self._whole[path] else path
        except KeyError:
            raise NotAtHand(path) from None

    def take(self, path: Path, data: bytes | None) -> None:
        """A file that was brought; None: there is none."""
        with self._writing:
            if data is not None:
                place = self.place(path)
                place.parent.mkdir(parents=True, exist_ok=True)
                part = place.with_name(f".{place.name}.{os.getpid()}.geomosaic.part")
                part.write_bytes(data)
                part.replace(place)
            self._whole[path] = data is not None

    def forget(self, paths: list[Path]) -> None:
        """Drops copies of files that may change."""
        with self._writing:
            for path in paths:
                if self._whole.pop(path, False):
                    self.place(path).unlink(missing_ok=True)

    def paths(self) -> list[Path]:
        """Of all files that are known."""
        return list(self._whole)

    def remove(self) -> None:
        """All of them go."""
        shutil.rmtree(self.folder, ignore_errors=True)


class _Present(threading.local):
    copies: Copies | None = None


_present = _Present()


@contextmanager
def reading_copies(copies: Copies | None) -> Iterator[None]:
    """In the block, on this thread, files are read from copies; None: from their own places."""
    before = _present.copies
    _present.copies = copies
    try:
        yield
    finally:
        _present.copies = before


def at_hand(path: Path) -> Path:
    """Where a file can be read on this machine. Raises: `NotAtHand` where it has to be brought."""
    return path if _present.copies is None else _present.copies.find(path.absolute())


def own_place(path: Path) -> Path:
    """Where this machine may keep a file of its own under a path of the run: nobody else sees it."""
    return path if _present.copies is None else _present.copies.place(path.absolute())


def shares_disk() -> bool:
    """Whether what is written under a path of the run is seen by the run."""
    return _present.copies is None
