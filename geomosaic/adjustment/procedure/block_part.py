"""Some neighbouring frames of a block, on which lenses and models are compared."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.sparse import coo_matrix

from geomosaic.adjustment.model import Block
from geomosaic.adjustment.solver.solution import Start
from geomosaic.arrays import Bools, Floats, Ints
from geomosaic.matching.model import TiePoints
from geomosaic.matching.tracks import Tracks


def neighbours(block: Block, allowed: Bools, most: int) -> Ints:
    """Up to `most` frames, ascending, each the one with most tie points to those chosen before. Args: allowed
    (f,): the frames to choose from."""
    ends = np.array(block.ties.frames, dtype=np.intp).reshape(-1, 2)
    inside = allowed[ends].all(axis=1)
    count = np.array([len(pair) for pair in block.ties.pairs], dtype=np.float64)[inside]
    size = (len(block.names),) * 2
    ties = coo_matrix((count, tuple(ends[inside].T)), shape=size).tocsr()
    ties = (ties + ties.T).tocsr()
    shared, chosen = np.asarray(ties.sum(axis=0)).ravel(), np.zeros(len(block.names), dtype=bool)
    free = shared > 0.0
    for k in range(most):
        frame = int(np.argmax(np.where(free, shared, 0.0)))
        if not free[frame] or shared[frame] <= 0.0:
            break
        shared = ties[[frame]].toarray()[0] + (shared if k else 0.0)
        chosen[frame], free[frame] = True, False
    return np.flatnonzero(chosen)


def part_of_block(block: Block, frames: Ints) -> Block:
    """Some frames of a block (ascending) and the pairs between them, without control."""
    number = {int(frame): k for k, frame in enumerate(frames)}
    pairs = tuple(
        replace(t, left=number[t.left], right=number[t.right])
        for t in block.ties.pairs
        if t.left in number and t.right in number
    )
    return replace(
        block,
        names=tuple(block.names[i] for i in frames),
        cameras=tuple(block.cameras[i] for i in frames),
        poses=block.poses.of(frames),
        ties=TiePoints(pairs),
        sequence=tuple(number[i] for i in block.sequence if i in number),
        lines=tuple(block.lines[i] for i in frames),
        turned=tuple(block.turned[i] for i in frames) if block.turned else (),
        control=(),
        times_s=None,
        unsteady_m_per_s=None if block.unsteady_m_per_s is None else block.unsteady_m_per_s[frames],
        heights=None,
        flights=tuple(block.flights[i] for i in frames) if block.flights else (),
    )


def read_at_once(block: Block) -> Block:
    """The block without rolling shutters."""
    cameras = tuple(replace(c, readout_s=0.0, readout_sd_s=0.0) for c in block.cameras)
    return replace(block, cameras=cameras, poses=replace(block.poses, velocities_m_per_s=None, turns=None))


def part_of_solution(whole: Start, frames: Ints, points_m: Floats) -> Start:
    """What a part's solve begins from. Args: points_m (p, 3): its points."""
    found = whole.of_points(points_m)
    estimate = replace(
        found.estimate,
        positions_m=found.estimate.positions_m[frames],
        rotations=found.estimate.rotations[frames],
        rotation_terms_rad=found.estimate.rotation_terms_rad[frames],
        drift=found.estimate.drift[frames],
    )
    return replace(found, poses=whole.poses.of(frames), estimate=estimate)


def solution_of_whole(found: Start, whole: Start, frames: Ints) -> Start:
    """What a block's solve begins from: a part's frames as solved there, the others moved by the median."""
    if len(frames) == len(whole.poses):
        return found
    away_m = found.poses.positions_m - whole.poses.positions_m[frames]
    positions_m, rotations = whole.poses.positions_m + np.median(away_m, axis=0), whole.poses.rotations.copy()
    positions_m[frames], rotations[frames] = found.poses.positions_m, found.poses.rotations
    terms = found.estimate.rotation_terms_rad.shape[1]
    rotation_terms_rad, drift = np.zeros((len(rotations), terms, 3)), np.zeros((len(rotations), 3))
    rotation_terms_rad[frames], drift[frames] = found.estimate.rotation_terms_rad, found.estimate.drift
    estimate = replace(
        found.estimate,
        positions_m=positions_m,
        rotations=rotations,
        points_m=whole.points_m,
        rotation_terms_rad=rotation_terms_rad,
        drift=drift,
    )
    poses = replace(whole.poses, positions_m=positions_m, rotations=rotations)
    return replace(found, poses=poses, estimate=estimate, local=None)


def part_of_tracks(tracks: Tracks, frames: Ints) -> tuple[Tracks, Bools]:
    """What some frames (ascending) see, numbered by them, of tracks that two of them see; which these are."""
    inside = np.isin(tracks.frame, frames)
    kept = np.bincount(tracks.point[inside], minlength=tracks.points) > 1
    use = inside & kept[tracks.point]
    number = np.cumsum(kept) - 1
    frame = np.searchsorted(frames, tracks.frame[use])
    return Tracks(frame, number[tracks.point[use]], tracks.image_px[use]), kept
