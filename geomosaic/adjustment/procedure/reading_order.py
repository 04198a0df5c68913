"""Frames whose rows were read from the other end: their pixels were turned after the flight.

By the images alone such a frame looks like one that flew backwards. Its rolling shutter then contradicts that
of all others, and the readout time comes out as next to nothing.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from geomosaic.adjustment.ground.ground_choice import flying_height_m
from geomosaic.adjustment.model import Block
from geomosaic.adjustment.problem.usable_block import as_taken
from geomosaic.adjustment.procedure.cross_validation import BETTER
from geomosaic.adjustment.procedure.model_selection import GOOD_PX
from geomosaic.adjustment.procedure.outcome import BlockState
from geomosaic.adjustment.solver.solution import Solution
from geomosaic.adjustment.terms.image_observations import IMAGE
from geomosaic.adjustment.terms.interior_orientation import NOMINAL_READOUT_S
from geomosaic.adjustment.terms.rolling_shutter_rotation import RollingShutterRotation
from geomosaic.adjustment.terms.term import Components
from geomosaic.arrays import Bools, Floats
from geomosaic.constants import SLIGHT, sourced, tuned
from geomosaic.matching.tracks import Tracks
from geomosaic.survey.model import Warn

_STEADY = tuned(0.5, "share of the velocity", "across the view, or unsteady: beyond it no way is known")
_SURE = sourced(150.0, "times as likely", "that one order is right, not the other", "Kass and Raftery 1995")
_MOST_BACKWARDS = tuned(0.6, "share of the frames", "more fly backwards: cameras look back; half: two lines")


def read_backwards(work: BlockState) -> tuple[int, ...]:
    """Quarters by which to turn each frame's image: 2 for those that fly backwards by their images while
    others fly forwards, or the reverse where cameras look back. Empty where no image is to be turned, or
    where the order of reading hardly matters."""
    block, solution = work.block, work.found.solution
    velocities, reported = block.poses.velocities_m_per_s, block.poses.turns is not None
    rolling = any(t.name == RollingShutterRotation.name for t in solution.problem.frames)
    if velocities is None or reported or not rolling or work.settings.turning:
        return ()
    in_camera = np.einsum("fij,fi->fj", solution.poses.rotations, velocities)
    speed = np.linalg.norm(velocities, axis=1)
    focal_px = np.array([c.focal_length_px * (c.readout_s or NOMINAL_READOUT_S) for c in block.cameras])
    if float(np.median(speed * focal_px)) < GOOD_PX * flying_height_m(block):
        return ()
    way = np.sign(in_camera[:, 1]) * (np.abs(in_camera[:, 1]) > _STEADY * speed) * _steady(block, speed)
    way[solution.left_out] = 0.0
    backwards = float((way < 0.0).mean() / max((way != 0.0).mean(), SLIGHT))
    turned = way > 0.0 if backwards > _MOST_BACKWARDS else way < 0.0
    return tuple(2 * int(its) for its in turned) if turned.any() else ()


def _steady(block: Block, speed: Floats) -> Bools:
    unsteady = np.zeros(len(speed)) if block.unsteady_m_per_s is None else block.unsteady_m_per_s
    return np.asarray((speed > 0.0) & (unsteady <= _STEADY * speed))


def turned_back(work: BlockState, quarters: tuple[int, ...]) -> BlockState:
    """The same work for the images turned back, but for its solution. Cameras stay: they are those of the
    sensor."""
    half = np.array(quarters) == 2
    block, given = (
        replace(as_taken(replace(b, turned=quarters)), cameras=b.cameras) for b in (work.block, work.given)
    )
    size = np.array([[c.width_px, c.height_px] for c in block.cameras], dtype=np.float64)

    def turned(tracks: Tracks) -> Tracks:
        its = half[tracks.frame][:, None]
        return replace(tracks, image_px=np.where(its, size[tracks.frame] - tracks.image_px, tracks.image_px))

    few = turned(work.few)
    tracks = few if work.few is work.tracks else turned(work.tracks)
    text = "its rows are read from the other end: its pixels were turned by 180 degrees after the flight; "
    notes = [
        Warn("frame-turned", block.names[i], f"{text}turned back: nothing to do")
        for i in np.flatnonzero(half)
    ]
    return replace(
        work, given=given, block=block, tracks=tracks, few=few, turned=quarters, notes=(*work.notes, *notes)
    )


def surely_better(its: Solution, now: Solution) -> bool:
    """Whether another order of reading leaves frames as sharp, and so much less of their velocities' errors
    that it is by far the likelier one."""
    if BETTER * its.components[IMAGE] > now.components[IMAGE]:
        return False
    before, after = _velocity_errors(now), _velocity_errors(its)
    return bool(len(now.poses) * np.log(max(before, SLIGHT) / max(after, SLIGHT)) > np.log(_SURE))


def _velocity_errors(solution: Solution) -> float:
    """Root mean square of what frames turned and drifted by while they were read, in stated deviations,
    without what is common to them."""
    term = next(t for t in solution.problem.frames if isinstance(t, RollingShutterRotation))
    own = solution.estimate.while_read / term.sd(Components())
    own = own[~solution.left_out] - np.median(own[~solution.left_out], axis=0)
    return float(np.sqrt(np.square(own).mean()))
