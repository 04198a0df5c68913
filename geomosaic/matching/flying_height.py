"""Flying height from images and positions alone, for surveys that report none."""

from __future__ import annotations

import numpy as np

from geomosaic.camera.interior import Camera
from geomosaic.constants import tuned
from geomosaic.estimation.linear import least_squares
from geomosaic.matching.features import Features
from geomosaic.matching.search import by_homography, mutual_nearest, root_sift

_LEAST = tuned(20, "tie points", "of a pair: fewer fit any height by chance; more lose water and fields")


def flying_height_m(
    features: tuple[Features, Features],
    cameras: tuple[Camera, Camera],
    base_m: float,
    tolerance_px: float,
) -> float:
    """Height above the ground at which two frames were taken base_m apart; NaN if they don't match.

    On flat ground seen from straight above, two images differ by a similarity. The place of one's middle in
    the other, counted in focal lengths, is the base over the height. A tilt of 1 degree is taken for 1.7 % of
    the height as base, so the median of several pairs is good to some per cent.

    Args: base_m: horizontal distance of the projection centres; tolerance_px: of the match, in full
        pixels.
    """
    left, right = features
    i, j = mutual_nearest(root_sift(left.descriptors), root_sift(right.descriptors), 0.8)
    good = by_homography(left.image_px[i], right.image_px[j], tolerance_px)
    if int(good.sum()) < _LEAST:
        return float("nan")
    z = cameras[0].ray_from_image(left.image_px[i[good]])[:, :2] @ [1, 1j]
    w = cameras[1].ray_from_image(right.image_px[j[good]])[:, :2] @ [1, 1j]
    turn, shift = least_squares(np.column_stack([z, np.ones_like(z)]), w)
    return base_m / abs(shift) if 0.5 < abs(turn) < 2.0 and abs(shift) > 0.01 else float("nan")
