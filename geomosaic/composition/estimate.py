"""What a mosaic will ask for, reported before the work: its size, room on the disk, memory and time."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from geomosaic.composition.model import OutputGrid
from geomosaic.constants import sourced, tuned
from geomosaic.errors import InputError
from geomosaic.matching.tracks import MOST_TIED
from geomosaic.surface.pyramid import MOST_CELLS

Range = tuple[float, float]


@dataclass(frozen=True)
class Rate:
    """What one unit of work takes: least and most, why so, and where it was measured."""

    least: float
    most: float
    unit: str
    reason: str
    source: str


_HERE: Final = "18 frames of 9 MP, 128 pairs, 44 MP filled, by processor time of one process; widened"
KEYPOINTS: Final = Rate(
    0.2, 0.6, "core s/MP", "SIFT, places in the pixels: 0.25; frames over 3000 px are halved", _HERE
)
PAIRS: Final = Rate(0.015, 0.1, "core s/pair", "descriptors compared and checked: 0.02", _HERE)
SOLVE: Final = Rate(0.2, 2.0, "s/frame", "bundle, by how many points and rounds it takes: 0.5", _HERE)
COMPOSE: Final = Rate(
    0.2, 0.8, "core s/MP filled", "tones, seams, each frame that sees a pixel resampled, packing: 0.3", _HERE
)
WRITE: Final = Rate(0.01, 0.1, "core s/MP filled", "the packed tiles are copied: 0.015", _HERE)
SURFACE: Final = Rate(
    13.0,
    80.0,
    "core s/million cells",
    "a surface matched, what it hides found, frames projected onto it",
    "18 frames of 9 MP in cells of 4 ground pixels: 27; widened",
)
_SCENE: Final = "8 strips of 4,096 x 35,000 lines on two cores by joint: 0.074 s/MP, 0.91 GB; widened"
STRIPS: Final = Rate(0.05, 0.5, "s/MP", "offsets to overviews; SIFT chains take several times joint", _SCENE)
ON_MAP: Final = Rate(
    0.1, 0.5, "s/MP", "the scene warped by its RPC, and packed",
    "4 strips of 512 x 4,096 lines on relief: 3.2 s of processor for 8 MP, on two cores; widened",
)  # fmt: skip
SCENE_MEMORY: Final = Rate(8e3, 30e3, "bytes/column", "blocks of rows at work, windows of offsets", _SCENE)
PACKED: Final = Rate(0.3, 1.1, "share of the pixels' bytes", "lossless, with a third for overviews", _HERE)
PARTS: Final = Rate(
    1.2,
    2.2,
    "share of the pixels' bytes",
    "what frames give and blends need of their neighbours, with the mosaic until it is written",
    "flights of 28, 18 and 19 frames: 1.37, 1.73 and 1.47",
)
MEMORY: Final = Rate(
    0.7, 1.5, "share of the sum", "of what frames give, windows at work and keypoints", _HERE
)
_LONGEST_MATCHED_PX = sourced(3000, "px", "side kept for matching", "default of matching.sift.longest_px")
_SIFT_BYTES_PER_PX = sourced(130.0, "bytes/px", "six float images, doubled", "Lowe 2004, 3: 6 x 4 x 4 x 4/3")
_PROGRAM_BYTES = tuned(250e6, "bytes", "of a process's libraries: less states the memory too low")
_WINDOW_BYTES = tuned(100e6, "bytes", "of a composing process's window: less states the memory too low")
_HALVES = sourced(1.0 / 4.0, "share", "kept halved: less states the space too low", "1 of 2 x 2 pixels")


_SOLVED_BYTES = sourced(600.0, "bytes/tied keypoint", "matched and adjusted", "2.4 million: 1.5 GB")
_TIED = sourced(2500, "keypoints/frame", "tied, at most", "1,000 frames of 6,000 keypoints each: 2,400")
_TIES_BYTES = sourced(2.5e6, "bytes/frame", "of keypoints and tie points", "1,000 frames of 0.3 MP: 2.6 GB")
_TIES_PX = sourced(0.3e6, "px", "of a frame that has so many; smaller ones have fewer", "1,000 such frames")
_FRAMES_BYTES = sourced(0.16, "bytes/px", "of reduced frames", "18 frames of 9 MP: 3.9 MB each, with ties")
_SURFACE_BYTES = sourced(128.0, "bytes/cell", "of a surface on disk", "18 frames: 360 MB for 2.9 million")


@dataclass(frozen=True)
class Before:
    """What the stages before composition take.

    core_s: seconds of one core, least and most. memory_bytes: of the whole run, without the windows at work.
    disk_bytes: on the disk.
    """

    core_s: Range
    memory_bytes: float
    disk_bytes: float


@dataclass(frozen=True)
class SizeEstimate:
    """A mosaic's size, and the least and the most of what it takes.

    filled_share: of the grid that frames cover; empty parts take neither room nor time. mosaic_gb: of
    mosaic.tif, which RUN/work has too, as the same file where the file system has hard links. parts_gb: there
    while it is composed, or a scene projected onto the map; scratch_gb: what else is.
    gsd_m: None for a scene without a map.
    """

    width_px: int
    height_px: int
    gsd_m: float | None
    filled_share: float
    scratch_gb: float
    mosaic_gb: Range
    memory_gb: Range
    minutes: Range
    parts_gb: Range = (0.0, 0.0)

    @property
    def disk_gb(self) -> Range:
        """All of it on the disk at once."""
        (least, most), (part, parts) = self.mosaic_gb, self.parts_gb
        return self.scratch_gb + least + part, self.scratch_gb + most + max(most, parts)

    def text(self) -> str:
        """One line for people."""
        at = "" if self.gsd_m is None else f" at {self.gsd_m:.3g} m"
        return (
            f"the mosaic will have about {self.width_px:,} x {self.height_px:,} px{at} and take "
            f"{room(self.disk_gb)} on the disk, {room(self.memory_gb)} of memory and {_minutes(self.minutes)}"
        )


@dataclass(frozen=True)
class FilledPixels:
    """The pixels of a grid: the share that images fill, and bytes of one. surface_cell_m: the side of the
    cells of a surface that is matched, None without one."""

    share: float
    pixel_bytes: int
    surface_cell_m: float | None = None


def estimate(grid: OutputGrid, of: FilledPixels, before: Before, threads: int) -> SizeEstimate:
    """Of a grid: what its pixels take, besides what comes before them."""
    pixels = float(grid.width_px) * float(grid.height_px)
    filled = of.share * pixels
    raw_gb = filled * of.pixel_bytes / 1e9
    of_surface = 0.0
    if of.surface_cell_m is not None:
        of_surface = min(filled * (grid.gsd_m / of.surface_cell_m) ** 2, MOST_CELLS)
    scratch = _HALVES * raw_gb + (before.disk_bytes + _SURFACE_BYTES * of_surface) / 1e9
    s = [
        before.core_s[k] + ((compose + write) * filled + surface * of_surface) / 1e6 / threads
        for k, (compose, write, surface) in enumerate(
            ((COMPOSE.least, WRITE.least, SURFACE.least), (COMPOSE.most, WRITE.most, SURFACE.most))
        )
    ]
    memory = before.memory_bytes / 1e9
    return SizeEstimate(
        width_px=grid.width_px,
        height_px=grid.height_px,
        gsd_m=grid.gsd_m,
        filled_share=of.share,
        scratch_gb=scratch,
        mosaic_gb=(PACKED.least * raw_gb, PACKED.most * raw_gb),
        parts_gb=(PARTS.least * raw_gb, PARTS.most * raw_gb),
        memory_gb=(MEMORY.least * memory, MEMORY.most * memory),
        minutes=(s[0] / 60.0, s[1] / 60.0),
    )


def estimate_scene(
    size_px: tuple[int, int], of: FilledPixels, max_gigapixels: float, *, on_map: bool = False
) -> SizeEstimate:
    """Of a scene of strips, and of its map if it is projected onto one; raises `InputError` where it would be
    larger than max_gigapixels. size_px: width and height."""
    width_px, height_px = size_px
    gigapixels = width_px * height_px / 1e9
    if gigapixels > max_gigapixels:
        raise InputError(
            f"the scene would have {width_px:,} x {height_px:,} px, {gigapixels:,.3g} gigapixels, "
            f"more than {max_gigapixels:g}",
            fix="check the strips' sizes and row_separation_lines, "
            f"or --set mosaic.strips.max_gigapixels={math.ceil(gigapixels)}",
        )
    pixels = of.share * width_px * height_px
    memory = 2.0 * _PROGRAM_BYTES + SCENE_MEMORY.least * width_px
    raw_gb = pixels * of.pixel_bytes / 1e9
    packed_gb = PACKED.least * raw_gb, PACKED.most * raw_gb
    least_s, most_s = STRIPS.least + on_map * ON_MAP.least, STRIPS.most + on_map * ON_MAP.most
    return SizeEstimate(
        width_px=width_px,
        height_px=height_px,
        gsd_m=None,
        filled_share=of.share,
        scratch_gb=0.0,
        mosaic_gb=packed_gb,
        parts_gb=(3.0 * packed_gb[0], 3.0 * packed_gb[1]) if on_map else (0.0, 0.0),
        memory_gb=(0.5e-9 * memory, (memory + SCENE_MEMORY.most * width_px) / 1e9),
        minutes=(least_s * pixels / 60e6, most_s * pixels / 60e6),
    )


def before_composing(
    sizes_px: list[tuple[int, int]], pairs: int, workers: int, memory_bytes: float
) -> Before:
    """What reading, matching and adjusting take.

    Args: sizes_px: of all frames; memory_bytes: that composing takes without the windows at work.
    """
    whole = np.array([float(w) * h for w, h in sizes_px])
    longest = np.array([max(size) for size in sizes_px])
    matched = whole / 4.0 ** np.ceil(np.log2(np.maximum(longest / _LONGEST_MATCHED_PX, 1.0)))
    s = [
        (keypoints * matched.sum() / 1e6 + of_pair * pairs) / workers + solve * len(sizes_px)
        for keypoints, of_pair, solve in (
            (KEYPOINTS.least, PAIRS.least, SOLVE.least), (KEYPOINTS.most, PAIRS.most, SOLVE.most),
        )
    ]  # fmt: skip
    matching = (workers if workers > 1 else 0) * _PROGRAM_BYTES
    matching += workers * _SIFT_BYTES_PER_PX * float(matched.max(initial=0.0))
    solving = _SOLVED_BYTES * min(_TIED * len(sizes_px), MOST_TIED)
    return Before(
        (s[0], s[1]),
        _PROGRAM_BYTES + matching + solving + memory_bytes + workers * _WINDOW_BYTES,
        _TIES_BYTES * float(np.minimum(1.0, whole / _TIES_PX).sum()) + _FRAMES_BYTES * float(whole.sum()),
    )


def room(range_gb: Range) -> str:
    """Gigabytes in words, in MB where they are few."""
    least, most = range_gb
    return f"{_from_to(range_gb)} GB" if most >= 1.0 else f"{_from_to((1e3 * least, 1e3 * most))} MB"


def _from_to(range_: Range) -> str:
    least, most = (f"{v:.2g}" if v < 10.0 else f"{v:,.0f}" for v in range_)
    return least if least == most else f"{least} to {most}"


def _minutes(range_: Range) -> str:
    least, most = range_
    if most < 2.0:
        return f"{_from_to((60.0 * least, 60.0 * most))} s"
    return f"{_from_to(range_)} min" if most < 180.0 else f"{_from_to((least / 60.0, most / 60.0))} hours"
