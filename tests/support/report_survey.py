"""A survey of made-up numbers with real geometry, for the report's tests."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from quality_images import eight_bits, moved, texture, write_tif

from geomosaic.adjustment.kernels.interior import INTERIOR
from geomosaic.adjustment.model import Adjusted, ControlResidual, Round, SharedUnknowns
from geomosaic.camera.exterior import Poses
from geomosaic.camera.interior import Camera
from geomosaic.camera.rotation import Rotation
from geomosaic.composition.model import Mosaic, OutputGrid
from geomosaic.geodesy.local import LocalFrame
from geomosaic.matching.model import TiePair, TiePoints
from geomosaic.placement.model import Placement
from geomosaic.projection.ground import flat_ground
from geomosaic.quality.accuracy import AbsoluteAccuracy, Accuracy, RelativeAccuracy, Requirement
from geomosaic.quality.compare import compare
from geomosaic.quality.compared_block import ComparisonOptions
from geomosaic.quality.criteria import CRITERIA
from geomosaic.quality.seam_check import SeamCheck
from geomosaic.quality.verdict import Evidence, Verdict
from geomosaic.report.frame_layers import map_footprints_m
from geomosaic.survey.model import Attitude, ControlPoint, Frame, Position, Survey

CAMERA = Camera("v1.0 dji fc300s", 1000, 750, 1000.0, 497.5, 380.0, k1=-0.0123, focal_length_sd_px=10.0)
WORK = LocalFrame(11.5, 48.1, 520.0)
HOSTILE = "<img src=x onerror=alert(1)>&.jpg"


def made_up_run(
    folder: Path, lines: int = 3, per_line: int = 4, *, with_comparison: bool = True, ties_per_pair: int = 40
) -> dict[str, Any]:
    """Everything `render_report` takes."""
    rng = np.random.default_rng(42)
    n = lines * per_line
    number = np.arange(n)
    line, along = number // per_line, number % per_line
    along = np.where(line % 2 == 0, along, per_line - 1 - along)
    true = np.stack([along * 30.0, line * 50.0, np.full(n, 100.0)], axis=-1)
    true -= [per_line * 15.0, lines * 25.0, 0.0]
    yaw = np.radians(np.where(line % 2 == 0, 90.0, 270.0))
    turned = Rotation.from_yaw_pitch_roll(yaw, 0.0, 0.0).matrix
    noisy = Rotation.from_yaw_pitch_roll(
        yaw + np.radians(rng.normal(0, 1.0, n)), np.radians(rng.normal(0, 0.3, n)), 0.0
    ).matrix
    sd = np.tile([1.5, 1.5, 2.0], (n, 1))
    prior = Poses(true + rng.normal(0, 1.5, (n, 3)), noisy, sd, np.full((n, 3), 0.01))
    after = Poses(true + rng.normal(0, 0.05, (n, 3)), turned, sd / 20, np.full((n, 3), 0.001))
    ground = flat_ground(WORK, 520.0, 2000.0)
    names = tuple(HOSTILE if i == 1 else f"DJI_{i + 1:04d}.JPG" for i in number)
    frames = tuple(
        Frame(
            name, f"/survey/{name}", 1000, 750, 3, "uint8", CAMERA.name,
            Position(11.5, 48.1, 620.0, 100.0, 1.5, 1.5, 2.0, "EXIF"),
            Attitude(0.0, 0.0, 0.0, 1.0, 0.3, "XMP"), time_s=1_718_003_000.0 + 2.0 * i,
        )
        for i, name in enumerate(names)
    )  # fmt: skip
    survey = Survey(frames, (CAMERA,), WORK, "EPSG:32632")
    near = [
        (i, j) for i in range(n) for j in range(i + 1, min(n, i + 2 * per_line))
        if np.abs(true[i] - true[j])[0] < 35.0 and np.abs(true[i] - true[j])[1] < 55.0 and n - 1 not in (i, j)
    ]  # fmt: skip
    pairs, residuals = [], []
    for i, j in near:
        px = rng.uniform([0.0, 0.0], [1000.0, 750.0], (ties_per_pair, 2))
        feature = np.arange(ties_per_pair, dtype=np.int32)
        pairs.append(TiePair(i, j, px, px, feature, feature))
        residuals.append(rng.normal(0, 0.04, (ties_per_pair, 2)))
    start = rng.normal(0, 2.0, (len(near), 2))
    rounds = tuple(Round(start * 0.55**k, rng.normal(0, 0.55**k, (n, 2))) for k in range(8))
    status = tuple("placed" if i == n - 1 else "tied" for i in number)
    adjusted = Adjusted(after, (CAMERA,) * n, status, rounds, tuple(residuals), ground)
    placement = Placement(prior, tuple(map(int, number)), tuple(map(int, line)), tuple(near), 0.1, "rigorous")
    ties = TiePoints(tuple(pairs), ((0, n - 1),))
    outline = np.concatenate(map_footprints_m(survey, adjusted, np.ones(n, dtype=bool)))
    grid, file, comparison = _mosaic(folder, outline, with_comparison)
    summary = {
        "frames": {"total": n, "tied": n - 1, "placed": 1, "rejected": 0},
        "warnings": [
            {"code": "no-tie-points", "frame": names[-1], "text": "no tie points with other frames"},
            {"code": "turned-frame", "frame": HOSTILE, "text": "its pixels were turned by 180 degrees <b>"},
        ],
        "timings_s": {"survey.read": 0.41, "matching.sift": 9.73, "adjustment.solve": 0.87},
        "peak_memory_mb": 512.3,
        "metrics": {"adjustment": {"method": "error_sharing", "rounds": 8}},
        "recipe": {"name": "error sharing", "stages": [{"stage": "survey.read"}]},
        "versions": {"geomosaic": "0.1.0", "gdal": "3.6.2"},
    }
    return {
        "survey": survey, "placement": placement, "ties": ties, "adjusted": adjusted,
        "mosaic": Mosaic(grid, "work/raster.tif", 3, "uint8", None, (), tuple(map(int, number)), n),
        "mosaic_file": file, "summary": summary, "comparison": comparison,
    }  # fmt: skip


def with_points(run: dict[str, Any]) -> dict[str, Any]:
    """The same run with ten control and eight check points, one of each a blunder, all that a verdict can
    state, and every number that frames can share."""
    rng = np.random.default_rng(7)
    points, residuals = [], []
    for i in range(18):
        check, at = i >= 10, np.array([*rng.uniform(-50.0, 50.0, 2), 0.0])
        lon, lat, height = WORK.geodetic_from_enu(at[None])[0]
        name = HOSTILE if i == 12 else f"{'CHK' if check else 'GCP'}-{i:02d}"
        points.append(ControlPoint(name, lon, lat, height, 0.01, 0.02, check, (), plan_only=i == 11))
        off_m = rng.normal(0.0, [0.02, 0.03, 0.05]) + np.array([1.5, -0.8, 0.0]) * (i in (3, 15))
        sd_m = np.array([0.03, 0.03, 1e9 if i == 11 else 0.05])
        residuals.append(ControlResidual(name, check, 3, off_m, sd_m, np.full(3, 0.01)))
    adjusted = replace(run["adjusted"], control=tuple(residuals), shared=_shared())
    seams = SeamCheck(
        np.array([0, 1, 2]), np.array([1, 2, 3]), np.tile([686_100.0, 5_330_400.0], (3, 1)),
        np.full(3, 4), np.array([[0.3, 0.2], [1.0, -4.0], [np.nan, np.nan]]),
    )  # fmt: skip
    evidence = [Evidence(name, 0.4, c.unit, "good") for name, c in CRITERIA.items()]
    evidence += [
        Evidence(f"{kind} accuracy", 0.06, "m RMSE", "doubtful", "the requirement is missed", "--gcp")
        for kind in ("absolute", "vertical", "relative")
    ]
    shift_m, scatter_m = np.array([0.01, -0.02, 0.0]), np.array([0.02, 0.03, 0.05])
    accuracy = Accuracy(
        AbsoluteAccuracy(0.041, 0.052, "measured", 7, shift_m, scatter_m),
        RelativeAccuracy(0.21, 0.02, 0.03, 160.0),
    )
    required = Requirement(0.03, 0.1, 3.0, "as asked for", 0.3)
    verdict = Verdict(
        "doubtful", "11 of 12 frames tied", "the requirement is missed", "use --gcp", tuple(evidence),
        accuracy, required, seams, (),
    )  # fmt: skip
    survey = replace(run["survey"], control=tuple(points))
    return {**run, "survey": survey, "adjusted": adjusted, "verdict": verdict}


def _shared() -> SharedUnknowns:
    """Every number that frames can share, by the names that the adjustment gives them."""
    platform = ("boresight_roll_deg", "lever_arm_down_m", "offset_east_m", "gps_lag_s")
    names = (*INTERIOR, *platform)
    of = ("lens",) * len(INTERIOR) + ("platform",) * len(platform)
    one = np.ones(len(names))
    return SharedUnknowns(of, names, one, 1.1 * one, 0.1 * one, np.eye(len(names)), one < 0.0)


def _mosaic(folder: Path, outline_m: Any, with_comparison: bool) -> tuple[OutputGrid, Path, Any]:
    low, high = outline_m.min(axis=0), outline_m.max(axis=0)
    gsd = max(0.1, float((high - low).max()) / 1200.0)
    cols, rows = (int(v) + 1 for v in (high - low) / gsd)
    base = texture(rows, cols, seed=31, slope=1.5)
    west, north = float(np.floor(low[0])), float(np.ceil(high[1]))
    valid = np.ones((rows, cols), dtype=bool)
    valid[: rows // 10, : cols // 4] = False
    split = np.where(np.arange(cols) < cols // 2, moved(base, 0.4, 1.1), moved(base, -0.3, 1.9))
    colour = np.concatenate([eight_bits(split * k) for k in (1.0, 0.95, 0.8)])
    file = write_tif(folder / "mosaic.tif", colour, west, north, gsd, valid=valid)
    truth = write_tif(folder / "ortho <true>.tif", eight_bits(base), west, north, gsd)
    comparison = compare(file, truth, ComparisonOptions(search_px=16)) if with_comparison else None
    return OutputGrid("EPSG:32632", west, north, gsd, cols, rows), file, comparison
