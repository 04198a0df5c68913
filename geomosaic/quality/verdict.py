"""Whether a mosaic can be trusted: good, doubtful or bad, for what reason, and what would fix it."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, Final

import numpy as np
from scipy.special import bdtr, ndtr, ndtri  # those of scipy.stats take half a second to import

from geomosaic.adjustment.model import Adjusted, ControlResidual
from geomosaic.adjustment.procedure.residual_pattern import ResidualPattern
from geomosaic.constants import sourced, tuned
from geomosaic.estimation.robust import THREE_SIGMA
from geomosaic.quality.accuracy import LEAST_POINTS, Accuracy, Requirement, metres
from geomosaic.quality.check_points import check_points
from geomosaic.quality.control import control_blunders
from geomosaic.quality.criteria import ASKED, CRITERIA, FIRST, GRADES, HOUSES, JUMPS, NOTED, WARNED
from geomosaic.quality.ground_doubt import LandDoubt
from geomosaic.quality.seam_check import SeamCheck
from geomosaic.survey.names import some

_DISREGARDED = sourced(0.1, "full weight", "3 in 1000 are below by chance", "Student's pairs: 10^(-5 / 2)")
_CHANCE = sourced(0.05, "share", "of medians below their lower limit", "the usual one-sided level")
OF_LAND: Final = ("ground unknown", "rim", "surface unsure")
_WORTH_A_WORD = tuned(0.01, "share", "of land off that a good verdict mentions: less is a corner")


@dataclass(frozen=True)
class Evidence:
    """One reason: a figure and its grade; the likely cause and the fix where it is not good. effect: what it
    does to the map in metres, and where."""

    FORMERLY: ClassVar[dict[str, str]] = {"mend": "fix"}
    name: str
    value: float
    unit: str
    grade: str
    cause: str = ""
    fix: str = ""
    effect: str = ""

    @property
    def figure(self) -> str:
        """The value with its unit."""
        if self.unit == "share":
            return _percent(self.value)
        return _with_unit(self.value, self.unit)


def _with_unit(value: float, unit: str) -> str:
    """A figure as text; lengths in metres with digits that tell them apart."""
    of, _, what = unit.partition(" ")
    if of == "m":
        return f"{metres(value)} {what}".strip()
    return f"{value:.{0 if unit == 'points' else 2}f} {unit}".strip()


@dataclass(frozen=True)
class Verdict:
    """The worst grade of all evidence, with the cause and the fix of what weighs most.

    accuracy, required: how accurate the map is, and what is asked of it. seams, patterns: what the verdict
    was drawn from.
    """

    FORMERLY: ClassVar[dict[str, str]] = {"mend": "fix"}
    grade: str
    text: str
    cause: str
    fix: str
    evidence: tuple[Evidence, ...]
    accuracy: Accuracy
    required: Requirement
    seams: SeamCheck
    patterns: tuple[ResidualPattern, ...]


@dataclass(frozen=True)
class VerdictInputs:
    """What is known of a mosaic without its truth. parts: frames that tie points connect; land:
    the share of the mosaic's land that each frame gives, by frame; doubt: of the ground and of what was
    matched; warned: codes of the run's warnings; names of the frames; pixel_m: the mosaic's."""

    seams: SeamCheck
    patterns: tuple[ResidualPattern, ...]
    parts: Sequence[Sequence[int]]
    land: Mapping[int, float]
    doubt: LandDoubt
    warned: Collection[str] = ()
    names: Sequence[str] = ()
    pixel_m: float = float("nan")


def verdict_of(adjusted: Adjusted, seen: VerdictInputs, accuracy: Accuracy, required: Requirement) -> Verdict:
    """Grades a mosaic: whether a fault was found, and whether it is as accurate as is required."""
    figures = _agreement(adjusted, seen.patterns) | _seams(seen.seams)
    figures |= _connection(adjusted, seen.parts, seen.land, required.local_m)
    figures |= _land(seen.doubt)
    warned = {w.code for w in adjusted.warnings} | {*seen.warned}
    if "not-placed" in warned:
        figures["frames left out"] = _left_out(adjusted, seen.parts)
    judged = [_judged(name, value, required, seen.pixel_m) for name, value in figures.items()]
    good, doubtful, _ = GRADES
    if HOUSES in warned:
        judged = [
            replace(e, grade=min(e.grade, doubtful, key=GRADES.index)) if e.name in JUMPS else e
            for e in judged
        ]
    evidence = (
        *(e if e.grade == good else replace(e, effect=_effect(e, adjusted, seen, required)) for e in judged),
        *_against(accuracy, required),
        *(Evidence(code, 1.0, "", *words) for code, words in WARNED.items() if code in warned),
    )
    worst = max(evidence, key=_weight)
    noted = worst.grade == NOTED
    return Verdict(
        grade=GRADES[0] if noted else worst.grade,
        text=_text(adjusted, figures, required.length(required.local_m, seen.pixel_m)),
        cause="" if noted else _cause(worst),
        fix="" if noted else worst.fix,
        evidence=evidence,
        accuracy=accuracy,
        required=required,
        seams=seen.seams,
        patterns=seen.patterns,
    )


def _weight(of: Evidence) -> tuple[int, bool]:
    return -1 if of.grade == NOTED else GRADES.index(of.grade), of.name in FIRST


def _cause(worst: Evidence) -> str:
    said = ", ".join(filter(None, [f"{worst.name} {worst.figure}", worst.effect]))
    return f"{worst.cause} ({said})" if worst.unit and worst.cause else worst.cause


def _effect(of: Evidence, adjusted: Adjusted, seen: VerdictInputs, required: Requirement) -> str:
    """What a figure that is not good does to the map, and where."""
    on_ground = of.unit == "px" and seen.pixel_m > 0.0 and required.scaled
    said = [f"{metres(of.value * seen.pixel_m)} on the ground"] * on_ground
    if of.name in ("seams", "worst tenth of the seams"):
        worst = int(np.nanargmax(seen.seams.length_px))
        ends = [seen.names[int(side[worst])] for side in (seen.seams.left, seen.seams.right) if seen.names]
        said += [f"most between {' and '.join(ends)}"] * bool(ends)
    elif of.name == "frames not tied" and seen.names:
        said.append(some([seen.names[i] for i in sorted(seen.land) if adjusted.status[i] != "tied"]))
    elif of.name in OF_LAND:
        said.append("accuracy.tif shows where")
    elif of.name == "control points":
        off = {p.name: np.nanmax(np.abs(p.residual_m / p.sd_m)) for p in adjusted.control if not p.check}
        said.append(f"most at {max(off, key=lambda name: off[name])}")
    return ", ".join(said)


def _judged(name: str, value: float, required: Requirement, pixel_m: float) -> Evidence:
    criterion, asked = CRITERIA[name], required.length(required.local_m, pixel_m)
    grade = criterion.grade(value, required.local_m / pixel_m)
    words = ("", "") if grade == GRADES[0] else (criterion.cause.replace(ASKED, asked), criterion.fix)
    return Evidence(name, value, criterion.unit, grade, *words)


def _against(accuracy: Accuracy, required: Requirement) -> list[Evidence]:
    """Stated or measured accuracy against the requirement."""
    absolute, relative = accuracy.absolute, accuracy.relative
    better = "control points (--gcp) or RTK positions; --accuracy states what you need"
    if absolute.shifted:
        better = "use some of the check points as control points: they show one shift in common"
    asked = (
        ("absolute accuracy", absolute.rmse_h_m, required.rmse_h_m, "m RMSE", better),
        ("vertical accuracy", absolute.rmse_v_m, required.rmse_v_m, "m RMSE", better),
        (
            "relative accuracy",
            relative.permille,
            required.permille,
            "per mille",
            "control points (--gcp), RTK positions, or more lines; --accuracy-relative states what you need",
        ),
    )
    over_100_m = f"{metres(relative.permille / 10.0)} over 100 m"
    out = []
    for name, value, most, unit, fix in asked:
        if np.isfinite(value) and np.isfinite(most):
            missed = value > most
            cause = f"the requirement is missed: {_with_unit(most, unit)}, {required.why}" if missed else ""
            effect = over_100_m if missed and unit == "per mille" else ""
            out.append(Evidence(name, value, unit, GRADES[int(missed)], cause, fix if missed else "", effect))
    return out


def _connection(
    adjusted: Adjusted, parts: Sequence[Sequence[int]], land: Mapping[int, float], local_m: float
) -> dict[str, float]:
    """Shares of the mosaic's land that frames give which hang on their own positions, or in another part than
    most. A part doesn't count if its place and that of most are known better than land may lie off relative
    to other land, as by RTK positions or control points."""
    tied = {i: share for i, share in land.items() if adjusted.status[i] == "tied"}
    shares = [sum(tied.get(i, 0.0) for i in part) for part in parts]
    apart = sum(tied.values()) - max(shares, default=0.0)
    if len(parts) > 1:
        off_m = np.linalg.norm(adjusted.poses.positions_sd_m[:, :2], axis=1)
        well = [bool(np.median(off_m[list(part)]) <= local_m) for part in parts]
        main = int(np.argmax(shares))
        apart -= sum(s for k, s in enumerate(shares) if k != main and well[k] and well[main])
    alone = sum(share for i, share in land.items() if i not in tied)
    return {"frames not tied": alone, "frames in other parts": max(apart, 0.0)}


def _left_out(adjusted: Adjusted, parts: Sequence[Sequence[int]]) -> float:
    """The share of the frames that have no place, since they are in none but the largest part."""
    largest = {*max(parts, key=len, default=())}
    lost = [i for i, status in enumerate(adjusted.status) if status == "rejected" and i not in largest]
    return len(lost) / max(len(adjusted.status), 1)


def _land(doubt: LandDoubt) -> dict[str, float]:
    """Shares of the land that have to be expected off by more than is asked, as far as they are known."""
    shares = zip(OF_LAND, (doubt.ground_share, doubt.rim_share, doubt.surface_share), strict=True)
    return {name: share for name, share in shares if np.isfinite(share)}


def _agreement(adjusted: Adjusted, patterns: tuple[ResidualPattern, ...]) -> dict[str, float]:
    """How far images, camera and control agree in the adjustment, as far as the method says."""
    names = {"image deviation": "sigma_px", "shape": "shape_sd_px", "tilts": "sigma_tilt"}
    found = {name: adjusted.figures[of] for name, of in names.items() if of in adjusted.figures}
    if adjusted.shared is not None:
        found["principal point"] = _principal_point_off(adjusted)
    if patterns:
        found["pattern of residuals"] = max(p.systematic_px for p in patterns)
    if adjusted.image_residuals is not None and len(adjusted.image_residuals.weight):
        disregarded = adjusted.image_residuals.weight < _DISREGARDED
        found["tie points disregarded"] = float(disregarded.mean())
    found |= _control(adjusted.control)
    return found


def _control(points: Sequence[ControlResidual]) -> dict[str, float]:
    """Control points by what none of as many exceeds by chance; the shift of check points in common by its
    stated deviation; and how many points contradict the others."""
    found = {}
    used, figures = [p for p in points if not p.check], check_points(points)
    wrong = control_blunders(used)
    if points:
        found["blunders"] = float(wrong.sum() + (0 if figures is None else len(figures.blunders)))
    good = [p for p, its in zip(used, wrong, strict=True) if not its]
    known = np.concatenate([np.abs(p.residual_m / p.sd_m) for p in good]) if good else np.zeros(0)
    known = known[np.isfinite(known)]
    if known.size:
        found["control points"] = float(known.max() / -ndtri(ndtr(-THREE_SIGMA) / known.size))
    if figures is not None and figures.count >= LEAST_POINTS:
        sd_m = np.median([p.sd_m for p in points if p.check], axis=0)
        found["check points"] = float(np.abs(figures.mean_shift_m / sd_m)[:2].max())
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
    """The median mismatch and the worst tenth. A map is not called bad by a median that so few places may
    show by chance. Its lower limit of 95 % must be bad, too (David and Nagaraja 2003, Order Statistics,
    section 7.1)."""
    length = np.sort(seams.length_px[np.isfinite(seams.length_px)])
    if not length.size:
        return {}
    median, bad = float(np.median(length)), CRITERIA["seams"].bad
    below = bdtr(np.arange(length.size + 1), length.size, 0.5)
    lower = int(np.searchsorted(below, _CHANCE, side="right")) - 1
    limited = lower >= 0 or 2 * length.size > len(seams.length_px)  # fewer than five of many have no limit
    surely = length[max(lower, 0)] if limited else 0.0
    return {
        "seams": median if surely > bad else min(median, bad),
        "worst tenth of the seams": float(np.quantile(length, 0.9)),
    }


def _text(adjusted: Adjusted, figures: Mapping[str, float], asked: str) -> str:
    """How many frames are tied, how well they agree, and how much land the surface leaves open."""
    words = [f"{adjusted.status.count('tied')} of {len(adjusted.status)} frames tied"]
    words += [f"{name} {figures[name]:.2f} px" for name in ("image deviation", "seams") if name in figures]
    for name, where in (
        ("surface unsure", ""),
        ("ground unknown", ", between tie points,"),
        ("rim", ", at the rim,"),
    ):
        share = figures.get(name, 0.0)
        words += [f"{_percent(share)} of the land{where} may be off by more than {asked}"] * (
            share >= _WORTH_A_WORD
        )
    return ", ".join(words)


def _percent(share: float) -> str:
    return f"{100.0 * share:.0f} %"
