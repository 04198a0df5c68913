"""Messages of a recording as the model has them; ValueError for what no run writes."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from geomosaic.recording.model import (
    Figures,
    Jitter,
    RoundOffsets,
    StageProgress,
    StripCurve,
    StripResidual,
)


def round_offsets(message: Any) -> RoundOffsets:
    """One round of an adjustment."""
    pairs = tuple(zip(message.left, message.right, strict=True))
    misalignments = np.array([message.east_m, message.north_m], dtype=np.float64).T
    moves = np.array([message.move_east_m, message.move_north_m], dtype=np.float64).T
    if len(misalignments) != len(pairs) or len(moves) != len(message.frame):
        raise ValueError("offsets of unequal lengths")
    return RoundOffsets(
        message.stage, message.stage_index, message.round, pairs, misalignments, tuple(message.frame), moves
    )


def curve(message: Any) -> StripCurve:
    """Offsets of a pair of strips."""
    line, label = (np.array(v, dtype=np.int64) for v in (message.line, message.label))
    offset = np.array([message.dcol_px, message.dline_px], dtype=np.float64).T
    sd = np.array([message.sd_col_px, message.sd_line_px], dtype=np.float64).T
    if not len(line) == len(label) == len(offset) == len(sd):
        raise ValueError("offsets of unequal lengths")
    return StripCurve(message.stage_index, message.pair, message.left, message.right, line, offset, sd, label)


def residual(message: Any) -> StripResidual:
    """What is left between a pair of strips."""
    line, sd = np.array(message.line, dtype=np.int64), np.array(message.sd_px, dtype=np.float64)
    residual = np.array([message.dcol_px, message.dline_px], dtype=np.float64).T
    if not len(line) == len(residual) == len(sd):
        raise ValueError("residuals of unequal lengths")
    return StripResidual(message.stage_index, message.pair, message.left, message.right, line, residual, sd)


def jitter(what: str, message: Any) -> Jitter:
    """A spectrum."""
    values = (message.frequency_hz, message.across_px, message.along_px)
    frequency, across, along = np.array(values, dtype=np.float64)  # ValueError if of unequal lengths
    if not np.isfinite([frequency, across, along]).all():
        raise ValueError("a spectrum that isn't finite")
    return Jitter(message.stage_index, what, frequency, across, along)


def progress(message: Any) -> StageProgress:
    """A heartbeat."""
    return StageProgress(
        message.stage_id,
        message.stage_index,
        message.text,
        message.done,
        message.total,
        message.seconds,
        message.memory_bytes,
    )


def iteration(message: Any) -> dict[str, Any]:
    """One step of a solve, by the message's own names; None for what isn't finite."""
    out: dict[str, Any] = {"stage_index": message.stage_index}
    out |= {name: getattr(message, name) for name in ("iteration", "solve", "cost_unit")}
    for name in ("cost", "sigma_px", "damping", "step_m", "share_down_weighted"):
        value = getattr(message, name)
        out[name] = value if math.isfinite(value) else None
    return out


def table(name: str, message: Any) -> Figures:
    """A table of frames or pairs."""
    rows, columns = len(message.row), tuple(message.column)
    if len(message.value) != rows * len(columns) or len(set(columns)) < len(columns):
        raise ValueError("a table of unequal columns")
    if len(message.other) not in (0, rows) or len(message.note) not in (0, rows):
        raise ValueError("a table of unequal rows")
    values = np.array(message.value, dtype=np.float64).reshape(len(columns), rows)
    return Figures(
        name,
        message.stage_index,
        tuple(message.row),
        tuple(message.other),
        dict(zip(columns, values, strict=True)),
        tuple(message.note),
    )
