"""What viewers saved from score forms, gathered by run."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from geomosaic.cli.main import main
from geomosaic.quality.scores import CRITERIA


def saved(path: Path, run: str, viewer: str, overall: int, date: str = "2026-01-01") -> str:
    scores = {c.key: 4 for c in CRITERIA} | {"overall": overall}
    path.write_text(
        json.dumps({"run": run, "viewer": viewer, "date": date, "scores": scores}), encoding="utf-8"
    )
    return str(path)


def test_runs_are_ranked_by_the_mean_opinion_of_their_viewers(tmp_path, capsys):
    files = [
        saved(tmp_path / "1.json", "old", "Ann", 3),
        saved(tmp_path / "2.json", "old", "Ben", 2),
        saved(tmp_path / "3.json", "new", "Ann", 5, "2026-01-02"),
        saved(tmp_path / "4.json", "new", "Ann", 1, "2026-01-01"),
    ]
    assert main(["evaluate", "--scores", *files, "--json"]) == 0
    new, old = json.loads(capsys.readouterr().out)
    assert (new["run"], new["viewers"], new["mean"]["overall"]) == ("new", 1, 5.0), "the later saving counts"
    assert (old["run"], old["viewers"], old["mean"]["overall"], old["mean"]["tone"]) == ("old", 2, 2.5, 4.0)
    assert main(["evaluate", "--scores", *files]) == 0
    head, first, second = capsys.readouterr().out.splitlines()
    assert head.split() == ["run", "viewers", *(c.key for c in CRITERIA)]
    assert first.split() == ["new", "1", "4.00", "4.00", "4.00", "4.00", "5.00"] and second.startswith("old")


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("[1]", "holds no scores"),
        ('{"scores": {"geometry": 6}}', "has no score of 1 to 5 for 'geometry'"),
        ('{"scores": {"geometry": true}}', "has no score of 1 to 5 for 'geometry'"),
        ("{", "no valid JSON"),
        ('{"scores": ' + "9" * 70_000 + "}", "too large"),
    ],
)
def test_other_files_are_one_line(tmp_path, capsys, content, said):
    (tmp_path / "s.json").write_text(content)
    assert main(["evaluate", "--scores", str(tmp_path / "s.json")]) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1 and "s.json" in err and said in err


@pytest.mark.parametrize("asked", [[], ["--scores", "--reference", "x.tif"]])
def test_evaluate_wants_one_thing(capsys, asked):
    assert main(["evaluate", "run", *asked]) == 2
    assert "one of --reference TIF, --surface-reference FILE and --scores" in capsys.readouterr().err
