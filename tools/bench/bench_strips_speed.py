"""How fast strips become a scene: `geomosaic strips` as a whole, against what GDAL needs to copy the strips.

    python -m tools.bench.bench_strips_speed [--lines 35000] [--width 4096] [--ccds 8] [--out DIR]

The floor reads every strip once and writes the scene once: a VRT of the strips at their nominal places, as a
COG with the options of export.cog. The strips' overlaps are simulated, what lies between them is noise and
ground made cheaply. Each step runs in a process of its own; printed are its seconds, those of all processors
(which other work disturbs least) and its peak memory (Linux). Strips and results (some 8 GB at full
size) are deleted at the end but with --keep. Exit code 1 if the whole takes more than 1.4 of the floor, or
1 GB.
"""

from __future__ import annotations

import argparse
import json
import resource
import shutil
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import yaml
from osgeo import gdal
from rasterio.windows import Window

from geomosaic.doors.raster import OWN, open_raster
from geomosaic.export.cog import COMPRESSIONS
from geomosaic.survey.strips import StripGeometry, read_geometry
from geomosaic_simulate.strip_files import open_whole_strip
from geomosaic_simulate.strip_overlaps import simulate_overlaps
from geomosaic_simulate.strip_plan import StripPlan
from tools.bench.result_rows import RowKind, add_options, write_rows
from tools.docs.results_page import STRIPS

gdal.UseExceptions()
MOST_OF_FLOOR, MOST_GB = 1.4, 1.0
ROWS = {
    "time": RowKind(
        STRIPS,
        "{ccds:d} strips of {width:d} x {lines:,}: time over the floor",
        f"{MOST_OF_FLOOR:g}",
        "{ratio:.2f}",
    ),
    "memory": RowKind(
        STRIPS,
        "{ccds:d} strips: peak memory",
        f"{MOST_GB:g} GB",
        "{peak:.2f} GB",
    ),
}
TILE_LINES = 1024


def make_strips(plan: StripPlan, out: Path) -> None:
    """Ground of amplitudes that fall as 1 / f, noise of 150:1, from one tile; overlaps as they are seen."""
    rng = np.random.default_rng(1)
    f = np.hypot(np.fft.fftfreq(TILE_LINES)[:, None], np.fft.rfftfreq(plan.width_px))
    spectrum = np.fft.rfft2(rng.standard_normal((TILE_LINES, plan.width_px))) / np.maximum(f, 0.003) ** 1.2
    ground = np.fft.irfft2(spectrum, s=(TILE_LINES, plan.width_px))
    tile = 360.0 * (1.0 + 0.15 * ground / ground.std()) + 2.4 * rng.standard_normal(ground.shape)
    tile = np.clip(np.rint(tile), 1, 2**plan.bit_depth - 1).astype(np.uint16)
    g, pairs = simulate_overlaps(plan)
    for k, ccd in enumerate(g.ccds):
        with open_whole_strip(out / str(ccd.path), g.width_px, g.lines[k], g.bit_depth) as strip:
            for top in range(0, g.lines[k], TILE_LINES):
                piece = np.roll(tile, 97 * k + top // TILE_LINES, axis=1)[: g.lines[k] - top].copy()
                rows = slice(top, top + len(piece))
                if k < len(pairs):
                    piece[:, -g.read_px :] = pairs[k].left[rows]
                if k > 0:
                    piece[:, : g.read_px] = pairs[k - 1].right[rows]
                strip.write(piece, 1, window=Window(0, top, *piece.shape[::-1]))
    ccds = [{"path": str(c.path), "row": c.row} for c in g.ccds]
    entry = {"line_rate_hz": g.line_rate_hz, "bit_depth": g.bit_depth, "ccds": ccds}
    (out / "geometry.yaml").write_text(yaml.safe_dump(entry))


def floor(g: StripGeometry, out: Path) -> None:
    """GDAL alone: strips side by side, at their nominal places, as a COG."""
    apart = round(g.row_separation_lines)
    vrt = out / "floor.vrt"
    sources = []
    for k, ccd in enumerate(g.ccds):
        size = f'xSize="{g.width_px}" ySize="{g.lines[k]}"'
        x, y = k * (g.width_px - g.overlap_px), apart if ccd.row == 1 else 0
        sources.append(
            f'<SimpleSource><SourceFilename relativeToVRT="0">{ccd.path}</SourceFilename>'
            f'<SourceBand>1</SourceBand><SrcRect xOff="0" yOff="0" {size}/>'
            f'<DstRect xOff="{x}" yOff="{y}" {size}/></SimpleSource>'
        )
    vrt.write_text(
        f'<VRTDataset rasterXSize="{g.scene_width_px}" rasterYSize="{max(g.lines) + apart}">'
        f'<VRTRasterBand dataType="UInt16" band="1">{"".join(sources)}</VRTRasterBand></VRTDataset>'
    )
    options = ["COMPRESS=DEFLATE", *COMPRESSIONS["deflate"], "BIGTIFF=IF_SAFER", "NUM_THREADS=2"]
    gdal.SetCacheMax(256 << 20)
    gdal.Translate(str(out / "floor_cog.tif"), str(vrt), format="COG", creationOptions=options)


def timed_floor(out: Path) -> None:
    """The floor in this process; prints seconds and peak memory in GB."""
    g = read_geometry(out / "geometry.yaml")
    start = time.perf_counter()
    floor(g, out)
    seconds = time.perf_counter() - start
    peak = next(v for v in Path("/proc/self/status").read_text().splitlines() if v.startswith("VmHWM"))
    print(f"{seconds:.3f} {int(peak.split()[1]) / 2**20:.3f}")


def whole(out: Path) -> tuple[float, float, dict[str, float]]:
    """`geomosaic strips`: seconds, peak memory in GB, and seconds of each stage."""
    start = time.perf_counter()
    command: list[str | Path] = [
        Path(sys.executable).with_name("geomosaic"),
        "strips",
        out / "geometry.yaml",
        "-o",
        out / "run",
    ]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    seconds = time.perf_counter() - start
    run_summary = json.loads((out / "run" / "run.json").read_text())
    shutil.rmtree(out / "run")
    return seconds, run_summary["peak_memory_mb"] / 1e3, run_summary["timings_s"]


def processors_s() -> float:
    """Seconds that processes started here have taken of all processors."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def main() -> int:
    """Times both in turn and prints their ratio."""
    ask = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    ask.add_argument("--lines", type=int, default=35000)
    ask.add_argument("--width", type=int, default=4096)
    ask.add_argument("--ccds", type=int, default=8)
    ask.add_argument("--rounds", type=int, default=2, help="how often both are timed")
    ask.add_argument("--out", type=Path, default=Path("out/bench-strips-speed"))
    ask.add_argument("--keep", action="store_true", help="keep the strips")
    ask.add_argument("--floor", action="store_true", help=argparse.SUPPRESS)
    add_options(ask)
    args = ask.parse_args()
    out = args.out.absolute()
    out.mkdir(parents=True, exist_ok=True)
    if args.floor:
        timed_floor(out)
        return 0
    plan = StripPlan(seed=3, ccds=args.ccds, width_px=args.width, lines=args.lines)
    ratios, of_processors, peak = [], [], 0.0
    try:
        if not is_made(out, plan):
            make_strips(plan, out)
        for _ in range(args.rounds):
            command = [sys.executable, "-m", "tools.bench.bench_strips_speed", "--floor", "--out", str(out)]
            before = processors_s()
            done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
            least, memory = (float(v) for v in done.stdout.split())
            between = processors_s()
            used = between - before
            print(f"floor {least:6.1f} s, {used:.1f} s of processors, {memory:.2f} GB", flush=True)
            (out / "floor_cog.tif").unlink()
            took, memory, stages = whole(out)
            after = processors_s()
            ratios.append(took / least)
            of_processors.append((after - between) / used)
            peak = max(peak, memory)
            print(f"whole {took:6.1f} s, {after - between:.1f} s of processors, {memory:.2f} GB, ", end="")
            print(f"{ratios[-1]:.2f} and {of_processors[-1]:.2f} of the floor; seconds by stage:")
            print("  " + ", ".join(f"{name} {seconds:.1f}" for name, seconds in stages.items()), flush=True)
    finally:
        if not args.keep:
            shutil.rmtree(out)
    print(f"the whole takes {np.median(ratios):.2f} of the floor's time, ", end="")
    print(f"{np.median(of_processors):.2f} of its processors' time, {peak:.2f} GB")
    ratio, size = float(np.median(ratios)), {"ccds": args.ccds, "width": args.width, "lines": args.lines}
    time_row = ROWS["time"].row(ratio <= MOST_OF_FLOOR, ratio=ratio, **size)
    write_rows(args, [time_row, ROWS["memory"].row(peak <= MOST_GB, peak=peak, **size)])
    return int(np.median(ratios) > MOST_OF_FLOOR or peak > MOST_GB)


def is_made(out: Path, plan: StripPlan) -> bool:
    """Whether an earlier run has left these strips."""
    if not (out / "geometry.yaml").exists():
        return False
    geometry = read_geometry(out / "geometry.yaml")
    with open_raster(out / "ccd1.tif", OWN) as strip:
        return len(geometry.ccds) == plan.ccds and strip.shape == (plan.lines, plan.width_px)


if __name__ == "__main__":
    sys.exit(main())
