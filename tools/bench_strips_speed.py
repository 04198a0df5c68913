"""How fast strips become a scene: composition and COG, beside what GDAL needs to lay the strips side by side.

    .venv/bin/python tools/bench_strips_speed.py [--lines 35000] [--width 4096] [--ccds 8] [--out DIR]

The floor is a VRT of the strips at their nominal places, written as a COG with the options of export.cog.
Each step runs in a process of its own; printed are its seconds and its peak memory (Linux). Strips and
results (some 8 GB at full size) are deleted at the end but with --keep. Exit code 1 if composition takes
more than 0.4 of the floor, or 1 GB.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
from osgeo import gdal
from rasterio.windows import Window

from geomosaic.ccd.layout import ImageSpaceLayout, image_space_layout
from geomosaic.ccd.model import PairOffsets, StripOffsets
from geomosaic.ccd.radiometry import Radiometry
from geomosaic.export.cog import write_cog
from geomosaic.mosaic.strip_compose import compose_strips
from geomosaic.simulate.strip_files import open_whole_strip
from geomosaic.survey.strips import Ccd, StripGeometry, open_strip

gdal.UseExceptions()
MOST_OF_FLOOR, MOST_GB = 0.4, 1.0
BIT_DEPTH, TILE_LINES = 10, 1024


def geometry(out: Path, ccds: int, width: int, lines: int) -> StripGeometry:
    return StripGeometry(
        ccds=tuple(Ccd(out / f"ccd{k + 1}.tif", 1 + k % 2) for k in range(ccds)),
        width_px=width,
        lines=(lines,) * ccds,
        line_rate_hz=3272.4,
        bit_depth=BIT_DEPTH,
    )


def make_strips(g: StripGeometry) -> None:
    """Ground of amplitudes that fall as 1 / f, noise of 150:1; pieces of one tile, to be quick."""
    rng = np.random.default_rng(1)
    f = np.hypot(np.fft.fftfreq(TILE_LINES)[:, None], np.fft.rfftfreq(g.width_px))
    spectrum = np.fft.rfft2(rng.standard_normal((TILE_LINES, g.width_px))) / np.maximum(f, 0.003) ** 1.2
    ground = np.fft.irfft2(spectrum, s=(TILE_LINES, g.width_px))
    tile = 360.0 * (1.0 + 0.15 * ground / ground.std()) + 2.4 * rng.standard_normal(ground.shape)
    tile = np.clip(np.rint(tile), 1, 2**g.bit_depth - 1).astype(np.uint16)
    for k, ccd in enumerate(g.ccds):
        assert ccd.path is not None
        with open_whole_strip(ccd.path, g.width_px, g.lines[k], g.bit_depth) as strip:
            for top in range(0, g.lines[k], TILE_LINES):
                piece = np.roll(tile, 97 * k + top // TILE_LINES, axis=1)[: g.lines[k] - top]
                strip.write(piece, 1, window=Window(0, top, *piece.shape[::-1]))


def _is_strip(path: Path | None, g: StripGeometry) -> bool:
    """Whether an earlier run has left this strip."""
    if path is None or not path.exists():
        return False
    with open_strip(path) as strip:
        return bool(strip.shape == (g.lines[0], g.width_px))


def layout(g: StripGeometry) -> ImageSpaceLayout:
    """Offsets of some pixels, drifting and trembling, other ones for each pair."""
    pairs = []
    for k in g.pairs:
        u = np.arange(g.lines[k]) / g.line_rate_hz
        dcol = 2.0 * np.sin(0.6 * u + k) + 0.4 * np.sin(2 * np.pi * 4.7 * u)
        dline = 3.0 * np.sin(0.5 * u + 2 * k) + 1.2 * np.sin(2 * np.pi * 1.1 * u)
        pairs.append(PairOffsets(k, dcol, dline, 0 * u, 0 * u, np.zeros(len(u), np.uint8)))
    return image_space_layout(g, StripOffsets("given", tuple(pairs)))


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
    write_cog(vrt, out / "floor_cog.tif")


def step(name: str, g: StripGeometry, out: Path) -> None:
    """One of the steps, in this process."""
    start = time.perf_counter()
    if name == "strips":
        make_strips(g)
    elif name == "floor":
        floor(g, out)
    elif name == "compose":
        ones = np.ones(len(g.ccds))
        compose_strips(g, layout(g), Radiometry(1.01 * ones, -2.0 * ones), out / "scene.tif")
    else:
        write_cog(out / "scene.tif", out / "scene_cog.tif")
    seconds = time.perf_counter() - start
    peak = next(
        (v for v in Path("/proc/self/status").read_text().splitlines() if v.startswith("VmHWM")), ": 0"
    )
    print(f"{seconds:.3f} {int(peak.split()[1]) / 2**20:.3f}")


def main() -> int:
    ask = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    ask.add_argument("--lines", type=int, default=35000)
    ask.add_argument("--width", type=int, default=4096)
    ask.add_argument("--ccds", type=int, default=8)
    ask.add_argument("--out", type=Path, default=Path("out/bench-strips-speed"))
    ask.add_argument("--keep", action="store_true", help="keep the strips and the results")
    ask.add_argument("--step", choices=("strips", "floor", "compose", "cog"), help=argparse.SUPPRESS)
    told = ask.parse_args()
    out = told.out.absolute()
    out.mkdir(parents=True, exist_ok=True)
    g = geometry(out, told.ccds, told.width, told.lines)
    if told.step is not None:
        step(told.step, g, out)
        return 0
    took, peaks = {}, {}
    try:
        for name in ("strips", "floor", "compose", "cog"):
            if name == "strips" and all(_is_strip(c.path, g) for c in g.ccds):
                continue
            command = [sys.executable, __file__, *sys.argv[1:], "--step", name]
            done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
            took[name], peaks[name] = (float(v) for v in done.stdout.split())
            print(f"{name:8} {took[name]:8.1f} s {peaks[name]:6.2f} GB", flush=True)
            if name == "floor":
                (out / "floor_cog.tif").unlink()
    finally:
        if not told.keep:
            made = [out / name for name in ("floor.vrt", "floor_cog.tif", "scene.tif", "scene_cog.tif")]
            for path in [*made, *(c.path for c in g.ccds if c.path is not None)]:
                path.unlink(missing_ok=True)
    share = took["compose"] / took["floor"]
    whole = (took["compose"] + took["cog"]) / took["floor"]
    print(f"composition {share:.2f} of the floor, with the COG {whole:.2f}; {peaks['compose']:.2f} GB")
    return int(share > MOST_OF_FLOOR or peaks["compose"] > MOST_GB)


if __name__ == "__main__":
    sys.exit(main())
