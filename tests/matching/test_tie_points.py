"""Tie points in the pixels: where a window lies in another image, tracks and what stands for them, planes."""

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from geomosaic.camera.exterior import Poses
from geomosaic.camera.interior import Camera
from geomosaic.camera.rotation import Rotation
from geomosaic.matching.affine_matching import TEMPLATE_PX, find, templates
from geomosaic.matching.expected_overlap import ExpectedOverlap
from geomosaic.matching.model import TiePair, TiePairs, TiePoints
from geomosaic.matching.planes import SeenPlanes, guessed, stretched, through, unconstrained_guess
from geomosaic.matching.refinement import Refinement
from geomosaic.matching.tracks import join, join_tracks, references, thin_pairs
from geomosaic.pipeline.artefact_reader import decode
from geomosaic.pipeline.artefacts import encode
from geomosaic.projection.ground import GroundSurface


def land(col: np.ndarray, row: np.ndarray, seed: int) -> np.ndarray:
    """Grey levels of a smooth, rich, known surface at any places: 300 waves of 6 px and longer."""
    rng = np.random.default_rng(seed)
    out = np.full(col.shape, 128.0)
    for _ in range(300):
        angle, phase = rng.uniform(0, 2 * np.pi, 2)
        per_px = 2 * np.pi / rng.uniform(6.0, 60.0)
        out += 3.0 * np.cos(per_px * (np.cos(angle) * col + np.sin(angle) * row) + phase)
    return out


def image(affine: np.ndarray, seed: int, size: tuple[int, int] = (420, 400)) -> np.ndarray:
    """What a camera shows whose pixel (col, row), corner origin, is land's affine @ (col, row, 1)."""
    col, row = np.meshgrid(np.arange(size[0]) + 0.5, np.arange(size[1]) + 0.5)
    places = np.stack([col, row, np.ones_like(col)], axis=-1) @ affine.T
    return np.clip(np.rint(land(places[..., 0], places[..., 1], seed)), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.proof)])
def test_windows_are_found_to_a_fiftieth_of_a_pixel_turned_and_stretched(seed: int) -> None:
    """A quarter turn less 8 degrees, 12 % smaller, seen aslant, darker: places predicted 1.5 px off are found
    without bias, where the predicted shapes are 3 % off."""
    rng = np.random.default_rng(seed)
    c, s = np.cos(np.radians(82.0)), np.sin(np.radians(82.0))
    there = np.array([[1.12 * c, -1.12 * s, 330.0], [1.05 * s, 1.05 * c, -20.0]])
    left = image(np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]), seed)
    right = (0.8 * image(there, seed) + 20.0).astype(np.uint8)
    at = rng.uniform([60.0, 60.0], [360.0, 340.0], (400, 2))
    back = np.linalg.inv(there[:, :2])
    true = (at - there[:, 2]) @ back.T
    inside = np.all((true > 30.0) & (true < [390.0, 370.0]), axis=1)
    at, true = at[inside], true[inside]
    assert len(at) > 100
    reported = true + rng.uniform(-1.5, 1.5, true.shape)
    shapes = np.broadcast_to(back @ np.array([[1.03, 0.02], [-0.01, 0.98]]), (len(at), 2, 2))
    found = find(templates(left, at), right, reported, shapes)
    assert found.sure.mean() > 0.97
    off = (found.image_px - true)[found.sure]
    assert np.abs(off.mean(axis=0)).max() < 0.005
    assert np.sqrt((off**2).mean()) < 0.02
    assert np.abs(off).max() < 0.2


@pytest.mark.proof
def test_other_texture_is_never_sure_and_a_flat_window_says_nothing() -> None:
    unit = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    at = np.random.default_rng(5).uniform(40.0, 360.0, (300, 2))
    windows = templates(image(unit, 1), at)
    assert windows.shape == (300, TEMPLATE_PX, TEMPLATE_PX)
    shapes = np.broadcast_to(np.eye(2), (300, 2, 2))
    assert find(windows, image(unit, 9), at, shapes).sure.mean() < 0.01
    assert not find(np.full_like(windows, 90), image(unit, 1), at, shapes).sure.any()
    assert not find(windows, np.full((400, 420), 90, np.uint8), at, shapes).sure.any()
    assert find(windows[:0], image(unit, 1), at[:0], shapes[:0]).image_px.shape == (0, 2)


def test_windows_that_look_alike_by_less_than_four_fifths_are_not_sure() -> None:
    """Noise of nearly three times the contrast: four in ten settle, half a pixel off, and the likeness alone tells."""
    dull = 128.0 + 0.4 * (image(np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]), 1) - 128.0)
    noise = np.random.default_rng(9).normal(size=dull.shape)
    at = np.random.default_rng(8).uniform(60.0, 340.0, (200, 2))
    shapes, windows = np.broadcast_to(np.eye(2), (200, 2, 2)), templates(dull.astype(np.uint8), at)
    little, much = (
        find(windows, np.clip(dull + sd * noise, 0, 255).astype(np.uint8), at, shapes) for sd in (5.0, 40.0)
    )
    assert little.sure.mean() > 0.9 and much.sure.mean() < 0.02
    assert np.median(np.abs(much.image_px - at)) < 0.6, "they are found all the same"


def test_windows_that_lie_farther_than_four_pixels_are_not_sure() -> None:
    """On ground so smooth that they are led there from anywhere."""
    rough = np.random.default_rng(7).normal(size=(400, 420))
    smooth = cv2.normalize(cv2.GaussianBlur(rough, (0, 0), 8.0), None, 0, 255, cv2.NORM_MINMAX).astype(
        np.uint8
    )
    at = np.random.default_rng(8).uniform(60.0, 340.0, (200, 2))
    shapes, windows = np.broadcast_to(np.eye(2), (200, 2, 2)), templates(smooth, at)
    for aside_px, share in ((3.0, 0.9), (-3.0, 0.9), (5.0, 0.0), (-5.0, 0.0)):
        for aside in np.eye(2) * aside_px:
            sure = find(windows, smooth, at + aside, shapes).sure
            assert sure.mean() > share if share else not sure.any(), aside


def test_windows_do_not_depend_on_what_is_looked_for_with_them() -> None:
    unit = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    at = np.random.default_rng(6).uniform(40.0, 360.0, (600, 2))
    shapes, left = np.broadcast_to(np.eye(2), (600, 2, 2)), image(unit, 1)
    whole = find(templates(left, at), left, at + 0.7, shapes)
    part = find(templates(left, at[300:]), left, at[300:] + 0.7, shapes[300:])
    assert whole.image_px[300:] == pytest.approx(part.image_px, abs=1e-4)
    assert np.array_equal(whole.sure[300:], part.sure)


def pair(left: int, right: int, features: list[tuple[int, int]], shift: float = 0.0) -> TiePair:
    i, j = (np.array(side, np.int32) for side in zip(*features, strict=True))
    px = np.stack([10.0 * i + 100.0 * left, 5.0 * i], axis=1)
    other = np.stack([10.0 * j + 100.0 * right + shift, 5.0 * j], axis=1)
    return TiePair(left, right, px, other, i, j)


def test_keypoints_join_over_pairs_and_a_frame_seen_twice_is_reported() -> None:
    """Keypoint 1 of frame 0 is 4 of frame 1 is 7 of frame 2; 2 of frame 0 is 5 and, by frame 2, 6 of frame 1."""
    pairs = [pair(0, 1, [(1, 4), (2, 5)]), pair(1, 2, [(4, 7), (6, 8)]), pair(0, 2, [(2, 8)])]
    joined = join(pairs)
    assert len(joined.frame) == 7 and joined.track.max() == 1
    left, right = joined.ends[0]
    assert joined.track[left[0]] == joined.track[right[0]] == joined.track[joined.ends[1][1, 0]]
    assert joined.once[left[0]] and not joined.once[left[1]]
    assert joined.image_px[left].tolist() == [[10.0, 5.0], [20.0, 10.0]]
    assert joined.degree[joined.ends[1][0, 0]] == 2
    standing = references(joined, np.full((3, 2), [400.0, 100.0]))
    assert joined.frame[standing[left[0]]] == 1  # it stands in two tie points
    assert len(join([]).frame) == 0 and join([]).ends == ()


def test_pairs_by_keypoints_are_the_same_pairs_in_less_on_the_disk_and_as_old_recordings_have_them() -> None:
    pairs = tuple(pair(a, b, [(k, k + 1) for k in range(500)]) for a in range(6) for b in range(a + 1, 6))
    packed = TiePairs.of(pairs)
    assert len(encode(TiePoints(packed))) < 0.4 * len(encode(TiePoints(pairs)))
    for ties in (TiePoints(pairs), TiePoints(packed, ((0, 7),))):
        back = decode(encode(ties), TiePoints)
        assert encode(back) == encode(ties)
        for found, was in zip(back.pairs, pairs, strict=True):
            assert (found.left, found.right) == (was.left, was.right)
            assert np.array_equal(found.left_px, was.left_px) and np.array_equal(found.right_px, was.right_px)
            assert np.array_equal(np.diff(found.left_feature), np.diff(was.left_feature))
    assert TiePairs.of(packed) is packed and packed[-1].right == 5 and len(packed[2:4]) == 2
    some = packed.part(np.arange(packed.keypoints.shape[1]) % 500 < 3, packed.image_px + 1.0)
    assert [len(t) for t in some] == [3] * 15 and len(some.frame) < 6 * 5
    assert np.array_equal(some[4].right_px, pairs[4].right_px[:3] + 1.0)


@pytest.mark.parametrize(
    "spoil",
    [
        lambda t: replace(t, keypoints=t.keypoints + np.int32(1)),
        lambda t: replace(t, keypoints=-t.keypoints),
        lambda t: replace(t, keypoints=t.keypoints.astype(np.float64)),
        lambda t: replace(t, keypoints=t.keypoints[::-1]),
        lambda t: replace(t, keypoints=t.keypoints[:, 1:]),
        lambda t: replace(t, counts=t.counts[1:]),
        lambda t: replace(t, frames=t.frames[:, :1]),
        lambda t: replace(t, image_px=t.image_px[:, :1]),
    ],
)
def test_tie_points_of_what_is_not_there_are_no_tie_points(spoil: Callable[[TiePairs], TiePairs]) -> None:
    with pytest.raises(ValueError, match=r"tie points|pairs|keypoints"):
        spoil(TiePairs.of([pair(0, 1, [(1, 4), (2, 5)]), pair(1, 2, [(4, 7), (6, 8)])]))


def test_planes_of_untied_pairs_come_through_the_best_common_neighbour() -> None:
    """0 and 2 aren't tied: 1 shares 30 and 40 tie points with them, 3 shares 50 and 10 and says otherwise."""
    rng = np.random.default_rng(0)
    shift = {(0, 1): [300.0, 7.0], (1, 2): [290.0, -3.0], (0, 3): [10.0, 0.0], (2, 3): [0.0, 0.0]}
    count = {(0, 1): 30, (1, 2): 40, (0, 3): 50, (2, 3): 10}
    places = {pair: rng.uniform(0.0, 1000.0, (n, 2)) for pair, n in count.items()}
    planes = SeenPlanes(lambda a, b: (places[a, b], places[a, b] - shift[a, b]))
    for pair, n in count.items():
        planes.add(*pair, n)
    found = planes.between(0, 2)
    assert found is not None
    assert through(found, np.array([[700.0, 50.0]])) == pytest.approx(np.array([[110.0, 46.0]]), abs=1e-4)
    back = planes.between(2, 0)
    assert back is not None and (back @ found / (back @ found)[2, 2]) == pytest.approx(np.eye(3), abs=1e-6)
    assert planes.between(0, 4) is None
    sizes = [(1000, 800)] * 5
    guess = planes.guess(0, 2, sizes)
    assert guess is not None and guess.corners_px[0] == (-592.0, 0.0) and guess.radius_px == 64.0
    assert planes.guess(0, 4, sizes) is None
    assert planes.guess(0, 2, [(500, 800)] * 5) is None  # they share no ground


@settings(deadline=None, max_examples=40)
@given(st.floats(-0.0004, 0.0004), st.floats(-0.0004, 0.0004), st.floats(-0.5, 0.5))
def test_how_a_plane_stretches_is_its_derivative(g: float, h: float, turn: float) -> None:
    plane = np.array([[1.1, turn, 40.0], [-turn, 0.9, -30.0], [g, h, 1.0]])
    px = np.array([[100.0, 250.0], [640.0, 30.0]])
    for axis in (0, 1):
        step = np.eye(2)[axis] * 0.01
        slope = (through(plane, px + step) - through(plane, px - step)) / 0.02
        assert stretched(plane, px)[:, :, axis] == pytest.approx(slope, abs=1e-5)


def test_a_guess_beyond_the_horizon_is_none() -> None:
    aslant = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, -0.002, 1.0]])
    assert guessed((1000, 800), aslant, 100.0) == unconstrained_guess((1000, 800))
    assert guessed((1000, 400), aslant, 100.0).radius_px == 112.0
    assert guessed((1000, 800), None, 100.0) == unconstrained_guess((1000, 800))


def test_poses_say_where_pairs_match_and_another_origin_changes_nothing() -> None:
    """Two frames 100 m above flat ground, 30 m apart to the east, tops to the north. What the left one shows
    in its middle lies 300 px to the left in the right one. A work frame moved by 3 m says the same."""
    camera = Camera("c", 1000, 800, 1000.0, 500.0, 400.0)
    ground = GroundSurface("flat", -1000.0, -1000.0, 2000.0, np.zeros((2, 2)))
    said = []
    for origin in (0.0, 3.0):
        at = np.array([[origin, 0.0, 100.0], [origin + 30.0, 0.0, 100.0]])
        poses = Poses(
            at, Rotation.from_yaw_pitch_roll(*np.zeros((3, 2))).matrix, np.ones((2, 3)), np.ones((2, 3))
        )
        predicted = ExpectedOverlap.of(poses, [camera, camera], ground)
        said.append(predicted.guess(0, 1, 250.0))
        assert np.isinf(predicted.guess(0, 1, np.inf).radius_px)
    assert said[0] == said[1]
    assert said[0].corners_px == ((-304.0, 0.0), (704.0, 0.0), (704.0, 800.0), (-304.0, 800.0))
    assert said[0].radius_px == 256.0


def test_tie_points_move_and_stay_one_place_a_track_and_a_pair_that_would_be_lost_keeps_its_own() -> None:
    rng = np.random.default_rng(1)
    sizes = [(1000, 800)] * 3
    px = rng.uniform([450.0, 50.0], [650.0, 750.0], (40, 2))
    off = [np.array([0.0, 0.0]), np.array([300.0, 5.0]), np.array([-200.0, -9.0])]
    numbers = np.arange(40, dtype=np.int32)
    pairs = [TiePair(a, b, px - off[a], px - off[b], numbers, numbers) for a, b in ((0, 1), (1, 2), (0, 2))]
    todo = Refinement.of(pairs, sizes)
    assert sum(map(len, todo.shown)) == 40
    assert sorted(k for of in todo.sought for s in of for k in s.keypoints) == sorted(
        set(range(120)) - set(np.concatenate(todo.shown).tolist())
    )
    for sought in todo.sought:
        for s in sought:
            assert s.shapes == pytest.approx(np.broadcast_to(np.eye(2), s.shapes.shape), abs=1e-6)
    found = {}
    for frame, sought in enumerate(todo.sought):
        if sought:
            keypoints = np.concatenate([s.keypoints for s in sought])
            found[frame] = todo.joined.image_px[keypoints] + [0.25, -0.5], np.full(len(keypoints), frame != 2)
    out = {(t.left, t.right): t for t in todo.applied(found, 8)}
    assert {len(t) for t in out.values()} <= set(range(8, 41))
    moved = {}
    for t in out.values():
        for frame, keypoints, places in (
            (t.left, t.left_feature, t.left_px),
            (t.right, t.right_feature, t.right_px),
        ):
            for k, place in zip(keypoints, places, strict=True):
                assert moved.setdefault((frame, int(k)), tuple(place)) == tuple(place)
    all_lost = {i: (p, np.zeros_like(good)) for i, (p, good) in found.items()}
    for before, after in zip(pairs, todo.applied(all_lost, 8), strict=True):
        assert np.array_equal(after.left_px, before.left_px) and len(after) == 40


def test_a_step_goes_the_way_the_image_moved() -> None:
    """What lies at (c, r) in the left image lies at (c + 2.25, r - 1.5) in the right one."""
    left = image(np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]), 8)
    right = image(np.array([[1.0, 0.0, -2.25], [0.0, 1.0, 1.5]]), 8)
    at = np.random.default_rng(8).uniform(40.0, 360.0, (50, 2))
    found = find(templates(left, at), right, at, np.broadcast_to(np.eye(2), (50, 2, 2)))
    assert found.sure.all()
    assert (found.image_px - at).mean(axis=0) == pytest.approx([2.25, -1.5], abs=0.005)


def chain(frames: int, points: int, seed: int) -> TiePairs:
    """Each place on the ground seen in two to six frames one after the other, tied with the next ones."""
    rng = np.random.default_rng(seed)
    first, length = rng.integers(0, frames - 6, points), rng.integers(2, 7, points)
    pairs = []
    for left in range(frames - 1):
        mine = np.flatnonzero((first <= left) & (left + 1 < first + length)).astype(np.int32)
        at = np.stack([100.0 + 37.0 * mine % 600, 53.0 * mine % 400], axis=1)
        pairs.append(TiePair(left, left + 1, at, at, mine, mine))
    return TiePairs.of([pair for pair in pairs if len(pair)])


def test_a_large_block_keeps_its_longest_tracks_and_all_its_pairs() -> None:
    pairs = chain(40, 30_000, 3)
    sizes_px = np.tile([700.0, 400.0], (40, 1))
    thin = thin_pairs(pairs, sizes_px, 16, 40_000)
    assert len(pairs.frame) > 100_000
    assert 20_000 < len(thin.frame) < 60_000
    assert [tuple(f) for f in thin.frames] == [tuple(f) for f in pairs.frames]
    before, after = (np.bincount(join_tracks(TiePoints(its)).lengths, minlength=7) for its in (pairs, thin))
    assert (np.diff(after[2:] / before[2:]) >= 0.0).all()
    assert after[6] > 0.9 * before[6] > 4.0 * after[2]
    assert thin_pairs(pairs, sizes_px, 16, len(pairs.frame)) is pairs


def test_a_pair_with_few_tie_points_keeps_them() -> None:
    few = np.arange(20, dtype=np.int32)
    at = np.tile([[5.0, 5.0]], (20, 1))  # all in one cell, where others are longer
    pairs = [*chain(40, 30_000, 4), TiePair(0, 39, at, at, few + 40_000, few + 40_000)]
    thin = thin_pairs(TiePairs.of(pairs), np.tile([700.0, 400.0], (40, 1)), 16, 40_000)
    counts = dict(zip(map(tuple, thin.frames.tolist()), thin.counts.tolist(), strict=True))
    assert counts[0, 39] == 20
