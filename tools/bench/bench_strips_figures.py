"""The figures of Cheng et al. 2018, drawn anew on a simulated scene.

    python -m tools.bench.bench_strips_figures --out docs/results

Figure 8: offsets of one overlap's first 64 segments, without and with enhancement. Figure 7: matched points
of one piece of that overlap, before and after. Figures 3, 5, 9: a seam at 100 % by whole_scene,
piecewise_linear and joint, without blending.
"""

from __future__ import annotations

import argparse
import os
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import cv2
import numpy as np

from geomosaic.ccd.layout import image_space_layout
from geomosaic.ccd.methods import METHODS
from geomosaic.ccd.model import CcdSettings, StripOffsets
from geomosaic.ccd.overlaps import StripFiles, Strips
from geomosaic.ccd.radiometry import radiometry
from geomosaic.ccd.sift_chains import matched_points, segments
from geomosaic.composition.strip_compose import PlacedStrips, StripOptions, compose_strips
from geomosaic.doors.raster import OWN, open_raster
from geomosaic.export.offsets_csv import read_true_offsets
from geomosaic.report.plots import Axis, Series, line_plot
from geomosaic.survey.strips import read_geometry
from geomosaic_simulate.strip_overlaps import simulate_overlaps, strips_in_memory
from geomosaic_simulate.strip_plan import StripPlan
from geomosaic_simulate.strips import simulate_strips

SEGMENTS, SEGMENT_LINES = 64, 256
LOW = StripPlan(seed=18, width_px=4096, lines=SEGMENTS * SEGMENT_LINES + 2114, low_contrast_share=0.4)
SEAM = StripPlan(seed=5, ccds=3, width_px=512, lines=8192, contrast=0.25)


def quiet(done: int, total: int) -> None:
    """No progress."""


def parameters(strips: Strips, truth: Any, pair: int) -> str:
    """Figure 8: dline of each segment's own points, and the truth."""
    settings = CcdSettings(segment_lines=SEGMENT_LINES)
    x = np.arange(SEGMENTS) + 1.0
    drawn = []
    for name, enhance in (("without enhancement", False), ("with enhancement", True)):
        found = segments(strips, replace(settings, enhance=enhance), quiet)[pair]
        there = found.points >= 4
        drawn.append(Series(name, x, np.where(there, found.offset_px[:, 1], np.nan)))
    drawn.append(Series("truth", x, truth[(found.first + found.stop) // 2], marks=False))
    return line_plot(drawn, Axis("segment"), Axis("offset along track", "px"), label="offsets by segment")


def points(strips: Strips, pair: int) -> np.ndarray:
    """Figure 7: the piece of the overlap where enhancement helps most; its points joined by lines."""
    settings, best, found = CcdSettings(), 0.0, strips.overlap(pair, 0, SEGMENT_LINES)
    for top in range(0, SEGMENTS * SEGMENT_LINES, SEGMENT_LINES):
        piece = strips.overlap(pair, top, top + SEGMENT_LINES)
        before, after = (len(matched_points(piece, strips.geometry, settings, on)) for on in (False, True))
        if (after - before) / (before + 5) > best:
            best, found = (after - before) / (before + 5), piece
    piece = found
    return np.hstack([drawn_points(piece, strips, settings, enhance) for enhance in (False, True)])


def drawn_points(piece: Any, strips: Strips, settings: CcdSettings, enhance: bool) -> np.ndarray:
    """Both sides of an overlap, and lines between the points found."""
    found = matched_points(piece, strips.geometry, settings, enhance)
    sides = []
    for side in (piece.left.astype(float), piece.right.astype(float)):
        low, high = np.percentile(side, [0.5, 99.5]) if enhance else (0, 2**strips.geometry.bit_depth)
        sides.append(np.clip((side - low) / (high - low) * 255, 0, 255).astype(np.uint8))
    gap = 40
    image = np.hstack([sides[0], np.full((len(sides[0]), gap), 255, np.uint8), sides[1]])
    colour = cv2.cvtColor(
        cv2.resize(image, None, fx=2, fy=2, interpolation=cv2.INTER_NEAREST), cv2.COLOR_GRAY2BGR
    )
    width = sides[0].shape[1]
    shift = strips.geometry.overlap_px - strips.geometry.read_px
    for (col, line), (dcol, dline) in zip(found.left_px, found.moved_px, strict=True):
        line -= piece.first_line
        a = 2 * col, 2 * line
        b = 2 * (col + dcol + shift + width + gap), 2 * (line + dline)
        cv2.line(colour, *(tuple(round(v) for v in p) for p in (a, b)), (40, 160, 255), 1, cv2.LINE_AA)
    cv2.rectangle(colour, (0, 0), (170, 34), (255, 255, 255), -1)
    cv2.putText(
        colour, f"{len(found)} points", (8, 24), cv2.FONT_HERSHEY_SIMPLEX, 0.7, (0, 0, 0), 1, cv2.LINE_AA
    )
    return np.pad(colour, ((0, 0), (0, 20), (0, 0)), constant_values=255)


def seams(folder: Path) -> np.ndarray:
    """One place of a seam at 100 %, by three methods: where the whole scene's offset is the most wrong."""
    made = simulate_strips(folder / "scene", SEAM, scene=False)
    geometry = read_geometry(made.geometry)
    crops: list[np.ndarray] = []
    at = 0
    for method in ("whole_scene", "piecewise_linear", "joint"):
        with StripFiles(geometry) as strips:
            offsets = StripOffsets(method, METHODS[method](strips, CcdSettings(), quiet))
            greys = radiometry(strips, offsets, quiet)
            left = strips.overlap(0).left.astype(float)
        layout = image_space_layout(geometry, offsets)
        raster = folder / f"{method}.tif"
        compose_strips(PlacedStrips(geometry, layout, greys), raster, StripOptions("hard"))
        if method == "whole_scene":
            at = worst_place(read_true_offsets(made.true_offsets, geometry)[0], offsets.pairs[0], left)
        row = round(at + 0.5 * SEAM.row_separation_lines - layout.first_line)
        seam = round(layout.seams_px[0])
        with open_raster(raster, OWN) as scene:
            crops.append(scene.read(1)[row - 150 : row + 150, seam - 150 : seam + 150].astype(float))
    low, high = np.percentile(np.stack(crops), [1, 99])
    shown = [np.pad(np.clip((c - low) / (high - low) * 255, 0, 255), 4, constant_values=255) for c in crops]
    return np.hstack(shown).astype(np.uint8)


def worst_place(truth: np.ndarray, found: Any, left: np.ndarray) -> int:
    """The line with the strongest edges among those that are off by the most."""
    lines = slice(400, len(truth) - 2600)
    off = np.hypot(found.dcol_px - truth[:, 0], found.dline_px - truth[:, 1])[lines]
    edges = np.abs(np.diff(cv2.GaussianBlur(left, (0, 0), 3), axis=0, append=0)).max(axis=1)[lines]
    edges = cv2.blur(edges[:, None], (1, 101))[:, 0]
    return int(np.argmax(np.where(off > np.quantile(off, 0.9), edges, 0.0))) + 400


def main() -> None:
    """Draws all."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("out/bench-strips"))
    out = parser.parse_args().out
    out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        cv2.imwrite(str(out / "strips_seam.png"), seams(Path(folder)))
    geometry, pairs = simulate_overlaps(LOW)
    strips = strips_in_memory(geometry, [(p.left, p.right) for p in pairs])
    (out / "strips_segments.svg").write_text(parameters(strips, pairs[0].truth.dline_px, 0), encoding="utf-8")
    cv2.imwrite(str(out / "strips_points.png"), points(strips, 0))


if __name__ == "__main__":
    main()
