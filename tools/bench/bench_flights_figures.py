"""The figures of a flight: from its run folder, and against check points that the run did not get."""

from __future__ import annotations

import json
import subprocess
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import rasterio

from geomosaic.adjustment.model import Adjusted, Block
from geomosaic.adjustment.procedure.control_points import control_residuals, ground_control
from geomosaic.errors import GeomosaicError
from geomosaic.geodesy.local import LocalFrame
from geomosaic.geodesy.mapcrs import is_local
from geomosaic.matching.model import TiePoints
from geomosaic.pipeline.run_results import load_artefact, read_summary
from geomosaic.placement.graph import connected_parts
from geomosaic.placement.model import Placement
from geomosaic.projection.ground import GroundSurface
from geomosaic.quality.control import control_figures
from geomosaic.quality.figures import best_similarity
from geomosaic.survey.control import read_control
from geomosaic.survey.model import Survey
from geomosaic.survey.names import FrameNames
from tools.bench.bench_speed_measure import on_disk


def figures_of(run: Path, check_points: Path | None) -> dict[str, Any]:
    """Figures of a finished run; None for those that it does not have."""
    summary = read_summary(run)
    metrics, mosaic, frames = summary["metrics"], summary["mosaic"], summary["frames"]
    adjustment, verdict = metrics.get("adjustment", {}), summary.get("verdict") or {}
    seams, evidence = metrics.get("seams", {}), {e["name"]: e["value"] for e in verdict.get("evidence", [])}
    tied: Adjusted = load_artefact(run, summary, "adjusted", Adjusted)
    ties: TiePoints = load_artefact(run, summary, "ties", TiePoints)
    parts = connected_parts(len(tied.status), ties.frames)
    figures = {
        "frames": frames,
        "tied_share": frames["tied"] / max(frames["total"], 1),
        "parts": sum(len(part) > 1 for part in parts),
        "sigma_px": adjustment.get("sigma_px"),
        "reprojection_mean_px": adjustment.get("reprojection_mean_px"),
        "seams_px": seams.get("median_px"),
        "seams_90_px": evidence.get("worst tenth of the seams"),
        "seams_95_px": seams.get("percentile_95_px"),
        "seams_measured": [seams.get("measured"), seams.get("asked")],
        "verdict": verdict.get("grade"),
        "verdict_cause": verdict.get("cause"),
        "control": adjustment.get("control"),
        "check": adjustment.get("check"),
        "mosaic": mosaic,
        "megapixels": mosaic["width"] * mosaic["height"] / 1e6,
        "folder_over_raw": on_disk(run) / _raw_bytes(run / "mosaic.tif"),
        "trimmed_share": (summary.get("trimmed") or {}).get("share"),
        "scale_over_gnss": _scale_over_gnss(run, summary, tied),
        "stages_s": summary["timings_s"],
        "stages_mb": summary["memory_mb"],
    }
    if check_points is not None:
        figures["check"] = _check(run, summary, check_points)
    return figures


def _raw_bytes(path: Path) -> int:
    """Bytes of a raster's pixels without compression."""
    with rasterio.open(path) as raster:
        return int(raster.width * raster.height * sum(np.dtype(kind).itemsize for kind in raster.dtypes))


def _scale_over_gnss(run: Path, summary: dict[str, Any], adjusted: Adjusted) -> float | None:
    """Scale of the similarity from the positions of the survey to the adjusted ones, both in plan; None for
    fewer than three tied frames with positions."""
    placed: Placement = load_artefact(run, summary, "placement", Placement)
    survey: Survey = load_artefact(run, summary, "survey", Survey)
    known = np.array(survey.located)
    known &= np.array(adjusted.status) == "tied"
    if known.sum() < 3:
        return None
    at_m = placed.poses.positions_m[known, :2]
    return float(best_similarity(at_m, adjusted.poses.positions_m[known, :2] - at_m)[0].scale)


def figures_of_failed(geomosaic: Path, run: Path) -> dict[str, Any]:
    """Of a run that did not finish: seconds by stage and where it ended, as far as it was recorded."""
    done = subprocess.run([geomosaic, "inspect", run, "--json"], capture_output=True, check=False)
    if done.returncode:
        return {}
    found = json.loads(done.stdout)
    return {
        "stages_s": {s["id"]: s["seconds"] for s in found["stages"] if s["seconds"] is not None},
        "failed_in": found["ended"].get("in_stage"),
    }


def _check(run: Path, summary: dict[str, Any], path: Path) -> dict[str, Any]:
    """`_errors_at`, or why there are none."""
    try:
        return _errors_at(run, summary, path)
    except (GeomosaicError, np.linalg.LinAlgError) as error:
        return {"n": 0, "failed": f"{type(error).__name__}: {error}".replace(f"{path.parent}/", "")}


def _errors_at(run: Path, summary: dict[str, Any], path: Path) -> dict[str, Any]:
    """Errors at surveyed points that took no part in the run, as tied frames see them.

    Of a mosaic in a local frame: those in plan that a similarity leaves.
    """
    survey: Survey = load_artefact(run, summary, "survey", Survey)
    adjusted: Adjusted = load_artefact(run, summary, "adjusted", Adjusted)
    ground: GroundSurface = load_artefact(run, summary, "ground", GroundSurface)
    ties: TiePoints = load_artefact(run, summary, "ties", TiePoints)
    names = tuple(frame.name for frame in survey.frames)
    tied = {name for name, status in zip(names, adjusted.status, strict=True) if status == "tied"}
    points = tuple(
        replace(point, check=True, images=tuple(image for image in point.images if image[0] in tied))
        for point in read_control(path, FrameNames(names)).points
    )
    control = ground_control(replace(survey, control=points), ground)
    block = Block(names, adjusted.cameras, adjusted.poses, ground, ties, (), (), 1.0, control=control)
    found = {r.name: r for r in control_residuals(block, adjusted.poses)}
    if not found:
        return {"n": 0, "failed": "no check point lies in a tied frame"}
    if not is_local(summary["mosaic"]["crs"]):
        return asdict(control_figures(list(found.values())))
    if len(found) < 3:
        return {"n": len(found), "failed": "a similarity wants 3 check points in tied frames"}
    surveyed = [p for p in points if p.name in found]
    places = np.array([[p.lon_deg, p.lat_deg, p.height_ellipsoidal_m] for p in surveyed])
    true_m = LocalFrame(*places.mean(axis=0)).enu_from_geodetic(*places.T)[:, :2]
    at_m = np.stack([c.enu_m - found[c.name].residual_m for c in control if c.name in found])[:, :2]
    left_m = best_similarity(at_m, true_m - at_m)[1]
    return {
        "n": len(left_m),
        "after_similarity": True,
        "rmse_horizontal_m": float(np.sqrt((left_m**2).sum(axis=1).mean())),
    }
