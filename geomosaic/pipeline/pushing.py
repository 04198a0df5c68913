"""The results of a finished run, copied into a folder of an object store."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

from geomosaic.doors.addresses import Address
from geomosaic.doors.remote import store, withdraw
from geomosaic.errors import FileError, InputError
from geomosaic.pipeline.recipe import RUN_JSON
from geomosaic.pipeline.reporter import Reporter
from geomosaic.pipeline.run_folder import WORK, RunFolder


@dataclass(frozen=True)
class Pushed:
    """Names that were copied, with their bytes."""

    names: tuple[str, ...]
    size_bytes: int


def push(run: Path, folder: Address, reporter: Reporter) -> Pushed:
    """Copies what a finished run made, without its cache, into a folder of an object store.

    run.json goes last, and that of an earlier run is deleted first: a folder without it holds no whole run.
    Files that are there are replaced.

    Raises: `FileError` for a folder that is no finished run; `InputError` where the store refuses.
    """
    if folder.name or folder.vsi.startswith("/vsicurl/"):
        fix = "write s3://BUCKET/FOLDER/, gs:// or az://, with a slash at its end"
        raise InputError("is no folder of an object store", file=folder.text, fix=fix)
    made = RunFolder(run)
    if not (made.path / RUN_JSON).is_file():
        raise FileError("holds no finished run", file=run, fix="give the folder of a run that ended")
    paths = [path for name in made.made() for path in _files(made.within(name))]
    inside = sorted({path.relative_to(made.path).as_posix() for path in paths} - {RUN_JSON})
    names = [*(name for name in inside if not name.startswith(f"{WORK}/")), RUN_JSON]
    started = time.monotonic()
    reporter.stage_started(0, 1, "Push")
    size_bytes = 0
    withdraw(_within(folder, RUN_JSON))
    for done, name in enumerate(names):
        reporter.progress(done, len(names), "files")
        size_bytes += store(made.within(name), _within(folder, name))
    reporter.stage_finished(time.monotonic() - started, "work")
    return Pushed(tuple(names), size_bytes)


def _within(folder: Address, name: str) -> Address:
    return Address(f"{folder.text.rstrip('/')}/{name}", f"{folder.vsi.rstrip('/')}/{name}", name)


def _files(path: Path) -> list[Path]:
    """A file, or those of a folder; links are left."""
    found = sorted(path.rglob("*")) if path.is_dir() else [path]
    return [file for file in found if file.is_file() and not file.is_symlink()]
