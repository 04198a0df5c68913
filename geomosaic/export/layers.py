"""The layers of layers.gpkg: of frames and seamlines here, of what is left in `residual_layers`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from geomosaic.adjustment.model import Adjusted
from geomosaic.arrays import Floats
from geomosaic.composition.model import Mosaic
from geomosaic.export import looks
from geomosaic.export.ellipses import error_ellipses, exaggeration
from geomosaic.export.geopackage import MapFeatures, columns, write_geopackage
from geomosaic.export.on_map import map_from_work
from geomosaic.export.orientation import Orientations, orientations
from geomosaic.export.residual_layers import ResidualLayers
from geomosaic.matching.model import TiePoints
from geomosaic.placement.model import Placement
from geomosaic.projection.footprint import footprint, ground_sampling_distance_m
from geomosaic.survey.model import Survey


@dataclass(frozen=True)
class SolvedSurvey:
    """A survey, where its frames were reported to be, what ties them, and the adjustment and mosaic of it."""

    survey: Survey
    placement: Placement
    ties: TiePoints
    adjusted: Adjusted
    mosaic: Mosaic


def write_layers(path: Path, solved: SolvedSurvey, stated: Mapping[str, str] | None = None) -> None:
    """Writes the GeoPackage, in the survey's map CRS. Every layer is there, if need be empty.

    frames: the adjusted projection centres with their orientation. footprints: what each frame sees of the
    ground. nadir_points: the ground below where the POS put each frame, before the adjustment. moves: lines
    from there to where the adjustment put it, true to scale.
    error_ellipses: of the adjusted positions, larger than life. tie_points: midway between where its two
    frames put each; residuals: lines from where the left frame puts it to where the right one does, true to
    scale; image_residuals: each observation of the bundle where its frame puts it on the ground, with its
    vector in pixels. These three are thinned, as their description says.
    control: where points were surveyed; control_residuals: lines to there from where the images put them,
    true to scale. seamlines: where each frame gives the mosaic. trimmed: what frames see and the
    mosaic leaves out, a part a reason.
    stated: what is said of the map's accuracy, metadata of frames.
    Raises: `OSError` if the file can't be written.
    """
    survey, adjusted = solved.survey, solved.adjusted
    adjusted_orientation = orientations(survey, solved.placement.poses, adjusted)
    times = [f.time_s for f in survey.frames if f.time_s is not None]
    layers = _Layers(solved, adjusted_orientation)
    residuals = ResidualLayers(survey, adjusted, adjusted_orientation.map_m)
    made = (
        replace(layers.frames(), metadata=stated),
        layers.footprints(),
        layers.nadir_points(),
        layers.moves(),
        layers.error_ellipses(),
        *residuals.tie_points(solved.ties, layers.gsd_m),
        residuals.image_residuals(),
        *residuals.control(),
        layers.seamlines(),
        layers.trimmed(),
    )
    write_geopackage(path, survey.map_crs, max(times, default=None), made)


class _Layers:
    def __init__(self, solved: SolvedSurvey, orientation: Orientations) -> None:
        survey, adjusted = solved.survey, solved.adjusted
        self.survey, self.placement, self.orientation = survey, solved.placement, orientation
        self.adjusted, self.mosaic = adjusted, solved.mosaic
        self.ellipses = error_ellipses(orientation.covariance_m2[:, :2, :2])
        self.names = np.array([f.name for f in survey.frames])
        self.status = np.array(adjusted.status)
        self.gsd_m = np.array(
            [
                ground_sampling_distance_m(adjusted.poses[i], adjusted.cameras[i], adjusted.ground)
                if placed
                else np.nan
                for i, placed in enumerate(orientation.placed)
            ]
        )

    def frames(self) -> MapFeatures:
        o = self.orientation
        points = self._points(np.column_stack([o.map_m, o.lon_lat_height[:, 2]]))
        return MapFeatures(
            "frames", "Adjusted projection centres", "PointZ", points, self._orientation(), looks.frames()
        )

    def footprints(self) -> MapFeatures:
        outlines = []
        for i, camera in enumerate(self.adjusted.cameras):
            ground = footprint(self.adjusted.poses[i], camera, self.adjusted.ground)
            ring = map_from_work(self.survey, ground[np.isfinite(ground).all(axis=1)])
            seen = len(ring) >= 3 and self.orientation.placed[i]
            outlines.append(shapely.Polygon(ring) if seen else None)
        fields = {**self._frame_fields(), "area_m2": [np.nan if p is None else p.area for p in outlines]}
        return MapFeatures(
            "footprints", "What each frame sees", "Polygon", outlines, fields, looks.footprints()
        )

    def nadir_points(self) -> MapFeatures:
        at = self.placement.poses.positions_m.copy()
        height_m = at[:, 2] - self.adjusted.ground.up_at(at[:, 0], at[:, 1])
        at[:, 2] -= height_m
        fields = {
            **self._frame_fields(),
            "height_above_ground_m": np.where(self.orientation.placed, height_m, np.nan),
            "pos_source": [f.position.source for f in self.survey.frames],
            "attitude_source": [f.attitude.source for f in self.survey.frames],
            "moved_m": self.orientation.moved_m,
        }
        points = self._points(map_from_work(self.survey, at))
        text = "Ground below the POS positions"
        return MapFeatures("nadir_points", text, "Point", points, fields, looks.nadir_points())

    def moves(self) -> MapFeatures:
        """Of frames whose position was given."""
        o, prior = self.orientation, self.placement.poses.positions_m
        known = np.isfinite(o.moved_m)
        given = map_from_work(self.survey, prior)
        geodetic = self.survey.work_frame.geodetic_from_enu
        moved = o.map_m - given
        fields = {
            "frame": self.names,
            "status": self.status,
            **columns("moved_e_m moved_n_m", moved),
            "moved_u_m": geodetic(self.adjusted.poses.positions_m)[:, 2] - geodetic(prior)[:, 2],
            "moved_m": o.moved_m,
            "turned_deg": o.turned_deg,
        }
        style = looks.moves(exaggeration(np.linalg.norm(moved[known], axis=1), o.map_m))
        return MapFeatures(
            "moves",
            "From where the POS put each frame to where the adjustment did, true to scale",
            "LineString",
            np.asarray(shapely.linestrings(np.stack([given, o.map_m], axis=1)[known])),
            {name: values[known] for name, values in fields.items()},
            style,
        )

    def error_ellipses(self) -> MapFeatures:
        """Of the frames' horizontal positions; a factor says how much larger than life they are drawn."""
        o, ellipses = self.orientation, self.ellipses
        factor = exaggeration(ellipses.semi_major_m, o.map_m)
        outlines = ellipses.outlines_m(o.map_m, factor)
        known = np.asarray(np.isfinite(outlines).all(axis=(1, 2)))
        fields = {**self._ellipse(), "sd_u_m": o.sd_m[:, 2], "scale": np.full(len(known), factor)}
        fields = {"frame": self.names, "status": self.status, **fields}
        larger = "true to scale" if factor == 1.0 else f"drawn {factor:,.0f} times larger"
        return MapFeatures(
            "error_ellipses",
            f"Standard error ellipses (1 sigma) of the frames' positions, {larger}",
            "Polygon",
            np.asarray(shapely.polygons(outlines[known])),
            {name: np.asarray(values)[known] for name, values in fields.items()},
            looks.error_ellipses(factor),
        )

    def seamlines(self) -> MapFeatures:
        lines = self.mosaic.seamlines
        frames = np.array([s.frame for s in lines], dtype=int)
        shapes = [shapely.MultiPolygon([(p[0], list(p[1:])) for p in s.polygons]) for s in lines]
        fields = {
            "frame": self.names[frames],
            "source_index": frames + 1,
            "area_m2": np.array([s.area for s in shapes], dtype=float),
        }
        return MapFeatures(
            "seamlines",
            "Where each frame gives the mosaic",
            "MultiPolygon",
            shapes,
            fields,
            looks.seamlines(),
        )

    def trimmed(self) -> MapFeatures:
        """What the mosaic leaves out, and why."""
        trimmed = self.mosaic.trimmed
        parts = [] if trimmed is None else [p for p in trimmed.parts if p.polygons]
        shapes = [shapely.MultiPolygon([(rings[0], list(rings[1:])) for rings in p.polygons]) for p in parts]
        fields = {
            "reason": np.array([p.reason for p in parts], dtype=str),
            "area_m2": np.array([p.area_m2 for p in parts], dtype=float),
        }
        text = "What frames see and the mosaic leaves out"
        return MapFeatures("trimmed", text, "MultiPolygon", shapes, fields, looks.trimmed())

    def _points(self, at: Floats) -> NDArray[np.object_]:
        """Points (n, 2 or 3) of the frames; none for those without a place."""
        return np.asarray(np.where(self.orientation.placed, shapely.points(at), None), dtype=np.object_)

    def _frame_fields(self) -> dict[str, Any]:
        frames = self.survey.frames
        turn = {frame: k for k, frame in enumerate(self.placement.sequence)}
        return {
            "frame": self.names,
            "status": self.status,
            "source_index": np.arange(1, len(frames) + 1),
            "flight_line": np.array(self.placement.lines, dtype=int),
            "sequence": [turn.get(i, -1) for i in range(len(frames))],
            "time_utc": times_utc([f.time_s for f in frames]),
            "camera": [f.camera for f in frames],
            "gsd_m": self.gsd_m,
        }

    def _ellipse(self) -> dict[str, Any]:
        """At one sigma; the azimuth of the longer axis is counted from grid north."""
        return {
            "ellipse_major_m": self.ellipses.semi_major_m,
            "ellipse_minor_m": self.ellipses.semi_minor_m,
            "ellipse_azimuth_deg": np.degrees(self.ellipses.azimuth_rad),
        }

    def _orientation(self) -> dict[str, Any]:
        o = self.orientation
        return {
            **self._frame_fields(),
            **columns("lon_deg lat_deg height_ellipsoidal_m", o.lon_lat_height),
            **columns("yaw_deg pitch_deg roll_deg", o.yaw_pitch_roll_deg),
            **columns("omega_deg phi_deg kappa_deg", o.omega_phi_kappa_deg),
            **columns("sd_e_m sd_n_m sd_u_m", o.sd_m),
            **columns("sd_omega_deg sd_phi_deg sd_kappa_deg", o.sd_omega_phi_kappa_deg),
            **self._ellipse(),
            "moved_m": o.moved_m,
            "turned_deg": o.turned_deg,
        }


def times_utc(times_s: Sequence[float | None]) -> NDArray[np.datetime64]:
    """Seconds since 1970 UTC as times to the millisecond, NaT where there is none."""
    known = [np.datetime64("NaT") if t is None else np.datetime64(round(1e3 * t), "ms") for t in times_s]
    return np.array(known, dtype="datetime64[ms]")
