"""How well the surface between frames is matched: simulated towns and their truth, real flights.

    python -m tools.bench.bench_surface [--out DIR] [--seeds 5,7,11] [--small] [--roofs] [--rival]
                                            [--scale] [--large] [--real DIR | --no-real]

Towns go through the whole command with cells of 4 ground pixels, by 18 frames of 2000 x 1500 px. These are
from 100 m, with 70 % and 60 % overlap. The towns have hills of 10 m, houses with walls of 3.5 to 10 m and
hipped or level roofs, bridges and trees. The surface is judged against the true heights, and how far the
mosaic's land lies off against what the verdict says of it. --roofs judges three mosaics against the true
ortho: on the surface, on the ground through tie points, and with roofs in place on that (--surface auto).
--rival adds StereoSGBM on rectified pairs. --scale measures what 20, 60 and 200 small frames take, and
whether one process and two give the same bytes. --large measures what 160 frames of 10 MP take.

Real data are skipped where they aren't there. 18 frames of 9 MP give the seconds of the stage, the memory of
the run, and a comparison of mosaics of odd and even frames. Four frames over 600 m of relief are compared to
their DEM. Tables go to standard output and OUT/surface.json.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from dataclasses import asdict
from pathlib import Path

import numpy as np

from geomosaic.quality.surface import compare_surface
from tools.bench.bench_real_cloud import read_cloud, write_bare_ground
from tools.bench.bench_real_halves import CRS, GSD_M, Wanted, halves
from tools.bench.bench_real_ngi import ngi_surface
from tools.bench.bench_real_table import Row, print_table
from tools.bench.bench_surface_judge import SurfaceErrors, judged
from tools.bench.bench_surface_land import judged_land
from tools.bench.bench_surface_rival import stereo_sgbm
from tools.bench.bench_surface_roofs import FAR_PX, Roofs, roofs, similarity_by_tile
from tools.bench.bench_surface_rows import (
    ROWS,
    SAME_SSIM,
    WANTED_NMAD_PX,
    WANTED_OFF_1_M,
    WORSE_SSIM,
    Town,
    gain_of,
    town_rows,
)
from tools.bench.bench_surface_scale import TOWN, called, large, scale
from tools.bench.result_rows import ResultRow, add_options, write_rows

LINES = ["--lines", "3"]
SIZE = ["--width-px", "2000", "--height-px", "1500", "--frames-per-line", "6"]
SMALL = ["--width-px", "1000", "--height-px", "750", "--frames-per-line", "5"]
WANTED_S, WANTED_MB = 15.0, 1500.0
_CELL_PX, _BARE_REACH_M, _SHOWN = 4.0, 1.0, 3


def town(
    out: Path, seed: int, size: list[str], *, with_roofs: bool, with_rival: bool
) -> tuple[list[Row], Town]:
    """Rows of one simulated town, and what was measured of it."""
    survey, run = out / f"town-{seed}", out / f"run-{seed}"
    truth = survey / "truth"
    if not (truth / "truth.json").is_file():
        called(out, "simulate", "frames", survey, *TOWN, *LINES, *size, "--seed", seed)
    options = [
        "--pos",
        survey / "pos.csv",
        "--camera",
        survey / "cameras.json",
        "--align-to",
        truth / "ortho.tif",
    ]
    rows: list[Row] = []
    took: list[str] = []
    of_town = Town(seed)
    compared = (("tie points' ground", "ties"), ("ground with roofs in place", "auto")) * with_roofs
    grounds = (*compared, ("surface", "dense", "--ortho", "surface"))
    for name, *how in grounds:
        taken = called(
            out, "mosaic", survey / "frames", *options, "-o", run, "--surface", *how, "--overwrite"
        )
        took.append(f"mosaic on the {name} {taken.processor_s:.0f}")
        if with_roofs:
            begun = time.process_time()
            shown = roofs(run / "mosaic.tif", truth)
            rows += _roof_rows(f"town {seed}, mosaic on the {name}", shown)
            of_town.houses[how[0]] = shown["houses"]
            of_town.tiles[how[0]] = similarity_by_tile(run / "mosaic.tif", truth)
            took.append(f"roofs {time.process_time() - begun:.0f}")
    if with_roofs:
        rows += [_tile_row(of_town, how) for how in ("auto", "dense")]
    begun = time.process_time()
    found, cell_m = judged(run, truth)
    (run / "judged.json").write_text(json.dumps({k: asdict(v) for k, v in found.items()}), encoding="utf-8")
    of_town.cells = found
    of_town.nmad_px = {name: of.nmad_m / (cell_m / _CELL_PX) for name, of in found.items()}
    rows += [_class_row(f"town {seed}, {name}", name, of, cell_m) for name, of in found.items()]
    land = judged_land(run, truth)
    rows.append((f"town {seed}, land of the mosaic ({land.places:,} places)", *land.figures()))
    took.append(f"judging {time.process_time() - begun:.0f}")
    if with_rival:
        begun = time.process_time()
        rival, _ = stereo_sgbm(run)
        took.append(f"StereoSGBM {time.process_time() - begun:.0f}")
        of_town.rival = judged(run, truth, rival)[0]
        for name, of in of_town.rival.items():
            what, text, _, _ = _class_row(f"town {seed}, StereoSGBM, {name}", name, of, cell_m)
            rows.append((what, text.split(";")[0], "", True))
    stage_s = json.loads((run / "run.json").read_text(encoding="utf-8"))["timings_s"]["surface.dense"]
    rows.append((f"town {seed}, processor s", f"{', '.join(took)}; surface.dense {stage_s:.1f} s", "", True))
    return rows, of_town


def _roof_rows(what: str, found: dict[str, Roofs]) -> list[Row]:
    rows: list[Row] = []
    for name, of in found.items():
        text = (
            f"corners {of.rmse_px:.2f} px RMSE, 90 % {of.p90_px:.2f} ({of.matched} of {of.corners} match "
            f"both ways{_far(of)}); "
            f"edges ({of.pieces} pieces) missing {100.0 * of.missing:.1f} %, doubled "
            f"{100.0 * of.doubled:.1f} %, moved {100.0 * of.moved:.1f} %; SSIM {of.ssim:.3f}, "
            f"about them {of.ssim_roofs:.3f}"
        )
        wanted = "surface" in what and name == "houses"
        good = of.rmse_px <= FAR_PX
        rows.append((f"{what}, {name}", text, f"corners {FAR_PX} px" if wanted else "", good))
    return rows


def _tile_row(of: Town, how: str) -> Row:
    """Tiles that a mosaic shows less like the truth than that on the tie points' ground."""
    gain = gain_of(of, how)
    changed = gain[np.abs(gain) > SAME_SSIM]
    by = float(changed.mean()) if changed.size else 0.0
    text = (
        f"{changed.size} of {gain.size} tiles changed, by {by:+.3f} SSIM; "
        f"{int((gain < -WORSE_SSIM).sum())} worse by more than {WORSE_SSIM}, at most by {-gain.min():.3f}"
    )
    return f"town {of.seed}, --surface {how} against ties", text, "", True


def _far(of: Roofs) -> str:
    """Corners that are off by more than is asked, farthest first: how far, and the pixel they are at."""
    worst = sorted(of.far, key=lambda f: -f[2])[:_SHOWN]
    if not worst:
        return ""
    places = ", ".join(f"{off:.1f} px at {col:.0f} {row:.0f}" for col, row, off in worst)
    return f", {len(of.far)} of them off by more than {FAR_PX:g} px: {places}"


def _class_row(what: str, name: str, of: SurfaceErrors, cell_m: float) -> Row:
    nmad_px = of.nmad_m / (cell_m / _CELL_PX)
    text = (
        f"NMAD {nmad_px:.2f} ground px, {100.0 * of.off_1_m:.1f} % off by 1 m "
        f"({100.0 * of.two_off_1_m:.1f} % of {of.two_see:,} that two see, "
        f"{100.0 * of.three_off_1_m:.1f} % of {of.three_see:,} that three see); "
        f"within 1 and 2 deviations {100.0 * of.within_1_sd:.0f} and {100.0 * of.within_2_sd:.0f} %, "
        f"filled {100.0 * of.filled:.0f} %"
    )
    what = f"{what} ({of.cells:,} cells)"
    if name in WANTED_NMAD_PX:
        limit = WANTED_NMAD_PX[name]
        return what, text, f"NMAD {limit} px", nmad_px <= limit
    if name in WANTED_OFF_1_M:
        share = WANTED_OFF_1_M[name]
        return what, text, f"{100.0 * share:.0f} % off by 1 m", of.off_1_m <= share
    return what, text, "", True


def flight(out: Path, data: Path, results: list[ResultRow]) -> list[Row]:
    """Rows of the real flight; none without it; adds to results."""
    frames = data / "brighton_beach" / "images"
    if not frames.is_dir():
        print(f"skipped: {frames} is missing")
        return []
    run = out / "brighton"
    options = ["--gsd", GSD_M, "--crs", CRS, "--surface", "dense", "--ortho", "surface", "--overwrite"]
    taken = called(out, "mosaic", frames, "-o", run, *options)
    summary = json.loads((run / "run.json").read_text(encoding="utf-8"))
    seconds = summary["timings_s"]["surface.dense"]
    matched = summary["metrics"]["surface"]["matched"]
    text = f"{seconds:.1f} s, the whole run {taken.peak_mb:.0f} MB at most, {100.0 * matched:.0f} % matched"
    good = seconds <= WANTED_S and taken.peak_mb <= WANTED_MB
    figures = {"seconds": seconds, "peak_mb": taken.peak_mb, "most_s": WANTED_S, "most_mb": WANTED_MB}
    results.append(ROWS["real"].row(good, **figures))
    rows: list[Row] = [("18 frames of 9 MP", text, f"{WANTED_S:.0f} s, {WANTED_MB:.0f} MB", good)]
    dense = ("--surface", "dense", "--ortho", "surface")
    own, one = Wanted(median_px=1.0), Wanted(median_px=0.5, p90_px=1.2)
    split = halves(data, out, run, *dense, own=own, one=one)
    for name, wanted, of in (("own surfaces", own, split.own), ("one surface", one, split.one)):
        met = of["median_px"] < wanted.median_px and of["p90_px"] < wanted.p90_px
        results.append(ROWS[name].row(met, most_median=wanted.median_px, most_p90=wanted.p90_px, **of))
    return [*rows, *split.rows, *_cloud_rows(run, data / "brighton_beach" / "model.laz")]


def _cloud_rows(run: Path, model: Path) -> list[Row]:
    """The surface on bare ground against a cloud that others have made of the same frames."""
    cloud = read_cloud(model)
    if cloud is None:
        return []
    bare = run / "bare.laz"
    write_bare_ground(cloud, _BARE_REACH_M, CRS, bare)
    files = run / "surface.tif", run / "surface_confidence.tif"
    found, _ = compare_surface(*files, bare, 0.0, lambda text: None)
    off = found.after_fit
    text = (
        f"NMAD {off.nmad_m:.3f} m, 68 % {off.abs_68_m:.3f}, 95 % {off.abs_95_m:.3f} m at {off.n:,} points, "
        f"after the cloud's shift and tilt (before: median {found.over_all.median_m:+.2f} m)"
    )
    return [("bare ground against the flight's point cloud", text, "", True)]


def main() -> int:
    """Prints the table; 1 where something is missed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("out/bench-surface"))
    parser.add_argument("--seeds", default="5,7,11", help="of the towns; empty for none")
    parser.add_argument("--real", type=Path, default=Path("../shared/data"), help="folder of the real data")
    parser.add_argument("--no-real", action="store_true", help="towns alone")
    parser.add_argument("--roofs", action="store_true", help="houses and bridges in the mosaics as well")
    parser.add_argument("--rival", action="store_true", help="StereoSGBM as well")
    parser.add_argument("--scale", action="store_true", help="20, 60 and 200 small frames as well")
    parser.add_argument("--large", action="store_true", help="160 frames of 10 MP as well")
    parser.add_argument(
        "--small", action="store_true", help="15 frames of 1000 x 750 px a town, to try the bench"
    )
    add_options(parser)
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    asked = {"with_roofs": given.roofs, "with_rival": given.rival}
    rows: list[Row] = []
    towns: list[Town] = []
    for seed in filter(None, given.seeds.split(",")):
        of_town, found = town(given.out, int(seed), SMALL if given.small else SIZE, **asked)
        rows += of_town
        towns.append(found)
    results = town_rows(towns, given.small)
    if given.scale:
        rows += scale(given.out)
    if given.large:
        rows += large(given.out, results)
    if not given.no_real:
        rows += ngi_surface(given.real, given.out, results) + flight(given.out, given.real, results)
    (given.out / "surface.json").write_text(json.dumps(rows, indent=1), encoding="utf-8")
    print_table(rows)
    write_rows(given, results)
    return int(not all(good for *_, good in rows))


if __name__ == "__main__":
    sys.exit(main())
