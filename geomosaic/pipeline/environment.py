"""Where a run ran."""

from __future__ import annotations

import platform
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
    found = {"geomosaic": __version__, "python": platform.python_version(), "platform": platform.platform()}
    for package in _PACKAGES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            continue
    return found
