"""How a mosaic compares with a reference: figures in words, likeness as an image."""

from __future__ import annotations

import cv2
import numpy as np

from geomosaic.quality.compare import Comparison
from geomosaic.report.glance import data_uri
from geomosaic.report.numbers import percent, short, signed, whole


def ssim_image(comparison: Comparison) -> str:
    """A data URI of the SSIM cells: dark blue 0 or less, yellow 1, transparent where nothing is valid."""
    cells = comparison.ssim_cells
    known = np.isfinite(cells)
    level = np.where(known, np.clip(cells, 0.0, 1.0) * 255.0, 0.0).astype(np.uint8)
    coloured = np.dstack(
        [cv2.applyColorMap(level, cv2.COLORMAP_CIVIDIS), np.where(known, 255, 0).astype(np.uint8)]
    )
    if max(coloured.shape) > 1200:
        reduce = 1200 / max(coloured.shape)
        coloured = cv2.resize(coloured, None, fx=reduce, fy=reduce, interpolation=cv2.INTER_AREA)
    return data_uri("png", coloured)


def comparison_rows(c: Comparison) -> list[tuple[str, str, str]]:
    """The figures: name, value, what it means."""
    f, s = c.figures, c.figures.similarity
    turn = signed(float(np.degrees(s.rotation_rad)) * 3600.0, "″")
    return [
        (
            "absolute RMSE",
            f"{short(f.absolute_rmse_m, 'm')} ({short(f.absolute_rmse_m / c.gsd_m, 'px')})",
            "root mean square length of the displacements: how far things lie from their true place",
        ),
        ("90 % within", short(f.ce90_m, "m"), "90 % of the displacements are shorter"),
        (
            "mean displacement",
            f"{signed(f.mean_east_m, 'm')} east, {signed(f.mean_north_m, 'm')} north",
            "mosaic minus reference; what a single shift would fix",
        ),
        (
            "RMSE after similarity",
            f"{short(f.after_similarity_px, 'px')} ({short(f.after_similarity_m, 'm')})",
            f"what is left after the best shift, turn and scale: the mosaic in itself. "
            f"Scale {signed(1e6 * (s.scale - 1.0), 'ppm')}, turn {turn}",
        ),
        (
            "jump, 99 %",
            short(f.jump_99_px, "px"),
            "99 % of the differences between touching patches are smaller: what an eye sees at seams",
        ),
        (
            "patches measured",
            f"{whole(f.measured)} of {whole(f.asked)} ({percent(f.share_measured)})",
            f"patches of {c.patch_px} px every {c.step_px} px, searched within {c.search_px} px",
        ),
        *_ssim_rows(c),
        ("overlap", percent(c.overlap_share), "share of the mosaic that the reference covers"),
    ]


def _ssim_rows(c: Comparison) -> list[tuple[str, str, str]]:
    """As the two lie, and after registration: the first falls with a shift of a pixel that nobody sees."""
    similarities = [("SSIM as it lies", c.ssim, "falls with any shift against the reference")]
    if c.ssim_registered is not None:
        similarities.insert(
            0, ("SSIM", c.ssim_registered, "after registration: the best shift, turn and scale taken out")
        )
    return [
        (
            name,
            short(terms.ssim),
            f"{words}; luminance {short(terms.luminance)}, contrast {short(terms.contrast)}, "
            f"structure {short(terms.structure)}",
        )
        for name, terms, words in similarities
    ]
