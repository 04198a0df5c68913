"""Pictures of what a recording knows: the plan of a survey, a frame with its tie points, a pair's."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from typing import Any, Final

import cv2
import numpy as np
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from numpy.typing import NDArray

from geomosaic.arrays import Floats
from geomosaic.projection.footprint import footprint
from geomosaic.quality.bare_ground import bare_outlines
from geomosaic.quality.ranking import RESIDUAL, badness
from geomosaic.quality.solved_tables import DOWN_WEIGHTED
from geomosaic.recording.file.mcapfile import BROKEN
from geomosaic.recording.file.model import Recording
from geomosaic.recording.file.pair_kinds import ChipTies
from geomosaic.recording.file.reader import messages
from geomosaic.recording.file.thumbnail import decoded
from geomosaic.recording.inspect.canvas import GOOD, INK, PAPER, RED, Canvas, heat, png_of, write
from geomosaic.recording.inspect.compare_frames import places_m
from geomosaic.recording.inspect.solved import Solved

Image = NDArray[np.uint8]
_SIDE_PX: Final = 900
_PLAN_PX: Final = 1500
_LINES: Final = 300
_OUTLINES: Final = 400
_LABELS: Final = 300
_ORANGE: Final = (30, 140, 240)
_ARROW: Final = 0.08
"""Of the survey's extent: how long the longest arrow of a difference is drawn at least."""


def plan_png(solved: Solved, faults: list[dict[str, Any]], pairs: list[dict[str, Any]]) -> bytes:
    """East to the right, north up: footprints as given (grey) and found (blue), arrows from given to found
    positions, tied pairs by what is left between them, untied ones in grey, accused frames in red."""
    given_m, found_m = _positions(solved)
    at_m = found_m if found_m is not None else given_m
    outlines = [_outlines(solved, found) for found in (False, True)]
    every = [o for sides in outlines for o in sides] + [given_m, at_m]
    canvas = Canvas(np.concatenate([o for o in every if len(o)] or [np.zeros((1, 2))]), _PLAN_PX)
    for sides, colour in zip(outlines, ((225, 225, 225), (225, 195, 160)), strict=True):
        for ring in sides:
            canvas.ring(ring, colour)
    if solved.adjusted is not None and solved.ties is not None:
        for ring in bare_outlines(solved.adjusted, solved.ties):
            canvas.ring(ring, _ORANGE)
    number = {name: i for i, name in enumerate(solved.names)}
    for p in sorted(pairs, key=lambda p: (p["tied"], p.get("rms_px") or 0.0)):
        ends = at_m[[number[p["left"]], number[p["right"]]]]
        left_px = np.array([np.nan if p.get("rms_px") is None else p["rms_px"]])
        share = float(badness(left_px, RESIDUAL.good, RESIDUAL.bad)[0])
        canvas.line(ends, heat(share) if p["tied"] else (190, 190, 190), dashed=not p["tied"])
    wrong: dict[str, list[str]] = {}
    for fault in faults:
        for name in fault["frames"] if fault["code"] != "ground-without-ties" else ():
            wrong.setdefault(name, []).append(fault["code"])
    if found_m is not None:
        for a, b in zip(given_m, found_m, strict=True):
            canvas.arrow(a, b, (160, 60, 0))
    for i, name in enumerate(solved.names):
        accused = wrong.get(name)
        canvas.dot(at_m[i], RED if accused else INK, large=bool(accused))
        if accused or len(solved.names) <= _LABELS:
            label = name.rpartition(".")[0] or name
            canvas.label(at_m[i], ", ".join([label[-14:], *(accused or ())]), RED if accused else INK)
    foot = [
        "grey outlines: as given; blue: as found; arrows: from given to found position",
        f"lines: tied pairs, yellow {RESIDUAL.good:g} red {RESIDUAL.bad:g} px left; dashed: tried, not tied",
        "red: frames of which something is wrong; orange: ground that three frames see without tie points",
    ]
    return png_of(canvas.finished(foot))


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


def _chip(recording: Recording, left: str, right: str) -> Image | None:
    """What a pair's frames show at full resolution where their tie points miss most, with these in it."""
    image: Image | None = None
    for topic, _, data in messages(recording.path, "foxglove.CompressedImage"):
        if topic == "/chips":
            with suppress(*BROKEN):
                message = CompressedImage.FromString(data)
                if message.frame_id == f"{left} - {right}":
                    image = decoded(message.data)
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


def _stacked(images: Sequence[Image]) -> Image:
    """Images below each other, on white."""
    width = max(i.shape[1] for i in images)
    wide = [np.pad(i, ((0, 0), (0, width - i.shape[1]), (0, 0)), constant_values=255) for i in images]
    return np.concatenate(wide)


def _positions(solved: Solved) -> tuple[Floats, Floats | None]:
    prior = solved.prior or solved.placement
    given = np.zeros((len(solved.names), 2)) if prior is None else prior.poses.positions_m[:, :2]
    return given, None if solved.adjusted is None else solved.adjusted.poses.positions_m[:, :2]


def _outlines(solved: Solved, found: bool) -> list[Floats]:
    """Outlines (k, 2) of the frames that see the ground all around."""
    adjusted, prior = solved.adjusted, solved.prior
    if adjusted is None or prior is None or len(solved.names) > _OUTLINES:
        return []
    poses = adjusted.poses if found else prior.poses
    rings = [footprint(poses[i], adjusted.cameras[i], adjusted.ground, 1) for i in range(len(solved.names))]
    return [r[:, :2] for r in rings if np.isfinite(r).all()]


def _shown(recording: Recording, solved: Solved, i: int) -> tuple[Image, Floats]:
    """A frame's thumbnail enlarged to `_SIDE_PX`, or grey where there is none, and its pixels a frame's pixel
    in col and row."""
    frame = solved.survey.frames[i]
    wide = max(frame.width_px, frame.height_px, 1)
    size = [max(round(_SIDE_PX * v / wide), 1) for v in (frame.width_px, frame.height_px)]
    image = np.full((size[1], size[0], 3), 200, dtype=np.uint8)
    for topic, _, data in messages(recording.path, "foxglove.CompressedImage"):
        if topic != "/frames":
            continue
        try:
            message = CompressedImage.FromString(data)
            if message.frame_id == frame.name:
                image = _enlarged(message.data, (size[0], size[1]), image)
        except BROKEN:
            continue
    return image, np.array(size) / [max(frame.width_px, 1), max(frame.height_px, 1)]


def _enlarged(jpeg: bytes, size: tuple[int, int], otherwise: Image) -> Image:
    """A small JPEG in another size; `otherwise` for what is none."""
    small = decoded(jpeg)
    if small is None:
        return otherwise
    return np.asarray(cv2.resize(small, size, interpolation=cv2.INTER_LINEAR), dtype=np.uint8)


def _dots(image: Image, at: Floats, weight: Floats) -> None:
    for (x, y), w in zip(at, weight, strict=True):
        if np.isfinite([x, y]).all() and abs(x) < 9999 and abs(y) < 9999:
            cv2.circle(image, (int(x), int(y)), 2, RED if w < DOWN_WEIGHTED else GOOD, -1, cv2.LINE_AA)


def _titled(image: Image, words: str) -> Image:
    band = np.full((26, image.shape[1], 3), PAPER, dtype=np.uint8)
    write(band, words, (6, 18), INK)
    return np.concatenate([band, image])
