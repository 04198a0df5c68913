"""How high the frames flew above the ground, from their images, where nothing else says it."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any, ClassVar

import numpy as np

from geomosaic.matching.features import reduction_for
from geomosaic.matching.flying_height import flying_height_m
from geomosaic.pipeline.stage import Context, Stage
from geomosaic.placement.heights import FlyingHeight, height_is_unknown, neighbours
from geomosaic.stages.keypoints import FrameReduction, frame_features, pictured
from geomosaic.survey.model import Survey

_PAIRS = 16
_LONGEST_PX = 750


class MatchingFlyingHeight(Stage):
    """Measures by how much the images of neighbours shift; looks at no image where heights were given."""

    id = "matching.flying_height"
    display_name = "Measure the flying height"
    group = "Matching"
    version = 2
    wants_frames: ClassVar[bool] = True
    inputs: ClassVar[dict[str, type]] = {"survey": Survey}
    outputs: ClassVar[dict[str, type]] = {"flying_height": FlyingHeight}

    def run(self, inputs: Mapping[str, Any], params: Any, context: Context) -> dict[str, Any]:
        """The median of some pairs of neighbours."""
        survey: Survey = inputs["survey"]
        frames = survey.frames
        pairs = neighbours(frames, _PAIRS) if height_is_unknown(survey) else []
        used = sorted({i for pair in pairs for i in pair[:2]})
        with pictured(
            context, FrameReduction(_LONGEST_PX, _LONGEST_PX), [frames[i] for i in used]
        ) as pictures:
            take = partial(frame_features, _LONGEST_PX, 3000)
            found = context.map("keypoints for the flying height", take, pictures)
        features = dict(zip(used, found, strict=True))
        heights_m = []
        for a, b, base_m in pairs:
            tolerance = 3.0 * reduction_for(frames[a].width_px, frames[a].height_px, _LONGEST_PX)
            cameras = survey.camera_of(a), survey.camera_of(b)
            heights_m.append(flying_height_m(features[a], features[b], *cameras, base_m, tolerance))
        known = np.array(heights_m)[np.isfinite(heights_m)]
        return {"flying_height": FlyingHeight(float(np.median(known)) if known.size else float("nan"))}
