"""`--dry-run`: what a run would do and take, found without doing it."""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from geomosaic.cli.running import print_named
from geomosaic.pipeline.files import refusals_named
from geomosaic.pipeline.recipe import Recipe
from geomosaic.requests.perform import check_folder

if TYPE_CHECKING:
    from geomosaic.pipeline.reporter import Reporter
    from geomosaic.requests.run_request import Job


@dataclass(frozen=True)
class _Begun(Recipe):
    """The first stages of a recipe, which know the parameters of all."""

    whole: Recipe | None = None

    def plain(self) -> dict[str, Any]:
        """The whole recipe."""
        return self.whole.plain() if self.whole is not None else super().plain()


class _Listening:
    """A reporter that also keeps the notes of the stage that is running."""

    def __init__(self, shown: Reporter) -> None:
        self._shown = shown
        self.notes: list[str] = []

    def __getattr__(self, name: str) -> Any:
        return getattr(self._shown, name)

    def stage_started(self, index: int, total: int, name: str) -> None:
        self.notes = []
        self._shown.stage_started(index, total, name)

    def note(self, text: str) -> None:
        self.notes.append(text)


def show_plan(job: Job, reporter: Reporter, as_json: bool) -> None:
    """Runs the stages up to the last that looks ahead, in a folder that goes, and prints what they found: for
    people, or as JSON with numbers.

    Raises: what the run itself would raise up to there, also of its folder.
    """
    from geomosaic.pipeline.run_options import RunOptions
    from geomosaic.pipeline.runner import run

    recipe, output = job.recipe, job.folder
    recipe.check_files(run_folder=output)
    check_folder(job)
    ahead = [i for i, step in enumerate(recipe.steps) if step.stage.looks_ahead]
    begun = _Begun(
        recipe.name, recipe.description, recipe.seed, recipe.steps[: ahead[-1] + 1 if ahead else 0],
        recipe.file, recipe,
    )  # fmt: skip
    listening: Any = _Listening(reporter)
    summary: dict[str, Any] = {"metrics": {}, "warnings": []}
    with _near(output) as folder:
        if ahead:
            how = RunOptions(workers=job.how.workers, dask=job.how.dask)
            summary = run(begun, folder, how, reporter=listening)
    if as_json:
        plan = {
            "stages": [step.stage.id for step in recipe.steps],
            "results": sorted(recipe.results()),
            "output": str(output),
            "metrics": summary["metrics"],
            "warnings": summary["warnings"],
        }
        print(json.dumps(plan, indent=2))
        return
    names = [step.stage.display_name for step in recipe.steps]
    lines = [
        ("stages", f"{len(names)}: {', '.join(names)}"),
        ("results", ", ".join(sorted(recipe.results()))),
        *(line for step in begun.steps for line in step.stage.plans(summary)),
        *(("expected", text) for text in listening.notes),
    ]
    if summary["warnings"]:
        lines.append(("warnings", f"{len(summary['warnings'])}, see above"))
    print_named(lines)
    print(f"nothing was written; without --dry-run the run goes to {output}")


@contextmanager
def _near(output: Path) -> Iterator[Path]:
    """A folder for a while on the disk that the run would be written to. Raises: `OutputError` where none can
    be made."""
    near = next(p for p in (output.absolute(), *output.absolute().parents) if os.path.lexists(p))
    with refusals_named(output):
        made = tempfile.TemporaryDirectory(prefix=".geomosaic-plan-", dir=near)
    with made as folder:
        yield Path(folder)
