"""Kinds of messages of a solve and of pairs of frames: steps, misalignments, tie points, chips."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike

from geomosaic.recording.file.chips import Chip
from geomosaic.recording.file.frame_kinds import image
from geomosaic.recording.file.messages import At, Kind, Topics, own
from geomosaic.recording.file.model import Recording, RoundOffsets
from geomosaic.recording.file.plain import as_text, set_singles, topic_part

Iteration = own(
    "Iteration",
    # One step of a solve; `iteration` counts through all solves of a stage. `cost` is what is minimised,
    # in cost_unit ("" for a sum of weighted squares), `sigma_px` the deviation of image coordinates,
    # `step_m` the largest move of a frame. NaN where a method has no such thing.
    "string stage",
    "uint32 stage_index iteration",
    "string solve",
    "double cost",
    "string cost_unit",
    "double sigma_px damping step_m share_down_weighted",
)


_OF_STEPS: Final = ("sigma_px", "damping", "step_m", "share_down_weighted")


def iteration(
    stage: str, solve: str, cost: float, cost_unit: str = "", figures: Mapping[str, float] | None = None
) -> Topics:
    """One step of a solve. figures: those of `_OF_STEPS` that the method has."""
    known = dict.fromkeys(_OF_STEPS, np.nan) | dict(figures or {})
    message = Iteration(stage=stage, solve=solve, cost=cost, cost_unit=cost_unit, **known)
    yield f"/iterations/{topic_part(stage)}", message


def _take_iteration(recording: Recording, message: Any, at: At) -> None:
    """By the message's own names; None for what isn't finite."""
    names = ("stage_index", "iteration", "solve", "cost_unit")
    out: dict[str, Any] = {name: getattr(message, name) for name in names}
    for name in ("cost", *_OF_STEPS):
        value = getattr(message, name)
        out[name] = value if math.isfinite(value) else None
    recording.iterations.append(out)


PairOffsets = own(
    "PairOffsets",
    # One round of an adjustment: (left, right, east_m, north_m) are the misalignments of the pairs
    # before the moves, right minus left, NaN where unknown; (frame, move_east_m, move_north_m) the moves.
    "string stage",
    "uint32 round",
    "repeated string left right",
    "repeated double east_m north_m",
    "repeated string frame",
    "repeated double move_east_m move_north_m",
    "double largest_misalignment_m rms_misalignment_m largest_move_m",
    "uint32 stage_index",
)


def offsets(
    stage: str,
    round_index: int,
    pairs: Sequence[tuple[str | int, str | int, float, float]],
    moves: Sequence[tuple[str | int, float, float]],
) -> Topics:
    """One round of an adjustment.

    `pairs` has (left, right, d_east_m, d_north_m): the misalignments before this round's moves, NaN
    where unknown. `moves` has (frame, d_east_m, d_north_m). Frames by their names.
    """
    misalignments = np.array([p[2:] for p in pairs], dtype=np.float64).reshape(-1, 2)
    moved = np.array([m[1:] for m in moves], dtype=np.float64).reshape(-1, 2)
    lengths = np.hypot(*misalignments.T)
    known = lengths[np.isfinite(lengths)]
    message = PairOffsets(
        stage=stage,
        round=round_index,
        left=[as_text(p[0]) for p in pairs],
        right=[as_text(p[1]) for p in pairs],
        east_m=misalignments[:, 0],
        north_m=misalignments[:, 1],
        frame=[as_text(m[0]) for m in moves],
        move_east_m=moved[:, 0],
        move_north_m=moved[:, 1],
        largest_misalignment_m=known.max() if known.size else np.nan,
        rms_misalignment_m=np.sqrt(np.mean(known**2)) if known.size else np.nan,
        largest_move_m=np.nanmax(np.hypot(*moved.T), initial=0.0),
    )
    yield f"/offsets/{topic_part(stage)}", message


def _take_offsets(recording: Recording, message: Any, at: At) -> None:
    pairs = tuple(zip(message.left, message.right, strict=True))
    misalignments = np.array([message.east_m, message.north_m], dtype=np.float64).T
    moves = np.array([message.move_east_m, message.move_north_m], dtype=np.float64).T
    if len(misalignments) != len(pairs) or len(moves) != len(message.frame):
        raise ValueError("offsets of unequal lengths")
    of = (message.stage, message.stage_index, message.round)
    recording.rounds.append(RoundOffsets(*of, pairs, misalignments, tuple(message.frame), moves))


TiePoints = own(
    "TiePoints",
    # Tie points of one pair: col and row in the full frames, corner origin. Residuals, where given,
    # are on the ground: right minus left; weight: of the solve, NaN for those that took no part.
    "string left right",
    "repeated float left_col_px left_row_px right_col_px right_row_px residual_east_m residual_north_m",
    "uint32 stage_index",
    "repeated float weight",
)


def tie_points(
    pair: tuple[str | int, str | int],
    left_px: ArrayLike,
    right_px: ArrayLike,
    residual_m: ArrayLike | None = None,
    weight: ArrayLike | None = None,
) -> Topics:
    """The tie points of a pair, the left frame first: (k, 2) cols and rows in both frames and (k, 2)
    residuals on the ground. Also the solve's weights (k,), 1 for a good one, NaN where one took no part.

    The artefacts hold them too; here in single precision (0.001 px at col 8000).
    """
    a, b = (np.asarray(px, dtype=np.float32).reshape(-1, 2) for px in (left_px, right_px))
    r = np.asarray(() if residual_m is None else residual_m, dtype=np.float32).reshape(-1, 2)
    message = TiePoints(left=as_text(pair[0]), right=as_text(pair[1]))
    set_singles(
        message,
        left_col_px=a[:, 0],
        left_row_px=a[:, 1],
        right_col_px=b[:, 0],
        right_row_px=b[:, 1],
        residual_east_m=r[:, 0],
        residual_north_m=r[:, 1],
        weight=() if weight is None else weight,
    )
    yield "/tie_points", message


ChipTies = own(
    "ChipTies",
    # Where in both frames the halves of the image before it on /chips are from, and the tie points in them.
    # Each half is a square of side_px; the corner of the left one is at (left_col_px, left_row_px) of its
    # frame; the right one's likewise, then turned by right_quarters times 90 degrees anticlockwise. Places
    # (x, y) are the image's. weight: of the solve, 1 for a good tie point, NaN if it took no part.
    "uint32 rank",
    "string left right",
    "uint32 side_px",
    "double left_col_px left_row_px right_col_px right_row_px",
    "uint32 right_quarters",
    "repeated float left_x_px left_y_px right_x_px right_y_px residual_east_m residual_north_m weight",
    "uint32 stage_index",
)


def chip(rank: int, left: str, right: str, chip: Chip) -> Topics:
    """Where a pair disagrees: both frames side by side at full resolution, and the tie points there."""
    yield from image("/chips", f"{left} - {right}", chip.jpeg)
    message = ChipTies(
        rank=rank,
        left=as_text(left),
        right=as_text(right),
        side_px=chip.side_px,
        left_col_px=chip.left_corner_px[0],
        left_row_px=chip.left_corner_px[1],
        right_col_px=chip.right_corner_px[0],
        right_row_px=chip.right_corner_px[1],
        right_quarters=chip.right_quarters,
    )
    set_singles(
        message,
        left_x_px=chip.left_xy[:, 0],
        left_y_px=chip.left_xy[:, 1],
        right_x_px=chip.right_xy[:, 0],
        right_y_px=chip.right_xy[:, 1],
        residual_east_m=chip.residual_m[:, 0],
        residual_north_m=chip.residual_m[:, 1],
        weight=chip.weight,
    )
    yield "/chips/ties", message


def _take_chip(recording: Recording, message: Any, at: At) -> None:
    sides = ("left_x_px", "left_y_px", "right_x_px", "right_y_px", "weight")
    if len({len(getattr(message, side)) for side in sides}) != 1:
        raise ValueError("tie points of unequal lengths")
    jpeg = recording.images.get("/chips", {}).pop(f"{message.left} - {message.right}", None)
    if jpeg is not None:
        recording.chips.append((jpeg, message))


PAIR_KINDS = (
    Kind(Iteration, "/iterations/STAGE", "steps", calls=(iteration,), take=_take_iteration),
    Kind(PairOffsets, "/offsets/STAGE", calls=(offsets,), take=_take_offsets),
    Kind(TiePoints, "/tie_points", level="full", calls=(tie_points,)),
    Kind(ChipTies, "/chips/ties", "worst pairs", level="normal", calls=(chip,), take=_take_chip),
)
