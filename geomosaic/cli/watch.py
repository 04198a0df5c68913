"""`geomosaic watch`: previews while frames arrive, and the whole run once they have all come."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Final

from geomosaic.errors import CancelledError, GeomosaicError

if TYPE_CHECKING:
    from geomosaic.requests.watch_request import WatchRequest

_LOOK_S: Final = 0.5
"""Between two looks into the folder: a file that changed meanwhile is still being written."""
Files = frozenset[tuple[Path, int, int]]


def until_all_have_come(request: WatchRequest, *, quiet: bool) -> None:
    """Shows previews of the frames that arrive, until none has for `request.after` seconds.

    Raises: `FileError` for what is no folder; `InputError` for what the whole run could not use, such as
    frames of a format that needs a reader. Raises: `OutputError` for a folder that it could not write to.
    """
    from geomosaic.requests.perform import check_folder

    job = request.job()
    job.recipe.check_files(skip={0})  # the first reads the frames, which are to come
    check_folder(job)
    shown, before, changed = Files(), Files(), time.monotonic()
    while True:
        there = _frames(request.frames)
        if there != before:
            before, changed = there, time.monotonic()
        elif there != shown:
            shown = there
            line = _preview(request, len(there))
            if not quiet:
                print(line, flush=True)
        elif there and time.monotonic() - changed >= request.after:
            return
        time.sleep(_LOOK_S)


def _preview(request: WatchRequest, count: int) -> str:
    """Makes a preview; returns the line that says what came of it."""
    from geomosaic.pipeline.reporter import Silent
    from geomosaic.requests.perform import perform

    began = time.monotonic()
    job = request.preview()
    try:
        perform(job, Silent())
    except CancelledError:
        raise
    except GeomosaicError as error:
        return f"waiting    {count} frames there: {error}"
    page = job.folder / "preview.html"
    return f"preview    {page} of {count} frames, {time.monotonic() - began:.1f} s"


def _frames(folder: Path) -> Files:
    """The frames there are, with their sizes and times. Raises: as `frame_files`, but for none yet."""
    from geomosaic.survey.folder import NoFramesError, frame_files

    try:
        found = frame_files(folder)
    except NoFramesError:
        return Files()
    out = set()
    for path in found:
        try:
            its = path.stat()
        except OSError:  # gone again
            continue
        out.add((path, its.st_size, its.st_mtime_ns))
    return Files(out)
