"""Whether tie points taken from the dense surface would fix the adjustment that it was matched on.

    python -m tools.bench.bench_ties_on_surface RUN ... [--folds 5] [--truth positions.csv]

RUN: folders of finished runs with `--surface dense`. Of each square of ground, 32 across a frame, the sure
cell of most texture is sought in every frame that sees it. A window of the frame that looks at it most from
above, warped by the surface's slope, is matched by least squares, and back again. Then the block is solved by
its own tie points and by these besides, with the model of lens and shutter that the run had chosen. A fifth
of the places (a quarter of the flying height wide) is left out in turn. Both solutions are judged by the tie
points of either kind there. With --truth (of `geomosaic simulate`) by the true positions, too.

Besides: how far tie points of three views and more, which agree to two deviations, lie off the surface. Where
they do, it is the surface that is wrong, and not the poses.
"""

from __future__ import annotations

import argparse
import csv
import os
from dataclasses import dataclass, replace
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import cv2
import numpy as np
from numpy.typing import NDArray

from geomosaic.adjustment.model import Adjusted, Block, Settings
from geomosaic.adjustment.procedure.bundle_method import pose_block
from geomosaic.adjustment.procedure.cross_validation import ModelScore
from geomosaic.adjustment.procedure.model_selection import with_readout
from geomosaic.camera.exterior import Pose
from geomosaic.camera.interior import Camera
from geomosaic.matching.affine_matching import TEMPLATE_PX, find, templates
from geomosaic.matching.model import TiePair, TiePoints
from geomosaic.matching.tracks import (
    Tracks,
    chosen_tracks,
    frame_by_frame,
    join_tracks,
    nearest_to_rays,
)
from geomosaic.pipeline.run_results import load_artefact, read_summary
from geomosaic.placement.model import Placement
from geomosaic.projection.footprint import ground_sampling_distance_m
from geomosaic.projection.ground import GroundSurface
from geomosaic.projection.horizon import hidden_m
from geomosaic.stages.adjustment_solve import block_of
from geomosaic.stages.keypoints import FrameReduction, frame_brightness
from geomosaic.surface.model import DenseSurface
from geomosaic.survey.model import Survey
from geomosaic.survey.small import FrameToDecode

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]
PER_SIDE = 32
LONGEST_PX = 3000  # as matching.sift looks at frames
SURE_CELLS = 0.5  # deviation of a cell that is taken
FLAT_CELLS = 2.5  # heights around it differ by less
BACK_PX = 0.3  # from where it began a window comes back to
PLACE = 0.25  # flying heights, as procedure.cross_validation
AT_ONCE = 1000


@dataclass(frozen=True)
class SurfaceRun:
    """What a finished run found."""

    survey: Survey
    adjusted: Adjusted
    surface: DenseSurface
    block: Block

    @classmethod
    def of(cls, folder: Path) -> SurfaceRun:
        run_summary = read_summary(folder)
        kinds = {"survey": Survey, "prior_ground": GroundSurface, "placement": Placement, "ties": TiePoints}
        block = block_of(*(load_artefact(folder, run_summary, name, kind) for name, kind in kinds.items()))
        return cls(
            load_artefact(folder, run_summary, "survey", Survey),
            load_artefact(folder, run_summary, "adjusted", Adjusted),
            load_artefact(folder, run_summary, "surface", DenseSurface),
            block,
        )

    def solved(self, own: Tracks, more: Tracks | None) -> Adjusted:
        """By the tie points of the run and by others besides, with the model that it had chosen."""
        block, settings = self.block, Settings(model="given")
        taken = () if self.adjusted.model is None else self.adjusted.model.taken
        if "readout" in taken or "turning" in taken:
            block, settings = with_readout(block, settings)
        settings = replace(settings, turning="turning" in taken)
        return pose_block(replace(block, ties=ties_of(own if more is None else joined(own, more))), settings)


def sure_cells(surface: DenseSurface) -> tuple[Floats, Floats]:
    """Middles (p, 3) of cells that are sure and next to no step, and how the surface slopes there (p, 2)."""
    cell_m = surface.cells.cell_m
    up_m = cv2.medianBlur(np.ascontiguousarray(surface.up_m), 5)
    around = np.ones((5, 5), np.uint8)
    level = cv2.dilate(up_m, around) - cv2.erode(up_m, around) < FLAT_CELLS * cell_m
    sure = (surface.views >= 2) & (np.nan_to_num(surface.sd_m, nan=np.inf) < SURE_CELLS * cell_m) & level
    smooth = cv2.GaussianBlur(up_m, (0, 0), 2.0).astype(np.float64)
    slopes = [cv2.Sobel(smooth, cv2.CV_64F, *way) / 8.0 / cell_m for way in ((1, 0), (0, 1))]
    east, north = surface.cells.axes_m()
    row, col = np.nonzero(sure)
    return (
        np.column_stack([east[col], north[row], surface.up_m[row, col]]),
        np.column_stack([s[row, col] for s in slopes]),
    )


def seen(run: SurfaceRun, i: int, points_m: Floats, margin_px: float) -> tuple[Ints, Floats]:
    """Which points a frame sees, and where."""
    camera, pose = run.adjusted.cameras[i], run.adjusted.poses[i]
    px = pose.image_from_ground(camera, points_m)
    size = np.array([camera.width_px, camera.height_px])
    inside = np.flatnonzero(((px > margin_px) & (px < size - margin_px)).all(axis=1))
    if not len(inside):
        return inside, px[inside]
    many = np.concatenate([inside, np.repeat(inside[-1:], -len(inside) % AT_ONCE)])
    below_m = hidden_m(run.surface.ground(), pose.position_m, points_m[many].reshape(-1, AT_ONCE, 3))
    inside = inside[below_m.ravel()[: len(inside)] <= SURE_CELLS * run.surface.cells.cell_m]
    return inside, px[inside]


def by_ground(pose: Pose, camera: Camera, points_m: Floats, slope: Floats, step_m: float) -> Floats:
    """Columns and rows of a frame over east and north along the surface, (p, 2, 2)."""
    ways = []
    for axis in (0, 1):
        step = np.zeros_like(points_m)
        step[:, axis], step[:, 2] = step_m, step_m * slope[:, axis]
        before, after = (pose.image_from_ground(camera, points_m + sign * step) for sign in (-1.0, 1.0))
        ways.append((after - before) / (2.0 * step_m))
    return np.stack(ways, axis=-1)


def surface_ties(run: SurfaceRun) -> Tracks:
    """Places on the surface, sought in all frames that see them; what was asked for is printed."""
    poses, cameras = run.adjusted.poses, run.adjusted.cameras
    used = [i for i, status in enumerate(run.adjusted.status) if status != "rejected"]
    sight, cell_m = FrameReduction(LONGEST_PX), run.surface.cells.cell_m
    shrunk = np.array([sight.reduction(f) for f in run.survey.frames])
    greys = {i: frame_brightness(sight, FrameToDecode(run.survey.frames[i])).grey for i in used}
    points, slope = sure_cells(run.surface)
    looks = {i: seen(run, i, points, float(TEMPLATE_PX * shrunk[i])) for i in used}
    slant, first = np.full(len(points), np.inf), np.full(len(points), -1)
    for i, (which, _) in looks.items():
        off = points[which] - poses.positions_m[i]
        here = np.linalg.norm(off[:, :2], axis=1) / -off[:, 2]
        nearer = which[here < slant[which]]
        slant[nearer], first[nearer] = here[here < slant[which]], i
    views = np.bincount(np.concatenate([which for which, _ in looks.values()]), minlength=len(points))
    texture, shown_px = np.zeros(len(points)), np.zeros((len(points), 2))
    for i, (which, px) in looks.items():
        corners = cv2.cornerMinEigenVal(cv2.GaussianBlur(greys[i], (0, 0), 0.6).astype(np.float32), 15, 3)
        mine = first[which] == i
        col, row = (px[mine] / shrunk[i]).astype(np.intp).T
        texture[which[mine]], shown_px[which[mine]] = corners[row, col], px[mine]
    pixel_m = np.median([ground_sampling_distance_m(poses[i], cameras[i], run.adjusted.ground) for i in used])
    across = np.sqrt(cameras[used[0]].width_px * cameras[used[0]].height_px) * pixel_m
    squares = np.unique(np.floor(points[:, :2] * PER_SIDE / across), axis=0, return_inverse=True)[1].ravel()
    order = np.lexsort((-texture, squares))
    order = order[views[order] >= 2]
    chosen = np.sort(order[np.diff(squares[order], prepend=-1) != 0])
    points, slope, first, shown_px = (a[chosen] for a in (points, slope, first, shown_px))
    shapes = np.stack([by_ground(poses[i], cameras[i], points, slope, cell_m) for i in range(len(poses))])
    frame, point, at_px, asked = [first], [np.arange(len(chosen))], [shown_px], 0
    for i in used:
        here, near_px = seen(run, i, points, float(TEMPLATE_PX * shrunk[i]))
        for j in np.unique(first[here]):
            if j == i:
                continue
            which = here[first[here] == j]
            asked += len(which)
            warp = shapes[i, which] @ np.linalg.inv(shapes[j, which]) * (shrunk[j] / shrunk[i])
            windows = templates(greys[j], shown_px[which] / shrunk[j])
            there = find(windows, greys[i], near_px[first[here] == j] / shrunk[i], warp)
            returned = templates(greys[i], there.image_px)
            back = find(returned, greys[j], shown_px[which] / shrunk[j], np.linalg.inv(warp))
            off_px = np.linalg.norm(back.image_px * shrunk[j] - shown_px[which], axis=1)
            good = there.sure & back.sure & (off_px < BACK_PX)
            frame.append(np.full(good.sum(), i))
            point.append(which[good])
            at_px.append(there.image_px[good] * shrunk[i])
    frames, numbers = np.concatenate(frame), np.concatenate(point)
    found = len(numbers) - len(chosen)
    share = found / max(asked, 1)
    print(f"  {len(chosen)} places sought {asked} times: {share:.2f} found, back to {BACK_PX} px")
    kept = np.bincount(numbers)[numbers] >= 2
    number = np.unique(numbers[kept], return_inverse=True)[1]
    order = np.lexsort((frames[kept], number))
    return Tracks(frames[kept][order], number[order], np.concatenate(at_px)[kept][order])


def joined(one: Tracks, other: Tracks) -> Tracks:
    """Both, those of the second after the first."""
    return Tracks(
        np.concatenate([one.frame, other.frame]),
        np.concatenate([one.point, other.point + one.points]),
        np.concatenate([one.image_px, other.image_px]),
    )


def ties_of(tracks: Tracks) -> TiePoints:
    """Every pair of a track's frames."""
    ends = [
        (np.arange(len(tracks.point) - by), np.arange(by, len(tracks.point)))
        for by in range(1, int(tracks.lengths.max(initial=1)))
    ]
    left, right = (np.concatenate(side) for side in zip(*ends, strict=True))
    same = tracks.point[left] == tracks.point[right]
    left, right = left[same], right[same]
    pairs, which = np.unique(
        np.column_stack([tracks.frame[left], tracks.frame[right]]), axis=0, return_inverse=True
    )
    made = []
    for k, (a, b) in enumerate(pairs.tolist()):
        i, j = left[which.ravel() == k], right[which.ravel() == k]
        px = tracks.image_px
        made.append(TiePair(a, b, px[i], px[j], i.astype(np.int32), j.astype(np.int32)))
    return TiePoints(tuple(made))


def left_px(tracks: Tracks, of: Adjusted) -> tuple[Floats, Floats]:
    """Deviations (t,) of tracks that a solution leaves, and their points (t, 3)."""
    below = np.median(of.poses.positions_m, axis=0) - [0.0, 0.0, flying_height_m(of)]
    points = nearest_to_rays(tracks, of.poses, of.cameras, np.broadcast_to(below, (tracks.points, 3)))
    off = np.empty_like(tracks.image_px)
    for i, mine in frame_by_frame(tracks.frame):
        seen_px = of.poses[i].image_from_ground(of.cameras[i], points[tracks.point[mine]])
        off[mine] = tracks.image_px[mine] - seen_px
    squares = np.bincount(tracks.point, (off**2).sum(axis=1), tracks.points)
    return np.sqrt(squares / (2.0 * tracks.lengths - 3.0)), points


def flying_height_m(of: Adjusted) -> float:
    """Of the frames above the ground."""
    at = of.poses.positions_m
    return float(np.median(at[:, 2] - of.ground.up_at(at[:, 0], at[:, 1])))


def print_heights(run: SurfaceRun, own: Tracks) -> None:
    """How far sure tie points lie off the surface."""
    long = chosen_tracks(own, own.lengths >= 3)
    error_px, points = left_px(long, run.adjusted)
    cells, cell_m = run.surface.cells, run.surface.cells.cell_m
    col, row = np.floor((points[:, :2] - [cells.west_m, cells.south_m]) / cell_m).astype(np.intp).T
    on = (col >= 0) & (row >= 0) & (col < cells.cols) & (row < cells.rows)
    on &= error_px < 2.0 * run.adjusted.figures["sigma_px"]
    at = row[on], col[on]
    off_m = np.abs(points[on, 2] - run.surface.up_m[at])
    views, sd_m = run.surface.views[at], run.surface.sd_m[at]
    kinds = {"all": views >= 0, "filled": views == 0, "2 views": views == 2, "3 and more": views > 2}
    kinds |= {"sure to 0.3 cells": sd_m < 0.3 * cell_m, "unsure by a cell": sd_m >= cell_m}
    for name, of in kinds.items():
        if of.sum() >= 10:
            far = (off_m[of] > 3.0 * cell_m).mean()
            text = f"median {np.median(off_m[of]):.3f} m, {100.0 * far:.1f} % off by more than 3 cells"
            print(f"  tie points off the surface, {name}: {of.sum()}, {text}")


def print_left_out(run: SurfaceRun, own: Tracks, more: Tracks, folds: int) -> None:
    """What both solutions leave of tie points in places that neither has seen."""
    side_m, kinds = PLACE * flying_height_m(run.adjusted), {"its own": own, "the surface's": more}
    squares = [np.floor(left_px(t, run.adjusted)[1][:, :2] / side_m) for t in kinds.values()]
    place = np.unique(np.concatenate(squares), axis=0, return_inverse=True)[1].ravel()
    turn = np.random.default_rng(7).permutation(place.max() + 1) % folds
    places = dict(zip(kinds, np.split(place, [own.points]), strict=True))
    left: dict[str, list[tuple[Floats, Floats, Ints]]] = {name: [] for name in kinds}
    for k in range(folds):
        out = {name: turn[places[name]] == k for name in kinds}
        fewer = [chosen_tracks(t, ~out[name]) for name, t in kinds.items()]
        before, after = run.solved(fewer[0], None), run.solved(fewer[0], fewer[1])
        for name, t in kinds.items():
            judges = chosen_tracks(t, out[name])
            each = (left_px(judges, of)[0] for of in (before, after))
            left[name].append((*each, places[name][out[name]]))
    for name, parts in left.items():
        before_px, after_px, where = (np.concatenate(part) for part in zip(*parts, strict=True))
        judged = [ModelScore(run.adjusted, px, where) for px in (before_px, after_px)]
        share, most = judged[1].compared_to(judged[0])
        text = f"median {judged[0].median_px:.4f} px, with the surface's {judged[1].median_px:.4f}"
        print(f"  left-out tie points, {name}: {text}; share {share:.3f}, at most {most:.3f}", flush=True)


def print_truth(run: SurfaceRun, truth: Path, solutions: dict[str, Adjusted]) -> None:
    """Positions against the true ones, after the best similarity."""
    with truth.open(newline="") as file:
        rows = list(csv.DictReader(file))
    columns = ("lon_deg", "lat_deg", "height_ellipsoidal_m")
    true = run.survey.work_frame.enu_from_geodetic(*(np.array([float(r[c]) for r in rows]) for c in columns))
    true = true - true.mean(axis=0)
    for name, of in solutions.items():
        found = of.poses.positions_m - of.poses.positions_m.mean(axis=0)
        u, size, v = np.linalg.svd(true.T @ found)
        scale = size.sum() / (found**2).sum()
        off = true - scale * found @ (u @ v).T
        plan, up = np.sqrt((off[:, :2] ** 2).sum(axis=1).mean()), np.sqrt((off[:, 2] ** 2).mean())
        print(f"  positions by {name}: {1000.0 * plan:.1f} mm in plan, {1000.0 * up:.1f} mm up, RMSE")


def main() -> None:
    """Judges each run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("runs", type=Path, nargs="+")
    parser.add_argument("--folds", type=int, default=5, help="of places left out; 0: none are")
    parser.add_argument("--truth", type=Path, help="positions.csv of a simulated survey")
    args = parser.parse_args()
    for folder in args.runs:
        print(folder, flush=True)
        run = SurfaceRun.of(folder)
        own = join_tracks(run.block.ties)
        print_heights(run, own)
        more = surface_ties(run)
        print(f"  tracks: {own.points} of its own, {more.points} from the surface", flush=True)
        if args.truth is not None:
            both = {"its own": run.solved(own, None), "both": run.solved(own, more)}
            print_truth(run, args.truth, both)
        if args.folds:
            print_left_out(run, own, more, args.folds)


if __name__ == "__main__":
    main()
