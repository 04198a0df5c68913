"""The rows of results that bench_surface writes."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from tools.bench.bench_surface_judge import SurfaceErrors
from tools.bench.bench_surface_roofs import FAR_PX, Roofs
from tools.bench.result_rows import ResultRow, RowKind, in_words, listed
from tools.docs.results_page import SURFACE

WANTED_NMAD_PX = {"ground": 1.2, "roofs": 1.5}
WANTED_OFF_1_M = {"edges": 0.25, "trees": 0.15}
SAME_SSIM, WORSE_SSIM = 1e-4, 0.005
"""Of a tile of the mosaic: what counts as no change, and as farther from the true ortho."""
_GROUND, _ROOFS = (f"{WANTED_NMAD_PX[name]:g} px" for name in ("ground", "roofs"))
_EDGES, _TREES = (f"{100 * WANTED_OFF_1_M[name]:.0f} %" for name in ("edges", "trees"))
_OFF, _SGBM = "off by more than 1 m", "(StereoSGBM: {rival} %)"
_STAGE = "time of the stage; memory of the run"
_S_MB = ("{most_s:.0f} s; {most_mb:.0f} MB", "{seconds:.1f} s; {peak_mb:.0f} MB")
_TILES = "tiles of the mosaic that change; farther from the true ortho than on the tie surface by"
ROWS = {
    "ground": RowKind(SURFACE, "ground, NMAD of {towns} towns", _GROUND, "{nmad} px"),
    "roofs": RowKind(SURFACE, "roofs, NMAD", _ROOFS, "{nmad} px"),
    "edges": RowKind(SURFACE, f"edges {_OFF} {_SGBM}", _EDGES, "{off} %", measured=("rival",)),
    "trees": RowKind(SURFACE, f"trees {_OFF} {_SGBM}", _TREES, "{off} %", measured=("rival",)),
    "corners": RowKind(SURFACE, "roof corners in the mosaic, RMSE", f"{FAR_PX:g} px", "{rmse} px"),
    "doubled": RowKind(SURFACE, "edges of roofs doubled in the mosaic", "none", "{doubled} %"),
    "ssim": RowKind(
        SURFACE,
        "SSIM of the mosaic, on the tie surface and on the dense surface",
        "",
        "{ties:.3f} and {dense:.3f}",
    ),
    "tiles": RowKind(
        SURFACE,
        f"towns {{seeds}}, `--surface auto`: {_TILES} {WORSE_SSIM} SSIM",
        "none farther",
        "{changed}, nearer by {gain}; {farther}",
    ),
    "small edges": RowKind(SURFACE, f"{{towns}} unseen towns: edges {_OFF}", _EDGES, "{off} %"),
    "small trees": RowKind(SURFACE, f"{{towns}} unseen towns: trees {_OFF}", _TREES, "{off} %"),
    "small corners": RowKind(
        SURFACE, "{towns} unseen towns: roof corners, RMSE", f"{FAR_PX:g} px", "{rmse} px"
    ),
    "one surface": RowKind(
        SURFACE,
        "brighton: odd against even frames, one surface, median and 90 %",
        "{most_median:g}, {most_p90:g} px",
        "{median_px:.2f}, {p90_px:.2f} px",
    ),
    "own surfaces": RowKind(
        SURFACE,
        "brighton: odd against even frames, own surfaces, median",
        "{most_median:g} px",
        "{median_px:.2f} px",
    ),
    "ngi": RowKind(SURFACE, "ngi: surface against the DEM, NMAD", "{wanted_px:g} px", "{nmad_px:.2f} px"),
    "real": RowKind(SURFACE, f"18 frames of 9 MP: {_STAGE}", *_S_MB),
    "large": RowKind(SURFACE, f"160 frames of 10 MP: {_STAGE}", *_S_MB),
}


@dataclass
class Town:
    """What was measured of a simulated town: classes of cells with their NMAD (ground px), those of
    StereoSGBM, houses of the mosaics by surface, and SSIM of tiles by surface."""

    seed: int
    nmad_px: dict[str, float] = field(default_factory=dict)
    cells: dict[str, SurfaceErrors] = field(default_factory=dict)
    rival: dict[str, SurfaceErrors] = field(default_factory=dict)
    houses: dict[str, Roofs] = field(default_factory=dict)
    tiles: dict[str, NDArray[np.float64]] = field(default_factory=dict)


def town_rows(towns: Sequence[Town], small: bool) -> list[ResultRow]:
    """The rows of towns of one size; those of roofs and of the rival only where these were measured."""
    if not towns:
        return []
    rows, count = [], {"towns": in_words(len(towns))}
    for name in [name for name in WANTED_NMAD_PX if not small and all(name in t.cells for t in towns)]:
        nmad = [t.nmad_px[name] for t in towns]
        rows.append(ROWS[name].row(max(nmad) <= WANTED_NMAD_PX[name], nmad=listed(nmad, ".2f"), **count))
    for name, most in WANTED_OFF_1_M.items():
        if not all(name in t.cells for t in towns):
            continue
        off = [t.cells[name].off_1_m for t in towns]
        fields = {"off": _percent(off), **count}
        if small:
            rows.append(ROWS[f"small {name}"].row(max(off) <= most, **fields))
        elif all(name in t.rival for t in towns):
            rival = _percent(t.rival[name].off_1_m for t in towns)
            rows.append(ROWS[name].row(max(off) <= most, rival=rival, **fields))
    if not all("dense" in t.houses for t in towns):
        return rows
    dense = [t.houses["dense"] for t in towns]
    rmse = [of.rmse_px for of in dense]
    corners = ROWS["small corners" if small else "corners"]
    rows.append(corners.row(max(rmse) <= FAR_PX, rmse=listed(rmse, ".2f"), **count))
    if not small:
        doubled = [of.doubled for of in dense]
        rows.append(ROWS["doubled"].row(not any(doubled), doubled=_percent(doubled)))
        ssim = {how: float(np.mean([t.houses[how].ssim for t in towns])) for how in ("ties", "dense")}
        rows.append(ROWS["ssim"].row(None, **ssim))
    return [*rows, tiles_row(towns)]


def tiles_row(towns: Sequence[Town]) -> ResultRow:
    """Tiles that the mosaic with roofs in place shows less like the truth than that on the tie surface."""
    gains = [gain_of(t, "auto") for t in towns]
    changed = [gain[np.abs(gain) > SAME_SSIM] for gain in gains]
    farther = [int((gain < -WORSE_SSIM).sum()) for gain in gains]
    worst = max(-float(gain.min()) for gain in gains)
    texts = {
        "seeds": _and(str(t.seed) for t in towns),
        "changed": _and(f"{c.size} of {g.size}" for c, g in zip(changed, gains, strict=True)),
        "gain": _and(f"{c.mean() if c.size else 0.0:.3f}" for c in changed),
        "farther": _and(map(str, farther)) + (f" (by {worst:.3f})" if any(farther) else ""),
    }
    return ROWS["tiles"].row(not any(farther), **texts)


def gain_of(town: Town, how: str) -> NDArray[np.float64]:
    """By how much SSIM each tile is nearer to the truth on this surface than on the tie surface."""
    gain = town.tiles[how] - town.tiles["ties"]
    return gain[np.isfinite(gain)]


def _percent(shares: Iterable[float]) -> str:
    return listed((100.0 * share for share in shares), ".1f")


def _and(words: Iterable[str]) -> str:
    *first, last = words
    return f"{', '.join(first)} and {last}" if first else last
