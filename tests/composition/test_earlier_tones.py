"""Tones of an earlier mosaic stay with frames that look the same by them, and with no others."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from geomosaic.composition.composed_tiles import MOST_GREY
from geomosaic.composition.earlier_tones import with_earlier_tones
from geomosaic.composition.tones import Tones, ToneSightings

FRAMES, EACH = 4, 50
EARLIER = np.array([2, 0, 1, -1])
"""Frames 0 to 2 of now were 2, 0 and 1; frame 3 is new."""
GREY = 100.0


def sightings() -> ToneSightings:
    rng = np.random.default_rng(3)
    m = FRAMES * EACH
    frame, offset = np.repeat(np.arange(FRAMES), EACH), rng.uniform(-0.7, 0.7, (m, 2))
    return ToneSightings(np.arange(m), frame, offset, np.zeros((m, 2)), np.zeros((m, 2), dtype=np.intp))


def tones(frames: int, white: float = np.inf) -> Tones:
    rng = np.random.default_rng(frames)
    gain, level = rng.normal(0.0, 0.1, (frames, 3)), rng.normal(0.0, 0.01, (frames, 3, 6))
    slope, vignette = (rng.normal(0.0, 0.05, (frames, 3, 2)) for _ in range(2))
    return Tones(gain, slope, vignette, white, level)


def after(was: Tones, change: list[float]) -> Tones:
    """What the present frames' tones would be: the earlier ones', each changed so much; of the new one other."""
    new = tones(7)
    before = {name: getattr(was, name)[EARLIER] for name in ("gain", "slope", "vignette", "level")}
    for name, its in before.items():
        its[-1] = getattr(new, name)[0]
    before["gain"] = before["gain"] + np.array(change)[:, None]
    return replace(was, **before)


@pytest.mark.parametrize("white", [np.inf, 256.0])
def test_frames_that_look_the_same_keep_their_tones(white: float) -> None:
    was = tones(3, white)
    values = np.full((FRAMES * EACH, 3), GREY, dtype=np.float32)
    values[0] = 250.0
    step = MOST_GREY / GREY
    found = after(was, [0.2 * step, -4.0 * step, 0.0, 0.0])
    kept = with_earlier_tones(found, sightings(), values, was, EARLIER)
    assert kept.level is not None and was.level is not None
    assert (kept.gain[0] == was.gain[2]).all() and (kept.level[0] == was.level[2]).all()
    assert (kept.gain[1] == found.gain[1]).all(), "by more than the bound"
    assert (kept.slope[2] == was.slope[1]).all() and (kept.vignette[2] == was.vignette[1]).all()
    assert (kept.gain[3] == found.gain[3]).all(), "a new frame"


def test_tones_of_another_kind_stay_as_they_are() -> None:
    was = tones(3)
    values = np.full((FRAMES * EACH, 3), GREY, dtype=np.float32)
    found = after(was, [0.001, 0.001, 0.001, 0.0])
    spot = replace(found, spot=np.full(3, 0.1), away=np.tile([0.0, 0.0, 1.0], (FRAMES, 1)))
    for other in (replace(found, white=256.0), replace(found, level=None), spot):
        assert with_earlier_tones(other, sightings(), values, was, EARLIER) is other
    unknown = np.full_like(values, np.nan)
    assert (with_earlier_tones(found, sightings(), unknown, was, EARLIER).gain == found.gain).all()
