"""`geomosaic doctor`: is everything here that the work needs, and does it fit together?"""

from __future__ import annotations

import importlib
import json
import os
import shutil
import tempfile
import textwrap
import warnings
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from geomosaic.cli.options import AsJson
from geomosaic.requests.run_request import cores


@dataclass(frozen=True)
class Check:
    """What was looked at, how it stands (ok, warning, broken), and one line about it."""

    name: str
    state: str
    text: str


def _versions() -> tuple[str, str]:
    from geomosaic.pipeline.environment import versions

    return "ok", ", ".join(f"{name} {number}" for name, number in versions().items())


def _bindings() -> tuple[str, str]:
    import numpy as np

    from geomosaic.doors.bindings import gdal, gdal_array

    gdal.UseExceptions()

    kind = gdal_array.flip_code(gdal.GDT_UInt16)
    return ("ok" if kind == np.uint16 else "broken"), f"GDAL {gdal.__version__} with numpy"


def _drivers() -> tuple[str, str]:
    from osgeo import gdal

    wanted = {"COG": True, "GTiff": True, "GPKG": True, "JPEG": True, "VRT": True, "PNG": True, "WEBP": False}
    missing = [name for name in wanted if gdal.GetDriverByName(name) is None]
    if any(wanted[name] for name in missing):
        return "broken", f"GDAL lacks {', '.join(missing)}; install a full build of GDAL"
    return ("warning" if missing else "ok"), f"missing: {', '.join(missing)}" if missing else ", ".join(
        wanted
    )


def _both_gdals() -> tuple[str, str]:
    import numpy as np
    import rasterio
    from osgeo import gdal, osr
    from pyproj import CRS

    from geomosaic.doors.raster import OWN, open_raster

    gdal.UseExceptions()
    pixels = np.arange(35, dtype=np.uint8).reshape(5, 7)
    with tempfile.TemporaryDirectory(prefix="geomosaic-") as folder:
        path = str(Path(folder) / "both.tif")
        srs = osr.SpatialReference()
        srs.ImportFromEPSG(32615)
        dataset = gdal.GetDriverByName("GTiff").Create(path, 7, 5, 1)
        dataset.SetProjection(srs.ExportToWkt())
        dataset.SetGeoTransform((500000.0, 0.5, 0.0, 5000000.0, 0.0, -0.5))
        dataset.WriteArray(pixels)
        dataset.FlushCache()
        del dataset
        with open_raster(Path(path), OWN) as file:
            same = bool((file.read(1) == pixels).all())
            same = same and CRS.from_wkt(file.crs.to_wkt()) == CRS.from_epsg(32615)
            same = same and tuple(file.transform)[:6] == (0.5, 0.0, 500000.0, 0.0, -0.5, 5000000.0)
        text = f"osgeo {gdal.__version__} writes, rasterio (GDAL {rasterio.__gdal_version__}) reads"
    return ("ok", f"{text} the same") if same else ("broken", f"{text} something else")


def _opencv() -> tuple[str, str]:
    import numpy as np

    cv2: Any = importlib.import_module("cv2")

    jpeg = cv2.imencode(".jpg", np.full((16, 16, 3), 99, np.uint8))[1]
    half = cv2.imdecode(jpeg, cv2.IMREAD_REDUCED_COLOR_2)
    cv2.SIFT_create(nfeatures=10)
    return ("ok" if half.shape == (8, 8, 3) else "broken"), f"OpenCV {cv2.__version__} with JPEG and SIFT"


def _geoids() -> tuple[str, str]:
    from pyproj.datadir import get_data_dir, get_user_data_dir  # type: ignore[attr-defined]
    from pyproj.transformer import TransformerGroup

    from geomosaic.geodesy.heights import GEOIDS

    def installed(code: int) -> bool:
        with warnings.catch_warnings(action="ignore"):
            group = TransformerGroup(f"EPSG:4326+{code}", "EPSG:4979", always_xy=True, allow_ballpark=False)
        return bool(group.transformers)

    missing = [name for name, code in GEOIDS.items() if not installed(code)]
    state = ", ".join(f"{name} {'not installed' if name in missing else 'installed'}" for name in GEOIDS)
    how = f" (geomosaic geoid fetch {missing[-1]})" if missing else ""
    folders = f"{get_data_dir()}, {get_user_data_dir()}"
    return (
        "ok",
        f"PROJ data in {folders}; geoids: EGM96 at 15 minutes comes with geomosaic; grids: {state}{how}",
    )


def _stages() -> tuple[str, str]:
    from geomosaic.pipeline.registry import installed

    working, broken = installed().all()
    if broken or not working:
        return "broken", "; ".join(broken.values()) or "no stages; install the package (make setup)"
    return "ok", f"{len(working)} stages"


def _machine() -> tuple[str, str]:
    free_gb = shutil.disk_usage(Path.cwd()).free / 1e9
    try:
        memory_gb = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") / 1e9
    except (ValueError, OSError, AttributeError):
        memory_gb = float("nan")
    text = f"{cores()} cores, {memory_gb:.1f} GB of memory, {free_gb:.1f} GB free in {Path.cwd()}"
    return ("warning" if free_gb < 2 or memory_gb < 2 else "ok"), text


CHECKS: dict[str, Callable[[], tuple[str, str]]] = {
    "versions": _versions,
    "GDAL bindings": _bindings,
    "GDAL drivers": _drivers,
    "osgeo and rasterio": _both_gdals,
    "OpenCV": _opencv,
    "PROJ": _geoids,
    "stages": _stages,
    "machine": _machine,
}


def doctor(as_json: AsJson = False) -> int:
    """Check the installation and the machine.

    Checked are versions, drivers, both GDALs, grids, stages, disk and memory.
    """
    checks = []
    for name, look in CHECKS.items():
        try:
            checks.append(Check(name, *look()))
        except Exception as error:
            checks.append(Check(name, "broken", " ".join(f"{type(error).__name__}: {error}".split())))
    if as_json:
        print(json.dumps([asdict(c) for c in checks], indent=2))
    else:
        for c in checks:
            head = f"{c.state:<8} {c.name:<19} "
            lines = textwrap.wrap(c.text, 100 - len(head), break_on_hyphens=False, break_long_words=False)
            print(head + f"\n{' ' * len(head)}".join(lines))
    return 1 if any(c.state == "broken" for c in checks) else 0
