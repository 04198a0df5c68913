"""Control and check points: what they do to a block, what is said of them, and from file to report."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rasterio
from adjustment_blocks import Flown, fly, hills, level
from pyproj import Transformer
from small_surveys import mosaic, small_survey, summary

from geomosaic.adjustment.methods import METHODS
from geomosaic.adjustment.model import Adjusted, ControlResidual, GroundControl, Settings
from geomosaic.adjustment.problem.usable_block import as_taken
from geomosaic.adjustment.procedure.control_points import control_residuals
from geomosaic.matching.model import TiePoints
from geomosaic.quality.control import control_figures, control_warnings
from geomosaic.quality.positions import read_poses
from geomosaic.survey.inputs import SurveyInputs
from geomosaic.survey.read import read_survey

SD_M = np.array([0.02, 0.02, 0.02])
CORNERS = np.array([[-15.0, -10.0], [95.0, -10.0], [95.0, 100.0], [-15.0, 100.0], [40.0, 45.0]])
Relief = Callable[[np.ndarray, np.ndarray], np.ndarray]


def surveyed(
    flown: Flown, plan_m: np.ndarray, relief: Relief = level, *, check: bool = False, noise_px: float = 0.5
) -> tuple[GroundControl, ...]:
    """Points of 2 cm, measured to half a pixel in every frame that sees them."""
    out = []
    for k, (east, north) in enumerate(plan_m):
        at = np.array([east, north, float(relief(east, north))])
        seen = tuple(flown.seen(at, noise_px))
        given = at + flown.rng.normal(0, SD_M)
        out.append(GroundControl(f"{'CHK' if check else 'GCP'}-{k}", given, SD_M, check, seen))
    return tuple(p for p in out if p.observations)


def checks(flown: Flown, relief: Relief = level) -> tuple[GroundControl, ...]:
    plan = flown.rng.uniform([-15.0, -10.0], [95.0, 100.0], (30, 2))
    return surveyed(flown, plan, relief, check=True)


def adjusted_with(flown: Flown, control: tuple[GroundControl, ...], method: str = "bundle") -> Adjusted:
    """By the model that is given, which is the true one."""
    return METHODS[method](replace(flown.block, control=control), Settings(model="given"))


def residuals(adjusted: Adjusted, *, check: bool) -> tuple[np.ndarray, np.ndarray]:
    """Residuals and their deviations, (n, 3) each."""
    some = [c for c in adjusted.control if c.check == check]
    return np.array([c.residual_m for c in some]), np.array([c.sd_m for c in some])


def rms(values: np.ndarray) -> np.ndarray:
    return np.asarray(np.sqrt(np.mean(np.square(values), axis=0)))


def test_figures_by_hand() -> None:
    """East 3, -1; north 4, 0; up -2, 6: lengths 5 and 1, their 0.9 quantile 1 + 0.9 * 4."""
    points = [
        ControlResidual("a", True, 2, np.array([3.0, 4.0, -2.0]), np.ones(3), np.ones(3)),
        ControlResidual("b", True, 2, np.array([-1.0, 0.0, 6.0]), np.ones(3), np.ones(3)),
    ]
    f = control_figures(points)
    assert (f.n, f.rmse_east_m, f.rmse_north_m) == (2, pytest.approx(5**0.5), pytest.approx(8**0.5))
    assert (f.rmse_up_m, f.rmse_horizontal_m) == (pytest.approx(20**0.5), pytest.approx(13**0.5))
    assert (f.ce90_m, f.le90_m) == (pytest.approx(4.6), pytest.approx(5.6))


def test_points_known_in_plan_alone_have_no_say_in_height() -> None:
    known = ControlResidual("a", True, 2, np.array([0.0, 0.0, 0.2]), np.ones(3), np.ones(3))
    plan = ControlResidual("b", True, 2, np.array([1.0, 0.0, 40.0]), np.array([1.0, 1.0, 2e5]), np.ones(3))
    both, alone = control_figures([known, plan]), control_figures([plan])
    assert (both.n, both.n_height, both.rmse_up_m, both.le90_m) == (
        2,
        1,
        pytest.approx(0.2),
        pytest.approx(0.2),
    )
    assert (alone.n_height, alone.rmse_up_m, alone.le90_m, alone.ce90_m) == (0, None, None, 1.0)


def test_points_known_in_plan_alone_do_not_lift_a_block_to_its_prior_ground() -> None:
    """RTK positions over land 20 m below what was taken for it before: the points' heights are that ground's."""
    flown = fly(3, points=900, position_sd_m=np.array([0.03, 0.03, 0.05]))
    control = tuple(
        replace(c, enu_m=np.array([*c.enu_m[:2], 20.0]), sd_m=np.array([0.02, 0.02, 1e5]))
        for c in surveyed(flown, CORNERS)
    )
    ground = replace(flown.block.ground, up_m=flown.block.ground.up_m + 20.0)
    block = replace(flown.block, ground=ground, control=control)
    adjusted = METHODS["bundle"](block, Settings(model="given"))
    off_m = adjusted.poses.positions_m - flown.truth.positions_m
    assert rms(off_m).max() < 0.1
    assert "positions-shifted" not in {w.code for w in adjusted.warnings}


def test_what_rtk_positions_are_off_by_in_common_does_not_outvote_control() -> None:
    """84 positions of 3 cm, all 11 cm off, and four points of 2 cm at the corners. Check points were 7 cm off
    where each position counted as one of 84 independent witnesses."""
    stated_m, off_m = np.array([0.03, 0.03, 0.05]), np.array([0.1, 0.05, 0.14])
    flown = fly(3, 6, 14, relief=hills, points=1500, position_sd_m=0.3 * stated_m, there_and_back=True)
    poses = flown.block.poses
    sd_m = np.tile(stated_m, (len(poses), 1))
    poses = replace(poses, positions_m=poses.positions_m + off_m, positions_sd_m=sd_m)
    corners = np.array([[5.0, 5.0], [195.0, 5.0], [5.0, 230.0], [195.0, 230.0]])
    control = surveyed(flown, corners, hills, noise_px=0.3)
    seen = surveyed(
        flown, flown.rng.uniform(corners[0], corners[3], (20, 2)), hills, check=True, noise_px=0.3
    )
    block = replace(flown.block, poses=poses, control=(*control, *seen))
    found, _ = residuals(METHODS["bundle"](block, Settings(model="given")), check=True)
    assert np.abs(found[:, :2].mean(axis=0)).max() < 0.04


def test_residual_is_surveyed_minus_found() -> None:
    """True poses, exact pixels. A point surveyed 0.3 m too far east, 0.2 m too far south and 0.5 m too high
    says just that. Seen once, it is found on the ground."""
    flown = fly(0)
    at = np.array([33.0, 40.0, 0.0])
    wrong = at + [0.3, -0.2, 0.5]
    seen = tuple(flown.seen(at))
    many = GroundControl("many", wrong, SD_M, True, seen)
    loose = replace(many, name="loose", sd_m=np.array([0.5, 0.3, 0.8]))
    once = GroundControl("once", wrong, SD_M, True, seen[:1])
    behind = GroundControl("behind", wrong, SD_M, True, ())
    block = replace(flown.block, poses=flown.truth, control=(many, once, loose))
    *found, badly_known = control_residuals(block, flown.truth)
    assert [f.name for f in found] == ["many", "once"] and behind.observations == ()
    assert found[0].images == len(seen) > 3
    for f in found:
        assert f.residual_m == pytest.approx([0.3, -0.2, 0.5], abs=1e-6)
    pixel = 0.5 * 0.1 / np.sqrt(len(seen))
    assert found[0].sd_m[0] == pytest.approx(np.hypot(pixel, 0.02), rel=0.3)
    assert found[1].sd_m[2] >= 0.5
    assert badly_known.sd_m**2 - found[0].sd_m ** 2 == pytest.approx(loose.sd_m**2 - SD_M**2)


@pytest.mark.parametrize("relief", [level, hills])
def test_two_points_show_what_all_positions_are_off_by(relief: Relief) -> None:
    """By a deviation of theirs, 1.5 m in plan. Check points were 0.6 to 1 m off, at a third of it stated."""
    flown = fly(3, points=300, relief=relief)
    poses = flown.block.poses
    moved = replace(poses, positions_m=poses.positions_m + [1.5, -1.5, 2.0])
    judges, control = checks(flown, relief), surveyed(flown, CORNERS, relief)[:2]
    for block in (flown.block, replace(flown.block, poses=moved)):
        adjusted = adjusted_with(replace(flown, block=block), (*control, *judges))
        found, sd = residuals(adjusted, check=True)
        assert rms(found)[:2].max() < 0.2
        assert rms(found / sd).max() < 2.0


@pytest.mark.proof
@pytest.mark.parametrize(("relief", "seed"), [(level, 0), (hills, 10)])
def test_five_points_of_two_centimetres(relief: Relief, seed: int) -> None:
    """From POS alone to control, check points fall from decimetres to below 0.05 m. In eight blocks, whose
    points share errors, they are as large as stated. One point at most is named by chance."""
    off: dict[int, list[np.ndarray]] = {0: [], 2: [], 5: []}
    share: dict[int, list[np.ndarray]] = {n: [] for n in off}
    named = 0
    for block in range(8):
        flown = fly(seed + block, points=300, relief=relief)
        judges, control = checks(flown, relief), surveyed(flown, CORNERS, relief)
        for n in off:
            adjusted = adjusted_with(flown, (*control[:n], *judges))
            named += sum("disagrees" in w.code for w in control_warnings(adjusted.control))
            found, sd = residuals(adjusted, check=True)
            assert len(found) == len(judges) and len(residuals(adjusted, check=False)[0]) == n
            off[n].append(found)
            share[n].append(found / sd)
    horizontal = {n: float(np.hypot(*rms(np.concatenate(v))[:2])) for n, v in off.items()}
    assert named <= 1
    assert 0.25 < horizontal[0] < 1.0
    assert horizontal[0] > horizontal[2] > horizontal[5]
    # A check point's own error: 0.5 px of 0.1 m in some 5 images, and its 0.02 m.
    noise = np.hypot(0.022, 0.02)
    block_only = np.sqrt(np.maximum(rms(np.concatenate(off[5]))[:2] ** 2 - noise**2, 0.0))
    assert np.all(block_only < 0.05)
    assert np.all(rms(np.concatenate(share[5])) == pytest.approx(1.0, abs=0.2))
    assert relief is hills or all(0.4 < v < 1.8 for n in (0, 2) for v in rms(np.concatenate(share[n])))


def test_a_blunder_is_named_and_outvoted() -> None:
    flown = fly(3)
    control = list(surveyed(flown, CORNERS))
    control[2] = replace(control[2], enu_m=control[2].enu_m + [3.0, -4.0, 0.0])
    adjusted = adjusted_with(flown, (*control, *checks(flown)))
    texts = [w.text for w in control_warnings(adjusted.control) if w.code == "control-disagrees"]
    assert len(texts) == 1 and "'GCP-2' lies" in texts[0]
    off = next(c.residual_m for c in adjusted.control if c.name == "GCP-2")
    assert off == pytest.approx([3.0, -4.0, 0.0], abs=0.6)
    assert np.all(rms(residuals(adjusted, check=True)[0])[:2] < 0.09)
    assert not [w for w in control_warnings(adjusted.control) if w.code == "check-disagrees"]


def test_check_points_change_nothing() -> None:
    """Not by a bit: also a check point that is 7 m wrong, which is named."""
    flown = fly(4)
    control = surveyed(flown, CORNERS)
    wrong = replace(checks(flown)[0], enu_m=np.array([20.0, 30.0, 7.0]))
    alone, judged = adjusted_with(flown, control), adjusted_with(flown, (wrong, *control))
    assert np.array_equal(alone.poses.positions_m, judged.poses.positions_m)
    assert [w.code for w in control_warnings(judged.control)] == ["check-disagrees"]
    assert not (judged.warnings or alone.warnings or control_warnings(alone.control))


def test_control_in_another_datum_is_named() -> None:
    """All points 30 m west: the block follows them, since they say centimetres, but not without a word."""
    flown = fly(5)
    moved = tuple(replace(c, enu_m=c.enu_m - [30.0, 0.0, 0.0]) for c in surveyed(flown, CORNERS))
    adjusted = adjusted_with(flown, moved)
    assert "positions-shifted" in [w.code for w in adjusted.warnings]
    shift = np.median(adjusted.poses.positions_m - flown.truth.positions_m, axis=0)
    assert shift[0] == pytest.approx(-30.0, abs=0.5)


def test_control_places_frames_without_ties() -> None:
    """No tie points at all: the frames that see control are placed by it, the others keep their POS."""
    flown = fly(6, 1, 4)
    plan = np.array([[-25.0, -15.0], [25.0, -12.0], [-22.0, 16.0], [20.0, 14.0], [3.0, 1.0]])
    first = tuple(
        replace(c, observations=tuple(o for o in c.observations if o[0] == 0))
        for c in surveyed(flown, plan, noise_px=0.2)
    )
    bare = replace(flown, block=replace(flown.block, ties=TiePoints(())))
    adjusted = adjusted_with(bare, first)
    assert adjusted.status == ("placed",) * 4
    assert adjusted.poses.positions_m[1:] == pytest.approx(flown.block.poses.positions_m[1:], abs=1e-6)
    hit = [c.residual_m[:2] for c in adjusted.control]
    assert np.abs(hit).max() < 0.1 and len(hit) == 5
    before = [c.residual_m[:2] for c in adjusted_with(bare, first, "none").control]
    assert np.abs(before).max() > 0.5


@pytest.mark.parametrize("check", [False, True])
def test_a_point_without_marks_is_no_control(check: bool) -> None:
    flown = fly(3)
    empty = GroundControl("empty", np.array([40.0, 45.0, 0.0]), SD_M, check, ())
    adjusted, without = adjusted_with(flown, (empty,)), adjusted_with(flown, ())
    assert np.array_equal(adjusted.poses.positions_m, without.poses.positions_m)
    assert adjusted.control == () and not without.warnings
    assert [w.code for w in adjusted.warnings] == ["control-points-unused"]
    assert "(empty)" in adjusted.warnings[0].text
    assert adjusted_with(flown, (empty,), "error_sharing").control == ()


def test_two_marks_of_a_point_in_one_image_count_as_their_mean() -> None:
    """A second mark of the same point in the same image, 1 px to the right and below."""
    flown = fly(3)
    first, *others = surveyed(flown, CORNERS, noise_px=0.3)
    (i, col, row), *rest = first.observations
    mean, apart, same = (
        adjusted_with(flown, (replace(first, observations=(*marks, *rest)), *others))
        for marks in (
            [(i, col + 0.5, row + 0.5)],
            [(i, col, row), (i, col + 1.0, row + 1.0)],
            [(i, col + 0.5, row + 0.5)] * 2,
        )
    )
    for its in (apart, same):
        assert its.poses.positions_m == pytest.approx(mean.poses.positions_m, abs=1e-6)
        assert its.control[0].images == len(rest) + 1
    assert [w.code for w in apart.warnings] == ["control-mark-repeated"]
    assert "(GCP-0)" in apart.warnings[0].text
    assert not (mean.warnings or same.warnings)


@pytest.mark.parametrize("method", sorted(set(METHODS) - {"bundle"}))
def test_other_methods_only_judge_by_it(method: str) -> None:
    flown = fly(7)
    control = (*surveyed(flown, CORNERS), *checks(flown))
    adjusted = adjusted_with(flown, control, method)
    assert len(adjusted.control) == len(control) and all(c.check for c in adjusted.control)
    assert np.array_equal(
        adjusted.poses.positions_m, METHODS[method](flown.block, Settings()).poses.positions_m
    )
    found, sd = residuals(adjusted, check=True)
    assert 0.2 < np.hypot(*rms(found)[:2]) < 8.0 and np.all(sd[:, :2] > 0.1)


def test_half_turned_images_turn_their_measurements() -> None:
    """800 x 600 pixels: 123, 45 of an image in its file was taken at 677, 555."""
    flown = fly(8, 1, 3)
    point = GroundControl("GCP", np.zeros(3), SD_M, False, ((0, 123.0, 45.0), (2, 123.0, 45.0)))
    block = replace(flown.block, control=(point,), turned=(0, 0, 2))
    assert as_taken(block).control[0].observations == ((0, 123.0, 45.0), (2, 677.0, 555.0))
    flown = fly(9, points=400)
    taken = replace(flown.block, control=surveyed(flown, CORNERS))
    filed = replace(as_taken(replace(taken, turned=(0, 2) * 9)), turned=(0, 2) * 9)
    assert filed.control[0].observations != taken.control[0].observations
    straight, upright = (METHODS["bundle"](b, Settings(model="given")) for b in (taken, filed))
    for a, b in zip(straight.control, upright.control, strict=True):
        assert a.residual_m == pytest.approx(b.residual_m, abs=1e-5)


@pytest.mark.proof
def test_from_the_file_to_the_report(tmp_path: Path) -> None:
    """A simulated survey with positions of 0.4 m; points on its true ground, placed in its frames by its
    true poses. Five hold it, six judge; one of the five is 5 m wrong."""
    flown = small_survey(tmp_path / "survey", frames_per_line=3, width_px=400, height_px=300)
    read = read_survey(SurveyInputs(flown.frames, pos=flown.pos, camera=flown.camera))
    true = read_poses(flown.positions, [f.name for f in read.frames], read.work_frame)
    share = np.array([[0, 0], [0, 1], [1, 0], [1, 1], [0.5, 0.5], [0.2, 0.5], [0.5, 0.1], [0.8, 0.4],
        [0.4, 0.8], [0.1, 0.3], [0.7, 0.7]])  # fmt: skip
    low, high = true.positions_m.min(axis=0)[:2] + 2.0, true.positions_m.max(axis=0)[:2] - 2.0
    plan = np.column_stack([low + share * (high - low), np.zeros(11)])
    lon, lat, _ = read.work_frame.geodetic_from_enu(plan).T
    with rasterio.open(flown.dem) as dem:
        place = Transformer.from_crs("EPSG:4979", dem.crs, always_xy=True).transform(lon, lat)
        height_m = np.array([v[0] for v in dem.sample(zip(*place, strict=True))], dtype=np.float64)
    at_m = read.work_frame.enu_from_geodetic(lon, lat, height_m)
    lines = ["name,kind,lon_deg,lat_deg,height_ellipsoidal_m,sd_horizontal_m,sd_vertical_m,image,col,row"]
    for k, at in enumerate(at_m):
        kind, wrong = ("control" if k < 5 else "check"), (5.0 if k == 2 else 0.0)
        for i, frame in enumerate(read.frames):
            col, row = true[i].image_from_ground(read.cameras[0], at)
            if 0.0 < col < frame.width_px and 0.0 < row < frame.height_px:
                lines.append(
                    f"P{k},{kind},{lon[k]:.10f},{lat[k]:.10f},{height_m[k] + wrong:.4f},0.02,0.02,"
                    f"{frame.name},{col:.2f},{row:.2f}"
                )
    gcp = tmp_path / "gcp.csv"
    gcp.write_text("\n".join(lines) + "\n", encoding="utf-8")
    run = tmp_path / "run"
    options = ("--pos", flown.pos) if flown.pos else ()
    assert mosaic(flown.frames, run, *options, "--camera", flown.camera, "--gcp", gcp) == 0
    metrics = summary(run)["metrics"]["adjustment"]
    assert metrics["control"]["n"] == 5 and metrics["check"]["n"] == 6
    assert metrics["check"]["rmse_horizontal_m"] < 0.03 and metrics["check"]["le90_m"] < 0.05
    named = [w["text"] for w in summary(run)["warnings"] if w["code"] == "control-disagrees"]
    assert len(named) == 1 and "'P2'" in named[0]
    page = (run / "report.html").read_text(encoding="utf-8")
    assert "Check points: 6" in page and "Control points: 4 of 5" in page and ">P2 <b" in page
