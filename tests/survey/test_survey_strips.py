"""GEOMETRY.yaml of CCD strips: read against real rasters; every bad input is one line."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
import yaml
from numpy.typing import NDArray
from rasterio.errors import NotGeoreferencedWarning

from geomosaic.errors import FileError, InputError
from geomosaic.survey.elevation import check_dem
from geomosaic.survey.strip_companions import read_rpc
from geomosaic.survey.strip_model import read_model
from geomosaic.survey.strips import Ccd, StripGeometry, read_geometry
from geomosaic_simulate.strip_plan import StripPlan
from geomosaic_simulate.strips import SimulatedStrips, simulate_strips

PLAIN: dict[str, Any] = {
    "line_rate_hz": 3272.4,
    "row_separation_lines": 40,
    "overlap_px": 12,
    "read_px": 16,
    "ground_pixel_m": 2.5,
    "ccds": [{"path": "a.tif", "row": 2}, {"path": "sub/b.tif", "row": 1}, {"path": "c.tif", "row": 2}],
}


def strip(path: Path, width: int = 48, lines: int = 100, dtype: str = "uint16", bands: int = 1) -> None:
    path.parent.mkdir(exist_ok=True)
    profile = {"driver": "GTiff", "width": width, "height": lines, "count": bands, "dtype": dtype}
    with pytest.warns(NotGeoreferencedWarning), rasterio.open(path, "w", **profile) as out:
        out.write(np.full((bands, lines, width), 7, dtype))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    strip(tmp_path / "a.tif", lines=100)
    strip(tmp_path / "sub" / "b.tif", lines=90)
    strip(tmp_path / "c.tif", lines=100)
    return tmp_path


def written(folder: Path, **changes: Any) -> Path:
    entry = {k: v for k, v in {**PLAIN, **changes}.items() if v is not ...}
    path = folder / "geometry.yaml"
    path.write_text(yaml.safe_dump(entry))
    return path


def test_geometry_is_read_and_paths_count_from_its_folder(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = written(folder)
    monkeypatch.chdir(folder.parent)
    g = read_geometry(Path(folder.name) / path.name)
    assert g.ccds == (Ccd(folder / "a.tif", 2), Ccd(folder / "sub/b.tif", 1), Ccd(folder / "c.tif", 2))
    assert (g.width_px, g.lines, g.overlap_px, g.read_px) == (48, (100, 90, 100), 12, 16)
    assert (g.row_separation_lines, g.ground_pixel_m, g.line_rate_hz) == (40.0, 2.5, 3272.4)
    assert (g.bit_depth, g.nodata, g.dem, g.rpc, g.model) == (16, None, None, None, None)
    assert g.scene_width_px == 120


def test_side_says_which_row_leads(folder: Path) -> None:
    g = read_geometry(written(folder))
    assert list(g.pairs) == [0, 1]
    assert (g.side(0), g.side(1)) == (-1, 1)


def test_defaults_are_the_paper_s() -> None:
    g = StripGeometry(ccds=(), width_px=4096, lines=(), line_rate_hz=3272.4, bit_depth=8)
    assert (g.overlap_px, g.read_px, g.row_separation_lines, g.ground_pixel_m) == (96, 110, 2114.0, 2.0)


def test_altitude_makes_the_rows_parallax(folder: Path) -> None:
    assert read_geometry(written(folder)).altitude_m == 500e3
    g = read_geometry(written(folder, altitude_m=600e3, row_separation_lines=50))
    assert g.altitude_m == 600e3
    # 1 / (50 (1 / 600 km + 1 / 6371 km))
    assert g.height_m_per_line == pytest.approx(10967.15, abs=0.01)


def test_a_dead_ccd_has_no_path_and_no_lines(folder: Path) -> None:
    g = read_geometry(written(folder, ccds=[PLAIN["ccds"][0], {"row": 1}, PLAIN["ccds"][2]], bit_depth=10))
    assert g.ccds[1] == Ccd(None, 1)
    assert g.lines == (100, 0, 100)
    assert g.bit_depth == 10


BAD: dict[str, tuple[dict[str, Any], str]] = {
    "overlap of zero": ({"overlap_px": 0}, "overlap_px is 0; give a whole number of at least 8"),
    "overlap of a few px": ({"overlap_px": 4, "read_px": 6}, "overlap_px is 4; give a whole number of at least 8"),
    "separation of 400 digits": ({"row_separation_lines": 10**400}, "line 12: too large a number"),
    "row of 400 digits": ({"ccds": [{"path": "a.tif", "row": 10**400}, PLAIN["ccds"][1]]}, "line 3: too large a number"),
    "nodata above the type's": ({"nodata": 70000}, "nodata is 70000; give a whole number from 0 to 65535"),
    "nodata below the type's": ({"nodata": -1}, "nodata is -1; give a whole number from 0 to 65535"),
    "nodata not whole": ({"nodata": 0.5}, "nodata is 0.5; give a whole number from 0 to 65535"),
    "nodata no number": ({"nodata": float("nan")}, "nodata is nan; give a whole number from 0 to 65535"),
    "width not whole": ({"width_px": 48.7}, "width_px is 48.7; give a whole number of at least 1"),
    "overlap too wide": ({"overlap_px": 24, "read_px": 30}, "less than half a strip"),
    "read less than the overlap": ({"read_px": 11}, "read_px is 11; give from 12"),
    "rows farther apart than the strips are long": ({"row_separation_lines": 100}, "longest strip has 100"),
    "separation no number": ({"row_separation_lines": "many"}, "row_separation_lines is 'many'"),
    "separation not finite": ({"row_separation_lines": float("nan")}, "row_separation_lines is nan"),
    "no line rate": ({"line_rate_hz": ...}, "has no line_rate_hz"),
    "another width": ({"width_px": 4096}, "strips of 4096 columns, but they have 48"),
    "more bits than the files": ({"bit_depth": 17}, "bit_depth is 17, but the strips are uint16"),
    "too few bits": ({"bit_depth": 7}, "bit_depth is 7; give a whole number of at least 8"),
    "unknown key": ({"overlap": 96}, "unknown geometry key 'overlap'; did you mean 'overlap_px'?"),
    "one CCD": ({"ccds": [PLAIN["ccds"][0]]}, "at least two CCDs"),
    "all dead": ({"ccds": [{"row": 1}, {"row": 2}]}, "fewer than two strips"),
    "row 3": ({"ccds": [{"path": "a.tif", "row": 3}, PLAIN["ccds"][1]]}, "CCD 1 has row 3"),
    "same row": ({"ccds": [{"path": "a.tif", "row": 1}, PLAIN["ccds"][1]]}, "CCDs 1 and 2 are both in row 1"),
    "strip twice": ({"ccds": [{**PLAIN["ccds"][1]}, {"path": "a.tif", "row": 2}, PLAIN["ccds"][1]]}, "second time"),
    "no such strip": ({"ccds": [{"path": "z.tif", "row": 2}, PLAIN["ccds"][1]]}, "z.tif: there is no such file"),
    "no such DEM": ({"dem": "dem.tif"}, "dem.tif: there is no such file, named as dem"),
    "not a list": ({"ccds": {"a": 1}}, "'ccds' isn't a list"),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_bad_geometry_is_one_clear_line(folder: Path, case: str) -> None:
    changes, text = BAD[case]
    with pytest.raises(InputError) as caught:
        read_geometry(written(folder, **changes))
    assert text in str(caught.value)
    assert str(folder) in str(caught.value)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < len(str(folder)) + 250
    assert caught.value.exit_code == 2


def test_a_nodata_at_the_end_of_the_range_is_taken(folder: Path) -> None:
    assert read_geometry(written(folder, nodata=65535, width_px=48.0)).nodata == 65535.0


def test_a_strip_of_text_is_named(folder: Path) -> None:
    (folder / "c.tif").write_text("no raster at all\n" * 9)
    with pytest.raises(FileError, match=r"c\.tif: is no raster file that can be read"):
        read_geometry(written(folder))


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"width": 47}, r"c\.tif: has 47 columns of uint16, but a\.tif has 48 columns of uint16"),
        ({"dtype": "uint8"}, r"c\.tif: has 48 columns of uint8"),
        ({"bands": 3}, r"c\.tif: has 3 bands"),
        ({"dtype": "float32"}, r"c\.tif: has 48 columns of float32"),
        ({"dtype": "float64"}, r"c\.tif: has float64 pixels"),
    ],
)
def test_strips_that_don_t_agree_are_named(folder: Path, change: dict[str, Any], text: str) -> None:
    strip(folder / "c.tif", **change)
    with pytest.raises(FileError, match=text):
        read_geometry(written(folder))


@pytest.mark.parametrize("text", ["{", "[1, 2]", "", "!!python/object/apply:os.system [ls]", "\0"])
def test_what_is_no_geometry_is_named(tmp_path: Path, text: str) -> None:
    path = tmp_path / "g.yaml"
    path.write_text(text)
    with pytest.raises(InputError, match=r"g\.yaml: is (no|empty)"):
        read_geometry(path)


def test_no_file_and_a_folder(tmp_path: Path) -> None:
    with pytest.raises(FileError, match="there is no such file"):
        read_geometry(tmp_path / "none.yaml")
    with pytest.raises(FileError, match="is no regular file"):
        read_geometry(tmp_path)


@pytest.mark.parametrize("key", ["path", "dem", "rpc", "model"])
@pytest.mark.parametrize("kind", ["pipe", "folder", "device"])
def test_what_is_no_regular_file_is_named_and_never_read(folder: Path, key: str, kind: str) -> None:
    odd = folder / "odd"
    if kind == "pipe":
        os.mkfifo(odd)
    elif kind == "folder":
        odd.mkdir()
    else:
        odd.symlink_to("/dev/zero")
    ccds = PLAIN["ccds"]
    change = {"ccds": [{"path": "odd", "row": 2}, *ccds[1:]]} if key == "path" else {key: "odd"}
    with pytest.raises(
        FileError, match=rf"odd: is no regular file but a {kind}, named as {key} in geometry\.yaml"
    ):
        read_geometry(written(folder, **change))


def test_devices_and_pipes_are_no_geometry_model_or_rpc(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    for path in (Path("/dev/zero"), tmp_path / "pipe"):
        for read in (read_geometry, read_model, read_rpc):
            with pytest.raises(FileError, match="is no regular file"):
                read(path)


@pytest.mark.parametrize("read", [read_geometry, read_model])
def test_a_file_over_256_kb_is_refused_before_it_is_parsed(
    folder: Path, read: Callable[[Path], object]
) -> None:
    path = folder / "long.yaml"
    path.write_text(yaml.safe_dump(PLAIN) + "dem: [" + "1," * 131_072 + "]")
    with pytest.raises(FileError, match=r"is too large for a \w+( file)?: more than 256 kB"):
        read(path)


@pytest.mark.parametrize("key", ["path", "dem"])
def test_a_path_of_thousands_of_letters_is_one_short_line(folder: Path, key: str) -> None:
    long = "x" * 5000
    change = {"ccds": [{"path": long, "row": 2}, *PLAIN["ccds"][1:]]} if key == "path" else {key: long}
    with pytest.raises(FileError, match=f"File name too long.*named as {key} in geometry.yaml") as caught:
        read_geometry(written(folder, **change))
    assert len(str(caught.value)) < 500
    with pytest.raises(FileError, match="File name too long") as caught:
        read_geometry(folder / long)
    assert len(str(caught.value)) < 500


def test_a_dem_without_a_crs_is_one_line_without_a_warning(folder: Path) -> None:
    with pytest.raises(InputError, match=r"a\.tif: the DEM has no coordinate reference system"):
        read_geometry(written(folder, dem="a.tif"))


def test_a_pipe_is_no_dem(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(FileError, match="pipe: is no regular file"):
        check_dem(tmp_path / "pipe")
    with pytest.raises(FileError, match="there is no such DEM") as caught:
        check_dem(tmp_path / ("x" * 5000))
    assert len(str(caught.value)) < 400


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> SimulatedStrips:
    plan = StripPlan(
        ccds=3,
        width_px=128,
        lines=600,
        overlap_px=48,
        read_px=60,
        row_separation_lines=150.0,
        dem_pixel_m=60.0,
    )
    return simulate_strips(tmp_path_factory.mktemp("scene"), plan, scene=False)


def test_altitude_is_the_models(scene: SimulatedStrips, tmp_path: Path) -> None:
    plan = StripPlan(row_separation_lines=150.0, lines=600)
    model = plan.altitude_m + plan.ground_height_m
    assert read_geometry(scene.geometry).altitude_m == pytest.approx(model, abs=20.0)
    reported = changed(scene, tmp_path / "reported.yaml", altitude_m=40e3)
    assert read_geometry(reported).altitude_m == 40e3


def changed(scene: SimulatedStrips, path: Path, **changes: Any) -> Path:
    """The scene's geometry at path, with its files' whole paths; ... takes an entry out."""
    entry, folder = yaml.safe_load(scene.geometry.read_text()), scene.geometry.parent
    entry["ccds"] = [{**ccd, "path": str(folder / ccd["path"])} for ccd in entry["ccds"]]
    entry |= {key: str(folder / entry[key]) for key in ("dem", "rpc", "model")} | changes
    path.write_text(yaml.safe_dump({k: v for k, v in entry.items() if v is not ...}))
    return path


def dem_at(path: Path, west: float, north: float) -> str:
    """A DEM of 0.2 degrees a side."""
    transform = rasterio.Affine(0.02, 0.0, west, 0.0, -0.02, north)
    profile = {
        "driver": "GTiff",
        "width": 10,
        "height": 10,
        "count": 1,
        "dtype": "float32",
        "crs": "EPSG:4326",
    }
    with rasterio.open(path, "w", transform=transform, **profile) as out:
        out.write(np.full((1, 10, 10), 900.0, "float32"))
    return str(path)


@pytest.mark.parametrize(("pixel_m", "fits"), [(0.9, False), (1.1, True), (3.8, True), (4.2, False)])
def test_a_ground_pixel_is_compared_to_the_model_s(
    scene: SimulatedStrips, tmp_path: Path, pixel_m: float, fits: bool
) -> None:
    path = changed(scene, tmp_path / "g.yaml", ground_pixel_m=pixel_m)
    if fits:
        assert read_geometry(path).ground_pixel_m == pixel_m
        return
    text = rf"g\.yaml: ground_pixel_m is {pixel_m}, but pixels of model\.yaml measure (1\.9\d|2(\.0\d)?) m"
    with pytest.raises(InputError, match=text):
        read_geometry(path)


@pytest.mark.parametrize("rpc", [True, False])
def test_a_dem_of_another_place_is_blamed_by_the_model(
    scene: SimulatedStrips, tmp_path: Path, rpc: bool
) -> None:
    dem = dem_at(tmp_path / "far.tif", 104.0, 38.3)
    path = changed(scene, tmp_path / "g.yaml", dem=dem, **({} if rpc else {"rpc": ...}))
    text = (
        r"far\.tif: the DEM does not cover the strips: the model looks at 100\.\d+, 38\.\d+ deg; give a DEM"
    )
    with pytest.raises(InputError, match=text):
        read_geometry(path)


def test_without_a_model_rpc_and_dem_of_two_places_are_both_named(
    scene: SimulatedStrips, tmp_path: Path
) -> None:
    dem = dem_at(tmp_path / "far.tif", 104.0, 38.3)
    path = changed(scene, tmp_path / "g.yaml", dem=dem, model=...)
    text = r"RPC\.TXT: it or far\.tif is of another scene: .* is not on far\.tif; correct 'rpc' or 'dem'"
    with pytest.raises(InputError, match=text):
        read_geometry(path)


def test_a_dem_that_covers_a_part_is_taken(scene: SimulatedStrips, tmp_path: Path) -> None:
    west, north = (float(v) for v in looked_at(scene))
    dem = dem_at(tmp_path / "part.tif", west, north + 0.1)  # its western edge is the middle CCD's middle
    assert read_geometry(changed(scene, tmp_path / "g.yaml", dem=dem)).dem == tmp_path / "part.tif"


def looked_at(scene: SimulatedStrips) -> NDArray[np.float64]:
    """Longitude and latitude of the scene's middle."""
    return read_model(scene.model).ground_from_image(1, 64.0, 300.0, 900.0)[:2]


@pytest.mark.parametrize("text", ["a: &a {k: 1}\nccds: {<<: [*a, *a]}", "ccds: !!bool x", "ccds: !!int x"])
def test_yaml_is_plain(tmp_path: Path, text: str) -> None:
    (tmp_path / "g.yaml").write_text(text)
    with pytest.raises(FileError, match="is no valid YAML"):
        read_geometry(tmp_path / "g.yaml")
