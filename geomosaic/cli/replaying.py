"""`geomosaic replay`: a recorded run again, from any stage to any stage, with its frames or without."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from geomosaic.cli.inspection import RecordingFile, recording_file
from geomosaic.cli.options import (
    Dask,
    FixedTime,
    Overwrite,
    Quiet,
    Record,
    RunFolder,
    Sets,
    Workers,
    record_options,
)
from geomosaic.errors import FileError, InputError, UnknownNameError

if TYPE_CHECKING:
    from geomosaic.pipeline.given import Given
    from geomosaic.pipeline.recipe import Recipe
    from geomosaic.recording.model import Recording

_GSD = "mosaic.seams.gsd_m"


def replay(
    recording: RecordingFile,
    output: RunFolder,
    start: Annotated[
        str,
        typer.Option(
            "--from", metavar="STAGE", help="first stage to run again [the first that --set changes]"
        ),
    ] = "",
    set: Sets = None,
    workers: Workers = None,
    dask: Dask = None,
    fixed_time: FixedTime = False,
    overwrite: Overwrite = False,
    until: Annotated[str, typer.Option(metavar="STAGE", help="last stage to run")] = "",
    frames: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="folder where the frames are now; they are found by content"),
    ] = None,
    quiet: Quiet = False,
    record: Record = "normal",
) -> None:
    """Run a recorded recipe again from any stage on.

    Results of earlier stages are taken from the recording. Stages that read pixels need the frames in their
    old folder or in --frames. From the adjustment on, recorded thumbnails replace missing frames. Trust a
    recording as you would a recipe: it names the files to read.
    """
    from geomosaic.cli.running import execute
    from geomosaic.pipeline.elsewhere import at_places, found_frames
    from geomosaic.pipeline.given import given_stages, missing_inputs
    from geomosaic.recording import read_recording

    path, recorded_as = recording_file(recording), record_options(record, False, False, False)
    recorded = read_recording(path)
    if path.absolute().parent == output.absolute():
        raise InputError("this is the run to be replayed", file=output, mend="give another folder with -o")
    if not recorded.recipe_yaml:
        raise FileError("it holds no recipe", file=path, mend="run the recipe itself")
    places = found_frames(recorded, frames) if frames is not None else {}
    sets = [*(set or ()), *([f"survey.read.frames={frames}"] if frames is not None else ())]
    recipe = _until(_recipe(recorded, sets), until, path)
    first = _first_stage(recipe, start, set or [], path)
    given: Mapping[int, Given] = given_stages(recorded, recipe, first)
    if places:
        given = at_places(given, places)
    recipe, given = _on_thumbnails(recorded, recipe, given, sets, output)
    try:
        execute(recipe, output, workers, dask, fixed_time, overwrite, given, quiet=quiet, record=recorded_as)
    except FileError as error:
        for path in missing_inputs(given.values()):
            mend = "put it back there, name its folder with --frames, or replay from a later stage"
            raise FileError("an input of the recorded run is gone", file=path, mend=mend) from error
        raise


def _recipe(recorded: Recording, sets: list[str]) -> Recipe:
    from geomosaic.pipeline.recipe import parse_recipe
    from geomosaic.pipeline.registry import installed

    return parse_recipe(recorded.recipe_yaml, installed(), sets, file=str(recorded.path))


def _on_thumbnails(
    recorded: Recording, recipe: Recipe, given: Mapping[int, Given], sets: list[str], output: Path
) -> tuple[Recipe, Mapping[int, Given]]:
    """The replay with thumbnails for frames where these are gone and something reads them; says what is left
    out."""
    from geomosaic.pipeline.elsewhere import (
        first_with_thumbnails,
        frames_gone,
        thumbnail_pixel_m,
        with_thumbnails,
    )

    if len(given) == len(recipe.steps) or not frames_gone(given):
        return recipe, given
    first = first_with_thumbnails(recipe, len(given))
    pixel_m = thumbnail_pixel_m(recorded, given)
    given = {i: g for i, g in given.items() if i < first}
    asked = any(s.replace(" ", "").startswith(f"{_GSD}=") for s in sets)
    if pixel_m > 0.0 and not asked and any(s.stage.id == _GSD.rpartition(".")[0] for s in recipe.steps):
        whole = _recipe(recorded, [*sets, f"{_GSD}={pixel_m}"])
        recipe = replace(whole, steps=whole.steps[: len(recipe.steps)])
    recipe, given, left_out = with_thumbnails(recorded, recipe, given, output)
    for line in left_out:
        print(f"left out   {line}")
    return recipe, given


def _until(recipe: Recipe, until: str, file: Path) -> Recipe:
    """The recipe up to a stage."""
    ids = [step.stage.id for step in recipe.steps]
    if until and until not in ids:
        raise UnknownNameError("stage of this recording", until, ids, file=file)
    return replace(recipe, steps=recipe.steps[: ids.index(until) + 1]) if until else recipe


def _first_stage(recipe: Recipe, start: str, sets: list[str], file: Path) -> int:
    """The number of the first stage to run: that of `--from`, else the first that `--set` changes."""
    ids = [step.stage.id for step in recipe.steps]
    of = [s.partition("=")[0].strip().rpartition(".")[0] for s in sets]
    changed = {ids.index(id): s for id, s in zip(of, sets, strict=True) if id in ids}
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
