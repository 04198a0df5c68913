"""The order of the worst frames and pairs."""

from __future__ import annotations

import numpy as np

from geomosaic.quality.ranking import headings_off_deg, worst_frames, worst_pairs, wrong_headings


def test_untied_frames_come_first_then_wrong_tags_then_moves() -> None:
    moved = [1.0, 9.0, np.nan, 2.0, 2.0]
    assert worst_frames([0, 0, 1, 0, 0], [0, 0, 0, 1, 0], moved, [0.0, 0.0, 0.0, 0.0, 5.0]) == [2, 3, 1, 4, 0]
    assert worst_frames([], [], [], []) == worst_pairs([]) == []
    assert worst_frames([0, 0], [0, 0], [3.0, 3.0], [1.0, -4.0]) == [1, 0]


def test_pairs_by_their_residuals_and_unknown_ones_last() -> None:
    assert worst_pairs([0.1, np.nan, 0.3, 0.2]) == [2, 3, 0, 1]
    assert worst_pairs([0.1, np.nan, 0.3, 0.2], 2) == [2, 3]


def test_a_heading_is_wrong_beyond_four_deviations_and_eight_degrees() -> None:
    off = headings_off_deg(np.array([350.0, 10.0, 0.0, 0.0, 0.0]), np.array([1.0, 3.0, 11.0, 15.0, 179.0]))
    np.testing.assert_allclose(off, [11.0, -7.0, 11.0, 15.0, 179.0])
    assert wrong_headings(off, np.array([np.nan, 1.0, 3.0, 3.0, 1e3])).tolist() == [
        True,
        False,
        False,
        True,
        False,
    ]
