"""The model of lens and shutter that tie points left out of the solve speak for."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from adjustment_blocks import fly, hills

from geomosaic.adjustment.methods import METHODS
from geomosaic.adjustment.model import Adjusted, Settings
from geomosaic.adjustment.procedure import cross_validation
from geomosaic.adjustment.procedure.cross_validation import LeftOutTracks, Model, ModelScore
from geomosaic.camera.exterior import Turns
from geomosaic.camera.interior import Camera
from geomosaic.estimation.similarity import fit_similarity
from geomosaic.pipeline.artefacts import encode
from geomosaic.pipeline.executor import Workers
from geomosaic.pipeline.stage import Context
from geomosaic.spread import AtOnce

SHARP = np.array([0.1, 0.1, 0.15])


def at_end(turns: Turns) -> np.ndarray:
    """Of eight frames read in 0.1 s, when the last row is read."""
    return turns.at(np.full(8, 0.05), np.arange(8))[0]


def _bent_m(found_m: np.ndarray, true_m: np.ndarray) -> float:
    """How far positions are off in plan after the best similarity, root mean square."""
    turn, shift = fit_similarity(found_m[:, :2], true_m[:, :2])
    left = true_m[:, :2] @ [1, 1j] - turn * (found_m[:, :2] @ [1, 1j]) - shift
    return float(np.sqrt(np.mean(np.abs(left) ** 2)))


TURNING = {"points": 700, "relief": hills, "readout_s": 0.1, "rate_sd_rad_per_s": 0.2}
"""Eight frames, 0.1 s at 0.2 rad/s: 20 px from the first row to the last, each frame another way."""


def _solved_in_parallel(folder: Path, workers: int) -> Adjusted:
    """The frames of `TURNING` by the model that is chosen, as a run with so many workers solves them."""
    with Workers(workers) as team:
        context = Context(folder, stage_id="adjustment.solve", workers=team, key="a key")
        adjusted = METHODS["bundle"](fly(3, 2, 4, **TURNING).block, Settings(), context)
    assert len(list(folder.rglob("items/*/*"))) >= 3
    return adjusted


class Counted:
    """The names of what is solved and tested."""

    def __init__(self) -> None:
        self.tested: list[str] = []
        self.solved: list[str] = []

    def judged(self, left_out, name, models, solve=cross_validation.solved):  # type: ignore[no-untyped-def]
        """`LeftOutTracks.judged`, counted."""
        (self.tested if solve is cross_validation.tested else self.solved).extend(models)
        return JUDGED(left_out, name, models, solve)


JUDGED = LeftOutTracks.judged


@pytest.fixture(scope="module")
def counted() -> Counted:
    """What is solved and tested for `turning`."""
    return Counted()


@pytest.fixture(scope="module")
def turning(counted: Counted) -> Adjusted:
    """In one process."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(LeftOutTracks, "judged", lambda *arguments: counted.judged(*arguments))
        return METHODS["bundle"](fly(3, 2, 4, **TURNING).block, Settings(), AtOnce())


def test_a_block_with_all_reported_is_solved_as_given() -> None:
    adjusted = METHODS["bundle"](fly(1).block, Settings())
    assert adjusted.model is None or adjusted.model.taken == ()
    assert adjusted.poses.turns is None


@pytest.mark.proof
def test_small_turns_are_found_too() -> None:
    """Vibration of 0.06 rad/s at 8 Hz: residuals of 0.4 px look well, but positions follow it by 0.4 m."""
    flown = fly(
        3,
        2,
        4,
        points=350,
        noise_px=0.05,
        relief=hills,
        readout_s=0.1,
        rate_sd_rad_per_s=0.06,
        shaking_hz=8.0,
    )
    given, chosen = (METHODS["bundle"](flown.block, Settings(model=m)) for m in ("given", "auto"))
    assert given.figures["sigma_px"] < 0.5
    assert chosen.model is not None and chosen.model.taken == ("turning",)
    bent_m = [_bent_m(a.poses.positions_m, flown.truth.positions_m) for a in (given, chosen)]
    assert bent_m[1] < 0.3 * bent_m[0], bent_m


@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.proof)])
def test_gusts_over_all_land_are_not_taken_for_a_camera_that_turns(seed: int) -> None:
    """A camera whose frames turn while they are read would follow 5 to 10 % of them, and the block would bend."""
    flown = fly(seed, 2, 6, points=350, there_and_back=True, gusts_px=2.0)
    adjusted = METHODS["bundle"](flown.block, Settings())
    assert adjusted.model is not None and adjusted.model.taken == ()
    assert adjusted.figures["sigma_px"] > 1.0
    assert not [w for w in adjusted.warnings if w.code in ("model-chosen", "shutter-doubtful")]


@pytest.mark.proof
def test_velocities_that_nobody_reports_are_not_taken_for_frames_that_turn() -> None:
    """Turning frames took up the stretch of an unknown velocity, and left the block's shape open."""
    flown = fly(4, 3, 5, points=500, readout_s=0.05, there_and_back=True)
    poses = replace(flown.block.poses, velocities_m_per_s=np.zeros((15, 3)))
    fixed_scale = METHODS["bundle"](replace(flown.block, poses=poses, times_s=None), Settings())
    nowhere = replace(poses, positions_sd_m=np.full((15, 3), 1e5))
    adjusted = METHODS["bundle"](replace(flown.block, poses=nowhere, times_s=None), Settings())
    assert all(a.model is None or "turning" not in a.model.taken for a in (fixed_scale, adjusted))
    assert not [w for w in fixed_scale.warnings if w.code == "velocity-unknown"]
    (line,) = [w.text for w in adjusted.warnings if w.code == "velocity-unknown"]
    assert "at 10 m/s the map would be stretched by 0.8 % along the lines" in line


@pytest.mark.proof
def test_frames_that_turn_while_they_are_read(turning: Adjusted) -> None:
    flown, adjusted = fly(3, 2, 4, **TURNING), turning
    given = METHODS["bundle"](flown.block, Settings(model="given"))
    assert given.model is None
    assert given.figures["sigma_px"] > 1.2
    assert adjusted.model is not None
    assert adjusted.model.taken == ("turning",)
    assert {"given", "readout", "turning"} <= set(adjusted.model.names)
    assert [w.code for w in adjusted.warnings if "turning in its own way" in w.text] == ["model-chosen"]
    assert adjusted.figures["sigma_px"] < 0.4
    truth = at_end(flown.truth.turns)
    assert np.sqrt(np.mean(truth**2)) > 0.008
    missed = at_end(adjusted.poses.turns) - truth
    assert np.sqrt(np.mean((missed - missed.mean(axis=0)) ** 2)) < 0.002


@pytest.mark.proof
def test_frames_that_shake_while_they_are_read() -> None:
    """Three quarters of a period, 10 px: no constant rate follows it."""
    flown = fly(3, 3, 5, points=500, relief=hills, readout_s=0.1, rate_sd_rad_per_s=0.4, shaking_hz=7.5)
    adjusted = METHODS["bundle"](flown.block, Settings())
    assert adjusted.model is not None
    assert adjusted.model.taken == ("turning",)
    assert adjusted.figures["sigma_px"] < 0.35
    found, truth = (
        np.stack([turns[i].at(np.linspace(-0.05, 0.05, 11))[0] for i in range(15)])
        for turns in (adjusted.poses.turns, flown.truth.turns)
    )
    missed = (found - truth) - (found - truth).mean(axis=0)
    assert np.sqrt(np.mean(truth**2)) > 0.007
    assert np.sqrt(np.mean(missed**2)) < 0.4 * np.sqrt(np.mean(truth**2))


@pytest.mark.parametrize("readout_s", [pytest.param(0.02, marks=pytest.mark.proof), 0.0])
def test_all_images_together_show_a_readout_that_is_below_the_noise_of_each(readout_s: float) -> None:
    """15 m/s and 0.02 s stretch crossing lines by half a percent, which positions and tilts take up but for 0.15 px."""
    flown = fly(7, 4, 6, points=900, crossed=True, readout_s=readout_s)
    silent = tuple(replace(c, readout_s=0.0, readout_sd_s=0.04) for c in flown.block.cameras)
    adjusted = METHODS["bundle"](replace(flown.block, cameras=silent), Settings())
    assert adjusted.figures["sigma_px"] < 0.4
    taken = adjusted.model.taken if adjusted.model is not None else ()
    assert ("readout" in taken) == (readout_s > 0.0)
    assert adjusted.cameras[0].readout_s == pytest.approx(readout_s, rel=0.1)


@pytest.mark.proof
def test_turns_that_are_reported_wrongly_are_not_followed() -> None:
    """As of a unit whose axes are not what they are taken for."""
    flown = fly(5, 2, 4, points=350, readout_s=0.1, relief=hills)
    wild = np.random.default_rng(2).normal(0.0, 0.02, (8, 1, 3)) * np.array([[-1.0], [1.0]])
    poses = replace(flown.block.poses, turns=Turns(0.1, wild))
    adjusted = METHODS["bundle"](replace(flown.block, poses=poses), Settings())
    assert adjusted.model is not None
    assert adjusted.model.taken == ("without_reported_turns",)
    assert adjusted.poses.turns is not None
    assert (
        np.abs(adjusted.poses.turns.rad).max() < 5e-4
    )  # what velocities are off by, of 0.02 that were reported
    assert adjusted.figures["sigma_px"] < 0.4


@pytest.mark.proof
def test_a_fisheye_lens_of_which_nobody_spoke() -> None:
    """Corners at 82 degrees: Brown's terms don't bend a pinhole's image so far."""
    eye = Camera("eye", 1600, 1200, 700.0, 802.0, 597.0, k1=0.01, kind="fisheye")
    flown = fly(6, 2, 3, points=500, relief=hills, lens=eye)
    reported = replace(eye, kind="brown", k1=0.0)
    adjusted = METHODS["bundle"](replace(flown.block, cameras=(reported,) * 6), Settings())
    assert adjusted.model is not None
    assert adjusted.model.taken == ("fisheye",)
    assert adjusted.cameras[0].kind == "fisheye"
    assert adjusted.figures["sigma_px"] < 0.4


@pytest.mark.proof
def test_a_lens_that_its_maker_reports_wrongly() -> None:
    """The corners are off by 14 % of their radius, where the maker says a thousandth."""
    lens = Camera("made", 800, 600, 600.0, 402.0, 297.0, k1=-0.2)
    flown = fly(6, 2, 4, points=500, relief=hills, lens=lens)
    reported = replace(flown.block.cameras[0], k1=0.0, distortion_sd=0.001, focal_length_sd_px=2.0)
    adjusted = METHODS["bundle"](replace(flown.block, cameras=(reported,) * 8), Settings())
    assert adjusted.model is not None
    assert adjusted.model.taken == ("lens",)
    assert adjusted.cameras[0].k1 == pytest.approx(-0.2, abs=0.01)
    assert adjusted.figures["sigma_px"] < 0.4


@pytest.mark.proof
def test_a_readout_without_a_tag_and_with_a_gyroscope() -> None:
    """The turns are reported, the readout time is not: begun at the span of the samples."""
    flown = fly(3, 2, 4, **(TURNING | {"points": 350}))
    poses = replace(flown.block.poses, turns=Turns(0.14, flown.truth.turns.rad * 1.4))
    cameras = tuple(replace(c, readout_s=0.0) for c in flown.block.cameras)
    adjusted = METHODS["bundle"](replace(flown.block, cameras=cameras, poses=poses), Settings())
    assert adjusted.model is not None
    assert adjusted.model.taken == ("readout",)
    assert adjusted.cameras[0].readout_s == pytest.approx(0.1, rel=0.05)
    assert adjusted.figures["sigma_px"] < 0.4


@pytest.mark.proof
def test_the_zero_of_a_gyroscope_is_common_to_all_frames() -> None:
    """0.04 rad/s about the image's right in every frame's turns: taken off as one. (Keypoints good to 0.3 px
    don't tell it in eight frames: it stretches them all by 3 px.)"""
    flown = fly(3, 2, 4, noise_px=0.1, **TURNING)
    zero = np.linspace(-0.05, 0.05, 41)[:, None] * np.array([0.04, 0.0, 0.0])
    poses = replace(flown.block.poses, turns=Turns(0.1, flown.truth.turns.rad - zero))
    adjusted = METHODS["bundle"](replace(flown.block, poses=poses), Settings(model="given", turning=True))
    missed = at_end(adjusted.poses.turns) - at_end(flown.truth.turns)
    assert np.abs(np.median(missed, axis=0)).max() < 0.001
    assert np.abs(missed - np.median(missed, axis=0)).max() < 0.0012
    assert adjusted.figures["sigma_px"] < 0.4


@pytest.mark.proof
def test_what_a_gyroscope_does_not_tell_of_the_last_rows_is_found() -> None:
    """Its last sample is 33 ms old when 0.1 s of rows end: the last rate goes on, of a shake of 7.5 Hz."""
    flown = fly(6, 3, 5, points=500, readout_s=0.1, rate_sd_rad_per_s=0.4, shaking_hz=7.5)
    truth = flown.truth.turns
    assert truth is not None
    reported, last = truth.rad.copy(), 27
    rate = truth.rad[:, last] - truth.rad[:, last - 1]
    reported[:, last:] = truth.rad[:, last, None] + rate[:, None] * np.arange(41 - last)[:, None]
    poses = replace(flown.block.poses, turns=Turns(0.1, reported))
    adjusted = METHODS["bundle"](replace(flown.block, poses=poses), Settings())
    assert adjusted.figures["sigma_px"] < 0.35
    assert (
        np.hypot(adjusted.cameras[0].principal_col_px - 402.0, adjusted.cameras[0].principal_row_px - 297.0)
        < 5.0
    )


@pytest.mark.proof
def test_rows_beyond_the_record_of_a_gyroscope_are_solved_for_and_the_others_taken_as_reported() -> None:
    """Its last sample is 33 ms old when 0.1 s of rows end, and says so. Where the record holds, the solved turns
    are its own to a tenth of a pixel (1e-4 rad); rotations over the whole frame missed it by a pixel."""
    flown = fly(6, 3, 5, points=500, noise_px=0.1, readout_s=0.1, rate_sd_rad_per_s=0.1, shaking_hz=7.5)
    truth = flown.truth.turns
    assert truth is not None
    rad, last = truth.rad.copy(), 27
    rate = truth.rad[:, last] - truth.rad[:, last - 1]
    rad[:, last:] = truth.rad[:, last, None] + rate[:, None] * np.arange(41 - last)[:, None]
    missed = {}
    for name, until_s in (("whole", np.nan), ("tail", (last / 40.0 - 0.5) * 0.1)):
        poses = replace(flown.block.poses, turns=Turns(0.1, rad, np.full(15, until_s)))
        adjusted = METHODS["bundle"](replace(flown.block, poses=poses), Settings(model="given", turning=True))
        found = adjusted.poses.turns
        rows_s = np.linspace(-0.05, 0.05, 21)
        off = np.stack([found[i].at(rows_s)[0] - truth[i].at(rows_s)[0] for i in range(15)])
        missed[name] = np.sqrt(np.mean(off[:, :14, :2] ** 2)), np.sqrt(np.mean(off[:, 14:, :2] ** 2))
    assert missed["tail"][0] < 3e-4 and missed["tail"][1] < 6e-4, missed
    assert missed["tail"][0] < 0.7 * missed["whole"][0], missed


STEADY = {"points": 500, "noise_px": 0.15, "there_and_back": True, "readout_s": 0.03}


@pytest.mark.proof
@pytest.mark.parametrize("rad_per_s", [0.1, 0.02])
def test_turns_that_left_out_points_do_not_show_are_taken_where_rates_are_too_large_for_velocities(
    rad_per_s: float,
) -> None:
    """Shakes at 3.5 Hz over 0.03 s of rows: a rate a frame follows all but 0.05 px of them, and bends the block
    by what it leaves. Those of 0.02 rad/s look like velocities that are 1.2 m/s off."""
    flown = fly(5, 2, 7, rate_sd_rad_per_s=rad_per_s, shaking_hz=3.5, **STEADY)
    given, chosen = (METHODS["bundle"](flown.block, Settings(model=m)) for m in ("given", "auto"))
    assert chosen.model is not None and chosen.model.taken == ("turning",) and chosen.model.shown
    said = [w.text for w in chosen.warnings if w.code == "model-chosen"]
    assert len(said) == 1 and "faster than what is unknown of their velocities" in said[0]
    assert "shutter-doubtful" in {w.code for w in chosen.warnings}
    bent_m = [_bent_m(a.poses.positions_m, flown.truth.positions_m) for a in (given, chosen)]
    assert bent_m[1] < 0.9 * bent_m[0], bent_m


@pytest.mark.proof
def test_no_turns_are_taken_where_there_are_none() -> None:
    steady = METHODS["bundle"](fly(5, 2, 7, **STEADY).block, Settings())
    assert steady.model is None or steady.model.taken == ()


@pytest.mark.proof
def test_what_stands_for_velocities_turns_about_image_axes_and_keeps_the_scale() -> None:
    """Frames do turn here, four times as fast as gusts of 1.5 m/s look; as the model is given nobody asks how.
    A tenth of the height would make of every gust the whole turn."""
    flown = fly(2, 3, 6, points=1200, readout_s=0.1, rate_sd_rad_per_s=0.2)
    adjusted = METHODS["bundle"](flown.block, Settings(model="given"))
    assert adjusted.poses.turns is not None
    rates = np.diff(adjusted.poses.turns.rad, axis=1)[:, 0] / adjusted.poses.turns.span_s
    across, about_sight = np.sqrt((rates**2).mean(axis=0))[[0, 2]]
    assert 0.005 < across < 0.2 and about_sight < 0.1 * across
    assert 0.6 < adjusted.poses.positions_m[:, :2].std() / flown.truth.positions_m[:, :2].std() < 1.2


def test_velocities_that_are_off_are_found() -> None:
    """By 0.4 m/s along the ground, over 0.1 s: 0.4 px over a frame. A rate of turning that stands for it leaves 0.07 px
    along a frame's edges, more than keypoints miss by, and the lens and the block take that up."""
    off = np.random.default_rng(8).normal(0.0, [0.4, 0.4, 0.0], (14, 3))
    way = {"points": 500, "noise_px": 0.02, "there_and_back": True, "readout_s": 0.1}
    flown = fly(8, 2, 7, unreported_m_per_s=off, **way)
    adjusted = METHODS["bundle"](flown.block, Settings(model="given"))
    missed = adjusted.poses.velocities_m_per_s - flown.truth.velocities_m_per_s
    assert np.sqrt(np.mean((missed - missed.mean(axis=0))[:, :2] ** 2)) < 0.15


def test_tracks_of_one_place_are_one_witness() -> None:
    """A richer model that leaves a tenth less in 13 of 20 places and a tenth more in the others may do so by
    chance, however many tracks each has. In 19 of 20 it doesn't."""
    solved = fly(1).block.poses  # that there is a solution counts, not which
    place = np.repeat(np.arange(20), 100)
    other = ModelScore(solved, np.ones(2000), place)  # type: ignore[arg-type]
    for better, sure in ((13, False), (19, True)):
        its = ModelScore(solved, np.where(place < better, 0.9, 1.1), place)  # type: ignore[arg-type]
        assert its.compared_to(other)[0] == 0.9
        assert its.beats(other) is sure


def test_the_model_with_most_unknowns_is_begun_first() -> None:
    """Two workers are done with one of 0.6 s and two of 0.3 s and 0.2 s after 0.6 s, not after 0.8."""
    begun: list[str] = []

    class Apart(AtOnce):
        def map(self, name, function, items, keys=None):  # type: ignore[no-untyped-def]
            begun.extend(keys)
            return [item.settings.model for item in items]

    left_out = object.__new__(LeftOutTracks)
    block = fly(1).block
    left_out._spread, left_out._test = Apart(), None  # type: ignore[assignment]
    left_out._frames = np.arange(len(block.names))
    models = {n: Model(block, Settings(model=n), None) for n in ("auto", "given")}  # type: ignore[arg-type]
    assert left_out.judged("models", models) == {"auto": "auto", "given": "given"}
    assert begun == ["given", "auto"]


@pytest.mark.proof
def test_a_model_that_cannot_win_is_not_solved(turning: Adjusted, counted: Counted) -> None:
    """Frames turn by 20 px: a readout alone and a fisheye gain nothing in the test."""
    assert turning.model is not None and turning.model.taken == ("turning",)
    assert {"readout", "fisheye", "turning"} <= set(counted.tested)
    assert counted.solved == ["given", "turning"]


@pytest.mark.proof
def test_a_large_block_is_compared_on_some_neighbouring_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    """The model that they choose is solved with all frames, and as well as if all had chosen it."""
    monkeypatch.setattr(cross_validation, "MOST_FRAMES", 6)
    flown = fly(3, 2, 5, **TURNING)
    adjusted = METHODS["bundle"](flown.block, Settings())
    assert adjusted.model is not None and adjusted.model.taken == ("turning",)
    assert set(adjusted.status) == {"tied"}
    assert adjusted.figures["sigma_px"] < 0.4


@pytest.mark.proof
def test_models_and_surfaces_side_by_side_are_those_of_one_process(turning: Adjusted, tmp_path: Path) -> None:
    assert encode(_solved_in_parallel(tmp_path, 2)) == encode(turning)
    assert turning.model is not None and turning.model.taken == ("turning",)
