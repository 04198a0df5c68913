"""Outlines of roofs: straight lines, each moved to where frames cease to agree on the roof."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from geomosaic.arrays import Bools, Bytes, Floats, Floats32
from geomosaic.composition.roof_views import FINER, Roof, RoofSeen
from geomosaic.composition.views import FrameView
from geomosaic.constants import tuned

_MOST_GREY = tuned(30.0, "grey levels", "cap of a difference: higher lets single pixels decide")
_RECTANGLE = tuned(
    0.8, "share", "that a rectangle and an outline have in common: less squares L-shaped houses"
)
_OFF_NODES = tuned(1.5, "nodes", "a straight line leaves an outline: less keeps what matching frayed")
_REACH_NODES = tuned(2.0, "nodes", "a line moves: less keeps grown roofs; more runs to the next edge")
_STEP_PX = tuned(0.5, "px", "between places of a line that are tried: more misses the edge; less takes time")
_SHORT_NODES = tuned(4.0, "nodes", "of a line that moves: shorter ones follow noise")
_UNSEEN = tuned(1.2, "of a roof's own difference", "where no two frames see the ground: more grows roofs")
_ROUNDS = tuned(2, "rounds", "of moved lines: one leaves lines where their neighbours were")
_INNER = tuned(np.ones((7, 7), np.uint8), "px", "off an outline: less takes its frayed edge for the roof")


def refined(
    roof: Roof, seen: Sequence[RoofSeen], views: Sequence[FrameView], behind: list[Bools]
) -> tuple[Bools, list[Bools]]:
    """The roof's mask, its outline of straight lines, and what it hides from each frame, by `Roof.hides`.
    Each line lies where what frames differ by on the ground ceases to exceed what they differ by on the roof.

    behind: what the roof's own mask hides from each frame.
    """
    mask, hidden = roof.mask, behind
    for _ in range(_ROUNDS):
        gain, found = _gain(mask, seen, hidden), np.zeros(mask.shape, np.uint8)
        for corners in _polygons(mask):
            moved = np.round(_moved(corners, gain) * 16.0).astype(np.int32)
            cv2.fillPoly(found, [moved], (1,), shift=4)
        if 2 * np.count_nonzero(found) < np.count_nonzero(roof.mask):
            return roof.mask, behind
        mask = found > 0
        hidden = roof.hides(mask, views)
    return mask, hidden


def _gain(mask: Bools, seen: Sequence[RoofSeen], hidden: Sequence[Bools]) -> Floats32:
    """By how much more frames differ from the steepest one on the ground than on the roof, in grey levels."""
    on_roof, on_ground = [], []
    for other, behind in zip(seen[1:], hidden[1:], strict=True):
        both = (seen[0].on_roof > 0) & (other.on_roof > 0)
        on_roof.append(_difference(seen[0].on_roof, other.on_roof, both, both & mask))
        both = (seen[0].on_ground > 0) & (other.on_ground > 0) & ~hidden[0] & ~behind
        on_ground.append(_difference(seen[0].on_ground, other.on_ground, both, both & ~mask))
    roof_grey, ground_grey = (_mean(of) for of in (on_roof, on_ground))
    inner = cv2.erode(mask.view(np.uint8), _INNER) > 0
    own = roof_grey[(inner if inner.any() else mask) & np.isfinite(roof_grey)]
    usual = _UNSEEN * float(np.median(own)) if own.size else 0.0
    return np.nan_to_num(np.where(np.isnan(ground_grey), usual, ground_grey) - roof_grey).astype(np.float32)


def _difference(one: Bytes, other: Bytes, both: Bools, of: Bools) -> Floats32:
    """In grey levels, after one gain found where `of`; NaN where not both show the place."""
    a, b = one.astype(np.float32), other.astype(np.float32)
    if of.any():
        b *= np.clip(np.median(a[of]) / max(float(np.median(b[of])), 1.0), 0.5, 2.0)
    off = cv2.blur(np.minimum(np.abs(a - b), np.float32(_MOST_GREY)), (3, 3))
    return np.where(both, off, np.float32(np.nan)).astype(np.float32)


def _mean(of: Sequence[Floats32]) -> Floats32:
    """Of what is known; NaN where nothing is."""
    all_of = np.stack(of)
    known = np.isfinite(all_of)
    number = known.sum(axis=0)
    total = np.where(known, all_of, 0.0).sum(axis=0)
    return np.where(number > 0, total / np.maximum(number, 1), np.nan).astype(np.float32)


def _polygons(mask: Bools) -> list[Floats]:
    """Corners (n, 2), col and row, of each part: its rectangle, if that is much the same, else straight lines
    (Douglas and Peucker 1973)."""
    lines, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    found = []
    for line in lines:
        filled, own = np.zeros(mask.shape, np.uint8), np.zeros(mask.shape, np.uint8)
        corners = np.asarray(cv2.boxPoints(cv2.minAreaRect(line)), dtype=np.float64)
        cv2.fillPoly(filled, [np.round(corners).astype(np.int32)], (1,))
        cv2.fillPoly(own, [np.asarray(line, dtype=np.int32)], (1,))
        common = int(np.count_nonzero(filled & own)) / max(int(np.count_nonzero(filled | own)), 1)
        if common < _RECTANGLE:
            corners = cv2.approxPolyDP(line, _OFF_NODES * FINER, closed=True)[:, 0].astype(np.float64)
        if len(corners) > 2:
            found.append(corners)
    return found


def _moved(corners: Floats, gain: Floats32) -> Floats:
    """Corners (n, 2) of a polygon, each of its lines moved outwards or inwards to where the gain summed
    outwards is largest."""
    ahead = np.roll(corners, -1, axis=0) - corners
    length = np.linalg.norm(ahead, axis=1)
    ahead = ahead / np.maximum(length, 1e-9)[:, None]
    area = float(_cross(corners, np.roll(corners, -1, axis=0)).sum())
    outwards = np.column_stack([ahead[:, 1], -ahead[:, 0]]) * (1.0 if area > 0.0 else -1.0)
    off = np.array([
        _off_px(a, b, out, gain) if size >= _SHORT_NODES * FINER else 0.0
        for a, b, out, size in zip(corners, np.roll(corners, -1, axis=0), outwards, length, strict=True)
    ])  # fmt: skip
    lies = corners + off[:, None] * outwards
    found = []
    for k, corner in enumerate(corners):
        before, turn = ahead[k - 1], float(_cross(ahead[k - 1], ahead[k]))
        meets = lies[k - 1] + before * (
            float(_cross(lies[k] - lies[k - 1], ahead[k])) / turn if turn else 0.0
        )
        if abs(turn) > 0.35 and np.linalg.norm(meets - corner) < 2.0 * _REACH_NODES * FINER:
            found.append(meets)
        else:
            found += [corner + off[k - 1] * outwards[k - 1], corner + off[k] * outwards[k]]
    return np.array(found)


def _off_px(a: Floats, b: Floats, outwards: Floats, gain: Floats32) -> float:
    """How far a line from a to b moves outwards."""
    reach = _REACH_NODES * FINER
    off = np.arange(-reach, reach + _STEP_PX, _STEP_PX)
    along = np.linspace(0.12, 0.88, max(int(np.linalg.norm(b - a)), 4))
    at = (a + along[:, None] * (b - a) + off[:, None, None] * outwards).astype(np.float32)
    profile = cv2.remap(gain, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    mean = np.asarray(profile).mean(axis=1)
    return float(off[np.argmax(np.cumsum(mean) - mean / 2.0)])


def _cross(a: Floats, b: Floats) -> Floats:
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])
