"""A recording in Rerun: the recording as an .rrd with a layout.

Rerun is imported only when asked for: it is large. Nothing that is drawn asks any network.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from geomosaic.errors import FileError, OutputError
from geomosaic.recording.file.model import Recording
from geomosaic.recording.file.reader import printable, read_recording
from geomosaic.recording.rerun.block_view import draw_block
from geomosaic.recording.rerun.image_view import draw_chips, draw_images, draw_picks, draw_thumbnails
from geomosaic.recording.rerun.layout import layout
from geomosaic.recording.rerun.list_view import PICK, draw_lists
from geomosaic.recording.rerun.plan_view import draw_plan
from geomosaic.recording.rerun.rounds_view import draw_spectra, draw_stages, draw_steps
from geomosaic.recording.rerun.strip_view import LINE, draw_strip_plan, log_strips
from geomosaic.recording.rerun.viewer import open_viewer, screenshot

STEP = "step"
LOG = "/log"
_STAGE_WIDTH = 22

_PARTS = (
    *(draw_plan, draw_block, draw_lists, draw_stages, draw_steps, draw_spectra),
    *(draw_images, draw_chips, draw_picks, draw_strip_plan),
)


def write_rrd(recording: Recording, path: Path) -> None:
    """The recording as Rerun's own file with the project's layout; the artefacts are left out.

    The plan and the lists are as at the end, on every timeline. `pick` chooses a frame and a pair, worst
    first; the log lies at its beginning, and on `step`, the count of messages. Offsets of strips lie on the
    timeline `line`.
    Raises OutputError where it can't be written, FileError if Rerun can't read the recording.
    """
    import rerun

    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        temporary.touch()
    except OSError as error:
        raise OutputError(error.strerror or str(error), file=path, fix="choose another file") from error
    try:
        stream = rerun.RecordingStream("geomosaic", recording_id=recording.path.parent.name or "run")
        stream.save(temporary, default_blueprint=layout(recording))
        recording = read_recording(recording.path, with_images=True)
        draw(recording, stream)
        draw_thumbnails(recording, stream)
        draw_log(recording, stream)
        log_strips(recording, stream)
        stream.flush()
        stream.disconnect()
        temporary.replace(path)
    except (RuntimeError, ValueError) as error:
        raise FileError(
            f"Rerun can't show it ({error})", file=recording.path, fix="record the run again"
        ) from error
    finally:
        temporary.unlink(missing_ok=True)


def draw(recording: Recording, stream: Any) -> None:
    """All that is drawn for good."""
    for part in _PARTS:
        part(recording, stream)


def draw_progress(recording: Recording, stream: Any) -> None:
    """What changes while a stage is on."""
    for part in (draw_stages, draw_lists):
        part(recording, stream)


def draw_log(recording: Recording, stream: Any, first: int = 0) -> None:
    """The log's lines from a number on; the stage is their first column."""
    import rerun

    levels = {"warning": "WARN", "fatal": "CRITICAL"}
    for line in recording.log[first:]:
        stream.set_time(PICK, sequence=0)
        stream.set_time(LINE, sequence=0)
        stream.set_time(STEP, sequence=line.number)
        stream.set_time("time", timestamp=line.time_ns / 1e9)
        text = printable(f"{line.frame}: {line.text}" if line.frame else line.text)
        stage = printable(line.stage) or "run"
        level = levels.get(line.level, line.level.upper())
        stream.log(LOG, rerun.TextLog(f"{stage:<{_STAGE_WIDTH}} {text}", level=level))
    stream.reset_time()


__all__ = ["draw", "draw_log", "draw_progress", "layout", "open_viewer", "screenshot", "write_rrd"]
