"""A job done: its recipe run, and a poor result raised where that is asked for."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from geomosaic.errors import FileError, PoorResultError

if TYPE_CHECKING:
    from geomosaic.pipeline.reporter import Reporter
    from geomosaic.requests.run_request import Job


def perform(job: Job, reporter: Reporter) -> dict[str, Any]:
    """Runs it. Returns run.json's content. Raises: what the run raises."""
    from geomosaic.pipeline.runner import run

    if job.how.incremental:
        check_folder(job)  # before the run makes it
    try:
        return run(job.recipe, job.folder, job.how, given=job.given, reporter=reporter)
    except FileError as error:
        if job.given:
            _name_missing(job, error)
        raise


def check_folder(job: Job) -> None:
    """Raises: what the run would raise of its folder before it begins; nothing is written there."""
    from geomosaic.pipeline.earlier_run import finished
    from geomosaic.pipeline.run_folder import RunFolder

    folder = RunFolder.checked(job.folder, sorted(job.recipe.results()), overwrite=job.how.overwrite)
    if job.how.incremental:
        finished(folder, job.recipe)


def _name_missing(job: Job, error: FileError) -> None:
    from geomosaic.pipeline.replayed_stage import missing_inputs

    for path in missing_inputs(job.given.values()):
        fix = "put it back there, name its folder with --frames, or replay from a later stage"
        raise FileError("an input of the recorded run is gone", file=path, fix=fix) from error


def check_result(job: Job, summary: Mapping[str, Any]) -> None:
    """Raises: if strict, `PoorResultError` for the first shortcoming of a stage."""
    for text in (step.stage.shortcoming(summary) for step in job.recipe.steps if job.strict):
        if text:
            raise PoorResultError(text)
