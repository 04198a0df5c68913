"""Shows a recording in Rerun as it grows; see `live`, which starts this as a process."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

from geomosaic.errors import FileError
from geomosaic.recording.file.mcapfile import DAMAGED, items, opened
from geomosaic.recording.file.model import Recording
from geomosaic.recording.file.reader import take
from geomosaic.recording.rerun.image_view import draw_thumbnails
from geomosaic.recording.rerun.layout import layout
from geomosaic.recording.rerun.view import draw, draw_log, draw_progress

_WAIT_S: Final = 0.5
_PATIENCE_S: Final = 20.0
"""How long a recording may take to begin, and a viewer to take in what is left at the end."""
_AGAIN_S: Final = 2.0
"""From one drawing to the next."""
ADDRESS: Final = "GEOMOSAIC_LIVE"
"""Names a viewer that listens already, as rerun+http://127.0.0.1:PORT/proxy."""


def follow(path: Path, stream: Any, alive: Callable[[], bool]) -> Recording:
    """Draws what a recording tells as it grows, until it is whole or nobody writes to it any more.

    alive: says whether its run is on.
    """
    recording, logged, drawn_s = Recording(path, with_images=True), 0, 0.0
    known: set[str] = set()

    def more() -> bool:
        nonlocal logged, drawn_s, known
        if not alive():
            return False
        if time.monotonic() - drawn_s > _AGAIN_S:
            there = {table.name for table in recording.tables}
            new, known = there - known, there
            (draw if new else draw_progress)(recording, stream)
            if "frames.adjusted" in new:
                draw_thumbnails(recording, stream)
            draw_log(recording, stream, logged)
            logged, drawn_s = len(recording.log), time.monotonic()
        time.sleep(_WAIT_S)
        return True

    with opened(path) as file:
        for item in items(path, file, more):
            with suppress(*DAMAGED):
                take(recording, item)
    draw(recording, stream)
    draw_thumbnails(recording, stream)
    draw_log(recording, stream, logged)
    return recording


def _main(recording: Path, run: int) -> None:
    """What the process does: waits for the recording, opens the viewer, follows."""
    import rerun

    from geomosaic.recording.rerun.viewer import free_port, started

    def alive() -> bool:
        return Path(f"/proc/{run}").exists() if Path("/proc/self").exists() else os.getppid() == run

    address = os.environ.get(ADDRESS, "")
    if not address:
        port = free_port()
        started("--port", str(port))
        address = f"rerun+http://127.0.0.1:{port}/proxy"
    deadline = time.monotonic() + _PATIENCE_S
    while not _readable(recording) and alive() and time.monotonic() < deadline:
        time.sleep(_WAIT_S)
    stream = rerun.RecordingStream("geomosaic", recording_id=f"{recording.parent.name or 'run'}-{run}")
    stream.connect_grpc(address, default_blueprint=layout(None))
    follow(recording, stream, alive)
    stream.flush(timeout_sec=_PATIENCE_S)


def _readable(recording: Path) -> bool:
    try:
        with opened(recording):
            return True
    except FileError:
        return False


if __name__ == "__main__":
    _main(Path(sys.argv[1]), int(sys.argv[2]))
