"""Rows of a POS file in reverse order turn a map by 180 degrees; the headings show it."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import pytest
from small_surveys import geomosaic, small_survey, summary

from geomosaic_simulate.survey import SimulatedSurvey

STAGES = "survey.read", "matching.flying_height", "projection.ground", "placement.pos", "matching.sift"


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> SimulatedSurvey:
    """Three lines of three frames without tags: by two, or any even number, headings would agree again."""
    return small_survey(tmp_path_factory.mktemp("flown") / "s", lines=3, frames_per_line=3, pos_in="csv")


@pytest.mark.proof
@pytest.mark.parametrize("backwards", [True, False])
def test_rows_in_reverse_order_are_named_once(
    flown: SimulatedSurvey, tmp_path: Path, backwards: bool
) -> None:
    with flown.pos.open(newline="") as file:
        rows = list(csv.DictReader(file))
    column = next(iter(rows[0]))
    names = [row[column] for row in rows]
    pos = tmp_path / "pos.csv"
    with pos.open("w", newline="") as file:
        writer = csv.DictWriter(file, rows[0].keys())
        writer.writeheader()
        for name, row in zip(reversed(names) if backwards else names, rows, strict=True):
            writer.writerow(row | {column: name})
    recipe, run = tmp_path / "match.yaml", tmp_path / "run"
    recipe.write_text(json.dumps({"name": "match", "stages": list(STAGES)}), encoding="utf-8")
    given = "--set", f"survey.read.pos={pos}", "--set", f"survey.read.camera={flown.camera}"
    assert geomosaic("run", recipe, flown.frames, "-o", run, "--workers", 1, *given) == 0
    codes = [w["code"] for w in summary(run)["warnings"]]
    assert codes.count("headings-reversed") == backwards
    assert "frame-turned" not in codes
