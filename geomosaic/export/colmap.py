"""An adjusted block for COLMAP and what reads its files: cameras.txt, images.txt, points3D.txt.

The format is COLMAP's text model (documentation, "Output Format"). Its pixels count from the outer corner of
the first one, as ours do. The world is the survey's work frame.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Final

import numpy as np
from scipy.spatial.transform import Rotation as Turn

from geomosaic.camera.interior import Camera
from geomosaic.export.sfm import SfmBlock, lens_terms
from geomosaic.matching.tracks import frame_by_frame

_GREY: Final = "128 128 128"


def write_colmap(folder: Path, block: SfmBlock, origin: tuple[float, float, float] | None) -> None:
    """Writes the three files into a folder.

    origin: longitude and latitude in degrees and ellipsoidal height in m of the world's origin, for people;
    None of a local frame without a place on the Earth.
    Raises: `OSError` if they can't be written.
    """
    head = "# a local frame: its scale and its heading are unknown\n"
    if origin is not None:
        lon, lat, height = origin
        head = f"# metres east, north and up about longitude {lon:.9f}, latitude {lat:.9f}, "
        head += f"height {height:.3f} m\n"
    cameras = [_camera(k + 1, camera) for k, camera in enumerate(block.cameras)]
    (folder / "cameras.txt").write_text(head + "".join(f"{line}\n" for line in cameras), encoding="utf-8")
    with (folder / "images.txt").open("w", encoding="utf-8") as file:
        file.write(head)
        file.writelines(f"{line}\n" for line in _images(block))
    with (folder / "points3D.txt").open("w", encoding="utf-8") as file:
        file.write(head)
        file.writelines(f"{line}\n" for line in _points(block))


def _camera(number: int, camera: Camera) -> str:
    """FULL_OPENCV has Brown's third radial term, OPENCV_FISHEYE Kannala's four."""
    f, terms = camera.focal_length_px, lens_terms(camera)
    if camera.kind == "fisheye":
        model, distortion = "OPENCV_FISHEYE", terms
    else:
        model, distortion = "FULL_OPENCV", (*terms, 0.0, 0.0, 0.0)
    numbers = (f, f, camera.principal_col_px, camera.principal_row_px, *distortion)
    return f"{number} {model} {camera.width_px} {camera.height_px} " + " ".join(f"{v:.15g}" for v in numbers)


def _images(block: SfmBlock) -> Iterator[str]:
    """Two lines each: the pose, and the image coordinates with their points."""
    seen = dict(frame_by_frame(block.tracks.frame))
    quaternions = Turn.from_matrix(block.rotations).as_quat(canonical=True)[:, [3, 0, 1, 2]]
    poses = np.column_stack([quaternions, block.translations_m])
    for k, (name, pose) in enumerate(zip(block.names, poses, strict=True)):
        yield f"{k + 1} {' '.join(f'{v:.12f}' for v in pose)} {block.camera[k] + 1} {name}"
        mine = seen.get(k, np.zeros(0, np.intp))
        yield " ".join(
            f"{x:.3f} {y:.3f} {point + 1}"
            for (x, y), point in zip(
                block.tracks.image_px[mine].tolist(), block.tracks.point[mine].tolist(), strict=True
            )
        )


def _points(block: SfmBlock) -> Iterator[str]:
    """Place, colour, error, and of each image that sees it its number and the place of the coordinates in its
    line."""
    tracks = block.tracks
    place = np.zeros(len(tracks.frame), dtype=np.intp)
    for _, mine in frame_by_frame(tracks.frame):
        place[mine] = np.arange(len(mine))
    pairs = np.column_stack([tracks.frame + 1, place]).tolist()
    ends = np.cumsum(tracks.lengths).tolist()
    first = 0
    for k, (point, off, end) in enumerate(
        zip(block.points_m.tolist(), block.off_px.tolist(), ends, strict=True)
    ):
        at = " ".join(f"{v:.4f}" for v in point)
        yield f"{k + 1} {at} {_GREY} {off:.3f} " + " ".join(f"{i} {j}" for i, j in pairs[first:end])
        first = end
