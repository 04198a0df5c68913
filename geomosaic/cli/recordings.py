"""`geomosaic inspect`, `replay`, `diff` and `view`: what can be done with a run.mcap."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Annotated

import typer

from geomosaic.cli.inspection import RecordingFile, diff, inspect, recording_file
from geomosaic.cli.replaying import replay

__all__ = ["app", "diff", "inspect", "replay", "view"]

app = typer.Typer()
for command in (inspect, diff, replay):
    app.command()(command)


@app.command()
def view(
    recording: RecordingFile,
    save: Annotated[
        Path | None, typer.Option(metavar="OUT.rrd", help="write Rerun's file and show nothing")
    ] = None,
    screenshot: Annotated[
        Path | None, typer.Option(metavar="PNG", help="an image of the view, made without a screen")
    ] = None,
) -> None:
    """Show a recording in Rerun: the map, the images, the offsets of each round, the log."""
    from geomosaic.recording import read_recording
    from geomosaic.recording import view as rerun_view

    recorded = read_recording(recording_file(recording))
    with tempfile.TemporaryDirectory(prefix="geomosaic-view-") as folder:
        rrd = save or Path(folder) / f"{recorded.path.stem}.rrd"
        rerun_view.write_rrd(recorded, rrd)
        if screenshot is not None:
            rerun_view.screenshot(rrd, screenshot)
        if save is None and screenshot is None:
            rerun_view.open_viewer(rrd)
