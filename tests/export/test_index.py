"""Indices of a mosaic's bands: values, names of bands, formulas that are none, and what they say of their values."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import rasterio

from geomosaic.composition.model import OutputGrid
from geomosaic.composition.raster import MosaicFiles, writing_mosaic
from geomosaic.composition.tiles import TileKind
from geomosaic.composition.window import Composed, Window
from geomosaic.errors import InputError, UnknownNameError
from geomosaic.export.index import FORMULAS, USUAL, Index, index_ends, write_index
from geomosaic.export.project_rasters import index_colours, index_layers, index_style
from geomosaic.pipeline.stage import Context
from geomosaic.radiometry.quantity import CENTIKELVIN, UNCALIBRATED, Quantity, reflectance
from geomosaic.report.surface import index_picture
from geomosaic.stages.exports_for_gis import export_index

GRID = OutputGrid("EPSG:32632", 5e5, 5e6, 0.5, 40, 30)


def rig_mosaic(path: Path, quantity: Quantity) -> Path:
    """Green 0.1, red 0.2 and NIR 0.6 of 32768, valid but in the first column."""
    pixels = np.zeros((30, 40, 3), np.uint16)
    pixels[:] = np.rint(np.array([0.1, 0.2, 0.6]) * 32768.0)
    valid = np.full((30, 40), 255, np.uint8)
    valid[:, 0] = 0
    bands = {"Green": quantity, "Red": quantity, "NIR": quantity}
    with writing_mosaic(MosaicFiles(path), GRID, TileKind(3, np.dtype("uint16")), bands=bands) as out:
        window = Window(0, 0, 40, 30)
        out.write(Composed(window, pixels, valid, valid.astype(np.int16) - 1, (0,), ()))
    return path


def written(tmp_path: Path, formula: str, quantity: Quantity) -> Path:
    out = tmp_path / "index_a.tif"
    write_index(rig_mosaic(tmp_path / "mosaic.tif", quantity), out, Index.of(formula), lambda done, all: None)
    return out


@pytest.mark.parametrize(
    ("formula", "expected"),
    [
        ("ndvi", 0.5),
        ("GNDVI", 5 / 7),
        ("(NIR - g) / (NIR + g)", 5 / 7),
        ("2.5 * (nir - red) / (nir + 6 * red + 1)", 2.5 * 0.4 / 2.8),
        ("sqrt(abs(-red)) ** 2", 0.2),
    ],
)
def test_an_index_is_its_formula_of_physical_values(tmp_path: Path, formula: str, expected: float) -> None:
    with rasterio.open(written(tmp_path, formula, reflectance("panel", absolute=True))) as found:
        values = found.read(1, masked=True)
        assert found.dtypes == ("float32",) and found.crs.to_epsg() == 32632
        assert found.tags()["VALUES"] == "reflectance by panel"
    assert values.mask[:, 0].all() and not values.mask[:, 1:].any()
    assert values.mean() == pytest.approx(expected, abs=1e-4)


def test_a_band_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(UnknownNameError, match="rededge"):
        written(tmp_path, "NDRE", UNCALIBRATED)


@pytest.mark.parametrize(
    "formula",
    [
        "nir -",
        "__import__('os')",
        "nir.real",
        "[nir]",
        "nir if red else 1",
        "abs(nir, red)",
        "x" * 400,
        "1 + 1",
    ],
)
def test_what_is_no_formula_is_an_error_and_is_not_executed(formula: str) -> None:
    with pytest.raises(InputError):
        Index.of(formula)
    with pytest.raises(InputError, match="no name"):
        Index.of("nir", "../a")


def test_values_as_recorded_are_called_so(tmp_path: Path) -> None:
    with rasterio.open(written(tmp_path, "NDVI", UNCALIBRATED)) as found:
        assert found.tags()["VALUES"] == "uncalibrated values as recorded"


@pytest.mark.parametrize(
    ("warned", "limit"),
    [
        ([], "compare it within this map only, or"),
        ([{"code": "exposure-varies"}], "it differs from frame to frame as exposures do;"),
    ],
)
def test_an_index_of_uneven_exposures_is_not_called_comparable(
    tmp_path: Path, warned: list[dict[str, str]], limit: str
) -> None:
    rig_mosaic(tmp_path / "mosaic.tif", UNCALIBRATED)
    context = Context(tmp_path, work_folder=tmp_path / "work", summary={"warnings": warned})
    asked = {"mosaic_file": context.run_file("mosaic.tif")}
    export_index().run(asked, export_index.Params(formula="NDVI"), context)
    assert [w["text"] for w in context.notes.warnings] == [
        f"NDVI is of uncalibrated values as recorded: {limit} calibrate the frames with "
        "--radiometry reflectance"
    ]


def test_a_picture_has_a_legend_and_a_style_the_same_ends(tmp_path: Path) -> None:
    out = written(tmp_path, "NDVI", UNCALIBRATED)
    assert index_ends(out) == USUAL
    other = tmp_path / "other"
    other.mkdir()
    low, high = index_ends(written(other, "nir - red", reflectance("panel", absolute=True)))
    assert low < high
    picture = index_picture(out, USUAL, index_colours(out))
    assert picture[:30, 0, 3].max() == 0 and picture[:30, 1, 3].min() == 255
    assert picture.shape[0] == 66 and picture[32, :, 3].min() == 255
    assert 'classificationMax="1"' in index_style(out, USUAL)
    (layer,) = index_layers(tmp_path)
    assert layer.title == "a" and FORMULAS


def test_temperatures_are_degrees_with_colours_of_their_own(tmp_path: Path) -> None:
    """0.6 of 32768 are 196.61 K in hundredths."""
    mosaic = rig_mosaic(tmp_path / "mosaic.tif", CENTIKELVIN)
    index = Index.for_mosaic(mosaic, "temperature")
    out = tmp_path / "index_temperature.tif"
    assert write_index(mosaic, out, index, lambda done, all: None) == "temperature by the camera"
    with rasterio.open(out) as found:
        assert found.units == ("°C",) and found.descriptions == ("temperature",)
        assert found.read(1)[0, 1] == pytest.approx(32.77 - 273.15, abs=0.01)
    assert index_colours(out) != index_colours(written(tmp_path, "NDVI", UNCALIBRATED))
    assert "°C" in index_style(out, (-10.0, 30.0))
    with pytest.raises(InputError, match="no band holds temperatures"):
        Index.for_mosaic(rig_mosaic(tmp_path / "plain.tif", UNCALIBRATED), "temperature")
