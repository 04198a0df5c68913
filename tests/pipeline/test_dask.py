"""A run on Dask, its scheduler and workers processes of their own: the same pixels, whoever dies meanwhile."""

from __future__ import annotations

import functools
import importlib
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from pipeline_toy import powered
from small_surveys import map_alone, small_survey

from geomosaic.errors import GeomosaicError, InputError
from geomosaic.pipeline import executor
from geomosaic.pipeline.context import Context
from geomosaic.pipeline.executor import Workers
from geomosaic.pipeline.recipe import Recipe
from geomosaic.pipeline.reporter import Silent
from geomosaic.pipeline.run_options import RunOptions
from geomosaic.pipeline.runner import run
from geomosaic_simulate.survey import SimulatedSurvey
from tools.trials.dask_team import Team, can_hide, dask_team

Client = pytest.importorskip("distributed").Client
RESULTS = ("mosaic.tif", "sources.tif", "positions.csv")


class Striking(Silent):
    """Does something once, when a third of some items is done."""

    def __init__(self, name: str, strike: Callable[[], None]) -> None:
        self.name, self.strike, self.struck = name, strike, False

    def progress(self, done: int, total: int, text: str) -> None:
        """See `Reporter`."""
        if text == self.name and not self.struck and 3 * done >= total:
            self.struck = True
            self.strike()


def flight(folder: Path) -> SimulatedSurvey:
    return small_survey(folder, lines=1, frames_per_line=3, width_px=320, height_px=240, seed=21)


@pytest.fixture(scope="module")
def survey(tmp_path_factory: pytest.TempPathFactory) -> SimulatedSurvey:
    return flight(tmp_path_factory.mktemp("survey"))


@pytest.fixture(scope="module")
def local(survey: SimulatedSurvey, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("local")
    run(recipe(survey), folder, RunOptions(fixed_time=True))
    return folder


@pytest.fixture(scope="module")
def team(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Team]:
    """A cluster that stays; one test kills a worker of two."""
    with dask_team(tmp_path_factory.mktemp("dask"), workers=2) as team:
        yield team


def recipe(survey: SimulatedSurvey) -> Recipe:
    keypoints = {"keypoints": 600}
    return map_alone(
        survey, matching__sift=keypoints, mosaic__seams={"gsd_m": 0.04}
    )  # several blocks of windows


@pytest.mark.proof
def test_a_worker_that_is_killed_leaves_the_pixels_as_they_are(
    team: Team, survey: SimulatedSurvey, local: Path, tmp_path: Path
) -> None:
    striking = Striking("pairs", team.kill)
    run(recipe(survey), tmp_path / "run", RunOptions(dask=team.address, fixed_time=True), reporter=striking)
    assert striking.struck
    for name in RESULTS:
        assert (tmp_path / "run" / name).read_bytes() == (local / name).read_bytes()


@pytest.mark.skipif(not can_hide(), reason="only root may hide folders from workers")
def test_workers_that_see_neither_frames_nor_run_give_the_same_bytes(local: Path, tmp_path: Path) -> None:
    """Each worker has a file system of its own, empty where survey and run lie; one of them is killed."""
    far = tmp_path / "far"
    far.mkdir()
    with dask_team(tmp_path / "dask", workers=2, hidden=far) as team:
        striking = Striking("windows", team.kill)
        options = RunOptions(dask=team.address, fixed_time=True)
        run(recipe(flight(far / "survey")), far / "run", options, reporter=striking)
        assert striking.struck
        with Client(team.address, set_as_default=False) as client:
            kept = client.run(lambda: len(importlib.import_module("geomosaic.pipeline.carrier")._copies))
            assert list(kept.values()) == [0]
    for name in RESULTS:
        assert (far / "run" / name).read_bytes() == (local / name).read_bytes()


def powers(
    team: Team, folder: Path, on_progress: Callable[[int, int, str], None] | None = None
) -> list[float]:
    """Twelve toy items of a twentieth of a second on Dask."""
    with Workers(dask=team.address) as workers:
        context = Context(folder, key="k", workers=workers, on_progress=on_progress)
        work = functools.partial(powered, power=2, delay_s=0.05)
        return context.map("powers", work, [float(i) for i in range(12)])


@pytest.mark.parametrize(
    ("deadly", "words"),
    [
        pytest.param(lambda team: team.kill(), "no Dask worker is left at tcp://", marks=pytest.mark.proof),
        (lambda team: team.scheduler.kill(), "the Dask scheduler at tcp://.* is gone"),
    ],
)
def test_a_cluster_that_is_gone_is_one_line_and_what_is_done_is_kept(
    deadly: Callable[[Team], object],
    words: str,
    team: Team,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    """Without anybody left a run had waited for ever; a dead scheduler was a `CancelledError` after a page of
    Dask's own words."""
    monkeypatch.setattr(executor, "DASK_PATIENCE_S", 1.0)
    with dask_team(tmp_path / "dying", workers=1) as dying:
        striking = Striking("powers", lambda: deadly(dying))
        with pytest.raises(
            GeomosaicError, match=f"{words}.*; start it anew and run again: finished work is kept"
        ):
            powers(dying, tmp_path / "run", striking.progress)
    assert capfd.readouterr().err == ""
    kept = len([p for p in (tmp_path / "run").rglob("items/*/*") if p.is_file()])
    seen: list[int] = []
    found = powers(team, tmp_path / "run", lambda done, *_: seen.append(done))
    assert found == [float(i * i) for i in range(12)] and 4 <= seen[0] == kept < 12


def test_workers_of_another_version_are_refused(team: Team, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(executor, "__version__", "0.0.7")
    with (
        pytest.raises(
            InputError,
            match=r"the worker on .* has geomosaic .*, the run 0\.0\.7; install geomosaic 0\.0\.7 there",
        ),
        Workers(dask=team.address) as workers,
    ):
        workers.result(workers.submit(len, ()))
