"""A mosaic of a folder into which frames are still being copied."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

from geomosaic.requests.mosaic_request import MosaicRequest
from geomosaic.requests.option import RUNNING, Option, asked
from geomosaic.requests.run_request import Job, recipe_of

_MATCHED: Final = (
    "survey.read",
    "matching.flying_height",
    "projection.ground",
    "placement.pos",
    "matching.sift",
)
"""What a preview shares with the whole run, which finds its results."""


@dataclass(frozen=True, kw_only=True)
class WatchRequest(MosaicRequest):
    """A mosaic whose frames arrive one after the other, with previews meanwhile."""

    after: int = asked(
        Option("seconds without another frame after which the whole run begins", "S", RUNNING, least=1), 120
    )

    def preview(self) -> Job:
        """The run that shows the frames there are: matched as in the whole run, shifted over the map by least
        squares. Raises: `InputError` for what cannot be used."""
        stages = [id for id in self.stages() if id in _MATCHED]
        given = self.parameters() | {"adjustment.solve": {"method": "least_squares"}}
        named = "preview", f"frames of {self.frames.name}"
        sets = [text for text in self.set if text.rpartition("=")[0].rpartition(".")[0] in _MATCHED]
        recipe = recipe_of(named, [*stages, "adjustment.solve", "mosaic.preview"], given, self.seed, sets)
        how = replace(
            self.how(), record=replace(self.recorded(), level="off"), preview=True, incremental=False
        )
        return Job(recipe, self.folder(recipe), how, strict=False)
