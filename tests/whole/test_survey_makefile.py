"""survey.mk in somebody's Makefile: three surveys, every product, side by side, and up to date when they are
made; one that fails stops no other."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from small_surveys import small_survey

import geomosaic

MAKEFILE = """\
north_FLAGS :=
GEOMOSAIC := {geomosaic}
GEOMOSAIC_COMMAND := run slim.yaml
WORKERS := 1
EXPORTS := tiles stac
include $(shell $(GEOMOSAIC) recipes --makefile)

hello:
	@echo hello
"""

SLIM = """\
stages: [survey.read, projection.ground, placement.pos, matching.sift,
  {stage: adjustment.solve, params: {method: none}}, mosaic.seams, mosaic.compose, export.cog, export.layers, export.report]
"""
EXPORTED = ["out/middle/.tiles", "out/middle/.stac"]
"""Of one survey, side by side: what `make tiles stac` makes of all."""


@pytest.fixture
def desk(tmp_path: Path) -> Path:
    """A folder with a Makefile, three flights of three frames, blanks in their names, and one that is broken."""
    survey = small_survey(
        tmp_path / "sim", lines=1, frames_per_line=5, width_px=240, height_px=180, pos_in="exif"
    )
    frames = sorted(survey.frames.glob("*.jpg"))
    for k, name in enumerate(("north", "middle", "south")):
        folder = tmp_path / "flights" / name
        folder.mkdir(parents=True)
        for frame in frames[k : k + 3]:
            shutil.copy2(frame, folder / f"a {frame.name}")
    (tmp_path / "flights" / "broken").mkdir()
    (tmp_path / "flights" / "broken" / "a.jpg").write_text("no image")
    (tmp_path / "slim.yaml").write_text(SLIM)
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


@pytest.mark.proof
def test_three_surveys_are_made_side_by_side_and_then_up_to_date(desk: Path) -> None:
    code, said = make(desk, "-k", "-j2", "mosaics", "reports", *EXPORTED)
    assert code == 2 and said.count("geomosaic: ") == 1 and "is no JPEG file" in said, said
    (desk / "flights" / "broken").rename(desk / "broken")
    for name in ("north", "middle", "south"):
        out = desk / "out" / name
        assert all((out / file).exists() for file in ("mosaic.tif", "report.html"))
    assert (desk / "out" / "middle" / "tiles").is_dir()
    for goals in ([], ["mosaics", "layers", "reports", *EXPORTED, "out/south/positions.csv"]):
        assert make(desk, "-q", *goals)[0] == 0
    assert "Nothing to be done for 'mosaics'" in make(desk)[1]
    # Outputs from the cache keep their times: the target must be up to date none the less.
    (frame, *_) = sorted((desk / "flights" / "middle").iterdir())
    frame.touch()
    before = (desk / "out" / "middle" / "mosaic.tif").stat().st_mtime_ns
    code, said = make(desk, "mosaics")
    assert code == 0 and said.count("main run slim.yaml") == 1 and "from the cache" in said
    assert (desk / "out" / "middle" / "mosaic.tif").stat().st_mtime_ns == before
    assert make(desk, "-q", "mosaics")[0] == 0 and make(desk, "-q", *EXPORTED)[0] == 1
    frame.unlink()
    assert make(desk, "-n", "out/middle/layers.gpkg")[1].count("main run slim.yaml") == 1
    text = (desk / "Makefile").read_text().replace("north_FLAGS :=", "north_FLAGS := --seed 2")
    (desk / "Makefile").write_text(text)
    code, said = make(desk, "-n", "out/north/mosaic.tif", "out/south/mosaic.tif")
    assert (
        said.count("main run slim.yaml flights/north -o out/north") == said.count("main run slim.yaml") == 1
    )
    assert make(desk, "hello") == (0, "hello\n")


def test_a_run_that_strict_refuses_is_tried_again(tmp_path: Path) -> None:
    """It ends with 3, but has written run.json: make took it for made."""
    (tmp_path / "flights" / "north").mkdir(parents=True)
    (tmp_path / "flights" / "north" / "a.jpg").write_text("a frame")
    writes = "mkdir -p out/north; touch out/north/run.json out/north/mosaic.tif; exit $(cat code)"
    (tmp_path / "stub.sh").write_text(writes)
    recipes = Path(geomosaic.__file__).parent / "recipes"
    (tmp_path / "Makefile").write_text(f"GEOMOSAIC := sh stub.sh\ninclude {recipes}/survey.mk\n")
    for code, ends in ((3, 2), (3, 2), (0, 0), (3, 0)):
        (tmp_path / "code").write_text(str(code))
        assert make(tmp_path, "mosaics")[0] == ends
