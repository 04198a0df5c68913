"""How high the frames flew above the ground, from their images, where nothing else says it."""

from __future__ import annotations

from functools import partial

import numpy as np

from geomosaic.arrays import Floats
from geomosaic.camera.rotation import Rotation
from geomosaic.matching.features import reduction_for
from geomosaic.matching.flying_height import flying_height_m
from geomosaic.pipeline.function_stage import stage
from geomosaic.pipeline.stage import Context
from geomosaic.placement.heights import FlyingHeight, height_is_unknown, neighbours, or_nan
from geomosaic.stages.keypoints import FrameReduction, frame_features, pictured
from geomosaic.survey.model import Frame, Survey

_PAIRS = 16
_LONGEST_PX = 750


@stage(
    "matching.flying_height", "Measure the flying height", group="Matching", version=4,
    outputs="flying_height", wants_frames=True,
)  # fmt: skip
def matching_flying_height(survey: Survey, context: Context) -> FlyingHeight:
    """Measures by how much the images of neighbours shift; looks at no image where heights were given."""
    frames = survey.frames
    pairs = neighbours(frames, _PAIRS) if height_is_unknown(survey) else []
    used = sorted({i for pair in pairs for i in pair[:2]})
    with pictured(context, FrameReduction(_LONGEST_PX, _LONGEST_PX), [frames[i] for i in used]) as pictures:
        take = partial(frame_features, _LONGEST_PX, 3000)
        found = context.map("keypoints for the flying height", take, pictures)
    features = dict(zip(used, found, strict=True))
    heights_m = []
    for a, b, base_m in pairs:
        tolerance = 3.0 * reduction_for(frames[a].width_px, frames[a].height_px, _LONGEST_PX)
        cameras = survey.camera_of(a), survey.camera_of(b)
        tilts = _tilt(frames[a]), _tilt(frames[b])
        heights_m.append(flying_height_m((features[a], features[b]), cameras, tilts, base_m, tolerance))
    known = np.array(heights_m)[np.isfinite(heights_m)]
    return FlyingHeight(float(np.median(known)) if known.size else float("nan"))


def _tilt(frame: Frame) -> Floats:
    """From the camera's axes to level ones, as reported; of a camera that looks down where nothing is."""
    pitch, roll = (or_nan(angle) for angle in (frame.attitude.pitch_deg, frame.attitude.roll_deg))
    return Rotation.from_yaw_pitch_roll(*np.radians(np.nan_to_num([0.0, pitch, roll]))).matrix
