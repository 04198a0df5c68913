"""Where a run ran."""

from __future__ import annotations

import platform
from functools import cache
from importlib.metadata import PackageNotFoundError, version

from geomosaic import __version__

_PACKAGES = (
    "numpy",
    "scipy",
    "gdal",
    "rasterio",
    "pyproj",
    "shapely",
    "opencv-python-headless",
    "mcap",
    "pydantic",
    "rerun-sdk",
)


def versions() -> dict[str, str]:
    """Versions of geomosaic, Python, the platform and the libraries that do the work."""
    own = {"geomosaic": __version__, "python": platform.python_version(), "platform": platform.platform()}
    return own | {package: found for package in _PACKAGES if (found := _version(package))}


@cache
def _version(package: str) -> str:
    """Empty where it isn't installed; a run asks twice, and each time its metadata would be read."""
    try:
        return version(package)
    except PackageNotFoundError:
        return ""
