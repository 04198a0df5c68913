"""accuracy.tif: how accurate the mosaic is, place by place."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from osgeo import gdal

from geomosaic.arrays import Floats
from geomosaic.composition.model import OutputGrid
from geomosaic.doors.gdal_failures import close, gdal_failures
from geomosaic.export.surface_heights import describe_bands, reference_of
from geomosaic.quality.accuracy_grid import AccuracyBlock

BANDS: Final = (
    ("horizontal standard deviation (root of the mean of the variances east and north)", "m"),
    ("vertical standard deviation (NaN without a surface)", "m"),
    ("source of the height: 1 tie surface, 2 matched, 3 filled, 4 extrapolated", ""),
)
_MEANING: Final = (
    "1 sigma of a pixel's ground position: pose covariance of its frame, lens included as far as poses "
    "absorb it, and height deviation times the tangent of the view"
)
_OPTIONS: Final = ["TILED=YES", "BLOCKXSIZE=256", "BLOCKYSIZE=256", "BIGTIFF=IF_SAFER"]
_SAMPLED: Final = 4096
"""Values of a block for the quantiles: 100 million cells are 6 million values."""


@dataclass
class _Statistics:
    """Of a band's known values."""

    number: int = 0
    least: float = np.inf
    most: float = -np.inf
    total: float = 0.0
    squares: float = 0.0

    def add(self, values: Floats) -> None:
        if values.size:
            self.number += values.size
            self.least, self.most = min(self.least, values.min()), max(self.most, values.max())
            self.total += values.sum()
            self.squares += np.square(values).sum()

    def write(self, band: Any) -> None:
        """Into the band's metadata; of nothing nothing."""
        if self.number:
            mean = self.total / self.number
            sd = np.sqrt(max(self.squares / self.number - mean**2, 0.0))
            figures = {"MINIMUM": self.least, "MAXIMUM": self.most, "MEAN": mean, "STDDEV": sd}
            for name, value in figures.items():
                band.SetMetadataItem(f"STATISTICS_{name}", f"{value:.10g}")


@dataclass(frozen=True)
class AccuracySummary:
    """Median and 95 % of the deviations in m, NaN where none is known, and the share of the mosaic's cells by
    `HeightSource`."""

    horizontal_m: tuple[float, float]
    vertical_m: tuple[float, float]
    shares: dict[int, float]


def write_accuracy(path: Path, grid: OutputGrid, blocks: Iterable[AccuracyBlock]) -> AccuracySummary:
    """Writes blocks as a plain raster of `BANDS` with statistics.

    Raises: `OSError` if it can't be written.
    """
    found, counted = [_Statistics() for _ in BANDS], np.zeros(5, dtype=np.int64)
    samples: list[list[Floats]] = [[], []]
    with gdal_failures(path):
        dataset = _created(path, grid)
        for block in blocks:
            for k, values in enumerate((block.horizontal_m, block.vertical_m, block.source)):
                dataset.GetRasterBand(k + 1).WriteArray(values, block.col, block.row)
                known = values[np.isfinite(values)].astype(np.float64)
                found[k].add(known)
                if k < len(samples):
                    samples[k].append(known[:: max(1, known.size // _SAMPLED)])
                else:
                    counted += np.bincount(known.astype(np.intp), minlength=len(counted))
        for k, statistics in enumerate(found):
            statistics.write(dataset.GetRasterBand(k + 1))
        close(dataset)
    horizontal, vertical = (_quantiles(np.concatenate([np.zeros(0), *some])) for some in samples)
    shares = counted / max(int(counted.sum()), 1)
    return AccuracySummary(horizontal, vertical, {k: float(shares[k]) for k in range(1, len(shares))})


def _quantiles(values: Floats) -> tuple[float, float]:
    if not values.size:
        return float("nan"), float("nan")
    median, most = np.quantile(values, [0.5, 0.95]).tolist()
    return median, most


def _created(path: Path, grid: OutputGrid) -> Any:
    size = grid.width_px, grid.height_px, len(BANDS)
    dataset = gdal.GetDriverByName("GTiff").Create(str(path), *size, gdal.GDT_Float32, _OPTIONS)
    dataset.SetSpatialRef(reference_of(grid.crs))
    dataset.SetGeoTransform(grid.geotransform)
    dataset.SetMetadataItem("ACCURACY", _MEANING)
    describe_bands(dataset, BANDS, float("nan"))
    return dataset
