"""A made-up geoid that PROJ finds under a real one's name."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pyproj


def undulation_m(lon: np.ndarray, lat: np.ndarray) -> np.ndarray:
    """40 m at 11 degrees east, 47 north, rising by 1 m a degree to the east and 2 m to the north."""
    return 40.0 + (lon - 11.0) + 2.0 * (lat - 47.0)


@contextmanager
def egm96_of(folder: Path) -> Iterator[None]:
    """EGM96's grid as PROJ looks for it, 9 to 13 degrees east, 45 to 49 north, of `undulation_m`."""
    west, south, step, rows, cols = 9.0, 45.0, 0.25, 17, 17
    lat, lon = np.mgrid[:rows, :cols] * step + np.array([south, west])[:, None, None]
    head = np.array([south, west, step, step], dtype=">f8").tobytes()
    head += np.array([rows, cols], dtype=">i4").tobytes()
    (folder / "egm96_15.gtx").write_bytes(head + undulation_m(lon, lat).astype(">f4").tobytes())
    before = pyproj.datadir.get_data_dir()
    pyproj.datadir.set_data_dir(f"{before}:{folder}")
    try:
        yield
    finally:
        pyproj.datadir.set_data_dir(before)
