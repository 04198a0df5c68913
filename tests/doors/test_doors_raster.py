"""Rasters of strangers: no connection, no other file, no image larger than its bytes can hold."""

from __future__ import annotations

import os
import re
import socket
import threading
import warnings
import zlib
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
import rasterio
from rasterio import Affine
from rasterio.errors import NotGeoreferencedWarning
from small_surveys import small_survey

import geomosaic
from geomosaic.doors.raster import (
    DEM,
    FRAME,
    MASK,
    OWN,
    REFERENCE,
    open_raster,
    open_with_osgeo,
    unreferenced_is_fine,
)
from geomosaic.errors import FileError
from geomosaic.quality.rasters import open_map
from geomosaic.survey.elevation import check_dem
from geomosaic.survey.header import read_header
from geomosaic.survey.inputs import SurveyInputs
from geomosaic.survey.pixels import read_pixels
from geomosaic.survey.read import read_survey
from geomosaic_simulate.survey import SimulatedSurvey

UTM = "EPSG:32632"


@pytest.fixture
def server() -> Iterator[Server]:
    """A server of this machine that counts who comes."""
    with Server() as listening:
        yield listening


class Server:
    """Accepts connections and answers none."""

    def __init__(self) -> None:
        self.came: list[bytes] = []
        self._socket = socket.create_server(("127.0.0.1", 0))
        self.url = f"http://127.0.0.1:{self._socket.getsockname()[1]}/"
        self._thread = threading.Thread(target=self._serve, daemon=True)

    def _serve(self) -> None:
        while True:
            try:
                connection, _ = self._socket.accept()
            except OSError:
                return
            with connection:
                connection.settimeout(1.0)
                self.came.append(connection.recv(100))

    def __enter__(self) -> Server:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._socket.shutdown(socket.SHUT_RDWR)
        self._socket.close()
        self._thread.join(5.0)


@pytest.fixture(scope="session")
def pair(tmp_path_factory: pytest.TempPathFactory) -> SimulatedSurvey:
    """Two TIFF frames with pos.csv, cameras.json and a DEM."""
    folder = tmp_path_factory.mktemp("pair")
    return small_survey(folder, lines=1, frames_per_line=2, format="tiff16", pos_in="csv", seed=21)


def tiff(path: Path, values: np.ndarray | None = None, **profile: object) -> Path:
    """A small north-up GeoTIFF."""
    values = np.full((20, 30), 500.0, np.float32) if values is None else values
    given: dict[str, object] = {"driver": "GTiff", "count": 1, "crs": UTM, "dtype": values.dtype}
    given |= {"transform": Affine(10.0, 0.0, 500_000.0, 0.0, -10.0, 5_400_000.0)}
    given |= {"height": values.shape[0], "width": values.shape[1]} | profile
    with rasterio.open(path, "w", **given) as file:
        file.write(values, 1)
    return path


def vrt(path: Path, source: object, kind: str = "SimpleSource", relative: int = 0, extra: str = "") -> Path:
    """A VRT of one source."""
    path.write_text(
        f'<VRTDataset rasterXSize="30" rasterYSize="20"><SRS>{UTM}</SRS>'
        "<GeoTransform>500000.0, 10.0, 0.0, 5400000.0, 0.0, -10.0</GeoTransform>"
        f'<VRTRasterBand dataType="Float32" band="1">{extra}<{kind}>'
        f'<SourceFilename relativeToVRT="{relative}">{source}</SourceFilename><SourceBand>1</SourceBand>'
        f"</{kind}></VRTRasterBand></VRTDataset>"
    )
    return path


WMS = (
    '<GDAL_WMS><Service name="WMS"><Version>1.1.1</Version><ServerUrl>{url}</ServerUrl><Layers>a</Layers>'
    "</Service><DataWindow><UpperLeftX>0</UpperLeftX><UpperLeftY>9</UpperLeftY><LowerRightX>9</LowerRightX>"
    "<LowerRightY>0</LowerRightY><SizeX>480</SizeX><SizeY>360</SizeY></DataWindow></GDAL_WMS>"
)
WMTS = "<GDAL_WMTS><GetCapabilitiesUrl>{url}c.xml</GetCapabilitiesUrl><Layer>a</Layer></GDAL_WMTS>"
REMOTE = (
    "/vsicurl/{url}a.tif", "/vsicurl_streaming/{url}a.tif", "{url}a.tif", "WMS:{url}?", "/vsis3/bucket/a.tif",
    'ZARR:"/vsicurl/{url}a"', 'NETCDF:"{url}a.nc":a', "/vsiwebhdfs/{url}", "/vsizip/vsicurl/{url}a.zip",
    "GTI:/vsicurl/{url}a", "&lt;GDAL_WMTS&gt;&lt;GetCapabilitiesUrl&gt;{url}&lt;/GetCapabilitiesUrl&gt;",
)  # fmt: skip


@pytest.mark.parametrize("purpose", [DEM, REFERENCE, MASK, FRAME, OWN])
@pytest.mark.parametrize("content", [WMS, WMTS])
def test_a_service_s_description_reaches_no_server(
    tmp_path: Path, server: Server, purpose: object, content: str
) -> None:
    path = tmp_path / "a.tif"
    path.write_text(content.format(url=server.url))
    for opening in (open_raster, open_with_osgeo):
        with pytest.raises(FileError, match=r"a\.tif: "):
            opening(path, purpose)
    assert not server.came


@pytest.mark.parametrize("source", REMOTE)
def test_a_vrt_of_what_is_remote_reaches_no_server(
    tmp_path: Path, server: Server, source: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("AWS_S3_ENDPOINT", server.url.removeprefix("http://").rstrip("/"))
    monkeypatch.setenv("AWS_HTTPS", "NO")
    monkeypatch.setenv("AWS_NO_SIGN_REQUEST", "YES")
    path = vrt(tmp_path / "dem.vrt", source.format(url=server.url))
    with pytest.raises(FileError, match=r"dem\.vrt: its source '.*' is no file on this machine"):
        check_dem(path)
    with pytest.raises(FileError, match="its source"):
        open_raster(vrt(tmp_path / "outer.vrt", "dem.vrt", relative=1), DEM)
    for purpose in (MASK, FRAME, OWN):
        with pytest.raises(FileError):
            open_raster(path, purpose)
        with pytest.raises(FileError):
            open_with_osgeo(path, purpose)
    assert not server.came


def test_what_is_a_path_of_gdal_alone_is_no_file(tmp_path: Path, server: Server) -> None:
    zipped = f"/vsizip/{tmp_path}/a.zip/a.tif"
    for text in (f"/vsicurl/{server.url}a.tif", f"WMS:{server.url}", zipped, "/vsimem/a.tif", "/vsistdin/"):
        with pytest.raises(FileError):
            open_raster(Path(text), DEM)
        with pytest.raises(FileError):
            open_with_osgeo(Path(text), OWN)
    assert not server.came


@pytest.mark.parametrize("name", ["dem.tif.ovr", "dem.tif.msk", "dem.tif.aux.xml", "dem.aux", "DEM.TIF.OVR"])
def test_sidecars_of_a_dem_lead_nowhere(tmp_path: Path, server: Server, name: str) -> None:
    path = tiff(tmp_path / "dem.tif")
    if name.endswith("xml"):
        key = f'<MDI key="OVERVIEW_FILE">/vsicurl/{server.url}a.tif</MDI>'
        (tmp_path / name).write_text(
            f'<PAMDataset><Metadata domain="OVERVIEWS">{key}</Metadata></PAMDataset>'
        )
    else:
        vrt(tmp_path / name, f"/vsicurl/{server.url}a.tif")
    with pytest.raises(FileError, match="; remove it"), open_raster(path, DEM) as dem:
        dem.overviews(1)
        dem.read_masks(1)
    assert not server.came


@pytest.mark.parametrize("target", ["dem.prj", "nothing.prj"], ids=["to itself", "to nothing"])
def test_a_link_that_leads_nowhere_next_to_a_dem(tmp_path: Path, target: str) -> None:
    path = tiff(tmp_path / "dem.tif")
    (tmp_path / "dem.prj").symlink_to(tmp_path / target)
    with pytest.raises(FileError, match=r"dem\.prj: is no regular file next to dem\.tif"):
        open_raster(path, DEM)


def test_a_text_next_to_a_dem_that_is_no_text_s_size(tmp_path: Path) -> None:
    path = tiff(tmp_path / "dem.tif")
    with (tmp_path / "dem.prj").open("wb") as sparse:
        sparse.truncate(3 << 30)
    with pytest.raises(FileError, match=r"dem\.prj: is over 1 MB; remove it"):
        open_raster(path, DEM)


def test_what_belongs_to_a_dem_is_read(tmp_path: Path) -> None:
    """.prj, world file, .aux.xml and overviews next to it; a VRT and a warped VRT of it."""
    path = tmp_path / "bare.tif"
    cv2.imwrite(str(path), np.full((20, 30), 5, np.uint8))
    (tmp_path / "bare.tfw").write_text("10\n0\n0\n-10\n500005\n5399995\n")
    wkt = rasterio.CRS.from_string(UTM).to_wkt()
    (tmp_path / "bare.tif.aux.xml").write_text(f"<PAMDataset><SRS>{wkt.replace('&', '')}</SRS></PAMDataset>")
    with open_raster(path, DEM) as dem:
        assert dem.crs.to_epsg() == 32632
        assert dem.transform[:6] == (10.0, 0.0, 500_000.0, 0.0, -10.0, 5_400_000.0)
    grid = tmp_path / "grid.asc"
    grid.write_text("ncols 3\nnrows 2\nxllcorner 500000\nyllcorner 5399980\ncellsize 10\n1 2 3\n4 5 6\n")
    (tmp_path / "grid.prj").write_text(wkt)
    with open_raster(grid, DEM) as dem:
        assert dem.crs.to_epsg() == 32632 and dem.read(1).tolist() == [[1, 2, 3], [4, 5, 6]]
    large = tiff(tmp_path / "large.tif", np.full((600, 600), 7.0, np.float32))
    from osgeo import gdal

    mosaic_, warped = tmp_path / "mosaic.vrt", tmp_path / "warped.vrt"
    del (
        built := [gdal.BuildVRT(str(mosaic_), [str(large)]), gdal.Warp(str(warped), str(large), format="VRT")]
    )[:]
    assert not built
    gdal.SetConfigOption("COMPRESS_OVERVIEW", "DEFLATE")
    dataset = gdal.Open(str(large))  # read only: the overviews lie next to it
    dataset.BuildOverviews("AVERAGE", [2])
    del dataset
    gdal.SetConfigOption("COMPRESS_OVERVIEW", None)
    assert (tmp_path / "large.tif.ovr").exists()
    with open_raster(large, DEM) as dem:
        assert dem.overviews(1) == [2]
    for path in (mosaic_, warped):
        with open_raster(path, DEM) as dem:
            assert (dem.read(1) == 7.0).all() and dem.driver == "VRT"


def test_the_sources_of_a_vrt_are_looked_at(tmp_path: Path) -> None:
    inner = tiff(tmp_path / "inner.tif")
    with open_raster(vrt(tmp_path / "a.vrt", "inner.tif", relative=1), DEM) as dem:
        assert (dem.read(1) == 500.0).all()

    def refused(path: Path, words: str) -> None:
        with pytest.raises(FileError, match=words):
            open_raster(path, DEM)

    refused(vrt(tmp_path / "b.vrt", tmp_path / "gone.tif"), r"b\.vrt: its source .*gone\.tif' is not there")
    refused(vrt(tmp_path / "b.vrt", tmp_path), "is no regular file")
    refused(vrt(tmp_path / "b.vrt", "/dev/zero"), "is no regular file")
    refused(vrt(tmp_path / "b.vrt", "/etc/passwd"), "passwd: is no raster file that can be read")
    refused(vrt(tmp_path / "b.vrt", tmp_path / "b.vrt"), "source of itself")
    refused(
        vrt(tmp_path / "b.vrt", inner, extra="<PixelFunctionType>f</PixelFunctionType>"), "PixelFunctionType"
    )
    refused(
        vrt(tmp_path / "b.vrt", inner, extra="<PixelFunctionCode>1</PixelFunctionCode>"), "PixelFunctionCode"
    )
    text = (tmp_path / "a.vrt").read_text()
    (tmp_path / "b.vrt").write_text(
        text.replace("<VRTRasterBand ", '<VRTRasterBand subClass="VRTRawRasterBand" ')
    )
    refused(tmp_path / "b.vrt", "VRTRawRasterBand, which isn't followed")
    (tmp_path / "b.vrt").write_text(
        text.replace("<VRTDataset ", '<VRTDataset subClass="VRTPansharpenedDataset" ')
    )
    refused(tmp_path / "b.vrt", "VRTPansharpenedDataset")
    (tmp_path / "b.vrt").write_text('<!DOCTYPE a [<!ENTITY x "y">]>' + text)
    refused(tmp_path / "b.vrt", "no well-formed XML")
    deep = inner
    for i in range(6):
        deep = vrt(tmp_path / f"deep{i}.vrt", deep)
    refused(deep, "more than 4 deep")


def test_a_frame_s_own_sidecars_stay_shut(tmp_path: Path, server: Server) -> None:
    """Not even a harmless one counts: a frame's mask is NAME_mask.tif."""
    path = tiff(tmp_path / "a.tif", np.full((20, 30), 9, np.uint8))
    vrt(tmp_path / "a.tif.msk", f"/vsicurl/{server.url}a.tif")
    vrt(tmp_path / "a.tif.ovr", f"/vsicurl/{server.url}a.tif")
    with open_raster(path, FRAME) as frame:
        assert frame.read_masks(1).min() == 255 and frame.overviews(1) == []
        assert frame.read(1, out_shape=(2, 3)).tolist() == [[9] * 3] * 2
    dataset = open_with_osgeo(path, OWN)
    assert dataset.GetRasterBand(1).GetMaskBand().ReadAsArray().min() == 255
    assert dataset.GetRasterBand(1).GetOverviewCount() == 0
    assert not server.came


def test_a_survey_opens_no_connection(pair: SimulatedSurvey, tmp_path: Path, server: Server) -> None:
    """Masks and sidecars of frames, and a DEM, that name a server."""
    frames = tmp_path / "frames"
    frames.mkdir()
    for frame in pair.frames.iterdir():
        (frames / frame.name).write_bytes(frame.read_bytes())
        vrt(frames / f"{frame.name}.msk", f"/vsicurl/{server.url}a.tif")
    given = {"camera": pair.camera, "pos": pair.pos}
    dem = tmp_path / "dem.xml"
    for content in (WMS, WMTS):
        dem.write_text(content.format(url=server.url))
        with pytest.raises(FileError, match=r"dem\.xml: is no raster file that can be read; give a DEM"):
            read_survey(SurveyInputs(frames, **given, dem=dem))
        with pytest.raises(FileError, match=r"dem\.xml: is no raster file that can be read"):
            open_map(dem)
    for frame in read_survey(SurveyInputs(frames, **given)).frames:
        assert read_pixels(frame)[1] is None
    mask = frames / f"{sorted(pair.frames.iterdir())[0].stem}_mask.png"
    mask.write_text(WMTS.format(url=server.url))
    with pytest.raises(FileError, match=r"_mask\.png: the mask can't be read; write it as 8 bit PNG or TIFF"):
        read_survey(SurveyInputs(frames, **given, strict=True))
    assert [out.name for out in read_survey(SurveyInputs(frames, **given)).left_out] == [
        min(pair.frames.iterdir()).name
    ]
    assert not server.came


def test_both_libraries_and_proj_are_set_to_stay_offline() -> None:
    from osgeo import gdal
    from pyproj import network

    with rasterio.Env() as env:
        drivers = env.drivers()
    for name in ("WMS", "WMTS", "WCS", "HTTP", "STACTA"):
        assert gdal.GetDriverByName(name) is None
        assert name not in drivers
    assert not network.is_network_enabled()
    assert os.environ["PROJ_NETWORK"] == "OFF" and os.environ["GDAL_VRT_ENABLE_PYTHON"] == "NO"


def test_rasters_and_outlines_are_opened_by_their_one_door_alone() -> None:
    package = Path(geomosaic.__file__).parent
    doors = package / "doors" / "raster.py", package / "doors" / "vector.py"
    opens = re.compile(
        r"cv2\.imread\(|gdal\.Open(Ex)?\(|ogr\.Open\w*\(|rasterio\.open\((?![^)]*\"w\")|DatasetReader\("
    )
    found = [
        f"{path.relative_to(package)}: {match.group()}"
        for path in package.rglob("*.py")
        if path not in doors
        for match in opens.finditer(path.read_text(encoding="utf-8"))
    ]
    assert not found


# Images that ask for more than their bytes can hold.


def jpeg_of(path: Path, width: int, height: int) -> Path:
    """A small JPEG whose header states another size."""
    data = bytearray(cv2.imencode(".jpg", np.zeros((64, 64, 3), np.uint8))[1].tobytes())
    at = data.index(b"\xff\xc0") + 5
    data[at : at + 4] = height.to_bytes(2, "big") + width.to_bytes(2, "big")
    path.write_bytes(data)
    return path


def test_jpeg_headers_that_ask_for_too_much(tmp_path: Path) -> None:
    with pytest.raises(FileError, match=r"a\.jpg: \d+ bytes can't hold 65500 x 65500 pixels"):
        read_header(jpeg_of(tmp_path / "a.jpg", 65500, 65500))
    path = jpeg_of(tmp_path / "b.jpg", 40000, 64)
    path.write_bytes(path.read_bytes() + bytes(5000))
    with pytest.raises(
        FileError, match="40000 x 64 pixels in 3 bands are too many; a frame has at most 32,766 px"
    ):
        read_header(path)


def png_of(path: Path, width: int, height: int) -> Path:
    """A PNG of one line whose header states another size."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return len(data).to_bytes(4, "big") + kind + data + zlib.crc32(kind + data).to_bytes(4, "big")

    header = width.to_bytes(4, "big") + height.to_bytes(4, "big") + bytes([8, 0, 0, 0, 0])
    parts = chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(bytes(width + 1))) + chunk(b"IEND", b"")
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + parts)
    return path


def test_a_mask_s_size_is_read_before_its_pixels(pair: SimulatedSurvey, tmp_path: Path) -> None:
    frames = tmp_path / "frames"
    frames.mkdir()
    for frame in pair.frames.iterdir():
        (frames / frame.name).write_bytes(frame.read_bytes())
    png_of(frames / f"{frame.stem}_mask.png", 60000, 60000)
    with pytest.raises(FileError, match="the mask has 60000 x 60000 pixels, its frame 480 x 360"):
        read_survey(SurveyInputs(frames, camera=pair.camera, pos=pair.pos, strict=True))


def test_tiffs_that_ask_for_too_much(tmp_path: Path) -> None:
    def refused(words: str, **profile: object) -> None:
        given: dict[str, object] = {
            "driver": "GTiff",
            "count": 1,
            "dtype": "uint8",
            "width": 100,
            "height": 100,
        }
        path = tmp_path / "a.tif"
        with rasterio.open(
            path, "w", **given | {"crs": UTM, "transform": Affine(1, 0, 5, 0, -1, 5)} | profile
        ):
            pass
        with pytest.raises(FileError, match=words):
            read_header(path)

    refused("129 bands; take out the needed ones, at most 128", count=129, SPARSE_OK=True)
    refused(
        "can't hold 30000 x 30000 pixels in 1 bands", width=30000, height=30000, SPARSE_OK=True, tiled=True
    )
    refused(r"40000 x 20 pixels in 1 bands are too many", width=40000, height=20)
    refused(
        r"is stored in blocks of 4\.3 GB; write it in tiles", width=100, height=100, tiled=True,
        blockxsize=65536, blockysize=65536, SPARSE_OK=True,
    )  # fmt: skip


def test_a_header_that_does_not_fit_its_pixels(tmp_path: Path) -> None:
    """Eight bits said to be one, a tag of another type."""
    path = tmp_path / "a.tif"
    cv2.imwrite(str(path), np.full((20, 30), 5, np.uint8), [cv2.IMWRITE_TIFF_COMPRESSION, 1])
    whole = path.read_bytes()
    assert read_header(path).width_px == 30
    directory = int.from_bytes(whole[4:8], "little")
    entries = {
        int.from_bytes(whole[at : at + 2], "little"): at
        for at in range(directory + 2, directory + 2 + 12 * whole[directory], 12)
    }
    for tag, at, value, words in (
        (258, 8, 1, "header is damaged"), (273, 2, 77, "readable|missing|trunc"),
    ):  # fmt: skip
        spoiled = bytearray(whole)
        spoiled[entries[tag] + at : entries[tag] + at + 2] = value.to_bytes(2, "little")
        path.write_bytes(spoiled)
        with pytest.raises(FileError, match=words):
            read_header(path)


def test_millions_of_blocks_are_looked_at_by_share(tmp_path: Path) -> None:
    path = tmp_path / "a.tif"
    side = 16 * 64
    with rasterio.open(
        path, "w", driver="GTiff", count=3, dtype="uint8", width=side, height=side, tiled=True, interleave="band",
        blockxsize=16, blockysize=16, compress="deflate", crs=UTM, transform=Affine(1, 0, 5, 0, -1, 5),
    ) as file:  # fmt: skip
        file.write(np.zeros((3, side, side), np.uint8))
    assert read_header(path).width_px == side
    path.write_bytes(path.read_bytes()[: path.stat().st_size * 9 // 10])
    with pytest.raises(FileError):
        read_header(path)


def test_a_thread_that_is_done_with_frames_leaves_another_one_s_quiet() -> None:
    """A mosaic is composed at the same time as another one, and ends first."""
    before, first, second = list(warnings.filters), unreferenced_is_fine(), unreferenced_is_fine()
    with first:
        second.__enter__()
    warnings.warn("no geotransform", NotGeoreferencedWarning, stacklevel=1)
    second.__exit__(None, None, None)
    assert list(warnings.filters) == before
