"""Which frames of a block are solved anew after an earlier run: those whose tie points changed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from geomosaic.adjustment.model import Adjusted, Block, SolvedBlock
from geomosaic.adjustment.procedure.block_part import part_of_block
from geomosaic.adjustment.terms.gnss_positions import OFFSET
from geomosaic.arrays import Bools, Floats, Ints
from geomosaic.camera.exterior import Poses
from geomosaic.constants import SLIGHT
from geomosaic.estimation.linear import least_squares
from geomosaic.matching.model import TiePairs, TiePoints
from geomosaic.placement.prior import position_assumed
from geomosaic.projection.footprint import footprint
from geomosaic.projection.ground import GroundSurface

SHIFT: Final = "kept_shift_m"
"""Of an outcome's figures: by how much reported positions would move frames that stayed, since the last whole
adjustment."""


@dataclass(frozen=True)
class EarlierBlock:
    """An adjusted block of an earlier run, in the same work frame. names (n,): its frames; given: where they
    were reported; unchanged: names of the frames whose files are as they were; bound_m: by how much a place
    on the ground may differ from that of a whole adjustment; prior_ground: before it was adjusted."""

    names: tuple[str, ...]
    given: Poses
    ties: TiePoints
    adjusted: Adjusted
    unchanged: frozenset[str]
    bound_m: float
    prior_ground: GroundSurface

    @property
    def solved(self) -> SolvedBlock | None:
        """Its solution, of the unchanged frames."""
        return None if self.adjusted.solved is None else self.adjusted.solved.of(self.unchanged)

    @property
    def shift_m(self) -> float:
        """By how much runs before this one would have moved its frames, see `SHIFT`."""
        return self.adjusted.figures.get(SHIFT, 0.0)

    @property
    def datum_sd_m(self) -> float:
        """How well the place of the whole block is known: the median of the stated deviations of its frames'
        positions in plan, which hold what all have in common. Never below the bound."""
        sd_m = np.linalg.norm(self.adjusted.poses.positions_sd_m[:, :2], axis=1)
        known = sd_m[np.isfinite(sd_m) & (sd_m > 0.0)]
        return max(self.bound_m, float(np.median(known)) if known.size else 0.0)

    @property
    def number(self) -> dict[str, int]:
        """The frames' numbers by their names."""
        return {name: k for k, name in enumerate(self.names)}


@dataclass(frozen=True)
class ChangedPart:
    """The part of a block that is solved anew. was (n,): of each frame of the whole block its number in the
    earlier one, -1 where it is new or no longer the same. frames (k,): numbers of the part's frames in the
    whole block, ascending; free (k,): which of them are solved; the others keep their earlier poses."""

    was: Ints
    frames: Ints
    free: Bools

    def of(self, block: Block) -> Block:
        """The part as a block: tie points of pairs with a frame that is solved."""
        part = part_of_block(block, self.frames)
        some = tuple(t for t in part.ties.pairs if self.free[t.left] or self.free[t.right])
        return replace(part, ties=TiePoints(some))


def changed_frames(block: Block, earlier: EarlierBlock) -> tuple[Ints, Bools]:
    """As `ChangedPart.was`; and which frames (n,) are new, are reported elsewhere, or have other tie points
    with others than before."""
    number, solved = earlier.number, earlier.solved
    known = frozenset() if solved is None else frozenset(solved.names)
    was = np.array([number[name] if name in known else -1 for name in block.names], dtype=np.intp)
    before, now = _ties_by_frame(earlier.names, earlier.ties), _ties_by_frame(block.names, block.ties)
    changed = np.array([before.get(name) != now.get(name) for name in block.names], dtype=bool)
    changed |= was < 0
    same, there = np.flatnonzero(was >= 0), was[was >= 0]
    given, reported = block.poses, earlier.given
    for its, other in (
        (given.positions_m, reported.positions_m),
        (given.rotations, reported.rotations),
        (given.positions_sd_m, reported.positions_sd_m),
        (given.rotations_sd_rad, reported.rotations_sd_rad),
    ):
        alike = np.isclose(its[same], other[there], rtol=SLIGHT, atol=SLIGHT, equal_nan=True)
        changed[same] |= ~alike.reshape(len(same), -1).all(axis=1)
    return was, changed


def by_known_flights(block: Block, was: Ints, earlier: EarlierBlock) -> Block:
    """The block whose flights with earlier frames are one, number 0. Where an earlier solution has an offset
    of each flight, their positions are freed of it. Other flights keep their own."""
    flights, known = block.flight_of, was >= 0
    if not flights.any():
        return block
    positions_m = block.poses.positions_m.copy()
    old = np.unique(flights[known])
    counts = np.flatnonzero(known & ~position_assumed(block.poses))
    found_m: Floats = earlier.adjusted.poses.positions_m[was[counts]]
    off_m = found_m[:, :2] - positions_m[counts, :2]
    if earlier.solved is not None and OFFSET in earlier.solved.shared:
        for flight in old.tolist():
            its = off_m[flights[counts] == flight]
            if len(its):
                positions_m[flights == flight, :2] += np.median(its, axis=0)
    numbers = np.where(np.isin(flights, old), -1, flights)
    numbers = np.unique(np.append(-1, numbers), return_inverse=True)[1][1:]
    poses = replace(block.poses, positions_m=positions_m)
    return replace(block, poses=poses, flights=tuple(numbers.tolist()))


def _ties_by_frame(names: tuple[str, ...], ties: TiePoints) -> Mapping[str, dict[str, int]]:
    """Of each frame the number of tie points with others, by their names."""
    pairs, out = TiePairs.of(ties.pairs), dict[str, dict[str, int]]()
    for (left, right), count in zip(pairs.frames.tolist(), pairs.counts.tolist(), strict=True):
        out.setdefault(names[left], {})[names[right]] = count
        out.setdefault(names[right], {})[names[left]] = count
    return out


def tied_with(block: Block, frames: Bools) -> Bools:
    """Those frames (n,) and all that have tie points with them."""
    ends = np.array(block.ties.frames, dtype=np.intp).reshape(-1, 2)
    out = frames.copy()
    out[ends[frames[ends].any(axis=1)].ravel()] = True
    return out


def moved_m(one: Adjusted, other: tuple[Poses, Ints], frames: Ints) -> Floats:
    """How far the corners of frames lie apart on the ground, the most of each frame (k,), in m. Args: other:
    other poses and the number (n,) of each of the block's frames there."""
    poses, at = other
    out = np.zeros(len(frames))
    for k, i in enumerate(frames.tolist()):
        found, before = (
            footprint(pose, one.cameras[i], one.ground, 1)[:, :2]
            for pose in (one.poses[i], poses[int(at[i])])
        )
        out[k] = float(np.nan_to_num(np.linalg.norm(found - before, axis=1), nan=np.inf).max())
    return out


def whole_block_shift_m(
    block: Block, found: tuple[Poses, Ints], earlier: EarlierBlock, corrected: bool = False
) -> float:
    """By how much, in m, the positions reported now would move the earlier frames. In plan they move as a
    similarity, whose turn is bound by headings. In height they move by a level and a slope, which is bound by
    attitudes. The fit to all positions of now is compared with the fit to those of then, at the earlier
    frames. Frames that are gone count as well as new ones. Flights all of whose frames are new do not: their
    positions are off in common by an error of their own.

    Args: found: all poses, and `ChangedPart.was`. corrected: of frames that are in both alone, where they
    were found then; their reported positions may be others now.
    """
    poses, was = found
    certain = frozenset() if earlier.solved is None else frozenset(earlier.solved.names)
    old_m, both = earlier.adjusted.poses.positions_m, was >= 0
    known = np.array([name in certain for name in earlier.names])
    at_m = poses.positions_m
    if corrected:
        at_m = at_m.copy()
        at_m[both] = old_m[was[both]]
    now, then = _placed(block.poses, at_m), _placed(earlier.given, old_m)
    if corrected:
        now &= both
        then &= np.isin(np.arange(len(then)), was[both])
    else:
        now &= np.isin(block.flight_of, block.flight_of[both])
    if not (known & then).any():
        return np.inf
    middle_m, moves_m = old_m[then].mean(axis=0), []
    for designs, turns in ((_plan, [(2, 2)]), (_heights, [(1, 1), (2, 0)])):
        fits = [
            _fitted(designs(at_m - middle_m), (reported, at_m, some), turns)
            for reported, at_m, some in (
                (block.poses, at_m, now), (earlier.given, old_m, then)
            )
        ]  # fmt: skip
        moves_m.append(np.linalg.norm(designs(old_m[known] - middle_m) @ (fits[0] - fits[1]), axis=1))
    aside = max(float(np.hypot(c.width_px, c.height_px)) / 2.0 / c.focal_length_px for c in block.cameras)
    return float((moves_m[0] + aside * moves_m[1]).max())


def _placed(reported: Poses, at_m: Floats) -> Bools:
    """Frames (n,) whose position was reported, and that are somewhere."""
    return ~position_assumed(reported) & np.isfinite(at_m).all(axis=1)


def _plan(at_m: Floats) -> Floats:
    """Rows (n, 2, 4) of a shift, a turn and a scale in plan."""
    zero, one = np.zeros(len(at_m)), np.ones(len(at_m))
    e, n = at_m[:, 0], at_m[:, 1]
    return np.stack([np.stack([one, zero, -n, e], 1), np.stack([zero, one, e, n], 1)], 1)


def _heights(at_m: Floats) -> Floats:
    """Rows (n, 1, 3) of a level and a slope."""
    return np.stack([np.ones(len(at_m)), at_m[:, 0], at_m[:, 1]], 1)[:, None]


def _fitted(design: Floats, of: tuple[Poses, Floats, Bools], turns: list[tuple[int, int]]) -> Floats:
    """Unknowns that reported positions, less those found (n, 3), ask for. of: what was reported, where it was
    found, which frames count. turns: unknowns that an axis of the attitudes binds."""
    reported, at_m, some = of
    its = slice(0, 2) if design.shape[1] == 2 else slice(2, 3)
    sd_m, sd_rad = reported.positions_sd_m[some, its], reported.rotations_sd_rad[some]
    miss_m = (reported.positions_m - at_m)[some, its]
    unknowns = design.shape[2]
    rows = [(design[some] / sd_m[..., None]).reshape(-1, unknowns)]
    rows += [np.eye(unknowns)[k] / sd_rad[:, axis, None] for k, axis in turns]
    side = np.zeros(sum(map(len, rows)))
    side[: len(rows[0])] = (miss_m / sd_m).ravel()
    return least_squares(np.concatenate(rows), side)
