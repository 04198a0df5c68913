"""Results that are referred to, what names a result, and functions that are lent to workers."""

from __future__ import annotations

import functools
import itertools
import os
import pickle
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from geomosaic.errors import FileError
from geomosaic.pipeline import stored_result
from geomosaic.pipeline.artefacts import content_of, encode
from geomosaic.pipeline.context import Context
from geomosaic.pipeline.executor import Workers
from geomosaic.pipeline.hashes import FileHashes
from geomosaic.pipeline.stored_result import OptionalCache, SharedFunction, StoredResult


@dataclass(frozen=True)
class Keypoints:
    """What a frame gives."""

    at: NDArray[np.float64]


@dataclass(frozen=True)
class Pair:
    """Two frames' keypoints, referred to, and what else its match hangs on."""

    left: StoredResult[Keypoints]
    right: StoredResult[Keypoints]
    radius: float = 1.0


def log_line(line: str) -> None:
    """Notes that real work was done, from whatever process."""
    with Path(os.environ["TOY_LOG"]).open("a") as log:
        log.write(line + "\n")


def keypoints(path: str) -> Keypoints:
    log_line(f"keypoints {Path(path).name}")
    return Keypoints(np.full(1000, float(Path(path).read_text())))


def matched(pair: Pair) -> float:
    log_line("pair")
    assert pair.left.recall() is pair.left.recall() or pair.left.path is None
    return pair.radius * float(pair.left.recall().at[0] * pair.right.recall().at[-1])


def weighed(item: float, *, ground: NDArray[np.float64]) -> float:
    log_line(f"weighed in {os.getpid()}")
    return item * float(ground.sum())


class Flight:
    """Frames of one number each, matched in neighbours."""

    def __init__(self, folder: Path, log: Path) -> None:
        self.folder, self.log = folder, log
        self.frames = folder / "frames"
        self.frames.mkdir()

    def put(self, *numbers: int) -> None:
        for number in numbers:
            (self.frames / f"{number:02}.jpg").write_text(str(number))

    def run(self, key: str, workers: Workers | None = None) -> list[float]:
        hashes = FileHashes()
        hashes.manifest(self.frames)
        context = Context(self.folder / "run", stage_id="toy.match", key=key, workers=workers, hashes=hashes)
        paths = sorted(str(p) for p in self.frames.glob("*.jpg"))
        features = context.stored("keypoints", keypoints, paths)
        pairs = [Pair(a, b) for a, b in itertools.pairwise(features)]
        found = context.map("pairs", matched, pairs)
        self.lasting = context.lasting_items
        return found

    def done(self) -> list[str]:
        lines = self.log.read_text().split("\n")[:-1] if self.log.exists() else []
        self.log.unlink(missing_ok=True)
        return sorted(lines)


@pytest.fixture
def flight(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Flight:
    monkeypatch.setenv("TOY_LOG", str(tmp_path / "log"))
    return Flight(tmp_path, tmp_path / "log")


@pytest.mark.parametrize("workers", [1, 2])
def test_new_frames_bring_only_their_own_keypoints_and_pairs(workers: int, flight: Flight) -> None:
    flight.put(2, 3, 7)
    with Workers(workers) as team:
        assert flight.run("one", team) == [6.0, 21.0]
        assert flight.done() == ["keypoints 02.jpg", "keypoints 03.jpg", "keypoints 07.jpg", "pair", "pair"]
        flight.put(5)
        assert flight.run("another key", team) == [6.0, 15.0, 35.0]
        assert flight.done() == ["keypoints 05.jpg", "pair", "pair"]
    assert len(flight.lasting) == 7 and all(path.is_file() for path in flight.lasting)


def test_large_results_are_left_on_the_disk_by_who_made_them(flight: Flight) -> None:
    """100 MB of each frame went home through a pipe to be written there."""
    flight.put(2, 3, 7)
    home: list[object] = []
    with Workers(2) as team:
        result = team.result
        team.result = lambda future: home.append(result(future)) or home[-1]  # type: ignore[method-assign, func-returns-value]
        flight.run("one", team)
    left = [path for path in home if isinstance(path, Path)]
    assert len(left) == 3 and not any(path.exists() for path in left)
    assert all(path.parent.parent.name == "items" for path in left)


def test_a_file_that_changes_meanwhile_leaves_no_result(tmp_path: Path, flight: Flight) -> None:
    flight.put(2)

    def change(done: int, *_: object) -> None:
        changed = tmp_path / "changed"
        changed.write_text("23")  # a worker may be reading: never half a file
        changed.replace(flight.frames / "02.jpg")

    hashes = FileHashes()
    hashes.manifest(flight.frames)
    with Workers(2) as team:
        context = Context(flight.folder / "run", key="one", workers=team, hashes=hashes, on_progress=change)
        with pytest.raises(FileError, match="was changed while the run read it"):
            context.stored("keypoints", keypoints, [str(flight.frames / "02.jpg")])
    assert not [path for path in context.work_folder.rglob("*") if path.is_file()]


def test_what_lies_next_to_a_file_and_counts_names_its_results_too(flight: Flight) -> None:
    """A mask or an overview of its name changes what is read of a frame."""
    flight.put(2, 3)
    flight.run("one")
    flight.done()
    (flight.frames / "02.jpg.msk").write_text("another stem")
    flight.run("two")
    assert flight.done() == []
    (flight.frames / "02.msk").write_text("a mask")
    flight.run("three")
    assert flight.done() == ["keypoints 02.jpg", "pair"]


def test_a_kept_result_that_is_spoiled_is_made_again(flight: Flight) -> None:
    flight.put(2, 3)
    flight.run("one")
    flight.done()
    largest = max(flight.lasting, key=lambda path: path.stat().st_size)
    largest.write_bytes(largest.read_bytes()[:-100])
    assert flight.run("one") == [6.0]
    assert len(flight.done()) == 1


def test_a_reference_that_leads_nowhere_says_where_and_what_to_do(tmp_path: Path) -> None:
    gone = StoredResult(Keypoints, "0" * 40, tmp_path / "gone")
    with pytest.raises(
        FileError, match=r"isn't there for the process at work on .*; with --dask the run fol"
    ):
        gone.recall()


def test_a_reference_is_no_artefact_and_counts_by_its_mark(tmp_path: Path) -> None:
    a, b = (StoredResult(Keypoints, mark, tmp_path / "same") for mark in ("a", "b"))
    assert content_of((1, a))[0] == content_of((1, StoredResult(Keypoints, "a", tmp_path / "moved")))[0]
    assert content_of((1, a))[0] != content_of((1, b))[0]
    with pytest.raises(TypeError, match=r"^tuple\[1\]: StoredResult can't be kept as an artefact"):
        encode((1, a))


def test_a_process_keeps_of_what_it_read_the_latest(monkeypatch: pytest.MonkeyPatch) -> None:
    memory = stored_result._Memory(10)
    read: list[str] = []

    def of(mark: str, size: int) -> str:
        def reading() -> tuple[str, int]:
            read.append(mark)
            return mark, size

        value: str = memory.get(mark, reading)
        return value

    for mark in "abaca":
        assert of(mark, 5) == mark
    assert read == ["a", "b", "c"]
    of("b", 5)
    of("large", 50)
    of("large", 50)
    of("a", 5)
    assert read == ["a", "b", "c", "b", "large", "a"]


def test_a_look_reads_what_is_looked_at(flight: Flight) -> None:
    """Of a frame's part of 100 MB a window wants a corner."""
    flight.put(2)
    hashes = FileHashes()
    hashes.manifest(flight.frames)
    context = Context(flight.folder / "run", key="one", hashes=hashes)
    (made,) = context.stored("keypoints", keypoints, [str(flight.frames / "02.jpg")])
    assert np.array_equal(made.look().at, made.load().at)
    assert not made.look().at.flags.owndata and made.look() is made.look()
    with pytest.raises(ValueError, match="read-only"):
        made.look().at[0] = 1.0
    assert made.path is not None
    made.path.write_bytes(made.path.read_bytes()[:-4000])
    with pytest.raises(FileError):
        StoredResult(made.returns, "another", made.path).look()


def test_many_small_results_are_not_all_open(flight: Flight) -> None:
    """Most systems let a process have 1,024 files open."""
    flight.put(400)
    hashes = FileHashes()
    hashes.manifest(flight.frames)
    context = Context(flight.folder / "run", key="one", hashes=hashes)
    paths = sorted(map(str, flight.frames.iterdir()))
    made = context.stored("keypoints", keypoints, paths)
    assert [float(its.look().at[0]) for its in made] == [float(Path(p).read_text()) for p in paths]
    assert len(list(Path("/proc/self/fd").iterdir())) < 320


def test_what_is_made_of_a_result_is_kept_instead_of_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """16 MB of a file of 2 MB count as such, and push out what came before."""
    path, made = tmp_path / "small", []

    def wide(values: NDArray[np.uint8]) -> NDArray[np.float64]:
        made.append(len(values))
        return values.astype(np.float64)

    path.write_bytes(encode(np.ones(2 << 20, np.uint8)))
    one, other = (StoredResult[NDArray[np.uint8]](np.ndarray, mark, path) for mark in ("one", "other"))
    monkeypatch.setattr(stored_result, "_memory", stored_result._Memory(20 << 20))
    assert one.recall_as(wide).sum() == 2 << 20
    assert one.recall_as(wide) is one.recall_as(wide) and len(made) == 1
    other.recall_as(wide)
    one.recall_as(wide)
    assert len(made) == 3


def test_large_arguments_are_written_once_for_all_items(flight: Flight) -> None:
    """8 MB of ground times thousands of frames went through the pipes."""
    ground = np.full(1_000_000, 0.5)
    work = functools.partial(weighed, ground=ground)
    with Workers(2) as team:
        sent: list[int] = []
        submit = team.submit
        team.submit = lambda f, item: sent.append(len(pickle.dumps(f))) or submit(f, item)  # type: ignore[method-assign, assignment, func-returns-value]
        context = Context(flight.folder / "run", key="one", workers=team)
        assert context.map("weighed", work, [1.0, 2.0, 3.0]) == [5e5, 1e6, 1.5e6]
    assert len(sent) == 3 and max(sent) < 1000
    assert not [p for p in context.work_folder.iterdir() if p.is_file()]


def test_a_lent_function_is_what_was_lent_or_nothing(tmp_path: Path) -> None:
    work = functools.partial(weighed, ground=np.zeros(100_000))
    lent = SharedFunction.of(work, tmp_path / "lent")
    assert isinstance(lent, SharedFunction)
    (tmp_path / "lent").write_bytes(pickle.dumps(print))
    with pytest.raises(FileError, match="isn't what the run wrote"):
        lent(1.0)


def lying(_: float, ground: np.ndarray, slope: np.ndarray) -> tuple[bool, np.ndarray, np.ndarray]:
    return ground.flags.owndata or ground.flags.writeable, ground, slope


def test_lent_arrays_stay_in_the_file(tmp_path: Path) -> None:
    """So that the workers of a machine share them; in every order and of every size that arrays have."""
    random = np.random.default_rng(2)
    ground, slope = random.normal(size=(301, 77)).T, random.integers(0, 9, (5, 3), dtype=np.uint8)
    lent = SharedFunction.of(functools.partial(lying, ground=ground, slope=slope[::2]), tmp_path / "lent")
    own, *arrays = lent(1.0)
    assert not own
    for found, given in zip(arrays, (ground, slope[::2]), strict=True):
        assert np.array_equal(found, given)
        assert found.dtype == given.dtype
        assert found.ctypes.data % found.itemsize == 0


@pytest.mark.parametrize("left", [0, 7, 1000])
def test_a_lent_function_that_is_cut_off_is_refused(tmp_path: Path, left: int) -> None:
    lent = SharedFunction.of(functools.partial(weighed, ground=np.zeros(100_000)), tmp_path / "lent")
    (tmp_path / "lent").write_bytes((tmp_path / "lent").read_bytes()[:left])
    with pytest.raises(FileError, match="isn't what the run wrote"):
        lent(1.0)


def recalled(kept: StoredResult[np.ndarray]) -> int:
    return len(kept.recall())


def test_a_worker_at_rest_forgets_what_it_recalled(tmp_path: Path) -> None:
    """64 MB, that the parent may need meanwhile."""
    path = tmp_path / "large"
    path.write_bytes(encode(np.ones(8 << 20)))
    large = StoredResult[np.ndarray](np.ndarray, "mark", path)
    with Workers(2) as workers:
        assert workers.result(workers.submit(recalled, large)) == 8 << 20
        most = workers.memory_bytes()
        until = time.monotonic() + 20.0
        while workers.memory_bytes() > most - (60 << 20) and time.monotonic() < until:
            time.sleep(0.2)
        assert workers.memory_bytes() <= most - (60 << 20)
        assert workers.result(workers.submit(recalled, large)) == 8 << 20


def test_what_spares_work_counts_for_nothing(tmp_path: Path) -> None:
    """It lies by type, version and the file's content, alike for every stage; it is there or not; it names
    nothing."""
    (tmp_path / "a").write_text("1")
    (tmp_path / "b").write_text("1")
    (tmp_path / "c").write_text("2")
    one, other = (
        Context(tmp_path / "run", stage_id=id, key="k", hashes=FileHashes()) for id in ("a.b", "c.d")
    )
    there = one.optional_cache(Keypoints, str(tmp_path / "a"))
    assert there.found() is None
    there.leave(Keypoints(np.arange(3.0)))
    for found in (there, other.optional_cache(Keypoints, str(tmp_path / "b"))):
        known = found.found()
        assert known is not None and known.at.tolist() == [0.0, 1.0, 2.0]
    assert other.optional_cache(Keypoints, str(tmp_path / "c")).found() is None
    assert other.optional_cache(Keypoints, str(tmp_path / "a"), 2).found() is None
    assert content_of([there, 1])[0] == content_of([OptionalCache(Keypoints, None), 1])[0]
    assert there.path is not None
    there.path.write_bytes(b"spoiled")
    assert there.found() is None
    byhand = Context(tmp_path / "run").optional_cache(Keypoints, str(tmp_path / "a"))
    byhand.leave(Keypoints(np.arange(3.0)))
    assert byhand.found() is None
