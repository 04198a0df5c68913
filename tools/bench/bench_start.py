"""Whether the solve finds its block: surveys with what EXIF assumes for accuracy, seed by seed.

    python -m tools.bench.bench_start [--out DIR] [--only NAME ...] [--first N] [--seeds N]

Each survey is simulated and matched once (kept in OUT). Then the solve alone runs and is judged by where it
puts a grid of every frame's own ground, against the true poses, lens and ground. Right: within 0.2 px after
the best similarity, and an absolute error within three stated deviations. The table goes to standard output
as Markdown and to OUT/start.json; exit code 1 if a seed is wrong.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from numpy.typing import NDArray

from geomosaic.adjustment.methods import METHODS
from geomosaic.adjustment.model import Adjusted, Block, Settings
from geomosaic.camera.exterior import Poses
from geomosaic.camera.interior import Camera
from geomosaic.camera.rotation import Rotation
from geomosaic.geodesy.local import LocalFrame
from geomosaic.matching.model import TiePoints
from geomosaic.pipeline.run_results import load_artefact, read_summary
from geomosaic.placement.model import Placement
from geomosaic.projection.footprint import ground_from_image
from geomosaic.projection.ground import GroundSurface, flat_ground
from geomosaic.quality.figures import best_similarity
from geomosaic.stages.adjustment_solve import block_of
from geomosaic.survey.model import Survey
from tools.bench.result_rows import RowKind, add_options, counted, in_words, write_rows
from tools.docs.results_page import DIRTY

Floats = NDArray[np.float64]
GEOMOSAIC = Path(sys.executable).with_name("geomosaic")
BLOCK = ["--lines", "3", "--frames-per-line", "8", "--k1", "0", "--k2", "0"]
SMALL = [
    *BLOCK,
    *["--width-px", "640", "--height-px", "480", "--height-above-ground-m", "72", "--pos-in", "exif"],
]
LARGER = [*BLOCK, *["--width-px", "1336", "--height-px", "1002", "--pos-in", "exif"]]
WITH_CSV = [*(word for word in SMALL if word not in ("--pos-in", "exif")), "--no-relative-height-reported"]
KEYPOINTS = 1500
RIGHT_PX, RIGHT_SDS = 0.2, 3.0
ROWS = {
    "found": RowKind(
        DIRTY,
        "initialisation: blocks of {kinds} of wrong tags that are found",
        "all",
        "{right:d} of {blocks:d}, seeds {seeds}",
    )
}


@dataclass(frozen=True)
class StartCase:
    """A survey; the reported focal length is wrong by focal_error, too long on odd seeds and too short on
    even ones. altitude: what becomes of the heights that the frames report, in a POS file with nothing else
    but plan positions."""

    name: str
    simulate: list[str]
    focal_error: float = 0.03
    altitude: str | None = None


CASES = (
    StartCase("flat", SMALL),
    StartCase("flat, larger frames", LARGER),
    StartCase("lies", [*SMALL, "--yaw-wrong-share", "0.2", "--turned", "9-16", "--gps-outliers", "1"]),
    StartCase("no attitude", [*SMALL, "--no-attitude-reported"]),
    StartCase("heights constant", WITH_CSV, altitude="constant"),
    StartCase("heights drift", WITH_CSV, altitude="drift"),
    StartCase("heights below ground", WITH_CSV, altitude="below"),
    StartCase("heights in steps", WITH_CSV, altitude="steps"),
)  # fmt: skip


def matched(case: StartCase, out: Path, seed: int) -> tuple[Path, Path]:
    """The survey's folder and the folder of its run as far as the tie points; both are made once."""
    folder = out / f"{''.join(c for c in case.name.replace(' ', '_') if c.isalnum() or c == '_')}-{seed}"
    if not (folder / "truth" / "truth.json").exists():
        focal = case.focal_error * (1 if seed % 2 else -1)
        _call("simulate", "frames", folder, *case.simulate, "--focal-error", focal, "--seed", seed)
    run = folder / "run"
    if not (run / "run.json").exists():
        recipe = folder / "matched.yaml"
        options = {"frames": str(folder / "frames")}
        if case.altitude is not None:
            options["pos"] = str(_altered(folder, case.altitude))
        recipe.write_text(
            json.dumps({"name": "matched", "stages": [
                {"stage": "survey.read", "params": options}, "matching.flying_height", "projection.ground",
                "placement.pos", {"stage": "matching.sift", "params": {"keypoints": KEYPOINTS}},
            ]})
        )  # fmt: skip
        _call("run", recipe, "-o", run)
    return folder, run


def _altered(folder: Path, altitude: str) -> Path:
    """A POS file of plan positions and heights that aren't worth much, with no deviation and no attitude."""
    with (folder / "pos.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    height = np.array([float(r["height_ellipsoidal_m"]) for r in rows])
    along = np.linspace(0.0, 1.0, len(rows))
    reported = {
        "constant": np.full(len(rows), 6.0),
        "drift": height + 120.0 * along,
        "below": height - 90.0 - 60.0 * along,
        "steps": np.round(height / 50.0) * 50.0,
    }[altitude]
    path = folder / f"pos-{altitude}.csv"
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["frame", "lon_deg", "lat_deg", "height_ellipsoidal_m"])
        writer.writerows(
            [r["frame"], r["lon_deg"], r["lat_deg"], h] for r, h in zip(rows, reported, strict=True)
        )
    return path


def measure(case: StartCase, out: Path, seed: int) -> dict[str, Any]:
    """All figures of one seed."""
    folder, run = matched(case, out, seed)
    run_summary = read_summary(run)
    parts = {
        "levelled_survey": Survey,
        "prior_ground": GroundSurface,
        "placement": Placement,
        "ties": TiePoints,
    }
    survey, ground, placement, ties = (load_artefact(run, run_summary, k, t) for k, t in parts.items())
    block = block_of(survey, ground, placement, ties)
    begun = time.process_time()
    adjusted = METHODS["bundle"](block, Settings())
    seconds = time.process_time() - begun
    return {
        "case": case.name,
        "seed": seed,
        "s": seconds,
        **judged(block, adjusted, survey.work_frame, folder),
    }


def judged(block: Block, adjusted: Adjusted, work_frame: LocalFrame, folder: Path) -> dict[str, Any]:
    """Errors of the ground that each frame shows nearest to its middle, and whether they are as stated."""
    truth = json.loads((folder / "truth" / "truth.json").read_text())
    poses, camera = true_poses(folder, work_frame), true_camera(folder)
    off, at = [], []
    true_ground = flat_ground(work_frame, truth["plan"]["ground_height_m"], 5000.0)
    for i, frame in enumerate(truth["frames"]):
        taken = camera.turned(2) if frame["turned"] else camera
        px = np.stack(np.meshgrid(np.linspace(0.3, 0.7, 5), np.linspace(0.3, 0.7, 5)), axis=-1).reshape(-1, 2)
        px = px * [camera.width_px, camera.height_px]
        there = ground_from_image(poses[i], taken, true_ground, px)[:, :2]
        at.append(there)
        off.append(
            ground_from_image(adjusted.poses[i], adjusted.cameras[i], adjusted.ground, px)[:, :2] - there
        )
    shown, moved = np.concatenate(at), np.concatenate(off)
    left = best_similarity(shown, moved)[1]
    rms = float(np.sqrt((moved**2).sum(axis=1).mean()))
    after = float(np.sqrt((left**2).sum(axis=1).mean())) / block.ground_pixel_m
    stated = float(np.sqrt((adjusted.poses.positions_sd_m[:, :2] ** 2).sum(axis=1).mean()))
    return {
        "absolute_m": rms, "after_px": after, "stated_m": stated, "scale": scale_of(shown, moved),
        "sigma_horizontal": adjusted.figures.get("sigma_horizontal", float("nan")),
        "ground": adjusted.ground.kind, "tied": adjusted.status.count("tied"), "frames": len(block.names),
        "warnings": sorted({w.code for w in adjusted.warnings}),
        "right": after <= RIGHT_PX and rms <= RIGHT_SDS * stated,
    }  # fmt: skip


def scale_of(at_m: Floats, moved_m: Floats) -> float:
    """By how much of itself the block is too large."""
    z, w = (at_m - at_m.mean(axis=0)) @ [1, 1j], (moved_m - moved_m.mean(axis=0)) @ [1, 1j]
    return float((w * np.conj(z)).sum().real / (np.abs(z) ** 2).sum())


def true_poses(folder: Path, work_frame: LocalFrame) -> Poses:
    with (folder / "truth" / "positions.csv").open(newline="") as file:
        rows = [
            {k: float(v) for k, v in r.items() if k not in ("frame", "status")} for r in csv.DictReader(file)
        ]
    lon, lat, up = (np.array([r[k] for r in rows]) for k in ("lon_deg", "lat_deg", "height_ellipsoidal_m"))
    angles = np.radians([[r["yaw_deg"], r["pitch_deg"] + 90.0, r["roll_deg"]] for r in rows]).T
    local = Rotation.from_yaw_pitch_roll(*angles).matrix
    none = np.zeros((len(rows), 3))
    return Poses(
        work_frame.enu_from_geodetic(lon, lat, up),
        work_frame.enu_from_local_rotation(lon, lat) @ local,
        none,
        none,
    )


def true_camera(folder: Path) -> Camera:
    (one,) = json.loads((folder / "truth" / "cameras.json").read_text()).values()
    size = max(one["width"], one["height"])
    return Camera(
        "true", one["width"], one["height"], one["focal_x"] * size,
        one["width"] / 2.0 + one["c_x"] * size, one["height"] / 2.0 + one["c_y"] * size,
        **{k: one[k] for k in ("k1", "k2", "k3", "p1", "p2")},
    )  # fmt: skip


def _call(*words: object) -> None:
    done = subprocess.run(
        [str(GEOMOSAIC), *map(str, words), "--workers", "1"], capture_output=True, text=True, check=False
    )
    if done.returncode:
        raise RuntimeError(f"geomosaic {' '.join(map(str, words))}\n{done.stderr}")


HEAD = (
    "survey",
    "seed",
    "absolute, m",
    "stated, m",
    "scale, %",
    "after similarity, px",
    "ground",
    "tied",
    "CPU s",
    "",
)


def _line(r: dict[str, Any]) -> str:
    if "failed" in r:
        return f"| {r['case']} | {r['seed']} | {r['failed']} |"
    cells = (
        r["case"], r["seed"], f"{r['absolute_m']:.2f}", f"{r['stated_m']:.2f}", f"{100 * r['scale']:+.2f}",
        f"{r['after_px']:.3f}", r["ground"], f"{r['tied']} of {r['frames']}", f"{r['s']:.1f}",
        "right" if r["right"] else "WRONG",
    )  # fmt: skip
    return f"| {' | '.join(map(str, cells))} |"


def main() -> int:
    """Runs the cases asked for, prints the table as it grows."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=Path("out/bench-start"))
    parser.add_argument("--only", nargs="*", choices=[c.name for c in CASES], help="names of surveys")
    parser.add_argument("--first", type=int, default=1, help="the first seed")
    parser.add_argument("--seeds", type=int, default=20, help="how many seeds")
    parser.add_argument("--match-only", action="store_true", help="simulate and match, don't solve")
    add_options(parser)
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    rows: list[dict[str, Any]] = []
    print(f"| {' | '.join(HEAD)} |\n|{'---|' * len(HEAD)}")
    for case in CASES:
        if args.only and case.name not in args.only:
            continue
        mine: list[dict[str, Any]] = []
        for seed in range(args.first, args.first + args.seeds):
            if args.match_only:
                matched(case, args.out, seed)
                continue
            try:
                mine.append(measure(case, args.out, seed))
            except Exception as error:  # a seed that ends without a result is a result
                mine.append({"case": case.name, "seed": seed, "failed": repr(error)[:300], "right": False})
            print(_line(mine[-1]), flush=True)
            (args.out / "start.json").write_text(json.dumps(rows + mine, indent=1))
        rows += mine
        if mine:
            print(f"{case.name}: {sum(r['right'] for r in mine)} of {len(mine)} right", flush=True)
    if rows:
        right, seeds = sum(r["right"] for r in rows), sorted({r["seed"] for r in rows})
        cases = len({r["case"] for r in rows})
        kinds = f"{in_words(cases)} kind{'s' if cases > 1 else ''}"
        figures = {"kinds": kinds, "right": right, "blocks": len(rows), "seeds": counted(seeds)}
        write_rows(args, [ROWS["found"].row(right == len(rows), **figures)])
    return 0 if all(r["right"] for r in rows) else 1


if __name__ == "__main__":
    raise SystemExit(main())
