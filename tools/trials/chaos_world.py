"""The world of a chaos trial: inputs that can be changed, a disk that can be full, runs that can be hit."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import sqlite3
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from hashlib import blake2b
from pathlib import Path
from typing import Any

import rasterio

from geomosaic_simulate.plan import SurveyPlan
from geomosaic_simulate.survey import simulate_frames
from tools.fuzz.fuzz_base import make_base
from tools.trials.chaos_changes import hold_back

DISK_MB = 256
PROGRAM = Path(sys.executable).with_name("geomosaic")
FLIGHT = SurveyPlan(
    lines=3, frames_per_line=5, width_px=480, height_px=360,
    height_above_ground_m=50.0, position_sd_m=0.4, height_sd_m=0.4,
)  # fmt: skip
"""More frames than workers, so that a stage can be hit in its middle."""
LONGEST_S = 180.0
_VOLATILE = (
    *("timings_s", "memory_mb", "peak_memory_mb"),
    *("cached_stages", "recorded_stages", "versions"),
)
"""What run.json says of the clock and the way, not of the result."""


@dataclass(frozen=True)
class EndedRun:
    """How a run ended: exit code (a signal negative), its words, seconds from the blow to the end."""

    code: int
    err: str
    seconds: float
    hung: bool
    orphans: int

    @property
    def last(self) -> str:
        return (self.err.strip().splitlines() or [""])[-1]


class Running:
    """A command of geomosaic in a session of its own."""

    def __init__(self, argv: list[str], log: Path) -> None:
        self.log = log
        with log.open("wb") as out:
            self.process = subprocess.Popen(
                [str(PROGRAM), *argv],
                stdin=subprocess.DEVNULL,
                stdout=out,
                stderr=out,
                start_new_session=True,
            )

    def wait(self, seconds: float) -> bool:
        """Whether it ended within so long."""
        try:
            self.process.wait(max(seconds, 0.0))
        except subprocess.TimeoutExpired:
            return False
        return True

    def stages(self) -> dict[str, float]:
        """The stages that it has finished, with their seconds."""
        finished = re.compile(r"^\[\d+/\d+\] (.+): (?:([\d.]+) s|unchanged, .+)$", re.MULTILINE)
        return {name: float(s or 0.0) for name, s in finished.findall(self.log.read_text())}

    def wait_for(self, stage: str, seconds: float) -> None:
        """Until the stage before this one is finished, and so long after."""
        while self.process.poll() is None and stage not in self.stages():
            time.sleep(0.01)
        self.wait(seconds)

    def children(self) -> list[int]:
        """Its worker processes; not Python's own keeper of semaphores, which works at nothing, nor the
        process that workers are forked from."""
        alive = list(processes())
        mine = [pid for pid, parent, _ in alive if parent == self.process.pid]
        servers = [pid for pid in mine if b"forkserver" in _command(pid)]
        forked = [pid for pid, parent, _ in alive if parent in servers]
        return [
            pid for pid in mine if pid not in servers and b"resource_tracker" not in _command(pid)
        ] + forked

    def end(self, struck: float) -> EndedRun:
        """Waits for the end; a run that has none is ended."""
        hung = not self.wait(LONGEST_S)
        seconds = time.monotonic() - struck
        deadline = time.monotonic() + 5.0
        while (left := self._left()) and time.monotonic() < deadline:
            time.sleep(0.05)
        for pid in (*left, *([self.process.pid] if hung else [])):
            try:
                os.kill(pid, signal.SIGKILL)
            except ProcessLookupError:
                continue
        code = self.process.wait()
        return EndedRun(code, self.log.read_bytes().decode(errors="replace"), seconds, hung, len(left))

    def _left(self) -> list[int]:
        """What lives on of its session after it."""
        return [p for p, _, session in processes() if session == self.process.pid and p != self.process.pid]


def processes() -> Iterator[tuple[int, int, int]]:
    """(id, parent, session) of the living processes of this machine."""
    for folder in Path("/proc").iterdir():
        if folder.name.isdigit():
            try:
                words = (folder / "stat").read_text().rpartition(")")[2].split()
            except OSError:
                continue
            if words[0] != "Z":
                yield int(folder.name), int(words[1]), int(words[3])


def _command(pid: int) -> bytes:
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes()
    except OSError:
        return b""


class Disk:
    """The run folder's disk: a small file system of its own where that is allowed."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        folder.mkdir(parents=True)
        options = ["-t", "tmpfs", "-o", f"size={DISK_MB}m", "tmpfs", str(folder)]
        self.own = (
            os.geteuid() == 0 and subprocess.run(["mount", *options], capture_output=True).returncode == 0
        )

    def used_kb(self) -> int:
        reported = os.statvfs(self.folder)
        return (reported.f_blocks - reported.f_bfree) * reported.f_frsize // 1024

    def resize(self, kb: int) -> None:
        subprocess.run(["mount", "-o", f"remount,size={kb}k", str(self.folder)], check=True)

    def large(self) -> None:
        if self.own:
            self.resize(DISK_MB * 1024)

    def clear(self) -> None:
        self.large()
        for path in self.folder.iterdir():
            shutil.rmtree(path) if path.is_dir() and not path.is_symlink() else path.unlink()

    def close(self) -> None:
        if self.own:
            subprocess.run(["umount", "--lazy", str(self.folder)], check=True)  # a worker may hold a file


def result_of(run: Path) -> dict[str, str]:
    """Fingerprints of what a run's result is, by name; what is missing is not there."""
    found: dict[str, str] = {}
    for name in ("positions.csv", "offsets.csv", "mosaic_RPC.TXT"):
        if (run / name).exists():
            found[name] = _hash((run / name).read_bytes())
    if (run / "mosaic.tif").exists():
        with rasterio.open(run / "mosaic.tif") as file:
            found["mosaic.tif"] = _hash(file.read().tobytes() + f"{file.crs} {file.transform}".encode())
    if (run / "layers.gpkg").exists():
        found["layers.gpkg"] = _hash(json.dumps(_tables(run / "layers.gpkg"), default=repr).encode())
    if (run / "run.json").exists():
        run_summary = json.loads((run / "run.json").read_text())
        run_summary.get("metrics", {}).pop(
            "estimate", None
        )  # of the machine and its workers, not of the result
        run_summary.get("artefacts", {}).pop("report_file", None)  # it tells the time that the run took
        for name, value in run_summary.items():
            if name not in _VOLATILE:
                found.update(_parts(f"run.json {name}", value))
    return found


def items_of(run: Path) -> dict[Path, tuple[int, int]]:
    """What single frames, pairs and tiles gave, with what shows whether it was made again."""
    found = [path for path in run.glob("work/*/items/*/*") if not path.name.startswith(".")]
    return {path: (path.stat().st_ino, path.stat().st_mtime_ns) for path in found}


def _parts(name: str, value: Any, depth: int = 3) -> dict[str, str]:
    """The parts of a tree by name, so that a difference says where it is."""
    if isinstance(value, dict) and depth:
        return {n: m for k, v in value.items() for n, m in _parts(f"{name}.{k}", v, depth - 1).items()}
    text = json.dumps(value, sort_keys=True)
    return {name: text if len(text) < 200 else f"{text[:100]}... {_hash(text.encode())}"}


def _hash(data: bytes) -> str:
    return blake2b(data, digest_size=16).hexdigest()


def _tables(path: Path) -> dict[str, list[Any]]:
    """All rows of a GeoPackage but the time of its last change."""
    with sqlite3.connect(f"file:{path}?mode=ro", uri=True) as file:
        names = [
            r[0] for r in file.execute("select name from sqlite_master where type = 'table' order by name")
        ]
        names = [n for n in names if not n.startswith(("rtree_", "sqlite_", "gpkg_"))]
        return {n: [list(row) for row in file.execute(f'select * from "{n}"')] for n in names}


@dataclass
class Trial:
    """One trial's plan and outcome. silent_s: how old the last words of recordings of killed runs were."""

    number: int
    what: str
    team: str
    method: str
    blows: list[str] = field(default_factory=list)
    seconds: dict[str, float] = field(default_factory=dict)
    silent_s: list[float] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)
    ended: str = ""
    words: str = ""
    kept: int = 0
    again: int = 0


class World:
    """Inputs, disk, the references of every state of the inputs, and the Dask cluster."""

    def __init__(self, folder: Path, seed: int) -> None:
        self.folder, self.seed = folder, seed
        make_base(folder / "base", seed)
        shutil.rmtree(folder / "base" / "tiffs")
        simulate_frames(folder / "base" / "flight", replace(FLIGHT, seed=seed))
        self.inputs = folder / "in"
        self.disk = Disk(folder / "disk")
        self.run = self.disk.folder / "run"
        self.references: dict[str, tuple[int, dict[str, str], str]] = {}
        self.length_s: dict[str, float] = {}
        self.stages: dict[str, dict[str, float]] = {}
        self.used_kb: dict[str, int] = {}
        self._cluster: Any = None

    def restore(self, what: str) -> None:
        """The inputs as they were at first; nothing on the disk."""
        shutil.rmtree(self.inputs, ignore_errors=True)
        shutil.copytree(self.folder / "base" / {"frames": "survey"}.get(what, what), self.inputs)
        if what != "strips":
            hold_back(self.inputs)
        self.disk.clear()

    def command(self, trial: Trial, run: Path) -> list[str]:
        """The command of a trial; the same for each of its runs."""
        if trial.what == "strips":
            words = ["strips", str(self.inputs / "geometry.yaml")]
        else:
            words = ["mosaic", str(self.inputs / "frames"), "--adjust", trial.method]
            words += ["--pos", str(self.inputs / "pos.csv"), "--camera", str(self.inputs / "cameras.json")]
        team = ["--dask", self.cluster()] if trial.team == "dask" else ["--workers", trial.team]
        return [*words, "-o", str(run), *team]

    def cluster(self) -> str:
        """The address of a Dask cluster of two workers."""
        if self._cluster is None:
            from distributed import LocalCluster

            self._cluster = LocalCluster(
                n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None, silence_logs=50
            )
        return str(self._cluster.scheduler_address)

    def dask_workers(self) -> list[int]:
        """Process ids of the cluster's workers."""
        return [n.pid for n in self._cluster.workers.values() if n.pid] if self._cluster is not None else []

    def reference(self, trial: Trial, state: str) -> tuple[int, dict[str, str], str]:
        """Exit code and result of a fresh run over the inputs as they are now."""
        key = f"{trial.what} {trial.method} {state}"
        if key not in self.references:
            fresh = self.disk.folder / "fresh"
            alone = Trial(0, trial.what, "1", trial.method)
            started, used = time.monotonic(), self.disk.used_kb()
            running = Running(self.command(alone, fresh), self.folder / "fresh.log")
            ended = running.end(started)
            self.length_s.setdefault(f"{trial.what} {trial.method}", ended.seconds)
            self.stages.setdefault(f"{trial.what} {trial.method}", running.stages())
            self.used_kb.setdefault(trial.what, self.disk.used_kb() - used)
            self.references[key] = (ended.code, result_of(fresh), ended.last)
            shutil.rmtree(fresh, ignore_errors=True)
        return self.references[key]

    def close(self) -> None:
        if self._cluster is not None:
            self._cluster.close()
        self.disk.close()
