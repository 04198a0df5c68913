"""How far the image of a video has moved on, and which looks at it are taken as frames."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Final

import cv2

from geomosaic.arrays import Floats32
from geomosaic.constants import tuned

_WINDOW = tuned(0.3, "of a frame's step", "about its end, in which the sharpest is taken")
_CELL = tuned(0.05, "of a frame's step", "of whose looks the sharpest is kept: more misses the step's end")
_AS_SHARP = tuned(0.9, "of the variance of the sharpest", "is no less sharp: more lets the codec choose")
_NEW_ANCHOR = tuned(0.15, "of a side", "from the anchor: more comes near half a side, where shifts wrap")
_LOST = tuned(0.05, "peak of the phase correlation", "less: unrelated images, such as after a cut")
_OTHER_SCENE: Final = None
"""The cell of all looks that show nothing of the last frame."""
_Cell = tuple[int, int] | None


@dataclass(frozen=True)
class VideoLook:
    """A frame at reduced size: its number and time in the video, its pixels, how sharp it is."""

    number: int
    time_s: float
    small: Floats32
    sharpness: float


@dataclass(frozen=True)
class PlacedLook:
    """A look without its pixels.

    right, down: how far the image has moved, in widths and heights. Only those of one scene compare.
    """

    number: int
    time_s: float
    sharpness: float
    scene: int
    right: float
    down: float


class _Track:
    """Sums the motion of the image from look to look.

    A shift is measured from an anchor, which is an earlier look; phase correlation wraps at half a side.
    So the look becomes the anchor once it is `_NEW_ANCHOR` away.
    """

    def __init__(self) -> None:
        self._scene = 0
        self._anchors: list[tuple[VideoLook, PlacedLook]] = []
        """One; or two, where the last look showed nothing of the first: it may be a damaged one, or a cut."""

    def placed(self, look: VideoLook) -> PlacedLook:
        """Where the image is at this look; a scene of its own if it shows nothing that an anchor shows."""
        for anchor, at in self._anchors:
            shift = _shift(anchor, look)
            if shift is not None:
                right, down = at.right + shift[0], at.down + shift[1]
                here = PlacedLook(look.number, look.time_s, look.sharpness, at.scene, right, down)
                far = max(map(abs, shift)) > _NEW_ANCHOR
                self._anchors = [(look, here) if far else (anchor, at)]
                return here
        self._scene += 1
        here = PlacedLook(look.number, look.time_s, look.sharpness, self._scene, 0.0, 0.0)
        self._anchors = [*self._anchors[:1], (look, here)]
        return here


def chosen_looks(looks: Iterable[VideoLook], step: float) -> Iterator[PlacedLook]:
    """The looks to take: the first one, then one each time the image has moved on by `step`.

    Of those within `_WINDOW` of a step it is the sharpest. If others are as sharp, the nearest to the step is
    taken. Pixels of two looks at most are kept.

    Args: step: share of the image that the last one taken does not show.
    """
    track = _Track()
    last: PlacedLook | None = None
    before: PlacedLook | None = None
    near: dict[_Cell, PlacedLook] = {}
    for look in looks:
        here = track.placed(look)
        if last is None or before is None:
            last = before = here
            yield here
            continue
        if here.scene == last.scene:
            near.pop(_OTHER_SCENE, None)  # a damaged image: the scene has not changed
            between = before.number > last.number and before.scene == last.scene
            if between and not near and _passed(here, last, step):  # no look is near the end of a step
                near[0, 0] = _nearest((before, here), last, step)
        while near and _passed(here, last, step):
            last = _best(near.values(), last, step)
            yield last
            later = [one for one in near.values() if one.number > last.number]
            near = {}
            for one in later:
                _keep(near, one, last, step)
        _keep(near, here, last, step)
        before = here
    if last is not None and near:
        yield _best(near.values(), last, step)


def _moved(one: PlacedLook, other: PlacedLook) -> float:
    """The share of the image that the other does not show again; 1 where they show nothing alike."""
    if one.scene != other.scene:
        return 1.0
    right, down = abs(other.right - one.right), abs(other.down - one.down)
    return 1.0 - max(1.0 - right, 0.0) * max(1.0 - down, 0.0)


def _passed(look: PlacedLook, last: PlacedLook, step: float) -> bool:
    """Whether the image has moved on beyond where the next frame is taken."""
    return _moved(last, look) > (1.0 + _WINDOW) * step


def _keep(near: dict[_Cell, PlacedLook], look: PlacedLook, last: PlacedLook, step: float) -> None:
    """Adds a look that a frame may be taken from, if it is the sharpest of its cell."""
    if _moved(last, look) < (1.0 - _WINDOW) * step:
        return
    side = _CELL * step
    cell = round((look.right - last.right) / side), round((look.down - last.down) / side)
    key = cell if look.scene == last.scene else _OTHER_SCENE
    if key not in near or look.sharpness > near[key].sharpness:
        near[key] = look


def _best(near: Iterable[PlacedLook], last: PlacedLook, step: float) -> PlacedLook:
    """Of the sharpest, and those as sharp, the nearest to the step."""
    some = list(near)
    least = _AS_SHARP * max(one.sharpness for one in some)
    return _nearest((one for one in some if one.sharpness >= least), last, step)


def _nearest(some: Iterable[PlacedLook], last: PlacedLook, step: float) -> PlacedLook:
    return min(some, key=lambda one: abs(_moved(last, one) - step))


def _shift(one: VideoLook, other: VideoLook) -> tuple[float, float] | None:
    """By what share of width and height the image has moved; None where they show nothing alike."""
    height, width = one.small.shape
    window = cv2.createHanningWindow((width, height), cv2.CV_32F)
    both = one.small.copy(), other.small.copy()  # it multiplies them by the window where they are
    (right, down), peak = cv2.phaseCorrelate(*both, window)
    return None if peak < _LOST else (right / width, down / height)
