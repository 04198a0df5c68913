"""What authors of stages, blends and seams build on: the one place to import from. See docs/stages.md.

What stands here changes only with a word in the changelog; other modules are geomosaic's own affair.
"""

from geomosaic.adjustment.model import Adjusted, Block
from geomosaic.camera.exterior import Pose, Poses
from geomosaic.camera.interior import Camera
from geomosaic.camera.rotation import Rotation
from geomosaic.composition.blends import Blend, Piece
from geomosaic.composition.model import Mosaic, OutputGrid
from geomosaic.composition.ownership import Ownership
from geomosaic.composition.seam_cut import Seam
from geomosaic.composition.tones import Tones
from geomosaic.errors import (
    CancelledError,
    FileError,
    GeomosaicError,
    InputError,
    NotSolvableError,
    OutputError,
    UnknownNameError,
)
from geomosaic.geodesy.local import LocalFrame
from geomosaic.matching.model import TiePair, TiePoints
from geomosaic.pipeline.function_stage import InputGroup, stage
from geomosaic.pipeline.stage import Context, RunFile, Stage, StageParams, param
from geomosaic.pipeline.stored_result import StoredResult
from geomosaic.placement.model import Placement
from geomosaic.projection.footprint import footprint, ground_from_image, ground_sampling_distance_m
from geomosaic.projection.ground import GroundSurface
from geomosaic.quality.verdict import Verdict
from geomosaic.survey.model import (
    Attitude,
    ControlPoint,
    ElevationModel,
    Frame,
    Position,
    Survey,
    UnusedImage,
)
from geomosaic.survey.pixels import read_pixels

__all__ = [
    "Adjusted",
    "Attitude",
    "Blend",
    "Block",
    "Camera",
    "CancelledError",
    "Context",
    "ControlPoint",
    "ElevationModel",
    "FileError",
    "Frame",
    "GeomosaicError",
    "GroundSurface",
    "InputError",
    "InputGroup",
    "LocalFrame",
    "Mosaic",
    "NotSolvableError",
    "OutputError",
    "OutputGrid",
    "Ownership",
    "Piece",
    "Placement",
    "Pose",
    "Poses",
    "Position",
    "Rotation",
    "RunFile",
    "Seam",
    "Stage",
    "StageParams",
    "StoredResult",
    "Survey",
    "TiePair",
    "TiePoints",
    "Tones",
    "UnknownNameError",
    "UnusedImage",
    "Verdict",
    "footprint",
    "ground_from_image",
    "ground_sampling_distance_m",
    "param",
    "read_pixels",
    "stage",
]
