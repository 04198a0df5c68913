"""`geomosaic inspect`, `replay`, `diff` and `view`: what can be done with a run.mcap."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from geomosaic.cli.inspection import RecordingFile, diff, inspect, recording_file
from geomosaic.cli.options import Dask, FixedTime, Overwrite, RunFolder, Sets, Workers
from geomosaic.errors import FileError, InputError, UnknownNameError

if TYPE_CHECKING:
    from geomosaic.pipeline.recipe import Recipe

app = typer.Typer()
for command in (inspect, diff):
    app.command()(command)


@app.command()
def replay(
    recording: RecordingFile,
    output: RunFolder,
    start: Annotated[
        str,
        typer.Option(
            "--from", metavar="STAGE", help="first stage to run again; default: the first that --set changes"
        ),
    ] = "",
    set: Sets = None,
    workers: Workers = None,
    dask: Dask = None,
    fixed_time: FixedTime = False,
    overwrite: Overwrite = False,
) -> None:
    """Run a recorded recipe again from any stage on, taking what comes before from the recording.

    Stages that read pixels need the frames where they were. Trust a recording as you would a recipe: it
    names the files to read.
    """
    from geomosaic.cli.mosaic import execute
    from geomosaic.pipeline.given import given_stage, missing_inputs
    from geomosaic.pipeline.recipe import parse_recipe
    from geomosaic.pipeline.registry import installed
    from geomosaic.recording import read_recording

    path = recording_file(recording)
    recorded = read_recording(path)
    if path.absolute().parent == output.absolute():
        raise InputError("this is the run to be replayed", file=output, mend="give another folder with -o")
    if not recorded.recipe_yaml:
        raise FileError("it holds no recipe", file=path, mend="run the recipe itself")
    recipe = parse_recipe(recorded.recipe_yaml, installed(), set or (), file=str(path))
    first = _first_stage(recipe, start, set or [], path)
    given = {i: given_stage(recorded, recipe, i) for i in range(first)}
    try:
        execute(recipe, output, workers, dask, fixed_time, overwrite, given)
    except FileError as error:
        for path in missing_inputs(given.values()):
            mend = "put it back there, or replay from a stage that doesn't need it"
            raise FileError("an input of the recorded run is gone", file=path, mend=mend) from error
        raise


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


def _first_stage(recipe: Recipe, start: str, sets: list[str], file: Path) -> int:
    """The number of the first stage to run: that of `--from`, else the first that `--set` changes."""
    ids = [step.stage.id for step in recipe.steps]
    changed = {ids.index(s.partition("=")[0].strip().rpartition(".")[0]): s for s in sets}
    if not start:
        return min(changed, default=0)
    if start not in ids:
        raise UnknownNameError("stage of this recording", start, ids, file=file)
    first = ids.index(start)
    if changed and min(changed) < first:
        earlier = min(changed)
        problem = f"--set {changed[earlier]} changes a stage before {start}"
        raise InputError(problem, mend=f"replay with --from {ids[earlier]}")
    return first
