"""Other people's hard flights: a rolling shutter with a gyroscope, a rig of four bands, wrong headings.

`garfield/rgb` and `garfield/msp`: a Parrot Sequoia on a fixed wing. `seneca`: a compact camera on another.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
from numpy.typing import NDArray

from geomosaic.adjustment.model import Adjusted
from geomosaic.pipeline.run_results import load_artefact, read_summary
from geomosaic.quality.compare import compare
from geomosaic.quality.compared_block import ComparisonOptions
from geomosaic.quality.figures import best_similarity
from geomosaic.survey.model import Survey
from tools.bench.bench_real_rows import BANDS_PX, HALVES_PX, OFF_TAG, PRINCIPAL, ROWS
from tools.bench.bench_real_table import Row
from tools.bench.result_rows import ResultRow, listed

Floats = NDArray[np.float64]
GEOMOSAIC = Path(sys.executable).with_name("geomosaic")
READOUT_TAG = b"LineReadoutTime"
HALVES_GSD_M = 0.03
_TILE_PX, _BINS = 192, 32


def others(data: Path, out: Path, results: list[ResultRow]) -> list[Row]:
    """Rows of the table; none for flights whose folders are missing; adds to results."""
    rows: list[Row] = []
    if (data / "garfield").is_dir():
        rows += _rolling(data / "garfield" / "rgb", out, results)
        rows += _rig(data / "garfield" / "msp", out, results)
    if (data / "seneca").is_dir():
        rows += _crooked(data / "seneca" / "images", out)
    return rows


def _run(frames: Path, run: Path, *more: object) -> tuple[dict[str, Any], float]:
    """run.json of the whole command, and its time in s."""
    shutil.rmtree(run, ignore_errors=True)
    start = time.monotonic()
    subprocess.run(
        [GEOMOSAIC, "mosaic", frames, "-o", run, *map(str, more)], check=True, stderr=subprocess.DEVNULL
    )
    return json.loads((run / "run.json").read_text()), time.monotonic() - start


def _found(run_summary: dict[str, Any], name: str) -> dict[str, Any]:
    return next(s for s in run_summary["metrics"]["adjustment"]["shared"] if s["name"] == name)


def _rolling(frames: Path, out: Path, results: list[ResultRow]) -> list[Row]:
    run = out / "garfield"
    run_summary, seconds = _run(frames, run)
    adjustment, tied = run_summary["metrics"]["adjustment"], run_summary["frames"]["tied"]
    survey: Survey = load_artefact(run, read_summary(run), "survey", Survey)
    adjusted: Adjusted = load_artefact(run, read_summary(run), "adjusted", Adjusted)
    maker, found = survey.cameras[0], adjusted.cameras[0]
    off = [found.principal_col_px - maker.principal_col_px, found.principal_row_px - maker.principal_row_px]
    share = np.abs(off) / [maker.width_px, maker.height_px]
    bare = _without_tag(frames, out / "garfield-no-readout-frames")
    silent, _ = _run(bare, out / "garfield-no-readout")
    readout = _found(silent, "readout_s")
    off_tag = readout["found"] / maker.readout_s - 1.0
    total, sigma_px = run_summary["frames"]["total"], adjustment["sigma_px"]
    sides = " and ".join(f"{100 * s:.1f} %" for s in share)
    found_readout, within = not readout["held"] and abs(off_tag) < OFF_TAG, share.max() < PRINCIPAL
    results += [
        ROWS["readout"].row(found_readout, off=100 * off_tag),
        ROWS["principal point"].row(within, col=100 * share[0], row=100 * share[1]),
    ]
    return [
        ("garfield/rgb: wall time", f"{seconds:.0f} s", "", True),
        ("frames tied", f"{tied} of {total}", "28", tied == total == 28),
        ("deviation of an image coordinate", f"{sigma_px:.2f} px", "< 1 px", sigma_px < 1.0),
        ("principal point off the maker's",
         f"{off[0]:+.0f}, {off[1]:+.0f} px: {sides} of the side", "< 1 %", within),
        ("readout with its tag taken away",
         f"{readout['found']:.4f} s; the tag says {maker.readout_s:.4f} s: {100 * off_tag:+.1f} %", "10 %",
         found_readout),
        _halves(frames, out, results),
        ("verdict", run_summary["verdict"]["grade"] + ": " + run_summary["verdict"]["cause"], "", True),
    ]  # fmt: skip


def _without_tag(frames: Path, folder: Path) -> Path:
    """Copies of the frames whose files don't say how long a line is read."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    for frame in sorted(frames.glob("*.JPG")):
        data = frame.read_bytes()
        if READOUT_TAG not in data:
            raise ValueError(f"{frame} has no {READOUT_TAG.decode()}")
        (folder / frame.name).write_bytes(data.replace(READOUT_TAG, b"LineReadoutNone"))
    return folder


def _halves(frames: Path, out: Path, results: list[ResultRow]) -> Row:
    """Mosaics of every second frame over each other, each with its own matching, adjustment and ground."""
    mosaics = []
    for k, name in enumerate(("odd", "even")):
        folder = out / f"garfield-{name}-frames"
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        for frame in sorted(frames.glob("*.JPG"))[k::2]:
            (folder / frame.name).symlink_to(frame.resolve())
        _run(folder, out / f"garfield-{name}", "--gsd", HALVES_GSD_M)
        mosaics.append(out / f"garfield-{name}" / "mosaic.tif")
    found = compare(*mosaics, ComparisonOptions(search_px=160))
    _, left_m = best_similarity(found.vectors_m[:, :2], found.vectors_m[:, 2:])
    length_px = np.linalg.norm(left_m, axis=1) / found.gsd_m
    median = float(np.median(length_px))
    results.append(ROWS["garfield halves"].row(median < HALVES_PX, median=median))
    return (
        f"odd against even frames, {len(length_px)} patches, trees as well",
        f"median {median:.2f} px, 90 % {np.quantile(length_px, 0.9):.2f} px",
        "< 3 px in the median",
        median < HALVES_PX,
    )


def _rig(frames: Path, out: Path, results: list[ResultRow]) -> list[Row]:
    run = out / "garfield-msp"
    run_summary, seconds = _run(frames, run)
    with rasterio.open(run / "mosaic.tif") as tiff:
        names, bands, valid = tiff.descriptions, tiff.read().astype(np.float64), tiff.dataset_mask() > 0
    rows: list[Row] = [
        ("garfield/msp: wall time, bands", f"{seconds:.0f} s, {', '.join(names)}", "four", len(names) == 4),
        (
            "deviation of an image coordinate",
            f"{run_summary['metrics']['adjustment']['sigma_px']:.2f} px",
            "",
            True,
        ),
    ]
    apart: list[float] = []
    for k in range(1, len(names)):
        shifts = np.array(list(_shifts(bands[0], bands[k], valid)))
        off = np.median(shifts, axis=0)
        scatter = np.median(np.abs(shifts - off))
        apart.append(float(np.hypot(*off)))
        rows.append((
            f"{names[k]} against {names[0]} by mutual information, {len(shifts)} tiles",
            f"rows {off[0]:+.2f}, cols {off[1]:+.2f} px; single tiles scatter by {scatter:.2f} px",
            "< 0.5 px", apart[-1] < BANDS_PX,
        ))  # fmt: skip
    bands = {"first": names[0], "others": ", ".join(names[1:])}
    results.append(ROWS["bands"].row(max(apart) < BANDS_PX, apart=listed(apart, ".2f"), **bands))
    return rows


def _shifts(one: Floats, other: Floats, valid: NDArray[np.bool_]) -> list[Floats]:
    """Where tiles of a band share most information with another band, (rows, cols) in px."""
    found = []
    for row in range(8, one.shape[0] - _TILE_PX - 8, _TILE_PX):
        for col in range(8, one.shape[1] - _TILE_PX - 8, _TILE_PX):
            at = slice(row, row + _TILE_PX), slice(col, col + _TILE_PX)
            if not valid[row - 8 : row + _TILE_PX + 8, col - 8 : col + _TILE_PX + 8].all():
                continue
            alike = np.empty((9, 9))
            for i, j in np.ndindex(9, 9):
                there = slice(row + i - 4, row + i - 4 + _TILE_PX), slice(col + j - 4, col + j - 4 + _TILE_PX)
                alike[i, j] = _information(one[at], other[there])
            i, j = (int(k) for k in np.unravel_index(int(alike.argmax()), alike.shape))
            if 0 < i < 8 and 0 < j < 8:
                down, right = _peak(alike[i - 1 : i + 2, j]), _peak(alike[i, j - 1 : j + 2])
                found.append(np.array([i - 4 + down, j - 4 + right]))
    return found


def _information(one: Floats, other: Floats) -> float:
    joint, _, _ = np.histogram2d(_ranked(one), _ranked(other), bins=_BINS)
    share = joint / joint.sum()
    alone = share.sum(axis=1, keepdims=True) * share.sum(axis=0, keepdims=True)
    some = share > 0.0
    return float((share[some] * np.log(share[some] / alone[some])).sum())


def _ranked(pixels: Floats) -> Floats:
    """Between 0 and 1, the darkest and the brightest hundredth cut off."""
    low, high = np.quantile(pixels, [0.01, 0.99])
    return np.asarray(np.clip((pixels - low) / max(high - low, 1e-9), 0.0, 1.0)).ravel()


def _peak(three: Floats) -> float:
    """Where a parabola through three neighbours is highest, from the middle one."""
    left, middle, right = three
    return float(0.5 * (left - right) / (left - 2.0 * middle + right))


def _crooked(frames: Path, out: Path) -> list[Row]:
    run = out / "seneca"
    run_summary, seconds = _run(frames, run)
    tied, total = run_summary["frames"]["tied"], run_summary["frames"]["total"]
    codes = [w["code"] for w in run_summary["warnings"]]
    return [
        ("seneca: wall time", f"{seconds:.0f} s", "", True),
        ("frames tied", f"{tied} of {total}", "all", tied == total),
        ("frames called turned; headings called wrong",
         f"{codes.count('frame-turned')}; {codes.count('yaw-wrong')}", "none; any",
         "frame-turned" not in codes),
        ("deviation of an image coordinate", f"{run_summary['metrics']['adjustment']['sigma_px']:.2f} px", "",
         True),
        ("verdict", run_summary["verdict"]["grade"] + ": " + run_summary["verdict"]["cause"], "", True),
    ]  # fmt: skip
