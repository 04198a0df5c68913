"""Where an unsure lens begins: several starts, compared on a few frames before the whole block is solved."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Final

import numpy as np

from geomosaic.adjustment.ground.ground_choice import LEAST_POINTS, flying_height_m
from geomosaic.adjustment.model import Block, Settings
from geomosaic.adjustment.paper.misalignment import offset_net
from geomosaic.adjustment.procedure.block_part import neighbours, part_of_block
from geomosaic.adjustment.procedure.block_problem import block_problem
from geomosaic.adjustment.procedure.block_solution import points_on_ground
from geomosaic.adjustment.procedure.cross_validation import (
    BETTER,
    LEFT_OUT,
    LeftOutTest,
    ModelScore,
    left_out_px,
    left_out_residuals,
    places,
)
from geomosaic.adjustment.procedure.initialisation import placed_by_images, start_poses
from geomosaic.adjustment.procedure.model_selection import contradicts
from geomosaic.adjustment.solver.solve import SolveOptions, solved_start
from geomosaic.adjustment.terms.interior_orientation import WIDE_FOCAL, far_off
from geomosaic.camera.interior import Camera
from geomosaic.constants import tuned
from geomosaic.errors import NotSolvableError
from geomosaic.matching.tracks import FEW_CELLS, FEW_PER_FRAME, chosen_tracks, join_tracks, thin_tracks
from geomosaic.placement.prior import position_assumed
from geomosaic.spread import Spread
from geomosaic.survey.accuracy import FOCAL_LENGTH
from geomosaic.survey.model import Warn

_FRAMES = tuned(10, "frames", "of one camera to compare starts on: with fewer focal lengths are chance")
_BROWN = tuned((0.5, 0.67, 0.9, 1.2, 1.6), "focal lengths by longer side", "fewer: solves end elsewhere")
_FISHEYE = tuned((0.35, 0.5, 0.75, 1.1, 1.6), "the same of fisheyes", "8 mm on APS-C is 0.34: fewer miss one")
STARTS = tuple((kind, f) for kind, shares in (("brown", _BROWN), ("fisheye", _FISHEYE)) for f in shares)
_FREED: Final = FOCAL_LENGTH["assumed"].sd_relative


def unsure(camera: Camera) -> bool:
    """Whether so little is known of a focal length that other starts are tried."""
    return camera.focal_length_sd_px > WIDE_FOCAL * camera.focal_length_px


def with_lens_starts(block: Block, settings: Settings, spread: Spread) -> Block:
    """The block whose uncertain lenses begin where tie points left out of small solves are predicted best.
    Each start is solved on up to ten well-overlapping frames, and taken where it is surely better than the
    given one (`ModelScore.beats`). A reported focal length becomes uncertain where these frames contradict
    it, and positions allow another one."""
    starts = {c.name: _begun(block, settings, spread, c) for c in block.lenses}
    if all(starts[c.name] == c for c in block.lenses):
        return block
    return replace(block, cameras=tuple(starts[c.name] for c in block.cameras))


def lens_notes(block: Block, cameras: Sequence[Camera]) -> tuple[list[str], list[Warn]]:
    """What the images found of uncertain lenses, and a warning for each reported focal length that they
    contradict. Args: cameras: of each frame, adjusted."""
    notes, warnings = [], []
    found = {c.name: c for c in cameras}
    for given in block.lenses:
        focal_px = found[given.name].focal_length_px
        if unsure(given):
            kind = "a fisheye lens" if found[given.name].kind == "fisheye" else "a lens"
            notes.append(f"{given.name}: {kind} of {focal_px:.0f} px by the images")
        elif far_off(given, focal_px):
            text = (
                f"{given.name}: the images contradict the reported focal length of "
                f"{given.focal_length_px:.0f} px; solved anew, {focal_px:.0f} px; the map's scale rests on "
                "positions: give the camera's interior orientation with --camera FILE"
            )
            warnings.append(Warn("focal-length-contradicted", "", text))
    return notes, warnings


def _begun(block: Block, settings: Settings, spread: Spread, camera: Camera) -> Camera:
    """The lens that a camera begins with."""
    known = camera.distortion_sd or not camera.focal_length_sd_px
    if known and not unsure(camera):
        return camera
    part = _part(block, camera)
    if len(part.names) < 2:
        return camera
    sizes = np.array([[c.width_px, c.height_px] for c in part.cameras])
    tracks = thin_tracks(join_tracks(part.ties), sizes, FEW_PER_FRAME, FEW_CELLS)
    if tracks.points < LEAST_POINTS:
        return camera
    out = np.random.default_rng(0).permutation(tracks.points) % LEFT_OUT == 0
    judges = chosen_tracks(tracks, out)
    at_m, judges = points_on_ground(part.poses, part.cameras, part.ground, judges)
    if not judges.points:
        return camera
    still = replace(settings, rolling_shutter=False, turning=False)
    place = places(at_m, flying_height_m(part))
    test = LeftOutTest(chosen_tracks(tracks, ~out), judges, place)

    def judged(name: str, lenses: Sequence[Camera]) -> list[ModelScore]:
        """What each lens leaves, of cameras whose rows are read at once."""
        at_once = [replace(lens, readout_s=0.0, readout_sd_s=0.0) for lens in lenses]
        blocks = [replace(part, cameras=(lens,) * len(part.names)) for lens in at_once]
        keys = [f"{c.kind} {c.focal_length_px:.1f} {c.focal_length_sd_px:.1f}" for c in at_once]
        return spread.map(name, partial(_tried, still, test), blocks, keys)

    if not unsure(camera):
        if camera.readout_s and position_assumed(part.poses).all():
            return camera  # rows read at unknown velocities stretch images as another focal length does
        free = replace(camera, focal_length_sd_px=_FREED * camera.focal_length_px)
        as_given, freed = judged(f"lens of {camera.name}", [camera, free])
        if freed.solved is None or not freed.beats(as_given) or contradicts(freed.solved, as_given.solved):
            return camera
        if not far_off(camera, freed.solved.cameras[0].focal_length_px):
            return camera
        camera = free
    longer, blank = (
        max(camera.width_px, camera.height_px),
        replace(camera, k1=0.0, k2=0.0, k3=0.0, p1=0.0, p2=0.0),
    )
    others = [replace(blank, kind=kind, focal_length_px=share * longer) for kind, share in STARTS]
    tried = [replace(c, focal_length_sd_px=WIDE_FOCAL * c.focal_length_px) for c in (camera, *others)]
    given, *rest = judged(f"focal lengths of {camera.name}", tried)
    better = [its for its in rest if its.beats(given)]
    if not better:
        return camera
    least_px = min(its.median_px for its in better)
    best = next(its for its in better if BETTER * its.median_px <= least_px)
    assert best.solved is not None
    lens = best.solved.cameras[0]
    return replace(
        camera, kind=lens.kind, focal_length_px=lens.focal_length_px, k1=lens.k1, k2=lens.k2, k3=lens.k3
    )


def _tried(settings: Settings, test: LeftOutTest, block: Block) -> ModelScore:
    """A lens's own solve, begun as a block is, and what it leaves at the other tracks."""
    nothing = ModelScore(None, np.full(test.judges.points, np.inf), test.place)
    try:
        start = start_poses(block, offset_net(block))
        block = placed_by_images(block, start)
        points, kept = points_on_ground(start, block.cameras, block.ground, test.solving)
        if 2 * len(points) < test.solving.points:
            return nothing
        problem = block_problem(block, settings, kept, points)
        solved = solved_start(problem, start, None, SolveOptions(rough=True))
        left_px = left_out_px(test.judges, left_out_residuals(test.judges, block, solved))
    except (NotSolvableError, np.linalg.LinAlgError):
        return nothing
    return ModelScore(solved.of_points(solved.points_m), left_px, test.place)


def _part(block: Block, camera: Camera) -> Block:
    """Well-overlapping frames of a camera, all rows read at once."""
    mine = np.array([c.name == camera.name for c in block.cameras])
    part = part_of_block(block, neighbours(block, mine, _FRAMES))
    poses = replace(part.poses, velocities_m_per_s=None, turns=None)
    return replace(part, poses=poses, sequence=tuple(range(len(part.names))))
