"""Changes between two maps as polygons and as a picture."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final

import cv2
import numpy as np
import shapely
from rasterio import Affine
from rasterio.enums import Resampling

from geomosaic.arrays import Floats
from geomosaic.doors.raster import OWN, open_raster, reading
from geomosaic.export.geopackage import MapFeatures, write_geopackage
from geomosaic.export.shown_bands import shown_bands
from geomosaic.quality.changes import HEIGHT, IMAGE, Change
from geomosaic.quality.rasters import mask_of

LAYER: Final = "changes"
_PICTURE_PX: Final = 2000  # longest side of the picture: more does not fit a screen
_COLOURS: Final = {IMAGE: (0, 0, 255), HEIGHT: (255, 80, 0)}
"""Blue, green, red: red for images, blue for heights."""


def write_polygons(path: Path, changes: Sequence[Change], crs: str, time_s: float | None) -> None:
    """A GeoPackage with one layer. Raises: `OSError` if it can't be written."""
    fields = {
        "kind": np.array([c.kind for c in changes], dtype=str),
        "deviations": np.array([c.sigma for c in changes], dtype=np.float64),
        "area_m2": np.array([c.area_m2 for c in changes], dtype=np.float64),
        "rise_m": np.array([c.rise_m for c in changes], dtype=np.float64),
        "volume_m3": np.array([c.volume_m3 for c in changes], dtype=np.float64),
    }
    shapes = [
        shapely.MultiPolygon([c.outline]) if c.outline.geom_type == "Polygon" else c.outline for c in changes
    ]
    text = "Differences of images and heights beyond the accuracy of both maps"
    write_geopackage(path, crs, time_s, [MapFeatures(LAYER, text, "MultiPolygon", shapes, fields)])


def write_picture(path: Path, mosaic: Path, changes: Sequence[Change]) -> None:
    """The new map, reduced, with the outlines of changes: red of images, blue of heights.

    Raises: `OSError` if it can't be written.
    """
    shown = shown_bands(mosaic)
    with open_raster(mosaic, OWN) as tiff, reading(mosaic):
        share = min(1.0, _PICTURE_PX / max(tiff.width, tiff.height))
        shape = max(1, round(tiff.height * share)), max(1, round(tiff.width * share))
        size = (len(shown.bands), *shape)
        bands = shown.eight_bits(tiff.read(shown.bands, out_shape=size, resampling=Resampling.average))
        bands[:, mask_of(tiff, shape=shape) == 0] = 0
        inverse = ~tiff.transform
    picture = np.ascontiguousarray(np.moveaxis(np.broadcast_to(bands, (3, *shape)), 0, -1)[..., ::-1])
    for change in changes:
        for part in shapely.get_parts(change.outline):
            ring = shapely.get_coordinates(part.exterior)
            at = np.round(_pixels(inverse, ring) * share).astype(np.int32)
            cv2.polylines(picture, [at], True, _COLOURS[change.kind], 2, cv2.LINE_AA)
    done, data = cv2.imencode(".png", picture)
    if not done:
        raise OSError(f"{path} can't be encoded")
    path.write_bytes(data.tobytes())


def _pixels(inverse: Affine, at: Floats) -> Floats:
    """Cols and rows (n, 2) of places on the map."""
    linear = np.array([[inverse.a, inverse.b], [inverse.d, inverse.e]])
    return np.asarray(at @ linear.T + [inverse.c, inverse.f])
