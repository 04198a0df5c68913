"""A checked recipe from the command line: its progress while it runs, and what it comes to."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from geomosaic.errors import InputError
from geomosaic.requests.perform import check_result, perform

if TYPE_CHECKING:
    from geomosaic.pipeline.recipe import Recipe
    from geomosaic.requests.run_request import Job

_OPENED = ("report.html", "project.qgz")
"""Of a run's files those to begin with."""


def execute(job: Job, *, dry_run: bool = False, as_json: bool = False, quiet: bool = False) -> None:
    """Runs it with progress on stderr, and says on stdout where the results lie.

    Raises: what the run raises; if strict, `PoorResultError` after it for the first shortcoming of a stage.
    """
    from geomosaic.cli.plan import show_plan
    from geomosaic.cli.progress import progress

    if as_json and not dry_run:
        raise InputError(
            "--json says what --dry-run finds", fix="add --dry-run, or read run.json after the run"
        )
    for line in job.left_out:
        print(f"left out   {line}")
    with progress(quiet=quiet) as reporter:
        if dry_run:
            show_plan(job, reporter, as_json)
            return
        summary = perform(job, reporter)
    if not quiet:
        _conclude(job.recipe, job.folder, summary)
    check_result(job, summary)


def _conclude(recipe: Recipe, output: Path, summary: Mapping[str, Any]) -> None:
    """Files first, then figures in the order of stages: verdict, accuracy and what to open come last."""
    from geomosaic.pipeline.recipe import RECORDING

    lines = []
    for file in (*(file for step in recipe.steps for file in step.stage.results), RECORDING):
        if (output / file).exists() and not file.endswith((".aux.xml", "_report.json")):
            lines.append(("recording" if file == RECORDING else Path(file).stem, f"{output / file}"))
    if summary["warnings"]:
        lines.append(("warnings", f"{len(summary['warnings'])}, see above and run.json"))
    lines += [pair for step in recipe.steps for pair in step.stage.conclusions(summary)]
    opened = [f"{output / file}" for file in _OPENED if (output / file).exists()]
    print_named(lines + [("open", ", ".join(opened))] * bool(opened))


def print_named(lines: Sequence[tuple[str, str]]) -> None:
    """Lines of a word and its text, the texts below each other."""
    width = max([10, *(len(name) for name, _ in lines)])
    for name, text in lines:
        print(f"{name:<{width}} {text}")
