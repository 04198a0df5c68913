"""Warnings that bear on a map as a whole: how they grade it, why, and what fixes it."""

from __future__ import annotations

from collections.abc import Mapping

from geomosaic.quality.criteria import HOUSES, NOTED

WARNED: Mapping[str, tuple[str, str, str]] = {
    "bundle-failed": (
        "bad",
        "the adjustment failed; frames are placed by similarities alone",
        "more overlap, or positions of more frames",
    ),
    "self-calibration-failed": (
        "doubtful",
        "lens and shutter could not be solved for and are as given",
        "give a calibrated lens (--camera), or more overlap",
    ),
    HOUSES: (
        "doubtful",
        "tall houses lean and are cut off at the seams; jumps there say nothing of the ground between them",
        "fly higher, with more overlap, to see less of their walls",
    ),
    "positions-mirrored": (
        "bad",
        "the positions are a mirror image of what the frames show: exchanged columns, or a lost sign",
        "correct longitude and latitude in --pos or in the frames' tags",
    ),
    "positions-out-of-step": (
        "bad",
        "the positions are one frame out of step: each frame has that of its neighbour",
        "shift the names in --pos by one line",
    ),
    "positions-contradicted": (
        "bad",
        "the positions contradict the images: they may belong to other frames",
        "check the names and their order in --pos, or the frames' tags",
    ),
    "positions-elsewhere": (
        "doubtful",
        "the POS file and the positions in the frames' tags lie kilometres apart",
        "check the columns of the file and its reference system (--pos-crs)",
    ),
    "positions-in-other-order": (
        "doubtful",
        "the positions of the POS file do not fit the frames' tags, or only in another order",
        "check the names in --pos and their order",
    ),
    "heights-elsewhere": (
        "doubtful",
        "the heights of the POS file agree with those in the frames' tags only if they are feet",
        "name the column of the heights height_ft, or correct the heights",
    ),
    "headings-reversed": (
        "doubtful",
        "all headings of the POS file are off by 180 degrees: its rows may be in reverse order",
        "check the names in --pos; of a camera mounted the other way round, give its own headings",
    ),
    "dem-heights-off": (
        "doubtful",
        "the elevation model lies hundreds of metres off the ground by the frames' altitudes",
        "check the unit of its heights and what they count from (--dem-offset)",
    ),
    "pixels-turned": (
        "doubtful",
        "the frames' pixels were turned after the flight: how the rolling shutter bends the map is unknown",
        "give the files as the camera wrote them",
    ),
    "velocity-unknown": (
        "doubtful",
        "rolling shutter: how fast the frames flew is unknown, and the map may be stretched along the lines",
        "give the files as the camera wrote them, with their times",
    ),
    "scale-doubtful": (
        "doubtful",
        "the block's scale disagrees with the positions",
        "check the focal length and the positions, or give control points",
    ),
    "positions-shifted": (
        NOTED,
        "positions and control lie apart",
        "check the datum and the height system of both",
    ),
    "pose-not-determined": (
        NOTED,
        "tie points don't determine the poses of some frames",
        "look at those frames; more overlap there",
    ),
    "shutter-doubtful": (
        NOTED,
        "the frames' rows were read one after the other while the camera turned, in a way that no tag states",
        "a camera with a global shutter or a gyroscope in its tags, or control points",
    ),
    "adjustment-step-failed": (
        NOTED,
        "a step of the adjustment could not be solved and was left out",
        "more overlap, or positions of more frames",
    ),
    "control-unused": (
        "doubtful",
        "no control or check point could be used",
        "mark the points in images of this survey, or leave --gcp out",
    ),
    "lens-strayed": (
        "doubtful",
        "the estimated lens is impossible: distances may be wrong",
        "give the lens and the readout time (--camera)",
    ),
}
"""Grade, cause and fix by the warning's code."""
