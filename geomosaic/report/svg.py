"""The little SVG that plots are made of: escaped text, numbers kept short, one style for light and dark."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Sequence
from html import escape

import numpy as np
from numpy.typing import ArrayLike

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#b8860b", "#56b4e9", "#7f7f7f")
"""Okabe and Ito's set (Color Universal Design), its yellow darkened to be seen on white."""
DASHES = ("", "7 3", "2 3", "9 3 2 3", "4 2", "1 2", "12 4")

_STYLE = (
    ".plot{font:13px system-ui,sans-serif;max-width:100%;height:auto;color:#1c2430}"
    ".plot text{fill:currentColor}.plot .grid{stroke:currentColor;stroke-opacity:.15}"
    ".plot .axis{stroke:currentColor;stroke-opacity:.6;fill:none}.plot .faint{opacity:.65}"
    "@media screen and (prefers-color-scheme:dark){.plot{color:#e6e9ee}"
    ".plot [stroke='#0072b2']{stroke:#4da3dd}.plot [fill='#0072b2']{fill:#4da3dd}}"
)


def number(value: float) -> str:
    """A coordinate in an image: two decimals at most."""
    text = f"{value:.2f}".rstrip("0").rstrip(".")
    return "0" if text in ("-0", "") else text


def points(xy: ArrayLike) -> str:
    """`x,y x,y` of (n, 2)."""
    return " ".join(f"{number(x)},{number(y)}" for x, y in np.asarray(xy, dtype=np.float64))


def tag(name: str, content: str | None = None, **attributes: object) -> str:
    """One element; attribute names have `_` for `-`, a trailing one is dropped; values are escaped."""
    parts = [name]
    for key, value in attributes.items():
        if value is None or value == "":
            continue
        text = number(value) if isinstance(value, float) else str(value)
        parts.append(f'{key.rstrip("_").replace("_", "-")}="{escape(text)}"')
    head = " ".join(parts)
    return f"<{head}/>" if content is None else f"<{head}>{content}</{name}>"


def text(x: float, y: float, words: str, **attributes: object) -> str:
    """Words at a place; escaped."""
    return tag("text", escape(words, quote=False), x=float(x), y=float(y), **attributes)


def document(width: float, height: float, content: Iterable[str], label: str) -> str:
    """A whole image that also stands alone as a file; `label` says what it shows."""
    body = tag("title", escape(label, quote=False)) + tag("style", _STYLE) + "".join(content)
    return tag(
        "svg",
        body,
        xmlns="http://www.w3.org/2000/svg",
        viewBox=f"0 0 {number(width)} {number(height)}",
        width=float(width),
        height=float(height),
        class_="plot",
        role="img",
        aria_label=label,
    )


def nice_ticks(low: float, high: float, about: int = 6, least_step: float = 0.0) -> list[float]:
    """Multiples of 1, 2 or 5 times a power of ten from at or below low to at or above high."""
    if not (math.isfinite(low) and math.isfinite(high)):
        low, high = 0.0, 1.0
    if high - low < 1e-12 * max(abs(low), abs(high), 1e-12):
        low, high = low - (abs(low) * 0.1 or 0.5), high + (abs(high) * 0.1 or 0.5)
    rough = max((high - low) / about, least_step)
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(m * power for m in (1.0, 2.0, 5.0, 10.0) if m * power >= rough * (1 - 1e-9))
    first, last = math.floor(low / step + 1e-9), math.ceil(high / step - 1e-9)
    return [i * step for i in range(first, last + 1)]


def power_ticks(low: float, high: float) -> list[float]:
    """1, 2 and 5 times powers of ten from at or below low to at or above high. Beyond some two decades and a
    half they are the powers alone, at most four decades of them below high."""
    if not 0.0 < high < math.inf:
        low, high = 0.1, 1.0
    low = min(max(low, high * 1e-4), 0.5 * high)
    steps = (1.0, 2.0, 5.0) if high <= 10**2.8 * low else (1.0,)
    first, last = math.floor(math.log10(low)), math.ceil(math.log10(high))
    ticks = [m * 10.0**power for power in range(first, last + 1) for m in steps]
    inside = [t for t in ticks if low * (1 + 1e-9) < t < high * (1 - 1e-9)]
    below = max(t for t in ticks if t <= low * (1 + 1e-9))
    return [below, *inside, min(t for t in ticks if t >= high * (1 - 1e-9))]


def tick_texts(ticks: Sequence[float]) -> list[str]:
    """Labels of one form for all: as many decimals as the step needs, or powers for extreme values."""
    step = min((b - a for a, b in itertools.pairwise(ticks)), default=1.0)
    if max(abs(t) for t in ticks) >= 1e7 or step < 1e-5:
        return [f"{t:.2g}" for t in ticks]
    decimals = max(0, -math.floor(math.log10(step) + 1e-9))
    return [f"{t + 0.0:.{decimals}f}" for t in ticks]
