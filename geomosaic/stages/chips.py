"""The pairs that disagree most, looked at in the pixels."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np

from geomosaic.adjustment.model import Adjusted
from geomosaic.arrays import Bytes
from geomosaic.errors import FileError
from geomosaic.matching.model import TiePoints
from geomosaic.pipeline.stage import Context
from geomosaic.quality.ranking import WORST_PAIRS, worst_pairs
from geomosaic.quality.seam_check import SeamGround, Sighting, Sights, seen_in
from geomosaic.quality.solved_tables import pair_columns, tie_weights
from geomosaic.recording.file.chips import Cut, chip, cuts, shown
from geomosaic.survey.model import Frame, Survey
from geomosaic.survey.pixels import read_pixels


@dataclass(frozen=True)
class ToCut:
    """A frame, what seams ask of it, and where it is to be cut."""

    frame: Frame
    seams: Sighting | None
    cuts: tuple[Cut, ...]


@dataclass(frozen=True)
class Pieces:
    """What seams asked for; and what was cut, (rows, cols, 3) each, in that order, none where the frame isn't
    there any more."""

    seams: Sights | None
    pixels: tuple[Bytes, ...]


def cut_frame(shared: SeamGround, item: ToCut) -> Pieces:
    """Decodes a frame once for all that is taken of it. Raises: `FileError` if seams can't have it."""
    try:
        pixels, mask = read_pixels(item.frame)
    except FileError:
        if item.seams is not None:
            raise
        return Pieces(None, ())
    seams = None if item.seams is None else seen_in(pixels, mask, shared, item.seams)
    return Pieces(seams, tuple(shown(cut.pixels(pixels)) for cut in item.cuts))


class Chips:
    """The worst pairs side by side at full resolution, with their tie points, worst first.

    Nothing where images aren't recorded, and without a pair whose frames aren't there any more.
    """

    def __init__(self, context: Context, survey: Survey, ties: TiePoints, adjusted: Adjusted) -> None:
        self._context, self._frames, self._pairs = context, survey.frames, ties.pairs
        self._residuals_m = adjusted.residuals_m
        self._weights = tie_weights(ties, adjusted.image_residuals)
        rms_m = pair_columns(ties, adjusted.residuals_m, self._weights)["rms_m"]
        wanted = context.recorder.wants("chip")
        self._worst = [p for p in worst_pairs(rms_m, WORST_PAIRS) if np.isfinite(rms_m[p])] if wanted else []
        self._where = {
            p: cuts(ties.pairs[p].left_px, ties.pairs[p].right_px, adjusted.residuals_m[p])
            for p in self._worst
        }
        self._halves: dict[tuple[int, int], Bytes] = {}

    def look(self, shared: SeamGround, seams: Mapping[int, Sighting]) -> list[Sights]:
        """Decodes frames once for both: what seams ask of them, and what they are cut for."""
        mine: dict[int, list[tuple[int, int]]] = {i: [] for i in seams}
        for p in self._worst:
            for side, frame in enumerate((self._pairs[p].left, self._pairs[p].right)):
                mine.setdefault(frame, []).append((p, side))
        jobs = [
            ToCut(self._frames[i], seams.get(i), tuple(self._where[p][side] for p, side in of))
            for i, of in mine.items()
        ]
        found = self._context.map("seams and chips", partial(cut_frame, shared), jobs, keys=list(mine))
        for of, pieces in zip(mine.values(), found, strict=True):
            self._halves |= dict(zip(of, pieces.pixels, strict=False))
        return [pieces.seams for pieces in found if pieces.seams is not None]

    def record(self) -> None:
        """What was cut."""
        for rank, p in enumerate(self._worst):
            if (p, 0) not in self._halves or (p, 1) not in self._halves:
                continue
            pair, both = self._pairs[p], (self._halves[p, 0], self._halves[p, 1])
            off_m, weights = self._residuals_m[p], self._weights[p]
            made = chip(both, self._where[p], (pair.left_px, pair.right_px), off_m, weights)
            names = self._frames[pair.left].name, self._frames[pair.right].name
            self._context.recorder.chip(rank, *names, made)
