"""Control and check points: how far they lie from where the images put them, blunders and a common shift."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from geomosaic.adjustment.model import ControlResidual, GroundControl
from geomosaic.adjustment.terms.point_coordinates import precision_figures
from geomosaic.adjustment.terms.term import Components
from geomosaic.arrays import Bools, Floats
from geomosaic.constants import sourced
from geomosaic.estimation.robust import FAR, LEAST_OBSERVATIONS, THREE_SIGMA, blunders
from geomosaic.survey.accuracy import POSITION
from geomosaic.survey.model import Warn
from geomosaic.survey.names import some

_COARSER = sourced(1.5, "stated deviations", "beyond: a warning", "F test at 1 %, 12 degrees: 1.48")
_AXES = ("east", "north", "up")
_DISAGREE: Final = {"control": "control-disagrees", "check": "check-disagrees"}
_SHIFT: Final = {"control": "control-shifted", "check": "check-shifted"}


@dataclass(frozen=True)
class ControlFigures:
    """Of n points. rmse_horizontal_m is of the length in the plane. ce90_m and le90_m: nine tenths of the
    points are nearer in the plane and in height. They are quantiles of what was found (linear between two
    points; no normal distribution assumed), so with few points little less than the largest. Figures of
    heights are of the n_height points whose height was surveyed, None without any.
    """

    n: int
    n_height: int
    rmse_east_m: float
    rmse_north_m: float
    rmse_up_m: float | None
    rmse_horizontal_m: float
    ce90_m: float
    le90_m: float | None


def control_figures(residuals: Sequence[ControlResidual]) -> ControlFigures:
    """Figures of one point or more."""
    residual_m = known_residuals_m(residuals)
    east, north = np.sqrt(np.mean(np.square(residual_m[:, :2]), axis=0)).tolist()
    up_m = residual_m[np.isfinite(residual_m[:, 2]), 2]
    return ControlFigures(
        n=len(residual_m),
        n_height=len(up_m),
        rmse_east_m=east,
        rmse_north_m=north,
        rmse_up_m=float(np.sqrt(np.mean(up_m**2))) if up_m.size else None,
        rmse_horizontal_m=float(np.hypot(east, north)),
        ce90_m=float(np.quantile(np.hypot(residual_m[:, 0], residual_m[:, 1]), 0.9)),
        le90_m=float(np.quantile(np.abs(up_m), 0.9)) if up_m.size else None,
    )


def known_residuals_m(points: Sequence[ControlResidual]) -> Floats:
    """Residuals (n, 3) east, north and up, surveyed minus found; NaN for a height that was not surveyed."""
    residual_m = np.array([p.residual_m for p in points]).reshape(-1, 3)
    sd_m = np.array([p.sd_m for p in points]).reshape(-1, 3)
    residual_m[~(sd_m[:, 2] < POSITION["none"].sd_vertical_m), 2] = np.nan
    return residual_m


def means(values: Floats) -> Floats:
    """Means (c,) of the finite values of each column (n, c); NaN for a column without any."""
    finite = np.isfinite(values)
    count = finite.sum(axis=0)
    total = np.where(finite, values, 0.0).sum(axis=0)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def control_blunders(points: Sequence[ControlResidual]) -> Bools:
    """Which of n points of one kind are blunders against the others, see `estimation.robust.blunders`. A
    vector that all have in common is the map's shift, not a blunder. Deviations that all share do not
    count."""
    found = np.zeros(len(points), dtype=bool)
    residual_m = known_residuals_m(points)
    sds_m = np.array([(p.sd_m, p.common_sd_m, p.surveyed_sd_m) for p in points]).reshape(-1, 3, 3)
    for axis in range(3):
        known = np.flatnonzero(np.isfinite(residual_m[:, axis]))
        sd_m, common_m, surveyed_m = sds_m[known, :, axis].T
        own_m = np.sqrt(np.maximum(sd_m**2 - common_m**2, surveyed_m**2))
        found[known] |= blunders(residual_m[known, axis], own_m)
    return found


def precision_warnings(control: Sequence[GroundControl], figures: Mapping[str, float]) -> list[Warn]:
    """One line where control is less precise than stated, by the figures of `Adjusted`."""
    stated = precision_figures(control, Components())
    words = [
        f"{figures[name]:.2g} m in {name.rpartition('.')[2]} (stated {stated[name]:.2g} m)"
        for name in stated
        if figures.get(name, 0.0) > _COARSER * stated[name]
    ]
    if not words:
        return []
    text = (
        f"control points agree to {' and '.join(words)}: weighted by that; the map is no better than they "
        "are: measure them again if it has to be"
    )
    return [Warn("control-imprecise", "", text)]


def control_warnings(residuals: Sequence[ControlResidual]) -> list[Warn]:
    """One line for each blunder. For the others there is one line for a common shift beyond three stated
    deviations. Another one is for all points that disagree by more than five of theirs."""
    out = []
    for kind, check in (("control", False), ("check", True)):
        points = [r for r in residuals if r.check == check]
        out += _warnings_of(kind, points) if points else []
    return out


def _warnings_of(kind: str, points: Sequence[ControlResidual]) -> list[Warn]:
    wrong, off_m = control_blunders(points), known_residuals_m(points)
    if len(points) < LEAST_OBSERVATIONS or wrong.all():
        return _far(kind, points, off_m)
    rest = [p for p, its in zip(points, wrong, strict=True) if not its]
    shift_m = means(off_m[~wrong])
    scatter_m = float(np.sqrt(np.nansum(means((off_m[~wrong] - shift_m) ** 2))))
    named = [(p.name, away_m) for p, away_m, its in zip(points, off_m - shift_m, wrong, strict=True) if its]
    blunder_lines = [
        f"{kind} point '{name}' lies {_length(away_m):.2f} m from where the images and the other {len(rest)} "
        f"{kind} points put it ({_vector(away_m)}), these scatter by {scatter_m:.2f} m; "
        "check its coordinates and its marks in the images"
        for name, away_m in named
    ]
    return [
        *(Warn(_DISAGREE[kind], "", text) for text in blunder_lines),
        *_shifted(kind, rest, shift_m, scatter_m),
        *_far(kind, rest, off_m[~wrong] - shift_m),
    ]


def _shifted(kind: str, points: Sequence[ControlResidual], shift_m: Floats, scatter_m: float) -> list[Warn]:
    """A line for a common shift (3,) beyond three stated deviations."""
    known = np.isfinite(known_residuals_m(points))
    sd_m = np.where(known, [p.sd_m for p in points], np.nan)
    stated_m = np.array([np.median(c[np.isfinite(c)]) if np.isfinite(c).any() else np.nan for c in sd_m.T])
    ratio = float(np.nanmax(np.abs(shift_m) / stated_m))
    if not ratio > THREE_SIGMA:
        return []
    text = (
        f"{len(points)} {kind} points lie off the map by one shift ({_vector(shift_m)}), {ratio:.1f} of its "
        f"stated deviations, and scatter by {scatter_m:.2f} m about it; check the datum and height system of "
        f"the positions and of these points{', or use them as control' if kind == 'check' else ''}"
    )
    return [Warn(_SHIFT[kind], "", text)]


def _far(kind: str, points: Sequence[ControlResidual], off_m: Floats) -> list[Warn]:
    """One line for all points that lie more than five of their deviations off, (n, 3)."""
    share = np.nan_to_num(np.abs(off_m) / np.array([p.sd_m for p in points])).max(axis=1)
    far = [(p.name, at) for p, at, s in zip(points, off_m, share, strict=True) if s > FAR]
    if not far:
        return []
    few = len(points) < LEAST_OBSERVATIONS
    names = "" if few and len(points) > 1 else f" ({some(name for name, _ in far)})"
    worst_m = max((at for _, at in far), key=_length)
    text = (
        f"{len(far)} of {len(points)} {kind} points{names} disagree with the images by more than "
        f"{FAR:g} deviations, the farthest by {_length(worst_m):.2f} m ({_vector(worst_m)})"
        f"{f'; fewer than {LEAST_OBSERVATIONS} points do not show which is wrong' if few else ''}; "
        "check their coordinates and their marks in the images"
    )
    return [Warn(_DISAGREE[kind], "", text)]


def _length(off_m: Floats) -> float:
    return float(np.sqrt(np.nansum(off_m**2)))


def _vector(off_m: Floats) -> str:
    """What is known of east, north and up."""
    return ", ".join(f"{v:+.2f} {axis}" for v, axis in zip(off_m, _AXES, strict=True) if np.isfinite(v))
