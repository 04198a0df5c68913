"""The lens as its maker wrote it into the image: XMP of DJI and of Pix4D's namespace `Camera`."""

from __future__ import annotations

import math
from dataclasses import replace

from geomosaic.camera.interior import Camera
from geomosaic.camera.lens import TERMS, fisheye_terms
from geomosaic.constants import tuned
from geomosaic.survey.accuracy import FOCAL_LENGTH, MAKERS_DISTORTION
from geomosaic.survey.header import FrameHeader
from geomosaic.survey.plausible import OFF_CENTRE, focal_length_can_be
from geomosaic.survey.xmp import number, numbers

_SQUARE = tuned(0.01, "share", "of a fisheye's matrix: more leaves a stretch that no lens has")


def dji_dewarp(header: FrameHeader, blank: Camera) -> Camera | None:
    """DewarpData: `date;fx,fy,cx,cy,k1,k2,p1,p2,k3`, pixels of the full frame, cx and cy from its middle.

    A frame that was dewarped in the camera (DewarpFlag 1) has no distortion left.
    """
    xmp = header.xmp or {}
    fields = {"": xmp.get("drone-dji:DewarpData", "").rpartition(";")[2]}
    values = numbers(fields, "", 9)
    if values is None or min(values[:2]) < 100.0:
        return None
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = values
    scale = _scale(header)
    camera = _with_lens(blank, scale * (fx + fy) / 2.0, "dji-dewarp")
    camera = replace(
        camera,
        principal_col_px=blank.principal_col_px + scale * cx,
        principal_row_px=blank.principal_row_px + scale * cy,
        distortion_sd=MAKERS_DISTORTION.sd_relative,
    )
    if number(xmp, "drone-dji:DewarpFlag") == 1.0:
        return camera
    return replace(camera, k1=k1, k2=k2, k3=k3, p1=p1, p2=p2)


def dji_calibrated(header: FrameHeader, blank: Camera) -> Camera | None:
    """CalibratedFocalLength and CalibratedOpticalCenterX/Y: pixels of the full frame, from its corner."""
    xmp = header.xmp or {}
    focal = number(xmp, "drone-dji:CalibratedFocalLength")
    if focal is None or focal <= 0.0:
        return None
    camera = _with_lens(blank, _scale(header) * focal, "dji-calibrated")
    col, row = (number(xmp, f"drone-dji:CalibratedOpticalCenter{axis}") for axis in "XY")
    if col is None or row is None:
        return camera
    return _centred(camera, (_scale(header) * col, _scale(header) * row)) or camera


def xmp_perspective(header: FrameHeader, blank: Camera, pixels_per_mm: float | None) -> Camera | None:
    """`Camera:PerspectiveFocalLength`, `PrincipalPoint` and `PerspectiveDistortion` (R1, R2, R3, T1, T2).

    Lengths are in mm, or in pixels of the full frame where `PerspectiveFocalLengthUnits` says so; the
    principal point counts from the top left corner. The distortion is Brown's as `Camera` writes it, T1 its
    p1 and T2 its p2; all 0 say nothing. None too where the principal point lies as no lens has it: then the
    tags are of another image, turned or cut.

    Args: pixels_per_mm: of the frame, None if nothing reports it.
    """
    xmp = header.xmp or {}
    focal = number(xmp, "Camera:PerspectiveFocalLength")
    unit = xmp.get("Camera:PerspectiveFocalLengthUnits", "").lower() or "mm"
    in_px = _scale(header) if unit in ("px", "pixel", "pixels") else pixels_per_mm if unit == "mm" else None
    if fisheye(header) or focal is None or focal <= 0.0 or in_px is None:
        return None
    camera = _at_principal_point(_with_lens(blank, focal * in_px, "xmp-perspective"), header, pixels_per_mm)
    distortion = numbers(xmp, "Camera:PerspectiveDistortion", 5)
    if distortion is None or camera is None or not any(distortion):  # no lens has none: nobody measured it
        return camera
    k1, k2, k3, p1, p2 = distortion
    return replace(camera, k1=k1, k2=k2, k3=k3, p1=p1, p2=p2, distortion_sd=MAKERS_DISTORTION.sd_relative)


def xmp_fisheye(header: FrameHeader, blank: Camera, pixels_per_mm: float | None) -> Camera | None:
    """`Camera:FisheyePolynomial`, `FisheyeAffineMatrix` and `PrincipalPoint`.

    This is Pix4D's fisheye (support.pix4d.com, "How are the internal and external camera parameters defined",
    2.2). Let θ be 2/π of the angle from the axis, and ρ = p0 + p1 θ + p2 θ² + p3 θ³ (+ p4 θ⁴). An image's
    point is the affine matrix (c, d, e, f; in pixels) times ρ along the direction, from the principal point.
    None where p0 isn't 0 or the pixels aren't square, which is none of our lenses.
    """
    xmp = header.xmp or {}
    polynomial = numbers(xmp, "Camera:FisheyePolynomial", 4) or numbers(xmp, "Camera:FisheyePolynomial", 5)
    affine = numbers(xmp, "Camera:FisheyeAffineMatrix", 4)
    if not fisheye(header) or polynomial is None or affine is None:
        return None
    c, d, e, f = (_scale(header) * value for value in affine)
    if c <= 0.0 or max(abs(c - f), abs(d), abs(e)) > _SQUARE * c or polynomial[0] or polynomial[1] <= 0.0:
        return None
    radius = {n: (c + f) / 2.0 * p * (2.0 / math.pi) ** n for n, p in enumerate(polynomial) if n and p}
    can_be = focal_length_can_be(radius[1], blank.width_px, blank.height_px)
    if not can_be or not all(map(math.isfinite, radius.values())):
        return None
    widest_rad = math.hypot(blank.width_px, blank.height_px) / 2.0 / radius[1]
    focal_px, terms = fisheye_terms(radius, widest_rad)
    camera = _at_principal_point(_with_lens(blank, focal_px, "xmp-fisheye"), header, pixels_per_mm)
    if camera is None:
        return None
    named = dict(zip(TERMS, terms.tolist(), strict=True))
    return replace(camera, **named, kind="fisheye", distortion_sd=MAKERS_DISTORTION.sd_relative)


def fisheye(header: FrameHeader) -> bool:
    """Whether the tags give a fisheye lens."""
    xmp = header.xmp or {}
    return xmp.get("Camera:ModelType", "").lower() == "fisheye" or (
        "Camera:FisheyePolynomial" in xmp and "Camera:PerspectiveFocalLength" not in xmp
    )


def label(header: FrameHeader) -> str:
    """Make and model, each word once, then what distinguishes the cameras of one rig: its band, or the band's
    wavelength, and its number."""
    xmp = header.xmp or {}
    words = list(dict.fromkeys(f"{header.exif.make} {header.exif.model}".split())) or ["camera"]
    names = ("Camera:BandName", "drone-dji:BandName", "drone-dji:CentralWavelength")
    band, index = next(filter(None, map(xmp.get, names)), ""), number(xmp, "Camera:RigCameraIndex")
    if band and "," not in band and header.bands == 1:
        words.append(band)
    if index is not None:
        words.append(f"#{index:g}")
    return " ".join(words)


def _scale(header: FrameHeader) -> float:
    """Pixels of the frame for one of the image as it was taken."""
    centre = number(header.xmp or {}, "drone-dji:CalibratedOpticalCenterX")
    full = header.exif.width_px or (2.0 * centre if centre and centre > 0.0 else header.width_px)
    return header.width_px / full


def _at_principal_point(camera: Camera, header: FrameHeader, pixels_per_mm: float | None) -> Camera | None:
    """The camera with the tags' principal point, in mm or pixels; None where it can be neither."""
    point = numbers(header.xmp or {}, "Camera:PrincipalPoint", 2)
    if point is None:
        return camera
    scales = [s for s in (pixels_per_mm, _scale(header)) if s is not None]
    placed = [_centred(camera, (s * point[0], s * point[1])) for s in scales]
    return next((c for c in placed if c is not None), None)


def _with_lens(blank: Camera, focal_px: float, source: str) -> Camera:
    sd_px = FOCAL_LENGTH[source].sd_relative * focal_px
    return replace(blank, focal_length_px=focal_px, focal_length_sd_px=sd_px)


def _centred(camera: Camera, point_px: tuple[float, float]) -> Camera | None:
    """The camera with such a principal point, None where that is too far off the middle."""
    off_px = math.dist(point_px, (camera.width_px / 2.0, camera.height_px / 2.0))
    if off_px > OFF_CENTRE.value * max(camera.width_px, camera.height_px):
        return None
    return replace(camera, principal_col_px=point_px[0], principal_row_px=point_px[1])
