"""The pairs that disagree most, looked at in the pixels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geomosaic.adjustment.model import Adjusted
from geomosaic.errors import FileError
from geomosaic.matching.model import TiePoints
from geomosaic.pipeline.stage import Context
from geomosaic.quality.solved_tables import pair_columns, tie_weights, worst_pairs
from geomosaic.recording.chips import Cut, chip, cuts, shown
from geomosaic.recording.messages import ChipTies
from geomosaic.survey.model import Frame, Survey
from geomosaic.survey.pixels import read_pixels


@dataclass(frozen=True)
class ToCut:
    """A frame, and where it is to be cut."""

    frame: Frame
    cuts: tuple[Cut, ...]


@dataclass(frozen=True)
class Pieces:
    """What was cut, (rows, cols, 3) each, in that order; none where the frame isn't there any more."""

    pixels: tuple[NDArray[np.uint8], ...]


def cut_frame(item: ToCut) -> Pieces:
    """Decodes a frame once for all that is cut of it."""
    try:
        pixels = read_pixels(item.frame)[0]
    except FileError:
        return Pieces(())
    return Pieces(tuple(shown(cut.pixels(pixels)) for cut in item.cuts))


def record_chips(context: Context, survey: Survey, ties: TiePoints, adjusted: Adjusted) -> None:
    """The worst pairs side by side at full resolution, with their tie points, worst first.

    Nothing where images aren't recorded, and without a pair whose frames aren't there any more.
    """
    if not context.recorder.wants(ChipTies):
        return
    weights = tie_weights(ties, adjusted.image_residuals)
    rms_m = pair_columns(ties, adjusted.residuals_m, weights)["rms_m"]
    worst = [p for p in worst_pairs(rms_m) if np.isfinite(rms_m[p])]
    where = {p: cuts(ties.pairs[p].left_px, ties.pairs[p].right_px, adjusted.residuals_m[p]) for p in worst}
    ends = [
        (p, side, ties.pairs[p].left if side == 0 else ties.pairs[p].right) for p in worst for side in (0, 1)
    ]
    frames = sorted({frame for *_, frame in ends})
    mine = {i: [(p, side) for p, side, frame in ends if frame == i] for i in frames}
    jobs = [ToCut(survey.frames[i], tuple(where[p][side] for p, side in mine[i])) for i in frames]
    halves: dict[tuple[int, int], NDArray[np.uint8]] = {}
    for i, pieces in zip(frames, context.map("chips", cut_frame, jobs, keys=frames), strict=True):
        halves |= dict(zip(mine[i], pieces.pixels, strict=False))
    for rank, p in enumerate(worst):
        if (p, 0) not in halves or (p, 1) not in halves:
            continue
        pair, both = ties.pairs[p], (halves[p, 0], halves[p, 1])
        made = chip(both, where[p], pair.left_px, pair.right_px, adjusted.residuals_m[p], weights[p])
        context.recorder.chip(rank, survey.frames[pair.left].name, survey.frames[pair.right].name, made)
