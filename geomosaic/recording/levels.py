"""How much of a run is recorded."""

from __future__ import annotations

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
