"""The rows of results that bench_real writes."""

from __future__ import annotations

from tools.bench.bench_real_halves import SMOOTH, Halves
from tools.bench.result_rows import ResultRow, RowKind
from tools.docs.results_page import BLOCK, FLIGHTS

TIME_S, HALVES_PX, OFF_TAG, PRINCIPAL, BANDS_PX = 120.0, 3.0, 0.1, 0.01, 0.5
"""Upper bounds. TIME_S: of brighton. HALVES_PX: median of garfield's halves. OFF_TAG: share of the readout
time by which its estimate is off the tag. PRINCIPAL: share of the side by which the principal point is off.
BANDS_PX: shift of a band."""
ROWS = {
    "brighton": RowKind(
        FLIGHTS,
        "brighton: wall time, peak memory",
        f"{TIME_S:.0f} s",
        "{seconds:.0f} s, {peak_mb:.0f} MB",
    ),
    "ngi": RowKind(
        BLOCK,
        "ngi: orthos by given poses; by poses off by {moved_m:g} m and {turned_deg:g}°, adjusted",
        "{wanted_px:g} px",
        "{given:.2f}; {adjusted} px",
    ),
    "own adjustments": RowKind(
        BLOCK,
        "brighton: odd against even frames, own adjustments, bare ground, RMSE",
        f"{SMOOTH.rmse_px:g} px",
        "{rmse_px:.2f} px (median {median_px:.2f})",
    ),
    "one adjustment": RowKind(
        BLOCK,
        "brighton: odd against even frames, one adjustment, RMSE",
        f"{SMOOTH.rmse_px:g} px",
        "{rmse_px:.2f} px (median {median_px:.2f})",
    ),
    "garfield halves": RowKind(
        BLOCK,
        "garfield: odd against even frames after a similarity, median",
        f"{HALVES_PX:g} px",
        "{median:.2f} px",
    ),
    "readout": RowKind(
        BLOCK,
        "garfield: readout time with its tag removed, against the tag",
        f"{100 * OFF_TAG:.0f} %",
        "{off:+.1f} %",
    ),
    "principal point": RowKind(
        BLOCK,
        "garfield: principal point against the maker's, share of the side",
        f"{100 * PRINCIPAL:.0f} %",
        "{col:.1f} and {row:.1f} %",
    ),
    "bands": RowKind(
        BLOCK,
        "garfield: {others} against {first}",
        f"{BANDS_PX:g} px",
        "{apart} px",
    ),
}


def halves_rows(found: Halves) -> list[ResultRow]:
    """The rows of brighton's halves."""
    return [
        ROWS[name].row(figures["rmse_px"] < SMOOTH.rmse_px, **figures)
        for name, figures in (("own adjustments", found.own), ("one adjustment", found.one))
    ]
