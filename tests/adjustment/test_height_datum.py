"""Heights that drift bend no block, and what all heights may be off in common is stated."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from adjustment_blocks import fly
from geoids import egm96_of, undulation_m
from survey_files import survey_folder

from geomosaic.adjustment.methods import METHODS
from geomosaic.adjustment.model import Block, GroundControl, Settings
from geomosaic.adjustment.procedure.common_offsets import common_error, with_common_error
from geomosaic.adjustment.terms.gnss_positions import HORIZONTAL, VERTICAL
from geomosaic.adjustment.terms.term import Components
from geomosaic.camera.exterior import Poses
from geomosaic.geodesy.local import LocalFrame
from geomosaic.matching.model import TiePoints
from geomosaic.projection.ground import GroundSurface
from geomosaic.quality.control import control_warnings
from geomosaic.survey.height_reference import HeightReference, height_reference
from geomosaic.survey.inputs import SurveyInputs
from geomosaic.survey.model import Survey
from geomosaic.survey.read import read_survey

SEA_LEVEL_M = 48.582
"""EGM96 above the ellipsoid at the surveys' place."""


@pytest.mark.parametrize("batteries", [pytest.param(False, marks=pytest.mark.proof), True])
def test_heights_that_drift_by_twice_the_flying_height(batteries: bool) -> None:
    """100 m above the ground; no attitude. The positions in plan give the scale, to half a per cent here."""
    flown = fly(7, lines=2, per_line=4, points=250)
    n, poses = 8, flown.block.poses
    drift = np.where(np.arange(n) < 4, 0.0, 120.0) if batteries else np.linspace(0.0, 200.0, n)
    at = np.column_stack([poses.positions_m[:, :2], flown.truth.positions_m[:, 2] + drift])
    unknown = replace(
        poses,
        positions_m=at,
        rotations=np.tile(np.eye(3), (n, 1, 1)),
        positions_sd_m=np.tile([5.0, 5.0, 15.0], (n, 1)),
        rotations_sd_rad=np.radians(np.tile([10.0, 10.0, 180.0], (n, 1))),
    )
    adjusted = METHODS["bundle"](replace(flown.block, poses=unknown), Settings(model="given"))
    (warning,) = [w for w in adjusted.warnings if w.code == "heights-drift"]
    reported = (
        ("jump by +120", "between 003.jpg and 004.jpg") if batteries else ("drift by +200", "to 007.jpg")
    )
    assert all(words in warning.text for words in reported)
    off = adjusted.poses.positions_m - flown.truth.positions_m
    assert off[:, 2].std() < 0.2
    z, w = (p.positions_m[:, :2] @ [1, 1j] for p in (adjusted.poses, flown.truth))
    turn = ((w - w.mean()) * (z - z.mean()).conj()).sum() / (np.abs(z - z.mean()) ** 2).sum()
    assert abs(turn) == pytest.approx(1.0, abs=0.05)


@pytest.fixture
def survey(tmp_path: Path) -> Survey:
    return read_survey(SurveyInputs(survey_folder(tmp_path, 6)))


def test_a_survey_has_no_deviation_that_is_no_number(survey: Survey) -> None:
    """A replay fell where frames' reach was drawn. Found by `make fuzz`, seed 922, case 3535."""
    first, *others = survey.frames
    for wrong in (
        replace(first, attitude=replace(first.attitude, sd_tilt_deg=float("nan"))),
        replace(first, position=replace(first.position, sd_north_m=float("nan"))),
    ):
        with pytest.raises(ValueError, match="deviation"):
            replace(survey, frames=(wrong, *others))


def block_of(survey: Survey) -> Block:
    n = len(survey.frames)
    lonlat = np.array([[f.position.lon_deg, f.position.lat_deg] for f in survey.frames])
    heights = np.array([f.position.height_ellipsoidal_m for f in survey.frames], dtype=float)
    poses = Poses(
        survey.work_frame.enu_from_geodetic(*lonlat.T, heights),
        np.tile(np.eye(3), (n, 1, 1)), np.full((n, 3), 0.2), np.full((n, 3), 0.01),
    )  # fmt: skip
    flat = GroundSurface("flat", 0.0, 0.0, 1.0, np.zeros((1, 1)))
    names, cameras = tuple(f.name for f in survey.frames), tuple(survey.camera_of(i) for i in range(n))
    return Block(
        names, cameras, poses, flat, TiePoints(()), tuple(range(n)), (0,) * n, 0.1,
        heights=height_reference(survey),
    )  # fmt: skip


def common_height_sd_m(survey: Survey, off_m: np.ndarray, above_m: float | None = None) -> float:
    """Of frames found so much below the heights they were given, so high above the ground."""
    block = block_of(survey)
    poses, ground = block.poses, block.ground
    poses = replace(poses, positions_m=poses.positions_m - np.column_stack([np.zeros((6, 2)), off_m]))
    if above_m is not None:
        ground = replace(ground, up_m=poses.positions_m[:1, 2:] - above_m)
    return float(np.sqrt(common_error(block, poses, ground, Components())[2]))


def of_pos(survey: Survey, sd_vertical_m: float, *, datum_stated: bool) -> Survey:
    given = {"source": "pos", "sd_vertical_m": sd_vertical_m, "datum_stated": datum_stated}
    frames = tuple(replace(f, position=replace(f.position, **given)) for f in survey.frames)
    return replace(survey, frames=frames)


def test_an_unknown_datum_is_shared_by_all_frames(survey: Survey) -> None:
    """15 m of a receiver's own and the sea's level about the ellipsoid."""
    assert common_height_sd_m(survey, np.full(6, 3.0)) == pytest.approx(np.hypot(15.0, SEA_LEVEL_M), abs=1e-3)
    poses = with_common_error(block_of(survey).poses, np.array([0.0, 0.0, 225.0]))
    assert poses.positions_sd_m[3] == pytest.approx([0.2, 0.2, np.hypot(0.2, 15.0)])


def test_heights_of_a_pos_file_without_datum_are_off_by_the_geoid_s_undulation(
    survey: Survey, tmp_path: Path
) -> None:
    """By an installed grid, else by the EGM96 of the package. Stated are 5 cm."""
    frame = survey.work_frame
    there = LocalFrame(11.0, 48.0, frame.height_ellipsoidal_m)
    undulation = float(undulation_m(np.array(11.0), np.array(48.0)))
    unstated = of_pos(replace(survey, work_frame=there), 0.05, datum_stated=False)
    with egm96_of(tmp_path):
        reference = height_reference(unstated)
    assert reference is not None and reference.datum_sd_m == pytest.approx(undulation, abs=0.01)
    still = np.zeros(6)
    assert common_height_sd_m(of_pos(survey, 0.05, datum_stated=False), still) == pytest.approx(
        SEA_LEVEL_M, abs=0.1
    )
    assert common_height_sd_m(of_pos(survey, 0.05, datum_stated=True), still) == 0.0


@pytest.mark.parametrize(("column", "stated"), [("alt_m", False), ("height_ellipsoidal_m", True)])
def test_a_pos_file_says_whether_its_datum_is_stated(tmp_path: Path, column: str, stated: bool) -> None:
    folder = survey_folder(tmp_path / "frames", 3)
    names = sorted(p.name for p in folder.glob("*.JPG"))
    rows = [f"{name},{9.12 + 1e-4 * k},48.77,500.0" for k, name in enumerate(names)]
    pos = tmp_path / "pos.csv"
    pos.write_text("\n".join([f"frame,lon_deg,lat_deg,{column}", *rows]) + "\n", encoding="utf-8")
    read = read_survey(SurveyInputs(folder, pos=pos))
    assert [f.position.datum_stated for f in read.frames] == [stated] * 3
    reference = height_reference(read)
    assert reference is not None and (reference.datum_sd_m is None) is stated


@pytest.mark.parametrize(
    ("ground_m", "stated_m"), [(-40.0, 800.0), (0.0, 800.0), (40.0, 800.0), (60.0, SEA_LEVEL_M)]
)
def test_heights_that_may_count_from_the_take_off_tell_no_datum(
    survey: Survey, ground_m: float, stated_m: float
) -> None:
    """100 m above the ground. Dirty survey 1727 was 522 m higher than it said, with 15 m stated."""
    low = tuple(
        replace(f, position=replace(f.position, height_ellipsoidal_m=100.0 + ground_m)) for f in survey.frames
    )
    found_m = common_height_sd_m(replace(survey, frames=low), np.zeros(6), above_m=100.0)
    assert found_m == pytest.approx(np.hypot(15.0, stated_m), rel=1e-4)


def test_heights_with_a_stated_datum_hide_the_receivers_error(survey: Survey) -> None:
    """Heights of 0.2 m that scatter by a tenth of it: 0.2² (1 - 0.1² / 0.5) m² may be common to all. Those of
    a receiver of 20 m are off by 2.1 m in common, in plan as in height."""
    block = block_of(of_pos(survey, 0.2, datum_stated=True))
    steady = Components({HORIZONTAL: 0.1, VERTICAL: 0.1})
    found = np.sqrt(common_error(block, block.poses, block.ground, steady))
    assert found == pytest.approx([0.198] * 3, abs=1e-4)
    rough = replace(block, poses=replace(block.poses, positions_sd_m=np.full((6, 3), 20.0)))
    found = np.sqrt(common_error(rough, block.poses, block.ground, steady))
    assert found == pytest.approx([2.1 * 0.98**0.5] * 3, abs=1e-4)


def test_a_drift_is_shared_too(survey: Survey) -> None:
    drift = np.arange(6) * 20.0
    assert common_height_sd_m(survey, drift) == pytest.approx(
        np.hypot(np.hypot(15.0, SEA_LEVEL_M), 1.4826 * 30.0), rel=0.01
    )
    pos = of_pos(survey, 3.0, datum_stated=True)
    assert common_height_sd_m(pos, np.arange(6) * 1.0) == 0.0
    assert common_height_sd_m(pos, drift) == pytest.approx(1.4826 * 30.0, rel=0.01)


def test_an_offset_of_all_heights_is_stated_and_leaves_the_plan_alone() -> None:
    """All heights 5 m too high, in a source that states 0.1 m and no datum; a check point says so, and is
    not called wrong."""
    flown = fly(3, position_sd_m=np.array([0.1, 0.1, 0.1]), points=400)
    poses, n = flown.block.poses, len(flown.block.names)
    frame = LocalFrame(11.0, 48.0, 500.0)
    raised = replace(poses, positions_m=poses.positions_m + [0.0, 0.0, 5.0])
    heights = frame.geodetic_from_enu(raised.positions_m)[:, 2]
    at = np.array([30.0, 40.0, 0.0])
    check = GroundControl("C", at, np.full(3, 0.02), True, tuple(flown.seen(at, 0.3)))
    block = replace(
        flown.block, poses=raised, control=(check,),
        heights=HeightReference(frame, heights, np.full(n, 0.1), 46.0),
    )  # fmt: skip
    adjusted = METHODS["bundle"](block, Settings(model="given"))
    off = adjusted.poses.positions_m - flown.truth.positions_m
    sd = adjusted.poses.positions_sd_m
    assert off[:, 2] == pytest.approx(5.0, abs=0.5) and np.all(np.abs(off[:, 2]) < 2.0 * sd[:, 2])
    assert np.all(np.abs(off[:, :2]) < 0.5) and np.all(sd[:, :2] < 0.5)
    assert np.std(off[:, 2]) < 0.2
    assert adjusted.pose_covariance is not None
    assert np.sqrt(adjusted.pose_covariance[:, 2, 2]) == pytest.approx(sd[:, 2])
    (judged,) = adjusted.control
    assert judged.sd_m[2] > 40.0 and np.all(judged.sd_m[:2] < 1.0)
    assert not [w for w in control_warnings(adjusted.control) if w.code == "check-disagrees"]
