"""The mosaic for web maps, globes and catalogues: tiles, MBTiles, PMTiles, KMZ, VRT, STAC."""

from __future__ import annotations

from functools import partial
from typing import Literal

import numpy as np

from geomosaic.ccd.outlines import Outlines
from geomosaic.errors import InputError
from geomosaic.export.packed_tiles import write_packed
from geomosaic.export.stac import coverage_of_mosaic, coverage_of_scene, stac_item, write_stac
from geomosaic.export.tile_pyramid import FORMATS
from geomosaic.export.web import TileOptions, on_map, write_kmz, write_tiles, write_vrt
from geomosaic.pipeline.function_stage import stage
from geomosaic.pipeline.stage import Context, RunFile, StageParams, param
from geomosaic.stages.input_groups import ComposedStrips, FrameMosaic

TILES, MBTILES, PMTILES = "tiles", "mosaic.mbtiles", "mosaic.pmtiles"
KMZ, VRT, ITEM = "mosaic.kmz", "mosaic.vrt", "mosaic.stac.json"


_FINEST = "finest zoom; auto: the mosaic's resolution"


class KmzParams(StageParams):
    """See each parameter's help."""

    max_zoom: int | Literal["auto"] = param("auto", help=_FINEST, ge=0, le=30)


class TilesParams(StageParams):
    """See each parameter's help."""

    format: str = param("png", help="of the tiles", choices=FORMATS)
    min_zoom: int | Literal["auto"] = param("auto", help="coarsest zoom", ge=0, le=30)
    max_zoom: int | Literal["auto"] = param("auto", help=_FINEST, ge=0, le=30)
    threads: int = param(2, help="threads at work", ge=1, le=64, affects_output=False)


class PackedTilesParams(StageParams):
    """See each parameter's help."""

    format: str = param("png", help="of the tiles", choices=FORMATS)
    max_zoom: int | Literal["auto"] = param(
        "auto", help=f"{_FINEST}, of MBTiles at most 22, where GDAL ends", ge=0, le=30
    )
    threads: int = param(2, help="threads at work", ge=1, le=64, affects_output=False)


@stage(
    "export.tiles", "Write web map tiles", group="Export", version=4, outputs="tiles_folder", results=(TILES,)
)
def export_tiles(
    mosaic_file: RunFile, params: TilesParams, context: Context, layers_file: RunFile | None = None
) -> RunFile:
    """Writes tiles/index.html, a page without network, over tiles/{z}/{x}/{y} in Web Mercator."""
    with context.writing(TILES) as folder:
        write_tiles(
            on_map(context.path_of(mosaic_file)),
            folder,
            TileOptions(
                tile_format=params.format,
                min_zoom=_zoom(params.min_zoom),
                max_zoom=_zoom(params.max_zoom),
                threads=params.threads,
            ),
            layers_file=None if layers_file is None else context.path_of(layers_file),
            progress=partial(context.progress, text=TILES),
        )
    return context.run_file(TILES)


@stage(
    "export.mbtiles", "Write MBTiles", group="Export", version=3, outputs="mbtiles_file", results=(MBTILES,)
)
def export_mbtiles(mosaic_file: RunFile, params: PackedTilesParams, context: Context) -> RunFile:
    """Writes mosaic.mbtiles: web map tiles in one file, for phones and map servers."""
    return _packed(MBTILES, mosaic_file, params, context)


@stage(
    "export.pmtiles", "Write PMTiles", group="Export", version=2, outputs="pmtiles_file", results=(PMTILES,)
)
def export_pmtiles(mosaic_file: RunFile, params: PackedTilesParams, context: Context) -> RunFile:
    """Writes mosaic.pmtiles: web map tiles in one file, for web pages without a server of maps."""
    return _packed(PMTILES, mosaic_file, params, context)


def _zoom(value: int | Literal["auto"]) -> int | None:
    return None if value == "auto" else value


def _packed(file: str, mosaic_file: RunFile, params: PackedTilesParams, context: Context) -> RunFile:
    """The tiles of export.tiles in one file, in the format of the file's extension."""
    with context.writing(file) as path:
        write_packed(
            on_map(context.path_of(mosaic_file)),
            path,
            file.rpartition(".")[2],
            TileOptions(tile_format=params.format, max_zoom=_zoom(params.max_zoom), threads=params.threads),
            progress=partial(context.progress, text=file),
        )
    return context.run_file(file)


@stage("export.kmz", "Write a KMZ", group="Export", version=2, outputs="kmz_file", results=(KMZ,))
def export_kmz(mosaic_file: RunFile, params: KmzParams, context: Context) -> RunFile:
    """Writes mosaic.kmz for Google Earth and its like, finer as one comes nearer."""
    with context.writing(KMZ) as path:
        progress = partial(context.progress, text=KMZ)
        write_kmz(on_map(context.path_of(mosaic_file)), path, _zoom(params.max_zoom), progress)
    return context.run_file(KMZ)


@stage("export.vrt", "Write a VRT", group="Export", version=1, outputs="vrt_file", results=(VRT,))
def export_vrt(mosaic_file: RunFile, context: Context) -> RunFile:
    """Writes mosaic.vrt, in which the mask is an alpha band."""
    with context.writing(VRT) as path:  # names mosaic.tif without a folder: both can be moved together
        write_vrt(context.path_of(mosaic_file), path)
    return context.run_file(VRT)


@stage(
    "export.stac", "Write a STAC item", group="Export", version=4, outputs="stac_file", results=(ITEM,),
    cached=False,
)  # fmt: skip
def export_stac(
    mosaic_file: RunFile,
    context: Context,
    frames: FrameMosaic | None = None,
    scene: ComposedStrips | None = None,
    outlines: Outlines | None = None,
) -> RunFile:
    """Writes mosaic.stac.json, a STAC item whose assets are the run's files."""
    times: list[float] = []
    if frames is not None:
        coverage = coverage_of_mosaic(frames.mosaic)
        exposed_s = [frames.survey.frames[i].time_s for i in frames.mosaic.frames_used]
        times = [time_s for time_s in exposed_s if time_s is not None]
    elif scene is not None:
        ring = np.zeros((0, 2)) if outlines is None else outlines.scene
        size_px = scene.strip_mosaic.height_px, scene.strip_mosaic.width_px
        coverage = coverage_of_scene(ring, scene.strips.ground_pixel_m, *size_px)
    else:
        raise InputError("the recipe composes no mosaic", fix="put mosaic.compose before export.stac")
    made_s = context.path_of(mosaic_file).stat().st_mtime
    item = stac_item(context.run_folder.name, coverage, times, made_s, context.run_folder)
    with context.writing(ITEM) as path:
        write_stac(path, item)
    return context.run_file(ITEM)
