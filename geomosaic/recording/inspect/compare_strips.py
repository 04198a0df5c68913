"""What differs between the strips of two recordings."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar

import numpy as np

from geomosaic.arrays import Ints
from geomosaic.recording.file.model import Recording, StripCurve, StripResidual
from geomosaic.recording.inspect.summary import largest_length, rms_length

OfPair = TypeVar("OfPair", StripCurve, StripResidual)


def strips(a: Recording, b: Recording) -> list[dict[str, Any]]:
    """For each pair of strips whose offsets differ: by how much, at the lines that both recorded."""

    def change(one: StripCurve, other: StripCurve, at: tuple[Ints, Ints]) -> dict[str, Any]:
        off = other.offset_px[at[1]] - one.offset_px[at[0]]
        relabelled = other.label[at[1]] != one.label[at[0]]
        return {
            "lines": [len(one.line), len(other.line)],
            "largest_px": largest_length(off),
            "rms_px": rms_length(off),
            "share_relabelled": float(relabelled.mean()) if relabelled.size else None,
        }

    names = ("line", "offset_px", "sd_px", "label")
    return _differing(_by_pair(a, a.strips), _by_pair(b, b.strips), names, change)


def strip_residuals(a: Recording, b: Recording) -> list[dict[str, Any]]:
    """For each pair of strips of which something else is left: blocks and RMS of both, the largest change."""

    def change(one: StripResidual, other: StripResidual, at: tuple[Ints, Ints]) -> dict[str, Any]:
        both = one.residual_px, other.residual_px
        return {
            "blocks_measured": [int(np.isfinite(r).all(axis=1).sum()) for r in both],
            "rms_px": [rms_length(r) for r in both],
            "largest_px": largest_length(both[1][at[1]] - both[0][at[0]]),
        }

    names = ("line", "residual_px", "sd_px")
    return _differing(_by_pair(a, a.strip_residuals), _by_pair(b, b.strip_residuals), names, change)


def _by_pair(recording: Recording, of_pairs: Sequence[OfPair]) -> dict[tuple[str, int], OfPair]:
    """By the stage's id and the pair's number."""
    ids = {stage.index: stage.stage_id for stage in recording.stages}
    return {(ids.get(one.stage_index, ""), one.pair): one for one in of_pairs}


def _differing(
    of_a: Mapping[tuple[str, int], OfPair],
    of_b: Mapping[tuple[str, int], OfPair],
    names: Sequence[str],
    change: Callable[[OfPair, OfPair, tuple[Ints, Ints]], dict[str, Any]],
) -> list[dict[str, Any]]:
    """Pairs of one recording alone, and those of which an array differs, with the change from a to b. The
    change is at the lines that both have."""
    out: list[dict[str, Any]] = []
    for stage, pair in dict.fromkeys([*of_a, *of_b]):
        row = {"stage": stage, "pair": pair}
        one, other = of_a.get((stage, pair)), of_b.get((stage, pair))
        if one is None or other is None:
            out.append(row | {"only_in": "b" if one is None else "a"})
        elif not all(
            np.array_equal(getattr(one, name), getattr(other, name), equal_nan=True) for name in names
        ):
            _, at_a, at_b = np.intersect1d(one.line, other.line, return_indices=True)
            out.append(row | change(one, other, (at_a, at_b)))
    return out
