"""Normalised errors of `bench_accuracy_raster.py` by class: of each survey, and of all with their scatter."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geomosaic.adjustment.ground_places import GroundPlaces

Floats = NDArray[np.float64]
Row = dict[str, Any]
CLASSES = {1: "tie surface", 2: "matched", 3: "filled", 4: "extrapolated"}
LIMITS = 0.8, 1.25
LEAST_CELLS = 200
"""Of a class in a survey, to be judged."""
COLUMNS = ("survey", "positions", "class", "surveys", "cells", "plan", "plan_scatter", "up", "up_scatter",
           "plan_rms_m", "local_rms_m", "plan_sd_m", "up_rms_m", "up_sd_m")  # fmt: skip
HEADINGS = ("survey", "positions", "class", "surveys", "cells", "horizontal", "±", "vertical",
            "±", "error, m", "after similarity, m", "stated, m", "error up, m", "stated up, m")  # fmt: skip


@dataclass(frozen=True)
class Errors:
    """Of places (n,) of a run, in m.

    source: class. at_m (n, 2) east, north. plan_m (n, 2), up_m: errors. plan_sd_m, up_sd_m: stated
    deviations, of heights NaN where none is stated. freedoms: see there.
    """

    source: NDArray[np.int64]
    at_m: Floats
    plan_m: Floats
    up_m: Floats
    plan_sd_m: Floats
    up_sd_m: Floats
    freedoms: tuple[float, float]


def freedoms(places: GroundPlaces | None) -> tuple[float, float]:
    """Independent errors to which those of places amount in plan and in height; 1 without a covariance.

    The mean of normalised squares scatters as chi-squared of so many degrees of freedom over their number
    (Satterthwaite 1946).
    """
    if places is None:
        return 1.0, 1.0
    up = np.arange(len(places.covariance_m2)) % 3 == 2
    found = []
    for axes in (~up, up):
        covariance = places.covariance_m2[np.ix_(axes, axes)]
        correlation = covariance / np.sqrt(np.outer(np.diag(covariance), np.diag(covariance)))
        found.append(float(len(correlation) ** 2 / np.square(correlation).sum()))
    return found[0], found[1]


def judged(name: str, positions: str, seed: int, errors: Errors) -> list[Row]:
    """The figures of each class that has enough places."""
    rows = []
    local_m = _after_similarity(errors)
    for number, label in CLASSES.items():
        of = errors.source == number
        if of.sum() < LEAST_CELLS:
            continue
        plan = np.square(errors.plan_m[of]).sum(axis=1) / 2.0
        up, stated = errors.up_m[of], errors.up_sd_m[of]
        known = np.isfinite(stated)
        rows.append(
            {
                "survey": name,
                "positions": positions,
                "seed": seed,
                "class": label,
                "cells": int(of.sum()),
                "plan": _rms(np.sqrt(plan) / errors.plan_sd_m[of]),
                "plan_scatter": float(np.sqrt(0.5 / errors.freedoms[0])),
                "plan_rms_m": _rms(np.sqrt(plan)),
                "local_rms_m": float(np.sqrt(np.square(local_m[of]).sum(axis=1).mean() / 2.0)),
                "plan_sd_m": _rms(errors.plan_sd_m[of]),
                "up": _rms(up[known] / stated[known]) if known.any() else None,
                "up_scatter": float(np.sqrt(0.5 / errors.freedoms[1])) if known.any() else None,
                "up_rms_m": _rms(up),
                "up_sd_m": _rms(stated[known]) if known.any() else None,
            }
        )
    return rows


def together(rows: Sequence[Row]) -> list[Row]:
    """Root mean squares of each class over surveys, each counted alike: of all, then by positions.

    plan_scatter, up_scatter: one deviation of them, from how the surveys' mean squares differ.
    """
    out = []
    for positions in ("all", *dict.fromkeys(row["positions"] for row in rows)):
        for label in CLASSES.values():
            mine = [r for r in rows if r["class"] == label and positions in ("all", r["positions"])]
            if mine:
                figures: Row = {"cells": sum(row["cells"] for row in mine), "surveys": len(mine)}
                for key in ("plan", "up"):
                    figures[key], figures[f"{key}_scatter"] = _pooled([r[key] for r in mine])
                out.append({"survey": "all", "positions": positions, "class": label, **figures})
    return out


def missed(pooled: Sequence[Row]) -> list[str]:
    """A line for each class of all surveys whose pooled figure lies outside `LIMITS`."""
    lines = []
    for row in pooled:
        for key, label in (("plan", "horizontal"), ("up", "vertical")):
            if row["positions"] == "all" and row[key] is not None and not LIMITS[0] <= row[key] <= LIMITS[1]:
                lines.append(f"{row['class']}, {label}: {row[key]:.2f} ± {_text(row, f'{key}_scatter')}")
    return lines


def table(rows: Sequence[Row]) -> str:
    """Markdown of rows, whose empty columns are left out."""
    shown = [k for k, name in enumerate(COLUMNS) if any(row.get(name) is not None for row in rows)]
    head = f"| {' | '.join(HEADINGS[k] for k in shown)} |\n{'|---' * len(shown)}|\n"
    return head + "".join(f"| {' | '.join(_text(row, COLUMNS[k]) for k in shown)} |\n" for row in rows)


def _text(row: Row, name: str) -> str:
    value = row.get(name)
    if name == "survey" and "seed" in row:
        return f"{value} {row['seed']}"
    digits = 3 if name.endswith("_m") else 2
    return "" if value is None else f"{value:.{digits}f}" if isinstance(value, float) else f"{value}"


def _pooled(values: Sequence[float | None]) -> tuple[float | None, float | None]:
    """Root mean square and its deviation; None where nothing, or of the deviation one value, is known."""
    squares = np.square([v for v in values if v is not None])
    if not squares.size:
        return None, None
    whole = float(np.sqrt(squares.mean()))
    if squares.size < 2:
        return whole, None
    return whole, float(squares.std(ddof=1) / np.sqrt(squares.size) / (2.0 * whole))


def _after_similarity(errors: Errors) -> Floats:
    """Errors in plan (n, 2) that the best shift, turn and scale leave."""

    def complex_of(plan: Floats) -> NDArray[np.complex128]:
        return np.asarray(plan[:, 0] + 1j * plan[:, 1])

    at, error = complex_of(errors.at_m - errors.at_m.mean(axis=0)), complex_of(errors.plan_m)
    error = error - error.mean()
    left = error - at * (np.vdot(at, error) / np.vdot(at, at))
    return np.stack([left.real, left.imag], axis=-1)


def _rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
