"""What a CCD makes of light: gain, offset, unequal columns, noise, whole counts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geomosaic.arrays import Floats32
from geomosaic_simulate.strip_plan import StripPlan


@dataclass(frozen=True, eq=False)
class CcdSensor:
    """One CCD: counts = gain * column[col] * brightness * full + offset + noise, cut to 0 ... full.

    gain and column (width_px,) without unit, offset in counts. Noise is of photons: its variance grows with
    the light, and is (brightness * full / snr)² at the plan's mean brightness.
    """

    plan: StripPlan
    ccd: int
    gain: float
    offset: float
    column: Floats32

    @classmethod
    def of(cls, plan: StripPlan, ccd: int) -> CcdSensor:
        """The CCD that the plan's seed makes."""
        rng = np.random.default_rng([plan.seed, 51, ccd])
        gain, offset = rng.standard_normal(2) * [plan.gain_sd, plan.offset_sd * cls.full_of(plan)]
        column = 1.0 + plan.column_sd * rng.standard_normal(plan.width_px)
        return cls(plan, ccd, float(1.0 + gain), float(offset), column.astype(np.float32))

    @staticmethod
    def full_of(plan: StripPlan) -> float:
        """The highest count."""
        return float(2**plan.bit_depth - 1)

    def counts(self, brightness: Floats32, first_col: int, block: int) -> NDArray[Any]:
        """Counts (n, m) of light on the columns from first_col; noise differs from `block` to block."""
        plan, full = self.plan, self.full_of(self.plan)
        response = self.column[first_col : first_col + brightness.shape[1]] * np.float32(self.gain * full)
        signal = brightness * response
        if plan.snr > 0.0:
            rng = np.random.default_rng([plan.seed, 52, self.ccd, first_col, block])
            per_root = np.sqrt(plan.brightness * full) / plan.snr
            noise = rng.standard_normal(signal.shape, dtype=np.float32)
            signal = signal + noise * np.sqrt(signal) * np.float32(per_root)
        signal += np.float32(self.offset)
        return as_counts(signal, plan.bit_depth)


def as_counts(signal: Floats32, bit_depth: int) -> NDArray[Any]:
    """Whole counts of a bit depth: uint8 up to 8 bits, else uint16."""
    whole = np.rint(np.clip(signal, 0.0, float(2**bit_depth - 1)))
    return whole.astype(np.uint8 if bit_depth <= 8 else np.uint16)
