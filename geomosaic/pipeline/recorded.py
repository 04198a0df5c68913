"""What a stage tells the recording, kept so that a stage taken from the cache tells it again."""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from geomosaic.camera.interior import Camera
from geomosaic.errors import FileError
from geomosaic.pipeline.artefacts import decode, encode

_LENGTH_BYTES = 8


class StageRecorder:
    """The recording as a stage sees it: every call goes to `target` at once and is added to `spool`.

    `target` is a `geomosaic.recording.Recorder`, whose methods these are; without one nothing is
    recorded. The spool is a file of length-prefixed calls, so memory doesn't grow with it.
    """

    def __init__(self, target: Any = None, spool: Path | None = None, stage: str = "") -> None:
        self._target = target
        self._stage = stage
        self._lock = threading.Lock()
        self._spool = None
        if spool is not None:
            spool.unlink(missing_ok=True)
            self._spool = spool.open("xb")

    def log(self, level: str, text: str, stage: str = "", frame: str = "") -> None:
        """One line; `level` is `debug`, `info`, `warning` or `error`."""
        self._call("log", level=level, text=text, stage=stage or self._stage, frame=frame)

    def image(self, topic: str, label: str, jpeg: bytes) -> None:
        """A thumbnail, already encoded."""
        self._call("image", topic=topic, label=label, jpeg=jpeg)

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
        """Where a frame was taken."""
        self._call(
            "location",
            frame=frame,
            lon_deg=lon_deg,
            lat_deg=lat_deg,
            height_ellipsoidal_m=height_ellipsoidal_m,
            sd_e_m=sd_e_m,
            sd_n_m=sd_n_m,
            sd_u_m=sd_u_m,
            status=status,
        )

    def geojson(self, topic: str, features: Sequence[Mapping[str, Any]]) -> None:
        """GeoJSON features in longitude and latitude."""
        self._call("geojson", topic=topic, features=[dict(f) for f in features])

    def offsets(
        self,
        stage: str,
        round_index: int,
        pairs: Sequence[tuple[str, str, float, float]],
        moves: Sequence[tuple[str, float, float]],
    ) -> None:
        """One round of an adjustment: (left, right, d_east_m, d_north_m) and (frame, d_east_m, d_north_m)."""
        self._call("offsets", stage=stage, round_index=round_index, pairs=list(pairs), moves=list(moves))

    def tie_points(
        self,
        left: str,
        right: str,
        left_px: NDArray[Any],
        right_px: NDArray[Any],
        residual_m: NDArray[Any] | None = None,
    ) -> None:
        """The tie points of one pair, (k, 2) each."""
        self._call(
            "tie_points", left=left, right=right, left_px=left_px, right_px=right_px, residual_m=residual_m
        )

    def strip_offsets(
        self,
        pair: int,
        left: str,
        right: str,
        line: NDArray[Any],
        dcol_px: NDArray[Any],
        dline_px: NDArray[Any],
        sd_col_px: NDArray[Any],
        sd_line_px: NDArray[Any],
        label: NDArray[Any],
    ) -> None:
        """Offsets of a pair of strips at some of the left strip's lines, (n,) each."""
        self._call(
            "strip_offsets",
            pair=pair,
            left=left,
            right=right,
            line=line,
            dcol_px=dcol_px,
            dline_px=dline_px,
            sd_col_px=sd_col_px,
            sd_line_px=sd_line_px,
            label=label,
        )

    def strip_residuals(
        self,
        pair: int,
        left: str,
        right: str,
        line: NDArray[Any],
        dcol_px: NDArray[Any],
        dline_px: NDArray[Any],
        sd_px: NDArray[Any],
    ) -> None:
        """What is left between a pair's strips at the middles of blocks of lines, (n,) each."""
        self._call(
            "strip_residuals",
            pair=pair,
            left=left,
            right=right,
            line=line,
            dcol_px=dcol_px,
            dline_px=dline_px,
            sd_px=sd_px,
        )

    def jitter(
        self, what: str, frequency_hz: NDArray[Any], across_px: NDArray[Any], along_px: NDArray[Any]
    ) -> None:
        """A spectrum, `found` or `left`, (f,) each."""
        self._call("jitter", what=what, frequency_hz=frequency_hz, across_px=across_px, along_px=along_px)

    def camera(self, name: str, camera: Camera) -> None:
        """An interior orientation."""
        self._call("camera", name=name, camera=camera)

    def _call(self, method: str, **arguments: Any) -> None:
        with self._lock:
            if self._spool is not None:
                data = encode((method, arguments))
                self._spool.write(len(data).to_bytes(_LENGTH_BYTES, "little") + data)
            if self._target is not None:
                getattr(self._target, method)(**arguments)

    def close(self) -> None:
        """Ends the spool."""
        if self._spool is not None:
            self._spool.close()


def record_again(spool: Path, target: Any) -> None:
    """Sends every call of a spool to a recorder, in order. `FileError` if the spool isn't whole."""
    with spool.open("rb") as file:
        left = spool.stat().st_size
        while left:
            size = int.from_bytes(file.read(_LENGTH_BYTES), "little")
            left -= _LENGTH_BYTES + size
            if left < 0:
                raise FileError("the recorded calls are cut short", file=spool)
            call: tuple[str, dict[str, Any]] = decode(file.read(size), tuple, also=(Camera,))
            method, arguments = call
            if method not in vars(StageRecorder) or method.startswith("_"):
                raise FileError(f"'{method}' is no call of a recorder", file=spool)
            getattr(target, method)(**arguments)
