"""A scene of CCD strips with known truth, written to a folder, block of lines by block of lines."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rasterio.windows import Window

from geomosaic.arrays import Ints64
from geomosaic.errors import OutputError
from geomosaic_simulate.rasters import write_heights
from geomosaic_simulate.spread import in_threads
from geomosaic_simulate.strip_files import (
    given_heights,
    offset_rows,
    open_whole_strip,
    target_rows,
    write_geometry,
    write_model,
    write_rpc,
)
from geomosaic_simulate.strip_plan import StripPlan
from geomosaic_simulate.strip_scene import IDEAL, StripWorld
from geomosaic_simulate.strip_sensor import CcdSensor, as_counts
from geomosaic_simulate.write import write_csv, write_json

Progress = Callable[[int, int, str], None]
_BLOCK_PX = 1 << 20
_BLOCK_LINES = 256
"""Lines of a block at most; noise is drawn block by block."""


@dataclass(frozen=True)
class SimulatedStrips:
    """The files of a simulated scene. `targets` is None where there are none."""

    geometry: Path
    strips: tuple[Path, ...]
    model: Path
    rpc: Path
    dem: Path
    true_offsets: Path
    true_clouds: Path
    true_scene: Path | None
    true_model: Path
    true_dem: Path
    truth: Path
    targets: Path | None

    def files(self) -> list[Path]:
        """All of them that were written, the models' tables too."""
        named = [p for p in (*dataclasses.astuple(self), *self.strips) if isinstance(p, Path)]
        tables = [t for m in (self.model, self.true_model) for t in m.parent.glob(f"{m.stem}_*.csv")]
        return sorted({*named, *tables})


def _silent(done: int, total: int, text: str) -> None:
    return None


def simulate_strips(
    out: Path, plan: StripPlan, *, scene: bool = True, progress: Progress = _silent
) -> SimulatedStrips:
    """Write a plan's strips, geometry.yaml, model, RPC and DEM, and the truth.

    `scene` False leaves out the true scene, half of the work. Layout and formats: docs/simulation.md.
    Raises: `OutputError` if the folder holds strips already or can't be written.
    """
    _check_folder(out)
    world = StripWorld(plan)
    plan = world.plan
    geometry, truth = plan.geometry(), out / "truth"
    strips = {k: out / str(ccd.path) for k, ccd in enumerate(geometry.ccds) if ccd.path is not None}
    total = sum(geometry.lines) + (plan.lines if scene else 0)
    done = 0
    for k, path in strips.items():
        with open_whole_strip(path, plan.width_px, geometry.lines[k], plan.bit_depth) as strip:
            for first, counts in in_threads(partial(_strip_block, world, k), _blocks(world, k)):
                strip.write(counts, 1, window=Window(0, first, *counts.shape[::-1]))
                done += len(counts)
                progress(done, total, path.name)
    if scene:
        _write_scene(truth / "scene.tif", world, lambda n: progress(done + n, total, "true scene"))
    write_model(out / "model.yaml", world.cameras.reported)
    write_model(truth / "model.yaml", world.cameras.true)
    write_rpc(out / "scene_RPC.TXT", world)
    crs = world.projection.crs
    write_heights(out / "dem.tif", crs, given_heights(world), world.bounds_m, plan.dem_pixel_m)
    write_heights(truth / "dem.tif", crs, world.relief, world.bounds_m, plan.dem_pixel_m)
    pairs = [world.truth(k) for k in geometry.pairs if k in strips and k + 1 in strips]
    write_csv(truth / "offsets.csv", ("pair", "line", "dcol_px", "dline_px"), offset_rows(pairs))
    clouds = ("pair", "line", "cloud_left", "cloud_right")
    write_csv(truth / "clouds.csv", clouds, offset_rows(pairs, clouds=True))
    if plan.targets:
        columns = ("target", "lon_deg", "lat_deg", "height_ellipsoidal_m", "ccd", "col_px", "line_px")
        write_csv(truth / "targets.csv", columns, target_rows(world))
    write_json(truth / "truth.json", _truth(world, pairs))
    write_geometry(out / "geometry.yaml", geometry)
    return _paths(out, plan, tuple(strips.values()), scene)


def _blocks(world: StripWorld, ccd: int) -> Iterator[tuple[int, Ints64]]:
    """First file line, and camera lines, of a CCD's blocks."""
    width = world.scene_width_px if ccd == IDEAL else world.plan.width_px
    acquired = np.arange(world.plan.lines) if ccd == IDEAL else world.plan.acquired(ccd)
    step = max(min(_BLOCK_PX // width, _BLOCK_LINES), 16)
    for first in range(0, acquired.size, step):
        yield first, acquired[first : first + step]


def _strip_block(world: StripWorld, ccd: int, at: tuple[int, Ints64]) -> tuple[int, NDArray[Any]]:
    """A block of a strip as counts; a repeated line is the same image, noise and all."""
    first, lines = at
    camera, own = np.unique(lines, return_inverse=True)
    light = world.light(world.look(ccd, (0, world.plan.width_px), camera))
    counts = CcdSensor.of(world.plan, ccd).counts(light.brightness, 0, int(camera[0]))
    return first, counts[own]


def _write_scene(path: Path, world: StripWorld, progress: Callable[[int], None]) -> None:
    """What the ideal line sees: gain 1, no noise, same bit depth, line for camera line."""
    plan, width = world.plan, world.scene_width_px

    def block(at: tuple[int, Ints64]) -> tuple[int, NDArray[Any]]:
        light = world.light(world.look(IDEAL, (0, width), at[1]))
        return at[0], as_counts(light.brightness * np.float32(CcdSensor.full_of(plan)), plan.bit_depth)

    with open_whole_strip(path, width, plan.lines, plan.bit_depth) as out:
        for first, counts in in_threads(block, _blocks(world, IDEAL)):
            out.write(counts, 1, window=Window(0, first, *counts.shape[::-1]))
            progress(first + len(counts))


def _truth(world: StripWorld, pairs: list[Any]) -> dict[str, Any]:
    plan = world.plan
    sensors = [CcdSensor.of(plan, k) for k in range(plan.ccds)]
    values = dataclasses.asdict(plan)
    return {
        "plan": {k: str(v) if isinstance(v, Path) else v for k, v in values.items()},
        "map_crs": world.projection.crs,
        "altitude_m": plan.altitude_m,
        "gain": [round(s.gain, 9) for s in sensors],
        "offset_counts": [round(s.offset, 6) for s in sensors],
        "pairs": [
            {
                "pair": p.pair,
                "dcol_px": [round(float(f(p.dcol_px)), 6) for f in (np.min, np.mean, np.max)],
                "dline_px": [round(float(f(p.dline_px)), 6) for f in (np.min, np.mean, np.max)],
                "cloudy_lines": round(float((p.cloud_left > 0.5).mean()), 6),
            }
            for p in pairs
        ],
    }


def _paths(out: Path, plan: StripPlan, strips: tuple[Path, ...], scene: bool) -> SimulatedStrips:
    truth = out / "truth"
    return SimulatedStrips(
        geometry=out / "geometry.yaml",
        strips=strips,
        model=out / "model.yaml",
        rpc=out / "scene_RPC.TXT",
        dem=out / "dem.tif",
        true_offsets=truth / "offsets.csv",
        true_clouds=truth / "clouds.csv",
        true_scene=truth / "scene.tif" if scene else None,
        true_model=truth / "model.yaml",
        true_dem=truth / "dem.tif",
        truth=truth / "truth.json",
        targets=truth / "targets.csv" if plan.targets else None,
    )


def _check_folder(out: Path) -> None:
    if (out / "geometry.yaml").exists() or list(out.glob("ccd*.tif")):
        raise OutputError("holds strips already", file=out, fix="give another folder, or empty it")
