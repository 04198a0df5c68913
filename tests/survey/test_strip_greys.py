"""Bit depth and sign of strips: what their values say about the geometry file, and values given back."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
import yaml

from geomosaic.ccd.layout import image_space_layout
from geomosaic.ccd.model import StripOffsets
from geomosaic.composition.strip_compose import PlacedStrips, compose_strips
from geomosaic.errors import InputError
from geomosaic.pipeline.context import Context
from geomosaic.pipeline.stage_recorder import StageRecorder
from geomosaic.recording import Recorder
from geomosaic.stages.survey_strips import survey_strips
from geomosaic.survey.strips import StripGeometry

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")


def read(folder: Path, strips: list[np.ndarray], **entry: Any) -> StripGeometry:
    """What the stage makes of two strips, rows 100 lines apart."""
    entry |= {"line_rate_hz": 3000.0, "row_separation_lines": 100, "overlap_px": 12, "read_px": 16}
    entry["ccds"] = [{"path": f"{k}.tif", "row": 1 + k} for k in range(2)]
    for k, pixels in enumerate(strips):
        profile = {"driver": "GTiff", "count": 1, "dtype": pixels.dtype, "width": 48, "height": len(pixels)}
        with rasterio.open(folder / f"{k}.tif", "w", **profile) as out:
            out.write(pixels, 1)
    (folder / "geometry.yaml").write_text(yaml.safe_dump(entry))
    stage = survey_strips()
    with Recorder(folder / "run.mcap", fixed_time=True) as recorder:
        recorder.begin_run("name: strips\n", {}, {})
        recorder.stage_started(stage.id, stage.version, {}, {})
        context = Context(folder, stage_id=stage.id, recorder=StageRecorder(recorder))
        found = stage.run({}, stage.Params(geometry=folder / "geometry.yaml"), context)["strips"]
    assert isinstance(found, StripGeometry)
    return found


def waves(lines: int, dtype: str = "uint16") -> np.ndarray:
    col, line = np.arange(48), np.arange(lines)[:, None]
    return np.rint(600.0 + 300.0 * np.sin(col / 9.0) * np.cos(line / 11.0)).astype(dtype)


def test_a_bit_depth_below_the_data_is_refused(tmp_path: Path) -> None:
    """More than half of a scene was cut to 1023 without a word."""
    bright = waves(400)
    bright[:, 20] = 3200
    with pytest.raises(InputError) as caught:
        read(tmp_path, [waves(400), bright], bit_depth=10)
    assert str(caught.value) == (
        f"{tmp_path / '1.tif'}: has values of 3200, but bit_depth is 10, so all above 1023 would be cut; "
        "leave bit_depth out, or give nodata: 3200 if that marks missing pixels"
    )
    assert read(tmp_path, [waves(400), bright], bit_depth=12).bit_depth == 12
    assert read(tmp_path, [waves(400), bright], bit_depth=10, nodata=3200).bit_depth == 10


@pytest.mark.parametrize(("bits", "offset"), [({}, -32768.0), ({"bit_depth": 12}, -4096.0)])
def test_strips_with_negative_values_give_them_back(
    tmp_path: Path, bits: dict[str, int], offset: float
) -> None:
    """From -300 to 300, with a missing pixel; columns of a negative mean were taken for stuck ones."""
    strips = [waves(400, "int16") - np.int16(600) for _ in range(2)]
    strips[0][150, 5] = -9999
    g = read(tmp_path, strips, nodata=-9999, **bits)
    assert g.scale is not None
    assert (g.scale.offset, g.scale.scale, g.nodata) == (offset, 1.0, 0.0)
    assert 2**g.bit_depth == -2 * offset
    compose_strips(PlacedStrips(g, image_space_layout(g, StripOffsets("none", ()))), tmp_path / "scene.tif")
    with rasterio.open(tmp_path / "scene.tif") as scene:
        assert (scene.dtypes[0], scene.offsets[0], scene.scales[0]) == ("uint16", offset, 1.0)
        values, valid = scene.offsets[0] + scene.read(1).astype(np.float64), scene.dataset_mask() > 0
    # Row 1 is half the separation ahead of the scene's lines, and the scene begins as much before line 0.
    np.testing.assert_array_equal(
        values[100:500, :36][valid[100:500, :36]], strips[0][:, :36][valid[100:500, :36]]
    )
    assert (~valid[100:500, :36]).sum() == 1


def test_int16_without_negative_values_stays_as_it_is(tmp_path: Path) -> None:
    g = read(tmp_path, [waves(400, "int16")] * 2)
    assert (g.scale, g.bit_depth) == (None, 15)
