"""Evens out how brightly frames show the ground, before they are composed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from geomosaic.adjustment.model import Adjusted
from geomosaic.arrays import Floats32, Ints64
from geomosaic.composition.earlier_tones import with_earlier_tones
from geomosaic.composition.grid import without_flung
from geomosaic.composition.hot_spot import SunBehind
from geomosaic.composition.mosaic_scene import TRIM, CandidateFrames
from geomosaic.composition.tone_curve import along, curve_to_mid_grey, how_dark, median_grey
from geomosaic.composition.tone_deviations import Exposures
from geomosaic.composition.tone_solution import (
    MEASURED,
    PICTURE,
    Evenness,
    reports_tell,
    solve_tones,
    with_one_level,
    with_own_level,
)
from geomosaic.composition.tones import Sampling, Tones, ToneSightings, lattice, sampled
from geomosaic.composition.views import FrameView
from geomosaic.constants import tuned
from geomosaic.errors import InputError
from geomosaic.matching.tracks import frame_by_frame
from geomosaic.pipeline.function_stage import stage
from geomosaic.pipeline.stage import Context, StageParams, param
from geomosaic.projection.ground import GroundSurface
from geomosaic.radiometry.quantity import UNCALIBRATED
from geomosaic.stages.earlier_frames import earlier_numbers
from geomosaic.stages.spares import spare_of
from geomosaic.survey.model import Survey

_ALIKE = tuned(0.1, "share", "exposures of a band that differ by less show no edges; more hides edges")
_EVEN = ("auto", "always", "never")
_LEVELS = ("auto", "frames", "common")


class TonesParams(StageParams):
    """See each parameter's help."""

    even: str = param(
        "auto",
        help="exposure, white balance and vignetting evened out; auto: of images of 8 bits with one or three "
        "bands, not of a rig's bands or of measured values",
        choices=_EVEN,
    )
    level: str = param(
        "frames",
        help="brightness of the map: frames is that of the frames about a place; common is that of one "
        "exposure for all, by which bright ground stays brighter than dark; auto: common where the "
        "exposures in the frames' tags account for their brightness, frames elsewhere",
        choices=_LEVELS,
    )
    brighten: bool = param(
        False, help="one curve for the whole map, by which half of it is darker than mid-grey"
    )


def _conclusions(summary: Mapping[str, Any]) -> list[tuple[str, str]]:
    """What makes a dark or pale mosaic brighter or darker."""
    its = summary["metrics"].get("tones", {})
    grey = its.get("median_grey")
    if grey is None or "curve" in its or not how_dark(grey):
        return []
    then = along(np.array(grey), curve_to_mid_grey(grey))
    median = f"half of the map is darker than {grey:.0f} of 255"
    text = f"{how_dark(grey)}: {median}; --brighten makes that {then:.0f}"
    return [("brightness", text)]


@stage(
    "mosaic.tones", "Even the tones", group="Mosaic", version=23, outputs="tones", conclusions=_conclusions,
    goes_on=True,
)  # fmt: skip
def mosaic_tones(
    survey: Survey, ground: GroundSurface, adjusted: Adjusted, params: TonesParams, context: Context
) -> Tones:
    """Solves for each frame's exposure, white balance and fall of light, and each camera's vignette."""
    frames = survey.frames
    n, bands = len(frames), max((f.bands for f in frames), default=1)
    none = Tones(np.zeros((n, bands)), np.zeros((n, bands, 2)), np.zeros((n, bands, 2)))
    measured = bool(survey.other_bands) and bands == 1
    if measured and params.even == "always":
        raise InputError(
            "the bands of a multispectral rig are measured values and are not balanced",
            fix="leave out --set mosaic.tones.even",
        )
    if measured:
        _warn_of_exposures(survey, adjusted, context)
    alike = all(f.bands == bands for f in frames)
    images = alike and all(f.dtype == "uint8" for f in frames) and bands in (1, 3) and not measured
    if params.brighten and not images:
        raise InputError(
            "only images of 8 bits with one or three bands can be brightened", fix="leave out --brighten"
        )
    even = alike and params.even != "never" and (params.even != "auto" or images)
    if not even and not params.brighten:
        return none
    used = [s != "rejected" for s in adjusted.status]
    frames_on_map = CandidateFrames(survey, adjusted.poses, adjusted.cameras, used, ground)
    seen = frames_on_map.views(frames_on_map.limits(TRIM, frames_on_map.pixel_m))
    views, _ = without_flung(seen, frames_on_map.pixel_m)
    if not views:
        return none
    places = lattice(views, survey.map_crs, survey.work_frame, ground)
    earlier = earlier_numbers(survey, adjusted, frames_on_map.pixel_m, context)
    was = _earlier_tones(earlier, context)
    whites = (PICTURE if images else MEASURED) if was is None else (was.white,)
    shown = _Seen(survey, views, places, _values(survey, places, bands, context), whites)
    tones = none
    if even and len(views) > 1:
        tones, evenness = _evened(shown, Exposures.of(frames, adjusted.cameras), params.level)
        if was is not None:
            tones = with_earlier_tones(tones, places, shown.values, was, earlier)
        _report(tones, evenness, [f.name for f in frames], context)
    if images:
        grey = median_grey(tones, places, shown.values)
        context.metric("tones.median_grey", grey)
        if params.brighten:
            its = was.curve if was is not None else 1.0
            tones = replace(tones, curve=curve_to_mid_grey(grey) if its == 1.0 else its)
            context.metric("tones.curve", tones.curve)
    return tones


def _warn_of_exposures(survey: Survey, adjusted: Adjusted, context: Context) -> None:
    """Names the bands of a rig whose recorded values differ from frame to frame as exposures do."""
    own = (survey.band, survey.frames, survey.quantity)
    varying = []
    for name, frames, quantity in (own, *((b.name, b.frames, b.quantity) for b in survey.other_bands)):
        shown = (f for f, status in zip(frames, adjusted.status, strict=True) if status != "rejected")
        exposures = [f.exposure for f in shown if f is not None and f.exposure]
        ratio = max(exposures, default=1.0) / min(exposures, default=1.0)
        if ratio > 1.0 + _ALIKE and quantity in (None, UNCALIBRATED):
            varying.append(f"{name} by a factor of {ratio:.2g}")
    if varying:
        text = f"exposures differ between frames ({', '.join(varying)}), and values are as recorded: "
        text += "brightness and indices differ from frame to frame; give --radiometry reflectance where tags "
        context.warn("exposure-varies", "", text + "allow it, else fly with one exposure")


@dataclass(frozen=True)
class _Seen:
    """What frames show at places of a survey: values (m, b) of the sightings, NaN where unknown. whites: of
    the responses that they may have, see `Tones`."""

    survey: Survey
    views: Sequence[FrameView]
    places: ToneSightings
    values: Floats32
    whites: Sequence[float]


def _evened(seen: _Seen, exposures: Exposures, level: str) -> tuple[Tones, Evenness]:
    """Tones by which frames show all places alike, with the level that is asked for."""
    places, values = seen.places, seen.values
    if level == "frames":
        exposures = exposures.unknown
    sun = SunBehind.of(seen.survey, seen.views, places.frame, places.image_px)
    tones, evenness = solve_tones(places, values, exposures, seen.whites, sun)
    common = level == "common" or reports_tell(tones)
    if level == "auto" and not common:
        tones, evenness = solve_tones(places, values, exposures.unknown, seen.whites, sun)
    return (with_one_level if common else with_own_level)(tones, places), evenness


def _report(tones: Tones, evenness: Evenness, names: list[str], context: Context) -> None:
    bands = tones.gain.shape[1]
    columns = {f"gain_log_{k + 1}": tones.gain[:, k] for k in range(bands)}
    slopes = {
        f"slope_log_{axis}_{k + 1}": tones.slope[:, k, i] for k in range(bands) for i, axis in enumerate("xy")
    }
    context.recorder.table("tones", names, columns | slopes)
    context.metric("tones.difference_grey", asdict(evenness))
    context.metric("tones.bend_towards_white", bool(np.isfinite(tones.white)))
    if tones.spot is not None:
        context.metric("tones.hot_spot_log", tones.spot.round(3))
        context.metric("tones.hot_spot_width_deg", round(float(np.degrees(tones.spot_width_rad)), 1))
    context.metric("tones.level", "common" if tones.level is None else "frames")
    if tones.reported is not None and np.ptp(tones.reported):
        left = tones.gain - tones.reported
        context.metric("tones.reported_sd", float(tones.reported.std()))
        context.metric("tones.unreported_sd", float(np.sqrt(left.var(axis=0).mean())))
    context.metric("tones.gain_sd", float(tones.gain.std()))


def _earlier_tones(earlier: Ints64, context: Context) -> Tones | None:
    """Those of the run before, if most frames are where they were."""
    if context.earlier is None or 2 * int((earlier >= 0).sum()) < len(earlier):
        return None
    was: Tones | None = context.earlier.artefact("tones", Tones)
    return was if was is not None and was.gain.any() else None


def _values(survey: Survey, places: ToneSightings, bands: int, context: Context) -> np.ndarray[Any, Any]:
    """Of all sightings, (m, b)."""
    its = dict(frame_by_frame(places.frame))
    seen, mine = list(its), list(its.values())
    jobs = [
        Sampling(survey.frames[i], places.image_px[m], spare_of(context, survey.frames[i].path))
        for i, m in zip(seen, mine, strict=True)
    ]
    found = context.map("tones", sampled, jobs, keys=seen)
    values = np.full((len(places.frame), bands), np.nan, dtype=np.float32)
    for m, samples in zip(mine, found, strict=True):
        values[m] = samples.values
    return values
