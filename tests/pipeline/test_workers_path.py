"""What workers import: nothing that lies in the current folder."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from small_surveys import small_survey

from geomosaic.pipeline import executor

SCRIPT = """
from geomosaic.pipeline.executor import Workers
from geomosaic.pipeline.worker_process import prepare_workers
prepare_workers(["geomosaic.matching.sift"])
with Workers(2) as workers:
    print(workers.result(workers.submit(abs, -7)))
"""

THREADED = """
import ctypes, sys, threading

from geomosaic import mosaic

written, ended = [], threading.Event()
getenv = ctypes.CDLL(None).getenv


def look() -> None:
    while not ended.is_set():
        getenv(b"NOT_THERE")


sys.addaudithook(lambda event, args: written.append(args) if event in ("os.putenv", "os.unsetenv") else None)
threads = [threading.Thread(target=look) for _ in range(2)]
for thread in threads:
    thread.start()
try:
    run = mosaic(sys.argv[1], sys.argv[2], workers=2)
finally:
    ended.set()
print(run.folder.name, written)
"""


def test_workers_take_no_module_from_the_current_folder(tmp_path: Path) -> None:
    """Neither one of a library's name nor a folder named as the package, as a clone next to the frames is."""
    folder, script = tmp_path / "frames", tmp_path / "elsewhere" / "run.py"
    (folder / "geomosaic").mkdir(parents=True)
    for name in ("cv2", "signal", "numpy"):
        (folder / f"{name}.py").write_text("open('taken', 'w').close()\n")
    script.parent.mkdir()
    script.write_text(SCRIPT)
    package = str(Path(executor.__file__).parents[2])
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONSAFEPATH"} | {"PYTHONPATH": package}
    done = subprocess.run(
        [sys.executable, script], cwd=folder, env=environment, capture_output=True, text=True, timeout=120
    )
    assert (done.stdout.strip(), done.returncode) == ("7", 0), done.stderr
    assert not (folder / "taken").exists()


def test_the_environment_stays_as_it_is_while_workers_start(monkeypatch: pytest.MonkeyPatch) -> None:
    """C libraries read it in threads of their own: who writes it meanwhile may end the program (setenv(3))."""
    written: list[str] = []
    monkeypatch.setattr(os, "putenv", lambda name, _: written.append(os.fsdecode(name)))
    monkeypatch.setattr(os, "unsetenv", lambda name: written.append(os.fsdecode(name)))
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    written.clear()
    with executor.Workers(2) as workers:
        assert workers.result(workers.submit(os.getenv, "OMP_NUM_THREADS")) == "1"
    assert not written


def test_a_mosaic_is_made_while_threads_read_the_environment(tmp_path: Path) -> None:
    """From a program of one's own, whose C libraries read it; nothing is written to it meanwhile."""
    made = small_survey(tmp_path / "survey", lines=1, frames_per_line=2)
    (tmp_path / "program.py").write_text(THREADED)
    done = subprocess.run(
        [sys.executable, tmp_path / "program.py", made.frames, tmp_path / "run"],
        capture_output=True, text=True, timeout=300,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1] == "run []"
