"""The changed part of a block, solved between earlier poses that stay, ends where a whole adjustment does."""

from dataclasses import replace

import numpy as np
import pytest
from adjustment_blocks import Flown, fly

from geomosaic.adjustment.methods import METHODS
from geomosaic.adjustment.model import Adjusted, Block, Settings
from geomosaic.adjustment.procedure.block_part import part_of_block
from geomosaic.adjustment.procedure.changed_part import (
    SHIFT,
    EarlierBlock,
    changed_frames,
    whole_block_shift_m,
)
from geomosaic.adjustment.procedure.local_adjustment import adjusted_in_part, kept_poses

BUNDLE = METHODS["bundle"]
PIXEL_M = 0.1


@pytest.fixture(scope="module")
def flown() -> Flown:
    return fly(4, per_line=8, position_sd_m=np.array([0.02, 0.02, 0.03]))


def of_earlier(block: Block, bound_m: float = 0.2 * PIXEL_M, without: tuple[str, ...] = ()) -> EarlierBlock:
    """A block as an earlier run left it; frames in `without` are replaced by others of the same name."""
    adjusted = BUNDLE(block, Settings())
    unchanged = frozenset(block.names) - frozenset(without)
    return EarlierBlock(block.names, block.poses, block.ties, adjusted, unchanged, bound_m, block.ground)


@pytest.fixture(scope="module")
def whole(flown: Flown) -> Adjusted:
    return BUNDLE(flown.block, Settings())


def off_px(one: Adjusted, other: Adjusted) -> float:
    """Most that frames lie apart in plan, in ground pixels."""
    return float(np.abs(one.poses.positions_m - other.poses.positions_m)[:, :2].max() / PIXEL_M)


def test_frames_added(flown: Flown, whole: Adjusted) -> None:
    """Two frames more at the end of the last line: frames far from them keep their poses, bit by bit."""
    earlier = of_earlier(part_of_block(flown.block, np.arange(22)))
    found = adjusted_in_part(flown.block, earlier)
    assert found is not None
    kept = kept_poses(found, earlier)
    assert kept.any() and not kept[22:].any()
    assert off_px(found, whole) < 0.1
    assert found.status == whole.status
    assert found.solved is not None and found.solved.names == flown.block.names
    assert len(found.residuals_m) == len(whole.residuals_m)
    assert whole.image_residuals is not None and found.image_residuals is not None
    assert set(found.image_residuals.frame.tolist()) == set(whole.image_residuals.frame.tolist())
    assert found.poses.positions_sd_m == pytest.approx(whole.poses.positions_sd_m, rel=0.5)


def test_a_frame_removed(flown: Flown, whole: Adjusted) -> None:
    """Its neighbours are solved again."""
    left = part_of_block(flown.block, np.arange(1, 24))
    earlier = of_earlier(flown.block)
    was, changed = changed_frames(left, earlier)
    assert was.tolist() == list(range(1, 24))
    assert changed.any() and not changed.all()
    found = adjusted_in_part(left, earlier)
    assert found is not None
    assert off_px(found, BUNDLE(left, Settings())) < 0.1


def test_a_frame_replaced(flown: Flown, whole: Adjusted) -> None:
    """One by another file of the same name counts as new."""
    earlier = of_earlier(flown.block, without=(flown.block.names[-1],))
    found = adjusted_in_part(flown.block, earlier)
    assert found is not None
    assert changed_frames(flown.block, earlier)[1].tolist() == [False] * 23 + [True]
    assert off_px(found, whole) < 0.1


def test_nothing_changed(flown: Flown) -> None:
    earlier = of_earlier(flown.block)
    found = adjusted_in_part(flown.block, earlier)
    assert found is not None
    assert found.poses.positions_m.tobytes() == earlier.adjusted.poses.positions_m.tobytes()


def test_a_whole_adjustment_is_needed(flown: Flown) -> None:
    """Positions that move the whole block, most frames new."""
    before = part_of_block(flown.block, np.arange(22))
    earlier = of_earlier(before)
    assert adjusted_in_part(flown.block, replace(earlier, unchanged=frozenset(before.names[:4]))) is None
    far = flown.block.poses.positions_m.copy()
    far[22:] += [3.0, 0.0, 0.0]
    moved = replace(flown.block, poses=replace(flown.block.poses, positions_m=far))
    assert adjusted_in_part(moved, earlier) is None


def test_corrected_positions_move_the_block(flown: Flown) -> None:
    """Three of 24 are reported 3 m farther east. The fit to all would move every frame by decimetres."""
    poses = flown.block.poses
    block = replace(flown.block, poses=replace(poses, positions_sd_m=np.full_like(poses.positions_sd_m, 1.0)))
    earlier = of_earlier(block, bound_m=0.05)
    corrected = poses.positions_m.copy()
    corrected[20:23, 0] += 3.0
    moved = replace(block, poses=replace(block.poses, positions_m=corrected))
    assert whole_block_shift_m(block, (earlier.adjusted.poses, np.arange(24)), earlier) == pytest.approx(
        0.0, abs=1e-9
    )
    assert whole_block_shift_m(moved, (earlier.adjusted.poses, np.arange(24)), earlier) > 0.3
    assert adjusted_in_part(moved, earlier) is None


def test_small_steps_add_up(flown: Flown) -> None:
    """What each run leaves undone counts for the next; a whole adjustment begins anew."""
    earlier = of_earlier(part_of_block(flown.block, np.arange(22)))
    found = adjusted_in_part(flown.block, earlier)
    most_m = earlier.datum_sd_m
    assert found is not None and 0.0 < found.figures[SHIFT] < most_m
    left = 1.5 * found.figures[SHIFT]
    figures = earlier.adjusted.figures | {SHIFT: most_m - left}
    again = replace(earlier, adjusted=replace(earlier.adjusted, figures=figures))
    found = adjusted_in_part(flown.block, again)
    assert found is not None and found.figures[SHIFT] > most_m - left
    figures |= {SHIFT: most_m - left / 2.0}
    again = replace(earlier, adjusted=replace(earlier.adjusted, figures=figures))
    assert adjusted_in_part(flown.block, again) is None
    assert SHIFT not in BUNDLE(flown.block, Settings()).figures


def over_similarity_m(one: Adjusted, other: Adjusted) -> np.ndarray:
    """How far frames lie apart in plan, (n,), once one block is shifted, turned and scaled onto the other."""
    here, there = (a.poses.positions_m[:, :2] @ [1.0, 1.0j] for a in (one, other))
    design = np.column_stack([here, np.ones(len(here))])
    return np.abs(design @ np.linalg.lstsq(design, there, rcond=None)[0] - there)


def test_a_map_placed_by_gnss_stays_where_it_is() -> None:
    """New positions with errors of metres move a whole block by decimetres, which is less than it is known to.
    But for that the part comes within the bound of a whole adjustment."""
    flown = fly(4, per_line=8)
    earlier = of_earlier(part_of_block(flown.block, np.arange(22)))
    found, whole = adjusted_in_part(flown.block, earlier), BUNDLE(flown.block, Settings())
    assert found is not None
    assert earlier.bound_m < found.figures[SHIFT] < earlier.datum_sd_m
    assert off_px(found, whole) > 0.3
    assert np.sqrt((over_similarity_m(found, whole) ** 2).mean()) < earlier.bound_m
    kept = kept_poses(found, earlier)
    assert kept.sum() > 12 and not kept[22:].any()


@pytest.mark.parametrize(
    ("readout_s", "rate_sd"),
    [(0.03, 0.0), pytest.param(0.1, 0.2, marks=pytest.mark.proof)],
)
def test_frames_with_rolling_shutters_turn_as_before(readout_s: float, rate_sd: float) -> None:
    """Earlier frames keep how they moved and turned while their rows were read; new ones are solved."""
    flown = fly(
        4, lines=4, per_line=8, points=1200, readout_s=readout_s, rate_sd_rad_per_s=rate_sd,
        position_sd_m=np.array([0.02, 0.02, 0.03]),
    )  # fmt: skip
    earlier = of_earlier(part_of_block(flown.block, np.arange(30)))
    found, whole = adjusted_in_part(flown.block, earlier), BUNDLE(flown.block, Settings())
    assert found is not None
    assert kept_poses(found, earlier).sum() >= 16
    assert off_px(found, whole) < 0.1
    turns, of_whole, before = found.poses.turns, whole.poses.turns, earlier.adjusted.poses.turns
    assert turns is not None and of_whole is not None and before is not None
    assert turns.rad[:30] == pytest.approx(before.rad)
    ends = np.s_[:, [0, -1]]
    assert turns.rad[ends] == pytest.approx(of_whole.rad[ends], abs=max(1e-5, 0.05 * rate_sd * readout_s))
    assert found.poses.velocities_m_per_s == pytest.approx(whole.poses.velocities_m_per_s, abs=0.15)
    assert found.solved is not None and earlier.adjusted.solved is not None
    assert (found.solved.rotation_terms_rad[:30] == earlier.adjusted.solved.rotation_terms_rad).all()


def test_a_new_flight_has_an_offset_of_its_own() -> None:
    """All positions of the last line are off by 4 m in common. Its frames come where the images put them, and
    those of the flights before stay."""
    flown, line = fly(4, lines=9, per_line=5, points=2000), np.arange(45) // 5
    poses = flown.block.poses
    off_m = poses.positions_m + (line == 8)[:, None] * [4.0, 0.0, 0.0]
    flights = tuple(np.array([0, 0, 0, 0, 1, 1, 1, 1, 2])[line].tolist())
    block = replace(flown.block, poses=replace(poses, positions_m=off_m), flights=flights)
    earlier = of_earlier(part_of_block(block, np.arange(40)))
    found = adjusted_in_part(block, earlier)
    assert found is not None
    assert kept_poses(found, earlier).sum() >= 20
    east_m = (found.poses.positions_m - flown.truth.positions_m)[:, 0]
    assert east_m[line == 8].mean() - east_m[line == 7].mean() == pytest.approx(0.0, abs=0.3)


def test_another_dem_needs_a_whole_adjustment(flown: Flown) -> None:
    """One of other heights, or that shows more land: part of a block keeps the ground of before."""
    ground = replace(flown.block.ground, kind="dem")
    block = replace(flown.block, ground=ground)
    earlier = of_earlier(part_of_block(block, np.arange(22)))
    assert adjusted_in_part(block, earlier) is not None
    for other in (replace(ground, up_m=ground.up_m + 1.0), replace(ground, east_0_m=ground.east_0_m - 5.0)):
        assert adjusted_in_part(replace(block, ground=other), earlier) is None
