"""layers.gpkg of a scene of CCD strips: outlines, and the seams with their misplacement."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import shapely

from geomosaic.arrays import Floats
from geomosaic.camera.rpc import Rpc
from geomosaic.ccd.outlines import Outlines, lonlat_by_rpc
from geomosaic.composition.strip_compose import StripMosaic
from geomosaic.export import looks
from geomosaic.export.geopackage import MapFeatures, write_geopackage
from geomosaic.geodesy.mapcrs import MapProjection
from geomosaic.quality.strip_figures import SEGMENT_LINES
from geomosaic.quality.strips import StripQuality
from geomosaic.survey.strips import StripGeometry

_CRS = "EPSG:4326"


@dataclass(frozen=True)
class SceneOnMap:
    """A composed scene, the outlines of it and of its strips, and its RPC if it has one."""

    mosaic: StripMosaic
    rings: Outlines
    rpc: Rpc | None


def write_strip_layers(path: Path, geometry: StripGeometry, scene: SceneOnMap, quality: StripQuality) -> None:
    """Writes the GeoPackage, in longitude and latitude. Without a model or an RPC its layers are empty.

    scene: the raster's outline. ccd_strips: what each CCD saw. seam_segments: 512 lines each of a seam, at
    the RPC's middle height. Each has the root mean square misplacement of the lines that were checked (NULL
    where none was), and whether it is above 1 px.
    Raises: `OSError` if the file can't be written.
    """
    mosaic, rings, rpc = scene.mosaic, scene.rings, scene.rpc
    lon_deg = float(rings.scene[0, 0]) if len(rings.scene) else 0.0
    outline = [shapely.Polygon(_near(rings.scene, lon_deg))] if len(rings.scene) else []
    size = {"width_px": [mosaic.width_px], "height_px": [mosaic.height_px]}
    size = {name: values[: len(outline)] for name, values in size.items()}
    ccds = list(rings.ccds)
    of_ccds = {
        "ccd": np.array(ccds, dtype=np.int64) + 1,
        "strip": np.array([_name(geometry, k) for k in ccds], dtype=str),
        "row": np.array([geometry.ccds[k].row for k in ccds], dtype=np.int64),
        "lines": np.array([geometry.lines[k] for k in ccds], dtype=np.int64),
    }
    seen = [shapely.Polygon(_near(rings.ccds[k], lon_deg)) for k in ccds]
    pairs, firsts, misplaced = (of[: 0 if rpc is None else None] for of in _segments(quality))
    of_segments = {
        "pair": pairs,
        "first_line": firsts,
        "misplacement_px": misplaced,
        "above_1px": (misplaced > 1.0).astype(np.int64),
    }
    lines = [] if rpc is None else _lines(geometry, mosaic, rpc, pairs, firsts)
    lines = [shapely.transform(line, lambda ends: _near(ends, lon_deg)) for line in lines]
    text = "Misplacement of each seam, by segments"
    layers = (
        MapFeatures("scene", "The scene's outline", "Polygon", outline, size, looks.scene()),
        MapFeatures("ccd_strips", "What each CCD saw", "Polygon", seen, of_ccds, looks.ccd_strips()),
        MapFeatures("seam_segments", text, "LineString", lines, of_segments, looks.seam_segments()),
    )
    write_geopackage(path, _CRS, None, layers)


def _name(geometry: StripGeometry, ccd: int) -> str:
    path = geometry.ccds[ccd].path
    return "" if path is None else path.name


def _segments(quality: StripQuality) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pair, first line of the left strip, and misplacement of every segment."""
    pairs = np.concatenate([np.full(len(p.segments_px), p.pair) for p in quality.pairs] or [np.zeros(0, int)])
    firsts = np.concatenate(
        [np.arange(len(p.segments_px)) * SEGMENT_LINES for p in quality.pairs] or [np.zeros(0, int)]
    )
    return pairs, firsts, np.concatenate([p.segments_px for p in quality.pairs] or [np.zeros(0)])


def _near(lonlat: Floats, lon_deg: float) -> Floats:
    """Longitudes and latitudes (n, 2) that do not jump at 180 degrees, but go on from one of the scene."""
    return np.column_stack([MapProjection(_CRS).unwrapped(lonlat[:, 0], lon_deg), lonlat[:, 1]])


def _lines(
    geometry: StripGeometry, mosaic: StripMosaic, rpc: Rpc, pairs: np.ndarray, firsts: np.ndarray
) -> list[shapely.LineString]:
    """The segments on the ground, at their nominal places in the scene."""
    ahead = np.array([0.5 * geometry.side(int(k)) for k in pairs]) * geometry.row_separation_lines
    col = (pairs + 1) * (geometry.width_px - geometry.overlap_px) + 0.5 * geometry.overlap_px
    last = np.array([geometry.lines[int(k)] for k in pairs])
    lines = (np.minimum(line, last) for line in (firsts, firsts + SEGMENT_LINES))
    at = (np.stack([col, line + ahead - mosaic.first_line], -1) for line in lines)
    ends = [lonlat_by_rpc(rpc, place) for place in at]
    return [shapely.LineString([a, b]) for a, b in zip(*ends, strict=True)]
