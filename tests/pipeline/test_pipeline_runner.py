"""Runs: what is redone, what is taken from the cache, what is left behind when things go wrong."""

from __future__ import annotations

import fcntl
import gc
import json
import os
import pickle
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pipeline_toy import Numbers, PowerNumbers, recipe_file, registry

from geomosaic.errors import (
    CancelledError,
    FileError,
    GeomosaicError,
    InputError,
    OutputError,
    PluginError,
    UnknownNameError,
)
from geomosaic.pipeline import executor, hashes, worker_process
from geomosaic.pipeline.artefact_reader import decode
from geomosaic.pipeline.context import Context, Notes, RunFile
from geomosaic.pipeline.files import writing
from geomosaic.pipeline.recipe import Recipe, load_recipe
from geomosaic.pipeline.replayed_stage import replayed_stage
from geomosaic.pipeline.reporter import Reporter, Silent
from geomosaic.pipeline.run_folder import MARKER
from geomosaic.pipeline.run_options import RunOptions
from geomosaic.pipeline.run_results import load_artefact, read_summary
from geomosaic.pipeline.runner import run
from geomosaic.recording.file.reader import read_recording
from geomosaic.recording.inspect.compare import compare

ALL = ["read", "power", "item 1", "item 2", "item 3", "item 4", "sum", "write", "tell"]


class Toys:
    """A folder with a recipe, and what its runs really did."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.recipe_path = recipe_file(folder)
        self.run_folder = folder / "run"
        self.log = folder / "log"

    def recipe(self, *overrides: str) -> Recipe:
        return load_recipe(self.recipe_path, registry(), overrides)

    def run(self, *overrides: str, reporter: Reporter | None = None, **options: Any) -> dict[str, Any]:
        return run(self.recipe(*overrides), self.run_folder, RunOptions(**options), reporter=reporter)

    def done(self) -> list[str]:
        """What was done since the last question, items of parallel work in order of value."""
        lines = self.log.read_text().split("\n")[:-1] if self.log.exists() else []
        self.log.unlink(missing_ok=True)
        items = iter(sorted(line for line in lines if line.startswith("item")))
        return [next(items) if line.startswith("item") else line for line in lines]


@pytest.fixture
def toys(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Toys:
    made = Toys(tmp_path)
    monkeypatch.setenv("TOY_LOG", str(made.log))
    return made


class StageCounter(Silent):
    """Counts what a stage made, whenever one begins."""

    def __init__(self) -> None:
        self.alive: list[int] = []

    def stage_started(self, index: int, total: int, name: str) -> None:
        gc.collect()
        self.alive.append(sum(isinstance(o, Numbers) and o.source == "fancy" for o in gc.get_objects()))


def test_what_the_next_stage_does_not_take_is_freed(toys: Toys) -> None:
    """Power makes it, sum and write take it, tell doesn't."""
    reporter = StageCounter()
    toys.run("toy.power.name=fancy", reporter=reporter)
    assert reporter.alive == [0, 0, 1, 1, 0]


def test_a_run_leaves_what_the_design_says(toys: Toys) -> None:
    returned = toys.run()
    assert toys.done() == ALL
    assert (toys.run_folder / "total.txt").read_text().startswith("30.0 0 ")
    assert (toys.run_folder / "notes.txt").read_text() == "1 {'largest': 16.0}\n"
    summary = json.loads((toys.run_folder / "run.json").read_text())
    assert summary == returned
    assert summary["frames"] == {"total": 4, "tied": 3, "placed": 1, "rejected": 0}
    assert summary["warnings"] == [
        {"code": "many-numbers", "frame": "four.jpg", "text": "4 numbers are many"}
    ]
    assert summary["metrics"] == {"toy": {"largest": 16.0}}
    assert list(summary["timings_s"]) == ["toy.read", "toy.power", "toy.sum", "toy.write", "toy.tell"]
    assert 10 < summary["peak_memory_mb"] < 10_000
    assert summary["recipe"]["stages"][1]["params"]["power"] == 2
    assert list(summary["inputs"]["toy.read.file"]["files"]) == ["numbers.txt"]
    assert {"geomosaic", "python", "numpy", "gdal", "rasterio"} <= summary["versions"].keys()
    assert sorted(p.name for p in toys.run_folder.iterdir()) == [
        MARKER, "notes.txt", "run.json", "run.mcap", "total.txt", "work",
    ]  # fmt: skip


def test_a_second_run_takes_everything_from_the_cache(toys: Toys) -> None:
    first = toys.run()
    toys.done()
    second = toys.run()
    assert toys.done() == ["tell"]
    assert second["cached_stages"] == ["toy.read", "toy.power", "toy.sum", "toy.write"]
    for key in ("warnings", "metrics", "frames", "artefacts", "recipe", "inputs"):
        assert second[key] == first[key]


def test_a_stage_of_a_higher_version_is_redone(toys: Toys, monkeypatch: pytest.MonkeyPatch) -> None:
    """With its items; what takes the same results from it isn't."""
    toys.run()
    toys.done()
    monkeypatch.setattr(PowerNumbers, "version", PowerNumbers.version + 1)
    toys.run()
    assert toys.done() == ["power", "item 1", "item 2", "item 3", "item 4", "tell"]


def edit_numbers(toys: Toys) -> None:
    toys.folder.joinpath("numbers.txt").write_text("1 2 3 5")


def touch_numbers(toys: Toys) -> None:
    os.utime(toys.folder / "numbers.txt", ns=(1, 1))


def delete_total(toys: Toys) -> None:
    (toys.run_folder / "total.txt").unlink()


def edit_total(toys: Toys) -> None:
    (toys.run_folder / "total.txt").write_text("31.0 0 1\n")


def delete_raw(toys: Toys) -> None:
    (toys.run_folder / "work" / "toy.sum" / "raw.bin").unlink()


def spoil_artefact(toys: Toys) -> None:
    for path in (toys.run_folder / "work" / "toy.power").glob("*/numbers.artefact"):
        path.write_bytes(path.read_bytes()[:-20])


def spoil_items(toys: Toys) -> None:
    """The stage is found whole, so its items aren't asked."""
    for path in (toys.run_folder / "work" / "toy.power" / "items").glob("*/*"):
        path.write_bytes(b"")


def new_sidecar(toys: Toys) -> None:
    toys.folder.joinpath("numbers.prj").write_text("EPSG:32632")


def new_log(toys: Toys) -> None:
    """Such as the run's own output, which changes while it reads."""
    toys.folder.joinpath("numbers.log").write_text("read")


@pytest.mark.parametrize(
    ("change", "redone"),
    [
        ((), ["tell"]),
        (("toy.read.loud=true",), ["tell"]),
        (("toy.power.delay_s=0.001",), ["tell"]),
        (("toy.write.megabytes=1",), ["write", "tell"]),
        (("toy.sum.fill=7",), ["sum", "write", "tell"]),
        (("toy.power.power=3",), ALL[1:]),
        (("toy.power.name=fancy",), ["power", *ALL[6:]]),
        (("toy.read.offset_m=1",), ["read", "power", "item 5", *ALL[6:]]),
        (edit_numbers, ["read", "power", "item 5", *ALL[6:]]),
        (touch_numbers, ["tell"]),
        (new_sidecar, ["read", "power", *ALL[6:]]),
        (new_log, ["tell"]),
        (delete_total, ["write", "tell"]),
        (edit_total, ["write", "tell"]),
        (delete_raw, ["sum", "tell"]),
        (spoil_artefact, ["power", "tell"]),
        (spoil_items, ["tell"]),
    ],
)
def test_a_change_redoes_only_what_it_touches(
    change: tuple[str, ...] | Callable[[Toys], None], redone: list[str], toys: Toys
) -> None:
    toys.run()
    toys.done()
    if callable(change):
        change(toys)
        toys.run()
    else:
        toys.run(*change)
    assert toys.done() == redone
    if change == ("toy.sum.fill=7",):
        assert (toys.run_folder / "total.txt").read_text().startswith("30.0 7 ")


def test_the_work_folder_keeps_what_the_last_run_used_and_nothing_else(toys: Toys) -> None:
    toys.run()
    work = toys.run_folder / "work"
    first = {p.relative_to(work) for p in work.rglob("*") if p.is_file()}
    assert len([p for p in first if "items" in p.parts]) == 4
    work.joinpath("toy.gone", "0123").mkdir(parents=True)
    work.joinpath("toy.gone", "0123", "entry.json").write_text("{}")
    toys.folder.joinpath("precious").mkdir()
    toys.folder.joinpath("precious", "pearl").write_text("x")
    work.joinpath("link").symlink_to(toys.folder / "precious")
    for power in (3, 4, 5):
        toys.run(f"toy.power.power={power}")
    assert [len(list((work / id).iterdir())) for id in ("toy.read", "toy.power")] == [1, 2]
    assert (work / "toy.gone" / "0123" / "entry.json").exists() and (work / "link").is_symlink()
    (work / "link").unlink()
    assert (toys.folder / "precious" / "pearl").exists()
    assert (work / "toy.sum" / "raw.bin").stat().st_size == 1000
    toys.done()
    toys.run()
    assert toys.done() == ALL[1:]
    shutil.rmtree(work / "toy.gone")
    assert {p.relative_to(work) for p in work.rglob("*") if p.is_file()} == first


def test_a_run_that_fails_prunes_nothing(toys: Toys) -> None:
    toys.run()
    before = set((toys.run_folder / "work").rglob("*.artefact"))
    recipe_file(toys.folder, "1 13 2")
    with pytest.raises(UnknownNameError):
        toys.run()
    assert before < set((toys.run_folder / "work").rglob("*.artefact"))


def test_what_a_killed_run_left_half_written_goes(toys: Toys) -> None:
    toys.run_folder.mkdir()
    for name in (
        ".mosaic.4711.geomosaic.part.tif",
        ".layers.4711.geomosaic.part.gpkg-journal",
        ".run.json.4711.geomosaic.old",
        ".x.part.txt",
        ".mine.12.part.txt",
    ):
        (toys.run_folder / name).write_text("half")
    (toys.run_folder / ".tiles.4711.geomosaic.part").mkdir()
    toys.run()
    (entry,) = (toys.run_folder / "work" / "toy.read").iterdir()
    half = [
        toys.run_folder / "work" / ".hashes.4711.geomosaic.part.json",
        toys.run_folder / "work" / ".disk.4711.geomosaic.part",
        entry / ".numbers.4711.geomosaic.part.artefact",
    ]
    for path in half:
        path.write_text("half")
    toys.run()
    assert not any(path.exists() for path in half) and entry.is_dir()
    assert sorted(p.name for p in toys.run_folder.glob(".*")) == [MARKER, ".mine.12.part.txt", ".x.part.txt"]


def test_hashes_of_files_nobody_asks_for_are_forgotten(toys: Toys, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(hashes, "UNTOUCHED_NS", 0)
    toys.run()
    toys.folder.joinpath("others.txt").write_text("5 6")
    toys.run(f"toy.read.file={toys.folder / 'others.txt'}")
    known = json.loads((toys.run_folder / "work" / "hashes.json").read_text())
    names = {Path(path).name for path in known}
    assert "others.txt" in names and "numbers.txt" not in names


def test_randomness_comes_from_the_seed_alone(toys: Toys) -> None:
    toys.run()
    first = (toys.run_folder / "total.txt").read_bytes()
    run(toys.recipe(), toys.folder / "other")
    assert (toys.folder / "other" / "total.txt").read_bytes() == first
    toys.recipe_path.write_text(toys.recipe_path.read_text().replace("seed: 5", "seed: 6"))
    toys.run()
    assert (toys.run_folder / "total.txt").read_bytes() != first


def test_equal_runs_record_equal_bytes(toys: Toys) -> None:
    for name in ("a", "b"):
        run(toys.recipe(), toys.folder / name, RunOptions(fixed_time=True, workers=1 if name == "a" else 2))
    a, b = ((toys.folder / name / "run.mcap").read_bytes() for name in ("a", "b"))
    assert a == b


def test_a_cached_run_records_what_the_first_one_did(toys: Toys) -> None:
    toys.run()
    first = read_recording(toys.run_folder / "run.mcap")
    toys.run()
    second = read_recording(toys.run_folder / "run.mcap")
    assert [s.cached for s in first.stages] == [False] * 5
    assert [s.cached for s in second.stages] == [True, True, True, True, False]
    assert {t.name: t.messages for t in first.topics.values()} == {
        t.name: t.messages for t in second.topics.values()
    }
    assert [s.outputs for s in first.stages] == [s.outputs for s in second.stages]
    assert [w.text for w in second.warnings] == ["many-numbers: 4 numbers are many"]
    assert second.rounds[0].misalignments_m.tolist() == [[1.5, -2.5]]
    assert first.whole and second.whole


def test_given_stages_tell_what_they_reported_and_are_not_run(toys: Toys) -> None:
    first = toys.run(fixed_time=True)
    toys.done()
    toys.folder.joinpath("numbers.txt").unlink()
    recording = read_recording(toys.run_folder / "run.mcap")
    recipe = toys.recipe()
    given = {i: replayed_stage(recording, recipe, i) for i in range(2)}
    for again in range(2):
        second = run(recipe, toys.folder / "again", given=given)
        assert toys.done() == (["tell"] if again else ["sum", "write", "tell"])
    assert second["recorded_stages"] == ["toy.read", "toy.power"]
    assert second["cached_stages"] == ["toy.sum", "toy.write"]
    for key in ("warnings", "metrics", "frames", "recipe", "inputs"):
        assert second[key] == first[key]
    recording_read = read_recording(toys.folder / "again" / "run.mcap")
    assert compare(recording, recording_read)["equal"]
    assert [s.outputs for s in recording_read.stages] == [s.outputs for s in recording.stages]
    assert recording_read.stages[1].notes["metrics"] == {"toy": {"largest": 16.0}}
    assert [line.text for line in recording_read.log if line.stage == "toy.read"][-1].startswith(
        "from the recording"
    )
    assert len([line for line in recording_read.log if line.text.startswith("from the recording")]) == 2
    assert recording_read.topics["/location/tied"].messages == 1 and recording_read.rounds[
        0
    ].moves_m.tolist() == [[0.25, 0.5]]


def test_a_changed_step_after_given_ones_is_named_first(toys: Toys) -> None:
    toys.run(fixed_time=True)
    recording = read_recording(toys.run_folder / "run.mcap")
    recipe = toys.recipe("toy.sum.fill=7")
    given = {i: replayed_stage(recording, recipe, i) for i in range(2)}
    run(recipe, toys.folder / "again", given=given)
    difference = compare(recording, read_recording(toys.folder / "again" / "run.mcap"))
    assert (
        difference["first_stage"] == "toy.sum" and not difference["warnings"] and not difference["manifest"]
    )


def test_notes_of_a_stranger_are_refused() -> None:
    warning = {"code": "a", "frame": "b", "text": "c"}
    assert Notes.from_plain({"warnings": [warning], "more": 1}).warnings == [warning]
    for plain in ({"warnings": {}}, {"warnings": [{"code": 1, "frame": "", "text": ""}]}, {"metrics": []}):
        with pytest.raises(FileError, match="notes aren't what a run writes"):
            Notes.from_plain(plain)


def test_artefacts_are_read_back_from_the_work_folder_or_the_recording(toys: Toys) -> None:
    toys.run()
    summary = read_summary(toys.run_folder)
    for _ in range(2):
        numbers = load_artefact(toys.run_folder, summary, "numbers", Numbers)
        assert numbers.values.tolist() == [1.0, 4.0, 9.0, 16.0]
        for path in (toys.run_folder / "work").rglob("*.artefact"):
            path.unlink()
    with pytest.raises(FileError, match="this run made no 'mosaic'"):
        load_artefact(toys.run_folder, summary, "mosaic", Numbers)
    with pytest.raises(FileError, match=r"is no finished run \(run.json is missing\)"):
        read_summary(toys.folder)


@pytest.mark.parametrize("workers", [1, 2])
def test_a_stage_s_error_comes_home_whole(workers: int, toys: Toys) -> None:
    recipe_file(toys.folder, "1 13 2")
    with pytest.raises(UnknownNameError) as error:
        toys.run(workers=workers)
    assert str(error.value) == "unknown number '13'; did you mean '14'?"
    assert error.value.exit_code == 2 and "in powered" in error.value.__notes__[0]
    assert not (toys.run_folder / "run.json").exists()
    recording = read_recording(toys.run_folder / "run.mcap")
    assert recording.warnings[-1].text.startswith("UnknownNameError: unknown number '13'")
    assert [s.finished for s in recording.stages] == [True, False]
    assert not [p for p in toys.run_folder.rglob("*") if p.name == "calls.part"]


class PickyError(Exception):
    """An error whose constructor doesn't take what it keeps: it can't be unpickled."""

    def __init__(self, one: str, two: str) -> None:
        super().__init__(f"{one} and {two}")


def picky(item: int) -> int:
    raise PickyError("salt", "pepper")


def twice(item: int) -> int:
    return 2 * item


def threads(item: int) -> list[str]:
    return [os.environ["OMP_NUM_THREADS"], os.environ["OPENBLAS_NUM_THREADS"]]


def test_an_error_that_cannot_travel_says_at_least_what_it_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    with executor.Workers(2) as team:
        context = Context(tmp_path, workers=team)
        assert context.map("threads", threads, [1]) == [["1", "1"]]
        assert os.environ["OMP_NUM_THREADS"] == "7"
        with pytest.raises(GeomosaicError, match="PickyError: salt and pepper"):
            context.map("picky", picky, [1])


def environment_of(name: str) -> str | None:
    return os.environ.get(name)


def test_a_worker_has_the_environment_of_now(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The process that workers are forked from keeps the environment that it was started with."""
    monkeypatch.setenv("TOY_GONE", "before")
    worker_process.prepare_workers(["json"])
    monkeypatch.setenv("TOY_SET", "later")
    monkeypatch.delenv("TOY_GONE")
    with executor.Workers(2) as team:
        assert Context(tmp_path, workers=team).map(
            "environment_of", environment_of, ["TOY_SET", "TOY_GONE"]
        ) == ["later", None]


def test_workers_need_not_look_through_what_was_imported_for_them() -> None:
    """A fork server of its own, which the other tests' isn't: it may be there before anything is prepared."""
    seen = "(__import__('gc').isenabled(), __import__('gc').get_freeze_count() > 1000)"
    script = (
        "import gc\n"
        "from geomosaic.pipeline.executor import Workers\n"
        "from geomosaic.pipeline.worker_process import prepare_workers\n"
        "prepare_workers(['json'])\n"
        "with Workers(2) as team:\n"
        f'    print(team.result(team.submit(eval, "{seen}")), gc.isenabled())\n'
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout == "(True, True) True\n"


def test_items_with_keys_are_made_as_they_are_needed(tmp_path: Path) -> None:
    made: list[int] = []

    def items() -> Iterator[int]:
        for i in range(8):
            made.append(i)
            yield i

    class Seeing(Context):
        def progress(self, done: int, total: int, words: str) -> None:
            assert total == 8 and len(made) <= done + 1

    assert Seeing(tmp_path).map("twice", twice, items(), keys=range(8)) == list(range(0, 16, 2))
    assert len(made) == 8


@pytest.mark.parametrize(
    "error",
    [
        InputError("bad", file="a.jpg", fix="correct it"),
        FileError("cut", file="b.jpg"),
        UnknownNameError("stage", "a.b", ["a.c"]),
        OutputError("full", file="c.tif", fix="free some"),
        PluginError("broken"),
        CancelledError(),
    ],
)
def test_errors_survive_pickling(error: GeomosaicError) -> None:
    error.add_note("seen here")
    back = pickle.loads(pickle.dumps(error))
    assert type(back) is type(error) and str(back) == str(error)
    assert vars(back) == vars(error) and back.__notes__ == ["seen here"]


def test_a_worker_that_dies_is_an_error_and_the_rest_is_kept(toys: Toys) -> None:
    recipe_file(toys.folder, "1 2 3 4 5 6 99")
    with pytest.raises(GeomosaicError, match="a worker process died"):
        toys.run("toy.power.delay_s=0.05", workers=2)
    assert "item 1" in toys.done()
    recipe_file(toys.folder, "1 2 3 4 5 6 99")
    with pytest.raises(GeomosaicError, match="a worker process died"):
        toys.run("toy.power.delay_s=0.05", workers=2)
    assert "item 1" not in toys.done()


def test_the_work_is_the_same_wherever_it_is_done(toys: Toys) -> None:
    distributed, dask = pytest.importorskip("distributed"), pytest.importorskip("dask")
    totals = []
    one = {"n_workers": 1, "threads_per_worker": 2, "processes": False}
    with (
        dask.config.set({"temporary-directory": str(toys.folder)}),
        distributed.LocalCluster(**one, protocol="tcp", dashboard_address="127.0.0.1:0") as cluster,
    ):
        manners: dict[str, Any] = {"one": {}, "two": {"workers": 2}}
        manners["dask"] = {"dask": cluster.scheduler_address}
        for name, options in manners.items():
            run(toys.recipe(), toys.folder / name, RunOptions(**options))
            totals.append((toys.folder / name / "total.txt").read_bytes())
            assert toys.done() == ALL
    assert len(set(totals)) == 1


def test_no_dask_scheduler_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("distributed")
    monkeypatch.setattr(executor, "DASK_TIMEOUT_S", 0.5)
    team = executor.Workers(dask="tcp://127.0.0.1:1")
    with pytest.raises(InputError, match="no Dask scheduler answers"):
        team.submit(len, ())


def test_two_runs_do_not_share_a_folder(toys: Toys) -> None:
    toys.run()
    with (toys.run_folder / "work" / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        before = (toys.run_folder / "run.json").read_bytes()
        with pytest.raises(OutputError, match=f"{toys.run_folder}: another run is writing here"):
            toys.run()
    assert (toys.run_folder / "run.json").read_bytes() == before


def test_a_folder_that_cannot_be_written_is_refused_before_any_work(toys: Toys) -> None:
    toys.folder.joinpath("file").write_text("x")
    for folder in (toys.folder / "file" / "run", toys.folder / "file", Path("/proc/run")):
        with pytest.raises(OutputError) as error:
            run(toys.recipe(), folder)
        assert str(error.value).startswith(f"{folder}: ") and error.value.exit_code == 2
    assert toys.done() == []


def test_a_failed_write_leaves_nothing(toys: Toys) -> None:
    refuse = toys.folder / "refuse.yaml"
    refuse.write_text("stages: [toy.refuse]")
    with pytest.raises(InputError, match=r"^x\.jpg: no pixels; take it away$"):
        run(load_recipe(refuse, registry()), toys.run_folder)
    assert sorted(p.name for p in toys.run_folder.iterdir()) == [MARKER, "run.mcap", "work"]


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    folder = tmp_path / "small"
    folder.mkdir()
    mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=4m", "tmpfs", folder], capture_output=True)
    if mounted.returncode:
        pytest.skip("a small tmpfs can't be mounted here")
    yield folder
    subprocess.run(["umount", "-l", folder], check=True)


def test_a_full_disk_is_one_line_and_leaves_nothing_half_written(toys: Toys, small_disk: Path) -> None:
    folder = small_disk / "run"
    with pytest.raises(OutputError) as error:
        run(toys.recipe("toy.write.megabytes=10"), folder)
    assert str(error.value) == (
        f"{folder}/total.txt: no space left on the disk; free some or choose another output folder"
    )
    assert sorted(p.name for p in folder.iterdir()) == [MARKER, "run.mcap", "work"]
    toys.done()
    run(toys.recipe(), folder)
    assert toys.done() == ["write", "tell"]


@pytest.mark.parametrize("ballast_kb", range(4000, 4096, 12))
def test_a_full_disk_is_reported_alike_whoever_notices(toys: Toys, small_disk: Path, ballast_kb: int) -> None:
    """The recorder, the cache or a stage, by how much is left."""
    (small_disk / "ballast").write_bytes(bytes(ballast_kb << 10))
    with pytest.raises(OutputError, match="no space left on the disk; free some or choose another output"):
        run(toys.recipe("toy.write.megabytes=1"), small_disk / "run")


def test_cancelling_stops_between_items(toys: Toys) -> None:
    calls = iter(range(100))
    with pytest.raises(CancelledError):
        toys.run(cancelled=lambda: next(calls) > 4)
    done = toys.done()
    assert "item 1" in done and "item 4" not in done
    toys.run()
    assert toys.done() == ["power", *[i for i in ALL[2:6] if i not in done], *ALL[6:]]


def double(path: str) -> int:
    with Path(os.environ["TOY_LOG"]).open("a") as log:
        log.write(f"item {Path(path).name}\n")
    return 2 * int(Path(path).read_text())


def test_items_that_name_what_they_read_outlive_other_changes(toys: Toys) -> None:
    paths = [str(toys.folder / name) for name in "abc"]
    for number, path in enumerate(paths):
        Path(path).write_text(str(number + 1))

    def doubled(key: str) -> list[int]:
        context = Context(toys.run_folder, stage_id="toy.x", key=key)
        return context.map("double", double, paths)

    assert doubled("one") == [2, 4, 6]
    assert toys.done() == ["item a", "item b", "item c"]
    Path(paths[1]).write_text("7")
    assert doubled("another") == [2, 14, 6]
    assert toys.done() == ["item b"]


def test_spooled_results_lie_on_the_disk_until_they_are_done_with(toys: Toys) -> None:
    """Where the work with them fails they stay, and nobody makes them again; by hand they are in memory."""
    paths = [str(toys.folder / name) for name in "ab"]
    for number, path in enumerate(paths):
        Path(path).write_text(str(number + 1))
    context = Context(toys.run_folder, stage_id="toy.x", key="one")
    items = context.work_folder / "items"
    with pytest.raises(ZeroDivisionError), context.spooled("double", double, paths, keys=[0, 1]) as made:
        assert [one.load() for one in made] == [one.load() for one in made] == [2, 4]
        assert all(one.data is None for one in made)
        raise ZeroDivisionError
    assert toys.done() == ["item a", "item b"]
    assert len([p for p in items.rglob("*") if p.is_file()]) == 2
    with context.spooled("double", double, paths, keys=[0, 1]) as made:
        assert [one.load() for one in made] == [2, 4]
    assert toys.done() == []
    assert not [p for p in items.rglob("*") if p.is_file()]
    with Context(toys.run_folder).spooled("double", double, paths, keys=[0, 1]) as made:
        assert [one.load() for one in made] == [2, 4]


def test_a_function_that_does_not_say_what_it_returns_is_refused(tmp_path: Path) -> None:
    with pytest.raises(TypeError, match="must say in its annotation what it returns"):
        Context(tmp_path).map("x", lambda x: x, [1])


def test_writing_is_whole_or_not_at_all(tmp_path: Path) -> None:
    context = Context(tmp_path)
    with context.writing("tiles/4/a.png") as path:
        assert path.suffix == ".png" and path.parent == tmp_path / "tiles" / "4"
        path.write_bytes(b"one")
        assert not (tmp_path / "tiles/4/a.png").exists()
    assert (tmp_path / "tiles/4/a.png").read_bytes() == b"one"
    with pytest.raises(ZeroDivisionError), context.writing("tiles/4/a.png") as path:
        path.write_bytes(b"two")
        path.with_name(path.name + "-journal").write_bytes(b"x")
        raise ZeroDivisionError
    assert (tmp_path / "tiles/4/a.png").read_bytes() == b"one"
    assert [p.name for p in (tmp_path / "tiles" / "4").iterdir()] == ["a.png"]
    with context.writing("tiles") as path:
        path.mkdir()
        path.joinpath("new").write_bytes(b"three")
    assert [p.name for p in (tmp_path / "tiles").iterdir()] == ["new"]
    assert context.run_file("tiles") == context.run_file("tiles")
    assert isinstance(context.run_file("tiles"), RunFile)
    for name in ("../x", "/x", "a/../../x", "", "a\\b"):
        with pytest.raises(ValueError, match="is no name inside"), context.writing(name):
            pass
    with pytest.raises(FileError, match="the file is gone"):
        context.path_of(RunFile("gone.tif", ""))


def test_a_file_and_a_folder_never_take_each_other_s_place(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("precious")
    (tmp_path / "empty").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "empty")
    with (
        pytest.raises(OutputError, match=r"notes\.txt: a file stands where a folder is needed"),
        writing(tmp_path / "notes.txt") as path,
    ):
        path.mkdir()
        path.joinpath("new").write_bytes(b"x")
    for name in ("empty", "link"):
        with (
            pytest.raises(OutputError, match=f"{name}: a folder stands where the file is to go"),
            writing(tmp_path / name) as path,
        ):
            path.write_bytes(b"x")
    assert (tmp_path / "notes.txt").read_text() == "precious"
    assert (tmp_path / "link").is_symlink() and not list((tmp_path / "empty").iterdir())
    assert {p.name for p in tmp_path.iterdir()} == {"notes.txt", "empty", "link"}


def test_random_streams_are_distinguished(tmp_path: Path) -> None:
    context = Context(tmp_path, stage_id="a.b", seed=3)
    one, two = context.rng("one").random(3), context.rng("two").random(3)
    assert (context.rng("one").random(3) == one).all() and (one != two).all()
    assert (Context(tmp_path, stage_id="a.c", seed=3).rng("one").random(3) != one).all()
    assert (Context(tmp_path, stage_id="a.b", seed=4).rng("one").random(3) != one).all()


def test_metrics_are_json_numbers(tmp_path: Path) -> None:
    context = Context(tmp_path)
    context.metric("a.b", np.float32(0.5))
    context.metric("a.c", [np.nan, np.int16(3)])
    assert context.summary()["metrics"] == {"a": {"b": 0.5, "c": [None, 3]}}
    with pytest.raises(TypeError):
        context.metric("a.d", object())


def test_decoded_and_fresh_outputs_are_alike(toys: Toys) -> None:
    summary = toys.run()
    path = toys.run_folder / summary["artefacts"]["numbers"]["file"]
    assert decode(path.read_bytes(), Numbers).source == "plain"
    started = time.monotonic()
    toys.run()
    assert time.monotonic() - started < 2.0
