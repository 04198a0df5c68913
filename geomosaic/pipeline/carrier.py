"""Work on Dask whose workers do not see the run's disk: files go there with the work that needs them.

A worker that lacks a file says so instead of a result. The run's process then sends the work again, to that
worker, with the file's bytes. So nothing but Dask's own connections is needed, and workers read nothing that
the run was not given or has not made.
"""

from __future__ import annotations

import atexit
import functools
import importlib
import os
import pickle
import secrets
import tempfile
import threading
from collections.abc import Callable
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

from geomosaic.doors.at_hand import Copies, NotAtHand, reading_copies
from geomosaic.errors import FileError
from geomosaic.pipeline import files
from geomosaic.pipeline.hashes import FileHashes, is_file
from geomosaic.pipeline.run_folder import WORK

ITEMS: Final = "items"
"""The folder of results that are named by their content, and so never change."""
_MOST_FILE_BYTES: Final = 2 << 30
"""A task in Dask's scheduler may be so large; a larger file wants a shared disk."""
_COURIERS: Final = 2
"""Threads that send files: one reads while another sends."""


class RunFiles:
    """The files that a run may send: those it reads, and those in its folder."""

    def __init__(self, folder: Path, hashes: FileHashes) -> None:
        self.folder = folder.absolute()
        self._hashes = hashes

    def bytes_of(self, path: Path) -> bytes | None:
        """What a file holds; None if there is none. Raises: `FileError` for one that can't be sent."""
        path = Path(os.path.normpath(path))
        try:
            inside = files.path_within(self.folder, path.relative_to(self.folder).as_posix())
        except ValueError:
            inside = None
        if inside is None and not self._hashes.reads(path):
            return None
        if path.suffix.lower() == ".vrt":
            fix = "write one TIFF of it (gdal_translate), or share the disk with all workers"
            raise FileError("names other files, which a worker elsewhere lacks", file=path, fix=fix)
        try:
            with path.open("rb") as file:
                if os.fstat(file.fileno()).st_size > _MOST_FILE_BYTES:
                    fix = "share the disk with all workers"
                    raise FileError("is too large to be sent to workers", file=path, fix=fix)
                return file.read()
        except FileNotFoundError:
            return None
        except OSError as error:
            raise FileError(
                f"can't be read ({error.strerror or error})", file=path, fix="run again"
            ) from error

    def with_companions(self, path: Path) -> list[Path]:
        """A file, and the inputs of the same stem in its folder."""
        return sorted({path, *self._hashes.named([str(path)])})


@dataclass(frozen=True)
class RunDisk:
    """How a worker tells whether it sees the run's disk: by a file there, and what it holds.

    step: rises where files may have changed that are not named by their content.
    """

    run: Path
    proof: Path
    token: bytes
    step: int = 0

    def is_here(self) -> bool:
        """Whether this process sees it."""
        try:
            return self.proof.read_bytes() == self.token
        except OSError:
            return False


@dataclass(frozen=True)
class CarriedFile:
    """A file on its way; data: None if there is none."""

    path: Path
    data: bytes | None


@dataclass(frozen=True)
class WantedFiles:
    """What a worker answers that lacks files; its address."""

    paths: list[Path]
    worker: str


_copies: dict[bytes, tuple[int, Copies]] = {}
_copying = threading.Lock()


def _copies_of(disk: RunDisk) -> Copies:
    """This process's copies of a run's files. Those that may have changed since an earlier step go."""
    with _copying:
        step, copies = _copies.get(disk.token, (disk.step, None))
        if copies is None:
            for token in [t for t, (_, old) in _copies.items() if old.run == disk.run]:
                _copies.pop(token)[1].remove()
            copies = Copies(disk.run, Path(tempfile.mkdtemp(prefix="geomosaic-")))
            atexit.register(copies.remove)
        if step < disk.step:
            copies.forget([p for p in copies.paths() if p.is_relative_to(disk.run) and ITEMS not in p.parts])
        _copies[disk.token] = max(step, disk.step), copies
        return copies


def drop_copies(token: bytes) -> None:
    """Removes this process's copies of a run's files."""
    with _copying:
        _, copies = _copies.pop(token, (0, None))
    if copies is not None:
        copies.remove()


def _done_there(disk: RunDisk, wanted: list[Path], call: _Call, *brought: CarriedFile) -> Any:
    """Runs in the worker: the call's result, or `WantedFiles`. wanted: what the call most likely reads."""
    if disk.is_here():
        return call()
    copies = _copies_of(disk)
    for file in brought:
        copies.take(file.path, file.data)
    missing = [path for path in wanted if not copies.known(path)]
    try:
        if not missing:
            with reading_copies(copies):
                return call()
    except NotAtHand as lacking:
        missing = [lacking.path]
    return WantedFiles(missing, _address())


def _address() -> str:
    from distributed import get_worker

    return str(get_worker().address)


class _Named(pickle.Pickler):
    """Notes which paths stand in what is pickled, as such or as texts."""

    def __init__(self) -> None:
        super().__init__(_Nowhere(), protocol=pickle.HIGHEST_PROTOCOL, buffer_callback=lambda _: None)
        self.paths: set[Path] = set()

    def persistent_id(self, value: Any) -> None:
        """Called with each object on the way."""
        if isinstance(value, Path) or (isinstance(value, str) and os.sep in value):
            self.paths.add(Path(value).absolute())


class _Nowhere:
    def write(self, data: bytes) -> int:
        return len(data)


def paths_in(value: Any) -> set[Path]:
    """The paths in a value, however deep."""
    pickler = _Named()
    pickler.dump(value)
    return pickler.paths


@dataclass(frozen=True)
class _Call:
    """A function with its arguments."""

    function: Callable[..., Any]
    args: tuple[Any, ...]

    def __call__(self) -> Any:
        return self.function(*self.args)


class CarryingExecutor(Executor):
    """Does work on Dask as its own executor does, and sends files after it where they are wanted.

    The files travel in the task and not by `scatter`: what was scattered is lost with the worker that has it.
    """

    def __init__(self, client: Any, run_files: RunFiles) -> None:
        dask: Any = importlib.import_module("dask")
        dask.config.set({"distributed.admin.large-graph-warning-threshold": _MOST_FILE_BYTES})
        self._client = client
        self._files = run_files
        proof = run_files.folder / WORK / f".disk.{os.getpid()}.geomosaic.part"
        self._disk = RunDisk(run_files.folder, proof, secrets.token_bytes(16))
        files.write_bytes(proof, self._disk.token)
        self._courier = ThreadPoolExecutor(_COURIERS, "carrier")

    def new_step(self) -> None:
        """Files may have changed that are not named by their content."""
        self._disk = replace(self._disk, step=self._disk.step + 1)

    def submit(self, function: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """As `Executor`'s; the last argument is the item."""
        done: Future[Any] = Future()
        call = _Call(functools.partial(function, **kwargs), args)
        self._send(done, call, sorted(path for path in paths_in(args[-1:]) if is_file(path)), None)
        return done

    def _send(self, done: Future[Any], call: _Call, wanted: list[Path], answer: WantedFiles | None) -> None:
        """The call on its way; where a worker lacked files, to that worker and with them."""
        where: dict[str, Any] = {"pure": False}
        carried = []
        if answer is not None:
            where |= {"workers": [answer.worker], "allow_other_workers": True}
            paths = {p for path in answer.paths for p in self._files.with_companions(path)}
            carried = [CarriedFile(path, self._files.bytes_of(path)) for path in sorted(paths)]
        sent = self._client.get_executor(**where).submit(_done_there, self._disk, wanted, call, *carried)
        sent.add_done_callback(lambda one: self._courier.submit(self._arrived, one, done, call, wanted))

    def _arrived(self, sent: Future[Any], done: Future[Any], call: _Call, wanted: list[Path]) -> None:
        try:
            answer = sent.result()
            if isinstance(answer, WantedFiles):
                self._send(done, call, wanted, answer)
            else:
                done.set_result(answer)
        except BaseException as error:
            done.set_exception(error)

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Ends the couriers. Workers drop their copies now, after a failure with the next run."""
        self._courier.shutdown(wait=False, cancel_futures=True)
        files.remove(self._disk.proof)
        if wait:
            with suppress(OSError, ValueError):
                self._client.run(drop_copies, self._disk.token, on_error="ignore")
