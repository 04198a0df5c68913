"""What a case showed: problems by name, and how far an accepted file's result is from the unspoiled one's."""

from __future__ import annotations

import dataclasses
import json
import re
import signal
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import rasterio

from geomosaic.errors import GeomosaicError
from geomosaic.pipeline.run_results import load_artefact, read_summary
from geomosaic.placement.model import Placement
from geomosaic.projection.ground import GroundSurface
from geomosaic.survey.model import Survey
from geomosaic.survey.strips import StripGeometry
from tools.trials.trial_box import MEMORY_BYTES, EndedCommand

_NO_MEMORY = re.compile(r"MemoryError|bad_alloc|nable to allocate|ut of memory")
_USUAL = re.compile(r"geomosaic: |warning: |\[\d+/\d+\] ")
_LEFT = re.compile(r"^\..*\.(part|old)")

REACH_M = 1000.0
"""A position may be reported so far from where it was, without a warning, by a survey of this size."""
RATIO = 2.0
"""Flying height and focal length may be reported off by up to this factor: more no honest slip of a digit
hides."""
PIXELS_SHARE, PIXEL_STEP = 0.002, 30.0
"""A mosaic is grossly another where this share of its pixels differs by this much of 255."""


@dataclass(frozen=True)
class Result:
    """What a command made, as far as it is compared: numbers by name, warnings, the mosaic's pixels."""

    numbers: dict[str, float | str] = field(default_factory=dict)
    warnings: frozenset[tuple[str, str, str]] = frozenset()
    pixels: Any = None


def problems(ended: EndedCommand, changed: list[str], out: Path, most_bytes: int = MEMORY_BYTES) -> list[str]:
    """Names of what must never be."""
    words, found = ended.err + ended.out, []
    if "Traceback (most recent call last)" in words:
        found.append("traceback")
    if "a fault of geomosaic" in words:
        found.append("fault")
    if ended.hung or ended.code == -signal.SIGXCPU:
        found.append("hang")
    elif ended.code < 0:
        found.append("crash")
    if ended.peak_mb * 1e6 > most_bytes or _NO_MEMORY.search(ended.err):
        found.append("memory")
    if changed or any("open for writing" in doing or "os." in doing for doing in ended.doings):
        found.append("changed outside")
    if ended.connections or any("socket" in doing for doing in ended.doings):
        found.append("connection")
    if any(
        doing.split()[0] in ("subprocess.Popen", "os.system", "os.exec", "pickle.find_class")
        for doing in ended.doings
    ):
        found.append("program")
    if ended.code not in (0, 1, 2) and ended.code >= 0 and not found:
        found.append("exit code")
    if ended.code in (1, 2) and not found and words.count("geomosaic: ") != 1 and ended.argv[0] != "diff":
        found.append("not one line")
    if ended.code == 2 and out.is_dir() and any(_LEFT.match(p.name) for p in out.rglob(".*")):
        found.append("half-written")
    return found


def stray_lines(ended: EndedCommand) -> list[str]:
    """Lines on stderr that are none of geomosaic's own: a library spoke."""
    return [line for line in ended.err.splitlines() if line.strip() and not _USUAL.match(line)]


def result_of(out: Path, judge: str) -> Result:
    """The result in a run folder; raises `GeomosaicError` or `OSError` where it can't be read."""
    if not judge:
        return Result()
    summary = read_summary(out)
    warnings = frozenset((w["code"], w["frame"], w["text"]) for w in summary["warnings"])
    numbers: dict[str, float | str] = {}
    kinds: dict[str, type] = {
        "survey": Survey,
        "prior_ground": GroundSurface,
        "ground": GroundSurface,
        "prior_placement": Placement,
        "placement": Placement,
        "strips": StripGeometry,
    }
    for name, kind in kinds.items():
        if name in summary["artefacts"]:
            try:
                numbers.update(_leaves(load_artefact(out, summary, name, kind), name.removeprefix("prior_")))
            except GeomosaicError:
                continue
    pixels = None
    if (out / "mosaic.tif").is_file() and judge != "survey":
        with rasterio.open(out / "mosaic.tif") as file:
            pixels = file.read().astype(np.float32)
    return Result(numbers, warnings, pixels)


def _leaves(value: Any, name: str) -> Iterator[tuple[str, float | str]]:
    """Numbers and words of an artefact by name; arrays by shape and two means; no paths, no hashes."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        for f in dataclasses.fields(value):
            if f.name not in ("warnings", "path", "valid_mask"):
                yield from _leaves(getattr(value, f.name), f"{name}.{f.name}")
    elif isinstance(value, dict):
        for key, item in value.items():
            yield from _leaves(item, f"{name}[{key}]")
    elif isinstance(value, tuple | list):
        yield f"{name}.count", len(value)
        for i, item in enumerate(value):
            yield from _leaves(item, f"{name}[{i}]")
    elif isinstance(value, np.ndarray):
        yield f"{name}.shape", str(value.shape)
        if value.size and value.dtype.kind in "iuf":
            flat = value.astype(np.float64).ravel()
            yield f"{name}.mean", float(flat.mean())
            yield f"{name}.weighted", float((flat * np.linspace(0.5, 1.5, flat.size)).mean())
    elif isinstance(value, bool | int | float):
        yield name, float(value)
    elif isinstance(value, str) and not re.fullmatch(r"[0-9a-f]{16,}", value) and "/" not in value:
        yield name, value


@dataclass(frozen=True)
class Difference:
    """`same`, `warned`, `small` (another honest survey could say so), `gross`; and where."""

    grade: str
    where: tuple[str, ...] = ()


def difference(base: Result, found: Result, judge: str) -> Difference:
    """How the result of a spoiled file differs from the unspoiled one's."""
    names = sorted(base.numbers.keys() | found.numbers.keys())
    other = [n for n in names if not _equal(base.numbers.get(n), found.numbers.get(n))]
    where = [f"{n}: {base.numbers.get(n)} -> {found.numbers.get(n)}" for n in other]
    share = _pixels_share(base.pixels, found.pixels)
    if share > 0:
        where.append(f"pixels: {share:.2%}")
    if not where:
        return Difference("same")
    if found.warnings - base.warnings:
        return Difference("warned", tuple(where[:4]))
    gross = judge == "same" or share > PIXELS_SHARE or any(_gross(n, base, found) for n in other)
    return Difference("gross" if gross else "small", tuple(where[:4]))


def _equal(a: object, b: object) -> bool:
    if isinstance(a, float) and isinstance(b, float):
        return a == b or bool(np.isclose(a, b, rtol=1e-9, atol=1e-9)) or (a != a and b != b)
    return a == b


def _pixels_share(a: Any, b: Any) -> float:
    """Share of the pixels that differ by more than `PIXEL_STEP`."""
    if a is None or b is None:
        return 0.0
    if a.shape != b.shape:
        return 1.0
    return float((np.abs(a - b).max(axis=0) > PIXEL_STEP).mean())


def _gross(name: str, base: Result, found: Result) -> bool:
    """Whether a number is beyond what a slip in an honest file of this survey could be."""
    a, b = base.numbers.get(name), found.numbers.get(name)
    last = name.rpartition(".")[2]
    if name.startswith("survey.control"):  # under another name it is another point
        return False
    if not isinstance(a, float) or not isinstance(b, float):
        return last not in ("source", "vertical", "name", "camera")  # a frame more or less, another shape
    if not np.isfinite(b):
        return bool(np.isfinite(a))
    if last in ("lon_deg", "lat_deg"):
        return abs(a - b) * 111e3 > REACH_M
    if last in ("height_ellipsoidal_m", "height_above_ground_m"):
        return abs(a - b) > 50.0 * RATIO
    if "focal" in last and not last.startswith("sd"):
        return not a / RATIO <= b <= a * RATIO
    return name.endswith("ground_pixel_m") and not a / RATIO**2 <= b <= a * RATIO**2


def read_json(path: Path) -> Any:
    return json.loads(path.read_text())
