"""Where the changed part of a block begins: at the solution of an earlier run."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from geomosaic.adjustment.model import Block, SolvedBlock
from geomosaic.adjustment.problem.estimate import Estimate
from geomosaic.adjustment.procedure.block_problem import block_problem
from geomosaic.adjustment.solver.solution import Start
from geomosaic.adjustment.terms.term import Components
from geomosaic.arrays import Bools
from geomosaic.camera.exterior import Poses
from geomosaic.estimation.robust import THREE_SIGMA
from geomosaic.matching.tracks import Tracks
from geomosaic.placement.collocation import moved_with_neighbours
from geomosaic.placement.prior import position_assumed


def with_earlier_poses(begun: Poses, earlier: SolvedBlock, block: Block, known: Bools) -> Poses:
    """The earlier poses of known frames; of the others the initial ones, moved as their neighbours were.

    Positions that the images put farther away than their deviations allow begin where they are reported.
    With the earlier variance components they would pass for blunders, and stay wrong.
    """
    at = {name: k for k, name in enumerate(earlier.names)}
    rows = np.array([at[name] for name, its in zip(block.names, known, strict=True) if its], dtype=np.intp)

    def moved(poses: Poses) -> Poses:
        positions_m, rotations = poses.positions_m.copy(), poses.rotations.copy()
        positions_m[known], rotations[known] = earlier.positions_m[rows], earlier.rotations[rows]
        found = replace(poses, positions_m=positions_m, rotations=rotations)
        return moved_with_neighbours(poses, found, known, ~known)

    by_images, given = moved(begun), block.poses
    positions_m = moved(given).positions_m
    near = np.abs(by_images.positions_m - positions_m) <= THREE_SIGMA * given.positions_sd_m
    by_image = known | position_assumed(given) | near.all(axis=1)
    return replace(
        by_images,
        positions_m=np.where(by_image[:, None], by_images.positions_m, positions_m),
        positions_sd_m=begun.positions_sd_m,
        rotations_sd_rad=begun.rotations_sd_rad,
    )


def start_from_earlier(block: Block, earlier: SolvedBlock, tracks: Tracks, poses: Poses) -> Start:
    """What a solve of the block goes on from; points begin where the rays of these poses meet. Rotation and
    drift begin at 0: the reported turns of earlier frames hold theirs, see `with_earlier_turns`."""
    layout = block_problem(block, earlier.settings, tracks, np.zeros((tracks.points, 3))).layout
    known = {name: (values, earlier.fixed[name]) for name, values in earlier.shared.items()}
    shared, fixed = layout.begun_from(known)
    rotation_terms_rad = np.zeros((len(block.names), *earlier.rotation_terms_rad.shape[1:]))
    drift = np.zeros((len(block.names), 3))
    points_m = np.zeros((0, 3))
    estimate = Estimate(
        layout, poses.positions_m, poses.rotations, points_m, shared, rotation_terms_rad, drift
    )
    found = {c.name: c for c in earlier.cameras}
    cameras = tuple(found[c.name] for c in block.lenses)
    return Start(poses, cameras, estimate, Components(earlier.components), fixed, None)
