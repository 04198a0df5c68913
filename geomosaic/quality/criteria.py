"""What a mosaic is judged by: figures with limits."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from geomosaic.composition.trim import REASONS

ASKED: Final = "{asked}"
"""Where a cause says how far land may lie off."""
GRADES: Final = ("good", "doubtful", "bad")
NOTED: Final = "noted"
"""The grade of an inner figure beyond its limit: it explains, but colours no verdict."""
HOUSES: Final = "houses-lean"
"""The warning that tall houses lean. Then jumps at seams don't show a wrong map."""
JUMPS: Final = ("seams", "worst tenth of the seams")
TRIMMED: Final = "land left out"
WHY: Final = "{why}"
"""Where a cause says why land was trimmed."""
FIRST: Final = ("frames left out", "frames not tied", TRIMMED, HOUSES)
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
        "take --surface dense or an elevation model (--dem); over flat land give the lens and the readout "
        "time (--camera)",
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
    TRIMMED: Criterion(
        0.5,
        0.9,
        "share",
        f"most of the land in the frames is trimmed: {WHY}",
        "--edges keep maps it all, less accurately",
        "by pixels of the frames: a map of less than half of them is not what they were taken for, and of a "
        "tenth it is a remainder",
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

MATCHED_SEAMS: Final = (
    "leave out frames that are blurred or out of place at the largest jumps (see the report), or fly with "
    "more overlap"
)
"""The fix for jumps at the seams where the surface is matched already."""

_ASLANT, _COARSE, _GUESSED = REASONS.values()
TRIM_FIXES: Final = {
    _ASLANT: "point the camera straight down; --edges keep maps this land, stretched",
    _COARSE: "leave out frames that look into the distance; --edges keep maps this land, blurred",
    _GUESSED: "more overlap and one more line on each side, or an elevation model (--dem); --edges keep maps "
    "this land, displaced",
}
"""The fix for land that is left out, by the reason for most of it."""
