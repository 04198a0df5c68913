"""How accurate a map is, in metres: absolutely, and of distances within it; and what is required of it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from scipy.special import stdtrit

from geomosaic.adjustment.ground_places import GroundPlaces
from geomosaic.adjustment.model import Adjusted
from geomosaic.arrays import Floats
from geomosaic.constants import MEDIAN_LENGTH, SLIGHT, sourced, tuned
from geomosaic.quality.block_errors import BlockErrors
from geomosaic.quality.check_points import CheckPoints, check_points
from geomosaic.quality.control import known_residuals_m, means
from geomosaic.quality.figures import circle_of, interval_of

NOT_STATED: Final = float("nan")
_ASPRS = "ASPRS Positional Accuracy Standards, edition 2 (2023)"
LEAST_CHECK_POINTS = sourced(30, "check points", "of a test; fewer: a reservation is stated", _ASPRS)
_NO_DATUM_M = sourced(107.0, "m", "largest undulation: beyond, heights have no datum", "EGM96: -107 m")
LEAST_POINTS = tuned(3, "check or control points", "fewer say less than the covariance does")
_SURE = sourced(0.9875, "probability", "of two axes to a side", "Fisher 1925, section 12: 5 % of both sides")
_OVER_M = tuned(100.0, "m", "length of the distances that are stated with the whole map's")
_PIXELS = tuned(3.0, "pixels", "of a map by control points or RTK positions; less is called right elsewhere")
_RTK_M = tuned(0.3, "m", "stated deviation of carrier phases at most; by code GNSS, distances over 100 m")
_GNSS_M = tuned(3.0, "m", "deviation of a coordinate by code GNSS; less would call most flights doubtful")


@dataclass(frozen=True)
class AbsoluteAccuracy:
    """Of a place on the map against the world. rmse_h_m: root of the sum of both squared horizontal RMSE;
    rmse_v_m: NaN where no height is mapped or known. how: `measured` by check points, or `estimated` from
    the covariance. shift_m, scatter_m (3,): mean of the check points' errors and RMS about it, else NaN."""

    rmse_h_m: float
    rmse_v_m: float
    how: str
    check_points: int
    shift_m: Floats
    scatter_m: Floats

    @property
    def without_datum(self) -> bool:
        """Whether heights are worse known than any datum is off, as those above the take-off."""
        return self.rmse_v_m > _NO_DATUM_M and not self.check_points

    @property
    def ce90_m(self) -> float:
        """Radius of the circle about a mapped place that holds the true one in 90 of 100 cases."""
        return self.circle_m(0.9)

    @property
    def le90_m(self) -> float:
        """Half of the interval about a mapped height that holds the true one in 90 of 100 cases."""
        return self.interval_m(0.9)

    def circle_m(self, share: float) -> float:
        """Radius of the circle about a mapped place that holds the true one in a share of cases.

        A common shift that check points measured does not scatter. With it a length has Rice's distribution,
        without it Rayleigh's, from which the factor of the RMSE is.
        """
        shift_m = float(np.hypot(*self.shift_m[:2]))
        if not shift_m > 0.0:
            return circle_of(share) * self.rmse_h_m
        from scipy.stats import rice  # half a second, which few runs need

        sd_m = np.sqrt(max(self.rmse_h_m**2 - shift_m**2, SLIGHT * shift_m**2) / 2.0)
        return float(sd_m * rice.ppf(share, shift_m / sd_m))

    def interval_m(self, share: float) -> float:
        """Half of the interval about a mapped height that holds the true one in a share of cases; see
        `circle_m`."""
        shift_m = abs(float(self.shift_m[2]))
        if not shift_m > 0.0:
            return interval_of(share) * self.rmse_v_m
        from scipy.stats import foldnorm

        sd_m = np.sqrt(max(self.rmse_v_m**2 - shift_m**2, SLIGHT * shift_m**2))
        return float(sd_m * foldnorm.ppf(share, shift_m / sd_m))

    @property
    def shifted(self) -> bool:
        """Whether check points show one horizontal shift in common rather than scatter, by Student's test."""
        n = self.check_points
        if n < LEAST_POINTS:
            return False
        mean_sd_m = self.scatter_m[:2] / np.sqrt(n - 1.0)
        off_m = np.abs(self.shift_m[:2])
        return bool(((off_m > self.scatter_m[:2]) & (off_m > stdtrit(n - 1, _SURE) * mean_sd_m)).any())


@dataclass(frozen=True)
class RelativeAccuracy:
    """Of distances within the map. scale_permille: deviation of its scale; rmse_100m_m: of distances over
    about 100 m; rmse_whole_m: over whole_m, about the map's length; NaN where nothing states them."""

    scale_permille: float
    rmse_100m_m: float
    rmse_whole_m: float
    whole_m: float

    @property
    def permille(self) -> float:
        """The larger of both errors as a share of its distance, in thousandths."""
        shares = [self.rmse_100m_m / _OVER_M, self.rmse_whole_m / self.whole_m if self.whole_m else np.nan]
        known = [s for s in shares if np.isfinite(s)]
        return 1000.0 * max(known) if known else NOT_STATED

    @property
    def undetermined(self) -> bool:
        """Whether distances are known no better than by their own length."""
        return self.rmse_whole_m >= self.whole_m > 0.0


@dataclass(frozen=True)
class Requirement:
    """What is asked of a map: RMSE horizontally and vertically in m, distances within it in per mille; NaN
    for what nothing is asked of. why: whose demand it is. local_m: how far land may lie off where it should
    be relative to the land around it. scaled: whether lengths are metres; without positions and control they
    are in a unit of the map's own, and only pixels mean something."""

    rmse_h_m: float
    rmse_v_m: float
    permille: float
    why: str
    local_m: float
    scaled: bool = True

    def length(self, length_m: float, pixel_m: float) -> str:
        """A length in words: in metres, or in pixels where the map has no scale."""
        return metres(length_m) if self.scaled else f"{length_m / pixel_m:.1f} px"

    def asked(self, rmse_h_m: float | None, rmse_v_m: float | None, permille: float | None) -> Requirement:
        """With what a user asks for, None where nothing; land then lies as well as the least of it."""
        if rmse_h_m is None and rmse_v_m is None and permille is None:
            return self
        local_m = [rmse_h_m, None if permille is None else permille * _OVER_M / 1000.0]
        asked_m = [m for m in local_m if m is not None and self.scaled]
        return replace(
            self,
            rmse_h_m=self.rmse_h_m if rmse_h_m is None else rmse_h_m,
            rmse_v_m=self.rmse_v_m if rmse_v_m is None else rmse_v_m,
            permille=self.permille if permille is None else permille,
            why="as asked for",
            local_m=min(asked_m, default=self.local_m),
        )


@dataclass(frozen=True)
class Accuracy:
    """Of a map, absolute and relative."""

    absolute: AbsoluteAccuracy
    relative: RelativeAccuracy


def accuracy_of(adjusted: Adjusted, seam_px: float, pixel_m: float, *, placed: bool = True) -> Accuracy:
    """The accuracy of a map, by check points where there are three or more, else by the covariance.

    Args: seam_px: median mismatch at its seams, NaN where none was measured; pixel_m: its pixel. A mismatch
    has the errors of two frames in it, as a distance between places of two frames does. placed: whether
    positions or control points place the map in the world; else its absolute accuracy is not stated, and
    distances are those of the map once it is scaled.
    """
    local_m2 = 2.0 * (np.nan_to_num(seam_px) * pixel_m / MEDIAN_LENGTH) ** 2
    places, figures = adjusted.places, check_points(adjusted.control)
    absolute = _estimated(places if placed else None, local_m2 / 2.0)
    if figures is not None and figures.count >= LEAST_POINTS:
        used = [c for c in adjusted.control if c.check and c.name not in figures.blunders]
        surveyed_m2 = np.array([c.surveyed_sd_m**2 for c in used])
        known = np.isfinite(known_residuals_m(used))
        absolute = _measured(figures, means(np.where(known, surveyed_m2, np.nan)))
    return Accuracy(absolute, _relative(places, local_m2, placed))


def usual_requirement(adjusted: Adjusted, position_sd_m: Floats, pixel_m: float) -> Requirement:
    """What a map's inputs can give, where the user asks for nothing else.

    Control points and RTK positions give three pixels. Positions by GNSS give 3 m in each coordinate and 3
    per mille, or their stated deviations where these are larger. Control points by code GNSS give what they
    state, and distances the same as positions by GNSS. Without any of these nothing is asked.

    Args: position_sd_m (f,): stated horizontal deviations of the frames' positions.
    """
    control_sd_m = [float(c.surveyed_sd_m[:2].max()) for c in adjusted.control if not c.check]
    by_control = len(control_sd_m) >= LEAST_POINTS
    stated_m = np.array(control_sd_m) if by_control else position_sd_m
    if not len(stated_m):
        nothing = NOT_STATED, NOT_STATED, NOT_STATED
        return Requirement(*nothing, "no frame has a position", _PIXELS * pixel_m, scaled=False)
    sd_m = float(np.median(stated_m))
    least_m, least_permille, why = _PIXELS * pixel_m, 1000.0 * _PIXELS * pixel_m / _OVER_M, "control points"
    if not by_control:
        why = "RTK positions" if sd_m < _RTK_M else "GNSS positions"
    if sd_m >= _RTK_M:
        sd_m = sd_m if by_control else max(sd_m, _GNSS_M)
        least_permille = max(least_permille, 1000.0 * _RTK_M / _OVER_M)
    plan_m = adjusted.poses.positions_m[:, :2]
    spread_m = float(np.linalg.norm(plan_m - plan_m.mean(axis=0)))
    scale_permille = 1000.0 * sd_m / max(spread_m, 1e-9)
    rmse_m = max(np.sqrt(2.0) * sd_m, least_m)
    permille, local_m = max(least_permille, scale_permille), least_permille * _OVER_M / 1000.0
    return Requirement(rmse_m, NOT_STATED, permille, f"what {why} give", local_m)


def _measured(figures: CheckPoints, surveyed_m2: Floats) -> AbsoluteAccuracy:
    """By the check points' errors, blunders left out; surveyed_m2 (3,), the mean variance of their own
    coordinates, is added (ASPRS, edition 2)."""
    square_m2 = figures.rmse_m**2 + surveyed_m2
    return AbsoluteAccuracy(
        rmse_h_m=float(np.sqrt(square_m2[:2].sum())),
        rmse_v_m=float(np.sqrt(square_m2[2])),
        how="measured",
        check_points=figures.count,
        shift_m=-figures.mean_shift_m,
        scatter_m=figures.scatter_m,
    )


def _estimated(places: GroundPlaces | None, local_m2: float) -> AbsoluteAccuracy:
    """By the covariance of places, with what frames are off locally (a variance of each coordinate)."""
    none = np.full(3, np.nan)
    if places is None:
        return AbsoluteAccuracy(NOT_STATED, NOT_STATED, "not stated", 0, none, none)
    variance_m2 = np.diag(places.covariance_m2).reshape(-1, 3).mean(axis=0)
    horizontal_m = float(np.sqrt(variance_m2[:2].sum() + 2.0 * local_m2))
    return AbsoluteAccuracy(horizontal_m, float(np.sqrt(variance_m2[2])), "estimated", 0, none, none)


def _relative(places: GroundPlaces | None, local_m2: float, placed: bool) -> RelativeAccuracy:
    """By the joint covariance of places; local_m2: what a distance is off by frames' own errors."""
    if places is None:
        return RelativeAccuracy(NOT_STATED, NOT_STATED, NOT_STATED, NOT_STATED)
    count = len(places.places_m)
    joint = places.plan_m2(after_similarity=not placed).reshape(count, 2, count, 2)
    one, other = np.triu_indices(count, 1)
    away_m = places.places_m[other, :2] - places.places_m[one, :2]
    length_m = np.linalg.norm(away_m, axis=1)
    along = away_m / np.maximum(length_m, 1e-9)[:, None]
    apart = joint[one, :, one] + joint[other, :, other] - joint[one, :, other] - joint[other, :, one]
    variance_m2 = np.einsum("ni,nij,nj->n", along, apart, along) + local_m2
    whole_m = float(length_m.max())

    def rmse_m(over_m: float) -> float:
        near = (length_m**2 > over_m**2 / 2.0) & (length_m**2 < 2.0 * over_m**2)
        if not near.any():
            return _between_places_m(places, joint.reshape(2 * count, 2 * count), over_m, local_m2)
        return float(np.sqrt(np.maximum(variance_m2[near], 0.0).mean()))

    scale = places.similar()[:, 2]
    scale = scale / (scale @ scale)
    scale_sd = float(np.sqrt(max(float(scale @ places.plan_m2() @ scale), 0.0)))
    return RelativeAccuracy(1000.0 * scale_sd, rmse_m(_OVER_M), rmse_m(whole_m), whole_m)


def _between_places_m(places: GroundPlaces, joint_m2: Floats, over_m: float, local_m2: float) -> float:
    """RMSE of distances shorter than those of any two places: from each of them towards the middle, by errors
    interpolated between places. Not stated on maps that are smaller. Args: joint_m2 (2 k, 2 k)."""
    at_m = places.places_m[:, :2]
    inwards_m = at_m.mean(axis=0) - at_m
    far = np.linalg.norm(inwards_m, axis=1) > over_m
    if not far.any():
        return NOT_STATED
    along = inwards_m[far] / np.linalg.norm(inwards_m[far], axis=1)[:, None]
    weights_at = BlockErrors(places).weights_at
    apart = weights_at(at_m[far] + over_m * along) - weights_at(at_m[far])
    rows = (apart[:, :, None] * along[:, None]).reshape(len(along), -1)
    variance_m2 = np.einsum("nk,nk->n", rows @ joint_m2, rows)
    return float(np.sqrt(np.maximum(variance_m2, 0.0).mean() + local_m2))


def metres(length_m: float) -> str:
    """A length in centimetres below a metre, else in metres."""
    return f"{100.0 * length_m:.1f} cm" if length_m < 1.0 else f"{length_m:.2f} m"
