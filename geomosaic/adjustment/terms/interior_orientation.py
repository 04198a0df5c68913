"""Interior orientation of the cameras and its prior deviations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from geomosaic.adjustment.kernels.interior import FOCAL, INTERIOR, PRINCIPAL, interior_of
from geomosaic.adjustment.problem.estimate import Estimate, Unknowns
from geomosaic.arrays import Bools, Floats
from geomosaic.camera.interior import Camera
from geomosaic.constants import sourced, tuned
from geomosaic.estimation.robust import FAR
from geomosaic.survey.accuracy import FOCAL_LENGTH
from geomosaic.survey.plausible import OFF_CENTRE

_LENS_SD: dict[str, tuple[float, float, float, float, float]] = tuned(
    {"brown": (0.1, 0.1, 0.1, 0.003, 0.003), "fisheye": (0.1, 0.1, 0.1, 0.0, 0.0)},
    "the terms' own, in the order of `lens.TERMS`",
    "wide lenses reach 0.3 in k1; decentring is a hundredth; no fisheye lens has even powers",
)
WIDE_FOCAL = tuned(0.1, "share of the focal length", "more: it was assumed; tags that agree are good to 0.05")
_WIDE_DISTORTION = sourced(4.0, "deviations", "of radial terms, with an assumed focal", "OpenSfM: -0.39")
_PRINCIPAL_SD = tuned((0.003, 0.01), "share of the longer side", "more: it takes up how frames rotate")
NOMINAL_READOUT_S = tuned(0.05, "s", "unreported readout and its deviation: small cameras: 0.01 to 0.1 s")


def interior_deviations(camera: Camera, *, readout: bool = False) -> Floats:
    """Prior deviations of a camera's numbers in the order of INTERIOR, (9,); 0 for a readout that is known or
    not reported, if it is not asked for. The principal point is known no better than the focal length, within
    _PRINCIPAL_SD. Of a distortion of known deviation each term alone moves the frame's corner by no more than
    that."""
    focal = camera.focal_length_sd_px or FOCAL_LENGTH["camera-file"].sd_relative * camera.focal_length_px
    least, most = (sd * max(camera.width_px, camera.height_px) for sd in _PRINCIPAL_SD)
    principal = min(max(focal, least), most)
    lens = np.array(_LENS_SD[camera.kind])
    if focal > WIDE_FOCAL * camera.focal_length_px:
        lens[:3] *= _WIDE_DISTORTION
    if camera.distortion_sd:
        corner = np.hypot(camera.width_px, camera.height_px) / 2.0 / camera.focal_length_px
        lens = np.minimum(lens, camera.distortion_sd / camera.lens.shares(corner))
    about_s = camera.readout_sd_s if camera.readout_s else 0.0
    return np.array([focal, principal, principal, *lens, about_s or (NOMINAL_READOUT_S if readout else 0.0)])


def part_of_camera(name: str) -> str:
    """The name of a camera's part of the shared unknowns."""
    return f"camera {name}"


def interior_unknowns(camera: Camera, *, readout: bool = False, free_lens: bool = False) -> Unknowns:
    """A camera's numbers; readout: solved for, also a known one; free_lens: maker's distortion is but the
    start."""
    known = replace(camera, distortion_sd=0.0) if free_lens else camera
    sd = interior_deviations(known, readout=readout)
    return Unknowns(part_of_camera(camera.name), camera.name, INTERIOR, interior_of(camera), sd)


def far_off(camera: Camera, focal_px: float) -> bool:
    """Whether a focal length is none that a camera can have, by what was reported of it."""
    off, sd = abs(focal_px / camera.focal_length_px - 1.0), camera.focal_length_sd_px / camera.focal_length_px
    return off > max(FAR * sd, WIDE_FOCAL)


def implausible_interior(at: Estimate, cameras: Sequence[Camera]) -> Bools:
    """Which shared unknowns have values that no lens has, (s,): principal points too far off, and focal
    lengths that are none by what was reported."""
    given = at.layout.given[at.layout.interior].reshape(len(cameras), -1)
    off_px = (given - at.interior)[:, PRINCIPAL]
    longer_px = np.array([max(c.width_px, c.height_px) for c in cameras])
    out = np.zeros(at.interior.shape, dtype=bool)
    out[:, PRINCIPAL] = (np.linalg.norm(off_px, axis=1) > OFF_CENTRE.value * longer_px)[:, None]
    out[:, FOCAL] = [far_off(c, focal_px) for c, focal_px in zip(cameras, at.interior[:, FOCAL], strict=True)]
    return np.concatenate([out.ravel(), np.zeros(at.layout.size - out.size, dtype=bool)])
