"""Images turned by 180 degrees after the flight, seen again as the camera took them.

A lens belongs to the sensor: frames of one camera share their interior orientation only if their
pixels are counted from the same corner of it. (Images turned by 90 degrees have another size and
so are a camera of their own.)
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from geomosaic.adjustment.model import Adjusted, Block, ImageResiduals
from geomosaic.camera.exterior import Poses
from geomosaic.camera.interior import Camera
from geomosaic.camera.rotation import Rotation


def _half_turned(block: Block) -> list[int]:
    return [i for i, quarters in enumerate(block.turned) if quarters == 2]


def _turned_poses(poses: Poses, frames: list[int]) -> Poses:
    rotations = poses.rotations.copy()
    rotations[frames] = Rotation(rotations[frames]).turned(2).matrix
    turns = None if poses.turns is None else poses.turns.turned(frames, 2)
    return replace(poses, rotations=rotations, turns=turns)


def as_taken(block: Block) -> Block:
    """The block with half-turned images turned back: poses, cameras, tie points and control."""
    frames = _half_turned(block)
    if not frames:
        return block
    cameras = tuple(c.turned(2) if i in frames else c for i, c in enumerate(block.cameras))
    size = np.array([[c.width_px, c.height_px] for c in cameras], dtype=np.float64)
    control = tuple(
        replace(
            p,
            observations=tuple(
                (i, float(size[i, 0]) - col, float(size[i, 1]) - row) if i in frames else (i, col, row)
                for i, col, row in p.observations
            ),
        )
        for p in block.control
    )
    pairs = tuple(
        replace(
            t,
            left_px=size[t.left] - t.left_px if t.left in frames else t.left_px,
            right_px=size[t.right] - t.right_px if t.right in frames else t.right_px,
        )
        for t in block.ties.pairs
    )
    return replace(
        block,
        cameras=cameras,
        poses=_turned_poses(block.poses, frames),
        ties=replace(block.ties, pairs=pairs),
        turned=(),
        control=control,
    )


def as_filed(adjusted: Adjusted, block: Block) -> Adjusted:
    """The outcome of `as_taken(block)` for the images as they lie in the files."""
    frames = _half_turned(block)
    cameras = tuple(c.turned(2) if i in frames else c for i, c in enumerate(adjusted.cameras))
    return replace(
        adjusted,
        cameras=cameras,
        poses=_turned_poses(adjusted.poses, frames),
        image_residuals=_turned_residuals(adjusted.image_residuals, cameras, frames),
    )


def _turned_residuals(
    residuals: ImageResiduals | None, cameras: tuple[Camera, ...], frames: list[int]
) -> ImageResiduals | None:
    if residuals is None:
        return None
    turned = np.isin(residuals.frame, frames)[:, None]
    size = np.array([[c.width_px, c.height_px] for c in cameras], dtype=np.float64)
    return replace(
        residuals,
        image_px=np.where(turned, size[residuals.frame] - residuals.image_px, residuals.image_px),
        residual_px=np.where(turned, -residuals.residual_px, residuals.residual_px),
    )
