"""A preview, and a replay of a run onto itself, leave what is there as it is."""

from __future__ import annotations

from pathlib import Path

import pytest
from small_surveys import geomosaic, mosaic, small_survey

from geomosaic.cli.watch import until_all_have_come
from geomosaic.errors import InputError, OutputError
from geomosaic.pipeline.reporter import Silent
from geomosaic.requests.perform import perform
from geomosaic.requests.watch_request import WatchRequest

SIZE = {"lines": 1, "frames_per_line": 3, "width_px": 320, "height_px": 240}


def contents(folder: Path) -> dict[Path, bytes]:
    return {p: p.read_bytes() for p in folder.rglob("*") if p.is_file() and p.name != ".geomosaic.json"}


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """The frames of a survey, and its finished run."""
    folder = tmp_path_factory.mktemp("left alone")
    survey = small_survey(folder / "simulated", **SIZE)
    assert mosaic(survey.frames, folder / "run", "--adjust", "least_squares") == 0
    return survey.frames, folder / "run"


@pytest.mark.parametrize("killed", [False, True])
def test_a_preview_keeps_what_another_run_made(flown: tuple[Path, Path], killed: bool) -> None:
    """Its cache as well, and run.json: the whole run goes on from there, and exports find it."""
    frames, run = flown
    summary = run / "run.json"
    if killed:
        summary.unlink()
    before = contents(run)
    perform(WatchRequest(frames=frames, output=run, adjust="least_squares", workers=1).preview(), Silent())
    after = contents(run)
    changed = {p.relative_to(run).parts[0] for p in before if after.get(p) != before[p]}
    assert changed <= {"preview.html", "work"}
    assert all((run / "work" / name).is_dir() for name in ("mosaic.compose", "export.cog", "mosaic.tones"))
    assert not {p for p in before if "work" in p.parts and p not in after}
    assert summary.exists() is not killed


def test_no_replay_goes_onto_its_own_run(
    flown: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    _, run = flown
    (tmp_path / "latest").symlink_to(run)
    recording = (run / "run.mcap").read_bytes()
    for output in (tmp_path / "latest", run / ".." / "run"):
        assert geomosaic("replay", tmp_path / "latest", "-o", output, "--from", "export.report") == 2
        assert "this is the run to be replayed" in capsys.readouterr().err
    assert (run / "run.mcap").read_bytes() == recording


@pytest.mark.parametrize(
    "wrong",
    [
        {"set": ["mosaic.compose.blnd=hard"]},
        {"edges": "foo"},
        {"adjust": "bundel"},
        {"aoi": "none.gpkg"},
        {"incremental": True},
        {"output": Path("/dev/null")},
    ],
)
def test_watch_names_what_the_whole_run_cannot_use_at_once(tmp_path: Path, wrong: dict[str, object]) -> None:
    (tmp_path / "card").mkdir()
    given = {"frames": tmp_path / "card", "output": tmp_path / "run"} | wrong
    with pytest.raises((InputError, OutputError)):
        until_all_have_come(WatchRequest(**given), quiet=True)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("command", "option"),
    [
        (("inspect", "RUN"), "--png"),
        (("inspect", "RUN"), "--repair"),
        (("diff", "RUN", "RUN"), "--png"),
        (("view", "RUN"), "--save"),
        (("view", "RUN"), "--screenshot"),
    ],
)
def test_a_file_of_others_is_not_replaced(
    few_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], command: tuple[str, ...], option: str
) -> None:
    theirs = tmp_path / "theirs.png"
    theirs.write_text("mine")
    asked = [few_run if word == "RUN" else word for word in command]
    assert geomosaic(*asked, option, theirs) == 2
    assert f"{theirs}: is there already; give another name with {option}" in capsys.readouterr().err
    assert theirs.read_text() == "mine"
