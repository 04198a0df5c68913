"""Flights whose positions err in common: separated by pauses, each with an offset of its own."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
import pytest
from adjustment_blocks import fly, frame_terms

from geomosaic.adjustment.methods import METHODS
from geomosaic.adjustment.model import Adjusted, Block, Settings
from geomosaic.adjustment.problem.estimate import Estimate, UnknownLayout
from geomosaic.adjustment.terms.gnss_positions import OFFSET
from geomosaic.adjustment.terms.terrain import level_unknown
from geomosaic.placement.flights import flights_of

OFFSETS_M = np.array([[1.9, -1.2], [-2.2, 0.8]])
FLIGHT = np.array([0, 0, 1, 1, 1])


def test_a_long_pause_parts_two_flights() -> None:
    """Lines with turns of 12 s between frames of 3 s, then a change of battery; not in order of time."""
    first, second = [0.0, 3.0, 6.0, 18.0, 21.0], [300.0, 303.0, 306.0]
    names = [f"DJI_{number:04d}.JPG" for number in (6, 7, 8, 1, 2, 3, 4, 5)]
    assert flights_of(np.array(second + first), names).tolist() == [1, 1, 1, 0, 0, 0, 0, 0]
    slow = np.arange(5) * 50.0 + [0, 0, 0, 90.0, 90.0]
    assert flights_of(slow, names[3:]).tolist() == [0] * 5
    assert flights_of(np.array([0.0, 3.0, np.nan, 900.0]), names[:4]).tolist() == [0] * 4
    assert flights_of(np.zeros(0), []).tolist() == [] and flights_of(np.zeros(1), names[:1]).tolist() == [0]


def test_frames_that_are_not_at_hand_are_no_pause() -> None:
    """An excerpt of a flight with a frame each 6 s. 76 frames lie between the second and the third, by the
    counter in the names and not by the time there."""
    times_s = np.array([0.0, 6.0, 468.0, 474.0, 480.0])
    names = ["IMG_161122_1633{}_{:04d}_RGB.JPG".format(*at) for at in ((40, 12), (46, 13))]
    names += ["IMG_161122_1641{}_{:04d}_RGB.JPG".format(*at) for at in ((28, 90), (34, 91), (40, 92))]
    assert flights_of(times_s, names).tolist() == [0] * 5
    counted_on = [name.replace("_009", "_001").replace("_0010", "_0014") for name in names]
    assert flights_of(times_s, counted_on).tolist() == [0, 0, 1, 1, 1]
    assert flights_of(times_s, ["a.jpg", "b.jpg", "c.jpg", "d.jpg", "e.jpg"]).tolist() == [0, 0, 1, 1, 1]


def test_each_flight_has_its_own_offset() -> None:
    """Reported positions are the true ones and their flight's offset; derivatives belong to it alone."""
    poses = fly(1, 1, 5, points=20).truth
    values = np.array([1.0, 2.0, 3.0, -4.0, 5.0, -6.0])
    moved = replace(poses, positions_m=poses.positions_m + values.reshape(2, 3)[FLIGHT])
    gnss = replace(frame_terms(moved)[0], flight=FLIGHT, lever_arm=False, delay=False)
    layout = UnknownLayout((), level_unknown(1.0), gnss.unknowns())
    assert [name for _, name in layout.names[1:]] == [
        "offset_east_1_m", "offset_north_1_m", "offset_up_1_m", "offset_east_2_m", "offset_north_2_m", "offset_up_2_m",
    ]  # fmt: skip
    none = np.zeros((0, 3)), np.append(0.0, values), np.zeros((5, 0, 3)), np.zeros((5, 3))
    at = Estimate(layout, poses.positions_m, poses.rotations, *none)
    np.testing.assert_allclose(gnss.miss(at), 0.0, atol=1e-12)
    by = dict(gnss.derivatives(at)[1])[OFFSET]
    assert by.shape == (5, 3, 6)
    assert by[1].tolist() == np.hstack([np.eye(3), np.zeros((3, 3))]).tolist()
    assert by[4].tolist() == np.hstack([np.zeros((3, 3)), np.eye(3)]).tolist()


def flown_twice(seed: int) -> tuple[Block, np.ndarray]:
    """Six lines of seven frames, three a flight, with EXIF's deviations; and the true positions."""
    flown = fly(seed, 6, 7, position_sd_m=np.array([0.4, 0.4, 0.8]), points=900)
    block, n = flown.block, len(flown.block.names)
    flight = np.repeat([0, 1], n // 2)
    positions_m = block.poses.positions_m.copy()
    positions_m[:, :2] += OFFSETS_M[flight]
    stated_m = np.tile([5.0, 5.0, 15.0], (n, 1))
    poses = replace(block.poses, positions_m=positions_m, positions_sd_m=stated_m)
    return replace(block, poses=poses, flights=tuple(flight.tolist())), flown.truth.positions_m


def scale_off(adjusted: Adjusted, true_m: np.ndarray) -> float:
    """By how much a block is too large."""
    found, true = (m[:, 0] + 1j * m[:, 1] for m in (adjusted.poses.positions_m, true_m))
    found, true = found - found.mean(), true - true.mean()
    return float(abs(np.vdot(true, found) / np.vdot(true, true)) - 1.0)


def test_two_flights_do_not_stretch_the_block() -> None:
    """By one offset for all, 4 m between two halves of 240 m would; the offsets are found instead."""
    block, true_m = flown_twice(3)
    apart = METHODS["bundle"](block, Settings(model="given", ground="flat"))
    as_one = METHODS["bundle"](replace(block, flights=()), Settings(model="given", ground="flat"))
    assert abs(scale_off(as_one, true_m)) > 6e-3
    assert abs(scale_off(apart, true_m)) < 3e-3
    assert apart.shared is not None
    found = dict(zip(apart.shared.names, apart.shared.found, strict=True))
    between = [found[f"offset_{axis}_2_m"] - found[f"offset_{axis}_1_m"] for axis in ("east", "north")]
    assert between == pytest.approx(OFFSETS_M[1] - OFFSETS_M[0], abs=0.7)
    assert apart.shared.flights_apart_m() == pytest.approx(
        np.linalg.norm(OFFSETS_M[1] - OFFSETS_M[0]), abs=0.7
    )
    assert as_one.shared is not None and as_one.shared.flights_apart_m() == 0.0
    error_m = np.linalg.norm((apart.poses.positions_m - true_m)[:, :2], axis=1)
    assert (error_m < 3.0 * np.linalg.norm(apart.poses.positions_sd_m[:, :2], axis=1)).all()


@pytest.mark.parametrize("apart", [0.5, 2.0, 4.0])
def test_flights_that_differ_by_any_number_of_deviations_do_not_stretch_the_block(apart: float) -> None:
    """By up to five deviations of a difference, which residuals would show as scatter of each position."""
    block, true_m = flown_twice(3)
    stated_m = np.tile([2.0, 2.0, 3.0], (len(block.names), 1))
    off_m = (apart * 2.0 - 1.0) * OFFSETS_M[list(block.flights)]
    positions_m = block.poses.positions_m + np.column_stack([off_m, np.zeros(len(off_m))])
    poses = replace(block.poses, positions_m=positions_m, positions_sd_m=stated_m)
    adjusted = METHODS["bundle"](replace(block, poses=poses), Settings(model="given", ground="flat"))
    assert abs(scale_off(adjusted, true_m)) < 5e-3


def test_rtk_flights_keep_their_positions() -> None:
    """Positions that scatter as stated have nothing in common that they hide."""
    block, true_m = flown_twice(4)
    stated_m = np.tile([0.4, 0.4, 0.8], (len(block.names), 1))
    straight_m = block.poses.positions_m.copy()
    straight_m[:, :2] -= OFFSETS_M[list(block.flights)]
    sharp = replace(block.poses, positions_m=straight_m, positions_sd_m=stated_m)
    adjusted = METHODS["bundle"](replace(block, poses=sharp), Settings(model="given", ground="flat"))
    assert adjusted.shared is not None
    assert adjusted.shared.flights_apart_m() < 0.4
    assert np.abs((adjusted.poses.positions_m - true_m)[:, :2].mean(axis=0)).max() < 0.2


@pytest.mark.parametrize("every_s", [1, 2])
@pytest.mark.parametrize(
    "name", ["DJI_{clock:%Y%m%d%H%M%S}_{number:04d}_V.JPG", "IMG_{clock:%Y%m%d_%H%M%S}.jpg", "{epoch}.jpg"]
)
def test_clocks_in_names_hide_no_pause(name: str, every_s: int) -> None:
    """Ten frames, ten minutes, ten frames."""
    times_s = 1_714_550_400.0 + every_s * np.arange(20) + np.repeat([0.0, 600.0], 10)
    clocks = [datetime.fromtimestamp(t, UTC) for t in times_s]
    names = [
        name.format(clock=clock, number=k + 1, epoch=int(t))
        for k, (clock, t) in enumerate(zip(clocks, times_s, strict=True))
    ]
    assert flights_of(times_s, names).tolist() == np.repeat([0, 1], 10).tolist()
