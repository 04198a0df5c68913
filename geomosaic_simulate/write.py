"""A survey on disk: frames with their tags, the POS, the camera file, the truth. Whole or not at all."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from geomosaic.arrays import Floats, Floats32
from geomosaic.camera.interior import Camera
from geomosaic.camera.rotation import Rotation, about_z
from geomosaic.errors import OutputError
from geomosaic.geodesy.mapcrs import MapProjection
from geomosaic.survey.focal_lengths import FILM_DIAGONAL_MM
from geomosaic_simulate.exif import camera_tags, gps_tags, tiff_bytes, with_segments, xmp_packet
from geomosaic_simulate.flight import START_S, Flight, Observed, rotations_in
from geomosaic_simulate.plan import SurveyPlan
from geomosaic_simulate.readout import gyroscope_tag, readout_of

MAKE = "geomosaic"
SENSOR_WIDTH_MM = Fraction(132, 10)
_USUAL_EXPOSURE_S = Fraction(1, 800)
_BOOTED_S = 900.0

POS_COLUMNS = (
    "frame", "lon_deg", "lat_deg", "height_ellipsoidal_m", "yaw_deg", "pitch_deg", "roll_deg",
    "sd_horizontal_m", "sd_vertical_m", "sd_yaw_deg", "sd_tilt_deg",
)  # fmt: skip
POSITIONS_COLUMNS = (
    "frame", "status", "lon_deg", "lat_deg", "height_ellipsoidal_m", "easting_m", "northing_m",
    "yaw_deg", "pitch_deg", "roll_deg", "omega_deg", "phi_deg", "kappa_deg",
    "sd_e_m", "sd_n_m", "sd_u_m", "sd_omega_deg", "sd_phi_deg", "sd_kappa_deg", "moved_m", "turned_deg",
)  # fmt: skip


CAR_COLUMNS = ("frame", "easting_m", "northing_m", "grid_heading_deg")


def car_rows(names: Sequence[str], cars: Sequence[Floats]) -> list[list[str]]:
    """Rows of moving_cars.csv from each frame's cars (see `changing.cars_at`)."""
    return [
        [name, f"{x:.3f}", f"{y:.3f}", f"{(90.0 - np.degrees(along)) % 360.0:.2f}"]
        for name, there in zip(names, cars, strict=True)
        for x, y, along, _ in there
    ]


@contextmanager
def whole(path: Path) -> Iterator[Path]:
    """A temporary path that gets its final name when all is written; gone if anything fails."""
    part = path.with_name(f".{path.name}.part{path.suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield part
        part.replace(path)
    except OSError as error:
        if isinstance(error, OutputError):
            raise
        raise OutputError(
            error.strerror or str(error), file=path, fix="free some space or give another folder"
        ) from error
    finally:
        part.unlink(missing_ok=True)


def write_bytes(path: Path, data: bytes) -> None:
    """Write a file whole."""
    with whole(path) as part:
        part.write_bytes(data)


def write_json(path: Path, tree: Any) -> None:
    """Write JSON, two blanks deep."""
    write_bytes(path, (json.dumps(tree, indent=2, allow_nan=False) + "\n").encode())


def write_csv(path: Path, columns: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    """Write a comma-separated table with Unix line ends."""
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(columns)
    table.writerows(rows)
    write_bytes(path, text.getvalue().encode())


def frame_name(plan: SurveyPlan, i: int) -> str:
    """`F0001.jpg` of the first frame."""
    return f"F{i + 1:04d}.{'jpg' if plan.format == 'jpeg' else 'tif'}"


def frame_bytes(
    plan: SurveyPlan,
    reported: Camera,
    flight: Flight,
    observed: Observed,
    i: int,
    light: Floats32,
    automatic: float,
) -> bytes:
    """One frame encoded: `light` is (rows, cols, 3) RGB in [0, 255]; 16-bit TIFFs use the whole range.
    automatic: the gain that the camera chose."""
    if plan.format == "tiff16":
        pixels: NDArray[Any] = np.round(light * 257.0).astype(np.uint16)
    else:
        pixels = np.round(light).astype(np.uint8)
    bgr = np.ascontiguousarray(pixels[..., ::-1])
    if plan.format != "jpeg":
        return cv2.imencode(".tif", bgr, [cv2.IMWRITE_TIFF_COMPRESSION, 8])[1].tobytes()
    jpeg = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, plan.jpeg_quality])[1].tobytes()
    size = reported.width_px, reported.height_px
    per_mm = Fraction(reported.width_px) / SENSOR_WIDTH_MM
    focal_35mm = max(round(reported.focal_length_px * FILM_DIAGONAL_MM / math.hypot(*size)), 1)
    focal_mm = reported.focal_length_px / float(per_mm)
    exposure_s = Fraction(round(plan.exposure_time_s * 1e6), 1_000_000) or _USUAL_EXPOSURE_S
    if plan.exposure_reported:
        exposure_s = Fraction(round(automatic * float(exposure_s) * 1e6), 1_000_000)
    main, exif = camera_tags(
        float(flight.time_s[i]), MAKE, plan.camera_model, size, focal_mm, per_mm, focal_35mm, exposure_s
    )
    if plan.pos_in == "csv":
        return with_segments(jpeg, tiff_bytes(main, exif, []), None)
    lon, lat, height = (float(v) for v in observed.lon_lat_height[i])
    gps = gps_tags(float(flight.time_s[i]), lon, lat, height if plan.height_reported else None)
    xmp = _dji(plan, observed, i) | _camera_xmp(plan, reported, flight, i)
    return with_segments(
        jpeg,
        tiff_bytes(main, exif, [] if i in plan.numbered("no_gps") else gps),
        xmp_packet(xmp) if xmp else None,
    )


def copies_of(plan: SurveyPlan) -> dict[int, str]:
    """Names of copied files by the index of the frame they are copies of."""
    chosen = plan.rng("duplicates").permutation(plan.kept)[: plan.duplicates]
    return {int(i): frame_name(plan, int(i)).replace(".", " (1).") for i in sorted(chosen)}


def _camera_xmp(plan: SurveyPlan, reported: Camera, flight: Flight, i: int) -> dict[str, str]:
    """What Pix4D's namespace reports of lens, readout and gyroscope, as a Parrot Sequoia writes it."""
    tags = {}
    mm = float(SENSOR_WIDTH_MM) / reported.width_px
    if plan.lens_in_tags:
        tags["PrincipalPoint"] = f"{reported.principal_col_px * mm:.6f},{reported.principal_row_px * mm:.6f}"
        if reported.kind == "fisheye":
            half_turn_px = reported.focal_length_px * math.pi / 2.0
            tags["ModelType"] = "fisheye"
            tags["FisheyeAffineMatrix"] = f"{half_turn_px:.6f},0,0,{half_turn_px:.6f}"
            tags["FisheyePolynomial"] = f"0,1,0,{reported.k1 * (math.pi / 2.0) ** 2:.9f}"
        else:
            terms = (reported.k1, reported.k2, reported.k3, reported.p1, reported.p2)
            tags["ModelType"] = "perspective"
            tags["PerspectiveFocalLength"] = f"{reported.focal_length_px * mm:.6f}"
            tags["PerspectiveFocalLengthUnits"] = "mm"
            tags["PerspectiveDistortion"] = ",".join(f"{term:.9f}" for term in terms)
    if plan.readout_reported:
        tags["LineReadoutTime"] = str(round(1e9 * plan.rolling_shutter_s / reported.height_px))
    if plan.gyroscope_reported:
        first_row_s = float(flight.time_s[i]) - START_S + _BOOTED_S - 0.5 * plan.rolling_shutter_s
        tags["IMUAngularVelocity"] = gyroscope_tag(
            plan, readout_of(plan, flight, i), round(1e6 * first_row_s), i
        )
    return {f"Camera:{name}": value for name, value in tags.items()}


def _dji(plan: SurveyPlan, observed: Observed, i: int) -> dict[str, str]:
    """DJI's tags: gimbal pitch -90 at the nadir, signs written out. The aircraft itself flies level."""
    tags = {}
    if plan.shutter_reported:
        tags["ShutterType"] = "Electronic" if plan.rolling_shutter_s else "Mechanical"
    if plan.height_reported and i not in plan.numbered("no_gps"):
        height = float(observed.lon_lat_height[i, 2])
        tags["AbsoluteAltitude"] = f"{height:+.3f}"
        if plan.relative_height_reported:
            tags["RelativeAltitude"] = f"{observed.height_above_take_off_m[i]:+.3f}"
    if plan.attitude_reported:
        yaw, pitch, roll = gimbal_deg(observed.yaw_pitch_roll_deg[i])
        heading = (float(observed.yaw_pitch_roll_deg[i, 0]) + 180.0) % 360.0 - 180.0
        tags |= {
            "GimbalRollDegree": f"{roll:+.4f}",
            "GimbalYawDegree": f"{yaw:+.4f}",
            "GimbalPitchDegree": f"{pitch:+.4f}",
            "FlightRollDegree": "+0.00",
            "FlightYawDegree": f"{heading:+.2f}",
            "FlightPitchDegree": "+0.00",
        }
    return {f"drone-dji:{name}": value for name, value in tags.items()}


def gimbal_deg(yaw_pitch_roll_deg: Floats) -> tuple[float, float, float]:
    """Gimbal yaw in ±180, pitch (-90 at the nadir) and roll in degrees of body angles in degrees.

    With the axes of `Rotation.from_gimbal`: the view is the gimbal's x, the image's right its y. Past the
    nadir (looking backward) yaw and roll both turn around, as `Rotation` says.
    """
    r = Rotation.from_yaw_pitch_roll(*np.radians(yaw_pitch_roll_deg)).matrix
    view, right, bottom = -r[:, 2], r[:, 0], -r[:, 1]
    pitch = np.arcsin(np.clip(view[2], -1.0, 1.0))
    yaw = np.arctan2(view[0], view[1])
    roll = np.arctan2(-right[2], -bottom[2])
    return float(np.degrees(yaw)), float(np.degrees(pitch)), float(np.degrees(roll))


def _files(plan: SurveyPlan) -> list[tuple[int, str]]:
    """Every frame's index and file name, copies after the others."""
    return [(i, frame_name(plan, i)) for i in plan.kept] + list(copies_of(plan).items())


def pos_rows(plan: SurveyPlan, observed: Observed) -> tuple[list[str], list[list[str]]]:
    """The POS table with the standard deviations that it states; columns that aren't given are left out."""
    hidden = (
        set() if plan.attitude_reported else {"yaw_deg", "pitch_deg", "roll_deg", "sd_yaw_deg", "sd_tilt_deg"}
    )
    hidden |= set() if plan.height_reported else {"height_ellipsoidal_m", "sd_vertical_m"}
    yaw_sd_deg = plan.yaw_sd_deg if plan.stated_yaw_sd_deg is None else plan.stated_yaw_sd_deg
    stated = (plan.position_sd_m, plan.height_sd_m, yaw_sd_deg, plan.tilt_sd_deg)
    sd = [plan.stated_sd_factor * s for s in stated]
    rows = []
    for i, name in _files(plan):
        if i in plan.numbered("no_gps"):
            continue
        lon, lat, height = observed.lon_lat_height[i]
        yaw, pitch, roll = observed.yaw_pitch_roll_deg[i]
        values = [name, f"{lon:.9f}", f"{lat:.9f}", f"{height:.4f}",
                  *(f"{a:.5f}" for a in (yaw, pitch, roll)), *(f"{s:g}" for s in sd)]  # fmt: skip
        rows.append([v for c, v in zip(POS_COLUMNS, values, strict=True) if c not in hidden])
    return [c for c in POS_COLUMNS if c not in hidden], rows


def true_positions(
    plan: SurveyPlan, flight: Flight, observed: Observed, projection: MapProjection
) -> list[list[str]]:
    """Rows of positions.csv for the truth: of each image as it is stored, so turned where it was turned.

    Yaw, pitch and roll are against each frame's own true north and vertical, yaw being the heading of the
    stored image's top edge. Omega, phi, kappa are against the map grid's east and north. A turned
    image obeys the collinearity equations with `camera.turned(2)`. `moved_m` and `turned_deg` are what
    a perfect adjustment moves and turns the POS, the half turn of a turned image left out.
    """
    rows = []
    turned = plan.turned_frames()
    said = rotations_in(flight.work_frame, observed.lon_lat_height, observed.yaw_pitch_roll_deg)
    for i, name in _files(plan):
        lon, lat, height = flight.lon_lat_height[i]
        local = Rotation.from_yaw_pitch_roll(*np.radians(flight.yaw_pitch_roll_deg[i]))
        stored = local.turned(2) if i in turned else local
        yaw, pitch, roll = (float(np.degrees(a)) for a in stored.yaw_pitch_roll())
        grid_from_local = about_z(projection.grid_convergence_rad(lon, lat))
        opk = [float(np.degrees(a)) for a in Rotation(grid_from_local @ stored.matrix).omega_phi_kappa()]
        east, north = projection.map_from_geodetic(lon, lat)
        moved = float(np.linalg.norm(observed.position_errors_m[i]))
        between = flight.poses.rotations[i].T @ said[i]
        cosine = (np.trace(between) - 1.0) / 2.0
        angle = float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))
        rows.append(
            [name, "tied", f"{lon:.10f}", f"{lat:.10f}",
             *(f"{v:.5f}" for v in (height, east, north)),
             *(f"{a:.7f}" for a in (yaw % 360.0, pitch - 90.0, roll, *opk)),
             *["0"] * 6, f"{moved:.5f}", f"{angle:.6f}"]
        )  # fmt: skip
    return rows


def opensfm_camera(
    camera: Camera, model: str, readout_s: float | None = None
) -> dict[str, dict[str, object]]:
    """A camera in OpenSfM's cameras.json: Brown or OpenCV's fisheye, lengths over the longer side, the centre
    from the middle; with the readout, 0 for none, where that is reported."""
    side = float(max(camera.width_px, camera.height_px))
    fisheye = camera.kind == "fisheye"
    terms = {"k1": camera.k1, "k2": camera.k2}
    terms |= {"k3": camera.k3, "k4": 0.0} if fisheye else {"p1": camera.p1, "p2": camera.p2, "k3": camera.k3}
    kind = "fisheye_opencv" if fisheye else "brown"
    return {
        f"{MAKE} {model} {camera.width_px} {camera.height_px} {kind.partition('_')[0]}": {
            "projection_type": kind,
            "width": camera.width_px,
            "height": camera.height_px,
            "focal_x": camera.focal_length_px / side,
            "focal_y": camera.focal_length_px / side,
            "c_x": (camera.principal_col_px - camera.width_px / 2.0) / side,
            "c_y": (camera.principal_row_px - camera.height_px / 2.0) / side,
            **terms,
            **({} if readout_s is None else {"readout_s": readout_s}),
        }
    }
