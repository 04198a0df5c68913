"""`geomosaic strips` from end to end: one scene of simulated strips, and what users get wrong."""

from __future__ import annotations

import csv
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
import yaml
from small_surveys import geomosaic

from geomosaic.simulate.strip_plan import StripPlan
from geomosaic.simulate.strips import SimulatedStrips, simulate_strips

PLAN = StripPlan(
    seed=4,
    ccds=4,
    width_px=384,
    lines=3200,
    row_separation_lines=700,
    relief_m=150.0,
    dead="",
    jitter_22hz_px=0.0,
)
FINAL = {"mosaic.tif", "mosaic_RPC.TXT", "offsets.csv", "report.html", "run.json"}


@pytest.fixture(scope="session")
def scene(tmp_path_factory: pytest.TempPathFactory) -> SimulatedStrips:
    """Four strips with model, RPC, DEM and truth."""
    return simulate_strips(tmp_path_factory.mktemp("strips") / "scene", PLAN)


@pytest.fixture(scope="session")
def run(scene: SimulatedStrips, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A whole run with the defaults."""
    out = tmp_path_factory.mktemp("strips") / "run"
    assert strips(with_companions(scene, out.parent / "whole.yaml"), out) == 0
    return out


def strips(geometry: Path, run: Path, *more: object) -> int:
    return geomosaic("strips", geometry, "-o", run, *more)


def with_companions(scene: SimulatedStrips, path: Path, **more: Any) -> Path:
    """The geometry with model, RPC and DEM, and other entries, in another place."""
    entry = yaml.safe_load(scene.geometry.read_text())
    folder = scene.geometry.parent
    for ccd in entry["ccds"]:
        ccd["path"] = str(folder / ccd["path"])
    entry |= {"model": str(scene.model), "dem": str(scene.dem), **more}
    path.write_text(yaml.safe_dump({k: v for k, v in entry.items() if v is not None}))
    return path


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))
