"""What differs between the moves of two recordings' frames, where their poses aren't recorded."""

from __future__ import annotations

from typing import Any

import numpy as np

from geomosaic.arrays import Floats
from geomosaic.recording.file.model import Recording


def offsets(a: Recording, b: Recording) -> list[dict[str, Any]]:
    """For each stage that moved frames: by how much further b moved each, and the rounds of both."""
    moved_a, moved_b = _moves_m(a), _moves_m(b)
    out = []
    for stage in dict.fromkeys([*moved_a, *moved_b]):
        rounds_a, of_a = moved_a.get(stage, (0, {}))
        rounds_b, of_b = moved_b.get(stage, (0, {}))
        frames = []
        for frame in dict.fromkeys([*of_a, *of_b]):
            if frame not in of_a or frame not in of_b:
                frames.append({"frame": frame, "only_in": "a" if frame in of_a else "b"})
            elif not np.array_equal(of_a[frame], of_b[frame], equal_nan=True):
                east_m, north_m = np.nan_to_num(of_b[frame] - of_a[frame]).tolist()
                frames.append({"frame": frame, "d_east_m": east_m, "d_north_m": north_m})
        frames.sort(key=_badness, reverse=True)
        if frames or rounds_a != rounds_b:
            lengths = [np.hypot(f["d_east_m"], f["d_north_m"]) for f in frames if "d_east_m" in f]
            out.append(
                {
                    "stage": stage,
                    "rounds": [rounds_a, rounds_b],
                    "largest_m": float(max(lengths, default=0.0)),
                    "frames": frames,
                }
            )
    return out


def _badness(frame: dict[str, Any]) -> tuple[bool, float]:
    """Frames of one run alone before all others, then those moved farthest."""
    return "only_in" in frame, float(np.hypot(frame.get("d_east_m", 0.0), frame.get("d_north_m", 0.0)))


def _moves_m(recording: Recording) -> dict[str, tuple[int, dict[str, Floats]]]:
    """By stage: the number of rounds, and each frame's moves summed (east, north)."""
    out: dict[str, tuple[int, dict[str, Floats]]] = {}
    for offsets in recording.rounds:
        count, sums = out.get(offsets.stage, (0, {}))
        for frame, move in zip(offsets.frames, offsets.moves_m, strict=True):
            sums[frame] = sums.get(frame, np.zeros(2)) + move
        out[offsets.stage] = count + 1, sums
    return out
