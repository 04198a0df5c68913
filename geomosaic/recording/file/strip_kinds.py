"""Kinds of messages of CCD strips."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from geomosaic.recording.file.messages import At, Kind, Topics, own
from geomosaic.recording.file.model import Jitter, Recording, StripCurve, StripResidual
from geomosaic.recording.file.plain import as_text, set_singles, topic_part

StripOffsets = own(
    "StripOffsets",
    # Offsets of one pair of CCD strips, right against left, at some of the left strip's lines; `sd` is one
    # standard deviation, label 0 measured, 1 bridged, 2 unreliable. `pair` counts from 0.
    "uint32 pair",
    "string left right",
    "repeated uint32 line",
    "repeated float dcol_px dline_px sd_col_px sd_line_px",
    "repeated uint32 label",
    "double share_measured share_bridged share_unreliable",
    "uint32 stage_index",
)


def strip_offsets(
    pair: tuple[int, str, str], line: ArrayLike, offset_px: ArrayLike, sd_px: ArrayLike, label: ArrayLike
) -> Topics:
    """Offsets (2, n) of a pair of strips, its number, left and right, at some lines, every eighth say: across
    and along, with their standard deviations (2, n). label: 0 to 2 as in `ccd.model.LABELS`.

    Recorded in single precision. Each pair has its own topic.
    """
    labels = np.asarray(label, dtype=np.uint32)
    measured, bridged, unreliable = np.bincount(labels, minlength=3)[:3] / max(labels.size, 1)
    (dcol_px, dline_px), (sd_col_px, sd_line_px) = np.asarray(offset_px), np.asarray(sd_px)
    number, left, right = pair
    message = StripOffsets(
        pair=number,
        left=as_text(left),
        right=as_text(right),
        line=np.asarray(line, dtype=np.uint32),
        label=labels,
        share_measured=measured,
        share_bridged=bridged,
        share_unreliable=unreliable,
    )
    set_singles(message, dcol_px=dcol_px, dline_px=dline_px, sd_col_px=sd_col_px, sd_line_px=sd_line_px)
    yield f"/strip_offsets/{number}", message


def _take_offsets(recording: Recording, message: Any, at: At) -> None:
    line, label = (np.array(v, dtype=np.int64) for v in (message.line, message.label))
    offset = np.array([message.dcol_px, message.dline_px], dtype=np.float64).T
    sd = np.array([message.sd_col_px, message.sd_line_px], dtype=np.float64).T
    if not len(line) == len(label) == len(offset) == len(sd):
        raise ValueError("offsets of unequal lengths")
    recording.strips.append(StripCurve(*_of_pair(message), line, offset, sd, label))


StripResiduals = own(
    "StripResiduals",
    # What is left between the strips of a pair after adding their offsets, block of lines by block: offset +
    # residual would be right. `line` is the left strip's in the middle of a block; NaN where nothing could be
    # measured. `sd` is one standard deviation, of either axis.
    "uint32 pair",
    "string left right",
    "repeated uint32 line",
    "repeated float dcol_px dline_px sd_px",
    "uint32 stage_index",
)


def strip_residuals(
    pair: tuple[int, str, str], line: ArrayLike, residual_px: ArrayLike, sd_px: ArrayLike
) -> Topics:
    """What is left between a pair's strips (2, n), across and along, at the middles of blocks of lines; NaN
    where unknown."""
    (dcol_px, dline_px), (number, left, right) = np.asarray(residual_px), pair
    message = StripResiduals(
        pair=number,
        left=as_text(left),
        right=as_text(right),
        line=np.floor(line).astype(np.uint32),
    )
    set_singles(message, dcol_px=dcol_px, dline_px=dline_px, sd_px=sd_px)
    yield f"/strip_residuals/{number}", message


def _take_residuals(recording: Recording, message: Any, at: At) -> None:
    line, sd = np.array(message.line, dtype=np.int64), np.array(message.sd_px, dtype=np.float64)
    residual = np.array([message.dcol_px, message.dline_px], dtype=np.float64).T
    if not len(line) == len(residual) == len(sd):
        raise ValueError("residuals of unequal lengths")
    recording.strip_residuals.append(StripResidual(*_of_pair(message), line, residual, sd))


def _of_pair(message: Any) -> tuple[int, int, str, str]:
    return message.stage_index, message.pair, message.left, message.right


JitterSpectrum = own(
    "JitterSpectrum",
    # Amplitudes of what moves line by line, dcol across and dline along; of `what` the topic names.
    "repeated float frequency_hz across_px along_px",
    "uint32 stage_index",
)


def jitter(what: str, frequency_hz: ArrayLike, across_px: ArrayLike, along_px: ArrayLike) -> Topics:
    """Amplitudes of what moves line by line; `what` is `found` or `left` and names the topic."""
    message = JitterSpectrum()
    set_singles(message, frequency_hz=frequency_hz, across_px=across_px, along_px=along_px)
    yield f"/jitter/{topic_part(what)}", message


def _take_jitter(recording: Recording, message: Any, at: At) -> None:
    values = (message.frequency_hz, message.across_px, message.along_px)
    frequency, across, along = np.array(values, dtype=np.float64)  # ValueError if of unequal lengths
    if not np.isfinite([frequency, across, along]).all():
        raise ValueError("a spectrum that isn't finite")
    recording.jitter.append(Jitter(message.stage_index, at.name, frequency, across, along))


STRIP_KINDS = (
    Kind(StripOffsets, "/strip_offsets/PAIR", "curves", calls=(strip_offsets,), take=_take_offsets),
    Kind(StripResiduals, "/strip_residuals/PAIR", "curves", calls=(strip_residuals,), take=_take_residuals),
    Kind(JitterSpectrum, "/jitter/WHAT", "jitter", calls=(jitter,), take=_take_jitter),
)
