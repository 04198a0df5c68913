"""What differs between the strips of two recordings."""

from __future__ import annotations

from typing import Any

import numpy as np

from geomosaic.recording.file.model import Recording, StripCurve, StripResidual
from geomosaic.recording.inspect.summary import largest_length, rms_length


def strips(a: Recording, b: Recording) -> list[dict[str, Any]]:
    """For each pair of strips whose offsets differ: by how much, at the lines that both recorded."""
    curves_a, curves_b = _curves(a), _curves(b)
    out: list[dict[str, Any]] = []
    for stage, pair in dict.fromkeys([*curves_a, *curves_b]):
        of_a, of_b = curves_a.get((stage, pair)), curves_b.get((stage, pair))
        if of_a is None or of_b is None:
            out.append({"stage": stage, "pair": pair, "only_in": "b" if of_a is None else "a"})
            continue
        _, at_a, at_b = np.intersect1d(of_a.line, of_b.line, return_indices=True)
        equal = len(at_a) == len(of_a.line) == len(of_b.line) and all(
            np.array_equal(getattr(of_a, name), getattr(of_b, name), equal_nan=True)
            for name in ("offset_px", "sd_px", "label")
        )
        if not equal:
            change = of_b.offset_px[at_b] - of_a.offset_px[at_a]
            relabelled = of_b.label[at_b] != of_a.label[at_a]
            out.append(
                {
                    "stage": stage,
                    "pair": pair,
                    "lines": [len(of_a.line), len(of_b.line)],
                    "largest_px": largest_length(change),
                    "rms_px": rms_length(change),
                    "share_relabelled": float(relabelled.mean()) if relabelled.size else None,
                }
            )
    return out


def _curves(recording: Recording) -> dict[tuple[str, int], StripCurve]:
    ids = {stage.index: stage.stage_id for stage in recording.stages}
    return {(ids.get(c.stage_index, ""), c.pair): c for c in recording.strips}


def strip_residuals(a: Recording, b: Recording) -> list[dict[str, Any]]:
    """For each pair of strips of which something else is left: blocks and RMS of both, the largest change."""
    left_a, left_b = _residuals(a), _residuals(b)
    out: list[dict[str, Any]] = []
    for stage, pair in dict.fromkeys([*left_a, *left_b]):
        of_a, of_b = left_a.get((stage, pair)), left_b.get((stage, pair))
        if of_a is None or of_b is None:
            out.append({"stage": stage, "pair": pair, "only_in": "b" if of_a is None else "a"})
            continue
        equal = all(
            np.array_equal(getattr(of_a, name), getattr(of_b, name), equal_nan=True)
            for name in ("line", "residual_px", "sd_px")
        )
        if not equal:
            _, at_a, at_b = np.intersect1d(of_a.line, of_b.line, return_indices=True)
            both = of_a.residual_px, of_b.residual_px
            out.append(
                {
                    "stage": stage,
                    "pair": pair,
                    "blocks_measured": [int(np.isfinite(r).all(axis=1).sum()) for r in both],
                    "rms_px": [rms_length(r) for r in both],
                    "largest_px": largest_length(both[1][at_b] - both[0][at_a]),
                }
            )
    return out


def _residuals(recording: Recording) -> dict[tuple[str, int], StripResidual]:
    ids = {stage.index: stage.stage_id for stage in recording.stages}
    return {(ids.get(r.stage_index, ""), r.pair): r for r in recording.strip_residuals}
