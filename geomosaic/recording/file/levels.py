"""How much of a run is recorded."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

LEVELS: Final = ("off", "summary", "normal", "full")
"""off: no file. summary: what happened, in figures and tables; no images and no artefacts, so no replay.
normal: all of it, but each pair's tie points, which the artefacts hold. full: these too."""


def reaches(level: str, least: str) -> bool:
    """Whether a level records what is recorded from another one on."""
    return LEVELS.index(level) >= LEVELS.index(least)


@dataclass(frozen=True)
class RecordOptions:
    """level: one of LEVELS. private: without folders, user and host; private_places: also with all places
    moved by a secret shift, and so without artefacts. live: shown in Rerun while the run is on."""

    level: str = "normal"
    private: bool = False
    private_places: bool = False
    live: bool = False

    @property
    def hides(self) -> bool:
        """Whether anything is private."""
        return self.private or self.private_places
