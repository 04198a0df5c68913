"""What the benches of speed and scale make of their figures, and how they measure a command."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from quality_images import write_tif

from tools.bench.bench_scale import BLOCKS, growth
from tools.bench.bench_speed_judge import steps_of
from tools.bench.bench_speed_measure import measured
from tools.bench.bench_speed_parts import parts_of
from tools.bench.bench_speed_table import Result, against_floor, behind, missed, side_by_side

OURS = {"wall_s": 20.0, "peak_mb": 900.0, "frames_used": 18.0, "ssim": 0.98}


def test_a_peer_that_is_better_in_one_column_is_reported_and_missed() -> None:
    slower = Result("slower", {"wall_s": 27.0, "peak_mb": 950.0, "frames_used": 18.0, "ssim": 0.97})
    smaller = Result("smaller", {**slower.figures, "peak_mb": 400.0})
    assert behind(OURS, slower.figures) == []
    assert behind(OURS, smaller.figures) == ["memory"]
    assert behind({**OURS, "frames_used": 17.0}, slower.figures) == ["frames used"]
    assert not missed(side_by_side(Result("ours", OURS), [slower]))
    assert missed(side_by_side(Result("ours", OURS), [slower, smaller]))


def test_a_figure_that_only_the_peer_has_is_behind_and_one_that_it_lacks_is_not() -> None:
    assert behind({"wall_s": 1.0}, {"wall_s": 2.0, "ssim": 0.1}) == ["SSIM"]
    assert behind({"wall_s": 1.0, "ssim": 0.1}, {"wall_s": 2.0}) == []
    lines = side_by_side(Result("ours", OURS), [Result("absent", failed="left out: no network")])
    assert lines[-1] == "| absent |  |  |  |  | left out: no network |"
    assert not missed(lines)


def test_the_mosaic_and_the_whole_are_compared_to_the_floor() -> None:
    floor = {"warp_s": 3.0, "cog_s": 5.0, "whole_s": 8.0}
    stages = {"matching.sift": 6.0, "mosaic.seams": 1.0, "mosaic.compose": 6.0, "export.cog": 3.0}
    lines = against_floor(floor, stages, wall_s=19.0, processor_s=30.0, peak_mb=1400.0)
    assert "| mosaic with COG | 10.0 | 1.25 | ok: at most 1.3 |" in lines
    assert "| whole | 19.0 | 2.38 | ok: at most 2.5 |" in lines
    assert not missed(lines)
    assert missed(against_floor(floor, stages, wall_s=21.0, processor_s=30.0, peak_mb=1400.0))
    assert missed(against_floor(floor, stages, wall_s=19.0, processor_s=30.0, peak_mb=1600.0))


def test_growth_is_against_the_least_of_all_smaller_runs() -> None:
    assert growth([0.2, 0.1, 0.11, 0.12]) == pytest.approx(1.2)
    assert growth([0.2]) == 1.0
    assert all(lines * per_line == frames for frames, (lines, per_line) in BLOCKS.items())


def test_a_seam_is_a_step_that_no_frame_shows_however_tones_were_evened() -> None:
    rng = np.random.default_rng(4)
    ground = rng.uniform(40.0, 180.0, (12, 10, 3)).astype(np.float32)
    frames = np.stack([ground * np.float32(0.7), ground * np.float32(1.3)])
    frames[0, :, 7:] = frames[1, :, :3] = np.nan
    odds = np.float32(1.6) * ground / (255.0 - ground)
    for even in (ground, ground + np.float32(20.0), 255.0 * odds / (1.0 + odds)):
        shown = np.stack([ground, ground]) if even is not ground else frames
        assert steps_of(even, shown).max() < 1e-3
    seamed = ground.copy()
    seamed[:, :5] = frames[0, :, :5]
    seamed[:, 5:] = frames[1, :, 5:]
    steps = steps_of(seamed, frames)
    assert len(steps) == 11 * 10 + 12 * 9
    assert (steps > 1.0).sum() == 12, "one for each row that the seam crosses"


def test_mosaics_are_judged_on_the_same_squares_of_ground_which_most_of_them_show(tmp_path: Path) -> None:
    west, north, gsd = 500000.0, 5200000.0, 0.1
    pixels = np.full((1, 640, 960), 7, dtype=np.uint8)
    left, coarse = np.zeros((640, 960), dtype=bool), np.zeros((320, 480), dtype=bool)
    left[:, :500], coarse[:, 100:] = True, True
    ortho = write_tif(tmp_path / "ortho.tif", pixels, west, north, gsd)
    one = write_tif(tmp_path / "one.tif", pixels, west, north, gsd, valid=left)
    other = write_tif(tmp_path / "other.tif", pixels[:, ::2, ::2], west, north, 2 * gsd, valid=coarse)

    def squares(seed: int, number: int = 12):
        return parts_of(ortho, [one, other], number, 64, 1.0, seed)

    found = squares(3)
    cols = (found.middles_m[:, 0] - west) / gsd
    assert len(cols) == 12 and found.side_m == pytest.approx(6.4)
    assert cols.min() - 32 >= 210 and cols.max() + 32 <= 490, "both show them, and a metre off"
    assert np.array_equal(found.middles_m, squares(3).middles_m)
    assert not np.array_equal(found.middles_m, squares(4).middles_m)
    assert len(squares(3, 149).middles_m) == 149 and squares(3, 150) is None
    for fine, half in zip(found.windows(one, 32), found.windows(other, 32), strict=True):
        assert (fine.width, fine.height, half.width, half.height) == (64, 64, 32, 32)
        assert abs(fine.col_off - 2 * half.col_off) <= 32 and abs(fine.row_off - 2 * half.row_off) <= 32
    far = write_tif(tmp_path / "far.tif", pixels, west + 1e4, north, gsd)
    assert found.windows(far, 32) == []
    assert all(w.col_off % 32 == w.row_off % 32 == 0 for w in found.windows(one, 32))


def test_a_command_is_measured_with_what_it_starts_and_stopped_at_its_limits(tmp_path: Path) -> None:
    program = "import time; data = bytearray(100 << 20); time.sleep(2)"
    command = [
        sys.executable,
        "-c",
        f"import subprocess, sys; subprocess.run([sys.executable, '-c', {program!r}])",
    ]
    taken = measured(command, tmp_path / "log")
    assert not taken.failed
    assert taken.wall_s > 1.9
    assert taken.peak_mb > 100.0
    stopped = measured([sys.executable, "-c", "import time; time.sleep(60)"], tmp_path / "log", most_s=0.5)
    assert stopped.failed == "stopped after 0 s"
    refused = measured([sys.executable, "-c", "raise SystemExit('no such thing')"], tmp_path / "log")
    assert refused.failed == "exit code 1: no such thing"
