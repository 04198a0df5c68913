"""Writes the recording of a run: an MCAP file of protobuf messages.

The file grows under its final name, unlike every other result: a run that is killed leaves a file
that is whole up to the last stage that finished, and `reader.read_recording` reads it.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.GeoJSON_pb2 import GeoJSON
from foxglove_schemas_protobuf.LocationFix_pb2 import LocationFix
from foxglove_schemas_protobuf.Log_pb2 import Log
from google.protobuf.message import DecodeError
from numpy.typing import ArrayLike, NDArray

from geomosaic import __version__
from geomosaic.camera.interior import Camera
from geomosaic.camera.lens import opencv_terms
from geomosaic.errors import InputError
from geomosaic.recording.messagefile import MessageFile
from geomosaic.recording.messages import (
    Artefact,
    JitterSpectrum,
    PairOffsets,
    StageEvent,
    StripOffsets,
    StripResiduals,
    TiePoints,
)

PROFILE = "geomosaic"
FORMAT = "1"
RECIPE, ENVIRONMENT, MANIFEST = "recipe.yaml", "environment.json", "manifest.json"
ARTEFACT_PART_BYTES = 1024 * 1024
COLOURS = {
    "observed": (0.45, 0.55, 0.70, 1.0),
    "tied": (0.18, 0.70, 0.35, 1.0),
    "placed": (0.95, 0.65, 0.10, 1.0),
    "rejected": (0.85, 0.20, 0.20, 1.0),
}
_CLASSES: dict[str, Any] = {
    kind.DESCRIPTOR.full_name: kind
    for kind in (
        CameraCalibration,
        CompressedImage,
        GeoJSON,
        JitterSpectrum,
        LocationFix,
        Log,
        PairOffsets,
        StripOffsets,
        StripResiduals,
        TiePoints,
    )
}
_OTHER_COLOUR = (0.60, 0.60, 0.60, 1.0)

STAGE_CALLS = (
    *("log", "image", "location", "geojson", "offsets", "tie_points"),
    *("strip_offsets", "strip_residuals", "jitter", "camera"),
)
"""What a stage may record; the other calls are the runner's."""


class Recorder:
    """The recording of one run.

    Every call writes at most a few messages and keeps nothing, so memory doesn't grow with the run.
    Arguments are plain values and arrays: a call can be stored and made again. All messages share one
    clock and one counter (the MCAP sequence number), so that they share every timeline. Log times
    rise strictly: the wall clock, or with `fixed_time` steps of 1 ms from the epoch, without
    durations, so that equal runs give equal bytes.

    Raises OutputError where the file can't be written; further calls then raise it again.
    """

    def __init__(self, path: Path, fixed_time: bool = False) -> None:
        self.path = path
        self._fixed_time = fixed_time
        self._stage_index = -1
        self._file = MessageFile(path, PROFILE, fixed_time)

    def begin_run(
        self, recipe_yaml: str, environment: Mapping[str, Any], manifest: Mapping[str, Any]
    ) -> None:
        """What the run was given and where it ran, written first and put on the disk at once.

        `environment` holds versions and the machine, `manifest` the inputs with their hashes; both of
        values that JSON knows.
        """
        described = {"format": FORMAT, "geomosaic": __version__, "fixed_time": str(self._fixed_time).lower()}
        self._file.describe(PROFILE, described)
        self._file.attach(RECIPE, "application/yaml", recipe_yaml.encode())
        self._file.attach(ENVIRONMENT, "application/json", _json(environment).encode())
        self._file.attach(MANIFEST, "application/json", _json(manifest).encode())
        self.flush()

    def stage_started(
        self,
        stage_id: str,
        version: int,
        params: Mapping[str, Any],
        input_fingerprints: Mapping[str, str],
        reads_run: bool = False,
    ) -> None:
        """A stage begins; what is recorded until its end belongs to it.

        `reads_run`: it reports the run itself, such as durations, so equal runs differ in its outputs.
        """
        self._stage_index += 1
        event = StageEvent(
            stage_id=stage_id, stage_index=self._stage_index, version=version, reads_run=reads_run
        )
        event.params_json = _json(params)
        for name, fingerprint in input_fingerprints.items():
            event.inputs.add(name=name, fingerprint=fingerprint)
        self._file.write("/stages", event)

    def stage_finished(
        self,
        stage_id: str,
        output_fingerprints: Mapping[str, str],
        seconds: float | None,
        cached: bool,
        notes: Mapping[str, Any] | None = None,
        written: Mapping[str, str] | None = None,
        lineage: Iterable[str] = (),
    ) -> None:
        """A stage is done and its artefacts are recorded: all of it is put on the disk.

        `notes` is what it adds to run.json besides, so that a replay can add it again. `written`, `lineage`:
        what the fingerprints hold besides the artefacts' bytes (`artefact_fingerprint`).
        """
        event = StageEvent(
            stage_id=stage_id, stage_index=max(self._stage_index, 0), finished=True, cached=cached
        )
        if seconds is not None and not self._fixed_time:
            event.seconds = seconds
        for name, fingerprint in output_fingerprints.items():
            event.outputs.add(name=name, fingerprint=fingerprint)
        for name, fingerprint in (written or {}).items():
            event.written.add(name=name, fingerprint=fingerprint)
        event.lineage.extend(sorted(lineage))
        if notes is not None:
            event.notes_json = _json(notes)
        self._file.write("/stages", event)
        self.flush()

    def artefact(self, stage_id: str, name: str, type_name: str, fingerprint: str, data: bytes) -> None:
        """An output of a stage as bytes, from which a replay can go on. Written in parts of 1 MiB."""
        parts = max(1, -(-len(data) // ARTEFACT_PART_BYTES))
        for part in range(parts):
            start = part * ARTEFACT_PART_BYTES
            message = Artefact(
                stage_id=stage_id,
                stage_index=max(self._stage_index, 0),
                name=name,
                type_name=type_name,
                fingerprint=fingerprint,
                part=part,
                parts=parts,
                total_bytes=len(data),
                data=data[start : start + ARTEFACT_PART_BYTES],
            )
            self._file.write("/artefacts", message)

    def log(self, level: str, text: str, stage: str = "", frame: str = "") -> None:
        """One line, of level debug, info, warning or error, about a stage and a frame if they are named."""
        message = Log(message=_text(f"{frame}: {text}" if frame else text), name=stage, file=_text(frame))
        message.level = Log.Level.Value(level.upper())
        self._file.write("/log", message)

    def image(self, topic: str, label: str, jpeg: bytes) -> None:
        """A small JPEG (see `thumbnail`), e.g. of topic `/images/before` with the frame's name as label."""
        self._file.write(topic, CompressedImage(frame_id=_text(label), data=jpeg, format="jpeg"))

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

        Each status has its own topic and colour. Standard deviations that aren't finite are left out.
        """
        fix = LocationFix(
            frame_id=_text(frame),
            latitude=lat_deg,
            longitude=lon_deg,
            altitude=height_ellipsoidal_m,
        )
        variances = np.square([sd_e_m, sd_n_m, sd_u_m], dtype=np.float64)
        if np.isfinite(variances).all():
            fix.position_covariance.extend(np.diag(variances).ravel().tolist())
            fix.position_covariance_type = LocationFix.DIAGONAL_KNOWN
        fix.color.r, fix.color.g, fix.color.b, fix.color.a = COLOURS.get(status, _OTHER_COLOUR)
        self._file.write(f"/location/{_topic_part(status)}", fix)

    def geojson(self, topic: str, features: Iterable[Mapping[str, Any]]) -> None:
        """GeoJSON features (dicts, lon and lat in degrees), e.g. of topic `/map/footprints`."""
        collection = {"type": "FeatureCollection", "features": list(features)}
        self._file.write(topic, GeoJSON(geojson=_json(collection)))

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
            left=[_text(p[0]) for p in pairs],
            right=[_text(p[1]) for p in pairs],
            east_m=misalignments[:, 0],
            north_m=misalignments[:, 1],
            frame=[_text(m[0]) for m in moves],
            move_east_m=moved[:, 0],
            move_north_m=moved[:, 1],
            largest_misalignment_m=known.max() if known.size else np.nan,
            rms_misalignment_m=np.sqrt(np.mean(known**2)) if known.size else np.nan,
            largest_move_m=np.nanmax(np.hypot(*moved.T), initial=0.0),
            stage_index=max(self._stage_index, 0),
        )
        self._file.write(f"/offsets/{_topic_part(stage)}", message)

    def tie_points(
        self,
        left: str | int,
        right: str | int,
        left_px: ArrayLike,
        right_px: ArrayLike,
        residual_m: ArrayLike | None = None,
    ) -> None:
        """The tie points of a pair: (k, 2) cols and rows in both frames, (k, 2) residuals on the ground.

        Recorded in single precision (0.001 px at col 8000); the artefacts hold the full one.
        """
        a, b = (np.asarray(px, dtype=np.float32).reshape(-1, 2) for px in (left_px, right_px))
        r = np.asarray(() if residual_m is None else residual_m, dtype=np.float32).reshape(-1, 2)
        message = TiePoints(
            left=_text(left),
            right=_text(right),
            left_col_px=a[:, 0],
            left_row_px=a[:, 1],
            right_col_px=b[:, 0],
            right_row_px=b[:, 1],
            residual_east_m=r[:, 0],
            residual_north_m=r[:, 1],
            stage_index=max(self._stage_index, 0),
        )
        self._file.write("/tie_points", message)

    def strip_offsets(
        self,
        pair: int,
        left: str,
        right: str,
        line: ArrayLike,
        dcol_px: ArrayLike,
        dline_px: ArrayLike,
        sd_col_px: ArrayLike,
        sd_line_px: ArrayLike,
        label: ArrayLike,
    ) -> None:
        """Offsets of a pair of strips at some lines, every eighth say; label 0 to 2 as in `ccd.model.LABELS`.

        Recorded in single precision. Each pair has its own topic.
        """
        labels = np.asarray(label, dtype=np.uint32)
        measured, bridged, unreliable = np.bincount(labels, minlength=3)[:3] / max(labels.size, 1)
        message = StripOffsets(
            pair=pair,
            left=_text(left),
            right=_text(right),
            line=np.asarray(line, dtype=np.uint32),
            label=labels,
            **_single(dcol_px=dcol_px, dline_px=dline_px, sd_col_px=sd_col_px, sd_line_px=sd_line_px),
            share_measured=measured,
            share_bridged=bridged,
            share_unreliable=unreliable,
            stage_index=max(self._stage_index, 0),
        )
        self._file.write(f"/strip_offsets/{pair}", message)

    def strip_residuals(
        self,
        pair: int,
        left: str,
        right: str,
        line: ArrayLike,
        dcol_px: ArrayLike,
        dline_px: ArrayLike,
        sd_px: ArrayLike,
    ) -> None:
        """What is left between a pair's strips at the middles of blocks of lines; NaN where unknown."""
        message = StripResiduals(
            pair=pair,
            left=_text(left),
            right=_text(right),
            line=np.floor(line).astype(np.uint32),
            **_single(dcol_px=dcol_px, dline_px=dline_px, sd_px=sd_px),
            stage_index=max(self._stage_index, 0),
        )
        self._file.write(f"/strip_residuals/{pair}", message)

    def jitter(self, what: str, frequency_hz: ArrayLike, across_px: ArrayLike, along_px: ArrayLike) -> None:
        """Amplitudes of what moves line by line; `what` is `found` or `left` and names the topic."""
        message = JitterSpectrum(
            **_single(frequency_hz=frequency_hz, across_px=across_px, along_px=along_px),
            stage_index=max(self._stage_index, 0),
        )
        self._file.write(f"/jitter/{_topic_part(what)}", message)

    def camera(self, name: str, camera: Camera) -> None:
        """A camera's interior orientation as OpenCV's model: pixel centres on whole numbers."""
        f = camera.focal_length_px
        col, row = camera.principal_col_px - 0.5, camera.principal_row_px - 0.5
        message = CameraCalibration(
            frame_id=_text(name),
            width=camera.width_px,
            height=camera.height_px,
            distortion_model="plumb_bob" if camera.kind == "brown" else "kannala_brandt",
            D=opencv_terms(camera.kind, camera.terms, camera.radius_limit),
            K=[f, 0.0, col, 0.0, f, row, 0.0, 0.0, 1.0],
            R=np.eye(3).ravel(),
            P=[f, 0.0, col, 0.0, 0.0, f, row, 0.0, 0.0, 0.0, 1.0, 0.0],
        )
        self._file.write(f"/camera/{_topic_part(name)}", message)

    def copy(self, topic: str, schema: str, data: bytes) -> None:
        """A message of another recording as it is, but for its time. See `reader.stage_messages`.

        Raises InputError if it is none that a stage records, or damaged.
        """
        if schema not in _CLASSES:
            raise InputError(
                f"no stage records a '{_topic_part(schema)}'", mend="replay from an earlier stage"
            )
        try:
            message = _CLASSES[schema].FromString(data)
        except DecodeError as error:
            raise InputError(f"a {schema} is damaged", mend="replay from an earlier stage") from error
        self._file.write(topic, message)

    def flush(self) -> None:
        """End the chunk and put everything on the disk."""
        self._file.flush()

    def close(self) -> None:
        """Write the summary and the footer, which make the file whole. Closing twice is harmless."""
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if error is None or not self._file.failed:
            self.close()


def _single(**values: ArrayLike) -> dict[str, NDArray[np.float32]]:
    """Arrays in single precision."""
    return {name: np.asarray(value, dtype=np.float32) for name, value in values.items()}


def _json(value: Any) -> str:
    """JSON in the order given, numpy numbers and arrays as plain ones, paths as text; NaN refused."""
    return json.dumps(value, allow_nan=False, default=_plain, separators=(",", ":"))


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return dict(value)
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    return str(value)


def _text(name: str | int) -> str:
    """A name or a message as protobuf takes it: a file name that isn't Unicode gets question marks."""
    return str(name).encode("utf-8", "replace").decode()


def _topic_part(name: str) -> str:
    """A name as one level of a topic: no slash, no blank."""
    return re.sub(r"[^\w.+-]+", "_", _text(name)) or "_"
