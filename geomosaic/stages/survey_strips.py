"""The front door for CCD strips: a geometry file and the strips it names."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rasterio import Env

from geomosaic.ccd.parallel import each
from geomosaic.doors.raster import READ_CACHE_BYTES, STRIP, open_raster, reading, unreferenced_is_fine
from geomosaic.errors import InputError
from geomosaic.pipeline.function_stage import stage
from geomosaic.pipeline.params import file_values
from geomosaic.pipeline.stage import Context, StageParams, param
from geomosaic.recording.file.thumbnail import thumbnail
from geomosaic.survey.strip_model import model_tables
from geomosaic.survey.strip_pixels import GreyScale, grey_scale, measured, signed_scale
from geomosaic.survey.strips import StripGeometry, read_geometry

_THUMBNAIL_LINES = 600


class StripParams(StageParams):
    """See each parameter's help."""

    geometry: Path = param(help="GEOMETRY.yaml: the CCDs' strips, rows and overlaps")


def _check(params: StripParams) -> None:
    """The geometry, every strip's header, and the other named files."""
    read_geometry(params.geometry)


def _files(params: StripParams) -> dict[str, Path]:
    """The geometry and all files it names, the model's tables too."""
    geometry = read_geometry(params.geometry)
    named = {f"ccd{k}": ccd.path for k, ccd in enumerate(geometry.ccds, 1)}
    named |= {"dem": geometry.dem, "rpc": geometry.rpc, "model": geometry.model}
    if geometry.model is not None:
        named |= {f"model.{name}": path for name, path in model_tables(geometry.model).items()}
    return file_values(params) | {name: path for name, path in named.items() if path is not None}


@stage(
    "survey.strips", "Read the strips' geometry", group="Survey", version=3, outputs="strips", check=_check,
    files=_files,
)  # fmt: skip
def survey_strips(params: StripParams, context: Context) -> StripGeometry:
    """Reads the focal plane's geometry and holds it against the strips; reads headers only."""
    geometry = read_geometry(params.geometry)
    if geometry.dem is not None and geometry.model is None:
        text = (
            "is not used, because only a rigorous model places the strips on it; give 'model' in "
            "the geometry file"
        )
        context.warn("dem-unused", geometry.dem.name, text)
    longest = max(geometry.lines)
    for k, (ccd, lines) in enumerate(zip(geometry.ccds, geometry.lines, strict=True), 1):
        if ccd.path is None:
            text = "has no strip, so its columns of the scene stay empty: nothing to do if it is dead, else "
            text += "give its 'path' in the geometry file"
            context.warn("ccd-missing", f"CCD {k}", text)
            continue
        if lines < longest:
            text = f"has {lines} lines, the longest strip {longest}; the rest of its columns stays empty: "
            text += "give the whole strip"
            context.warn("strip-short", ccd.path.name, text)
    paths = [ccd.path for ccd in geometry.ccds if ccd.path is not None]
    with unreferenced_is_fine(), Env(GDAL_CACHEMAX=READ_CACHE_BYTES):
        seen = each(_glance, paths)
    context.check_cancelled()
    for path, image in zip(paths, seen, strict=True):
        context.recorder.image("/strips", path.name, thumbnail(image))
    scale = _scale(geometry, dict(zip(paths, seen, strict=True)))
    if scale is None:
        return geometry
    line = f"{scale.offset:.6g} + {scale.scale:.6g} g"
    context.inform(f"strips of {seen[0].dtype} are read as greys: grey g stands for the value {line}")
    context.metric("strips.scale", {"offset": scale.offset, "scale": scale.scale})
    return replace(geometry, scale=scale, nodata=0.0, bit_depth=scale.highest.bit_length())


def _scale(geometry: StripGeometry, seen: dict[Path, NDArray[Any]]) -> GreyScale | None:
    """By which float32 and negative values are read as greys, None where the pixels are greys.

    Args: seen: a sample (rows, cols) of each strip.
    Raises: `InputError` for values that exceed the bit depth.
    """
    nodata, bits = geometry.nodata, geometry.bit_depth
    if all(sample.dtype == np.float32 for sample in seen.values()):
        return grey_scale(list(seen.values()), nodata, bits)
    lowest = 0
    for path, sample in seen.items():
        values = sample[measured(sample, nodata)].astype(int)
        highest = int(values.max(initial=0))
        if highest > 2**bits - 1:
            raise InputError(
                f"has values of {highest}, but bit_depth is {bits}, so all above {2**bits - 1} would be cut",
                file=path,
                fix=f"leave bit_depth out, or give nodata: {highest} if that marks missing pixels",
            )
        lowest = min(lowest, int(values.min(initial=0)))
    return signed_scale(nodata, bits) if lowest < 0 else None


def _glance(path: Path) -> Any:
    """A strip at a fraction of its size."""
    with open_raster(path, STRIP) as strip, reading(path):
        reduction = max(1, strip.height // _THUMBNAIL_LINES)
        return strip.read(1, out_shape=(-(-strip.height // reduction), -(-strip.width // reduction)))
