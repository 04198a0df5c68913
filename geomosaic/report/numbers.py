"""The one way in which reports write numbers: three digits that matter, a unit, a dash for the unknown."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

THIN: Final = "\u202f"
"""Between groups of three digits: it doesn't break a line."""
UNKNOWN: Final = "–"
_SHORT_S: Final = 0.01


def short(value: float | None, unit: str = "", digits: int = 3) -> str:
    """A value for people: so many digits that matter; a dash for what isn't known."""
    if value is None or not math.isfinite(value):
        return UNKNOWN
    if value == 0.0:
        words = "0"
    elif abs(value) < 1e-4:
        words = f"{value:.1e}"
    else:
        power = int(f"{value:.{digits - 1}e}".partition("e")[2])  # of the rounded value: 9.996 is 10.0
        words = f"{value:.{digits - 1 - power}f}" if power < digits - 1 else whole(value)
    return f"{words}\u00a0{unit}" if unit else words


def signed(value: float | None, unit: str = "", digits: int = 3) -> str:
    """The same with its sign."""
    words = short(value, unit, digits)
    return words if value is None or not value > 0.0 or words == UNKNOWN else f"+{words}"


def whole(number: float) -> str:
    """A count: all its digits, in groups of three."""
    return f"{number:,.0f}".replace(",", THIN)


def percent(share: float | None) -> str:
    """A share of 1 in per cent."""
    return UNKNOWN if share is None or not math.isfinite(share) else f"{100.0 * share:.3g}\u00a0%"


def plural(number: int, noun: str) -> str:
    """`3 frames`, `1 frame`."""
    return f"{whole(number)} {noun}{'' if number == 1 else 's'}"


def length(metres: float) -> str:
    """In metres, or centimetres below one."""
    return short(metres * 100.0, "cm") if metres < 1.0 else short(metres, "m")


def on_ground(metres: float, pixel_m: float | None) -> str:
    """A length on the map in metres; where it has no scale, in its pixels of this side."""
    return short(metres, "m") if pixel_m is None else short(metres / pixel_m, "px")


def cm(metres: float) -> str:
    """A residual or a deviation in cm, to a millimetre below a metre."""
    if not math.isfinite(metres):
        return UNKNOWN
    return f"{100.0 * metres:.{int(abs(metres) < 1.0)}f}\u00a0cm".replace("-0.0\u00a0", "0.0\u00a0")


def signed_cm(metres: float) -> str:
    """The same with its sign."""
    words = cm(metres)
    return f"+{words}" if metres > 0.0 and not words.startswith("0.0\u00a0") else words


def duration(seconds: float) -> str:
    """Seconds, or minutes from two on."""
    if seconds < _SHORT_S:
        return f"< {_SHORT_S:g}\u00a0s"
    if seconds < 120.0:
        return short(seconds, "s")
    return f"{int(seconds // 60)}\u00a0min {int(seconds % 60)}\u00a0s"


def map_metres(easting_or_northing: float) -> str:
    """A coordinate of a map to a decimetre, without groups: to be copied."""
    return f"{easting_or_northing:.1f}" if math.isfinite(easting_or_northing) else UNKNOWN


def by_deviation(sd: float) -> int:
    """Decimals of a value that is known to within a deviation, and of the deviation: its first two digits."""
    return int(np.clip(1 - np.floor(np.log10(sd)), 0, 8))
