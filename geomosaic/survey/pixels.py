"""Pixels of a frame, decoded."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from rasterio.enums import ColorInterp, MaskFlags
from rasterio.windows import Window

from geomosaic.arrays import Bytes
from geomosaic.doors.at_hand import at_hand
from geomosaic.doors.camera_formats import camera_format, decoded_camera_image
from geomosaic.doors.raster import FRAME, MASK, open_raster, reading
from geomosaic.doors.thermograms import thermogram
from geomosaic.errors import FileError
from geomosaic.survey.damage import decoded
from geomosaic.survey.header import JPEG_SUFFIXES, mask_size_error
from geomosaic.survey.jpeg import parse_structure
from geomosaic.survey.model import Frame
from geomosaic.survey.small import HALF, REDUCTIONS, Spare, brightness, means, padded

_FIX: Final = "copy it again from the camera, or take it out of the folder"


def read_pixels(
    frame: Frame, reduction: int = 1, *, luma: bool = False, spare: Spare | None = None
) -> tuple[NDArray[Any], Bytes | None]:
    """A frame's pixels (rows, cols, bands) in the file's own type, and its mask of valid pixels; of a frame
    with a calibration reflectance, see `Calibration.digital`.

    Bands are in the file's order (red, green, blue for colour); an alpha band goes into the mask.
    EXIF's orientation is ignored: columns and rows are the sensor's. The mask is (rows, cols), 255
    where a pixel is valid and 0 where not, None where all are. Fractional values are 0 where not valid.

    A reduced pixel is the mean of reduction x reduction full ones, so that in corner-origin
    coordinates `reduced = full / reduction`; sizes are rounded up. JPEG is halved while decoding. A
    reduced pixel is valid where all full ones are.

    Args: reduction: 1, 2, 4 or 8; luma: of a JPEG in colour one band is enough, its brightness by ITU-R
    BT.601; other files give all of theirs. spare: where a JPEG's pixels may lie already.
    Raises: `FileError` when the file can't be decoded whole; `ValueError` for another reduction.
    """
    if reduction not in REDUCTIONS:
        raise ValueError(f"reduction is one of {REDUCTIONS}, not {reduction}")
    path = Path(frame.path)
    for named in filter(None, (frame.path, frame.valid_mask)):
        if not Path(named).is_absolute():  # in the current folder lies what nobody named
            raise FileError("is no full path", file=named, fix="run the recipe again from its first stage")
    pixels: NDArray[Any]
    valid: Bytes | None
    bands = frame.bands
    reduced = 1
    if path.suffix.lower() in JPEG_SUFFIXES and frame.dtype == "float32":
        pixels, valid = thermogram(path)[..., None], None
    elif path.suffix.lower() in JPEG_SUFFIXES:
        bands, reduced = 1 if luma else bands, reduction
        kept = None if spare is None else spare.at(reduction, bands)
        pixels, valid = _decode_jpeg(path, frame, bands, reduction) if kept is None else kept, None
    else:
        if camera_format(path) is None:
            pixels, valid = _read_raster(path, frame.whole_rows)
        else:
            pixels, valid = decoded_camera_image(path, (frame.width_px, frame.height_px))
        pixels = pixels if frame.calibration is None else frame.calibration.digital(pixels)
    expected = (-(-frame.height_px // reduced), -(-frame.width_px // reduced), bands)
    if pixels.shape != expected:
        raise FileError(f"has changed: {pixels.shape} pixels instead of {expected}", file=path, fix=_FIX)
    if frame.valid_mask is not None:
        sidecar = _read_mask(Path(frame.valid_mask), (frame.height_px, frame.width_px))
        valid = sidecar if valid is None else np.minimum(valid, sidecar)
    if frame.whole_rows is not None:
        valid = np.full((frame.height_px, frame.width_px), 255, np.uint8) if valid is None else valid
        valid[frame.whole_rows :] = 0
    if valid is not None and pixels.dtype.kind == "f":  # nodata of -3.4e38 would spoil means and costs
        pixels = np.where(valid[..., None] > 0, pixels, pixels.dtype.type(0))
    return means(pixels, reduction // reduced), None if valid is None else _least(valid, reduction)


def _decode_jpeg(path: Path, frame: Frame, bands: int, reduction: int) -> NDArray[Any]:
    try:
        data = at_hand(path).read_bytes()
    except OSError as error:
        raise FileError(f"can't be read ({error.strerror})", file=path, fix=_FIX) from error
    parse_structure(data, path, whole=frame.whole_rows is None)  # what is missing is filled with grey
    try:
        if reduction == 1:
            return decoded(data, bands)
        half = decoded(data, frame.bands, HALF)
        return means(brightness(half) if bands == 1 else half, reduction // HALF)
    except ValueError as error:
        raise FileError("the JPEG can't be decoded", file=path, fix=_FIX) from error


def _read_raster(path: Path, whole_rows: int | None) -> tuple[NDArray[Any], Bytes | None]:
    """By rasterio: it knows nodata, internal masks, alpha, any number of bands, and what is missing."""
    with reading(path, "the image can't be decoded whole", _FIX), open_raster(path, FRAME) as tiff:
        bands = zip(tiff.indexes, tiff.colorinterp, strict=True)
        window = Window(0, 0, tiff.width, tiff.height if whole_rows is None else whole_rows)
        pixels = tiff.read([i for i, c in bands if c != ColorInterp.alpha], window=window)
        masked = any(flag != MaskFlags.all_valid for flags in tiff.mask_flag_enums for flag in flags)
        valid = tiff.dataset_mask(window=window) if masked else None
        missing = tiff.height - window.height
    if missing:
        pixels = np.pad(pixels, [(0, 0), (0, missing), (0, 0)])
        valid = None if valid is None else np.pad(valid, [(0, missing), (0, 0)])
    pixels = np.moveaxis(pixels, 0, -1)
    if pixels.dtype.kind == "f" and not (finite := np.isfinite(pixels)).all():
        pixels = np.where(finite, pixels, pixels.dtype.type(0))
        valid = np.where(finite.all(axis=-1), 255 if valid is None else valid, 0)
    if valid is not None:
        valid = np.where(valid > 0, np.uint8(255), np.uint8(0))
        valid = None if valid.all() else valid
    return np.ascontiguousarray(pixels), valid


def _read_mask(path: Path, shape: tuple[int, int]) -> Bytes:
    """255 where any colour is above 0, or bright in a JPEG; an alpha band says nothing."""
    with open_raster(path, MASK) as mask, reading(path, MASK.problem, MASK.fix):
        if mask.shape != shape:
            raise mask_size_error(path, (mask.width, mask.height), (shape[1], shape[0]))
        if mask.colorinterp[0] == ColorInterp.palette:
            colours = mask.colormap(1)
            lit = np.array([any(colours.get(i, (i,))[:3]) for i in range(256)])
            return np.where(lit[mask.read(1)], np.uint8(255), np.uint8(0))
        valid = np.zeros(shape, dtype=np.uint8)
        dark = 127 if mask.driver == "JPEG" else 0  # black is not quite so in JPEG
        for i, colour in zip(mask.indexes, mask.colorinterp, strict=True):
            if colour != ColorInterp.alpha:
                valid[mask.read(i) > dark] = 255
        return valid


def _least(valid: Bytes, reduction: int) -> Bytes:
    if reduction == 1:
        return valid
    whole = padded(valid, reduction)
    rows, cols = (n // reduction for n in whole.shape)
    return np.asarray(whole.reshape(rows, reduction, cols, reduction).min(axis=(1, 3)))
