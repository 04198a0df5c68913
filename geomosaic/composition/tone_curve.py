"""One gentle curve for the whole map: a dark survey becomes brighter, black and white stay as they are."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from geomosaic.arrays import Floats32
from geomosaic.composition.tones import GREYS, Tones, ToneSightings, evened
from geomosaic.constants import sourced
from geomosaic.matching.tracks import frame_by_frame

_MID_GREY = sourced(118.0, "grey levels", "what half of the map is made darker than", "sRGB of an 18 % card")
_STOP = sourced(2.0, "times the odds", "dark or pale beyond one, changed by two at most", "definition")


def median_grey(tones: Tones, places: ToneSightings, values: Floats32) -> float:
    """The median of the map's values, 0 to 255, by the mean of the bands; NaN where nothing is known. Hot
    spots are too small to count.

    values (m, b): of the sightings as frames show them, NaN where unknown.
    """
    greys = [np.zeros(0, dtype=np.float32)]
    known = np.flatnonzero(np.isfinite(values).all(axis=1))
    for frame, some in frame_by_frame(places.frame[known]):
        mine = known[some]
        right, below = places.offset[mine].astype(np.float32).T[..., None]
        darker = np.exp(-tones.at_offsets(frame, right, below))
        greys.append(evened(values[mine][None], darker[None], tones.white, "float32")[0].mean(axis=1))
    of_all = np.concatenate(greys)
    return float(np.median(of_all)) if len(of_all) else float("nan")


def curve_to_mid_grey(median: float) -> float:
    """By what the odds v / (255 - v) of the map's values are multiplied to bring their median to mid-grey.

    That is the middle of a film's characteristic curve (Hurter and Driffield 1890). At most two stops; 1,
    which leaves all values as they are, for an unknown median.
    """
    if np.isnan(median):
        return 1.0
    grey = np.clip(median, 1.0, GREYS - 1.0)
    wanted = _MID_GREY / (GREYS - _MID_GREY) / (grey / (GREYS - grey))
    return float(np.clip(wanted, _STOP**-2, _STOP**2))


def how_dark(median: float) -> str:
    """`dark` or `pale` for a map that is more than a stop off mid-grey, nothing for any other."""
    curve = curve_to_mid_grey(median)
    return "dark" if curve > _STOP else "pale" if curve < 1.0 / _STOP else ""


def along(grey: NDArray[Any], curve: float) -> NDArray[Any]:
    """Values (...), 0 to 255, along the curve of so many times the odds."""
    return np.asarray(GREYS * curve * grey / (GREYS + (curve - 1.0) * grey))


def curved(pixels: NDArray[Any], curve: float) -> NDArray[Any]:
    """Pixels of 8 bits (h, w, b) along the curve of so many times the odds."""
    if curve == 1.0:
        return pixels
    table = np.rint(along(np.arange(GREYS + 1.0), curve)).astype(np.uint8)
    return np.asarray(cv2.LUT(pixels, table)).reshape(pixels.shape)
