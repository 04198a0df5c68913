"""Simulates a small survey, mosaics it with the command line, and says how true the mosaic came out."""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from pathlib import Path


def geomosaic(*arguments: str | Path) -> None:
    """Runs a command of geomosaic, shown as one would type it; ends the demo if it fails."""
    words = [str(a) for a in arguments]
    print("\n$ geomosaic " + " ".join(words), flush=True)
    done = subprocess.run([sys.executable, "-m", "geomosaic.cli.main", *words], check=False)
    if done.returncode:
        sys.exit(done.returncode)


def figures(run: Path) -> str:
    """What the comparison with the true ortho gave."""
    summary = json.loads((run / "run.json").read_text(encoding="utf-8"))
    quality, frames = summary["metrics"]["quality"], summary["frames"]
    return "\n".join(
        (
            f"frames tied                 {frames['tied']} of {frames['total']}",
            f"ground pixel                {summary['mosaic']['gsd_m']:g} m, {summary['mosaic']['crs']}",
            f"absolute RMSE               {quality['absolute_rmse_m']:.2f} m (noise of a position: 1.5 m)",
            f"RMSE after similarity       {quality['after_similarity_px']:.2f} px",
            f"jumps at seams, 99 %        {quality['jump_99_px']:.2f} px",
        )
    )


def main() -> None:
    """The demo."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path, help="folder to write: OUT/survey and OUT/run")
    out: Path = parser.parse_args().out
    survey, run = out / "survey", out / "run"
    started = time.monotonic()
    print("Demo: 3 x 4 frames are simulated and mosaicked; less than a minute on two idle cores.")
    geomosaic("simulate", "frames", survey, "--lines", "3", "--frames-per-line", "4")
    geomosaic(
        *("mosaic", survey / "frames", "-o", run),
        *("--pos", survey / "pos.csv", "--camera", survey / "cameras.json"),
        *("--reference", survey / "truth" / "ortho.tif"),
        *("--set", f"quality.compare.truth={survey / 'truth' / 'positions.csv'}"),
    )
    print(f"\nAgainst the simulated truth ({time.monotonic() - started:.0f} s in all)\n{figures(run)}")
    print(
        f"""
Where it lies, and how to open it
mosaic        {run / "mosaic.tif"}, and {survey / "truth" / "ortho.tif"}, in any GIS
GeoPackage    {run / "layers.gpkg"} in any GIS: frames, footprints, tie points, residuals, seamlines
report        {run / "report.html"} in a browser
recording     {run / "run.mcap"}: .venv/bin/geomosaic inspect {run / "run.mcap"}
                  .venv/bin/geomosaic view {run / "run.mcap"}"""
    )


if __name__ == "__main__":
    main()
