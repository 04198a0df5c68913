"""What ends a run for lack of memory is one line with what to do."""

from __future__ import annotations

import numpy as np
import pytest

from geomosaic.cli import app
from geomosaic.cli.main import main


def test_too_little_memory_is_no_fault_but_a_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def build_app(argv: list[str] | None) -> None:
        np.empty(1 << 60, dtype=np.uint8)

    monkeypatch.setattr(app, "build_app", build_app)
    assert main(["info"]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("geomosaic: out of memory") and "--gsd" in line
    assert "fault" not in line
