"""Whether a mosaic can be trusted: good, doubtful or bad, for what reason, and what would fix it."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from geomosaic.adjustment.model import Adjusted
from geomosaic.adjustment.procedure.residual_pattern import ResidualPattern
from geomosaic.constants import tuned
from geomosaic.quality.accuracy import Accuracy, Requirement, metres
from geomosaic.quality.criteria import (
    ASKED,
    CRITERIA,
    FIRST,
    GRADES,
    HOUSES,
    JUMPS,
    MATCHED_SEAMS,
    NOTED,
    TRIM_FIXES,
    TRIMMED,
    WHY,
)
from geomosaic.quality.ground_doubt import LandDoubt
from geomosaic.quality.mapped_land import NOT_TRIMMED, LeftOutLand
from geomosaic.quality.seam_check import SeamCheck
from geomosaic.quality.verdict_figures import (
    OF_LAND,
    agreement,
    connection,
    land_off,
    left_out,
    seam_mismatch,
)
from geomosaic.quality.warned import WARNED
from geomosaic.survey.names import some

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
    matched; warned: codes of the run's warnings; names of the frames; pixel_m: the mosaic's; trimmed: the
    share of the frames' land that is left out."""

    seams: SeamCheck
    patterns: tuple[ResidualPattern, ...]
    parts: Sequence[Sequence[int]]
    land: Mapping[int, float]
    doubt: LandDoubt
    warned: Collection[str] = ()
    names: Sequence[str] = ()
    pixel_m: float = float("nan")
    trimmed: LeftOutLand = NOT_TRIMMED


def verdict_of(adjusted: Adjusted, seen: VerdictInputs, accuracy: Accuracy, required: Requirement) -> Verdict:
    """Grades a mosaic: whether a fault was found, and whether it is as accurate as is required."""
    figures = agreement(adjusted, seen.patterns) | seam_mismatch(seen.seams)
    figures |= connection(adjusted, seen.parts, seen.land, required.local_m)
    figures |= land_off(seen.doubt)
    if np.isfinite(seen.trimmed.share):
        figures[TRIMMED] = seen.trimmed.share
    warned = {w.code for w in adjusted.warnings} | {*seen.warned}
    if "not-placed" in warned:
        figures["frames left out"] = left_out(adjusted, seen.parts)
    judged = [_judged(name, value, required, seen) for name, value in figures.items()]
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
    elif of.name == TRIMMED:
        said.append("layer trimmed of layers.gpkg shows where")
    elif of.name in OF_LAND:
        said.append("accuracy.tif shows where")
    elif of.name == "control points":
        off = {p.name: np.nanmax(np.abs(p.residual_m / p.sd_m)) for p in adjusted.control if not p.check}
        said.append(f"most at {max(off, key=lambda name: off[name])}")
    return ", ".join(said)


def _judged(name: str, value: float, required: Requirement, seen: VerdictInputs) -> Evidence:
    criterion, asked = CRITERIA[name], required.length(required.local_m, seen.pixel_m)
    grade = criterion.grade(value, required.local_m / seen.pixel_m)
    if grade == GRADES[0]:
        return Evidence(name, value, criterion.unit, grade)
    cause, fix = criterion.cause.replace(ASKED, asked), criterion.fix
    if name == TRIMMED:
        cause, fix = cause.replace(WHY, seen.trimmed.reason), TRIM_FIXES.get(seen.trimmed.reason, fix)
    elif name in JUMPS and np.isfinite(seen.doubt.surface_share):
        fix = MATCHED_SEAMS
    return Evidence(name, value, criterion.unit, grade, cause, fix)


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
