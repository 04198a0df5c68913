"""Gains, slopes and vignettes that make frames alike where they overlap: least squares of logarithms."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import cv2
import numpy as np
from scipy.sparse import csr_matrix, diags, eye

from geomosaic.arrays import Floats, Floats32
from geomosaic.composition.hot_spot import SunBehind, TonesLeft, can_be_spot, hot_spot, shown_spot
from geomosaic.composition.tone_deviations import GAIN_SD, Exposures, Scatter
from geomosaic.composition.tone_equations import OF_A_FRAME, ToneDesign
from geomosaic.composition.tones import ACROSS, BUMPS, GREYS, Tones, ToneSightings, powers, radial
from geomosaic.constants import NORMAL_PER_MAD, sourced, tuned
from geomosaic.estimation.linear import least_squares
from geomosaic.estimation.robust import cauchy_weight
from geomosaic.matching.tracks import frame_by_frame

_WHITE: Final = GREYS + 1.0
"""Of the tone curve of pictures: the highest grey level itself could not move."""
MEASURED: Final = (np.inf,)
"""The response of measured values: see `Tones`."""
PICTURE: Final = (np.inf, _WHITE)
"""The responses that images of 8 bits may have."""
_SHARED_SD = tuned(
    0.5, "log brightness", "prior of what frames share: fields' spots came to 0.6; corners to 0.5"
)
_SLOPE_SD = tuned(0.1, "log brightness", "prior, middle to corner: 10 % by the sun's side")
_LINEAR = sourced(1.0, "log brightness/log exposure", "contrast expected, and its prior", "values as light")
_INDEPENDENT = tuned(25.0, "places", "independent in a frame, by fields: more follow noise at small overlaps")
_LEAST_SD = tuned(0.005, "log brightness", "a grey level: less overweights places that agree by chance")
_LEVEL_SD = tuned(
    0.25, "of a frame's longer side", "exposure follows a frame; less: frames' own scatter stays"
)
_KERNEL_SDS = sourced(4.0, "deviations", "where a Gaussian kernel ends", "OpenCV: getGaussianKernel, 32 bits")
_PART_NODES = tuned(512, "places", "along a part of the map: fewer take time, more memory; results stay")
_ROUNDS = tuned(8, "rounds", "of re-weighting against cars and glitter: fewer have not converged")


@dataclass(frozen=True)
class Evenness:
    """By how many grey levels two frames differ where they show the same ground: median and nine tenths,
    before and after."""

    before_median: float
    before_90: float
    after_median: float
    after_90: float


def solve_tones(
    places: ToneSightings,
    values: Floats32,
    exposures: Exposures,
    whites: Sequence[float] = MEASURED,
    sun: SunBehind | None = None,
) -> tuple[Tones, Evenness]:
    """Gains, slopes and vignettes by which all frames show each place alike, band by band.

    By the response that leaves the smallest differences in the median; with a hot spot where they show one.

    Args: values (m, b) of the sightings, NaN where unknown. whites: of the responses, see `Tones`.
    """
    found = [_by_response(places, values, exposures, white) for white in whites]
    tones, evenness, left = min(found, key=lambda one: np.nan_to_num(one[1].after_median))
    shown = None if sun is None else shown_spot(sun, left)
    if sun is not None and shown is not None:
        away, width_rad = shown
        spot = hot_spot(sun.rays, away[places.frame], width_rad)
        with_spot, its_evenness, _ = _by_response(places, values, exposures, tones.white, spot)
        if with_spot.spot is not None and can_be_spot(with_spot.spot, left.bent):
            tones, evenness = replace(with_spot, away=away, spot_width_rad=width_rad), its_evenness
    return tones, evenness


def _by_response(
    places: ToneSightings,
    values: Floats32,
    exposures: Exposures,
    white: float,
    spot: Floats | None = None,
) -> tuple[Tones, Evenness, TonesLeft]:
    """The solution by one response: see `Tones`. spot (m,): `hot_spot` of the sightings, where it counts.

    Least squares of logarithms, whose brightness at each place is eliminated; Cauchy weights, since parked
    cars drive off and water shines from one side. Gains scatter about what exposures report, and bumps in
    the frames' middle about nothing, by variance components.
    """
    of_frame = exposures.camera
    n, bands = len(of_frame), values.shape[1]
    known = np.isfinite(values).all(axis=1)
    known &= np.bincount(places.place[known], minlength=len(places.nodes))[places.place] > 1
    place, frame, offset = places.place[known], places.frame[known], places.offset[known]
    grey = values[known].astype(np.float64)
    below = np.maximum(1.0 - grey / white, 1.0 / _WHITE)
    logs = np.log(grey / below)
    camera = of_frame[frame]
    seen = np.bincount(frame, minlength=n)
    share = np.minimum(1.0, _INDEPENDENT / np.maximum(seen, 1))[frame]
    cameras, radius2 = int(of_frame.max(initial=0)) + 1, (offset**2).sum(axis=1)
    nothing = np.zeros(len(frame))
    shared = (
        (camera, nothing, cameras, _LINEAR),
        (camera, nothing, cameras, _SHARED_SD),
        *((camera, by, cameras, _SHARED_SD) for by in radial(radius2)),
        *([] if spot is None else [(np.zeros_like(frame), spot[known], 1, _SHARED_SD)]),
    )
    by_shared = [(np.arange(count) == of[:, None]) * by[:, None] for of, by, count, _ in shared]
    own = np.column_stack([np.ones(len(frame)), offset])
    design = ToneDesign(frame, place, own, np.concatenate(by_shared, axis=1), n, len(places.nodes))
    bent = float(np.median(1.0 / below)) if len(frame) else 1.0
    of_frames = np.tile([np.inf, _SLOPE_SD * bent, _SLOPE_SD * bent], n)
    deviations = np.concatenate([of_frames, *(np.full(count, sd * bent) for _, _, count, sd in shared)])
    bumps = len(of_frames) + 4 * cameras + np.arange(len(BUMPS) * cameras)
    deviations[bumps] = np.inf
    errors, reported = design.of_gains(exposures.gain_errors()), np.isfinite(exposures.log_exposure)
    linear = _LINEAR * bent * exposures.about_mean
    scatters = [
        Scatter(diags(1.0 / deviations, format="csr"), np.zeros(design.unknowns), 1.0, True),
        Scatter(eye(design.unknowns, format="csr")[bumps], np.zeros(len(bumps)), _SHARED_SD * bent, False),
        *(
            Scatter(errors[of], linear[of], GAIN_SD * bent, not its)
            for of, its in ((reported, True), (~reported, False))
        ),
    ]
    found = np.zeros((bands, design.unknowns))
    left, weight = np.zeros_like(logs), np.zeros_like(logs)
    priors: list[csr_matrix] = []
    for b in range(bands if len(frame) else 0):
        found[b], left[:, b], weight[:, b], its = _solved(design, logs[:, b], share, scatters)
        priors.append(its)
    of_frame_itself, of_all = np.split(found.T, [OF_A_FRAME * n])
    itself = np.where((seen > 0)[:, None, None], of_frame_itself.reshape(n, OF_A_FRAME, bands), 0.0)
    contrast, _, *vignette = np.split(of_all, cameras * np.arange(1, 5 + len(BUMPS)))
    tones = Tones(
        itself[:, 0],
        np.swapaxes(itself[:, 1:], 1, 2),
        np.stack([its[of_frame] for its in vignette[: 2 + len(BUMPS)]], axis=-1),
        white,
        spot=None if spot is None else vignette[-1][0],
        reported=exposures.about_mean[:, None] * (_LINEAR * bent + contrast[of_frame]),
    )
    before = logs - design.means(np.ones(len(frame)), logs)
    evenness = _evenness(grey * below, before, left)
    return tones, evenness, TonesLeft(left, weight, known, design, priors, bent)


def _solved(
    design: ToneDesign, logs: Floats, share: Floats, scatters: Sequence[Scatter]
) -> tuple[Floats, Floats, Floats, csr_matrix]:
    """One band's unknowns, what they leave of the differences to each place's mean, the weights, and the
    priors' part of the last normal equations."""
    left = logs - design.means(share, logs)
    for _ in range(_ROUNDS):
        sd = max(NORMAL_PER_MAD * float(np.median(np.abs(left))), _LEAST_SD)
        weight = share / sd**2 * cauchy_weight(left / sd)
        priors = sum(scatter.normal for scatter in scatters)
        normal = design.normal(weight, priors)
        side = design.summed(weight * (logs - design.means(weight, logs)))
        found = normal.solve(side + sum(scatter.side for scatter in scatters))
        scatters = [scatter.estimated(found, normal) for scatter in scatters]
        off = logs - design.logs(found)
        left = off - design.means(weight, off)
    return found, left, weight, priors


def reports_tell(tones: Tones) -> bool:
    """Whether exposures that frames report account for more of their gains than they leave."""
    if tones.reported is None:
        return False
    left = tones.gain - tones.reported
    return bool(tones.reported.var(axis=0).sum() > left.var(axis=0).sum())


def with_one_level(tones: Tones, places: ToneSightings) -> Tones:
    """Tones with which the map shows all ground by one exposure: that of the frames about the place where
    they were exposed least. So the ground that is brightest keeps the brightness of its frames."""
    if not len(places.frame) or tones.reported is None:
        return tones
    about = _about_places(places, tones.reported[places.frame])
    return replace(tones, gain=tones.gain - about[about.sum(axis=1).argmin()])


def with_own_level(tones: Tones, places: ToneSightings) -> Tones:
    """Tones with which the map is as bright as the frames that show a place are in the mean. Changes of
    brightness that a camera's exposure follows stay, and only differences between frames go. The mean is
    taken over about half a frame. Each frame follows it to the second degree, over the box of its
    sightings."""
    if not len(places.frame):
        return tones
    n, b = tones.gain.shape
    own = tones.gain[places.frame] + np.einsum("mbk,mk->mb", tones.slope[places.frame], places.offset)
    target = _about_places(places, own)
    level, box = np.zeros((n, b, 6)), np.zeros((n, 2, 2))
    for i, mine in frame_by_frame(places.frame):
        box[i] = places.offset[mine].min(axis=0), places.offset[mine].max(axis=0)
        terms = powers(*(places.offset[mine, k][:, None] for k in (0, 1)))
        level[i] = least_squares(terms, target[mine].astype(np.float64)).T
    return replace(tones, level=level, level_box=box)


def _about_places(places: ToneSightings, own: Floats) -> Floats32:
    """Means of sightings' values (m, b) over about half a frame, at each sighting's place.

    Part by part of the map, since frames may be scattered over far more land than they show.
    """
    sd, n = _LEVEL_SD * ACROSS, len(places.nodes)
    each = np.column_stack([own, np.ones(len(own))])
    sums = np.stack([np.bincount(places.place, of, n) for of in each.T], axis=1).astype(np.float32)
    seen = sums[:, -1] > 0
    sums[seen] /= sums[seen, -1:]
    about, reach = np.zeros_like(sums), int(np.ceil(_KERNEL_SDS * sd))
    for part in np.unique(places.nodes // _PART_NODES, axis=0):
        first = part * _PART_NODES - reach
        near = places.nodes - first
        within = ((near >= 0) & (near < _PART_NODES + 2 * reach)).all(axis=1)
        inner = within & (places.nodes // _PART_NODES == part).all(axis=1)
        land = np.zeros((_PART_NODES + 2 * reach,) * 2 + sums.shape[1:], dtype=np.float32)
        land[tuple(near[within].T)] = sums[within]
        smooth = cv2.GaussianBlur(land, (0, 0), sd, borderType=cv2.BORDER_CONSTANT).reshape(land.shape)
        about[inner] = smooth[tuple(near[inner].T)]
    return np.asarray((about[:, :-1] / np.maximum(about[:, -1:], 1e-6))[places.place])


def _evenness(grey: Floats, before: Floats, after: Floats) -> Evenness:
    """Differences of two frames are the root of two times those to their mean.

    Args: grey (m, b): how far a value moves by its logarithm, or by that of its odds.
    """
    if not len(grey):
        return Evenness(*[float("nan")] * 4)
    figures = [
        float(np.quantile(np.sqrt(2.0) * np.abs(np.expm1(off)) * grey, share))
        for off in (before, after)
        for share in (0.5, 0.9)
    ]
    return Evenness(*figures)
