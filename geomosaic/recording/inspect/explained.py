"""Wrong headings, turned images and wrong positions of a run, each with its probability."""

from __future__ import annotations

from collections.abc import Iterator
from collections.abc import Set as AbstractSet
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from geomosaic.arrays import Floats
from geomosaic.constants import MEDIAN_LENGTH
from geomosaic.matching.explanations import (
    WRONG,
    HeadingEvidence,
    explained,
    placed_by_pairs,
    usual_angle,
    wrong_positions,
)
from geomosaic.placement.prior import COURSE_YAW_SD_DEG, YAW_LIES_DEG, smooth_courses_deg
from geomosaic.quality.ranking import headings_off_deg
from geomosaic.recording.file.model import FigureTable, Recording

TURNED: Final = "frame-turned"
HEADING: Final = "yaw-wrong"
POSITION: Final = "position-wrong"
EXPLAINED: Final = frozenset((TURNED, HEADING, POSITION))
"""Codes of the faults that are compared with each other."""
_HALF_TURNS = (True, False, True, False)
SURE, LIKELY = 0.99, 0.5


@dataclass(frozen=True)
class Cause:
    """A fault of a frame, how probable it is, and by how much the tag is off: degrees, or metres."""

    code: str
    frame: str
    probability: float
    off: float


def causes(
    recording: Recording, accused: AbstractSet[tuple[str, str]], frames: list[dict[str, Any]]
) -> list[Cause]:
    """The likeliest explanation of each frame that the run names, or whose tags don't fit; both faults of a
    frame that has two. Empty without the tables of placed and adjusted frames.

    Args: accused: codes and names of frames by the run's warnings; frames: their figures.
    """
    placed, adjusted = (recording.table(name) for name in ("frames.placed", "frames.adjusted"))
    if not placed.row or placed.row != adjusted.row:
        return []
    by_name = {f["frame"]: f for f in frames}
    mine = [by_name.get(name, {}) for name in adjusted.row]
    shares_placed = placed_by_pairs(np.array([f.get("pairs_tied") or 0 for f in mine]))
    return [
        *_of_headings(placed, adjusted, shares_placed, accused),
        *_of_positions(placed, adjusted, shares_placed, accused),
    ]


def _of_headings(
    placed: FigureTable, adjusted: FigureTable, shares_placed: Floats, accused: AbstractSet[tuple[str, str]]
) -> Iterator[Cause]:
    """Wrong headings and turned images."""
    names, found_sd = adjusted.row, adjusted.column("sd_yaw_deg")
    given, found, given_sd = (
        placed.column("yaw_deg"), adjusted.column("yaw_deg"), placed.column("sd_yaw_deg"),
    )  # fmt: skip
    given = np.where(given_sd < COURSE_YAW_SD_DEG - 1e-9, given, np.nan)
    off = np.radians(given - found)
    if ("headings-off", "") in accused and np.isfinite(off).any():
        given = given - np.degrees(usual_angle(off[np.isfinite(off)]))
    place = np.column_stack([adjusted.column("east_m"), adjusted.column("north_m")])
    sd_deg = np.hypot(np.maximum(YAW_LIES_DEG / 4.0, given_sd), np.nan_to_num(found_sd))
    possible = np.tile(_HALF_TURNS, (len(names), 1))
    possible[[(TURNED, name) in accused for name in names]] = True
    course = smooth_courses_deg(place)
    tags, images, courses, sd_rad = (np.radians(v) for v in (given, found, course, sd_deg))
    evidence = HeadingEvidence(tags, images, courses, sd_rad, possible)
    shares = explained(evidence).reshape(len(names), 8)
    for i, name in enumerate(names):
        best = int(shares[i].argmax())
        if best == 0:
            if not accused & {(TURNED, name), (HEADING, name)}:
                continue
            best = 1 + int(shares[i, 1:].argmax())
        quarters = best % 4
        off_deg = float(abs(headings_off_deg(found[i] + 90.0 * quarters, given[i])))
        if quarters:
            turned = float(shares[i, [quarters, WRONG + quarters]].sum())
            yield Cause(TURNED, name, turned * shares_placed[i], off_deg)
        if best >= WRONG:
            yield Cause(HEADING, name, float(shares[i, WRONG:].sum()) * shares_placed[i], off_deg)


def _of_positions(
    placed: FigureTable, adjusted: FigureTable, shares_placed: Floats, accused: AbstractSet[tuple[str, str]]
) -> Iterator[Cause]:
    """Wrong positions, of those that the run names."""
    names = adjusted.row
    moved = np.column_stack([adjusted.column(f"moved_{axis}_m") for axis in "en"])
    if not np.isfinite(moved).all(axis=1).any():
        return
    off_m = np.linalg.norm(moved - np.nanmedian(moved, axis=0), axis=1)
    scatter_m = float(np.nanmedian(off_m)) / MEDIAN_LENGTH
    stated_m, found_m = placed.column("sd_e_m"), np.nan_to_num(adjusted.column("sd_e_m"))
    sd_m = np.hypot(np.fmin(stated_m, scatter_m), found_m)
    place = np.column_stack([adjusted.column("east_m"), adjusted.column("north_m")])
    reach_m = max(float(np.linalg.norm(np.ptp(place, axis=0))), float(np.nanmax(off_m)))
    probability = wrong_positions(off_m, sd_m, reach_m) * shares_placed
    for i, name in enumerate(names):
        if (POSITION, name) in accused:
            yield Cause(POSITION, name, float(probability[i]), float(off_m[i]))


def how_sure(probability: float) -> str:
    """A probability in words: sure from 99 % up, likely from 50 %, else unsure; with its figure."""
    word = "sure" if probability >= SURE else "likely" if probability >= LIKELY else "unsure"
    percent = np.floor(1000.0 * probability) / 10.0
    return f"{word}: {'over 99.9' if percent >= 99.9 else f'{percent:.1f}'} %"
