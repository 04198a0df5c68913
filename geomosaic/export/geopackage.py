"""A GeoPackage of vector layers with the styles that QGIS opens them in, written by pyogrio.

A row costs 20 microseconds through OGR's features in Python, and a survey has hundreds of thousands of tie
points; pyogrio takes columns.
"""

from __future__ import annotations

import errno
import shutil
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

import numpy as np
import shapely
from numpy.typing import NDArray

from geomosaic.arrays import Floats
from geomosaic.export.styles import Style, qml

_COLUMN: Final = "geom"
_STYLES: Final = "layer_styles"
_VERSION: Final = "1.2"
"""What GIS of the last years read and write alike; GDAL's newest has other triggers."""
_LITTLE_BYTES: Final = 1 << 20
_ZONE_UTC: Final = 100
"""OGR's flag of a time in UTC."""


@dataclass(frozen=True)
class MapFeatures:
    """A layer: its name and description, shapely geometries of a type, and `fields`, columns of the same
    length: numbers, text or times in UTC (`datetime64`). NaN, NaT and None become NULL.

    style: how a GIS shows it at first. metadata: as GIS show it.
    """

    name: str
    text: str
    geometry_type: str
    geometries: Sequence[Any] | NDArray[np.object_]
    fields: Mapping[str, Any]
    style: Style | None = None
    metadata: Mapping[str, str] | None = None


def columns(names: str, values: Floats) -> dict[str, Floats]:
    """The columns of values (n, c) by their names, which blanks separate."""
    return dict(zip(names.split(), values.T, strict=True))


def write_geopackage(path: Path, crs: str, time_s: float | None, layers: Iterable[MapFeatures]) -> None:
    """Writes a new GeoPackage with its layers in this order.

    time_s: seconds since 1970 UTC that stand as its time of change, so that equal data give equal bytes.
    Raises: `OSError` if it can't be written (`ENOSPC` where the disk is full).
    """
    import pyogrio

    stamp, written = datetime.fromtimestamp(time_s or 0.0, UTC), list(layers)
    if styled := [layer for layer in written if layer.style is not None]:
        written.append(_style_table(styled, stamp))
    settings = {"OGR_CURRENT_DATE": f"{stamp:%Y-%m-%dT%H:%M:%S.000Z}", "OGR_SQLITE_SYNCHRONOUS": "OFF"}
    before = {name: pyogrio.get_gdal_config_option(name) for name in settings}
    pyogrio.set_gdal_config_options(settings)
    try:
        for number, layer in enumerate(written):
            _write(path, layer, crs, append=number > 0)
    except RuntimeError as error:
        full = shutil.disk_usage(path.parent).free < _LITTLE_BYTES
        raise OSError(errno.ENOSPC if full else errno.EIO, " ".join(str(error).split())) from error
    finally:
        pyogrio.set_gdal_config_options(before)


def _write(path: Path, layer: MapFeatures, crs: str, *, append: bool) -> None:
    from pyogrio.raw import write

    placed = layer.geometry_type != "None"
    fields = {field: np.asarray(values) for field, values in layer.fields.items()}
    shapes = np.array([*layer.geometries], dtype=object)
    of_geometry = {"GEOMETRY_NAME": _COLUMN, "SPATIAL_INDEX": "YES"} if placed else {"FID": "id"}
    write(
        str(path),
        shapely.to_wkb(shapes, flavor="iso") if placed else None,
        [v.astype(object) if v.dtype.kind == "U" else v for v in fields.values()],
        np.array(list(fields), dtype=object),
        layer=layer.name,
        driver="GPKG",
        geometry_type=layer.geometry_type.replace("PointZ", "Point Z") if placed else None,
        crs=crs if placed else None,
        append=append,
        gdal_tz_offsets={f: np.full(len(v), _ZONE_UTC) for f, v in fields.items() if v.dtype.kind == "M"},
        dataset_options=None if append else {"VERSION": _VERSION},
        layer_options={"DESCRIPTION": layer.text, **of_geometry},
        layer_metadata=dict(layer.metadata) if layer.metadata else None,
    )


def _style_table(layers: Sequence[MapFeatures], stamp: datetime) -> MapFeatures:
    """The table in which QGIS keeps styles and finds those that count as default."""
    n = len(layers)
    styles = [layer.style for layer in layers if layer.style is not None]
    fields = {
        "f_table_catalog": [""] * n,
        "f_table_schema": [""] * n,
        "f_table_name": [layer.name for layer in layers],
        "f_geometry_column": [_COLUMN] * n,
        "styleName": ["geomosaic"] * n,
        "styleQML": [qml(style) for style in styles],
        "styleSLD": [""] * n,
        "useAsDefault": np.ones(n, dtype=bool),
        "description": [style.text for style in styles],
        "owner": ["geomosaic"] * n,
        "ui": [""] * n,
        "update_time": np.full(n, np.datetime64(stamp.replace(tzinfo=None), "ms")),
    }
    return MapFeatures(_STYLES, "How layers are shown", "None", [], fields)
