"""The rows of results that bench_speed writes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from tools.bench.bench_speed_table import MOSAIC_STAGES, MOST_MB, MOST_OF_FLOOR, Result
from tools.bench.peers.peer import PEERS
from tools.bench.result_rows import ResultRow, RowKind
from tools.docs.results_page import FAST

NAMES = {"OpenCV Stitcher, SCANS": "OpenCV's Stitcher"}
"""What a row calls a peer, where it is not the peer's own name."""
ROWS = {
    "whole": RowKind(
        FAST,
        "{frames_of_size}, over the floor",
        f"{MOST_OF_FLOOR['whole']:g}",
        "{ratio:.2f} ({seconds:.1f} s)",
    ),
    "mosaic": RowKind(
        FAST,
        "{frames}: composition and COG alone, over the floor",
        f"{MOST_OF_FLOOR['mosaic with COG']:g}",
        "{ratio:.2f}",
    ),
    "memory": RowKind(
        FAST,
        "{frames}: peak memory",
        f"{MOST_MB:.0f} MB",
        "{peak_mb:.0f} MB",
    ),
    **{
        peer.name: RowKind(
            FAST,
            f"{{frames}}: {NAMES.get(peer.name, peer.name)}{{used}}",
            "slower",
            "{figures}",
            measured=("used",),
        )
        for peer in PEERS
    },
}


@dataclass(frozen=True)
class Measured:
    """The whole command on a flight: the flight's name, the same with the size of its frames, seconds."""

    name: str
    name_of_size: str
    frames: int
    floor_s: float
    stages_s: Mapping[str, float]
    wall_s: float
    peak_mb: float


def result_rows(found: Measured, ours: Result, peers: Sequence[Result]) -> list[ResultRow]:
    """Against the floor, and a row for each peer that made a mosaic."""
    whole = found.wall_s / found.floor_s
    mosaic = sum(found.stages_s.get(stage, 0.0) for stage in MOSAIC_STAGES) / found.floor_s
    name = {"frames": found.name}
    rows = [
        ROWS["whole"].row(
            whole <= MOST_OF_FLOOR["whole"],
            frames_of_size=found.name_of_size,
            ratio=whole,
            seconds=found.wall_s,
        ),
        ROWS["mosaic"].row(mosaic <= MOST_OF_FLOOR["mosaic with COG"], ratio=mosaic, **name),
        ROWS["memory"].row(found.peak_mb <= MOST_MB, peak_mb=found.peak_mb, **name),
    ]
    for peer in peers:
        if peer.failed:
            continue
        figures, used = peer.figures, int(peer.figures["frames_used"])
        text = f"{figures['wall_s']:.1f} s, "
        text += f"SSIM {figures['ssim']:.3f}" if "ssim" in figures else f"{figures['peak_mb']:.0f} MB"
        few = f" (uses {used})" if used < found.frames else ""
        slower = figures["wall_s"] > ours.figures["wall_s"]
        rows.append(ROWS[peer.name].row(slower, used=few, figures=text, **name))
    return rows
