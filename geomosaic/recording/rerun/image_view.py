"""The images in Rerun: the worst pairs with their tie points, the picked frame, the mosaic, all strips."""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from geomosaic.arrays import Bytes
from geomosaic.quality.solved_tables import DOWN_WEIGHTED
from geomosaic.recording.file.frame_kinds import THUMBNAILS
from geomosaic.recording.file.model import Recording
from geomosaic.recording.file.reader import printable, recorded_images
from geomosaic.recording.file.thumbnail import decoded, thumbnail
from geomosaic.recording.rerun.list_view import PICK, frame_text, worst_frames
from geomosaic.recording.rerun.plan_view import PLAN, ui

CHIP: Final = "/worst_pair"
FRAME: Final = "/picked_frame"
FRAME_TEXT: Final = "/picked_about"
MOSAIC: Final = "/mosaic"
STRIPS: Final = "/strip_images"
_LARGE: Final = 200
"""Frames, worst first, whose images are shown as recorded: more than a person looks through."""
_MOST: Final = 4000
"""Frames whose images are shown at all: 200 of some 40 kB and 3,800 of some 5 kB are 27 MB in the viewer."""
_LARGE_PX, _SMALL_PX = 512, 160
_KEPT, _REJECTED, _UNUSED = (70, 230, 90), (255, 60, 60), (150, 150, 160)


def draw_chips(recording: Recording, stream: Any) -> None:
    """The k-th worst pair at the k-th place of the timeline: tie points that count in green, others in red,
    those that took no part in grey."""
    import rerun

    rms_m = {}
    tied = recording.table("pairs.adjusted")
    for a, b, rms in zip(tied.row, tied.other, tied.column("rms_m"), strict=False):
        rms_m[a, b] = rms
    for jpeg, ties in recording.chips:
        stream.set_time(PICK, sequence=ties.rank)
        stream.log(f"{CHIP}/image", rerun.EncodedImage(contents=jpeg, media_type="image/jpeg"))
        weight = np.array(ties.weight, dtype=np.float64)
        for name, colour, which in (
            ("kept", _KEPT, weight >= DOWN_WEIGHTED),
            ("rejected", _REJECTED, weight < DOWN_WEIGHTED),
            ("unused", _UNUSED, ~np.isfinite(weight)),
        ):
            sides = [(ties.left_x_px, ties.left_y_px), (ties.right_x_px, ties.right_y_px)]
            at = np.concatenate([np.array(side, dtype=np.float64).T[which] for side in sides])
            size = 3.0 if name == "rejected" else 1.6
            points = rerun.Points2D(at, colors=[colour], radii=ui(size), draw_order=30.0)
            stream.log(f"{CHIP}/{name}", points)
        counts = [int(np.sum(w)) for w in (weight >= DOWN_WEIGHTED, weight < DOWN_WEIGHTED)]
        text = (
            f"{ties.rank + 1}: {printable(ties.left)} | {printable(ties.right)}, rms "
            f"{rms_m.get((ties.left, ties.right), np.nan):.3f} m, {counts[0]} kept, {counts[1]} rejected here"
        )
        label = rerun.Points2D(
            [[ties.side_px, -30.0]], labels=[text], show_labels=True, colors=[(230, 230, 230)], radii=ui(0.5)
        )
        stream.log(f"{CHIP}/about", label)
    stream.reset_time()


def draw_thumbnails(recording: Recording, stream: Any) -> None:
    """Draws frames' images at their places of the timeline `pick`, one after the other out of the recording.
    Those of the worst frames are drawn as they are, others small. The best ones of a very large survey are
    left out."""
    import rerun

    names = recording.table("frames.adjusted").row
    place = {names[row]: k for k, row in enumerate(worst_frames(recording))}
    bare = dict(place)
    for label, whole in recorded_images(recording.path, THUMBNAILS):
        at = bare.get(label, _MOST)
        jpeg = _bounded(whole, _LARGE_PX if at < _LARGE else _SMALL_PX) if at < _MOST else b""
        if jpeg:
            del bare[label]
            stream.set_time(PICK, sequence=at)
            stream.log(FRAME, rerun.EncodedImage(contents=jpeg, media_type="image/jpeg"))
    for at in bare.values():
        stream.set_time(PICK, sequence=at)
        stream.log(FRAME, rerun.Clear(recursive=False))
    stream.reset_time()


def _bounded(jpeg: bytes, side_px: int) -> bytes:
    """A JPEG whose longer side is at most so long; nothing of what is none."""
    image = decoded(jpeg)
    if image is None or max(image.shape[:2]) <= side_px:
        return b"" if image is None else jpeg
    return thumbnail(image[..., ::-1], side_px)


def draw_picks(recording: Recording, stream: Any) -> None:
    """A frame's figures at its place of the timeline, and where it is on the plan."""
    import rerun

    adjusted = recording.table("frames.adjusted")
    rings = dict(recording.outlines.get("adjusted", ()))
    said: dict[str, list[str]] = {}
    for entry in recording.log:
        if entry.frame and entry.level != "info":
            said.setdefault(entry.frame, []).append(entry.text)
    for place, row in enumerate(worst_frames(recording)):
        name = adjusted.row[row]
        stream.set_time(PICK, sequence=place)
        text = frame_text(recording, row, said.get(name, ()))
        about = rerun.TextDocument(text, media_type="text/markdown")
        stream.log(FRAME_TEXT, about)
        ring = rings.get(name, np.zeros((0, 2)))
        line = [np.concatenate([ring, ring[:1]]) * [1.0, -1.0]] if len(ring) else []
        shown = rerun.LineStrips2D(line, colors=[(255, 255, 255)], radii=ui(1.0), draw_order=7.0)
        stream.log(f"{PLAN}/picked", shown)
    stream.reset_time()


def draw_images(recording: Recording, stream: Any) -> None:
    """The mosaic; of strips all of them side by side."""
    import rerun

    for jpeg in recording.images.get("/images/mosaic", {}).values():
        stream.log(MOSAIC, rerun.EncodedImage(contents=jpeg, media_type="image/jpeg"), static=True)
    strips = recording.images.get("/strips", {})
    if strips:
        stacked, places = _stacked(list(strips.values()))
        stream.log(f"{STRIPS}/images", rerun.Image(stacked), static=True)
        named = rerun.Points2D(
            [[45.0, y] for y in places],
            labels=[printable(name) for name in strips][: len(places)],
            show_labels=True,
            colors=[(230, 230, 230)],
            radii=ui(0.5),
        )
        stream.log(f"{STRIPS}/names", named, static=True)


def _stacked(jpegs: list[bytes], gap_px: int = 6) -> tuple[Bytes, list[float]]:
    """Strips lying, their first lines at the left, one below the other, RGB; and the middle of each."""
    images = [np.rot90(image[..., ::-1]) for image in map(decoded, jpegs) if image is not None]
    wide = max((image.shape[1] for image in images), default=1)
    parts: list[Bytes] = []
    places, at = [], 0
    for image in images:
        part = np.zeros((len(image) + gap_px, wide, 3), np.uint8)
        part[: len(image), : image.shape[1]] = image
        parts.append(part)
        places.append(at + len(image) / 2.0)
        at += len(part)
    return np.concatenate(parts or [np.zeros((1, 1, 3), np.uint8)]), places
