"""Pixels of frames: order, types, masks, reductions, and files that are not whole."""

from __future__ import annotations

import re
import zlib
from fractions import Fraction
from pathlib import Path
from typing import Generic, TypeVar

import cv2
import numpy as np
import pytest
import rasterio
from rasterio.enums import ColorInterp
from rasterio.transform import Affine
from survey_files import exif_block, image, write_jpeg

from geomosaic.doors.raster import unreferenced_is_fine
from geomosaic.errors import FileError, InputError
from geomosaic.survey import pixels as pixels_room
from geomosaic.survey.damage import decoded, looked_at
from geomosaic.survey.folder import masks
from geomosaic.survey.header import read_header
from geomosaic.survey.model import Attitude, Frame, Position
from geomosaic.survey.pixels import read_pixels
from geomosaic.survey.small import EighthColours, HalfGrey, Spare
from geomosaic.survey.xmp import parse_xmp


def frame(path: Path, mask: Path | None = None) -> Frame:
    h = read_header(path)
    nowhere = Position(9.0, 48.0, None, None, 1.0, 1.0, 1.0, "test")
    level = Attitude(None, None, None, 1.0, 1.0, "test")
    return Frame(
        path.name, str(path), h.width_px, h.height_px, h.bands, h.dtype, "c", nowhere, level,
        valid_mask=None if mask is None else str(mask), nodata=h.nodata,
    )  # fmt: skip


def write_tiff(
    path: Path, pixels: np.ndarray, alpha: bool = False, mask: np.ndarray | None = None, **profile: object
) -> Path:
    rows, cols, bands = pixels.shape
    options = {
        "driver": "GTiff",
        "dtype": pixels.dtype,
        "count": bands,
        "width": cols,
        "height": rows,
    } | profile
    with (
        rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True),
        rasterio.open(path, "w", transform=Affine(1.0, 0.0, 0.0, 0.0, -1.0, float(rows)), **options) as tiff,
    ):
        tiff.write(np.moveaxis(pixels, -1, 0))
        if alpha:
            tiff.colorinterp = [*[ColorInterp.undefined] * (bands - 1), ColorInterp.alpha]
        if mask is not None:
            tiff.write_mask(mask)
    return path


def test_jpeg_is_red_green_blue_and_never_turned(tmp_path: Path) -> None:
    pixels = np.zeros((48, 96, 3), np.uint8)
    pixels[..., 0] = 200
    pixels[:24, :48] = (10, 220, 40)
    path = write_jpeg(tmp_path / "a.jpg", pixels, exif_block(Orientation=3))
    got, valid = read_pixels(frame(path))
    assert got.shape == (48, 96, 3) and got.dtype == np.uint8 and valid is None
    assert got[40, 80].astype(float) == pytest.approx([200, 0, 0], abs=6)
    assert got[8, 8].astype(float) == pytest.approx([10, 220, 40], abs=6)


@pytest.mark.parametrize("bands", [1, 3])
@pytest.mark.parametrize("reduction", [1, 2, 4, 8])
def test_reduced_pixels_are_means_of_full_ones(tmp_path: Path, bands: int, reduction: int) -> None:
    pixels = image(203, 101, bands)
    jpeg, _ = read_pixels(frame(write_jpeg(tmp_path / "a.JPEG", pixels)), reduction)
    tiff, _ = read_pixels(frame(write_tiff(tmp_path / "a.tif", pixels)), reduction)
    rows, cols = 101 // reduction, 203 // reduction
    means = (
        pixels[: rows * reduction, : cols * reduction]
        .reshape(rows, reduction, cols, reduction, bands)
        .mean((1, 3))
    )
    assert jpeg.shape == tiff.shape == (-(-101 // reduction), -(-203 // reduction), bands)
    assert np.abs(tiff[:rows, :cols].astype(float) - means).max() <= 0.51
    assert np.abs(jpeg[:rows, :cols].astype(float) - means).mean() < 4.0


def test_tiff_keeps_sixteen_bits_and_many_bands(tmp_path: Path) -> None:
    pixels = (np.arange(40 * 30 * 6).reshape(40, 30, 6) * 9).astype(np.uint16)
    got, valid = read_pixels(
        frame(write_tiff(tmp_path / "a.TIFF", pixels, compress="deflate", interleave="band"))
    )
    assert got.dtype == np.uint16 and valid is None
    assert np.array_equal(got, pixels)
    half, _ = read_pixels(frame(tmp_path / "a.TIFF"), 2)
    assert half.shape == (20, 15, 6)
    assert half[3, 5, 4] == round(pixels[6:8, 10:12, 4].mean())


def test_invalid_pixels_from_nodata_mask_alpha_and_sidecar(tmp_path: Path) -> None:
    pixels = image(40, 30).clip(1, 255)
    hole = np.full((30, 40), 255, np.uint8)
    hole[4:7, 10:13] = 0
    zeroed = pixels * (hole > 0)[..., None]
    files = [
        write_tiff(tmp_path / "nodata.tif", zeroed, nodata=0),
        write_tiff(tmp_path / "mask.tif", pixels, mask=hole),
        write_tiff(tmp_path / "alpha.tif", np.dstack([pixels, hole]), alpha=True),
    ]
    for path in files:
        got, valid = read_pixels(frame(path))
        assert got.shape == (30, 40, 3)
        assert valid is not None and np.array_equal(valid, hole), path.name
    cv2.imwrite(str(tmp_path / "a_mask.png"), hole // 255)
    jpeg = write_jpeg(tmp_path / "a.jpg", pixels)
    (sidecar,) = masks([read_header(jpeg)])[0].values()
    assert sidecar == str(tmp_path / "a_mask.png")
    _, valid = read_pixels(frame(jpeg, Path(sidecar)))
    assert valid is not None and np.array_equal(valid, hole)
    _, quarter = read_pixels(frame(jpeg, Path(sidecar)), 4)
    assert quarter is not None and quarter.shape == (8, 10)
    assert np.argwhere(quarter == 0).tolist() == [[1, 2], [1, 3]]


@pytest.mark.parametrize("how", ["nodata", "sidecar"])
def test_wild_values_of_invalid_pixels_are_nothing(tmp_path: Path, how: str) -> None:
    """Nor do they spoil the means of reduced pixels next to them."""
    pixels = image(40, 30, 1).astype(np.float32) / np.float32(255.0)
    pixels[4:7, 10:13] = np.float32(-3.4e38)
    mask = None
    if how == "sidecar":
        mask = tmp_path / "a_mask.png"
        cv2.imwrite(str(mask), (pixels[..., 0] > -1.0).astype(np.uint8))
    nodata = {"nodata": -3.4e38} if how == "nodata" else {}
    of = frame(write_tiff(tmp_path / "a.tif", pixels, **nodata), mask)
    for reduction in (1, 4):
        got, valid = read_pixels(of, reduction)
        assert valid is not None and (valid == 0).sum() == (9, 2)[reduction > 1]
        assert got.min() >= 0.0 and got.max() <= 1.0
    got, valid = read_pixels(of)
    assert valid is not None and (got[valid == 0] == 0.0).all()
    assert np.array_equal(got[valid > 0], pixels[valid > 0])


def test_a_mask_of_another_size_is_named(tmp_path: Path) -> None:
    jpeg = write_jpeg(tmp_path / "a.jpg", image(40, 30))
    cv2.imwrite(str(tmp_path / "A.MASK.png"), np.ones((30, 41), np.uint8))
    found, spoiled = masks([read_header(jpeg)])
    assert found == {} and spoiled.keys() == {"a.jpg"}
    assert "A.MASK.png: the mask has 41 x 30 pixels, its frame 40 x 30" in str(spoiled["a.jpg"])


@pytest.mark.parametrize("share", [0.3, 0.6, 0.95])
def test_a_jpeg_cut_after_its_header_was_read_is_refused(tmp_path: Path, share: float) -> None:
    path = write_jpeg(tmp_path / "a.jpg", image(400, 300))
    cut = frame(path)
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
    with pytest.raises(FileError, match=r"a\.jpg: the JPEG is truncated"):
        read_pixels(cut)


def png_with(pixels: np.ndarray, *chunks: tuple[bytes, bytes]) -> bytes:
    """A PNG with more chunks in front of its end."""
    whole = cv2.imencode(".png", pixels)[1].tobytes()
    more = (
        len(data).to_bytes(4, "big") + kind + data + zlib.crc32(kind + data).to_bytes(4, "big")
        for kind, data in chunks
    )
    return b"".join((whole[:-12], *more, whole[-12:]))


@pytest.mark.parametrize("packed", [False, True])
def test_a_png_has_pixels_and_tags(tmp_path: Path, packed: bool) -> None:
    rng = np.random.default_rng(5)
    pixels = rng.integers(0, 60000, (40, 30, 3), dtype=np.uint16)
    packet = b"<x:xmpmeta xmlns:x='adobe:ns:meta/'><rdf:RDF xmlns:rdf="
    packet += b"'http://www.w3.org/1999/02/22-rdf-syntax-ns#'><rdf:Description xmlns:d="
    packet += b"'http://www.dji.com/drone-dji/1.0/' d:FlightYawDegree='31.5'/></rdf:RDF></x:xmpmeta>"
    text = b"XML:com.adobe.xmp\0" + bytes([packed, 0]) + b"\0\0"
    text += zlib.compress(packet) if packed else packet
    tags, path = exif_block(Make="DJI", Model="FC6310", FocalLength=Fraction("8.8")), tmp_path / "a.png"
    path.write_bytes(png_with(pixels, (b"eXIf", tags), (b"iTXt", text)))
    header = read_header(path)
    assert (header.width_px, header.height_px, header.bands, header.dtype) == (30, 40, 3, "uint16")
    assert (header.exif.make, header.exif.focal_length_mm) == ("DJI", 8.8)
    assert header.xmp == parse_xmp(packet) != parse_xmp(b"")
    found, mask = read_pixels(frame(path))
    np.testing.assert_array_equal(found[..., ::-1], pixels)
    assert mask is None


def test_a_png_with_alpha_or_damage(tmp_path: Path) -> None:
    rng = np.random.default_rng(6)
    pixels = rng.integers(0, 255, (40, 30, 4), dtype=np.uint8)
    pixels[..., 3] = 255
    pixels[:10, :, 3] = 0
    path = tmp_path / "a.png"
    path.write_bytes(png_with(pixels))
    found, mask = read_pixels(frame(path))
    assert found.shape == (40, 30, 3)
    assert mask is not None
    np.testing.assert_array_equal(mask[:, 0] > 0, np.arange(40) >= 10)
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    assert "not what its check sum says" in looked_at(str(path))[0].damage


def test_a_palette_is_no_frame(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    options = {"driver": "PNG", "width": 8, "height": 8, "count": 1, "dtype": "uint8"}
    with unreferenced_is_fine(), rasterio.open(path, "w", **options) as png:
        png.write(np.zeros((1, 8, 8), np.uint8))
        png.write_colormap(1, {0: (9, 8, 7)})
    with pytest.raises(InputError, match=r"a\.png: has a palette: .*; convert it to RGB or grey"):
        read_header(path)


@pytest.mark.parametrize("compress", ["none", "deflate"])
def test_a_cut_tiff_is_refused(tmp_path: Path, compress: str) -> None:
    rng = np.random.default_rng(3)
    path = write_tiff(
        tmp_path / "a.tif", rng.integers(0, 255, (300, 200, 3), dtype=np.uint8), compress=compress
    )
    whole = frame(path)
    data = path.read_bytes()
    path.write_bytes(data[: int(0.7 * len(data))])
    with pytest.raises(FileError, match=r"a\.tif: the TIFF is truncated: its image data don't end; copy it"):
        read_header(path)
    with pytest.raises(FileError, match=r"a\.tif: the image can't be decoded whole"):
        read_pixels(whole)


def test_other_files_and_types_are_refused(tmp_path: Path) -> None:
    text = tmp_path / "a.tif"
    text.write_text("I am a text")
    with pytest.raises(FileError, match=r"a\.tif: is no readable TIFF or PNG file"):
        read_header(text)
    with pytest.raises(
        InputError, match="pixels of type float64 aren't handled; convert the frame to one of"
    ):
        read_header(write_tiff(tmp_path / "b.tif", np.zeros((8, 8, 1))))
    path = write_jpeg(tmp_path / "c.jpg", image(40, 30))
    with pytest.raises(ValueError, match="reduction is one of"):
        read_pixels(frame(path), 3)
    before = frame(path)
    write_jpeg(path, image(48, 30))
    with pytest.raises(FileError, match="has changed"):
        read_pixels(before)


def test_a_path_that_counts_from_the_current_folder_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A survey out of a stranger's cache may name what lies where the user happens to be."""
    monkeypatch.chdir(tmp_path)
    write_jpeg(tmp_path / "a.jpg", np.zeros((48, 96, 3), np.uint8), exif_block(Orientation=1))
    with pytest.raises(FileError, match=r"^a\.jpg: is no full path"):
        read_pixels(frame(Path("a.jpg")))


@pytest.mark.parametrize("spoil", ["cut", "flipped", "without its end", "length"])
def test_a_damaged_png_mask_is_named(tmp_path: Path, spoil: str) -> None:
    """GDAL decodes what is left of each, with rows missing or wrong and not a word of it."""
    jpeg = write_jpeg(tmp_path / "a.jpg", image(40, 30))
    mask = tmp_path / "a_mask.png"
    hole = np.random.default_rng(2).integers(0, 2, (30, 40)).astype(np.uint8) * 255
    cv2.imwrite(str(mask), hole)
    whole = mask.read_bytes()
    assert masks([read_header(jpeg)])[1] == {}
    at = whole.index(b"IDAT") + 20
    spoiled = {
        "cut": whole[: at + 4],
        "flipped": whole[:at] + bytes([whole[at] ^ 1]) + whole[at + 1 :],
        "without its end": whole[:-12],
        "length": whole[: at - 24] + b"\x00\x00\xff\xff" + whole[at - 20 :],
    }
    mask.write_bytes(spoiled[spoil])
    (error,) = masks([read_header(jpeg)])[1].values()
    assert re.search(r"a_mask\.png: (the mask is damaged|can't be)", str(error))


def test_brightness_alone(tmp_path: Path) -> None:
    """Of a JPEG in colour one band, weighed as ITU-R BT.601 does; of other files all bands, as they are."""
    pixels = image(96, 64, 3)
    jpeg = frame(write_jpeg(tmp_path / "a.jpg", pixels))
    (grey, valid), (colour, _) = read_pixels(jpeg, luma=True), read_pixels(jpeg)
    assert grey.shape == (64, 96, 1) and valid is None
    assert np.abs(grey[..., 0] - colour @ np.array([0.299, 0.587, 0.114])).mean() < 1.0
    tiff = frame(write_tiff(tmp_path / "a.tif", pixels))
    assert np.array_equal(read_pixels(tiff, luma=True)[0], pixels)


Small = TypeVar("Small")


class Lying(Generic[Small]):
    """What was left of a frame, or nothing."""

    def __init__(self, small: Small | None) -> None:
        self.small = small

    def found(self) -> Small | None:
        return self.small

    def leave(self, result: Small) -> None:
        raise AssertionError


@pytest.mark.parametrize("bands", [1, 3])
def test_what_was_left_of_a_frame_is_what_decoding_it_gives(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, bands: int
) -> None:
    path = write_jpeg(tmp_path / "a.jpg", image(517, 509, bands))
    half = looked_at(str(path))[1]
    assert half is not None
    asked = [{"reduction": 2, "luma": True}, {"reduction": 8}, {"reduction": 4}, {"reduction": 1}]
    anew = [read_pixels(frame(path), **how)[0] for how in asked]  # type: ignore[arg-type]
    decodes: list[int] = []
    monkeypatch.setattr(pixels_room, "decoded", lambda *of: decodes.append(1) or decoded(*of))
    for how, wanted in zip(asked, anew, strict=True):
        for spare in (
            Spare(Lying(HalfGrey.of(half)), Lying(EighthColours.of(half))),
            Spare(Lying(None), Lying(None)),
        ):
            assert np.array_equal(read_pixels(frame(path), spare=spare, **how)[0], wanted)  # type: ignore[arg-type]
    assert len(decodes) == 6  # neither of the first two where they lie
    assert anew[0].shape == (255, 259, 1)
