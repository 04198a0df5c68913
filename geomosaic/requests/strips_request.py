"""One scene of the strips of a satellite's CCDs: each field an option of `geomosaic strips`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

from geomosaic.requests.option import ACCURACY, OUTPUT, Option, asked, required
from geomosaic.requests.run_request import NewRunRequest, default_folder, recipe_of

if TYPE_CHECKING:
    from geomosaic.pipeline.recipe import Recipe

STAGES: Final = (
    "survey.strips",
    "mosaic.estimate_strips",
    "ccd.offsets",
    "ccd.radiometry",
    "mosaic.strips",
    "quality.strips",
    "export.cog",
    "export.map",
    "export.offsets",
    "export.strip_layers",
    "export.project",
    "export.strip_report",
)
"""`export.map` runs where it is asked for."""


@dataclass(frozen=True, kw_only=True)
class StripsRequest(NewRunRequest):
    """One scene of the strips of a satellite's CCDs."""

    geometry: Path = required(
        Option("YAML file of the focal plane and its strips", "GEOMETRY.yaml", sets="survey.strips.geometry")
    )
    method: str | None = asked(
        Option(
            "how offsets are estimated; 'geomosaic stages ccd.offsets' lists the methods",
            "METHOD",
            ACCURACY,
            sets="ccd.offsets.method",
            methods=True,
        )
    )
    map: bool = asked(
        Option("also write mosaic_map.tif, the scene in map coordinates on the geometry's DEM", None, OUTPUT),
        False,
    )

    def recipe(self) -> Recipe:
        """The checked recipe. Raises: `InputError` for what cannot be used."""
        stages = [id for id in STAGES if self.map or id != "export.map"]
        named = "strips", f"strips of {self.geometry.name}"
        return recipe_of(named, stages, self.parameters(), self.seed, self.set)

    def folder(self, recipe: Recipe) -> Path:
        """Where the run goes: what is asked for, or a folder next to the geometry."""
        return self.output or default_folder(self.geometry, "scene")
