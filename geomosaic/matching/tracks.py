"""Keypoints that tie points join: one place on the ground, seen in two or more frames."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from geomosaic.arrays import Bools, Floats, Ints
from geomosaic.camera.exterior import Poses
from geomosaic.camera.interior import Camera
from geomosaic.constants import tuned
from geomosaic.estimation.linear import solve_each
from geomosaic.matching.model import TiePair, TiePairs, TiePoints

MOST_TIED = tuned(
    2_500_000, "tied keypoints", "of a block: more take 0.6 kB of memory each; fewer: noise counts"
)
FEW_PER_FRAME = tuned(192, "image observations a frame", "for solves that find the block or compare lenses")
FEW_CELLS = tuned(8, "cells a side", "of a frame, 3 observations each; fewer: corners may stay empty")
_OVER = tuned(1.25, "times the observations asked for", "of the median frame; more: each asks for fewer")
_PARALLEL: float = tuned(float(np.radians(0.5) ** 2), "rad²", "of rays all but parallel; more: near_m wins")


@dataclass(frozen=True, eq=False)
class Joined(TiePairs):
    """Pairs and the tracks that their keypoints belong to: track (n,), once (n,): whether it sees no frame
    twice."""

    track: Ints
    once: Bools

    @property
    def degree(self) -> Ints:
        """In how many tie points each keypoint stands, (n,)."""
        return np.bincount(self.keypoints.ravel(), minlength=len(self.frame))

    def thinned(self, chosen: Bools, image_px: Floats, least: int) -> TiePairs:
        """The tie points of chosen keypoints (n,), which lie at image_px; a pair that would keep fewer than
        `least` keeps all it had."""
        kept = chosen[self.keypoints].all(axis=0)
        few = np.diff(np.concatenate([[0], np.cumsum(kept)])[self.first]) < least
        return self.part(kept | np.repeat(few, self.counts), image_px)


def join(pairs: Sequence[TiePair]) -> Joined:
    """Keypoints that are connected by tie points, however far, are of one track."""
    all_of = TiePairs.of(pairs)
    n = len(all_of.frame)
    ones = np.ones(all_of.keypoints.shape[1], np.int8)
    graph = coo_matrix((ones, tuple(all_of.keypoints)), shape=(n, n))
    count, track = connected_components(graph, directed=False)
    order = np.lexsort((all_of.frame, track))
    twice = (np.diff(track[order]) == 0) & (np.diff(all_of.frame[order]) == 0)
    once = np.ones(count, np.bool_)
    once[track[order[1:]][twice]] = False
    return Joined(
        *(all_of.frame, all_of.image_px, all_of.frames, all_of.counts, all_of.keypoints),
        track=track.astype(np.intp),
        once=once[track],
    )


def references(joined: Joined, sizes_px: Floats) -> Ints:
    """For each keypoint the one of its track that stands for the place on the ground, (n,). It is the one
    with most tie points; of several, the nearest to its frame's middle, where the ground is seen most from
    above.

    Args: sizes_px (frames, 2): width and height of each frame.
    """
    aside = np.linalg.norm(joined.image_px / sizes_px[joined.frame] - 0.5, axis=1)
    order = np.lexsort((aside, -joined.degree, joined.track))
    first = np.diff(joined.track[order], prepend=-1) != 0
    return np.asarray(order[first][joined.track], np.intp)


@dataclass(frozen=True)
class Tracks:
    """m image observations of p ground points, sorted by point: frame, point (m,) and image_px (m, 2). Every
    point is observed in at least two frames, in each of them once. memo: derived quantities, computed
    once."""

    frame: Ints
    point: Ints
    image_px: Floats
    memo: dict[tuple[int, int], Any] = field(default_factory=dict, repr=False, compare=False)

    @property
    def points(self) -> int:
        """How many ground points there are."""
        return int(self.point[-1]) + 1 if len(self.point) else 0

    @cached_property
    def lengths(self) -> Ints:
        """In how many frames each point is seen, (p,)."""
        return np.bincount(self.point, minlength=self.points)


def join_tracks(ties: TiePoints) -> Tracks:
    """Connected keypoints become tracks; a track that meets a frame twice is dropped as contradictory."""
    return _tracks_of(join(ties.pairs))[0]


def _tracks_of(joined: Joined) -> tuple[Tracks, Ints]:
    """The tracks that see no frame twice, and the keypoint of each of their observations (m,)."""
    order = np.lexsort((joined.frame, joined.track))
    good = order[joined.once[order]]
    point = np.cumsum(np.diff(joined.track[good], prepend=joined.track[good[:1]]) != 0)
    return Tracks(joined.frame[good].astype(np.intp), point, joined.image_px[good]), good


def thin_pairs(pairs: TiePairs, sizes_px: Floats, least: int, most: int) -> TiePairs:
    """The tie points of a block with at most about so many tied keypoints, as `asked_tracks` chooses them, so
    that its memory does not grow with the frames. A pair that would keep fewer than `least` keeps all."""
    if len(pairs.frame) <= most:
        return pairs
    joined = join(pairs)
    tracks, keypoint = _tracks_of(joined)
    asked = asked_tracks(tracks, sizes_px, most // len(sizes_px))
    chosen = np.zeros(len(joined.frame), dtype=np.bool_)
    chosen[keypoint] = asked[tracks.point]
    return joined.thinned(chosen, joined.image_px, least)


def frame_by_frame(frame: Ints) -> Iterator[tuple[int, Ints]]:
    """Each frame that occurs among observations (m,), and which ones are its."""
    order = np.argsort(frame, kind="stable")
    for mine in np.split(order, np.flatnonzero(np.diff(frame[order])) + 1) if len(frame) else []:
        yield int(frame[mine[0]]), mine


def chosen_tracks(tracks: Tracks, chosen: Bools) -> Tracks:
    """Some of the tracks: chosen (p,)."""
    keep = chosen[tracks.point]
    number = np.cumsum(chosen) - 1
    return Tracks(tracks.frame[keep], number[tracks.point[keep]], tracks.image_px[keep])


def thin_tracks(tracks: Tracks, sizes_px: Floats, per_frame: int, cells: int = 16) -> Tracks:
    """Those of `asked_tracks`."""
    asked = asked_tracks(tracks, sizes_px, per_frame, cells)
    return tracks if asked.all() else chosen_tracks(tracks, asked)


def asked_tracks(tracks: Tracks, sizes_px: Floats, per_frame: int, cells: int = 16) -> Bools:
    """Which tracks (p,) give about per_frame observations a frame at most, spread evenly, long ones first.
    Each frame asks for its longest tracks, cell by cell of a grid of cells x cells; a track stays if any
    frame asks for it. Args: sizes_px (frames, 2): width and height of each frame."""
    counts = np.bincount(tracks.frame, minlength=len(sizes_px))
    if not len(tracks.frame) or counts.max() <= per_frame:
        return np.ones(tracks.points, dtype=bool)
    cell = tracks.frame.astype(np.int32)
    for px, side_px in zip(tracks.image_px.T[::-1], sizes_px.T[::-1], strict=True):
        cell *= cells
        cell += np.clip(px / side_px[tracks.frame] * cells, 0, cells - 1).astype(np.int32)
    order = np.lexsort((tracks.point, -tracks.lengths[tracks.point], cell))
    begins = np.flatnonzero(np.diff(cell[order], prepend=-1))
    within = np.diff(begins, append=len(order))
    rank = np.arange(len(order), dtype=np.int32) - np.repeat(begins.astype(np.int32), within)
    point = tracks.point[order]
    for need in range(max(1, per_frame // cells**2), 0, -1):
        asked = np.zeros(tracks.points, dtype=bool)
        asked[point[rank < need]] = True
        taken = np.bincount(tracks.frame[asked[tracks.point]], minlength=len(sizes_px))
        if np.median(taken) <= _OVER * per_frame:
            break
    return asked


def nearest_to_rays(tracks: Tracks, poses: Poses, cameras: Sequence[Camera], near_m: Floats) -> Floats:
    """Points (p, 3) with the least squared distances to their rays; where these are parallel to within half a
    degree, drawn along them to near_m (p, 3)."""
    normal, side = np.zeros((tracks.points, 3, 3)) + _PARALLEL * np.eye(3), _PARALLEL * near_m
    for i, mine in frame_by_frame(tracks.frame):
        image_px, seen = tracks.image_px[mine], tracks.point[mine]
        ray = poses[i].ray_from_image(cameras[i], image_px)
        ray /= np.linalg.norm(ray, axis=1)[:, None]
        across = np.eye(3) - ray[:, :, None] * ray[:, None, :]
        normal[seen] += across
        side[seen] += (across @ poses[i].centre_at(cameras[i], image_px)[:, :, None])[:, :, 0]
    return solve_each(normal, side[:, :, None])[:, :, 0]
