"""Names that classes of artefacts had in recordings and run folders of earlier versions."""

from __future__ import annotations

from typing import Final

_FORMER: Final = {
    "geomosaic.surface.terrain:TerrainModel": "geomosaic.surface.dtm:TerrainModel",
}
"""Present name by former name."""


def present_name(name: str) -> str:
    """The name that a class has now, given the name in a file."""
    return _FORMER.get(name, name)
