"""What the stage `ccd.offsets` says of strips without texture, of narrow overlaps, and of better ways."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
import yaml

from geomosaic.ccd.model import UNRELIABLE, StripOffsets
from geomosaic.pipeline.context import Context
from geomosaic.pipeline.stage_recorder import StageRecorder
from geomosaic.recording import Recorder
from geomosaic.stages.ccd_offsets import ccd_offsets
from geomosaic.stages.strip_input import better_offsets
from geomosaic.survey.strips import read_geometry

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")


def sought(folder: Path, overlap_px: int = 96, **params: Any) -> tuple[StripOffsets, dict[str, str]]:
    """Offsets of three strips of noise and nothing else, and the warnings' texts by code."""
    rng = np.random.default_rng(3)
    entry = {"line_rate_hz": 3272.4, "row_separation_lines": 400, "ground_pixel_m": 2.0}
    entry |= {"overlap_px": overlap_px, "read_px": overlap_px + 14}
    ccds = [{"path": f"{k}.tif", "row": 1 + k % 2} for k in range(3)]
    for ccd in ccds:
        profile = {"driver": "GTiff", "count": 1, "dtype": "uint16", "width": 256, "height": 1600}
        with rasterio.open(folder / str(ccd["path"]), "w", **profile) as out:
            out.write(np.rint(300.0 + rng.normal(0.0, 4.0, (1600, 256))).astype(np.uint16), 1)
    (folder / "geometry.yaml").write_text(yaml.safe_dump(entry | {"ccds": ccds}))
    stage = ccd_offsets()
    with Recorder(folder / "run.mcap", fixed_time=True) as recorder:
        recorder.begin_run("name: strips\n", {}, {})
        recorder.stage_started(stage.id, stage.version, {}, {})
        context = Context(folder, stage_id=stage.id, recorder=StageRecorder(recorder))
        given = {"strips": read_geometry(folder / "geometry.yaml")}
        found = stage.run(given, stage.Params(**params), context)["offsets"]
    return found, {warning["code"]: warning["text"] for warning in context.notes.warnings}


def test_offsets_without_texture_are_unknown_and_called_a_guess(tmp_path: Path) -> None:
    """They are not those of the nominal geometry, and some lines claimed half a pixel."""
    found, warned = sought(tmp_path)
    for pair in found.pairs:
        assert (pair.label == UNRELIABLE).all()
        assert min(pair.sd_col_px.min(), pair.sd_line_px.min()) >= 10.0
    assert any(pair.dline_px.any() for pair in found.pairs)
    assert warned["overlap-unmeasured"].startswith(
        "no matches with 2.tif: joined by a best guess, so the seam"
    )
    assert "search-narrowed" not in warned


def test_a_search_that_a_narrow_overlap_cuts_is_named(tmp_path: Path) -> None:
    _, warned = sought(tmp_path, overlap_px=24, search_cols_px=20)
    text = "overlaps of 24 columns allow a search of 4 columns across instead of 20: CCDs mounted"
    assert warned["search-narrowed"].startswith(text)
    assert warned["overlap-unmeasured"].startswith("no matches with 2.tif within 4 columns: joined by")


def test_a_method_that_takes_the_nominal_geometry_says_so(tmp_path: Path) -> None:
    _, warned = sought(tmp_path, overlap_px=24, method="whole_scene")
    text = "no matches with 2.tif: joined by the nominal geometry, so the seam may be off"
    assert warned.keys() == {"overlap-unmeasured"} and warned["overlap-unmeasured"].startswith(text)


def test_the_way_to_better_offsets_is_one_that_changes_them(tmp_path: Path) -> None:
    """A model alone changes nothing of `joint`, and neither model nor DEM anything of most others."""
    sought(tmp_path, method="whole_scene")
    bare = read_geometry(tmp_path / "geometry.yaml")
    assert better_offsets(bare, "joint") == "'model' and 'dem' in the geometry file"
    assert better_offsets(bare, "mean_offset") == "--method joint or virtual_line"
    assert better_offsets(bare, "virtual_line") == "--method joint"
