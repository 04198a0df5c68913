"""Whether a mosaic is called good only where it is: seams in the pixels, patterns of residuals, the verdict."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mosaic_scenes import CRS, GSD_M, HOME, make_survey
from small_surveys import mosaic, small_survey, summary

from geomosaic.adjustment.model import Adjusted, ControlResidual, ImageResiduals
from geomosaic.adjustment.procedure.residual_pattern import CELLS, residual_patterns
from geomosaic.camera.exterior import Poses
from geomosaic.camera.interior import Camera
from geomosaic.composition.area import Area
from geomosaic.composition.compose import compose
from geomosaic.composition.grid import output_grid
from geomosaic.composition.model import MapPixels, Mosaic, Trimmed, TrimmedPart
from geomosaic.composition.ownership import by_nearest_nadir
from geomosaic.composition.raster import MosaicFiles
from geomosaic.composition.views import PosedFrames, frame_views
from geomosaic.projection.ground import flat_ground
from geomosaic.quality.accuracy import AbsoluteAccuracy, Accuracy, RelativeAccuracy, Requirement
from geomosaic.quality.criteria import CRITERIA
from geomosaic.quality.ground_doubt import LandDoubt
from geomosaic.quality.mapped_land import LeftOutLand, left_out_land
from geomosaic.quality.seam_check import SeamCheck, check_seams, seam_places
from geomosaic.quality.verdict import Verdict, VerdictInputs, verdict_of
from geomosaic.spread import AtOnce
from geomosaic.survey.model import Warn

CAMERA = Camera("cam", 800, 600, 700.0, 400.0, 300.0)
NO_SEAMS = SeamCheck(
    *(np.zeros(0, dtype=np.int64),) * 2, np.zeros((0, 2)), np.zeros(0, np.int64), np.zeros((0, 2))
)


def composed(folder: Path, moved_m: tuple[float, float] = (0.0, 0.0)) -> tuple[SeamCheck, Mosaic]:
    """Two by three frames, the poses of the second line moved; the seams of their mosaic."""
    survey, poses, ground = make_survey(folder / "frames")
    off = np.zeros((len(poses), 3))
    off[3:, :2] = moved_m
    poses = replace(poses, positions_m=poses.positions_m + off)
    cameras = [survey.camera_of(i) for i in range(len(poses))]
    used = [True] * len(poses)
    frames = PosedFrames(survey, poses, cameras, used, ground)
    views = frame_views(frames, CRS)
    grid = output_grid(MapPixels(CRS, GSD_M), views, [f.name for f in survey.frames])
    mosaic = compose(frames, by_nearest_nadir(frames, grid), MosaicFiles(folder / "mosaic.tif"))
    seams = check_seams(frames, grid, mosaic.seamlines)
    return seams, mosaic


def test_ground_goes_on_across_right_seams(tmp_path: Path) -> None:
    seams, mosaic = composed(tmp_path)
    known = np.isfinite(seams.length_px)
    assert known.sum() >= 5 and np.all(seams.left < seams.right)
    assert np.all(seams.length_px[known] < 0.05)
    assert len(seam_places(mosaic.seamlines, 64.0, most=3)) == 3


def test_each_frame_is_decoded_once(tmp_path: Path) -> None:
    """However many places it shows, and whoever does the work."""
    survey, poses, ground = make_survey(tmp_path / "frames")
    cameras = [survey.camera_of(i) for i in range(len(poses))]
    frames = PosedFrames(survey, poses, cameras, [True] * len(poses), ground)
    views = frame_views(frames, CRS)
    grid = output_grid(MapPixels(CRS, GSD_M), views, [f.name for f in survey.frames])
    mosaic = compose(frames, by_nearest_nadir(frames, grid), MosaicFiles(tmp_path / "mosaic.tif"))
    given: dict[str, list[Any]] = {}

    class Backwards(AtOnce):
        def map(self, name: str, function: Any, items: Sequence[Any], keys: Sequence[Any]) -> list[Any]:
            given[name] = list(items)
            return super().map(name, function, items[::-1], keys[::-1])[::-1]

    at = frames, grid, mosaic.seamlines
    seams = check_seams(*at, Backwards())
    decoded = [job.frame.name for job in given["seams"]]
    assert len(decoded) == len(set(decoded)) and len(seams.left) > len(decoded) / 2
    again = check_seams(*at)
    assert np.array_equal(seams.displacement_px, again.displacement_px, equal_nan=True)


def test_a_moved_line_is_seen_with_its_sign(tmp_path: Path) -> None:
    """Where the right frame shows the ground minus where the left one does: 1.5 m east is 6 cols, 0.75 m south
    3 rows, between the lines and nowhere else."""
    seams, _ = composed(tmp_path, (1.5, -0.75))
    across = (seams.left < 3) & (seams.right >= 3) & np.isfinite(seams.length_px)
    along = ~((seams.left < 3) & (seams.right >= 3)) & np.isfinite(seams.length_px)
    assert across.sum() >= 2 and along.sum() >= 2
    # The work frame's north is turned against the grid's by the convergence, 0.5 degrees here.
    assert seams.displacement_px[across] == pytest.approx(np.tile([6.0, 3.0], (across.sum(), 1)), abs=0.1)
    assert np.all(seams.length_px[along] < 0.05)


def residuals(mean_px: np.ndarray, noise_px: float, frames: int = 8) -> ImageResiduals:
    """Two hundred points in each frame, each with its cell's mean and noise."""
    rng = np.random.default_rng(4)
    frame = np.repeat(np.arange(frames), 200)
    at = rng.uniform(0.0, [800.0, 600.0], (len(frame), 2))
    cell = (at / [800.0, 600.0] * CELLS).astype(int)
    off = mean_px[cell[:, 1], cell[:, 0]] + rng.normal(0.0, noise_px, at.shape)
    return ImageResiduals(frame, at, off, np.ones(len(frame)))


def test_a_pattern_is_distinguished_from_noise() -> None:
    rows = np.arange(CELLS[1])
    bent = np.zeros((CELLS[1], CELLS[0], 2))
    bent[..., 0] = (rows - 2.5)[:, None]
    (found,) = residual_patterns(residuals(bent, 0.4), [CAMERA] * 8)
    assert found.mean_px[5, 1] == pytest.approx([2.5, 0.0], abs=0.3)
    assert found.systematic_px == pytest.approx(np.sqrt((np.arange(-2.5, 3.0) ** 2).mean()), rel=0.05)
    (none,) = residual_patterns(residuals(np.zeros_like(bent), 0.4), [CAMERA] * 8)
    assert none.systematic_px < 0.4 / np.sqrt(1600 / 48)  # a cell's mean by chance


def test_frames_too_few_for_a_pattern_show_none() -> None:
    shifted = np.full((CELLS[1], CELLS[0], 2), 3.0)
    (found,) = residual_patterns(residuals(shifted, 0.1, frames=3), [CAMERA] * 3)
    assert found.systematic_px == 0.0 and np.isnan(found.mean_px).all()


def outcome(**more: object) -> Adjusted:
    """Five tied frames with all figures good."""
    made_up = {
        "poses": None, "cameras": (CAMERA,) * 5, "status": ("tied",) * 5, "rounds": (), "residuals_m": (),
        "ground": flat_ground(HOME, 100.0, 100.0), "figures": {"sigma_px": 0.4},
        "pose_covariance": np.tile(np.diag([0.3, 0.3, 1.0, 1e-6, 1e-6, 1e-6]) ** 2, (5, 1, 1)),
    }  # fmt: skip
    return Adjusted(**{**made_up, **more})  # type: ignore[arg-type]


def seams_of(*length_px: float) -> SeamCheck:
    n = len(length_px)
    at = np.zeros((n, 2))
    return SeamCheck(
        np.zeros(n, int), np.ones(n, int), at, np.full(n, 9), np.array([[x, 0.0] for x in length_px])
    )


NAN = float("nan")
FIFTHS = dict.fromkeys(range(5), 0.2)
NO_DOUBT = LandDoubt(NAN, NAN, NAN)
UNSTATED = AbsoluteAccuracy(NAN, NAN, "not stated", 0, np.full(3, NAN), np.full(3, NAN))
NOT_STATED = Accuracy(UNSTATED, RelativeAccuracy(NAN, NAN, NAN, NAN))
NOTHING_ASKED = Requirement(NAN, NAN, NAN, "nobody's demand", 0.3)


def judged(
    adjusted: Adjusted,
    seams: SeamCheck = NO_SEAMS,
    parts: tuple[range, ...] = (range(5),),
    doubt: LandDoubt = NO_DOUBT,
) -> Verdict:
    return verdict_of(adjusted, VerdictInputs(seams, (), parts, FIFTHS, doubt), NOT_STATED, NOTHING_ASKED)


def grade(
    adjusted: Adjusted,
    seams: SeamCheck = NO_SEAMS,
    parts: tuple[range, ...] = (range(5),),
    doubt: LandDoubt = NO_DOUBT,
) -> str:
    return judged(adjusted, seams, parts, doubt).grade


def known_to(*sd_m: float) -> Poses:
    """Five level frames with these deviations of their positions."""
    sd = np.broadcast_to(np.reshape(sd_m, (-1, 1)), (5, 3))
    return Poses(np.zeros((5, 3)), np.tile(np.eye(3), (5, 1, 1)), sd, np.zeros((5, 3)))


def test_each_figure_can_spoil_the_verdict() -> None:
    lost = ControlResidual("GCP", False, 4, np.array([0.05, 0.45, 0.0]), np.full(3, 0.1), np.full(3, 0.05))
    shares = np.r_[np.ones(60), np.full(40, 0.01)]
    some = ImageResiduals(np.zeros(100, int), np.zeros((100, 2)), np.zeros((100, 2)), shares)
    assert grade(outcome()) == "good"
    assert grade(outcome(figures={"sigma_px": 1.5})) == "doubtful"
    assert grade(outcome(figures={"sigma_px": 14.7})) == "bad"
    assert grade(outcome(), seams_of(0.2, 0.3, 0.4)) == "good"
    assert grade(outcome(), seams_of(0.2, 2.0, 2.2)) == "doubtful"
    assert grade(outcome(), seams_of(*[0.2] * 8, 9.0, 9.0)) == "doubtful"
    assert grade(outcome(), seams_of(4.0, 5.0, 6.0)) == "bad"
    assert grade(outcome(status=("tied",) * 4 + ("placed",))) == "doubtful"
    assert grade(outcome(status=("tied",) * 2 + ("placed",) * 3)) == "bad"
    assert grade(outcome(poses=known_to(3.0)), parts=(range(3), range(3, 5))) == "bad"
    assert grade(outcome(poses=known_to(0.02)), parts=(range(3), range(3, 5))) == "good"
    mixed = known_to(0.02, 0.02, 0.02, 3.0, 3.0)
    assert grade(outcome(poses=mixed), parts=(range(3), range(3, 5))) == "bad"
    assert grade(outcome(control=(lost,))) == "doubtful"
    assert grade(outcome(image_residuals=some)) == "doubtful"
    assert grade(outcome(), doubt=LandDoubt(0.08, 0.3, 0.05)) == "good"
    assert grade(outcome(), doubt=LandDoubt(0.12, 0.0, 0.05)) == "doubtful"
    assert grade(outcome(), doubt=LandDoubt(0.0, 0.35, 0.0)) == "doubtful"
    assert grade(outcome(), doubt=LandDoubt(0.0, 0.0, 0.15)) == "doubtful"
    assert grade(outcome(warnings=(Warn("scale-doubtful", "", "x"),))) == "doubtful"
    assert grade(outcome(warnings=(Warn("bundle-failed", "", "x"),))) == "bad"


def test_inner_figures_are_noted_and_colour_nothing() -> None:
    """What they do to the map shows in its accuracy and at its seams."""
    found = judged(outcome(figures={"sigma_px": 0.4, "shape_sd_px": 4.0, "sigma_tilt": 9.0}))
    assert found.grade == "good" and found.cause == found.fix == ""
    noted = {e.name: e for e in found.evidence if e.grade == "noted"}
    assert set(noted) == {"shape", "tilts"} and noted["shape"].cause
    shutter = judged(outcome(warnings=(Warn("shutter-doubtful", "", "x"),)))
    assert shutter.grade == "good" and "shutter-doubtful" in {e.name for e in shutter.evidence}


def test_a_requirement_that_is_missed_makes_a_map_doubtful() -> None:
    absolute = replace(UNSTATED, rmse_h_m=0.5, rmse_v_m=0.8, how="estimated")
    stated = Accuracy(absolute, RelativeAccuracy(1.0, 0.1, 0.3, 300.0))
    seen = VerdictInputs(NO_SEAMS, (), (range(5),), FIFTHS, NO_DOUBT)

    def asked(rmse_h_m: float = NAN, rmse_v_m: float = NAN, permille: float = NAN) -> Verdict:
        return verdict_of(
            outcome(), seen, stated, Requirement(rmse_h_m, rmse_v_m, permille, "as asked for", 0.3)
        )

    assert asked(0.5, 0.8, 1.0).grade == "good"
    missed = asked(0.1)
    assert missed.grade == "doubtful" and missed.cause.endswith("(absolute accuracy 50.0 cm RMSE)")
    assert "10.0 cm RMSE, as asked for" in missed.cause and "--gcp" in missed.fix
    assert asked(rmse_v_m=0.7).grade == asked(permille=0.9).grade == "doubtful"


def test_check_points_are_judged_by_their_common_shift() -> None:
    """Within three stated deviations it is what the absolute accuracy says; many points, each with chance."""
    rng = np.random.default_rng(3)

    def shifted(east_m: float) -> Adjusted:
        residuals = rng.normal([east_m, 0.0, 0.0], 0.1, (28, 3))
        point = ControlResidual("c", True, 3, residuals[0], np.full(3, 1.2), np.full(3, 0.02))
        return outcome(control=tuple(replace(point, residual_m=r) for r in residuals))

    assert grade(shifted(2.0)) == "good"
    off = judged(shifted(4.5))
    assert off.grade == "doubtful" and "use them as control points" in off.fix
    honest = rng.normal(0.0, 0.1, (400, 3))
    point = ControlResidual("c", False, 3, honest[0], np.full(3, 0.1), np.full(3, 0.02))
    assert grade(outcome(control=tuple(replace(point, residual_m=r) for r in honest))) == "good"


def test_places_that_show_nothing_say_nothing() -> None:
    assert grade(outcome(), seams_of(np.nan, np.nan)) == "good"


def test_a_few_places_in_woods_condemn_no_map() -> None:
    """The median of 0.4 to 9 px at six of sixty places may be below a pixel; that of sixty such may not."""
    few = (0.4, 0.9, 3.1, 3.4, 5.0, 9.0)
    assert grade(outcome(), seams_of(*few, *[np.nan] * 54)) == "doubtful"
    assert grade(outcome(), seams_of(*few * 10)) == "bad"
    assert grade(outcome(), seams_of(3.1, 3.4)) == "bad"
    assert grade(outcome(), seams_of(3.22, *[np.nan] * 59)) == "doubtful"


def test_the_worst_figure_gives_cause_and_fix() -> None:
    verdict = judged(outcome(figures={"sigma_px": 14.7}), seams_of(1.5))
    assert verdict.cause.endswith("(image deviation 14.70 px)") and verdict.fix
    assert verdict.text == "5 of 5 frames tied, image deviation 14.70 px, seams 1.50 px"
    assert [e.name for e in verdict.evidence if e.grade != "good"][:2] == ["image deviation", "seams"]


def test_land_that_may_be_off_is_reported_even_where_all_is_good() -> None:
    def with_doubt(share: float) -> Verdict:
        return judged(outcome(), doubt=LandDoubt(0.0, 0.0, share))

    assert with_doubt(0.004).text == "5 of 5 frames tied, image deviation 0.40 px"
    some, much = with_doubt(0.07), with_doubt(0.235)
    assert some.grade == "good" and some.text.endswith("7 % of the land may be off by more than 30.0 cm")
    assert (
        much.cause.endswith("(surface unsure 24 %, accuracy.tif shows where)")
        and "--ortho terrain" in much.fix
    )
    assert [e.figure for e in some.evidence if e.name == "surface unsure"] == ["7 %"]


def test_at_a_limit_stands_the_better_grade() -> None:
    limits = CRITERIA["image deviation"].good, CRITERIA["image deviation"].bad
    for px, grades in zip(limits, (("good", "doubtful"), ("doubtful", "bad")), strict=True):
        assert tuple(grade(outcome(figures={"sigma_px": v})) for v in (px, px * 1.001)) == grades


def test_limits_grow_from_good_to_bad_and_have_reasons() -> None:
    assert all(c.good < c.bad and c.reason and c.fix for c in CRITERIA.values())


def test_a_mosaic_by_positions_alone_is_not_called_good(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """0.4 m of noise are four pixels: people can't miss it, in the last lines, in run.json, in the report."""
    size = {"lines": 1, "frames_per_line": 3, "width_px": 320, "height_px": 240}
    survey = small_survey(tmp_path / "survey", **size)
    run = tmp_path / "run"
    assert mosaic(survey.frames, run, "--pos", survey.pos, "--camera", survey.camera, "--adjust", "none") == 0
    run_summary = summary(run)["verdict"]
    assert (
        run_summary["grade"] in ("doubtful", "bad")
        and run_summary["cause"]
        and run_summary["fix"] == run_summary["mend"] != ""
    )
    out = capsys.readouterr().out.splitlines()
    last = ["verdict", "fix", "seams", "relative", "absolute", "required", "open"]
    assert [line.split()[0] for line in out[-7:]] == last
    assert (
        out[-7].startswith(f"verdict    {run_summary['grade']}: ")
        and out[-6] == f"fix        {run_summary['fix']}"
    )
    assert [w["code"] for w in summary(run)["warnings"]].count(f"verdict-{run_summary['grade']}") == 1
    page = (run / "report.html").read_text(encoding="utf-8")
    first = page[page.index("<h1>") :][:600]
    assert {"doubtful": "Doubtful", "bad": "Bad"}[run_summary["grade"]] in first
    json.dumps(run_summary)


def test_evidence_says_what_it_does_to_the_map_and_where() -> None:
    """Jumps of 4 px are 8 cm at 2 cm a pixel; the largest is between the last two frames."""
    seams = SeamCheck(
        np.array([0, 1, 3]),
        np.array([1, 2, 4]),
        np.zeros((3, 2)),
        np.full(3, 9),
        np.array([[0.1, 0.0]] * 2 + [[4.9, 0.0]]),
    )
    names = tuple("abcde")
    seen = VerdictInputs(seams, (), (range(5),), FIFTHS, NO_DOUBT, (), names, 0.02)
    worst, allowed = (
        next(e for e in verdict.evidence if e.name == "worst tenth of the seams")
        for local_m in (0.06, 0.3)
        for verdict in [verdict_of(outcome(), seen, NOT_STATED, replace(NOTHING_ASKED, local_m=local_m))]
    )
    assert allowed.grade == "good"  # 30 cm over 100 m is what GNSS positions give
    assert worst.grade == "doubtful" and worst.effect == "7.9 cm on the ground, most between d and e"
    nowhere = replace(NOTHING_ASKED, local_m=0.06, scaled=False)
    (unscaled,) = (
        e
        for e in verdict_of(outcome(), seen, NOT_STATED, nowhere).evidence
        if e.name == "worst tenth of the seams"
    )
    assert unscaled.effect == "most between d and e"  # the map's unit is no metre
    assert nowhere.length(0.06, 0.02) == "3.0 px"
    lost = replace(outcome(), status=("tied", "placed", "tied", "tied", "tied"))
    verdict = verdict_of(lost, replace(seen, seams=NO_SEAMS), NOT_STATED, NOTHING_ASKED)
    assert verdict.cause.endswith("(frames not tied 20 %, b)")


def test_frames_without_a_place_are_missing() -> None:
    """A public video under water: 12 of 54 frames were left out of a map that was called good."""
    lost = outcome(poses=known_to(1.0), status=("tied", "tied", "tied", "rejected", "rejected"))
    seen = VerdictInputs(
        NO_SEAMS, (), ((0, 1, 2), (3, 4)), {0: 0.4, 1: 0.3, 2: 0.3}, NO_DOUBT, ("not-placed",)
    )
    verdict = verdict_of(lost, seen, NOT_STATED, NOTHING_ASKED)
    assert (verdict.grade, verdict.cause[-22:]) == ("bad", "(frames left out 40 %)")
    among = replace(seen, parts=(range(5),))  # contradicted by their neighbours: these show their ground
    assert verdict_of(lost, among, NOT_STATED, NOTHING_ASKED).grade == "good"


def test_of_two_that_are_bad_the_frames_left_out_are_the_cause() -> None:
    """A stranger's flight: 12 of 18 frames were left out, and the verdict named seams of 5 px alone."""
    seams = seams_of(4.96, 4.96, 4.96)
    lost = outcome(poses=known_to(1.0), status=("tied", "tied", "rejected", "rejected", "rejected"))
    seen = VerdictInputs(seams, (), ((0, 1), (2,), (3,), (4,)), {0: 0.5, 1: 0.5}, NO_DOUBT, ("not-placed",))
    verdict = verdict_of(lost, seen, NOT_STATED, NOTHING_ASKED)
    assert verdict.cause.endswith("(frames left out 60 %)") and "--pos" in verdict.fix
    assert {e.name for e in verdict.evidence if e.grade == "bad"} == {"seams", "frames left out"}
    apart = replace(outcome(poses=known_to(1.0)), status=("tied", "placed", "tied", "tied", "tied"))
    verdict = verdict_of(apart, replace(seen, land={0: 0.5, 1: 0.5}, warned=()), NOT_STATED, NOTHING_ASKED)
    assert verdict.cause.endswith("(frames not tied 50 %)")


def test_frames_count_by_the_land_that_they_give() -> None:
    """A frame without tie points at a corner, half a hundredth of the land, is no fault; a twentieth is."""
    lost = outcome(status=("tied",) * 4 + ("placed",))

    def judged_by(land: float) -> str:
        shares = dict.fromkeys(range(4), (1.0 - land) / 4.0) | {4: land}
        seen = VerdictInputs(NO_SEAMS, (), (range(4),), shares, NO_DOUBT)
        return verdict_of(lost, seen, NOT_STATED, NOTHING_ASKED).grade

    assert [judged_by(land) for land in (0.005, 0.05, 0.4)] == ["good", "doubtful", "bad"]


@pytest.mark.parametrize(("share", "expected"), [(0.4, "good"), (0.6, "doubtful"), (0.95, "bad")])
def test_a_map_of_little_of_what_the_frames_show_is_not_good(share: float, expected: str) -> None:
    """Of two public flights 0 and 13 % of the land was mapped, and the verdict named the rim."""
    trimmed = LeftOutLand(share, "ground extrapolated too far")
    seen = VerdictInputs(NO_SEAMS, (), (range(5),), FIFTHS, NO_DOUBT, trimmed=trimmed)
    verdict = verdict_of(outcome(), seen, NOT_STATED, NOTHING_ASKED)
    assert verdict.grade == expected
    if expected != "good":
        trimmed_for = "most of the land in the frames is trimmed: ground extrapolated too far"
        assert verdict.cause.startswith(trimmed_for)
        assert f"land left out {100.0 * share:.0f} %" in verdict.cause and "--dem" in verdict.fix
    kept = replace(seen, trimmed=replace(trimmed, share=NAN))
    evidence = verdict_of(outcome(), kept, NOT_STATED, NOTHING_ASKED).evidence
    assert "land left out" not in {e.name for e in evidence}


def test_land_left_out_counts_by_the_pixels_of_the_frames(tmp_path: Path) -> None:
    """Six nadir frames; what lies west of their middle is trimmed."""
    survey, poses, ground = make_survey(tmp_path / "frames")
    frames = PosedFrames(survey, poses, [survey.camera_of(i) for i in range(6)], [True] * 6, ground)
    names = [f.name for f in survey.frames]
    owned = by_nearest_nadir(frames, output_grid(MapPixels(CRS, GSD_M), frame_views(frames, CRS), names))
    grid = owned.grid
    middle_m = (grid.west_m + grid.east_m) / 2.0

    def half(west_m: float, east_m: float) -> tuple[tuple[np.ndarray, ...], ...]:
        corners = [
            (west_m, grid.south_m),
            (east_m, grid.south_m),
            (east_m, grid.north_m),
            (west_m, grid.north_m),
        ]
        return ((np.array([*corners, corners[0]]),),)

    part = TrimmedPart("seen too coarsely", 1.0, half(grid.west_m, middle_m))
    trimmed = replace(
        owned, area=Area(half(middle_m, grid.east_m), asked=False), trimmed=Trimmed(2.0, (part,))
    )
    found = left_out_land(frames, trimmed)
    assert found.reason == "seen too coarsely" and found.share == pytest.approx(0.5, abs=0.03)
    assert left_out_land(frames, replace(owned, trimmed=Trimmed(2.0))) == LeftOutLand(0.0)
    assert np.isnan(left_out_land(frames, owned).share), "with --edges keep nothing is left out by choice"


def test_jumps_at_the_seams_come_with_a_fix_that_can_be_done() -> None:
    """Where no other figure is bad, other figures are no help; a matched surface needs no --surface dense."""
    jumps = seams_of(2.0, 2.1, 2.2)
    verdict = judged(outcome(), jumps)
    assert "other figures" not in verdict.fix and "--surface dense" in verdict.fix
    assert "--surface dense" not in judged(outcome(), jumps, doubt=LandDoubt(0.0, 0.0, 0.0)).fix
