"""`geomosaic view`: a recording in Rerun."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Annotated

import typer

from geomosaic.cli.inspection import RecordingFile, check_new, recording_file


def view(
    recording: RecordingFile,
    save: Annotated[
        Path | None, typer.Option(metavar="OUT.rrd", help="write a file for Rerun instead of opening it")
    ] = None,
    screenshot: Annotated[
        Path | None, typer.Option(metavar="PNG", help="write an image of the view instead of opening it")
    ] = None,
) -> None:
    """Show a recording in Rerun.

    Shown are the map, the images, the offsets of each round and the log.
    """
    from geomosaic.recording import read_recording
    from geomosaic.recording.rerun import view as rerun_view

    check_new(save, "--save")
    check_new(screenshot, "--screenshot")
    recorded = read_recording(recording_file(recording))
    with tempfile.TemporaryDirectory(prefix="geomosaic-view-") as folder:
        rrd = save or Path(folder) / f"{recorded.path.stem}.rrd"
        rerun_view.write_rrd(recorded, rrd)
        if screenshot is not None:
            rerun_view.screenshot(rrd, screenshot)
        if save is None and screenshot is None:
            rerun_view.open_viewer(rrd)
