"""An adjustment that always ends: simpler models take over where one cannot be solved."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from geomosaic.adjustment.model import Adjusted, Block, Round, Settings
from geomosaic.adjustment.paper.misalignment import offset_net
from geomosaic.adjustment.procedure.block_part import read_at_once
from geomosaic.adjustment.procedure.initialisation import start_poses
from geomosaic.adjustment.procedure.outcome import outcome
from geomosaic.camera.exterior import Poses
from geomosaic.errors import NotSolvableError
from geomosaic.survey.model import Warn

Solve = Callable[[Block, Settings], Adjusted]


def with_fallbacks(block: Block, settings: Settings, solve: Solve) -> Adjusted:
    """The block adjusted by the richest model that can be solved. The first model is the one asked for, the
    next keeps the lens, shutter and mounting as given, the third also reads all rows at once. Then come
    similarities of the plane, and last position and attitude alone. Each level that fails, or is not finite,
    adds one warning."""
    warnings: tuple[Warn, ...] = ()
    why = ""
    for solve_level, code, text in _levels(solve):
        if code:
            warnings = (*warnings, Warn(code, "", text.format(why=why)))
        try:
            adjusted = solve_level(block, settings)
            _check_finite(adjusted)
        except (NotSolvableError, np.linalg.LinAlgError) as error:
            why = str(error)
            continue
        return replace(adjusted, warnings=(*warnings, *adjusted.warnings))
    text = (
        f"the frames cannot be adjusted ({why}): each lies where its position and attitude put it, and "
        "seams will not fit; fly more overlap, or give positions with --pos"
    )
    return replace(_outcome(block, block.poses), warnings=(*warnings, Warn("bundle-failed", "", text)))


def _levels(solve: Solve) -> tuple[tuple[Solve, str, str], ...]:
    """Ways to adjust a block, each with the code and text of its warning; `{why}` the one before failed."""
    return (
        (solve, "", ""),
        (
            lambda block, settings: solve(block, replace(settings, self_calibration=False, model="given")),
            "self-calibration-failed",
            "the lens, the shutter and the camera's mounting cannot be solved for ({why}) and are kept as "
            "given: the map is as true as they are; give a calibrated lens with --camera",
        ),
        (
            lambda block, settings: solve(
                read_at_once(block), Settings(ground=settings.ground, model="given", self_calibration=False)
            ),
            "self-calibration-failed",
            "poses cannot be solved for with the shutter as given ({why}): all rows are taken as read at "
            "once; ground may be displaced by what the camera moved meanwhile; give the lens with --camera",
        ),
        (
            lambda block, _: _outcome(block, start_poses(block, offset_net(block))),
            "bundle-failed",
            "the bundle adjustment cannot be solved ({why}): frames are shifted, turned and scaled over the "
            "ground until they agree, without tilts or lens; fly more overlap, or give positions with --pos",
        ),
    )


def _outcome(block: Block, poses: Poses) -> Adjusted:
    moves = (poses.positions_m - block.poses.positions_m)[:, :2]
    return outcome(block, poses, (Round(offset_net(block).misalignments_m(np.zeros_like(moves)), moves),))


def _check_finite(adjusted: Adjusted) -> None:
    """Raises: `NotSolvableError` naming the frames whose poses are not finite, or for such a camera."""
    poses = adjusted.poses
    good = np.isfinite(poses.positions_m).all(axis=1) & np.isfinite(poses.rotations).all(axis=(1, 2))
    good &= ~np.isnan(poses.positions_sd_m).any(axis=1) & ~np.isnan(poses.rotations_sd_rad).any(axis=1)
    if not good.all():
        raise NotSolvableError("poses are not finite", frames=np.flatnonzero(~good).tolist())
    if not np.isfinite([[c.focal_length_px, *c.terms] for c in adjusted.cameras]).all():
        raise NotSolvableError("a lens is not finite")
    if not np.isfinite(adjusted.ground.up_m).any():
        raise NotSolvableError("the ground is not finite")
