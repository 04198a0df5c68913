"""Adjusts degenerate blocks by the thousand: each has to end finite, without an exception.

python -m tools.trials.trial_degenerate --draws 10000 --seed 1 --out out/trial-degenerate
"""

from __future__ import annotations

import argparse
import json
import os
import time
import traceback
import warnings
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

from geomosaic.adjustment.model import Adjusted
from geomosaic.adjustment.procedure.bundle_method import pose_block
from tools.bench.result_rows import RowKind, add_options, write_rows
from tools.docs.results_page import FLIGHTS
from tools.trials.degenerate_blocks import draw

ROWS = {
    "finite": RowKind(
        FLIGHTS,
        "degenerate blocks that end with finite values and without an exception",
        "all",
        "{finite:,} of {blocks:,}",
    )
}


def problems(adjusted: Adjusted, frames: int) -> list[str]:
    """What is wrong with an outcome; empty where nothing is."""
    poses = adjusted.poses
    checks = {
        "positions": np.isfinite(poses.positions_m).all(),
        "rotations": np.isfinite(poses.rotations).all(),
        "position deviations": not np.isnan(poses.positions_sd_m).any(),
        "turn deviations": not np.isnan(poses.rotations_sd_rad).any(),
        "deviations above zero": (poses.positions_sd_m > 0.0).all(),
        "rotations orthonormal": np.allclose(
            poses.rotations @ np.swapaxes(poses.rotations, 1, 2), np.eye(3), atol=1e-6
        ),
        "lenses": all(np.isfinite([c.focal_length_px, *c.terms]).all() for c in adjusted.cameras),
        "ground": np.isfinite(adjusted.ground.up_m).all(),
        "a status a frame": len(adjusted.status) == frames,
        "figures": not any(np.isinf(v) for v in adjusted.figures.values()),
    }
    return [name for name, good in checks.items() if not good]


def tried(seed: int) -> tuple[int, str, str, tuple[str, ...], float]:
    """Seed, kind, what went wrong (empty: nothing), warning codes, seconds."""
    made = draw(seed)
    begin = time.perf_counter()
    wrong, codes = "", ()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            adjusted = pose_block(made.block, made.settings)
        wrong = ", ".join(problems(adjusted, len(made.block.names)))
        codes = tuple(sorted({w.code for w in adjusted.warnings}))
    except Exception:
        wrong = "exception: " + " | ".join(traceback.format_exc(limit=-3).strip().splitlines()[-7:])
    return seed, made.kind, wrong, codes, time.perf_counter() - begin


def main() -> int:
    """Runs the draws, prints a table of what failed, writes degenerate.json."""
    words = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    words.add_argument("--draws", type=int, default=10_000)
    words.add_argument("--seed", type=int, default=1)
    words.add_argument("--workers", type=int, default=2)
    words.add_argument("--out", type=Path, default=Path("out/trial-degenerate"))
    add_options(words)
    asked = words.parse_args()
    begin = time.perf_counter()
    seeds = range(asked.seed, asked.seed + asked.draws)
    codes: Counter[str] = Counter()
    failed, slow = [], []
    with ProcessPoolExecutor(asked.workers) as pool:
        for seed, kind, wrong, seen, seconds in pool.map(tried, seeds, chunksize=8):
            codes.update(seen)
            slow.append((seconds, seed))
            if wrong:
                failed.append({"seed": seed, "kind": kind, "wrong": wrong})
                print(f"seed {seed} ({kind}): {wrong}", flush=True)
            if len(slow) % 1000 == 0:
                passed_s = time.perf_counter() - begin
                print(
                    f"{len(slow)} of {asked.draws} draws, {len(failed)} failed, {passed_s:.0f} s", flush=True
                )
    result = {
        "draws": asked.draws,
        "first_seed": asked.seed,
        "failed": failed,
        "warnings": dict(codes.most_common()),
        "slowest_s": max(slow)[0],
        "slowest_seed": max(slow)[1],
        "total_s": time.perf_counter() - begin,
    }
    asked.out.mkdir(parents=True, exist_ok=True)
    (asked.out / "degenerate.json").write_text(json.dumps(result, indent=1))
    print(
        f"{asked.draws} draws, {len(failed)} failed, {result['total_s']:.0f} s; warnings {result['warnings']}"
    )
    finite = asked.draws - len(failed)
    write_rows(asked, [ROWS["finite"].row(not failed, finite=finite, blocks=asked.draws)])
    return 1 if failed else 0


if __name__ == "__main__":
    raise SystemExit(main())
