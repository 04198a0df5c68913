"""Which control and check points can be used: those with marks inside images of the survey."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from geomosaic.arrays import Floats
from geomosaic.constants import FEW
from geomosaic.errors import InputError
from geomosaic.survey.control import LEAST_POINTS, ControlFile
from geomosaic.survey.model import ControlPoint, Warn
from geomosaic.survey.names import some
from geomosaic.survey.places import away_from

_LEANS: Final = (
    "no frame has a position, and two control points leave open how the block leans about the line "
    "through them: add a third point off that line"
)


@dataclass(frozen=True)
class _Outside:
    """The image mark of a point outside its image, and that image's size."""

    point: str
    frame: str
    at_px: tuple[float, float]
    size_px: tuple[int, int]

    def __str__(self) -> str:
        (col, row), (width, height) = self.at_px, self.size_px
        return f"of point '{self.point}' at {col:g}, {row:g} in {self.frame} ({width} x {height} pixels)"


def check_marks(file: ControlFile) -> None:
    """`InputError` where no point has a mark in a frame that the file was read for."""
    reason = _without_marks(file)
    if reason is not None:
        raise _error(file, reason)


def used_control(
    file: ControlFile, lonlat: Floats, sizes_px: Mapping[str, tuple[int, int]], *, optional: bool
) -> tuple[tuple[ControlPoint, ...], list[Warn]]:
    """The file's points with their marks inside images, and what was assumed or is not used.

    No points where none can be used and control is optional.

    Args: lonlat: (n, 2) of the frames whose position is known; sizes_px: width and height of each frame by
        name; optional: a file of which no point can be used is a warning.
    Raises: `InputError` that says why no point can be used.
    """
    points, outside = _inside(file, sizes_px)
    reason = _without_marks(file) or _marks_of_others(points, outside) or _unplaced(points, lonlat)
    if reason is None:
        unused = [*_unused_marks(file, points, outside), *_unused_points(file, points)]
        leans = not len(lonlat) and len(lonlat_of_control(points)) == LEAST_POINTS
        return points, [*file.notes, *unused, *([Warn("control-few", "", _LEANS)] if leans else [])]
    if not optional:
        raise _error(file, reason)
    text = f"{file.path.name}: {reason.problem}; the map is made without these points; {reason.fix}"
    return (), [Warn("control-unused", "", text)]


def lonlat_of_control(points: Sequence[ControlPoint]) -> Floats:
    """Longitudes and latitudes (n, 2) of the points that can stand in for the positions of all frames."""
    return np.array([[p.lon_deg, p.lat_deg] for p in points if p.images and not p.check]).reshape(-1, 2)


def _error(file: ControlFile, reason: InputError) -> InputError:
    fix = f"{reason.fix}, or add --gcp-optional to go on without control points"
    return InputError(reason.problem, file=file.path, fix=fix)


def _inside(
    file: ControlFile, sizes_px: Mapping[str, tuple[int, int]]
) -> tuple[tuple[ControlPoint, ...], list[_Outside]]:
    """The points with their marks inside images, and the other marks."""
    points, outside = [], []
    for point in file.points:
        kept = []
        for frame, col, row in point.images:
            width, height = sizes_px[frame]
            if 0.0 <= col <= width and 0.0 <= row <= height:
                kept.append((frame, col, row))
            else:
                outside.append(_Outside(point.name, frame, (col, row), (width, height)))
        points.append(replace(point, images=tuple(kept)))
    return tuple(points), outside


def _without_marks(file: ControlFile) -> InputError | None:
    count = len(file.points)
    if any(p.images for p in file.points):
        return None
    if not file.absent:
        return InputError(
            f"none of its {count} points has an image mark, so none can be found in the images",
            fix="mark them with geomosaic control, or give image, col and row in the --gcp file",
        )
    return InputError(
        f"all {len(file.absent)} image marks of its {count} points are in images that are not in the survey "
        f"({some(dict.fromkeys(image for _, image in file.absent))})",
        fix="give the folder of these images, or the frames' names in the --gcp file",
    )


def _marks_of_others(points: Sequence[ControlPoint], outside: Sequence[_Outside]) -> InputError | None:
    """Of marks that were measured in other images than these, such as larger ones."""
    marks = len(outside) + sum(len(p.images) for p in points)
    if len(outside) <= FEW * marks:
        return None
    return InputError(
        f"{len(outside)} of {marks} image marks lie outside their images, the first {outside[0]}",
        fix="correct or remove them in the --gcp file "
        "(pixels of the frames as they were taken, columns first)",
    )


def _unplaced(points: Sequence[ControlPoint], lonlat: Floats) -> InputError | None:
    """Of points far from all frames, or too few to stand in for the frames' positions."""
    used = [p for p in points if p.images]
    if not len(lonlat):
        control = len(lonlat_of_control(points))
        if control >= LEAST_POINTS:
            return None
        return InputError(
            f"no frame has a position, and {control or 'no'} control point{'s'[: control != 1]} "
            f"{'is' if control == 1 else 'are'} measured in the images: they can't be put on a map",
            fix=f"measure at least {LEAST_POINTS} control points (3 for heights)",
        )
    away_m, reach_m = away_from(lonlat, np.array([[p.lon_deg, p.lat_deg] for p in used]))
    i = int(np.argmin(away_m))
    if away_m[i] <= reach_m:
        return None
    return InputError(
        f"all {len(used)} points with image marks lie far from the frames, the nearest, '{used[i].name}', "
        f"{away_m[i] / 1000.0:.1f} km from their middle",
        fix="check the coordinate reference system and the order of the columns in the --gcp file",
    )


def _unused_marks(
    file: ControlFile, points: Sequence[ControlPoint], outside: Sequence[_Outside]
) -> list[Warn]:
    """A line for all marks in images that are not in the survey, and one for all outside their images."""
    marks = len(file.absent) + len(outside) + sum(len(p.images) for p in points)
    of, out = f"of {marks} image marks", []
    if file.absent:
        images = some(dict.fromkeys(image for _, image in file.absent))
        text = f"{len(file.absent)} {of} are in images that are not in the survey ({images}) and "
        text += "are not used: give the folder of those images, or remove the marks"
        out.append(Warn("control-image-missing", "", f"{file.path.name}: {text}"))
    if outside:
        text = (
            f"{len(outside)} {of} lie outside their images and are not used, the first {outside[0]}; correct "
        )
        text += "or remove them"
        out.append(Warn("control-mark-outside", "", f"{file.path.name}: {text}"))
    return out


def _unused_points(file: ControlFile, points: Sequence[ControlPoint]) -> list[Warn]:
    """One line for all points that are not used."""
    unused = [p.name for p in points if not p.images]
    if not unused:
        return []
    absent, marked = {name for name, _ in file.absent}, {p.name for p in file.points if p.images}
    why = Counter(
        "marked only outside the images" if name in marked
        else "marked only in images that are not in the survey" if name in absent
        else "without an image mark"
        for name in unused
    )  # fmt: skip
    reasons = ", ".join(f"{count} {reason}" for reason, count in why.items())
    text = f"{file.path.name}: {len(unused)} of {len(points)} points are not used ({some(unused)}): {reasons}"
    if not any(p.images and not p.check for p in points) and not all(p.check for p in points):
        text += "; only check points are left, so that none corrects the map"
    text += "; mark them with geomosaic control if they matter"
    return [Warn("control-points-unused", "", text)]
