"""Where the mosaic ends: what is seen aslant, coarsely, or on ground that is a guess is left out."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from mosaic_scenes import CAMERA, HOME
from osgeo import ogr
from small_surveys import mosaic, small_survey, summary
from test_mosaic_grid import given_for, seams

from geomosaic.camera.exterior import Pose
from geomosaic.camera.interior import Camera
from geomosaic.camera.rotation import Rotation, exp_turn
from geomosaic.composition.compose import compose
from geomosaic.composition.limits import Limits
from geomosaic.composition.model import Trimmed, TrimmedPart
from geomosaic.composition.orthos import plan_orthos
from geomosaic.composition.raster import MosaicFiles
from geomosaic.composition.trim import REASONS, looked_at, slivers, whole_of
from geomosaic.composition.views import PosedFrames, frame_views
from geomosaic.geodesy.mapcrs import LOCAL_CRS
from geomosaic.matching.band_registration import RigPoses
from geomosaic.projection.footprint import sightings, survey_pixel_m
from geomosaic.projection.ground import flat_ground
from geomosaic.report.parts import trimmed_rows
from geomosaic.stages.reporting import reported_trimmed, trimmed_text

ASLANT, COARSE, GUESSED = REASONS.values()


def turned(given: dict[str, Any], off_vertical_deg: dict[int, float]) -> dict[str, Any]:
    """Some of the frames look aside, to the north."""
    poses = given["adjusted"].poses
    rotations = poses.rotations.copy()
    for i, deg in off_vertical_deg.items():
        rotations[i] = Rotation.from_yaw_pitch_roll(0.0, np.radians(deg), 0.0).matrix
    poses = replace(poses, rotations=rotations)
    return {**given, "adjusted": replace(given["adjusted"], poses=poses)}


def reasons(ownership: Any) -> dict[str, float]:
    return {part.reason: part.area_m2 for part in ownership.trimmed.parts}


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    return given_for(tmp_path_factory.mktemp("flown"), per_line=4)


def test_a_pixel_is_as_long_as_it_is_along_the_view() -> None:
    """On flat ground of 50 m below: h / f at the nadir, h / (f cos²) along the view of the middle."""
    camera = Camera("plain", 240, 180, 200.0, 120.0, 90.0)
    pose = Pose(np.array([0.0, 0.0, 50.0]), Rotation.from_yaw_pitch_roll(0.3, np.radians(60.0), 0.0))
    at_px = np.array([[120.0, 90.0]])
    point, tangent, pixel_m = sightings(pose, camera, flat_ground(HOME, 400.0, 400.0), at_px)
    assert tangent == pytest.approx([np.sqrt(3.0)], rel=1e-3)
    assert pixel_m == pytest.approx([50.0 / 200.0 / 0.25], rel=2e-3)
    assert np.hypot(*point[0, :2]) == pytest.approx(50.0 * np.sqrt(3.0), rel=1e-3)


def test_two_frames_at_the_horizon_make_the_mosaic_no_larger(tmp_path: Path, flown: dict[str, Any]) -> None:
    few = {**flown, "adjusted": replace(flown["adjusted"], status=("tied",) * 6 + ("rejected",) * 2)}
    without = seams(tmp_path / "without", few)[0].grid
    aside = turned(flown, {6: 88.0, 7: 95.0})
    owned, notes = seams(tmp_path / "with", aside)
    assert (owned.grid.width_px, owned.grid.height_px) == (without.width_px, without.height_px)
    assert not owned.used[6:].any() and owned.used[:6].all()
    warning_found = [w for w in notes.warnings if w["code"] == "looks-aside"]
    assert len(warning_found) == 1
    assert (
        "2 frames look too obliquely" in warning_found[0]["text"] and "frame 06" in warning_found[0]["text"]
    )
    assert set(reasons(owned)) <= {ASLANT, COARSE} and owned.trimmed.share > 0.5
    kept = seams(tmp_path / "keep", turned(flown, {6: 75.0}), edges="keep")[0]
    assert kept.grid.height_px > 3 * without.height_px
    assert kept.trimmed is None and kept.area is None


def test_an_oblique_frame_gives_what_it_sees_within_the_limits(tmp_path: Path, flown: dict[str, Any]) -> None:
    given = turned(flown, {3: 50.0})
    owned, _ = seams(tmp_path, given)
    assert (owned.owner == 4).any()
    _, tangent = looked_at(owned, given["adjusted"].poses, given["survey"].work_frame, given["ground"])
    inside = owned.area.cells(owned.grid, whole_of(owned.grid), owned.cell_px)
    assert np.nanmax(tangent[inside]) < np.tan(np.radians(61.0))
    assert set(reasons(owned)) <= {ASLANT, COARSE}


def test_a_nadir_survey_is_left_as_it_is(tmp_path: Path, flown: dict[str, Any]) -> None:
    trimmed, kept = (seams(tmp_path / how, flown, edges=how)[0] for how in ("trim", "keep"))
    assert trimmed.grid == kept.grid and trimmed.area is None
    assert np.array_equal(trimmed.owner, kept.owner)
    assert trimmed.trimmed.parts == ()


def test_a_survey_that_is_oblique_as_a_whole_keeps_its_mosaic(tmp_path: Path, flown: dict[str, Any]) -> None:
    oblique = turned(flown, dict.fromkeys(range(8), 66.0))
    owned, _ = seams(tmp_path, oblique)
    assert owned.used.all() and (owned.owner > 0).any()
    assert ASLANT not in reasons(owned)


def test_land_inside_that_no_frame_sees_well_is_no_hole(tmp_path: Path, flown: dict[str, Any]) -> None:
    """A gap of the ground's heights, known well outside, has a mountain's deviation; it stays."""
    ground, n = flown["ground"], 81
    sd_m = np.full((n, n), 0.01)
    sd_m[30:50, 30:50] = 100.0
    known = replace(
        ground, kind="dem", east_0_m=-80.0, north_0_m=-80.0, spacing_m=2.0, up_m=np.zeros((n, n)), sd_m=sd_m
    )
    given = {**flown, "ground": known, "adjusted": replace(flown["adjusted"], ground=known)}
    owned, _ = seams(tmp_path, given)
    assert owned.trimmed.parts == ()


def with_ground_sd(
    given: dict[str, Any], sd_m: np.ndarray | float, least_m: float | None = None
) -> dict[str, Any]:
    """Heights of the ground have these deviations, and the least one at a corner far away."""
    sd = np.broadcast_to(sd_m, given["ground"].up_m.shape).astype(np.float64)
    sd[0, 0] = sd[0, 0] if least_m is None else least_m
    ground = replace(given["ground"], sd_m=sd)
    return {**given, "ground": ground, "adjusted": replace(given["adjusted"], ground=ground)}


def test_beyond_what_was_flown_over_guessed_ground_is_trimmed(tmp_path: Path, flown: dict[str, Any]) -> None:
    """A frame that looks 40 degrees aside shows land beyond a level frame's reach, good to 5 m only."""
    given = turned(with_ground_sd(flown, 5.0, least_m=0.01), {7: 40.0})
    assert reasons(seams(tmp_path, given)[0])[GUESSED] > 100.0
    sure = with_ground_sd(given, 0.01)
    assert GUESSED not in reasons(seams(tmp_path / "sure", sure)[0])


def test_a_deviation_that_all_ground_has_in_common_trims_nothing(
    tmp_path: Path, flown: dict[str, Any]
) -> None:
    """Five thermal frames with GNSS positions: heights of tied land were good to 5 m, and half was trimmed."""
    given = turned(with_ground_sd(flown, 5.0), {7: 40.0})
    assert GUESSED not in reasons(seams(tmp_path, given)[0])


def test_frames_that_look_a_little_aside_keep_the_land_they_look_at(
    tmp_path: Path, flown: dict[str, Any]
) -> None:
    """By 15 degrees: all land that a level frame would reach about the middle of each frame's view is kept."""
    given = turned(with_ground_sd(flown, 50.0, least_m=0.01), dict.fromkeys(range(8), 15.0))
    owned, _ = seams(tmp_path, given)
    assert owned.trimmed.share < 0.03


def test_a_frame_without_tie_points_shows_all_it_sees_from_above(
    tmp_path: Path, flown: dict[str, Any]
) -> None:
    """On unknown ground as well, or a chip about the point below it would be left."""
    ground = replace(flown["ground"], sd_m=np.full_like(flown["ground"].up_m, 50.0))
    adjusted = replace(flown["adjusted"], ground=ground, status=("tied",) * 2 + ("placed",) * 6)
    owned, _ = seams(tmp_path, {**flown, "ground": ground, "adjusted": adjusted})
    assert owned.used[2:].any()
    assert owned.trimmed.share < 0.02


def test_pixels_end_where_the_mosaic_does(tmp_path: Path, flown: dict[str, Any]) -> None:
    given = turned(flown, {3: 62.0})
    owned, _ = seams(tmp_path, given)
    survey, adjusted, raster = given["survey"], given["adjusted"], tmp_path / "mosaic.tif"
    frames = PosedFrames(survey, adjusted.poses, adjusted.cameras, owned.used.tolist(), given["ground"])
    made = compose(frames, owned, MosaicFiles(raster))
    with rasterio.open(raster) as image:
        valid = image.dataset_mask() > 0
    assert valid.any() and not (valid & ~owned.area.mask(owned.grid, whole_of(owned.grid))).any()
    assert made.holes.number == 0
    assert made.trimmed == owned.trimmed


def test_what_a_frame_whose_middle_looks_past_the_ground_owns_is_shown(
    tmp_path: Path, flown: dict[str, Any]
) -> None:
    """A wide lens looks at the horizon from the block's northern end; of its land it gives the nearest."""
    wide = Camera("wide", 240, 180, 80.0, 120.0, 90.0)
    given = turned(flown, {3: 93.0})
    adjusted = replace(given["adjusted"], cameras=(*(CAMERA,) * 3, wide, *(CAMERA,) * 4))
    given |= {"adjusted": adjusted}
    owned, _ = seams(tmp_path, given)
    mine = np.repeat(np.repeat(owned.owner == 4, owned.cell_px, axis=0), owned.cell_px, axis=1)
    grid = owned.grid
    mine = mine[: grid.height_px, : grid.width_px] & owned.area.mask(grid, whole_of(grid))
    assert mine.sum() > 3000
    frames = PosedFrames(
        given["survey"], adjusted.poses, adjusted.cameras, owned.used.tolist(), given["ground"]
    )
    made = compose(frames, owned, MosaicFiles(tmp_path / "mosaic.tif"))
    with rasterio.open(tmp_path / "mosaic.tif") as image:
        valid = image.dataset_mask() > 0
    assert 3 in made.frames_used
    assert valid[mine].mean() > 0.95, "all but halves of cells at its lower edge"
    plan = plan_orthos(frames, owned, RigPoses(), "cubic", None)
    assert 3 in plan.frames
    view = plan.frames[3][0].view
    reach_m = view.bounds_m[3] - view.nadir_m[1]
    assert reach_m < 50.0 * np.tan(np.radians(85.5)), "land up to the horizon would take all memory"


def test_a_survey_of_which_no_frame_is_tied_and_all_look_aside_keeps_its_frames(
    tmp_path: Path, flown: dict[str, Any]
) -> None:
    given = turned(flown, dict.fromkeys(range(8), 58.0))
    given["adjusted"] = replace(given["adjusted"], status=("placed",) * 8)
    owned, notes = seams(tmp_path, given)
    assert owned.used.all() and (owned.owner > 0).any()
    assert not [w for w in notes.warnings if w["code"] in ("untied-left-out", "edges-kept")]


def test_the_pixel_is_that_of_frames_that_look_down(flown: dict[str, Any]) -> None:
    ground, cameras = flown["ground"], (CAMERA,) * 8
    down = survey_pixel_m(flown["adjusted"].poses, cameras, (True,) * 8, ground)
    poses = turned(flown, dict.fromkeys(range(3, 8), 60.0))["adjusted"].poses
    assert survey_pixel_m(poses, cameras, (True,) * 8, ground) == pytest.approx(down, rel=0.03)


def test_bounds_are_those_of_what_is_seen_well(flown: dict[str, Any]) -> None:
    given = turned(flown, {0: 70.0})
    survey, adjusted = given["survey"], given["adjusted"]
    limits = Limits(np.tan(np.radians(60.0)), 1.0)
    used = [True] + [False] * 7
    frames = PosedFrames(survey, adjusted.poses, adjusted.cameras, used, given["ground"])
    (view,) = frame_views(frames, survey.map_crs, limits)
    reach_m = view.bounds_m[3] - view.nadir_m[1]
    assert reach_m == pytest.approx(50.0 * np.tan(np.radians(60.0)), rel=0.06)


@pytest.mark.proof
def test_the_command_makes_the_same_mosaic_with_frames_at_the_horizon(tmp_path: Path) -> None:
    """They tie, or not, and give no pixels; the size is that of the others before and after matching."""
    found = []
    for horizon in (0, 2):
        survey, run = (
            small_survey(
                tmp_path / f"s{horizon}",
                horizon_frames=horizon,
                frames_per_line=3,
                width_px=320,
                height_px=240,
            ),
            tmp_path / f"run{horizon}",
        )
        options = ["--pos", survey.pos, "--camera", survey.camera, "--set", "survey.read.leave_out=none"]
        assert mosaic(survey.frames, run, *options, "--edges", "trim", "--adjust", "least_squares") == 0
        found.append(summary(run))
    usual, aside = found
    assert aside["mosaic"] == usual["mosaic"]
    assert aside["metrics"]["estimate"]["width_px"] == pytest.approx(usual["mosaic"]["width"], rel=0.05)
    assert usual["trimmed"]["share"] == 0.0 and aside["trimmed"]["share"] > 0.5
    assert 'id="edges"' in (tmp_path / "run2" / "report.html").read_text(encoding="utf-8")
    layers = ogr.Open(str(tmp_path / "run2" / "layers.gpkg"))
    trimmed = {f["reason"]: f["area_m2"] for f in layers.GetLayerByName("trimmed")}
    assert trimmed.keys() == aside["trimmed"]["parts"].keys()


@pytest.mark.parametrize(
    ("map_crs", "words", "area"),
    [
        ("EPSG:32632", "3.00 ha are mapped; trimmed: 1.00 ha seen coarsely", "1.00 ha"),
        (LOCAL_CRS, "75.0% of the land seen is mapped; trimmed: 25.0% seen coarsely", "–"),
    ],
)
def test_a_map_without_scale_states_no_hectares(map_crs: str, words: str, area: str) -> None:
    trimmed = Trimmed(40_000.0, (TrimmedPart("seen coarsely", 10_000.0, ()),))
    assert trimmed_text(reported_trimmed(trimmed, map_crs)) == f"{words}; --edges keep keeps it"
    assert [row[1:] for row in trimmed_rows(trimmed, map_crs)] == [(area, "25\u00a0%")]


def placed(given: dict[str, Any], frame: int, moved_m: float = 0.0) -> dict[str, Any]:
    """One frame without tie points, moved to the east."""
    adjusted = given["adjusted"]
    status, positions_m = list(adjusted.status), adjusted.poses.positions_m.copy()
    status[frame] = "placed"
    positions_m[frame, 0] += moved_m
    poses = replace(adjusted.poses, positions_m=positions_m)
    return {**given, "adjusted": replace(adjusted, status=tuple(status), poses=poses)}


def test_a_frame_that_matches_no_other_gives_no_pixels_where_others_show_the_ground(
    tmp_path: Path, flown: dict[str, Any]
) -> None:
    owned, notes = seams(tmp_path / "inside", placed(flown, 1))
    assert not owned.used[1] and owned.used.sum() == 7 and not (owned.owner == 2).any()
    (warning_found,) = [w["text"] for w in notes.warnings if w["code"] == "untied-left-out"]
    assert "1 frame matches no other" in warning_found and "frame 01" in warning_found
    kept, _ = seams(tmp_path / "keep", placed(flown, 1), edges="keep")
    assert kept.used[1]


def test_a_frame_that_matches_no_other_and_shows_land_of_its_own_stays(
    tmp_path: Path, flown: dict[str, Any]
) -> None:
    owned, notes = seams(tmp_path, placed(flown, 1, moved_m=60.0))
    assert owned.used[1] and (owned.owner == 2).any()
    assert not [w for w in notes.warnings if w["code"] == "untied-left-out"]


def test_a_frame_that_matches_no_other_and_looks_at_the_horizon_gives_no_pixels(
    tmp_path: Path, flown: dict[str, Any]
) -> None:
    """Turned by 65 degrees about the east axis, most of the frame lies beyond 60 degrees off the vertical."""
    given = placed(flown, 1, moved_m=60.0)
    poses = given["adjusted"].poses
    rotations = poses.rotations.copy()
    rotations[1] = exp_turn(np.radians([[65.0, 0.0, 0.0]]))[0] @ rotations[1]
    given["adjusted"] = replace(given["adjusted"], poses=replace(poses, rotations=rotations))
    owned, notes = seams(tmp_path, given)
    assert not owned.used[1]
    (warning_found,) = [w["text"] for w in notes.warnings if w["code"] == "untied-left-out"]
    assert "horizon" in warning_found and "frame 01" in warning_found


def test_specks_that_trimming_leaves_alone_go_and_other_land_stays() -> None:
    kept = np.zeros((120, 200), dtype=bool)
    kept[10:110, 10:110] = True
    lost = np.zeros_like(kept)
    lost[10:110, 110:130] = True
    kept[50:53, 130:132] = True  # beyond what was lost: a speck
    kept[90:110, 130:150] = True  # and land of some size
    kept[2:4, 190:192] = True  # a frame far away, which nothing was cut from
    found = slivers(kept, lost)
    assert found[50:53, 130:132].all() and found.sum() == 6
    assert not slivers(kept, np.zeros_like(lost)).any()
