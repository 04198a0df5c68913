"""`geomosaic replay`: real stages, run, recorded and run again in the middle."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
from numpy.typing import NDArray

from geomosaic.cli.main import main
from geomosaic.errors import FileError
from geomosaic.pipeline import registry as registry_module
from geomosaic.pipeline.recipe import parse_recipe
from geomosaic.pipeline.registry import Registry
from geomosaic.pipeline.run_options import RunOptions
from geomosaic.pipeline.runner import run
from geomosaic.pipeline.stage import Context, RunFile, Stage, StageParams, param
from geomosaic.recording import read_recording


@dataclass(frozen=True)
class Image:
    """A frame's place."""

    path: str


@dataclass(frozen=True)
class Found:
    """Frames and heights."""

    frames: tuple[Image, ...]
    heights_m: NDArray[np.float64]


@dataclass(frozen=True)
class Raised:
    """Heights, and a raster below work/."""

    heights_m: NDArray[np.float64]
    raster: str


RUNS: list[str] = []


class Find(Stage):
    """Reads a folder."""

    id = "replayed.find"
    display_name = "Find"
    group = "Replayed"
    outputs: ClassVar = {"survey": Found}

    class Params(StageParams):
        """See each parameter's help."""

        frames: Path = param(help="folder of frames")

    def run(self, inputs: Mapping[str, Any], params: Params, context: Context) -> dict[str, Any]:
        RUNS.append(self.id)
        paths = sorted(params.frames.iterdir())
        context.warn("few-frames", paths[0].name, f"only {len(paths)}")
        heights_m = np.array([float(p.read_text()) for p in paths])
        return {"survey": Found(tuple(Image(str(p)) for p in paths), heights_m)}


class Raise(Stage):
    """Adds a height."""

    id = "replayed.raise"
    display_name = "Raise"
    group = "Replayed"
    inputs: ClassVar = {"survey": Found}
    outputs: ClassVar = {"raised": Raised}

    class Params(StageParams):
        """See each parameter's help."""

        by_m: float = param(0.5, help="added", unit="m", ge=-10, le=10)

    def run(self, inputs: Mapping[str, Any], params: Params, context: Context) -> dict[str, Any]:
        RUNS.append(self.id)
        heights_m = inputs["survey"].heights_m + params.by_m
        name = "work/replayed.raise/raster.bin"
        with context.writing(name) as path:
            path.write_bytes(heights_m.tobytes())
        return {"raised": Raised(heights_m, name)}


class Read(Stage):
    """Writes the raster's sum; reads the frames' files too if asked to."""

    id = "replayed.read"
    display_name = "Read"
    group = "Replayed"
    inputs: ClassVar = {"survey": Found, "raised": Raised}
    outputs: ClassVar = {"sum_file": RunFile}

    class Params(StageParams):
        """See each parameter's help."""

        pixels: bool = param(False, help="read the frames")
        factor: float = param(1.0, help="scale", ge=0, le=100)

    def run(self, inputs: Mapping[str, Any], params: Params, context: Context) -> dict[str, Any]:
        RUNS.append(self.id)
        if params.pixels:
            for frame in inputs["survey"].frames:
                if not Path(frame.path).is_file():
                    raise FileError("can't be read", file=frame.path)
        heights_m = np.frombuffer((context.run_folder / inputs["raised"].raster).read_bytes())
        with context.writing("sum.txt") as path:
            path.write_text(f"{params.factor * heights_m.sum():g}\n")
        return {"sum_file": context.run_file("sum.txt")}


RECIPE = """name: replayed
stages:
  - {stage: replayed.find, params: {frames: FRAMES}}
  - replayed.raise
  - replayed.read
"""


@pytest.fixture
def recorded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A finished run's folder; its frames are in FRAMES next to it."""
    stages = Registry()
    for stage in (Find, Raise, Read):
        stages.register(stage)
    monkeypatch.setattr(registry_module, "installed", lambda: stages)
    frames = tmp_path / "FRAMES"
    frames.mkdir()
    for i, height in enumerate((10.0, 20.0, 40.0)):
        (frames / f"{i}.txt").write_text(str(height))
    run(parse_recipe(RECIPE, stages, base=tmp_path), tmp_path / "RUN", RunOptions(fixed_time=True))
    assert (tmp_path / "RUN" / "sum.txt").read_text() == "71.5\n"
    RUNS.clear()
    return tmp_path / "RUN"


def replay(recorded: Path, *arguments: str) -> tuple[int, Path]:
    out = recorded.parent / "RUN2"
    return main(["replay", str(recorded / "run.mcap"), "-o", str(out), "--workers", "1", *arguments]), out


def test_a_changed_parameter_redoes_its_stage_and_what_follows(recorded: Path) -> None:
    code, out = replay(recorded, "--set", "replayed.raise.by_m=-2")
    assert code == 0 and RUNS == ["replayed.raise", "replayed.read"]
    assert (out / "sum.txt").read_text() == "64\n"
    again = read_recording(out / "run.mcap")
    assert again.whole and [s.finished for s in again.stages] == [True] * 3
    assert again.stages[1].params == {"by_m": -2.0}


def test_the_frames_may_be_gone_where_no_pixel_is_read(recorded: Path) -> None:
    (recorded.parent / "FRAMES").rename(recorded.parent / "elsewhere")
    code, out = replay(recorded, "--from", "replayed.raise")
    assert code == 0 and RUNS == ["replayed.raise", "replayed.read"]
    assert (out / "sum.txt").read_text() == (recorded / "sum.txt").read_text()


def test_a_recording_of_a_stage_that_gave_another_name_is_replayed(
    recorded: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Sum(Read):
        inputs: ClassVar = {"survey": Found, "lifted": Raised}

        def run(self, inputs: Mapping[str, Any], params: Any, context: Context) -> dict[str, Any]:
            return super().run({"raised": inputs["lifted"], **inputs}, params, context)

    class Lift(Raise):
        outputs: ClassVar = {"lifted": Raised}
        formerly: ClassVar = {"lifted": "raised"}

    stages = Registry()
    for stage in (Find, Lift, Sum):
        stages.register(stage)
    monkeypatch.setattr(registry_module, "installed", lambda: stages)
    code, out = replay(recorded, "--set", "replayed.read.factor=2")
    assert code == 0 and RUNS == ["replayed.read"]
    assert (out / "sum.txt").read_text() == "143\n"


def test_a_missing_folder_of_frames_is_named(recorded: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (recorded.parent / "FRAMES").rename(recorded.parent / "elsewhere")
    code, _ = replay(recorded, "--set", "replayed.read.pixels=true")
    err = capsys.readouterr().err.splitlines()[-1]
    assert (
        code == 2
        and f"{recorded.parent / 'FRAMES'}: an input of the recorded run is gone; put it back" in err
    )
    code, _ = replay(recorded)
    assert code == 2 and "FRAMES: no such file or folder" in capsys.readouterr().err


def test_files_of_earlier_stages_come_along_or_are_named(
    recorded: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, out = replay(recorded, "--set", "replayed.read.factor=2")
    assert code == 0 and RUNS == ["replayed.read"] and (out / "sum.txt").read_text() == "143\n"
    (recorded / "work" / "replayed.raise" / "raster.bin").unlink()
    capsys.readouterr()
    code, _ = replay(recorded, "--from", "replayed.read")
    err = capsys.readouterr().err
    assert code == 2 and "raster.bin: the file of 'raised' is gone; replay with --from replayed.raise" in err


def test_a_run_that_was_cut_off_is_replayed_from_where_it_stood(
    recorded: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = recorded / "run.mcap"
    data = path.read_bytes()
    ends = [s for s in range(1000, len(data), 50) if _finished(path, data[:s]) == 1]
    path.write_bytes(data[: ends[0]])
    code, _ = replay(recorded, "--from", "replayed.read")
    err = capsys.readouterr().err
    assert code == 2 and "lacks results of stage replayed.raise; replay with --from replayed.raise" in err
    code, out = replay(recorded, "--from", "replayed.raise")
    assert code == 0 and (out / "sum.txt").read_text() == "71.5\n"


def _finished(path: Path, data: bytes) -> int:
    cut = path.with_name("cut.mcap")
    cut.write_bytes(data)
    return sum(stage.finished for stage in read_recording(cut).stages)


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (
            ["--from", "replayed.rais"],
            "of this recording 'replayed.rais'; did you mean 'replayed.raise'?",
        ),
        (
            ["--from", "replayed.read", "--set", "replayed.raise.by_m=1"],
            "changes a stage before replayed.read",
        ),
        (["--set", "replayed.raise.by_m=99"], "--set replayed.raise.by_m=99"),
        (["--set", "replayed.rise.by_m=1"], "did you mean 'replayed.raise'?"),
    ],
)
def test_bad_wishes_are_one_line_and_exit_2(
    recorded: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], says: str
) -> None:
    code, out = replay(recorded, *arguments)
    err = capsys.readouterr().err
    assert code == 2 and says in err and err.count("\n") == 1
    assert not out.exists() and RUNS == []


def test_a_run_is_not_replayed_over_itself(recorded: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = (recorded / "run.mcap").read_bytes()
    assert main(["replay", str(recorded), "-o", str(recorded)]) == 2
    assert "give another folder with -o" in capsys.readouterr().err
    assert (recorded / "run.mcap").read_bytes() == before


def test_until_ends_the_replay_there(recorded: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, out = replay(recorded, "--from", "replayed.raise", "--until", "replayed.raise")
    assert code == 0 and RUNS == ["replayed.raise"] and not (out / "sum.txt").exists()
    again = read_recording(out / "run.mcap")
    assert [s.stage_id for s in again.stages] == ["replayed.find", "replayed.raise"]
    assert "replayed.read" not in again.recipe_yaml
    assert replay(recorded, "--until", "replayed.rais")[0] == 2
    assert "did you mean 'replayed.raise'?" in capsys.readouterr().err


@pytest.mark.parametrize(("level", "holds"), [("off", None), ("summary", 0), ("normal", 3)])
def test_a_replay_records_as_much_as_is_asked(recorded: Path, level: str, holds: int | None) -> None:
    code, out = replay(recorded, "--from", "replayed.raise", "--record", level)
    assert code == 0 and (out / "sum.txt").read_text() == "71.5\n"
    if holds is None:
        assert not (out / "run.mcap").exists()
    else:
        again = read_recording(out / "run.mcap")
        assert len(again.artefacts) == holds and [s.finished for s in again.stages] == [True] * 3


def test_a_replay_knows_its_levels(recorded: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert replay(recorded, "--record", "summry")[0] == 2
    assert "did you mean 'summary'?" in capsys.readouterr().err
