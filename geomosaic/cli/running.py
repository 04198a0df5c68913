"""A checked recipe from the command line: its progress while it runs, and what it comes to."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from geomosaic.cli.options import cores
from geomosaic.errors import InputError, PoorResultError

if TYPE_CHECKING:
    from geomosaic.pipeline.given import Given
    from geomosaic.pipeline.recipe import Recipe
    from geomosaic.recording.levels import RecordOptions

_OPENED = ("report.html", "project.qgz")
"""Of a run's files those to begin with."""


def prepare(stages: Iterable[str], workers: int | None, dask: str | None) -> None:
    """Has workers made ready, if there are to be some on this machine, while the recipe is read."""
    from geomosaic.pipeline.announced import modules_of
    from geomosaic.pipeline.executor import prepare_workers

    if dask is None and (workers or cores()) > 1:
        prepare_workers(modules_of(stages))


def execute(
    recipe: Recipe,
    output: Path,
    workers: int | None,
    dask: str | None,
    fixed_time: bool,
    overwrite: bool = False,
    given: Mapping[int, Given] | None = None,
    *,
    strict: bool = False,
    dry_run: bool = False,
    as_json: bool = False,
    quiet: bool = False,
    record: RecordOptions | None = None,
) -> None:
    """Runs a checked recipe with progress on stderr, and says on stdout where the results lie.

    Raises: what the run raises; if strict, `PoorResultError` after it for the first shortcoming of a stage.
    """
    from geomosaic.cli.plan import show_plan
    from geomosaic.cli.progress import progress
    from geomosaic.pipeline.runner import run

    if as_json and not dry_run:
        raise InputError(
            "--json says what --dry-run finds", mend="add --dry-run, or read run.json after the run"
        )
    with progress(quiet=quiet) as reporter:
        if dry_run:
            show_plan(recipe, output, reporter, workers or cores(), dask, as_json)
            return
        summary = run(
            recipe,
            output,
            overwrite=overwrite,
            workers=workers or cores(),
            dask=dask,
            fixed_time=fixed_time,
            given=given,
            reporter=reporter,
            record=record,
        )
    if not quiet:
        _conclude(recipe, output, summary)
    for text in (step.stage.shortcoming(summary) for step in recipe.steps if strict):
        if text:
            raise PoorResultError(text)


def _conclude(recipe: Recipe, output: Path, summary: Mapping[str, Any]) -> None:
    """Files first, then figures in the order of stages: verdict, accuracy and what to open come last."""
    from geomosaic.pipeline.recipe import RECORDING

    told = []
    for file in (*(file for step in recipe.steps for file in step.stage.results), RECORDING):
        if (output / file).exists() and not file.endswith((".aux.xml", "_report.json")):
            told.append(("recording" if file == RECORDING else Path(file).stem, f"{output / file}"))
    if summary["warnings"]:
        told.append(("warnings", f"{len(summary['warnings'])}, see above and run.json"))
    told += [pair for step in recipe.steps for pair in step.stage.conclusions(summary)]
    opened = [f"{output / file}" for file in _OPENED if (output / file).exists()]
    print_named(told + [("open", ", ".join(opened))] * bool(opened))


def print_named(told: Sequence[tuple[str, str]]) -> None:
    """Lines of a word and its text, the texts below each other."""
    width = max(10, *(len(name) for name, _ in told))
    for name, text in told:
        print(f"{name:<{width}} {text}")
