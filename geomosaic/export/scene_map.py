"""A scene of CCD strips on a map: by its RPC on a DEM, or at the RPC's middle height without one."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from osgeo import gdal
from pyproj import CRS

from geomosaic.camera.rpc import Rpc
from geomosaic.ccd.outlines import lonlat_by_rpc
from geomosaic.constants import tuned
from geomosaic.doors.gdal_failures import GdalProgress, Progress, close, gdal_failures, gdal_options
from geomosaic.doors.raster import DEM, OWN, open_raster, open_with_osgeo
from geomosaic.doors.scratch import scratch_folder
from geomosaic.errors import InputError
from geomosaic.export.cog import CogOptions, write_cog
from geomosaic.geodesy.heights import raster_unit_m
from geomosaic.geodesy.mapcrs import map_crs, utm_crs
from geomosaic.survey.model import ElevationModel
from geomosaic.survey.strip_heights import DemHeights, read_dem_heights

RESAMPLING: Final = {"nearest": "near", "bilinear": "bilinear", "cubic": "cubic", "lanczos": "lanczos"}
_OFF_PX = tuned(0.02, "px", "of GDAL's approximation, a tenth of what greys show: less takes time")
_SAMPLES = tuned(33, "places a side", "of a scene, to measure its DEM's coverage: good to 0.1 %")


def scene_rpc_of(scene: Path) -> Rpc | None:
    """The RPC that a scene's file holds."""
    with open_raster(scene, OWN) as tiff:
        tags = tiff.tags(ns="RPC")
    return Rpc.from_metadata(tags) if tags else None


def ground_under(dem: Path, scene: Path, rpc: Rpc) -> DemHeights:
    """A DEM's heights under a scene, with their datum. Raises: as `read_dem_heights`."""
    with open_raster(scene, OWN) as tiff:
        cols, rows = np.linspace(0.0, tiff.width, _SAMPLES), np.linspace(0.0, tiff.height, _SAMPLES)
    at = np.stack(np.meshgrid(cols, rows), axis=-1).reshape(-1, 2)
    return read_dem_heights(dem, lonlat_by_rpc(rpc, at))


@dataclass(frozen=True)
class SceneMapOptions:
    """How a scene is projected onto a map: its pixel; crs: `auto` is the UTM zone of the scene's middle;
    threads: at work."""

    gsd_m: float
    crs: str = "auto"
    resampling: str = "cubic"
    threads: int = 2


def write_scene_map(
    scene: Path,
    out: Path,
    options: SceneMapOptions,
    elevation: ElevationModel | None = None,
    progress: Progress | None = None,
) -> None:
    """Writes a COG with a mask, its corner at whole multiples of its pixel, by the scene's RPC.

    elevation: the ground, outside of which the RPC's middle height counts.
    Raises: `InputError` for a CRS that is no map or a scene without an RPC; `OSError` if it can't be
    written.
    """
    rpc = check_rpc_there(scene_rpc_of(scene), scene)
    _, _, lat_deg, lon_deg, height_m = rpc.offset.tolist()
    target = map_crs(utm_crs(lon_deg, lat_deg) if options.crs == "auto" else options.crs).to_wkt()
    ground = [f"RPC_HEIGHT={height_m:.3f}"]
    if elevation is not None:
        scale_m, offset_m = _heights_of_values(elevation)
        ground = [
            f"RPC_DEM={elevation.path}",
            f"RPC_HEIGHT={offset_m:.3f}",
            f"RPC_HEIGHT_SCALE={scale_m:.12g}",
            f"RPC_DEM_MISSING_VALUE={(height_m - offset_m) / scale_m:.3f}",
            "RPC_DEM_APPLY_VDATUM_SHIFT=FALSE",
        ]
    callback = GdalProgress(progress)
    with (
        scratch_folder(out.parent) as scratch,
        callback.reraise(),
        gdal_failures(out),
        gdal_options({"GDAL_TIFF_INTERNAL_MASK": "YES"}),
    ):
        warped, raster = Path(scratch) / "warped.vrt", Path(scratch) / "raster.tif"
        source = open_with_osgeo(scene, OWN)
        bands = source.RasterCount
        close(
            gdal.Warp(
                str(warped), source, format="VRT", dstSRS=target, xRes=options.gsd_m, yRes=options.gsd_m,
                targetAlignedPixels=True, dstAlpha=True, rpc=True, transformerOptions=ground,
                errorThreshold=_OFF_PX, resampleAlg=RESAMPLING[options.resampling],
            )
        )  # fmt: skip
        creation = ["TILED=YES", "BLOCKXSIZE=512", "BLOCKYSIZE=512", "COMPRESS=DEFLATE", "ZLEVEL=1",
                    "BIGTIFF=IF_SAFER", f"NUM_THREADS={options.threads}"]  # fmt: skip
        close(
            gdal.Translate(
                str(raster), str(warped), format="GTiff", bandList=[*range(1, bands + 1)],
                maskBand=str(bands + 1), creationOptions=creation, callback=callback,
            )
        )  # fmt: skip
        write_cog(raster, out, CogOptions(threads=options.threads))


def _heights_of_values(elevation: ElevationModel) -> tuple[float, float]:
    """Scale and offset (m) from a DEM's stored values, which GDAL's RPC takes, to ellipsoidal heights."""
    with open_raster(Path(elevation.path), DEM) as dem:
        metres = raster_unit_m(dem.units[0], CRS.from_wkt(dem.crs.to_wkt()))
        return metres * dem.scales[0], metres * dem.offsets[0] + elevation.offset_m


def check_rpc_there(rpc: Rpc | None, scene: Path) -> Rpc:
    """`InputError` for a scene that nothing lays on a map."""
    if rpc is None:
        fix = "give 'model' or 'rpc' in the geometry file and run the recipe again"
        raise InputError("has neither a model nor an RPC", file=scene, fix=fix)
    return rpc
