"""The tables of bench_speed: what is measured, what is wanted of it, and who is ahead."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

MOSAIC_STAGES = ("mosaic.seams", "mosaic.compose", "export.cog")
"""From a solved block to the written mosaic."""
MOST_OF_FLOOR = {"whole": 2.5, "mosaic with COG": 1.3}
MOST_MB = 1500.0


@dataclass(frozen=True)
class Column:
    """One figure that programs are compared by: its key, digits, and whether more of it is better."""

    key: str
    title: str
    digits: int
    more: bool = False


COLUMNS = (
    Column("wall_s", "time, s", 1),
    Column("peak_mb", "memory, MB", 0),
    Column("frames_used", "frames used", 0, more=True),
    Column("area_m2", "ground shown, m²", 0, more=True),
    Column("ssim", "SSIM", 4, more=True),
    Column("after_px", "displacement after similarity, px", 3),
    Column("jumps_px", "jumps 99 %, px", 2),
    Column("absolute_m", "absolute, m", 2),
    Column("found", "patches found", 2, more=True),
    Column("steps_grey", "colour steps 99 %, grey", 2),
)
ROUNDED_OFF = {"area_m2": 0.02}
"""Shares by which a figure may be behind and is still the same: the rim of a mosaic is cut by taste."""


@dataclass(frozen=True)
class Result:
    """What a program made of a flight. figures: by the keys of COLUMNS. failed: why there are none."""

    name: str
    figures: Mapping[str, float] = field(default_factory=dict)
    failed: str = ""


def behind(ours: Mapping[str, float], peer: Mapping[str, float]) -> list[str]:
    """Names of the columns in which a peer is better; of columns that only one has, the other is worse."""
    found = []
    for column in COLUMNS:
        mine, theirs = (f.get(column.key, math.nan) for f in (ours, peer))
        if math.isnan(theirs):
            continue
        sign = -1.0 if column.more else 1.0
        slack = ROUNDED_OFF.get(column.key, 0.0) * abs(theirs)
        if math.isnan(mine) or sign * mine > sign * theirs + slack:
            found.append(column.title.partition(",")[0])
    return found


def side_by_side(ours: Result, peers: Sequence[Result]) -> list[str]:
    """A line a program, with what we are behind in; columns that nobody has are left out."""
    results = [ours, *peers]
    columns = [c for c in COLUMNS if any(c.key in r.figures for r in results)]
    lines = [f"| program | {' | '.join(c.title for c in columns)} | |", "|---" * (len(columns) + 2) + "|"]
    for result in results:
        cells = [f"{result.figures[c.key]:.{c.digits}f}" if c.key in result.figures else "" for c in columns]
        verdict = ""
        if result.failed:
            verdict = result.failed
        elif result is not ours:
            better = behind(ours.figures, result.figures)
            verdict = f"MISSED: {', '.join(better)}" if better else "ok"
        lines.append(f"| {result.name} | {' | '.join(cells)} | {verdict} |")
    return lines


def against_floor(
    floor: Mapping[str, float],
    stages_s: Mapping[str, float],
    wall_s: float,
    processor_s: float,
    peak_mb: float,
) -> list[str]:
    """Seconds of every stage and what they are of the floor; and what is wanted.

    Args: floor: of `bench_speed_floor`.
    """
    least = floor["whole_s"]
    lines = ["| | s | of the floor | |", "|---|---:|---:|---|"]

    def row(name: str, seconds: float, verdict: str = "") -> None:
        lines.append(f"| {name} | {seconds:.1f} | {seconds / least:.2f} | {verdict} |")

    row("floor: decoded and warped", floor["warp_s"])
    row("floor: written", floor["cog_s"])
    row("floor", least)
    for stage, seconds in stages_s.items():
        if seconds >= 0.05:
            row(stage, seconds)
    mosaic_s = sum(stages_s.get(stage, 0.0) for stage in MOSAIC_STAGES)
    for name, seconds in (("mosaic with COG", mosaic_s), ("whole", wall_s)):
        most = MOST_OF_FLOOR[name]
        row(name, seconds, f"{'ok' if seconds <= most * least else 'MISSED'}: at most {most:g}")
    row("whole, of processors", processor_s)
    verdict = f"{'ok' if peak_mb <= MOST_MB else 'MISSED'}: at most {MOST_MB:.0f} MB"
    lines.append(f"| peak memory | {peak_mb:.0f} MB | | {verdict} |")
    return lines


def missed(lines: Sequence[str]) -> bool:
    """Whether a line of a table says so."""
    return any("| MISSED" in line for line in lines)
