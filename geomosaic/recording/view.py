"""A recording in Rerun: the recording as an .rrd with a layout, the viewer, a screenshot without a screen.

Rerun is imported here alone and only when asked for: it is large. The viewer is bound to this
machine (127.0.0.1), and its analytics are off.
"""

from __future__ import annotations

import json
import os
import shutil
import socket
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.GeoJSON_pb2 import GeoJSON
from foxglove_schemas_protobuf.LocationFix_pb2 import LocationFix
from mcap.records import Message
from numpy.typing import NDArray

from geomosaic.errors import FileError, GeomosaicError, OutputError
from geomosaic.recording.mcapfile import BROKEN, items, opened
from geomosaic.recording.messages import StageEvent
from geomosaic.recording.model import Recording
from geomosaic.recording.reader import messages
from geomosaic.recording.strip_view import LINE, log_strips, strip_views

STEP = "step"
_LOG_TIME = "message_log_time"
_IMAGE = "foxglove.CompressedImage"
_LINE_COLOUR = (110, 170, 255)
_PLOT_COLOURS = [(235, 110, 60), (90, 170, 250), (130, 200, 90)]


def write_rrd(recording: Recording, path: Path) -> None:
    """The recording as Rerun's own file with the project's layout; the artefacts are left out.

    Every stream lies on the timeline `step`, the count of messages, besides the log time. Places are
    shown as one map per stage, GeoJSON as lines, and the offsets of each round as plots. Offsets of strips
    lie on the timeline `line`; where there are such, all else is at its line 0.
    Raises OutputError where it can't be written, FileError if Rerun can't read the recording.
    """
    import rerun
    from rerun.chunk import DeriveLens, McapReader

    log_times_ns, steps = _timeline(recording)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        temporary.touch()
    except OSError as error:
        raise OutputError(error.strerror or str(error), file=path, mend="choose another file") from error
    try:
        stream = rerun.RecordingStream("geomosaic", recording_id=recording.path.parent.name or "run")
        stream.save(temporary, default_blueprint=layout(recording))
        reader = McapReader(recording.path, recover=True, exclude_topic_regex=["^/artefacts$"])
        chunks = reader.stream()
        for topic in _topics(recording, "geomosaic.PairOffsets"):
            plot = DeriveLens("geomosaic.PairOffsets:message", output_entity=f"/plots{topic}")
            lens = plot.to_scalars("largest_misalignment_m", "rms_misalignment_m", "largest_move_m")
            chunks = chunks.lenses([lens], output_mode="forward_all", content=topic)
            names = ["largest misalignment, m", "rms misalignment, m", "largest move, m"]
            lines = rerun.SeriesLines(names=names, colors=_PLOT_COLOURS, widths=[2.0])
            stream.log(f"/plots{topic}", lines, static=True)
        if recording.strips:
            stream.set_time(LINE, sequence=0)
        on_steps = chunks.flat_map(
            lambda chunk: _on_steps(chunk, log_times_ns, steps, at_line_0=bool(recording.strips))
        )
        rerun.send_chunks(on_steps, recording=stream)
        _log_maps(recording, stream)
        log_strips(recording, stream)
        stream.flush()
        stream.disconnect()
        temporary.replace(path)
    except (RuntimeError, ValueError) as error:
        raise FileError(f"Rerun can't show it ({error})", file=recording.path) from error
    finally:
        temporary.unlink(missing_ok=True)


def layout(recording: Recording) -> Any:
    """The blueprint: the map or the strips' offsets; the images; the offsets of each round; the log."""
    import rerun.blueprint as rrb

    images = [rrb.Spatial2DView(origin=topic, name=topic.strip("/")) for topic in _topics(recording, _IMAGE)]
    plots = [
        rrb.TimeSeriesView(origin=f"/plots{topic}", name=topic.strip("/"), plot_legend=rrb.Corner2D.RightTop)
        for topic in _topics(recording, "geomosaic.PairOffsets")
    ]
    right: list[Any] = [rrb.Grid(*images)] if images else []
    place = rrb.MapView(origin="/map", name="map", zoom=_zoom(recording))
    if recording.strips and _topics(recording, "foxglove.GeoJSON"):
        right.append(place)
    right += [rrb.Tabs(*plots)] if plots else []
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Grid(*strip_views(recording), grid_columns=2) if recording.strips else place,
            rrb.Vertical(*right, rrb.TextLogView(origin="/log", name="log")),
            column_shares=[3, 2],
        ),
        rrb.TimePanel(timeline=LINE if recording.strips else STEP, state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
    )


def _topics(recording: Recording, schema: str) -> list[str]:
    return [topic.name for topic in recording.topics.values() if topic.schema == schema]


def _zoom(recording: Recording) -> float:
    """The web map's zoom level at which all places fit into some 600 pixels."""
    fixes = [LocationFix.FromString(data) for _, _, data in messages(recording.path, "foxglove.LocationFix")]
    places = np.array([(fix.longitude, fix.latitude) for fix in fixes]).reshape(-1, 2)
    places = places[np.isfinite(places).all(axis=1)]
    if not len(places):
        return 2.0
    lon, lat = np.ptp(places, axis=0)
    span_deg = max(lon, lat / max(np.cos(np.radians(places[0, 1])), 0.1), 1e-4)
    return float(np.clip(np.log2(600.0 / 256.0 * 360.0 / span_deg) - 0.5, 1.0, 19.0))


def open_viewer(file: Path) -> None:
    """Shows an .rrd in Rerun's window until the user closes it."""
    with _viewer(file, "--port", "auto") as viewer:
        if viewer.wait() != 0:
            raise GeomosaicError("Rerun's viewer failed; without a screen use --save or --screenshot")


def screenshot(file: Path, png: Path, seconds: float = 8.0) -> None:
    """An image of an .rrd as the viewer shows it, made without a screen after `seconds` of loading."""
    from rerun.experimental import ViewerClient

    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    with _viewer(file, "--headless", "--port", str(port)) as viewer:
        deadline = time.monotonic() + 60.0
        client = None
        while client is None:
            if viewer.poll() is not None or time.monotonic() > deadline:
                mend = "install mesa-vulkan-drivers and libvulkan1"
                raise GeomosaicError(f"Rerun's viewer didn't start without a screen; {mend}")
            try:
                client = ViewerClient.connect(f"rerun+http://127.0.0.1:{port}/proxy")
                client.get_state()
            except (RuntimeError, ConnectionError):
                client = None
                time.sleep(0.5)
        time.sleep(seconds)
        try:
            client.save_screenshot(str(png.absolute()))
        except RuntimeError as error:
            raise OutputError(f"no screenshot ({error})", file=png) from error


@contextmanager
def _viewer(file: Path, *arguments: str) -> Iterator[subprocess.Popen[bytes]]:
    """Rerun's viewer as a child with settings of its own, so that the user's stay as they are."""
    import rerun_cli  # type: ignore[import-untyped]

    program = shutil.which("rerun", path=str(Path(rerun_cli.__file__).parent)) or shutil.which("rerun")
    if program is None:
        raise GeomosaicError("Rerun's viewer isn't installed; pip install rerun-sdk")
    with tempfile.TemporaryDirectory(prefix="geomosaic-view-") as settings:
        environment = {**os.environ, "XDG_CONFIG_HOME": settings, "XDG_DATA_HOME": settings}
        quiet: dict[str, Any] = {
            "stdout": subprocess.DEVNULL,
            "stderr": subprocess.DEVNULL,
            "env": environment,
        }
        subprocess.run([program, "analytics", "disable"], check=False, timeout=60, **quiet)  # noqa: S603
        command = [program, "--bind", "127.0.0.1", *arguments, str(file.absolute())]
        viewer = subprocess.Popen(command, **quiet)  # noqa: S603
        try:
            yield viewer
        finally:
            if viewer.poll() is None:
                viewer.terminate()
                try:
                    viewer.wait(timeout=10)
                except subprocess.TimeoutExpired:
                    viewer.kill()
                    viewer.wait()


def _timeline(recording: Recording) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Log time and count of every message, rising."""
    with opened(recording.path) as file:
        pairs = [
            (item.record.log_time, item.record.sequence)
            for item in items(recording.path, file)
            if isinstance(item.record, Message)
        ]
    table = np.array(pairs or [(0, 0)], dtype=np.int64)
    return table[:, 0], table[:, 1]


def _on_steps(
    chunk: Any, log_times_ns: NDArray[np.int64], steps: NDArray[np.int64], at_line_0: bool
) -> list[Any]:
    """The chunk with the timeline `step` beside its own; `at_line_0`: with the timeline `line`, too."""
    import pyarrow  # type: ignore[import-untyped]
    from rerun.chunk import Chunk

    if chunk.is_static or _LOG_TIME not in chunk.timeline_names:
        return [chunk]
    batch = chunk.to_record_batch()
    times = batch.column(_LOG_TIME).cast(pyarrow.int64()).to_numpy()
    at = np.clip(np.searchsorted(log_times_ns, times), 0, len(steps) - 1)
    timelines = {STEP: steps[at]} | ({LINE: np.zeros_like(at)} if at_line_0 else {})
    for name, values in timelines.items():
        kind = {"rerun:kind": "index", "rerun:index_name": name}
        column = pyarrow.field(name, pyarrow.int64(), nullable=False, metadata=kind)
        batch = batch.add_column(1, column, pyarrow.array(values))
    return list(Chunk.from_record_batch(batch))


def _log_maps(recording: Recording, stream: Any) -> None:
    """Places of the frames as points, all of a stage's at its end; GeoJSON as lines when recorded."""
    import rerun

    places: list[tuple[float, float]] = []
    colours: list[tuple[float, float, float, float]] = []
    with opened(recording.path) as file:
        for item in items(recording.path, file):
            if not isinstance(item.record, Message):
                continue
            try:
                stream.set_time(STEP, sequence=item.record.sequence)
                stream.set_time(_LOG_TIME, timestamp=np.datetime64(item.record.log_time, "ns"))
                match item.schema:
                    case "foxglove.LocationFix":
                        fix = LocationFix.FromString(item.record.data)
                        places.append((fix.latitude, fix.longitude))
                        colours.append((fix.color.r, fix.color.g, fix.color.b, fix.color.a))
                    case "foxglove.GeoJSON":
                        lines = _lines(json.loads(GeoJSON.FromString(item.record.data).geojson))
                        shape = rerun.GeoLineStrings(
                            lat_lon=lines, radii=rerun.Radius.ui_points(1.0), colors=[_LINE_COLOUR]
                        )
                        stream.log(f"/map{item.topic}", shape)
                    case "geomosaic.StageEvent" if (
                        StageEvent.FromString(item.record.data).finished and places
                    ):
                        points = rerun.GeoPoints(
                            lat_lon=places, radii=rerun.Radius.ui_points(5.0), colors=np.array(colours)
                        )
                        stream.log("/map/frames", points)
                        places, colours = [], []
            except BROKEN:
                continue


def _lines(geojson: Any) -> list[NDArray[np.float64]]:
    """Every line and ring in GeoJSON as (n, 2) latitudes and longitudes."""
    if not isinstance(geojson, dict):
        raise ValueError("no GeoJSON")
    coordinates = geojson.get("coordinates")
    match geojson.get("type"):
        case "FeatureCollection":
            return [line for feature in geojson["features"] for line in _lines(feature)]
        case "Feature":
            return _lines(geojson["geometry"]) if geojson.get("geometry") else []
        case "GeometryCollection":
            return [line for geometry in geojson["geometries"] for line in _lines(geometry)]
        case "LineString":
            rings = [coordinates or ()]
        case "Polygon" | "MultiLineString":
            rings = list(coordinates or ())
        case "MultiPolygon":
            rings = [ring for polygon in coordinates or () for ring in polygon]
        case _:
            return []
    return [np.array([[p[1], p[0]] for p in ring], dtype=np.float64) for ring in rings]
