"""Pictures of what a recording knows: the plan of a survey, a frame with its tie points, a pair's."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from contextlib import suppress
from typing import Any, Final

import cv2
import numpy as np

from geomosaic.arrays import Bytes, Floats
from geomosaic.errors import InputError
from geomosaic.quality.solved_tables import DOWN_WEIGHTED
from geomosaic.recording.file.frame_kinds import THUMBNAILS
from geomosaic.recording.file.mcapfile import BROKEN
from geomosaic.recording.file.model import Recording
from geomosaic.recording.file.pair_kinds import ChipTies
from geomosaic.recording.file.reader import messages, recorded_images
from geomosaic.recording.file.thumbnail import decoded
from geomosaic.recording.inspect.canvas import GOOD, INK, PAPER, RED, Canvas, png_of, write
from geomosaic.recording.inspect.compare_frames import places_m
from geomosaic.recording.inspect.plan import LEGEND, plan_layers
from geomosaic.recording.inspect.solved import Solved

_SIDE_PX: Final = 900
_PLAN_PX: Final = 1500
_LINES: Final = 300
_LETTERS: Final = 150
_MORE: Final = "footprints: grey before the adjustment, blue after; orange: ground without tie points"
_ARROW: Final = 0.08
"""Of the survey's extent: how long the longest arrow of a difference is drawn at least."""


def plan_png(recording: Recording) -> bytes:
    """East to the right, north up: the layers of `plan.plan_layers` on white.

    Raises: `InputError` where no place of a frame is recorded.
    """
    layers = plan_layers(recording)
    every = [part for layer in layers for part in layer.parts_m]
    if not any(np.isfinite(part).all(axis=1).any() for part in every):
        fix = "give the recording of a run that placed its frames"
        raise InputError("no frame's place is recorded", file=recording.path, fix=fix)
    canvas = Canvas(np.concatenate(every), _PLAN_PX)
    for layer in layers:
        colours = np.broadcast_to(np.array(layer.colours), (len(layer.parts_m), 3))
        if layer.name.startswith("footprints"):
            colours = colours // 2 + 128  # they are many, and faint on white is light
        for k, part in enumerate(layer.parts_m):
            red, green, blue = (int(c) for c in colours[k])
            colour = (blue, green, red)
            if layer.kind == "rings":
                canvas.ring(part, colour)
            elif layer.kind == "lines":
                canvas.line(part, colour, dashed=layer.name == "pairs_untied")
            elif layer.kind == "arrows":
                canvas.arrow(part[0], part[1], colour)
            elif layer.named:
                canvas.label(part[0], layer.labels[k], INK if " " not in layer.labels[k] else colour)
            else:
                canvas.dot(part[0], colour, small=layer.name == "tie_points")
    return png_of(canvas.finished([*textwrap.wrap(LEGEND, _LETTERS), _MORE]))


def difference_png(a: Solved, b: Solved, frames: list[dict[str, Any]]) -> bytes:
    """Where a places the frames, and arrows to where b does, drawn as much longer as lets them be seen; the
    ten worst (`compare_frames.frames`) by name."""
    names, from_m, to_m = places_m(a, b)
    moves_m = to_m - from_m
    known = moves_m[np.isfinite(moves_m).all(axis=1)]
    longest_m = float(np.hypot(*known.T).max()) if len(known) else 0.0
    seen = from_m[np.isfinite(from_m).all(axis=1)]
    extent_m = float(np.ptp(seen, axis=0).max()) if len(seen) else 0.0
    times = max(_ARROW * extent_m / longest_m, 1.0) if longest_m > 0.0 else 1.0
    canvas = Canvas(np.concatenate([from_m, from_m + times * moves_m]), _PLAN_PX)
    for start, move in zip(from_m, moves_m, strict=True):
        canvas.dot(start, INK)
        canvas.arrow(start, start + times * move, RED)
    number = {name: i for i, name in enumerate(names)}
    for f in frames[:10]:
        if f["frame"] in number and f.get("moved_m") is not None:
            canvas.label(from_m[number[f["frame"]]], f"{f['frame'][-18:]} {f['moved_m']:.3f} m", INK)
    foot = [
        f"arrows: from a's places to b's, drawn {times:.3g} times as long; the longest is {longest_m:.3g} m"
    ]
    return png_of(canvas.finished(foot))


def frame_png(recording: Recording, solved: Solved, name: str) -> bytes:
    """A frame's thumbnail with its tie points: green, or red where the solve doubts them."""
    i = solved.names.index(name)
    image, scale = _shown(recording, solved, i)
    for k, t in enumerate(solved.ties.pairs if solved.ties else ()):
        for side, px in ((t.left, t.left_px), (t.right, t.right_px)):
            if side == i:
                _dots(image, px * scale, solved.weights[k])
    return png_of(_titled(image, f"{name}: tie points, red where the solve doubts them"))


def pair_png(recording: Recording, solved: Solved, left: str, right: str) -> bytes:
    """Both thumbnails, lines between their tie points: green, or red where the solve doubts them; below them
    the recorded chip, if there is one."""
    a, b = solved.names.index(left), solved.names.index(right)
    (one, one_scale), (other, other_scale) = _shown(recording, solved, a), _shown(recording, solved, b)
    height = max(len(one), len(other))
    image = np.full((height, one.shape[1] + other.shape[1] + 6, 3), PAPER, dtype=np.uint8)
    image[: len(one), : one.shape[1]] = one
    image[: len(other), one.shape[1] + 6 :] = other
    count = 0
    for k, t in enumerate(solved.ties.pairs if solved.ties else ()):
        if (t.left, t.right) == (a, b):
            from_px, to_px = t.left_px * one_scale, t.right_px * other_scale + [one.shape[1] + 6, 0]
            keep = np.linspace(0, len(t) - 1, min(len(t), _LINES)).astype(np.intp)
            count = len(t)
            for p, q, w in zip(from_px[keep], to_px[keep], solved.weights[k][keep], strict=True):
                if np.isfinite([*p, *q]).all():
                    ends = [tuple(int(v) for v in np.clip(e, -9999, 9999)) for e in (p, q)]
                    cv2.line(image, ends[0], ends[1], RED if w < DOWN_WEIGHTED else GOOD, 1, cv2.LINE_AA)
    words = f"{left} - {right}: {count} tie points"
    words += f", {_LINES} shown" if count > _LINES else "" if count else ", not tied"
    images = [_titled(image, words)]
    chip = _chip(recording, left, right)
    if chip is not None:
        images.append(_titled(chip, "where they miss most, at full resolution"))
    return png_of(_stacked(images))


def _chip(recording: Recording, left: str, right: str) -> Bytes | None:
    """What a pair's frames show at full resolution where their tie points miss most, with these in it."""
    image: Bytes | None = None
    for label, jpeg in recorded_images(recording.path, "/chips"):
        if label == f"{left} - {right}":
            image = decoded(jpeg)
    if image is None:
        return None
    for _, _, data in messages(recording.path, "geomosaic.ChipTies"):
        with suppress(*BROKEN):
            ties = ChipTies.FromString(data)
            if (ties.left, ties.right) == (left, right):
                weight = np.array(ties.weight, dtype=np.float64)
                for x, y in ((ties.left_x_px, ties.left_y_px), (ties.right_x_px, ties.right_y_px)):
                    _dots(image, np.array([x, y], dtype=np.float64).T, weight)
    return image


def _stacked(images: Sequence[Bytes]) -> Bytes:
    """Images below each other, on white."""
    width = max(i.shape[1] for i in images)
    wide = [np.pad(i, ((0, 0), (0, width - i.shape[1]), (0, 0)), constant_values=255) for i in images]
    return np.concatenate(wide)


def _shown(recording: Recording, solved: Solved, i: int) -> tuple[Bytes, Floats]:
    """A frame's thumbnail enlarged to `_SIDE_PX`, or grey where there is none, and its pixels a frame's pixel
    in col and row."""
    frame = solved.survey.frames[i]
    wide = max(frame.width_px, frame.height_px, 1)
    size = [max(round(_SIDE_PX * v / wide), 1) for v in (frame.width_px, frame.height_px)]
    image = np.full((size[1], size[0], 3), 200, dtype=np.uint8)
    for label, jpeg in recorded_images(recording.path, THUMBNAILS):
        if label == frame.name and (small := decoded(jpeg)) is not None:
            image = np.asarray(cv2.resize(small, size, interpolation=cv2.INTER_LINEAR), dtype=np.uint8)
    return image, np.array(size) / [max(frame.width_px, 1), max(frame.height_px, 1)]


def _dots(image: Bytes, at: Floats, weight: Floats) -> None:
    for (x, y), w in zip(at, weight, strict=True):
        if np.isfinite([x, y]).all() and abs(x) < 9999 and abs(y) < 9999:
            cv2.circle(image, (int(x), int(y)), 2, RED if w < DOWN_WEIGHTED else GOOD, -1, cv2.LINE_AA)


def _titled(image: Bytes, words: str) -> Bytes:
    band = np.full((26, image.shape[1], 3), PAPER, dtype=np.uint8)
    write(band, words, (6, 18), INK)
    return np.concatenate([band, image])
