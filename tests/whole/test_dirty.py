"""Surveys drawn at random with their faults: what is drawn, that it can be drawn again, and the bench's judge."""

from __future__ import annotations

import json
import re
import shutil
from collections import Counter
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import rasterio
from affine import Affine
from rasterio.windows import Window
from small_surveys import geomosaic

from geomosaic_simulate.dirty import FAULTS, GROUND_SHARES, KIND_SHARES, OVERLAP, dirty_survey
from geomosaic_simulate.survey import landscape_of
from tools.bench import bench_dirty, bench_dirty_judge

TINY = ["--width-px", "96", "--height-px", "72", "--height-above-ground-m", "8", "--ground-pixel-m", "0.1"]
DRAWN = [dirty_survey(seed) for seed in range(1, 301)]


def simulate(out: Path, seed: int, *more: object) -> dict[str, bytes]:
    assert geomosaic("simulate", "frames", out, "--dirty", seed, *TINY, *more) == 0
    return {str(p.relative_to(out)): p.read_bytes() for p in sorted(out.rglob("*")) if p.is_file()}


def test_equal_seeds_draw_equal_surveys_and_others_others(tmp_path: Path) -> None:
    first, again = (simulate(tmp_path / name, 6) for name in "ab")
    assert first == again
    assert len({json.dumps(d.summary()) for d in DRAWN}) == len(DRAWN)
    reported = json.loads(first["truth/dirty.json"])
    drawn = dirty_survey(6)
    assert (reported["seed"], reported["ground"]) == (6, drawn.ground)
    assert reported["faults"] == [{"name": name, "set": values} for name, values in drawn.faults.items()]
    plan = json.loads(first["truth/truth.json"])["plan"]
    for fault in reported["faults"]:
        later = {k for f in reported["faults"][reported["faults"].index(fault) + 1 :] for k in f["set"]}
        assert all(plan[k] == v for k, v in fault["set"].items() if k not in later)
    assert reported["given"] == {
        "width_px": "96",
        "height_px": "72",
        "height_above_ground_m": "8.0",
        "ground_pixel_m": "0.1",
        "without": "[]",
    }
    assert plan["width_px"] == 96


def test_each_fault_is_as_likely_as_its_table_says() -> None:
    counts = Counter(name for d in DRAWN for name in d.faults)
    for fault in FAULTS:
        able = [
            d
            for d in DRAWN
            if d.survey["kind"] in fault.kinds
            and (not fault.needs or fault.needs in d.faults)
            and not set(fault.unless) & (set(d.faults) - {fault.name})
        ]
        sd = np.sqrt(fault.probability * (1.0 - fault.probability) / len(able))
        assert counts[fault.name] / len(able) == pytest.approx(fault.probability, abs=3.5 * sd + 0.01), (
            fault.name
        )
    assert 3.0 < np.mean([len(d.faults) for d in DRAWN]) < 7.0


def test_the_documents_table_is_the_one_that_is_drawn_from() -> None:
    text = (Path(__file__).parents[2] / "docs" / "simulation.md").read_text()
    reported = re.findall(r"^\| `(\w+)` \| ([\d.]+) \|", text, re.MULTILINE)
    assert reported == [(fault.name, f"{fault.probability:g}") for fault in FAULTS]


def test_surveys_are_flown_as_people_fly_them() -> None:
    for shares, drawn in (
        (KIND_SHARES, [d.plan.kind for d in DRAWN]),
        (GROUND_SHARES, [d.ground for d in DRAWN]),
    ):
        for name, share in shares.items():
            assert drawn.count(name) / len(DRAWN) == pytest.approx(share, abs=0.09)
    for d in DRAWN:
        assert 12 <= d.plan.planned_frames <= 30
        assert (640, 480) <= (d.plan.width_px, d.plan.height_px) <= (1000, 750)
        for overlap in (d.plan.forward_overlap, d.plan.side_overlap):
            assert OVERLAP[0] <= overlap <= OVERLAP[1]
        assert d.plan.pos_in == "exif"
        assert (d.plan.relief_m > 0.0) == (d.ground != "flat")


def test_one_fault_more_or_less_leaves_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    name, others = "clouds", [f for f in FAULTS if f.name != "clouds"]
    before = next(d for d in DRAWN if name in d.faults and len(d.faults) > 3)
    monkeypatch.setattr("geomosaic_simulate.dirty.FAULTS", tuple(others))
    after = dirty_survey(before.seed)
    assert after.faults == {k: v for k, v in before.faults.items() if k != name}
    assert after.survey == before.survey
    monkeypatch.undo()
    assert dirty_survey(before.seed, without=[name]).faults == after.faults


def test_a_turned_line_is_a_line_also_behind_take_off_frames() -> None:
    turned = [d for d in DRAWN if "turned_line" in d.faults]
    assert any("take_off" in d.faults for d in turned)
    for d in turned:
        first, last = min(d.plan.turned_frames()), max(d.plan.turned_frames())
        assert (first - d.plan.take_off_frames) % d.plan.frames_per_line == 0
        assert last - first + 1 == len(d.plan.turned_frames()) == d.plan.frames_per_line


@pytest.mark.parametrize(
    ("more", "words"),
    [(["--seed", "3"], "both dirty and a seed"), (["--clouds", "2"], "clouds"), (["--turned", "99"], "turned: '99'"), (["--without", "cloud"], "cloud"),],
)  # fmt: skip
def test_what_can_not_be_drawn_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], more: list[str], words: str
) -> None:
    assert geomosaic("simulate", "frames", tmp_path / "out", "--dirty", 6, *more) == 2
    said = capsys.readouterr().err.strip()
    assert words in said and len(said.splitlines()) == 1
    assert not (tmp_path / "out" / "frames").exists()


def row(**changes: Any) -> dict[str, Any]:
    good = {"kind": "dirty", "placed": True, "exit": 0, "grade": "good", "after_px": 0.5, "jump_px": 1.0,
            "covered": 0.99, "absolute_m": 2.0, "stated_m": 1.0}  # fmt: skip
    return {**good, **changes}


@pytest.mark.parametrize(
    ("changes", "outcome", "missed"),
    [
        ({}, "right", 0),
        ({"grade": "doubtful"}, "right", 0),
        ({"grade": "bad"}, "right called bad", 0),
        ({"after_px": 1.01}, "wrong, not flagged", 1),
        ({"after_px": 1.01, "grade": "none"}, "wrong, not flagged", 1),
        ({"after_px": 1.01, "grade": "doubtful"}, "wrong, flagged", 1),
        ({"after_px": float("nan"), "jump_px": float("nan"), "grade": "bad"}, "wrong, flagged", 2),
        ({"jump_px": 1.6, "absolute_m": 3.1, "covered": 0.8, "grade": "bad"}, "wrong, flagged", 3),
        ({"absolute_m": None, "stated_m": None}, "wrong, not flagged", 1),
        ({"absolute_m": None, "stated_m": None, "placed": False, "covered": None}, "right", 0),
        ({"after_px": None, "jump_px": None}, "wrong, not flagged", 1),
        ({"kind": "plain", "after_px": 0.21}, "wrong, not flagged", 1),
    ],
)  # fmt: skip
def test_the_bench_counts_by_truth_and_not_by_what_a_run_says(
    changes: dict[str, Any], outcome: str, missed: int
) -> None:
    found, reasons = bench_dirty.outcome(row(**changes))
    assert (found, len(reasons)) == (outcome, missed)


def test_without_a_mosaic_there_is_none() -> None:
    assert bench_dirty.outcome({"kind": "dirty", "placed": True, "exit": 1}) == ("no mosaic", ["exit 1"])


def test_the_judge_measures_a_mosaic_without_a_place_once_it_is_georeferenced(tmp_path: Path) -> None:
    """A copy of the ortho turned, shrunk and moved to nowhere, with a step of three pixels in its middle."""
    assert geomosaic(
        "simulate", "frames", tmp_path / "s", "--lines", 1, "--frames-per-line", 2, "--width-px", 400,
        "--height-px", 300, "--height-above-ground-m", 40, "--buildings-stand", "--trees-stand", "--seed", 4,
    ) == 0  # fmt: skip
    with rasterio.open(tmp_path / "s" / "truth" / "ortho.tif") as ortho:
        valid = np.argwhere(ortho.dataset_mask() > 0)
        (top, left), (end, right) = valid.min(axis=0), valid.max(axis=0) + 1
        part = Window(int(left), int(top), int(right - left), int(end - top))
        image, mask = ortho.read(window=part), ortho.dataset_mask(window=part)
        profile = {**ortho.profile, "width": part.width, "height": part.height}
        profile["transform"] = ortho.transform @ Affine.translation(int(left), int(top))
    (tmp_path / "t" / "truth").mkdir(parents=True)
    shutil.copy(tmp_path / "s" / "truth" / "truth.json", tmp_path / "t" / "truth")
    with rasterio.open(tmp_path / "t" / "truth" / "ortho.tif", "w", **profile) as out:
        out.write(image)
        out.write_mask(mask)
    for name, step in (("whole", 0), ("torn", 3)):
        torn = image.copy()
        half = image.shape[2] // 2
        if step:
            torn[:, step:, half:] = image[:, :-step, half:]
        turn = cv2.getRotationMatrix2D((image.shape[2] / 2, image.shape[1] / 2), 25.0, 0.75)
        size = image.shape[2], image.shape[1]
        away = cv2.warpAffine(np.moveaxis(torn, 0, -1), turn, size, flags=cv2.INTER_CUBIC)
        alpha = cv2.warpAffine(mask, turn, size, flags=cv2.INTER_NEAREST)
        path = tmp_path / f"{name}.tif"
        nowhere = {**profile, "count": 4, "photometric": "RGB", "transform": Affine(0.05, 0, 0, 0, -0.05, 0)}
        with rasterio.open(path, "w", **nowhere, ALPHA="YES") as out:
            out.write(np.concatenate([np.moveaxis(away, -1, 0), alpha[None]]))
        found = bench_dirty_judge.of_map(tmp_path / "t", path)
        assert found["aligned"] and found["covered"] > 0.7
        assert found["map_absolute_m"] is None
        assert (found["after_px"] < 0.4) == (not step)
    with rasterio.open(bench_dirty_judge.open_ground(tmp_path / "s")) as judge:
        hidden = (mask > 0).sum() - (judge.dataset_mask() > 0).sum()
    assert 0.01 < hidden / (mask > 0).sum() < 0.95, "what houses and trees may hide isn't judged"


def test_the_judge_hides_crowns_that_wind_moves_and_nothing_beyond_the_bare_ground(tmp_path: Path) -> None:
    """Frames at the rim of the bare ground's raster had made all of the surface beyond it stand 300 m high."""
    folder = tmp_path / "s"
    assert geomosaic(
        "simulate", "frames", folder, "--lines", 1, "--frames-per-line", 2, "--width-px", 400,
        "--height-px", 300, "--height-above-ground-m", 40, "--buildings-stand", "--wind-in-trees-m", 0.2,
        "--relief-m", 8, "--seed", 4,
    ) == 0  # fmt: skip
    plan = bench_dirty_judge.plan_of(folder)
    assert (plan.seed, plan.wind_in_trees_m) == (4, 0.2)
    assert bench_dirty_judge.hidden_by_heights(folder)[0].mean() < 0.5
    with (
        rasterio.open(folder / "truth" / "ortho.tif") as true,
        rasterio.open(bench_dirty_judge.open_ground(folder)) as left,
    ):
        before, after = true.dataset_mask() > 0, left.dataset_mask() > 0
        tree = landscape_of(plan).trees_in(true.bounds)
        col, row = np.floor(~true.transform @ tree[:, :2].T).astype(int)
        inside = (col >= 0) & (col < true.width) & (row >= 0) & (row < true.height)
    assert inside.any() and not after[row[inside], col[inside]].any()
    assert 0.05 * before.sum() < after.sum() < before.sum()
