"""One stage by itself: for commands that are no run."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from geomosaic.errors import PluginError
from geomosaic.pipeline.context import Context, Notes
from geomosaic.pipeline.executor import Workers
from geomosaic.pipeline.plugin import blamed
from geomosaic.pipeline.recipe import Recipe
from geomosaic.pipeline.reporter import Reporter, Silent, warning_lines
from geomosaic.pipeline.run_folder import RunFolder
from geomosaic.pipeline.stage import Stage


def check_outputs(stage: type[Stage], values: Any) -> None:
    """`PluginError` unless a stage gave just what it declared."""
    if not isinstance(values, dict) or values.keys() != stage.outputs.keys():
        got = sorted(values) if isinstance(values, dict) else type(values).__name__
        raise PluginError(f"stage {stage.id} gave {got} instead of {sorted(stage.outputs)}")
    for name, kind in stage.outputs.items():
        if isinstance(kind, type) and not isinstance(values[name], kind):
            raise PluginError(
                f"stage {stage.id} gave '{name}' as {type(values[name]).__name__}, not {kind.__name__}"
            )


@dataclass(frozen=True)
class StageInputs:
    """What a stage takes of a run. folder: of the run, into which it writes. artefacts: by name. summary: of
    run.json."""

    folder: RunFolder
    artefacts: Mapping[str, Any] = field(default_factory=dict)
    summary: Mapping[str, Any] = field(default_factory=dict)


def run_stage(
    recipe: Recipe,
    given: StageInputs,
    *,
    work_folder: Path,
    workers: int = 1,
    reporter: Reporter | None = None,
) -> tuple[dict[str, Any], Notes]:
    """The one stage of a recipe, without recording or cache: its outputs and what it noted.

    `work_folder` is the caller's to delete.
    """
    reporter, folder = reporter or Silent(), given.folder
    ((stage, params),) = ((step.stage, step.params) for step in recipe.steps)
    recipe.check_files()
    reporter.stage_started(0, 1, stage.display_name)
    started = time.monotonic()
    with Workers(workers) as team:
        context = Context(
            folder,
            stage_id=stage.id,
            version=stage.version,
            work_folder=work_folder,
            workers=team,
            seed=recipe.seed,
            on_progress=reporter.progress,
            on_note=reporter.note,
            summary=given.summary,
        )
        try:
            with blamed(stage):
                values = stage().run(given.artefacts, params, context)
        finally:
            for line in warning_lines(context.notes.warnings):
                reporter.warning(line)
    check_outputs(stage, values)
    written = (path.relative_to(folder.path).as_posix() for path in context.kept)
    folder.note(written, results=bool(stage.inputs))
    reporter.stage_finished(time.monotonic() - started, "work")
    return values, context.notes
