"""The plan of a survey as layers in metres of the work frame, for Rerun and for pictures."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from geomosaic.arrays import Bools, Bytes, Floats
from geomosaic.quality import ranking
from geomosaic.quality.ranking import MOVE, RESIDUAL, badness, moves_sd
from geomosaic.recording.file.model import FigureTable, Recording

Colour = tuple[int, int, int]
LEGEND: Final = (
    f"arrows from POS to adjusted, yellow {MOVE.good:g}, red {MOVE.bad:g} deviations; pairs and tie "
    f"points, yellow {RESIDUAL.good:g}, red {RESIDUAL.bad:g} ground pixels; grey: tried, not tied"
)
_GREY, _FAINT, _RED, _BARE = (95, 95, 110), (60, 66, 80), (255, 60, 60), (210, 130, 40)
_BLUE: Final = (80, 110, 160)
_BARE_NAMED, _NO_TIES = 3, "no tie points"
"""Parts of the ground that are named, and how, where it has none."""
_ROOM: Final = (1000.0, 600.0)
"""UI points that a plan has on a screen of 1920 x 1080: names that would lie on one another there are left
out, and shown where the pointer is."""
_LETTER, _NAME_HIGH, _NAME_RIM = 7.5, 24.0, 14.0
_LONGEST_NAME: Final = 40
_CROWDED: Final = 100
"""Frames of which a plan is full: beyond them what is all right is drawn thinner."""
_LEAST_NAMED_M: Final = 1.0
"""No move below it is named, however sure its position was given: names tell whole metres."""
_TURNED: Final = "frame-turned:"
"""How the warning of an image that was turned begins."""


@dataclass(frozen=True)
class PlanLayer:
    """What of a plan is drawn alike, from the lowest layer to the highest.

    kind: `rings`, `lines`, `arrows` (start and end) or `points`; parts_m: (k, 2) each, east and north; points
    are one a part. colours: one, or (n, 3) of the parts, red, green, blue. wide: points of a screen, one or
    of the parts. order: Rerun's. labels: of points; named: whether they are always shown.
    """

    name: str
    kind: str
    parts_m: Sequence[Floats] | Floats
    colours: Bytes | Colour
    wide: float | Floats
    order: float
    labels: Sequence[str] = ()
    named: bool = False


def plan_layers(recording: Recording) -> list[PlanLayer]:
    """What is known so far."""
    placed, adjusted = recording.table("frames.placed"), recording.table("frames.adjusted")
    layers = []
    for what, colour, wide in (("placed", _FAINT, 0.6), ("adjusted", _BLUE, 0.8), ("seams", _FAINT, 0.6)):
        rings = [ring for _, ring in recording.outlines.get(what, ()) if len(ring)]
        name = f"footprints_{what}" if what != "seams" else what
        layers.append(PlanLayer(name, "rings", rings, colour, wide / 2, 1.0))
    bare = [ring for _, ring in recording.outlines.get("bare", ()) if len(ring)]
    layers.append(PlanLayer("bare", "rings", bare, _BARE, 1.0, 1.2))
    now = adjusted if adjusted.row else placed
    if not now.row:
        return layers
    at, thin = _places(now), min(1.0, (_CROWDED / len(now.row)) ** 0.5)
    layers += [_ties(recording, thin), *_pairs(recording, at, now.number, thin)]
    far_sd = moves_in_sd(placed, adjusted)
    if adjusted.row:
        layers.append(_moves(adjusted, at, far_sd))
    turned = {line.frame for line in recording.log if line.text.startswith(_TURNED)}
    labels, colours = frame_labels(placed, adjusted, turned), frame_colours(placed, adjusted)
    layers.append(PlanLayer("frames", "points", at[:, None], colours, 3.5 * thin, 5.0, labels))
    outlines = [ring for what in ("placed", "adjusted") for _, ring in recording.outlines.get(what, ())]
    every = np.concatenate([at, *outlines])
    seen = every[np.isfinite(every).all(axis=1)]
    middles = [(ring.min(axis=0) + ring.max(axis=0)) / 2.0 for ring in bare[:_BARE_NAMED]]
    at, labels = np.concatenate([at, *([m] for m in middles)]), [*labels, *[_NO_TIES] * len(middles)]
    colours = np.concatenate([colours, *([_BARE] for _ in middles)]).astype(np.uint8)
    far_sd = np.append(far_sd, np.zeros(len(middles)))
    shown, named_at = names_apart(at, np.ptp(seen, axis=0) if len(seen) else np.ones(2), labels, far_sd)
    named = [labels[k] for k in shown]
    layers.append(
        PlanLayer("names", "points", named_at[:, None], colours[shown], 1.0, 6.0, named, named=True)
    )
    return layers


def names_apart(at: Floats, span_m: Floats, labels: list[str], far_sd: Floats) -> tuple[list[int], Floats]:
    """Rows and places of those labels at (n, 2) that don't lie on one another where all of the plan, span_m
    (2,), is seen. Odd ones come first, and of these the ones that moved farthest, by far_sd (n,) in
    deviations. An odd one may be moved below or above for room."""
    points_per_m = min(_ROOM / np.maximum(span_m, 1e-9))
    at_pt = np.nan_to_num(at) * points_per_m
    wide = np.array([len(label) * _LETTER + _NAME_RIM for label in labels])
    odd = np.array([" " in label for label in labels])
    shown: list[int] = []
    moved = np.nan_to_num(far_sd) if len(far_sd) == len(labels) else np.zeros(len(labels))
    for k in np.lexsort((np.arange(len(labels)), -moved, ~odd)):
        if not np.isfinite(at[k]).all():
            continue
        for rows in (0, 1, -1) if odd[k] else (0,):
            place = at_pt[k] + [0.0, rows * _NAME_HIGH]
            across, down = np.abs(at_pt[shown] - place).T
            if not ((across < (wide[shown] + wide[k]) / 2.0) & (down < _NAME_HIGH)).any():
                at_pt[k] = place
                shown.append(int(k))
                break
    return shown, at_pt[shown] / points_per_m


def _pairs(recording: Recording, at: Floats, number: dict[str, int], thin: float) -> list[PlanLayer]:
    tried, tied = recording.table("pairs.tried"), recording.table("pairs.adjusted")
    vain = [
        at[[number[a], number[b]]]
        for a, b, why in zip(tried.row, tried.other, tried.note, strict=False)
        if why and a in number and b in number
    ]
    known = [k for k, (a, b) in enumerate(zip(tied.row, tied.other, strict=False)) if {a, b} <= number.keys()]
    rms_m = tied.column("rms_m")[known]
    order = np.argsort(np.nan_to_num(rms_m), kind="stable")
    ends = [at[[number[tied.row[known[k]]], number[tied.other[known[k]]]]] for k in order]
    bad = _in_pixels(recording, rms_m[order])
    wide = np.where(bad > 0.5, 1.2 * thin**0.5, 0.7 * thin)
    return [
        PlanLayer("pairs_untied", "lines", vain, _GREY, 0.4 * thin, 2.0),
        PlanLayer("pairs_tied", "lines", ends, by_badness(bad), wide, 3.0),
    ]


def _ties(recording: Recording, thin: float) -> PlanLayer:
    sample = recording.table("ties.ground")
    colours = by_badness(_in_pixels(recording, sample.column("residual_m")))
    return PlanLayer("tie_points", "points", _places(sample)[:, None], colours, 0.9 * thin, 1.5)


def _moves(adjusted: FigureTable, at: Floats, far_sd: Floats) -> PlanLayer:
    moved = np.column_stack([adjusted.column("moved_e_m"), adjusted.column("moved_n_m")])
    known = np.isfinite(moved).all(axis=1)
    arrows = np.stack([(at - moved)[known], at[known]], axis=1)
    colours = by_badness(badness(far_sd[known], MOVE.good, MOVE.bad))
    return PlanLayer("moved", "arrows", arrows, colours, 1.6, 4.0)


def frame_labels(placed: FigureTable, adjusted: FigureTable, turned: Collection[str] = ()) -> list[str]:
    """Names without their endings, and behind a blank what is odd about a frame.

    Args: turned: names of frames whose images were turned, which isn't their headings' fault.
    """
    if not adjusted.row:
        return [_stem(name)[:_LONGEST_NAME] for name in placed.row]
    moved, far_sd = moves_m(adjusted), moves_in_sd(placed, adjusted)
    off, wrong = headings_off_deg(placed, adjusted), wrong_headings(placed, adjusted)
    out = []
    for k, name in enumerate(adjusted.row):
        odd = [f"{moved[k]:.0f} m"] if far_sd[k] > MOVE.good and moved[k] > _LEAST_NAMED_M else []
        if name in turned:
            odd.append("image turned")
        elif wrong[k]:
            odd.append(f"heading {off[k]:.0f} deg off")
        status = adjusted.note[k] if adjusted.note else "tied"
        odd += [status] if status != "tied" else []
        out.append(" ".join([_stem(name)[:_LONGEST_NAME], ", ".join(odd)]).strip())
    return out


def moves_m(adjusted: FigureTable) -> Floats:
    """How far frames moved over the ground, (n,)."""
    return np.hypot(adjusted.column("moved_e_m"), adjusted.column("moved_n_m"))


def moves_in_sd(placed: FigureTable, adjusted: FigureTable) -> Floats:
    """The same in deviations of given and found positions together, (n,)."""
    before = np.column_stack([_given(placed, adjusted, f"sd_{axis}_m") for axis in "en"])
    after = np.column_stack([adjusted.column(f"sd_{axis}_m") for axis in "en"])
    moved = np.column_stack([adjusted.column("moved_e_m"), adjusted.column("moved_n_m")])
    return moves_sd(moved, before, after)


def headings_off_deg(placed: FigureTable, adjusted: FigureTable) -> Floats:
    """By how much headings as found differ from those as given, (n,) of the adjusted frames, 0 to 180."""
    return np.abs(ranking.headings_off_deg(_given(placed, adjusted, "yaw_deg"), adjusted.column("yaw_deg")))


def wrong_headings(placed: FigureTable, adjusted: FigureTable) -> Bools:
    """Of the adjusted frames, (n,), those whose heading is off by more than its limit."""
    return ranking.wrong_headings(headings_off_deg(placed, adjusted), _given(placed, adjusted, "sd_yaw_deg"))


def _given(placed: FigureTable, adjusted: FigureTable, column: str) -> Floats:
    """A column of placed frames by the rows of adjusted ones, (n,); NaN where it isn't known."""
    rows = [placed.number.get(name, -1) for name in adjusted.row]
    return np.asarray(np.append(placed.column(column), np.nan)[rows])


def frame_colours(placed: FigureTable, adjusted: FigureTable) -> Bytes:
    """By how many deviations frames moved, light grey before they did; red for a heading that is off, and for
    what isn't tied."""
    if not adjusted.row:
        return np.full((len(placed.row), 3), 170, np.uint8)
    colours = by_badness(badness(moves_in_sd(placed, adjusted), MOVE.good, MOVE.bad))
    colours[wrong_headings(placed, adjusted)] = _RED
    for k, status in enumerate(adjusted.note):
        if status in ("placed", "rejected"):
            colours[k] = _RED
    return colours


def by_badness(bad: Floats) -> Bytes:
    """(n, 3): green for 0, yellow for 0.5, red for 1; grey for unknown."""
    share = np.nan_to_num(bad)[:, None]
    green, yellow, red = (np.array(c, dtype=np.float64) for c in ((60, 200, 80), (230, 190, 60), _RED))
    low = green + (yellow - green) * np.minimum(2.0 * share, 1.0)
    mixed = np.where(share > 0.5, yellow + (red - yellow) * (2.0 * share - 1.0), low)
    mixed[np.isnan(bad)] = _GREY
    return np.asarray(np.round(mixed), dtype=np.uint8)


def _in_pixels(recording: Recording, residual_m: Floats) -> Floats:
    """How bad residuals are, by the frames' ground pixel; NaN if that isn't known."""
    known = recording.metrics.get("placement.ground_pixel_m")
    pixel_m = float(known) if isinstance(known, int | float) and known > 0 else np.nan
    return badness(residual_m / pixel_m, RESIDUAL.good, RESIDUAL.bad)


def _places(table: FigureTable) -> Floats:
    return np.column_stack([table.column("east_m"), table.column("north_m")])


def _stem(name: str) -> str:
    return name.rpartition(".")[0] or name
