"""Weights, the walk over the windows, and the memory of decoded frames."""

from __future__ import annotations

import itertools
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from geomosaic.mosaic.frames import Decoded, DecodedFrames
from geomosaic.mosaic.model import OutputGrid
from geomosaic.mosaic.plan import windows
from geomosaic.mosaic.seams import can_matter, nearest_nadir

distances = arrays(np.float32, (4, 3, 3), elements=st.floats(0.0, 100.0, width=32))
insides = arrays(np.float32, (4, 3, 3), elements=st.floats(0.0, 1.0, width=32))


def weights_at(distance: list[float], inside: list[float], feather_m: float) -> list[float]:
    shape = (len(distance), 1, 1)
    given = [np.array(a, dtype=np.float32).reshape(shape) for a in (distance, inside)]
    return nearest_nadir(*given, feather_m).ravel().tolist()


def test_nearest_nadir_by_hand():
    assert weights_at([10.0, 14.0], [1.0, 1.0], 2.0) == [1.0, 0.0]
    assert weights_at([10.0, 10.0], [1.0, 1.0], 2.0) == [0.5, 0.5]
    assert weights_at([10.0, 11.0], [1.0, 1.0], 2.0) == [0.75, 0.25]
    # The nearer frame is near its edge: a quarter inside, it leaves three quarters to the next.
    assert weights_at([10.0, 50.0], [0.25, 1.0], 2.0) == [0.25, 0.75]
    # It has a mere rim, and nobody else is there.
    assert weights_at([10.0, 50.0], [0.01, 0.0], 2.0) == [1.0, 0.0]
    assert weights_at([10.0, 50.0], [0.0, 0.0], 2.0) == [0.0, 0.0]
    assert weights_at([10.0, 10.1, 60.0], [1.0, 1.0, 1.0], 0.0) == [1.0, 0.0, 0.0]


@given(distances, insides, st.floats(0.01, 50.0))
def test_weights_sum_to_one_where_any_frame_is_valid(distance, inside, feather_m):
    weights = nearest_nadir(distance, inside, feather_m)
    assert (weights >= 0.0).all()
    assert (weights[inside == 0.0] == 0.0).all()
    total = weights.sum(axis=0)
    np.testing.assert_allclose(total[(inside > 1e-30).any(axis=0)], 1.0, atol=1e-5)


@given(distances, insides, st.floats(0.5, 50.0), st.floats(0.0, 10.0))
def test_a_frame_ruled_out_has_no_weight_anywhere_in_its_cell(distance, inside, feather_m, change_m):
    """Distances within a cell differ from its middle's by up to `change_m`, either way."""
    matters = can_matter(distance, inside > 0.0, inside == 1.0, feather_m + 2.0 * change_m + 1e-3)
    for sign in (-1.0, 1.0):
        moved = distance + np.float32(sign * change_m) * np.where(np.arange(4) % 2, 1, -1)[:, None, None]
        weights = nearest_nadir(moved.astype(np.float32), inside, feather_m)
        assert (weights[~matters] <= 1e-6).all()


def test_windows_cover_the_grid_once_and_walk_from_neighbour_to_neighbour():
    grid = OutputGrid("EPSG:32632", 0.0, 0.0, 1.0, 1000, 1900)
    seen = np.zeros((1900, 1000), dtype=int)
    walk = windows(grid, 128)
    for w in walk:
        seen[w.row : w.row + w.height, w.col : w.col + w.width] += 1
    assert (seen == 1).all()
    steps = [abs(a.col - b.col) + abs(a.row - b.row) for a, b in itertools.pairwise(walk)]
    assert np.mean([s == 128 for s in steps]) > 0.85


def decodes(plan: list[list[int]], room: int) -> tuple[int, list[int]]:
    order: list[int] = []

    def decode(frame: int) -> Decoded:
        order.append(frame)
        return Decoded(np.zeros((1, 1, 1)), None)

    with ThreadPoolExecutor(1) as pool:
        frames = DecodedFrames(plan, dict.fromkeys(range(9), 10), 10 * room, pool, decode)
        for step, needed in enumerate(plan):
            assert set(frames.for_step(step)) == set(needed)
    return frames.decodes, order


def test_the_frame_needed_last_is_forgotten_first():
    """With room for two: at frame 2's turn, 1 is needed later than 0, so 0 stays."""
    assert decodes([[0], [1], [2], [0], [1]], room=2) == (4, [0, 1, 2, 1])
    assert decodes([[0], [1], [2], [0], [1]], room=3) == (3, [0, 1, 2])


def test_a_step_larger_than_the_memory_still_gets_its_frames():
    count, _ = decodes([[0, 1, 2], [3], [0, 1, 2]], room=1)
    assert count == pytest.approx(7)
