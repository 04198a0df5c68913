"""What a mosaic is judged by: figures with limits, and warnings of the adjustment."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

ASKED: Final = "{asked}"
"""Where a cause says how far land may lie off."""
GRADES: Final = ("good", "doubtful", "bad")
NOTED: Final = "noted"
"""The grade of an inner figure beyond its limit: it explains, but colours no verdict."""
HOUSES: Final = "houses-lean"
"""The warning that tall houses lean. Then jumps at seams don't show a wrong map."""
JUMPS: Final = ("seams", "worst tenth of the seams")
FIRST: Final = ("frames left out", "frames not tied", HOUSES)
"""Of figures with the worst grade, these are named before others: they explain seams and deviations."""


@dataclass(frozen=True)
class Criterion:
    """A figure is good up to `good`, bad beyond `bad`, doubtful between; the cause and the fix if it is not
    good, and why the limits are where they are. inner: up to `bad` it is noted, since what it does to the map
    shows elsewhere, and doubtful beyond. of_land: a length in pixels that is good up to what is asked
    of land relative to the land around it."""

    good: float
    bad: float
    unit: str
    cause: str
    fix: str
    reason: str
    inner: bool = False
    of_land: bool = False

    def grade(self, value: float, asked_px: float) -> str:
        """Of a figure; asked_px: how far land may lie off."""
        if self.of_land and value <= asked_px:
            return GRADES[0]
        if self.inner and value > self.good:
            return NOTED if value <= self.bad else GRADES[1]
        return GRADES[int(value > self.good) + int(value > self.bad)]


CRITERIA: Mapping[str, Criterion] = {
    "image deviation": Criterion(
        0.7,
        3.0,
        "px",
        "images and camera disagree: blur, rolling shutter while turning, another lens, moving ground",
        "give the lens and the readout time (--camera); blurred frames need shorter exposures",
        "keypoints on ground that stays are good to a third of a pixel, by reduced frames to half of one: "
        "beyond that something moves or bends; a map is called wrong beyond three",
    ),
    "pattern of residuals": Criterion(
        0.5,
        2.0,
        "px",
        "residuals repeat at the same places of the frames: another lens than given, or a rolling shutter",
        "give the lens and the readout time (--camera)",
        "half a pixel is where a step at a seam begins to be seen",
    ),
    "seams": Criterion(
        1.0,
        3.0,
        "px",
        "the ground jumps at the seams",
        "see the other figures; on relief take --surface dense, or give an elevation model (--dem)",
        "the median of all places, as for the image deviation",
    ),
    "worst tenth of the seams": Criterion(
        3.0,
        np.inf,
        "px",
        "the ground jumps at some seams: things that stand above it, or single frames out of place",
        "look at the seams in the report; --surface dense or an elevation model (--dem) helps with what "
        "stands above ground",
        "what stands above the ground jumps by more, while the map around it is right",
        of_land=True,
    ),
    "ground unknown": Criterion(
        0.1,
        np.inf,
        "share",
        "the ground between tie points may lie so much higher or lower that the map is off by more than "
        f"{ASKED}",
        "an elevation model (--dem), --surface dense where things stand on it, or more overlap",
        "as for the worst tenth of the seams and a matched surface: about what stands, ground is rough",
    ),
    "rim": Criterion(
        0.05,
        1.0 / 3.0,
        "share",
        "the ground beyond the last tie points may lie so much higher or lower that the map there is off by "
        f"more than {ASKED}",
        "an elevation model (--dem), or one more line beyond the area on each side",
        "every survey has a rim that too few frames see, and accuracy.tif shows it; a third of all is no rim",
        inner=True,
    ),
    "surface unsure": Criterion(
        0.1,
        np.inf,
        "share",
        "the surface was matched unsurely: woods in wind, edges of objects, and land that few frames or only "
        f"oblique views show, may lie off by more than {ASKED}",
        "more overlap along and across, flown without wind; --ortho terrain rectifies on the terrain below",
        "as for the worst tenth of the seams: nine tenths of the land keep below what is asked",
    ),
    "frames not tied": Criterion(
        0.01,
        1.0 / 3.0,
        "share",
        "frames without tie points are placed by their own positions alone, which may be metres off",
        "leave them out, or fly with more overlap",
        "a position is worth metres, so their land is off; a hundredth of all is a corner, a third is no map",
    ),
    "frames left out": Criterion(
        0.01,
        1.0 / 3.0,
        "share",
        "frames without a position, which no tie points join to the others, are missing with their ground",
        "give their positions with --pos, or fly with more overlap",
        "as for frames that are not tied",
    ),
    "frames in other parts": Criterion(
        0.01,
        1.0 / 3.0,
        "share",
        "tie points connect the frames in several parts only, each placed by its own positions",
        "frames between the parts, or control points in each",
        "as for frames that are not tied",
    ),
    "tie points disregarded": Criterion(
        0.3,
        0.6,
        "share",
        "many tie points disagree: repeating patterns, moving ground, or another kind of camera",
        "look at the pairs with the largest residuals in the report",
        "by chance three in a thousand are; beyond a half the solve follows the wrong ones",
    ),
    "principal point": Criterion(
        2.0,
        np.inf,
        "% of the side",
        "the principal point is drawn farther off than lenses have it: a rolling shutter, or another lens",
        "give the lens and the readout time (--camera)",
        "small cameras' principal points lie within 1 or 2 in a hundred of the longer side",
        inner=True,
    ),
    "shape": Criterion(
        0.5,
        np.inf,
        "px",
        "positions and images leave open how the block is stretched or bent",
        "lines flown across, better positions or control points",
        "one deviation; what it does to distances is in the relative accuracy",
        inner=True,
    ),
    "tilts": Criterion(
        3.0,
        np.inf,
        "stated deviations",
        "the frames' tilts are not those that were given: the block leans, or the attitudes are wrong",
        "check the attitudes' convention, give control points or an elevation model (--dem)",
        "tags state their deviation to a factor of two; beyond three something else takes part",
        inner=True,
    ),
    "control points": Criterion(
        1.0,
        2.0,
        "of the limit",
        "a control point lies far from where the images put it",
        "check its coordinates and where it was marked",
        "the limit is three deviations of one point, and of many what none of them exceeds by chance",
    ),
    "blunders": Criterion(
        0.0,
        np.inf,
        "points",
        "control or check points contradict the others",
        "check the coordinates and the marks of the points that the warnings name",
        "a point that contradicts the others is wrong, or the map is there",
    ),
    "check points": Criterion(
        3.0,
        np.inf,
        "stated deviations",
        "all check points are off by one common shift, larger than the stated accuracy",
        "use them as control points, or check the datum of both",
        "within three, a shift is what the stated absolute accuracy says",
    ),
}

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
"""Warnings that bear on the map as a whole: grade, cause and fix."""
