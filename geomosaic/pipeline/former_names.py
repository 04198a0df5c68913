"""Names of earlier versions that recordings, run folders and plug-ins may still have, for one release."""

from __future__ import annotations

import re
from typing import Final

_ROOMS: Final = {"mosaic": "composition"}
"""Present name of a room by its former name."""
FORMER: Final = {
    "geomosaic.adjustment.model:GroundPlaces": "geomosaic.adjustment.ground_places:GroundPlaces",
    "geomosaic.composition.pyramid:PackedTile": "geomosaic.composition.tiles:PackedTile",
    "geomosaic.survey.model:LeftOut": "geomosaic.survey.model:UnusedImage",
    "geomosaic.recording.chips:Chip": "geomosaic.recording.file.chips:Chip",
    "geomosaic.recording.thumbnail:Seen": "geomosaic.stages.survey_read:FirstLook",
    "geomosaic.stages.survey_read:Seen": "geomosaic.stages.survey_read:FirstLook",
    "geomosaic.recording.file.thumbnail:Seen": "geomosaic.stages.survey_read:FirstLook",
    "geomosaic.adjustment.procedure.rig:RigPoses": "geomosaic.matching.band_registration:RigPoses",
    "geomosaic.adjustment.procedure.rig:BandPose": "geomosaic.matching.band_registration:BandPose",
    "geomosaic.surface.terrain:TerrainModel": "geomosaic.surface.dtm:TerrainModel",
}
"""Present name of a class by its former name, in the room's present name."""


FORMER_DECLARATIONS: Final = {"beside": "concurrent"}
"""Present name of what a stage declares by its former name."""


def present_name(name: str) -> str:
    """The name that a class has now, given the name in a file."""
    found = re.match(r"geomosaic\.(\w+)", name)
    if found and found[1] in _ROOMS:
        name = f"geomosaic.{_ROOMS[found[1]]}{name[found.end() :]}"
    return FORMER.get(name, name)
