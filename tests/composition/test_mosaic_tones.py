"""Exposure, white balance and vignettes."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from typing import cast

import cv2
import numpy as np
import pytest
import rasterio
from mosaic_scenes import CRS, make_survey
from rasterio.warp import reproject
from small_surveys import MAP_ALONE, made_map

from geomosaic.adjustment.model import Adjusted
from geomosaic.camera.exterior import Poses
from geomosaic.camera.interior import Camera
from geomosaic.composition.hot_spot import SunBehind, hot_spot
from geomosaic.composition.tone_deviations import Exposures
from geomosaic.composition.tone_solution import (
    PICTURE,
    reports_tell,
    solve_tones,
    with_one_level,
    with_own_level,
)
from geomosaic.composition.tones import (
    Sampling,
    Tones,
    ToneSightings,
    evened,
    lattice,
    powers,
    sampled,
)
from geomosaic.composition.views import PosedFrames, frame_views
from geomosaic.errors import InputError
from geomosaic.pipeline.stage import Context
from geomosaic.projection.footprint import ground_from_images
from geomosaic.projection.ground import GroundSurface
from geomosaic.radiometry.quantity import UNCALIBRATED, Quantity, reflectance
from geomosaic.stages.mosaic_tones import mosaic_tones
from geomosaic.survey.model import Band, Survey
from geomosaic_simulate.plan import SurveyPlan
from geomosaic_simulate.survey import simulate_frames

CAMERA = Camera("c", 400, 300, 350.0, 200.0, 150.0)
EVENED = (*MAP_ALONE[:5], "mosaic.tones", *MAP_ALONE[5:])


def sightings(
    seed: int, frames: int = 12, noise: float = 0.03, slope_sd: float = 0.0, dark_middle: float = 0.0
) -> tuple[ToneSightings, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """A line of frames, each seeing the next two's places too; with true gains (n, 3), vignette (2,) and
    slopes (n, 2). The middle may be darker by a cusp, as a lens shading table leaves it."""
    rng = np.random.default_rng(seed)
    ground = rng.uniform(40.0, 160.0, (frames + 2, 60, 3))
    gains = rng.normal(0.0, 0.12, (frames, 3))
    gains -= gains.mean(axis=0)
    vignette, slopes = np.array([-0.18, -0.1]), rng.normal(0.0, slope_sd, (frames, 2))
    place, frame, offset, values = [], [], [], []
    for i in range(frames):
        for k in range(3):
            r, way = np.sqrt(rng.uniform(0.0, 1.0, 60)), rng.uniform(0.0, 2.0 * np.pi, 60)
            off = r[:, None] * np.column_stack([np.cos(way), np.sin(way)])
            fall = r**2 * vignette[0] + r**4 * vignette[1] - dark_middle * np.exp(-r / 0.15)
            light = np.exp(gains[i] + (fall + off @ slopes[i])[:, None])
            place.append((i + k) * 60 + np.arange(60))
            frame.append(np.full(60, i))
            offset.append(off)
            values.append(ground[i + k] * light * np.exp(rng.normal(0.0, noise, (60, 3))))
    flat = np.concatenate(place), np.concatenate(frame), np.concatenate(offset)
    return (
        ToneSightings(
            *flat, np.zeros((len(flat[0]), 2)), np.array([divmod(p, 60) for p in range(60 * (frames + 2))])
        ),
        np.concatenate(values).astype(np.float32),
        gains,
        vignette,
        slopes,
    )


def exposures(frames: int, log_exposure: np.ndarray | float = np.nan) -> Exposures:
    """Of one camera."""
    return Exposures(np.zeros(frames, dtype=np.intp), np.broadcast_to(log_exposure, frames))


def fall_of_light(tones: Tones, away: list[float]) -> np.ndarray:
    """Logarithms (..., 3) at distances from the first frame's middle, over those at the first distance."""
    right = np.array(away, dtype=np.float32)[:, None]
    found = tones.at_offsets(0, right, np.zeros_like(right))
    return found - found[0]


@pytest.mark.parametrize("seed", [1, 2])
def test_gains_of_each_band_and_the_vignette_are_found(seed: int) -> None:
    places, values, gains, vignette, _ = sightings(seed)
    values[::17] *= 1.8  # cars that drove off, and water that shines
    values[5] = np.nan
    tones, evenness = solve_tones(places, values, exposures(12))
    off = tones.gain - gains
    assert np.abs(off - off.mean(axis=0)).max() < 0.03
    np.testing.assert_allclose(fall_of_light(tones, [0.0, 1.0])[1], vignette.sum(), atol=0.03)
    assert evenness.after_median < 0.35 * evenness.before_median


@pytest.mark.parametrize("seed", [3, 4, 5])
def test_a_dark_middle_is_found_where_there_is_one(seed: int) -> None:
    """By the square and its square alone each frame kept a blotch of a third of its light."""
    away = [0.7, 0.4, 0.2, 0.1]
    r = np.array(away)
    for dark, off in ((0.4, 0.06), (0.0, 0.03)):
        places, values, _, vignette, _ = sightings(seed, dark_middle=dark)
        tones, _ = solve_tones(places, values, exposures(12))
        fall = r**2 * vignette[0] + r**4 * vignette[1] - dark * np.exp(-r / 0.15)
        assert fall_of_light(tones, away) == pytest.approx(np.tile((fall - fall[0])[:, None], 3), abs=off)


@pytest.mark.parametrize("seed", [6, 7])
def test_light_that_falls_off_across_each_frame_is_found(seed: int) -> None:
    """As where the sun stands behind the camera on one side. What all frames have in common would be a slope
    of the land."""
    places, values, _, _, slopes = sightings(seed, slope_sd=0.08)
    tones, evenness = solve_tones(places, values, exposures(12))
    off = tones.slope - slopes[:, None]
    assert np.abs(off - off.mean(axis=0)).max() < 0.03
    assert evenness.after_median < 0.35 * evenness.before_median


def test_alike_frames_stay_as_they_are_and_a_block_doesnt_drift() -> None:
    places, values, *_ = sightings(4, frames=60)
    rng = np.random.default_rng(5)
    level = np.repeat(rng.uniform(40.0, 160.0, 62 * 60), 1)
    values = (level[places.place][:, None] * np.exp(rng.normal(0.0, 0.05, (len(places.place), 3)))).astype(
        np.float32
    )
    tones, _ = solve_tones(places, values, exposures(60))
    assert np.abs(tones.gain).max() < 0.04
    trend = np.polyfit(np.arange(60.0), tones.gain.mean(axis=1), 1)[0] * 60.0
    assert abs(trend) < 0.03


def test_the_map_keeps_what_the_exposure_follows_and_loses_what_frames_differ_by() -> None:
    """Frames of 24 x 18 nodes, a quarter of them apart, from a wood (exposed twice as long) to a beach, with
    exposures that scatter by 4 % besides. The last is far away: frames may be scattered over any land."""
    rng = np.random.default_rng(8)
    exposure = np.linspace(0.35, -0.35, 21)
    place, frame, offset, own = [], [], [], []
    for i, gain in enumerate(exposure + rng.normal(0.0, 0.04, 21)):
        row, col = (a.ravel() for a in np.mgrid[:18, :24])
        place.append(np.column_stack([row, col + 6 * i]))
        frame.append(np.full(row.size, i))
        offset.append(np.column_stack([col - 11.5, row - 8.5]) / 15.0)
        own.append(np.full(row.size, gain))
    place[-1] = place[-1] + 10_000_000
    nodes, number = np.unique(np.concatenate(place), axis=0, return_inverse=True)
    flat = number.ravel(), np.concatenate(frame), np.concatenate(offset)
    places = ToneSightings(*flat, np.zeros((len(flat[0]), 2)), nodes)
    gain = np.array([o[0] for o in own])[:, None]
    tones = with_own_level(Tones(gain, np.zeros((21, 1, 2)), np.zeros((21, 1, 2))), places)
    assert tones.level is not None
    level = np.array([powers(*(o[:, [k]] for k in (0, 1))) @ tones.level[i, 0] for i, o in enumerate(offset)])
    column = np.array([p[:, 1] for p in place])
    wanted = np.interp(column, 11.5 + 6.0 * np.arange(21), exposure)
    off = (level - wanted)[2:-3]
    assert np.sqrt((off**2).mean()) < 0.04, "as bright as frames are, nearer than each of them"
    mean = np.bincount(flat[0], level.ravel()) / np.bincount(flat[0])
    assert np.abs(level.ravel() - mean[flat[0]]).max() < 0.01, "alike in all frames"


def test_the_level_stays_as_at_the_edge_beyond_what_a_frame_sees_well() -> None:
    """Sightings of the lower half alone of a frame that brightens downwards: further up, the quadratic that
    fits them would come to anything."""
    row, col = (a.ravel() for a in np.mgrid[9:18, :24])
    offset = np.column_stack([col - 11.5, row - 8.5]) / 15.0
    nodes = np.column_stack([row, col])
    frame = np.zeros(len(row), dtype=np.intp)
    places = ToneSightings(np.arange(len(row)), frame, offset, np.zeros((len(row), 2)), nodes)
    tones = Tones(np.zeros((1, 1)), np.array([[[0.0, 0.4]]]), np.zeros((1, 1, 2)))
    found = with_own_level(tones, places)
    assert found.level_box is not None
    np.testing.assert_allclose(found.level_box[0], [[-11.5 / 15, 0.5 / 15], [11.5 / 15, 8.5 / 15]])
    shown = replace(found, slope=np.zeros((1, 1, 2)))
    right, below = (np.array(of, np.float32)[:, None] for of in ([0.0] * 3, [0.5 / 15, -0.3, -0.6]))
    at = shown.at_offsets(0, right, below)[:, 0]
    np.testing.assert_allclose(at, at[0], atol=1e-6)
    free = replace(shown, level_box=None).at_offsets(0, right, below)[:, 0]
    assert at[0] == pytest.approx(free[0], abs=1e-6) and abs(free[2] - free[0]) > 0.04


@pytest.mark.parametrize("seed", [21, 22])
def test_reported_exposures_keep_a_long_line_of_frames_from_drifting(seed: int) -> None:
    """Exposures that double along the line, reported to 1 %; overlaps alone lose some of it."""
    places, values, gains, _, _ = sightings(seed, frames=40, noise=0.1)
    rng = np.random.default_rng(seed)
    true = np.linspace(-0.35, 0.35, 40)
    values = (values * np.exp(true[:, None] - gains)[places.frame]).astype(np.float32)
    reported = 0.001 * np.exp(true + rng.normal(0.0, 0.01, 40))
    alone, _ = solve_tones(places, values, exposures(40))
    tones, _ = solve_tones(places, values, exposures(40, np.log(reported)))
    off, off_alone = (of.gain - of.gain.mean(axis=0) - true[:, None] for of in (tones, alone))
    assert np.sqrt((off**2).mean()) < 0.6 * np.sqrt((off_alone**2).mean())
    assert reports_tell(tones) and not reports_tell(alone)


def test_exposures_that_say_nothing_of_the_gains_change_nothing() -> None:
    places, values, _, _, _ = sightings(24)
    wrong = np.random.default_rng(24).permutation(np.linspace(-0.5, 0.5, 12))
    alone, _ = solve_tones(places, values, exposures(12))
    tones, _ = solve_tones(places, values, exposures(12, wrong))
    np.testing.assert_allclose(
        tones.gain - tones.gain.mean(axis=0), alone.gain - alone.gain.mean(axis=0), atol=0.02
    )
    assert not reports_tell(tones)


def test_by_one_level_the_brightest_ground_keeps_its_brightness_and_other_ground_its_share_of_it() -> None:
    """Frames exposed twice as long over a wood as over a beach: the map shows the wood half as bright."""
    places, *_ = sightings(25, frames=40)
    reported = np.repeat([[0.0], [-0.7]], 20, axis=0)
    tones = Tones(reported.copy(), np.zeros((40, 1, 2)), np.zeros((40, 1, 2)), reported=reported)
    # one node of the lattice a place: frames see three columns of it, and means go over six
    found = with_one_level(tones, places)
    assert found.level is None
    np.testing.assert_allclose(found.gain[30:], 0.0, atol=0.02)
    np.testing.assert_allclose(found.gain[:10], 0.7, atol=0.02)
    assert with_one_level(replace(tones, reported=None), places).gain is tones.gain


def test_evened_pixels_are_those_that_all_frames_would_show() -> None:
    slope, vignette = np.array([[[0.0, 0.0]], [[0.25, -0.1]]]), np.array([[[0.0, 0.0]], [[-0.2, -0.1]]])
    tones = Tones(np.array([[0.0], [np.log(0.5)]]), slope, vignette)
    pixels = np.array([[[100], [60]]], dtype=np.uint8)
    cols, rows = np.array([[200.0, 400.0]], np.float32), np.array([[150.0, 300.0]], np.float32)
    brighter = tones.brighter(1, CAMERA, cols, rows)
    found = evened(pixels, np.exp(-brighter), np.inf, "float32")
    np.testing.assert_allclose(
        found[0, :, 0], [200.0, 60.0 * 2.0 * np.exp(0.3 - 0.25 * 0.8 + 0.1 * 0.6)], rtol=1e-5
    )
    found = evened(np.full((1, 2, 1), 200, np.uint8), np.exp(-brighter), np.inf, "uint8")
    assert (found.dtype, found.max()) == (np.uint8, 255)
    assert tones.flat(0) and not tones.flat(1)
    assert np.isfinite(tones.brighter(1, CAMERA, np.full_like(cols, np.nan), rows)).all()


@pytest.mark.parametrize("seed", [11, 12])
@pytest.mark.parametrize("bends", [True, False])
def test_frames_say_whether_their_values_bend_towards_white(seed: int, bends: bool) -> None:
    """The same light, drawn along a logistic curve or as it is; gains are those of the light."""
    places, light, gains, _, _ = sightings(seed)
    light = np.minimum(light, 240.0)
    values = 256.0 * light / (90.0 + light) if bends else light
    tones, evenness = solve_tones(places, values.astype(np.float32), exposures(12), PICTURE)
    assert np.isfinite(tones.white) == bends
    off = tones.gain - gains
    assert np.abs(off - off.mean(axis=0)).max() < 0.05
    assert evenness.after_median < 0.45 * evenness.before_median
    assert solve_tones(places, values.astype(np.float32), exposures(12))[0].white == np.inf, "measured values"


def test_what_bends_towards_white_is_never_beyond_it_and_keeps_its_order() -> None:
    grey = np.arange(256, dtype=np.uint8).reshape(1, 256, 1)
    for darker in (0.2, 0.7, 1.0, 1.9, 6.0):
        found = evened(grey, np.full((1, 256, 1), darker, np.float32), 256.0, "float32")[0, :, 0]
        assert found[0] == 0.0 and found[-1] < 256.0 and (np.diff(found) > 0.0).all()
        odds = found[1:] / (256.0 - found[1:])
        np.testing.assert_allclose(odds, darker * np.arange(1, 256) / np.arange(255, 0, -1), rtol=1e-3)
    assert evened(grey, np.ones((1, 256, 1), np.float32), 256.0, "uint8").ravel().tolist() == list(range(256))


@pytest.mark.proof
def test_a_flight_of_uneven_light_becomes_one_tone(tmp_path: Path) -> None:
    """9 real JPEGs with a third of the light lost in the corners and exposures that scatter by 8 %."""
    plan = SurveyPlan(
        seed=3, lines=3, frames_per_line=3, width_px=480, height_px=360, vignetting=0.33, exposure_sd=0.08
    )
    survey = simulate_frames(tmp_path / "flight", plan)
    run, as_they_are = tmp_path / "run", tmp_path / "as_they_are"
    bundle = {"method": "bundle"}
    figures = made_map(survey, run, EVENED, adjustment__solve=bundle)["metrics"]["tones"]["difference_grey"]
    assert figures["before_90"] > 8.0
    assert figures["after_90"] < 2.5
    shutil.copytree(run, as_they_are)  # matched and adjusted
    uncorrected = made_map(
        survey, as_they_are, EVENED, adjustment__solve=bundle, mosaic__tones={"even": "never"}
    )
    assert "tones" not in uncorrected["metrics"]
    spread = [uneven(path / "mosaic.tif", survey.ortho) for path in (run, as_they_are)]
    assert spread[0] < 0.6 * spread[1]


@pytest.mark.proof
@pytest.mark.parametrize("spot", [0.5, 0.0])
def test_the_hot_spot_goes_where_frames_show_one(tmp_path: Path, spot: float) -> None:
    """9 real JPEGs of a wide lens, the sun behind the camera in each: half brighter there, or not at all."""
    plan = SurveyPlan(
        seed=5, lines=3, frames_per_line=3, width_px=480, height_px=360, height_above_ground_m=25.0,
        exposure_sd=0.04, hot_spot=spot, position_sd_m=0.02, height_sd_m=0.02,
    )  # fmt: skip
    survey = simulate_frames(tmp_path / "flight", plan)
    run = tmp_path / "run"
    figures = made_map(survey, run, EVENED)["metrics"]["tones"]
    assert ("hot_spot_log" in figures) == bool(spot)
    assert not spot or figures["hot_spot_width_deg"] == pytest.approx(5.0, rel=0.3)
    assert uneven(run / "mosaic.tif", survey.ortho) < 0.03, "0.05 as the frames are, with the spot"


@pytest.mark.parametrize("seed", [31, 32])
@pytest.mark.parametrize("width_rad", [0.05, 0.087, 0.15])
def test_the_hot_spots_width_and_height_are_found(seed: int, width_rad: float) -> None:
    """Frames that see 45 degrees to each side, with gains, slopes and a vignette besides; the sun stands 25
    degrees off the zenith. Vignettes and slopes absorb more of a wide spot than of a narrow one."""
    tones = solved_with_spot(seed, width_rad, np.full(3, 0.4))
    assert tones.spot is not None
    assert tones.spot_width_rad == pytest.approx(width_rad, rel=0.2)
    np.testing.assert_allclose(tones.spot, 0.4, rtol=0.2)


@pytest.mark.parametrize("logs", [(-0.6, -0.7, -0.5), (0.4, 0.4, -0.2), (1.2, 1.1, 1.2)])
def test_what_shadows_cannot_make_is_no_hot_spot(logs: tuple[float, ...]) -> None:
    """A spot that is dark in a band, or thrice as bright. A sphere of frames taken from one place showed one
    a third as bright as the ground about it: a quarter of its mosaic was burnt out."""
    tones = solved_with_spot(31, 0.15, np.array(logs))
    assert tones.spot is None and tones.away is None


def solved_with_spot(seed: int, width_rad: float, logs: np.ndarray) -> Tones:
    """Of 30 frames with a spot of these heights (3,), by their tones."""
    places, values, _, _, _ = sightings(seed, frames=30, slope_sd=0.05)
    rays = np.column_stack([places.offset, np.ones(len(places.frame))])
    rays /= np.linalg.norm(rays, axis=1)[:, None]
    away = np.tile([0.3, -0.3, 0.9], (30, 1)) / np.linalg.norm([0.3, -0.3, 0.9])
    spot = hot_spot(rays, away[places.frame], width_rad)
    values = (values * np.exp(spot[:, None] * logs)).astype(np.float32)
    return solve_tones(places, values, exposures(30), sun=SunBehind(away[None], rays))[0]


def test_sixteen_bits_tell_their_gains_as_eight_do(tmp_path: Path) -> None:
    """Values beyond 249, which are too bright for an image of eight bits only."""
    gains = [1.0, 0.8, 0.9, 0.7, 1.0, 0.85]
    survey, poses, ground = make_survey(tmp_path, dtype="uint16", gains=gains)
    cameras = [survey.camera_of(i) for i in range(6)]
    views = frame_views(PosedFrames(survey, poses, cameras, [True] * 6, ground), CRS)
    places = lattice(views, CRS, survey.work_frame, ground)
    values = np.full((len(places.frame), survey.frames[0].bands), np.nan, np.float32)
    for i, frame in enumerate(survey.frames):
        mine = places.frame == i
        values[mine] = sampled(Sampling(frame, places.image_px[mine])).values
    assert np.nanmedian(values) > 1000.0
    tones, _ = solve_tones(places, values, exposures(6))
    true = np.log(gains) - np.log(gains).mean()
    off = tones.gain - tones.gain.mean(axis=0) - true[:, None]
    assert np.abs(off).max() < 0.03


def test_a_frame_that_sees_far_more_land_is_sampled_at_fewer_nodes(tmp_path: Path) -> None:
    """Twenty times as high, it saw 480 nodes a side; of a frame over a pit two million filled the memory."""
    survey, poses, ground = make_survey(tmp_path, lines=1, per_line=3)
    at_m = poses.positions_m.copy()
    at_m[2, 2] += 19.0 * (at_m[2, 2] - float(np.median(ground.up_m)))
    poses = replace(poses, positions_m=at_m)
    cameras = [survey.camera_of(i) for i in range(3)]
    views = frame_views(PosedFrames(survey, poses, cameras, [True] * 3, ground), CRS)
    places = lattice(views, CRS, survey.work_frame, ground)
    its = places.frame == 2
    assert 8_000 < its.sum() < (8 * 24) ** 2
    assert (places.nodes[places.place[its]] % 3 == 1).all()
    both, low, high = np.intersect1d(places.place[~its], places.place[its], return_indices=True)
    assert len(both) > 50
    seen_m = [
        ground_from_images(places.frame[mine][which], places.image_px[mine][which], poses, cameras, ground)
        for mine, which in ((~its, low), (its, high))
    ]
    assert np.abs(seen_m[0] - seen_m[1]).max() < 0.02


def test_a_rigs_bands_are_not_evened_by_one_bands_tones(tmp_path: Path) -> None:
    survey, poses, ground = make_survey(tmp_path, lines=1, per_line=2, bands=1)
    with_band = replace(survey, other_bands=(Band("NIR", 790.0, survey.camera_of(0), survey.frames),))
    stage, nobody = mosaic_tones(), cast(Context, None)
    asked = {"survey": with_band, "ground": None, "adjusted": adjusted(survey, poses, ground)}
    with pytest.raises(InputError, match=r"leave out --set mosaic\.tones\.even"):
        stage.run(asked, mosaic_tones.Params(even="always"), nobody)
    tones = stage.run(asked, mosaic_tones.Params(), nobody)["tones"]
    assert not tones.gain.any() and not tones.vignette.any()


@pytest.mark.parametrize(
    ("status", "quantity", "named"),
    [
        ("tied", None, "(NIR by a factor of 6.2)"),
        ("tied", UNCALIBRATED, "(NIR by a factor of 6.2)"),
        ("tied", reflectance("panel", absolute=True), ""),
        ("rejected", UNCALIBRATED, ""),
    ],
)
def test_a_rig_that_exposes_its_frames_differently_is_named(
    tmp_path: Path, status: str, quantity: Quantity | None, named: str
) -> None:
    """A Parrot Sequoia: NIR from 1/2281 s to 1/370 s, green within a tenth; a file is missing."""
    survey, poses, ground = make_survey(tmp_path / "frames", lines=1, per_line=4, bands=1)
    greens, nirs = (1.0, 1.08, 1.04, 1.0), (1 / 2281, 1 / 2281, 1 / 2100, 1 / 370)
    green, nir = (
        tuple(replace(f, exposure=e) for f, e in zip(survey.frames, exposures, strict=True))
        for exposures in (greens, nirs)
    )
    rig = replace(
        survey,
        frames=green,
        band="Green",
        quantity=quantity,
        other_bands=(Band("NIR", 790.0, survey.camera_of(0), (None, *nir[1:]), quantity),),
    )
    found = replace(adjusted(survey, poses, ground), status=("tied", "tied", "tied", status))
    context = Context(tmp_path / "run")
    asked = {"survey": rig, "ground": ground, "adjusted": found}
    mosaic_tones().run(asked, mosaic_tones.Params(), context)
    warnings = [(w["code"], w["text"]) for w in context.notes.warnings]
    if not named:
        assert warnings == []
        return
    ((code, text),) = warnings
    assert code == "exposure-varies" and named in text and "--radiometry reflectance" in text


def adjusted(survey: Survey, poses: Poses, ground: GroundSurface) -> Adjusted:
    """Frames that are right as they were placed."""
    n = len(survey.frames)
    return Adjusted(poses, (survey.camera_of(0),) * n, ("tied",) * n, (), (), ground)


def uneven(found: Path, true: Path) -> float:
    """Standard deviation of the logarithm of how much brighter a mosaic is than the truth, over some metres."""
    with rasterio.open(found) as m, rasterio.open(true) as t:
        ours, valid = m.read(2).astype(np.float32), m.dataset_mask() > 0
        theirs = np.zeros_like(ours)
        reproject(rasterio.band(t, 2), theirs, dst_transform=m.transform, dst_crs=m.crs)
    valid &= theirs > 0
    ours, theirs = (cv2.blur(np.where(valid, p, 0.0), (41, 41)) for p in (ours, theirs))
    return float(np.log(ours[valid] / theirs[valid]).std())
