"""No file that geomosaic reads makes it open a connection: GDAL and PROJ are set so before they are loaded.

By environment variables, since two builds of GDAL (rasterio's and osgeo's), PROJ and the programs that are
started read them alike. Remote paths are refused at the doors; this is the bolt behind. `geomosaic fetch`
alone opens it, for one name at a time (`doors.remote`).
"""

from __future__ import annotations

import os
from typing import Final

SETTINGS: Final = {
    "PROJ_NETWORK": "OFF",
    "CPL_VSIL_CURL_ALLOWED_FILENAME": "none",
    "GDAL_VRT_ENABLE_PYTHON": "NO",
    "GDAL_VRT_ENABLE_RAWRASTERBAND": "NO",
}
"""Among them that a VRT can neither run code nor take another file's bytes for pixels."""


def go_offline() -> None:
    """Sets `SETTINGS` for this process and those it starts, where they are not set."""
    os.environ.update({name: value for name, value in SETTINGS.items() if os.environ.get(name) != value})
