"""Writes geomosaic/geodesy/egm96_15.npz from NGA's 15-minute grid of EGM96 as PROJ has it.

python tools/egm96.py /usr/share/proj/egm96_15.gtx   (Debian's package proj-data; or us_nga_egm96_15.tif)
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import rasterio

from geomosaic.geodesy.egm96 import FILE


def main() -> None:
    """Second differences in whole centimetres, rows from north, columns from 180 degrees west."""
    with rasterio.open(sys.argv[1]) as grid:
        assert grid.shape == (721, 1440), grid.shape
        assert np.allclose(grid.xy(0, 0), (-180.0, 90.0)), grid.xy(0, 0)
        undulation_cm = np.rint(100.0 * grid.read(1)).astype(np.int16)
    down = np.diff(undulation_cm, axis=0, prepend=np.int16(0))
    np.savez_compressed(FILE, differences_cm=np.diff(down, axis=1, prepend=np.int16(0)))
    print(f"{FILE}: {Path(FILE).stat().st_size:,} bytes")


if __name__ == "__main__":
    main()
