"""How much of a run is recorded."""

from __future__ import annotations

from typing import Final

LEVELS: Final = ("off", "summary", "normal", "full")
"""off: no file. summary: what happened, in figures and tables; no images and no artefacts, so no replay.
normal: all of it, but each pair's tie points, which the artefacts hold. full: these too."""

_FROM: Final = {"artefact": "normal", "image": "normal", "chip": "normal", "tie_points": "full"}


def wanted(call: str, level: str) -> bool:
    """Whether a call of the recorder is recorded at a level."""
    return LEVELS.index(level) >= LEVELS.index(_FROM.get(call, "summary"))
