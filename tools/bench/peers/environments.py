"""Environments of other programs, from PyPI, one each, made once."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path


class UnavailableError(Exception):
    """A peer can't be had here; its text says why."""


def environment(folder: Path, *requirements: str) -> Path:
    """The folder of an environment's programs. Raises `UnavailableError` where pip can't make it."""
    programs, ready = folder / "bin", folder / "ready"
    if ready.exists() and ready.read_text().split() == list(requirements):
        return programs
    for command in (
        [sys.executable, "-m", "venv", "--clear", folder],
        [programs / "python", "-m", "pip", "install", "--quiet", *requirements],
    ):
        done = subprocess.run(list(map(str, command)), capture_output=True, text=True, check=False)
        if done.returncode:
            said = (done.stderr.strip().splitlines() or ["nothing said"])[-1]
            raise UnavailableError(f"{' '.join(requirements)} can't be installed: {said[:200]}")
    ready.write_text("\n".join(requirements))
    return programs
