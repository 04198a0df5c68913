"""What of `geomosaic export` suits which run, for its help."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import typer

if TYPE_CHECKING:
    from geomosaic.pipeline.stage import Stage


def described(stage: type[Stage]) -> str:
    """A line of help: what it writes, and of which runs if not of all."""
    suited = [name for name, given in _given().items() if stage.inputs.keys() <= given]
    kind = f" (of {suited[0]})" if len(suited) == 1 else ""
    return f"{stage.display_name}{kind}"


def suiting(stages: Iterable[type[Stage]], folder: Path) -> list[type[Stage]]:
    """Those that find in a finished run what they take. Raises `FileError` if it is none."""
    from geomosaic.pipeline.run_results import read_summary

    there = read_summary(folder)["artefacts"].keys()
    return [stage for stage in stages if stage.inputs.keys() <= there]


def add_folder(app: typer.Typer, folder: str) -> None:
    """Has `geomosaic export RUN` list the app's commands."""

    @app.command(
        folder,
        hidden=True,
        add_help_option=False,
        context_settings={"ignore_unknown_options": True, "allow_extra_args": True},
    )
    def listed(context: typer.Context) -> None:
        if context.parent is not None:
            print(context.parent.get_help())


def _given() -> dict[str, set[str]]:
    """Names of artefacts that runs of frames and of strips have."""
    from geomosaic.pipeline.registry import installed
    from geomosaic.requests import mosaic_stages, strips_request

    return {
        "frames": _outputs(installed().all()[0], mosaic_stages.STAGES),
        "strips": _outputs(installed().all()[0], strips_request.STAGES),
    }


def _outputs(stages: Iterable[type[Stage]], ids: Sequence[str]) -> set[str]:
    return {name for stage in stages if stage.id in ids for name in stage.outputs}
