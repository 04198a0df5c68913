"""Whether a mosaic can be trusted: good, doubtful or bad, for what reason, and what would mend it."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from geomosaic.adjustment.model import Adjusted
from geomosaic.adjustment.procedure.residual_pattern import ResidualPattern
from geomosaic.constants import sourced, tuned
from geomosaic.mosaic.trim import OFF_PX
from geomosaic.quality.ground_doubt import LandDoubt
from geomosaic.quality.seam_check import SeamCheck

GRADES = ("good", "doubtful", "bad")


@dataclass(frozen=True)
class Criterion:
    """A figure is good up to `good`, bad beyond `bad`, doubtful between; the cause and the mend if it isn't
    good, and why the limits are where they are."""

    good: float
    bad: float
    unit: str
    cause: str
    mend: str
    reason: str


CRITERIA: Mapping[str, Criterion] = {
    "image deviation": Criterion(
        0.7,
        3.0,
        "px",
        "images and camera disagree: rolling shutter while turning, another lens, moving ground",
        "give the lens and the readout time (--camera)",
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
        "houses without a surface model jump by more, while the map around them is right",
    ),
    "ground unknown": Criterion(
        1.5,
        np.inf,
        "px",
        "the ground beyond the last tie points, or between them, may be higher or lower than was assumed",
        "an elevation model (--dem), or frames beyond what is wanted",
        "what 99 of 100 places of the land keep below; a step of 1.5 px in a road is seen",
    ),
    "surface unsure": Criterion(
        0.1,
        np.inf,
        "share",
        "the surface was matched unsurely: woods that wind moves, rims of what stands, and what few frames "
        f"see, or see aslant, may lie off by more than {OFF_PX:g} px",
        "more overlap along and across, flown in calm air; --ortho terrain lays frames on the ground below",
        "as for the worst tenth of the seams: nine tenths of the land keep below 3 px",
    ),
    "frames not tied": Criterion(
        0.0,
        1.0 / 3.0,
        "share",
        "frames that match no other lie where their own positions say",
        "leave them out, or fly with more overlap",
        "a position is worth metres, so one such frame is a visible fault, a third of them no map",
    ),
    "frames in other parts": Criterion(
        0.0,
        1.0 / 3.0,
        "share",
        "the frames hang together in several parts, each placed by its own positions",
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
    ),
    "shape": Criterion(
        0.5,
        np.inf,
        "px",
        "positions and images leave open how the block is stretched or bent",
        "lines flown across, the readout time (--camera), better positions or control points",
        "one deviation; a map is promised to a pixel, and two deviations are what 95 of 100 keep",
    ),
    "tilts": Criterion(
        3.0,
        np.inf,
        "stated deviations",
        "the frames' tilts are not those that were given: the block leans, or the attitudes are wrong",
        "check the attitudes' convention, give control points or an elevation model (--dem)",
        "tags state their deviation to a factor of two; beyond three something else takes part",
    ),
    "control points": Criterion(
        3.0,
        6.0,
        "deviations",
        "a control or check point lies far from where the images put it",
        "check its coordinates and where it was marked",
        "of a few dozen honest coordinates none is beyond three, of a million none beyond six",
    ),
}

_WARNED: Mapping[str, tuple[str, str, str]] = {
    "bundle-failed": (
        "bad",
        "the adjustment failed; frames are only laid beside each other",
        "more overlap, or positions of more frames",
    ),
    "self-calibration-failed": (
        "doubtful",
        "lens and shutter could not be solved for and are as given",
        "give a calibrated lens (--camera), or more overlap",
    ),
    "scale-doubtful": (
        "doubtful",
        "the block's scale disagrees with the positions",
        "check the focal length and the positions, or give control points",
    ),
    "positions-shifted": (
        "doubtful",
        "positions and control lie apart",
        "check the datum and the height system of both",
    ),
    "pose-not-determined": (
        "doubtful",
        "tie points don't determine the poses of some frames",
        "look at those frames; more overlap there",
    ),
    "shutter-doubtful": (
        "doubtful",
        "the frames' rows were read one after the other while the camera turned, in a way that no tag states",
        "a camera with a global shutter or a gyroscope in its tags, or control points",
    ),
    "lens-strayed": (
        "doubtful",
        "no lens bends images as these are bent",
        "give the lens and the readout time (--camera)",
    ),
}
"""Warnings of the adjustment that bear on the map as a whole: grade, cause and mend."""
_DISREGARDED = sourced(0.1, "full weight", "3 in 1000 are below by chance", "Student's pairs: 10^(-5 / 2)")

_WORTH_A_WORD = tuned(0.01, "share", "of land off that a good verdict mentions: less is a corner")


@dataclass(frozen=True)
class Evidence:
    """One reason: a figure and its grade; the likely cause and the mend where it isn't good."""

    name: str
    value: float
    unit: str
    grade: str
    cause: str = ""
    mend: str = ""

    @property
    def figure(self) -> str:
        """The value with its unit."""
        return _percent(self.value) if self.unit == "share" else f"{self.value:.2f} {self.unit}".strip()


@dataclass(frozen=True)
class Verdict:
    """The worst grade of all evidence, with the cause and the mend of what weighs most.

    absolute_sd_m: what the adjustment states of where the typical tied frame lies on the ground, one
    deviation of a horizontal coordinate; NaN for methods that state none. seams, patterns: what it was drawn
    from.
    """

    grade: str
    text: str
    cause: str
    mend: str
    evidence: tuple[Evidence, ...]
    absolute_sd_m: float
    seams: SeamCheck
    patterns: tuple[ResidualPattern, ...]


def verdict_of(
    adjusted: Adjusted,
    seams: SeamCheck,
    patterns: tuple[ResidualPattern, ...],
    parts: Sequence[Sequence[int]],
    used: Collection[int],
    flying_height_m: float,
    doubt: LandDoubt,
) -> Verdict:
    """Grades all that is known of a mosaic without its truth.

    Args: parts: frames that hang together by tie points; used: frames that gave pixels; doubt: of the ground
    and of what was matched.
    """
    figures = _agreement(adjusted, patterns) | _seams(seams) | _held_together(adjusted, parts, used)
    of_land = {"ground unknown": doubt.ground_px, "surface unsure": doubt.surface_share}
    figures |= {name: value for name, value in of_land.items() if np.isfinite(value)}
    warned = {w.code for w in adjusted.warnings}
    evidence = (
        *(_judged(name, value) for name, value in figures.items()),
        *(Evidence(code, 1.0, "", *words) for code, words in _WARNED.items() if code in warned),
    )
    worst = max(evidence, key=lambda e: GRADES.index(e.grade))
    return Verdict(
        grade=worst.grade,
        text=_text(adjusted, figures),
        cause=f"{worst.cause} ({worst.name} {worst.figure})" if worst.unit and worst.cause else worst.cause,
        mend=worst.mend,
        evidence=evidence,
        absolute_sd_m=_absolute_sd_m(adjusted, flying_height_m),
        seams=seams,
        patterns=patterns,
    )


def _judged(name: str, value: float) -> Evidence:
    criterion = CRITERIA[name]
    grade = GRADES[int(value > criterion.good) + int(value > criterion.bad)]
    if grade == "good":
        return Evidence(name, value, criterion.unit, grade)
    return Evidence(name, value, criterion.unit, grade, criterion.cause, criterion.mend)


def _held_together(
    adjusted: Adjusted, parts: Sequence[Sequence[int]], used: Collection[int]
) -> dict[str, float]:
    """Shares of the mosaic's frames that hang on their own positions, or in another part than most."""
    tied = {i for i in used if adjusted.status[i] == "tied"}
    largest = max((len(tied.intersection(part)) for part in parts), default=0)
    return {
        "frames not tied": (len(used) - len(tied)) / max(len(used), 1),
        "frames in other parts": (len(tied) - largest) / max(len(used), 1),
    }


def _agreement(adjusted: Adjusted, patterns: tuple[ResidualPattern, ...]) -> dict[str, float]:
    """How far images, camera and control agree in the adjustment, as far as the method says."""
    found = {}
    if "sigma_px" in adjusted.figures:
        found["image deviation"] = adjusted.figures["sigma_px"]
    if "shape_sd_px" in adjusted.figures:
        found["shape"] = adjusted.figures["shape_sd_px"]
    if "sigma_tilt" in adjusted.figures:
        found["tilts"] = adjusted.figures["sigma_tilt"]
    if adjusted.shared is not None:
        found["principal point"] = _principal_point_off(adjusted)
    if patterns:
        found["pattern of residuals"] = max(p.systematic_px for p in patterns)
    if adjusted.image_residuals is not None and len(adjusted.image_residuals.weight):
        disregarded = adjusted.image_residuals.weight < _DISREGARDED
        found["tie points disregarded"] = float(disregarded.mean())
    off = [float(np.abs(c.residual_m / c.sd_m).max()) for c in adjusted.control]
    if any(np.isfinite(off)):
        found["control points"] = float(np.nanmax(off))
    return found


def _principal_point_off(adjusted: Adjusted) -> float:
    """By how much principal points moved from what was given, in % of the longer side; the worst camera's."""
    shared, side = adjusted.shared, {c.name: max(c.width_px, c.height_px) for c in adjusted.cameras}
    if shared is None:
        return 0.0
    moved: dict[str, float] = {}
    for of, name, given, found in zip(shared.of, shared.names, shared.given, shared.found, strict=True):
        if name in ("principal_col_px", "principal_row_px") and of in side:
            moved[of] = float(np.hypot(moved.get(of, 0.0), 100.0 * (found - given) / side[of]))
    return max(moved.values(), default=0.0)


def _seams(seams: SeamCheck) -> dict[str, float]:
    length = seams.length_px[np.isfinite(seams.length_px)]
    if not length.size:
        return {}
    return {
        "seams": float(np.median(length)),
        "worst tenth of the seams": float(np.quantile(length, 0.9)),
    }


def _absolute_sd_m(adjusted: Adjusted, flying_height_m: float) -> float:
    """Median over the tied frames of the deviation of the ground below: position and tilts together."""
    tied = [i for i, s in enumerate(adjusted.status) if s == "tied"]
    if adjusted.pose_covariance is None or not tied:
        return float("nan")
    h = flying_height_m
    down = np.array([[1.0, 0.0, 0.0, 0.0, -h, 0.0], [0.0, 1.0, 0.0, h, 0.0, 0.0]])
    on_ground = down @ adjusted.pose_covariance[tied] @ down.T
    return float(np.median(np.sqrt(np.trace(on_ground, axis1=1, axis2=2) / 2.0)))


def _text(adjusted: Adjusted, figures: Mapping[str, float]) -> str:
    """How many frames are tied, how well they agree, and how much land the surface leaves open."""
    words = [f"{adjusted.status.count('tied')} of {len(adjusted.status)} frames tied"]
    words += [f"{name} {figures[name]:.2f} px" for name in ("image deviation", "seams") if name in figures]
    unsure = figures.get("surface unsure", 0.0)
    words += [f"{_percent(unsure)} of the land may be off by more than {OFF_PX:g} px"] * (
        unsure >= _WORTH_A_WORD
    )
    return ", ".join(words)


def _percent(share: float) -> str:
    return f"{100.0 * share:.0f} %"
