"""A small scene of CCD strips on the disk with true offsets, composed, for the tests of what is reported of it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from geomosaic.ccd.layout import image_space_layout
from geomosaic.ccd.model import PairOffsets, StripOffsets
from geomosaic.ccd.overlaps import StripFiles
from geomosaic.ccd.radiometry import Radiometry
from geomosaic.composition.strip_compose import PlacedStrips, StripMosaic, StripOptions, compose_strips
from geomosaic.export.offsets_csv import read_true_offsets
from geomosaic.quality.strips import StripQuality, misplacement
from geomosaic.survey.strips import StripGeometry, read_geometry
from geomosaic_simulate.strip_plan import StripPlan
from geomosaic_simulate.strips import simulate_strips


@dataclass(frozen=True)
class ComposedScene:
    """All that the report is made of."""

    geometry: StripGeometry
    offsets: StripOffsets
    quality: StripQuality
    radiometry: Radiometry
    mosaic: StripMosaic
    mosaic_file: Path


def composed(folder: Path, plan: StripPlan, bump_px: float = 0.0) -> ComposedScene:
    """Clouded lines are labelled bridged, the last 300 of each pair unreliable.

    bump_px: an error of dline in lines 3072 to 3583 of pair 1.
    """
    files = simulate_strips(folder, plan, scene=False)
    geometry = read_geometry(files.geometry)
    clouds = read_clouds(files.true_clouds)
    pairs = []
    for pair, truth in read_true_offsets(files.true_offsets, geometry).items():
        n = len(truth)
        label = np.where(clouds[pair] > 0.02, 1, 0).astype(np.uint8)
        label[-300:] = 2
        sd = np.choose(label, [0.03, 0.2, 1.0])
        dline = truth[:, 1].copy()
        if pair == 1:
            dline[3072:3584] += bump_px
        pairs.append(PairOffsets(pair, truth[:, 0], dline, sd, 1.5 * sd, label))
        assert len(label) == n
    offsets = StripOffsets("joint", tuple(pairs))
    with StripFiles(geometry) as strips:
        quality = misplacement(strips, offsets, lambda done, total: None)
    gains = np.linspace(0.97, 1.03, plan.ccds)
    radiometry = Radiometry(gains, np.linspace(-2.0, 2.0, plan.ccds))
    layout = image_space_layout(geometry, offsets, "all")
    path = folder / "mosaic.tif"
    mosaic = compose_strips(PlacedStrips(geometry, layout, radiometry), path, StripOptions(threads=1))
    return ComposedScene(geometry, offsets, quality, radiometry, mosaic, path)


def read_clouds(path: Path) -> dict[int, np.ndarray]:
    """The larger of both shares of cloud, by pair, for every line."""
    table = np.loadtxt(path, delimiter=",", skiprows=1)
    return {int(k): table[table[:, 0] == k, 2:].max(axis=1) for k in np.unique(table[:, 0])}
