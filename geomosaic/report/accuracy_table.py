"""The accuracy table of the report's first screen: seams, distances within the map, places on it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from geomosaic.quality.accuracy import AbsoluteAccuracy, Accuracy, RelativeAccuracy, Requirement, metres
from geomosaic.quality.seam_check import SeamCheck
from geomosaic.quality.statement import NO_ABSOLUTE, NO_RELATIVE, UNDETERMINED
from geomosaic.report.numbers import UNKNOWN

_OVER_M = 100.0
"""Length of the distances of `RelativeAccuracy.rmse_100m_m`."""


@dataclass(frozen=True)
class AccuracyRow:
    """question: what it answers, of the first row of a group; usual, most: a typical and a large value, with
    the measure's name; required: what is asked; missed: it is not met."""

    question: str
    figure: str
    usual: str
    most: str = ""
    required: str = ""
    missed: bool = False

    @property
    def unstated(self) -> bool:
        """Whether the figure says only why there is none."""
        return self.usual == UNKNOWN


@dataclass(frozen=True)
class AccuracyTable:
    """rows; notes: how places were measured, whose the requirement is."""

    rows: list[AccuracyRow]
    notes: list[str]


def accuracy_table(
    accuracy: Accuracy, required: Requirement, seams: SeamCheck, pixel_m: float
) -> AccuracyTable:
    """The three questions in their order: does it hold together, relative accuracy, absolute accuracy."""
    rows = [_seams(seams), *_distances(accuracy.relative, required, pixel_m)]
    return AccuracyTable([*rows, *_places(accuracy.absolute, required)], _notes(accuracy.absolute, required))


def _seams(seams: SeamCheck) -> AccuracyRow:
    length = seams.length_px[np.isfinite(seams.length_px)]
    if not length.size:
        return AccuracyRow("Seams", "none could be measured", UNKNOWN)
    median, most = np.quantile(length, [0.5, 0.95])
    places = f"at {length.size} of {len(seams.left)} places"
    return AccuracyRow("Seams", places, f"median {median:.2f} px", f"95 % {most:.2f} px")


def _distances(relative: RelativeAccuracy, required: Requirement, pixel_m: float) -> list[AccuracyRow]:
    title = "Relative"
    if not math.isfinite(relative.scale_permille):
        return [AccuracyRow(title, NO_RELATIVE, UNKNOWN)]
    if relative.undetermined:
        return [AccuracyRow(title, f"distances {UNDETERMINED}", UNKNOWN)]
    rows: list[AccuracyRow] = []
    for rmse_m, length_m in ((relative.rmse_100m_m, _OVER_M), (relative.rmse_whole_m, relative.whole_m)):
        if math.isfinite(rmse_m) and (required.scaled or length_m is relative.whole_m):
            asked_m = required.permille * length_m / 1000.0
            words = "RMSE " + f"{metres(rmse_m)}, " * required.scaled + f"{rmse_m / pixel_m:.2f} px"
            whole = "distances over the whole map, once it is scaled"
            over = f"distances over {length_m:.0f} m" if required.scaled else whole
            rows.append(AccuracyRow("" if rows else title, over, words, "", *_required(rmse_m, asked_m)))
    scale = f"±\u202f{relative.scale_permille:.2f} ‰" if required.scaled else UNKNOWN
    named = "scale of the map" if required.scaled else "scale of the map: not known"
    return [*rows, AccuracyRow("" if rows else title, named, scale)]


def _places(absolute: AbsoluteAccuracy, required: Requirement) -> list[AccuracyRow]:
    title = "Absolute"
    if not math.isfinite(absolute.rmse_h_m):
        return [AccuracyRow(title, NO_ABSOLUTE, UNKNOWN)]
    of_plan = f"RMSE {metres(absolute.rmse_h_m)}", f"CE90 {metres(absolute.ce90_m)}"
    up = f"vertical, {absolute.how}", f"RMSE {metres(absolute.rmse_v_m)}", f"LE90 {metres(absolute.le90_m)}"
    if absolute.without_datum:
        up = "vertical: not known, heights may count from the take-off", UNKNOWN, ""
    figures = (
        (title, absolute.rmse_h_m, (f"horizontal, {absolute.how}", *of_plan), required.rmse_h_m),
        ("", absolute.rmse_v_m, up, required.rmse_v_m),
    )
    return [
        AccuracyRow(group, *words, *_required(rmse_m, asked_m))
        for group, rmse_m, words, asked_m in figures
        if math.isfinite(rmse_m)
    ]


def _required(value_m: float, most_m: float) -> tuple[str, bool]:
    if not math.isfinite(most_m):
        return "", False
    missed = value_m > most_m
    return f"{metres(most_m)}, {'missed' if missed else 'met'}", missed


def _notes(absolute: AbsoluteAccuracy, required: Requirement) -> list[str]:
    how = "Absolute accuracy is estimated from the covariance: no three check points measure it."
    if absolute.check_points:
        east, north, up = (_signed(v) for v in absolute.shift_m)
        upwards = f", {up} up" if math.isfinite(absolute.shift_m[2]) else ""
        how = (
            f"Absolute accuracy is measured at {absolute.check_points} check points: mean shift of the map "
            f"{east} east, {north} north{upwards}; "
            f"scatter {metres(float(np.hypot(*absolute.scatter_m[:2])))} in plan."
        )
    asked = [required.rmse_h_m, required.rmse_v_m, required.permille]
    what = "Required" if np.isfinite(asked).any() else "Nothing is required"
    stated = [how] if math.isfinite(absolute.rmse_h_m) else []
    return [*stated, f"{what}: {required.why}."]


def _signed(length_m: float) -> str:
    words = metres(abs(length_m))
    return words if words == "0.0 cm" else f"{'+' if length_m > 0.0 else '-'}{words}"
