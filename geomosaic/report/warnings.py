"""A run's warnings as people read them: by how much they matter, equal ones once, with their number."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

_MOST_NAMES: Final = 500
_SEVERE: Final = frozenset(
    (
        "bundle-failed", "ccd-missing", "frame-damaged", "frame-flung", "looks-past-ground",
        "mosaic-stretched", "not-placed", "pose-not-determined", "positions-all-alike",
        "positions-contradicted", "positions-mirrored", "positions-out-of-step",
        "scale-doubtful", "scene-misplaced", "self-calibration-failed", "separate-part",
    )
)  # fmt: skip
_ROUTINE: Final = frozenset(
    (
        "attitude-of-aircraft", "bands-left-out", "camera-assumed", "camera-scaled",
        "control-columns-ignored",
        "dem-datum-assumed", "dem-unused", "frame-copy", "frame-other-bands", "frame-other-camera",
        "frame-take-off",
        "frame-turned", "geoid-assumed", "headings-off", "height-above-take-off", "height-by-neighbours",
        "height-datum-assumed", "height-datum-unknown", "height-estimated",
        "height-unit-assumed", "image-edited", "model-chosen", "order-by-name",
        "pos-attitude-convention", "pos-columns-ignored", "pos-crs-unused", "pos-header-assumed",
        "readout-by-model",
        "readout-by-tag", "reference-datum-assumed", "search-narrowed", "surface-coarse", "yaw-wrong",
    )
)  # fmt: skip
"""What was assumed or corrected by the run itself, for the record."""
_IN_VERDICT: Final = frozenset(("verdict-good", "verdict-doubtful", "verdict-bad"))
"""The page begins with it."""


@dataclass(frozen=True)
class ReportedWarning:
    """One text: its code in words, how often it was said, of which frames (the first of them)."""

    code: str
    text: str
    count: int
    frames: list[str]


@dataclass(frozen=True)
class Warnings:
    """severe: what the map suffers from; look: what may matter; routine: for the record. frames: how often
    each is named in the first two."""

    severe: list[ReportedWarning]
    look: list[ReportedWarning]
    routine: list[ReportedWarning]
    frames: Mapping[str, int]

    @property
    def number(self) -> int:
        """Of the warnings, equal ones counted each, without routine."""
        return sum(listed.count for listed in (*self.severe, *self.look))


def warnings_of(summary: Mapping[str, Any]) -> Warnings:
    """Those of run.json, the most frequent last within each group, so that none hides another."""
    given: Sequence[Mapping[str, Any]] = summary.get("warnings", [])
    equal: dict[tuple[str, str], list[str]] = {}
    frames: dict[str, int] = {}
    for warning in given:
        code, text, frame = (str(warning.get(k) or "") for k in ("code", "text", "frame"))
        if code not in _IN_VERDICT:
            equal.setdefault((code, text), []).append(frame)
            if frame and code not in _ROUTINE:
                frames[frame] = frames.get(frame, 0) + 1
    groups: dict[str, list[ReportedWarning]] = {"severe": [], "look": [], "routine": []}
    for (code, text), of in sorted(equal.items(), key=lambda item: len(item[1])):
        group = "severe" if code in _SEVERE else "routine" if code in _ROUTINE else "look"
        names = [name for name in of if name]
        groups[group].append(ReportedWarning(code.replace("-", " "), text, len(of), names[:_MOST_NAMES]))
    return Warnings(**groups, frames=frames)
