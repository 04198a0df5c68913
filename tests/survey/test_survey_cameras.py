"""Cameras from files and from EXIF."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import cv2
import numpy as np
import pytest
from survey_files import dji_xmp, drone_frame, exif_block, image, write_jpeg, xmp_attributes

from geomosaic.camera.interior import Camera
from geomosaic.errors import FileError, InputError, UnknownNameError
from geomosaic.survey.camera_files import read_cameras
from geomosaic.survey.cameras import (
    _assumed_lens,
    cameras_from_headers,
    reported_camera,
    shutter_warnings,
)
from geomosaic.survey.cameras_of_file import cameras_from_file
from geomosaic.survey.exif import Exif
from geomosaic.survey.header import FrameHeader, read_header
from geomosaic.survey.xmp import parse_xmp


def camera_from_header(header: FrameHeader) -> tuple[Camera, str]:
    """A frame's camera and which source reported it."""
    camera, source, _ = reported_camera(header)
    return _assumed_lens(header) if camera is None else (camera, source)


def header(
    width: int = 4000, height: int = 3000, xmp: dict[str, str] | None = None, **exif: object
) -> FrameHeader:
    return FrameHeader(Path("/f/a.jpg"), width, height, 3, "uint8", None, Exif(**exif), xmp or {})  # type: ignore[arg-type]


def written(tmp_path: Path, content: object, name: str = "cameras.json") -> Path:
    path = tmp_path / name
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


BROWN = {
    "projection_type": "brown", "width": 5472, "height": 3648, "focal_x": 0.66, "focal_y": 0.662,
    "c_x": -0.002, "c_y": 0.005, "k1": -0.26, "k2": 0.1, "k3": -0.02, "p1": 0.0007, "p2": 0.0003,
}  # fmt: skip


def test_opensfm_brown_is_normalised_by_the_longer_side(tmp_path: Path) -> None:
    (camera,) = read_cameras(written(tmp_path, {"v2 dji": BROWN}))
    assert camera.focal_length_px == pytest.approx(0.661 * 5472)
    assert (camera.principal_col_px, camera.principal_row_px) == pytest.approx((2736 - 10.944, 1824 + 27.36))
    assert (camera.k1, camera.k2, camera.k3, camera.p1, camera.p2) == (-0.26, 0.1, -0.02, 0.0007, 0.0003)
    assert camera.focal_length_sd_px == pytest.approx(0.005 * camera.focal_length_px)


def test_opensfm_perspective_upright_and_reconstruction(tmp_path: Path) -> None:
    upright = {
        "projection_type": "perspective",
        "width": 1000,
        "height": 1500,
        "focal": 0.8,
        "k1": -0.1,
        "k2": 0.02,
    }
    for content in ({"a": upright}, [{"cameras": {"a": upright}, "shots": {}}], {"cameras": {"a": upright}}):
        (camera,) = read_cameras(written(tmp_path, content))
        assert camera == Camera(
            "a", 1000, 1500, 1200.0, 500.0, 750.0, k1=-0.1, k2=0.02, focal_length_sd_px=6.0, readout_sd_s=0.04
        )


def test_plain_yaml_of_our_own(tmp_path: Path) -> None:
    text = "name: survey camera\nwidth_px: 5344\nheight_px: 4008\nk1: -0.01\n"
    text += "focal_length_mm: 50\npixel_size_um: 9\n"
    (camera,) = read_cameras(written(tmp_path, text, "camera.yaml"))
    assert camera.name == "survey camera"
    assert camera.focal_length_px == pytest.approx(5555.5556, abs=1e-4)
    assert (camera.principal_col_px, camera.principal_row_px, camera.k1) == (2672.0, 2004.0, -0.01)
    both = (
        "left: {width_px: 100, height_px: 80, focal_length_px: 90, focal_length_sd_px: 0.5, "
        "principal_col_px: 49.5}\n"
        "right:\n  {width_px: 200, height_px: 80, focal_length_px: 95}\n"
    )
    left, right = read_cameras(written(tmp_path, both, "camera.yml"))
    assert (left.name, left.focal_length_sd_px, left.principal_col_px) == ("left", 0.5, 49.5)
    assert (right.name, right.focal_length_sd_px) == ("right", pytest.approx(0.475))


def test_opensfm_fisheyes(tmp_path: Path) -> None:
    """Two terms, and OpenCV's four."""
    opencv = {
        "projection_type": "fisheye_opencv",
        "width": 4000,
        "height": 3000,
        "focal_x": 0.4,
        "focal_y": 0.4,
    }
    opencv |= {"c_x": 0.01, "c_y": -0.005, "k1": -0.03, "k2": 0.012, "k3": -0.009, "k4": 0.004}
    two = {"projection_type": "fisheye", "width": 4000, "height": 3000, "focal": 0.5, "k1": -0.04, "k2": 0.01}
    cameras = {c.name: c for c in read_cameras(written(tmp_path, {"four": opencv, "two": two}))}
    camera = cameras["two"]
    assert (camera.kind, camera.focal_length_px, *camera.terms) == (
        "fisheye",
        2000.0,
        -0.04,
        0.01,
        0.0,
        0.0,
        0.0,
    )
    theta = np.linspace(0.05, 1.2, 9)
    seen = cameras["four"].image_from_camera(np.stack([np.sin(theta), 0.0 * theta, -np.cos(theta)], axis=1))
    k = np.array([[1600.0, 0.0, 2039.5], [0.0, 1600.0, 1479.5], [0.0, 0.0, 1.0]])
    points = np.stack([np.sin(theta), 0.0 * theta, np.cos(theta)], axis=1)[None]
    terms = np.array([-0.03, 0.012, -0.009, 0.004])
    wanted = cv2.fisheye.projectPoints(points, np.zeros(3), np.zeros(3), k, terms)[0][0] + 0.5
    assert seen == pytest.approx(wanted, abs=1e-6)


def test_a_fisheye_in_our_own_yaml(tmp_path: Path) -> None:
    text = "width_px: 100\nheight_px: 80\nfocal_length_px: 60\nkind: {}\nk1: -0.02\n"
    camera = read_cameras(written(tmp_path, text.format("fisheye"), "c.yaml"))[0]
    assert (camera.kind, camera.k1) == ("fisheye", -0.02)
    with pytest.raises(UnknownNameError, match="fisheye"):
        read_cameras(written(tmp_path, text.format("fish"), "c.yaml"))


def test_orthority_yaml(tmp_path: Path) -> None:
    text = "DMC:\n  type: pinhole\n  im_size: [640, 1152]\n  focal_len: 120.0\n"
    text += "  sensor_size: [92.16, 165.888]\n  cx: 0.01\n"
    (camera,) = read_cameras(written(tmp_path, text, "int.yaml"))
    assert camera.focal_length_px == pytest.approx(833.33333)
    assert (camera.principal_col_px, camera.principal_row_px) == pytest.approx((331.52, 576.0))


@pytest.mark.parametrize(
    ("content", "name", "message"),
    [
        ("{", "c.json", r"is no valid JSON: Expecting property name.*; give cameras.json"),
        ("a: [", "c.yaml", "is no valid YAML"),
        ("a: !!python/object/apply:os.system ['true']", "c.yaml", "is no valid YAML"),
        ("[]", "c.json", "holds no cameras"),
        ("just text", "c.yaml", "holds no cameras"),
        ({"a": {"projection_type": "dual", "width": 1}}, "c.json", "projection 'dual' isn't handled"),
        ({"a": {"projection_type": ["brown"], "width": 1}}, "c.json", "isn't handled"),
        ("a: {focal_len: 1, im_size: [3, 2], type: [brown]}\n", "c.yaml", "isn't handled"),
        ({"a": {**BROWN, "focal_y": 0.7}}, "c.json", "differ by more than 1 %"),
        ({"a": {**BROWN, "k1": "NaN"}}, "c.json", "camera 'a' has 'NaN' for k1; give it as a number"),
        ({"a": {k: v for k, v in BROWN.items() if k != "width"}}, "c.json", "camera 'a' has no width"),
        (
            '{"a": {"projection_type": "brown", "width": NaN, "height": 1, "focal_x": 1}}',
            "c.json",
            "is no valid JSON: NaN is no number of JSON",
        ),
        ("width_px: 100\nheight_px: 80\n", "c.yaml", "has no focal_length_px"),
        ("width_px: 100\nheight_px: 80\nfocal_length_px: -5\n", "c.yaml", "must be above 0"),
        (
            "width_px: 100\nheight_px: 80\nfocal_length_px: 50\nfocal_length_sd_px: -1.0e+308\n",
            "c.yaml",
            "has -1e[+]308 for focal_length_sd_px; give a deviation from 0 to the focal length",
        ),
        ("a: {width: 100}\n", "c.yaml", "camera 'a' has none of projection_type, focal_len, width_px"),
        ("a: {focal_len: 1, im_size: [100, 80], sensor_size: [1, 2]}", "c.yaml", "differ in shape"),
        ("a: {focal_len: 1, im_size: 100}", "c.yaml", "im_size isn't"),
        (
            "a: {type: opencv, focal_len: 1, im_size: [100, 80], k1: -0.1, k4: 0.3, k5: 0.02, k6: 0}",
            "c.yaml",
            "its lens has k4, k5 other than 0, which isn't handled; calibrate it with k1, k2, k3, p1, p2 alone",
        ),
        ("a: {type: opencv, focal_len: 1, im_size: [9, 8], s4: 1.0e-3}", "c.yaml", "its lens has s4 other"),
        ("a: {type: opencv, focal_len: 1, im_size: [9, 8], tau_x: 1.0e-3}", "c.yaml", "lens has tau_x"),
        ("a: {type: opencv, focal_len: 1, im_size: [9, 8], ty: 1.0e-3}", "c.yaml", "lens has ty other"),
        ({"a": {**BROWN, "k4": 0.3}}, "c.json", "its lens has k4 other than 0"),
        (
            {
                "a": {
                    "projection_type": "fisheye",
                    "width": 9,
                    "height": 8,
                    "focal": 0.5,
                    "k4": 0.1,
                    "p1": 0.1,
                }
            },
            "c.json",
            "its lens has p1 other than 0, which isn't handled; calibrate it with k1, k2, k3, k4 alone",
        ),
        ({"a": {**BROWN, "focal": 0.7}}, "c.json", "focal 0.7 and focal_x 0.66 and focal_y 0.662 differ by"),
        (
            "width_px: 4000\nheight_px: 3000\nfocal_length_px: 3000\n"
            "focal_length_mm: 8.8\npixel_size_um: 2.4\n",
            "c.yaml",
            "focal_length_px is 3000, but focal_length_mm and pixel_size_um give 3666.7; leave out the wrong",
        ),
    ],
)
def test_bad_camera_files(tmp_path: Path, content: object, name: str, message: str) -> None:
    path = written(tmp_path, content, name)
    with pytest.raises(InputError, match=message) as caught:
        read_cameras(path)
    assert str(caught.value).startswith(f"{path}: ")


def test_terms_of_zero_and_lengths_that_agree_as_written_are_read(tmp_path: Path) -> None:
    """8.8 mm by 2.4 um are 3525 px to 3806 px, by the digits that are written."""
    zeros = {"a": {**BROWN, "focal": 0.661, "k4": 0.0, "s1": 0, "tau_x": 0.0}}
    assert read_cameras(written(tmp_path, zeros))[0].focal_length_px == pytest.approx(0.661 * 5472)
    text = "width_px: 4000\nheight_px: 3000\nfocal_length_px: {}\nfocal_length_mm: 8.8\npixel_size_um: {}\n"
    for focal_px, pixel_um in ((3667, 2.4), (3700.5, 2.4), (3666.7, 2.40001)):
        (camera,) = read_cameras(written(tmp_path, text.format(focal_px, pixel_um), "c.yaml"))
        assert camera.focal_length_px == focal_px
    with pytest.raises(InputError, match=r"focal_length_px is 3700\.5, but"):
        read_cameras(written(tmp_path, text.format(3700.5, 2.40001), "c.yaml"))


def test_a_misspelt_key_is_named(tmp_path: Path) -> None:
    with pytest.raises(UnknownNameError, match="did you mean 'focal_length_px'"):
        read_cameras(written(tmp_path, "width_px: 1\nheight_px: 1\nfocal_lenght_px: 1\n", "c.yaml"))
    with pytest.raises(FileError, match=r"there is no such file; give cameras.json"):
        read_cameras(tmp_path / "none.json")


def test_focal_length_from_the_sensor_table() -> None:
    camera, source = camera_from_header(
        header(4000, 2250, make="DJI", model="FC300S", focal_length_mm=3.61, focal_length_35mm=20.0)
    )
    assert source == "sensor-table"
    assert camera.focal_length_px == pytest.approx(3.61 * 4000 / 6.17)
    assert camera.focal_length_sd_px == pytest.approx(0.02 * camera.focal_length_px)
    assert camera.name == "DJI FC300S 4000 x 2250 3.61 mm"


@pytest.mark.parametrize(
    ("width", "height", "expected"),
    [(6000, 4000, 24 / 36 * 6000), (4000, 3000, 24 * 5000 / 43.26661), (4000, 2250, 24 * 5000 / 43.26661)],
)
def test_focal_length_from_the_35_mm_equivalent_compares_diagonals(
    width: int, height: int, expected: float
) -> None:
    camera, source = camera_from_header(header(width, height, focal_length_35mm=24.0))
    assert source == "exif-35mm"
    assert camera.focal_length_px == pytest.approx(expected, rel=1e-6)
    rounding = 1 / math.sqrt(12) / 24
    assert camera.focal_length_sd_px / camera.focal_length_px == pytest.approx(math.hypot(0.02, rounding))


def test_focal_length_from_the_focal_plane_of_a_resized_image() -> None:
    camera, source = camera_from_header(
        header(
            2000,
            1500,
            width_px=4000,
            height_px=3000,
            focal_length_mm=5.5,
            pixels_per_mm=250.0,
            focal_length_35mm=12.0,
        )
    )
    assert (source, camera.focal_length_px) == ("focal-plane", 687.5)


def test_djis_own_calibration() -> None:
    data = "2018-09-07;3657.02,3650.62,-4.03,23.1,-0.267,0.112,0.00092,0.00009,-0.033"
    exif = {
        "make": "DJI",
        "model": "FC6310R",
        "width_px": 5472,
        "focal_length_mm": 8.8,
        "focal_length_35mm": 24.0,
    }
    camera, source = camera_from_header(header(1368, 912, {"drone-dji:DewarpData": data}, **exif))
    assert source == "dji-dewarp"
    assert camera.focal_length_px == pytest.approx(3653.82 / 4)
    assert (camera.principal_col_px, camera.principal_row_px) == pytest.approx((684 - 1.0075, 456 + 5.775))
    assert (camera.k1, camera.k2, camera.p1, camera.p2, camera.k3) == (
        -0.267,
        0.112,
        0.00092,
        0.00009,
        -0.033,
    )
    dewarped, _ = camera_from_header(
        header(1368, 912, {"drone-dji:DewarpData": data, "drone-dji:DewarpFlag": "1"}, **exif)
    )
    assert (dewarped.k1, dewarped.focal_length_px) == (0.0, camera.focal_length_px)
    wrong, source = camera_from_header(
        header(1368, 912, {"drone-dji:DewarpData": data.replace("365", "965")}, **exif)
    )
    assert (source, wrong.k1) == ("sensor-table", 0.0)


@pytest.mark.parametrize(("width", "height"), [(4000, 3000), (3000, 4000)])
def test_a_lens_that_nothing_reports_is_assumed(width: int, height: int) -> None:
    frame = header(width, height, make="X", model="Y", focal_length_mm=8.8)
    choice = cameras_from_headers([frame])
    (camera,) = choice.cameras
    assert camera_from_header(frame) == (camera, "assumed")
    assert (camera.focal_length_px, camera.focal_length_sd_px) == (3400.0, 1700.0)
    (warning,) = choice.warnings
    assert warning.code == "focal-length-assumed"
    assert "3400 px is assumed" in warning.text
    assert "--camera FILE" in warning.text


@pytest.mark.parametrize(
    ("size", "exif", "expected"),
    [
        ((640, 512), {"make": "DJI", "model": "MAVIC2-ENTERPRISE-ADVANCED"}, 750.0),
        ((640, 512), {"make": "DJI", "model": "XT2", "focal_length_mm": 13.0, "pixels_per_mm": 10.8}, 764.7),
        ((336, 256), {"make": "FLIR", "model": "Vue Pro R", "focal_length_mm": 13.0}, 764.7),
        ((1280, 1024), {"make": "DJI", "model": "M3T", "focal_length_mm": 9.1}, 1516.7),
        (
            (640, 512),
            {"make": "Teledyne FLIR", "model": "BOSON 640 8.7MM LWIR", "focal_length_mm": 8.7},
            725.0,
        ),
        ((1640, 1232), {"make": "RaspberryPi", "model": "RP_imx219"}, 1357.1),
        ((4608, 2592), {"make": "Raspberry Pi", "model": "imx708_wide"}, 1964.3),
        ((4608, 2592), {"make": "Raspberry Pi", "model": "imx708"}, 3385.7),
    ],
)
def test_sensors_of_published_pitch(size: tuple[int, int], exif: dict[str, object], expected: float) -> None:
    camera, source = camera_from_header(header(*size, **exif))
    assert (source, camera.kind) == ("sensor-pitch", "brown")
    assert camera.focal_length_px == pytest.approx(expected, abs=0.1)


def test_the_visual_camera_of_a_thermal_drone_goes_by_its_own_tags() -> None:
    exif = {"make": "DJI", "model": "MAVIC2-ENTERPRISE-ADVANCED", "focal_length_35mm": 24.0}
    assert camera_from_header(header(8000, 6000, **exif))[1] == "exif-35mm"


@pytest.mark.parametrize(
    ("exif", "expected", "reach"),
    [
        # Both can be: the one nearer to what most cameras have, as unsure as they are apart.
        ({"focal_length_mm": 10.0, "pixels_per_mm": 300.0, "focal_length_35mm": 94.0}, 3000.0, 10862 - 3000),
        # No lens maps a plane to a plane as wide.
        ({"focal_length_mm": 5.0, "pixels_per_mm": 150.0}, 3400.0, 3400.0 - 750.0),
    ],
)
def test_contradicting_tags_have_a_deviation_that_covers_them(
    exif: dict[str, object], expected: float, reach: float
) -> None:
    choice = cameras_from_headers([header(make="X", model="Y", **exif)])
    (camera,) = choice.cameras
    assert camera.focal_length_px == pytest.approx(expected)
    assert camera.focal_length_sd_px == pytest.approx(reach, rel=1e-3)
    assert [w.code for w in choice.warnings] == ["focal-length-assumed"]


def test_a_source_that_two_others_contradict_is_outvoted() -> None:
    camera, source = camera_from_header(
        header(make="DJI", model="FC6310", focal_length_mm=8.8, pixels_per_mm=40.0, focal_length_35mm=24.0)
    )
    assert (source, camera.focal_length_px) == ("sensor-table", pytest.approx(8.8 * 4000 / 13.2))


def test_a_zoom_that_always_says_the_same_says_nothing() -> None:
    exif = {"make": "SIYIKEJI", "model": "ZR10", "focal_length_mm": 47.0, "focal_length_35mm": 94.0}
    camera, source = camera_from_header(header(2560, 1440, **exif))
    assert (source, camera.focal_length_px) == ("assumed", 2176.0)


def test_an_action_camera_in_its_wide_mode_begins_as_a_fisheye() -> None:
    camera, source = camera_from_header(header(make="GoPro", model="HERO5 Black", focal_length_35mm=15.0))
    assert (source, camera.kind) == ("action-camera", "fisheye")
    assert camera.focal_length_px / 4000 == pytest.approx(0.433, abs=1e-3)
    linear, _ = camera_from_header(header(make="GoPro", model="HERO5 Black", focal_length_35mm=17.0))
    assert linear.kind == "brown"
    untagged, source = camera_from_header(header(make="GoPro", model="HERO5 Black"))
    assert (source, untagged.kind, untagged.focal_length_px) == ("assumed", "fisheye", 1880.0)


def test_each_make_size_and_focal_length_is_a_camera() -> None:
    one = header(make="DJI", model="FC6310", focal_length_mm=8.8)
    two = replace(one, width_px=2000, height_px=1500)
    choice = cameras_from_headers([one, two, one])
    assert choice.names == (
        "DJI FC6310 4000 x 3000 8.8 mm",
        "DJI FC6310 2000 x 1500 8.8 mm",
        "DJI FC6310 4000 x 3000 8.8 mm",
    )
    assert [c.name for c in choice.cameras] == [*choice.names[:2]]
    assert [w.code for w in choice.warnings] == ["camera-assumed", "camera-assumed"]


def test_two_calibrations_of_one_model_are_two_cameras(tmp_path: Path) -> None:
    paths = []
    for i, f in enumerate((120.0, 121.0, 120.0)):
        exif = exif_block(Make="DJI", Model="FC6310", FocalLength=Fraction("8.8"))
        xmp = dji_xmp(DewarpData=f"2020-01-01;{f},{f},0,0,-0.1,0,0,0,0")
        paths.append(write_jpeg(tmp_path / f"{i}.jpg", image(180, 120), exif, xmp))
    choice = cameras_from_headers([read_header(p) for p in paths])
    assert [c.focal_length_px for c in choice.cameras] == [120.0, 121.0]
    assert choice.names == (
        "DJI FC6310 180 x 120 8.8 mm",
        "DJI FC6310 180 x 120 8.8 mm (2)",
        "DJI FC6310 180 x 120 8.8 mm",
    )


CAMERA = Camera("big", 4000, 3000, 3500.0, 1990.0, 1510.0, k1=-0.1, focal_length_sd_px=8.0)


def test_a_resized_frame_scales_its_camera() -> None:
    choice = cameras_from_file([header(1000, 750)], [CAMERA], Path("c.json"), [None])
    assert choice.cameras == (Camera("big", 1000, 750, 875.0, 497.5, 377.5, k1=-0.1, focal_length_sd_px=2.0),)
    assert choice.warnings[0].code == "camera-scaled"
    assert choice.warnings[0].text.startswith("big: of 4000 x 3000 pixels, scaled by 0.25 to ")


def test_a_camera_of_another_shape_is_refused() -> None:
    message = (
        r"c\.json: no camera for frame a\.jpg of 4000 x 2250 pixels: big \(4000 x 3000\); give --camera FILE"
    )
    with pytest.raises(InputError, match=message):
        cameras_from_file([header(4000, 2250)], [CAMERA], Path("c.json"), [None])
    with pytest.raises(InputError, match="no camera for frame"):
        cameras_from_file([header(3000, 4000)], [CAMERA], Path("c.json"), [None])


def test_several_cameras_are_distinguished() -> None:
    cameras = [
        CAMERA,
        replace(CAMERA, name="v2 dji fc6310"),
        replace(CAMERA, name="small", width_px=400, height_px=300),
    ]
    dji = header(make="DJI", model="FC6310")
    assert cameras_from_file([dji], cameras, Path("c"), [None]).names == ("v2 dji fc6310",)
    assert cameras_from_file([header(400, 300)], cameras, Path("c"), [None]).names == ("small",)
    assert cameras_from_file([dji], cameras, Path("c"), ["big"]).names == ("big",)
    with pytest.raises(InputError, match="several cameras fit frame"):
        cameras_from_file([header()], cameras, Path("c"), [None])


def test_a_drone_frame_tells_its_camera(tmp_path: Path) -> None:
    camera, source = camera_from_header(read_header(drone_frame(tmp_path / "a.jpg")))
    assert (source, camera.focal_length_px) == ("sensor-table", pytest.approx(80.0))


SEQUOIA = {
    "ModelType": "perspective", "PrincipalPoint": "3.042001,2.280612", "PerspectiveFocalLength": "4.812073",
    "PerspectiveDistortion": "0.178441961,-0.4745818,0.402026402,-0.000900784,-0.000653429",
    "LineReadoutTime": "47500",
}  # fmt: skip


def tagged(path: Path, bands: int = 3, size: tuple[int, int] = (288, 216), **tags: object) -> Path:
    """A small copy of a frame whose tags are of 4608 x 3456 pixels of 1.34 um."""
    exif = exif_block(
        Make="Parrot", Model="Sequoia", FocalLength=Fraction("4.88"), FocalLengthIn35mmFilm=28,
        PixelXDimension=4608, PixelYDimension=3456, FocalPlaneXResolution=Fraction("746.2687"),
        FocalPlaneResolutionUnit=4,
    )  # fmt: skip
    xmp = xmp_attributes("http://pix4d.com/camera/1.0/", "Camera", **tags)
    return write_jpeg(path, image(*size, bands), exif, xmp)


def test_the_makers_lens_in_pix4ds_tags(tmp_path: Path) -> None:
    """mm of the sensor times pixels per mm, a sixteenth of the full frame; R1, R2, R3, T1, T2."""
    choice = cameras_from_headers([read_header(tagged(tmp_path / "a.jpg", **SEQUOIA))])
    (camera,) = choice.cameras
    per_mm = 746.2687 / 16
    assert camera.focal_length_px == pytest.approx(4.812073 * per_mm, rel=1e-6)
    assert camera.focal_length_px * 16 == pytest.approx(3591.1, abs=0.1)
    assert camera.focal_length_sd_px == pytest.approx(0.005 * camera.focal_length_px)
    assert camera.principal_col_px == pytest.approx(3.042001 * per_mm, rel=1e-6)
    assert camera.principal_row_px == pytest.approx(2.280612 * per_mm, rel=1e-6)
    assert (camera.k1, camera.k2, camera.k3) == (0.178441961, -0.4745818, 0.402026402)
    assert (camera.p1, camera.p2, camera.distortion_sd) == (-0.000900784, -0.000653429, 0.002)
    assert camera.readout_s == pytest.approx(47.5e-6 * 3456)
    assert [w.code for w in choice.warnings] == ["camera-assumed", "readout-by-tag"]
    assert choice.warnings[0].text.endswith(
        "focal length 224 px (sd 1) from xmp-perspective, principal point 142, 106 and distortion"
    )
    assert choice.warnings[1].text.endswith("that reads all rows in 0.164 s (LineReadoutTime)")


def test_a_list_of_distortion_terms_and_lengths_in_pixels() -> None:
    terms = "-0.1,0.2,-0.03,0.001,0.002"
    seq = "".join(f"<r:li>{term}</r:li>" for term in terms.split(","))
    packet = (
        '<x:xmpmeta xmlns:x="adobe:ns:meta/"><r:RDF xmlns:r="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
        '<r:Description xmlns:Camera="http://pix4d.com/camera/1.0/">'
        f"<Camera:PerspectiveDistortion><r:Seq>{seq}</r:Seq></Camera:PerspectiveDistortion>"
        "<Camera:PerspectiveFocalLength>3500</Camera:PerspectiveFocalLength>"
        "<Camera:PerspectiveFocalLengthUnits>px</Camera:PerspectiveFocalLengthUnits>"
        "<Camera:PrincipalPoint>2010,1490</Camera:PrincipalPoint></r:Description></r:RDF></x:xmpmeta>"
    )
    xmp = parse_xmp(packet.encode())
    camera, source = camera_from_header(header(2000, 1500, xmp, width_px=4000, height_px=3000))
    assert (source, camera.focal_length_px) == ("xmp-perspective", 1750.0)
    assert (camera.principal_col_px, camera.principal_row_px) == (1005.0, 745.0)
    assert (camera.k1, camera.k2, camera.k3, camera.p1, camera.p2) == (-0.1, 0.2, -0.03, 0.001, 0.002)


@pytest.mark.parametrize(
    "odd",
    [
        {"PrincipalPoint": "2.28,3.04"},
        {"PerspectiveFocalLength": "7.5"},
        {"PerspectiveFocalLength": "nan"},
        {"PerspectiveFocalLengthUnits": "furlong"},
        {"PerspectiveDistortion": "90,0,0,0,0"},
    ],
)
def test_a_makers_lens_that_is_not_this_images_is_not_taken(tmp_path: Path, odd: dict[str, str]) -> None:
    camera, source = camera_from_header(read_header(tagged(tmp_path / "a.jpg", **(SEQUOIA | odd))))
    assert source == "focal-plane"
    assert (camera.principal_col_px, camera.k1, camera.distortion_sd) == (144.0, 0.0, 0.0)


MSP = {  # of a Sequoia's green camera; 3.75 um pixels
    "ModelType": "fisheye",
    "FisheyePolynomial": "0,1,0.00592627,-0.136981656",
    "FisheyeAffineMatrix": "1676.825547004,0,0,1676.825547004",
    "PrincipalPoint": "2.487934,1.754932",
}


def sequoia(xmp: dict[str, str]) -> FrameHeader:
    exif = {"pixels_per_mm": 1000.0 / 3.75, "focal_length_mm": 3.98, "make": "Parrot", "model": "Sequoia"}
    return header(1280, 960, xmp, **exif)


def test_the_makers_fisheye_in_pix4ds_tags() -> None:
    """Pixels by hand: 0.3 rad is 0.19099 of a right angle, rho 0.19025 of the image circle's 1676.83 px."""
    camera, source = camera_from_header(sequoia({f"Camera:{k}": v for k, v in MSP.items()}))
    assert (source, camera.kind) == ("xmp-fisheye", "fisheye")
    assert camera.focal_length_px == pytest.approx(1067.5003, abs=1e-3)
    assert (camera.principal_col_px, camera.principal_row_px) == pytest.approx((663.449, 467.982), abs=1e-3)
    at = camera.image_from_camera([np.sin(0.3), 0.0, -np.cos(0.3)])
    share = 2.0 * 0.3 / np.pi
    rho = share + 0.00592627 * share**2 - 0.136981656 * share**3
    assert at == pytest.approx([663.4491 + 1676.825547 * rho, 467.9819], abs=1e-3)
    assert at[0] == pytest.approx(982.458, abs=1e-2)
    assert 0.0 < camera.distortion_sd < 0.01


def test_a_fourth_power_is_taken_up_by_the_others() -> None:
    camera, _ = camera_from_header(
        sequoia({f"Camera:{k}": v for k, v in (MSP | {"FisheyePolynomial": "0,1,0.006,-0.14,0.05"}).items()})
    )
    theta = np.linspace(0.01, 0.7, 9)
    share = 2.0 * theta / np.pi
    rho = share + 0.006 * share**2 - 0.14 * share**3 + 0.05 * share**4
    at = camera.image_from_camera(np.stack([np.sin(theta), 0.0 * theta, -np.cos(theta)], axis=1))
    assert at[:, 0] == pytest.approx(663.4491 + 1676.825547 * rho, abs=0.005)


@pytest.mark.parametrize(
    "odd",
    [
        {"FisheyePolynomial": "0.2,1,0.006,-0.137"},
        {"FisheyePolynomial": "0,1,0.006"},
        {"FisheyePolynomial": "0,1,0,0,1e308"},
        {"FisheyeAffineMatrix": "1e308,0,0,1e308"},
        {"FisheyeAffineMatrix": "1676,0,0,1500"},
        {"FisheyeAffineMatrix": "1676,90,0,1676"},
        {"FisheyeAffineMatrix": "-1676,0,0,-1676"},
        {"PrincipalPoint": "900.0,10.0"},
    ],
)
def test_a_fisheye_that_no_tag_tells_rightly_is_equidistant(odd: dict[str, str]) -> None:
    xmp = {f"Camera:{k}": v for k, v in (MSP | odd).items()}
    camera, source = camera_from_header(sequoia(xmp))
    assert (source, camera.kind, camera.terms.any(), camera.distortion_sd) == (
        "focal-plane",
        "fisheye",
        False,
        0.0,
    )
    assert camera.focal_length_px == pytest.approx(1061.333, abs=1e-3)


def test_a_fisheye_lens_is_reported_and_a_global_shutter_known(tmp_path: Path) -> None:
    tags = {"ModelType": "fisheye", "LineReadoutTime": "23076"}
    paths = [
        tagged(tmp_path / f"{band}.jpg", 1, **tags, BandName=band, RigCameraIndex=i, PrincipalPoint="2.5,1.7")
        for i, band in enumerate(("Green", "Red"))
    ]
    choice = cameras_from_headers([read_header(p) for p in paths])
    assert choice.names == (
        "Parrot Sequoia Green #0 288 x 216 4.88 mm",
        "Parrot Sequoia Red #1 288 x 216 4.88 mm",
    )
    assert [w.code for w in choice.warnings] == ["camera-assumed"] * 2
    assert "228 px (sd 5) from focal-plane of a fisheye lens, whose distortion" in choice.warnings[1].text
    assert [(c.readout_s, c.kind) for c in choice.cameras] == [(0.0, "fisheye")] * 2


@pytest.mark.parametrize("line_ns", ["-5", "3e9"])
def test_a_readout_that_cant_be(tmp_path: Path, line_ns: str) -> None:
    path = tagged(tmp_path / "a.jpg", **(SEQUOIA | {"LineReadoutTime": line_ns}))
    choice = cameras_from_headers([read_header(path)])
    assert choice.cameras[0].readout_s == 0.0
    assert [w.code for w in choice.warnings] == ["camera-assumed", "readout-absurd"]


def test_djis_number_for_the_model() -> None:
    xmp = {"drone-dji:CalibratedFocalLength": "3666.666504", "drone-dji:CalibratedOpticalCenterX": "2746.0"}
    xmp["drone-dji:CalibratedOpticalCenterY"] = "1814.0"
    exif = {"make": "DJI", "model": "FC6310R", "width_px": 5472, "focal_length_mm": 8.8}
    camera, source = camera_from_header(header(1368, 912, xmp, **exif))
    assert (source, camera.focal_length_px) == ("dji-calibrated", pytest.approx(916.666626))
    assert camera.focal_length_sd_px == pytest.approx(0.01 * camera.focal_length_px)
    assert (camera.principal_col_px, camera.principal_row_px) == (686.5, 453.5)


def test_an_upright_frame_has_the_lens_of_a_lying_one() -> None:
    exif = {"make": "DJI", "model": "FC300S", "width_px": 4000, "height_px": 2250, "focal_length_mm": 3.61}
    lying, upright = (camera_from_header(header(*size, {}, **exif)) for size in ((2000, 1125), (1125, 2000)))
    assert upright[1] == lying[1] == "sensor-table"
    assert upright[0].focal_length_px == lying[0].focal_length_px == pytest.approx(3.61 * 2000 / 6.17)
    (warning,) = shutter_warnings(header(1125, 2000, {}, **exif), upright[0])
    assert warning.code == "pixels-turned"


def test_a_camera_file_unlike_the_tags_is_followed_with_a_word(tmp_path: Path) -> None:
    """A sensor's size left out of the file makes parts of the side of what was in mm."""
    header = read_header(drone_frame(tmp_path / "a.jpg"))
    reported = camera_from_header(header)[0].focal_length_px
    for factor, words in ((1.1, []), (12.0, ["focal-length-differs"])):
        camera = Camera("mine", header.width_px, header.height_px, factor * reported, 60.0, 40.0)
        choice = cameras_from_file([header], [camera], tmp_path / "c.yaml", [None])
        assert [w.code for w in choice.warnings] == words
        assert choice.cameras[0].focal_length_px == factor * reported


@pytest.mark.parametrize(
    ("in_file", "model", "expected", "words"),
    [
        ({"readout_s": 0.0, "readout_sd_s": 0.0}, "FC330", (0.0, 0.0), []),
        ({"readout_s": 0.05, "readout_sd_s": 0.0}, "FC330", (0.05, 0.0), []),
        ({"readout_sd_s": 0.04}, "FC330", (0.033, 0.0033), ["readout-by-model"]),
        ({"readout_sd_s": 0.04}, "FC6310", (0.0, 0.0), []),
        ({"readout_sd_s": 0.04}, "unheard of", (0.0, 0.04), []),
    ],
)
def test_of_a_shutter_that_a_camera_file_does_not_tell_of_the_frames_do(
    in_file: dict[str, float], model: str, expected: tuple[float, float], words: list[str]
) -> None:
    camera = replace(CAMERA, **in_file)  # type: ignore[arg-type]
    frame = header(camera.width_px, camera.height_px, make="DJI", model=model)
    choice = cameras_from_file([frame], [camera], Path("c.json"), [None])
    assert (choice.cameras[0].readout_s, choice.cameras[0].readout_sd_s) == pytest.approx(expected)
    assert [w.code for w in choice.warnings] == words


@pytest.mark.parametrize(
    ("equivalent_mm", "zoom", "times"),
    [(None, 2.0, 2.0), (48, 2.0, 2.0), (24, 2.0, 1.0), (None, 1.0, 1.0), (None, 0.0, 1.0), (24, 1.0, 1.0)],
    ids=["no equivalent", "in the equivalent", "in none", "none", "not used", "none in the equivalent"],
)
def test_a_digital_zoom_counts_once(
    tmp_path: Path, equivalent_mm: int | None, zoom: float, times: float
) -> None:
    """The lens of 8.8 mm is 24 mm in 35 mm film; the zoom shows half of its sensor of 13.2 mm."""
    equivalent = {} if equivalent_mm is None else {"FocalLengthIn35mmFilm": equivalent_mm}
    exif = exif_block(
        Make="DJI", Model="FC6310", FocalLength=Fraction("8.8"), DigitalZoomRatio=Fraction(zoom), **equivalent
    )
    found = read_header(write_jpeg(tmp_path / "a.jpg", image(120, 80), exif))
    camera, source = camera_from_header(found)
    assert source == "sensor-table"
    assert camera.focal_length_px == pytest.approx(times * 120 * 8.8 / 13.2)
    assert camera.name == "DJI FC6310 120 x 80 8.8 mm" + (" x 2" if zoom == 2.0 else "")
