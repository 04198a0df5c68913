"""Keypoints of one frame, as stages spread them over the workers."""

from __future__ import annotations

from geomosaic.matching.features import Features, grey, reduction_for, sift_features
from geomosaic.survey.model import Frame
from geomosaic.survey.pixels import read_pixels


def frame_features(frame: Frame, longest_px: int, most: int, band: int | None) -> Features:
    """Decodes a frame once, reduced, and takes its keypoints."""
    reduction = reduction_for(frame.width_px, frame.height_px, longest_px)
    pixels, valid = read_pixels(frame, reduction)
    return sift_features(grey(pixels, valid, band), valid, reduction, most)
