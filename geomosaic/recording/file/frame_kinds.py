"""Kinds of messages of frames: images, positions, poses, points."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.GeoJSON_pb2 import GeoJSON
from foxglove_schemas_protobuf.LocationFix_pb2 import LocationFix
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.PosesInFrame_pb2 import PosesInFrame
from numpy.typing import ArrayLike

from geomosaic.camera.interior import Camera
from geomosaic.camera.lens import opencv_terms
from geomosaic.recording.file.messages import At, Kind, Topics, own, stamped
from geomosaic.recording.file.model import Recording
from geomosaic.recording.file.plain import as_text, json_text, topic_part

THUMBNAILS = "/frames"
MAP = "map"
"""The frame of reference of poses and points: east, north and up in metres about the work frame's origin."""
_OPTICAL = np.diag([1.0, -1.0, -1.0])
"""From a camera's axes right, down and forward to those right, to the image's top and against the view."""
_DISTORTION = {"brown": "plumb_bob", "fisheye": "kannala_brandt"}
COLOURS = {
    "observed": (0.45, 0.55, 0.70, 1.0),
    "tied": (0.18, 0.70, 0.35, 1.0),
    "placed": (0.95, 0.65, 0.10, 1.0),
    "rejected": (0.85, 0.20, 0.20, 1.0),
}
_OTHER_COLOUR = (0.60, 0.60, 0.60, 1.0)

FrameTime = own(
    "FrameTime",
    # Both times of a frame, in ns since 1970: of its exposure (0: unknown), and of its recording.
    "string frame",
    "uint64 captured_ns recorded_ns",
    "uint32 stage_index",
)


def image(topic: str, label: str, jpeg: bytes) -> Topics:
    """A small JPEG (see `thumbnail`), e.g. of topic `/images/mosaic` with what it shows as label."""
    yield topic, CompressedImage(frame_id=as_text(label), data=jpeg, format="jpeg")


def frame_image(frame: str, jpeg: bytes, captured_s: float | None = None) -> Topics:
    """A frame's thumbnail at the time of its exposure, and both its times."""
    name = as_text(frame)
    shown = stamped(CompressedImage(frame_id=name, data=jpeg, format="jpeg"), captured_s)
    times = FrameTime(frame=name, captured_ns=shown.timestamp.ToNanoseconds())
    yield from ((THUMBNAILS, shown), ("/frames/times", times))


def _take_image(recording: Recording, message: Any, at: At) -> None:
    if recording.with_images and at.topic != THUMBNAILS:
        recording.images.setdefault(at.topic, {})[message.frame_id] = message.data


def location(
    frame: str, place: Sequence[float], sd_m: Sequence[float], status: str, captured_s: float | None = None
) -> Topics:
    """Where a frame's projection centre is: longitude, latitude (degrees) and ellipsoidal height (m), with
    standard deviations to the east, to the north and up. `status` is `observed` or that of the adjustment;
    `origin` with the frame `map` says where the work frame's origin is.

    Each status has its own topic and colour. Where a standard deviation isn't finite none is reported:
    Foxglove's schema wants nine numbers even so.
    """
    lon_deg, lat_deg, height_m = place
    fix = LocationFix(frame_id=as_text(frame), latitude=lat_deg, longitude=lon_deg, altitude=height_m)
    variances = np.square(sd_m, dtype=np.float64)
    known = np.isfinite(variances).all()
    fix.position_covariance.extend(np.diag(variances if known else np.zeros(3)).ravel().tolist())
    if known:
        fix.position_covariance_type = LocationFix.DIAGONAL_KNOWN
    fix.color.r, fix.color.g, fix.color.b, fix.color.a = COLOURS.get(status, _OTHER_COLOUR)
    yield f"/location/{topic_part(status)}", stamped(fix, captured_s)


def _location_of(data: bytes) -> Any:
    """A LocationFix. Recordings made until November 2026 hold it as JSON.

    Raises one of `mcapfile.DAMAGED`.
    """
    if not data.startswith(b"{"):
        fix = LocationFix.FromString(data)
    else:
        values = json.loads(data)
        plain = (*_PLACE, "frame_id", "position_covariance", "position_covariance_type")
        fix = LocationFix(**{name: values[name] for name in plain})
        for name in "rgba":
            setattr(fix.color, name, values["color"][name])
    if not all(math.isfinite(getattr(fix, name)) for name in _PLACE):
        raise ValueError("a position that isn't finite")
    return fix


_PLACE = ("latitude", "longitude", "altitude")


def pose(
    frame: str, camera: Camera, position_m: ArrayLike, rotation: ArrayLike, captured_s: float | None = None
) -> Topics:
    """Where a frame's camera is in `map` at the time of its exposure, and how it images.

    position_m: (3,) east, north, up. rotation: (3, 3) those axes from the camera's, as `Rotation` has it. The
    frame of reference that bears the frame's name is the camera's with x right, y down and z forward. Pixels
    have the origin in the first one's middle, as OpenCV.
    """
    from scipy.spatial.transform import Rotation as Turn  # half a second that most commands needn't wait

    name, at = as_text(frame), np.asarray(position_m, dtype=np.float64)
    transform = FrameTransform(parent_frame_id=MAP, child_frame_id=name)
    transform.translation.x, transform.translation.y, transform.translation.z = at.tolist()
    q = transform.rotation
    q.x, q.y, q.z, q.w = Turn.from_matrix(np.asarray(rotation) @ _OPTICAL).as_quat(canonical=True).tolist()
    yield "/tf", stamped(transform, captured_s)
    f, col, row = camera.focal_length_px, camera.principal_col_px - 0.5, camera.principal_row_px - 0.5
    widest = float(np.linalg.norm(camera.ray_from_image(camera.corners_px)[:, :2], axis=1).max())
    calibration = CameraCalibration(
        frame_id=name,
        width=camera.width_px,
        height=camera.height_px,
        distortion_model=_DISTORTION.get(camera.kind, ""),
        D=opencv_terms(camera.kind, camera.terms, widest).tolist(),
        K=[f, 0.0, col, 0.0, f, row, 0.0, 0.0, 1.0],
        R=np.eye(3).ravel().tolist(),
        P=[f, 0.0, col, 0.0, 0.0, f, row, 0.0, 0.0, 0.0, 1.0, 0.0],
    )
    yield f"/cameras/{topic_part(camera.name)}", stamped(calibration, captured_s)


def flown_path(positions_m: ArrayLike, captured_s: float | None = None) -> Topics:
    """The way flown: projection centres (n, 3) in the work frame, in the order of exposure."""
    flown = PosesInFrame(frame_id=MAP)
    for east, north, up in np.asarray(positions_m, dtype=np.float64):
        flown.poses.add(position={"x": east, "y": north, "z": up}, orientation={"w": 1.0})
    yield "/path", stamped(flown, captured_s)


def points(
    what: str, points_m: ArrayLike, values: Mapping[str, ArrayLike], captured_s: float | None = None
) -> Topics:
    """Points (n, 3) in the work frame, each with numbers (n,) under their names; `what` names the topic.
    Points that aren't finite are left out."""
    columns = {**dict(zip("xyz", np.asarray(points_m, dtype=np.float64).T, strict=True)), **values}
    packed = np.column_stack([np.asarray(v, dtype="<f4") for v in columns.values()])
    packed = packed[np.isfinite(packed[:, :3]).all(axis=1)]
    cloud = PointCloud(frame_id=MAP, point_stride=packed.dtype.itemsize * packed.shape[1])
    cloud.pose.orientation.w = 1.0
    for k, name in enumerate(columns):
        cloud.fields.add(name=name, offset=packed.dtype.itemsize * k, type=PackedElementField.FLOAT32)
    cloud.data = np.ascontiguousarray(packed).tobytes()
    yield f"/points/{topic_part(what)}", stamped(cloud, captured_s)


def _take_transform(recording: Recording, message: Any, at: At) -> None:
    t, q = message.translation, message.rotation
    place, turn = np.array([t.x, t.y, t.z]), np.array([q.x, q.y, q.z, q.w])
    if not np.isfinite(place).all() or not abs(np.linalg.norm(turn) - 1.0) < 1e-6:
        raise ValueError("no transform")
    recording.transforms[message.child_frame_id] = place, turn


def _take_calibration(recording: Recording, message: Any, at: At) -> None:
    f, _, col, _, _, row = list(message.K)[:6]
    ends = np.array([[0, 0], [message.width, 0], [message.width, message.height], [0, message.height]]) - 0.5
    if not np.isfinite([f, col, row]).all() or f == 0.0:
        raise ValueError("no camera")
    recording.corners[message.frame_id] = np.column_stack([(ends - [col, row]) / f, np.ones(4)])


def _take_points(recording: Recording, message: Any, at: At) -> None:
    stride, fields = message.point_stride, [f.name for f in message.fields]
    if fields[:3] != list("xyz") or stride < 12 or stride % 4:
        raise ValueError("no points")
    values = np.frombuffer(message.data, "<f4").reshape(-1, stride // 4)
    recording.clouds[at.name] = values[:, :3].astype(np.float64)


def geojson(topic: str, features: Iterable[Mapping[str, Any]]) -> Topics:
    """GeoJSON features (dicts, lon and lat in degrees), e.g. of topic `/map/footprints`."""
    collection = {"type": "FeatureCollection", "features": list(features)}
    yield topic, GeoJSON(geojson=json_text(collection))


def _take_geojson(recording: Recording, message: Any, at: At) -> None:
    """Names and outer rings (k, 2) of strips. Raises of `mcapfile.DAMAGED`."""
    if at.topic == "/map/strips":
        recording.strips_lonlat = [
            (
                str(feature["properties"].get("strip", "")),
                np.array(feature["geometry"]["coordinates"][0], dtype=np.float64).reshape(-1, 2),
            )
            for feature in json.loads(message.geojson)["features"]
        ]


FRAME_KINDS = (
    Kind(
        CompressedImage, "/frames, /images/NAME, /chips, /strips", "images",
        level="normal", calls=(image, frame_image), take=_take_image,
    ),
    Kind(FrameTime, "/frames/times", level="normal"),
    Kind(LocationFix, "/location/STATUS", calls=(location,), parse=_location_of),
    Kind(FrameTransform, "/tf", "block", calls=(pose,), take=_take_transform),
    Kind(CameraCalibration, "/cameras/NAME", "block", take=_take_calibration),
    Kind(PosesInFrame, "/path", calls=(flown_path,)),
    Kind(PointCloud, "/points/NAME", "block", "normal", calls=(points,), take=_take_points),
    Kind(GeoJSON, "/footprints/NAME, /map/strips", "plan of strips", calls=(geojson,), take=_take_geojson),
)  # fmt: skip
