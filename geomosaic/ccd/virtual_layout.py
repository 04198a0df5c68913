"""The scene of an ideal unbroken line: each of its pixels by way of the ground into the real CCDs."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import make_interp_spline

from geomosaic.arrays import Floats
from geomosaic.camera.pushbroom import Pushbroom
from geomosaic.ccd.layout import Ends, StripLookup
from geomosaic.ccd.line_poses import SPARE_LINES, STEP_LINES, LinePoses
from geomosaic.ccd.object_space import SAMPLE_LINES, ObjectSpace
from geomosaic.constants import tuned
from geomosaic.errors import InputError
from geomosaic.estimation.linear import least_squares
from geomosaic.survey.strips import StripGeometry

KNOT_PX = tuned(64, "columns", "knot spacing: 64 is off by 2e-4 px, 256 by 4e-3; closer takes time")
_NOWHERE_PX = tuned(-1e6, "px", "a place no line sees: nearer ones would draw parts of the strip there")


def ideal_camera(geometry: StripGeometry, model: Pushbroom) -> Pushbroom:
    """One unbroken line of CCDs on the strips' orbit, looking midway between the rows; scene line = its line.

    Its attitude is the straight line through the real one over the scene, its columns lie evenly, as near to
    the real ones as may be.
    """
    g, last = geometry, max(geometry.lines)
    lines = np.arange(0.0, last + 1.0)
    share = lines / last - 0.5
    level, slope = least_squares(np.stack([np.ones_like(share), share], axis=1), model.attitude_rad(lines))
    spare = g.row_separation_lines + SPARE_LINES
    at = np.linspace(-spare, last + spare, 4)
    attitude = level + (at / last - 0.5)[:, None] * slope
    forward, right = _even_looks(g, model, 0.5 * last)
    return replace(
        model,
        attitude_time_s=at / model.line_rate_hz,
        roll_pitch_yaw_rad=attitude,
        forward_tan=forward,
        right_tan=right,
    )


def _even_looks(g: StripGeometry, model: Pushbroom, line: float) -> tuple[Floats, Floats]:
    """forward_tan and right_tan (1, 3) of scene columns, by least squares over all CCDs' ends."""
    places, looks, rows = [], [], []
    for k, ccd in enumerate(g.ccds):
        ends = np.array([0.0, g.width_px])
        places.append(k * (g.width_px - g.overlap_px) + ends)
        looks.append(model.look(k, ends, line)[:, :2])
        rows.append(np.full(2, 1.0 if ccd.row == 1 else -1.0))
    col = np.concatenate(places)
    design = np.stack([np.ones_like(col), col, np.concatenate(rows)], axis=1)
    (forward, right) = least_squares(design, np.concatenate(looks)).T
    return np.array([[forward[0], forward[1], 0.0]]), np.array([[right[0], right[1], 0.0]])


@dataclass(frozen=True, eq=False)
class VirtualLayout:
    """The object-space `SceneLayout`; places are found block by block, as they are asked for.

    columns: of each CCD, first and one beyond the last; (0, 0) where it is dead. sample_lines (s,): scene
    lines at which shift_lines (ccds, s) is the strip's line less the scene's.
    """

    geometry: StripGeometry
    space: ObjectSpace
    camera: Pushbroom
    first_line: float
    height_px: int
    seams_px: tuple[float, ...]
    columns: tuple[tuple[int, int], ...]
    sample_lines: Floats
    shift_lines: Floats

    @property
    def width_px(self) -> int:
        """Columns of the raster: the ideal unbroken line's."""
        return self.geometry.scene_width_px

    def cols(self, ccd: int) -> tuple[int, int]:
        """The raster cols, first and one beyond the last, that a CCD may fill."""
        return self.columns[ccd]

    def places(self, ccd: int, top: int, bottom: int) -> StripLookup:
        """Where raster rows top to bottom - 1 see the strip; knots every 64 columns.

        The strip's columns and lines are solved at every 4th row.
        """
        first, last = self.cols(ccd)
        knots = np.arange(first, last + KNOT_PX, KNOT_PX, dtype=np.float64)
        start, rows = self.first_line + top + 0.5, bottom - top
        solved_at = start + np.arange(0.0, max(rows - 1, 1) + STEP_LINES, STEP_LINES)
        poses = LinePoses(self.camera, solved_at[0], solved_at[-1] + 1.0, STEP_LINES)
        ground = self.space.ground(poses, 0, knots, solved_at[:, None])
        near = solved_at + np.interp(solved_at, self.sample_lines, self.shift_lines[ccd])
        earliest, latest = near[0] - SPARE_LINES, near[-1] + SPARE_LINES
        image = np.stack(LinePoses(self.space.model, earliest, latest).image(ccd, ground, near[:, None]))
        image = np.where((image[1] >= earliest) & (image[1] <= latest), image, _NOWHERE_PX)
        at = start + np.arange(float(rows))
        return StripLookup(knots, make_interp_spline(solved_at, image, k=1, axis=1)(at))


def virtual_layout(geometry: StripGeometry, space: ObjectSpace, ends: Ends = "all") -> VirtualLayout:
    """The layout of strips by their model and the ground's heights.

    Raises: `InputError` if the strips have no lines in common, where those are wanted, or no line is found.
    """
    g, camera = geometry, ideal_camera(geometry, space.model)
    spare = 0.5 * g.row_separation_lines + 2.0 * SPARE_LINES
    longest = max(g.lines)
    at = np.linspace(-spare, longest + spare, SAMPLE_LINES)
    ideal = LinePoses(camera, at[0], at[-1], STEP_LINES)
    real = LinePoses(space.model, at[0] - spare, at[-1] + spare, STEP_LINES)
    step, width = g.width_px - g.overlap_px, g.width_px
    shifts, columns, starts, stops = np.zeros((len(g.ccds), SAMPLE_LINES)), [], [], []
    lefts, rights = [], []
    for k, ccd in enumerate(g.ccds):
        scene_cols = k * step + np.array([0.0, 0.5 * width, width])
        ground = space.ground(ideal, 0, scene_cols, at[:, None])
        nominal = at + g.row_separation_lines * (-0.5 if ccd.row == 1 else 0.5)
        col, line = real.image(k, ground, nominal[:, None])
        shift = line - at[:, None]
        inside, known = (at >= 0.0) & (at <= longest), np.isfinite(line)
        if not known[inside].any(axis=0).all():
            raise _too_noisy(g)
        shifts[k] = np.interp(at, at[known[:, 1]], shift[known[:, 1], 1])
        left, right = scene_cols[0] - col[inside, 0], scene_cols[-1] + width - col[inside, -1]
        lefts.append(float(np.nanmedian(left)))
        rights.append(float(np.nanmedian(right)))
        if not g.lines[k]:
            columns.append((0, 0))
            continue
        columns.append((max(round(np.nanmin(left)), 0), min(round(np.nanmax(right)), g.scene_width_px)))
        if columns[-1][0] >= columns[-1][1]:
            raise _too_noisy(g)
        for seen, lines in zip(known.T, line.T, strict=True):
            starts.append(float(np.interp(0.0, lines[seen], at[seen])))
            stops.append(float(np.interp(g.lines[k], lines[seen], at[seen])))
    start, stop = (min(starts), max(stops)) if ends == "all" else (max(starts), min(stops))
    first, height = math.ceil(start - 0.5), math.floor(stop + 0.5) - math.ceil(start - 0.5)
    if height < 1:
        raise InputError(
            ("the strips have no lines in common"),
            fix="use --set mosaic.strips.ends=all, or leave out the shortest strip",
        )
    seams = tuple(0.5 * (rights[k] + lefts[k + 1]) for k in g.pairs)
    return VirtualLayout(g, space, camera, float(first), height, seams, tuple(columns), at, shifts)


def _too_noisy(geometry: StripGeometry) -> InputError:
    return InputError(
        "its attitudes are too noisy: lines look back and forth over the same ground",
        file=geometry.model,
        fix="smooth the attitudes, or use --set mosaic.strips.space=image",
    )
