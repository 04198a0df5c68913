"""Temperatures inside the JPEG of a FLIR camera, by the extra `thermal`."""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from io import BytesIO
from pathlib import Path
from typing import Any, Final

import numpy as np

from geomosaic.arrays import Floats32
from geomosaic.constants import tuned
from geomosaic.doors.at_hand import at_hand
from geomosaic.doors.files import TEXT_BYTES, read_bytes
from geomosaic.errors import FileError, InputError

_MOST_RECORDS = tuned(1000, "records", "of a FLIR JPEG, usually 12: a damaged number would take hours")
_MOST_PX = tuned(16 << 20, "px", "of a thermogram, usually 0.3e6: more takes minutes to unpack")
_MARK: Final = re.compile(rb"\xff\xe1..FLIR\0", re.DOTALL)
_FIX: Final = "take it out of the folder, or leave out --radiometry temperature"
_CONVERT: Final = (
    "convert DJI's frames to TIFF in 32-bit floats with its Thermal Analysis Tool or dji-thermal-cli, or "
    "leave out --radiometry temperature"
)


def check_thermograms() -> None:
    """`InputError` where the extra is not installed."""
    if find_spec("flyr") is None:
        raise InputError(
            "flyr, which reads the temperatures in FLIR's JPEG files, is not installed",
            fix="pip install 'geomosaic-ortho[thermal]', or convert the frames to TIFF in 32-bit floats",
        )


def thermogram(path: Path) -> Floats32:
    """Degrees Celsius (rows, cols) by the camera's calibration, emissivity and air.

    Raises: `FileError` where there are none, where they are damaged or too large.
    """
    from flyr.flyr import parse_thermogram

    with _records(path) as (stream, records), warnings.catch_warnings():
        warnings.simplefilter("error")  # of an image that is too large
        stream.seek(records[1][2] + 2)
        width, height = (int.from_bytes(stream.read(2), "little") for _ in range(2))
        if not 0 < width * height <= _MOST_PX:
            raise FileError(f"its temperatures are {width} x {height} pixels", file=path, fix=_FIX)
        values = parse_thermogram(
            stream, records, BytesIO(read_bytes(at_hand(path), TEXT_BYTES, "a frame", _FIX))
        ).celsius
        return np.asarray(values, dtype=np.float32)


@contextmanager
def _records(path: Path) -> Iterator[tuple[BytesIO, dict[int, Any]]]:
    """The FLIR data in a JPEG, and where its records lie."""
    from flyr.records import extract_flir_app1, parse_flir_records

    data = read_bytes(at_hand(path), TEXT_BYTES, "a frame", _FIX)
    if _MARK.search(data) is None:
        raise FileError("holds no temperatures of a FLIR camera", file=path, fix=_CONVERT)
    try:
        stream = extract_flir_app1(BytesIO(data))
        stream.seek(0x1C)
        if int.from_bytes(stream.read(4), "big") > _MOST_RECORDS:
            raise FileError("its FLIR records are damaged", file=path, fix=_FIX)
        stream.seek(0)
        yield stream, parse_flir_records(stream)
    except FileError:
        raise
    except Exception as error:  # a library that states none
        raise FileError("its temperatures can't be decoded", file=path, fix=_FIX) from error
