"""How a mosaic compares with a reference: figures in words, displacements as a map, likeness as an image."""

from __future__ import annotations

import cv2
import numpy as np

from geomosaic.quality.compare import Comparison
from geomosaic.report.glance import data_uri
from geomosaic.report.map_plots import vector_map
from geomosaic.report.svg import short


def comparison_map(comparison: Comparison, after_similarity: bool) -> str:
    """The displacement vectors, as measured or as the best similarity leaves them, in pixels."""
    at, vector = comparison.vectors_m[:, :2], comparison.vectors_m[:, 2:]
    label = "displacement of the mosaic against the reference"
    if after_similarity:
        s = comparison.figures.similarity
        if not np.isfinite(s.scale):
            return ""
        about = (at - [s.centre_east_m, s.centre_north_m]) @ [1.0, 1.0j]
        turned = (s.scale * np.exp(1j * s.rotation_rad) - 1.0) * about
        vector = vector - np.stack([turned.real, turned.imag], axis=-1) - [s.shift_east_m, s.shift_north_m]
        label += ", after the best similarity"
    return vector_map(at, vector, unit="px", unit_per_m=1.0 / comparison.gsd_m, label=label)


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
    turn = f"{np.degrees(s.rotation_rad) * 3600:+.0f}″" if np.isfinite(s.rotation_rad) else "–"
    return [
        (
            "absolute RMSE",
            f"{short(f.absolute_rmse_m, 'm')} ({short(f.absolute_rmse_m / c.gsd_m, 'px')})",
            "root mean square length of the displacements: how far things lie from their true place",
        ),
        ("CE90", short(f.ce90_m, "m"), "90 % of the displacements are shorter"),
        (
            "mean displacement",
            f"{f.mean_east_m:+.3f} m east, {f.mean_north_m:+.3f} m north",
            "mosaic minus reference; what a single shift would mend",
        ),
        (
            "RMSE after similarity",
            f"{short(f.after_similarity_px, 'px')} ({short(f.after_similarity_m, 'm')})",
            f"what is left after the best shift, turn and scale: the mosaic in itself. "
            f"Scale {s.scale:.6f}, turn {turn}",
        ),
        (
            "jump, 99 %",
            short(f.jump_99_px, "px"),
            "99 % of the differences between touching patches are smaller: what an eye sees at seams",
        ),
        (
            "patches measured",
            f"{f.measured:,} of {f.asked:,} ({100 * f.share_measured:.1f} %)",
            f"patches of {c.patch_px} px every {c.step_px} px, searched within {c.search_px} px",
        ),
        (
            "SSIM",
            short(c.ssim.ssim),
            f"luminance {short(c.ssim.luminance)}, contrast {short(c.ssim.contrast)}, "
            f"structure {short(c.ssim.structure)}",
        ),
        ("overlap", f"{100 * c.overlap_share:.1f} %", "share of the mosaic that the reference covers"),
    ]
