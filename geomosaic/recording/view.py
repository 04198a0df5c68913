"""A recording in Rerun: the recording as an .rrd with a layout.

Rerun is imported only when asked for: it is large. Nothing that is drawn asks any network.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from mcap.records import Message

from geomosaic.errors import FileError, OutputError
from geomosaic.recording.image_view import draw_chips, draw_images, draw_picks, draw_thumbnails
from geomosaic.recording.layout import layout
from geomosaic.recording.list_view import PICK, draw_lists
from geomosaic.recording.mcapfile import BROKEN, MEND, items, opened
from geomosaic.recording.model import Recording
from geomosaic.recording.plan_view import draw_plan
from geomosaic.recording.reader import printable
from geomosaic.recording.rounds_view import draw_spectra, draw_stages, draw_steps
from geomosaic.recording.story import SHOWN, Story
from geomosaic.recording.strip_view import LINE, draw_strip_plan, log_strips
from geomosaic.recording.viewer import open_viewer, screenshot

STEP = "step"
LOG = "/log"
MOST_TOLD = 20
"""Times a recording's own size that what it shows may take, beside 64 MiB: images hardly pack, tables do."""
_ALWAYS_BYTES = 64 * 2**20
_STAGE_WIDTH = 22

_PARTS = (
    *(draw_plan, draw_lists, draw_stages, draw_steps, draw_spectra),
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
        story = told(recording.path)
        draw(story, stream)
        draw_thumbnails(recording.path, story, stream)
        draw_log(story, stream)
        log_strips(recording, stream)
        stream.flush()
        stream.disconnect()
        temporary.replace(path)
    except (RuntimeError, ValueError) as error:
        raise FileError(f"Rerun can't show it ({error})", file=recording.path) from error
    finally:
        temporary.unlink(missing_ok=True)


def told(path: Path) -> Story:
    """What a recording tells a view; messages that are damaged are left out.

    Raises FileError if it would take far more memory than the file.
    """
    story, left_bytes = Story(), MOST_TOLD * path.stat().st_size + _ALWAYS_BYTES
    with opened(path) as file:
        for item in items(path, file):
            if not isinstance(item.record, Message) or item.schema not in SHOWN:
                continue
            left_bytes -= len(item.record.data)
            if left_bytes < 0:
                raise FileError("what it shows would take far more than the file itself", file=path, fix=MEND)
            try:
                message = SHOWN[item.schema].of(item.record.data)
                story.take(item.topic, message, item.record.sequence, item.record.log_time)
            except (*BROKEN, KeyError, TypeError, AttributeError):
                continue
    return story


def draw(story: Story, stream: Any) -> None:
    """All that is drawn for good."""
    for part in _PARTS:
        part(story, stream)


def draw_progress(story: Story, stream: Any) -> None:
    """What changes while a stage is on."""
    for part in (draw_stages, draw_lists):
        part(story, stream)


def draw_log(story: Story, stream: Any, first: int = 0) -> None:
    """The log's lines from a number on; the stage is their first column."""
    import rerun

    levels = {"WARNING": "WARN", "FATAL": "CRITICAL"}
    for line in story.log[first:]:
        stream.set_time(PICK, sequence=0)
        stream.set_time(LINE, sequence=0)
        stream.set_time(STEP, sequence=line.number)
        stream.set_time("time", timestamp=line.time_ns / 1e9)
        text = printable(f"{line.frame}: {line.text}" if line.frame else line.text)
        stage = printable(line.stage) or "run"
        entry = rerun.TextLog(f"{stage:<{_STAGE_WIDTH}} {text}", level=levels.get(line.level, line.level))
        stream.log(LOG, entry)
    stream.reset_time()


__all__ = ["draw", "draw_log", "draw_progress", "layout", "open_viewer", "screenshot", "told", "write_rrd"]
