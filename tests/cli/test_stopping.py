"""Ctrl-C and SIGTERM, whatever is being done."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
import rasterio

from geomosaic.export.cog import write_cog

STUBBORN = """
import sys, time, geomosaic.cli.main as main
def stubborn(argv, stop):
    while True:
        try:
            print("ready", flush=True)
            while True:
                time.sleep(0.01)
        except KeyboardInterrupt:
            {then}
main._main = stubborn
sys.exit(main.main())
"""


@pytest.fixture(scope="module")
def raster(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("raster") / "raster.tif"
    shape = {"width": 2000, "height": 2000, "count": 3, "dtype": "uint8", "crs": "EPSG:32632"}
    with rasterio.open(
        path, "w", driver="GTiff", transform=rasterio.Affine(1, 0, 5e5, 0, -1, 5e6), **shape
    ) as out:
        out.write(np.random.default_rng(1).integers(0, 255, (3, 2000, 2000), dtype=np.uint8))
    return path


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("percent", [0, pytest.param(20, marks=pytest.mark.proof), 70])
def test_a_signal_while_gdal_writes_stops_it_and_leaves_nothing(
    number: int, percent: int, raster: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """Raised in GDAL's callback it was printed, and taken for a fault of the disk."""

    def stop(*_: object) -> None:
        raise KeyboardInterrupt

    def progress(done: int, _: int) -> None:
        if done >= percent:
            os.kill(os.getpid(), number)

    before = signal.signal(number, stop)
    try:
        with pytest.raises(KeyboardInterrupt):
            write_cog(raster, tmp_path / "cog.tif", progress=progress)
        assert signal.getsignal(number) is stop
    finally:
        signal.signal(number, before)
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
@pytest.mark.parametrize(
    "then",
    [
        "pass",
        "raise OSError('disk')",
        pytest.param("return 0", marks=pytest.mark.proof),
        pytest.param("raise", marks=pytest.mark.proof),
    ],
)
def test_a_command_ends_in_time_with_the_signal_s_code(number: int, code: int, then: str) -> None:
    """Also where a library swallows the exception, or makes another one of it."""
    process = subprocess.Popen(
        [sys.executable, "-c", STUBBORN.format(then=then)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None and process.stdout.readline() == "ready\n"
    started = time.monotonic()
    process.send_signal(number)
    _, err = process.communicate(timeout=20)
    if then in ("pass", "return 0"):
        assert process.returncode == code
    assert time.monotonic() - started < 10.0
    assert process.returncode != 0 and (then != "pass" or err == "geomosaic: stopped\n")


def test_a_long_call_of_a_library_holds_up_no_stop() -> None:
    """Python's own handlers wait until such a call comes back."""
    code = (
        "import hashlib, sys, geomosaic.cli.main as main\n"
        "def long(argv, stop):\n"
        "    print('ready', flush=True)\n"
        "    hashlib.pbkdf2_hmac('sha512', b'a', b'b', 10**9)\n"
        "main._main = long\n"
        "sys.exit(main.main())"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert process.stdout is not None and process.stdout.readline() == "ready\n"
    time.sleep(0.2)
    started = time.monotonic()
    process.send_signal(signal.SIGTERM)
    _, err = process.communicate(timeout=20)
    assert (process.returncode, err) == (143, "geomosaic: stopped\n")
    assert time.monotonic() - started < 10.0


def test_a_stopped_program_waits_for_nothing_at_its_exit() -> None:
    """What a library still wants to do at exit, such as writing a raster, could take a minute."""
    code = (
        "import sys, time, geomosaic.cli.main as main\n"
        "class Slow:\n"
        "    def __del__(self, sleep=time.sleep): sleep(60)\n"
        "def stopped(argv, stop):\n"
        "    sys.modules['__main__'].kept = Slow()\n"
        "    print('ready', flush=True)\n"
        "    try: time.sleep(60)\n"
        "    except KeyboardInterrupt: return 130\n"
        "main._main = stopped\n"
        "sys.exit(main.main())"
    )
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None and process.stdout.readline() == "ready\n"
    process.send_signal(signal.SIGINT)
    started = time.monotonic()
    process.communicate(timeout=20)
    assert process.returncode == 130
    assert time.monotonic() - started < 2.0


def test_a_program_that_has_ended_gives_nothing_back_piece_by_piece() -> None:
    """Its files are written and its output is flushed; the exit code is the command's."""
    code = (
        "import atexit, sys, time, geomosaic.cli.main as main\n"
        "class Slow:\n"
        "    def __del__(self, sleep=time.sleep): sleep(60)\n"
        "def ended(argv, stop):\n"
        "    sys.modules['__main__'].kept = Slow()\n"
        "    atexit.register(print, 'others have their turn')\n"
        "    print('said', end=' ')\n"
        "    return 3\n"
        "main._main = ended\n"
        "sys.exit(main.main())"
    )
    started = time.monotonic()
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=20)
    assert (done.returncode, done.stdout, done.stderr) == (3, "said others have their turn\n", "")
    assert time.monotonic() - started < 10.0


def test_a_signal_that_is_ignored_stays_so() -> None:
    """As under nohup, or in the background of a script."""
    code = (
        "import signal; signal.signal(signal.SIGINT, signal.SIG_IGN); import geomosaic.cli.stopping as s\n"
        "with s.stoppable(): print(signal.getsignal(signal.SIGINT) is signal.SIG_IGN)"
    )
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout == "True\n"


@pytest.mark.parametrize(
    "after_s",
    [pytest.param(0.5, marks=pytest.mark.proof), 0.7, pytest.param(0.9, marks=pytest.mark.proof), 1.2],
)
def test_workers_that_are_being_prepared_hear_no_interrupt(after_s: float, tmp_path: Path) -> None:
    """Ctrl-C goes to the whole group: the process that workers are forked from is then among its imports."""
    for i in range(3):
        cv2.imwrite(str(tmp_path / f"{i}.jpg"), np.full((300, 400, 3), 90 + i, np.uint8))
    program = "import sys; from geomosaic.cli.main import main; sys.exit(main())"
    command = [
        sys.executable,
        "-c",
        program,
        "mosaic",
        str(tmp_path),
        "-o",
        str(tmp_path / "run"),
        "--workers",
        "2",
    ]
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True
    )
    time.sleep(after_s)
    if process.poll() is None:
        os.killpg(process.pid, signal.SIGINT)
    said, _ = process.communicate(timeout=20)
    assert "forkserver" not in said, said
    assert process.returncode != 130 or "Traceback" not in said, said
