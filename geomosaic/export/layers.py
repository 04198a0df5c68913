"""The six layers of layers.gpkg: frames, footprints, nadir_points, tie_points, residuals, seamlines."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from geomosaic.adjustment.model import Adjusted
from geomosaic.export.geopackage import GeoPackage, writing_geopackage
from geomosaic.export.orientation import Orientations, orientations
from geomosaic.geodesy.mapcrs import MapProjection
from geomosaic.matching.model import TiePoints
from geomosaic.mosaic.model import Mosaic
from geomosaic.placement.model import Placement
from geomosaic.projection.footprint import footprint, ground_from_image, ground_sampling_distance_m
from geomosaic.survey.model import Survey

Floats = NDArray[np.float64]
MOST_TIE_POINTS = 200_000
"""Of more the layers show an even share: a map can't show them, and a GIS opens the file slowly."""


def write_layers(
    path: Path, survey: Survey, placement: Placement, ties: TiePoints, adjusted: Adjusted, mosaic: Mosaic
) -> None:
    """Writes the GeoPackage, in the survey's map CRS.

    frames: the adjusted projection centres with their orientation. footprints: what each frame sees of the
    ground. nadir_points: the ground below where the POS put each frame, before the adjustment. tie_points:
    midway between where its two frames put each; residuals: lines from where the left frame puts it to where
    the right one does, true to scale; both show at most 200,000, as their description says. seamlines: where
    each frame is the heaviest in the mosaic.
    Raises: `OSError` if the file can't be written.
    """
    adjusted_orientation = orientations(survey, placement.poses, adjusted)
    times = [f.time_s for f in survey.frames if f.time_s is not None]
    with writing_geopackage(path, survey.map_crs, max(times, default=None)) as package:
        layers = _Layers(package, survey, placement, ties, adjusted, mosaic, adjusted_orientation)
        layers.frames()
        layers.footprints()
        layers.nadir_points()
        layers.tie_points()
        layers.seamlines()


class _Layers:
    def __init__(
        self,
        package: GeoPackage,
        survey: Survey,
        placement: Placement,
        ties: TiePoints,
        adjusted: Adjusted,
        mosaic: Mosaic,
        orientation: Orientations,
    ) -> None:
        self.package, self.survey, self.placement, self.ties = package, survey, placement, ties
        self.adjusted, self.mosaic, self.orientation = adjusted, mosaic, orientation
        self.names = np.array([f.name for f in survey.frames])
        self.status = np.array(adjusted.status)
        self.gsd_m = np.array(
            [
                ground_sampling_distance_m(adjusted.poses[i], adjusted.cameras[i], adjusted.ground)
                for i in range(len(self.names))
            ]
        )

    def frames(self) -> None:
        o = self.orientation
        points = shapely.points(np.column_stack([o.map_m, o.lon_lat_height[:, 2]]))
        self.package.add_layer("frames", "Adjusted projection centres", "PointZ", points, self._orientation())

    def footprints(self) -> None:
        outlines = []
        for i, camera in enumerate(self.adjusted.cameras):
            ground = footprint(self.adjusted.poses[i], camera, self.adjusted.ground)
            ring = self._map_from_work(ground[np.isfinite(ground).all(axis=1)])
            outlines.append(shapely.Polygon(ring) if len(ring) >= 3 else None)
        fields = {**self._frame_fields(), "area_m2": [np.nan if p is None else p.area for p in outlines]}
        self.package.add_layer("footprints", "What each frame sees", "Polygon", outlines, fields)

    def nadir_points(self) -> None:
        at = self.placement.poses.positions_m.copy()
        height_m = at[:, 2] - self.adjusted.ground.up_at(at[:, 0], at[:, 1])
        at[:, 2] -= height_m
        fields = {
            **self._frame_fields(),
            "height_above_ground_m": height_m,
            "pos_source": [f.position.source for f in self.survey.frames],
            "attitude_source": [f.attitude.source for f in self.survey.frames],
            "moved_m": self.orientation.moved_m,
        }
        points = shapely.points(self._map_from_work(at))
        self.package.add_layer("nadir_points", "Ground below the POS positions", "Point", points, fields)

    def tie_points(self) -> None:
        left, right, left_px, right_px, shift = self._joined_ties()
        left_m = np.full((len(left), 3), np.nan)
        for frame in np.unique(left):
            left_m[left == frame] = self._ground(frame, left_px[left == frame])
        hit = np.isfinite(left_m).all(axis=1) & np.isfinite(shift).all(axis=1)
        shown = _evenly(np.flatnonzero(hit), MOST_TIE_POINTS)
        thinned = f": {len(shown):,} of {hit.sum():,}, evenly thinned" if len(shown) < hit.sum() else ""
        left, right, left_px, right_px = left[shown], right[shown], left_px[shown], right_px[shown]
        left_map = self._map_from_work(left_m[shown])
        right_map = self._map_from_work(left_m[shown] + np.pad(shift[shown], ((0, 0), (0, 1))))
        residual = right_map - left_map
        length = np.linalg.norm(residual, axis=1)
        fields = {
            "left_frame": self.names[left],
            "right_frame": self.names[right],
            "residual_m": length,
            "residual_e_m": residual[:, 0],
            "residual_n_m": residual[:, 1],
            "residual_px": length / ((self.gsd_m[left] + self.gsd_m[right]) / 2.0),
        }
        place = {
            "left_col_px": left_px[:, 0],
            "left_row_px": left_px[:, 1],
            "right_col_px": right_px[:, 0],
            "right_row_px": right_px[:, 1],
        }
        middle = shapely.points((left_map + right_map) / 2.0)
        lines = shapely.linestrings(np.stack([left_map, right_map], axis=1))
        for name, text, kind, shapes, columns in (
            ("tie_points", "Tie points on the ground", "Point", middle, {**fields, **place}),
            ("residuals", "From left to right frame's place", "LineString", lines, fields),
        ):
            self.package.add_layer(name, text + thinned, kind, shapes, columns)

    def _joined_ties(self) -> tuple[NDArray[Any], NDArray[Any], Floats, Floats, Floats]:
        """All pairs in one: left and right frame, their pixels, and right minus left on the ground."""
        pairs = self.ties.pairs
        counts = [len(p) for p in pairs]
        left = np.repeat(np.array([p.left for p in pairs], dtype=np.int64), counts)
        right = np.repeat(np.array([p.right for p in pairs], dtype=np.int64), counts)
        nothing = np.zeros((0, 2))
        return (
            left,
            right,
            np.concatenate([nothing, *(p.left_px for p in pairs)]),
            np.concatenate([nothing, *(p.right_px for p in pairs)]),
            np.concatenate([nothing, *self.adjusted.residuals_m]),
        )

    def seamlines(self) -> None:
        lines = self.mosaic.seamlines
        frames = np.array([s.frame for s in lines], dtype=int)
        shapes = [shapely.MultiPolygon([(p[0], list(p[1:])) for p in s.polygons]) for s in lines]
        fields = {
            "frame": self.names[frames],
            "source_index": frames + 1,
            "area_m2": np.array([s.area for s in shapes], dtype=float),
        }
        self.package.add_layer(
            "seamlines", "Where each frame is the heaviest", "MultiPolygon", shapes, fields
        )

    def _ground(self, frame: int, image_px: Floats) -> Floats:
        pose, camera = self.adjusted.poses[frame], self.adjusted.cameras[frame]
        return ground_from_image(pose, camera, self.adjusted.ground, image_px)

    def _map_from_work(self, enu_m: Floats) -> Floats:
        geodetic = self.survey.work_frame.geodetic_from_enu(enu_m)
        return MapProjection(self.survey.map_crs).map_from_geodetic(geodetic[:, 0], geodetic[:, 1])

    def _frame_fields(self) -> dict[str, Any]:
        frames = self.survey.frames
        turn = {frame: k for k, frame in enumerate(self.placement.sequence)}
        return {
            "frame": self.names,
            "status": self.status,
            "source_index": np.arange(1, len(frames) + 1),
            "flight_line": np.array(self.placement.lines, dtype=int),
            "sequence": [turn.get(i, -1) for i in range(len(frames))],
            "time_utc": [_utc(f.time_s) for f in frames],
            "camera": [f.camera for f in frames],
            "gsd_m": self.gsd_m,
        }

    def _orientation(self) -> dict[str, Any]:
        o = self.orientation
        groups = {
            "lon_deg lat_deg height_ellipsoidal_m": o.lon_lat_height,
            "yaw_deg pitch_deg roll_deg": o.yaw_pitch_roll_deg,
            "omega_deg phi_deg kappa_deg": o.omega_phi_kappa_deg,
            "sd_e_m sd_n_m sd_u_m": o.sd_m,
            "sd_omega_deg sd_phi_deg sd_kappa_deg": o.sd_omega_phi_kappa_deg,
        }
        fields = self._frame_fields()
        for names, values in groups.items():
            fields.update(zip(names.split(), values.T, strict=True))
        return {**fields, "moved_m": o.moved_m, "turned_deg": o.turned_deg}


def _evenly(indices: NDArray[np.int64], most: int) -> NDArray[np.int64]:
    """At most so many of them, evenly over their order, so that every pair of frames keeps its share."""
    return indices if len(indices) <= most else indices[np.arange(most) * len(indices) // most]


def _utc(time_s: float | None) -> str:
    return "" if time_s is None else datetime.fromtimestamp(time_s, UTC).isoformat(timespec="milliseconds")
