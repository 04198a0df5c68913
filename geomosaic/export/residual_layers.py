"""What the adjustment leaves, as layers: of tie points on the ground and in images, of control points."""

from __future__ import annotations

from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from geomosaic.adjustment.model import Adjusted, ControlResidual
from geomosaic.arrays import Floats, Ints64
from geomosaic.export import looks
from geomosaic.export.ellipses import exaggeration
from geomosaic.export.geopackage import MapFeatures, columns
from geomosaic.export.on_map import grid_from_work, map_from_work
from geomosaic.matching.model import TiePairs, TiePoints
from geomosaic.matching.tracks import frame_by_frame
from geomosaic.projection.footprint import ground_from_image
from geomosaic.survey.model import Survey

MOST_POINTS, MOST_A_FRAME = 100_000, 300
"""Where there are more, in all or in the mean of a frame, the layers show an even share. A map can't show
them all, and a GIS opens the file slowly (190 bytes a feature)."""
_SHARE_OF_SPACING = 0.03
"""How long the typical residual is drawn, of the way to the next frame: thousands of arrows stay apart."""


class ResidualLayers:
    """The layers tie_points, residuals, image_residuals, control and control_residuals.

    frames_m (n, 2): where each frame is on the map. Frames that are nowhere (NaN) put nothing on the ground.
    """

    def __init__(self, survey: Survey, adjusted: Adjusted, frames_m: Floats) -> None:
        self.survey, self.adjusted, self.frames_m = survey, adjusted, frames_m
        self.names = np.array([f.name for f in survey.frames])
        self.most = min(MOST_POINTS, MOST_A_FRAME * len(self.names))

    def tie_points(self, ties: TiePoints, gsd_m: Floats) -> tuple[MapFeatures, MapFeatures]:
        """The points, and their residuals as arrows. gsd_m (n,): each frame's ground sampling distance."""
        pairs, residuals_m = TiePairs.of(ties.pairs), self.adjusted.residuals_m
        known = np.concatenate([np.zeros(0, dtype=bool), *(np.isfinite(r).all(axis=1) for r in residuals_m)])
        shown = _evenly(np.flatnonzero(known), self.most)
        thinned = _thinned(len(shown), int(known.sum()))
        keypoints = pairs.keypoints[0, shown]
        left_m = self._ground(pairs.frame[keypoints], pairs.image_px, keypoints)
        hit = np.isfinite(left_m).all(axis=1)
        shown, left_m = shown[hit], left_m[hit]
        (left, right), (left_px, right_px) = (
            of[pairs.keypoints[:, shown]] for of in (pairs.frame, pairs.image_px)
        )
        of_pairs = np.split(shown, np.searchsorted(shown, pairs.first[1:-1]))
        parts = zip(residuals_m, of_pairs, pairs.first, strict=False)
        shift = np.concatenate([np.zeros((0, 2)), *(r[k - first] for r, k, first in parts)])
        left_map = map_from_work(self.survey, left_m)
        right_map = map_from_work(self.survey, left_m + np.pad(shift, ((0, 0), (0, 1))))
        residual = right_map - left_map
        length = np.linalg.norm(residual, axis=1)
        fields = {
            "left_frame": self.names[left],
            "right_frame": self.names[right],
            "residual_m": length,
            **columns("residual_e_m residual_n_m", residual),
            "residual_px": length / ((gsd_m[left] + gsd_m[right]) / 2.0),
        }
        place = columns("left_col_px left_row_px right_col_px right_row_px", np.hstack([left_px, right_px]))
        middle = shapely.points((left_map + right_map) / 2.0)
        text = "Tie points on the ground" + thinned
        points = MapFeatures("tie_points", text, "Point", middle, {**fields, **place}, looks.tie_points())
        style = looks.residuals(exaggeration(length, self.frames_m, _SHARE_OF_SPACING))
        text, lines = "From left to right frame's place" + thinned, _lines(left_map, right_map)
        return points, MapFeatures("residuals", text, "LineString", lines, fields, style)

    def image_residuals(self) -> MapFeatures:
        """The layer of observations, each at the place on the ground where its frame puts it. Their vectors
        lie along the image's axes and not the map's, so that they are drawn as dots."""
        r = self.adjusted.image_residuals
        frame = np.zeros(0, dtype=np.intp) if r is None else r.frame
        image_px, residual_px = (np.zeros((0, 2)),) * 2 if r is None else (r.image_px, r.residual_px)
        weight = np.zeros(0) if r is None else r.weight
        known = np.flatnonzero(np.isfinite(residual_px).all(axis=1))
        shown = _evenly(known, self.most)
        thinned = _thinned(len(shown), len(known))
        at = self._ground(frame[shown], image_px, shown)
        hit = np.isfinite(at).all(axis=1)
        shown = shown[hit]
        fields = {
            "frame": self.names[frame[shown]],
            **columns("col_px row_px", image_px[shown]),
            **columns("residual_col_px residual_row_px", residual_px[shown]),
            "residual_px": np.linalg.norm(residual_px[shown], axis=1),
            "weight": weight[shown],
        }
        text = "Tie points' image coordinates, measured minus computed" + thinned
        points = np.asarray(shapely.points(map_from_work(self.survey, at[hit])))
        return MapFeatures("image_residuals", text, "Point", points, fields, looks.tie_points())

    def control(self) -> tuple[MapFeatures, MapFeatures]:
        """The surveyed places, and lines from where the images put them: the way a residual points."""
        points = self.survey.control
        found = {(c.name, c.check): c for c in self.adjusted.control}
        residuals = [found.get((p.name, p.check)) or found.get((p.name, True)) for p in points]
        both = zip(points, residuals, strict=True)
        check = np.array([p.check if r is None else r.check for p, r in both], dtype=bool)
        place = np.array([(p.lon_deg, p.lat_deg, p.height_ellipsoidal_m) for p in points]).reshape(-1, 3)
        surveyed = self.survey.work_frame.enu_from_geodetic(*place.T)
        off = _column(residuals, "residual_m")
        there = surveyed - off
        surveyed_map, found_map = map_from_work(self.survey, surveyed), map_from_work(self.survey, there)
        residual = surveyed_map - found_map
        found_height = self.survey.work_frame.geodetic_from_enu(there)[:, 2]
        plan_only = np.array([p.plan_only for p in points], dtype=bool)
        residual_u = np.where(plan_only, np.nan, place[:, 2] - found_height)
        drawn_height = np.where(plan_only & np.isfinite(found_height), found_height, place[:, 2])
        turn = grid_from_work(self.survey, surveyed)
        sd = np.sqrt(np.einsum("nij,nj->ni", turn**2, _column(residuals, "sd_m") ** 2))
        place[plan_only, 2] = sd[plan_only, 2] = np.nan
        fields = {
            "name": np.array([p.name for p in points], dtype=str),
            "kind": np.where(check, "check", "control"),
            "pictures": np.array([0 if r is None else r.images for r in residuals], dtype=np.int64),
            **columns("lon_deg lat_deg height_ellipsoidal_m", place),
            **columns("residual_e_m residual_n_m", residual),
            "residual_u_m": residual_u,
            "residual_m": np.linalg.norm(residual, axis=1),
            **columns("sd_e_m sd_n_m sd_u_m", sd),
        }
        at = np.asarray(shapely.points(np.column_stack([surveyed_map, drawn_height])))
        text = "Surveyed control and check points"
        surveyed_points = MapFeatures("control", text, "PointZ", at, fields, looks.control())
        seen = np.isfinite(residual).all(axis=1)
        lines = MapFeatures(
            "control_residuals",
            "From where the images put control and check points to where they were surveyed",
            "LineString",
            _lines(found_map[seen], surveyed_map[seen]),
            {name: values[seen] for name, values in fields.items()},
            looks.control_residuals(exaggeration(fields["residual_m"], self.frames_m)),
        )
        return surveyed_points, lines

    def _ground(self, frame: NDArray[Any], image_px: Floats, which: NDArray[Any]) -> Floats:
        """Where frames (k,) put some of the image coordinates, (k,) of all, on the ground, (k, 3)."""
        out = np.full((len(frame), 3), np.nan)
        a = self.adjusted
        for i, mine in frame_by_frame(frame):
            if np.isfinite(self.frames_m[i]).all():
                out[mine] = ground_from_image(a.poses[i], a.cameras[i], a.ground, image_px[which[mine]])
        return out


def _column(residuals: list[ControlResidual | None], name: str) -> Floats:
    """One vector a point, (n, 3), NaN where there is none."""
    empty = np.full(3, np.nan)
    return np.array([empty if r is None else getattr(r, name) for r in residuals]).reshape(-1, 3)


def _lines(start_m: Floats, end_m: Floats) -> NDArray[np.object_]:
    """Lines between places (n, 2) on the map."""
    return np.asarray(shapely.linestrings(np.stack([start_m, end_m], axis=1)))


def _evenly(indices: Ints64, most: int) -> Ints64:
    """At most so many of them, evenly over their order, so that every part keeps its share."""
    return indices if len(indices) <= most else indices[np.arange(most) * len(indices) // most]


def _thinned(shown: int, there: int) -> str:
    return f": {shown:,} of {there:,}, evenly thinned" if shown < there else ""
