"""Lenses of which little is known, or of which something wrong is reported, on blocks of known truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from adjustment_blocks import Flown, fly, hills, level

from geomosaic.adjustment.methods import METHODS
from geomosaic.adjustment.model import Adjusted, Block, Settings
from geomosaic.adjustment.procedure.lens_start import lens_notes, with_lens_starts
from geomosaic.camera.interior import Camera
from geomosaic.spread import AtOnce
from geomosaic.survey.accuracy import POSITION

EXIF_SD_M = np.array([3.0, 3.0, 10.0])
FISHEYE = Camera("fish", 800, 600, 380.0, 402.0, 297.0, k1=-0.02, kind="fisheye")
LONG = Camera("long", 800, 600, 1500.0, 402.0, 297.0)


def assumed(flown: Flown, focal_px: float = 680.0, sd: float = 0.5) -> Block:
    """The block as if no lens were reported, or a wrong one."""
    blank = Camera(
        flown.block.cameras[0].name, 800, 600, focal_px, 400.0, 300.0, focal_length_sd_px=sd * focal_px
    )
    return replace(flown.block, cameras=(blank,) * len(flown.block.cameras))


def off(adjusted: Adjusted, true: Camera) -> float:
    """By how many of its deviations the focal length is off."""
    shared = adjusted.shared
    assert shared is not None
    sd_px = shared.sd[shared.names.index("focal_length_px")]
    return float(abs(adjusted.cameras[0].focal_length_px - true.focal_length_px) / sd_px)


@pytest.mark.proof
@pytest.mark.parametrize("lens", [FISHEYE, LONG])
def test_an_assumed_lens_is_found_within_its_deviation(lens: Camera) -> None:
    flown = fly(1, relief=hills, position_sd_m=EXIF_SD_M, lens=lens)
    adjusted = METHODS["bundle"](assumed(flown), Settings())
    assert adjusted.cameras[0].kind == lens.kind
    assert off(adjusted, lens) < 3.0
    assert adjusted.figures["sigma_px"] < 0.35
    assert set(adjusted.status) == {"tied"}


def test_a_fisheye_is_distinguished_from_a_flat_lens_over_flat_land() -> None:
    started = with_lens_starts(
        assumed(fly(2, relief=level, position_sd_m=EXIF_SD_M, lens=FISHEYE)), Settings(), AtOnce()
    )
    (lens,) = started.lenses
    assert lens.kind == "fisheye"
    assert lens.focal_length_px == pytest.approx(380.0, rel=0.15)
    assert lens.focal_length_sd_px == 340.0


@pytest.mark.proof
def test_the_given_start_stays_where_flat_land_does_not_tell_lenses_apart() -> None:
    block = assumed(fly(1, relief=level, position_sd_m=EXIF_SD_M))
    assert with_lens_starts(block, Settings(), AtOnce()) is block


@pytest.mark.proof
def test_a_reported_focal_length_that_the_images_contradict_is_solved_anew() -> None:
    flown = fly(1, relief=hills, position_sd_m=EXIF_SD_M)
    block = assumed(flown, 2600.0, 0.02)
    adjusted = METHODS["bundle"](block, Settings())
    assert adjusted.cameras[0].focal_length_px == pytest.approx(1000.0, rel=0.05)
    assert [w.code for w in lens_notes(block, adjusted.cameras)[1]] == ["focal-length-contradicted"]


class NothingTried(AtOnce):
    def map(self, *_: object) -> list[object]:
        raise AssertionError("lenses are compared")


def test_without_positions_rows_read_one_after_the_other_contradict_no_focal_length() -> None:
    """Rows read at unknown velocities stretch images as another lens does."""
    flown = assumed(fly(1, relief=hills), 2600.0, 0.02)
    nowhere = np.full_like(flown.poses.positions_m, POSITION["none"].sd_horizontal_m)
    cameras = tuple(replace(c, readout_s=0.05) for c in flown.cameras)
    block = replace(flown, cameras=cameras, poses=replace(flown.poses, positions_sd_m=nowhere))
    assert with_lens_starts(block, Settings(), NothingTried()) is block


def test_a_lens_that_is_reported_rightly_stays() -> None:
    block = assumed(fly(1, relief=hills), 1000.0, 0.02)
    assert with_lens_starts(block, Settings(), AtOnce()) is block
    notes, warnings = lens_notes(block, block.cameras)
    assert not notes and not warnings
