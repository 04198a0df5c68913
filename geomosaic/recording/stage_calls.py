"""What any stage may record, and what those of frames do."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.GeoJSON_pb2 import GeoJSON
from foxglove_schemas_protobuf.LocationFix_pb2 import LocationFix
from foxglove_schemas_protobuf.Log_pb2 import Log
from numpy.typing import ArrayLike

from geomosaic.camera.interior import Camera
from geomosaic.recording.chips import Chip
from geomosaic.recording.messages import ChipTies, Iteration, Metric, Outlines, PairOffsets, Table, TiePoints
from geomosaic.recording.plain import as_text, json_text, single, topic_part

COLOURS = {
    "observed": (0.45, 0.55, 0.70, 1.0),
    "tied": (0.18, 0.70, 0.35, 1.0),
    "placed": (0.95, 0.65, 0.10, 1.0),
    "rejected": (0.85, 0.20, 0.20, 1.0),
}
_OTHER_COLOUR = (0.60, 0.60, 0.60, 1.0)


class StageCalls:
    """Calls with plain values and arrays, so that they can be stored and made again.

    Whoever writes them says where to (`_write`), and which stage is on (`_stage`, `_index`).
    """

    _stage = ""
    _index = 0
    _iteration = 0

    def _write(self, topic: str, message: Any) -> None:
        raise NotImplementedError

    def log(self, level: str, text: str, stage: str = "", frame: str = "") -> None:
        """One line, of level debug, info, warning or error, about a stage and a frame if they are named."""
        message = Log(message=as_text(f"{frame}: {text}" if frame else text), name=stage, file=as_text(frame))
        message.level = Log.Level.Value(level.upper())
        self._write("/log", message)

    def image(self, topic: str, label: str, jpeg: bytes) -> None:
        """A small JPEG (see `thumbnail`), e.g. of topic `/images/before` with the frame's name as label."""
        self._write(topic, CompressedImage(frame_id=as_text(label), data=jpeg, format="jpeg"))

    def location(
        self,
        frame: str,
        lon_deg: float,
        lat_deg: float,
        height_ellipsoidal_m: float,
        sd_e_m: float,
        sd_n_m: float,
        sd_u_m: float,
        status: str,
    ) -> None:
        """Where a frame's projection centre is. `status` is `observed` or that of the adjustment.

        Each status has its own topic and colour. Where a standard deviation isn't finite none is told:
        Foxglove's schema wants nine numbers even so.
        """
        fix = LocationFix(
            frame_id=as_text(frame),
            latitude=lat_deg,
            longitude=lon_deg,
            altitude=height_ellipsoidal_m,
        )
        variances = np.square([sd_e_m, sd_n_m, sd_u_m], dtype=np.float64)
        known = np.isfinite(variances).all()
        fix.position_covariance.extend(np.diag(variances if known else np.zeros(3)).ravel().tolist())
        if known:
            fix.position_covariance_type = LocationFix.DIAGONAL_KNOWN
        fix.color.r, fix.color.g, fix.color.b, fix.color.a = COLOURS.get(status, _OTHER_COLOUR)
        self._write(f"/location/{topic_part(status)}", fix)

    def geojson(self, topic: str, features: Iterable[Mapping[str, Any]]) -> None:
        """GeoJSON features (dicts, lon and lat in degrees), e.g. of topic `/map/footprints`."""
        collection = {"type": "FeatureCollection", "features": list(features)}
        self._write(topic, GeoJSON(geojson=json_text(collection)))

    def metric(self, name: str, value: Any) -> None:
        """One figure, or a whole entry of run.json: of values that JSON knows. The name's dots nest."""
        message = Metric(stage_id=self._stage, stage_index=self._index, name=name, json=json_text(value))
        if isinstance(value, int | float) and not isinstance(value, bool):
            message.number = value
        self._write("/metrics", message)

    def table(
        self,
        name: str,
        rows: Sequence[str],
        columns: Mapping[str, ArrayLike],
        others: Sequence[str] = (),
        notes: Sequence[str] = (),
    ) -> None:
        """A table of frames, or of pairs of frames where `others` has the second ones: numbers by column,
        whose names end in units, NaN where unknown; a text for each row, or none."""
        values = [np.broadcast_to(np.asarray(v, dtype=np.float64), (len(rows),)) for v in columns.values()]
        message = Table(
            stage_id=self._stage,
            stage_index=self._index,
            row=[as_text(r) for r in rows],
            other=[as_text(o) for o in others],
            column=list(columns),
            value=np.concatenate([np.zeros(0), *values]),
            note=[as_text(n) for n in notes],
        )
        self._write(f"/tables/{topic_part(name)}", message)

    def outlines(self, what: str, names: Sequence[str], lines_m: Sequence[ArrayLike]) -> None:
        """Rings or lines (k, 2 or more) in the work frame, east and north first; points not finite are left
        out."""
        lines = (np.asarray(line, dtype=np.float64) for line in lines_m)
        shown = [line[:, :2] if line.size else np.zeros((0, 2)) for line in lines]
        shown = [line[np.isfinite(line).all(axis=1)] for line in shown]
        east, north = np.concatenate([np.zeros((0, 2)), *shown]).T
        message = Outlines(
            stage_id=self._stage,
            stage_index=self._index,
            name=[as_text(n) for n in names],
            vertices=[len(line) for line in shown],
            **single(east_m=east, north_m=north),
        )
        self._write(f"/outlines/{topic_part(what)}", message)

    def iteration(
        self,
        stage: str,
        solve: str,
        cost: float,
        cost_unit: str = "",
        sigma_px: float = np.nan,
        damping: float = np.nan,
        step_m: float = np.nan,
        share_down_weighted: float = np.nan,
    ) -> None:
        """One step of a solve, see `messages`; they are counted here."""
        message = Iteration(
            stage=stage,
            stage_index=self._index,
            iteration=self._iteration,
            solve=solve,
            cost=cost,
            cost_unit=cost_unit,
            sigma_px=sigma_px,
            damping=damping,
            step_m=step_m,
            share_down_weighted=share_down_weighted,
        )
        self._iteration += 1
        self._write(f"/iterations/{topic_part(stage)}", message)

    def offsets(
        self,
        stage: str,
        round_index: int,
        pairs: Sequence[tuple[str | int, str | int, float, float]],
        moves: Sequence[tuple[str | int, float, float]],
    ) -> None:
        """One round of an adjustment.

        `pairs` has (left, right, d_east_m, d_north_m): the misalignments before this round's moves, NaN
        where unknown. `moves` has (frame, d_east_m, d_north_m). Frames by their names.
        """
        misalignments = np.array([p[2:] for p in pairs], dtype=np.float64).reshape(-1, 2)
        moved = np.array([m[1:] for m in moves], dtype=np.float64).reshape(-1, 2)
        lengths = np.hypot(*misalignments.T)
        known = lengths[np.isfinite(lengths)]
        message = PairOffsets(
            stage=stage,
            round=round_index,
            left=[as_text(p[0]) for p in pairs],
            right=[as_text(p[1]) for p in pairs],
            east_m=misalignments[:, 0],
            north_m=misalignments[:, 1],
            frame=[as_text(m[0]) for m in moves],
            move_east_m=moved[:, 0],
            move_north_m=moved[:, 1],
            largest_misalignment_m=known.max() if known.size else np.nan,
            rms_misalignment_m=np.sqrt(np.mean(known**2)) if known.size else np.nan,
            largest_move_m=np.nanmax(np.hypot(*moved.T), initial=0.0),
            stage_index=self._index,
        )
        self._write(f"/offsets/{topic_part(stage)}", message)

    def tie_points(
        self,
        left: str | int,
        right: str | int,
        left_px: ArrayLike,
        right_px: ArrayLike,
        residual_m: ArrayLike | None = None,
        weight: ArrayLike | None = None,
    ) -> None:
        """The tie points of a pair: (k, 2) cols and rows in both frames, (k, 2) residuals on the ground, and
        the solve's weights (k,), 1 for a good one, NaN where one took no part.

        At the level `full` alone, as the artefacts hold them too; in single precision (0.001 px at col 8000).
        """
        a, b = (np.asarray(px, dtype=np.float32).reshape(-1, 2) for px in (left_px, right_px))
        r = np.asarray(() if residual_m is None else residual_m, dtype=np.float32).reshape(-1, 2)
        message = TiePoints(
            left=as_text(left),
            right=as_text(right),
            left_col_px=a[:, 0],
            left_row_px=a[:, 1],
            right_col_px=b[:, 0],
            right_row_px=b[:, 1],
            residual_east_m=r[:, 0],
            residual_north_m=r[:, 1],
            weight=np.asarray(() if weight is None else weight, dtype=np.float32),
            stage_index=self._index,
        )
        self._write("/tie_points", message)

    def chip(self, rank: int, left: str, right: str, chip: Chip) -> None:
        """Where a pair disagrees: both frames side by side at full resolution, and the tie points there."""
        image = CompressedImage(frame_id=as_text(f"{left} - {right}"), data=chip.jpeg, format="jpeg")
        self._write("/chips", image)
        message = ChipTies(
            rank=rank,
            left=as_text(left),
            right=as_text(right),
            side_px=chip.side_px,
            left_col_px=chip.left_corner_px[0],
            left_row_px=chip.left_corner_px[1],
            right_col_px=chip.right_corner_px[0],
            right_row_px=chip.right_corner_px[1],
            right_quarters=chip.right_quarters,
            stage_index=self._index,
            **single(
                left_x_px=chip.left_xy[:, 0],
                left_y_px=chip.left_xy[:, 1],
                right_x_px=chip.right_xy[:, 0],
                right_y_px=chip.right_xy[:, 1],
                residual_east_m=chip.residual_m[:, 0],
                residual_north_m=chip.residual_m[:, 1],
                weight=chip.weight,
            ),
        )
        self._write("/chips/ties", message)

    def camera(self, name: str, camera: Camera) -> None:
        """A camera's interior orientation: pixels with the corner origin, terms of its kind of lens, which
        the note names.

        Not as foxglove.CameraCalibration: Rerun takes that for a camera in space whose place nobody tells,
        and opens a view with an error.
        """
        columns = {k: v for k, v in asdict(camera).items() if isinstance(v, int | float)}
        self.table(f"camera.{name}", [name], columns, notes=[camera.kind])
