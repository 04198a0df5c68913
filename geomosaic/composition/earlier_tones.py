"""Tones of an earlier mosaic, which stay where frames look the same by them as by the present ones.

New frames change all tones by tenths of a grey level. No mosaic looks better for it, and no tile is kept.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from geomosaic.arrays import Floats, Floats32, Ints64
from geomosaic.composition.composed_tiles import MOST_GREY
from geomosaic.composition.tones import GREYS, Tones, ToneSightings, evened
from geomosaic.matching.tracks import frame_by_frame


def with_earlier_tones(
    found: Tones, places: ToneSightings, values: Floats32, was: Tones, earlier: Ints64
) -> Tones:
    """The tones in which a frame keeps its earlier ones if they show it within MOST_GREY of the present ones,
    root mean square over its sightings and bands.

    Args: values (m, b) of the sightings, NaN where unknown. earlier (n,): of each frame the number that it
    had, -1 where it is new or another.
    """
    bands = found.gain.shape[1]
    alike = (found.white, found.level is None, bands) == (was.white, was.level is None, was.gain.shape[1])
    if not alike or found.spot is not None or was.spot is not None:
        return found
    known = np.asarray(np.isfinite(values).all(axis=1))
    most = MOST_GREY * float(values[known].max(initial=0.0)) / GREYS
    kept = np.full(len(earlier), -1)
    for frame, mine in frame_by_frame(places.frame):
        if earlier[frame] < 0 or not known[mine].any():
            continue
        mine = mine[known[mine]]
        right, below = places.offset[mine].astype(np.float32).T[..., None]
        one, other = (
            evened(values[mine][None], np.exp(-its)[None], found.white, "float32")
            for its in (
                found.at_offsets(frame, right, below),
                was.at_offsets(int(earlier[frame]), right, below),
            )
        )
        if float(np.sqrt(((one - other) ** 2).mean())) <= most:
            kept[frame] = earlier[frame]

    def merged(now: Floats, before: Floats) -> Floats:
        stays = (kept >= 0).reshape(-1, *[1] * (now.ndim - 1))
        return np.where(stays, before[kept], now)

    return replace(
        found,
        gain=merged(found.gain, was.gain),
        slope=merged(found.slope, was.slope),
        vignette=merged(found.vignette, was.vignette),
        level=None if found.level is None or was.level is None else merged(found.level, was.level),
        level_box=None
        if found.level_box is None or was.level_box is None
        else merged(found.level_box, was.level_box),
    )
