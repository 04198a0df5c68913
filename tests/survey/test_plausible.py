"""Heights, lenses and mosaics that can't be: named, never asked of the memory or the disk."""

from __future__ import annotations

import json
import math
import os
import resource
import shutil
import subprocess
import sys
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from small_surveys import mosaic, small_survey, summary
from survey_files import dji_xmp, exif_block, gps, image, write_jpeg

from geomosaic.camera.exterior import Pose
from geomosaic.camera.interior import Camera
from geomosaic.camera.rotation import Rotation
from geomosaic.composition.estimate import FilledPixels, estimate_scene
from geomosaic.composition.grid import output_grid, stretching, without_flung
from geomosaic.composition.model import MapPixels
from geomosaic.composition.views import FrameView
from geomosaic.errors import InputError
from geomosaic.geodesy.local import LocalFrame
from geomosaic.placement.heights import FrameHeights, with_missing_heights
from geomosaic.projection.ground import flat_ground, node_spacing_m
from geomosaic.survey.exif import Exif
from geomosaic.survey.inputs import SurveyInputs
from geomosaic.survey.model import Position, Warn
from geomosaic.survey.onboard import UNKNOWN_ATTITUDE, onboard_attitude
from geomosaic.survey.plausible import (
    lens_problem,
    plausible_attitudes,
    plausible_positions,
    strange_lenses,
)
from geomosaic.survey.read import read_survey
from geomosaic_simulate.survey import SimulatedSurvey

QUICK = ("--adjust", "least_squares", "--ground-height", 520)
LAT_M = 111_200.0
MEMORY = 2 << 30
"""Bytes of address space beyond what the program's libraries take."""


@pytest.fixture(scope="session")
def flown(tmp_path_factory: pytest.TempPathFactory) -> SimulatedSurvey:
    """Two lines of four frames of 240 x 180, their heights some 570 m."""
    folder = tmp_path_factory.mktemp("flown")
    return small_survey(
        folder, width_px=240, height_px=180, height_above_ground_m=25.0, relative_height_reported=False
    )


def limited(*arguments: object) -> tuple[int, str, float]:
    """A command in a process that may not take more memory: exit code, stderr, peak memory in GB."""

    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_AS, (8 << 30, 8 << 30))
        resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 30, 1 << 30))

    code = (
        "import sys; from geomosaic.cli.main import main; code = main(sys.argv[1:]); "
        "from geomosaic.pipeline.executor import peak_memory_bytes; "
        "print('peak', peak_memory_bytes(), file=sys.stderr); sys.exit(code)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, *map(str, arguments)],
        capture_output=True, text=True, timeout=300, preexec_fn=limit, env=os.environ | {"OMP_NUM_THREADS": "1"},
    )  # fmt: skip
    lines = done.stderr.splitlines()
    peaks = [int(line.split()[1]) for line in lines if line.startswith("peak ")]
    return done.returncode, done.stderr, peaks[0] / 1e9 if peaks else float("nan")


def copied(
    made: SimulatedSurvey, folder: Path, heights: dict[int, object], what: str = "height_ellipsoidal_m"
) -> tuple[Path, Path]:
    """The frames, and a POS file with another height (or what else) in some rows."""
    shutil.copytree(made.frames, folder / "frames")
    assert made.pos is not None
    head, *rows = made.pos.read_text().splitlines()
    column = head.split(",").index(what)
    for i, height in heights.items():
        cells = rows[i].split(",")
        cells[column] = str(height)
        rows[i] = ",".join(cells)
    pos = folder / "pos.csv"
    pos.write_text("\n".join([head, *rows]) + "\n")
    return folder / "frames", pos


def test_a_slip_of_the_decimal_point_is_named(flown: SimulatedSurvey, tmp_path: Path) -> None:
    frames, pos = copied(flown, tmp_path, {2: "616333.1"})
    survey = read_survey(SurveyInputs(frames, pos=pos, camera=flown.camera))
    (warning_found,) = [w for w in survey.warnings if w.code == "height-absurd"]
    assert warning_found.frame == "F0003.jpg" and "616333 m" in warning_found.text


@pytest.mark.proof
def test_a_larger_slip_is_named_and_the_mosaic_is_made(flown: SimulatedSurvey, tmp_path: Path) -> None:
    height = "6163331"
    frames, pos = copied(flown, tmp_path, {2: height})
    code, err, peak_gb = limited(
        "mosaic",
        frames,
        "-o",
        tmp_path / "run",
        "--pos",
        pos,
        "--camera",
        flown.camera,
        "--workers",
        1,
        *QUICK,
    )
    assert code == 0, err
    assert peak_gb < 1.5
    run_summary = {w["code"]: w for w in summary(tmp_path / "run")["warnings"]}
    assert run_summary["height-absurd"]["frame"] == "F0003.jpg"
    assert f"{float(height):g} m" in run_summary["height-absurd"]["text"]
    assert run_summary["height-by-neighbours"]["frame"] == "F0003.jpg"
    assert summary(tmp_path / "run")["frames"]["total"] == 8
    assert summary(tmp_path / "run")["mosaic"]["width"] < 1500


def test_all_heights_absurd_are_refused(
    flown: SimulatedSurvey, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """1e7 m passed without a word."""
    frames, pos = copied(flown, tmp_path, dict.fromkeys(range(8), "1e7"))
    shutil.rmtree(frames)
    shutil.copytree(flown.frames, frames)
    code = mosaic(frames, tmp_path / "run", "--pos", pos, "--camera", flown.camera, *QUICK)
    err = capfd.readouterr().err
    if code == 2:
        assert "no frame has a plausible height" in err and "in metres" in err
    else:  # heights above the ground in the file are left
        assert "height-absurd" in {w["code"] for w in summary(tmp_path / "run")["warnings"]}


def test_a_mosaic_too_large_is_refused_before_it_is_matched(
    flown: SimulatedSurvey, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """By the limit, with the fix; by a frame 10 km off, with its name."""
    options = ("--pos", flown.pos, "--camera", flown.camera, *QUICK)
    small = ("--gsd", 0.03, "--set", "mosaic.seams.max_gigapixels=0.001")
    assert mosaic(flown.frames, tmp_path / "run", *options, *small) == 2
    err = capfd.readouterr().err
    assert "gigapixels at 0.03 m, more than 0.001; frame F000" in err
    assert "--gsd coarser, or --set mosaic.seams.max_gigapixels=1" in err
    assert "Match" not in err

    frames, pos = copied(flown, tmp_path, {3: 9000.0 / LAT_M + 48.1}, "lat_deg")
    assert mosaic(frames, tmp_path / "run", "--pos", pos, *options[2:]) == 2
    err = capfd.readouterr().err
    assert "without frame F0004.jpg: it reaches 9." in err and "check its position, height" in err
    assert "Match" not in err


@pytest.mark.proof
def test_the_estimate_is_reported_and_comes_true(
    flown: SimulatedSurvey, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "run"
    assert mosaic(flown.frames, run, "--pos", flown.pos, "--camera", flown.camera, *QUICK) == 0
    (line,) = [x for x in capfd.readouterr().err.splitlines() if "the mosaic will have about" in x]
    found, estimate = summary(run)["mosaic"], summary(run)["metrics"]["estimate"]
    assert f"{estimate['width_px']:,} x {estimate['height_px']:,} px at 0." in line and "B of memory" in line
    for side in ("width", "height"):
        assert estimate[f"{side}_px"] == pytest.approx(found[side], rel=0.05)
    least, most = estimate["disk_gb"]
    files = {p.stat().st_ino: p.stat().st_size for p in run.rglob("*") if p.is_file()}
    taken = sum(files.values()) / 1e9
    whole_tiles = math.prod(512 * math.ceil(found[side] / 512) / found[side] for side in ("width", "height"))
    assert 0.5 * least < taken < 2.0 * whole_tiles * most, f"of {found}"
    assert not [
        w for w in summary(run)["warnings"] if "absurd" in w["code"] or w["code"].startswith("mosaic-")
    ]


def test_a_surface_takes_its_time_and_room_too(
    flown: SimulatedSurvey, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """Four times the cells, four times as much."""
    reports = []
    for how in ((), ("--surface", "dense"), ("--surface", "dense", "--set", "surface.dense.cell_px=2")):
        asked = ("--pos", flown.pos, "--camera", flown.camera, "--dry-run", "--json", *how)
        assert mosaic(flown.frames, tmp_path / "run", *QUICK, *asked) == 0
        reports.append(json.loads(capfd.readouterr().out)["metrics"]["estimate"])
    for of in (lambda e: e["scratch_gb"], lambda e: e["minutes"][0], lambda e: e["minutes"][1]):
        without, four, two = map(of, reports)
        assert two - without == pytest.approx(4.0 * (four - without)) and four > without


def view(frame: int, east: float, north: float, side_m: float = 100.0) -> FrameView:
    """A level frame of 1000 x 1000 px."""
    pose = Pose(np.array([east, north, 100.0]), Rotation.from_yaw_pitch_roll(0.0, 0.0, 0.0))
    bounds = np.array([east - side_m, north - side_m, east + side_m, north + side_m])
    camera = Camera("c", 1000, 1000, 1000.0, 500.0, 500.0)
    return FrameView(frame, pose, camera, np.array([east, north]), bounds, 0.2)


NAMES = [f"{i}.jpg" for i in range(40)]


def test_a_frame_that_the_adjustment_flings_away_is_left_out() -> None:
    honest_ = [view(i, 50.0 * i, 0.0) for i in range(20)]
    assert without_flung(honest_, 0.2) == (tuple(honest_), ())
    flung = [*honest_[:7], view(7, 3e5, -4e5), *honest_[8:]]
    kept, out = without_flung(flung, 0.2)
    assert [v.frame for v in out] == [7] and len(kept) == 19
    grid = output_grid(MapPixels("EPSG:32632", 0.2), kept, NAMES)
    assert (grid.width_px, grid.height_px) == (5762, 1012), "from whole cells of 16 pixels on"
    many = [view(i, 1e5 * i, 1e5 * i) for i in range(20)]
    assert without_flung(many, 0.2) == (tuple(many), ()), "that is no one frame's fault"
    with pytest.raises(InputError, match="nearly all of it empty"):
        output_grid(MapPixels("EPSG:32632", 0.2), many, NAMES, 1e9)
    wide = [*honest_[:7], view(7, 350.0, 0.0, side_m=9e4), *honest_[8:]]
    with pytest.raises(InputError, match=r"without frame 7\.jpg: it reaches .* and is 180\.0 km wide"):
        output_grid(MapPixels("EPSG:32632", 0.2), wide, NAMES)


def test_a_frame_that_stretches_the_mosaic_is_reported() -> None:
    line = [view(i, 50.0 * i, 0.0) for i in range(8)]
    assert stretching(line, 0.2) is None
    reported = stretching([*line, view(8, 200.0, 4000.0)], 0.2)
    assert (
        reported is not None
        and reported[0].frame == 8
        and reported[1] == pytest.approx(200.0 / 4200.0, rel=0.01)
    )
    assert stretching(line[:3], 0.2) is None


def test_an_honest_big_survey_fits() -> None:
    """A line of 300 km at 0.3 m across a diagonal has to ask; 1,000 km² at 0.1 m have not."""
    block_ = [view(20 * i + j, 1500.0 * i, 1500.0 * j, 900.0) for i in range(20) for j in range(20)]
    big = [replace(v, camera=replace(v.camera, width_px=18000, height_px=18000)) for v in block_]
    assert output_grid(MapPixels("EPSG:32632", 0.1), big, []).width_px == 303_088
    line = [replace(v, bounds_m=v.bounds_m * 2) for v in big]
    with pytest.raises(InputError, match=r"max_gigapixels=3\d\d"):
        output_grid(MapPixels("EPSG:32632", 0.1), line, [f"{i}" for i in range(400)])
    assert output_grid(MapPixels("EPSG:32632", 0.1), line, [], 400.0).height_px == 606_032


def test_a_scene_of_strips_has_the_same_limit() -> None:
    reported = estimate_scene((30_000, 20_000), FilledPixels(0.9, 2), 100.0)
    assert reported.disk_gb[0] == pytest.approx(0.54 * 0.6, rel=0.01)
    on_map = estimate_scene((30_000, 20_000), FilledPixels(0.9, 2), 100.0, on_map=True)
    assert on_map.disk_gb[0] == pytest.approx(0.54 * 4 * 0.6, rel=0.01)
    assert on_map.minutes[0] > reported.minutes[0]
    with pytest.raises(InputError, match="check the strips' sizes"):
        estimate_scene((260_000, 500_000), FilledPixels(1.0, 2), 100.0)


def tagged(folder: Path, focal: Fraction, film_mm: int | None, wrong: int = 1, count: int = 4) -> Path:
    """Frames of one camera, the focal length of the first `wrong` ones as reported."""
    folder.mkdir()
    for i in range(count):
        tags: dict[str, object] = {
            "Make": "X", "Model": "Y", "DateTimeOriginal": f"2024:05:17 10:11:{i:02d}",
            "FocalLength": focal if i < wrong else Fraction("8.8"),
            "FocalPlaneXResolution": Fraction(90), "FocalPlaneResolutionUnit": 3,
            **gps(9.1 + i * 2.7e-4, 48.7, 412.5),
        }  # fmt: skip
        if film_mm is not None:
            tags["FocalLengthIn35mmFilm"] = film_mm
        xmp = dji_xmp(AbsoluteAltitude="+412.50", RelativeAltitude="+80.20")
        block = exif_block(**tags)
        if i < wrong and focal == Fraction(1, 10**7):  # a denominator that Fraction can't hold short enough
            block = block.replace((1).to_bytes(4, "little") + (10**7).to_bytes(4, "little"),
                                  (1).to_bytes(4, "little") + b"\xff\xff\xff\xff")  # fmt: skip
        write_jpeg(folder / f"{i}.jpg", image(120, 80, seed=i), block, xmp)
    return folder


def test_a_focal_length_of_next_to_nothing_is_the_other_frames(tmp_path: Path) -> None:
    survey = read_survey(SurveyInputs(tagged(tmp_path / "a", Fraction(1, 10**7), None)))
    assert [survey.camera_of(i).focal_length_px for i in range(4)] == pytest.approx([79.2] * 4)
    (warning_found,) = [w for w in survey.warnings if w.code == "focal-length-absurd"]
    assert warning_found.frame == "0.jpg" and "px" in warning_found.text and "not given" in warning_found.text
    many = read_survey(SurveyInputs(tagged(tmp_path / "b", Fraction(10**6), None, wrong=2, count=6)))
    (warning_found,) = [w for w in many.warnings if w.code == "focal-length-absurd"]
    assert warning_found.frame == "" and "2 of 6 frames: 0.jpg, 1.jpg" in warning_found.text


@pytest.mark.proof
def test_a_focal_length_of_next_to_nothing_everywhere(tmp_path: Path) -> None:
    """By the 35 mm equivalent; without it the lens is assumed."""
    survey = read_survey(SurveyInputs(tagged(tmp_path / "a", Fraction(1, 10**7), 24, wrong=4)))
    assert survey.camera_of(0).focal_length_px == pytest.approx(24 * np.hypot(120, 80) / np.hypot(36, 24))
    assert [w.code for w in survey.warnings if w.code == "focal-length-absurd"]
    frames = tagged(tmp_path / "b", Fraction(1, 10**7), None, wrong=4)
    code, err, peak_gb = limited("mosaic", frames, "-o", tmp_path / "run", "--workers", 1)
    assert code == 0 and "can't be" in err and "assumed" in err and "--camera" in err and peak_gb < 1.0


@pytest.mark.parametrize(
    "change",
    [
        {"focal_length_px": 1e-6}, {"focal_length_px": 1e9}, {"principal_col_px": 1e6}, {"k1": 1e5},
        {"p2": -30.0}, {"k3": -1e9}, {"readout_s": 1e4},
    ],
)  # fmt: skip
def test_a_lens_that_cannot_be_is_refused_with_its_file(
    flown: SimulatedSurvey, tmp_path: Path, capfd: pytest.CaptureFixture[str], change: dict[str, float]
) -> None:
    camera = {"width_px": 240, "height_px": 180, "focal_length_px": 250.0} | change
    file = tmp_path / "camera.json"
    file.write_text(json.dumps(camera))
    assert mosaic(flown.frames, tmp_path / "run", "--camera", file) == 2
    err = capfd.readouterr().err
    assert str(file) in err and "can't be" in err and not (tmp_path / "run").exists()


def test_lenses_that_there_are() -> None:
    for relative, k1, k2 in ((0.22, 0.0, 0.0), (0.45, -0.3, 0.1), (0.75, 0.2, -0.4), (85.0, 0.0, 0.0)):
        camera = Camera("c", 4000, 3000, relative * 4000, 2040.0, 1490.0, k1=k1, k2=k2, readout_s=-0.164)
        assert lens_problem(camera) == ""
    assert not strange_lenses(np.array([0.7, 0.7, 0.7, 4.9, 4.9, 9.8])).any(), "zoomed"
    assert strange_lenses(np.array([0.7, 0.7, 0.7, 70.0])).tolist() == [False, False, False, True]
    assert not strange_lenses(np.array([0.7, 70.0])).any(), "who is to say"


def positions(east: object, north: object, height: object, above: object = np.nan) -> list[Position]:
    """Positions in metres around 10 E, 46 N."""
    rows = np.broadcast_arrays(*(np.asarray(a, dtype=np.float64) for a in (east, north, height, above)))
    return [
        Position(
            10.0 + e / (LAT_M * np.cos(np.radians(46.0))), 46.0 + n / LAT_M,
            None if np.isnan(h) else float(h), None if np.isnan(a) else float(a), 2.0, 2.0, 3.0, "test",
        )
        for e, n, h, a in zip(*(r.ravel() for r in rows), strict=True)
    ]  # fmt: skip


def block(
    rng: np.random.Generator, lines: int, per_line: int, base_m: float
) -> tuple[np.ndarray, np.ndarray]:
    """East and north of parallel lines, flown to and fro."""
    along = np.concatenate([np.arange(per_line)[:: 1 if k % 2 == 0 else -1] for k in range(lines)]) * base_m
    across = np.repeat(np.arange(lines), per_line) * 2.5 * base_m
    return along + rng.normal(0.0, 1.0, along.size), across + rng.normal(0.0, 1.0, along.size)


def honest(kind: str, rng: np.random.Generator) -> list[Position]:
    """A survey of a kind, as people fly it."""
    lines, per_line = int(rng.integers(1, 9)), int(rng.integers(2, 30))
    base = float(rng.choice([8.0, 30.0, 120.0, 900.0]))
    e, n = block(rng, lines, per_line, base)
    level = float(rng.uniform(-450.0, 5000.0))
    noise = rng.normal(0.0, float(rng.choice([0.02, 2.0, 15.0])), e.size)
    if kind == "drift":
        return positions(
            e, n, level + np.linspace(0.0, rng.uniform(-300.0, 300.0), e.size) + noise, 100.0 + noise
        )
    if kind == "two heights":
        return positions(
            e, n, level + np.where(np.arange(e.size) < rng.uniform() * e.size, 60.0, 120.0) + noise
        )
    if kind == "drone and aircraft":
        e2, n2 = block(rng, 2, 3 + per_line // 2, 5.0 * base)
        h = np.concatenate([np.full(e.size, level + 100.0), np.full(e2.size, level + 3000.0)])
        return positions(np.r_[e, e2], np.r_[n, n2], h)
    if kind == "mountains":
        level = abs(level) + 800.0
        relief = 1200.0 * np.sin(e / 2500.0) * np.cos(n / 2000.0)
        return positions(e, n, level + 150.0 + relief + noise)
    if kind == "plateau":
        return positions(e, n, level + np.where(e > np.quantile(e, 0.9), 1100.0, 0.0) + noise)
    if kind == "long line":
        k = np.arange(int(rng.integers(20, 300)))
        return positions(1000.0 * k * 0.7, 1000.0 * k * 0.7, level + 2000.0 + 800.0 * np.sin(k / 9.0))
    if kind == "crossed":
        return positions(np.r_[e, n], np.r_[n, e], np.r_[level + 80.0 + noise, level + 110.0 + noise])
    if kind == "take-off":
        climb = np.minimum(np.arange(e.size) / 3.0, 1.0) * 2500.0
        return positions(e, n, level + climb)
    if kind == "garbage that is harmless":
        return positions(
            e, n, rng.choice([0.0, 5.4, 6.9, np.nan], e.size), rng.choice([50.0, 0.0, np.nan], e.size)
        )
    return positions(e, n, level + noise, rng.normal(60.0, 10.0, e.size))


KINDS = ("plain", "drift", "two heights", "drone and aircraft", "mountains", "plateau", "long line", "crossed",
         "take-off", "garbage that is harmless")  # fmt: skip


@settings(max_examples=200, deadline=None)
@given(st.sampled_from(KINDS), st.integers(0, 2**32 - 1))
def test_honest_surveys_are_left_alone(kind: str, seed: int) -> None:
    given_ = honest(kind, np.random.default_rng(seed))
    kept, warning_found = plausible_positions([f"{i}.jpg" for i in range(len(given_))], given_)
    assert not warning_found and list(kept) == given_


@settings(max_examples=100, deadline=None)
@given(st.sampled_from(KINDS[:8]), st.integers(0, 2**32 - 1), st.integers(1, 2), st.floats(9.0e3, 1e12))
def test_slips_among_honest_heights_are_found(kind: str, seed: int, count: int, high: float) -> None:
    rng = np.random.default_rng(seed)
    given_ = honest(kind, rng)
    if len(given_) < 8:
        return
    wrong = {int(i) for i in rng.choice(len(given_), count, replace=False)}
    level = float(np.median([p.height_ellipsoidal_m for p in given_ if p.height_ellipsoidal_m is not None]))
    spoilt = [
        replace(p, height_ellipsoidal_m=level + 4.0 * high) if i in wrong else p for i, p in enumerate(given_)
    ]
    kept, warning_found = plausible_positions([f"{i}.jpg" for i in range(len(given_))], spoilt)
    assert {i for i, p in enumerate(kept) if p.height_ellipsoidal_m is None} == wrong
    assert [w.code for w in warning_found] == ["height-absurd"]


@pytest.mark.parametrize("height", [616333.1, 6163331.0, 61633.31, 6163.331, 1e7, 1e300, -61633.0, -6163.0])
def test_a_slip_is_named_with_its_value(height: float) -> None:
    given_ = positions(np.arange(9) * 20.0, 0.0, [616.3] * 4 + [height] + [616.1] * 4, 90.0)
    kept, (warning_found,) = plausible_positions([f"{i}.jpg" for i in range(9)], given_)
    text = f"a height of {height:g} m can't be: taken as not given; correct it with --pos"
    assert warning_found == Warn("height-absurd", "4.jpg", text)
    assert kept[4] == replace(given_[4], height_ellipsoidal_m=None)
    assert kept[:4] + kept[5:] == tuple(given_[:4] + given_[5:])


def test_nothing_usable_left_is_refused() -> None:
    with pytest.raises(InputError, match="no frame has a plausible height"):
        plausible_positions(["a", "b"], positions([0.0, 10.0], 0.0, [1e7, 2e7]))
    kept, warning_found = plausible_positions(["a", "b"], positions([0.0, 10.0], 0.0, [1e7, 2e7], 80.0))
    assert [p.height_above_ground_m for p in kept] == [80.0, 80.0] and "2 of 2" in warning_found[0].text


def test_a_missing_height_lies_between_its_neighbours_and_is_known_as_badly() -> None:
    reported = FrameHeights(np.array([np.nan, 600.0, np.nan, np.nan, 660.0]), np.ones(5))
    heights = with_missing_heights(reported, np.full(5, 500.0))
    assert heights.m == pytest.approx([600.0, 600.0, 620.0, 640.0, 660.0])
    assert heights.sd_m == pytest.approx([44.478, 1.0, 44.478, 44.478, 1.0])
    unknown = with_missing_heights(FrameHeights(np.full(2, np.nan), np.ones(2)), np.zeros(2))
    assert np.isnan(unknown.m).all()


@settings(max_examples=200, deadline=None)
@given(st.floats(0.0, 1e9), st.floats(0.0, 1e9), st.floats(1e-3, 1e4), st.integers(100, 20_000_000))
def test_no_ground_has_more_nodes_than_its_budget(
    width: float, height: float, wanted: float, most: int
) -> None:
    spacing = node_spacing_m([0.0, 0.0], [width, height], wanted, most)
    assert spacing >= wanted
    assert (np.ceil(width / spacing) + 1) * (np.ceil(height / spacing) + 1) <= most
    roomy = (np.ceil(width / wanted) + 2) * (np.ceil(height / wanted) + 2) < 0.9 * most
    assert not roomy or spacing == wanted


@pytest.mark.parametrize("reach_m", [200.0, 30_000.0, 150_000.0])
def test_flat_ground_follows_the_earth_however_far_it_reaches(reach_m: float) -> None:
    home = LocalFrame(11.3, 48.1, 520.0)
    ground = flat_ground(home, 431.5, reach_m)
    assert ground.up_m.size < 260_000
    rng = np.random.default_rng(4)
    en = rng.uniform(-reach_m, reach_m, (500, 2))
    at = np.column_stack([en, ground.up_at(*en.T)])
    assert np.abs(home.geodetic_from_enu(at)[:, 2] - 431.5).max() < 0.02


def test_an_unknown_extent_is_no_ground() -> None:
    with pytest.raises(InputError, match="extent is unknown"):
        node_spacing_m([0.0, np.nan], [1.0, 1.0], 1.0)


def test_cameras_that_look_up_are_named() -> None:
    """A gimbal pitch of +90 is a roll of 180 of a body; a gimbal roll of 180 at the nadir looks down."""
    up = onboard_attitude(Exif(), {"drone-dji:GimbalYawDegree": "20", "drone-dji:GimbalPitchDegree": "90"})
    down = onboard_attitude(
        Exif(),
        {f"drone-dji:Gimbal{a}Degree": v for a, v in (("Yaw", "20"), ("Pitch", "-90"), ("Roll", "180"))},
    )
    rolled = replace(down, roll_deg=178.0)
    level = replace(down, pitch_deg=90.0)
    kept, warnings = plausible_attitudes("abcd", [up, down, rolled, level], UNKNOWN_ATTITUDE)
    assert kept == (up, down, rolled, level)
    (warning,) = warnings
    assert warning.code == "frame-looks-up" and warning.text.endswith("(2 of 4 frames: a, c)")
