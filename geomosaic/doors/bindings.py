"""GDAL's Python bindings, built for the libgdal of this machine and with numpy: pip can know neither."""

from __future__ import annotations

import shutil
import subprocess
from typing import Final

from geomosaic.errors import BindingsError

_LIBRARY: Final = "install libgdal-dev (Debian, Ubuntu), gdal-devel (Fedora) or gdal (Homebrew), or use conda"


def _fix() -> str:
    """What to install, for the libgdal that is here."""
    if shutil.which("gdal-config") is None:
        return _LIBRARY
    found = subprocess.run(["gdal-config", "--version"], capture_output=True, text=True, check=False)  # noqa: S607
    bindings = f"'gdal[numpy]=={found.stdout.strip()}'"
    return (
        "pip install setuptools wheel numpy && "
        f"pip install --force-reinstall --no-deps --no-cache-dir --no-build-isolation {bindings}"
    )


try:
    from osgeo import gdal, gdal_array, ogr, osr
except ImportError as error:
    missing = isinstance(error, ModuleNotFoundError) and error.name == "osgeo"
    problem = "are not installed" if missing else f"don't work ({error})"
    raise BindingsError(f"GDAL's Python bindings {problem}; {_fix()}") from error

__all__ = ["gdal", "gdal_array", "ogr", "osr"]
