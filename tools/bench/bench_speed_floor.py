"""The floor of a mosaic's time: what nobody spares who makes one with the same libraries.

    python -m tools.bench.bench_speed_floor RUN OUT.tif [--threads 2]

RUN is a finished run of the same frames: poses, cameras, ground and grid come from it, so that neither
matching, adjustment, tones, seams nor blending is in the floor. Every frame is read and decoded once, at full
size. All of its pixels are warped once onto the mosaic's grid, cubic, by the plane transform that fits its
pose best (cv2.warpPerspective). Distortion and relief, which take longer, are left out. The result is put
over the frames before it, in memory. Then GDAL writes one COG from there with the product's options: mask,
blocks of 512 px, DEFLATE of level 3 with predictor, overviews by averages. Frames are worked on by as many
threads as there are cores, GDAL compresses by as many. Prints JSON: seconds of both parts, and in all, from
the first byte read.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from osgeo import gdal

from geomosaic.adjustment.model import Adjusted
from geomosaic.composition.model import Mosaic, OutputGrid
from geomosaic.geodesy.mapcrs import MapProjection
from geomosaic.pipeline.run_results import load_artefact, read_summary
from geomosaic.projection.footprint import ground_from_image
from geomosaic.projection.ground import GroundSurface
from geomosaic.survey.model import Survey

gdal.UseExceptions()
Bytes = NDArray[np.uint8]
OPTIONS = ["COMPRESS=DEFLATE", "PREDICTOR=YES", "LEVEL=3", "BLOCKSIZE=512", "BIGTIFF=IF_SAFER",
           "OVERVIEW_RESAMPLING=AVERAGE"]  # fmt: skip
SAMPLES = 9


def solved(run: Path) -> tuple[Survey, Adjusted, GroundSurface, OutputGrid]:
    """What a finished run says of its frames."""
    run_summary = read_summary(run)
    return (
        load_artefact(run, run_summary, "survey", Survey),
        load_artefact(run, run_summary, "adjusted", Adjusted),
        load_artefact(run, run_summary, "ground", GroundSurface),
        load_artefact(run, run_summary, "mosaic", Mosaic).grid,
    )


def plane(
    survey: Survey, adjusted: Adjusted, ground: GroundSurface, grid: OutputGrid, i: int
) -> NDArray[np.float64]:
    """Mosaic cols and rows from a frame's (3, 3), with corner origin: the best over the frame."""
    camera, t = adjusted.cameras[i], np.linspace(0.0, 1.0, SAMPLES)
    image = np.stack(np.meshgrid(t * camera.width_px, t * camera.height_px), axis=-1).reshape(-1, 2)
    at = ground_from_image(adjusted.poses[i], camera, ground, image)
    seen = np.isfinite(at).all(axis=1)
    geodetic = survey.work_frame.geodetic_from_enu(at[seen])
    on_map = MapProjection(grid.crs).map_from_geodetic(geodetic[:, 0], geodetic[:, 1])
    pixel = (on_map - [grid.west_m, grid.north_m]) / [grid.gsd_m, -grid.gsd_m]
    return np.asarray(cv2.findHomography(image[seen], pixel)[0], dtype=np.float64)


def warped(path: str, to_mosaic: NDArray[np.float64], grid: OutputGrid) -> tuple[int, int, Bytes, Bytes]:
    """A frame's col and row in the mosaic, its pixels there (h, w, 3), and 255 where they are."""
    frame = cv2.imread(path, cv2.IMREAD_COLOR_RGB | cv2.IMREAD_IGNORE_ORIENTATION)
    height, width = frame.shape[:2]
    corners = np.array([[[0, 0]], [[width, 0]], [[width, height]], [[0, height]]], dtype=np.float64)
    outline = cv2.perspectiveTransform(corners, to_mosaic)[:, 0]
    left, top = np.maximum(np.floor(outline.min(axis=0)).astype(int), 0)
    right, bottom = np.minimum(np.ceil(outline.max(axis=0)).astype(int), (grid.width_px, grid.height_px))
    half, back = np.eye(3), np.eye(3)
    half[:2, 2], back[:2, 2] = 0.5, (-left - 0.5, -top - 0.5)  # cv2 counts from the first pixel's middle
    size = int(right - left), int(bottom - top)
    pixels = cv2.warpPerspective(frame, back @ to_mosaic @ half, size, flags=cv2.INTER_CUBIC)
    valid = np.zeros(size[::-1], np.uint8)
    cv2.fillConvexPoly(valid, np.rint(outline - [left, top]).astype(np.int32), 255)
    return int(left), int(top), pixels, valid


def paste(run: Path, threads: int) -> tuple[OutputGrid, Bytes, Bytes]:
    """All frames in use, one over the other: the mosaic (rows, cols, 3), and 255 where there is any."""
    survey, adjusted, ground, grid = solved(run)
    mosaic = np.zeros((grid.height_px, grid.width_px, 3), np.uint8)
    mask = np.zeros((grid.height_px, grid.width_px), np.uint8)
    used = [i for i, status in enumerate(adjusted.status) if status != "rejected"]

    def one(i: int) -> tuple[int, int, Bytes, Bytes]:
        return warped(survey.frames[i].path, plane(survey, adjusted, ground, grid, i), grid)

    with ThreadPoolExecutor(threads) as pool:
        waiting = [pool.submit(one, i) for i in used[: 2 * threads]]
        for k in range(len(used)):
            col, row, pixels, valid = waiting.pop(0).result()
            if k + 2 * threads < len(used):
                waiting.append(pool.submit(one, used[k + 2 * threads]))
            at = np.s_[row : row + valid.shape[0], col : col + valid.shape[1]]
            cv2.copyTo(pixels, valid, mosaic[at])
            np.maximum(mask[at], valid, out=mask[at])
    return grid, mosaic, mask


def write(grid: OutputGrid, mosaic: Bytes, mask: Bytes, out: Path, threads: int) -> None:
    """One COG, by GDAL, from memory."""
    rows, cols, bands = mosaic.shape
    place = f"DATAPOINTER={mosaic.ctypes.data},PIXELS={cols},LINES={rows},BANDS={bands},DATATYPE=Byte"
    source: Any = gdal.Open(f"MEM:::{place},PIXELOFFSET={bands},LINEOFFSET={bands * cols},BANDOFFSET=1")
    source.SetProjection(gdal_wkt(grid.crs))
    source.SetGeoTransform(grid.geotransform)
    source.CreateMaskBand(gdal.GMF_PER_DATASET)
    source.GetRasterBand(1).GetMaskBand().WriteArray(mask)
    gdal.SetCacheMax(256 << 20)
    gdal.Translate(
        str(out), source, format="COG", creationOptions=[*OPTIONS, f"NUM_THREADS={threads}"]
    ).FlushCache()


def gdal_wkt(crs: str) -> str:
    """A CRS by its code as GDAL takes it."""
    from osgeo import osr

    reference = osr.SpatialReference()
    reference.SetFromUserInput(crs)
    return str(reference.ExportToWkt())


def main() -> None:
    """Prints seconds as JSON."""
    ask = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    ask.add_argument("run", type=Path)
    ask.add_argument("out", type=Path)
    ask.add_argument("--threads", type=int, default=os.cpu_count() or 2)
    asked = ask.parse_args()
    cv2.setNumThreads(1)
    begun = time.perf_counter()
    grid, mosaic, mask = paste(asked.run, asked.threads)
    pasted = time.perf_counter()
    write(grid, mosaic, mask, asked.out, asked.threads)
    ended = time.perf_counter()
    reported = {"warp_s": pasted - begun, "cog_s": ended - pasted, "whole_s": ended - begun}
    print(json.dumps({name: round(value, 3) for name, value in reported.items()}))


if __name__ == "__main__":
    main()
