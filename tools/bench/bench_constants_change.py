"""How far two outcomes of a stage are apart, as a multiple of what counts as a change."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

from geomosaic.camera.exterior import Poses
from geomosaic.doors.bindings import gdal
from geomosaic.pipeline.context import Notes, RunFile
from tools.bench.bench_constants_scenes import StageOutcome

SHARE, PX, GREY = 0.01, 0.01, 0.1
"""What counts: of a stated deviation, of a figure or of a count; on a frame; of the mosaic's grey levels."""
OF_THE_PROCEDURE = {"steps", "rounds", "seconds", "timings_s", "memory_mb", "peak_memory_mb"}
"""How a result was found, and on which machine."""
CHANGED = float("inf")
Change = tuple[float, str]


def change(before: StageOutcome, after: StageOutcome, rasters: Mapping[str, Any]) -> Change:
    """The largest change, 1 the least that counts, and what changed. rasters: of files before, by name."""
    if after.failure:
        return CHANGED, after.failure
    found = list(_between(before.outputs, after.outputs, ""))
    found += _notes(before.notes, after.notes)
    found += [_raster(name, old, folder) for name, (old, folder) in rasters.items()]
    return max(found, default=(0.0, ""))


def _notes(old: Notes, new: Notes) -> Iterator[Change]:
    codes = [sorted({(w["code"], w["frame"]) for w in notes.warnings}) for notes in (old, new)]
    if codes[0] != codes[1]:
        names = sorted({code for code, _ in set(codes[0]) ^ set(codes[1])})
        yield CHANGED, f"warnings: {', '.join(names)}"
    yield from _between(old.metrics, new.metrics, "metrics")
    yield from _between(old.report, new.report, "report")


def _between(old: Any, new: Any, name: str) -> Iterator[Change]:
    """Each change below a name."""
    last = name.rsplit(".", 1)[-1]
    picture = isinstance(old, str) and old.startswith("data:")
    if last in OF_THE_PROCEDURE or isinstance(old, RunFile) or picture:
        return
    if isinstance(old, Poses) and isinstance(new, Poses) and len(old) == len(new):
        yield from _poses(old, new, name)
    elif type(old) is not type(new) and not (_number(old) and _number(new)):
        yield CHANGED, f"{name}: {type(old).__name__}, then {type(new).__name__}"
    elif is_dataclass(old):
        for field in fields(old):
            yield from _between(getattr(old, field.name), getattr(new, field.name), f"{name}.{field.name}")
    elif isinstance(old, Mapping):
        for key in sorted({*old, *new}, key=str):
            yield from _between(old.get(key), new.get(key), f"{name}.{key}")
    elif isinstance(old, str):
        if re.sub(r"[\d.,]+", "#", old) != re.sub(r"[\d.,]+", "#", new):
            yield CHANGED, f"{name}: {old[:40]!r}, then {new[:40]!r}"
    elif isinstance(old, bool) or old is None:
        if old != new:
            yield CHANGED, f"{name}: {old}, then {new}"
    elif _number(old) or isinstance(old, np.ndarray) or (isinstance(old, (list, tuple)) and _flat(old, new)):
        yield _numbers(np.asarray(old), np.asarray(new), name)
    elif isinstance(old, (list, tuple)):
        if len(old) != len(new):
            yield abs(len(old) - len(new)) / max(len(old), 1) / SHARE, f"{name}: {len(old)}, then {len(new)}"
        else:
            for one, other in zip(old, new, strict=True):
                yield from _between(one, other, name)


def _number(value: Any) -> bool:
    return isinstance(value, (int, float, np.number)) and not isinstance(value, bool)


def _flat(old: Any, new: Any) -> bool:
    return bool(old) and all(map(_number, old)) and all(map(_number, new))


def _poses(old: Poses, new: Poses, name: str) -> Iterator[Change]:
    """By their stated deviations."""
    moved = np.abs(new.positions_m - old.positions_m) / np.maximum(old.positions_sd_m, 1e-6)
    yield float(np.nanmax(moved, initial=0.0)) / SHARE, f"{name}.positions_m"
    turn = np.swapaxes(old.rotations, -1, -2) @ new.rotations
    cos = np.clip((np.trace(turn, axis1=-2, axis2=-1) - 1.0) / 2.0, -1.0, 1.0)
    angle = np.where(cos < 1.0 - 1e-12, np.arccos(cos), 0.0)
    angle /= np.maximum(np.linalg.norm(old.rotations_sd_rad, axis=-1), 1e-6)
    yield float(np.nanmax(angle, initial=0.0)) / SHARE, f"{name}.rotations"
    for field in fields(old):
        if field.name not in ("positions_m", "rotations"):
            yield from _between(getattr(old, field.name), getattr(new, field.name), f"{name}.{field.name}")


def _numbers(old: np.ndarray, new: np.ndarray, name: str) -> Change:
    """Pixels by pixels, all else by its own scatter or size."""
    if old.dtype.kind not in "fiub" or new.dtype.kind not in "fiub":
        return (0.0, "") if np.array_equal(old, new) else (CHANGED, name)
    if old.shape != new.shape:
        return max(
            abs(old.size - new.size) / max(old.size, 1) / SHARE, 1e-3
        ), f"{name}: {old.shape}, then {new.shape}"
    if not old.size or np.array_equal(old, new, equal_nan=old.dtype.kind == "f"):
        return 0.0, ""
    if old.dtype.kind in "iub" and old.ndim:
        return float(np.mean(old != new)) / SHARE, name
    one, other = old.astype(float), new.astype(float)
    lost = float(np.mean(np.isfinite(one) != np.isfinite(other))) / SHARE
    both = np.isfinite(one) & np.isfinite(other)
    if not both.any():
        return lost, name
    one, other = one[both], other[both]
    off = float(np.sqrt(np.mean((other - one) ** 2)))
    spread = float(np.std(one)) if one.size > 1 else 0.0
    least = PX if name.endswith("_px") else SHARE * (spread or float(np.abs(one).max()) or 1.0)
    return max(lost, off / least), f"{name}: by {off:.3g}"


def rasters_of(folder: Path, since: float) -> dict[str, Any]:
    """The rasters in a run's folder that are not older, each with the folder."""
    found = [p for p in folder.rglob("*.tif") if p.stat().st_mtime >= since]
    return {str(path.relative_to(folder)): (_read(path), folder) for path in found}


def _read(path: Path) -> np.ndarray | None:
    dataset = gdal.Open(str(path)) if path.exists() else None
    return None if dataset is None else np.asarray(dataset.ReadAsArray())


def _raster(name: str, old: np.ndarray | None, folder: Path) -> Change:
    new = _read(folder / name)
    if old is None or new is None:
        return (0.0, "") if old is new else (CHANGED, f"{name}: there or not")
    if old.shape != new.shape:
        return CHANGED, f"{name}: {old.shape}, then {new.shape}"
    if old.dtype == np.uint8 and old.ndim == 3:
        off = float(np.sqrt(np.mean((new.astype(float) - old) ** 2)))
        return off / GREY, f"{name}: by {off:.2g} grey levels"
    return _numbers(old, new, name)
