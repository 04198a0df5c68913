"""A POS file's positions compared to those in the frames' tags: mistaken columns, signs, units and order."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from geomosaic.arrays import Floats
from geomosaic.constants import sourced, tuned
from geomosaic.errors import InputError
from geomosaic.estimation.robust import THREE_SIGMA
from geomosaic.geodesy.ellipsoid import mid_latitude_offset_m
from geomosaic.geodesy.heights import LENGTHS_M
from geomosaic.survey.extent import distances_m
from geomosaic.survey.model import Position, Warn
from geomosaic.survey.pos_row import PosFile, PosRow

_FAR_M = tuned(1000.0, "m", "from the frames' GPS, warns: GPS is off by tens, other data by hundreds")
_DATUMS_M = sourced(107.0, "m", "between heights of two datums", "EGM2008: undulations of -107 to 86 m")


def against_tags(
    names: Sequence[str], own: Sequence[Position | None], rows: Sequence[PosRow | None], pos: PosFile
) -> list[Warn]:
    """What the tags of the frames contradict in a POS file.

    Args: of each frame, in order: its name, the position in its tags, its row of the file.
    Raises: `InputError` where columns are exchanged or a sign is lost.
    """
    every = zip(rows, own, names, strict=True)
    both = [(r, p, name) for r, p, name in every if r is not None and p is not None]
    if not both:
        return []
    given = np.array([[r.lon_deg, r.lat_deg] for r, _, _ in both])
    known = np.array([[p.lon_deg, p.lat_deg] for _, p, _ in both])
    sd_m = float(np.median([max(p.sd_east_m, p.sd_north_m) for _, p, _ in both]))
    found = _elsewhere(given, known, [name for _, _, name in both], pos)
    found = found or _in_other_order(given, known, sd_m)
    heights = _as_feet([(r, p) for r, p, _ in both])
    return [Warn(code, frame, f"{pos.path.name}: {text}") for code, frame, text in (*found, *heights)]


def _elsewhere(
    given: Floats, known: Floats, names: Sequence[str], pos: PosFile
) -> list[tuple[str, str, str]]:
    """Swapped columns, lost signs, and positions far from where the frames say they were."""
    away = distances_m(given, known)
    if np.median(away) > _FAR_M:
        for problem, fix, other in _mistaken(given):
            if np.median(distances_m(other, known)) < _FAR_M:
                said = f"the frames' own GPS says {known[0, 0]:.5f}, {known[0, 1]:.5f} for {names[0]}"
                raise InputError(f"{problem}: {said}", file=pos.path, fix=fix)
        text = f"its positions lie {np.median(away) / 1000.0:.1f} km from those in the frames' tags: "
        return [("positions-elsewhere", "", text + "check columns and CRS of the file")]
    i = int(np.argmax(away))
    if away[i] <= _FAR_M:
        return []
    text = f"up to {away[i] / 1000.0:.1f} km from the positions in the frames' tags: check columns and CRS "
    return [("pos-far-from-exif", names[i], text + "of the file")]


def _mistaken(given: Floats) -> Iterator[tuple[str, str, Floats]]:
    """What may be wrong with longitudes and latitudes (n, 2), how it is corrected, and what they are then."""
    if (np.abs(given[:, 0]) <= 90.0).all():
        fix = "exchange the two columns or their names"
        yield "longitude and latitude are swapped", fix, given[:, ::-1]
    for name, sign in (("longitudes", [-1.0, 1.0]), ("latitudes", [1.0, -1.0])):
        yield f"the {name} have the wrong sign", "west and south are negative", given * sign


def _in_other_order(given: Floats, known: Floats, sd_m: float) -> list[tuple[str, str, str]]:
    """Positions that fit those in the tags only in reverse order or as those of neighbouring frames.
    Positions that lie no nearer to their frames' tags than to the middle of all tags are found as well."""
    if len(given) < 3:  # of two, one wrong position looks like an order
        return []
    as_given_m = float(np.median(distances_m(given, known)))
    if as_given_m <= sd_m:
        return []
    orders = (
        ("in reverse order", given[::-1], known),
        ("as those of the frames before", given[1:], known[:-1]),
        ("as those of the next frames", given[:-1], known[1:]),
    )
    for order, places, tags in orders:
        so_m = float(np.median(distances_m(places, tags)))
        if THREE_SIGMA * so_m < as_given_m:
            text = f"its positions lie {as_given_m:.1f} m from those in the frames' tags, and {so_m:.1f} m "
            return [("positions-in-other-order", "", f"{text}{order}: check the names in the file")]
    off_m = _scatter_m(mid_latitude_offset_m(*known.T, *given.T))
    apart_m = _scatter_m(mid_latitude_offset_m(*np.median(known, axis=0), *known.T))
    if off_m <= apart_m or apart_m <= sd_m:  # tags that are all alike are not compared
        return []
    text = f"its positions lie {as_given_m:.1f} m from those in the frames' tags, which scatter by "
    text += f"{apart_m:.1f} m: lines may belong to other frames; check the names in the file"
    return [("positions-in-other-order", "", text)]


def _scatter_m(offsets_m: Floats) -> float:
    """Median distance of offsets (n, 2) from their median."""
    return float(np.median(np.linalg.norm(offsets_m - np.median(offsets_m, axis=0), axis=1)))


def _as_feet(both: Sequence[tuple[PosRow, Position]]) -> list[tuple[str, str, str]]:
    """Heights of the file that agree with those in the frames' tags only as feet. Tags that repeat the height
    above the ground are not compared."""
    pairs = [
        (r.height_ellipsoidal_m, p.height_ellipsoidal_m)
        for r, p in both
        if r.height_ellipsoidal_m is not None
        and p.height_ellipsoidal_m is not None
        and abs(p.height_ellipsoidal_m - (p.height_above_ground_m or 0.0)) > p.sd_vertical_m
    ]
    if not pairs:
        return []
    given_m, tags_m = np.array(pairs).T
    up_m, as_feet_m = (abs(float(np.median(unit * given_m - tags_m))) for unit in (1.0, LENGTHS_M["ft"]))
    if up_m <= 2.0 * _DATUMS_M or as_feet_m > _DATUMS_M:
        return []
    text = f"its heights lie {up_m:.0f} m from those in the frames' tags, and {as_feet_m:.0f} m if they are "
    return [("heights-elsewhere", "", text + "feet: name the column height_ft")]
