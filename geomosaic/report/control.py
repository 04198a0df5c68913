"""Control and check points in the report: figures of each kind, tables, and the points on the map."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from geomosaic.adjustment.model import Adjusted, ControlResidual
from geomosaic.arrays import Bools, Floats
from geomosaic.export.on_map import map_from_work
from geomosaic.quality.accuracy import metres
from geomosaic.quality.control import control_blunders, control_figures, known_residuals_m
from geomosaic.report.numbers import UNKNOWN, cm, signed_cm
from geomosaic.survey.model import Survey

_MOST: Final = 500
"""Points of a kind on the map."""
CHECK_POINTS: Final = "Check points"
KINDS: Final = (("check", CHECK_POINTS, True), ("control", "Control points", False))
"""Of points: layer, title, whether they took no part in the adjustment."""


@dataclass(frozen=True)
class PointFigures:
    """Figures of one kind of points, in m, those of `blunders` left out; NaN for heights without any surveyed
    one. used: their number; plan_only: how many of them have no surveyed height; ce90_m, le90_m: quantiles of
    what was found."""

    title: str
    points: tuple[ControlResidual, ...]
    blunders: tuple[str, ...]
    used: int
    plan_only: int
    rmse_m: Floats
    ce90_m: float
    le90_m: float

    @property
    def rmse_h_m(self) -> float:
        """Of the length in plan."""
        return float(np.hypot(*self.rmse_m[:2]))

    @property
    def rmse_v_m(self) -> float:
        """Of the height."""
        return float(self.rmse_m[2])

    def residual(self, point: ControlResidual) -> Floats:
        """Of one of the points, surveyed minus found (3,); NaN for a height that was not surveyed."""
        return np.asarray(known_residuals_m([point])[0])

    def deviation(self, point: ControlResidual) -> Floats:
        """Of that residual (3,), in m."""
        return np.asarray(np.where(np.isfinite(self.residual(point)), point.sd_m, np.nan))

    @property
    def count(self) -> str:
        """How many there are, and how many of them count."""
        number = len(self.points)
        return f"{number}" if self.used == number else f"{self.used} of {number}"

    @property
    def row(self) -> tuple[str, str, str, str, str]:
        """On the first screen: kind, number, RMSE horizontally and vertically, blunders."""
        named = ", ".join(self.blunders[:3]) + f" and {len(self.blunders) - 3} more" * (
            len(self.blunders) > 3
        )
        return self.title, self.count, _metres(self.rmse_h_m), _metres(self.rmse_v_m), named or "none"


def point_figures(adjusted: Adjusted) -> list[PointFigures]:
    """Check points, then control points; a kind without any is left out."""
    found = []
    for _, title, check in KINDS:
        points = sorted(
            (c for c in adjusted.control if c.check == check),
            key=lambda c: -float(np.linalg.norm(c.residual_m)),
        )
        if points:
            found.append(_figures(title, points))
    return found


def _figures(title: str, points: Sequence[ControlResidual]) -> PointFigures:
    wrong = control_blunders(points)
    good = [p for p, its in zip(points, wrong, strict=True) if not its]
    blunders = tuple(p.name for p, its in zip(points, wrong, strict=True) if its)
    if not good:
        nan = float("nan")
        return PointFigures(title, tuple(points), blunders, 0, 0, np.full(3, nan), nan, nan)
    of = control_figures(good)
    return PointFigures(
        title=title,
        points=tuple(points),
        blunders=blunders,
        used=of.n,
        plan_only=of.n - of.n_height,
        rmse_m=np.array([of.rmse_east_m, of.rmse_north_m, of.rmse_up_m], dtype=np.float64),
        ce90_m=of.ce90_m,
        le90_m=float("nan") if of.le90_m is None else of.le90_m,
    )


def _metres(length_m: float) -> str:
    return metres(length_m) if np.isfinite(length_m) else UNKNOWN


@dataclass(frozen=True)
class MappedPoints:
    """Points of one kind on the map: where the map shows them, and the way to where they were surveyed, both
    (n, 2) in m of the map; labels: name and residual; blunders (n,); number: how many there are, of which
    those farthest off are here."""

    layer: str
    title: str
    names: tuple[str, ...]
    at_m: Floats
    residual_m: Floats
    labels: tuple[str, ...]
    blunders: Bools
    number: int


def mapped_points(survey: Survey, figures: Sequence[PointFigures]) -> list[MappedPoints]:
    """The points of the report's map, of each kind the largest residual first."""
    surveyed = {p.name: (p.lon_deg, p.lat_deg, p.height_ellipsoidal_m) for p in survey.control}
    layers = {title: layer for layer, title, _ in KINDS}
    found = []
    for f in figures:
        known = [p for p in f.points if p.name in surveyed and np.isfinite(p.residual_m).all()]
        points = known[:_MOST]
        if not points:
            continue
        place = np.array([surveyed[p.name] for p in points])
        there = survey.work_frame.enu_from_geodetic(*place.T)
        at_m = map_from_work(survey, there - np.array([p.residual_m for p in points]))
        wrong = [p.name in f.blunders for p in points]
        found.append(
            MappedPoints(
                layers[f.title],
                f.title,
                tuple(p.name for p in points),
                at_m,
                map_from_work(survey, there) - at_m,
                tuple(_label(f.title, p, its) for p, its in zip(points, wrong, strict=True)),
                np.array(wrong),
                len(known),
            )
        )
    return found


def _label(title: str, point: ControlResidual, blunder: bool) -> str:
    (east, north, _), up = point.residual_m, known_residuals_m([point])[0, 2]
    lines = [
        f"{title.removesuffix('s')} {point.name}",
        f"{cm(float(np.hypot(east, north)))} in plan:",
        f"{signed_cm(east)} east, {signed_cm(north)} north",
        f"{signed_cm(up)} up" if np.isfinite(up) else "no surveyed height",
    ]
    return "\n".join([*lines, *["blunder: left out of the figures"] * blunder])
