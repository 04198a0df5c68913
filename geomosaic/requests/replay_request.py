"""A recorded run again, from any stage to any stage, with its frames or without."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Final

from geomosaic.errors import FileError, InputError, UnknownNameError
from geomosaic.requests.option import OUTPUT, RUNNING, Option, asked, folder_given, required
from geomosaic.requests.run_request import DASK, Job, RunRequest, override

if TYPE_CHECKING:
    from geomosaic.pipeline.recipe import Recipe
    from geomosaic.pipeline.replayed_stage import ReplayedStage
    from geomosaic.recording.file.model import Recording

_GSD: Final = "mosaic.seams.gsd_m"


@dataclass(frozen=True, kw_only=True)
class ReplayRequest(RunRequest):
    """A recorded run again."""

    recording: Path = required(Option("the recording of a run, or its folder", "RUN.mcap"))
    output: Path = required(
        Option("folder to write the run to", "RUN", OUTPUT, flags=("-o", "--output"), parse=folder_given)
    )
    start: str = asked(
        Option(
            "first stage to run again [the first that --set changes]", "STAGE", RUNNING, flags=("--from",)
        ),
        "",
    )
    until: str = asked(Option("last stage to run", "STAGE", RUNNING), "")
    frames: Path | None = asked(
        Option("folder where the frames are now; they are found by content", "DIR", RUNNING)
    )
    dask: str | None = asked(DASK)

    @property
    def cluster(self) -> str | None:
        """The address of a Dask cluster that computes."""
        return self.dask

    def folder(self, recipe: Recipe) -> Path:
        """Where the run goes."""
        return self.output

    def recipe(self) -> Recipe:
        """The checked recipe. Raises: `InputError` for what cannot be used."""
        return self.job().recipe

    def job(self) -> Job:
        """The rest of the recorded run. Raises: `InputError` for what cannot be used."""
        from geomosaic.pipeline.replayed_stage import replayed_stages
        from geomosaic.recording import read_recording
        from geomosaic.recording.replay.moved_frames import at_places, found_frames

        path = self.recording / "run.mcap" if self.recording.is_dir() else self.recording
        recorded = read_recording(path)
        if path.resolve().parent == self.output.resolve():
            raise InputError(
                "this is the run to be replayed", file=self.output, fix="give another folder with -o"
            )
        if not recorded.recipe_yaml:
            raise FileError("it holds no recipe", file=path, fix="run the recipe itself")
        places = found_frames(recorded, self.frames) if self.frames is not None else {}
        moved = [override("survey.read.frames", self.frames)] if self.frames is not None else []
        sets = [*self.set, *moved]
        recipe = _until(_recipe(recorded, sets), self.until, path)
        first = _first_stage(recipe, self.start, list(self.set), path)
        given: Mapping[int, ReplayedStage] = replayed_stages(recorded, recipe, first)
        if places:
            given = at_places(given, places)
        recipe, given, left_out = _on_thumbnails(recorded, recipe, given, sets, self.output)
        return Job(recipe, self.output, self.how(), self.is_strict, given, left_out)


def _recipe(recorded: Recording, sets: list[str]) -> Recipe:
    from geomosaic.pipeline.recipe import parse_recipe
    from geomosaic.pipeline.registry import installed

    return parse_recipe(recorded.recipe_yaml, installed(), sets, file=str(recorded.path))


def _on_thumbnails(
    recorded: Recording, recipe: Recipe, given: Mapping[int, ReplayedStage], sets: list[str], output: Path
) -> tuple[Recipe, Mapping[int, ReplayedStage], tuple[str, ...]]:
    """The replay with thumbnails for frames where these are gone and something reads them, and what is left
    out."""
    from geomosaic.recording.replay.moved_frames import (
        first_with_thumbnails,
        frames_gone,
        thumbnail_pixel_m,
        with_thumbnails,
    )

    if len(given) == len(recipe.steps) or not frames_gone(given):
        return recipe, given, ()
    first = first_with_thumbnails(recipe, len(given))
    pixel_m = thumbnail_pixel_m(recorded, given)
    given = {i: g for i, g in given.items() if i < first}
    asked = any(s.replace(" ", "").startswith(f"{_GSD}=") for s in sets)
    if pixel_m > 0.0 and not asked and any(s.stage.id == _GSD.rpartition(".")[0] for s in recipe.steps):
        whole = _recipe(recorded, [*sets, f"{_GSD}={pixel_m}"])
        recipe = replace(whole, steps=whole.steps[: len(recipe.steps)])
    recipe, given, left_out = with_thumbnails(recorded, recipe, given, output)
    return recipe, given, tuple(left_out)


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
        raise InputError(problem, fix=f"replay with --from {ids[earlier]}")
    return first
