"""survey.mk in somebody's Makefile: three surveys, every product, side by side, and settled when they are made."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from small_surveys import small_survey

MAKEFILE = """\
north_FLAGS :=
GEOMOSAIC := {geomosaic}
GEOMOSAIC_COMMAND := run none
WORKERS := 1
EXPORTS := tiles stac
include $(shell $(GEOMOSAIC) recipes --makefile)

hello:
	@echo hello
"""


@pytest.fixture
def desk(tmp_path: Path) -> Path:
    """A folder with a Makefile and three flights of three frames, a blank in one's name."""
    survey = small_survey(
        tmp_path / "sim", lines=1, frames_per_line=5, width_px=240, height_px=180, pos_in="exif"
    )
    frames = sorted(survey.frames.glob("*.jpg"))
    for k, name in enumerate(("north", "middle", "south")):
        folder = tmp_path / "flights" / name
        folder.mkdir(parents=True)
        for frame in frames[k : k + 3]:
            shutil.copy2(frame, folder / f"a {frame.name}")
    geomosaic = f"{sys.executable} -m geomosaic.cli.main"
    (tmp_path / "Makefile").write_text(MAKEFILE.format(geomosaic=geomosaic))
    return tmp_path


def make(desk: Path, *arguments: str) -> tuple[int, str]:
    """Its exit code and what it printed."""
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("MAKE", "MFLAGS"))}
    done = subprocess.run(
        ["make", *arguments], cwd=desk, env=environment, capture_output=True, text=True, timeout=300
    )
    return done.returncode, done.stdout + done.stderr


def test_three_surveys_are_made_side_by_side_and_then_settled(desk: Path) -> None:
    code, said = make(desk, "-j2", "mosaics", "reports", "tiles", "stac")
    assert code == 0, said
    for name in ("north", "middle", "south"):
        out = desk / "out" / name
        assert all((out / file).exists() for file in ("mosaic.tif", "report.html", "tiles"))
    for goals in ([], ["mosaics", "layers", "reports", "tiles", "stac", "out/south/positions.csv"]):
        assert make(desk, "-q", *goals)[0] == 0
    assert "Nothing to be done for 'mosaics'" in make(desk)[1]
    # Outputs from the cache keep their times: the target must be settled none the less.
    (frame, *_) = sorted((desk / "flights" / "middle").iterdir())
    frame.touch()
    before = (desk / "out" / "middle" / "mosaic.tif").stat().st_mtime_ns
    code, said = make(desk, "mosaics")
    assert code == 0 and said.count("main run none") == 1 and "from the cache" in said
    assert (desk / "out" / "middle" / "mosaic.tif").stat().st_mtime_ns == before
    assert make(desk, "-q", "mosaics")[0] == 0 and make(desk, "-q", "tiles")[0] == 1
    frame.unlink()
    assert make(desk, "-n", "out/middle/layers.gpkg")[1].count("main run none") == 1
    text = (desk / "Makefile").read_text().replace("north_FLAGS :=", "north_FLAGS := --seed 2")
    (desk / "Makefile").write_text(text)
    code, said = make(desk, "-n", "out/north/mosaic.tif", "out/south/mosaic.tif")
    assert said.count("main run none flights/north -o out/north") == said.count("main run none") == 1
    assert make(desk, "hello") == (0, "hello\n")


def test_a_survey_that_fails_stops_no_other(desk: Path) -> None:
    for frame in (desk / "flights" / "north").iterdir():
        frame.write_text("no image")
    (desk / "flights" / "middle").rename(desk / "middle")
    code, said = make(desk, "-k", "mosaics")
    assert code == 2 and "is no JPEG file" in said
    assert (desk / "out" / "south" / "mosaic.tif").exists() and not (
        desk / "out" / "north" / "run.json"
    ).exists()
