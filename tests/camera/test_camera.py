"""Rotations, distortion and collinearity, with absolute and non-symmetric numbers."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from geomosaic.camera.exterior import Pose, Turns
from geomosaic.camera.interior import Camera
from geomosaic.camera.lens import LENSES, opencv_terms
from geomosaic.camera.rotation import Rotation, about_x, about_y, about_z, turned_by

RIGHT, TOP, VIEW = np.eye(3)[0], np.eye(3)[1], -np.eye(3)[2]
CAMERA = Camera("test", 4000, 3000, 3100.0, 2012.0, 1489.0, -0.09, 0.012, -0.002, 0.0011, -0.0007)
angle = st.floats(-3.1, 3.1)
tilt = st.floats(-1.4, 1.4)


def deg(*angles: float) -> list[float]:
    return [float(np.radians(a)) for a in angles]


@pytest.mark.parametrize(
    "rotation",
    [
        Rotation.from_yaw_pitch_roll(*deg(30, 0, 0)),
        Rotation.from_gimbal(*deg(30, -90, 0)),
        Rotation.from_gimbal(*deg(-150, -90, 180)),
        Rotation.from_omega_phi_kappa(*deg(0, 0, -30)),
        Rotation.from_phi_omega_kappa(*deg(0, 0, -30)),
    ],
)
def test_nadir_with_heading_30(rotation: Rotation) -> None:
    """However it is written, the top of the image points to azimuth 30 and the camera looks down."""
    assert rotation.matrix @ TOP == pytest.approx([0.5, np.sqrt(0.75), 0.0], abs=1e-12)
    assert rotation.matrix @ VIEW == pytest.approx([0.0, 0.0, -1.0], abs=1e-12)


def test_signs_of_tilts() -> None:
    """Heading north: pitch 10 looks north, roll 10 looks west; phi 10 (phi-primary) looks north, its
    omega 10 west; omega 10 (omega-primary) looks north, phi 10 looks west."""
    s, c = np.sin(np.radians(10)), np.cos(np.radians(10))
    north, west = [0, s, -c], [-s, 0, -c]
    assert Rotation.from_yaw_pitch_roll(*deg(0, 10, 0)).matrix @ VIEW == pytest.approx(north)
    assert Rotation.from_yaw_pitch_roll(*deg(0, 0, 10)).matrix @ VIEW == pytest.approx(west)
    assert Rotation.from_phi_omega_kappa(*deg(10, 0, 0)).matrix @ VIEW == pytest.approx(north)
    assert Rotation.from_phi_omega_kappa(*deg(0, 10, 0)).matrix @ VIEW == pytest.approx(west)
    assert Rotation.from_omega_phi_kappa(*deg(10, 0, 0)).matrix @ VIEW == pytest.approx(north)
    assert Rotation.from_omega_phi_kappa(*deg(0, 10, 0)).matrix @ VIEW == pytest.approx(west)


def test_the_papers_matrix() -> None:
    """Yue et al. 2021, equation 1, element by element, for phi 0.1, omega 0.2, kappa 0.3."""
    p, o, k = 0.1, 0.2, 0.3
    s, c = np.sin, np.cos
    paper = [
        [c(p) * c(k) - s(p) * s(o) * s(k), -c(p) * s(k) - s(p) * s(o) * c(k), -s(p) * c(o)],
        [c(o) * s(k), c(o) * c(k), -s(o)],
        [s(p) * c(k) + c(p) * s(o) * s(k), -s(p) * s(k) + c(p) * s(o) * c(k), c(p) * c(o)],
    ]
    north_west_up = np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1]])
    top_left_up = np.column_stack([TOP, -RIGHT, -VIEW])
    matrix = Rotation.from_phi_omega_kappa(p, o, k).matrix
    assert north_west_up @ matrix @ top_left_up == pytest.approx(np.array(paper))


# Frames of 30 degrees off nadir with attitude twice over, published with orthority's test data:
# (roll, pitch, yaw) as flown, and (omega, phi, kappa) as adjusted; they agree to 1.3 degrees.
OBLIQUE = [
    ((0.0, 30.0, 92.9), (-2.728, -30.083, -93.729)),
    ((0.0, 30.0, -175.8), (-30.071, 1.882, 175.984)),
    ((0.0, 30.0, -90.3), (-0.798, 29.064, 90.031)),
    ((0.0, 30.0, -2.1), (28.831, 0.94, 1.782)),
]


@pytest.mark.parametrize(("flown", "adjusted"), OBLIQUE)
def test_two_published_attitudes_of_one_frame_agree(
    flown: tuple[float, ...], adjusted: tuple[float, ...]
) -> None:
    roll, pitch, yaw = deg(*flown)
    a = Rotation.from_yaw_pitch_roll(yaw, pitch, roll)
    b = Rotation.from_omega_phi_kappa(*deg(*adjusted))
    between = np.degrees(np.arccos((np.trace(a.matrix.T @ b.matrix) - 1) / 2))
    assert between < 1.3
    assert np.degrees(b.yaw_pitch_roll()) == pytest.approx([yaw * 180 / np.pi, 30.0, 0.0], abs=1.3)


@given(angle, tilt, angle)
def test_angles_there_and_back(a: float, b: float, c: float) -> None:
    for into, back in (
        (Rotation.from_omega_phi_kappa, Rotation.omega_phi_kappa),
        (Rotation.from_yaw_pitch_roll, Rotation.yaw_pitch_roll),
    ):
        rotation = into(a, b, c)
        assert into(*back(rotation)).matrix == pytest.approx(rotation.matrix, abs=1e-9)
        assert np.array(back(rotation)) == pytest.approx([a, b, c], abs=1e-6)
    rotation = Rotation.from_phi_omega_kappa(a, b, c)
    assert np.array(rotation.phi_omega_kappa()) == pytest.approx([a, b, c], abs=1e-6)


def test_body_pitch_is_gimbal_pitch_plus_90() -> None:
    assert Rotation.from_gimbal(*deg(77, -60, 0)).matrix == pytest.approx(
        Rotation.from_yaw_pitch_roll(*deg(77, 30, 0)).matrix
    )


def test_an_image_turned_clockwise_points_its_top_to_the_left_of_before() -> None:
    """Turned by one quarter clockwise in a viewer, what was left is now on top."""
    turned = Rotation.from_yaw_pitch_roll(*deg(30, 0, 0)).turned(1)
    assert np.degrees(turned.yaw_pitch_roll()[0]) == pytest.approx(-60.0)


def test_pixel_of_a_ground_point_by_hand() -> None:
    """100 m up, heading north, f 1000 px: 10 m east and 20 m north is 100 px right, 200 px up."""
    camera = Camera("plain", 800, 600, 1000.0, 400.0, 300.0)
    pose = Pose(np.array([5.0, 7.0, 100.0]), Rotation.from_yaw_pitch_roll(0.0, 0.0, 0.0))
    assert pose.image_from_ground(camera, [15.0, 27.0, 0.0]) == pytest.approx([500.0, 100.0])
    east = Pose(np.array([5.0, 7.0, 100.0]), Rotation.from_yaw_pitch_roll(np.pi / 2, 0.0, 0.0))
    assert east.image_from_ground(camera, [15.0, 27.0, 0.0]) == pytest.approx([200.0, 200.0])


def test_projection_agrees_with_opencv() -> None:
    """cv2.projectPoints with the same Brown coefficients; its axes are x right, y down, z forward."""
    rng = np.random.default_rng(3)
    points = np.column_stack([rng.uniform(-40, 40, (500, 2)), rng.uniform(-3, 3, 500)])
    pose = Pose(np.array([2.0, -3.0, 100.0]), Rotation.from_yaw_pitch_roll(0.7, 0.05, -0.08))
    cv_from_camera = np.diag([1.0, -1.0, -1.0])
    r = cv_from_camera @ pose.rotation.matrix.T
    k = np.array([[3100.0, 0, 2012.0], [0, 3100.0, 1489.0], [0, 0, 1]])
    expected, _ = cv2.projectPoints(
        points, cv2.Rodrigues(r)[0], -r @ pose.position_m, k, opencv_terms("brown", CAMERA.terms, 1.0)
    )
    found = pose.image_from_ground(CAMERA, points)
    assert found == pytest.approx(expected[:, 0], abs=1e-6)


@given(st.floats(0, 4000), st.floats(0, 3000))
def test_undistortion_undoes_distortion(col: float, row: float) -> None:
    ray = CAMERA.ray_from_image([col, row])
    assert CAMERA.image_from_camera(ray * 37.0) == pytest.approx([col, row], abs=1e-6)


FISHEYE = Camera("eye", 4000, 3000, 1600.0, 2012.0, 1489.0, -0.03, 0.012, -0.004, 0.001, kind="fisheye")


def test_a_fisheye_is_opencvs() -> None:
    rng = np.random.default_rng(5)
    points = rng.normal([0.0, 0.0, 3.0], [3.0, 3.0, 0.3], (40, 3))
    k = np.array([[1600.0, 0.0, 2011.5], [0.0, 1600.0, 1488.5], [0.0, 0.0, 1.0]])
    terms = opencv_terms("fisheye", FISHEYE.terms, FISHEYE.radius_limit)
    wanted = cv2.fisheye.projectPoints(points[None], np.zeros(3), np.zeros(3), k, terms)[0][0] + 0.5
    seen = FISHEYE.image_from_camera(points * [1.0, -1.0, -1.0])
    inside = np.isfinite(seen).all(axis=1)
    assert inside.sum() > 20
    assert seen[inside] == pytest.approx(wanted[inside], abs=1e-8)


def test_a_fisheye_by_hand() -> None:
    """45 degrees to the right and straight on; equidistant: 0.7854 of the focal length, Brown's pinhole: 1."""
    plain = Camera("eye", 4000, 3000, 1000.0, 2000.0, 1500.0, kind="fisheye")
    assert plain.image_from_camera([1.0, 0.0, -1.0]) == pytest.approx([2785.398, 1500.0], abs=1e-3)
    assert plain.image_from_camera([0.0, 0.0, -1.0]) == pytest.approx([2000.0, 1500.0])
    assert plain.ray_from_image([2785.398163, 1500.0]) == pytest.approx([1.0, 0.0, -1.0], abs=1e-9)
    bent = replace(plain, k1=0.1, p2=-0.2)  # 785.398 (1 + 0.1 * 0.61685 - 0.2 * 0.785398)
    assert bent.image_from_camera([0.0, -1.0, -1.0]) == pytest.approx([2000.0, 2210.476], abs=1e-3)


@given(st.floats(1.0, 3999.0), st.floats(1.0, 2999.0), st.floats(-0.1, 0.1), st.floats(-0.05, 0.05))
def test_a_fisheye_undone(col: float, row: float, k1: float, p2: float) -> None:
    """As far as the lens goes: with the strongest terms its radius ends before the corners."""
    camera = replace(FISHEYE, focal_length_px=2200.0, k1=k1, p2=p2)
    end_px = 2200.0 * float(camera.lens.radial(camera.terms, np.asarray(camera.radius_limit)))
    assume(np.hypot(col - 2012.0, row - 1489.0) < end_px - 1.0)
    assert camera.image_from_camera(camera.ray_from_image([col, row])) == pytest.approx([col, row], abs=1e-6)


@pytest.mark.parametrize("kind", list(LENSES))
def test_slopes_and_terms_are_those_of_differences(kind: str) -> None:
    lens, terms = LENSES[kind], np.array([-0.06, 0.02, -0.004, 0.003, -0.002])
    x, y = np.random.default_rng(2).normal(0.0, 0.5, (2, 30))
    x[0] = y[0] = 1e-9  # on the axis

    def bent(terms: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return np.stack(lens.bent(terms, x, y, x * x + y * y))

    step = 1e-6
    by_x = (bent(terms, x + step, y) - bent(terms, x - step, y)) / (2.0 * step)
    by_y = (bent(terms, x, y + step) - bent(terms, x, y - step)) / (2.0 * step)
    slopes = lens.slopes(terms, x, y, x * x + y * y)
    assert np.stack(slopes) == pytest.approx(np.stack([by_x[0], by_x[1], by_y[1]]), abs=1e-7)
    assert by_y[0] == pytest.approx(by_x[1], abs=1e-7)
    for k, found in enumerate(lens.by_terms(x, y, x * x + y * y)):
        d = np.eye(5)[k]
        assert np.stack(found) == pytest.approx(bent(terms + d, x, y) - bent(terms, x, y), abs=1e-9)


@pytest.mark.parametrize("kind", list(LENSES))
def test_single_precision_is_the_same_lens(kind: str) -> None:
    x, y = np.random.default_rng(3).normal(0.0, 0.4, (2, 50)).astype(np.float32)
    terms = np.array([-0.06, 0.02, -0.004, 0.003, -0.002])
    single = LENSES[kind].bent(terms.astype(np.float32), x, y, x * x + y * y)
    double = LENSES[kind].bent(
        terms, x.astype(float), y.astype(float), x.astype(float) ** 2 + y.astype(float) ** 2
    )
    assert single[0].dtype == np.float32
    assert np.stack(single) == pytest.approx(np.stack(double), abs=1e-6)


def test_where_a_fisheye_is_no_lens_any_more() -> None:
    """It may not fold back (here at 0.79 rad) and ends at 86 degrees; an image turned keeps its even terms."""
    folding = replace(FISHEYE, k1=-0.6, k2=0.0, k3=0.0, focal_length_px=4000.0, width_px=9000)
    assert np.isnan(folding.image_from_camera([1.1, 0.0, -1.0])).all()
    assert folding.radius_limit == pytest.approx(np.tan(np.sqrt(1.0 / 1.8)), rel=1e-2)
    wide = replace(FISHEYE, focal_length_px=900.0)
    assert np.isnan(wide.image_from_camera([15.0, 0.0, -1.0])).all()
    assert np.isfinite(wide.ray_from_image(wide.corners_px)).all()
    even = replace(FISHEYE, p1=0.02, p2=-0.01)
    assert (even.turned(1).p1, even.turned(1).p2) == (0.02, -0.01)


def test_nothing_is_seen_behind_or_far_off_the_camera() -> None:
    barrel = Camera("barrel", 4000, 3000, 2000.0, 2000.0, 1500.0, k1=-0.3)
    assert np.isnan(barrel.image_from_camera([0.0, 0.0, 5.0])).all()
    assert np.isnan(barrel.image_from_camera([50.0, 0.0, -10.0])).all()


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("angle_rad", [0.0, 1e-9, 0.03, -0.5])
def test_vectors_turned_by_rotation_vectors(axis: int, angle_rad: float) -> None:
    vector = np.array([0.3, -2.0, 5.0])
    wanted = (about_x, about_y, about_z)[axis](angle_rad) @ vector
    assert np.stack(turned_by(angle_rad * np.eye(3)[axis], vector)) == pytest.approx(wanted, abs=1e-9)
    single = turned_by((angle_rad * np.eye(3)[axis]).astype(np.float32), vector.astype(np.float32))
    assert single[0].dtype == np.float32
    assert np.stack(single) == pytest.approx(wanted, abs=1e-5)


READ = Camera("read", 800, 600, 1000.0, 400.0, 300.0, readout_s=0.1)


def test_a_camera_that_turns_while_it_reads_by_hand() -> None:
    """A quarter of the readout before the middle row, at 0.4 rad/s: 0.01 rad the other way. Turning about y, the
    image's top, leaves its right side behind: a ray seen there pointed to the left of what it would."""
    rate = np.array([0.0, 0.4, 0.0])
    pose = Pose(np.zeros(3), Rotation(np.eye(3)), None, Turns(0.1, np.outer([-0.05, 0.05], rate)))
    ray = pose.ray_from_image(READ, [400.0, 150.0])
    assert ray == pytest.approx([np.sin(0.01), 0.15, -np.cos(0.01)], abs=1e-12)
    assert pose.image_from_ground(READ, 50.0 * ray) == pytest.approx([400.0, 150.0], abs=1e-6)
    about_view = Pose(
        np.zeros(3), Rotation(np.eye(3)), None, Turns(0.1, np.outer([-0.05, 0.05], [0.0, 0.0, 0.4]))
    )
    turned = about_view.ray_from_image(READ, [500.0, 150.0])
    assert turned == pytest.approx(
        [0.1 * np.cos(0.01) + 0.15 * np.sin(0.01), 0.15 * np.cos(0.01) - 0.1 * np.sin(0.01), -1.0]
    )


@given(st.floats(0.0, 800.0), st.floats(0.0, 600.0), st.integers(0, 99))
def test_turning_and_moving_there_and_back(col: float, row: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    turns = Turns(0.12, np.cumsum(rng.normal(0.0, 0.004, (9, 3)), axis=0))
    pose = Pose(
        np.array([3.0, -7.0, 90.0]),
        Rotation.from_yaw_pitch_roll(1.0, 0.1, -0.05),
        np.array([9.0, -4.0, 1.0]),
        turns,
    )
    point = pose.centre_at(READ, [col, row]) + 80.0 * pose.ray_from_image(READ, [col, row])
    assert pose.image_from_ground(READ, point) == pytest.approx([col, row], abs=1e-3)


def test_turns_of_an_image_turned_by_180_degrees() -> None:
    """The same rays for the same places of the sensor, whichever way up its image lies."""
    turns = Turns(0.1, np.array([[[-0.01, 0.02, -0.03], [0.01, -0.02, 0.03]]]))
    pose = Pose(np.zeros(3), Rotation.from_yaw_pitch_roll(0.3, 0.1, 0.0), None, turns[0])
    over = Pose(np.zeros(3), pose.rotation.turned(2), None, turns.turned([0], 2)[0])
    assert over.ray_from_image(READ.turned(2), [800.0 - 123.0, 600.0 - 45.0]) == pytest.approx(
        pose.ray_from_image(READ, [123.0, 45.0])
    )


@pytest.mark.parametrize(("quarters", "at"), [(1, [555.0, 123.0]), (2, [677.0, 555.0]), (3, [45.0, 677.0])])
def test_a_turned_image_shows_the_same_rays_at_other_places(quarters: int, at: list[float]) -> None:
    """Clockwise, by a lens that is neither even nor in the middle: where col 123, row 45 of 800 x 600 lies then."""
    lens = replace(READ, principal_col_px=411.0, principal_row_px=287.0, k1=-0.05, p1=0.002, p2=-0.003)
    pose, turned = (Rotation.from_yaw_pitch_roll(0.3, 0.1, -0.2).turned(q) for q in (0, quarters))
    rays = [Pose(np.zeros(3), r).ray_from_image(c, px) for r, c, px in
            ((pose, lens, [123.0, 45.0]), (turned, lens.turned(quarters), at))]  # fmt: skip
    assert rays[1] == pytest.approx(rays[0], abs=1e-9)


@pytest.mark.parametrize("quarters", [1, 2, 3])
def test_turns_of_a_turned_image_are_about_the_same_axes_in_space(quarters: int) -> None:
    rotation, turns = (
        Rotation.from_yaw_pitch_roll(0.3, 0.1, -0.2),
        Turns(0.1, np.array([[[-0.01, 0.02, -0.03]]])),
    )
    turned = turns.turned([0], quarters)
    assert rotation.turned(quarters).matrix @ turned.rad[0, 0] == pytest.approx(
        rotation.matrix @ turns.rad[0, 0], abs=1e-12
    )


def test_turns_over_another_span() -> None:
    turns = Turns(0.2, np.array([[-0.02, 0.0, 0.0], [0.0, 0.0, 0.0], [0.06, 0.0, 0.0]]))
    assert turns.at([-0.05, 0.05, 0.2])[0][:, 0] == pytest.approx([-0.01, 0.03, 0.12])
    assert turns.at([-0.05, 0.05])[1][:, 0] == pytest.approx([0.2, 0.6])
    assert turns.tabled(0.1, 5).rad[:, 0] == pytest.approx([-0.01, -0.005, 0.0, 0.015, 0.03])


@pytest.mark.parametrize(
    "camera",
    [
        Camera("k1 alone", 4000, 3000, 1900.0, 2000.0, 1500.0, k1=-0.15),
        Camera("decentred", 4000, 3000, 1900.0, 2000.0, 1500.0, k1=-0.15, p1=1e-3, p2=-5e-4),
        Camera("action camera", 4000, 3000, 1790.0, 2000.0, 1500.0, k1=-0.255, k2=0.067, k3=-0.0065),
        Camera("small", 640, 480, 400.0, 320.0, 240.0, k1=-0.33, k2=0.12, k3=-0.02),
    ],
    ids=lambda c: c.name,
)
def test_rays_of_wide_lenses_go_back_to_their_pixels(camera: Camera) -> None:
    """Also near the radius where such a lens ends, beyond which pixels have no ray."""
    col, row = np.meshgrid(np.linspace(2, camera.width_px - 2, 60), np.linspace(2, camera.height_px - 2, 50))
    px = np.stack([col, row], axis=-1)
    rays = camera.ray_from_image(px)
    inside = np.linalg.norm(rays[..., :2], axis=-1) < 0.98 * camera.radius_limit
    assert inside.mean() > 0.5
    assert np.abs(camera.image_from_camera(rays) - px)[inside].max() < 0.01
