"""`geomosaic inspect`, `replay`, `diff` and `view`: what can be done with a run.mcap."""

from __future__ import annotations

import dataclasses
import json
import shutil
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console

from geomosaic.cli.options import AsJson, Dask, FixedTime, RunFolder, Sets, Workers
from geomosaic.errors import FileError, InputError, UnknownNameError

if TYPE_CHECKING:
    from geomosaic.pipeline.recipe import Recipe
    from geomosaic.recording import Recording

app = typer.Typer()

RecordingFile = Annotated[
    Path, typer.Argument(metavar="RUN.mcap", help="the recording of a run, or its folder")
]


@app.command()
def inspect(recording: RecordingFile, as_json: AsJson = False) -> None:
    """Say what a recording holds: stages, rounds of adjustment, warnings, topics, and whether it is whole."""
    from geomosaic.recording import read_recording, summary
    from geomosaic.recording.tables import show_summary

    short = summary(read_recording(_file(recording)))
    print(json.dumps(short, indent=2)) if as_json else show_summary(short, _console())


@app.command()
def diff(
    a: Annotated[Path, typer.Argument(metavar="A.mcap", help="a recording, or a run's folder")],
    b: Annotated[Path, typer.Argument(metavar="B.mcap", help="another one")],
    as_json: AsJson = False,
) -> None:
    """Say what differs between two recordings; exit 0 if the runs are equal and 1 if not.

    Durations, the cache and the environment don't count.
    """
    from geomosaic.recording import compare, read_recording
    from geomosaic.recording.tables import show_difference

    difference = compare(read_recording(_file(a)), read_recording(_file(b)))
    print(json.dumps(difference, indent=2)) if as_json else show_difference(difference, _console())
    raise typer.Exit(0 if difference["equal"] else 1)


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
) -> None:
    """Run a recorded recipe again from any stage on, taking what comes before from the recording.

    Stages that read pixels need the frames where they were. Trust a recording as you would a recipe: it
    names the files to read.
    """
    from geomosaic.cli.mosaic import execute
    from geomosaic.pipeline.recipe import parse_recipe
    from geomosaic.pipeline.registry import installed
    from geomosaic.recording import read_recording

    path = _file(recording)
    recorded = read_recording(path)
    if path.absolute().parent == output.absolute():
        raise InputError("this is the run to be replayed", file=output, mend="give another folder with -o")
    if not recorded.recipe_yaml:
        raise FileError("it holds no recipe", file=path, mend="run the recipe itself")
    recipe = parse_recipe(recorded.recipe_yaml, installed(), set or (), file=str(path))
    first = _first_stage(recipe, start, set or [], path)
    given = {i: _given(recorded, recipe, i) for i in range(first)}
    _bring_files(recipe, given, path.absolute().parent, output.absolute())
    try:
        execute(recipe, output, workers, dask, fixed_time, given)
    except FileError as error:
        for folder in _frame_folders(given):
            if not folder.is_dir():
                mend = "put the frames back there, or replay from a stage that reads no pixels"
                raise FileError("the frames' folder is gone", file=folder, mend=mend) from error
        raise


@app.command()
def view(
    recording: RecordingFile,
    save: Annotated[
        Path | None, typer.Option(metavar="OUT.rrd", help="write Rerun's file and show nothing")
    ] = None,
    screenshot: Annotated[
        Path | None, typer.Option(metavar="PNG", help="a picture of the view, made without a screen")
    ] = None,
) -> None:
    """Show a recording in Rerun: the map, the pictures, the offsets of each round, the log."""
    from geomosaic.recording import read_recording
    from geomosaic.recording import view as rerun_view

    recorded = read_recording(_file(recording))
    with tempfile.TemporaryDirectory(prefix="geomosaic-view-") as folder:
        rrd = save or Path(folder) / f"{recorded.path.stem}.rrd"
        rerun_view.write_rrd(recorded, rrd)
        if screenshot is not None:
            rerun_view.screenshot(rrd, screenshot)
        if save is None and screenshot is None:
            rerun_view.open_viewer(rrd)


def _file(path: Path) -> Path:
    return path / "run.mcap" if path.is_dir() else path


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


def _given(recorded: Recording, recipe: Recipe, index: int) -> dict[str, Any]:
    """The recorded outputs of a stage."""
    from geomosaic.pipeline.artefacts import decode
    from geomosaic.recording import artefact_data

    stage = recipe.steps[index].stage
    done = next(
        (s for s in recorded.stages if s.index == index and s.stage_id == stage.id and s.finished), None
    )
    kept = {a.name: a for a in recorded.artefacts if a.stage_index == index}
    if done is None or not kept.keys() >= stage.outputs.keys():
        problem = f"the recording has no whole outcome of stage {stage.id}"
        raise FileError(
            problem, file=recorded.path, mend=f"replay with --from {stage.id} or an earlier stage"
        )
    given: dict[str, Any] = {}
    for name, kind in stage.outputs.items():
        try:
            given[name] = decode(artefact_data(recorded, kept[name]), kind)
        except FileError as error:
            mend = f"replay with --from {stage.id} or an earlier stage"
            raise FileError(error.problem, file=recorded.path, mend=mend) from error
    return given


def _bring_files(
    recipe: Recipe, given: dict[int, dict[str, Any]], recorded_folder: Path, output: Path
) -> None:
    """Copies into the new run folder the files that given artefacts name and later stages take."""
    from geomosaic.pipeline.files import path_within, writing

    later = recipe.steps[len(given) :]
    wanted = {name for step in later for name in (*step.stage.inputs, *step.stage.optional_inputs)}
    for index, outputs in given.items():
        for name in wanted & outputs.keys():
            for file in _named_files(outputs[name]):
                try:
                    source, target = path_within(recorded_folder, file), path_within(output, file)
                except ValueError as error:
                    raise FileError(str(error), file=recorded_folder) from error
                if not source.is_file():
                    id = recipe.steps[index].stage.id
                    mend = f"replay with --from {id} or an earlier stage"
                    raise FileError(f"the file of '{name}' is gone", file=source, mend=mend)
                with writing(target) as temporary:
                    shutil.copyfile(source, temporary)


def _named_files(artefact: Any) -> list[str]:
    """Names of files in the run folder that an artefact stands for: of `RunFile`s, and below work/."""
    from geomosaic.pipeline.context import RunFile

    if isinstance(artefact, RunFile):
        return [artefact.name]
    if isinstance(artefact, str):
        return [artefact] if artefact.startswith("work/") else []
    if dataclasses.is_dataclass(artefact):
        return [n for f in dataclasses.fields(artefact) for n in _named_files(getattr(artefact, f.name))]
    return [n for item in artefact for n in _named_files(item)] if isinstance(artefact, tuple) else []


def _frame_folders(given: dict[int, dict[str, Any]]) -> list[Path]:
    """The folders of the frames of a given survey."""
    surveys = [outputs["survey"] for outputs in given.values() if "survey" in outputs]
    paths = [Path(frame.path) for survey in surveys for frame in getattr(survey, "frames", ())]
    return list(dict.fromkeys(path.parent for path in paths))


def _console() -> Console:
    console = Console(highlight=False)
    return console if console.is_terminal else Console(highlight=False, width=160)
