"""A run of a recipe: each field an option of `geomosaic run`."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from geomosaic.errors import InputError
from geomosaic.requests.of_frames import FramesRequest, crs_of
from geomosaic.requests.option import INPUTS, Option, asked, required
from geomosaic.requests.run_request import default_folder, override

if TYPE_CHECKING:
    from geomosaic.pipeline.recipe import Recipe


@dataclass(frozen=True, kw_only=True)
class RecipeRequest(FramesRequest):
    """What a recipe makes of an input."""

    name: str = required(
        Option("recipe file (YAML), or the name of one that 'geomosaic recipes' lists", "RECIPE")
    )
    input: Path | None = asked(Option("folder of frames, or geometry of strips (YAML)", "INPUT"))
    frames: Path | None = asked(
        Option("folder of frames, as --set survey.read.frames=DIR", "DIR", INPUTS, sets="survey.read.frames")
    )
    strips: Path | None = asked(
        Option(
            "geometry of strips, as --set survey.strips.geometry=FILE",
            "FILE",
            INPUTS,
            sets="survey.strips.geometry",
        )
    )

    @cached_property
    def _file(self) -> Path:
        from geomosaic.pipeline.recipe_names import recipe_path

        return recipe_path(self.name)

    def _overrides(self) -> list[str]:
        """What the options set, before what `set` does."""
        of_strips = self.input is not None and self.input.suffix in (".yaml", ".yml")
        flag, other = ("--strips", self.strips) if of_strips else ("--frames", self.frames)
        if self.input is not None and other is not None:
            raise InputError(
                f"INPUT is {self.input}, and {flag} is {other}", fix=f"leave out INPUT or {flag}"
            )
        asked = replace(
            self,
            frames=self.frames or (None if of_strips else self.input),
            strips=self.strips or (self.input if of_strips else None),
            strict=False,
        )
        given = asked.parameters()
        values = [(f"{id}.{name}", value) for id, of in given.items() for name, value in of.items()]
        return [override(parameter, value) for parameter, value in values]

    def recipe(self) -> Recipe:
        """The checked recipe. Raises: `InputError` for what cannot be used."""
        from geomosaic.pipeline.recipe import load_recipe
        from geomosaic.pipeline.registry import installed

        overrides = [*self._overrides(), *self.set]
        loaded = load_recipe(self._file, installed(), overrides)
        if self.strict:
            able = [step.stage.id for step in loaded.steps if "strict" in step.stage.Params.model_fields]
            overrides += [f"{id}.strict=true" for id in able]
            loaded = load_recipe(self._file, installed(), overrides)
        if self.align_to is not None:
            (read,) = (step.params.model_dump() for step in loaded.steps if step.stage.id == "survey.read")
            overrides.append(f"survey.read.crs={crs_of(self.align_to, read['crs'])}")
            loaded = load_recipe(self._file, installed(), overrides)
        self.prepare(step.stage.id for step in loaded.steps)
        return replace(loaded, seed=self.seed) if self.seed is not None else loaded

    def folder(self, recipe: Recipe) -> Path:
        """Where the run goes: what is asked for, or a folder next to the input or the recipe's first file."""
        from geomosaic.pipeline.params import file_values

        if self.output is not None:
            return self.output
        if self.input is not None:
            return default_folder(self.input, self._file.stem.replace("_", "-"))
        named = [path for step in recipe.steps for path in file_values(step.params).values()]
        return default_folder((named or [self._file])[0], self._file.stem.replace("_", "-"))
