"""Which frames of a block are solved anew after an earlier run: those whose tie points changed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from geomosaic.adjustment.model import Adjusted, Block, SolvedBlock
from geomosaic.adjustment.procedure.block_part import part_of_block
from geomosaic.arrays import Bools, Floats, Ints
from geomosaic.camera.exterior import Poses
from geomosaic.constants import SLIGHT
from geomosaic.estimation.linear import least_squares
from geomosaic.geodesy.local import LocalFrame
from geomosaic.matching.model import TiePairs, TiePoints
from geomosaic.placement.prior import position_assumed
from geomosaic.projection.footprint import footprint


@dataclass(frozen=True)
class EarlierBlock:
    """An adjusted block of an earlier run. names (n,): its frames; given: where they were reported;
    unchanged: names of the frames whose files are as they were; bound_m: by how much a place on the ground
    may differ from that of a whole adjustment; moved: turn (3, 3) and shift (3,) in m to the present work
    frame, None where it is the same."""

    names: tuple[str, ...]
    given: Poses
    ties: TiePoints
    adjusted: Adjusted
    unchanged: frozenset[str]
    bound_m: float

    moved: tuple[Floats, Floats] | None = None

    @property
    def solved(self) -> SolvedBlock | None:
        """What a whole adjustment begins from, of the unchanged frames."""
        solved = self.adjusted.solved
        if solved is None:
            return None
        solved = solved.of(self.unchanged)
        return solved if self.moved is None else solved.moved(*self.moved)

    def in_frame(self, was: LocalFrame, now: LocalFrame) -> EarlierBlock:
        """From one work frame to another. Of another one, only `solved` is known."""
        if was == now:
            return self
        turn = now.enu_from_local_rotation(was.lon_deg, was.lat_deg)
        shift_m = now.enu_from_geodetic(was.lon_deg, was.lat_deg, was.height_ellipsoidal_m)
        return replace(self, moved=(turn, shift_m))

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


def whole_block_shift_m(block: Block, poses: Poses, was: Ints) -> float:
    """By how much, in m, the positions of new frames would move the earlier frames. In plan they move as a
    similarity, whose turn is bound by headings. In height they move by a level and a slope, which is bound by
    attitudes. The fit to all reported positions is compared with the fit to those of the earlier frames, at
    the earlier frames.

    Args: poses: all as found. was: see `ChangedPart`.
    """
    given, old = block.poses, was >= 0
    known = ~position_assumed(given)
    miss_m, before = given.positions_m - poses.positions_m, known & old
    if not before.any():
        return np.inf
    e, n = (poses.positions_m[:, :2] - poses.positions_m[before, :2].mean(axis=0)).T
    zero, one = np.zeros(len(e)), np.ones(len(e))
    plan = np.stack([np.stack([one, zero, -n, e], 1), np.stack([zero, one, e, n], 1)], 1)
    height = np.stack([one, e, n], 1)[:, None]
    sd_m, sd_rad = given.positions_sd_m, given.rotations_sd_rad
    moves_m = []
    for design, its, turns in ((plan, np.s_[:, :2], [(2, 2)]), (height, np.s_[:, 2:], [(1, 1), (2, 0)])):
        found = []
        for some in (known, before):
            rows = [(design[some] / sd_m[its][some][..., None]).reshape(-1, design.shape[2])]
            rows += [np.eye(design.shape[2])[k] / sd_rad[some, axis, None] for k, axis in turns]
            side = np.zeros(sum(map(len, rows)))
            side[: len(rows[0])] = (miss_m[its][some] / sd_m[its][some]).ravel()
            found.append(least_squares(np.concatenate(rows), side))
        moves_m.append(np.linalg.norm(design[old] @ (found[0] - found[1]), axis=1))
    aside = max(float(np.hypot(c.width_px, c.height_px)) / 2.0 / c.focal_length_px for c in block.cameras)
    return float((moves_m[0] + aside * moves_m[1]).max())
