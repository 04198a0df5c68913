"""`geomosaic run`: from a recipe to a run folder."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer

from geomosaic.cli.help import INPUTS
from geomosaic.cli.options import (
    AlignTo,
    Aoi,
    Dask,
    DryRun,
    FixedTime,
    Live,
    Overwrite,
    PlanJson,
    Private,
    PrivatePlaces,
    Quiet,
    Record,
    RunFolderBeside,
    Seed,
    Sets,
    Strict,
    Workers,
    beside,
    crs_of,
    record_options,
)
from geomosaic.cli.recipes import completed
from geomosaic.cli.running import execute, prepare


def run(
    recipe: Annotated[
        str,
        typer.Argument(
            help="recipe file (YAML), or the name of one that 'geomosaic recipes' lists",
            metavar="RECIPE",
            autocompletion=completed,
        ),
    ],
    input: Annotated[
        Path | None,
        typer.Argument(help="folder of frames, or geometry of strips (YAML)", metavar="INPUT"),
    ] = None,
    output: RunFolderBeside = None,
    frames: Annotated[
        Path | None,
        typer.Option(
            help="folder of frames, as --set survey.read.frames=DIR", metavar="DIR", rich_help_panel=INPUTS
        ),
    ] = None,
    strips: Annotated[
        Path | None,
        typer.Option(
            help="geometry of strips, as --set survey.strips.geometry=FILE",
            metavar="FILE",
            rich_help_panel=INPUTS,
        ),
    ] = None,
    aoi: Aoi = None,
    align_to: AlignTo = None,
    set: Sets = None,
    workers: Workers = None,
    dask: Dask = None,
    fixed_time: FixedTime = False,
    seed: Seed = None,
    overwrite: Overwrite = False,
    strict: Strict = False,
    dry_run: DryRun = False,
    as_json: PlanJson = False,
    quiet: Quiet = False,
    record: Record = "normal",
    private: Private = False,
    private_places: PrivatePlaces = False,
    live: Live = False,
) -> None:
    """Run a recipe: a YAML file of stages and their parameters."""
    from geomosaic.pipeline.named import recipe_path
    from geomosaic.pipeline.params import file_values
    from geomosaic.pipeline.recipe import load_recipe
    from geomosaic.pipeline.registry import installed

    file = recipe_path(recipe)
    if input is not None and input.suffix in (".yaml", ".yml"):
        strips = strips or input
    else:
        frames = frames or input
    inputs = {
        "survey.read.frames": frames,
        "survey.strips.geometry": strips,
        "mosaic.seams.aoi": aoi,
        "mosaic.seams.align_to": align_to,
    }
    overrides = [*(f"{name}={path}" for name, path in inputs.items() if path is not None), *(set or ())]
    checked = load_recipe(file, installed(), overrides)
    if strict:
        able = [step.stage.id for step in checked.steps if "strict" in step.stage.Params.model_fields]
        overrides += [f"{id}.strict=true" for id in able]
        checked = load_recipe(file, installed(), overrides)
    if align_to is not None:
        (read,) = (step.params.model_dump() for step in checked.steps if step.stage.id == "survey.read")
        overrides.append(f"survey.read.crs={crs_of(align_to, read['crs'])}")
        checked = load_recipe(file, installed(), overrides)
    if seed is not None:
        checked = replace(checked, seed=seed)
    if output is None:
        named = [path for step in checked.steps for path in file_values(step.params).values()]
        output = beside(input or (named or [file])[0], file.stem.replace("_", "-"))
    prepare([step.stage.id for step in checked.steps], workers, dask)
    recorded = record_options(record, private, private_places, live)
    how: dict[str, Any] = {
        "strict": strict,
        "dry_run": dry_run,
        "as_json": as_json,
        "quiet": quiet,
        "record": recorded,
    }
    execute(checked, output, workers, dask, fixed_time, overwrite, **how)
