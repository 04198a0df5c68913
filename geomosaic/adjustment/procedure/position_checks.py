"""Whether positions and images agree on how the block lies, and how large it is."""

from __future__ import annotations

from typing import Final

import numpy as np

from geomosaic.adjustment.model import Block
from geomosaic.arrays import Floats, Ints
from geomosaic.camera.exterior import Poses
from geomosaic.constants import MEDIAN_LENGTH, tuned
from geomosaic.estimation.robust import FAR
from geomosaic.estimation.similarity import fit_similarity
from geomosaic.placement.prior import position_assumed
from geomosaic.survey.model import Warn

_WITHIN_FLIGHT_M = tuned(1.0, "m", "agreement of a code receiver's positions in a flight, whatever is stated")
_UNLIKE = tuned(0.5, "share", "of the flight's extent, left by the best similarity: less is a few blunders")
OF_ANOTHER_SHAPE: Final = frozenset(("positions-mirrored", "positions-contradicted", "positions-out-of-step"))
"""Warnings after which no single position is worth a word."""
_FEWEST = tuned(5, "frames", "with positions: a similarity and its mirror image fit fewer alike")
_MIRRORED = (
    "the positions are a mirror image of what the frames show, so that the map lies in a wrong place: "
    "longitude and latitude are exchanged, or the sign of a western longitude or a southern latitude is "
    "missing; correct the columns of --pos, or the frames' tags"
)


def shift_and_scale(block: Block, poses: Poses, frames: Ints) -> list[Warn]:
    """Warning of positions that have another shape than the block, or its mirror image. Otherwise warnings of
    a common shift of all beyond five stated deviations (another datum of control), and of a wrong scale of
    the block. The scale is that of the similarity from adjusted to given positions. Its deviation is a
    position's over the root of the squared extent. A position's deviation is the residual of the similarity,
    and at least the stated one or 1 m."""
    frames = frames[~position_assumed(block.poses)[frames]]
    if not len(frames):
        return []
    stated = block.poses.positions_sd_m[frames]
    given, found = block.poses.positions_m[frames], poses.positions_m[frames]
    shift_m, out = np.median(given - found, axis=0), []
    if np.any(np.abs(shift_m) > FAR * np.median(stated, axis=0)):
        east, north, up = shift_m
        text = (
            f"the positions lie {east:+.1f} m east, {north:+.1f} m north and {up:+.1f} m up of where the "
            "adjustment puts the frames; check their datum and height system, and those of control points"
        )
        out.append(Warn("positions-shifted", "", text))
    given, found = given[:, :2], found[:, :2]
    extent_m = float(np.sqrt(((found - found.mean(axis=0)) ** 2).sum()))
    if extent_m == 0.0 or len(frames) < 3 or not np.ptp(given, axis=0).any():
        return out
    turn, left_m = _fit(found, given)
    far = len(frames) >= _FEWEST and left_m > FAR * float(np.median(stated[:, :2]))
    if far and (named := _of_another_shape(found, given, left_m)):
        return [named]
    position_sd_m = max(min(float(np.median(stated[:, :2])), _WITHIN_FLIGHT_M), left_m / MEDIAN_LENGTH)
    off, sd = 1.0 / abs(turn) - 1.0, position_sd_m / extent_m
    if abs(off) > FAR * sd:
        text = (
            f"the block is {abs(off) * 100.0:.2f} % {'larger' if off > 0.0 else 'smaller'} than its "
            f"frames' positions say (standard deviation {sd * 100.0:.2f} %); the mosaic's scale is in "
            "doubt: check the focal length, the flying height and the positions"
        )
        out.append(Warn("scale-doubtful", "", text))
    return out


def _fit(found: Floats, given: Floats) -> tuple[complex, float]:
    """Turn and scale of the similarity from found to given places (n, 2), and its median residual in m."""
    turn, shift = fit_similarity(found, given)
    return turn, float(np.median(np.abs(given @ [1, 1j] - turn * (found @ [1, 1j]) - shift)))


def _reach_m(given: Floats) -> float:
    """How far half of places (n, 2) lie from their middle."""
    return float(np.median(np.linalg.norm(given - np.median(given, axis=0), axis=1)))


def _of_another_shape(found: Floats, given: Floats, left_m: float) -> Warn | None:
    """What is wrong with positions that a similarity takes to left_m of where the images put the frames, in
    the survey's order; None where single blunders may be."""
    shifted = {"before": (found[:-1], given[1:]), "after": (found[1:], given[:-1])}
    for side, (places, positions) in shifted.items():
        if _fit(places, positions)[1] < _UNLIKE**2 * left_m:
            text = (
                f"the positions are one frame out of step: each frame has that of the one {side}, "
                f"{left_m:.0f} m away (median); shift the names in --pos by one line"
            )
            return Warn("positions-out-of-step", "", text)
    if left_m <= _UNLIKE * _reach_m(given):
        return None
    if _fit(found * [1.0, -1.0], given)[1] < _UNLIKE * left_m:
        return Warn("positions-mirrored", "", _MIRRORED)
    text = (
        "the positions contradict the images: turned, scaled and shifted onto the frames they are still off "
        f"by {left_m:.0f} m (median); they may belong to other frames: check names and order in --pos, or "
        "the frames' tags"
    )
    return Warn("positions-contradicted", "", text)
