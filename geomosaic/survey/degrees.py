"""Longitudes and latitudes as text: with minutes and seconds, or with the letter of a direction."""

from __future__ import annotations

import re
from typing import Final

LETTERS: Final = {"lon": ("E", "W"), "lat": ("N", "S")}
"""Of the positive and the negative direction."""
_NUMBER: Final = r"\d+(?:\.\d*)?"
_TEXT: Final = re.compile(
    rf"([NSEW]?)\s*([-+]?)({_NUMBER})\s*"
    rf"(?:(?:[°º:]|deg(?![a-z])|d(?![a-z])|\s)\s*"
    rf"(?:({_NUMBER})\s*(?:['′’:]|(?P<m>min|m)(?![a-z])|\s|$)\s*"
    rf"(?:({_NUMBER})\s*(?:[\"″”]|''|′′|sec|(?(m)(?-i:s)))?)?)?)?\s*([NSEW]?)",
    re.ASCII | re.IGNORECASE,
)
"""A small s is the unit of seconds next to minutes in m or min; every other S is the south."""


def degrees_of(text: str, column: str) -> float | None:
    """Decimal degrees of a longitude or latitude such as `48 deg 12' 30.5" N`; None if it is neither.

    Args: column: `lon` or `lat`; a letter of the other one is none of its own.
    """
    found = _TEXT.fullmatch(text.strip().replace(",", "."))
    if found is None or column not in LETTERS:
        return None
    before, sign, *numbers, behind = found.group(1, 2, 3, 4, 6, 7)
    letter = (before + behind).upper()
    degrees, minutes, seconds = (float(number or 0.0) for number in numbers)
    parts = [number for number in numbers if number]
    if minutes >= 60.0 or seconds >= 60.0 or any("." in part for part in parts[:-1]) or (letter and sign):
        return None
    if letter and letter not in LETTERS[column]:
        return None
    size = degrees + minutes / 60.0 + seconds / 3600.0
    return -size if sign == "-" or letter == LETTERS[column][1] else size
