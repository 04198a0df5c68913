"""What is done is not done again: after kill -9 at any moment, after new frames, after a disk that was full."""

from __future__ import annotations

import itertools
import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from small_surveys import MAP_ALONE, small_survey

from geomosaic.errors import FileError, OutputError
from geomosaic.pipeline.recipe import Recipe
from geomosaic.pipeline.reporter import Silent
from geomosaic.pipeline.run_options import RunOptions
from geomosaic.pipeline.runner import run
from geomosaic.requests.run_request import recipe_of
from geomosaic_simulate.survey import SimulatedSurvey

RESULTS = ("mosaic.tif", "sources.tif", "positions.csv")


class ItemCounter(Silent):
    """How many items of each name were there from before, of how many, and how many are; strikes once when half
    of some are done."""

    def __init__(self, at: str = "", strike: Callable[[], object] | None = None) -> None:
        self.found: dict[str, tuple[int, int]] = {}
        self.done: dict[str, int] = {}
        self._at, self._strike, self._stage = at, strike, ""

    def stage_started(self, index: int, total: int, name: str) -> None:
        """See `Reporter`."""
        self._stage = name

    def progress(self, done: int, total: int, text: str) -> None:
        """See `Reporter`."""
        name = f"{self._stage}: {text}"
        self.found.setdefault(name, (done, total))
        self.done[name] = done
        if text == self._at and 2 * done >= total and self._strike is not None:
            strike, self._strike = self._strike, None
            strike()


def recipe(frames: Path, camera: Path) -> Recipe:
    given = {
        "survey.read": {"frames": frames, "camera": camera},
        "matching.sift": {"keypoints": 600},
        "mosaic.seams": {"gsd_m": 0.04},  # several blocks of windows
        "adjustment.solve": {"method": "least_squares"},
    }
    return recipe_of(("map", ""), MAP_ALONE, given)


def die(frames: str, camera: str, to: str, at: str, tell: str) -> None:
    """In a process of its own: a run that is killed when half of some items are done."""

    def strike() -> None:
        Path(tell).write_text(json.dumps([counting.found, counting.done]))
        os.kill(os.getpid(), signal.SIGKILL)

    counting = ItemCounter(at, strike)
    run(recipe(Path(frames), Path(camera)), Path(to), RunOptions(fixed_time=True), reporter=counting)


@pytest.fixture(scope="module")
def survey(tmp_path_factory: pytest.TempPathFactory) -> SimulatedSurvey:
    return small_survey(
        tmp_path_factory.mktemp("survey"), lines=2, frames_per_line=3, width_px=320, height_px=240, seed=21
    )


@pytest.fixture(scope="module")
def fresh(survey: SimulatedSurvey, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("fresh")
    run(recipe(survey.frames, survey.camera), folder, RunOptions(fixed_time=True))
    return folder


def assert_same(one: Path, other: Path) -> None:
    for name in RESULTS:
        assert (one / name).read_bytes() == (other / name).read_bytes()


def test_a_killed_run_goes_on_where_it_was(survey: SimulatedSurvey, fresh: Path, tmp_path: Path) -> None:
    """Four times in a row; nothing that was finished is made again, and the result is a fresh run's."""
    given = (survey.frames, survey.camera)
    reports, moments = [], ("keypoints", "pairs", "frames on the map", "windows")
    for at in moments:
        code = "import sys; from test_resume import die; die(*sys.argv[1:])"
        words = [str(word) for word in (*given, tmp_path / "run", at, tmp_path / at)]
        environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
        ended = subprocess.run([sys.executable, "-c", code, *words], env=environment, capture_output=True)
        assert ended.returncode == -signal.SIGKILL, ended.stderr.decode()
        reports.append(json.loads((tmp_path / at).read_text()))
    counting = ItemCounter()
    run(recipe(*given), tmp_path / "run", RunOptions(fixed_time=True), reporter=counting)
    runs = itertools.pairwise([*reports, [counting.found, counting.done]])
    for moment, ((_, done), (found, _)) in zip(moments, runs, strict=True):
        (at,) = (name for name in done if name.endswith(f": {moment}"))
        assert 0 < done[at] == found[at][0] < found[at][1]
        begun = (done.keys() & found.keys()) - {": reading inputs"}  # the others' stages are finished
        assert {name: found[name][0] for name in begun} == {name: done[name] for name in begun}
    assert_same(tmp_path / "run", fresh)


@pytest.mark.proof
def test_new_frames_bring_their_own_work_alone(survey: SimulatedSurvey, fresh: Path, tmp_path: Path) -> None:
    frames = tmp_path / "frames"
    frames.mkdir()
    names = sorted(path.name for path in survey.frames.glob("*.jpg"))
    for name in names[:-2]:
        shutil.copy2(survey.frames / name, frames / name)
    run(recipe(frames, survey.camera), tmp_path / "run", RunOptions(fixed_time=True))
    for name in names[-2:]:
        shutil.copy2(survey.frames / name, frames / name)
    counting = ItemCounter()
    run(recipe(frames, survey.camera), tmp_path / "run", RunOptions(fixed_time=True), reporter=counting)
    for name in ("Read the survey: looking for damage", "Match frames with SIFT: keypoints"):
        assert counting.found[name] == (4, 6)
    assert counting.found["Match frames with SIFT: pairs"] == (6, 15)
    assert_same(tmp_path / "run", fresh)


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    folder = tmp_path / "small"
    folder.mkdir()
    mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=64m", "tmpfs", folder], capture_output=True)
    if mounted.returncode:
        pytest.skip("a small tmpfs can't be mounted here")
    yield folder
    subprocess.run(["umount", "--lazy", folder], check=True)


def test_a_disk_that_fills_while_composing_is_one_line_and_costs_nothing_done(
    survey: SimulatedSurvey, fresh: Path, small_disk: Path
) -> None:
    ballast = small_disk / "ballast"

    def fill() -> None:
        left = os.statvfs(small_disk)
        ballast.write_bytes(bytes(left.f_bavail * left.f_frsize - 20_000))

    filled = ItemCounter("frames on the map", fill)
    with pytest.raises(OutputError, match="no space left on the disk; free some or choose another output"):
        run(
            recipe(survey.frames, survey.camera),
            small_disk / "run",
            RunOptions(fixed_time=True),
            reporter=filled,
        )
    ballast.unlink()
    counting = ItemCounter()
    run(
        recipe(survey.frames, survey.camera),
        small_disk / "run",
        RunOptions(fixed_time=True),
        reporter=counting,
    )
    at = "Compose the mosaic: frames on the map"
    assert 0 < filled.done[at] == counting.found[at][0] < counting.found[at][1]
    assert_same(small_disk / "run", fresh)


def test_a_frame_that_vanishes_is_named_and_costs_nothing_done(
    survey: SimulatedSurvey, fresh: Path, tmp_path: Path
) -> None:
    frames = tmp_path / "frames"
    shutil.copytree(survey.frames, frames)
    last = sorted(frames.glob("*.jpg"))[-1]
    vanished = ItemCounter("keypoints", last.unlink)
    with pytest.raises(FileError, match=last.name):
        run(recipe(frames, survey.camera), tmp_path / "run", RunOptions(fixed_time=True), reporter=vanished)
    shutil.copy2(survey.frames / last.name, last)
    counting = ItemCounter()
    run(recipe(frames, survey.camera), tmp_path / "run", RunOptions(fixed_time=True), reporter=counting)
    at = "Match frames with SIFT: keypoints"
    assert 0 < vanished.done[at] == counting.found[at][0] < 6
    assert_same(tmp_path / "run", fresh)
