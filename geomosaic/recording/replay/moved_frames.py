"""Frames of a recorded run that lie elsewhere now, or nowhere: found by content, or thumbnails for them."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Collection, Mapping, Sequence
from functools import partial
from pathlib import Path
from stat import S_ISREG
from typing import Any

import cv2
import numpy as np

from geomosaic.doors.files import mode_of
from geomosaic.errors import FileError, InputError
from geomosaic.pipeline.hashes import FileHashes
from geomosaic.pipeline.input_files import frame_files
from geomosaic.pipeline.recipe import Recipe, RecipeStep
from geomosaic.pipeline.replayed_stage import ReplayedStage
from geomosaic.placement.model import Placement
from geomosaic.recording.file.frame_kinds import THUMBNAILS
from geomosaic.recording.file.model import Recording
from geomosaic.recording.file.reader import recorded_images
from geomosaic.recording.file.thumbnail import decoded
from geomosaic.survey.model import Frame, Survey

_MOST_FRAME_PX = 400 << 20
"""Of a frame whose thumbnail is enlarged, more than cameras have: a recording may claim any size."""
_STAND_INS = "work/thumbnails"
_SEAMS = "mosaic.seams"
_WANTED = ("matching.sift", "adjustment.solve", "mosaic.compose")
"""What a replay is for: where one of these is asked for and can't be, the frames are wanted."""


def found_frames(recording: Recording, folder: Path) -> dict[Path, Path]:
    """Where files of the recorded survey lie below a folder, by where they lay: found by content, whatever
    they are called. Raises `FileError` if one isn't there."""
    wanted = dict(frame_files(recording.manifest))
    if not wanted:
        raise InputError("the recording names no frames", file=recording.path, fix="replay without --frames")
    if not folder.is_dir():
        raise FileError("no such folder", file=folder, fix="give the folder that holds the frames")
    hashes = FileHashes()
    below: dict[str, Path] = {}
    for path in sorted(p for p in folder.absolute().rglob("*") if p.is_file()):
        below.setdefault(hashes.of_file(path), path)
    missing = [path for path, mark in wanted.items() if mark not in below]
    if missing:
        count = f"{len(missing)} of {len(wanted)} files of the recorded survey aren't below it"
        fix = "give the folder that holds them, unchanged"
        raise FileError(f"{count}, the first is {missing[0].name}", file=folder, fix=fix)
    return {path: below[mark] for path, mark in wanted.items()}


def at_places(given: Mapping[int, ReplayedStage], places: Mapping[Path, Path]) -> dict[int, ReplayedStage]:
    """Stages from a recording, with the files that they read and name at other places."""
    texts = {str(old): str(new) for old, new in places.items()}
    texts |= {old.name: str(new) for old, new in places.items() if not old.is_absolute()}  # of private ones
    return {
        i: dataclasses.replace(g, places=places).with_outputs(partial(_renamed, texts=texts))
        for i, g in given.items()
    }


def _renamed(value: Any, texts: Mapping[str, str]) -> Any:
    """A value with other texts in it; itself where it holds none of them."""
    if isinstance(value, str):
        return texts.get(value, value)
    if isinstance(value, tuple):
        items = tuple(_renamed(v, texts) for v in value)
        return value if all(a is b for a, b in zip(items, value, strict=True)) else items
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        old = {f.name: getattr(value, f.name) for f in dataclasses.fields(value) if f.init}
        new = {name: _renamed(v, texts) for name, v in old.items()}
        changed = {name: v for name, v in new.items() if v is not old[name]}
        return dataclasses.replace(value, **changed) if changed else value
    return value


def frames_gone(given: Mapping[int, ReplayedStage]) -> list[Frame]:
    """Frames of the recorded survey whose files aren't where they were."""
    surveys = [v for g in given.values() for v in g.outputs.values() if isinstance(v, Survey)]
    return [f for f in surveys[0].frames if not S_ISREG(mode_of(Path(f.path)))] if surveys else []


def first_with_thumbnails(recipe: Recipe, first: int) -> int:
    """Where a replay on thumbnails begins: at the seams at the latest, since the mosaic's pixel is theirs."""
    ids = [step.stage.id for step in recipe.steps]
    return min(first, ids.index(_SEAMS)) if _SEAMS in ids else first


def with_thumbnails(
    recording: Recording, recipe: Recipe, given: Mapping[int, ReplayedStage], output: Path
) -> tuple[Recipe, dict[int, ReplayedStage], list[str]]:
    """A replay that has the recorded thumbnails, enlarged, for frames: recipe, stages from the recording, and
    what is left out, one line each.

    Stages that make nothing of thumbnails (`Stage.wants_frames`) are left out. Raises `FileError` where one
    of them is needed, or a frame has no thumbnail.
    """
    gone = frames_gone(given)
    thumbnails = dict(recorded_images(recording.path, THUMBNAILS))
    lacking = [f.name for f in gone if f.name not in thumbnails]
    fix = "put the frames back there, or name their folder with --frames"
    if not gone:
        return recipe, dict(given), []
    if lacking:
        few = f"{len(lacking)} of them have no thumbnail in the recording, such as {lacking[0]}"
        raise FileError(f"the frames are gone, and {few}", file=gone[0].path, fix=fix)
    steps, out = _without_pixels(recipe.steps, given)
    kept = {s.stage.id for s in steps}
    if lost := [s.stage.id for s in recipe.steps if s.stage.id in _WANTED and s.stage.id not in kept]:
        needed = next(s.stage for i, s in enumerate(recipe.steps) if i not in given and s.stage.wants_frames)
        without = "" if needed.id in lost else f", without which there is no {lost[0]}"
        problem = f"the frames are gone, and {needed.id} takes their pixels{without}"
        raise FileError(problem, file=gone[0].path, fix=fix)
    out.append("full resolution: the mosaic is of the recorded thumbnails")
    folder = output.absolute() / _STAND_INS
    made = {i: _standing_in(g, thumbnails, folder) for i, g in given.items()}
    last = max(made)
    made[last] = made[last].with_warning("frames-gone", f"the frames are gone; left out: {'; '.join(out)}")
    return dataclasses.replace(recipe, steps=tuple(steps)), made, out


def _without_pixels(
    steps: Sequence[RecipeStep], given: Collection[int]
) -> tuple[list[RecipeStep], list[str]]:
    """The steps that need no frames, nor what only such steps give; and a line for each other one."""
    kept: list[RecipeStep] = []
    out: list[str] = []
    there: set[str] = set()
    for i, step in enumerate(steps):
        lacking = [name for name in step.stage.inputs if name not in there]
        if i not in given and (step.stage.wants_frames or lacking):
            why = "takes the frames' own pixels" if step.stage.wants_frames else f"needs '{lacking[0]}'"
            out.append(f"{step.stage.id}, which {why}")
        else:
            kept.append(step)
            there |= step.stage.outputs.keys()
    return kept, out


def thumbnail_pixel_m(recording: Recording, given: Mapping[int, ReplayedStage]) -> float:
    """The usual ground pixel of the survey's thumbnails, to two digits; NaN where nothing tells it."""
    values = [v for g in given.values() for v in g.outputs.values()]
    placed = [v for v in values if isinstance(v, Placement)]
    widths = {f.name: f.width_px for v in values if isinstance(v, Survey) for f in v.frames}
    thumbnails = recorded_images(recording.path, THUMBNAILS)
    small = {name: decoded(jpeg) for name, jpeg in thumbnails if name in widths}
    times = [widths[n] / s.shape[1] for n, s in small.items() if s is not None]
    return float(f"{placed[-1].ground_pixel_m * np.median(times):.2g}") if placed and times else math.nan


def _standing_in(given: ReplayedStage, thumbnails: Mapping[str, bytes], folder: Path) -> ReplayedStage:
    """A stage whose surveys have enlarged thumbnails for frames, which it brings along."""
    brought: dict[str, Callable[[], bytes]] = {}

    def change(value: Any) -> Any:
        if not isinstance(value, Survey):
            return value
        frames = []
        for i, f in enumerate(value.frames):
            name = f"{i:06d}.jpg"
            if not 0 < f.width_px * f.height_px <= _MOST_FRAME_PX:
                problem = f"can't be {f.width_px} x {f.height_px} px, as the recording says"
                raise FileError(problem, file=f.path, fix="take another copy of the recording")
            brought[f"{_STAND_INS}/{name}"] = partial(_enlarged, thumbnails[f.name], f.width_px, f.height_px)
            image = dataclasses.replace(
                f, path=str(folder / name), bands=3, dtype="uint8", valid_mask=None, calibration=None
            )
            frames.append(dataclasses.replace(image, nodata=None, whole_rows=None))
        return dataclasses.replace(value, frames=tuple(frames), other_bands=())

    made = given.with_outputs(change)
    return dataclasses.replace(made, brought=brought)


def _enlarged(jpeg: bytes, width_px: int, height_px: int) -> bytes:
    """A thumbnail as a JPEG of its frame's size; black where it is none."""
    small = decoded(jpeg)
    if small is None:
        small = np.zeros((2, 2, 3), np.uint8)
    large = cv2.resize(small, (width_px, height_px), interpolation=cv2.INTER_LINEAR)
    return bytes(cv2.imencode(".jpg", large, [cv2.IMWRITE_JPEG_QUALITY, 90])[1].tobytes())
