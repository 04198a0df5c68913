"""How much of a run is recorded."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

LEVELS: Final = ("off", "summary", "normal", "full")
"""off: no file. summary: what happened, in figures and tables; no images and no artefacts, so no replay.
normal: all of it, but each pair's tie points, which the artefacts hold. full: these too."""

_FROM: Final = {
    "geomosaic.Artefact": "normal",
    "foxglove.CompressedImage": "normal",
    "geomosaic.ChipTies": "normal",
    "geomosaic.TiePoints": "full",
}


def wanted(schema: str, level: str) -> bool:
    """Whether messages of a schema are recorded at a level."""
    return LEVELS.index(level) >= LEVELS.index(_FROM.get(schema, "summary"))


@dataclass(frozen=True)
class RecordOptions:
    """level: one of LEVELS. private: without folders, user and host; private_places: also with all places
    moved by what nobody is told, and so without artefacts. live: shown in Rerun while the run is on."""

    level: str = "normal"
    private: bool = False
    private_places: bool = False
    live: bool = False

    @property
    def hides(self) -> bool:
        """Whether anything is private."""
        return self.private or self.private_places
