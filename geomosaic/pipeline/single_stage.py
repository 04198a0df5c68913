"""One stage by itself: for commands that are no run."""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from geomosaic.errors import PluginError
from geomosaic.pipeline.context import Context, Notes
from geomosaic.pipeline.executor import Workers
from geomosaic.pipeline.params import StageParams
from geomosaic.pipeline.plugin import blamed
from geomosaic.pipeline.recipe import Recipe, RecipeStep
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


def run_stage(
    stage: type[Stage],
    params: StageParams,
    folder: RunFolder,
    inputs: Mapping[str, Any] | None = None,
    *,
    work_folder: Path,
    workers: int = 1,
    seed: int = 0,
    reporter: Reporter | None = None,
    summary: Mapping[str, Any] | None = None,
) -> tuple[dict[str, Any], Notes]:
    """One stage by itself, without recording or cache: its outputs and what it noted.

    `work_folder` is the caller's to delete.
    """
    reporter = reporter or Silent()
    Recipe("", "", seed, (RecipeStep(stage, params),)).check_files()
    reporter.stage_started(0, 1, stage.display_name)
    started = time.monotonic()
    with Workers(workers) as team:
        context = Context(
            folder,
            stage_id=stage.id,
            version=stage.version,
            work_folder=work_folder,
            workers=team,
            seed=seed,
            on_progress=reporter.progress,
            on_note=reporter.note,
            summary=summary,
        )
        try:
            with blamed(stage):
                values = stage().run(inputs or {}, params, context)
        finally:
            for line in warning_lines(context.notes.warnings):
                reporter.warning(line)
    check_outputs(stage, values)
    folder.note(path.relative_to(folder.path).as_posix() for path in context.kept)
    reporter.stage_finished(time.monotonic() - started, "work")
    return values, context.notes
