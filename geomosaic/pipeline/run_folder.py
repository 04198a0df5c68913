"""A folder that geomosaic writes to. A marker in it lists what geomosaic made; all else is somebody's."""

from __future__ import annotations

import fcntl
import json
import os
import threading
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path, PurePosixPath

from geomosaic import __version__
from geomosaic.doors.files import RUN_MARKER, check_name
from geomosaic.errors import OutputError
from geomosaic.pipeline import files

MARKER = RUN_MARKER
WORK = "work"
_LOCK = f"{WORK}/lock"
_MOST_MARKER_BYTES = 16 << 20
_OVERWRITE = "move it elsewhere, choose another output folder, or allow it with --overwrite"


class RunFolder:
    """A run's folder: `work/` is its cache, and only files that the marker lists are replaced or removed.

    overwrite: files that geomosaic did not make may be replaced where a result has their name. passing: the
    run leaves what others made alone. last: the fingerprints of the artefacts, by name, of the finished run
    that this one replaces. No link inside the folder is ever followed.
    """

    def __init__(self, path: Path, *, overwrite: bool = False) -> None:
        self.path = path.absolute()
        self.overwrite = overwrite
        there = self._marker()
        self._made, self._results = (set(), set()) if there is None else there
        self._listing = threading.RLock()
        self.passing = False
        self.last: dict[str, str] = {}

    @classmethod
    def checked(cls, path: Path, results: Iterable[str] = (), *, overwrite: bool = False) -> RunFolder:
        """The folder of a run that is to come; nothing is made.

        Raises `OutputError` if it holds files and no marker, or if one of the results to be written is there
        and not in the marker's list. Raises `FileError` for a path that is not in UTF-8.
        """
        check_name(path.absolute())
        folder = cls(path, overwrite=overwrite)
        if any(c < " " or c == "\x7f" for c in str(folder.path)):
            problem = "has a line break or another control character in its path, which GDAL leaves out"
            raise OutputError(problem, file=path, fix="choose another name")
        if not overwrite and not folder.marked and folder._holds_files():
            raise OutputError(
                "is not empty and not geomosaic's",
                file=path,
                fix="choose a new or empty folder, or allow it with --overwrite",
            )
        for name in results:
            folder._check_free(name)
        return folder

    @classmethod
    def opened(cls, path: Path, results: Iterable[str] = (), *, overwrite: bool = False) -> RunFolder:
        """The folder, made where missing, marked, and proven to be writable. Raises: as `checked`, before
        anything is made."""
        folder = cls.checked(path, results, overwrite=overwrite)
        files.make_folder(folder.path)
        folder._change()
        return folder

    @property
    def marked(self) -> bool:
        """Whether geomosaic made this folder."""
        return (self.path / MARKER).is_file()

    def within(self, name: str) -> Path:
        """The path of a name in this folder; see `files.path_within`."""
        return files.path_within(self.path, name)

    def claim(self, name: str) -> Path:
        """The path of a file that is about to be written, from now on in the marker's list.

        Raises `OutputError` if a file of that name is there that geomosaic did not make.
        """
        with self._listing:
            if name not in self._made:
                self._made |= (self._marker() or (set(), set()))[0]
                self._check_free(name)
                self._change(listed={name})
        return self.within(name)

    def note(self, names: Iterable[str], *, results: bool = False) -> None:
        """Lists files that a stage wrote by itself. results: they go with the run that they are of."""
        with self._listing:
            more = set(names)
            if not self._made.issuperset(more) or (results and not self._results.issuperset(more)):
                self._change(listed=more, results=more if results else ())

    @contextmanager
    def writing(self, name: str) -> Iterator[Path]:
        """A temporary path that takes a claimed name if the block succeeds; see `files.writing`."""
        with files.writing(self.claim(name)) as temporary:
            yield temporary

    def expect(self, results: Iterable[str], *, passing: bool = False) -> None:
        """Notes what a run may write. passing: its results and those of other runs leave each other alone."""
        self.passing = passing
        if passing:
            self._results = set(results)
        else:
            self._change(results=results)

    def stale(self, made: Iterable[str]) -> frozenset[str]:
        """Results of earlier runs, whatever their recipes, that are not among those made now."""
        return frozenset(self._made & self._results - set(made))

    def repeats(self, marks: Mapping[str, str], unsure: Collection[str]) -> bool:
        """Whether a run makes the artefacts of the last one again. marks: as `last`; unsure: those that say
        nothing of it."""
        names = {*marks, *self.last}.difference(unsure)
        return bool(self.last) and all(marks.get(name) == self.last.get(name) for name in names)

    def made(self) -> frozenset[str]:
        """The names in the marker's list."""
        return frozenset(self._made)

    def remove(self, name: str) -> None:
        """Removes a file or folder that the marker lists, and forgets it; another one is left alone."""
        if name in self._made:
            files.remove(self.within(name))
            self._change(dropped={name})

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Only one run writes here; `OutputError` if another does."""
        files.make_folder(self.within(WORK))
        path = self.within(_LOCK)
        try:
            handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o644)
        except OSError as error:
            raise files.output_error(error, path) from error
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            yield
        except BlockingIOError as error:
            raise OutputError(
                "another run is writing here", file=self.path, fix="wait for it or choose another folder"
            ) from error
        finally:
            os.close(handle)

    def _holds_files(self) -> bool:
        try:
            return any(not entry.name.startswith(".") for entry in self.path.iterdir())
        except FileNotFoundError:
            return False
        except OSError as error:
            raise files.output_error(error, self.path) from error

    def _check_free(self, name: str) -> None:
        path = self.within(name)
        if name in self._made or self.overwrite or not os.path.lexists(path):
            return
        raise OutputError("is in the way, and geomosaic did not make it", file=path, fix=_OVERWRITE)

    def _marker(self) -> tuple[set[str], set[str]] | None:
        """The marker's names of files, and of what runs may write; None where it can't be read."""
        try:
            data = files.read_own(self.within(MARKER), _MOST_MARKER_BYTES)
            marker = json.loads(data)
            made, results = (
                {name for name in names if isinstance(name, str) and _stays_inside(name)}
                for names in (marker["files"], marker.get("results", ()))
            )
            return made, results
        except (
            OSError,
            ValueError,
            KeyError,
            TypeError,
            AttributeError,
            RecursionError,
        ):  # none, or cut by a power failure
            return None

    def _change(
        self, listed: Iterable[str] = (), dropped: Iterable[str] = (), results: Iterable[str] = ()
    ) -> None:
        """Adds names to the marker's lists and takes others out. Names that another process listed stay."""
        path = self.within(MARKER)
        with self._listing, _locked(path):
            made, known = self._marker() or (self._made, self._results)
            self._made = (made | set(listed)) - set(dropped)
            known = known | set(results)
            if results:
                self._results = known
            marker = {"made_by": f"geomosaic {__version__}", "files": sorted(self._made)}
            files.write_json(path, {**marker, "results": sorted(known)})


@contextmanager
def _locked(path: Path) -> Iterator[None]:
    """Only one process at a time replaces a file, which others may have replaced while this one waited."""
    with ExitStack() as stack:
        with suppress(OSError):  # there is none yet, or the file system has no locks
            while True:
                handle = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC)
                stack.callback(os.close, handle)
                fcntl.flock(handle, fcntl.LOCK_EX)
                if os.path.samestat(os.fstat(handle), path.lstat()):
                    break
        yield


def _stays_inside(name: str) -> bool:
    path = PurePosixPath(name)
    inside = bool(path.parts) and not path.is_absolute() and ".." not in path.parts
    return inside and "\\" not in name and "\0" not in name
