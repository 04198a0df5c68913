"""Rerun's viewer: a window, or an image of it without a screen. It is bound to this machine (127.0.0.1), and
its analytics are off."""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from geomosaic.errors import GeomosaicError, OutputError

_NO_SCREEN = "Rerun's viewer doesn't start without a screen; install mesa-vulkan-drivers and libvulkan1"
_TRIES = 4
"""Of a screenshot: the viewer gives up after 15 s, and a busy machine paints slowly without a card."""


def open_viewer(file: Path) -> None:
    """Shows an .rrd in Rerun's window until the user closes it."""
    with _viewer(file, "--port", "auto") as viewer:
        if viewer.wait() != 0:
            raise GeomosaicError("Rerun's viewer failed; without a screen use --save or --screenshot")


def screenshot(file: Path, png: Path, seconds: float = 8.0) -> None:
    """An image of an .rrd as the viewer shows it, made without a screen after `seconds` of loading."""
    from rerun.experimental import ViewerClient

    port = free_port()
    with _viewer(file, "--headless", "--port", str(port)) as viewer:
        deadline = time.monotonic() + 60.0
        client = None
        while client is None:
            if viewer.poll() is not None or time.monotonic() > deadline:
                raise GeomosaicError(_NO_SCREEN)
            try:
                client = ViewerClient.connect(f"rerun+http://127.0.0.1:{port}/proxy")
                client.get_state()
            except (RuntimeError, OSError):
                client = None
                time.sleep(0.5)
        time.sleep(seconds)
        for tries_left in reversed(range(_TRIES)):
            try:
                client.save_screenshot(str(png.absolute()))
                break
            except (RuntimeError, OSError) as error:
                if viewer.poll() is not None:
                    raise GeomosaicError(_NO_SCREEN) from error
                if not tries_left:
                    fix = "choose another file, or run it again"
                    raise OutputError(f"no screenshot ({error})", file=png, fix=fix) from error


def free_port() -> int:
    """A port of this machine that nobody listens on."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@contextmanager
def _viewer(file: Path, *arguments: str) -> Iterator[subprocess.Popen[bytes]]:
    """Rerun's viewer as a child with settings of its own, so that the user's stay as they are."""
    with tempfile.TemporaryDirectory(prefix="geomosaic-view-") as settings:
        viewer = started(*arguments, str(file.absolute()), settings=Path(settings))
        try:
            yield viewer
        finally:
            if viewer.poll() is None:
                viewer.terminate()
                try:
                    viewer.wait(timeout=10)
                except subprocess.TimeoutExpired:
                    viewer.kill()
                    viewer.wait()


def started(*arguments: str, settings: Path | None = None) -> subprocess.Popen[bytes]:
    """Rerun's viewer, bound to this machine, its analytics off. settings: a folder for what it remembers."""
    import rerun_cli  # type: ignore[import-untyped]

    program = shutil.which("rerun", path=str(Path(rerun_cli.__file__).parent)) or shutil.which("rerun")
    if program is None:
        raise GeomosaicError("Rerun's viewer isn't installed; pip install rerun-sdk")
    own = {} if settings is None else {"XDG_CONFIG_HOME": str(settings), "XDG_DATA_HOME": str(settings)}
    quiet: dict[str, Any] = {
        "stdout": subprocess.DEVNULL,
        "stderr": subprocess.DEVNULL,
        "env": {**os.environ, **own},
    }
    subprocess.run([program, "analytics", "disable"], check=False, timeout=60, **quiet)  # noqa: S603
    return subprocess.Popen([program, "--bind", "127.0.0.1", *arguments], **quiet)  # noqa: S603
