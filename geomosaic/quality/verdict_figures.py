"""The figures by which a verdict judges: agreement of the adjustment, seams, connection, and land."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np
from scipy.special import bdtr, ndtr, ndtri  # those of scipy.stats take half a second to import

from geomosaic.adjustment.model import Adjusted, ControlResidual
from geomosaic.adjustment.procedure.residual_pattern import ResidualPattern
from geomosaic.constants import sourced
from geomosaic.estimation.robust import THREE_SIGMA
from geomosaic.quality.accuracy import LEAST_POINTS
from geomosaic.quality.check_points import check_points
from geomosaic.quality.control import control_blunders
from geomosaic.quality.criteria import CRITERIA
from geomosaic.quality.ground_doubt import LandDoubt
from geomosaic.quality.seam_check import SeamCheck

_DISREGARDED = sourced(0.1, "full weight", "3 in 1000 are below by chance", "Student's pairs: 10^(-5 / 2)")
_CHANCE = sourced(0.05, "share", "of medians below their lower limit", "the usual one-sided level")
OF_LAND: Final = ("ground unknown", "rim", "surface unsure")


def connection(
    adjusted: Adjusted, parts: Sequence[Sequence[int]], land: Mapping[int, float], local_m: float
) -> dict[str, float]:
    """Shares of the mosaic's land that frames give which hang on their own positions, or in another part than
    most. A part doesn't count if its place and that of most are known better than land may lie off relative
    to other land, as by RTK positions or control points."""
    tied = {i: share for i, share in land.items() if adjusted.status[i] == "tied"}
    shares = [sum(tied.get(i, 0.0) for i in part) for part in parts]
    apart = sum(tied.values()) - max(shares, default=0.0)
    if len(parts) > 1:
        off_m = np.linalg.norm(adjusted.poses.positions_sd_m[:, :2], axis=1)
        well = [bool(np.median(off_m[list(part)]) <= local_m) for part in parts]
        main = int(np.argmax(shares))
        apart -= sum(s for k, s in enumerate(shares) if k != main and well[k] and well[main])
    alone = sum(share for i, share in land.items() if i not in tied)
    return {"frames not tied": alone, "frames in other parts": max(apart, 0.0)}


def left_out(adjusted: Adjusted, parts: Sequence[Sequence[int]]) -> float:
    """The share of the frames that have no place, since they are in none but the largest part."""
    largest = {*max(parts, key=len, default=())}
    lost = [i for i, status in enumerate(adjusted.status) if status == "rejected" and i not in largest]
    return len(lost) / max(len(adjusted.status), 1)


def land_off(doubt: LandDoubt) -> dict[str, float]:
    """Shares of the land that have to be expected off by more than is asked, as far as they are known."""
    shares = zip(OF_LAND, (doubt.ground_share, doubt.rim_share, doubt.surface_share), strict=True)
    return {name: share for name, share in shares if np.isfinite(share)}


def agreement(adjusted: Adjusted, patterns: tuple[ResidualPattern, ...]) -> dict[str, float]:
    """How far images, camera and control agree in the adjustment, as far as the method says."""
    names = {"image deviation": "sigma_px", "shape": "shape_sd_px", "tilts": "sigma_tilt"}
    found = {name: adjusted.figures[of] for name, of in names.items() if of in adjusted.figures}
    if adjusted.shared is not None:
        found["principal point"] = _principal_point_off(adjusted)
    if patterns:
        found["pattern of residuals"] = max(p.systematic_px for p in patterns)
    if adjusted.image_residuals is not None and len(adjusted.image_residuals.weight):
        disregarded = adjusted.image_residuals.weight < _DISREGARDED
        found["tie points disregarded"] = float(disregarded.mean())
    found |= _control(adjusted.control)
    return found


def _control(points: Sequence[ControlResidual]) -> dict[str, float]:
    """Control points by what none of as many exceeds by chance; the shift of check points in common by its
    stated deviation; and how many points contradict the others."""
    found = {}
    used, figures = [p for p in points if not p.check], check_points(points)
    wrong = control_blunders(used)
    if points:
        found["blunders"] = float(wrong.sum() + (0 if figures is None else len(figures.blunders)))
    good = [p for p, its in zip(used, wrong, strict=True) if not its]
    known = np.concatenate([np.abs(p.residual_m / p.sd_m) for p in good]) if good else np.zeros(0)
    known = known[np.isfinite(known)]
    if known.size:
        found["control points"] = float(known.max() / -ndtri(ndtr(-THREE_SIGMA) / known.size))
    if figures is not None and figures.count >= LEAST_POINTS:
        sd_m = np.median([p.sd_m for p in points if p.check], axis=0)
        found["check points"] = float(np.abs(figures.mean_shift_m / sd_m)[:2].max())
    return found


def _principal_point_off(adjusted: Adjusted) -> float:
    """By how much principal points moved from what was given, in % of the longer side; the worst camera's."""
    shared, side = adjusted.shared, {c.name: max(c.width_px, c.height_px) for c in adjusted.cameras}
    if shared is None:
        return 0.0
    moved: dict[str, float] = {}
    for of, name, given, found in zip(shared.of, shared.names, shared.given, shared.found, strict=True):
        if name in ("principal_col_px", "principal_row_px") and of in side:
            moved[of] = float(np.hypot(moved.get(of, 0.0), 100.0 * (found - given) / side[of]))
    return max(moved.values(), default=0.0)


def seam_mismatch(seams: SeamCheck) -> dict[str, float]:
    """The median mismatch and the worst tenth. A map is not called bad by a median that so few places may
    show by chance. Its lower limit of 95 % must be bad, too (David and Nagaraja 2003, Order Statistics,
    section 7.1)."""
    length = np.sort(seams.length_px[np.isfinite(seams.length_px)])
    if not length.size:
        return {}
    median, bad = float(np.median(length)), CRITERIA["seams"].bad
    below = bdtr(np.arange(length.size + 1), length.size, 0.5)
    lower = int(np.searchsorted(below, _CHANCE, side="right")) - 1
    limited = lower >= 0 or 2 * length.size > len(seams.length_px)  # fewer than five of many have no limit
    surely = length[max(lower, 0)] if limited else 0.0
    return {
        "seams": median if surely > bad else min(median, bad),
        "worst tenth of the seams": float(np.quantile(length, 0.9)),
    }
