"""An adjusted block for OpenSfM and OpenDroneMap: reconstruction.json, tracks.csv, reference_lla.json.

As in OpenSfM's documentation ("Dataset structure", "Geometric models"): lengths in images are shares of the
longer side, from the middle of the image. The world is the topocentric frame of reference_lla, ours.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, Final

import numpy as np
from scipy.spatial.transform import Rotation as Turn

from geomosaic.camera.interior import Camera
from geomosaic.export.sfm import SfmBlock, lens_terms
from geomosaic.matching.tracks import frame_by_frame

_GREY: Final = (128, 128, 128)


def write_opensfm(
    folder: Path, block: SfmBlock, origin: tuple[float, float, float], times_s: tuple[float | None, ...]
) -> None:
    """Writes the files into a folder.

    origin: longitude and latitude in degrees and ellipsoidal height in m of the world's origin. times_s: of
    each frame of the block, seconds since 1970 UTC.
    Raises: `OSError` if they can't be written.
    """
    reference = dict(zip(("longitude", "latitude", "altitude"), origin, strict=True))
    cameras = {camera.name: camera_model(camera) for camera in block.cameras}
    points = {
        str(k): {"color": list(_GREY), "coordinates": [round(v, 4) for v in point]}
        for k, point in enumerate(block.points_m.tolist())
    }
    whole = {
        "cameras": cameras,
        "shots": _shots(block, times_s),
        "points": points,
        "reference_lla": reference,
    }
    for name, value in (
        ("reconstruction.json", [whole]),
        ("camera_models.json", cameras),
        ("reference_lla.json", reference),
    ):
        (folder / name).write_text(json.dumps(value, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    _write_tracks(folder / "tracks.csv", block)


def camera_model(camera: Camera) -> dict[str, Any]:
    """A camera as cameras.json and camera_models.json have it, in OpenSfM and in OpenDroneMap."""
    longer = max(camera.width_px, camera.height_px)
    fisheye = camera.kind == "fisheye"
    names = ("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "p1", "p2", "k3")
    return {
        "projection_type": "fisheye_opencv" if fisheye else "brown",
        "width": camera.width_px,
        "height": camera.height_px,
        "focal_x": camera.focal_length_px / longer,
        "focal_y": camera.focal_length_px / longer,
        "c_x": (camera.principal_col_px - camera.width_px / 2.0) / longer,
        "c_y": (camera.principal_row_px - camera.height_px / 2.0) / longer,
        **dict(zip(names, lens_terms(camera), strict=True)),
    }


def _shots(block: SfmBlock, times_s: tuple[float | None, ...]) -> dict[str, Any]:
    """gps_position: where the adjustment put each; OpenSfM starts from it."""
    turns = Turn.from_matrix(block.rotations).as_rotvec().tolist()
    centres = -(np.swapaxes(block.rotations, -1, -2) @ block.translations_m[:, :, None])[:, :, 0]
    return {
        name: {
            "rotation": turns[k],
            "translation": block.translations_m[k].tolist(),
            "camera": block.cameras[block.camera[k]].name,
            "orientation": 1,
            "gps_position": centres[k].tolist(),
            **({} if times_s[k] is None else {"capture_time": times_s[k]}),
        }
        for k, name in enumerate(block.names)
    }


def _write_tracks(path: Path, block: SfmBlock) -> None:
    tracks = block.tracks
    red, green, blue = _GREY
    with path.open("w", encoding="utf-8") as file:
        file.write("OPENSFM_TRACKS_VERSION_v2\n")
        for k, mine in frame_by_frame(tracks.frame):
            camera = block.cameras[block.camera[k]]
            longer = max(camera.width_px, camera.height_px)
            middle = np.array([camera.width_px, camera.height_px]) / 2.0
            at = (tracks.image_px[mine] - middle) / longer
            for feature, ((x, y), point) in enumerate(
                zip(at.tolist(), tracks.point[mine].tolist(), strict=True)
            ):
                file.write(
                    f"{block.names[k]}\t{point}\t{feature}\t{x:.9f}\t{y:.9f}\t0.004\t"
                    f"{red}\t{green}\t{blue}\t-1\t-1\n"
                )
