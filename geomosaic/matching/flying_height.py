"""Flying height from images and positions alone, for surveys that report none."""

from __future__ import annotations

import numpy as np

from geomosaic.arrays import Floats
from geomosaic.camera.interior import Camera
from geomosaic.constants import tuned
from geomosaic.estimation.linear import least_squares
from geomosaic.matching.features import Features
from geomosaic.matching.search import by_homography, mutual_nearest, root_sift

_LEAST_DOWN = tuned(0.2, "focal lengths", "by which rays go down: less meets far land; more loses tilts")
_LEAST = tuned(20, "tie points", "of a pair: fewer fit any height by chance; more lose water and fields")


def flying_height_m(
    features: tuple[Features, Features],
    cameras: tuple[Camera, Camera],
    tilts: tuple[Floats, Floats],
    base_m: float,
    tolerance_px: float,
) -> float:
    """Height above the ground at which two frames were taken base_m apart; NaN if they don't match.

    Seen from straight above, images of flat ground differ by a similarity; those of tilted cameras do once
    their rays are turned. The place of one's middle in the other, counted in heights, is the base over the
    height. A tilt that is off by 1 degree is taken for 1.7 % of the height as base, so the median of several
    pairs is good to some per cent.

    Args: tilts: turns (3, 3) from each camera's axes to level ones, headed anywhere. base_m: horizontal
        distance of the projection centres; tolerance_px: of the match, in full pixels.
    """
    left, right = features
    i, j = mutual_nearest(root_sift(left.descriptors), root_sift(right.descriptors), 0.8)
    good = by_homography(left.image_px[i], right.image_px[j], tolerance_px)
    if int(good.sum()) < _LEAST:
        return float("nan")
    rays = [
        camera.ray_from_image(px) @ tilt.T
        for camera, px, tilt in zip(
            cameras, (left.image_px[i[good]], right.image_px[j[good]]), tilts, strict=True
        )
    ]
    down = (rays[0][:, 2] < -_LEAST_DOWN) & (rays[1][:, 2] < -_LEAST_DOWN)
    if int(down.sum()) < _LEAST:
        return float("nan")
    z, w = (ray[down, :2] @ [1, 1j] / -ray[down, 2] for ray in rays)
    turn, shift = least_squares(np.column_stack([z, np.ones_like(z)]), w)
    return base_m / abs(shift) if 0.5 < abs(turn) < 2.0 and abs(shift) > 0.01 else float("nan")
