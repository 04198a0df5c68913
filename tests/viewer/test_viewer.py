"""What the page of a run is sent: tiles of its rasters, measures, and errors that say what to do."""

from __future__ import annotations

import json
import threading
import urllib.error
import urllib.request
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import rasterio
from osgeo import gdal, ogr, osr
from rasterio.windows import Window

from geomosaic.errors import FileError, InputError
from geomosaic.export.index import Index, write_index
from geomosaic.geodesy.mapcrs import LOCAL_CRS
from geomosaic.pages.loopback_server import Answer, LoopbackServer
from geomosaic.viewer.grid_raster import GridRaster, ViewGrid
from geomosaic.viewer.map_features import map_features
from geomosaic.viewer.run_view import run_views
from geomosaic.viewer.viewer_pages import ViewerPages

SQUARE = [[100, 100], [500, 100], [500, 400], [100, 400]]


def raster(path: Path, bands: list[np.ndarray], pixel_m: float = 0.1, epsg: int | None = 32632) -> Path:
    """From (600000, 5300100); of bytes, or of float32 with nodata NaN."""
    kind = gdal.GDT_Byte if bands[0].dtype == np.uint8 else gdal.GDT_Float32
    rows, cols = bands[0].shape
    made = gdal.GetDriverByName("GTiff").Create(str(path), cols, rows, len(bands), kind)
    if epsg is not None:
        reference = osr.SpatialReference()
        reference.ImportFromEPSG(epsg)
        made.SetSpatialRef(reference)
        made.SetGeoTransform((600_000.0, pixel_m, 0.0, 5_300_100.0, 0.0, -pixel_m))
    for number, values in enumerate(bands, start=1):
        if kind != gdal.GDT_Byte:
            made.GetRasterBand(number).SetNoDataValue(float("nan"))
        made.GetRasterBand(number).WriteArray(values)
    made.GetRasterBand(1).SetMetadataItem("STATISTICS_MINIMUM", "0.05")
    made.FlushCache()
    return path


def finished(folder: Path, epsg: int | None = 32632, accuracy: bool = True) -> Path:
    """A folder of a run: a mosaic of 1100 x 700 px of 0.1 m whose reds rise by column, greens by row."""
    folder.mkdir()
    (folder / "run.json").write_text(json.dumps({"artefacts": {}, "mosaic": {"gsd_m": 0.1}}))
    row, col = np.mgrid[:700, :1100]
    mosaic = [(col / 5).astype(np.uint8), (row / 3).astype(np.uint8), np.full((700, 1100), 60, np.uint8)]
    raster(folder / "mosaic.tif", mosaic, epsg=epsg)
    if accuracy:
        sd = np.full((44, 69), 0.05, np.float32)
        raster(folder / "accuracy.tif", [sd, 2 * sd, 0 * sd + 1], 1.6, epsg)
    return folder


def post(pages: ViewerPages, kind: str, points: Any, run: int = 0) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(
        pages.post(["measure"], {"run": run, "kind": kind, "points": points}).body
    )
    return found


def test_tiles_are_the_mosaic_s_own_pixels_and_their_means(tmp_path: Path) -> None:
    pages = ViewerPages(run_views(finished(tmp_path / "run")))
    for reduction, size in ((1, (188, 76)), (2, (350, 38))):
        across, down = (2, 1) if reduction == 1 else (1, 0)
        answer = pages.get(["tile", "0", "mosaic", str(reduction), str(across), str(down)])
        assert answer is not None and answer.kept
        tile = cv2.imdecode(np.frombuffer(answer.body, np.uint8), cv2.IMREAD_COLOR)
        assert tile.shape[:2] == size
        row, col = (
            np.arange(n) * reduction + 512 * reduction * at
            for n, at in zip(size, (down, across), strict=True)
        )
        assert (
            np.abs(tile[..., 2] - col / 5).mean() < 3.0
            and np.abs(tile[..., 1] - row[:, None] / 3).mean() < 3.0
        )
    for beyond in (["0", "mosaic", "1", "3", "0"], ["0", "surface", "1", "0", "0"], ["1", "mosaic", "1", "0", "0"],
                   ["0", "mosaic", "0", "0", "0"], ["x", "mosaic", "1", "0", "0"], ["0", "..", "1", "0", "0"]):  # fmt: skip
        assert pages.get(["tile", *beyond]) is None


def test_a_raster_of_floats_ends_where_it_ends_on_another_grid(tmp_path: Path) -> None:
    grid = ViewGrid.of(raster(tmp_path / "map.tif", [np.zeros((300, 400), np.uint8)]))
    at = {"width": 50, "height": 60, "count": 1, "dtype": "float32", "crs": "EPSG:32632"}
    place = rasterio.Affine(0.4, 0.0, 600_000.0, 0.0, -0.4, 5_300_100.0)
    with rasterio.open(tmp_path / "small.tif", "w", driver="GTiff", transform=place, **at) as tiff:
        tiff.write(np.full((1, 60, 50), 280.0, np.float32))
    values, known = GridRaster(tmp_path / "small.tif", grid).read([1], Window(0, 0, 400, 300), 2)
    assert known[:120, :100].all() and known.sum() == 120 * 100 and values[0, 60, 50] == 280.0


def test_an_index_is_a_layer_with_the_colours_of_its_style(tmp_path: Path) -> None:
    """(2 green - red - blue) / (2 green + red + blue); its ends are the 2nd and the 98th percentile."""
    run = finished(tmp_path / "run")
    index = Index.for_mosaic(run / "mosaic.tif", "auto")
    write_index(run / "mosaic.tif", run / "index_GLI.tif", index, lambda done, all: None)
    pages = ViewerPages(run_views(run))
    answer = pages.get(["tile", "0", "index_GLI", "2", "0", "0"])
    assert answer is not None
    tile = cv2.imdecode(np.frombuffer(answer.body, np.uint8), cv2.IMREAD_COLOR)
    assert tile[5, 250, 2] > 180 > tile[5, 250, 1]  # red and blue without green: the first colour
    assert tile[340, 5, 1] > tile[340, 5, 2]
    described = json.loads(pages.get(["runs"]).body)  # type: ignore[union-attr]
    (layer,) = [of for of in described["runs"][0]["layers"] if of["name"] == "index_GLI"]
    red, green = np.meshgrid(np.arange(1100) // 5, np.arange(700) // 3)
    values = (2.0 * green - red - 60.0) / (2.0 * green + red + 60.0)
    assert layer["title"] == "GLI"
    assert [float(end) for end in layer["legend"][:2]] == pytest.approx(
        np.percentile(values, [2, 98]), abs=0.01
    )


def test_measures_without_a_surface(tmp_path: Path) -> None:
    pages = ViewerPages(run_views(finished(tmp_path / "run")))
    length = post(pages, "distance", SQUARE[:2])
    assert length["length"]["value"] == pytest.approx(40.0) and length["rise"] is None
    area = post(pages, "volume", SQUARE)
    assert area["area"]["value"] == pytest.approx(1200.0) and area["volume"] is None and not area["surface"]
    place = post(pages, "place", SQUARE[:1])
    assert (place["east"], place["north"]) == (pytest.approx(600_010.0), pytest.approx(5_300_090.0))
    assert place["plan_sd"] == pytest.approx(0.05) and "height" not in place
    assert post(pages, "place", [[5000, 50]])["plan_sd"] is None
    with pytest.raises(InputError, match="no surface; make the mosaic with --surface dense"):
        post(pages, "profile", SQUARE[:2])


@pytest.mark.parametrize(
    ("kind", "points", "text"),
    [("area", [SQUARE[k] for k in (0, 2, 1, 3)], "crosses itself"), ("area", SQUARE[:2], "2 points"),
     ("distance", [[1, 1]], "1 points"), ("weight", SQUARE, "is no measure"), ("distance", [[1, 1], [float("nan"), 2]], "points")],
)  # fmt: skip
def test_what_cannot_be_measured_is_named(tmp_path: Path, kind: str, points: Any, text: str) -> None:
    pages = ViewerPages(run_views(finished(tmp_path / "run")))
    with pytest.raises(InputError, match=text):
        post(pages, kind, points)


@pytest.mark.parametrize("asked", [None, [], {}, {"run": 0, "kind": "area"}, {"run": 7, "kind": "area", "points": SQUARE},
                                   {"run": 0, "kind": "area", "points": [[1], [2]]}])  # fmt: skip
def test_what_is_no_request_is_none_of_the_servers_faults(tmp_path: Path, asked: Any) -> None:
    pages = ViewerPages(run_views(finished(tmp_path / "run")))
    with pytest.raises((LookupError, TypeError, ValueError)):
        pages.post(["measure"], asked)


def test_a_scene_without_a_map_is_shown_and_not_measured(tmp_path: Path) -> None:
    scene = finished(tmp_path / "scene", epsg=None, accuracy=False)
    pages = ViewerPages(run_views(scene))
    assert pages.get(["tile", "0", "mosaic", "1", "0", "0"]) is not None
    described = json.loads(pages.get(["runs"]).body)  # type: ignore[union-attr]
    assert not described["on_map"] and "accuracy.tif" in described["runs"][0]["unmeasured"]
    with pytest.raises(InputError, match=r"no accuracy\.tif"):
        post(pages, "distance", SQUARE[:2])
    with pytest.raises(InputError, match="no map projection, and cannot be compared"):
        run_views(finished(tmp_path / "run"), scene)


def test_a_local_frame_has_no_metres(tmp_path: Path) -> None:
    """Its CRS is an engineering one, not none: the page stated metres."""
    run, other = finished(tmp_path / "run"), finished(tmp_path / "other")
    for name in ("mosaic.tif", "accuracy.tif"):
        made = gdal.Open(str(run / name), gdal.GA_Update)
        made.SetProjection(LOCAL_CRS)
        del made
    pages = ViewerPages(run_views(run))
    assert not json.loads(pages.get(["runs"]).body)["on_map"]  # type: ignore[union-attr]
    for kind in ("place", "distance"):
        with pytest.raises(InputError, match="local frame has no place on the Earth: no measurement"):
            post(pages, kind, SQUARE[:2])
    for pair in ((run, other), (other, run)):
        with pytest.raises(InputError, match="no comparison can be made"):
            run_views(*pair)


def test_what_is_no_run_is_named(tmp_path: Path) -> None:
    with pytest.raises(FileError, match="no finished run"):
        run_views(tmp_path)
    run = finished(tmp_path / "run")
    (run / "mosaic.tif").unlink()
    with pytest.raises(FileError, match=r"no mosaic\.tif"):
        run_views(run)


class Broken(ViewerPages):
    """Pages with a fault that nobody thought of."""

    def get(self, path: list[str]) -> Answer | None:
        raise RuntimeError("no memory")


def test_a_page_is_answered_even_where_a_measure_fails(tmp_path: Path) -> None:
    run = finished(tmp_path / "run")
    with LoopbackServer(ViewerPages(run_views(run))) as server:
        threading.Thread(target=server.serve_forever, args=(0.02,), daemon=True).start()
        (run / "accuracy.tif").unlink()
        asked = json.dumps({"run": 0, "kind": "place", "points": SQUARE[:1]}).encode()
        headers = {"Content-Type": "application/json"}
        for body, status, text in ((asked, 400, "accuracy.tif"), (b"{}", 400, "not understood")):
            with pytest.raises(urllib.error.HTTPError) as failed:
                urllib.request.urlopen(urllib.request.Request(server.url + "measure", body, headers))
            with failed.value as answer:
                assert answer.status == status and answer.headers["Connection"] == "close"
                assert text in json.load(answer)["error"]
        server.pages = Broken([])
        with pytest.raises(urllib.error.HTTPError) as failed:
            urllib.request.urlopen(server.url + "runs")
        with failed.value as answer:
            assert answer.status == 500 and json.load(answer)["error"] == "failed: RuntimeError: no memory"
        server.shutdown()


def test_a_frame_without_a_place_is_not_shown(tmp_path: Path) -> None:
    """Empty points, and points at NaN, ended the page."""
    run = finished(tmp_path / "run")
    package = gdal.GetDriverByName("GPKG").Create(str(run / "layers.gpkg"), 0, 0, 0, gdal.GDT_Unknown)
    reference = osr.SpatialReference()
    reference.ImportFromEPSG(32632)
    layer = package.CreateLayer("frames", reference, ogr.wkbPoint)
    layer.CreateField(ogr.FieldDefn("frame", ogr.OFTString))
    for name, (east, north) in {"A": (600_010.0, 5_300_090.0), "B": (float("nan"),) * 2}.items():
        place, feature = ogr.Geometry(ogr.wkbPoint), ogr.Feature(layer.GetLayerDefn())
        place.AddPoint_2D(east, north)
        feature.SetGeometry(place)
        feature.SetField("frame", name)
        layer.CreateFeature(feature)
    empty = ogr.Feature(layer.GetLayerDefn())
    empty.SetGeometry(ogr.Geometry(ogr.wkbPoint))
    layer.CreateFeature(empty)
    del layer, feature, empty, package  # closes the file
    (frames,) = map_features(run / "layers.gpkg", ViewGrid.of(run / "mosaic.tif"))
    assert frames["points"] == [[100.0, 100.0, "A"]] and not frames["lines"]
