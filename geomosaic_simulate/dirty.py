"""Surveys as people deliver them, drawn at random: how they were flown, over what, and what went wrong."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from geomosaic.errors import UnknownNameError
from geomosaic.survey.shutters import READOUTS_S
from geomosaic_simulate.plan import SurveyPlan

Values = dict[str, Any]
Random = np.random.Generator

KIND_SHARES = {"block": 0.5, "crossed": 0.2, "free": 0.15, "spiral": 0.15}
GROUND_SHARES = {"flat": 0.5, "slope": 0.2, "hills": 0.3}
SIZE_SHARES = {(640, 480): 0.4, (720, 540): 0.25, (800, 600): 0.2, (1000, 750): 0.15}
TREES_SHARE, HOUSES_SHARE = 0.3, 0.4
SHIFT_SD_M = 2.1
"""Of all positions in common, a coordinate: 2.5 m CEP, what the u-blox NEO-M8 of small drones states."""
FRAMES = (12, 30)
HEIGHT_M, FOCAL_WIDTHS = (40.0, 110.0), (0.7, 1.05)
"""Flying height above the ground, and focal length in widths of a frame."""
OVERLAP = (0.65, 0.85)


@dataclass(frozen=True)
class Flaw:
    """Something that real surveys have.

    probability: that a survey has it, given that it may: `needs` is there, nothing of `unless` is, and the
    survey is flown as one of `kinds`. draw: what it sets of the plan, from numbers of its own and the plan
    so far. former: its name in earlier versions, by which its numbers are still drawn.
    """

    name: str
    probability: float
    draw: Callable[[Random, Values], Values]
    needs: str = ""
    unless: tuple[str, ...] = ()
    kinds: tuple[str, ...] = tuple(KIND_SHARES)
    former: str = ""


@dataclass(frozen=True)
class DirtySurvey:
    """What was drawn for a seed: the survey, the faults with what they set, and what was given instead."""

    seed: int
    ground: str
    survey: Values
    faults: dict[str, Values]
    given: Values
    plan: SurveyPlan

    def summary(self) -> Values:
        """For truth/dirty.json."""
        return {
            "seed": self.seed,
            "ground": self.ground,
            "survey": self.survey,
            "faults": [{"name": name, "set": values} for name, values in self.faults.items()],
            "given": {name: None if v is None else str(v) for name, v in self.given.items()},
        }


def dirty_survey(
    seed: int, given: Mapping[str, Any] | None = None, without: Iterable[str] = ()
) -> DirtySurvey:
    """Draw a survey and its faults; `given` fields of `SurveyPlan` are not drawn, nor are faults `without`.

    Each fault has random numbers of its own, so that one more or less leaves the others as they are.
    Raises: `UnknownNameError` for a fault that isn't known.
    """
    present = {fault.former: fault.name for fault in FAULTS if fault.former}
    without = {present.get(name, name) for name in without}
    known = [fault.name for fault in FAULTS]
    for name in sorted(without.difference(known)):
        raise UnknownNameError("fault", name, known)
    ground, survey = _survey(_random(seed, "survey"))
    faults: dict[str, Values] = {}
    values = dict(survey)
    for fault in FAULTS:
        rng = _random(seed, fault.former or fault.name)
        may = (
            fault.name not in without
            and values["kind"] in fault.kinds
            and (not fault.needs or fault.needs in faults)
            and faults.keys().isdisjoint(fault.unless)
        )
        if rng.random() < fault.probability and may:
            faults[fault.name] = fault.draw(rng, values)
            values |= faults[fault.name]
    plan = SurveyPlan(**{**values, **(given or {}), "seed": seed})
    return DirtySurvey(seed, ground, survey, faults, {**(given or {}), "without": sorted(without)}, plan)


def _random(seed: int, purpose: str) -> Random:
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=tuple(purpose.encode())))


def _pick(rng: Random, shares: Mapping[Any, float]) -> Any:
    return list(shares)[int(rng.choice(len(shares), p=list(shares.values())))]


def _number(rng: Random, low: float, high: float, digits: int = 4) -> float:
    return round(float(rng.uniform(low, high)), digits)


def _survey(rng: Random) -> tuple[str, Values]:
    """How it is flown and over what, with the noise that every survey has."""
    kind, ground, (width, height) = (_pick(rng, s) for s in (KIND_SHARES, GROUND_SHARES, SIZE_SHARES))
    count = int(rng.integers(FRAMES[0], FRAMES[1] + 1))
    lines = {"block": int(rng.integers(2, 5)), "crossed": int(rng.integers(2, 4))}.get(kind, 1)
    times = 2 if kind == "crossed" else 1
    each = min(
        max(round(count / (lines * times)), -(-FRAMES[0] // (lines * times))), FRAMES[1] // (lines * times)
    )
    above = round(float(np.exp(rng.uniform(*np.log(HEIGHT_M)))), 1)
    pixel = round(above / float(rng.uniform(*FOCAL_WIDTHS)) / width, 4)
    relief = {
        "flat": (0.0, 300.0),
        "slope": (rng.uniform(0.08, 0.2), 12.0),
        "hills": (rng.uniform(0.05, 0.2), 4.0),
    }
    share, wave = relief[ground]
    return ground, {
        "kind": kind,
        "lines": lines,
        "frames_per_line": each,
        "forward_overlap": _number(rng, *OVERLAP),
        "side_overlap": _number(rng, *OVERLAP),
        "width_px": width,
        "height_px": height,
        "ground_pixel_m": pixel,
        "height_above_ground_m": above,
        "lon_deg": _number(rng, -170.0, 170.0),
        "lat_deg": _number(rng, -55.0, 62.0),
        "ground_height_m": _number(rng, 0.0, 900.0, 1),
        "heading_deg": _number(rng, 0.0, 360.0, 1),
        "speed_m_per_s": _number(rng, 4.0, 12.0, 1),
        "relief_m": round(share * above, 2),
        "relief_wavelength_m": round(max(wave * above, 20.0) if ground != "flat" else wave, 1),
        "trees_stand": bool(rng.random() < TREES_SHARE),
        "buildings_stand": bool(rng.random() < HOUSES_SHARE),
        "buildings": _number(rng, 0.3, 1.2, 2),
        "k1": _number(rng, -0.02, 0.02),
        "k2": 0.0,
        "wander_m": _number(rng, 0.3, 1.5),
        "wander_tilt_deg": _number(rng, 0.5, 3.0),
        "wander_yaw_deg": _number(rng, 1.0, 4.0),
        "position_sd_m": _number(rng, 0.3, 1.5),
        "height_sd_m": _number(rng, 0.5, 2.5),
        "tilt_sd_deg": _number(rng, 0.2, 0.8),
        "yaw_sd_deg": _number(rng, 0.5, 3.0),
        "position_bias_m": round(float(rng.rayleigh(SHIFT_SD_M)), 4),
        "height_bias_m": _number(rng, -15.0, 15.0),
        "relative_height_reported": bool(rng.random() < 0.6),
        "pixel_noise": _number(rng, 1.0, 3.0),
        "jpeg_quality": int(rng.integers(80, 96)),
        "pos_in": "exif",
        "wander_s": _number(rng, 2.0, 8.0),
    }


def _planned(v: Values) -> list[int]:
    """The survey's own frames, by their numbers among all."""
    n = v["lines"] * v["frames_per_line"] * (2 if v["kind"] == "crossed" else 1)
    return [v.get("take_off_frames", 0) + 1 + k for k in range(n)]


def _some(rng: Random, v: Values, low: float, high: float) -> str:
    """Between two shares of the survey's frames, one at least, as text."""
    frames = _planned(v)
    count = max(round(float(rng.uniform(low, high)) * len(frames)), 1)
    return _listed(rng.choice(frames, count, replace=False))


def _listed(numbers: Iterable[int]) -> str:
    return ",".join(str(n) for n in sorted(int(n) for n in numbers))


def _line(rng: Random, v: Values) -> str:
    """All frames of one flight line, as text."""
    frames, each = _planned(v), int(v["frames_per_line"])
    first = int(rng.integers(0, len(frames) // each)) * each
    return f"{frames[first]}-{frames[first + each - 1]}"


def _heights(rng: Random, v: Values, low: float, high: float) -> float:
    """Between two shares of the flying height."""
    return round(float(rng.uniform(low, high) * v["height_above_ground_m"]), 1)


def _sign(rng: Random) -> int:
    return 1 if rng.random() < 0.5 else -1


def _model_of_known_readout(rng: Random, v: Values) -> Values:
    """A camera that others have measured, whose own readout differs by some 5 %."""
    model = str(rng.choice(sorted(READOUTS_S)))
    return {
        "camera_model": model.upper(),
        "rolling_shutter_s": round(READOUTS_S[model] * (1.0 + 0.05 * float(rng.standard_normal())), 5),
    }


_OTHERS = ("take_off", "oblique", "horizon", "landing")
_NO_OTHER = {"relative_height_reported": False}
_ALTITUDES = (
    "altitude_drifts", "altitude_in_steps", "altitude_from_take_off", "altitude_constant",
    "altitude_of_ground", "no_altitude",
)  # fmt: skip

FAULTS: tuple[Flaw, ...] = (
    Flaw("take_off", 0.2, lambda r, v: {"take_off_frames": int(r.integers(1, 5))}),
    Flaw("landing", 0.1, lambda r, v: {"landing_frames": int(r.integers(1, 4))}),
    Flaw("oblique", 0.1, lambda r, v: {"oblique_frames": int(r.integers(1, 3))}),
    Flaw("horizon", 0.07, lambda r, v: {"horizon_frames": int(r.integers(1, 3))}),
    Flaw("duplicates", 0.1, lambda r, v: {"duplicates": int(r.integers(1, 4))}),
    Flaw("blurred", 0.12, lambda r, v: {"blurred": _some(r, v, 0.03, 0.12)}),
    Flaw("no_attitude", 0.25, lambda r, v: {"attitude_reported": False}),
    Flaw("wrong_headings", 0.12, lambda r, v: {"yaw_wrong_share": 0.2}, unless=("no_attitude",)),
    Flaw("turned_line", 0.08, lambda r, v: {"turned": _line(r, v)}, kinds=("block", "crossed")),
    Flaw("altitude_drifts", 0.08, lambda r, v: {
        "height_drift_m": _sign(r) * min(_heights(r, v, 0.3, 1.5), 190.0),
        **_NO_OTHER}),
    Flaw("altitude_in_steps", 0.08, lambda r, v: {
        "altitude_step_m": _heights(r, v, 0.1, 0.5), **_NO_OTHER},
        unless=_ALTITUDES),
    Flaw("altitude_from_take_off", 0.1, lambda r, v: {
        "altitude": "take_off", "take_off_up_m": _heights(r, v, -0.3, 0.3)},
        unless=_ALTITUDES),
    Flaw("altitude_constant", 0.06, lambda r, v: {"altitude": "constant", **_NO_OTHER}, unless=_ALTITUDES),
    Flaw("altitude_of_ground", 0.06, lambda r, v: {"altitude": "ground", **_NO_OTHER}, unless=_ALTITUDES),
    Flaw("no_altitude", 0.06, lambda r, v: {"height_reported": False}, unless=_ALTITUDES),
    Flaw("no_gps_at_all", 0.02, lambda r, v: {
        "no_gps": f"1-{len(_planned(v)) + sum(v.get(f'{k}_frames', 0) for k in _OTHERS)}"}),
    Flaw("no_gps_in_some", 0.12, lambda r, v: {"no_gps": _some(r, v, 0.05, 0.3)}, unless=("no_gps_at_all",)),
    Flaw("gps_outlier", 0.12, lambda r, v: {"gps_outliers": 1}, unless=("no_gps_at_all",)),
    Flaw("gps_lag", 0.1, lambda r, v: {"gps_lag_s": _number(r, 0.1, 0.5)}),
    Flaw("two_batteries", 0.12, lambda r, v: {
        "battery_offset_m": _number(r, 2.0, 6.0), "battery_height_offset_m": _number(r, -12.0, 12.0)}),
    Flaw("rolling_shutter", 0.35, lambda r, v: {"rolling_shutter_s": _number(r, 0.015, 0.12)}),
    Flaw("readout_reported", 0.4, lambda r, v: {"readout_reported": True}, needs="rolling_shutter",
        former="readout_told"),
    Flaw("readout_by_model", 0.7, _model_of_known_readout, needs="rolling_shutter",
        unless=("readout_reported",)),
    Flaw("shutter_unreported", 0.3, lambda r, v: {"shutter_reported": False}, unless=("rolling_shutter",),
        former="shutter_untold"),
    Flaw("vibration", 0.5, lambda r, v: {
        "vibration_deg_per_s": _number(r, 1.0, 6.0), "vibration_hz": _number(r, 3.0, 12.0)},
        needs="rolling_shutter"),
    Flaw("gyroscope_reported", 0.4, lambda r, v: {
        "gyroscope_reported": True, "readout_reported": True, "gyroscope_sd_deg_per_s": 0.1},
        needs="vibration", former="gyroscope_told"),
    Flaw("distortion_unreported", 0.25, lambda r, v: {
        "lens_reported": False, "k1": _number(r, -0.12, 0.05), "k2": _number(r, -0.02, 0.02),
        "principal_col_offset_px": _number(r, -0.01, 0.01) * v["width_px"],
        "principal_row_offset_px": _number(r, -0.01, 0.01) * v["width_px"]}, former="distortion_untold"),
    Flaw("fisheye_unreported", 0.06, lambda r, v: {
        "lens": "fisheye", "lens_reported": False, "k1": _number(r, -0.03, 0.03)},
        unless=("distortion_unreported",), former="fisheye_untold"),
    Flaw("focal_off", 0.3, lambda r, v: {"focal_error": _sign(r) * _number(r, 0.01, 0.04)}),
    Flaw("lens_in_tags", 0.15, lambda r, v: {"lens_in_tags": True}),
    Flaw("motion_blur", 0.2, lambda r, v: {
        "exposure_time_s": round(_number(r, 0.5, 2.5) * v["ground_pixel_m"] / v["speed_m_per_s"], 5)}),
    Flaw("clouds", 0.2, lambda r, v: {"clouds": _number(r, 0.2, 0.5)}),
    Flaw("auto_exposure", 0.35, lambda r, v: {"auto_exposure": _number(r, 0.5, 1.0)}),
    Flaw("exposure_varies", 0.2, lambda r, v: {"exposure_sd": _number(r, 0.05, 0.2)}),
    Flaw("vignetting", 0.35, lambda r, v: {"vignetting": _number(r, 0.1, 0.4)}),
    Flaw("wind_in_trees", 0.25, lambda r, v: {"wind_in_trees_m": _number(r, 0.05, 0.3)}),
    Flaw("water", 0.1, lambda r, v: {"water_share": _number(r, 0.1, 0.3)}),
    Flaw("cars", 0.2, lambda r, v: {"moving_cars": _number(r, 0.5, 2.0)}),
)  # fmt: skip
