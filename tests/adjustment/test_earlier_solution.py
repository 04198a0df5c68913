"""An adjustment that begins from the solution of an earlier run ends where a whole one does."""

import io
import zipfile
from dataclasses import replace

import numpy as np
import pytest
from adjustment_blocks import Flown, fly

from geomosaic.adjustment.methods import METHODS
from geomosaic.adjustment.model import Adjusted, Block, Settings, SolvedBlock
from geomosaic.adjustment.procedure.block_part import part_of_block
from geomosaic.adjustment.procedure.earlier_solution import EARLIER
from geomosaic.camera.rotation import about_z
from geomosaic.matching.model import TiePoints
from geomosaic.pipeline.artefact_reader import decode
from geomosaic.pipeline.artefacts import TIMELESS, TREE, encode

BUNDLE = METHODS["bundle"]


@pytest.fixture(scope="module")
def flown() -> Flown:
    return fly(4)


@pytest.fixture(scope="module")
def earlier(flown: Flown) -> SolvedBlock:
    """Of the first two of three lines."""
    solved = BUNDLE(part_of_block(flown.block, np.arange(12)), Settings(model="given")).solved
    assert solved is not None
    return solved


@pytest.fixture(scope="module")
def whole(flown: Flown) -> Adjusted:
    return BUNDLE(flown.block, Settings(model="given"))


def begun(adjusted: Adjusted) -> bool:
    return any(step.solve == EARLIER for step in adjusted.steps)


def off_px(one: Adjusted, other: Adjusted) -> float:
    """Most that frames lie apart, in ground pixels of 0.1 m."""
    return float(np.abs(one.poses.positions_m - other.poses.positions_m).max() / 0.1)


def test_a_line_more(flown: Flown, earlier: SolvedBlock, whole: Adjusted) -> None:
    """New frames have no earlier pose; all end within a tenth of a pixel of a whole solution."""
    found = BUNDLE(replace(flown.block, earlier=earlier), Settings(model="given"))
    assert begun(found)
    assert not begun(whole)
    assert off_px(found, whole) < 0.1
    assert found.status == whole.status
    assert found.poses.positions_sd_m == pytest.approx(whole.poses.positions_sd_m, rel=0.01)
    assert len(found.steps) < len(whole.steps)
    assert found.solved is not None and found.solved.names == flown.block.names


def test_frames_removed(flown: Flown, whole: Adjusted) -> None:
    """Of a solution of all, those frames that are left."""
    left = part_of_block(flown.block, np.arange(6, 18))
    found = BUNDLE(replace(left, earlier=whole.solved), Settings(model="given"))
    assert begun(found)
    assert off_px(found, BUNDLE(left, Settings(model="given"))) < 0.1


def test_a_model_that_fits_no_more(flown: Flown, earlier: SolvedBlock, whole: Adjusted) -> None:
    """Images that fit worse than they did: the whole procedure, to the same bytes."""
    better = {**earlier.components, "image": earlier.components["image"] / 1.2}
    found = BUNDLE(replace(flown.block, earlier=replace(earlier, components=better)), Settings(model="given"))
    assert not begun(found)
    assert found.poses.positions_m.tobytes() == whole.poses.positions_m.tobytes()


def blurred(block: Block) -> Block:
    """Every third frame's keypoints are off by 0.5 px, the others' by 0.1 px, as where some are blurred."""
    rng = np.random.default_rng(5)
    off_px = rng.normal(0.0, 1.0, (len(block.names), 20_000, 2))
    off_px *= np.where(np.arange(len(block.names)) % 3 == 2, 0.5, 0.1)[:, None, None]
    pairs = [
        replace(
            pair,
            left_px=pair.left_px + off_px[pair.left, pair.left_feature],
            right_px=pair.right_px + off_px[pair.right, pair.right_feature],
        )
        for pair in block.ties.pairs
    ]
    return replace(block, ties=TiePoints(tuple(pairs)))


def test_frames_differ_in_how_well_a_model_explains_them(flown: Flown) -> None:
    """New frames more blurred than most contradict no model: 15 % more variance, as in a real flight."""
    block = blurred(flown.block)
    before = BUNDLE(part_of_block(block, np.arange(11)), Settings(model="given")).solved
    found = BUNDLE(replace(block, earlier=before), Settings(model="given"))
    assert before is not None and found.solved is not None
    assert (found.solved.components["image"] / before.components["image"]) ** 2 > 1.05
    assert begun(found)


def test_few_frames_are_known(flown: Flown, earlier: SolvedBlock, whole: Adjusted) -> None:
    found = BUNDLE(replace(flown.block, earlier=earlier.of(flown.block.names[:4])), Settings(model="given"))
    assert not begun(found)
    assert found.poses.positions_m.tobytes() == whole.poses.positions_m.tobytes()


def test_another_work_frame(earlier: SolvedBlock) -> None:
    """A turn and a shift of the axes; images of the frames stay."""
    moved = earlier.moved(about_z(np.array(0.1)), np.array([3.0, -2.0, 1.0]))
    apart = np.linalg.norm(np.diff(moved.positions_m, axis=0), axis=1)
    assert apart == pytest.approx(np.linalg.norm(np.diff(earlier.positions_m, axis=0), axis=1))
    there = np.array([5.0, 7.0, 0.0])
    seen = (there - earlier.positions_m[3]) @ earlier.rotations[3]
    now = about_z(np.array(0.1)) @ there + [3.0, -2.0, 1.0]
    assert (now - moved.positions_m[3]) @ moved.rotations[3] == pytest.approx(seen)


def test_a_solution_of_an_earlier_version_is_read(earlier: SolvedBlock) -> None:
    """Its rotation while rows are read had another name, as field and as variance component."""
    solved = replace(earlier, components={"image": 0.3, "rotation term 1": 0.5})
    present = {"rotation_terms_rad": "swing_rad", "rotation term 1": "swing 1"}
    former = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(encode(solved))) as now, zipfile.ZipFile(former, "w") as then:
        for name in now.namelist():
            member = now.read(name)
            for new, old in present.items() if name == TREE else ():
                assert new.encode() in member
                member = member.replace(new.encode(), old.encode())
            then.writestr(zipfile.ZipInfo(name, TIMELESS), member)
    read = decode(former.getvalue(), SolvedBlock)
    assert read.components == solved.components
    assert (read.rotation_terms_rad == solved.rotation_terms_rad).all()
