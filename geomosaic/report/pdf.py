"""A report's page as PDF, printed by the browser that is there."""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
from contextlib import suppress
from pathlib import Path
from typing import Final

from geomosaic.errors import InputError

_BROWSERS: Final = (
    "chromium",
    "chromium-browser",
    "google-chrome",
    "google-chrome-stable",
    "microsoft-edge",
    "chrome",
    "msedge",
)
_LONGEST_S: Final = 300.0  # of printing a page: a report of thousands of frames takes a minute
_DRAWN_MS: Final = 10_000  # of the page's own time, in which its map is drawn: less prints it half drawn


def browser() -> Path:
    """The browser that prints. Raises: InputError where there is none."""
    found = next((path for name in _BROWSERS if (path := shutil.which(name))), None)
    if found is None:
        raise InputError(
            "--pdf needs a browser of the Chromium family, and none is in the PATH",
            fix="install chromium, or leave out --pdf and print report.html",
        )
    return Path(found)


def print_page(page: Path, target: Path) -> None:
    """Prints a page that holds all it needs to `target`; the browser has a profile of its own, for once.

    Raises: InputError where there is no browser, or it prints nothing.
    """
    program = browser()
    with tempfile.TemporaryDirectory(prefix="geomosaic-pdf-") as folder:
        printed = Path(folder) / "report.pdf"
        words = [
            str(program),
            "--headless",
            "--disable-gpu",
            "--disable-extensions",
            "--no-first-run",
            "--no-pdf-header-footer",
            f"--user-data-dir={folder}/profile",
            f"--virtual-time-budget={_DRAWN_MS}",
            f"--print-to-pdf={printed}",
        ]
        if hasattr(os, "geteuid") and os.geteuid() == 0:
            words.append("--no-sandbox")  # Chromium refuses its sandbox to root
        with suppress(subprocess.TimeoutExpired):
            subprocess.run(  # noqa: S603
                [*words, page.resolve().as_uri()], capture_output=True, check=False, timeout=_LONGEST_S
            )
        if not printed.exists() or not printed.read_bytes()[:5] == b"%PDF-":
            raise InputError(
                f"{program.name} printed no PDF of {page.name}", fix="leave out --pdf and print report.html"
            )
        shutil.copyfile(printed, target)
