"""A simulated scene's files other than images' content: geometry, model, RPC, given DEM, tables of truth."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
import yaml
from numpy.typing import ArrayLike
from rasterio.errors import NotGeoreferencedWarning

from geomosaic.arrays import Floats
from geomosaic.camera.pushbroom import Pushbroom
from geomosaic.camera.rpc import fit_rpc
from geomosaic.survey.strip_model import ATTITUDE_COLUMNS, ORBIT_COLUMNS
from geomosaic.survey.strips import StripGeometry
from geomosaic_simulate.noise import spline_noise
from geomosaic_simulate.relief import RasterRelief, Relief
from geomosaic_simulate.strip_scene import PairTruth, StripWorld
from geomosaic_simulate.write import whole, write_bytes, write_csv

_RPC_NODES = (21, 31, 5)
_RPC_SPAN_M = 500.0
_SPLINE_SD = 0.137  # of spline_noise


@contextmanager
def open_whole_strip(path: Path, width_px: int, lines: int, bit_depth: int) -> Iterator[Any]:
    """A strip to write block by block, which gets its name when all is written."""
    profile = {
        "driver": "GTiff",
        "width": width_px,
        "height": lines,
        "count": 1,
        "dtype": "uint8" if bit_depth <= 8 else "uint16",
        "bigtiff": "if_safer",
        "blockysize": max(1, min(64, (1 << 19) // width_px)),
    }
    with whole(path) as part, warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        with rasterio.open(part, "w", **profile) as strip:
            yield strip


def write_geometry(path: Path, geometry: StripGeometry) -> None:
    """GEOMETRY.yaml in the folder of its strips, DEM, RPC and model."""
    ccds: list[dict[str, object]] = []
    for ccd in geometry.ccds:
        ccds.append({"row": ccd.row} if ccd.path is None else {"path": str(ccd.path), "row": ccd.row})
    entry = {
        "ground_pixel_m": geometry.ground_pixel_m,
        "line_rate_hz": geometry.line_rate_hz,
        "row_separation_lines": geometry.row_separation_lines,
        "overlap_px": geometry.overlap_px,
        "read_px": geometry.read_px,
        "width_px": geometry.width_px,
        "bit_depth": geometry.bit_depth,
        "ccds": ccds,
        "dem": "dem.tif",
        "rpc": "scene_RPC.TXT",
        "model": "model.yaml",
    }
    write_bytes(path, yaml.safe_dump(entry, sort_keys=False).encode())


def write_model(path: Path, model: Pushbroom) -> None:
    """The rigorous model as `survey.strip_model.read_model` reads it: YAML, and two tables in its folder."""
    tables = {"orbit": f"{path.stem}_orbit.csv", "attitude": f"{path.stem}_attitude.csv"}
    orbit = (
        [f"{t:.9f}", *(f"{v:.6f}" for v in xyz)] for t, xyz in _rows(model.orbit_time_s, model.orbit_ecef_m)
    )
    degrees = np.degrees(model.roll_pitch_yaw_rad)
    attitude = ([f"{t:.9f}", *(f"{v:.12f}" for v in rpy)] for t, rpy in _rows(model.attitude_time_s, degrees))
    write_csv(path.with_name(tables["orbit"]), ORBIT_COLUMNS, orbit)
    write_csv(path.with_name(tables["attitude"]), ATTITUDE_COLUMNS, attitude)
    looks = [
        {"forward_tan": [float(v) for v in ahead], "right_tan": [float(v) for v in right]}
        for ahead, right in zip(model.forward_tan, model.right_tan, strict=True)
    ]
    entry = {"line_rate_hz": model.line_rate_hz, **tables, "looks": looks}
    write_bytes(path, yaml.safe_dump(entry, sort_keys=False, default_flow_style=None, width=110).encode())


def _rows(time_s: Floats, values: Floats) -> Iterator[tuple[float, Floats]]:
    yield from zip(time_s, values, strict=True)


def write_rpc(path: Path, scene: StripWorld) -> float:
    """The RPC of the ideal scene over its heights and 500 m more each way; its worst residual in px."""
    plan, model = scene.plan, scene.cameras.ideal
    half = scene.relief.amplitude_m / 2.0 + _RPC_SPAN_M
    middle = scene.relief.base_m
    cols = np.linspace(0.0, scene.scene_width_px, _RPC_NODES[0])
    lines = np.linspace(0.0, plan.lines, _RPC_NODES[1])
    heights = np.linspace(middle - half, middle + half, _RPC_NODES[2])
    col, line, height = (a.ravel() for a in np.meshgrid(cols, lines, heights, indexing="ij"))
    ground = model.ground_from_image(0, col, line, height)
    rpc, worst = fit_rpc(ground, np.stack([col, line], axis=-1))
    write_bytes(path, rpc.text().encode())
    return worst


@dataclass(frozen=True, eq=False)
class GivenHeights:
    """The relief as the given DEM has it: a constant off, and bumps of some hundred metres' length."""

    relief: Relief | RasterRelief
    seed: int
    bias_m: float
    error_m: float

    def height_at(self, easting_m: ArrayLike, northing_m: ArrayLike) -> Floats:
        """Ellipsoidal height (m) at map coordinates of any shape."""
        true = self.relief.height_at(easting_m, northing_m)
        if self.error_m == 0.0:
            return true + self.bias_m
        x, y = (np.asarray(a, dtype=np.float64) / 400.0 for a in (easting_m, northing_m))
        bumps = (spline_noise(self.seed, 91, x, y) - 0.5) / _SPLINE_SD
        return np.asarray(true + self.bias_m + self.error_m * bumps)


def given_heights(scene: StripWorld) -> Any:
    """The heights that dem.tif holds: the truth plus `dem_bias_m` and `dem_error_m` (sd)."""
    plan = scene.plan
    return GivenHeights(scene.relief, plan.seed, plan.dem_bias_m, plan.dem_error_m)


def offset_rows(pairs: Sequence[PairTruth], clouds: bool = False) -> Iterator[list[str]]:
    """Rows of truth/offsets.csv, or of truth/clouds.csv."""
    for p in pairs:
        first, second = (p.cloud_left, p.cloud_right) if clouds else (p.dcol_px, p.dline_px)
        places = 3 if clouds else 5
        for line, (a, b) in enumerate(zip(first, second, strict=True)):
            yield [str(p.pair), str(line), f"{a:.{places}f}", f"{b:.{places}f}"]


def target_rows(scene: StripWorld) -> Iterator[list[str]]:
    """Rows of truth/targets.csv: each target's place, and where each CCD that sees it has it (CCDs from 1).

    By the rigorous model itself, not by the curves that the images were made with; camera lines.
    """
    plan, model = scene.plan, scene.cameras.true
    height = scene.relief.height_at(scene.targets_m[:, 0], scene.targets_m[:, 1])
    lonlat = scene.projection.geodetic_from_map(scene.targets_m[:, 0], scene.targets_m[:, 1])
    ground = np.column_stack([lonlat, height])
    line = plan.lines / 2.0 - scene.targets_m[:, 1] / plan.ground_pixel_m
    for ccd in range(plan.ccds):
        apart = plan.row_separation_lines * (-0.5 if plan.row(ccd) == 1 else 0.5)
        image = model.image_from_ground(ccd, ground, line + apart, plan.width_px / 2.0)
        for i, ((lon, lat, h), (col, at)) in enumerate(zip(ground, image, strict=True)):
            if 0.0 <= col <= plan.width_px and 0.0 <= at <= plan.lines:
                place = f"{lon:.11f}", f"{lat:.11f}", f"{h:.5f}"
                yield [str(i + 1), *place, str(ccd + 1), f"{col:.5f}", f"{at:.5f}"]
